//! The bound in fewer unknowns: residuals that differ from the desired removal by cubic B-splines.
//!
//! ```text
//! e = z - S a,   S_j = cubic B-spline j on the valid pixels, of norm 1                              (1)
//! G = S'S,   V = S'K at the constraints,   u = S'1,   q_z = K'z at the constraints                 (2)
//! ```
//!
//! The constraints are places of the tool at which `K'e` is bounded. Removal is smooth: splines a fraction of the
//! flanks of the tool apart represent it nearly. What they miss makes the bound smaller, never wrong.

use std::ops::Range;

use ndarray::{Array1, Array2, ArrayView2, Axis, s};
use planish_numerics::{
    linear::skyline::{Skyline, axpy, dot},
    parallel,
    vectors::vectorised,
};

use super::tool::{LatticeTool, PartPixels, Place, Window, product, squares};

/// Largest work of a step (number of splines times the square of the band of their matrix). Above it, the splines are
/// farther apart than the flanks ask for. Larger: more time for large parts. Smaller: a smaller bound there.
const MOST_WORK: f64 = 5.5e8;

/// Square of the norm of a spline on the valid pixels, relative to the largest, below which it is not used. Larger:
/// the rim is represented less. Smaller: the matrices are closer to singular.
const LEAST_ENERGY: f64 = 1e-3;

/// Number added to the diagonal of G, whose elements there are 1. Larger: a smaller bound. Smaller: splines that depend
/// on each other on the valid pixels make the matrices singular.
const DAMPING: f64 = 1e-9;

/// The splines of (1) of the module. Spline (i, j) has the number `i * across + j`, where j counts along the shorter
/// side of the map.
#[derive(Clone)]
pub struct Splines {
    /// The splines along [x, y].
    along: [Vec<Piece>; 2],
    /// True if j counts along y.
    is_y_across: bool,
    /// 1 over the norm of every spline; 0 if it is not used.
    scale: Vec<f64>,
    /// Map beside the splines (ny, nx), of norm 1 and 0 on the invalid pixels.
    other: Option<Array2<f64>>,
    /// G, damped.
    pub gram: Skyline,
    /// u.
    pub sums: Vec<f64>,
    /// S'z, nm.
    pub along_desired: Vec<f64>,
}

/// The matrices of (2) of the module at some constraints.
#[derive(Clone)]
pub struct Constraints {
    /// The number of splines.
    splines: usize,
    /// The places.
    pub places: Vec<Place>,
    /// Columns of V, nm/s: for every constraint its splines in runs of neighbouring numbers.
    columns: Vec<Vec<Run>>,
    /// Rows of V: for [`SPLINES_TOGETHER`] neighbouring splines the constraints that any of them has, with the elements.
    rows: Vec<Vec<(usize, [f64; SPLINES_TOGETHER])>>,
    /// q_z.
    pub desired: Array1<f64>,
}

/// Splines whose rows of (G + V D V') are summed together, so that a column of V is read once for all of them. Larger:
/// the rows leave the cache. Smaller: every column is read more often.
const SPLINES_TOGETHER: usize = 8;

/// Values on neighbouring pixels of one axis.
#[derive(Clone)]
struct Piece {
    /// First pixel.
    first: usize,
    values: Vec<f64>,
}

/// Values on a rectangle of pixels.
struct Patch {
    /// First pixel (row, column).
    origin: (usize, usize),
    values: Array2<f64>,
}

/// Elements of a column for neighbouring splines.
#[derive(Clone)]
struct Run {
    first: usize,
    values: Vec<f64>,
}

