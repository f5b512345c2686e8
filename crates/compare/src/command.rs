//! `planish compare`: compares the numbers of runs side by side, and the arrays of two artifacts.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish compare report out/raster --out out/raster/report\n\
    \x20 planish compare report out/raster out/maze --out out/both\n\
    \x20 planish compare several out/several/mirror --out out/several/mirror/report\n\
    \x20 planish compare figures out/raster --format pdf --out out/figures\n\
    \x20 planish compare sweep out/sweeps/small/table.json --out out/sweeps/small/report\n\
    \x20 planish compare diff out/a/removal out/b/removal --max-difference 0.001";

/// Compare runs, or two artifacts
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct CompareCli {
    #[command(subcommand)]
    command: crate::cli::CompareCommand,
}

/// The command `planish compare`: its name, its main function, and its command line.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: CompareCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &CompareCli| cli.command.run())
}
