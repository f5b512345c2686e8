//! Convolution of two real sources at once with a fixed real kernel, the lines of a transform in the lanes of vectors.
//!
//! A real kernel convolves the real and the imaginary part of a source independently: two sources, here two strips of a
//! map, share one complex transform. A circular convolution of `n` elements contains the part that never leaves a
//! source of `s <= n` elements: `valid[i] = circular[i + g - 1]`, i = 0 .. s-g.
//!
//! First the columns are transformed, as many at a time as a vector has lanes, each block in its
//! place. Then squares of lanes are transposed, so that as many rows are in the lanes. The rows are
//! transformed, multiplied and transformed back while they stay in the cache, and transposed again.
//! Finally the columns are transformed back. A map is transposed twice and never reordered, because
//! the order of the frequencies does not matter ([`super::lanes`]).
//!
//! A *field* is the complex array that is transformed, with one source as its real and one as its imaginary part. One
//! thread does all work of a field. Many threads work on many fields at once.

use std::ops::Range;

use ndarray::ArrayView2;
use pulp::{Arch, Simd, WithSimd};

use super::lanes::{Transform, elements, is_size, transpose};
use crate::vectors::Lanes;

/// Divisor of the number of rows and of columns of a field. It is the largest number of lanes of a vector: single
/// precision in 64 bytes. Smaller: a line may not be a whole number of vectors. Larger: more padding.
const STEP: usize = 16;

/// Number of map rows that are read or written together. Larger: more rows than the processor can fetch ahead. Smaller:
/// shorter stretches of memory in a block are written at a time. It does not change the result.
const ROWS: usize = 8;

/// Returns true if a field may have `n` rows or columns: a multiple of 16, above 0, without prime factors above 5.
pub fn is_field_size(n: usize) -> bool {
    n > 0 && n.is_multiple_of(STEP) && is_size(n)
}

/// Returns the smallest possible number of rows or columns of a field that is at least `n` ([`is_field_size`]).
pub fn field_size(n: usize) -> usize {
    (n.max(1).next_multiple_of(STEP)..)
        .step_by(STEP)
        .find(|n| is_field_size(*n))
        .expect("powers of two are unbounded")
}

/// Reads two sources (the left and the right strip of a map), and writes the valid parts of their convolutions.
pub trait Strips<T> {
    /// Reads elements of one row of both sources, from `column` on, until `left` and `right` are full; zero outside
    /// the sources.
    fn read(&self, row: usize, column: usize, left: &mut [T], right: &mut [T]);

    /// Writes `left` and `right` to one row of both valid parts, from `column` on.
    fn write(&mut self, row: usize, column: usize, left: &[T], right: &[T]);
}

/// Plan of two-dimensional convolutions with one kernel, for fields of one size.
pub struct LaneConvolution<T = f64> {
    kernel: (usize, usize),
    x: Transform<T>,
    y: Transform<T>,
    /// Spectrum of the kernel, scaled by 1 / (number of elements of a field). For each group of as many frequencies
    /// along y as there are lanes, it has the elements along x, in the order of the transforms.
    spectrum: Vec<T>,
}

/// Buffers of one thread for a convolution.
#[derive(Default)]
pub struct Workspace<T> {
    /// Field: the elements along y of each group of as many columns as there are lanes.
    field: Vec<T>,
    /// Elements of the rows that are processed together, as many as there are lanes.
    lines: Vec<T>,
}

