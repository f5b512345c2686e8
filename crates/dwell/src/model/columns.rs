//! The removal model of the dwell solvers: what one second at each dwell point removes.
//!
//! ```text
//! point columns    B_ij = R(x_i - d_j)                                   the tool sits at d_j
//! segment columns  B_ij = sum_q w_q R(x_i - p_j - s_q (p_{j+1} - p_j))   it moves uniformly
//! executed columns B_ij = sum_q w_q R(x_i - P_j(u_q h_j))                it moves as scheduled
//! ```
//!
//! with dwell point d_j, control points p_j, and the position P_j of the tool in the trajectory, whose duration for
//! dwell point j is h_j. `s_q`, `u_q` and `w_q` are the nodes and weights of the three-point Gauss rule along segment
//! j, or in time along each segment of the trajectory that serves dwell point j. R is the interpolated TIF of
//! [`planish_types::Tif`]. For a tool that varies, `R(x_i - p)` is K of [`planish_types::Variation`], with its factor
//! of the time in the fractions of executed columns. This model is the solver's own; what the machine really does is
//! predicted elsewhere, by code that shares nothing with it.

use std::{borrow::Cow, ops::Range};

use ndarray::{Array2, ArrayView2, Axis as NdAxis, Zip, s};
use planish_numerics::{
    keys, linear::skyline::dot, parallel, quadrature::gauss_legendre, vectors::vectorised,
};
use planish_types::{Axis, Grid, Headings, Pose, Tif, ToolPath, Trajectory, headings_of_path_rad};

use serde::Serialize;

pub use crate::model::place::ToolPlace;
use crate::model::{ROWS_PER_TASK, varying};

/// Columns of the removal model: motion of the tool during one dwell time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Columns {
    /// Standing at the dwell point.
    Point,
    /// Moving uniformly along the segment.
    Segment,
}

impl Columns {
    /// Returns the places of the tool in each column: positions with their fractions of the dwell time. A column has no
    /// places where the tool is off. A moving tool has the places of the three-point Gauss rule on the segment, or on
    /// each of the fewest equal parts of it that are short compared with the TIF.
    pub fn places(self, path: &ToolPath, tif: &Tif) -> Vec<Vec<ToolPlace>> {
        self.places_in_parts(path, longest_part_mm(tif))
    }

    /// Returns the places of [`Self::places`] in each column, with parts of a segment that are at most `longest_mm`
    /// [x, y] long.
    fn places_in_parts(self, path: &ToolPath, longest_mm: [f64; 2]) -> Vec<Vec<ToolPlace>> {
        let rule = gauss_legendre::<3>();
        let headings_rad = headings_of_path_rad(path);
        let columns = (0..path.len()).map(|j| match self {
            _ if !path.tool_on()[j] => Vec::new(),
            Self::Point => vec![ToolPlace {
                position_mm: path.dwell_point_mm()[j],
                heading_rad: headings_rad[j],
                fraction: 1.0,
            }],
            Self::Segment => {
                let start = path.point_mm()[j];
                let d = path.displacement_mm(j);
                in_parts(&rule, parts(d, longest_mm), |s, fraction| ToolPlace {
                    position_mm: [start[0] + s * d[0], start[1] + s * d[1]],
                    heading_rad: headings_rad[j],
                    fraction,
                })
            }
        });
        columns.collect()
    }
}

/// Returns the largest length along x and y of a part on which three Gauss points represent the removal of the moving
/// tool, mm.
///
/// For a Gaussian it is two standard deviations, found from the slopes of the TIF. The slopes of a tool with steep
/// flanks give a much shorter length, and three points never represent it exactly. For such a tool it is half of the
/// spread, the standard deviation of a Gaussian with the same width of R^2.
pub(crate) fn longest_part_mm(tif: &Tif) -> [f64; 2] {
    // 1 / (2 sigma^2) and sigma^2 / 2 of a Gaussian, weighted with R^2: noise far from the tool counts for nothing.
    let slopes = tif.slope_energy_per_mm2();
    [0, 1].map(|axis| {
        let mean_mm = energy_moment(tif, axis, 1, 0.0);
        let spread_mm = (2.0 * energy_moment(tif, axis, 2, mean_mm)).sqrt();
        let flank_mm = (2.0 * slopes[axis]).sqrt().recip();
        2.0 * flank_mm.max(LEAST_PART_OF_SPREAD * spread_mm)
    })
}

/// Returns the moment `sum R^2 (x - about_mm)^power / sum R^2` of a TIF R along x (`axis` 0) or y (1), in mm to this
/// power.
fn energy_moment(tif: &Tif, axis: usize, power: i32, about_mm: f64) -> f64 {
    let rate = tif.rate_nm_per_s();
    let grid = tif.grid();
    let energy: f64 = rate.iter().map(|r| r * r).sum();
    let terms = rate.indexed_iter().map(|((r, c), v)| {
        let coordinate_mm =
            if axis == 0 { grid.x.coordinate_mm(c) } else { grid.y.coordinate_mm(r) };
        v * v * (coordinate_mm - about_mm).powi(power)
    });
    terms.sum::<f64>() / energy
}

/// Smallest half length of a part as a fraction of the spread of the TIF, dimensionless; see [`longest_part_mm`].
/// Larger: longer parts of tools with steep flanks, and a larger error of the removal. Smaller: more parts, and more
/// time.
const LEAST_PART_OF_SPREAD: f64 = 0.25;

/// Returns the smallest number of equal parts of a displacement [x, y] that are no longer than `longest_mm` along x
/// and y.
fn parts(displacement_mm: [f64; 2], longest_mm: [f64; 2]) -> usize {
    let [x, y] = [0, 1].map(|axis| (displacement_mm[axis].abs() / longest_mm[axis]).ceil());
    (x.max(y) as usize).max(1)
}

