//! Parallel lines at a uniform dwell-time density, and the ripple that they leave.
//!
//! ```text
//! z(y) = (delta / d) VRR [1 + 2 sum_n L(n / d) cos(2 pi n (y - y_0) / d)]                    (1)
//! ```
//!
//! with the Fourier transform L of the TIF's line integral, L(0) = 1 (Poisson's summation; Eq. 18 of
//! the trigonometric-spline paper). A Gaussian has `L(f) = exp(-2 pi^2 sigma^2 f^2)`; a sum of
//! Gaussians the mean weighted by their volumes.

use std::f64::consts::PI;

use ndarray::Array2;
use planish_schedule::baselines::average_velocity;
use planish_simulate::{SimulationSettings as Settings, simulate};
use planish_testkit::ion_beam;
use planish_toolpath::{RasterSettings, raster};
use planish_types::{Axis, DwellTime, Grid, Surface, Tif, ToolPath};

/// Pixel of the simulated maps and of the TIF, mm. Larger: less time and a less accurate ripple. Smaller:
/// the reverse.
const PIXEL_MM: f64 = 0.05;

/// A sum of Gaussians, (peak in nm/s, sigma in mm).
pub struct Spot(pub Vec<(f64, f64)>);

impl Spot {
    fn volume(&self) -> f64 {
        self.0.iter().map(|(a, s)| 2.0 * PI * a * s * s).sum()
    }

    /// The TIF with pixels of `pixel_mm`.
    pub fn on(&self, pixel_mm: f64) -> Tif {
        let widest = self.0.iter().fold(0.0, |m: f64, (_, s)| m.max(*s));
        // At 6.5 sigma a Gaussian is 7e-10 of its peak.
        let half = (6.5 * widest / pixel_mm).ceil();
        let axis = Axis::new(-half * pixel_mm, pixel_mm, 2 * half as usize + 1).expect("an axis");
        let rate = Array2::from_shape_fn((axis.len(), axis.len()), |(r, c)| {
            let r2 = axis.coordinate_mm(r).powi(2) + axis.coordinate_mm(c).powi(2);
            self.0.iter().map(|(a, s)| a * (-0.5 * r2 / (s * s)).exp()).sum()
        });
        Tif::new(Grid { x: axis, y: axis }, rate).expect("a spot")
    }

    /// (1) at the distance `y_mm` from a line, nm.
    pub fn removal_nm(&self, pitch_mm: f64, density_s_per_mm: f64, y_mm: f64) -> f64 {
        let harmonic = |n: f64| -> f64 {
            let part = |(a, s): &(f64, f64)| {
                2.0 * PI * a * s * s * (-2.0 * (PI * s * n / pitch_mm).powi(2)).exp()
            };
            self.0.iter().map(part).sum::<f64>() * (2.0 * PI * n * y_mm / pitch_mm).cos()
        };
        let ripple: f64 = (1..50).map(|n| harmonic(f64::from(n))).sum();
        density_s_per_mm / pitch_mm * (self.volume() + 2.0 * ripple)
    }

    /// PV over mean by (1): `4 sum over odd n of L(n / d)`.
    pub fn relative_ripple(&self, pitch_mm: f64) -> f64 {
        let [high, low] = [0.0, 0.5 * pitch_mm].map(|y| self.removal_nm(pitch_mm, 1.0, y));
        (high - low) / (self.volume() / pitch_mm)
    }

    /// Simulated removal across the lines: (distance from the middle line in mm, nm).
    pub fn simulated(&self, pitch_mm: f64, density_s_per_mm: f64) -> Vec<[f64; 2]> {
        let tif = self.on(PIXEL_MM);
        let part = flat([1.0, 16.0]);
        let overscan_mm = tif.half_size_mm()[0] + pitch_mm;
        let path = lines(&part, pitch_mm, overscan_mm);
        let z = uniform(&part, &tif, &path, density_s_per_mm);
        let axis = part.grid().y;
        (0..axis.len()).map(|r| [axis.coordinate_mm(r), z[[r, z.ncols() / 2]]]).collect()
    }
}

/// PV over mean, over whole periods.
pub fn ripple(profile: &[[f64; 2]], pitch_mm: f64) -> f64 {
    let period = (pitch_mm / PIXEL_MM).round() as usize;
    let whole = &profile[..profile.len() / period * period];
    let (low, high) =
        whole.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p[1]), h.max(p[1])));
    let mean = whole.iter().map(|p| p[1]).sum::<f64>() / whole.len() as f64;
    (high - low) / mean
}

fn flat(size_mm: [f64; 2]) -> Surface {
    let axis = |length: f64| {
        let half = (0.5 * length / PIXEL_MM).round();
        Axis::new(-half * PIXEL_MM, PIXEL_MM, 2 * half as usize + 1).expect("an axis")
    };
    let grid = Grid { x: axis(size_mm[0]), y: axis(size_mm[1]) };
    Surface::new(grid, Array2::zeros(grid.shape())).expect("a plane")
}

/// Lines along x, one of them at y = 0, in steps of at most 1 mm.
pub fn lines(part: &Surface, pitch_mm: f64, overscan_mm: f64) -> ToolPath {
    lines_in_steps(part, pitch_mm, 1.0, overscan_mm)
}

/// Lines along x, one of them at y = 0, in steps of at most `step_mm`.
pub fn lines_in_steps(part: &Surface, pitch_mm: f64, step_mm: f64, overscan_mm: f64) -> ToolPath {
    let settings = RasterSettings {
        line_origin_mm: Some(0.0),
        ..RasterSettings::new(pitch_mm, step_mm, overscan_mm)
    };
    raster(part, &settings).expect("a raster")
}

/// Removal at the same density everywhere on the path, nm.
pub fn uniform(part: &Surface, tif: &Tif, path: &ToolPath, density_s_per_mm: f64) -> Array2<f64> {
    let dwell_s = (0..path.len()).map(|i| density_s_per_mm * path.segment_length_mm(i)).collect();
    let dwell = DwellTime::new(dwell_s).expect("dwell times");
    let motion = average_velocity::schedule(path, &dwell, &ion_beam()).expect("a motion");
    assert!(motion.report.stretched.is_empty(), "the density is too small for the machine");
    let prediction = simulate(&motion.trajectory, tif, part, Settings::Gridded).expect("a removal");
    prediction.removal.removal_nm().clone()
}
