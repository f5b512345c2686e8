//! Least squares with a floor, by the active set method of Lawson and Hanson.
//!
//! ```text
//! min over s >= 0:  1/2 || P W^1/2 (B s - z') ||^2 + 1/2 alpha K A sum_j s_j^2 / a_j,
//! t = lo + s,  z' = z - B lo                                                               (1)
//! ```
//!
//! P subtracts the piston, and K is the largest diagonal element of `B' W P B`. A is the effective area of the TIF (at
//! least that of 36 dwell points), and `a_j` the area of dwell point j. It has the same minimum as
//! [`crate::bounded_least_squares`] without an upper bound and without smoothness. Its method
//! ([`planish_numerics::qp::nnls`]) shares nothing with that solver: it is a check of it, and serves for comparison
//! with the literature. One dwell time changes its set at a time, so it is slow: minutes for thousands of points.
//!
//! Source: C. L. Lawson, R. J. Hanson, Solving Least Squares Problems (1974), chapter 23.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `desired` | (ny, nx) | nm |
//! | t, lo | `dwell_s`, `min_dwell` | (n) | s |

use planish_numerics::qp::nnls::nnls;
use planish_types::{End, progress};
use serde::Serialize;

use crate::{
    DwellError,
    model::operator::normal_matrix,
    objective::{Penalty, PenaltyScale, PenaltyWeights},
    problem::{DwellModel, Problem, Solution, check},
};

/// Settings of the non-negative least squares.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct NonNegativeSettings {
    /// Weight alpha of the Tikhonov term, dimensionless; >= 0.
    pub tikhonov: f64,
    /// Largest gradient component at which the solver ends, as a fraction of the largest one if all dwell times are at
    /// their floor.
    pub tolerance: f64,
    /// Largest number of changes per dwell point; a change frees a dwell time or puts it back on its floor.
    pub max_changes_per_point: usize,
}

impl Default for NonNegativeSettings {
    fn default() -> Self {
        // With points as dense as ten in a width of the TIF, `alpha A / a_j` is at the rounding of the single
        // precision in which maps are measured; below, the columns of neighbours cannot be told apart.
        Self { tikhonov: 3e-9, tolerance: 1e-12, max_changes_per_point: 10 }
    }
}

/// Report of the non-negative least squares.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct NonNegativeReport {
    /// Reason for the end: `optimal` or `iteration-limit`.
    pub end: End,
    /// Number of changes: dwell times freed, or put back on their floor.
    pub iterations: usize,
    /// Largest change of a dwell time in a projected gradient step, s; 0 at the optimum.
    pub kkt_residual_s: f64,
}

impl NonNegativeReport {
    /// Returns the reason of a negative verdict; none if the solver converged.
    pub fn negative(&self) -> Option<String> {
        if self.end == End::Optimal {
            return None;
        }
        Some(format!(
            "not converged after {} changes: a dwell time would still move by {:.1e} s",
            self.iterations, self.kkt_residual_s
        ))
    }
}

/// Finds the dwell times that minimise (1) of the module.
///
/// # Errors
/// Refuses an alpha that is negative or not finite, and more than 6000 dwell points or 2.5e8 elements of B. Every
/// solver refuses weights and floors out of range, a floor that alone removes more than the PV of the map, a TIF that
/// varies in time, and a tool that does not reach the map.
pub fn solve(
    problem: &Problem<'_>,
    settings: &NonNegativeSettings,
) -> Result<Solution<NonNegativeReport>, DwellError> {
    check("tikhonov", settings.tikhonov, |a| a >= 0.0, "give a number >= 0")?;
    let model = DwellModel::new(problem)?;
    let n = problem.path.len();
    let mut h = normal_matrix(&model.places, &model.tif, problem.desired.grid(), &model.weight)?;
    let strongest = (0..n).map(|j| h[[j, j]]).fold(0.0, f64::max);
    let scale = PenaltyScale::new(
        problem.path,
        &model.tif,
        strongest,
        model.weight.sum(),
        &model.sensitivity,
    );
    let weights = PenaltyWeights {
        tikhonov: settings.tikhonov,
        slope_weight: 0.0,
        time_weight_nm2_per_s: 0.0,
    };
    let penalty = Penalty::new(problem.path, &model.lo, &scale, &weights);
    for (j, alpha) in penalty.alpha().iter().enumerate() {
        // A column that does not reach the map takes no part.
        h[[j, j]] = if model.reached(j) { h[[j, j]] + alpha } else { 0.0 };
    }
    let g = model.gradient(&model.target());
    let most = settings.max_changes_per_point * n;
    let solution = nnls(&h, &g, settings.tolerance, most, progress::of_excess());
    let report = NonNegativeReport {
        end: if solution.converged { End::Optimal } else { End::IterationLimit },
        iterations: solution.iterations,
        kkt_residual_s: solution.violation,
    };
    let dwell_s = model.lo.iter().zip(&solution.value).map(|(lo, s)| lo + s).collect();
    model.finish(dwell_s, report)
}
