//! One constant acceleration, then constant velocity, in every segment.
//!
//! Each axis starts with the end velocity `v0` of the previous segment. It moves by the displacement `s`
//! in the time `d`: first with the full acceleration `a = +-a_max` for a time `tau`, then with the
//! constant velocity `v`. With the distance `r = s - v0 d` that the velocity `v0` alone would miss:
//!
//! ```text
//! a = sign(r) a_max
//! v = v0 + a d - sign(a) sqrt(a^2 d^2 - 2 a r),   tau = (v - v0) / a      if 2 |r| <= a_max d^2   (1)
//! ```
//!
//! Otherwise the time is too short for the machine. If the axis comes too late, it takes
//!
//! ```text
//! v = sign(s) sqrt(v0^2 + 2 a s),   d' = (v - v0) / a > d                                         (2)
//! ```
//!
//! Where `|v|` of (1) or (2) is above the limit `v_max`, the axis accelerates to it and keeps it until it is there:
//!
//! ```text
//! v = sign(a) v_max,   tau = (v - v0) / a,   d' = tau + (s - (v0 + v) tau / 2) / v > d            (3)
//! ```
//!
//! Both axes take the longer of their times. If an axis cannot brake in time, it goes too far, by `|r| - a_max d^2
//! / 2`, and the next segment starts from there. There is no look-ahead. So velocity and acceleration are within
//! the limits, but the motion leaves the path and takes longer than the dwell times. Lifts (tool off) are links
//! within all limits that end at rest. The motion ends with a brake to rest, tool off.
//!
//! Source: T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005, Eqs 3-7,
//! with signed accelerations and the sign of the displacement on the root of Eq. 7. Two things are built otherwise:
//!
//! * The source sets v to v_max where it is above. (3) adds the time that the axis then needs to its control point.
//! * By Eq. 7 an axis that brakes too late arrives early, and could begin its next segment early. But two
//!   axes share the time of a segment. So here the axis keeps braking until the other one arrives, and
//!   goes too far.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | s | displacement of the segment | (n) | mm |
//! | d | its dwell time | (n) | s |
//! | v0, v | velocity before and after | (n) | mm/s |

use planish_types::{DwellTime, Invalid, Limits, ToolPath, TrajectoryBuilder};
use serde::Serialize;

use crate::{
    Schedule, ScheduleError, Scheduled, Scheduler, check_lengths,
    shortest_cubic::{State, shortest_cubic},
};

/// Numbers of late segments, missed control points, overshoots and lifts of a schedule.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ConstantAccelerationReport {
    /// Number of segments with the tool on that took longer than their dwell time.
    pub late_segments: usize,
    /// Sum of the times by which the late segments were longer than their dwell times, s; lifts are counted apart.
    pub added_s: f64,
    /// Largest time by which a late segment was longer than its dwell time, s.
    pub largest_added_s: f64,
    /// Number of segments, per axis, that did not end at their control point because the axis could not brake in time.
    pub missed_points: [usize; 2],
    /// Largest distance between the end of a segment and its control point, per axis, mm.
    pub largest_missed_mm: [f64; 2],
    /// Number of segments, per axis, in which the axis left the interval between its ends by more than [`OVERSHOOT_MM`]
    /// = 1 nm.
    pub overshoot_segments: [usize; 2],
    /// Number of segments, per axis, in which the axis left that interval by more than [`VISIBLE_OVERSHOOT_MM`] = 1 um.
    pub visible_overshoot_segments: [usize; 2],
    /// Largest distance of an axis from the interval between the ends of its segment, per axis, mm.
    pub largest_overshoot_mm: [f64; 2],
    /// Number of lifts: segments with the tool off, each a motion that ends at rest.
    pub lifts: usize,
    /// Sum of the times by which the lifts were longer than their dwell times, s.
    pub added_lifted_s: f64,
    /// Duration of the brake at the end of the motion, s.
    pub brake_s: f64,
    /// Indices of the segments that the motion leaves out. They have no dwell time, and the tool is already at their
    /// end (to rounding if it is off).
    pub dropped: Vec<usize>,
}

/// Scheduler `constant-acceleration`, which has no settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConstantAccelerationSettings;

