//! The tour: a short closed path through random points.
//!
//! Random points ("darts") have a distance of at least 0.83 d (d: spacing) from each other; from each the tour goes on
//! to the nearest one that is left. Then 2-opt and Or-opt (moves of one to three points, either way round) over the
//! nearest neighbours shorten the tour until neither can. Steps beyond the region count ten times in its length. Pairs
//! of crossing steps are exchanged, which always shortens, until there are none. Points are moved into steps that are
//! still long, and the rest of these is cut into equal parts.
//!
//! Source: J. L. Bentley, ORSA J. Comput. 4 (1992) 387 (neighbour lists, don't-look bits).

use std::collections::VecDeque;

use rand_chacha::ChaCha8Rng;

use super::{
    Loop, Point,
    crossing::crossings,
    distance,
    field::Field,
    points::{Buckets, darts},
};

/// Least distance of the random points over the spacing of the path, dimensionless. Larger: fewer points, and a wider
/// path. Smaller: more points, and a denser path.
const RADIUS_PER_SPACING: f64 = 0.83;
/// Number of nearest neighbours of a point to which a move may connect it. Larger: more time. Smaller: a longer tour.
const NEIGHBOURS: usize = 12;
/// Length above which a step is long and is repaired, in units of the local spacing. Larger: longer steps remain.
/// Smaller: more repairs.
pub(super) const LONG: f64 = 2.2;
/// Largest number of points that Or-opt moves at once. Larger: more time. Smaller: a longer tour.
const MOVED: usize = 3;
/// Factor on the length of a step that leaves the region, in the length that the tour minimises, dimensionless. Larger:
/// longer ways around holes. Smaller: more steps outside of the region.
const DETOUR: f64 = 10.0;
/// Largest number of rounds that remove steps which leave the region, and largest number of rounds that remove long
/// steps. Larger: more time. Smaller: more such steps remain.
const REPAIRS: usize = 4;

/// Returns one closed path per island (connected part of the region) with at least three points. `scale` is a factor on
/// the spacing of the field.
pub(super) fn tour(field: &Field, scale: f64, rng: &mut ChaCha8Rng) -> Vec<Loop> {
    let spacing = |p: Point| scale * field.spacing_mm(p);
    let points = darts(field, &|p| RADIUS_PER_SPACING * spacing(p), rng);
    let mut islands = vec![Vec::new(); field.island_area_mm2.len()];
    for p in points {
        if let Some(island) = field.island(p) {
            islands[island].push(p);
        }
    }
    islands.retain(|points| points.len() >= 3);
    islands.into_iter().map(|points| closed(points, field, &spacing)).collect()
}

fn closed(points: Vec<Point>, field: &Field, spacing: &impl Fn(Point) -> f64) -> Loop {
    let visits = points.len();
    let near = neighbours(&points);
    let order = nearest_neighbour(&points);
    let mut tour = Tour::new(points, order, field);
    tour.shorten(&near);
    tour.uncross();
    // An exchange of crossing steps does not look at the region.
    for _ in 0..REPAIRS {
        if tour.leaving() == 0 {
            break;
        }
        tour.shorten(&near);
        tour.uncross();
    }
    for _ in 0..REPAIRS {
        if tour.repair(&near, spacing) == 0 {
            break;
        }
        tour.uncross();
    }
    let node_mm: Vec<Point> = tour.order.iter().map(|c| tour.points[*c as usize]).collect();
    Loop { node_mm: cut_long(&node_mm, spacing), visits }
}

fn buckets(points: &[Point]) -> Buckets {
    let low = [0, 1].map(|a| points.iter().map(|p| p[a]).fold(f64::MAX, f64::min));
    let high = [0, 1].map(|a| points.iter().map(|p| p[a]).fold(f64::MIN, f64::max));
    let area = (high[0] - low[0]) * (high[1] - low[1]);
    let longer = (high[0] - low[0]).max(high[1] - low[1]);
    // About one point per bucket.
    let side = (area / points.len() as f64).sqrt().max(longer / points.len() as f64);
    Buckets::new(points, low, high, side)
}

