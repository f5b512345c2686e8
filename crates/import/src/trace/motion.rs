//! A motion through the samples of a log, with a cubic or a straight piece between two samples.
//!
//! Between the samples at t_i and t_(i+1), h_i apart, the position is the cubic with the velocities v_i and
//! v_(i+1) at its ends. Each velocity is that of the parabola through a sample and its two neighbours:
//!
//! ```text
//! v_i = (h_i s_(i-1) + h_(i-1) s_i) / (h_(i-1) + h_i),   s_i = (p_(i+1) - p_i) / h_i
//! ```
//!
//! with the end of the outermost parabola at both ends. Source: cubic Bessel interpolation, C. de Boor, A
//! Practical Guide to Splines (1978), chapter IV.
//!
//! Why cubic. The removal is a time integral, so noise of the samples averages out in either kind of piece.
//! The kinds differ in how they follow a motion that accelerates. A straight piece cuts its corner by a
//! h^2/12 on average, always to the inside: a systematic error of the removal of second order in h. The
//! error of the cubic is of fourth order. At 1 kHz both are below the noise; a log at 20 Hz shows the
//! difference (the tests print it). A straight piece also has a step in velocity at every sample. No
//! machine makes such steps, and the judge of limits would report them.
//!
//! Where samples are absent (a step longer than a given one) the motion is straight, and the parabolas on both
//! sides do not reach over the gap.

use planish_types::{Invalid, Trajectory};
use serde::Serialize;

/// Motion between two samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Between {
    /// The cubic with the velocities of the parabolas through three neighbours.
    #[default]
    Cubic,
    /// A straight line.
    Linear,
}

/// Returns the motion through samples [x, y] at `time_s`, s (n, ascending), straight where two are more than
/// `longest_step_s` apart. The tool is on everywhere, and no segment serves a dwell point. Refuses what makes no valid
/// trajectory, such as numbers that are not finite.
pub fn through(
    time_s: &[f64],
    position_mm: &[[f64; 2]],
    longest_step_s: f64,
    between: Between,
) -> Result<Trajectory, Invalid> {
    let [x, y] = [0, 1].map(|a| {
        let axis: Vec<f64> = position_mm.iter().map(|p| p[a]).collect();
        pieces(time_s, &axis, longest_step_s, between)
    });
    let coefficient_mm: Vec<[[f64; 4]; 2]> = x.into_iter().zip(y).map(|(x, y)| [x, y]).collect();
    let k = coefficient_mm.len();
    Trajectory::new(time_s.to_vec(), coefficient_mm, vec![true; k], vec![None; k])
}

/// Returns the cubics (n-1) of one axis between its samples at `time_s`, s (n, ascending). Each has the coefficients of
/// rising powers of the time since its first sample. Pieces longer than `longest_step_s` are straight.
pub fn pieces(
    time_s: &[f64],
    position: &[f64],
    longest_step_s: f64,
    between: Between,
) -> Vec<[f64; 4]> {
    let n = time_s.len();
    let mut pieces = Vec::with_capacity(n.saturating_sub(1));
    let mut start = 0;
    while start + 1 < n {
        // Samples start ..= end follow each other without a gap.
        let mut gaps = (start..n - 1).filter(|i| time_s[i + 1] - time_s[*i] > longest_step_s);
        let end = gaps.next().unwrap_or(n - 1);
        run(&time_s[start..=end], &position[start..=end], between, &mut pieces);
        if end + 1 < n {
            let h = time_s[end + 1] - time_s[end];
            pieces.push([position[end], (position[end + 1] - position[end]) / h, 0.0, 0.0]);
        }
        start = end + 1;
    }
    pieces
}

/// Appends the pieces between consecutive samples without a gap: times `time_s`, s, and positions `p` of one axis.
fn run(time_s: &[f64], p: &[f64], between: Between, pieces: &mut Vec<[f64; 4]>) {
    let n = time_s.len();
    if n < 2 {
        return;
    }
    let mut before = velocity(time_s, p, 0);
    for i in 0..n - 1 {
        let after = velocity(time_s, p, i + 1);
        let (t, s) = step(time_s, p, i);
        pieces.push(match between {
            // p(u) = p0 + v0 u + (3 s - 2 v0 - v1)/T u^2 + (v0 + v1 - 2 s)/T^2 u^3
            Between::Cubic => [
                p[i],
                before,
                (3.0 * s - 2.0 * before - after) / t,
                (before + after - 2.0 * s) / (t * t),
            ],
            Between::Linear => [p[i], s, 0.0, 0.0],
        });
        before = after;
    }
}

