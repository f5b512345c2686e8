//! Commands of the one program: which words start which stage.

use std::process::{Command, Output};

use planish_testkit::program::{planish, stage, text};

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
    assert_eq!(help.replace("Usage: planish dwell ", "Usage: planish-dwell "), same);
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
    for command in ["run", "show", "next-run", "dwell", "bspline-feed", "export", "sweep"] {
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
