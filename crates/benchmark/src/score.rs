//! The numbers of a motion.

use planish_dwell::DwellError;
use planish_numerics::{
    slope::{Along, slopes},
    statistics::statistics,
};
use planish_simulate::{SimulationSettings, error_budget::ErrorBudget, simulate};
use planish_tolerance::{ToleranceSettings, tolerance};
use planish_types::{Invalid, Machine, Surface, Tif, Trajectory, outcome::tolerance::Quantiles};
use planish_verify::{Program, VerifySettings, verify_on_axes};
use serde::Serialize;

use crate::front::Front;

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
    /// Time, s, that every path and every motion of the tool needs for this residual RMS.
    pub bound_time_s: f64,
    /// Excess of the time over that bound, relative to it.
    pub excess_time: f64,
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
    let mut reached = Vec::new();
    for motion in executed.iter().flatten() {
        reached.push([motion.time_s, motion.residual.statistics().rms]);
    }
    let front = Front::new(task.desired, task.tif, &reached)?;
    Ok(executed.into_iter().map(|one| one.map(|motion| motion.score(&front))).collect())
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
    /// Returns the score beside the bounds.
    fn score(self, front: &Front) -> Score {
        let Self { time_s, residual, with_errors } = self;
        let statistics = residual.statistics();
        let bound_rms_nm = front.bound_rms_nm(time_s);
        let bound_time_s = front.bound_time_s(statistics.rms);
        Score {
            time_s,
            residual_rms_nm: statistics.rms,
            residual_rms_detilted_nm: residual.detilted_rms_nm(),
            residual_pv_nm: statistics.pv,
            slope_rms_nrad: [Along::X, Along::Y].map(|along| slope_rms_nrad(&residual, along)),
            bound_rms_nm,
            reached_rms_nm: front.reached_rms_nm(time_s),
            excess: statistics.rms / bound_rms_nm - 1.0,
            bound_time_s,
            excess_time: time_s / bound_time_s - 1.0,
            with_errors,
        }
    }
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
