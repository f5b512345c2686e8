//! The steps to the minimum of (1) of [`crate::bounded_least_squares`]. The exact H is too large to be solved
//! with, its surrogate H~ is not exact: so each step is found with H~ and corrected with the exact gradient.

use ndarray::Array2;
use planish_types::{End, progress};

use super::{
    descent::{Descent, Look, Target},
    prepared::BoundedProblem,
    settings::BoundedSettings,
};
use crate::DwellError;

/// Largest number of steps by the surrogate H~. Larger: problems that do not converge take longer. Smaller: slow
/// problems end without a certificate. Chosen: measured problems take 3 to 6.
const MAX_CORRECTIONS: usize = 100;

/// Easier problems that are solved before (1), one after the other, see [`BoundedProblem::approach`]: (factor on the
/// weights alpha and beta of (1), factor on the pitch of the splines). Chosen by the time that problems took: a third
/// easier problem, or smaller steps of the weights, cost as much time as they save.
const ROUGH_PROBLEMS: [(f64, f64); 2] = [(1e3, 2.0), (30.0, 1.5)];

/// Ratio of the side of the cells of an easier problem to that for (1). Larger: cheaper and less exact easier
/// problems.
const ROUGH_CELLS: usize = 2;

/// Largest alpha of an easier problem, dimensionless; a problem with a larger one is left out, because the penalty
/// would decide its whole result. Larger: useless easier problems cost time. Smaller: strongly regularised problems
/// start without easier ones.
const MAX_ROUGH_TIKHONOV: f64 = 1e-2;

/// Number of steps by the surrogate H~ for an easier problem. Larger: a better start of the next problem, for more
/// time.
const ROUGH_CORRECTIONS: usize = 1;

/// Number of steps by the surrogate H~ for an easier problem with a Huber loss, whose weights come with the second
/// step. Larger: more time. Smaller: the next problem starts without these weights.
const ROUGH_CORRECTIONS_HUBER: usize = 3;

/// Dwell times at the end of a descent, and how they were reached.
pub struct Iterate {
    pub t: Vec<f64>,
    /// Removal B t of the dwell times t (ny, nx), nm.
    pub removal_nm: Array2<f64>,
    /// Number of sets of free dwell times that were solved for with the factorised surrogate H~, plus that of products
    /// or gradient steps with the other one.
    pub iterations: usize,
    /// Number of steps found by H~, each corrected by the exact gradient.
    pub corrections: usize,
    /// Value of (1), nm^2 times the weights of the pixels.
    pub objective: f64,
    pub natural_residual: f64,
    pub relative_gap: Option<f64>,
    pub end: End,
}

impl BoundedProblem<'_> {
    /// Minimises the objective (1) with the smoothness beta = `slope_weight`, by steps of its surrogate:
    ///
    /// ```text
    /// repeat  q = gradient of (1) at t                                             exact
    ///         d = argmin q'd + d'H~d / 2,  lo <= t + d <= hi                       by H~
    ///         s = argmin of (1) over t + s d,  and s = 1 where that is above 0.6   exact
    ///         e = argmin of (1) over t + a d + b p,  then clipped to the bounds    exact
    ///         p = that of s d and e with the lower (1),   t += p
    /// ```
    ///
    /// p is the step before; without one, p = s d. A whole step (s = 1) puts the dwell times on the bounds on which the
    /// minimum of H~ has them. If the two-level method finds d, the next steps are found by [`Self::without_bounds`] as
    /// long as that helps; not with a Huber loss.
    ///
    /// d is a descent direction for every positive definite H~, and vanishes only at the minimum of (1). With the
    /// step before, p, this is the conjugate gradient method preconditioned by H~ as soon as the
    /// components at their bounds are settled. With a Huber loss every q has the weights v of (4) there, but the first,
    /// which has those of the map.
    pub(super) fn minimise(&mut self, slope_weight: f64) -> Result<Iterate, DwellError> {
        self.minimise_by(&BoundedSettings { slope_weight, ..*self.settings }, MAX_CORRECTIONS)
    }

    /// Solves the easier problems [`ROUGH_PROBLEMS`] to start the two-level method near the minimum, and returns the
    /// number of products with their surrogates. Larger weights of the penalty make the dwell times smoother, so that
    /// wider splines and larger cells can represent them. Fewer and cheaper steps then find which dwell times are at
    /// their bounds. Some percent of these change afterwards.
    ///
    /// Returns 0 and does nothing for other methods, or if the problem has a guess.
    pub(super) fn approach(&mut self, slope_weight: f64) -> Result<usize, DwellError> {
        let (cell, Some(pitch_mm)) = (self.cell, self.splines_mm) else { return Ok(0) };
        if self.is_guessed {
            return Ok(0);
        }
        let mut iterations = 0;
        for (k, (weight, splines)) in ROUGH_PROBLEMS.into_iter().enumerate() {
            let tikhonov = weight * self.settings.tikhonov;
            if tikhonov > MAX_ROUGH_TIKHONOV {
                continue;
            }
            let cells = (ROUGH_CELLS * cell, Some(splines * pitch_mm));
            let surrogate = self.convolved(cells)?;
            let fine = std::mem::replace(&mut self.surrogate, surrogate);
            let settings =
                BoundedSettings { tikhonov, slope_weight: weight * slope_weight, ..*self.settings };
            let corrections = match settings.huber_nm {
                Some(_) => ROUGH_CORRECTIONS_HUBER,
                None => ROUGH_CORRECTIONS,
            };
            let iterate = progress::part(k, 2 * ROUGH_PROBLEMS.len(), || {
                self.minimise_by(&settings, corrections)
            });
            self.surrogate = fine;
            let iterate = iterate?;
            iterations += iterate.iterations;
            self.start = iterate.t;
        }
        Ok(iterations)
    }

    /// Minimises the objective (1) as [`Self::minimise`] does, with the weights and limits of these settings, in at
    /// most `max_corrections` steps.
    fn minimise_by(
        &mut self,
        settings: &BoundedSettings,
        max_corrections: usize,
    ) -> Result<Iterate, DwellError> {
        let mut descent = Descent::new(self, settings);
        loop {
            descent.reweigh(self);
            let mut look = descent.look(self, max_corrections);
            if look.end.is_some() && descent.lacks_huber_weights() {
                descent.weigh_by_residual(self);
                look = descent.look(self, max_corrections);
            }
            let end = match look.end {
                Some(end) => end,
                None => match descent.target(self, &look)? {
                    Target::End(end) => end,
                    Target::To(to, free) => {
                        descent.advance(self, &look, (to, free));
                        continue;
                    }
                },
            };
            let Descent { t, removal_nm, iterations, corrections, .. } = descent;
            let Look { objective, natural_residual, relative_gap, .. } = look;
            return Ok(Iterate {
                t,
                removal_nm,
                iterations,
                corrections,
                objective,
                natural_residual,
                relative_gap,
                end,
            });
        }
    }
}
