//! `planish-register`: where a part lies on its machine.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-register fit fiducials.csv --out out/transform\n\
    \x20 planish-register apply --transform out/transform --trajectory out/trajectory --out out/on-machine\n\
    \x20 planish-register maps --before out/before --after out/after --shorter-than-mm 3 --out out/moved\n\
    \x20 planish-register mean out/map-1 out/map-2 out/map-3 --out out/mean\n\
    \x20 planish-register join out/left out/middle out/right --out out/whole";

/// Find where a part lies on its machine, and take paths and motions there
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    method: cli::Method,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.method.run())
}
