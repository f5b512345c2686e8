//! The judge of the benchmark: one way to score a motion, whoever planned it.
//!
//! ```text
//! p(t) = cubic through (p0, v0) and (p1, v1) between two rows t0, t1 of a submission, per axis      (1)
//! excess = residual RMS of the executed motion / bound on any path in the same time - 1             (2)
//! ```
//!
//! The limits are those of `planish verify`, exact on the whole of (1). The residual is that of `planish simulate`. The
//! bound is that of `planish dwell bound` for the time of the submission, so that no plan has an excess below 0. What the
//! errors of the process add is that of `planish tolerance`.
//!
//! | module | what it holds |
//! |---|---|
//! | `problem` | part, tool, machine and errors |
//! | `submission` | the rows of a submission, and their refusals |
//! | `front` | bounds for the times and the residuals of the motions |
//! | `score` | the numbers of a motion |

// The command line names this library as any other program does.
extern crate self as planish_benchmark;

pub mod command;
mod front;
mod problem;
mod score;
mod submission;

pub use problem::{MeasuredPart, Problem, Source};
pub use score::{Score, ScoreError, ScoreTask, scores};
pub use submission::{LONGEST_STEP_S, trajectory};
