//! `planish-benchmark`: scores of submitted motions.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::{CommandFactory, Parser, Subcommand};
use planish_benchmark::{Problem, score, trajectory};
use planish_fixture::{Recipe, make};
use planish_handoff::{Failure, Inputs, Status, say, with_flags};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-benchmark score benchmark/problems/coupon.json submission.csv";

/// Largest submission that is read, bytes. Larger: more memory for files of another kind. Smaller: fine motions are
/// refused.
const LARGEST_SUBMISSION: u64 = 1 << 30;

/// Judge a motion on a problem of the benchmark, whoever planned it
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct BenchmarkCli {
    #[command(subcommand)]
    command: BenchmarkCommand,
}

#[derive(Subcommand)]
enum BenchmarkCommand {
    /// Print the residual, the time and the excess over the bound on any path, as JSON
    ///
    /// The motion is the cubic through every two neighbouring rows, with the tool on. It starts at 0 s and at rest, and
    /// ends at rest. The program refuses a motion that breaks a limit of the machine, jumps, or leaves out a time.
    Score(ScoreArgs),
}

#[derive(clap::Args)]
struct ScoreArgs {
    /// Problem, like those in benchmark/problems [JSON]
    #[arg(value_name = "PROBLEM")]
    problem: PathBuf,
    /// Motion with the header t,x,y,vx,vy, in s, mm and mm/s [CSV]
    #[arg(value_name = "SUBMISSION")]
    submission: PathBuf,
}

/// The command `planish benchmark`.
pub const COMMAND: planish_handoff::Stage = planish_handoff::Stage {
    name: env!("CARGO_PKG_NAME"),
    main,
    definition: BenchmarkCli::command,
};

fn main() -> ExitCode {
    planish_handoff::program(|cli: &BenchmarkCli| match &cli.command {
        BenchmarkCommand::Score(arguments) => arguments.run(),
    })
}

impl ScoreArgs {
    fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let problem: Problem = inputs.read_json("problem", &self.problem)?;
        let folder = self.problem.parent().unwrap_or(Path::new(""));
        let file = folder.join(&problem.recipe);
        let recipe: Recipe = inputs.read_json("recipe", &file)?;
        let fixture = make(&recipe).map_err(|e| of_file(&file, &e))?;
        let machine = inputs.read_machine(&folder.join(&problem.machine))?;
        let bytes = inputs.read_bytes("submission", &self.submission, LARGEST_SUBMISSION)?;
        let text = String::from_utf8(bytes).map_err(|e| of_file(&self.submission, &e))?;
        let motion = trajectory(&text).map_err(|e| of_file(&self.submission, &e))?;
        let score = score(&fixture.surface, &fixture.tif, &machine, &motion)
            .map_err(|e| of_file(&self.submission, &e))?;
        say(serde_json::to_string_pretty(&score)?);
        Ok(Status::Done)
    }
}

/// Returns the failure of a command by an error about a file.
fn of_file(file: &Path, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(with_flags(&format!("{}: {error}", file.display())))
}
