//! Result of a plan: a row of the table.

use planish_types::outcome::sweep::{Constraints, PlanNumbers, PlanStatus};
use serde::{Deserialize, Serialize};

/// Numbers of a plan, or the reason why there are none. The same plan gives the same bytes on every machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanRow {
    /// Name of the plan.
    pub id: String,
    /// Status of the plan: done, negative or failed.
    pub status: PlanStatus,
    /// Message of a stage: the reason of a failure or of a negative verdict; `None` for a plan that is done.
    pub message: Option<String>,
    /// Numbers of the plan; `None` if it could not be made.
    pub numbers: Option<PlanNumbers>,
}

impl PlanRow {
    /// Makes the row of the plan `id` that could not be made, for the reason `message`.
    pub fn failed(id: &str, message: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            status: PlanStatus::Failed,
            message: Some(message.into()),
            numbers: None,
        }
    }

    /// Returns the numbers of a plan that keeps the constraints; `None` if it was not made or does not keep them.
    pub fn eligible(&self, constraints: &Constraints) -> Option<&PlanNumbers> {
        self.numbers.as_ref().filter(|numbers| numbers.keeps(constraints))
    }
}
