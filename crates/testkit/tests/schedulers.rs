//! Every scheduler along random paths, judged by `planish-verify` and by invariants.
//!
//! `PLANISH_SEED`, `PLANISH_FIRST` and `PLANISH_CASES` choose the random cases. A failing case is
//! named by its population, seed and number; `PLANISH_SEED=s PLANISH_FIRST=number PLANISH_CASES=1`
//! runs it again. The long test is `PLANISH_CASES=5051`: 1e6 schedules, 18 of every case of 11
//! populations, and a table of what came of them. It can be run in pieces: `PLANISH_COUNTS` names a
//! file that keeps the counts of all pieces, and the table is then that of their sum.

use std::sync::{LazyLock, Mutex};

use planish_schedule::{
    Choices, Named, SCHEDULERS as TABLE, Scheduled,
    baselines::{average_velocity, position, pvt_as_published},
    claim::measured_claim,
    constant_acceleration,
    interpolator::{self, Interpolator},
    pvt::{self, Mode},
    stop_at_corners,
    trig_spline::{self, Repair},
};
use planish_testkit::{case_generator, ion_beam, machine};
use planish_types::{DwellTime, Limits, MachineFile, ToolPath, Trajectory};
use planish_verify::{AxisVerdict, Check, Verdict, VerifySettings, verify};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Velocity limit that no motion reaches, mm/s, for a machine without limits.
const FREE: f64 = 1e9;

/// Tolerance of the distance from the path that no motion reaches, mm.
const ANYWHERE_MM: f64 = 1e12;

/// Input of a scheduler.
#[derive(Clone, Debug)]
struct Case {
    points: Vec<[f64; 2]>,
    dwell_s: Vec<f64>,
    limits: Limits,
}

impl Case {
    fn path(&self) -> ToolPath {
        let n = self.dwell_s.len();
        ToolPath::through(self.points.clone(), vec![true; n], vec![0; n]).unwrap()
    }

    fn dwell(&self) -> DwellTime {
        DwellTime::new(self.dwell_s.clone()).unwrap()
    }

    /// The case without limits. A segment with a length and without a time gets 0.5 s, because nothing else
    /// defines its time.
    fn free(&self) -> Self {
        let mut free = Self { limits: machine([FREE; 2], [1e15; 2]), ..self.clone() };
        for (t, w) in free.dwell_s.iter_mut().zip(self.points.windows(2)) {
            if *t == 0.0 && w[0] != w[1] {
                *t = 0.5;
            }
        }
        free
    }

    /// Relative rounding of the shortest duration, the difference of two break times, and of what
    /// is proportional to it.
    fn rounding(&self) -> f64 {
        let kept = self.dwell_s.iter().filter(|t| **t > 0.0);
        let shortest_s = kept.fold(f64::INFINITY, |m, t| m.min(*t));
        f64::EPSILON * self.dwell_s.iter().sum::<f64>() / shortest_s
    }

    /// Limits of the case with a limit on jerk: its own, or that of a slow stage.
    fn with_jerk(&self) -> Limits {
        let mut file = MachineFile::from(&self.limits);
        for (axis, jerk) in file.axes.iter_mut().zip([5e3, 2e3]) {
            axis.max_jerk_mm_per_s3.get_or_insert(jerk);
        }
        file.checked().unwrap()
    }

    fn without_jerk(&self) -> Limits {
        let mut file = MachineFile::from(&self.limits);
        file.axes.iter_mut().for_each(|axis| axis.max_jerk_mm_per_s3 = None);
        file.checked().unwrap()
    }

    /// The motion without a tolerance of its distance from the path.
    fn pvt(&self, mode: Mode) -> Result<planish_schedule::Schedule<pvt::PvtReport>, String> {
        let settings = pvt::PvtSettings {
            max_path_distance_mm: Some(ANYWHERE_MM),
            ..pvt::PvtSettings::new(mode)
        };
        pvt::schedule(&self.path(), &self.dwell(), &self.limits, &settings)
            .map_err(|e| e.to_string())
    }

    fn constant_acceleration(
        &self,
    ) -> Result<planish_schedule::Schedule<constant_acceleration::ConstantAccelerationReport>, String>
    {
        constant_acceleration::schedule(&self.path(), &self.dwell(), &self.limits)
            .map_err(|e| e.to_string())
    }

    /// Largest distance of a control point from the origin, mm.
    fn extent_mm(&self) -> f64 {
        self.points.iter().flatten().fold(0.0, |m, p| p.abs().max(m))
    }
}

/// A motion, and the report of its scheduler on the time that it added.
struct Motion {
    trajectory: Trajectory,
    /// True if the scheduler reports segments with the tool on that last longer than their dwell time.
    stretched: bool,
    /// Added time of these segments, s.
    added_s: f64,
    /// True if every segment with the tool on keeps its own dwell time, not only their sum.
    one_by_one: bool,
}

/// Motion of a scheduler, or the reason of a refusal.
type Schedule = dyn Fn(&ToolPath, &DwellTime, &Limits) -> Result<Motion, String> + Send + Sync;

/// The schedulers under test, by name: those that report more than the times of their segments, and every other one
/// in the table of `planish-schedule`.
static SCHEDULERS: LazyLock<Vec<(&str, Box<Schedule>)>> = LazyLock::new(|| {
    let mut all: Vec<(&str, Box<Schedule>)> = WITH_REPORTS
        .into_iter()
        .map(|(name, schedule)| (name, Box::new(schedule) as Box<Schedule>))
        .collect();
    for named in &TABLE {
        let is_there =
            |(name, _): &(&str, Box<Schedule>)| name.split(' ').next() == Some(named.name);
        if !all.iter().any(is_there) {
            all.push((named.name, Box::new(|p, d, l| named_motion(named, p, d, l))));
        }
    }
    all
});

/// The motion of a scheduler of the table, with the added times that it states.
fn named_motion(
    named: &Named,
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
) -> Result<Motion, String> {
    let scheduler = named.scheduler(&Choices::default(), limits);
    let Scheduled { trajectory, changed } =
        scheduler.schedule(path, dwell, limits).map_err(|e| e.to_string())?;
    let added = |(i, took): &(usize, f64)| {
        if path.tool_on()[*i] { (took - dwell.dwell_s()[*i]).max(0.0) } else { 0.0 }
    };
    let added_s = changed.iter().map(added).sum();
    Ok(Motion { trajectory, stretched: added_s > 0.0, added_s, one_by_one: true })
}

