//! Programs as an operator loads them, written by `planish-export` and read back by `planish-import`: checksum, dry
//! run, lines of the machine file, the rest from a mark, and parts.

use planish_export::{
    Origin, Program, ProgramSettings, cuts, in_parts, joins_without_stop,
    pmac::{PmacBuffer, PmacSettings},
    program, scan_arrays,
};
use planish_import::program::{self as reader, Configuration};
use planish_types::{
    AxesMotion, ControllerFile, ControllerKind, Interpolation, Machine, MachineFile,
    MachineFileAxis, Trajectory,
};
use planish_verify::{Program as Law, VerifySettings, verify_on_axes};

/// Largest acceleration and jerk of the machine, mm/s^2 and mm/s^3.
const ACCELERATION: f64 = 1000.0;
const JERK: f64 = 20_000.0;

/// Radius of the circle of the motion, mm, and time for one turn, s.
const RADIUS_MM: f64 = 5.0;
const TURN_S: f64 = 1.6;

/// Returns a machine with a limit on jerk, and the lines of its controller, which has this kind.
fn machine(controller: Option<ControllerFile>) -> Machine {
    let axis = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: 100.0,
        max_acceleration_mm_per_s2: ACCELERATION,
        max_jerk_mm_per_s3: Some(JERK),
        travel_mm: Some([-50.0, 50.0]),
        ..MachineFileAxis::default()
    };
    let axes = vec![axis("x"), axis("y")];
    Machine::new(MachineFile { name: "bench".into(), axes, controller, ..MachineFile::default() })
        .unwrap()
}

/// Returns a motion along a circle from rest to rest, in 8 turns: it never rests between, and both axes accelerate. The
/// cubics join with continuous accelerations to rounding, because they are those of a fine spline.
fn circle(tool_on: impl Fn(usize) -> bool) -> Trajectory {
    const PIECES: usize = 1600;
    let end_s = 8.0 * TURN_S;
    // The angle goes from 0 to 16 pi at rest in velocity, acceleration and jerk.
    let angle = |t: f64| {
        let s = t / end_s;
        let ramp = s.powi(4) * (35.0 + s * (-84.0 + s * (70.0 - 20.0 * s)));
        16.0 * std::f64::consts::PI * ramp
    };
    let place = |t: f64| [RADIUS_MM * angle(t).cos(), RADIUS_MM * angle(t).sin()];
    let step_s = end_s / PIECES as f64;
    let mut coefficients = Vec::with_capacity(PIECES);
    let times: Vec<f64> = (0..=PIECES).map(|k| k as f64 * step_s).collect();
    let nodes: Vec<[f64; 2]> = times.iter().map(|t| place(*t)).collect();
    let splines = [0, 1].map(|a| natural_clamped(&nodes, a, step_s));
    for k in 0..PIECES {
        coefficients.push([0, 1].map(|a| {
            let (p, q) = (nodes[k][a], nodes[k + 1][a]);
            let (v, w) = (splines[a][k], splines[a][k + 1]);
            let mean = (q - p) / step_s;
            [p, v, (3.0 * mean - 2.0 * v - w) / step_s, (v + w - 2.0 * mean) / step_s.powi(2)]
        }));
    }
    let on = (0..PIECES).map(tool_on).collect();
    Trajectory::new(times, coefficients, on, vec![None; PIECES]).unwrap()
}

/// Returns the velocities of the cubic spline through equidistant nodes, at rest at both ends.
fn natural_clamped(nodes: &[[f64; 2]], axis: usize, step_s: f64) -> Vec<f64> {
    let n = nodes.len();
    // v_{k-1} + 4 v_k + v_{k+1} = 3 (p_{k+1} - p_{k-1}) / h, by elimination
    let mut diagonal = vec![1.0; n];
    let mut right = vec![0.0; n];
    for k in 1..n - 1 {
        let own = 3.0 * (nodes[k + 1][axis] - nodes[k - 1][axis]) / step_s;
        let factor = if k == 1 { 0.0 } else { 1.0 / diagonal[k - 1] };
        diagonal[k] = 4.0 - factor;
        right[k] = own - factor * right[k - 1];
    }
    let mut v = vec![0.0; n];
    for k in (1..n - 1).rev() {
        v[k] = (right[k] - v[k + 1]) / diagonal[k];
    }
    v
}

