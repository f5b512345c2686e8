//! What came of a run: numbers for programs, a table for people, the difference of two artifacts.
//!
//! * [`answer`]: which plan is to be run, and why, in sentences.
//! * [`summary`]: the numbers of `summary.json`.
//! * [`table`]: the same numbers as tables, methods side by side.
//! * [`dwell`]: dwell solvers side by side.
//! * [`execution`]: dwell times kept, overshoot, jerk.
//! * [`report`]: a page to look at, and its figures.
//! * [`typeset`]: a figure as PDF or PNG.
//! * [`chain`]: whether the artifacts of a run belong together.
//! * [`plan`]: how good a plan is known to be.
//! * [`process`]: what the errors of a process add to a plan.
//! * [`reach`]: the part of a residual at wavelengths shorter than the tool corrects.
//! * [`places`]: where something remains, and where the time goes.
//! * [`recommended`]: which plan is to be executed;
//! * [`specification`]: what the runs keep of a specification.
//! * [`sweep`]: the plans of a sweep, and the front of residual against time.
//! * [`diff`]: how far two arrays are apart.

pub mod answer;
pub mod chain;
pub mod diff;
pub mod dwell;
pub mod execution;
pub mod places;
pub mod plan;
pub mod process;
pub mod reach;
pub mod recommended;
pub mod report;
pub mod specification;
pub mod summary;
pub mod sweep;
pub mod table;
pub mod typeset;
