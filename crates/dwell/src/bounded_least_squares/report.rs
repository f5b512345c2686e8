//! Report of the solver of the bounded least squares.

use std::fmt;

use ndarray::{Array2, Zip};
use planish_numerics::statistics;
use planish_types::{
    DwellTime, End, Invalid, TifLattice,
    outcome::plan::ProvenGap,
    plausible::{self, Rms},
};
use serde::Serialize;

use super::{minimise::Iterate, prepared::BoundedProblem};
use crate::{continuation::Continuation, model::FFT_ROUNDING, surrogate::Surrogate};

/// Method that minimises the surrogate of H for every step; manifests hold its name in kebab case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Algorithm {
    /// Sets of free dwell times (active sets), with factorisations of the surrogate of H.
    ActiveSet,
    /// Conjugate gradients on the active set, preconditioned on a lattice of B-splines.
    TwoLevel,
    /// Projected gradient steps with products of the surrogate.
    ProjectedGradient,
}

impl fmt::Display for Algorithm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// Report of the bounded least squares: method, certificate and residual.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BoundedReport {
    /// Method that found the steps.
    pub algorithm: Algorithm,
    /// Number of sets of free dwell times that were solved for with the factorised surrogate of H, plus that of
    /// products or gradient steps with the other one.
    pub iterations: usize,
    /// Number of steps found by the surrogate, each corrected by the exact gradient.
    pub corrections: usize,
    /// Number of pixels along the side of a cell of the surrogate; 1 if its cells are the pixels.
    pub cell_pixels: usize,
    /// Reason for which the steps ended: `optimal`, `stagnated` (the objective changes no more) or `iteration-limit`.
    pub end: End,
    /// Natural residual, the largest |t - clip(t - gradient / H_jj)|, s: 0 at the optimum.
    pub kkt_residual_s: f64,
    /// Upper bound of the distance of the objective (1) from its minimum, relative to the objective. It is left out if
    /// alpha is 0: then `kkt_residual_s` alone certifies the result.
    #[serde(flatten)]
    pub proven: ProvenGap,
    /// Smoothness beta that was used: the given one, or the larger one that the search for the noise level found.
    pub slope_weight: f64,
    /// Number of dwell points at their lower bound, unreached and lifted ones not counted.
    pub at_lower_bound: usize,
    /// Number of reached dwell points at their upper bound.
    pub at_upper_bound: usize,
    /// Number of dwell points that do not reach the map, those with the tool off included. Segments with the tool on
    /// get the dwell time per length of their neighbours.
    pub unreached_points: usize,
    /// Number of pixels with a weight above 0 that no dwell point reaches: nothing can be corrected there.
    pub unreached_pixels: usize,
    /// RMS (mean removed) of the residual in the removal model of the solver, nm.
    pub model_rms_nm: f64,
    /// RMS of the residual without its best plane, nm.
    pub model_rms_detilted_nm: f64,
    /// Sum of the dwell times, s.
    pub total_time_s: f64,
    /// Value of the objective (1) over the sum of the weights of the pixels, nm^2. The dwell times of unreached points
    /// count as their lower bounds.
    #[serde(skip)]
    pub objective_nm2: f64,
    /// Lattice of the map on which the TIF was sampled anew; left out where the samples are its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tif_lattice: Option<TifLattice>,
    /// Rounds for a rate that depends on the time of the run; left out for other tools.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rates_of_time: Option<RatesOfTime>,
    /// Root of twice the mean Huber loss of [the map, the residual], nm; none without a Huber loss.
    #[serde(skip)]
    pub robust_nm: Option<[f64; 2]>,
}

/// Largest relative difference between a rate in the model of the solver and the rate at the times of the plan at
/// which they count as the same. Larger: dwell times for rates that are wrong by it. Smaller: more rounds.
pub(super) const SAME_TIME_FACTOR: f64 = 1e-5;

/// Convergence of a plan for a tool whose rate depends on the time of the run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RatesOfTime {
    /// Number of problems that were solved: the first at the rate factor 1, each further one with the rates at the
    /// times of the one before.
    pub rounds: usize,
    /// Largest relative difference of a rate in the model of the solver from that at the times of the plan.
    pub rate_error: f64,
}

