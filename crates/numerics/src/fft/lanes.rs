//! Transforms of as many lines at a time as a vector of the processor has lanes.
//!
//! With a line in every lane, nothing is shuffled within a vector, whatever the length. For a convolution, the spectra
//! of the map and of the kernel only have to be in the same order. The forward transform therefore leaves its
//! frequencies reversed in the digits of the radices (decimation in frequency), and the inverse takes them in this
//! order (decimation in time). Both are in place. A transform of n elements is done in levels. On a level, blocks of n
//! elements are divided by the radix `r` into r blocks of `m = n / r`:
//!
//! ```text
//! y[p m' + j] = exp(-2 pi i j p / n) sum_q exp(-2 pi i p q / r) x[q m + j],   j < m, p < r         (1)
//! ```
//!
//! and the next level takes each of the `r` blocks by itself. Blocks that fit into the fastest cache are processed
//! level by level; larger ones are divided first.
//!
//! `pulp` chooses the vectors when the program runs. Each lane is computed by itself. A result
//! depends on the number of lanes only by the rounding of processors that multiply and add in one
//! step.

use std::f64::consts::{FRAC_1_SQRT_2, TAU};

use pulp::{NullaryFnOnce, Simd};

use crate::vectors::Lanes;

/// Largest number of elements of a line that are processed level by level: 16 KiB with two vectors of 64 bytes per
/// element. Larger: a block leaves the fastest cache. Smaller: more calls. It does not change the result.
const BLOCK: usize = 128;

/// Returns true if there is a transform of `n` elements: n > 0 has no prime factors above 5.
pub fn is_size(n: usize) -> bool {
    let mut rest = n;
    for p in [2, 3, 5] {
        while rest > 0 && rest.is_multiple_of(p) {
            rest /= p;
        }
    }
    rest == 1
}

/// One element of the lines, in every lane: vectors of the real and of the imaginary parts.
pub type Element<T, S> = [<T as Lanes>::Vector<S>; 2];

/// Views numbers as elements: the real parts of the first element in all lanes, its imaginary parts, and so on.
#[inline(always)]
pub fn elements<T: Lanes, S: Simd>(numbers: &mut [T]) -> &mut [Element<T, S>] {
    T::vectors_mut::<S>(numbers).as_chunks_mut::<2>().0
}

/// Plan of the transforms of lines of one length.
pub struct Transform<T> {
    size: usize,
    levels: Vec<Level<T>>,
}

/// Step (1) of the module for blocks of `radix` times `rest` elements.
struct Level<T> {
    radix: usize,
    rest: usize,
    /// Roots of unity exp(-2 pi i j p / n) of (1) as [real, imaginary], ordered [j][p - 1].
    twiddles: Vec<[T; 2]>,
}

impl<T: Lanes> Transform<T> {
    /// Plans transforms for lines of `len` elements; panics unless [`is_size`].
    pub fn new(len: usize) -> Self {
        assert!(is_size(len), "no transform of {len} elements");
        let mut size = len;
        let levels = radices(len).into_iter().map(|radix| {
            let rest = size / radix;
            let turns = (0..rest).flat_map(|j| (1..radix).map(move |p| j * p));
            let twiddles = turns.map(|turns| {
                let (sin, cos) = (-TAU * turns as f64 / size as f64).sin_cos();
                [T::rounded(cos), T::rounded(sin)]
            });
            let level = Level { radix, rest, twiddles: twiddles.collect() };
            size = rest;
            level
        });
        Self { size: len, levels: levels.collect() }
    }

    /// Returns the number of elements of a line.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Transforms lines in place, one per lane. The frequencies come out in the order of the levels of this plan, which
    /// is not ascending.
    #[inline(always)]
    pub fn forward<S: Simd>(&self, simd: S, lines: &mut [Element<T, S>]) {
        Step { simd, levels: &self.levels, lines, what: What::<T, S>::Forward }.run();
    }

    /// Transforms lines back in place: the inverse of [`Self::forward`], times the number of elements.
    #[inline(always)]
    pub fn inverse<S: Simd>(&self, simd: S, lines: &mut [Element<T, S>]) {
        Step { simd, levels: &self.levels, lines, what: What::<T, S>::Inverse }.run();
    }

