//! A plan, and the removal of runs whose motion and TIF deviate from it.
//!
//! ```text
//! M(run) = M + (S(run) - S(no error))
//! ```
//!
//! M is executed with the TIF of the plan, S with the TIF that errors move ([`crate::tool`]): the noise of a measured
//! TIF and the step where its samples end belong to its measurement, and a displacement must not move them over the
//! pixels. Where the TIF of the plan is moved as it is, M(run) is S(run).
//!
//! A tool that varies over the part does so in the coordinates of the part: a displaced tool has the weights of the
//! place where it is, and the factor of a pixel stays with the pixel. A factor of the time belongs to the times of the
//! plan; M has it as it is, and S its mean over every piece of the motion.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | M | `executed` | (ny, nx) | nm |
//! | S(no error) | `unchanged` | (ny, nx) | nm |

use std::borrow::Cow;

use ndarray::Array2;
use planish_types::{Grid, Invalid, Tif, Trajectory, text::significant};

use crate::{
    SimulationPlan, SimulationSettings,
    deviation::{Deviation, check_tool},
    error_budget::{Effect, ErrorBudget, Noise, Scalar},
    gridded,
    motion::Motion,
};

/// Largest displacement of the tool by an error, in lengths of the longer side of the TIF's samples; a larger one is
/// refused as no error of a process. Larger: mistakes in the units pass. Smaller: large but real errors are refused.
const LARGEST_DISPLACEMENT: f64 = 1.0;

/// Largest length of a piece of the motion, in widths of the TIF; each piece has one position error. Larger: a larger
/// error. Smaller: more pieces, and more time.
const LONGEST_OVER_WIDTH: f64 = 0.5;

/// A plan on the pixels of a map, prepared for runs with errors.
pub struct Runs<'a> {
    /// The TIF that errors change, without its factor of the time, which the motion holds.
    tif: Cow<'a, Tif>,
    grid: Grid,
    plan: gridded::GriddedPlan,
    /// Motion of the plan in pieces.
    pub motion: Motion,
    /// Removal of the plan with its own TIF (M of the module), shape (ny, nx), nm.
    pub executed: Array2<f64>,
    /// Removal without errors with the TIF that errors change (S(no error)), shape (ny, nx), nm.
    pub unchanged: Array2<f64>,
    width_mm: f64,
}

impl<'a> Runs<'a> {
    /// Prepares runs of `trajectory` on the pixels of `grid`. The removal of the plan is computed with `tif`, and the
    /// changes by errors with the TIF `moved`, which may be `tif` itself.
    pub fn new(
        trajectory: &Trajectory,
        tif: &Tif,
        moved: &'a Tif,
        grid: &Grid,
    ) -> Result<Self, Invalid> {
        let width_mm = tif.width_mm();
        let motion = Motion::new(trajectory, LONGEST_OVER_WIDTH * width_mm)?.with_rate_of(moved);
        let moved = moved.without_time();
        let executed =
            SimulationPlan::new(tif, grid, SimulationSettings::Gridded)?.removal_nm(trajectory)?.0;
        let plan = gridded::GriddedPlan::new(&moved, grid)?;
        let as_planned = Deviation::default().trajectory(&motion, grid)?;
        let unchanged = plan.removal_nm(&as_planned).0;
        Ok(Self { tif: moved, grid: *grid, plan, motion, executed, unchanged, width_mm })
    }

    /// Returns the removal S(run) of the module, with the deviations of one run and the TIF that errors change, shape
    /// (ny, nx), nm.
    ///
    /// # Errors
    ///
    /// Fails as [`Deviation::trajectory`] and [`Deviation::tif`] do.
    pub fn moved_nm(&self, run: &Deviation) -> Result<Array2<f64>, Invalid> {
        let trajectory = run.trajectory(&self.motion, &self.grid)?;
        Ok(match run.tif(&self.tif)? {
            Some(tif) => gridded::GriddedPlan::new(&tif, &self.grid)?.removal_nm(&trajectory).0,
            None => self.plan.removal_nm(&trajectory).0,
        })
    }

    /// Returns the removal M(run) of the module for one run, shape (ny, nx), nm.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::moved_nm`] does.
    pub fn removal_nm(&self, run: &Deviation) -> Result<Array2<f64>, Invalid> {
        Ok(&self.executed + &(self.moved_nm(run)? - &self.unchanged))
    }

    /// Returns half the diagonal of the map, mm.
    fn reach_mm(&self) -> f64 {
        let size = self.grid.size_mm();
        0.5 * size[0].hypot(size[1])
    }

    /// Returns the largest displacement of the tool on the map, mm, per unit of the size of an effect; 0 for errors of
    /// the rate. For a change of the TIF it is the width of the TIF.
    pub fn displacement_per_size(&self, effect: Scalar) -> f64 {
        match effect {
            Scalar::RateScale | Scalar::RateDrift | Scalar::RateWarmUp { .. } => 0.0,
            Scalar::OffsetX | Scalar::OffsetY | Scalar::Backlash => 1.0,
            Scalar::Rotation | Scalar::Magnification | Scalar::Shear => self.reach_mm(),
            Scalar::TifWidth
            | Scalar::TifEllipticity
            | Scalar::TifDiagonalEllipticity
            | Scalar::TifRotation => self.width_mm,
            Scalar::VelocityLag
            | Scalar::ServoFirstOrder
            | Scalar::ServoSecondOrder { .. }
            | Scalar::Smoothing
            | Scalar::CornerSpeed { .. } => self.motion.largest_speed_mm_per_s(),
        }
    }

    /// Refuses errors that displace the tool by more than the longer side of the TIF's samples, and what [`check_tool`]
    /// refuses. A lag may be of any size.
    pub fn check_sizes(&self, process: &ErrorBudget) -> Result<(), Invalid> {
        check_tool(process, &self.tif)?;
        let [x, y] = self.tif.grid().size_mm();
        let largest = LARGEST_DISPLACEMENT * x.max(y);
        for (i, error) in process.errors.iter().enumerate() {
            let moved = match error.effect {
                // The tool comes later to where it should be, and removes there what it should.
                Effect::Scalar(effect) if effect.is_a_lag() => 0.0,
                Effect::Scalar(effect) => self.displacement_per_size(effect) * error.size,
                Effect::Noise(Noise::Position) => error.size,
                _ => 0.0,
            };
            if moved.abs() > largest {
                let stated = &error.stated;
                let problem = format!(
                    "{} of {} {} moves the tool by {} mm, and the TIF is {} mm wide",
                    stated.kind.name(),
                    stated.size,
                    stated.unit,
                    significant(moved, 4),
                    significant(largest, 4)
                );
                let most = significant(largest / moved.abs() * stated.size.abs(), 3);
                let remedy = format!(
                    "give at most {most} {}: an error moves the tool by less than the TIF is wide",
                    stated.unit
                );
                return Err(Invalid::at_index("errors", i, problem, remedy));
            }
        }
        Ok(())
    }
}
