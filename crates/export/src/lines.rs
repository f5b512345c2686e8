//! The nodes of lines that are joined: their times on the clock of the controller, and their positions in its counts. A
//! line is a straight segment of the program; a place is a point of a grid of times.
//!
//! The joined motion has the acceleration a_k near node k. The mean velocities m of a plan P give, for lines of T1 s
//! before the node and T2 s after it,
//!
//! ```text
//! a_k = (m_k - m_{k-1}) / min(T1, T2)
//! m_k - m_{k-1} = int P''(t_k + u) w(u) du      w = 1 + u / T1 before the node, 1 - u / T2 after it
//! ```
//!
//! The integral of w is (T1 + T2) / 2. Between equal lines |a_k| is therefore at most the largest |P''| beside the
//! node: such a program keeps the limit on acceleration wherever the plan does, at the times of the plan. Between
//! unequal lines
//! |a_k| is up to (T1 + T2) / (2 min(T1, T2)) times as large. So the lines change their length only where the plan leaves
//! that much of the acceleration unused:
//!
//! ```text
//! |T2 / T1 - 1| <= (1 - u) / u      u: largest use of an acceleration limit beside the node
//! ```
//!
//! This is half of what the limit allows; rounding and the whole ticks of a line take the rest. From two nodes that are
//! fixed the lines are laid towards each other. Where they meet, at the smallest u, is the seam, whose lines share the
//! rest of the time.

use crate::{
    plan::length_mm,
    slowed::{Choice, Slowed, line_at_limit_s},
};

/// Distance of the times at which the plan is sampled, s. Larger: a short peak of the acceleration is missed, and
/// mended in a further round. Smaller: more time. Chosen: a fifth of a line at a usual limit.
const GRID_S: f64 = 1e-3;

/// Length of a line, mm, above which the speed of the plan may change within it by at most [`STEADY`]. Larger: fewer
/// lines, and a removal that differs over this length. Smaller: more lines. Chosen: no tool sees it.
const LONGEST_MM: f64 = 0.25;

/// Relative change of the speed that a line of any length may ignore. Larger: fewer lines. Smaller: more lines.
const STEADY: f64 = 1e-3;

/// Largest relative change of the length from one line to the next. Larger: more acceleration where the plan uses
/// little of it. Smaller: shorter lines near a bend.
const MOST_CHANGE: f64 = 0.25;

/// Smallest used fraction of the acceleration limit with which the change of the lines is computed. Larger: lines of
/// few ticks keep their length. Smaller: lines that are twice as long as their neighbours. Chosen: (1 - u) / u = 2.3 of
/// a line.
const LITTLE_USE: f64 = 0.3;

/// Used fraction of the acceleration limit above which the lines at both ends of a program are not made shorter.
const MUCH_USE: f64 = 0.8;

/// Longest line at both ends of a program, s, unless a line at the limits is longer. Larger: the tool stays longer at
/// the ends, by half of the difference. Smaller: more lines.
const LONGEST_AT_END_S: f64 = 5e-3;

/// Distance from a node, in lines, within which the plan affects its acceleration, the growth of the lines included.
const LINES_BESIDE: f64 = 1.5;

/// Largest ratio of the lines at the seam to those beside it. Its square is the ratio of their distances from the plan,
/// and the choice leaves 40 % of the path deviation.
const LONGER_AT_SEAM: f64 = 1.2;

/// Largest number of lines of a seam. Larger: more even lines where the plan uses its limit everywhere. Smaller: less
/// time.
const MOST_LINES_OF_SEAM: usize = 400;

/// Returns the ticks of the nodes, from 0 to the last of `fixed` (ascending); all of `fixed` are nodes. `motion` is the
/// plan on the clock of the program, and `choice` has the limits, counts and shortest line.
pub(crate) fn choose<const N: usize>(
    motion: &Slowed<N>,
    fixed: &[i64],
    choice: &Choice<N>,
) -> Vec<i64> {
    let lengths = Lengths::new(motion, choice);
    let mut ticks = vec![0];
    for stop in fixed {
        let start = ticks[ticks.len() - 1];
        lengths.lay(start, *stop, &mut ticks);
    }
    ticks
}

