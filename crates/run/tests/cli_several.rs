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

/// Price of a second of the tools of the rack.
const PRICE_NM2_PER_S: f64 = 1e-2;

fn entry(name: &str, pitch_mm: f64) -> Value {
    json!({
        "name": name,
        "tif": name,
        "pitch_mm": pitch_mm,
        "time_weight_nm2_per_s": PRICE_NM2_PER_S,
        "change_s": 30.0,
    })
}

fn write_rack(dir: &Path, rack: &Value) {
    fs::write(dir.join("lab/rack.json"), rack.to_string()).unwrap();
}

fn run(dir: &Path, more: &[&str]) -> Output {
    let settings = ["run", "several", "surface=mirror", "rack=lab/rack.json", "out=out"];
    let mut command = stage("planish-run");
    command.current_dir(dir).args(settings).args(more).output().unwrap()
}

/// Runs `next-run` with these settings.
fn next_run(dir: &Path, settings: &[&str]) -> Output {
    stage("planish-run").current_dir(dir).arg("next-run").args(settings).output().unwrap()
}

/// Returns the map of a directory.
fn surface(place: &Path) -> Surface {
    artifact::read::<Surface>(place).unwrap().value
}

/// Returns the rack of the tests with set-up errors of the coarse tool, after which the part is measured.
fn with_setup_errors() -> Value {
    let mut coarse = entry("coarse", 4.0);
    coarse["setup_shift_mm"] = json!([0.3, 0.3]);
    coarse["setup_rate_fraction"] = json!(0.03);
    coarse["measured_after"] = json!(true);
    json!({ "tools": [entry("fine", 1.5), coarse] })
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
    let more = [
        "machine=machine.json",
        "export=galil",
        "compare=yes",
        "price_factors=4",
        "part_number=47-11",
    ];
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

/// Checks the page of the run: the tools in their order, what they leave, the subsets, each tool alone, and the plan at
/// four times the prices. `last` is the outcome of the removal by the last tool.
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
    let others = several["others"].as_array().unwrap();
    let labels: Vec<&Value> = others.iter().map(|other| &other["label"]).collect();
    assert_eq!(labels, ["coarse", "fine", "prices=4"]);
    for other in others {
        let label = other["label"].as_str().unwrap();
        let names: Vec<&str> =
            other["tools"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
        let executed: Vec<RemovalOutcome> = names
            .iter()
            .map(|name| removal(dir, &format!("others/{label}/tools/{name}/removal")))
            .collect();
        let rms_nm = executed[names.len() - 1].rms_nm;
        let time_s = executed.iter().map(|tool| tool.total_time_s + 30.0).sum();
        assert!(near(&other["rms_nm"], rms_nm), "{other}");
        assert!(near(&other["time_with_changes_s"], time_s), "{other}");
        // Half the mean square, and the price of every second; the rack has no set-up errors.
        let cost_nm2 = 0.5 * rms_nm * rms_nm + PRICE_NM2_PER_S * time_s;
        assert!(near(&other["cost_nm2"], cost_nm2), "{other} {cost_nm2}");
        assert!(report.join(other["report"].as_str().unwrap()).is_file());
    }
    // A second costs more, so the plan takes less time.
    let dearer_s = others[2]["time_with_changes_s"].as_f64().unwrap();
    assert!(dearer_s < whole_s, "{dearer_s} {whole_s}");
    let chosen: Vec<&Value> =
        several["subsets"].as_array().unwrap().iter().filter(|s| s["is_chosen"] == true).collect();
    assert_eq!(chosen.len(), 1);
    assert_eq!(chosen[0]["tools"], json!(["fine", "coarse"]));
    let rows = fs::read_to_string(report.join("front.csv")).unwrap();
    let executed = rows.lines().find(|row| row.contains("coarse + fine, executed")).unwrap();
    assert!(executed.ends_with(",true") && rows.contains("\"fine, executed\""), "{rows}");
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
    let cases: [(&[&str], &str); 10] = [
        (&["price_factors=2,-1"], "price_factors has '-1'; give numbers above 0"),
        (&["compare=all"], "compare is 'all'; give yes or no"),
        (&["specification=limits.json"], "several takes no specification: it plans heights"),
        (&["form=form.json"], "several takes no form: its part is flat"),
        (&["varying=time"], "several takes no varying: give the directory of the tool that varies"),
        (&["export=galil"], "export=galil writes programs for the machine that will run them"),
        (&["speed=1"], "'speed=1' is no setting of several"),
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
    let weak = tif(1.5);
    write(dir, "lab/weak", &Tif::new(*weak.grid(), weak.rate_nm_per_s() * 1e-7).unwrap());
    let mut off = entry("fine", 1.5);
    off["setup_rate_fraction"] = json!(3.0);
    let mut curved = entry("fine", 1.5);
    curved["machine"] = json!("five-axes.json");
    fs::copy(
        workspace().join("fixtures/machines/bonnet-five-axis.json"),
        dir.join("lab/five-axes.json"),
    )
    .unwrap();
    let racks = [
        (json!([entry("weak", 1.5), entry("coarse", 4.0)]), "more than a factor of 1e6 apart"),
        (json!([off]), "tool \"fine\": setup_rate_fraction is 3; give it relative to the rate"),
        (json!([curved]), "several tools are planned for machines with the axes x and y"),
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

#[test]
fn a_run_goes_on_after_its_first_tool_with_the_measured_map() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    write_rack(dir, &with_setup_errors());
    let output = run(dir, &["machine=machine.json"]);
    let printed = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{printed}\n{}", text(&output.stderr));
    let table = fs::read_to_string(dir.join("out/table.txt")).unwrap();
    assert!(table.contains(" nm) are left for fine, which then dwells up to "), "{table}");
    let (plan, place) = manifest(dir, "tools/coarse/plan/fine", &kind::DWELL);
    let plan: PlanOutcome<SeveralReport> = plan.read_outcome(&place, "").unwrap();
    let plan = plan.report.unwrap();
    let reserve = plan.tools.iter().find_map(|tool| tool.reserve.clone()).unwrap();
    assert!(reserve.mean_nm > 0.0 && reserve.largest_nm >= reserve.mean_nm, "{reserve:?}");
    assert_eq!(reserve.errors_of, ["coarse"]);

    // The coarse tool removed 3 % more than it should, one pixel beside its place.
    let before = surface(&dir.join("out/surface"));
    let left = surface(&dir.join("out/tools/fine/map"));
    let removed = before.height_nm() - left.height_nm();
    let off = Array2::from_shape_fn(removed.dim(), |(r, c)| {
        before.height_nm()[[r, c]] - 1.03 * removed[[r, c.saturating_sub(1)]]
    });
    write(dir, "measured", &Surface::new(*before.grid(), off).unwrap());
    let output = next_run(dir, &["run=out", "after=measured", "out=next"]);
    let printed = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{printed}\n{}", text(&output.stderr));
    assert!(printed.contains("measured after coarse: "), "{printed}");
    let table = fs::read_to_string(dir.join("next/table.txt")).unwrap();
    assert!(table.contains(" nm are kept, at "), "{table}");
    assert!(!dir.join("next/tools/coarse").exists());
    let after = surface(&dir.join("next/after"));
    println!("after: {} nm, planned {} nm", after.statistics().rms, plan.model_rms_nm);
    // Within 10 % of the plan: 5 % of the motion, and what the reserve mends.
    assert!(after.statistics().rms <= 1.1 * plan.model_rms_nm, "{table}");

    // A second time it changes nothing, and its own last tool ends it.
    let again = next_run(dir, &["run=out", "after=measured", "out=next"]);
    assert_eq!(again.status.code(), Some(0), "{}", text(&again.stderr));
    let shifted = grid(12.0).moved([3.0, 0.0]).unwrap();
    write(dir, "elsewhere", &Surface::new(shifted, before.height_nm().clone()).unwrap());
    let cases: [(&[&str], &str); 8] = [
        (&["run=next", "after=measured"], "fine is the last tool of the run, which is complete"),
        (&["run=out", "after=measured", "done=fine"], "fine is the last tool of the run"),
        (&["run=out", "after=measured", "done=pad"], "its tools are coarse, fine"),
        (&["run=out", "after=nosuch"], "after nosuch is not there; give the map"),
        (&["run=out", "after=elsewhere"], "it is the map of another part, or lies elsewhere"),
        (&["run=out"], "after is not given; give run=DIR after=MAP"),
        (&["run=lab", "after=measured"], "lab has no several.json"),
        (&["run=out", "after=measured", "machine=machine.json"], "is decided by the run"),
    ];
    for (settings, expected) in cases {
        let output = next_run(dir, &[settings, &["out=refused"]].concat());
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(expected), "no {expected:?} in: {message}");
        assert!(!dir.join("refused").exists(), "{expected}");
    }

    let drawn = ["tolerance", "run=out", "draws=4", "out=draws"];
    let output = stage("planish-run").current_dir(dir).args(drawn).output().unwrap();
    let printed = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{printed}\n{}", text(&output.stderr));
    assert!(printed.contains("residual of the plan kept in 4 of 4"), "{printed}");
    let report = fs::read_to_string(dir.join("draws/fine/manifest.json")).unwrap();
    let report: Value = serde_json::from_str(&report).unwrap();
    let draws = &report["outcome"]["report"]["setup_draws"];
    let below = |which: &str| draws[which]["below_95_percent_nm"].as_f64().unwrap();
    assert!(below("with_maps") < below("without_maps"), "{draws}");
}

#[test]
fn the_file_of_an_instrument_is_imported_first() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    let map = surface(&dir.join("mirror"));
    let rows = map.height_nm().outer_iter();
    let rows = rows.map(|row| row.iter().map(f64::to_string).collect::<Vec<_>>().join(","));
    fs::write(dir.join("mirror.csv"), rows.collect::<Vec<_>>().join("\n")).unwrap();
    let settings = ["run", "several", "surface=mirror.csv", "rack=lab/rack.json", "out=out"];
    let with = |more: &[&str]| {
        stage("planish-run").current_dir(dir).args(settings).args(more).output().unwrap()
    };
    let output = with(&[
        "machine=machine.json",
        "surface_settings=--unit nm --pixel-mm 0.5 --origin centre --first-row bottom",
    ]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(dir.join("out/after/height_nm.npy").exists());
    let imported = surface(&dir.join("out/import/surface"));
    let apart = imported.height_nm() - map.height_nm();
    // Rounding of a few hundred nm in units of the file.
    assert!(apart.iter().all(|nm| nm.abs() < 1e-9), "{apart}");
    assert_eq!(imported.grid().x.start_mm(), -12.0);
}

#[test]
fn doubts_about_the_rack_come_before_the_run() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    // Effective area 4 pi sigma^2 = 1017 mm^2 on a part of 576 mm^2, and waves of 2 pi / 0.9 = 7 mm that it does not
    // reach: 1 % of its transfer function is at 2.07 sigma = 18.6 mm.
    write(dir, "lab/coarse", &tif(9.0));
    write_rack(dir, &json!({ "tools": [entry("coarse", 9.0)] }));
    fs::create_dir(dir.join("out")).unwrap();
    fs::write(dir.join("out/mine"), "").unwrap();
    let output = run(dir, &["machine=machine.json"]);
    // The directory of somebody else is refused after the doubts, and nothing is written.
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains("tool \"coarse\": is wider than the part"), "{message}");
    assert!(message.contains("no tool of the rack reaches them"), "{message}");
    assert_eq!(fs::read_dir(dir.join("out")).unwrap().count(), 1);
}

