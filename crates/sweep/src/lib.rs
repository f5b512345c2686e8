//! Many plans of one mirror: the file of a sweep becomes plans, which run in batches and share what they can.
//!
//! * [`setting`]: what can be varied: names, units, bounds.
//! * [`description`]: what the file of a sweep says.
//! * [`expand`]: every combination of its settings.
//! * [`plan`]: plans, and the stages that make them.
//! * [`batch`]: which plans a job runs, and what it needs.
//! * [`row`]: what came of a plan.
//! * [`search`]: plans between those of the front.
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
