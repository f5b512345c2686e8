//! The numbers of a motion.

use planish_dwell::{
    DwellError,
    path_free_bound::{BoundSettings, bounds_on_any_path},
};
use planish_simulate::{SimulationSettings, simulate};
use planish_types::{Invalid, Machine, Surface, Tif, Trajectory};
use planish_verify::{Program, VerifySettings, verify_on_axes};
use serde::Serialize;

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
    /// Residual RMS, nm, that no path and no motion of the tool can beat in this time.
    pub bound_rms_nm: f64,
    /// Residual RMS, nm, that dwell times at any place leave in this time.
    pub reached_rms_nm: f64,
    /// Excess of the residual RMS over the bound, relative to it.
    pub excess: f64,
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

/// Scores a motion.
///
/// # Errors
/// Refuses a motion that breaks a limit of the machine, and what the bound and the simulation refuse.
pub fn score(
    desired: &Surface,
    tif: &Tif,
    machine: &Machine,
    motion: &Trajectory,
) -> Result<Score, ScoreError> {
    let settings = VerifySettings { program: Some(Program::Cubics), ..VerifySettings::default() };
    if let Some(reason) = verify_on_axes(motion, machine, &settings)?.reason() {
        return Err(ScoreError::Limit(reason));
    }
    let prediction = simulate(motion, tif, desired, SimulationSettings::Gridded)?;
    let residual = prediction.removal.residual();
    let statistics = residual.statistics();
    let time_s = motion.total_time_s();
    let settings = BoundSettings { time_s: vec![time_s], ..BoundSettings::default() };
    let bound = bounds_on_any_path(desired, tif, &settings)?.bounds[0];
    Ok(Score {
        time_s,
        residual_rms_nm: statistics.rms,
        residual_rms_detilted_nm: residual.detilted_rms_nm(),
        residual_pv_nm: statistics.pv,
        bound_rms_nm: bound.bound_rms_nm,
        reached_rms_nm: bound.reached_rms_nm,
        excess: statistics.rms / bound.bound_rms_nm - 1.0,
    })
}
