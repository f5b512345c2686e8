//! Node velocities of one axis: equation (4) of [`super`] under the limits of the machine.
//!
//! The free minimiser is a tridiagonal solution. If it exceeds a limit, a quadratic program is solved.
//! If that has no solution, the quadratic program with the least excess over the limits shows the segments that
//! need more time, and [`super::shortest`] finds the times. Equation numbers are those of [`super`].

use std::{borrow::Cow, collections::BTreeMap, ops::Range, sync::OnceLock};

use planish_numerics::qp::chain;
use planish_types::AxisLimits;
use rayon::prelude::*;
use serde::Serialize;

use super::{mode::Mode, timing::parallel};
use crate::hermite::{accelerations, peak_velocity};

/// Part of every limit that the schedule leaves free, relative: room for the tolerance of the interior point method
/// (1e-7 at the worst) and the rounding of `planish verify`. Larger: motions are slower. Smaller: `planish verify` can
/// report an excess.
const MARGIN: f64 = 1e-6;

/// Solver of the least-energy problem, (4) of [`super`], for one axis. If the axis has several parts, the solver of the
/// hardest one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// No bound is active; one tridiagonal solve suffices.
    Tridiagonal,
    /// Bounds are active; the interior point method solved a quadratic program.
    QuadraticProgram,
    /// The motion of the search for the shortest times was taken. Either the interior point method did not converge, or
    /// the motions of both axes together would leave the path. It keeps the limits, but does not have the least energy.
    LeastTime,
}

/// Form in which the limits of the machine enter the quadratic program.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Bounds {
    /// The limits must hold.
    Hard,
    /// The limits are exceeded as little as possible.
    Elastic {
        /// Penalty for an excess of 1 (relative to the limit) that lasts 1 s.
        price: f64,
    },
}

/// Largest number of quadratic programs until all limits that become active have rows. Every quadratic program reaches
/// four times as many neighbours as the one before, and the times of the largest velocity settle after a few. Larger:
/// an endless case runs longer. Smaller: a solvable program is given up.
const MAX_PROGRAMS: usize = 24;

/// Weight of the acceleration energy relative to the penalty for exceeding the limits. Larger: limits
/// are exceeded for the sake of a smaller energy. Smaller: the energy no longer selects one of the
/// motions with the least excess.
const ELASTIC_ENERGY: f64 = 1e-4;

/// Least-energy problem, (4) of [`super`], of one axis with N segments.
#[derive(Debug)]
pub(super) struct AxisProblem<'a> {
    pub(super) displacement_mm: Cow<'a, [f64]>,
    /// Smallest and largest velocity of each node (N+1) that keep the motion near its path, mm/s; empty if nothing
    /// bounds them. Rest is always near the path, even if zero is outside of the range.
    pub(super) velocity_range: Cow<'a, [[f64; 2]]>,
    mode: Mode,
    pub(super) max_velocity: f64,
    pub(super) max_acceleration: f64,
    /// Jerk limit, mm/s^3; infinite if the machine has none.
    pub(super) max_jerk: f64,
}

/// Motion of an axis that exceeds its limits at the given times.
#[derive(Debug)]
pub(super) struct Exceeding {
    /// Node velocities (N+1), mm/s; they keep the limits in the segments whose excess is 1.
    pub(super) velocity: Vec<f64>,
    /// Excess of each segment (N): the factor by which its time should grow at least; 1 if it keeps the
    /// limits.
    pub(super) excess: Vec<f64>,
}

/// Part of an axis: its segments from a node at rest to another. Neither (4) of [`super`] nor a bound couples the two
/// sides of a node whose velocity is fixed at zero, so the parts are solved one by one. They fit the caches, and a part
/// whose times do not change is solved once.
#[derive(Debug)]
pub(super) struct Part {
    pub(super) segments: Range<usize>,
    /// Segments for which earlier quadratic programs needed the limits of the machine as rows (linear constraints).
    pub(super) limited: Vec<usize>,
    /// Solution at the present durations, by [`AxisProblem::solve`]; `None` if it is not solved yet.
    pub(super) solved: Option<Result<Solved, Exceeding>>,
}

