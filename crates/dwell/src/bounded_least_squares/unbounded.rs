//! The certificate of the two-level method, without new factorisations: steps on the free dwell times alone, without
//! their bounds.
//!
//! The errors of the surrogate and the cuts at the bounds leave a gradient q on the free dwell times. The bound of
//! [`super::certificate`] counts `q^2 / (2 c)` for each, with the small curvature c of the Tikhonov term in place of
//! the curvature of (1). If c is a hundred millionth of that, a result that is 1e-6 above the minimum seems to be 0.3
//! of it above. So the free dwell times are moved to where q is zero, whatever their bounds. That takes a few products
//! with the last factorisation. Dwell times slightly beyond their bounds hardly weaken the bound of the certificate,
//! and put back within the bounds, the result is better than before.

use ndarray::Array2;
use planish_numerics::linear::skyline::dot;
use planish_types::progress;

use super::{prepared::BoundedProblem, weighted::Weighted};
use crate::surrogate::{Surrogate, Unbounded};

/// Change of the objective when the dwell times are put back within their bounds, as a fraction of it, above which the
/// solution without bounds is dropped: other dwell times should then be free. Larger: more rounds with a wrong set of
/// free dwell times. Smaller: useful solutions are dropped.
const MAX_COST_OF_BOUNDS: f64 = 1e-3;

/// Fraction of the wanted relative gap at which the steps without bounds end; the rest is left for the cost of the
/// bounds. Larger: the bounds may spoil the certificate. Smaller: more steps.
const GAP_FRACTION: f64 = 0.3;

/// Fraction of the gap that a step may leave; the steps end if one leaves more. Larger: more slow steps. Smaller: the
/// steps end while they still help.
const SLOW_GAP_FRACTION: f64 = 0.5;

/// Result of [`BoundedProblem::without_bounds`].
pub struct WithoutBounds {
    /// Dwell times, of which free ones may be beyond their bounds. `None` if putting the first ones back within the
    /// bounds costs more than [`MAX_COST_OF_BOUNDS`], or if nothing is proven because alpha is 0.
    pub end: Option<Unbounded>,
    /// Largest lower bound of the minimum of (1) that was proven; minus infinity if none was.
    pub bound: f64,
    /// Number of products with the surrogate H~.
    pub products: usize,
}

impl BoundedProblem<'_> {
    /// Goes on from `from`, dwell times whose free ones may be beyond their bounds, to the minimum of the objective (1)
    /// over the free ones without bounds:
    ///
    /// ```text
    /// repeat  q = gradient of (1) at t                           exact
    ///         e = argmin q'e + e'H~e / 2 over the free ones      by the factor of before
    ///         p = argmin of (1) over t + a e + b p               exact
    ///         t += p
    /// ```
    ///
    /// Dwell times at a bound become free if (1) falls when they leave it. `objective` is (1) at the dwell times within
    /// the bounds that were found with `from`. The steps end at [`GAP_FRACTION`] of the gap `relative_gap`, after a
    /// slow step, or after `max_products` products with H~.
    pub(super) fn without_bounds(
        &mut self,
        weighted: &Weighted,
        from: Unbounded,
        objective: f64,
        (relative_gap, max_products): (f64, usize),
    ) -> WithoutBounds {
        let Unbounded { mut t, mut free } = from;
        let mut result = WithoutBounds { end: None, bound: f64::NEG_INFINITY, products: 0 };
        let mut removal_nm = self.b.apply(&t);
        let mut before: Option<(Vec<f64>, Array2<f64>)> = None;
        let mut gaps: Option<(f64, f64)> = None;
        loop {
            let (value, q) = weighted.evaluate(self, &t, &removal_nm);
            let Some(gap) = self.gap(weighted.penalty, &t, &q) else { return result };
            result.bound = result.bound.max(value - gap);
            if gaps.is_none() && (objective - value).abs() > MAX_COST_OF_BOUNDS * objective {
                return result;
            }
            let enough = GAP_FRACTION * relative_gap * objective;
            let (first, last) = gaps.unwrap_or((gap, f64::INFINITY));
            progress::done(progress::of_convergence(first, gap, enough));
            let is_slow = gap > SLOW_GAP_FRACTION * last;
            if gap <= enough || is_slow || result.products >= max_products {
                result.end = Some(Unbounded { t, free });
                return result;
            }
            gaps = Some((first, gap));
            for j in (0..t.len()).filter(|j| self.reached[*j] && self.lo[*j] < self.hi[*j]) {
                let leaves = t[j] <= self.lo[j] && q[j] < 0.0 || t[j] >= self.hi[j] && q[j] > 0.0;
                free[j] |= leaves;
            }
            let left = max_products - result.products;
            let Surrogate::Convolved(h) = &mut self.surrogate else { return result };
            let (e, products) = h.step(weighted.penalty, &q, &free, left);
            result.products += products;
            let mut p_nm = self.b.apply(&e);
            let curvature = weighted.curvature(&e, &p_nm);
            let p: Vec<f64> = match before {
                Some((p, of_p)) => {
                    let [a, b] = weighted.plane_minimum(&q, (&e, &p_nm, curvature), (&p, &of_p));
                    p_nm = a * &p_nm;
                    p_nm.scaled_add(b, &of_p);
                    e.iter().zip(&p).map(|(e, p)| a * e + b * p).collect()
                }
                None => {
                    let a = -dot(&q, &e) / curvature;
                    p_nm = a * &p_nm;
                    e.iter().map(|e| a * e).collect()
                }
            };
            t.iter_mut().zip(&p).for_each(|(t, p)| *t += p);
            removal_nm.scaled_add(1.0, &p_nm);
            before = Some((p, p_nm));
        }
    }
}
