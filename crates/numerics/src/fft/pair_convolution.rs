//! Convolution of two real sources at once with fixed real kernels.
//!
//! A real kernel convolves the real and the imaginary part of a source independently: two sources
//! share one complex transform, which takes about two thirds of the time of two real ones. The
//! sizes are those of [`quick_size`], the transforms in place, and every line is transformed by
//! itself, so that the result does not depend on the number of threads.
//!
//! A circular convolution of `n` elements contains the part that never leaves a source of
//! `s <= n` elements: `valid[i] = circular[i + g - 1]`, i = 0 .. s-g.

use std::sync::Arc;

use ndarray::{ArrayView2, ArrayViewMut2, Axis};
use rayon::prelude::*;
use rustfft::{Fft, FftPlanner};

use super::{Complex, Complex64};
use crate::precision::Real;

/// Columns that are transformed together: 256 bytes of a row, which the processor fetches ahead.
const COLUMNS: usize = 16;

/// Products that are summed in one pass over a line.
const TERMS: usize = 3;

/// Whether a transform of `n` elements is among the quickest of its length: 2^a times 1, 3, 5, 9
/// or 27, as measured on `rustfft` 6.4 with AVX.
pub fn is_quick_size(n: usize) -> bool {
    n > 0 && [1, 3, 5, 9, 27].contains(&(n >> n.trailing_zeros()))
}

/// The smallest quick size `>= n`.
pub fn quick_size(n: usize) -> usize {
    (n.max(1)..).find(|n| is_quick_size(*n)).expect("powers of two are unbounded")
}

struct Transform<T> {
    forward: Arc<dyn Fft<T>>,
    inverse: Arc<dyn Fft<T>>,
    scratch: usize,
}

impl<T: Real> Transform<T> {
    fn new(planner: &mut FftPlanner<T>, n: usize) -> Self {
        let (forward, inverse) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
        let scratch = forward.get_inplace_scratch_len().max(inverse.get_inplace_scratch_len());
        Self { forward, inverse, scratch }
    }

    fn scratch(&self) -> Vec<Complex<T>> {
        vec![Complex::default(); self.scratch]
    }
}

/// Two-dimensional convolution with one kernel.
pub struct PairConvolution<T = f64> {
    kernel_rows: usize,
    size: (usize, usize),
    x: Transform<T>,
    y: Transform<T>,
    /// Spectrum of the kernel, [kx][ky], scaled by 1 / (number of elements).
    spectrum: Vec<Complex<T>>,
}

impl<T: Real> PairConvolution<T> {
    /// Plans for fields of shape `size`, at least as large as the kernel (gy, gx) on both axes.
    pub fn new(kernel: ArrayView2<f64>, size: (usize, usize)) -> Self {
        let (gy, gx) = kernel.dim();
        assert!(gy >= 1 && gx >= 1 && size.0 >= gy && size.1 >= gx, "kernel exceeds the field");
        let mut planner = FftPlanner::new();
        let (x, y) = (Transform::new(&mut planner, size.1), Transform::new(&mut planner, size.0));
        let mut rows = vec![Complex::<T>::default(); gy * size.1];
        rows.par_chunks_mut(size.1).zip(kernel.outer_iter().into_par_iter()).for_each_init(
            || x.scratch(),
            |scratch, (line, row)| {
                line.iter_mut().zip(row).for_each(|(l, g)| l.re = T::rounded(*g));
                x.forward.process_with_scratch(line, scratch);
            },
        );
        let scale = T::rounded(1.0 / (size.0 * size.1) as f64);
        let mut spectrum = vec![Complex::default(); size.0 * size.1];
        spectrum.par_chunks_mut(size.0).enumerate().for_each_init(
            || y.scratch(),
            |scratch, (k, column)| {
                for r in 0..gy {
                    column[r] = rows[r * size.1 + k] * scale;
                }
                y.forward.process_with_scratch(column, scratch);
            },
        );
        Self { kernel_rows: gy, size, x, y, spectrum }
    }

