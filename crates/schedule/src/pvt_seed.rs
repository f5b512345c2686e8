//! PVT as its source states it: least squares in the coefficients, for comparison with [`crate::pvt`].
//!
//! Per axis, six unknowns per segment: the four coefficients of its cubic and the velocity `v` and
//! the acceleration `a` of its end node. In segment-local time the rows of the least squares are
//!
//! ```text
//! p(0) = P0     p(h) = P1     p'(0) = v0     p'(h) = v1     p''(0) = a0     p''(h) = a1      (1)
//! ```
//!
//! all of weight 1 in mm, mm/s and mm/s^2, with the hard rows `p''_i(h) = p''_{i+1}(0)` at the
//! inner nodes (Eq. 13), `v = a = 0` at both ends (Eq. 16), `|a| <= a_max` (Eq. 17), and
//! `0 <= v_i <= v_max` where `P_{i+1} >= P_i`, else `-v_max <= v_i <= 0` (Eq. 18). Of the solution
//! only the velocities are kept: the cubics are those of Eq. 8 through the exact positions.
//!
//! Solved without loss in fewer unknowns. The accelerations `A` of the cubics at the nodes, shared
//! by Eq. 13, and the start `(p, w)` give a segment's cubic, so that
//!
//! ```text
//! p(h) = p + h w + h^2 (A0/3 + A1/6),   p'(h) = w + h (A0 + A1)/2                             (2)
//! ```
//!
//! and `(p, w)` is eliminated from the four first rows of (1): the two combinations without them,
//! of length 1 and at right angles, are
//!
//! ```text
//! (v1 - v0 - h (A0 + A1)/2) / sqrt 2 = 0
//! (P1 - P0 - h (v0 + v1)/2 + h^2 (A1 - A0)/12) / sqrt(2 + h^2/2) = 0                          (3)
//! ```
//!
//! and the cubic misses its points by the last, r: `p(0) - P0 = P1 - p(h) = r / sqrt(2 + h^2/2)`.
//! The unknowns `(v, A, a)` of the nodes are solved for by Givens rotations of the rows; the normal
//! equations hold the squares of `h^2/12`, which at 1e-4 s vanish in the rounding of 1. The bounds
//! are met by active sets.
//!
//! What the report shows and nothing repairs: the squares of unlike units are added, so the
//! positions, cheapest to violate, are missed by up to 0.37 mm on the reference mirror before Eq. 8
//! puts them right, which breaks the continuity of the acceleration; an axis at rest is asked for
//! `v_i >= 0` and moves; neither the inside of a segment nor the limits after Eq. 8 are looked at.
//!
//! Source: T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005, Eqs 8-18.
//! Corrected: Eq. 16 pins the end of the first segment where it means its start (the `v = a = 0`
//! here is that of node 0; [`Eq16::Printed`] pins both, and misses positions by up to 0.495 mm); Eq. 18 is not defined for the last node, which rests. The time of the
//! source is absolute, whose t^3 leaves no digit at 30 s; the local one is the same least squares
//! in other variables.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | h | `duration_s` | (N) | s |
//! | P1 - P0 | `displacement_mm` | (N) | mm |
//! | v, A, a | `Nodes::value` | (N+1) | mm/s, mm/s^2, mm/s^2 |

use clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettingsBuilder, DefaultSolver, IPSolver,
        SupportedConeT::{NonnegativeConeT, ZeroConeT},
    },
};
use planish_types::{DwellTime, Invalid, Limits, NotConverged, ToolPath, Trajectory, break_times};
use serde::Serialize;

use crate::{ScheduleError, check_lengths, pvt::accelerations, pvt::hermite};

/// Which node the first two rows of Eq. 16 fix.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Eq16 {
    /// The start: `v = a = 0` at node 0.
    #[default]
    Corrected,
    /// As printed: at node 0 and, since the unknowns of the first segment belong to its end, at
    /// node 1 too.
    Printed,
}

