//! `planish export`: trajectories as programs of motion controllers.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish export galil --trajectory out/trajectory --machine machine.json --out run.dmc\n\
    \x20 planish export pmac --axes out/axes --form sphere.json --machine five-axis.json --out run.pmc";

/// A motion as the program of a motion controller
///
/// --trajectory is a motion of the axes x and y. --axes is a motion of all axes, which planish axes motion makes.
///
/// The limits of the machine hold on the whole motion, or nothing is written. FILE.json beside the
/// program says what it is.
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct ExportCli {
    #[command(subcommand)]
    export: crate::cli::Export,
}

/// The command `planish export`: its name, its main function, and its command line.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: ExportCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &ExportCli| cli.export.run())
}
