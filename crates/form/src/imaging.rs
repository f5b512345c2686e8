//! The mirror that images a source onto a point: an elliptic, parabolic or hyperbolic cylinder, exactly, in the
//! coordinates of the mirror.
//!
//! A mirror images a source at the distance p onto a point at the distance q under the grazing angle theta
//! at its pole. x is along the mirror from the source to the image. z is along the normal at the pole,
//! towards the light. The source is at (-p cos theta, p sin theta), the image at (q cos theta, q sin
//! theta). Over an ellipse the path is p + q long. A negative distance is that of a virtual point beyond the mirror:
//! the difference of the distances is constant, and the curve is a hyperbola. Squaring twice leaves
//!
//! ```text
//! a z^2 - 2 b z + t s^2 x^2 = 0,   s = sin theta,  c = cos theta
//! t = (1/p + 1/q) / 2,   w = (1/q - 1/p) / 2,   a = t - s^2 w^2 / t,   b = s (1 - w c x)
//! z  = t s^2 x^2 / (b + sqrt(b^2 - (t^2 - s^2 w^2) s^2 x^2))
//! ```
//!
//! z = 0 and z' = 0 at the pole. The mirror is concave, so that its ends are above its pole, where 1/p + 1/q > 0. To
//! turn the mirror round, exchange p and q. An infinite distance (1/p = 0) is a parabola; nothing is singular there.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | p, q | `p_mm`, `q_mm` | mm |
//! | theta | `theta_rad` | rad |
//! | x, z | `x_mm`, `height_mm` | mm |

use std::f64::consts::FRAC_PI_2;

use planish_types::Invalid;
use serde::Serialize;

use crate::jet::Jet;

/// Distances and grazing angle of a mirror that images a source onto a point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ImagingConic {
    /// Source to pole, mm; infinite for a parabola, negative for a virtual source.
    pub p_mm: f64,
    /// Pole to image, mm; infinite for a parabola, negative for a virtual image.
    pub q_mm: f64,
    /// Grazing angle at the pole, rad; > 0, at most a right angle.
    pub theta_rad: f64,
}

impl ImagingConic {
    /// Returns an ellipse: source and image at finite distances before the mirror. Refuses distances that are not
    /// positive, and an angle out of its range.
    pub fn ellipse(p_mm: f64, q_mm: f64, theta_rad: f64) -> Result<Self, Invalid> {
        for (name, mm) in [("p", p_mm), ("q", q_mm)] {
            if !(mm.is_finite() && mm > 0.0) {
                let problem = format!("{name} is {mm} mm");
                return Err(Invalid::whole("ellipse", problem, "give a distance in mm, above 0"));
            }
        }
        check_angle("ellipse", theta_rad)?;
        Ok(Self { p_mm, q_mm, theta_rad })
    }

    /// Returns a hyperbola: exactly one of both distances is negative. Refuses other distances, those of a plane, and
    /// an angle out of its range.
    pub fn hyperbola(p_mm: f64, q_mm: f64, theta_rad: f64) -> Result<Self, Invalid> {
        let finite = p_mm.is_finite() && q_mm.is_finite();
        if !(finite && p_mm * q_mm < 0.0) {
            let problem = format!("p is {p_mm} mm and q is {q_mm} mm");
            let remedy = "give one distance above 0 and one below 0, that of the virtual point";
            return Err(Invalid::whole("hyperbola", problem, remedy));
        }
        if p_mm + q_mm == 0.0 {
            let problem = format!("p is {p_mm} mm and q is {q_mm} mm, which is a plane");
            return Err(Invalid::whole("hyperbola", problem, "give a plane, or other distances"));
        }
        check_angle("hyperbola", theta_rad)?;
        Ok(Self { p_mm, q_mm, theta_rad })
    }

    /// Returns a parabola: one distance, of the source or of the image, is infinite. Refuses other distances, and an
    /// angle out of its range.
    pub fn parabola(p_mm: f64, q_mm: f64, theta_rad: f64) -> Result<Self, Invalid> {
        let near = if p_mm.is_infinite() { q_mm } else { p_mm };
        let one_is_infinite = p_mm.is_infinite() != q_mm.is_infinite();
        if !(one_is_infinite && near.is_finite() && near != 0.0) {
            let problem = format!("p is {p_mm} mm and q is {q_mm} mm");
            let remedy = "give one of both distances, in mm and not 0";
            return Err(Invalid::whole("parabola", problem, remedy));
        }
        check_angle("parabola", theta_rad)?;
        Ok(Self { p_mm, q_mm, theta_rad })
    }

