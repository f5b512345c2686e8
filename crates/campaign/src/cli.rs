//! The subcommands, one file each.

mod decide;
mod measure;
mod report;
mod spread;

use clap::Subcommand;
use planish_handoff::{Failure, Status};

#[derive(Subcommand)]
pub enum Command {
    /// Measure a mirror before a run of a virtual machine: its map with the errors of a measurement
    Measure(measure::Measure),
    /// Say whether the next run is worth it: what it would gain, how sure that is, and how long it takes
    Decide(decide::Decide),
    /// Print and draw what a campaign left, run by run, with and without learning, and what it learnt
    Report(report::Report),
    /// Print how the results of several campaigns, of other seeds, scatter
    Spread(spread::Spread),
}

impl Command {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Measure(arguments) => arguments.write(),
            Self::Decide(arguments) => arguments.run(),
            Self::Report(arguments) => arguments.run(),
            Self::Spread(arguments) => arguments.run(),
        }
    }
}
