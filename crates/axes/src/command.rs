//! `planish axes`: the motion of all axes of a machine, and the contact point that it executes.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish axes motion --trajectory out/trajectory --machine five-axis.json --form sphere.json --out out/axes\n\
    \x20 planish verify --axes out/axes --machine five-axis.json --out out/verdict\n\
    \x20 planish axes contact --axes out/axes --machine five-axis.json --form sphere.json --out out/executed";

/// Turn a plan on a curved part into the motion of all axes of the machine
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct AxesCli {
    #[command(subcommand)]
    command: crate::cli::AxesCommand,
}

/// The command `planish axes`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: AxesCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &AxesCli| cli.command.run())
}
