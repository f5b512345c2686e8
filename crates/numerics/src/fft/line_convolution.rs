//! Convolutions of lines with several kernels, whose spectra are summed before they are transformed back.
//!
//! A real kernel convolves the real and the imaginary part of a line independently: two real lines share one complex
//! transform. Every line is transformed by itself, so that the result does not depend on the number of threads.
//!
//! A circular convolution of `n` elements contains the part that never leaves a source of
//! `s <= n` elements: `valid[i] = circular[i + g - 1]`, i = 0 .. s-g.

use std::sync::Arc;

use ndarray::ArrayView2;
use rustfft::{Fft, FftPlanner};

use super::Complex64;
use crate::vectors::vectorised;

/// Products that are summed in one pass over a line.
const TERMS: usize = 3;

/// Convolutions along one axis with several kernels. Their sum is made of the spectra, and the
/// spectrum of a source serves all kernels.
pub struct LineConvolution {
    size: usize,
    forward: Arc<dyn Fft<f64>>,
    inverse: Arc<dyn Fft<f64>>,
    /// Spectra of the kernels, [j][k], scaled by 1 / (number of elements).
    spectrum: Vec<Complex64>,
}

impl LineConvolution {
    /// Plans for kernels (m, g) and lines of `size >= g` elements.
    pub fn new(kernels: ArrayView2<f64>, size: usize) -> Self {
        let (m, g) = kernels.dim();
        assert!(g >= 1 && size >= g, "kernel exceeds the line");
        let mut planner = FftPlanner::new();
        let (forward, inverse) = (planner.plan_fft_forward(size), planner.plan_fft_inverse(size));
        let mut spectrum = vec![Complex64::default(); m * size];
        let mut scratch = vec![Complex64::default(); forward.get_inplace_scratch_len()];
        for (line, g) in spectrum.chunks_mut(size).zip(kernels.outer_iter()) {
            line.iter_mut().zip(g).for_each(|(l, g)| l.re = g / size as f64);
            forward.process_with_scratch(line, &mut scratch);
        }
        Self { size, forward, inverse, spectrum }
    }

    /// Elements of a line.
    pub fn size(&self) -> usize {
        self.size
    }

    /// A buffer for [`Self::forward`] and [`Self::inverse`].
    pub fn scratch(&self) -> Vec<Complex64> {
        let of = |plan: &dyn Fft<f64>| plan.get_inplace_scratch_len();
        vec![Complex64::default(); of(&*self.forward).max(of(&*self.inverse))]
    }

    /// The spectra of whole lines, one after the other.
    pub fn forward(&self, lines: &mut [Complex64], scratch: &mut [Complex64]) {
        self.forward.process_with_scratch(lines, scratch);
    }

    /// The lines of sums of [`Self::subtract`].
    pub fn inverse(&self, lines: &mut [Complex64], scratch: &mut [Complex64]) {
        self.inverse.process_with_scratch(lines, scratch);
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
        vectorised(
            #[inline(always)]
            || {
                for k in 0..n {
                    let mut rest = sum[k];
                    for (g, s) in &factors {
                        rest -= g[k] * s[k];
                    }
                    sum[k] = rest;
                }
            },
        );
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
}
