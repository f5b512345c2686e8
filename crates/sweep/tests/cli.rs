//! Tests of `planish-sweep` as the workflow calls it, with the real stages.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::Output,
    time::Duration,
};

use planish_testkit::{
    program::{run_within, text},
    workspace,
};
use serde_json::Value;

/// Longest time of a run of the test, s. A plan of the coupon takes a second.
const LIMIT: Duration = Duration::from_secs(120);

/// Three plans on two paths, and one that cannot be made: no tool path has a floor of the dwell-time density that the
/// largest time allows.
const SWEEP: &str = "\
mirror: {fixture: FIXTURE}
machine: MACHINE
reports: none
plans:
  - path: raster
    pitch_mm: 2
    time_elasticity: [0.5, 2]
  - path: maze
    pitch_mm: 2
    seed: 3
  - path: raster
    pitch_mm: 1e6
";

fn planish(arguments: &[&str]) -> Output {
    run_within(planish_testkit::program::stage("planish-sweep").args(arguments), LIMIT)
}

#[track_caller]
fn ended(code: i32, arguments: &[&str]) -> String {
    let output = planish(arguments);
    let said = format!("{}{}", text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
    said
}

/// Writes the file of a sweep in `dir` and returns its path.
fn written(dir: &Path, sweep: &str) -> PathBuf {
    let fixtures = workspace().join("fixtures");
    let sweep = sweep
        .replace("FIXTURE", fixtures.join("coupon.json").to_str().unwrap())
        .replace("MACHINE", fixtures.join("machines/ion-beam.json").to_str().unwrap());
    let path = dir.join("some.yaml");
    fs::write(&path, sweep).unwrap();
    path
}

fn expanded(dir: &Path, name: &str) -> String {
    let file = written(dir, SWEEP);
    let out = dir.join(name).to_str().unwrap().to_string();
    ended(0, &["expand", file.to_str().unwrap(), "--out", &out]);
    out
}

/// Returns the contents of the result files under a directory, without those that depend on how the results were
/// made.
fn results(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![dir.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_symlink() || path == dir.join("done") {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else {
                files.insert(path.strip_prefix(dir).unwrap().into(), fs::read(&path).unwrap());
            }
        }
    }
    files
}

fn row(dir: &str, plan: &Value) -> Value {
    let path = Path::new(dir).join("plans").join(plan["id"].as_str().unwrap()).join("row.json");
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn jobs_make_the_same_bytes_however_the_plans_are_shared_out() {
    let dir = tempfile::tempdir().unwrap();
    let one = expanded(dir.path(), "one");
    let said = ended(2, &["run", &one, "--layer", "plans"]);
    assert!(said.contains("make the mirror first (--layer mirror)"), "{said}");
    ended(0, &["run", &one, "--layer", "mirror"]);
    ended(0, &["run", &one, "--layer", "paths", "--at-once", "2"]);
    ended(0, &["run", &one, "--layer", "plans", "--at-once", "2"]);

    let two = expanded(dir.path(), "two");
    ended(0, &["run", &two, "--layer", "mirror"]);
    for job in ["1", "2"] {
        ended(0, &["run", &two, "--layer", "paths", "--job", job, "--jobs", "2"]);
    }
    for job in ["3", "2", "1"] {
        ended(0, &["run", &two, "--layer", "plans", "--job", job, "--jobs", "3"]);
    }
    for dir in [&one, &two] {
        ended(0, &["table", dir]);
    }
    let (one_files, two_files) = (results(Path::new(&one)), results(Path::new(&two)));
    let names = |files: &BTreeMap<PathBuf, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&one_files), names(&two_files));
    for (name, bytes) in &one_files {
        // The commands that make plans again name the directory of their mirror.
        let has_commands = ["sweep.json", "table.json"].contains(&name.to_str().unwrap());
        let same = match has_commands {
            true => text(bytes).replace(&one, &two) == text(&two_files[name]),
            false => *bytes == two_files[name],
        };
        assert!(same, "{} differs", name.display());
    }

    // One raster for two prices; what cannot be made is a row with the message of its stage.
    let sweep: Value = serde_json::from_slice(&one_files[Path::new("sweep.json")]).unwrap();
    let plans = sweep["rounds"][0]["plans"].as_array().unwrap();
    assert_eq!(plans.len(), 4);
    assert_eq!(plans[0]["path_id"], plans[1]["path_id"]);
    for plan in &plans[..3] {
        assert_eq!(row(&one, plan)["status"], "done");
        assert_eq!(row(&one, plan)["numbers"]["limits_kept"], true);
    }
    let failed = row(&one, &plans[3]);
    assert_eq!((&failed["status"], &failed["numbers"]), (&"failed".into(), &Value::Null));
    assert!(failed["message"].as_str().unwrap().starts_with("planish toolpath: "), "{failed}");
    // A dearer second takes less time and leaves more.
    let number = |plan: &Value, key: &str| row(&one, plan)["numbers"][key].as_f64().unwrap();
    assert!(number(&plans[0], "total_time_s") > number(&plans[1], "total_time_s"));
    assert!(number(&plans[0], "rms_nm") < number(&plans[1], "rms_nm"));

    let again = ended(0, &["again", &one, plans[1]["id"].as_str().unwrap()]);
    assert!(again.starts_with("planish run raster "), "{again}");
    assert!(
        again.contains(" pitch_mm=2 step_mm=1 time_elasticity=2 plan_joint=yes refine=no"),
        "{again}"
    );

    // Made again, nothing is done but the plan that failed.
    let said = ended(0, &["run", &one, "--layer", "plans", "--at-once", "2"]);
    assert!(said.contains("3 of 4 plans are there already"), "{said}");
    // A row that is lost is made again, and is the same.
    let lost =
        Path::new(&one).join("plans").join(plans[2]["id"].as_str().unwrap()).join("row.json");
    let before = fs::read(&lost).unwrap();
    fs::remove_file(&lost).unwrap();
    ended(0, &["run", &one, "--layer", "plans"]);
    assert_eq!(fs::read(&lost).unwrap(), before);

    // Between the plans of the front lie others, in a round of their own; what is there is not proposed again.
    let said = ended(0, &["propose", &one]);
    assert!(said.contains("raster, joint: pitch_mm=2 step_mm=1 time_elasticity=1"), "{said}");
    let said = ended(2, &["propose", &one]);
    assert!(said.contains("has no row; make the plans of round 1 first"), "{said}");
}

