//! The objective (1) of [`crate::bounded_least_squares`], its gradient, and its least value along steps, all exact.

use ndarray::{Array2, Zip};
use planish_numerics::linear::skyline::dot;

use super::{certificate::gap, prepared::BoundedProblem, settings::Product};
use crate::{
    objective::{Basis, Penalty, weighted_product},
    residual_slope::SlopeTerm,
};

/// Determinant of the 2 x 2 matrix of [`Weighted::plane_minimum`], as a fraction of that of orthogonal directions, up
/// to which two directions count as parallel. Larger: useful second directions are dropped. Smaller: rounding decides
/// the step.
const MIN_DETERMINANT_FRACTION: f64 = 1e-9;

/// The objective (1) with the present weights of the pixels.
pub struct Weighted<'a> {
    pub penalty: &'a Penalty,
    pub basis: &'a Basis,
    pub weight: &'a Array2<f64>,
    /// Product with the matrix Q of (1), if there is one.
    pub quadratic: Option<Product<'a>>,
    /// Matrix S of (1), the slope of the residual, if the settings have one.
    pub slope: Option<&'a SlopeTerm>,
}

impl Weighted<'_> {
    /// Returns the value of (1) at the dwell times t (n) with their removal B t (ny, nx), and its gradient q (n).
    pub fn evaluate(
        &self,
        problem: &BoundedProblem,
        t: &[f64],
        removal_nm: &Array2<f64>,
    ) -> (f64, Vec<f64>) {
        // r = z - B t without its free part,  q = -B' W r + penalty
        let mut r = &problem.z - removal_nm;
        self.basis.project(self.weight, &mut r);
        let mut squares = weighted_product(self.weight, &r, &r);
        // B' P' S r, which adds to B' W r
        let sloped = self.slope.map(|slope| {
            let mut product = slope.product(&r);
            squares += (&product * &r).sum();
            self.basis.project_adjoint(self.weight, &mut product);
            product
        });
        Zip::from(&mut r).and(self.weight).for_each(|r, w| *r *= -w);
        if let Some(product) = sloped {
            r -= &product;
        }
        let mut q = problem.b.adjoint(&r);
        self.penalty.add_gradient(t, &mut q);
        let mut value = 0.5 * squares + self.penalty.value(t);
        if let Some(product) = self.quadratic {
            let more = product(t);
            value += 0.5 * dot(t, &more);
            q.iter_mut().zip(&more).for_each(|(q, more)| *q += more);
        }
        (value, q)
    }

    /// Returns the curvature `e' H e` of (1) along a step e (n) with its removal B e (ny, nx).
    pub fn curvature(&self, e: &[f64], e_nm: &Array2<f64>) -> f64 {
        self.between((e, e_nm), (e, e_nm))
    }

    /// Returns `d' H p` of two steps d and p, each given as (step (n), its removal (ny, nx)).
    fn between(&self, d: (&[f64], &Array2<f64>), p: (&[f64], &Array2<f64>)) -> f64 {
        let mut curved = vec![0.0; p.0.len()];
        self.penalty.add_product(p.0, &mut curved);
        if let Some(product) = self.quadratic {
            curved.iter_mut().zip(product(p.0)).for_each(|(c, more)| *c += more);
        }
        // d' B' P' S P B p
        let sloped = self.slope.map_or(0.0, |slope| {
            let [d, p] = [d.1, p.1].map(|nm| {
                let mut left = nm.clone();
                self.basis.project(self.weight, &mut left);
                left
            });
            (&d * &slope.product(&p)).sum()
        });
        let [free_d, free_p] = [d.1, p.1].map(|nm| self.basis.coefficients(self.weight, nm));
        let height = weighted_product(self.weight, d.1, p.1) - dot(&free_d, &free_p);
        height + sloped + dot(&curved, d.0)
    }

    /// Returns the factors [a, b] at which `q'e + e'He / 2` is least over the steps `e = a d + b p`. The steps are
    /// given with their removals, `dd` is d'Hd, and b is 0 if d and p are parallel to rounding.
    ///
    /// ```text
    /// [d'Hd d'Hp; d'Hp p'Hp] [a; b] = -[q'd; q'p]
    /// ```
    pub fn plane_minimum(
        &self,
        q: &[f64],
        (d, d_nm, dd): (&[f64], &Array2<f64>, f64),
        (p, p_nm): (&[f64], &Array2<f64>),
    ) -> [f64; 2] {
        let dp = self.between((d, d_nm), (p, p_nm));
        let pp = self.curvature(p, p_nm);
        let qd = dot(q, d);
        let qp = dot(q, p);
        let determinant = dd * pp - dp * dp;
        if determinant <= MIN_DETERMINANT_FRACTION * dd * pp {
            return [-qd / dd, 0.0];
        }
        [(dp * qp - pp * qd) / determinant, (dp * qd - dd * qp) / determinant]
    }
}

impl BoundedProblem<'_> {
    /// Returns an upper bound of the decrease of (1) that is still possible at t with the gradient q; `None` if alpha
    /// is 0.
    pub fn gap(&self, penalty: &Penalty, t: &[f64], q: &[f64]) -> Option<f64> {
        gap(t, q, self.lo, &self.hi, penalty.alpha(), &self.reached)
    }
}

/// Returns the weights v of (4) of [`crate::bounded_least_squares`], `w min(k / |r|, 1)`, for the residual r (ny, nx)
/// without its free part and the threshold k, both in nm. With them the gradient of the weighted squares is that of the
/// Huber loss.
pub fn huber_weights(weight: &Array2<f64>, r: &Array2<f64>, k: f64) -> Array2<f64> {
    Zip::from(weight).and(r).map_collect(|w, r| w * (k / r.abs()).min(1.0))
}
