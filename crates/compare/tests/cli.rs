//! Tests of the program `planish-compare` from its flags to its files and exit codes.

use std::{
    fs,
    path::Path,
    process::{self, Command},
};

use ndarray::{Array2, ArrayD, array};
use ndarray_npy::write_npy;
use planish_draw::colour::{BLUE_TO_BROWN, rgb_at};
use planish_handoff::{
    Artifact, Inputs, Output, Status, Task, flags::OutputArgs, kind, npy::ArrayData, save,
};
use planish_numerics::orthogonal::{zernike, zernike_index, zernike_terms};
use planish_testkit::program::text;
use planish_types::{
    AxesMotion, Axis, DwellTime, Grid, Removal, Surface, Tif, ToolPath, Trajectory,
};
use serde_json::{Value, json};

fn compare(dir: &Path, arguments: &[&str]) -> process::Output {
    planish_testkit::program::stage("planish-compare")
        .current_dir(dir)
        .args(arguments)
        .output()
        .unwrap()
}

/// Writes a verdict with this outcome as planish-verify does.
fn save_verdict(dir: &Path, outcome: Value) {
    let args = OutputArgs { out: dir.to_path_buf(), force: true, wall_time: None };
    let task = Task::new("test", "0", "test", &outcome);
    let begin = Output::directory(&args, &kind::VERDICT).begin(&task, &Inputs::new()).unwrap();
    if let Some(mut writer) = begin.writer() {
        writer.write_arrays(&kind::VERDICT, &[], &[], outcome, &Status::Done).unwrap();
    }
}

fn desired() -> Surface {
    let grid = Grid { x: Axis::new(0.0, 0.5, 3).unwrap(), y: Axis::new(0.0, 0.5, 2).unwrap() };
    Surface::new(grid, array![[9.0, 5.0, 9.0], [5.0, 9.0, f64::NAN]]).unwrap()
}

/// Creates a run. Each method (name, fraction, limits kept) removes `fraction` of the desired removal, so that (1 -
/// fraction) of the RMS remains.
fn prepare(run: &Path, methods: &[(&str, f64, bool)]) {
    prepare_of(&desired(), run, methods);
}

fn prepare_of(desired: &Surface, run: &Path, methods: &[(&str, f64, bool)]) {
    save(&run.join("surface"), desired).unwrap();
    for (i, (name, fraction, kept)) in methods.iter().enumerate() {
        let dir = run.join("methods").join(name);
        let removal_nm = desired.height_nm().mapv(|z| if z.is_nan() { 0.0 } else { fraction * z });
        let removal = Removal::new(desired, removal_nm).unwrap();
        let end_s = 60.0 + i as f64;
        let trajectory =
            Trajectory::new(vec![0.0, end_s], vec![[[0.0; 4]; 2]], vec![true], vec![Some(0)])
                .unwrap();
        let outcome = json!({
            "total_time_s": end_s, "max_velocity_mm_per_s": [1.0, 2.0],
            "max_acceleration_mm_per_s2": [3.0, 4.0], "max_velocity_step_mm_per_s": [5.0, 6.0],
            "max_acceleration_step_mm_per_s2": [7.0, 8.0], "limits_respected": kept,
        });
        save(&dir.join("trajectory"), &trajectory).unwrap();
        save(&dir.join("removal"), &removal).unwrap();
        save_verdict(&dir.join("verdict"), outcome);
    }
}

fn summary(dir: &Path) -> Value {
    serde_json::from_slice(&fs::read(dir.join("summary.json")).unwrap()).unwrap()
}

/// Returns the words of the table row that begins with `start`.
fn row(table: &str, start: &str) -> Vec<String> {
    let line = table.lines().find(|l| l.starts_with(start)).expect(table);
    line.split_whitespace().map(String::from).collect()
}

