//! Slopes of samples over a base length.
//!
//! ```text
//! s[i] = (z[i + k] - z[i]) / (x[i + k] - x[i]),   base length = k steps
//! a wave of amplitude a and frequency f has the slope amplitude  2 a |sin(pi f k dx)| / (k dx)
//! ```
//!
//! Between neighbouring samples (k = 1) a slope is mostly noise, and grows with every finer pitch.
//! A slope error is therefore stated with its base length. A pair with an invalid sample (NaN) has
//! no slope.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `z` | (ny, nx) | u |
//! | x | `coordinates` | (nx) or (ny) | s |
//! | k | `steps` | | samples |
//! | s | slopes | (ny, nx - k) or (ny - k, nx) | u/s |

use ndarray::{Array2, ArrayView2, Axis, Slice, Zip};

/// Direction along which a slope is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Along {
    /// Along a row, from column to column.
    X,
    /// Along a column, from row to row.
    Y,
}

impl Along {
    /// Returns the axis of an array [y, x] along this direction: 1 for X, 0 for Y.
    pub fn axis(self) -> Axis {
        match self {
            Self::X => Axis(1),
            Self::Y => Axis(0),
        }
    }
}

/// Returns the whole number of sample steps of length `step`, at least one, that is nearest to the base length `base`.
/// `None` if `n` samples have fewer steps, or if the number is not finite.
pub fn steps_of_base(base: f64, step: f64, n: usize) -> Option<usize> {
    let steps = (base / step).round().max(1.0);
    if steps.is_finite() && steps < n as f64 { Some(steps as usize) } else { None }
}

/// Returns the slopes of `z` (ny, nx) along the axis, each between two samples that are `steps` apart. `coordinates`
/// are those of the samples along this axis. The result is empty if there are no more than `steps` samples.
pub fn slopes(z: ArrayView2<f64>, coordinates: &[f64], along: Along, steps: usize) -> Array2<f64> {
    let axis = along.axis();
    let count = z.len_of(axis).saturating_sub(steps);
    let near = z.slice_axis(axis, Slice::from(..count));
    let far = z.slice_axis(axis, Slice::from(steps.min(z.len_of(axis))..));
    let mut slopes = Array2::zeros(near.dim());
    Zip::from(&mut slopes).and(&near).and(&far).for_each(|s, a, b| *s = b - a);
    for (i, mut line) in slopes.axis_iter_mut(axis).enumerate() {
        let base = coordinates[i + steps] - coordinates[i];
        line.mapv_inplace(|rise| rise / base);
    }
    slopes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::statistics::statistics;
    use std::f64::consts::PI;

    #[test]
    fn a_wave_has_the_slope_of_its_base_length_along_either_axis() {
        // 40 periods of 2.5 mm in 1000 samples of 0.1 mm; a base of a whole number of half steps keeps the RMS
        // exact only over whole periods, which 1000 - 25 samples are (39).
        let (amplitude, period, step) = (3.0, 2.5, 0.1);
        let at: Vec<f64> = (0..1000).map(|i| step * f64::from(i)).collect();
        let wave = Array2::from_shape_fn((4, 1000), |(_, c)| {
            amplitude * (2.0 * PI * at[c] / period + 0.3).sin()
        });
        let k = steps_of_base(2.5 / 4.0, step, 1000).unwrap();
        assert_eq!(k, 6);
        for k in [25, 5] {
            let want = 2.0 * amplitude * (PI * k as f64 * step / period).sin().abs()
                / (k as f64 * step)
                / 2.0_f64.sqrt();
            let whole = slopes(wave.view(), &at, Along::X, k);
            assert_eq!(whole.dim(), (4, 1000 - k));
            let found = statistics(whole.slice(ndarray::s![.., ..975])).unwrap().rms;
            // Rounding of differences of 3 over bases of 0.5.
            assert!((found - want).abs() < 1e-12, "{k} {found} {want}");
            let turned = slopes(wave.t(), &at, Along::Y, k);
            assert_eq!(turned.t(), whole);
        }
    }

    #[test]
    fn a_line_has_one_slope_whatever_the_spacing_and_nan_has_none() {
        let at = [0.0, 1.0, 3.0, 3.5, 7.0];
        let mut line = Array2::from_shape_fn((1, 5), |(_, c)| 2.0 - 0.25 * at[c]);
        assert_eq!(slopes(line.view(), &at, Along::X, 2).as_slice().unwrap(), [-0.25; 3]);
        line[[0, 1]] = f64::NAN;
        let found = slopes(line.view(), &at, Along::X, 1);
        assert!(found[[0, 0]].is_nan() && found[[0, 1]].is_nan() && found[[0, 3]] == -0.25);
        assert_eq!(slopes(line.view(), &at, Along::X, 7).dim(), (1, 0));
    }

    #[test]
    fn a_base_is_a_whole_number_of_steps_within_the_samples() {
        assert_eq!(steps_of_base(1.0, 0.12, 100), Some(8));
        assert_eq!(steps_of_base(0.01, 0.12, 100), Some(1));
        assert_eq!(steps_of_base(1.0, 0.12, 8), None);
        assert_eq!(steps_of_base(f64::NAN, 0.12, 8), Some(1));
        assert_eq!(steps_of_base(f64::INFINITY, 0.12, 8), None);
    }
}