fn origin() -> Origin {
    Origin { made_from: "a test".into(), made_by: "planish-export".into(), ..Origin::default() }
}

fn write(kind: ControllerKind, settings: &ProgramSettings) -> Program {
    program(&circle(|_| true), &machine(None), kind, settings, &origin())
        .unwrap_or_else(|e| panic!("{kind:?}: {e}"))
}

/// Returns the configuration of the file beside a program, through its text.
fn beside(made: &Program) -> Configuration {
    serde_json::from_str(&serde_json::to_string(&made.about).unwrap()).unwrap()
}

fn read(kind: ControllerKind, made: &Program) -> AxesMotion {
    reader::read_axes(kind, made.text.as_bytes(), &beside(made))
        .unwrap_or_else(|e| panic!("{kind:?}: {e}"))
}

/// Returns the settings of a PMAC program that switches the tool, and loads itself into `buffer`.
fn pmac(buffer: PmacBuffer) -> ProgramSettings {
    let pmac = PmacSettings { tool_output: Some(1), buffer, ..PmacSettings::default() };
    ProgramSettings { pmac, ..ProgramSettings::default() }
}

/// Returns the settings of the programs of this kind.
fn settings_of(kind: ControllerKind) -> ProgramSettings {
    if kind == ControllerKind::Pmac {
        pmac(PmacBuffer::Program(7))
    } else {
        ProgramSettings::default()
    }
}

/// Returns position and velocity of the axes at the time `t` since the start.
fn state(motion: &AxesMotion, t: f64) -> [[f64; 2]; 2] {
    let times = motion.break_time_s();
    let t = (t + times[0]).clamp(times[0], times[motion.len()]);
    let k = times.partition_point(|s| *s <= t).clamp(1, motion.len()) - 1;
    let u = t - times[k];
    let axes = [0, 1].map(|a| motion.segment(k)[a]);
    [
        axes.map(|c| c[0] + u * (c[1] + u * (c[2] + u * c[3]))),
        axes.map(|c| c[1] + u * (2.0 * c[2] + u * 3.0 * c[3])),
    ]
}

/// Returns true if the controller joins the lines of a program in its own way.
fn is_lines(kind: ControllerKind) -> bool {
    kind.model().interpolation == Interpolation::Linear
}

/// Returns true if the lines of a program state times since its start, so that those of the rest are others.
fn has_absolute_times(kind: ControllerKind) -> bool {
    use ControllerKind::{Aerotech, Csv, Ros, SinumerikPoly, Twincat};
    matches!(kind, Aerotech | Csv | Ros | SinumerikPoly | Twincat)
}

/// Returns true if the file of the controller has no place for a comment.
fn is_bare(kind: ControllerKind) -> bool {
    use ControllerKind::{Ros, Xps, XpsPt, Zaber};
    matches!(kind, Ros | Xps | XpsPt | Zaber)
}

/// Checks that the limits of the machine hold on a motion, and that it is continuous, from rest to rest.
fn keeps_limits(motion: &AxesMotion, kind: ControllerKind, name: &str) {
    let coefficients = (0..motion.len()).map(|i| [motion.segment(i)[0], motion.segment(i)[1]]);
    let trajectory = Trajectory::new(
        motion.break_time_s().to_vec(),
        coefficients.collect(),
        motion.tool_on().to_vec(),
        motion.dwell_index().to_vec(),
    )
    .unwrap();
    let law = if is_lines(kind) { Law::Lines } else { Law::Cubics };
    let settings = VerifySettings { program: Some(law), ..VerifySettings::default() };
    let verdict = verify_on_axes(&trajectory, &machine(None), &settings).unwrap();
    assert!(verdict.limits_respected, "{name}: {:?}", verdict.reason());
}