#[test]
fn a_report_writes_the_summary_and_prints_the_table() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("raster");
    prepare(&run, &[("pvt", 0.75, true), ("position", 0.9, false), ("bspline", 0.5, true)]);
    fs::write(run.join("methods/pvt/schedule-wall.json"), r#"{"wall_s": 0.125}"#).unwrap();
    // What a stage that was killed leaves is no method.
    fs::create_dir(run.join("methods/.pvt.123.tmp")).unwrap();
    let report = ["report", "raster", "--out", "report", "--mirror", "coupon"];
    let first = compare(dir.path(), &report);
    assert_eq!(first.status.code(), Some(0), "{}", text(&first.stderr));

    let found = summary(&dir.path().join("report"));
    assert_eq!((&found["pipeline"], &found["fixture"]), (&json!("raster"), &json!("coupon")));
    // Heights 9, 5, 9, 5, 9: mean 7.4, squares 3 * 1.6^2 + 2 * 2.4^2 = 19.2, over 5.
    let rms = (19.2_f64 / 5.0).sqrt();
    // Rounding, and the last bit that the parser of JSON may miss.
    let near = |v: &Value, expected: f64| (v.as_f64().unwrap() - expected).abs() < 1e-13;
    assert!(near(&found["initial"]["rms_nm"], rms), "{found}");
    assert_eq!(found["initial"]["pv_nm"], 4.0);
    assert!(near(&found["methods"]["pvt"]["rms_nm"], 0.25 * rms));
    assert!(near(&found["methods"]["pvt"]["pv_nm"], 1.0));
    assert!(near(&found["without_motion"]["rms_nm"], 0.1 * rms));
    assert_eq!(found["without_motion"]["total_time_s"], 61.0);
    assert_eq!(found["methods"]["pvt"]["max_velocity_step_mm_per_s"], json!([5.0, 6.0]));
    assert_eq!(found["methods"]["pvt"]["schedule_wall_s"], 0.125);
    assert_eq!(found["methods"]["pvt"]["simulate_wall_s"], Value::Null);
    // The answer: heights 2.25 and 1.25 nm remain, 1.25 nm is 0.6 nm below their mean.
    let answer = &found["answer"];
    assert_eq!(answer["method"], "pvt");
    assert_eq!(
        answer["sentence"],
        "pvt runs in 60 s: 1.96 to 0.49 nm RMS, worst -0.6 nm from the mean at x 0.5, y 0.0 mm; \
         the limits of the machine are kept."
    );
    let why = answer["why"].as_str().unwrap();
    let next = "the least RMS of the 2 plans that keep the limits; the next is bspline with 0.98 nm in 62 s.";
    assert!(why.starts_with("pvt, because it leaves ") && why.contains(next), "{why}");
    assert!(
        answer["without_motion"]
            .as_str()
            .unwrap()
            .starts_with("Not a plan: position applies the dwell times")
    );
    assert_eq!(answer["problems"], json!([]));
    let order: Vec<_> = found["methods"].as_object().unwrap().keys().collect();
    assert_eq!(order, ["position", "pvt", "bspline"]);

    let table = text(&first.stdout);
    assert!(table.starts_with(
        "raster, coupon: initial surface 1.9596 nm RMS, 4.00 nm PV; dwell times without"
    ));
    // position has the smallest RMS but not within the limits; pvt is the best of the others.
    assert_eq!(row(&table, "pvt")[1], "0.4899");
    assert_eq!(row(&table, "pvt").last().unwrap(), "*");
    assert!(row(&table, "position").contains(&"no".to_string()));
    assert_eq!(table.matches('*').count(), 2);
    let last: Vec<&str> = table.lines().rev().take(2).collect();
    assert_eq!(last, ["report/report.html", "report/summary.json"]);
    let rows = fs::read_to_string(dir.path().join("report/table.csv")).unwrap();
    let recommended: Vec<&str> = rows.lines().filter(|row| row.ends_with(",true")).collect();
    assert!(recommended.len() == 1 && recommended[0].contains(",pvt,0.48"), "{rows}");

    // Again: nothing to do, and still the table. A lost summary comes back.
    let again = compare(dir.path(), &report);
    assert_eq!(again.status.code(), Some(0));
    assert!(text(&again.stdout).contains("unchanged") && text(&again.stdout).contains("0.4899"));
    fs::remove_file(dir.path().join("report/summary.json")).unwrap();
    assert_eq!(compare(dir.path(), &report).status.code(), Some(0));
    assert_eq!(summary(&dir.path().join("report")), found);

    // A changed method is another report.
    prepare(&run, &[("pvt", 0.8, true)]);
    let refused = compare(dir.path(), &report);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("--force"));
    assert_eq!(summary(&dir.path().join("report")), found);
    let forced = compare(dir.path(), &[&report[..], &["--force"]].concat());
    assert_eq!(forced.status.code(), Some(0));
    assert!(near(&summary(&dir.path().join("report"))["methods"]["pvt"]["rms_nm"], 0.2 * rms));
}

/// Returns the JSON data in the page of a report.
/// Returns a disc of 30 mm radius with a coma along x of 10 nm RMS, and a tilt that removal brings along.
fn coma() -> Surface {
    let axis = Axis::new(-30.0, 1.0, 61).unwrap();
    let grid = Grid { x: axis, y: axis };
    let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let [u, v] = [axis.coordinate_mm(c) / 30.0, axis.coordinate_mm(r) / 30.0];
        let mut z = vec![0.0; zernike_terms(3)];
        zernike(3, u, v, &mut z);
        // The RMS of Z_3^1 on the disc is 1 / sqrt(8).
        if u.hypot(v) > 1.0 {
            f64::NAN
        } else {
            100.0 + 10.0 * 8.0_f64.sqrt() * z[zernike_index(3, 1)]
        }
    });
    Surface::new(grid, height).unwrap()
}

/// Returns a Gaussian TIF with these standard deviations along x and y, mm.
fn gaussian([x_mm, y_mm]: [f64; 2]) -> Tif {
    let axis = Axis::new(-8.0, 0.1, 161).unwrap();
    let grid = Grid { x: axis, y: axis };
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let [u, v] = [axis.coordinate_mm(c) / x_mm, axis.coordinate_mm(r) / y_mm];
        5.0 * (-0.5 * (u * u + v * v)).exp()
    });
    Tif::new(grid, rate).unwrap()
}

