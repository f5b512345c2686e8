//! Nodes of the density along the curves: their removal, and the motion of the tool between them.
//!
//! The unknown is the dwell-time density D = 1 / v at nodes, linear in the arc length between them. So the removal
//! and the time are linear in the unknowns. With the fraction f of a span of length l from node j to node k:
//!
//! ```text
//! D(f) = (1 - f) D_j + f D_k
//! removal           integral of R(x - q(s)) D ds: Gauss points, l omega_q D(f_q) seconds each    (1)
//! time of a span    T = l (D_j + D_k) / 2                                                       (2)
//! motion            s(u), 0 <= u <= T: the cubic with s(0) = 0, s'(0) = 1 / D_j, s(T) = l, s'(T) = 1 / D_k   (3)
//! ```
//!
//! (3) has exactly the times and feedrates of D at the nodes, and is one polynomial. At `D_k = 2 D_j` it is within
//! 0.8 % of l of the position of D itself. At rest D is infinite. A curve begins and ends at rest, on a span with one
//! node: `D = D_k (l / s)^1/2`, `T = 2 l D_k`. That is a constant acceleration. With `s = l u^2` the removal is an
//! integral over u of constant weight.

use planish_numerics::quadrature::gauss_legendre;
use planish_types::{Invalid, Tif, ToolPath, budget};

use crate::{curve::Curve, piece::Station};

/// Number of Gauss points of a span in (1) of the module. Larger: a removal nearer to the integral, with more time for
/// every model of it. Smaller: the removal of the solver differs from that of the motion. Chosen.
const GAUSS_POINTS: usize = 3;

/// Least turn of a corner with a node of its own, rad. Larger: corners between nodes, at which the feedrate cannot
/// fall by itself. Smaller: nodes at corners where it need not fall. Chosen.
const GENTLE_TURN_RAD: f64 = 0.1;

/// Least turn of a corner with nodes at both of its ends too, rad. Larger: the feedrate cannot rise at once after a
/// sharp corner. Smaller: more nodes. Chosen.
const SHARP_TURN_RAD: f64 = 0.5;

/// Least distance of a node at a corner, or at an end of a corner, from the other nodes, over their spacing. Larger:
/// corners without a node. Smaller: short spans, which cost time of the solver. Chosen.
const NEAREST_NODE_FRACTION: f64 = 0.3;

/// Largest number of Newton or bisection steps that find the time at which the motion, (3) of the module, reaches a
/// position. Larger: no difference. Smaller: a search by bisection may stop early. Derived: Newton's method takes some
/// five, bisection as many as a number has bits.
const MAX_INVERSION_STEPS: usize = 60;

/// Newton step of [`Span::tau_at`] below which its result is exact to rounding, as a fraction of the time of the span.
/// Larger: less exact. Smaller: a step more than needed. Derived: the next step of Newton's method is about the square
/// of this one.
const INVERSION_STEP: f64 = 1e-9;

/// Span: the part of a curve between two nodes, of which one may be a rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Span {
    /// Index of its curve.
    pub curve: usize,
    /// Arc length of its start from the start of the curve, mm.
    pub from_mm: f64,
    /// Arc length of its end from the start of the curve, mm.
    pub to_mm: f64,
    /// Indices of the nodes at its start and its end; `None` at rest.
    pub nodes: [Option<usize>; 2],
}

/// Motion along a span at some time, (3) of the module: position, feedrate, acceleration and jerk along the curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Kinematics {
    /// Position (s) from the start of the span, mm.
    pub s_mm: f64,
    /// Feedrate (s'), mm/s.
    pub feed_mm_per_s: f64,
    /// Acceleration along the curve (s''), mm/s^2.
    pub acceleration_mm_per_s2: f64,
    /// Jerk along the curve (s'''), mm/s^3.
    pub jerk_mm_per_s3: f64,
    /// Derivatives of the position by the densities of the two nodes at a fixed fraction of the time of the span,
    /// mm^2/s.
    pub s_by: [f64; 2],
    /// Derivatives of the feedrate by the densities of the two nodes, mm^2/s^2; [`Span::at_place`] says when they are
    /// at a fixed position.
    pub feed_by: [f64; 2],
    /// Derivatives of the acceleration by the densities of the two nodes, mm^2/s^3, taken like those of the feedrate.
    pub acceleration_by: [f64; 2],
}

