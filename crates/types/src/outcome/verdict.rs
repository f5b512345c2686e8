//! Verdict of `planish verify` on a motion: the exact range of every quantity, and its limit.
//!
//! A verdict that another program wrote may lack what is not needed to compare plans. It then reads as not exceeded.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::{PathDistance, TransformNumbers, stored_dwell_index};

/// A value and the place in the motion where it occurs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct PlacedValue {
    /// Index of the segment. For a step: index of the break at which segment `index` starts.
    pub index: usize,
    /// Dwell point that the segment serves, if any; serialised as -1 when none.
    #[serde(serialize_with = "as_stored", deserialize_with = "from_stored")]
    pub dwell_index: Option<usize>,
    /// Time on the time axis of the trajectory, s.
    pub time_s: f64,
    /// The value, with its sign, in the unit of the check.
    pub value: f64,
}

fn as_stored<S: Serializer>(index: &Option<usize>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_i64(stored_dwell_index(*index))
}

fn from_stored<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<usize>, D::Error> {
    Ok(usize::try_from(i64::deserialize(deserializer)?).ok())
}

/// The exact range of one quantity over the whole trajectory, and its limit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Check {
    /// Smallest value.
    pub min: PlacedValue,
    /// Largest value.
    pub max: PlacedValue,
    /// Largest magnitude that is allowed (for durations: smallest value). Absent if nothing limits
    /// the quantity, and for a position: its two limits are `travel_mm` of the axis.
    pub limit: Option<f64>,
    /// True if a value exceeds the limit by more than rounding.
    pub exceeded: bool,
    /// Number of segments (for steps: breaks) that exceed the limit.
    pub exceeding_count: usize,
    /// Ratio of the largest magnitude to the limit (for durations: of the limit to the shortest).
    pub worst_ratio: Option<f64>,
    /// The worst segments (for steps: breaks) that exceed the limit, the worst first; at most 20.
    pub worst: Vec<PlacedValue>,
    /// The worst excess in a sentence. A manifest has it in `violations`.
    #[serde(skip)]
    pub complaint: Option<String>,
}

impl Check {
    /// Returns the largest magnitude of the quantity, in its unit.
    pub fn magnitude(&self) -> f64 {
        self.min.value.abs().max(self.max.value.abs())
    }
}

/// Number and size of excursions inside segments. They are information, and no limit applies to
/// them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Excursions {
    /// Number of segments with an excursion.
    pub count: usize,
    /// The largest excursion; `None` if there is none.
    pub largest: Option<PlacedValue>,
    /// Threshold, in the unit of the quantity. Values up to it are rounding and do not count.
    pub noise: f64,
}

/// Everything about one axis.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct AxisVerdict {
    /// "x" or "y".
    pub name: String,
    /// Smallest and largest position within the travel of the axis, mm. Absent if no travel is
    /// stated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub travel_mm: Option<[f64; 2]>,
    /// Range of the position, mm.
    pub position_mm: Check,
    /// Range of the velocity, mm/s.
    pub velocity_mm_per_s: Check,
    /// Range of the acceleration inside the segments, mm/s^2.
    pub acceleration_mm_per_s2: Check,
    /// Range of the jerk inside the segments, mm/s^3.
    pub jerk_mm_per_s3: Check,
    /// Steps in position at the breaks, mm.
    pub position_step_mm: Check,
    /// Steps in velocity at the breaks, start and end included, mm/s.
    pub velocity_step_mm_per_s: Check,
    /// Steps in acceleration at the breaks, start and end included, mm/s^2.
    pub acceleration_step_mm_per_s2: Check,
    /// Largest distance of the position from the interval between both ends of its segment, mm.
    pub overshoot_mm: Excursions,
    /// Speed against the main direction of a segment in which the velocity has both signs, mm/s:
    /// the smaller of the two largest speeds.
    pub reversal_mm_per_s: Excursions,
}

impl AxisVerdict {
    /// Returns the checks of velocity, acceleration and jerk, in this order.
    pub fn derivatives(&self) -> [&Check; 3] {
        [&self.velocity_mm_per_s, &self.acceleration_mm_per_s2, &self.jerk_mm_per_s3]
    }
}