#[test]
fn planted_terms_a_known_tool_and_what_the_user_states_are_in_the_report() {
    let dir = tempfile::tempdir().unwrap();
    prepare_of(&coma(), &dir.path().join("run"), &[("pvt", 0.75, true), ("joint", 0.5, true)]);
    save(&dir.path().join("tif"), &gaussian([2.0, 1.5])).unwrap();
    let flags = ["report", "run", "--tif", "tif", "--out", "report", "--quiet"];
    let stated = ["--part-name", "M1 <b>upper", "--date", "2026-03-01"];
    let output = compare(dir.path(), &[&flags[..], &stated].concat());
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let found = summary(&dir.path().join("report"));
    let coefficients = |terms: &Value| -> Vec<(String, f64)> {
        let terms = terms["terms"].as_array().unwrap().iter();
        let named = |t: &Value| {
            (t["name"].as_str().unwrap().to_string(), t["coefficient_nm"].as_f64().unwrap())
        };
        terms.map(named).collect()
    };
    for (terms, coma_nm) in [
        (&found["initial"]["low_order"], 10.0),
        (&found["methods"]["pvt"]["low_order"], 2.5),
        (&found["methods"]["joint"]["low_order"], 5.0),
    ] {
        assert_eq!(terms["family"], "zernike");
        for (name, coefficient) in coefficients(terms) {
            let expected = if name == "coma along x" { coma_nm } else { 0.0 };
            // Rounding of sums over 2800 pixels.
            assert!((coefficient - expected).abs() < 1e-10, "{name}: {coefficient}");
        }
        assert!(terms["rest_rms_nm"].as_f64().unwrap() < 1e-10);
    }
    let tool = &found["tool"];
    let factor = 2.0 * (2.0 * 2.0_f64.ln()).sqrt();
    for (axis, sigma_mm) in [2.0, 1.5].into_iter().enumerate() {
        let width = tool["half_maximum_width_mm"][axis].as_f64().unwrap();
        // Keys' interpolation at 15 samples per sigma: an error of third order, below 1e-4.
        assert!((width / (factor * sigma_mm) - 1.0).abs() < 1e-4, "{tool}");
    }
    let volume = 2.0 * std::f64::consts::PI * 5.0 * 2.0 * 1.5;
    // The tails beyond 4 sigma: 6e-5 of the volume.
    assert!((tool["volume_rate_nm_mm2_per_s"].as_f64().unwrap() / volume - 1.0).abs() < 1e-4);
    assert_eq!(found["part"]["name"], "M1 <b>upper");
    assert_eq!(found["part"]["operator"], Value::Null);

    let rows = fs::read_to_string(dir.path().join("report/front.csv")).unwrap();
    let rows: Vec<&str> = rows.lines().collect();
    assert_eq!(rows.len(), 3, "{rows:?}");
    for (plan, time, rms_nm, end) in
        [("pvt", "60", 2.5, ",true,true,true"), ("joint", "61", 5.0, ",true,false,false")]
    {
        let start = format!("run,{plan},plan,{time},");
        let row = rows.iter().find(|row| row.starts_with(&start)).unwrap();
        let rms: f64 = row.split(',').nth(4).unwrap().parse().unwrap();
        // The rim of a disc of 61 pixels is known to 1 / 61.
        assert!((rms / rms_nm - 1.0).abs() < 1.0 / 61.0 && row.ends_with(end), "{row}");
    }
    let front = fs::read_to_string(dir.path().join("report/front.svg")).unwrap();
    assert!(front.contains("<title>pvt: 2.") && front.contains(" nm in 60 s</title>"), "{front}");
    let page = fs::read_to_string(dir.path().join("report/report.html")).unwrap();
    assert!(
        page.contains("FWHM x 4.71 mm, y 3.53") && page.contains("volume rate 94.2"),
        "the sections of the tool"
    );
    assert!(!page.contains("M1 <b>upper"), "a name is no markup");
    assert_eq!(
        page_data(&dir.path().join("report"))["front"]["csv"].as_str().unwrap().lines().count(),
        3
    );
}

fn page_data(report: &Path) -> Value {
    let page = fs::read_to_string(report.join("report.html")).unwrap();
    let start = page.find("id=\"data\">").unwrap() + "id=\"data\">".len();
    let end = start + page[start..].find("</script>").unwrap();
    serde_json::from_str(&page[start..end]).unwrap()
}

#[test]
fn the_page_holds_the_summary_and_is_the_same_for_the_same_input() {
    let dir = tempfile::tempdir().unwrap();
    // A name that would end the element of the data if it were not escaped.
    prepare(&dir.path().join("a<b"), &[("pvt", 0.75, true), ("position", 0.9, false)]);
    let made = compare(dir.path(), &["report", "a<b", "--out", "one", "--mirror", "</script>"]);
    assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    let data = page_data(&dir.path().join("one"));
    assert_eq!(data["summary"], summary(&dir.path().join("one")));
    let run = &data["runs"][0];
    assert_eq!((&run["fixture"], &run["best"]), (&json!("</script>"), &json!("pvt")));
    assert_eq!(run["methods"][0]["name"], "position");
    assert_eq!(run["desired"]["size"], json!([3, 2]));
    let provenance = run["methods"][1]["provenance"].as_array().unwrap();
    let roles: Vec<_> = provenance.iter().map(|p| p["role"].as_str().unwrap()).collect();
    assert_eq!(roles, ["trajectory", "removal", "verdict"]);
    // Nothing that only the other file system or another time would give.
    let page = fs::read_to_string(dir.path().join("one/report.html")).unwrap();
    assert!(page.contains("<title>Planish: &lt;/script&gt;, a&lt;b</title>"));
    assert!(!page.contains("http:") && !page.contains("https:") && !page.contains("{{"));
    compare(dir.path(), &["report", "a<b", "--out", "two", "--mirror", "</script>"]);
    for file in
        ["report.html", "overview.svg", "maps.svg", "path.svg", "motion.svg", "histogram.svg"]
    {
        let read = |out: &str| fs::read(dir.path().join(out).join(file)).unwrap();
        assert!(read("one") == read("two"), "{file}");
        assert!(file.ends_with(".html") || read("one").starts_with(b"<svg xmlns"));
    }
    // No refinement, and no rectangle of valid pixels that is large enough for a spectrum.
    for file in ["refinement.svg", "spectrum.svg"] {
        assert!(!dir.path().join("one").join(file).exists(), "{file}");
    }
}