impl Scheduler for ConstantAccelerationSettings {
    fn name(&self) -> &'static str {
        "constant-acceleration"
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

/// Motion of one axis in one segment: a constant acceleration from the start, then a constant velocity.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Phase {
    /// Signed acceleration, mm/s^2.
    acceleration: f64,
    /// Time of the acceleration (tau), s.
    tau_s: f64,
    /// Time of the whole segment (d), s.
    duration_s: f64,
    /// Velocity at the end of the acceleration and for the rest of the segment, mm/s.
    velocity: f64,
}

/// Schedules `path` with the times `dwell` and the full accelerations of `limits`.
///
/// # Errors
///
/// Refuses dwell times of another path, and a path without a length whose dwell times are all zero.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
) -> Result<Schedule<ConstantAccelerationReport>, ScheduleError> {
    check_lengths(path, dwell)?;
    let v_max = limits.max_velocity_mm_per_s();
    let a_max = limits.max_acceleration_mm_per_s2();
    let mut report = ConstantAccelerationReport::default();
    let mut motion = TrajectoryBuilder::default();
    let mut position = path.point_mm()[0];
    let mut velocity = [0.0; 2];
    for (i, &dwell_s) in dwell.dwell_s().iter().enumerate() {
        let target = path.point_mm()[i + 1];
        let s = [0, 1].map(|a| target[a] - position[a]);
        if !path.tool_on()[i] {
            let from = State { position_mm: position, velocity_mm_per_s: velocity };
            let to = State::at_rest(target);
            // Without dwell time and but for rounding at its end already, it would vanish too.
            let link = shortest_cubic(from, to, limits, dwell_s)
                .filter(|l| l.duration_s > least_piece_s(motion.end_s() + l.duration_s));
            match link {
                Some(link) => {
                    motion.push(link.duration_s, link.coefficient_mm, false, Some(i));
                    report.lifts += 1;
                    report.added_lifted_s += link.duration_s - dwell_s;
                }
                None => report.dropped.push(i),
            }
            position = target;
            velocity = [0.0; 2];
            continue;
        }
        if dwell_s == 0.0 && s == [0.0; 2] {
            report.dropped.push(i);
            continue;
        }
        let phases = coupled(s, velocity, dwell_s, v_max, a_max);
        let duration_s = phases[0].duration_s;
        let start = State { position_mm: position, velocity_mm_per_s: velocity };
        add(&mut motion, start, phases, duration_s, path.tool_on()[i], Some(i));
        for axis in 0..2 {
            let p = &phases[axis];
            position[axis] += p.travel(velocity[axis], duration_s);
            let from = start.position_mm[axis];
            let v0 = start.velocity_mm_per_s[axis];
            report.overshoot(axis, p, v0, [from, target[axis]], duration_s);
            report.missed(axis, position[axis] - target[axis]);
            if (position[axis] - target[axis]).abs() <= ROUNDING_MM {
                position[axis] = target[axis];
            }
            velocity[axis] = p.velocity;
        }
        let added = duration_s - dwell_s;
        if added > 0.0 {
            report.late_segments += 1;
            report.added_s += added;
            report.largest_added_s = report.largest_added_s.max(added);
        }
    }
    report.brake_s = (0..2).map(|a| velocity[a].abs() / a_max[a]).fold(0.0, f64::max);
    if report.brake_s > 0.0 {
        let brake = [0, 1].map(|a| Phase {
            acceleration: -a_max[a].copysign(velocity[a]),
            tau_s: velocity[a].abs() / a_max[a],
            duration_s: report.brake_s,
            velocity: 0.0,
        });
        let from = State { position_mm: position, velocity_mm_per_s: velocity };
        add(&mut motion, from, brake, report.brake_s, false, None);
    }
    if motion.is_empty() {
        return Err(Invalid::whole("dwell_s", "is zero everywhere", "give a dwell time").into());
    }
    Ok(Schedule { trajectory: motion.build()?, report })
}

/// Returns the shortest duration of a cubic piece that ends at the time `end_s`, s: 64 roundings of that time.
pub(crate) fn least_piece_s(end_s: f64) -> f64 {
    64.0 * f64::EPSILON * end_s
}

/// Distance from a control point up to which it counts as reached, mm: rounding of coordinates up to
/// 1e3 mm. Larger: real misses are not counted. Smaller: rounding counts as a miss.
const ROUNDING_MM: f64 = 1e-9;

