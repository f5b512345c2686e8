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
    let more = ["machine=machine.json", "export=galil", "compare=yes", "part_number=47-11"];
    let output = run(dir, &more);
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
    the_page_has_the_run(dir, &removal);
}

/// Checks the page of the run: the tools in their order, what they leave, the subsets, and each tool alone. `last` is
/// the outcome of the removal by the last tool.
fn the_page_has_the_run(dir: &Path, last: &RemovalOutcome) {
    let report = dir.join("out/report");
    let summary = fs::read_to_string(report.join("summary.json")).unwrap();
    let summary: Value = serde_json::from_str(&summary).unwrap();
    let several = &summary["several"];
    let tools = several["tools"].as_array().unwrap();
    let names: Vec<&Value> = tools.iter().map(|tool| &tool["name"]).collect();
    assert_eq!(names, ["coarse", "fine"]);
    let first = removal(dir, "tools/coarse/program/removal");
    let near =
        |value: &Value, expected: f64| (value.as_f64().unwrap() / expected - 1.0).abs() < 1e-12;
    // Two sums of the same 2400 squares.
    assert!(
        near(&tools[0]["rms_nm"], first.rms_nm) && near(&tools[1]["before_rms_nm"], first.rms_nm)
    );
    assert!(near(&summary["methods"]["fine"]["rms_nm"], last.rms_nm), "{summary}");
    let whole_s = first.total_time_s + last.total_time_s + 60.0;
    assert!(near(&several["total_time_s"], whole_s), "{several}");
    let sentence = summary["answer"]["sentence"].as_str().unwrap();
    assert!(
        sentence.starts_with("Run coarse, then fine on ") && sentence.ends_with("are kept."),
        "{sentence}"
    );
    for tool in tools {
        let program = report.join(tool["program"].as_str().unwrap());
        let text = fs::read_to_string(&program).unwrap();
        assert!(text.contains("number 47-11"), "{text:.400}");
    }
    let alone = several["alone"].as_array().unwrap();
    for tool in alone {
        let name = tool["name"].as_str().unwrap();
        let own = removal(dir, &format!("alone/{name}/tools/{name}/removal"));
        assert!(
            near(&tool["rms_nm"], own.rms_nm)
                && near(&tool["time_with_change_s"], own.total_time_s + 30.0)
        );
        assert!(report.join(tool["report"].as_str().unwrap()).is_file());
    }
    assert_eq!(alone.len(), 2);
    let chosen: Vec<&Value> =
        several["subsets"].as_array().unwrap().iter().filter(|s| s["is_chosen"] == true).collect();
    assert_eq!(chosen.len(), 1);
    assert_eq!(chosen[0]["tools"], json!(["fine", "coarse"]));
    let rows = fs::read_to_string(report.join("front.csv")).unwrap();
    let executed = rows.lines().find(|row| row.contains("coarse + fine, executed")).unwrap();
    assert!(executed.ends_with(",true") && rows.contains("fine alone, executed"), "{rows}");
    let mut page = stage("planish-compare");
    let refused = page.current_dir(dir).args(["report", "out", "--out", "other"]).output().unwrap();
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        text(&refused.stderr)
            .contains("is a run of several tools, whose page is out/report/report.html")
    );
}

#[test]
fn a_bad_setting_or_rack_ends_with_2_and_writes_nothing() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    let cases: [(&[&str], &str); 6] = [
        (&["compare=all"], "compare is 'all'; give yes or no"),
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