/// Smallest number of segments of a part. Larger: fewer parts, which fit the caches less, and more
/// segments to solve again. Smaller: parts cost more to set up than to solve.
const LEAST_PART_SEGMENTS: usize = 64;

/// Returns the excess factor of each of `n` segments, the larger one of both axes; `None` if no part exceeds the
/// limits.
pub(super) fn excess_of_parts(parts: &[Vec<Part>; 2], n: usize) -> Option<Vec<f64>> {
    let mut all = None;
    for part in parts.iter().flatten() {
        if let Some(Err(exceeding)) = &part.solved {
            let all = &mut all.get_or_insert_with(|| vec![1.0_f64; n])[part.segments.clone()];
            all.iter_mut().zip(&exceeding.excess).for_each(|(a, e)| *a = a.max(*e));
        }
    }
    all
}

/// Returns the node velocities of an axis, mm/s, from its solved parts, including parts that exceed limits.
pub(super) fn velocity_of_parts(parts: &[Part]) -> Vec<f64> {
    let mut all = vec![0.0];
    for part in parts {
        let velocity = match part.solved.as_ref().expect("every part is solved") {
            Ok(solved) => &solved.velocity,
            Err(exceeding) => &exceeding.velocity,
        };
        all.extend(&velocity[1..]); // the first is at rest, and the last one of the part before
    }
    all
}

/// Returns the solution of a whole axis, joined from its parts; every part has to be solved within the limits.
pub(super) fn joined(parts: Vec<Part>) -> Solved {
    let mut parts = parts.into_iter().filter_map(|part| part.solved?.ok());
    let mut all = parts.next().expect("every part is solved");
    for part in parts {
        all.velocity.pop(); // the node at rest
        all.velocity.extend(part.velocity);
        all.solver = all.solver.max(part.solver);
    }
    all
}

/// Segments, and times within them, for which a quadratic program has the limits of the machine as rows (linear
/// constraints).
#[derive(Debug)]
struct Limited {
    /// True for each segment (N) whose limits are rows of the quadratic program.
    segment: Vec<bool>,
    /// Times, as parts of the duration, at which the velocity of a segment is bounded in addition to its middle, by
    /// segment.
    velocity_at: BTreeMap<usize, Vec<f64>>,
}

impl Limited {
    /// Returns the times, as parts of the duration, at which the velocity of segment `i` is bounded.
    fn times(&self, i: usize) -> impl Iterator<Item = f64> {
        std::iter::once(0.5).chain(self.velocity_at.get(&i).into_iter().flatten().copied())
    }
}

/// Node velocities (N+1), mm/s, and the solver that found them.
#[derive(Debug)]
pub(super) struct Solved {
    pub(super) velocity: Vec<f64>,
    pub(super) solver: Solver,
}

