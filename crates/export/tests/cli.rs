//! Tests of the program `planish-export`: the files that it writes, and that a refusal ends with exit code 2, one
//! message and no file.

use std::{
    fs,
    path::{Path, PathBuf},
};

use ndarray::{Array1, Array3};
use planish_handoff::npy::ArrayData;
use planish_types::ControllerKind;
use serde_json::{Value, json};
use tempfile::TempDir;

/// Directory of a test with a trajectory without a manifest, and a machine file.
pub(crate) struct Bench {
    tmp: TempDir,
}

impl Bench {
    pub(crate) fn new(times: &[f64], coefficients: &[[[f64; 4]; 2]], tool_on: &[u8]) -> Self {
        let tmp = tempfile::tempdir().unwrap();
        let dir = tmp.path().join("t");
        fs::create_dir(&dir).unwrap();
        let put = |name: &str, array: ArrayData| fs::write(dir.join(name), array.to_npy()).unwrap();
        let n = coefficients.len();
        let c = Array3::from_shape_fn((n, 2, 4), |(i, a, o)| coefficients[i][a][o]);
        put("break_time_s.npy", ArrayData::F64(Array1::from(times.to_vec()).into_dyn().into()));
        put("coefficient_mm.npy", ArrayData::F64(c.into_dyn().into()));
        put("dwell_index.npy", ArrayData::I64(Array1::from(vec![0; n]).into_dyn().into()));
        put("tool_on.npy", ArrayData::U8(Array1::from(tool_on.to_vec()).into_dyn().into()));
        let bench = Self { tmp };
        bench.machine("bench");
        bench
    }

    /// Makes a motion from rest at (1, -2) mm by 1 mm along x to rest in 0.1 s, then 3 s of standing. Its largest
    /// velocity is 15 mm/s, its largest acceleration 600 mm/s^2.
    fn simple() -> Self {
        let x = [1.0, 0.0, 300.0, -2000.0];
        let y = [-2.0, 0.0, 0.0, 0.0];
        Self::new(&[5.0, 5.1, 8.1], &[[x, y], [[2.0, 0.0, 0.0, 0.0], y]], &[1, 0])
    }

    fn machine(&self, name: &str) {
        let axis = |axis: &str| json!({ "name": axis, "max_velocity_mm_per_s": 100, "max_acceleration_mm_per_s2": 1000 });
        let machine = json!({ "name": name, "axes": [axis("x"), axis("y")] });
        fs::write(self.path("m.json"), machine.to_string()).unwrap();
    }

    /// Writes a manifest that names the machine file of the motion, as a scheduler writes it.
    fn made_for(&self, machine: &[u8]) {
        let array = |name: &str, dtype: &str, shape: &[usize], axes: &[&str], unit: &str| {
            let file = format!("{name}.npy");
            let hash = blake3::hash(&fs::read(self.path("t").join(&file)).unwrap()).to_hex();
            let record = json!({
                "file": file, "dtype": dtype, "shape": shape, "axes": axes, "unit": unit,
                "blake3": hash.as_str(),
            });
            (name.to_string(), record)
        };
        let arrays: serde_json::Map<String, Value> = [
            array("break_time_s", "<f8", &[3], &["break"], "s"),
            array("coefficient_mm", "<f8", &[2, 2, 4], &["segment", "x|y", "order"], "mm/s^order"),
            array("dwell_index", "<i8", &[2], &["segment"], "1"),
            array("tool_on", "|u1", &[2], &["segment"], "1"),
        ]
        .into_iter()
        .collect();
        let hash = blake3::hash(machine).to_hex();
        let manifest = json!({
            "kind": "trajectory", "version": 1, "tool": "planish-schedule", "tool_version": "0.1.0",
            "method": "pvt", "command": "planish-schedule pvt", "key": "0",
            "frame": "part coordinates; the last axis is [x, y]", "settings": {},
            "inputs": [{ "role": "machine", "path": "m.json", "kind": "file", "blake3": hash.as_str() }],
            "lineage": [{ "kind": "machine", "blake3": hash.as_str() }],
            "outcome": { "status": "done" }, "arrays": arrays,
        });
        fs::write(self.path("t/manifest.json"), manifest.to_string()).unwrap();
    }

