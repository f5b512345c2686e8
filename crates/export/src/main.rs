//! `planish-export`: trajectories as programs of motion controllers.

use std::{
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::{Args, Parser, Subcommand};
use planish_export::{Common, Controller, Origin, csv, galil, gcode, pmac, program, xps};
use planish_handoff::{
    Failure, Inputs, OutputFile, Status,
    flags::{MachineArgs, OutputFileArgs, TrajectoryArgs},
    pair, run, say, warn,
};

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-export galil --trajectory out/trajectory --machine machine.json --out run.dmc";

/// A trajectory as the program of a motion controller
///
/// The limits of the machine hold on the whole motion, or nothing is written. FILE.json beside the
/// program says what it is.
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
        feed: gcode::Feed,
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

#[derive(Debug, Args)]
struct CommonArgs {
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    #[command(flatten)]
    machine: MachineArgs,
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
    #[command(flatten)]
    output: OutputFileArgs,
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
                let settings = gcode::Settings { feed, tick_s, path_tolerance_mm };
                (Controller::Gcode(settings), common)
            }
            Method::Csv { tick_s, common } => (Controller::Csv(csv::Settings { tick_s }), common),
        };
        export(&controller, &args)
    })
}

fn export(controller: &Controller, args: &CommonArgs) -> Result<Status, Failure> {
    let OutputFileArgs { out, force } = &args.output;
    let about = PathBuf::from(format!("{}.json", out.display()));
    let version = env!("CARGO_PKG_VERSION");
    let mut inputs = Inputs::new();
    let machine = args.machine.read(&mut inputs)?;
    let trajectory = args.trajectory.read(&mut inputs)?;
    let program_file = args.output.begin(&inputs)?;
    let about_file = OutputFile::begin("--out", &about, *force, &inputs)?;
    refuse_foreign_about(&about)?;

    let digest = inputs.digest("trajectory").unwrap_or_default();
    let origin = Origin {
        made_from: format!("trajectory {}, BLAKE3 {digest}", args.trajectory.trajectory.display()),
        made_by: format!("planish-export {version}"),
    };
    let common =
        Common { count_mm: args.count_mm, max_step_s: args.max_step_s, always_on: args.always_on };
    let made = program(&trajectory, &machine, controller, &common, &origin)?;
    for warning in &made.about.warnings {
        warn(warning);
    }
    let about_text = format!("{}\n", serde_json::to_string_pretty(&made.about)?);
    let files = [(program_file, made.text.as_bytes()), (about_file, about_text.as_bytes())];
    OutputFile::write_together(files)?;
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

/// The name of the file beside the program follows from that of the program; the user did not give it,
/// so `--force` replaces there only what an export wrote.
fn refuse_foreign_about(about: &Path) -> Result<(), Failure> {
    let Ok(found) = fs::metadata(about) else { return Ok(()) };
    // A pipe would never end.
    let text = if found.is_file() { fs::read_to_string(about).ok() } else { None };
    let is_ours = text.is_some_and(|text| {
        serde_json::from_str::<serde_json::Value>(&text)
            .is_ok_and(|json| json.get("controller").is_some() && json.get("segments").is_some())
    });
    match is_ours {
        true => Ok(()),
        false => Err(Failure::new(format!(
            "{}: would be replaced by what planish-export says of its program, and Planish did not \
             write it; give another --out",
            about.display()
        ))),
    }
}
