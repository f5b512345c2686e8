//! Extension in which every new pixel has the height of the nearest valid one, decaying to zero.
//!
//! ```text
//! z(p) = z(q) exp(-|p - q|^2 / 2 sigma^2),  q the valid pixel with the least |p - q|
//! ```
//!
//! Zero is the smallest desired removal after levelling, so the dwell times beyond the edge are shorter and
//! the run is shorter. But the tool leaves the part while it still overlaps the edge, and some tenths of a
//! nanometre remain there. Use it for a short run whose edge does not matter.

use ndarray::{Array2, Zip};
use planish_types::{Grid, Invalid};
use serde::Serialize;

use crate::distance;

/// Settings of the decay.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GaussianDecaySettings {
    /// Distance at which the height has fallen to exp(-1/2) = 0.61, mm; > 0.
    pub sigma_mm: f64,
}

impl GaussianDecaySettings {
    /// Returns the usual decay for a margin: a third of it as `sigma_mm`, so that the height falls to 1 % at the outer
    /// edge.
    pub fn for_margin_mm(margin_mm: f64) -> Self {
        Self { sigma_mm: margin_mm / 3.0 }
    }
}

/// Returns `map` (ny, nx), which has the margin already, with a height on every pixel. Refuses a `sigma_mm` that is not
/// positive.
pub(super) fn extend(
    map: &Array2<f64>,
    grid: &Grid,
    settings: &GaussianDecaySettings,
) -> Result<Array2<f64>, Invalid> {
    let sigma = settings.sigma_mm;
    if !(sigma.is_finite() && sigma > 0.0) {
        return Err(Invalid::whole(
            "extension sigma",
            format!("is {sigma} mm"),
            "give a positive length in mm; a third of the margin decays to 1 %",
        ));
    }
    let near = distance::nearest(map.view(), grid);
    // z(p) = z(q) exp(-d^2 / 2 sigma^2)
    Ok(Zip::from(&near.place)
        .and(&near.distance_mm)
        .map_collect(|pixel, d| map[*pixel] * (-0.5 * (d / sigma).powi(2)).exp()))
}
