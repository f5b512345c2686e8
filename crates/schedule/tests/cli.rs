//! The binary from its flags to its files and exit codes. Motions are judged by formulas of this
//! file, not by those of the schedulers.

use std::{collections::BTreeSet, fs, path::Path, process::Output};

use ndarray::{Array1, Array2};
use planish_handoff::{artifact, npy::ArrayData};
use planish_testkit::program::{text, write};
use planish_types::{DwellTime, Segment, ToolPath, Trajectory};
use serde_json::{Value, json};

/// Returns the reference machine, an ion beam.
fn ion_beam() -> Value {
    let axis = |name: &str, velocity: f64, acceleration: f64| {
        json!({
            "name": name,
            "max_velocity_mm_per_s": velocity,
            "max_acceleration_mm_per_s2": acceleration
        })
    };
    json!({"name": "ion-beam", "axes": [axis("x", 250.0, 2000.0), axis("y", 150.0, 1000.0)]})
}

const V_MAX: [f64; 2] = [250.0, 150.0];
const A_MAX: [f64; 2] = [2000.0, 1000.0];

fn prepare(dir: &Path, points: &[[f64; 2]], dwell_s: &[f64]) {
    let n = points.len() - 1;
    let path = ToolPath::through(points.to_vec(), vec![true; n], vec![0; n]).unwrap();
    write(dir, "tool_path", &path);
    write(dir, "dwell", &DwellTime::new(dwell_s.to_vec()).unwrap());
    fs::write(dir.join("machine.json"), ion_beam().to_string()).unwrap();
}

fn schedule(dir: &Path, scheduler: &str, more: &[&str]) -> Output {
    planish_testkit::program::stage("planish-schedule")
        .current_dir(dir)
        .arg(scheduler)
        .args(["--tool-path", "tool_path", "--dwell", "dwell", "--machine", "machine.json"])
        .args(["--out", "trajectory"])
        .args(more)
        .output()
        .unwrap()
}

/// Returns the motion that the scheduler writes, and the outcome in its manifest.
fn scheduled(dir: &Path, scheduler: &str, more: &[&str]) -> (Trajectory, Value) {
    let output = schedule(dir, scheduler, more);
    let loaded = artifact::read::<Trajectory>(&dir.join("trajectory")).unwrap();
    let manifest = loaded.manifest.unwrap();
    assert_eq!(manifest.method, scheduler);
    let kept = manifest.outcome["claim"]["limits_respected"].as_bool().unwrap();
    assert_eq!(output.status.code(), Some(i32::from(!kept)), "{}", text(&output.stderr));
    assert_eq!(manifest.outcome["status"], if kept { "done" } else { "negative" });
    (loaded.value, manifest.outcome)
}

/// Returns the subcommands that make a motion, baselines too, as `--help` lists them. The other subcommands write a
/// single file, which has no manifest.
fn schedulers() -> Vec<String> {
    let output =
        planish_testkit::program::stage("planish-schedule").arg("--help").output().unwrap();
    let help = text(&output.stdout);
    let list = |heading: &str| help.split(heading).nth(1).unwrap().split("\n\n").next().unwrap();
    let lists = [list("Commands:\n"), list("Baselines, to compare with the literature:\n")];
    // A name is indented by two, the rest of its description by more.
    let lines = lists.iter().flat_map(|list| list.lines());
    let lines = lines.filter_map(|line| line.strip_prefix("  "));
    let names =
        lines.filter(|line| !line.starts_with(' ')).map(|line| line.split(' ').next().unwrap());
    let names = names.filter(|name| !["abort", "interpolate", "program", "help"].contains(name));
    names.map(String::from).collect()
}

#[test]
fn every_subcommand_is_one_method_of_its_own() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &STEP, &STEP_DWELL_S);
    let schedulers = schedulers();
    assert!(schedulers.len() >= 7, "{schedulers:?}");
    let mut methods = BTreeSet::new();
    for scheduler in &schedulers {
        schedule(tmp.path(), scheduler, &["--force"]);
        let loaded = artifact::read::<Trajectory>(&tmp.path().join("trajectory")).unwrap();
        let manifest = loaded.manifest.unwrap();
        assert_eq!(&manifest.method, scheduler);
        assert!(methods.insert(manifest.method), "{scheduler}: the method of two subcommands");
        // What chooses among motions of one method is a setting.
        let mut settings: Vec<&str> =
            manifest.settings.as_object().unwrap().keys().map(String::as_str).collect();
        settings.sort_unstable();
        let expected: &[&str] = match scheduler.as_str() {
            "pvt" => &["max_path_distance_mm", "mode", "stretch"],
            "pvt-as-published" => &["max_path_distance_mm", "rest_condition"],
            "trig-spline" => {
                &["corner_deviation_mm", "fit_tolerance_mm", "max_path_distance_mm", "repair"]
            }
            _ => &["max_path_distance_mm"],
        };
        assert_eq!(settings, expected, "{scheduler}");
    }
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("not a number: {value}"))
}

/// Returns position, velocity and acceleration of a cubic at the local time `u`.
fn state(c: &[f64; 4], u: f64) -> [f64; 3] {
    [
        c[0] + u * (c[1] + u * (c[2] + u * c[3])),
        c[1] + u * (2.0 * c[2] + 3.0 * c[3] * u),
        2.0 * c[2] + 6.0 * c[3] * u,
    ]
}