#[test]
fn a_changed_program_is_refused_without_the_file_beside_it() {
    for kind in ControllerKind::ALL {
        let made = write(kind, &settings_of(kind));
        let alone = Configuration { program_blake3: None, ..beside(&made) };
        let read = |text: &str| reader::read_axes(kind, text.as_bytes(), &alone);
        assert!(read(&made.text).is_ok(), "{kind:?}");
        // Another line end is no change.
        assert!(read(&made.text.replace('\n', "\r\n")).is_ok(), "{kind:?}");
        if !made.text.contains("checksum: crc32") {
            assert!(is_bare(kind), "{kind:?}");
            continue;
        }
        // One digit of one segment, and a line less.
        let mark = made.about.marks.all()[5].line;
        let lines: Vec<&str> = made.text.lines().collect();
        let digit = lines[mark].rfind(|c: char| c.is_ascii_digit()).unwrap();
        let mut changed = lines[mark].to_string();
        let other = if changed.as_bytes()[digit] == b'7' { "8" } else { "7" };
        changed.replace_range(digit..=digit, other);
        let damaged = made.text.replacen(lines[mark], &changed, 1);
        let said = read(&damaged).unwrap_err().to_string();
        assert!(said.contains("checksum: is"), "{kind:?}: {said}");
        let shorter = made.text.replacen(&format!("{}\n", lines[mark]), "", 1);
        assert!(read(&shorter).unwrap_err().to_string().contains("checksum: is"), "{kind:?}");
    }
}

#[test]
fn a_dry_run_is_the_same_motion_with_the_tool_off() {
    for kind in ControllerKind::ALL {
        let settings = settings_of(kind);
        let real = write(kind, &settings);
        let dry = write(kind, &ProgramSettings { dry_run: true, ..settings });
        assert!(dry.about.dry_run && !real.about.dry_run);
        let (motion, run) = (read(kind, &dry), read(kind, &real));
        assert!(motion.tool_on().iter().all(|on| !on), "{kind:?}");
        assert!(run.tool_on().iter().any(|on| *on), "{kind:?}");
        assert_eq!(motion.break_time_s(), run.break_time_s(), "{kind:?}");
        for k in 0..run.len() {
            assert_eq!(motion.segment(k), run.segment(k), "{kind:?}, segment {k}");
        }
        // The text says so by itself, where it can.
        let says = dry.text.contains("DRY RUN");
        assert_eq!(says, !is_bare(kind), "{kind:?}");
        if says {
            let bare = Configuration { dry_run: false, program_blake3: None, ..beside(&dry) };
            let motion = reader::read_axes(kind, dry.text.as_bytes(), &bare).unwrap();
            assert!(motion.tool_on().iter().all(|on| !on), "{kind:?}");
        }
    }
}

