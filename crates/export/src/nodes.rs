//! The times of the nodes, on the clock of the controller, before anything is rounded.
//!
//! From node to node the longest segment is taken whose motion stays near the plan and leaves room for rounding:
//!
//! | law | segment of T s | room |
//! |---|---|---|
//! | Hermite | the cubic through the plan's positions and velocities is within the deviation of the plan, and within A and J reduced by the room | A: 6 c/T^2 + 3 q/T, J: 12 c/T^3 + 6 q/T^2 |
//! | linear | the parabola that joins two lines leaves the plan by a T^2/8; [`lines`] says more | - |
//!
//! with the limits A on acceleration and J on jerk, the count c, the unit q of a velocity, and the acceleration a of
//! the plan. Where no segment does, the one that comes nearest is taken, and the generator slows the plan down there.

use std::array::from_fn;

use planish_numerics::polynomial::{derivative, evaluate};
use planish_types::{AxisGrid, Interpolation};

use crate::{
    lines,
    slowed::{AxesState, Choice, ClockCells, Slowed},
    velocities::hermite,
};

/// Number of points within a segment at which it is compared with the plan, besides the plan's own breaks. Larger:
/// more time. Smaller: a deviation between the points may be missed. Chosen.
const POINTS: usize = 7;

/// Largest number of breaks of the plan within a segment that are checked one by one. Larger: more time for plans of
/// many short segments. Smaller: a deviation at a break may be missed. Chosen.
const MOST_BREAKS: usize = 64;

/// Largest distance of a node along the path from the plan at the same time, in path deviations. Larger: a removal that
/// differs more in time. Smaller: more segments. Chosen: it is a time of microseconds, which does not change the
/// removal.
const ALONG_PATH: f64 = 2.0;

/// Ratio of the lengths of segments that are tried one after the other; above 1. Larger: a good length may be skipped.
/// Smaller: more trials. Chosen.
const GROWTH: f64 = 1.4;

/// Returns the ticks of the nodes, from 0 to the last of `fixed`; all of `fixed` are nodes. They ascend, and where
/// possible they are at least the shortest segment apart. `motion` is the plan on the clock of the program, and `cells`
/// hold the longest segments that are still allowed.
pub(crate) fn choose<const N: usize>(
    motion: &Slowed<N>,
    cells: &ClockCells,
    fixed: &[i64],
    choice: &Choice<N>,
) -> Vec<i64> {
    if choice.interpolation == Interpolation::Linear {
        return lines::choose(motion, fixed, choice);
    }
    let mut ticks = vec![0];
    for stop in fixed {
        let mut tick = ticks[ticks.len() - 1];
        while tick < *stop {
            let rest = stop - tick;
            tick += choice.landing(choice.longest(motion, cells, tick, rest), rest);
            ticks.push(tick);
        }
    }
    ticks
}

