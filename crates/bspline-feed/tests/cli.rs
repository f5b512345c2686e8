//! The binary from its flags to its files and exit codes.

use std::{fs, path::Path, process::Output};

use ndarray::{Array1, Array2};
use planish_handoff::artifact;
use planish_testkit::program::{save, text, write};
use planish_types::{Axis, Grid, Surface, Tif, ToolPath, Trajectory};
use serde_json::{Value, json};

fn machine(axes: &[(&str, f64, f64)]) -> String {
    let axis = |(name, v, a): &(&str, f64, f64)| json!({"name": name, "max_velocity_mm_per_s": v, "max_acceleration_mm_per_s2": a});
    json!({"name": "m", "axes": axes.iter().map(axis).collect::<Vec<_>>()}).to_string()
}

/// Writes the inputs into `dir`: a map of 6 x 2 mm with a wave, a Gaussian TIF (sigma 0.5 mm), and three passes that
/// turn outside of the map.
fn prepare(dir: &Path) {
    let axis = |start: f64, n: usize| Axis::new(start, 0.25, n).unwrap();
    let grid = Grid { x: axis(0.0, 25), y: axis(0.0, 9) };
    let height = Array2::from_shape_fn(grid.shape(), |(_, c)| {
        20.0 + 10.0 * (1.5 * grid.x.coordinate_mm(c)).sin()
    });
    write(dir, "surface", &Surface::new(grid, height).unwrap());
    let a = axis(-1.5, 13);
    let rate = Array2::from_shape_fn((13, 13), |(r, c)| {
        5.0 * (-(a.coordinate_mm(c).powi(2) + a.coordinate_mm(r).powi(2)) / 0.5).exp()
    });
    write(dir, "tif", &Tif::new(Grid { x: a, y: a }, rate).unwrap());
    let points = vec![[-2.0, 0.0], [8.0, 0.0], [8.0, 1.0], [-2.0, 1.0], [-2.0, 2.0], [8.0, 2.0]];
    let path = ToolPath::through(points, vec![true; 5], vec![0, 0, 1, 1, 2]).unwrap();
    write(dir, "tool_path", &path);
    fs::write(dir.join("machine.json"), machine(&[("x", 20.0, 200.0), ("y", 20.0, 100.0)]))
        .unwrap();
}

fn run(dir: &Path, more: &[&str]) -> Output {
    planish_testkit::program::stage("planish-bspline-feed")
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", "2")
        .args(["--surface=surface", "--tif=tif", "--tool-path=tool_path"])
        .args(["--machine=machine.json", "--out=out"])
        .args(more)
        .output()
        .unwrap()
}

fn manifest(dir: &Path, part: &str) -> Value {
    let text = fs::read_to_string(dir.join("out").join(part).join("manifest.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

#[test]
fn writes_trajectory_and_feed_and_then_nothing() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let output = run(tmp.path(), &[]);
    let message = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{message}{}", text(&output.stderr));
    assert!(message.contains("bspline: 3 passes"), "{message}");
    let out = tmp.path().join("out");
    let trajectory = artifact::read::<Trajectory>(&out.join("trajectory")).unwrap().value;
    let report = &manifest(tmp.path(), "trajectory")["outcome"]["report"];
    assert_eq!(report["links"]["turn_arounds"], 2);
    // The default of --fit-tolerance-mm.
    assert!(report["fit"]["largest_error_mm"].as_f64().unwrap() <= 1e-6);
    assert!(report["acceleration_use"].as_f64().unwrap() <= 1.0);
    // The tool is off before the first and after the last pass, and every dwell point is served by
    // its pass or, where the path turns, by no segment.
    let n = trajectory.len();
    assert!(!trajectory.tool_on()[0] && !trajectory.tool_on()[n - 1]);
    let mut served: Vec<usize> = trajectory.dwell_index().iter().copied().flatten().collect();
    served.dedup();
    assert_eq!(served, [0, 2, 4]);
    let feed = &manifest(tmp.path(), "dwell_density")["arrays"];
    assert_eq!(feed["arc_length_mm"]["shape"], feed["dwell_density_s_per_mm"]["shape"]);

    let again = run(tmp.path(), &[]);
    assert!(text(&again.stdout).contains("unchanged"));
    let other = run(tmp.path(), &["--feed-source=vrr"]);
    assert_eq!(other.status.code(), Some(2), "another method needs --force");
    let forced = run(tmp.path(), &["--feed-source=vrr", "--force"]);
    assert_eq!(forced.status.code(), Some(0));
    assert_eq!(manifest(tmp.path(), "dwell_density")["method"], "vrr");
}

#[test]
fn too_few_steps_are_a_negative_verdict() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let output = run(tmp.path(), &["--max-sweeps=1"]);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("after 1 steps no proof"), "{message}");
    assert!(message.contains("raise --max-sweeps"), "{message}");
    let outcome = &manifest(tmp.path(), "trajectory")["outcome"];
    assert!(outcome["end"] == "sweep-limit" && outcome["report"]["gap"].is_null(), "{outcome}");
}

