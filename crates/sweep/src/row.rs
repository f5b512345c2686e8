//! Result of a plan: a row of the table.

use serde::{Deserialize, Serialize};

use crate::description::Constraints;

/// The numbers of a plan, or why there are none. The same plan gives the same bytes, wherever it was made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// The plan.
    pub id: String,
    /// Status at the end.
    pub status: RowStatus,
    /// Message of a stage: the reason for which there are no numbers, or of a negative verdict.
    pub message: Option<String>,
    /// The numbers, where the plan was made.
    pub numbers: Option<Numbers>,
}

/// Statuses of a plan at its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RowStatus {
    /// The plan was made.
    Done,
    /// Made, and a stage gave a negative verdict: not converged, a limit exceeded.
    Negative,
    /// The plan was not made.
    Failed,
}

/// The numbers of a plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Numbers {
    /// Time of the run, s.
    pub total_time_s: f64,
    /// RMS of the residual, mean removed, nm.
    pub rms_nm: f64,
    /// RMS of the residual, plane removed, nm.
    pub rms_detilted_nm: f64,
    /// RMS of the residual that 95 % of the runs are below, nm, where there is a process.
    pub below_95_percent_nm: Option<f64>,
    /// True if the limits of the machine are kept.
    pub limits_kept: bool,
    /// Verdict of the specification, where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub specification: Option<Specified>,
}

/// Verdict of a specification on the residual of a plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Specified {
    /// True if all limits are kept.
    pub passed: bool,
    /// The limits, in the order of the specification.
    pub limits: Vec<Limited>,
}

/// A quantity with a limit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Limited {
    /// Quantity in words.
    pub quantity: String,
    /// Unit; empty if it has none.
    pub unit: String,
    /// Value of the plan.
    pub value: Option<f64>,
    /// True if the limit is kept.
    pub passed: bool,
}

impl Row {
    /// A plan that was not made.
    pub fn failed(id: &str, message: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            status: RowStatus::Failed,
            message: Some(message.into()),
            numbers: None,
        }
    }

    /// The numbers, where the plan keeps the constraints.
    pub fn eligible(&self, constraints: &Constraints) -> Option<&Numbers> {
        self.numbers.as_ref().filter(|numbers| {
            let keeps_specification = numbers.specification.as_ref().is_none_or(|s| s.passed);
            (numbers.limits_kept || !constraints.keep_limits)
                && (keeps_specification || !constraints.keep_specification)
                && constraints.max_time_s.is_none_or(|most| numbers.total_time_s <= most)
        })
    }
}

impl Numbers {
    /// Residual against time: what 95 % of the runs are below where there is a process, else without errors.
    pub fn point(&self) -> [f64; 2] {
        [self.total_time_s, self.below_95_percent_nm.unwrap_or(self.rms_nm)]
    }
}
