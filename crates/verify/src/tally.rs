//! Tally: the range of one quantity over all segments, and the worst segments in which it exceeds its limit.

use planish_types::{
    outcome::verdict::{Check, PlacedValue},
    text::significant,
};

use crate::LIMIT_ALLOWANCE;

/// Largest number of segments or breaks beyond the bound that a check lists. Larger: longer manifests. Smaller: fewer
/// of them to look at. Chosen: 20; `exceeding_count` counts all of them.
const WORST_COUNT: usize = 20;

/// Bound on the values of a quantity.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Bound {
    /// The magnitude inside a segment is at most this limit.
    Within(f64),
    /// The magnitude of the step at a break is at most this tolerance, which covers rounding.
    StepWithin(f64),
    /// The step of the acceleration at a break of a controller's program is at most this tolerance for rounding, plus
    /// the step that the jerk limit allows there.
    StepOfProgram(f64),
    /// The value is at least this limit.
    AtLeast(f64),
    /// The value is between the first number and the second, such as the travel of an axis.
    Between([f64; 2]),
}

impl Bound {
    /// Returns the limit; `None` if it is not a single number.
    fn value(self) -> Option<f64> {
        match self {
            Self::Within(v) | Self::StepWithin(v) | Self::AtLeast(v) => Some(v),
            Self::StepOfProgram(_) | Self::Between(_) => None,
        }
    }

    /// Returns true if `value` is outside the bound by more than `rounding`, the uncertainty of the value.
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

    /// Returns the ratio of the value to its limit: 1 is the limit itself. `None` if the limit is zero, which a
    /// tolerance may be, or if it is not a single number.
    fn ratio(self, value: f64) -> Option<f64> {
        match self {
            Self::Within(limit) | Self::StepWithin(limit) => {
                if limit > 0.0 {
                    Some(value.abs() / limit)
                } else {
                    None
                }
            }
            Self::AtLeast(limit) => Some(limit / value),
            Self::StepOfProgram(_) | Self::Between(_) => None,
        }
    }

    /// Returns the number by which the values beyond the bound are sorted: the larger, the worse.
    fn badness(self, value: f64) -> f64 {
        match self {
            Self::Within(_) | Self::StepWithin(_) | Self::StepOfProgram(_) => value.abs(),
            Self::AtLeast(_) => -value,
            // Excess over the nearer end.
            Self::Between([low, high]) => (low - value).max(value - high),
        }
    }

    fn complaint(self, name: &str, unit: &str, worst: &PlacedValue, count: usize) -> String {
        let PlacedValue { index, time_s, value, .. } = worst;
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

/// Range of one quantity in the segments so far, and its values beyond the bound.
pub(crate) struct Tally {
    name: String,
    unit: &'static str,
    bound: Option<Bound>,
    range: Option<(PlacedValue, PlacedValue)>,
    exceeding_count: usize,
    /// Values beyond the bound, the worst first; equal ones in the order of the motion. At most [`WORST_COUNT`].
    worst: Vec<PlacedValue>,
}

impl Tally {
    pub(crate) fn new(name: impl Into<String>, unit: &'static str, bound: Option<Bound>) -> Self {
        let name = name.into();
        Self { name, unit, bound, range: None, exceeding_count: 0, worst: Vec::new() }
    }

    /// Adds one segment or break with its smallest and largest value; both have the uncertainty `rounding`.
    pub(crate) fn add(&mut self, min: PlacedValue, max: PlacedValue, rounding: f64) {
        let (low, high) = self.range.get_or_insert((min, max));
        if min.value < low.value {
            *low = min;
        }
        if max.value > high.value {
            *high = max;
        }
        let Some(bound) = self.bound else { return };
        let worse =
            |a: PlacedValue, b: PlacedValue| bound.badness(a.value) > bound.badness(b.value);
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
