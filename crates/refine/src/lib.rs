//! Correction of dwell times against the removal of the motion that will run.
//!
//! A dwell solver assumes that the tool stands at points or moves uniformly along chords; the
//! machine executes a curve. So, starting from a dwell time `t`:
//!
//! ```text
//! repeat   P = schedule(t)                     the motion, within the limits
//!          h = time of every segment in P      t, where the scheduler did not change it
//!          e = RMS of the residual of P        simulated: what will be executed
//!          if e is the smallest so far:        t*, P* = h, P
//!            lo_j = max(lo_j, h_j) where h_j > t_j   the machine's need becomes a lower bound
//!            B_ij = mean over the time of segment j of R(x_i - P*(u))   what a second there removes
//!            t^ = bounded least squares with B, lo, and less smoothness than before
//!          else: s = s / 2
//!          t = t* + s (t^ - t*)
//! until    e falls by less than a fraction, or s is spent
//! ```
//!
//! The operator B must be that of the executed motion: a fixed one converges on gentle paths and
//! diverges where the curve leaves the chords. B holds for its own curve, but t^ changes the curve, and
//! a rougher correction changes it more. So two settings limit a correction. The fraction s of the step
//! is halved until the executed residual falls, and doubled if it falls at the first try. The
//! smoothness falls from round to round to its last value, because the first corrections change the
//! plan most.
//!
//! It can happen that no part of a correction lowers the executed residual, although B predicted a decrease by a
//! tenth or more. Then t^ is outside the range of B, or the machine cannot follow it. The next correction is
//! smoother, and its lower bounds are the times that the machine needed at every try. The loop ends only if
//! smoother corrections fail, too.
//!
//! The result is the iterate of the smallest `e` that keeps the limits, which need not be the last.
//! With a price `lambda` on the total time T, `sqrt(e^2 + 2 lambda T)` replaces `e`; its square is twice
//! the objective of the dwell solver. With a noise level the first correction chooses the smoothness at
//! which the residual reaches the noise, and all corrections keep it.
//!
//! With an error budget ([`error_budget`]) the loop goes on from its result. The expected square replaces e^2: the
//! errors of the process add a quadratic t'Q t of the dwell times. The additional removal by its fixed errors is
//! subtracted from the map.
//!
//! The scheduler is any [`Scheduler`] of `planish schedule`. It states h: the time of every segment that is not its
//! dwell time. A segment that takes less than its dwell time (`trig-spline` gives the time of a segment without length
//! to its neighbours) has that time in h, and raises no bound.
//!
//! This crate calls `planish simulate` and `planish verify` as they are, so that its residual and its
//! limits are those that both report of the trajectory that it writes.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | t, h | `dwell_s` | (n) | s |
//! | P | `trajectory` | (k, 2, 4) | mm |
//! | e | `rms_nm` | - | nm |
//! | t^, s | `proposed_s`, `step_fraction` | (n), - | s, 1 |

// The command line names this library as any other program does.
extern crate self as planish_refine;

mod cli;
pub mod command;
pub mod error_budget;
pub mod trade_off;

use ndarray::Array2;
use planish_dwell::{
    DwellError,
    bounded_least_squares::{self as dwell_solver, Product, Program},
    columns,
};
use planish_schedule::{ScheduleError, Scheduled, Scheduler, pvt};
use planish_simulate::{SimulationPlan, SimulationSettings};
use planish_tolerance::quadratic::{Quadratic, Sources};
use planish_types::{
    DwellTime, End, Invalid, Limits, OnLattice, PARTS_TOLERANCE, Surface, Tif, TifLattice,
    ToolPath, Trajectory,
    plausible::{self, Rms},
    progress as work,
};
use planish_verify::{VerifySettings, verify};
use serde::{Serialize, Serializer};