impl Span {
    /// Returns the length of the span (l), mm.
    pub fn length_mm(&self) -> f64 {
        self.to_mm - self.from_mm
    }

    /// Returns the arc length of the middle of the span from the start of the curve, mm.
    pub fn middle_mm(&self) -> f64 {
        0.5 * (self.from_mm + self.to_mm)
    }

    /// Returns both halves of the span; they keep the nodes of the whole span.
    pub fn halves(&self) -> [Self; 2] {
        let middle_mm = self.middle_mm();
        [Self { to_mm: middle_mm, ..*self }, Self { from_mm: middle_mm, ..*self }]
    }

    /// Returns the densities of the nodes at its start and its end, s/mm; `None` at rest. `density` has those of all
    /// nodes.
    pub fn densities(&self, density: &[f64]) -> [Option<f64>; 2] {
        self.nodes.map(|n| n.map(|n| density[n]))
    }

    /// Returns the duration of the span by (2) of the module, s.
    pub fn duration_s(&self, density: &[f64]) -> f64 {
        let l = self.length_mm();
        match self.densities(density) {
            [Some(a), Some(b)] => 0.5 * l * (a + b),
            [Some(d), None] | [None, Some(d)] => 2.0 * l * d,
            [None, None] => 0.0,
        }
    }

    /// Returns the motion at the fraction `tau` (0 to 1) of the time of the span, by (3) of the module. The densities
    /// of its nodes are in s/mm. All derivatives are at fixed `tau`.
    pub fn kinematics(&self, tau: f64, densities: [Option<f64>; 2]) -> Kinematics {
        let l = self.length_mm();
        let t = tau;
        let t2 = tau * tau;
        match densities {
            [Some(a), Some(b)] => {
                let va = 1.0 / a;
                let vb = 1.0 / b;
                let mean = 2.0 / (a + b);
                // l / T = mean; derivatives of the mean, of v, and of 1 / T = mean / l
                let by_mean = -0.5 * mean * mean;
                let by_v = [-va * va, -vb * vb];
                // s' = 6 t (1 - t) mean + (1 - 4 t + 3 t^2) v_a + (3 t^2 - 2 t) v_b
                let m = 6.0 * (t - t2);
                let p = 1.0 - 4.0 * t + 3.0 * t2;
                let q = 3.0 * t2 - 2.0 * t;
                // s'' T = (6 - 12 t) mean + (6 t - 4) v_a + (6 t - 2) v_b
                let dm = 6.0 - 12.0 * t;
                let dp = 6.0 * t - 4.0;
                let dq = 6.0 * t - 2.0;
                let change = dm * mean + dp * va + dq * vb;
                let rate = mean / l;
                let s = (3.0 - 2.0 * t) * t2
                    + ((t - 2.0 * t2 + t * t2) * va + (t * t2 - t2) * vb) / mean;
                // v_a / mean = (1 + b / a) / 2
                let early = t - 2.0 * t2 + t * t2;
                let late = t * t2 - t2;
                let s_by = [
                    0.5 * (late * vb - early * b * va * va),
                    0.5 * (early * va - late * a * vb * vb),
                ];
                Kinematics {
                    s_mm: l * s,
                    feed_mm_per_s: m * mean + p * va + q * vb,
                    acceleration_mm_per_s2: change * rate,
                    jerk_mm_per_s3: (6.0 * (va + vb) - 12.0 * mean) * rate * rate,
                    s_by: s_by.map(|s| l * s),
                    feed_by: [m * by_mean + p * by_v[0], m * by_mean + q * by_v[1]],
                    acceleration_by: [dp * by_v[0], dq * by_v[1]]
                        .map(|dv| (dm * by_mean + dv) * rate + change * by_mean / l),
                }
            }
            // s = l t^2, s' = t / D, s'' = 1 / (2 l D^2); and backwards
            [None, Some(d)] => Kinematics {
                s_mm: l * t2,
                feed_mm_per_s: t / d,
                acceleration_mm_per_s2: 0.5 / (l * d * d),
                jerk_mm_per_s3: 0.0,
                s_by: [0.0; 2],
                feed_by: [0.0, -t / (d * d)],
                acceleration_by: [0.0, -1.0 / (l * d * d * d)],
            },
            [Some(d), None] => Kinematics {
                s_mm: l * t * (2.0 - t),
                feed_mm_per_s: (1.0 - t) / d,
                acceleration_mm_per_s2: -0.5 / (l * d * d),
                jerk_mm_per_s3: 0.0,
                s_by: [0.0; 2],
                feed_by: [(t - 1.0) / (d * d), 0.0],
                acceleration_by: [1.0 / (l * d * d * d), 0.0],
            },
            [None, None] => Kinematics {
                s_mm: 0.0,
                feed_mm_per_s: 0.0,
                acceleration_mm_per_s2: 0.0,
                jerk_mm_per_s3: 0.0,
                s_by: [0.0; 2],
                feed_by: [0.0; 2],
                acceleration_by: [0.0; 2],
            },
        }
    }

