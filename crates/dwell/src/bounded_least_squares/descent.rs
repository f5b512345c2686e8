//! The states of the descent of [`super::minimise`]. One step goes through all of them:
//!
//! ```text
//! reweigh --> look --> target --> advance --> reweigh ...
//!               |         |
//!               +---------+--> an end
//! ```
//!
//! | state | transition |
//! |---|---|
//! | reweigh | with a Huber loss the pixels get the weights of their own residual |
//! | look | computes the exact objective, its gradient q and the gap at t, and decides whether the descent ends |
//! | target | finds dwell times with a smaller objective, by H~ or without bounds; or ends |
//! | advance | goes to the exact minimum on the way there |

use ndarray::Array2;
use planish_numerics::{
    linear::skyline::dot,
    qp::bounded::{self, GradientSettings},
};
use planish_types::{End, Grid, progress};

use super::{
    prepared::BoundedProblem,
    settings::BoundedSettings,
    weighted::{Weighted, huber_weights},
};
use crate::{
    DwellError,
    objective::{Basis, Penalty},
    residual_slope::SlopeTerm,
    surrogate::{Penalised, Surrogate, Unbounded},
};

/// Usual number of corrections (steps by the surrogate) of a problem, for the estimate of the remaining time only.
/// Larger: the progress starts slower and ends with a jump. Smaller: it waits before its end.
const USUAL_CORRECTIONS: f64 = 6.0;
/// Largest fraction of the progress that is reported before the end, for the estimate of the remaining time only.
const BEFORE_LAST: f64 = 0.9;

/// Fraction of the natural residual before a step; a step that leaves more than this counts as slow. Larger: fewer
/// steps count as slow. Smaller: the surrogate gets smaller cells earlier, and costs more.
const SLOW_RESIDUAL_FRACTION: f64 = 0.5;

/// Number of slow steps in a row after which the factorised surrogate gets smaller cells. Larger: more slow steps.
/// Smaller: one slow step causes a new factorisation.
const SLOW_STEPS_BEFORE_SHARPENING: usize = 2;

/// Relative decrease of the objective over 50 gradient steps below which the gradient method ends; the RMS changes by
/// about half of it. The descent ends, too, if one step of the gradient method lowers the objective by less. Larger:
/// earlier end, larger residual. Smaller: more steps.
const STAGNATION: f64 = 2e-4;

/// Fraction of the natural residual that the search for a step by the two-level method may leave. Larger: more
/// corrections by the exact gradient. Smaller: more products with H~ per step.
const RESIDUAL_FRACTION_TWO_LEVEL: f64 = 0.1;

/// Fraction of the natural residual that the search for a step by gradient steps may leave. It is smaller than that of
/// the two-level method because gradient steps are more expensive to restart.
const RESIDUAL_FRACTION_GRADIENT: f64 = 0.01;

/// Largest number of steps in a row that are found without bounds before the surrogate chooses the free dwell times
/// again. Larger: more steps with a set of free dwell times that may be wrong. Smaller: more searches for sets.
const MAX_ROUNDS_WITHOUT_BOUNDS: usize = 3;

/// Decrease of the objective (1) that a step promises, as a fraction of (1), up to which it is rounding and the steps
/// end. Larger: an earlier end. Smaller: steps that only rounding decides.
const STEP_ROUNDING: f64 = 1e-15;

/// Length of the best step, over the whole step, above which the whole step is taken. Only a whole step puts the dwell
/// times that are at bounds in the minimum of the surrogate on these bounds. Larger: more steps that stop short of the
/// bounds. Smaller: whole steps that lower (1) less, or raise it.
const WHOLE_STEP_FROM: f64 = 0.6;

/// Distance of a dwell time from its bound, as a fraction of the dwell time, up to which the difference is rounding.
/// Larger: free dwell times count as being at a bound. Smaller: rounding makes bound ones free.
const BOUND_ROUNDING: f64 = 1e-13;

/// Terms of the objective (1) other than the columns: its penalty, its free functions, the present weights of the
/// pixels, and the slope term.
struct Terms {
    penalty: Penalty,
    basis: Basis,
    weight: Array2<f64>,
    slope: Option<SlopeTerm>,
}

