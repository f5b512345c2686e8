//! The discrete Fourier transform of a map, of any size.
//!
//! ```text
//! F[k, l] = sum_(r, c) z[r, c] exp(-2 pi i (k r / ny + l c / nx))
//! ```
//!
//! Rows and columns are independent transforms, so the result does not depend on the number of
//! threads. For convolutions see [`super::convolution`].

use ndarray::{Array2, ArrayView2};
use rustfft::{FftDirection, FftPlanner};

use super::Complex64;

use crate::parallel;

/// Returns the discrete Fourier transform F (ny, nx) of a real map; element [0, 0] is the sum of the map.
pub fn forward(map: ArrayView2<f64>) -> Array2<Complex64> {
    transform(map.mapv(|v| Complex64::new(v, 0.0)), FftDirection::Forward)
}

/// Returns the real part of the inverse transform (ny, nx) of a spectrum: `inverse(forward(z)) = z`.
pub fn inverse(spectrum: Array2<Complex64>) -> Array2<f64> {
    let scale = 1.0 / spectrum.len() as f64;
    transform(spectrum, FftDirection::Inverse).mapv(|v| v.re * scale)
}

/// Returns the frequency of element `k` of `n`, in cycles per sample: `k / n` up to n/2, and `(k - n) / n`
/// above.
pub fn frequency(k: usize, n: usize) -> f64 {
    let signed = if 2 * k <= n { k as f64 } else { k as f64 - n as f64 };
    signed / n as f64
}

/// Transforms the rows and the columns of an array, without a scale.
fn transform(mut field: Array2<Complex64>, direction: FftDirection) -> Array2<Complex64> {
    let mut planner = FftPlanner::new();
    for _axis in 0..2 {
        let plan = planner.plan_fft(field.ncols(), direction);
        parallel::consume_with(
            field.outer_iter_mut(),
            &|| vec![Complex64::default(); plan.get_inplace_scratch_len()],
            &|scratch, _, mut row| {
                let row = row.as_slice_mut().expect("rows are contiguous");
                plan.process_with_scratch(row, scratch);
            },
        );
        field = field.reversed_axes().as_standard_layout().into_owned();
    }
    field
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn a_wave_has_its_two_lines_and_the_inverse_gives_it_back() {
        let (ny, nx) = (12, 15);
        let z = Array2::from_shape_fn((ny, nx), |(r, c)| {
            3.0 + 2.0 * (2.0 * PI * (2.0 * r as f64 / ny as f64 - 4.0 * c as f64 / nx as f64)).cos()
        });
        let spectrum = forward(z.view());
        for ((k, l), v) in spectrum.indexed_iter() {
            let want = match (k, l) {
                (0, 0) => 3.0 * 180.0,
                (2, 11) | (10, 4) => 180.0,
                _ => 0.0,
            };
            // Sums of 180 terms of order 5.
            assert!((v.re - want).abs() < 1e-11 && v.im.abs() < 1e-11, "{k} {l} {v}");
        }
        let back = inverse(spectrum);
        // Rounding of the sums above, divided by 180.
        assert!((&back - &z).iter().all(|e| e.abs() < 1e-13));
        assert_eq!([0, 7, 8, 14].map(|k| frequency(k, 15) * 15.0), [0.0, 7.0, -7.0, -1.0]);
        assert_eq!(frequency(6, 12), 0.5);
    }
}