/// Asserts that the motion starts and ends at rest, passes every control point at the end of its segment,
/// is continuous in position and velocity, and keeps the limits everywhere. The velocity is a parabola,
/// largest at an end or its vertex. The acceleration is linear, largest at an end.
fn judge(t: &Trajectory, points: &[[f64; 2]]) {
    assert_eq!(t.len(), points.len() - 1);
    for axis in 0..2 {
        let mut before = [points[0][axis], 0.0];
        for (i, s) in t.segments().enumerate() {
            let (c, h) = (&s.coefficient_mm[axis], s.duration_s);
            let (start, end) = (state(c, 0.0), state(c, h));
            // Rounding of positions up to 1e2 mm and velocities up to 1e2 mm/s.
            assert!((start[0] - before[0]).abs() < 1e-11, "segment {i}: jump to {}", start[0]);
            assert!((start[1] - before[1]).abs() < 1e-9, "segment {i}: step to {}", start[1]);
            assert!((end[0] - points[i + 1][axis]).abs() < 1e-11, "segment {i}: {}", end[0]);
            let vertex = -c[2] / (3.0 * c[3]);
            let inner = if vertex > 0.0 && vertex < h { state(c, vertex)[1] } else { 0.0 };
            let v = start[1].abs().max(end[1].abs()).max(inner.abs());
            let a = start[2].abs().max(end[2].abs());
            assert!(v <= V_MAX[axis] && a <= A_MAX[axis], "segment {i}: {v} mm/s, {a} mm/s^2");
            before = [end[0], end[1]];
        }
        // Rounding of velocities, as above.
        assert!(before[1].abs() < 1e-9, "ends at {} mm/s", before[1]);
    }
}

#[test]
fn pvt_is_the_clamped_spline_at_the_dwell_times() {
    let tmp = tempfile::tempdir().unwrap();
    let points = [0.0, 1.0, 3.0, 4.0].map(|x| [x, 10.0 - 2.0 * x]);
    prepare(tmp.path(), &points, &[1.0; 3]);
    let (t, outcome) = scheduled(tmp.path(), "pvt", &["--mode=smooth"]);
    judge(&t, &points);
    assert_eq!(t.break_time_s(), [0.0, 1.0, 2.0, 3.0]);
    assert_eq!(t.dwell_index(), [0, 1, 2].map(Some));
    // By hand: 4 v1 + v2 = 9, v1 + 4 v2 = 9 along x; -2 times that along y.
    for (axis, factor) in [(0, 1.0), (1, -2.0)] {
        for (i, v) in [0.0, 1.8, 1.8].iter().enumerate() {
            let found = t.coefficient_mm()[i][axis][1];
            // Rounding of coefficients of the order 1.
            assert!((found - factor * v).abs() < 1e-13, "{i}: {found}");
        }
    }
    let report = &outcome["report"];
    assert_eq!((&report["stretched"], &report["dropped"]), (&json!([]), &json!([])));
    assert_eq!(report["solver"], json!(["tridiagonal", "tridiagonal"]));
    assert_eq!((number(&outcome["dwell_s"]), number(&outcome["total_time_s"])), (3.0, 3.0));

    let again = schedule(tmp.path(), "pvt", &["--mode=smooth"]);
    assert_eq!(again.status.code(), Some(0));
    assert!(text(&again.stdout).contains("unchanged"));
    // Another method is another output.
    let other = schedule(tmp.path(), "position", &[]);
    assert_eq!(other.status.code(), Some(2));
    assert!(text(&other.stderr).contains("give --force to replace it, or another --out"));
}

/// Returns true if the motion leaves the box of the ends of one of its segments.
fn leaves_a_box(t: &Trajectory, points: &[[f64; 2]]) -> bool {
    let beyond = |(i, s): (usize, Segment)| {
        (0..=50).any(|k| {
            let p = s.position_mm(s.duration_s * f64::from(k) / 50.0);
            (0..2).any(|a| {
                let (from, to) = (points[i][a], points[i + 1][a]);
                // Velocities at reversals are exactly zero; rounding of positions.
                p[a] < from.min(to) - 1e-11 || p[a] > from.max(to) + 1e-11
            })
        })
    };
    t.segments().enumerate().any(beyond)
}

#[test]
fn monotone_never_leaves_the_box_of_a_segment() {
    let tmp = tempfile::tempdir().unwrap();
    let points = [[0.0, 0.0], [5.0, 0.0], [6.0, 0.0], [6.0, 3.0], [1.0, 3.0], [0.5, 9.0]];
    prepare(tmp.path(), &points, &[0.4, 0.3, 0.5, 0.5, 0.7]);
    let (t, outcome) = scheduled(tmp.path(), "pvt", &["--mode=monotone"]);
    judge(&t, &points);
    assert_eq!(outcome["report"]["stretched"], json!([]));
    assert!(!leaves_a_box(&t, &points));
    let (smooth, _) = scheduled(tmp.path(), "pvt", &["--mode=smooth", "--force"]);
    assert!(leaves_a_box(&smooth, &points), "the case proves nothing");
}

