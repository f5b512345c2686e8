//! Report: the lines of the errors, the distribution, and the simulated runs.

use ndarray::Array2;
use planish_simulate::coverage::Coverage;
use planish_types::outcome::tolerance::ToleranceOutcome;
use serde::Serialize;

/// Number of levels at which the distribution is stored. Larger: larger files. Smaller: coarser curves.
pub const LEVELS: usize = 201;

/// A run with all errors, simulated, and as the first order has it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Pair {
    /// RMS of the simulated run, nm.
    pub simulated_rms_nm: f64,
    /// RMS to first order, nm.
    pub first_order_rms_nm: f64,
}

impl Pair {
    /// Returns the relative difference of the two RMS.
    pub(crate) fn difference(&self) -> f64 {
        (self.simulated_rms_nm / self.first_order_rms_nm - 1.0).abs()
    }
}

/// Sentence on what the mean tool decides in the budget of a tool that varies.
pub const MEAN_TOOL: &str = "the tool varies over the part: every error acts on it as it is at its place, and the mean \
                             tool decides which wavelengths are reached";

/// Effect of the process on the residual.
#[derive(Clone, Debug, Serialize)]
pub struct Tolerance {
    /// Numbers that other stages read.
    #[serde(flatten)]
    pub outcome: ToleranceOutcome,
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
