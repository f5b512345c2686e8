//! Product of two panels of a factor, which is nearly all of the work of a factorisation.
//!
//! ```text
//! C -= A' B,      A (k, n), B (k, n), C (n, n),      n = BLOCK
//! ```
//!
//! A *panel* is a block of [`BLOCK`] rows of a factor, stored column by column: row k of A or B contains column k of
//! these rows. The product reads it in this order. A general matrix product copies both into such an order first. For
//! panels as narrow as these, the copy takes half as long as the multiplications. Some elements of C stay in registers
//! while the product reads a part of both panels that fits into the fastest cache.
//!
//! Every element of C is summed in the order of k, whatever the vector width.

use pulp::{Arch, Simd, WithSimd};

use crate::vectors::Lanes;

/// Number of rows of a block of the matrix. Larger: the factorisation of the diagonal blocks, without matrix products,
/// takes longer. Smaller: the matrix products do not run at full speed.
pub(crate) const BLOCK: usize = 64;

/// Number of rows of A and of B that are used for all of C before the next ones: 32 KiB for both in single precision.
/// Larger: they leave the fastest cache. Smaller: C is read and written more often.
const DEPTH: usize = 64;

/// Number of rows of C in registers. Larger: more accumulators than registers. Smaller: elements of
/// B are read more often.
const ROWS: usize = 4;

/// Subtracts `a' b` from `c`, all row by row: a and b have the shape (k, BLOCK), c (BLOCK, BLOCK).
pub(crate) fn subtract_product<T: Lanes>(a: &[T], b: &[T], c: &mut [T]) {
    assert_eq!(a.len(), b.len(), "panels of one height");
    assert_eq!(c.len(), BLOCK * BLOCK, "elements of a block");
    Arch::new().dispatch(Product { a, b, c });
}

struct Product<'a, T> {
    a: &'a [T],
    b: &'a [T],
    c: &'a mut [T],
}

impl<T: Lanes> WithSimd for Product<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { a, b, c } = self;
        let parts = a.chunks(DEPTH * BLOCK).zip(b.chunks(DEPTH * BLOCK));
        // Accumulators, a row of B and an element of A fit into the registers.
        if S::REGISTER_COUNT >= 32 {
            parts.for_each(|(a, b)| subtract_part::<T, S, 4>(simd, a, b, c));
        } else {
            parts.for_each(|(a, b)| subtract_part::<T, S, 2>(simd, a, b, c));
        }
    }
}

/// Computes `c -= a' b` with `VECTORS` vectors of a row of C at a time.
#[inline(always)]
fn subtract_part<T: Lanes, S: Simd, const VECTORS: usize>(simd: S, a: &[T], b: &[T], c: &mut [T]) {
    let of_row = BLOCK / T::lanes::<S>();
    let b = T::vectors::<S>(b);
    let c = T::vectors_mut::<S>(c);
    for from in (0..of_row).step_by(VECTORS) {
        for row in (0..BLOCK).step_by(ROWS) {
            let mut sums = [[T::splat(simd, T::zero()); VECTORS]; ROWS];
            let columns = a[row..].chunks(BLOCK).zip(b[from..].chunks(of_row));
            for (a, b) in columns {
                let a = a.first_chunk::<ROWS>().expect("rows divide a block");
                let b = b.first_chunk::<VECTORS>().expect("vectors divide a row");
                for (sums, a) in sums.iter_mut().zip(a) {
                    let a = T::splat(simd, *a);
                    for (sum, b) in sums.iter_mut().zip(b) {
                        *sum = T::mul_add(simd, a, *b, *sum);
                    }
                }
            }
            for (i, sums) in sums.iter().enumerate() {
                let c = &mut c[(row + i) * of_row + from..][..VECTORS];
                for (c, sum) in c.iter_mut().zip(sums) {
                    *c = T::difference(simd, *c, *sum);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;

    #[test]
    fn it_is_the_product_of_the_definition() {
        // Whole numbers below 2^24, so that the sums are exact in either precision and any order.
        fn check<T: Lanes>(depth: usize) {
            let panel = |step: usize| {
                Array2::from_shape_fn((depth, BLOCK), |(k, i)| {
                    ((k * step + i * 3) % 11) as f64 - 4.0
                })
            };
            let (a, b) = (panel(7), panel(5));
            let c = Array2::from_shape_fn((BLOCK, BLOCK), |(i, j)| (i * BLOCK + j) as f64);
            let expected = &c - &a.t().dot(&b);
            let rounded = |m: &Array2<f64>| m.iter().map(|v| T::rounded(*v)).collect::<Vec<_>>();
            let mut found = rounded(&c);
            subtract_product(&rounded(&a), &rounded(&b), &mut found);
            let found: Vec<f64> = found.into_iter().map(Into::into).collect();
            assert_eq!(found, expected.into_raw_vec_and_offset().0);
        }
        // None, less than a part, whole parts, and one and a half.
        for depth in [0, 1, DEPTH, 2 * DEPTH, 3 * DEPTH / 2] {
            check::<f32>(depth);
            check::<f64>(depth);
        }
    }
}
