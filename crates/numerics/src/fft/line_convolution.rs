//! Convolutions of lines with several kernels, whose spectra are summed before the inverse
//! transform.
//!
//! A real kernel convolves the real and the imaginary part of a line independently: two real lines, here called left
//! and right, share one complex transform. A circular convolution of `n` elements contains the part that never leaves a
//! source of `s <= n` elements: `valid[i] = circular[i + g - 1]`, i = 0 .. s-g.
//!
//! [`GROUP`] lines are transformed at a time, in the lanes of vectors ([`super::lanes`]). A product handles the
//! frequencies in runs of 16 ([`Run`]). It computes all sums for one run before the next run, so that data that several
//! sums share stays in the fastest cache. No result depends on the grouping of the lines, nor on the number of threads.

use ndarray::ArrayView2;
use pulp::{Arch, Simd, WithSimd};

use super::{
    lane_convolution::is_field_size,
    lanes::{Transform, elements, transpose},
};
use crate::vectors::Lanes;

/// Number of lines that are transformed together: a multiple of the lanes of every vector. Larger:
/// more padding for few lines. Smaller: idle lanes. It does not change the result.
pub const GROUP: usize = 8;

/// Number of frequencies of a run. Larger: the data of a run leaves the fastest cache. Smaller:
/// more loops. It has to be a multiple of [`PAIR`] vectors of the widest processor.
const RUN: usize = 16;

/// A run: a spectrum at 16 neighbouring frequencies, first the real parts, then the imaginary ones. For a line that is
/// not transformed, 32 of its numbers.
pub type Run = [f64; 2 * RUN];

/// Number of unused runs between a line and the next. With 0, lines can be a power of two apart in memory, and all of
/// them compete for the same few cache lines. Larger: more memory.
const GAP: usize = 1;

/// Plan of convolutions along one axis with several kernels. The spectra of their results are summed before the
/// inverse transform, and the spectrum of a source serves all kernels.
pub struct LineConvolution {
    size: usize,
    kernels: usize,
    transform: Transform<f64>,
    /// Spectra of the kernels, scaled by 1 / (number of elements): for each run, those of all
    /// kernels.
    spectra: Vec<Run>,
}

/// A sum of products for [`LineConvolution::subtract`]: the spectrum from which it is subtracted, and the range of its
/// terms in the list of all terms.
pub type Sum<'a> = (&'a mut [Run], std::ops::Range<usize>);

impl LineConvolution {
    /// Plans convolutions with m kernels of g elements, (m, g), on lines of `size >= g` elements. Panics unless
    /// [`is_field_size`] is true for `size`.
    pub fn new(kernels: ArrayView2<f64>, size: usize) -> Self {
        let (m, g) = kernels.dim();
        assert!(g >= 1 && size >= g, "kernel exceeds the line");
        assert!(is_field_size(size), "no lines of {size} elements");
        let transform = Transform::new(size);
        let mut plan = Self { size, kernels: m, transform, spectra: vec![] };
        let mut lines = vec![[0.0; 2 * RUN]; m.next_multiple_of(GROUP) * plan.runs()];
        for (line, g) in lines.chunks_exact_mut(plan.runs()).zip(kernels.outer_iter()) {
            let left = line.as_flattened_mut().iter_mut();
            left.zip(g).for_each(|(l, g)| *l = g / size as f64);
        }
        plan.forward(&mut lines, &mut Vec::new());
        plan.spectra = (0..size / RUN)
            .flat_map(|k| (0..m).map(move |j| (k, j)))
            .map(|(k, j)| lines[j * plan.runs() + k])
            .collect();
        plan
    }

    /// Returns the number of runs from the start of one line to that of the next. Before a transform, they hold the
    /// elements of the left line, those of the right one, and the gap; afterwards, the runs of the spectrum and the
    /// gap.
    pub fn runs(&self) -> usize {
        self.size / RUN + GAP
    }

