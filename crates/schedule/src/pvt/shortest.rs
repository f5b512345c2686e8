//! Search for the shortest times of the segments whose dwell times the machine cannot follow.
//!
//! Between the velocities `v0` and `v1` a segment of the cubics (1) of [`super`] can last any time at which it keeps
//! the limits. Each limit excludes an interval of times h; with `dp >= 0` (else all signs turn), and A, V and J the
//! limits of the axis,
//!
//! ```text
//! +-a+ <= A, +-a- <= A:   c0 + c1 h <= A h^2                                              (1)
//!     with (c0, c1) = +-(6 dp, -(4 v0 + 2 v1)) and +-(6 dp, -(2 v0 + 4 v1))
//! +-jerk <= J:            c0 + c1 h <= J h^3,   (c0, c1) = +-(12 dp, -6 (v0 + v1))         (2)
//! v(u) <= V:              3 dp / h <= v0 + v1 + V + sqrt((V - v0) (V - v1))                (3)
//! v(u) >= -V:             3 dp / h >= v0 + v1 - V - sqrt((V + v0) (V + v1))                (4)
//! no reversal:            3 dp / h >= v0 + v1
//! near the path:          p0 + v0 h / 3 and p0 + dp - v1 h / 3 within its tolerance, for both axes at once
//! ```
//!
//! (3): a quadratic Bezier curve `V - v(u)` is never negative if its middle control value is at least minus the
//! root of the product of the outer ones. The search for the least time starts at the dwell time and goes from the
//! end of one excluded interval to that of the next, until both axes allow the time. The shortest motion is
//!
//! ```text
//! min over v_1 .. v_{N-1} of  sum_i h_i(v_{i-1}, v_i)                                      (5)
//! ```
//!
//! With a few candidates for the velocity of every node, the best of all their combinations is found from node to
//! node (dynamic programming; R. Bellman, 1957). The first candidates are speeds along the path and rest. With rest
//! there is a motion for all dwell times. The next candidates are steps of both axes up and down around the best so
//! far, which get smaller when they gain little. All nodes can change in one sweep, so braking before a bend takes
//! no more sweeps over a hundred segments than over one.
//!
//! Most of a path keeps its dwell times. Only nodes near segments that take longer have candidates, as far as an
//! axis needs to brake. The other nodes keep their velocity.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | h | `duration_s` | (N) | s |
//! | dp | `displacement_mm` | (N) | mm |
//! | v | `velocity` | (N+1) pairs | mm/s |

use super::{axis::AxisProblem, near_path::NearPath};

/// Part of the time of a segment that the search leaves free, relative: it plans with limits that a segment could
/// keep in (1 - ROOM) of its time. Larger: motions take longer. Smaller: the quadratic program that follows has no
/// interior, and the motion of the search replaces that of the least energy. The value, 0.1 %, is in
/// docs/schedulers.md.
const ROOM: f64 = 1e-3;

/// Least time of a segment, in roundings of the total time. A duration is the difference of two break times, and
/// its rounding is then at most a tenth of [`ROOM`]. Larger: very short segments take longer. Smaller: rounding
/// uses up [`ROOM`].
const LEAST_ROUNDINGS: f64 = 1e4;

/// Number of speeds along the path that are tried first, from the largest that any direction allows downwards. Larger:
/// a lower lowest speed, and more computing time. Smaller: slow speeds are missing. The lowest is 6e-4 of the largest.
const SPEEDS: usize = 42;
/// Ratio of each of the [`SPEEDS`] to the next lower one. Larger: coarser speeds, and a lower lowest one. Smaller:
/// finer speeds that end at a higher one.
const SPEED_FACTOR: f64 = 1.2;

/// Largest change of speed along one segment, in steps of [`SPEED_FACTOR`], except from and to rest. Larger: more
/// computing time. Smaller: the search misses accelerations that the machine can do. From rest with constant
/// acceleration the second of equal segments ends 1.41 times as fast as the first, which is two steps.
const SPEEDS_PER_SEGMENT: usize = 3;

/// Number of candidates of a node beside its [`SPEEDS`] along the path: rest, the velocity before, and that of
/// [`Search::profile`].
const OTHERS: usize = 3;

/// Largest ratio of the time of a segment between two speeds of a profile to its time at constant acceleration. It
/// allows for cubics whose acceleration varies where lengths or directions change. Larger: the segment itself may take
/// longer. Smaller: the profile, and with it the neighbours, become slower.
const LONGER_THAN_EVEN: f64 = 1.02;