    /// Returns the motion at `s_mm` from the start of the span, by (3) of the module. The derivatives of feedrate and
    /// acceleration are those at this position; those of the position stay at a fixed fraction of the time.
    pub fn at_place(&self, s_mm: f64, densities: [Option<f64>; 2]) -> Kinematics {
        let mut at = self.kinematics(self.tau_at(s_mm, densities), densities);
        // At a place the time changes by du / dD = -(ds / dD) / s' with a density.
        if at.feed_mm_per_s > 0.0 {
            for k in 0..2 {
                let du = -at.s_by[k] / at.feed_mm_per_s;
                at.feed_by[k] += at.acceleration_mm_per_s2 * du;
                at.acceleration_by[k] += at.jerk_mm_per_s3 * du;
            }
        }
        at
    }

    /// Returns the fraction of the time of the span after which the tool is `s_mm` from its start.
    ///
    /// On a span that begins or ends at rest this has a closed form. Otherwise Newton's method solves (3) of the module
    /// within brackets, because (3) is monotone. It starts at the time that the linear density gives.
    pub fn tau_at(&self, s_mm: f64, densities: [Option<f64>; 2]) -> f64 {
        let f = (s_mm / self.length_mm()).clamp(0.0, 1.0);
        let (a, b) = match densities {
            [Some(a), Some(b)] => (a, b),
            [None, _] => return f.sqrt(),
            [_, None] => return 1.0 - (1.0 - f).sqrt(),
        };
        // s / l = (3 - 2 t) t^2 + (t - 2 t^2 + t^3) p + (t^3 - t^2) q,  p = v_a T / l, q = v_b T / l
        let p = 0.5 * (1.0 + b / a);
        let q = 0.5 * (1.0 + a / b);
        let c2 = 3.0 - 2.0 * p - q;
        let c3 = p + q - 2.0;
        let (mut low, mut high) = (0.0, 1.0);
        let mut tau = f * (2.0 * a + (b - a) * f) / (a + b);
        for _ in 0..MAX_INVERSION_STEPS {
            let off = ((c3 * tau + c2) * tau + p) * tau - f;
            if off < 0.0 {
                low = tau
            } else {
                high = tau
            }
            let newton = tau - off / ((3.0 * c3 * tau + 2.0 * c2) * tau + p);
            let next = if (low..=high).contains(&newton) { newton } else { 0.5 * (low + high) };
            let step = (next - tau).abs();
            tau = next;
            // The next step of Newton's method would be of the order of the square of this one.
            if step < INVERSION_STEP {
                break;
            }
        }
        tau
    }
}