/// Settings of the closed loop of schedule and correction.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct RefineSettings<'a> {
    /// Scheduler that makes the motion of the dwell times.
    #[serde(serialize_with = "name_and_kind")]
    pub scheduler: &'a dyn Scheduler,
    /// Settings of the dwell solver. Its columns (removal by a second at each dwell point) apply to the first plan, its
    /// smoothness (`slope_weight`) to the last corrections.
    pub dwell: dwell_solver::BoundedSettings,
    /// Smoothness (slope weight of the dwell solver) of the first correction; it falls to that of `dwell`. Larger: more
    /// rounds, and a larger residual along random paths (docs/refine.md). Smaller: the first corrections are too rough
    /// for their operator, and more tries fail.
    pub first_smoothness: f64,
    /// Largest number of rounds of schedule and correction.
    pub max_rounds: usize,
    /// Smallest improvement on the best round that counts as progress, as a fraction of its objective
    /// [`Iterate::merit_nm`]. Larger: the loop ends earlier, with a larger residual. Smaller: more rounds for small
    /// gains.
    pub least_improvement: f64,
}

/// Writes the name of a scheduler, with the kind of its motion if it has several kinds.
fn name_and_kind<S: Serializer>(scheduler: &&dyn Scheduler, to: S) -> Result<S::Ok, S::Error> {
    match scheduler.kind() {
        None => to.serialize_str(scheduler.name()),
        Some(kind) => to.collect_map([(scheduler.name(), kind)]),
    }
}

impl Default for RefineSettings<'_> {
    fn default() -> Self {
        Self {
            scheduler: &pvt::PvtSettings {
                mode: pvt::Mode::Monotone,
                stretch: true,
                max_path_distance_mm: None,
            },
            dwell: dwell_solver::BoundedSettings {
                // The columns are those of the executed motion, so the smoothness need not make the dwell
                // times executable. The pull to the lower bound saves machine time.
                tikhonov: 2.78e-6,
                slope_weight: 7.72e-8,
                // RMS within 5e-4 of the smallest, relative: half of the improvement that counts as progress.
                relative_gap: 1e-3,
                ..dwell_solver::BoundedSettings::default()
            },
            first_smoothness: 2.31e-7,
            max_rounds: 50,
            least_improvement: 1e-3,
        }
    }
}

/// Reasons why the loop gives no plan.
#[derive(Debug, thiserror::Error)]
pub enum RefineError {
    /// The inputs do not belong together.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The dwell solver refused its inputs or failed.
    #[error(transparent)]
    Dwell(#[from] DwellError),
    /// The scheduler refused its inputs or failed.
    #[error(transparent)]
    Schedule(#[from] ScheduleError),
    /// The machine needs more time than the upper bound allows.
    #[error(
        "no plan within limits and bounds: the machine needs {needed_s:.6} s for segment {segment} \
         ({length_mm:.6} mm), its upper bound is {bound_s:.6} s; raise the upper bound or the limits"
    )]
    BoundBelowNeed {
        /// Index of the segment of the path.
        segment: usize,
        /// Length of the segment, mm.
        length_mm: f64,
        /// Time that the machine needs for the segment, s.
        needed_s: f64,
        /// Upper bound of the time of the segment, s.
        bound_s: f64,
    },
}

/// Results of one round: a schedule of dwell times and its simulation.
#[derive(Clone, Debug, PartialEq)]
pub struct Iterate {
    /// Time of every segment of the path in the motion, s.
    pub dwell_s: Vec<f64>,
    /// RMS of the executed residual about its mean, nm.
    pub rms_nm: f64,
    /// RMS of the executed residual with its best-fit plane removed, nm.
    pub detilted_nm: f64,
    /// Root of the expected mean square of the residual with an error budget, nm, without the part that does not depend
    /// on the dwell times ([`error_budget`]); `None` without an error budget.
    pub expected_rms_nm: Option<f64>,
    /// Objective of the loop, sqrt(rms^2 + 2 lambda T), nm, with the price lambda and the total time T. The noise
    /// replaces an RMS below it, and with an error budget the expected square replaces rms^2. If the slope of the
    /// residual has a weight, its weighted mean square is added to the square.
    pub merit_nm: f64,
    /// Total time of the motion, s.
    pub total_time_s: f64,
    /// Number of segments whose time the scheduler had to lengthen.
    pub stretched: usize,
    /// True if `planish verify` finds that the motion keeps the limits.
    pub limits_respected: bool,
}

