//! The removal by a few columns, on the pixels that they reach.

use std::{borrow::Cow, ops::Range};

use ndarray::{Array2, s};
use planish_numerics::fft::convolution::Convolution;
use planish_types::{Grid, Tif};

use super::lattice::{Lattice, Placed, Spread, kernel, placed, samples, without_ghosts};
use crate::model::{
    columns::{Patch, ToolPlace},
    varying,
};

/// Computes the removal by a few columns at a time, on the pixels that they reach. The columns are those of
/// `FftOperator::without_border`.
pub struct Sums {
    kernels: Vec<KernelSums>,
    /// Factor of the removal at every pixel, if the tool has one.
    factor: Option<Array2<f64>>,
}

/// [`Sums`] of one kernel of the tool.
struct KernelSums {
    x: Lattice,
    y: Lattice,
    placed: Vec<Placed>,
    /// Index in `placed` of the first place of every column: those of column j are `first[j] .. first[j + 1]`.
    first: Vec<u32>,
    /// Shape (y, x) of the nodes on which the columns of one call may be spread, for which `correlation` is planned.
    room: (usize, usize),
    correlation: Convolution,
}

impl Sums {
    /// Prepares the computation, on the pixels of `grid`. The places of the columns of one call must lie within a
    /// square with the side `size_mm`.
    pub fn new(
        places: &[Vec<ToolPlace>],
        tif: &Tif,
        grid: &Grid,
        size_mm: f64,
        spread: Spread,
    ) -> Self {
        let kernels = varying::kernels(places, tif)
            .map(|(kernel, places)| KernelSums::new(&places, kernel, grid, size_mm, spread))
            .collect();
        let factor = tif.variation().and_then(|v| v.factor_on(grid)).map(Cow::into_owned);
        Self { kernels, factor }
    }

    /// Returns the ranges of the pixels (y, x) that the columns with these indices reach.
    pub fn extent(&self, columns: impl Iterator<Item = usize>) -> (Range<usize>, Range<usize>) {
        // All kernels have one grid, and reach the same pixels.
        self.kernels[0].extent(columns)
    }

    /// Returns the removal `sum_j t_j B_j` of some columns, given as pairs (j, t_j), on a rectangle of pixels; empty if
    /// they reach no pixel. Panics if their places exceed the prepared square.
    pub fn patch(&self, t: &[(usize, f64)]) -> Patch {
        let kernels = self.kernels.iter().map(|kernel| kernel.patch(t));
        let sum = kernels.reduce(|mut sum, patch| {
            sum.rate_nm_per_s += &patch.rate_nm_per_s;
            sum
        });
        let mut patch = sum.unwrap_or_default();
        if let Some(factor) = &self.factor {
            patch.times(factor);
        }
        patch
    }
}

impl KernelSums {
    fn new(
        places: &[Vec<ToolPlace>],
        tif: &Tif,
        grid: &Grid,
        size_mm: f64,
        spread: Spread,
    ) -> Self {
        let [x, y] = [0, 1].map(|axis| Lattice::new(grid, tif, axis, spread));
        // In the order of the columns.
        let placed = placed(places, &x, &y);
        let first = (0..=places.len())
            .map(|j| placed.partition_point(|p| (p.column as usize) < j) as u32)
            .collect();
        let [ny, nx] = [y, x].map(|lattice| (size_mm / lattice.step_mm).ceil() as usize + 5);
        let room = (ny, nx);
        let correlation =
            full_correlation(&kernel(&without_ghosts(samples(tif, &x, &y)), spread), room);
        Self { x, y, placed, first, room, correlation }
    }

    /// Returns the places of a column on the lattice, without those that do not reach the map.
    fn places(&self, column: usize) -> &[Placed] {
        &self.placed[self.first[column] as usize..self.first[column + 1] as usize]
    }

    /// Returns the first and the last node [y, x] on which the columns are spread; `None` if none of their places
    /// reaches the map.
    fn nodes(&self, columns: impl Iterator<Item = usize>) -> Option<[[isize; 2]; 2]> {
        let cells = columns.flat_map(|j| self.places(j)).map(|p| p.cell.map(|c| c as isize));
        let ends = cells.map(|c| [c.map(|c| c - 1), c.map(|c| c + 2)]);
        ends.reduce(|[a, b], [c, d]| {
            [[a[0].min(c[0]), a[1].min(c[1])], [b[0].max(d[0]), b[1].max(d[1])]]
        })
    }

    /// Returns the ranges of the pixels (y, x) that the tool reaches from the nodes between `low` and `high`, [y, x].
    fn pixels(&self, [low, high]: [[isize; 2]; 2]) -> (Range<usize>, Range<usize>) {
        let [rows, columns] = [(0, self.y), (1, self.x)].map(|(axis, l)| {
            let to = (high[axis] + l.last + 1).clamp(0, l.pixels as isize) as usize;
            ((low[axis] - 1).max(0) as usize).min(to)..to
        });
        (rows, columns)
    }

    /// Returns the ranges of the pixels (y, x) that the columns with these indices reach.
    fn extent(&self, columns: impl Iterator<Item = usize>) -> (Range<usize>, Range<usize>) {
        self.nodes(columns).map_or((0..0, 0..0), |nodes| self.pixels(nodes))
    }

    /// Returns the removal `sum_j t_j B_j` by this kernel of some columns, given as pairs (j, t_j).
    fn patch(&self, t: &[(usize, f64)]) -> Patch {
        let Some(nodes) = self.nodes(t.iter().map(|(j, _)| *j)) else { return Patch::default() };
        let (rows, columns) = self.pixels(nodes);
        if rows.is_empty() || columns.is_empty() {
            return Patch::default();
        }
        let [low, high] = nodes;
        let [height, width] = [0, 1].map(|axis| (high[axis] - low[axis] + 1) as usize);
        let fits = height <= self.room.0 && width <= self.room.1;
        assert!(fits, "columns within the planned square");
        let mut seconds = Array2::zeros(self.room);
        for (p, t) in t.iter().flat_map(|(j, t)| self.places(*j).iter().map(move |p| (p, t))) {
            let wy = self.y.weights(p.offset[0]);
            let wx = self.x.weights(p.offset[1]);
            let [first_r, first_c] =
                [0, 1].map(|axis| (p.cell[axis] as isize - 1 - low[axis]) as usize);
            for (r, wy) in wy.iter().enumerate() {
                for (c, wx) in wx.iter().enumerate() {
                    seconds[[first_r + r, first_c + c]] += t * p.fraction * wy * wx;
                }
            }
        }
        // From the pixel before the first node on.
        let all = self.correlation.adjoint(seconds.view());
        let r = (rows.start as isize - low[0] + 1) as usize;
        let c = (columns.start as isize - low[1] + 1) as usize;
        let rate = all.slice(s![r..r + rows.len(), c..c + columns.len()]).to_owned();
        Patch { origin: (rows.start, columns.start), rate_nm_per_s: rate }
    }
}

/// Prepares the full convolution of `samples` with a source of at most the shape `room`, as the adjoint of a
/// convolution.
fn full_correlation(samples: &Array2<f64>, room: (usize, usize)) -> Convolution {
    let (my, mx) = samples.dim();
    let reversed = samples.slice(s![..;-1, ..;-1]);
    Convolution::new(reversed, (room.0 + my - 1, room.1 + mx - 1))
}