/// Excursion beyond the ends of a segment above which it counts as an overshoot, mm: 1 nm, the
/// position tolerance of `planish verify`. Larger: fewer segments count. Smaller: more, without end:
/// after every stop an axis swings back by an amount that falls quadratically from one segment to the
/// next. On the reference maze 478 x and 628 y segments overshoot by more than 1 nm, 632 and 700 by
/// more than 1e-9 mm.
pub const OVERSHOOT_MM: f64 = 1e-6;

/// Overshoot above which a corner counts as missed, mm; a smaller one follows from an earlier missed corner. Larger:
/// missed corners are not counted. Smaller: overshoots that only follow from others count, too. On the reference maze
/// 379 segments per axis overshoot by more than this (docs/schedulers.md).
pub const VISIBLE_OVERSHOOT_MM: f64 = 1e-3;

/// Returns the motion of both axes in the same time: at least the dwell time `dwell_s`, and as long as the later axis
/// needs. The arguments are the displacements `s`, mm, the start velocities `v0`, mm/s, and the limits per axis.
fn coupled(
    s: [f64; 2],
    v0: [f64; 2],
    dwell_s: f64,
    v_max: [f64; 2],
    a_max: [f64; 2],
) -> [Phase; 2] {
    let mut duration_s = dwell_s;
    loop {
        let phases = [0, 1].map(|a| phase(s[a], v0[a], duration_s, v_max[a], a_max[a]));
        let later = phases[0].duration_s.max(phases[1].duration_s);
        if later <= duration_s {
            return phases;
        }
        duration_s = later;
    }
}

/// Returns the motion of one axis for the displacement `s`, mm, the start velocity `v0`, mm/s, and the time `d`, s. It
/// follows (1) of the module, (2) if the time is too short, or (3) if the result is too fast.
fn phase(s: f64, v0: f64, d: f64, v_max: f64, a_max: f64) -> Phase {
    let free = unlimited(s, v0, d, a_max);
    if free.velocity.abs() <= v_max {
        return free;
    }
    let v = v_max.copysign(free.velocity);
    let tau_s = ((v - v0) / free.acceleration).max(0.0);
    let duration_s = (tau_s + (s - 0.5 * (v0 + v) * tau_s) / v).max(d);
    Phase { tau_s, duration_s, velocity: v, ..free }
}

/// Returns the motion of one axis as [`phase`] does, by (1) or (2) of the module, but without the velocity limit. An
/// axis that cannot brake in time brakes to the end of the time `d`.
fn unlimited(s: f64, v0: f64, d: f64, a_max: f64) -> Phase {
    let r = s - v0 * d;
    if r.abs() <= 1e-15 * s.abs().max(1.0) {
        return Phase { acceleration: 0.0, tau_s: 0.0, duration_s: d, velocity: v0 };
    }
    let a = a_max.copysign(r);
    let radicand = a * a * d * d - 2.0 * a * r;
    if radicand >= 0.0 {
        // v = v0 + a d - sign(a) sqrt(a^2 d^2 - 2 a r), without the cancellation of a d:
        // v - v0 = 2 r / (d + sqrt(d^2 - 2 r / a))
        let change = 2.0 * r / (d + radicand.sqrt() / a_max);
        return Phase { acceleration: a, tau_s: change / a, duration_s: d, velocity: v0 + change };
    }
    // Too late: r and s point the same way, or the axis has to turn and come back.
    if r * s > 0.0 {
        let v = (v0 * v0 + 2.0 * a * s).sqrt().copysign(s);
        let duration_s = (v - v0) / a;
        Phase { acceleration: a, tau_s: duration_s, duration_s, velocity: v }
    } else {
        // Cannot brake in time: goes too far.
        Phase { acceleration: a, tau_s: d, duration_s: d, velocity: v0 + a * d }
    }
}

impl Phase {
    /// Returns the displacement after the time `t` from the start of the segment, mm, for the start velocity `v0`,
    /// mm/s.
    fn travel(&self, v0: f64, t: f64) -> f64 {
        let tau = self.tau_s.min(t);
        v0 * tau + 0.5 * self.acceleration * tau * tau + self.velocity * (t - tau)
    }
}

impl ConstantAccelerationReport {
    fn missed(&mut self, axis: usize, distance: f64) {
        if distance.abs() > ROUNDING_MM {
            self.missed_points[axis] += 1;
            self.largest_missed_mm[axis] = self.largest_missed_mm[axis].max(distance.abs());
        }
    }

