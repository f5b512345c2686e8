//! Slows a motion down where an axis would exceed a limit.
//!
//! Time is stretched by a factor w >= 1 that is given at the ends of the pieces and is linear between them:
//!
//! ```text
//! h' = h (w0 + w1) / 2,   velocities at the ends v0 / w0, v1 / w1                                   (1)
//! ```
//!
//! A piece that exceeds a limit by the ratio e needs a larger factor: e for a velocity, e^(1/2) for an acceleration,
//! e^(1/3) for a jerk or a step of the acceleration. A running maximum over a window spreads these needs; two averages
//! over half the window follow. So w has a continuous slope and is nowhere below the need. The window grows from round
//! to round. An excess that is left after the last round stretches the whole motion.
//!
//! | symbol | meaning | unit |
//! |---|---|---|
//! | h | duration of a piece | s |
//! | w | stretch of the time | 1 |

use std::collections::VecDeque;

use planish_numerics::polynomial::{derivative, evaluate, range};
use planish_types::MachineAxis;

use crate::piece::{AxesPiece, stretched_s};

/// Half the window of the first round, s; it grows by [`GROWTH`] from round to round. Larger: the motion is slowed down
/// for longer. Smaller: more rounds. Chosen: it grows from a few servo cycles to 20 000 s in [`ROUNDS`] rounds.
const FIRST_WINDOW_S: f64 = 0.01;
const GROWTH: f64 = 1.6;

/// Largest number of rounds. Larger: more time before the whole motion is stretched. Smaller: the whole motion is
/// stretched earlier.
const ROUNDS: usize = 32;

/// Excess of the stretch over 1 that counts as rounding. Larger: limits are exceeded by it. Smaller: rounding slows the
/// motion down. Chosen: a tenth of what planish verify takes for rounding.
pub(crate) const ROUNDING: f64 = 1e-10;

/// Relative amount by which a piece is stretched more than it needs. Larger: the motion is slower by it. Smaller: more
/// rounds. Chosen.
const MARGIN: f64 = 1e-4;

/// Excess of one axis over one limit on one piece.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Excess {
    /// Ratio of the largest value of the quantity on the piece to its limit.
    pub(crate) ratio: f64,
    /// Factor by which the time of the piece has to be stretched to keep this limit; below 1 if the limit is kept.
    pub(crate) stretch: f64,
    /// Index of the axis of the machine.
    pub(crate) axis: usize,
    pub(crate) quantity: &'static str,
    /// Index of the piece in the motion.
    pub(crate) piece: usize,
}

/// Factors (w) of the stretch of time at the ends of the pieces (n + 1), and a further factor for the whole motion.
pub(crate) struct Slowed {
    pub(crate) stretch: Vec<f64>,
    pub(crate) whole: f64,
    /// Worst excess of the unslowed motion; `None` if the motion keeps every limit to rounding.
    pub(crate) worst: Option<Excess>,
}

/// Returns the stretch of time with which the pieces keep the limits of the axes, to rounding.
pub(crate) fn slow(pieces: &[AxesPiece], axes: &[MachineAxis]) -> Slowed {
    let mut need = vec![1.0; pieces.len()];
    let mut stretch = vec![1.0; pieces.len() + 1];
    let mut worst = None;
    let mut window_s = FIRST_WINDOW_S;
    for round in 0..ROUNDS {
        let excess = excesses(pieces, axes, &stretch);
        let largest = largest(&excess);
        if round == 0 {
            worst = largest.filter(|e| e.stretch > 1.0 + ROUNDING);
        }
        if largest.is_none_or(|e| e.stretch <= 1.0 + ROUNDING) {
            return Slowed { stretch, whole: 1.0, worst };
        }
        for (need, e) in need.iter_mut().zip(&excess) {
            if let Some(e) = e.filter(|e| e.stretch > 1.0 + ROUNDING) {
                *need *= e.stretch * (1.0 + MARGIN);
            }
        }
        stretch = spread(pieces, &need, window_s);
        window_s *= GROWTH;
    }
    let left = largest(&excesses(pieces, axes, &stretch));
    Slowed { stretch, whole: left.map_or(1.0, |e| e.stretch.max(1.0)), worst }
}

fn largest(excess: &[Option<Excess>]) -> Option<Excess> {
    excess.iter().flatten().copied().max_by(|a, b| a.stretch.total_cmp(&b.stretch))
}