#[test]
fn converged_is_proven_by_a_gap_and_knot_removal_proves_nothing() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let output = run(tmp.path(), &[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let outcome = manifest(tmp.path(), "trajectory")["outcome"].clone();
    assert_eq!(outcome["end"], "converged");
    let gap = outcome["report"]["gap"].as_f64().unwrap();
    // The default of --relative-gap.
    assert!((0.0..=1e-3).contains(&gap), "{gap}");
    let said = format!(
        "proven within {:.2} % of the least objective of feeds on these knots",
        100.0 * gap
    );
    assert!(text(&output.stdout).contains(&said), "{}", text(&output.stdout));
    run(tmp.path(), &["--refinement=knot-removal", "--force"]);
    let outcome = manifest(tmp.path(), "trajectory")["outcome"].clone();
    assert!(outcome["end"] != "converged" && outcome["report"]["gap"].is_null(), "{outcome}");
}

#[test]
fn a_limit_on_jerk_is_not_kept_and_the_verdict_says_so() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let mut machine: Value =
        serde_json::from_str(&machine(&[("x", 20.0, 200.0), ("y", 20.0, 100.0)])).unwrap();
    machine["axes"][0]["max_jerk_mm_per_s3"] = json!(500.0);
    fs::write(tmp.path().join("machine.json"), machine.to_string()).unwrap();
    let output = run(tmp.path(), &[]);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("the limit on jerk of the machine is exceeded"), "{message}");
    let jerk = &manifest(tmp.path(), "trajectory")["outcome"]["report"]["jerk"];
    // The motion starts with all of the acceleration of an axis.
    let step = jerk["largest_acceleration_step_mm_per_s2"].as_f64().unwrap();
    // A link leaves 0.5e-6 of the limit free.
    assert!(step >= (1.0 - 1e-6) * 200.0, "{jerk}");
}

#[test]
fn a_machine_without_an_effective_limit_is_planned_for() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    for acceleration in [1e6, 1e9, 1e15] {
        let axes = [("x", 20.0, acceleration), ("y", 20.0, acceleration)];
        fs::write(tmp.path().join("machine.json"), machine(&axes)).unwrap();
        let output = run(tmp.path(), &["--force"]);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{acceleration}: {message}");
    }
    // At the velocity of light passes vanish in the rounding of times.
    let axes = [("x", 1e12, 1e15), ("y", 1e12, 1e15)];
    fs::write(tmp.path().join("machine.json"), machine(&axes)).unwrap();
    let output = run(tmp.path(), &["--force"]);
    let message = text(&output.stderr);
    assert!(matches!(output.status.code(), Some(0..=2)), "{message}");
    assert!(!message.contains("internal error") && !message.contains("ascend"), "{message}");
}