/// Control points, mm, and dwell times, s, of a path with 60 mm in 0.1 s between ordinary segments.
const STEP: [[f64; 2]; 6] =
    [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [62.0, 0.0], [63.0, 0.0], [64.0, 0.0]];
const STEP_DWELL_S: [f64; 5] = [0.5, 0.5, 0.1, 0.5, 0.5];

#[test]
fn what_the_machine_cannot_do_is_stretched_and_the_manifest_says_where_and_by_how_much() {
    for mode in ["smooth", "monotone"] {
        let tmp = tempfile::tempdir().unwrap();
        prepare(tmp.path(), &STEP, &STEP_DWELL_S);
        let (t, outcome) = scheduled(tmp.path(), "pvt", &["--mode", mode]);
        judge(&t, &STEP);
        let report = &outcome["report"];
        let stretched = report["stretched"].as_array().unwrap();
        let at = |i: usize| stretched.iter().find(|s| s["segment"] == i).cloned();
        // At the limit of the velocity 60 mm take 0.24 s.
        let step = at(2).expect("the step is stretched");
        assert_eq!((number(&step["dwell_s"]), &step["tool_on"]), (0.1, &json!(true)));
        assert!(number(&step["scheduled_s"]) > 0.24, "{step}");
        // The report is the motion: every segment takes its dwell time, or what is reported.
        let mut added = 0.0;
        for (i, dwell_s) in STEP_DWELL_S.iter().enumerate() {
            let expected = at(i).map_or(*dwell_s, |s| number(&s["scheduled_s"]));
            // Rounding of break times of a few s.
            assert!((t.segment(i).duration_s - expected).abs() < 1e-14, "{mode} segment {i}");
            added += expected - dwell_s;
        }
        // Below: rounding of times of a few s.
        assert!((number(&report["added_tool_on_s"]) - added).abs() < 1e-14);
        assert_eq!(number(&report["added_tool_off_s"]), 0.0);
        assert!((number(&outcome["total_time_s"]) - 2.1 - added).abs() < 1e-14);
        assert!(number(&report["rounds"]) >= 1.0);
        println!("{mode}: {added} s added");
        // Regression bound: measured 0.14 s (smooth) and 0.32 s (monotone) on this step, which takes 0.424 s
        // from rest to rest.
        assert!(added < 0.6, "{mode}: {added} s");
    }
}

#[test]
fn from_rest_to_rest_the_stretch_is_that_of_the_cubic() {
    let tmp = tempfile::tempdir().unwrap();
    let points = [[0.0, 3.0], [60.0, 3.0]];
    prepare(tmp.path(), &points, &[0.1]);
    let (t, outcome) = scheduled(tmp.path(), "pvt", &[]);
    judge(&t, &points);
    // Acceleration 6 d / h^2 <= 2000: h >= 0.424 s; velocity 1.5 d / h <= 250: h >= 0.36 s.
    let least = (6.0_f64 * 60.0 / 2000.0).sqrt();
    let h = number(&outcome["report"]["stretched"][0]["scheduled_s"]);
    // At most one step of 0.2 % too far.
    assert!(h >= least && h <= 1.003 * least, "{h} {least}");
}

#[test]
fn without_stretching_the_infeasible_is_refused_and_nothing_written() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &STEP, &STEP_DWELL_S);
    refused(
        tmp.path(),
        "pvt",
        &["--no-stretch"],
        &["segment 2 (60.000000 mm in 0.100000 s) needs at least 0.240000 s", "allow stretching"],
    );
    // Within the mean velocity, but from rest to rest not within the acceleration: 0.424 s.
    prepare(tmp.path(), &[[0.0, 0.0], [60.0, 0.0]], &[0.3]);
    let factor =
        "segment 0 (60.000000 mm in 0.300000 s) needs its time stretched by a factor 1.4142";
    for mode in ["--mode=smooth", "--mode=monotone"] {
        let expected = [factor, "allow stretching or raise its dwell time"];
        refused(tmp.path(), "pvt", &["--no-stretch", mode], &expected);
    }
    // What is feasible is not touched by the flag.
    prepare(tmp.path(), &STEP, &[0.5, 0.5, 2.0, 0.5, 0.5]);
    let (t, _) = scheduled(tmp.path(), "pvt", &["--no-stretch"]);
    judge(&t, &STEP);
    assert_eq!(t.total_time_s(), 4.0);
}