impl<T: Lanes> LaneConvolution<T> {
    /// Plans the convolution with `kernel` (gy, gx) in fields of the shape `size` (rows, columns). Panics unless
    /// [`is_field_size`] is true for both, and both are at least those of the kernel.
    pub fn new(kernel: ArrayView2<f64>, size: (usize, usize)) -> Self {
        let (gy, gx) = kernel.dim();
        assert!(gy >= 1 && gx >= 1 && size.0 >= gy && size.1 >= gx, "kernel exceeds the field");
        assert!(is_field_size(size.0) && is_field_size(size.1), "no field of {size:?}");
        let mut plan = Self {
            kernel: (gy, gx),
            x: Transform::new(size.1),
            y: Transform::new(size.0),
            spectrum: vec![T::default(); 2 * size.0 * size.1],
        };
        let mut spectrum = std::mem::take(&mut plan.spectrum);
        let scale = 1.0 / (size.0 * size.1) as f64;
        let mut strips = Kernel { samples: kernel, scale };
        let to = Some(&mut spectrum);
        plan.run((gy, gx), &mut strips, &mut Workspace::default(), to);
        plan.spectrum = spectrum;
        plan
    }

    /// Returns the shape (ny, nx) of the fields.
    pub fn size(&self) -> (usize, usize) {
        (self.y.size(), self.x.size())
    }

    /// Computes the valid parts of both strips, for sources of the shape `source` (rows, columns), at most that of the
    /// fields. Reads and writes them through `strips`.
    pub fn convolve(
        &self,
        source: (usize, usize),
        strips: &mut impl Strips<T>,
        work: &mut Workspace<T>,
    ) {
        self.run(source, strips, work, None);
    }

    /// Convolves the strips. If `spectrum` is given, only writes the spectrum of the strips there.
    fn run(
        &self,
        source: (usize, usize),
        strips: &mut impl Strips<T>,
        work: &mut Workspace<T>,
        spectrum: Option<&mut Vec<T>>,
    ) {
        let (ny, nx) = self.size();
        assert!(source.0 <= ny && source.1 <= nx, "source exceeds the field");
        Arch::new().dispatch(ConvolutionRun { plan: self, source, strips, work, spectrum });
    }
}

/// The kernel as the left of two sources, times `scale`; the right one is zero.
struct Kernel<'a> {
    samples: ArrayView2<'a, f64>,
    scale: f64,
}

impl<T: Lanes> Strips<T> for Kernel<'_> {
    fn read(&self, row: usize, column: usize, left: &mut [T], right: &mut [T]) {
        right.fill(T::default());
        for (k, left) in left.iter_mut().enumerate() {
            let sample = self.samples.get([row, column + k]);
            *left = T::rounded(sample.map_or(0.0, |s| s * self.scale));
        }
    }

    fn write(&mut self, _: usize, _: usize, _: &[T], _: &[T]) {}
}

/// One run of a convolution, or only the spectrum of its strips if `spectrum` is given.
struct ConvolutionRun<'a, T: Lanes, X> {
    plan: &'a LaneConvolution<T>,
    source: (usize, usize),
    strips: &'a mut X,
    work: &'a mut Workspace<T>,
    spectrum: Option<&'a mut Vec<T>>,
}

/// Layout of the numbers of a field: blocks of as many columns as there are lanes, one after the other.
#[derive(Clone, Copy)]
struct Places {
    lanes: usize,
    /// Count of the numbers of an element in all lanes: real and imaginary parts.
    element: usize,
    /// Count of numbers from the start of one block of columns to that of the next.
    stride: usize,
    /// Count of the numbers of a square: as many elements of a block as there are lanes.
    square: usize,
    /// Count of the blocks that contain columns of the source.
    blocks: usize,
}

impl Places {
    /// Returns the range, in the field, of the numbers of a square: a block of columns in a group of as many rows.
    fn square(&self, block: usize, group: usize) -> Range<usize> {
        let from = block * self.stride + group * self.square;
        from..from + self.square
    }

    /// Returns the range, in the field, of the numbers of a block of columns in one row.
    fn element(&self, block: usize, row: usize) -> Range<usize> {
        let from = block * self.stride + row * self.element;
        from..from + self.element
    }
}

