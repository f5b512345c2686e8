//! `planish-import`: reads files of instruments and of other programs.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-import surface mirror.datx --picture mirror.svg --out out/surface\n\
    \x20 planish-import tif spot.mat --rate --unit m --coordinate-unit m --out out/tif\n\
    \x20 planish-import trace gathering.dat --format xps --unit mm --rate-hz 1000 --out out/run";

/// Read files of instruments and of other programs
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    method: cli::Method,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.method.run())
}
