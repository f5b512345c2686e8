//! Rounding of corners, and steps of a wanted length.
//!
//! A pass of Chaikin's subdivision cuts every corner Q between P and R:
//!
//! ```text
//! P, Q, R  ->  .., P/4 + 3Q/4, 3Q/4 + R/4, ..
//! ```
//!
//! which halves the turning angles about. What still turns by more than 90 degrees is cut once
//! more, as far from Q on both sides: two corners of half the angle. Afterwards the path may be divided anew at equal parts
//! of the integral of
//!
//! ```text
//! max(ds / min(step, 2 d), turning / 90 degrees)
//! ```
//!
//! so that a hairpin is not cut to a spike. Both could let strands cross that were apart: a corner
//! whose cut crosses another step stays, and a chord that crosses another gets the node farthest
//! from it back, until nothing crosses.
//!
//! Source: G. M. Chaikin, Comput. Graph. Image Process. 3 (1974) 346.

use super::{Point, crossing::crossings, distance};

/// Largest length of a new step, in units of the local spacing. Larger: coarser paths, which leave the region or cross
/// more easily. Smaller: more nodes than `step_mm` asks for.
const MAX_STEP: f64 = 2.0;

/// Makes one pass of Chaikin's corner cutting over closed paths that do not cross. Returns the number of corners that
/// were left, because their cut would cross a step.
pub(super) fn round(loops: &mut [Vec<Point>]) -> usize {
    // 3Q/4 + P/4
    cut(loops, |_| false, |q, other, _| [0, 1].map(|x| 0.75 * q[x] + 0.25 * other[x]))
}

/// Replaces every corner that turns by more than 90 degrees by two corners of half the angle. Returns the number of
/// corners that were left, because their cut would cross a step.
pub(super) fn blunt(loops: &mut [Vec<Point>]) -> usize {
    cut(
        loops,
        |[p, q, r]| turn(p, q, r) <= MAX_TURN,
        |q, other, shorter| {
            // Q + t (P - Q) / |P - Q|, as far from Q on both sides
            let f = 0.25 * shorter / distance(q, other);
            [0, 1].map(|x| q[x] + f * (other[x] - q[x]))
        },
    )
}

/// Replaces every corner by two nodes, except where `stay` is true or the cut would cross another step. `place(corner,
/// neighbour, length of the shorter side)` gives each node; the result is the number of crossing cuts.
fn cut(
    loops: &mut [Vec<Point>],
    stay: impl Fn([Point; 3]) -> bool,
    place: impl Fn(Point, Point, f64) -> Point,
) -> usize {
    let mut stays: Vec<Vec<bool>> = loops
        .iter()
        .map(|l| {
            let n = l.len();
            (0..n).map(|i| stay([l[(i + n - 1) % n], l[i], l[(i + 1) % n]])).collect()
        })
        .collect();
    let mut given_up = 0;
    loop {
        let (new, corner_of): (Vec<_>, Vec<_>) = loops
            .iter()
            .zip(&stays)
            .map(|(nodes, stays)| cut_corners(nodes, stays, &place))
            .unzip();
        let mut more = 0;
        for (l, step) in crossings(&new).into_iter().flatten() {
            let from = corner_of[l][step];
            let to = corner_of[l][(step + 1) % new[l].len()];
            if from == to {
                more += usize::from(!std::mem::replace(&mut stays[l][from], true));
            }
        }
        given_up += more;
        if more == 0 {
            loops.iter_mut().zip(new).for_each(|(old, new)| *old = new);
            return given_up;
        }
    }
}

/// Returns the nodes after the cuts, and for each the index of the corner that it belongs to.
fn cut_corners(
    nodes: &[Point],
    stays: &[bool],
    place: &impl Fn(Point, Point, f64) -> Point,
) -> (Vec<Point>, Vec<usize>) {
    let n = nodes.len();
    let mut new = Vec::new();
    let mut corner_of = Vec::new();
    for (i, q) in nodes.iter().enumerate() {
        if stays[i] {
            new.push(*q);
            corner_of.push(i);
            continue;
        }
        let beside = [nodes[(i + n - 1) % n], nodes[(i + 1) % n]];
        let shorter = distance(*q, beside[0]).min(distance(*q, beside[1]));
        for other in beside {
            new.push(place(*q, other, shorter));
            corner_of.push(i);
        }
    }
    (new, corner_of)
}

