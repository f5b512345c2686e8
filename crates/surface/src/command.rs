//! `planish surface`: prepares measured maps, and describes them.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};
use planish_handoff::{Stage, Subcommands};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish surface prepare --surface mirror --level plane --out out/surface\n\
    \x20 planish surface prepare --surface mirror --mask-outliers --feature-mm 4 --out out/surface\n\
    \x20 planish surface psd --surface mirror --band-per-mm 0.1 1 --out out/psd\n\
    \x20 planish surface spec --surface mirror --base-mm 1 --specification limits.json --out out/spec\n\
    \x20 planish surface spec --profile ltp.csv --value-unit urad --subtract cylinder-x --out out/ltp\n\
    \x20 planish surface line --profile ltp.csv --value-unit urad --positive hill --tif spot --strip-width-mm 10 --out out/line";

/// Prepare measured maps, and describe them
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct SurfaceCli<Others: Subcommands> {
    #[command(subcommand)]
    method: crate::cli::SurfaceCommand<Others>,
}

/// Returns the command `planish surface`. `Others` are the subcommands of another stage, which can be called under this
/// name as well.
pub const fn command<Others: Subcommands>() -> Stage {
    Stage {
        name: env!("CARGO_PKG_NAME"),
        main: main::<Others>,
        definition: <SurfaceCli<Others> as CommandFactory>::command,
    }
}

fn main<Others: Subcommands>() -> ExitCode {
    planish_handoff::program(|cli: &SurfaceCli<Others>| cli.method.run())
}
