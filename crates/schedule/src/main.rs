//! `planish-schedule`: tool path and dwell times become a motion.

use std::{path::PathBuf, process::ExitCode};

use clap::{Args, Parser, Subcommand, ValueEnum};
use planish_handoff::{Artifact, Begin, Failure, OutputArgs, Stage, Status, run, stage::say};
use planish_schedule::{constant_acceleration, position, pvt};
use planish_types::{DwellTime, ToolPath, Trajectory};
use serde_json::{Value, json};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-schedule pvt --tool-path out/tool_path --dwell out/dwell --machine machine.json --mode monotone --out out/trajectory";

/// Turn a tool path and dwell times into a motion that the machine can follow
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    scheduler: Scheduler,
}

#[derive(Subcommand)]
enum Scheduler {
    /// Cubic segments through the control points at the dwell times, within the limits
    Pvt {
        #[command(flatten)]
        common: Common,
        /// What the motion shall be like
        #[arg(long, value_enum, default_value = "smooth")]
        mode: Mode,
        /// Refuse dwell times that the machine cannot follow instead of stretching them
        #[arg(long)]
        no_stretch: bool,
    },
    /// One constant acceleration, then constant velocity, per segment; no look-ahead
    ConstantAcceleration {
        #[command(flatten)]
        common: Common,
    },
    /// Stand at the dwell points and jump between them: the ideal, no machine can do it
    Position {
        #[command(flatten)]
        common: Common,
    },
}

#[derive(Args)]
struct Common {
    /// Tool path [tool_path artifact]
    #[arg(long, value_name = "DIR")]
    tool_path: PathBuf,
    /// Dwell times [dwell artifact]
    #[arg(long, value_name = "DIR")]
    dwell: PathBuf,
    /// Limits of the machine [JSON file]
    #[arg(long, value_name = "FILE")]
    machine: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum Mode {
    /// Least acceleration energy; may overshoot corners
    Smooth,
    /// Least acceleration energy without reversal inside a segment
    Monotone,
}

fn main() -> ExitCode {
    let cli: Cli = planish_handoff::parse();
    run(|| schedule(&cli.scheduler))
}

fn schedule(scheduler: &Scheduler) -> Result<Status, Failure> {
    let (method, common, settings) = match scheduler {
        Scheduler::Pvt { common, mode, no_stretch } => {
            let mode = match mode {
                Mode::Smooth => pvt::Mode::Smooth,
                Mode::Monotone => pvt::Mode::Monotone,
            };
            ("pvt", common, Some(pvt::Settings { mode, stretch: !no_stretch }))
        }
        Scheduler::ConstantAcceleration { common } => ("constant-acceleration", common, None),
        Scheduler::Position { common } => ("position", common, None),
    };
    let mut stage =
        Stage::new("planish-schedule", env!("CARGO_PKG_VERSION"), method, &common.output);
    stage.settings(settings.map_or(json!({}), |s| json!(s)));
    let path: ToolPath = stage.read("tool-path", &common.tool_path)?;
    let dwell: DwellTime = stage.read("dwell", &common.dwell)?;
    let machine = stage.read_machine(&common.machine)?;
    if let Begin::Unchanged(status) = stage.begin(&[""], Trajectory::KIND)? {
        return Ok(status);
    }

    let (trajectory, report, remark): (Trajectory, Value, String) = match scheduler {
        Scheduler::Pvt { .. } => {
            let settings = settings.expect("set above");
            let s = pvt::schedule(&path, &dwell, &machine, &settings)?;
            let remark = format!(
                "; {} segments stretched by {:.4} s with the tool on, {:.4} s lifted",
                s.report.stretched.len(),
                s.report.added_tool_on_s,
                s.report.added_tool_off_s
            );
            (s.trajectory, json!(s.report), remark)
        }
        Scheduler::ConstantAcceleration { .. } => {
            let s = constant_acceleration::schedule(&path, &dwell, &machine)?;
            let (r, micron) = (&s.report, 1e3);
            let remark = format!(
                "; overshoot in {} x and {} y segments, up to {:.1} and {:.1} um; {} segments late by {:.4} s",
                r.overshoot_segments[0],
                r.overshoot_segments[1],
                r.largest_overshoot_mm[0] * micron,
                r.largest_overshoot_mm[1] * micron,
                r.late_segments,
                r.added_s
            );
            (s.trajectory, json!(s.report), remark)
        }
        Scheduler::Position { .. } => {
            (position::schedule(&path, &dwell)?, json!({}), "; jumps between the points".into())
        }
    };

    let outcome = json!({
        "dwell_s": dwell.total_s(),
        "total_time_s": trajectory.total_time_s(),
        "report": report,
    });
    stage.write("", &trajectory, outcome, &Status::Done)?;
    say(format!(
        "{method}: {} segments, {:.3} s (dwell {:.3} s){remark} -> {}",
        trajectory.len(),
        trajectory.total_time_s(),
        dwell.total_s(),
        common.output.out.display()
    ));
    Ok(Status::Done)
}
