//! Mathematics without optics, shared by the stages.
//!
//! Nothing here knows a unit, a file or a clock. A routine lives here when two crates need it,
//! or when it is a textbook method that would hide the algorithm it serves.

pub mod bounded;
pub mod envelope;
pub mod fft;
pub mod keys;
pub mod polynomial;
pub mod quadrature;
pub mod statistics;