/// Ratio of the largest speed of the profile to the mean speed of a segment in its wanted time. Where neighbours
/// have different mean speeds, the velocity between them is above the lower one. Larger: the profile may be faster
/// than the dwell times need. Smaller: it is too slow between such neighbours.
const FASTER_THAN_WANTED: f64 = 1.25;

/// Number of bisections that find a speed of the profile; 20 resolve it to 1e-6 of its upper bound. More: a finer speed
/// and more computing time.
const BISECTIONS: usize = 20;

/// First and last step of the search around the best velocities so far. They are relative to the velocity at a node or,
/// if that is larger, to the mean velocity of a segment beside it. A larger first step: a wider search. A smaller last
/// step: a finer result, and more sweeps.
const STEPS: [f64; 2] = [0.1, 2e-3];

/// Gain of a sweep below which the steps are halved, relative to the time of the segments that may change. Larger:
/// fewer sweeps, and longer times. Smaller: more sweeps for small gains.
const GAIN: f64 = 1e-3;

/// Largest number of sweeps over the path. Larger: more computing time. Smaller: the search ends before the last
/// step size, with longer times.
const MAX_SWEEPS: usize = 40;

/// Reach of the search around a segment that takes longer, in the time that an axis needs to brake from its largest
/// velocity. Two: to brake, and to be as fast again. Larger: more nodes may change, and the search takes longer.
/// Smaller: neighbours cannot brake for the segment, so it takes more time.
const BRAKING_TIMES: f64 = 2.0;
/// Smallest reach of the search, in segments. Larger: more nodes may change. Smaller: too few nodes may change where
/// segments are long.
const LEAST_REACH: usize = 8;

/// Velocity of a node along [x, y], mm/s.
type Velocity = [f64; 2];

/// Problem of an axis, with its limits less the part that the search leaves free ([`ROOM`]), mm/s, mm/s^2, mm/s^3.
#[derive(Debug)]
struct ShortestAxis<'a> {
    problem: &'a AxisProblem<'a>,
    velocity: f64,
    acceleration: f64,
    jerk: f64,
}

/// Problem of the shortest motion, (5) of the module.
#[derive(Debug)]
pub(super) struct Search<'a> {
    axes: [ShortestAxis<'a>; 2],
    near: &'a NearPath,
    /// Wanted time of every segment (N), s: the dwell time, or, if that is larger, the least time by its mean velocity
    /// and the controller.
    wanted_s: &'a [f64],
    /// Least time of every segment, s: the wanted time, but at least [`LEAST_ROUNDINGS`] roundings of the total time.
    least_s: Vec<f64>,
}

/// Result of the search: a motion within the limits.
#[derive(Debug)]
pub(super) struct Shortest {
    /// Time of every segment (N), s.
    pub(super) duration_s: Vec<f64>,
    /// Velocities at the nodes (N+1) at these times, mm/s, one vector per axis.
    pub(super) velocity: [Vec<f64>; 2],
    /// Number of sweeps over the path.
    pub(super) sweeps: usize,
}

