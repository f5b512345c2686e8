//! Every scheduler along random paths, judged by `planish-verify` and by invariants.
//!
//! `PLANISH_SEED` and `PLANISH_CASES` choose the random cases. A failing case is named by its
//! population, seed and number; `PLANISH_SEED=s PLANISH_CASES=n` with n above the number runs it
//! again.

use planish_schedule::{
    constant_acceleration, position,
    pvt::{self, Mode},
};
use planish_testkit::{case_generator, ion_beam, machine};
use planish_types::{DwellTime, Limits, ToolPath, Trajectory};
use planish_verify::{Verdict, VerifySettings, verify};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Limits that nothing reaches.
const FREE: f64 = 1e9;

/// What a scheduler is given.
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

    /// The same without limits; a length without time, which has nothing else to go by, gets some.
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

    fn pvt(&self, mode: Mode) -> Result<pvt::Schedule, String> {
        let settings = pvt::Settings { mode, stretch: true };
        pvt::schedule(&self.path(), &self.dwell(), &self.limits, &settings)
            .map_err(|e| e.to_string())
    }

    fn constant_acceleration(&self) -> Result<constant_acceleration::Schedule, String> {
        constant_acceleration::schedule(&self.path(), &self.dwell(), &self.limits)
            .map_err(|e| e.to_string())
    }

    /// Largest distance of a control point from the origin, mm.
    fn extent_mm(&self) -> f64 {
        self.points.iter().flatten().fold(0.0, |m, p| p.abs().max(m))
    }
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

/// The machine can follow without more time, or nearly.
fn easy(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 0.2, 2.0);
    Case {
        points: walk(generator, &lengths),
        dwell_s: times(generator, n, 0.1, 2.0),
        limits: ion_beam(),
    }
}

/// Mean speeds up to several times the largest.
fn infeasible(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 0.1, 20.0);
    Case {
        points: walk(generator, &lengths),
        dwell_s: times(generator, n, 0.01, 0.3),
        limits: machine([30.0, 20.0], [200.0, 80.0]),
    }
}

/// Times and lengths over five orders of magnitude.
fn unequal(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 1e-3, 50.0);
    Case {
        points: walk(generator, &lengths),
        dwell_s: times(generator, n, 1e-4, 10.0),
        limits: ion_beam(),
    }
}

/// Lines along x, steps along y, dwell times that vary slowly.
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

/// Repeated points, times of zero, motion along one axis, exact reversals, equal segments.
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

/// Accelerations so small that braking takes many segments.
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

/// Everything at once: five orders of magnitude, slow and unlike drives, a least segment time.
fn harsh(generator: &mut ChaCha8Rng) -> Case {
    let n = segments(generator);
    let lengths = times(generator, n, 1e-3, 50.0);
    let mut limit = |low, high| [0, 1].map(|_| log_uniform(generator, low, high));
    let mut limits = machine(limit(1.0, 300.0), limit(1.0, 3000.0));
    limits.min_segment_s = log_uniform(generator, 1e-3, 0.1);
    Case { points: walk(generator, &lengths), dwell_s: times(generator, n, 1e-4, 10.0), limits }
}

/// Runs `check` on every case of every population and reports all that fail.
fn on_every_case(check: impl Fn(&Case) -> Result<(), String> + Sync) {
    let (seed, count) = (number_from_env("PLANISH_SEED", 1), number_from_env("PLANISH_CASES", 40));
    let cases: Vec<(usize, u64)> =
        (0..POPULATIONS.len()).flat_map(|p| (0..count).map(move |i| (p, i))).collect();
    let failures: Vec<String> = cases
        .into_par_iter()
        .filter_map(|(p, i)| {
            let (name, population) = POPULATIONS[p];
            let case = population(&mut case_generator(seed, p as u64, i));
            let message = check(&case).err()?;
            Some(format!("{name}, PLANISH_SEED={seed}, case {i}: {message}"))
        })
        .collect();
    assert!(failures.is_empty(), "{} failing:\n{}", failures.len(), failures.join("\n"));
}

