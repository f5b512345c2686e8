//! `planish campaign`: measures, decides and reports for a campaign, that is several runs on one mirror.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish campaign measure --surface mirror --error-budget error_budget.json --seed 7 --out out/measured\n\
    \x20 planish campaign decide --surface out/plan/surface --trajectory out/plan/methods/joint/trajectory \\\n\
    \x20     --tolerance out/tolerance --out out/decision\n\
    \x20 planish campaign report out/campaign/coupon --runs 3 --out out/campaign/coupon/report";

/// Several runs on one mirror: measure, decide whether to run again, report
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct CampaignCli {
    #[command(subcommand)]
    command: crate::cli::CampaignCommand,
}

/// The command `planish campaign`: its name, its main function, and its command line.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: CampaignCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &CampaignCli| cli.command.run())
}
