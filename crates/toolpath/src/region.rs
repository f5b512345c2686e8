//! The clear aperture as every method sees it: runs of valid pixels, each pixel as its centre,
//! and the region that they become when the tool goes beyond them by an overscan.
//!
//! A tool may remove beside the place where it stands: the centroid c of its TIF is off centre. It removes around the
//! pixel p while it stands at p - c, so its path is that over the aperture moved by -c
//! ([`planish_types::Surface::seen_by_tool`]), with the overscan that the TIF has around c:
//!
//! ```text
//! stands at  p - c
//! overscan   o = the least |r - c|_max of a sample r so that the samples beyond it hold at most 5e-4 of sum R
//! ```
//!
//! A TIF is often stored with a margin in which it removes nothing. The overscan follows what removes: the samples and
//! not their array.

use ndarray::{Array2, ArrayView2};
use planish_types::{Axis, Grid, Invalid, Surface, Tif};

/// Difference of two lengths, as a fraction of a pitch or a step, up to which they are equal. Larger: different
/// lengths are taken as equal. Smaller: rounding of coordinates adds a segment.
pub(crate) const SLACK: f64 = 1e-9;

/// Fraction of the volume of a TIF that may lie beyond the square that sets the usual overscan. About half of it is
/// missing at an edge of the part. Larger: the edge is left higher. Smaller: noise in the margin of a measured TIF
/// counts, and the path spends time beyond the part.
const BEYOND_SUPPORT: f64 = 5e-4;

/// Returns the usual overscan, mm: half the side of the square around the TIF's centroid `off_centre_mm` beyond which
/// lies at most 5e-4 of the TIF's volume. It keeps the removal at the edge equal to that inside.
pub fn usual_overscan_mm(tif: &Tif, off_centre_mm: [f64; 2]) -> f64 {
    let [cx, cy] = off_centre_mm;
    let grid = tif.grid();
    let rate = tif.rate_nm_per_s();
    let samples = rate.indexed_iter().map(|((r, c), v)| {
        let distance =
            (grid.x.coordinate_mm(c) - cx).abs().max((grid.y.coordinate_mm(r) - cy).abs());
        (distance, *v)
    });
    let mut samples: Vec<(f64, f64)> = samples.collect();
    samples.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then_with(|| b.1.total_cmp(&a.1)));
    let most = BEYOND_SUPPORT * rate.sum();
    // From the outermost square of samples inwards, until those beyond would be too much.
    let mut beyond = 0.0;
    let mut support = samples[0].0;
    for square in samples.chunk_by(|a, b| a.0 - b.0 <= SLACK * a.0) {
        support = square[0].0;
        beyond += square.iter().map(|(_, v)| v).sum::<f64>();
        if beyond.abs() > most {
            break;
        }
    }
    support
}

/// Returns the map with only those pixels valid that are at least `inset_mm` from the edge of the aperture. The edge
/// runs half a pixel beyond the centres of the outermost valid pixels:
///
/// ```text
/// inset  the pixels with |x - b| + h/2 >= inset for every valid pixel b that has an invalid or no neighbour
/// ```
///
/// with h the smaller of the pixel's two sides. Refuses an `inset_mm` that is not finite, and one that leaves nothing.
pub fn inset(surface: &Surface, inset_mm: f64) -> Result<Surface, Invalid> {
    let z = surface.height_nm();
    let grid = surface.grid();
    let (ny, nx) = z.dim();
    let pixel_mm = [grid.x.step_mm(), grid.y.step_mm()];
    if !inset_mm.is_finite() {
        let problem = format!("is {}", -inset_mm);
        return Err(Invalid::whole("overscan_mm", problem, "give a finite number"));
    }
    let reach_mm = inset_mm - 0.5 * pixel_mm[0].min(pixel_mm[1]);
    let cells = pixel_mm.map(|mm| (reach_mm / mm).ceil().clamp(0.0, nx.max(ny) as f64) as usize);
    let mut left = z.clone();
    for ((r, c), _) in z.indexed_iter().filter(|(pixel, v)| !v.is_nan() && is_border(z, *pixel)) {
        for i in r.saturating_sub(cells[1])..(r + cells[1] + 1).min(ny) {
            for k in c.saturating_sub(cells[0])..(c + cells[0] + 1).min(nx) {
                let distance_mm =
                    (i.abs_diff(r) as f64 * pixel_mm[1]).hypot(k.abs_diff(c) as f64 * pixel_mm[0]);
                if distance_mm < reach_mm {
                    left[[i, k]] = f64::NAN;
                }
            }
        }
    }
    if left.iter().all(|v| v.is_nan()) {
        let problem = format!("is -{inset_mm} mm, which leaves nothing of the aperture");
        return Err(Invalid::whole(
            "overscan_mm",
            problem,
            "give a smaller distance from the edge",
        ));
    }
    Surface::new(*grid, left)
}

