//! `planish-import`: reads files of instruments and of other programs.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-import surface mirror.datx --picture mirror.svg --out out/surface\n\
    \x20 planish-import tif spot.mat --rate --unit m --coordinate-unit m --out out/tif\n\
    \x20 planish-import trace gathering.dat --format xps --unit mm --rate-hz 1000 --out out/run";

/// Read files of instruments and of other programs
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    method: crate::cli::Method,
}

/// The command `planish import`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: Cli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.method.run())
}
