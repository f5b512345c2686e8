//! A motion for the report page: points to draw, and exact ranges of velocity, acceleration and jerk.
//!
//! If there are more segments than the screen needs, neighbours form groups. A point is the end of a group, a range
//! is that of all its segments, so no peak is lost.

use planish_numerics::polynomial::{derivative, range};
use planish_types::{DwellTime, ToolPath, Trajectory};

/// Smallest gap between the ends of two segments that is drawn as a jump, mm. Larger: jumps are drawn as lines.
/// Smaller: rounding is drawn as a jump. Chosen far above rounding, and far below a pixel.
const JUMP_MM: f64 = 1e-6;

/// Largest number of points that are drawn per segment. Larger: larger pages. Smaller: cubics with visible corners.
/// Chosen: enough for a cubic on the screen.
const MOST_PER_SEGMENT: usize = 4;

/// Points along a motion, to draw it as a line in colours of the speed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SpeedLine {
    /// Points of the motion [x, y], mm.
    pub point_mm: Vec<[f64; 2]>,
    /// Times of the points from the start of the motion, s.
    pub time_s: Vec<f64>,
    /// Mean speed between the previous point and this one, mm/s; NaN after a jump and at the start.
    pub speed_mm_per_s: Vec<f64>,
    /// Number of segments between two points; 1 if a segment has one or more points.
    pub every: usize,
}

/// Returns about `most` points along a motion: up to `MOST_PER_SEGMENT` per segment, or the last of every group of
/// segments. A jump adds a point.
pub fn line(t: &Trajectory, most: usize) -> SpeedLine {
    let every = t.len().div_ceil(most.max(1));
    let per_segment = (most / t.len()).clamp(1, MOST_PER_SEGMENT);
    let start_s = t.break_time_s()[0];
    let mut line = SpeedLine { every, ..SpeedLine::default() };
    let mut push = |p: [f64; 2], time_s: f64, speed: f64| {
        line.point_mm.push(p);
        line.time_s.push(time_s);
        line.speed_mm_per_s.push(speed);
    };
    let mut place = t.segment(0).position_mm(0.0);
    push(place, 0.0, f64::NAN);
    let mut length_mm = 0.0;
    let mut duration_s = 0.0;
    for (i, segment) in t.segments().enumerate() {
        let first = segment.position_mm(0.0);
        if distance(first, place) > JUMP_MM {
            push(first, segment.start_s - start_s, f64::NAN);
            place = first;
        }
        for j in 1..=per_segment {
            let u = segment.duration_s * j as f64 / per_segment as f64;
            let p = segment.position_mm(u);
            length_mm += distance(p, place);
            duration_s += segment.duration_s / per_segment as f64;
            place = p;
            if (i + 1) % every == 0 || i + 1 == t.len() {
                push(p, segment.start_s + u - start_s, length_mm / duration_s);
                length_mm = 0.0;
                duration_s = 0.0;
            }
        }
    }
    line
}

/// Returns the distance of two points in the plane, mm.
fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Smallest and largest value of one quantity on one axis, for each piece (group of segments) of a motion.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Envelope {
    /// Smallest value of the quantity in each piece, in its unit.
    pub low: Vec<f64>,
    /// Largest value of the quantity in each piece, in its unit.
    pub high: Vec<f64>,
}

impl Envelope {
    /// Returns the envelope over `count` columns of equal duration. `end_s` are the ends of the pieces, s from the
    /// start of the motion. Each column is (middle of its time, s; smallest and largest value of all pieces that
    /// reach into it).
    pub(crate) fn over_columns(&self, end_s: &[f64], count: usize) -> Vec<(f64, f64, f64)> {
        let total_s = end_s.last().copied().unwrap_or(0.0);
        let mut columns: Vec<(f64, f64, f64)> = (0..count)
            .map(|c| total_s * (c as f64 + 0.5) / count as f64)
            .map(|middle| (middle, f64::INFINITY, f64::NEG_INFINITY))
            .collect();
        let column = |t: f64| ((t / total_s * count as f64) as usize).min(count - 1);
        let mut start = 0.0;
        for (i, end) in end_s.iter().enumerate() {
            for (_, low, high) in &mut columns[column(start)..=column(*end)] {
                *low = low.min(self.low[i]);
                *high = high.max(self.high[i]);
            }
            start = *end;
        }
        columns
    }
}