/// A scheduler by name, with what its own report says.
type WithReport = (&'static str, fn(&ToolPath, &DwellTime, &Limits) -> Result<Motion, String>);

const WITH_REPORTS: [WithReport; 11] = [
    ("pvt smooth", |p, d, l| pvt_motion(p, d, l, Mode::Smooth)),
    ("pvt monotone", |p, d, l| pvt_motion(p, d, l, Mode::Monotone)),
    ("pvt smooth, jerk limited", |p, d, l| pvt_motion(p, d, l, Mode::Smooth)),
    ("pvt monotone, jerk limited", |p, d, l| pvt_motion(p, d, l, Mode::Monotone)),
    ("pvt-as-published", |p, d, l| {
        let s = pvt_as_published::schedule(p, d, l, &Default::default());
        s.map(|s| unstretched(s.trajectory)).map_err(|e| e.to_string())
    }),
    ("constant-acceleration", |p, d, l| {
        let s = constant_acceleration::schedule(p, d, l).map_err(|e| e.to_string())?;
        let stretched = s.report.late_segments > 0;
        Ok(Motion {
            trajectory: s.trajectory,
            stretched,
            added_s: s.report.added_s,
            one_by_one: true,
        })
    }),
    ("stop-at-corners", |p, d, l| {
        let s = stop_at_corners::schedule(p, d, l).map_err(|e| e.to_string())?;
        let stretched = s.report.late_segments > 0;
        Ok(Motion {
            trajectory: s.trajectory,
            stretched,
            added_s: s.report.added_s,
            one_by_one: true,
        })
    }),
    ("average-velocity", |p, d, l| {
        let s = average_velocity::schedule(p, d, l).map_err(|e| e.to_string())?;
        let on = s.report.stretched.iter().filter(|s| s.tool_on);
        let added_s = on.map(|s| s.scheduled_s - s.dwell_s).fold(0.0, |a, b| a + b);
        Ok(Motion { trajectory: s.trajectory, stretched: added_s > 0.0, added_s, one_by_one: true })
    }),
    ("trig-spline offset", |p, d, l| trig_motion(p, d, l, Repair::Offset)),
    ("trig-spline local", |p, d, l| trig_motion(p, d, l, Repair::Local)),
    ("position", |p, d, _| position::schedule(p, d).map(unstretched).map_err(|e| e.to_string())),
];

fn unstretched(trajectory: Trajectory) -> Motion {
    Motion { trajectory, stretched: false, added_s: 0.0, one_by_one: true }
}

fn pvt_motion(p: &ToolPath, d: &DwellTime, l: &Limits, mode: Mode) -> Result<Motion, String> {
    let settings = pvt::PvtSettings::new(mode);
    let s = pvt::schedule(p, d, l, &settings).map_err(|e| e.to_string())?;
    let stretched = s.report.stretched.iter().any(|s| s.tool_on);
    Ok(Motion {
        trajectory: s.trajectory,
        stretched,
        added_s: s.report.added_tool_on_s,
        one_by_one: true,
    })
}

fn trig_motion(p: &ToolPath, d: &DwellTime, l: &Limits, repair: Repair) -> Result<Motion, String> {
    let s = trig(p, d, l, repair)?;
    let r = &s.report;
    let repaired = r.feed_offset_s_per_mm + r.acceleration_offset_s_per_mm > 0.0;
    let counts = [r.raised_nodes, r.held_densities, r.slowed_corners, r.evened_pieces];
    let stretched = repaired || counts.iter().any(|n| *n > 0);
    let added_s = r.held_added_s + r.offset_added_s + r.corner_added_s;
    // A held density gives up the time of its own segment; a segment without length gives its time to
    // its neighbours.
    let one_by_one = r.held_densities == 0 && r.moved_dwell.is_empty();
    Ok(Motion { trajectory: s.trajectory, stretched, added_s, one_by_one })
}

fn trig(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    repair: Repair,
) -> Result<trig_spline::TrigSplineSchedule, String> {
    let settings = trig_spline::TrigSplineSettings { repair, ..Default::default() };
    trig_spline::schedule(path, dwell, limits, &settings).map_err(|e| e.to_string())
}

fn with_max_jerk(limits: &Limits, mm_per_s3: [f64; 2]) -> Limits {
    let mut file = MachineFile::from(limits);
    for (axis, j) in file.axes.iter_mut().zip(mm_per_s3) {
        axis.max_jerk_mm_per_s3 = Some(j);
    }
    file.checked().unwrap()
}

fn with_min_segment(limits: &Limits, min_segment_s: f64) -> Limits {
    MachineFile { min_segment_s, ..MachineFile::from(limits) }.checked().unwrap()
}

fn judge(trajectory: &Trajectory, limits: &Limits) -> Verdict {
    verify(trajectory, limits, &VerifySettings::default()).unwrap()
}

fn velocity(c: &[f64; 4], u: f64) -> f64 {
    (3.0 * c[3] * u + 2.0 * c[2]) * u + c[1]
}

/// Fails with this message unless `condition` holds.
fn ensure(condition: bool, message: impl FnOnce() -> String) -> Result<(), String> {
    if condition { Ok(()) } else { Err(message()) }
}

// ---------------------------------------------------------------------------------------------
// Populations

type Population = (&'static str, fn(&mut ChaCha8Rng) -> Case);

/// Populations of random cases; the position in this list is the number of a population's stream.
const POPULATIONS: [Population; 7] = [
    ("easy", easy),
    ("infeasible", infeasible),
    ("unequal", unequal),
    ("raster-like", raster_like),
    ("degenerate", degenerate),
    ("slow-drives", slow_drives),
    ("harsh", harsh),
];

/// A number from the environment variable `name`, or `default` when it is not set.
fn number_from_env(name: &str, default: u64) -> u64 {
    let parse = |text: String| text.parse().unwrap_or_else(|_| panic!("{name}={text}: no number"));
    std::env::var(name).map_or(default, parse)
}

/// A number between `low` and `high`, uniform in its logarithm.
fn log_uniform(generator: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    generator.random_range(low.ln()..high.ln()).exp()
}

/// Points from steps of a length and a direction each.
fn walk(generator: &mut ChaCha8Rng, lengths: &[f64]) -> Vec<[f64; 2]> {
    let mut points =
        vec![[generator.random_range(-50.0..50.0), generator.random_range(-50.0..50.0)]];
    let mut direction = generator.random_range(0.0..std::f64::consts::TAU);
    for length in lengths {
        direction += generator.random_range(-2.0..2.0);
        let [x, y] = points[points.len() - 1];
        points.push([x + length * direction.cos(), y + length * direction.sin()]);
    }
    points
}

fn segments(generator: &mut ChaCha8Rng) -> usize {
    generator.random_range(1..60)
}

fn times(generator: &mut ChaCha8Rng, n: usize, low: f64, high: f64) -> Vec<f64> {
    (0..n).map(|_| log_uniform(generator, low, high)).collect()
}

/// Cases that the machine can follow without more time, or nearly.
fn easy(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 0.2, 2.0);
    Case {
        points: walk(generator, &lengths),
        dwell_s: times(generator, n, 0.1, 2.0),
        limits: ion_beam(),
    }
}

/// Cases with mean speeds up to several times the largest speed of the machine.
fn infeasible(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 0.1, 20.0);
    Case {
        points: walk(generator, &lengths),
        dwell_s: times(generator, n, 0.01, 0.3),
        limits: machine([30.0, 20.0], [200.0, 80.0]),
    }
}

/// Cases with times and lengths over five orders of magnitude.
fn unequal(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 1e-3, 50.0);
    Case {
        points: walk(generator, &lengths),
        dwell_s: times(generator, n, 1e-4, 10.0),
        limits: ion_beam(),
    }
}

/// Cases with lines along x, steps along y, and dwell times that vary slowly.
fn raster_like(generator: &mut ChaCha8Rng) -> Case {
    let (lines, steps) = (generator.random_range(2..6), generator.random_range(3..15));
    let (pitch, step) = (log_uniform(generator, 0.1, 3.0), log_uniform(generator, 0.05, 2.0));
    let mut points = Vec::new();
    for line in 0..lines {
        for k in 0..=steps {
            let k = if line % 2 == 0 { k } else { steps - k };
            points.push([step * f64::from(k), pitch * f64::from(line)]);
        }
    }
    let mut time = log_uniform(generator, 0.02, 1.0);
    let dwell_s = (1..points.len())
        .map(|_| {
            time = (time * generator.random_range(0.8..1.25)).clamp(0.01, 5.0);
            time
        })
        .collect();
    Case { points, dwell_s, limits: ion_beam() }
}

/// Cases with repeated points, times of zero, motion along one axis, exact reversals, equal segments.
fn degenerate(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let along = generator.random_range(0..3);
    let mut points = vec![[0.0; 2]];
    for _ in 0..n {
        let mut next = points[points.len() - 1];
        let step = f64::from(generator.random_range(-2..3));
        let other = f64::from(generator.random_range(-1..2));
        match along {
            0 => next[0] += step,
            1 => next[1] += step,
            _ => next = [next[0] + step, next[1] + other],
        }
        points.push(next);
    }
    let mut dwell_s: Vec<f64> =
        (0..n).map(|_| [0.0, 0.0, 0.01, 1.0, 1.0, 1.0][generator.random_range(0..6)]).collect();
    dwell_s[0] = 1.0;
    Case { points, dwell_s, limits: ion_beam() }
}

/// Cases with accelerations so small that braking takes many segments.
fn slow_drives(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 0.1, 5.0);
    let a = [log_uniform(generator, 0.5, 50.0), log_uniform(generator, 0.5, 50.0)];
    Case {
        points: walk(generator, &lengths),
        dwell_s: times(generator, n, 0.05, 2.0),
        limits: machine([50.0, 50.0], a),
    }
}

/// Cases with everything at once: five orders of magnitude, slow and unlike drives, a least segment time.
fn harsh(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 1e-3, 50.0);
    let mut limit = |low, high| [0, 1].map(|_| log_uniform(generator, low, high));
    let limits = machine(limit(1.0, 300.0), limit(1.0, 3000.0));
    let limits = with_min_segment(&limits, log_uniform(generator, 1e-3, 0.1));
    Case { points: walk(generator, &lengths), dwell_s: times(generator, n, 1e-4, 10.0), limits }
}

/// Populations of every scale, 1e-6 to 1e6, for properties that hold at every scale. The numbers of their
/// streams follow those of [`POPULATIONS`].
const SCALES: [Population; 4] =
    [("scaled", scaled), ("neighbours", neighbours), ("axes", axes), ("everything", everything)];

/// The populations of both tables.
fn all_populations() -> Vec<Population> {
    POPULATIONS.into_iter().chain(SCALES).collect()
}

/// A number between 1e-6 and 1e6.
fn any_scale(generator: &mut ChaCha8Rng) -> f64 {
    log_uniform(generator, 1e-6, 1e6)
}

/// Number of segments, at most as many as [`segments`] gives; small numbers are more frequent.
fn few_segments(generator: &mut ChaCha8Rng) -> usize {
    log_uniform(generator, 1.0, 60.0) as usize
}

/// A machine near these limits on velocity, acceleration and jerk: up to ten times as fast or as
/// slow on either axis, between 1e-6 and 1e6.
fn machine_near(generator: &mut ChaCha8Rng, [v, a, j]: [f64; 3]) -> Limits {
    let mut near =
        |n: f64| [0, 1].map(|_| (n * log_uniform(generator, 0.1, 10.0)).clamp(1e-6, 1e6));
    let limits = machine(near(v), near(a));
    with_max_jerk(&limits, near(j))
}

/// A machine of any limits, on both axes alike or not.
fn any_machine(generator: &mut ChaCha8Rng) -> Limits {
    let mut any = || [0, 1].map(|_| any_scale(generator));
    let (v, a, j) = (any(), any(), any());
    with_max_jerk(&machine(v, a), j)
}

/// Points from steps along x and y, which turn around where they would leave the coordinates that a
/// tool path may have.
fn wander(steps: impl IntoIterator<Item = [f64; 2]>) -> Vec<[f64; 2]> {
    let mut points = vec![[0.0; 2]];
    for step in steps {
        let from = points[points.len() - 1];
        points.push([0, 1].map(|a| match from[a] + step[a] {
            p if p.abs() > 9e6 => from[a] - step[a],
            p => p,
        }));
    }
    points
}

