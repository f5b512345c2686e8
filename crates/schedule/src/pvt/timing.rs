//! Segments and the time they get: never less than the machine's, more where a round of stretching
//! gives it.

use planish_types::{DwellTime, Limits, ToolPath};
use rayon::prelude::*;
use serde::Serialize;

use crate::ScheduleError;

/// Most rounds of stretching. A round multiplies the time of a segment in excess by up to 1.5,
/// so 100 rounds cover 17 orders of magnitude.
pub(super) const MAX_ROUNDS: usize = 100;

/// A segment that was given more time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Stretched {
    /// Index of the segment (= dwell point).
    pub segment: usize,
    /// Whether the tool removes there: then the stretch is an error of the dwell time.
    pub tool_on: bool,
    /// Dwell time, s.
    pub dwell_s: f64,
    /// Time in the schedule, s.
    pub scheduled_s: f64,
}

/// Segments and the time they get.
#[derive(Debug)]
pub(super) struct Timing {
    /// Segments that take time.
    pub(super) kept: Vec<usize>,
    /// Their time, s; > 0.
    pub(super) duration_s: Vec<f64>,
}

impl Timing {
    /// [`durations_s`], without the segments that take no time.
    pub(super) fn new(path: &ToolPath, dwell: &DwellTime, limits: &Limits) -> Self {
        let mut duration_s = durations_s(path, dwell, limits);
        let kept = (0..path.len()).filter(|i| duration_s[*i] > 0.0).collect();
        duration_s.retain(|h| *h > 0.0);
        Self { kept, duration_s }
    }

    /// The segment that is furthest from what its mean speed or duration may be.
    pub(super) fn refusal(
        &self,
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
    ) -> Option<ScheduleError> {
        let short = |i: &usize| least_time(path, limits, *i) - dwell.dwell_s()[*i];
        let worst = self.kept.iter().copied().max_by(|a, b| short(a).total_cmp(&short(b)))?;
        (short(&worst) > 0.0).then(|| ScheduleError::Infeasible {
            segment: worst,
            length_mm: path.segment_length_mm(worst),
            dwell_s: dwell.dwell_s()[worst],
            reason: format!(
                "needs at least {:.6} s for the mean velocity and the shortest segment",
                least_time(path, limits, worst)
            ),
        })
    }

    /// `h <- 1.002 min(excess, 1.5) h` where the excess is above 1: algorithms that scale a segment's time
    /// by k divide its velocity by k and its acceleration by k^2.
    pub(super) fn stretch(&mut self, excess: &[f64]) {
        for (h, e) in self.duration_s.iter_mut().zip(excess) {
            if *e > 1.0 {
                *h *= 1.002 * e.min(1.5);
            }
        }
    }

    /// Segments that have more than their dwell time, in order.
    pub(super) fn stretched(&self, path: &ToolPath, dwell: &DwellTime) -> Vec<Stretched> {
        (self.kept.iter().zip(&self.duration_s))
            .map(|(&segment, &scheduled_s)| Stretched {
                segment,
                tool_on: path.tool_on()[segment],
                dwell_s: dwell.dwell_s()[segment],
                scheduled_s,
            })
            .filter(|s| s.scheduled_s > s.dwell_s)
            .collect()
    }

    /// Segments of `path` that take no time, in order.
    pub(super) fn dropped(&self, path: &ToolPath) -> Vec<usize> {
        let mut kept = self.kept.iter().peekable();
        (0..path.len()).filter(|i| kept.next_if(|k| *k == i).is_none()).collect()
    }
}

/// Least duration, in roundings of the time of the whole motion: a duration is the difference of two break times, and
/// what rounds to zero is no time. With 64 a duration has two digits, which is enough for a segment so short that its
/// times and lengths are rounding.
const LEAST_ROUNDINGS: f64 = 64.0;

/// Duration of every segment of `path`: `h >= dwell`, `h >= |dp| / v_max` on both axes, `h >= min_segment_s`, and
/// where that is not zero, not below [`LEAST_ROUNDINGS`].
pub(crate) fn durations_s(path: &ToolPath, dwell: &DwellTime, limits: &Limits) -> Vec<f64> {
    let time = |i: usize| dwell.dwell_s()[i].max(least_time(path, limits, i));
    let mut duration_s: Vec<f64> = parallel(path.len()).map(time).collect();
    let least_s = LEAST_ROUNDINGS * f64::EPSILON * duration_s.iter().sum::<f64>();
    duration_s.iter_mut().filter(|h| **h > 0.0).for_each(|h| *h = h.max(least_s));
    duration_s
}

/// Least time of segment `i`: its mean velocity within the limits, and the controller's least.
fn least_time(path: &ToolPath, limits: &Limits, i: usize) -> f64 {
    let (dp, v) = (path.displacement_mm(i), limits.max_velocity_mm_per_s());
    let axis = |a: usize| dp[a].abs() / v[a];
    axis(0).max(axis(1)).max(limits.min_segment_s())
}

/// The segment that exceeds the limits most, and by how much; 1 where none does.
pub(super) fn worst(excess: &[f64]) -> (usize, f64) {
    let each = excess.iter().copied().enumerate();
    each.fold((0, 1.0), |m, (k, e)| if e > m.1 { (k, e) } else { m })
}

/// A segment whose time may not be stretched, but would have to be.
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

/// The segments by all threads, where there are many: the system's work for memory that is touched
/// for the first time would else be that of one.
pub(super) fn parallel(segments: usize) -> impl IndexedParallelIterator<Item = usize> {
    (0..segments).into_par_iter().with_min_len(2048)
}
