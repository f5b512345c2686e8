//! Points whose distance follows the spacing: on the border of the region, and inside it.
//!
//! Border points are placed at equal parts of the integral of ds / l along the border of the
//! lattice's cells, smoothed over a pitch between its corners. Inside, darts are thrown with
//!
//! ```text
//! |x - x_i| >= a (l(x) + l(x_i))
//! ```
//!
//! and moved by Lloyd's iteration to the centroids of their Voronoi cells, weighted by l^-4: in
//! the plane the density of the points follows the square root of the weight.
//!
//! Source: S. Lloyd, IEEE Trans. Inf. Theory 28 (1982) 129; exponent: Q. Du, V. Faber,
//! M. Gunzburger, SIAM Review 41 (1999) 637.

use rand::{RngExt, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::{Point, distance, field::Field};

/// Number of cells (one pitch) of a straight run that makes a corner of the border if there is one
/// on both sides. Larger: fewer corners are kept sharp. Smaller: the staircase of a slanted border
/// counts as corners.
const CORNER_CELLS: usize = 3;
/// Number of nodes on either side over which the border is averaged, against the staircase of a
/// slanted border. Larger: a smoother border that cuts its bends. Smaller: steps remain.
const SMOOTHING_CELLS: usize = 2;
/// Number of times that every cell is offered as a place for a dart. Larger: more time, fewer gaps.
/// Smaller: gaps between the darts.
const ROUNDS: usize = 3;

/// Points in square buckets.
pub(super) struct Buckets {
    low: Point,
    side: f64,
    count: [usize; 2],
    members: Vec<Vec<u32>>,
}

impl Buckets {
    pub(super) fn new(points: &[Point], low: Point, high: Point, side: f64) -> Self {
        // At most about a million buckets.
        let side = side.max((high[0] - low[0]).max(high[1] - low[1]) / 1000.0);
        let count = [0, 1].map(|a| ((high[a] - low[a]) / side) as usize + 1);
        let mut buckets = Self { low, side, count, members: vec![Vec::new(); count[0] * count[1]] };
        points.iter().enumerate().for_each(|(i, p)| buckets.insert(i, *p));
        buckets
    }

    fn place(&self, p: Point) -> [usize; 2] {
        [0, 1].map(|a| {
            let i = ((p[a] - self.low[a]) / self.side).floor();
            i.clamp(0.0, (self.count[a] - 1) as f64) as usize
        })
    }

    pub(super) fn insert(&mut self, i: usize, p: Point) {
        let [x, y] = self.place(p);
        self.members[y * self.count[0] + x].push(i as u32);
    }

    pub(super) fn remove(&mut self, i: usize, p: Point) {
        let [x, y] = self.place(p);
        self.members[y * self.count[0] + x].retain(|member| *member != i as u32);
    }

    /// Side of a bucket, mm.
    pub(super) fn side(&self) -> f64 {
        self.side
    }

    /// Members of the buckets that meet the square of half-width `reach` about `p`.
    pub(super) fn around(&self, p: Point, reach: f64) -> impl Iterator<Item = usize> + '_ {
        let low = self.place([p[0] - reach, p[1] - reach]);
        let high = self.place([p[0] + reach, p[1] + reach]);
        (low[1]..=high[1]).flat_map(move |y| {
            let row = &self.members[y * self.count[0] + low[0]..=y * self.count[0] + high[0]];
            row.iter().flatten().map(|i| *i as usize)
        })
    }

    /// The nearest point; the first of equals.
    pub(super) fn nearest(&self, points: &[Point], p: Point) -> Option<usize> {
        let mut reach = self.side;
        let most = self.side * (self.count[0] + self.count[1]) as f64;
        loop {
            let better = |a: (f64, usize), b: (f64, usize)| if b < a { b } else { a };
            let near = self.around(p, reach).map(|i| (distance(points[i], p), i)).reduce(better);
            match near {
                Some((d, i)) if d <= reach || reach > most => return Some(i),
                None if reach > most => return None,
                _ => reach *= 2.0,
            }
        }
    }
}

