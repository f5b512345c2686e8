//! Constant acceleration along the path, at rest in every corner: within all limits.
//!
//! [`crate::constant_acceleration`] moves each axis by itself and goes beyond corners. Here the tool
//! stays on the path. Along a segment of length `L` and direction `t`, with
//!
//! ```text
//! v_max = min over axes v_axis / |t_axis|,   a = min over axes a_axis / |t_axis|
//! ```
//!
//! it accelerates or brakes with `a`, or keeps its velocity. It is at rest where the direction changes,
//! where it stands, and at the ends. From `v0` a segment takes its dwell time `d` by Eqs 5 and 6 of
//! the source: `a` for a while, then `v` to the end. Look-ahead bounds the velocity at every node, so
//! that the tool can brake for the next nodes and no segment ends early:
//!
//! ```text
//! V_i <= v_max on both sides,   V_i^2 <= V_{i+1}^2 + 2 a L                                     (1)
//! V_i <= L/d + a d/2  where  d^2 < 2 L/a,  else  V_i^2 <= 2 a L
//! ```
//!
//! If Eqs 5 and 6 would end faster than `V`, the segment ends with `v1 = V` and has a velocity `w` of
//! its own in between,
//!
//! ```text
//! w^2 - (a d + v0 + v1) w + a L + (v0^2 + v1^2)/2 = 0        faster than both ends             (2)
//! w = (L - (v0^2 - v1^2)/(2 a)) / (d - (v0 - v1)/a)          between them
//! ```
//!
//! and if the machine cannot do that in the time `d`, the segment takes the least time. Dwell times
//! are kept or exceeded, never cut; the report has the additional time. Lifts are links, rest to rest.
//!
//! Source: T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005, Eqs 3-7, for
//! the motion within a segment; stops and look-ahead are not in it.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | L | `Along::length_mm` | (n) | mm |
//! | d | `Along::duration_s` | (n) | s |
//! | V | `bound` | (n+1) | mm/s |

use planish_types::{DwellTime, Invalid, Limits, ToolPath, TrajectoryBuilder};
use serde::Serialize;

use crate::{
    Schedule, ScheduleError, Scheduled, Scheduler, check_lengths,
    constant_acceleration::least_piece_s,
    largest_along,
    shortest_cubic::{State, shortest_cubic},
};

/// Stops, late segments and lifts of a schedule.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StopAtCornersReport {
    /// Number of nodes between two segments with the tool on at which the tool comes to rest.
    pub stops: usize,
    /// Number of segments with the tool on that took longer than their dwell time.
    pub late_segments: usize,
    /// Sum of the times by which the late segments were longer than their dwell times, s.
    pub added_s: f64,
    /// Largest time by which a late segment was longer than its dwell time, s.
    pub largest_added_s: f64,
    /// Number of lifts: segments with the tool off, each a motion from rest to rest.
    pub lifts: usize,
    /// Sum of the times by which the lifts were longer than their dwell times, s.
    pub added_lifted_s: f64,
    /// Indices of the segments that have neither length nor dwell time; the motion leaves them out.
    pub dropped: Vec<usize>,
}

/// Scheduler `stop-at-corners`, which has no settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StopAtCornersSettings;

impl Scheduler for StopAtCornersSettings {
    fn name(&self) -> &'static str {
        "stop-at-corners"
    }

    fn schedule(
        &self,
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
    ) -> Result<Scheduled, ScheduleError> {
        Ok(Scheduled::compared(schedule(path, dwell, limits)?.trajectory, dwell)?)
    }
}

/// Largest step of the velocity at a node that the tool passes without a stop, mm/s: a tenth of the step that
/// `planish verify` takes for rounding. Larger: `planish verify` reports the steps. Smaller: the tool stops at nodes of
/// a straight line whose coordinates are rounded.
const STRAIGHT_MM_PER_S: f64 = 1e-7;