#[test]
fn the_dwell_times_of_a_program_are_those_of_its_plan_and_it_executes_none_that_are_known() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("out");
    prepare(
        &run,
        &[("pvt", 0.75, true), ("pvt+refined", 0.8, true), ("pvt+refined+galil", 0.8, true)],
    );
    let path = ToolPath::through(vec![[0.0, 0.0], [1.0, 0.0]], vec![true], vec![0]).unwrap();
    save(&run.join("tool_path"), &path).unwrap();
    let seconds = |s: f64| DwellTime::new(vec![s]).unwrap();
    save(&run.join("dwell"), &seconds(188.6)).unwrap();
    save(&run.join("methods/pvt+refined/dwell"), &seconds(161.2)).unwrap();
    // The motion of the program as planish-import writes it: no segment names a point.
    let motion = Trajectory::new(vec![0.0, 62.0], vec![[[0.0; 4]; 2]], vec![true], vec![None]);
    let args = OutputArgs {
        out: run.join("methods/pvt+refined+galil/trajectory"),
        force: true,
        wall_time: None,
    };
    let task = Task::new("planish-import", "0", "program", json!({}));
    let output = Output::directory(&args, Trajectory::KIND).begin(&task, &Inputs::new()).unwrap();
    output.writer().unwrap().write(&motion.unwrap(), json!({}), &Status::Done).unwrap();
    let report = ["report", "out", "--pipeline", "raster", "--mirror", "coupon", "--out", "report"];
    let made = compare(dir.path(), &[&report[..], &["--assumed-machine", "ion-beam"]].concat());
    assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    let data = page_data(&dir.path().join("report"));
    let methods = data["runs"][0]["methods"].as_array().unwrap();
    let dwell = |name: &str| &methods.iter().find(|m| m["name"] == name).unwrap()["dwell"];
    // Little-endian single precision in base64, as the page has it.
    assert_ne!(dwell("pvt")["planned_s"], dwell("pvt+refined")["planned_s"]);
    assert_eq!(dwell("pvt+refined+galil")["planned_s"], dwell("pvt+refined")["planned_s"]);
    let unknown = &dwell("pvt+refined+galil");
    assert_eq!((&unknown["executed_s"], &unknown["total_error_s"]), (&Value::Null, &Value::Null));
    assert!(dwell("pvt+refined")["executed_s"].is_string());
    let figure = fs::read_to_string(dir.path().join("report/dwell.svg")).unwrap();
    assert!(figure.contains("not known of a program: executed - planned, pvt+refined+galil"));
    // The headline has the part and the pipeline, and not the directory.
    let page = fs::read_to_string(dir.path().join("report/report.html")).unwrap();
    assert!(page.contains("<title>Planish: coupon, raster</title>"));
    // A machine that nobody named is a problem of the answer.
    let problems = summary(&dir.path().join("report"))["answer"]["problems"].clone();
    let problem = problems[0].as_str().unwrap();
    assert!(
        problem.starts_with("no machine was named, so this is planned for ion-beam"),
        "{problem}"
    );
    assert!(text(&made.stdout).contains("no machine was named"), "{}", text(&made.stdout));
}

#[test]
fn where_no_plan_keeps_the_limits_the_answer_is_that_nothing_is_to_be_run() {
    let dir = tempfile::tempdir().unwrap();
    prepare(&dir.path().join("run"), &[("pvt", 0.75, false), ("position", 0.9, false)]);
    let made = compare(dir.path(), &["report", "run", "--out", "report"]);
    assert_eq!(made.status.code(), Some(1));
    let answer = &summary(&dir.path().join("report"))["answer"];
    assert_eq!(
        (&answer["method"], &answer["sentence"], &answer["why"]),
        (
            &Value::Null,
            &json!("Nothing here is to be run."),
            &json!("pvt exceeds the limits of the machine.")
        )
    );
    assert_eq!(answer["problems"], json!(["no method keeps the limits of the machine"]));
}