/// Largest turn of the path along one step, radians. Larger: steps that cut hairpins. Smaller: more nodes.
const MAX_TURN: f64 = std::f64::consts::FRAC_PI_2;

/// Divides closed paths that do not cross into steps of at most `step_mm` and twice the `spacing` along the path.
/// Returns the number of nodes that had to be put back; `None` if there would be more than `most` steps.
pub(super) fn divide(
    loops: &mut [Vec<Point>],
    step_mm: f64,
    spacing: &impl Fn(Point) -> f64,
    most: usize,
) -> Option<usize> {
    let lines: Vec<ClosedLine> =
        loops.iter().map(|nodes| ClosedLine::new(nodes, step_mm, spacing)).collect();
    if lines.iter().map(ClosedLine::parts).sum::<f64>() > most as f64 {
        return None;
    }
    let mut stops: Vec<Vec<f64>> = lines.iter().map(ClosedLine::stops).collect();
    let mut put_back = 0;
    loop {
        let chords: Vec<Vec<Point>> = lines
            .iter()
            .zip(&stops)
            .map(|(line, stops)| stops.iter().map(|t| line.point(*t)).collect())
            .collect();
        let mut more: Vec<(usize, f64)> = Vec::new();
        for (l, step) in crossings(&chords).into_iter().flatten() {
            let from = stops[l][step];
            let to = stops[l].get(step + 1).copied().unwrap_or(lines[l].whole());
            more.extend(lines[l].farthest_between(from, to).map(|t| (l, t)));
        }
        more.sort_by(|a, b| a.0.cmp(&b.0).then_with(|| a.1.total_cmp(&b.1)));
        more.dedup();
        if more.is_empty() {
            loops.iter_mut().zip(chords).for_each(|(old, new)| *old = new);
            return Some(put_back);
        }
        put_back += more.len();
        more.iter().for_each(|(l, t)| stops[*l].push(*t));
        stops.iter_mut().for_each(|s| s.sort_by(f64::total_cmp));
    }
}

/// A closed path with the coordinate t along it, the integral of ds / (wanted step), at its nodes.
struct ClosedLine {
    /// Nodes, the first one again at the end.
    nodes: Vec<Point>,
    t: Vec<f64>,
}

impl ClosedLine {
    fn new(nodes: &[Point], step_mm: f64, spacing: &impl Fn(Point) -> f64) -> Self {
        let mut nodes = nodes.to_vec();
        nodes.push(nodes[0]);
        let n = nodes.len() - 1;
        let turn: Vec<f64> =
            (0..n).map(|i| turn(nodes[(i + n - 1) % n], nodes[i], nodes[i + 1])).collect();
        let mut t = vec![0.0];
        for (i, w) in nodes.windows(2).enumerate() {
            let local = step_mm.min(MAX_STEP * spacing(w[0]).min(spacing(w[1])));
            let turning = 0.5 * (turn[i] + turn[(i + 1) % n]);
            t.push(t[t.len() - 1] + (distance(w[0], w[1]) / local).max(turning / MAX_TURN));
        }
        Self { nodes, t }
    }

    fn whole(&self) -> f64 {
        self.t[self.t.len() - 1]
    }

    /// Returns the number of steps into which the path is divided, at least 3.
    fn parts(&self) -> f64 {
        (self.whole() - 1e-9).ceil().max(3.0)
    }

    fn stops(&self) -> Vec<f64> {
        let parts = self.parts();
        (0..parts as usize).map(|k| k as f64 * self.whole() / parts).collect()
    }

    fn point(&self, t: f64) -> Point {
        let i = self.t.partition_point(|v| *v <= t).clamp(1, self.t.len() - 1);
        let f = (t - self.t[i - 1]) / (self.t[i] - self.t[i - 1]);
        [0, 1].map(|x| self.nodes[i - 1][x] + f * (self.nodes[i][x] - self.nodes[i - 1][x]))
    }

    /// Returns the coordinate t of the node strictly between `from` and `to` that is farthest from their chord; `None`
    /// without such a node.
    fn farthest_between(&self, from: f64, to: f64) -> Option<f64> {
        let [a, b] = [from, to].map(|t| self.point(t));
        let first = self.t.partition_point(|v| *v <= from);
        let end = self.t.partition_point(|v| *v < to);
        let nodes = (first..end.max(first)).map(|i| {
            let p = self.nodes[i];
            let aside = ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])).abs();
            (aside, self.t[i])
        });
        nodes.max_by(|i, j| i.0.total_cmp(&j.0)).map(|(_, t)| t)
    }
}

