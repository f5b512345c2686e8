//! `planish-tolerance`: what the errors of a process add to the residual of a plan.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-tolerance --trajectory out/trajectory --tif tool --surface out/surface \\\n\
    \x20     --error-budget fixtures/error-budgets/ion-beam.json --out out/tolerance\n\
    \x20 planish-tolerance --trajectory out/trajectory --tif tool --surface out/surface \\\n\
    \x20     --error-budget my-error_budget.json --simulated-runs 1000 --out out/tolerance";

/// Say before the run what each error of a process adds to the residual, and what to expect of all of them
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(flatten)]
    tolerance: cli::Tolerance,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.tolerance.run())
}