impl Terms {
    /// Returns the objective (1) of a problem with these terms.
    fn weighted<'a>(&'a self, problem: &BoundedProblem<'a>) -> Weighted<'a> {
        Weighted {
            penalty: &self.penalty,
            basis: &self.basis,
            weight: &self.weight,
            quadratic: problem.quadratic,
            slope: self.slope.as_ref(),
        }
    }
}

/// A step of the dwell times (n), s, with the removal (ny, nx) that it adds, nm.
type Step = (Vec<f64>, Array2<f64>);

/// The descent to the minimum of (1), with everything that one state of the module hands to the next.
pub struct Descent<'s> {
    settings: &'s BoundedSettings,
    grid: Grid,
    terms: Terms,
    /// Diagonal of the normal matrix H (n); 0 for unreached columns.
    diagonal: Vec<f64>,
    /// Present dwell times (n), s.
    pub t: Vec<f64>,
    /// Removal B t of these dwell times (ny, nx), nm.
    pub removal_nm: Array2<f64>,
    /// Number of sets of free dwell times that were solved for with the factorised surrogate H~, plus that of products
    /// or gradient steps with the other one.
    pub iterations: usize,
    /// Number of steps found by the surrogate H~, each corrected by the exact gradient.
    pub corrections: usize,
    /// Number of slow steps in a row, and the natural residual before the last step, s.
    slow: (usize, f64),
    first_gap: Option<f64>,
    /// Largest lower bound of the minimum of (1) that was proven so far; minus infinity before the first one.
    bound: f64,
    /// Reason to end at the next call of [`Self::look`]; `None` unless the last step changed the objective too little.
    settled: Option<End>,
    /// Last step, for the plane of the next one; `None` at the start, or if the next step goes on without bounds.
    before: Option<Step>,
    /// Dwell times from which the next step goes on without bounds; `None` if it goes by the surrogate.
    unbounded: Option<Unbounded>,
    rounds_without_bounds: usize,
    /// The factorised surrogate H~ with the matrix of the penalty.
    penalised: Option<Penalised>,
}

/// Exact objective (1) and its gradient at the present dwell times, and the decision whether the descent ends there.
pub struct Look {
    /// Value of (1), nm^2 times the weights of the pixels.
    pub objective: f64,
    gradient: Vec<f64>,
    /// Natural residual: the largest change of a dwell time in a projected gradient step, s; 0 at the minimum.
    pub natural_residual: f64,
    /// Proven distance of the objective from its minimum, relative to the objective; `None` if alpha is 0.
    pub relative_gap: Option<f64>,
    /// True if the natural residual is at most `tolerance_s` of the settings.
    is_still: bool,
    /// Reason for which the descent ends here; `None` if it goes on.
    pub end: Option<End>,
}

/// Result of the search for a step.
pub enum Target {
    /// Dwell times towards which the objective falls, and the mask of the free ones if they were found without bounds
    /// (`None` by the surrogate).
    To(Vec<f64>, Option<Vec<bool>>),
    /// Reason for which the descent ends, because there are no such dwell times.
    End(End),
}

impl<'s> Descent<'s> {
    /// Starts the descent at the first dwell times of a problem.
    pub fn new(problem: &BoundedProblem<'_>, settings: &'s BoundedSettings) -> Self {
        let penalty = problem.penalty(&settings.penalty_weights());
        let own = penalty.diagonal();
        let diagonal = (0..own.len())
            .map(|j| if problem.reached[j] { problem.diagonal[j] + own[j] } else { 0.0 })
            .collect();
        let grid = *problem.desired.grid();
        let weight = &problem.weight;
        let terms = Terms {
            penalty,
            basis: Basis::new(&grid, weight, settings.free),
            weight: weight.clone(),
            slope: settings.residual_slope.map(|slope| SlopeTerm::new(&slope, &grid, weight)),
        };
        let t = problem.start.clone();
        let removal_nm = if t.iter().all(|t| *t == 0.0) {
            Array2::zeros(problem.z.dim())
        } else {
            problem.b.apply(&t)
        };
        Self {
            settings,
            grid,
            terms,
            diagonal,
            t,
            removal_nm,
            iterations: 0,
            corrections: 0,
            slow: (0, f64::INFINITY),
            first_gap: None,
            bound: f64::NEG_INFINITY,
            settled: None,
            before: None,
            unbounded: None,
            rounds_without_bounds: 0,
            penalised: None,
        }
    }