#[test]
fn lines_of_the_machine_file_change_no_motion() {
    let lines = |list: &[&str]| list.iter().map(ToString::to_string).collect::<Vec<_>>();
    let cases: [(ControllerKind, &[&str], &[&str]); 4] = [
        (ControllerKind::Galil, &["SHAB", "SB 3", "AI 1", "WT 2000"], &["CB 3"]),
        (ControllerKind::Pmac, &["M2=1", "WHILE(M11=0)WAIT", "DWELL2000"], &["M2=0"]),
        (ControllerKind::Gcode, &["M3 S500", "M66 P1 L3 Q60", "G4 P2"], &["M5", "M65 P2"]),
        (ControllerKind::Aerotech, &["DOUT X,0,1", "DWELL 2"], &["DOUT X,0,0"]),
    ];
    for (kind, before, after) in cases {
        let stated = ControllerFile {
            prologue: lines(before),
            epilogue: lines(after),
            ..ControllerFile::new(kind)
        };
        let machine = machine(Some(stated));
        let made =
            program(&circle(|_| true), &machine, kind, &settings_of(kind), &origin()).unwrap();
        let text: Vec<&str> = made.text.lines().collect();
        let line = |wanted: &str| text.iter().position(|line| *line == wanted).unwrap() + 1;
        let first = made.about.marks.all()[0].line;
        let last = made.about.marks.all().last().unwrap().line;
        assert!(before.iter().all(|wanted| line(wanted) < first), "{kind:?}");
        assert!(after.iter().all(|wanted| line(wanted) > last), "{kind:?}");
        let (with, without) = (read(kind, &made), read(kind, &write(kind, &settings_of(kind))));
        assert_eq!(with.break_time_s(), without.break_time_s(), "{kind:?}");
        assert!((0..with.len()).all(|k| with.segment(k) == without.segment(k)), "{kind:?}");
        // A program for another controller leaves them out, and says so.
        let other = program(
            &circle(|_| true),
            &machine,
            ControllerKind::Csv,
            &settings_of(kind),
            &origin(),
        );
        let warnings = other.unwrap().about.warnings;
        assert!(
            warnings.iter().any(|w| w.contains("states lines for its controller")),
            "{warnings:?}"
        );
    }
}

/// Checks the rest from marks all over the program, of every controller: from rest, within the limits, and from the mark
/// on with the lines of the whole program and their motion.
#[test]
fn every_program_starts_at_its_marks_without_a_jump() {
    for kind in ControllerKind::ALL {
        let settings = settings_of(kind);
        let whole = write(kind, &settings);
        let motion = read(kind, &whole);
        let marks = whole.about.marks.all();
        let n = whole.about.segments;
        let lines: Vec<&str> = whole.text.lines().collect();
        for mark in (n / 12..n).step_by(n / 5) {
            let name = format!("{kind:?}, mark {mark} of {n}");
            let settings = ProgramSettings { marks: Some([mark, n]), ..settings.clone() };
            let made = write(kind, &settings);
            let excerpt = made.about.excerpt.as_ref().unwrap();
            assert_eq!(excerpt.whole_blake3, whole.about.program_blake3, "{name}");
            assert_eq!(excerpt.from_line, marks[mark].line, "{name}");
            let rest = read(kind, &made);
            keeps_limits(&rest, kind, &name);
            // The circle is at 50 mm/s at most, of 1000 mm/s^2 and 20000 mm/s^3: 0.3 s by jerk and acceleration.
            assert!(
                excerpt.run_up_s > 0.0 && excerpt.run_up_s < 1.0,
                "{name}: {}",
                excerpt.run_up_s
            );
            let own = made.about.marks.all();
            let run_up = excerpt.run_up_segments;
            assert_eq!(own[run_up].position, marks[mark].position, "{name}");
            // Positions and velocities at the same time after the mark are those of the whole program. Sums of an XPS
            // round by 1e-12 each; joined lines differ over the half of the line at the mark.
            let is_lines = is_lines(kind);
            // Half a line before its first node begins the motion of lines, unless the axes stand there first.
            let shift_s = |made: &Program| {
                let marks = made.about.marks.all();
                let moves = marks[0].position != marks[1].position;
                if is_lines && moves { 0.5 * marks[1].time_s } else { 0.0 }
            };
            let (from_s, at_s) =
                (marks[mark].time_s + shift_s(&whole), own[run_up].time_s + shift_s(&made));
            let least_s = if is_lines { marks[mark + 1].time_s - marks[mark].time_s } else { 0.0 };
            let last_s = marks[n - 1].time_s - marks[mark].time_s;
            for k in 0..=200 {
                let t = least_s + (last_s - least_s) * f64::from(k) / 200.0;
                let (expected, found) = (state(&motion, from_s + t), state(&rest, at_s + t));
                for (e, f) in expected.iter().flatten().zip(found.iter().flatten()) {
                    // Times have nine decimals: 50 mm/s and 1000 mm/s^2 times a nanosecond.
                    assert!((e - f).abs() < 2e-6, "{name}, {t} s: {e} {f}");
                }
            }
            if !has_absolute_times(kind) {
                let text: Vec<&str> = made.text.lines().collect();
                let (a, b) = (marks[mark + 1].line - 1, marks[n - 1].line - 1);
                let a_own = own[run_up + 1].line - 1;
                let same = lines[a..b].iter().filter(|line| !line.starts_with("BT"));
                let own = text[a_own..].iter().filter(|line| !line.starts_with("BT"));
                assert!(same.zip(own).all(|(x, y)| x == y), "{name}");
            }
            assert!(!rest.tool_on()[0], "{name}: the tool is on in the run-up");
        }
    }
}