impl<const N: usize> Choice<'_, N> {
    /// Returns a length near `n` ticks that leaves, if possible, either nothing or a whole segment until the next fixed
    /// node, `rest` ticks away.
    fn landing(&self, n: i64, rest: i64) -> i64 {
        let [least, most] = self.ticks;
        let n = n.clamp(least, most);
        if n >= rest {
            rest
        } else if rest - n >= least {
            n
        } else if rest >= 2 * least {
            // Two equal halves rather than a long segment and one that is too short.
            rest / 2
        } else if rest <= most {
            rest
        } else {
            n
        }
    }

    /// Returns the length in ticks of the longest valid cubic from the tick `start`, at most `rest`. It may be shorter,
    /// so that it ends where a segment of the plan ends. If no length is valid, it is the one nearest to that.
    fn longest(&self, motion: &Slowed<N>, cells: &ClockCells, start: i64, rest: i64) -> i64 {
        let [least, most] = self.ticks;
        let most = most.min(rest);
        let from = motion.state(start as f64 * self.tick_s);
        // The cells between are those of shorter segments, which are tried first.
        let longest_s =
            |tick: i64| cells.longest_s[cells.index(motion.plan_time(tick as f64 * self.tick_s).0)];
        let from_here_s = longest_s(start);
        let misfit = |n: i64| {
            let is_long = n as f64 * self.tick_s > from_here_s.min(longest_s(start + n));
            if is_long && n > least { f64::INFINITY } else { self.misfit(motion, &from, start, n) }
        };
        let mut good = None;
        let mut bad = None;
        let mut nearest = (f64::INFINITY, least.min(rest));
        let mut n = least.min(most);
        let mut tries = 0;
        loop {
            let m = misfit(n);
            if m <= 1.0 {
                good = Some(n);
            } else {
                if m < nearest.0 {
                    nearest = (m, n);
                }
                tries += 1;
                if good.is_some() {
                    bad = Some(n);
                }
            }
            if bad.is_some() || n == most || (good.is_none() && tries > TRIES) {
                break;
            }
            n = ((n as f64 * GROWTH).ceil() as i64).min(most);
        }
        let Some(mut good) = good else { return nearest.1 };
        if let Some(mut bad) = bad {
            while bad - good > 1 + good / 64 {
                let middle = good + (bad - good) / 2;
                if misfit(middle) <= 1.0 {
                    good = middle;
                } else {
                    bad = middle;
                }
            }
        }
        // A node where the plan has one keeps its rests and its switches as they are.
        let [start_s, end_s] = [start, start + good].map(|tick| tick as f64 * self.tick_s);
        let nearest = motion.breaks_within(0.5 * (start_s + end_s), end_s).last();
        let at_break = nearest.map_or(good, |s| (s / self.tick_s).round() as i64 - start);
        if at_break >= least && at_break < good && misfit(at_break) <= 1.0 {
            return at_break;
        }
        good
    }

    /// Returns the largest ratio of deviation from the path, acceleration and jerk to their allowance, for the cubic of
    /// `n` ticks from the tick `start`. Above 1 the segment must be shorter.
    fn misfit(&self, motion: &Slowed<N>, from: &AxesState<N>, start: i64, n: i64) -> f64 {
        let start_s = start as f64 * self.tick_s;
        let t = n as f64 * self.tick_s;
        let end_s = start_s + t;
        let to = motion.state(end_s);
        let c: [[f64; 4]; N] = from_fn(|a| {
            let v = [from.velocity[a], to.velocity[a]];
            hermite(to.position[a] - from.position[a], v, t)
        });
        let mut misfit: f64 = 0.0;
        for ((c, grid), limits) in c.iter().zip(self.grids).zip(self.axes) {
            let second = derivative(&derivative(c));
            let largest = second[0].abs().max((second[0] + second[1] * t).abs());
            let AxisGrid { count, velocity: unit } = grid;
            let room = 6.0 * count / (t * t) + 3.0 * unit / t;
            misfit = misfit.max((largest + room) / limits.max_acceleration);
            if let Some(jerk) = limits.max_jerk {
                let room = 12.0 * count / (t * t * t) + 6.0 * unit / (t * t);
                misfit = misfit.max((second[1].abs() + room) / jerk);
            }
        }
        let mut compare = |time_s: f64| {
            let u = time_s - start_s;
            let position = from_fn(|a| from.position[a] + evaluate(&c[a], u));
            let [from_path, now] = motion.distance_mm(time_s, position);
            misfit = misfit
                .max(from_path / self.deviation_mm)
                .max(now / (ALONG_PATH * self.deviation_mm));
        };
        for k in 1..=POINTS {
            compare(start_s + t * k as f64 / (POINTS + 1) as f64);
        }
        motion.breaks_within(start_s, end_s).take(MOST_BREAKS).for_each(&mut compare);
        misfit
    }
}

/// Number of segment lengths that are tried without success before the nearest to success is taken. Larger: more time.
/// Smaller: a valid length may be missed. Chosen.
const TRIES: usize = 8;
