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
use planish_numerics::pareto;
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
    /// Finds bounds where (1) is widest for these motions: the time, s, and the residual RMS, nm, of each. Motions that
    /// another beats in both come last, and for each motion its residual comes before its time.
    pub fn new(desired: &Surface, tif: &Tif, motions: &[[f64; 2]]) -> Result<Self, DwellError> {
        let mut front = Self { desired_rms_nm: desired.statistics().rms, bounds: Vec::new() };
        if motions.is_empty() {
            return Ok(front);
        }
        let problem = BoundProblem::new(desired, tif)?;
        let best: Vec<[f64; 2]> = pareto::front(motions).into_iter().map(|i| motions[i]).collect();
        for _ in 0..MOST_BOUNDS {
            let next = front.widest_at_residuals(&best).or_else(|| front.widest_at_times(&best));
            let next = next.or_else(|| front.widest_at_residuals(motions));
            let Some(time_s) = next.or_else(|| front.widest_at_times(motions)) else { break };
            let place = front.bounds.partition_point(|bound| bound.time_s < time_s);
            front.bounds.insert(place, problem.at_time(time_s));
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

    /// Returns the middle of the times, s, between which (1) has the least time for the residual of a motion, where
    /// they are widest; `None` if they are narrow for all motions.
    fn widest_at_residuals(&self, motions: &[[f64; 2]]) -> Option<f64> {
        self.widest(motions.iter().map(|&[time_s, rms_nm]| {
            let times = [self.bound_time_s(rms_nm), self.reached_time_s(rms_nm, time_s)];
            (0.5 * (times[0] + times[1]), times)
        }))
    }

    /// Returns the time, s, of the motion at whose time (1) is widest; `None` if it is narrow for all motions. A motion
    /// of more than [`LONG`] times the time that its residual needs has no bound at its time: it would be nearly zero.
    fn widest_at_times(&self, motions: &[[f64; 2]]) -> Option<f64> {
        let short = motions
            .iter()
            .filter(|[time_s, rms_nm]| *time_s <= LONG * self.reached_time_s(*rms_nm, *time_s));
        self.widest(
            short.map(|&[time_s, _]| {
                (time_s, [self.bound_rms_nm(time_s), self.reached_rms_nm(time_s)])
            }),
        )
    }

    /// Returns the time, s, with the widest interval [low, high]; `None` if all are narrow or have a bound near them.
    fn widest(&self, intervals: impl Iterator<Item = (f64, [f64; 2])>) -> Option<f64> {
        let mut widest = (NARROW, None);
        for (time_s, [low, high]) in intervals {
            let width = high / low - 1.0;
            if width > widest.0 && !self.has_bound_near(time_s) {
                widest = (width, Some(time_s));
            }
        }
        widest.1
    }

    fn has_bound_near(&self, time_s: f64) -> bool {
        let mut ratios = self.bounds.iter().map(|bound| bound.time_s / time_s);
        ratios.any(|ratio| ratio.max(ratio.recip()) < TIMES_APART)
    }
}
