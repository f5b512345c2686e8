//! Dwell times on the pixels of the map, and from there to the points of a path.
//!
//! ```text
//! removal = R * tau                       tau: seconds per node of the lattice of tool positions   (1)
//! t_j = sum of tau over the nodes whose nearest dwell point is j                          (2)
//! ```
//!
//! The lattice has the pitch of the map and reaches as far as the tool reaches the map. (2) keeps the total time: on a
//! raster, t_j is tau per area times pitch times step. It sums over the nodes around a dwell point. Interpolating tau
//! at the dwell points instead would alias its rough parts (noise, the edge of a margin) into the shape of the part.
//! Details of tau between the lines of the path are lost: the pitch must be fine against the TIF.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, Axis as NdAxis};
use planish_numerics::{
    counting::Grouped,
    fft::{Complex64, convolution::Convolution},
    parallel,
    vectors::vectorised,
};
use planish_types::{Axis, Grid, Invalid, Tif, ToolPath};

/// Removal by a map of dwell times, (1) of the module, with the TIF sampled at the pitch of the map.
pub(crate) struct DwellMap {
    /// Lattice of tool positions.
    pub grid: Grid,
    /// Sum of the samples of the TIF at the pitch of the map, nm/s.
    pub rate_sum: f64,
    convolution: Convolution,
}

impl DwellMap {
    /// Makes the lattice of tool positions for maps on `grid`, and the convolution with the TIF.
    ///
    /// # Errors
    /// Refuses a TIF that varies over the part.
    pub fn new(tif: &Tif, grid: &Grid) -> Result<Self, Invalid> {
        let (kernel, nodes) = lattice(tif, grid)?;
        let convolution = Convolution::new(kernel.view(), nodes.shape());
        Ok(Self { grid: nodes, rate_sum: kernel.sum(), convolution })
    }

    /// Returns the removal, (1) of the module, (ny, nx), nm, for the times on the nodes of the lattice (rows, columns),
    /// s.
    pub fn removal(&self, seconds: ArrayView2<f64>) -> Array2<f64> {
        self.convolution.valid(seconds)
    }

    /// Applies the adjoint of (1) of the module to a map (ny, nx), with `filter` of the spectrum of the TIF in place of
    /// its conjugate. Returns one value per node of the lattice.
    pub fn filtered(
        &self,
        map: &Array2<f64>,
        filter: impl Fn(Complex64) -> Complex64 + Sync,
    ) -> Array2<f64> {
        self.convolution.filtered(map.view(), filter)
    }
}

/// Returns the TIF sampled at the pitch of the map, nm/s, and the lattice of the tool positions from which its samples
/// reach the map.
///
/// # Errors
/// Refuses a TIF that varies over the part.
pub(crate) fn lattice(tif: &Tif, grid: &Grid) -> Result<(Array2<f64>, Grid), Invalid> {
    tif.same_everywhere("a map of dwell times")?;
    let t = tif.grid();
    let [columns, rows] = [samples_at_pitch(&grid.x, &t.x), samples_at_pitch(&grid.y, &t.y)];
    let kernel = Array2::from_shape_fn((rows, columns), |(r, c)| {
        tif.rate_at(sample_mm(&grid.x, &t.x, c), sample_mm(&grid.y, &t.y, r))
    });
    let x = tool_positions(&grid.x, &t.x, columns)?;
    Ok((kernel, Grid { x, y: tool_positions(&grid.y, &t.y, rows)? }))
}

/// Returns the number of samples of the TIF along an axis at the pitch of the map.
fn samples_at_pitch(map: &Axis, tif: &Axis) -> usize {
    // The tolerance of a shared pitch that is rounded differently in the two files.
    ((tif.end_mm() - tif.start_mm()) / map.step_mm() + 1e-4).floor() as usize + 1
}

/// Returns the offset of sample k of the TIF, at the pitch of the map, from the tool, mm.
fn sample_mm(map: &Axis, tif: &Axis, k: usize) -> f64 {
    tif.start_mm() + k as f64 * map.step_mm()
}