/// A step of this length in any direction.
fn step(generator: &mut ChaCha8Rng, length: f64) -> [f64; 2] {
    let direction = generator.random_range(0.0..std::f64::consts::TAU);
    [length * direction.cos(), length * direction.sin()]
}

/// Cases in any unit of length and of time, with a machine whose limits are near those that the path needs,
/// as far as these are between 1e-6 and 1e6.
fn scaled(generator: &mut ChaCha8Rng) -> Case {
    let (length, time) = (any_scale(generator), any_scale(generator));
    let n = few_segments(generator);
    let mut about = |unit: f64| (unit * log_uniform(generator, 0.3, 3.0)).clamp(1e-6, 1e6);
    let lengths: Vec<f64> = (0..n).map(|_| about(length)).collect();
    let dwell_s = (0..n).map(|_| about(time)).collect();
    let points = wander(lengths.iter().map(|l| step(generator, *l)));
    let v = length / time;
    Case { points, dwell_s, limits: machine_near(generator, [v, v / time, v / time / time]) }
}

/// Cases with neighbours that differ by up to twelve orders of magnitude in length and in time.
fn neighbours(generator: &mut ChaCha8Rng) -> Case {
    let n = few_segments(generator);
    let points = wander((0..n).map(|_| {
        let length = any_scale(generator);
        step(generator, length)
    }));
    let dwell_s = times(generator, n, 1e-6, 1e6);
    Case { points, dwell_s, limits: machine_near(generator, [100.0, 1e3, 1e4]) }
}

/// Cases with steps and limits of the two axes that differ by up to twelve orders of magnitude.
fn axes(generator: &mut ChaCha8Rng) -> Case {
    let n = few_segments(generator);
    let unit = [any_scale(generator), any_scale(generator)];
    let points = wander(
        (0..n).map(|_| unit.map(|u| (u * generator.random_range(-1.0..1.0_f64)).clamp(-1e6, 1e6))),
    );
    let dwell_s = times(generator, n, 0.1, 10.0);
    Case { points, dwell_s, limits: any_machine(generator) }
}

/// Cases with all of these, with repeated points, times of zero and a least segment time among them.
fn everything(generator: &mut ChaCha8Rng) -> Case {
    let n = few_segments(generator);
    let points = wander((0..n).map(|_| match generator.random_range(0..20) {
        0 => [0.0; 2],
        1 => [any_scale(generator), 0.0],
        2 => [0.0, -any_scale(generator)],
        _ => {
            let length = any_scale(generator);
            step(generator, length)
        }
    }));
    let mut dwell_s = times(generator, n, 1e-6, 1e6);
    for t in dwell_s.iter_mut().skip(1) {
        if generator.random_range(0..20) == 0 {
            *t = 0.0;
        }
    }
    let mut limits = any_machine(generator);
    if generator.random_range(0..2) == 0 {
        limits = with_min_segment(&limits, any_scale(generator));
    }
    Case { points, dwell_s, limits }
}

/// Cases that the long test has found: population, seed, number. Always among those that run.
const FOUND: [(&str, u64, u64); 40] = [
    // A late start: pieces of 1e-17 s vanished in the rounding of break times that the sum of the
    // dwell times said nothing about (constant acceleration).
    ("unequal", 1, 8559),
    ("harsh", 1, 8238),
    // A lift without time that is at its end but for rounding (constant acceleration).
    ("degenerate", 1, 307),
    ("degenerate", 1, 361),
    ("degenerate", 1, 3633),
    ("degenerate", 1, 4630),
    ("degenerate", 1, 9046),
    ("degenerate", 1, 9310),
    ("degenerate", 1, 10629),
    ("degenerate", 1, 12502),
    ("degenerate", 1, 13237),
    ("degenerate", 1, 14220),
    // Braking to the very end of a segment, to wait there: 0/0 (stop at corners).
    ("raster-like", 1, 264),
    // Densities so unlike that the times of short parts lost their digits (trig-spline local).
    ("unequal", 1, 221),
    ("unequal", 1, 1418),
    ("unequal", 1, 2613),
    ("unequal", 1, 2668),
    ("unequal", 1, 3433),
    ("unequal", 1, 5395),
    ("unequal", 1, 5563),
    ("unequal", 1, 5872),
    ("unequal", 1, 8675),
    ("unequal", 1, 8844),
    ("unequal", 1, 8868),
    ("unequal", 1, 10069),
    ("unequal", 1, 13050),
    ("unequal", 1, 13250),
    ("harsh", 1, 6655),
    // Runs of times around 1e-4 s, whose rows vanish in normal equations (PVT as published).
    ("unequal", 1, 1975),
    ("unequal", 1, 4597),
    ("unequal", 1, 4937),
    ("unequal", 1, 8471),
    ("unequal", 1, 9060),
    // The interior point method makes too little progress (PVT as published).
    ("unequal", 1, 2976),
    // Rounds of stretching that move the excess from segment to segment (monotone PVT).
    ("harsh", 1, 2820),
    // Long segments whose directions are the same but for rounding, and whose ends are not
    // (trig-spline).
    ("axes", 1, 16),
    // Times too coarse for the shortest segments (jerk-limited PVT, stop at corners, trig-spline).
    ("neighbours", 1, 9),
    ("everything", 1, 9),
    // Accelerations shorter than the rounding of the time, which are left out (constant acceleration).
    ("axes", 1, 1055),
    // Programs of which neither is solved (monotone PVT).
    ("harsh", 1, 9116),
];

/// Number of the first case, and of the first one after the last.
fn case_numbers() -> std::ops::Range<u64> {
    let first = number_from_env("PLANISH_FIRST", 0);
    first..first + number_from_env("PLANISH_CASES", 40)
}

/// Runs `check` on every case of every population, and on those found, and reports all that fail.
fn on_every_case(check: impl Fn(&Case) -> Result<(), String> + Sync) {
    let failures = failing(&POPULATIONS, |_, _, case| check(case));
    assert!(failures.is_empty(), "{} failing:\n{}", failures.len(), failures.join("\n"));
}

/// Runs `check(population, is random, case)` on the random cases of the `populations` and on those
/// found, and names all that fail, in order.
fn failing(
    populations: &[Population],
    check: impl Fn(usize, bool, &Case) -> Result<(), String> + Sync,
) -> Vec<String> {
    let seed = number_from_env("PLANISH_SEED", 1);
    let named = |name: &str| populations.iter().position(|p| p.0 == name);
    let found = FOUND.iter().filter_map(|(name, seed, i)| Some((named(name)?, *seed, *i, false)));
    // All populations of a number together, so that threads have alike parts of the work.
    let random =
        case_numbers().flat_map(|i| (0..populations.len()).map(move |p| (p, seed, i, true)));
    let cases: Vec<(usize, u64, u64, bool)> = found.chain(random).collect();
    let run = |(p, seed, i, random): (usize, u64, u64, bool)| {
        let (name, population) = populations[p];
        let checked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            check(p, random, &population(&mut case_generator(seed, p as u64, i)))
        }));
        let message = match checked {
            Ok(result) => result.err()?,
            Err(_) => "panics, see above".into(),
        };
        Some(format!("{name}, PLANISH_SEED={seed}, case {i}: {message}"))
    };
    cases.into_par_iter().with_max_len(1).filter_map(run).collect()
}

// ---------------------------------------------------------------------------------------------
// All of them

/// The path of a case, with the tool lifted in every seventh segment.
fn lifted(case: &Case) -> ToolPath {
    let n = case.dwell_s.len();
    let on = (0..n).map(|i| i % 7 != 3).collect();
    ToolPath::through(case.points.clone(), on, vec![0; n]).unwrap()
}

/// Limits that a scheduler always keeps if it makes a motion. The position is continuous in all modes but
/// the position mode.
struct Promise {
    /// No step in velocity, at rest before and after.
    smooth: bool,
    velocity: bool,
    acceleration: bool,
    /// Limit on jerk inside segments.
    jerk: bool,
    /// No step in acceleration, if the jerk is limited.
    acceleration_step: bool,
    min_segment: bool,
}

fn promise(scheduler: &str) -> Promise {
    let none = Promise {
        smooth: false,
        velocity: false,
        acceleration: false,
        jerk: false,
        acceleration_step: false,
        min_segment: false,
    };
    let axes = Promise { smooth: true, velocity: true, acceleration: true, ..none };
    match scheduler {
        "pvt smooth" | "pvt monotone" => Promise { min_segment: true, ..axes },
        "pvt monotone, jerk limited" => Promise { jerk: true, min_segment: true, ..axes },
        "pvt smooth, jerk limited" => {
            Promise { jerk: true, acceleration_step: true, min_segment: true, ..axes }
        }
        "pvt-as-published" => Promise { smooth: true, ..none },
        // A phase may be shorter than the controller's least segment.
        "constant-acceleration"
        | "stop-at-corners"
        | "trig-spline offset"
        | "trig-spline local" => axes,
        "average-velocity" => Promise { velocity: true, min_segment: true, ..none },
        _ => Promise { velocity: true, acceleration: true, ..none },
    }
}