impl Splines {
    /// Makes splines for a part and a tool, at distances of `pitch` times the flanks of the tool, or farther apart if
    /// that is too much work.
    pub fn new(part: &PartPixels, tool: &LatticeTool, pitch: f64) -> Self {
        let (ny, nx) = part.desired_nm.dim();
        let reach = [tool.samples().ncols(), tool.samples().nrows()];
        let reach = [0, 1].map(|axis| reach[axis] as f64 / tool.parts[axis] as f64);
        let mut pitch = tool.flanks.map(|flank| (pitch * flank).max(1.0));
        if work([nx, ny], reach, [1.0; 2]) <= MOST_WORK {
            pitch = [1.0; 2];
        }
        while work([nx, ny], reach, pitch) > MOST_WORK {
            pitch = pitch.map(|pitch| 1.05 * pitch);
        }
        let along = [along(nx, pitch[0]), along(ny, pitch[1])];
        let is_y_across = along[1].len() <= along[0].len();
        // Two splines have a constraint in common if they are nearer than this.
        let spans = [0, 1].map(|axis| (reach[axis] / pitch[axis]).ceil() as usize + 4);
        let mut splines = Self {
            scale: vec![1.0; along[0].len() * along[1].len()],
            along,
            is_y_across,
            other: None,
            gram: Skyline::zeros(Vec::new()),
            sums: Vec::new(),
            along_desired: Vec::new(),
        };
        let maps: Vec<Patch> = (0..splines.scale.len()).map(|k| splines.on_map(k, part)).collect();
        let energies: Vec<f64> = maps.iter().map(|map| map.product(map)).collect();
        let least = LEAST_ENERGY * energies.iter().copied().fold(0.0, f64::max);
        let scale = energies.iter().map(|e| if *e > least { e.sqrt().recip() } else { 0.0 });
        splines.scale = scale.collect();
        let scaled = || maps.iter().zip(&splines.scale);
        splines.sums = scaled().map(|(map, scale)| scale * map.values.sum()).collect();
        splines.along_desired = scaled()
            .map(|(map, scale)| scale * (&map.values * &map.under(&part.desired_nm)).sum())
            .collect();
        splines.gram = splines.products(&maps, spans);
        splines
    }

    /// Returns these splines, which have no map beside them, and a map (ny, nx) that is 0 on the invalid pixels.
    pub fn with(&self, mut map: Array2<f64>, part: &PartPixels) -> Self {
        map /= squares(&map).sqrt();
        let n = self.sums.len();
        let mut row: Vec<f64> = (0..n)
            .map(|k| {
                let spline = self.on_map(k, part);
                self.scale[k] * (&spline.values * &spline.under(&map)).sum()
            })
            .collect();
        row.push(1.0 + DAMPING);
        let first = (0..n).map(|k| self.gram.first(k)).chain([0]);
        let mut gram = Skyline::zeros(first.collect());
        gram.fill(|k, to| to.copy_from_slice(if k < n { self.gram.row(k) } else { &row }));
        let mut more = Self { gram, ..self.clone() };
        more.sums.push(map.sum());
        more.along_desired.push(product(&map, &part.desired_nm));
        more.other = Some(map);
        more
    }

    /// Returns true if every map is a sum of these splines.
    pub fn are_pixels(&self) -> bool {
        self.along.iter().flatten().all(|piece| piece.values.len() == 1)
    }

    /// Returns G, with 1 on the diagonal for splines that are not used.
    fn products(&self, maps: &[Patch], spans: [usize; 2]) -> Skyline {
        let across = self.across();
        let [span_along, span_across] = if self.is_y_across { spans } else { [spans[1], spans[0]] };
        let first: Vec<usize> = (0..maps.len())
            .map(|k| {
                let [i, j] = [k / across, k % across];
                i.saturating_sub(span_along) * across + j.saturating_sub(span_across)
            })
            .collect();
        let mut gram = Skyline::zeros(first.clone());
        gram.fill(|k, row| {
            for (v, l) in row.iter_mut().zip(first[k]..) {
                let scale = self.scale[k] * self.scale[l];
                *v = if scale > 0.0 { scale * maps[k].product(&maps[l]) } else { 0.0 };
            }
            let diagonal = row.len() - 1;
            row[diagonal] = if self.scale[k] == 0.0 { 1.0 } else { row[diagonal] + DAMPING };
        });
        gram
    }

