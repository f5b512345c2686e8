//! `planish-dwell several-tools` from its rack to its files and exit codes.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::{artifact, npy::ArrayData};
use planish_testkit::program::{save_array, stage, text, write};
use planish_types::{Axis, DwellTime, Grid, Surface, Tif, ToolPath};
use serde_json::{Value, json};

/// Returns the grid of the map: 12 x 8 mm in pixels of 0.25 mm.
fn map_grid() -> Grid {
    Grid { x: Axis::new(0.0, 0.25, 49).unwrap(), y: Axis::new(0.0, 0.25, 33).unwrap() }
}

/// Returns a Gaussian TIF of 5 nm/s with this sigma, mm, out to four of them.
fn tif(sigma_mm: f64) -> Tif {
    let half = (16.0 * sigma_mm).round();
    let a = Axis::new(-0.25 * half, 0.25, 2 * half as usize + 1).unwrap();
    let g = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let square = g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2);
        5.0 * (-square / (2.0 * sigma_mm * sigma_mm)).exp()
    });
    Tif::new(g, rate).unwrap()
}

/// Returns a raster over the map and one step around it, with steps and lines this far apart, mm.
fn path(pitch_mm: f64) -> ToolPath {
    let [nx, ny] = [12.0, 8.0].map(|size: f64| (size / pitch_mm).round() as usize + 2);
    let mut points = Vec::new();
    for j in 0..=ny {
        for i in 0..=nx {
            let i = if j % 2 == 0 { i } else { nx - i };
            points.push([pitch_mm * (i as f64 - 1.0), pitch_mm * (j as f64 - 1.0)]);
        }
    }
    let n = points.len() - 1;
    ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
}

fn entry(name: &str, which: &str) -> Value {
    json!({
        "name": name,
        "tif": format!("{which}-tif"),
        "tool_path": format!("{which}-path"),
        "time_weight_nm2_per_s": 1e-3,
    })
}

/// Writes a map, two tools with their paths, and their rack, into a directory beside the one in which the program runs.
fn prepare(dir: &Path) {
    let g = map_grid();
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.coordinate_mm(c) - 6.0, g.y.coordinate_mm(r) - 4.0);
        40.0 + 0.5 * x * x + 0.3 * y * y + 3.0 * (1.5 * x).sin() * (1.2 * y).cos()
    });
    write(dir, "surface", &Surface::new(g, height).unwrap());
    for (which, sigma_mm, pitch_mm) in [("fine", 0.75, 1.0), ("coarse", 2.5, 2.0)] {
        write(dir, &format!("tools/{which}-tif"), &tif(sigma_mm));
        write(dir, &format!("tools/{which}-path"), &path(pitch_mm));
    }
    write_rack(dir, &json!({ "tools": [entry("fine", "fine"), entry("coarse", "coarse")] }));
}

fn write_rack(dir: &Path, rack: &Value) {
    fs::write(dir.join("tools/rack.json"), rack.to_string()).unwrap();
}

/// Writes a rack in which the price of a second decides the residual.
fn write_dear_rack(dir: &Path) {
    let tools = ["fine", "coarse"].map(|name| {
        let mut tool = entry(name, name);
        tool["time_weight_nm2_per_s"] = json!(0.1);
        tool
    });
    write_rack(dir, &json!({ "tools": tools }));
}

fn run(dir: &Path, more: &[&str]) -> Output {
    run_command(dir, "several-tools", more)
}

fn run_command(dir: &Path, command: &str, more: &[&str]) -> Output {
    let arguments = [command, "--surface=surface", "--rack=tools/rack.json", "--out=plan"];
    stage("planish-dwell").current_dir(dir).args(arguments).args(more).output().unwrap()
}

fn outcome(dir: &Path, name: &str) -> Value {
    let text = fs::read_to_string(dir.join(format!("plan/{name}/manifest.json"))).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["outcome"].clone()
}

