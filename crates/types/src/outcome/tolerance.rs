//! Outcome of `planish tolerance`: the residual that the errors of a process add to a plan.

use ndarray::Array2;
use serde::{Deserialize, Serialize};

use crate::Grid;

/// Settings of `planish tolerance` that others read.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
pub struct ToleranceSettings {
    /// Low-order terms that are not part of the residual, `piston` or `plane`; `piston` where it is left out.
    pub free: Option<String>,
}

/// Effect of the process on the residual.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ToleranceOutcome {
    /// Name of the process.
    pub error_budget: String,
    /// RMS of the residual of the plan, nm.
    pub nominal_rms_nm: f64,
    /// sqrt of the mean over runs of the mean square, nm (first order).
    pub expected_rms_nm: f64,
    /// Distribution of the RMS of the residual.
    pub residual: Quantiles,
    /// True if the distribution is that of simulated runs.
    pub simulated: bool,
    /// An entry per error of the process.
    pub errors: Vec<ErrorLine>,
    /// Error to improve first; none if no error adds anything.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first: Option<First>,
}

/// Arrays of a tolerance artifact.
#[derive(Clone, Debug, PartialEq)]
pub struct ToleranceArrays {
    /// Fractions of the runs (m), ascending from 0 to 1.
    pub part: Vec<f64>,
    /// RMS that these fractions of the runs are below (m), nm.
    pub rms_nm: Vec<f64>,
    /// Standard deviation over the runs of every pixel (ny, nx), nm; NaN where invalid.
    pub deviation_nm: Array2<f64>,
    /// Pixel centres.
    pub grid: Grid,
}

/// Effect of one error of a process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorLine {
    /// Kind of the error.
    pub kind: String,
    /// Size of the error as stated.
    pub size: f64,
    /// Unit of the size.
    pub unit: String,
    /// Distribution of the error from run to run.
    pub distribution: Distribution,
    /// Source of the number.
    #[serde(default)]
    pub note: String,
    /// RMS over pixels and runs of the residual that the error adds alone, nm.
    pub adds_rms_nm: f64,
    /// Part of `adds_rms_nm` at frequencies that the tool corrects, nm.
    pub reached_rms_nm: f64,
    /// Part of `adds_rms_nm` at frequencies that the tool does not correct, nm.
    pub unreached_rms_nm: f64,
    /// RMS difference between what one run with the error of this size adds and its first order, nm.
    #[serde(default)]
    pub departs_by_rms_nm: f64,
    /// True if the line is that of simulated runs, because the departure is too large.
    #[serde(default)]
    pub simulated: bool,
    /// Standard error of `adds_rms_nm`, nm, if it is that of simulated runs with noise. An error of one number is
    /// simulated at the nodes of a quadrature, which has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub standard_error_nm: Option<f64>,
}

/// The distribution of the residual's RMS over the runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// Half of the runs are below, nm.
    pub median_nm: f64,
    /// 95 % of the runs are below, nm.
    pub below_95_percent_nm: f64,
    /// 95 % of the runs are between these, as many above as below, nm.
    pub interval_95_percent_nm: [f64; 2],
}

/// The error without which the residual that 95 % of the runs are below is least.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct First {
    /// Index of the error.
    #[serde(default)]
    pub index: usize,
    /// Kind of the error.
    pub kind: String,
    /// RMS below which 95 % of the runs are without this error, nm (first order).
    pub without_it_95_percent_nm: f64,
}

/// Distributions of an error from run to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Distribution {
    /// Normal about zero; the size is the standard deviation.
    Normal,
    /// Uniform about zero; the size is half the width.
    Uniform,
    /// Always the size itself.
    Fixed,
}
