//! Real transforms of lines of one size, for convolutions along one axis whose products are summed
//! before the inverse transform.

use std::sync::Arc;

use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};

use super::{Complex64, smooth_size};

/// Plan of the transforms of real lines (sequences of numbers) of up to a given length.
pub struct Lines {
    size: usize,
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
}

/// Buffers of one thread for the transforms.
pub struct Workspace {
    line: Vec<f64>,
    half: Vec<Complex64>,
    forward: Vec<Complex64>,
    inverse: Vec<Complex64>,
}

impl Lines {
    /// Plans transforms for lines of `len` elements, continued by zeros up to 2^a 3^b 5^c 7^d.
    pub fn new(len: usize) -> Self {
        let size = smooth_size(len);
        let mut planner = RealFftPlanner::new();
        let forward = planner.plan_fft_forward(size);
        let inverse = planner.plan_fft_inverse(size);
        Self { size, forward, inverse }
    }

    /// Returns the number of elements of the spectrum of a real line: only the frequencies from 0 to the Nyquist
    /// frequency.
    pub fn half(&self) -> usize {
        self.size / 2 + 1
    }

    /// Makes the buffers for [`Self::forward`] and [`Self::inverse`].
    pub fn workspace(&self) -> Workspace {
        Workspace {
            line: self.forward.make_input_vec(),
            half: self.forward.make_output_vec(),
            forward: self.forward.make_scratch_vec(),
            inverse: self.inverse.make_scratch_vec(),
        }
    }

    /// Computes the spectrum of a line. `write` puts its values into a line of zeros, and `spectrum`, of [`Self::half`]
    /// elements, receives the result.
    pub fn forward(
        &self,
        write: impl FnOnce(&mut [f64]),
        spectrum: &mut [Complex64],
        work: &mut Workspace,
    ) {
        work.line.fill(0.0);
        write(&mut work.line);
        self.forward
            .process_with_scratch(&mut work.line, spectrum, &mut work.forward)
            .expect("buffers have the planned sizes");
    }

    /// Returns the line whose spectrum is given, by the inverse transform divided by the number of elements.
    pub fn inverse<'a>(&self, spectrum: &[Complex64], work: &'a mut Workspace) -> &'a [f64] {
        let scale = 1.0 / self.size as f64;
        work.half.iter_mut().zip(spectrum).for_each(|(h, s)| *h = s * scale);
        // These two elements of the transform of a real line are real but for rounding.
        work.half[0].im = 0.0;
        if self.size.is_multiple_of(2) {
            work.half[self.size / 2].im = 0.0;
        }
        self.inverse
            .process_with_scratch(&mut work.half, &mut work.line, &mut work.inverse)
            .expect("buffers have the planned sizes");
        &work.line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_and_back_and_a_product_is_a_convolution() {
        for len in [1, 2, 9, 14] {
            let lines = Lines::new(len);
            let mut work = lines.workspace();
            let (mut a, mut b) = (vec![Complex64::default(); lines.half()], Vec::new());
            b.clone_from(&a);
            let value = |k: usize| (1.0 + k as f64).sin();
            let write = |line: &mut [f64]| (0..len).for_each(|k| line[k] = value(k));
            lines.forward(write, &mut a, &mut work);
            let back = lines.inverse(&a, &mut work);
            // Sums of at most 14 elements of order 1.
            assert!((0..len).all(|k| (back[k] - value(k)).abs() < 1e-14));
            lines.forward(|line| line[lines.size - 1] = 2.0, &mut b, &mut work);
            a.iter_mut().zip(&b).for_each(|(a, b)| *a *= b);
            // One element at the end: a shift by one to the left.
            let back = lines.inverse(&a, &mut work);
            // As above, of order 2.
            assert!((1..len).all(|k| (back[k - 1] - 2.0 * value(k)).abs() < 1e-14));
        }
    }
}
