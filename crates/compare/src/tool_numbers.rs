//! Numbers of a tool that is the same everywhere: its peak, its widths along two sections, and its volume rate.
//!
//! ```text
//! sections   R(x, y_peak) and R(x_peak, y), through the sample of the largest rate
//! width      distance of the two nearest places along a section, one to each side, at which R = R_peak / 2
//! ```
//!
//! Between its samples the TIF is Keys' cubic convolution. A Gaussian of standard deviation sigma has the width 2.355
//! sigma.

use planish_types::{Axis, Tif};
use serde::Serialize;

/// Halvings of a step of the TIF that find the place of half the peak. Larger: no more digits. Smaller: fewer digits.
/// Derived: a step times 2^-50 is below the rounding of the place.
const HALVINGS: usize = 50;

/// Numbers of a tool that is the same everywhere.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ToolNumbers {
    /// Largest sample of the removal rate, nm/s.
    pub peak_nm_per_s: f64,
    /// Place [x, y] of that sample, from the position of the tool, mm.
    pub peak_mm: [f64; 2],
    /// Width at half of the peak along [x, y], through the peak, mm; `null` if the samples end before.
    pub half_maximum_width_mm: [Option<f64>; 2],
    /// Removed volume per second, the integral of the TIF, nm mm^2/s.
    pub volume_rate_nm_mm2_per_s: f64,
}

impl ToolNumbers {
    /// Returns the numbers of a tool; `None` for one that varies over the part or in time.
    pub fn new(tif: &Tif) -> Option<Self> {
        if tif.variation().is_some() {
            return None;
        }
        let grid = tif.grid();
        let mut peak = (0, 0);
        for (index, rate) in tif.rate_nm_per_s().indexed_iter() {
            if *rate > tif.rate_nm_per_s()[peak] {
                peak = index;
            }
        }
        let (row, column) = peak;
        let width = |axis| half_maximum_width_mm(tif, [column, row], axis);
        Some(Self {
            peak_nm_per_s: tif.rate_nm_per_s()[peak],
            peak_mm: [grid.x.coordinate_mm(column), grid.y.coordinate_mm(row)],
            half_maximum_width_mm: [width(0), width(1)],
            volume_rate_nm_mm2_per_s: tif.vrr_nm_mm2_per_s(),
        })
    }
}

/// Returns the width at half of the peak along x (`axis` 0) or y (1), mm; `None` if the samples end before. `peak` is
/// the index [column, row] of the peak.
fn half_maximum_width_mm(tif: &Tif, peak: [usize; 2], axis: usize) -> Option<f64> {
    let samples = axis_of(tif, axis);
    let before: Vec<usize> = (0..=peak[axis]).rev().collect();
    let after: Vec<usize> = (peak[axis]..samples.len()).collect();
    Some(half_maximum_mm(tif, peak, axis, &after)? - half_maximum_mm(tif, peak, axis, &before)?)
}

/// Returns the first place along `indices`, which go away from the peak, where the section is at half of the peak, mm.
fn half_maximum_mm(tif: &Tif, peak: [usize; 2], axis: usize, indices: &[usize]) -> Option<f64> {
    let half = 0.5 * section_at(tif, peak, axis, axis_of(tif, axis).coordinate_mm(peak[axis]));
    let places = indices.iter().map(|i| axis_of(tif, axis).coordinate_mm(*i));
    let mut inside = axis_of(tif, axis).coordinate_mm(peak[axis]);
    for outside in places {
        if section_at(tif, peak, axis, outside) < half {
            return Some(between(tif, peak, axis, [inside, outside], half));
        }
        inside = outside;
    }
    None
}

/// Returns the place between two samples where the section is `half`, by bisection, mm.
fn between(
    tif: &Tif,
    peak: [usize; 2],
    axis: usize,
    [mut inside, mut outside]: [f64; 2],
    half: f64,
) -> f64 {
    for _ in 0..HALVINGS {
        let middle = 0.5 * (inside + outside);
        if section_at(tif, peak, axis, middle) < half {
            outside = middle;
        } else {
            inside = middle;
        }
    }
    0.5 * (inside + outside)
}

/// Returns the rate at a place along the section through the peak, nm/s.
fn section_at(tif: &Tif, [column, row]: [usize; 2], axis: usize, place_mm: f64) -> f64 {
    let grid = tif.grid();
    match axis {
        0 => tif.rate_at(place_mm, grid.y.coordinate_mm(row)),
        _ => tif.rate_at(grid.x.coordinate_mm(column), place_mm),
    }
}

fn axis_of(tif: &Tif, axis: usize) -> &Axis {
    [&tif.grid().x, &tif.grid().y][axis]
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use planish_types::Grid;

    fn gaussian(sigma_mm: [f64; 2], half_mm: f64, step_mm: f64) -> Tif {
        let n = 2 * (half_mm / step_mm).round() as usize + 1;
        let axis = Axis::new(-half_mm, step_mm, n).unwrap();
        let grid = Grid { x: axis, y: axis };
        let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let [u, v] = [axis.coordinate_mm(c) / sigma_mm[0], axis.coordinate_mm(r) / sigma_mm[1]];
            8.0 * (-0.5 * (u * u + v * v)).exp()
        });
        Tif::new(grid, rate).unwrap()
    }

    #[test]
    fn a_gaussian_has_its_width_and_its_volume() {
        let factor = 2.0 * (2.0 * 2.0_f64.ln()).sqrt();
        let mut errors = Vec::new();
        for step_mm in [0.4, 0.2, 0.1] {
            let numbers = ToolNumbers::new(&gaussian([2.0, 1.0], 10.0, step_mm)).unwrap();
            assert_eq!((numbers.peak_nm_per_s, numbers.peak_mm), (8.0, [0.0, 0.0]));
            let [x, y] = numbers.half_maximum_width_mm.map(Option::unwrap);
            errors.push((x / (2.0 * factor) - 1.0).abs() + (y / factor - 1.0).abs());
            // The trapezoidal rule of a Gaussian that has 2.5 samples per sigma or more: below rounding.
            let volume = 2.0 * std::f64::consts::PI * 8.0 * 2.0;
            assert!((numbers.volume_rate_nm_mm2_per_s / volume - 1.0).abs() < 1e-6);
        }
        // Keys' interpolation is of third order: a step of half the size has an eighth of the error, or less. The place
        // of half the peak within its cell moves, so the second halving alone is not compared.
        assert!(errors[0] < 5e-3 && errors[2] < errors[0] / 16.0, "{errors:?}");
    }

    #[test]
    fn a_section_that_ends_above_half_of_the_peak_has_no_width() {
        let numbers = ToolNumbers::new(&gaussian([9.0, 1.0], 8.0, 0.5)).unwrap();
        assert_eq!(numbers.half_maximum_width_mm[0], None);
        assert!(numbers.half_maximum_width_mm[1].is_some());
    }
}
