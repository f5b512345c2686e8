//! Least squares in the space of the large singular values, without bounds.
//!
//! ```text
//! t = t_ref + sum over sigma_i > cut sigma_1 of  v_i (u_i' P W^1/2 (z - B t_ref)) / sigma_i   (1)
//! ```
//!
//! where `u_i, sigma_i, v_i` are the singular vectors and values of `P W^1/2 B`, P subtracts the free piston, and t_ref
//! are reference dwell times ([`crate::problem`]). A TIF is smooth: beyond a few hundred singular values, the part of
//! the map that the vectors could correct is below the noise, and needs absurd dwell times.
//!
//! The sum is computed by the process of Lanczos on the normal equations ([`planish_numerics::linear::lanczos`]), which
//! needs products only. Up to 6000 dwell points they use the normal matrix, if B is small enough.
//!
//! Source: P. C. Hansen, Rank-Deficient and Discrete Ill-Posed Problems (1998), section 3.2.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `desired` | (ny, nx) | nm |
//! | t | `dwell_s` | (n) | s |

use ndarray::ArrayView1;
use planish_numerics::linear::lanczos::{Truncated, truncated};
use planish_types::{End, Invalid, budget, progress};
use serde::Serialize;

use crate::{
    DwellError,
    model::operator::{MAX_MATRIX_POINTS, normal_matrix},
    problem::{DwellModel, Problem, Solution, check},
};

/// Settings of the truncated singular value decomposition.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TruncatedSvdSettings {
    /// Singular values up to this fraction of the largest one are left out; between 0 and 1.
    pub cut: f64,
    /// Relative change of the dwell times at which the Lanczos process ends.
    pub tolerance: f64,
    /// Largest number of steps of the Lanczos process; each keeps a vector of n numbers. Fewer are done if the memory
    /// is too small for them.
    pub max_iterations: usize,
}

impl Default for TruncatedSvdSettings {
    fn default() -> Self {
        Self { cut: 1e-2, tolerance: 1e-3, max_iterations: 2000 }
    }
}

/// Report of the truncated singular value decomposition.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TruncatedSvdReport {
    /// Reason for the end: `converged` or `step-limit`.
    pub end: End,
    /// Number of steps of the Lanczos process.
    pub steps: usize,
    /// Number of singular values that were kept, as far as the map contains their vectors.
    pub rank: usize,
    /// Largest singular value, nm/s.
    pub largest_singular_value_nm_per_s: f64,
    /// Smallest singular value that was kept, nm/s; infinite if none was.
    pub smallest_singular_value_nm_per_s: f64,
    /// Level of dwell c, s: the reference dwell time of a segment of median length, the least that meets the floor ((3)
    /// of [`crate::problem`]).
    pub level_s: f64,
    /// Number of dwell times that are still below their floor at this level; they are set to it.
    pub clipped: usize,
}

impl TruncatedSvdReport {
    /// Returns the reason of a negative verdict; none if the solver converged.
    pub fn negative(&self) -> Option<String> {
        if self.end == End::Converged {
            return None;
        }
        Some(format!("not converged after {} steps; raise `max_iterations`", self.steps))
    }
}

/// Computes the dwell times (1) of the module.
///
/// # Errors
/// Refuses a cut that is not between 0 and 1, and a `max_iterations` of 0. Every solver refuses weights and floors out
/// of range, a floor that alone removes more than the PV of the map, a TIF that varies in time, and a tool that does
/// not reach the map.
pub fn solve(
    problem: &Problem<'_>,
    settings: &TruncatedSvdSettings,
) -> Result<Solution<TruncatedSvdReport>, DwellError> {
    check("cut", settings.cut, |c| c > 0.0 && c < 1.0, "give a number between 0 and 1")?;
    if settings.max_iterations == 0 {
        return Err(Invalid::whole("max_iterations", "is 0", "give at least 1").into());
    }
    let model = DwellModel::new(problem)?;
    // Every step keeps a vector of n: as many as fit into memory.
    let fit = budget::memory_bytes() / (size_of::<f64>() * problem.path.len()) as u64;
    let max_steps = settings.max_iterations.min(usize::try_from(fit).unwrap_or(usize::MAX).max(1));
    let matrix = if problem.path.len() <= MAX_MATRIX_POINTS {
        normal_matrix(&model.places, &model.tif, problem.desired.grid(), &model.weight).ok()
    } else {
        None
    };
    let apply = |t: &[f64]| match &matrix {
        Some(h) => h.dot(&ArrayView1::from(t)).to_vec(),
        None => model.gradient(&model.operator.apply(t)),
    };
    let run = |g: &[f64]| -> Truncated {
        // The eigenvalues of the normal equations are squares.
        let watch = progress::of_excess();
        truncated(apply, g, settings.cut.powi(2), settings.tolerance, max_steps, watch)
    };
    let solution = progress::part(0, 2, || run(&model.gradient(problem.desired.height_nm())));
    let level: Vec<f64> = apply(&model.shape).iter().map(|v| -v).collect();
    let answer = progress::part(1, 2, || run(&level));
    let b: Vec<f64> = model.shape.iter().zip(&answer.value).map(|(s, u)| s + u).collect();
    let levelled = model.levelled(&solution.value, &b);
    let report = TruncatedSvdReport {
        end: if solution.converged && answer.converged { End::Converged } else { End::StepLimit },
        steps: solution.steps.max(answer.steps),
        rank: solution.rank,
        largest_singular_value_nm_per_s: solution.largest.sqrt(),
        smallest_singular_value_nm_per_s: solution.smallest.sqrt(),
        level_s: levelled.level_s,
        clipped: levelled.clipped,
    };
    model.finish(levelled.dwell_s, report)
}