impl<'a> Search<'a> {
    pub(super) fn new(
        axes: &'a [AxisProblem<'a>; 2],
        near: &'a NearPath,
        wanted_s: &'a [f64],
    ) -> Self {
        let slower = 1.0 - ROOM;
        let axes = axes.each_ref().map(|problem| ShortestAxis {
            problem,
            velocity: slower * problem.max_velocity,
            acceleration: slower.powi(2) * problem.max_acceleration,
            jerk: slower.powi(3) * problem.max_jerk,
        });
        let rounding_s = f64::EPSILON * wanted_s.iter().sum::<f64>();
        let least_s = wanted_s.iter().map(|h| h.max(LEAST_ROUNDINGS * rounding_s)).collect();
        Self { axes, near, wanted_s, least_s }
    }

    /// Searches for the shortest motion. It starts from the node velocities `before`, which keep the limits at the
    /// wanted times except in the segments for which `exceed` is true.
    pub(super) fn run(&self, before: &[Vec<f64>; 2], exceed: &[bool]) -> Shortest {
        let before: Vec<Velocity> =
            before[0].iter().zip(&before[1]).map(|(x, y)| [*x, *y]).collect();
        let open = self.near(exceed, &before);
        let (mut open, mut velocity) = match self.along_the_path(&open, &before) {
            Some(velocity) => (open, velocity),
            None => {
                // No candidate joins the velocities that are kept. If all nodes may change, rest is always a solution.
                let all = self.near(&vec![true; exceed.len()], &before);
                let velocity = self.along_the_path(&all, &before);
                (all, velocity.expect("from rest to rest every segment has a time"))
            }
        };
        let mut duration_s = self.durations(&open, &velocity);
        let mut sweeps = 1;
        let mut step = STEPS[0];
        while sweeps <= MAX_SWEEPS && step > STEPS[1] {
            let longer: Vec<bool> =
                duration_s.iter().zip(self.wanted_s).map(|(h, wanted)| h > wanted).collect();
            open = self.near(&longer, &velocity);
            let stepped = self.stepped(&open, &velocity, &duration_s, step);
            let total_s: f64 = duration_s.iter().sum();
            let now_s = self.durations(&open, &stepped);
            let gained_s = total_s - now_s.iter().sum::<f64>();
            if gained_s > 0.0 {
                velocity = stepped;
                duration_s = now_s;
            }
            let of_open = (0..duration_s.len()).filter(|i| open[*i] || open[*i + 1]);
            if gained_s < GAIN * of_open.map(|i| duration_s[i]).sum::<f64>() {
                step *= 0.5;
            }
            sweeps += 1;
        }
        let velocity = [0, 1].map(|axis| velocity.iter().map(|v| v[axis]).collect());
        Shortest { duration_s, velocity, sweeps }
    }

    /// Returns true for each node (N+1) whose velocity may change. These are the nodes within reach of the `wanted`
    /// segments, and the following ones up to a segment that keeps the limits of the search at its wanted time.
    fn near(&self, wanted: &[bool], velocity: &[Velocity]) -> Vec<bool> {
        let n = wanted.len();
        let [x_s, y_s] =
            self.axes.each_ref().map(|axis| BRAKING_TIMES * axis.velocity / axis.acceleration);
        let reach_s = x_s.max(y_s);
        let mut open = vec![false; n + 1];
        let mut pass = |segments: &mut dyn Iterator<Item = usize>, far: usize| {
            let mut left_s = 0.0;
            let mut left = 0;
            let mut go_on = false;
            for i in segments {
                if wanted[i] {
                    left_s = reach_s;
                    left = LEAST_REACH;
                    go_on = true;
                } else if left == 0 && left_s <= 0.0 && go_on {
                    go_on = !self.is_at_ease(i, velocity);
                }
                open[i + far] |= go_on;
                if !wanted[i] {
                    left_s -= self.wanted_s[i];
                    left = left.saturating_sub(1);
                }
            }
        };
        pass(&mut (0..n), 1);
        pass(&mut (0..n).rev(), 0);
        // The machine rests before and after.
        open[0] = false;
        open[n] = false;
        open
    }

    fn is_at_ease(&self, i: usize, velocity: &[Velocity]) -> bool {
        self.least_time(i, velocity[i], velocity[i + 1]) <= self.least_s[i]
    }

    /// Returns the times of all segments (N), s, for these node velocities. A segment between two nodes that are not
    /// `open` has its wanted time.
    fn durations(&self, open: &[bool], velocity: &[Velocity]) -> Vec<f64> {
        let durations = (0..self.wanted_s.len()).map(|i| {
            let least = self.least_time(i, velocity[i], velocity[i + 1]);
            // A path of one segment has no node between.
            let takes_part = open[i] || open[i + 1] || open.len() == 2;
            if least > self.least_s[i] && takes_part { least } else { self.wanted_s[i] }
        });
        durations.collect()
    }

    /// Returns the node velocities of the best combination of speeds along the path, rest, and the velocities `before`;
    /// `None` if no combination keeps the limits. Only nodes that are `open` change.
    fn along_the_path(&self, open: &[bool], before: &[Velocity]) -> Option<Vec<Velocity>> {
        let largest = self.axes[0].velocity.hypot(self.axes[1].velocity);
        let speeds: Vec<f64> = (0..SPEEDS as i32).map(|k| largest / SPEED_FACTOR.powi(k)).collect();
        let profile = self.profile(open, before);
        self.best(open, before, SPEEDS_PER_SEGMENT, |node, candidates| {
            let direction = self.direction(node);
            candidates.extend([[0.0; 2], self.allowed(node, before[node]), profile[node]]);
            candidates.extend(speeds.iter().map(|speed| direction.map(|d| speed * d)));
        })
    }

    /// Returns the node velocities of a profile: the highest speeds along the path at which every segment takes about
    /// the time of a constant acceleration. The limits at constant speed come first, then those of accelerating, and
    /// backwards those of braking (J. E. Bobrow, S. Dubowsky, J. S. Gibson, Int. J. Robot. Res. 4 (1985) 3). A grid of
    /// speeds is too coarse along segments that are too short to change the speed by one of its steps.
    fn profile(&self, open: &[bool], before: &[Velocity]) -> Vec<Velocity> {
        let n = self.wanted_s.len();
        let direction: Vec<Velocity> =
            (0..=n).map(|node| if open[node] { self.direction(node) } else { [0.0; 2] }).collect();
        let velocity = |node: usize, speed: f64| {
            if open[node] { direction[node].map(|d| speed * d) } else { before[node] }
        };
        let is_even = |i: usize, from: f64, to: f64| {
            let (from_v, to_v) = (velocity(i, from), velocity(i + 1, to));
            let even_s = LONGER_THAN_EVEN * 2.0 * self.length_mm(i) / (from + to);
            self.is_allowed(from_v)
                && self.is_allowed(to_v)
                && self.least_time(i, from_v, to_v) <= even_s.max(self.least_s[i])
        };
        let largest = self.axes[0].velocity.hypot(self.axes[1].velocity);
        let mut speed: Vec<f64> = before.iter().map(|v| v[0].hypot(v[1])).collect();
        for node in (1..n).filter(|node| open[*node]) {
            let beside = [node - 1, node];
            let [before, after] =
                beside.map(|i| FASTER_THAN_WANTED * self.length_mm(i) / self.least_s[i]);
            let most = largest.min(before).min(after);
            let inner = beside.into_iter().filter(|i| open[*i] && open[i + 1]);
            speed[node] =
                inner.map(|i| highest(most, |speed| is_even(i, speed, speed))).fold(most, f64::min);
        }
        for i in 0..n {
            let (from, most) = (speed[i], speed[i + 1]);
            if open[i + 1] && most > from {
                speed[i + 1] = highest(most, |to| to < from || is_even(i, from, to)).max(from);
            }
        }
        for i in (0..n).rev() {
            let most = speed[i];
            let to = speed[i + 1];
            if open[i] && most > to {
                speed[i] = highest(most, |from| from < to || is_even(i, from, to)).max(to);
            }
        }
        (0..=n).map(|node| velocity(node, speed[node])).collect()
    }

    /// Returns the node velocities of the shortest combination of steps up and down from `velocity` at the open nodes;
    /// `velocity` itself if none keeps the limits. `step` is relative to the velocity at the node or the mean velocity
    /// beside it.
    fn stepped(
        &self,
        open: &[bool],
        velocity: &[Velocity],
        duration_s: &[f64],
        step: f64,
    ) -> Vec<Velocity> {
        let best = self.best(open, velocity, usize::MAX, |node, candidates| {
            let v = velocity[node];
            candidates.extend([[0.0; 2], v, v]);
            let steps = [0, 1].map(|axis| {
                let dp = &self.axes[axis].problem.displacement_mm;
                let [before, after] = [node - 1, node].map(|i| dp[i].abs() / duration_s[i]);
                step * v[axis].abs().max(before).max(after)
            });
            for x in [-1.0, 0.0, 1.0] {
                for y in [-1.0, 0.0, 1.0] {
                    let c = self.allowed(node, [v[0] + x * steps[0], v[1] + y * steps[1]]);
                    if c != v && !candidates.contains(&c) {
                        candidates.push(c);
                    }
                }
            }
        });
        best.unwrap_or_else(|| velocity.to_vec())
    }

    /// Returns the node velocities of the shortest of all combinations of candidates at the open nodes; `None` if none
    /// keeps the limits. Other nodes keep their velocity in `fixed`; `fill` gives the candidates of an open node. It
    /// combines the first [`OTHERS`] candidates with all candidates of a neighbour, the others with those whose index
    /// differs by at most `apart`.
    fn best(
        &self,
        open: &[bool],
        fixed: &[Velocity],
        apart: usize,
        fill: impl Fn(usize, &mut Vec<Velocity>),
    ) -> Option<Vec<Velocity>> {
        let n = self.wanted_s.len();
        let candidates = |node: usize, to: &mut Vec<Velocity>| {
            to.clear();
            if open[node] { fill(node, to) } else { to.push(fixed[node]) }
        };
        // Candidates of the present node, the least time until there, and for all nodes the candidate before.
        let (mut here, mut next) = (Vec::new(), Vec::new());
        candidates(0, &mut here);
        let (mut cost, mut cost_next) = (vec![0.0], Vec::new());
        let (mut from, mut start) = (vec![0_u8], vec![0]);
        for i in 0..n {
            candidates(i + 1, &mut next);
            cost_next.clear();
            start.push(from.len());
            let free = open[i] || open[i + 1];
            for (b, to) in next.iter().enumerate() {
                let mut least = (f64::INFINITY, 0);
                if !free {
                    least = (cost[0], 0);
                } else if self.is_allowed(*to) {
                    let mut try_from = |a: usize| {
                        if cost[a] + self.least_s[i] < least.0 {
                            let total = cost[a] + self.least_time(i, here[a], *to);
                            if total < least.0 {
                                least = (total, a);
                            }
                        }
                    };
                    let others = if b < OTHERS { here.len() } else { OTHERS.min(here.len()) };
                    (0..others).for_each(&mut try_from);
                    let near = b.saturating_sub(apart).max(others)
                        ..(b.saturating_add(apart)).min(here.len() - 1) + 1;
                    near.for_each(&mut try_from);
                }
                cost_next.push(least.0);
                from.push(least.1 as u8);
            }
            std::mem::swap(&mut here, &mut next);
            std::mem::swap(&mut cost, &mut cost_next);
        }
        if !cost[0].is_finite() {
            return None;
        }
        let mut best = vec![[0.0; 2]; n + 1];
        let mut candidate = 0;
        for node in (0..=n).rev() {
            candidates(node, &mut here);
            best[node] = here[candidate];
            candidate = usize::from(from[start[node] + candidate]);
        }
        Some(best)
    }

    fn displacement_mm(&self, i: usize) -> [f64; 2] {
        self.axes.each_ref().map(|axis| axis.problem.displacement_mm[i])
    }

    fn length_mm(&self, i: usize) -> f64 {
        let [x, y] = self.displacement_mm(i);
        x.hypot(y)
    }

    /// Returns the direction of the path at a node, not normalised: per axis the mean of the slopes beside it. If
    /// reversal is forbidden, it is the harmonic mean (F. N. Fritsch, J. Butland, SIAM J. Sci. Stat. Comput. 5 (1984)
    /// 300).
    fn direction(&self, node: usize) -> Velocity {
        let [before, after] = [node - 1, node].map(|i| self.displacement_mm(i));
        let [l0, l1] = [before, after].map(|d| d[0].hypot(d[1]));
        if l0 == 0.0 || l1 == 0.0 {
            return [0.0; 2];
        }
        [0, 1].map(|axis| {
            let problem = self.axes[axis].problem;
            let s0 = before[axis] / l0;
            let s1 = after[axis] / l1;
            if problem.allowed_signs(node) == [false, false] {
                0.0
            } else if problem.is_reversal_allowed() {
                (s0 * l1 + s1 * l0) / (l0 + l1)
            } else {
                (l0 + l1) / (l0 / s1 + l1 / s0)
            }
        })
    }

    /// Returns the velocity nearest to `velocity` that the signs of the mode and the velocity limits allow at the node,
    /// mm/s.
    fn allowed(&self, node: usize, velocity: Velocity) -> Velocity {
        [0, 1].map(|a| {
            let axis = &self.axes[a];
            let [negative, positive] = axis.problem.allowed_signs(node);
            let [low, high] =
                [negative, positive].map(|is_allowed| if is_allowed { axis.velocity } else { 0.0 });
            velocity[a].clamp(-low, high)
        })
    }

    fn is_allowed(&self, velocity: Velocity) -> bool {
        (0..2).all(|a| velocity[a].abs() <= self.axes[a].velocity)
    }

    /// Returns the least time of segment `i` between two velocities, s, not below `least_s`. It is infinite if no time
    /// keeps the limits, or if the segment would leave its path. In more time, a segment with the same velocities
    /// leaves its path by more.
    fn least_time(&self, i: usize, from: Velocity, to: Velocity) -> f64 {
        let mut h = self.least_s[i];
        loop {
            let before = h;
            for (axis, (v0, v1)) in self.axes.iter().zip(from.into_iter().zip(to)) {
                h = axis.least_time(i, v0, v1, h);
            }
            let goes_on = h > before && h.is_finite();
            if !goes_on {
                break;
            }
        }
        if h.is_finite() && !self.near.hull_is_near(i, from, to, h) { f64::INFINITY } else { h }
    }
}