/// Applies a quadrature rule on [0, 1], given as (node, weight), to each of `parts` equal parts of [0, 1]. Returns
/// `place(s, w)` for every node s, as a fraction of the whole interval, and its weight w; all weights sum to 1.
fn in_parts(
    rule: &[(f64, f64)],
    parts: usize,
    place: impl Fn(f64, f64) -> ToolPlace,
) -> Vec<ToolPlace> {
    let n = parts as f64;
    let each = (0..parts).flat_map(|k| rule.iter().map(move |(s, w)| ((k as f64 + s) / n, w / n)));
    each.map(|(s, w)| place(s, w)).collect()
}

/// Returns the places of the tool in each of `columns` columns of an executed motion; column j belongs to dwell point
/// j, and has no places if no segment with the tool on serves it. Every segment of the trajectory with the tool on has
/// the places of the three-point Gauss rule in time, on the whole or on equal parts that are short compared with the
/// tool. The fractions of a column sum to its factor of [`time_factors`].
pub fn executed(trajectory: &Trajectory, columns: usize, tif: &Tif) -> Vec<Vec<ToolPlace>> {
    let rule = gauss_legendre::<3>();
    let longest_mm = longest_part_mm(tif);
    let headings = Headings::new(trajectory);
    let mut places = vec![Vec::new(); columns];
    for (k, segment) in trajectory.segments().enumerate().filter(|(_, s)| s.tool_on) {
        let Some(column) = segment.dwell_index.and_then(|j| places.get_mut(j)) else { continue };
        // The way between four positions is that of a cubic piece but for a few percent.
        let positions =
            [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0].map(|u| segment.position_mm(u * segment.duration_s));
        let total =
            [0, 1].map(|axis| positions.windows(2).map(|p| (p[1][axis] - p[0][axis]).abs()).sum());
        column.extend(in_parts(&rule, parts(total, longest_mm), |u, w| {
            let Pose { position_mm, heading_rad } =
                headings.pose(k, &segment, u * segment.duration_s);
            ToolPlace { position_mm, heading_rad, fraction: w * segment.duration_s }
        }));
    }
    for (column, factor) in places.iter_mut().zip(time_factors(trajectory, columns, tif)) {
        let total: f64 = column.iter().map(|p| p.fraction).sum();
        column.iter_mut().for_each(|p| p.fraction = factor * (p.fraction / total));
    }
    places
}

/// Returns, for each of `columns` columns of an executed motion, the mean over its time of the factor c(t) of the
/// removal rate, for a tool whose rate depends on the time of the run. It is 1 for other tools, and for columns that no
/// segment with the tool on serves.
pub fn time_factors(trajectory: &Trajectory, columns: usize, tif: &Tif) -> Vec<f64> {
    let Some(time) = tif.variation().and_then(|v| v.time_factor()) else {
        return vec![1.0; columns];
    };
    let mut sums = vec![(0.0, 0.0); columns];
    for segment in trajectory.segments() {
        let column = segment.dwell_index.filter(|_| segment.tool_on);
        let Some((sum, total)) = column.and_then(|j| sums.get_mut(j)) else { continue };
        let end_s = segment.start_s + segment.duration_s;
        *sum += segment.duration_s * time.mean(segment.start_s, end_s);
        *total += segment.duration_s;
    }
    sums.into_iter().map(|(sum, total)| if total > 0.0 { sum / total } else { 1.0 }).collect()
}

/// One column of the removal matrix B: the removal rate of one dwell point on a rectangle of pixels; zero elsewhere.
#[derive(Clone, Debug, Default)]
pub struct Patch {
    /// First pixel of the rectangle (row, column) in the map.
    pub origin: (usize, usize),
    /// Removal rate on the rectangle (rows, columns), nm/s; possibly empty.
    pub rate_nm_per_s: Array2<f64>,
}

/// Returns the columns of B for the places of the tool in each of them, on the pixels of `grid`; a patch is empty if
/// the TIF covers no pixel from any of its places.
pub fn patches(places: &[Vec<ToolPlace>], tif: &Tif, grid: &Grid) -> Vec<Patch> {
    let factor = tif.variation().and_then(|v| v.factor_on(grid));
    parallel::map(places.len(), &|j| {
        let mut patch = patch(&places[j], tif, grid);
        if let Some(factor) = &factor {
            patch.times(factor);
        }
        patch
    })
}

/// Returns an empty patch.
fn nowhere() -> Patch {
    Patch { origin: (0, 0), rate_nm_per_s: Array2::zeros((0, 0)) }
}

/// Returns the first and last pixel, [along x, along y], that the TIF covers from any of the places. `None` if it
/// covers none along an axis.
fn reach(places: &[ToolPlace], tif: &Tif, grid: &Grid) -> Option<[(usize, usize); 2]> {
    let [x, y] = [0, 1].map(|axis| {
        let covered = places.iter().filter_map(|p| pixels(p.position_mm[axis], grid, tif, axis));
        covered.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    });
    Some([x?, y?])
}

/// Returns the removal rate `sum_q w_q K(x_i; p_q)` on the pixels that the tool covers from any of the places, without
/// the factor of the pixels.
fn patch(places: &[ToolPlace], tif: &Tif, grid: &Grid) -> Patch {
    let Some(v) = tif.variation() else { return of_kernel(places, tif, grid) };
    let each = v.components().iter().enumerate().map(|(k, component)| {
        let places: Vec<ToolPlace> = places.iter().map(|p| varying::weighted(v, k, p)).collect();
        of_kernel(&places, component.kernel(), grid)
    });
    // All kernels have one grid, and reach the same pixels.
    let sum = each.reduce(|mut sum, patch| {
        sum.rate_nm_per_s += &patch.rate_nm_per_s;
        sum
    });
    sum.unwrap_or_else(nowhere)
}

