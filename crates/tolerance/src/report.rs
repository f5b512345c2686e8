//! Report of the tolerance analysis: the table of the errors, the distribution, and the simulated runs.

use ndarray::Array2;
use planish_simulate::coverage::Coverage;
use planish_types::outcome::tolerance::ToleranceOutcome;
use serde::Serialize;

/// Number of quantiles with which the distribution is stored, at equal steps from 0 to 1. Larger: larger files.
/// Smaller: coarser curves.
pub const LEVELS: usize = 201;

/// One run with all errors: its simulated RMS, and its RMS to first order.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Pair {
    /// RMS of the residual of the simulated run, nm.
    pub simulated_rms_nm: f64,
    /// RMS of the residual of the same run to first order, nm.
    pub first_order_rms_nm: f64,
}

impl Pair {
    /// Returns the relative difference of the two RMS values, as a fraction of that to first order.
    pub(crate) fn difference(&self) -> f64 {
        (self.simulated_rms_nm / self.first_order_rms_nm - 1.0).abs()
    }
}

/// Sentence for the user on the mean tool in the budget of a tool that varies.
pub const MEAN_TOOL: &str = "the tool varies over the part: every error acts on it as it is at its place, and the mean \
                             tool decides which wavelengths are reached";

/// Result of the tolerance analysis: the effect of a process on the residual.
#[derive(Clone, Debug, Serialize)]
pub struct Tolerance {
    /// Results that other stages read from the manifest.
    #[serde(flatten)]
    pub outcome: ToleranceOutcome,
    /// Simulated runs with all errors.
    pub runs: Vec<Pair>,
    /// Largest relative difference between the simulated RMS and that to first order, over these runs.
    pub largest_difference: f64,
    /// Number of simulated runs whose RMS lies in the 95 % interval of the distribution.
    pub within_interval: usize,
    /// Distribution of the RMS: pairs of a fraction of the runs and the RMS that this fraction does not exceed, nm.
    #[serde(skip)]
    pub levels: Vec<(f64, f64)>,
    /// Standard deviation of the residual over the runs at every pixel, nm; NaN where invalid.
    #[serde(skip)]
    pub deviation_nm: Array2<f64>,
    /// Coverage of the map by the plan.
    pub coverage: Coverage,
    /// Largest error of the TIF that errors change, as a fraction of its peak, if it was resampled on the pixels of the
    /// map; else 0.
    pub tif_resampling_error: f64,
    /// Sentence on the state in which an axis with play begins; absent if the budget has no play.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub backlash_start: Option<&'static str>,
    /// Sentence on the mean tool; absent if the tool is the same everywhere.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_tool: Option<&'static str>,
}
