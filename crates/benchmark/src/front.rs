//! Least residual against time on any path: bounds at a few times, between which convexity holds.
//!
//! The least residual r(T) is convex, because the mean of two dwell times removes the mean of what they remove. So the
//! bounds b_k with slopes s_k, and the residuals r_k that dwell times reach in T_k, enclose it at every time:
//!
//! ```text
//! max over k of b_k - s_k (T - T_k)  <=  r(T)  <=  chord of the points (T_k, r_k), (0, RMS of the map)      (1)
//! ```
//!
//! Read along T, (1) encloses the least time for a residual.

use planish_dwell::{
    DwellError,
    path_free_bound::{BoundProblem, PathFreeBound},
};
use planish_types::{Surface, Tif};

/// Width of (1), relative to its lower end, that is narrow enough at a motion. Larger: smaller bounds. Smaller: time.
const NARROW: f64 = 0.02;

/// Ratio of two times from which each may have a bound of its own. Larger: smaller bounds. Smaller: time.
const TIMES_APART: f64 = 1.02;

/// Largest number of bounds. Larger: no change for few motions. Smaller: smaller bounds for some of many motions.
const MOST_BOUNDS: usize = 5;

/// Ratio of the time of a motion to the time that its residual needs, up to which a bound at its time says something.
/// Larger: bounds that cost a minute on a small map, of nearly zero. Smaller: smaller bounds.
const LONG: f64 = 2.0;

/// Bounds at some times.
pub struct Front {
    desired_rms_nm: f64,
    /// Bounds in the order of their times.
    bounds: Vec<PathFreeBound>,
}

impl Front {
    /// Finds bounds for these motions: the time, s, and the residual RMS, nm, of each. Those of the least RMS^2 T^(1/2)
    /// come first.
    pub fn new(desired: &Surface, tif: &Tif, motions: &[[f64; 2]]) -> Result<Self, DwellError> {
        let mut front = Self { desired_rms_nm: desired.statistics().rms, bounds: Vec::new() };
        if motions.is_empty() {
            return Ok(front);
        }
        let problem = BoundProblem::new(desired, tif)?;
        let mut ordered = motions.to_vec();
        ordered.sort_by(|a, b| cost(*a).total_cmp(&cost(*b)));
        for motion in ordered {
            while front.bounds.len() < MOST_BOUNDS
                && let Some(time_s) = front.widest(motion)
            {
                let place = front.bounds.partition_point(|bound| bound.time_s < time_s);
                front.bounds.insert(place, problem.at_time(time_s));
            }
        }
        Ok(front)
    }

    /// Returns the residual RMS, nm, that no path and no motion beats in this time: the lower end of (1).
    pub fn bound_rms_nm(&self, time_s: f64) -> f64 {
        self.bounds.iter().map(|bound| bound.at_time_nm(time_s)).fold(0.0, f64::max)
    }

    /// Returns the residual RMS, nm, that dwell times at any place reach in this time: the upper end of (1).
    pub fn reached_rms_nm(&self, time_s: f64) -> f64 {
        let mut before = (0.0, self.desired_rms_nm);
        for bound in &self.bounds {
            let after = (bound.time_s, bound.reached_rms_nm);
            if after.0 >= time_s {
                let part = (time_s - before.0) / (after.0 - before.0);
                return before.1 + part * (after.1 - before.1);
            }
            before = after;
        }
        before.1
    }

    /// Returns the time, s, below which no path and no motion reaches this residual RMS, nm.
    pub fn bound_time_s(&self, rms_nm: f64) -> f64 {
        let sloping = self.bounds.iter().filter(|bound| bound.bound_slope_nm_per_s > 0.0);
        let times = sloping
            .map(|bound| bound.time_s + (bound.bound_rms_nm - rms_nm) / bound.bound_slope_nm_per_s);
        times.fold(0.0, f64::max)
    }

    /// Returns a time, s, in which dwell times at any place reach this residual RMS, nm; at most `time_s`.
    fn reached_time_s(&self, rms_nm: f64, time_s: f64) -> f64 {
        let mut before = (0.0, self.desired_rms_nm);
        for bound in &self.bounds {
            let after = (bound.time_s, bound.reached_rms_nm);
            if after.1 <= rms_nm {
                let part = (before.1 - rms_nm).max(0.0) / (before.1 - after.1);
                return (before.0 + part * (after.0 - before.0)).min(time_s);
            }
            before = after;
        }
        time_s
    }

    /// Returns the time, s, at which (1) is widest for a motion: at its residual, or at its time. `None` if it is narrow.
    /// A motion of more than [`LONG`] times the time that its residual needs has no bound at its time: it would be
    /// nearly zero.
    fn widest(&self, [time_s, rms_nm]: [f64; 2]) -> Option<f64> {
        let times = [self.bound_time_s(rms_nm), self.reached_time_s(rms_nm, time_s)];
        let residuals = [self.bound_rms_nm(time_s), self.reached_rms_nm(time_s)];
        let mut widest = (NARROW, None);
        for (at_s, [low, high]) in [(0.5 * (times[0] + times[1]), times), (time_s, residuals)] {
            let width = high / low - 1.0;
            if width > widest.0 && at_s <= LONG * times[1] && !self.has_bound_near(at_s) {
                widest = (width, Some(at_s));
            }
        }
        widest.1
    }

    fn has_bound_near(&self, time_s: f64) -> bool {
        let mut ratios = self.bounds.iter().map(|bound| bound.time_s / time_s);
        ratios.any(|ratio| ratio.max(ratio.recip()) < TIMES_APART)
    }
}

/// Returns RMS^2 T^(1/2) of a motion, nm^2 s^(1/2).
fn cost([time_s, rms_nm]: [f64; 2]) -> f64 {
    rms_nm * rms_nm * time_s.sqrt()
}