/// Returns the removal rate `sum_q w_q R(x_i - p_q)` of a TIF R that is the same everywhere, on the pixels that it
/// covers from any of the places.
fn of_kernel(places: &[ToolPlace], tif: &Tif, grid: &Grid) -> Patch {
    let Some([x, y]) = reach(places, tif, grid) else { return nowhere() };
    let mut rate_nm_per_s = Array2::zeros((y.1 - y.0 + 1, x.1 - x.0 + 1));
    let samples = tif.with_ghosts();
    let mut row = SampleRow::new(samples.ncols(), stride(&grid.x, &tif.grid().x));
    // Interpolate along y once for all places of the same y, then along x.
    for places in places.chunk_by(|a, b| a.position_mm[1] == b.position_mm[1]) {
        let along_x: Vec<Under> = places
            .iter()
            .map(|p| Under::new(p.position_mm[0], grid, tif, 0, x, p.fraction))
            .collect();
        let along_y = Under::new(places[0].position_mm[1], grid, tif, 1, y, 1.0);
        for (k, node) in along_y.node.iter().enumerate() {
            let w = [0, 1, 2, 3].map(|t| along_y.w[t][k]);
            combine(&samples.slice(s![*node..node + 4, ..]), &w, &mut row.samples);
            row.sort_by_phase();
            let mut out = rate_nm_per_s.row_mut(along_y.pixel + k);
            let out = out.as_slice_mut().expect("in C order");
            along_x.iter().for_each(|under| under.add(&row, out));
        }
    }
    Patch { origin: (y.0, x.0), rate_nm_per_s }
}

/// Writes the sum of the four rows of `rows`, each times its weight of `w`, to `out`.
fn combine(rows: &ArrayView2<f64>, w: &[f64; 4], out: &mut [f64]) {
    let n = out.len();
    let all = rows.as_slice().expect("whole rows of an array in C order");
    let [a, b, c, d] = [0, 1, 2, 3].map(|k| &all[k * n..(k + 1) * n]);
    for (i, out) in out.iter_mut().enumerate() {
        *out = w[0] * a[i] + w[1] * b[i] + w[2] * c[i] + w[3] * d[i];
    }
}

/// A row of samples of a TIF, and the same samples sorted by phase (index modulo the number of samples per pixel), so
/// that the samples under neighbouring pixels are adjacent.
struct SampleRow {
    samples: Vec<f64>,
    by_phase: Vec<f64>,
    /// Number of samples of the TIF to a pixel.
    stride: usize,
    /// Number of samples of one phase.
    of_phase: usize,
}

impl SampleRow {
    fn new(samples: usize, stride: usize) -> Self {
        let of_phase = samples.div_ceil(stride);
        let by_phase = if stride == 1 { Vec::new() } else { vec![0.0; of_phase * stride] };
        Self { samples: vec![0.0; samples], by_phase, stride, of_phase }
    }

    fn sort_by_phase(&mut self) {
        let Self { samples, by_phase, stride, of_phase } = self;
        if *stride == 1 {
            return;
        }
        for (phase, line) in by_phase.chunks_exact_mut(*of_phase).enumerate() {
            let own = samples.iter().skip(phase).step_by(*stride);
            line.iter_mut().zip(own).for_each(|(to, from)| *to = *from);
        }
    }

    /// Returns `count` samples, one pixel apart, from the index `node` on.
    fn under(&self, node: usize, count: usize) -> &[f64] {
        match self.stride {
            1 => &self.samples[node..node + count],
            stride => &self.by_phase[node % stride * self.of_phase + node / stride..][..count],
        }
    }
}

/// Returns the pitch of the map over that of the samples along an axis, rounded to a whole number, at least 1: the
/// number of samples of the TIF to a pixel.
fn stride(map: &Axis, samples: &Axis) -> usize {
    (map.step_mm() / samples.step_mm()).round().max(1.0) as usize
}

/// Returns the first and last pixel along x (`axis` 0) or y (1) that the TIF covers from the tool position `p`, mm.
/// `None` if it covers none.
fn pixels(p: f64, grid: &Grid, tif: &Tif, axis: usize) -> Option<(usize, usize)> {
    let map = [&grid.x, &grid.y][axis];
    let start_mm = [tif.grid().x, tif.grid().y][axis].start_mm();
    let [low, high] = [start_mm, tif.edge_mm()[axis]]
        .map(|offset_mm| (p + offset_mm - map.start_mm()) / map.step_mm());
    let first = (low - keys::SNAP).ceil().max(0.0);
    let last = (high + keys::SNAP).floor().min((map.len() - 1) as f64);
    if first <= last { Some((first as usize, last as usize)) } else { None }
}

/// The pixels along an axis under the TIF, and the samples of the TIF that each of them interpolates.
struct Under {
    /// First pixel under the TIF, counted from the first pixel of the range.
    pixel: usize,
    /// Index of the first of the four samples that every pixel interpolates; index 0 is the ghost node.
    node: Vec<usize>,
    /// Keys' four weights for every pixel; they differ from pixel to pixel if the TIF and the map do not have exactly
    /// the same pitch.
    w: [Vec<f64>; 4],
    /// Runs of neighbouring pixels whose nodes are [`stride`] apart.
    runs: Vec<Range<usize>>,
}

/// Difference of the offsets of two pixels from their samples, in steps of the TIF, below which both pixels get the
/// same weights. Larger: a pixel gets weights that are wrong for it. Smaller: rounding of coordinates splits runs of
/// pixels, which costs time.
const SAME_OFFSET: f64 = 1e-11;

/// Smallest number of pixels in a run that is computed as a run; shorter ones are faster pixel by pixel. Changes the
/// speed only.
const SHORTEST_RUN: usize = 8;

