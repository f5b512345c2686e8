//! The programs of a motion, line by line, and the binary. That they run as planned is shown where
//! both sides are seen: `crates/testkit/tests/programs.rs` reads them back with the reader of
//! `planish-import`.

use std::{fs, path::Path, process::Command};

use planish_export::{Common, Controller, Origin, csv, galil, gcode, pmac, program, xps};
use planish_types::{AxisLimits, Limits, Trajectory};

fn machine(min_segment_s: f64) -> Limits {
    let axis = |name: &str| AxisLimits {
        name: name.into(),
        max_velocity_mm_per_s: 100.0,
        max_acceleration_mm_per_s2: 1000.0,
        max_jerk_mm_per_s3: None,
    };
    Limits { name: "bench (1)".into(), axes: vec![axis("x"), axis("y")], min_segment_s }
}

/// From rest at (1, -2) by 1.00004 mm along x to rest in 0.1 s, then 3 s of standing.
fn motion(tool_on: [bool; 2]) -> Trajectory {
    let d = 1.00004;
    // 3 d u^2 / T^2 - 2 d u^3 / T^3
    let x = [1.0, 0.0, 3.0 * d / 0.01, -2.0 * d / 0.001];
    let end = [1.0 + d, 0.0, 0.0, 0.0];
    let y = [-2.0, 0.0, 0.0, 0.0];
    let times = vec![5.0, 5.1, 8.1];
    Trajectory::new(times, vec![[x, y], [end, y]], tool_on.to_vec(), vec![0, 1]).unwrap()
}

fn write(
    trajectory: &Trajectory,
    controller: &Controller,
    common: &Common,
) -> Result<String, String> {
    let origin = Origin { made_from: "a test".into(), made_by: "hand".into() };
    program(trajectory, &machine(0.0), controller, common, &origin)
        .map(|p| p.text)
        .map_err(|e| e.to_string())
}

fn common() -> Common {
    Common { count_mm: [1e-4; 2], max_step_s: None, always_on: false }
}

#[test]
fn the_text_of_every_controller() {
    let motion = motion([true; 2]);
    let body = |controller| {
        let text = write(&motion, &controller, &common()).unwrap();
        let comment = |l: &&str| !["' ", "; ", "# ", "("].iter().any(|c| l.starts_with(c));
        text.lines().filter(comment).collect::<Vec<_>>().join("\n")
    };
    // 10000.4 counts; 3 s are more than 2048 samples less one tick: two parts.
    let expected = "PVA=0,0,-1\nPVB=0,0,-1\nPVA=10000,0,100\nPVB=0,0,100\nPVA=0,0,1500\nPVB=0,0,1500\n\
                    PVA=0,0,1500\nPVB=0,0,1500\nBTAB\nPVA=0,0,0\nPVB=0,0,0";
    assert_eq!(body(Controller::Galil(galil::Settings::default())), expected);
    let expected = "0.1, 1, 0, 0, 0\n3, 0, 0, 0, 0";
    assert_eq!(body(Controller::Xps(xps::Settings::default())), expected);
    let expected = "ABS\nPVT100\nX2:0 Y-2:0\nPVT3000\nX2:0 Y-2:0";
    assert_eq!(body(Controller::Pmac(pmac::Settings::default())), expected);
    let expected = "G21 G90 G17 G40 G49 G94\nG64 P0.001 Q0\nG0 X1 Y-2\nG93\nM62 P0\nG1 X2 Y-2 F600\n\
                    G4 P3\nM63 P0\nG94 F60\nM2";
    assert_eq!(body(Controller::Gcode(gcode::Settings::default())), expected);
    let settings = gcode::Settings { feed: gcode::Feed::PerMinute, ..gcode::Settings::default() };
    assert!(body(Controller::Gcode(settings)).contains("\nG94\nM62 P0\nG1 X2 Y-2 F600\nG4 P3\n"));
    let expected = "t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on\n0,1,0,-2,0,1\n0.1,2,0,-2,0,1\n\
                    3.1,2,0,-2,0,1";
    assert_eq!(body(Controller::Csv(csv::Settings::default())), expected);
}