/// Names of the quantities of [`Ranges::envelope`] on the report page.
pub const QUANTITIES: [&str; 3] = ["velocity", "acceleration", "jerk"];

/// Ranges of velocity, acceleration and jerk of a motion, for each piece (group of segments).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ranges {
    /// End of each piece from the start of the motion, s.
    pub end_s: Vec<f64>,
    /// Envelopes by quantity (velocity mm/s, acceleration mm/s^2, jerk mm/s^3), then by axis (x, y).
    pub envelope: [[Envelope; 2]; 3],
    /// Number of segments in a piece; the last piece may have fewer.
    pub every: usize,
}

/// Returns the ranges of a motion in at most `most` pieces; they are exact for each piece.
pub fn ranges(t: &Trajectory, most: usize) -> Ranges {
    let every = t.len().div_ceil(most.max(1));
    let mut ranges = Ranges { every, ..Ranges::default() };
    let start_s = t.break_time_s()[0];
    for first in (0..t.len()).step_by(every) {
        let last = (first + every).min(t.len());
        let mut low_high = [[(f64::INFINITY, f64::NEG_INFINITY); 2]; 3];
        for segment in (first..last).map(|i| t.segment(i)) {
            for axis in 0..2 {
                // v = p', a = p'', j = p'''
                let mut order = segment.coefficient_mm[axis];
                for reached in &mut low_high {
                    order = derivative(&order);
                    let r = range(&order, segment.duration_s);
                    reached[axis] = (reached[axis].0.min(r.min), reached[axis].1.max(r.max));
                }
            }
        }
        for (envelopes, reached) in ranges.envelope.iter_mut().zip(low_high) {
            for (envelope, (low, high)) in envelopes.iter_mut().zip(reached) {
                envelope.low.push(low);
                envelope.high.push(high);
            }
        }
        ranges.end_s.push(t.break_time_s()[last] - start_s);
    }
    ranges
}

/// Planned and executed times of the dwell points, for the report page.
#[derive(Clone, Debug, PartialEq)]
pub struct Dwell {
    /// Dwell points [x, y], mm.
    pub point_mm: Vec<[f64; 2]>,
    /// Planned dwell times, s.
    pub planned_s: Vec<f64>,
    /// Executed dwell times, s: duration of the segments that serve the point, with the tool on or off. `None` for a
    /// motion that names no dwell points, such as that of a program that was read back.
    pub executed_s: Option<Vec<f64>>,
    /// Number of dwell points of the plan per point in these lists: the first of every `every` points is kept.
    pub every: usize,
    /// Sum of |executed - planned| over all dwell points of the plan, s; `None` if the executed times are not known.
    pub total_error_s: Option<f64>,
}

