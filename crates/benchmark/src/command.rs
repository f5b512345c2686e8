//! `planish benchmark`: scores of submitted motions.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::{CommandFactory, Parser, Subcommand};
use planish_benchmark::{Problem, Score, ScoreError, ScoreTask, Source, scores, trajectory};
use planish_fixture::{Recipe, make};
use planish_handoff::{Failure, Inputs, Status, say, with_flags};
use planish_simulate::error_budget::ErrorBudgetFile;
use planish_types::{Surface, Tif, Trajectory};

const EXAMPLES: &str = "Examples:\n\
    \x20 planish benchmark score benchmark/problems/coupon.json submission.csv";

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
    /// Motions with the header t,x,y,vx,vy, in s, mm and mm/s [CSV], or directories with a motion: of a plan, or of
    /// `planish import program`
    #[arg(value_name = "SUBMISSION", required = true)]
    submissions: Vec<PathBuf>,
    /// Draw no runs with the errors of the process, which take most of the time
    #[arg(long)]
    no_errors: bool,
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
        let (surface, tif) = self.part(&problem, folder, &mut inputs)?;
        let machine = inputs.read_machine(&folder.join(&problem.machine))?;
        let file = folder.join(&problem.error_budget);
        let errors: ErrorBudgetFile = inputs.read_json("error-budget", &file)?;
        let errors = errors.checked().map_err(|e| of_file(&file, &e))?;
        let errors = if self.no_errors { None } else { Some(&errors) };
        let mut motions = Vec::new();
        for submission in &self.submissions {
            motions.push(motion(submission, &mut inputs)?);
        }
        let task = ScoreTask { desired: &surface, tif: &tif, machine: &machine, errors };
        let scores = scores(&task, &motions).map_err(|e| of_file(&self.problem, &e))?;
        if let [only] = self.submissions.as_slice() {
            let score = scores.into_iter().next().expect("one score");
            say(serde_json::to_string_pretty(&score.map_err(|e| of_file(only, &e))?)?);
            return Ok(Status::Done);
        }
        let rows: Vec<Row> = self.submissions.iter().zip(scores).map(Row::new).collect();
        say(serde_json::to_string_pretty(&rows)?);
        let refused = rows.iter().filter(|row| row.score.is_none()).count();
        if refused == 0 {
            return Ok(Status::Done);
        }
        Ok(Status::Negative(format!("{refused} of {} motions have no score", rows.len())))
    }

    /// Returns the desired removal and the tool of the problem, whose files are relative to `folder`.
    fn part(
        &self,
        problem: &Problem,
        folder: &Path,
        inputs: &mut Inputs,
    ) -> Result<(Surface, Tif), Failure> {
        match problem.source().map_err(|e| of_file(&self.problem, &e))? {
            Source::Recipe(recipe) => {
                let file = folder.join(recipe);
                let recipe: Recipe = inputs.read_json("recipe", &file)?;
                let fixture = make(&recipe).map_err(|e| of_file(&file, &e))?;
                Ok((fixture.surface, fixture.tif))
            }
            Source::Measured(part) => {
                let [surface, tif] =
                    ["surface", "tif"].map(|name| folder.join(&part.folder).join(name));
                if !surface.exists() {
                    return Err(Failure::new(format!(
                        "{}: the measured part is not there; make it with benchmark/measured.py",
                        surface.display()
                    )));
                }
                let read = (inputs.read("surface", &surface)?, inputs.read_tool("tif", &tif)?);
                same_content(inputs, "surface", &surface, &part.surface_blake3)?;
                same_content(inputs, "tif", &tif, &part.tif_blake3)?;
                Ok(read)
            }
        }
    }
}

/// A submission with its score, or with the reason why it has none.
#[derive(serde::Serialize)]
struct Row<'a> {
    submission: &'a Path,
    #[serde(flatten)]
    score: Option<Score>,
    #[serde(skip_serializing_if = "Option::is_none")]
    refused: Option<String>,
}

impl<'a> Row<'a> {
    fn new((submission, score): (&'a PathBuf, Result<Score, ScoreError>)) -> Self {
        let refused = score.as_ref().err().map(ToString::to_string);
        Self { submission, score: score.ok(), refused }
    }
}

/// Returns the motion of a submission: a file of rows, or a directory.
fn motion(submission: &Path, inputs: &mut Inputs) -> Result<Trajectory, Failure> {
    if submission.is_dir() {
        let motion: Trajectory = inputs.read("submission", submission)?;
        motion.check_rate_is_constant().map_err(|e| of_file(submission, &e))?;
        return Ok(motion);
    }
    let bytes = inputs.read_bytes("submission", submission, LARGEST_SUBMISSION)?;
    let text = String::from_utf8(bytes).map_err(|e| of_file(submission, &e))?;
    trajectory(&text).map_err(|e| of_file(submission, &e))
}

/// Refuses the input `role` if its content is not the one that the problem states.
fn same_content(inputs: &Inputs, role: &str, path: &Path, blake3: &str) -> Result<(), Failure> {
    let digest = inputs.digest(role).unwrap_or_default();
    if digest == blake3 {
        return Ok(());
    }
    Err(Failure::new(format!(
        "{}: has the content {digest}, but the problem is stated for {blake3}; make it anew with \
         benchmark/measured.py",
        path.display()
    )))
}

/// Returns the failure of a command by an error about a file.
fn of_file(file: &Path, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(with_flags(&format!("{}: {error}", file.display())))
}
