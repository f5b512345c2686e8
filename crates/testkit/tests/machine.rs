//! A plan on machines whose axes are turned, exchanged, turned over and displaced: through the programs, from the path
//! to the program of a controller and back.

use std::{fs, path::Path, process::Output};

use planish_handoff::artifact;
use planish_testkit::program::{text, write};
use planish_types::{ControllerKind, DwellTime, ToolPath, Trajectory};
use serde_json::{Value, json};
use tempfile::TempDir;

/// Runs `planish-<command>` in `dir`; no argument contains a space.
fn run(dir: &Path, command: &str) -> Output {
    let mut words = command.split_whitespace();
    let program = format!("planish-{}", words.next().unwrap());
    planish_testkit::program::stage(&program).args(words).current_dir(dir).output().unwrap()
}

/// Runs, expects the exit code, and returns what it says to the user.
fn expect(dir: &Path, code: i32, command: &str) -> String {
    let output = run(dir, command);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "planish-{command}: {said}");
    said
}

/// A machine of 5 and 3 mm/s, 100 and 60 mm/s^2, with more keys of the file and of its axes.
fn machine(dir: &Path, name: &str, more: Value, of_x: Value, of_y: Value) {
    let axis = |name: &str, factor: f64, more: Value| {
        let mut axis = json!({ "name": name, "max_velocity_mm_per_s": 5.0 * factor,
                               "max_acceleration_mm_per_s2": 100.0 * factor });
        axis.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        axis
    };
    let axes = [axis("x", 1.0, of_x), axis("y", 0.6, of_y)];
    let mut machine = json!({ "name": "bench", "axes": axes });
    machine.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    fs::write(dir.join(format!("{name}.json")), machine.to_string()).unwrap();
}

/// Two lines along x, 3 mm apart, of 10 mm: the first there, the second back.
fn bench() -> TempDir {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let mut points: Vec<[f64; 2]> = (0..=10).map(|k| [f64::from(k), 1.0]).collect();
    points.extend((0..=10).map(|k| [f64::from(10 - k), 4.0]));
    let between = |p: &[[f64; 2]]| [0.5 * (p[0][0] + p[1][0]), 0.5 * (p[0][1] + p[1][1])];
    let dwell_points: Vec<[f64; 2]> = points.windows(2).map(between).collect();
    let n = dwell_points.len();
    let path = ToolPath::new(points, dwell_points, vec![true; n], vec![0; n]).unwrap();
    write(dir, "path", &path);
    let times = (0..n).map(|k| 0.5 + 0.25 * (k as f64).sin()).collect();
    write(dir, "dwell", &DwellTime::new(times).unwrap());

    let none = || json!({});
    machine(dir, "plain", none(), none(), none());
    let origin = json!({ "part_origin_mm": [100.0, -20.0] });
    let quarter = json!({ "part_origin_mm": [100.0, -20.0], "part_rotation_deg": 90.0 });
    machine(dir, "turned", quarter, none(), none());
    machine(dir, "exchanged", origin.clone(), json!({ "along": "-y" }), json!({ "along": "+x" }));
    let third = json!({ "part_origin_mm": [7.0, 3.0], "part_rotation_deg": 30.0 });
    machine(dir, "mirrored", third, json!({ "along": "-x" }), none());
    tmp
}

fn schedule(dir: &Path, machine: &str) {
    let command = format!(
        "schedule pvt --tool-path path --dwell dwell --machine {machine}.json --out {machine}-motion"
    );
    expect(dir, 0, &command);
}

fn motion(dir: &Path, name: &str) -> Trajectory {
    artifact::read(&dir.join(name)).unwrap().value
}

