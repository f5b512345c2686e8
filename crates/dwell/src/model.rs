//! The removal model of the dwell solvers, `removal = B t`, and B as an operator.
//!
//! | module | what it holds |
//! |---|---|
//! | [`columns`] | what one second at a dwell point removes, column by column |
//! | `products` | their products with each other, and an order in which the matrix of these is small |
//! | `fft_operator` | the same removal without a matrix, in memory proportional to the map |
//! | `operator` | the choice between the two, and the normal matrix `B' W B` |

pub mod columns;
pub(crate) mod fft_operator;
pub(crate) mod operator;
pub(crate) mod products;

/// A column whose effect on the map (its energy, or its sensitivity) is below this fraction of the largest
/// does not reach the map: what is left of it there is rounding, and the density of its neighbours goes on there.
pub(crate) const UNREACHED_FRACTION: f64 = 1e-9;

/// Fraction of the largest value that an FFT leaves where nothing is removed.
pub(crate) const FFT_ROUNDING: f64 = 1e-12;

/// Rows of the map that one thread takes at a time. Sums over the map are sums over such bands, so that
/// they do not depend on the number of threads; another number of rows would round them differently.
pub(crate) const ROWS_PER_TASK: usize = 16;