/// Returns the tool positions along an axis. At the first one, the last of the `samples` of the TIF lies on the first
/// pixel; at the last one, the first sample lies on the last pixel.
fn tool_positions(map: &Axis, tif: &Axis, samples: usize) -> Result<Axis, Invalid> {
    let start = map.start_mm() - sample_mm(map, tif, samples - 1);
    Axis::new(start, map.step_mm(), map.len() + samples - 1)
}

/// Assignment of the nodes of a lattice of tool positions to the dwell points of a path.
pub(crate) struct NodeOwners {
    grid: Grid,
    points: Buckets,
    /// Index of the nearest dwell point of every node; [`NO_POINT`] if that is farther away than the limit of
    /// [`Self::new`].
    nearest: Array2<u32>,
}

/// Index in place of a dwell point, for a node that has none near enough.
const NO_POINT: u32 = u32::MAX;

/// Number of rows of nodes that one thread takes at a time. Larger: fewer tasks than threads on small maps. Smaller:
/// more overhead.
const NODE_ROWS_PER_TASK: usize = 64;

impl NodeOwners {
    /// Assigns every node of `grid` to the nearest dwell point with the tool on, unless that is too far away. The limit
    /// is twice the median distance of the nodes in the `aperture` from their dwell points; in a cell of a lattice the
    /// corner is 1.8 medians from the middle. `aperture` returns true for a position [x, y], mm, within the aperture,
    /// which may have any shape.
    pub fn new(path: &ToolPath, grid: &Grid, aperture: impl Fn([f64; 2]) -> bool + Sync) -> Self {
        let points: Vec<(u32, [f64; 2])> = (0..path.len())
            .filter(|j| path.tool_on()[*j])
            .map(|j| (j as u32, path.dwell_point_mm()[j]))
            .collect();
        let points = Buckets::new(&points);
        let mut nearest = Array2::from_elem(grid.shape(), NO_POINT);
        let square = |j: u32, p| squared_distance(path.dwell_point_mm()[j as usize], p);
        // Squared distances of the nodes in the aperture.
        let mut inside = vec![Vec::new(); grid.y.len().div_ceil(NODE_ROWS_PER_TASK)];
        let bands = nearest.axis_chunks_iter_mut(NdAxis(0), NODE_ROWS_PER_TASK);
        parallel::consume(bands.zip(&mut inside), &|band, (mut nearest, inside)| {
            let rows = band * NODE_ROWS_PER_TASK..band * NODE_ROWS_PER_TASK + nearest.nrows();
            let nearest = nearest.as_slice_mut().expect("whole rows");
            let mut squares = vec![f64::INFINITY; nearest.len()];
            points.within_a_side(grid, rows.clone(), nearest, &mut squares);
            let width = grid.x.len();
            let lines = nearest.chunks_mut(width).zip(squares.chunks(width));
            for (r, (nearest, squares)) in rows.zip(lines) {
                let mut guess = 0;
                for (c, (n, d)) in nearest.iter_mut().zip(squares).enumerate() {
                    let p = [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)];
                    if !aperture(p) {
                        continue;
                    }
                    if *n != NO_POINT {
                        inside.push(*d as f32);
                        continue;
                    }
                    (guess, (*n, _)) = points.nearest(p, guess, f64::INFINITY);
                    if *n != NO_POINT {
                        inside.push(square(*n, p) as f32);
                    }
                }
            }
        });
        let far = median(&inside).map_or(0.0, |square| 2.0 * f64::from(square).sqrt());
        parallel::consume(nearest.outer_iter_mut(), &|r, mut row| {
            let mut guess = 0;
            for (c, n) in row.iter_mut().enumerate() {
                let p = [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)];
                if *n == NO_POINT && far > points.side {
                    (guess, (*n, _)) = points.nearest(p, guess, far);
                }
                if *n != NO_POINT && square(*n, p) > far * far {
                    *n = NO_POINT;
                }
            }
        });
        Self { grid: *grid, points, nearest }
    }

    /// Returns the mask of the nodes with a dwell point within the limit of [`Self::new`].
    pub fn owned(&self) -> Array2<bool> {
        self.nearest.mapv(|j| j != NO_POINT)
    }

    /// Returns the times of `n` dwell points, s, from those on the nodes, by (2) of the module. The time on a node
    /// beyond the limit of [`Self::new`] goes to the nearest dwell point, too.
    pub fn to_path(&self, seconds: &Array2<f64>, n: usize) -> Vec<f64> {
        // Each row by itself, and neighbours with one dwell point together.
        let of_rows = parallel::map(seconds.nrows(), &|r| {
            let mut sums = Vec::<(u32, f64)>::new();
            let mut guess = 0;
            for (c, (j, tau)) in self.nearest.row(r).iter().zip(seconds.row(r)).enumerate() {
                if *tau == 0.0 {
                    continue;
                }
                let mut j = *j;
                if j == NO_POINT {
                    let p = [self.grid.x.coordinate_mm(c), self.grid.y.coordinate_mm(r)];
                    (guess, (j, _)) = self.points.nearest(p, guess, f64::INFINITY);
                }
                match sums.last_mut() {
                    Some((last, sum)) if *last == j => *sum += tau,
                    _ => sums.push((j, *tau)),
                }
            }
            sums
        });
        let mut t = vec![0.0; n];
        for (j, sum) in of_rows.into_iter().flatten() {
            if let Some(t) = t.get_mut(j as usize) {
                *t += sum;
            }
        }
        t
    }
}