    /// Returns the number of elements of a left or a right line.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Returns the count of numbers from the start of one line to that of the next.
    pub fn numbers(&self) -> usize {
        self.runs() * 2 * RUN
    }

    /// Returns the left and the right real line, `size` elements each, of a line that is not transformed.
    pub fn left_and_right<'a>(&self, line: &'a [Run]) -> [&'a [f64]; 2] {
        let (left, rest) = line.as_flattened().split_at(self.size);
        [left, &rest[..self.size]]
    }

    /// Replaces lines by their spectra; their number must be a multiple of [`GROUP`]. `work` is a buffer.
    pub fn forward(&self, lines: &mut [Run], work: &mut Vec<f64>) {
        for lines in lines.chunks_exact_mut(GROUP * self.runs()) {
            Arch::new().dispatch(GroupTransform::<false> { plan: self, lines, work });
        }
    }

    /// Replaces the spectra that [`Self::subtract`] has summed by their lines; their number must be a multiple of
    /// [`GROUP`]. `work` is a buffer.
    pub fn inverse(&self, lines: &mut [Run], work: &mut Vec<f64>) {
        for lines in lines.chunks_exact_mut(GROUP * self.runs()) {
            Arch::new().dispatch(GroupTransform::<true> { plan: self, lines, work });
        }
    }

    /// Transforms back the spectra of one group of lines, and passes the result on element by element. `write(i, first,
    /// left, right)` gets element `i` of as many left and right lines as a vector has lanes, from line `first` of the
    /// group on.
    pub fn inverse_by_elements(
        &self,
        lines: &[Run],
        work: &mut Vec<f64>,
        write: impl FnMut(usize, usize, &[f64], &[f64]),
    ) {
        assert_eq!(lines.len(), GROUP * self.runs(), "one group");
        Arch::new().dispatch(ByElements { plan: self, lines, work, write });
    }

    /// Subtracts convolutions from the spectra in `sums`. Each term is (index j of a kernel, spectrum s of a source),
    /// and its product `g_j s` with the spectrum of the kernel is subtracted.
    pub fn subtract(&self, sums: &mut [Sum<'_>], terms: &[(usize, &[Run])]) {
        Arch::new().dispatch(Subtract { plan: self, sums, terms });
    }

    /// Returns the index of element `i` in the numbers of a line: for the left line (`part` 0) or the right one (1). If
    /// `SPECTRUM`, for the real (0) or the imaginary (1) part of frequency i.
    #[inline(always)]
    fn place<const SPECTRUM: bool>(&self, part: usize, i: usize) -> usize {
        if SPECTRUM { (i / RUN * 2 + part) * RUN + i % RUN } else { part * self.size + i }
    }

    /// Copies as many lines or spectra as there are lanes, from line `first` on, into the lanes of
    /// `to`.
    #[inline(always)]
    fn gather<S: Simd, const SPECTRUM: bool>(&self, lines: &[Run], first: usize, to: &mut [f64]) {
        let lanes = f64::lanes::<S>();
        let numbers = self.numbers();
        let lines = &lines.as_flattened()[first * numbers..];
        for i in (0..self.size).step_by(lanes) {
            for part in 0..2 {
                let from = &lines[self.place::<SPECTRUM>(part, i)..];
                transpose::<f64, S>(from, numbers, &mut to[(2 * i + part) * lanes..], 2 * lanes);
            }
        }
    }

    /// Copies the lanes of `from` back into lines or spectra from line `first` on: the inverse of
    /// [`Self::gather`].
    #[inline(always)]
    fn scatter<S: Simd, const SPECTRUM: bool>(
        &self,
        from: &[f64],
        lines: &mut [Run],
        first: usize,
    ) {
        let lanes = f64::lanes::<S>();
        let numbers = self.numbers();
        let lines = &mut lines.as_flattened_mut()[first * numbers..];
        for i in (0..self.size).step_by(lanes) {
            for part in 0..2 {
                let to = &mut lines[self.place::<SPECTRUM>(part, i)..];
                transpose::<f64, S>(&from[(2 * i + part) * lanes..], 2 * lanes, to, numbers);
            }
        }
    }

    /// Returns the part of `work` that holds as many lines as there are lanes; makes it longer if necessary.
    #[inline(always)]
    fn buffer<'a, S: Simd>(&self, work: &'a mut Vec<f64>) -> &'a mut [f64] {
        let needed = 2 * self.size * f64::lanes::<S>();
        work.resize(work.len().max(needed), 0.0);
        &mut work[..needed]
    }
}