/// Returns the times of at most `most` dwell points, every second, third ... of a longer plan. `None` if the plan has
/// another number of points than the path, or if the motion names a dwell point that the path does not have.
pub fn dwell(path: &ToolPath, plan: &DwellTime, t: &Trajectory, most: usize) -> Option<Dwell> {
    let n = path.len();
    if plan.dwell_s().len() != n {
        return None;
    }
    let names_points = t.dwell_index().iter().any(Option::is_some);
    let executed_s = if names_points { Some(t.served_s(n, |_| true).ok()?) } else { None };
    let every = n.div_ceil(most.max(1));
    let thin = |values: &[f64]| values.iter().step_by(every).copied().collect::<Vec<_>>();
    let total_error_s = executed_s
        .as_ref()
        .map(|executed_s| plan.dwell_s().iter().zip(executed_s).map(|(p, e)| (e - p).abs()).sum());
    Some(Dwell {
        point_mm: path.dwell_point_mm().iter().step_by(every).copied().collect(),
        planned_s: thin(plan.dwell_s()),
        total_error_s,
        executed_s: executed_s.as_deref().map(thin),
        every,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a motion p = (u^2, -u) mm for 2 s, which then jumps to (9, 9) mm and rests there for 1 s, `rests`
    /// times.
    fn motion(rests: usize) -> Trajectory {
        let mut c = vec![[[0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]];
        c.extend(vec![[[9.0, 0.0, 0.0, 0.0]; 2]; rests]);
        let mut times = vec![10.0, 12.0];
        times.extend((1..=rests).map(|i| 12.0 + i as f64));
        let n = c.len();
        Trajectory::new(times, c, vec![true; n], (0..n).map(Some).collect()).unwrap()
    }

    #[test]
    fn a_line_follows_the_cubic_and_shows_the_jump() {
        let l = line(&motion(1), 8);
        assert_eq!(l.time_s, [0.0, 0.5, 1.0, 1.5, 2.0, 2.0, 2.25, 2.5, 2.75, 3.0]);
        assert_eq!((l.point_mm[2], l.point_mm[4]), ([1.0, -1.0], [4.0, -2.0]));
        assert!(l.speed_mm_per_s[0].is_nan() && l.speed_mm_per_s[5].is_nan());
        assert_eq!(l.speed_mm_per_s[9], 0.0);
        // Chord from (0, 0) to (0.25, -0.5) in 0.5 s.
        assert!((l.speed_mm_per_s[1] - 0.25_f64.hypot(0.5) / 0.5).abs() < 1e-14);
        let few = line(&motion(9), 5);
        assert_eq!((few.every, few.time_s.last()), (2, Some(&11.0)));
        // Start, the jump, and the ends of five groups.
        assert_eq!(few.time_s.len(), 7);
    }

    #[test]
    fn ranges_are_exact_and_keep_the_peak_of_a_group() {
        for most in [1, 2, 10] {
            let r = ranges(&motion(9), most);
            assert_eq!(r.end_s.len(), most);
            assert_eq!(r.end_s.last(), Some(&11.0));
            let [velocity, acceleration, jerk] = &r.envelope;
            assert_eq!((velocity[0].low[0], velocity[0].high[0]), (0.0, 4.0));
            assert_eq!(velocity[1].low[0], -1.0);
            assert_eq!((acceleration[0].high[0], jerk[0].high[0]), (2.0, 0.0));
        }
    }

    #[test]
    fn columns_keep_every_peak() {
        let end_s: Vec<f64> = (1..=5000).map(f64::from).collect();
        let mut e = Envelope { low: vec![0.0; 5000], high: vec![1.0; 5000] };
        e.high[3333] = 9.0;
        e.low[7] = -4.0;
        let found = e.over_columns(&end_s, 900);
        assert_eq!(found.len(), 900);
        let ends = planish_draw::frame::range(found.iter().flat_map(|c| [c.1, c.2]));
        assert_eq!(ends, [-4.0, 9.0]);
        let one = Envelope { low: vec![1.0], high: vec![3.0] }.over_columns(&[2.0], 900);
        assert!(one.iter().all(|c| (c.1, c.2) == (1.0, 3.0)));
    }

    #[test]
    fn dwell_is_summed_over_the_segments_that_serve_a_point() {
        let points = vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]];
        let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
        let plan = DwellTime::new(vec![2.0, 2.5]).unwrap();
        let c = vec![[[0.0; 4]; 2]; 4];
        let t = |index: [Option<usize>; 4]| {
            Trajectory::new(vec![0.0, 1.0, 3.0, 4.0, 5.0], c.clone(), vec![true; 4], index.into())
                .unwrap()
        };
        let d = dwell(&path, &plan, &t([Some(0), Some(1), Some(0), None]), 10).unwrap();
        assert_eq!((d.executed_s, d.total_error_s), (Some(vec![2.0, 2.0]), Some(0.5)));
        // A program that was read back names no points: its times are not known, and not 0.
        let d = dwell(&path, &plan, &t([None; 4]), 10).unwrap();
        assert_eq!((d.planned_s, d.executed_s, d.total_error_s), (vec![2.0, 2.5], None, None));
        assert_eq!(dwell(&path, &plan, &t([Some(0), Some(1), Some(2), Some(0)]), 10), None);
        let short = DwellTime::new(vec![2.0]).unwrap();
        assert_eq!(dwell(&path, &short, &t([Some(0); 4]), 10), None);
    }
}
