//! The numbers of a motion.

use planish_dwell::{
    DwellError,
    path_free_bound::{BoundSettings, PathFreeBound, bounds_on_any_path},
};
use planish_numerics::{
    slope::{Along, slopes},
    statistics::statistics,
};
use planish_simulate::{SimulationSettings, error_budget::ErrorBudget, simulate};
use planish_tolerance::{ToleranceSettings, tolerance};
use planish_types::{Invalid, Machine, Surface, Tif, Trajectory, outcome::tolerance::Quantiles};
use planish_verify::{Program, VerifySettings, verify_on_axes};
use serde::Serialize;

/// Ratio of two times from which each has a bound of its own. Larger: a smaller bound between them, by the second order
/// of the ratio. Smaller: more time.
const TIMES_APART: f64 = 1.02;

/// Score of a motion.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Duration of the motion, s.
    pub time_s: f64,
    /// RMS (mean removed) of the residual of the executed motion, nm.
    pub residual_rms_nm: f64,
    /// RMS of that residual without its best plane, nm.
    pub residual_rms_detilted_nm: f64,
    /// PV of that residual, nm.
    pub residual_pv_nm: f64,
    /// RMS of its slopes along [x, y] between neighbouring pixels, nrad.
    pub slope_rms_nrad: [f64; 2],
    /// Residual RMS, nm, that no path and no motion of the tool can beat in this time.
    pub bound_rms_nm: f64,
    /// Residual RMS, nm, that dwell times at any place leave in this time.
    pub reached_rms_nm: f64,
    /// Excess of the residual RMS over the bound, relative to it.
    pub excess: f64,
    /// Residual RMS over runs with the errors of the process, nm; absent if they were not drawn.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub with_errors: Option<Quantiles>,
}

/// Part, tool, machine and errors that a motion is scored on.
#[derive(Clone, Copy, Debug)]
pub struct ScoreTask<'a> {
    /// Desired removal.
    pub desired: &'a Surface,
    /// Tool.
    pub tif: &'a Tif,
    /// Machine with its limits.
    pub machine: &'a Machine,
    /// Errors of the process; `None` to draw none.
    pub errors: Option<&'a ErrorBudget>,
}

/// Reasons for which a motion has no score.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScoreError {
    /// The motion breaks a limit of the machine.
    #[error("breaks a limit of the machine: {0}")]
    Limit(String),
    /// The motion cannot be judged or simulated.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// There is no bound.
    #[error(transparent)]
    Bound(#[from] DwellError),
}

/// Scores motions on the same task. Each has its score, or the reason why it has none.
///
/// # Errors
/// Refuses a task for which there is no bound.
pub fn scores(
    task: &ScoreTask<'_>,
    motions: &[Trajectory],
) -> Result<Vec<Result<Score, ScoreError>>, ScoreError> {
    let executed: Vec<_> = motions.iter().map(|motion| executed(task, motion)).collect();
    let times = executed.iter().flatten().map(|motion| motion.time_s);
    let time_s = apart(times.collect());
    if time_s.is_empty() {
        return Ok(executed.into_iter().map(|one| Err(one.expect_err("no time"))).collect());
    }
    let settings = BoundSettings { time_s, ..BoundSettings::default() };
    let bounds = bounds_on_any_path(task.desired, task.tif, &settings)?.bounds;
    Ok(executed.into_iter().map(|one| one.map(|motion| motion.score(&bounds))).collect())
}

/// Returns some of these times in ascending order, so that none is more than [`TIMES_APART`] above one of them.
fn apart(mut time_s: Vec<f64>) -> Vec<f64> {
    time_s.sort_unstable_by(f64::total_cmp);
    let mut kept: Vec<f64> = Vec::new();
    for time in time_s {
        if kept.last().is_none_or(|last| time > last * TIMES_APART) {
            kept.push(time);
        }
    }
    kept
}

/// Execution of a motion: its time, and what it leaves.
#[derive(Debug)]
struct Executed {
    time_s: f64,
    residual: Surface,
    with_errors: Option<Quantiles>,
}

/// Simulates a motion, without and with errors. Refuses a motion that breaks a limit of the machine, and what the
/// simulation refuses.
fn executed(task: &ScoreTask<'_>, motion: &Trajectory) -> Result<Executed, ScoreError> {
    let ScoreTask { desired, tif, machine, errors } = *task;
    let settings = VerifySettings { program: Some(Program::Cubics), ..VerifySettings::default() };
    if let Some(reason) = verify_on_axes(motion, machine, &settings)?.reason() {
        return Err(ScoreError::Limit(reason));
    }
    let prediction = simulate(motion, tif, desired, SimulationSettings::Gridded)?;
    let mut with_errors = None;
    if let Some(errors) = errors {
        let drawn = tolerance(motion, tif, desired, errors, &ToleranceSettings::default())?;
        with_errors = Some(drawn.outcome.residual);
    }
    Ok(Executed {
        time_s: motion.total_time_s(),
        residual: prediction.removal.residual().clone(),
        with_errors,
    })
}

impl Executed {
    /// Returns the score beside bounds for some times. Each bound holds at every time T, along its tangent:
    ///
    /// ```text
    /// RMS(T) >= bound(T0) - slope (T - T0)
    /// ```
    fn score(self, bounds: &[PathFreeBound]) -> Score {
        let Self { time_s, residual, with_errors } = self;
        let at_time = |bound: &PathFreeBound| {
            bound.bound_rms_nm - bound.bound_slope_nm_per_s * (time_s - bound.time_s)
        };
        let bound_rms_nm = bounds.iter().map(at_time).fold(0.0, f64::max);
        let statistics = residual.statistics();
        Score {
            time_s,
            residual_rms_nm: statistics.rms,
            residual_rms_detilted_nm: residual.detilted_rms_nm(),
            residual_pv_nm: statistics.pv,
            slope_rms_nrad: [Along::X, Along::Y].map(|along| slope_rms_nrad(&residual, along)),
            bound_rms_nm,
            reached_rms_nm: reached(bounds, time_s),
            excess: statistics.rms / bound_rms_nm - 1.0,
            with_errors,
        }
    }
}

/// Returns the residual that dwell times reach within a time: that of the longest of the `bounds` within it. The first
/// bound has the shortest time of all.
fn reached(bounds: &[PathFreeBound], time_s: f64) -> f64 {
    let within = bounds.iter().rfind(|bound| bound.time_s <= time_s);
    within.unwrap_or(&bounds[0]).reached_rms_nm
}

/// Returns the RMS (mean removed) of the slopes of a map between neighbouring pixels, nrad; 0 if it has none.
fn slope_rms_nrad(map: &Surface, along: Along) -> f64 {
    let axis = match along {
        Along::X => &map.grid().x,
        Along::Y => &map.grid().y,
    };
    let urad = slopes(map.height_nm().view(), &axis.coordinates(), along, 1);
    statistics(urad.view()).map_or(0.0, |slope| 1e3 * slope.rms)
}
