//! Removal of a trajectory: the time integral of the TIF along the motion.
//!
//! ```text
//! M(x) = integral over the time the tool is on of  w(t) R(x - P(t)) dt
//! ```
//!
//! with the TIF `R` of [`planish_types::Tif`]. The position `P` is that of the trajectory, never of the dwell points.
//! The rate factor `w` is 1 except for logs that have a beam current.
//!
//! Source: the convolution model of computer-controlled optical surfacing (Jones, Appl. Opt. 16 (1977) 218), with the
//! executed motion in place of the dwell map.
//!
//! Two methods, which share nothing but the definition of R:
//!
//! * [`gridded`]: exact quadrature ([`quadrature`]) and FFT convolution; the default.
//! * [`direct`]: midpoint quadrature, pixel by pixel; slow, and the oracle of the other.
//!
//! [`frames`] computes the removal part by part: the surface in the course of the run. [`coverage`] reports the part
//! of the map that the tool touches. [`between`] reports the dependence of a prediction on the interpolation of the
//! TIF.
//!
//! A motion of an imperfect process is simulated as another motion with another TIF. [`error_budget`] reads the errors,
//! [`sample`] draws them, and [`deviation`] applies them with [`motion`], [`planner`], [`servo`], [`tool`] and the play
//! of the axes. [`runs`] computes the removal with them. [`virtual_machine`] runs a plan with them and measures the
//! residual.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | R | `tif` | (my, mx) | nm/s |
//! | P | `trajectory` | (k, 2, 4) | mm |
//! | M | `removal_nm` | (ny, nx) | nm |

// The command line names this library as any other program does.
extern crate self as planish_simulate;

pub mod between;
mod cli;
pub mod command;
pub mod coverage;
pub mod deviation;
pub mod direct;
pub mod error_budget;
pub mod frames;
pub mod gridded;
mod kernel;
mod lattice;
pub mod motion;
pub mod planner;
mod play;
pub mod quadrature;
pub mod runs;
pub mod sample;
pub mod servo;
mod spill;
pub mod tail;
mod tile;
pub mod tool;
pub mod virtual_machine;

use ndarray::Array2;
use planish_types::{
    Grid, Invalid, Removal, Surface, Tif, Trajectory, doubts,
    plausible::{self, Rms},
    progress,
};
use serde::Serialize;

/// Method that computes the removal, the integral of the module.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "method", rename_all = "kebab-case")]
pub enum SimulationSettings {
    /// Exact quadrature and FFT convolution.
    Gridded,
    /// Midpoint rule pixel by pixel, with equal time steps in each segment.
    Direct {
        /// Number of time steps per segment; >= 1.
        steps: usize,
    },
}

/// A predicted removal and residual, and data on the computation.
#[derive(Clone, Debug)]
pub struct Prediction {
    /// Removal and residual.
    pub removal: Removal,
    /// Quadrature points, lattice and interpolation error of this computation of the removal.
    pub numerics: Numerics,
}

impl Prediction {
    /// Returns the reason why the motion should not be run on the surface `desired`, for example that it increases the
    /// error, with the mistake that would explain it; otherwise `None`. `total_time_s` is the duration of the motion.
    pub fn drawback(&self, desired: &Surface, total_time_s: f64) -> Option<String> {
        let after = Rms::of_surface(self.removal.residual());
        let reason = plausible::drawback(Rms::of_surface(desired), after, total_time_s)?;
        Some(match doubts::of_residual(desired, &self.removal) {
            Some(doubt) => format!("{reason}; {doubt}"),
            None => reason,
        })
    }
}

/// Quadrature points, lattice and interpolation error of a computation of the removal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Numerics {
    /// Number of quadrature points along the motion.
    pub quadrature_points: usize,
    /// Number of lattice steps per pixel of the map along [x, y]; above 1 for a TIF that is sampled more finely, by a
    /// whole number. It is 1 for the direct method.
    pub subdivision: [usize; 2],
    /// Largest error of the TIF that is interpolated on the lattice, relative to its peak. It is 0 if the pitch of the
    /// TIF is that of the map or divides it, and for the direct method.
    pub tif_interpolation_error: f64,
}

