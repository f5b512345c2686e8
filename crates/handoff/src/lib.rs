//! Files, messages and command lines: reading and writing of artifacts, and the shell that all programs share.
//!
//! * [`Allocator`]: mimalloc within the memory budget of the process; a program selects it.
//! * [`kind`]: table of the kinds of artifact directories. Readers, writers and `docs/formats.md` all
//!   use it.
//! * [`npy`]: one array from or to a `.npy` file.
//! * [`artifact`]: a directory of arrays with its manifest: read, checked, hashed, written whole
//!   or not at all.
//! * [`Running`]: a process that this one starts, and that ends with it.
//! * [`command_line`]: flags, and the completions and manual pages made from them.
//! * `describe`: the flags as data, for functions of other languages.
//! * [`flags`]: groups of flags that several programs share.
//! * [`from_run`]: environment variables by which `planish run` informs the programs that it starts.
//! * [`Inputs`]: the inputs of a command, with their hashes.
//! * [`Output`], [`OutputFile`]: the outputs of a command; skipped if they are up to date.
//! * `publish`: makes the outputs of a run visible, whole and together, safe against power failures.
//! * [`program`]: the body of every `main`; messages and exit codes.
//! * [`Stage`]: a stage as a command of the one program `planish`, which [`start`] begins.
//! * [`Subcommands`]: subcommands that a stage may have under names of another one.
//! * [`system`]: all that depends on the operating system.
//! * [`words`]: several words in one text, as a shell reads them.
//!
//! The `main.rs` of a program that doubles every dwell time:
//!
//! ```no_run
//! use std::{path::PathBuf, process::ExitCode};
//!
//! use planish_handoff::{
//!     Allocator, Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, program, task,
//! };
//! use planish_types::DwellTime;
//! use serde_json::json;
//!
//! #[global_allocator]
//! static ALLOCATOR: Allocator = Allocator;
//!
//! /// Double every dwell time
//! #[derive(clap::Parser)]
//! struct Cli {
//!     /// Dwell times [dwell artifact]
//!     #[arg(long, value_name = "DIR")]
//!     dwell: PathBuf,
//!     #[command(flatten)]
//!     output: OutputArgs,
//! }
//!
//! fn main() -> ExitCode {
//!     program(double)
//! }
//!
//! fn double(cli: &Cli) -> Result<Status, Failure> {
//!     let mut inputs = Inputs::new();
//!     let dwell: DwellTime = inputs.read("dwell", &cli.dwell)?;
//!     let output = Output::directory(&cli.output, DwellTime::KIND);
//!     let mut output = match output.begin(&task!("double", json!({ "factor": 2 })), &inputs)? {
//!         Begin::Unchanged(status) => return Ok(status),
//!         Begin::Run(output) => output,
//!     };
//!     let doubled = DwellTime::new(dwell.dwell_s().iter().map(|t| 2.0 * t).collect())?;
//!     output.write(&doubled, json!({ "total_s": doubled.total_s() }), &Status::Done)?;
//!     Ok(Status::Done)
//! }
//! ```

mod allocator;
mod arguments;
pub mod artifact;
mod children;
pub mod command_line;
mod describe;
pub mod flags;
pub mod formats;
pub mod from_run;
mod inputs;
pub mod kind;
mod message;
mod nouns;
pub mod npy;
mod output;
mod place;
mod publish;
mod shell;
mod stage;
pub mod system;
mod telling;
pub mod words;

pub use allocator::Allocator;
pub use arguments::as_command;
pub use artifact::{Arrays, Artifact, Manifest, read_regular};
pub use children::Running;
pub use command_line::{controller, pair, with_flags};
pub use inputs::{GivenForm, Inputs, StatedForm};
pub use nouns::Tool;
pub use output::{Begin, Output, OutputFile, Task, Writer, save};
pub use publish::is_temporary;
pub use shell::{Failure, Status, program, say, warn};
pub use stage::{Stage, Subcommands, stage_command, start};
pub use telling::{exit, keep_output, tells_text};

/// Error about a file or directory that cannot be used. The message states the file, the place, the value and
/// the remedy.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {problem}")]
pub struct HandoffError {
    /// The file or directory.
    pub path: String,
    /// The fault and its remedy.
    pub problem: String,
}

impl HandoffError {
    pub(crate) fn new(path: &std::path::Path, problem: impl Into<String>) -> Self {
        Self { path: path.display().to_string(), problem: problem.into() }
    }

    pub(crate) fn io(path: &std::path::Path, doing: &str, error: &std::io::Error) -> Self {
        Self::new(path, format!("cannot {doing}: {error}"))
    }
}