#[test]
fn every_tool_gets_its_dwell_times_and_all_have_one_certificate() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    let output = run(dir, &[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let [fine, coarse] = ["fine", "coarse"].map(|name| outcome(dir, name));
    let [of_fine, of_coarse] = [&fine, &coarse].map(|outcome| &outcome["report"]);
    assert_eq!((&of_fine["tool"], &of_coarse["tool"]), (&json!("fine"), &json!("coarse")));
    assert_eq!(of_fine["tools"], of_coarse["tools"]);
    assert_eq!(of_fine["relative_gap"], of_coarse["relative_gap"]);
    // The wanted gap.
    assert!(of_fine["relative_gap"].as_f64().unwrap() <= 1e-4, "{of_fine}");
    let mut total = 0.0;
    for (k, (name, pitch_mm)) in [("fine", 1.0), ("coarse", 2.0)].into_iter().enumerate() {
        let read = artifact::read::<DwellTime>(&dir.join("plan").join(name)).unwrap().value;
        assert_eq!(read.dwell_s().len(), path(pitch_mm).len());
        let own: f64 = read.dwell_s().iter().sum();
        let stated = of_fine["tools"][k]["total_time_s"].as_f64().unwrap();
        // Rounding of sums of 200 times.
        assert!(own > 0.0 && (own / stated - 1.0).abs() < 1e-13, "{name}: {own} {stated}");
        total += own;
    }
    let stated = of_fine["total_time_s"].as_f64().unwrap();
    assert!((total / stated - 1.0).abs() < 1e-13, "{total} {stated}");
    let printed = text(&output.stdout);
    assert!(printed.contains("2 tools") && printed.contains("  coarse: "), "{printed}");

    let again = run(dir, &[]);
    assert_eq!(again.status.code(), Some(0));
    assert!(text(&again.stdout).contains("unchanged"));
    // Another price is another plan, which does not replace this one by itself.
    let mut dear = entry("fine", "fine");
    dear["time_weight_nm2_per_s"] = json!(1.0);
    write_rack(dir, &json!({ "tools": [dear, entry("coarse", "coarse")] }));
    assert_eq!(run(dir, &[]).status.code(), Some(2));
    assert_eq!(run(dir, &["--force"]).status.code(), Some(0));
    assert_ne!(outcome(dir, "fine")["report"], *of_fine);
}

#[test]
fn a_bad_rack_ends_with_2_and_writes_nothing() {
    let (fine, coarse) = (entry("fine", "fine"), entry("coarse", "coarse"));
    let with = |key: &str, value: Value| {
        let mut tool = coarse.clone();
        tool[key] = value;
        tool
    };
    let both = |tool: Value| json!({ "tools": [fine.clone(), tool] });
    let cases = [
        (json!({ "tools": [] }), "tools/rack.json: has no tools; give at least one"),
        (json!({ "rack": [] }), "tools/rack.json: unknown field `rack`"),
        (
            both(with("name", json!("fine"))),
            "tools[1].name is \"fine\" again; give every tool its own",
        ),
        (both(with("name", json!("FINE"))), "tools[1].name is \"FINE\" again"),
        (
            both(with("name", json!("../out"))),
            "tools[1].name is \"../out\", which names a directory",
        ),
        (both(with("tif", json!("no"))), "tools/no: does not exist; give a tif"),
        (both(with("tool_path", json!("no"))), "tools/no: does not exist; give a tool_path"),
        (both(with("price", json!(1.0))), "unknown field `price`"),
        (
            both(with("tif", json!("zero"))),
            "zero/rate_nm_per_s.npy: rate_nm_per_s: has no positive rate (largest 0 nm/s)",
        ),
        (both(with("tif", json!("weak"))), "(\"fine\"), more than a factor of 1e6 apart"),
        (
            both(with("time_weight_nm2_per_s", json!(-1.0))),
            "tool \"coarse\": time_weight_nm2_per_s: is -1",
        ),
        (both(with("min_dwell_s", json!(-1.0))), "tool \"coarse\": "),
        (
            both(with("change_s", json!(-1.0))),
            "tool \"coarse\": change_s is -1; give a number >= 0",
        ),
        (
            both(with("setup_rate_fraction", json!(3.0))),
            "tool \"coarse\": setup_rate_fraction is 3; give it relative to the rate, 0.03 for 3 %",
        ),
        (
            both(with("setup_shift_mm", json!([0.1, -0.2]))),
            "tool \"coarse\": setup_shift_mm[1] is -0.2; give a number >= 0",
        ),
        (both(with("tool_path", Value::Null)), "tool \"coarse\": has no tool_path; give"),
        (both(with("tool_path", json!("far"))), "tool \"coarse\": none of the"),
    ];
    for (rack, expected) in cases {
        let tmp = tempfile::tempdir().unwrap();
        let dir = tmp.path();
        prepare(dir);
        let zero = dir.join("tools/zero");
        save_array(&zero, "rate_nm_per_s", ArrayData::F64(Array2::zeros((3, 3)).into_dyn().into()));
        for name in ["x_mm", "y_mm"] {
            let a = ndarray::array![-1.0, 0.0, 1.0];
            save_array(&zero, name, ArrayData::F64(a.into_dyn().into()));
        }
        let strong = tif(2.5);
        let weak = Tif::new(*strong.grid(), strong.rate_nm_per_s() * 1e-7).unwrap();
        write(dir, "tools/weak", &weak);
        let points = path(2.0).point_mm().iter().map(|p| [p[0] + 1e3, p[1]]).collect::<Vec<_>>();
        let n = points.len() - 1;
        write(dir, "tools/far", &ToolPath::through(points, vec![true; n], vec![0; n]).unwrap());
        write_rack(dir, &rack);
        let output = run(dir, &[]);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{expected}: {message}");
        assert!(message.contains(expected), "no {expected:?} in: {message}");
        assert!(!dir.join("plan").exists(), "{expected}");
    }
    let mut both_bounds = with("min_dwell_s", json!(0.1));
    both_bounds["min_dwell_s_per_mm"] = json!(0.1);
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    write_rack(tmp.path(), &both(both_bounds));
    let message = text(&run(tmp.path(), &[]).stderr);
    assert!(
        message.contains("tool \"coarse\": has min_dwell_s and min_dwell_s_per_mm"),
        "{message}"
    );
}

#[test]
fn a_tool_wider_than_the_part_causes_a_warning() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    // Effective area 4 pi sigma^2 = 201 mm^2, more than the 96 mm^2 of the map.
    write(dir, "tools/coarse-tif", &tif(4.0));
    let output = run(dir, &[]);
    let message = text(&output.stderr);
    assert!(message.contains("tool \"coarse\": is wider than the part"), "{message}");
    assert_eq!(output.status.code(), Some(0), "{message}");
}

