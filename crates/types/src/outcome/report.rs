//! Part of the summary of `planish compare` that other programs read: `summary.json` of a report.

use serde::{Deserialize, Serialize};

use super::NoMore;

/// Summary of a run, with the answer before its numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AnsweredSummary<Summary = NoMore> {
    /// The plan that is to be run.
    pub answer: Answer,
    /// Numbers of the run.
    #[serde(flatten)]
    pub summary: Summary,
}

/// The plan that a report recommends.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// The method that is to be run; `null` when there is none.
    pub method: Option<String>,
    /// Time of the plan and its residual.
    #[serde(default)]
    pub sentence: String,
    /// Reason for this choice, and the state of its plan.
    pub why: String,
    /// Sentence on the row without a motion, which is not a plan; `null` where the run has no such row.
    pub without_motion: Option<String>,
    /// Reasons against running it; empty if there are none.
    #[serde(default)]
    pub problems: Vec<String>,
}
