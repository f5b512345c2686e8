//! Tests of the report through the binary: artifacts that do not belong together, plans that are not known to be
//! good, and names that are programs.

use std::{
    fs,
    path::{Path, PathBuf},
    process,
};

use ndarray::{Array1, Array2, ArrayD};
use planish_handoff::{
    Artifact, Inputs, Output, Status, Task, Writer, flags::OutputArgs, kind, kind::Kind,
    npy::ArrayData,
};
use planish_testkit::program::text;
use planish_types::{Axis, DwellTime, Grid, Removal, Surface, Tif, ToolPath, Trajectory};
use serde_json::{Value, json};

fn compare(dir: &Path, arguments: &[&str]) -> process::Output {
    planish_testkit::program::stage("planish-compare")
        .current_dir(dir)
        .args(arguments)
        .output()
        .unwrap()
}

/// Artifacts of a run as the stages write them, so that every manifest records its inputs.
struct Lab {
    run: PathBuf,
    tool: PathBuf,
    machine: PathBuf,
}

const END_S: f64 = 60.0;

impl Lab {
    /// Creates a run in `dir`/`name` with surface, tool, path and dwell times; all pixels have the height
    /// `height_nm`.
    fn new(dir: &Path, name: &str, height_nm: f64) -> Self {
        let lab =
            Self { run: dir.join(name), tool: dir.join("tool"), machine: dir.join("machine.json") };
        fs::write(&lab.machine, "{}").unwrap();
        let axis = |n| Axis::new(0.0, 0.5, n).unwrap();
        let grid = Grid { x: axis(3), y: axis(3) };
        let tif = Tif::new(grid, Array2::ones((3, 3))).unwrap();
        planish_handoff::save(&lab.tool, &tif).unwrap();
        lab.surface(height_nm);
        lab.dwell(1.0, json!({ "end": "optimal", "relative_gap": 3e-5 }));
        lab
    }

    /// Returns a writer for the outputs of `tool` from the inputs of these roles, each in the directory of its name
    /// in `out`.
    fn writer<const N: usize>(
        &self,
        tool: &'static str,
        inputs: &Inputs,
        out: &Path,
        parts: [(&str, &'static Kind); N],
    ) -> Writer {
        // What stands there may have been made from the same inputs, and differ in its values.
        for (part, _) in parts {
            let _ = fs::remove_dir_all(out.join(part));
        }
        let args = OutputArgs { out: out.to_path_buf(), force: true, wall_time: None };
        let task = Task::new(tool, "0", "test", json!({}));
        let begin = Output::directories(&args, parts).begin(&task, inputs).unwrap();
        begin.writer().expect("there is work to do")
    }

    /// Writes one artifact, made from the inputs of these roles.
    fn write<T: Artifact>(
        &self,
        tool: &'static str,
        roles: &[&str],
        out: &str,
        value: &T,
        outcome: Value,
    ) {
        let mut writer = self.writer(tool, &self.read(roles), &self.run, [(out, T::KIND)]);
        writer.write(value, outcome, &Status::Done).unwrap();
    }

    fn surface(&self, height_nm: f64) {
        let axis = |n| Axis::new(0.0, 0.5, n).unwrap();
        let grid = Grid { x: axis(3), y: axis(2) };
        let mut height = Array2::from_elem((2, 3), 5.0);
        height[[0, 0]] += height_nm;
        let surface = Surface::new(grid, height).unwrap();
        planish_handoff::save(&self.run.join("surface"), &surface).unwrap();
        let points = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 0.5]];
        let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
        self.write("planish-toolpath", &["surface", "tif"], "tool_path", &path, json!({}));
    }

    fn dwell(&self, seconds: f64, report: Value) {
        let dwell = DwellTime::new(vec![seconds; 2]).unwrap();
        let roles = ["surface", "tif", "tool-path"];
        self.write("planish-dwell", &roles, "dwell", &dwell, json!({ "report": report }));
    }

