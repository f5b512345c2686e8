//! The closed loop for a process with errors: the expected square in the place of the square.
//!
//! ```text
//! E |e|^2 = |P (e - m)|^2 + t'Q t + constant                                             (1)
//! ```
//!
//! with the residual e of the motion, what the fixed errors of the process remove more (m), and the quadratic of the
//! variances Q ([`planish_tolerance::quadratic`]). The loop first lowers |e|, as without a process, and goes on from
//! there with (1). Its rounds keep the best plan by (1), so what it ends with is expected to leave no more than the
//! plan that knows nothing of the process; the machine's needs that were found stay lower bounds. Q and m are those of the best motion so far, as the columns are. Q enters
//! the dwell solver as products, in its exact gradient and curvature, and its certificate holds with them.
//!
//! Both plans are judged by [`planish_tolerance::tolerance`], which has the whole process, the constant included, and
//! the one with the smaller expected RMS is kept: where the errors are so large that Q, which is of first order, is
//! none of theirs, that can be the first one.

use planish_tolerance::{
    Settings as ToleranceSettings, Tolerance, process::Process, quadratic::Sources, tolerance,
};
use planish_types::{DwellTime, End, Invalid, Limits, Surface, Tif, ToolPath, Trajectory};
use serde::Serialize;

use crate::{RefineError, Refined, Settings, Start, refine, rounds};

/// What a plan leaves under a process.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Judged {
    /// RMS without errors, nm.
    pub nominal_rms_nm: f64,
    /// sqrt of the mean over runs of the mean square, nm.
    pub expected_rms_nm: f64,
    /// Half of the runs are below, nm.
    pub median_nm: f64,
    /// 95 % of the runs are below, nm.
    pub below_95_percent_nm: f64,
    /// Total time, s.
    pub total_time_s: f64,
}

/// What the process made of the plan, and what that costs and gains.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Price {
    /// Name of the process.
    pub name: String,
    /// Kinds of its errors that the objective has.
    pub in_the_objective: Vec<String>,
    /// Kinds that it has not, because they add the same whatever the dwell times, or are not differentiable by them.
    pub not_in_the_objective: Vec<String>,
    /// The plan made without the process.
    pub without: Judged,
    /// The plan made for it; the same where no error is in the objective.
    pub with: Judged,
    /// Whether the plan made for it is the one that is kept.
    pub kept: bool,
}

/// [`refine`], and then for a process.
pub fn refine_for(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    first: Option<DwellTime>,
    settings: &Settings,
    process: &Process,
) -> Result<(Refined, Price), RefineError> {
    let sources = Sources::new(desired, tif, process, settings.dwell.free)?;
    let plan = refine(desired, tif, path, limits, first, settings)?;
    let judge = |plan: &Refined| -> Result<Judged, Invalid> {
        let how = ToleranceSettings {
            free: settings.dwell.free,
            simulated_runs: 0,
            ..ToleranceSettings::default()
        };
        let found = tolerance(&plan.trajectory, tif, desired, process, &how)?;
        Ok(Judged::of(&found, &plan.trajectory))
    };
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
    let mut kept = plan;
    let rounds_before = kept.iterates.len();
    kept.iterates.extend(expected.iterates);
    if price.kept {
        let limit = [kept.end, expected.end].contains(&End::RoundLimit);
        kept.dwell = expected.dwell;
        kept.trajectory = expected.trajectory;
        kept.best = rounds_before + expected.best;
        kept.end = if limit { End::RoundLimit } else { expected.end };
        kept.at_bound = expected.at_bound;
        kept.least_s = expected.least_s;
    }
    Ok((kept, price))
}

impl Judged {
    fn of(found: &Tolerance, plan: &Trajectory) -> Self {
        Self {
            nominal_rms_nm: found.nominal_rms_nm,
            expected_rms_nm: found.expected_rms_nm,
            median_nm: found.residual.median_nm,
            below_95_percent_nm: found.residual.below_95_percent_nm,
            total_time_s: plan.total_time_s(),
        }
    }
}