#[test]
fn constant_acceleration_is_its_closed_form() {
    let tmp = tempfile::tempdir().unwrap();
    // From rest 5 mm in 0.2 s at 2000 mm/s^2: v = a d - sqrt(a^2 d^2 - 2 a s).
    prepare(tmp.path(), &[[1.0, 2.0], [6.0, 2.0]], &[0.2]);
    let (t, outcome) = scheduled(tmp.path(), "constant-acceleration", &[]);
    let (a, d, s) = (2000.0_f64, 0.2, 5.0);
    let v = a * d - (a * a * d * d - 2.0 * a * s).sqrt();
    let report = &outcome["report"];
    // Cancellation in v: rounding of 400 mm/s over 2000 mm/s^2.
    assert!((number(&report["brake_s"]) - v / a).abs() < 1e-15);
    assert!((number(&outcome["total_time_s"]) - d - v / a).abs() < 1e-15);
    assert_eq!((&report["late_segments"], number(&report["added_s"])), (&json!(0), 0.0));
    // Acceleration, constant velocity, brake with the tool off.
    assert_eq!(
        (t.dwell_index(), t.tool_on()),
        (&[Some(0), Some(0), None][..], &[true, true, false][..])
    );
    let end = state(&t.coefficient_mm()[1][0], t.segment(1).duration_s);
    // Rounding of 6 mm; that of 400 mm/s in v.
    assert!((end[0] - 6.0).abs() < 1e-13 && (end[1] - v).abs() < 1e-11, "{end:?}");

    // Too late: 10 mm from rest at full acceleration take sqrt(2 s / a).
    prepare(tmp.path(), &[[0.0, 0.0], [-10.0, 0.0]], &[0.05]);
    let (_, outcome) = scheduled(tmp.path(), "constant-acceleration", &["--force"]);
    let report = &outcome["report"];
    assert_eq!(report["late_segments"], 1);
    let late = (2.0_f64 * 10.0 / 2000.0).sqrt() - 0.05;
    // Below: rounding of times below 1 s.
    assert!((number(&report["added_s"]) - late).abs() < 1e-14, "{report}");

    // Too fast: 60 mm in 0.25 s. 250 mm/s are reached after 0.125 s and 15.625 mm; the other 44.375 mm take 0.1775 s.
    prepare(tmp.path(), &[[0.0, 0.0], [-60.0, 0.0]], &[0.25]);
    let (t, outcome) = scheduled(tmp.path(), "constant-acceleration", &["--force"]);
    let added_s = number(&outcome["report"]["added_s"]);
    // Rounding, as above.
    assert!((added_s - 0.0525).abs() < 1e-14, "{added_s}");
    assert_eq!(t.coefficient_mm()[1][0][1], -250.0);
    assert_eq!(outcome["claim"]["limits_respected"], true);
}

#[test]
fn position_stands_at_the_dwell_points() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &[[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [4.0, 1.0]], &[0.25, 0.0, 0.5]);
    let (t, outcome) = scheduled(tmp.path(), "position", &[]);
    assert_eq!(
        (t.break_time_s(), t.dwell_index()),
        (&[0.0, 0.25, 0.75][..], &[Some(0), Some(2)][..])
    );
    assert_eq!(t.coefficient_mm()[0], [[1.0, 0.0, 0.0, 0.0], [0.0; 4]]);
    assert_eq!(t.coefficient_mm()[1], [[3.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]);
    assert_eq!(number(&outcome["total_time_s"]), 0.75);
}

#[test]
fn the_lifted_tool_is_off_and_its_stretch_counted_apart() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &STEP, &STEP_DWELL_S);
    let on = vec![true, true, false, true, true];
    let path = ToolPath::through(STEP.to_vec(), on.clone(), vec![0, 0, 0, 1, 1]).unwrap();
    write(tmp.path(), "tool_path", &path);
    let (t, outcome) = scheduled(tmp.path(), "pvt", &[]);
    judge(&t, &STEP);
    assert_eq!(t.tool_on(), on);
    // The lift takes 0.24 s at the limit of the velocity, of which 0.1 s are planned.
    assert!(number(&outcome["report"]["added_tool_off_s"]) > 0.14, "{outcome}");
}

#[test]
fn segments_shorter_than_the_controllers_least_are_stretched() {
    let tmp = tempfile::tempdir().unwrap();
    let points = [[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]];
    prepare(tmp.path(), &points, &[0.02, 0.5]);
    let mut machine = ion_beam();
    machine["min_segment_s"] = json!(0.05);
    fs::write(tmp.path().join("machine.json"), machine.to_string()).unwrap();
    let (t, outcome) = scheduled(tmp.path(), "pvt", &[]);
    judge(&t, &points);
    assert!(t.segment(0).duration_s >= 0.05);
    assert_eq!(outcome["report"]["stretched"][0]["segment"], 0);
}

/// Asserts exit code 2, one message that contains every part of `expected`, and no output.
fn refused(dir: &Path, scheduler: &str, more: &[&str], expected: &[&str]) {
    let output = schedule(dir, scheduler, more);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    let errors: Vec<&str> = message.lines().filter(|l| l.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{message}");
    for part in expected {
        assert!(errors[0].contains(part), "no {part:?} in: {message}");
    }
    assert!(!dir.join("trajectory").exists() && output.stdout.is_empty(), "{output:?}");
}

/// Asserts that every scheduler refuses the inputs after `change`.
fn all_refuse(change: impl Fn(&Path), expected: &[&str]) {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &STEP, &STEP_DWELL_S);
    change(tmp.path());
    for scheduler in schedulers() {
        refused(tmp.path(), &scheduler, &[], expected);
    }
}

/// Removes the manifest of an artifact and replaces an array by `array`.
fn bare(artifact: &'static str, name: &'static str, array: ArrayData) -> impl Fn(&Path) {
    move |dir| {
        let dir = dir.join(artifact);
        fs::remove_file(dir.join("manifest.json")).unwrap();
        fs::write(dir.join(format!("{name}.npy")), array.to_npy()).unwrap();
    }
}

