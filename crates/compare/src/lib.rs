//! What came of a run: numbers for programs, a table for people, the difference of two artifacts.
//!
//! * [`summary`]: the numbers of `summary.json`.
//! * [`table`]: the same numbers as a table, methods side by side.
//! * [`dwell`]: dwell solvers side by side.
//! * [`execution`]: dwell times kept, overshoot, jerk.
//! * [`report`]: a page to look at, and its figures.
//! * [`diff`]: how far two arrays are apart.

pub mod diff;
pub mod dwell;
pub mod execution;
pub mod report;
pub mod summary;
pub mod table;
