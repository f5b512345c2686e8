//! `planish tolerance`: what the errors of a process add to the residual of a plan.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish tolerance --trajectory out/trajectory --tif tool --surface out/surface \\\n\
    \x20     --error-budget fixtures/error-budgets/ion-beam.json --out out/tolerance\n\
    \x20 planish tolerance --trajectory out/trajectory --tif tool --surface out/surface \\\n\
    \x20     --error-budget my-error_budget.json --simulated-runs 1000 --out out/tolerance";

/// Say before the run what each error of a process adds to the residual, and what to expect of all of them
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct ToleranceCli {
    #[command(flatten)]
    tolerance: crate::cli::Tolerance,
}

/// The command `planish tolerance`.
pub const COMMAND: planish_handoff::Stage = planish_handoff::Stage {
    name: env!("CARGO_PKG_NAME"),
    main,
    definition: ToleranceCli::command,
};

fn main() -> ExitCode {
    planish_handoff::program(|cli: &ToleranceCli| cli.tolerance.run())
}