impl AxisProblem<'_> {
    /// Returns the problem of an axis with these displacements of its segments, mm, and these limits.
    pub(super) fn new(displacement_mm: Vec<f64>, mode: Mode, limits: &AxisLimits) -> Self {
        Self {
            displacement_mm: Cow::Owned(displacement_mm),
            velocity_range: Cow::Borrowed(&[]),
            mode,
            max_velocity: (1.0 - MARGIN) * limits.max_velocity_mm_per_s(),
            max_acceleration: (1.0 - MARGIN) * limits.max_acceleration_mm_per_s2(),
            // Twice: its use of the limit is a cube root, compared with 1 + MARGIN / 2.
            max_jerk: limits
                .max_jerk_mm_per_s3()
                .map_or(f64::INFINITY, |j| (1.0 - 2.0 * MARGIN) * j),
        }
    }

    /// Returns the problem of the same axis, with its limits and mode, along other segments.
    pub(super) fn along(&self, displacement_mm: Vec<f64>) -> AxisProblem<'static> {
        AxisProblem {
            displacement_mm: Cow::Owned(displacement_mm),
            velocity_range: Cow::Borrowed(&[]),
            ..*self
        }
    }

    /// Bounds the velocity of a node to a range, mm/s.
    pub(super) fn bound_velocity(&mut self, node: usize, range: [f64; 2]) {
        if self.velocity_range.is_empty() {
            let free = [f64::NEG_INFINITY, f64::INFINITY];
            self.velocity_range = Cow::Owned(vec![free; self.displacement_mm.len() + 1]);
        }
        self.velocity_range.to_mut()[node] = range;
    }

    /// Returns the smallest and largest velocity of a node, mm/s; `None` if nothing bounds it.
    fn range_of(&self, node: usize) -> Option<[f64; 2]> {
        self.velocity_range.get(node).copied().filter(|range| range[0] > f64::NEG_INFINITY)
    }

    fn is_within_ranges(&self, v: &[f64]) -> bool {
        let ranges = self.velocity_range.iter().zip(v);
        ranges.into_iter().all(|([low, high], v)| low <= v && v <= high)
    }

    /// Returns the parts of the axis: one part in *smooth*. In *monotone* it cuts the axis at nodes at which the signs
    /// of the displacements fix the velocity at zero. A part before a cut has at least [`LEAST_PART_SEGMENTS`].
    pub(super) fn parts(&self) -> Vec<Part> {
        let n = self.displacement_mm.len();
        let mut parts = Vec::new();
        let mut start = 0;
        for node in 1..=n {
            let is_long =
                node - start >= LEAST_PART_SEGMENTS && self.allowed_signs(node) == [false, false];
            if is_long || node == n {
                parts.push(Part { segments: start..node, limited: Vec::new(), solved: None });
                start = node;
            }
        }
        parts
    }

    /// Solves the parts that are not solved yet at the durations `h` (N), s.
    pub(super) fn solve_parts(&self, h: &[f64], parts: &mut [Part]) {
        let price = OnceLock::new();
        parts.par_iter_mut().filter(|part| part.solved.is_none()).for_each(|part| {
            let segments = part.segments.clone();
            let displacement_mm = Cow::Borrowed(&self.displacement_mm[segments.clone()]);
            let velocity_range = if self.velocity_range.is_empty() {
                Cow::Borrowed(&[][..])
            } else {
                Cow::Borrowed(&self.velocity_range[segments.start..=segments.end])
            };
            let problem = AxisProblem { displacement_mm, velocity_range, ..*self };
            let price = || *price.get_or_init(|| self.elastic_price(h));
            part.solved = Some(problem.solve(&h[segments], price, &mut part.limited));
        });
    }

    /// Returns the node velocities within the limits at the durations `h`, s. If there are none, the error has those
    /// with the least excess, or rest at every node if the elastic program does not converge. `price` returns the
    /// penalty of the elastic bounds; `limited` has the segments with rows, and gets new ones.
    fn solve(
        &self,
        h: &[f64],
        price: impl Fn() -> f64,
        limited: &mut Vec<usize>,
    ) -> Result<Solved, Exceeding> {
        let free = self.clamped_spline(h);
        let allowed = self.mode == Mode::Smooth || self.is_monotone(&free, h);
        if allowed
            && self.is_within_ranges(&free)
            && parallel(h.len()).all(|i| self.excess_of(i, &free, h) <= 1.0)
        {
            return Ok(Solved { velocity: free, solver: Solver::Tridiagonal });
        }
        drop(free); // its memory is the quadratic program's
        if let Some(velocity) = self.quadratic_program(h, Bounds::Hard, limited) {
            return Ok(Solved { velocity, solver: Solver::QuadraticProgram });
        }
        // If the bounds allow a single motion only, hard rows have no interior and the method does not
        // converge. With the elastic ones it does, and no limit is exceeded.
        let within = 1.0 + 0.5 * MARGIN;
        let elastic = self.quadratic_program(h, Bounds::Elastic { price: price() }, limited);
        let converged = elastic.is_some();
        // At rest in every control point it has no need of its neighbours.
        let velocity = elastic.unwrap_or_else(|| vec![0.0; h.len() + 1]);
        let mut excess = self.excess(&velocity, h);
        if excess.iter().all(|e| *e <= within) {
            let solver = if converged { Solver::QuadraticProgram } else { Solver::LeastTime };
            return Ok(Solved { velocity, solver });
        }
        excess.iter_mut().filter(|e| **e <= within).for_each(|e| *e = 1.0);
        Err(Exceeding { velocity, excess })
    }

    /// Returns the minimiser of (4) of [`super`] without limits, by elimination in H v = g; H is diagonally dominant.
    fn clamped_spline(&self, h: &[f64]) -> Vec<f64> {
        let n = h.len();
        let dp = &self.displacement_mm;
        let mut v = vec![0.0; n + 1];
        // Forward elimination of nodes 1 .. n-1; v_0 = v_n = 0.
        let mut upper = vec![0.0; n];
        let mut a = 1.0 / h[0];
        for i in 1..n {
            let b = 1.0 / h[i];
            let pivot = 1.0 / (4.0 * (a + b) - 2.0 * a * upper[i - 1]);
            let g = 6.0 * (dp[i - 1] * a * a + dp[i] * b * b);
            upper[i] = 2.0 * b * pivot;
            v[i] = (g - 2.0 * a * v[i - 1]) * pivot;
            a = b;
        }
        for i in (1..n).rev() {
            v[i] -= upper[i] * v[i + 1];
        }
        v
    }

    /// Returns the factor by which the time of each segment (N) should grow; up to 1 if it keeps the limits. The
    /// velocity falls with the time, the acceleration with its square, the jerk with its cube.
    pub(super) fn excess(&self, v: &[f64], h: &[f64]) -> Vec<f64> {
        (0..h.len()).map(|i| self.excess_of(i, v, h)).collect()
    }

    fn excess_of(&self, i: usize, v: &[f64], h: &[f64]) -> f64 {
        let dp = self.displacement_mm[i];
        let v0 = v[i];
        let v1 = v[i + 1];
        let h = h[i];
        let (start, end) = accelerations(dp, v0, v1, h);
        let a = (start.abs().max(end.abs()) / self.max_acceleration).sqrt();
        let excess = a.max(peak_velocity(dp, v0, v1, h).0 / self.max_velocity);
        if self.max_jerk.is_infinite() {
            return excess;
        }
        excess.max(((end - start).abs() / (h * self.max_jerk)).cbrt())
    }

    /// Returns two flags: true if the velocity of node `i` may be negative, and true if it may be positive.
    pub(super) fn allowed_signs(&self, i: usize) -> [bool; 2] {
        let n = self.displacement_mm.len();
        if i == 0 || i == n {
            return [false, false];
        }
        if self.mode == Mode::Smooth {
            return [true, true];
        }
        let (before, after) = (self.displacement_mm[i - 1], self.displacement_mm[i]);
        [before < 0.0 && after < 0.0, before > 0.0 && after > 0.0]
    }

    /// Returns true if the axis may reverse inside a segment.
    pub(super) fn is_reversal_allowed(&self) -> bool {
        self.mode == Mode::Smooth
    }

    fn is_monotone(&self, v: &[f64], h: &[f64]) -> bool {
        let have_signs = v.iter().enumerate().all(|(i, v)| {
            let [negative, positive] = self.allowed_signs(i);
            (*v >= 0.0 || negative) && (*v <= 0.0 || positive)
        });
        have_signs
            && (0..h.len()).all(|i| {
                let dp = self.displacement_mm[i];
                dp * (3.0 * dp / h[i] - v[i] - v[i + 1]) >= 0.0
            })
    }

    /// Returns true if the segment `i` exceeds a limit by more than the tolerance of the solver.
    fn exceeds(&self, i: usize, v: &[f64], h: &[f64]) -> bool {
        self.excess_of(i, v, h) > 1.0 + 0.5 * MARGIN
    }

    /// Returns the minimiser of (4) of [`super`] within the bounds of the mode and of the machine; `None` if none is
    /// found.
    ///
    /// Most segments are far from the machine's limits. A segment gets rows for the limits if the motion without them
    /// exceeds a limit, with more and more of its neighbours. The largest velocity can lie anywhere in the segment: the
    /// program bounds it at the middle first, then at each time of an excess.
    fn quadratic_program(
        &self,
        h: &[f64],
        bounds: Bounds,
        known: &mut Vec<usize>,
    ) -> Option<Vec<f64>> {
        let n = h.len();
        if (0..=n).all(|i| self.allowed_signs(i) == [false, false]) {
            // The axis rests in every control point.
            let v = vec![0.0; n + 1];
            let is_solution =
                bounds != Bounds::Hard || !parallel(n).any(|i| self.exceeds(i, &v, h));
            return if is_solution { Some(v) } else { None };
        }
        let mut limited = Limited { segment: vec![false; n], velocity_at: BTreeMap::new() };
        known.iter().for_each(|i| limited.segment[*i] = true);
        let mut reach = 2;
        for _ in 0..MAX_PROGRAMS {
            let program = self.program(h, bounds);
            let v = chain::solve(program, |i, rows| self.rows(i, h, &limited, rows)).ok()?;
            let v = self.exact_at_fixed_nodes(v);
            let mut complete = true;
            let mut with_rows: Vec<usize> = Vec::new();
            let exceeding: Vec<usize> = parallel(n).filter(|i| self.exceeds(*i, &v, h)).collect();
            for i in exceeding {
                if !limited.segment[i] {
                    with_rows.push(i);
                } else if bounds == Bounds::Hard {
                    let (peak, u) = peak_velocity(self.displacement_mm[i], v[i], v[i + 1], h[i]);
                    let known = limited.times(i).any(|k| (k - u).abs() < 1e-9);
                    if peak <= self.max_velocity || known {
                        return None;
                    }
                    limited.velocity_at.entry(i).or_default().push(u);
                    complete = false;
                }
            }
            for i in with_rows {
                for near in i.saturating_sub(reach)..(i + reach + 1).min(n) {
                    if !limited.segment[near] {
                        limited.segment[near] = true;
                        known.push(near);
                    }
                }
                complete = false;
            }
            if complete {
                return Some(v);
            }
            reach *= 4;
        }
        None
    }

    /// Returns the penalty of elastic bounds for an excess of 1 that lasts 1 s, in units of the acceleration energy. It
    /// follows from the largest energy and the largest mean velocity of the axis, so that the energy hardly counts
    /// against it.
    fn elastic_price(&self, h: &[f64]) -> f64 {
        let n = h.len();
        let dp = &self.displacement_mm;
        let ends = (4.0 / h[0]).max(4.0 / h[n - 1]);
        let energy = (1..n).map(|i| 4.0 / h[i - 1] + 4.0 / h[i]).fold(ends, f64::max);
        let mean = (0..n).map(|i| dp[i].abs() / h[i]).fold(0.0, f64::max);
        let mean_s = h.iter().sum::<f64>() / n as f64;
        energy * mean * mean / (ELASTIC_ENERGY * mean_s)
    }

    /// Returns the quadratic program of (4) of [`super`]; with elastic bounds it includes the penalty for exceeding
    /// them.
    ///
    /// Elastic bounds: segment i may exceed its limits by the fraction e_i >= 0, a variable of its own. The
    /// penalty is proportional to h_i e_i, about twice the time that a stretch of the segment would add.
    /// The excesses are then few and need little time.
    fn program(&self, h: &[f64], bounds: Bounds) -> chain::ChainProgram {
        let n = h.len();
        let dp = &self.displacement_mm;
        let diagonal = parallel(n + 1).map(|node| beside_node(node, n).map(|i| 4.0 / h[i]).sum());
        let linear = parallel(n + 1)
            .map(|node| beside_node(node, n).map(|i| 6.0 * dp[i] / (h[i] * h[i])).sum());
        let beside = parallel(n).map(|i| 2.0 / h[i]).collect();
        let price = match bounds {
            Bounds::Hard => Vec::new(),
            Bounds::Elastic { price } => h.iter().map(|h| price * h).collect(),
        };
        let free = parallel(n + 1).map(|i| self.allowed_signs(i) != [false, false]).collect();
        let (diagonal, linear) = (diagonal.collect(), linear.collect());
        chain::ChainProgram { diagonal, beside, linear, free, price }
    }

    /// Adds the rows (linear constraints) of segment `i` at the durations `h`, s, to `rows`. They are its velocity
    /// range, the signs of the mode, and the limits of the machine if `limited` has the segment.
    fn rows(&self, i: usize, h: &[f64], limited: &Limited, rows: &mut chain::ChainRows) {
        let dp = self.displacement_mm[i];
        if let Some([low, high]) = self.range_of(i) {
            rows.add([1.0, 0.0], 0.0, high);
            rows.add([-1.0, 0.0], 0.0, -low);
        }
        if self.mode == Mode::Monotone {
            // v_i >= 0 or v_i <= 0;  sign(dp) (v0 + v1) <= 3 |dp| / h
            match self.allowed_signs(i) {
                [false, true] => rows.add([-1.0, 0.0], 0.0, 0.0),
                [true, false] => rows.add([1.0, 0.0], 0.0, 0.0),
                _ => {}
            }
            let sign = dp.signum();
            if dp != 0.0 {
                rows.add([sign, sign], 0.0, 3.0 * dp.abs() / h[i]);
            }
        }
        if !limited.segment[i] {
            return;
        }
        // |6 dp/h - (4 v0 + 2 v1)| <= a h,  |-6 dp/h + (2 v0 + 4 v1)| <= a h
        let d = dp / h[i];
        let a = self.max_acceleration * h[i];
        let v_max = self.max_velocity;
        add_both(rows, [-4.0, -2.0], 6.0 * d, a);
        add_both(rows, [2.0, 4.0], -6.0 * d, a);
        add_both(rows, [1.0, 0.0], 0.0, v_max);
        add_both(rows, [0.0, 1.0], 0.0, v_max);
        if self.max_jerk.is_finite() {
            // |6 (v0 + v1) - 12 dp/h| <= j h^2
            add_both(rows, [6.0, 6.0], -12.0 * d, self.max_jerk * h[i] * h[i]);
        }
        for u in limited.times(i) {
            // v(u) = (1-u)^2 v0 + 2u(1-u) (3 dp/h - v0 - v1) + u^2 v1
            let w = 1.0 - u;
            let m = 2.0 * u * (1.0 - u);
            add_both(rows, [w * w - m, u * u - m], 3.0 * m * d, v_max);
        }
    }

    /// Moves velocities into their bounds, which the solver can miss by its tolerance. Velocities that are fixed at
    /// zero become exactly zero; the others get an allowed sign and their range.
    fn exact_at_fixed_nodes(&self, mut v: Vec<f64>) -> Vec<f64> {
        for (i, v) in v.iter_mut().enumerate() {
            let [negative, positive] = self.allowed_signs(i);
            *v = v.clamp(
                if negative { f64::NEG_INFINITY } else { 0.0 },
                if positive { f64::INFINITY } else { 0.0 },
            );
            if let Some([low, high]) = self.range_of(i).filter(|_| negative || positive) {
                *v = v.clamp(low, high);
            }
        }
        v
    }
}

