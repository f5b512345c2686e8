//! `planish app`: the page that plans.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish app\n\
    \x20 planish app sessions/mirror-7 --port 8123 --no-browser";

/// Open a page in the browser that plans: part, tool, machine, plan, result, program
///
/// The page is served from this machine to this machine alone, and nothing is uploaded. Each step runs the other programs
/// and shows their command lines. Files, results and the script of a session are in its directory. The program ends with
/// Ctrl-C; the same command opens the session again (docs/app.md).
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct AppCli {
    #[command(flatten)]
    session: crate::cli::ServeArguments,
}

/// The command `planish app`: its name, its main function, and its command line.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: AppCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &AppCli| cli.session.run())
}
