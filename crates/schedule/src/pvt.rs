//! Position-velocity-time: cubic segments through the control points at the dwell times.
//!
//! The tool passes control point `p_i` at the time that the dwell times give; only its velocities
//! `v_i` there are free. Segment `i` from `p` to `p + dp` in the time `h` is the cubic Hermite
//! polynomial, with `u` the local time,
//!
//! ```text
//! p(u) = p + v0 u + (3 dp/h^2 - (2 v0 + v1)/h) u^2 + (-2 dp/h^3 + (v0 + v1)/h^2) u^3    (1)
//! a+ = 6 dp/h^2 - (4 v0 + 2 v1)/h       acceleration at its start                      (2)
//! a- = -6 dp/h^2 + (2 v0 + 4 v1)/h      acceleration at its end
//! v(u) = quadratic Bezier curve of (v0, V, v1),  V = 3 dp/h - v0 - v1                   (3)
//! ```
//!
//! and the velocities minimise the acceleration energy, a tridiagonal problem per axis:
//!
//! ```text
//! min sum_i integral_0^h a^2 du = v' H v - 2 g' v + const                               (4)
//! H_ii = 4/h_i + 4/h_{i+1},  H_{i,i+1} = 2/h_{i+1},  g_i = 6 dp_i/h_i^2 + 6 dp_{i+1}/h_{i+1}^2
//! ```
//!
//! with `v_0 = v_N = 0`. Its free minimiser has `a-` = `a+` at every node: the clamped cubic
//! spline. Where a limit is exceeded, (4) is solved under `|v| <= v_max`, `|a| <= a_max` on whole
//! segments as a quadratic program; where that has no solution, the program with the least excess
//! over the limits says which segments need more time, and the report how much they got.
//!
//! Modes: *smooth* is (4); *monotone* adds that no axis reverses inside a segment, so the tool
//! never leaves the box of a segment's ends: `v_i` has the sign of its two displacements (zero
//! where they differ), and `sign(dp) V >= 0`. A node at which the velocity is fixed at zero parts the
//! axis: neither (4) nor a bound couples what is on its two sides, so the parts are solved one by one,
//! and after a round of stretching only those whose times have changed.
//!
//! A limit on jerk. The jerk of (1) is constant, `6 (v0 + v1)/h^2 - 12 dp/h^3`. Where the machine
//! limits it, *monotone* has it as rows of its program; its acceleration still steps at the nodes,
//! which no limit on jerk allows, and the claim says so. *smooth* must not use a program then: an
//! active row makes the acceleration step. It is the spline whose acceleration too starts and ends
//! at zero. That takes one more node, at no given place, in the middle of the first and of the last
//! segment; with `tau = h/2`, the jerk `j` of the first half is, from rest to `v` at `dp`,
//!
//! ```text
//! j = 3 dp / (2 tau^3) - v / (2 tau^2),   a- = 6 v/h - 12 dp/h^2                        (5)
//! ```
//!
//! and (5) replaces (2) in the equations `a- = a+`. (One segment from rest to rest: four quarters
//! of `j = 32 dp/h^3` with the signs + - - +.) It is slowed where it exceeds a limit; every limit is
//! then kept, with continuous acceleration, but not in the least time.
//!
//! Source: T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005, Eqs 8-18,
//! in the node velocities instead of polynomial coefficients: positions and times are then exact,
//! where the source's least squares trades them against accelerations, unit against unit.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | h | `duration_s` | (N) | s |
//! | dp | `displacement_mm` | (N) | mm |
//! | v | `velocity_mm_per_s` | (N+1) | mm/s |

use std::{borrow::Cow, collections::BTreeMap, ops::Range, sync::OnceLock};

use planish_numerics::qp::chain;
use planish_types::{DwellTime, Invalid, Limits, ToolPath, Trajectory, break_times};
use rayon::prelude::*;
use serde::Serialize;

use crate::{ScheduleError, check_lengths};

/// What the motion shall be like.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Least acceleration energy.
    Smooth,
    /// Least acceleration energy without reversal inside a segment.
    Monotone,
}

/// A [`Mode`], or the one that suits the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum ModeChoice {
    /// Monotone, or smooth where the machine has a limit on jerk, which only that mode keeps.
    #[default]
    Auto,
    /// Least acceleration energy; may overshoot corners; keeps a limit on jerk.
    Smooth,
    /// Least acceleration energy without reversal inside a segment; its acceleration steps.
    Monotone,
}

impl ModeChoice {
    /// The mode on this machine.
    pub fn on(self, machine: &Limits) -> Mode {
        match self {
            Self::Auto => Mode::within(machine),
            Self::Smooth => Mode::Smooth,
            Self::Monotone => Mode::Monotone,
        }
    }
}

impl Mode {
    /// The mode for a machine where none is asked for: monotone, which never leaves the box of a segment;
    /// where the machine limits jerk, smooth, because the acceleration of monotone motions steps.
    pub fn within(limits: &Limits) -> Self {
        match limits.axes().iter().any(|axis| axis.max_jerk_mm_per_s3().is_some()) {
            true => Self::Smooth,
            false => Self::Monotone,
        }
    }
}

/// How to schedule.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// What the motion shall be like.
    pub mode: Mode,
    /// Give segments more time where the limits need it; else such dwell times are refused.
    pub stretch: bool,
}

/// A segment that was given more time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Stretched {
    /// Index of the segment (= dwell point).
    pub segment: usize,
    /// Whether the tool removes there: then the stretch is an error of the dwell time.
    pub tool_on: bool,
    /// Dwell time, s.
    pub dwell_s: f64,
    /// Time in the schedule, s.
    pub scheduled_s: f64,
}

/// What was done.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Segments that were given more time, in order.
    pub stretched: Vec<Stretched>,
    /// Time that the stretching added with the tool on, s.
    pub added_tool_on_s: f64,
    /// Time that the stretching added with the tool lifted, s.
    pub added_tool_off_s: f64,
    /// Segments without length and dwell time, left out.
    pub dropped: Vec<usize>,
    /// Solver of (4) for [x, y] in the last round.
    pub solver: [Solver; 2],
    /// Rounds of stretching.
    pub rounds: usize,
}

/// How (4) was solved for an axis: where it was solved in parts, for the hardest of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// No bound is active: one tridiagonal solve.
    Tridiagonal,
    /// Bounds are active: interior point method.
    QuadraticProgram,
    /// The interior point method still did not converge after many rounds: at rest in every control
    /// point, which is within the limits and monotone, but far from the least energy.
    Rest,
}

