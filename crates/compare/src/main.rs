//! `planish-compare`: the numbers of runs side by side, and the difference of two artifacts.

mod files;

use std::{path::PathBuf, process::ExitCode};

use clap::{Parser, Subcommand};
use planish_compare::{
    diff::difference,
    execution::execution_table,
    summary::{Summary, to_json},
    table::{table, table_of_runs},
};
use planish_handoff::{Begin, Failure, OutputArgs, Stage, Status, kind, run, stage::say};
use serde_json::json;

/// Compare runs, or two artifacts
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Print the results of the methods of one or several runs side by side, and write summary.json
    Report(Report),
    /// Print how far the arrays of two artifacts are apart; exit code 1 above the tolerance
    Diff(Diff),
}

#[derive(clap::Args)]
struct Report {
    /// Run: a directory with surface/ and methods/<scheduler>/{trajectory,removal,verdict}/
    #[arg(required = true, value_name = "RUN_DIR")]
    runs: Vec<PathBuf>,
    /// Name of the pipeline [default: the name of the run's directory]
    #[arg(long, value_name = "NAME")]
    pipeline: Option<String>,
    /// Name of the mirror
    #[arg(long, value_name = "NAME", default_value = "")]
    fixture: String,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(clap::Args)]
struct Diff {
    /// First artifact, or directory of .npy files
    #[arg(value_name = "A")]
    a: PathBuf,
    /// Second artifact, or directory of .npy files
    #[arg(value_name = "B")]
    b: PathBuf,
    /// Largest absolute difference that is accepted [in the unit of each array]
    #[arg(long, value_name = "T")]
    tolerance: f64,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    run(|| match &cli.command {
        Command::Report(arguments) => report(arguments),
        Command::Diff(arguments) => diff(arguments),
    })
}

fn report(arguments: &Report) -> Result<Status, Failure> {
    let Report { runs, pipeline, fixture, output } = arguments;
    let mut stage = Stage::new("planish-compare", env!("CARGO_PKG_VERSION"), "report", output);
    let names: Vec<String> = runs.iter().map(|dir| files::name_of(dir)).collect();
    stage.settings(json!({ "pipeline": pipeline, "fixture": fixture, "runs": names }));
    let mut summaries = Vec::new();
    for (i, dir) in runs.iter().enumerate() {
        let (surface, methods) = files::read_run(&mut stage, i, dir)?;
        let pipeline = pipeline.as_ref().unwrap_or(&names[i]);
        summaries.push(Summary::new(pipeline, fixture, &surface, methods));
    }
    let begin = stage.begin(&[""], &kind::REPORT)?;

    let mut bytes = serde_json::to_vec_pretty(&to_json(&summaries))?;
    bytes.push(b'\n');
    // The table is wanted every time, also when the file is there already.
    if begin == Begin::Run {
        let beside = [("summary.json", bytes)];
        stage.write_files("", &kind::REPORT, &[], &beside, json!({}), &Status::Done)?;
    }
    let runs: Vec<_> = names.iter().map(String::as_str).zip(&summaries).collect();
    say(match &summaries[..] {
        [one] => table(one),
        _ => table_of_runs(&runs),
    });
    say(execution_table(&runs));
    say(output.out.join("summary.json").display());
    Ok(Status::Done)
}

fn diff(arguments: &Diff) -> Result<Status, Failure> {
    let Diff { a, b, tolerance } = arguments;
    if tolerance.is_nan() || *tolerance < 0.0 {
        let message = format!("--tolerance is {tolerance}; give a number that is not negative");
        return Err(Failure::new(message));
    }
    let mut lines = Vec::new();
    let mut beyond = Vec::new();
    for (name, [x, y]) in files::read_pair(a, b)? {
        let found = difference(&x, &y)
            .map_err(|e| Failure::new(format!("{name}: {e}; nothing compared")))?;
        if found.largest > *tolerance {
            beyond.push(format!("{name} by {:e}", found.largest));
        }
        lines.push(found.line(&name));
    }
    lines.iter().for_each(say);
    Ok(match beyond.is_empty() {
        true => Status::Done,
        false => Status::Negative(format!("above {tolerance:e}: {}", beyond.join(", "))),
    })
}