/// Gauss point of a span with the tool on.
#[derive(Clone, Copy, Debug)]
struct Point {
    /// Length of the path that belongs to each of the two nodes at this point, mm.
    weight: [f64; 2],
    nodes: [Option<usize>; 2],
    span: usize,
    /// Length from the start of the span to the point, mm.
    s_mm: f64,
}

/// Mesh of the density: nodes and spans of all curves, and the Gauss points at which the tool acts.
#[derive(Clone, Debug)]
pub struct Mesh {
    /// Spans in order, curve by curve.
    pub spans: Vec<Span>,
    /// Number of nodes, without the rests.
    pub nodes: usize,
    /// Positions of the Gauss points of the spans with the tool on, mm.
    pub points_mm: Vec<[f64; 2]>,
    /// Directions of the curve at the Gauss points, rad from positive x towards positive y.
    pub headings_rad: Vec<f64>,
    /// Segment of the path for every Gauss point.
    pub segments: Vec<usize>,
    points: Vec<Point>,
}

impl Mesh {
    /// Builds the mesh with nodes along the curves at most `spacing_mm` apart, and further ones at corners and where
    /// the tool is switched.
    ///
    /// # Errors
    ///
    /// Refuses a spacing at which the nodes would not fit into the memory.
    pub fn new(curves: &[Curve], path: &ToolPath, spacing_mm: f64) -> Result<Self, Invalid> {
        let length: f64 = curves.iter().map(Curve::length_mm).sum();
        budget::affordable(
            "tool_path",
            length / spacing_mm,
            GAUSS_POINTS * 8 * size_of::<f64>(),
            "give a larger spacing of the nodes; is the path in mm?",
        )?;
        let breaks: Vec<Vec<f64>> =
            curves.iter().map(|curve| breaks(curve, path, spacing_mm)).collect();
        Ok(Self::through(curves, path, &breaks))
    }

    /// Returns the mesh with one more node in the middle of every span for which `halved` (spans) is true. None of
    /// these may end at rest.
    pub fn refined(&self, curves: &[Curve], path: &ToolPath, halved: &[bool]) -> Self {
        let mut breaks = vec![vec![0.0]; curves.len()];
        for (span, halved) in self.spans.iter().zip(halved) {
            let at = &mut breaks[span.curve];
            if *halved {
                at.push(span.middle_mm());
            }
            at.push(span.to_mm);
        }
        Self::through(curves, path, &breaks)
    }

    /// Returns the mesh with nodes at all arc lengths `breaks` (curves), mm, except the first and the last one, which
    /// are rests.
    fn through(curves: &[Curve], path: &ToolPath, breaks: &[Vec<f64>]) -> Self {
        let mut spans = Vec::new();
        let mut nodes = 0;
        for (c, at) in breaks.iter().enumerate() {
            for (i, w) in at.windows(2).enumerate() {
                let before = if i > 0 { Some(nodes - 1) } else { None };
                let after = if i + 2 < at.len() { Some(nodes) } else { None };
                nodes += usize::from(after.is_some());
                spans.push(Span { curve: c, from_mm: w[0], to_mm: w[1], nodes: [before, after] });
            }
        }
        let rule = gauss_legendre::<GAUSS_POINTS>();
        let mut points = Vec::new();
        let mut points_mm = Vec::new();
        let mut segments = Vec::new();
        let mut headings_rad = Vec::new();
        for (i, span) in spans.iter().enumerate() {
            let curve = &curves[span.curve];
            let l = span.length_mm();
            for (u, omega) in rule {
                let (f, weight) = match span.nodes {
                    [Some(_), Some(_)] => (u, [1.0 - u, u].map(|w| w * l * omega)),
                    [None, _] => (u * u, [0.0, 2.0 * l * omega]),
                    [_, None] => (1.0 - u * u, [2.0 * l * omega, 0.0]),
                };
                let s = span.from_mm + f * l;
                let segment = curve.piece_at(s).segment;
                if path.tool_on()[segment] {
                    segments.push(segment);
                    points.push(Point { weight, nodes: span.nodes, span: i, s_mm: f * l });
                    let Station { point_mm, tangent, .. } = curve.station(s);
                    points_mm.push(point_mm);
                    headings_rad.push(tangent[1].atan2(tangent[0]));
                }
            }
        }
        Self { spans, nodes, points_mm, headings_rad, segments, points }
    }