#[test]
fn a_run_up_beyond_the_travel_is_refused() {
    let narrow = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: 100.0,
        max_acceleration_mm_per_s2: ACCELERATION,
        max_jerk_mm_per_s3: Some(JERK),
        travel_mm: Some([-5.001, 5.001]),
        ..MachineFileAxis::default()
    };
    let file = MachineFile {
        name: "narrow".into(),
        axes: vec![narrow("x"), narrow("y")],
        ..MachineFile::default()
    };
    let machine = Machine::new(file).unwrap();
    let write = |marks| {
        let settings = ProgramSettings { marks, ..ProgramSettings::default() };
        program(&circle(|_| true), &machine, ControllerKind::Xps, &settings, &origin())
    };
    let n = write(None).unwrap().about.segments;
    // In the middle the circle is fastest, and the run-up is some millimetres along its tangent.
    let mut refusals = 0;
    for mark in (n / 2..n / 2 + n / 8).step_by((n / 80).max(1)) {
        match write(Some([mark, n])) {
            Ok(made) => {
                assert!(made.about.limits.reach_mm.iter().flatten().all(|p| p.abs() <= 5.001))
            }
            Err(e) => {
                let said = e.to_string();
                let expected = format!("mark: {mark}: no run-up to it keeps the limits");
                assert!(said.contains(&expected) && said.contains("beyond its travel"), "{said}");
                assert!(said.contains("planish resume"), "{said}");
                refusals += 1;
            }
        }
    }
    assert!(refusals > 0);
    let beyond = ProgramSettings { marks: Some([9999, 10_000]), ..ProgramSettings::default() };
    let made = program(&circle(|_| true), &machine, ControllerKind::Xps, &beyond, &origin());
    assert!(made.unwrap_err().to_string().contains("the program has the marks 0 to"));
}

