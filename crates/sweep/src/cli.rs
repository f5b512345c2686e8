//! The subcommands, one file each.

mod again;
mod expand;
mod propose;
mod resources;
mod run;
mod table;

use clap::Subcommand;
use planish_handoff::{Failure, Status};

#[derive(Subcommand)]
pub enum SweepCommand {
    /// Write the plans of a sweep's file to DIR/sweep.json
    ///
    /// Nothing is run. A mistake in the file is named with its line.
    Expand(expand::Expand),
    /// Run the stages of one job: the mirror, the tool paths, or some of the plans
    ///
    /// Existing results are not made again, so that a job that was ended continues where it stopped. A plan that
    /// fails is a row with its message. A stage that was killed is tried once more, alone.
    Run(run::RunJob),
    /// Print the resources of a job as JSON: minutes and MiB, from the size of the map
    Resources(resources::Resources),
    /// Propose plans between those of the front, as one more round of the sweep; exit code 1 if the front has stopped
    /// moving
    Propose(propose::Propose),
    /// Write the results of all plans to DIR/table.json, which planish compare sweep reads
    Table(table::TableCommand),
    /// Print the command that makes a plan again
    Again(again::Again),
}

impl SweepCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Expand(arguments) => arguments.run(),
            Self::Run(arguments) => arguments.run(),
            Self::Resources(arguments) => arguments.run(),
            Self::Propose(arguments) => arguments.run(),
            Self::Table(arguments) => arguments.run(),
            Self::Again(arguments) => arguments.run(),
        }
    }
}
