//! The smooth motion of a machine that limits jerk: a spline whose acceleration too starts and ends at
//! zero, equation (5) of [`super`], slowed until every limit is kept.

use planish_types::{DwellTime, Limits, ToolPath, Trajectory, break_times};

use super::{
    axis::AxisProblem,
    timing::{MAX_ROUNDS, Timing, too_short, worst},
};
use crate::{ScheduleError, hermite::coefficients};

/// Number of rounds in which only the segments in excess are slowed. After that all segments are
/// slowed by the same factor k, which divides velocity, acceleration and jerk by k, k^2 and k^3, so
/// that the loop ends. Larger: hard cases run longer. Smaller: more of them are slowed as a whole.
const MAX_LOCAL_ROUNDS: usize = 200;

/// Motion along the spline of (5), and the number of rounds. `timing` is stretched until every limit
/// is kept; without `stretch` an excess is an error.
pub(super) fn motion(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    stretch: bool,
    timing: &mut Timing,
    axes: &[AxisProblem<'_>; 2],
) -> Result<(Trajectory, usize), ScheduleError> {
    let n = timing.kept.len();
    let parts: Vec<usize> = match n {
        1 => vec![4],
        _ => (0..n).map(|k| if k == 0 || k == n - 1 { 2 } else { 1 }).collect(),
    };
    for (h, parts) in timing.duration_s.iter_mut().zip(&parts) {
        *h = h.max(*parts as f64 * limits.min_segment_s());
    }
    // Segment of every piece.
    let of: Vec<usize> = (0..n).flat_map(|k| std::iter::repeat_n(k, parts[k])).collect();
    for rounds in 0.. {
        let pieces: Vec<f64> =
            of.iter().map(|k| timing.duration_s[*k] / parts[*k] as f64).collect();
        let break_time_s = break_times(&pieces);
        let u: Vec<f64> = break_time_s.windows(2).map(|w| w[1] - w[0]).collect();
        let solved = axes.each_ref().map(|a| smooth_from_rest(a, &timing.duration_s));
        let mut excess = vec![1.0_f64; n];
        for (problem, velocity) in &solved {
            for (k, e) in of.iter().zip(problem.excess(velocity, &u)) {
                excess[*k] = excess[*k].max(e);
            }
        }
        let (k, worst) = worst(&excess);
        if worst <= 1.0 {
            let mut position = path.point_mm()[0];
            let segments = (0..of.len()).map(|i| {
                let c = [0, 1].map(|a| {
                    let (problem, v) = &solved[a];
                    coefficients(position[a], problem.displacement_mm[i], v[i], v[i + 1], u[i])
                });
                let next = i + 1;
                position = if next == of.len() || of[next] != of[i] {
                    path.point_mm()[timing.kept[of[i]] + 1]
                } else {
                    [0, 1].map(|a| position[a] + solved[a].0.displacement_mm[i])
                };
                c
            });
            let segments = segments.collect();
            let trajectory = Trajectory::new(
                break_time_s,
                segments,
                of.iter().map(|k| path.tool_on()[timing.kept[*k]]).collect(),
                of.iter().map(|k| Some(timing.kept[*k])).collect(),
            )?;
            return Ok((trajectory, rounds));
        }
        let segment = timing.kept[k];
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
    }
    unreachable!("the rounds have no end")
}

/// Pieces of the spline that starts and ends with v = a = 0, by (5): their displacements in
/// a problem of their own, and the velocities of their ends, mm/s.
fn smooth_from_rest(axis: &AxisProblem, h: &[f64]) -> (AxisProblem<'static>, Vec<f64>) {
    let (n, dp) = (h.len(), &axis.displacement_mm);
    if n == 1 {
        let (d, v) = (dp[0], dp[0] / h[0]);
        let parts = [1.0, 5.0, 5.0, 1.0].map(|part| part / 12.0 * d);
        return (axis.along(parts.to_vec()), vec![0.0, v, 2.0 * v, v, 0.0]);
    }
    // a-(i) = a+(i+1): elimination of the nodes 1 .. n-1.
    let mut v = vec![0.0; n + 1];
    let mut upper = vec![0.0; n + 1];
    for i in 1..n {
        let (a, b) = (h[i - 1], h[i]);
        // (5) at the ends, (2) else: the factors of v/h and of dp/h^2.
        let (own, mean) = if i == 1 { (6.0, 12.0) } else { (4.0, 6.0) };
        let (next, next_mean) = if i == n - 1 { (6.0, 12.0) } else { (4.0, 6.0) };
        let below = if i == 1 { 0.0 } else { 2.0 / a };
        let pivot = own / a + next / b - below * upper[i - 1];
        let g = mean * dp[i - 1] / (a * a) + next_mean * dp[i] / (b * b);
        upper[i] = if i == n - 1 { 0.0 } else { 2.0 / b / pivot };
        v[i] = (g - below * v[i - 1]) / pivot;
    }
    for i in (1..n).rev() {
        v[i] -= upper[i] * v[i + 1];
    }
    // j tau^3/6 and j tau^2/2 of the half at rest.
    let half = |dp: f64, v: f64, h: f64| {
        let tau = 0.5 * h;
        let outer = 0.25 * dp - v * tau / 12.0;
        (outer, 3.0 * outer / tau)
    };
    let (first, first_v) = half(dp[0], v[1], h[0]);
    let (last, last_v) = half(dp[n - 1], v[n - 1], h[n - 1]);
    let mut parts = vec![first, dp[0] - first];
    parts.extend(&dp[1..n - 1]);
    parts.extend([dp[n - 1] - last, last]);
    let mut velocity = vec![0.0, first_v];
    velocity.extend(&v[1..n]);
    velocity.extend([last_v, 0.0]);
    (axis.along(parts), velocity)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{hermite::accelerations, pvt::mode::Mode};
    use planish_types::{MachineFile, MachineFileAxis};

    /// The problem through `points` within limits that are never active.
    fn problem(points: &[f64]) -> AxisProblem<'static> {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 1e4,
            max_acceleration_mm_per_s2: 1e4,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x"), axis("y")];
        let limits =
            MachineFile { name: "m".into(), axes, min_segment_s: 0.0, ..MachineFile::default() }
                .checked()
                .unwrap();
        let displacement_mm = points.windows(2).map(|w| w[1] - w[0]).collect();
        AxisProblem::new(displacement_mm, Mode::Smooth, &limits.axes()[0])
    }

    #[test]
    fn one_segment_with_limited_jerk_by_hand() {
        // 1 mm in 4 s: j = 32 / 64, a(1) = 1/2, v(2) = 1/2.
        let (p, v) = smooth_from_rest(&problem(&[0.0, 1.0]), &[4.0]);
        for (found, expected) in v.iter().zip([0.0, 0.25, 0.5, 0.25, 0.0]) {
            assert!((found - expected).abs() < 1e-15, "{v:?}");
        }
        for (i, expected) in [(0.0, 0.5), (0.5, 0.0), (0.0, -0.5), (-0.5, 0.0)].iter().enumerate() {
            let a = accelerations(p.displacement_mm[i], v[i], v[i + 1], 1.0);
            assert!((a.0 - expected.0).abs() + (a.1 - expected.1).abs() < 1e-14, "{i}: {a:?}");
        }
    }

    #[test]
    fn with_limited_jerk_the_acceleration_is_continuous_from_zero_to_zero() {
        for n in 2..8 {
            let x: Vec<f64> = (0..=n).map(|i| f64::from((i * i * 7) % 11)).collect();
            let h: Vec<f64> = (0..n).map(|i| 0.5 + 0.1 * f64::from((i * 5) % 4)).collect();
            let (p, v) = smooth_from_rest(&problem(&x), &h);
            let mut u = vec![0.5 * h[0]; 2];
            u.extend(&h[1..h.len() - 1]);
            u.extend([0.5 * h[h.len() - 1]; 2]);
            assert_eq!((p.displacement_mm.len(), v.len()), (u.len(), u.len() + 1));
            let mut before = 0.0;
            for i in 0..u.len() {
                let (start, end) = accelerations(p.displacement_mm[i], v[i], v[i + 1], u[i]);
                // Rounding of accelerations up to 1e3 mm/s^2.
                assert!((start - before).abs() < 1e-11, "{n} {i}: {before} {start}");
                before = end;
            }
            assert!(before.abs() < 1e-11, "{n}: {before}");
        }
    }
}