#[test]
fn the_header_says_what_it_is() {
    let text =
        write(&motion([true; 2]), &Controller::Galil(Default::default()), &common()).unwrap();
    for part in [
        "' galil for bench _1_, written by hand",
        "' made from: a test",
        "' units: A = x in counts of 0.0001 mm",
        "TM 1000",
        "' start: x 1 mm, y -2 mm",
        "' 3 segments, total time 3.1 s",
        "' start: A 10000, B -20000 counts",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
}

#[test]
fn what_a_controller_cannot_do_is_refused() {
    let galil = Controller::Galil(galil::Settings::default());
    let refused =
        |t: &Trajectory, c: &Controller, common: &Common| write(t, c, common).unwrap_err();
    let lifted = motion([true, false]);
    assert!(refused(&lifted, &galil, &common()).contains("cannot switch the tool"));
    let on = Common { always_on: true, ..common() };
    assert!(write(&lifted, &galil, &on).unwrap().contains("' warning: the tool is on"));
    let text = write(&lifted, &Controller::Gcode(Default::default()), &common()).unwrap();
    assert!(text.contains("M63 P0\nG4 P3\n"));

    let line = |c: Vec<[[f64; 4]; 2]>, step: f64| {
        let n = c.len();
        let times = (0..=n).map(|k| k as f64 * step).collect();
        Trajectory::new(times, c, vec![true; n], vec![0; n]).unwrap()
    };
    let at = |x: f64, v: f64| [[x, v, 0.0, 0.0], [0.0; 4]];
    let moving = line(vec![at(0.0, 1.0)], 1.0);
    assert!(refused(&moving, &galil, &common()).contains("starts with the velocity [1.0, 0.0]"));
    let step = line(vec![at(0.0, 0.0), at(0.0, 1.0)], 1.0);
    assert!(
        refused(&step, &galil, &common()).contains("segment[1]: begins with a step in velocity")
    );
    assert!(write(&step, &Controller::Gcode(Default::default()), &common()).is_ok());
    let jump = line(vec![at(0.0, 0.0), at(0.5, 0.0)], 1.0);
    let gcode = Controller::Gcode(Default::default());
    assert!(refused(&jump, &gcode, &common()).contains("segment[1]: begins 0.5 mm from"));
    let short = line(vec![at(0.0, 0.0)], 0.0004);
    assert!(refused(&short, &galil, &common()).contains("0 ticks of 0.002 s"));
    // 50 mm/s of 1e-6 mm are 50 000 000 counts/s.
    let fine = Common { count_mm: [1e-6; 2], ..common() };
    let rest = [[0.0, 0.0, 50.0, 0.0], [0.0; 4]];
    let stop = [[50.0, 100.0, -50.0, 0.0], [0.0; 4]];
    let fast = line(vec![rest, stop], 1.0);
    assert!(refused(&fast, &galil, &fine).contains("beyond 44000000 counts"));
    let over =
        line(vec![[[0.0, 0.0, 75.0, 0.0], [0.0; 4]], [[75.0, 150.0, -75.0, 0.0], [0.0; 4]]], 1.0);
    assert!(refused(&over, &gcode, &common()).contains("150 mm/s along x, the machine does 100"));
    let zero = Common { count_mm: [0.0; 2], ..common() };
    assert!(refused(&over, &gcode, &zero).contains("count_mm: is 0"));
    let origin = Origin { made_from: "a test".into(), made_by: "hand".into() };
    let slow = program(&motion([true; 2]), &machine(0.2), &gcode, &common(), &origin).unwrap_err();
    let slow = slow.to_string();
    assert!(slow.contains("segment[0]: lasts") && slow.contains("wants 0.2 s"), "{slow}");
}

#[test]
fn a_long_program_says_how_fast_its_buffer_runs_empty() {
    let n = 600;
    let c = vec![[[0.0; 4]; 2]; n];
    let times = (0..=n).map(|k| 0.01 * k as f64).collect();
    let still = Trajectory::new(times, c, vec![true; n], vec![0; n]).unwrap();
    let text = write(&still, &Controller::Galil(Default::default()), &common()).unwrap();
    assert!(text.contains("' buffer: 255 segments, which last 2.55 s at least"), "{text}");
    let before = text.split("BTAB").next().unwrap();
    // The line that clears the buffer, then 255 segments.
    assert_eq!(before.matches("PVA=").count(), 1 + 255);
}

fn run(dir: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_planish-export"))
        .current_dir(dir)
        .args(arguments)
        .output()
        .unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn the_binary_writes_the_program_and_what_it_is() {
    use ndarray::{Array1, Array3};
    use planish_handoff::npy::ArrayData;
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path().join("t");
    fs::create_dir(&dir).unwrap();
    let put = |name: &str, array: ArrayData| fs::write(dir.join(name), array.to_npy()).unwrap();
    let m = motion([true; 2]);
    let c = Array3::from_shape_fn((2, 2, 4), |(i, a, o)| m.coefficient_mm()[i][a][o]);
    put("break_time_s.npy", ArrayData::F64(Array1::from(m.break_time_s().to_vec()).into_dyn()));
    put("coefficient_mm.npy", ArrayData::F64(c.into_dyn()));
    put("dwell_index.npy", ArrayData::I64(Array1::from(vec![0, 1]).into_dyn()));
    let machine = serde_json::to_string(&machine(0.0)).unwrap();
    fs::write(tmp.path().join("m.json"), machine).unwrap();
    let base = ["--trajectory", "t", "--machine", "m.json", "--out", "p/a.pmc"];
    let with = |more: &[&'static str]| [&["pmac"], &base[..], more].concat();

    let (code, said) = run(tmp.path(), &with(&["--count-mm", "0.001,0.01"]));
    assert_eq!(code, Some(0), "{said}");
    let text = fs::read_to_string(tmp.path().join("p/a.pmc")).unwrap();
    assert!(text.contains("; made from: trajectory t, BLAKE3 "), "{text}");
    let about = fs::read_to_string(tmp.path().join("p/a.pmc.json")).unwrap();
    let about: serde_json::Value = serde_json::from_str(&about).unwrap();
    assert_eq!(about["start_mm"], serde_json::json!([1.0, -2.0]));
    assert_eq!(about["count_mm"], serde_json::json!([0.001, 0.01]));
    assert_eq!(about["feedrate_time_unit_s"], 1.0);

    let (code, said) = run(tmp.path(), &with(&[]));
    assert!(code == Some(2) && said.contains("give --force"), "{said}");
    let (code, said) = run(tmp.path(), &with(&["--force", "--count-mm", "-1"]));
    assert!(code == Some(2) && said.contains("count_mm: is -1"), "{said}");
    assert_eq!(fs::read_to_string(tmp.path().join("p/a.pmc")).unwrap(), text);
}
