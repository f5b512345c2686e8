//! `planish bspline-feed`: desired removal, TIF and tool path become a feed profile and its motion.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish bspline-feed --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --out out/bspline";

/// Find the feed along every pass of a path, as a B-spline, and the motion that runs it
///
/// The path is of straight passes that turn outside the clear aperture.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct FeedCli {
    #[command(flatten)]
    feed: crate::cli::Feed,
}

/// The command `planish bspline-feed`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: FeedCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &FeedCli| cli.feed.run())
}
