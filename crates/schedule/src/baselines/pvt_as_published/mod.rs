//! PVT as published: least squares in the coefficients, for comparison with [`crate::pvt`].
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
//! Givens rotations of the rows solve for the unknowns `(v, A, a)` of the nodes. The normal equations
//! would contain the squares of `h^2/12`, which at 1e-4 s vanish in the rounding of 1. Active sets
//! keep the bounds.
//!
//! Defects that the report shows and nothing repairs:
//!
//! * The least squares add squares of unlike units. Errors of position cost least, and are up to
//!   0.37 mm on the reference mirror. Eq. 8 then restores the positions, which breaks the continuity
//!   of the acceleration.
//! * Eq. 18 demands `v_i >= 0` of an axis at rest, so it moves.
//! * Neither the inside of a segment nor the limits after Eq. 8 are checked.
//!
//! Source: T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005, Eqs 8-18.
//! Corrected: Eq. 16 fixes the end of the first segment, but means its start. Here `v = a = 0` holds at
//! node 0. [`RestCondition::AsPrinted`] fixes both, and misses positions by up to 0.495 mm. Eq. 18 is
//! not defined for the last node, which rests. The time of the source is absolute, and its t^3 leaves
//! no digit at 30 s. Local time gives the same least squares in other variables.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | h | `duration_s` | (N) | s |
//! | P1 - P0 | `displacement_mm` | (N) | mm |
//! | v, A, a | `Nodes::value` | (N+1) | mm/s, mm/s^2, mm/s^2 |

mod least_squares;

use planish_types::{DwellTime, Invalid, Limits, NotConverged, ToolPath, Trajectory, break_times};
use serde::Serialize;

use self::least_squares::{LeastSquares, MAX_ROUNDS, PER_NODE, ResidualRow, Side};
use crate::{
    Schedule, ScheduleError, check_lengths,
    hermite::{accelerations, coefficients},
    rounding_mm,
};

/// Nodes at which Eq. 16 of the source sets the tool at rest, `v = a = 0`, in addition to the last node.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum RestCondition {
    /// The start: node 0.
    #[default]
    Corrected,
    /// Node 0, and node 1 as well, because the unknowns of the first segment belong to its end.
    AsPrinted,
}

/// Settings of PVT as published.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct AsPublishedSettings {
    /// Nodes at which Eq. 16 of the source sets the tool at rest.
    pub rest_condition: RestCondition,
}

/// Errors of the least squares and of the motion; every pair is one value per axis [x, y].
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct AsPublishedReport {
    /// Largest distance of the least-squares cubics from their control points, mm.
    pub largest_position_error_mm: [f64; 2],
    /// RMS of the distance of the least-squares cubics from their control points over both ends of every segment, mm.
    pub rms_position_error_mm: [f64; 2],
    /// Number of segments in which this axis has no displacement.
    pub resting_segments: [usize; 2],
    /// Largest |velocity| at a node between two segments without displacement of the axis, mm/s.
    pub largest_resting_velocity_mm_per_s: [f64; 2],
    /// Largest |velocity| at a node of a segment whose sign is opposite to the displacement of that segment, mm/s.
    pub largest_reverse_velocity_mm_per_s: [f64; 2],
    /// Largest step of the acceleration at an inner node of the motion (cubics of Eq. 8 of the source), mm/s^2.
    pub largest_acceleration_step_mm_per_s2: [f64; 2],
    /// Number of inner nodes whose velocity is at a bound of Eq. 16 or 18 of the source.
    pub velocities_at_a_bound: [usize; 2],
    /// Number of factorisations of the active set method. It is more than 60 if the sets repeated; the method then
    /// changed one bound at a time, starting from the solution of the interior point method.
    pub factorisations: [usize; 2],
    /// Relative distance of the solution from the minimum: the largest step of a single unknown to the minimum along
    /// it, within its bounds. It is measured as the change of the rows over the norm of the right-hand side.
    pub optimality: [f64; 2],
    /// Indices of the segments whose length and dwell time are zero or rounding; the motion leaves them out.
    pub dropped: Vec<usize>,
}

