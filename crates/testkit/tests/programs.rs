//! Random motions at the limits of their machine. `planish-export` writes them for the controllers that
//! interpolate cubics, and the reader of `planish-import`, which shares no code with the writer, reads them
//! back. `planish-verify` judges what was read: every limit and the travel kept, the path within the stated
//! deviation of the plan's, little more time, the tool as planned.

use planish_export::{Common, Controller, Origin, PATH_DEVIATION_MM, pmac, program};
use planish_import::program::{self as reader, Configuration};
use planish_testkit::case_generator;
use planish_types::{Machine, MachineFile, MachineFileAxis, Trajectory};
use planish_verify::{VerifySettings, verify_on_axes};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// A controller, and how it is read.
struct Target {
    controller: Controller,
    reader: reader::Controller,
    tick_s: Option<f64>,
    /// True if the program switches the tool.
    switches: bool,
}

fn targets() -> Vec<Target> {
    let target =
        |controller, reader, tick_s, switches| Target { controller, reader, tick_s, switches };
    let pmac =
        |tool_output| Controller::Pmac(pmac::Settings { feedrate_time_unit_s: 0.001, tool_output });
    vec![
        target(Controller::Galil, reader::Controller::Galil, None, false),
        target(Controller::Galil, reader::Controller::Galil, Some(1.0 / 256.0), false),
        target(Controller::Xps, reader::Controller::Xps, None, false),
        target(pmac(Some(1)), reader::Controller::Pmac, Some(2.5e-7), true),
        target(pmac(None), reader::Controller::Pmac, Some(1e-3), false),
        target(Controller::Csv, reader::Controller::Csv, None, true),
    ]
}

/// A motion from rest to rest with stops and slow segments: cubics through random states.
fn motion(random: &mut ChaCha8Rng) -> Trajectory {
    let n = random.random_range(1..40);
    let mut time = vec![random.random_range(-5.0..5.0)];
    let mut state =
        vec![([random.random_range(-9.0..9.0), random.random_range(-9.0..9.0)], [0.0; 2])];
    for k in 0..n {
        let stands = random.random_range(0..8) == 0;
        let duration: f64 = if stands { 0.05 } else { random.random_range(0.02..1.9) };
        time.push(time[k] + duration);
        let (p, v): ([f64; 2], [f64; 2]) = state[k];
        let rest = k + 1 == n || stands || random.random_range(0..8) == 0;
        let next = [0, 1].map(|a| {
            let w: f64 = if rest { 0.0 } else { random.random_range(-20.0..20.0) };
            // Stands where it can: from rest to rest at one place.
            let mean = if stands && v == [0.0; 2] { 0.0 } else { 0.5 * (v[a] + w) };
            (p[a] + mean * duration, w)
        });
        state.push(([next[0].0, next[1].0], [next[0].1, next[1].1]));
    }
    let coefficients = (0..n).map(|k| {
        let t: f64 = time[k + 1] - time[k];
        [0, 1].map(|a| {
            let ((p, v), (q, w)) =
                ((state[k].0[a], state[k].1[a]), (state[k + 1].0[a], state[k + 1].1[a]));
            // p(T) = q, p'(T) = w
            let (d, s) = (q - p - v * t, w - v);
            [p, v, (3.0 * d - s * t) / (t * t), (s * t - 2.0 * d) / (t * t * t)]
        })
    });
    let coefficients = coefficients.collect();
    let tool_on = (0..n).map(|_| random.random_range(0..3) > 0).collect();
    Trajectory::new(time, coefficients, tool_on, vec![Some(0); n]).unwrap()
}

/// Samples of a motion, 0.25 ms apart: time since its start and position.
fn samples(motion: &Trajectory) -> Vec<(f64, [f64; 2])> {
    const STEP_S: f64 = 2.5e-4;
    let start = motion.break_time_s()[0];
    let mut all = Vec::new();
    for segment in motion.segments() {
        let n = (segment.duration_s / STEP_S).ceil().max(1.0);
        let at = |k: usize| segment.duration_s * k as f64 / n;
        all.extend(
            (0..=n as usize).map(|k| (segment.start_s - start + at(k), segment.position_mm(at(k)))),
        );
    }
    all
}

/// A machine that the motion uses fully: its limits are the largest values of the motion, and its travel is its reach.
fn machine_of(motion: &Trajectory) -> Machine {
    let loose = MachineFile {
        name: "bench".into(),
        axes: ["x", "y"].map(|name| axis(name, 1e6, 1e9, None)).to_vec(),
        ..MachineFile::default()
    };
    let loose = Machine::new(loose).unwrap();
    let seen = verify_on_axes(motion, &loose, &VerifySettings::default()).unwrap();
    let mut file = MachineFile::from(loose.limits());
    let reach = |a: usize| {
        let along = samples(motion).into_iter().map(|s| s.1[a]);
        along.fold([f64::MAX, f64::MIN], |[l, h], p| [l.min(p), h.max(p)])
    };
    for a in 0..2 {
        // Largest values are found exactly; samples of the position miss its extremes by nanometres.
        let [low, high] = reach(a);
        file.axes[a] = axis(
            ["x", "y"][a],
            seen.max_velocity_mm_per_s[a].max(1.0),
            seen.max_acceleration_mm_per_s2[a].max(10.0),
            Some([low - 1e-4, high + 1e-4]),
        );
    }
    Machine::new(file).unwrap()
}

