//! Table of `planish sweep`: the plans of a sweep with their numbers.

use std::{collections::BTreeMap, fmt};

use serde::{Deserialize, Serialize};

use super::specification::{LimitReport, SpecificationReport};

/// Table that `planish sweep table` writes. `S` are the settings of a plan by name.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SweepTable<S = BTreeMap<String, SettingValue>> {
    /// Name of the sweep.
    pub name: String,
    /// Name of the mirror.
    pub mirror: String,
    /// True if the plans were judged by the errors of a process.
    pub has_process: bool,
    /// Constraints on the plans.
    pub constraints: Constraints,
    /// The plans.
    pub plans: Vec<SweepPlan<S>>,
}

/// Constraints that a plan must keep to be on the front.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Constraints {
    /// Longest time of a run, s.
    pub max_time_s: Option<f64>,
    /// True if the limits of the machine must be kept.
    pub keep_limits: bool,
    /// True if the limits of the specification must be kept, where there is one.
    #[serde(default = "keep_specification")]
    pub keep_specification: bool,
}

/// Returns the default of [`Constraints::keep_specification`], true.
fn keep_specification() -> bool {
    true
}

/// A plan and its result.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SweepPlan<S = BTreeMap<String, SettingValue>> {
    /// Name.
    pub id: String,
    /// Family of the path.
    pub path: String,
    /// Method.
    pub method: String,
    /// Settings by name.
    pub settings: S,
    /// Status at the end.
    pub status: PlanStatus,
    /// Message of the stage that ended the plan.
    pub message: Option<String>,
    /// The numbers, where the plan was made.
    pub numbers: Option<PlanNumbers>,
    /// The report, relative to the table.
    pub report: Option<String>,
    /// The command that makes the plan again.
    pub again: String,
}

/// Statuses of a plan at its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PlanStatus {
    /// The plan was made.
    Done,
    /// Made, and a stage gave a negative verdict: not converged, a limit exceeded.
    Negative,
    /// The plan was not made.
    Failed,
}

impl fmt::Display for PlanStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// The value of a setting in a plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum SettingValue {
    /// A number in the unit of the name.
    Number(f64),
    /// A word.
    Word(String),
}

impl fmt::Display for SettingValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => write!(f, "{number}"),
            Self::Word(word) => f.write_str(word),
        }
    }
}

/// The numbers of a plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanNumbers {
    /// Time of the run, s.
    pub total_time_s: f64,
    /// RMS of the residual, mean removed, nm.
    pub rms_nm: f64,
    /// RMS of the residual, plane removed, nm.
    pub rms_detilted_nm: f64,
    /// RMS of the residual that 95 % of the runs are below, nm, where the sweep has an error budget.
    pub below_95_percent_nm: Option<f64>,
    /// True if the limits of the machine are kept.
    pub limits_kept: bool,
    /// Verdict of the specification, where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub specification: Option<Specified>,
}

impl PlanNumbers {
    /// Returns the point [time of the run in s, residual RMS in nm] of a plan. The residual is the one that 95 % of the
    /// runs are below if the errors of a process are known, else the one without errors.
    pub fn point(&self) -> [f64; 2] {
        [self.total_time_s, self.below_95_percent_nm.unwrap_or(self.rms_nm)]
    }

    /// Returns true if the plan keeps its specification, or if there is no specification.
    pub fn keeps_specification(&self) -> bool {
        self.specification.as_ref().is_none_or(|specification| specification.passed)
    }

    /// Returns true if the plan keeps those limits, specification and longest time that the constraints require.
    pub fn keeps(&self, constraints: &Constraints) -> bool {
        (self.limits_kept || !constraints.keep_limits)
            && (self.keeps_specification() || !constraints.keep_specification)
            && constraints.max_time_s.is_none_or(|most| self.total_time_s <= most)
    }
}

/// Verdict of a specification on the residual of a plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Specified {
    /// True if all limits are kept.
    pub passed: bool,
    /// The limits, in the order of the specification.
    pub limits: Vec<Limited>,
}

impl From<SpecificationReport> for Specified {
    fn from(report: SpecificationReport) -> Self {
        let SpecificationReport { passed, limits, .. } = report;
        Self { passed, limits: limits.into_iter().map(Limited::from).collect() }
    }
}

/// A quantity with a limit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limited {
    /// Quantity in words.
    pub quantity: String,
    /// Unit; empty if it has none.
    pub unit: String,
    /// Value of the plan; `None` for infinity.
    pub value: Option<f64>,
    /// True if the limit is kept.
    pub passed: bool,
}

impl From<LimitReport> for Limited {
    fn from(report: LimitReport) -> Self {
        let LimitReport { quantity, unit, value, passed, .. } = report;
        Self { quantity, unit, value: Some(value).filter(|value| value.is_finite()), passed }
    }
}
