//! Times of the segments: at least the dwell time and the least time of the machine, and more after a
//! round of stretching.

use planish_types::{DwellTime, Limits, ToolPath};
use rayon::prelude::*;
use serde::Serialize;

use crate::ScheduleError;

/// Largest number of rounds in which all segments are stretched by the same factor. A round multiplies
/// their times by up to 1.5, so 100 rounds cover 17 orders of magnitude. Larger: a hopeless case runs
/// longer. Smaller: times that are orders of magnitude too short end in an error.
pub(super) const MAX_ROUNDS: usize = 100;

/// A segment whose time in the motion is longer than its dwell time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Stretched {
    /// Index of the segment in the path, which is also that of its dwell point.
    pub segment: usize,
    /// True if the tool is on; the additional time then removes more material than planned.
    pub tool_on: bool,
    /// Dwell time, s.
    pub dwell_s: f64,
    /// Time of the segment in the schedule, s.
    pub scheduled_s: f64,
}

/// Segments of a path whose time is above zero, and their times.
#[derive(Debug)]
pub(super) struct Timing {
    /// Indices of the segments with a time above zero in the path.
    pub(super) segments: Vec<usize>,
    /// Time of each of the `segments`, s; > 0.
    pub(super) duration_s: Vec<f64>,
}

impl Timing {
    /// Returns the times of [`durations_s`], without the segments whose time is zero.
    pub(super) fn new(path: &ToolPath, dwell: &DwellTime, limits: &Limits) -> Self {
        let mut duration_s = durations_s(path, dwell, limits);
        let segments = (0..path.len()).filter(|i| duration_s[*i] > 0.0).collect();
        duration_s.retain(|h| *h > 0.0);
        Self { segments, duration_s }
    }

    /// Returns the error for the segment whose dwell time is farthest below its least time; `None` if there is no such
    /// segment.
    pub(super) fn refusal(
        &self,
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
    ) -> Option<ScheduleError> {
        let missing =
            self.segments.iter().map(|i| (*i, least_time(path, limits, *i) - dwell.dwell_s()[*i]));
        let (worst, missing_s) = missing.max_by(|a, b| a.1.total_cmp(&b.1))?;
        if missing_s <= 0.0 {
            return None;
        }
        Some(ScheduleError::Infeasible {
            segment: worst,
            length_mm: path.segment_length_mm(worst),
            dwell_s: dwell.dwell_s()[worst],
            reason: format!(
                "needs at least {:.6} s for the mean velocity and the shortest segment",
                least_time(path, limits, worst)
            ),
        })
    }

    /// Stretches every segment whose excess factor is above 1: `h <- 1.002 min(excess, 1.5) h`. A time that is k times
    /// as long divides the velocity by k and the acceleration by k^2.
    pub(super) fn stretch(&mut self, excess: &[f64]) {
        for (h, e) in self.duration_s.iter_mut().zip(excess) {
            if *e > 1.0 {
                *h *= 1.002 * e.min(1.5);
            }
        }
    }

    /// Returns the segments that take longer than their dwell time, in order.
    pub(super) fn stretched(&self, path: &ToolPath, dwell: &DwellTime) -> Vec<Stretched> {
        (self.segments.iter().zip(&self.duration_s))
            .map(|(&segment, &scheduled_s)| Stretched {
                segment,
                tool_on: path.tool_on()[segment],
                dwell_s: dwell.dwell_s()[segment],
                scheduled_s,
            })
            .filter(|s| s.scheduled_s > s.dwell_s)
            .collect()
    }

    /// Returns the indices of the segments of `path` whose time is zero, in order.
    pub(super) fn dropped(&self, path: &ToolPath) -> Vec<usize> {
        let mut timed = self.segments.iter().peekable();
        (0..path.len()).filter(|i| timed.next_if(|k| *k == i).is_none()).collect()
    }
}

/// Least duration of a segment, in roundings of the total time. A duration is the difference of two break times, so a
/// shorter one could round to zero. Larger: very short segments are stretched by more. Smaller: durations keep fewer
/// digits. 64 roundings leave two digits, enough for a segment whose times and lengths are rounding.
const LEAST_ROUNDINGS: f64 = 64.0;

/// Returns the duration of every segment of `path`, s: the largest of the dwell time, |dp| / v_max on both axes, and
/// `min_segment_s`. If that is not zero, it is at least [`LEAST_ROUNDINGS`] roundings of the total time.
pub(crate) fn durations_s(path: &ToolPath, dwell: &DwellTime, limits: &Limits) -> Vec<f64> {
    let mut duration_s: Vec<f64> =
        parallel(path.len()).map(|i| dwell.dwell_s()[i].max(least_time(path, limits, i))).collect();
    let least_s = LEAST_ROUNDINGS * f64::EPSILON * duration_s.iter().sum::<f64>();
    duration_s.iter_mut().filter(|h| **h > 0.0).for_each(|h| *h = h.max(least_s));
    duration_s
}

/// Returns the least time of segment `i`, s, at which its mean velocity keeps the limits and the controller accepts its
/// duration.
fn least_time(path: &ToolPath, limits: &Limits, i: usize) -> f64 {
    let dp = path.displacement_mm(i);
    let v = limits.max_velocity_mm_per_s();
    let [x_s, y_s] = [0, 1].map(|a| dp[a].abs() / v[a]);
    x_s.max(y_s).max(limits.min_segment_s())
}

/// Returns the index of the segment with the largest excess factor, and that factor; (0, 1) if no segment exceeds the
/// limits.
pub(super) fn worst(excess: &[f64]) -> (usize, f64) {
    let each = excess.iter().copied().enumerate();
    each.fold((0, 1.0), |m, (k, e)| if e > m.1 { (k, e) } else { m })
}

/// Returns the error for a segment that would have to be stretched by `factor`, which the settings forbid.
pub(super) fn too_short(
    path: &ToolPath,
    dwell: &DwellTime,
    segment: usize,
    factor: f64,
) -> ScheduleError {
    ScheduleError::Infeasible {
        segment,
        length_mm: path.segment_length_mm(segment),
        dwell_s: dwell.dwell_s()[segment],
        reason: format!("needs its time stretched by a factor {factor:.4} or more"),
    }
}

/// Returns an iterator over the segment indices, on all threads if there are many. With one thread, that thread alone
/// would do the system's work for memory that is touched for the first time.
pub(super) fn parallel(segments: usize) -> impl IndexedParallelIterator<Item = usize> {
    (0..segments).into_par_iter().with_min_len(2048)
}
