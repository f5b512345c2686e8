//! Motion that an abort leaves: that of a plan or of a log up to the abort, the stop, and the tool that stays on.
//!
//! After the abort at the time t_a, each axis slows down at a constant rate from its velocity v_k, and all of them rest
//! after the same time T. No axis exceeds its largest acceleration A_k:
//!
//! ```text
//! T = max_k |v_k| / A_k,      p_k(u) = p_k(t_a) + v_k u - v_k u^2 / (2 T),   0 <= u <= T        (1)
//! ```
//!
//! The tool removes for the time tau after the abort: along (1), then at rest.

use planish_types::{Invalid, Trajectory, TrajectoryBuilder};
use serde::Serialize;

/// Shortest segment that an abort leaves, s. Shorter remainders of a segment remove nothing that could be measured.
/// Larger: the motion ends before the abort. Smaller: break times may fall together.
const SHORTEST_S: f64 = 1e-9;
/// Number of times of a log at which its positions are compared with the plan. Larger: more time. Smaller: noise moves
/// the offset.
const COMPARED_TIMES: usize = 200;
/// Step of the offsets that are tried between log and plan, s. It has to be shorter than the time over a dwell point.
const OFFSET_STEP_S: f64 = 0.01;

/// Time of an abort, and for how long the tool stayed on after it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AbortSettings {
    /// Time of the abort since the start of the motion, s; `None` for the end of the motion.
    pub abort_s: Option<f64>,
    /// Time for which the tool removed after the abort, s; >= 0.
    pub tool_stays_on_s: f64,
}

/// Returns the motion that was executed: `motion` up to the abort, the stop (1) of the module with the largest
/// accelerations `[x, y]` in mm/s^2, and the tool at rest for the rest of its time.
///
/// # Errors
/// Refuses a time of the abort outside of the motion, a negative time of the tool, and an abort before anything ran.
pub fn aborted(
    motion: &Trajectory,
    settings: &AbortSettings,
    acceleration_mm_per_s2: [f64; 2],
) -> Result<Trajectory, Invalid> {
    let total_s = motion.total_time_s();
    let abort_s = settings.abort_s.unwrap_or(total_s);
    if !(0.0..=total_s).contains(&abort_s) {
        let problem = format!("is {abort_s}, and the motion takes {total_s:.6} s");
        return Err(Invalid::whole("abort_s", problem, "give a time of this motion"));
    }
    let tool_s = settings.tool_stays_on_s;
    if !(tool_s >= 0.0 && tool_s.is_finite()) {
        let problem = format!("is {tool_s}");
        return Err(Invalid::whole("tool_stays_on_s", problem, "give a time from 0"));
    }
    let mut executed = Executed::until(motion, abort_s);
    executed.stop(tool_s, acceleration_mm_per_s2);
    if executed.builder.is_empty() {
        let problem = "is 0, so nothing ran";
        return Err(Invalid::whole("abort_s", problem, "run the whole program"));
    }
    let trajectory = executed.builder.build()?;
    match motion.rate_factor() {
        Some(_) => trajectory.with_rate_factor(executed.rate_factor),
        None => Ok(trajectory),
    }
}

/// Motion that was executed so far, with its state at the end.
struct Executed {
    builder: TrajectoryBuilder,
    rate_factor: Vec<f64>,
    position_mm: [f64; 2],
    velocity_mm_per_s: [f64; 2],
    dwell_index: Option<usize>,
}

impl Executed {
    /// Returns the motion up to the time `abort_s` after its start.
    fn until(motion: &Trajectory, abort_s: f64) -> Self {
        let start_s = motion.break_time_s()[0];
        let first = motion.segment(0);
        let mut executed = Self {
            builder: TrajectoryBuilder::default(),
            rate_factor: Vec::new(),
            position_mm: first.position_mm(0.0),
            velocity_mm_per_s: [0.0; 2],
            dwell_index: first.dwell_index,
        };
        for segment in motion.segments() {
            let duration_s = segment.duration_s.min(abort_s + start_s - segment.start_s);
            if duration_s <= SHORTEST_S {
                break;
            }
            let c = *segment.coefficient_mm;
            executed.builder.push(duration_s, c, segment.tool_on, segment.dwell_index);
            executed.rate_factor.push(segment.rate_factor);
            executed.position_mm = segment.position_mm(duration_s);
            let u = duration_s;
            executed.velocity_mm_per_s = c.map(|c| c[1] + u * (2.0 * c[2] + 3.0 * u * c[3]));
            executed.dwell_index = segment.dwell_index.or(executed.dwell_index);
        }
        executed
    }

