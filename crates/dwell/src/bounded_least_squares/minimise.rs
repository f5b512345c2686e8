//! The steps to the minimum of (1) of [`crate::bounded_least_squares`]. The exact H is too large to be solved
//! with, its surrogate H~ is not exact: so each step is found with H~ and corrected with the exact gradient.

use ndarray::{Array2, Zip};
use planish_numerics::{
    linear::skyline::dot,
    qp::bounded::{self, GradientSettings},
};
use planish_types::{End, progress};

use super::{
    prepared::BoundedProblem,
    settings::Settings,
    weighted::{Weighted, add_scaled, scaled},
};
use crate::{
    DwellError,
    objective::{Basis, Penalty},
    residual_slope::SlopeTerm,
    surrogate::{Penalised, Surrogate, Unbounded},
};

/// Usual number of corrections of a problem, for the estimate of the remaining time only. Larger: the progress starts
/// slower and ends with a jump. Smaller: it waits before its end.
const USUAL_CORRECTIONS: f64 = 6.0;
/// Largest fraction of the progress that is reported before the end, for the estimate of the remaining time only.
const BEFORE_LAST: f64 = 0.9;

/// Largest number of steps of H~. Larger: problems that do not converge take longer. Smaller: slow problems end
/// without a certificate. Chosen: measured problems take 3 to 6.
const MAX_CORRECTIONS: usize = 100;

/// Easier problems that are solved before (1), one after the other, see [`BoundedProblem::approach`]: weights of the
/// penalty and pitch of the splines, both over those of (1). Chosen by the time that problems took: a third easier
/// problem, or smaller steps of the weights, cost as much time as they save.
const ROUGH_PROBLEMS: [(f64, f64); 2] = [(1e3, 2.0), (30.0, 1.5)];

/// Side of the cells of an easier problem over that for (1). Larger: cheaper and less exact easier problems.
const ROUGH_CELLS: usize = 2;

/// Largest alpha of an easier problem, dimensionless; a problem with a larger one is left out, because the penalty
/// would decide its whole result. Larger: useless easier problems cost time. Smaller: strongly regularised problems
/// start without easier ones.
const MAX_ROUGH_TIKHONOV: f64 = 1e-2;

/// Number of steps of H~ for an easier problem. Larger: a better start of the next problem, for more time.
const ROUGH_CORRECTIONS: usize = 1;

/// Number of steps of H~ for an easier problem with a Huber loss, whose weights come with the second step. Smaller:
/// the next problem starts without these weights.
const ROUGH_CORRECTIONS_HUBER: usize = 3;

/// Fraction of the natural residual above which a step is slow: it leaves more than this. Larger: fewer steps count
/// as slow. Smaller: the surrogate gets smaller cells earlier, and costs more.
const SLOW_RESIDUAL_FRACTION: f64 = 0.5;

/// Number of slow steps in a row after which the factorised surrogate gets smaller cells. Larger: more slow steps.
/// Smaller: one slow step causes a new factorisation.
const SLOW_STEPS_BEFORE_SHARPENING: usize = 2;

/// Relative change of the mean square of the residual over 50 steps below which the gradient method ends; the RMS
/// changes by half of it. The corrections of its result end if one changes the mean square by less. Larger: earlier
/// end, larger residual. Smaller: more steps.
const STAGNATION: f64 = 2e-4;

/// Fraction of the natural residual that a step of the two-level method may leave. Larger: more corrections by the
/// exact gradient. Smaller: more products with H~ per step.
const RESIDUAL_FRACTION_TWO_LEVEL: f64 = 0.1;

/// Fraction of the natural residual that gradient steps may leave. It is smaller than that of the two-level method
/// because gradient steps are more expensive to restart.
const RESIDUAL_FRACTION_GRADIENT: f64 = 0.01;

/// Largest number of rounds that continue without bounds before the surrogate finds other sets. Larger: more rounds
/// with a set of free dwell times that may be wrong. Smaller: more searches for sets.
const MAX_ROUNDS_WITHOUT_BOUNDS: usize = 3;

/// Decrease of (1) that a step promises, as a fraction of (1), up to which it is rounding and the steps end. Larger:
/// an earlier end. Smaller: steps that only rounding decides.
const STEP_ROUNDING: f64 = 1e-15;

/// Length of the best step, over the whole step, above which the whole step is taken. Only a whole step puts the
/// components that the surrogate has at their bounds on these bounds. Larger: more steps that stop short of the
/// bounds. Smaller: whole steps that lower (1) less, or raise it.
const WHOLE_STEP_FROM: f64 = 0.6;