/// Schedules `path` within `limits`; every segment takes at least its dwell time.
///
/// # Errors
///
/// Refuses dwell times of another path, and a path without a length whose dwell times are all zero.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
) -> Result<Schedule<StopAtCornersReport>, ScheduleError> {
    check_lengths(path, dwell)?;
    let mut report = StopAtCornersReport::default();
    let all = (0..path.len()).map(|i| Along::new(path, dwell, limits, i));
    let (along, dropped): (Vec<Along>, Vec<Along>) =
        all.partition(|s| s.length_mm > 0.0 || s.dwell_s > 0.0);
    report.dropped = dropped.iter().map(|s| s.index).collect();
    let bound = bounds(&along);
    let mut motion = TrajectoryBuilder::default();
    let mut end_s = 0.0;
    let mut v = 0.0;
    for (k, segment) in along.iter().enumerate() {
        let i = segment.index;
        let start = path.point_mm()[i];
        if !segment.tool_on {
            let [from, to] = [start, path.point_mm()[i + 1]].map(State::at_rest);
            if let Some(link) = shortest_cubic(from, to, limits, segment.dwell_s) {
                motion.push(link.duration_s, link.coefficient_mm, false, Some(i));
                end_s += link.duration_s;
                report.lifts += 1;
                report.added_lifted_s += link.duration_s - segment.dwell_s;
            }
            continue;
        }
        report.stops += usize::from(bound[k] == 0.0 && k > 0 && along[k - 1].tool_on);
        let profile = segment.profile(v, bound[k + 1]);
        end_s += profile.duration_s();
        let least_s = least_piece_s(end_s);
        for [from, to] in profile.cuts(least_s) {
            let [s, ds, half] = profile.state(0.5 * (from + to), from);
            let c = [0, 1].map(|a| {
                let t = segment.direction[a];
                [start[a] + t * s, t * ds, t * half, 0.0]
            });
            motion.push(to - from, c, true, Some(i));
        }
        v = profile.velocity[2];
        let added = profile.duration_s() - segment.dwell_s;
        if added > least_s {
            report.late_segments += 1;
            report.added_s += added;
            report.largest_added_s = report.largest_added_s.max(added);
        }
    }
    if motion.is_empty() {
        return Err(Invalid::whole("dwell_s", "is zero everywhere", "give a dwell time").into());
    }
    Ok(Schedule { trajectory: motion.build()?, report })
}

/// Segment of the path: length, direction, dwell time, and limits along the direction.
#[derive(Clone, Copy, Debug)]
struct Along {
    index: usize,
    tool_on: bool,
    length_mm: f64,
    /// Unit vector along the segment; zero if the tool stands.
    direction: [f64; 2],
    dwell_s: f64,
    /// The dwell time, but not below the shortest segment that the controller accepts, s.
    duration_s: f64,
    max_velocity: f64,
    max_acceleration: f64,
}

impl Along {
    fn new(path: &ToolPath, dwell: &DwellTime, limits: &Limits, i: usize) -> Self {
        let d = path.displacement_mm(i);
        let length_mm = path.segment_length_mm(i);
        let direction = if length_mm > 0.0 { d.map(|d| d / length_mm) } else { [0.0; 2] };
        Self {
            index: i,
            tool_on: path.tool_on()[i],
            length_mm,
            direction,
            dwell_s: dwell.dwell_s()[i],
            duration_s: dwell.dwell_s()[i].max(limits.min_segment_s()),
            max_velocity: largest_along(direction, limits.max_velocity_mm_per_s()),
            max_acceleration: largest_along(direction, limits.max_acceleration_mm_per_s2()),
        }
    }

    /// Returns true if the motion goes on into the next segment without a stop.
    fn joins(&self, next: &Self) -> bool {
        let speed = self.max_velocity.min(next.max_velocity);
        let [x, y] = [0, 1].map(|a| (self.direction[a] - next.direction[a]).abs() * speed);
        self.tool_on
            && next.tool_on
            && self.length_mm > 0.0
            && next.length_mm > 0.0
            && x.max(y) <= STRAIGHT_MM_PER_S
    }

    /// Returns the largest velocity at the start of the segment, mm/s, by (1) of the module, with the velocity `next`
    /// at its end.
    fn bound(&self, next: f64) -> f64 {
        let l = self.length_mm;
        let d = self.duration_s;
        let a = self.max_acceleration;
        let in_time = if d * d < 2.0 * l / a { l / d + 0.5 * a * d } else { (2.0 * a * l).sqrt() };
        self.max_velocity.min((next * next + 2.0 * a * l).sqrt()).min(in_time)
    }