impl Under {
    /// Finds the pixels in `range` (first, last) along x (`axis` 0) or y (1) that the TIF covers from the tool position
    /// `p`, mm. The weights are those of Keys times `fraction`.
    fn new(
        p: f64,
        grid: &Grid,
        tif: &Tif,
        axis: usize,
        range: (usize, usize),
        fraction: f64,
    ) -> Self {
        let map = [&grid.x, &grid.y][axis];
        let stride = stride(map, [&tif.grid().x, &tif.grid().y][axis]);
        let count = range.1 + 1 - range.0;
        let w = [(); 4].map(|()| Vec::with_capacity(count));
        let mut under = Self { pixel: 0, node: Vec::with_capacity(count), w, runs: Vec::new() };
        let mut offset = f64::NAN;
        let mut w = [0.0; 4];
        for i in range.0..=range.1 {
            let Some((node, f)) = tif.cell(axis, map.coordinate_mm(i) - p) else { continue };
            let n = under.node.len();
            if n == 0 {
                under.pixel = i - range.0;
            }
            let follows = under.node.last().is_some_and(|before| before + stride == node);
            if !follows || (f - offset).abs() >= SAME_OFFSET {
                (offset, w) = (f, keys::weights(f).map(|w| w * fraction));
            }
            match under.runs.last_mut().filter(|_| follows) {
                Some(run) => run.end += 1,
                None => under.runs.push(n..n + 1),
            }
            under.node.push(node);
            under.w.iter_mut().zip(w).for_each(|(all, w)| all.push(w));
        }
        under
    }

    /// Adds `sum_t w_t g[node + t]`, t = 0 .. 3, to the pixels of `out`, which begins at the first pixel of the range,
    /// with the samples g of a row of the TIF.
    fn add(&self, row: &SampleRow, out: &mut [f64]) {
        let out = &mut out[self.pixel..self.pixel + self.node.len()];
        for run in &self.runs {
            let [wa, wb, wc, wd] = [0, 1, 2, 3].map(|t| &self.w[t][run.clone()]);
            if run.len() < SHORTEST_RUN {
                for (k, i) in run.clone().enumerate() {
                    let samples = &row.samples[self.node[i]..self.node[i] + 4];
                    out[i] += wa[k] * samples[0]
                        + wb[k] * samples[1]
                        + wc[k] * samples[2]
                        + wd[k] * samples[3];
                }
                continue;
            }
            let from = self.node[run.start];
            let n = run.len();
            let [a, b, c, d] = [0, 1, 2, 3].map(|t| row.under(from + t, n));
            for (i, out) in out[run.clone()].iter_mut().enumerate() {
                *out += wa[i] * a[i] + wb[i] * b[i] + wc[i] * c[i] + wd[i] * d[i];
            }
        }
    }
}

impl Patch {
    /// Multiplies the rates by a factor for every pixel of the map (ny, nx).
    pub(crate) fn times(&mut self, factor: &Array2<f64>) {
        let ((r, c), (ny, nx)) = (self.origin, self.rate_nm_per_s.dim());
        self.rate_nm_per_s *= &factor.slice(s![r..r + ny, c..c + nx]);
    }

    /// Returns, for every row of the rectangle: the index of the row in the map, the range of its columns there, and
    /// the rates.
    fn rows(&self) -> impl Iterator<Item = (usize, Range<usize>, &[f64])> {
        let (r, c) = self.origin;
        let width = self.rate_nm_per_s.ncols();
        self.all()
            .chunks_exact(width.max(1))
            .enumerate()
            .map(move |(k, row)| (r + k, c..c + width, row))
    }

    /// Returns the sum over the pixels of the rate times a map (ny, nx).
    pub fn product(&self, map: &Array2<f64>) -> f64 {
        let all = map.as_slice().expect("in C order");
        let width = map.ncols();
        self.rows()
            .map(|(r, c, rate)| dot(rate, &all[r * width + c.start..r * width + c.end]))
            .sum()
    }

    /// Returns the energy of the column: the sum over its pixels of the squared rate times the weights of the map (ny,
    /// nx).
    fn energy(&self, weight: &Array2<f64>) -> f64 {
        let rows = self.rows().map(|(r, c, rate)| {
            let w = weight.slice(s![r, c]);
            rate.iter().zip(w).map(|(b, w)| w * b * b).sum::<f64>()
        });
        rows.sum()
    }

    /// Returns the part of a map (ny, nx) on the rectangle of the patch.
    pub(crate) fn part_of(&self, map: &Array2<f64>) -> Array2<f64> {
        let (r, c) = self.origin;
        let (ny, nx) = self.rate_nm_per_s.dim();
        map.slice(s![r..r + ny, c..c + nx]).to_owned()
    }
}

/// The removal matrix B, stored by columns.
pub struct Stored {
    /// Columns of B, one for every dwell point.
    pub(super) patches: Vec<Patch>,
    shape: (usize, usize),
}

impl Stored {
    /// Computes and stores the columns for the places of the tool in each of them, on the pixels of `grid`.
    pub fn new(places: &[Vec<ToolPlace>], tif: &Tif, grid: &Grid) -> Self {
        Self { patches: patches(places, tif, grid), shape: grid.shape() }
    }

    /// Returns the removal `B t` (ny, nx), nm, for dwell times t (n), s. Every pixel sums in the order of the columns,
    /// whatever the threads.
    pub fn apply(&self, t: &[f64]) -> Array2<f64> {
        let mut map = Array2::zeros(self.shape);
        parallel::for_each_band(&mut map, ROWS_PER_TASK, &|b, mut band| {
            let first = b * ROWS_PER_TASK;
            let rows = first..first + band.nrows();
            for (p, t) in self.patches.iter().zip(t).filter(|(_, t)| **t != 0.0) {
                let height = p.rate_nm_per_s.nrows();
                let from = rows.start.max(p.origin.0);
                let to = rows.end.min(p.origin.0 + height);
                if from >= to {
                    continue;
                }
                for (r, columns, rate) in p.rows().skip(from - p.origin.0).take(to - from) {
                    let mut row = band.row_mut(r - rows.start);
                    let row = row.as_slice_mut().expect("in C order");
                    let row = &mut row[columns];
                    row.iter_mut().zip(rate).for_each(|(m, r)| *m += t * r);
                }
            }
        });
        map
    }

