//! `planish compare report`.

use std::{
    io::{IsTerminal, Write},
    path::PathBuf,
};

use clap::{Args, ValueEnum};
use planish_compare::{
    answer::to_json,
    chain::Standing,
    front,
    report::{
        RunData, View,
        figure::{Layout, figures},
        page, sparkline, views,
    },
    summary::{Summary, negative},
    table::{csv, execution_table, specification_table, table, table_of_runs},
};
use planish_handoff::{
    Failure, Inputs, Output, Status,
    flags::{OutputArgs, PartArgs},
    kind, say, task, tells_text,
};
use planish_types::{progress, text::visible};
use serde_json::json;

use super::super::files::{self, Names};

#[derive(Args)]
pub struct ReportCommand {
    /// Run: a directory with surface/ and methods/<scheduler>/{trajectory,removal,verdict}/
    #[arg(required = true, value_name = "RUN_DIR")]
    runs: Vec<PathBuf>,
    /// Name of the pipeline [default: the name of the run's directory]
    #[arg(long, value_name = "NAME")]
    pipeline: Option<String>,
    /// Name of the mirror
    #[arg(long, value_name = "NAME", default_value = "")]
    mirror: String,
    /// Map as it was measured, before anything was done to it; shown beside the others [surface
    /// artifact; of one run only]
    #[arg(long, value_name = "DIR")]
    measured: Option<PathBuf>,
    /// Tool influence function, for the part of the residual at wavelengths shorter than it corrects [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: Option<PathBuf>,
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]; drawn beside the motion of all axes,
    /// with the residual along its normal
    #[arg(long, value_name = "PATH")]
    form: Option<PathBuf>,
    /// Row of a program that was read back, such as joint+galil. The report recommends it in the place of its plan [of
    /// one run only; default: the report chooses among all rows]
    #[arg(long, value_name = "ROW")]
    program_row: Option<String>,
    /// Compare the plans by what they leave after the servo of the process: methods/<scheduler>/removal-after-servo, written
    /// by planish simulate --servo-of
    #[arg(long)]
    after_servo: bool,
    /// Name of the machine, if nobody named one and it is that of the fixtures; the result says so
    #[arg(long, value_name = "NAME")]
    assumed_machine: Option<String>,
    #[command(flatten)]
    part: PartArgs,
    /// Small plots under the table; auto: where standard output is a terminal
    #[arg(long, value_enum, default_value = "auto")]
    plots: Plots,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum Plots {
    Auto,
    Always,
    Never,
}

impl Plots {
    /// Returns true if the small plots are printed: with `always`, and with `auto` if standard output is a terminal.
    fn are_wanted(self) -> bool {
        match self {
            Self::Always => true,
            Self::Auto => std::io::stdout().is_terminal(),
            Self::Never => false,
        }
    }
}

impl ReportCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        let ReportCommand {
            runs,
            pipeline,
            mirror: fixture,
            measured,
            tif,
            form,
            program_row: program,
            after_servo,
            assumed_machine,
            part,
            plots,
            output,
        } = self;
        let part = part.part();
        let mut inputs = Inputs::new();
        let names: Vec<String> = runs.iter().map(|dir| files::name_of(dir)).collect();
        let task = task!(
            "report",
            json!({ "pipeline": pipeline, "fixture": fixture, "runs": names, "program": program,
                "after_servo": after_servo, "assumed_machine": assumed_machine, "part": part })
        );
        let called = Names {
            pipeline: pipeline.as_deref(),
            fixture,
            measured: measured.as_deref().filter(|_| runs.len() == 1),
            tif: tif.as_deref(),
            form: form.as_deref(),
            after_servo: *after_servo,
        };
        if measured.is_some() && runs.len() > 1 {
            let count = runs.len();
            let message = format!("--measured is of one run, {count} are given; leave it out");
            return Err(Failure::new(message));
        }
        let read = runs.iter().enumerate();
        let read = read.map(|(i, dir)| files::read_run(&mut inputs, i, dir, &called));
        let mut read = read.collect::<Result<Vec<_>, _>>()?;
        recommend(program.as_deref(), &mut read)?;
        for run in &mut read {
            run.summary.part = part.clone();
        }
        for (run, name) in read.iter_mut().zip(assumed_machine.iter().cycle()) {
            run.summary.remarks.push(planish_types::assumed_machine(name));
        }
        let summaries: Vec<Summary> = read.iter().map(|run| run.summary.clone()).collect();
        let runs: Vec<_> = names.iter().map(String::as_str).zip(&summaries).collect();
        let status = negative(&runs).map_or(Status::Done, Status::Negative);
        let writer = Output::directory(output, &kind::REPORT).begin(&task, &inputs)?.writer();

        let plotted = tells_text() && plots.are_wanted();
        // The plots are wanted every time, also when the files are there already.
        let views = if writer.is_some() || plotted { made_views(read) } else { vec![] };
        if let Some(mut writer) = writer {
            let beside = files_of_page(&views, &runs)?;
            let beside: Vec<(&str, Vec<u8>)> =
                beside.iter().map(|(name, bytes)| (name.as_str(), bytes.clone())).collect();
            writer.write_arrays(&kind::REPORT, &[], &beside, json!({}), &status)?;
        }
        tell(&runs);
        if plotted {
            say(sparkline::plots(&views));
        }
        for name in ["summary.json", "report.html"] {
            say(visible(&output.out.join(name).to_string_lossy()));
        }
        warn_of_old(&runs);
        Ok(status)
    }
}