    /// Returns the velocity profile that starts at `v0` and ends at `bound` at most, mm/s.
    fn profile(&self, v0: f64, bound: f64) -> Profile {
        let l = self.length_mm;
        let d = self.duration_s;
        let a = self.max_acceleration;
        if l == 0.0 {
            return Profile { time_s: [0.0, d, 0.0], velocity: [0.0; 3] };
        }
        // Eqs 5 and 6: v = v0 + 2 r / (d + sqrt(d^2 - 2 |r| / a)),  r = L - v0 d
        let r = l - v0 * d;
        let root = d * d - 2.0 * r.abs() / a;
        if root >= 0.0 {
            let v = (v0 + 2.0 * r / (d + root.sqrt())).max(0.0);
            if v <= bound {
                let tau_s = ((v - v0).abs() / a).min(d);
                return Profile { time_s: [tau_s, d - tau_s, 0.0], velocity: [v0, v, v] };
            }
        } else if r < 0.0 {
            // By (1) only up to rounding: braking all the way.
            let v = (v0 * v0 - 2.0 * a * l).max(0.0).sqrt().min(bound);
            return Profile { time_s: [(v0 - v) / a, 0.0, 0.0], velocity: [v0, v, v] };
        }
        let v1 = bound.min((v0 * v0 + 2.0 * a * l).sqrt());
        // (2)
        let b = a * d + v0 + v1;
        let c = a * l + 0.5 * (v0 * v0 + v1 * v1);
        let fastest = self.max_velocity.min(c.sqrt()).max(v0).max(v1);
        let discriminant = b * b - 4.0 * c;
        let wanted =
            if discriminant > 0.0 { 2.0 * c / (b + discriminant.sqrt()) } else { f64::INFINITY };
        if wanted > fastest {
            // Late.
            let w = fastest;
            let [t0, t2] = [v0, v1].map(|v| (w - v).abs() / a);
            let rest_mm = l - 0.5 * ((v0 + w) * t0 + (w + v1) * t2);
            return Profile { time_s: [t0, rest_mm.max(0.0) / w, t2], velocity: [v0, w, v1] };
        }
        let w = if wanted >= v0.max(v1) {
            wanted
        } else {
            // Where it brakes all the way and then waits, w is 0.
            let coast_mm = l - (v0 * v0 - v1 * v1) / (2.0 * a);
            let coast_s = d - (v0 - v1) / a;
            let w = if coast_s > 0.0 { coast_mm / coast_s } else { v0.max(v1) };
            w.clamp(v0.min(v1), v0.max(v1))
        };
        let [t0, t2] = [v0, v1].map(|v| (w - v).abs() / a);
        Profile { time_s: [t0, (d - t0 - t2).max(0.0), t2], velocity: [v0, w, v1] }
    }
}

/// Returns the largest velocities at all nodes (n+1), mm/s, by (1) of the module, computed from the end backwards.
fn bounds(along: &[Along]) -> Vec<f64> {
    let mut bound = vec![0.0; along.len() + 1];
    for i in (1..along.len()).rev() {
        if along[i - 1].joins(&along[i]) {
            bound[i] = along[i].bound(bound[i + 1]).min(along[i - 1].max_velocity);
        }
    }
    bound
}

/// Velocity along a segment, in three phases. It changes from velocity[0] to velocity[1] in time_s[0], stays at
/// velocity[1] for time_s[1], and changes to velocity[2] in time_s[2].
#[derive(Clone, Copy, Debug, PartialEq)]
struct Profile {
    time_s: [f64; 3],
    velocity: [f64; 3],
}

impl Profile {
    fn duration_s(&self) -> f64 {
        self.time_s.iter().sum()
    }

    /// Returns start and end time of the phases, s, from 0 to the end of the segment. A phase of at most `least_s`
    /// joins the next one.
    fn cuts(&self, least_s: f64) -> Vec<[f64; 2]> {
        let end = self.duration_s();
        let mut cut = vec![0.0, self.time_s[0], self.time_s[0] + self.time_s[1], end];
        cut.dedup_by(|later, earlier| *later - *earlier <= least_s);
        if let Some(last) = cut.last_mut() {
            *last = end;
        }
        cut.windows(2).map(|w| [w[0], w[1]]).collect()
    }

    /// Returns the distance along the segment, mm, the velocity and half the acceleration at the time `t`. The time
    /// `during` selects the phase whose formula applies.
    fn state(&self, during: f64, t: f64) -> [f64; 3] {
        let [t0, t1, t2] = self.time_s;
        let [v0, w, v1] = self.velocity;
        if during < t0 {
            let half = 0.5 * slope(w - v0, t0);
            [t * (v0 + t * half), v0 + 2.0 * t * half, half]
        } else if during < t0 + t1 {
            [0.5 * (v0 + w) * t0 + w * (t - t0), w, 0.0]
        } else {
            let half = 0.5 * slope(v1 - w, t2);
            let u = t - t0 - t1;
            let before = 0.5 * (v0 + w) * t0 + w * t1;
            [before + u * (w + u * half), w + 2.0 * u * half, half]
        }
    }
}

