//! Report: the lines of the errors, the distribution, and the simulated runs.

use ndarray::Array2;
use planish_simulate::coverage::Coverage;
use serde::Serialize;

use crate::error_budget::Distribution;

/// Number of levels at which the distribution is stored. Larger: larger files. Smaller: coarser curves.
pub const LEVELS: usize = 201;

/// Effect of one error.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Line {
    /// Kind of the error.
    pub kind: String,
    /// Size of the error as stated.
    pub size: f64,
    /// Unit of the size.
    pub unit: String,
    /// Distribution of the error from run to run.
    pub distribution: Distribution,
    /// Source of the number.
    pub note: String,
    /// RMS over pixels and runs of the residual that the error adds alone, nm.
    pub adds_rms_nm: f64,
    /// Part of `adds_rms_nm` at frequencies that the tool corrects, nm.
    pub reached_rms_nm: f64,
    /// Part of `adds_rms_nm` at frequencies that the tool does not correct, nm.
    pub unreached_rms_nm: f64,
    /// RMS difference between what one run with the error of this size adds and its first order, nm.
    pub departs_by_rms_nm: f64,
    /// True if the line is that of simulated runs, because the departure is too large.
    pub simulated: bool,
    /// Standard error of `adds_rms_nm`, nm, if it is that of simulated runs with noise. An error of one number is
    /// simulated at the nodes of a quadrature, which has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub standard_error_nm: Option<f64>,
}

/// A run with all errors, simulated, and as the first order has it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Pair {
    /// RMS of the simulated run, nm.
    pub simulated_rms_nm: f64,
    /// RMS to first order, nm.
    pub first_order_rms_nm: f64,
}

/// The distribution of the residual's RMS over the runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Quantiles {
    /// Half of the runs are below, nm.
    pub median_nm: f64,
    /// 95 % of the runs are below, nm.
    pub below_95_percent_nm: f64,
    /// 95 % of the runs are between these, as many above as below, nm.
    pub interval_95_percent_nm: [f64; 2],
}

/// The error without which the residual that 95 % of the runs are below is least.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct First {
    /// Index of the error.
    pub index: usize,
    /// Kind of the error.
    pub kind: String,
    /// RMS below which 95 % of the runs are without this error, nm (first order).
    pub without_it_95_percent_nm: f64,
}

/// Sentence on what the mean tool decides in the budget of a tool that varies.
pub const MEAN_TOOL: &str = "the tool varies over the part: every error acts on it as it is at its place, and the mean \
                             tool decides which wavelengths are reached";

/// Effect of the process on the residual.
#[derive(Clone, Debug, Serialize)]
pub struct Tolerance {
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
    pub errors: Vec<Line>,
    /// Error to improve first; none if no error adds anything.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first: Option<First>,
    /// Runs that were simulated.
    pub runs: Vec<Pair>,
    /// Largest relative difference between the two RMS of these runs.
    pub largest_difference: f64,
    /// Number of the simulated runs that are in the interval of 95 %.
    pub within_interval: usize,
    /// Distribution: fractions of the runs, and the RMS below which they are, nm.
    #[serde(skip)]
    pub levels: Vec<(f64, f64)>,
    /// Standard deviation over the runs of the residual of every pixel, nm; NaN where invalid.
    #[serde(skip)]
    pub deviation_nm: Array2<f64>,
    /// Part of the map that the plan reaches.
    pub coverage: Coverage,
    /// Largest error of the TIF that errors move, over its peak, where it was sampled anew on the pixels of the map;
    /// else 0.
    pub tif_resampling_error: f64,
    /// The sentence on the state in which an axis with play begins, if the budget has play.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub backlash_start: Option<&'static str>,
    /// The sentence on what the mean tool decides, for a tool that varies over the part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_tool: Option<&'static str>,
}