impl Iterate {
    /// Returns the rank of the round; the round of lowest rank is the best. A plan that exceeds the limits ranks after
    /// all that keep them.
    fn rank(&self) -> (bool, f64) {
        (!self.limits_respected, self.merit_nm)
    }
}

/// Result of the loop: the best round, and all rounds.
#[derive(Clone, Debug)]
pub struct Refined {
    /// Dwell times of the best round: the times of the segments in `trajectory`.
    pub dwell: DwellTime,
    /// Motion of the best round.
    pub trajectory: Trajectory,
    /// Index of the best round in `iterates`.
    pub best: usize,
    /// All rounds; the first is the plan before any correction.
    pub iterates: Vec<Iterate>,
    /// Reason why the loop ended: `no-improvement` or `round-limit`.
    pub end: End,
    /// Number of dwell times of the best round at a bound: the upper bound, or the smallest time that the floor or the
    /// machine allows.
    pub at_bound: usize,
    /// Limits of the machine that the best round exceeds, in words; `None` if it keeps them.
    pub exceeded: Option<String>,
    /// Lower bounds after the best round, s: the floor, or the time that the machine needed.
    pub least_s: Vec<f64>,
    /// Lattice of the map on which the TIF was resampled; `None` if the TIF was used as it is.
    pub tif_lattice: Option<TifLattice>,
}

impl Refined {
    /// Returns the reason for a negative verdict: the best round exceeds the limits, the rounds were used up, or the
    /// plan is not worth its run, for example because it increases the error of `desired`. Returns `None` for a
    /// positive one. Using up the rounds is no reason if the user gave their number (`rounds_asked_for`).
    pub fn negative(&self, desired: &Surface, rounds_asked_for: bool) -> Option<String> {
        let best = &self.iterates[self.best];
        if let Some(exceeded) = &self.exceeded {
            Some(format!("no round keeps the limits of the machine: in the best one {exceeded}"))
        } else if self.end == End::RoundLimit && !rounds_asked_for {
            Some(format!(
                "not converged: {} rounds were done before they ceased to improve; the best plan is kept, \
                 and `max_rounds` allows more, or says that these are enough",
                self.iterates.len()
            ))
        } else {
            let after = Rms { rms_nm: best.rms_nm, detilted_nm: best.detilted_nm };
            plausible::drawback(Rms::of_surface(desired), after, best.total_time_s)
        }
    }
}

/// Factor on the smoothness from one correction to the next: half a decade. Larger: more rounds until the last
/// smoothness. Smaller: corrections that are too rough for their operator, and more failed tries.
const LESS_SMOOTHNESS: f64 = 0.316_227_766_016_837_94;
/// Fraction of the step towards a correction below which the correction is given up, dimensionless. Larger: corrections
/// are given up of which a small part would help. Smaller: more simulations of failed tries.
const LEAST_STEP_FRACTION: f64 = 0.1;
/// Number of kept rounds in a row without enough progress after which the loop ends. One full step without progress is
/// enough, unless its correction predicted more ([`UNKEPT_PROMISE`]). Larger: more rounds for small gains. Smaller: the
/// loop ends after one short step.
const PATIENCE: usize = 2;
/// Fraction of the executed RMS by which the RMS that the correction predicted must be lower, so that a full step
/// without progress does not end the loop. The machine then needed times that the correction did not know, and the next
/// one has them as lower bounds. Larger: the loop ends although such a correction would help. Smaller: more rounds.
const UNKEPT_PROMISE: f64 = 0.01;

/// Ratio of the RMS that a correction predicts to the best RMS, below which a correction that failed counts as too
/// large: the next one is smoother. Larger: more smoother corrections are tried. Smaller: the loop ends although a
/// smoother correction would help.
const LARGE_PROMISE: f64 = 0.9;
/// Factor on the smoothness of the correction after one that was too large. Larger: a safer and smaller correction.
/// Smaller: the next correction can be too large again.
const MORE_SMOOTHNESS: f64 = 10.0;