impl<T: Lanes, X: Strips<T>> WithSimd for ConvolutionRun<'_, T, X> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { plan, source, strips, work, spectrum } = self;
        let lanes = T::lanes::<S>();
        let element = 2 * lanes;
        let (ny, nx) = plan.size();
        let places = Places {
            lanes,
            element,
            // A few elements more than a block is long: at a power of two, the squares of one group of rows would all
            // fall on the same few lines of the cache.
            stride: (ny + lanes) * element,
            square: lanes * element,
            blocks: source.1.div_ceil(lanes),
        };
        work.field.resize(places.stride * (nx / lanes), T::default());
        work.lines.resize(nx * element, T::default());
        plan.columns_of(simd, source.0, strips, &mut work.field, places);
        match spectrum {
            Some(spectrum) => plan.rows_of_spectrum(simd, &work.field, spectrum, places),
            None => {
                plan.convolve_rows(simd, work, places);
                plan.columns_back(simd, source, strips, &mut work.field, places);
            }
        }
    }
}

/// Steps of a convolution. All of them are inlined into the one function that may use the vectors
/// of the processor.
impl<T: Lanes> LaneConvolution<T> {
    /// Reads the first `rows` rows of the strips into the field and transforms its columns.
    #[inline(always)]
    fn columns_of<S: Simd>(
        &self,
        simd: S,
        rows: usize,
        strips: &impl Strips<T>,
        field: &mut [T],
        places: Places,
    ) {
        for from in (0..rows).step_by(ROWS) {
            for b in 0..places.blocks {
                for row in from..(from + ROWS).min(rows) {
                    let element = &mut field[places.element(b, row)];
                    let (left, right) = element.split_at_mut(places.lanes);
                    strips.read(row, b * places.lanes, left, right);
                }
            }
        }
        for (b, block) in field.chunks_exact_mut(places.stride).enumerate() {
            let block = &mut block[..self.y.size() * places.element];
            if b < places.blocks {
                block[rows * places.element..].fill(T::default());
                self.y.forward::<S>(simd, elements::<T, S>(block));
            } else {
                block.fill(T::default());
            }
        }
    }

    /// Writes to `spectrum` the transform of the rows of a field whose columns are transformed already.
    #[inline(always)]
    fn rows_of_spectrum<S: Simd>(&self, simd: S, field: &[T], spectrum: &mut [T], places: Places) {
        for (group, lines) in spectrum.chunks_exact_mut(self.x.size() * places.element).enumerate()
        {
            for (b, to) in lines.chunks_exact_mut(places.square).enumerate() {
                transpose_parts::<T, S>(&field[places.square(b, group)], to);
            }
            self.x.forward::<S>(simd, elements::<T, S>(lines));
        }
    }

    /// Transforms the rows of a field whose columns are transformed already, multiplies by the spectrum of the kernel,
    /// and transforms the rows back.
    #[inline(always)]
    fn convolve_rows<S: Simd>(&self, simd: S, work: &mut Workspace<T>, places: Places) {
        let Workspace { field, lines } = work;
        let groups = self.spectrum.chunks_exact(self.x.size() * places.element);
        for (group, spectrum) in groups.enumerate() {
            for (b, to) in lines.chunks_exact_mut(places.square).enumerate() {
                transpose_parts::<T, S>(&field[places.square(b, group)], to);
            }
            let spectrum = T::vectors::<S>(spectrum).as_chunks::<2>().0;
            self.x.convolve::<S>(simd, elements::<T, S>(lines), spectrum);
            let valid = lines.chunks_exact(places.square).enumerate().skip(self.spoilt(places));
            for (b, from) in valid {
                transpose_parts::<T, S>(from, &mut field[places.square(b, group)]);
            }
        }
    }