/// Returns the worst excess of every piece, the step of the acceleration at its start included. The excess is a ratio
/// of value to limit and can be below 1; `None` without axes.
fn excesses(pieces: &[AxesPiece], axes: &[MachineAxis], stretch: &[f64]) -> Vec<Option<Excess>> {
    // Accelerations at the end of the piece before, and its duration.
    let mut before = (vec![0.0; axes.len()], 0.0);
    let last = pieces.len() - 1;
    let mut all = Vec::with_capacity(pieces.len());
    for (k, piece) in pieces.iter().enumerate() {
        let at_ends = [stretch[k], stretch[k + 1]];
        let h = stretched_s(piece, at_ends);
        let mut worst: Option<Excess> = None;
        let mut after = Vec::with_capacity(axes.len());
        for (axis, (c, limits)) in piece.cubics(h, at_ends).zip(axes).enumerate() {
            let v = derivative(&c);
            let a = derivative(&v);
            let mut add = |quantity, value: f64, limit: f64, power: f64| {
                let ratio = value / limit;
                let stretch = ratio.powf(power);
                if worst.is_none_or(|w| stretch > w.stretch) {
                    worst = Some(Excess { ratio, stretch, axis, quantity, piece: k });
                }
            };
            add("velocity", range(&v, h).peak().0, limits.max_velocity, 1.0);
            add("acceleration", range(&a, h).peak().0, limits.max_acceleration, 0.5);
            let end = evaluate(&a, h);
            if let Some(jerk) = limits.max_jerk {
                add("jerk", range(&derivative(&a), h).peak().0, jerk, 1.0 / 3.0);
                // As planish verify allows it in a program: from the middle of a segment to that of the next.
                let step = (a[0] - before.0[axis]).abs();
                add("step of the acceleration", step, 0.5 * jerk * (before.1 + h), 1.0 / 3.0);
                if k == last {
                    add("step of the acceleration", end.abs(), 0.5 * jerk * h, 1.0 / 3.0);
                }
            }
            after.push(end);
        }
        before = (after, h);
        all.push(worst);
    }
    all
}

/// Returns the factors of the stretch at the ends of the pieces; `need` is the factor that each piece needs. They are
/// the largest need within `window_s` to both sides, averaged twice over half of that. No factor is below the need of a
/// piece beside it.
fn spread(pieces: &[AxesPiece], need: &[f64], window_s: f64) -> Vec<f64> {
    let mut time_s = vec![0.0];
    for piece in pieces {
        time_s.push(time_s[time_s.len() - 1] + piece.duration_s());
    }
    let widest = windowed_largest(&time_s, need, window_s);
    let once = averaged(&time_s, &widest, 0.5 * window_s);
    let twice = averaged(&time_s, &once, 0.5 * window_s);
    // A piece whose ends do not reach its need, because it is longer than the window, gets it at both ends.
    let mut stretch = twice;
    for (k, need) in need.iter().enumerate() {
        stretch[k] = stretch[k].max(*need);
        stretch[k + 1] = stretch[k + 1].max(*need);
    }
    stretch
}

/// Returns, for each of the times, the largest need of the pieces that come within `window_s` of it.
fn windowed_largest(time_s: &[f64], need: &[f64], window_s: f64) -> Vec<f64> {
    let mut largest = Vec::with_capacity(time_s.len());
    // Pieces in the window, the needs descending.
    let mut queue: VecDeque<usize> = VecDeque::new();
    let mut next = 0;
    for t in time_s {
        while next < need.len() && time_s[next] <= t + window_s {
            while queue.back().is_some_and(|k| need[*k] <= need[next]) {
                queue.pop_back();
            }
            queue.push_back(next);
            next += 1;
        }
        while queue.front().is_some_and(|k| time_s[k + 1] < t - window_s) {
            queue.pop_front();
        }
        largest.push(queue.front().map_or(1.0, |k| need[*k]));
    }
    largest
}

/// Returns, for each of the times, the mean of `value` over `half_s` on both sides. The values are linear between the
/// times and constant beyond them.
fn averaged(time_s: &[f64], value: &[f64], half_s: f64) -> Vec<f64> {
    let n = time_s.len();
    let mut sum = vec![0.0];
    for k in 1..n {
        sum.push(sum[k - 1] + 0.5 * (value[k] + value[k - 1]) * (time_s[k] - time_s[k - 1]));
    }
    let integral = |t: f64| {
        let k = time_s.partition_point(|s| *s <= t);
        if k == 0 {
            return value[0] * (t - time_s[0]);
        }
        if k == n {
            return sum[n - 1] + value[n - 1] * (t - time_s[n - 1]);
        }
        let d = t - time_s[k - 1];
        let h = time_s[k] - time_s[k - 1];
        sum[k - 1] + d * (value[k - 1] + 0.5 * (value[k] - value[k - 1]) * d / h)
    };
    time_s.iter().map(|t| (integral(t + half_s) - integral(t - half_s)) / (2.0 * half_s)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_and_an_average_are_never_below_the_need() {
        // Pieces of 1 s; one needs 3.
        let pieces: Vec<AxesPiece> = (0..40)
            .map(|segment| AxesPiece {
                segment,
                from_s: 0.0,
                to_s: 1.0,
                start: vec![],
                end: vec![],
            })
            .collect();
        let mut need = vec![1.0; 40];
        need[20] = 3.0;
        for window_s in [0.1, 2.0, 5.0, 100.0] {
            let stretch = spread(&pieces, &need, window_s);
            // Rounding of averages of some hundred pieces with factors of up to 3.
            assert!(
                stretch[20] >= 3.0 - 1e-12 && stretch[21] >= 3.0 - 1e-12,
                "{window_s}: {stretch:?}"
            );
            assert!(stretch.iter().all(|w| (1.0 - 1e-12..=3.0 + 1e-12).contains(w)), "{stretch:?}");
            // Nothing changes beyond the two windows and, where each average is interpolated, one more piece each.
            let reach = 2.0 * window_s + 2.0;
            let outside =
                (0..=40).filter(|k| (*k as f64) < 20.0 - reach || (*k as f64) > 21.0 + reach);
            assert!(outside.into_iter().all(|k| (stretch[k] - 1.0).abs() < 1e-12), "{stretch:?}");
        }
    }
}
