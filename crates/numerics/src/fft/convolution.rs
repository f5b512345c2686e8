//! Linear convolution with a fixed kernel by real two-dimensional FFTs.
//!
//! For a source `s` (sy, sx) and a kernel `g` (gy, gx), both at least one element,
//!
//! ```text
//! valid[i, j] = sum_{a, b} g[a, b] s[i + gy-1 - a, j + gx-1 - b],   shape (sy-gy+1, sx-gx+1)
//! ```
//!
//! This *valid part* has the elements of the convolution for which the whole kernel lies within the source. A circular
//! convolution of the source's size (rounded up to 2^a 3^b 5^c 7^d) contains it: the wrapped part falls on the first
//! g-1 elements, which are not used. Rows and columns are independent transforms, so the result does not depend on the
//! number of threads. If tiles are less work, as for most maps and tools, sources are convolved tile by tile
//! ([`super::tiles`]).
//!
//! In single precision (`T` = f32) a convolution takes two thirds of the time, and its transforms
//! take half of the memory. Its input and output are in double precision. With the unit roundoff
//! `u`, the `N` elements of the transform and the 1-norm of the kernel
//!
//! ```text
//! rms(error) <= 20 log2(N) u |g|_1 rms(s)                                               (1)
//! ```
//!
//! because a transform has an error of at most `6.7 log2(N) u` of its 2-norm (N. Higham, Accuracy and Stability of
//! Numerical Algorithms, 2nd ed., theorem 24.2), and there are three transforms. Example: for dwell times s, a kernel
//! in nm/s, single precision and 1e6 elements, the bound is 2e-5 of `|g|_1 rms(s)`.

use std::sync::{Arc, OnceLock};

use ndarray::{Array2, ArrayView2, s};
use realfft::{ComplexToReal, RealToComplex};
use rustfft::Fft;

use super::{
    Complex,
    plan::{Planned, Plans},
    smooth_size,
    tiles::Tiles,
};
use crate::parallel;
use crate::vectors::Lanes;

/// Number of columns that a thread transforms at a time: four cache lines of every row. Larger: the
/// columns leave the cache. Smaller: cache lines are read more than once. It does not change the
/// result.
const LINES: usize = 16;

/// Convolution with one kernel, planned for sources of one shape.
pub struct Convolution<T: Lanes + Planned = f64> {
    source: (usize, usize),
    kernel: Array2<f64>,
    size: (usize, usize),
    forward_x: Arc<dyn RealToComplex<T>>,
    inverse_x: Arc<dyn ComplexToReal<T>>,
    forward_y: Arc<dyn Fft<T>>,
    inverse_y: Arc<dyn Fft<T>>,
    /// Spectrum of the kernel, [kx][ky], scaled by 1 / (number of elements); made at its first use.
    spectrum: OnceLock<Vec<Complex<T>>>,
    /// Tiles for the valid part and for its adjoint, made at their first use; `None` if one transform of the whole
    /// array is less work.
    tiles: [OnceLock<Option<Tiles<T>>>; 2],
}

impl<T: Lanes + Planned> Convolution<T> {
    /// Plans the convolution with `kernel` (gy, gx) of sources of the shape `source` (sy, sx), at least as large as
    /// the kernel on both axes.
    pub fn new(kernel: ArrayView2<f64>, source: (usize, usize)) -> Self {
        let (gy, gx) = kernel.dim();
        assert!(
            gy >= 1 && gx >= 1 && source.0 >= gy && source.1 >= gx,
            "kernel exceeds the source"
        );
        let size = (smooth_size(source.0), smooth_size(source.1));
        let Plans { forward_x, inverse_x, forward_y, inverse_y } = T::plans(size);
        Self {
            source,
            kernel: kernel.to_owned(),
            size,
            forward_x,
            inverse_x,
            forward_y,
            inverse_y,
            spectrum: OnceLock::new(),
            tiles: Default::default(),
        }
    }

    /// Returns the valid part of the convolution, `valid` of the module: shape (sy-gy+1, sx-gx+1), in the product of
    /// the units of kernel and source.
    pub fn valid(&self, source: ArrayView2<f64>) -> Array2<f64> {
        assert_eq!(source.dim(), self.source, "shape of the source");
        let (gy, gx) = self.kernel.dim();
        let shape = (self.source.0 - gy + 1, self.source.1 - gx + 1);
        let tiles = self.tiles[0]
            .get_or_init(|| Tiles::new(self.kernel.view(), shape, self.size.0 * self.size.1));
        match tiles {
            Some(tiles) => tiles.valid(source, (0, 0)),
            None => self.through(source, (0, 0), |g| g, (gy - 1, gx - 1), shape),
        }
    }

