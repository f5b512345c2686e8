//! `planish-run`: lock, owner and verdict of a run of several stages.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-run start --out out/mine --pipeline mine --surface mirror --tif tool --machine machine.json -- sh my-stages.sh\n\
    \x20 planish-run words \"--unit m --variable 'my map'\"\n\
    \x20 planish-run verdict --run out/mine --plan methods/pvt";

/// Start a run of several stages as the only owner of its directory; name at its end the stages that gave a
/// negative verdict
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: cli::Command,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.command.run())
}