/// Checks that a varying tool is made with the mirror, once for each command, and that its table is found from the
/// folder of the sweep's file. The command beside the recipe of a fixture counts for the plans without the setting.
#[test]
fn a_tool_that_varies_is_made_with_the_mirror() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("rate.txt"), "0 1\n100 0.7\n").unwrap();
    let command = "rate --by radius --table rate.txt --error 1e-2";
    let with = SWEEP.replacen("pitch_mm: 2", &format!("varying: [none, {command}]"), 1);
    let file = written(dir.path(), &with);
    let out = dir.path().join("out").to_str().unwrap().to_string();
    let expand = || ended(0, &["expand", file.to_str().unwrap(), "--out", &out]);
    let sweep = || -> Value {
        serde_json::from_slice(&fs::read(Path::new(&out).join("sweep.json")).unwrap()).unwrap()
    };
    expand();
    let first = sweep();
    let steps = first["mirror_steps"].as_array().unwrap();
    let tool = steps.last().unwrap()["arguments"].as_array().unwrap();
    assert_eq!((steps.len(), &tool[0]), (3, &"rate".into()), "{steps:?}");
    let table = dir.path().canonicalize().unwrap().join("rate.txt");
    assert!(tool.contains(&table.to_str().unwrap().into()), "{tool:?}");
    ended(0, &["run", &out, "--layer", "mirror"]);
    let at = tool[tool.iter().position(|word| word == "--out").unwrap() + 1].as_str().unwrap();
    assert!(Path::new(&out).join(at).join("weight.npy").exists(), "{at}");
    // Another table is another tool, and other plans.
    fs::write(dir.path().join("rate.txt"), "0 1\n100 0.6\n").unwrap();
    expand();
    let id = |sweep: &Value, k: usize| sweep["rounds"][0]["plans"][k]["id"].clone();
    let second = sweep();
    // Two prices for each of the two tools.
    assert!((0..2).all(|k| id(&first, k) == id(&second, k)));
    assert!((2..4).all(|k| id(&first, k) != id(&second, k)));

    let beam =
        with.replace("FIXTURE", "FIXTURE_BEAM").replace(&format!("[none, {command}]"), "none");
    let fixture = workspace().join("fixtures/sphere-beam.json");
    let file = written(dir.path(), &beam.replace("FIXTURE_BEAM", fixture.to_str().unwrap()));
    ended(0, &["expand", file.to_str().unwrap(), "--out", &out]);
    let plans = sweep()["rounds"][0]["plans"].clone();
    let of = |plan: &Value| {
        let settings = plan["settings"].as_array().unwrap();
        settings.iter().find(|s| s[0] == "varying").unwrap()[1].as_str().unwrap().to_string()
    };
    assert_eq!(of(&plans[0]), "none");
    assert!(of(plans.as_array().unwrap().last().unwrap()).starts_with("incidence "));
}