#[test]
fn a_tool_that_varies_over_the_part_is_planned_and_one_that_varies_in_time_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    // The rate of the coarse tool falls by a fifth from left to right, or in a thousand seconds.
    fs::write(dir.join("by-x.txt"), "-12 1\n12 0.8\n").unwrap();
    fs::write(dir.join("by-time.txt"), "0 1\n1000 0.8\n").unwrap();
    let tool = |arguments: &[&str]| {
        let output = stage("planish-tool").current_dir(dir).args(arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    };
    let place = ["rate", "--by=x", "--table=by-x.txt", "--surface=mirror"];
    tool(&[&place[..], &["--tif=lab/coarse", "--out=lab/by-x"]].concat());
    tool(&["time", "--table=by-time.txt", "--tif=lab/coarse", "--out=lab/by-time"]);
    let rack = |tif: &str| {
        let mut coarse = entry("coarse", 4.0);
        coarse["tif"] = json!(tif);
        write_rack(dir, &json!({ "tools": [entry("fine", 1.5), coarse] }));
    };
    rack("by-time");
    let output = run(dir, &["machine=machine.json"]);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains("tool \"coarse\": ") && message.contains("time"), "{message}");
    assert!(!dir.join("out").exists());
    rack("by-x");
    let output = run(dir, &["machine=machine.json", "choose=no"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let (plan, place) = manifest(dir, "tools/coarse/plan/fine", &kind::DWELL);
    let plan: PlanOutcome<SeveralReport> = plan.read_outcome(&place, "").unwrap();
    let planned_nm = plan.report.unwrap().model_rms_nm;
    let executed_nm = removal(dir, "tools/fine/removal").rms_nm;
    println!("executed {executed_nm} nm, planned {planned_nm} nm");
    // As for tools that do not vary.
    assert!(executed_nm <= 1.05 * planned_nm, "{executed_nm} {planned_nm}");
}

#[test]
fn a_tool_with_a_path_over_half_of_the_part_says_what_it_does_not_reach() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    // A path of the fine tool over the left half alone.
    let map = surface(&dir.join("mirror"));
    let half = Array2::from_shape_fn(map.height_nm().dim(), |(r, c)| {
        if c < 24 { map.height_nm()[[r, c]] } else { f64::NAN }
    });
    write(dir, "half", &Surface::new(*map.grid(), half).unwrap());
    let flags = ["raster", "--surface=half", "--tif=lab/fine", "--pitch-mm=1.5", "--step-mm=1.5"];
    let output =
        stage("planish-toolpath").current_dir(dir).args(flags).arg("--out=lab/left").output();
    assert_eq!(output.unwrap().status.code(), Some(0));
    let mut fine = entry("fine", 1.5);
    fine["tool_path"] = json!("left");
    write_rack(dir, &json!({ "tools": [fine, entry("coarse", 4.0)] }));
    let output = run(dir, &["machine=machine.json", "choose=no"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let table = fs::read_to_string(dir.join("out/table.txt")).unwrap();
    let line = table.lines().find(|line| line.contains("  fine does not reach "));
    let words: Vec<&str> = line.expect(&table).split_whitespace().collect();
    let percent: f64 = words[4].parse().unwrap();
    // The path ends half a tool beyond its half, at 6 mm of 12 mm, and reaches three sigma further.
    assert!((1.0..50.0).contains(&percent), "{table}");
    assert!(!table.contains("coarse does not reach"), "{table}");
}