    /// Gives every pixel the Huber weight of its present residual. Does nothing without a Huber loss or before the
    /// first step.
    pub fn reweigh(&mut self, problem: &BoundedProblem<'_>) {
        if self.corrections > 0 {
            self.weigh_by_residual(problem);
        }
    }

    /// Returns true if the loss is Huber's and the pixels still have the weights of the map. An end with these is one of
    /// another problem.
    pub fn lacks_huber_weights(&self) -> bool {
        self.settings.huber_nm.is_some() && self.corrections == 0
    }

    /// Gives every pixel the Huber weight of its present residual. Does nothing without a Huber loss.
    pub fn weigh_by_residual(&mut self, problem: &BoundedProblem<'_>) {
        let Some(k) = self.settings.huber_nm else { return };
        // That of before is one of other weights.
        self.bound = f64::NEG_INFINITY;
        let mut r = &problem.z - &self.removal_nm;
        self.terms.basis.project(&self.terms.weight, &mut r);
        self.terms.weight = huber_weights(&problem.weight, &r, k);
        self.terms.basis = Basis::new(&self.grid, &self.terms.weight, self.settings.free);
    }

    /// Computes the exact objective and gradient, and decides whether the descent ends here, at the latest after
    /// `max_corrections` steps.
    pub fn look(&mut self, problem: &BoundedProblem<'_>, max_corrections: usize) -> Look {
        let settings = self.settings;
        let weighted = self.terms.weighted(problem);
        let (objective, gradient) = weighted.evaluate(problem, &self.t, &self.removal_nm);
        let lo = problem.lo;
        let hi = &problem.hi;
        let natural_residual =
            bounded::natural_residual(&self.t, &gradient, &self.diagonal, lo, hi);
        let relative_gap = problem.gap(&self.terms.penalty, &self.t, &gradient).map(|gap| {
            self.bound = self.bound.max(objective - gap);
            (objective - self.bound).max(0.0) / objective.max(f64::MIN_POSITIVE)
        });
        self.tell_progress(relative_gap);
        // Where there is a gap it decides, and how far a dwell time would still move where no step falls any more.
        let is_still = natural_residual <= settings.tolerance_s;
        let proven = relative_gap.map_or(is_still, |gap| gap <= settings.relative_gap);
        let end = match self.settled {
            _ if proven => Some(End::Optimal),
            Some(_) if is_still => Some(End::Optimal),
            None if self.corrections >= max_corrections => Some(End::IterationLimit),
            settled => settled,
        };
        Look { objective, gradient, natural_residual, relative_gap, is_still, end }
    }

    /// Reports the progress: by the number of corrections, or by the proven gap, whichever is further.
    fn tell_progress(&mut self, relative_gap: Option<f64>) {
        let usual = (self.corrections as f64 / USUAL_CORRECTIONS).min(BEFORE_LAST);
        let proven = relative_gap.map_or(0.0, |gap| {
            let first = *self.first_gap.get_or_insert(gap);
            progress::of_convergence(first, gap, self.settings.relative_gap)
        });
        progress::done(usual.max(proven));
    }

    /// Finds dwell times towards which the objective falls: without bounds if the last step left a start for that,
    /// otherwise by the surrogate H~. Ends if the objective would fall by rounding only.
    ///
    /// # Errors
    /// Refuses a problem whose H~ is singular in every form.
    pub fn target(
        &mut self,
        problem: &mut BoundedProblem<'_>,
        look: &Look,
    ) -> Result<Target, DwellError> {
        self.sharpen_where_slow(problem, look);
        let target = match self.without_bounds(problem, look) {
            Some(target) => target,
            None => self.by_surrogate(problem, look)?,
        };
        let Target::To(to, _) = &target else { return Ok(target) };
        if -slope(&look.gradient, &self.t, to) <= STEP_ROUNDING * look.objective {
            return Ok(Target::End(if look.is_still { End::Optimal } else { End::Stagnated }));
        }
        Ok(target)
    }

    /// Gives the factorised surrogate smaller cells of pixels after [`SLOW_STEPS_BEFORE_SHARPENING`] slow steps.
    fn sharpen_where_slow(&mut self, problem: &mut BoundedProblem<'_>, look: &Look) {
        let (count, before) = self.slow;
        let is_slow = look.natural_residual > SLOW_RESIDUAL_FRACTION * before;
        self.slow = (if is_slow { count + 1 } else { 0 }, look.natural_residual);
        let factorised = matches!(problem.surrogate, Surrogate::Ordered(_));
        if self.slow.0 >= SLOW_STEPS_BEFORE_SHARPENING && factorised {
            self.slow.0 = 0;
            problem.sharpen(&self.terms.penalty);
            self.penalised = None;
        }
    }

