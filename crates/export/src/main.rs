//! `planish-export`: trajectories as programs of motion controllers.

use std::{
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::{Args, Parser, Subcommand, ValueEnum};
use planish_export::{Common, Controller, Origin, Program, csv, galil, gcode, pmac, program, xps};
use planish_handoff::{Failure, OutputArgs, Stage, Status, artifact, pair, run, stage::say};
use planish_types::{Limits, Trajectory};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-export galil --trajectory out/trajectory --machine machine.json --out run.dmc";

/// A trajectory as the program of a motion controller
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    controller: Method,
}

#[derive(Debug, Subcommand)]
enum Method {
    /// Galil DMC, PVT mode: counts, counts/s, samples
    Galil {
        /// Sample time, s: 1/1024 with the default TM 1000
        #[arg(long, value_name = "T", default_value_t = 1.0 / 1024.0, allow_negative_numbers = true)]
        sample_s: f64,
        #[command(flatten)]
        common: CommonArgs,
    },
    /// Newport XPS, PVT trajectory file: dt, dx, vx, dy, vy
    Xps {
        /// What a time is rounded to, s
        #[arg(long, value_name = "T", default_value_t = 1e-4, allow_negative_numbers = true)]
        tick_s: f64,
        #[command(flatten)]
        common: CommonArgs,
    },
    /// Delta Tau / Omron PMAC, PVT mode
    Pmac {
        /// What a time is rounded to, s: 1 ms on a PMAC, down to 2.5e-7 on a Turbo PMAC
        #[arg(long, value_name = "T", default_value_t = 1e-3, allow_negative_numbers = true)]
        tick_s: f64,
        /// Unit of time of the velocities, s: Isx90 / 1000
        #[arg(long, value_name = "T", default_value_t = 1.0, allow_negative_numbers = true)]
        feedrate_time_unit_s: f64,
        /// M-variable that switches the tool, 1 for on [default: the program does not switch it]
        #[arg(long, value_name = "M")]
        tool_output: Option<u32>,
        #[command(flatten)]
        common: CommonArgs,
    },
    /// G-code for LinuxCNC and its relatives: straight lines, each in its time
    Gcode {
        /// What F is
        #[arg(long, value_enum, default_value = "inverse-time")]
        feed: FeedArg,
        /// What a time is rounded to, s
        #[arg(long, value_name = "T", default_value_t = 1e-6, allow_negative_numbers = true)]
        tick_s: f64,
        /// How far the path may leave the corners, mm; 0 for an exact path
        #[arg(long, value_name = "P", default_value_t = 0.001, allow_negative_numbers = true)]
        path_tolerance_mm: f64,
        #[command(flatten)]
        common: CommonArgs,
    },
    /// Table of the motion: t, x, vx, y, vy, tool on
    Csv {
        /// What a time is rounded to, s
        #[arg(long, value_name = "T", default_value_t = 1e-6, allow_negative_numbers = true)]
        tick_s: f64,
        #[command(flatten)]
        common: CommonArgs,
    },
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum FeedArg {
    /// G93: 60 / F seconds per line
    InverseTime,
    /// G94: mm per minute
    PerMinute,
}

#[derive(Debug, Args)]
struct CommonArgs {
    /// Motion
    #[arg(long, value_name = "DIR")]
    trajectory: PathBuf,
    /// Machine: its name goes into the header, and its limits hold on the whole motion or nothing is
    /// written
    #[arg(long, value_name = "FILE")]
    machine: PathBuf,
    /// Size of a count, mm: one number, or two for X,Y
    #[arg(long, value_name = "C", value_parser = pair, default_value = "0.0001", allow_hyphen_values = true)]
    count_mm: [f64; 2],
    /// Longest time between two lines, s; longer segments are split [default: what the controller
    /// allows]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    max_step_s: Option<f64>,
    /// Leave the tool on where the motion has it off and the program cannot switch it
    #[arg(long)]
    always_on: bool,
    /// Program to write; FILE.json beside it says what it is
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Replace the files
    #[arg(long)]
    force: bool,
}

fn main() -> ExitCode {
    let method = planish_handoff::parse::<Cli>().controller;
    run(move || {
        let (controller, args) = match method {
            Method::Galil { sample_s, common } => {
                (Controller::Galil(galil::Settings { sample_s }), common)
            }
            Method::Xps { tick_s, common } => (Controller::Xps(xps::Settings { tick_s }), common),
            Method::Pmac { tick_s, feedrate_time_unit_s, tool_output, common } => {
                let settings = pmac::Settings { tick_s, feedrate_time_unit_s, tool_output };
                (Controller::Pmac(settings), common)
            }
            Method::Gcode { feed, tick_s, path_tolerance_mm, common } => {
                let feed = match feed {
                    FeedArg::InverseTime => gcode::Feed::InverseTime,
                    FeedArg::PerMinute => gcode::Feed::PerMinute,
                };
                let settings = gcode::Settings { feed, tick_s, path_tolerance_mm };
                (Controller::Gcode(settings), common)
            }
            Method::Csv { tick_s, common } => (Controller::Csv(csv::Settings { tick_s }), common),
        };
        export(&controller, &args)
    })
}

fn export(controller: &Controller, args: &CommonArgs) -> Result<Status, Failure> {
    let out = &args.out;
    let about = PathBuf::from(format!("{}.json", out.display()));
    for path in [out, &about] {
        if path.is_dir() {
            return Err(Failure::new(format!("{}: is a directory; give a file", path.display())));
        }
        if path.exists() && !args.force {
            let problem = "exists; give --force to replace it, or another --out";
            return Err(Failure::new(format!("{}: {problem}", path.display())));
        }
    }
    let made = make(controller, args)?;
    for warning in &made.about.warnings {
        use std::io::Write;
        let _ = writeln!(std::io::stderr(), "warning: {warning}");
    }
    if let Some(parent) = out.parent() {
        fs::create_dir_all(parent)
            .map_err(|e| Failure::new(format!("{}: cannot create: {e}", parent.display())))?;
    }
    put(out, &made.text)?;
    put(&about, &format!("{}\n", serde_json::to_string_pretty(&made.about)?))?;
    let a = &made.about;
    say(format!(
        "planish-export: {} segments, {:.4} s, rounded by {:.1e} x {:.1e} mm and {:.1e} s at most -> {}",
        a.segments,
        a.total_time_s,
        a.rounding_mm[0],
        a.rounding_mm[1],
        a.rounding_s,
        out.display()
    ));
    Ok(Status::Done)
}

fn make(controller: &Controller, args: &CommonArgs) -> Result<Program, Failure> {
    let output = OutputArgs { out: args.out.clone(), force: args.force, wall_time: None };
    let version = env!("CARGO_PKG_VERSION");
    let mut stage = Stage::new("planish-export", version, "program", &output);
    let machine: Limits = stage.read_machine(&args.machine)?;
    let loaded = artifact::read::<Trajectory>(&args.trajectory)?;
    let origin = Origin {
        made_from: format!("trajectory {}, BLAKE3 {}", args.trajectory.display(), loaded.digest),
        made_by: format!("planish-export {version}"),
    };
    let common =
        Common { count_mm: args.count_mm, max_step_s: args.max_step_s, always_on: args.always_on };
    Ok(program(&loaded.value, &machine, controller, &common, &origin)?)
}

/// `X,Y`, or one number for both.
/// A killed run leaves the old file or the new one.
fn put(path: &Path, text: &str) -> Result<(), Failure> {
    let beside = PathBuf::from(format!("{}.part", path.display()));
    fs::write(&beside, text)
        .and_then(|()| fs::rename(&beside, path))
        .map_err(|e| Failure::new(format!("{}: cannot write: {e}", path.display())))
}
