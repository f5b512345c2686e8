//! The only crate that knows files, and the shell that every binary shares.
//!
//! * `allocator`: mimalloc, within the memory that the run may take.
//! * [`kind`]: what an artifact directory holds. One table; the readers, the writers and
//!   `docs/formats.md` all follow it.
//! * [`npy`]: one array from or to a `.npy` file.
//! * [`artifact`]: a directory of arrays with its manifest: read, checked, hashed, written whole
//!   or not at all.
//! * [`command_line`]: flags, and the completions and manual pages made from them.
//! * `publish`: how what a run writes appears, whole and together, and survives a power failure.
//! * [`stage`]: what the `main` of a stage does: flags, inputs, skipping what is unchanged,
//!   progress, messages and exit codes.

mod allocator;
pub mod artifact;
pub mod command_line;
pub mod kind;
mod nouns;
pub mod npy;
mod publish;
pub mod stage;

pub use artifact::{Arrays, Artifact, Manifest};
pub use command_line::{pair, parse};
pub use stage::{Begin, Failure, OutputArgs, Stage, Status, run};

#[global_allocator]
static ALLOCATOR: allocator::Budgeted = allocator::Budgeted;

/// A file or directory that cannot be used. The message names the file, the place, the value and
/// what to do about it.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {problem}")]
pub struct HandoffError {
    /// The file or directory.
    pub path: String,
    /// What is wrong and what to do.
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
