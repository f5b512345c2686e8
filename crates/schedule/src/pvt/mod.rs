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
//! spline. If that exceeds a limit, (4) is solved under `|v| <= v_max`, `|a| <= a_max` on whole
//! segments as a quadratic program. If it has no solution, the quadratic program with the least excess
//! over the limits shows the segments that need more time. `shortest` searches for the shortest times
//! there, and (4) is solved again at those. The report has the additional times.
//!
//! Modes: *smooth* is (4). In *monotone*, in addition, no axis reverses inside a segment, so the tool
//! never leaves the box of a segment's ends: `v_i` has the sign of its two displacements (zero if they
//! differ), and `sign(dp) V >= 0`. A node at which the velocity is fixed at zero divides the axis:
//! neither (4) nor a bound couples its two sides. So the parts are solved one by one, and only those
//! whose times have changed are solved again.
//!
//! A limit on jerk. The jerk of (1) is constant, `6 (v0 + v1)/h^2 - 12 dp/h^3`. If the machine limits
//! it, *monotone* has it as rows of its quadratic program. Its acceleration still steps at the nodes, which no
//! limit on jerk allows, and the claim says so. *smooth* must not use a quadratic program then, because an
//! active row makes the acceleration step. It is the spline whose acceleration also starts and ends
//! at zero. That needs one more node, at a free position, at half the time of the first and of the
//! last segment. With `tau = h/2`, the jerk `j` of the first half is, from rest to `v` at `dp`,
//!
//! ```text
//! j = 3 dp / (2 tau^3) - v / (2 tau^2),   a- = 6 v/h - 12 dp/h^2                        (5)
//! ```
//!
//! and (5) replaces (2) in the equations `a- = a+`. (One segment from rest to rest: four quarters
//! of `j = 32 dp/h^3` with the signs + - - +.) Segments that exceed a limit are slowed. Every limit is
//! then kept, with continuous acceleration, but not in the least time.
//!
//! Source: T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005, Eqs 8-18,
//! in the node velocities instead of polynomial coefficients. Positions and times are then exact. The
//! least squares of the source weighs their errors against accelerations, in different units.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | h | `duration_s` | (N) | s |
//! | dp | `displacement_mm` | (N) | mm |
//! | v | `velocity_mm_per_s` | (N+1) | mm/s |

mod axis;
mod jerk_limited;
mod mode;
mod near_path;
mod shortest;
mod timing;

use std::borrow::Cow;

use planish_types::{DwellTime, Invalid, Limits, ToolPath, Trajectory, break_times};
use rayon::prelude::*;
use serde::Serialize;

pub use self::{
    axis::Solver,
    mode::{Mode, ModeChoice},
    timing::Stretched,
};
pub(crate) use timing::durations_s;

use self::{
    axis::{AxisProblem, Part, Solved, excess_of_parts, joined, velocity_of_parts},
    near_path::NearPath,
    shortest::Search,
    timing::{Timing, parallel, too_short, worst},
};
use crate::{Schedule, ScheduleError, Scheduled, Scheduler, check_lengths, hermite::coefficients};

/// Settings of the PVT scheduler.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PvtSettings {
    /// Objective of the motion: least acceleration energy (smooth), or that without reversal in a segment (monotone).
    pub mode: Mode,
    /// True: segments get more time if the limits need it. False: the scheduler refuses such dwell times.
    pub stretch: bool,
    /// Largest distance of the motion from its path, mm; the usual tolerance of the path
    /// ([`ToolPath::tolerance_mm`]) when absent. Smaller: slower motions that stop at corners.
    #[serde(skip)]
    pub max_path_distance_mm: Option<f64>,
}

impl PvtSettings {
    /// Returns the settings of a mode with the defaults: segments may be stretched, and the path has its usual
    /// tolerance.
    pub fn new(mode: Mode) -> Self {
        Self { mode, stretch: true, max_path_distance_mm: None }
    }
}