fn made_views(read: Vec<RunData>) -> Vec<View> {
    progress::part(0, 3, || views(read))
}

/// Returns the files of a report of these runs, each with its name: summary, tables, page and figures.
pub(super) fn report_files(
    read: Vec<RunData>,
    runs: &[(&str, &Summary)],
) -> Result<Vec<(String, Vec<u8>)>, Failure> {
    files_of_page(&made_views(read), runs)
}

fn files_of_page(
    views: &[View],
    runs: &[(&str, &Summary)],
) -> Result<Vec<(String, Vec<u8>)>, Failure> {
    let summary = to_json(runs);
    let mut bytes = serde_json::to_vec_pretty(&summary)?;
    bytes.push(b'\n');
    let points = front::points(runs);
    let page = progress::part(1, 3, || page(views, &summary, &points));
    let mut files = vec![
        ("summary.json".to_string(), bytes),
        ("table.csv".to_string(), csv(runs).into_bytes()),
        ("front.csv".to_string(), front::csv(&points).into_bytes()),
        ("report.html".to_string(), page.into_bytes()),
    ];
    for (name, svg) in progress::part(2, 3, || figures(views, &Layout::BESIDE_PAGE)) {
        files.push((format!("{name}.svg"), svg.into_bytes()));
    }
    Ok(files)
}

/// Makes the row `program` of the only run its recommendation; does nothing for `None`. Refuses a row if there are
/// several runs. `read` are the runs of the command line.
fn recommend(program: Option<&str>, read: &mut [RunData]) -> Result<(), Failure> {
    match (program, read) {
        (None, _) => Ok(()),
        (Some(row), [run]) => run.summary.recommend(row).map_err(Failure::new),
        (Some(_), _) => {
            let message = "--program-row is of one run; give one run, or leave it out";
            Err(Failure::new(message))
        }
    }
}

/// Prints one line on standard error; a closed pipe is not an error.
fn warn(message: &str) {
    let _ = writeln!(std::io::stderr(), "{}", visible(message));
}

/// Prints the tables of the runs, and the sentences that go with them.
fn tell(runs: &[(&str, &Summary)]) {
    say(match runs {
        [(_, one)] => table(one),
        _ => table_of_runs(runs),
    });
    say(execution_table(runs));
    let judged = specification_table(runs);
    if !judged.is_empty() {
        say(judged);
    }
    for (name, method) in runs.iter().flat_map(|(_, s)| &s.methods) {
        if let Some(on_axes) = &method.on_axes {
            say(visible(&on_axes.sentence(name)));
        }
    }
    for process in runs.iter().filter_map(|(_, s)| s.error_budget.as_ref()) {
        say(visible(&process.sentence));
    }
}

/// Prints a warning on standard error for every method that is out of date, with the reasons.
fn warn_of_old(runs: &[(&str, &Summary)]) {
    for (name, left) in runs.iter().flat_map(|(n, s)| s.left_out.iter().map(move |l| (n, l))) {
        if left.standing == Standing::OutOfDate {
            let warning = format!("warning: {name}/methods/{} is out of date", left.name);
            warn(&format!("{warning}: {}", left.reasons.join("; ")));
        }
    }
}