/// Returns the width, the height, and [red, green, blue] of every pixel of a PNG file.
fn decoded(path: &Path) -> (usize, usize, Vec<[u8; 3]>) {
    let file = std::io::BufReader::new(fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    assert_eq!(info.color_type, png::ColorType::Rgb);
    let pixels = bytes.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    (info.width as usize, info.height as usize, pixels)
}

/// Returns the names and contents of the files in a directory, sorted by name.
fn files(dir: &Path) -> Vec<(String, Vec<u8>)> {
    let entries = fs::read_dir(dir).unwrap().map(|e| e.unwrap());
    let mut found: Vec<_> = entries
        .map(|e| (e.file_name().to_string_lossy().into_owned(), fs::read(e.path()).unwrap()))
        .collect();
    found.sort();
    found
}

/// Writes the artifacts of a motion of two axes that runs the plan in `method`: motion, verdict, executed contact
/// point and removal.
fn put_on_axes(method: &Path, trajectory: &str, kept: bool) {
    let on_axes = method.join("on-axes");
    let made = |name: &str,
                from: &[(&str, &str)],
                outcome: Value,
                kind: &'static kind::Kind,
                arrays: &[ArrayData]| {
        let mut inputs = Inputs::new();
        for (role, dir) in from {
            let dir = method.join(dir);
            match *role {
                "trajectory" => drop(inputs.read::<Trajectory>(role, &dir).unwrap()),
                _ => drop(inputs.read::<AxesMotion>(role, &dir).unwrap()),
            }
        }
        let args = OutputArgs { out: on_axes.join(name), force: true, wall_time: None };
        let task = Task::new("test", "0", "test", &outcome);
        let begin = Output::directory(&args, kind).begin(&task, &inputs).unwrap();
        // Without a writer, the same artifact is there already.
        if let Some(mut writer) = begin.writer() {
            writer.write_arrays(kind, arrays, &[], outcome, &Status::Done).unwrap();
        }
    };
    let still = [7.0, 0.0, 0.0, 0.0];
    let motion =
        AxesMotion::new(vec![0.0, 61.0], vec![[0.0; 4], still], vec![true], vec![None]).unwrap();
    let named = json!({ "axes": ["x", "b"], "units": ["mm", "deg"], "contact_deviation_um": 1.5, "gap_um": 0.25,
        "added_tool_on_time_s": 1.0 });
    made("axes", &[("trajectory", trajectory)], named, &kind::AXES, &motion.to_arrays());
    let verdict = json!({ "limits_respected": kept, "axes": [] });
    made("verdict", &[("axes", "on-axes/axes")], verdict, &kind::VERDICT, &[]);
    let executed =
        Trajectory::new(vec![0.0, 61.0], vec![[[0.0; 4]; 2]], vec![true], vec![Some(0)]).unwrap();
    made(
        "trajectory",
        &[("axes", "on-axes/axes")],
        json!({}),
        &kind::TRAJECTORY,
        &executed.to_arrays(),
    );
    let removal_nm = desired().height_nm().mapv(|z| if z.is_nan() { 0.0 } else { 0.5 * z });
    let removal = Removal::new(&desired(), removal_nm).unwrap();
    made(
        "removal",
        &[("trajectory", "on-axes/trajectory")],
        json!({}),
        &kind::REMOVAL,
        &removal.to_arrays(),
    );
}

#[test]
fn a_plan_on_all_axes_is_judged_as_the_axes_run_it() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("raster");
    prepare(&run, &[("joint", 0.9, true), ("pvt", 0.75, true)]);
    put_on_axes(&run.join("methods/joint"), "trajectory", true);
    let report = |out: &str| compare(dir.path(), &["report", "raster", "--out", out, "--force"]);
    let first = report("report");
    assert_eq!(first.status.code(), Some(0), "{}", text(&first.stderr));
    let said = text(&first.stdout);
    let rms_nm = (19.2_f64 / 5.0).sqrt();
    // Half of the surface is left on the axes, where a tenth is left in the plane; pvt leaves a quarter.
    assert!(
        said.contains(&format!("joint on the axes x, b: {:.4} nm RMS in 61.00 s", 0.5 * rms_nm)),
        "{said}"
    );
    assert!(said.contains("with the tool on for 1 s longer than planned"), "{said}");
    let found = summary(&dir.path().join("report"));
    assert_eq!(found["best"], "pvt", "{found}");
    assert!(
        fs::read_to_string(dir.path().join("report/report.html"))
            .unwrap()
            .contains("All axes of the machine")
    );
    // The picture is a file of the report, so the same command may replace the report.
    assert!(dir.path().join("report/axes.svg").exists());
    prepare(&run, &[("joint", 0.9, true), ("pvt", 0.8, true)]);
    let again = report("report");
    assert_eq!(again.status.code(), Some(0), "{}", text(&again.stderr));
    // A motion of the axes that was made from another plan says nothing about this one.
    put_on_axes(&run.join("methods/joint"), "../pvt/trajectory", true);
    let other = report("other");
    let said = text(&other.stderr);
    assert_eq!(other.status.code(), Some(0), "{said}");
    assert!(said.contains("joint is out of date: on-axes/axes was made from another"), "{said}");
    // A run that was killed between two of its stages leaves a method that is left out, not a report that fails.
    fs::rename(run.join("methods/pvt/removal"), dir.path().join("removal")).unwrap();
    put_on_axes(&run.join("methods/joint"), "trajectory", true);
    let unfinished = report("unfinished");
    let said = text(&unfinished.stderr);
    assert_eq!(unfinished.status.code(), Some(0), "{said}");
    assert!(said.contains("pvt is out of date: it has no removal; run the stages again"), "{said}");
    fs::rename(dir.path().join("removal"), run.join("methods/pvt/removal")).unwrap();
    // Limits of the axes that are not kept rule a plan out.
    put_on_axes(&run.join("methods/joint"), "trajectory", false);
    prepare(&run, &[("joint", 0.8, true), ("pvt", 0.1, false)]);
    put_on_axes(&run.join("methods/joint"), "trajectory", false);
    let none = report("none");
    assert_eq!(none.status.code(), Some(1), "{}", text(&none.stderr));
    assert!(text(&none.stdout).contains("limits of the axes NOT kept"));
}

