//! Binning: the mean of the pixels of every square becomes one pixel.
//!
//! A map of fewer pixels is faster to plan. The squares hide what is shorter than they are. Its part of the mean square
//! is known, because the sum of squares splits exactly into that between the squares and that within them:
//!
//! ```text
//! sum (z - Z)^2 = sum over squares of n_k (z_k - Z)^2 + sum over squares of sum (z - z_k)^2                          (1)
//! ```
//!
//! | symbol | variable | unit | source |
//! |---|---|---|---|
//! | `z` | `height_nm` | nm | the map |
//! | `z_k` | `mean` | nm | mean of the valid pixels of the square k |
//! | `n_k` | `count` | 1 | number of its valid pixels |
//! | `Z` | | nm | mean of the map |

use ndarray::{Array2, s};
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
    /// RMS of the heights about the means of their squares, nm: the part of the map that is shorter than the squares.
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
    let (mut within, mut used, mut valid_pixels) = (0.0, 0, 0);
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
        // (1), the second sum
        within += valid.iter().map(|z| (z - *mean).powi(2)).sum::<f64>();
        used += count;
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
        within_rms_nm: (within / used as f64).sqrt(),
        valid_pixels,
        left_out_pixels: valid_pixels - used,
    };
    Ok(Binned { surface: binned, report })
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
    fn squares_and_what_they_hide_make_the_mean_square() {
        let surface = map(6, 9);
        let Binned { surface: binned, report } = bin(&surface, 3).unwrap();
        assert_eq!(binned.grid().shape(), (2, 3));
        let first: f64 = surface.height_nm().slice(s![0..3, 0..3]).iter().sum();
        assert!((binned.height_nm()[[0, 0]] - first / 9.0).abs() < 1e-12);
        // The middle of the first square is its second pixel.
        assert!((binned.grid().x.start_mm() - -2.5).abs() < 1e-12);
        assert!((binned.grid().y.step_mm() - 0.75).abs() < 1e-12);
        // (1), exact but for rounding
        let [before, after] = [&surface, &binned].map(|map| map.statistics().rms);
        assert!((before.powi(2) - after.powi(2) - report.within_rms_nm.powi(2)).abs() < 1e-10);
        assert_eq!(report.left_out_pixels, 0);
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
