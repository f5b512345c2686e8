//! The clear aperture for lines of any direction: its rows (or columns) of valid pixels as
//! straight pieces in coordinates u along and w across the lines.
//!
//! Rows where the lines are nearer to x, columns where they are nearer to y: so a line meets the
//! next row after at most sqrt(2) pixels.

use planish_types::Surface;

use crate::region::{Aperture, Interval, join};

/// Straight pieces of valid pixels, as pairs of end points (u, w), sorted by the smaller w of their ends.
pub(super) struct Runs {
    piece: Vec<[[f64; 2]; 2]>,
    /// Largest extent of a piece across the lines, mm; 0 for lines along x or y.
    tilt_mm: f64,
    /// Distance, mm, from a pixel column to the next along a line, and from a pixel row to the next across the lines.
    pub(super) pixel_mm: [f64; 2],
}

impl Runs {
    /// Makes the pieces from the valid pixels of `surface`; `axes` are the unit vectors along and across the lines.
    pub(super) fn new(surface: &Surface, axes: [[f64; 2]; 2]) -> Self {
        let grid = surface.grid();
        let map = surface.height_nm().view();
        let [along, across] = axes;
        let by_rows = along[0].abs() >= along[1].abs();
        let aperture = if by_rows {
            Aperture::new(&grid.x, &grid.y, map)
        } else {
            Aperture::new(&grid.y, &grid.x, map.reversed_axes())
        };
        let mut piece = Vec::new();
        for (row, runs) in &aperture.rows {
            for run in runs {
                piece.push([run.low, run.high].map(|end| {
                    let p = if by_rows { [end, *row] } else { [*row, end] };
                    // u = <x, along>,  w = <x, across>
                    [along, across].map(|a| p[0] * a[0] + p[1] * a[1])
                }));
            }
        }
        piece.sort_by(|a, b| low_end_mm(a).total_cmp(&low_end_mm(b)));
        let tilt_mm = piece.iter().map(|s| (s[1][1] - s[0][1]).abs()).fold(0.0, f64::max);
        let cos = along[0].abs().max(along[1].abs());
        Self { piece, tilt_mm, pixel_mm: aperture.pixel_mm.map(|h| h / cos) }
    }

    /// Returns the extent along (0) or across (1) the lines, overscan included, mm.
    pub(super) fn extent(&self, axis: usize, overscan_mm: f64) -> Interval {
        let ends = self.piece.iter().flatten().map(|p| p[axis]);
        Interval {
            low: ends.clone().fold(f64::MAX, f64::min) - overscan_mm,
            high: ends.fold(f64::MIN, f64::max) + overscan_mm,
        }
    }

    /// Returns the intervals of a line in the region: `[u_first - o, u_last + o]` of the parts of the pieces in the
    /// band `low_mm <= w <= high_mm`, joined if they are at most `bridge_mm` apart; ascending.
    pub(super) fn stretches(
        &self,
        [low_mm, high_mm]: [f64; 2],
        overscan_mm: f64,
        bridge_mm: f64,
    ) -> Vec<Interval> {
        let first = self.piece.partition_point(|s| low_end_mm(s) < low_mm - self.tilt_mm);
        let last = self.piece.partition_point(|s| low_end_mm(s) <= high_mm);
        let met = self.piece[first..last].iter().filter(|[a, b]| a[1].max(b[1]) >= low_mm);
        let parts = met.map(|[a, b]| {
            let rise = b[1] - a[1];
            let mut ends = [a[0], b[0]];
            if rise != 0.0 {
                // w = w_a + f (w_b - w_a)
                ends = [low_mm, high_mm]
                    .map(|w| a[0] + ((w - a[1]) / rise).clamp(0.0, 1.0) * (b[0] - a[0]));
            }
            Interval {
                low: ends[0].min(ends[1]) - overscan_mm,
                high: ends[0].max(ends[1]) + overscan_mm,
            }
        });
        join(parts.collect(), bridge_mm)
    }
}

/// Returns the smaller coordinate w, across the lines, of the ends of a piece, mm.
fn low_end_mm(piece: &[[f64; 2]; 2]) -> f64 {
    piece[0][1].min(piece[1][1])
}