    pub(crate) fn path(&self, name: impl AsRef<Path>) -> PathBuf {
        self.tmp.path().join(name)
    }

    fn run(&self, controller: &str, trajectory: &str, more: &[&str]) -> (Option<i32>, String) {
        let base = ["--trajectory", trajectory, "--machine", "m.json", "--out", "p/a.txt"];
        let output = planish_testkit::program::stage("planish-export")
            .current_dir(self.tmp.path())
            .arg(controller)
            .args(base)
            .args(more)
            .output()
            .unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    }

    fn done(&self, controller: &str, trajectory: &str, more: &[&str]) -> (String, Value) {
        let (code, said) = self.run(controller, trajectory, &[more, &["--force"]].concat());
        assert_eq!(code, Some(0), "{controller} {more:?}: {said}");
        let text = fs::read_to_string(self.path("p/a.txt")).unwrap();
        let about = fs::read_to_string(self.path("p/a.txt.json")).unwrap();
        (text, serde_json::from_str(&about).unwrap())
    }

    /// Returns the message with which the export is refused; nothing is written.
    fn refused(&self, controller: &str, more: &[&str]) -> String {
        let (code, said) = self.run(controller, "t", more);
        assert_eq!(code, Some(2), "{controller} {more:?}: {said}");
        // Beside it only what was read is said: the motion here is bare arrays. Settings are refused before it is read.
        let (warnings, errors): (Vec<_>, Vec<_>) =
            said.lines().partition(|line| line.starts_with("warning: "));
        assert!(warnings.len() <= 1 && errors.len() == 1, "{controller} {more:?}: {said}");
        assert!(!said.contains("panicked"), "{said}");
        assert!(!self.path("p").exists(), "{controller} {more:?}");
        said
    }
}

/// Returns a message in which flags have the names of their settings.
fn named(message: &str) -> String {
    message.replace('-', "_")
}

#[test]
fn the_program_and_what_it_is() {
    let bench = Bench::simple();
    let flags = ["--count-mm", "0.001,0.002", "--always-on"];
    let (text, about) = bench.done("pmac", "t", &flags);
    assert!(text.contains("; made from: trajectory t, BLAKE3 "), "{text}");
    assert_eq!(about["start_mm"], json!([1.0, -2.0]));
    assert_eq!(about["count_mm"], json!([0.001, 0.002]));
    assert_eq!(about["feedrate_time_unit_s"], 1.0);
    assert_eq!(about["program_blake3"], blake3::hash(text.as_bytes()).to_hex().as_str());
    let largest = about["limits"]["largest"].as_array().unwrap();
    let acceleration = largest.iter().find(|p| p["quantity"] == "x acceleration").unwrap();
    assert!((acceleration["value"].as_f64().unwrap() - 600.0).abs() < 1e-6, "{acceleration}");
    assert_eq!(acceleration["limit"], 1000.0);

    let (code, said) = bench.run("pmac", "t", &flags);
    assert!(code == Some(2) && said.contains("give --force"), "{said}");
    let (code, said) = bench.run("pmac", "t", &["--always-on", "--force", "--count-mm", "-1"]);
    assert!(code == Some(2) && said.contains("count-mm: is -1"), "{said}");
    assert_eq!(fs::read_to_string(bench.path("p/a.txt")).unwrap(), text);
}

#[test]
fn the_tool_is_off_before_and_after_the_program() {
    let bench = Bench::simple();
    let (text, _) = bench.done("gcode", "t", &[]);
    let body: Vec<&str> = text.lines().filter(|l| !l.starts_with('(')).collect();
    assert_eq!(body[0], "M65 P0");
    // Half of the last line takes some of the 3 s.
    assert!(text.contains("\nM62 P0\nG1 X") && text.contains("\nM65 P0\nG4 P2.99"), "{text}");
    assert!(text.ends_with("\nM65 P0\nG94 F60\nM2\n"), "{text}");
    let (text, _) = bench.done("pmac", "t", &["--tool-output", "7"]);
    assert!(
        text.contains(
            "\nM7=0\nABS\nRAPID\nX1 Y-2\nDWELL0\nM7==1\nPVT100\nX2:0 Y-2:0\nM7==0\nPVT3000\n"
        ),
        "{text}"
    );
    assert!(text.ends_with("M7==0\nDWELL0\n"), "{text}");
    let (text, _) = bench.done("csv", "t", &[]);
    assert!(text.ends_with("\n3.1,2,0,-2,0,0\n"), "{text}");
}