fn neighbours(points: &[Point]) -> Vec<Vec<u32>> {
    let buckets = buckets(points);
    let wanted = NEIGHBOURS.min(points.len() - 1);
    let neighbours = points.iter().enumerate().map(|(i, &p)| {
        let mut reach = buckets.side();
        let mut near: Vec<(f64, u32)> = Vec::new();
        // Enough of them within the circle that the square of buckets surely holds.
        while near.iter().filter(|n| n.0 <= reach).count() < wanted {
            reach *= 1.5;
            let others = buckets.around(p, reach).filter(|j| *j != i);
            near = others.map(|j| (distance(points[j], p), j as u32)).collect();
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then_with(|| a.1.cmp(&b.1)));
        near.iter().take(wanted).map(|n| n.1).collect()
    });
    neighbours.collect()
}

fn nearest_neighbour(points: &[Point]) -> Vec<u32> {
    let mut left = buckets(points);
    let mut order = vec![0];
    left.remove(0, points[0]);
    let mut here = points[0];
    while let Some(next) = left.nearest(points, here) {
        order.push(next as u32);
        here = points[next];
        left.remove(next, here);
    }
    order
}

/// Returns the nodes of a closed path with additional ones where a step is longer than [`LONG`] spacings: it is cut
/// into equal parts.
fn cut_long(nodes: &[Point], spacing: &impl Fn(Point) -> f64) -> Vec<Point> {
    let mut out = Vec::new();
    for (i, a) in nodes.iter().enumerate() {
        let b = nodes[(i + 1) % nodes.len()];
        let smallest = spacing(*a).min(spacing(between(*a, b, 0.5))).min(spacing(b));
        let parts = (distance(*a, b) / (LONG * smallest)).ceil().max(1.0);
        out.extend((0..parts as usize).map(|k| between(*a, b, k as f64 / parts)));
    }
    out
}

/// Returns the point at the fraction `f`, 0 to 1, of the line from `a` to `b`.
fn between(a: Point, b: Point, f: f64) -> Point {
    [0, 1].map(|x| a[x] + f * (b[x] - a[x]))
}

/// A closed tour: the points, their indices in the order of the tour, and the position (`place`) of each in that order.
struct Tour<'a> {
    field: &'a Field,
    points: Vec<Point>,
    order: Vec<u32>,
    place: Vec<u32>,
}

impl<'a> Tour<'a> {
    fn new(points: Vec<Point>, order: Vec<u32>, field: &'a Field) -> Self {
        let mut place = vec![0; order.len()];
        order.iter().enumerate().for_each(|(i, c)| place[*c as usize] = i as u32);
        Self { field, points, order, place }
    }

    fn len(&self) -> usize {
        self.order.len()
    }

    fn next(&self, c: u32) -> u32 {
        let i = self.place[c as usize] as usize + 1;
        self.order[if i == self.len() { 0 } else { i }]
    }

    fn previous(&self, c: u32) -> u32 {
        let i = self.place[c as usize] as usize;
        self.order[if i == 0 { self.len() - 1 } else { i - 1 }]
    }

    /// Returns the next point of the tour if `ahead` is true, otherwise the previous one.
    fn step(&self, c: u32, ahead: bool) -> u32 {
        if ahead { self.next(c) } else { self.previous(c) }
    }
    fn distance(&self, a: u32, b: u32) -> f64 {
        distance(self.points[a as usize], self.points[b as usize])
    }

    fn leaves(&self, a: u32, b: u32) -> bool {
        self.field.leaves(self.points[a as usize], self.points[b as usize])
    }

    /// Returns the distance of two points, mm, times [`DETOUR`] if the step between them leaves the region.
    fn cost(&self, a: u32, b: u32) -> f64 {
        self.distance(a, b) * if self.leaves(a, b) { DETOUR } else { 1.0 }
    }

    /// Returns the number of steps of the tour that leave the region.
    fn leaving(&self) -> usize {
        self.order.iter().filter(|c| self.leaves(**c, self.next(**c))).count()
    }

