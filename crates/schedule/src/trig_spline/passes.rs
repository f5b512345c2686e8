//! Passes of a path: maximal runs of segments with the tool on, their corners, and the densities
//! that give every segment its dwell time. A straight is a segment of a pass with a length above rounding. The numbers
//! of equations and steps are those of [`super`].

use std::{f64::consts::PI, ops::Range};

use planish_numerics::linear::tridiagonal::{self, TridiagonalRow as Row};
use planish_types::{DensityNodes, DwellDensity, DwellTime, Invalid, Limits, ToolPath};

use super::{
    report::TrigSplineReport,
    spline::{Limited, TrigPiece},
};
use crate::{largest_along, rounding_mm, shortest_cubic::State};

/// Part of the limits that the repair leaves free, relative. The acceleration of a fitted cubic deviates
/// from that of the spline; with the margin a few cuts near its peak are enough. Larger: motions are
/// slower. Smaller: more cubics.
pub(super) const MARGIN: f64 = 1e-4;

/// Largest difference of two unit vectors that count as the same direction, dimensionless. Larger: the
/// velocity steps at the node. Smaller: rounded coordinates of a line become corners. The value makes a
/// step of 1e-7 mm/s at 100 mm/s.
const SAME_DIRECTION: f64 = 1e-9;

/// Largest distance from the path at which two directions still count as the same, mm, for a tool that keeps the first
/// direction up to the middle of the second segment. Larger: the position steps at the node. Smaller: rounded
/// coordinates of a line become corners. The value is a tenth of the position step that `planish verify` takes for
/// rounding.
const SAME_LINE_MM: f64 = 1e-7;

/// Deficit of the time of a straight segment that counts as rounding, relative to the time. Larger: segments get less
/// than their dwell time. Smaller: rounding releases densities without need that are held at their least value.
const SHORT: f64 = 1e-9;

/// Largest number of times that a density that is held at its least value (half the mean density of its segment) is
/// released. Without a bound, two that are held in turn would never end. Larger: more tridiagonal solutions. Smaller:
/// segments can keep less than their dwell time.
const MOST_LET_GO: usize = 3;

/// Largest half length of a blend (the parabola at a corner), relative to the shorter of its two segments. Larger: less
/// of the segment is left for the change of density. Smaller: corners of short segments are passed more slowly.
const LARGEST_BLEND: f64 = 0.25;

/// Blend (parabola) at the end of a segment where the direction of the path changes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Corner {
    /// Half length (b), mm: the distance from the corner at which the blend starts and ends.
    half_length_mm: f64,
    /// Change of the unit vector of the direction, u2 - u1.
    turn: [f64; 2],
}

/// Node of the spline: a dwell point or a corner.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    pub(super) density: f64,
    /// Smallest density that the velocity limit allows, and at a corner also the acceleration limit, s/mm.
    pub(super) least: f64,
    /// Smallest density that the velocity limit alone allows, without the margin, s/mm.
    pub(super) fastest: f64,
    /// Length on which the density is constant before and after the node, mm: the half length of a corner, 0 at a dwell
    /// point.
    pub(super) half_length_mm: f64,
}

/// Segment of a pass with a length above rounding.
#[derive(Clone, Copy, Debug)]
pub(super) struct Straight {
    /// Index of the segment in the path.
    pub(super) index: usize,
    pub(super) start: [f64; 2],
    pub(super) direction: [f64; 2],
    pub(super) length: f64,
    /// Arc length of the whole path up to the start of the straight, mm.
    arc_length: f64,
    /// Largest acceleration along the direction of the segment, less the margin of the repair, mm/s^2.
    max_acceleration: f64,
    /// Blend at the end of the segment; `None` if the direction does not change there.
    corner: Option<Corner>,
}

/// Pass: a maximal run of segments with the tool on.
#[derive(Clone, Debug)]
pub(super) struct Pass {
    /// Range of the segments in the path.
    pub(super) run: Range<usize>,
    /// Start of the pass [x, y], mm.
    start_mm: [f64; 2],
    /// Segments with a length above rounding; empty if the tool only stands.
    pub(super) straights: Vec<Straight>,
    /// Nodes in order: the dwell points, and the corners between them.
    pub(super) nodes: Vec<Node>,
    /// Index of the straight for each node; a dwell point is at the middle of the straight, a corner at its end.
    pub(super) straight_of: Vec<usize>,
}