/// What came of it, per axis [x, y].
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// Largest distance of the least-squares cubics from their control points, mm.
    pub largest_position_error_mm: [f64; 2],
    /// RMS of that distance over both ends of every segment, mm.
    pub rms_position_error_mm: [f64; 2],
    /// Segments along which the axis rests (no displacement).
    pub resting_segments: [usize; 2],
    /// Largest |velocity| at a node between two such segments, mm/s.
    pub largest_resting_velocity_mm_per_s: [f64; 2],
    /// Largest |velocity| against the displacement of its segment at one of its nodes, mm/s.
    pub largest_reverse_velocity_mm_per_s: [f64; 2],
    /// Largest step of the acceleration at an inner node after Eq. 8, mm/s^2.
    pub largest_acceleration_step_mm_per_s2: [f64; 2],
    /// Nodes whose velocity is at a bound of Eq. 18.
    pub velocities_at_a_bound: [usize; 2],
    /// Factorisations of the active set method; more than 60 where it repeated itself and went on
    /// one bound at a time from the solution of the interior point method.
    pub factorisations: [usize; 2],
    /// How far the solution is from a least one: the longest step of one unknown within its bounds
    /// that the gradient asks for, by the change of the rows, over the right-hand side.
    pub optimality: [f64; 2],
    /// Segments without length and dwell time, left out.
    pub dropped: Vec<usize>,
}

/// The motion and what came of it.
#[derive(Clone, Debug)]
pub struct Schedule {
    /// Motion.
    pub trajectory: Trajectory,
    /// What came of it.
    pub report: Report,
}

/// Schedules `path` with the times `dwell`; nothing is stretched.
///
/// Refuses a dwell time of zero on a segment with a length: the cubic has no time.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    eq_16: Eq16,
) -> Result<Schedule, ScheduleError> {
    check_lengths(path, dwell)?;
    let mut report = Report::default();
    let mut kept = Vec::new();
    for (i, &t) in dwell.dwell_s().iter().enumerate() {
        if t > 0.0 {
            kept.push(i);
        } else if path.segment_length_mm(i) == 0.0 {
            report.dropped.push(i);
        } else {
            let length = path.segment_length_mm(i);
            let problem = format!("is 0 s on a segment of {length} mm");
            let remedy = "the seed formulation stretches nothing; give it time, or use the hermite \
                          formulation";
            return Err(Invalid::at("dwell_s", i, problem, remedy).into());
        }
    }
    if kept.is_empty() {
        return Err(Invalid::whole("dwell_s", "is zero everywhere", "give a dwell time").into());
    }
    let durations: Vec<f64> = kept.iter().map(|i| dwell.dwell_s()[*i]).collect();
    let break_time_s = break_times(&durations);
    let h: Vec<f64> = break_time_s.windows(2).map(|w| w[1] - w[0]).collect();
    let axes = [0, 1].map(|axis| Axis {
        displacement_mm: kept.iter().map(|i| path.displacement_mm(*i)[axis]).collect(),
        duration_s: h.clone(),
        max_velocity: limits.max_velocity_mm_per_s()[axis],
        max_acceleration: limits.max_acceleration_mm_per_s2()[axis],
        eq_16,
    });
    let (x, y) = rayon::join(|| axes[0].solve(), || axes[1].solve());
    let nodes = [x?, y?];
    for axis in 0..2 {
        report.measure(axis, &axes[axis], &nodes[axis]);
    }
    // Eq. 8 with the velocities of the solution.
    let segments = (0..h.len()).map(|k| {
        [0, 1].map(|a| {
            let (v0, v1) = (nodes[a].velocity(k), nodes[a].velocity(k + 1));
            let start = path.point_mm()[kept[k]][a];
            hermite(start, axes[a].displacement_mm[k], v0, v1, h[k])
        })
    });
    let trajectory = Trajectory::new(
        break_time_s,
        segments.collect(),
        kept.iter().map(|i| path.tool_on()[*i]).collect(),
        kept.iter().copied().map(Some).collect(),
    )?;
    Ok(Schedule { trajectory, report })
}

impl Report {
    fn measure(&mut self, axis: usize, problem: &Axis, nodes: &Nodes) {
        let n = problem.duration_s.len();
        let (mut largest, mut sum) = (0.0_f64, 0.0);
        for i in 0..n {
            for error in problem.position_errors(nodes, i) {
                largest = largest.max(error.abs());
                sum += error * error;
            }
        }
        self.largest_position_error_mm[axis] = largest;
        self.rms_position_error_mm[axis] = (sum / (2 * n) as f64).sqrt();
        let (dp, h) = (&problem.displacement_mm, &problem.duration_s);
        self.resting_segments[axis] = dp.iter().filter(|d| **d == 0.0).count();
        for i in 1..n {
            let v = nodes.velocity(i);
            if dp[i - 1] == 0.0 && dp[i] == 0.0 {
                let largest = &mut self.largest_resting_velocity_mm_per_s[axis];
                *largest = largest.max(v.abs());
            }
            let end = accelerations(dp[i - 1], nodes.velocity(i - 1), v, h[i - 1]).1;
            let start = accelerations(dp[i], v, nodes.velocity(i + 1), h[i]).0;
            let largest = &mut self.largest_acceleration_step_mm_per_s2[axis];
            *largest = largest.max((start - end).abs());
        }
        for i in 0..n {
            let against = |v: f64| if v * dp[i] < 0.0 { v.abs() } else { 0.0 };
            let largest = &mut self.largest_reverse_velocity_mm_per_s[axis];
            *largest = largest.max(against(nodes.velocity(i)).max(against(nodes.velocity(i + 1))));
        }
        self.velocities_at_a_bound[axis] = nodes.velocities_at_a_bound;
        self.factorisations[axis] = nodes.factorisations;
        self.optimality[axis] = nodes.optimality;
    }
}