/// Points of a mesh whose edges are about `edge(x)`, those on the border first; their number.
pub(super) fn mesh_points(
    field: &Field,
    edge: &(impl Fn(Point) -> f64 + Sync),
    iterations: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<Point> {
    let mut points: Vec<Point> = Vec::new();
    let mut buckets = empty_buckets(field, edge);
    for p in border(field).iter().flat_map(|arc| along(arc, edge, rng)) {
        // Two arcs meet at a corner.
        let close = 0.25 * edge(p);
        if buckets.around(p, close).all(|i| distance(points[i], p) > close) {
            buckets.insert(points.len(), p);
            points.push(p);
        }
    }
    let fixed = points.len();
    throw(field, edge, 0.43, &mut points, &mut buckets, rng);
    for _ in 0..iterations {
        lloyd(field, edge, &mut points, fixed);
    }
    points
}

/// Darts at a distance of at least the mean of their `radius`.
pub(super) fn darts(
    field: &Field,
    radius: &impl Fn(Point) -> f64,
    rng: &mut ChaCha8Rng,
) -> Vec<Point> {
    let mut points = Vec::new();
    let mut buckets = empty_buckets(field, radius);
    throw(field, radius, 0.5, &mut points, &mut buckets, rng);
    points
}

fn empty_buckets(field: &Field, length: &impl Fn(Point) -> f64) -> Buckets {
    let (sum, n) = field.cells().fold((0.0, 0), |(s, n), k| (s + length(field.centre(k)), n + 1));
    Buckets::new(&[], field.corner([0, 0]), field.corner(field.count), sum / f64::from(n))
}

/// Offers a random place in every cell, in random order, [`ROUNDS`] times.
fn throw(
    field: &Field,
    length: &impl Fn(Point) -> f64,
    fraction: f64,
    points: &mut Vec<Point>,
    buckets: &mut Buckets,
    rng: &mut ChaCha8Rng,
) {
    let mut cells: Vec<usize> = field.cells().collect();
    let largest = cells.iter().map(|k| length(field.centre(*k))).fold(0.0, f64::max);
    for _ in 0..ROUNDS {
        cells.shuffle(rng);
        for k in &cells {
            let centre = field.centre(*k);
            let p = [0, 1].map(|a| centre[a] + (rng.random::<f64>() - 0.5) * field.side_mm[a]);
            let own = length(p);
            let clear = |i: usize| distance(points[i], p) >= fraction * (own + length(points[i]));
            if buckets.around(p, fraction * (own + largest)).all(clear) {
                buckets.insert(points.len(), p);
                points.push(p);
            }
        }
    }
}

/// Moves every point but the first `fixed` to the centroid of its Voronoi cell.
fn lloyd(field: &Field, edge: &(impl Fn(Point) -> f64 + Sync), points: &mut [Point], fixed: usize) {
    let mut buckets = empty_buckets(field, edge);
    points.iter().enumerate().for_each(|(i, p)| buckets.insert(i, *p));
    let cells: Vec<usize> = field.cells().collect();
    let own = |k: &usize| buckets.nearest(points, field.centre(*k)).expect("there are points");
    let owner: Vec<usize> = cells.par_iter().map(own).collect();
    let mut sum = vec![[0.0; 3]; points.len()];
    for (k, i) in cells.iter().zip(owner) {
        let p = field.centre(*k);
        let weight = edge(p).powi(-4);
        for (s, v) in sum[i].iter_mut().zip([weight * p[0], weight * p[1], weight]) {
            *s += v;
        }
    }
    for (p, [x, y, weight]) in points.iter_mut().zip(sum).skip(fixed) {
        let centroid = [x / weight, y / weight];
        if weight > 0.0 && field.island(centroid).is_some() {
            *p = centroid;
        }
    }
}

/// A stretch of the border between two corners, or a closed one without corners.
struct Arc {
    nodes: Vec<Point>,
    closed: bool,
}

/// Points at equal parts of the integral of ds / l; the end of an open arc begins the next one.
fn along(arc: &Arc, length: &impl Fn(Point) -> f64, rng: &mut ChaCha8Rng) -> Vec<Point> {
    let mut nodes = arc.nodes.clone();
    nodes.extend(arc.closed.then(|| arc.nodes[0]));
    let mut total = vec![0.0];
    for w in nodes.windows(2) {
        let middle = [0, 1].map(|a| 0.5 * (w[0][a] + w[1][a]));
        total.push(total[total.len() - 1] + distance(w[0], w[1]) / length(middle));
    }
    let whole = total[total.len() - 1];
    let (parts, shift) = if arc.closed {
        (whole.round().max(3.0), rng.random::<f64>())
    } else {
        (whole.round().max(1.0), 0.0)
    };
    let at = |k: usize| {
        let target = (k as f64 + shift) * whole / parts;
        let i = total.partition_point(|t| *t <= target).clamp(1, nodes.len() - 1);
        let f = ((target - total[i - 1]) / (total[i] - total[i - 1])).clamp(0.0, 1.0);
        [0, 1].map(|a| nodes[i - 1][a] + f * (nodes[i][a] - nodes[i - 1][a]))
    };
    (0..parts as usize).map(at).collect()
}

/// The border of the region, its inside on the left.
fn border(field: &Field) -> Vec<Arc> {
    loops(field).into_iter().flat_map(|corners| arcs(field, &corners)).collect()
}

/// Closed chains of lattice corners between cells of an island and others.
fn loops(field: &Field) -> Vec<Vec<[usize; 2]>> {
    let [nx, ny] = field.count;
    let inside = |i: isize, j: isize| {
        let within = (0..nx as isize).contains(&i) && (0..ny as isize).contains(&j);
        within && field.island_of_cell(j as usize * nx + i as usize).is_some()
    };
    // From corner (i, j) in direction 0 = +x, 1 = +y, 2 = -x, 3 = -y: cells on the left and right.
    const STEP: [[isize; 2]; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];
    let is_border = |[i, j]: [isize; 2], direction: usize| {
        let (left, right) = match direction {
            0 => ([i, j], [i, j - 1]),
            1 => ([i - 1, j], [i, j]),
            2 => ([i - 1, j - 1], [i - 1, j]),
            _ => ([i, j - 1], [i - 1, j - 1]),
        };
        inside(left[0], left[1]) && !inside(right[0], right[1])
    };
    let mut seen = vec![false; (nx + 1) * (ny + 1)];
    let mut loops = Vec::new();
    for start in 0..seen.len() {
        // Every loop has a step in +x.
        let first = [(start % (nx + 1)) as isize, (start / (nx + 1)) as isize];
        if seen[start] || !is_border(first, 0) {
            continue;
        }
        let (mut at, mut direction) = (first, 0);
        let mut chain = Vec::new();
        loop {
            if direction == 0 {
                seen[at[1] as usize * (nx + 1) + at[0] as usize] = true;
            }
            chain.push(at.map(|v| v as usize));
            at = [at[0] + STEP[direction][0], at[1] + STEP[direction][1]];
            // Left first: cells that touch at a corner only stay apart.
            let turns = [1, 0, 3].map(|t| (direction + t) % 4);
            direction = turns.into_iter().find(|d| is_border(at, *d)).expect("borders close");
            if at == first && direction == 0 {
                break;
            }
        }
        loops.push(chain);
    }
    loops
}

/// Cuts a loop at its corners and smooths the stretches between them.
fn arcs(field: &Field, chain: &[[usize; 2]]) -> Vec<Arc> {
    let n = chain.len();
    let straight = |i: usize| {
        // Whether the border goes straight on at node i.
        let (a, b) = (chain[(i + n - 1) % n], chain[(i + 1) % n]);
        a[0] == b[0] || a[1] == b[1]
    };
    let run = |i: usize, sign: usize| {
        (1..CORNER_CELLS).all(|k| straight((i + if sign == 0 { k } else { n - k }) % n))
    };
    let corners: Vec<usize> = if n > 2 * CORNER_CELLS {
        (0..n).filter(|i| !straight(*i) && run(*i, 0) && run(*i, 1)).collect()
    } else {
        Vec::new()
    };
    let at = |i: usize| field.corner(chain[i % n]);
    let mean = |nodes: &[Point]| {
        let sum = nodes.iter().fold([0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]]);
        sum.map(|v| v / nodes.len() as f64)
    };
    if corners.is_empty() {
        let reach = SMOOTHING_CELLS.min((n - 1) / 4);
        let around = |i: usize| (0..=2 * reach).map(|k| at(i + n + k - reach)).collect::<Vec<_>>();
        return vec![Arc { nodes: (0..n).map(|i| mean(&around(i))).collect(), closed: true }];
    }
    let ends = corners.iter().skip(1).copied().chain([corners[0] + n]);
    let arc = |(&from, to): (&usize, usize)| {
        let nodes: Vec<Point> = (from..=to).map(at).collect();
        let smoothed = (0..nodes.len()).map(|i| {
            let reach = SMOOTHING_CELLS.min(i).min(nodes.len() - 1 - i);
            mean(&nodes[i - reach..=i + reach])
        });
        Arc { nodes: smoothed.collect(), closed: false }
    };
    corners.iter().zip(ends).map(arc).collect()
}