fn axis(name: &str, v: f64, a: f64, travel_mm: Option<[f64; 2]>) -> MachineFileAxis {
    MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: v,
        max_acceleration_mm_per_s2: a,
        travel_mm,
        ..MachineFileAxis::default()
    }
}

#[test]
fn every_program_keeps_the_limits_and_the_path() {
    let origin = Origin {
        made_from: "a test".into(),
        made_by: "planish-export".into(),
        ..Origin::default()
    };
    for (case, count_mm) in (0..5).zip([1e-4, 1e-3, 2.5e-4, 1e-5].into_iter().cycle()) {
        let plan = motion(&mut case_generator(1, 7, case));
        let machine = machine_of(&plan);
        for target in targets() {
            let name = format!("case {case}, count {count_mm}, {:?}", target.controller);
            let common = Common {
                count_mm: Some([count_mm, 2.0 * count_mm]),
                tick_s: target.tick_s,
                always_on: true,
                ..Common::default()
            };
            let made = program(&plan, &machine, &target.controller, &common, &origin)
                .unwrap_or_else(|e| panic!("{name}: {e}"));
            // Through the file beside it, as a user does.
            let about = serde_json::to_string(&made.about).unwrap();
            let configuration: Configuration = serde_json::from_str(&about).unwrap();
            let run = reader::read(target.reader, made.text.as_bytes(), &configuration)
                .unwrap_or_else(|e| panic!("{name}: {e}"));
            // Positions with nine decimals, and of an XPS sums of them: no jump, but a nanometre of the travel.
            let verdict = verify_on_axes(&run, &machine, &VerifySettings::default()).unwrap();
            assert!(verdict.limits_respected, "{name}: {:?}", verdict.reason());
            compare(&plan, &run, &target, &name);
        }
    }
}

fn compare(plan: &Trajectory, run: &Trajectory, target: &Target, name: &str) {
    let planned = samples(plan);
    let added_s = run.total_time_s() - plan.total_time_s();
    // A motion that is at its limits everywhere is slowed down by some percent. The clock adds a tick or
    // two at every switch, and joined lines add half a line at both ends.
    let most_s = 0.03 * plan.total_time_s() + 0.05;
    assert!(added_s > -1e-6 && added_s < most_s, "{name}: {added_s} s longer");
    let mut near = 0;
    for (time_s, position) in samples(run).into_iter().step_by(7) {
        let distance = |k: usize| {
            let p = planned[k].1;
            (p[0] - position[0]).hypot(p[1] - position[1])
        };
        // The nearest sample of the plan, not before the one of the sample before.
        while near + 1 < planned.len() && planned[near + 1].0 < time_s - most_s - 0.02 {
            near += 1;
        }
        let last = planned.partition_point(|s| s.0 <= time_s + 0.02);
        let nearest =
            (near..last).min_by(|a, b| distance(*a).total_cmp(&distance(*b))).unwrap_or(near);
        // Between two samples the plan is on the line through them, but for nanometres (a t^2 / 8).
        let off = |k: usize| {
            let (a, b) = (planned[k].1, planned[(k + 1).min(planned.len() - 1)].1);
            let d = [b[0] - a[0], b[1] - a[1]];
            let e = [position[0] - a[0], position[1] - a[1]];
            let f = ((e[0] * d[0] + e[1] * d[1]) / (d[0] * d[0] + d[1] * d[1])).clamp(0.0, 1.0);
            let f = if f.is_finite() { f } else { 0.0 };
            (e[0] - f * d[0]).hypot(e[1] - f * d[1])
        };
        let distance = off(nearest).min(off(nearest.saturating_sub(1)));
        let allowed = PATH_DEVIATION_MM * 1.02 + 1e-5;
        assert!(distance <= allowed, "{name}: {distance} mm at {time_s} s");
    }
    if !target.switches {
        assert!(run.tool_on().iter().all(|on| *on), "{name}");
        return;
    }
    // The tool is on as long as planned, but for the time added and a tick at every switch.
    let on_s =
        |t: &Trajectory| t.segments().filter(|s| s.tool_on).map(|s| s.duration_s).sum::<f64>();
    let difference = on_s(run) - on_s(plan);
    assert!(difference.abs() <= added_s + 1e-3 * plan.len() as f64, "{name}: {difference} s");
}
