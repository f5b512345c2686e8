//! `planish-axes`: the motion of all axes of a machine, and the contact point that it executes.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-axes motion --trajectory out/trajectory --machine five-axis.json --form sphere.json --out out/axes\n\
    \x20 planish-verify --axes out/axes --machine five-axis.json --out out/verdict\n\
    \x20 planish-axes contact --axes out/axes --machine five-axis.json --form sphere.json --out out/executed";

/// Turn a plan on a curved part into the motion of all axes of the machine
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: cli::Command,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.command.run())
}