    /// Transforms lines in place, multiplies them by a spectrum in the order of [`Self::forward`], and transforms them
    /// back, times the number of elements.
    #[inline(always)]
    pub fn convolve<S: Simd>(
        &self,
        simd: S,
        lines: &mut [Element<T, S>],
        spectrum: &[Element<T, S>],
    ) {
        Step { simd, levels: &self.levels, lines, what: What::<T, S>::Convolve(spectrum) }.run();
    }
}

/// Returns the radices of the levels of a transform of `len` elements, in descending order. Most factors of 2 are
/// joined to eights, so that the blocks are soon small.
fn radices(len: usize) -> Vec<usize> {
    let mut twos = len.trailing_zeros();
    let mut rest = len >> twos;
    let mut radices = vec![];
    match twos % 3 {
        1 if twos >= 4 => {
            radices.extend([4, 4]);
            twos -= 4;
        }
        1 => {
            radices.push(2);
            twos -= 1;
        }
        2 => {
            radices.push(4);
            twos -= 2;
        }
        _ => {}
    }
    radices.extend((0..twos / 3).map(|_| 8));
    for p in [5, 3] {
        while rest.is_multiple_of(p) {
            radices.push(p);
            rest /= p;
        }
    }
    radices.sort_by(|a, b| b.cmp(a));
    radices
}

/// Operation on lines: a transform, its inverse, or a convolution with this spectrum.
enum What<'a, T: Lanes, S: Simd> {
    Forward,
    Inverse,
    Convolve(&'a [Element<T, S>]),
}

/// One operation: the levels of the transform, and the lines, for one vector type of a processor.
struct Step<'a, T: Lanes, S: Simd> {
    simd: S,
    levels: &'a [Level<T>],
    lines: &'a mut [Element<T, S>],
    what: What<'a, T, S>,
}

impl<T: Lanes, S: Simd> Step<'_, T, S> {
    fn run(self) {
        self.simd.vectorize(self);
    }
}

impl<T: Lanes, S: Simd> NullaryFnOnce for Step<'_, T, S> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { simd, levels, lines, what } = self;
        let forward = !matches!(what, What::Inverse);
        let inverse = !matches!(what, What::<T, S>::Forward);
        if lines.len() <= BLOCK {
            if forward {
                for level in levels {
                    for block in lines.chunks_exact_mut(level.radix * level.rest) {
                        level.pass::<S, false>(simd, block);
                    }
                }
            }
            if let What::Convolve(spectrum) = what {
                for (element, g) in lines.iter_mut().zip(spectrum) {
                    *element = times::<T, S>(simd, *element, *g);
                }
            }
            if inverse {
                for level in levels.iter().rev() {
                    for block in lines.chunks_exact_mut(level.radix * level.rest) {
                        level.pass::<S, true>(simd, block);
                    }
                }
            }
            return;
        }
        let Some((level, levels)) = levels.split_first() else { return };
        if forward {
            level.pass::<S, false>(simd, lines);
        }
        for (i, lines) in lines.chunks_exact_mut(level.rest).enumerate() {
            let what = match what {
                What::Forward => What::Forward,
                What::Inverse => What::Inverse,
                What::Convolve(spectrum) => {
                    What::Convolve(&spectrum[i * level.rest..][..level.rest])
                }
            };
            Step { simd, levels, lines, what }.run();
        }
        if inverse {
            level.pass::<S, true>(simd, lines);
        }
    }
}

impl<T: Lanes> Level<T> {
    /// Does step (1) of the module within a block, or its inverse. With real and imaginary parts exchanged, the
    /// transform is its own inverse.
    #[inline(always)]
    fn pass<S: Simd, const INVERSE: bool>(&self, simd: S, block: &mut [Element<T, S>]) {
        match self.radix {
            2 => self.butterflies::<S, Two, 2, 1, INVERSE>(simd, block),
            3 => self.butterflies::<S, Three, 3, 2, INVERSE>(simd, block),
            4 => self.butterflies::<S, Four, 4, 3, INVERSE>(simd, block),
            5 => self.butterflies::<S, Five, 5, 4, INVERSE>(simd, block),
            _ => self.butterflies::<S, Eight, 8, 7, INVERSE>(simd, block),
        }
    }