#[test]
fn bad_dwell_times_end_with_2_and_name_file_place_and_remedy() {
    let array = |array| bare("dwell", "dwell_s", array);
    let times = |t: &[f64]| array(ArrayData::F64(Array1::from(t.to_vec()).into_dyn().into()));
    let file = "dwell/dwell_s.npy: ";
    let remedy = "dwell times are not negative";
    all_refuse(times(&[0.5, -0.25, 0.1, 0.5, 0.5]), &[file, "dwell_s[1]: is -0.25 s", remedy]);
    all_refuse(times(&[0.5, 0.5, f64::NAN, 0.5, 0.5]), &[file, "element [2] is NaN"]);
    all_refuse(times(&[f64::INFINITY, 0.5, 0.5, 0.5, 0.5]), &[file, "element [0] is inf"]);
    all_refuse(times(&[]), &[file, "is empty (shape [0])"]);
    all_refuse(
        times(&[0.5; 4]),
        &["dwell_s: has 4 elements, the tool path 5 dwell points; give the dwell time of this"],
    );
    let integers = ArrayData::I64(Array1::from(vec![1, 1, i64::MAX, 1, 1]).into_dyn().into());
    all_refuse(array(integers), &[file, "element [2] is 9223372036854775807 of dtype <i8"]);
    let column = ArrayData::F64(Array2::ones((5, 1)).into_dyn().into());
    all_refuse(array(column), &[file, "has 2 axes (shape [5, 1]), needs 1: (n)"]);
}

#[test]
fn bad_paths_end_with_2() {
    let points =
        |p: Array2<f64>| bare("tool_path", "point_mm", ArrayData::F64(p.into_dyn().into()));
    let mut bad = Array2::zeros((6, 2));
    bad[[4, 1]] = f64::NAN;
    all_refuse(points(bad), &["tool_path/point_mm.npy: element [4, 1] is NaN; give finite"]);
    all_refuse(points(Array2::zeros((5, 2))), &["dwell_point_mm.npy: ", "n = 4 from point_mm"]);
    all_refuse(points(Array2::zeros((6, 3))), &["point_mm.npy: has shape [6, 3], needs (n+1, 2)"]);
    all_refuse(
        |dir| {
            fs::remove_dir_all(dir.join("tool_path")).unwrap();
            fs::rename(dir.join("dwell"), dir.join("tool_path")).unwrap();
        },
        &["tool_path: holds a dwell, needs a tool_path; check the order of the flags"],
    );
    all_refuse(
        |dir| fs::remove_dir_all(dir.join("dwell")).unwrap(),
        &["dwell: does not exist; give a dwell directory"],
    );
}

#[test]
fn bad_machines_end_with_2() {
    let machine = |change: &dyn Fn(&mut Value), expected: &[&str]| {
        let mut json = ion_beam();
        change(&mut json);
        let write = |dir: &Path| fs::write(dir.join("machine.json"), json.to_string()).unwrap();
        all_refuse(write, &[&["machine.json: "], expected].concat());
    };
    let positive = "a limit is positive and finite";
    for (axis, key, value) in [
        (0, "max_velocity_mm_per_s", 0.0),
        (1, "max_velocity_mm_per_s", -150.0),
        (0, "max_acceleration_mm_per_s2", 0.0),
        (1, "max_acceleration_mm_per_s2", -1.5),
        (1, "max_jerk_mm_per_s3", 0.0),
    ] {
        let place = format!("axes[{axis}]: {key} is {value}");
        machine(&|m| m["axes"][axis][key] = json!(value), &[&place, positive]);
    }
    let two = "give exactly two axes named \"x\" and \"y\", in this order";
    machine(&|m| drop(m["axes"].as_array_mut().unwrap().pop()), &["axes: are [\"x\"]", two]);
    machine(&|m| m["axes"].as_array_mut().unwrap().reverse(), &["are [\"y\", \"x\"]", two]);
    machine(&|m| m["axes"] = json!([]), &["axes: are []", two]);
    machine(
        &|m| m["axes"][0]["max_speed"] = json!(1.0),
        &["unknown field `max_speed`", "max_velocity_mm_per_s"],
    );
    machine(&|m| m["units"] = json!("mm"), &["unknown field `units`"]);
    machine(&|m| m["min_segment_s"] = json!(-1.0), &["min_segment_s: is -1"]);
    machine(&|m| m["axes"][0]["max_velocity_mm_per_s"] = json!("fast"), &["invalid type: string"]);
    machine(&|m| m["axes"][0]["max_velocity_mm_per_s"] = Value::Null, &["invalid type: null"]);
    machine(&|m| *m = Value::Null, &["invalid type: null"]);
    for (text, expected) in [
        ("{\"name\": \"m\"", "EOF while parsing"),
        ("{\"name\": \"m\"}", "missing field `axes`"),
        ("", "EOF while parsing"),
        ("{\"name\": \"m\", \"axes\": [], \"min_segment_s\": 1e999}", "out of range"),
        ("{\"name\": \"m\", \"axes\": [], \"min_segment_s\": NaN}", "expected value"),
    ] {
        let write = |dir: &Path| fs::write(dir.join("machine.json"), text).unwrap();
        all_refuse(write, &["machine.json: ", expected]);
    }
    let none = |dir: &Path| fs::remove_file(dir.join("machine.json")).unwrap();
    all_refuse(none, &["machine.json: cannot read: No such file"]);
}

