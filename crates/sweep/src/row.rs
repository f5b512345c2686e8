//! Result of a plan: a row of the table.

use planish_types::outcome::sweep::{Constraints, PlanNumbers, PlanStatus};
use serde::{Deserialize, Serialize};

/// The numbers of a plan, or why there are none. The same plan gives the same bytes, wherever it was made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanRow {
    /// The plan.
    pub id: String,
    /// Status at the end.
    pub status: PlanStatus,
    /// Message of a stage: the reason for which there are no numbers, or of a negative verdict.
    pub message: Option<String>,
    /// The numbers, where the plan was made.
    pub numbers: Option<PlanNumbers>,
}

impl PlanRow {
    /// Makes the row of a plan that was not made.
    pub fn failed(id: &str, message: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            status: PlanStatus::Failed,
            message: Some(message.into()),
            numbers: None,
        }
    }

    /// Returns the numbers, where the plan keeps the constraints.
    pub fn eligible(&self, constraints: &Constraints) -> Option<&PlanNumbers> {
        self.numbers.as_ref().filter(|numbers| numbers.keeps(constraints))
    }
}
