//! The binary from its flags to its files and exit codes.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::{Artifact, artifact};
use planish_types::{Axis, DwellTime, Grid, Surface, Tif, ToolPath, Trajectory};
use planish_verify::{VerifySettings, verify};
use serde_json::{Value, json};

fn machine(jerk: Option<f64>, acceleration: f64) -> Value {
    let axis = |name: &str| {
        let mut axis = json!({
            "name": name,
            "max_velocity_mm_per_s": 40.0,
            "max_acceleration_mm_per_s2": acceleration,
        });
        if let Some(jerk) = jerk {
            axis["max_jerk_mm_per_s3"] = json!(jerk);
        }
        axis
    };
    json!({"name": "m", "axes": [axis("x"), axis("y")]})
}

/// Writes the inputs into `dir`: a map of 6 x 2 mm with a wave, a Gaussian TIF of 0.5 mm, and lines with turns outside
/// of the map.
fn prepare(dir: &Path) {
    let axis = |start: f64, n: usize| Axis::new(start, 0.25, n).unwrap();
    let grid = Grid { x: axis(0.0, 25), y: axis(0.0, 9) };
    let height = Array2::from_shape_fn(grid.shape(), |(_, c)| {
        20.0 + 10.0 * (1.5 * grid.x.coordinate_mm(c)).sin()
    });
    write(dir, "surface", &Surface::new(grid, height).unwrap());
    let a = axis(-1.5, 13);
    let rate = Array2::from_shape_fn((13, 13), |(r, c)| {
        20.0 * (-(a.coordinate_mm(c).powi(2) + a.coordinate_mm(r).powi(2)) / 0.5).exp()
    });
    write(dir, "tif", &Tif::new(Grid { x: a, y: a }, rate).unwrap());
    let mut points = Vec::new();
    for line in 0..7 {
        let y = 0.5 * f64::from(line) - 0.5;
        points.extend(if line % 2 == 0 { [[-2.0, y], [8.0, y]] } else { [[8.0, y], [-2.0, y]] });
    }
    let n = points.len() - 1;
    write(dir, "tool_path", &ToolPath::through(points, vec![true; n], vec![0; n]).unwrap());
    fs::write(dir.join("machine.json"), machine(None, 400.0).to_string()).unwrap();
}

fn write<T: Artifact>(dir: &Path, name: &str, value: &T) {
    planish_handoff::save(&dir.join(name), value).unwrap();
}

