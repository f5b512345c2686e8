//! Positions of the lines, and the order in which they are run.

use planish_types::Surface;
use rand::{SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

use super::{LineOrder, RasterSettings, runs::Runs};
use crate::{
    MAX_SEGMENTS, ToolPathError,
    region::{Interval, SLACK},
};

/// Returns the coordinates w of the lines across them, mm, ascending; `None` if their segments would exceed
/// [`MAX_SEGMENTS`]. Refuses a given origin with which no line lies in the region.
pub(super) fn positions(
    surface: &Surface,
    runs: &Runs,
    settings: &RasterSettings,
) -> Result<Option<Vec<f64>>, ToolPathError> {
    let p = settings.pitch_mm;
    let region = runs.extent(1, settings.overscan_mm);
    let (first, spaces) = match (settings.pitch_range_mm, settings.line_origin_mm) {
        (Some(range), _) => {
            let count = Count::new(surface, runs, region, settings, range);
            // N(w_k) = (N_H - floor(N_H)) / 2 + k
            let all = count.line[count.line.len() - 1];
            let spaces = (all + SLACK).floor();
            let first = 0.5 * (all - spaces);
            return Ok(up_to(spaces).map(|k| k.map(|k| count.position(first + k)).collect()));
        }
        (None, None) => {
            // w_k = w_mid + (k - (n-1)/2) p,  n = floor(H/p) + 1
            let spaces = ((region.high - region.low) / p + SLACK).floor();
            (0.5 * (region.low + region.high) - 0.5 * spaces * p, spaces)
        }
        (None, Some(origin)) => {
            // w_k = C + k p in the region
            let first = ((region.low - origin) / p - SLACK).ceil();
            let last = ((region.high - origin) / p + SLACK).floor();
            if first > last {
                return Err(ToolPathError::NoLine {
                    origin_mm: origin,
                    pitch_mm: p,
                    low_mm: region.low,
                    high_mm: region.high,
                });
            }
            (origin + first * p, last - first)
        }
    };
    Ok(up_to(spaces).map(|k| k.map(|k| first + k * p).collect()))
}

/// Returns the numbers 0, 1, .. `spaces` of the lines. `None` if their segments (one per line and one per turn) would
/// exceed [`MAX_SEGMENTS`].
fn up_to(spaces: f64) -> Option<impl Iterator<Item = f64>> {
    if 2.0 * spaces < MAX_SEGMENTS as f64 {
        Some((0..=spaces as usize).map(|k| k as f64))
    } else {
        None
    }
}

/// Returns the indices 0 .. `lines` of the lines in the order in which they are run.
pub(super) fn order(lines: usize, order: LineOrder) -> Vec<usize> {
    let mut all: Vec<usize> = (0..lines).collect();
    match order {
        LineOrder::Sequential => all,
        LineOrder::BiStep => {
            let back = (0..lines).rev().filter(|k| k % 2 == 1);
            (0..lines).step_by(2).chain(back).collect()
        }
        LineOrder::Random { seed } => {
            all.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
            all
        }
    }
}

/// The number N(w) of line distances below the coordinate w across the lines, for a pitch that follows the map. It is
/// linear between the rows.
struct Count {
    /// Coordinates w at which the slope of N changes, ascending, mm.
    break_mm: Vec<f64>,
    /// Values of N at these coordinates, from 0.
    line: Vec<f64>,
}

impl Count {
    fn new(
        surface: &Surface,
        runs: &Runs,
        region: Interval,
        settings: &RasterSettings,
        [least_mm, most_mm]: [f64; 2],
    ) -> Self {
        let h = runs.pixel_mm[1];
        let part = runs.extent(1, 0.0);
        let (row_mean, mean) = row_means(surface, settings.scan.axes()[1], part, h);
        // d = clamp(p mean r / r, d_min, d_max)
        let ratio =
            |r: f64| if mean > 0.0 { settings.pitch_mm * mean / r } else { settings.pitch_mm };
        let mut break_mm = vec![region.low];
        let mut line = vec![0.0];
        for (j, r) in row_mean.iter().enumerate() {
            let is_last = j + 1 == row_mean.len();
            let end = if is_last { region.high } else { part.low + (j as f64 + 0.5) * h };
            // N(w) = integral of dw / d
            line.push(line[j] + (end - break_mm[j]) / ratio(*r).clamp(least_mm, most_mm));
            break_mm.push(end);
        }
        Self { break_mm, line }
    }

    /// Returns the coordinate w, mm, at which N(w) is `line`.
    fn position(&self, line: f64) -> f64 {
        let above = self.line.partition_point(|n| *n <= line).clamp(1, self.line.len() - 1);
        let n = &self.line[above - 1..=above];
        let w = &self.break_mm[above - 1..=above];
        let f = if n[1] > n[0] { (line - n[0]) / (n[1] - n[0]) } else { 0.0 };
        w[0] + f * (w[1] - w[0])
    }
}

/// Returns the mean of the desired removal, nm, in each row along the lines, and over all pixels. Row j is `h` mm high
/// and centred at part.low + j h along the unit vector `across`. If heights are negative, the lowest is subtracted.
/// Rows without a valid pixel have the mean of the row before.
fn row_means(surface: &Surface, across: [f64; 2], part: Interval, h: f64) -> (Vec<f64>, f64) {
    let grid = surface.grid();
    let map = surface.height_nm();
    let rows = ((part.high - part.low) / h).round() as usize + 1;
    let mut sum = vec![(0.0, 0.0); rows];
    let lowest = surface.statistics().min.min(0.0);
    for ((r, c), z) in map.indexed_iter().filter(|(_, z)| !z.is_nan()) {
        let w = grid.x.coordinate_mm(c) * across[0] + grid.y.coordinate_mm(r) * across[1];
        let row = &mut sum[(((w - part.low) / h).round() as usize).min(rows - 1)];
        *row = (row.0 + (z - lowest), row.1 + 1.0);
    }
    let (total, count) = sum.iter().fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
    let mean = total / count;
    let mut last = mean;
    let means = sum.into_iter().map(|(total, count)| {
        last = if count > 0.0 { total / count } else { last };
        last
    });
    (means.collect(), mean)
}