impl RatesOfTime {
    /// Returns the reason of a negative verdict: the rates in the model are not those at the times of the plan. `None`
    /// if they are.
    fn negative(&self) -> Option<String> {
        let Self { rounds, rate_error } = *self;
        if rate_error <= SAME_TIME_FACTOR {
            return None;
        }
        Some(format!(
            "not converged: after {rounds} rounds the rate at the times of the plan is up to {rate_error:.1e} off \
             the one it is planned with; give a tool whose rate changes less within the run"
        ))
    }
}

impl BoundedReport {
    /// Returns the reason of a negative verdict; `None` if the verdict is positive. It is negative if the rates of a
    /// time-dependent tool did not converge, if the solver did not end at a proven minimum, or if
    /// [`plausible::drawback`] finds one. `before` is the RMS of the map.
    ///
    /// With a Huber loss, the loss of the residual is compared with that of the map, because the pits would decide an
    /// RMS.
    pub fn negative(&self, before: Rms) -> Option<String> {
        let plain = Rms { rms_nm: self.model_rms_nm, detilted_nm: self.model_rms_detilted_nm };
        let (before, after) = match self.robust_nm {
            Some(robust) => robust.map(|rms_nm| Rms { rms_nm, detilted_nm: rms_nm }).into(),
            None => (before, plain),
        };
        let gap = self.proven.relative_gap.map_or_else(String::new, |gap| {
            format!(", and the objective may be {gap:.1e} of itself above its minimum")
        });
        let unproven = format!(
            "after {} iterations a dwell time would still move by {:.1e} s{gap}; raise `tikhonov` or \
             `slope_weight`",
            self.iterations, self.kkt_residual_s
        );
        if let Some(reason) = self.rates_of_time.and_then(|rates| rates.negative()) {
            return Some(reason);
        }
        match self.end {
            End::Optimal => plausible::drawback(before, after, self.total_time_s),
            End::Stagnated => {
                Some(format!("not proven optimal, the steps change nothing any more: {unproven}"))
            }
            _ => Some(format!("not converged: {unproven}")),
        }
    }
}

/// Dwell times of the bounded least squares, and the report on them.
#[derive(Clone, Debug)]
pub struct BoundedSolution {
    /// Dwell times along the path.
    pub dwell: DwellTime,
    /// Report of the solver on them.
    pub report: BoundedReport,
}

impl BoundedProblem<'_> {
    /// Makes the solution from the result of [`Self::minimise`] with the smoothness beta = `slope_weight`.
    pub(super) fn finish(
        &self,
        mut iterate: Iterate,
        slope_weight: f64,
    ) -> Result<BoundedSolution, Invalid> {
        for tool in &self.tools {
            let columns = tool.columns.columns.clone();
            let reached = &self.reached[columns.clone()];
            let unreached = Continuation::new(tool.columns.path, |j| reached[j]);
            let [lo, hi] = [self.lo, self.hi_given].map(|bound| &bound[columns.clone()]);
            unreached.apply_within(&mut iterate.t[columns.clone()], lo, hi);
        }
        let t = &iterate.t;
        let mut residual = self.desired.height_nm() - &iterate.removal_nm;
        Zip::from(&mut residual).and(&self.weight).for_each(|r, w| {
            if *w == 0.0 {
                *r = f64::NAN;
            }
        });
        // Where something is removed the tool was; where nothing is, it may not have dwelt.
        let mut unreached_pixels = self.unreached_pixels(&iterate.removal_nm);
        if unreached_pixels > 0 {
            unreached_pixels = self.unreached_pixels(&self.b.apply(&vec![1.0; t.len()]));
        }
        let reached: Vec<usize> = (0..t.len()).filter(|j| self.reached[*j]).collect();
        let grid = self.desired.grid();
        let rms = statistics::statistics(residual.view()).map_or(0.0, |s| s.rms);
        let (x, y) = (grid.x.coordinates(), grid.y.coordinates());
        let report = BoundedReport {
            algorithm: match &self.surrogate {
                Surrogate::Ordered(_) => Algorithm::ActiveSet,
                Surrogate::Convolved(_) if self.splines_mm.is_some() => Algorithm::TwoLevel,
                Surrogate::Convolved(_) => Algorithm::ProjectedGradient,
            },
            iterations: iterate.iterations,
            corrections: iterate.corrections,
            cell_pixels: self.cell,
            end: iterate.end,
            kkt_residual_s: iterate.natural_residual,
            proven: ProvenGap { relative_gap: iterate.relative_gap, ..ProvenGap::default() },
            slope_weight,
            at_lower_bound: reached.iter().filter(|j| t[**j] <= self.lo[**j]).count(),
            at_upper_bound: reached.iter().filter(|j| t[**j] >= self.hi[**j]).count(),
            unreached_points: t.len() - reached.len(),
            unreached_pixels,
            model_rms_nm: rms,
            model_rms_detilted_nm: statistics::detilted_rms(residual.view(), &x, &y).unwrap_or(rms),
            total_time_s: t.iter().sum(),
            objective_nm2: iterate.objective / self.weight.sum(),
            tif_lattice: None,
            rates_of_time: None,
            robust_nm: self.settings.huber_nm.map(|k| {
                [self.desired.height_nm(), &residual].map(|z| huber_rms(z, &self.weight, k))
            }),
        };
        Ok(BoundedSolution { dwell: DwellTime::new(iterate.t)?, report })
    }

    /// Counts the pixels with a weight above 0 whose removal is no more than the rounding of an FFT.
    fn unreached_pixels(&self, removal_nm: &Array2<f64>) -> usize {
        let floor = FFT_ROUNDING * removal_nm.iter().copied().fold(0.0, f64::max);
        removal_nm.iter().zip(&self.weight).filter(|(r, w)| **w > 0.0 && **r <= floor).count()
    }
}