    /// Applies the adjoint of [`Self::valid`] to a map of the shape of a valid part: `<valid(s), m> = <s,
    /// adjoint(m)>`. The result has the shape of the source.
    pub fn adjoint(&self, map: ArrayView2<f64>) -> Array2<f64> {
        // The kernel is rotated by 180 degrees, and the map is placed in the middle of zeros.
        let turned = self.kernel.slice(s![..;-1, ..;-1]);
        let tiles = self.tiles[1]
            .get_or_init(|| Tiles::new(turned, self.source, self.size.0 * self.size.1));
        match tiles {
            Some(tiles) => tiles.valid(map, self.placed()),
            None => self.filtered(map, |g| g.conj()),
        }
    }

    /// Applies the adjoint with `filter(G)` in place of the complex conjugate of G, where G is the spectrum of the
    /// kernel. `map` has the shape of a valid part, and the result that of the source. A filter near 1 / G gives a
    /// source whose valid part is near `map`.
    pub fn filtered(
        &self,
        map: ArrayView2<f64>,
        filter: impl Fn(Complex<T>) -> Complex<T> + Sync,
    ) -> Array2<f64> {
        self.through(map, self.placed(), self.scaled(filter), (0, 0), self.source)
    }

    /// Applies `filter(G)` to a map of the shape of the source, which continues periodically: with G itself, a circular
    /// convolution whose valid part is [`Self::valid`]. The sides of the source are those of a [`smooth_size`].
    pub fn periodic(
        &self,
        map: ArrayView2<f64>,
        filter: impl Fn(Complex<T>) -> Complex<T> + Sync,
    ) -> Array2<f64> {
        assert_eq!((map.dim(), self.source), (self.size, self.size), "shape of the period");
        self.through(map, (0, 0), self.scaled(filter), (0, 0), self.size)
    }

    /// Returns the filter of the stored spectrum, which has the scale of the inverse transform.
    fn scaled(
        &self,
        filter: impl Fn(Complex<T>) -> Complex<T> + Sync,
    ) -> impl Fn(Complex<T>) -> Complex<T> + Sync {
        let elements = T::rounded((self.size.0 * self.size.1) as f64);
        move |g| filter(g * elements) / elements
    }

    /// Returns the index (row, column) in the source of the first element of the valid part.
    fn placed(&self) -> (usize, usize) {
        (self.kernel.nrows() - 1, self.kernel.ncols() - 1)
    }

    /// Puts `map` at `offset` (row, column) in an array of zeros of the size of the transform, multiplies its spectrum
    /// by `filter` of the stored spectrum of the kernel, and transforms back. Returns the part of the shape `shape`
    /// that starts at the element `from` (row, column).
    fn through(
        &self,
        map: ArrayView2<f64>,
        offset: (usize, usize),
        filter: impl Fn(Complex<T>) -> Complex<T> + Sync,
        from: (usize, usize),
        shape: (usize, usize),
    ) -> Array2<f64> {
        let (py, px) = self.size;
        let kx = px / 2 + 1;
        let rows = map.nrows();
        let spectrum = self.spectrum.get_or_init(|| self.kernel_spectrum());
        let by_rows = self.rows(map, offset.1);
        // [k / LINES][row][k % LINES]
        let mut by_blocks = vec![Complex::<T>::default(); kx.div_ceil(LINES) * shape.0 * LINES];
        let scratch =
            self.forward_y.get_inplace_scratch_len().max(self.inverse_y.get_inplace_scratch_len());
        parallel::consume_with(
            by_blocks.chunks_mut(shape.0 * LINES),
            &|| (vec![Complex::default(); LINES * py], vec![Complex::default(); scratch]),
            &|(columns, scratch), b, out| {
                let first = b * LINES;
                let width = LINES.min(kx - first);
                columns.fill(Complex::default());
                for r in 0..rows {
                    let values = &by_rows[r * kx + first..r * kx + first + width];
                    for (l, v) in values.iter().enumerate() {
                        columns[l * py + offset.0 + r] = *v;
                    }
                }
                for (l, column) in columns.chunks_mut(py).take(width).enumerate() {
                    self.forward_y.process_with_scratch(column, scratch);
                    let g = &spectrum[(first + l) * py..(first + l + 1) * py];
                    column.iter_mut().zip(g).for_each(|(c, g)| *c = *c * filter(*g));
                    self.inverse_y.process_with_scratch(column, scratch);
                }
                for (r, out) in out.chunks_mut(LINES).enumerate() {
                    for (l, out) in out[..width].iter_mut().enumerate() {
                        *out = columns[l * py + from.0 + r];
                    }
                }
            },
        );
        let mut out = Array2::zeros(shape);
        parallel::consume_with(
            out.outer_iter_mut(),
            &|| {
                (
                    vec![Complex::default(); kx],
                    vec![T::default(); px],
                    self.inverse_x.make_scratch_vec(),
                )
            },
            &|(half, line, scratch), r, mut row| {
                for (b, half) in half.chunks_mut(LINES).enumerate() {
                    let start = (b * shape.0 + r) * LINES;
                    half.copy_from_slice(&by_blocks[start..start + half.len()]);
                }
                // These two elements of the transform of a real line are real but for rounding.
                half[0].im = T::default();
                if px % 2 == 0 {
                    half[kx - 1].im = T::default();
                }
                self.inverse_x
                    .process_with_scratch(half, line, scratch)
                    .expect("buffers have the planned sizes");
                row.iter_mut().zip(&line[from.1..]).for_each(|(o, v)| *o = (*v).into());
            },
        );
        out
    }