    /// Reverses the path from `a` to `b` in the order of the tour, or the rest of the tour if that is shorter.
    fn reverse(&mut self, a: u32, b: u32) {
        let n = self.len();
        let [mut i, mut j] = [a, b].map(|c| self.place[c as usize] as usize);
        let inner = (j + n - i) % n + 1;
        let mut swaps = inner / 2;
        if 2 * inner > n {
            (i, j) = ((j + 1) % n, (i + n - 1) % n);
            swaps = (n - inner) / 2;
        }
        for _ in 0..swaps {
            self.order.swap(i, j);
            self.place[self.order[i] as usize] = i as u32;
            self.place[self.order[j] as usize] = j as u32;
            i = if i + 1 == n { 0 } else { i + 1 };
            j = if j == 0 { n - 1 } else { j - 1 };
        }
    }

    /// Replaces the steps a -> a' and b -> b' by a -> b and a' -> b'.
    fn exchange(&mut self, a: u32, b: u32) {
        let from = self.next(a);
        self.reverse(from, b);
    }

    /// Applies 2-opt and Or-opt until neither finds a shorter tour. `near` has the nearest neighbours of each point.
    fn shorten(&mut self, near: &[Vec<u32>]) {
        let mut queue: VecDeque<u32> = self.order.iter().copied().collect();
        let mut queued = vec![true; self.len()];
        while let Some(c) = queue.pop_front() {
            queued[c as usize] = false;
            while let Some(touched) = self.two_opt(c, near).or_else(|| self.or_opt(c, near)) {
                for t in touched {
                    if !std::mem::replace(&mut queued[t as usize], true) {
                        queue.push_back(t);
                    }
                }
            }
        }
    }

    fn two_opt(&mut self, a: u32, near: &[Vec<u32>]) -> Option<[u32; 6]> {
        for ahead in [true, false] {
            let a_next = self.step(a, ahead);
            let old = self.cost(a, a_next);
            for &b in &near[a as usize] {
                if self.distance(a, b) >= old {
                    break;
                }
                let new = self.cost(a, b);
                let b_next = self.step(b, ahead);
                if b == a_next || b_next == a {
                    continue;
                }
                let change = new + self.cost(a_next, b_next) - old - self.cost(b, b_next);
                if change < -LEAST_GAIN * old {
                    if ahead {
                        self.exchange(a, b)
                    } else {
                        self.exchange(a_next, b_next)
                    }
                    return Some([a, a_next, b, b_next, a, b]);
                }
            }
        }
        None
    }

    /// Tries to move one to three points that begin or end with `a` next to a neighbour of `a`. Returns the points
    /// whose steps changed, or `None` if no move shortens the tour.
    fn or_opt(&mut self, a: u32, near: &[Vec<u32>]) -> Option<[u32; 6]> {
        for moved in 1..=MOVED.min(self.len().saturating_sub(3)) {
            for ahead in [true, false] {
                // The path a .. z, and what is before and after it.
                let mut z = a;
                for _ in 1..moved {
                    z = self.step(z, ahead);
                }
                let (first, last) = if ahead { (a, z) } else { (z, a) };
                let before = self.previous(first);
                let after = self.next(last);
                let gain =
                    self.cost(before, first) + self.cost(last, after) - self.cost(before, after);
                for &b in &near[a as usize] {
                    if self.distance(a, b) >= gain {
                        break;
                    }
                    let joined = self.cost(a, b);
                    let offset = (self.place[b as usize] + self.len() as u32
                        - self.place[first as usize])
                        % self.len() as u32;
                    if (offset as usize) < moved {
                        continue;
                    }
                    // a beside b, z beside the next or the one before b.
                    for c in [self.next(b), self.previous(b)] {
                        let within = c == first || c == last;
                        let change = joined + self.cost(z, c) - self.cost(b, c) - gain;
                        if !within && change < -LEAST_GAIN * gain {
                            self.relocate([before, first, last, after], [b, c], a);
                            return Some([before, after, b, c, a, z]);
                        }
                    }
                }
            }
        }
        None
    }