/// The motion and what was done to get it.
#[derive(Clone, Debug)]
pub struct Schedule {
    /// Motion.
    pub trajectory: Trajectory,
    /// What was done.
    pub report: Report,
}

/// Part of the limit that the schedule leaves free, for the tolerance of the interior point
/// method (1e-7 relative at the worst) and the rounding of the judge.
const MARGIN: f64 = 1e-6;

/// Most rounds of stretching. A round multiplies the time of a segment in excess by up to 1.5,
/// so 100 rounds cover 17 orders of magnitude.
const MAX_ROUNDS: usize = 100;

/// Rounds after which everything is slowed together: what a stretched segment asks of its
/// neighbours can go round, a slower motion as a whole cannot.
const ROUNDS_BEFORE_UNIFORM_SLOWDOWN: usize = 60;

/// Schedules `path` with the times `dwell` within `limits`.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    settings: &Settings,
) -> Result<Schedule, ScheduleError> {
    check_lengths(path, dwell)?;
    // All of it by the threads of rayon: to hand over every part of it would cost more than a part.
    rayon::scope(|_| schedule_stretched(path, dwell, limits, settings))
}

fn schedule_stretched(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    settings: &Settings,
) -> Result<Schedule, ScheduleError> {
    let mut timing = Timing::new(path, dwell, limits);
    if timing.kept.is_empty() {
        let problem = "is zero everywhere on a path at rest";
        return Err(Invalid::whole("dwell_s", problem, "give a dwell time").into());
    }
    if !settings.stretch
        && let Some(error) = timing.refusal(path, dwell, limits)
    {
        return Err(error);
    }
    let displacement = |axis: usize, k: usize| path.displacement_mm(timing.kept[k])[axis];
    let axes = [0, 1].map(|axis| AxisProblem {
        displacement_mm: parallel(timing.kept.len()).map(|k| displacement(axis, k)).collect(),
        mode: settings.mode,
        max_velocity: (1.0 - MARGIN) * limits.max_velocity_mm_per_s()[axis],
        max_acceleration: (1.0 - MARGIN) * limits.max_acceleration_mm_per_s2()[axis],
        // Twice: its use of the limit is a cube root, compared with 1 + MARGIN / 2.
        max_jerk: limits.axes()[axis]
            .max_jerk_mm_per_s3()
            .map_or(f64::INFINITY, |j| (1.0 - 2.0 * MARGIN) * j),
    });
    if settings.mode == Mode::Smooth && axes.iter().any(|a| a.max_jerk.is_finite()) {
        return jerk_limited(path, dwell, limits, settings, timing, &axes);
    }

    let mut parts = axes.each_ref().map(AxisProblem::parts);
    for rounds in 0..=MAX_ROUNDS {
        // Durations as the difference of the break times, so that the segments join to rounding.
        let break_time_s = break_times(&timing.duration_s);
        let duration = |k: usize| break_time_s[k + 1] - break_time_s[k];
        let h: Vec<f64> = parallel(timing.kept.len()).map(duration).collect();
        let [x, y] = &mut parts;
        rayon::join(|| axes[0].solve_parts(&h, x), || axes[1].solve_parts(&h, y));
        let Some(excess) = excess_of_parts(&parts, h.len()) else {
            let [x, y] = parts.map(joined);
            let solver = [x.solver, y.solver];
            let segments = parallel(h.len()).map(|k| {
                let start = path.point_mm()[timing.kept[k]];
                let hermite = |axis: usize, v: &[f64]| {
                    hermite(start[axis], axes[axis].displacement_mm[k], v[k], v[k + 1], h[k])
                };
                [hermite(0, &x.velocity), hermite(1, &y.velocity)]
            });
            let trajectory = Trajectory::new(
                break_time_s,
                segments.collect(),
                parallel(h.len()).map(|k| path.tool_on()[timing.kept[k]]).collect(),
                parallel(h.len()).map(|k| Some(timing.kept[k])).collect(),
            )?;
            return Ok(Schedule { trajectory, report: timing.report(path, dwell, solver, rounds) });
        };
        let mut excess = excess;
        let (k, worst) = worst(&excess);
        let segment = timing.kept[k];
        if !settings.stretch {
            return Err(too_short(path, dwell, segment, worst));
        }
        if rounds == MAX_ROUNDS {
            return Err(ScheduleError::StretchLimit { rounds, segment, excess: worst });
        }
        if rounds >= ROUNDS_BEFORE_UNIFORM_SLOWDOWN {
            let of_parts = || parts.iter().flatten();
            if !of_parts().any(|part| part.rounds.may_rest) {
                excess.fill(worst);
            }
            for part in parts.iter_mut().flatten() {
                part.rounds.may_rest = part.rounds.unsolved;
            }
        }
        timing.stretch(&excess);
        for part in parts.iter_mut().flatten() {
            if excess[part.segments.clone()].iter().any(|e| *e > 1.0) {
                part.solved = None;
            }
        }
    }
    unreachable!("the last round returns")
}

/// The segment that exceeds the limits most, and by how much; 1 where none does.
fn worst(excess: &[f64]) -> (usize, f64) {
    let each = excess.iter().copied().enumerate();
    each.fold((0, 1.0), |m, (k, e)| if e > m.1 { (k, e) } else { m })
}

/// A segment whose time may not be stretched, but would have to be.
fn too_short(path: &ToolPath, dwell: &DwellTime, segment: usize, factor: f64) -> ScheduleError {
    ScheduleError::Infeasible {
        segment,
        length_mm: path.segment_length_mm(segment),
        dwell_s: dwell.dwell_s()[segment],
        reason: format!("needs its time stretched by a factor {factor:.4} or more"),
    }
}

/// The segments by all threads, where there are many: the system's work for memory that is touched
/// for the first time would else be that of one.
fn parallel(segments: usize) -> impl IndexedParallelIterator<Item = usize> {
    (0..segments).into_par_iter().with_min_len(2048)
}

/// Rounds after which everything is slowed together, which ends: a factor k divides velocity,
/// acceleration and jerk by k, k^2 and k^3.
const MAX_LOCAL_ROUNDS: usize = 200;

