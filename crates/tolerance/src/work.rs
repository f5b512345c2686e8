//! A plan with the errors of its process: the residual of a run with any of them, by simulation.

use ndarray::Array2;
use planish_simulate::{
    coverage::Coverage,
    runs::Runs,
    sample::{legendre_terms, low_orders},
};
use planish_types::{Invalid, Surface, Tif, Trajectory};

use crate::{
    deviation::Deviation,
    error_budget::{Effect, ErrorBudget, Noise, Scalar},
    inner::Inner,
    motion::Motion,
    settings::Free,
};

/// Plan, process, and the prepared data from which the effects of errors are computed.
pub struct Work<'a> {
    runs: Runs<'a>,
    pub inner: Inner,
    pub process: &'a ErrorBudget,
    /// Residual of the plan without errors, P (z - M) of the crate's documentation, shape (ny, nx), nm.
    pub nominal: Array2<f64>,
    /// Coverage of the map by the plan.
    pub coverage: Coverage,
}

impl<'a> Work<'a> {
    /// Prepares a plan with the TIF `tif`. The effects of errors are computed with the TIF `moved`; `width` is the
    /// width of both, mm.
    ///
    /// # Errors
    /// Refuses a log with the rate of its beam, and what [`Runs::new`] and [`Runs::check_sizes`] refuse.
    pub fn new(
        trajectory: &Trajectory,
        tif: &Tif,
        moved: &'a Tif,
        desired: &'a Surface,
        process: &'a ErrorBudget,
        free: Free,
        width: f64,
    ) -> Result<Self, Invalid> {
        // A log with the rate of its beam is one run, and a budget is of a plan.
        trajectory.check_rate_is_constant()?;
        let inner = Inner::new(desired, free, width);
        let runs = Runs::new(trajectory, tif, moved, desired.grid())?;
        let nominal = inner.judged(desired.height_nm() - &runs.executed);
        runs.check_sizes(process)?;
        let coverage = Coverage::new(&runs.executed, trajectory, tif, desired);
        Ok(Self { runs, inner, process, nominal, coverage })
    }

    /// Returns the motion of the plan in pieces.
    pub fn motion(&self) -> &Motion {
        &self.runs.motion
    }

    /// Returns the RMS of a map that is 0 at invalid pixels, nm.
    pub fn rms(&self, judged: &Array2<f64>) -> f64 {
        self.inner.dot(judged, judged).sqrt()
    }

    /// Returns the largest displacement of the tool, mm, per unit of the size of an effect. For a change of the TIF it
    /// is the width of the TIF.
    pub fn displacement_per_size(&self, effect: Scalar) -> f64 {
        self.runs.displacement_per_size(effect)
    }

    /// Simulates the residual of a run without its free terms, shape (ny, nx), nm.
    ///
    /// # Errors
    /// Refuses a deviation that cannot be simulated.
    pub fn residual(&self, run: &Deviation) -> Result<Array2<f64>, Invalid> {
        let mut more = &self.runs.unchanged - &self.runs.moved_nm(run)?;
        if let Some(map) = &run.map_nm {
            more += map;
        }
        Ok(&self.nominal + &self.inner.judged(more))
    }

    /// Returns the Legendre polynomials of total degree 1 to `degree` on the map, each with an RMS of one over its
    /// rectangle.
    pub fn low_order(&self, degree: usize) -> Vec<Array2<f64>> {
        legendre_terms(&self.inner.grid, &low_orders(degree))
    }

    /// Returns each noise along the run with a size above 0: the index of the error in the budget, its kind, and its
    /// size in the unit of the calculation.
    pub fn noises(&self) -> Vec<(usize, Noise, f64)> {
        let each = self.process.errors.iter().enumerate();
        each.filter_map(|(i, e)| match e.effect {
            Effect::Noise(noise) if e.size > 0.0 => Some((i, noise, e.size)),
            _ => None,
        })
        .collect()
    }
}
