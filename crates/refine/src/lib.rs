//! Dwell times corrected against the removal of the motion that will run.
//!
//! A dwell solver believes that the tool stands at points or moves uniformly along chords; the
//! machine executes a curve. So, starting from a dwell time `t`:
//!
//! ```text
//! repeat   P = schedule(t)                     the motion, within the limits
//!          h = time of every segment in P      >= t where the machine needs more
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
//! The operator must be the executed one: a fixed one converges on gentle paths and diverges where
//! the curve leaves the chords. It holds for the curve that it was made of, and t^ bends the curve:
//! the rougher the correction, the more. Hence the fraction s of the step, which is halved until the
//! executed residual falls and doubled where it falls at the first try; and hence the smoothness,
//! which falls from round to round to its last value: the
//! first corrections are of a plan far from its own operator, the last ones are not.
//!
//! Where no part of a correction lowers the executed residual, although by B it was to fall by a tenth or more, t^ was
//! beyond what B holds for, or asked for what the machine cannot do. The next one is smoother, and has what the machine
//! needed at every try as lower bounds. Only where smoother ones fail, too, does the loop end.
//!
//! The result is the iterate of the smallest `e` that keeps the limits, never the last by
//! accident. With a price `lambda` on the total time T the place of `e` is taken by
//! `sqrt(e^2 + 2 lambda T)`, twice the objective of the dwell solver. With a noise level the first
//! correction chooses the smoothness at which the residual reaches the noise; it stays.
//!
//! With a process ([`process`]) the loop goes on from its result: e^2 becomes the expected square, to which the errors
//! of the process add a quadratic t'Q t of the dwell times, and what its fixed errors remove more is taken off the map.
//!
//! This is the only crate that sees several stages. What it promises is what `planish-simulate`
//! and `planish-verify` say of the trajectory it writes; both are called inside as they are.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | t, h | `dwell_s` | (n) | s |
//! | P | `trajectory` | (k, 2, 4) | mm |
//! | e | `rms_nm` | - | nm |
//! | t^, s | `proposed_s`, `step_fraction` | (n), - | s, 1 |

pub mod process;
pub mod trade_off;

use ndarray::Array2;
use planish_dwell::{
    DwellError,
    bounded_least_squares::{self as dwell_solver, Product, Program},
    columns,
};
use planish_schedule::{ScheduleError, constant_acceleration, pvt};
use planish_simulate::{Plan, Settings as Simulation};
use planish_tolerance::quadratic::{Quadratic, Sources};
use planish_types::{
    DwellTime, End, Invalid, Limits, Surface, Tif, ToolPath, Trajectory,
    plausible::{self, Rms},
    progress as work,
};
use planish_verify::{VerifySettings, verify};
use serde::Serialize;

/// What makes the motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Scheduler {
    /// Cubic segments, stretched where the limits ask for it.
    Pvt(pvt::Mode),
    /// One constant acceleration, then constant velocity, per segment. It has no look-ahead: it
    /// comes late where it cannot stop, and its velocity is not limited.
    ConstantAcceleration,
}

/// How to refine.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// What makes the motion.
    pub scheduler: Scheduler,
    /// The dwell solver; its columns are those of the first plan, its smoothness that of the last
    /// corrections.
    pub dwell: dwell_solver::Settings,
    /// Smoothness of the first correction; it falls to that of `dwell`.
    pub first_smoothness: f64,
    /// Most rounds of schedule and correction.
    pub max_rounds: usize,
    /// Fraction of the RMS by which a round must improve on the best one to count as progress.
    pub least_improvement: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            scheduler: Scheduler::Pvt(pvt::Mode::Monotone),
            dwell: dwell_solver::Settings {
                // The columns are the executed ones, so the smoothness need not stand for what a
                // machine can execute; the pull to the lower bound buys machine time.
                tikhonov: 2.78e-6,
                smoothness: 7.72e-8,
                // RMS within 5e-4 of the least, half of what counts as progress.
                relative_gap: 1e-3,
                ..dwell_solver::Settings::default()
            },
            first_smoothness: 2.31e-7,
            max_rounds: 50,
            least_improvement: 1e-3,
        }
    }
}

/// Why nothing could be refined.
#[derive(Debug, thiserror::Error)]
pub enum RefineError {
    /// The inputs do not belong together.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The dwell solver refused.
    #[error(transparent)]
    Dwell(#[from] DwellError),
    /// The scheduler refused.
    #[error(transparent)]
    Schedule(#[from] ScheduleError),
    /// The machine needs more time than the upper bound allows.
    #[error(
        "no plan within limits and bounds: the machine needs {needed_s:.6} s for segment {segment} \
         ({length_mm:.6} mm), its upper bound is {bound_s:.6} s; raise the upper bound or the limits"
    )]
    BoundBelowNeed {
        /// Index of the segment.
        segment: usize,
        /// Its length, mm.
        length_mm: f64,
        /// Time that the machine needs, s.
        needed_s: f64,
        /// Upper bound, s.
        bound_s: f64,
    },
}

