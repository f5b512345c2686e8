//! `planish import`: reads files of instruments and of other programs.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};
use planish_handoff::{Stage, Subcommands};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish import surface mirror.datx --picture mirror.svg --out out/surface\n\
    \x20 planish import trace gathering.dat --format xps --unit mm --rate-hz 1000 --out out/run";

/// Read files of instruments and of other programs
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct ImportCli<Others: Subcommands> {
    #[command(subcommand)]
    method: crate::cli::ImportMethod<Others>,
}

/// Returns the command `planish import`. `Others` are subcommands of another stage that are offered here too.
pub const fn command<Others: Subcommands>() -> Stage {
    Stage {
        name: env!("CARGO_PKG_NAME"),
        main: main::<Others>,
        definition: <ImportCli<Others> as CommandFactory>::command,
    }
}

fn main<Others: Subcommands>() -> ExitCode {
    planish_handoff::program(|cli: &ImportCli<Others>| cli.method.run())
}
