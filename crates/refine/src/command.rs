//! `planish refine`: correction of dwell times against the motion that will run.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};
use planish_handoff::Failure;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish refine --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --min-dwell-s 0.1 --out out/refined\n\
    \x20 planish refine pareto --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --out out/pareto";

/// Correct the dwell times against the removal of the scheduled motion, round by round
///
/// Writes DIR/dwell and DIR/trajectory of the best round, and DIR/iterations with all of them.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
struct RefineCli {
    #[command(subcommand)]
    command: Option<crate::cli::RefineCommand>,
    #[command(flatten)]
    refine: Option<crate::cli::Refine>,
}

/// The command `planish refine`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: RefineCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &RefineCli| match (&cli.command, &cli.refine) {
        (Some(command), _) => command.run(),
        (None, Some(arguments)) => arguments.run(),
        (None, None) => Err(Failure::new("no arguments; planish refine --help shows them")),
    })
}