    /// Minimises the objective without bounds, from the dwell times that the last step has left for it, and puts the
    /// result within the bounds. Returns `None` if there are no such dwell times, if the bounds cost too much, or if
    /// the objective would not fall.
    fn without_bounds(&mut self, problem: &mut BoundedProblem<'_>, look: &Look) -> Option<Target> {
        let from = self.unbounded.take()?;
        let most = self.settings.max_iterations.saturating_sub(self.iterations);
        let wanted = (self.settings.relative_gap, most);
        let weighted = self.terms.weighted(problem);
        let unbounded = problem.without_bounds(&weighted, from, look.objective, wanted);
        self.iterations += unbounded.products;
        self.bound = self.bound.max(unbounded.bound);
        let end = unbounded.end?;
        let to = bounded::clip(&end.t, problem.lo, &problem.hi);
        let falls = -slope(&look.gradient, &self.t, &to) > STEP_ROUNDING * look.objective;
        if falls { Some(Target::To(to, Some(end.free))) } else { None }
    }

    /// Finds the minimum of the surrogate H~ within the bounds. If a factorised H~ is singular, uses one with smaller
    /// cells, or one that is not factorised. Ends if the limit of the iterations is reached.
    fn by_surrogate(
        &mut self,
        problem: &mut BoundedProblem<'_>,
        look: &Look,
    ) -> Result<Target, DwellError> {
        let penalty = &self.terms.penalty;
        loop {
            match &mut problem.surrogate {
                Surrogate::Ordered(h) => {
                    let h = self.penalised.get_or_insert_with(|| h.penalised(penalty));
                    let minimum = h.minimum(&self.t, &look.gradient, problem.lo, &problem.hi);
                    if let Some((to, count)) = minimum {
                        self.iterations += count;
                        return Ok(Target::To(to, None));
                    }
                    if !(problem.sharpen(penalty) || problem.without_factors(penalty)?) {
                        let tikhonov = self.settings.tikhonov;
                        return Err(DwellError::Singular { tikhonov });
                    }
                    self.penalised = None;
                }
                Surrogate::Convolved(h) => {
                    let steps = self.gradient_settings(problem.splines_mm, look);
                    let bounds = (problem.lo, problem.hi.as_slice());
                    let t = &self.t;
                    let q = &look.gradient;
                    let reached = &problem.reached;
                    let minimum = h.minimum(penalty, t, q, reached, bounds, &steps);
                    self.iterations += minimum.iterations;
                    // With a Huber loss the next q has other weights.
                    self.unbounded = minimum.unbounded.filter(|_| self.settings.huber_nm.is_none());
                    if self.iterations >= self.settings.max_iterations {
                        return Ok(Target::End(End::IterationLimit));
                    }
                    return Ok(Target::To(minimum.t, None));
                }
            }
        }
    }

    /// Returns the conditions at which the search for the minimum of H~ ends: for gradient steps, or for the two-level
    /// method if there is a pitch of splines.
    fn gradient_settings(&self, splines_mm: Option<f64>, look: &Look) -> GradientSettings {
        GradientSettings {
            tolerance: match splines_mm {
                None => (RESIDUAL_FRACTION_GRADIENT * look.natural_residual)
                    .max(0.5 * self.settings.tolerance_s),
                Some(_) => RESIDUAL_FRACTION_TWO_LEVEL * look.natural_residual,
            },
            max_iterations: self.settings.max_iterations.saturating_sub(self.iterations),
            stagnation: STAGNATION,
            offset: look.objective,
        }
    }