/// Checks that the residual of every plan is judged by the specification. Its limits are columns of the table, and a
/// plan that misses one counts only if the sweep says so.
#[test]
fn a_specification_is_a_constraint_and_its_limits_are_columns() {
    let dir = tempfile::tempdir().unwrap();
    let limits = r#"{"name": "s", "limits": [
        {"quantity": "height_rms", "at_most_nm": 1e6},
        {"quantity": "height_rms", "shortest_period_mm": 1, "longest_period_mm": 5, "at_most_nm": 1e-6}]}"#;
    fs::write(dir.path().join("limits.json"), limits).unwrap();
    let blocks = SWEEP.split("  - path: maze").next().unwrap();
    let with = |more: &str| {
        let more = format!("specification: limits.json\n{more}plans:");
        written(dir.path(), &blocks.replace("plans:", &more))
    };
    let out = dir.path().join("out").to_str().unwrap().to_string();
    let judged = |more: &str| -> String {
        let file = with(more);
        ended(0, &["expand", file.to_str().unwrap(), "--out", &out]);
        for layer in ["mirror", "paths", "plans"] {
            ended(0, &["run", &out, "--layer", layer]);
        }
        ended(0, &["table", &out]);
        let table = format!("{out}/table.json");
        let mut compare = planish_testkit::program::stage("planish-compare");
        let report = format!("{out}/report");
        compare.args(["sweep", &table, "--out", &report, "--force"]);
        let said = run_within(&mut compare, LIMIT);
        format!("{}{}", text(&said.stdout), text(&said.stderr))
    };
    let said = judged("");
    assert!(said.contains("None of the 2 plans keeps the constraints"), "{said}");
    let sweep: Value =
        serde_json::from_slice(&fs::read(Path::new(&out).join("sweep.json")).unwrap()).unwrap();
    let plan = &sweep["rounds"][0]["plans"][0];
    let verdict = &row(&out, plan)["numbers"]["specification"];
    let passed = |k: usize| verdict["limits"][k]["passed"].as_bool().unwrap();
    assert_eq!((passed(0), passed(1), &verdict["passed"]), (true, false, &false.into()));
    let csv = fs::read_to_string(Path::new(&out).join("report/table.csv")).unwrap();
    let band = verdict["limits"][1]["value"].as_f64().unwrap();
    assert!(csv.lines().next().unwrap().contains("periods 1 to 5 mm after plane (nm)"), "{csv}");
    assert!(csv.lines().nth(1).unwrap().contains(&format!(",{band},")), "{csv}");

    let said = judged("constraints: {keep_specification: false}\n");
    assert!(said.contains("Of the 2 plans, raster-joint-"), "{said}");
    assert!(said.contains("1 of 2 missed") && said.contains("/limits.json pitch_mm=2"), "{said}");
}

#[test]
fn a_mistake_is_named_with_its_file_and_line_and_nothing_is_written() {
    let dir = tempfile::tempdir().unwrap();
    for (from, to, said) in [
        (
            "pitch_mm: 2",
            "pitch_um: 2000",
            "some.yaml: line 6: no setting 'pitch_um'; write pitch_mm, in that unit",
        ),
        (
            "reports: none",
            "constraints: {keep_specification: false}",
            "line 3: keep_specification is given without a specification",
        ),
        ("raster", "zigzag", "some.yaml: line 5: path is 'zigzag'; give raster, maze"),
        (
            "pitch_mm: 2",
            "pitch_mm: {from: 2, to: 1, step: 1}",
            "line 6: the range of pitch_mm is empty",
        ),
        ("FIXTURE", "nowhere.json", "fixture: "),
        ("{fixture: FIXTURE}", "{surface: nowhere, tif: nowhere}", "nowhere: cannot read"),
        (
            "{fixture: FIXTURE}",
            "{fixture: FIXTURE, prepare: \"'\"}",
            "prepare: ': the quotation mark",
        ),
    ] {
        assert!(SWEEP.contains(from));
        let file = written(dir.path(), &SWEEP.replacen(from, to, 1));
        let out = dir.path().join("out");
        let found = ended(2, &["expand", file.to_str().unwrap(), "--out", out.to_str().unwrap()]);
        assert!(found.starts_with("error: ") && found.contains(said), "{found}");
        assert!(!out.join("sweep.json").exists());
    }
    let unreadable = dir.path().join("binary.yaml");
    fs::write(&unreadable, [0xff, 0xfe, 0x00]).unwrap();
    ended(
        2,
        &["expand", unreadable.to_str().unwrap(), "--out", dir.path().join("o").to_str().unwrap()],
    );
}