impl ShortestAxis<'_> {
    /// Returns the least time of segment `i` from `h` on that no limit excludes, s; infinite if an excluded interval
    /// has no end.
    fn least_time(&self, i: usize, v0: f64, v1: f64, mut h: f64) -> f64 {
        /// Excess over a condition that counts as equality, relative. Larger: limits are exceeded by as much. Smaller:
        /// a time at the end of an interval counts as excluded, because of rounding.
        const ROUNDING: f64 = 1e-12;
        let dp = self.problem.displacement_mm[i];
        let [dp, v0, v1] = if dp < 0.0 { [-dp, -v0, -v1] } else { [dp, v0, v1] };
        let limit = self.velocity;
        let sum = v0 + v1;
        if v0.abs().max(v1.abs()) > limit {
            return f64::INFINITY;
        }
        // (3)
        let most = sum + limit + ((limit - v0) * (limit - v1)).sqrt();
        if 3.0 * dp > most * h {
            h = 3.0 * dp / most;
        }
        // (1)
        for (c0, c1) in [(6.0 * dp, 4.0 * v0 + 2.0 * v1), (6.0 * dp, 2.0 * v0 + 4.0 * v1)] {
            for (c0, c1) in [(c0, -c1), (-c0, c1)] {
                let a = self.acceleration;
                if c0 + c1 * h > (1.0 + ROUNDING) * a * h * h {
                    h = h.max((c1 + (c1 * c1 + 4.0 * a * c0).sqrt()) / (2.0 * a));
                }
            }
        }
        // (2)
        if self.jerk.is_finite() {
            let c0 = 12.0 * dp;
            let c1 = 6.0 * sum;
            let j = self.jerk;
            for (c0, c1) in [(c0, -c1), (-c0, c1)] {
                if c0 + c1 * h > (1.0 + ROUNDING) * j * h.powi(3) {
                    h = h.max(end_of_cubic(c0, c1, j));
                }
            }
        }
        // (4)
        let least = if self.problem.is_reversal_allowed() {
            sum - limit - ((limit + v0) * (limit + v1)).sqrt()
        } else {
            sum
        };
        if least * h > (1.0 + ROUNDING) * 3.0 * dp { f64::INFINITY } else { h }
    }
}