    /// Returns the number of splines along the shorter side.
    fn across(&self) -> usize {
        self.along[usize::from(self.is_y_across)].len()
    }

    /// Returns the numbers [along x, along y] of spline k.
    fn indices(&self, k: usize) -> [usize; 2] {
        let [i, j] = [k / self.across(), k % self.across()];
        if self.is_y_across { [i, j] } else { [j, i] }
    }

    /// Returns spline k on the valid pixels, without its scale.
    fn on_map(&self, k: usize, part: &PartPixels) -> Patch {
        let [i, j] = self.indices(k);
        let [x, y] = [&self.along[0][i], &self.along[1][j]];
        let values = Array2::from_shape_fn((y.values.len(), x.values.len()), |(r, c)| {
            y.values[r] * x.values[c] * part.valid[[y.first + r, x.first + c]]
        });
        Patch { origin: (y.first, x.first), values }
    }

    /// Returns `S a` on the valid pixels (ny, nx).
    pub fn map(&self, a: &[f64], part: &PartPixels) -> Array2<f64> {
        let mut map = Array2::zeros(part.desired_nm.dim());
        for (k, a) in a.iter().take(self.scale.len()).enumerate() {
            let Patch { origin: (r, c), values } = self.on_map(k, part);
            let (ny, nx) = values.dim();
            map.slice_mut(s![r..r + ny, c..c + nx]).scaled_add(a * self.scale[k], &values);
        }
        if let Some(other) = &self.other {
            map.scaled_add(a[self.scale.len()], other);
        }
        map
    }

    /// Returns the matrices without any constraint.
    pub fn unconstrained(&self) -> Constraints {
        Constraints {
            splines: self.sums.len(),
            places: Vec::new(),
            columns: Vec::new(),
            rows: vec![Vec::new(); self.sums.len().div_ceil(SPLINES_TOGETHER)],
            desired: Array1::zeros(0),
        }
    }

    /// Returns the column of V for a place of the tool: the tool on the valid pixels, times the splines along x, then
    /// along y.
    fn column(&self, place: Place, part: &PartPixels, tool: &LatticeTool) -> Vec<Run> {
        let Window { origin: (top, left), rates } = tool.window_at(place, part);
        let (ny, nx) = rates.dim();
        let x = touched(&self.along[0], left, nx);
        let y = touched(&self.along[1], top, ny);
        let mut by_rows = Array2::zeros((x.len(), ny));
        for ((i, r), v) in by_rows.indexed_iter_mut() {
            let row = rates.row(r).to_slice().expect("in C order");
            *v = self.along[0][x.start + i].product(row, left);
        }
        let elements = Array2::from_shape_fn((x.len(), y.len()), |(i, j)| {
            let rows = by_rows.row(i).to_slice().expect("in C order");
            self.along[1][y.start + j].product(rows, top)
        });
        let (runs, first) = if self.is_y_across {
            (elements.axis_iter(Axis(0)), (x.start, y.start))
        } else {
            (elements.axis_iter(Axis(1)), (y.start, x.start))
        };
        let mut runs: Vec<Run> = (runs.enumerate())
            .map(|(i, elements)| {
                let first = (first.0 + i) * self.across() + first.1;
                let scaled = elements.iter().zip(&self.scale[first..]).map(|(v, scale)| v * scale);
                Run { first, values: scaled.collect() }
            })
            .collect();
        if let Some(other) = &self.other {
            let under = other.slice(s![top..top + ny, left..left + nx]);
            runs.push(Run { first: self.scale.len(), values: vec![(&rates * &under).sum()] });
        }
        runs
    }
}

impl Piece {
    /// Returns the sum of the products with numbers on the pixels from `start` on.
    fn product(&self, numbers: &[f64], start: usize) -> f64 {
        let from = self.first.max(start);
        let to = (self.first + self.values.len()).min(start + numbers.len());
        dot(&numbers[from - start..to - start], &self.values[from - self.first..to - self.first])
    }
}