    /// Measures by how much the axis left the interval between the start and the target `ends`, mm. The extremes are at
    /// the end of the acceleration, at its turning point, and at the ends.
    fn overshoot(&mut self, axis: usize, p: &Phase, v0: f64, ends: [f64; 2], duration_s: f64) {
        let turn = -v0 / p.acceleration;
        let turn = if turn > 0.0 && turn < p.tau_s { turn } else { 0.0 };
        let (low, high) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        let beyond = [turn, p.tau_s, duration_s]
            .map(|t| ends[0] + p.travel(v0, t))
            .map(|x| (low - x).max(x - high))
            .into_iter()
            .fold(0.0, f64::max);
        self.overshoot_segments[axis] += usize::from(beyond > OVERSHOOT_MM);
        self.visible_overshoot_segments[axis] += usize::from(beyond > VISIBLE_OVERSHOOT_MM);
        if beyond > ROUNDING_MM {
            self.largest_overshoot_mm[axis] = self.largest_overshoot_mm[axis].max(beyond);
        }
    }
}

/// Adds the cubics of a segment of both axes to `motion`, cut where either axis ends its acceleration.
fn add(
    motion: &mut TrajectoryBuilder,
    from: State,
    phases: [Phase; 2],
    duration_s: f64,
    tool_on: bool,
    dwell_index: Option<usize>,
) {
    let position = from.position_mm;
    let velocity = from.velocity_mm_per_s;
    let mut cuts = vec![0.0, phases[0].tau_s, phases[1].tau_s, duration_s];
    cuts.retain(|t| (0.0..=duration_s).contains(t));
    cuts.sort_by(f64::total_cmp);
    // Shorter pieces would vanish in the rounding of the break times; where segments are late,
    // that is not the rounding of the dwell times.
    let least_s = least_piece_s(motion.end_s() + duration_s);
    cuts.dedup_by(|later, earlier| *later - *earlier <= least_s);
    if let Some(last) = cuts.last_mut().filter(|t| **t < duration_s) {
        *last = duration_s;
    }
    for piece in cuts.windows(2) {
        let c = [0, 1].map(|a| {
            let p = &phases[a];
            let accelerating = 0.5 * (piece[0] + piece[1]) < p.tau_s;
            let v = if accelerating { velocity[a] + p.acceleration * piece[0] } else { p.velocity };
            let half = if accelerating { 0.5 * p.acceleration } else { 0.0 };
            [position[a] + p.travel(velocity[a], piece[0]), v, half, 0.0]
        });
        motion.push(piece[1] - piece[0], c, tool_on, dwell_index);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Velocity limit that no case reaches, mm/s.
    const FREE: f64 = 1e3;

    #[test]
    fn one_segment_from_rest_by_hand() {
        // v0 = 0, a = 2, d = 1, s = 1/2: v = 2 - sqrt(4 - 2)
        let p = phase(0.5, 0.0, 1.0, FREE, 2.0);
        assert!((p.velocity - (2.0 - 2.0_f64.sqrt())).abs() < 1e-15);
        assert!((p.travel(0.0, 1.0) - 0.5).abs() < 1e-15);
        assert!((p.tau_s - (1.0 - 0.5_f64.sqrt())).abs() < 1e-15);
        // The mirror image.
        assert_eq!(phase(-0.5, 0.0, 1.0, FREE, 2.0).velocity, -p.velocity);
        // Constant velocity.
        assert_eq!(phase(3.0, 1.5, 2.0, FREE, 9.0).velocity, 1.5);
    }

    #[test]
    fn too_late_takes_longer_in_both_directions() {
        // 1 mm from rest at 2 mm/s^2 takes 1 s.
        for sign in [1.0, -1.0] {
            let p = phase(sign, 0.0, 0.4, FREE, 2.0);
            assert!((p.duration_s - 1.0).abs() < 1e-15 && (p.velocity - 2.0 * sign).abs() < 1e-15);
            assert!((p.travel(0.0, p.duration_s) - sign).abs() < 1e-15);
        }
        // Moving the wrong way first: v0 = -1, s = 1: v = sqrt(1 + 4), d = (v + 1) / 2.
        let p = phase(1.0, -1.0, 0.1, FREE, 2.0);
        assert!((p.velocity - 5.0_f64.sqrt()).abs() < 1e-15);
        assert!((p.travel(-1.0, p.duration_s) - 1.0).abs() < 1e-14);
    }

    #[test]
    fn an_axis_that_would_be_too_fast_keeps_its_limit_and_comes_later() {
        // From rest to 2 mm/s at 4 mm/s^2: 0.5 s and 0.5 mm; the other 5.5 mm of 6 take 2.75 s.
        for sign in [1.0, -1.0] {
            for d in [0.4, 1.0, 2.0, 3.0] {
                let p = phase(6.0 * sign, 0.0, d, 2.0, 4.0);
                assert_eq!((p.velocity, p.tau_s, p.duration_s), (2.0 * sign, 0.5, 3.25), "{d}");
                assert!((p.travel(0.0, p.duration_s) - 6.0 * sign).abs() < 1e-15);
            }
            // In the time that it needs, and in more, it is as without a limit.
            let p = phase(6.0 * sign, 0.0, 4.0, 2.0, 4.0);
            assert_eq!(p, phase(6.0 * sign, 0.0, 4.0, FREE, 4.0));
            // At the limit already: no acceleration is left.
            let p = phase(6.0 * sign, 2.0 * sign, 1.0, 2.0, 4.0);
            assert_eq!((p.velocity, p.tau_s, p.duration_s), (2.0 * sign, 0.0, 3.0));
        }
        // 1 mm ahead at 2 mm/s and asked for 7 mm back: turns round in 0.5 s and 0.5 mm, is at -2 mm/s after 1 s.
        let p = phase(-7.0, 2.0, 1.5, 2.0, 4.0);
        assert_eq!((p.velocity, p.tau_s, p.duration_s), (-2.0, 1.0, 4.5));
    }

    #[test]
    fn too_fast_to_brake_goes_too_far() {
        // v0 = 10, d = 1, a = 2: 9 mm at least, asked for 5.
        let p = phase(5.0, 10.0, 1.0, FREE, 2.0);
        assert_eq!((p.travel(10.0, 1.0), p.velocity, p.duration_s), (9.0, 8.0, 1.0));
    }

    #[test]
    fn the_motion_is_continuous_and_ends_at_rest_at_every_join() {
        let points = vec![[0.0, 0.0], [1.0, 0.5], [1.0, 2.0], [-1.0, 2.5], [-1.2, 0.0]];
        let path = ToolPath::through(points, vec![true; 4], vec![0; 4]).unwrap();
        let dwell = DwellTime::new(vec![0.5, 0.7, 0.3, 1.0]).unwrap();
        let axis = |name: &str, a: f64| planish_types::MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 100.0,
            max_acceleration_mm_per_s2: a,
            max_jerk_mm_per_s3: None,
            ..planish_types::MachineFileAxis::default()
        };
        let limits = planish_types::MachineFile {
            name: "m".into(),
            axes: vec![axis("x", 20.0), axis("y", 15.0)],
            min_segment_s: 0.0,
            ..planish_types::MachineFile::default()
        }
        .checked()
        .unwrap();
        let s = schedule(&path, &dwell, &limits).unwrap();
        let t = &s.trajectory;
        let velocity = |i: usize, a: usize, u: f64| {
            let c = t.coefficient_mm()[i][a];
            c[1] + 2.0 * c[2] * u
        };
        for i in 0..t.len() {
            let h = t.segment(i).duration_s;
            for a in 0..2 {
                let (end, v_end) = (t.segment(i).position_mm(h)[a], velocity(i, a, h));
                let (next, v_next) = if i + 1 < t.len() {
                    (t.segment(i + 1).position_mm(0.0)[a], velocity(i + 1, a, 0.0))
                } else {
                    (end, 0.0)
                };
                // Rounding of positions of a few mm and velocities of a few 10 mm/s.
                assert!((end - next).abs() < 1e-12, "position after piece {i}");
                assert!(
                    (v_end - v_next).abs() < 1e-11,
                    "velocity after piece {i}: {v_end} {v_next}"
                );
            }
        }
        assert!(s.report.late_segments > 0 && s.report.brake_s > 0.0);
        assert_eq!(*t.dwell_index().last().unwrap(), None);
    }
}