/// The transform of a group of [`GROUP`] lines, or its inverse.
struct GroupTransform<'a, const INVERSE: bool> {
    plan: &'a LineConvolution,
    lines: &'a mut [Run],
    work: &'a mut Vec<f64>,
}

impl<const INVERSE: bool> WithSimd for GroupTransform<'_, INVERSE> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { plan, lines, work } = self;
        let buffer = plan.buffer::<S>(work);
        for first in (0..GROUP).step_by(f64::lanes::<S>()) {
            if INVERSE {
                plan.gather::<S, true>(lines, first, buffer);
                plan.transform.inverse::<S>(simd, elements::<f64, S>(buffer));
                plan.scatter::<S, false>(buffer, lines, first);
            } else {
                plan.gather::<S, false>(lines, first, buffer);
                plan.transform.forward::<S>(simd, elements::<f64, S>(buffer));
                plan.scatter::<S, true>(buffer, lines, first);
            }
        }
    }
}

struct ByElements<'a, W> {
    plan: &'a LineConvolution,
    lines: &'a [Run],
    work: &'a mut Vec<f64>,
    write: W,
}

impl<W: FnMut(usize, usize, &[f64], &[f64])> WithSimd for ByElements<'_, W> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { plan, lines, work, mut write } = self;
        let lanes = f64::lanes::<S>();
        let buffer = plan.buffer::<S>(work);
        for first in (0..GROUP).step_by(lanes) {
            plan.gather::<S, true>(lines, first, buffer);
            plan.transform.inverse::<S>(simd, elements::<f64, S>(buffer));
            for (i, element) in buffer.chunks_exact(2 * lanes).enumerate() {
                let (left, right) = element.split_at(lanes);
                write(i, first, left, right);
            }
        }
    }
}

struct Subtract<'a, 'b> {
    plan: &'a LineConvolution,
    sums: &'a mut [Sum<'b>],
    terms: &'a [(usize, &'a [Run])],
}

impl WithSimd for Subtract<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { plan, sums, terms } = self;
        for (k, spectra) in plan.spectra.chunks_exact(plan.kernels).enumerate() {
            for (sum, own) in &mut *sums {
                subtract_run::<S>(simd, &mut sum[k], &terms[own.clone()], spectra, k);
            }
        }
    }
}

/// Number of vectors of real parts, and of imaginary parts, that are multiplied together. Larger:
/// more sums than registers. Smaller: fewer independent sums.
const PAIR: usize = 2;

