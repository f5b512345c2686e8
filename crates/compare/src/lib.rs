//! Comparison of the results of a run: numbers for programs, tables and a page for people, differences of artifacts.
//!
//! * [`answer`]: the plan that is to be run, with reasons, in sentences.
//! * [`summary`]: the numbers of `summary.json`.
//! * [`table`]: the same numbers as tables, methods side by side.
//! * [`dwell`]: dwell solvers side by side.
//! * [`execution`]: error of the dwell times, overshoot, jerk.
//! * [`on_axes`]: what a plan leaves when all axes of a machine run it.
//! * [`report`]: a page to look at, and its figures.
//! * [`typeset`]: a figure as PDF or PNG.
//! * [`chain`]: check that the artifacts of a run belong together.
//! * [`plan`]: state of a plan: certified, converged or not.
//! * [`error_budget`]: the residual that the errors of a process add to a plan.
//! * [`reach`]: the part of a residual at wavelengths shorter than the tool corrects.
//! * [`places`]: residual and time by place.
//! * [`recommended`]: choice of the plan that is to be executed.
//! * [`specification`]: verdicts on a specification.
//! * [`sweep`]: the plans of a sweep, and the front of residual against time.
//! * [`diff`]: difference of two arrays.

// The command line names this library as any other program does.
extern crate self as planish_compare;

pub mod answer;
pub mod chain;
mod cli;
pub mod command;
pub mod diff;
pub mod dwell;
pub mod error_budget;
pub mod execution;
mod files;
pub mod made;
pub mod on_axes;
pub mod places;
pub mod plan;
pub mod reach;
pub mod recommended;
pub mod report;
pub mod specification;
pub mod summary;
pub mod sweep;
pub mod table;
pub mod typeset;