/// Returns the index ranges of the maximal runs of segments with the tool on.
pub(super) fn runs_with_tool_on(path: &ToolPath) -> impl Iterator<Item = Range<usize>> + '_ {
    let on = path.tool_on();
    let mut next = 0;
    std::iter::from_fn(move || {
        let first = (next..on.len()).find(|i| on[*i])?;
        let after = (first..on.len()).find(|i| !on[*i]).unwrap_or(on.len());
        next = after;
        Some(first..after)
    })
}

impl Pass {
    pub(super) fn new(
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
        corner_deviation_mm: f64,
        run: Range<usize>,
        report: &mut TrigSplineReport,
    ) -> Self {
        let v_max = limits.max_velocity_mm_per_s();
        let a_max = limits.max_acceleration_mm_per_s2();
        let mut arc_length: f64 = (0..run.start).map(|i| path.segment_length_mm(i)).sum();
        let mut straights: Vec<Straight> = Vec::new();
        for index in run.clone() {
            let length = path.segment_length_mm(index);
            if length > rounding_mm(path, index) {
                let direction = path.displacement_mm(index).map(|d| d / length);
                straights.push(Straight {
                    index,
                    start: path.point_mm()[index],
                    direction,
                    length,
                    arc_length,
                    max_acceleration: (1.0 - MARGIN) * largest_along(direction, a_max),
                    corner: None,
                });
            }
            arc_length += length;
        }
        for k in 1..straights.len() {
            let (before, after) = (straights[k - 1], straights[k]);
            let turn = [0, 1].map(|a| after.direction[a] - before.direction[a]);
            let size = turn[0].hypot(turn[1]);
            let aside_mm = 0.5 * size * before.length.max(after.length);
            if size > SAME_DIRECTION || aside_mm > SAME_LINE_MM {
                // deviation = b |u2 - u1| / 4
                let half_length_mm = (4.0 * corner_deviation_mm / size)
                    .min(LARGEST_BLEND * before.length.min(after.length));
                straights[k - 1].corner = Some(Corner { half_length_mm, turn });
                report.corners += 1;
                let deviation = 0.25 * half_length_mm * size;
                report.largest_corner_deviation_mm =
                    report.largest_corner_deviation_mm.max(deviation);
            }
        }
        let start_mm = path.point_mm()[run.start];
        let mut pass =
            Self { run, start_mm, straights, nodes: Vec::new(), straight_of: Vec::new() };
        if pass.straights.is_empty() {
            return pass;
        }
        let times = pass.times(dwell, report);
        let densities = pass.densities(&times, report);
        for (k, s) in pass.straights.iter().enumerate() {
            let fastest = 1.0 / largest_along(s.direction, v_max);
            let least = fastest / (1.0 - MARGIN);
            let density = densities[k];
            pass.nodes.push(Node { density, least, fastest, half_length_mm: 0.0 });
            pass.straight_of.push(k);
            let Some(corner) = s.corner else { continue };
            let next = &pass.straights[k + 1];
            let fastest = fastest.max(1.0 / largest_along(next.direction, v_max));
            let b = corner.half_length_mm;
            // a = v^2 (u2 - u1) / (2 b)
            let [x, y] = [0, 1]
                .map(|a| (corner.turn[a].abs() / (2.0 * b * (1.0 - MARGIN) * a_max[a])).sqrt());
            let least = (fastest / (1.0 - MARGIN)).max(x).max(y);
            let weights = corner_weights(s.length, next.length);
            let density = weights[0] * density + weights[1] * densities[k + 1];
            pass.nodes.push(Node { density, least, fastest, half_length_mm: b });
            pass.straight_of.push(k);
        }
        pass
    }

    /// Returns the dwell time of every straight, s. A segment without length gives its time to the straights before and
    /// after it.
    fn times(&self, dwell: &DwellTime, report: &mut TrigSplineReport) -> Vec<f64> {
        let mut times: Vec<f64> = self.straights.iter().map(|s| dwell.dwell_s()[s.index]).collect();
        for i in self.run.clone() {
            if self.straights.binary_search_by_key(&i, |s| s.index).is_ok() {
                continue;
            }
            let t = dwell.dwell_s()[i];
            if t == 0.0 {
                report.dropped.push(i);
                continue;
            }
            let after = self.straights.partition_point(|s| s.index < i);
            let takers = after.saturating_sub(1)..(after + 1).min(times.len());
            let part = t / takers.len() as f64;
            times[takers].iter_mut().for_each(|time| *time += part);
            report.moved_dwell.push(i);
        }
        times
    }