/// Schedules `path` with the times `dwell`; no segment gets more time. The cubics are not checked against the limits
/// inside of the segments.
///
/// Refuses dwell times of another path, and dwell times that are zero everywhere. Refuses a dwell time of zero on a
/// segment with a length, because its cubic would have no time. Fails if the least squares do not converge.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    settings: &AsPublishedSettings,
) -> Result<Schedule<AsPublishedReport>, ScheduleError> {
    check_lengths(path, dwell)?;
    let mut report = AsPublishedReport::default();
    let mut timed = Vec::new();
    // A length that is rounding, in a time that vanishes in the rounding of the break times, is no segment.
    let least_s = 4.0 * f64::EPSILON * dwell.total_s();
    for (i, &t) in dwell.dwell_s().iter().enumerate() {
        if t <= least_s && path.segment_length_mm(i) <= rounding_mm(path, i) {
            report.dropped.push(i);
        } else if t > 0.0 {
            timed.push(i);
        } else {
            let length = path.segment_length_mm(i);
            let problem = format!("is 0 s on a segment of {length} mm");
            let remedy = "PVT as published stretches nothing; give it time, or use pvt";
            return Err(Invalid::at_index("dwell_s", i, problem, remedy).into());
        }
    }
    if timed.is_empty() {
        return Err(Invalid::whole("dwell_s", "is zero everywhere", "give a dwell time").into());
    }
    let durations: Vec<f64> = timed.iter().map(|i| dwell.dwell_s()[*i]).collect();
    let break_time_s = break_times(&durations);
    let h: Vec<f64> = break_time_s.windows(2).map(|w| w[1] - w[0]).collect();
    let axes = [0, 1].map(|axis| PublishedAxis {
        displacement_mm: timed.iter().map(|i| path.displacement_mm(*i)[axis]).collect(),
        duration_s: h.clone(),
        max_velocity: limits.max_velocity_mm_per_s()[axis],
        max_acceleration: limits.max_acceleration_mm_per_s2()[axis],
        rest_condition: settings.rest_condition,
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
            let start = path.point_mm()[timed[k]][a];
            coefficients(start, axes[a].displacement_mm[k], v0, v1, h[k])
        })
    });
    let trajectory = Trajectory::new(
        break_time_s,
        segments.collect(),
        timed.iter().map(|i| path.tool_on()[*i]).collect(),
        timed.iter().copied().map(Some).collect(),
    )?;
    Ok(Schedule { trajectory, report })
}

impl AsPublishedReport {
    fn measure(&mut self, axis: usize, problem: &PublishedAxis, nodes: &Nodes) {
        let n = problem.duration_s.len();
        let mut largest = 0.0_f64;
        let mut sum = 0.0;
        for i in 0..n {
            for error in problem.position_errors(nodes, i) {
                largest = largest.max(error.abs());
                sum += error * error;
            }
        }
        self.largest_position_error_mm[axis] = largest;
        self.rms_position_error_mm[axis] = (sum / (2 * n) as f64).sqrt();
        let dp = &problem.displacement_mm;
        let h = &problem.duration_s;
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
            let largest = &mut self.largest_reverse_velocity_mm_per_s[axis];
            for v in [nodes.velocity(i), nodes.velocity(i + 1)] {
                if v * dp[i] < 0.0 {
                    *largest = largest.max(v.abs());
                }
            }
        }
        self.velocities_at_a_bound[axis] = nodes.velocities_at_a_bound;
        self.factorisations[axis] = nodes.factorisations;
        self.optimality[axis] = nodes.optimality;
    }
}

/// Least-squares problem of one axis with N segments.
#[derive(Debug)]
struct PublishedAxis {
    displacement_mm: Vec<f64>,
    duration_s: Vec<f64>,
    max_velocity: f64,
    max_acceleration: f64,
    rest_condition: RestCondition,
}

/// Solution of the least-squares problem of one axis.
#[derive(Debug)]
struct Nodes {
    /// Unknowns of node 0, then of node 1, and so on: velocity (v), acceleration of the cubics (A), acceleration (a).
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

/// Largest [`AsPublishedReport::optimality`] of a solution, relative; others are refused. Larger: inaccurate velocities
/// pass. Smaller: solutions are refused because of rounding. The reference mirror reaches 4e-15 (docs/schedulers.md).
const LARGEST_OPTIMALITY: f64 = 1e-9;

impl PublishedAxis {
    /// Returns the distances of the least-squares cubic of segment `i` from its start point and its end point, p(0) -
    /// P0 and p(h) - P1, mm.
    fn position_errors(&self, nodes: &Nodes, i: usize) -> [f64; 2] {
        let h = self.duration_s[i];
        let [_, row] = self.rows(i);
        let error = row.residual(&nodes.value) / (2.0 + 0.5 * h * h).sqrt();
        [error, -error]
    }

