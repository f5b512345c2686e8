//! The spiral: one line from the inside out at one pitch, for round parts.
//!
//! Archimedes' spiral about the middle of the aperture's extent, counter-clockwise, from the inner
//! to the outer radius of the valid pixels, each as its centre:
//!
//! ```text
//! r(theta) = p theta / 2 pi
//! S(theta) = (p / 4 pi) (theta sqrt(1 + theta^2) + asinh theta)         arc length from the pole
//! r        from max(p/2, r_in - m) to r_out + m,  m = max(o, p/2)
//! nodes    S_k = S_a + k (S_b - S_a) / n where the radius is above 4 s / pi,
//!          theta_k = theta_a + k (theta_b - theta_a) / n below it, at most 45 degrees apart
//! ```
//!
//! The nodes by Newton's method on S, `theta <- theta - (S - S_k) / ((p/2 pi) sqrt(1 + theta^2))`;
//! S is convex, so it converges from above. At the pole the curvature has no bound: the spiral
//! begins half a pitch from it. Chords longer than 4 pitches would cut across the next turn, so
//! s is at most that. Between its turns every point is at most half a pitch from the curve, where
//! it begins at most 0.77 pitches, and everywhere at most one pitch from its chords.
//!
//! An aperture that is not a disc or a ring is inside of one: the tool stays on all over it.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | p | `pitch_mm` | - | mm |
//! | s | `step_mm` | - | mm |
//! | o | `overscan_mm` | - | mm |

use std::f64::consts::{FRAC_PI_4, PI};

use planish_types::{Surface, ToolPath};
use serde::Serialize;

use crate::{
    ToolPathError,
    draft::{Draft, parts},
    region::{Aperture, check_length},
};

/// Longest chord (segment), in pitches. Where such a chord spans 45 degrees, it is 0.4 pitches from its arc. Larger:
/// sharper turns near the centre. Smaller: more segments.
const LONGEST_CHORD: f64 = 4.0;

/// Settings of a spiral.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SpiralSettings {
    /// Distance between neighbouring turns, mm; > 0.
    pub pitch_mm: f64,
    /// Longest segment, mm; > 0.
    pub step_mm: f64,
    /// Distance that the path goes beyond the clear aperture, mm; >= 0.
    pub overscan_mm: f64,
}

/// Makes a spiral over the valid pixels of `surface`. Refuses lengths out of their range, and too many segments.
pub fn spiral(surface: &Surface, settings: &SpiralSettings) -> Result<ToolPath, ToolPathError> {
    let SpiralSettings { pitch_mm: p, step_mm, overscan_mm } = *settings;
    check_length("pitch_mm", p, false)?;
    check_length("step_mm", step_mm, false)?;
    check_length("overscan_mm", overscan_mm, true)?;
    let grid = surface.grid();
    let aperture = Aperture::new(&grid.x, &grid.y, surface.height_nm().view());
    let (x, y) = (aperture.along(0.0), aperture.across(0.0));
    let centre = [0.5 * (x.low + x.high), 0.5 * (y.low + y.high)];
    let valid = surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan());
    let (inner, outer) = valid
        .map(|((r, c), _)| {
            (grid.x.coordinate_mm(c) - centre[0]).hypot(grid.y.coordinate_mm(r) - centre[1])
        })
        .fold((f64::MAX, 0.0_f64), |(low, high), r| (low.min(r), high.max(r)));
    // max(p/2, r_in - m) .. r_out + m
    let margin = overscan_mm.max(0.5 * p);
    let inner = (inner - margin).max(0.5 * p);
    let outer = outer + margin;
    let angles = angles(p, step_mm.min(LONGEST_CHORD * p), inner, outer).ok_or({
        ToolPathError::TooManySegments { pitch_mm: p, step_mm, extent_mm: [2.0 * outer; 2] }
    })?;
    let mut path = Draft::default();
    for (k, theta) in angles.into_iter().enumerate() {
        let r = p * theta / (2.0 * PI);
        let point = [centre[0] + r * theta.cos(), centre[1] + r * theta.sin()];
        if k == 0 { path.begin(point) } else { path.to(point, true, 0) }
    }
    Ok(path.finish()?)
}