    fn read(&self, roles: &[&str]) -> Inputs {
        let mut inputs = Inputs::new();
        for role in roles {
            let in_run = |name: &str| self.run.join(name);
            match *role {
                "surface" => drop(inputs.read::<Surface>(role, &in_run("surface")).unwrap()),
                "tif" => drop(inputs.read::<Tif>(role, &self.tool).unwrap()),
                "tool-path" => drop(inputs.read::<ToolPath>(role, &in_run("tool_path")).unwrap()),
                "dwell" => drop(inputs.read::<DwellTime>(role, &in_run("dwell")).unwrap()),
                "machine" => drop(inputs.read_json::<Value>(role, &self.machine).unwrap()),
                trajectory => {
                    drop(inputs.read::<Trajectory>("trajectory", &in_run(trajectory)).unwrap())
                }
            }
        }
        inputs
    }

    fn method(&self, name: &str) -> PathBuf {
        self.run.join("methods").join(name)
    }

    /// Writes the motion of the method `name`, which moves by `away_mm`, so that every method has its own.
    fn schedule(&self, name: &str, away_mm: f64) {
        let claim = json!({ "claim": { "limits_respected": true } });
        let out = format!("methods/{name}/trajectory");
        let roles = ["tool-path", "dwell", "machine"];
        self.write("planish-schedule", &roles, &out, &motion(away_mm), claim);
    }

    /// Writes the dwell times, motion and rounds of the method `name` as planish-refine does, with this `end`.
    fn refine(&self, name: &str, end: &str) {
        let inputs = self.read(&["surface", "tif", "tool-path", "machine", "dwell"]);
        let parts = [
            ("dwell", DwellTime::KIND),
            ("trajectory", Trajectory::KIND),
            ("iterations", &kind::ITERATIONS),
        ];
        let mut writer = self.writer("planish-refine", &inputs, &self.method(name), parts);
        let outcome = json!({ "end": end, "best_round": 1 });
        let dwell = DwellTime::new(vec![0.5; 2]).unwrap();
        writer.write(&dwell, outcome.clone(), &Status::Done).unwrap();
        writer.write(&motion(0.75), outcome.clone(), &Status::Done).unwrap();
        let arrays = [
            ArrayData::F64(ArrayD::from_elem(vec![2, 2], 0.5).into()),
            ArrayData::F64(Array1::from(vec![2.0, 1.0]).into_dyn().into()),
            ArrayData::F64(Array1::from(vec![END_S; 2]).into_dyn().into()),
            ArrayData::I64(Array1::from(vec![0, 0]).into_dyn().into()),
        ];
        writer.write_arrays(&kind::ITERATIONS, &arrays, &[], outcome, &Status::Done).unwrap();
    }

    /// Writes the prediction and the verdict of the method `name`. The residual is `left` times the desired removal,
    /// and `kept` says whether the limits are kept.
    fn judge(&self, name: &str, left: f64, kept: bool) {
        let trajectory = format!("methods/{name}/trajectory");
        let desired: Surface = Inputs::new().read("surface", &self.run.join("surface")).unwrap();
        let removal_nm = desired.height_nm().mapv(|z| (1.0 - left) * z);
        let removal = Removal::new(&desired, removal_nm).unwrap();
        let roles = [&*trajectory, "tif", "surface"];
        let out = format!("methods/{name}/removal");
        self.write("planish-simulate", &roles, &out, &removal, json!({}));
        let inputs = self.read(&[&trajectory, "machine"]);
        let parts = [("verdict", &kind::VERDICT)];
        let mut writer = self.writer("planish-verify", &inputs, &self.method(name), parts);
        let outcome = json!({
            "total_time_s": END_S, "max_velocity_mm_per_s": [1.0, 2.0],
            "max_acceleration_mm_per_s2": [3.0, 4.0], "max_velocity_step_mm_per_s": [5.0, 6.0],
            "max_acceleration_step_mm_per_s2": [7.0, 8.0], "limits_respected": kept,
        });
        writer.write_arrays(&kind::VERDICT, &[], &[], outcome, &Status::Done).unwrap();
    }