    /// Returns the rows of the least squares for segment `i`, (3) of the module: velocity, then position.
    fn rows(&self, i: usize) -> [ResidualRow; 2] {
        let h = self.duration_s[i];
        let dp = self.displacement_mm[i];
        let turn = 0.5_f64.sqrt();
        let shift = 1.0 / (2.0 + 0.5 * h * h).sqrt();
        let area = h * h / 12.0;
        let first = PER_NODE * i;
        [
            ResidualRow {
                first,
                value: [-1.0, -0.5 * h, 0.0, 1.0, -0.5 * h, 0.0].map(|c| c * turn),
                right: 0.0,
            },
            ResidualRow {
                first,
                value: [-0.5 * h, -area, 0.0, -0.5 * h, area, 0.0].map(|c| c * shift),
                right: -dp * shift,
            },
        ]
    }

    /// Returns all rows in order of the nodes: the row `A - a` of each node, then the rows (3) of the module for the
    /// segment that starts there. The row `A - a` is multiplied by the square root of the number of segments at its
    /// node.
    fn least_squares(&self) -> LeastSquares {
        let n = self.duration_s.len();
        let mut rows = Vec::with_capacity(3 * n + 1);
        for i in 0..=n {
            // The last node is the second of its rows.
            let (first, own) =
                if i < n { (PER_NODE * i, 0) } else { (PER_NODE * (n - 1), PER_NODE) };
            let weight = if i == 0 || i == n { 1.0 } else { 2.0_f64.sqrt() };
            let mut value = [0.0; 2 * PER_NODE];
            value[own + 1] = weight;
            value[own + 2] = -weight;
            rows.push(ResidualRow { first, value, right: 0.0 });
            if i < n {
                rows.extend(self.rows(i));
            }
        }
        LeastSquares { rows, unknowns: PER_NODE * (n + 1) }
    }

