//! Proven upper bound on the excess of an objective over its least value (duality gap), nm^2.
//!
//! The convex program is `min f(D + d)` over the changes d of the densities D. It has the rows (linearised constraints)
//! `c + J d >= 0` and the bounds `D + d >= lo`; f is quadratic. For all dual variables z >= 0 and y >= 0, with the
//! curvature F of f, at least alpha,
//!
//! ```text
//! f - min <= z' c + y' (D - lo) + 1/2 r' F^-1 r,   r = f' - J' z - y                            (1)
//! ```
//!
//! by Lagrange's function, which is least at `d = -F^-1 r`. The y at hand need not be the best one. With y_j the
//! positive part of `f' - J' z`, and alpha in the place of F,
//!
//! ```text
//! f - min <= z' c + sum over r_j > 0 of r_j (D_j - lo_j) + sum over r_j < 0 of r_j^2 / (2 alpha),   r = f' - J' z   (2)
//! ```
//!
//! (2) costs almost nothing, but it is much too large where r is smooth, because F is far above alpha there. In that
//! case (1) is used, with
//! ```text
//! r' F^-1 r <= x' r + x' e + e' e / alpha,   e = r - F x,   for every x                          (3)
//! ```
//!
//! for the x of conjugate gradients. (1) holds for every F that is nowhere above the curvature of f. (3) also needs
//! an F that is nowhere below alpha. The normal matrix on cells of pixels, with the weights alpha and beta of
//! [`crate::merit`], is such a matrix where [`planish_dwell::residual`] says so. Its products are cheap, and its own
//! inverse differs from F^-1 by rounding only, so that one or two steps are enough. Elsewhere F is the curvature
//! itself.

use planish_numerics::linear::skyline::dot;

/// Largest number of conjugate-gradient steps for (3) of the module. Larger: a tighter bound where the preconditioner
/// is poor, at the cost of one product with F per step. Smaller: a looser, still valid bound, so more proofs fail.
/// Chosen: one or two steps are usual with the inverse of F itself as the preconditioner.
const MAX_STEPS: usize = 10;

/// Ratio of the last term of (3) of the module to the sum of the first two at which the steps end. Larger: fewer steps
/// and a looser bound. Smaller: more steps and a tighter bound. Derived: the first two terms are a lower bound, so the
/// result is at most a tenth above the exact value.
const REST: f64 = 0.1;

/// Returns the bound (2) of the module on the gap, without its term `z' c`, nm^2. `r` (n) is f' - J' z, `room` (n) the
/// distance D - lo of the densities from their bounds, and `alpha` the least curvature of f.
pub fn by_alpha(r: &[f64], room: &[f64], alpha: f64) -> f64 {
    r.iter()
        .zip(room)
        .map(|(r, room)| if *r > 0.0 { r * room } else { r * r / (2.0 * alpha) })
        .sum()
}