/// Refines the dwell times `first`, or those of the dwell solver, for `path` on a machine.
///
/// # Errors
///
/// Refuses inputs that do not belong together and settings out of range. Fails where the dwell solver or the scheduler
/// does, and if the motion of a best round needs more time than an upper bound allows.
pub fn refine(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    first: Option<DwellTime>,
    settings: &RefineSettings,
) -> Result<Refined, RefineError> {
    let start = Start { dwell: first, least_s: None };
    rounds(desired, tif, path, limits, start, settings, None)
}

/// Dwell times and bounds with which the loop starts.
struct Start {
    /// First dwell times; `None`: those of the dwell solver.
    dwell: Option<DwellTime>,
    /// Lower bounds of an earlier loop, s; `None`: those of the settings.
    least_s: Option<Vec<f64>>,
}

/// Runs the rounds of the loop; if `sources` (the errors of a process) are given, it lowers the expected square.
fn rounds(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    start: Start,
    settings: &RefineSettings,
    sources: Option<&Sources>,
) -> Result<Refined, RefineError> {
    let OnLattice { tif, lattice } = tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?;
    let inputs = LoopInputs { desired, tif: &tif, path, limits, settings, sources };
    let (mut state, mut t) = Rounds::start(inputs, start)?;
    let mut end = End::RoundLimit;
    for round in 0..=settings.max_rounds {
        // P = schedule(t), h, e
        let executed = state.execute(&t)?;
        let is_better = state.keep(round, executed)?;
        match state.next(is_better) {
            Next::End => {
                end = End::NoImprovement;
                break;
            }
            _ if round == settings.max_rounds => break,
            Next::HalveStep => state.step_fraction *= 0.5,
            Next::Correct { is_given_up, is_smoother } => {
                state.adapt(round, is_given_up, is_smoother);
                state.correct(round)?;
            }
        }
        t = state.proposal()?;
    }
    Ok(Refined { tif_lattice: lattice.if_anew(), ..state.result(end)? })
}

/// The inputs of the loop.
#[derive(Clone, Copy)]
struct LoopInputs<'a> {
    desired: &'a Surface,
    tif: &'a Tif,
    path: &'a ToolPath,
    limits: &'a Limits,
    settings: &'a RefineSettings<'a>,
    sources: Option<&'a Sources>,
}

/// Motion of some dwell times, with its simulated result and its limits.
struct Executed<'a> {
    iterate: Iterate,
    trajectory: Trajectory,
    /// Limits that the motion exceeds, in words; `None` if it keeps them.
    exceeded: Option<String>,
    /// Segments that took longer than their dwell time: index, and time in the motion, s.
    stretched: Vec<(usize, f64)>,
    quadratic: Option<Quadratic<'a>>,
}

/// The best round so far.
struct Best<'a> {
    round: usize,
    trajectory: Trajectory,
    exceeded: Option<String>,
    quadratic: Option<Quadratic<'a>>,
}

/// Transition of the loop after a round.
enum Next {
    /// The loop ends.
    End,
    /// The loop tries the same correction with half of its step.
    HalveStep,
    /// The loop makes a new correction from the best round.
    Correct {
        /// True if the correction before failed and is given up.
        is_given_up: bool,
        /// True if that correction was too large, so that the next one is smoother.
        is_smoother: bool,
    },
}

/// State of the loop between two rounds.
struct Rounds<'a> {
    inputs: LoopInputs<'a>,
    simulation: SimulationPlan<'a>,
    /// Number of valid pixels of the map.
    pixels: f64,
    /// RMS below which a residual is noise, nm.
    known_nm: f64,
    has_noise: bool,
    last_smoothness: f64,
    /// Settings of the next correction.
    solver: dwell_solver::BoundedSettings,
    /// Lower (`lo`) and upper (`hi`) bounds of the dwell times, s; the lower ones rise to the times that the machine
    /// needs.
    lo: Vec<f64>,
    hi: Vec<f64>,
    lo_of_best: Vec<f64>,
    iterates: Vec<Iterate>,
    best: Option<Best<'a>>,
    /// Dwell times that the correction proposes (t^ of the module), s, and the fraction of the step towards them in the
    /// next round.
    proposed_s: Vec<f64>,
    step_fraction: f64,
    /// Number of rounds in which the present correction was tried.
    tries: usize,
    /// RMS that the correction predicts, nm, and lower bounds from the times that the machine needed at every try of
    /// it, s.
    promised_nm: f64,
    tried_lo: Vec<f64>,
    without_progress: usize,
    /// True if a correction has been given up for a smoother one since the best round.
    is_smoother: bool,
}

