//! `planish joint`: desired removal, TIF, tool path and machine become the motion along a smooth curve.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish joint --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --out out/feed";

/// Find how fast to run along a path with rounded corners: the dwell-time density of least residual within the
/// limits of the machine, and its motion
///
/// Writes DIR/dwell (the time of the motion on every segment) and DIR/trajectory.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct JointCli {
    #[command(flatten)]
    joint: crate::cli::Joint,
}

/// The command `planish joint`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: JointCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &JointCli| cli.joint.run())
}