    /// Writes the verdict of planish-surface on the residual of a method, by the specification of this text.
    fn specify(&self, name: &str, by: &str) {
        let file = self.run.with_file_name("limits.json");
        fs::write(&file, by).unwrap();
        let mut inputs = Inputs::new();
        inputs.read::<Removal>("removal", &self.method(name).join("removal")).unwrap();
        inputs.read_json::<Value>("specification", &file).unwrap();
        let out = self.run.join("specified").join(name);
        let parts = [("specification", &kind::SPECIFICATION)];
        let mut writer = self.writer("planish-surface", &inputs, &out, parts);
        let limit = json!({ "quantity": "PV height", "unit": "nm", "value": 2.0, "limit": 1.0,
            "bound": "at-most", "passed": false, "worst": "at x 0, y 0 mm" });
        let outcome =
            json!({ "specification": { "name": "strict", "passed": false, "limits": [limit] } });
        let empty = || ArrayData::F64(Array1::zeros(0).into_dyn().into());
        let arrays: Vec<ArrayData> = kind::SPECIFICATION.arrays.iter().map(|_| empty()).collect();
        writer.write_arrays(&kind::SPECIFICATION, &arrays, &[], outcome, &Status::Done).unwrap();
    }

    fn report(&self) -> process::Output {
        let dir = self.run.parent().unwrap();
        let run = self.run.file_name().unwrap().to_str().unwrap();
        compare(dir, &["report", run, "--out", "report", "--force"])
    }

    fn summary(&self) -> Value {
        let file = self.run.parent().unwrap().join("report/summary.json");
        serde_json::from_slice(&fs::read(file).unwrap()).unwrap()
    }
}

fn motion(away_mm: f64) -> Trajectory {
    let c = [[0.0, away_mm / END_S, 0.0, 0.0], [0.0; 4]];
    Trajectory::new(vec![0.0, END_S], vec![c], vec![true], vec![Some(0)]).unwrap()
}

/// Creates a run with two methods of which the second is the better one.
fn lab(dir: &Path) -> Lab {
    let lab = Lab::new(dir, "run", 3.0);
    lab.schedule("constant-acceleration", 1.0);
    lab.judge("constant-acceleration", 0.5, true);
    lab.schedule("pvt", 0.5);
    lab.judge("pvt", 0.25, true);
    lab
}

fn replace(from: &Path, to: &Path) {
    fs::remove_dir_all(to).unwrap();
    fs::create_dir(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
    }
}

fn row<'a>(table: &'a str, start: &str) -> &'a str {
    table.lines().find(|l| l.starts_with(start)).expect(table)
}

#[test]
fn what_belongs_together_is_compared_and_its_dwell_times_are_optimal() {
    let dir = tempfile::tempdir().unwrap();
    let lab = lab(dir.path());
    let made = lab.report();
    assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    let table = text(&made.stdout);
    assert!(
        row(&table, "pvt").contains("dwell times optimal") && row(&table, "pvt").ends_with('*'),
        "{table}"
    );
    assert!(!table.contains("not checked") && table.contains("proven within 3e-5"), "{table}");
    // 60 s at the first of two points that were planned 1 s each.
    assert!(table.contains("the motion departs from one of them by 59 s"), "{table}");
    let found = lab.summary();
    assert_eq!((&found["best"], &found["left_out"]), (&json!("pvt"), &json!([])));
    assert_eq!(found["methods"]["pvt"]["plan"]["state"], "dwell-optimal");
    assert!(!table.contains("certified"), "nothing is proven of a scheduled motion: {table}");
    // Nor of a trajectory of one's own, beside dwell times that are optimal.
    fs::remove_file(lab.method("pvt").join("trajectory/manifest.json")).unwrap();
    let made = lab.report();
    let table = text(&made.stdout);
    assert!(row(&table, "pvt ").contains("not known"), "{table}");
    assert!(table.contains("no manifest says which dwell times its motion follows"), "{table}");
}