/// The problem of one axis; N segments.
#[derive(Debug)]
struct Axis {
    displacement_mm: Vec<f64>,
    duration_s: Vec<f64>,
    max_velocity: f64,
    max_acceleration: f64,
    eq_16: Eq16,
}

/// The solution of one axis.
#[derive(Debug)]
struct Nodes {
    /// v, A, a of node 0, of node 1, ...
    value: Vec<f64>,
    velocities_at_a_bound: usize,
    factorisations: usize,
    optimality: f64,
}

impl Nodes {
    fn velocity(&self, node: usize) -> f64 {
        self.value[3 * node]
    }
}

/// Unknowns per node: v, A, a.
const PER_NODE: usize = 3;

/// Half bandwidth: an unknown of a node meets those of the next one.
const BAND: usize = 5;

/// Most rounds of the active set method: it ends after 4 to 12 on real paths, and where it has
/// not ended after 60 it repeats itself.
const MAX_ROUNDS: usize = 60;

/// Most changes of one bound; a random path of 60 segments needs some tens.
const MAX_CHANGES: usize = 2000;

/// Gradients below this fraction of the right-hand side are rounding.
const ROUNDING: f64 = 1e-13;

/// A solution farther from a least one than this is refused; see [`Report::optimality`].
const LARGEST_OPTIMALITY: f64 = 1e-9;

impl Axis {
    /// Distances p(0) - P0, p(h) - P1 of the least-squares cubic.
    fn position_errors(&self, nodes: &Nodes, i: usize) -> [f64; 2] {
        let h = self.duration_s[i];
        let [_, row] = self.rows(i);
        let error = row.residual(&nodes.value) / (2.0 + 0.5 * h * h).sqrt();
        [error, -error]
    }

    /// (3) of segment i.
    fn rows(&self, i: usize) -> [Row; 2] {
        let (h, dp) = (self.duration_s[i], self.displacement_mm[i]);
        let (turn, shift) = (0.5_f64.sqrt(), 1.0 / (2.0 + 0.5 * h * h).sqrt());
        let area = h * h / 12.0;
        let first = PER_NODE * i;
        [
            Row {
                first,
                value: [-1.0, -0.5 * h, 0.0, 1.0, -0.5 * h, 0.0].map(|c| c * turn),
                right: 0.0,
            },
            Row {
                first,
                value: [-0.5 * h, -area, 0.0, -0.5 * h, area, 0.0].map(|c| c * shift),
                right: -dp * shift,
            },
        ]
    }

    /// All rows: `A - a` of every node, once per segment that ends there, and (3), by segments.
    fn least_squares(&self) -> LeastSquares {
        let n = self.duration_s.len();
        let mut rows = Vec::with_capacity(3 * n + 1);
        for i in 0..=n {
            // The last node is the second of its rows.
            let (first, own) =
                if i < n { (PER_NODE * i, 0) } else { (PER_NODE * (n - 1), PER_NODE) };
            let weight = if i == 0 || i == n { 1.0 } else { 2.0_f64.sqrt() };
            let mut value = [0.0; 2 * PER_NODE];
            (value[own + 1], value[own + 2]) = (weight, -weight);
            rows.push(Row { first, value, right: 0.0 });
            if i < n {
                rows.extend(self.rows(i));
            }
        }
        LeastSquares { rows, unknowns: PER_NODE * (n + 1) }
    }

    /// Bounds of the unknowns: Eqs 16-18.
    fn bounds(&self) -> (Vec<f64>, Vec<f64>) {
        let n = self.duration_s.len();
        let (mut low, mut high) = (Vec::new(), Vec::new());
        for i in 0..=n {
            let pinned = i == 0 || i == n || (i == 1 && self.eq_16 == Eq16::Printed);
            let velocity = match i {
                _ if pinned => [0.0, 0.0],
                i if self.displacement_mm[i] >= 0.0 => [0.0, self.max_velocity],
                _ => [-self.max_velocity, 0.0],
            };
            let a = if pinned { 0.0 } else { self.max_acceleration };
            low.extend([velocity[0], f64::NEG_INFINITY, -a]);
            high.extend([velocity[1], f64::INFINITY, a]);
        }
        (low, high)
    }

