//! `planish run`: runs of a pipeline, and the owner of the directory of a run.
//!
//! * [`owner`]: the pipeline and the mirror that a directory belongs to.
//!
//! The binary reads the pipelines (`planish-pipeline`), locks the directory while their stages run, and names at the
//! end the stages that gave a negative verdict.

// The command line names this library as any other program does.
extern crate self as planish_run;

mod cli;
pub mod command;
pub mod owner;
