//! Convolution of a map with a smaller kernel, tile by tile.
//!
//! Each element of the valid part needs only the part of the map under the kernel. A tile of it is
//! therefore the valid part of a smaller convolution (overlap-save). The data of a thread stays in
//! its cache, and only the result is as large as the map. Tiles overlap by the kernel less one
//! element; in return, their transforms are shorter. A tile consists of two adjoining strips of the
//! map, which share one complex transform. The tiles depend on the shapes only, so the result does
//! not depend on the number of threads.

use std::sync::{Mutex, MutexGuard};

use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis};

use super::{
    lane_convolution::{LaneConvolution, Strips, Workspace, field_size, is_field_size},
    lanes::round,
};
use crate::parallel;
use crate::vectors::Lanes;

/// Number of cores for which the sizes of the tiles are chosen. It is fixed, because the result must not depend on the
/// number of cores. Larger: more and smaller tiles, with more overlap. Smaller: cores are idle on small maps.
const CORES: usize = 2;

/// Plan of the convolutions with one kernel whose valid parts have one shape, tile by tile.
pub struct Tiles<T> {
    convolution: LaneConvolution<T>,
    kernel: (usize, usize),
    shape: (usize, usize),
    /// Size of the parts of the result: rows of a band, and columns of a strip. A tile has two strips.
    part: (usize, usize),
    /// Buffers that no thread uses at present.
    idle: Mutex<Vec<Workspace<T>>>,
}

/// Returns an estimate of the work of the forward and inverse transform of a field of (ny, nx) complex elements. The
/// unit is the arithmetic of one element in one level of a transform. Reading, transposing and writing take as long as
/// eight levels, and a field that exceeds the cache takes longer. Both were measured in double precision on fields of
/// 384 x 384 to 1536 x 1024 elements.
pub fn field_work<T>((ny, nx): (usize, usize)) -> f64 {
    let elements = (ny * nx) as f64;
    let bytes = elements * 2.0 * size_of::<T>() as f64;
    let memory = if bytes <= 6.5e6 {
        1.0
    } else if bytes <= 13e6 {
        1.35
    } else {
        1.7
    };
    elements * (elements.log2() + 8.0) * memory
}

impl<T: Lanes> Tiles<T> {
    /// Plans tiles for valid parts of this `shape` (rows, columns). `None` if one transform of the whole array, of
    /// `whole` real elements, is not more work.
    pub fn new(kernel: ArrayView2<f64>, shape: (usize, usize), whole: usize) -> Option<Self> {
        let (gy, gx) = kernel.dim();
        // Two real elements count as one complex one, gathering and scattering of lines as a factor
        // of 2, and all cores work.
        let mut least = field_work::<T>((whole.div_ceil(2), 1)) * 2.0 / CORES as f64;
        let mut best = None;
        let nxs = sizes(gx, shape.1);
        let nys = sizes(gy, shape.0);
        for nx in nxs {
            let strips = shape.1.div_ceil(nx - gx + 1);
            for &ny in &nys {
                let bands = shape.0.div_ceil(ny - gy + 1);
                let tiles = strips.div_ceil(2) * bands;
                let cost = tiles.div_ceil(CORES) as f64 * field_work::<T>((ny, nx));
                if cost < least {
                    // Parts of equal size.
                    let part = (shape.0.div_ceil(bands), shape.1.div_ceil(strips));
                    least = cost;
                    best = Some(((ny, nx), part));
                }
            }
        }
        let (size, part) = best?;
        let convolution = LaneConvolution::new(kernel, size);
        Some(Self { convolution, kernel: (gy, gx), shape, part, idle: Mutex::default() })
    }

