//! `planish-simulate`: removal and residual of a trajectory.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-simulate --trajectory out/trajectory --tif tool --surface out/surface --out out/removal\n\
    \x20 planish-simulate --trajectory out/trajectory --tif tool --surface out/surface --frames 24 --out out/frames\n\
    \x20 planish-simulate --trajectory out/trajectory --tif tool --surface out/surface \\\n\
    \x20     --error-budget fixtures/error-budgets/ion-beam.json --seed 7 --measured-out out/after --out out/truth";

/// Predict what a trajectory removes from a surface, and what remains; or run it with hidden errors
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(flatten)]
    simulate: cli::Simulate,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.simulate.run())
}
