//! Binning: the mean of the pixels of every square becomes one pixel.
//!
//! A map of fewer pixels is faster to plan. The squares hide what is shorter than they are. Within a square, the figure
//! of a part is nearly a plane, which a tool that is wider than the square removes. The rest of it stays:
//!
//! ```text
//! W^2 = mean over the squares of (n - 1) / (n - 3) * mean of (z - p)^2 over the square                                (1)
//! ```
//!
//! With the factor, W^2 and the mean square of the binned map together are the variance of white noise.
//!
//! | symbol | variable | unit | source |
//! |---|---|---|---|
//! | `z` | `height_nm` | nm | the map |
//! | `p` | | nm | least-squares plane through the square |
//! | `n` | `count` | 1 | number of pixels of the square |
//! | `W` | `within_rms_nm` | nm | |

use ndarray::{Array2, ArrayView2, s};
use planish_types::{Axis, Grid, Invalid, Surface};
use serde::Serialize;

/// A binned map, and what it hides.
#[derive(Clone, Debug)]
pub struct Binned {
    /// Map of the means, smallest coordinates first.
    pub surface: Surface,
    /// Numbers of the binning.
    pub report: BinningReport,
}

/// Numbers of a binning.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BinningReport {
    /// Side of the squares, pixels of the map before.
    pub square_px: usize,
    /// W of (1), nm: the part of the map that is shorter than the squares. Squares with an invalid pixel do not count.
    pub within_rms_nm: f64,
    /// Valid pixels of the map before.
    pub valid_pixels: usize,
    /// Valid pixels of the map before in squares that are invalid, because less than half of the square is valid.
    pub left_out_pixels: usize,
}

/// Returns the map whose pixels are the means of squares of `square_px` pixels. A square is valid if at least half of
/// its pixels are; those that the map ends in count as whole squares. A standard deviation becomes that of the mean of
/// independent pixels.
///
/// # Errors
/// Refuses squares of no pixel, and squares that leave fewer than two rows or columns or no valid pixel.
pub fn bin(surface: &Surface, square_px: usize) -> Result<Binned, Invalid> {
    let (rows, columns) = surface.grid().shape();
    if square_px == 0 || rows.div_ceil(square_px) < 2 || columns.div_ceil(square_px) < 2 {
        let problem = format!("is {square_px} for a map of {columns} x {rows} px");
        let remedy = "give at least 1, and leave two squares along each axis";
        return Err(Invalid::whole("square_px", problem, remedy));
    }
    let shape = (rows.div_ceil(square_px), columns.div_ceil(square_px));
    let least_count = (square_px * square_px).div_ceil(2);
    let mut means = Array2::from_elem(shape, f64::NAN);
    let mut deviations = Array2::from_elem(shape, f64::NAN);
    let (mut within, mut whole_squares) = (0.0, 0_usize);
    let (mut used, mut valid_pixels) = (0, 0);
    for ((row, column), mean) in means.indexed_iter_mut() {
        let [first_row, first_column] = [row, column].map(|k| k * square_px);
        let square = s![
            first_row..rows.min(first_row + square_px),
            first_column..columns.min(first_column + square_px)
        ];
        let heights = surface.height_nm().slice(square);
        let valid: Vec<f64> = heights.iter().copied().filter(|z| !z.is_nan()).collect();
        let count = valid.len();
        valid_pixels += count;
        if count < least_count {
            continue;
        }
        *mean = valid.iter().sum::<f64>() / count as f64;
        used += count;
        if count == square_px * square_px {
            within += within_square_nm2(heights, *mean);
            whole_squares += 1;
        }
        if let Some(deviation) = surface.deviation_nm() {
            let squares: f64 =
                deviation.slice(square).iter().filter(|s| !s.is_nan()).map(|s| s * s).sum();
            deviations[[row, column]] = squares.sqrt() / count as f64;
        }
    }
    let grid = Grid {
        x: binned_axis(&surface.grid().x, square_px)?,
        y: binned_axis(&surface.grid().y, square_px)?,
    };
    let mut binned = Surface::new(grid, means)?;
    if surface.deviation_nm().is_some() {
        binned = binned.with_deviation(deviations)?;
    }
    let report = BinningReport {
        square_px,
        within_rms_nm: (within / whole_squares.max(1) as f64).sqrt(),
        valid_pixels,
        left_out_pixels: valid_pixels - used,
    };
    Ok(Binned { surface: binned, report })
}