impl<'a> Rounds<'a> {
    /// Returns the state before the first round, and the dwell times of that round.
    fn start(inputs: LoopInputs<'a>, start: Start) -> Result<(Self, DwellTime), RefineError> {
        let LoopInputs { desired, tif, path, settings, .. } = inputs;
        let mut solver = settings.dwell;
        let (floor_s, hi) = dwell_solver::bounds(path, &solver)?;
        let lo = start.least_s.unwrap_or(floor_s);
        let last_smoothness = solver.slope_weight;
        solver.slope_weight = last_smoothness.max(settings.first_smoothness);
        let parts = settings.max_rounds.max(1);
        let t = match start.dwell {
            Some(dwell) => dwell,
            None => {
                work::part(0, parts, || dwell_solver::solve(desired, tif, path, None, &solver))?
                    .dwell
            }
        };
        let pixels = desired.height_nm().iter().filter(|z| !z.is_nan()).count() as f64;
        // A residual below the noise is no gain. The RMS of the noise over m pixels scatters by 1 / sqrt(2 m).
        let scatter = 1.0 + 3.0 / (2.0 * pixels).sqrt();
        let state = Self {
            inputs,
            simulation: SimulationPlan::new(tif, desired.grid(), SimulationSettings::Gridded)?,
            pixels,
            known_nm: solver.noise_rms_nm.map_or(0.0, |noise_nm| noise_nm * scatter),
            has_noise: solver.noise_rms_nm.is_some(),
            last_smoothness,
            solver,
            lo_of_best: lo.clone(),
            tried_lo: lo.clone(),
            lo,
            hi,
            iterates: Vec::new(),
            best: None,
            proposed_s: Vec::new(),
            step_fraction: 1.0,
            tries: 0,
            promised_nm: f64::INFINITY,
            without_progress: 0,
            is_smoother: false,
        };
        Ok((state, t))
    }