#[test]
fn a_foreign_verdict_or_removal_or_motion_is_not_valid() {
    type Break = fn(&Lab);
    let cases: [(&str, Break); 4] = [
        ("its verdict is of another trajectory: run planish verify again", |lab| {
            let verdict = lab.method("constant-acceleration").join("verdict");
            replace(&verdict, &lab.method("pvt").join("verdict"));
        }),
        ("its removal is of another trajectory: run planish simulate again", |lab| {
            let removal = lab.method("constant-acceleration").join("removal");
            replace(&removal, &lab.method("pvt").join("removal"));
        }),
        // The same command made another motion: array and manifest agree, the judges are old.
        ("its verdict is of another trajectory: run planish verify again", |lab| {
            lab.schedule("pvt", 0.625);
        }),
        ("its removal is of another surface: run planish simulate again", |lab| {
            let (path, dwell) = (lab.run.join("tool_path"), lab.run.join("dwell"));
            let keep = tempfile::tempdir().unwrap();
            for part in [&path, &dwell] {
                fs::rename(part, keep.path().join(part.file_name().unwrap())).unwrap();
            }
            lab.surface(4.0);
            fs::remove_dir_all(&path).unwrap();
            for part in [&path, &dwell] {
                fs::rename(keep.path().join(part.file_name().unwrap()), part).unwrap();
            }
            lab.judge("constant-acceleration", 0.5, true);
        }),
    ];
    for (reason, break_it) in cases {
        let dir = tempfile::tempdir().unwrap();
        let lab = lab(dir.path());
        break_it(&lab);
        let made = lab.report();
        let (out, err) = (text(&made.stdout), text(&made.stderr));
        assert_eq!(made.status.code(), Some(1), "{reason}: {out}{err}");
        assert!(err.contains("verdict: pvt is not valid: ") && err.contains(reason), "{err}");
        let row = row(&out, "pvt ");
        assert!(row.contains("not valid") && !row.contains(['*', '0']), "{out}");
        assert!(self::row(&out, "constant-acceleration").ends_with('*'), "{out}");
        let found = lab.summary();
        assert_eq!(found["best"], "constant-acceleration");
        assert_eq!(found["left_out"][0]["standing"], "not-valid");
        assert!(found["methods"]["pvt"].is_null());
    }
}

#[test]
fn a_refinement_of_older_dwell_times_is_out_of_date_and_no_error() {
    let dir = tempfile::tempdir().unwrap();
    let lab = lab(dir.path());
    lab.refine("pvt+refined", "no-improvement");
    lab.judge("pvt+refined", 0.125, true);
    assert_eq!(lab.report().status.code(), Some(0));
    assert_eq!(lab.summary()["best"], "pvt+refined");
    // Another dwell solution, and no refinement of it.
    lab.dwell(2.0, json!({ "end": "optimal", "relative_gap": 3e-5 }));
    for name in ["constant-acceleration", "pvt"] {
        lab.schedule(name, 0.5);
        lab.judge(name, 0.25, true);
    }
    let made = lab.report();
    let (out, err) = (text(&made.stdout), text(&made.stderr));
    assert_eq!(made.status.code(), Some(0), "{err}");
    let expected = "pvt+refined is out of date: it is a plan from other dwell times";
    assert!(err.contains(&format!("warning: run/methods/{expected}")), "{err}");
    assert!(out.contains("pvt+refined: out of date, left out"), "{out}");
    assert!(!out.lines().any(|l| l.starts_with("pvt+refined ")), "{out}");
    let found = lab.summary();
    assert_eq!(found["left_out"][0]["standing"], "out-of-date");
    assert_eq!(found["best"], "constant-acceleration");
    // Nothing of the present dwell times: no plan.
    fs::remove_dir_all(lab.method("constant-acceleration")).unwrap();
    fs::remove_dir_all(lab.method("pvt")).unwrap();
    let made = lab.report();
    assert_eq!(made.status.code(), Some(1), "{}", text(&made.stderr));
    assert!(lab.summary()["best"].is_null());
    let page = fs::read_to_string(dir.path().join("report/report.html")).unwrap();
    assert!(page.contains("out-of-date"));
}