/// Counts of the random cases of a population in a scheduler, by result.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Count {
    made: u64,
    /// Cases that the scheduler refused with a message.
    refused: u64,
    /// Motions with more time than the dwell times in segments with the tool on.
    stretched: u64,
    /// Motions whose scheduler reports that they break a promised limit, because their times, as numbers of
    /// 53 bits, are too coarse for their shortest segments.
    coarse: u64,
    /// Motions with an error: a claim that differs from the verdict, another broken promise, or a dwell
    /// time that was cut.
    violations: u64,
    /// Largest use of a promised limit on velocity, acceleration or jerk, 1 = at the limit; 0 if none is
    /// promised.
    largest_use: f64,
}

impl Count {
    fn add(&mut self, other: &Self) {
        self.made += other.made;
        self.refused += other.refused;
        self.stretched += other.stretched;
        self.coarse += other.coarse;
        self.violations += other.violations;
        self.largest_use = self.largest_use.max(other.largest_use);
    }
}

/// The claim of a scheduler on its motion must be the verdict of the judge, limit by limit. The motion must
/// keep the promises of the scheduler, and no dwell time may be cut, at all scales. Prints the table of
/// `Counts`.
#[test]
fn the_judge_agrees_with_every_claim() {
    let populations = all_populations();
    let (seed, numbers) = (number_from_env("PLANISH_SEED", 1), case_numbers());
    let mut counts = Counts::before(seed, &numbers);
    let here = Mutex::new(vec![vec![Count::default(); SCHEDULERS.len()]; populations.len()]);
    let failures = failing(&populations, |p, random, case| {
        let any_scale = p >= POPULATIONS.len();
        let mut broken = Vec::new();
        for (k, &(name, ref scheduler)) in SCHEDULERS.iter().enumerate() {
            for path in [case.path(), lifted(case)] {
                // A lift is a segment like any other for PVT, whose programs take most of the time.
                if name.starts_with("pvt ") && path.tool_on().contains(&false) {
                    continue;
                }
                let (count, problems) = judged(name, scheduler.as_ref(), &path, case, any_scale);
                broken.extend(problems.into_iter().map(|e| format!("{name}: {e}")));
                if random {
                    // Sums and maxima: the same whatever the order.
                    here.lock().unwrap()[p][k].add(&count);
                }
            }
        }
        ensure(broken.is_empty(), || broken.join("; "))
    });
    for ((population, _), of) in populations.iter().zip(here.into_inner().unwrap()) {
        for ((scheduler, _), count) in SCHEDULERS.iter().zip(of) {
            counts.rows.push(Row {
                seed,
                first: numbers.start,
                end: numbers.end,
                population: population.to_string(),
                scheduler: scheduler.to_string(),
                count,
            });
        }
    }
    counts.keep();
    println!("{}", counts.table());
    assert!(failures.is_empty(), "{} failing:\n{}", failures.len(), failures.join("\n"));
}

/// Runs a scheduler and judges its motion; returns the counts, and a sentence for every error.
fn judged(
    name: &str,
    scheduler: &Schedule,
    path: &ToolPath,
    case: &Case,
    any_scale: bool,
) -> (Count, Vec<String>) {
    let (with_jerk, without_jerk) = (case.with_jerk(), case.without_jerk());
    let limits = if name.ends_with("jerk limited") { &with_jerk } else { &without_jerk };
    let mut count = Count::default();
    let motion = match scheduler(path, &case.dwell(), limits) {
        Ok(motion) => motion,
        Err(e) => {
            count.refused = 1;
            let expected = e.contains("PVT as published stretches nothing") || any_scale;
            return (count, if expected { Vec::new() } else { vec![e] });
        }
    };
    count.made = 1;
    let mut problems = Vec::new();
    let t = &motion.trajectory;
    for judged_by in [&without_jerk, &with_jerk] {
        let (claim, verdict) = (measured_claim(t, judged_by), judge(t, judged_by));
        let found = [
            verdict.limits_respected,
            kept(&verdict, |a| &a.position_step_mm),
            kept(&verdict, |a| &a.velocity_step_mm_per_s),
            kept(&verdict, |a| &a.velocity_mm_per_s),
            kept(&verdict, |a| &a.acceleration_mm_per_s2),
            kept(&verdict, |a| &a.jerk_mm_per_s3)
                && kept(&verdict, |a| &a.acceleration_step_mm_per_s2),
            !verdict.segment_duration_s.exceeded,
        ];
        let claimed = [
            claim.limits_respected,
            claim.continuous_position,
            claim.continuous_velocity,
            claim.velocity,
            claim.acceleration,
            claim.jerk.unwrap_or(true),
            claim.min_segment,
        ];
        if found != claimed {
            problems.push(format!("claims {claim:?}, is {:?}", verdict.violations));
        }
        if std::ptr::eq(judged_by, limits) {
            match keeps_its_promise(name, &verdict) {
                Kept::Yes(largest_use) => count.largest_use = largest_use,
                // The claim agrees, or it would differ from the verdict.
                Kept::ButForRounding if any_scale => count.coarse = 1,
                _ => problems.push(format!("breaks its promise: {:?}", verdict.violations)),
            }
        }
    }
    match keeps_the_dwell_times(path, case, &motion) {
        Ok(stretched) => count.stretched = u64::from(stretched),
        Err(e) => problems.push(e),
    }
    count.violations = u64::from(!problems.is_empty());
    (count, problems)
}

/// Returns true if both axes keep a limit.
fn kept(verdict: &Verdict, check: fn(&AxisVerdict) -> &Check) -> bool {
    verdict.axes.iter().all(|axis| !check(axis).exceeded)
}

/// Result of the check of a scheduler's promises on its motion.
enum Kept {
    /// The motion keeps them; with the largest use of the promised limits on velocity, acceleration and
    /// jerk.
    Yes(f64),
    /// The motion exceeds them by no more than the rounding of its times explains.
    ButForRounding,
    No,
}

/// Largest excess of an axis over a limit that the rounding of times explains.
type Excess = fn(&AxisVerdict, Rounding) -> f64;

/// True if the limit was promised, the judge's check of it, and the excess that rounding explains.
type PromisedLimit = (bool, fn(&AxisVerdict) -> &Check, Excess);

fn keeps_its_promise(name: &str, verdict: &Verdict) -> Kept {
    let promise = promise(name);
    let axes = || verdict.axes.iter();
    // Where a time is off by u, positions are off by v u and velocities by a u.
    let checks: [PromisedLimit; 6] = [
        (promise.velocity, |a| &a.velocity_mm_per_s, |a, u| u.time_s * a_max(a)),
        (promise.acceleration, |a| &a.acceleration_mm_per_s2, acceleration_rounding),
        (promise.jerk, |a| &a.jerk_mm_per_s3, |a, u| acceleration_rounding(a, u) / u.shortest_s),
        (
            name != "position",
            |a| &a.position_step_mm,
            |a, u| u.time_s * v_max(a) + u.relative * a.position_mm.magnitude(),
        ),
        (
            promise.smooth,
            |a| &a.velocity_step_mm_per_s,
            |a, u| u.time_s * a_max(a) + u.relative * v_max(a),
        ),
        (promise.acceleration_step, |a| &a.acceleration_step_mm_per_s2, acceleration_rounding),
    ];
    let promised = checks.iter().filter(|(promised, ..)| *promised);
    let duration_kept = !(promise.min_segment && verdict.segment_duration_s.exceeded);
    if duration_kept && promised.clone().all(|(_, check, _)| kept(verdict, *check)) {
        let ranges = checks[..3].iter().filter(|(promised, ..)| *promised);
        let uses = ranges.flat_map(|(_, check, _)| axes().filter_map(|a| check(a).worst_ratio));
        return Kept::Yes(uses.fold(0.0, f64::max));
    }
    // Pieces below 64 epsilon of the time may be left out, one on either side.
    let relative = 128.0 * f64::EPSILON;
    let rounding = Rounding {
        relative,
        time_s: relative * verdict.total_time_s,
        shortest_s: verdict.segment_duration_s.min.value,
    };
    let within = |(_, check, excess): &(bool, fn(&AxisVerdict) -> &Check, Excess)| {
        axes().all(|a| {
            let check = check(a);
            let limit = check.limit.unwrap_or(f64::INFINITY);
            !check.exceeded || check.magnitude() <= limit + excess(a, rounding)
        })
    };
    match duration_kept && promised.clone().all(within) {
        true => Kept::ButForRounding,
        false => Kept::No,
    }
}

/// Rounding of the times of a motion.
#[derive(Clone, Copy)]
struct Rounding {
    relative: f64,
    /// Rounding of the last break time, s.
    time_s: f64,
    /// Shortest segment, s.
    shortest_s: f64,
}

/// The larger of the limit and the largest value of the motion. Pieces that were left out may have had more
/// than the motion, up to the limit.
fn limit_or_reached(check: &Check) -> f64 {
    check.magnitude().max(check.limit.unwrap_or(0.0))
}

fn v_max(axis: &AxisVerdict) -> f64 {
    limit_or_reached(&axis.velocity_mm_per_s)
}

fn a_max(axis: &AxisVerdict) -> f64 {
    limit_or_reached(&axis.acceleration_mm_per_s2)
}

/// Rounding of the accelerations 6 dp / h^2 and 4 v / h at the shortest duration h, which has the rounding
/// of the time.
fn acceleration_rounding(axis: &AxisVerdict, u: Rounding) -> f64 {
    u.time_s / u.shortest_s * (a_max(axis) + v_max(axis) / u.shortest_s)
}