/// Returns the indices of the segments beside a node, of `n` segments in all.
fn beside_node(node: usize, n: usize) -> Range<usize> {
    node.saturating_sub(1)..(node + 1).min(n)
}

/// Adds the two rows of `|row . v + constant| <= bound`, with `v` the velocities of two neighbouring nodes.
fn add_both(rows: &mut chain::ChainRows, row: [f64; 2], constant: f64, bound: f64) {
    rows.add(row, bound, bound - constant);
    rows.add(row.map(|v| -v), bound, bound + constant);
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::break_times;

    /// Limit that is never active, within a few orders of magnitude of the other numbers.
    const FREE: f64 = 1e4;

    fn problem(points: &[f64], mode: Mode, max_acceleration: f64) -> AxisProblem<'static> {
        let displacement_mm = points.windows(2).map(|w| w[1] - w[0]).collect();
        let max_jerk = f64::INFINITY;
        let velocity_range = Cow::Borrowed(&[][..]);
        AxisProblem {
            displacement_mm,
            velocity_range,
            mode,
            max_velocity: FREE,
            max_acceleration,
            max_jerk,
        }
    }

    fn velocities(points: &[f64], h: &[f64], mode: Mode, max_acceleration: f64) -> Vec<f64> {
        solve(&problem(points, mode, max_acceleration), h).unwrap().velocity
    }

    fn solve(problem: &AxisProblem, h: &[f64]) -> Result<Solved, Exceeding> {
        problem.solve(h, || problem.elastic_price(h), &mut Vec::new())
    }

    fn close(a: &[f64], b: &[f64], tolerance: f64) {
        assert_eq!(a.len(), b.len());
        assert!(a.iter().zip(b).all(|(x, y)| (x - y).abs() < tolerance), "{a:?} {b:?}");
    }

    #[test]
    fn smooth_is_the_clamped_cubic_spline() {
        // Solved by hand: 4 v1 + v2 = 9, v1 + 4 v2 = 9.
        let v = velocities(&[0.0, 1.0, 3.0, 4.0], &[1.0; 3], Mode::Smooth, FREE);
        close(&v, &[0.0, 1.8, 1.8, 0.0], 1e-14);
        let a: Vec<(f64, f64)> = [1.0, 2.0, 1.0]
            .iter()
            .enumerate()
            .map(|(i, dp)| accelerations(*dp, v[i], v[i + 1], 1.0))
            .collect();
        for (found, expected) in a.iter().zip([(2.4, 1.2), (1.2, -1.2), (-1.2, -2.4)]) {
            assert!((found.0 - expected.0).abs() + (found.1 - expected.1).abs() < 1e-13, "{a:?}");
        }
        assert!((peak_velocity(2.0, 1.8, 1.8, 1.0).0 - 2.1).abs() < 1e-14);
        let v = velocities(&[0.0, 1.0, 2.0, 3.0, 2.0], &[1.0; 4], Mode::Smooth, FREE);
        close(&v, &[0.0, 1.178_571_43, 1.285_714_29, -0.321_428_57, 0.0], 1e-8);
    }

    #[test]
    fn monotone_never_reverses_and_has_the_least_energy() {
        // Minimisers of (4) under the signs, from the optimality conditions of each case; the
        // interior point method reaches 1e-14 of the objective, 1e-7 of the velocity.
        let mono = |p: &[f64], h: &[f64], a: f64| velocities(p, h, Mode::Monotone, a);
        close(&mono(&[0.0, 1.0, 2.0, 3.0, 2.0], &[1.0; 4], FREE), &[0.0, 1.2, 1.2, 0.0, 0.0], 1e-6);
        let (p, h) = ([0.0, 1.0, 2.0, 3.0, 4.0], [1.0, 0.3, 1.0, 1.0]);
        close(&mono(&p, &h, FREE), &[0.0, 3.0, 2.75, 0.25, 0.0], 1e-6);
        close(&mono(&p, &h, 8.0), &[0.0, 3.0, 2.9, 0.1, 0.0], 1e-6);
        close(&mono(&[0.0, 1.0, 1.0, 3.0], &[1.0, 0.5, 2.0], FREE), &[0.0; 4], 1e-12);
    }

    #[test]
    fn the_parts_are_the_whole() {
        // Runs of a few segments to and fro with rests between; limits that some of them reach.
        let wave = |i: i32| (f64::from(i) * 0.37).sin() + 0.4 * (f64::from(i) * 1.9).sin();
        let dp: Vec<f64> = (0..700).map(|i| if i % 31 == 0 { 0.0 } else { wave(i) }).collect();
        let h: Vec<f64> = (0..700).map(|i| 0.6 + 0.2 * f64::from(i * 7 % 5)).collect();
        let mut p = problem(&break_times(&dp), Mode::Monotone, 0.0);
        // Loose; active here and there; too tight for some parts.
        for (limit, feasible) in [(40.0, true), (15.0, true), (8.0, false)] {
            p.max_acceleration = limit;
            let mut parts = p.parts();
            p.solve_parts(&h, &mut parts);
            let solved = parts.iter().filter(|part| matches!(part.solved, Some(Ok(_)))).count();
            match solve(&p, &h) {
                Ok(whole) => {
                    assert!(feasible && solved == parts.len() && solved > 5, "{limit} {solved}");
                    // The root of the tolerance of 1e-14 where a bound is only just active.
                    close(&joined(parts).velocity, &whole.velocity, 1e-6);
                }
                Err(whole) => {
                    assert!(!feasible && solved > 0 && solved < parts.len(), "{limit} {solved}");
                    let excess = excess_of_parts(&[parts, Vec::new()], h.len()).unwrap();
                    // The tolerance of the elastic program, whose largest term is the price.
                    close(&excess, &whole.excess, 1e-5);
                }
            }
        }
    }

    #[test]
    fn the_quadratic_program_without_active_bounds_is_the_tridiagonal_solution() {
        let p = [0.0, 0.7, 1.9, 2.4, 2.2, -1.0, -1.5, 0.3];
        let h = [0.3, 0.4, 0.11, 0.7, 0.9, 0.25, 0.6];
        let problem = problem(&p, Mode::Smooth, FREE);
        let (a, b) = (
            problem.clamped_spline(&h),
            problem.quadratic_program(&h, Bounds::Hard, &mut Vec::new()).unwrap(),
        );
        // The interior point method starts from the same elimination: nothing is active.
        close(&a, &b, 1e-12);
    }

    #[test]
    fn an_active_limit_holds_and_costs_energy_but_no_time() {
        let p = [0.0, 1.0, 3.0, 4.0];
        let h = [1.0; 3];
        let free = velocities(&p, &h, Mode::Smooth, FREE);
        let bounded = solve(&problem(&p, Mode::Smooth, 2.2), &h).unwrap();
        assert_eq!(bounded.solver, Solver::QuadraticProgram);
        let energy = |v: &[f64]| -> f64 {
            (0..3)
                .map(|i| {
                    let (a, b) = accelerations(p[i + 1] - p[i], v[i], v[i + 1], 1.0);
                    (a * a + a * b + b * b) / 3.0
                })
                .sum()
        };
        assert!(
            problem(&p, Mode::Smooth, 2.2)
                .excess(&bounded.velocity, &h)
                .iter()
                .all(|e| *e < 1.0 + 1e-6)
        );
        assert!(energy(&bounded.velocity) > energy(&free));
        // Below 2 no velocities exist: 1 mm from rest, 2 mm, 1 mm to rest in 1 s each.
        assert!(solve(&problem(&p, Mode::Smooth, 1.5), &h).is_err());
    }

    #[test]
    fn the_peak_between_nodes_is_bounded_not_only_the_nodes() {
        // Rest to rest: the nodes are at zero, the middle at 1.5 times the mean velocity.
        let mut one = problem(&[0.0, 1.0], Mode::Smooth, FREE);
        one.max_velocity = 1.49;
        let excess = solve(&one, &[1.0]).unwrap_err().excess;
        assert!((excess[0] - 1.5 / 1.49).abs() < 1e-12);
        one.max_velocity = 1.51;
        assert!(solve(&one, &[1.0]).is_ok());
    }
}
