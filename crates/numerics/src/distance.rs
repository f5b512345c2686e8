//! Largest distance of a plane cubic from line segments.
//!
//! The four Bernstein coefficients of a cubic on an interval are the corners of a polygon that contains it, and the
//! distance from a segment is a convex function. The largest distance of a corner is therefore an upper bound of the
//! distance of the cubic, and a point of the cubic gives a lower bound. Halving the interval closes the gap (G. Farin,
//! *Curves and Surfaces for CAGD*, chapter 5).

use crate::polynomial::halves;

/// A point [x, y] of the plane.
pub type Point = [f64; 2];

/// A line segment, given by its two ends.
pub type Chord = [Point; 2];

/// Gap between the upper and the lower bound of a distance, relative to it, at which the search ends. Larger: the
/// returned distance is too large by as much. Smaller: more halvings.
const RELATIVE_GAP: f64 = 1e-7;

/// The same gap, absolute, in the unit of the cubic. It is far below any length of a machine in mm, and ends the
/// search where the distance is 0.
const ABSOLUTE_GAP: f64 = 1e-11;

/// Largest number of halvings of the interval. After 40 of them the gap is rounding. Larger: more time. Smaller: the
/// returned distance may be too large by more than the gap.
const MAX_HALVINGS: usize = 40;

/// Returns the distance of `point` from the nearest point of the line segment `chord`.
pub fn from_chord(point: Point, chord: &Chord) -> f64 {
    let [a, b] = chord;
    let along = [b[0] - a[0], b[1] - a[1]];
    let from_a = [point[0] - a[0], point[1] - a[1]];
    let square = along[0] * along[0] + along[1] * along[1];
    let product = from_a[0] * along[0] + from_a[1] * along[1];
    // Place of the nearest point, in units of the length.
    let place = if square > 0.0 { (product / square).clamp(0.0, 1.0) } else { 0.0 };
    (from_a[0] - place * along[0]).hypot(from_a[1] - place * along[1])
}

/// Returns the Bernstein coefficients, as points of the plane, of the cubic on [0, `end`]. `cubic` has the ascending
/// coefficients along [x, y].
fn bernstein(cubic: &[[f64; 4]; 2], end: f64) -> [Point; 4] {
    let per_axis = cubic.map(|c| {
        let first = c[1] * end;
        let second = c[2] * end * end;
        let third = c[3] * end * end * end;
        [
            c[0],
            c[0] + first / 3.0,
            c[0] + (2.0 * first + second) / 3.0,
            c[0] + first + second + third,
        ]
    });
    [0, 1, 2, 3].map(|k| [per_axis[0][k], per_axis[1][k]])
}

/// Returns the largest distance of a plane cubic on [0, `end`] that is above `least`, or `least` if none is. The
/// distance is an upper bound, and exact to 1e-7. It is infinite if `farthest` returns no finite number.
///
/// `farthest(points, enough)` returns the largest distance of the points from a chord; with several chords, the
/// smallest of these numbers. If that is not above `enough`, it may return any upper bound that is not above `enough`
/// either.
pub fn largest(
    cubic: &[[f64; 4]; 2],
    end: f64,
    least: f64,
    farthest: impl Fn(&[Point], f64) -> f64,
) -> f64 {
    let mut largest = least;
    let mut parts = vec![(bernstein(cubic, end), 0)];
    while let Some((corners, halvings)) = parts.pop() {
        let enough = largest * (1.0 + RELATIVE_GAP) + ABSOLUTE_GAP;
        let bound = farthest(&corners, enough);
        if bound.is_nan() || bound == f64::INFINITY {
            return f64::INFINITY;
        }
        if bound <= largest {
            continue;
        }
        if bound <= enough || halvings == MAX_HALVINGS {
            largest = bound;
            continue;
        }
        for corner in [corners[0], corners[3]] {
            largest = largest.max(farthest(&[corner], largest));
        }
        let [first, second] = halves(&corners);
        parts.push((second, halvings + 1));
        parts.push((first, halvings + 1));
    }
    largest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::polynomial::evaluate;

    fn from_one(cubic: &[[f64; 4]; 2], end: f64, chord: Chord) -> f64 {
        largest(cubic, end, 0.0, |points, _| {
            points.iter().map(|p| from_chord(*p, &chord)).fold(0.0, f64::max)
        })
    }

    #[test]
    fn overshoot_and_bulge_by_hand() {
        // x(u) = 3 u - 2 u^2: 9/8 at u = 3/4, beyond an end at 1; y = 0.
        let beyond = from_one(&[[0.0, 3.0, -2.0, 0.0], [0.0; 4]], 1.0, [[0.0, 0.0], [1.0, 0.0]]);
        // The gap of the search.
        assert!((beyond - 0.125).abs() < 1e-7, "{beyond}");
        // y(u) = u (1 - u) beside the line: 1/4.
        let beside =
            from_one(&[[0.0, 1.0, 0.0, 0.0], [0.0, 1.0, -1.0, 0.0]], 1.0, [[0.0; 2], [1.0, 0.0]]);
        assert!((beside - 0.25).abs() < 1e-7, "{beside}");
        // Along the chord, and at a chord without length.
        assert!(from_one(&[[0.0, 1.0, 0.0, 0.0], [0.0; 4]], 1.0, [[0.0; 2], [1.0, 0.0]]) < 1e-10);
        let stand = from_one(&[[3.0, 0.0, 0.0, 0.0], [4.0, 0.0, 0.0, 0.0]], 1.0, [[0.0; 2]; 2]);
        assert!((stand - 5.0).abs() < 1e-6, "{stand}");
    }

    #[test]
    fn the_largest_distance_is_that_of_dense_samples() {
        let wave = |i: usize| ((i * i * 37 + i * 11) % 101) as f64 / 50.0 - 1.0;
        for case in 0..200 {
            let number = |k: usize| wave(13 * case + k);
            let cubic = [[0, 1, 2, 3].map(number), [4, 5, 6, 7].map(number)];
            let chords = [
                [[number(8), number(9)], [number(10), number(11)]],
                [[number(10), number(11)], [number(12), number(13)]],
            ];
            for count in 1..=2 {
                let farthest = |points: &[Point]| {
                    let of = |chord: &Chord| {
                        points.iter().map(|p| from_chord(*p, chord)).fold(0.0, f64::max)
                    };
                    chords[..count].iter().map(of).fold(f64::INFINITY, f64::min)
                };
                let stated = largest(&cubic, 2.0, 0.0, |points, _| farthest(points));
                let at = |k: usize| [0, 1].map(|a| evaluate(&cubic[a], 2e-4 * k as f64));
                let sampled = (0..=10_000).map(|k| farthest(&[at(k)])).fold(0.0, f64::max);
                // Samples miss the peak by the speed (30 at most) times half their distance; rounding of numbers of 10.
                assert!(
                    stated >= sampled - 1e-12 && stated < sampled + 3e-3,
                    "{case}: {stated} {sampled}"
                );
            }
        }
    }
}