/// Checks that no segment with the tool on is shorter than its dwell time, and that the added time is the
/// reported one. Returns true if segments were stretched.
fn keeps_the_dwell_times(path: &ToolPath, case: &Case, motion: &Motion) -> Result<bool, String> {
    let (t, n) = (&motion.trajectory, path.len());
    let served_s = t.served_s(n, |piece| piece.tool_on).map_err(|e| e.to_string())?;
    let on = || (0..n).filter(|i| path.tool_on()[*i]);
    let (dwell_s, on_s) = on().fold((0.0, 0.0), |(d, s), i| (d + case.dwell_s[i], s + served_s[i]));
    // Break times are sums up to the total; a piece below 64 epsilon of them may be left out, one per
    // segment and axis.
    let rounding_s = 1e-12 * t.total_time_s();
    if motion.one_by_one {
        for i in on() {
            let late_s = case.dwell_s[i] - served_s[i];
            ensure(late_s <= rounding_s, || {
                format!("segment {i} lasts {} s, {late_s} s less than its dwell time", served_s[i])
            })?;
        }
    }
    let added_s = on_s - dwell_s;
    ensure((added_s - motion.added_s).abs() <= 1e3 * rounding_s, || {
        format!("adds {added_s} s with the tool on, and reports {} s", motion.added_s)
    })?;
    ensure(motion.stretched || added_s <= 1e3 * rounding_s, || {
        format!("adds {added_s} s with the tool on, and reports no stretched segment")
    })?;
    Ok(motion.stretched)
}

/// The counts of a piece of the campaign: the cases from `first` on, those from `end` on not.
struct Row {
    seed: u64,
    first: u64,
    end: u64,
    population: String,
    scheduler: String,
    count: Count,
}

/// The rows of this run and, where `PLANISH_COUNTS` names a file, those of the runs before it, which
/// the file keeps: a campaign can be run piece by piece.
struct Counts {
    rows: Vec<Row>,
}

impl Counts {
    /// The rows of the runs before, none of which may have had one of these cases.
    fn before(seed: u64, numbers: &std::ops::Range<u64>) -> Self {
        let text = std::env::var_os("PLANISH_COUNTS")
            .filter(|file| std::path::Path::new(file).exists())
            .map_or(String::new(), |file| std::fs::read_to_string(file).unwrap());
        let rows: Vec<Row> = text.lines().map(Row::parse).collect();
        let again =
            rows.iter().find(|r| r.seed == seed && r.first < numbers.end && numbers.start < r.end);
        if let Some(Row { first, end, .. }) = again {
            panic!(
                "PLANISH_COUNTS has the cases {first} to {} of seed {seed} already; choose others by \
                 PLANISH_FIRST or PLANISH_SEED",
                end - 1
            );
        }
        Self { rows }
    }

    fn keep(&self) {
        if let Some(file) = std::env::var_os("PLANISH_COUNTS") {
            std::fs::write(file, self.rows.iter().map(Row::line).collect::<String>()).unwrap();
        }
    }

    /// Markdown: by scheduler, and by scheduler and population.
    fn table(&self) -> String {
        let sum = |scheduler: Option<&str>, population: Option<&str>| {
            let is = |name: &str, wanted: Option<&str>| wanted.is_none_or(|w| w == name);
            let mut sum = Count::default();
            let of = self.rows.iter();
            of.filter(|r| is(&r.scheduler, scheduler) && is(&r.population, population))
                .for_each(|r| sum.add(&r.count));
            sum
        };
        let cells = |count: Count| {
            let Count { made, refused, stretched, coarse, violations, largest_use } = count;
            let largest = match largest_use {
                0.0 => "-".into(),
                largest => format!("{largest:.9}"),
            };
            format!("{made} | {refused} | {stretched} | {coarse} | {violations} | {largest} |\n")
        };
        let columns = "made | refused | stretched | times too coarse | violations | \
                       largest use of a promised limit |";
        let mut text = format!("| scheduler | {columns}\n|---|---|---|---|---|---|---|\n");
        for (scheduler, _) in SCHEDULERS.iter() {
            text += &format!("| {scheduler} | {}", cells(sum(Some(scheduler), None)));
        }
        text += &format!("| all | {}", cells(sum(None, None)));
        text +=
            &format!("\n| population | scheduler | {columns}\n|---|---|---|---|---|---|---|---|\n");
        for (population, _) in all_populations() {
            for (scheduler, _) in SCHEDULERS.iter() {
                let of = cells(sum(Some(scheduler), Some(population)));
                text += &format!("| {population} | {scheduler} | {of}");
            }
        }
        text
    }
}

impl Row {
    fn line(&self) -> String {
        let Self { seed, first, end, population, scheduler, count } = self;
        let Count { made, refused, stretched, coarse, violations, largest_use } = count;
        format!(
            "{seed}\t{first}\t{end}\t{population}\t{scheduler}\t\
             {made}\t{refused}\t{stretched}\t{coarse}\t{violations}\t{largest_use:?}\n"
        )
    }

    fn parse(line: &str) -> Self {
        let cells: Vec<&str> = line.split('\t').collect();
        let [seed, first, end, population, scheduler, numbers @ ..] = cells.as_slice() else {
            panic!("PLANISH_COUNTS: {line}: has {} cells; remove the file", cells.len())
        };
        let [made, refused, stretched, coarse, violations, most] = numbers else {
            panic!("PLANISH_COUNTS: {line}: has {} cells; remove the file", cells.len())
        };
        let number = |text: &str| text.parse().unwrap_or_else(|_| panic!("PLANISH_COUNTS: {line}"));
        Self {
            seed: number(seed),
            first: number(first),
            end: number(end),
            population: population.to_string(),
            scheduler: scheduler.to_string(),
            count: Count {
                made: number(made),
                refused: number(refused),
                stretched: number(stretched),
                coarse: number(coarse),
                violations: number(violations),
                largest_use: most.parse().unwrap_or_else(|_| panic!("PLANISH_COUNTS: {line}")),
            },
        }
    }
}

/// Path and times backwards give p'(T - t) = p(t); not constant acceleration, which has no
/// look-ahead, nor PVT as published, whose Eq. 18 looks ahead only.
#[test]
fn the_path_speed_methods_run_backwards_too() {
    on_every_case(|case| {
        let mut back = case.clone();
        back.points.reverse();
        back.dwell_s.reverse();
        for &(name, ref scheduler) in SCHEDULERS.iter() {
            if !name.starts_with("trig-spline") && name != "average-velocity" {
                continue;
            }
            let a = scheduler(&case.path(), &case.dwell(), &case.limits)?.trajectory;
            let b = scheduler(&back.path(), &back.dwell(), &back.limits)?.trajectory;
            let total_s = a.total_time_s();
            ensure((total_s - b.total_time_s()).abs() <= 1e-9 * total_s, || {
                format!("{name}: {total_s} s forwards, {} s backwards", b.total_time_s())
            })?;
            for k in 0..200 {
                let t = (f64::from(k) + 0.5) / 200.0 * total_s;
                let (p, q) = (position_at(&a, t), position_at(&b, total_s - t));
                let off = (p[0] - q[0]).abs().max((p[1] - q[1]).abs());
                // The fit of 1e-6 mm on either side, and 1e-9 of the time at 250 mm/s.
                let tolerance_mm = 2e-6 + 1e-9 * total_s * 250.0;
                ensure(off <= tolerance_mm, || format!("{name}: {off} mm apart at {t} s"))?;
            }
        }
        Ok(())
    });
}

fn position_at(t: &Trajectory, time_s: f64) -> [f64; 2] {
    let i = t.break_time_s().partition_point(|b| *b <= time_s).clamp(1, t.len()) - 1;
    t.segment(i).position_mm(time_s - t.break_time_s()[i])
}

/// Dwell times k times as long give the same places at times k times as late.
#[test]
fn the_path_speed_methods_scale_with_the_dwell_times() {
    let (seed, k) = (number_from_env("PLANISH_SEED", 1), 3.0);
    for (p, (name, population)) in POPULATIONS.iter().enumerate() {
        if !["easy", "raster-like"].contains(name) {
            continue;
        }
        for i in 0..20 {
            let mut case = population(&mut case_generator(seed, p as u64, i));
            // Run-up and brake of 1e-9 s do not scale; nothing is repaired.
            case.limits = machine([FREE; 2], [1e11; 2]);
            let mut slow = case.clone();
            slow.dwell_s.iter_mut().for_each(|t| *t *= k);
            for &(scheduler_name, ref scheduler) in SCHEDULERS.iter() {
                if !scheduler_name.starts_with("trig") && scheduler_name != "average-velocity" {
                    continue;
                }
                let a = scheduler(&case.path(), &case.dwell(), &case.limits).unwrap().trajectory;
                let b = scheduler(&slow.path(), &slow.dwell(), &slow.limits).unwrap().trajectory;
                for n in 0..100 {
                    let t = (f64::from(n) + 0.5) / 100.0 * a.total_time_s();
                    let (p, q) = (position_at(&a, t), position_at(&b, k * t));
                    let off = (p[0] - q[0]).abs().max((p[1] - q[1]).abs());
                    assert!(off < 3e-6, "{name} {i} {scheduler_name}: {off} mm at {t} s");
                }
            }
        }
    }
}

// ---------------------------------------------------------------------------------------------
// Trigonometric spline

