//! Tests of the programs of a motion, line by line. Another test, `crates/testkit/tests/programs.rs`, checks that they
//! run as planned: it reads them back with the reader of `planish-import`.

use planish_export::{Origin, ProgramSettings, gcode, pmac, program};
use planish_types::{ControllerKind, Counts, Limits, MachineFile, MachineFileAxis, Trajectory};

fn machine() -> Limits {
    let axis = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: 100.0,
        max_acceleration_mm_per_s2: 1000.0,
        max_jerk_mm_per_s3: None,
        ..MachineFileAxis::default()
    };
    MachineFile {
        name: "bench (1)".into(),
        axes: vec![axis("x"), axis("y")],
        ..MachineFile::default()
    }
    .checked()
    .unwrap()
}

/// Makes a motion from rest at (1, -2) mm by 1.00004 mm along x to rest in 0.125 s, then 3 s of standing. `tool_on` has
/// the state of the tool in both segments.
fn motion(tool_on: [bool; 2]) -> Trajectory {
    let d = 1.00004;
    // 3 d u^2 / T^2 - 2 d u^3 / T^3
    let t = 0.125;
    let x = [1.0, 0.0, 3.0 * d / (t * t), -2.0 * d / (t * t * t)];
    let end = [1.0 + d, 0.0, 0.0, 0.0];
    let y = [-2.0, 0.0, 0.0, 0.0];
    let times = vec![5.0, 5.0 + t, 8.0 + t];
    Trajectory::new(times, vec![[x, y], [end, y]], tool_on.to_vec(), vec![Some(0), Some(1)])
        .unwrap()
}

fn write(
    trajectory: &Trajectory,
    controller: ControllerKind,
    settings: &ProgramSettings,
) -> Result<String, String> {
    let origin = Origin { made_from: "a test".into(), made_by: "hand".into(), ..Origin::default() };
    program(trajectory, &machine().into(), controller, settings, &origin)
        .map(|p| p.text)
        .map_err(|e| e.to_string())
}

fn settings() -> ProgramSettings {
    ProgramSettings { counts: Counts::linear(1e-4), ..ProgramSettings::default() }
}

