//! Height maps for the report page: down-sampled if they are large, with the histogram of all pixels.

use ndarray::{Array2, ArrayView2};
use planish_numerics::statistics::statistics;
use planish_types::Grid;
use serde::Serialize;

use super::pack::{Packed, pack};

/// A map for the report page, with numbers of the map (the array) from which it was made.
#[derive(Clone, Debug, Serialize)]
pub struct ScreenMap {
    /// Coordinates of the centre of the first column and row, mm.
    pub start_mm: [f64; 2],
    /// Distances between neighbouring columns and between neighbouring rows, mm.
    pub step_mm: [f64; 2],
    /// Numbers of columns and rows.
    pub size: [usize; 2],
    /// Side, in pixels of the array, of the square block whose mean is one pixel of this map.
    pub every: usize,
    /// Mean of the valid pixels of the array, nm.
    pub mean_nm: f64,
    /// RMS of the valid pixels of the array about their mean, nm.
    pub rms_nm: f64,
    /// Smallest and largest height of the array, nm.
    pub range_nm: [f64; 2],
    /// Distance from the mean that 99 % of the valid pixels of the array do not exceed, nm. If that is 0, it is
    /// the largest distance, and 1 nm for a flat map.
    pub reach_99_nm: f64,
    /// Heights of the pixels of this map (means over blocks), shape (ny, nx), nm, as packed text for the page.
    pub height_nm: Packed,
    /// The same heights as numbers, shape (ny, nx), nm; NaN for a block without valid pixels.
    #[serde(skip)]
    pub means_nm: Array2<f64>,
}

/// Returns the smallest side, in pixels, of a square block that reduces `grid` to at most `most` blocks; `most` counts
/// as 4 if it is smaller.
pub(crate) fn block_side(grid: &Grid, most: usize) -> usize {
    (1..)
        .find(|k| grid.x.len().div_ceil(*k) * grid.y.len().div_ceil(*k) <= most.max(4))
        .expect("a large block leaves one pixel")
}

/// Returns `map` (nm, on `grid`) reduced to means over blocks of `every` x `every` pixels.
pub(crate) fn screen_map(map: ArrayView2<f64>, grid: &Grid, every: usize) -> ScreenMap {
    let means = block_means(map, every);
    let axes = [&grid.x, &grid.y];
    let s = statistics(map).expect("a map has a valid pixel");
    ScreenMap {
        start_mm: axes.map(|a| a.start_mm() + 0.5 * (every - 1) as f64 * a.step_mm()),
        step_mm: axes.map(|a| a.step_mm() * every as f64),
        size: [means.ncols(), means.nrows()],
        every,
        mean_nm: s.mean,
        rms_nm: s.rms,
        range_nm: [s.min, s.max],
        reach_99_nm: reach_99(map, s.mean),
        height_nm: pack(means.iter().copied()),
        means_nm: means,
    }
}

/// Returns the distance from `mean` that 99 % of the valid pixels do not exceed, nm, so that one pit does not decide
/// the colours. If it is 0, it returns the largest distance, and 1 nm for a flat map.
fn reach_99(map: ArrayView2<f64>, mean: f64) -> f64 {
    let valid = map.iter().filter(|v| !v.is_nan());
    let mut sizes: Vec<f64> = valid.map(|v| (v - mean).abs()).collect();
    let index = (0.99 * (sizes.len() - 1) as f64) as usize;
    let (_, reach, beyond) = sizes.select_nth_unstable_by(index, f64::total_cmp);
    let largest = beyond.iter().fold(*reach, |m, v| m.max(*v));
    [*reach, largest].into_iter().find(|v| *v > 0.0).unwrap_or(1.0)
}

/// Returns the means of the valid pixels of blocks of `every` x `every` pixels; NaN for a block without any. The last
/// blocks may be smaller.
pub fn block_means(map: ArrayView2<f64>, every: usize) -> Array2<f64> {
    if every == 1 {
        return map.to_owned();
    }
    let (ny, nx) = map.dim();
    let shape = (ny.div_ceil(every), nx.div_ceil(every));
    let mut sum = Array2::zeros(shape);
    let mut count = Array2::<f64>::zeros(shape);
    for ((r, c), v) in map.indexed_iter().filter(|(_, v)| !v.is_nan()) {
        sum[[r / every, c / every]] += v;
        count[[r / every, c / every]] += 1.0;
    }
    // 0 / 0 is NaN.
    sum / count
}