    /// Appends the stop, equation (1), and the rest with the tool on. The tool removes for `tool_s` s in all.
    fn stop(&mut self, tool_s: f64, acceleration_mm_per_s2: [f64; 2]) {
        let v = self.velocity_mm_per_s;
        let stop_s =
            (v[0].abs() / acceleration_mm_per_s2[0]).max(v[1].abs() / acceleration_mm_per_s2[1]);
        let on_s = tool_s.min(stop_s);
        let p = self.position_mm;
        let slowing = [0, 1].map(|k| [p[k], v[k], -v[k] / (2.0 * stop_s), 0.0]);
        self.push(on_s, slowing, true);
        let later = [0, 1].map(|k| {
            let [p, v, a, _] = slowing[k];
            [p + on_s * (v + on_s * a), v + 2.0 * on_s * a, a, 0.0]
        });
        self.push(stop_s - on_s, later, false);
        if stop_s > SHORTEST_S {
            self.position_mm = [0, 1].map(|k| p[k] + 0.5 * v[k] * stop_s);
        }
        let rest = self.position_mm.map(|p| [p, 0.0, 0.0, 0.0]);
        self.push(tool_s - on_s, rest, true);
    }

    /// Appends a segment that serves the last dwell point; leaves out one that is shorter than [`SHORTEST_S`].
    fn push(&mut self, duration_s: f64, coefficient_mm: [[f64; 4]; 2], tool_on: bool) {
        if duration_s > SHORTEST_S {
            self.builder.push(duration_s, coefficient_mm, tool_on, self.dwell_index);
            self.rate_factor.push(self.rate_factor.last().copied().unwrap_or(1.0));
        }
    }
}

/// Returns the motion `log` with the dwell points that `plan` serves at the same places.
///
/// The offset of the times of the log is the one within `most_offset_s` at which its positions are nearest to those of
/// the plan, in the sense of least squares.
///
/// # Errors
/// Never fails for a log that is a trajectory already.
pub fn with_dwell_points(
    log: &Trajectory,
    plan: &Trajectory,
    most_offset_s: f64,
) -> Result<Trajectory, Invalid> {
    let duration_s = log.total_time_s();
    let compared: Vec<(f64, [f64; 2])> = (0..COMPARED_TIMES)
        .map(|k| {
            let time_s = duration_s * (k as f64 + 0.5) / COMPARED_TIMES as f64;
            (time_s, position_mm(log, time_s))
        })
        .collect();
    let steps = (most_offset_s / OFFSET_STEP_S).round() as i64;
    let mut best = (f64::INFINITY, 0.0);
    for step in -steps..=steps {
        let offset_s = step as f64 * OFFSET_STEP_S;
        let mut squares = 0.0;
        for (time_s, p) in &compared {
            let q = position_mm(plan, time_s + offset_s);
            squares += (p[0] - q[0]).powi(2) + (p[1] - q[1]).powi(2);
        }
        if squares < best.0 {
            best = (squares, offset_s);
        }
    }
    let start_s = log.break_time_s()[0];
    let served = log.segments().map(|segment| {
        let middle_s = segment.start_s - start_s + 0.5 * segment.duration_s;
        plan.segment(index_at(plan, middle_s + best.1)).dwell_index
    });
    let trajectory = Trajectory::new(
        log.break_time_s().to_vec(),
        log.coefficient_mm().to_vec(),
        log.tool_on().to_vec(),
        served.collect(),
    )?;
    match log.rate_factor() {
        Some(factor) => trajectory.with_rate_factor(factor.to_vec()),
        None => Ok(trajectory),
    }
}