    /// Returns the adjoint product `B' m` (n) for a map m (ny, nx).
    pub fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        parallel::map(self.patches.len(), &|j| self.patches[j].product(map))
    }

    /// Returns the energy of every column under a weight w (ny, nx): the sum of `w_i B_ij^2` over the pixels i, (n).
    pub fn energy(&self, weight: &Array2<f64>) -> Vec<f64> {
        parallel::map(self.patches.len(), &|j| self.patches[j].energy(weight))
    }
}

/// Computes `P W^1/2 B`, the columns of B on cells of `size` x `size` pixels: `sum_i w_i B_ij / sqrt(sum_i w_i)` over
/// the pixels i of every cell, 0 in a cell without weight. The columns of B on the pixels are not kept.
///
/// Where every cell that a column reaches has pixels of one weight, the weights of the interpolation are summed along
/// either axis before they meet the samples g of the TIF. The weights of Keys for pixel row r and pixel column c are
/// a_t(r) and b_s(c), for the four samples from p(r) and q(c) on:
///
/// ```text
/// sum_r sum_c sum_t sum_s a_t(r) b_s(c) g[p(r) + t, q(c) + s] = sum_m A_m sum_n B_n g[m, n]              (1)
/// A_m = sum of a_t(r) over all r and t with p(r) + t = m,   B_n likewise
/// ```
pub fn on_cells(
    places: &[Vec<ToolPlace>],
    tif: &Tif,
    grid: &Grid,
    weight: &Array2<f64>,
    size: usize,
) -> Vec<Patch> {
    let cells = PixelCells::new(tif, grid, weight, size);
    parallel::map(places.len(), &|j| match size {
        1 => cells.by_pixels(&places[j]),
        _ => cells.by_sums(&places[j]).unwrap_or_else(|| cells.by_pixels(&places[j])),
    })
}

/// Computes `P W^-1/2 m`, a map m (ny, nx) on cells of `size` x `size` pixels: `sum_i m_i / sqrt(sum_i w_i)` over the
/// pixels i of every cell, 0 in a cell without weight.
pub fn map_on_cells(map: &Array2<f64>, weight: &Array2<f64>, size: usize) -> Array2<f64> {
    let mut cells = sums(map, size);
    Zip::from(&mut cells).and(&sums(weight, size)).for_each(|v, w| *v *= reciprocal_root(*w));
    cells
}

/// Returns the sum of a map over the pixels of every cell of `size` x `size` pixels; the last cell along an axis may be
/// smaller.
fn sums(map: &Array2<f64>, size: usize) -> Array2<f64> {
    by_cells(map, size, 0.0, |sum, pixels| pixels.iter().for_each(|v| *sum += v))
}

/// Computes a number for every cell. It starts as `begin`, and `meet` updates it with each row of pixels of the cell.
fn by_cells(
    map: &Array2<f64>,
    size: usize,
    begin: f64,
    meet: impl Fn(&mut f64, &[f64]) + Sync,
) -> Array2<f64> {
    let shape = (map.nrows().div_ceil(size), map.ncols().div_ceil(size));
    let mut cells = Array2::from_elem(shape, begin);
    let lines = cells.outer_iter_mut().zip(map.axis_chunks_iter(NdAxis(0), size));
    parallel::consume(lines, &|_, (mut cells, rows)| {
        for row in rows.outer_iter() {
            let pixels = row.to_slice().expect("in C order").chunks(size);
            cells.iter_mut().zip(pixels).for_each(|(cell, pixels)| meet(cell, pixels));
        }
    });
    cells
}

/// Returns `1 / sqrt(w)`; 0 if w is 0.
fn reciprocal_root(w: f64) -> f64 {
    if w > 0.0 { w.sqrt().recip() } else { 0.0 }
}

/// Cells of `size` x `size` pixels of a map, for columns of one TIF.
struct PixelCells<'a> {
    tif: &'a Tif,
    grid: &'a Grid,
    weight: &'a Array2<f64>,
    size: usize,
    /// Factor `1 / sqrt(sum_i w_i)` of every cell, over its pixels i; 0 without a weight.
    scale: Array2<f64>,
    /// Common weight of the pixels of every cell; NaN where their weights differ.
    alike: Array2<f64>,
    /// Factor of the removal at every pixel, if the tool has one.
    factor: Option<Cow<'a, Array2<f64>>>,
}

impl<'a> PixelCells<'a> {
    fn new(tif: &'a Tif, grid: &'a Grid, weight: &'a Array2<f64>, size: usize) -> Self {
        let scale = sums(weight, size).mapv(reciprocal_root);
        let alike = by_cells(weight, size, f64::INFINITY, |alike, pixels| {
            let first = if *alike == f64::INFINITY { pixels[0] } else { *alike };
            *alike = if pixels.iter().all(|w| *w == first) { first } else { f64::NAN };
        });
        let factor = tif.variation().and_then(|v| v.factor_on(grid));
        Self { tif, grid, weight, size, scale, alike, factor }
    }

