//! Ordinary least squares with few parameters, and the standard errors of these.
//!
//! ```text
//! z_i = sum_k p_k a_ik + noise of one variance,   p = (A'A)^-1 A'z,   covariance s^2 (A'A)^-1
//! ```

/// Smallest pivot in the elimination of the normal matrix A'A, scaled to a diagonal of ones. Larger: columns that
/// differ little are refused. Smaller: rounding decides the parameters.
const LEAST_PIVOT: f64 = 1e-10;

/// Result of a least-squares fit with N parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Regression<const N: usize> {
    /// Parameters p of the module.
    pub parameters: [f64; N],
    /// Standard error of every parameter, in the unit of the parameter.
    pub standard_errors: [f64; N],
}

/// Fits samples, each a row of the matrix A and its value z. Returns `None` if they do not determine the parameters.
pub(crate) fn regression<const N: usize>(samples: &[([f64; N], f64)]) -> Option<Regression<N>> {
    let mut squares = [0.0; N];
    for (row, _) in samples {
        squares.iter_mut().zip(row).for_each(|(sum, a)| *sum += a * a);
    }
    let scale = squares.map(|square: f64| square.sqrt().recip());
    let mut normal = [[0.0; N]; N];
    let mut right = [0.0; N];
    for (row, z) in samples {
        for i in 0..N {
            right[i] += scale[i] * row[i] * z;
            for j in 0..N {
                normal[i][j] += scale[i] * row[i] * scale[j] * row[j];
            }
        }
    }
    let inverse = inverse(normal)?;
    if samples.len() <= N {
        return None;
    }
    let parameters: [f64; N] =
        std::array::from_fn(|k| (0..N).map(|j| inverse[k][j] * right[j]).sum::<f64>() * scale[k]);
    let mut squares = 0.0;
    for (row, z) in samples {
        let fitted: f64 = row.iter().zip(&parameters).map(|(a, p)| a * p).sum();
        squares += (z - fitted).powi(2);
    }
    let variance = squares / (samples.len() - N) as f64;
    let standard_errors = std::array::from_fn(|k| (variance * inverse[k][k]).sqrt() * scale[k]);
    Some(Regression { parameters, standard_errors })
}

/// Returns the inverse of a positive definite matrix with a diagonal of ones, by Gauss-Jordan elimination; `None` if a
/// pivot is too small.
fn inverse<const N: usize>(mut a: [[f64; N]; N]) -> Option<[[f64; N]; N]> {
    let mut inverse = [[0.0; N]; N];
    (0..N).for_each(|k| inverse[k][k] = 1.0);
    for k in 0..N {
        let pivot = a[k][k];
        // A column of zeros has no scale.
        if pivot.is_nan() || pivot < LEAST_PIVOT {
            return None;
        }
        for j in 0..N {
            a[k][j] /= pivot;
            inverse[k][j] /= pivot;
        }
        for i in (0..N).filter(|i| *i != k) {
            let factor = a[i][k];
            for j in 0..N {
                a[i][j] -= factor * a[k][j];
                inverse[i][j] -= factor * inverse[k][j];
            }
        }
    }
    Some(inverse)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_the_closed_form_and_its_standard_errors() {
        // z = 3 - 2 x with errors of +-1 that are orthogonal to 1 and x.
        let errors = [1.0, -1.0, -1.0, 1.0];
        let of = |i: usize| ([1.0, i as f64], 3.0 - 2.0 * i as f64 + errors[i]);
        let samples: Vec<_> = (0..4).map(of).collect();
        let Regression { parameters, standard_errors } = regression(&samples).unwrap();
        // s^2 = 4 / 2; A'A = [4 6; 6 14], its inverse [14 -6; -6 4] / 20. Below: rounding.
        for (k, (p, e)) in [(3.0, 1.4_f64.sqrt()), (-2.0, 0.4_f64.sqrt())].into_iter().enumerate() {
            assert!((parameters[k] - p).abs() < 1e-13 && (standard_errors[k] - e).abs() < 1e-13);
        }
    }

    #[test]
    fn columns_that_are_one_and_too_few_samples_determine_nothing() {
        let same: Vec<_> = (0..5).map(|i| ([1.0, 2.0], f64::from(i))).collect();
        assert_eq!(regression(&same), None);
        assert_eq!(regression(&[([1.0, 0.0], 1.0), ([0.0, 1.0], 2.0)]), None);
        assert_eq!(regression(&[([0.0], 1.0), ([0.0], 2.0)]), None);
    }
}
