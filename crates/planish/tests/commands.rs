//! Commands of the one program: which words start which stage.

use std::process::{Command, Output};

use planish_testkit::program::{planish, stage, text};
use serde_json::{Value, json};

/// Runs `planish` with these words.
fn run(words: &[&str]) -> Output {
    Command::new(planish()).args(words).output().unwrap()
}

/// Returns the standard output of a run that ends well.
fn printed(words: &[&str]) -> String {
    let output = run(words);
    assert_eq!(output.status.code(), Some(0), "{words:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

#[test]
fn a_stage_is_a_command_with_its_own_help() {
    let help = printed(&["dwell", "--help"]);
    assert!(help.contains("Usage: planish dwell "), "{help}");
    let same = text(&stage("planish-dwell").arg("--help").output().unwrap().stdout);
    assert_eq!(help, same);
    assert!(printed(&["bspline-feed", "--version"]).starts_with("planish-bspline-feed "));
}

#[test]
fn the_commands_of_the_runner_need_no_run_before_them() {
    let settings = |words: &[&str]| {
        let root = planish_testkit::workspace();
        let output =
            Command::new(planish()).args(words).env("PLANISH_SHARE", root).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{words:?}: {}", text(&output.stderr));
        text(&output.stdout)
    };
    let table = settings(&["show", "raster"]);
    assert!(table.contains("pitch_mm"), "{table}");
    assert_eq!(table, settings(&["planish-run", "show", "raster"]));
    // The name of a stage and of a command of the runner: a subcommand or a flag of the stage starts the stage.
    assert!(printed(&["compare", "report", "--help"]).contains("Usage: planish compare report "));
    assert!(printed(&["tolerance", "--help"]).contains("--error-budget"));
    let several = run(&["tolerance", "no-such-pipeline"]);
    assert_eq!(several.status.code(), Some(2));
    assert!(text(&several.stderr).contains("no-such-pipeline"), "{}", text(&several.stderr));
}

#[test]
fn the_program_lists_its_commands_and_refuses_others() {
    let help = printed(&["--help"]);
    for command in ["run", "show", "next-run", "dwell", "bspline-feed", "export", "sweep", "doctor"]
    {
        assert!(help.contains(&format!("\n  {command} ")), "{command}: {help}");
    }
    let refused = run(&["polish"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("unrecognized subcommand 'polish'"));
    assert_eq!(run(&[]).status.code(), Some(2));
    let completions = printed(&["--completions", "bash"]);
    assert!(completions.contains("--min-dwell-s") && completions.contains("_planish"));
    assert!(printed(&["--man"]).contains(".TH planish"));
}

#[test]
fn every_command_has_a_manual_page() {
    for words in [&["dwell", "--man"][..], &["dwell", "rifta", "--man"], &["next-run", "--man"]] {
        assert!(printed(words).contains(".TH "), "{words:?}");
    }
}

#[test]
fn a_sweep_is_started_by_its_file_and_the_stage_by_its_subcommand() {
    assert!(printed(&["sweep", "expand", "--help"]).contains("Usage: planish sweep expand "));
    let root = planish_testkit::workspace();
    let missing = Command::new(planish())
        .args(["sweep", "no-such.yaml"])
        .env("PLANISH_SHARE", root)
        .output()
        .unwrap();
    assert_eq!(missing.status.code(), Some(2));
    assert!(
        text(&missing.stderr).contains("no-such.yaml is not there"),
        "{}",
        text(&missing.stderr)
    );
}

/// The JSON object that a command prints.
fn object(words: &[&str]) -> (Option<i32>, Value) {
    let output = run(words);
    let object = serde_json::from_slice(&output.stdout);
    let problem = format!("{words:?}: {}{}", text(&output.stdout), text(&output.stderr));
    (output.status.code(), object.expect(&problem))
}

#[test]
fn a_command_tells_its_outcome_as_json_or_nothing() {
    let root = planish_testkit::workspace();
    let folder = tempfile::tempdir().unwrap();
    let recipe = root.join("fixtures/coupon.json").display().to_string();
    let out = folder.path().join("mirror").display().to_string();
    let words = ["fixture", &recipe, "--out", &out];
    assert!(printed(&words).starts_with("coupon: surface 81 x 49 px"));
    // The output is there already: its outcome is told all the same.
    let (code, told) = object(&[&words[..], &["--json"]].concat());
    assert_eq!((code, &told["exit_code"], &told["message"]), (Some(0), &json!(0), &Value::Null));
    let outputs = told["outputs"].as_array().unwrap();
    assert_eq!(outputs.len(), 2, "{told}");
    assert!(outputs.iter().any(|output| output["kind"] == "surface"), "{told}");
    assert!(told["text"][0].as_str().unwrap().contains("nothing to do"), "{told}");
    assert_eq!(printed(&[&words[..], &["--quiet"]].concat()), "");
    // Numbers that are only printed are in the text.
    let surface = format!("{out}/surface");
    let (_, told) = object(&["--json", "surface", "statistics", "--surface", &surface]);
    assert!(told["text"][0].as_str().unwrap().contains("nm"), "{told}");
    // A refusal is in the message, and still on standard error.
    let (code, told) = object(&["surface", "statistics", "--surface", "no-such", "--json"]);
    assert_eq!((code, &told["exit_code"]), (Some(2), &json!(2)));
    assert!(told["message"].as_str().unwrap().starts_with("error: no-such"), "{told}");
}

#[test]
fn a_pipeline_tells_its_report_as_json() {
    let root = planish_testkit::workspace();
    let folder = tempfile::tempdir().unwrap();
    let out = format!("out={}", folder.path().join("run").display());
    let words = [
        "run",
        "raster",
        "fixture=coupon",
        "pitch_mm=2",
        "refine=no",
        "plan_joint=no",
        "frames=0",
        &out,
    ];
    let told = |flag: &str| {
        let mut command = Command::new(planish());
        let output = command.args(words).arg(flag).env("PLANISH_SHARE", &root).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        text(&output.stdout)
    };
    let object: Value = serde_json::from_str(&told("--json")).unwrap();
    let outputs = object["outputs"].as_array().unwrap();
    let run = outputs.iter().find(|output| output["kind"] == "run").expect("the run is an output");
    let summary = &run["outcome"];
    assert!(summary["methods"]["pvt"]["rms_nm"].as_f64().unwrap() < 10.0, "{object}");
    assert_eq!(told("--quiet"), "");
}