/// Returns the squared distance of two points [x, y], mm^2.
fn squared_distance(q: [f64; 2], p: [f64; 2]) -> f64 {
    (q[0] - p[0]).powi(2) + (q[1] - p[1]).powi(2)
}

/// Returns the median of numbers >= 0, the upper one of two; `None` if there are no numbers.
fn median(parts: &[Vec<f32>]) -> Option<f32> {
    let mut counts = vec![0; 1 << 15];
    parts.iter().flatten().for_each(|v| counts[upper_bits(*v)] += 1);
    let mut rank = counts.iter().sum::<usize>() / 2;
    let shared = counts.iter().position(|count| match rank.checked_sub(*count) {
        Some(rest) => {
            rank = rest;
            false
        }
        None => true,
    })?;
    let of_shared = parts.iter().flatten().copied().filter(|v| upper_bits(*v) == shared);
    let mut near: Vec<f32> = of_shared.collect();
    Some(*near.select_nth_unstable_by(rank, f32::total_cmp).1)
}

/// Returns the upper half of the bits of a number >= 0. It grows with the number, so the median is among the numbers
/// that share it.
fn upper_bits(v: f32) -> usize {
    (v.to_bits() >> 16) as usize
}

/// Nodes of a lattice that belong to a dwell point but are no unknowns. Each gets the time of the nearest unknown
/// (active node).
pub(crate) struct Spread {
    /// Pairs of a node and the unknown whose time it gets, both by index in the lattice, row by row.
    ties: Vec<(u32, u32)>,
}

impl Spread {
    /// Finds the nearest active node for the nodes that belong to a dwell point (`owned`, (rows, columns)) but are not
    /// `active` (row by row). The path to it goes over owned nodes; its length is the number of steps, each to one of
    /// the eight neighbours.
    pub fn new(owned: &Array2<bool>, active: &[bool]) -> Self {
        let (ny, nx) = owned.dim();
        let mut source: Vec<u32> = vec![NO_POINT; active.len()];
        let mut front: Vec<u32> = Vec::new();
        for (k, active) in active.iter().enumerate() {
            if *active {
                source[k] = k as u32;
                front.push(k as u32);
            }
        }
        let mut ties = Vec::new();
        while !front.is_empty() {
            let mut next = Vec::new();
            for k in front {
                let (r, c) = (k as usize / nx, k as usize % nx);
                for row in r.saturating_sub(1)..(r + 2).min(ny) {
                    for column in c.saturating_sub(1)..(c + 2).min(nx) {
                        let to = row * nx + column;
                        if source[to] == NO_POINT && owned[[row, column]] {
                            source[to] = source[k as usize];
                            ties.push((to as u32, source[to]));
                            next.push(to as u32);
                        }
                    }
                }
            }
            front = next;
        }
        Self { ties }
    }

