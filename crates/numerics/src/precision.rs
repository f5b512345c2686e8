//! Double precision, or single where that is proven to be exact enough.

use rustfft::FftNum;

/// A number of a matrix, a transform or a factor.
pub trait Real: FftNum + Default + Into<f64> {
    /// The nearest number.
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