    /// The shape (ny, nx) of the fields.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Replaces the rows gy-1 .. `rows` of `field` by those of its circular convolution; the rows
    /// from `rows` on are zero. The first gy-1 rows are spoilt. `adjust` may change the spectra of
    /// these rows, one after the other, before they are transformed back. With `parallel` the lines
    /// are shared among the threads.
    pub fn convolve(
        &self,
        mut field: ArrayViewMut2<Complex<T>>,
        rows: usize,
        parallel: bool,
        adjust: impl FnOnce(&mut [Complex<T>]),
    ) {
        assert_eq!(field.dim(), self.size, "shape of the field");
        let shared = if parallel { 1 } else { usize::MAX };
        let (ny, nx) = self.size;
        let first = self.kernel_rows - 1;
        let lines = field.as_slice_mut().expect("in C order");

        let used: Vec<bool> = lines[..rows * nx]
            .par_chunks_mut(nx)
            .with_min_len(shared)
            .map_init(
                || self.x.scratch(),
                |scratch, line| {
                    let used = line.iter().any(|v| *v != Complex::default());
                    if used {
                        self.x.forward.process_with_scratch(line, scratch);
                    }
                    used
                },
            )
            .collect();
        let empty = Complex::<T>::default();
        field
            .axis_chunks_iter_mut(Axis(1), COLUMNS)
            .into_par_iter()
            .zip(self.spectrum.par_chunks(COLUMNS * ny))
            .with_min_len(shared)
            .for_each_init(
                || (vec![empty; COLUMNS * ny], self.y.scratch()),
                |(columns, scratch), (mut part, spectrum)| {
                    let width = part.ncols();
                    let columns = &mut columns[..width * ny];
                    columns.fill(empty);
                    for r in (0..rows).filter(|r| used[*r]) {
                        let row = part.row(r);
                        let row = row.to_slice().expect("in C order");
                        (0..width).for_each(|k| columns[k * ny + r] = row[k]);
                    }
                    self.y.forward.process_with_scratch(columns, scratch);
                    columns.iter_mut().zip(spectrum).for_each(|(s, g)| *s = *s * *g);
                    self.y.inverse.process_with_scratch(columns, scratch);
                    for r in first..rows {
                        let mut row = part.row_mut(r);
                        let row = row.as_slice_mut().expect("in C order");
                        (0..width).for_each(|k| row[k] = columns[k * ny + r]);
                    }
                },
            );
        let lines = &mut field.as_slice_mut().expect("in C order")[first * nx..rows * nx];
        adjust(lines);
        lines.par_chunks_mut(nx).with_min_len(shared).for_each_init(
            || self.x.scratch(),
            |scratch, line| self.x.inverse.process_with_scratch(line, scratch),
        );
    }
}

/// Convolutions along one axis with several kernels. Their sum is made of the spectra, and the
/// spectrum of a source serves all kernels.
pub struct LineConvolution {
    size: usize,
    transform: Transform<f64>,
    /// Spectra of the kernels, [j][k], scaled by 1 / (number of elements).
    spectrum: Vec<Complex64>,
}

impl LineConvolution {
    /// Plans for kernels (m, g) and lines of `size >= g` elements.
    pub fn new(kernels: ArrayView2<f64>, size: usize) -> Self {
        let (m, g) = kernels.dim();
        assert!(g >= 1 && size >= g, "kernel exceeds the line");
        let transform = Transform::new(&mut FftPlanner::new(), size);
        let mut spectrum = vec![Complex64::default(); m * size];
        let mut scratch = transform.scratch();
        for (line, g) in spectrum.chunks_mut(size).zip(kernels.outer_iter()) {
            line.iter_mut().zip(g).for_each(|(l, g)| l.re = g / size as f64);
            transform.forward.process_with_scratch(line, &mut scratch);
        }
        Self { size, transform, spectrum }
    }

    /// Elements of a line.
    pub fn size(&self) -> usize {
        self.size
    }

    /// A buffer for [`Self::forward`] and [`Self::inverse`].
    pub fn scratch(&self) -> Vec<Complex64> {
        self.transform.scratch()
    }

    /// The spectra of whole lines, one after the other.
    pub fn forward(&self, lines: &mut [Complex64], scratch: &mut [Complex64]) {
        self.transform.forward.process_with_scratch(lines, scratch);
    }

    /// The lines of sums of [`Self::subtract`].
    pub fn inverse(&self, lines: &mut [Complex64], scratch: &mut [Complex64]) {
        self.transform.inverse.process_with_scratch(lines, scratch);
    }