#[test]
fn a_plan_that_is_not_known_to_be_good_is_said_and_decides_the_exit_code() {
    for (report, word, code) in [
        (json!({ "end": "optimal", "relative_gap": 1e-5 }), "dwell times optimal", 0),
        (json!({ "end": "stagnated", "relative_gap": 0.2 }), "stagnated", 1),
        (json!({ "end": "iteration-limit" }), "iteration limit", 1),
        (json!({ "gain": 2.0 }), "no certificate", 0),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let lab = Lab::new(dir.path(), "run", 3.0);
        lab.dwell(1.5, report);
        lab.schedule("pvt", 1.0);
        lab.judge("pvt", 0.5, true);
        let made = lab.report();
        assert_eq!(made.status.code(), Some(code), "{word}: {}", text(&made.stderr));
        assert!(row(&text(&made.stdout), "pvt ").contains(word));
        assert_eq!(lab.summary()["methods"]["pvt"]["plan"]["word"], word);
        let says = text(&made.stderr).contains("pvt is the best, but not optimal");
        assert_eq!(says, code == 1);
        // Again, unchanged: the same end.
        assert_eq!(lab.report().status.code(), Some(code));
    }
    for (end, word, code) in [("no-improvement", "converged", 0), ("round-limit", "round limit", 1)]
    {
        let dir = tempfile::tempdir().unwrap();
        let lab = lab(dir.path());
        lab.refine("pvt+refined", end);
        lab.judge("pvt+refined", 0.125, true);
        let made = lab.report();
        assert_eq!(made.status.code(), Some(code), "{word}: {}", text(&made.stderr));
        assert!(row(&text(&made.stdout), "pvt+refined ").contains(word));
    }
}

#[test]
fn dwell_times_without_a_motion_are_no_plan_and_no_limits_kept_is_negative() {
    let dir = tempfile::tempdir().unwrap();
    let lab = Lab::new(dir.path(), "run", 3.0);
    lab.schedule("position", 0.0);
    lab.judge("position", 0.1, true);
    lab.schedule("pvt", 1.0);
    lab.judge("pvt", 0.5, false);
    let made = lab.report();
    assert_eq!(made.status.code(), Some(1));
    let out = text(&made.stdout);
    assert!(text(&made.stderr).contains("no method keeps the limits of the machine"));
    assert!(row(&out, "position ").contains("no motion"), "{out}");
    assert!(out.contains("not a plan; no machine can run it"), "{out}");
    assert!(!out.contains('*'), "{out}");
}

#[test]
fn a_script_in_the_place_of_the_dwell_solver_is_compared() {
    let dir = tempfile::tempdir().unwrap();
    let lab = lab(dir.path());
    // The same content without a manifest, as numpy.save leaves it.
    fs::remove_file(lab.run.join("dwell/manifest.json")).unwrap();
    let made = lab.report();
    assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    let out = text(&made.stdout);
    assert!(row(&out, "pvt ").contains("not known") && row(&out, "pvt ").ends_with('*'), "{out}");
    // A removal of one's own cannot be checked; that is said.
    fs::remove_file(lab.method("pvt").join("removal/manifest.json")).unwrap();
    let out = text(&lab.report().stdout);
    assert!(out.contains("pvt: not checked") && out.contains(": removal\n"), "{out}");
}

#[test]
fn dwell_times_of_ones_own_belong_in_the_directory_of_their_method() {
    let dir = tempfile::tempdir().unwrap();
    let lab = lab(dir.path());
    // As a script leaves them: arrays without a manifest.
    let own = lab.method("mine").join("dwell");
    planish_handoff::save(&own, &DwellTime::new(vec![2.0; 2]).unwrap()).unwrap();
    let _ = fs::remove_file(own.join("manifest.json"));
    let mut inputs = lab.read(&["tool-path", "machine"]);
    inputs.read::<DwellTime>("dwell", &own).unwrap();
    let parts = [("trajectory", Trajectory::KIND)];
    let mut writer = lab.writer("planish-schedule", &inputs, &lab.method("mine"), parts);
    writer.write(&motion(0.25), json!({}), &Status::Done).unwrap();
    lab.judge("mine", 0.125, true);
    let made = lab.report();
    let out = text(&made.stdout);
    assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    assert!(row(&out, "mine ").contains("not known") && row(&out, "mine ").ends_with('*'), "{out}");
    assert_eq!(lab.summary()["left_out"], json!([]));
    // Anywhere else they are not known to be the plan of this method: the reason says where they belong.
    fs::remove_dir_all(&own).unwrap();
    let made = lab.report();
    let out = text(&made.stdout);
    assert!(
        out.contains("mine: out of date, left out: it is a plan from other dwell times"),
        "{out}"
    );
    assert!(out.contains("if they are its own, put them in dwell/ of its directory"), "{out}");
}