/// The spline of (5), stretched until every limit is kept.
fn jerk_limited(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    settings: &Settings,
    mut timing: Timing,
    axes: &[AxisProblem<'_>; 2],
) -> Result<Schedule, ScheduleError> {
    let n = timing.kept.len();
    let parts: Vec<usize> = match n {
        1 => vec![4],
        _ => (0..n).map(|k| if k == 0 || k == n - 1 { 2 } else { 1 }).collect(),
    };
    for (h, parts) in timing.duration_s.iter_mut().zip(&parts) {
        *h = h.max(*parts as f64 * limits.min_segment_s());
    }
    // Segment of every piece.
    let of: Vec<usize> = (0..n).flat_map(|k| std::iter::repeat_n(k, parts[k])).collect();
    for rounds in 0.. {
        let pieces: Vec<f64> =
            of.iter().map(|k| timing.duration_s[*k] / parts[*k] as f64).collect();
        let break_time_s = break_times(&pieces);
        let u: Vec<f64> = break_time_s.windows(2).map(|w| w[1] - w[0]).collect();
        let solved = axes.each_ref().map(|a| a.smooth_from_rest(&timing.duration_s));
        let mut excess = vec![1.0_f64; n];
        for (problem, velocity) in &solved {
            for (k, e) in of.iter().zip(problem.excess(velocity, &u)) {
                excess[*k] = excess[*k].max(e);
            }
        }
        let (k, worst) = worst(&excess);
        if worst <= 1.0 {
            let mut position = path.point_mm()[0];
            let segments = (0..of.len()).map(|i| {
                let c = [0, 1].map(|a| {
                    let (problem, v) = &solved[a];
                    hermite(position[a], problem.displacement_mm[i], v[i], v[i + 1], u[i])
                });
                let next = i + 1;
                position = if next == of.len() || of[next] != of[i] {
                    path.point_mm()[timing.kept[of[i]] + 1]
                } else {
                    [0, 1].map(|a| position[a] + solved[a].0.displacement_mm[i])
                };
                c
            });
            let segments = segments.collect();
            let trajectory = Trajectory::new(
                break_time_s,
                segments,
                of.iter().map(|k| path.tool_on()[timing.kept[*k]]).collect(),
                of.iter().map(|k| Some(timing.kept[*k])).collect(),
            )?;
            let solver = [Solver::Tridiagonal; 2];
            return Ok(Schedule { trajectory, report: timing.report(path, dwell, solver, rounds) });
        }
        let segment = timing.kept[k];
        if !settings.stretch {
            return Err(too_short(path, dwell, segment, worst));
        }
        if rounds > MAX_LOCAL_ROUNDS + MAX_ROUNDS {
            return Err(ScheduleError::StretchLimit { rounds, segment, excess: worst });
        }
        if rounds >= MAX_LOCAL_ROUNDS {
            excess.fill(worst);
        }
        timing.stretch(&excess);
    }
    unreachable!("the rounds have no end")
}

/// Segments and the time they get.
#[derive(Debug)]
struct Timing {
    /// Segments that take time.
    kept: Vec<usize>,
    /// Their time, s; > 0.
    duration_s: Vec<f64>,
}

impl Timing {
    /// `h >= |dp| / v_max` on both axes, `h >= min_segment_s`.
    fn new(path: &ToolPath, dwell: &DwellTime, limits: &Limits) -> Self {
        let time = |i: usize| dwell.dwell_s()[i].max(least_time(path, limits, i));
        let mut duration_s: Vec<f64> = parallel(path.len()).map(time).collect();
        let kept = (0..path.len()).filter(|i| duration_s[*i] > 0.0).collect();
        duration_s.retain(|h| *h > 0.0);
        Self { kept, duration_s }
    }

    /// The segment that is furthest from what its mean speed or duration may be.
    fn refusal(
        &self,
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
    ) -> Option<ScheduleError> {
        let short = |i: &usize| least_time(path, limits, *i) - dwell.dwell_s()[*i];
        let worst = self.kept.iter().copied().max_by(|a, b| short(a).total_cmp(&short(b)))?;
        (short(&worst) > 0.0).then(|| ScheduleError::Infeasible {
            segment: worst,
            length_mm: path.segment_length_mm(worst),
            dwell_s: dwell.dwell_s()[worst],
            reason: format!(
                "needs at least {:.6} s for the mean velocity and the shortest segment",
                least_time(path, limits, worst)
            ),
        })
    }

    /// `h <- 1.002 min(excess, 1.5) h` where the excess is above 1: algorithms that scale a
    /// segment's time by k divide its velocity by k and its acceleration by k^2.
    fn stretch(&mut self, excess: &[f64]) {
        for (h, e) in self.duration_s.iter_mut().zip(excess) {
            if *e > 1.0 {
                *h *= 1.002 * e.min(1.5);
            }
        }
    }

    fn report(
        &self,
        path: &ToolPath,
        dwell: &DwellTime,
        solver: [Solver; 2],
        rounds: usize,
    ) -> Report {
        let stretched: Vec<Stretched> = (self.kept.iter().zip(&self.duration_s))
            .map(|(&segment, &scheduled_s)| Stretched {
                segment,
                tool_on: path.tool_on()[segment],
                dwell_s: dwell.dwell_s()[segment],
                scheduled_s,
            })
            .filter(|s| s.scheduled_s > s.dwell_s)
            .collect();
        let mut kept = self.kept.iter().peekable();
        let added = |on: bool| {
            let of = stretched.iter().filter(|s| s.tool_on == on);
            of.map(|s| s.scheduled_s - s.dwell_s).fold(0.0, |a, b| a + b)
        };
        Report {
            added_tool_on_s: added(true),
            added_tool_off_s: added(false),
            dropped: (0..path.len()).filter(|i| kept.next_if(|k| *k == i).is_none()).collect(),
            stretched,
            solver,
            rounds,
        }
    }
}

/// Least time of segment `i`: its mean velocity within the limits, and the controller's least.
pub(crate) fn least_time(path: &ToolPath, limits: &Limits, i: usize) -> f64 {
    let (dp, v) = (path.displacement_mm(i), limits.max_velocity_mm_per_s());
    let axis = |a: usize| dp[a].abs() / v[a];
    axis(0).max(axis(1)).max(limits.min_segment_s())
}

/// Coefficients of (1).
pub(crate) fn hermite(p: f64, dp: f64, v0: f64, v1: f64, h: f64) -> [f64; 4] {
    [p, v0, (3.0 * dp / h - 2.0 * v0 - v1) / h, (-2.0 * dp / h + v0 + v1) / (h * h)]
}

/// How the limits of the machine enter the quadratic program.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Bounds {
    /// They hold.
    Hard,
    /// They are exceeded as little as possible.
    Elastic {
        /// Of an excess of 1 for 1 s.
        price: f64,
    },
}