/// Returns the largest h at which `c0 + c1 h = j h^3`, the end of an interval excluded by (2) of the module.
fn end_of_cubic(c0: f64, c1: f64, j: f64) -> f64 {
    // Not below it; from there the steps of Newton descend to it, because the difference is concave.
    let mut h = (2.0 * c0.max(0.0) / j).cbrt().max((2.0 * c1.max(0.0) / j).sqrt());
    loop {
        let next = h - (c0 + c1 * h - j * h.powi(3)) / (c1 - 3.0 * j * h * h);
        // To rounding.
        let descends = next < h * (1.0 - 1e-14);
        if !descends {
            return h;
        }
        h = next;
    }
}

/// Returns the largest value in [0, most] for which `good` is true, by bisection. Every value below a good one must be
/// good.
fn highest(most: f64, good: impl Fn(f64) -> bool) -> f64 {
    if good(most) {
        return most;
    }
    let (mut low, mut high) = (0.0, most);
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (low + high);
        if good(middle) { low = middle } else { high = middle }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        hermite::{accelerations, peak_velocity},
        pvt::mode::Mode,
    };
    use planish_testkit::numbers;
    use planish_types::{Limits, MachineFile, MachineFileAxis};

    fn machine(velocity: f64, acceleration: f64, jerk: Option<f64>) -> Limits {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: velocity,
            max_acceleration_mm_per_s2: acceleration,
            max_jerk_mm_per_s3: jerk,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x"), axis("y")];
        MachineFile { name: "m".into(), axes, ..MachineFile::default() }.checked().unwrap()
    }

    fn problems(dp: [Vec<f64>; 2], mode: Mode, limits: &Limits) -> [AxisProblem<'static>; 2] {
        dp.map(|dp| AxisProblem::new(dp, mode, &limits.axes()[0]))
    }

    /// Returns the path of these axes with a tolerance that no motion reaches.
    fn anywhere(axes: &[AxisProblem; 2]) -> NearPath {
        let [x, y] = axes.each_ref().map(|axis| axis.displacement_mm.iter());
        NearPath::new(x.zip(y).map(|(x, y)| [*x, *y]).collect(), 1e9)
    }

    #[test]
    fn the_least_time_is_the_least_at_which_every_limit_is_kept() {
        let mut random = numbers(3);
        let (mut longer, mut none) = (0, 0);
        for case in 0..4000 {
            let jerk = (case % 3 == 0).then(|| 200.0 * 30f64.powf(random()));
            let mode = if case % 2 == 0 { Mode::Smooth } else { Mode::Monotone };
            let limits = machine(10.0, 60.0, jerk);
            let dp = (random() - 0.3) * 10f64.powf(-2.0 * random());
            let [v0, v1] = [(); 2].map(|()| match mode {
                Mode::Smooth => 20.0 * random() - 10.0,
                Mode::Monotone => 10.0 * random() * dp.signum(),
            });
            let axes = problems([vec![dp], vec![0.0]], mode, &limits);
            let near = anywhere(&axes);
            let search = Search::new(&axes, &near, &[1e-3]);
            let axis = &search.axes[0];
            let slower = 1.0 - ROOM;
            let kept = |h: f64, beyond: f64| {
                let (start, end) = accelerations(dp, v0, v1, h);
                let middle = 3.0 * dp / h - v0 - v1;
                start.abs().max(end.abs()) <= beyond * slower.powi(2) * 60.0
                    && peak_velocity(dp, v0, v1, h).0 <= beyond * slower * 10.0
                    && jerk.is_none_or(|j| (end - start).abs() / h <= beyond * slower.powi(3) * j)
                    && (mode == Mode::Smooth || middle * dp.signum() >= -(beyond - 1.0) * 10.0)
            };
            let mut h = 1e-3;
            loop {
                let next = axis.least_time(0, v0, v1, h);
                if next <= h || next == f64::INFINITY {
                    h = next;
                    break;
                }
                h = next;
            }
            // The limits leave 1e-6 free in addition to the part that the search leaves; 1e-5 is more than that.
            let before = |part: f64| 1e-3 * (h.min(1e3) / 1e-3).powf(part);
            if h.is_finite() {
                assert!(kept(h, 1.0), "{case}: {h}");
                longer += usize::from(h > 1e-3);
            }
            none += usize::from(h.is_infinite());
            for k in 0..300 {
                let earlier = before(f64::from(k) / 300.0);
                let apart = h > 1e-3 && earlier < h * (1.0 - 1e-3);
                assert!(!apart || !kept(earlier, 1.0 - 1e-5), "{case}: {earlier} {h}");
            }
        }
        assert!(longer > 1000 && none > 300, "{longer} {none}");
    }

    #[test]
    fn a_line_that_is_asked_for_too_fast_takes_the_time_of_a_trapezoid() {
        // 300 segments of 0.1 mm at 10 mm/s and 60 mm/s^2: 30 / 10 + 10 / 60 s at the least.
        let limits = machine(10.0, 60.0, None);
        for mode in [Mode::Monotone, Mode::Smooth] {
            let axes = problems([vec![0.1; 300], vec![0.0; 300]], mode, &limits);
            let asked = [0.01; 300];
            let rest = [vec![0.0; 301], vec![0.0; 301]];
            let found = Search::new(&axes, &anywhere(&axes), &asked).run(&rest, &[true; 300]);
            let total_s: f64 = found.duration_s.iter().sum();
            assert!(total_s > 3.1666, "{mode:?}: {total_s}");
            // The part that the search leaves to the quadratic program, and a first segment whose acceleration falls
            // linearly.
            assert!(total_s < 3.1667 * (1.0 + 2.0 * ROOM) + 0.02, "{mode:?}: {total_s}");
            for (i, h) in found.duration_s.iter().enumerate() {
                let [v0, v1] = [0, 1].map(|end| found.velocity[0][i + end]);
                let (start, end) = accelerations(0.1, v0, v1, *h);
                assert!(start.abs().max(end.abs()) <= 60.0, "{mode:?} {i}");
                assert!(peak_velocity(0.1, v0, v1, *h).0 <= 10.0, "{mode:?} {i}");
            }
        }
    }

    #[test]
    fn one_segment_takes_what_it_needs_from_rest_to_rest() {
        // 1.5 * 3 / 10 s for the velocity, sqrt(6 * 3 / 60) s for the acceleration.
        let limits = machine(10.0, 60.0, None);
        let axes = problems([vec![3.0], vec![0.0]], Mode::Monotone, &limits);
        let found = Search::new(&axes, &anywhere(&axes), &[0.3])
            .run(&[vec![0.0; 2], vec![0.0; 2]], &[true]);
        let least_s = (18.0_f64 / 60.0).sqrt();
        let over = found.duration_s[0] / least_s;
        assert!(over > 1.0 && over < 1.0 + 2.0 * ROOM, "{over}");
    }

    #[test]
    fn segments_that_are_short_beside_the_way_to_brake_are_as_fast() {
        // 3 mm in segments of 1 um, over which the speed changes by 0.06 % where it is highest.
        let limits = machine(10.0, 60.0, None);
        let axes = problems([vec![1e-3; 3000], vec![0.0; 3000]], Mode::Monotone, &limits);
        let rest = [vec![0.0; 3001], vec![0.0; 3001]];
        let found = Search::new(&axes, &anywhere(&axes), &[1e-6; 3000]).run(&rest, &[true; 3000]);
        let total_s: f64 = found.duration_s.iter().sum();
        // Up for half of the way, and down: 2 sqrt(3 / 60) s.
        let least_s = 2.0 * (3.0_f64 / 60.0).sqrt();
        assert!(total_s > least_s && total_s < 1.05 * least_s, "{total_s} {least_s}");
    }

    #[test]
    fn what_is_far_from_segments_that_exceed_is_kept() {
        // 5 mm/s along 2000 segments; one in the middle has a tenth of the time.
        let limits = machine(10.0, 60.0, None);
        let axes = problems([vec![0.1; 2000], vec![0.0; 2000]], Mode::Monotone, &limits);
        let mut velocity = vec![5.0; 2001];
        (velocity[0], velocity[2000]) = (0.0, 0.0);
        let mut asked = vec![0.02; 2000];
        (asked[0], asked[1999]) = (1.0, 1.0);
        asked[1000] = 0.002;
        let exceed: Vec<bool> = (0..2000).map(|i| i == 1000).collect();
        let before = [velocity, vec![0.0; 2001]];
        let found = Search::new(&axes, &anywhere(&axes), &asked).run(&before, &exceed);
        let other = |i: &usize| found.duration_s[*i] != asked[*i];
        assert!((0..2000).filter(other).all(|i| i == 1000), "only what is too fast is slower");
        // 0.1 mm at no more than 10 mm/s, with the velocities of the others.
        assert!((0.01..0.02).contains(&found.duration_s[1000]), "{}", found.duration_s[1000]);
        let moved = |i: &usize| found.velocity[0][*i] != before[0][*i];
        // To brake and to be as fast again takes 0.33 s, that is 17 segments, on each side.
        assert!((0..=2000).filter(moved).all(|i| (980..=1021).contains(&i)));
    }

    #[test]
    fn where_what_is_kept_cannot_be_reached_everything_may_change() {
        // The segments beside the one that exceeds are far too short to brake in from the velocities that are kept.
        let limits = machine(10.0, 60.0, None);
        let mut dp = vec![0.1; 60];
        dp[10..50].fill(1e-6);
        let mut velocity = vec![9.0; 61];
        (velocity[0], velocity[60]) = (0.0, 0.0);
        velocity[25..=35].fill(1e-4);
        let asked: Vec<f64> = dp.iter().map(|dp| dp / 9.0).collect();
        let axes = problems([dp, vec![0.0; 60]], Mode::Monotone, &limits);
        let exceed: Vec<bool> = (0..60).map(|i| i == 30).collect();
        let near = anywhere(&axes);
        let search = Search::new(&axes, &near, &asked);
        let pairs: Vec<Velocity> = velocity.iter().map(|v| [*v, 0.0]).collect();
        let open: Vec<bool> = (0..=60).map(|node| (23..=37).contains(&node)).collect();
        assert!(search.along_the_path(&open, &pairs).is_none());
        let before = [velocity, vec![0.0; 61]];
        let found = search.run(&before, &exceed);
        for i in 0..60 {
            let [v0, v1] = [0, 1].map(|end| found.velocity[0][i + end]);
            let least = search.least_time(i, [v0, 0.0], [v1, 0.0]);
            assert!(least <= found.duration_s[i] * (1.0 + 1e-12), "{i}");
        }
    }
}