    /// Returns the lower and upper bounds of the unknowns, by Eqs 16-18 of the source.
    fn bounds(&self) -> (Vec<f64>, Vec<f64>) {
        let n = self.duration_s.len();
        let (mut low, mut high) = (Vec::new(), Vec::new());
        for i in 0..=n {
            let pinned =
                i == 0 || i == n || (i == 1 && self.rest_condition == RestCondition::AsPrinted);
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

    /// Returns the minimum within the bounds by active sets, starting with all unknowns free. If the sets repeat, it
    /// changes one bound at a time, starting from the solution of the interior point method.
    fn solve(&self) -> Result<Nodes, NotConverged> {
        let problem = self.least_squares();
        let (low, high) = self.bounds();
        let free = vec![Side::Free; low.len()];
        let (value, factorisations) = match problem.active_set(&low, &high, free) {
            Some(solution) => solution,
            None => {
                let near = problem.interior_point(&low, &high);
                let residual = problem.optimality(&low, &high, &near);
                let minimum = problem.descend(&low, &high, near);
                let (value, changes) =
                    minimum.ok_or_else(|| not_converged(MAX_ROUNDS, residual))?;
                (value, MAX_ROUNDS + changes)
            }
        };
        let at_a_bound = (1..self.duration_s.len())
            .map(|i| PER_NODE * i)
            .filter(|v| value[*v] == low[*v] || value[*v] == high[*v]);
        let velocities_at_a_bound = at_a_bound.count();
        let optimality = problem.optimality(&low, &high, &value);
        if optimality <= LARGEST_OPTIMALITY {
            Ok(Nodes { value, velocities_at_a_bound, factorisations, optimality })
        } else {
            Err(not_converged(factorisations, optimality))
        }
    }
}

/// Returns the error for a solution whose relative distance from the minimum is `residual`.
fn not_converged(iterations: usize, residual: f64) -> NotConverged {
    NotConverged {
        method: "the least squares of PVT as published",
        iterations,
        residual,
        residual_of: "its distance from the minimum, of which 1e-9 is allowed,",
        remedy: "the times in dwell_s differ by too many orders of magnitude, use pvt",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    fn axis(dp: &[f64], h: &[f64], max_velocity: f64, max_acceleration: f64) -> PublishedAxis {
        PublishedAxis {
            displacement_mm: dp.to_vec(),
            duration_s: h.to_vec(),
            max_velocity,
            max_acceleration,
            rest_condition: RestCondition::Corrected,
        }
    }

    /// Returns velocity and acceleration (v, a) of the nodes 1 .. N-1 by Eqs 9-16 as printed. There are six unknowns
    /// (c1 t^3 + c2 t^2 + c3 t + c4, v, a) per segment in the absolute time `t` of the source. The matrix is dense, and
    /// the null space keeps the hard rows. There are no bounds; they must not be active.
    fn as_printed(problem: &PublishedAxis) -> Vec<[f64; 2]> {
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

    /// A motion with continuous acceleration, from rest to rest, must be its own least-squares solution at all times.
    /// Here segments of 1e-4 s are among those of seconds; the squares of their rows would vanish in the normal
    /// equations.
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
    fn times_a_hundred_orders_of_magnitude_apart_do_not_converge_and_it_says_so() {
        // Rows of 1e-100 s beside those of 0.2 s: the rotations keep no digit of the former.
        let meander = |i: usize| [(i / 2 + i % 2) as f64, (i / 2 % 2) as f64];
        let path = ToolPath::through((0..=40).map(meander).collect(), vec![true; 40], vec![0; 40]);
        let times = (0..40).map(|i| if i % 2 == 0 { 1e-100 } else { 0.2 }).collect();
        let dwell = DwellTime::new(times).unwrap();
        let limits = planish_testkit::machine([100.0; 2], [1000.0; 2]);
        let error =
            schedule(&path.unwrap(), &dwell, &limits, &AsPublishedSettings::default()).unwrap_err();
        println!("{error}");
        let ScheduleError::NotConverged(NotConverged { iterations, residual, .. }) = error else {
            panic!("{error}")
        };
        assert!(iterations >= MAX_ROUNDS && residual > LARGEST_OPTIMALITY, "{error}");
        assert!(error.to_string().contains("has not converged: after 60 iterations"), "{error}");
        assert!(error.to_string().contains("times in dwell_s differ"), "{error}");
    }

    #[test]
    fn a_resting_axis_is_asked_to_move_and_the_report_says_so() {
        // A move and then rest: without reverse motion the spline would swing back; Eq. 18 forbids
        // that, and the soft positions pay.
        let points = vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [2.0, 2.0], [2.0, 3.0]];
        let path = ToolPath::through(points, vec![true; 5], vec![0; 5]).unwrap();
        let dwell = DwellTime::new(vec![0.3, 0.25, 0.3, 0.25, 0.3]).unwrap();
        let limits = planish_testkit::machine([100.0; 2], [1000.0; 2]);
        let s = schedule(&path, &dwell, &limits, &AsPublishedSettings::default()).unwrap();
        assert_eq!(s.report.resting_segments, [3, 2]);
        assert!(s.report.largest_position_error_mm[0] > 1e-4, "{:?}", s.report);
        // Eq. 18 lets x move forwards only at the nodes 3 and 4, between segments along which it rests: at
        // node 3, where a spline swings back, it is held; at node 4 it does move.
        let [at_3, at_4] = [3, 4].map(|node| s.trajectory.coefficient_mm()[node][0][1]);
        assert_eq!(at_3, 0.0);
        assert!(at_4 > 0.1, "{at_4} mm/s");
        assert_eq!(s.report.largest_resting_velocity_mm_per_s[0], at_4);
        // Eq. 8 passes the control points.
        for (i, segment) in s.trajectory.segments().enumerate() {
            let end = segment.position_mm(segment.duration_s);
            let p = path.point_mm()[i + 1];
            assert!((end[0] - p[0]).abs() + (end[1] - p[1]).abs() < 1e-14, "{i}: {end:?} {p:?}");
        }
        let never = DwellTime::new(vec![0.3, 0.0, 0.3, 0.25, 0.3]).unwrap();
        let message = schedule(&path, &never, &limits, &AsPublishedSettings::default())
            .unwrap_err()
            .to_string();
        assert!(message.contains("dwell_s[1]: is 0 s on a segment of 1 mm"), "{message}");
    }
}
