//! Clothoids: curves whose curvature is linear in the arc length, straight lines and circular arcs among them.
//!
//! ```text
//! theta(s) = kappa_0 s + sigma s^2 / 2                        heading, rad; 0 at s = 0
//! kappa(s) = kappa_0 + sigma s                                curvature, 1/mm
//! q(s) = integral from 0 to s of (cos theta, sin theta)       position, mm                    (1)
//! ```
//!
//! The arc length is exact by construction, and so are heading and curvature; only (1) needs quadrature.
//! Source: the Fresnel integrals, M. Abramowitz and I. Stegun, *Handbook of Mathematical Functions*, 7.3.

use crate::quadrature::gauss_legendre;

/// The heading changes by at most this within a step of the quadrature, rad: the eight-point rule is then exact
/// to rounding, because its error is below `(1/2)^16 / 16!`, 7e-19.
const MAX_TURN_PER_STEP_RAD: f64 = 0.5;

/// Position (1) at the arc length `s`, mm, in the frame of the start: it begins along the first axis.
pub fn position(curvature: f64, sharpness: f64, s: f64) -> [f64; 2] {
    if curvature == 0.0 && sharpness == 0.0 {
        return [s, 0.0];
    }
    let turn = curvature.abs() * s.abs() + 0.5 * sharpness.abs() * s * s;
    let steps = (turn / MAX_TURN_PER_STEP_RAD).ceil().max(1.0);
    let step = s / steps;
    let rule = gauss_legendre::<8>();
    let mut at = [0.0; 2];
    for k in 0..steps as usize {
        for (f, weight) in rule {
            let u = step * (k as f64 + f);
            let (sin, cos) = heading(curvature, sharpness, u).sin_cos();
            at[0] += weight * step * cos;
            at[1] += weight * step * sin;
        }
    }
    at
}

/// Heading at the arc length `s` against that of the start, rad.
pub fn heading(curvature: f64, sharpness: f64, s: f64) -> f64 {
    s * (curvature + 0.5 * sharpness * s)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_and_circles_are_exact() {
        assert_eq!(position(0.0, 0.0, 3.5), [3.5, 0.0]);
        for (curvature, s) in [(0.3, 7.0), (-2.0, 5.0), (1e-9, 10.0)] {
            // A circle of radius 1 / kappa: sin(kappa s) / kappa, (1 - cos(kappa s)) / kappa
            let turn: f64 = curvature * s;
            let expected = [turn.sin() / curvature, 2.0 * (0.5 * turn).sin().powi(2) / curvature];
            let found = position(curvature, 0.0, s);
            for k in 0..2 {
                // Rounding of some tens of terms of order s.
                assert!((found[k] - expected[k]).abs() < 1e-13, "{curvature}: {found:?}");
            }
        }
    }

    #[test]
    fn a_clothoid_gives_the_fresnel_integrals() {
        // With theta = pi s^2 / 2: C(1) = 0.7798934003768228, S(1) = 0.4382591473903548, C(2), S(2) likewise
        // (Abramowitz and Stegun, table 7.7).
        let table = [
            (1.0, 0.779_893_400_376_822_8, 0.438_259_147_390_354_8),
            (2.0, 0.488_253_406_075_340_75, 0.343_415_678_363_698_24),
        ];
        for (s, c, sn) in table {
            let found = position(0.0, std::f64::consts::PI, s);
            assert!((found[0] - c).abs() < 1e-14 && (found[1] - sn).abs() < 1e-14, "{found:?}");
        }
    }
}