    /// Active sets from the free solution; where they repeat, one bound at a time from the solution
    /// of the interior point method.
    fn solve(&self) -> Result<Nodes, NotConverged> {
        let problem = self.least_squares();
        let (low, high) = self.bounds();
        let free = vec![Side::Free; low.len()];
        let not_converged = |iterations: usize, residual: f64| NotConverged {
            method: "the least squares of the seed formulation",
            iterations,
            residual,
            residual_of: "its distance from the minimum, of which 1e-9 is allowed,",
            remedy: "the times in dwell_s differ by too many orders of magnitude, use the hermite \
                     formulation",
        };
        let (value, factorisations) = match problem.active_set(&low, &high, free) {
            Some(found) => found,
            None => {
                let near = problem.interior_point(&low, &high);
                let residual = problem.optimality(&low, &high, &near);
                let found = problem.descend(&low, &high, near);
                let (value, changes) = found.ok_or_else(|| not_converged(MAX_ROUNDS, residual))?;
                (value, MAX_ROUNDS + changes)
            }
        };
        let inner = 1..self.duration_s.len();
        let at_a_bound = |i: &usize| {
            let v = value[PER_NODE * i];
            v == low[PER_NODE * i] || v == high[PER_NODE * i]
        };
        let velocities_at_a_bound = inner.filter(at_a_bound).count();
        let optimality = problem.optimality(&low, &high, &value);
        if optimality <= LARGEST_OPTIMALITY {
            Ok(Nodes { value, velocities_at_a_bound, factorisations, optimality })
        } else {
            Err(not_converged(factorisations, optimality))
        }
    }
}

/// Where an unknown is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Side {
    Low,
    Free,
    High,
}

/// A row `value x[first..] = right` of the least squares.
#[derive(Clone, Copy, Debug)]
struct Row {
    first: usize,
    value: [f64; 2 * PER_NODE],
    right: f64,
}

impl Row {
    fn residual(&self, x: &[f64]) -> f64 {
        let terms = self.value.iter().zip(&x[self.first..]).map(|(c, x)| c * x);
        terms.sum::<f64>() - self.right
    }
}

/// min |J x - r|^2, rows ascending in `first`.
#[derive(Clone, Debug)]
struct LeastSquares {
    rows: Vec<Row>,
    unknowns: usize,
}

impl LeastSquares {
    /// J'(J x - r) and the diagonal of J'J.
    fn gradient(&self, x: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let (mut gradient, mut square) = (vec![0.0; self.unknowns], vec![0.0; self.unknowns]);
        for row in &self.rows {
            let residual = row.residual(x);
            for (k, c) in row.value.iter().enumerate() {
                gradient[row.first + k] += c * residual;
                square[row.first + k] += c * c;
            }
        }
        (gradient, square)
    }

    /// max_j |J_j| |x_j - clamp(x_j - gradient_j / |J_j|^2)| / |r|, 0 at the minimum and only there.
    fn optimality(&self, low: &[f64], high: &[f64], x: &[f64]) -> f64 {
        let (gradient, square) = self.gradient(x);
        let scale = self.right_norm();
        let off = |j: usize| {
            let wanted = (x[j] - gradient[j] / square[j]).clamp(low[j], high[j]);
            square[j].sqrt() * (x[j] - wanted).abs()
        };
        let largest = (0..self.unknowns).map(off).fold(0.0, f64::max);
        // At rest along the whole axis nothing is asked for.
        if largest == 0.0 { 0.0 } else { largest / scale }
    }

    /// The side to which x - gradient / |J_j|^2 points.
    fn sides(&self, low: &[f64], high: &[f64], x: &[f64]) -> Vec<Side> {
        let (gradient, square) = self.gradient(x);
        (0..self.unknowns)
            .map(|j| {
                let wanted = x[j] - gradient[j] / square[j];
                if low[j] == high[j] || wanted < low[j] {
                    Side::Low
                } else if wanted > high[j] {
                    Side::High
                } else {
                    Side::Free
                }
            })
            .collect()
    }