/// Returns the time between sample `i` and the next (h_i of the module), s, and the mean slope of `p` between them
/// (s_i), in the unit of `p` per s.
fn step(time_s: &[f64], p: &[f64], i: usize) -> (f64, f64) {
    let h = time_s[i + 1] - time_s[i];
    (h, (p[i + 1] - p[i]) / h)
}

/// Returns the velocity at sample `i`, in the unit of `p` per s: the slope there of the parabola through the three
/// nearest samples. Two samples have the slope of the line through them.
fn velocity(time_s: &[f64], p: &[f64], i: usize) -> f64 {
    let last = time_s.len() - 1;
    if last == 1 {
        return step(time_s, p, 0).1;
    }
    // The sample in the middle of the parabola.
    let middle = i.clamp(1, last - 1);
    let (h_before, s_before) = step(time_s, p, middle - 1);
    let (h_after, s_after) = step(time_s, p, middle);
    let v = inner(h_before, h_after, s_before, s_after);
    match i {
        // The parabola through the first three has the velocity 2 s_0 - v_1 at its beginning.
        0 => 2.0 * s_before - v,
        i if i == last => 2.0 * s_after - v,
        _ => v,
    }
}

/// Returns the velocity v_i of the module, from the times (s) and the mean slopes of the steps before and after the
/// sample.
fn inner(h_before: f64, h_after: f64, s_before: f64, s_after: f64) -> f64 {
    (h_after * s_before + h_before * s_after) / (h_before + h_after)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the largest distance of the pieces from x(t) = `of(t)` in their middles.
    fn error(of: fn(f64) -> f64, time_s: &[f64], between: Between) -> f64 {
        let p: Vec<[f64; 2]> = time_s.iter().map(|t| [of(*t), -of(*t)]).collect();
        let motion = through(time_s, &p, f64::INFINITY, between).unwrap();
        let middle = |s: planish_types::Segment<'_>| {
            let u = 0.5 * s.duration_s;
            let [x, y] = s.position_mm(u);
            // Rounding.
            assert!((x + y).abs() < 1e-12);
            (x - of(s.start_s + u)).abs()
        };
        motion.segments().map(middle).fold(0.0, f64::max)
    }

    fn uneven(n: usize) -> Vec<f64> {
        (0..=n).map(|i| (i as f64 + 0.3 * (i as f64 * 1.7).sin()) / n as f64).collect()
    }

    #[test]
    fn a_parabola_is_exact_and_a_sine_of_third_order() {
        let parabola = |t: f64| 1.0 - 2.0 * t + 3.0 * t * t;
        // Rounding of values up to 2 over short intervals.
        assert!(error(parabola, &uneven(20), Between::Cubic) < 1e-13);
        // Between two samples it is a line: off by 3 / 4 in the middle.
        assert!(error(parabola, &[0.0, 1.0], Between::Cubic) > 0.5);
        let sine = |t: f64| (5.0 * t).sin();
        let ratio =
            |between| error(sine, &uneven(50), between) / error(sine, &uneven(100), between);
        // Third order halves to 8, at the ends where the parabolas are one-sided; second to 4.
        assert!((6.0..20.0).contains(&ratio(Between::Cubic)), "{}", ratio(Between::Cubic));
        assert!((3.0..5.5).contains(&ratio(Between::Linear)), "{}", ratio(Between::Linear));
    }

    #[test]
    fn the_motion_joins_and_a_gap_is_straight() {
        let time_s = [0.0, 0.1, 0.2, 0.3, 0.9, 1.0, 1.1];
        let p = time_s.map(|t: f64| [t * t, 1.0]);
        let motion = through(&time_s, &p, 0.15, Between::Cubic).unwrap();
        assert_eq!(motion.len(), 6);
        for (i, s) in motion.segments().enumerate() {
            let end = s.position_mm(s.duration_s);
            // Rounding of positions of the order 1.
            assert!((end[0] - p[i + 1][0]).abs() < 1e-14, "{i}");
            let middle = s.position_mm(0.5 * s.duration_s)[0];
            let t = s.start_s + 0.5 * s.duration_s;
            match i {
                // (0.09 + 0.81) / 2, not 0.6^2
                3 => assert!((middle - 0.45).abs() < 1e-14),
                _ => assert!((middle - t * t).abs() < 1e-14, "{i}"),
            }
        }
    }
}
