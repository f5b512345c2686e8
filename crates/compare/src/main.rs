//! `planish-compare`: the numbers of runs side by side, and the difference of two artifacts.

mod cli;
mod files;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-compare report out/raster --out out/raster/report\n\
    \x20 planish-compare report out/raster out/maze --out out/both\n\
    \x20 planish-compare figures out/raster --format pdf --out out/figures\n\
    \x20 planish-compare sweep out/sweeps/small/table.json --out out/sweeps/small/report\n\
    \x20 planish-compare diff out/a/removal out/b/removal --max-difference 0.001";

/// Compare runs, or two artifacts
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: cli::Command,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.command.run())
}
