//! The subcommands, one file each.

mod best;
mod program;
mod start;
mod verdict;
mod words;

use clap::Subcommand;
use planish_handoff::{Failure, Status};

#[derive(Subcommand)]
pub enum Command {
    /// Hold a directory for a run, and run a command in the place of this program
    ///
    /// The machine file and the mirror are looked at first, so that a mistake in them is not found after
    /// the long stages. Then --out is locked until the command and all that it has started have ended,
    /// however they end. The file run.json in it says whose directory it is: the run of another pipeline,
    /// of another mirror, or a directory with other content, is refused with exit code 2.
    Start(start::Start),
    /// Print the words of a text that holds several, quoted for a shell: as a shell takes them apart,
    /// but nothing is evaluated
    Words(words::Words),
    /// Print the name of the plan that the report of a run recommends
    Best(best::Best),
    /// Say of which plan the program of a run is, and whether the report recommends that plan
    Program(program::Program),
    /// Say which stages of a run gave a negative verdict; exit code 1 when there are any
    Verdict(verdict::Verdict),
}

impl Command {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Start(arguments) => arguments.run(),
            Self::Words(arguments) => arguments.run(),
            Self::Best(arguments) => arguments.run(),
            Self::Program(arguments) => arguments.run(),
            Self::Verdict(arguments) => arguments.run(),
        }
    }
}
