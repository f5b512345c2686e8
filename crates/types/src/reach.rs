//! Part of a map at wavelengths that are too short for its tools to correct.
//!
//! ```text
//! G_k(f) = |sum R_k exp(-2 pi i f u)| / |sum R_k|                  transfer function of tool k
//! short-wave fraction = sum of S(f) where G_k(f) < threshold for every k / sum of S(f)
//! short-wave RMS      = RMS sqrt(fraction),   RMS of the plane-free map
//! ```
//!
//! so that the squares of the short-wave RMS and of the rest add up to that of the RMS without the plane. S is the
//! two-dimensional spectrum of the report: of the largest rectangle of valid pixels, plane removed, Hann window.
//!
//! The short-wave RMS is a description of a residual, not a bound on it. It contains the ripple that the lines of the
//! path leave, and the part that the window spreads from longer waves; other dwell times change both. The map outside
//! of the rectangle counts as if its spectrum were the same.
//!
//! The threshold is [`LEAST_TRANSFER`], whose comment has the reason. A Gaussian TIF reaches it at a period of 2.07
//! sigma; a measured one has side lobes above it at shorter periods.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | R, removal rate at the offset u from the tool centre | `tif` | (my, mx) | nm/s |
//! | S, power spectral density of the residual at the frequency f | `density` | (ny, nx) | nm^2 mm^2 |

use ndarray::{Array2, ArrayView1, s};
use planish_numerics::spectrum::{
    Density, LEAST_TRANSFER, MIN_SAMPLES, hann, largest_rectangle, transfer, without_plane,
};
use serde::Serialize;

use crate::{Surface, Tif};

/// Limit between the waves that the tools can correct and the short waves, which none of them can.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ReachReport {
    /// Value of the transfer function, 0 to 1, below which a wave counts as short.
    pub transfer_threshold: f64,
    /// Longest period of the short waves along [x, y], mm; `null` if no wave along that axis is short.
    pub period_mm: [Option<f64>; 2],
}

/// Waves of a map that are too short for all of its tools, with the rectangle of the map in which they are measured. `origin` is
/// the row and column of its first pixel, `step_mm` the pitch along [x, y].
#[derive(Clone, Debug)]
pub struct Reach {
    origin: (usize, usize),
    x_mm: Vec<f64>,
    y_mm: Vec<f64>,
    step_mm: [f64; 2],
    /// True for the frequencies of short waves (ny, nx), in the order of a [`Density`].
    is_short: Array2<bool>,
    longest_mm: Option<f64>,
    report: ReachReport,
}

impl Reach {
    /// Finds the waves that none of `tools` reaches on maps with the valid pixels of `surface`. Returns `None` if their
    /// largest rectangle is too small for a spectrum.
    pub fn new(surface: &Surface, tools: &[&Tif]) -> Option<Self> {
        let valid = surface.height_nm().mapv(|v| !v.is_nan());
        let (origin, (ny, nx)) = largest_rectangle(&valid);
        if ny < MIN_SAMPLES || nx < MIN_SAMPLES {
            return None;
        }
        let grid = surface.grid();
        let step_mm = [grid.x.step_mm(), grid.y.step_mm()];
        // The frequencies of its spectra, which do not depend on the heights.
        let flat = Array2::zeros((ny, nx));
        let Density { frequency_x, frequency_y, .. } =
            Density::new(flat.view(), step_mm, [&vec![1.0; nx], &vec![1.0; ny]]);
        let mut is_short = Array2::from_elem((ny, nx), true);
        for tif in tools {
            let [x, y] = [&tif.grid().x, &tif.grid().y].map(|axis| axis.coordinates());
            let gain = transfer(tif.rate_nm_per_s().view(), [&x, &y], [&frequency_x, &frequency_y]);
            is_short.zip_mut_with(&gain, |short, gain| *short &= *gain < LEAST_TRANSFER);
        }
        let short = is_short.indexed_iter().filter(|(_, short)| **short);
        let least = short.map(|((r, c), _)| frequency_x[c].hypot(frequency_y[r])).reduce(f64::min);
        let zero_x = frequency_x.iter().position(|f| *f == 0.0)?;
        let zero_y = frequency_y.iter().position(|f| *f == 0.0)?;
        let period_mm = [
            first_period_mm(&frequency_x, is_short.row(zero_y)),
            first_period_mm(&frequency_y, is_short.column(zero_x)),
        ];
        Some(Self {
            origin,
            x_mm: grid.x.coordinates()[origin.1..origin.1 + nx].to_vec(),
            y_mm: grid.y.coordinates()[origin.0..origin.0 + ny].to_vec(),
            step_mm,
            is_short,
            longest_mm: least.map(|frequency| 1.0 / frequency),
            report: ReachReport { transfer_threshold: LEAST_TRANSFER, period_mm },
        })
    }

    /// Returns the threshold and the longest periods of the short waves.
    pub fn report(&self) -> ReachReport {
        self.report
    }

