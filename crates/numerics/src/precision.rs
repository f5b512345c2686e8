//! Number types for double precision, and for single precision where a proof shows that it is exact enough.

use rustfft::FftNum;

/// Number type of a matrix, a transform or a factor: `f64` or `f32`.
pub trait Real: FftNum + Default + Into<f64> {
    /// Returns the number of this type that is nearest to `value`.
    fn rounded(value: f64) -> Self;
}

impl Real for f64 {
    #[inline]
    fn rounded(value: f64) -> Self {
        value
    }
}

impl Real for f32 {
    #[inline]
    fn rounded(value: f64) -> Self {
        value as Self
    }
}