/// Stretched segments, held nodes and solvers of a schedule.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PvtReport {
    /// Segments whose time the scheduler lengthened, in order of the path.
    pub stretched: Vec<Stretched>,
    /// Time by which segments with the tool on were stretched in all, s.
    pub added_tool_on_s: f64,
    /// Time by which segments with the tool off (lifts) were stretched in all, s.
    pub added_tool_off_s: f64,
    /// Indices of the segments that the motion leaves out: they have neither length nor dwell time, and the controller
    /// has no shortest segment.
    pub dropped: Vec<usize>,
    /// Number of nodes whose velocity the scheduler bounds or reduces, because the motion would leave its path by more
    /// than the tolerance.
    pub held_nodes: usize,
    /// Solver of the least-energy problem, (4) of the module, for [x, y], at the final times.
    pub solver: [Solver; 2],
    /// Number of sweeps of the search for the shortest times, or of rounds of stretching under a limit on jerk. 0 if
    /// the machine can follow the dwell times.
    pub rounds: usize,
}

impl Scheduler for PvtSettings {
    fn name(&self) -> &'static str {
        "pvt"
    }

    fn kind(&self) -> Option<&'static str> {
        Some(self.mode.name())
    }

    fn schedule(
        &self,
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
    ) -> Result<Scheduled, ScheduleError> {
        let Schedule { trajectory, report } = schedule(path, dwell, limits, self)?;
        let changed = report.stretched.iter().map(|s| (s.segment, s.scheduled_s)).collect();
        Ok(Scheduled { trajectory, changed })
    }
}

/// Schedules `path` with the times `dwell` within `limits`, and reports the segments that it stretched.
///
/// # Errors
///
/// Refuses dwell times of another path, and a path without a length whose dwell times are all zero. Without stretching
/// it refuses dwell times that the machine cannot follow. Under a limit on jerk it fails if the limits are still
/// exceeded after the last round.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    settings: &PvtSettings,
) -> Result<Schedule<PvtReport>, ScheduleError> {
    check_lengths(path, dwell)?;
    // The whole runs on the threads of rayon: handing over every part by itself would cost more than a part.
    rayon::scope(|_| schedule_stretched(path, dwell, limits, settings))
}

