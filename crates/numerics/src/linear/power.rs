//! The power method.
//!
//! ```text
//! x <- S A S x / |x|,   |x| -> largest eigenvalue of S A S
//! ```
//!
//! for a symmetric positive semidefinite A that is known by its products only, and a diagonal S.
//! Source: Golub and Van Loan, Matrix Computations, 4th ed., section 8.2.1.

/// Returns estimates of the largest eigenvalue of `S A S` with the diagonal matrix S of `scale`, one per product with
/// A. They are lower bounds that increase. The iterator ends when a product vanishes, after the estimate 0.
///
/// `product(x)` is A x. The start has no structure, so that it contains every eigenvector.
pub fn power_method(
    product: impl Fn(&[f64]) -> Vec<f64>,
    scale: &[f64],
) -> impl Iterator<Item = f64> {
    let mut x: Vec<f64> = (0..scale.len()).map(|j| 0.5 + (0.618_034 * j as f64).fract()).collect();
    let mut length = norm(&x);
    std::iter::from_fn(move || {
        if length == 0.0 {
            return None;
        }
        let scaled: Vec<f64> = scale.iter().zip(&x).map(|(s, x)| s * x / length).collect();
        x = product(&scaled);
        x.iter_mut().zip(scale).for_each(|(x, s)| *x *= s);
        length = norm(&x);
        Some(length)
    })
}

/// Returns the Euclidean norm of x.
fn norm(x: &[f64]) -> f64 {
    x.iter().map(|v| v * v).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_ascends_to_the_largest_scaled_eigenvalue() {
        // S A S has the eigenvalues 9, 4, 0.
        let apply = |x: &[f64]| vec![x[0], 4.0 * x[1], 7.0 * x[2]];
        let found: Vec<f64> = power_method(apply, &[3.0, 1.0, 0.0]).take(60).collect();
        // |S A S x| / |x| never falls for the x that the method makes; 1e-15 of 9 is rounding.
        assert!(found.windows(2).skip(1).all(|w| w[1] >= w[0] * (1.0 - 1e-15)), "{found:?}");
        // The error falls by (4/9)^2 per step.
        assert!((found[59] / 9.0 - 1.0).abs() < 1e-14, "{}", found[59]);
    }

    #[test]
    fn nothing_has_the_eigenvalue_zero() {
        assert_eq!(power_method(|x| x.to_vec(), &[0.0; 4]).collect::<Vec<_>>(), [0.0]);
        assert_eq!(power_method(|x| x.to_vec(), &[]).count(), 0);
    }
}