    /// Returns the spectra [row][kx] of the rows of `map`, each put at column `offset` in a line of zeros.
    fn rows(&self, map: ArrayView2<f64>, offset: usize) -> Vec<Complex<T>> {
        let px = self.size.1;
        let kx = px / 2 + 1;
        let (rows, columns) = map.dim();
        let mut by_rows = vec![Complex::<T>::default(); rows * kx];
        parallel::consume_with(
            by_rows.chunks_mut(kx).zip(map.outer_iter()),
            &|| (vec![T::default(); px], self.forward_x.make_scratch_vec()),
            &|(line, scratch), _, (out, row)| {
                if row.iter().all(|v| *v == 0.0) {
                    return; // the transform of zeros
                }
                line.fill(T::default());
                line[offset..offset + columns]
                    .iter_mut()
                    .zip(row)
                    .for_each(|(l, v)| *l = T::rounded(*v));
                self.forward_x
                    .process_with_scratch(line, out, scratch)
                    .expect("buffers have the planned sizes");
            },
        );
        by_rows
    }

    /// Returns the spectrum [kx][ky] of the kernel, scaled by 1 / (number of elements).
    fn kernel_spectrum(&self) -> Vec<Complex<T>> {
        let py = self.size.0;
        let kx = self.size.1 / 2 + 1;
        let by_rows = self.rows(self.kernel.view(), 0);
        let scale = T::rounded(1.0 / (self.size.0 * self.size.1) as f64);
        let mut by_columns = vec![Complex::<T>::default(); kx * py];
        parallel::consume_with(
            by_columns.chunks_mut(py),
            &|| vec![Complex::default(); self.forward_y.get_inplace_scratch_len()],
            &|scratch, k, column| {
                for (r, value) in column[..self.kernel.nrows()].iter_mut().enumerate() {
                    *value = by_rows[r * kx + k];
                }
                self.forward_y.process_with_scratch(column, scratch);
                column.iter_mut().for_each(|v| *v = *v * scale);
            },
        );
        by_columns
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random(shape: (usize, usize), seed: u64) -> Array2<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Array2::from_shape_simple_fn(shape, || rng.random_range(-1.0..1.0))
    }

    /// Computes the valid part of the convolution of the kernel g with the source s by its definition.
    fn by_definition(g: &Array2<f64>, s: &Array2<f64>) -> Array2<f64> {
        let ((gy, gx), (sy, sx)) = (g.dim(), s.dim());
        Array2::from_shape_fn((sy - gy + 1, sx - gx + 1), |(i, j)| {
            g.indexed_iter().map(|((a, b), v)| v * s[[i + gy - 1 - a, j + gx - 1 - b]]).sum()
        })
    }

    #[test]
    fn agrees_with_the_definition_for_odd_and_even_sizes() {
        for (g, s) in [((1, 1), (1, 1)), ((3, 4), (11, 13)), ((5, 2), (5, 16)), ((4, 7), (22, 9))] {
            let (g, s) = (random(g, 1), random(s, 2));
            let plan = Convolution::<f64>::new(g.view(), s.dim());
            let error = &plan.valid(s.view()) - &by_definition(&g, &s);
            // Sums of at most 28 products of order 1.
            assert!(error.iter().all(|e| e.abs() < 1e-13), "{error:?}");
        }
    }