#[test]
fn figures_for_papers_have_their_size_and_the_same_bytes_twice() {
    let dir = tempfile::tempdir().unwrap();
    prepare(&dir.path().join("run"), &[("pvt", 0.75, true), ("position", 0.9, false)]);
    for format in ["pdf", "png", "svg"] {
        for out in ["one", "two"] {
            let out = format!("{out}-{format}");
            let made = compare(dir.path(), &["figures", "run", "--format", format, "--out", &out]);
            assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
            assert!(text(&made.stdout).contains(&format!("maps.{format}")));
        }
        let both = ["one", "two"].map(|out| files(&dir.path().join(format!("{out}-{format}"))));
        for (a, b) in both[0].iter().zip(&both[1]).filter(|(a, _)| a.0 != "manifest.json") {
            assert!(a == b, "{}", a.0);
        }
        // No dwell times, no refinement, and no rectangle that is large enough for a spectrum.
        let names: Vec<&str> = both[0].iter().map(|(name, _)| name.as_str()).collect();
        let wanted = ["front", "histogram", "maps", "motion", "overview", "path"];
        let mut wanted: Vec<String> = wanted.iter().map(|n| format!("{n}.{format}")).collect();
        wanted.insert(2, "manifest.json".into());
        assert_eq!(names, wanted);
        for (name, bytes) in both[0].iter().filter(|(name, _)| name != "manifest.json") {
            match format {
                "pdf" => {
                    let page = String::from_utf8_lossy(bytes);
                    assert!(page.starts_with("%PDF-1.") && page.trim_end().ends_with("%%EOF"));
                    // 180 mm are 510.236 points.
                    assert!(page.contains("/MediaBox [0 0 510.23"), "{name}");
                }
                "png" => {
                    let (width, height, pixels) = decoded(&dir.path().join("one-png").join(name));
                    assert_eq!((width, pixels.len()), (2126, width * height), "{name}");
                    assert!(pixels.iter().any(|p| *p != pixels[0]), "{name}: one colour");
                }
                _ => assert!(bytes.starts_with(b"<svg xmlns"), "{name}"),
            }
        }
    }
    let coarse = ["figures", "run", "--format", "png", "--dpi", "150", "--out", "coarse"];
    assert_eq!(compare(dir.path(), &coarse).status.code(), Some(0));
    assert_eq!(decoded(&dir.path().join("coarse/maps.png")).0, 1063);
}

#[test]
fn the_residual_is_read_back_from_the_pixels_of_its_figure() {
    let dir = tempfile::tempdir().unwrap();
    prepare(&dir.path().join("run"), &[("pvt", 0.75, true)]);
    for format in ["svg", "png"] {
        let made = compare(dir.path(), &["figures", "run", "--format", format, "--out", format]);
        assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    }
    // The fourth map is the residual on its own scale; the drawing says where, in pixels of which 952 are its width.
    let svg = fs::read_to_string(dir.path().join("svg/maps.svg")).unwrap();
    let image = svg.lines().filter(|l| l.starts_with("<image")).nth(3).unwrap();
    let [x, y, width, height] = ["x", "y", "width", "height"].map(|key| {
        let (_, rest) = image.split_once(&format!(" {key}=\"")).unwrap();
        rest.split_once('"').unwrap().0.parse::<f64>().unwrap()
    });
    let (columns, _, pixels) = decoded(&dir.path().join("png/maps.png"));
    let scale = columns as f64 / 952.0;
    // A quarter of the heights remains; 99 % of the five pixels are within 0.6 nm of their mean, 1.85 nm.
    let (mean, reach) = (1.85, 0.6);
    for ((r, c), desired) in desired().height_nm().indexed_iter() {
        // Row 0 is the smallest y, at the lower edge.
        let px = (x + width * (c as f64 + 0.5) / 3.0) * scale;
        let py = (y + height * (1.0 - (r as f64 + 0.5) / 2.0)) * scale;
        let found = pixels[py as usize * columns + px as usize];
        if desired.is_nan() {
            assert_eq!(found, [255; 3], "an invalid pixel is paper");
            continue;
        }
        let far = |k: &i32| -> i32 {
            let colour = rgb_at(&BLUE_TO_BROWN, f64::from(*k) / 254.0);
            colour.iter().zip(found).map(|(a, b)| (i32::from(*a) - i32::from(b)).abs()).sum()
        };
        let nearest = (0..255).min_by_key(far).unwrap();
        let read = mean + f64::from(nearest - 127) / 127.0 * reach;
        // Half of one of 254 steps between the colours, and one for colours that are equal when rounded.
        assert!((read - 0.25 * desired).abs() < 1.5 * reach / 127.0, "[{r}, {c}]: {read}");
        assert!(far(&nearest) <= 3, "[{r}, {c}]: {found:?} is no colour of the scale");
    }
}

#[test]
fn figures_refuse_what_they_cannot_draw() {
    let dir = tempfile::tempdir().unwrap();
    prepare(&dir.path().join("run"), &[("pvt", 0.75, false), ("position", 0.9, false)]);
    for (flags, expected) in [
        (&["nowhere", "--format", "pdf"][..], "nowhere/surface: does not exist"),
        (&["run", "--format", "gif"], "invalid value 'gif'"),
        (&["run"], "--format"),
        (
            &["run", "--format", "pdf"],
            "run: no plan keeps the limits; name the method to draw (--method)",
        ),
        (&["run", "--format", "pdf", "--method", "x"], "has no valid method \"x\"; there is: "),
        (&["run", "--format", "pdf", "--dpi", "150"], "--dpi is of a PNG"),
        (
            &["run", "--format", "png", "--dpi", "10"],
            "--dpi: is 10; give 72 to 1200 pixels an inch",
        ),
        (&["run", "--format", "png", "--dpi", "nan"], "--dpi: is NaN"),
    ] {
        let refused = compare(dir.path(), &[&["figures"], flags, &["--out", "figures"]].concat());
        assert_eq!(refused.status.code(), Some(2), "{flags:?}");
        assert!(text(&refused.stderr).contains(expected), "{}", text(&refused.stderr));
        assert!(refused.stdout.is_empty() && !dir.path().join("figures").exists());
    }
    // A plan that exceeds the limits is drawn when it is asked for by name.
    let named = ["figures", "run", "--format", "svg", "--method", "pvt", "--out", "figures"];
    assert_eq!(compare(dir.path(), &named).status.code(), Some(0));
}