/// Returns the acceleration of a change of velocity in some time; 0 if the time is 0.
fn slope(change: f64, time: f64) -> f64 {
    if time > 0.0 { change / time } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{MachineFile, MachineFileAxis};

    fn limits(v: f64, a: f64) -> Limits {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: v,
            max_acceleration_mm_per_s2: a,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        MachineFile {
            name: "m".into(),
            axes: vec![axis("x"), axis("y")],
            min_segment_s: 0.0,
            ..MachineFile::default()
        }
        .checked()
        .unwrap()
    }

    fn motion(
        points: &[[f64; 2]],
        dwell_s: &[f64],
        limits: &Limits,
    ) -> Schedule<StopAtCornersReport> {
        let n = dwell_s.len();
        let path = ToolPath::through(points.to_vec(), vec![true; n], vec![0; n]).unwrap();
        schedule(&path, &DwellTime::new(dwell_s.to_vec()).unwrap(), limits).unwrap()
    }

    #[test]
    fn one_segment_from_rest_to_rest_by_hand() {
        // 1 mm in 1 s at 8 mm/s^2: w^2 - 8 w + 8 = 0, w = 4 - sqrt 8, up and down in w / 8 each.
        let s = motion(&[[0.0; 2], [1.0, 0.0]], &[1.0], &limits(100.0, 8.0));
        let w = 4.0 - 8.0_f64.sqrt();
        let times = s.trajectory.break_time_s();
        for (found, expected) in times.iter().zip([0.0, w / 8.0, 1.0 - w / 8.0, 1.0]) {
            assert!((found - expected).abs() < 1e-15, "{times:?}");
        }
        let c = s.trajectory.coefficient_mm()[1][0];
        assert!((c[0] - w * w / 16.0).abs() < 1e-15 && (c[1] - w).abs() < 1e-15, "{c:?}");
        assert_eq!((s.report.added_s, s.report.late_segments, s.report.stops), (0.0, 0, 0));
        // Too short a time takes sqrt(4 L / a), or L / v + v / a where the velocity is limited.
        let s = motion(&[[0.0; 2], [1.0, 0.0]], &[0.1], &limits(100.0, 16.0));
        assert!((s.trajectory.total_time_s() - 0.5).abs() < 1e-15);
        assert!((s.report.added_s - 0.4).abs() < 1e-15 && s.report.late_segments == 1);
        let s = motion(&[[0.0; 2], [1.0, 0.0]], &[0.1], &limits(2.0, 16.0));
        assert!((s.trajectory.total_time_s() - 0.625).abs() < 1e-15);
    }

    #[test]
    fn it_stops_in_corners_and_goes_on_along_lines() {
        let points = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [2.0, 0.0], [2.0, 0.0]];
        let s = motion(&points, &[0.5; 5], &limits(10.0, 100.0));
        // The corner, the reversal and the point it stands on; not the node on the line.
        assert_eq!((s.report.stops, s.report.added_s), (3, 0.0));
        let at = |time_s: f64| {
            let t = &s.trajectory;
            let i = t.break_time_s().partition_point(|b| *b <= time_s).clamp(1, t.len()) - 1;
            (i, time_s - t.break_time_s()[i])
        };
        for (node, moving) in [(1, true), (2, false), (3, false), (4, false)] {
            let (i, u) = at(0.5 * f64::from(node));
            let p = s.trajectory.segment(i).position_mm(u);
            let speed = s.trajectory.coefficient_mm()[i].map(|c| c[1] + 2.0 * c[2] * u);
            let expected = points[node as usize];
            assert!((p[0] - expected[0]).abs() + (p[1] - expected[1]).abs() < 1e-12, "{p:?}");
            assert_eq!(speed[0].hypot(speed[1]) > 1.0, moving, "node {node}: {speed:?}");
        }
    }

    #[test]
    fn it_brakes_to_the_very_end_and_waits_there() {
        // 4 mm/s and 8 mm/s^2: 1 mm and half a second to rest, of three seconds.
        let along = Along {
            index: 0,
            tool_on: true,
            length_mm: 1.0,
            direction: [1.0, 0.0],
            dwell_s: 3.0,
            duration_s: 3.0,
            max_velocity: 10.0,
            max_acceleration: 8.0,
        };
        let profile = along.profile(4.0, 0.0);
        assert_eq!(profile, Profile { time_s: [0.5, 2.5, 0.0], velocity: [4.0, 0.0, 0.0] });
        // Braking from a little less leaves the rest of the way for the rest of the time.
        let v0 = 3.999_999_999_999;
        let profile = along.profile(v0, 0.0);
        assert!((profile.duration_s() - 3.0).abs() < 1e-15, "{profile:?}");
    }

    #[test]
    fn it_brakes_ahead_of_a_slow_segment_and_is_never_early() {
        // 10 mm at 20 mm/s, then 0.1 mm in 2 s and in 0.05 s: braking from 20 mm/s takes 2 mm.
        let points = [[0.0, 0.0], [10.0, 0.0], [10.1, 0.0], [10.2, 0.0]];
        let dwell_s = [0.6, 2.0, 0.05];
        let s = motion(&points, &dwell_s, &limits(30.0, 100.0));
        let served = s.trajectory.served_s(3, |_| true).unwrap();
        for (served, dwell_s) in served.iter().zip(dwell_s) {
            assert!(*served >= dwell_s - 1e-15, "{served} {dwell_s}");
        }
        let late: f64 = served.iter().zip(dwell_s).map(|(s, d)| s - d).sum();
        assert!((late - s.report.added_s).abs() < 1e-14, "{late} {}", s.report.added_s);
    }
}
