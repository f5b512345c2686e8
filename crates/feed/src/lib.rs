//! Motion and times as one problem: the dwell-time density along a smooth curve.
//!
//! A dwell solver chooses times and a scheduler then looks for a motion that takes them; where the machine is slow
//! the two contradict each other. Here the curve is fixed first, with rounded corners, and the unknown is how fast
//! it is run through. The removal is linear in the dwell-time density, and every iterate of the solver is a motion
//! within the limits.
//!
//! | module | what |
//! |---|---|
//! | [`curve`] | the smooth curve along a path: lines and clothoids |
//! | [`mesh`] | its nodes: what they remove, and how the tool moves between them |
//! | [`limits`] | what the machine allows of that motion |
//! | [`merit`] | what is minimised: residual and price of time |
//! | [`interior_point`] | the least objective under the rows |
//! | [`certificate`] | how far it is above the least, proven |
//! | `refinement` | more nodes where they are worth most |
//! | `problem` | the densities on one mesh after another, until their motion keeps the limits |
//! | [`mod@motion`] | the cubic pieces in time |
//! | [`jerk`] | its average in time, where the machine limits jerk |
//! | `settings` | how to plan |
//! | [`mod@plan`] | all of it, judged as it will be executed |

pub mod certificate;
pub mod curve;
pub mod interior_point;
pub mod jerk;
pub mod limits;
pub mod merit;
pub mod mesh;
pub mod motion;
pub mod plan;
mod problem;
mod refinement;
mod settings;

pub use merit::Price;
pub use plan::{Plan, Report, plan};
pub use settings::Settings;

use planish_dwell::DwellError;
use planish_types::Invalid;

/// Why no feed could be found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FeedError {
    /// The inputs or settings contradict themselves or each other.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The removal model refused.
    #[error(transparent)]
    Dwell(#[from] DwellError),
    /// The program has no unique solution to rounding.
    #[error("the densities are not determined by the surface; raise `tikhonov` (now {tikhonov})")]
    Singular {
        /// alpha.
        tikhonov: f64,
    },
    /// A normal matrix on cells of the map is too far below the curvature: to be made on smaller ones, down to single
    /// pixels, with which this does not happen.
    #[error("cells of {pixels} x {pixels} pixels are too large for this TIF")]
    CellsTooLarge {
        /// Along the side of a cell.
        pixels: usize,
    },
}
