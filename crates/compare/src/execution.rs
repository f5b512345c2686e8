//! Deviations of a motion from its plan: error of the dwell times, overshoot, jerk.
//!
//! ```text
//! dwell error of point i = time with the tool on in its segments - dwell_i
//! overshoot of point i   = distance by which its segments leave the interval from their start to their end position
//! jerk                   = |6 c3|
//! ```
//!
//! The segments of a point are those that serve it: whose dwell index names it. A point whose segments all have the
//! tool off has no dwell error. An overshoot is that of consecutive segments of one point, along x or y; a segment
//! without a point counts alone. It counts above 1 nm.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | dwell | `dwell_s` | (n) | s |
//! | c3, cubic coefficient | `coefficient_mm[.., .., 3]` | (k, 2) | mm/s^3 |

use planish_numerics::polynomial::{evaluate, range};
use planish_types::{DwellTime, Invalid, Trajectory};
use serde::Serialize;

/// Smallest excursion that counts as an overshoot, mm. Larger: real overshoots are missed. Smaller: rounding counts.
/// Chosen: the tolerance of a position in `planish verify`.
const OVERSHOOT_MM: f64 = 1e-6;

/// Deviations of a motion from its planned dwell times, its overshoot, and its jerk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Execution {
    /// RMS of the dwell error over the points, s; `null` without dwell times, or if no segment names a dwell point.
    pub dwell_error_rms_s: Option<f64>,
    /// Dwell error of the largest magnitude, with its sign, s; `null` without dwell times, or if no segment names a
    /// dwell point.
    pub dwell_error_worst_s: Option<f64>,
    /// Number of overshoots of more than 1 nm along [x, y]: of dwell points, and of segments that serve no point.
    pub overshoot_points: [usize; 2],
    /// Largest overshoot along [x, y], mm; 0 if no segment overshoots.
    pub max_overshoot_mm: [f64; 2],
    /// Largest magnitude of the jerk inside segments along [x, y], mm/s^3.
    pub max_jerk_mm_per_s3: [f64; 2],
}

impl Execution {
    /// Measures how `trajectory` executes the dwell times `dwell`; its segments name the dwell points that they
    /// serve.
    ///
    /// # Errors
    /// Refuses a dwell index beyond the points.
    pub fn new(trajectory: &Trajectory, dwell: Option<&DwellTime>) -> Result<Self, Invalid> {
        let mut execution = Self::default();
        // A motion read back from a controller's program serves no points.
        let serves = trajectory.dwell_index().iter().any(Option::is_some);
        if let Some(dwell) = dwell.filter(|_| serves) {
            let errors = dwell_errors(trajectory, dwell)?;
            let squares: f64 = errors.iter().map(|e| e * e).sum();
            let worst = errors.iter().fold(0.0, |m: f64, e| if e.abs() > m.abs() { *e } else { m });
            execution.dwell_error_rms_s = Some((squares / errors.len().max(1) as f64).sqrt());
            execution.dwell_error_worst_s = Some(worst);
        }
        let index = trajectory.dwell_index();
        let mut first = 0;
        while first < trajectory.len() {
            let mut following = first + 1..trajectory.len();
            let next = following.find(|k| index[*k] != index[first] || index[first].is_none());
            let end = next.unwrap_or(trajectory.len());
            execution.add_overshoot(trajectory, first, end);
            first = end;
        }
        for (c, axis) in trajectory.coefficient_mm().iter().flat_map(|c| [(c[0], 0), (c[1], 1)]) {
            let jerk = &mut execution.max_jerk_mm_per_s3[axis];
            *jerk = jerk.max(6.0 * c[3].abs());
        }
        Ok(execution)
    }

    /// Adds the overshoot of the segments from `first` to `end` (exclusive), which all serve one dwell point; or of one
    /// segment that serves none.
    fn add_overshoot(&mut self, trajectory: &Trajectory, first: usize, end: usize) {
        for axis in 0..2 {
            let last = trajectory.segment(end - 1);
            let from = trajectory.coefficient_mm()[first][axis][0];
            let to = evaluate(&last.coefficient_mm[axis], last.duration_s);
            let beyond = (first..end).map(|k| {
                let segment = trajectory.segment(k);
                let r = range(&segment.coefficient_mm[axis], segment.duration_s);
                (r.max - from.max(to)).max(from.min(to) - r.min)
            });
            let beyond = beyond.fold(0.0, f64::max);
            self.overshoot_points[axis] += usize::from(beyond > OVERSHOOT_MM);
            self.max_overshoot_mm[axis] = self.max_overshoot_mm[axis].max(beyond);
        }
    }
}

/// Returns the dwell errors, s, of all points except those that are served with the tool off only.
fn dwell_errors(trajectory: &Trajectory, dwell: &DwellTime) -> Result<Vec<f64>, Invalid> {
    let n = dwell.dwell_s().len();
    let on_s = trajectory.served_s(n, |segment| segment.tool_on)?;
    let off_s = trajectory.served_s(n, |segment| !segment.tool_on)?;
    let served = (0..n).filter(|i| off_s[*i] <= 0.0 || on_s[*i] != 0.0);
    Ok(served.map(|i| on_s[i] - dwell.dwell_s()[i]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_overshoot_and_jerk_by_hand() {
        let x = |c: [f64; 4]| [c, [0.0; 4]];
        // Point 0: 0 to 1 in two pieces, by 0.25 too far in between. Point 1: a lift. Point 2: not
        // served. Then a brake.
        let t = Trajectory::new(
            vec![0.0, 1.0, 2.0, 3.0, 4.0],
            vec![
                x([0.0, 1.25, 0.0, 0.0]),
                x([1.25, -0.25, 0.0, 0.0]),
                x([1.0, 0.0, 0.0, 2.0]),
                x([3.0, 0.0, 0.0, 0.0]),
            ],
            vec![true, true, false, false],
            vec![Some(0), Some(0), Some(1), None],
        )
        .unwrap();
        let dwell = DwellTime::new(vec![1.5, 9.0, 0.25]).unwrap();
        let e = Execution::new(&t, Some(&dwell)).unwrap();
        assert_eq!(e.dwell_error_worst_s, Some(0.5));
        // Two points count: 0.5 s and -0.25 s.
        let rms = ((0.25 + 0.0625) / 2.0_f64).sqrt();
        assert!((e.dwell_error_rms_s.unwrap() - rms).abs() < 1e-15);
        assert_eq!((e.overshoot_points, e.max_overshoot_mm), ([1, 0], [0.25, 0.0]));
        assert_eq!(e.max_jerk_mm_per_s3, [12.0, 0.0]);
        assert_eq!(Execution::new(&t, None).unwrap().dwell_error_rms_s, None);
        let other = DwellTime::new(vec![1.0]).unwrap();
        let message = Execution::new(&t, Some(&other)).unwrap_err().to_string();
        assert!(message.contains("dwell_index[2]: is 1, the dwell times are 1"), "{message}");
    }
}
