//! The clear aperture as every method sees it: runs of valid pixels, each pixel as its centre,
//! and the region that they become when the tool goes beyond them by an overscan.
//!
//! A tool may remove beside the place where it stands: the centroid c of its TIF is off centre. It removes around the
//! pixel p while it stands at p - c, so its path is that over the aperture moved by -c
//! ([`planish_types::Surface::seen_by_tool`]), with the overscan that the TIF has around c:
//!
//! ```text
//! stands at  p - c
//! overscan   max over both axes of (last - c, c - first),   first, last = offsets of the first and the last sample
//! ```

use ndarray::ArrayView2;
use planish_types::{Axis, Invalid, Tif};

/// Lengths that agree to this fraction of a pitch or a step are equal: rounding of coordinates.
pub(crate) const SLACK: f64 = 1e-9;

/// The usual overscan: half the TIF's larger size around `off_centre_mm`, where it removes, which keeps the removal at
/// the edge equal to that inside, mm.
pub fn usual_overscan_mm(tif: &Tif, off_centre_mm: [f64; 2]) -> f64 {
    let half = |axis: &Axis, c: f64| (axis.end_mm() - c).max(c - axis.start_mm());
    let [x, y] = off_centre_mm;
    half(&tif.grid().x, x).max(half(&tif.grid().y, y))
}

/// The clear aperture as runs of valid pixels, in coordinates along and across the lines.
pub(crate) struct Aperture {
    /// Across the lines, mm: (coordinate of a pixel row, its runs), rows without a run left out.
    pub rows: Vec<(f64, Vec<Interval>)>,
    /// Pixel along and across, mm.
    pub pixel_mm: [f64; 2],
}

/// A stretch of a line, mm; `low <= high`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Interval {
    pub low: f64,
    pub high: f64,
}

impl Aperture {
    /// The valid pixels of `map` (across, along).
    pub fn new(along: &Axis, across: &Axis, map: ArrayView2<f64>) -> Self {
        let mut rows = Vec::new();
        for (r, row) in map.outer_iter().enumerate() {
            let mut runs: Vec<Interval> = Vec::new();
            let mut open = false;
            for (c, z) in row.iter().enumerate() {
                let u = along.at(c);
                match (z.is_nan(), open) {
                    (false, true) => runs.last_mut().expect("a run is open").high = u,
                    (false, false) => runs.push(Interval { low: u, high: u }),
                    (true, _) => {}
                }
                open = !z.is_nan();
            }
            if !runs.is_empty() {
                rows.push((across.at(r), runs));
            }
        }
        Self { rows, pixel_mm: [along.step_mm(), across.step_mm()] }
    }

    /// Extent across the lines, overscan included, mm. A surface has a valid pixel.
    pub fn across(&self, overscan_mm: f64) -> Interval {
        let (first, last) = (self.rows[0].0, self.rows[self.rows.len() - 1].0);
        Interval { low: first - overscan_mm, high: last + overscan_mm }
    }

    /// Extent along the lines, overscan included, mm.
    pub fn along(&self, overscan_mm: f64) -> Interval {
        let runs = || self.rows.iter().flat_map(|(_, runs)| runs);
        Interval {
            low: runs().map(|i| i.low).fold(f64::MAX, f64::min) - overscan_mm,
            high: runs().map(|i| i.high).fold(f64::MIN, f64::max) + overscan_mm,
        }
    }

    /// Where a line is in the region: the runs `[u_first - o, u_last + o]` of the pixel rows
    /// with `low_mm <= w <= high_mm`, those at most `bridge_mm` apart joined; ascending.
    pub fn stretches(
        &self,
        low_mm: f64,
        high_mm: f64,
        overscan_mm: f64,
        bridge_mm: f64,
    ) -> Vec<Interval> {
        let first = self.rows.partition_point(|(w, _)| *w < low_mm);
        let last = self.rows.partition_point(|(w, _)| *w <= high_mm);
        let runs = self.rows[first..last].iter().flat_map(|(_, runs)| runs);
        let grown = runs.map(|i| Interval { low: i.low - overscan_mm, high: i.high + overscan_mm });
        join(grown.collect(), bridge_mm)
    }
}

/// Intervals at most `bridge_mm` apart joined; ascending.
pub(crate) fn join(mut all: Vec<Interval>, bridge_mm: f64) -> Vec<Interval> {
    all.sort_unstable_by(|a, b| a.low.total_cmp(&b.low).then(a.high.total_cmp(&b.high)));
    let mut joined: Vec<Interval> = Vec::new();
    for next in all {
        match joined.last_mut() {
            Some(last) if next.low - last.high <= bridge_mm => {
                last.high = last.high.max(next.high);
            }
            _ => joined.push(next),
        }
    }
    joined
}

/// Longest length of a setting, mm: beyond it no path has its points.
const LONGEST_MM: f64 = 1e7;

/// Refuses what is not a length > 0, or >= 0 where `zero` allows it.
pub(crate) fn check_length(name: &'static str, mm: f64, zero: bool) -> Result<(), Invalid> {
    if mm > LONGEST_MM && mm.is_finite() {
        let remedy = "give mm, at most 1e7: no point of a path may be farther from the origin";
        return Err(Invalid::whole(name, format!("is {mm:e}"), remedy));
    }
    if mm.is_finite() && (mm > 0.0 || zero && mm == 0.0) {
        return Ok(());
    }
    let remedy =
        if zero { "give a length of at least 0 mm" } else { "give a positive length in mm" };
    Err(Invalid::whole(name, format!("is {mm}"), remedy))
}