    /// Sets the times of these nodes, in t (row by row), to those of their unknowns.
    pub fn apply(&self, t: &mut [f64]) {
        for (node, source) in &self.ties {
            t[*node as usize] = t[*source as usize];
        }
    }

    /// Applies the adjoint of [`Self::apply`] to s (row by row): adds the element of every such node to that of the
    /// unknown whose time it gets.
    pub fn gather(&self, s: &mut [f64]) {
        for (node, source) in &self.ties {
            s[*source as usize] += s[*node as usize];
        }
    }
}

/// Points sorted into squares, for a quick search of the nearest point.
struct Buckets {
    start: [f64; 2],
    side: f64,
    shape: [usize; 2],
    /// Points grouped by the square that contains them.
    grouped: Grouped,
    /// Index and position of the points, mm [x, y], in the order of `grouped`.
    points: Vec<(u32, [f64; 2])>,
}

impl Buckets {
    fn new(points: &[(u32, [f64; 2])]) -> Self {
        let [x, y] = [0, 1].map(|axis| {
            let ends = points.iter().map(|(_, p)| p[axis]);
            ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
        });
        // About one point in each square; a line of points has no area.
        let [width, height] = [x, y].map(|(low, high)| (high - low).max(0.0));
        let n = points.len().max(1) as f64;
        let side = (width * height / n).sqrt().max((width + height) / n).max(1e-9);
        let shape = [width, height].map(|w| (w / side) as usize + 1);
        let start = [x.0, y.0];
        let squares = points.iter().map(|(_, p)| {
            let [bx, by] = [0, 1].map(|a| (((p[a] - start[a]) / side) as usize).min(shape[a] - 1));
            Some(by * shape[0] + bx)
        });
        let grouped = Grouped::new(shape[0] * shape[1], squares);
        let points = grouped.items().iter().map(|i| points[*i as usize]).collect();
        Self { start, side, shape, grouped, points }
    }

    /// Writes the number of the nearest point to `nearest`, and its squared distance to `squares`, for every node of
    /// the rows `rows` that has a point within the side of a square. Others stay as they are. Of equal distances the
    /// lowest number counts. In a lattice of square cells every node has a point within 0.71 sides.
    fn within_a_side(
        &self,
        grid: &Grid,
        rows: Range<usize>,
        nearest: &mut [u32],
        squares: &mut [f64],
    ) {
        let reach = self.side;
        let Grid { x, y } = grid;
        let [low, high] = [(rows.start, -1.0), (rows.end - 1, 1.0)].map(|(r, side)| {
            let by = (y.coordinate_mm(r) + side * 1.001 * reach - self.start[1]) / self.side;
            (by.max(-1.0) as isize).clamp(-1, self.shape[1] as isize)
        });
        let lines = low.max(0) as usize..((high + 1).max(0) as usize).min(self.shape[1]);
        let [from, to] = [lines.start, lines.end.max(lines.start)].map(|by| by * self.shape[0]);
        let points = &self.points[self.grouped.first(from)..self.grouped.first(to)];
        vectorised(
            #[inline(always)]
            || {
                for (j, p) in points {
                    let near = nodes_within(y, p[1], reach);
                    for r in near.start.max(rows.start)..near.end.min(rows.end) {
                        let dy = y.coordinate_mm(r) - p[1];
                        let columns =
                            nodes_within(x, p[0], (reach * reach - dy * dy).max(0.0).sqrt());
                        let first = (r - rows.start) * x.len();
                        let line = first + columns.start..first + columns.end;
                        let on_line = nearest[line.clone()].iter_mut().zip(&mut squares[line]);
                        for ((n, d), c) in on_line.zip(columns) {
                            let dx = x.coordinate_mm(c) - p[0];
                            let square = dx * dx + dy * dy;
                            let nearer = square < *d || square == *d && *j < *n;
                            *n = if nearer { *j } else { *n };
                            *d = if nearer { square } else { *d };
                        }
                    }
                }
            },
        );
    }

