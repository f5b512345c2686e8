//! An ellipse some of whose parameters are fitted, described by how far the fit has moved them from the design.
//!
//! One or two free parameters move along their logarithms. All three move along
//!
//! ```text
//! ln(sin theta (1/p + 1/q)),   k = (1/q - 1/p) / (1/p + 1/q) from -1 to 1,   ln(1/p + 1/q)
//! ```
//!
//! These are the curvature, the asymmetry, and the remaining scale. Along p, q and theta themselves, the
//! set of ellipses of equal curvature is bent, and with noise p moves to infinity and beyond.

use super::{EllipseParameter, EllipseSettings};
use planish_form::ImagingConic;

/// Largest change of a coordinate of the fit that is a logarithm; the factor is e^3 = 20. Larger: a longer search, and
/// ellipses that are far from the design. Smaller: the best ellipse may lie outside.
const LARGEST_LOGARITHM: f64 = 3.0;

/// Starting points of fits between the bounds of a coordinate, as fractions of their distance. More of them find
/// narrower minima and cost time in proportion. Five along each of three coordinates are 125 starts of ten steps.
const STARTS: [f64; 5] = [0.1, 0.3, 0.5, 0.7, 0.9];

/// Step of the central differences by the coordinates of an ellipse, dimensionless. Larger: a larger error
/// of the extrapolated difference, which is the fourth power of the step, 1e-12. Smaller: a larger error by
/// rounding, which is 1e-13 here.
const DIFFERENCE: f64 = 1e-3;

/// The ellipse as designed, and the change `by` of each coordinate of the fit.
#[derive(Clone, Debug)]
pub(super) struct MovedEllipse {
    pub settings: EllipseSettings,
    by: Vec<f64>,
}

impl MovedEllipse {
    /// Returns the ellipse as designed, with all changes 0.
    pub fn new(settings: &EllipseSettings) -> Self {
        let mut settings = settings.clone();
        settings.free.sort_by_key(|parameter| *parameter as usize);
        settings.free.dedup();
        let by = vec![0.0; settings.free.len()];
        Self { settings, by }
    }

    /// Returns the number of coordinates that are fitted.
    pub fn count(&self) -> usize {
        self.by.len()
    }

    /// Adds to every coordinate of the fit the number that `step` returns, called once per coordinate.
    pub fn add(&mut self, mut step: impl FnMut() -> f64) {
        self.by.iter_mut().for_each(|v| *v += step());
    }

    /// Returns the design moved to a lattice of starting points within its bounds, [`STARTS`] along each coordinate.
    /// The design itself is not among them.
    pub fn starts(&self) -> Vec<Self> {
        let room = Self { by: vec![0.0; self.by.len()], ..self.clone() }.room();
        let count = STARTS.len().pow(room.len() as u32);
        if room.is_empty() {
            return Vec::new();
        }
        let starts = (0..count).map(|index| {
            let by = room.iter().enumerate().map(|(k, [low, high])| {
                let part = STARTS[index / STARTS.len().pow(k as u32) % STARTS.len()];
                low + part * (high - low)
            });
            Self { by: by.collect(), ..self.clone() }
        });
        starts.collect()
    }

    /// Returns the ellipse at the current coordinates of the fit.
    pub fn ellipse(&self) -> ImagingConic {
        self.moved(&self.by)
    }
    /// Returns the design with the changes `by` added to its coordinates.
    fn moved(&self, by: &[f64]) -> ImagingConic {
        let mut ellipse = self.settings.design;
        if let [curvature, asymmetric, rest] = by {
            let sum = 1.0 / ellipse.p_mm + 1.0 / ellipse.q_mm;
            let k = asymmetry(&ellipse) + asymmetric;
            let sum_then = sum * rest.exp();
            let sine = ellipse.theta_rad.sin() * (curvature - rest).exp();
            // Beyond a right angle there is no mirror: the arc sine is NaN, and a fit refuses the step.
            return ImagingConic {
                p_mm: 2.0 / (sum_then * (1.0 - k)),
                q_mm: 2.0 / (sum_then * (1.0 + k)),
                theta_rad: sine.asin(),
            };
        }
        for (parameter, by) in self.settings.free.iter().zip(by) {
            let value = match parameter {
                EllipseParameter::P => &mut ellipse.p_mm,
                EllipseParameter::Q => &mut ellipse.q_mm,
                EllipseParameter::Theta => &mut ellipse.theta_rad,
            };
            *value *= by.exp();
        }
        ellipse
    }

    /// Returns the derivative of a value of the ellipse by the coordinate `k` of the fit.
    pub fn derivative(&self, k: usize, value: impl Fn(ImagingConic) -> f64) -> f64 {
        let [short, long] = [DIFFERENCE, 2.0 * DIFFERENCE].map(|step| {
            let [above, below] = [step, -step].map(|step| {
                let mut by = self.by.clone();
                by[k] += step;
                value(self.moved(&by))
            });
            (above - below) / (2.0 * step)
        });
        (4.0 * short - long) / 3.0
    }

    /// Returns the distances of every coordinate to its lower and upper bound; the first is at most 0.
    pub fn room(&self) -> Vec<[f64; 2]> {
        let k = asymmetry(&self.settings.design);
        let mut room = vec![[-LARGEST_LOGARITHM, LARGEST_LOGARITHM]; self.by.len()];
        if self.by.len() == 3 {
            room[1] = [-1.0 - k, 1.0 - k];
        }
        room.iter().zip(&self.by).map(|(ends, v)| ends.map(|end| end - v)).collect()
    }
}

/// Returns the asymmetry k = (1/q - 1/p) / (1/p + 1/q) of an ellipse, from -1 to 1.
fn asymmetry(ellipse: &ImagingConic) -> f64 {
    let [u, v] = [ellipse.p_mm, ellipse.q_mm].map(|mm| 1.0 / mm);
    (v - u) / (u + v)
}
