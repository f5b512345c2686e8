//! The smooth motion of a machine that limits jerk: a spline whose acceleration too starts and ends at
//! zero, equation (5) of [`super`], slowed until every limit is kept.
//!
//! The spline has no freedom but its times. Where it leaves its path by more than the tolerance, it is cut at both ends
//! of the segment: at a cut node the velocity is one that keeps the tolerance (`near_path`), and the acceleration is
//! zero. Between two cuts the motion is the spline again, from v to v' at its ends, each with a free node at half the
//! time h of its first and of its last segment. With tau = h/2, the jerk j of the first half and the acceleration at
//! the inner end of the segment, where the velocity is w, are
//!
//! ```text
//! j = 3 dp / (2 tau^3) - 5 v / (2 tau^2) - w / (2 tau^2),   a- = 6 (v + w) / h - 12 dp / h^2       (6)
//! ```
//!
//! A segment between two cuts consists of thirds. Its velocity is the quadratic B-spline with the control values
//!
//! ```text
//! v0, v0, V, v1, v1,   V = 3 dp/h - v0 - v1                                                        (7)
//! ```
//!
//! so that a = 0 at both ends. V and the control points p0, p0 + v0 h/9, p0 + v0 h/3, p1 - v1 h/3, p1 - v1 h/9, p1 of
//! the position are those of the Hermite cubic, with one point more on each side of the hull. What keeps a Hermite
//! cubic near its path therefore keeps these thirds there, too. From rest to rest the quarters of (5) need less jerk.

use planish_types::{DwellTime, Limits, ToolPath, Trajectory, break_times};

use super::{
    axis::AxisProblem,
    near_path::NearPath,
    timing::{MAX_ROUNDS, Timing, too_short, worst},
};
use crate::{ScheduleError, hermite::coefficients};

/// Number of rounds that slow only the segments in excess. Later rounds slow all segments by the same factor k, which
/// divides velocity, acceleration and jerk by k, k^2 and k^3, so that the loop ends. Larger: hard cases run longer.
/// Smaller: more of them are slowed as a whole.
const MAX_LOCAL_ROUNDS: usize = 200;