/// Distance of a dwell time from its bound, as a fraction of the dwell time, up to which the difference is rounding.
/// Larger: free dwell times count as being at a bound. Smaller: rounding makes bound ones free.
const BOUND_ROUNDING: f64 = 1e-13;

/// State of the iteration.
pub struct Iterate {
    pub t: Vec<f64>,
    /// B t.
    pub removal_nm: Array2<f64>,
    /// Sets of free dwell times that were solved for with H~, or products with it.
    pub iterations: usize,
    /// Steps of H~.
    pub corrections: usize,
    pub natural_residual: f64,
    pub relative_gap: Option<f64>,
    pub end: End,
}

impl BoundedProblem<'_> {
    /// Minimises (1) by steps of its surrogate:
    ///
    /// ```text
    /// repeat  q = gradient of (1) at t                           exact
    ///         d = argmin q'd + d'H~d / 2,  lo <= t + d <= hi     by H~
    ///         p = argmin of (1) over t + a d + b p, clipped      exact
    ///         t += p
    /// ```
    ///
    /// Where the two-level method finds d, the next one is by [`Self::without_bounds`].
    ///
    /// d is a descent direction whatever H~ is, and vanishes only at the minimum of (1). With the
    /// step before, p, this is the conjugate gradient method preconditioned by H~ as soon as the
    /// components at their bounds are settled. With a Huber loss every q has the weights of its own
    /// residual ([`huber_weights`]).
    pub(super) fn minimise(&mut self, slope_weight: f64) -> Result<Iterate, DwellError> {
        self.minimise_by(&Settings { slope_weight, ..*self.settings }, MAX_CORRECTIONS)
    }

    /// Brings the two-level method near the minimum by easier problems, and returns the number of products with their
    /// surrogates. Larger weights of the penalty make the dwell times smoother, so that wider splines and larger
    /// cells can represent them. Fewer and cheaper steps then find the dwell times at their bounds. Some percent of
    /// these change afterwards.
    ///
    /// Does nothing for other methods, or where a guess is given.
    pub(super) fn approach(&mut self, slope_weight: f64) -> Result<usize, DwellError> {
        let (cell, Some(pitch_mm)) = (self.cell, self.splines_mm) else { return Ok(0) };
        if self.is_guessed {
            return Ok(0);
        }
        let mut iterations = 0;
        for (k, (weight, splines)) in ROUGH_PROBLEMS.into_iter().enumerate() {
            let tikhonov = weight * self.settings.tikhonov;
            if tikhonov > MAX_ROUGH_TIKHONOV {
                continue;
            }
            let cells = (ROUGH_CELLS * cell, Some(splines * pitch_mm));
            let surrogate = self.convolved(cells)?;
            let fine = std::mem::replace(&mut self.surrogate, surrogate);
            let settings =
                Settings { tikhonov, slope_weight: weight * slope_weight, ..*self.settings };
            let corrections = match settings.huber_nm {
                Some(_) => ROUGH_CORRECTIONS_HUBER,
                None => ROUGH_CORRECTIONS,
            };
            let found = progress::part(k, 2 * ROUGH_PROBLEMS.len(), || {
                self.minimise_by(&settings, corrections)
            });
            self.surrogate = fine;
            let found = found?;
            iterations += found.iterations;
            self.start = found.t;
        }
        Ok(iterations)
    }

    /// [`Self::minimise`] with the weights and limits of these settings, in at most so many corrections.
    fn minimise_by(
        &mut self,
        settings: &Settings,
        max_corrections: usize,
    ) -> Result<Iterate, DwellError> {
        let weights = settings.penalty_weights();
        let penalty = Penalty::new(self.path, self.lo, &self.scale, &weights);
        let own = penalty.diagonal();
        let diagonal: Vec<f64> = (0..own.len())
            .map(|j| if self.reached[j] { self.diagonal[j] + own[j] } else { 0.0 })
            .collect();
        let grid = *self.desired.grid();
        let mut basis = Basis::new(&grid, &self.weight, settings.free);
        let mut weight = self.weight.clone();
        let slope_term =
            settings.residual_slope.map(|slope| SlopeTerm::new(&slope, &grid, &self.weight));
        let mut t = self.start.clone();
        let mut removal_nm = if t.iter().all(|t| *t == 0.0) {
            Array2::zeros(self.z.dim())
        } else {
            self.b.apply(&t)
        };
        let (mut iterations, mut corrections, mut slow) = (0, 0, 0);
        let mut residual_before = f64::INFINITY;
        let mut first_gap = None;
        let (mut before, mut settled): (Option<(Vec<f64>, Array2<f64>)>, _) = (None, None);
        let (mut unbounded, mut rounds): (Option<Unbounded>, _) = (None, 0);
        // The factorised H~ with the penalty.
        let mut penalised: Option<Penalised> = None;
        // Largest lower bound of (1).
        let mut bound = f64::NEG_INFINITY;
        loop {
            if let Some(k) = settings.huber_nm.filter(|_| corrections > 0) {
                // That of before is one of other weights.
                bound = f64::NEG_INFINITY;
                let mut r = &self.z - &removal_nm;
                basis.project(&weight, &mut r);
                weight = huber_weights(&self.weight, &r, k);
                basis = Basis::new(&grid, &weight, settings.free);
            }
            let weighted = Weighted {
                penalty: &penalty,
                basis: &basis,
                weight: &weight,
                quadratic: self.quadratic,
                slope: slope_term.as_ref(),
            };
            let (objective, q) = weighted.at(self, &t, &removal_nm);
            let natural_residual = bounded::natural_residual(&t, &q, &diagonal, self.lo, &self.hi);
            let relative_gap = self.gap(&penalty, &t, &q).map(|gap| {
                bound = bound.max(objective - gap);
                (objective - bound).max(0.0) / objective.max(f64::MIN_POSITIVE)
            });
            let usual = (corrections as f64 / USUAL_CORRECTIONS).min(BEFORE_LAST);
            let proven = relative_gap.map_or(0.0, |gap| {
                let first = *first_gap.get_or_insert(gap);
                progress::of_convergence(first, gap, settings.relative_gap)
            });
            progress::done(usual.max(proven));
            // Where there is a gap it decides, and how far a dwell time would still move where no step falls any more.
            let is_still = natural_residual <= settings.tolerance_s;
            let proven = relative_gap.map_or(is_still, |gap| gap <= settings.relative_gap);
            let mut end = if proven || (is_still && settled.is_some()) {
                Some(End::Optimal)
            } else {
                settled
            };
            if end.is_none() && corrections >= max_corrections {
                end = Some(End::IterationLimit);
            }
            slow = if natural_residual > SLOW_RESIDUAL_FRACTION * residual_before {
                slow + 1
            } else {
                0
            };
            residual_before = natural_residual;
            let factorised = matches!(self.surrogate, Surrogate::Ordered(_));
            if slow >= SLOW_STEPS_BEFORE_SHARPENING && factorised && end.is_none() {
                slow = 0;
                self.sharpen(&penalty);
                penalised = None;
            }
            // d by what is found without bounds, or by H~; where that is singular, by smaller cells
            let (mut to, mut free) = (None, None);
            if let Some(from) = unbounded.take().filter(|_| end.is_none()) {
                let most = settings.max_iterations.saturating_sub(iterations);
                let wanted = (settings.relative_gap, most);
                let found = self.without_bounds(&weighted, from, objective, wanted);
                iterations += found.products;
                bound = bound.max(found.bound);
                if let Some(found) = found.end {
                    let found_to = bounded::clip(&found.t, self.lo, &self.hi);
                    if -slope(&q, &t, &found_to) > STEP_ROUNDING * objective {
                        (to, free) = (Some(found_to), Some(found.free));
                    }
                }
            }
            while end.is_none() && to.is_none() {
                match &mut self.surrogate {
                    Surrogate::Ordered(h) => {
                        let h = penalised.get_or_insert_with(|| h.penalised(&penalty));
                        if let Some((found, count)) = h.minimum(&t, &q, self.lo, &self.hi) {
                            (to, iterations) = (Some(found), iterations + count);
                        } else if self.sharpen(&penalty) || self.without_factors(&penalty)? {
                            penalised = None;
                        } else {
                            return Err(DwellError::Singular { tikhonov: settings.tikhonov });
                        }
                    }
                    Surrogate::Convolved(h) => {
                        let steps = GradientSettings {
                            tolerance: if self.splines_mm.is_none() {
                                (RESIDUAL_FRACTION_GRADIENT * natural_residual)
                                    .max(0.5 * settings.tolerance_s)
                            } else {
                                RESIDUAL_FRACTION_TWO_LEVEL * natural_residual
                            },
                            max_iterations: settings.max_iterations.saturating_sub(iterations),
                            stagnation: STAGNATION,
                            offset: objective,
                        };
                        let bounds = (self.lo, self.hi.as_slice());
                        let found = h.minimum(&penalty, &t, &q, &self.reached, bounds, &steps);
                        (to, iterations) = (Some(found.t), iterations + found.iterations);
                        // With a Huber loss the next q has other weights.
                        unbounded = found.unbounded.filter(|_| settings.huber_nm.is_none());
                        if iterations >= settings.max_iterations {
                            end = Some(End::IterationLimit);
                        }
                    }
                }
            }
            let to = to.unwrap_or_else(|| t.clone());
            let slope = slope(&q, &t, &to);
            if end.is_none() && -slope <= STEP_ROUNDING * objective {
                end = Some(if is_still { End::Optimal } else { End::Stagnated });
            }
            if let Some(end) = end {
                return Ok(Iterate {
                    t,
                    removal_nm,
                    iterations,
                    corrections,
                    natural_residual,
                    relative_gap,
                    end,
                });
            }
            let d: Vec<f64> = to.iter().zip(&t).map(|(to, t)| to - t).collect();
            let d_nm = self.b.apply(&d);
            let curvature = weighted.curvature(&d, &d_nm);
            // The whole step lands on the bounds: nearly whole is made whole.
            let s = -slope / curvature;
            let s = if s > WHOLE_STEP_FROM { 1.0 } else { s };
            let mut fall = -s * slope - 0.5 * s * s * curvature;
            let mut step: Vec<f64> = d.iter().map(|d| s * d).collect();
            let mut step_nm = scaled(&d_nm, s);
            if let Some((p, p_nm)) = &before {
                let [a, b] = weighted.plane_minimum(&q, (&d, &d_nm, curvature), (p, p_nm));
                let wanted: Vec<f64> = d.iter().zip(p).map(|(d, p)| a * d + b * p).collect();
                // B e = a B d + b B p + B (what was clipped: few columns)
                let clipped = |j: usize| match t[j] + wanted[j] {
                    to if to < self.lo[j] => self.lo[j] - t[j],
                    to if to > self.hi[j] => self.hi[j] - t[j],
                    _ => wanted[j],
                };
                let e: Vec<f64> = (0..t.len()).map(clipped).collect();
                let left_out: Vec<f64> = e.iter().zip(&wanted).map(|(e, w)| e - w).collect();
                let mut e_nm = scaled(&d_nm, a);
                add_scaled(&mut e_nm, b, p_nm);
                if left_out.iter().any(|w| *w != 0.0) {
                    add_scaled(&mut e_nm, 1.0, &self.b.apply(&left_out));
                }
                let other = -dot(&q, &e) - 0.5 * weighted.curvature(&e, &e_nm);
                if other > fall {
                    (fall, step, step_nm) = (other, e, e_nm);
                }
            }
            let by_gradient =
                matches!(self.surrogate, Surrogate::Convolved(_)) && self.splines_mm.is_none();
            // The exact step of a descent direction falls but for rounding.
            let enough = if by_gradient { STAGNATION * objective } else { 0.0 };
            if fall <= enough && free.is_none() {
                settled = Some(End::Stagnated);
            }
            if fall <= 0.0 {
                continue;
            }
            for j in 0..t.len() {
                t[j] = snapped(t[j] + step[j], self.lo[j], self.hi[j]);
            }
            add_scaled(&mut removal_nm, 1.0, &step_nm);
            // Where it was without bounds it may be so again, with those dwell times at their bounds that were beyond them.
            if let Some(mut free) = free.filter(|_| rounds < MAX_ROUNDS_WITHOUT_BOUNDS) {
                (0..t.len()).for_each(|j| free[j] &= self.lo[j] < t[j] && t[j] < self.hi[j]);
                unbounded = Some(Unbounded { t: t.clone(), free });
                rounds += 1;
            } else {
                rounds = 0;
            }
            // What goes on without bounds does not need it.
            before = unbounded.is_none().then_some((step, step_nm));
            corrections += 1;
        }
    }
}

/// Weights with which the gradient of the weighted squares is that of the Huber loss: `w min(k / |r|, 1)`,
/// for the residual r without its free part.
pub(super) fn huber_weights(weight: &Array2<f64>, r: &Array2<f64>, k: f64) -> Array2<f64> {
    Zip::from(weight).and(r).map_collect(|w, r| w * (k / r.abs()).min(1.0))
}

/// Slope of the objective along the step d = to - t of the dwell times: `q'd`, with its gradient q.
fn slope(q: &[f64], t: &[f64], to: &[f64]) -> f64 {
    q.iter().zip(to.iter().zip(t)).map(|(q, (to, t))| q * (to - t)).sum()
}

/// `t` within its bounds, and on them where it differs by rounding.
fn snapped(t: f64, lo: f64, hi: f64) -> f64 {
    let rounding = BOUND_ROUNDING * t.abs().max(lo.abs());
    match t {
        t if t <= lo + rounding => lo,
        t if t >= hi - rounding => hi,
        t => t,
    }
}