fn schedule_stretched(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    settings: &PvtSettings,
) -> Result<Schedule<PvtReport>, ScheduleError> {
    let mut timing = Timing::new(path, dwell, limits);
    if timing.segments.is_empty() {
        let problem = "is zero everywhere on a path at rest";
        return Err(Invalid::whole("dwell_s", problem, "give a dwell time").into());
    }
    if !settings.stretch
        && let Some(error) = timing.refusal(path, dwell, limits)
    {
        return Err(error);
    }
    let displacement_mm: Vec<[f64; 2]> =
        timing.segments.iter().map(|segment| path.displacement_mm(*segment)).collect();
    let mut axes = [0, 1].map(|axis| {
        let displacement_mm =
            parallel(timing.segments.len()).map(|k| displacement_mm[k][axis]).collect();
        AxisProblem::new(displacement_mm, settings.mode, &limits.axes()[axis])
    });
    let tolerance_mm = path.tolerance_mm(settings.max_path_distance_mm)?;
    let near = NearPath::new(displacement_mm, tolerance_mm);
    if settings.mode == Mode::Smooth && axes.iter().any(|a| a.max_jerk.is_finite()) {
        let (trajectory, rounds, held_nodes) =
            jerk_limited::motion(path, dwell, limits, settings.stretch, &mut timing, &axes, &near)?;
        let solver = [Solver::Tridiagonal; 2];
        let report = PvtReport::new(&timing, path, dwell, solver, rounds, held_nodes);
        return Ok(Schedule { trajectory, report });
    }

    let mut parts = axes.each_ref().map(AxisProblem::parts);
    let (break_time_s, h) = differences(&timing.duration_s);
    let held_nodes = solve_near_path(&mut axes, &near, &h, &mut parts);
    let Some(excess) = excess_of_parts(&parts, h.len()) else {
        return joined_motion(path, dwell, &timing, &axes, parts, break_time_s, [0, held_nodes]);
    };
    if !settings.stretch {
        let (k, worst) = worst(&excess);
        return Err(too_short(path, dwell, timing.segments[k], worst));
    }
    let exceed: Vec<bool> = excess.iter().map(|e| *e > 1.0).collect();
    let before = parts.each_ref().map(|parts| velocity_of_parts(parts));
    let shortest = Search::new(&axes, &near, &timing.duration_s).run(&before, &exceed);
    let changed: Vec<bool> =
        shortest.duration_s.iter().zip(&timing.duration_s).map(|(a, b)| a != b).collect();
    timing.duration_s = shortest.duration_s;
    let (break_time_s, h) = differences(&timing.duration_s);
    for part in parts.iter_mut().flatten() {
        if matches!(part.solved, Some(Err(_))) || changed[part.segments.clone()].contains(&true) {
            part.solved = None;
        }
    }
    axes.iter_mut().for_each(|axis| axis.velocity_range = Cow::Borrowed(&[]));
    let held_nodes = solve_near_path(&mut axes, &near, &h, &mut parts);
    take_least_times(&mut parts, &shortest.velocity, |part| matches!(part.solved, Some(Err(_))));
    // One axis by the quadratic program and the other one by the search may leave the path together.
    let [x, y] = parts.each_ref().map(|parts| velocity_of_parts(parts));
    if !near.far_segments([&x, &y], &h).is_empty() {
        take_least_times(&mut parts, &shortest.velocity, |_| true);
    }
    joined_motion(path, dwell, &timing, &axes, parts, break_time_s, [shortest.sweeps, held_nodes])
}

/// Replaces the solution of the parts for which `chosen` returns true by the node velocities of the search for the
/// shortest times.
fn take_least_times(
    parts: &mut [Vec<Part>; 2],
    velocity: &[Vec<f64>; 2],
    chosen: impl Fn(&Part) -> bool,
) {
    for (parts, velocity) in parts.iter_mut().zip(velocity) {
        for part in parts.iter_mut().filter(|part| chosen(part)) {
            let velocity = velocity[part.segments.start..=part.segments.end].to_vec();
            part.solved = Some(Ok(Solved { velocity, solver: Solver::LeastTime }));
        }
    }
}