// ---------------------------------------------------------------------------------------------
// PVT

const MODES: [Mode; 2] = [Mode::Smooth, Mode::Monotone];

#[test]
fn pvt_keeps_the_limits() {
    on_every_case(|case| {
        MODES.iter().try_for_each(|&mode| {
            let verdict = judge(&case.pvt(mode)?.trajectory, &case.limits);
            ensure(verdict.limits_respected, || format!("{mode:?}: {:?}", verdict.violations))
        })
    });
}

/// As long as a real plan, on drives that are at their limit in every line.
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
        passes_and_lasts(&case, mode).unwrap();
        let schedule = case.pvt(mode).unwrap();
        let verdict = judge(&schedule.trajectory, &case.limits);
        assert!(verdict.limits_respected, "{mode:?}: {:?}", verdict.violations);
        assert!(schedule.report.rounds > 0, "{mode:?}: no limit was active");
    }
}

#[test]
fn pvt_passes_every_control_point_at_its_break_and_takes_at_least_the_dwell_time() {
    on_every_case(|case| MODES.iter().try_for_each(|&mode| passes_and_lasts(case, mode)));
}

fn passes_and_lasts(case: &Case, mode: Mode) -> Result<(), String> {
    let schedule = case.pvt(mode)?;
    let t = &schedule.trajectory;
    // The cubic ends where the next one starts up to the rounding of its four terms, each of
    // which is at most a few times the extent.
    let rounding_mm = 1e-13 * case.extent_mm().max(1.0) * 10.0;
    let total_s = t.total_time_s();
    for (k, s) in t.segments().enumerate() {
        let i = s.dwell_index as usize;
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

#[test]
fn monotone_never_leaves_the_box_of_a_segment() {
    on_every_case(|case| {
        let verdict = judge(&case.pvt(Mode::Monotone)?.trajectory, &case.limits);
        let count =
            verdict.axes.each_ref().map(|a| [a.overshoot_mm.count, a.reversal_mm_per_s.count]);
        ensure(count == [[0, 0]; 2], || {
            let largest = verdict
                .axes
                .each_ref()
                .map(|a| (a.overshoot_mm.largest, a.reversal_mm_per_s.largest));
            format!("overshoot, reversal {count:?}: {largest:?}")
        })
    });
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
    // Constant acceleration from rest swings about the feed and keeps the mean.
    let t = case.constant_acceleration().unwrap().trajectory;
    let served: f64 = t.segments().filter(|s| s.dwell_index >= 0).map(|s| s.duration_s).sum();
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
        assert_eq!(schedule.trajectory.dwell_index(), [0, 1, 3, 4], "{mode:?}");
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
        // Steps at the breaks, the start and the end included. It knows no limit on the velocity.
        let free = machine([FREE; 2], a_max.map(|a| 2.0 * a));
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
                (0..s.trajectory.len()).rev().find(|k| s.trajectory.dwell_index()[*k] == i as i64);
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

// ---------------------------------------------------------------------------------------------
// Position

#[test]
fn position_mode_stands_and_is_found_out() {
    on_every_case(|case| {
        let path = case.path();
        let t = position::schedule(&path, &case.dwell()).map_err(|e| e.to_string())?;
        for s in t.segments() {
            let p = path.dwell_point_mm()[s.dwell_index as usize];
            ensure(*s.coefficient_mm == p.map(|p| [p, 0.0, 0.0, 0.0]), || {
                format!("dwell point {}: {:?}", s.dwell_index, s.coefficient_mm)
            })?;
        }
        let jumps = t.coefficient_mm().windows(2).any(|w| w[0] != w[1]);
        // It knows no least segment time.
        let verdict = judge(&t, &Limits { min_segment_s: 0.0, ..case.limits.clone() });
        ensure(verdict.limits_respected != jumps, || format!("{:?}", verdict.violations))
    });
}
