//! The binary from end to end, and the reference mirror where `PLANISH_REFERENCE` names the
//! folder that holds it.

use std::{fs, path::Path, process::Output};

use ndarray::{Array1, Array2};
use planish_handoff::{
    artifact::{self, Manifest},
    npy::ArrayData,
};
use planish_testkit::{mirror::mirror, program::save};
use planish_types::ToolPath;

fn save_axis(dir: &Path, name: &str, start: f64, step: f64, n: usize) {
    save(dir, name, Array1::from_iter((0..n).map(|i| start + step * i as f64)));
}

/// Writes the inputs: a map of 20 x 10 mm, and a Gaussian TIF of 6 x 6 mm.
fn write_inputs(dir: &Path) {
    let surface = dir.join("surface");
    save(&surface, "height_nm", Array2::zeros((21, 41)));
    save_axis(&surface, "x_mm", 0.0, 0.5, 41);
    save_axis(&surface, "y_mm", 0.0, 0.5, 21);
    let tif = dir.join("tif");
    let at = |i: usize| -3.0 + 0.25 * i as f64;
    // A paraboloid of radius 3.05 mm removes out to its last samples, which the overscan follows.
    let rate = |(r, c)| (1.0 - (at(r).powi(2) + at(c).powi(2)) / 3.05_f64.powi(2)).max(0.0);
    let rate = Array2::from_shape_fn((25, 25), rate);
    save(&tif, "rate_nm_per_s", rate);
    save_axis(&tif, "x_mm", -3.0, 0.25, 25);
    save_axis(&tif, "y_mm", -3.0, 0.25, 25);
}

fn run(dir: &Path, arguments: &[&str]) -> Output {
    call(dir, "raster", arguments)
}

fn call(dir: &Path, method: &str, arguments: &[&str]) -> Output {
    planish_testkit::program::stage("planish-toolpath")
        .current_dir(dir)
        .arg(method)
        .args(arguments)
        .output()
        .unwrap()
}

fn read(dir: &Path) -> (ToolPath, Manifest) {
    let loaded = artifact::read::<ToolPath>(dir).unwrap();
    (loaded.value, loaded.manifest.unwrap())
}

const BASIC: [&str; 6] = ["--surface", "surface", "--pitch-mm", "1", "--step-mm", "1"];

/// A tool that removes beside the place where it stands goes the other way, by as much, with the same overscan and the
/// same limit of the pitch.
#[test]
fn a_tool_that_removes_beside_itself_stands_beside_the_aperture() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let made = |method: &str, [x, y]: [f64; 2]| {
        save_axis(&tmp.path().join("tif"), "x_mm", -3.0 + x, 0.25, 25);
        save_axis(&tmp.path().join("tif"), "y_mm", -3.0 + y, 0.25, 25);
        let flags = [&BASIC[..], &["--tif", "tif", "--out", "out", "--force"]].concat();
        let output = call(tmp.path(), method, &flags);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        read(&tmp.path().join("out"))
    };
    for method in ["raster", "maze", "spiral"] {
        let (centred, _) = made(method, [0.0; 2]);
        let (path, manifest) = made(method, [1.5, -0.7]);
        assert_eq!(path.len(), centred.len(), "{method}");
        for (p, q) in path.point_mm().iter().zip(centred.point_mm()) {
            // Rounding of the centroid.
            let is_moved = (p[0] + 1.5 - q[0]).abs() < 1e-9 && (p[1] - 0.7 - q[1]).abs() < 1e-9;
            assert!(is_moved, "{method}: {p:?} for {q:?}");
        }
        let number = |v: &serde_json::Value| v.as_f64().unwrap();
        // Below: rounding of the centroid, as above.
        assert!((number(&manifest.settings["overscan_mm"]) - 3.0).abs() < 1e-9);
        let o = &manifest.outcome;
        assert!((number(&o["pitch_limit"]["tif_size_sixth_mm"]) - 1.0).abs() < 1e-9, "{o}");
        assert!(o["warnings"].to_string().contains("removes (1.500, -0.700) mm from where"), "{o}");
    }
    // Less than half a pixel of the map, 0.25 mm, is not seen; all of the TIF is within the overscan.
    let (_, manifest) = made("raster", [-0.2, 0.2]);
    assert_eq!(manifest.settings["overscan_mm"], 3.2);
    assert_eq!(manifest.outcome["warnings"].as_array().unwrap().len(), 0);
}

