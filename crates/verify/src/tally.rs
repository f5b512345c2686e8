//! Collects one quantity over all segments: its range, and where it exceeds its limit.

use planish_types::text::significant;

use crate::{
    LIMIT_ALLOWANCE,
    verdict::{Check, Place},
};

/// Number of offenders that are listed.
const WORST_COUNT: usize = 20;

/// What is allowed.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Bound {
    /// A magnitude of at most this inside a segment.
    Within(f64),
    /// A step of at most this at a break; the tolerance is the allowance for rounding.
    StepWithin(f64),
    /// A step of the acceleration of a program; the tolerance is for rounding, beside what the jerk limit allows at the
    /// break.
    StepOfProgram(f64),
    /// A value of at least this.
    AtLeast(f64),
    /// A value from the first to the second.
    Between([f64; 2]),
}

impl Bound {
    /// The number that bounds, where it is one.
    fn value(self) -> Option<f64> {
        match self {
            Self::Within(v) | Self::StepWithin(v) | Self::AtLeast(v) => Some(v),
            Self::StepOfProgram(_) | Self::Between(_) => None,
        }
    }

    /// Whether `value`, known to `rounding`, is beyond the bound.
    fn is_exceeded_by(self, value: f64, rounding: f64) -> bool {
        match self {
            Self::Within(limit) => value.abs() > limit * (1.0 + LIMIT_ALLOWANCE) + rounding,
            Self::StepWithin(tolerance) | Self::StepOfProgram(tolerance) => {
                value.abs() > tolerance + rounding
            }
            Self::AtLeast(limit) => value < limit * (1.0 - LIMIT_ALLOWANCE) - rounding,
            Self::Between(_) => self.badness(value) > rounding,
        }
    }

    /// How near: 1 is the bound itself. `None` when the bound is zero (a tolerance may be), or two.
    fn ratio(self, value: f64) -> Option<f64> {
        match self {
            Self::Within(limit) | Self::StepWithin(limit) => {
                (limit > 0.0).then(|| value.abs() / limit)
            }
            Self::AtLeast(limit) => Some(limit / value),
            Self::StepOfProgram(_) | Self::Between(_) => None,
        }
    }

    /// The larger, the worse.
    fn badness(self, value: f64) -> f64 {
        match self {
            Self::Within(_) | Self::StepWithin(_) | Self::StepOfProgram(_) => value.abs(),
            Self::AtLeast(_) => -value,
            // How far beyond the nearer end.
            Self::Between([low, high]) => (low - value).max(value - high),
        }
    }

    fn complaint(self, name: &str, unit: &str, worst: &Place, count: usize) -> String {
        let Place { index, time_s, value, .. } = worst;
        let excess = self.ratio(*value).unwrap_or(f64::INFINITY);
        match self {
            Self::Within(limit) => format!(
                "{name} reaches {value:.6} {unit} in segment {index} at {time_s:.6} s, \
                 {excess:.6} times the limit of {} {unit} (segments that exceed it: {count})",
                significant(limit, 7)
            ),
            Self::StepWithin(tolerance) => format!(
                "{name} steps by {} {unit} at break {index} at {time_s:.6} s, where {} {unit} is \
                 taken for rounding (breaks that exceed it: {count})",
                significant(*value, 7),
                significant(tolerance, 2)
            ),
            Self::StepOfProgram(_) => format!(
                "{name} of the program steps by {} {unit} at break {index} at {time_s:.6} s, more than the jerk limit \
                 allows from the middle of the segment before to that of the next (breaks that exceed it: {count})",
                significant(*value, 7)
            ),
            Self::AtLeast(limit) => format!(
                "{name} is {} {unit} in segment {index} at {time_s:.6} s, below the \
                 smallest of {} {unit} (segments that are: {count})",
                significant(*value, 7),
                significant(limit, 7)
            ),
            Self::Between([low, high]) => format!(
                "{name} reaches {value:.6} {unit} in segment {index} at {time_s:.6} s, {:.6} {unit} beyond \
                 the travel from {low} to {high} {unit} (segments that leave it: {count})",
                self.badness(*value)
            ),
        }
    }
}

/// Range and offenders so far.
pub(crate) struct Tally {
    name: String,
    unit: &'static str,
    bound: Option<Bound>,
    range: Option<(Place, Place)>,
    exceeding_count: usize,
    /// Worst first; equals in the order of the motion.
    worst: Vec<Place>,
}

impl Tally {
    pub(crate) fn new(name: impl Into<String>, unit: &'static str, bound: Option<Bound>) -> Self {
        let name = name.into();
        Self { name, unit, bound, range: None, exceeding_count: 0, worst: Vec::new() }
    }

    /// Takes in one segment or break with its smallest and largest value, known to `rounding`.
    pub(crate) fn add(&mut self, min: Place, max: Place, rounding: f64) {
        let (low, high) = self.range.get_or_insert((min, max));
        if min.value < low.value {
            *low = min;
        }
        if max.value > high.value {
            *high = max;
        }
        let Some(bound) = self.bound else { return };
        let worse = |a: Place, b: Place| bound.badness(a.value) > bound.badness(b.value);
        let peak = if worse(min, max) { min } else { max };
        if bound.is_exceeded_by(peak.value, rounding) {
            self.exceeding_count += 1;
            if self.worst.len() < WORST_COUNT || worse(peak, self.worst[WORST_COUNT - 1]) {
                let at = self.worst.partition_point(|w| !worse(peak, *w));
                self.worst.insert(at, peak);
                self.worst.truncate(WORST_COUNT);
            }
        }
    }

    pub(crate) fn finish(self) -> Check {
        let (min, max) = self.range.expect("a trajectory has a segment");
        let worst_value = match self.bound {
            Some(Bound::AtLeast(_)) => min.value,
            _ => min.value.abs().max(max.value.abs()),
        };
        let complaint = self.bound.zip(self.worst.first()).map(|(bound, worst)| {
            bound.complaint(&self.name, self.unit, worst, self.exceeding_count)
        });
        Check {
            min,
            max,
            limit: self.bound.and_then(Bound::value),
            exceeded: self.exceeding_count > 0,
            exceeding_count: self.exceeding_count,
            worst_ratio: self.bound.and_then(|b| b.ratio(worst_value)),
            worst: self.worst,
            complaint,
        }
    }
}