#[test]
fn a_tool_less_leaves_no_old_directory() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    assert_eq!(run(dir, &[]).status.code(), Some(0));
    // A dwell artifact of another method, and a file of the user.
    let foreign = dir.join("plan/mine");
    planish_handoff::save(&foreign, &DwellTime::new(vec![1.0]).unwrap()).unwrap();
    write_rack(dir, &json!({ "tools": [entry("coarse", "coarse")] }));
    let refused = run(dir, &[]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused.stderr));
    assert!(dir.join("plan/fine").exists());
    let output = run(dir, &["--force"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(!dir.join("plan/fine").exists() && foreign.exists());
    assert_eq!(outcome(dir, "coarse")["report"]["tools"].as_array().unwrap().len(), 1);
    assert!(text(&run(dir, &[]).stdout).contains("unchanged"));
    // No temporary directory stays.
    let names = fs::read_dir(dir.join("plan")).unwrap();
    let mut names: Vec<_> = names.map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["coarse", "mine"]);
}

#[test]
fn the_chosen_tools_have_the_plan_of_these_tools_alone() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    // 1000 s at 1e-3 nm^2/s are 1 nm^2, more than the fine tool lowers the cost alone or beside the coarse one.
    let dear = |name: &str, change_s: f64| {
        let mut tool = entry(name, name);
        tool["change_s"] = json!(change_s);
        tool
    };
    for (changes_s, chosen) in [
        ([1e4, 0.0], vec!["coarse"]),
        ([0.0, 1e4], vec!["fine"]),
        ([0.0; 2], vec!["coarse", "fine"]),
    ] {
        let rack = json!({ "tools": [dear("fine", changes_s[0]), dear("coarse", changes_s[1])] });
        write_rack(dir, &rack);
        let output = run_command(dir, "choose-tools", &["--force"]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let names = fs::read_dir(dir.join("plan")).unwrap();
        let mut names: Vec<_> = names.map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, chosen, "{}", text(&output.stdout));
        let report = outcome(dir, chosen[0])["report"].clone();
        let choice = &report["choice"];
        let best = &choice["subsets"][choice["best"].as_u64().unwrap() as usize];
        assert_eq!(best["tools"].as_array().unwrap().len(), chosen.len());
        // The gap of each problem.
        assert!(choice["relative_gap_of_choice"].as_f64().unwrap() <= 1e-4, "{choice}");
        let changes: f64 = if chosen.len() == 2 { changes_s.iter().sum() } else { 0.0 };
        let stated = best["time_with_changes_s"].as_f64().unwrap();
        let total = report["total_time_s"].as_f64().unwrap() + changes;
        // Rounding of a sum of two times.
        assert!((stated / total - 1.0).abs() < 1e-13, "{stated} {total}");
        let printed = text(&output.stdout);
        assert!(printed.contains("chosen: ") && printed.contains(" of 3 solved"), "{printed}");
        let bytes = |name: &str| fs::read(dir.join(format!("plan/{name}/dwell_s.npy"))).unwrap();
        let of_choice: Vec<_> = chosen.iter().map(|name| bytes(name)).collect();
        let alone: Vec<Value> = ["fine", "coarse"]
            .into_iter()
            .filter(|name| chosen.contains(name))
            .map(|name| entry(name, name))
            .collect();
        write_rack(dir, &json!({ "tools": alone }));
        assert_eq!(run(dir, &["--force"]).status.code(), Some(0));
        let again: Vec<_> = chosen.iter().map(|name| bytes(name)).collect();
        assert_eq!(of_choice, again, "{chosen:?}");
    }
}

