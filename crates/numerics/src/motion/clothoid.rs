//! Clothoids: curves whose curvature is linear in the arc length. Straight lines and circular arcs
//! are special cases.
//!
//! ```text
//! theta(s) = kappa_0 s + sigma s^2 / 2                        heading, rad; 0 at s = 0
//! kappa(s) = kappa_0 + sigma s                                curvature, 1/mm
//! q(s) = integral from 0 to s of (cos theta, sin theta)       position, mm                    (1)
//! ```
//!
//! Arc length, heading and curvature are exact by construction; only (1) is a sum. Its integrand
//! solves `z' = i (kappa_0 + sigma s) z`, so the terms t_n of its power series at s follow from
//! each other:
//!
//! ```text
//! q(s) = s sum_n t_n / (n + 1),   t_0 = 1,   (n + 1) t_(n+1) = i (kappa_0 s t_n + sigma s^2 t_(n-1))         (2)
//! ```
//!
//! Source: the Fresnel integrals, M. Abramowitz and I. Stegun, *Handbook of Mathematical Functions*, 7.3.

/// Largest bound on the change of heading for which (2) is summed, rad. Larger: the terms exceed
/// the sum, and more than a digit is lost to rounding. Smaller: the curve is divided into more
/// steps.
const MAX_TURN_OF_SERIES_RAD: f64 = 1.5;

/// Largest number of terms of (2). Derived: with the turn of [`MAX_TURN_OF_SERIES_RAD`], the last
/// term is below `1.5^39 / 39!` = 4e-40 on a circle. On a clothoid that begins straight, only every
/// other term is not 0, and the last one is below `0.75^19 / 19!` = 4e-20. Larger: no change.
/// Smaller: truncation exceeds rounding.
const MAX_TERMS: usize = 40;

/// Size of a term of (2), relative to the first, below which two terms in a row end the sum.
/// Larger: truncation exceeds rounding. Smaller: more terms without an effect.
const NEGLIGIBLE_TERM: f64 = 1e-18;

/// Returns the position (1) of the module at the arc length `s`, mm, in the frame of the start: the curve begins at
/// the origin, along the first axis. `curvature` is that of the start, 1/mm; `sharpness` is its change per arc length,
/// 1/mm^2.
pub fn position(curvature: f64, sharpness: f64, s: f64) -> [f64; 2] {
    if curvature == 0.0 && sharpness == 0.0 {
        return [s, 0.0];
    }
    // A bound for every step: the turn at the largest curvature.
    let turn = (curvature.abs() + (sharpness * s).abs()) * s.abs();
    let steps = (turn / MAX_TURN_OF_SERIES_RAD).ceil().max(1.0);
    let step = s / steps;
    let mut position = series(curvature, sharpness, step);
    for k in 1..steps as usize {
        let from = step * k as f64;
        let [along, across] = series(curvature + sharpness * from, sharpness, step);
        let (sin, cos) = heading(curvature, sharpness, from).sin_cos();
        position[0] += cos * along - sin * across;
        position[1] += sin * along + cos * across;
    }
    position
}

/// Returns the position at the arc length `s`, mm, as the sum (2) of the module.
fn series(curvature: f64, sharpness: f64, s: f64) -> [f64; 2] {
    let bend = curvature * s;
    let change = sharpness * s * s;
    let mut before = [0.0; 2];
    let mut term = [1.0, 0.0];
    let mut sum = term;
    for n in 1..MAX_TERMS {
        let by = [0, 1].map(|k| bend * term[k] + change * before[k]);
        let part = 1.0 / n as f64;
        (before, term) = (term, [-by[1] * part, by[0] * part]);
        let part = 1.0 / (n + 1) as f64;
        sum = [sum[0] + term[0] * part, sum[1] + term[1] * part];
        let is_negligible = |t: [f64; 2]| t[0].abs() + t[1].abs() < NEGLIGIBLE_TERM;
        if is_negligible(term) && is_negligible(before) {
            break;
        }
    }
    sum.map(|v| s * v)
}

/// Returns the heading at the arc length `s`, mm, relative to that of the start, rad; positive towards the second
/// axis. The arguments are those of [`position`].
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
            // The table has 15 to 16 digits; sums of some ten terms round in the last.
            assert!((found[0] - c).abs() < 1e-14 && (found[1] - sn).abs() < 1e-14, "{found:?}");
        }
    }

    #[test]
    fn bends_that_grow_shrink_or_turn_over_agree_with_quadrature() {
        for (curvature, sharpness, s) in [
            (0.4, 0.3, 1.3),
            (0.9, -1.1, 2.0),
            (-1.5, 0.2, 4.0),
            (0.0, -2.0, 0.6),
            (2.0, -0.9, -1.1),
        ] {
            // Steps of a hundredth: the error of the eight-point rule is far below rounding.
            let steps = 100;
            let step = s / f64::from(steps);
            let mut expected = [0.0; 2];
            for k in 0..steps {
                for (f, weight) in crate::quadrature::gauss_legendre::<8>() {
                    let (sin, cos) =
                        heading(curvature, sharpness, step * (f64::from(k) + f)).sin_cos();
                    expected[0] += weight * step * cos;
                    expected[1] += weight * step * sin;
                }
            }
            let found = position(curvature, sharpness, s);
            for k in 0..2 {
                // Rounding of some hundred terms, each a hundredth of the sum.
                let error = (found[k] - expected[k]).abs();
                assert!(error < 1e-14 * s.abs(), "{curvature} {sharpness} {s}: {error}");
            }
        }
    }
}
