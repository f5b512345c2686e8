//! `planish-run several` from a rack to the map after the last tool.
#![cfg(unix)]

use std::{
    fs,
    path::{Path, PathBuf},
    process::Output,
};

use ndarray::Array2;
use planish_handoff::{Manifest, artifact, kind};
use planish_testkit::{
    program::{stage, text, write},
    workspace,
};
use planish_types::{
    Axis, Grid, Surface, Tif,
    outcome::{
        plan::{PlanOutcome, SeveralReport},
        removal::RemovalOutcome,
        verdict::Verdict,
    },
};
use serde_json::{Value, json};

/// Returns a square grid about the origin in pixels of 0.5 mm.
fn grid(half_mm: f64) -> Grid {
    let a = Axis::new(-half_mm, 0.5, (4.0 * half_mm) as usize + 1).unwrap();
    Grid { x: a, y: a }
}

/// Returns a Gaussian TIF of 10 nm/s with this sigma, mm.
fn tif(sigma_mm: f64) -> Tif {
    let g = grid(4.0 * sigma_mm);
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let square = g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2);
        10.0 * (-square / (2.0 * sigma_mm * sigma_mm)).exp()
    });
    Tif::new(g, rate).unwrap()
}

/// Writes a map of long and middle waves, a narrow and a wide tool, and their rack, and a machine of the fixtures.
fn prepare(dir: &Path) {
    let g = grid(12.0);
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
        120.0 + 0.8 * x * x + 0.3 * y * y + 12.0 * (0.9 * x).sin() * (0.8 * y).cos()
    });
    write(dir, "mirror", &Surface::new(g, height).unwrap());
    for (name, sigma_mm) in [("fine", 1.5), ("coarse", 4.0)] {
        write(dir, &format!("lab/{name}"), &tif(sigma_mm));
    }
    write_rack(dir, &json!({ "tools": [entry("fine", 1.5), entry("coarse", 4.0)] }));
    let machine = workspace().join("fixtures/machines/ion-beam.json");
    fs::copy(machine, dir.join("machine.json")).unwrap();
}

fn entry(name: &str, pitch_mm: f64) -> Value {
    json!({ "name": name, "tif": name, "pitch_mm": pitch_mm, "time_weight_nm2_per_s": 1e-2, "change_s": 30.0 })
}

fn write_rack(dir: &Path, rack: &Value) {
    fs::write(dir.join("lab/rack.json"), rack.to_string()).unwrap();
}

fn run(dir: &Path, more: &[&str]) -> Output {
    let settings = ["run", "several", "surface=mirror", "rack=lab/rack.json", "out=out"];
    let mut command = stage("planish-run");
    command.current_dir(dir).args(settings).args(more).output().unwrap()
}

/// Returns the manifest of an artifact of the run, and its place.
fn manifest(dir: &Path, part: &str, kind: &kind::Kind) -> (Manifest, PathBuf) {
    let place = dir.join("out").join(part);
    (artifact::read_manifest(&place, kind).unwrap().unwrap(), place)
}

fn verdict(dir: &Path, part: &str) -> Verdict {
    let (manifest, place) = manifest(dir, part, &kind::VERDICT);
    manifest.read_outcome(&place, "").unwrap()
}

fn removal(dir: &Path, part: &str) -> RemovalOutcome {
    let (manifest, place) = manifest(dir, part, &kind::REMOVAL);
    manifest.read_outcome(&place, "").unwrap()
}

#[test]
fn every_tool_keeps_its_limits_and_leaves_what_is_planned() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    let output = run(dir, &["machine=machine.json", "export=galil"]);
    let printed = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{printed}\n{}", text(&output.stderr));
    for name in ["coarse", "fine"] {
        for motion in ["", "/program"] {
            let verdict = verdict(dir, &format!("tools/{name}{motion}/verdict"));
            assert!(verdict.limits_respected, "{name}{motion}: {verdict:?}");
        }
    }
    let (manifest, place) = manifest(dir, "choice/fine", &kind::DWELL);
    let first: PlanOutcome<SeveralReport> = manifest.read_outcome(&place, "").unwrap();
    let planned_nm = first.report.unwrap().model_rms_nm;
    for motion in ["", "/program"] {
        let removal = removal(dir, &format!("tools/fine{motion}/removal"));
        println!("executed{motion}: {} nm, planned {planned_nm} nm", removal.rms_nm);
        // The goal for the residual of the motion: 5 % of that of the dwell times alone.
        assert!(removal.rms_nm <= 1.05 * planned_nm, "{motion}: {removal:?} {planned_nm}");
    }
    let table = fs::read_to_string(dir.join("out/table.txt")).unwrap();
    assert!(printed.contains(table.trim_end()), "{printed}");
    let rows: Vec<&str> = table.lines().collect();
    assert!(rows[2].starts_with("coarse ") && rows[3].starts_with("fine "), "{table}");
    assert!(rows[2].ends_with("  kept") && rows[4].starts_with("2 tools, "), "{table}");
    // The map after a tool is the map before the next one, and what the program of the last one leaves.
    let after = artifact::read::<Surface>(&dir.join("out/after")).unwrap().value;
    let removal = removal(dir, "tools/fine/program/removal");
    // Rounding of a mean square of 2400 pixels.
    assert!((after.statistics().rms / removal.rms_nm - 1.0).abs() < 1e-12);
}

#[test]
fn a_bad_setting_or_rack_ends_with_2_and_writes_nothing() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    let cases: [(&[&str], &str); 5] = [
        (&["export=galil"], "export=galil writes programs for the machine that will run them"),
        (&["pitch_mm=1"], "'pitch_mm=1' is no setting of several"),
        (&["motion=fast"], "motion is 'fast'; give refine or joint"),
        (&["choose=perhaps"], "choose is 'perhaps'; give yes or no"),
        (&["machine=no.json"], "no.json"),
    ];
    for (more, expected) in cases {
        let output = run(dir, more);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(expected), "no {expected:?} in: {message}");
        assert!(!dir.join("out").exists(), "{expected}");
    }
    let mut bare = entry("fine", 1.0);
    bare.as_object_mut().unwrap().remove("pitch_mm");
    let racks = [
        (json!([entry("nosuch", 1.0)]), "nosuch: does not exist; give a tif"),
        (json!([bare]), "tool \"fine\" has neither tool_path nor pitch_mm"),
        (json!([]), "has no tools; give at least one"),
        (json!([entry("fine", 1.0), entry("Fine", 1.0)]), "tools[1].name is \"Fine\" again"),
    ];
    for (tools, expected) in racks {
        write_rack(dir, &json!({ "tools": tools }));
        let output = run(dir, &[]);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(expected), "no {expected:?} in: {message}");
        assert!(!dir.join("out").exists(), "{expected}");
    }
}