#[test]
fn small_plots_are_for_a_terminal() {
    let dir = tempfile::tempdir().unwrap();
    prepare(&dir.path().join("run"), &[("pvt", 0.75, true)]);
    let report = |plots: &str| {
        let flags = ["report", "run", "--out", "report", "--plots", plots];
        text(&compare(dir.path(), &flags).stdout)
    };
    assert!(!report("auto").contains('▁') && !report("never").contains('▁'));
    let plotted = report("always");
    assert!(plotted.contains('█') && plotted.contains("speed over time, at most 0.00 mm/s"));
}

#[test]
fn the_map_as_measured_is_of_one_run() {
    let dir = tempfile::tempdir().unwrap();
    prepare(&dir.path().join("a"), &[("pvt", 0.75, true)]);
    prepare(&dir.path().join("b"), &[("pvt", 0.75, true)]);
    let measured = ["--measured", "b/surface", "--out", "report"];
    let one = compare(dir.path(), &[&["report", "a"], &measured[..]].concat());
    assert_eq!(one.status.code(), Some(0));
    assert_eq!(page_data(&dir.path().join("report"))["runs"][0]["measured"]["every"], 1);
    let two = compare(dir.path(), &[&["report", "a", "b"], &measured[..]].concat());
    assert_eq!(two.status.code(), Some(2));
    assert!(text(&two.stderr).contains("--measured is of one run, 2 are given"));
}

#[test]
fn completions_and_the_manual_page_come_from_the_flags() {
    let dir = tempfile::tempdir().unwrap();
    let completions = compare(dir.path(), &["--completions", "bash"]);
    assert!(text(&completions.stdout).contains("--measured"));
    let manual = compare(dir.path(), &["--man"]);
    assert!(text(&manual.stdout).contains(".TH planish") && manual.status.success());
    let help = text(&compare(dir.path(), &["--help"]).stdout);
    assert!(help.contains("Examples:") && help.contains("--completions bash"), "{help}");
    assert_eq!(compare(dir.path(), &["--completions", "cmd"]).status.code(), Some(2));
}

#[test]
fn several_runs_share_one_table() {
    let dir = tempfile::tempdir().unwrap();
    prepare(&dir.path().join("raster"), &[("pvt", 0.75, true)]);
    prepare(&dir.path().join("maze"), &[("pvt", 0.5, true), ("mine", 0.6, true)]);
    let run = compare(dir.path(), &["report", "raster", "maze", "--out", "report"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
    let found = summary(&dir.path().join("report"));
    assert_eq!(found["runs"][1]["pipeline"], "maze");
    assert!(
        found["runs"][0]["methods"]["mine"].is_null()
            && found["runs"][0]["without_motion"].is_null()
    );
    let table = text(&run.stdout);
    assert_eq!(row(&table, "raster  pvt")[2], "0.4899");
    assert_eq!(row(&table, "maze    mine").last().unwrap(), "*");
    // One of them is to be run: it leaves least.
    let winner = &found["winner"];
    assert_eq!((&winner["run"], &winner["method"]), (&"raster".into(), &"pvt".into()));
    let sentence = winner["sentence"].as_str().unwrap();
    assert!(
        sentence.starts_with("Of the 2 runs, raster is to be run, by pvt: 0.49 nm RMS in "),
        "{sentence}"
    );
    assert!(table.contains(sentence), "{table}");
    // Another map before the run: no residual of one run says anything about the other.
    let double = Surface::new(*desired().grid(), 2.0 * desired().height_nm()).unwrap();
    prepare_of(&double, &dir.path().join("other"), &[("pvt", 0.5, true)]);
    let run = compare(dir.path(), &["report", "raster", "other", "--out", "report", "--force"]);
    let found = summary(&dir.path().join("report"));
    assert!(found["winner"]["run"].is_null(), "{}", text(&run.stderr));
    assert!(text(&run.stdout).contains("No run is named as the one to be run: their maps"));
}

/// Checks the report of a run in which a stage refused and left its message in place of a plan.
#[test]
fn a_method_that_its_stage_refused_is_a_row_with_the_reason() {
    let dir = tempfile::tempdir().unwrap();
    prepare(&dir.path().join("run"), &[("pvt", 0.75, true)]);
    let refused = dir.path().join("run/methods/published");
    fs::create_dir(&refused).unwrap();
    fs::write(refused.join("message.txt"), "warning: w\nerror: no convergence, use pvt\n").unwrap();
    let run = compare(dir.path(), &["report", "run", "--out", "report"]);
    // The plan that is recommended is as good as without it.
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
    let table = text(&run.stdout);
    assert!(row(&table, "published").contains(&"refused".to_string()), "{table}");
    assert!(table.contains("published: refused by its stage: no convergence, use pvt"), "{table}");
    let left = &summary(&dir.path().join("report"))["left_out"][0];
    assert_eq!((&left["name"], &left["standing"]), (&"published".into(), &"refused".into()));
}

#[test]
fn a_run_that_cannot_be_read_is_exit_2_and_writes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |run: &str, expected: &str| {
        let found = compare(dir.path(), &["report", run, "--out", "report"]);
        assert_eq!(found.status.code(), Some(2), "{found:?}");
        let message = text(&found.stderr);
        assert!(message.contains(expected), "{message}");
        assert!(found.stdout.is_empty() && !dir.path().join("report").exists());
    };
    refused("nowhere", "nowhere/surface: does not exist");
    prepare(&dir.path().join("empty"), &[]);
    refused("empty", "empty/methods: cannot read");
    fs::create_dir(dir.path().join("empty/methods")).unwrap();
    refused("empty", "holds no method");
    let run = dir.path().join("run");
    prepare(&run, &[("pvt", 0.5, true)]);
    fs::remove_dir_all(run.join("methods/pvt/verdict")).unwrap();
    refused(
        "run",
        "holds no method; schedule, simulate and verify at least one (pvt: it has no verdict",
    );
    // A removal predicted on another surface.
    prepare(&run, &[("pvt", 0.5, true)]);
    let other = Surface::new(*desired().grid(), Array2::ones((2, 3))).unwrap();
    save(&run.join("surface"), &other).unwrap();
    refused("run", "run/methods/pvt: residual_nm[0, 0]: is 4.5 nm where the surface has 1 nm");
    prepare(&run, &[("pvt", 0.5, true)]);
    fs::write(run.join("methods/pvt/simulate-wall.json"), "{}").unwrap();
    refused("run", "simulate-wall.json: missing field `wall_s`");
}

#[test]
fn diff_decides_by_the_tolerance_and_by_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, surface: &Surface| {
        save(&dir.path().join(name), surface).unwrap();
    };
    let mut heights = desired().height_nm().clone();
    write("a", &desired());
    heights[[1, 0]] += 0.25;
    write("b", &Surface::new(*desired().grid(), heights.clone()).unwrap());
    heights[[0, 0]] = f64::NAN;
    write("c", &Surface::new(*desired().grid(), heights).unwrap());
    let diff = |a: &str, b: &str, tolerance: &str| {
        let run = compare(dir.path(), &["diff", a, b, "--max-difference", tolerance]);
        (run.status.code(), text(&run.stdout), text(&run.stderr))
    };

    assert_eq!(diff("a", "a", "0").0, Some(0));
    let (code, out, _) = diff("a", "b", "0.25");
    assert_eq!(code, Some(0));
    // RMS over the five valid pixels: 0.25 / sqrt(5).
    assert!(out.contains(
        "height_nm.npy: largest difference 2.5e-1 at [1, 0] (A 5, B 5.25), RMS 1.118033988749"
    ));
    assert!(out.contains("x_mm.npy: equal"));
    let (code, _, err) = diff("a", "b", "0.2499");
    assert_eq!((code, err.trim()), (Some(1), "verdict: above 2.499e-1: height_nm.npy by 2.5e-1"));
    let (code, out, _) = diff("b", "c", "1e300");
    assert_eq!(code, Some(1));
    assert!(out.contains("largest difference inf at [0, 0] (A 9, B NaN)"), "{out}");
}