#[test]
fn the_text_of_every_controller() {
    let motion = motion([true; 2]);
    let body_with = |controller, settings: &ProgramSettings| {
        let text = write(&motion, controller, settings).unwrap();
        let comment = |l: &&str| !["' ", "; ", "# ", "// ", "("].iter().any(|c| l.starts_with(c));
        text.lines().filter(comment).collect::<Vec<_>>().join("\n")
    };
    let body = |controller| body_with(controller, &settings());
    // 10000.4 counts in 64 ticks; 3 s are more than 2048 samples: two parts.
    let expected = "PVA=0,0,-1\nPVB=0,0,-1\nPVA=10000,0,128\nPVB=0,0,128\nPVA=0,0,2048\nPVB=0,0,2048\n\
                    PVA=0,0,1024\nPVB=0,0,1024\nBTAB\nPVA=0,0,0\nPVB=0,0,0";
    assert_eq!(body(ControllerKind::Galil), expected);
    let expected = "0.125, 1, 0, 0, 0\n3, 0, 0, 0, 0";
    assert_eq!(body(ControllerKind::Xps), expected);
    let expected = "ABS\nPVT125\nX2:0 Y-2:0\nPVT3000\nX2:0 Y-2:0";
    assert_eq!(body(ControllerKind::Pmac), expected);
    let pmac = pmac::PmacSettings { tool_output: Some(7), ..pmac::PmacSettings::default() };
    let switched = ProgramSettings { pmac, ..settings() };
    let expected = "M7=0\nABS\nRAPID\nX1 Y-2\nDWELL0\nM7==1\nPVT125\nX2:0 Y-2:0\nPVT3000\nX2:0 Y-2:0\nM7==0\nDWELL0";
    assert_eq!(body_with(ControllerKind::Pmac, &switched), expected);
    // Lines, then a dwell: the tool switches with the first, and at once after the last.
    let gcode = body(ControllerKind::Gcode);
    let head = "M65 P0\nG21 G90 G17 G40 G49 G54 G94\nG92.2\nM49\nG64 P0.005 Q0\nG0 X1 Y-2\nG93\nM62 P0\nG1 X";
    assert!(gcode.starts_with(head), "{gcode}");
    let end: Vec<&str> = gcode.lines().rev().take(5).collect();
    assert_eq!(end[..3], ["M2", "G94 F60", "M65 P0"]);
    assert!(end[3].starts_with("G4 P") && end[4].starts_with("G1 X2 Y-2 F"), "{end:?}");
    let gcode =
        gcode::GcodeSettings { feed: gcode::Feed::PerMinute, ..gcode::GcodeSettings::default() };
    let per_minute = ProgramSettings { gcode, ..settings() };
    assert!(body_with(ControllerKind::Gcode, &per_minute).contains("\nG94\nM62 P0\nG1 X"));
    let expected = "t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on\n0,1,0,-2,0,1\n0.125,2,0,-2,0,1\n\
                    3.125,2,0,-2,0,0";
    assert_eq!(body(ControllerKind::Csv), expected);
    let expected = "PROGRAM\nABS\nVELOCITY ON\nPVT INIT TIME ABS\nPVT X 2,0 Y -2,0 TIME 0.125\n\
                    PVT X 2,0 Y -2,0 TIME 3.125\nWAIT MOVEDONE X Y\nVELOCITY OFF\nEND PROGRAM";
    assert_eq!(body(ControllerKind::Aerotech), expected);
    let expected = "program\nSetupTaskTargetMode(TargetMode.Absolute)\nSetupTaskTimeUnits(TimeUnits.Seconds)\n\
                    MovePvt([X, Y], [2, -2], [0, 0], 125)\nMovePvt([X, Y], [2, -2], [0, 0], 3000)\n\
                    WaitForMotionDone([X, Y])\nend";
    assert_eq!(body(ControllerKind::Automation1), expected);
    let expected = "Time (s),x Position (mm),x Velocity (mm/s),y Position (mm),y Velocity (mm/s)\n\
                    0.125,2,0,-2,0\n3,2,0,-2,0";
    assert_eq!(body(ControllerKind::Zaber), expected);
    // 3 d p^2 / PL^2 - 2 d p^3 / PL^3, d = 1 mm and PL = 125 ms
    let expected = "G17 G40 G71 G90 G94\nG0 X1 Y-2 W=0\nFGROUP(W)\nUPATH\nG64\nF60\n\
                    POLY PO[X]=(2,0.000192,-0.000001024) PO[Y]=(-2,0,0) W=0.125 PL=125\n\
                    PO[X]=(2,0,0) PO[Y]=(-2,0,0) W=3.125 PL=3000\nG1\nFGROUP()\nM30";
    assert_eq!(body(ControllerKind::SinumerikPoly), expected);
    let lines = body(ControllerKind::Sinumerik);
    let head = "G17 G40 G71 G90 G94\nFGROUP(X,Y)\nG642 CTOL=0.005\nG0 X1 Y-2\nG93\nG1 X";
    assert!(lines.starts_with(head) && lines.ends_with("\nG94 F60\nM30"), "{lines}");
    assert!(lines.contains(" Y-2 F") && lines.contains("\nG4 F"), "{lines}");
    // Elements add up to the way and nearly to the time; without way the axes stand.
    let elements = body(ControllerKind::XpsPt);
    let sums = elements.lines().fold([0.0; 3], |sums: [f64; 3], line| {
        let numbers: Vec<f64> = line.split(", ").map(|word| word.parse().unwrap()).collect();
        std::array::from_fn(|i| sums[i] + numbers[i])
    });
    assert!((sums[0] - 3.125).abs() < 0.01, "{sums:?}");
    assert!((sums[1] - 1.0).abs() < 1e-6 && sums[2] == 0.0, "{sums:?}");
    let table = body(ControllerKind::Twincat);
    let head = "cycle_s,0.002\ncycle,x_mm,vx_mm_per_s,ax_mm_per_s2,y_mm,vy_mm_per_s,ay_mm_per_s2,tool_on,segment\n0,1,0,";
    assert!(table.starts_with(head) && table.ends_with(",2,0,0,-2,0,0,0,3"), "{table:.300}");
    let point = |x: &str, sec: u32, nanosec: u32| {
        format!(
            "  {{\"positions\": [{x}, -0.002], \"velocities\": [0.0, 0.0], \"time_from_start\": {{\"sec\": {sec}, \
             \"nanosec\": {nanosec}}}}}"
        )
    };
    let points =
        [point("0.001", 0, 0), point("0.002", 0, 125_000_000), point("0.002", 3, 125_000_000)];
    let head = "{\"header\": {\"stamp\": {\"sec\": 0, \"nanosec\": 0}, \"frame_id\": \"\"},\n \"joint_names\": \
                [\"x\", \"y\"],\n \"points\": [\n";
    assert_eq!(body(ControllerKind::Ros), format!("{head}{}\n ]}}", points.join(",\n")));
}

