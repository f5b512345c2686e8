//! `planish-run`: what a run of several stages needs beside the stages.

mod start;
mod verdict;

use std::{path::PathBuf, process::ExitCode};

use clap::{Parser, Subcommand};
use planish_handoff::{Failure, Status, run, say, words};

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-run start --out out/mine --pipeline mine --surface mirror --tif tool --machine machine.json -- sh my-stages.sh\n\
    \x20 planish-run words \"--unit m --variable 'my map'\"\n\
    \x20 planish-run verdict --run out/mine --plan methods/pvt";

/// Start a run of several stages as the only owner of its directory; say at its end which stage gave a
/// negative verdict
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Hold a directory for a run, and run a command in the place of this program
    ///
    /// The machine file and the mirror are looked at first, so that a mistake in them is not found after
    /// the long stages. Then --out is locked until the command and all that it has started have ended,
    /// however they end. The file run.json in it says whose directory it is: the run of another pipeline,
    /// of another mirror, or a directory with other content, is refused with exit code 2.
    Start(Start),
    /// Print the words of a text that holds several, quoted for a shell: as a shell takes them apart,
    /// but nothing is evaluated
    Words {
        /// Text, for example a list of flags
        #[arg(allow_hyphen_values = true)]
        text: String,
    },
    /// Say which stages of a run gave a negative verdict; exit code 1 when there are any
    Verdict(Verdict),
}

#[derive(clap::Args)]
struct Start {
    /// Directory of the run
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Name of the pipeline
    #[arg(long, value_name = "NAME")]
    pipeline: String,
    /// Mirror from a recipe [JSON]
    #[arg(long, value_name = "FILE", conflicts_with_all = ["surface", "tif"])]
    fixture: Option<PathBuf>,
    /// Mirror as it was measured [surface artifact, or a file of an instrument]
    #[arg(long, value_name = "PATH")]
    surface: Option<PathBuf>,
    /// Its tool [tif artifact, or a file of an instrument]
    #[arg(long, value_name = "PATH")]
    tif: Option<PathBuf>,
    /// Machine and its limits [JSON]
    #[arg(long, value_name = "FILE")]
    machine: PathBuf,
    /// A setting that holds several flags, as NAME=FLAGS; can be given again. An unclosed quotation
    /// mark in it is found before anything runs
    #[arg(long, value_name = "NAME=FLAGS")]
    flags: Vec<String>,
    /// What to run, with its arguments
    #[arg(last = true, required = true, value_name = "COMMAND")]
    command: Vec<String>,
}

#[derive(clap::Args)]
struct Verdict {
    /// Directory of the run; the artifacts directly in it count
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Directory in it whose artifacts count too: the plan that is to be executed. Can be given
    /// again; the verdicts on other methods, made for comparison, do not count
    #[arg(long, value_name = "NAME")]
    plan: Vec<PathBuf>,
}

fn main() -> ExitCode {
    let cli: Cli = planish_handoff::parse();
    run(|| match cli.command {
        Command::Start(arguments) => start::start(&arguments),
        Command::Words { text } => {
            let words = words::split(&text).map_err(|e| Failure::new(format!("{text}: {e}")))?;
            say(words::join(words));
            Ok(Status::Done)
        }
        Command::Verdict(arguments) => verdict::verdict(&arguments.run, &arguments.plan),
    })
}
