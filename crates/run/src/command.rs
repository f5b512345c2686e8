//! `planish run`: pipelines, and the directory, lock and verdict of a run.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish run raster fixture=coupon pitch_mm=2 export=galil\n\
    \x20 planish stage raster path fixture=coupon pitch_mm=2\n\
    \x20 planish show raster\n\
    \x20 planish start --out out/mine --pipeline mine --surface mirror --tif tool --machine machine.json -- sh my-stages.sh\n\
    \x20 planish verdict --run out/mine --plan methods/pvt";

/// Run pipelines, each as the only owner of its directory, and name the stages that gave a negative verdict
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct RunCli {
    #[command(subcommand)]
    command: crate::cli::RunCommand,
}

/// The command `planish run`: its name, its main function, and its command line.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: RunCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &RunCli| cli.command.run())
}