#[test]
fn the_overscan_defaults_to_half_the_tif_and_the_manifest_has_the_statistics() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let output = run(tmp.path(), &[&BASIC[..], &["--tif", "tif", "--out", "out"]].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let (path, manifest) = read(&tmp.path().join("out"));
    // x -3 .. 23, y -3 .. 13: 17 lines of 27 nodes.
    assert_eq!(path.point_mm().len(), 17 * 27);
    assert_eq!((path.point_mm()[0], path.point_mm()[26]), ([-3.0, -3.0], [23.0, -3.0]));
    assert_eq!(manifest.settings["overscan_mm"], 3.0);
    let o = &manifest.outcome;
    assert_eq!((&o["points"], &o["passes"], &o["lifts"]), (&459.into(), &17.into(), &0.into()));
    for (key, value) in [("length_mm", 458.0), ("lift_length_mm", 0.0), ("longest_step_mm", 1.0)] {
        // Rounding of coordinates up to 23 mm, summed over 458 segments.
        assert!((o[key].as_f64().unwrap() - value).abs() < 1e-11, "{key}: {o}");
    }
    // Rounding of coordinates of up to 23 mm.
    assert!((o["coverage_mm"].as_f64().unwrap() - 0.5).abs() < 1e-12);
    // 21.5 x 10.5 pixels' area, with pixels of 0.5 mm, over 11 lines of 20 or 21 mm within them.
    assert!((o["effective_pitch_mm"].as_f64().unwrap() - 1.0).abs() < 0.05, "{o}");
    assert_eq!(o["pitch_limit"]["tif_size_sixth_mm"], 1.0);
    assert_eq!(o["warnings"].as_array().unwrap().len(), 0);

    let again = run(tmp.path(), &[&BASIC[..], &["--tif", "tif", "--out", "out"]].concat());
    assert!(String::from_utf8(again.stdout).unwrap().contains("unchanged"));
}

#[test]
fn every_flag_reaches_the_library() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let flags = [
        "--overscan-mm",
        "1.5",
        "--scan",
        "y",
        "--turn",
        "semicircle",
        "--line-origin-mm",
        "-0.25",
        "--out",
        "out",
    ];
    let output = run(tmp.path(), &[&BASIC[..], &flags].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let (path, manifest) = read(&tmp.path().join("out"));
    assert_eq!(path.point_mm()[0], [-1.25, -1.5]);
    assert_eq!(manifest.settings["scan"], "y");
    // The semicircle beyond the end of the first line.
    assert!(path.point_mm().iter().any(|p| (p[1] - 12.0).abs() < 1e-12 && p[0] < 0.0));
}

#[test]
fn every_variant_of_the_raster_is_told_by_its_flags() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let variant = |out: &str, flags: &str| {
        let flags: Vec<&str> = flags.split_whitespace().collect();
        let common = [&BASIC[..], &["--overscan-mm", "1", "--out", out]].concat();
        let output = run(tmp.path(), &[&common[..], &flags].concat());
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        read(&tmp.path().join(out))
    };
    let plain = variant("plain", "").0;
    assert_eq!(variant("zero", "--angle-deg 0").0, plain);
    assert_eq!(variant("right", "--angle-deg 90").0, variant("y", "--scan y").0);
    let (turned, manifest) = variant("turned", "--angle-deg -30");
    let d = turned.displacement_mm(0);
    // Rounding of a slope.
    assert!((d[1] / d[0] + 1.0 / 3.0_f64.sqrt()).abs() < 1e-12, "{d:?}");
    assert_eq!(manifest.settings["scan"]["angle"]["angle_deg"], -30.0);

    // 13 lines of 22 mm.
    let (one, manifest) = variant("one", "--one-directional");
    assert_eq!(manifest.settings["turn"], "lift");
    assert_eq!(manifest.outcome["lifts"], 12);
    let back = |i: &usize| one.displacement_mm(*i)[0] < 0.0;
    assert!((0..one.len()).filter(back).all(|i| !one.tool_on()[i]));
    let (steps, manifest) = variant("steps", "--line-order bi-step --turn semicircle");
    assert_eq!(
        (&manifest.settings["order"], steps.len()),
        (&"bi-step".into(), 13 * 22 + 11 * 4 + 4)
    );
    let (random, manifest) = variant("random", "--line-order random");
    assert_eq!(manifest.settings["order"]["random"]["seed"], 1);
    assert_eq!(manifest.outcome["lifts"], 12);
    assert_eq!(variant("seeded", "--line-order random --seed 1").0, random);
    assert_ne!(variant("other", "--line-order random --seed 2").0, random);

    // A map of zeros has the mean everywhere.
    assert_eq!(variant("flat", "--pitch-range-mm 0.5 2").0.tool_on(), plain.tool_on());
    let ramp = Array2::from_shape_fn((21, 41), |(r, _)| r as f64);
    save(&tmp.path().join("surface"), "height_nm", ramp);
    let (ranged, manifest) = variant("ranged", "--pitch-range-mm 0.5 2");
    assert_eq!(manifest.settings["pitch_range_mm"], serde_json::json!([0.5, 2.0]));
    let mut y: Vec<f64> = ranged.point_mm().iter().map(|p| p[1]).collect();
    y.dedup();
    // Wide where little is removed, down to p / 2 where twice the mean is.
    let (first, last) = (y[1] - y[0], y[y.len() - 1] - y[y.len() - 2]);
    // Rounding of lines of up to 13 mm.
    assert!(first < 2.0 + 1e-12 && first >= last && last > 0.5 - 1e-12, "{y:?}");
}

