//! `planish reconcile`: what a run teaches of the machine and its tool.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

pub use crate::cli::controller::ImportNames;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish reconcile --before out/surface --after out/after --trajectory out/trajectory --tif tool \\\n\
    \x20     --out out/reconcile --corrected-tif out/tool-learnt\n\
    \x20 planish reconcile --before out/surface --after out/after --trajectory out/trajectory --tif tool \\\n\
    \x20     --hold magnification --hold power --error-budget fixtures/error-budgets/ion-beam.json --out out/reconcile";

/// Learn the rate, the place, the width and the shape of the tool from the maps before and after a run
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct ReconcileCli {
    #[command(flatten)]
    reconcile: crate::cli::Reconcile,
}

/// The command `planish reconcile`.
pub const COMMAND: planish_handoff::Stage = planish_handoff::Stage {
    name: env!("CARGO_PKG_NAME"),
    main,
    definition: ReconcileCli::command,
};

fn main() -> ExitCode {
    planish_handoff::program(|cli: &ReconcileCli| cli.reconcile.run())
}