    /// Returns the dwell time at every Gauss point (points), s, by (1) of the module for the densities of the nodes,
    /// s/mm.
    pub fn times_s(&self, density: &[f64]) -> Vec<f64> {
        let times = self.points.iter().map(|point| {
            let nodes = point.nodes.iter().zip(point.weight);
            nodes.map(|(node, weight)| node.map_or(0.0, |j| weight * density[j])).sum()
        });
        times.collect()
    }

    /// Returns the derivatives of a function by the densities (nodes), from its derivatives `by_time` by the times at
    /// the Gauss points.
    pub fn collect(&self, by_time: &[f64]) -> Vec<f64> {
        let mut by_density = vec![0.0; self.nodes];
        for (point, g) in self.points.iter().zip(by_time) {
            for (node, weight) in point.nodes.iter().zip(point.weight) {
                if let Some(j) = node {
                    by_density[*j] += weight * g;
                }
            }
        }
        by_density
    }

    /// Returns the correction of [`Self::collect`] for a function of the removal of the motion (3) of the module: the
    /// exact derivatives by the densities less those of [`Self::collect`].
    ///
    /// At a point the motion takes `1 / s'` per length. Its derivatives by the two densities are `-s'_k / s'^2` and not
    /// `1 - f` and `f`; at rest they are the same. The time of a span is linear in the densities, so on every span the
    /// sum of the differences is zero. The method subtracts what the Gauss points leave of this sum.
    pub fn collect_beyond(&self, by_time: &[f64], density: &[f64]) -> Vec<f64> {
        let mut by_density = vec![0.0; self.nodes];
        let of_spans = self.points.chunk_by(|a, b| a.span == b.span);
        let mut from = 0;
        for points in of_spans {
            let by_time = &by_time[from..from + points.len()];
            from += points.len();
            let [Some(j), Some(k)] = points[0].nodes else { continue };
            let span = &self.spans[points[0].span];
            let densities = [density[j], density[k]];
            let differences: Vec<[f64; 2]> = points
                .iter()
                .map(|point| {
                    let at = span.at_place(point.s_mm, densities.map(Some));
                    let length_mm = point.weight[0] + point.weight[1];
                    let slowness_by = at.feed_by.map(|by| -by / at.feed_mm_per_s.powi(2));
                    [0, 1].map(|e| length_mm * slowness_by[e] - point.weight[e])
                })
                .collect();
            for (e, node) in [j, k].into_iter().enumerate() {
                let sum: f64 = differences.iter().map(|d| d[e]).sum();
                let over_length = sum / span.length_mm();
                for ((d, point), g) in differences.iter().zip(points).zip(by_time) {
                    let length_mm = point.weight[0] + point.weight[1];
                    by_density[node] += (d[e] - over_length * length_mm) * g;
                }
            }
        }
        by_density
    }