/// One round.
#[derive(Clone, Debug, PartialEq)]
pub struct Iterate {
    /// Time of every segment of the path in the motion, s.
    pub dwell_s: Vec<f64>,
    /// RMS (mean removed) of the executed residual, nm.
    pub rms_nm: f64,
    /// The same, plane removed, nm.
    pub detilted_nm: f64,
    /// With a process, sqrt of the expected mean square, nm, of which what is the same whatever the dwell times is
    /// left out: [`process`].
    pub expected_rms_nm: Option<f64>,
    /// sqrt(rms^2 + 2 lambda T), nm, with the noise in place of an RMS below it: what the loop
    /// lowers. With a process the expected square takes the place of rms^2.
    pub merit_nm: f64,
    /// Total time of the motion, s.
    pub total_time_s: f64,
    /// Segments whose dwell time the schedule had to stretch.
    pub stretched: usize,
    /// Whether the judge finds the limits kept.
    pub limits_respected: bool,
}

/// The best round, and all of them.
#[derive(Clone, Debug)]
pub struct Refined {
    /// Dwell times of the best round: what every segment takes in `trajectory`.
    pub dwell: DwellTime,
    /// Its motion.
    pub trajectory: Trajectory,
    /// Index of the best round.
    pub best: usize,
    /// All rounds; the first is the plan before any correction.
    pub iterates: Vec<Iterate>,
    /// Why it ended: `no-improvement` or `round-limit`.
    pub end: End,
    /// How many dwell times of the best round are at a bound: the least that the floor or the machine allows.
    pub at_bound: usize,
    /// Lower bounds after the best round: the floor, or what the machine was found to need, s.
    pub least_s: Vec<f64>,
}

impl Refined {
    /// Why the verdict is negative, where it is. To stop at the largest number of rounds is no reason when
    /// that number was asked for.
    pub fn negative(&self, desired: &Surface, rounds_asked_for: bool) -> Option<String> {
        let best = &self.iterates[self.best];
        if !best.limits_respected {
            Some("no round keeps the limits of the machine".into())
        } else if self.end == End::RoundLimit && !rounds_asked_for {
            Some(format!(
                "not converged: {} rounds were done before they ceased to improve; the best plan is kept, \
                 and `max_rounds` allows more, or says that these are enough",
                self.iterates.len()
            ))
        } else {
            let after = Rms { rms_nm: best.rms_nm, detilted_nm: best.detilted_nm };
            plausible::drawback(Rms::of(desired), after, best.total_time_s)
        }
    }
}

/// By what the smoothness falls from one correction to the next: half a decade.
const LESS_SMOOTHNESS: f64 = 0.316_227_766_016_837_94;
/// Fraction of the step below which a correction is given up.
const LEAST_STEP_FRACTION: f64 = 0.1;
/// Part steps in a row without progress after which the loop ends; of full steps, one is enough, unless it promised
/// progress.
const PATIENCE: usize = 2;
/// A full step that leaves this fraction more than its correction promised: the machine needed times that the correction
/// did not know, and the next one has them as lower bounds.
const UNKEPT_PROMISE: f64 = 0.01;

/// A correction that was to leave less than this fraction of the RMS, and is given up, asked for too much at once.
const LARGE_PROMISE: f64 = 0.9;
/// By what the next correction after such a one is smoother.
const MORE_SMOOTHNESS: f64 = 10.0;

/// A motion and what it needed.
struct Motion {
    trajectory: Trajectory,
    /// Segment and time of those that took longer than they should.
    stretched: Vec<(usize, f64)>,
}

/// P = schedule(t).
fn schedule(
    path: &ToolPath,
    t: &DwellTime,
    limits: &Limits,
    scheduler: Scheduler,
) -> Result<Motion, ScheduleError> {
    match scheduler {
        Scheduler::Pvt(mode) => {
            let how = pvt::Settings { mode, stretch: true };
            let motion = pvt::schedule(path, t, limits, &how)?;
            let stretched =
                motion.report.stretched.iter().map(|s| (s.segment, s.scheduled_s)).collect();
            Ok(Motion { trajectory: motion.trajectory, stretched })
        }
        Scheduler::ConstantAcceleration => {
            let trajectory = constant_acceleration::schedule(path, t, limits)?.trajectory;
            let served_s = trajectory.served_s(path.len(), |_| true)?;
            // Break times are sums: their differences round with the total.
            let rounding = 1e-12 * trajectory.total_time_s();
            let stretched = t
                .dwell_s()
                .iter()
                .zip(&served_s)
                .enumerate()
                .filter(|(_, (asked, took))| **took > **asked + rounding)
                .map(|(j, (_, took))| (j, *took))
                .collect();
            Ok(Motion { trajectory, stretched })
        }
    }
}

