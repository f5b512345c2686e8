//! Outcome of a prediction of the residual, and of a measured map.

use serde::{Deserialize, Serialize};

use super::NoMore;

/// Outcome of `planish simulate`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RemovalOutcome<More = NoMore> {
    /// RMS of the residual, mean removed, nm.
    pub rms_nm: f64,
    /// RMS of the residual, plane removed, nm; absent of a run of the virtual machine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_detilted_nm: Option<f64>,
    /// Largest minus smallest residual, nm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pv_nm: Option<f64>,
    /// Duration of the motion, s.
    pub total_time_s: f64,
    /// Further numbers.
    #[serde(flatten)]
    pub more: More,
}

/// Servos of a prediction: the first of its further numbers that others read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServoOutcome {
    /// Number of servos of a fixed lag that the axes follow through; absent unless the prediction is that after the servo.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub servos: Option<usize>,
}

/// Outcome of a map that the virtual machine measures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeasuredOutcome {
    /// RMS of the map, mean removed, nm.
    pub rms_nm: f64,
    /// Largest minus smallest height, nm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pv_nm: Option<f64>,
}
