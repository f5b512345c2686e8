//! `planish toolpath`: tool paths over a clear aperture.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish toolpath raster --surface out/surface --tif tool --pitch-mm 1 --step-mm 1 --out out/tool_path\n\
    \x20 planish toolpath maze --surface out/surface --tif tool --pitch-mm 1 --step-mm 1 --seed 2 --out out/tool_path\n\
    \x20 planish toolpath draw --tool-path out/tool_path --surface out/surface --out path.svg";

/// Tool paths over the clear aperture: the valid pixels of a map
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct ToolPathCli {
    #[command(subcommand)]
    method: crate::cli::PathCommand,
}

/// The command `planish toolpath`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: ToolPathCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &ToolPathCli| cli.method.run())
}