/// The verdict on a trajectory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// True if the motion keeps every limit.
    pub limits_respected: bool,
    /// One sentence per exceeded limit, the gravest first.
    #[serde(default)]
    pub violations: Vec<String>,
    /// Duration of the motion, s.
    pub total_time_s: f64,
    /// Number of segments.
    #[serde(default)]
    pub segment_count: usize,
    /// Largest |velocity| of [x, y], mm/s.
    pub max_velocity_mm_per_s: [f64; 2],
    /// Largest |acceleration| inside segments of [x, y], mm/s^2.
    pub max_acceleration_mm_per_s2: [f64; 2],
    /// Largest |jerk| inside segments of [x, y], mm/s^3.
    #[serde(default)]
    pub max_jerk_mm_per_s3: [f64; 2],
    /// Largest step in position of [x, y], mm.
    #[serde(default)]
    pub max_position_step_mm: [f64; 2],
    /// Largest step in velocity of [x, y], mm/s.
    pub max_velocity_step_mm_per_s: [f64; 2],
    /// Largest step in acceleration of [x, y], mm/s^2.
    pub max_acceleration_step_mm_per_s2: [f64; 2],
    /// Largest overshoot beyond the ends of a segment of [x, y], mm.
    #[serde(default)]
    pub max_overshoot_mm: [f64; 2],
    /// Excess over a limit that is taken for rounding, relative to the limit.
    #[serde(default)]
    pub limit_allowance: f64,
    /// Durations of the segments, s.
    #[serde(default)]
    pub segment_duration_s: Check,
    /// Verdicts on the axes [x, y].
    #[serde(default)]
    pub axes: [AxisVerdict; 2],
    /// Distance of the motion from its path; absent if the path is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path_distance: Option<PathDistance>,
    /// Name of the machine; absent where nobody named it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
    /// Place of the part on the axes that the verdict is about; absent if the axes read the coordinates of the part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub part_to_axes: Option<TransformNumbers>,
}

impl Verdict {
    /// Returns the verdict with the distance from the path added. If that distance exceeds its tolerance, the motion
    /// counts as not keeping its limits.
    pub fn with_path_distance(mut self, distance: PathDistance) -> Self {
        self.violations.extend(distance.excess());
        self.limits_respected = self.violations.is_empty();
        self.path_distance = Some(distance);
        self
    }

    /// Returns the gravest violation as a sentence, with the number of further ones; `None` if the motion keeps every
    /// limit.
    pub fn reason(&self) -> Option<String> {
        reason(&self.violations)
    }
}

/// Everything about one axis of a machine. Values have the unit of the axis, over powers of s.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct MachineAxisVerdict {
    /// Name of the axis.
    pub name: String,
    /// Unit of its positions, mm or deg.
    pub unit: String,
    /// Smallest and largest position within the travel of the axis. Absent if no travel is stated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub travel: Option<[f64; 2]>,
    /// Range of the position.
    pub position: Check,
    /// Range of the velocity.
    pub velocity: Check,
    /// Range of the acceleration inside the segments.
    pub acceleration: Check,
    /// Range of the jerk inside the segments.
    pub jerk: Check,
    /// Steps in position at the breaks.
    pub position_step: Check,
    /// Steps in velocity at the breaks, start and end included.
    pub velocity_step: Check,
    /// Steps in acceleration at the breaks, start and end included.
    pub acceleration_step: Check,
}

impl MachineAxisVerdict {
    /// Returns the checks of velocity, acceleration and jerk, in this order.
    pub fn derivatives(&self) -> [&Check; 3] {
        [&self.velocity, &self.acceleration, &self.jerk]
    }
}

/// The verdict on a motion of all axes of a machine.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct AxesVerdict {
    /// True if the motion keeps every limit.
    pub limits_respected: bool,
    /// One sentence per exceeded limit, the gravest first.
    pub violations: Vec<String>,
    /// Duration of the motion, s.
    pub total_time_s: f64,
    /// Number of segments.
    pub segment_count: usize,
    /// Excess over a limit that is taken for rounding, relative to the limit.
    pub limit_allowance: f64,
    /// Durations of the segments, s.
    pub segment_duration_s: Check,
    /// Verdicts on the axes, in the order of the machine.
    pub axes: Vec<MachineAxisVerdict>,
    /// Name of the machine; absent where nobody named it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
}

impl AxesVerdict {
    /// Returns the gravest violation as a sentence, with the number of further ones; `None` if the motion keeps every
    /// limit.
    pub fn reason(&self) -> Option<String> {
        reason(&self.violations)
    }
}

fn reason(violations: &[String]) -> Option<String> {
    let first = violations.first()?;
    Some(match violations.len() - 1 {
        0 => first.clone(),
        1 => format!("{first}; 1 more limit is exceeded"),
        more => format!("{first}; {more} more limits are exceeded"),
    })
}
