//! `planish tool`: makes, prepares and varies tools.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

pub use crate::cli::{ImportNames, SurfaceNames};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish tool from-maps after.datx --before before.datx --dwell-s 30 --half-size-mm 6 --out out/tif\n\
    \x20 planish tool from-maps rates.mat --rate --unit m --coordinate-unit m --out out/tif\n\
    \x20 planish tool prepare --tif spot --centre centroid --fit-formula gaussian --out out/tif\n\
    \x20 planish tool incidence --tif spot --surface mirror --sphere-radius-mm 100 --exponent=-1.7 --out out/tool\n\
    \x20 planish tool rate --tif spot --surface mirror --by radius --table rate.txt --out out/tool";

/// Make and prepare tools: from maps, for curved parts, and varying over the part or in time
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct ToolCli {
    #[command(subcommand)]
    method: crate::cli::ToolCommand,
}

/// The command `planish tool`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: ToolCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &ToolCli| cli.method.run())
}
