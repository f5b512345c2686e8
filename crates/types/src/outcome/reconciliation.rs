//! Outcome of `planish reconcile`: what a run did, found from the maps before and after it.

use serde::{Deserialize, Serialize};

/// One unknown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Its name.
    pub name: String,
    /// Its unit: that of the error budget, or nm RMS.
    pub unit: String,
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
    #[serde(default)]
    pub held: bool,
    /// The reason for which the fit itself held it at the plan, where it did. `value` and `standard_error` are then those
    /// with it free, and those of the other parameters are those with it held.
    pub held_because: Option<String>,
    /// Correction that the written tool and transform contain: the part of the estimate that lowers the expected residual
    /// of the next run; 0 where they keep the value of the plan.
    #[serde(default, deserialize_with = "super::null_is_nan")]
    pub applied: f64,
}

/// Magnitude and direction of the TIF's ellipticity, from its two components.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Ellipse {
    /// Difference of the lengths along and across, over their mean, %.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub ellipticity_percent: f64,
    /// Its standard error, %.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub standard_error_percent: f64,
    /// Direction of the longer axis from x towards y, degrees; `null` where the ellipticity is within two standard
    /// errors of none, which has no direction.
    pub direction_deg: Option<f64>,
    /// Its standard error, degrees.
    pub direction_standard_error_deg: Option<f64>,
}

/// RMS values, nm, with the terms of the metrology removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Fitted {
    /// RMS of the measured removal.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub measured_removal_rms_nm: f64,
    /// RMS of the measured removal less the planned one.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub measured_less_planned_rms_nm: f64,
    /// RMS of the rest, after the fit of all unknowns.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub rest_rms_nm: f64,
}

/// Numbers on which the judgement of the map after rests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Evidence {
    /// Part of the planned removal that lies between the maps, 1 expected; `null` where the plan removes no shape.
    pub removal_factor: Option<f64>,
    /// Its standard error.
    pub removal_factor_standard_error: Option<f64>,
    /// RMS of the part of the maps that the fit cannot explain and both have, nm; negative if they have it with opposite
    /// signs.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub common_rms_nm: f64,
    /// The common part over its standard error if the maps have nothing in common; 4 are needed.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub common_standard_errors: f64,
    /// Bounds of the scale of the map after; `null` where the maps have nothing in common.
    pub scale: Option<[f64; 2]>,
    /// Noise from pixel to pixel of the map after over that of the map before; `null` where it is not told from the
    /// figure.
    pub noise_ratio: Option<f64>,
}

/// Outcome of `planish reconcile`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ReconciliationOutcome {
    /// Machine and tool.
    pub parameters: Vec<Estimate>,
    /// Low-order terms of the metrology.
    #[serde(default)]
    pub metrology: Vec<Estimate>,
    /// The TIF's ellipticity, where both components are determined.
    pub ellipse: Option<Ellipse>,
    /// Names of the rows and columns of the correlation matrix.
    #[serde(default)]
    pub correlation_of: Vec<String>,
    /// Singular values of the derivatives, columns of length one.
    #[serde(default)]
    pub singular_values: Vec<f64>,
    /// The noise.
    #[serde(default)]
    pub noise: Noise,
    /// RMS values.
    #[serde(default)]
    pub fitted: Fitted,
    /// Predicted against measured.
    #[serde(default)]
    pub bands: Vec<Band>,
    /// End of the fit.
    #[serde(default)]
    pub end: String,
    /// Points at which derivatives were computed.
    #[serde(default)]
    pub points: usize,
    /// Orders of the Legendre terms by which the dependence on the metrology was tried.
    #[serde(default)]
    pub tried_orders: [usize; 2],
    /// True if the removal is that of the TIF as it is sampled; false if that of the smoothed TIF fits better.
    #[serde(default)]
    pub tif_is_as_sampled: bool,
    /// True if the removal is that of the TIF with a tail beyond its samples, because that fits better.
    #[serde(default)]
    pub tif_is_continued: bool,
    /// Method by which the map after was taken to the pixels of the map before, where they differ.
    pub resampled: Option<String>,
    /// Numbers on whether the map after is that of the run.
    #[serde(default)]
    pub evidence: Evidence,
    /// The sentence against the map after, where there is one: nothing of the fit is then applied.
    pub explains_nothing: Option<String>,
}

/// Numbers of the noise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Noise {
    /// RMS of what the fit leaves, nm.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub rest_rms_nm: f64,
    /// l, mm.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub correlation_length_mm: f64,
    /// L, mm.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub window_mm: f64,
    /// True if the correlation goes on beyond the largest window: standard errors are then too small.
    pub window_is_cut: bool,
    /// Valid pixels.
    pub pixels: usize,
    /// Number of independent pixels that would give the same variance of a mean.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub effective_pixels: f64,
    /// Part of the noise's spectrum at zero frequency that the fit took; made up for.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub lost_to_the_fit: f64,
}

/// One band.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Band {
    /// Shortest and longest period, mm; `null` without a longest.
    pub period_mm: [Option<f64>; 2],
    /// RMS of the measured removal without the terms of the metrology, nm.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub measured_rms_nm: f64,
    /// RMS of the removal that the plan promised, nm.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub planned_rms_nm: f64,
    /// RMS of the removal with what was learnt, nm.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub predicted_rms_nm: f64,
    /// RMS of the difference of the measured removal and the plan's, nm.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub measured_less_planned_rms_nm: f64,
    /// RMS of the rest, nm.
    #[serde(deserialize_with = "super::null_is_nan")]
    pub rest_rms_nm: f64,
    /// Coefficient of the predicted removal in the measured one; `null` where there is no predicted one.
    pub transfer: Option<f64>,
}