/// Returns true if a pixel (row, column) has an invalid neighbour, or lies at the edge of the map.
fn is_border(z: &Array2<f64>, (r, c): (usize, usize)) -> bool {
    let neighbours = [(r.wrapping_sub(1), c), (r + 1, c), (r, c.wrapping_sub(1)), (r, c + 1)];
    neighbours.iter().any(|n| z.get(*n).is_none_or(|z| z.is_nan()))
}

/// Returns the centres of the valid pixels, mm.
pub(crate) fn valid_mm(surface: &Surface) -> Vec<[f64; 2]> {
    let grid = surface.grid();
    let valid = surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan());
    valid.map(|((r, c), _)| [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)]).collect()
}

/// Returns the pixel (row, column) whose centre is nearest to the point (x, y), mm; `None` beyond the map.
pub(crate) fn nearest_pixel(grid: &Grid, [x, y]: [f64; 2]) -> Option<(usize, usize)> {
    let [row, column] = [(&grid.y, y), (&grid.x, x)].map(|(axis, mm)| {
        let i = ((mm - axis.start_mm()) / axis.step_mm()).round();
        if i >= 0.0 && i < axis.len() as f64 { Some(i as usize) } else { None }
    });
    row.zip(column)
}

/// The clear aperture as runs of valid pixels, in coordinates along and across the lines.
pub(crate) struct Aperture {
    /// Rows of pixels: coordinate across the lines, mm, and the runs of valid pixels in the row. Rows without a run are
    /// left out.
    pub rows: Vec<(f64, Vec<Interval>)>,
    /// Pixel pitch along and across the lines, mm.
    pub pixel_mm: [f64; 2],
}

/// An interval on a line: its smallest and largest coordinate, mm; `low <= high`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Interval {
    pub low: f64,
    pub high: f64,
}

impl Aperture {
    /// Finds the runs of valid pixels of `map`, whose rows lie at the coordinates `across` and columns at `along`.
    pub fn new(along: &Axis, across: &Axis, map: ArrayView2<f64>) -> Self {
        let mut rows = Vec::new();
        for (r, row) in map.outer_iter().enumerate() {
            let mut runs: Vec<Interval> = Vec::new();
            let mut open = false;
            for (c, z) in row.iter().enumerate() {
                let u = along.coordinate_mm(c);
                match (z.is_nan(), open) {
                    (false, true) => runs.last_mut().expect("a run is open").high = u,
                    (false, false) => runs.push(Interval { low: u, high: u }),
                    (true, _) => {}
                }
                open = !z.is_nan();
            }
            if !runs.is_empty() {
                rows.push((across.coordinate_mm(r), runs));
            }
        }
        Self { rows, pixel_mm: [along.step_mm(), across.step_mm()] }
    }

    /// Returns the extent of the aperture across the lines, widened by the overscan on both sides, mm.
    pub fn across(&self, overscan_mm: f64) -> Interval {
        let first = self.rows[0].0;
        let last = self.rows[self.rows.len() - 1].0;
        Interval { low: first - overscan_mm, high: last + overscan_mm }
    }

    /// Returns the extent of the aperture along the lines, widened by the overscan on both sides, mm.
    pub fn along(&self, overscan_mm: f64) -> Interval {
        let runs = self.rows.iter().flat_map(|(_, runs)| runs);
        Interval {
            low: runs.clone().map(|i| i.low).fold(f64::MAX, f64::min) - overscan_mm,
            high: runs.map(|i| i.high).fold(f64::MIN, f64::max) + overscan_mm,
        }
    }