    /// Returns the point nearest to p, mm: its index in `points` (for the next guess), its number, and its distance; of
    /// equal distances, the lowest number. The closer `points[guess]` is to p, the quicker the search. If the nearest
    /// point is farther than `reach`, another one may be returned; without points, [`NO_POINT`].
    fn nearest(&self, p: [f64; 2], guess: usize, reach: f64) -> (usize, (u32, f64)) {
        let own = [0, 1].map(|a| {
            let b = ((p[a] - self.start[a]) / self.side).floor();
            b.clamp(-1e9, 1e9) as isize
        });
        let Some((j, q)) = self.points.get(guess) else { return (0, (NO_POINT, f64::INFINITY)) };
        let best = (*j, (q[0] - p[0]).hypot(q[1] - p[1]));
        let mut search = NearestSearch {
            buckets: self,
            p,
            place: guess,
            best,
            above: rounded_up_square(best.1),
        };
        // Rings of squares: the first that can hold a point, and the last.
        let shape = self.shape.map(|n| n as isize);
        let gap = [0, 1].map(|a| (-own[a]).max(own[a] - shape[a] + 1).max(0));
        let span = [0, 1].map(|a| own[a].abs().max((shape[a] - 1 - own[a]).abs()));
        for ring in gap[0].max(gap[1])..=span[0].max(span[1]) {
            // All points of this ring are at least ring - 1 sides away.
            if search.best.1.min(reach) <= (ring - 1) as f64 * self.side {
                break;
            }
            for by in [own[1] - ring, own[1] + ring] {
                for bx in (own[0] - ring).max(0)..=(own[0] + ring).min(shape[0] - 1) {
                    search.look_into([bx, by]);
                }
                if ring == 0 {
                    break;
                }
            }
            for bx in [own[0] - ring, own[0] + ring] {
                for by in (own[1] - ring + 1).max(0)..(own[1] + ring).min(shape[1]) {
                    search.look_into([bx, by]);
                }
            }
        }
        (search.place, search.best)
    }
}

/// Returns the range of the nodes of an axis within `distance` of the coordinate p, mm.
#[inline(always)]
fn nodes_within(axis: &Axis, p: f64, distance: f64) -> Range<usize> {
    let low = (p - distance - axis.start_mm()) / axis.step_mm();
    let high = (p + distance - axis.start_mm()) / axis.step_mm();
    let from = low.ceil().max(0.0) as usize;
    let to = ((high.floor() + 1.0).max(0.0) as usize).min(axis.len());
    from.min(to)..to
}

/// Returns the square of a distance, raised by 1e-6 of it, so that rounding does not exclude a point at this distance.
fn rounded_up_square(distance: f64) -> f64 {
    1.000_001 * distance * distance
}

/// State of the search for the point nearest to `p`, mm.
struct NearestSearch<'a> {
    buckets: &'a Buckets,
    p: [f64; 2],
    /// Index in `points` of the best point so far.
    place: usize,
    best: (u32, f64),
    /// Squared distance above which a point is not better than the best one.
    above: f64,
}