    /// Returns the valid part of the convolution of `map`, which is put at `offset` (row, column) in a field of zeros.
    pub fn valid(&self, map: ArrayView2<f64>, offset: (usize, usize)) -> Array2<f64> {
        let map = map.as_standard_layout();
        let data = map.as_slice().expect("in C order");
        let source = Source { data, shape: map.dim(), offset };
        let mut out = Array2::zeros(self.shape);
        let (rows, columns) = self.part;
        let mut jobs = vec![];
        for (band, mut rest) in out.axis_chunks_iter_mut(Axis(0), rows).enumerate() {
            for column in (0..self.shape.1).step_by(2 * columns) {
                let width = (2 * columns).min(rest.ncols());
                let (tile, right) = rest.split_at(Axis(1), width);
                rest = right;
                jobs.push(Tile { source, first: (band * rows, column), columns, out: tile });
            }
        }
        let (gy, gx) = self.kernel;
        parallel::consume(jobs, &|_, mut tile| {
            let mut work = self.idle().pop().unwrap_or_default();
            let source = (tile.out.nrows() + gy - 1, columns.min(tile.out.ncols()) + gx - 1);
            self.convolution.convolve(source, &mut tile, &mut work);
            self.idle().push(work);
        });
        out
    }

    /// Returns the list of the buffers that no thread is using, locked.
    fn idle(&self) -> MutexGuard<'_, Vec<Workspace<T>>> {
        self.idle.lock().expect("no thread panics with the lock")
    }
}

/// Returns the possible sizes of a field along an axis, for a kernel of `g` elements and a valid part of `valid`
/// elements in all. The largest one has room for the whole valid part.
fn sizes(g: usize, valid: usize) -> Vec<usize> {
    (g..=field_size(valid + g - 1)).filter(|n| is_field_size(*n)).collect()
}

/// A map in C order, put at an offset (row, column) in a field of zeros.
#[derive(Clone, Copy)]
struct Source<'a> {
    data: &'a [f64],
    shape: (usize, usize),
    offset: (usize, usize),
}

impl Source<'_> {
    /// Reads elements of row `row` of the field, from `column` on, until `to` is full; zero outside the map.
    #[inline(always)]
    fn read<T: Lanes>(&self, row: usize, column: usize, to: &mut [T]) {
        let (rows, columns) = self.shape;
        if row < self.offset.0 || row - self.offset.0 >= rows {
            to.fill(T::default());
            return;
        }
        let line = &self.data[(row - self.offset.0) * columns..][..columns];
        if column >= self.offset.1
            && let Some(values) =
                line.get(column - self.offset.1..column - self.offset.1 + to.len())
        {
            round(values, to);
            return;
        }
        for (k, to) in to.iter_mut().enumerate() {
            let value = (column + k).checked_sub(self.offset.1).and_then(|c| line.get(c));
            *to = T::rounded(value.copied().unwrap_or(0.0));
        }
    }
}

/// A tile: a part of the result, and the map that it is computed from.
struct Tile<'a> {
    source: Source<'a>,
    /// Row and column of its first element in the result.
    first: (usize, usize),
    /// Number of columns of its left strip.
    columns: usize,
    out: ArrayViewMut2<'a, f64>,
}

impl<T: Lanes> Strips<T> for Tile<'_> {
    #[inline(always)]
    fn read(&self, row: usize, column: usize, left: &mut [T], right: &mut [T]) {
        let row = self.first.0 + row;
        let column = self.first.1 + column;
        self.source.read(row, column, left);
        self.source.read(row, column + self.columns, right);
    }

    #[inline(always)]
    fn write(&mut self, row: usize, column: usize, left: &[T], right: &[T]) {
        let mut row = self.out.row_mut(row);
        let row = row.as_slice_mut().expect("in C order");
        let (left_row, right_row) = row.split_at_mut(self.columns.min(row.len()));
        for (to, value) in left_row[column..].iter_mut().zip(left) {
            *to = (*value).into();
        }
        if let Some(right_row) = right_row.get_mut(column..) {
            for (to, value) in right_row.iter_mut().zip(right) {
                *to = (*value).into();
            }
        }
    }
}