/// Most programs until every limit that matters has its rows: the reach of a round is four times
/// that of the one before, and an added time lies within rounding of the last after a few.
const MAX_PROGRAMS: usize = 24;

/// Weight of the energy beside the excess over the limits: small, but enough to choose among the
/// motions with the least excess.
const ELASTIC_ENERGY: f64 = 1e-4;

/// (4) for one axis; N segments.
#[derive(Debug)]
struct AxisProblem<'a> {
    displacement_mm: Cow<'a, [f64]>,
    mode: Mode,
    max_velocity: f64,
    max_acceleration: f64,
    /// Infinite where the machine has none.
    max_jerk: f64,
}

/// Excess above which the next round, whose times are longer by little, begins with the elastic
/// program. Nearer to the limits the elastic one may exceed by its tolerance what the hard one keeps.
const EXCESS_FOR_ELASTIC_START: f64 = 1.01;

/// What a round of stretching knows of the rounds before it.
#[derive(Debug, Default)]
struct Rounds {
    /// Segments that needed the rows of the machine's limits.
    limited: Vec<usize>,
    /// The last durations had clearly no motion within the limits.
    infeasible: bool,
    /// Neither program was solved.
    unsolved: bool,
    /// [`Solver::Rest`] is allowed.
    may_rest: bool,
}

/// Segments of an axis from a node at rest to another. Neither (4) nor a bound couples what is on the
/// two sides of a node whose velocity is zero, so the parts are solved one by one: they fit the
/// caches, and a round of stretching solves only those whose times it changed.
#[derive(Debug)]
struct Part {
    segments: Range<usize>,
    rounds: Rounds,
    /// At the present durations, or `None`; see [`AxisProblem::solve`].
    solved: Option<Result<Solved, Vec<f64>>>,
}

/// Least segments of a part: fewer cost more to set up than to solve.
const PART: usize = 64;

/// How much each of n segments exceeds the limits, the worse axis counts; `None` where no part does.
fn excess_of_parts(parts: &[Vec<Part>; 2], n: usize) -> Option<Vec<f64>> {
    let mut all = None;
    for part in parts.iter().flatten() {
        if let Some(Err(excess)) = &part.solved {
            let all = &mut all.get_or_insert_with(|| vec![1.0_f64; n])[part.segments.clone()];
            all.iter_mut().zip(excess).for_each(|(a, e)| *a = a.max(*e));
        }
    }
    all
}

/// The solution of all parts of an axis.
fn joined(parts: Vec<Part>) -> Solved {
    let mut parts = parts.into_iter().filter_map(|part| part.solved?.ok());
    let mut all = parts.next().expect("every part is solved");
    for part in parts {
        all.velocity.pop(); // the node at rest
        all.velocity.extend(part.velocity);
        all.solver = all.solver.max(part.solver);
    }
    all
}

/// Where the limits of the machine are in a program.
#[derive(Debug)]
struct Limited {
    /// Whether a segment (N) has them.
    segment: Vec<bool>,
    /// Times, in units of the duration, at which its velocity is bounded besides the middle.
    velocity_at: BTreeMap<usize, Vec<f64>>,
}

impl Limited {
    /// Times at which the velocity of segment `i`, which has limits, is bounded.
    fn times(&self, i: usize) -> impl Iterator<Item = f64> {
        std::iter::once(0.5).chain(self.velocity_at.get(&i).into_iter().flatten().copied())
    }
}

/// Node velocities (N+1) and how they were found.
#[derive(Debug)]
struct Solved {
    velocity: Vec<f64>,
    solver: Solver,
}