/// Returns the angle between the directions from p to q and from q to r, radians, 0 to pi.
fn turn(p: Point, q: Point, r: Point) -> f64 {
    let [u, v] = [(p, q), (q, r)].map(|(a, b)| [b[0] - a[0], b[1] - a[1]]);
    (u[0] * v[1] - u[1] * v[0]).atan2(u[0] * v[0] + u[1] * v[1]).abs()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_becomes_an_octagon() {
        let mut loops = [vec![[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]];
        assert_eq!(round(&mut loops), 0);
        assert_eq!(loops[0][..3], [[0.0, 1.0], [1.0, 0.0], [3.0, 0.0]]);
        assert_eq!(loops[0].len(), 8);
    }

    #[test]
    fn a_hairpin_becomes_two_right_angles() {
        let mut loops = [vec![[0.0, 0.0], [4.0, 0.0], [-3.0, 1e-3]]];
        assert_eq!(blunt(&mut loops), 0);
        let (l, n) = (&loops[0], loops[0].len());
        assert_eq!(n, 5);
        let turns = (0..n).map(|i| turn(l[i], l[(i + 1) % n], l[(i + 2) % n]));
        assert!(turns.fold(0.0, f64::max) <= MAX_TURN);
        let square = vec![[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]];
        let mut loops = [square.clone()];
        assert_eq!((blunt(&mut loops), &loops[0]), (0, &square));
    }

    #[test]
    fn a_corner_whose_cut_would_cross_stays() {
        // A tower whose top at y = 10 stands in the notch of another path.
        let tip = vec![[0.0, 0.0], [4.0, 0.0], [2.1, 10.0], [1.9, 10.0]];
        let roof = vec![[-9.0, 0.0], [2.0, 10.5], [13.0, 0.0], [13.0, 20.0], [-9.0, 20.0]];
        let mut loops = [tip, roof];
        // Cut at a quarter, the roof's notch would come down to 7.9 at x = 2.
        assert!(round(&mut loops) > 0);
        assert!(crossings(&loops).is_empty());
    }

    #[test]
    fn steps_have_the_wanted_length() {
        let circle: Vec<Point> = (0..1000)
            .map(|i| (std::f64::consts::TAU * f64::from(i) / 1000.0).sin_cos())
            .map(|(s, c)| [10.0 * c, 10.0 * s])
            .collect();
        let mut loops = [circle.clone()];
        assert_eq!(divide(&mut loops, 1.0, &|_| 10.0, 1000), Some(0));
        // 62.83 mm in 63 steps.
        assert_eq!(loops[0].len(), 63);
        let mut loops = [circle];
        assert_eq!(divide(&mut loops, 100.0, &|_| 1.0, 1), None);
        divide(&mut loops, 100.0, &|_| 1.0, 1000).unwrap();
        assert_eq!(loops[0].len(), 32);
    }

    #[test]
    fn a_hairpin_is_not_cut_to_a_spike() {
        // Two strands 1 mm apart, joined by semicircles of 12 chords; steps of 5 mm.
        let half = |x: f64, sign: f64| {
            (0..=12).map(move |i| {
                let (s, c) = (std::f64::consts::PI * f64::from(i) / 12.0).sin_cos();
                [x + sign * 0.5 * s, -sign * 0.5 * c]
            })
        };
        let path: Vec<Point> = half(20.0, 1.0).chain(half(0.0, -1.0)).collect();
        let mut loops = [path];
        assert_eq!(divide(&mut loops, 5.0, &|_| 10.0, 1000), Some(0));
        let (nodes, n) = (&loops[0], loops[0].len());
        // 42 mm in steps of 5, and 360 degrees in steps of at most 90.
        assert!((9..=14).contains(&n), "{n}");
        let turns = (0..n).map(|i| turn(nodes[i], nodes[(i + 1) % n], nodes[(i + 2) % n]));
        // Two corners at least share the 180 degrees of each end.
        let sharpest = turns.fold(0.0, f64::max).to_degrees();
        assert!(sharpest < 120.0, "{sharpest}");
    }
}