#[test]
fn a_path_without_time_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &[[1.0, 1.0]; 3], &[0.0; 2]);
    for scheduler in ["constant-acceleration", "trig-spline", "average-velocity", "position"] {
        refused(tmp.path(), scheduler, &[], &["dwell_s: is zero everywhere; give a dwell time"]);
    }
}

#[test]
fn bad_flags_end_with_2() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &STEP, &STEP_DWELL_S);
    refused(tmp.path(), "pvt", &["--mode=fast"], &["invalid value 'fast'"]);
    refused(tmp.path(), "position", &["--no-stretch"], &["unexpected argument '--no-stretch'"]);
    let unknown = ["unexpected argument '--rest-condition'"];
    refused(tmp.path(), "pvt", &["--rest-condition=as-printed"], &unknown);
    refused(tmp.path(), "pvt-as-published", &["--mode=smooth"], &["unexpected argument '--mode'"]);
    let other = ["invalid value 'other'"];
    refused(tmp.path(), "pvt-as-published", &["--rest-condition=other"], &other);
    refused(tmp.path(), "spline", &[], &["unrecognized subcommand 'spline'"]);
}

#[test]
fn bad_settings_and_times_end_with_2() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &STEP, &STEP_DWELL_S);
    for flag in ["corner-deviation-mm", "fit-tolerance-mm"] {
        for value in ["0", "-1", "nan", "inf"] {
            let name = format!("{}: is ", flag.replace('-', "_"));
            refused(tmp.path(), "trig-spline", &[&format!("--{flag}={value}")], &[&name]);
        }
    }
    // No time on a segment with a length: the least squares have no polynomial for it.
    prepare(tmp.path(), &STEP, &[0.5, 0.0, 0.1, 0.5, 0.5]);
    let expected = ["dwell_s[1]: is 0 s on a segment of 1 mm", "give it time, or use pvt"];
    refused(tmp.path(), "pvt-as-published", &[], &expected);
    // A path without a length has a motion, but no feed.
    prepare(tmp.path(), &[[1.0, 1.0]; 3], &[0.5; 2]);
    refused(
        tmp.path(),
        "trig-spline",
        &["--dwell-density-out", "dwell_density"],
        &["the path has no length"],
    );
    assert!(!tmp.path().join("dwell_density").exists());
    let (t, _) = scheduled(tmp.path(), "trig-spline", &[]);
    assert_eq!((t.len(), t.total_time_s()), (2, 1.0));
}

#[test]
fn the_manifest_says_which_limits_are_kept() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &STEP, &[0.5, 0.5, 2.0, 0.5, 0.5]);
    for (scheduler, kept) in [
        ("pvt", true),
        ("trig-spline", true),
        ("constant-acceleration", true),
        ("stop-at-corners", true),
        ("average-velocity", false),
        ("position", false),
    ] {
        let (_, outcome) = scheduled(tmp.path(), scheduler, &["--force"]);
        assert_eq!(outcome["claim"]["limits_respected"], kept, "{scheduler}: {outcome}");
        assert!(outcome["claim"].get("jerk").is_none(), "{scheduler}");
    }
    // A limit on jerk is kept by the smooth motion, which starts without a step in the
    // acceleration; not by the monotone one, and it is said.
    let mut machine = ion_beam();
    machine["axes"][0]["max_jerk_mm_per_s3"] = json!(1e4);
    fs::write(tmp.path().join("machine.json"), machine.to_string()).unwrap();
    let (t, outcome) = scheduled(tmp.path(), "pvt", &["--force"]);
    assert_eq!(outcome["claim"]["limits_respected"], true, "{outcome}");
    assert_eq!(outcome["claim"]["jerk"], true, "{outcome}");
    // By this file: |6 c3| and the acceleration at every break, from rest to rest.
    let mut before = 0.0;
    for s in t.segments() {
        let c = &s.coefficient_mm[0];
        assert!(6.0 * c[3].abs() <= 1e4, "{c:?}");
        // Rounding of 2000 mm/s^2.
        assert!((state(c, 0.0)[2] - before).abs() < 1e-8, "{c:?} {before}");
        before = state(c, s.duration_s)[2];
    }
    // Rounding of 2000 mm/s^2.
    assert!(before.abs() < 1e-8);
    let output = schedule(tmp.path(), "pvt", &["--force", "--mode=monotone"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stdout).contains("; the acceleration steps, which no"), "{output:?}");
    let manifest = artifact::read::<Trajectory>(&tmp.path().join("trajectory")).unwrap().manifest;
    let claim = manifest.unwrap().outcome["claim"].clone();
    assert_eq!((&claim["jerk"], &claim["jerk_inside_segments"]), (&json!(false), &json!(true)));
    // Not at the given times.
    refused_again(tmp.path());
}