    /// Computes the column for some places of the tool on the cells, from all of its pixels.
    fn by_pixels(&self, places: &[ToolPlace]) -> Patch {
        let Self { tif, grid, size, .. } = *self;
        let mut p = patch(places, tif, grid);
        if let Some(factor) = &self.factor {
            p.times(factor);
        }
        let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
        if ny == 0 || nx == 0 {
            return nowhere();
        }
        let all = self.weight.as_slice().expect("in C order");
        let width = self.weight.ncols();
        let top = r / size;
        let left = c / size;
        let shape = ((r + ny - 1) / size + 1 - top, (c + nx - 1) / size + 1 - left);
        let mut cells = Array2::zeros(shape);
        let mut line = vec![0.0; nx];
        for (r, columns, rate) in p.rows() {
            let w = &all[r * width + columns.start..r * width + columns.end];
            line.iter_mut().zip(w).zip(rate).for_each(|((l, w), b)| *l = w * b);
            let mut row = cells.row_mut(r / size - top);
            // The first cell has the pixels up to the next multiple of the size.
            let (head, rest) = line.split_at((size - c % size).min(nx));
            row[0] += head.iter().sum::<f64>();
            for (cell, pixels) in row.iter_mut().skip(1).zip(rest.chunks(size)) {
                *cell += pixels.iter().sum::<f64>();
            }
        }
        cells *= &self.scale.slice(s![top..top + shape.0, left..left + shape.1]);
        Patch { origin: (top, left), rate_nm_per_s: cells }
    }

    /// Computes the column for some places of the tool on the cells by the sums (1) of [`on_cells`]. `None` if it
    /// reaches a cell whose pixels differ in weight, or if the tool has a factor for every pixel.
    fn by_sums(&self, places: &[ToolPlace]) -> Option<Patch> {
        let Self { tif, grid, size, .. } = *self;
        if self.factor.is_some() {
            return None;
        }
        let Some([x, y]) = reach(places, tif, grid) else { return Some(nowhere()) };
        let top = y.0 / size;
        let left = x.0 / size;
        let window = s![top..=y.1 / size, left..=x.1 / size];
        let alike = self.alike.slice(window);
        if alike.iter().any(|w| w.is_nan()) {
            return None;
        }
        let mut cells = Array2::zeros(alike.dim());
        let one_column = [places.to_vec()];
        for (kernel, places) in varying::kernels(&one_column, tif) {
            let mut sums = TwoSums::new(kernel.with_ghosts(), alike.dim());
            for places in places[0].chunk_by(|a, b| a.position_mm[1] == b.position_mm[1]) {
                let along_y = self.summed(kernel, 1, &places[0], y, 1.0);
                let along_x = places.iter().map(|p| self.summed(kernel, 0, p, x, p.fraction));
                sums.add(&along_y, top, &along_x.collect::<Vec<_>>(), left);
            }
            sums.add_to(&mut cells);
        }
        cells *= &alike;
        cells *= &self.scale.slice(window);
        Some(Patch { origin: (top, left), rate_nm_per_s: cells })
    }

    /// Returns the sums over every cell of Keys' weights, times `fraction`, along x (`axis` 0) or y (1), for the pixels
    /// in `range` (first, last) that the kernel covers from a place.
    fn summed(
        &self,
        kernel: &Tif,
        axis: usize,
        place: &ToolPlace,
        range: (usize, usize),
        fraction: f64,
    ) -> Summed {
        let under = Under::new(place.position_mm[axis], self.grid, kernel, axis, range, fraction);
        Summed::new(&under, range.0, self.size)
    }
}

/// Computes the right side of (1) of [`on_cells`] for all cells under a column.
struct TwoSums<'a> {
    /// Samples g of the TIF with its ghost nodes.
    samples: &'a Array2<f64>,
    /// Sums `sum_m A_m g[m, n]` of one row of cells, for every sample column n.
    row: Vec<f64>,
    /// Sums `sum_m A_m g[m, n]` of all rows of cells; those of one sample column n are adjacent.
    rows: Vec<f64>,
    /// Results of (1): those of one column of cells are adjacent.
    cells: Vec<f64>,
    /// Number of rows of cells.
    height: usize,
}

impl<'a> TwoSums<'a> {
    fn new(samples: &'a Array2<f64>, (height, width): (usize, usize)) -> Self {
        let nodes = samples.ncols();
        Self {
            samples,
            row: vec![0.0; nodes],
            rows: vec![0.0; nodes * height],
            cells: vec![0.0; width * height],
            height,
        }
    }

    /// Adds some places of the tool with the same y. `along_y` has their common weights A; `along_x` has the weights B
    /// of each place. `top` and `left` are the first row and the first column of cells.
    fn add(&mut self, along_y: &Summed, top: usize, along_x: &[Summed], left: usize) {
        let Self { samples, row, rows, cells, height } = self;
        let nodes = samples.ncols();
        let height = *height;
        let g = samples.as_slice().expect("in C order");
        rows.fill(0.0);
        vectorised(
            #[inline(always)]
            || {
                for (r, (node, weights)) in along_y.cells() {
                    row.fill(0.0);
                    for (w, g) in weights.iter().zip(g[node * nodes..].chunks_exact(nodes)) {
                        row.iter_mut().zip(g).for_each(|(sum, g)| *sum += w * g);
                    }
                    let of_row = rows[r - top..].iter_mut().step_by(height);
                    of_row.zip(row.iter()).for_each(|(to, from)| *to = *from);
                }
                for along_x in along_x {
                    for (c, (node, weights)) in along_x.cells() {
                        let cells = &mut cells[(c - left) * height..][..height];
                        let rows = rows[node * height..].chunks_exact(height);
                        for (w, rows) in weights.iter().zip(rows) {
                            cells.iter_mut().zip(rows).for_each(|(sum, row)| *sum += w * row);
                        }
                    }
                }
            },
        );
    }

    /// Adds the sums of all places of the column to `cells` (rows of cells, columns of cells).
    fn add_to(&self, cells: &mut Array2<f64>) {
        cells.indexed_iter_mut().for_each(|((r, c), v)| *v += self.cells[c * self.height + r]);
    }
}