/// Prepared data that depend on the TIF and the map only and serve many trajectories.
pub enum SimulationPlan<'a> {
    /// Data of the method [`SimulationSettings::Gridded`].
    Gridded(Box<gridded::GriddedPlan>),
    /// Inputs of the method [`SimulationSettings::Direct`], which prepares nothing.
    Direct {
        /// TIF of the tool.
        tif: &'a Tif,
        /// Pixels of the map.
        grid: &'a Grid,
        /// Number of time steps per segment.
        steps: usize,
    },
}

impl<'a> SimulationPlan<'a> {
    /// Prepares the removal of `tif` on the pixels of `grid`.
    ///
    /// # Errors
    ///
    /// Refuses what [`gridded::GriddedPlan::new`] refuses; the direct method refuses nothing here.
    pub fn new(
        tif: &'a Tif,
        grid: &'a Grid,
        settings: SimulationSettings,
    ) -> Result<Self, Invalid> {
        Ok(match settings {
            SimulationSettings::Gridded => {
                Self::Gridded(Box::new(gridded::GriddedPlan::new(tif, grid)?))
            }
            SimulationSettings::Direct { steps } => Self::Direct { tif, grid, steps },
        })
    }

    /// Computes the removal of `trajectory`, shape (ny, nx), nm.
    ///
    /// # Errors
    ///
    /// Refuses the steps that [`direct::removal_nm`] refuses.
    pub fn removal_nm(&self, trajectory: &Trajectory) -> Result<(Array2<f64>, Numerics), Invalid> {
        self.removal_with_progress(trajectory, &|_| ())
    }

    /// Computes the removal, and calls `tell` with the fraction that is done.
    fn removal_with_progress(
        &self,
        trajectory: &Trajectory,
        tell: Tell<'_>,
    ) -> Result<(Array2<f64>, Numerics), Invalid> {
        match self {
            Self::Gridded(plan) => Ok(plan.removal_with_progress(trajectory, tell)),
            Self::Direct { tif, grid, steps } => {
                direct::removal_with_progress(trajectory, tif, grid, *steps, tell)
            }
        }
    }

    /// Predicts the removal of `trajectory` and the residual of `desired`, whose pixels are those of the plan.
    ///
    /// # Errors
    ///
    /// Refuses what [`Self::removal_nm`] refuses, and a map of another shape than the planned pixels.
    pub fn predict(
        &self,
        trajectory: &Trajectory,
        desired: &Surface,
    ) -> Result<Prediction, Invalid> {
        let (removal_nm, numerics) = self.removal_nm(trajectory)?;
        Ok(Prediction { removal: Removal::new(desired, removal_nm)?, numerics })
    }
}

/// Function that receives the fraction of a computation that is done, 0 to 1. A computation that is a step of another
/// gets one that reports nothing; the other reports its own progress.
type Tell<'a> = &'a (dyn Fn(f64) + Sync);

/// Predicts the removal of `trajectory` and the residual of `desired` on the pixels of `desired`, and reports its
/// progress ([`progress`]).
///
/// # Errors
///
/// Refuses what [`SimulationPlan::new`] and [`SimulationPlan::removal_nm`] refuse.
pub fn simulate(
    trajectory: &Trajectory,
    tif: &Tif,
    desired: &Surface,
    settings: SimulationSettings,
) -> Result<Prediction, Invalid> {
    let plan = SimulationPlan::new(tif, desired.grid(), settings)?;
    let (removal_nm, numerics) = plan.removal_with_progress(trajectory, &progress::done)?;
    Ok(Prediction { removal: Removal::new(desired, removal_nm)?, numerics })
}