/// Returns an upper bound of `1/2 r' F^-1 r` by (3) of the module, nm^2, for `r = f' - J' z - y` (n). `product` returns
/// F x, and `precondition` nearly F^-1 x.
///
/// The first two terms of (3) are a lower bound of the result. The steps also end when half of them exceeds `of_use`,
/// nm^2, because the bound can then prove nothing.
pub fn by_curvature(
    r: &[f64],
    alpha: f64,
    of_use: f64,
    mut product: impl FnMut(&[f64]) -> Vec<f64>,
    precondition: impl Fn(&[f64]) -> Vec<f64>,
) -> f64 {
    let bound = |x: &[f64], e: &[f64]| (dot(x, r) + dot(x, e), dot(e, e) / alpha);
    let (mut x, mut e) = (vec![0.0; r.len()], r.to_vec());
    let (mut known, mut rest) = bound(&x, &e);
    let mut least = known + rest;
    let mut towards = precondition(&e);
    let mut e_m_e = dot(&e, &towards);
    for _ in 0..MAX_STEPS {
        if rest <= REST * known || 0.5 * known > of_use || e_m_e <= 0.0 {
            break;
        }
        let f_towards = product(&towards);
        let length = e_m_e / dot(&towards, &f_towards);
        x.iter_mut().zip(&towards).for_each(|(x, t)| *x += length * t);
        e.iter_mut().zip(&f_towards).for_each(|(e, t)| *e -= length * t);
        (known, rest) = bound(&x, &e);
        least = least.min(known + rest);
        let next = precondition(&e);
        let before = std::mem::replace(&mut e_m_e, dot(&e, &next));
        let conjugate = e_m_e / before;
        towards.iter_mut().zip(&next).for_each(|(t, n)| *t = n + conjugate * *t);
    }
    0.5 * least
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 40;
    const ALPHA: f64 = 1e-5;

    /// Returns the product of `x` with the matrix whose eigenvectors are cosines, with the eigenvalues `spectrum`.
    fn of_spectrum(spectrum: impl Fn(usize) -> f64, x: &[f64]) -> Vec<f64> {
        let cosine = |k: usize, i: usize| {
            let norm = if k == 0 { 1.0 } else { 2.0f64 };
            (norm / N as f64).sqrt()
                * (std::f64::consts::PI * (i as f64 + 0.5) * k as f64 / N as f64).cos()
        };
        let along = |k: usize| (0..N).map(|i| cosine(k, i) * x[i]).sum::<f64>();
        let parts: Vec<f64> = (0..N).map(|k| spectrum(k) * along(k)).collect();
        (0..N).map(|i| (0..N).map(|k| cosine(k, i) * parts[k]).sum()).collect()
    }

    #[test]
    fn it_is_a_bound_and_close_to_what_it_bounds() {
        let f = |k: usize| ALPHA + (-0.5 * k as f64).exp();
        let r: Vec<f64> = (0..N).map(|i| 1e-3 * (0.07 * (i * i) as f64).cos()).collect();
        let exact = 0.5 * dot(&r, &of_spectrum(|k| 1.0 / f(k), &r));
        // A preconditioner that is up to a third off, and none.
        let off = |k: usize| f(k) * (1.0 + 0.3 * (k as f64).sin());
        let near = |x: &[f64]| of_spectrum(|k| 1.0 / off(k), x);
        let found = by_curvature(&r, ALPHA, f64::INFINITY, |x| of_spectrum(f, x), near);
        // The steps end where the rest is a tenth; rounding through a condition number of 1e5.
        assert!(found >= exact * (1.0 - 1e-9) && found <= 1.11 * exact, "{found} {exact}");
        let poor = by_curvature(&r, ALPHA, f64::INFINITY, |x| of_spectrum(f, x), <[f64]>::to_vec);
        // Rounding through a condition number of 1e5, as above.
        assert!(poor >= exact * (1.0 - 1e-9), "{poor} {exact}");
        assert!(poor <= 0.5 * dot(&r, &r) / ALPHA);
        // What cannot be of use is seen after a step or two, and is a bound all the same.
        let mut steps = 0;
        let product = |x: &[f64]| {
            steps += 1;
            of_spectrum(f, x)
        };
        let early = by_curvature(&r, ALPHA, 0.1 * exact, product, near);
        assert!(early >= exact && steps <= 2, "{early} {exact} {steps}");
    }

    #[test]
    fn lagrange_bounds_the_fall_of_a_program() {
        // f = 1/2 a d^2 + g d with d >= -room: the least value is -g^2 / (2 a), or that at the bound.
        for (a, g, room) in [(2.0, 0.3, 1.0), (2.0, 0.3, 0.05), (2.0, -0.3, 1.0)] {
            let d = f64::max(-g / a, -room);
            let fall = -(0.5 * a * d * d + g * d);
            let bound = by_alpha(&[g], &[room], a);
            assert!(bound >= fall, "{bound} {fall}");
            let of_y = |y: f64| {
                y * room
                    + by_curvature(
                        &[g - y],
                        a,
                        f64::INFINITY,
                        |x| vec![a * x[0]],
                        |x| vec![x[0] / a],
                    )
            };
            let best = (0..=400).map(|k| of_y(f64::from(k) * 1e-3)).fold(f64::INFINITY, f64::min);
            // Duality is strong: the best of the bounds is the fall, to the square of the step of y, 2.5e-7 / a.
            assert!(best >= fall - 1e-12 && best <= fall + 1e-6, "{best} {fall}");
        }
    }
}
