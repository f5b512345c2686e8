//! Dwell times of a tool along its path.
//!
//! Every solver is a file and faces the same removal model ([`columns`]): the removal is linear
//! in the dwell times t,
//!
//! ```text
//! removal  M = B t,   B_ij = mean of R(x_i - P) over the dwell point or segment j
//! ```
//!
//! | solver | what it does |
//! |---|---|
//! | [`bounded_least_squares`] | least RMS of the residual, with bounds on every dwell time |
//! | [`baselines::bcls`] | the same, with bounds from the feed and acceleration limits of a machine |
//! | [`baselines::non_negative_least_squares`] | the same with a floor only, one component at a time |
//! | [`tikhonov_lsqr`] | least sum of squares of the residual and of the dwell times (weighted), without bounds |
//! | [`baselines::truncated_svd`] | least RMS in the space of the large singular values, without bounds |
//! | [`lucy_richardson`] | largest Poisson likelihood by positive steps, total variation |
//! | [`mod@rifta`] | inverse filter with an optimised cap of its gain |
//! | [`mod@udo`] | adjoint image of the extended map, refined by its residual |
//! | [`baselines::feed_law`] | nothing is solved for: the feed law of rasters of one or several pitches |
//!
//! Words of this crate: a *column* j of B is the removal rate of dwell point or segment j on all pixels. It consists
//! of *places*: positions of the tool, each with its fraction of the dwell time. A dwell point is *reached* if its
//! column is not negligible. The *floor* is the lower bound of a dwell time, and the *density* is the dwell time per
//! length of the path.

// The command line names this library as any other program does.
extern crate self as planish_dwell;

pub mod baselines;
pub mod bounded_least_squares;
mod bounds;
mod cli;
mod coarse;
pub mod command;
mod continuation;
mod dwell_map;
mod extension;
pub mod front;
pub mod lucy_richardson;
mod model;
mod objective;
pub mod path_free_bound;
pub mod problem;
pub mod residual;
pub mod residual_slope;
pub mod rifta;
mod surrogate;
pub mod tikhonov_lsqr;
pub mod udo;

pub use model::columns;
use planish_types::Invalid;

/// Reasons for which a solver finds no dwell times.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DwellError {
    /// The inputs or settings are out of range, or contradict each other.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The tool reaches no pixel that counts, or removes the same everywhere.
    #[error(
        "none of the {points} dwell points changes the shape of the surface: the tool reaches no \
         valid pixel, or removes the same everywhere; check that surface, tool path and TIF are in mm and in the same frame"
    )]
    OutOfReach {
        /// Number of dwell points of the path.
        points: usize,
    },
    /// The normal equations of the least-squares problem are not positive definite.
    #[error(
        "the dwell times are not determined by the surface; raise `tikhonov` (now {tikhonov}) above 0"
    )]
    Singular {
        /// Regularisation alpha that was used, dimensionless.
        tikhonov: f64,
    },
    /// One of several tools cannot be planned with.
    #[error("tool {tool:?}: {reason}")]
    OfTool {
        /// Name of the tool.
        tool: String,
        /// Reason for which it cannot.
        reason: Box<DwellError>,
    },
}

impl DwellError {
    /// Returns this error with the name of the tool that it is about.
    pub(crate) fn of_tool(self, tool: &str) -> Self {
        Self::OfTool { tool: tool.to_string(), reason: Box::new(self) }
    }
}