/// The map is 20 mm long, the overscan 3 mm: the axis x, which reads 10 mm at its origin, would go from 7 to 33 mm.
#[test]
fn the_overscan_says_where_it_leaves_the_travel() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write_inputs(dir);
    let machine = |travel: &str| {
        let limits = "\"max_velocity_mm_per_s\": 20, \"max_acceleration_mm_per_s2\": 100";
        let axes = format!("{{\"name\": \"x\", {limits}{travel}}}, {{\"name\": \"y\", {limits}}}");
        let text =
            format!("{{\"name\": \"bench\", \"part_origin_mm\": [10, 0], \"axes\": [{axes}]}}");
        fs::write(dir.join("machine.json"), text).unwrap();
    };
    let said = |out: &str| {
        let more = ["--tif", "tif", "--machine", "machine.json", "--out", out];
        let output = run(dir, &[&BASIC[..], &more].concat());
        assert_eq!(output.status.code(), Some(0));
        String::from_utf8(output.stderr).unwrap().replace('\n', " ")
    };
    machine("");
    assert!(!said("free").contains("travel"));
    // A machine without travel says nothing of a path, and is no input of it.
    assert!(read(&dir.join("free")).1.inputs.iter().all(|i| i.role != "machine"));
    machine(", \"travel_mm\": [8, 40]");
    let short = said("short");
    for part in [
        "the path leaves the travel of axis x of bench: from 7.000 to 33.000 mm, the travel is 8 to 40 mm, 1.000 mm too \
         far",
        "the clear aperture is from 10.000 to 30.000 mm there, which leaves an overscan of 2.000 mm at most \
         (--overscan-mm)",
        "with part_origin_mm of x moved by 4.000 mm the path is in the middle of the travel",
    ] {
        assert!(short.contains(part), "{part}: {short}");
    }
    assert_eq!(read(&dir.join("free")).0, read(&dir.join("short")).0);
    let strict =
        ["--tif", "tif", "--machine", "machine.json", "--within-travel", "--out", "refused"];
    let refused = run(dir, &[&BASIC[..], &strict].concat());
    assert_eq!(refused.status.code(), Some(2));
    let message = String::from_utf8(refused.stderr).unwrap().replace('\n', " ");
    assert!(message.contains("error: the path leaves the travel of axis x of bench"), "{message}");
    assert!(!dir.join("refused").exists());
    machine(", \"travel_mm\": [12, 31]");
    let small = said("small");
    assert!(small.contains("5.000 mm too far; the clear aperture itself"), "{small}");
    assert!(!small.contains("moved by"), "{small}");
    machine(", \"travel_mm\": [7, 33]");
    assert!(!said("just").contains("travel"));
}

#[test]
fn a_coarse_pitch_is_warned_of() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let flags = ["--surface", "surface", "--tif", "tif", "--pitch-mm", "30", "--step-mm", "1"];
    let output = run(tmp.path(), &[&flags[..], &["--out", "out"]].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("one line only") && said.contains("sixth of the TIF"), "{said}");
    assert_eq!(read(&tmp.path().join("out")).1.outcome["warnings"].as_array().unwrap().len(), 2);
}