#[test]
fn a_limit_within_a_segment_is_refused() {
    // 10 mm in 0.125 s: v = 120 in the middle, a = 3840, rest at both ends.
    let x = [0.0, 0.0, 30.0 / 0.125f64.powi(2), -20.0 / 0.125f64.powi(3)];
    let bench = Bench::new(&[0.0, 0.125], &[[x, [0.0; 4]]], &[1]);
    for controller in ControllerKind::ALL.map(ControllerKind::name) {
        let said = bench.refused(controller, &[]);
        assert!(said.contains("segment[0]: x acceleration reaches 3840.000000 mm/s^2"), "{said}");
        assert!(
            said.contains(
                "the limit is 1000 mm/s^2 (machine \"bench\"); schedule for this machine"
            )
        );
    }
    // Constant velocity from nothing, as average-velocity has it.
    let bench = Bench::new(&[0.0, 1.0], &[[[0.0, 1.0, 0.0, 0.0], [0.0; 4]]], &[1]);
    for controller in ControllerKind::ALL.map(ControllerKind::name) {
        let said = bench.refused(controller, &[]);
        assert!(
            said.contains("segment[0]: begins with a step of 1.000000 mm/s in the velocity"),
            "{said}"
        );
    }
}

#[test]
fn absurd_numbers_are_one_message() {
    let bench = Bench::simple();
    for value in ["0", "-1", "NaN", "inf", "1e300", "1e-300", "1e-9"] {
        for (controller, flag) in [
            ("galil", "--sample-s"),
            ("galil", "--count-mm"),
            ("galil", "--max-step-s"),
            ("xps", "--tick-s"),
            ("xps", "--max-step-s"),
            ("pmac", "--tick-s"),
            ("pmac", "--feedrate-time-unit-s"),
            ("gcode", "--tick-s"),
            ("gcode", "--count-mm"),
            ("gcode", "--max-step-s"),
            ("csv", "--tick-s"),
            ("csv", "--count-mm"),
            ("csv", "--max-step-s"),
            ("ros", "--tick-s"),
            ("ros", "--count-mm"),
            ("ros", "--max-step-s"),
            ("aerotech", "--tick-s"),
            ("aerotech", "--count-mm"),
            ("automation1", "--tick-s"),
            ("sinumerik", "--tick-s"),
            ("sinumerik-poly", "--tick-s"),
            ("sinumerik-poly", "--count-mm"),
            ("twincat", "--count-mm"),
            ("xps-pt", "--tick-s"),
            ("zaber", "--tick-s"),
            ("zaber", "--count-mm"),
        ] {
            // 1e-9 is a nanosecond or a picometre, which a text with nine decimals holds; a step of 1e300 s is
            // longer than any segment.
            let fine = match flag {
                "--max-step-s" => value == "1e300",
                "--tick-s" => value == "1e-9" && !["pmac", "sinumerik-poly"].contains(&controller),
                "--count-mm" => value == "1e-9" && controller != "galil",
                _ => false,
            };
            if fine {
                bench.done(controller, "t", &["--always-on", flag, value]);
                fs::remove_dir_all(bench.path("p")).unwrap();
                continue;
            }
            let said = bench.refused(controller, &["--always-on", flag, value]);
            assert!(
                said.contains(';') || said.contains("try"),
                "{controller} {flag} {value}: {said}"
            );
        }
    }
    let said = bench.refused("galil", &["--always-on", "--sample-s", "1e-9"]);
    let expected = "sample-s: is 0.000000001, and PVT mode with 2 axes has samples from TM 62.5";
    assert!(said.contains(expected), "{said}");
    // The fast firmware has samples of TM 31.25 and no PVT mode.
    assert!(bench.refused("galil", &["--always-on", "--sample-s", "3.125e-5"]).contains("TM 62.5"));
    for sample in ["6.103515625e-5", "6.25e-5"] {
        bench.done("galil", "t", &["--always-on", "--sample-s", sample]);
        fs::remove_dir_all(bench.path("p")).unwrap();
    }
    let (_, about) = bench.done("pmac", "t", &["--always-on", "--tick-s", "3e-7"]);
    let warnings = about["warnings"].to_string();
    assert!(warnings.contains("no multiple of 0.00000025 s"), "{warnings}");
    fs::remove_dir_all(bench.path("p")).unwrap();
    let said = bench.refused("csv", &["--max-step-s", "1e-9"]);
    assert!(named(&said).contains("max_step_s: is shorter than one tick of 0.000001 s"), "{said}");
    let said = bench.refused("csv", &["--max-step-s", "1e-9", "--tick-s", "1e-9"]);
    assert!(
        named(&said).contains("min_segment_s: is 0.000001 s, the longest segment 0.000000001 s"),
        "{said}"
    );
    for value in ["0", "-1", "NaN", "inf", "1e-300"] {
        let said = bench.refused("csv", &["--path-deviation-mm", value]);
        let said = named(&said);
        assert!(said.contains("path_deviation_mm") || said.contains("count_mm"), "{said}");
    }
    for value in ["-1", "NaN", "inf", "1e-10"] {
        let said = named(&bench.refused("gcode", &["--path-tolerance-mm", value]));
        assert!(said.contains("path_tolerance_mm: is"), "{said}");
    }
    assert!(
        bench.refused("pmac", &["--tool-output", "8192"]).contains("the last M-variable is M8191")
    );
}