/// Returns the term of (1) for a square of valid `heights` (n, n), nm, with their mean. A square of one pixel hides
/// nothing.
fn within_square_nm2(heights: ArrayView2<f64>, mean: f64) -> f64 {
    let side = heights.nrows();
    if side == 1 {
        return 0.0;
    }
    let middle = 0.5 * (side - 1) as f64;
    let (mut square, mut along_x, mut along_y) = (0.0, 0.0, 0.0);
    for ((row, column), z) in heights.indexed_iter() {
        square += (z - mean).powi(2);
        along_x += (column as f64 - middle) * (z - mean);
        along_y += (row as f64 - middle) * (z - mean);
    }
    // Offsets from the middle along x and y are orthogonal, so that the plane is two slopes:
    // sum (z - p)^2 = sum (z - mean)^2 - ((sum x z)^2 + (sum y z)^2) / sum x^2
    let n = (side * side) as f64;
    let offsets = n * (n - 1.0) / 12.0;
    let rest = (square - (along_x * along_x + along_y * along_y) / offsets).max(0.0);
    (n - 1.0) / (n - 3.0) * rest / n
}

/// Returns the axis of the middles of `square_px` pixels each; the last may be beyond the end of `axis`.
fn binned_axis(axis: &Axis, square_px: usize) -> Result<Axis, Invalid> {
    let middle_mm = axis.start_mm() + 0.5 * (square_px - 1) as f64 * axis.step_mm();
    Axis::new(middle_mm, square_px as f64 * axis.step_mm(), axis.len().div_ceil(square_px))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(rows: usize, columns: usize) -> Surface {
        let grid = Grid {
            x: Axis::new(-3.0, 0.5, columns).unwrap(),
            y: Axis::new(2.0, 0.25, rows).unwrap(),
        };
        let heights =
            Array2::from_shape_fn((rows, columns), |(r, c)| ((7 * r + 3 * c * c) % 11) as f64);
        Surface::new(grid, heights).unwrap()
    }

    #[test]
    fn a_pixel_is_the_mean_of_its_square_at_its_middle() {
        let surface = map(6, 9);
        let Binned { surface: binned, report } = bin(&surface, 3).unwrap();
        assert_eq!(binned.grid().shape(), (2, 3));
        let first: f64 = surface.height_nm().slice(s![0..3, 0..3]).iter().sum();
        assert!((binned.height_nm()[[0, 0]] - first / 9.0).abs() < 1e-12);
        // The middle of the first square is its second pixel.
        assert!((binned.grid().x.start_mm() - -2.5).abs() < 1e-12);
        assert!((binned.grid().y.step_mm() - 0.75).abs() < 1e-12);
        assert_eq!(report.left_out_pixels, 0);
    }

    #[test]
    fn a_plane_is_not_hidden_and_white_noise_keeps_its_variance() {
        let shape = (400, 400);
        let grid = *map(shape.0, shape.1).grid();
        let plane = Array2::from_shape_fn(shape, |(r, c)| 3.0 * c as f64 - 2.0 * r as f64);
        let hidden = bin(&Surface::new(grid, plane.clone()).unwrap(), 5).unwrap().report;
        assert!(hidden.within_rms_nm < 1e-9, "{hidden:?}");
        // Uniform noise of the variance 1 / 12, from Knuth's linear congruence.
        let mut state = 68_u64;
        let noise = Array2::from_shape_simple_fn(shape, || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        });
        for square_px in [2, 3, 5] {
            let Binned { surface, report } =
                bin(&Surface::new(grid, noise.clone()).unwrap(), square_px).unwrap();
            let variance = surface.statistics().rms.powi(2) + report.within_rms_nm.powi(2);
            // 160 000 samples know their variance within 0.3 %; of squares of four pixels one number remains.
            assert!((variance * 12.0 - 1.0).abs() < 0.02, "{square_px}: {variance}");
        }
    }

    #[test]
    fn a_square_counts_if_half_of_it_is_valid() {
        let surface = map(4, 5);
        let mut heights = surface.height_nm().clone();
        heights.slice_mut(s![0..2, 0]).fill(f64::NAN);
        heights[[2, 2]] = f64::NAN;
        heights[[2, 3]] = f64::NAN;
        heights[[3, 3]] = f64::NAN;
        let Binned { surface: binned, report } =
            bin(&Surface::new(*surface.grid(), heights).unwrap(), 2).unwrap();
        // Two of four pixels are enough, one is not; the column that the map ends in is half a square.
        let valid: Vec<bool> = binned.height_nm().iter().map(|z| !z.is_nan()).collect();
        assert_eq!(valid, [true, true, true, true, false, true]);
        assert_eq!((report.valid_pixels, report.left_out_pixels), (15, 1));
        assert!(bin(&surface, 0).is_err());
        assert!(bin(&surface, 4).is_err());
    }

    #[test]
    fn the_deviation_of_a_mean_of_four_is_half() {
        let surface = map(4, 4).with_deviation(Array2::from_elem((4, 4), 0.6)).unwrap();
        let binned = bin(&surface, 2).unwrap().surface;
        assert!(binned.deviation_nm().unwrap().iter().all(|s| (s - 0.3).abs() < 1e-12));
    }
}
