//! `planish dwell`: dwell times for a desired removal along a tool path.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish dwell bounded-least-squares --surface out/surface --tif tool --tool-path out/tool_path --min-dwell-s 0.1 --out out/dwell\n\
    \x20 planish dwell lucy-richardson --surface out/surface --tif tool --tool-path out/tool_path --out out/dwell";

/// Find the dwell times that remove what is desired
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct DwellCli {
    #[command(subcommand)]
    solver: crate::cli::Solver,
}

/// The command `planish dwell`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: DwellCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &DwellCli| cli.solver.run())
}