    /// Returns, for every node (nodes), the Gauss points at which it acts: index, and length of the path that belongs
    /// to the node there, mm.
    pub fn columns(&self) -> Vec<Vec<(usize, f64)>> {
        let mut columns = vec![Vec::new(); self.nodes];
        for (i, point) in self.points.iter().enumerate() {
            for (node, weight) in point.nodes.iter().zip(point.weight) {
                if let Some(j) = node {
                    columns[*j].push((i, weight));
                }
            }
        }
        columns
    }

    /// Returns the number of multiplications of one factorisation of the normal matrix: the sum of b^2 over the nodes.
    /// b is the number of earlier nodes within reach of a TIF, in the order along the axis (x or y) for which the sum
    /// is less.
    pub fn work(&self, tif: &Tif) -> f64 {
        let columns = self.columns();
        let [x, y] = [(0, &tif.grid().x), (1, &tif.grid().y)]
            .map(|(axis, own)| self.work_along(&columns, axis, own.end_mm() - own.start_mm()));
        x.min(y)
    }

    /// Returns [`Self::work`] for the nodes in the order along `axis` (0 x, 1 y), for a TIF that reaches `reach_mm`
    /// along it.
    fn work_along(&self, columns: &[Vec<(usize, f64)>], axis: usize, reach_mm: f64) -> f64 {
        let mut places: Vec<f64> = columns
            .iter()
            .filter(|points| !points.is_empty())
            .map(|points| {
                let sum: f64 = points.iter().map(|(i, _)| self.points_mm[*i][axis]).sum();
                sum / points.len() as f64
            })
            .collect();
        places.sort_by(f64::total_cmp);
        let mut first = 0;
        let mut sum = 0.0;
        for (i, place) in places.iter().enumerate() {
            first += places[first..].iter().take_while(|p| **p < place - reach_mm).count();
            sum += ((i - first) as f64).powi(2);
        }
        sum
    }

    /// Returns the length of the path that belongs to every node (nodes), mm: the derivatives of the total time by the
    /// densities.
    pub fn lengths_mm(&self) -> Vec<f64> {
        let mut lengths = vec![0.0; self.nodes];
        for span in &self.spans {
            let l = span.length_mm();
            let each = if span.nodes.iter().all(Option::is_some) { 0.5 * l } else { 2.0 * l };
            span.nodes.iter().flatten().for_each(|j| lengths[*j] += each);
        }
        lengths
    }
}

/// Returns the arc lengths of the nodes of a curve, mm, from the rest at its start to that at its end.
fn breaks(curve: &Curve, path: &ToolPath, spacing_mm: f64) -> Vec<f64> {
    let end = curve.length_mm();
    let mut at = vec![0.0];
    let switches = curve
        .pieces()
        .windows(2)
        .filter(|w| path.tool_on()[w[0].segment] != path.tool_on()[w[1].segment])
        .map(|w| w[1].from_mm);
    at.extend(switches);
    at.push(end);
    // Corners between them, and then the ends of corners, where they are not too near.
    let nearest = NEAREST_NODE_FRACTION * spacing_mm;
    let corners = curve.corners().iter();
    let gentle = corners.clone().filter(|c| c.turn_rad > GENTLE_TURN_RAD);
    let at = insert(at, gentle.map(|c| c.at_mm), nearest);
    let sharp = corners.filter(|c| c.turn_rad > SHARP_TURN_RAD);
    let ends = sharp.flat_map(|c| [c.at_mm - c.half_length_mm, c.at_mm + c.half_length_mm]);
    let at = insert(at, ends, nearest);
    // At least one node between two rests.
    let least_parts = if at.len() == 2 { 2.0 } else { 1.0 };
    let mut all = vec![0.0];
    for w in at.windows(2) {
        let parts = ((w[1] - w[0]) / spacing_mm).ceil().max(least_parts);
        for k in 1..=parts as usize {
            let f = k as f64 / parts;
            all.push(w[0] + f * (w[1] - w[0]));
        }
    }
    all
}

