//! The elliptical cylinder of an x-ray mirror, exactly, in the coordinates of the mirror.
//!
//! A mirror images a source at the distance p onto a point at the distance q under the grazing angle theta
//! at its pole. x is along the mirror from the source to the image. z is along the normal at the pole,
//! towards the light. The source is at (-p cos theta, p sin theta), the image at (q cos theta, q sin
//! theta). The mirror is the set of points over which the path is p + q long. Squaring twice leaves
//!
//! ```text
//! a z^2 - 2 b z + s^2 x^2 = 0,   s = sin theta,  c = cos theta
//! k = (1/q - 1/p) / (1/p + 1/q),   a = 1 - s^2 k^2,   b = s (2 / (1/p + 1/q) - k c x)
//! z  = s^2 x^2 / (b + sqrt(b^2 - a s^2 x^2))
//! z' = (s^2 x + s k c z) / (b - a z)
//! ```
//!
//! z = 0 and z' = 0 at the pole; the mirror is concave, so its ends are above its pole. To turn the mirror
//! round, exchange p and q. An infinite distance (1/p = 0) is a parabola; nothing is singular there.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | p, q | `p_mm`, `q_mm` | mm |
//! | theta | `theta_rad` | rad |
//! | x, z | `x_mm`, `height_mm` | mm |

use std::f64::consts::FRAC_PI_2;

use planish_types::Invalid;
use serde::Serialize;

/// Distances and angle of an elliptical mirror.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Ellipse {
    /// Source to pole, mm; > 0, infinite for a parabola.
    pub p_mm: f64,
    /// Pole to image, mm; > 0, infinite for a parabola.
    pub q_mm: f64,
    /// Grazing angle at the pole, rad; > 0, at most a right angle.
    pub theta_rad: f64,
}

impl Ellipse {
    /// Refuses what is no mirror.
    pub fn new(p_mm: f64, q_mm: f64, theta_rad: f64) -> Result<Self, Invalid> {
        for (name, mm) in [("p", p_mm), ("q", q_mm)] {
            if !(mm.is_finite() && mm > 0.0) {
                let problem = format!("{name} is {mm} mm");
                return Err(Invalid::whole("ellipse", problem, "give a distance in mm, above 0"));
            }
        }
        if !(theta_rad > 0.0 && theta_rad <= FRAC_PI_2) {
            let problem = format!("theta is {} mrad", 1e3 * theta_rad);
            let remedy = "give the grazing angle in mrad, above 0 and at most 1570.8";
            return Err(Invalid::whole("ellipse", problem, remedy));
        }
        Ok(Self { p_mm, q_mm, theta_rad })
    }

    /// [s, c, k, a, b] at x.
    fn coefficients(&self, x_mm: f64) -> [f64; 5] {
        let (s, c) = self.theta_rad.sin_cos();
        let (u, v) = (1.0 / self.p_mm, 1.0 / self.q_mm);
        let k = (v - u) / (u + v);
        let b = s * (2.0 / (u + v) - k * c * x_mm);
        [s, c, k, 1.0 - (s * k).powi(2), b]
    }

    /// z above the tangent at the pole, mm; NaN beyond the ends of the ellipse.
    pub fn height_mm(&self, x_mm: f64) -> f64 {
        let [s, _, _, a, b] = self.coefficients(x_mm);
        let square = (s * x_mm).powi(2);
        // z = s^2 x^2 / (b + sqrt(b^2 - a s^2 x^2))
        square / (b + (b * b - a * square).sqrt())
    }

    /// dz/dx, rad; NaN beyond the ends of the ellipse.
    pub fn slope(&self, x_mm: f64) -> f64 {
        let [s, c, k, a, b] = self.coefficients(x_mm);
        let z = self.height_mm(x_mm);
        (s * s * x_mm + s * k * c * z) / (b - a * z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_path_over_the_mirror_is_as_long_as_that_over_its_pole() {
        for (p, q, theta) in [(30_000.0, 300.0, 3e-3), (400.0, 900.0, 0.2), (50.0, 50.0, 1.2)] {
            let ellipse = Ellipse::new(p, q, theta).unwrap();
            let (s, c) = theta.sin_cos();
            for x in [-40.0, -7.5, 0.0, 1e-3, 30.0] {
                let z = ellipse.height_mm(x);
                let path = (x + p * c).hypot(z - p * s) + (x - q * c).hypot(z - q * s);
                // A few roundings of the sum.
                assert!((path / (p + q) - 1.0).abs() < 1e-15, "{p} {q} {theta} {x}: {path}");
                let h = 1e-3;
                let slope = (ellipse.height_mm(x + h) - ellipse.height_mm(x - h)) / (2.0 * h);
                // h^2 / 6 = 2e-7 times a third derivative of at most 0.1 /mm^2, and rounding of z over h.
                assert!((slope - ellipse.slope(x)).abs() < 2e-8, "{x}: {slope}");
            }
            assert_eq!((ellipse.height_mm(0.0), ellipse.slope(0.0)), (0.0, 0.0));
        }
    }

    #[test]
    fn the_curvature_at_the_pole_is_that_of_the_mirror_equation() {
        // 1/p + 1/q = 2 / (R sin theta)
        let ellipse = Ellipse::new(30_000.0, 300.0, 3e-3).unwrap();
        let curvature = 2.0 * ellipse.height_mm(1e-3) / 1e-6;
        let want = 0.5 * ellipse.theta_rad.sin() * (1.0 / 30_000.0 + 1.0 / 300.0);
        // The cubic term at 1 um.
        assert!((curvature / want - 1.0).abs() < 1e-5, "{curvature} {want}");
    }

    #[test]
    fn to_exchange_the_distances_turns_it_round() {
        let (a, b) = (Ellipse::new(9e3, 400.0, 4e-3), Ellipse::new(400.0, 9e3, 4e-3));
        let (a, b) = (a.unwrap(), b.unwrap());
        for x in [-20.0, 13.0] {
            assert!((a.height_mm(x) / b.height_mm(-x) - 1.0).abs() < 1e-14);
        }
    }

    #[test]
    fn what_is_no_mirror_is_refused() {
        for (p, q, theta, part) in [
            (0.0, 1.0, 0.1, "p is 0 mm"),
            (1.0, f64::NAN, 0.1, "q is NaN mm"),
            (1.0, 1.0, -0.1, "theta is -100 mrad"),
            (1.0, 1.0, 3.0, "theta is 3000 mrad"),
        ] {
            let message = Ellipse::new(p, q, theta).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
    }
}
