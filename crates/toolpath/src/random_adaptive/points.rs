//! Points whose distance follows the spacing: on the border of the region, and inside it.
//!
//! Border points are placed at equal parts of the integral of ds / l (l: wanted edge length) along the border of the
//! lattice's cells, smoothed over a pitch between its corners. Inside, random points ("darts") are thrown, which stay
//! if they keep the distance
//!
//! ```text
//! |x - x_i| >= a (l(x) + l(x_i))
//! ```
//!
//! from all others, and moved by Lloyd's iteration to the centroids of their Voronoi cells, weighted by l^-4: in the
//! plane the density of the points follows the square root of the weight.
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
/// Number of times that a random point is tried in every cell. Larger: more time, fewer gaps. Smaller: gaps between the
/// points.
const ROUNDS: usize = 3;

/// Indices of points, sorted into square buckets for the search of neighbours.
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

    /// Returns the side of a bucket, mm.
    pub(super) fn side(&self) -> f64 {
        self.side
    }

    /// Returns the indices of the points in the buckets that meet the square of half-width `reach` about `p`, mm.
    pub(super) fn around(&self, p: Point, reach: f64) -> impl Iterator<Item = usize> + '_ {
        let low = self.place([p[0] - reach, p[1] - reach]);
        let high = self.place([p[0] + reach, p[1] + reach]);
        (low[1]..=high[1]).flat_map(move |y| {
            let row = &self.members[y * self.count[0] + low[0]..=y * self.count[0] + high[0]];
            row.iter().flatten().map(|i| *i as usize)
        })
    }

    /// Returns the index of the point nearest to `p`, the first one if several are equally near; `None` without points.
    pub(super) fn nearest(&self, points: &[Point], p: Point) -> Option<usize> {
        let mut reach = self.side;
        let most = self.side * (self.count[0] + self.count[1]) as f64;
        loop {
            let near = self.around(p, reach).map(|i| (distance(points[i], p), i));
            match near.reduce(|a, b| if b < a { b } else { a }) {
                Some((d, i)) if d <= reach || reach > most => return Some(i),
                None if reach > most => return None,
                _ => reach *= 2.0,
            }
        }
    }
}

/// Returns the points of a mesh whose edges are about `edge(x)` long, mm; those on the border come first. `iterations`
/// is the number of Lloyd's iterations.
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

/// Returns random points in the region. Two points are at least the mean of their two values of `radius` apart, mm.
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

/// Tries a random point in every cell, in random order, [`ROUNDS`] times. It stays if it is at least `fraction` times
/// the sum of both `length` values from the others.
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
            let is_clear = buckets
                .around(p, fraction * (own + largest))
                .all(|i| distance(points[i], p) >= fraction * (own + length(points[i])));
            if is_clear {
                buckets.insert(points.len(), p);
                points.push(p);
            }
        }
    }
}