    /// Returns the densities of the dwell points that give every straight its time, s/mm. Row k of the system has the
    /// time that a density of 1 at the dwell points k-1, k, k+1 gives straight k. A density that would fall below half
    /// of the mean density of its straight is held there, so that the straight may take longer.
    fn densities(&self, times: &[f64], report: &mut TrigSplineReport) -> Vec<f64> {
        let n = self.straights.len();
        let mut rows = vec![[0.0; 3]; n];
        for k in 0..n {
            rows[k][1] += match (k == 0, k + 1 == n) {
                (true, true) => self.straights[k].length,
                (true, false) | (false, true) => 0.5 * self.straights[k].length,
                (false, false) => 0.0,
            };
        }
        for k in 0..n - 1 {
            let s = &self.straights[k];
            let next = &self.straights[k + 1];
            let [before, after] = match s.corner {
                Some(corner) => {
                    // Dwell point, cosine to the corner, plateau b | b, cosine, dwell point:
                    // (l/2 - b) (d + d_c)/2 + b d_c
                    let weights = corner_weights(s.length, next.length);
                    [(s.length, 0), (next.length, 1)].map(|(length, own)| {
                        let rest = 0.5 * length - corner.half_length_mm;
                        let at_corner = 0.5 * rest + corner.half_length_mm;
                        let mut weight = weights.map(|w| w * at_corner);
                        weight[own] += 0.5 * rest;
                        weight
                    })
                }
                None => {
                    // Cut at x = l/2 / L: integral of (1) to x, L (M2 x/2 - M1/(2 pi) sin(pi x))
                    let length = 0.5 * (s.length + next.length);
                    let x = 0.5 * s.length / length;
                    let swing = (PI * x).sin() / PI;
                    let first = [0.5 * length * (x + swing), 0.5 * length * (x - swing)];
                    [first, [0.5 * length - first[0], 0.5 * length - first[1]]]
                }
            };
            rows[k][1] += before[0];
            rows[k][2] += before[1];
            rows[k + 1][0] += after[0];
            rows[k + 1][1] += after[1];
        }
        // A density that falls too low is held, and its row then has more than its time; the others stay exact.
        // A density that was held before its neighbours may have less than its time. It is released again, a few
        // times at most.
        let least: Vec<f64> = (0..n).map(|k| 0.5 * times[k] / self.straights[k].length).collect();
        let mut held = vec![false; n];
        let mut times_let_go = vec![0; n];
        loop {
            // Every row is diagonally dominant, at least weakly.
            let d = tridiagonal::solve(n, |k| {
                if held[k] {
                    Row::held(least[k])
                } else {
                    Row { elements: rows[k], right: times[k] }
                }
            });
            let low: Vec<usize> =
                (0..n).filter(|k| !held[*k] && (d[*k].is_nan() || d[*k] < least[*k])).collect();
            let mut let_go = Vec::new();
            if low.is_empty() {
                let_go.extend((0..n).filter(|k| {
                    times_let_go[*k] < MOST_LET_GO
                        && held[*k]
                        && time_of_row(&rows[*k], &d, *k) < (1.0 - SHORT) * times[*k]
                }));
            }
            if low.is_empty() && let_go.is_empty() {
                report.held_densities += held.iter().filter(|h| **h).count();
                return d;
            }
            low.into_iter().for_each(|k| held[k] = true);
            for k in let_go {
                held[k] = false;
                times_let_go[k] += 1;
            }
        }
    }

    /// Returns the piece of the spline from node `k` to the next one, with its acceleration limit.
    pub(super) fn piece(&self, k: usize) -> Limited {
        let a = &self.nodes[k];
        let b = &self.nodes[k + 1];
        let (from, to) = (self.arc_length(k), self.arc_length(k + 1));
        let length_mm = to - b.half_length_mm - (from + a.half_length_mm);
        let straight = &self.straights[self.straight_of[k]];
        // After a corner the direction is that of the next straight.
        let straight = if a.half_length_mm > 0.0 {
            &self.straights[self.straight_of[k] + 1]
        } else {
            straight
        };
        Limited {
            shape: TrigPiece { density_s_per_mm: [a.density, b.density], length_mm },
            max_acceleration: straight.max_acceleration,
        }
    }