/// The motion is on the path up to the rounding of corners and the fit, serves its segments in
/// order, and takes the dwell times and what is reported.
#[test]
fn trig_spline_stays_on_the_path_and_accounts_for_its_time() {
    on_every_case(|case| {
        for repair in [Repair::Offset, Repair::Local] {
            for path in [case.path(), lifted(case)] {
                let s = trig(&path, &case.dwell(), &case.limits, repair)?;
                let mut before = 0;
                for (k, piece) in s.trajectory.segments().enumerate() {
                    if !piece.tool_on {
                        continue;
                    }
                    let i = piece.dwell_index.ok_or("a pass serves no dwell point")?;
                    ensure(i >= before, || {
                        format!("{repair:?}: piece {k} serves {i} after {before}")
                    })?;
                    before = i;
                    for part in [0.0, 0.3, 0.7, 1.0] {
                        let p = piece.position_mm(part * piece.duration_s);
                        let [a, b] = [0, 1].map(|e| case.points[i + e]);
                        let off = distance_to_chord(p, a, b);
                        ensure(off <= 0.02 + 2e-6, || {
                            format!("{repair:?}: piece {k} is {off} mm beside segment {i}")
                        })?;
                    }
                }
                let r = &s.report;
                ensure(r.feed_use <= 1.0 && r.acceleration_use <= 1.0, || format!("{r:?}"))?;
                ensure(r.fit_error_mm <= 1e-6, || format!("{r:?}"))?;
                let on: f64 =
                    s.trajectory.segments().filter(|s| s.tool_on).map(|s| s.duration_s).sum();
                let dwell_s: f64 =
                    (0..path.len()).filter(|i| path.tool_on()[*i]).map(|i| case.dwell_s[i]).sum();
                let reported = dwell_s + r.held_added_s + r.offset_added_s + r.corner_added_s;
                let off = (on - reported).abs();
                ensure(off <= 1e-9 * on.max(1.0), || {
                    format!("{repair:?}: {on} s with the tool on, reported {reported} s: {r:?}")
                })?;
            }
        }
        Ok(())
    });
}

fn distance_to_chord(p: [f64; 2], a: [f64; 2], b: [f64; 2]) -> f64 {
    let (d, q) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
    let length2 = d[0] * d[0] + d[1] * d[1];
    let part = if length2 > 0.0 { (q[0] * d[0] + q[1] * d[1]) / length2 } else { 0.0 };
    let part = part.clamp(0.0, 1.0);
    (q[0] - part * d[0]).hypot(q[1] - part * d[1])
}

/// The interpolator runs through the same motion, tick by tick; the run-up comes before it.
#[test]
fn the_interpolator_is_where_the_trajectory_is() {
    on_every_case(|case| {
        let s = trig(&case.path(), &case.dwell(), &case.limits, Repair::Offset)?;
        let Some(density) = &s.density else { return Ok(()) };
        let t = &s.trajectory;
        let start = (0..t.len()).find(|k| t.tool_on()[*k]).unwrap_or(0);
        let start_s = t.break_time_s()[start];
        let tick_s = t.total_time_s() / 300.0;
        let mut interpolator = Interpolator::new(tick_s)?;
        let mut references = Vec::new();
        for record in interpolator::records(density) {
            interpolator.push(&record, |r| references.push(r))?;
        }
        references.extend(interpolator.finish());
        for r in &references {
            let p = position_at(t, start_s + r.time_s);
            let off = (p[0] - r.position_mm[0]).abs().max((p[1] - r.position_mm[1]).abs());
            // The fit, and 1e-12 of the time at 250 mm/s.
            ensure(off <= 2e-6, || format!("{off} mm apart at {} s", r.time_s))?;
        }
        let last = references.last().map(|r| r.position_mm);
        ensure(last == density.point_mm().last().copied(), || format!("ends at {last:?}"))
    });
}

/// A disk of 100 mm after smoothing, steps of 0.2 mm, at two feed limits. The offset of the feed is
/// 1/v_max, because the smallest density is 0. If the path goes beyond the aperture by the TIF and 1 mm,
/// the repaired motion removes what the ideal one does plus a piston.
#[test]
fn disk_100_repaired_removes_a_piston_more() {
    let recipe =
        std::fs::read_to_string(planish_testkit::workspace().join("fixtures/disk-100.json"));
    let recipe: planish_fixture::Recipe = serde_json::from_str(&recipe.unwrap()).unwrap();
    let fixture = planish_fixture::make(&recipe).unwrap();
    let (surface, tif) = (&fixture.surface, &fixture.tif);
    let [half_x, half_y] = tif.half_size_mm();
    let (pitch_mm, step_mm) = (1.0, 0.2);
    let settings =
        planish_toolpath::RasterSettings::new(pitch_mm, step_mm, half_x.max(half_y) + 1.0);
    let path = planish_toolpath::raster(surface, &settings).unwrap();
    // density = z pitch / VRR, z the mean height within 1 mm, continued from the edge outwards.
    let height = |p: [f64; 2]| {
        let (r, inside) = (p[0].hypot(p[1]), 48.5);
        let p = if r > inside { p.map(|c| c * inside / r) } else { p };
        let grid = surface.grid();
        let near = |axis: &planish_types::Axis, c: f64| {
            let i = (c - axis.start_mm()) / axis.step_mm();
            (i - 4.0).ceil().max(0.0) as usize..=((i + 4.0).floor() as usize).min(axis.len() - 1)
        };
        let (mut sum, mut weight) = (0.0, 0.0);
        for row in near(&grid.y, p[1]) {
            for column in near(&grid.x, p[0]) {
                let z = surface.height_nm()[[row, column]];
                let r =
                    (grid.x.coordinate_mm(column) - p[0]).hypot(grid.y.coordinate_mm(row) - p[1]);
                if z.is_finite() && r < 1.0 {
                    let w = (1.0 - r * r).powi(2);
                    (sum, weight) = (sum + w * z, weight + w);
                }
            }
        }
        sum / weight
    };
    let heights: Vec<f64> = path.dwell_point_mm().par_iter().map(|p| height(*p)).collect();
    let lowest = heights.iter().fold(f64::INFINITY, |m: f64, z| m.min(*z));
    let density = |z: f64| (z - lowest) * pitch_mm / tif.vrr_nm_mm2_per_s();
    let dwell_s =
        (0..path.len()).map(|i| density(heights[i]) * path.segment_length_mm(i)).collect();
    let dwell = DwellTime::new(dwell_s).unwrap();
    let removal = |t: &Trajectory| {
        let gridded = planish_simulate::SimulationSettings::Gridded;
        planish_simulate::simulate(t, tif, surface, gridded).unwrap().removal
    };
    let ideal = trig(&path, &dwell, &machine([1e6; 2], [1e12; 2]), Repair::Local).unwrap();
    let ideal = removal(&ideal.trajectory);
    for (mm_per_min, acceleration, feed_offset) in
        [(4000.0, 2000.0, 0.015), (12000.0, 200.0, 0.005)]
    {
        let limits = machine([mm_per_min / 60.0; 2], [acceleration; 2]);
        let s = trig(&path, &dwell, &limits, Repair::Offset).unwrap();
        let verdict = judge(&s.trajectory, &limits);
        assert!(verdict.limits_respected, "{:?}", verdict.violations);
        let r = &s.report;
        // The number of the source to its last digit.
        assert!((r.feed_offset_s_per_mm - feed_offset).abs() < 5e-4, "{r:?}");
        let more = removal(&s.trajectory).removal_nm() - ideal.removal_nm();
        let aperture = ndarray::Zip::from(&more)
            .and(surface.height_nm())
            .map_collect(|m, z| if z.is_nan() { f64::NAN } else { *m });
        let more = planish_types::Surface::new(*surface.grid(), aperture).unwrap();
        println!(
            "{mm_per_min} mm/min, {acceleration} mm/s^2: offsets {:.6} + {:.6} s/mm; piston {:.3} nm, \
             without it {:.6} nm RMS detilted, {:.6} nm PV; {} corners slowed, {:.3} s",
            r.feed_offset_s_per_mm,
            r.acceleration_offset_s_per_mm,
            more.height_nm().iter().filter(|m| !m.is_nan()).sum::<f64>()
                / more.height_nm().iter().filter(|m| !m.is_nan()).count() as f64,
            more.detilted_rms_nm(),
            more.statistics().pv,
            r.slowed_corners,
            r.corner_added_s,
        );
        assert!(more.detilted_rms_nm() < 0.067, "{} nm", more.detilted_rms_nm());
    }
}

// ---------------------------------------------------------------------------------------------
// PVT

const MODES: [Mode; 2] = [Mode::Smooth, Mode::Monotone];

/// PVT keeps the limits of a path that is as long as a real plan, on drives that are at their limit in
/// every line.
#[test]
fn pvt_keeps_the_limits_of_a_long_path() {
    let (lines, steps) = (20, 100);
    let mut points = Vec::new();
    for line in 0..lines {
        for k in 0..=steps {
            let k = if line % 2 == 0 { k } else { steps - k };
            points.push([f64::from(k), f64::from(line)]);
        }
    }
    let mut generator = case_generator(number_from_env("PLANISH_SEED", 1), 1000, 0);
    let dwell_s = times(&mut generator, points.len() - 1, 0.05, 0.5);
    let case = Case { points, dwell_s, limits: machine([25.0, 15.0], [200.0, 100.0]) };
    for mode in MODES {
        let schedule = case.pvt(mode).unwrap();
        passes_and_lasts(&case, mode, &schedule).unwrap();
        let verdict = judge(&schedule.trajectory, &case.limits);
        assert!(verdict.limits_respected, "{mode:?}: {:?}", verdict.violations);
        assert!(schedule.report.rounds > 0, "{mode:?}: no limit was active");
    }
}

