//! A run of several stages: the owner of its directory.
//!
//! * [`owner`]: owner of a directory, that is one pipeline for one mirror.
//!
//! The binary reads the pipelines (`planish-pipeline`), locks the directory while their stages run, and names at the end
//! the stages that gave a negative verdict.

// The command line names this library as any other program does.
extern crate self as planish_run;

mod cli;
pub mod command;
pub mod owner;
