//! Position mode: stand at each dwell point for its dwell time.
//!
//! ```text
//! P(t) = dwell_point[i]   for the time dwell[i]
//! ```
//!
//! No machine can execute this motion: it jumps between the points, in no time. A dwell solver with
//! point columns assumes it, and executed motions are compared with it.

use planish_types::{DwellTime, Invalid, ToolPath, Trajectory, TrajectoryBuilder};

use crate::{ScheduleError, check_lengths};

/// Dwell time, relative to the total time, up to which a dwell point is left out: it would vanish in the rounding of
/// the break times. Four roundings. Larger: short dwell times are lost. Smaller: two break times can be equal.
const ROUNDING: f64 = 4.0 * f64::EPSILON;

/// Plans a motion that stands at each dwell point of `path` for its dwell time. It leaves out points whose dwell time
/// is zero or rounding.
///
/// # Errors
///
/// Refuses dwell times of another path, and dwell times that are zero everywhere.
pub fn schedule(path: &ToolPath, dwell: &DwellTime) -> Result<Trajectory, ScheduleError> {
    check_lengths(path, dwell)?;
    let mut motion = TrajectoryBuilder::default();
    let least_s = ROUNDING * dwell.total_s();
    for (i, &dwell_s) in dwell.dwell_s().iter().enumerate().filter(|(_, t)| **t > least_s) {
        let at = path.dwell_point_mm()[i].map(|p| [p, 0.0, 0.0, 0.0]);
        motion.push(dwell_s, at, path.tool_on()[i], Some(i));
    }
    if motion.is_empty() {
        return Err(Invalid::whole("dwell_s", "is zero everywhere", "give a dwell time").into());
    }
    Ok(motion.build()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stands_at_the_dwell_points_not_the_control_points() {
        let points = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let path = ToolPath::through(points, vec![true, true, false], vec![0; 3]).unwrap();
        let dwell = DwellTime::new(vec![0.5, 0.0, 2.0]).unwrap();
        let t = schedule(&path, &dwell).unwrap();
        assert_eq!((t.len(), t.total_time_s()), (2, 2.5));
        assert_eq!(t.segment(0).position_mm(0.3), [0.5, 0.0]);
        assert_eq!(t.segment(1).position_mm(1.7), [0.5, 1.0]);
        assert_eq!((t.segment(1).tool_on, t.segment(1).dwell_index), (false, Some(2)));
    }

    #[test]
    fn a_dwell_time_of_another_path_is_refused() {
        let path = ToolPath::through(vec![[0.0; 2], [1.0, 0.0]], vec![true], vec![0]).unwrap();
        let message = |v| schedule(&path, &DwellTime::new(v).unwrap()).unwrap_err().to_string();
        assert!(message(vec![1.0, 1.0]).contains("has 2 elements, the tool path 1"));
        assert!(message(vec![0.0]).contains("zero everywhere"));
    }
}