fn run(dir: &Path, threads: &str, more: &[&str]) -> Output {
    planish_testkit::program::stage("planish-joint")
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", threads)
        .args(["--surface=surface", "--tif=tif", "--tool-path=tool_path"])
        .arg("--machine=machine.json")
        .args(more)
        .output()
        .unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_plan_is_written_with_its_certificate_and_keeps_the_limits() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let output = run(tmp.path(), "2", &["--out=out", "--time-weight-nm2-per-s=0.01"]);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let trajectory: Trajectory = artifact::read(&tmp.path().join("out/trajectory")).unwrap().value;
    let dwell: DwellTime = artifact::read(&tmp.path().join("out/dwell")).unwrap().value;
    let file = serde_json::from_value::<planish_types::MachineFile>(machine(None, 400.0)).unwrap();
    let verdict =
        verify(&trajectory, &file.checked().unwrap(), &VerifySettings::default()).unwrap();
    assert!(verdict.limits_respected, "{:?}", verdict.violations);
    let total = trajectory.total_time_s();
    // Rounding of sums of some hundred times, relative.
    assert!((dwell.dwell_s().iter().sum::<f64>() - total).abs() < 1e-9 * total);
    let text = fs::read_to_string(tmp.path().join("out/trajectory/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(manifest["method"], "joint");
    assert_eq!(manifest["outcome"]["end"], "optimal");
    // The default of --relative-gap.
    assert!(manifest["outcome"]["report"]["relative_gap"].as_f64().unwrap() <= 1e-3);
    assert!(manifest["outcome"]["report"]["pull_part"].as_f64().unwrap() <= 0.01);
    let covers = manifest["outcome"]["report"]["gap_covers"].as_str().unwrap();
    assert!(covers.contains("not closer nodes"), "{covers}");
    assert!(String::from_utf8_lossy(&output.stdout).contains(covers), "{}", said(&output));
    // The same bytes on one thread
    let other = run(tmp.path(), "1", &["--out=other", "--time-weight-nm2-per-s=0.01"]);
    assert_eq!(other.status.code(), Some(0), "{}", said(&other));
    for file in
        ["trajectory/coefficient_mm.npy", "trajectory/break_time_s.npy", "dwell/dwell_s.npy"]
    {
        let bytes = |out: &str| fs::read(tmp.path().join(out).join(file)).unwrap();
        assert_eq!(bytes("out"), bytes("other"), "{file}");
    }
}

/// Returns the machine file of a machine with the axes x, y, z and the tilts a and b, whose pivot is far above the
/// part.
fn five_axes() -> Value {
    let mut machine = machine(None, 400.0);
    let z = json!({"name": "z", "max_velocity_mm_per_s": 40, "max_acceleration_mm_per_s2": 300});
    machine["axes"].as_array_mut().unwrap().push(z);
    let tilt = |name: &str| {
        json!({
            "name": name,
            "max_velocity_deg_per_s": 60,
            "max_acceleration_deg_per_s2": 300,
        })
    };
    machine["rotary_axes"] = json!([tilt("a"), tilt("b")]);
    machine["kinematics"] = json!({"kind": "xyz-tilts", "pivot_mm": 30, "tilts": ["b", "a"]});
    machine
}

#[test]
fn a_machine_with_more_axes_is_planned_within_their_limits_on_its_form() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let flat = "--time-weight-nm2-per-s=0.01";
    let time_s = |out: &str| {
        let text = fs::read_to_string(tmp.path().join(out).join("trajectory/manifest.json"));
        let manifest: Value = serde_json::from_str(&text.unwrap()).unwrap();
        (manifest["outcome"]["total_time_s"].as_f64().unwrap(), manifest)
    };
    let form = r#"{"kind": "sphere", "radius_mm": -20, "vertex_mm": [3, 1]}"#;
    fs::write(tmp.path().join("sphere.json"), form).unwrap();

    // x and y alone: the form does not act, and the program says so.
    let output = run(tmp.path(), "2", &["--out=two", flat, "--form=sphere.json"]);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("the form does not act on the plan"), "{text}");
    let (two_s, manifest) = time_s("two");
    assert_eq!(manifest["outcome"]["report"].get("axes"), None);

    fs::write(tmp.path().join("machine.json"), five_axes().to_string()).unwrap();
    let output = run(tmp.path(), "2", &["--out=five", flat, "--form=sphere.json"]);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("planned with the axes contact x, contact y, x, y, z, a, b"), "{text}");
    let (five_s, manifest) = time_s("five");
    let axes = manifest["outcome"]["report"]["axes"].as_array().unwrap();
    assert_eq!(axes.len(), 7);
    for axis in axes {
        for key in ["velocity_over_limit", "acceleration_over_limit"] {
            // The allowance of the judge for rounding
            assert!(axis[key].as_f64().unwrap() <= 1.0 + 1e-6, "{axis}");
        }
    }
    // With the pivot at 30 mm over a radius of 20 mm, x and y move 2.5 times as far as the contact point.
    assert!(five_s > 1.05 * two_s, "{five_s} {two_s}");

    // The sphere ends within the path.
    fs::write(tmp.path().join("small.json"), form.replace("-20", "-4")).unwrap();
    let output = run(tmp.path(), "2", &["--out=small", flat, "--form=small.json"]);
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    assert!(said(&output).contains("give a form that covers all of it"), "{}", said(&output));
    assert!(!tmp.path().join("small").exists());
}

#[test]
fn too_few_steps_are_a_negative_verdict() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let output = run(tmp.path(), "2", &["--out=out", "--max-iterations=3"]);
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(
        said(&output).contains("raise --max-iterations or --relative-gap"),
        "{}",
        said(&output)
    );
}

#[test]
fn what_cannot_be_planned_is_refused_and_nothing_is_written() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let refused = |more: &[&str], text: &str| {
        let output = run(tmp.path(), "2", &[&["--out=out"], more].concat());
        assert_eq!(output.status.code(), Some(2), "{more:?}: {}", said(&output));
        assert!(said(&output).contains(text), "{more:?}: {}", said(&output));
        assert!(!tmp.path().join("out").exists());
    };
    refused(&["--tikhonov=0"], "tikhonov: is 0");
    refused(&["--node-spacing-mm=1e-9"], "node_spacing_mm: is 1e-9");
    refused(&["--corner-deviation-mm=nan"], "corner_deviation_mm: is NaN");
    refused(&["--min-dwell-s-per-mm=-1"], "min_dwell_s_per_mm: is -1");
    refused(&["--time-elasticity=inf"], "time_elasticity: is inf");
    refused(&["--time-elasticity=0.1", "--time-weight-nm2-per-s=1"], "cannot be used with");
    fs::write(tmp.path().join("machine.json"), machine(Some(1e-9), 400.0).to_string()).unwrap();
    refused(&[], "axes: limit jerk so that");
    fs::write(tmp.path().join("machine.json"), machine(None, 0.0).to_string()).unwrap();
    refused(&[], "max_acceleration_mm_per_s2 is 0");
}
