//! Damped least squares with a matrix that is known by its products only, for several dampings at
//! once:
//!
//! ```text
//! min ||A x - b||^2 + delta^2 ||x||^2                                                     (1)
//! ```
//!
//! The bidiagonalisation `A V = U L` of Golub and Kahan does not depend on delta. Only the
//! rotations that solve the small problem do. One pair of products per step therefore serves every
//! damping.
//!
//! Source: C. C. Paige, M. A. Saunders, ACM Trans. Math. Softw. 8 (1982) 43, section 4 (the
//! rotations), 5.3 (damping), 5.4 (stopping).

use crate::linear::lanczos::largest_eigenvalue;

/// Solution of the damped least squares problem (1) of the module for one damping.
#[derive(Clone, Debug)]
pub struct Damped {
    /// Damping delta, in the unit of the elements of A.
    pub damping: f64,
    /// Solution x (n).
    pub value: Vec<f64>,
    /// Number of steps of the bidiagonalisation; each takes one product with A and one with its adjoint.
    pub iterations: usize,
    /// True if the residual met the tolerance of [`lsqr`], or if the solution is exactly zero.
    pub converged: bool,
}

/// State of the iteration for one damping, in addition to the bidiagonalisation that all dampings share.
struct Lane {
    result: Damped,
    direction: Vec<f64>,
    phi_bar: f64,
    rho_bar: f64,
    /// Squared norm of the residual that the damping rotations have split off so far.
    left: f64,
    /// Squared Frobenius norm of the bidiagonal matrix so far.
    norm2: f64,
}

/// Solves the damped least squares problem (1) of the module for every delta of `dampings`. Returns the solutions in
/// their order.
///
/// `apply` is x (n) -> A x (m), and `adjoint` its adjoint, r (m) -> A' r (n). The iteration of a damping ends when
/// `||[A' r - delta^2 x]|| <= tolerance ||[A; delta I]||_F ||[r; delta x]||`, with r = b - A x, or after
/// `max_iterations` steps. After every step `watch` gets the largest ratio of the left side to the right one among the
/// dampings that have not ended.
pub fn lsqr(
    apply: impl Fn(&[f64]) -> Vec<f64>,
    adjoint: impl Fn(&[f64]) -> Vec<f64>,
    b: &[f64],
    dampings: &[f64],
    tolerance: f64,
    max_iterations: usize,
    mut watch: impl FnMut(f64),
) -> Vec<Damped> {
    // beta u = b, alpha v = A' u
    let mut u = b.to_vec();
    let beta = normalise(&mut u);
    let mut v = adjoint(&u);
    let mut alpha = normalise(&mut v);
    let mut lanes: Vec<Lane> = dampings
        .iter()
        .map(|&damping| Lane {
            result: Damped {
                damping,
                value: vec![0.0; v.len()],
                iterations: 0,
                converged: beta == 0.0 || alpha == 0.0,
            },
            direction: v.clone(),
            phi_bar: beta,
            rho_bar: alpha,
            left: 0.0,
            norm2: alpha * alpha,
        })
        .collect();
    for iteration in 1..=max_iterations {
        if lanes.iter().all(|lane| lane.result.converged) {
            break;
        }
        // beta u = A v - alpha u,   alpha v = A' u - beta v
        step(&mut u, apply(&v), alpha);
        let beta = normalise(&mut u);
        step(&mut v, adjoint(&u), beta);
        alpha = normalise(&mut v);
        let mut excess = 0.0_f64;
        for lane in lanes.iter_mut().filter(|lane| !lane.result.converged) {
            excess = excess.max(lane.advance(&v, alpha, beta, tolerance));
            lane.result.iterations = iteration;
        }
        watch(excess);
    }
    lanes.into_iter().map(|lane| lane.result).collect()
}