/// One schedule per mode and case for both properties: the programs take most of the long test.
#[test]
fn pvt_passes_every_control_point_in_time_and_monotone_stays_in_its_boxes() {
    on_every_case(|case| {
        MODES.iter().try_for_each(|&mode| {
            let schedule = case.pvt(mode)?;
            passes_and_lasts(case, mode, &schedule)?;
            stays_in_its_boxes(case, mode, &schedule)
        })
    });
}

fn passes_and_lasts(
    case: &Case,
    mode: Mode,
    schedule: &planish_schedule::Schedule<pvt::PvtReport>,
) -> Result<(), String> {
    let t = &schedule.trajectory;
    // The cubic ends where the next one starts up to the rounding of its four terms, each of
    // which is at most a few times the extent.
    let rounding_mm = 1e-13 * case.extent_mm().max(1.0) * 10.0;
    let total_s = t.total_time_s();
    for (k, s) in t.segments().enumerate() {
        let i = s.dwell_index.ok_or("a segment serves no dwell point")?;
        let (start, end) = (s.position_mm(0.0), s.position_mm(s.duration_s));
        ensure(start == case.points[i], || {
            format!("{mode:?}: segment {k} starts at {start:?}, not at {:?}", case.points[i])
        })?;
        let off = (0..2).map(|a| (end[a] - case.points[i + 1][a]).abs()).fold(0.0, f64::max);
        ensure(off <= rounding_mm, || format!("{mode:?}: segment {k} misses its end by {off:e}"))?;
        // A duration is the difference of two sums up to the total.
        let late = case.dwell_s[i] - s.duration_s;
        ensure(late <= 2.0 * f64::EPSILON * total_s, || {
            format!("{mode:?}: segment {k} lasts {} s, dwell {} s", s.duration_s, case.dwell_s[i])
        })?;
    }
    // What is left out has neither length nor time; what is stretched is reported.
    for &i in &schedule.report.dropped {
        ensure(case.dwell_s[i] == 0.0 && case.points[i] == case.points[i + 1], || {
            format!("{mode:?}: segment {i} was dropped")
        })?;
    }
    let dwell_s: f64 = case.dwell_s.iter().sum();
    let reported = dwell_s + schedule.report.added_tool_on_s;
    ensure((total_s - reported).abs() <= 1e-12 * total_s, || {
        format!("{mode:?}: takes {total_s} s, dwell and stretch are {reported} s")
    })
}

/// Neither overshoot nor reversal inside a segment.
fn stays_in_its_boxes(
    case: &Case,
    mode: Mode,
    schedule: &planish_schedule::Schedule<pvt::PvtReport>,
) -> Result<(), String> {
    if mode == Mode::Smooth {
        return Ok(());
    }
    let verdict = judge(&schedule.trajectory, &case.limits);
    let count = verdict.axes.each_ref().map(|a| [a.overshoot_mm.count, a.reversal_mm_per_s.count]);
    ensure(count == [[0, 0]; 2], || {
        let largest =
            verdict.axes.each_ref().map(|a| (a.overshoot_mm.largest, a.reversal_mm_per_s.largest));
        format!("overshoot, reversal {count:?}: {largest:?}")
    })
}

/// Path and times backwards give the mirrored motion: p'(T - t) = p(t).
#[test]
fn reversed_path_and_dwell_give_the_mirrored_motion() {
    on_every_case(|case| {
        let forward = case.free();
        let mut backward = forward.clone();
        backward.points.reverse();
        backward.dwell_s.reverse();
        MODES.iter().try_for_each(|&mode| {
            let (a, b) = (forward.pvt(mode)?.trajectory, backward.pvt(mode)?.trajectory);
            ensure(a.len() == b.len(), || {
                format!("{mode:?}: {} and {} segments", a.len(), b.len())
            })?;
            let speed = fastest(&a);
            let tolerance = velocity_tolerance(mode, &forward);
            for k in 0..a.len() {
                let (s, r) = (a.segment(k), b.segment(a.len() - 1 - k));
                for axis in 0..2 {
                    let (v, w) = (s.coefficient_mm[axis][1], r.coefficient_mm[axis]);
                    let w = velocity(&w, r.duration_s);
                    ensure((v + w).abs() <= tolerance * speed, || {
                        format!("{mode:?}: segment {k}, axis {axis}: {v} forwards, {w} backwards")
                    })?;
                }
            }
            Ok(())
        })
    });
}

/// Dwell times k times as long give velocities divided by k and accelerations by k^2.
#[test]
fn longer_dwell_scales_velocity_and_acceleration() {
    on_every_case(|case| {
        let base = case.free();
        let k = 3.0;
        let mut slow = base.clone();
        slow.dwell_s.iter_mut().for_each(|t| *t *= k);
        MODES.iter().try_for_each(|&mode| {
            let (a, b) = (base.pvt(mode)?.trajectory, slow.pvt(mode)?.trajectory);
            let (speed, tolerance) = (fastest(&a), velocity_tolerance(mode, &base));
            for i in 0..a.len() {
                let h = a.segment(i).duration_s;
                for axis in 0..2 {
                    let (c, d) = (a.coefficient_mm()[i][axis], b.coefficient_mm()[i][axis]);
                    let off = [(c[1] - k * d[1]).abs(), (c[2] - k * k * d[2]).abs() * h];
                    ensure(off.iter().all(|o| *o <= 10.0 * tolerance * speed), || {
                        format!("{mode:?}: segment {i}, axis {axis}: {c:?} and {d:?}")
                    })?;
                }
            }
            Ok(())
        })
    });
}

/// Rounding, through a tridiagonal system of condition at most 3. The interior point method of the
/// monotone mode stops at 1e-14 of the objective, or 1e-9 where rounding ends it: 1e-7 to 3e-5 of
/// the velocity, on either side.
fn velocity_tolerance(mode: Mode, case: &Case) -> f64 {
    match mode {
        Mode::Smooth => 1e-12 + 10.0 * case.rounding(),
        Mode::Monotone => 1e-4,
    }
}

/// Largest |velocity| at a break, or mean velocity of a segment, mm/s.
fn fastest(t: &Trajectory) -> f64 {
    let of = |s: planish_types::Segment<'_>| {
        let (a, b) = (s.position_mm(0.0), s.position_mm(s.duration_s));
        (0..2)
            .map(|x| s.coefficient_mm[x][1].abs().max((b[x] - a[x]).abs() / s.duration_s))
            .fold(0.0, f64::max)
    };
    t.segments().map(of).fold(0.0, f64::max)
}

#[test]
fn equal_dwell_on_equal_spacing_gives_constant_feed() {
    let n = 80;
    let case = Case {
        points: (0..=n).map(|i| [0.5 * f64::from(i), 2.0 - 0.25 * f64::from(i)]).collect(),
        dwell_s: vec![0.125; n as usize],
        limits: ion_beam(),
    };
    let feed = [4.0, -2.0];
    let check = |t: &Trajectory, segments: std::ops::Range<usize>, tolerance: f64| {
        for i in segments {
            for (axis, v) in feed.iter().enumerate() {
                let c = t.coefficient_mm()[i][axis];
                // c1 = v, c2 = c3 = 0
                let off = (c[1] - v).abs() + c[2].abs() + c[3].abs();
                assert!(off < tolerance, "segment {i}, axis {axis}: {c:?}");
            }
        }
    };
    // The influence of the ends falls by 2 - sqrt 3 per segment: 4e-18 after 30. The coefficients
    // of the order of dp/h^3 = 256 keep their rounding of 1e-13.
    for mode in MODES {
        check(&case.pvt(mode).unwrap().trajectory, 32..48, 1e-11);
    }
    for &(name, ref scheduler) in SCHEDULERS.iter() {
        if name.starts_with("trig-spline") || name == "average-velocity" {
            let t = scheduler(&case.path(), &case.dwell(), &case.limits).unwrap().trajectory;
            check(&t, 1..t.len() - 1, 1e-9);
        }
    }
    // Constant acceleration from rest swings about the feed and keeps the mean.
    let t = case.constant_acceleration().unwrap().trajectory;
    let served: f64 = t.segments().filter(|s| s.dwell_index.is_some()).map(|s| s.duration_s).sum();
    // Rounding of a sum of 80 durations, 10 s in all.
    assert!((served - 10.0).abs() < 1e-9, "{served}");
}

#[test]
fn an_axis_at_rest_stays_at_rest() {
    for axis in 0..2 {
        let along = |i: i32| {
            let mut p = [7.3, 7.3];
            p[axis] = f64::from((i * 7) % 5);
            p
        };
        let n = 30;
        let case = Case {
            points: (0..=n).map(along).collect(),
            dwell_s: (0..n).map(|i| 0.05 + 0.01 * f64::from(i % 4)).collect(),
            limits: machine([100.0, 100.0], [1000.0, 1000.0]),
        };
        let rests =
            |t: &Trajectory| t.coefficient_mm().iter().all(|c| c[1 - axis] == [7.3, 0.0, 0.0, 0.0]);
        for mode in MODES {
            assert!(rests(&case.pvt(mode).unwrap().trajectory), "{mode:?}, axis {axis}");
        }
        assert!(rests(&case.constant_acceleration().unwrap().trajectory), "axis {axis}");
    }
}

