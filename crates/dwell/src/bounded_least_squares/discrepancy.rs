//! Morozov's discrepancy principle: the noise of the map chooses the smoothness.
//!
//! A residual smaller than the noise of the measurement means that dwell times were spent on the noise. Source:
//! V. A. Morozov, Soviet Math. Dokl. 7 (1966) 414.

use ndarray::Zip;

use super::{minimise::Iterate, prepared::BoundedProblem, report::BoundedSolution};
use crate::{DwellError, objective::Basis};

/// Range of the smoothness that the noise level chooses from.
const MIN_SMOOTHNESS: f64 = 1e-9;
const MAX_SMOOTHNESS: f64 = 1e3;

/// Factor between two trials of the smoothness while none is too smooth.
const SMOOTHNESS_FACTOR: f64 = 10.0;

/// Ratio of two trials, one too smooth and one not, that are near enough to each other.
const SMOOTHNESS_RATIO: f64 = 1.05;

/// The minimum, at the given smoothness or at the one that the noise of the map asks for.
pub fn solve(mut problem: BoundedProblem<'_>) -> Result<BoundedSolution, DwellError> {
    let given = problem.settings.smoothness;
    let approach = problem.approach(given)?;
    let mut first = problem.minimise(given)?;
    first.iterations += approach;
    let (smoothness, iterate) = match problem.settings.noise_rms_nm {
        Some(noise) if problem.rms_nm(&first) < noise => problem.stop_at(noise, first)?,
        _ => (given, first),
    };
    Ok(problem.finish(iterate, smoothness)?)
}

impl BoundedProblem<'_> {
    /// The largest beta at which the residual does not exceed the noise (Morozov's discrepancy
    /// principle), and its minimum; `first` is that of the given beta, which fits the noise.
    fn stop_at(&mut self, noise_nm: f64, first: Iterate) -> Result<(f64, Iterate), DwellError> {
        let (mut low, mut best) = (self.settings.smoothness.max(MIN_SMOOTHNESS), first);
        let mut high = low;
        while high < MAX_SMOOTHNESS {
            high *= SMOOTHNESS_FACTOR;
            self.start.clone_from(&best.t);
            let rougher = self.minimise(high)?;
            if self.rms_nm(&rougher) > noise_nm {
                break;
            }
            (low, best) = (high, rougher);
        }
        while high / low > SMOOTHNESS_RATIO && low < MAX_SMOOTHNESS {
            let middle = (low * high).sqrt();
            self.start.clone_from(&best.t);
            let found = self.minimise(middle)?;
            if self.rms_nm(&found) > noise_nm {
                high = middle;
            } else {
                (low, best) = (middle, found);
            }
        }
        Ok((low, best))
    }

    /// RMS of the residual without its free part, nm.
    fn rms_nm(&self, iterate: &Iterate) -> f64 {
        let mut r = &self.z - &iterate.removal_nm;
        Basis::new(self.desired.grid(), &self.weight, self.settings.free)
            .project(&self.weight, &mut r);
        let squares = Zip::from(&r).and(&self.weight).fold(0.0, |sum, r, w| sum + w * r * r);
        (squares / self.weight.sum()).sqrt()
    }
}
