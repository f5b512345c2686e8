//! Motion and times as one problem: the dwell-time density along a smooth curve.
//!
//! A dwell solver chooses times, and a scheduler then looks for a motion that takes them. On a slow machine the two
//! contradict each other. In a joint plan the curve is fixed first, with rounded corners, and the unknown is the
//! dwell-time density along it (time per length, s/mm). The removal is linear in this density, and every iterate of the
//! solver is a motion within the limits.
//!
//! | module | contents |
//! |---|---|
//! | [`curve`] | the smooth curve along a path: lines and clothoids |
//! | [`mesh`] | nodes of the density: their removal, and the motion between them |
//! | [`further`] | axes beyond x and y: their limits and positions |
//! | [`axes`] | the judge of their motion |
//! | `machine_axes` | these axes from the kinematics of a machine and the form of the part |
//! | [`limits`] | limits of the machine on that motion |
//! | [`merit`] | the objective: residual and price of time |
//! | [`interior_point`] | the solver: the least objective under the limits |
//! | [`certificate`] | proven bound on the excess of the objective over its least value |
//! | `refinement` | nodes added where they lower the objective most |
//! | `problem` | the densities on one mesh after another, until their motion keeps the limits |
//! | [`mod@motion`] | the cubic pieces in time |
//! | [`jerk`] | the average of the motion in time, if the machine limits jerk |
//! | `settings` | settings of the plan |
//! | `plan` | all of it, judged as it will be executed |
//!
//! Words of this crate: a node is a point of the curve with an unknown density, and a span the part of the curve
//! between two nodes. A row is a constraint `c >= 0` on the densities that a limit of the machine imposes. The pull is
//! the Tikhonov term of the objective, which draws the densities to their least values. A round is one solution of the
//! convex program, after which limits are tightened or new tangents are taken. The judge is the proof that a motion
//! keeps the limits, by `planish verify` or by [`axes`]. Further axes are those beyond x and y.

// The command line names this library as any other program does.
extern crate self as planish_joint;

pub mod axes;
pub mod certificate;
mod cli;
mod clothoid_spline;
pub mod command;
pub mod curve;
pub mod further;
pub mod interior_point;
pub mod jerk;
pub mod limits;
mod machine_axes;
pub mod merit;
pub mod mesh;
pub mod motion;
pub mod piece;
mod plan;
mod problem;
mod refinement;
mod settings;

pub use further::{FurtherAxes, FurtherLimits};
pub use machine_axes::MachineAxes;
pub use merit::Price;
pub use plan::{JointPlan, JointReport, plan, plan_with_further_axes};
pub use settings::JointSettings;

use planish_dwell::DwellError;
use planish_types::Invalid;

/// Reason why no joint plan could be found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum JointError {
    /// The inputs or settings contradict themselves or each other.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The removal model of the dwell solver failed.
    #[error(transparent)]
    Dwell(#[from] DwellError),
    /// The matrix of the solver is singular to rounding, so that the densities have no unique solution.
    #[error("the densities are not determined by the surface; raise `tikhonov` (now {tikhonov})")]
    Singular {
        /// Tikhonov weight of the plan (alpha), dimensionless.
        tikhonov: f64,
    },
    /// The normal matrix, which is computed on cells of several pixels of the map, is too far below the true curvature.
    /// It must be made on smaller cells; with single pixels this does not happen.
    #[error("cells of {pixels} x {pixels} pixels are too large for this TIF")]
    CellsTooLarge {
        /// Number of pixels along a side of a cell.
        pixels: usize,
    },
}
