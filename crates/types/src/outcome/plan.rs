//! Outcome of a stage that makes dwell times, a motion, or both.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::{End, PathDistance, TifLattice};

/// Outcome of `planish dwell`, `planish schedule`, `planish refine`, `planish joint` or `planish bspline-feed`. Each
/// states what it knows. `R` is the report of the method.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanOutcome<R = PlanReport> {
    /// Round of the closed loop whose plan this is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_round: Option<usize>,
    /// Reason for which the method ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub end: Option<StatedEnd>,
    /// Number of dwell times of the closed loop at a bound of their correction.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_bound: Option<usize>,
    /// RMS of the predicted residual, mean removed, nm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_nm: Option<f64>,
    /// RMS of the predicted residual, plane removed, nm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_detilted_nm: Option<f64>,
    /// Sum of the dwell times that were scheduled, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dwell_s: Option<f64>,
    /// Duration of the motion, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub total_time_s: Option<f64>,
    /// True if the judge found every limit of the machine kept.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub limits_respected: Option<bool>,
    /// Claim of a scheduler about the limits of the machine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub claim: Option<Claim>,
    /// Distance of the motion from its path.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path_distance: Option<PathDistance>,
    /// Interpolation between the nodes of a dwell-time density, in words.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub between_nodes: Option<Cow<'static, str>>,
    /// Report of the method.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub report: Option<R>,
}

impl<R> Default for PlanOutcome<R> {
    fn default() -> Self {
        Self {
            best_round: None,
            end: None,
            at_bound: None,
            rms_nm: None,
            rms_detilted_nm: None,
            dwell_s: None,
            total_time_s: None,
            limits_respected: None,
            claim: None,
            path_distance: None,
            between_nodes: None,
            report: None,
        }
    }
}

/// Reason for which a method ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum StatedEnd {
    /// Reason that the stages of Planish know.
    Known(End),
    /// Word of another program.
    Foreign(String),
}

impl From<End> for StatedEnd {
    fn from(end: End) -> Self {
        Self::Known(end)
    }
}

/// Part of the report of a method that others read. A program that is not ours, or an older one, may state its end here.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PlanReport {
    /// Reason for which the method ended, if the outcome does not state it.
    pub end: Option<StatedEnd>,
    /// True if the method ended by itself.
    pub converged: Option<bool>,
    /// Proven bound on the rest that is left to gain.
    #[serde(flatten)]
    pub proven: ProvenGap,
}

/// Report on the dwell times of several tools, as far as a run with them reads it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct SeveralReport {
    /// RMS of the residual of all tools in the removal model of the solver, nm.
    pub model_rms_nm: f64,
    /// Share of each tool.
    pub tools: Vec<ToolShare>,
    /// Expected RMS of the set-up errors that no map shows, nm; `None` without such errors.
    pub unseen_setup_rms_nm: Option<f64>,
    /// Residual that the plan shall keep; `None` if the prices alone decide.
    pub keeping: Option<Keeping>,
    /// Choice of the tools; absent if it was not made here.
    pub choice: Option<ChoiceReport>,
}

/// Share of one tool in a plan of several.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ToolShare {
    /// Name of the tool.
    pub name: String,
    /// Price of a second of this tool, nm^2/s.
    pub time_weight_nm2_per_s: f64,
    /// Sum of its dwell times, s.
    pub total_time_s: f64,
    /// Weighted mean of what it removes, nm.
    pub mean_removal_nm: f64,
    /// Number of its dwell points.
    pub points: usize,
    /// Number of its reached dwell points at their lower bound.
    pub at_lower_bound: usize,
    /// Number of its dwell points that do not reach the map.
    pub unreached_points: usize,
    /// Part of the pixels that count at which it removes next to nothing, wherever along its path it dwells.
    pub unreached_part: f64,
    /// Lattice of the map on which its TIF was sampled anew; left out where the samples are its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tif_lattice: Option<TifLattice>,
    /// Removal that it keeps for the set-up errors of the tools before it; left out if no map shows such errors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reserve: Option<Reserve>,
}

/// Removal that a tool keeps for the set-up errors of the tools before it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reserve {
    /// Names of the tools whose set-up errors it is for.
    pub errors_of: Vec<String>,
    /// Mean of the reserve over the pixels that count, nm.
    pub mean_nm: f64,
    /// Its largest value there, nm.
    pub largest_nm: f64,
    /// Sum of the least dwell times that it asks for, s.
    pub time_s: f64,
}

/// Residual that a plan shall keep, and whether it does.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Keeping {
    /// Residual that it shall keep, RMS, nm.
    pub keep_rms_nm: f64,
    /// Factor on the prices of a second of all tools.
    pub price_factor: f64,
    /// True if it keeps the residual.
    pub is_kept: bool,
}

/// Report on the choice of tools: the subsets that were solved, and the bound over all of them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChoiceReport {
    /// Subsets that were solved, in the order in which they were.
    pub subsets: Vec<SubsetRow>,
    /// Index of the best one.
    pub best: usize,
    /// Proven lower bound of the cost of every subset, nm^2.
    pub bound_nm2: Option<f64>,
    /// Bound of the distance of the cost of the best subset from the least one, relative to its cost.
    pub relative_gap_of_choice: Option<f64>,
}

/// A subset of the rack that was solved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SubsetRow {
    /// Names of its tools.
    pub tools: Vec<String>,
    /// Residual of its plan, RMS, nm.
    pub model_rms_nm: f64,
    /// Sum of the dwell times of each tool, s.
    pub time_s: Vec<f64>,
    /// Sum of all dwell times and of the times to mount the tools, s.
    pub time_with_changes_s: f64,
    /// Objective and prices of the changes, nm^2.
    pub cost_nm2: f64,
    /// Proven lower bound of this cost, nm^2.
    pub bound_nm2: Option<f64>,
}

/// Proven bound on what a plan leaves to gain: part of the report of a method.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ProvenGap {
    /// Excess of the objective over its minimum, relative to it, at most. Not finite if nothing is proven.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub relative_gap: Option<f64>,
    /// The same, as `planish bspline-feed` calls it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gap: Option<f64>,
    /// Sentence on the plans that the bound compares with.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gap_covers: Option<Cow<'static, str>>,
}

/// Claim of a schedule about the limits of the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Claim {
    /// True if every limit is kept: each of the following is true or `None`.
    pub limits_respected: bool,
    /// True if the position is continuous.
    #[serde(default)]
    pub continuous_position: bool,
    /// True if the velocity is continuous, from rest at the start to rest at the end.
    #[serde(default)]
    pub continuous_velocity: bool,
    /// True if both axes keep the velocity limit.
    #[serde(default)]
    pub velocity: bool,
    /// True if both axes keep the acceleration limit.
    #[serde(default)]
    pub acceleration: bool,
    /// True if the limited axes keep the jerk limit and their acceleration does not step. `None` if the
    /// machine does not limit jerk.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jerk: Option<bool>,
    /// True if the limited axes keep the jerk limit inside segments; steps of the acceleration between
    /// segments do not count. `None` if the machine does not limit jerk.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jerk_inside_segments: Option<bool>,
    /// True if no segment is shorter than the controller accepts.
    #[serde(default)]
    pub min_segment: bool,
    /// Largest |jerk| inside segments of [x, y], mm/s^3.
    #[serde(default)]
    pub max_jerk_mm_per_s3: [f64; 2],
    /// Largest step in acceleration of [x, y], start and end included, mm/s^2.
    #[serde(default)]
    pub max_acceleration_step_mm_per_s2: [f64; 2],
}
