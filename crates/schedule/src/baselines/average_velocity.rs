//! Average velocity: constant velocity in every segment, its displacement over its dwell time.
//!
//! ```text
//! h = max(dwell, |dp_x| / v_max_x, |dp_y| / v_max_y, least segment)      v = dp / h
//! ```
//!
//! The velocity steps at every control point, and the report has the largest step: no machine can
//! execute the motion. A dwell solver with segment columns assumes this motion. So the residual is
//! that of the solver if no segment is stretched.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | h | `duration_s` | (n) | s |
//! | dp | `displacement_mm` | (n) | mm |
//! | v | `coefficient_mm[.., 1]` | (n) | mm/s |

use planish_types::{DwellTime, Invalid, Limits, ToolPath, TrajectoryBuilder};
use serde::Serialize;

use crate::{
    Schedule, ScheduleError, check_lengths,
    pvt::{Stretched, durations_s},
};

/// Stretched segments, velocity steps and dropped segments of a schedule.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct AverageVelocityReport {
    /// Segments whose time is longer than their dwell time, in order of the path.
    pub stretched: Vec<Stretched>,
    /// Sum of the times by which the stretched segments are longer than their dwell times, s.
    pub added_s: f64,
    /// Largest step of the velocity at a control point along [x, y], start and end of the motion included, mm/s.
    pub largest_velocity_step_mm_per_s: [f64; 2],
    /// Indices of the segments that the motion leaves out: they have neither length nor dwell time, and the controller
    /// has no shortest segment.
    pub dropped: Vec<usize>,
}

/// Schedules `path` with the times `dwell`. A segment takes longer if the velocity limit or the
/// shortest segment of the controller demands it.
///
/// # Errors
///
/// Refuses dwell times of another path, and a path without a length whose dwell times are all zero.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
) -> Result<Schedule<AverageVelocityReport>, ScheduleError> {
    check_lengths(path, dwell)?;
    let mut report = AverageVelocityReport::default();
    let mut motion = TrajectoryBuilder::default();
    let mut before = [0.0; 2];
    let durations_s = durations_s(path, dwell, limits);
    for (i, (&dwell_s, &h)) in dwell.dwell_s().iter().zip(&durations_s).enumerate() {
        if h == 0.0 {
            report.dropped.push(i);
            continue;
        }
        let tool_on = path.tool_on()[i];
        if h > dwell_s {
            report.stretched.push(Stretched { segment: i, tool_on, dwell_s, scheduled_s: h });
            report.added_s += h - dwell_s;
        }
        let v = path.displacement_mm(i).map(|dp| dp / h);
        report.step(before, v);
        before = v;
        let start = path.point_mm()[i];
        motion.push(h, [0, 1].map(|a| [start[a], v[a], 0.0, 0.0]), tool_on, Some(i));
    }
    report.step(before, [0.0; 2]);
    if motion.is_empty() {
        return Err(Invalid::whole("dwell_s", "is zero everywhere", "give a dwell time").into());
    }
    Ok(Schedule { trajectory: motion.build()?, report })
}

impl AverageVelocityReport {
    fn step(&mut self, before: [f64; 2], after: [f64; 2]) {
        for axis in 0..2 {
            let largest = &mut self.largest_velocity_step_mm_per_s[axis];
            *largest = largest.max((after[axis] - before[axis]).abs());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{MachineFile, MachineFileAxis};

    #[test]
    fn velocity_is_length_over_time_and_steps_are_reported() {
        let points = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 3.0], [1.0, 3.0]];
        let path = ToolPath::through(points, vec![true; 4], vec![0; 4]).unwrap();
        let dwell = DwellTime::new(vec![0.5, 0.25, 0.1, 0.0]).unwrap();
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 10.0,
            max_acceleration_mm_per_s2: 1.0,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x"), axis("y")];
        let limits =
            MachineFile { name: "m".into(), axes, min_segment_s: 0.0, ..MachineFile::default() }
                .checked()
                .unwrap();
        let s = schedule(&path, &dwell, &limits).unwrap();
        // 3 mm at 10 mm/s need 0.3 s.
        assert_eq!(s.trajectory.break_time_s(), [0.0, 0.5, 0.75, 1.05]);
        assert_eq!(s.trajectory.coefficient_mm()[0], [[0.0, 2.0, 0.0, 0.0], [0.0; 4]]);
        assert_eq!(s.trajectory.coefficient_mm()[1], [[1.0, 0.0, 0.0, 0.0], [0.0; 4]]);
        assert_eq!(s.trajectory.coefficient_mm()[2][1], [0.0, 10.0, 0.0, 0.0]);
        assert_eq!(s.report.largest_velocity_step_mm_per_s, [2.0, 10.0]);
        assert_eq!((s.report.stretched.len(), s.report.stretched[0].segment), (1, 2));
        assert!((s.report.added_s - 0.2).abs() < 1e-15);
        assert_eq!(s.report.dropped, [3]);
    }
}
