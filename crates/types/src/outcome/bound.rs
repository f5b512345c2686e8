//! Outcome of `planish dwell bound`: residuals that no path and no motion of a tool can beat.

use serde::{Deserialize, Serialize};

use crate::TifLattice;

/// Bounds of the residual on any path.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PathFreeBounds {
    /// Number of valid pixels.
    pub pixels: usize,
    /// RMS of the desired removal, nm.
    pub desired_rms_nm: f64,
    /// Lattice of the map on which the TIF was sampled anew; left out where the samples are its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tif_lattice: Option<TifLattice>,
    /// A bound per run time or price, in the order of the settings, the run times first.
    pub bounds: Vec<PathFreeBound>,
}

/// Lower bound of the residual on any path for one run time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PathFreeBound {
    /// Run time T, s. For a price it is the time of the best dwell times.
    pub time_s: f64,
    /// Residual RMS, nm, below which no path and no motion of this tool gets in T.
    pub bound_rms_nm: f64,
    /// Residual RMS, nm, that dwell times at any place of a lattice leave in T.
    pub reached_rms_nm: f64,
    /// Difference of both over the reached residual.
    pub gap: f64,
    /// Slope of the bound, nm/s: for another time T' the residual is at least `bound_rms_nm` minus this times T' - T.
    pub bound_slope_nm_per_s: f64,
    /// Price of a second at the bound, relative to half the mean square of the residual, nm^2/s.
    pub time_weight_nm2_per_s: f64,
    /// Place of the tool [x, y], mm, at which a further second would remove most of the bound's residual; absent if
    /// none would.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub place_mm: Option<[f64; 2]>,
}

impl PathFreeBounds {
    /// Returns the bound of the residual RMS, nm, for a run of `time_s`: the best of all.
    pub fn at_time_nm(&self, time_s: f64) -> f64 {
        self.bounds.iter().map(|bound| bound.at_time_nm(time_s)).fold(0.0, f64::max)
    }
}

impl PathFreeBound {
    /// Returns the bound of the residual RMS, nm, for a run of `time_s`.
    pub fn at_time_nm(&self, time_s: f64) -> f64 {
        self.bound_rms_nm - self.bound_slope_nm_per_s * (time_s - self.time_s)
    }
}