impl AxisProblem<'_> {
    /// The whole in *smooth*; in *monotone* cut at nodes that the signs of the displacements fix.
    fn parts(&self) -> Vec<Part> {
        let n = self.displacement_mm.len();
        let (mut parts, mut start) = (Vec::new(), 0);
        for node in 1..=n {
            let is_long = node - start >= PART && self.allowed_signs(node) == [false, false];
            if is_long || node == n {
                let rounds = Rounds::default();
                parts.push(Part { segments: start..node, rounds, solved: None });
                start = node;
            }
        }
        parts
    }

    /// Solves the parts whose durations have changed.
    fn solve_parts(&self, h: &[f64], parts: &mut [Part]) {
        let price = OnceLock::new();
        let price = || *price.get_or_init(|| self.elastic_price(h));
        parts.par_iter_mut().filter(|part| part.solved.is_none()).for_each(|part| {
            let segments = part.segments.clone();
            let displacement_mm = Cow::Borrowed(&self.displacement_mm[segments.clone()]);
            let problem = AxisProblem { displacement_mm, ..*self };
            part.solved = Some(problem.solve(&h[segments], price, &mut part.rounds));
        });
    }

    /// Node velocities within the limits at the durations `h`, or how much each segment exceeds
    /// them: the factor by which its time should grow.
    fn solve(
        &self,
        h: &[f64],
        price: impl Fn() -> f64,
        before: &mut Rounds,
    ) -> Result<Solved, Vec<f64>> {
        before.unsolved = false;
        let free = self.clamped_spline(h);
        let allowed = self.mode == Mode::Smooth || self.is_monotone(&free, h);
        if allowed && parallel(h.len()).all(|i| self.excess_of(i, &free, h) <= 1.0) {
            return Ok(Solved { velocity: free, solver: Solver::Tridiagonal });
        }
        drop(free); // its memory is the program's
        let solved = |velocity| Ok(Solved { velocity, solver: Solver::QuadraticProgram });
        if !before.infeasible
            && let Some(velocity) = self.quadratic_program(h, Bounds::Hard, before)
        {
            return solved(velocity);
        }
        // Where the bounds leave a single motion, hard rows have no interior and the method does
        // not converge; with the elastic ones it does, and nothing exceeds.
        let within = 1.0 + 0.5 * MARGIN;
        let mut excess = match self.quadratic_program(h, Bounds::Elastic { price: price() }, before)
        {
            Some(velocity) => {
                let excess = self.excess(&velocity, h);
                if excess.iter().all(|e| *e <= within) {
                    let hard = before.infeasible.then(|| {
                        before.infeasible = false;
                        self.quadratic_program(h, Bounds::Hard, before)
                    });
                    return solved(hard.flatten().unwrap_or(velocity));
                }
                excess
            }
            None => {
                before.unsolved = true;
                if before.may_rest {
                    let velocity = vec![0.0; h.len() + 1];
                    let excess = self.excess(&velocity, h);
                    if excess.iter().all(|e| *e <= 1.0) {
                        return Ok(Solved { velocity, solver: Solver::Rest });
                    }
                    return Err(excess);
                }
                self.excess(&self.clamped_spline(h), h)
            }
        };
        before.infeasible = excess.iter().any(|e| *e > EXCESS_FOR_ELASTIC_START);
        if excess.iter().all(|e| *e <= within) {
            // Only the solver's tolerance stands in the way.
            excess.fill(1.0 + MARGIN);
        }
        excess.iter_mut().filter(|e| **e <= within).for_each(|e| *e = 1.0);
        Err(excess)
    }

    /// The free minimiser of (4): H v = g by elimination; H is diagonally dominant.
    fn clamped_spline(&self, h: &[f64]) -> Vec<f64> {
        let n = h.len();
        let dp = &self.displacement_mm;
        let mut v = vec![0.0; n + 1];
        // Forward elimination of nodes 1 .. n-1; v_0 = v_n = 0.
        let mut upper = vec![0.0; n];
        let mut a = 1.0 / h[0];
        for i in 1..n {
            let b = 1.0 / h[i];
            let pivot = 1.0 / (4.0 * (a + b) - 2.0 * a * upper[i - 1]);
            let g = 6.0 * (dp[i - 1] * a * a + dp[i] * b * b);
            upper[i] = 2.0 * b * pivot;
            v[i] = (g - 2.0 * a * v[i - 1]) * pivot;
            a = b;
        }
        for i in (1..n).rev() {
            v[i] -= upper[i] * v[i + 1];
        }
        v
    }

    /// The pieces of the spline that starts and ends with v = a = 0, by (5): their displacements in
    /// a problem of their own, and the velocities of their ends.
    fn smooth_from_rest(&self, h: &[f64]) -> (AxisProblem<'static>, Vec<f64>) {
        let (n, dp) = (h.len(), &self.displacement_mm);
        let pieces = |parts: Vec<f64>| AxisProblem { displacement_mm: Cow::Owned(parts), ..*self };
        if n == 1 {
            let (d, v) = (dp[0], dp[0] / h[0]);
            let parts = [1.0, 5.0, 5.0, 1.0].map(|part| part / 12.0 * d);
            return (pieces(parts.to_vec()), vec![0.0, v, 2.0 * v, v, 0.0]);
        }
        // a-(i) = a+(i+1): elimination of the nodes 1 .. n-1.
        let mut v = vec![0.0; n + 1];
        let mut upper = vec![0.0; n + 1];
        for i in 1..n {
            let (a, b) = (h[i - 1], h[i]);
            // (5) at the ends, (2) else: the factors of v/h and of dp/h^2.
            let (own, mean) = if i == 1 { (6.0, 12.0) } else { (4.0, 6.0) };
            let (next, next_mean) = if i == n - 1 { (6.0, 12.0) } else { (4.0, 6.0) };
            let below = if i == 1 { 0.0 } else { 2.0 / a };
            let pivot = own / a + next / b - below * upper[i - 1];
            let g = mean * dp[i - 1] / (a * a) + next_mean * dp[i] / (b * b);
            upper[i] = if i == n - 1 { 0.0 } else { 2.0 / b / pivot };
            v[i] = (g - below * v[i - 1]) / pivot;
        }
        for i in (1..n).rev() {
            v[i] -= upper[i] * v[i + 1];
        }
        // j tau^3/6 and j tau^2/2 of the half at rest.
        let half = |dp: f64, v: f64, h: f64| {
            let tau = 0.5 * h;
            let outer = 0.25 * dp - v * tau / 12.0;
            (outer, 3.0 * outer / tau)
        };
        let (first, first_v) = half(dp[0], v[1], h[0]);
        let (last, last_v) = half(dp[n - 1], v[n - 1], h[n - 1]);
        let mut parts = vec![first, dp[0] - first];
        parts.extend(&dp[1..n - 1]);
        parts.extend([dp[n - 1] - last, last]);
        let mut velocity = vec![0.0, first_v];
        velocity.extend(&v[1..n]);
        velocity.extend([last_v, 0.0]);
        (pieces(parts), velocity)
    }

    /// Factor by which the time of each segment should grow: the velocity is inversely
    /// proportional to it, the acceleration to its square, the jerk to its cube.
    fn excess(&self, v: &[f64], h: &[f64]) -> Vec<f64> {
        (0..h.len()).map(|i| self.excess_of(i, v, h)).collect()
    }

    fn excess_of(&self, i: usize, v: &[f64], h: &[f64]) -> f64 {
        let (dp, v0, v1, h) = (self.displacement_mm[i], v[i], v[i + 1], h[i]);
        let (start, end) = accelerations(dp, v0, v1, h);
        let a = (start.abs().max(end.abs()) / self.max_acceleration).sqrt();
        let excess = a.max(peak_velocity(dp, v0, v1, h).0 / self.max_velocity);
        if self.max_jerk.is_infinite() {
            return excess;
        }
        excess.max(((end - start).abs() / (h * self.max_jerk)).cbrt())
    }

    /// Signs that the velocity of each node may have: [negative, positive].
    fn allowed_signs(&self, i: usize) -> [bool; 2] {
        let n = self.displacement_mm.len();
        if i == 0 || i == n {
            return [false, false];
        }
        if self.mode == Mode::Smooth {
            return [true, true];
        }
        let (before, after) = (self.displacement_mm[i - 1], self.displacement_mm[i]);
        [before < 0.0 && after < 0.0, before > 0.0 && after > 0.0]
    }

    fn is_monotone(&self, v: &[f64], h: &[f64]) -> bool {
        let sign_ok = |i: usize| {
            let [negative, positive] = self.allowed_signs(i);
            (v[i] >= 0.0 || negative) && (v[i] <= 0.0 || positive)
        };
        let middle_ok = |i: usize| {
            let dp = self.displacement_mm[i];
            dp * (3.0 * dp / h[i] - v[i] - v[i + 1]) >= 0.0
        };
        (0..v.len()).all(sign_ok) && (0..h.len()).all(middle_ok)
    }

    /// (4) under the bounds of the mode and of the machine; `None` when there is no solution.
    ///
    /// Most segments are far from the machine's limits. A segment gets their rows when the motion
    /// without exceeds them, with more and more of its neighbours; the velocity, whose largest
    /// value lies anywhere in the segment, is bounded at its middle first and then wherever the
    /// limit was exceeded.
    fn quadratic_program(
        &self,
        h: &[f64],
        bounds: Bounds,
        before: &mut Rounds,
    ) -> Option<Vec<f64>> {
        let n = h.len();
        let exceeds = |v: &[f64], i: usize| self.excess_of(i, v, h) > 1.0 + 0.5 * MARGIN;
        if (0..=n).all(|i| self.allowed_signs(i) == [false, false]) {
            // The axis rests in every control point.
            let v = vec![0.0; n + 1];
            let kept = bounds != Bounds::Hard || !parallel(n).any(|i| exceeds(&v, i));
            return kept.then_some(v);
        }
        let mut limited = Limited { segment: vec![false; n], velocity_at: BTreeMap::new() };
        before.limited.iter().for_each(|i| limited.segment[*i] = true);
        let mut reach = 2;
        for _ in 0..MAX_PROGRAMS {
            let add = |i: usize, rows: &mut chain::Rows| self.rows(i, h, &limited, rows);
            let v = chain::solve(self.program(h, bounds), add).ok()?;
            let v = self.exact_at_fixed_nodes(v);
            let mut complete = true;
            let mut with_rows: Vec<usize> = Vec::new();
            let exceeding: Vec<usize> = parallel(n).filter(|i| exceeds(&v, *i)).collect();
            for i in exceeding {
                if !limited.segment[i] {
                    with_rows.push(i);
                } else if bounds == Bounds::Hard {
                    let (peak, u) = peak_velocity(self.displacement_mm[i], v[i], v[i + 1], h[i]);
                    let known = limited.times(i).any(|k| (k - u).abs() < 1e-9);
                    if peak <= self.max_velocity || known {
                        return None;
                    }
                    limited.velocity_at.entry(i).or_default().push(u);
                    complete = false;
                }
            }
            for i in with_rows {
                for near in i.saturating_sub(reach)..(i + reach + 1).min(n) {
                    if !limited.segment[near] {
                        limited.segment[near] = true;
                        before.limited.push(near);
                    }
                }
                complete = false;
            }
            if complete {
                return Some(v);
            }
            reach *= 4;
        }
        None
    }

    /// Price of elastic bounds, from the largest energy and the largest mean velocity of the axis:
    /// the energy hardly counts against it.
    fn elastic_price(&self, h: &[f64]) -> f64 {
        let (n, dp) = (h.len(), &self.displacement_mm);
        let of = |i: usize| 4.0 / h[i];
        let energy = (1..n).map(|i| of(i - 1) + of(i)).fold(of(0).max(of(n - 1)), f64::max);
        let mean = (0..n).map(|i| dp[i].abs() / h[i]).fold(0.0, f64::max);
        let mean_s = h.iter().sum::<f64>() / n as f64;
        energy * mean * mean / (ELASTIC_ENERGY * mean_s)
    }

    /// (4), and how its bounds may be exceeded.
    ///
    /// Elastic bounds: the limits of segment i may be exceeded by the fraction e_i >= 0, a
    /// variable of its own, at the price of h_i e_i, about twice the time that it costs to mend.
    /// The excesses are then few and cheap.
    fn program(&self, h: &[f64], bounds: Bounds) -> chain::Program {
        let (n, dp) = (h.len(), &self.displacement_mm);
        // Of the segments at a node.
        let sum = |node: usize, of: &dyn Fn(usize) -> f64| {
            (node.saturating_sub(1)..(node + 1).min(n)).map(of).sum()
        };
        let nodes = || parallel(n + 1);
        let diagonal = nodes().map(|node| sum(node, &|i| 4.0 / h[i])).collect();
        let linear = nodes().map(|node| sum(node, &|i| 6.0 * dp[i] / (h[i] * h[i]))).collect();
        let beside = parallel(n).map(|i| 2.0 / h[i]).collect();
        let price = match bounds {
            Bounds::Hard => Vec::new(),
            Bounds::Elastic { price } => h.iter().map(|h| price * h).collect(),
        };
        let free = nodes().map(|i| self.allowed_signs(i) != [false, false]).collect();
        chain::Program { diagonal, beside, linear, free, price }
    }

    /// Rows of segment i: its signs, and the limits of the machine where it is limited.
    fn rows(&self, i: usize, h: &[f64], limited: &Limited, rows: &mut chain::Rows) {
        let dp = self.displacement_mm[i];
        if self.mode == Mode::Monotone {
            // v_i >= 0 or v_i <= 0;  sign(dp) (v0 + v1) <= 3 |dp| / h
            match self.allowed_signs(i) {
                [false, true] => rows.add([-1.0, 0.0], 0.0, 0.0),
                [true, false] => rows.add([1.0, 0.0], 0.0, 0.0),
                _ => {}
            }
            let sign = dp.signum();
            if dp != 0.0 {
                rows.add([sign, sign], 0.0, 3.0 * dp.abs() / h[i]);
            }
        }
        if !limited.segment[i] {
            return;
        }
        // |6 dp/h - (4 v0 + 2 v1)| <= a h,  |-6 dp/h + (2 v0 + 4 v1)| <= a h
        let (d, a, v_max) = (dp / h[i], self.max_acceleration * h[i], self.max_velocity);
        let mut both = |row: [f64; 2], constant: f64, bound: f64| {
            rows.add(row, bound, bound - constant);
            rows.add(row.map(|v| -v), bound, bound + constant);
        };
        both([-4.0, -2.0], 6.0 * d, a);
        both([2.0, 4.0], -6.0 * d, a);
        both([1.0, 0.0], 0.0, v_max);
        both([0.0, 1.0], 0.0, v_max);
        if self.max_jerk.is_finite() {
            // |6 (v0 + v1) - 12 dp/h| <= j h^2
            both([6.0, 6.0], -12.0 * d, self.max_jerk * h[i] * h[i]);
        }
        for u in limited.times(i) {
            // v(u) = (1-u)^2 v0 + 2u(1-u) (3 dp/h - v0 - v1) + u^2 v1
            let (w, m) = (1.0 - u, 2.0 * u * (1.0 - u));
            both([w * w - m, u * u - m], 3.0 * m * d, v_max);
        }
    }

    /// Velocities that are fixed at zero are zero, and none has a forbidden sign by the solver's
    /// tolerance.
    fn exact_at_fixed_nodes(&self, mut v: Vec<f64>) -> Vec<f64> {
        for (i, v) in v.iter_mut().enumerate() {
            let [negative, positive] = self.allowed_signs(i);
            *v = v.clamp(
                if negative { f64::NEG_INFINITY } else { 0.0 },
                if positive { f64::INFINITY } else { 0.0 },
            );
        }
        v
    }
}

