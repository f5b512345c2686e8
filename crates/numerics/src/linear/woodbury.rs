//! A symmetric positive definite matrix less a few outer products, by the formula of Woodbury.
//!
//! ```text
//! (K - U U')^-1 = K^-1 + V S^-1 V',   V = K^-1 U,   S = 1 - U' V                          (1)
//! ```
//!
//! K keeps its skyline, which the outer products would fill. `K - U U'` is positive definite exactly
//! when K and S are. Source: Golub and Van Loan, Matrix Computations, 4th ed., section 2.1.4.

use crate::linear::skyline::{Factor, Number, Skyline, axpy, dot};

/// `(K - U U')^-1`.
#[derive(Clone, Debug)]
pub struct Woodbury<T = f64> {
    /// Of K.
    factor: Factor<T>,
    u: Vec<Vec<f64>>,
    v: Vec<Vec<f64>>,
    /// Of S.
    small: Factor,
}

impl<T: Number> Woodbury<T> {
    /// From the factor of K and the columns of U; `None` when `K - U U'` is not positive definite.
    pub fn new(factor: Factor<T>, u: Vec<Vec<f64>>) -> Option<Self> {
        // V = K^-1 U
        let mut v = u.clone();
        v.iter_mut().for_each(|v| factor.solve(v));
        // S = 1 - U' V
        let mut small = Skyline::zeros(vec![0; u.len()]);
        small.fill(|i, row| {
            for (j, s) in row.iter_mut().enumerate() {
                *s = f64::from(i == j) - dot(&u[i], &v[j]);
            }
        });
        let small = small.factorise()?;
        Some(Self { factor, u, v, small })
    }

    /// The least square of a pivot of S: what the outer products leave of K along the directions of U,
    /// as a part of it. The less, the more the rounding of the factor of K counts.
    pub fn least_left(&self) -> f64 {
        self.small.least_pivot()
    }

    /// Solves `(K - U U') x = b` in place.
    pub fn solve(&self, b: &mut [f64]) {
        // x = K^-1 b + V S^-1 U' K^-1 b,  which is (1) because V' b = U' K^-1 b
        self.factor.solve(b);
        let mut c: Vec<f64> = self.u.iter().map(|u| dot(u, b)).collect();
        self.small.solve(&mut c);
        for (v, c) in self.v.iter().zip(&c) {
            axpy(*c, v, b);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;

    fn case(scale: f64) -> (Skyline, Vec<Vec<f64>>, Array2<f64>) {
        let n = 90;
        let dense = Array2::from_shape_fn((n, n), |(i, j)| match i.abs_diff(j) {
            0 => 3.0,
            d if d < 6 => 0.2 / d as f64,
            _ => 0.0,
        });
        let u: Vec<Vec<f64>> = (0..3)
            .map(|k| (0..n).map(|i| scale * (f64::from(k + 1) * i as f64).sin()).collect())
            .collect();
        let mut whole = dense.clone();
        for u in &u {
            for i in 0..n {
                for j in 0..n {
                    whole[[i, j]] -= u[i] * u[j];
                }
            }
        }
        (Skyline::from_dense(&dense), u, whole)
    }

    #[test]
    fn it_solves_the_whole_matrix() {
        // Outer products of squared length 90 / 2 * 0.2^2 = 1.8, below the least eigenvalue of K,
        // which is above 3 - 2 * 0.2 (1 + 1/2 + ... + 1/5) = 2.08.
        let (k, u, whole) = case(0.2);
        for count in [0, 1, 3] {
            let mut expected = whole.clone();
            for u in &u[count..] {
                expected += &Array2::from_shape_fn(whole.dim(), |(i, j)| u[i] * u[j]);
            }
            let inverse = Woodbury::new(k.clone().factorise().unwrap(), u[..count].to_vec());
            let planted: Vec<f64> = (0..90).map(|i| f64::from(i).cos()).collect();
            let mut x = expected.dot(&ndarray::aview1(&planted)).to_vec();
            inverse.unwrap().solve(&mut x);
            for (found, planted) in x.iter().zip(&planted) {
                // Condition numbers of at most 4 / (2.08 - 1.8) = 14, values of order 1.
                assert!((found - planted).abs() < 1e-13, "{count}: {found} {planted}");
            }
        }
    }

    #[test]
    fn what_is_not_positive_definite_is_refused() {
        // Squared length 45, above the largest eigenvalue of K.
        let (k, u, _) = case(1.0);
        assert!(Woodbury::new(k.factorise().unwrap(), u).is_none());
    }
}
