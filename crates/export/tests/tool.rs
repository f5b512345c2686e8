//! State of the tool in every program that switches it: replayed by controllers written here from the manuals alone,
//! which know nothing of the writers.

use planish_export::{Origin, ProgramSettings, gcode, pmac, program};
use planish_types::{ControllerKind, Limits, MachineFile, MachineFileAxis, Trajectory};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Actions of the axes (lines of a program), each with the state of the tool during it, true for on.
type Events = Vec<(String, bool)>;

/// Returns the actions of a G-code program `text` by the manual of LinuxCNC (M-codes, "M62 - M65 Digital Output
/// Control"). M62 and M63 are queued: the change happens at the beginning of the next motion command, and not at all
/// without one. M64 and M65 happen at once. A dwell (G4) is no motion command. The run before was aborted and has left
/// the output on.
fn linuxcnc(text: &str) -> Events {
    let (mut on, mut queued) = (true, None);
    let mut events = Events::new();
    for line in text.lines().filter(|l| !l.starts_with('(')) {
        let first = line.split(' ').next().unwrap();
        match line {
            "M62 P0" => queued = Some(true),
            "M63 P0" => queued = Some(false),
            "M64 P0" => on = true,
            "M65 P0" => on = false,
            "M2" => {
                events.push(("end".into(), on));
                return events;
            }
            _ if ["G0", "G1"].contains(&first) => {
                on = queued.take().unwrap_or(on);
                events.push((first.into(), on));
            }
            _ if first == "G4" => events.push(("G4".into(), on)),
            _ => assert!(
                ["G21", "G64", "G61", "G92.2", "G93", "G94", "M49"].contains(&first),
                "{line}"
            ),
        }
    }
    panic!("no end");
}

/// Returns the actions of a PMAC program `text` by the Turbo PMAC user manual ("Synchronous M-Variable Assignment").
/// `==` is executed at the start of the next move or dwell, and not at all after the last one; `=` when the line is
/// read, one or two moves early among moves.
fn pmac(text: &str) -> Events {
    let (mut on, mut queued) = (true, None);
    let mut events = Events::new();
    for line in text.lines().filter(|l| !l.starts_with(';')) {
        match line {
            "M7==1" => queued = Some(true),
            "M7==0" => queued = Some(false),
            "M7=0" => {
                assert!(events.is_empty(), "would happen one or two moves early");
                on = false;
            }
            "ABS" | "RAPID" => {}
            _ if line.starts_with("PVT") => {}
            _ => {
                on = queued.take().unwrap_or(on);
                let what = if line.starts_with("DWELL") { "dwell" } else { "move" };
                events.push((what.into(), on));
            }
        }
    }
    events.push(("end".into(), on));
    events
}

/// Returns the actions for a host that sets the output at every row of the table.
fn table(text: &str) -> Events {
    let rows = text.lines().filter(|l| l.starts_with(|c: char| c.is_ascii_digit()));
    rows.map(|l| ("row".into(), l.ends_with(",1"))).collect()
}

fn limits() -> Limits {
    let axis = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: 100.0,
        max_acceleration_mm_per_s2: 1000.0,
        max_jerk_mm_per_s3: None,
        ..MachineFileAxis::default()
    };
    MachineFile {
        name: "bench".into(),
        axes: vec![axis("x"), axis("y")],
        min_segment_s: 0.0,
        ..MachineFile::default()
    }
    .checked()
    .unwrap()
}

/// Makes a motion that moves from rest to rest (true) or stands (false) in each segment.
fn motion(moves: &[bool], tool_on: &[bool]) -> Trajectory {
    let mut x = 0.0;
    let coefficients = moves.iter().map(|moves| {
        let d = if *moves { 1.0 } else { 0.0 };
        let c = [[x, 0.0, 3.0 * d, -2.0 * d], [0.0; 4]];
        x += d;
        c
    });
    let coefficients = coefficients.collect();
    let n = moves.len();
    let times = (0..=n).map(|k| k as f64).collect();
    Trajectory::new(times, coefficients, tool_on.to_vec(), vec![Some(0); n]).unwrap()
}

