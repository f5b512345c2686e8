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

use super::Complex64;

/// Columns that are transformed together: 128 bytes of a row.
const COLUMNS: usize = 8;

/// Whether a transform of `n` elements is among the quickest of its length: 2^a times 1, 3, 5, 9
/// or 27, as measured on `rustfft` 6.4 with AVX.
pub fn is_quick_size(n: usize) -> bool {
    n > 0 && [1, 3, 5, 9, 27].contains(&(n >> n.trailing_zeros()))
}

/// The smallest quick size `>= n`.
pub fn quick_size(n: usize) -> usize {
    (n.max(1)..).find(|n| is_quick_size(*n)).expect("powers of two are unbounded")
}

struct Transform {
    forward: Arc<dyn Fft<f64>>,
    inverse: Arc<dyn Fft<f64>>,
    scratch: usize,
}

impl Transform {
    fn new(planner: &mut FftPlanner<f64>, n: usize) -> Self {
        let (forward, inverse) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
        let scratch = forward.get_inplace_scratch_len().max(inverse.get_inplace_scratch_len());
        Self { forward, inverse, scratch }
    }

    fn scratch(&self) -> Vec<Complex64> {
        vec![Complex64::default(); self.scratch]
    }
}

/// Two-dimensional convolution with one kernel.
pub struct PairConvolution {
    kernel_rows: usize,
    size: (usize, usize),
    x: Transform,
    y: Transform,
    /// Spectrum of the kernel, [kx][ky], scaled by 1 / (number of elements).
    spectrum: Vec<Complex64>,
}

impl PairConvolution {
    /// Plans for fields of shape `size`, at least as large as the kernel (gy, gx) on both axes.
    pub fn new(kernel: ArrayView2<f64>, size: (usize, usize)) -> Self {
        let (gy, gx) = kernel.dim();
        assert!(gy >= 1 && gx >= 1 && size.0 >= gy && size.1 >= gx, "kernel exceeds the field");
        let mut planner = FftPlanner::new();
        let (x, y) = (Transform::new(&mut planner, size.1), Transform::new(&mut planner, size.0));
        let mut rows = vec![Complex64::default(); gy * size.1];
        rows.par_chunks_mut(size.1).zip(kernel.outer_iter().into_par_iter()).for_each_init(
            || x.scratch(),
            |scratch, (line, row)| {
                line.iter_mut().zip(row).for_each(|(l, g)| l.re = *g);
                x.forward.process_with_scratch(line, scratch);
            },
        );
        let scale = 1.0 / (size.0 * size.1) as f64;
        let mut spectrum = vec![Complex64::default(); size.0 * size.1];
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
    /// from `rows` on are zero. The first gy-1 rows are spoilt. With `parallel` the lines are shared
    /// among the threads.
    pub fn convolve(&self, mut field: ArrayViewMut2<Complex64>, rows: usize, parallel: bool) {
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
                    let used = line.iter().any(|v| v.re != 0.0 || v.im != 0.0);
                    if used {
                        self.x.forward.process_with_scratch(line, scratch);
                    }
                    used
                },
            )
            .collect();
        let empty = Complex64::default();
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
                    columns.iter_mut().zip(spectrum).for_each(|(s, g)| *s *= g);
                    self.y.inverse.process_with_scratch(columns, scratch);
                    for r in first..rows {
                        let mut row = part.row_mut(r);
                        let row = row.as_slice_mut().expect("in C order");
                        (0..width).for_each(|k| row[k] = columns[k * ny + r]);
                    }
                },
            );
        let lines = field.as_slice_mut().expect("in C order");
        lines[first * nx..rows * nx].par_chunks_mut(nx).with_min_len(shared).for_each_init(
            || self.x.scratch(),
            |scratch, line| self.x.inverse.process_with_scratch(line, scratch),
        );
    }
}

/// Convolutions along one axis with several kernels, summed: `sum_j g_j * s_j`.
pub struct LineConvolution {
    size: usize,
    transform: Transform,
    /// Spectra of the kernels, [j][k], scaled by 1 / (number of elements).
    spectrum: Vec<Complex64>,
    kernels: usize,
}

/// Buffers of a [`LineConvolution`].
pub struct LineWorkspace {
    sources: Vec<Complex64>,
    used: Vec<bool>,
    sum: Vec<Complex64>,
    scratch: Vec<Complex64>,
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
        Self { size, transform, spectrum, kernels: m }
    }

    /// Buffers with empty sources.
    pub fn workspace(&self) -> LineWorkspace {
        LineWorkspace {
            sources: vec![Complex64::default(); self.kernels * self.size],
            used: vec![false; self.kernels],
            sum: vec![Complex64::default(); self.size],
            scratch: self.transform.scratch(),
        }
    }

    /// The circular convolution, and empty sources again; `None` when no source was used.
    pub fn sum<'a>(&self, work: &'a mut LineWorkspace) -> Option<&'a [Complex64]> {
        let n = self.size;
        if !work.used.contains(&true) {
            return None;
        }
        work.sum.fill(Complex64::default());
        for j in 0..self.kernels {
            if !work.used[j] {
                continue;
            }
            let source = &mut work.sources[j * n..(j + 1) * n];
            self.transform.forward.process_with_scratch(source, &mut work.scratch);
            let terms = source.iter_mut().zip(&self.spectrum[j * n..(j + 1) * n]);
            work.sum.iter_mut().zip(terms).for_each(|(sum, (s, g))| {
                *sum += *s * g;
                *s = Complex64::default();
            });
            work.used[j] = false;
        }
        self.transform.inverse.process_with_scratch(&mut work.sum, &mut work.scratch);
        Some(&work.sum)
    }
}

impl LineWorkspace {
    /// Source `j`, from now on used.
    #[inline]
    pub fn source(&mut self, j: usize) -> &mut [Complex64] {
        let n = self.sum.len();
        self.used[j] = true;
        &mut self.sources[j * n..(j + 1) * n]
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
                plan.convolve(field.view_mut(), s.0, parallel);
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
    fn lines_with_several_kernels_are_summed_and_the_sources_emptied() {
        let (g, s) = (random((3, 4), 8), random((3, 15), 9));
        let plan = LineConvolution::new(g.view(), 16);
        let mut work = plan.workspace();
        assert!(plan.sum(&mut work).is_none());
        for _ in 0..2 {
            for j in [0, 2] {
                let source = work.source(j).iter_mut();
                source.zip(s.row(j)).for_each(|(w, s)| *w = Complex64::new(*s, -2.0 * s));
            }
            let found = plan.sum(&mut work).unwrap();
            for i in 0..12 {
                let of = |j: usize| (0..4).map(|b| g[[j, b]] * s[[j, i + 3 - b]]).sum::<f64>();
                let expected = of(0) + of(2);
                // Sums of 8 products of order 1.
                assert!((found[i + 3].re - expected).abs() < 1e-13);
                assert!((found[i + 3].im + 2.0 * expected).abs() < 1e-13);
            }
        }
        assert!(plan.sum(&mut work).is_none());
    }

    #[test]
    fn quick_sizes() {
        assert_eq!(
            [1, 7, 33, 276, 355, 601, 1025].map(quick_size),
            [1, 8, 36, 288, 384, 640, 1152]
        );
    }
}