    /// Primal-dual active sets: solve with the unknowns on their sides, choose the sides anew,
    /// until they stay. `None` when they do not, or the rows are dependent.
    fn active_set(
        &self,
        low: &[f64],
        high: &[f64],
        mut side: Vec<Side>,
    ) -> Option<(Vec<f64>, usize)> {
        for j in 0..self.unknowns {
            if low[j] == high[j] {
                side[j] = Side::Low;
            }
        }
        for round in 1..=MAX_ROUNDS {
            let fixed = |j: usize| match side[j] {
                Side::Low => Some(low[j]),
                Side::High => Some(high[j]),
                Side::Free => None,
            };
            let x = self.solve_with_fixed(fixed)?;
            let next = self.sides(low, high, &x);
            if next == side {
                return Some((x, round));
            }
            side = next;
        }
        None
    }

    /// From the feasible x down to the minimum: to the solution of the free unknowns, or to the
    /// first bound on the way, which holds from then on; there, the bound that keeps most from the
    /// minimum is given up. The sum of squares never grows.
    fn descend(&self, low: &[f64], high: &[f64], x: Vec<f64>) -> Option<(Vec<f64>, usize)> {
        let mut x = x;
        let mut side = self.sides(low, high, &x);
        let bound = |j: usize, side: Side| match side {
            Side::Low => Some(low[j]),
            Side::High => Some(high[j]),
            Side::Free => None,
        };
        for (j, x) in x.iter_mut().enumerate() {
            *x = bound(j, side[j]).unwrap_or(*x);
        }
        let scale = self.right_norm();
        for change in 1..=MAX_CHANGES {
            let wanted = self.solve_with_fixed(|j| bound(j, side[j]))?;
            let (mut step, mut first) = (1.0, None);
            for j in 0..x.len() {
                let (at, hit) = match wanted[j] {
                    w if w < low[j] => (low[j], Side::Low),
                    w if w > high[j] => (high[j], Side::High),
                    _ => continue,
                };
                let part = (at - x[j]) / (wanted[j] - x[j]);
                if part < step {
                    (step, first) = (part, Some((j, hit)));
                }
            }
            if let Some((hit, at)) = first {
                side[hit] = at;
                for (j, x) in x.iter_mut().enumerate() {
                    let moved = *x + step * (wanted[j] - *x);
                    *x = bound(j, side[j]).unwrap_or_else(|| moved.clamp(low[j], high[j]));
                }
                continue;
            }
            x = (0..x.len()).map(|j| wanted[j].clamp(low[j], high[j])).collect();
            let (gradient, square) = self.gradient(&x);
            let pull = |j: usize| match side[j] {
                _ if low[j] == high[j] => 0.0,
                Side::Low => -gradient[j] / square[j].sqrt(),
                Side::High => gradient[j] / square[j].sqrt(),
                Side::Free => 0.0,
            };
            let most = (0..x.len()).max_by(|a, b| pull(*a).total_cmp(&pull(*b)))?;
            if pull(most) <= ROUNDING * scale {
                return Some((x, change));
            }
            side[most] = Side::Free;
        }
        Some((x, MAX_CHANGES))
    }

    /// |r|.
    fn right_norm(&self) -> f64 {
        self.rows.iter().map(|row| row.right * row.right).sum::<f64>().sqrt()
    }

    /// Solves for the unknowns that `fixed` leaves free: Givens rotations of row after row into a
    /// banded upper triangle, and back substitution.
    fn solve_with_fixed(&self, fixed: impl Fn(usize) -> Option<f64>) -> Option<Vec<f64>> {
        let n = self.unknowns;
        let value: Vec<Option<f64>> = (0..n).map(fixed).collect();
        // Row k: the columns k, k+1, ...; then the right-hand side.
        let mut triangle = vec![[0.0_f64; BAND + 1]; n];
        let mut right = vec![0.0; n];
        for row in &self.rows {
            let (mut c, mut b) = (row.value, row.right);
            for (k, c) in c.iter_mut().enumerate() {
                if let Some(value) = value[row.first + k] {
                    b -= *c * value;
                    *c = 0.0;
                }
            }
            for k in 0..c.len() {
                if c[k] == 0.0 {
                    continue;
                }
                let own = &mut triangle[row.first + k];
                let size = own[0].hypot(c[k]);
                let (cosine, sine) = (own[0] / size, c[k] / size);
                for l in k..c.len() {
                    let (upper, lower) = (own[l - k], c[l]);
                    own[l - k] = cosine * upper + sine * lower;
                    c[l] = cosine * lower - sine * upper;
                }
                let (upper, lower) = (right[row.first + k], b);
                right[row.first + k] = cosine * upper + sine * lower;
                b = cosine * lower - sine * upper;
            }
        }
        let mut x = vec![0.0; n];
        for k in (0..n).rev() {
            x[k] = match value[k] {
                Some(value) => value,
                None => {
                    let later = (1..=BAND.min(n - 1 - k)).map(|d| triangle[k][d] * x[k + d]);
                    (right[k] - later.sum::<f64>()) / triangle[k][0]
                }
            };
        }
        x.iter().all(|x| x.is_finite()).then_some(x)
    }

