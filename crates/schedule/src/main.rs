//! `planish-schedule`: a motion from a tool path and dwell times.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-schedule pvt --tool-path out/tool_path --dwell out/dwell --machine machine.json --mode monotone --out out/trajectory";

/// Turn a tool path and dwell times into a motion that the machine can follow
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: cli::Command,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.command.run())
}
