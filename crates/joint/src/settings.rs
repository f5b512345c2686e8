//! Settings of a joint plan.

use planish_dwell::residual::Free;
use planish_types::Invalid;
use serde::Serialize;

use crate::merit::Price;

/// Largest Tikhonov weight that is chosen automatically, dimensionless. Larger: the pull to the least densities
/// distorts plans. Smaller: more plans whose weight has to be lowered. Chosen: on rasters of the fixtures the pull is
/// below [`MOST_PULL`] with it.
pub const FIRST_TIKHONOV: f64 = 1e-5;

/// Smallest Tikhonov weight that is chosen automatically, dimensionless. Larger: more of the pull stays in the
/// objective. Smaller: the factors of the normal matrix, in single precision, are not positive definite.
pub const LEAST_TIKHONOV: f64 = 1e-10;

/// Largest part of the objective that the pull to the least densities may have, if its weight is chosen automatically.
/// Larger: the pull costs more of the residual than a plan may miss. Smaller: weights at which rounding decides.
/// Chosen: ten times `relative_gap`.
pub const MOST_PULL: f64 = 0.01;

/// Settings of a joint plan.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct JointSettings {
    /// Least dwell-time density (inverse of a largest feedrate), s/mm; >= 0. The limits of the machine apply in
    /// addition.
    pub min_dwell_s_per_mm: f64,
    /// Price of time in the objective: fixed, or by an elasticity.
    pub price: Price,
    /// Tikhonov weight (alpha) of the squared distance to the least densities, dimensionless; > 0. If absent, 1e-5, and
    /// less where this pull would be more than 1 % of the objective.
    pub tikhonov: Option<f64>,
    /// Weight (beta) of the squared differences of neighbouring densities, dimensionless; >= 0.
    pub difference_weight: f64,
    /// Low-order terms of the surface error that need not be removed, such as the piston.
    pub free: Free,
    /// Largest distance of the curve from a corner of the path, mm; if absent, a fifth of the TIF's width.
    pub corner_deviation_mm: Option<f64>,
    /// Largest radius to which corners are rounded, mm; if absent, the TIF's width.
    pub corner_radius_mm: Option<f64>,
    /// Largest distance of neighbouring nodes of the density, mm. If absent, 0.6 of the TIF's width, more where the
    /// solver would take too long, and less where it has little work.
    pub node_spacing_mm: Option<f64>,
    /// Number of refinements of the mesh: each adds nodes where they lower the objective most. If no spacing is given,
    /// the plan makes only as many as the solver can afford.
    pub refinements: usize,
    /// Proven excess of the objective over its least value, relative to the objective, at which the solver ends.
    pub relative_gap: f64,
    /// Largest number of steps of the solver.
    pub max_iterations: usize,
}

impl Default for JointSettings {
    fn default() -> Self {
        Self {
            min_dwell_s_per_mm: 0.0,
            price: Price::Elasticity(0.5),
            tikhonov: None,
            difference_weight: 0.0,
            free: Free::Piston,
            corner_deviation_mm: None,
            corner_radius_mm: None,
            node_spacing_mm: None,
            refinements: 3,
            relative_gap: 1e-3,
            max_iterations: 600,
        }
    }
}

/// Largest number of refinements. Larger: nodes that stand closer than any machine resolves. Smaller: settings that
/// make sense are refused. Derived: ten halvings make a thousandth of the distance of two nodes.
const MOST_REFINEMENTS: usize = 10;

impl JointSettings {
    /// Checks that every number is in its range.
    ///
    /// # Errors
    ///
    /// Refuses a number that is not finite or is out of its range, and too many refinements.
    pub fn check(&self) -> Result<(), Invalid> {
        let (price_name, price) = match self.price {
            Price::Nm2PerS(price) => ("time_weight_nm2_per_s", price),
            Price::Elasticity(x) => ("time_elasticity", x),
        };
        let not_negative = [
            ("min_dwell_s_per_mm", self.min_dwell_s_per_mm),
            (price_name, price),
            ("difference_weight", self.difference_weight),
        ];
        for (name, v) in not_negative {
            if !(v.is_finite() && v >= 0.0) {
                return Err(Invalid::whole(name, format!("is {v}"), "give a finite number >= 0"));
            }
        }
        let positive = [
            ("tikhonov", self.tikhonov),
            ("relative_gap", Some(self.relative_gap)),
            ("corner_deviation_mm", self.corner_deviation_mm),
            ("corner_radius_mm", self.corner_radius_mm),
            ("node_spacing_mm", self.node_spacing_mm),
        ];
        for (name, v) in positive {
            if let Some(v) = v.filter(|v| !(v.is_finite() && *v > 0.0)) {
                return Err(Invalid::whole(
                    name,
                    format!("is {v}"),
                    "give a finite number above 0",
                ));
            }
        }
        if self.refinements > MOST_REFINEMENTS {
            let problem = format!("is {}", self.refinements);
            let remedy = format!(
                "give at most {MOST_REFINEMENTS}: each may halve the distance of two nodes"
            );
            return Err(Invalid::whole("refinements", problem, remedy));
        }
        Ok(())
    }
}