    /// Returns the height z above the tangent at the pole, mm, with its derivatives, at x from the pole, mm; NaN beyond
    /// the ends of the curve.
    pub(crate) fn jet(&self, x: Jet) -> Jet {
        let (s, c) = self.theta_rad.sin_cos();
        let [u, v] = [self.p_mm, self.q_mm].map(|mm| 1.0 / mm);
        let t = 0.5 * (u + v);
        let w = 0.5 * (v - u);
        let one = Jet::constant(1.0);
        let b = (one - x.times(w * c)).times(s);
        let square = (x * x).times(s * s);
        // z = t s^2 x^2 / (b + sqrt(b^2 - (t^2 - s^2 w^2) s^2 x^2))
        square.times(t) / (b + (b * b - square.times(t * t - (s * w).powi(2))).sqrt())
    }

    /// Returns the height z above the tangent at the pole, mm, at `x_mm` from the pole; NaN beyond the ends of the
    /// curve.
    pub fn height_mm(&self, x_mm: f64) -> f64 {
        self.jet(Jet::coordinates([x_mm, 0.0])[0]).value
    }

    /// Returns the slope dz/dx at `x_mm` from the pole, rad; NaN beyond the ends of the curve.
    pub fn slope(&self, x_mm: f64) -> f64 {
        self.jet(Jet::coordinates([x_mm, 0.0])[0]).gradient[0]
    }
}

fn check_angle(name: &'static str, theta_rad: f64) -> Result<(), Invalid> {
    if theta_rad > 0.0 && theta_rad <= FRAC_PI_2 {
        return Ok(());
    }
    let problem = format!("theta is {} mrad", 1e3 * theta_rad);
    let remedy = "give the grazing angle in mrad, above 0 and at most 1570.8";
    Err(Invalid::whole(name, problem, remedy))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_path_over_the_mirror_is_as_long_as_that_over_its_pole() {
        for (p, q, theta) in [(30_000.0, 300.0, 3e-3), (400.0, 900.0, 0.2), (50.0, 50.0, 1.2)] {
            let ellipse = ImagingConic::ellipse(p, q, theta).unwrap();
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
    fn over_a_hyperbola_the_difference_of_the_distances_is_constant() {
        for (p, q, theta) in [(900.0, -400.0, 0.1), (300.0, -2000.0, 0.3), (-500.0, 700.0, 0.05)] {
            let hyperbola = ImagingConic::hyperbola(p, q, theta).unwrap();
            let (s, c) = theta.sin_cos();
            for x in [-40.0, -7.5, 1e-3, 30.0] {
                let z = hyperbola.height_mm(x);
                let (to_p, to_q) = ((x + p * c).hypot(z - p * s), (x - q * c).hypot(z - q * s));
                let difference = p.signum() * to_p + q.signum() * to_q;
                // A few roundings of distances of up to 2000 mm.
                assert!((difference - (p + q)).abs() < 2e-12, "{p} {q} {x}: {difference}");
                // Concave where 1/p + 1/q > 0.
                assert_eq!(z > 0.0, 1.0 / p + 1.0 / q > 0.0);
            }
        }
    }

    #[test]
    fn over_a_parabola_a_plane_wave_stays_in_phase() {
        let (q, theta) = (300.0, 0.2_f64);
        let parabola = ImagingConic::parabola(f64::INFINITY, q, theta).unwrap();
        let (s, c) = theta.sin_cos();
        for x in [-40.0, 12.0, 60.0] {
            let z = parabola.height_mm(x);
            // The path along the light (c, -s), and from the mirror to the image.
            let path = x * c - z * s + (x - q * c).hypot(z - q * s);
            // Rounding of lengths of 300 mm.
            assert!((path - q).abs() < 1e-12, "{x}: {path}");
        }
        assert!(ImagingConic::parabola(300.0, 300.0, theta).is_err());
    }

    #[test]
    fn the_curvature_at_the_pole_is_that_of_the_mirror_equation() {
        // 1/p + 1/q = 2 / (R sin theta)
        let ellipse = ImagingConic::ellipse(30_000.0, 300.0, 3e-3).unwrap();
        let curvature = 2.0 * ellipse.height_mm(1e-3) / 1e-6;
        let want = 0.5 * ellipse.theta_rad.sin() * (1.0 / 30_000.0 + 1.0 / 300.0);
        // The cubic term at 1 um.
        assert!((curvature / want - 1.0).abs() < 1e-5, "{curvature} {want}");
    }

    #[test]
    fn to_exchange_the_distances_turns_it_round() {
        let a = ImagingConic::ellipse(9e3, 400.0, 4e-3).unwrap();
        let b = ImagingConic::ellipse(400.0, 9e3, 4e-3).unwrap();
        for x in [-20.0, 13.0] {
            // Rounding of heights, relative.
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
            let message = ImagingConic::ellipse(p, q, theta).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
        let message = ImagingConic::hyperbola(5.0, -5.0, 0.1).unwrap_err().to_string();
        assert!(message.contains("which is a plane"), "{message}");
        assert!(ImagingConic::hyperbola(5.0, 6.0, 0.1).is_err());
    }
}
