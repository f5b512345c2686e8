//! Mathematics without optics, shared by the stages.
//!
//! Nothing here knows a unit, a file or a clock. A routine lives here when two crates need it,
//! or when it is a textbook method that would hide the algorithm it serves.

pub mod arc_feed;
pub mod bounded;
pub mod bspline;
pub mod chain;
pub mod envelope;
pub mod fft;
pub mod fft_line;
pub mod fft_pairs;
pub mod fourier;
pub mod keys;
pub mod lanczos;
pub mod link;
pub mod lsqr;
pub mod nnls;
pub mod orthogonal;
pub mod polynomial;
pub mod quadrature;
pub mod statistics;
pub mod ticks;