impl Lane {
    /// Does one step for this damping. Returns the ratio of the two sides of the stopping condition of [`lsqr`];
    /// converged at 1 or below.
    fn advance(&mut self, v: &[f64], alpha: f64, beta: f64, tolerance: f64) -> f64 {
        let delta = self.result.damping;
        // A rotation takes delta out of the bidiagonal matrix ...
        let damped = self.rho_bar.hypot(delta);
        self.left += (delta / damped * self.phi_bar).powi(2);
        let phi_bar = self.rho_bar / damped * self.phi_bar;
        // ... and one takes beta out.
        let rho = damped.hypot(beta);
        let c = damped / rho;
        let s = beta / rho;
        let theta = s * alpha;
        let phi = c * phi_bar;
        self.rho_bar = -c * alpha;
        self.phi_bar = s * phi_bar;
        for (x, (w, v)) in self.result.value.iter_mut().zip(self.direction.iter_mut().zip(v)) {
            *x += phi / rho * *w;
            *w = v - theta / rho * *w;
        }
        self.norm2 += beta * beta + alpha * alpha + delta * delta;
        let residual = (self.phi_bar * self.phi_bar + self.left).sqrt();
        let gradient = self.phi_bar * alpha * c;
        let enough = tolerance * self.norm2.sqrt() * residual;
        self.result.converged = gradient.abs() <= enough;
        gradient.abs() / enough
    }
}

/// Replaces x by `y - factor x`.
fn step(x: &mut [f64], y: Vec<f64>, factor: f64) {
    for (x, y) in x.iter_mut().zip(y) {
        *x = y - factor * *x;
    }
}

/// Scales a vector to length 1, and returns its length before; a vector of zeros stays as it is.
fn normalise(x: &mut [f64]) -> f64 {
    let length = x.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length > 0.0 {
        x.iter_mut().for_each(|v| *v /= length);
    }
    length
}

/// Returns the largest singular value of a matrix A with n columns, to about 1e-3, from the products `x -> A' A x`.
/// The result is a lower bound.
pub fn largest_singular_value(normal: impl Fn(&[f64]) -> Vec<f64>, n: usize) -> f64 {
    largest_eigenvalue(normal, n).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn agrees_with_the_normal_equations_for_every_damping() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let a = DMatrix::from_fn(40, 25, |i, j| {
            // Columns of very different length.
            rng.random_range(-1.0..1.0) * 0.8_f64.powi(j as i32) + if i == j { 0.1 } else { 0.0 }
        });
        let b = DVector::from_fn(40, |_, _| rng.random_range(-1.0..1.0));
        let apply = |x: &[f64]| (&a * DVector::from_row_slice(x)).as_slice().to_vec();
        let adjoint = |y: &[f64]| a.tr_mul(&DVector::from_row_slice(y)).as_slice().to_vec();
        let dampings = [1.0, 0.1, 0.01];
        let found = lsqr(apply, adjoint, b.as_slice(), &dampings, 1e-14, 500, |_| ());
        for (damped, delta) in found.iter().zip(dampings) {
            assert!(damped.converged && damped.damping == delta);
            let h = a.tr_mul(&a) + DMatrix::identity(25, 25) * delta * delta;
            let expected = h.cholesky().unwrap().solve(&a.tr_mul(&b));
            let error = (DVector::from_row_slice(&damped.value) - &expected).norm();
            // Rounding times the condition number 1e4 of the worst normal equations.
            assert!(error < 1e-10 * expected.norm(), "{delta}: {error}");
        }
        let normal = |x: &[f64]| (a.tr_mul(&(&a * DVector::from_row_slice(x)))).as_slice().to_vec();
        let largest = a.clone().svd(false, false).singular_values[0];
        // The process ends at about 1e-3 of the singular value.
        assert!((largest_singular_value(normal, 25) / largest - 1.0).abs() < 1e-2);
    }

    #[test]
    fn a_right_hand_side_of_zeros_needs_no_step() {
        let found = lsqr(|x| x.to_vec(), |x| x.to_vec(), &[0.0; 3], &[0.1], 1e-12, 10, |_| ());
        assert!(found[0].converged && found[0].value == [0.0; 3] && found[0].iterations == 0);
    }
}