/// Makes one Lloyd iteration: moves every point but the first `fixed` to the centroid of its Voronoi cell, weighted by
/// the edge length to the power -4. Points whose centroid lies outside the region stay.
fn lloyd(field: &Field, edge: &(impl Fn(Point) -> f64 + Sync), points: &mut [Point], fixed: usize) {
    let mut buckets = empty_buckets(field, edge);
    points.iter().enumerate().for_each(|(i, p)| buckets.insert(i, *p));
    let cells: Vec<usize> = field.cells().collect();
    let owners = cells
        .par_iter()
        .map(|k| buckets.nearest(points, field.centre(*k)).expect("there are points"));
    let owner: Vec<usize> = owners.collect();
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

/// A part of the border between two corners; closed if the border has no corner.
struct Arc {
    nodes: Vec<Point>,
    closed: bool,
}

/// Returns points at equal parts of the integral of ds / l along an arc (l: `length`, mm). The end of an open arc is
/// left out, because the next arc begins there.
fn along(arc: &Arc, length: &impl Fn(Point) -> f64, rng: &mut ChaCha8Rng) -> Vec<Point> {
    let mut nodes = arc.nodes.clone();
    if arc.closed {
        nodes.push(arc.nodes[0]);
    }
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
    let points = (0..parts as usize).map(|k| {
        let target = (k as f64 + shift) * whole / parts;
        let i = total.partition_point(|t| *t <= target).clamp(1, nodes.len() - 1);
        let f = ((target - total[i - 1]) / (total[i] - total[i - 1])).clamp(0.0, 1.0);
        [0, 1].map(|a| nodes[i - 1][a] + f * (nodes[i][a] - nodes[i - 1][a]))
    });
    points.collect()
}

/// Returns the border of the region as arcs, with the region on their left.
fn border(field: &Field) -> Vec<Arc> {
    loops(field).into_iter().flat_map(|corners| arcs(field, &corners)).collect()
}

/// Returns the closed chains of lattice corners (i, j) that separate cells of the region from others.
fn loops(field: &Field) -> Vec<Vec<[usize; 2]>> {
    let [nx, ny] = field.count;
    let mut seen = vec![false; (nx + 1) * (ny + 1)];
    let mut loops = Vec::new();
    for start in 0..seen.len() {
        // Every loop has a step in +x.
        let first = [(start % (nx + 1)) as isize, (start / (nx + 1)) as isize];
        if seen[start] || !is_border(field, first, 0) {
            continue;
        }
        let mut corner = first;
        let mut direction = 0;
        let mut chain = Vec::new();
        loop {
            if direction == 0 {
                seen[corner[1] as usize * (nx + 1) + corner[0] as usize] = true;
            }
            chain.push(corner.map(|v| v as usize));
            corner = [corner[0] + STEP[direction][0], corner[1] + STEP[direction][1]];
            // Left first: cells that touch at a corner only stay apart.
            let turns = [1, 0, 3].map(|t| (direction + t) % 4);
            direction =
                turns.into_iter().find(|d| is_border(field, corner, *d)).expect("borders close");
            if corner == first && direction == 0 {
                break;
            }
        }
        loops.push(chain);
    }
    loops
}

/// Steps from a lattice corner to its neighbour in the directions 0 = +x, 1 = +y, 2 = -x, 3 = -y.
const STEP: [[isize; 2]; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];

/// Returns true if the step from a lattice corner in that direction has a cell of the region on its left and none on
/// its right.
fn is_border(field: &Field, [i, j]: [isize; 2], direction: usize) -> bool {
    let (left, right) = match direction {
        0 => ([i, j], [i, j - 1]),
        1 => ([i - 1, j], [i, j]),
        2 => ([i - 1, j - 1], [i - 1, j]),
        _ => ([i, j - 1], [i - 1, j - 1]),
    };
    is_inside(field, left) && !is_inside(field, right)
}

fn is_inside(field: &Field, [i, j]: [isize; 2]) -> bool {
    let [nx, ny] = field.count;
    let within = (0..nx as isize).contains(&i) && (0..ny as isize).contains(&j);
    within && field.island_of_cell(j as usize * nx + i as usize).is_some()
}

/// Cuts a closed chain at its corners, and smooths the parts between them.
fn arcs(field: &Field, chain: &[[usize; 2]]) -> Vec<Arc> {
    let n = chain.len();
    let nodes: Vec<Point> = chain.iter().map(|corner| field.corner(*corner)).collect();
    let corners: Vec<usize> = (0..n).filter(|i| is_corner(chain, *i)).collect();
    if corners.is_empty() {
        let reach = SMOOTHING_CELLS.min((n - 1) / 4);
        let smoothed = (0..n).map(|i| {
            let around: Vec<Point> =
                (0..=2 * reach).map(|k| nodes[(i + n + k - reach) % n]).collect();
            mean(&around)
        });
        return vec![Arc { nodes: smoothed.collect(), closed: true }];
    }
    let ends = corners.iter().skip(1).copied().chain([corners[0] + n]);
    let arcs = corners.iter().zip(ends).map(|(&from, to)| {
        let nodes: Vec<Point> = (from..=to).map(|i| nodes[i % n]).collect();
        let smoothed = (0..nodes.len()).map(|i| {
            let reach = SMOOTHING_CELLS.min(i).min(nodes.len() - 1 - i);
            mean(&nodes[i - reach..=i + reach])
        });
        Arc { nodes: smoothed.collect(), closed: false }
    });
    arcs.collect()
}

/// Returns true if the border turns at node i, between straight runs of [`CORNER_CELLS`] cells on both sides.
fn is_corner(chain: &[[usize; 2]], i: usize) -> bool {
    let n = chain.len();
    n > 2 * CORNER_CELLS
        && !is_straight(chain, i)
        && (1..CORNER_CELLS).all(|k| is_straight(chain, i + k) && is_straight(chain, i + n - k))
}

/// Returns true if the border goes straight on at node i, counted round the chain.
fn is_straight(chain: &[[usize; 2]], i: usize) -> bool {
    let n = chain.len();
    let [a, b] = [chain[(i + n - 1) % n], chain[(i + 1) % n]];
    a[0] == b[0] || a[1] == b[1]
}

fn mean(nodes: &[Point]) -> Point {
    let sum = nodes.iter().fold([0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]]);
    sum.map(|v| v / nodes.len() as f64)
}