    #[inline(always)]
    fn butterflies<
        S: Simd,
        B: Butterfly<RADIX>,
        const RADIX: usize,
        const OTHERS: usize,
        const INVERSE: bool,
    >(
        &self,
        simd: S,
        block: &mut [Element<T, S>],
    ) {
        if self.rest == 1 {
            for block in block.as_chunks_mut::<RADIX>().0 {
                let mut v = *block;
                exchange::<T, S, INVERSE>(&mut v);
                v = B::dft::<T, S>(simd, v);
                exchange::<T, S, INVERSE>(&mut v);
                *block = v;
            }
            return;
        }
        let m = self.rest;
        let mut parts = block.chunks_exact_mut(m);
        let mut x = [(); RADIX].map(|()| parts.next().expect("one for each root"));
        for x in &mut x {
            *x = &mut std::mem::take(x)[..m];
        }
        let twiddles = &self.twiddles.as_chunks::<OTHERS>().0[..m];
        for j in 0..m {
            let mut v = [x[0][j]; RADIX];
            for q in 1..RADIX {
                v[q] = x[q][j];
            }
            exchange::<T, S, INVERSE>(&mut v);
            if INVERSE {
                twiddle::<T, S>(simd, &mut v[1..], &twiddles[j]);
            }
            v = B::dft::<T, S>(simd, v);
            if !INVERSE {
                twiddle::<T, S>(simd, &mut v[1..], &twiddles[j]);
            }
            exchange::<T, S, INVERSE>(&mut v);
            for q in 0..RADIX {
                x[q][j] = v[q];
            }
        }
    }
}

/// Exchanges real and imaginary parts if the transform is an inverse.
#[inline(always)]
fn exchange<T: Lanes, S: Simd, const INVERSE: bool>(v: &mut [Element<T, S>]) {
    if INVERSE {
        for [re, im] in v {
            std::mem::swap(re, im);
        }
    }
}

/// Multiplies each element by its root of unity, [real, imaginary].
#[inline(always)]
fn twiddle<T: Lanes, S: Simd>(simd: S, v: &mut [Element<T, S>], roots: &[[T; 2]]) {
    for (v, [re, im]) in v.iter_mut().zip(roots) {
        *v = times::<T, S>(simd, *v, [T::splat(simd, *re), T::splat(simd, *im)]);
    }
}

/// Returns the complex product `a b` in every lane.
#[inline(always)]
fn times<T: Lanes, S: Simd>(simd: S, a: Element<T, S>, b: Element<T, S>) -> Element<T, S> {
    let [re, im] = [T::product(simd, a[0], b[0]), T::product(simd, a[0], b[1])];
    [T::negate_mul_add(simd, a[1], b[1], re), T::mul_add(simd, a[1], b[0], im)]
}

/// Discrete Fourier transform of RADIX elements, of which a level of a transform consists.
trait Butterfly<const RADIX: usize> {
    fn dft<T: Lanes, S: Simd>(simd: S, x: [Element<T, S>; RADIX]) -> [Element<T, S>; RADIX];
}

struct Two;
struct Three;
struct Four;
struct Five;
struct Eight;

/// Returns a + b and a - b, complex, in every lane.
#[inline(always)]
fn sum_and_difference<T: Lanes, S: Simd>(
    simd: S,
    a: Element<T, S>,
    b: Element<T, S>,
) -> [Element<T, S>; 2] {
    [
        [T::sum(simd, a[0], b[0]), T::sum(simd, a[1], b[1])],
        [T::difference(simd, a[0], b[0]), T::difference(simd, a[1], b[1])],
    ]
}

/// Returns a - i b and a + i b, complex, in every lane.
#[inline(always)]
fn turned<T: Lanes, S: Simd>(simd: S, a: Element<T, S>, b: Element<T, S>) -> [Element<T, S>; 2] {
    [
        [T::sum(simd, a[0], b[1]), T::difference(simd, a[1], b[0])],
        [T::difference(simd, a[0], b[1]), T::sum(simd, a[1], b[0])],
    ]
}

impl Butterfly<2> for Two {
    #[inline(always)]
    fn dft<T: Lanes, S: Simd>(simd: S, x: [Element<T, S>; 2]) -> [Element<T, S>; 2] {
        sum_and_difference::<T, S>(simd, x[0], x[1])
    }
}

impl Butterfly<3> for Three {
    #[inline(always)]
    fn dft<T: Lanes, S: Simd>(simd: S, x: [Element<T, S>; 3]) -> [Element<T, S>; 3] {
        let half = T::splat(simd, T::rounded(0.5));
        let sine = T::splat(simd, T::rounded((TAU / 3.0).sin()));
        let [sum, difference] = sum_and_difference::<T, S>(simd, x[1], x[2]);
        let [all, _] = sum_and_difference::<T, S>(simd, x[0], sum);
        let a = [
            T::negate_mul_add(simd, sum[0], half, x[0][0]),
            T::negate_mul_add(simd, sum[1], half, x[0][1]),
        ];
        let b = [T::product(simd, difference[0], sine), T::product(simd, difference[1], sine)];
        let [y1, y2] = turned::<T, S>(simd, a, b);
        [all, y1, y2]
    }
}

