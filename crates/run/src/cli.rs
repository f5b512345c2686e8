//! Subcommands, one file each.

mod best;
mod program;
mod start;
mod verdict;
mod words;

use clap::Subcommand;
use planish_handoff::{Failure, Status};

#[derive(Subcommand)]
pub enum Command {
    /// Run a command while the directory of a run is locked for it; the command replaces this program
    ///
    /// The program checks the machine file and the mirror first, so that a mistake in them is not found
    /// after the long stages. Then it locks --out until the command and all processes that it has started
    /// have ended, however they end. The file run.json in it names the owner of the directory. The program
    /// refuses the directory of another pipeline or of another mirror, or one with other content, with exit
    /// code 2.
    Start(start::Start),
    /// Print the words of a text, quoted for a shell; they are split like a shell does it, but nothing is
    /// evaluated
    Words(words::Words),
    /// Print the name of the plan that the report of a run recommends
    Best(best::Best),
    /// Print the plan that the program of a run executes, and whether the report recommends that plan
    Program(program::Program),
    /// Print the stages of a run that gave a negative verdict; exit code 1 if there are any
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
