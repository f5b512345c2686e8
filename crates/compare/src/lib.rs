//! Comparison of the results of a run: numbers for programs, tables and a report page for people, differences of
//! artifacts. A method is one plan in a run: a scheduler or solver with its results.
//!
//! * [`answer`]: sentences on the plan that is to be run, with reasons.
//! * [`summary`]: the numbers in `summary.json`.
//! * [`table`]: the same numbers as tables, methods side by side.
//! * [`dwell`]: comparison of dwell solvers, side by side.
//! * [`execution`]: deviations of a motion from its plan: dwell times, overshoot, jerk.
//! * [`on_axes`]: residual of a plan when all axes of a machine run it.
//! * [`report`]: the report page for people, and its figures.
//! * [`typeset`]: conversion of a figure to PDF or PNG.
//! * [`chain`]: check that the artifacts of a run belong together.
//! * [`plan`]: state of a plan: certified, converged or not.
//! * [`error_budget`]: the residual that the errors of a process add to a plan.
//! * [`low_order`]: low-order terms of a map, by name.
//! * [`tool_numbers`]: rate, widths and volume rate of a tool.
//! * [`front`]: residual against time of all plans, as a picture.
//! * [`several`]: a plan of several tools, tool by tool.
//! * [`places`]: residual and time by position on the part: worst points, edge zone, regions.
//! * [`recommended`]: choice of the plan that is to be executed.
//! * [`specification`]: verdicts on the specification of a mirror.
//! * [`sweep`]: the plans of a sweep, and the front of residual against time.
//! * [`diff`]: difference of two arrays.

// The command line names this library as any other program does.
extern crate self as planish_compare;

pub mod answer;
pub mod chain;
mod cli;
pub mod command;
mod csv;
pub mod diff;
pub mod dwell;
pub mod error_budget;
pub mod execution;
mod files;
pub mod front;
pub mod low_order;
pub mod made;
pub mod on_axes;
pub mod places;
pub mod plan;
pub mod recommended;
pub mod report;
pub mod several;
pub mod specification;
pub mod summary;
pub mod sweep;
pub mod table;
pub mod tool_numbers;
pub mod typeset;
