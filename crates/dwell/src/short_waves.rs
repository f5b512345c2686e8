//! Waves of a map that no tool of several reaches, so that no dwell times remove them.
//!
//! ```text
//! G_k(f) = |sum R_k exp(-2 pi i f u)| / |sum R_k|               transfer function of tool k
//! short waves: the f with G_k(f) < threshold for every k
//! their RMS  = (sum of S(f) over the short waves / sum of S(f))^(1/2) times the RMS of the plane-free map
//! ```
//!
//! S is the spectrum of the largest rectangle of valid pixels, plane removed, Hann window. The threshold is
//! [`LEAST_TRANSFER`], whose comment has the reason.

use ndarray::{Array2, s};
use planish_numerics::spectrum::{
    Density, LEAST_TRANSFER, MIN_SAMPLES, hann, largest_rectangle, transfer, without_plane,
};
use planish_types::{Surface, Tif};

/// Waves of a map that none of the tools reaches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShortWaves {
    /// Longest wavelength of these waves, mm.
    pub wavelength_mm: f64,
    /// RMS of the map at these waves, nm: no plan of the tools leaves much less.
    pub rms_nm: f64,
}

/// Returns the waves of `desired` that none of `tools` reaches; `None` if a tool reaches all of them, or if the map is
/// too small for a spectrum.
pub fn short_waves(desired: &Surface, tools: &[&Tif]) -> Option<ShortWaves> {
    let valid = desired.height_nm().mapv(|v| !v.is_nan());
    let ((r, c), (ny, nx)) = largest_rectangle(&valid);
    if ny < MIN_SAMPLES || nx < MIN_SAMPLES {
        return None;
    }
    let grid = desired.grid();
    let z = desired.height_nm().slice(s![r..r + ny, c..c + nx]);
    let z = without_plane(z, &grid.x.coordinates()[c..c + nx], &grid.y.coordinates()[r..r + ny]);
    let step_mm = [grid.x.step_mm(), grid.y.step_mm()];
    let Density { frequency_x, frequency_y, density, .. } =
        Density::new(z.view(), step_mm, [&hann(nx), &hann(ny)]);
    let mut is_short = Array2::from_elem(density.dim(), true);
    for tif in tools {
        let [x, y] = [&tif.grid().x, &tif.grid().y].map(|axis| axis.coordinates());
        let gain = transfer(tif.rate_nm_per_s().view(), [&x, &y], [&frequency_x, &frequency_y]);
        is_short.zip_mut_with(&gain, |short, gain| *short &= *gain < LEAST_TRANSFER);
    }
    let mut least_frequency = f64::INFINITY;
    let mut of_short = 0.0;
    for ((r, c), _) in is_short.indexed_iter().filter(|(_, short)| **short) {
        least_frequency = least_frequency.min(frequency_x[c].hypot(frequency_y[r]));
        of_short += density[[r, c]];
    }
    let total = density.sum();
    if least_frequency.is_infinite() || total == 0.0 {
        return None;
    }
    let rms_nm = (of_short / total).sqrt() * desired.detilted_rms_nm();
    Some(ShortWaves { wavelength_mm: 1.0 / least_frequency, rms_nm })
}