#[test]
fn bad_input_ends_with_2_a_message_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let with = |pitch, step, rest: &[&'static str]| {
        [&["--surface", "surface", "--pitch-mm", pitch, "--step-mm", step], rest].concat()
    };
    let cases = [
        (with("1", "1", &[]), "--tif"),
        (with("0", "1", &["--overscan-mm", "1"]), "pitch_mm: is 0"),
        (with("-1", "1", &["--overscan-mm", "1"]), "pitch_mm: is -1"),
        (with("1", "NaN", &["--overscan-mm", "1"]), "step_mm: is NaN"),
        (with("1", "1", &["--overscan-mm", "-200"]), "which leaves nothing of the aperture"),
        (with("1e-8", "1", &["--overscan-mm", "1"]), "more than 20000000 segments"),
        (with("1", "1", &["--tif", "surface"]), "rate_nm_per_s"),
        (with("1", "one", &["--overscan-mm", "1"]), "invalid value"),
        (with("1", "1", &["--tif", "tif", "--angle-deg", "inf"]), "angle_deg: is inf"),
        (with("1", "1", &["--tif", "tif", "--angle-deg", "3", "--scan", "x"]), "--scan"),
        (with("1", "1", &["--tif", "tif", "--seed", "3"]), "only --line-order random"),
        (with("1", "1", &["--tif", "tif", "--one-directional", "--turn", "square"]), "need lifts"),
        (
            with("1", "1", &["--tif", "tif", "--line-order", "random", "--turn", "semicircle"]),
            "need lifts",
        ),
        (with("1", "1", &["--tif", "tif", "--pitch-range-mm", "2", "1"]), "smaller pitch first"),
        (with("1", "1", &["--tif", "tif", "--pitch-range-mm", "2"]), "2 values"),
        (
            with(
                "1",
                "1",
                &["--tif", "tif", "--pitch-range-mm", "1", "2", "--line-origin-mm", "0"],
            ),
            "cannot be used with",
        ),
    ];
    for (arguments, message) in cases {
        let output = run(tmp.path(), &[&arguments[..], &["--out", "out"]].concat());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(message), "{arguments:?}: {said}");
        assert!(!tmp.path().join("out").exists(), "{arguments:?}");
    }
}

#[test]
fn a_maze_is_seeded_and_says_what_it_did() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let common = ["--surface", "surface", "--tif", "tif", "--pitch-mm", "1"];
    let maze = |out: &str, flags: &[&str]| {
        let output = call(tmp.path(), "maze", &[&common[..], flags, &["--out", out]].concat());
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        read(&tmp.path().join(out))
    };
    let (path, manifest) = maze("one", &["--seed", "4"]);
    // 20 x 10 mm and 3 mm around: 27 x 17 cells, one left out.
    assert_eq!(path.len(), 27 * 17 - 1);
    assert_eq!(path.point_mm()[0], path.point_mm()[path.len()]);
    let o = &manifest.outcome;
    assert_eq!((&o["cells"], &o["cells_left_out"]), (&459.into(), &1.into()));
    assert_eq!((&o["crossings"], &o["lifts"]), (&0.into(), &0.into()));
    let settings = &manifest.settings;
    assert_eq!((&settings["seed"], &settings["step_mm"]), (&4.into(), &1.0.into()));
    assert_eq!(settings["tree"]["depth-first"]["straightness"], 0.0);
    assert_eq!(maze("again", &["--seed", "4"]).0, path);
    assert_ne!(maze("other", &["--seed", "5"]).0, path);
    let wilson = maze("wilson", &["--tree", "wilson", "--open", "--corner-radius-mm", "0.25"]);
    assert_eq!(wilson.1.settings["step_mm"], 0.25);
    assert_ne!(wilson.0.point_mm()[0], wilson.0.point_mm()[wilson.0.len()]);
    let straight = maze("straight", &["--straightness", "1", "--seed", "4"]);
    let turn = |m: &Manifest| m.outcome["mean_turn_deg"].as_f64().unwrap();
    assert!(turn(&straight.1) < turn(&manifest) - 2.0);
}