/// Histogram of the heights of a map about their mean, in bins of equal width.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Histogram {
    /// Lower edge of the first bin, nm from the mean.
    pub low_nm: f64,
    /// Width of the bins, nm.
    pub width_nm: f64,
    /// Fraction of the valid pixels in each bin, divided by its width, 1/nm.
    pub density_per_nm: Vec<f64>,
    /// Fraction of the valid pixels whose height is beyond the bins.
    pub outside: f64,
}

const BINS: usize = 101;

/// Half of the range of a histogram, in units of the RMS of the map. Larger: coarser bins. Smaller: more pixels
/// beyond the bins. Chosen: a Gaussian has 6e-5 of its pixels beyond it.
const REACH_RMS: f64 = 4.0;

/// Returns the histogram of a map, from four RMS below the mean to four RMS above it; for a flat map, from 1e-6 nm
/// below to 1e-6 nm above.
pub fn histogram(map: ArrayView2<f64>) -> Histogram {
    let s = statistics(map).expect("a map has a valid pixel");
    // A map that is flat but for rounding gets bins of some width all the same.
    let flat = s.rms <= 1e-12 * s.min.abs().max(s.max.abs());
    let reach = if flat { 1e-6 } else { REACH_RMS * s.rms };
    let width_nm = 2.0 * reach / BINS as f64;
    let mut counts = vec![0_usize; BINS];
    let mut outside = 0_usize;
    for v in map.iter().filter(|v| !v.is_nan()) {
        let bin = ((v - s.mean + reach) / width_nm).floor();
        if bin >= 0.0 && bin < BINS as f64 { counts[bin as usize] += 1 } else { outside += 1 }
    }
    let n = s.valid_count as f64;
    Histogram {
        low_nm: -reach,
        width_nm,
        density_per_nm: counts.iter().map(|c| *c as f64 / n / width_nm).collect(),
        outside: outside as f64 / n,
    }
}

#[cfg(test)]
mod tests {
    use ndarray::array;
    use planish_types::Axis;

    use super::*;

    const NAN: f64 = f64::NAN;

    #[test]
    fn blocks_are_means_of_their_valid_pixels_and_their_centres() {
        let map = array![[1.0, 3.0, 5.0], [5.0, NAN, 7.0], [NAN, NAN, 9.0]];
        let means = block_means(map.view(), 2);
        assert!(means[[1, 0]].is_nan());
        assert_eq!([means[[0, 0]], means[[0, 1]], means[[1, 1]]], [3.0, 6.0, 9.0]);
        let axis = Axis::new(10.0, 0.5, 3).unwrap();
        let screen = screen_map(map.view(), &Grid { x: axis, y: axis }, 2);
        assert_eq!((screen.start_mm, screen.step_mm), ([10.25; 2], [1.0; 2]));
        assert_eq!((screen.size, screen.range_nm, screen.mean_nm), ([2, 2], [1.0, 9.0], 5.0));
        let grid = Grid { x: Axis::new(0.0, 1.0, 1641).unwrap(), y: axis };
        assert_eq!(block_side(&grid, 1641 * 3), 1);
        assert_eq!([block_side(&grid, 1642), block_side(&grid, 1641)], [2, 3]);
    }

    #[test]
    fn a_pit_does_not_decide_the_scale() {
        // 2 % at 1 nm, one pixel at 100 nm, the others at 0: the mean is taken for 0 by hand.
        let map = Array2::from_shape_fn((10, 100), |(r, c)| match (r, c) {
            (0, 0) => 100.0,
            (_, c) if c < 2 => 1.0,
            _ => 0.0,
        });
        assert_eq!(reach_99(map.view(), 0.0), 1.0);
        let mut pit = Array2::zeros((10, 100));
        pit[[3, 3]] = -7.0;
        assert_eq!(reach_99(pit.view(), 0.0), 7.0);
        assert_eq!(reach_99(Array2::zeros((2, 2)).view(), 0.0), 1.0);
    }

    #[test]
    fn a_histogram_has_all_pixels() {
        let map =
            Array2::from_shape_fn(
                (10, 100),
                |(r, c)| if r == 0 && c == 0 { 1e4 } else { (c % 10) as f64 },
            );
        let h = histogram(map.view());
        let inside: f64 = h.density_per_nm.iter().sum::<f64>() * h.width_nm;
        assert!((inside + h.outside - 1.0).abs() < 1e-12);
        assert_eq!(h.outside, 0.001);
        assert!(histogram(array![[2.0, 2.0]].view()).density_per_nm[50] > 0.0);
    }
}