/// The wanted durations of lines over the time of a program, at places (instants) `step` ticks apart.
struct Lengths {
    /// Time from one place to the next, ticks.
    step: i64,
    /// Duration of the shortest line, ticks.
    least: i64,
    /// Wanted duration of a line at every place, ticks.
    ticks: Vec<f64>,
    /// Largest used fraction of an acceleration limit by the plan near every place, at least [`LITTLE_USE`].
    used: Vec<f64>,
}

impl Lengths {
    fn new<const N: usize>(motion: &Slowed<N>, choice: &Choice<N>) -> Self {
        let [least, most] = choice.ticks;
        let step = (GRID_S / choice.tick_s).ceil().max(1.0) as i64;
        let step_s = step as f64 * choice.tick_s;
        let m = (motion.total_s() / step_s).ceil() as usize + 2;
        let Choice { axes, grids, lever, .. } = choice;
        let at_limit_s = line_at_limit_s(axes, grids, lever, choice.deviation_mm);
        let limits = axes.each_ref().map(|axis| axis.max_acceleration);
        let mut ticks = Vec::with_capacity(m);
        let mut used = vec![LITTLE_USE; m];
        for k in 0..m {
            let time_s = k as f64 * step_s;
            let state = motion.state(time_s);
            let a = state.acceleration;
            let v_mm = length_mm(lever, state.velocity);
            let a_mm = length_mm(lever, a);
            // a T^2 / 8 is the distance of the parabola from the plan, that of lines at the limits; a T / v is the change of the
            // speed.
            let near_s = at_limit_s * (length_mm(lever, limits) / a_mm).sqrt();
            let steady_s = (LONGEST_MM / v_mm).max(STEADY * v_mm / a_mm).max(at_limit_s);
            let longest_s = near_s.min(steady_s);
            let length = (longest_s / choice.tick_s).clamp(least as f64, most as f64);
            ticks.push(length);
            let axes = a.iter().zip(choice.axes);
            let here = axes.map(|(a, axis)| a.abs() / axis.max_acceleration).fold(0.0, f64::max);
            if here > LITTLE_USE {
                let beside = (LINES_BESIDE * length / step as f64).ceil() as usize;
                let near = k.saturating_sub(beside)..(k + beside + 1).min(m);
                used[near].iter_mut().for_each(|u| *u = u.max(here.min(1.0)));
            }
        }
        // Half a line comes before the first node and after the last one, with the tool on.
        let at_end = LONGEST_AT_END_S.max(at_limit_s) / choice.tick_s;
        for k in [0, m - 2, m - 1] {
            if used[k] <= MUCH_USE {
                ticks[k] = ticks[k].min(at_end);
            }
        }
        let mut lengths = Self { step, least, ticks, used };
        // A line begins where it may still be as long as what comes within it.
        for k in 0..m - 1 {
            let longest = lengths.ticks[k] + lengths.growth(k, lengths.ticks[k]);
            lengths.ticks[k + 1] = lengths.ticks[k + 1].min(longest);
        }
        for k in (0..m - 1).rev() {
            let longest = lengths.ticks[k + 1] + lengths.growth(k, lengths.ticks[k + 1]);
            lengths.ticks[k] = lengths.ticks[k].min(longest);
        }
        lengths
    }

    /// Returns the largest change of the length of lines from place `k` of the grid to the next, in ticks. The lines
    /// have `length` ticks at `k`. It is 0 if one line may not differ from its neighbour by a tick.
    fn growth(&self, k: usize, length: f64) -> f64 {
        let change = self.change(self.used[k].max(self.used[k + 1]));
        if change * length < 1.0 { 0.0 } else { change.min(MOST_CHANGE) * self.step as f64 }
    }

    /// Returns the largest relative change from the duration of one line to the next: (1 - u) / u of the module, for
    /// the used fraction u of the acceleration limit.
    fn change(&self, used: f64) -> f64 {
        (1.0 - used) / used
    }

    fn place(&self, tick: i64) -> usize {
        ((tick / self.step).max(0) as usize).min(self.ticks.len() - 1)
    }