/// Asserts that the smooth motion within a limit on jerk needs more time, and that it is refused without stretching.
fn refused_again(dir: &Path) {
    fs::remove_dir_all(dir.join("trajectory")).unwrap();
    prepare(dir, &[[0.0, 0.0], [1.0, 0.0]], &[0.1]);
    let mut machine = ion_beam();
    // 32 mm / (0.1 s)^3 = 32000 mm/s^3: four times the limit, whose root is 1.5874.
    machine["axes"][0]["max_jerk_mm_per_s3"] = json!(8e3);
    fs::write(dir.join("machine.json"), machine.to_string()).unwrap();
    let expected = ["segment 0 (1.000000 mm in 0.100000 s)", "a factor 1.5874"];
    refused(dir, "pvt", &["--no-stretch"], &expected);
    let (t, outcome) = scheduled(dir, "pvt", &[]);
    assert_eq!((t.len(), &outcome["claim"]["limits_respected"]), (4, &json!(true)));
    assert!((t.total_time_s() / 0.158_74 - 1.0).abs() < 0.005, "{} s", t.total_time_s());
}

#[test]
fn corners_cost_time_and_no_overshoot_when_it_stops_there() {
    let tmp = tempfile::tempdir().unwrap();
    // 2 mm in 0.1 s each way around a corner: w^2 - a d w + a L = 0 with a = 2000 mm/s^2 is
    // w = 22.54 mm/s along x; y, with 1000 mm/s^2, needs 2 sqrt(2 / 1000) = 0.0894 s.
    let points = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];
    prepare(tmp.path(), &points, &[0.1, 0.08, 0.1]);
    let (_, outcome) = scheduled(tmp.path(), "constant-acceleration", &[]);
    assert!(number(&outcome["report"]["largest_overshoot_mm"][1]) > 0.1, "{outcome}");
    let (t, outcome) = scheduled(tmp.path(), "stop-at-corners", &["--force"]);
    let report = &outcome["report"];
    assert_eq!((&report["stops"], &report["late_segments"]), (&json!(2), &json!(1)));
    let late = 2.0 * (2.0_f64 / 1000.0).sqrt() - 0.08;
    // Rounding of times below 1 s.
    assert!((number(&report["added_s"]) - late).abs() < 1e-14, "{report}");
    assert!(!leaves_the_path(&t, &points), "{t:?}");
    assert_eq!(outcome["claim"]["limits_respected"], true);
}

/// Returns true if a cubic leaves the box of the ends of its segment.
fn leaves_the_path(t: &Trajectory, points: &[[f64; 2]]) -> bool {
    t.segments().any(|s| {
        let i = s.dwell_index.unwrap();
        (0..=50).any(|k| {
            let p = s.position_mm(s.duration_s * f64::from(k) / 50.0);
            (0..2).any(|a| {
                let (from, to) = (points[i][a], points[i + 1][a]);
                p[a] < from.min(to) - 1e-11 || p[a] > from.max(to) + 1e-11
            })
        })
    })
}

#[test]
fn a_lift_is_a_link_of_the_path_speed_methods() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path(), &STEP, &STEP_DWELL_S);
    let on = vec![true, true, false, true, true];
    let path = ToolPath::through(STEP.to_vec(), on, vec![0, 0, 0, 1, 1]).unwrap();
    write(tmp.path(), "tool_path", &path);
    // 60 mm from rest to rest by one cubic: 6 d / T^2 = 2000 mm/s^2.
    let least = (6.0_f64 * 60.0 / 2000.0).sqrt();
    for scheduler in ["trig-spline", "constant-acceleration"] {
        let (t, outcome) = scheduled(tmp.path(), scheduler, &["--force"]);
        assert_eq!(outcome["claim"]["limits_respected"], true, "{scheduler}: {outcome}");
        let lifts: Vec<Segment> = t.segments().filter(|s| s.dwell_index == Some(2)).collect();
        assert_eq!((lifts.len(), lifts[0].tool_on), (1, false), "{scheduler}");
        // From 2 mm/s the link is a little shorter or longer.
        let h = lifts[0].duration_s;
        assert!((h - least).abs() < 0.05 * least, "{scheduler}: {h} {least}");
    }
}

fn planish(dir: &Path, arguments: &[&str]) -> Output {
    planish_testkit::program::stage("planish-schedule")
        .current_dir(dir)
        .args(arguments)
        .output()
        .unwrap()
}