    /// Makes the motion of the dwell times `t`, simulates it and checks its limits.
    fn execute(&self, t: &DwellTime) -> Result<Executed<'a>, RefineError> {
        let LoopInputs { desired, path, limits, settings, sources, .. } = self.inputs;
        let Scheduled { trajectory, mut changed } = settings.scheduler.schedule(path, t, limits)?;
        let mut h = t.dwell_s().to_vec();
        for (segment, took) in &changed {
            h[*segment] = *took;
        }
        changed.retain(|(segment, took)| *took > t.dwell_s()[*segment]);
        let stretched = changed;
        let predicted = self.simulation.predict(&trajectory, desired)?;
        let verdict = verify(&trajectory, limits, &VerifySettings::default())?;
        let residual = predicted.removal.residual();
        let Rms { rms_nm, detilted_nm } = Rms::of_surface(residual);
        let total_time_s = trajectory.total_time_s();
        let price = 2.0 * self.solver.time_weight_nm2_per_s * total_time_s;
        // E |e|^2 = |P (e - m)|^2 + h'Q h
        let quadratic = sources.map(|s| s.quadratic(&trajectory, path.len())).transpose()?;
        let (mean_nm, variance_nm2) = match &quadratic {
            None => (rms_nm, 0.0),
            Some(q) => (less_bias(residual, q)?.statistics().rms, q.variance_nm2(&h)),
        };
        let slope = self.solver.residual_slope;
        let slope_nm2 = slope.map_or(0.0, |slope| slope.mean_square_nm2(residual));
        let mean_nm2 = mean_nm.max(self.known_nm).powi(2);
        let iterate = Iterate {
            rms_nm,
            detilted_nm,
            expected_rms_nm: sources.map(|_| (mean_nm.powi(2) + variance_nm2).sqrt()),
            merit_nm: (mean_nm2 + variance_nm2 + slope_nm2 + price).sqrt(),
            total_time_s,
            stretched: stretched.len(),
            limits_respected: verdict.limits_respected,
            dwell_s: h,
        };
        Ok(Executed { iterate, trajectory, exceeded: verdict.reason(), stretched, quadratic })
    }

    /// Records the round, and keeps its plan if it is the best one; returns true then. A plan that exceeds the limits
    /// ranks below all that keep them.
    fn keep(&mut self, round: usize, executed: Executed<'a>) -> Result<bool, RefineError> {
        let Executed { iterate, trajectory, exceeded, stretched, quadratic } = executed;
        let before = self.best.as_ref().map(|b| &self.iterates[b.round]);
        let is_better = before.is_none_or(|b| iterate.rank() < b.rank());
        let least_improvement = self.inputs.settings.least_improvement;
        let is_progress = before.is_none_or(|b| {
            iterate.merit_nm < (1.0 - least_improvement) * b.merit_nm
                || iterate.limits_respected && !b.limits_respected
        });
        let rms_nm = iterate.rms_nm;
        self.iterates.push(iterate);
        work::round_ended();
        self.tries += 1;
        if is_better {
            self.is_smoother = false;
            self.best = Some(Best { round, trajectory, exceeded, quadratic });
            self.raise_bounds(&stretched)?;
            let is_unkept = self.promised_nm < (1.0 - UNKEPT_PROMISE) * rms_nm;
            self.without_progress = if is_progress {
                0
            } else if self.step_fraction < 1.0 || is_unkept {
                self.without_progress + 1
            } else {
                PATIENCE
            };
        }
        for &(j, took) in &stretched {
            self.tried_lo[j] = self.tried_lo[j].max(took.min(self.hi[j]));
        }
        Ok(is_better)
    }

    /// Raises the lower bounds to the times that the machine needed. Refuses a time above the upper bound. `stretched`
    /// has the index of each lengthened segment and its time, s.
    fn raise_bounds(&mut self, stretched: &[(usize, f64)]) -> Result<(), RefineError> {
        for &(segment, needed_s) in stretched {
            let bound_s = self.hi[segment];
            if needed_s > bound_s {
                let length_mm = self.inputs.path.segment_length_mm(segment);
                return Err(RefineError::BoundBelowNeed { segment, length_mm, needed_s, bound_s });
            }
            self.lo[segment] = self.lo[segment].max(needed_s);
        }
        self.lo_of_best.clone_from(&self.lo);
        Ok(())
    }

    /// Returns true if the corrections have reached their last smoothness, or if the noise chose it.
    fn is_at_last(&self) -> bool {
        self.solver.slope_weight <= self.last_smoothness || self.has_noise
    }

    /// Decides what the loop does after a round; `is_better` is true if it is the best one so far.
    fn next(&self, is_better: bool) -> Next {
        let is_spent = !is_better && 0.5 * self.step_fraction < LEAST_STEP_FRACTION;
        let best_nm = self.best.as_ref().map_or(f64::INFINITY, |b| self.iterates[b.round].rms_nm);
        let asked_too_much = self.promised_nm < LARGE_PROMISE * best_nm;
        let gets_smoother = is_spent && asked_too_much && !self.is_smoother && !self.has_noise;
        let is_over = is_spent || self.without_progress >= PATIENCE;
        if self.is_at_last() && !gets_smoother && is_over {
            return Next::End;
        }
        if is_better || is_spent {
            Next::Correct { is_given_up: is_spent, is_smoother: gets_smoother }
        } else {
            Next::HalveStep
        }
    }

    /// Chooses the fraction of the next step and the smoothness of the next correction. After a step that succeeded at
    /// the first try, the step may be longer and the correction rougher. The same holds after a correction that is
    /// given up; if that was too large, the next one is smoother.
    fn adapt(&mut self, round: usize, is_given_up: bool, is_smoother: bool) {
        if self.tries != 1 && !is_given_up {
            return;
        }
        self.step_fraction = f64::min(2.0 * self.step_fraction, 1.0);
        if is_smoother {
            self.is_smoother = true;
            self.lo.clone_from(&self.tried_lo);
            self.solver.slope_weight *= MORE_SMOOTHNESS;
        } else if round > 0 && !self.is_at_last() {
            let less = LESS_SMOOTHNESS * self.solver.slope_weight;
            self.solver.slope_weight = less.max(self.last_smoothness);
            // The effect of the new smoothness is not known yet.
            self.without_progress = 0;
        }
    }

    fn best(&self) -> &Best<'a> {
        self.best.as_ref().expect("the first round is the best one so far")
    }

    /// Computes the dwell times t^ of the module by bounded least squares with the columns B of the best motion.
    fn correct(&mut self, round: usize) -> Result<(), RefineError> {
        let LoopInputs { desired, tif, path, settings, .. } = self.inputs;
        let Best { round: best, trajectory, quadratic, .. } = self.best();
        let places = columns::executed(trajectory, path.len(), tif);
        let guess = Some(self.iterates[*best].dwell_s.clone());
        let lo = self.lo.clone();
        let hi = self.hi.clone();
        let target = quadratic.as_ref().map(|q| less_bias(desired, q)).transpose()?;
        // Sums over the pixels in the solver, means here.
        let product = |t: &[f64]| -> Vec<f64> {
            let product = quadratic.as_ref().map(|q| q.product(t)).unwrap_or_default();
            product.into_iter().map(|v| self.pixels * v).collect()
        };
        let quadratic = quadratic.as_ref().map(|_| &product as Product<'_>);
        let program = Program { places: &places, lo, hi, guess, quadratic };
        let target = target.as_ref().unwrap_or(desired);
        let solution = work::part(round, settings.max_rounds.max(1), || {
            dwell_solver::solve_columns(target, tif, path, None, &self.solver, &program)
        })?;
        let lo = program.lo;
        if self.solver.noise_rms_nm.take().is_some() {
            self.solver.slope_weight = solution.report.slope_weight;
        }
        self.promised_nm = solution.report.model_rms_nm;
        self.tried_lo = lo;
        self.proposed_s = solution.dwell.dwell_s().to_vec();
        self.tries = 0;
        Ok(())
    }

    /// Returns the dwell times of the next round, t = t* + s (t^ - t*) of the module.
    fn proposal(&self) -> Result<DwellTime, Invalid> {
        let best_s = &self.iterates[self.best().round].dwell_s;
        let step = best_s.iter().zip(&self.proposed_s);
        DwellTime::new(step.map(|(t, to)| t + self.step_fraction * (to - t)).collect())
    }

    fn result(self, end: End) -> Result<Refined, RefineError> {
        let Self { best, iterates, lo_of_best, hi, .. } = self;
        let best = best.expect("the first round is the best one so far");
        let dwell = DwellTime::new(iterates[best.round].dwell_s.clone())?;
        let bounds = lo_of_best.iter().zip(&hi);
        let at_bound =
            dwell.dwell_s().iter().zip(bounds).filter(|(t, (lo, hi))| t <= lo || t >= hi).count();
        Ok(Refined {
            exceeded: best.exceeded,
            dwell,
            trajectory: best.trajectory,
            best: best.round,
            iterates,
            end,
            at_bound,
            least_s: lo_of_best,
            tif_lattice: None,
        })
    }
}

/// Returns the map less the additional removal m by the fixed errors of a process, nm.
fn less_bias(map: &Surface, quadratic: &Quadratic<'_>) -> Result<Surface, Invalid> {
    let height: Array2<f64> = match &quadratic.bias_nm {
        None => return Ok(map.clone()),
        Some(bias) => map.height_nm() - bias,
    };
    let less = Surface::new(*map.grid(), height)?;
    match map.deviation_nm() {
        None => Ok(less),
        Some(deviation) => less.with_deviation(deviation.clone()),
    }
}