#[test]
fn bad_mazes_end_with_2_a_message_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let cases: [(&[&str], &str); 6] = [
        (&["--pitch-mm", "50", "--tif", "tif"], "smaller pitch or a larger overscan"),
        (&["--pitch-mm", "1"], "--tif"),
        (&["--pitch-mm", "1", "--tif", "tif", "--corner-radius-mm", "0.6"], "at most half"),
        (&["--pitch-mm", "1", "--tif", "tif", "--straightness", "-1"], "straightness: is -1"),
        (
            &["--pitch-mm", "1", "--tif", "tif", "--tree", "wilson", "--straightness", "0.5"],
            "depth-first",
        ),
        (&["--pitch-mm", "1", "--tif", "tif", "--seed", "x"], "invalid value"),
    ];
    for (flags, message) in cases {
        let arguments = [&["--surface", "surface"], flags, &["--out", "out"]].concat();
        let output = call(tmp.path(), "maze", &arguments);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(message), "{arguments:?}: {said}");
        assert!(!tmp.path().join("out").exists(), "{arguments:?}");
    }
}

#[test]
fn a_spiral_covers_the_map() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    let flags = [&BASIC[..], &["--tif", "tif", "--out", "out"]].concat();
    let output = call(tmp.path(), "spiral", &flags);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let (path, manifest) = read(&tmp.path().join("out"));
    // Half the diagonal of 20 x 10 mm, and 3 mm.
    let end = path.point_mm()[path.len()];
    // Rounding. Regression bound: no difference was seen.
    assert!(((end[0] - 10.0).hypot(end[1] - 5.0) - 125_f64.sqrt() - 3.0).abs() < 1e-9);
    assert_eq!(manifest.outcome["crossings"], 0);
    let flags = ["--surface", "surface", "--pitch-mm", "0", "--step-mm", "1"];
    let bad = call(tmp.path(), "spiral", &[&flags[..], &["--tif", "tif", "--out", "bad"]].concat());
    assert_eq!(bad.status.code(), Some(2));
    assert!(!tmp.path().join("bad").exists());
}

#[test]
fn inspect_prints_the_statistics_of_any_path() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    // Two lines that cross, by hand and without a manifest.
    let dir = tmp.path().join("path");
    let points = [[0.0, 0.0], [20.0, 0.0], [20.0, 10.0], [10.0, -5.0]];
    save(&dir, "point_mm", Array2::from(points.to_vec()));
    let middles = [[10.0, 0.0], [20.0, 5.0], [15.0, 2.5]];
    save(&dir, "dwell_point_mm", Array2::from(middles.to_vec()));
    let on = ArrayData::U8(Array1::from(vec![1, 1, 1]).into_dyn().into());
    fs::write(dir.join("tool_on.npy"), on.to_npy()).unwrap();
    let pass = ArrayData::I64(Array1::from(vec![0, 0, 0]).into_dyn().into());
    fs::write(dir.join("pass_idx.npy"), pass.to_npy()).unwrap();
    let machine = r#"{"name": "m", "axes": [
        {"name": "x", "max_velocity_mm_per_s": 10, "max_acceleration_mm_per_s2": 1},
        {"name": "y", "max_velocity_mm_per_s": 5, "max_acceleration_mm_per_s2": 1}]}"#;
    fs::write(tmp.path().join("m.json"), machine).unwrap();
    let flags = ["--tool-path", "path", "--surface", "surface", "--machine", "m.json"];
    let output = call(tmp.path(), "inspect", &flags);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&found["points"], &found["crossings"]), (&4.into(), &1.into()));
    // 20 / 10 + 10 / 5 + max(10 / 10, 15 / 5) s.
    assert_eq!(found["least_time_s"], 7.0);
    assert_eq!(found["longest_step_mm"], 20.0);
}

#[test]
fn a_picture_is_written_once() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    run(tmp.path(), &[&BASIC[..], &["--overscan-mm", "1", "--out", "path"]].concat());
    let flags = ["--tool-path", "path", "--surface", "surface", "--out", "path.svg"];
    let output = call(tmp.path(), "draw", &flags);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let picture = fs::read_to_string(tmp.path().join("path.svg")).unwrap();
    assert!(picture.starts_with("<svg") && picture.trim_end().ends_with("</svg>"));
    let again = call(tmp.path(), "draw", &flags);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8(again.stderr).unwrap().contains("--force"));
    assert_eq!(
        call(tmp.path(), "draw", &[&flags[..], &["--force"]].concat()).status.code(),
        Some(0)
    );
    // Directories are made as for an artifact, where they can be.
    for (out, code) in [("new/deep/path.svg", 0), ("/proc/planish/path.svg", 2)] {
        let output = call(tmp.path(), "draw", &["--tool-path", "path", "--out", out]);
        assert_eq!(output.status.code(), Some(code), "{output:?}");
    }
}