/// Checks that a plan that was made with another machine file is refused, since its positions would go to other axes.
#[test]
fn a_plan_for_another_machine_is_refused() {
    let bench = Bench::simple();
    let (_, about) = bench.done("csv", "t", &[]);
    assert_eq!(about["segments"], 2);
    bench.made_for(&fs::read(bench.path("m.json")).unwrap());
    bench.done("csv", "t", &[]);
    bench.machine("another");
    let (code, said) = bench.run("csv", "t", &["--force"]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("was made for another machine file") && said.contains("--other-machine"));
    let (code, said) = bench.run("csv", "t", &["--force", "--other-machine"]);
    assert!(code == Some(0) && said.contains("warning: t: was made for another machine"), "{said}");
}

/// Checks that names of the user cannot end a comment or begin a command in a program, and that no line is too long.
#[test]
fn names_and_paths_stay_within_a_comment() {
    let bench = Bench::simple();
    bench.machine("a) M64 P0\nG0 X9\r\x1b[31m;PVA=9,9,9` ß (MSG, b) %");
    let long = format!("t) ; x\n{}", "d".repeat(200));
    fs::rename(bench.path("t"), bench.path(&long)).unwrap();
    for (controller, open, close, most) in [
        ("galil", "' ", "", 80),
        ("pmac", "; ", "", 80),
        ("gcode", "(", ")", 252),
        ("csv", "# ", "", 120),
        ("aerotech", "' ", "", 80),
        ("automation1", "// ", "", 120),
        ("sinumerik", "; ", "", 120),
        ("sinumerik-poly", "; ", "", 120),
        ("twincat", "# ", "", 120),
    ] {
        let (text, about) = bench.done(controller, &long, &["--always-on"]);
        assert!(about["machine"].as_str().unwrap().contains('\u{1b}'));
        let mut inside = 0;
        for line in text.split('\n') {
            assert!(
                line.len() <= most && line.chars().all(|c| (' '..='~').contains(&c)),
                "{line:?}"
            );
            if let Some(comment) = line.strip_prefix(open).and_then(|l| l.strip_suffix(close)) {
                assert!(!comment.contains(['(', ')', ';', '`']), "{line}");
                inside += comment.matches('d').count();
            } else {
                assert!(!line.contains("X9") && !line.contains("9,9"), "{line}");
            }
        }
        assert!(inside >= 200, "the path is there: {text}");
        fs::remove_dir_all(bench.path("p")).unwrap();
    }
}