/// Returns the ascending values `at` with those ascending candidates that are farther than `nearest` from every value
/// and from each other.
fn insert(at: Vec<f64>, candidates: impl Iterator<Item = f64>, nearest: f64) -> Vec<f64> {
    let mut all: Vec<f64> = Vec::with_capacity(at.len());
    let mut rest = at.into_iter().peekable();
    for candidate in candidates {
        while let Some(value) = rest.next_if(|value| *value <= candidate) {
            all.push(value);
        }
        let free = |other: Option<&f64>| other.is_none_or(|v| (v - candidate).abs() > nearest);
        if free(all.last()) && free(rest.peek()) {
            all.push(candidate);
        }
    }
    all.extend(rest);
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::curve::{Rounding, curves};
    use ndarray::Array2;
    use planish_dwell::residual::{Free, Residual};
    use planish_types::{Axis, Grid, Surface};

    #[test]
    fn the_motion_of_a_span_has_its_times_and_feeds_and_derivatives() {
        let inner = Span { curve: 0, from_mm: 1.0, to_mm: 1.7, nodes: [Some(0), Some(1)] };
        let first = Span { nodes: [None, Some(1)], ..inner };
        let last = Span { nodes: [Some(0), None], ..inner };
        let d = [0.13, 0.31];
        for (span, feeds) in [
            (inner, [1.0 / d[0], 1.0 / d[1]]),
            (first, [0.0, 1.0 / d[1]]),
            (last, [1.0 / d[0], 0.0]),
        ] {
            let (of, time) = (span.densities(&d), span.duration_s(&d));
            let (start, end) = (span.kinematics(0.0, of), span.kinematics(1.0, of));
            assert_eq!(start.s_mm, 0.0);
            // Below: rounding of lengths of 0.7 mm and of feeds of up to 8 mm/s.
            assert!((end.s_mm - 0.7).abs() < 1e-15);
            assert!((start.feed_mm_per_s - feeds[0]).abs() < 1e-14);
            assert!((end.feed_mm_per_s - feeds[1]).abs() < 1e-14);
            for tau in [0.1, 0.5, 0.9] {
                let at = span.kinematics(tau, of);
                // Central differences of quadratics and cubics: h^2 of the third derivative, and rounding / h.
                let (h, s) = (1e-4, |t: f64| span.kinematics(t, of));
                let feed = (s(tau + h).s_mm - s(tau - h).s_mm) / (2.0 * h * time);
                assert!((feed - at.feed_mm_per_s).abs() < 1e-6 * at.feed_mm_per_s);
                let a = (s(tau + h).feed_mm_per_s - s(tau - h).feed_mm_per_s) / (2.0 * h * time);
                assert!((a - at.acceleration_mm_per_s2).abs() < 1e-6 * a.abs().max(1.0));
                // Rounding of a fraction.
                assert!((span.tau_at(at.s_mm, of) - tau).abs() < 1e-14);
                for k in (0..2).filter(|k| span.nodes[*k].is_some()) {
                    let moved = |h: f64| {
                        let mut of = of;
                        of[k] = of[k].map(|d| d + h);
                        span.kinematics(tau, of)
                    };
                    let (p, m) = (moved(1e-6), moved(-1e-6));
                    let by = (p.feed_mm_per_s - m.feed_mm_per_s) / 2e-6;
                    assert!((by - at.feed_by[k]).abs() < 1e-6 * by.abs().max(1.0));
                    let by = (p.acceleration_mm_per_s2 - m.acceleration_mm_per_s2) / 2e-6;
                    assert!((by - at.acceleration_by[k]).abs() < 1e-6 * by.abs().max(1.0));
                    let there = span.at_place(at.s_mm, of);
                    let moved = |h: f64| {
                        let mut d = d;
                        d[k] += h;
                        span.at_place(at.s_mm, span.densities(&d))
                    };
                    let (p, m) = (moved(1e-6), moved(-1e-6));
                    let by = (p.feed_mm_per_s - m.feed_mm_per_s) / 2e-6;
                    assert!((by - there.feed_by[k]).abs() < 1e-6 * by.abs().max(1.0), "{tau} {k}");
                    let by = (p.acceleration_mm_per_s2 - m.acceleration_mm_per_s2) / 2e-6;
                    assert!((by - there.acceleration_by[k]).abs() < 1e-6 * by.abs().max(1.0));
                }
            }
        }
    }

    #[test]
    fn the_derivatives_are_those_of_the_removal_and_of_the_time() {
        let own = Axis::new(-2.0, 0.25, 17).unwrap();
        let g = Grid { x: own, y: own };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            10.0 * (-(g.x.coordinate_mm(c).powi(2) + 1.3 * g.y.coordinate_mm(r).powi(2)) / 0.8)
                .exp()
        });
        let tif = Tif::new(g, rate).unwrap();
        let axis = |n: usize| Axis::new(0.0, 0.25, n).unwrap();
        let grid = Grid { x: axis(33), y: axis(21) };
        let z =
            Array2::from_shape_fn(grid.shape(), |(r, c)| (0.3 * c as f64 + 0.2 * r as f64).sin());
        let desired = Surface::new(grid, z).unwrap();
        let points = vec![[0.0, 1.0], [7.0, 1.0], [7.0, 2.0], [0.5, 2.0], [0.5, 4.0], [8.0, 4.0]];
        let path = ToolPath::through(points, vec![true; 5], vec![0; 5]).unwrap();
        let rounding = Rounding { deviation_mm: 0.1, radius_mm: 0.5 };
        let curves = curves(&path, &rounding).curves;
        let mesh = Mesh::new(&curves, &path, 0.6).unwrap();
        let residual = Residual::new(&desired, &tif, &mesh.points_mm, None, Free::Piston).unwrap();
        let density: Vec<f64> =
            (0..mesh.nodes).map(|j| 0.3 + 0.1 * (1.7 * j as f64).sin()).collect();
        let gradient =
            |d: &[f64]| mesh.collect(&residual.evaluate(&mesh.times_s(d)).gradient_nm2_per_s);
        let by = gradient(&density);
        for j in [0, 1, mesh.nodes / 2, mesh.nodes - 1] {
            let value = |h: f64| {
                let mut d = density.clone();
                d[j] += h;
                let total: f64 = mesh.spans.iter().map(|s| s.duration_s(&d)).sum();
                (residual.evaluate(&mesh.times_s(&d)).half_mean_square_nm2, total)
            };
            let (plus, minus) = (value(1e-3), value(-1e-3));
            // Quadratic and linear: exact but for rounding.
            let error = ((plus.0 - minus.0) / 2e-3 - by[j]).abs();
            assert!(error < 1e-8 * by[j].abs().max(1.0), "{j}");
            // Rounding of a total of some ten seconds over 2e-3.
            assert!(((plus.1 - minus.1) / 2e-3 - mesh.lengths_mm()[j]).abs() < 1e-10);
        }
        // The normal matrix is the curvature, but for the energy that the cells lose (0.5 %).
        let normal = residual.normal(&mesh.columns(), None).unwrap();
        let d: Vec<f64> = (0..mesh.nodes).map(|j| (0.2 * j as f64).sin()).collect();
        let moved: Vec<f64> = density.iter().zip(&d).map(|(u, d)| u + d).collect();
        let exact: f64 =
            gradient(&moved).iter().zip(&by).zip(&d).map(|((a, b), d)| d * (a - b)).sum();
        let ordered: Vec<f64> = normal.order.iter().map(|j| d[*j]).collect();
        let found: f64 =
            normal.matrix.product(&ordered).iter().zip(&ordered).map(|(a, b)| a * b).sum();
        assert!((found / exact - 1.0).abs() < 0.01, "{found} {exact}");
    }
}