/// Subtracts the products of run `k` of all terms from the same run of a sum, [`PAIR`] vectors at a time. `spectra` has
/// run `k` of all kernels.
#[inline(always)]
fn subtract_run<S: Simd>(
    simd: S,
    sum: &mut Run,
    terms: &[(usize, &[Run])],
    spectra: &[Run],
    k: usize,
) {
    let (re, im) = sum.split_at_mut(RUN);
    let re = f64::vectors_mut::<S>(re);
    let im = f64::vectors_mut::<S>(im);
    let pairs = re.as_chunks_mut::<PAIR>().0.iter_mut().zip(im.as_chunks_mut::<PAIR>().0);
    for (pair, (to_re, to_im)) in pairs.enumerate() {
        let mut re = *to_re;
        let mut im = *to_im;
        for &(j, source) in terms {
            let g = &spectra[j];
            let s = &source[k];
            let [g_re, g_im] = [0, 1].map(|i| part::<S>(g, i, pair));
            let [s_re, s_im] = [0, 1].map(|i| part::<S>(s, i, pair));
            for v in 0..PAIR {
                re[v] = <f64 as Lanes>::negate_mul_add(simd, g_re[v], s_re[v], re[v]);
                re[v] = <f64 as Lanes>::mul_add(simd, g_im[v], s_im[v], re[v]);
                im[v] = <f64 as Lanes>::negate_mul_add(simd, g_re[v], s_im[v], im[v]);
                im[v] = <f64 as Lanes>::negate_mul_add(simd, g_im[v], s_re[v], im[v]);
            }
        }
        *to_re = re;
        *to_im = im;
    }
}

/// Returns group number `pair` of [`PAIR`] vectors of a run, of its real parts (`part` 0) or of its imaginary ones (1).
#[inline(always)]
fn part<S: Simd>(run: &Run, part: usize, pair: usize) -> &[<f64 as Lanes>::Vector<S>; PAIR] {
    let numbers = &run.as_chunks::<RUN>().0[part];
    &f64::vectors::<S>(numbers).as_chunks::<PAIR>().0[pair]
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
        for size in [16, 48] {
            let s = size - 1;
            let (g, left, right) =
                (random((3, 4), 8), random((GROUP, s), 9), random((GROUP, s), 10));
            let plan = LineConvolution::new(g.view(), size);
            let (runs, mut work) = (plan.runs(), vec![]);
            let mut lines = vec![[0.0; 2 * RUN]; GROUP * runs];
            for (j, line) in lines.chunks_exact_mut(runs).enumerate() {
                for (part, from) in [&left, &right].into_iter().enumerate() {
                    let to = &mut line.as_flattened_mut()[part * size..][..s];
                    to.copy_from_slice(from.row(j).as_slice().unwrap());
                }
            }
            plan.forward(&mut lines, &mut work);
            // Two sums: of two terms in the fourth line of a group, and of one in its last line.
            let line = |j: usize| &lines[j * runs..][..runs];
            let terms = [(0, line(1)), (2, line(5)), (1, line(7))];
            let mut found = vec![[0.0; 2 * RUN]; GROUP * runs];
            let mut parts = found.chunks_exact_mut(runs);
            let (fourth, last) = (parts.nth(3).unwrap(), parts.nth(3).unwrap());
            plan.subtract(&mut [(fourth, 0..2), (last, 2..3)], &terms);
            let mut by_elements = Array2::zeros((2 * GROUP, size));
            plan.inverse_by_elements(&found, &mut work, |i, first, left, right| {
                for (k, (left, right)) in left.iter().zip(right).enumerate() {
                    by_elements[[first + k, i]] = *left;
                    by_elements[[GROUP + first + k, i]] = *right;
                }
            });
            plan.inverse(&mut found, &mut work);
            for (j, line) in found.chunks_exact(runs).enumerate() {
                let terms: &[(usize, usize)] = match j {
                    3 => &[(0, 1), (2, 5)],
                    7 => &[(1, 7)],
                    _ => &[],
                };
                for (part, source) in [&left, &right].into_iter().enumerate() {
                    let found = plan.left_and_right(line)[part];
                    assert!((0..size).all(|i| found[i] == by_elements[[part * GROUP + j, i]]));
                    for i in 0..s - 3 {
                        // the definition
                        let of = |&(k, j): &(usize, usize)| {
                            (0..4).map(|b| g[[k, b]] * source[[j, i + 3 - b]]).sum::<f64>()
                        };
                        let expected = -terms.iter().map(of).sum::<f64>();
                        // Sums of 8 products of order 1.
                        assert!((found[i + 3] - expected).abs() < 1e-13);
                    }
                }
            }
        }
    }
}
