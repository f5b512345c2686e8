//! `planish-axes`: the motion of all axes of a machine, and the contact point that it executes.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-axes motion --trajectory out/trajectory --machine five-axis.json --form sphere.json --out out/axes\n\
    \x20 planish-verify --axes out/axes --machine five-axis.json --out out/verdict\n\
    \x20 planish-axes contact --axes out/axes --machine five-axis.json --form sphere.json --out out/executed";

/// Turn a plan on a curved part into the motion of all axes of the machine
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: crate::cli::Command,
}

/// The command `planish axes`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: Cli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.command.run())
}
