//! `planish register`: where a part lies on its machine.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish register fit fiducials.csv --out out/transform\n\
    \x20 planish register apply --transform out/transform --trajectory out/trajectory --out out/on-machine\n\
    \x20 planish register maps --before out/before --after out/after --shorter-than-mm 3 --out out/moved\n\
    \x20 planish register mean out/map-1 out/map-2 out/map-3 --out out/mean\n\
    \x20 planish register join out/left out/middle out/right --out out/whole";

/// Find where a part lies on its machine, and take paths and motions there
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct RegisterCli {
    #[command(subcommand)]
    method: crate::cli::RegisterMethod,
}

/// The command `planish register`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: RegisterCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &RegisterCli| cli.method.run())
}
