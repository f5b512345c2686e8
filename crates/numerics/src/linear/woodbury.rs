//! A symmetric positive definite matrix less a few outer products, by the formula of Woodbury.
//!
//! ```text
//! (K - U U')^-1 = K^-1 + V S^-1 V',   V = K^-1 U,   S = 1 - U' V                          (1)
//! ```
//!
//! K keeps its skyline, which the outer products would fill. `K - U U'` is positive definite exactly if K and S are. If
//! `K - U U'` is nearly singular, S is the small difference of 1 and of U' V, which has the rounding of the factor of
//! K. A factor in single precision then needs V to be refined ([`Woodbury::refined`]). Source: Golub and Van Loan,
//! Matrix Computations, 4th ed., section 2.1.4.

use crate::linear::skyline::{Factor, Number, Skyline, axpy, dot};

/// Largest number of steps of a refinement. Larger: more time on a factor that is too far from K.
/// Smaller: usable factors are refused. With a usable factor, each step leaves a thousandth or less
/// of the error.
const MOST_REFINEMENTS: usize = 4;

/// Largest change of S by the last step of a refinement, relative to the smallest squared diagonal element (pivot) of
/// the Cholesky factor of S. Larger: a less exact S. Smaller: more steps.
const REFINED_TO: f64 = 1e-3;

/// The inverse `(K - U U')^-1` of (1) of the module, as factors.
#[derive(Clone, Debug)]
pub struct Woodbury<T = f64> {
    /// Factor of the matrix K.
    factor: Factor<T>,
    v: Vec<Vec<f64>>,
    /// Factor of the small matrix S of (1) of the module.
    small: Factor,
}

impl<T: Number> Woodbury<T> {
    /// Makes the inverse from the factor of K and the columns of U; `None` if `K - U U'` is not positive
    /// definite.
    pub fn new(factor: Factor<T>, u: &[Vec<f64>]) -> Option<Self> {
        let v = solutions(&factor, u);
        let small = small(u, &v)?;
        Some(Self { factor, v, small })
    }

    /// Makes the inverse with a refined V, so that the rounding of the factor does not limit it. V stays unrefined if
    /// the smallest pivot of S is at least `enough`. `product` is K times a vector. `None` if `K - U U'` is not
    /// positive definite, or if the factor is too far from K for a refinement.
    pub fn refined(
        factor: Factor<T>,
        u: &[Vec<f64>],
        enough: f64,
        product: impl Fn(&[f64]) -> Vec<f64>,
    ) -> Option<Self> {
        let mut v = solutions(&factor, u);
        if let Some(small) = small(u, &v).filter(|small| small.least_pivot() >= enough) {
            return Some(Self { factor, v, small });
        }
        for _ in 0..MOST_REFINEMENTS {
            // V += K^-1 (U - K V)
            let mut change = 0.0f64;
            for (u_i, v) in u.iter().zip(&mut v) {
                let mut e: Vec<f64> = u_i.iter().zip(product(v)).map(|(u, kv)| u - kv).collect();
                factor.solve(&mut e);
                axpy(1.0, &e, v);
                change = u.iter().map(|u| dot(u, &e).abs()).fold(change, f64::max);
            }
            if let Some(small) = small(u, &v)
                && change <= REFINED_TO * small.least_pivot()
            {
                return Some(Self { factor, v, small });
            }
        }
        None
    }

    /// Solves `(K - U U') x = b`; x replaces b.
    pub fn solve(&self, b: &mut [f64]) {
        // x = K^-1 b + V S^-1 V' b
        let mut c: Vec<f64> = self.v.iter().map(|v| dot(v, b)).collect();
        self.small.solve(&mut c);
        self.factor.solve(b);
        for (v, c) in self.v.iter().zip(&c) {
            axpy(*c, v, b);
        }
    }
}

/// Returns the columns of V = K^-1 U for the columns `u` of U.
fn solutions<T: Number>(factor: &Factor<T>, u: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let mut v = u.to_vec();
    v.iter_mut().for_each(|v| factor.solve(v));
    v
}

/// Returns the factor of `S = 1 - U' V`, from the columns of U and V; `None` if S is not positive definite.
fn small(u: &[Vec<f64>], v: &[Vec<f64>]) -> Option<Factor> {
    let mut small = Skyline::zeros(vec![0; u.len()]);
    small.fill(|i, row| {
        for (j, s) in row.iter_mut().enumerate() {
            *s = f64::from(i == j) - dot(&u[i], &v[j]);
        }
    });
    small.factorise()
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
            let inverse = Woodbury::new(k.clone().factorise().unwrap(), &u[..count]);
            let planted: Vec<f64> = (0..90).map(|i| f64::from(i).cos()).collect();
            let mut x = expected.dot(&ndarray::aview1(&planted)).to_vec();
            inverse.unwrap().solve(&mut x);
            for (found, planted) in x.iter().zip(&planted) {
                // Condition numbers of at most 4 / (2.08 - 1.8) = 14, values of order 1.
                assert!((found - planted).abs() < 1e-13, "{count}: {found} {planted}");
            }
        }
    }

    /// A factor in single precision alone would not resolve the remainder of 1e-11 here.
    #[test]
    fn a_factor_in_single_precision_is_refined() {
        let (k, u, _) = case(1.0);
        let u = &u[0];
        let mut v = u.clone();
        k.clone().factorise().unwrap().solve(&mut v);
        let left = 1e-11;
        let scale = ((1.0 - left) / dot(u, &v)).sqrt();
        let u: Vec<f64> = u.iter().map(|u| scale * u).collect();
        let planted: Vec<f64> = (0..90).map(|i| f64::from(i).cos() + 0.3).collect();
        let mut b = k.product(&planted);
        axpy(-dot(&u, &planted), &u, &mut b);
        let error = |inverse: &Woodbury<f32>| {
            let mut x = b.clone();
            inverse.solve(&mut x);
            let off = x.iter().zip(&planted).map(|(x, p)| (x - p).abs());
            off.fold(0.0, f64::max)
        };
        let single = || k.factorise_in_single(&[]).unwrap();
        let refined = |enough: f64| {
            Woodbury::refined(single(), std::slice::from_ref(&u), enough, |x| k.product(x)).unwrap()
        };
        let found = refined(1e-4);
        // The remainder agrees to the change that the last step may make. The planted part along V
        // is of order 1 and appears in b as small as the remainder. Rounding of 1e-16 in b is
        // therefore 1e-5 of it; that of single precision is far more.
        assert!(
            (found.small.least_pivot() / left - 1.0).abs() < 1e-3,
            "{}",
            found.small.least_pivot()
        );
        assert!(error(&found) < 1e-4, "{}", error(&found));
        let alone = Woodbury::new(single(), std::slice::from_ref(&u)).map(|alone| error(&alone));
        // Rounding of 6e-8 alone is above the remainder of 1e-11; what comes out, if anything, has no digit of it.
        assert!(alone.is_none_or(|error| error > 1e-3), "{alone:?}");
    }

    #[test]
    fn what_is_not_positive_definite_is_refused() {
        // Squared length 45, above the largest eigenvalue of K.
        let (k, u, _) = case(1.0);
        assert!(Woodbury::new(k.factorise().unwrap(), &u).is_none());
    }
}
