//! Convolution of a large map with a small kernel, tile by tile.
//!
//! The valid part of a convolution needs, for each of its elements, only what the kernel reaches: a tile of it is the
//! valid part of a smaller convolution (overlap-save). What a thread works on stays in its cache, and nothing as large
//! as the map is kept but the result. Tiles overlap by the kernel less one element, for which their transforms are
//! shorter. A tile has two strips of the map side by side, which share one complex transform. The tiles depend on the
//! shapes only: the result does not depend on the number of threads.

use std::sync::Mutex;

use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis, s};
use rayon::prelude::*;

use super::{
    Complex,
    pair_convolution::{PairConvolution, is_quick_size},
};
use crate::precision::Real;

/// Elements of a transform that stays in the cache beside that of another core and the spectrum of the kernel: 12 MiB in
/// double precision.
const CACHED: usize = 3 << 18;

/// How much slower an element of a transform is that does not: measured on 8192 x 8192 elements.
const UNCACHED_COST: f64 = 2.0;

/// Cores that the tiles are laid out for. The result may not depend on how many there are.
const CORES: usize = 2;

/// The valid part of convolutions with one kernel, of one shape.
pub struct Tiles<T> {
    convolution: PairConvolution<T>,
    kernel: (usize, usize),
    shape: (usize, usize),
    /// Rows of a band, columns of a strip.
    part: (usize, usize),
    /// Fields that no thread uses at the moment.
    idle: Mutex<Vec<Array2<Complex<T>>>>,
}

impl<T: Real> Tiles<T> {
    /// Plans for valid parts of this `shape`; `None` where one real transform of `whole` elements is less work.
    pub fn new(kernel: ArrayView2<f64>, shape: (usize, usize), whole: usize) -> Option<Self> {
        if whole <= CACHED {
            return None;
        }
        let (gy, gx) = kernel.dim();
        let work = |n: usize| n as f64 * (n as f64).log2();
        let mut least = 0.5 * UNCACHED_COST * work(whole) / CORES as f64;
        let mut best = None;
        for nx in (gx..=CACHED / gy).filter(|n| is_quick_size(*n)) {
            let strips = shape.1.div_ceil(nx - gx + 1);
            // A column is gathered from as many rows as a tile is high.
            for ny in (gy..=nx.min(CACHED / nx)).filter(|n| is_quick_size(*n)) {
                let bands = shape.0.div_ceil(ny - gy + 1);
                let tiles = strips.div_ceil(2) * bands;
                let cost = tiles.div_ceil(CORES) as f64 * work(ny * nx);
                if cost < least {
                    // Parts of equal size.
                    (least, best) = (
                        cost,
                        Some(((ny, nx), (shape.0.div_ceil(bands), shape.1.div_ceil(strips)))),
                    );
                }
            }
        }
        let (size, part) = best?;
        let convolution = PairConvolution::new(kernel, size);
        Some(Self { convolution, kernel: (gy, gx), shape, part, idle: Mutex::default() })
    }

    /// The valid part of the convolution of `map`, placed at `at` in a field of zeros.
    pub fn valid(&self, map: ArrayView2<f64>, at: (usize, usize)) -> Array2<f64> {
        let mut out = Array2::zeros(self.shape);
        let (rows, columns) = self.part;
        let mut jobs = vec![];
        for (band, mut rest) in out.axis_chunks_iter_mut(Axis(0), rows).enumerate() {
            for column in (0..self.shape.1).step_by(2 * columns) {
                let width = (2 * columns).min(rest.ncols());
                let (tile, right) = rest.split_at(Axis(1), width);
                rest = right;
                jobs.push((band * rows, column, tile));
            }
        }
        let idle = || self.idle.lock().expect("no thread panics with the lock");
        jobs.into_par_iter().with_max_len(1).for_each(|(row, column, tile)| {
            let field = idle().pop();
            let mut field = field.unwrap_or_else(|| Array2::zeros(self.convolution.size()));
            self.tile(map, at, (row, column), tile, &mut field);
            idle().push(field);
        });
        out
    }

    /// The tile whose first element is the one at `first`.
    fn tile(
        &self,
        map: ArrayView2<f64>,
        at: (usize, usize),
        first: (usize, usize),
        mut tile: ArrayViewMut2<f64>,
        field: &mut Array2<Complex<T>>,
    ) {
        let (gy, gx) = self.kernel;
        let rows = tile.nrows() + gy - 1;
        let left = self.part.1.min(tile.ncols());
        let widths = [left, tile.ncols() - left];
        for (r, mut line) in field.outer_iter_mut().enumerate().take(rows) {
            line.fill(Complex::default());
            let Some(row) = (first.0 + r).checked_sub(at.0).filter(|r| *r < map.nrows()) else {
                continue;
            };
            let row = map.row(row);
            let line = line.as_slice_mut().expect("in C order");
            for (strip, width) in widths.into_iter().enumerate() {
                // Column c of the strip is column c + from of the source, which is that of the map less `at`.
                let from = first.1 + strip * left;
                let begin = at.1.saturating_sub(from);
                let end = (width + gx - 1).min((at.1 + map.ncols()).saturating_sub(from));
                if width == 0 || begin >= end {
                    continue;
                }
                let (line, at) = (&mut line[begin..end], from + begin - at.1);
                let values = row.slice(s![at..at + end - begin]);
                if strip == 0 {
                    line.iter_mut().zip(values).for_each(|(l, v)| l.re = T::rounded(*v));
                } else {
                    line.iter_mut().zip(values).for_each(|(l, v)| l.im = T::rounded(*v));
                }
            }
        }
        self.convolution.convolve(field.view_mut(), rows, false, |_| ());
        for (mut row, line) in tile.outer_iter_mut().zip(field.outer_iter().skip(gy - 1)) {
            let (left, right) = row.as_slice_mut().expect("in C order").split_at_mut(left);
            let valid = &line.to_slice().expect("in C order")[gx - 1..];
            left.iter_mut().zip(valid).for_each(|(o, v)| *o = v.re.into());
            right.iter_mut().zip(valid).for_each(|(o, v)| *o = v.im.into());
        }
    }
}