    #[test]
    fn adjoint_is_the_adjoint() {
        let (g, s) = (random((4, 3), 3), random((17, 12), 4));
        let plan = Convolution::<f64>::new(g.view(), s.dim());
        let forward = plan.valid(s.view());
        let m = random(forward.dim(), 5);
        let left: f64 = (&forward * &m).sum();
        let right: f64 = (&plan.adjoint(m.view()) * &s).sum();
        // The two sums of about 200 terms of order 1 differ by rounding.
        assert!((left - right).abs() < 1e-12 * left.abs().max(1.0), "{left} {right}");
    }

    #[test]
    fn the_inverse_filter_is_the_inverse() {
        // A kernel without zeros in its spectrum: the centre outweighs the rest.
        let mut g = random((5, 4), 6) * 0.04;
        g[[2, 1]] = 1.0;
        let source = (17, 12);
        let plan = Convolution::<f64>::new(g.view(), source);
        let map = random((13, 9), 7);
        let found = plan.filtered(map.view(), |g| 1.0 / g);
        let error = &plan.valid(found.view()) - &map;
        // 18 x 12 samples, condition number below 10.
        assert!(error.iter().all(|e| e.abs() < 1e-13), "{error:?}");
    }

    #[test]
    fn a_periodic_filter_contains_the_valid_part_and_is_undone_by_its_inverse() {
        let mut g = random((5, 4), 6) * 0.04;
        g[[2, 1]] = 1.0;
        let source = random((18, 12), 11);
        let plan = Convolution::<f64>::new(g.view(), source.dim());
        let convolved = plan.periodic(source.view(), |g| g);
        let valid = &convolved.slice(s![4.., 3..]) - &plan.valid(source.view());
        let back = &plan.periodic(convolved.view(), |g| 1.0 / g) - &source;
        // 18 x 12 samples, condition number below 10.
        assert!(valid.iter().chain(&back).all(|e| e.abs() < 1e-13));
    }

    #[test]
    fn tiles_give_the_same_as_one_transform() {
        // One column of tiles, whose parts differ in size, and a second strip.
        for source in [(4000, 500), (900, 1500)] {
            let (g, s) = (random((21, 34), 8), random(source, 9));
            let plan = Convolution::<f64>::new(g.view(), source);
            let shape = (source.0 - 20, source.1 - 33);
            let one = plan.through(s.view(), (0, 0), |g| g, plan.placed(), shape);
            let m = random(shape, 10);
            let adjoint = plan.filtered(m.view(), |g| g.conj());
            let pairs = [(plan.valid(s.view()), one), (plan.adjoint(m.view()), adjoint)];
            assert!(plan.tiles.iter().all(|t| t.get().is_some_and(Option::is_some)));
            for (tiles, one) in pairs {
                // Sums of 714 products of order 1, through a transform.
                assert!((&tiles - &one).iter().all(|e| e.abs() < 1e-12));
            }
        }
    }

    #[test]
    fn single_precision_errs_by_less_than_its_bound() {
        // One transform, and tiles; a kernel without a sign as a TIF, so that the sums do not cancel.
        for source in [(150, 90), (900, 1500)] {
            let (g, s) = (random((21, 34), 11).mapv(f64::abs), random(source, 12).mapv(f64::abs));
            let (double, single) = (
                Convolution::<f64>::new(g.view(), source),
                Convolution::<f32>::new(g.view(), source),
            );
            let rms = |a: &Array2<f64>| (a.mapv(|v| v * v).sum() / a.len() as f64).sqrt();
            let unit_roundoff = 0.5 * f64::from(f32::EPSILON);
            let bound = |n: usize| 20.0 * (n as f64).log2() * unit_roundoff * g.sum();
            let exact = double.valid(s.view());
            let error = rms(&(&single.valid(s.view()) - &exact));
            // Bound (1) for the number of elements of the whole source, of which a tile is a part.
            // The error found is of the size of single-precision rounding.
            assert!(error < bound(s.len()) * rms(&s), "{error}");
            assert!(error > 0.01 * unit_roundoff * rms(&exact), "{error}");
            let adjoint = double.adjoint(exact.view());
            let error = rms(&(&single.adjoint(exact.view()) - &adjoint));
            assert!(error < bound(s.len()) * rms(&exact), "{error}");
        }
    }

    #[test]
    fn smooth_sizes() {
        assert_eq!([1, 7, 11, 13, 121, 1013].map(smooth_size), [1, 7, 12, 14, 125, 1024]);
    }
}
