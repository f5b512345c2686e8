//! `planish-bspline-feed`: desired removal, TIF and tool path become a feed profile and its motion.

mod cli;

use std::process::ExitCode;

use clap::Parser;

#[cfg(not(feature = "together"))]
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-bspline-feed --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --out out/bspline";

/// Find the feed along every pass of a path, as a B-spline, and the motion that runs it
///
/// The path is of straight passes that turn outside the clear aperture.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(flatten)]
    feed: cli::Feed,
}

pub(crate) fn main() -> ExitCode {
    planish_handoff::program(|cli: &Cli| cli.feed.run())
}