    /// The same problem by clarabel, to its tolerance of 1e-8: min |z|^2/2 with J x - z = r.
    fn interior_point(&self, low: &[f64], high: &[f64]) -> Vec<f64> {
        let (n, m) = (self.unknowns, self.rows.len());
        let (mut r, mut c, mut v, mut bound) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (i, row) in self.rows.iter().enumerate() {
            for (k, value) in row.value.iter().enumerate().filter(|(_, value)| **value != 0.0) {
                r.push(i);
                c.push(row.first + k);
                v.push(*value);
            }
            r.push(i);
            c.push(n + i);
            v.push(-1.0);
            bound.push(row.right);
        }
        for j in 0..n {
            for (limit, sign) in [(high[j], 1.0), (low[j], -1.0)] {
                if limit.is_finite() {
                    r.push(bound.len());
                    c.push(j);
                    v.push(sign);
                    bound.push(sign * limit);
                }
            }
        }
        let a = CscMatrix::new_from_triplets(bound.len(), n + m, r, c, v);
        let residuals: Vec<usize> = (n..n + m).collect();
        let p =
            CscMatrix::new_from_triplets(n + m, n + m, residuals.clone(), residuals, vec![1.0; m]);
        let settings = DefaultSettingsBuilder::default().verbose(false).build().expect("valid");
        let cones = [ZeroConeT(m), NonnegativeConeT(bound.len() - m)];
        let q = vec![0.0; n + m];
        let Ok(mut solver) = DefaultSolver::new(&p, &q, &a, &bound, &cones, settings) else {
            return vec![0.0; n];
        };
        solver.solve();
        // Any point within the bounds is a start for `descend`, the last one of a run that made too
        // little progress too.
        let clamped = |j: usize| {
            let x = solver.solution.x[j];
            if x.is_finite() { x.clamp(low[j], high[j]) } else { 0.0 }
        };
        (0..n).map(clamped).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    fn axis(dp: &[f64], h: &[f64], max_velocity: f64, max_acceleration: f64) -> Axis {
        Axis {
            displacement_mm: dp.to_vec(),
            duration_s: h.to_vec(),
            max_velocity,
            max_acceleration,
            eq_16: Eq16::Corrected,
        }
    }

    /// Eqs 9-16 as printed: six unknowns (c1 t^3 + c2 t^2 + c3 t + c4, v, a) per segment in the
    /// absolute time `t` of the source, dense, the hard rows by their null space. No bounds; they
    /// must not be active. Returns (v, a) of the nodes 1 .. N-1.
    fn as_printed(problem: &Axis) -> Vec<[f64; 2]> {
        let n = problem.duration_s.len();
        let t = break_times(&problem.duration_s);
        let p: Vec<f64> = break_times(&problem.displacement_mm);
        let unknowns = 6 * n;
        let (mut rows, mut right): (Vec<Vec<f64>>, Vec<f64>) = (Vec::new(), Vec::new());
        let (mut hard, mut row) = (Vec::new(), vec![0.0; unknowns]);
        let position = |t: f64| [t * t * t, t * t, t, 1.0];
        let velocity = |t: f64| [3.0 * t * t, 2.0 * t, 1.0, 0.0];
        let acceleration = |t: f64| [6.0 * t, 2.0, 0.0, 0.0];
        for i in 0..n {
            let mut add = |c: [f64; 4], node: Option<(usize, usize)>, value: f64| {
                row.fill(0.0);
                row[6 * i..6 * i + 4].copy_from_slice(&c);
                // The unknowns of segment k belong to node k + 1; node 0 is at rest.
                if let Some((node, which)) = node.filter(|(node, _)| *node > 0) {
                    row[6 * (node - 1) + 4 + which] = -1.0;
                }
                rows.push(row.clone());
                right.push(value);
            };
            add(position(t[i]), None, p[i]);
            add(position(t[i + 1]), None, p[i + 1]);
            add(velocity(t[i]), Some((i, 0)), 0.0);
            add(velocity(t[i + 1]), Some((i + 1, 0)), 0.0);
            add(acceleration(t[i]), Some((i, 1)), 0.0);
            add(acceleration(t[i + 1]), Some((i + 1, 1)), 0.0);
            if i + 1 < n {
                let mut row = vec![0.0; unknowns];
                row[6 * i..6 * i + 4].copy_from_slice(&acceleration(t[i + 1]));
                let next: Vec<f64> = acceleration(t[i + 1]).iter().map(|c| -c).collect();
                row[6 * i + 6..6 * i + 10].copy_from_slice(&next);
                hard.push(row);
            }
        }
        for which in [4, 5] {
            let mut row = vec![0.0; unknowns];
            row[6 * (n - 1) + which] = 1.0;
            hard.push(row);
        }
        let c = DMatrix::from_fn(rows.len(), unknowns, |r, k| rows[r][k]);
        let d = DVector::from_vec(right);
        // The null space of the hard rows: the columns of the orthogonal factor of their transpose
        // beyond their number.
        let m = hard.len();
        let a = DMatrix::from_fn(unknowns, unknowns, |r, k| if k < m { hard[k][r] } else { 0.0 });
        let svd = a.svd(true, false);
        let u = svd.u.unwrap();
        let zero = svd.singular_values.iter().enumerate().filter(|(_, s)| **s < 1e-9);
        let null: Vec<usize> = zero.map(|(k, _)| k).collect();
        assert_eq!(null.len(), unknowns - m);
        let z = DMatrix::from_fn(unknowns, null.len(), |r, k| u[(r, null[k])]);
        let qr = (&c * &z).qr();
        let y = qr.r().solve_upper_triangular(&(qr.q().transpose() * d)).unwrap();
        let x = z * y;
        (1..n).map(|node| [x[6 * (node - 1) + 4], x[6 * (node - 1) + 5]]).collect()
    }

    #[test]
    fn local_and_absolute_time_are_the_same_least_squares() {
        // Twelve segments whose velocities are not at a bound: Eq. 18 does not interfere.
        let dp = [0.5, 1.0, 0.9, 1.1, 1.0, 0.95, 1.05, 1.0, 0.9, 1.1, 1.0, 0.5];
        let h = [0.25, 0.22, 0.2, 0.21, 0.2, 0.19, 0.2, 0.22, 0.2, 0.21, 0.23, 0.25];
        let problem = axis(&dp, &h, 1e6, 1e6);
        let nodes = problem.solve().unwrap();
        assert_eq!((nodes.velocities_at_a_bound, nodes.factorisations), (0, 1));
        let printed = as_printed(&problem);
        for (i, [v, a]) in printed.iter().enumerate() {
            let node = i + 1;
            let found = [nodes.value[PER_NODE * node], nodes.value[PER_NODE * node + 2]];
            // 1e-12 of the velocities of 5 mm/s, the rounding of the absolute time: t^3 up to 17 s^3
            // where the local one has h^3 = 0.008. The accelerations are larger by 1/h.
            assert!((found[0] - v).abs() < 5e-12, "node {node}: v {} {v}", found[0]);
            assert!((found[1] - a).abs() < 1e-10, "node {node}: a {} {a}", found[1]);
        }
        // The positions are soft: the least squares does miss them.
        let missed = (0..12).flat_map(|i| problem.position_errors(&nodes, i));
        assert!(missed.fold(0.0, |m: f64, e| m.max(e.abs())) > 1e-6);
    }

    #[test]
    fn active_sets_end_at_the_optimum_of_the_interior_point_method() {
        let dp = [1.0, 0.0, 0.0, 2.0, -1.0, -1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 3.0];
        let h = [0.2, 0.3, 0.2, 0.1, 0.4, 0.2, 0.2, 0.3, 0.2, 0.2, 0.2, 0.5];
        let problem = axis(&dp, &h, 12.0, 80.0);
        let least_squares = problem.least_squares();
        let (low, high) = problem.bounds();
        let free = vec![Side::Free; low.len()];
        let (x, rounds) = least_squares.active_set(&low, &high, free).unwrap();
        assert!(rounds > 1, "no bound is active");
        assert!(least_squares.optimality(&low, &high, &x) < 1e-13);
        // A velocity changed by 1e-3 mm/s moves the rows by sqrt 2/2 of that or more.
        let mut moved = x.clone();
        let free = (1..12).find(|i| x[3 * i] > low[3 * i] && x[3 * i] < high[3 * i]).unwrap();
        moved[3 * free] += 1e-3;
        assert!(least_squares.optimality(&low, &high, &moved) > 1e-4);
        let y = least_squares.interior_point(&low, &high);
        let (gradient, square) = least_squares.gradient(&x);
        for j in 0..x.len() {
            // 1e-8 of the objective is some 1e-4 of an unknown.
            assert!((x[j] - y[j]).abs() < 1e-2 * (1.0 + x[j].abs()), "{j}: {} {}", x[j], y[j]);
            // Optimality: the gradient vanishes or points out of the bounds.
            let g = gradient[j];
            let scale = 1e-9 * square[j] * (1.0 + x[j].abs());
            let optimal = g.abs() < scale
                || (x[j] == low[j] && (g > 0.0 || low[j] == high[j]))
                || (x[j] == high[j] && g < 0.0);
            assert!(optimal, "{j}: x {} in [{}, {}], gradient {g}", x[j], low[j], high[j]);
        }
    }

    /// A motion with continuous acceleration, from rest to rest, is its own least squares, whatever
    /// its times: runs of segments of 1e-4 s among those of seconds, whose rows the squares of the
    /// normal equations do not hold.
    #[test]
    fn a_smooth_motion_is_found_again_at_unequal_times() {
        let h = [2.0, 1e-4, 1e-4, 2e-4, 1e-4, 3e-4, 0.5, 1.0, 1e-3, 1e-4, 1e-4, 2e-4, 1.5, 3.0];
        // Accelerations of the nodes; the last but one brings the velocity to 0.
        let mut a =
            vec![0.0, 0.5, 0.6, 0.4, 0.7, 0.5, 0.3, 0.2, 0.1, 0.2, 0.0, -0.1, 0.1, 0.0, 0.0];
        let n = h.len();
        // v1 = v0 + h (A0 + A1)/2
        let velocities = |a: &[f64]| -> Vec<f64> {
            (0..n).fold(vec![0.0], |mut v, i| {
                v.push(v[i] + 0.5 * h[i] * (a[i] + a[i + 1]));
                v
            })
        };
        a[n - 1] = -2.0 * velocities(&a)[n] / (h[n - 2] + h[n - 1]);
        let v = velocities(&a);
        // p(h) - p(0) = h v0 + h^2 (A0/3 + A1/6)
        let dp: Vec<f64> =
            (0..n).map(|i| h[i] * v[i] + h[i] * h[i] * (a[i] / 3.0 + a[i + 1] / 6.0)).collect();
        let problem = axis(&dp, &h, 1e3, 1e3);
        let nodes = problem.solve().unwrap();
        assert_eq!((nodes.velocities_at_a_bound, nodes.factorisations), (0, 1));
        for (k, v) in v.iter().enumerate() {
            // The velocities are known to rounding times sqrt 2 / h, the weight of the positions.
            assert!((nodes.velocity(k) - v).abs() < 1e-11, "{k}: {} {v}", nodes.velocity(k));
        }
        let missed = (0..n).flat_map(|i| problem.position_errors(&nodes, i));
        assert!(missed.fold(0.0, |m: f64, e| m.max(e.abs())) < 1e-13);
    }

    #[test]
    fn a_resting_axis_is_asked_to_move_and_the_report_says_so() {
        // A move and then rest: without reverse motion the spline would swing back; Eq. 18 forbids
        // that, and the soft positions pay.
        let points = vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [2.0, 2.0], [2.0, 3.0]];
        let path = ToolPath::through(points, vec![true; 5], vec![0; 5]).unwrap();
        let dwell = DwellTime::new(vec![0.3, 0.25, 0.3, 0.25, 0.3]).unwrap();
        let axis = |name: &str| planish_types::MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 100.0,
            max_acceleration_mm_per_s2: 1000.0,
            max_jerk_mm_per_s3: None,
        };
        let axes = vec![axis("x"), axis("y")];
        let limits = planish_types::MachineFile { name: "m".into(), axes, min_segment_s: 0.0 }
            .checked()
            .unwrap();
        let s = schedule(&path, &dwell, &limits, Eq16::Corrected).unwrap();
        assert_eq!(s.report.resting_segments, [3, 2]);
        assert!(s.report.largest_position_error_mm[0] > 1e-4, "{:?}", s.report);
        assert!(s.report.largest_resting_velocity_mm_per_s[0] >= 0.0);
        // Eq. 8 passes the control points.
        for (i, segment) in s.trajectory.segments().enumerate() {
            let end = segment.position_mm(segment.duration_s);
            let p = path.point_mm()[i + 1];
            assert!((end[0] - p[0]).abs() + (end[1] - p[1]).abs() < 1e-14, "{i}: {end:?} {p:?}");
        }
        let never = DwellTime::new(vec![0.3, 0.0, 0.3, 0.25, 0.3]).unwrap();
        let message = schedule(&path, &never, &limits, Eq16::Corrected).unwrap_err().to_string();
        assert!(message.contains("dwell_s[1]: is 0 s on a segment of 1 mm"), "{message}");
    }
}