    /// Subtracts the convolutions of these (kernel, spectrum of a source): `sum -= g_j s` for each.
    pub fn subtract(&self, sum: &mut [Complex64], terms: &[(usize, &[Complex64])]) {
        let mut terms = terms.chunks_exact(TERMS);
        for some in &mut terms {
            self.subtract_some::<TERMS>(sum, some);
        }
        for one in terms.remainder().chunks_exact(1) {
            self.subtract_some::<1>(sum, one);
        }
    }

    fn subtract_some<const N: usize>(
        &self,
        sum: &mut [Complex64],
        terms: &[(usize, &[Complex64])],
    ) {
        let n = self.size;
        let sum = &mut sum[..n];
        let factors: [(&[Complex64], &[Complex64]); N] = std::array::from_fn(|t| {
            let (j, source) = terms[t];
            (&self.spectrum[j * n..][..n], &source[..n])
        });
        for k in 0..n {
            let mut rest = sum[k];
            for (g, s) in &factors {
                rest -= g[k] * s[k];
            }
            sum[k] = rest;
        }
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn random(shape: (usize, usize), seed: u64) -> Array2<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Array2::from_shape_simple_fn(shape, || rng.random_range(-1.0..1.0))
    }

    #[test]
    fn both_parts_are_convolved() {
        for (g, s, n) in
            [((1, 1), (1, 1), (1, 1)), ((3, 4), (11, 13), (12, 16)), ((5, 2), (5, 9), (8, 9))]
        {
            let (g, re, im) = (random(g, 1), random(s, 2), random(s, 3));
            let plan = PairConvolution::new(g.view(), n);
            let source = |p: &Array2<f64>, r, c| if r < s.0 && c < s.1 { p[[r, c]] } else { 0.0 };
            for parallel in [false, true] {
                let mut field = Array2::from_shape_fn(n, |(r, c)| {
                    Complex64::new(source(&re, r, c), source(&im, r, c))
                });
                plan.convolve(field.view_mut(), s.0, parallel, |_| ());
                let (gy, gx) = g.dim();
                for (i, j) in (0..=s.0 - gy).flat_map(|i| (0..=s.1 - gx).map(move |j| (i, j))) {
                    // the definition
                    let of = |s: &Array2<f64>| -> f64 {
                        let term = |((a, b), v): ((usize, usize), &f64)| {
                            v * s[[i + gy - 1 - a, j + gx - 1 - b]]
                        };
                        g.indexed_iter().map(term).sum()
                    };
                    let found = field[[i + gy - 1, j + gx - 1]];
                    // Sums of at most 12 products of order 1.
                    assert!(
                        (found.re - of(&re)).abs() < 1e-13 && (found.im - of(&im)).abs() < 1e-13
                    );
                }
            }
        }
    }

    #[test]
    fn lines_with_several_kernels_are_summed() {
        let (g, s) = (random((3, 4), 8), random((3, 15), 9));
        let plan = LineConvolution::new(g.view(), 16);
        let mut scratch = plan.scratch();
        let mut lines = vec![Complex64::default(); 3 * 16];
        for ((j, i), s) in s.indexed_iter() {
            lines[j * 16 + i] = Complex64::new(*s, -2.0 * s);
        }
        plan.forward(&mut lines, &mut scratch);
        let terms = [0, 2].map(|j| (j, &lines[j * 16..(j + 1) * 16]));
        let mut found = vec![Complex64::default(); 16];
        plan.subtract(&mut found, &terms);
        plan.inverse(&mut found, &mut scratch);
        for i in 0..12 {
            let of = |j: usize| (0..4).map(|b| g[[j, b]] * s[[j, i + 3 - b]]).sum::<f64>();
            let expected = of(0) + of(2);
            // Sums of 8 products of order 1.
            assert!((found[i + 3].re + expected).abs() < 1e-13);
            assert!((found[i + 3].im - 2.0 * expected).abs() < 1e-13);
        }
    }

    #[test]
    fn quick_sizes() {
        assert_eq!(
            [1, 7, 33, 276, 355, 601, 1025].map(quick_size),
            [1, 8, 36, 288, 384, 640, 1152]
        );
    }
}
