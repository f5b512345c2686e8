//! `planish simulate`: removal and residual of a trajectory.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish simulate --trajectory out/trajectory --tif tool --surface out/surface --out out/removal\n\
    \x20 planish simulate --trajectory out/trajectory --tif tool --surface out/surface --frames 24 --out out/frames\n\
    \x20 planish simulate --trajectory out/trajectory --tif tool --surface out/surface \\\n\
    \x20     --error-budget fixtures/error-budgets/ion-beam.json --seed 7 --measured-out out/after --out out/truth";

/// Predict what a trajectory removes from a surface, and what remains; or run it with hidden errors
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct SimulateCli {
    #[command(flatten)]
    simulate: crate::cli::Simulate,
}

/// The command `planish simulate`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: SimulateCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &SimulateCli| cli.simulate.run())
}