#[test]
fn parts_are_the_same_motion() {
    let mut joined = 0;
    let pmacs =
        [PmacBuffer::Rotary(1), PmacBuffer::Program(3)].map(|b| (ControllerKind::Pmac, pmac(b)));
    let all = ControllerKind::ALL.map(|kind| (kind, ProgramSettings::default()));
    for (kind, settings) in all.into_iter().chain(pmacs) {
        let whole = write(kind, &settings);
        let motion = read(kind, &whole);
        let cuts = cuts(whole.about.segments, 3);
        if joins_without_stop(kind, &settings) {
            joined += 1;
            let parts = in_parts(&whole, kind, &settings, &cuts);
            let files: Vec<(Vec<u8>, Configuration)> =
                parts.iter().map(|part| (part.text.clone().into_bytes(), beside(part))).collect();
            let text = reader::join(&files).unwrap_or_else(|(i, e)| panic!("{kind:?} {i}: {e}"));
            let about = Configuration { program_blake3: None, ..beside(&parts[0]) };
            let back = reader::read_axes(kind, &text, &about).unwrap();
            assert_eq!(back.break_time_s(), motion.break_time_s(), "{kind:?}");
            assert!((0..back.len()).all(|k| back.segment(k) == motion.segment(k)), "{kind:?}");
            assert_eq!(back.tool_on(), motion.tool_on(), "{kind:?}");
            for (part, cut) in parts.iter().zip(&cuts) {
                let mark = &part.about.marks.all()[0];
                let wanted = &whole.about.marks.all()[*cut];
                assert_eq!(mark.time_s, wanted.time_s);
                let line = |text: &str, n: usize| text.lines().nth(n - 1).unwrap().to_string();
                assert_eq!(line(&part.text, mark.line), line(&whole.text, wanted.line), "{kind:?}");
                let alone = reader::read_axes(kind, part.text.as_bytes(), &beside(part));
                assert!(
                    alone.unwrap_err().to_string().contains("of 3; give all parts"),
                    "{kind:?}"
                );
            }
            let mut wrong = files.clone();
            wrong.swap(1, 2);
            assert!(reader::join(&wrong).unwrap_err().1.to_string().contains("is part 3 of 3"));
            assert!(reader::join(&files[..2]).is_err(), "{kind:?}");
            continue;
        }
        // The others rest between: every part is a program by itself, and with its run-up and run-down off it has the
        // nodes of the whole one.
        let mut covered = 0;
        for cut in cuts.windows(2) {
            let marks = Some([cut[0], cut[1]]);
            let part = write(kind, &ProgramSettings { marks, ..settings.clone() });
            let run = read(kind, &part);
            keeps_limits(&run, kind, &format!("{kind:?} {cut:?}"));
            let excerpt = part.about.excerpt.as_ref().unwrap();
            let own = part.about.marks.all();
            let inside = excerpt.run_up_segments..part.about.segments - excerpt.run_down_segments;
            for k in inside {
                assert_eq!(own[k].position, whole.about.marks.all()[covered].position, "{kind:?}");
                covered += 1;
            }
        }
        assert_eq!(covered, whole.about.segments, "{kind:?}");
    }
    assert_eq!(joined, 3);
}

/// Checks that the arrays of the trajectory-scan program are the motion of the program: the same numbers.
#[test]
fn scan_arrays_have_the_numbers_of_the_program() {
    let motion = circle(|k| !(400..500).contains(&k));
    let settings = pmac(PmacBuffer::OfTheHost);
    let made =
        program(&motion, &machine(None), ControllerKind::Pmac, &settings, &origin()).unwrap();
    let arrays: serde_json::Value = serde_json::from_str(&scan_arrays(&made).unwrap()).unwrap();
    let run = read(ControllerKind::Pmac, &made);
    let list = |name: &str| arrays[name].as_array().unwrap().clone();
    let times: Vec<f64> = list("time_us").iter().map(|v| v.as_f64().unwrap()).collect();
    assert_eq!(times.len(), made.about.segments);
    let users: Vec<u64> = list("user").iter().map(|v| v.as_u64().unwrap()).collect();
    let mut elapsed_s = 0.0;
    for (k, us) in times.iter().enumerate() {
        elapsed_s += us * 1e-6;
        let [p, v] = state(&run, elapsed_s - 1e-12);
        for (a, name) in ["X", "Y"].iter().enumerate() {
            let number = |what: &str| arrays["axes"][name][what][k].as_f64().unwrap();
            // The state is that of a cubic, evaluated at its end.
            assert!((number("positions") - p[a]).abs() < 1e-8, "{k} {name}");
            assert!((number("velocities") - v[a]).abs() < 1e-5, "{k} {name}");
        }
        let middle = run.break_time_s().partition_point(|s| *s < elapsed_s - 0.5e-6 * us) - 1;
        assert_eq!(users[k] == 1, run.tool_on()[middle], "{k}");
    }
    assert!(users.contains(&1) && users.contains(&2));
}