    /// Transforms the columns back and writes the valid parts to the strips.
    #[inline(always)]
    fn columns_back<S: Simd>(
        &self,
        simd: S,
        source: (usize, usize),
        strips: &mut impl Strips<T>,
        field: &mut [T],
        places: Places,
    ) {
        let (gy, gx) = self.kernel;
        let lanes = places.lanes;
        let valid = self.spoilt(places)..places.blocks;
        for block in field.chunks_exact_mut(places.stride).take(valid.end).skip(valid.start) {
            let block = &mut block[..self.y.size() * places.element];
            self.y.inverse::<S>(simd, elements::<T, S>(block));
        }
        for rows in (gy - 1..source.0).step_by(ROWS) {
            for b in valid.clone() {
                let column = b * lanes;
                // Lanes of valid columns.
                let from = (gx - 1).saturating_sub(column);
                let to = lanes.min(source.1 - column);
                if from >= to {
                    continue;
                }
                for row in rows..(rows + ROWS).min(source.0) {
                    let (left, right) = field[places.element(b, row)].split_at(lanes);
                    let column = column + from + 1 - gx;
                    strips.write(row + 1 - gy, column, &left[from..to], &right[from..to]);
                }
            }
        }
    }

    /// Returns the number of blocks of columns that contain only elements of the circular convolution outside the valid
    /// part; they are not used.
    fn spoilt(&self, places: Places) -> usize {
        (self.kernel.1 - 1) / places.lanes
    }
}

/// Transposes the real parts and the imaginary parts of a square of lanes, each by themselves.
#[inline(always)]
fn transpose_parts<T: Lanes, S: Simd>(from: &[T], to: &mut [T]) {
    let lanes = T::lanes::<S>();
    transpose::<T, S>(from, 2 * lanes, to, 2 * lanes);
    transpose::<T, S>(&from[lanes..], 2 * lanes, &mut to[lanes..], 2 * lanes);
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

    struct Two {
        source: [Array2<f64>; 2],
        valid: [Array2<f64>; 2],
    }

    impl<T: Lanes> Strips<T> for Two {
        fn read(&self, row: usize, column: usize, left: &mut [T], right: &mut [T]) {
            for (part, to) in [left, right].into_iter().enumerate() {
                for (k, to) in to.iter_mut().enumerate() {
                    let value = self.source[part].get([row, column + k]);
                    *to = T::rounded(value.copied().unwrap_or(0.0));
                }
            }
        }

        fn write(&mut self, row: usize, column: usize, left: &[T], right: &[T]) {
            for (part, from) in [left, right].into_iter().enumerate() {
                for (k, value) in from.iter().enumerate() {
                    self.valid[part][[row, column + k]] += (*value).into();
                }
            }
        }
    }

    #[test]
    fn both_parts_are_convolved() {
        let mut work = Workspace::default();
        let cases = [
            ((1, 1), (1, 1), (16, 16)),
            ((3, 4), (11, 13), (16, 32)),
            ((5, 2), (5, 9), (16, 16)),
            ((2, 19), (31, 75), (48, 80)),
        ];
        for (g, s, n) in cases {
            let (g, source) = (random(g, 1), [random(s, 2), random(s, 3)]);
            let plan = LaneConvolution::<f64>::new(g.view(), n);
            let (gy, gx) = g.dim();
            let shape = (s.0 + 1 - gy, s.1 + 1 - gx);
            let mut two = Two { source, valid: [Array2::zeros(shape), Array2::zeros(shape)] };
            plan.convolve(s, &mut two, &mut work);
            for (source, valid) in two.source.iter().zip(&two.valid) {
                for ((i, j), found) in valid.indexed_iter() {
                    // the definition
                    let term = |((a, b), v): ((usize, usize), &f64)| {
                        v * source[[i + gy - 1 - a, j + gx - 1 - b]]
                    };
                    let expected: f64 = g.indexed_iter().map(term).sum();
                    // Sums of at most 38 products of order 1; each element is written once.
                    assert!((found - expected).abs() < 1e-13, "{found} {expected}");
                }
            }
        }
    }

    #[test]
    fn field_sizes() {
        assert_eq!(
            [0, 1, 17, 276, 355, 601, 1025].map(field_size),
            [16, 16, 32, 288, 384, 640, 1152]
        );
    }
}