#[test]
fn the_lines_of_the_published_raster_come_back() {
    let Some(mirror) = mirror() else { return };
    let tmp = tempfile::tempdir().unwrap();
    let flags = ["--pitch-mm", "1", "--step-mm", "1", "--overscan-mm", "5", "--out", "out"];
    let origin = ["--line-origin-mm", "-4.329889", "--surface"];
    let output =
        run(tmp.path(), &[&flags[..], &origin, &[mirror.dir().to_str().unwrap()]].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let (path, _) = read(&tmp.path().join("out"));

    // Published: from the largest y, from left to right; ours is its reverse, which also starts
    // on the left (26 lines).
    let published = mirror.map("raster_path_mm");
    let published: Vec<_> = published.outer_iter().rev().map(|p| [p[0], p[1]]).collect();
    let lines = |points: &[[f64; 2]]| {
        let mut lines: Vec<f64> = points.iter().map(|p| p[1]).collect();
        lines.dedup();
        lines
    };
    let (ours, theirs) = (lines(path.point_mm()), lines(&published));
    assert_eq!((ours.len(), theirs.len()), (26, 26));
    for (a, b) in ours.iter().zip(&theirs) {
        // The origin was given to 1e-6 mm.
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
    // Published nodes: -5 .. 97 in steps of 1. Ours: the region ends at 92.33167 + 5, in equal
    // steps of at most 1.
    let n = 103;
    let step = (92.33167 + 10.0) / f64::from(n);
    for (i, p) in path.point_mm().iter().enumerate() {
        let (line, k) = (i / 104, (i % 104) as f64);
        let x = if line % 2 == 0 { -5.0 + k * step } else { 97.33167 - k * step };
        // x_mm is given to 1e-5 mm.
        assert!((p[0] - x).abs() < 1e-5, "{i}: {p:?}");
    }
    assert_eq!(path.point_mm().len(), 26 * 104);
}

#[test]
fn a_path_of_one_point_but_for_rounding_is_drawn() {
    let tmp = tempfile::tempdir().unwrap();
    for (name, beyond) in [("point", 0.0), ("rounding", 1e-14)] {
        let dir = tmp.path().join(name);
        let points = Array2::from_shape_fn((3, 2), |(i, _)| 7.0 + beyond * i as f64);
        save(&dir, "dwell_point_mm", points.slice(ndarray::s![..2, ..]).to_owned());
        save(&dir, "point_mm", points);
        let output =
            call(tmp.path(), "draw", &["--tool-path", name, "--out", &format!("{name}.svg")]);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let svg = fs::read_to_string(tmp.path().join(format!("{name}.svg"))).unwrap();
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        // A frame of 1 mm about it, with round numbers.
        assert!(svg.contains(">7</text>") && svg.contains(">6.8</text>"), "{svg}");
    }
}

#[test]
fn passes_repeat_any_path_there_and_back() {
    let tmp = tempfile::tempdir().unwrap();
    write_inputs(tmp.path());
    run(tmp.path(), &[&BASIC[..], &["--overscan-mm", "2", "--out", "once"]].concat());
    let ended = call(
        tmp.path(),
        "passes",
        &["--tool-path", "once", "--passes", "4", "--return", "--out", "out"],
    );
    assert_eq!(ended.status.code(), Some(0), "{}", String::from_utf8_lossy(&ended.stderr));
    let ((once, _), (path, manifest)) =
        (read(&tmp.path().join("once")), read(&tmp.path().join("out")));
    assert_eq!((path.len(), manifest.method.as_str()), (4 * once.len(), "passes"));
    // Every pass but the first is that before it, backwards.
    for (i, p) in path.dwell_point_mm().iter().enumerate() {
        let (pass, k) = (i / once.len(), i % once.len());
        let k = if pass % 2 == 1 { once.len() - 1 - k } else { k };
        assert_eq!(*p, once.dwell_point_mm()[k], "{i}");
    }
    let ended =
        call(tmp.path(), "passes", &["--tool-path", "once", "--passes", "1", "--out", "no"]);
    let said = String::from_utf8(ended.stderr).unwrap();
    assert_eq!(ended.status.code(), Some(2), "{said}");
    assert!(said.contains("passes: are 1; give 2 to"), "{said}");
    assert!(!tmp.path().join("no").exists());
}

/// A cylinder of 12 mm that is curved along x, on the map of 20 x 10 mm: 56 degrees steep at its ends.
#[test]
fn pitch_and_step_count_along_the_surface_of_a_form() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write_inputs(dir);
    let file = r#"{"kind": "cylinder", "radius_mm": 12, "vertex_mm": [10, 5]}"#;
    fs::write(dir.join("form.json"), file).unwrap();
    let lines = ["--scan", "y", "--overscan-mm", "1", "--form", "form.json", "--out", "out"];
    let output = run(dir, &[&BASIC[..], &lines[..]].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let (path, manifest) = read(&dir.join("out"));
    let mut arcs: Vec<f64> = (0..path.len())
        .filter(|i| path.displacement_mm(*i)[0].abs() < 1e-9)
        .map(|i| path.dwell_point_mm()[i][0])
        .filter(|x| (0.0..=20.0).contains(x))
        .map(|x| 12.0 * ((x - 10.0) / 12.0).asin())
        .collect();
    arcs.sort_by(f64::total_cmp);
    arcs.dedup_by(|a, b| (*a - *b).abs() < 1e-6);
    assert!(arcs.len() >= 23, "{arcs:?}");
    // Arcs on a cylinder keep 1e-10 mm (planish-form, development.rs).
    assert!(arcs.windows(2).all(|pair| (pair[1] - pair[0] - 1.0).abs() < 1e-9), "{arcs:?}");
    let form = &manifest.outcome["form"];
    let longest = form["along_surface"]["longest_step_mm"].as_f64().unwrap();
    // As above.
    assert!(longest <= 1.0 + 1e-9, "{longest}");
    // 1 / cos at 10 mm of 12 mm.
    let ratio = form["largest_over_projection"].as_f64().unwrap();
    // Rounding of a cosine.
    assert!((ratio - 12.0 / 44_f64.sqrt()).abs() < 1e-9, "{ratio}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("up to 80.9 % longer than their projections"), "{said}");

    // The same numbers of a path that exists.
    let inspect = ["--tool-path", "out", "--surface", "surface", "--form", "form.json"];
    let found = call(dir, "inspect", &inspect);
    let found: serde_json::Value = serde_json::from_slice(&found.stdout).unwrap();
    let again = found["form"]["along_surface"]["length_mm"].as_f64().unwrap();
    // Some 500 lengths of segments, each to 1e-10 mm twice.
    assert!((again - form["along_surface"]["length_mm"].as_f64().unwrap()).abs() < 1e-6);

    // A path in projection over a map with a form beside it: a warning with the remedy.
    fs::copy(dir.join("form.json"), dir.join("surface/form.json")).unwrap();
    let output = run(dir, &[&BASIC[..], &["--overscan-mm", "1", "--out", "flat"]].concat());
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(
        said.contains("give --form surface/form.json, and they count along the surface"),
        "{said}"
    );
    for method in ["spiral", "maze", "random-adaptive"] {
        let out = format!("out-{method}");
        let base = if method == "random-adaptive" { &BASIC[..4] } else { &BASIC[..] };
        let more = ["--overscan-mm", "1", "--form", "form.json", "--out", &out];
        let output = call(dir, method, &[base, &more[..]].concat());
        assert_eq!(output.status.code(), Some(0), "{method}: {output:?}");
        let (_, manifest) = read(&dir.join(&out));
        // Along a cylinder it is 1; a difference over 1e-3 mm is exact to 1e-7.
        assert!(manifest.outcome["form"]["stretches"][0].as_f64().unwrap() > 0.999_999, "{method}");
    }
    // A form that ends within the part.
    let file = r#"{"kind": "cylinder", "radius_mm": 9.8, "vertex_mm": [10, 5]}"#;
    fs::write(dir.join("small.json"), file).unwrap();
    let small = ["--overscan-mm", "1", "--form", "small.json", "--out", "refused"];
    let output = run(dir, &[&BASIC[..], &small[..]].concat());
    assert_eq!(output.status.code(), Some(2));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(
        said.contains("small.json: form[0, 0]: is invalid or absent at (0.0000, 0.0000) mm"),
        "{said}"
    );
    let missing = ["--overscan-mm", "1", "--form", "nowhere.json", "--out", "refused"];
    let output = run(dir, &[&BASIC[..], &missing[..]].concat());
    assert_eq!(output.status.code(), Some(2));
}
