//! Subcommands, one file each.

mod decide;
mod measure;
mod report;
mod spread;

use clap::Subcommand;
use planish_handoff::{Failure, Status};

#[derive(Subcommand)]
pub enum CampaignCommand {
    /// Measure a mirror before a run of the virtual machine: its map with the errors of a measurement
    Measure(measure::Measure),
    /// Decide whether to run again: gain of the next run, its uncertainty, and its time
    Decide(decide::Decide),
    /// Print and draw the residuals of a campaign, run by run, with and without learning, and the learnt parameters
    Report(report::CampaignReport),
    /// Print the scatter of the results of several campaigns with different seeds
    Spread(spread::Spread),
}

impl CampaignCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Measure(arguments) => arguments.write(),
            Self::Decide(arguments) => arguments.run(),
            Self::Report(arguments) => arguments.run(),
            Self::Spread(arguments) => arguments.run(),
        }
    }
}
