//! The removal model of the dwell solvers, `removal = B t`, and B as an operator.
//!
//! | module | what it holds |
//! |---|---|
//! | [`columns`] | what one second at a dwell point removes, column by column |
//! | `products` | products of columns with each other, and an order of the columns that makes their matrix small |
//! | `fft_operator` | the same removal without a matrix, in memory proportional to the map |
//! | `place` | a place: one position of the tool in a column, with its fraction of the dwell time |
//! | `varying` | the kernels of a tool that is not the same everywhere |
//! | `stacked` | the columns of several tools side by side |
//! | `operator` | the choice between stored columns and the FFT, and the normal matrix `B' W B` |

pub mod columns;
pub(crate) mod fft_operator;
pub(crate) mod operator;
mod place;
pub(crate) mod products;
pub(crate) mod stacked;
pub(crate) mod varying;

/// Effect of a column on the map, as a fraction of the largest of all columns, below which the column counts as
/// unreached. The effect is the energy (sum of the squared rates) or the sensitivity (sum of the rates), which depends
/// on the solver. A smaller effect is only rounding, and the density of the neighbours is continued there. Larger:
/// weakly reached dwell points are not solved for. Smaller: rounding decides dwell times.
pub(crate) const UNREACHED_FRACTION: f64 = 1e-9;

/// Fraction of the largest value up to which a result of an FFT counts as rounding, that is, as no removal. Larger:
/// weak removals are refused. Smaller: rounding passes as removal.
pub(crate) const FFT_ROUNDING: f64 = 1e-12;

/// Number of rows of the map that one thread takes at a time. Sums over the map are sums over such bands, so that
/// they do not depend on the number of threads. Larger: fewer tasks for the threads. Smaller: more overhead. Another
/// value rounds the sums differently.
pub(crate) const ROWS_PER_TASK: usize = 16;
