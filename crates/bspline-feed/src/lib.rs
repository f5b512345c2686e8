//! Desired removal, TIF and tool path become a feed profile and its motion: dwell and feed at once.
//!
//! On every straight pass of the path the dwell-time density (the inverse of the feed) is a cubic
//! B-spline of the arc length, and the removal M is linear in its control values:
//!
//! ```text
//! D_m(s) = sum_i d_mi B_i(s) >= 1/F_max                    s/mm
//! M(x) = sum_m sum_i d_mi G_mi(x),   G_mi(x) = integral R(x - P_m(s)) B_i(s) ds               (1)
//! a = -D'/D^3,   |a| <= A                                  mm/s^2
//! ```
//!
//! | module | what |
//! |---|---|
//! | [`passes`] | the straight passes of a path, what joins them, and what a machine can do on them |
//! | [`columns`] | the material-removal basis G |
//! | [`limited`] | a quadratic objective within the feed and acceleration limits of one pass |
//! | [`deconvolution`] | the control values of all passes for a map: the problem, and the sweeps of knot removal |
//! | `joint` | all control values at once, by the convex-concave procedure, with a proof of how good they are |
//! | [`vrr`] | the baseline: feed = VRR / (desired removal x pitch) |
//! | [`motion`] | the splines as one trajectory, passes joined by links |
//! | [`mod@plan`] | all of it |

// The command line names this library as any other program does.
extern crate self as planish_bspline_feed;

mod cli;
pub mod columns;
pub mod command;
pub mod deconvolution;
mod joint;
pub mod limited;
pub mod motion;
pub mod passes;
pub mod plan;
pub mod vrr;

pub use plan::{FeedPlan, FeedReport, FeedSettings, plan};

use planish_types::Invalid;

/// Reasons why no feed can be found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FeedError {
    /// The inputs or settings contradict themselves or each other.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// A segment with the tool on that belongs to no straight pass lies inside the clear aperture.
    #[error(
        "tool_path: segment {segment} at {point_mm:?} mm turns inside the clear aperture; a B-spline feed \
         needs straight passes that turn outside it: give a raster with overscan, or schedule this \
         path with `planish schedule pvt`"
    )]
    CornerInside {
        /// Index of this segment in the path.
        segment: usize,
        /// Start, middle or end of the segment, whichever is inside first, mm.
        point_mm: [f64; 2],
    },
    /// The path has no straight pass with the tool on, or the tool reaches no valid pixel along its passes.
    #[error(
        "no pass of the path reaches a valid pixel; check that surface, tool path and TIF are in \
         mm and in the same frame"
    )]
    OutOfReach,
    /// The removal basis would not fit into memory.
    #[error(
        "the removal basis of {control_values} control values has {elements} elements, more than \
         {limit}; bin the map and the TIF, or raise `knot_spacing_mm`"
    )]
    TooLarge {
        /// Number of control values of all passes.
        control_values: usize,
        /// Number of pixels of the columns of all control values.
        elements: usize,
        /// Largest allowed number of elements.
        limit: usize,
    },
    /// The quadratic program of a pass was not solved.
    #[error(
        "pass {pass}: the quadratic program ended with {status}; raise `tikhonov` or `knot_spacing_mm`"
    )]
    Solver {
        /// Index of the pass, in the order of the path.
        pass: usize,
        /// Status that the solver reports.
        status: String,
    },
}