impl NearestSearch<'_> {
    /// Looks for a better point in a square, given by its indices [x, y], which may lie outside of all squares.
    #[inline]
    fn look_into(&mut self, square: [isize; 2]) {
        let Self { buckets: Buckets { start, side, shape, grouped, points }, p, .. } = *self;
        if [0, 1].iter().any(|a| square[*a] < 0 || square[*a] >= shape[*a] as isize) {
            return;
        }
        let [x, y] = [0, 1].map(|a| {
            let low = start[a] + square[a] as f64 * side - p[a];
            low.max(-low - side).max(0.0)
        });
        if x * x + y * y > self.above {
            return;
        }
        let index = square[1] as usize * shape[0] + square[0] as usize;
        for k in grouped.first(index)..grouped.first(index + 1) {
            let (j, q) = points[k];
            let [x, y] = [q[0] - p[0], q[1] - p[1]];
            if x * x + y * y > self.above {
                continue;
            }
            let d = x.hypot(y);
            if d < self.best.1 || d == self.best.1 && j < self.best.0 {
                self.place = k;
                self.best = (j, d);
                self.above = rounded_up_square(d);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn axis(start: f64, step: f64, n: usize) -> Axis {
        Axis::new(start, step, n).unwrap()
    }

    #[test]
    fn one_node_gives_the_tif_where_it_stands() {
        // Not symmetric, and off the pixels: samples from -0.35 to 0.65 mm.
        let t = Grid { x: axis(-0.35, 0.1, 11), y: axis(-0.2, 0.1, 6) };
        let tif =
            Tif::new(t, Array2::from_shape_fn(t.shape(), |(r, c)| 1.0 + r as f64 + 0.3 * c as f64))
                .unwrap();
        let grid = Grid { x: axis(1.0, 0.1, 40), y: axis(2.0, 0.1, 30) };
        let map = DwellMap::new(&tif, &grid).unwrap();
        let mut seconds = Array2::zeros(map.grid.shape());
        seconds[[12, 17]] = 2.0;
        let tool = [map.grid.x.coordinate_mm(17), map.grid.y.coordinate_mm(12)];
        let found = map.removal(seconds.view());
        for ((r, c), z) in found.indexed_iter() {
            let expected = 2.0
                * tif.rate_at(grid.x.coordinate_mm(c) - tool[0], grid.y.coordinate_mm(r) - tool[1]);
            // Rounding of an FFT; at the border of the TIF a pixel is in or out by rounding too.
            assert!((z - expected).abs() < 1e-12, "{r} {c}: {z} {expected}");
        }
    }

    #[test]
    fn the_nearest_point_is_found() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let random =
            |rng: &mut ChaCha8Rng| [rng.random_range(0.0..9.0), rng.random_range(0.0..2.0)];
        let points: Vec<(u32, [f64; 2])> = (0..70).map(|j| (j, random(&mut rng))).collect();
        for points in [&points[..], &points[..1]] {
            let buckets = Buckets::new(points);
            for k in 0..500 {
                let p = [rng.random_range(-9.0..18.0), rng.random_range(-9.0..9.0)];
                let d = |q: &[f64; 2]| (q[0] - p[0]).hypot(q[1] - p[1]);
                let best = points.iter().map(|(_, q)| d(q)).fold(f64::INFINITY, f64::min);
                let (place, (j, d)) = buckets.nearest(p, k % points.len(), f64::INFINITY);
                assert_eq!(d, best);
                assert_eq!(points[j as usize], buckets.points[place]);
            }
        }
    }

    #[test]
    fn a_node_belongs_to_the_nearest_point_that_is_near_enough() {
        let grid = Grid { x: axis(-3.0, 0.2, 81), y: axis(-1.0, 0.13, 61) };
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        // All over the map and beyond; in one corner of it, with all nodes far away; a single one.
        for (n, from, to) in [(300, -8.0, 20.0), (60, 0.0, 0.5), (1, 0.0, 12.0)] {
            let points: Vec<[f64; 2]> = (0..=n)
                .map(|_| [rng.random_range(from..to), 0.5 * rng.random_range(from..to)])
                .collect();
            let on: Vec<bool> = (0..n).map(|j| j % 7 != 1).collect();
            let path = ToolPath::new(points.clone(), points[..n].to_vec(), on.clone(), vec![0; n])
                .unwrap();
            let inside = |p: [f64; 2]| (p[0] - 5.0).hypot(p[1] - 3.0) < 3.5;
            let cells = NodeOwners::new(&path, &grid, inside);
            let at = |(r, c): (usize, usize)| [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)];
            let nearest = |p: [f64; 2]| {
                let with = (0..n).filter(|j| on[*j]);
                with.map(|j| ((points[j][0] - p[0]).hypot(points[j][1] - p[1]), j))
                    .min_by(|a, b| a.0.total_cmp(&b.0))
                    .unwrap()
            };
            let nodes = || ndarray::indices(grid.shape()).into_iter();
            let mut medians: Vec<f64> =
                nodes().map(at).filter(|p| inside(*p)).map(|p| nearest(p).0).collect();
            medians.sort_by(f64::total_cmp);
            let far = 2.0 * medians[medians.len() / 2];
            let mut owned = 0;
            for node in nodes() {
                let (distance, j) = nearest(at(node));
                owned += usize::from(distance <= far);
                // The median is that of single precision.
                if (distance / far - 1.0).abs() > 1e-6 {
                    assert_eq!(cells.owned()[node], distance <= far, "{node:?}");
                }
                let mut seconds = Array2::zeros(grid.shape());
                seconds[node] = 1.0;
                // Wherever it is: the time is not lost.
                assert_eq!(cells.to_path(&seconds, n)[j], 1.0, "{node:?}");
            }
            assert!(owned > 0 && (n == 1 || owned < grid.shape().0 * grid.shape().1), "{owned}");
        }
    }

    #[test]
    fn the_median_is_that_of_a_sorted_list() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for n in [1, 2, 3, 10, 999, 5000] {
            let parts: Vec<Vec<f32>> = (0..n)
                .map(|_| rng.random_range(0.0..2.0_f32).powi(8))
                .collect::<Vec<_>>()
                .chunks(700)
                .map(<[f32]>::to_vec)
                .collect();
            let mut sorted = parts.concat();
            sorted.sort_by(f32::total_cmp);
            assert_eq!(median(&parts), Some(sorted[n / 2]), "{n}");
        }
        assert_eq!(median(&[Vec::new()]), None);
        assert_eq!(median(&[vec![0.0; 4]]), Some(0.0));
    }

    #[test]
    fn a_raster_gets_pitch_times_step_times_the_density() {
        let grid = Grid { x: axis(-3.0, 0.1, 161), y: axis(-3.0, 0.1, 121) };
        let points: Vec<[f64; 2]> = (0..7)
            .flat_map(|j| {
                (0..11).map(move |i| [f64::from(if j % 2 == 0 { i } else { 10 - i }), f64::from(j)])
            })
            .collect();
        let n = points.len();
        let mut ends = points.clone();
        ends.push(points[n - 1]);
        let path = ToolPath::new(ends, points, vec![true; n], vec![0; n]).unwrap();
        let inside = |p: [f64; 2]| p[0] > 0.0 && p[0] < 10.0 && p[1] > 0.0 && p[1] < 6.0;
        let cells = NodeOwners::new(&path, &grid, inside);
        // 2 + 0.1 x seconds per mm^2, 100 nodes per mm^2.
        let density = |x: f64| 2.0 + 0.1 * x;
        let seconds =
            Array2::from_shape_fn(grid.shape(), |(_, c)| 0.01 * density(grid.x.coordinate_mm(c)));
        let t = cells.to_path(&seconds, n);
        // Rounding of a sum of 2e4 times, 400 s in all.
        assert!((t.iter().sum::<f64>() - seconds.sum()).abs() < 1e-9, "the total time is kept");
        let far = cells.owned().iter().filter(|owned| !**owned).count();
        assert!(far > 0 && far < seconds.len());
        for (t, p) in t.iter().zip(path.dwell_point_mm()) {
            if inside(*p) {
                // Nodes on the border of two cells fall to one of them: up to 10 in 100.
                assert!((t / density(p[0]) - 1.0).abs() < 0.11, "{p:?}: {t}");
            }
        }
    }
}
