//! How long the tool shall spend where.
//!
//! Every solver is a file and faces the same removal model ([`columns`]): the removal is linear
//! in the dwell times,
//!
//! ```text
//! removal = B t,   B_ij = mean of R(x_i - P) over the dwell point or segment j
//! ```
//!
//! | solver | what it minimises |
//! |---|---|
//! | [`bounded_least_squares`] | RMS of the residual, with bounds on every dwell time |

mod approximate;
pub mod bounded_least_squares;
pub mod columns;
mod fft_operator;

use planish_types::Invalid;

/// Why no dwell time could be found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DwellError {
    /// The inputs or settings contradict themselves or each other.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The tool does not reach the part.
    #[error(
        "none of the {points} dwell points changes the shape of the surface: the tool reaches no \
         valid pixel, or removes the same everywhere; check that surface, tool path and TIF are in mm and in the same frame"
    )]
    OutOfReach {
        /// Dwell points of the path.
        points: usize,
    },
    /// The normal equations are not positive definite.
    #[error(
        "the dwell times are not determined by the surface; raise --tikhonov (now {tikhonov}) above 0"
    )]
    Singular {
        /// Regularisation that was used.
        tikhonov: f64,
    },
}