/// Returns the angles of the nodes from the radius `inner` to `outer` (mm), radians from the pole, with chords of at
/// most `step` mm and 45 degrees; `None` if there are more than `MAX_SEGMENTS` segments.
fn angles(pitch: f64, step: f64, inner: f64, outer: f64) -> Option<Vec<f64>> {
    let [first, last, change] = [inner, outer, step / FRAC_PI_4].map(|r| 2.0 * PI * r / pitch);
    let change = change.clamp(first, last);
    let mut angles = vec![first];
    if change > first {
        let n = parts(change - first, FRAC_PI_4, 0)?;
        angles.extend((1..=n).map(|k| first + (change - first) * k as f64 / n as f64));
    }
    if last > change {
        let begin = arc_length(pitch, change);
        let end = arc_length(pitch, last);
        let n = parts(end - begin, step, angles.len())?;
        // S_k = S_a + k (S_b - S_a) / n
        let lengths = (1..=n).map(|k| begin + (end - begin) * k as f64 / n as f64);
        angles.extend(lengths.map(|length| angle_at(pitch, length)));
    }
    Some(angles)
}

/// Returns the arc length of the spiral from the pole (radius 0) to the angle `theta`, mm.
fn arc_length(pitch: f64, theta: f64) -> f64 {
    // S = (p / 4 pi) (theta sqrt(1 + theta^2) + asinh theta)
    pitch / (4.0 * PI) * (theta * theta.hypot(1.0) + theta.asinh())
}