/// Weights A or B of (1) of [`on_cells`] for the cells along an axis.
struct Summed {
    /// Index of the first cell.
    cell: usize,
    /// Index of the first sample of every cell, counted with the ghost nodes.
    node: Vec<usize>,
    /// Index in `weight` of the first weight of every cell, and at the end the number of all weights.
    from: Vec<usize>,
    /// The weights of all cells, one after the other.
    weight: Vec<f64>,
}

impl Summed {
    /// Sums the weights of the pixels under a tool over cells of `size` pixels. The range of `under` begins at pixel
    /// `first` of the map.
    fn new(under: &Under, first: usize, size: usize) -> Self {
        let first = first + under.pixel;
        let mut summed =
            Self { cell: first / size, node: Vec::new(), from: Vec::new(), weight: Vec::new() };
        let mut start = 0;
        let mut from = 0;
        for (k, node) in under.node.iter().enumerate() {
            if k == 0 || (first + k).is_multiple_of(size) {
                (start, from) = (*node, summed.weight.len());
                summed.node.push(start);
                summed.from.push(from);
            }
            let first_weight = from + node - start;
            summed.weight.resize((first_weight + 4).max(summed.weight.len()), 0.0);
            (0..4).for_each(|t| summed.weight[first_weight + t] += under.w[t][k]);
        }
        summed.from.push(summed.weight.len());
        summed
    }

    /// Returns for every cell its index, its first sample, and the weights of the samples from there on.
    fn cells(&self) -> impl Iterator<Item = (usize, (usize, &[f64]))> {
        let weights = self.from.windows(2).map(|w| &self.weight[w[0]..w[1]]);
        (self.cell..).zip(self.node.iter().copied().zip(weights))
    }
}

impl Patch {
    /// Returns the sum of the squared rates.
    pub fn square(&self) -> f64 {
        dot(self.all(), self.all())
    }

    /// Returns the range of the rows (`axis` 0) or columns (1) of the map that the rectangle covers.
    pub fn range(&self, axis: usize) -> Range<usize> {
        let start = [self.origin.0, self.origin.1][axis];
        start..start + self.rate_nm_per_s.shape()[axis]
    }

    /// Returns true if the two rectangles have a pixel in common.
    pub fn overlaps(&self, other: &Self) -> bool {
        [0, 1].iter().all(|axis| {
            let own = self.range(*axis);
            let other = other.range(*axis);
            own.start < other.end && other.start < own.end
        })
    }