#[test]
fn a_directory_that_is_somebody_elses_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let file = written(dir.path(), SWEEP);
    fs::create_dir(dir.path().join("mine")).unwrap();
    fs::write(dir.path().join("mine/notes.txt"), "mine").unwrap();
    let mine = dir.path().join("mine").to_str().unwrap().to_string();
    let said = ended(2, &["expand", file.to_str().unwrap(), "--out", &mine]);
    assert!(said.contains("holds notes.txt and no sweep.json"), "{said}");
    assert_eq!(fs::read_dir(&mine).unwrap().count(), 1);
    let said = ended(2, &["run", &mine, "--layer", "mirror"]);
    assert!(said.contains("sweep.json: is not there"), "{said}");
    // While a workflow runs, its plans stay.
    let taken = expanded(dir.path(), "taken");
    let lock = fs::File::create(Path::new(&taken).join("lock")).unwrap();
    lock.lock().unwrap();
    let said = ended(2, &["expand", file.to_str().unwrap(), "--out", &taken]);
    assert!(said.contains("is in use by another just sweep"), "{said}");
    drop(lock);
    expanded(dir.path(), "taken");
    fs::write(dir.path().join("mine/sweep.json"), "{}").unwrap();
    let said = ended(2, &["run", &mine, "--layer", "mirror"]);
    assert!(said.contains("sweep.json: cannot read"), "{said}");
}

/// Checks that a `sweep.json` from elsewhere cannot run any program or write outside of the directory of the sweep.
#[test]
fn a_sweep_that_no_expansion_wrote_runs_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let out = expanded(dir.path(), "sweep");
    let file = Path::new(&out).join("sweep.json");
    let whole: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    let shell = serde_json::json!({"program": "/bin/sh", "arguments": ["-c", "touch EXECUTED"]});
    let elsewhere = serde_json::json!("../../ESCAPED");
    type Change<'a> = dyn Fn(&mut Value) + 'a;
    let cases: [(&Change<'_>, &str); 9] = [
        (&|s| s["mirror_steps"][0] = shell.clone(), "runs '/bin/sh', which makes no mirror"),
        (&|s| s["mirror_steps"][0]["program"] = "../planish-fixture".into(), "makes no mirror"),
        (&|s| s["mirror_steps"][0]["arguments"][2] = elsewhere.clone(), "not in the sweep"),
        (&|s| s["mirror_steps"][0]["arguments"][3] = "--wall-time=/x".into(), "'--wall-time=/x'"),
        (&|s| s["surface"] = elsewhere.clone(), "'../../ESCAPED', not in the sweep"),
        (&|s| s["rounds"][0]["id"] = "$(touch EXECUTED)".into(), "a round is named"),
        (&|s| s["rounds"][0]["plans"][0]["id"] = elsewhere.clone(), "is not that of its plan"),
        (&|s| s["rounds"][0]["plans"][0]["path_id"] = elsewhere.clone(), "is not that of its plan"),
        (&|s| s["rounds"][0]["plans"][0]["method"] = elsewhere.clone(), "is not that of its plan"),
    ];
    for (change, said) in cases {
        let mut sweep = whole.clone();
        change(&mut sweep);
        fs::write(&file, sweep.to_string()).unwrap();
        for layer in ["mirror", "paths", "plans"] {
            let message = ended(2, &["run", &out, "--layer", layer]);
            assert!(
                message.contains(said) && message.contains("expand the sweep again"),
                "{message}"
            );
        }
        let left: Vec<_> = fs::read_dir(&out)
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .collect();
        assert!(left.iter().all(|name| ["sweep.json", "inputs"].contains(&&**name)), "{left:?}");
    }
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2, "the sweep and its file");
}