/// Checks the programs of a machine that turns its part, for a motion of its axes r and c: 1 mm and 90 degrees in 2 s,
/// from rest to rest.
#[test]
fn a_motion_of_all_axes_has_its_own_flag() {
    let bench = Bench::simple();
    let machine = json!({
        "name": "turning",
        "axes": [{ "name": "r", "max_velocity_mm_per_s": 10, "max_acceleration_mm_per_s2": 100, "travel_mm": [0, 50] }],
        "rotary_axes": [{ "name": "c", "max_velocity_deg_per_s": 100, "max_acceleration_deg_per_s2": 500 }],
        "kinematics": { "kind": "spindle",
            "contact": { "max_velocity_mm_per_s": 10, "max_acceleration_mm_per_s2": 100 } },
        "controller": { "kind": "csv", "count_mm": [0.001], "count_deg": [0.002] },
    });
    fs::write(bench.path("m.json"), machine.to_string()).unwrap();
    let put = |name: &str, array: ArrayData| {
        fs::create_dir_all(bench.path("axes")).unwrap();
        fs::write(bench.path("axes").join(name), array.to_npy()).unwrap();
    };
    // p + d (3 u^2 / T^2 - 2 u^3 / T^3) with T = 2 s
    let from_rest = |p: f64, d: f64| [p, 0.0, 0.75 * d, -0.25 * d];
    let cubics = [from_rest(5.0, 1.0), from_rest(0.0, 90.0)];
    let c = Array3::from_shape_fn((1, 2, 4), |(_, a, o)| cubics[a][o]);
    put("break_time_s.npy", ArrayData::F64(Array1::from(vec![0.0, 2.0]).into_dyn().into()));
    put("coefficient_mm_or_deg.npy", ArrayData::F64(c.into_dyn().into()));
    put("dwell_index.npy", ArrayData::I64(Array1::from(vec![0]).into_dyn().into()));
    put("tool_on.npy", ArrayData::U8(Array1::from(vec![1]).into_dyn().into()));

    let run = |arguments: &[&str]| {
        let output = planish_testkit::program::stage("planish-export")
            .current_dir(bench.path(""))
            .args(["csv", "--machine", "m.json", "--out", "p/a.csv", "--force"])
            .args(arguments)
            .output()
            .unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    for (arguments, expected) in [
        (
            &["--trajectory", "t"][..],
            "has the axes r, c, and --trajectory moves x and y; give --axes",
        ),
        (&["--trajectory", "t", "--axes", "axes"], "cannot be used with"),
        (&[], "--trajectory <DIR>"),
        (&["--trajectory", "t", "--form", "f.json"], "cannot be used with"),
        (
            &["--axes", "axes", "--count-mm", "1e-4,1e-4"],
            "count-mm: has 2 numbers; give one for each of the axes r",
        ),
    ] {
        let (code, said) = run(arguments);
        assert!(code == Some(2) && said.contains(expected), "{arguments:?}: {said}");
        assert!(!bench.path("p").exists(), "{arguments:?}");
    }
    let (code, said) = run(&["--axes", "axes"]);
    assert_eq!(code, Some(0), "{said}");
    let about: Value =
        serde_json::from_slice(&fs::read(bench.path("p/a.csv.json")).unwrap()).unwrap();
    assert_eq!(about.get("start_mm"), None);
    let axis = |i: usize| {
        [&about["axes"][i]["name"], &about["axes"][i]["unit"], &about["axes"][i]["count"]]
    };
    assert_eq!(axis(0), [&json!("r"), &json!("mm"), &json!(0.001)]);
    assert_eq!(axis(1), [&json!("c"), &json!("deg"), &json!(0.002)]);
    let reach = [0, 1].map(|side| about["axes"][1]["reach"][side].as_f64().unwrap());
    // Rounding of the cubic at its end.
    assert!(reach[0].abs() < 1e-9 && (reach[1] - 90.0).abs() < 1e-9, "{reach:?}");
    let text = fs::read_to_string(bench.path("p/a.csv")).unwrap();
    assert!(
        text.contains("\nt_s,r_mm,vr_mm_per_s,c_deg,vc_deg_per_s,tool_on\n0,5,0,0,0,1\n"),
        "{text}"
    );
    assert!(text.contains("# kinematics: spindle, axes r in mm, c in deg"), "{text}");
}

/// Runs `planish-import program` in the directory of the bench; returns its exit code and messages.
fn read_back(bench: &Bench, arguments: &[&str]) -> (Option<i32>, String) {
    let output = planish_testkit::program::stage("planish-import")
        .current_dir(bench.tmp.path())
        .arg("program")
        .args(arguments)
        .args(["--out", "back", "--force"])
        .output()
        .unwrap();
    let said = [output.stdout, output.stderr].map(|s| String::from_utf8_lossy(&s).into_owned());
    (output.status.code(), said.concat())
}

#[test]
fn a_dry_run_has_its_name() {
    let bench = Bench::simple();
    let said = bench.refused("csv", &["--dry-run"]);
    assert!(
        said.contains("p/a.txt: is the name of a dry run; give one with \"dry-run\" in it"),
        "{said}"
    );
    let output = planish_testkit::program::stage("planish-export")
        .current_dir(bench.tmp.path())
        .args(["csv", "--trajectory", "t", "--machine", "m.json", "--out", "p/dry-run.csv"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2));
    assert!(said.contains("names a dry run, and the tool of this program goes on"), "{said}");
    assert!(!bench.path("p").exists());
}

#[test]
fn parts_are_read_in_their_order_only() {
    let bench = Bench::simple();
    let step = ["--max-step-s", "0.1"];
    let (code, said) = bench.run("csv", "t", &[&step[..], &["--parts", "3"]].concat());
    assert_eq!(code, Some(0), "{said}");
    let parts = [1, 2, 3].map(|k| format!("p/a.part-{k}-of-3.txt"));
    let [a, b, c] = parts.each_ref().map(String::as_str);
    let (code, said) = read_back(&bench, &[a, b, c, "--controller", "csv"]);
    assert_eq!(code, Some(0), "{said}");
    let (whole, _) = bench.done("csv", "t", &step);
    let (_, of_whole) = read_back(&bench, &["p/a.txt", "--controller", "csv"]);
    assert_eq!(said, of_whole);
    for (files, expected) in [
        (
            vec![a, c, b],
            "p/a.part-3-of-3.txt: part[2]: is part 3 of 3, and stands as number 2 of 3",
        ),
        (vec![a, b], "p/a.part-1-of-3.txt: part[1]: is part 1 of 3, and stands as number 1 of 2"),
        (vec![b], "is part 2 of 3; give all parts"),
    ] {
        let (code, said) = read_back(&bench, &[&files[..], &["--controller", "csv"]].concat());
        assert!(code == Some(2) && said.contains(expected), "{said}");
    }
    // As many parts as the lines need.
    let lines = whole.lines().count();
    let (code, said) =
        bench.run("csv", "t", &[&step[..], &["--max-lines", &(lines - 5).to_string()]].concat());
    assert!(code == Some(0), "{said}");
    assert!(
        bench.path("p/a.part-2-of-2.txt").exists()
            && bench.path("p/a.part-2-of-2.txt.json").exists()
    );
    let (code, said) = bench.run("csv", "t", &[&step[..], &["--max-lines", "3"]].concat());
    assert!(code == Some(2) && said.contains("the head of a part alone may have more"), "{said}");
    let (code, said) = bench.run("csv", "t", &["--parts", "0"]);
    assert!(code == Some(2) && said.contains("--parts: is 0; give a number from 1 to"), "{said}");
}

#[test]
fn the_rest_begins_at_a_mark() {
    let bench = Bench::simple();
    let (_, whole) = bench.done("pmac", "t", &["--tool-output", "1", "--max-step-s", "0.02"]);
    let flags = ["--tool-output", "1", "--max-step-s", "0.02", "--from-mark", "2"];
    let (text, about) = bench.done("pmac", "t", &flags);
    assert!(text.contains("; from mark 2 to mark "), "{text}");
    assert_eq!(about["excerpt"]["whole_blake3"], whole["program_blake3"]);
    let line = about["excerpt"]["from_line"].as_u64().unwrap();
    assert!(whole["marks"][2].as_str().unwrap().starts_with(&format!("{line} ")));
    let (code, said) =
        read_back(&bench, &["p/a.txt", "--controller", "pmac", "--about", "p/a.txt.json"]);
    assert_eq!(code, Some(0), "{said}");
    let (code, said) = bench.run("pmac", "t", &["--from-mark", "9999", "--always-on", "--force"]);
    assert!(code == Some(2) && said.contains("the program has the marks 0 to"), "{said}");
}

#[test]
fn lines_of_the_machine_file_that_move_are_refused() {
    let bench = Bench::simple();
    let with = |controller: Value| {
        let axis = |axis: &str| json!({ "name": axis, "max_velocity_mm_per_s": 100, "max_acceleration_mm_per_s2": 1000 });
        let machine =
            json!({ "name": "bench", "axes": [axis("x"), axis("y")], "controller": controller });
        fs::write(bench.path("m.json"), machine.to_string()).unwrap();
    };
    for (controller, expected) in [
        (
            json!({ "kind": "gcode", "prologue": ["M3 S500", "G0 X5"] }),
            "controller.prologue[1]: is \"G0 X5\"",
        ),
        (
            json!({ "kind": "gcode", "epilogue": ["M64 P0"] }),
            "controller.epilogue[0]: is \"M64 P0\"",
        ),
        (
            json!({ "kind": "pmac", "prologue": ["M1=1"] }),
            "tool-output: is M1, and the machine file states",
        ),
        (json!({ "kind": "csv", "prologue": ["M3"] }), "a csv file has no place for a command"),
    ] {
        let kind = controller["kind"].as_str().unwrap().to_string();
        with(controller);
        let more: &[&str] = if kind == "pmac" { &["--tool-output", "1"] } else { &[] };
        let said = bench.refused(&kind, more);
        assert!(said.contains(expected), "{kind}: {said}");
    }
    with(
        json!({ "kind": "xps", "tool_on": ["GPIODigitalSet(GPIO1.DO,1,1)"], "tool_off": ["GPIODigitalSet(GPIO1.DO,1,0)"],
                 "prologue": ["GPIODigitalSet(GPIO1.DO,2,2)"] }),
    );
    let flags = ["--always-on", "--commands", "calls.txt", "--group", "XY", "--positioners", "X,Y"];
    let (_, about) = bench.done("xps", "t", &flags);
    let calls = fs::read_to_string(bench.path("calls.txt")).unwrap();
    let calls: Vec<&str> = calls.lines().filter(|line| !line.starts_with('#')).collect();
    let answers = "char *,double *,double *,double *,double *";
    let expected = [
        "GPIODigitalSet(GPIO1.DO,1,0)".to_string(),
        "GPIODigitalSet(GPIO1.DO,2,2)".into(),
        "GroupMoveAbsolute(XY,1,-2)".into(),
        "MultipleAxesPVTVerification(XY,a.txt)".into(),
        format!("MultipleAxesPVTVerificationResultGet(XY.X,{answers})"),
        format!("MultipleAxesPVTVerificationResultGet(XY.Y,{answers})"),
        "GPIODigitalSet(GPIO1.DO,1,1)".into(),
        "MultipleAxesPVTExecution(XY,a.txt,1)".into(),
        "GPIODigitalSet(GPIO1.DO,1,0)".into(),
    ];
    assert_eq!(calls, expected);
    assert_eq!(about["prologue"], json!(["GPIODigitalSet(GPIO1.DO,2,2)"]));
    let (code, said) =
        bench.run("xps", "t", &["--always-on", "--commands", "c.txt", "--group", "X;Y", "--force"]);
    assert!(code == Some(2) && said.contains("has the name \"X;Y\""), "{said}");
}

#[test]
fn a_pmac_program_opens_its_buffer() {
    let bench = Bench::simple();
    for (flags, first, last) in [
        (
            ["--open-program", "12"],
            "CLOSE\nOPEN PROG 12 CLEAR\nM1=0\nABS\n",
            "M1==0\nDWELL0\nCLOSE\n",
        ),
        (["--rotary", "2"], "CLOSE\n&2\nOPEN ROT\nM1=0\nABS\n", "M1==0\nDWELL0\nCLOSE\n"),
    ] {
        let (text, _) = bench.done("pmac", "t", &[&flags[..], &["--tool-output", "1"]].concat());
        let body =
            text.lines().skip_while(|line| line.starts_with(';')).collect::<Vec<_>>().join("\n")
                + "\n";
        assert!(body.starts_with(first) && body.ends_with(last), "{body}");
        let (code, said) =
            read_back(&bench, &["p/a.txt", "--controller", "pmac", "--about", "p/a.txt.json"]);
        assert_eq!(code, Some(0), "{said}");
    }
    let said = Bench::simple().refused("pmac", &["--rotary", "17", "--always-on"]);
    assert!(said.contains("rotary: is 17; give a number from 1 to 16"), "{said}");
}
