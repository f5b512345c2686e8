//! Products of eight interleaved rectangles of numbers with one rectangle.
//!
//! ```text
//! y[l] += sum over r, c of a[r, c, l] b[r, c],      l < EIGHT
//! ```
//!
//! An element of b is read once for all eight rectangles, and the sums stay in registers.

use pulp::{Arch, Simd, WithSimd};

use crate::vectors::Lanes;

/// Number of interleaved rectangles: the lanes of a wide vector of the processor. Larger: sums do
/// not fit into registers. Smaller: idle lanes.
pub const EIGHT: usize = 8;

/// Rows of numbers in memory. The first numbers of two neighbouring rows are `pitch` elements apart.
#[derive(Clone, Copy, Debug)]
pub struct PitchedRows<'a> {
    /// Numbers, from the first one of the rectangle on.
    pub numbers: &'a [f64],
    /// Distance between rows, in elements. An element is eight numbers if the rectangle is
    /// interleaved.
    pub pitch: usize,
}

/// Adds `sum over r, c of a[r, c, l] b[r, c]` to `sums[l]`, over a rectangle of `shape` (rows, columns). `a` has eight
/// numbers, one per l, for each number of `b`.
pub fn add_products(
    a: PitchedRows<'_>,
    b: PitchedRows<'_>,
    shape: (usize, usize),
    sums: &mut [f64; EIGHT],
) {
    Arch::new().dispatch(Products { a, b, shape, sums });
}

struct Products<'a> {
    a: PitchedRows<'a>,
    b: PitchedRows<'a>,
    shape: (usize, usize),
    sums: &'a mut [f64; EIGHT],
}

impl WithSimd for Products<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match S::F64_LANES {
            8 => self.by::<S, 1>(simd),
            4 => self.by::<S, 2>(simd),
            2 => self.by::<S, 4>(simd),
            _ => self.by::<S, EIGHT>(simd),
        }
    }
}

impl Products<'_> {
    /// Runs the product with the eight numbers of an element in `VECTORS` vectors of the processor.
    #[inline(always)]
    fn by<S: Simd, const VECTORS: usize>(self, simd: S) {
        let Self { a, b, shape: (ny, nx), sums } = self;
        let elements = f64::vectors::<S>(a.numbers).as_chunks::<VECTORS>().0;
        // Four sums, each of every fourth column, because a single sum would wait for its own
        // result.
        let mut four = [[simd.splat_f64s(0.0); VECTORS]; 4];
        for (a, b) in elements.chunks(a.pitch).zip(b.numbers.chunks(b.pitch)).take(ny) {
            let (a4, a_rest) = a[..nx].as_chunks::<4>();
            let (b4, b_rest) = b[..nx].as_chunks::<4>();
            for (a, b) in a4.iter().zip(b4) {
                for i in 0..4 {
                    let b = simd.splat_f64s(b[i]);
                    for v in 0..VECTORS {
                        four[i][v] = simd.mul_add_e_f64s(a[i][v], b, four[i][v]);
                    }
                }
            }
            for (i, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
                let b = simd.splat_f64s(*b);
                for v in 0..VECTORS {
                    four[i][v] = simd.mul_add_e_f64s(a[v], b, four[i][v]);
                }
            }
        }
        for (v, sum) in f64::vectors_mut::<S>(sums).iter_mut().enumerate() {
            let [early, late] =
                [[0, 1], [2, 3]].map(|[i, k]| simd.add_f64s(four[i][v], four[k][v]));
            *sum = simd.add_f64s(*sum, simd.add_f64s(early, late));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_lane_has_its_own_sum() {
        // Whole numbers, so that sums are exact in any order. The rows are longer than the summed
        // part.
        for shape in [(1, 1), (3, 4), (5, 7), (2, 11)] {
            let (ny, nx) = shape;
            let (pitch_a, pitch_b) = (nx + 3, nx + 1);
            let a: Vec<f64> =
                (0..ny * pitch_a * EIGHT).map(|i| (i * 7 % 23) as f64 - 9.0).collect();
            let b: Vec<f64> = (0..ny * pitch_b).map(|i| (i * 5 % 17) as f64 - 4.0).collect();
            let mut sums = [1.0; EIGHT];
            let rows = |numbers, pitch| PitchedRows { numbers, pitch };
            add_products(rows(&a, pitch_a), rows(&b, pitch_b), shape, &mut sums);
            for (l, found) in sums.into_iter().enumerate() {
                let at = |r: usize, c: usize| a[(r * pitch_a + c) * EIGHT + l] * b[r * pitch_b + c];
                let expected: f64 =
                    (0..ny).flat_map(|r| (0..nx).map(move |c| (r, c))).map(|(r, c)| at(r, c)).sum();
                assert_eq!(found, 1.0 + expected, "{shape:?} {l}");
            }
        }
    }
}