/// Returns the motion along the spline of (5) of [`super`], the number of rounds, and the number of cuts. It lengthens
/// the times in `timing` until every limit is kept. An excess is an error without `stretch`, or after the largest
/// number of rounds.
pub(super) fn motion(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    stretch: bool,
    timing: &mut Timing,
    axes: &[AxisProblem<'_>; 2],
    near: &NearPath,
) -> Result<(Trajectory, usize, usize), ScheduleError> {
    let n = timing.segments.len();
    let mut is_cut = vec![false; n + 1];
    is_cut[0] = true;
    is_cut[n] = true;
    let mut rounds = 0;
    loop {
        for (k, h) in timing.duration_s.iter_mut().enumerate() {
            let least_parts = match (is_cut[k], is_cut[k + 1]) {
                (true, true) => 4.0,
                (false, false) => 1.0,
                _ => 2.0,
            };
            *h = h.max(least_parts * limits.min_segment_s());
        }
        let pieces = CutSegments::new(axes, near, &timing.duration_s, &is_cut);
        let more_cuts = pieces.cut_far_segments(near, &mut is_cut);
        if more_cuts {
            continue;
        }
        let mut excess = vec![1.0_f64; n];
        for axis in 0..2 {
            let problem = axes[axis].along(pieces.displacement_mm[axis].clone());
            let of_pieces = problem.excess(&pieces.velocity[axis], &pieces.duration_s);
            for (k, e) in pieces.segment.iter().zip(of_pieces) {
                excess[*k] = excess[*k].max(e);
            }
        }
        let (k, worst) = worst(&excess);
        if worst <= 1.0 {
            let cuts = is_cut.iter().filter(|cut| **cut).count() - 2;
            return Ok((pieces.trajectory(path, &timing.segments)?, rounds, cuts));
        }
        let segment = timing.segments[k];
        if !stretch {
            return Err(too_short(path, dwell, segment, worst));
        }
        if rounds > MAX_LOCAL_ROUNDS + MAX_ROUNDS {
            return Err(ScheduleError::StretchLimit { rounds, segment, excess: worst });
        }
        if rounds >= MAX_LOCAL_ROUNDS {
            excess.fill(worst);
        }
        timing.stretch(&excess);
        rounds += 1;
    }
}

/// Cubic pieces of a motion: the segments, of which those at cuts are divided.
struct CutSegments {
    /// Index of the segment to which every piece (m) belongs.
    segment: Vec<usize>,
    /// Times of the breaks between pieces (m+1), s; `duration_s` has their differences (m).
    break_time_s: Vec<f64>,
    duration_s: Vec<f64>,
    /// Displacement of every piece (m) along each axis, mm.
    displacement_mm: [Vec<f64>; 2],
    /// Velocity at every break (m+1) along each axis, mm/s.
    velocity: [Vec<f64>; 2],
}

impl CutSegments {
    /// Returns the pieces of the motion with the durations `h` (N), s, that is cut at the nodes for which `is_cut`
    /// (N+1) is true.
    fn new(axes: &[AxisProblem<'_>; 2], near: &NearPath, h: &[f64], is_cut: &[bool]) -> Self {
        let n = h.len();
        let free = axes.each_ref().map(|axis| match n {
            1 => vec![0.0; 2],
            _ => node_velocities(&axis.displacement_mm, h, [0.0; 2]),
        });
        let cuts: Vec<usize> = (0..=n).filter(|node| is_cut[*node]).collect();
        let mut pieces = Self {
            segment: Vec::new(),
            break_time_s: Vec::new(),
            duration_s: Vec::new(),
            displacement_mm: [Vec::new(), Vec::new()],
            velocity: [vec![0.0], vec![0.0]],
        };
        let mut times = Vec::new();
        for ends in cuts.windows(2) {
            let run = ends[0]..ends[1];
            let [from, to] = [ends[0], ends[1]].map(|node| {
                if node == 0 || node == n {
                    [0.0; 2]
                } else {
                    near.held(node, [free[0][node], free[1][node]], h)
                }
            });
            let parts: Vec<usize> = match run.len() {
                1 if from == [0.0; 2] && to == [0.0; 2] => vec![4],
                1 => vec![3],
                n => (0..n).map(|k| if k == 0 || k == n - 1 { 2 } else { 1 }).collect(),
            };
            for (k, parts) in run.clone().zip(&parts) {
                pieces.segment.extend(std::iter::repeat_n(k, *parts));
                times.extend(std::iter::repeat_n(h[k] / *parts as f64, *parts));
            }
            for a in 0..2 {
                let dp = &axes[a].displacement_mm[run.clone()];
                let h = &h[run.clone()];
                let (displacement, velocity) = match parts[0] {
                    4 => quarters(dp[0], h[0]),
                    3 => thirds(dp[0], h[0], [from[a], to[a]]),
                    _ => spline(dp, h, [from[a], to[a]]),
                };
                pieces.displacement_mm[a].extend(displacement);
                pieces.velocity[a].extend(velocity);
            }
        }
        pieces.break_time_s = break_times(&times);
        pieces.duration_s = pieces.break_time_s.windows(2).map(|w| w[1] - w[0]).collect();
        pieces
    }

    /// Marks a cut at both ends of every segment whose motion leaves the tolerance of the path. Returns true if there
    /// are new cuts.
    fn cut_far_segments(&self, near: &NearPath, is_cut: &mut [bool]) -> bool {
        let mut more = false;
        let mut first = 0;
        while first < self.segment.len() {
            let k = self.segment[first];
            let last = first + self.segment[first..].partition_point(|segment| *segment == k);
            let is_single = is_cut[k] && is_cut[k + 1];
            let mut start = [0.0; 2];
            let cubics = (first..last).map(|i| {
                let cubic = self.cubic(i, start);
                start = [0, 1].map(|a| start[a] + self.displacement_mm[a][i]);
                (cubic, self.duration_s[i])
            });
            if !is_single && !near.pieces_are_near(k, cubics) {
                is_cut[k] = true;
                is_cut[k + 1] = true;
                more = true;
            }
            first = last;
        }
        more
    }

    /// Returns the coefficients of piece `i`, which starts at the point `start`, mm.
    fn cubic(&self, i: usize, start: [f64; 2]) -> [[f64; 4]; 2] {
        [0, 1].map(|a| {
            let v = &self.velocity[a];
            let dp = self.displacement_mm[a][i];
            coefficients(start[a], dp, v[i], v[i + 1], self.duration_s[i])
        })
    }

    /// Returns the pieces as a trajectory; `timed` has the indices of their segments in `path`.
    fn trajectory(self, path: &ToolPath, timed: &[usize]) -> Result<Trajectory, ScheduleError> {
        let segment_of = &self.segment;
        let mut position = path.point_mm()[0];
        let segments = (0..segment_of.len()).map(|i| {
            let cubic = self.cubic(i, position);
            let next = i + 1;
            position = if next == segment_of.len() || segment_of[next] != segment_of[i] {
                path.point_mm()[timed[segment_of[i]] + 1]
            } else {
                [0, 1].map(|a| position[a] + self.displacement_mm[a][i])
            };
            cubic
        });
        let segments = segments.collect();
        Ok(Trajectory::new(
            self.break_time_s,
            segments,
            segment_of.iter().map(|k| path.tool_on()[timed[*k]]).collect(),
            segment_of.iter().map(|k| Some(timed[*k])).collect(),
        )?)
    }
}

/// Returns the displacements of the four quarters of a segment from rest to rest, mm, and the velocities at their ends,
/// mm/s. The module [`super`] describes them after (5).
fn quarters(dp: f64, h: f64) -> (Vec<f64>, Vec<f64>) {
    let v = dp / h;
    let parts = [1.0, 5.0, 5.0, 1.0].map(|part| part / 12.0 * dp);
    (parts.to_vec(), vec![v, 2.0 * v, v, 0.0])
}

/// Returns the displacements of the thirds of a segment between two cuts, mm, and the velocities at their ends, mm/s,
/// by (7) of the module.
fn thirds(dp: f64, h: f64, [v0, v1]: [f64; 2]) -> (Vec<f64>, Vec<f64>) {
    let tau = h / 3.0;
    let middle = 3.0 * dp / h - v0 - v1;
    let [first, second] = [v0, v1].map(|v| 0.5 * (middle + v));
    let outer = [v0 + v0 + first, second + v1 + v1].map(|sum| tau * sum / 3.0);
    (vec![outer[0], dp - outer[0] - outer[1], outer[1]], vec![first, second, v1])
}

/// Returns the velocities at the nodes (N+1) of the spline along N > 1 segments that has the velocities `ends` and no
/// acceleration at its ends, mm/s.
fn node_velocities(dp: &[f64], h: &[f64], ends: [f64; 2]) -> Vec<f64> {
    let n = h.len();
    // a-(i) = a+(i+1): elimination of the nodes 1 .. n-1.
    let mut v = vec![0.0; n + 1];
    v[0] = ends[0];
    v[n] = ends[1];
    let mut upper = vec![0.0; n + 1];
    for i in 1..n {
        let a = h[i - 1];
        let b = h[i];
        // (6) at the ends, (2) else: the factors of v/h and of dp/h^2.
        let (own, mean) = if i == 1 { (6.0, 12.0) } else { (4.0, 6.0) };
        let (next, next_mean) = if i == n - 1 { (6.0, 12.0) } else { (4.0, 6.0) };
        let below = if i == 1 { 0.0 } else { 2.0 / a };
        let pivot = own / a + next / b - below * upper[i - 1];
        let mut g = mean * dp[i - 1] / (a * a) + next_mean * dp[i] / (b * b);
        if i == 1 {
            g -= 6.0 * ends[0] / a;
        }
        if i == n - 1 {
            g -= 6.0 * ends[1] / b;
        }
        upper[i] = if i == n - 1 { 0.0 } else { 2.0 / b / pivot };
        v[i] = (g - below * v[i - 1]) / pivot;
    }
    for i in (1..n).rev() {
        v[i] -= upper[i] * v[i + 1];
    }
    v
}

/// Returns the displacement of the outer half of the first or last segment, v tau + j tau^3/6, and the velocity at its
/// inner end, v + j tau^2/2, by (6) of the module. The acceleration is zero at the outer end, where the velocity is
/// `end`.
fn outer_half(dp: f64, end: f64, inner: f64, h: f64) -> (f64, f64) {
    let tau = 0.5 * h;
    let change = 0.25 * dp - (5.0 * end + inner) * tau / 12.0;
    (end * tau + change, end + 3.0 * change / tau)
}

/// Returns the displacements of the pieces of the spline along N > 1 segments, mm, and the velocities at their ends,
/// mm/s. The first and the last segment consist of two halves by (6) of the module.
fn spline(dp: &[f64], h: &[f64], ends: [f64; 2]) -> (Vec<f64>, Vec<f64>) {
    let n = h.len();
    let v = node_velocities(dp, h, ends);
    let (first, first_v) = outer_half(dp[0], ends[0], v[1], h[0]);
    let (last, last_v) = outer_half(dp[n - 1], ends[1], v[n - 1], h[n - 1]);
    let mut parts = vec![first, dp[0] - first];
    parts.extend(&dp[1..n - 1]);
    parts.extend([dp[n - 1] - last, last]);
    let mut velocity = vec![first_v];
    velocity.extend(&v[1..n]);
    velocity.extend([last_v, ends[1]]);
    (parts, velocity)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hermite::accelerations;

    /// Checks that the acceleration is zero at both ends, and continuous between.
    fn check(displacement: &[f64], velocity: &[f64], times: &[f64], start: f64) {
        assert_eq!((displacement.len(), velocity.len()), (times.len(), times.len()));
        let (mut before, mut from) = (0.0, start);
        for ((dp, to), h) in displacement.iter().zip(velocity).zip(times) {
            let (start, end) = accelerations(*dp, from, *to, *h);
            // Rounding of accelerations up to 1e3 mm/s^2.
            assert!((start - before).abs() < 1e-10, "{before} {start}");
            (before, from) = (end, *to);
        }
        assert!(before.abs() < 1e-10, "{before}");
    }

    #[test]
    fn one_segment_with_limited_jerk_by_hand() {
        // 1 mm in 4 s: j = 32 / 64, a(1) = 1/2, v(2) = 1/2.
        let (p, v) = quarters(1.0, 4.0);
        for (found, expected) in v.iter().zip([0.25, 0.5, 0.25, 0.0]) {
            assert!((found - expected).abs() < 1e-15, "{v:?}");
        }
        check(&p, &v, &[1.0; 4], 0.0);
        let a = accelerations(p[0], 0.0, v[0], 1.0);
        assert!((a.1 - 0.5).abs() < 1e-14, "{a:?}");
    }

    #[test]
    fn with_limited_jerk_the_acceleration_is_continuous_from_zero_to_zero() {
        for n in 2..8 {
            let x: Vec<f64> = (0..=n).map(|i| f64::from((i * i * 7) % 11)).collect();
            let dp: Vec<f64> = x.windows(2).map(|w| w[1] - w[0]).collect();
            let h: Vec<f64> = (0..n).map(|i| 0.5 + 0.1 * f64::from((i * 5) % 4)).collect();
            let mut u = vec![0.5 * h[0]; 2];
            u.extend(&h[1..h.len() - 1]);
            u.extend([0.5 * h[h.len() - 1]; 2]);
            for ends in [[0.0; 2], [1.5, -0.5]] {
                let (p, v) = spline(&dp, &h, ends);
                assert_eq!(v[v.len() - 1], ends[1]);
                check(&p, &v, &u, ends[0]);
                let sum: f64 = p.iter().sum();
                assert!((sum - x[x.len() - 1] + x[0]).abs() < 1e-12, "{sum}");
            }
        }
    }

    #[test]
    fn thirds_have_no_acceleration_at_their_ends_and_the_hull_of_the_hermite_cubic() {
        let (dp, h) = (2.0, 0.6);
        for ends in [[0.0; 2], [3.0, 5.0], [-1.0, 4.0]] {
            let (p, v) = thirds(dp, h, ends);
            check(&p, &v, &[0.2; 3], ends[0]);
            assert!((p.iter().sum::<f64>() - dp).abs() < 1e-15);
            // Not beyond the control points of the Hermite cubic.
            let hull = [0.0, ends[0] * h / 3.0, dp - ends[1] * h / 3.0, dp];
            let [low, high] = [
                hull.iter().copied().fold(0.0, f64::min),
                hull.iter().copied().fold(0.0, f64::max),
            ];
            let (mut start, mut from) = (0.0, ends[0]);
            for (dp, to) in p.iter().zip(&v) {
                let c = coefficients(start, *dp, from, *to, 0.2);
                for k in 0..=50 {
                    let x = planish_numerics::polynomial::evaluate(&c, 0.004 * f64::from(k));
                    assert!(x >= low - 1e-15 && x <= high + 1e-15, "{ends:?}: {x}");
                }
                (start, from) = (start + dp, *to);
            }
        }
    }
}
