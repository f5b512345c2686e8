//! Outcome of `planish axes motion`.

use serde::{Deserialize, Serialize};

use crate::PathDistance;

/// Report on a motion of the axes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MotionReport {
    /// Names of the axes, in the order of the arrays.
    pub axes: Vec<String>,
    /// Unit of each axis, mm or deg.
    pub units: Vec<String>,
    /// Number of segments.
    #[serde(default)]
    pub segment_count: usize,
    /// Largest distance of the executed contact point from the path, um, at 7 points in every segment.
    pub contact_deviation_um: f64,
    /// Time of this distance in the motion of the axes, s.
    #[serde(default)]
    pub contact_deviation_time_s: f64,
    /// Largest distance of the tip of the tool from the surface, along the tool, um, at the same points.
    pub gap_um: f64,
    /// Largest angle between tool and normal on the executed motion, degrees.
    #[serde(default)]
    pub off_normal_deg: f64,
    /// Duration of the motion of the contact point as it was given, s.
    #[serde(default)]
    pub planned_time_s: f64,
    /// Duration of the motion of the axes, s.
    #[serde(default)]
    pub total_time_s: f64,
    /// Part of the difference that segments with the tool on have, s: the tool removes that much longer.
    pub added_tool_on_time_s: f64,
    /// Largest factor by which time was stretched, and where; absent if every limit was kept.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub slowed: Option<SlowedReport>,
    /// Work of a spindle near its centre; absent for other kinematics.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spindle: Option<SpindleReport>,
    /// Distance of the contact point from the tool path; absent if the maker of the plan does not state one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path_distance: Option<PathDistance>,
}

/// Limit that decides on the slowest place of a motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SlowedReport {
    /// Axis that would exceed its limit most.
    pub axis: String,
    /// Quantity that would exceed its limit.
    pub quantity: String,
    /// Ratio of its value to the limit.
    pub ratio: f64,
    /// Time of this place in the motion as it was given, s.
    pub time_s: f64,
    /// Largest factor by which time is stretched anywhere.
    pub largest_stretch: f64,
}

/// Work of a spindle near its centre.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpindleReport {
    /// Smallest distance of the contact point from the centre, mm, at the ends of the segments.
    pub least_radius_mm: f64,
    /// Radius below which the axis c cannot turn as fast as the motion asks, mm; 0 if it can everywhere.
    pub c_limit_radius_mm: f64,
    /// Time that was added below this radius, s.
    pub added_time_within_s: f64,
}