/// (2): (a+, a-).
pub(crate) fn accelerations(dp: f64, v0: f64, v1: f64, h: f64) -> (f64, f64) {
    let mean = 6.0 * dp / (h * h);
    (mean - (4.0 * v0 + 2.0 * v1) / h, -mean + (2.0 * v0 + 4.0 * v1) / h)
}

/// Largest |velocity| of a segment by (3), and the u in [0, 1] where it is.
pub(crate) fn peak_velocity(dp: f64, v0: f64, v1: f64, h: f64) -> (f64, f64) {
    let middle = 3.0 * dp / h - v0 - v1;
    let mut peak = if v0.abs() >= v1.abs() { (v0.abs(), 0.0) } else { (v1.abs(), 1.0) };
    // v'(u) = 0 at u = (v0 - V) / (v0 - 2V + v1), where v = (v0 v1 - V^2) / (v0 - 2V + v1)
    let curvature = v0 - 2.0 * middle + v1;
    let u = (v0 - middle) / curvature;
    if u > 0.0 && u < 1.0 {
        let value = (1.0 - u) * ((1.0 - u) * v0 + u * middle) + u * ((1.0 - u) * middle + u * v1);
        if value.abs() > peak.0 {
            peak = (value.abs(), u);
        }
    }
    peak
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A limit that is never active, within a few orders of magnitude of the numbers.
    const FREE: f64 = 1e4;

    fn problem(points: &[f64], mode: Mode, max_acceleration: f64) -> AxisProblem<'static> {
        let displacement_mm = points.windows(2).map(|w| w[1] - w[0]).collect();
        let max_jerk = f64::INFINITY;
        AxisProblem { displacement_mm, mode, max_velocity: FREE, max_acceleration, max_jerk }
    }

    fn velocities(points: &[f64], h: &[f64], mode: Mode, max_acceleration: f64) -> Vec<f64> {
        solve(&problem(points, mode, max_acceleration), h).unwrap().velocity
    }

    fn solve(problem: &AxisProblem, h: &[f64]) -> Result<Solved, Vec<f64>> {
        problem.solve(h, || problem.elastic_price(h), &mut Rounds::default())
    }

    fn close(a: &[f64], b: &[f64], tolerance: f64) {
        assert_eq!(a.len(), b.len());
        assert!(a.iter().zip(b).all(|(x, y)| (x - y).abs() < tolerance), "{a:?} {b:?}");
    }

    #[test]
    fn smooth_is_the_clamped_cubic_spline() {
        // Solved by hand: 4 v1 + v2 = 9, v1 + 4 v2 = 9.
        let v = velocities(&[0.0, 1.0, 3.0, 4.0], &[1.0; 3], Mode::Smooth, FREE);
        close(&v, &[0.0, 1.8, 1.8, 0.0], 1e-14);
        let a: Vec<(f64, f64)> = [1.0, 2.0, 1.0]
            .iter()
            .enumerate()
            .map(|(i, dp)| accelerations(*dp, v[i], v[i + 1], 1.0))
            .collect();
        for (found, expected) in a.iter().zip([(2.4, 1.2), (1.2, -1.2), (-1.2, -2.4)]) {
            assert!((found.0 - expected.0).abs() + (found.1 - expected.1).abs() < 1e-13, "{a:?}");
        }
        assert!((peak_velocity(2.0, 1.8, 1.8, 1.0).0 - 2.1).abs() < 1e-14);
        let v = velocities(&[0.0, 1.0, 2.0, 3.0, 2.0], &[1.0; 4], Mode::Smooth, FREE);
        close(&v, &[0.0, 1.178_571_43, 1.285_714_29, -0.321_428_57, 0.0], 1e-8);
    }

    #[test]
    fn monotone_never_reverses_and_has_the_least_energy() {
        // Minimisers of (4) under the signs, from the optimality conditions of each case; the
        // interior point method reaches 1e-14 of the objective, 1e-7 of the velocity.
        let mono = |p: &[f64], h: &[f64], a: f64| velocities(p, h, Mode::Monotone, a);
        close(&mono(&[0.0, 1.0, 2.0, 3.0, 2.0], &[1.0; 4], FREE), &[0.0, 1.2, 1.2, 0.0, 0.0], 1e-6);
        let (p, h) = ([0.0, 1.0, 2.0, 3.0, 4.0], [1.0, 0.3, 1.0, 1.0]);
        close(&mono(&p, &h, FREE), &[0.0, 3.0, 2.75, 0.25, 0.0], 1e-6);
        close(&mono(&p, &h, 8.0), &[0.0, 3.0, 2.9, 0.1, 0.0], 1e-6);
        close(&mono(&[0.0, 1.0, 1.0, 3.0], &[1.0, 0.5, 2.0], FREE), &[0.0; 4], 1e-12);
    }

    #[test]
    fn the_parts_are_the_whole() {
        // Runs of a few segments to and fro with rests between; limits that some of them reach.
        let wave = |i: i32| (f64::from(i) * 0.37).sin() + 0.4 * (f64::from(i) * 1.9).sin();
        let dp: Vec<f64> = (0..700).map(|i| if i % 31 == 0 { 0.0 } else { wave(i) }).collect();
        let h: Vec<f64> = (0..700).map(|i| 0.6 + 0.2 * f64::from(i * 7 % 5)).collect();
        let mut p = problem(&break_times(&dp), Mode::Monotone, 0.0);
        // Loose; active here and there; too tight for some parts.
        for (limit, feasible) in [(40.0, true), (15.0, true), (8.0, false)] {
            p.max_acceleration = limit;
            let mut parts = p.parts();
            p.solve_parts(&h, &mut parts);
            let solved = parts.iter().filter(|part| matches!(part.solved, Some(Ok(_)))).count();
            match solve(&p, &h) {
                Ok(whole) => {
                    assert!(feasible && solved == parts.len() && solved > 5, "{limit} {solved}");
                    // The root of the tolerance of 1e-14 where a bound is only just active.
                    close(&joined(parts).velocity, &whole.velocity, 1e-6);
                }
                Err(whole) => {
                    assert!(!feasible && solved > 0 && solved < parts.len(), "{limit} {solved}");
                    let excess = excess_of_parts(&[parts, Vec::new()], h.len()).unwrap();
                    // The tolerance of the elastic program, whose largest term is the price.
                    close(&excess, &whole, 1e-5);
                }
            }
        }
    }

    #[test]
    fn the_quadratic_program_without_active_bounds_is_the_tridiagonal_solution() {
        let p = [0.0, 0.7, 1.9, 2.4, 2.2, -1.0, -1.5, 0.3];
        let h = [0.3, 0.4, 0.11, 0.7, 0.9, 0.25, 0.6];
        let problem = problem(&p, Mode::Smooth, FREE);
        let (a, b) = (
            problem.clamped_spline(&h),
            problem.quadratic_program(&h, Bounds::Hard, &mut Rounds::default()).unwrap(),
        );
        // The interior point method starts from the same elimination: nothing is active.
        close(&a, &b, 1e-12);
    }

    #[test]
    fn an_active_limit_holds_and_costs_energy_but_no_time() {
        let p = [0.0, 1.0, 3.0, 4.0];
        let h = [1.0; 3];
        let free = velocities(&p, &h, Mode::Smooth, FREE);
        let bounded = solve(&problem(&p, Mode::Smooth, 2.2), &h).unwrap();
        assert_eq!(bounded.solver, Solver::QuadraticProgram);
        let energy = |v: &[f64]| -> f64 {
            (0..3)
                .map(|i| {
                    let (a, b) = accelerations(p[i + 1] - p[i], v[i], v[i + 1], 1.0);
                    (a * a + a * b + b * b) / 3.0
                })
                .sum()
        };
        assert!(
            problem(&p, Mode::Smooth, 2.2)
                .excess(&bounded.velocity, &h)
                .iter()
                .all(|e| *e < 1.0 + 1e-6)
        );
        assert!(energy(&bounded.velocity) > energy(&free));
        // Below 2 no velocities exist: 1 mm from rest, 2 mm, 1 mm to rest in 1 s each.
        assert!(solve(&problem(&p, Mode::Smooth, 1.5), &h).is_err());
    }

    #[test]
    fn stretching_costs_no_more_time_than_stopping_in_between() {
        // 1 mm from rest in 1 ms, then 1 mm in 1 s: the second segment can brake with ease.
        let mut h = vec![1.0 / 250.0, 1.0];
        let mut p = problem(&[0.0, 1.0, 2.0], Mode::Smooth, 2000.0);
        p.max_velocity = 250.0;
        for _ in 0..40 {
            match solve(&p, &h) {
                Ok(_) => break,
                Err(e) => h.iter_mut().zip(e).for_each(|(h, e)| *h *= 1.002 * e.clamp(1.0, 1.5)),
            }
        }
        assert!(solve(&p, &h).is_ok());
        // From rest 1 mm takes at least sqrt(2 / 2000) = 31.6 ms, and sqrt(6 / 2000) = 54.8 ms to
        // rest: what the second segment gets is less than the difference.
        assert!(h[0] > 0.0316 && h[0] < 0.0549 && h[1] < 1.0233, "{h:?}");
    }

    #[test]
    fn one_segment_with_limited_jerk_by_hand() {
        // 1 mm in 4 s: j = 32 / 64, a(1) = 1/2, v(2) = 1/2.
        let (p, v) = problem(&[0.0, 1.0], Mode::Smooth, FREE).smooth_from_rest(&[4.0]);
        close(&v, &[0.0, 0.25, 0.5, 0.25, 0.0], 1e-15);
        for (i, expected) in [(0.0, 0.5), (0.5, 0.0), (0.0, -0.5), (-0.5, 0.0)].iter().enumerate() {
            let a = accelerations(p.displacement_mm[i], v[i], v[i + 1], 1.0);
            assert!((a.0 - expected.0).abs() + (a.1 - expected.1).abs() < 1e-14, "{i}: {a:?}");
        }
    }

    #[test]
    fn with_limited_jerk_the_acceleration_is_continuous_from_zero_to_zero() {
        for n in 2..8 {
            let x: Vec<f64> = (0..=n).map(|i| f64::from((i * i * 7) % 11)).collect();
            let h: Vec<f64> = (0..n).map(|i| 0.5 + 0.1 * f64::from((i * 5) % 4)).collect();
            let (p, v) = problem(&x, Mode::Smooth, FREE).smooth_from_rest(&h);
            let mut u = vec![0.5 * h[0]; 2];
            u.extend(&h[1..h.len() - 1]);
            u.extend([0.5 * h[h.len() - 1]; 2]);
            assert_eq!((p.displacement_mm.len(), v.len()), (u.len(), u.len() + 1));
            let mut before = 0.0;
            for i in 0..u.len() {
                let (start, end) = accelerations(p.displacement_mm[i], v[i], v[i + 1], u[i]);
                // Rounding of accelerations up to 1e3 mm/s^2.
                assert!((start - before).abs() < 1e-11, "{n} {i}: {before} {start}");
                before = end;
            }
            assert!(before.abs() < 1e-11, "{n}: {before}");
        }
    }

    #[test]
    fn the_peak_between_nodes_is_bounded_not_only_the_nodes() {
        // Rest to rest: the nodes are at zero, the middle at 1.5 times the mean velocity.
        let mut one = problem(&[0.0, 1.0], Mode::Smooth, FREE);
        one.max_velocity = 1.49;
        let excess = solve(&one, &[1.0]).unwrap_err();
        assert!((excess[0] - 1.5 / 1.49).abs() < 1e-12);
        one.max_velocity = 1.51;
        assert!(solve(&one, &[1.0]).is_ok());
    }
}