    /// Returns the rates row by row, as one slice.
    pub fn all(&self) -> &[f64] {
        self.rate_nm_per_s.as_slice().expect("in C order")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rough() -> (Tif, Grid) {
        let g =
            Grid { x: Axis::new(-1.3, 0.11, 23).unwrap(), y: Axis::new(-0.9, 0.09, 17).unwrap() };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
            5.0 + 2.0 * x - y + (37.0 * x).sin() * (29.0 * y).cos()
        });
        let map =
            Grid { x: Axis::new(0.0, 0.1, 40).unwrap(), y: Axis::new(0.0, 0.08, 30).unwrap() };
        (Tif::new(g, rate).unwrap(), map)
    }

    /// Returns a grid of pixels with these pitches, mm.
    fn of_pitch(x_mm: f64, y_mm: f64) -> Grid {
        Grid { x: Axis::new(0.0, x_mm, 37).unwrap(), y: Axis::new(0.0, y_mm, 29).unwrap() }
    }

    #[test]
    fn a_patch_is_the_tif_at_pixel_minus_tool() {
        let (tif, coarse) = rough();
        // Pixels of the pitch of the TIF, and of that pitch but for the digits that a file has lost.
        let maps = [coarse, of_pitch(0.11, 0.09), of_pitch(0.11 * (1.0 + 2.5e-8), 0.09 + 1e-9)];
        let places = [[1.7, 1.3], [-1.0, 0.2], [3.9, 2.32], [0.0, 0.0], [99.0, 0.0]];
        for (map, p) in maps.iter().flat_map(|map| places.map(|p| (map, p))) {
            let patch = patch(&[ToolPlace::new(p, 1.0)], &tif, map);
            let mut full = Array2::zeros(map.shape());
            let (r, c) = patch.origin;
            let (ny, nx) = patch.rate_nm_per_s.dim();
            full.slice_mut(s![r..r + ny, c..c + nx]).assign(&patch.rate_nm_per_s);
            for ((r, c), v) in full.indexed_iter() {
                let expected =
                    tif.rate_at(map.x.coordinate_mm(c) - p[0], map.y.coordinate_mm(r) - p[1]);
                // Rounding of coordinates; a pitch that is off by a few 1e-8 is taken as the same one and gives the
                // same rate here.
                assert!((v - expected).abs() < 1e-12, "{p:?} at {r} {c}: {v} {expected}");
            }
        }
    }

    #[test]
    fn segment_columns_average_along_the_chord() {
        let (tif, map) = rough();
        let path =
            ToolPath::new(vec![[1.0, 1.0], [1.4, 1.2]], vec![[9.0, 9.0]], vec![true], vec![0])
                .unwrap();
        let p = &patches(&Columns::Segment.places(&path, &tif), &tif, &map)[0];
        let q = 0.5 - 0.15_f64.sqrt();
        let at = |s: f64, r: usize, c: usize| {
            tif.rate_at(
                map.x.coordinate_mm(c) - 1.0 - 0.4 * s,
                map.y.coordinate_mm(r) - 1.0 - 0.2 * s,
            )
        };
        for (r, c) in [(12, 10), (20, 17), (3, 5)] {
            let expected =
                (5.0 * at(q, r, c) + 8.0 * at(0.5, r, c) + 5.0 * at(1.0 - q, r, c)) / 18.0;
            let found = p.rate_nm_per_s[[r - p.origin.0, c - p.origin.1]];
            // Rounding of a sum of three rates.
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
    }

    #[test]
    fn a_long_segment_is_seen_in_parts_that_are_short_beside_the_tool() {
        let a = Axis::new(-5.0, 0.25, 41).unwrap();
        let g = Grid { x: a, y: a };
        let sigma = 1.0;
        let of = |(r, c): (usize, usize)| {
            (-(a.coordinate_mm(c).powi(2) + a.coordinate_mm(r).powi(2)) / (2.0 * sigma * sigma))
                .exp()
        };
        let tif = Tif::new(g, Array2::from_shape_fn(g.shape(), of)).unwrap();
        // Two standard deviations; slopes by differences are some percent less.
        let longest = longest_part_mm(&tif);
        assert!(longest.iter().all(|mm| (mm / 2.0 - 1.0).abs() < 0.05), "{longest:?}");
        let points = vec![[0.0, 0.0], [12.0, 0.0], [12.0, 1.5]];
        let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
        let places = Columns::Segment.places(&path, &tif);
        assert_eq!([places[0].len(), places[1].len()], [6 * 3, 3]);
        let whole = Columns::Segment.places_in_parts(&path, [f64::INFINITY; 2]);
        assert_eq!(places[1], whole[1]);
        // (1 / 12) integral of exp(-(x - s)^2 / 2) over s from 0 to 12: sqrt(2 pi) / 12 in the middle.
        let at = |x: f64| -> f64 {
            let each = places[0].iter();
            each.map(|p| p.fraction * (-(x - p.position_mm[0]).powi(2) / 2.0).exp()).sum()
        };
        let expected = std::f64::consts::TAU.sqrt() / 12.0;
        for x in [5.0, 6.0, 6.3] {
            // Of three points on two deviations: f^(6) h^7 / 2016000 = 1e-3 at most.
            assert!((at(x) / expected - 1.0).abs() < 1e-3, "{x}: {} {expected}", at(x));
        }
        // So it is in time: the same way, there uniformly.
        let c = [[0.0, 4.0, 0.0, 0.0], [0.0; 4]];
        let t = Trajectory::new(vec![0.0, 3.0], vec![c], vec![true], vec![Some(0)]).unwrap();
        for (a, b) in executed(&t, 1, &tif)[0].iter().zip(&places[0]) {
            // Below: rounding of fractions and of positions of up to 12 mm.
            assert!((a.fraction - b.fraction).abs() < 1e-14);
            assert!((a.position_mm[0] - b.position_mm[0]).abs() < 1e-13);
        }
    }

    #[test]
    fn executed_columns_average_in_time_along_the_motion() {
        // x = u^2 in [0, 1]: the mean of x^2 in time is 1/5 of (1)^2, of a uniform motion 1/3.
        let c = [[0.0, 0.0, 1.0, 0.0], [2.0, 0.0, 0.0, 0.0]];
        let t = Trajectory::new(
            vec![0.0, 1.0, 1.5],
            vec![c, c],
            vec![true, false],
            vec![Some(0), Some(1)],
        )
        .unwrap();
        let (tif, _) = rough();
        let places = executed(&t, 2, &tif);
        let mean = |f: fn(f64) -> f64| -> f64 {
            places[0].iter().map(|p| p.fraction * f(p.position_mm[0])).sum()
        };
        // Below: the rule is exact for these degrees; rounding of sums of three terms.
        assert!((mean(|_| 1.0) - 1.0).abs() < 1e-14);
        assert!((mean(|x| x * x) - 0.2).abs() < 1e-14);
        assert!(places[1].is_empty(), "lifted");
    }

    #[test]
    fn cells_summed_before_the_samples_are_those_of_the_pixels() {
        let (tif, coarse) = rough();
        // Pixels of another pitch than the TIF, of its pitch, and larger ones.
        let place = |x: f64, y: f64, fraction: f64| ToolPlace::new([x, y], fraction);
        let columns = [
            vec![place(1.7, 1.3, 0.4), place(1.9, 1.3, 0.3), place(2.0, 1.45, 0.3)],
            vec![place(-1.0, 0.2, 1.0)],
            vec![place(3.9, 2.32, 0.5), place(0.0, 0.0, 0.5)],
            vec![place(99.0, 0.0, 1.0)],
        ];
        for map in [coarse, of_pitch(0.11, 0.09), of_pitch(0.17, 0.12)] {
            let mut weight = Array2::from_elem(map.shape(), 0.3);
            for size in [1, 2, 5] {
                let cells = PixelCells::new(&tif, &map, &weight, size);
                for column in &columns {
                    let (found, expected) =
                        (cells.by_sums(column).unwrap(), cells.by_pixels(column));
                    assert_eq!(found.origin, expected.origin);
                    assert_eq!(found.rate_nm_per_s.dim(), expected.rate_nm_per_s.dim());
                    let off = &found.rate_nm_per_s - &expected.rate_nm_per_s;
                    // Rounding of some hundred terms of order 10.
                    assert!(off.iter().all(|v| v.abs() < 1e-12), "{size}");
                }
            }
            // A pixel that is not measured: only columns that reach its cell see it.
            weight[[0, 0]] = 0.0;
            let cells = PixelCells::new(&tif, &map, &weight, 2);
            let by_sums = columns.each_ref().map(|column| cells.by_sums(column).is_some());
            assert!(by_sums[0] && !by_sums[2] && by_sums[3], "{by_sums:?}");
        }
    }

    #[test]
    fn a_lifted_tool_removes_nothing() {
        let (tif, map) = rough();
        let path = ToolPath::through(vec![[1.0, 1.0], [1.4, 1.2]], vec![false], vec![0]).unwrap();
        assert_eq!(
            patches(&Columns::Segment.places(&path, &tif), &tif, &map)[0].rate_nm_per_s.len(),
            0
        );
    }
}
