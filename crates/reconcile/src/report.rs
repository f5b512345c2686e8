//! Report of a reconciliation, for the manifest.

use serde::Serialize;

use crate::{bands::Band, correlation::Noise};

/// One unknown.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// Its name.
    pub name: String,
    /// Its unit: that of the error budget, or nm RMS.
    pub unit: &'static str,
    /// Estimate; `null` where it is refused or held.
    pub value: Option<f64>,
    /// Standard error; `null` where it is held, or the removal does not depend on it.
    pub standard_error: Option<f64>,
    /// Scale that is known beforehand, in the same unit; `null` for terms of the metrology, of which nothing is
    /// known.
    pub known_beforehand: Option<f64>,
    /// Factor by which the other unknowns enlarge its variance.
    pub variance_inflation: Option<f64>,
    /// Reason why the data do not determine it.
    pub refused: Option<String>,
    /// True if the settings hold it at its value in the plan.
    pub held: bool,
    /// The reason for which the fit itself held it at the plan, where it did. `value` and `standard_error` are then those
    /// with it free, and those of the other parameters are those with it held.
    pub held_because: Option<String>,
    /// Correction that the written tool and transform contain: the part of the estimate that lowers the expected residual
    /// of the next run; 0 where they keep the value of the plan.
    pub applied: f64,
}

/// Magnitude and direction of the TIF's ellipticity, from its two components.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Ellipse {
    /// Difference of the lengths along and across, over their mean, %.
    pub ellipticity_percent: f64,
    /// Its standard error, %.
    pub standard_error_percent: f64,
    /// Direction of the longer axis from x towards y, degrees; `null` where the ellipticity is within two standard
    /// errors of none, which has no direction.
    pub direction_deg: Option<f64>,
    /// Its standard error, degrees.
    pub direction_standard_error_deg: Option<f64>,
}

/// RMS values, nm, with the terms of the metrology removed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Fitted {
    /// RMS of the measured removal.
    pub measured_removal_rms_nm: f64,
    /// RMS of the measured removal less the planned one.
    pub measured_less_planned_rms_nm: f64,
    /// RMS of the rest, after the fit of all unknowns.
    pub rest_rms_nm: f64,
}

/// Numbers on which the judgement of the map after rests.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Evidence {
    /// Part of the planned removal that lies between the maps, 1 expected; `null` where the plan removes no shape.
    pub removal_factor: Option<f64>,
    /// Its standard error.
    pub removal_factor_standard_error: Option<f64>,
    /// RMS of the part of the maps that the fit cannot explain and both have, nm; negative if they have it with opposite
    /// signs.
    pub common_rms_nm: f64,
    /// The common part over its standard error if the maps have nothing in common; 4 are needed.
    pub common_standard_errors: f64,
    /// Bounds of the scale of the map after; `null` where the maps have nothing in common.
    pub scale: Option<[f64; 2]>,
    /// Noise from pixel to pixel of the map after over that of the map before; `null` where it is not told from the
    /// figure.
    pub noise_ratio: Option<f64>,
}

/// All of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// Machine and tool.
    pub parameters: Vec<Estimate>,
    /// Low-order terms of the metrology.
    pub metrology: Vec<Estimate>,
    /// The TIF's ellipticity, where both components are determined.
    pub ellipse: Option<Ellipse>,
    /// Names of the rows and columns of the correlation matrix.
    pub correlation_of: Vec<String>,
    /// Singular values of the derivatives, columns of length one.
    pub singular_values: Vec<f64>,
    /// The noise.
    pub noise: Noise,
    /// RMS values.
    pub fitted: Fitted,
    /// Predicted against measured.
    pub bands: Vec<Band>,
    /// End of the fit.
    pub end: String,
    /// Points at which derivatives were computed.
    pub points: usize,
    /// Orders of the Legendre terms by which the dependence on the metrology was tried.
    pub tried_orders: [usize; 2],
    /// True if the removal is that of the TIF as it is sampled; false if that of the smoothed TIF fits better.
    pub tif_is_as_sampled: bool,
    /// True if the removal is that of the TIF with a tail beyond its samples, because that fits better.
    pub tif_is_continued: bool,
    /// Method by which the map after was taken to the pixels of the map before, where they differ.
    pub resampled: Option<&'static str>,
    /// Numbers on whether the map after is that of the run.
    pub evidence: Evidence,
    /// The sentence against the map after, where there is one: nothing of the fit is then applied.
    pub explains_nothing: Option<String>,
}