#[test]
fn waves_that_no_tool_reaches_are_told() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    let both = run(dir, &[]);
    assert!(!text(&both.stderr).contains("no tool reaches them"), "{}", text(&both.stderr));
    // The waves of 2 pi / (1.5^2 + 1.2^2)^(1/2) = 3.3 mm; a Gaussian of sigma 2.5 mm passes 1 % at 2.07 sigma = 5.2 mm.
    write_rack(dir, &json!({ "tools": [entry("coarse", "coarse")] }));
    let message = text(&run(dir, &["--force"]).stderr).to_string();
    let rest = message.split_once("waves shorter than ").expect("a warning").1;
    let wavelength_mm: f64 = rest.split(' ').next().unwrap().parse().unwrap();
    // The frequencies of 12 x 8 mm are 0.08 /mm apart, so that the wavelength is one of steps of a third.
    assert!((3.9..=5.3).contains(&wavelength_mm), "{message}");
}

#[test]
fn set_up_errors_leave_a_reserve_or_are_stated() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    let with_errors = |measured_after: bool| {
        let mut coarse = entry("coarse", "coarse");
        coarse["setup_shift_mm"] = json!([0.2, 0.2]);
        coarse["setup_rate_fraction"] = json!(0.03);
        coarse["measured_after"] = json!(measured_after);
        write_rack(dir, &json!({ "tools": [entry("fine", "fine"), coarse] }));
    };
    with_errors(true);
    let output = run(dir, &["--setup-draws=5", "--seed=3"]);
    let printed = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{printed}\n{}", text(&output.stderr));
    assert!(
        printed.contains(" nm) are left for fine, for the set-up errors of coarse: at"),
        "{printed}"
    );
    let of_fine = outcome(dir, "fine")["report"].clone();
    let reserve = &of_fine["tools"][0]["reserve"];
    assert_eq!(reserve["errors_of"], json!(["coarse"]));
    assert!(reserve["time_s"].as_f64().unwrap() > 0.0 && of_fine["unseen_setup_rms_nm"].is_null());
    let draws = &of_fine["setup_draws"];
    assert_eq!((&draws["runs"], &draws["seed"]), (&json!(5), &json!(3)));
    let below = |which: &str| draws[which]["below_95_percent_nm"].as_f64().unwrap();
    assert!(below("with_maps") < below("without_maps"), "{draws}");
    // The same draws again, and others.
    assert_eq!(run(dir, &["--force", "--setup-draws=5", "--seed=3"]).status.code(), Some(0));
    assert_eq!(&outcome(dir, "fine")["report"]["setup_draws"], draws);
    assert_eq!(run(dir, &["--force", "--setup-draws=5", "--seed=4"]).status.code(), Some(0));
    assert_ne!(&outcome(dir, "fine")["report"]["setup_draws"], draws);

    with_errors(false);
    let output = run(dir, &["--force"]);
    assert!(text(&output.stdout).contains("set-up errors that no map shows add "));
    let of_fine = outcome(dir, "fine")["report"].clone();
    assert!(of_fine["unseen_setup_rms_nm"].as_f64().unwrap() > 0.0, "{of_fine}");
    assert!(of_fine["tools"][0]["reserve"].is_null(), "{of_fine}");
}

#[test]
fn a_residual_is_kept_or_the_exit_code_is_1() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    write_dear_rack(dir);
    assert_eq!(run(dir, &[]).status.code(), Some(0));
    let rms_nm = outcome(dir, "fine")["report"]["model_rms_nm"].as_f64().unwrap();
    let keep = format!("--keep-rms-nm={}", 0.9 * rms_nm);
    let output = run(dir, &["--force", &keep]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let report = outcome(dir, "fine")["report"].clone();
    let factor = report["keeping"]["price_factor"].as_f64().unwrap();
    assert!(factor < 1.0 && report["model_rms_nm"].as_f64().unwrap() <= 0.9 * rms_nm, "{report}");
    let output = run(dir, &["--force", "--keep-rms-nm=1e-6"]);
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert_eq!(outcome(dir, "fine")["report"]["keeping"]["is_kept"], json!(false));
    let output = run(dir, &["--force", "--keep-rms-nm=0"]);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains("keep_rms_nm: is 0; give a number > 0"), "{message}");
}

/// With a weight of the slope, the residual counts more against the price of a second, so that less of it stays.
#[test]
fn slopes_of_the_residual_are_weighed_as_for_one_tool() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    prepare(dir);
    write_dear_rack(dir);
    let rms_nm = |more: &[&str]| {
        let output = run(dir, &[&["--force"], more].concat());
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        outcome(dir, "fine")["report"]["model_rms_nm"].as_f64().unwrap()
    };
    let [plain, sloped] = [&[][..], &["--residual-slope-weight-mm2=5"]].map(rms_nm);
    assert!(sloped < plain, "{sloped} {plain}");
}