    /// Moves the path first .. last between the neighbours b and c, with its end `end` beside b.
    fn relocate(&mut self, [before, first, last, after]: [u32; 4], [b, c]: [u32; 2], end: u32) {
        // before [first .. last] [after .. x] y -> before [after .. x] [first .. last] y
        let (x, y) = if self.next(b) == c { (b, c) } else { (c, b) };
        let first_by_x = (end == first) == (b == x);
        let n = self.len() as u32;
        let [first_place, last_place, x_place, y_place] =
            [first, last, x, y].map(|c| self.place[c as usize]);
        if (x_place + n - last_place) % n <= (first_place + n - y_place) % n {
            // before F..L after..x y: reverse (F..x), then its parts.
            self.reverse(first, x);
            // before x..after L..F y
            self.forward_reverse(before, x, after);
            // before after..x L..F y
            if first_by_x {
                self.forward_reverse(x, last, first);
            }
        } else {
            // x y..before F..L after: reverse (y..L), then its parts.
            self.reverse(y, last);
            // x L..F before..y after
            self.forward_reverse(first, before, y);
            // x L..F y..before after
            if first_by_x {
                self.forward_reverse(x, last, first);
            }
        }
    }

    /// Reverses the path between `a` and `b`, starting with the end that follows `outer` in the present direction of
    /// the tour.
    fn forward_reverse(&mut self, outer: u32, a: u32, b: u32) {
        if self.next(outer) == a { self.reverse(a, b) } else { self.reverse(b, a) }
    }

    /// Exchanges crossing steps until there are none, with at most as many rounds as points.
    fn uncross(&mut self) {
        // Every exchange shortens the tour, so this ends; rounding is stopped by the count.
        for _ in 0..self.len() {
            let nodes: Vec<Point> = self.order.iter().map(|c| self.points[*c as usize]).collect();
            let pairs = crossings(&[nodes]);
            let ends: Vec<_> = pairs
                .iter()
                .map(|p| p.map(|s| (self.order[s.1], self.order[(s.1 + 1) % self.len()])))
                .collect();
            let mut exchanged = 0;
            for [(a, a_next), (b, b_next)] in ends {
                // Both steps are still there, either way round.
                if self.next(a) == a_next && self.next(b) == b_next {
                    self.exchange(a, b);
                    exchanged += 1;
                } else if self.next(a_next) == a && self.next(b_next) == b {
                    self.exchange(a_next, b_next);
                    exchanged += 1;
                }
            }
            if exchanged == 0 {
                return;
            }
        }
    }

    /// Returns true if the step between two points is longer than [`LONG`] times the smaller of their spacings.
    fn is_long(&self, a: u32, b: u32, spacing: &impl Fn(Point) -> f64) -> bool {
        let local = spacing(self.points[a as usize]).min(spacing(self.points[b as usize]));
        self.distance(a, b) > LONG * local
    }
    /// Moves points into long steps where this makes no other step long; returns the number of moved points. `near` has
    /// the nearest neighbours of each point.
    fn repair(&mut self, near: &[Vec<u32>], spacing: &impl Fn(Point) -> f64) -> usize {
        let mut moved = 0;
        for a in 0..self.len() as u32 {
            let b = self.next(a);
            if self.len() < 5 || !self.is_long(a, b, spacing) {
                continue;
            }
            let near = near[a as usize].iter().chain(&near[b as usize]).copied();
            let offers = near.filter(|c| *c != a && *c != b).filter_map(|c| {
                let before = self.previous(c);
                let after = self.next(c);
                if [(a, c), (c, b), (before, after)].iter().any(|s| self.is_long(s.0, s.1, spacing))
                {
                    return None;
                }
                let change =
                    self.distance(a, c) + self.distance(c, b) + self.distance(before, after)
                        - self.distance(before, c)
                        - self.distance(c, after);
                Some((change, c))
            });
            if let Some((_, c)) = offers.min_by(|x, y| x.0.total_cmp(&y.0)) {
                let before = self.previous(c);
                let after = self.next(c);
                if before != b && after != a {
                    self.relocate([before, c, c, after], [a, b], c);
                    moved += 1;
                }
            }
        }
        moved
    }
}

/// Gain of a move, as a fraction of the length that it replaces, above which the move is made. Larger: useful moves are
/// left out. Smaller: rounding alone decides moves, and they may never end.
const LEAST_GAIN: f64 = 1e-9;