impl Butterfly<4> for Four {
    #[inline(always)]
    fn dft<T: Lanes, S: Simd>(simd: S, x: [Element<T, S>; 4]) -> [Element<T, S>; 4] {
        let [a, b] = sum_and_difference::<T, S>(simd, x[0], x[2]);
        let [c, d] = sum_and_difference::<T, S>(simd, x[1], x[3]);
        let [y0, y2] = sum_and_difference::<T, S>(simd, a, c);
        let [y1, y3] = turned::<T, S>(simd, b, d);
        [y0, y1, y2, y3]
    }
}

impl Butterfly<5> for Five {
    #[inline(always)]
    fn dft<T: Lanes, S: Simd>(simd: S, x: [Element<T, S>; 5]) -> [Element<T, S>; 5] {
        let angles = [TAU / 5.0, 2.0 * TAU / 5.0];
        let [c1, c2] = angles.map(|angle| T::splat(simd, T::rounded(angle.cos())));
        let [s1, s2] = angles.map(|angle| T::splat(simd, T::rounded(angle.sin())));
        let [p1, d1] = sum_and_difference::<T, S>(simd, x[1], x[4]);
        let [p2, d2] = sum_and_difference::<T, S>(simd, x[2], x[3]);
        let [p, _] = sum_and_difference::<T, S>(simd, p1, p2);
        let [all, _] = sum_and_difference::<T, S>(simd, x[0], p);
        let mut a = [x[0]; 2];
        let mut b = [x[0]; 2];
        for part in 0..2 {
            let (p1, p2, d1, d2) = (p1[part], p2[part], d1[part], d2[part]);
            a[0][part] = T::mul_add(simd, p2, c2, T::mul_add(simd, p1, c1, x[0][part]));
            a[1][part] = T::mul_add(simd, p2, c1, T::mul_add(simd, p1, c2, x[0][part]));
            b[0][part] = T::mul_add(simd, d2, s2, T::product(simd, d1, s1));
            b[1][part] = T::negate_mul_add(simd, d2, s1, T::product(simd, d1, s2));
        }
        let [y1, y4] = turned::<T, S>(simd, a[0], b[0]);
        let [y2, y3] = turned::<T, S>(simd, a[1], b[1]);
        [all, y1, y2, y3, y4]
    }
}

impl Butterfly<8> for Eight {
    #[inline(always)]
    fn dft<T: Lanes, S: Simd>(simd: S, x: [Element<T, S>; 8]) -> [Element<T, S>; 8] {
        let even = Four::dft::<T, S>(simd, [x[0], x[2], x[4], x[6]]);
        let odd = Four::dft::<T, S>(simd, [x[1], x[3], x[5], x[7]]);
        let h = T::splat(simd, T::rounded(FRAC_1_SQRT_2));
        let [y0, y4] = sum_and_difference::<T, S>(simd, even[0], odd[0]);
        let [y2, y6] = turned::<T, S>(simd, even[2], odd[2]);
        // exp(-i pi/4) (a + i b) = h (a + b) + i h (b - a), and -i times that for exp(-3 i pi/4).
        let first = [T::sum(simd, odd[1][0], odd[1][1]), T::difference(simd, odd[1][1], odd[1][0])];
        let third = [T::difference(simd, odd[3][1], odd[3][0]), T::sum(simd, odd[3][0], odd[3][1])];
        let y1 =
            [T::mul_add(simd, first[0], h, even[1][0]), T::mul_add(simd, first[1], h, even[1][1])];
        let y5 = [
            T::negate_mul_add(simd, first[0], h, even[1][0]),
            T::negate_mul_add(simd, first[1], h, even[1][1]),
        ];
        let y3 = [
            T::mul_add(simd, third[0], h, even[3][0]),
            T::negate_mul_add(simd, third[1], h, even[3][1]),
        ];
        let y7 = [
            T::negate_mul_add(simd, third[0], h, even[3][0]),
            T::mul_add(simd, third[1], h, even[3][1]),
        ];
        [y0, y1, y2, y3, y4, y5, y6, y7]
    }
}

