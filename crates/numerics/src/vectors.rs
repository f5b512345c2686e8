//! Loops compiled for the vector width of the processor that runs them.
//!
//! A binary is compiled for the oldest processor that may run it, and so for its narrowest vectors.
//! Code within [`vectorised`] is compiled for wider vectors as well, and `pulp` chooses among them
//! when the program runs. The compiler keeps the order of sums and never contracts a product and a
//! sum. Every bit is therefore the same on all processors.
//!
//! Loops that the compiler does not turn into vectors are written with [`Lanes`], for vectors of any number of lanes.
//! It multiplies and adds in one step if the processor can, so that its last bits depend on the processor.

use pulp::{Arch, Simd};

use crate::precision::Real;

/// Runs `work` compiled for the vectors of the processor. `work` is a closure with the attribute
/// `#[inline(always)]` that calls only inlined functions, because only inlined code is compiled
/// again.
#[inline(always)]
pub fn vectorised<R>(work: impl FnOnce() -> R) -> R {
    Arch::new().dispatch(work)
}

/// Arithmetic on vectors of the processor, each with one number in every lane. All operations act lane by lane.
pub trait Lanes: Real {
    /// Vector type of the processor for this number type.
    type Vector<S: Simd>: Copy;

    /// Returns the number of lanes: how many numbers a vector holds.
    fn lanes<S: Simd>() -> usize;
    /// Returns a vector with `value` in every lane.
    fn splat<S: Simd>(simd: S, value: Self) -> Self::Vector<S>;
    /// Returns `a + b` in every lane.
    fn sum<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    /// Returns `a - b` in every lane.
    fn difference<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    /// Returns the product `a b` in every lane.
    fn product<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    /// Returns `a b + c` in every lane, rounded once if the processor can.
    fn mul_add<S: Simd>(
        simd: S,
        a: Self::Vector<S>,
        b: Self::Vector<S>,
        c: Self::Vector<S>,
    ) -> Self::Vector<S>;
    /// Returns `c - a b` in every lane, rounded once if the processor can.
    fn negate_mul_add<S: Simd>(
        simd: S,
        a: Self::Vector<S>,
        b: Self::Vector<S>,
        c: Self::Vector<S>,
    ) -> Self::Vector<S>;
    /// Views a slice of numbers as vectors; its length must be a multiple of [`Self::lanes`].
    fn vectors<S: Simd>(numbers: &[Self]) -> &[Self::Vector<S>];
    /// Views a slice of numbers as mutable vectors; its length must be a multiple of [`Self::lanes`].
    fn vectors_mut<S: Simd>(numbers: &mut [Self]) -> &mut [Self::Vector<S>];
}

macro_rules! lanes {
    ($number:ty, $vector:ident, $lanes:ident, $splat:ident, $add:ident, $sub:ident, $mul:ident, $mul_add:ident,
     $negate_mul_add:ident, $vectors:ident, $vectors_mut:ident) => {
        impl Lanes for $number {
            type Vector<S: Simd> = S::$vector;

            #[inline(always)]
            fn lanes<S: Simd>() -> usize {
                S::$lanes
            }

            #[inline(always)]
            fn splat<S: Simd>(simd: S, value: Self) -> S::$vector {
                simd.$splat(value)
            }

            #[inline(always)]
            fn sum<S: Simd>(simd: S, a: S::$vector, b: S::$vector) -> S::$vector {
                simd.$add(a, b)
            }

            #[inline(always)]
            fn difference<S: Simd>(simd: S, a: S::$vector, b: S::$vector) -> S::$vector {
                simd.$sub(a, b)
            }

            #[inline(always)]
            fn product<S: Simd>(simd: S, a: S::$vector, b: S::$vector) -> S::$vector {
                simd.$mul(a, b)
            }

            #[inline(always)]
            fn mul_add<S: Simd>(
                simd: S,
                a: S::$vector,
                b: S::$vector,
                c: S::$vector,
            ) -> S::$vector {
                simd.$mul_add(a, b, c)
            }

            #[inline(always)]
            fn negate_mul_add<S: Simd>(
                simd: S,
                a: S::$vector,
                b: S::$vector,
                c: S::$vector,
            ) -> S::$vector {
                simd.$negate_mul_add(a, b, c)
            }

            #[inline(always)]
            fn vectors<S: Simd>(numbers: &[Self]) -> &[S::$vector] {
                S::$vectors(numbers).0
            }

            #[inline(always)]
            fn vectors_mut<S: Simd>(numbers: &mut [Self]) -> &mut [S::$vector] {
                S::$vectors_mut(numbers).0
            }
        }
    };
}

lanes!(
    f64,
    f64s,
    F64_LANES,
    splat_f64s,
    add_f64s,
    sub_f64s,
    mul_f64s,
    mul_add_e_f64s,
    negate_mul_add_e_f64s,
    as_simd_f64s,
    as_mut_simd_f64s
);
lanes!(
    f32,
    f32s,
    F32_LANES,
    splat_f32s,
    add_f32s,
    sub_f32s,
    mul_f32s,
    mul_add_e_f32s,
    negate_mul_add_e_f32s,
    as_simd_f32s,
    as_mut_simd_f32s
);
