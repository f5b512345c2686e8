//! Random motions written for every controller by `planish-export` and read back by the reader of
//! `planish-import`, which shares no code with the writer: every end within half a count and half a
//! tick, no drift, the cubic between the ends as planned, the tool on where the plan has it on.

use planish_export::{Common, Controller, Origin, csv, galil, gcode, pmac, program, xps};
use planish_import::program::{self as reader, Configuration};
use planish_testkit::{case_generator, machine};
use planish_types::Trajectory;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// What a controller rounds to, and how it is read.
struct Target {
    controller: Controller,
    reader: reader::Controller,
    tick_s: f64,
    /// What a velocity is rounded to, in counts/s (0: not rounded beyond 1e-9 mm/s).
    counts_per_s: f64,
    /// Whether the motion between two ends is the cubic.
    cubic: bool,
    /// Whether the program switches the tool.
    switches: bool,
    /// Rounding of the text: error of a time, s.
    time_s: f64,
}

fn targets() -> Vec<Target> {
    let target = |controller, reader, tick_s| Target {
        controller,
        reader,
        tick_s,
        counts_per_s: 0.0,
        cubic: true,
        switches: true,
        // Sums of up to 60 times, each to rounding.
        time_s: 1e-12,
    };
    vec![
        Target {
            counts_per_s: 1.0,
            switches: false,
            ..target(
                Controller::Galil(galil::Settings::default()),
                reader::Controller::Galil,
                2.0 / 1024.0,
            )
        },
        Target {
            switches: false,
            ..target(Controller::Xps(xps::Settings { tick_s: 1e-4 }), reader::Controller::Xps, 1e-4)
        },
        target(
            Controller::Pmac(pmac::Settings {
                tick_s: 2.5e-7,
                feedrate_time_unit_s: 0.001,
                tool_output: Some(1),
            }),
            reader::Controller::Pmac,
            2.5e-7,
        ),
        Target {
            cubic: false,
            // F with 9 digits, times up to 100 s.
            time_s: 1e-6,
            ..target(Controller::Gcode(gcode::Settings::default()), reader::Controller::Gcode, 1e-6)
        },
        Target {
            cubic: false,
            time_s: 1e-6,
            ..target(
                Controller::Gcode(gcode::Settings {
                    feed: gcode::Feed::PerMinute,
                    ..gcode::Settings::default()
                }),
                reader::Controller::Gcode,
                1e-6,
            )
        },
        target(Controller::Csv(csv::Settings { tick_s: 1e-6 }), reader::Controller::Csv, 1e-6),
    ]
}

/// A smooth motion from rest to rest, with stops and with slow segments.
fn motion(random: &mut ChaCha8Rng) -> Trajectory {
    let n = random.random_range(1..60);
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

#[test]
fn every_program_reads_back_within_half_a_count_and_half_a_tick() {
    let machine = machine([250.0, 150.0], [1e4, 1e4]);
    let origin = Origin {
        made_from: "a test".into(),
        made_by: "planish-export".into(),
        ..Origin::default()
    };
    for (case, count_mm) in (0..200).zip([1e-4, 1e-3, 2.5e-4, 1e-5].into_iter().cycle()) {
        let plan = motion(&mut case_generator(1, 7, case));
        let common =
            Common { count_mm: [count_mm, 2.0 * count_mm], max_step_s: None, always_on: true };
        for target in targets() {
            let name = format!("case {case}, count {count_mm}, {:?}", target.controller);
            let made =
                program(&plan, &machine.clone().into(), &target.controller, &common, &origin)
                    .unwrap_or_else(|e| panic!("{name}: {e}"));
            // Through the file beside it, as a user does.
            let about = serde_json::to_string(&made.about).unwrap();
            let configuration: Configuration = serde_json::from_str(&about).unwrap();
            let run = reader::read(target.reader, made.text.as_bytes(), &configuration)
                .unwrap_or_else(|e| panic!("{name}: {e}"));
            compare(&plan, &run, &target, common.count_mm, &name);
        }
    }
}

fn compare(plan: &Trajectory, run: &Trajectory, target: &Target, count_mm: [f64; 2], name: &str) {
    let start = plan.break_time_s()[0];
    // Segments that were too long for the controller are several.
    assert!(run.len() >= plan.len(), "{name}");
    let half_tick = 0.5 * target.tick_s * (1.0 + 1e-6) + target.time_s;
    let mut k = 0;
    for (i, segment) in plan.segments().enumerate() {
        let (begin, end) = (segment.start_s - start, segment.start_s - start + segment.duration_s);
        while k < run.len() && run.break_time_s()[k] < end - target.tick_s - target.time_s {
            let (piece, at) = (run.segment(k), run.break_time_s()[k] - begin);
            assert_eq!(piece.tool_on, segment.tool_on || !target.switches, "{name}: segment {i}");
            let planned = segment.position_mm(at.clamp(0.0, segment.duration_s));
            let found = piece.position_mm(0.0);
            for a in 0..2 {
                // Half a count, what the plan moves in half a tick (at most 40 mm/s), rounding.
                let allowed = 0.5 * count_mm[a] * (1.0 + 1e-6) + 40.0 * half_tick + 1e-9;
                assert!((planned[a] - found[a]).abs() <= allowed, "{name}: segment {i}");
            }
            k += 1;
        }
        // The end of the planned segment is an end of the program: half a count, half a tick.
        assert!((run.break_time_s()[k] - end).abs() <= half_tick, "{name}: end of {i}");
        let piece = run.segment(k - 1);
        let (planned, found) =
            (segment.position_mm(segment.duration_s), piece.position_mm(piece.duration_s));
        for a in 0..2 {
            // 9 decimals of the text, and sums of up to 100 of them.
            let allowed = 0.5 * count_mm[a] * (1.0 + 1e-6) + 1e-9;
            assert!((planned[a] - found[a]).abs() <= allowed, "{name}: end of segment {i}");
        }
        if target.cubic {
            for axis in 0..2 {
                let c = piece.coefficient_mm[axis];
                let u = piece.duration_s;
                let d = segment.coefficient_mm[axis];
                let t = segment.duration_s;
                let (v, w) = (
                    c[1] + u * (2.0 * c[2] + 3.0 * c[3] * u),
                    d[1] + t * (2.0 * d[2] + 3.0 * d[3] * t),
                );
                let allowed = 0.5 * target.counts_per_s * count_mm[axis] + 1e-8;
                assert!((v - w).abs() <= allowed, "{name}: velocity at the end of segment {i}");
            }
        }
    }
    assert_eq!(k, run.len(), "{name}");
    // No drift: the end of the program is the end of the plan.
    assert!((run.total_time_s() - plan.total_time_s()).abs() <= half_tick, "{name}");
}
