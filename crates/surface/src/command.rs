//! `planish-surface`: prepares measured maps and tools, and describes them.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-surface prepare --surface mirror --level plane --out out/surface\n\
    \x20 planish-surface prepare --surface mirror --mask-outliers --feature-mm 4 --out out/surface\n\
    \x20 planish-surface psd --surface mirror --band-per-mm 0.1 1 --out out/psd\n\
    \x20 planish-surface spec --surface mirror --base-mm 1 --specification limits.json --out out/spec\n\
    \x20 planish-surface spec --profile ltp.csv --value-unit urad --subtract cylinder-x --out out/ltp\n\
    \x20 planish-surface line --profile ltp.csv --value-unit urad --positive hill --tif spot --strip-width-mm 10 --out out/line\n\
    \x20 planish-surface tif --tif spot --centre centroid --fit-formula gaussian --out out/tif";

/// Prepare measured maps and tools, and describe them
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    method: crate::cli::Method,
}

/// The command `planish surface`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: Cli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.method.run())
}