#[test]
fn the_header_says_what_it_is() {
    let text = write(&motion([true; 2]), ControllerKind::Galil, &settings()).unwrap();
    for part in [
        "' galil for bench _1_, written by hand",
        "' made from: a test",
        "' units: A = x in counts of 0.0001 mm",
        "TM 1000",
        "' start: x 1 mm, y -2 mm",
        "' 3 segments, total time 3.125 s",
        "' start: A 10000, B -20000 counts",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
}

#[test]
fn what_a_controller_cannot_do_is_refused() {
    let galil = ControllerKind::Galil;
    let refused =
        |t: &Trajectory, c, settings: &ProgramSettings| write(t, c, settings).unwrap_err();
    let lifted = motion([true, false]);
    assert!(refused(&lifted, galil, &settings()).contains("cannot switch the tool"));
    let on = ProgramSettings { always_on: true, ..settings() };
    assert!(write(&lifted, galil, &on).unwrap().contains("' warning: the tool is on"));
    let text = write(&lifted, ControllerKind::Gcode, &settings()).unwrap();
    // G4 is no motion, so M63 would wait beyond it.
    assert!(text.contains("\nM65 P0\nG4 P2.99"), "{text}");

    let line = |c: Vec<[[f64; 4]; 2]>, step: f64| {
        let n = c.len();
        let times = (0..=n).map(|k| k as f64 * step).collect();
        Trajectory::new(times, c, vec![true; n], vec![Some(0); n]).unwrap()
    };
    let at = |x: f64, v: f64| [[x, v, 0.0, 0.0], [0.0; 4]];
    let gcode = ControllerKind::Gcode;
    let moving = line(vec![at(0.0, 1.0)], 1.0);
    let step = line(vec![at(0.0, 0.0), at(0.0, 1.0)], 1.0);
    let jump = line(vec![at(0.0, 0.0), at(0.5, 0.0)], 1.0);
    for controller in [galil, gcode, ControllerKind::Csv] {
        let said = refused(&moving, controller, &settings());
        assert!(
            said.contains("segment[0]: begins with a step of 1.000000 mm/s in the velocity of x")
        );
        assert!(
            refused(&step, controller, &settings())
                .contains("segment[1]: begins with a step of 1.0")
        );
        let said = refused(&jump, controller, &settings());
        assert!(
            said.contains("segment[1]: begins with a step of 0.500000 mm in the position"),
            "{said}"
        );
    }
    // 50 mm/s of 1e-6 mm are 50 000 000 counts/s.
    let fine = ProgramSettings { counts: Counts::linear(1e-6), ..settings() };
    let rest = [[0.0, 0.0, 50.0, 0.0], [0.0; 4]];
    let stop = [[50.0, 100.0, -50.0, 0.0], [0.0; 4]];
    let fast = line(vec![rest, stop], 1.0);
    assert!(refused(&fast, galil, &fine).contains("beyond 44000000 counts"));
    let over =
        line(vec![[[0.0, 0.0, 75.0, 0.0], [0.0; 4]], [[75.0, 150.0, -75.0, 0.0], [0.0; 4]]], 1.0);
    assert!(refused(&over, gcode, &settings()).contains("x velocity reaches 150.000000 mm/s"));
    let zero = ProgramSettings { counts: Counts::linear(0.0), ..settings() };
    assert!(refused(&motion([true; 2]), gcode, &zero).contains("count_mm: is 0"));
    // 1e-10 mm would be written as G64 P0: any deviation.
    let gcode = gcode::GcodeSettings { path_tolerance_mm: Some(1e-10), ..Default::default() };
    let tight = ProgramSettings { gcode, ..settings() };
    let said = refused(&motion([true; 2]), ControllerKind::Gcode, &tight);
    assert!(said.contains("path_tolerance_mm: is 0.0000000001, and G64 P0"), "{said}");
}

/// Checks what a JointTrajectory cannot hold: an output, a time beyond an int32, and parts of a nanosecond.
#[test]
fn a_joint_trajectory_has_its_own_limits() {
    let ros = ControllerKind::Ros;
    let lifted = motion([true, false]);
    let said = write(&lifted, ros, &settings()).unwrap_err();
    assert!(said.contains("a ros program cannot switch the tool"), "{said}");
    assert!(said.contains("use gcode, csv, or pmac with `tool_output`"), "{said}");
    let stands = [[0.0; 4]; 2];
    // 2^31 s are one more than `sec` holds. The time of a double of that size is exact to 5e-7 s.
    let long =
        |s: f64| Trajectory::new(vec![0.0, s], vec![stands], vec![true], vec![None]).unwrap();
    let said = write(&long(2_147_483_648.0), ros, &settings()).unwrap_err();
    assert!(said.contains("`sec` of the message is an int32"), "{said}");
    let text = write(&long(2_147_483_647.0), ros, &settings()).unwrap();
    assert!(text.contains("{\"sec\": 2147483647, \"nanosec\": 0}"), "{text}");
    let origin = Origin::default();
    let warned = |tick_s: f64| {
        let settings = ProgramSettings { tick_s: Some(tick_s), ..settings() };
        let made = program(&motion([true; 2]), &machine().into(), ros, &settings, &origin).unwrap();
        made.about.warnings.iter().any(|warning| warning.contains("no multiple of a nanosecond"))
    };
    assert!(warned(1.0 / 1024.0) && !warned(1e-3) && !warned(2e-9));
}

#[test]
fn a_long_program_says_how_fast_its_buffer_runs_empty() {
    // To and fro by 1 mm in 0.1 s, 300 times: the acceleration steps between two moves keep them apart.
    let n = 300;
    let there = |k: usize| {
        let (from, d) = if k.is_multiple_of(2) { (0.0, 1.0) } else { (1.0, -1.0) };
        [[from, 0.0, 3.0 * d / 0.01, -2.0 * d / 0.001], [0.0; 4]]
    };
    let times = (0..=n).map(|k| 0.1 * k as f64).collect();
    let motion =
        Trajectory::new(times, (0..n).map(there).collect(), vec![true; n], vec![Some(0); n])
            .unwrap();
    let text = write(&motion, ControllerKind::Galil, &settings()).unwrap();
    assert!(text.contains("' buffer of the controller: 255 segments, which last "), "{text}");
    let before = text.split("\nBTAB").next().unwrap();
    // The line that clears the buffer, then 255 segments.
    assert_eq!(before.matches("PVA=").count(), 1 + 255);
}
