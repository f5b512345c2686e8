//! `planish schedule`: a motion from a tool path and dwell times.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish schedule pvt --tool-path out/tool_path --dwell out/dwell --machine machine.json --mode monotone --out out/trajectory";

/// Turn a tool path and dwell times into a motion that the machine can follow
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct ScheduleCli {
    #[command(subcommand)]
    command: crate::cli::ScheduleCommand,
}

/// The command `planish schedule`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: ScheduleCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &ScheduleCli| cli.command.run())
}