/// Number of steps of the iteration for the piston in [`huber_rms`]. Each halves the error at least, if more than half
/// of the pixels are within the threshold k. Larger: more time. Smaller: the piston is not exact to rounding.
const PISTON_STEPS: usize = 50;

/// Returns the root of twice the mean Huber loss rho of a map z with the threshold k, nm, at the piston p where it is
/// least:
///
/// ```text
/// sqrt(2 sum w rho(z - p) / sum w),   p <- sum w h z / sum w h,   h = min(1, k / |z - p|)
/// rho(e) = e^2 / 2 up to |e| = k,     k (|e| - k / 2) beyond it
/// ```
///
/// It is the RMS if no pixel is farther than k from the mean, and 0 if no pixel counts.
fn huber_rms(z: &Array2<f64>, weight: &Array2<f64>, k: f64) -> f64 {
    let counted: Vec<(f64, f64)> =
        z.iter().zip(weight).filter(|(_, w)| **w > 0.0).map(|(z, w)| (*z, *w)).collect();
    let mut sorted: Vec<f64> = counted.iter().map(|(z, _)| *z).collect();
    if sorted.is_empty() {
        return 0.0;
    }
    let half = sorted.len() / 2;
    let mut piston = *sorted.select_nth_unstable_by(half, f64::total_cmp).1;
    for _ in 0..PISTON_STEPS {
        let mut sum = 0.0;
        let mut total = 0.0;
        for (z, w) in &counted {
            let w = w * (k / (z - piston).abs()).min(1.0);
            sum += w * z;
            total += w;
        }
        piston = sum / total;
    }
    let mut sum = 0.0;
    let mut total = 0.0;
    for (z, w) in &counted {
        let e = (z - piston).abs();
        sum += w * if e <= k { 0.5 * e * e } else { k * (e - 0.5 * k) };
        total += w;
    }
    (2.0 * sum / total).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn a_huber_rms_is_that_of_its_loss_at_the_best_piston() {
        // Nothing beyond k: the RMS; weights count, what has none does not.
        let z = array![[1.0, 3.0, f64::NAN], [5.0, 3.0, 1e9]];
        let w = array![[1.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
        // Rounding.
        assert!((huber_rms(&z, &w, 10.0) - 2f64.sqrt()).abs() < 1e-12);
        // Four pixels at 0 and one at -100, k = 1: 4 p = -1 at the piston, which is -1/4; the loss is
        // 4 / 32 + (100 - 1/4) - 1/2.
        let z = array![[0.0, 0.0, -100.0, 0.0, 0.0]];
        let exact = (2.0 * (0.125 + 99.75 - 0.5) / 5.0_f64).sqrt();
        let found = huber_rms(&z, &z.mapv(|_| 1.0), 1.0);
        assert!((found - exact).abs() < 1e-9, "{found} {exact}");
    }
}