#[test]
fn a_manifest_with_another_unit_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let lab = lab(dir.path());
    let file = lab.run.join("surface/manifest.json");
    // As another program would write it; with its seal the change itself is noticed.
    let manifest = fs::read_to_string(&file).unwrap();
    let manifest = manifest.replace("\"nm\"", "\"furlong\"").replace("\"seal\"", "\"note\"");
    fs::write(&file, manifest).unwrap();
    let made = lab.report();
    assert_eq!(made.status.code(), Some(2));
    let err = text(&made.stderr);
    assert!(err.contains("run/surface") && err.contains("height_nm is in \"furlong\""), "{err}");
    assert!(!dir.path().join("report").exists());
}

/// Returns the text of the page between `open` and the next `close`.
fn element<'a>(page: &'a str, open: &str, close: &str) -> &'a str {
    let start = page.find(open).expect(open) + open.len();
    &page[start..start + page[start..].find(close).unwrap()]
}

#[test]
fn names_that_are_programs_stay_names() {
    let dir = tempfile::tempdir().unwrap();
    let hostile = "{{data}}{{js}}<img src=x onerror=alert(1)>\u{1b}[31m\u{202e}&quot;\u{2028}";
    let lab = Lab::new(dir.path(), hostile, 3.0);
    let method = "pvt<svg onload=alert(2)>\u{1b}]0;title\u{7}\u{8}";
    lab.schedule(method, 1.0);
    lab.judge(method, 0.5, true);
    let named = "</script><script>alert(3)</script>\u{1b}[2J";
    let flags = ["--mirror", named, "--pipeline", "<!--<script>", "--plots", "always"];
    let report = ["report", hostile, "--out", "report"];
    let made = compare(dir.path(), &[&report[..], &flags].concat());
    assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    for stream in [&made.stdout, &made.stderr] {
        let stream = text(stream);
        let commands =
            |c: char| c != '\n' && (c.is_control() || c == '\u{202e}' || c == '\u{2028}');
        assert!(!stream.contains(commands), "{stream:?}");
    }
    assert!(text(&made.stdout).contains(r"\u{1b}[31m\u{202e}"));

    let page = fs::read_to_string(dir.path().join("report/report.html")).unwrap();
    // One script that runs, and it is the one that the policy names; the data are data.
    assert_eq!(page.matches("<script").count(), 2);
    assert_eq!((page.matches("<img").count(), page.matches("<!--").count()), (0, 0));
    assert!(!page.contains("unsafe-inline") && page.contains("script-src 'sha256-"));
    let data: Value = serde_json::from_str(element(&page, "id=\"data\">", "</script>")).unwrap();
    assert_eq!(data["runs"][0]["name"], hostile);
    assert_eq!(data["runs"][0]["fixture"], named);
    assert_eq!(data["runs"][0]["methods"][0]["name"], method);
    let title = element(&page, "<title>", "</title>");
    // The part and the pipeline.
    assert!(
        title.starts_with("Planish: &lt;/script&gt;&lt;script&gt;alert(3)&lt;/script&gt;"),
        "{title}"
    );
    assert!(!title.contains('\u{1b}'), "{title}");
    for file in ["maps.svg", "path.svg", "motion.svg", "dwell.svg", "histogram.svg"] {
        let svg = fs::read_to_string(dir.path().join("report").join(file)).unwrap();
        assert!(!svg.contains(|c: char| c != '\n' && c.is_control()), "{file}");
        assert!(!svg.contains("<svg onload") && svg.matches("<svg").count() == 1, "{file}");
    }
    // A message about such a name.
    fs::remove_dir_all(lab.method(method).join("verdict")).unwrap();
    let made = compare(dir.path(), &[&report[..], &["--force"]].concat());
    assert_eq!(made.status.code(), Some(2));
    let message = text(&made.stderr);
    assert!(message.contains(r"\u{1b}]0;title\u{7}") && !message.contains('\u{1b}'), "{message:?}");
}