    /// Returns the wanted duration of a line that begins or ends at `tick`, in ticks. It is that of the last place up
    /// to `tick`, rounded down, and at least `least`.
    fn length(&self, tick: i64) -> i64 {
        (self.ticks[self.place(tick)] as i64).max(self.least)
    }

    /// Returns the tick between two nodes where the plan uses least of the acceleration limit; there the lines are
    /// longest.
    fn loosest(&self, start: i64, stop: i64) -> i64 {
        let places = self.place(start) + 1..self.place(stop);
        let loosest = places.min_by(|a, b| {
            let by_use = self.used[*a].total_cmp(&self.used[*b]);
            by_use.then_with(|| self.ticks[*b].total_cmp(&self.ticks[*a]))
        });
        loosest.map_or(start + (stop - start) / 2, |k| k as i64 * self.step)
    }

    /// Adds the ticks of the nodes after `start` up to `stop` to `ticks`.
    fn lay(&self, start: i64, stop: i64, ticks: &mut Vec<i64>) {
        let seam = self.loosest(start, stop);
        let mut forward = vec![start];
        let mut next = start + self.length(start);
        while next <= seam {
            forward.push(next);
            next += self.length(next);
        }
        let mut backward = vec![stop];
        let mut next = stop - self.length(stop);
        while next >= seam {
            backward.push(next);
            next -= self.length(next);
        }
        let length = self.length(seam);
        let even = self.change(self.used[self.place(seam)]);
        let (first, last, lines) = loop {
            let first = forward[forward.len() - 1];
            let last = backward[backward.len() - 1];
            let gap = last - first;
            let longest = 1.0 + even.min(LONGER_AT_SEAM - 1.0);
            let lines = (gap as f64 / (longest * length as f64)).ceil() as i64;
            let lines = lines.min(gap / self.least).max(i64::from(gap > 0));
            let is_even = (lines * length) as f64 <= (1.0 + even) * gap as f64;
            let is_all = forward.len() == 1 && backward.len() == 1;
            if is_even || is_all || lines as usize > MOST_LINES_OF_SEAM {
                break (first, last, lines);
            }
            if forward.len() > backward.len() {
                forward.pop()
            } else {
                backward.pop()
            };
        };
        ticks.extend(&forward[1..]);
        ticks.extend((1..lines).map(|j| first + (last - first) * j / lines));
        if lines > 0 {
            ticks.push(last);
        }
        ticks.extend(backward.iter().rev().skip(1));
    }
}

/// Data for the positions of the nodes of one axis, in counts; n is the number of lines.
pub(crate) struct AxisCounts<'a> {
    /// Duration of every line, s, length n.
    pub time_s: &'a [f64],
    /// Limits of velocity and acceleration, counts/s and counts/s^2.
    pub velocity: f64,
    pub acceleration: f64,
    /// Lowest and highest count of the travel.
    pub travel: [i64; 2],
    /// Largest number of counts by which a position is moved. Larger: positions may run away from the plan where it
    /// leaves no room. Smaller: more places are slowed down.
    pub most_moved: i64,
}

impl AxisCounts<'_> {
    /// Moves rounded positions (n+1) as far as the limits of the joined lines require. Where the plan leaves room for a
    /// count, the position returns to its own value.
    pub fn keep_limits(&self, positions: &mut [i64]) {
        let mut velocity = 0.0;
        let mut before_s = f64::INFINITY;
        for (k, time_s) in self.time_s.iter().enumerate() {
            let change = self.acceleration * before_s.min(*time_s);
            let from = positions[k];
            let [slowest, fastest] = [velocity - change, velocity + change]
                .map(|v: f64| v.clamp(-self.velocity, self.velocity) * time_s);
            // A hair is the rounding of the product.
            let low = (slowest - 1e-6).ceil() as i64;
            let high = (fastest + 1e-6).floor() as i64;
            let [lowest, highest] = self.travel;
            let own = positions[k + 1];
            if low <= high {
                let within = own.clamp(from.saturating_add(low), from.saturating_add(high));
                let most = self.most_moved;
                let near = within.clamp(own.saturating_sub(most), own.saturating_add(most));
                positions[k + 1] = near.clamp(lowest, highest);
            }
            velocity = (positions[k + 1] - from) as f64 / time_s;
            before_s = *time_s;
        }
    }
}