    /// Returns the intervals of a line in the region: the runs `[u_first - o, u_last + o]` of the pixel rows with
    /// coordinates `low_mm <= w <= high_mm`, joined if they are at most `bridge_mm` apart; ascending.
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

/// Joins the intervals that are at most `bridge_mm` apart; the result is ascending.
pub(crate) fn join(mut all: Vec<Interval>, bridge_mm: f64) -> Vec<Interval> {
    all.sort_unstable_by(|a, b| a.low.total_cmp(&b.low).then_with(|| a.high.total_cmp(&b.high)));
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

/// Largest length that a setting may have, mm; a longer one is refused. Larger: mistakes in the units pass. Smaller:
/// paths that are allowed are refused. No point of a path may lie farther from the origin.
const LONGEST_MM: f64 = 1e7;

/// Refuses `mm` unless it is a finite length > 0 (>= 0 if `zero` is true) of at most 1e7 mm; `name` is the setting in
/// the message.
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

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use planish_types::Grid;

    use super::*;

    #[test]
    fn an_inset_disk_is_a_smaller_disk() {
        for [x, y] in [[0.25, 0.25], [0.5, 0.2]] {
            let axis = |step: f64| {
                let half = (12.0 / step).round();
                Axis::new(-step * half, step, 2 * half as usize + 1).unwrap()
            };
            let grid = Grid { x: axis(x), y: axis(y) };
            let radius =
                |(r, c): (usize, usize)| grid.x.coordinate_mm(c).hypot(grid.y.coordinate_mm(r));
            let disk = Array2::from_shape_fn(grid.shape(), |at| {
                if radius(at) <= 10.0 { 1.0 } else { f64::NAN }
            });
            let left = inset(&Surface::new(grid, disk).unwrap(), 3.0).unwrap();
            // The centres at the edge lie up to a pixel inside of it, so the kept disk is exact to a pixel.
            for (at, v) in left.height_nm().indexed_iter() {
                let beyond_mm = radius(at) - 7.0;
                assert!(v.is_nan() || beyond_mm <= x.max(y), "{beyond_mm}");
                assert!(!v.is_nan() || beyond_mm >= -x.max(y), "{beyond_mm}");
            }
        }
    }

    #[test]
    fn an_inset_that_leaves_nothing_is_refused() {
        let axis = |n| Axis::new(0.0, 1.0, n).unwrap();
        let grid = Grid { x: axis(9), y: axis(5) };
        let surface = Surface::new(grid, Array2::zeros(grid.shape())).unwrap();
        // The part is 5 mm high: at 2.5 mm its middle row is left but for two pixels at each end, beyond it nothing.
        let left = inset(&surface, 2.5).unwrap();
        assert_eq!(left.height_nm().iter().filter(|v| !v.is_nan()).count(), 5);
        assert!(inset(&surface, 2.6).is_err());
        assert!(inset(&surface, f64::INFINITY).is_err());
    }

    /// Makes a TIF with the rates `rate(x, y)` within `half` mm around 0, in samples of 0.25 mm.
    fn tif(half: f64, rate: impl Fn(f64, f64) -> f64) -> Tif {
        let n = (8.0 * half) as usize + 1;
        let axis = Axis::new(-half, 0.25, n).unwrap();
        let rates = Array2::from_shape_fn((n, n), |(r, c)| {
            rate(axis.coordinate_mm(c), axis.coordinate_mm(r))
        });
        Tif::new(Grid { x: axis, y: axis }, rates).unwrap()
    }

    #[test]
    fn the_overscan_is_that_of_the_tool_and_not_of_its_array() {
        let flat = |x: f64, y: f64| if x.abs().max(y.abs()) <= 2.0 { 5.0 } else { 0.0 };
        for half in [2.0, 4.0, 12.0] {
            assert_eq!(usual_overscan_mm(&tif(half, flat), [0.0; 2]), 2.0, "{half}");
        }
        // Around the place where it removes.
        let beside = tif(6.0, |x, y| flat(x - 1.0, y));
        assert_eq!(usual_overscan_mm(&beside, [1.0, 0.0]), 2.0);
        assert_eq!(usual_overscan_mm(&beside, [0.0; 2]), 3.0);
        // A tool that its samples cut off goes to their end.
        let gaussian = |x: f64, y: f64| (-0.5 * (x * x + y * y)).exp();
        assert_eq!(usual_overscan_mm(&tif(3.0, gaussian), [0.0; 2]), 3.0);
        // Beyond o a fraction of 4 Q(o) of a Gaussian of 1 mm is left, with the samples half a pitch wide: 7e-4 beyond
        // 3.625 mm, 2e-4 beyond 3.875 mm.
        assert_eq!(usual_overscan_mm(&tif(12.0, gaussian), [0.0; 2]), 3.75);
    }
}