/// Returns the segment of the motion at `time_s` after its start; the first or the last one beyond its ends.
fn index_at(motion: &Trajectory, time_s: f64) -> usize {
    let breaks = motion.break_time_s();
    let after = breaks.partition_point(|b| b - breaks[0] <= time_s);
    after.saturating_sub(1).min(motion.len() - 1)
}

/// Returns the position [x, y], mm, at `time_s` after the start of the motion; that of its start or end beyond them.
fn position_mm(motion: &Trajectory, time_s: f64) -> [f64; 2] {
    let segment = motion.segment(index_at(motion, time_s));
    let u_s = time_s - (segment.start_s - motion.break_time_s()[0]);
    segment.position_mm(u_s.clamp(0.0, segment.duration_s))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Motion along x at 2 mm/s for 3 s, one dwell point per second.
    fn line() -> Trajectory {
        let mut builder = TrajectoryBuilder::default();
        for i in 0..3 {
            builder.push(
                1.0,
                [[2.0 * i as f64, 2.0, 0.0, 0.0], [5.0, 0.0, 0.0, 0.0]],
                true,
                Some(i),
            );
        }
        builder.build().unwrap()
    }

    fn settings(abort_s: f64, tool_stays_on_s: f64) -> AbortSettings {
        AbortSettings { abort_s: Some(abort_s), tool_stays_on_s }
    }

    #[test]
    fn the_stop_keeps_the_acceleration_and_the_tool_its_time() {
        // From 2 mm/s at 4 mm/s^2: 0.5 s and 0.5 mm.
        for (tool_s, total_s, on_s) in
            [(0.0, 2.0, 1.5), (0.2, 2.0, 1.7), (0.5, 2.0, 2.0), (1.5, 3.0, 3.0)]
        {
            let executed = aborted(&line(), &settings(1.5, tool_s), [4.0, 1e3]).unwrap();
            assert!((executed.total_time_s() - total_s).abs() < 1e-12, "{tool_s}");
            let on: f64 = executed.segments().filter(|s| s.tool_on).map(|s| s.duration_s).sum();
            assert!((on - on_s).abs() < 1e-12, "{tool_s}: {on}");
            let last = executed.segment(executed.len() - 1);
            let end = last.position_mm(last.duration_s);
            assert!((end[0] - 3.5).abs() < 1e-12 && end[1] == 5.0, "{end:?}");
            assert_eq!(last.dwell_index, Some(1));
        }
    }

    #[test]
    fn an_abort_outside_of_the_motion_or_before_it_is_refused() {
        for (abort_s, tool_s, part) in [
            (3.5, 0.0, "takes 3"),
            (-1.0, 0.0, "takes 3"),
            (f64::NAN, 0.0, "takes 3"),
            (1.0, -1.0, "tool_stays_on_s"),
            (0.0, 0.0, "nothing ran"),
        ] {
            let refusal = aborted(&line(), &settings(abort_s, tool_s), [4.0; 2]).unwrap_err();
            assert!(refusal.to_string().contains(part), "{refusal}");
        }
        // A tool that stays on at the start has removed something.
        let standing = aborted(&line(), &settings(0.0, 0.5), [4.0; 2]).unwrap();
        assert_eq!((standing.len(), standing.total_time_s()), (1, 0.5));
    }

    #[test]
    fn a_log_gets_the_dwell_points_of_its_plan_whenever_it_began() {
        let mut builder = TrajectoryBuilder::default();
        // The log begins 0.5 s after the plan.
        for i in 0..20 {
            builder.push(
                0.1,
                [[1.0 + 0.2 * f64::from(i), 2.0, 0.0, 0.0], [5.0, 0.0, 0.0, 0.0]],
                true,
                None,
            );
        }
        let log = with_dwell_points(&builder.build().unwrap(), &line(), 10.0).unwrap();
        let expected: Vec<_> = (0..20)
            .map(|i| {
                Some(if i < 5 {
                    0
                } else if i < 15 {
                    1
                } else {
                    2
                })
            })
            .collect();
        assert_eq!(log.dwell_index(), expected);
    }
}