fn json_of(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

/// The verdict, without what names its inputs.
fn verdict(dir: &Path, motion: &str, machine: &str, code: i32) -> Value {
    let command = format!(
        "verify --trajectory {motion} --machine {machine}.json --other-machine --out {motion}-on-{machine} --force"
    );
    expect(dir, code, &command);
    let mut outcome =
        json_of(&dir.join(format!("{motion}-on-{machine}/manifest.json")))["outcome"].clone();
    outcome.as_object_mut().unwrap().remove("part_to_axes");
    // Only the scheduler states it, and not the program that moves a motion.
    outcome.as_object_mut().unwrap().remove("path_distance");
    outcome
}

#[test]
fn a_quarter_turn_and_exchanged_axes_are_one_machine() {
    let tmp = bench();
    let dir = tmp.path();
    schedule(dir, "turned");
    schedule(dir, "exchanged");
    let planned = motion(dir, "turned-motion");
    assert_eq!(planned, motion(dir, "exchanged-motion"));
    let judged = verdict(dir, "turned-motion", "turned", 0);
    assert_eq!(judged, verdict(dir, "turned-motion", "exchanged", 0));
    // The lines along x are driven by the axis y, backwards from -20 + 0 to -20 + 10; y by the axis x from 100 - 1.
    let range = |axis: usize| {
        let check = &judged["axes"][axis]["position_mm"];
        [&check["min"]["value"], &check["max"]["value"]].map(|v| v.as_f64().unwrap())
    };
    assert_eq!((range(0), range(1)), ([96.0, 99.0], [-20.0, -10.0]));
    // A plan for axes as the part has them is too fast for the axis that is slower here.
    schedule(dir, "plain");
    let fast = motion(dir, "plain-motion");
    assert_ne!(fast, planned);
    for controller in ControllerKind::ALL.map(ControllerKind::name) {
        let text = ["turned", "exchanged"].map(|machine| {
            let command = format!(
                "export {controller} --trajectory turned-motion --machine {machine}.json --other-machine --out {machine}.txt --force"
            );
            expect(dir, 0, &command);
            fs::read_to_string(dir.join(format!("{machine}.txt"))).unwrap()
        });
        assert_eq!(text[0], text[1], "{controller}");
        let about = json_of(&dir.join("turned.txt.json"));
        assert_eq!(about["start_mm"], json!([99.0, -20.0]), "{controller}");
        if controller == "csv" {
            assert!(text[0].contains("\n0,99,0,-20,0,1\n"), "{}", text[0]);
            assert!(text[0].contains(
                "# part: its origin where the axes read x 100 mm, y -20 mm, its x axis 90"
            ));
            // The motion turns up to 3 um beyond the end of its last line.
            assert!(text[0].contains("# reach: x from 95.997 to 99 mm"), "{}", text[0]);
        }
    }
}

/// A motion as chords, 64 in every segment: on segments of 0.1 s at 1000 mm/s^2 a chord is 0.3 nm off its curve.
fn chords(motion: &Trajectory) -> Vec<[[f64; 2]; 2]> {
    let of = |k: usize| {
        let s = motion.segment(k);
        let at = move |i: u8| s.position_mm(s.duration_s * f64::from(i) / 64.0);
        (0..64).map(move |i| [at(i), at(i + 1)])
    };
    (0..motion.len()).flat_map(of).collect()
}

/// Distance of `p` from the chord between `a` and `b`, mm.
fn distance_mm(p: [f64; 2], a: [f64; 2], b: [f64; 2]) -> f64 {
    let (d, e) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
    let length2 = d[0] * d[0] + d[1] * d[1];
    let along =
        if length2 > 0.0 { ((d[0] * e[0] + d[1] * e[1]) / length2).clamp(0.0, 1.0) } else { 0.0 };
    (e[0] - along * d[0]).hypot(e[1] - along * d[1])
}

/// Out by the writer, back by the reader, which shares no code with it: the motion of the part.
#[test]
fn what_is_exported_and_read_back_is_the_plan_of_the_part() {
    let tmp = bench();
    let dir = tmp.path();
    for machine in ["plain", "turned", "exchanged", "mirrored"] {
        schedule(dir, machine);
        let planned = motion(dir, &format!("{machine}-motion"));
        for controller in ControllerKind::ALL.map(ControllerKind::name) {
            expect(
                dir,
                0,
                &format!(
                    "export {controller} --trajectory {machine}-motion --machine {machine}.json --out p --force"
                ),
            );
            expect(
                dir,
                0,
                &format!(
                    "import program p --controller {controller} --about p.json --out back --force"
                ),
            );
            let back = artifact::read::<Trajectory>(&dir.join("back")).unwrap();
            assert!(back.manifest.unwrap().frame.starts_with("part coordinates"));
            let back = back.value;
            // The nodes of a program are others than those of the plan; its path is within the 5 um that export allows.
            let chords = chords(&back);
            for k in 0..planned.len() {
                let p = planned.segment(k).position_mm(0.0);
                let apart =
                    chords.iter().map(|[a, b]| distance_mm(p, *a, *b)).fold(f64::MAX, f64::min);
                assert!(apart <= 5e-3, "{machine} {controller} {k}: {p:?} is {apart} mm off");
            }
        }
    }
}

/// The transform of the machine file as an artifact, applied by planish-register: the same program and verdict, and
/// nothing is applied twice.
#[test]
fn the_machine_file_and_planish_register_are_one_mechanism() {
    let tmp = bench();
    let dir = tmp.path();
    schedule(dir, "mirrored");
    expect(dir, 0, "register place --machine mirrored.json --out where");
    expect(dir, 0, "register apply --transform where --trajectory mirrored-motion --out there");
    let [direct, applied] =
        ["mirrored-motion", "there"].map(|motion| verdict(dir, motion, "mirrored", 0));
    assert_eq!(direct, applied);
    for (name, motion) in [("direct", "mirrored-motion"), ("applied", "there")] {
        expect(
            dir,
            0,
            &format!("export galil --trajectory {motion} --machine mirrored.json --out {name}"),
        );
    }
    let commands = |name: &str| {
        let text = fs::read_to_string(dir.join(name)).unwrap();
        text.lines().filter(|l| !l.starts_with("' ")).map(String::from).collect::<Vec<_>>()
    };
    assert_eq!(commands("direct"), commands("applied"));
    expect(dir, 0, "import program applied --controller galil --about applied.json --out back");
    let back = artifact::read::<Trajectory>(&dir.join("back")).unwrap();
    assert!(back.manifest.unwrap().frame.starts_with("machine coordinates"));
    expect(dir, 0, "register apply --inverse --transform where --trajectory there --out again");
    let [planned, again] = ["mirrored-motion", "again"].map(|name| motion(dir, name));
    let [p, q] = [planned, again].map(|t| t.segment(7).position_mm(0.1));
    // Rounding of coordinates of up to 100 mm, there and back.
    assert!((p[0] - q[0]).hypot(p[1] - q[1]) < 1e-13, "{p:?} {q:?}");
}

/// Four marks of a part on axes that mirror it: without the machine they are refused, with it they are found.
#[test]
fn fiducials_on_axes_that_mirror_the_part() {
    let tmp = bench();
    let dir = tmp.path();
    // q_x = -(cos 30 x - sin 30 y) + 7.1, q_y = sin 30 x + cos 30 y + 2.8
    let (s, c) = (0.5, 0.75_f64.sqrt());
    let mut csv = String::from("map_x_mm,map_y_mm,machine_x_mm,machine_y_mm,uncertainty_mm\n");
    for [x, y] in [[0.0, 0.0], [50.0, 0.0], [50.0, 20.0], [0.0, 20.0]] {
        csv += &format!("{x},{y},{},{},0.001\n", -(c * x - s * y) + 7.1, s * x + c * y + 2.8);
    }
    fs::write(dir.join("marks.csv"), csv).unwrap();
    let said = expect(dir, 2, "register fit marks.csv --out where");
    assert!(said.contains("mirrors") && said.contains("give the --machine whose axes"), "{said}");
    expect(dir, 0, "register fit marks.csv --machine mirrored.json --out where");
    schedule(dir, "mirrored");
    expect(dir, 0, "register apply --transform where --trajectory mirrored-motion --out there");
    let [p, q] =
        ["mirrored-motion", "there"].map(|name| motion(dir, name).segment(5).position_mm(0.2));
    let expected = [-(c * p[0] - s * p[1]) + 7.1, s * p[0] + c * p[1] + 2.8];
    // To rounding: the marks are exact.
    assert!((q[0] - expected[0]).hypot(q[1] - expected[1]) < 1e-9, "{q:?} {expected:?}");
    let outcome = json_of(&dir.join("where/manifest.json"))["outcome"]["registration"].clone();
    assert!(outcome["rms_mm"].as_f64().unwrap() < 1e-9, "{outcome}");
}

#[test]
fn travel_is_judged_and_nothing_is_written_beyond_it() {
    let tmp = bench();
    let dir = tmp.path();
    schedule(dir, "turned");
    let quarter = json!({ "part_origin_mm": [100.0, -20.0], "part_rotation_deg": 90.0 });
    // The axis x goes from 96 to 99 mm, y from -20 to -10 mm.
    machine(
        dir,
        "fits",
        quarter.clone(),
        json!({ "travel_mm": [96.0, 99.0] }),
        json!({ "travel_mm": [-20.0, -10.0] }),
    );
    machine(
        dir,
        "short",
        quarter,
        json!({ "travel_mm": [96.0, 99.0] }),
        json!({ "travel_mm": [-30.0, -10.5] }),
    );
    let judged = verdict(dir, "turned-motion", "fits", 0);
    assert_eq!(judged["axes"][0]["travel_mm"], json!([96.0, 99.0]));
    expect(
        dir,
        0,
        "export csv --trajectory turned-motion --machine fits.json --other-machine --out fits.csv",
    );
    let judged = verdict(dir, "turned-motion", "short", 1);
    assert_eq!(judged["axes"][1]["position_mm"]["exceeded"], true);
    let said = judged["violations"][0].as_str().unwrap().to_string();
    assert!(said.starts_with("y position reaches -10.000000 mm in segment"), "{said}");
    assert!(said.contains("0.500000 mm beyond the travel from -30 to -10.5 mm"), "{said}");
    for controller in ControllerKind::ALL.map(ControllerKind::name) {
        let said = expect(
            dir,
            2,
            &format!(
                "export {controller} --trajectory turned-motion --machine short.json --other-machine --out p"
            ),
        );
        assert!(said.contains("y reaches -10.0000 mm, 0.5000 mm beyond its travel"), "{said}");
        assert!(!dir.join("p").exists() && !dir.join("p.json").exists());
    }
    fs::write(
        dir.join("bad.json"),
        fs::read_to_string(dir.join("short.json")).unwrap().replace("-10.5", "-30.5"),
    )
    .unwrap();
    let said = expect(dir, 2, "verify --trajectory turned-motion --machine bad.json --out v");
    assert!(
        said.contains("bad.json: axes[1]: travel_mm is [-30, -30.5]; give the smallest"),
        "{said}"
    );
}