#[test]
fn a_sweep_that_raises_the_objective_is_a_negative_verdict() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    fs::write(tmp.path().join("machine.json"), machine(&[("x", 20.0, 0.5), ("y", 20.0, 0.5)]))
        .unwrap();
    let output = run(tmp.path(), &["--refinement=knot-removal"]);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{message}{}", text(&output.stdout));
    assert!(message.contains("raised the objective"), "{message}");
    assert_eq!(manifest(tmp.path(), "trajectory")["outcome"]["report"]["end"], "stopped");
}

/// Returns the message of a run that is refused, after checking that it wrote nothing; `more` are further arguments.
fn refused(dir: &Path, more: &[&str]) -> String {
    let output = run(dir, more);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(!dir.join("out").exists(), "something was written");
    assert!(!message.contains("internal error"), "{message}");
    message
}

#[test]
fn bad_inputs_are_refused_by_one_message() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    let good = fs::read_to_string(dir.join("machine.json")).unwrap();
    for (axes, said) in [
        (&[("x", 20.0, 200.0)][..], "give exactly two axes"),
        (&[("x", 20.0, 200.0), ("y", 20.0, 0.0)][..], "max_acceleration_mm_per_s2 is 0"),
        (&[("x", 20.0, 200.0), ("y", 20.0, 5e-324)][..], "max_acceleration_mm_per_s2 is 5e-324"),
        (&[("x", -1.0, 200.0), ("y", 20.0, 1.0)][..], "max_velocity_mm_per_s is -1"),
    ] {
        fs::write(dir.join("machine.json"), machine(axes)).unwrap();
        let message = refused(dir, &[]);
        assert!(message.contains("machine.json") && message.contains(said), "{message}");
    }
    fs::write(dir.join("machine.json"), good).unwrap();

    for (flag, said) in [
        ("--knot-spacing-mm=0", "knot_spacing_mm: is 0"),
        ("--knot-spacing-mm=NaN", "knot_spacing_mm: is NaN"),
        ("--pitch-mm=-1", "pitch_mm: is -1"),
        ("--tikhonov=-1", "tikhonov: is -1"),
        ("--max-sweeps=0", "max_sweeps: is 0"),
    ] {
        let message = refused(dir, &[flag]);
        assert!(message.contains(said), "{message}");
    }

    // A path that turns inside the aperture.
    let points = vec![[-2.0, 1.0], [3.0, 1.0], [3.0, 8.0]];
    let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
    write(dir, "tool_path", &path);
    let message = refused(dir, &[]);
    assert!(message.contains("segment 0") && message.contains("pvt"), "{message}");

    // A path beside the part.
    let far = ToolPath::through(vec![[50.0, 0.0], [60.0, 0.0]], vec![true], vec![0]).unwrap();
    write(dir, "tool_path", &far);
    assert!(refused(dir, &[]).contains("reaches a valid pixel"));
    let points = Array2::from_shape_vec((2, 2), vec![0.0, 0.0, f64::NAN, 0.0]).unwrap();
    fs::remove_dir_all(dir.join("tool_path")).unwrap();
    save(&dir.join("tool_path"), "point_mm", points);
    save(&dir.join("tool_path"), "dwell_point_mm", Array2::zeros((1, 2)));
    assert!(refused(dir, &[]).contains("NaN"));
    // Arrays without a manifest are somebody's own and not replaced.
    fs::remove_dir_all(dir.join("tool_path")).unwrap();
    prepare(dir);

    // A TIF that removes nothing, and one with a NaN.
    for (value, said) in [(0.0, "no positive rate"), (f64::NAN, "NaN")] {
        fs::remove_dir_all(dir.join("tif")).unwrap();
        let tif = dir.join("tif");
        save(&tif, "rate_nm_per_s", Array2::from_elem((13, 13), value));
        for name in ["x_mm", "y_mm"] {
            save(&tif, name, Array1::from_iter((0..13).map(|i| -1.5 + 0.25 * f64::from(i))));
        }
        let message = refused(dir, &[]);
        assert!(message.contains("tif") && message.contains(said), "{message}");
    }
}