fn text(plan: &Trajectory, controller: ControllerKind, settings: &ProgramSettings) -> String {
    let origin = Origin { made_from: "a test".into(), made_by: "hand".into(), ..Origin::default() };
    program(plan, &limits().into(), controller, settings, &origin).unwrap().text
}

/// Returns the states of the tool in their order, equal neighbours once, because a segment of the plan can be several
/// lines of the program, and several segments one line.
fn states(events: &[(String, bool)]) -> Vec<bool> {
    changes(events.iter().map(|e| e.1).collect())
}

fn changes(mut states: Vec<bool>) -> Vec<bool> {
    states.dedup();
    states
}

#[test]
fn the_tool_is_on_exactly_where_the_plan_has_it_on() {
    let mut random = ChaCha8Rng::seed_from_u64(23);
    for case in 0..300 {
        let n = random.random_range(1..12);
        let mut some = || (0..n).map(|_| random.random_range(0..2) == 1).collect::<Vec<bool>>();
        let (moves, on) = (some(), some());
        if moves.iter().all(|m| !m) {
            continue;
        }
        let plan = motion(&moves, &on);
        let name = format!("case {case}: moves {moves:?}, on {on:?}");
        for feed in [gcode::Feed::InverseTime, gcode::Feed::PerMinute] {
            let gcode = gcode::GcodeSettings { feed, ..gcode::GcodeSettings::default() };
            let settings = ProgramSettings { gcode, ..ProgramSettings::default() };
            let events = linuxcnc(&text(&plan, ControllerKind::Gcode, &settings));
            // Off on the way to the start, as planned in every segment, off at the end.
            let last = events.len() - 1;
            assert_eq!(events[0], ("G0".into(), false), "{name}");
            assert_eq!(states(&events[1..last]), changes(on.clone()), "{name}");
            assert_eq!(events[last], ("end".into(), false), "{name}");
        }
        let output = pmac::PmacSettings { tool_output: Some(7), ..pmac::PmacSettings::default() };
        let settings = ProgramSettings { pmac: output, ..ProgramSettings::default() };
        let events = pmac(&text(&plan, ControllerKind::Pmac, &settings));
        // Off on the way to the start, and while the axes come to rest there.
        let last = events.len() - 2;
        assert_eq!(events[..2], [("move".into(), false), ("dwell".into(), false)], "{name}");
        assert_eq!(states(&events[2..last]), changes(on.clone()), "{name}");
        assert_eq!(events[last..], [("dwell".into(), false), ("end".into(), false)], "{name}");
        let events = table(&text(&plan, ControllerKind::Csv, &ProgramSettings::default()));
        let last = events.len() - 1;
        assert_eq!(states(&events[..last]), changes(on), "{name}");
        assert_eq!(events[last..], [("row".into(), false)], "{name}");
    }
}

/// Checks that the replay finds the fault of an older form of the programs, which had synchronised switches only.
#[test]
fn synchronised_switches_alone_leave_the_tool_on() {
    let old = "G21 G90 G17 G40 G49 G94\nG0 X1 Y-2\nG93\nM62 P0\nG1 X2 Y-2 F600\nM63 P0\nG4 P3\nM62 P0\n\
               G1 X3 Y-2 F600\nM63 P0\nG94 F60\nM2\n";
    let expected = [("G0", true), ("G1", true), ("G4", true), ("G1", true), ("end", true)];
    assert_eq!(linuxcnc(old), expected.map(|(what, on)| (what.to_string(), on)));
    let old = "ABS\nM7==1\nPVT100\nX2:0 Y-2:0\nM7==0\n";
    assert_eq!(pmac(old), [("move".to_string(), true), ("end".to_string(), true)]);
}