#[test]
fn a_feed_becomes_a_program_and_positions() {
    let tmp = tempfile::tempdir().unwrap();
    let points = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [2.0, 2.0]];
    prepare(tmp.path(), &points, &[0.5, 0.3, 0.4, 0.5]);
    let (t, outcome) =
        scheduled(tmp.path(), "trig-spline", &["--dwell-density-out", "dwell_density"]);
    // The default of --fit-tolerance-mm.
    assert!(number(&outcome["report"]["fit_error_mm"]) <= 1e-6);
    let feed =
        artifact::read::<planish_types::DwellDensity>(&tmp.path().join("dwell_density")).unwrap();
    assert_eq!(feed.manifest.unwrap().method, "trig-spline");
    assert_eq!(feed.value.corner().iter().filter(|c| **c).count(), 1);
    // Again, nothing to do; a lost feed comes back.
    let again = schedule(tmp.path(), "trig-spline", &["--dwell-density-out", "dwell_density"]);
    assert!(text(&again.stdout).contains("unchanged"), "{again:?}");
    fs::remove_dir_all(tmp.path().join("dwell_density")).unwrap();
    schedule(tmp.path(), "trig-spline", &["--dwell-density-out", "dwell_density"]);
    assert!(tmp.path().join("dwell_density/manifest.json").exists());

    let ok = |arguments: &[&str]| {
        let output = planish(tmp.path(), arguments);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        text(&output.stdout)
    };
    ok(&["program", "--dwell-density", "dwell_density", "--out", "part.nc"]);
    ok(&["interpolate", "--program", "part.nc", "--cycle-s", "0.01", "--out", "a.csv"]);
    ok(&["interpolate", "--dwell-density", "dwell_density", "--cycle-s", "0.01", "--out", "b.csv"]);
    let read = |name: &str| fs::read(tmp.path().join(name)).unwrap();
    assert_eq!(read("a.csv"), read("b.csv"));
    // On a sphere of R = 1000 mm the only difference is Z, the height of the part.
    fs::write(tmp.path().join("form.json"), r#"{"kind": "sphere", "radius_mm": 1000}"#).unwrap();
    let form = ["--form", "form.json", "--out", "curved.nc"];
    ok(&[&["program", "--dwell-density", "dwell_density"][..], &form[..]].concat());
    let (flat, curved) = (text(&read("part.nc")), text(&read("curved.nc")));
    let number = |line: &str, letter: char| {
        let word = line.split_whitespace().find(|w| w.starts_with(letter)).unwrap();
        word[1..].parse::<f64>().unwrap()
    };
    for (flat, curved) in flat.lines().zip(curved.lines()).filter(|(l, _)| l.starts_with('N')) {
        let [x, y, z] = ['X', 'Y', 'Z'].map(|letter| number(curved, letter));
        // R - sqrt(R^2 - x^2 - y^2), which cancels to the rounding of R, 1e-13 mm.
        let sag_mm = 1000.0 - (1e6 - x * x - y * y).sqrt();
        assert!((z - sag_mm).abs() < 1e-12, "{curved}");
        assert_eq!(curved.replace(&format!("Z{z}"), "Z0"), flat);
    }
    ok(&["interpolate", "--dwell-density", "dwell_density", "--cycle-s", "0.01", "--out", "a.npy"]);
    let table: Array2<f64> = ndarray_npy::read_npy(tmp.path().join("a.npy")).unwrap();
    // 1.7 s in ticks of 0.01 s; the first and the last one are the ends.
    assert_eq!(table.shape(), [171, 5]);
    assert_eq!([table[[0, 1]], table[[0, 2]]], [0.0, 0.0]);
    assert_eq!([table[[170, 1]], table[[170, 2]]], [2.0, 2.0]);
    let csv = text(&read("a.csv"));
    assert_eq!(csv.lines().next(), Some("time_s,x_mm,y_mm,feed_mm_per_s,pass_idx"));
    for (line, row) in csv.lines().skip(1).zip(table.outer_iter()) {
        let values: Vec<f64> = line.split(',').map(|v| v.parse().unwrap()).collect();
        assert_eq!(values, row.to_vec());
    }
    // The motion is there at the same time, after its run-up.
    let run_up_s = t.break_time_s()[1];
    assert_eq!(t.dwell_index()[0], None);
    for row in table.outer_iter() {
        let at = t.break_time_s().partition_point(|b| *b <= row[0] + run_up_s).min(t.len()) - 1;
        let p = t.segment(at).position_mm(row[0] + run_up_s - t.break_time_s()[at]);
        // The motion is fitted to 1e-6 mm: twice that.
        assert!((p[0] - row[1]).abs().max((p[1] - row[2]).abs()) < 2e-6, "{row} {p:?}");
    }

    let refuse = |arguments: &[&str], expected: &str| {
        let output = planish(tmp.path(), arguments);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(expected), "no {expected:?} in: {message}");
    };
    let from = ["interpolate", "--program", "part.nc"];
    let with = |more: &[&'static str]| [&from[..], more].concat();
    refuse(&with(&["--out", "a.csv"]), "a.csv: exists; give --force");
    refuse(&with(&["--out", "c.txt"]), "c.txt is neither .csv nor .npy");
    refuse(&with(&["--out", "c.csv", "--cycle-s", "0"]), "--cycle-s: the tick is 0 s");
    refuse(&with(&["--out", "c.csv", "--dwell-density", "dwell_density"]), "cannot be used with");
    refuse(&["interpolate", "--program", "no.nc", "--out", "c.csv"], "no.nc: cannot read");
    let program = text(&read("part.nc"));
    fs::write(tmp.path().join("bad.nc"), program.replacen(" P0", " W0", 1)).unwrap();
    refuse(&["interpolate", "--program", "bad.nc", "--out", "c.csv"], "bad.nc: line 5: the word");
    fs::write(tmp.path().join("empty.nc"), "(nothing)\n").unwrap();
    refuse(&["interpolate", "--program", "empty.nc", "--out", "c.csv"], "moves nothing");
    // Nothing temporary is left.
    let left = |name: &str| name.starts_with("c.") || name.contains("tmp");
    let names = fs::read_dir(tmp.path()).unwrap().map(|e| e.unwrap().file_name());
    assert!(!names.into_iter().any(|n| left(&n.to_string_lossy())));
}
