//! `planish-refine`: correction of dwell times against the motion that will run.

mod cli;

use std::process::ExitCode;

use clap::Parser;
use planish_handoff::Failure;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-refine --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --min-dwell-s 0.1 --out out/refined\n\
    \x20 planish-refine pareto --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --out out/pareto";

/// Correct the dwell times against the removal of the scheduled motion, round by round
///
/// Writes DIR/dwell and DIR/trajectory of the best round, and DIR/iterations with all of them.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<cli::Command>,
    #[command(flatten)]
    refine: Option<cli::Refine>,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| match (&cli.command, &cli.refine) {
        (Some(command), _) => command.run(),
        (None, Some(arguments)) => arguments.run(),
        (None, None) => Err(Failure::new("no arguments; planish-refine --help shows them")),
    })
}