    /// Moves by the step of [`Self::best_step`] to the dwell times `to` (`free` as in [`Target::To`]). Notes an end if
    /// the objective falls too little; does not move if it does not fall.
    pub fn advance(
        &mut self,
        problem: &BoundedProblem<'_>,
        look: &Look,
        (to, free): (Vec<f64>, Option<Vec<bool>>),
    ) {
        let (fall, (step, step_nm)) = self.best_step(problem, look, &to);
        let by_gradient =
            matches!(problem.surrogate, Surrogate::Convolved(_)) && problem.splines_mm.is_none();
        // The exact step of a descent direction falls but for rounding.
        let enough = if by_gradient { STAGNATION * look.objective } else { 0.0 };
        if fall <= enough && free.is_none() {
            self.settled = Some(End::Stagnated);
        }
        if fall <= 0.0 {
            return;
        }
        let lo = problem.lo;
        let hi = &problem.hi;
        for (j, t) in self.t.iter_mut().enumerate() {
            *t = snapped(*t + step[j], lo[j], hi[j]);
        }
        self.removal_nm.scaled_add(1.0, &step_nm);
        // Where it was without bounds it may be so again, with those dwell times at their bounds that were beyond them.
        match free.filter(|_| self.rounds_without_bounds < MAX_ROUNDS_WITHOUT_BOUNDS) {
            Some(mut free) => {
                let t = &self.t;
                (0..t.len()).for_each(|j| free[j] &= lo[j] < t[j] && t[j] < hi[j]);
                self.unbounded = Some(Unbounded { t: t.clone(), free });
                self.rounds_without_bounds += 1;
            }
            None => self.rounds_without_bounds = 0,
        }
        // What goes on without bounds does not need it.
        self.before = if self.unbounded.is_none() { Some((step, step_nm)) } else { None };
        self.corrections += 1;
    }

    /// Returns the better of two steps, with the decrease of the objective. One is the best step along the line to the
    /// dwell times `to`, made whole from [`WHOLE_STEP_FROM`] on. The other is the best one in the plane of that and the
    /// step before, clipped to the bounds.
    fn best_step(&self, problem: &BoundedProblem<'_>, look: &Look, to: &[f64]) -> (f64, Step) {
        let t = &self.t;
        let q = &look.gradient;
        let weighted = self.terms.weighted(problem);
        let slope = slope(q, t, to);
        let d: Vec<f64> = to.iter().zip(t).map(|(to, t)| to - t).collect();
        let d_nm = problem.b.apply(&d);
        let curvature = weighted.curvature(&d, &d_nm);
        // The whole step lands on the bounds: nearly whole is made whole.
        let s = -slope / curvature;
        let s = if s > WHOLE_STEP_FROM { 1.0 } else { s };
        let fall = -s * slope - 0.5 * s * s * curvature;
        let Some((p, p_nm)) = &self.before else { return (fall, scaled(s, &d, &d_nm)) };
        let [a, b] = weighted.plane_minimum(q, (&d, &d_nm, curvature), (p, p_nm));
        let wanted: Vec<f64> = d.iter().zip(p).map(|(d, p)| a * d + b * p).collect();
        // B e = a B d + b B p + B (what was clipped: few columns)
        let e: Vec<f64> = (0..t.len())
            .map(|j| match t[j] + wanted[j] {
                to if to < problem.lo[j] => problem.lo[j] - t[j],
                to if to > problem.hi[j] => problem.hi[j] - t[j],
                _ => wanted[j],
            })
            .collect();
        let left_out: Vec<f64> = e.iter().zip(&wanted).map(|(e, w)| e - w).collect();
        let mut e_nm = a * &d_nm;
        e_nm.scaled_add(b, p_nm);
        if left_out.iter().any(|w| *w != 0.0) {
            e_nm.scaled_add(1.0, &problem.b.apply(&left_out));
        }
        let other = -dot(q, &e) - 0.5 * weighted.curvature(&e, &e_nm);
        if other > fall { (other, (e, e_nm)) } else { (fall, scaled(s, &d, &d_nm)) }
    }
}

/// Returns the step `s d` and its removal, from the step d and its removal `d_nm`.
fn scaled(s: f64, d: &[f64], d_nm: &Array2<f64>) -> Step {
    (d.iter().map(|d| s * d).collect(), s * d_nm)
}
/// Returns the slope of the objective along the step d = to - t of the dwell times: `q'd`, with its gradient q.
fn slope(q: &[f64], t: &[f64], to: &[f64]) -> f64 {
    q.iter().zip(to.iter().zip(t)).map(|(q, (to, t))| q * (to - t)).sum()
}

/// Returns the dwell time `t` within its bounds, and exactly on a bound from which it differs by rounding only.
fn snapped(t: f64, lo: f64, hi: f64) -> f64 {
    let rounding = BOUND_ROUNDING * t.abs().max(lo.abs());
    match t {
        t if t <= lo + rounding => lo,
        t if t >= hi - rounding => hi,
        t => t,
    }
}