/// Returns the pieces that have one of the `count` pixels from `start` on.
fn touched(pieces: &[Piece], start: usize, count: usize) -> Range<usize> {
    let first = pieces.partition_point(|piece| piece.first + piece.values.len() <= start);
    let end = pieces.partition_point(|piece| piece.first < start + count);
    first..end.max(first)
}

impl Patch {
    /// Returns the part of `map` under this patch.
    fn under<'a>(&self, map: &'a Array2<f64>) -> ArrayView2<'a, f64> {
        let ((r, c), (ny, nx)) = (self.origin, self.values.dim());
        map.slice(s![r..r + ny, c..c + nx])
    }

    /// Returns the sum of the products with another patch.
    fn product(&self, other: &Self) -> f64 {
        let [rows, columns] = [self.rows(), self.columns()];
        let [other_rows, other_columns] = [other.rows(), other.columns()];
        let left = columns.start.max(other_columns.start);
        let right = columns.end.min(other_columns.end);
        if left >= right {
            return 0.0;
        }
        let mut sum = 0.0;
        for row in rows.start.max(other_rows.start)..rows.end.min(other_rows.end) {
            sum += dot(self.part_of_row(row, left..right), other.part_of_row(row, left..right));
        }
        sum
    }

    fn rows(&self) -> Range<usize> {
        self.origin.0..self.origin.0 + self.values.nrows()
    }

    fn columns(&self) -> Range<usize> {
        self.origin.1..self.origin.1 + self.values.ncols()
    }

    /// Returns the values on these columns of a row of the map.
    fn part_of_row(&self, row: usize, columns: Range<usize>) -> &[f64] {
        let all = self.values.as_slice().expect("in C order");
        let start = (row - self.origin.0) * self.values.ncols();
        &all[start + columns.start - self.origin.1..start + columns.end - self.origin.1]
    }
}

impl Constraints {
    /// Adds constraints at these places. `desired` is K'z at all places, for every limit of the tool.
    pub fn add(
        &mut self,
        places: &[Place],
        splines: &Splines,
        (part, tool): (&PartPixels, &LatticeTool),
        desired: &[Array2<f64>],
    ) {
        let columns = parallel::map(places.len(), &|k| splines.column(places[k], part, tool));
        for (place, runs) in places.iter().zip(columns) {
            self.push(*place, runs);
        }
        let more = places.iter().map(|place| desired[place.limit][place.index]);
        self.desired = self.desired.iter().copied().chain(more).collect();
    }

    /// Adds a constraint with its column of V, and without its element of q_z.
    fn push(&mut self, place: Place, runs: Vec<Run>) {
        let k = self.columns.len();
        for run in &runs {
            for (l, v) in (run.first..).zip(&run.values).filter(|(_, v)| **v != 0.0) {
                let rows = &mut self.rows[l / SPLINES_TOGETHER];
                if rows.last().is_none_or(|(last, _)| *last != k) {
                    rows.push((k, [0.0; SPLINES_TOGETHER]));
                }
                rows.last_mut().expect("a constraint").1[l % SPLINES_TOGETHER] = *v;
            }
        }
        self.columns.push(runs);
        self.places.push(place);
    }

    /// Returns the constraints with these multipliers, s, that are at least `part` of the mean one.
    pub fn used(&self, dwell_s: &Array1<f64>, part: f64) -> Self {
        let least_s = part * dwell_s.sum() / dwell_s.len() as f64;
        let kept: Vec<usize> = (0..dwell_s.len()).filter(|k| dwell_s[*k] >= least_s).collect();
        let mut used = Self {
            splines: self.splines,
            places: Vec::new(),
            columns: Vec::new(),
            rows: vec![Vec::new(); self.rows.len()],
            desired: self.desired.select(Axis(0), &kept),
        };
        for k in kept {
            used.push(self.places[k], self.columns[k].clone());
        }
        used
    }