#[test]
fn a_specification_counts_for_the_prediction_that_it_judged() {
    let dir = tempfile::tempdir().unwrap();
    let lab = lab(dir.path());
    lab.specify("pvt", "{}");
    let said = text(&lab.report().stdout);
    let row =
        said.lines().find(|l| l.starts_with("PV height (nm)")).unwrap_or_else(|| panic!("{said}"));
    assert_eq!(row.split_whitespace().collect::<Vec<_>>()[3..], ["<=", "1", "2!"]);
    let summary = lab.summary();
    assert_eq!(summary["methods"]["pvt"]["specification"]["passed"], false);
    assert!(summary["methods"]["constant-acceleration"]["specification"].is_null());
    assert_eq!(summary["remarks"], json!([]));

    // Another specification for the second method: two columns would not belong together.
    lab.specify("constant-acceleration", "{}");
    lab.specify("pvt", "[]");
    let said = text(&lab.report().stdout);
    assert!(said.contains("pvt: it was judged by another specification; judge it again"), "{said}");
    assert!(lab.summary()["methods"]["pvt"]["specification"].is_null());

    // Another prediction than the one that was judged.
    lab.judge("constant-acceleration", 0.125, true);
    let said = text(&lab.report().stdout);
    let remark =
        "constant-acceleration: its specification was judged on another map; judge it again";
    assert!(said.contains(remark), "{said}");
    assert!(lab.summary()["methods"]["constant-acceleration"]["specification"].is_null());
    assert!(lab.summary()["methods"]["pvt"]["specification"]["passed"] == false);
}

#[test]
fn flat_maps_and_points_are_drawn_with_numbers_only() {
    // A flat map, perfectly removed or not at all; a motion and a path of one point.
    for (height_nm, left) in [(0.0, 0.0), (0.0, 1.0), (3.0, 0.0), (1e-13, 0.5)] {
        let dir = tempfile::tempdir().unwrap();
        let lab = Lab::new(dir.path(), "run", height_nm);
        let path = ToolPath::through(vec![[7.0, 7.0]; 3], vec![true; 2], vec![0; 2]).unwrap();
        lab.write("planish-toolpath", &["surface", "tif"], "tool_path", &path, json!({}));
        lab.dwell(0.0, json!({ "end": "optimal", "relative_gap": 0.0 }));
        lab.schedule("pvt", 0.0);
        lab.judge("pvt", left, true);
        let made = compare(dir.path(), &["report", "run", "--out", "report", "--plots", "always"]);
        assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
        let out = text(&made.stdout);
        let odd =
            |text: &str| ["NaN", "nan", "inf", "-0.0 ", "-0.00"].iter().any(|w| text.contains(w));
        assert!(!odd(&out), "{out}");
        for entry in fs::read_dir(dir.path().join("report")).unwrap() {
            let path = entry.unwrap().path();
            let content = fs::read_to_string(&path).unwrap();
            if path.extension().is_some_and(|e| e == "svg") {
                // Pictures in a picture are base64, in which any word may occur.
                let drawn: Vec<&str> = content.split("href=\"data:").collect();
                let drawn = drawn.iter().map(|d| d.split_once('"').map_or(*d, |(_, rest)| rest));
                assert!(
                    drawn.clone().all(|d| !odd(d) && !d.contains("null")),
                    "{}",
                    path.display()
                );
            }
        }
        let numbers = lab.summary().to_string();
        // The two times that were not measured, the RMS after a servo that is not there, the method `position`, the tool (it, and the part that it does not
        // reach, before and after), three verdicts by a specification, the process; slopes along y, before and
        // after, and their base, which is as long as the map. Without a tool there is no edge zone (width and
        // fraction, RMS of it and of the inside before and after, time, each of five places), two rows fill two
        // thirds of three regions, and the answer has no row without a motion. The user states nothing about the part
        // (four), the tool has no numbers, and so few pixels have no low-order terms, before and after.
        let edge = 2 + 2 + 2 + 1 + 5;
        assert_eq!(
            numbers.matches("null").count(),
            2 + 1 + 1 + 3 + 3 + 1 + 3 + edge + 3 + 1 + 4 + 1 + 2,
            "{numbers}"
        );
    }
}
