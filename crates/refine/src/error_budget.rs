//! The closed loop for a process with errors: the expected mean square of the residual replaces the mean square.
//!
//! ```text
//! E |e|^2 = |P (e - m)|^2 + t'Q t + constant                                             (1)
//! ```
//!
//! with the residual e of the motion, the additional removal m by the fixed errors of the process, and the quadratic Q
//! of the variances ([`planish_tolerance::quadratic`]). The loop first lowers |e|, as without an error budget, and goes
//! on from there with (1). Its rounds keep the best plan by (1), so by (1) the result is no worse than the plan without
//! the error budget. The times that the machine needed remain lower bounds. Q and m are those of the best motion so
//! far, like the columns. Q enters the dwell solver as products, in its exact gradient and curvature, and its
//! certificate holds with them.
//!
//! [`planish_tolerance::tolerance`] judges both plans with the whole process, the constant included, and the plan
//! with the smaller expected RMS is kept. That can be the first plan, if the errors are too large for Q, which is
//! of first order.

use planish_tolerance::{
    ToleranceSettings, error_budget::ErrorBudget, quadratic::Sources, tolerance,
};
use planish_types::{DwellTime, End, Invalid, Limits, Surface, Tif, ToolPath};
use serde::Serialize;

use crate::{RefineError, RefineSettings, Refined, Start, refine, rounds};

/// Distribution of the residual of a plan under the errors of a process, and its time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PlanRisk {
    /// RMS of the residual without errors, nm.
    pub nominal_rms_nm: f64,
    /// Root of the mean square of the residual, averaged over runs, nm.
    pub expected_rms_nm: f64,
    /// Median of the RMS over the runs, nm.
    pub median_nm: f64,
    /// RMS that 95 % of the runs do not exceed, nm.
    pub below_95_percent_nm: f64,
    /// Total time of the motion, s.
    pub total_time_s: f64,
}

/// Comparison of the plans made without and with the error budget.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Price {
    /// Name of the process, from its error budget.
    pub name: String,
    /// Kinds of errors whose effect is in the objective of the loop.
    pub in_the_objective: Vec<String>,
    /// Kinds of errors that are not in the objective of the loop: their effect does not depend on the dwell times, or
    /// has no derivative by them.
    pub not_in_the_objective: Vec<String>,
    /// Risk of the plan made without the error budget.
    pub without: PlanRisk,
    /// Risk of the plan made with the error budget; the same as `without` if no error is in the objective.
    pub with: PlanRisk,
    /// True if the plan made with the error budget is kept, because its expected RMS is smaller; false if the other one
    /// is.
    pub kept: bool,
}

/// Refines the dwell times by [`refine`], and goes on from the result with the expected square for the process.
///
/// # Errors
///
/// Refuses what [`refine`] refuses, and errors that the tool cannot have or that [`tolerance`] refuses.
pub fn refine_for(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    first: Option<DwellTime>,
    settings: &RefineSettings,
    process: &ErrorBudget,
) -> Result<(Refined, Price), RefineError> {
    let sources = Sources::new(desired, tif, process, settings.dwell.free)?;
    let plan = refine(desired, tif, path, limits, first, settings)?;
    let judge = |plan: &Refined| PlanRisk::new(plan, tif, desired, process, settings);
    let without = judge(&plan)?;
    let Sources { included, left_out, .. } = &sources;
    let mut price = Price {
        name: process.name.clone(),
        in_the_objective: included.clone(),
        not_in_the_objective: left_out.clone(),
        without,
        with: without,
        kept: false,
    };
    if sources.is_empty() {
        return Ok((plan, price));
    }
    let start = Start { dwell: Some(plan.dwell.clone()), least_s: Some(plan.least_s.clone()) };
    let expected = rounds(desired, tif, path, limits, start, settings, Some(&sources))?;
    price.with = judge(&expected)?;
    price.kept = price.with.expected_rms_nm < without.expected_rms_nm;
    let mut best = plan;
    let rounds_before = best.iterates.len();
    best.iterates.extend(expected.iterates);
    if price.kept {
        let limit = [best.end, expected.end].contains(&End::RoundLimit);
        best.dwell = expected.dwell;
        best.trajectory = expected.trajectory;
        best.best = rounds_before + expected.best;
        best.end = if limit { End::RoundLimit } else { expected.end };
        best.at_bound = expected.at_bound;
        best.least_s = expected.least_s;
    }
    Ok((best, price))
}

impl PlanRisk {
    /// Computes the distribution of the residual of a plan with the whole process.
    fn new(
        plan: &Refined,
        tif: &Tif,
        desired: &Surface,
        process: &ErrorBudget,
        settings: &RefineSettings,
    ) -> Result<Self, Invalid> {
        let how = ToleranceSettings {
            free: settings.dwell.free,
            simulated_runs: 0,
            ..ToleranceSettings::default()
        };
        let outcome = tolerance(&plan.trajectory, tif, desired, process, &how)?.outcome;
        Ok(Self {
            nominal_rms_nm: outcome.nominal_rms_nm,
            expected_rms_nm: outcome.expected_rms_nm,
            median_nm: outcome.residual.median_nm,
            below_95_percent_nm: outcome.residual.below_95_percent_nm,
            total_time_s: plan.trajectory.total_time_s(),
        })
    }
}