/// Returns the angle at the arc length `length` from the pole, radians.
fn angle_at(pitch: f64, length: f64) -> f64 {
    // (p / 4 pi) theta^2 is less than S: this is too large, and Newton goes down.
    let mut theta = (4.0 * PI * length / pitch).sqrt();
    loop {
        // theta <- theta - (S - S_k) / ((p/2 pi) sqrt(1 + theta^2))
        let slope = pitch / (2.0 * PI) * theta.hypot(1.0);
        let next = theta - (arc_length(pitch, theta) - length) / slope;
        // Rounding ends the descent.
        if next.is_nan() || next >= theta {
            return theta;
        }
        theta = next;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::statistics;
    use ndarray::Array2;
    use planish_types::{Axis, Grid};
    use proptest::prelude::*;

    /// Makes a map with pixels of 0.5 mm over 100 x 100 mm about (10, -5), valid where `inside(r)` is true.
    fn round(inside: impl Fn(f64) -> bool) -> Surface {
        let grid =
            Grid { x: Axis::new(-40.0, 0.5, 201).unwrap(), y: Axis::new(-55.0, 0.5, 201).unwrap() };
        let height = Array2::from_shape_fn((201, 201), |(r, c)| {
            let radius = (grid.x.coordinate_mm(c) - 10.0).hypot(grid.y.coordinate_mm(r) + 5.0);
            if inside(radius) { 0.0 } else { f64::NAN }
        });
        Surface::new(grid, height).unwrap()
    }

    fn settings(pitch_mm: f64, step_mm: f64, overscan_mm: f64) -> SpiralSettings {
        SpiralSettings { pitch_mm, step_mm, overscan_mm }
    }

    fn radii(path: &ToolPath) -> Vec<f64> {
        path.point_mm().iter().map(|p| (p[0] - 10.0).hypot(p[1] + 5.0)).collect()
    }

    #[test]
    fn a_disc_of_50_mm_has_the_length_of_its_area_over_the_pitch() {
        let surface = round(|r| r <= 49.5);
        let path = spiral(&surface, &settings(1.0, 0.1, 0.0)).unwrap();
        let s = statistics(&path, &surface);
        // pi (R^2 - r_0^2) / p + (p / 4 pi) ln(R / r_0), R = 50, r_0 = 0.5, as S ~ theta^2 +
        // ln(2 theta) + 1/2; the chords fall short by (2 pi / p) (s^2 / 24) ln(R / r_0) = 0.012.
        let expected = PI * (2500.0 - 0.25) + 100_f64.ln() / (4.0 * PI) - 0.012;
        assert!((s.length_mm - expected).abs() < 5e-3, "{} {expected}", s.length_mm);
        assert_eq!((s.crossings, s.lifts), (0, 0));
        // 0.77 pitches where it begins, and the 0.0025 mm of a chord of 0.1 mm on radius 0.5 mm.
        assert!(s.coverage_mm.unwrap() <= 0.7725 && s.p99_turn_deg < 5.7);
        let r = radii(&path);
        assert!((r[0] - 0.5).abs() < 1e-9 && (r[r.len() - 1] - 50.0).abs() < 1e-9);
        assert!(r.windows(2).all(|w| w[1] > w[0]));
    }

    #[test]
    fn nodes_are_equally_apart_along_the_arc_beyond_the_middle() {
        let path = spiral(&round(|r| r <= 40.0), &settings(0.7, 0.5, 3.0)).unwrap();
        let r = radii(&path);
        let begin = r.iter().position(|r| *r > 20.0).unwrap();
        let length: Vec<f64> = (begin..path.len()).map(|i| path.segment_length_mm(i)).collect();
        // Chord of arc 0.5 on radius 20 falls short by 0.5^3 / 24 / 20^2 = 1.3e-5.
        for l in &length {
            assert!((l - length[0]).abs() < 2e-5 && *l <= 0.5, "{l}");
        }
        // Counter-clockwise, one pitch outwards per turn.
        let [a, b] = [path.point_mm()[begin], path.point_mm()[begin + 1]];
        assert!((a[0] - 10.0) * (b[1] + 5.0) - (a[1] + 5.0) * (b[0] - 10.0) > 0.0);
        let turn = |k: usize| (path.point_mm()[k][1] + 5.0).atan2(path.point_mm()[k][0] - 10.0);
        for k in [begin, begin + 100] {
            let phase = (turn(k) / (2.0 * PI) - r[k] / 0.7).rem_euclid(1.0);
            assert!(phase.min(1.0 - phase) < 1e-9, "{phase}");
        }
    }

    #[test]
    fn a_ring_leaves_its_hole_out() {
        let path =
            spiral(&round(|r| (20.0..=40.0).contains(&r)), &settings(1.0, 1.0, 2.0)).unwrap();
        let r = radii(&path);
        assert!((r[0] - 18.0).abs() < 1e-9 && (r[r.len() - 1] - 42.0).abs() < 1e-9);
    }

    #[test]
    fn bad_settings_are_refused_with_the_value() {
        let surface = round(|r| r < 30.0);
        let cases = [
            (settings(0.0, 1.0, 0.0), "pitch_mm: is 0"),
            (settings(1.0, f64::NAN, 0.0), "step_mm: is NaN"),
            (settings(1.0, 1.0, -1.0), "overscan_mm: is -1"),
            (settings(1e-9, 1.0, 0.0), "more than 20000000"),
            (settings(1.0, 1e-9, 0.0), "more than 20000000"),
            (settings(1.0, 1.0, 1e300), "overscan_mm: is 1e300"),
        ];
        for (settings, message) in cases {
            let error = spiral(&surface, &settings).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
    }

    proptest! {
        #[test]
        fn what_holds_for_every_pitch_and_step(
            pitch in 0.5..20.0_f64, step in 0.1..60.0_f64, overscan in 0.0..5.0_f64,
            hole in 0.0..30.0_f64,
        ) {
            let surface = round(|r| r >= hole && r <= 45.0);
            let path = spiral(&surface, &settings(pitch, step, overscan)).unwrap();
            let s = statistics(&path, &surface);
            prop_assert_eq!(s.crossings, 0);
            prop_assert!(s.longest_step_mm <= step * (1.0 + 1e-9));
            prop_assert!(s.coverage_mm.unwrap() <= pitch, "{:?}", s.coverage_mm);
        }

        #[test]
        fn the_angle_is_the_inverse_of_the_arc_length(
            pitch in 0.01..10.0_f64, theta in 0.1..1e5_f64,
        ) {
            let back = angle_at(pitch, arc_length(pitch, theta));
            prop_assert!((back / theta - 1.0).abs() < 1e-12);
        }
    }
}
