//! Settings of the solver, and the inputs of a problem for every dwell point.

use std::ops::Range;

use planish_types::{Invalid, SetupErrors, Tif, ToolPath};
use serde::Serialize;

use crate::{
    bounds::Bound,
    model::columns::{Columns, ToolPlace},
    objective::{Free, PenaltyWeights},
    residual_slope::ResidualSlope,
};

/// Settings of the bounded least squares.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BoundedSettings {
    /// Columns of the removal model: the tool stands at the dwell point, or moves along the segment.
    pub columns: Columns,
    /// Lower bound of every dwell time.
    pub min_dwell: Bound,
    /// Upper bound of every dwell time; none if absent.
    pub max_dwell: Option<Bound>,
    /// Weight alpha of the squared dwell time per area above its lower bound, dimensionless; >= 0.
    pub tikhonov: f64,
    /// Weight beta of the squared slope of the dwell time per area along the path, dimensionless; >= 0.
    pub slope_weight: f64,
    /// Weight of one second of the total time in half the mean square of the residual, nm^2/s; >= 0.
    pub time_weight_nm2_per_s: f64,
    /// Low-order terms of the map that need not be removed.
    pub free: Free,
    /// Residual above which a pixel counts linearly instead of squared (Huber loss), nm; for maps with pits. All pixels
    /// count squared if absent.
    pub huber_nm: Option<f64>,
    /// RMS of the noise of the map, nm: if the residual is smaller, the smoothness beta is raised until it is about as
    /// large. With a Huber loss, pixels beyond its threshold do not count in this comparison. No search if absent.
    pub noise_rms_nm: Option<f64>,
    /// Weight of the squared slope of the residual, and its base length; no such term if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub residual_slope: Option<ResidualSlope>,
    /// Largest number of dwell points up to which the surrogate of H is always factorised. Problems with up to ten
    /// times as many are factorised if the splines of the two-level method suit them badly.
    pub max_factorised_points: usize,
    /// Natural residual at which the solver ends, s, if alpha is 0 and nothing can be proven. Otherwise `relative_gap`
    /// decides, and a natural residual below this only makes steps that change nothing any more count as optimal.
    pub tolerance_s: f64,
    /// Proven distance of the objective (1) from its minimum, relative to the objective, at which the solver ends.
    pub relative_gap: f64,
    /// Largest number of products with the surrogate of H, or of gradient steps, if it is not factorised.
    pub max_iterations: usize,
}

impl Default for BoundedSettings {
    fn default() -> Self {
        Self {
            columns: Columns::Segment,
            min_dwell: Bound::Seconds(0.0),
            max_dwell: None,
            // Flat optima of the executed residual, as measured on a mirror with 36 dwell points in the area of the
            // TIF: 1e-5 / 36 and 1e-2 / 36^2.
            tikhonov: 2.78e-7,
            slope_weight: 7.72e-6,
            time_weight_nm2_per_s: 0.0,
            free: Free::Piston,
            huber_nm: None,
            noise_rms_nm: None,
            residual_slope: None,
            max_factorised_points: 6000,
            tolerance_s: 1e-6,
            // RMS within 5e-5 of the least.
            relative_gap: 1e-4,
            max_iterations: 10_000,
        }
    }
}

impl BoundedSettings {
    /// Refuses weights, thresholds and noise levels that are not in their range.
    pub(super) fn check(&self) -> Result<(), Invalid> {
        let weights = [
            ("tikhonov", self.tikhonov),
            ("slope_weight", self.slope_weight),
            ("time_weight_nm2_per_s", self.time_weight_nm2_per_s),
        ];
        for (name, value) in weights {
            if !(value.is_finite() && value >= 0.0) {
                return Err(Invalid::whole(name, format!("is {value}"), "give a number >= 0"));
            }
        }
        for (name, value) in [("huber_nm", self.huber_nm), ("noise_rms_nm", self.noise_rms_nm)] {
            if let Some(value) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
                return Err(Invalid::whole(name, format!("is {value}"), "give a number > 0"));
            }
        }
        self.residual_slope.iter().try_for_each(ResidualSlope::check)
    }

    /// Returns the weights of the terms of the objective other than the residual.
    pub(super) fn penalty_weights(&self) -> PenaltyWeights {
        PenaltyWeights {
            tikhonov: self.tikhonov,
            slope_weight: self.slope_weight,
            time_weight_nm2_per_s: self.time_weight_nm2_per_s,
        }
    }
}

/// Function that multiplies a vector by a symmetric positive semidefinite matrix Q (n, n): from t (n) to Q t (n).
pub type Product<'a> = &'a (dyn Fn(&[f64]) -> Vec<f64> + Sync);

/// Input of one problem: the columns of the removal matrix B, and the bounds of their dwell times.
#[derive(Clone)]
pub struct Program<'a> {
    /// Places of the tool in each of the n columns: positions with their fractions of the dwell time.
    pub places: &'a [Vec<ToolPlace>],
    /// Lower bounds (n), s.
    pub lo: Vec<f64>,
    /// Upper bounds (n), s.
    pub hi: Vec<f64>,
    /// Dwell times of a similar problem (n), s: a first guess, which only saves time.
    pub guess: Option<Vec<f64>>,
    /// Matrix Q of a further term `t'Q t / 2` of the objective, nm^2/s^2; no such term if absent.
    pub quadratic: Option<Product<'a>>,
}

/// One tool of a problem: the columns of B that are its own, and the price of its time.
#[derive(Clone)]
pub struct ToolColumns<'a> {
    /// Name of the tool, for messages; empty if the problem has one tool.
    pub name: &'a str,
    /// TIF of the tool, on the lattice of the map.
    pub tif: &'a Tif,
    pub path: &'a ToolPath,
    /// Range of its columns in B, one for every dwell point of its path.
    pub columns: Range<usize>,
    /// Weight of one second of this tool in half the mean square of the residual, nm^2/s.
    pub time_weight_nm2_per_s: f64,
}

/// One tool of a problem of several.
#[derive(Clone, Copy, Debug)]
pub struct ToolTask<'a> {
    /// Name of the tool, different from those of the others.
    pub name: &'a str,
    /// Removal rate; it may vary over the part, but not with the time of the run.
    pub tif: &'a Tif,
    /// Path along which it dwells.
    pub path: &'a ToolPath,
    /// Lower bound of every dwell time of this tool.
    pub min_dwell: Bound,
    /// Upper bound of every dwell time of this tool; none if absent.
    pub max_dwell: Option<Bound>,
    /// Price of a second of this tool: its weight in half the mean square of the residual, nm^2/s; >= 0.
    pub time_weight_nm2_per_s: f64,
    /// Errors with which it is set up; none of them counts if all are 0.
    pub setup: SetupErrors,
}
