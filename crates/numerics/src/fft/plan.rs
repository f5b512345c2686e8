//! Plans of the transforms of a map, made here for both precisions.
//!
//! A planner of `rustfft` brings every transform that it may choose, for every precision, into the crate that makes it.
//! Other crates take plans from here, so that the transforms are compiled once.

use std::sync::Arc;

use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftPlanner};

use crate::precision::Real;

/// Transforms of the rows of a real map, and of the columns of their spectra.
pub struct Plans<T> {
    /// Transform of the rows: from real numbers to half of their spectrum.
    pub forward_x: Arc<dyn RealToComplex<T>>,
    /// Inverse transform of the rows: from half of a spectrum to real numbers.
    pub inverse_x: Arc<dyn ComplexToReal<T>>,
    /// Forward transform of the columns of these spectra.
    pub forward_y: Arc<dyn Fft<T>>,
    /// Inverse transform of the columns.
    pub inverse_y: Arc<dyn Fft<T>>,
}

/// A number type for which transforms can be planned: `f64` or `f32`.
pub trait Planned: Real {
    /// Plans the transforms of maps of `size` (rows, columns).
    fn plans(size: (usize, usize)) -> Plans<Self>;
}

impl Planned for f64 {
    fn plans(size: (usize, usize)) -> Plans<Self> {
        plans(size)
    }
}

impl Planned for f32 {
    fn plans(size: (usize, usize)) -> Plans<Self> {
        plans(size)
    }
}

/// Plans the transforms of maps of a size (rows, columns).
fn plans<T: Real>((rows, columns): (usize, usize)) -> Plans<T> {
    let mut real = RealFftPlanner::new();
    let mut complex = FftPlanner::new();
    Plans {
        forward_x: real.plan_fft_forward(columns),
        inverse_x: real.plan_fft_inverse(columns),
        forward_y: complex.plan_fft_forward(rows),
        inverse_y: complex.plan_fft_inverse(rows),
    }
}