    /// Returns the longest wavelength of the short waves in any direction, mm; `None` if a tool reaches every wave.
    pub fn longest_mm(&self) -> Option<f64> {
        self.longest_mm
    }

    /// Returns the short-wave RMS of `surface` (see the module), nm: the part at wavelengths too short for the tools.
    pub fn short_wave_rms_nm(&self, surface: &Surface) -> f64 {
        let (ny, nx) = self.is_short.dim();
        let (r, c) = self.origin;
        let z = surface.height_nm().slice(s![r..r + ny, c..c + nx]);
        let z = without_plane(z, &self.x_mm, &self.y_mm);
        let density = Density::new(z.view(), self.step_mm, [&hann(nx), &hann(ny)]).density;
        let short: f64 = density
            .iter()
            .zip(&self.is_short)
            .filter(|(_, is_short)| **is_short)
            .map(|(s, _)| s)
            .sum();
        let whole = density.sum();
        let fraction = if whole > 0.0 { (short / whole).min(1.0) } else { 0.0 };
        surface.detilted_rms_nm() * fraction.sqrt()
    }
}

/// Returns the period of the first positive frequency that is short, mm; `None` if there is none. `frequencies` ascend,
/// 1/mm, and `is_short` says which of them belong to short waves.
fn first_period_mm(frequencies: &[f64], is_short: ArrayView1<bool>) -> Option<f64> {
    let mut all = frequencies.iter().zip(is_short);
    all.find(|(f, is_short)| **f > 0.0 && **is_short).map(|(f, _)| 1.0 / f)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axis, Grid};
    use std::f64::consts::PI;

    fn gaussian(sigma_mm: f64) -> Tif {
        let axis = Axis::new(-10.0, 0.25, 81).unwrap();
        let grid = Grid { x: axis, y: axis };
        let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            5.0 * (-0.5 * (axis.coordinate_mm(c).powi(2) + axis.coordinate_mm(r).powi(2))
                / sigma_mm.powi(2))
            .exp()
        });
        Tif::new(grid, rate).unwrap()
    }

    #[test]
    fn a_short_wave_counts_and_a_long_one_does_not() {
        // Whole periods of 8 mm and 2 mm on 64 x 32 mm; sigma 2 mm: the threshold is at 4.14 mm.
        let grid =
            Grid { x: Axis::new(0.0, 0.25, 256).unwrap(), y: Axis::new(0.0, 0.25, 128).unwrap() };
        let tif = gaussian(2.0);
        for turned in [false, true] {
            for (long, short) in [(3.0, 4.0), (1.0, 0.0), (0.0, 2.0)] {
                let map = Array2::from_shape_fn(grid.shape(), |(r, c)| {
                    let u = 0.25 * (if turned { r } else { c }) as f64;
                    7.0 + long * (2.0 * PI * u / 8.0).cos() + short * (2.0 * PI * u / 2.0).cos()
                });
                let surface = Surface::new(grid, map).unwrap();
                let reach = Reach::new(&surface, &[&tif]).unwrap();
                // sqrt(ln 100 / (2 pi^2)) / sigma = 0.2415 /mm, on frequencies 1/64 and 1/32 apart.
                let [x, y] = reach.report().period_mm.map(Option::unwrap);
                assert_eq!((1.0 / x, 1.0 / y), (0.25, 0.25));
                let found = reach.short_wave_rms_nm(&surface);
                // Of two tools the narrower one decides, in any order.
                let wide = gaussian(3.0);
                for tools in [[&wide, &tif], [&tif, &wide]] {
                    let both = Reach::new(&surface, &tools).unwrap();
                    assert_eq!(both.short_wave_rms_nm(&surface), found);
                    assert_eq!(both.longest_mm(), reach.longest_mm());
                }
                // The first frequency beyond the threshold, in any direction, is at most as far as that along an axis.
                assert!(reach.longest_mm().is_some_and(|mm| (4.0..=1.0 / 0.2415).contains(&mm)));
                // The plane takes 1e-3 of the wave of 8 mm, 2 % along the shorter side.
                assert!((found - short / 2.0_f64.sqrt()).abs() < 0.02, "{found} {short}");
            }
        }
    }

    #[test]
    fn holes_are_left_out_and_a_flat_map_has_nothing() {
        let axis = Axis::new(0.0, 0.25, 100).unwrap();
        let grid = Grid { x: axis, y: axis };
        let mut map = Array2::zeros((100, 100));
        map[[3, 50]] = f64::NAN;
        let flat = Surface::new(grid, map).unwrap();
        let reach = Reach::new(&flat, &[&gaussian(2.0)]).unwrap();
        assert_eq!(reach.origin, (4, 0));
        assert_eq!(reach.short_wave_rms_nm(&flat), 0.0);
        let small = Grid { x: axis, y: Axis::new(0.0, 0.25, 7).unwrap() };
        let small = Surface::new(small, Array2::zeros((7, 100))).unwrap();
        assert!(Reach::new(&small, &[&gaussian(2.0)]).is_none());
    }
}
