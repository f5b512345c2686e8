//! `planish sweep`: many plans of one mirror, in batches.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish sweep expand sweeps/small.yaml --out out/sweeps/small\n\
    \x20 planish sweep run out/sweeps/small --layer plans --job 1 --jobs 4 --at-once 2\n\
    \x20 planish sweep propose out/sweeps/small\n\
    \x20 planish sweep again out/sweeps/small raster-joint-0123456789ab";

/// Many plans of one mirror: what is in a sweep, and the stages that make it
///
/// `just sweep` calls it by way of Snakemake.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct SweepCli {
    #[command(subcommand)]
    command: crate::cli::SweepCommand,
}

/// The command `planish sweep`: its name, its main function, and its command line.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: SweepCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &SweepCli| cli.command.run())
}