#[test]
fn zero_length_segments_take_their_time_or_vanish() {
    let case = Case {
        points: vec![[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [2.0, 1.0], [2.0, 1.0]],
        dwell_s: vec![0.5, 0.25, 0.0, 0.5, 0.125],
        limits: ion_beam(),
    };
    for mode in MODES {
        let schedule = case.pvt(mode).unwrap();
        assert_eq!(schedule.report.dropped, [2], "{mode:?}");
        assert_eq!(schedule.trajectory.dwell_index(), [0, 1, 3, 4].map(Some), "{mode:?}");
        assert_eq!(schedule.trajectory.break_time_s(), [0.0, 0.5, 0.75, 1.25, 1.375], "{mode:?}");
        assert!(judge(&schedule.trajectory, &case.limits).limits_respected, "{mode:?}");
    }
    // Without reversal the tool stands still where it stays.
    let t = case.pvt(Mode::Monotone).unwrap().trajectory;
    assert_eq!(t.coefficient_mm()[1], [[1.0, 0.0, 0.0, 0.0], [0.0; 4]]);
    let t = case.constant_acceleration().unwrap();
    assert_eq!(t.report.dropped, [2]);
}

#[test]
fn nowhere_and_in_no_time() {
    let standing =
        Case { points: vec![[1.0, 2.0], [1.0, 2.0]], dwell_s: vec![3.0], limits: ion_beam() };
    for mode in MODES {
        let t = standing.pvt(mode).unwrap().trajectory;
        assert_eq!(t.coefficient_mm(), [[[1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]]]);
        assert_eq!(t.total_time_s(), 3.0);
    }
    let never = Case { dwell_s: vec![0.0], ..standing };
    for mode in MODES {
        assert!(never.pvt(mode).is_err(), "{mode:?}: a trajectory without a segment");
    }
    assert!(never.constant_acceleration().is_err());
}

// ---------------------------------------------------------------------------------------------
// Constant acceleration

#[test]
fn constant_acceleration_is_continuous_and_uses_the_whole_acceleration() {
    on_every_case(|case| {
        let t = case.constant_acceleration()?.trajectory;
        let a_max = case.limits.max_acceleration_mm_per_s2();
        for (i, axis) in (0..t.len()).flat_map(|i| [(i, 0), (i, 1)]) {
            let c = t.coefficient_mm()[i][axis];
            let a = 2.0 * c[2].abs();
            ensure(c[3] == 0.0 && (a == 0.0 || (a / a_max[axis] - 1.0).abs() < 1e-15), || {
                format!("segment {i}, axis {axis}: acceleration {a}, jerk {}", c[3])
            })?;
        }
        // Steps at the breaks, the start and the end included, and the limit on the velocity.
        let free = machine(case.limits.max_velocity_mm_per_s(), a_max.map(|a| 2.0 * a));
        let verdict = judge(&t, &free);
        ensure(verdict.limits_respected, || format!("{:?}", verdict.violations))
    });
}

#[test]
fn constant_acceleration_reports_what_it_missed() {
    on_every_case(|case| {
        let s = case.constant_acceleration()?;
        let dwell_s: f64 = case.dwell_s.iter().sum();
        let total_s = s.trajectory.total_time_s();
        let reported_s = dwell_s + s.report.added_s + s.report.brake_s;
        // Pieces below 64 epsilon of the dwell time may be dropped, one per segment and axis.
        let slack_s = 1e-12 * total_s;
        ensure((total_s - reported_s).abs() <= slack_s, || {
            format!("takes {total_s} s, reported {reported_s} s")
        })?;
        let missed = (0..2).map(|a| s.report.largest_missed_mm[a]).fold(0.0, f64::max);
        let mut largest = 0.0_f64;
        for i in 0..case.dwell_s.len() {
            let last =
                (0..s.trajectory.len()).rev().find(|k| s.trajectory.dwell_index()[*k] == Some(i));
            let Some(k) = last else { continue };
            let segment = s.trajectory.segment(k);
            let end = segment.position_mm(segment.duration_s);
            for axis in 0..2 {
                largest = largest.max((end[axis] - case.points[i + 1][axis]).abs());
            }
        }
        ensure((largest - missed).abs() <= 2e-9 + 1e-9 * missed, || {
            format!("ends up to {largest} mm from its points, reported {missed} mm")
        })
    });
}

/// At rest in corners the tool is on the path everywhere, passes every control point, and no dwell
/// time is cut; what is added is reported.
#[test]
fn stop_at_corners_stays_on_the_path_and_cuts_no_dwell_time() {
    on_every_case(|case| {
        for path in [case.path(), lifted(case)] {
            let s = stop_at_corners::schedule(&path, &case.dwell(), &case.limits)
                .map_err(|e| e.to_string())?;
            let (t, n) = (&s.trajectory, case.dwell_s.len());
            let mut end = case.points.clone();
            let served_s = t.served_s(n, |_| true).map_err(|e| e.to_string())?;
            for (k, piece) in t.segments().enumerate() {
                let i = piece.dwell_index.ok_or("a segment serves no dwell point")?;
                end[i + 1] = piece.position_mm(piece.duration_s);
                if !piece.tool_on {
                    continue;
                }
                for part in [0.0, 0.5, 1.0] {
                    let p = piece.position_mm(part * piece.duration_s);
                    let off = distance_to_chord(p, case.points[i], case.points[i + 1]);
                    // A thousandth of a nanometre: the rounding of v^2/a in one segment.
                    ensure(off <= 1e-9, || format!("piece {k} is {off} mm beside segment {i}"))?;
                }
            }
            let total_s = t.total_time_s();
            for i in 0..n {
                let off = (0..2).map(|a| (end[i + 1][a] - case.points[i + 1][a]).abs());
                let off = off.fold(0.0, f64::max);
                ensure(off <= 1e-8, || format!("segment {i} misses its end by {off} mm"))?;
                // A piece below 64 epsilon of the time may be left out.
                let early_s = case.dwell_s[i] - served_s[i];
                ensure(early_s <= 1e-12 * total_s, || format!("segment {i} early by {early_s} s"))?;
            }
            let added_s = s.report.added_s + s.report.added_lifted_s;
            let reported_s = case.dwell_s.iter().sum::<f64>() + added_s;
            ensure((total_s - reported_s).abs() <= 1e-11 * total_s, || {
                format!("takes {total_s} s, reported {reported_s} s")
            })?;
        }
        Ok(())
    });
}

/// With a limit on jerk, the smooth motion keeps it, steps of the acceleration included, and every other
/// limit. The monotone motion keeps it inside segments only, and claims no more.
#[test]
fn pvt_keeps_a_limit_on_jerk() {
    on_every_case(|case| {
        let limited = Case { limits: case.with_jerk(), ..case.clone() };
        let s = limited.pvt(Mode::Smooth)?;
        let verdict = judge(&s.trajectory, &limited.limits);
        ensure(verdict.limits_respected, || format!("smooth: {:?}", verdict.violations))?;
        let claim = measured_claim(&s.trajectory, &limited.limits);
        ensure(claim.limits_respected && claim.jerk == Some(true), || format!("{claim:?}"))?;
        let mut end = case.points.clone();
        let served_s =
            s.trajectory.served_s(case.dwell_s.len(), |_| true).map_err(|e| e.to_string())?;
        for piece in s.trajectory.segments() {
            let i = piece.dwell_index.ok_or("a segment serves no dwell point")?;
            end[i + 1] = piece.position_mm(piece.duration_s);
        }
        let total_s = s.trajectory.total_time_s();
        for (i, served_s) in served_s.iter().enumerate() {
            let off = (0..2).map(|a| (end[i + 1][a] - case.points[i + 1][a]).abs());
            let off = off.fold(0.0, f64::max);
            // As in `passes_and_lasts`.
            ensure(off <= 1e-12 * case.extent_mm().max(1.0), || {
                format!("smooth: segment {i} misses its end by {off}")
            })?;
            ensure(*served_s >= case.dwell_s[i] - 4.0 * f64::EPSILON * total_s, || {
                format!("smooth: segment {i} lasts {served_s} s, dwell {} s", case.dwell_s[i])
            })?;
        }
        let t = limited.pvt(Mode::Monotone)?.trajectory;
        let jerk = judge(&t, &limited.limits).axes.map(|a| a.jerk_mm_per_s3.exceeded);
        ensure(jerk == [false; 2], || "monotone: exceeds the jerk inside segments".into())
    });
}

// ---------------------------------------------------------------------------------------------
// Position

#[test]
fn position_mode_stands_and_is_found_out() {
    on_every_case(|case| {
        let path = case.path();
        let t = position::schedule(&path, &case.dwell()).map_err(|e| e.to_string())?;
        for s in t.segments() {
            let p = path.dwell_point_mm()[s.dwell_index.ok_or("a rest serves no dwell point")?];
            ensure(*s.coefficient_mm == p.map(|p| [p, 0.0, 0.0, 0.0]), || {
                format!("dwell point {:?}: {:?}", s.dwell_index, s.coefficient_mm)
            })?;
        }
        let jumps = t.coefficient_mm().windows(2).any(|w| w[0] != w[1]);
        // It knows no least segment time.
        let verdict = judge(&t, &with_min_segment(&case.limits, 0.0));
        ensure(verdict.limits_respected != jumps, || format!("{:?}", verdict.violations))
    });
}