#[test]
fn diff_refuses_what_cannot_be_compared() {
    let dir = tempfile::tempdir().unwrap();
    let out = |name: &str| dir.path().join(name);
    let bare = |name: &str, array: &str, values: ArrayD<f64>| {
        fs::create_dir_all(out(name)).unwrap();
        write_npy(out(name).join(format!("{array}.npy")), &values).unwrap();
    };
    save(&out("surface"), &desired()).unwrap();
    let dwell = DwellTime::new(vec![1.0, 2.0]).unwrap();
    save(&out("dwell"), &dwell).unwrap();
    save_verdict(&out("report"), json!({}));
    bare("three", "dwell_s", array![1.0, 2.0, 3.0].into_dyn());
    bare("two", "dwell_s", array![1.0, 2.5].into_dyn());
    bare("other", "seconds", array![1.0, 2.5].into_dyn());
    fs::create_dir(out("integers")).unwrap();
    write_npy(out("integers").join("dwell_s.npy"), &array![1_i64, 2]).unwrap();
    fs::create_dir(out("single")).unwrap();
    write_npy(out("single").join("dwell_s.npy"), &array![1_f32, 2.0]).unwrap();

    let diff = |a: &str, b: &str, tolerance: &str| {
        compare(dir.path(), &["diff", a, b, &format!("--max-difference={tolerance}")])
    };
    // Bare arrays stand in for an artifact.
    assert_eq!(diff("dwell", "two", "0.5").status.code(), Some(0));
    assert_eq!(diff("dwell", "two", "0.4").status.code(), Some(1));
    assert_eq!(diff("integers", "integers", "0").status.code(), Some(0));
    // 32-bit floats lose nothing on the way to 64 bits.
    assert_eq!(diff("dwell", "single", "0").status.code(), Some(0));
    // What never ends is not waited for.
    fs::create_dir(out("pipe")).unwrap();
    let made = Command::new("mkfifo").arg(out("pipe").join("dwell_s.npy")).status().unwrap();
    assert!(made.success());
    for (a, b, tolerance, expected) in [
        ("surface", "dwell", "1", "surface holds a surface, dwell a dwell"),
        ("dwell", "three", "1", "dwell_s.npy: A has the shape [2], B [3]"),
        ("two", "other", "1", r#"two holds the arrays ["dwell_s.npy"], other ["seconds.npy"]"#),
        ("dwell", "integers", "1", "A holds floats, B holds integers"),
        ("dwell", "pipe", "1", "dwell_s.npy: is not a file"),
        ("dwell", "nowhere", "1", "nowhere: cannot read"),
        ("report", "report", "1", "holds no .npy file"),
        ("two", "two", "-1", "max_difference: is -1"),
        ("two", "two", "nan", "max_difference: is NaN"),
    ] {
        let run = diff(a, b, tolerance);
        assert_eq!(run.status.code(), Some(2), "{a} {b}: {run:?}");
        assert!(text(&run.stderr).contains(expected), "{}", text(&run.stderr));
        assert!(run.stdout.is_empty());
    }
}