    pub(super) fn pieces(&self) -> impl Iterator<Item = Limited> + '_ {
        (1..self.nodes.len()).map(|k| self.piece(k - 1))
    }

    /// Returns the arc length of node `k` from the start of the pass, mm; for a corner that of the middle of its blend.
    fn arc_length(&self, k: usize) -> f64 {
        let s = &self.straights[self.straight_of[k]];
        let part = if self.nodes[k].half_length_mm > 0.0 { s.length } else { 0.5 * s.length };
        s.arc_length - self.straights[0].arc_length + part
    }

    fn standing(&self) -> State {
        State::at_rest(self.start_mm)
    }

    pub(super) fn start(&self) -> State {
        let s = self.straights.first().zip(self.nodes.first());
        s.map_or_else(
            || self.standing(),
            |(s, n)| State {
                position_mm: s.start,
                velocity_mm_per_s: s.direction.map(|u| u / n.density),
            },
        )
    }

    pub(super) fn end(&self) -> State {
        let s = self.straights.last().zip(self.nodes.last());
        s.map_or_else(
            || self.standing(),
            |(s, n)| State {
                position_mm: [0, 1].map(|a| s.start[a] + s.direction[a] * s.length),
                velocity_mm_per_s: s.direction.map(|u| u / n.density),
            },
        )
    }

    /// Returns the duration of the pass, s.
    pub(super) fn duration_s(&self) -> f64 {
        let (Some(first), Some(last)) = (self.nodes.first(), self.nodes.last()) else { return 0.0 };
        let last_straight = &self.straights[self.straights.len() - 1];
        let plateaus: f64 = self.nodes.iter().map(|n| 2.0 * n.half_length_mm * n.density).sum();
        0.5 * self.straights[0].length * first.density
            + 0.5 * last_straight.length * last.density
            + plateaus
            + self.pieces().map(|p| p.shape.duration_s()).sum::<f64>()
    }
}

/// Returns the time of straight `k`, s, from its row of the system and the densities `d` of all dwell points.
fn time_of_row([before, own, after]: &[f64; 3], d: &[f64], k: usize) -> f64 {
    let first = if k > 0 { d[k - 1] } else { 0.0 };
    let last = d.get(k + 1).copied().unwrap_or(0.0);
    before * first + own * d[k] + after * last
}

/// Returns the weights of the dwell points before and after a corner in its density; the nearer one has more weight.
/// The arguments are the lengths of the segments.
fn corner_weights(before: f64, after: f64) -> [f64; 2] {
    [after / (before + after), before / (before + after)]
}

/// Returns the nodes of all passes that have a length, in order: start, dwell points, three nodes for every corner,
/// end. `None` if no pass has a length.
pub(super) fn density_of(
    path: &ToolPath,
    passes: &[Pass],
) -> Result<Option<DwellDensity>, Invalid> {
    let mut nodes = DensityNodes::default();
    for (number, pass) in passes.iter().filter(|p| !p.straights.is_empty()).enumerate() {
        let mut push = |straight: &Straight, along: f64, density: f64, is_corner: bool| {
            let at = [0, 1].map(|a| straight.start[a] + straight.direction[a] * along);
            nodes.arc_length_mm.push(straight.arc_length + along);
            nodes.dwell_density_s_per_mm.push(density);
            nodes.point_mm.push(at);
            nodes.pass_idx.push(number as i64);
            nodes.corner.push(is_corner);
        };
        let first = &pass.straights[0];
        let last = &pass.straights[pass.straights.len() - 1];
        push(first, 0.0, pass.nodes[0].density, false);
        for (node, k) in pass.nodes.iter().zip(&pass.straight_of) {
            let straight = &pass.straights[*k];
            let b = node.half_length_mm;
            if b == 0.0 {
                push(straight, 0.5 * straight.length, node.density, false);
            } else {
                push(straight, straight.length - b, node.density, false);
                push(straight, straight.length, node.density, true);
                push(&pass.straights[*k + 1], b, node.density, false);
            }
        }
        push(last, last.length, pass.nodes[pass.nodes.len() - 1].density, false);
    }
    debug_assert!(nodes.arc_length_mm.len() <= 6 * path.len());
    if nodes.arc_length_mm.is_empty() { Ok(None) } else { DwellDensity::new(nodes).map(Some) }
}