/// Solves the parts of both axes that are not solved yet at the durations `h`, s. Where the motion leaves its path by
/// more than the tolerance, it bounds the velocities of the nodes beside and solves their parts again. Returns the
/// number of these nodes.
fn solve_near_path(
    axes: &mut [AxisProblem<'_>; 2],
    near: &NearPath,
    h: &[f64],
    parts: &mut [Vec<Part>; 2],
) -> usize {
    let mut held = vec![false; h.len() + 1];
    loop {
        solve_parts(axes, h, parts);
        let velocity = parts.each_ref().map(|parts| velocity_of_parts(parts));
        let far = near.far_segments([&velocity[0], &velocity[1]], h);
        let nodes = far.iter().flat_map(|i| [*i, i + 1]);
        let mut more = false;
        for node in nodes.filter(|node| *node > 0 && *node < h.len()) {
            if std::mem::replace(&mut held[node], true) {
                continue;
            }
            more = true;
            let held_velocity = near.held(node, [velocity[0][node], velocity[1][node]], h);
            let range = near.velocity_range(node, held_velocity, h);
            for a in 0..2 {
                axes[a].bound_velocity(node, range[a]);
                let first = parts[a].partition_point(|part| part.segments.end < node);
                let beside = parts[a][first..].iter_mut();
                beside
                    .take_while(|part| part.segments.start <= node)
                    .for_each(|part| part.solved = None);
            }
        }
        if !more {
            return held.iter().filter(|held| **held).count();
        }
    }
}

/// Returns the break times (N+1), s, and the durations (N) as their differences, so that the segments join to rounding.
fn differences(duration_s: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let break_time_s = break_times(duration_s);
    let h = parallel(duration_s.len()).map(|k| break_time_s[k + 1] - break_time_s[k]);
    let h = h.collect();
    (break_time_s, h)
}

/// Solves the parts of both axes that are not solved yet at the durations `h`, s.
fn solve_parts(axes: &[AxisProblem<'_>; 2], h: &[f64], parts: &mut [Vec<Part>; 2]) {
    let [x, y] = parts;
    rayon::join(|| axes[0].solve_parts(h, x), || axes[1].solve_parts(h, y));
}

/// Returns the schedule from the solutions of all parts; the last argument is the number of rounds and of held nodes
/// for the report.
fn joined_motion(
    path: &ToolPath,
    dwell: &DwellTime,
    timing: &Timing,
    axes: &[AxisProblem<'_>; 2],
    parts: [Vec<Part>; 2],
    break_time_s: Vec<f64>,
    [rounds, held_nodes]: [usize; 2],
) -> Result<Schedule<PvtReport>, ScheduleError> {
    let [x, y] = parts.map(joined);
    let report = PvtReport::new(timing, path, dwell, [x.solver, y.solver], rounds, held_nodes);
    let velocity = [x.velocity, y.velocity];
    let n = timing.segments.len();
    let segments = parallel(n).map(|k| {
        let start = path.point_mm()[timing.segments[k]];
        let h = break_time_s[k + 1] - break_time_s[k];
        [0, 1].map(|axis| {
            let v = &velocity[axis];
            let dp = axes[axis].displacement_mm[k];
            coefficients(start[axis], dp, v[k], v[k + 1], h)
        })
    });
    let segments = segments.collect();
    let trajectory = Trajectory::new(
        break_time_s,
        segments,
        parallel(n).map(|k| path.tool_on()[timing.segments[k]]).collect(),
        parallel(n).map(|k| Some(timing.segments[k])).collect(),
    )?;
    Ok(Schedule { trajectory, report })
}

impl PvtReport {
    fn new(
        timing: &Timing,
        path: &ToolPath,
        dwell: &DwellTime,
        solver: [Solver; 2],
        rounds: usize,
        held_nodes: usize,
    ) -> Self {
        let stretched = timing.stretched(path, dwell);
        let [added_tool_on_s, added_tool_off_s] = [true, false].map(|tool_on| {
            let segments = stretched.iter().filter(|s| s.tool_on == tool_on);
            segments.map(|s| s.scheduled_s - s.dwell_s).fold(0.0, |a, b| a + b)
        });
        Self {
            added_tool_on_s,
            added_tool_off_s,
            dropped: timing.dropped(path),
            held_nodes,
            stretched,
            solver,
            rounds,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_testkit::{ion_beam, numbers};

    #[test]
    fn short_and_long_segments_that_are_too_fast_are_slowed_as_little_as_the_machine_needs() {
        // Ten lines of segments from 0.01 to 1.2 mm, at densities from 0.006 to 0.034 s/mm: too fast for the machine.
        let mut random = numbers(8);
        let (mut points, mut dwell_s) = (vec![[0.0, 0.0]], Vec::new());
        for line in 0..10 {
            let sign = if line % 2 == 0 { 1.0 } else { -1.0 };
            for _ in 0..60 {
                let (length_mm, density) = (0.01 * 120f64.powf(random()), random());
                let [x, y] = points[points.len() - 1];
                points.push([x + sign * length_mm, y]);
                dwell_s.push((0.02 * length_mm * (0.3 + 1.4 * density)).max(1e-4));
            }
            if line < 9 {
                let [x, y] = points[points.len() - 1];
                points.push([x, y + 1.0]);
                dwell_s.push(0.02);
            }
        }
        let n = dwell_s.len();
        let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
        let limits = ion_beam();
        let settings = PvtSettings::new(Mode::Monotone);
        let dwell = DwellTime::new(dwell_s).unwrap();
        let found = schedule(&path, &dwell, &limits, &settings).unwrap();
        // With segments slowed one by one, each by its excess, it was 7.7 s.
        let total_s = found.trajectory.total_time_s();
        assert!(total_s < 7.0, "{total_s}");
    }

    #[test]
    fn a_spiral_that_is_far_too_fast_takes_little_more_than_its_least_time() {
        // 900 segments at 500 mm/s on an axis of 7 mm/s and 12 mm/s^2. From rest to rest they take 73 s.
        let point = |k: usize| {
            let angle = 12.0 * k as f64 / 900.0;
            [3.0 * angle * angle.cos(), 3.0 * angle * angle.sin()]
        };
        let path = ToolPath::through((0..=900).map(point).collect(), vec![true; 900], vec![0; 900]);
        let path = path.unwrap();
        let limits = planish_testkit::machine([7.0, 280.0], [12.0, 1100.0]);
        let x_mm: f64 = (0..900).map(|i| path.displacement_mm(i)[0].abs()).sum();
        let least_s = x_mm / 7.0;
        let dwell_s = (0..900).map(|i| path.segment_length_mm(i) / 500.0 + 1e-4).collect();
        let dwell = DwellTime::new(dwell_s).unwrap();
        for mode in [Mode::Monotone, Mode::Smooth] {
            let settings = PvtSettings::new(mode);
            let found = schedule(&path, &dwell, &limits, &settings).unwrap();
            let total_s = found.trajectory.total_time_s();
            // Slowed one by one, each by its excess, they took six times as long.
            assert!(total_s > least_s && total_s < 1.2 * least_s, "{mode:?}: {total_s} {least_s}");
            assert!(found.report.solver.iter().all(|s| *s != Solver::LeastTime));
        }
    }

    #[test]
    fn no_motion_takes_more_time_than_one_that_stops_in_every_control_point() {
        // Lines of segments from 5 to 40 mm, every third one of 1 to 10 um, and every third dwell time is zero.
        for seed in 0..6 {
            let mut random = numbers(seed);
            let (mut points, mut dwell_s) = (vec![[0.0, 0.0]], Vec::new());
            for _ in 0..170 {
                let short = random() < 0.3;
                let length_mm = random() * if short { 0.009 } else { 35.0 };
                let [x, y] = points[points.len() - 1];
                points.push([x + length_mm + if short { 0.001 } else { 5.0 }, y]);
                dwell_s.push(if random() < 0.3 { 0.0 } else { 0.01 + 0.49 * random() });
            }
            let n = dwell_s.len();
            let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
            let limits = ion_beam();
            let [v, a] =
                [limits.max_velocity_mm_per_s()[0], limits.max_acceleration_mm_per_s2()[0]];
            let rest_to_rest_s = |i: usize| {
                let length_mm = path.segment_length_mm(i);
                (6.0 * length_mm / a).sqrt().max(1.5 * length_mm / v)
            };
            let stops_s: f64 = (0..n).map(|i| dwell_s[i].max(rest_to_rest_s(i))).sum();
            let dwell = DwellTime::new(dwell_s).unwrap();
            for mode in [Mode::Monotone, Mode::Smooth] {
                let settings = PvtSettings::new(mode);
                let found = schedule(&path, &dwell, &limits, &settings).unwrap();
                let total_s = found.trajectory.total_time_s();
                // The search leaves 0.001 free for the quadratic program (`shortest::ROOM`).
                assert!(total_s < 1.0011 * stops_s, "{seed} {mode:?}: {total_s} {stops_s}");
            }
        }
    }
}