/// Refines the dwell times `first`, or those of the dwell solver, for `path` on a machine.
pub fn refine(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    first: Option<DwellTime>,
    settings: &Settings,
) -> Result<Refined, RefineError> {
    let start = Start { dwell: first, least_s: None };
    rounds(desired, tif, path, limits, start, settings, None)
}

/// Where the loop starts.
struct Start {
    /// First dwell times; those of the dwell solver where there are none.
    dwell: Option<DwellTime>,
    /// Lower bounds of an earlier loop; those of the settings where there are none.
    least_s: Option<Vec<f64>>,
}

/// The loop; with `sources` it lowers the expected square.
fn rounds(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    start: Start,
    settings: &Settings,
    sources: Option<&Sources>,
) -> Result<Refined, RefineError> {
    let mut solver = settings.dwell;
    let (floor_s, hi) = dwell_solver::bounds(path, &solver)?;
    let mut lo = start.least_s.unwrap_or(floor_s);
    let mut lo_of_best = lo.clone();
    let last_smoothness = solver.smoothness;
    solver.smoothness = last_smoothness.max(settings.first_smoothness);
    let parts = settings.max_rounds.max(1);
    let mut t = match start.dwell {
        Some(dwell) => dwell,
        None => {
            work::part(0, parts, || dwell_solver::solve(desired, tif, path, None, &solver))?.dwell
        }
    };
    let simulation = Plan::new(tif, desired.grid(), Simulation::Gridded)?;
    // Below the noise (its RMS over m pixels scatters by 1 / sqrt(2 m)) nothing is gained.
    let pixels = desired.height_nm().iter().filter(|z| !z.is_nan()).count() as f64;
    let known = solver.noise_rms_nm.map_or(0.0, |s| s * (1.0 + 3.0 / (2.0 * pixels).sqrt()));
    let mut iterates: Vec<Iterate> = Vec::new();
    let mut best: Option<(usize, Trajectory, Option<Quadratic<'_>>)> = None;
    let (mut proposed_s, mut step_fraction, mut tries) = (Vec::new(), 1.0, 0);
    let mut without_progress = 0;
    // RMS that t^ promises, and lower bounds by what the machine needed at every try of it.
    let (mut promised_nm, mut tried_lo) = (f64::INFINITY, lo.clone());
    // Whether a correction has been given up for a smoother one since the best round.
    let mut is_smoother = false;
    let has_noise = solver.noise_rms_nm.is_some();
    let mut end = End::RoundLimit;
    for round in 0..=settings.max_rounds {
        // P = schedule(t), h, e
        let motion = schedule(path, &t, limits, settings.scheduler)?;
        let mut h = t.dwell_s().to_vec();
        for (segment, took) in &motion.stretched {
            h[*segment] = *took;
        }
        let predicted = simulation.predict(&motion.trajectory, desired)?;
        let verdict = verify(&motion.trajectory, limits, &VerifySettings::default())?;
        let Rms { rms_nm, detilted_nm } = Rms::of(predicted.removal.residual());
        let total_time_s = motion.trajectory.total_time_s();
        let price = 2.0 * solver.time_weight_nm2_per_s * total_time_s;
        // E |e|^2 = |P (e - m)|^2 + h'Q h
        let quadratic = sources.map(|s| s.of(&motion.trajectory, path.len())).transpose()?;
        let (mean_nm, variance_nm2) = match &quadratic {
            None => (rms_nm, 0.0),
            Some(q) => {
                (less_bias(predicted.removal.residual(), q)?.statistics().rms, q.variance_nm2(&h))
            }
        };
        let iterate = Iterate {
            rms_nm,
            detilted_nm,
            expected_rms_nm: sources.map(|_| (mean_nm.powi(2) + variance_nm2).sqrt()),
            merit_nm: (mean_nm.max(known).powi(2) + variance_nm2 + price).sqrt(),
            total_time_s,
            stretched: motion.stretched.len(),
            limits_respected: verdict.limits_respected,
            dwell_s: h,
        };

        // Keep the best; a plan beyond the limits is worse than any within them.
        let before = best.as_ref().map(|(b, ..)| &iterates[*b]);
        let rank = |i: &Iterate| (!i.limits_respected, i.merit_nm);
        let better = before.is_none_or(|b| rank(&iterate) < rank(b));
        let progress = before.is_none_or(|b| {
            iterate.merit_nm < (1.0 - settings.least_improvement) * b.merit_nm
                || iterate.limits_respected && !b.limits_respected
        });
        iterates.push(iterate);
        work::round_ended();
        tries += 1;
        let at_last = solver.smoothness <= last_smoothness || has_noise;
        if better {
            is_smoother = false;
            best = Some((round, motion.trajectory, quadratic));
            // The machine's need becomes a lower bound.
            for &(j, needed_s) in &motion.stretched {
                if needed_s > hi[j] {
                    return Err(RefineError::BoundBelowNeed {
                        segment: j,
                        length_mm: path.segment_length_mm(j),
                        needed_s,
                        bound_s: hi[j],
                    });
                }
                lo[j] = lo[j].max(needed_s);
            }
            lo_of_best.clone_from(&lo);
            let is_unkept = promised_nm < (1.0 - UNKEPT_PROMISE) * rms_nm;
            without_progress = match progress {
                true => 0,
                false if step_fraction < 1.0 || is_unkept => without_progress + 1,
                false => PATIENCE,
            };
        }
        for &(j, took) in &motion.stretched {
            tried_lo[j] = tried_lo[j].max(took.min(hi[j]));
        }
        let spent = !better && 0.5 * step_fraction < LEAST_STEP_FRACTION;
        let best_nm = best.as_ref().map_or(f64::INFINITY, |(b, ..)| iterates[*b].rms_nm);
        let asked_too_much = promised_nm < LARGE_PROMISE * best_nm;
        let gets_smoother = spent && asked_too_much && !is_smoother && !has_noise;
        if at_last && !gets_smoother && (spent || without_progress >= PATIENCE) {
            end = End::NoImprovement;
            break;
        }
        if round == settings.max_rounds {
            break;
        }

        let (b, trajectory, quadratic) =
            best.as_ref().expect("the first round is the best one so far");
        let best_s = &iterates[*b].dwell_s;
        if better || spent {
            // A step that held at the first try may be longer, and rougher, the next time; so is what follows a
            // correction that is given up, unless that asked for too much.
            if tries == 1 || spent {
                step_fraction = f64::min(2.0 * step_fraction, 1.0);
                if gets_smoother {
                    is_smoother = true;
                    lo.clone_from(&tried_lo);
                    solver.smoothness *= MORE_SMOOTHNESS;
                } else if round > 0 && !at_last {
                    solver.smoothness = (LESS_SMOOTHNESS * solver.smoothness).max(last_smoothness);
                    // What that changes is not known yet.
                    without_progress = 0;
                }
            }
            // B of the motion; t^ = bounded least squares.
            let places = columns::executed(trajectory, path.len(), tif);
            let (lo, hi, guess) = (lo.clone(), hi.clone(), Some(best_s.clone()));
            let target = quadratic.as_ref().map(|q| less_bias(desired, q)).transpose()?;
            // Sums over the pixels in the solver, means here.
            let product = |t: &[f64]| -> Vec<f64> {
                let product = quadratic.as_ref().map(|q| q.product(t)).unwrap_or_default();
                product.into_iter().map(|v| pixels * v).collect()
            };
            let quadratic = quadratic.as_ref().map(|_| &product as Product<'_>);
            let program = Program { places: &places, lo, hi, guess, quadratic };
            let target = target.as_ref().unwrap_or(desired);
            let solution = work::part(round, parts, || {
                dwell_solver::solve_columns(target, tif, path, None, &solver, &program)
            })?;
            if solver.noise_rms_nm.take().is_some() {
                solver.smoothness = solution.report.smoothness;
            }
            promised_nm = solution.report.model_rms_nm;
            tried_lo.clone_from(&program.lo);
            proposed_s = solution.dwell.dwell_s().to_vec();
            tries = 0;
        } else {
            step_fraction *= 0.5;
        }
        // t = t* + s (t^ - t*)
        let step = best_s.iter().zip(&proposed_s).map(|(t, to)| t + step_fraction * (to - t));
        t = DwellTime::new(step.collect())?;
    }
    let (best, trajectory, _) = best.expect("the first round is the best one so far");
    let dwell = DwellTime::new(iterates[best].dwell_s.clone())?;
    let is_at_bound = |(j, t): &(usize, &f64)| **t <= lo_of_best[*j] || **t >= hi[*j];
    let at_bound = dwell.dwell_s().iter().enumerate().filter(is_at_bound).count();
    Ok(Refined { dwell, trajectory, best, iterates, end, at_bound, least_s: lo_of_best })
}

/// A map less m: what the fixed errors of a process remove more.
fn less_bias(map: &Surface, quadratic: &Quadratic<'_>) -> Result<Surface, Invalid> {
    let height: Array2<f64> = match &quadratic.bias_nm {
        None => return Ok(map.clone()),
        Some(bias) => map.height_nm() - bias,
    };
    Surface::new(*map.grid(), height)
}
