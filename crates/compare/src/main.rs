//! `planish-compare`: the numbers of runs side by side, and the difference of two artifacts.

mod files;

use std::{
    io::{IsTerminal, Write},
    path::PathBuf,
    process::ExitCode,
};

use clap::{Parser, Subcommand};
use planish_compare::{
    chain::Standing,
    diff::difference,
    dwell,
    report::{figure::figures, page, sparkline, views},
    summary::{Summary, to_json},
    table::{execution_table, table, table_of_runs},
};
use planish_handoff::{Failure, Inputs, Output, Status, flags::OutputArgs, kind, run, say, task};
use planish_types::text::visible;
use serde_json::json;

use crate::files::Names;

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-compare report out/raster --out out/raster/report\n\
    \x20 planish-compare report out/raster out/maze --out out/both\n\
    \x20 planish-compare diff out/a/removal out/b/removal --tolerance 0.001";

/// Compare runs, or two artifacts
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Print the results of the methods of one or several runs side by side; write summary.json,
    /// report.html and figures (SVG)
    Report(Report),
    /// Print the results of dwell solvers side by side, and write summary.json
    Dwell(Dwell),
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
    /// Map as it was measured, before anything was done to it; shown beside the others [surface
    /// artifact; of one run only]
    #[arg(long, value_name = "DIR")]
    measured: Option<PathBuf>,
    /// Small plots under the table; auto: where standard output is a terminal
    #[arg(long, value_enum, default_value = "auto")]
    plots: Plots,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Plots {
    Auto,
    Always,
    Never,
}

#[derive(clap::Args)]
struct Dwell {
    /// Run: a directory with surface/, tool_path/ and solvers/<solver>/ with dwell/,
    /// position/removal/, executed/{trajectory,removal}/, dwell-wall.json, or only message.txt
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
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
    /// Largest absolute difference that is accepted, in the unit of each array
    #[arg(long, value_name = "T")]
    tolerance: f64,
}

fn main() -> ExitCode {
    let cli: Cli = planish_handoff::parse();
    run(|| {
        let ended = match &cli.command {
            Command::Report(arguments) => report(arguments),
            Command::Dwell(arguments) => dwell_solvers(arguments),
            Command::Diff(arguments) => diff(arguments),
        };
        // Names of files and directories may command the terminal.
        match ended {
            Ok(Status::Negative(reason)) => Ok(Status::Negative(visible(&reason).into_owned())),
            Err(failure) => Err(Failure::new(visible(&failure.to_string()))),
            done => done,
        }
    })
}

fn report(arguments: &Report) -> Result<Status, Failure> {
    let Report { runs, pipeline, fixture, measured, plots, output } = arguments;
    let mut inputs = Inputs::new();
    let names: Vec<String> = runs.iter().map(|dir| files::name_of(dir)).collect();
    let task = task!("report", json!({ "pipeline": pipeline, "fixture": fixture, "runs": names }));
    let called = Names {
        pipeline: pipeline.as_deref(),
        fixture,
        measured: measured.as_deref().filter(|_| runs.len() == 1),
    };
    if measured.is_some() && runs.len() > 1 {
        let message = format!("--measured is of one run, {} are given; leave it out", runs.len());
        return Err(Failure::new(message));
    }
    let read = runs.iter().enumerate();
    let read = read.map(|(i, dir)| files::read_run(&mut inputs, i, dir, &called));
    let read = read.collect::<Result<Vec<_>, _>>()?;
    let summaries: Vec<Summary> = read.iter().map(|run| run.summary.clone()).collect();
    let status = status(&names, &summaries);
    let writer = Output::directory(output, &kind::REPORT).begin(&task, &inputs)?.writer();

    let plotted = match plots {
        Plots::Always => true,
        Plots::Auto => std::io::stdout().is_terminal(),
        Plots::Never => false,
    };
    // The table is wanted every time, also when the files are there already.
    let views = if writer.is_some() || plotted { views(read) } else { vec![] };
    if let Some(mut writer) = writer {
        let summary = to_json(&summaries);
        let mut bytes = serde_json::to_vec_pretty(&summary)?;
        bytes.push(b'\n');
        let page = page(&views, &summary);
        let mut beside = vec![("summary.json", bytes), ("report.html", page.into_bytes())];
        beside.extend(figures(&views).into_iter().map(|(name, svg)| (name, svg.into_bytes())));
        writer.write_arrays(&kind::REPORT, &[], &beside, json!({}), &status)?;
    }
    let runs: Vec<_> = names.iter().map(String::as_str).zip(&summaries).collect();
    say(match &summaries[..] {
        [one] => table(one),
        _ => table_of_runs(&runs),
    });
    say(execution_table(&runs));
    if plotted {
        say(sparkline::plots(&views));
    }
    for name in ["summary.json", "report.html"] {
        say(visible(&output.out.join(name).to_string_lossy()));
    }
    for (name, left) in runs.iter().flat_map(|(n, s)| s.left_out.iter().map(move |l| (n, l))) {
        if left.standing == Standing::OutOfDate {
            let warning = format!("warning: {name}/methods/{} is out of date", left.name);
            warn(&format!("{warning}: {}", left.reasons.join("; ")));
        }
    }
    Ok(status)
}

/// Negative where a run has no plan that can be recommended without reserve.
fn status(names: &[String], summaries: &[Summary]) -> Status {
    let several = names.len() > 1;
    let named = names.iter().zip(summaries).flat_map(|(name, summary)| {
        let whose = if several { format!("{name}: ") } else { String::new() };
        summary.reserves().into_iter().map(move |reserve| format!("{whose}{reserve}"))
    });
    match named.collect::<Vec<_>>() {
        none if none.is_empty() => Status::Done,
        reserves => Status::Negative(reserves.join("; ")),
    }
}

/// One line on standard error; a closed pipe is not an error.
fn warn(message: &str) {
    let _ = writeln!(std::io::stderr(), "{}", visible(message));
}

fn dwell_solvers(arguments: &Dwell) -> Result<Status, Failure> {
    let Dwell { run, fixture, output } = arguments;
    let mut inputs = Inputs::new();
    let task = task!("dwell", json!({ "fixture": fixture }));
    let (surface, rows) = files::read_solvers(&mut inputs, run)?;
    let writer = Output::directory(output, &kind::REPORT).begin(&task, &inputs)?.writer();
    let solvers: serde_json::Map<String, serde_json::Value> =
        rows.iter().map(|(name, row)| (name.clone(), json!(row))).collect();
    let initial = surface.statistics();
    let summary = json!({
        "fixture": fixture,
        "initial": { "rms_nm": initial.rms, "pv_nm": initial.pv },
        "solvers": solvers,
    });
    let mut bytes = serde_json::to_vec_pretty(&summary)?;
    bytes.push(b'\n');
    // The table is wanted every time, also when the file is there already.
    if let Some(mut writer) = writer {
        let beside = [("summary.json", bytes)];
        writer.write_arrays(&kind::REPORT, &[], &beside, json!({}), &Status::Done)?;
    }
    say(dwell::table(fixture, &surface, &rows));
    say(visible(&output.out.join("summary.json").to_string_lossy()));
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
