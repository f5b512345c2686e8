//! Discrete Fourier transforms, and convolutions by means of them.
//!
//! | module | subject |
//! |---|---|
//! | [`transform`] | a map of any size, for its spectrum |
//! | [`plan`] | prepared transforms of a map, in single and in double precision |
//! | [`convolution`] | one real map at a time, convolved with one kernel |
//! | [`tiles`] | one real map at a time, convolved with one kernel, tile by tile |
//! | [`lane_convolution`] | two strips of a tile at a time, as the real and imaginary parts of one complex array |
//! | [`lanes`] | as many lines at a time as a vector of the processor has lanes |
//! | [`line_convolution`] | pairs of lines whose products with several kernels are summed before the inverse |
//! | [`mod@line`] | single real lines whose products are summed before the inverse |
//!
//! Rows and columns are independent transforms everywhere. No result depends on the number of
//! threads.

pub mod convolution;
pub mod lane_convolution;
pub mod lanes;
pub mod line;
pub mod line_convolution;
pub mod plan;
pub mod tiles;
pub mod transform;

pub use rustfft::num_complex::{Complex, Complex64};

use crate::vectors::vectorised;

/// Adds the products `a[i] b[i]` to `sum[i]`, for every element i.
pub fn add_products(sum: &mut [Complex64], a: &[Complex64], b: &[Complex64]) {
    vectorised(
        #[inline(always)]
        || {
            for ((sum, a), b) in sum.iter_mut().zip(a).zip(b) {
                *sum += a * b;
            }
        },
    );
}

/// Adds the products of `a[i]` and the complex conjugate of `b[i]` to `sum[i]`, for every element i.
pub fn add_conjugate_products(sum: &mut [Complex64], a: &[Complex64], b: &[Complex64]) {
    vectorised(
        #[inline(always)]
        || {
            for ((sum, a), b) in sum.iter_mut().zip(a).zip(b) {
                *sum += a * b.conj();
            }
        },
    );
}

/// Returns the smallest `m >= n`, at least 1, without prime factors above 7: a length whose transforms are fast.
pub fn smooth_size(n: usize) -> usize {
    (n.max(1)..)
        .find(|&m| {
            let mut rest = m;
            for p in [2, 3, 5, 7] {
                while rest % p == 0 {
                    rest /= p;
                }
            }
            rest == 1
        })
        .expect("powers of two are unbounded")
}