    /// Returns `V'a` at the constraints.
    pub fn at_places(&self, a: &[f64]) -> Array1<f64> {
        Array1::from_vec(parallel::map(self.columns.len(), &|k| {
            let runs = self.columns[k].iter();
            runs.map(|run| dot(&run.values, &a[run.first..run.first + run.values.len()])).sum()
        }))
    }

    /// Returns `V m` for numbers m at the constraints.
    pub fn along(&self, m: &Array1<f64>) -> Vec<f64> {
        let sums = parallel::map(self.rows.len(), &|rows| {
            let mut sums = [0.0; SPLINES_TOGETHER];
            for (k, elements) in &self.rows[rows] {
                axpy(m[*k], elements, &mut sums);
            }
            sums
        });
        sums.into_iter().flatten().take(self.splines).collect()
    }

    /// Returns `G + V D V'`, with the diagonal D at the constraints.
    pub fn normal(&self, gram: &Skyline, d: &Array1<f64>) -> Skyline {
        let mut normal = gram.clone();
        let first: Vec<usize> = (0..normal.len()).map(|l| normal.first(l)).collect();
        normal.fill_together(SPLINES_TOGETHER, |splines, rows| {
            vectorised(
                #[inline(always)]
                || {
                    for (k, elements) in &self.rows[splines.start / SPLINES_TOGETHER] {
                        for ((l, row), v) in splines.clone().zip(rows.iter_mut()).zip(elements) {
                            add_up_to(l, d[*k] * v, &self.columns[*k], &mut row[..], first[l]);
                        }
                    }
                },
            );
        });
        normal
    }
}

/// Adds `factor` times the elements of a column up to spline l to a row, which begins with spline `start`.
#[inline(always)]
fn add_up_to(l: usize, factor: f64, column: &[Run], row: &mut [f64], start: usize) {
    if factor == 0.0 {
        return;
    }
    for run in column {
        if run.first > l {
            return;
        }
        let count = run.values.len().min(l + 1 - run.first);
        axpy(factor, &run.values[..count], &mut row[run.first - start..][..count]);
    }
}

/// Returns the work of a step for splines at distances of `pitch` pixels on a map of [nx, ny] pixels, with a tool that
/// reaches over `reach` pixels.
fn work(pixels: [usize; 2], reach: [f64; 2], pitch: [f64; 2]) -> f64 {
    let [x, y] = [0, 1].map(|axis| {
        let count = pixels[axis] as f64 / pitch[axis] + 3.0;
        (count, (reach[axis] / pitch[axis] + 4.0).min(count))
    });
    let band = (x.1 * y.0).min(y.1 * x.0);
    x.0 * y.0 * band * band
}

/// Returns the cubic B-splines at distances of `pitch` pixels on `n` pixels; the pixels themselves if there are not
/// more of them than of splines, which would depend on each other.
fn along(n: usize, pitch: f64) -> Vec<Piece> {
    let last = (n - 1) as f64;
    let intervals = (last / pitch).ceil();
    if intervals as usize + 3 >= n {
        return (0..n).map(|first| Piece { first, values: vec![1.0] }).collect();
    }
    let mut splines = Vec::new();
    for k in 0..intervals as usize + 3 {
        let centre = (k as f64 - 1.0) * pitch - 0.5 * (intervals * pitch - last);
        let first = (centre - 2.0 * pitch).ceil().max(0.0) as usize;
        let end = ((centre + 2.0 * pitch).floor() as usize + 1).min(n);
        if first < end {
            let values = (first..end).map(|i| cubic((i as f64 - centre).abs() / pitch)).collect();
            splines.push(Piece { first, values });
        }
    }
    splines
}

/// Returns the cubic B-spline at the distance u >= 0 from its centre, in steps.
fn cubic(u: f64) -> f64 {
    if u < 1.0 {
        2.0 / 3.0 - u * u + 0.5 * u * u * u
    } else if u < 2.0 {
        (2.0 - u).powi(3) / 6.0
    } else {
        0.0
    }
}
