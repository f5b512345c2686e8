//! Morozov's discrepancy principle: the noise of the map chooses the smoothness.
//!
//! A residual smaller than the noise of the measurement means that dwell times were spent on the noise. Source:
//! V. A. Morozov, Soviet Math. Dokl. 7 (1966) 414.
//!
//! With a Huber loss the map has pits, which are neither noise nor removed, and they would decide the RMS. Then
//! residuals e beyond the threshold k of the loss do not count, and the normal noise of the given RMS s is cut at k,
//! too:
//!
//! ```text
//! mean of e^2 over |e| <= k  against  the mean of x^2 over |x| <= k,   x normal with the deviation s         (1)
//! ```

use ndarray::{Array2, Zip};
use planish_numerics::quadrature::gauss_legendre;

use super::{
    minimise::Iterate, prepared::BoundedProblem, report::BoundedSolution, weighted::huber_weights,
};
use crate::{DwellError, objective::Basis};

/// Smallest smoothness beta from which the search begins, dimensionless. Larger: a map with little noise is smoothed
/// until its residual exceeds the noise. Smaller: more trials.
const MIN_SMOOTHNESS: f64 = 1e-9;
/// Smoothness beta from which on no larger one is tried, dimensionless; the last trial may be up to
/// [`SMOOTHNESS_FACTOR`] times as large. Larger: more trials if no smoothness makes the residual as large as the noise.
/// Smaller: the residual may stay below a large noise.
const MAX_SMOOTHNESS: f64 = 1e3;

/// Factor between two trials of the smoothness until the residual of one exceeds the noise. Larger: more bisections
/// afterwards. Smaller: more trials before them.
const SMOOTHNESS_FACTOR: f64 = 10.0;

/// Ratio of two trials of the smoothness, one too smooth and one not, at which the search ends. Larger: the residual
/// meets the noise less closely. Smaller: more trials, each of which solves the problem.
const SMOOTHNESS_RATIO: f64 = 1.05;

/// Ratio of the threshold of the Huber loss to the standard deviation of the noise from which on no noise lies beyond
/// the threshold, to rounding. Larger: integrals are computed although their result is the noise itself. Smaller: the
/// cut of the noise is ignored where it matters.
const BEYOND_NOISE: f64 = 8.0;

/// Number of points of the Gauss rule for integrals over the normal distribution: exact to rounding over
/// [`BEYOND_NOISE`] deviations. Smaller: errors of the expected noise.
const QUADRATURE_POINTS: usize = 32;

/// Solves the problem at the smoothness of the settings. If the noise of the map is given and the residual is smaller,
/// raises the smoothness until the residual is about as large as the noise.
///
/// # Errors
/// Refuses a problem whose surrogate is singular in every form.
pub fn solve(problem: &mut BoundedProblem<'_>) -> Result<BoundedSolution, DwellError> {
    let smoothness = problem.settings.slope_weight;
    let approach = problem.approach(smoothness)?;
    let mut iterate = problem.minimise(smoothness)?;
    iterate.iterations += approach;
    if let Some(noise) = problem.settings.noise_rms_nm {
        let noise_nm = problem.settings.huber_nm.map_or(noise, |k| rms_within(noise, k));
        if problem.rms_nm(&iterate) < noise_nm {
            let (smoothness, iterate) = problem.stop_at(noise_nm, iterate)?;
            return Ok(problem.finish(iterate, smoothness)?);
        }
    }
    Ok(problem.finish(iterate, smoothness)?)
}

impl BoundedProblem<'_> {
    /// Returns the largest smoothness beta at which the residual does not exceed the noise (Morozov's discrepancy
    /// principle), within the constants of the module, and the minimum at that beta. `first` is the minimum at the beta
    /// of the settings, whose residual is below the noise.
    fn stop_at(&mut self, noise_nm: f64, first: Iterate) -> Result<(f64, Iterate), DwellError> {
        let mut low = self.settings.slope_weight.max(MIN_SMOOTHNESS);
        let mut best = first;
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
            let iterate = self.minimise(middle)?;
            if self.rms_nm(&iterate) > noise_nm {
                high = middle;
            } else {
                (low, best) = (middle, iterate);
            }
        }
        Ok((low, best))
    }

    /// Returns the RMS of the residual without its free part (piston or plane), nm; with a Huber loss only over the
    /// pixels that (1) of the module counts. It is infinite if there is none.
    fn rms_nm(&self, iterate: &Iterate) -> f64 {
        let mut r = &self.z - &iterate.removal_nm;
        self.project_free(&self.weight, &mut r);
        let most = self.settings.huber_nm.unwrap_or(f64::INFINITY);
        if most.is_finite() {
            // Pits do not decide what is free either.
            let weight = huber_weights(&self.weight, &r, most);
            self.project_free(&weight, &mut r);
        }
        let mut squares = 0.0;
        let mut weight = 0.0;
        Zip::from(&r).and(&self.weight).for_each(|r, w| {
            if r.abs() <= most {
                squares += w * r * r;
                weight += w;
            }
        });
        // Where nothing is within, nothing is near the noise.
        if weight > 0.0 { (squares / weight).sqrt() } else { f64::INFINITY }
    }

    /// Subtracts the free part (piston or plane) from a residual (ny, nx), with these weights of the pixels.
    fn project_free(&self, weight: &Array2<f64>, r: &mut Array2<f64>) {
        Basis::new(self.desired.grid(), weight, self.settings.free).project(weight, r);
    }
}

/// Returns the RMS of normal noise of the RMS `noise_nm` over those values whose size is at most `most_nm`, nm: the
/// root of the right-hand side of (1) of the module.
fn rms_within(noise_nm: f64, most_nm: f64) -> f64 {
    let c = most_nm / noise_nm;
    if c >= BEYOND_NOISE {
        return noise_nm;
    }
    // Integrals of the density and of u^2 times it over 0 <= u <= c, with u = x / s; its factor is in both.
    let mut inside = 0.0;
    let mut squares = 0.0;
    for (f, weight) in gauss_legendre::<QUADRATURE_POINTS>() {
        let u = f * c;
        let p = weight * (-0.5 * u * u).exp();
        inside += p;
        squares += p * u * u;
    }
    noise_nm * (squares / inside).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_within_a_bound_is_less_by_what_is_beyond() {
        // Tables of the normal distribution: 1 - erf(1 / sqrt 2) = 0.317310507862914, density 0.241970724519143 at 1;
        // the integral of u^2 p over |u| < 1 is what is inside less twice the density there.
        let (inside, density): (f64, f64) = (1.0 - 0.317_310_507_862_914, 0.241_970_724_519_143);
        let expected = ((inside - 2.0 * density) / inside).sqrt();
        // The tables have 15 digits.
        assert!((rms_within(3.0, 3.0) / 3.0 - expected).abs() < 1e-13);
        // Beyond 7.5 deviations there is 4e-12 of the squares.
        assert!((rms_within(2.0, 15.0) / 2.0 - 1.0).abs() < 1e-11);
        assert_eq!(rms_within(2.0, 1e9), 2.0);
        // Within little it is the same everywhere: k / sqrt 3.
        assert!((rms_within(2.0, 1e-6) / 1e-6 - 3.0f64.sqrt().recip()).abs() < 1e-9);
    }
}
