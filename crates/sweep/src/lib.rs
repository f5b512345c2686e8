//! Many plans of one mirror: the file of a sweep becomes plans, which run in batches and share what they can.
//!
//! * [`setting`]: settings that can be varied: names, units, bounds.
//! * [`description`]: content of the file of a sweep.
//! * [`expand`]: every combination of the settings in the file.
//! * [`plan`]: plans, and the stages (runs of a program) that make them.
//! * [`batch`]: choice of the plans that a job runs, and the time and memory that it needs.
//! * [`row`]: result of a plan.
//! * [`search`]: new plans between neighbours on the front of residual against time.
//! * [`varying`]: commands of tools that vary over the part.
//!
//! The binary reads the files, runs the stages, and is called by `workflow/Snakefile`.

// The command line names this library as any other program does.
extern crate self as planish_sweep;

pub mod batch;
mod cli;
pub mod command;
pub mod description;
pub mod expand;
mod files;
mod runner;

pub mod plan;
pub mod row;
pub mod search;
pub mod setting;
pub mod varying;
