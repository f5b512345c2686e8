//! `planish-reconcile`: what a run teaches of the machine and its tool.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-reconcile --before out/surface --after out/after --trajectory out/trajectory --tif tool \\\n\
    \x20     --out out/reconcile --corrected-tif out/tool-learnt\n\
    \x20 planish-reconcile --before out/surface --after out/after --trajectory out/trajectory --tif tool \\\n\
    \x20     --hold magnification --hold power --error-budget fixtures/error-budgets/ion-beam.json --out out/reconcile";

/// Learn the rate, the place, the width and the shape of the tool from the maps before and after a run
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(flatten)]
    reconcile: cli::Reconcile,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.reconcile.run())
}
