//! Settings of the solver, and those inputs that may be given point by point.

use serde::Serialize;

use crate::{
    bounds::Bound,
    model::columns::{Columns, ToolPlace},
    objective::{Free, PenaltyWeights},
    residual_slope::ResidualSlope,
};

/// Settings of the solver.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BoundedSettings {
    /// Columns of the removal model: the tool stands at the dwell point, or moves along the segment.
    pub columns: Columns,
    /// Lower bound.
    pub min_dwell: Bound,
    /// Upper bound; none when absent.
    pub max_dwell: Option<Bound>,
    /// alpha: weight of the dwell time per area above its lower bound; >= 0.
    pub tikhonov: f64,
    /// beta: weight of the slope of the dwell time per area along the path; >= 0.
    pub slope_weight: f64,
    /// Weight of the total time beside half the mean square of the residual, nm^2/s; >= 0.
    pub time_weight_nm2_per_s: f64,
    /// Low-order terms of the map that need not be removed.
    pub free: Free,
    /// Residual above which a pixel counts linearly instead of squared (Huber loss), nm; for maps with pits.
    pub huber_nm: Option<f64>,
    /// RMS of the noise of the map, nm: beta is raised until the residual is no smaller; with a Huber loss pixels
    /// beyond its threshold do not count there.
    pub noise_rms_nm: Option<f64>,
    /// Weight of the slope of the residual beside its height; none when absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub residual_slope: Option<ResidualSlope>,
    /// Dwell points up to which the surrogate of H is factorised.
    pub max_factorised_points: usize,
    /// Natural residual that is enough, s.
    pub tolerance_s: f64,
    /// Bound on how far (1) is above its minimum, relative to it, that is enough.
    pub relative_gap: f64,
    /// Largest number of products with the surrogate of H if it is not factorised.
    pub max_iterations: usize,
}

impl Default for BoundedSettings {
    fn default() -> Self {
        Self {
            columns: Columns::Segment,
            min_dwell: Bound::Seconds(0.0),
            max_dwell: None,
            // Flat optima of the executed residual, as measured on a mirror with 36 dwell points in the area of the TIF:
            // 1e-5 / 36 and 1e-2 / 36^2.
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
    /// Returns the weights of the terms beside the residual.
    pub(super) fn penalty_weights(&self) -> PenaltyWeights {
        PenaltyWeights {
            tikhonov: self.tikhonov,
            slope_weight: self.slope_weight,
            time_weight_nm2_per_s: self.time_weight_nm2_per_s,
        }
    }
}

/// A product with a symmetric positive semidefinite matrix (n, n): from t (n) to Q t (n).
pub type Product<'a> = &'a (dyn Fn(&[f64]) -> Vec<f64> + Sync);

/// The columns of B and the bounds of their dwell times.
#[derive(Clone)]
pub struct Program<'a> {
    /// Places of the tool in each column (n).
    pub places: &'a [Vec<ToolPlace>],
    /// Lower bounds (n), s.
    pub lo: Vec<f64>,
    /// Upper bounds (n), s.
    pub hi: Vec<f64>,
    /// Dwell times of a similar problem (n), s: a first guess, which only saves time.
    pub guess: Option<Vec<f64>>,
    /// Q of a further term `t'Q t / 2` of the objective, nm^2/s^2; none when absent.
    pub quadratic: Option<Product<'a>>,
}