/// Rounds the numbers of `from` to the precision of a transform and writes them to `to`, several at a time so that the
/// compiler uses vectors.
#[inline(always)]
pub fn round<T: Lanes>(from: &[f64], to: &mut [T]) {
    /// Number of values that are rounded at a time. Larger: more than the compiler has vectors for.
    /// Smaller: single values. It does not change the result.
    const AT_A_TIME: usize = 4;
    let (from, from_rest) = from.as_chunks::<AT_A_TIME>();
    let (to, to_rest) = to.as_chunks_mut::<AT_A_TIME>();
    for (from, to) in from.iter().zip(to) {
        // All of them are read before the first is written.
        let from = *from;
        let mut rounded = [T::default(); AT_A_TIME];
        for k in 0..AT_A_TIME {
            rounded[k] = T::rounded(from[k]);
        }
        *to = rounded;
    }
    for (from, to) in from_rest.iter().zip(to_rest) {
        *to = T::rounded(*from);
    }
}

/// Transposes a square of numbers whose side is the number of lanes. Row `i` of it begins at `from[i from_step]`, and
/// becomes column `i` of the square whose rows begin at `to[j to_step]`.
#[inline(always)]
pub fn transpose<T: Lanes, S: Simd>(from: &[T], from_step: usize, to: &mut [T], to_step: usize) {
    match T::lanes::<S>() {
        16 => transpose_square::<T, 16>(from, from_step, to, to_step),
        8 => transpose_square::<T, 8>(from, from_step, to, to_step),
        4 => transpose_square::<T, 4>(from, from_step, to, to_step),
        lanes => {
            for i in 0..lanes {
                for j in 0..lanes {
                    to[j * to_step + i] = from[i * from_step + j];
                }
            }
        }
    }
}

/// Transposes a square of side N, in smaller squares for which the compiler has vectors.
#[inline(always)]
fn transpose_square<T: Lanes, const N: usize>(
    from: &[T],
    from_step: usize,
    to: &mut [T],
    to_step: usize,
) {
    /// Side of the squares that are transposed at a time. Larger: more than the compiler has
    /// vectors for. Smaller: single values. It does not change the result.
    const SIDE: usize = 4;
    let from = &from[..(N - 1) * from_step + N];
    let to = &mut to[..(N - 1) * to_step + N];
    for i in 0..N / SIDE {
        for j in 0..N / SIDE {
            let mut v = [[T::default(); SIDE]; SIDE];
            for k in 0..SIDE {
                let row = from[(SIDE * i + k) * from_step + SIDE * j..].first_chunk();
                v[k] = *row.expect("squares are whole");
            }
            for k in 0..SIDE {
                let column = to[(SIDE * j + k) * to_step + SIDE * i..].first_chunk_mut();
                *column.expect("squares are whole") = [v[0][k], v[1][k], v[2][k], v[3][k]];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use pulp::{Arch, Scalar, WithSimd};

    use super::*;

    /// Transforms `line` in every lane, scaled by the number of the lane. Returns the results of
    /// one lane: the transform, its inverse, and the convolution with a spectrum of ones.
    struct Lane<'a> {
        line: &'a [[f64; 2]],
        lane: usize,
    }

    impl WithSimd for Lane<'_> {
        type Output = Option<[Vec<[f64; 2]>; 3]>;

        fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
            let (n, lanes) = (self.line.len(), f64::lanes::<S>());
            if self.lane >= lanes {
                return None;
            }
            let mut numbers = vec![0.0; 2 * n * lanes];
            for (element, value) in numbers.chunks_mut(2 * lanes).zip(self.line) {
                for k in 0..lanes {
                    (element[k], element[lanes + k]) =
                        ((1 + k) as f64 * value[0], (1 + k) as f64 * value[1]);
                }
            }
            let scale = 1.0 / (1 + self.lane) as f64;
            let of = |numbers: &[f64]| -> Vec<[f64; 2]> {
                numbers
                    .chunks(2 * lanes)
                    .map(|e| [scale * e[self.lane], scale * e[lanes + self.lane]])
                    .collect()
            };
            let plan = Transform::<f64>::new(n);
            let mut one = numbers.clone();
            let spectrum = [vec![1.0; lanes], vec![0.0; lanes]].concat().repeat(n);
            let spectrum = f64::vectors::<S>(&spectrum).as_chunks::<2>().0;
            plan.convolve(simd, f64::vectors_mut::<S>(&mut one).as_chunks_mut::<2>().0, spectrum);
            plan.forward(simd, f64::vectors_mut::<S>(&mut numbers).as_chunks_mut::<2>().0);
            let there = of(&numbers);
            plan.inverse(simd, f64::vectors_mut::<S>(&mut numbers).as_chunks_mut::<2>().0);
            Some([there, of(&numbers), of(&one)])
        }
    }

    /// Returns the frequencies in the order of a transform of n elements: the digits of the radices are reversed.
    fn order(n: usize) -> Vec<usize> {
        let radices = radices(n);
        (0..n)
            .map(|mut at| {
                let (mut size, mut factor, mut frequency) = (n, 1, 0);
                for r in &radices {
                    size /= r;
                    frequency += factor * (at / size);
                    at %= size;
                    factor *= r;
                }
                frequency
            })
            .collect()
    }

    #[test]
    fn every_lane_is_transformed_by_the_definition_and_back() {
        for n in [1, 2, 3, 5, 8, 12, 16, 45, 48, 96, 240, 400, 2048] {
            let line: Vec<_> =
                (0..n).map(|i| [(1.3 * i as f64).sin(), (0.7 * i as f64).cos()]).collect();
            let exact: Vec<_> = order(n)
                .into_iter()
                .map(|k| {
                    let term = |(j, v): (usize, &[f64; 2])| {
                        let (sin, cos) = (-TAU * ((j * k) % n) as f64 / n as f64).sin_cos();
                        [v[0] * cos - v[1] * sin, v[0] * sin + v[1] * cos]
                    };
                    let terms = line.iter().enumerate().map(term);
                    terms.fold([0.0; 2], |s, t| [s[0] + t[0], s[1] + t[1]])
                })
                .collect();
            let near = |a: &[[f64; 2]], b: &[[f64; 2]], scale: f64| {
                let far = |(a, b): (&[f64; 2], &[f64; 2])| {
                    (a[0] - scale * b[0]).abs().max((a[1] - scale * b[1]).abs())
                };
                a.iter().zip(b).map(far).fold(0.0, f64::max)
            };
            for lane in [0, 1, 7] {
                let of = |found: Option<[Vec<[f64; 2]>; 3]>| {
                    let Some([there, back, one]) = found else { return };
                    // Sums of n terms of order 1.
                    let tolerance = 1e-15 * (n as f64).powf(1.5);
                    let error = near(&there, &exact, 1.0);
                    assert!(error <= tolerance, "{n} elements, lane {lane}: {error}");
                    assert!(near(&back, &line, n as f64) <= tolerance);
                    assert!(near(&one, &line, n as f64) <= tolerance);
                };
                let widest = Arch::new().dispatch(Lane { line: &line, lane });
                // Narrower vectors that multiply and add in one step give the same to the last bit.
                #[cfg(target_arch = "x86_64")]
                if let Some(simd) = pulp::x86::V3::try_new() {
                    let narrower = Arch::V3(simd).dispatch(Lane { line: &line, lane });
                    assert!(narrower.is_none() || narrower == widest);
                }
                of(widest);
                of(Lane { line: &line, lane }.with_simd(Scalar::new()));
            }
        }
    }

    #[test]
    fn squares_are_transposed() {
        fn transposed<const N: usize>() {
            let (from_step, to_step) = (N + 2, N + 3);
            let from: Vec<f64> = (0..N * from_step).map(|v| v as f64).collect();
            let mut to = vec![0.0; N * to_step];
            transpose_square::<f64, N>(&from, from_step, &mut to, to_step);
            for (i, j) in (0..N).flat_map(|i| (0..N).map(move |j| (i, j))) {
                assert_eq!(to[j * to_step + i], from[i * from_step + j]);
            }
            assert!((1..N).all(|i| to[i * to_step - 3..i * to_step] == [0.0; 3]));
        }
        transposed::<4>();
        transposed::<8>();
        transposed::<16>();
    }

    #[test]
    fn sizes() {
        assert!([1, 2, 3, 5, 45, 48, 1000].into_iter().all(is_size));
        assert!(![0, 7, 14, 22].into_iter().any(is_size));
        assert_eq!(radices(768), [8, 8, 4, 3]);
        assert!(
            [2, 16, 32, 48, 80, 640, 1152]
                .into_iter()
                .all(|n| radices(n).iter().product::<usize>() == n)
        );
    }
}
