//! Motion along an arc whose time is a function of the arc length, as cubic pieces in time.
//!
//! ```text
//! t(s) = integral of D ds,  D = dt/ds > 0;   v = 1/D,  a = -D'/D^3
//! s(u) = s0 + v0 u + (3 ds/h - 2 v0 - v1)/h u^2 + (v0 + v1 - 2 ds/h)/h^2 u^3,  u = t - t(s0)   (1)
//! ```
//!
//! A piece from `s0` to `s1` is the cubic Hermite polynomial (1). Positions, times and velocities
//! at its ends are exact (`ds = s1 - s0`, `h = t(s1) - t(s0)`). It is halved until it is within the
//! tolerance of the inverse of t(s), and its velocity and acceleration are within the limits. The
//! inverse itself is not needed, because at the time t(s) the true position is s. The error falls
//! with the fourth power of h.
//!
//! Source: C. de Boor, *A Practical Guide to Splines*, chapter IV.

use crate::polynomial::{derivative, evaluate, range};

/// One piece of the motion along an arc, cubic in time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimingPiece {
    /// Arc length at the start of the piece.
    pub start: f64,
    /// Arc length at the end of the piece.
    pub end: f64,
    /// Duration of the piece; > 0.
    pub duration: f64,
    /// Coefficients of the arc length in ascending powers of the time since the start of the piece.
    pub coefficient: [f64; 4],
}

/// Pieces that approximate a motion, and their largest difference from it.
#[derive(Clone, Debug, PartialEq)]
pub struct TimingFit {
    /// Pieces in order along the arc.
    pub pieces: Vec<TimingPiece>,
    /// Largest difference of arc length from the motion at equal times, among 15 points in every piece.
    pub largest_error: f64,
}

/// Number of points inside a piece where it is compared with the motion. Larger: more time. Smaller: the largest
/// difference of these can be below the true one by more. A test allows 5 % for 15 points.
const PLACES: u32 = 15;

/// Smallest useful tolerance of a fit, mm: a picometre. Smaller: pieces are halved because of the
/// rounding of path lengths. Larger: fine fits are refused.
pub const LEAST_TOLERANCE_MM: f64 = 1e-9;

/// Largest number of halvings of an interval. Each halving divides the error by 16, which is 3e14
/// for 12. Larger: no change, because rounding comes first. Smaller: a piece can stay outside the
/// tolerance.
const MAX_HALVINGS: u32 = 12;

/// Fits the motion that passes the arc length s at the time `time(s)`, with the derivative `density(s)` = dt/ds,
/// between consecutive `breaks` (arc lengths, strictly ascending).
///
/// A piece is halved until it is within `tolerance` in arc length, and within `max_velocity` and `max_acceleration`
/// along the arc (infinite if there is no limit). After 12 halvings it is taken as it is, so the caller must check
/// `largest_error`. The motion itself should stay somewhat below both limits.
pub fn fit(
    time: impl Fn(f64) -> f64,
    density: impl Fn(f64) -> f64,
    breaks: &[f64],
    tolerance: f64,
    max_velocity: f64,
    max_acceleration: f64,
) -> TimingFit {
    let mut fit = TimingFit { pieces: Vec::new(), largest_error: 0.0 };
    for w in breaks.windows(2) {
        let mut open = vec![(w[0], w[1], 0)];
        while let Some((start, end, halvings)) = open.pop() {
            let piece = hermite(&time, &density, start, end);
            let error = largest_error(&time, &piece);
            let good = error <= tolerance
                && range(&derivative(&piece.coefficient), piece.duration).max <= max_velocity
                && end_acceleration(&piece) <= max_acceleration;
            if good || halvings == MAX_HALVINGS {
                fit.largest_error = fit.largest_error.max(error);
                fit.pieces.push(piece);
            } else {
                let middle = 0.5 * (start + end);
                open.push((middle, end, halvings + 1));
                open.push((start, middle, halvings + 1));
            }
        }
    }
    fit
}

/// Returns the cubic Hermite piece (1) of the module from the arc length `start` to `end`.
fn hermite(
    time: impl Fn(f64) -> f64,
    density: impl Fn(f64) -> f64,
    start: f64,
    end: f64,
) -> TimingPiece {
    let ds = end - start;
    let h = time(end) - time(start);
    let v0 = 1.0 / density(start);
    let v1 = 1.0 / density(end);
    let coefficient =
        [start, v0, (3.0 * ds / h - 2.0 * v0 - v1) / h, (v0 + v1 - 2.0 * ds / h) / (h * h)];
    TimingPiece { start, end, duration: h, coefficient }
}

/// Returns the largest difference of arc length between a piece and the motion at equal times, among [`PLACES`] points.
fn largest_error(time: impl Fn(f64) -> f64, piece: &TimingPiece) -> f64 {
    let begin = time(piece.start);
    let errors = (1..=PLACES).map(|k| {
        let s = piece.start + (piece.end - piece.start) * f64::from(k) / f64::from(PLACES + 1);
        (evaluate(&piece.coefficient, time(s) - begin) - s).abs()
    });
    errors.fold(0.0, f64::max)
}

/// Returns the largest magnitude of the acceleration in a piece. It is at an end, because the acceleration is linear
/// in time.
fn end_acceleration(piece: &TimingPiece) -> f64 {
    let [_, _, c2, c3] = piece.coefficient;
    (2.0 * c2).abs().max((2.0 * c2 + 6.0 * c3 * piece.duration).abs())
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: f64 = f64::INFINITY;

    /// Returns the fit of the motion with the density D = 1 + s: t = s + s^2/2, s = sqrt(1 + 2t) - 1.
    fn fitted(tolerance: f64) -> TimingFit {
        fit(|s| s + 0.5 * s * s, |s| 1.0 + s, &[0.0, 0.7, 3.0], tolerance, NONE, NONE)
    }

    #[test]
    fn within_the_tolerance_of_the_inverse_everywhere() {
        let fit = fitted(1e-7);
        // The tolerance that is asked for. A halving divides the error by 16: no fit is a thousand times finer than
        // that.
        assert!(fit.largest_error <= 1e-7 && fit.largest_error > 1e-10);
        let mut begin = 0.0;
        for piece in &fit.pieces {
            for k in 0..=50 {
                let u = piece.duration * f64::from(k) / 50.0;
                let exact = (1.0 + 2.0 * (begin + u)).sqrt() - 1.0;
                let error = (evaluate(&piece.coefficient, u) - exact).abs();
                // The places of the check miss the maximum by at most some percent.
                assert!(error <= 1.05e-7, "{error}");
            }
            begin += piece.duration;
        }
        // Rounding of a sum of some hundred durations.
        assert!((begin - 7.5).abs() < 1e-13);
        assert!(fit.pieces.iter().any(|p| p.end == 0.7), "breaks are kept");
    }

    #[test]
    fn the_error_falls_with_the_fourth_power_of_the_step() {
        let error = |n: u32| {
            let breaks: Vec<f64> = (0..=n).map(|k| 3.0 * f64::from(k) / f64::from(n)).collect();
            fit(|s| s + 0.5 * s * s, |s| 1.0 + s, &breaks, 1.0, NONE, NONE).largest_error
        };
        let order = (error(16) / error(32)).log2();
        // The order is 4; at 16 pieces the next order takes a part of it.
        assert!(order > 3.8 && order < 4.2, "order {order}");
    }

    #[test]
    fn the_acceleration_limit_is_kept_by_shorter_pieces() {
        // v = 1 until s = 1/4, then v^2 = 1 - 2 A (s - 1/4) with A = 1/2: uniform braking, to 1/2 at s = 1.
        // One piece for all starts to brake later and ends with more: of a braking that fills the
        // fraction r of the time, r (4 - 3r) times A. Here r = 1 s / 1.25 s.
        let late = |s: f64| (s - 0.25).max(0.0);
        let density = |s: f64| 1.0 / (1.0 - late(s)).sqrt();
        let time = |s: f64| s.min(0.25) + 2.0 * (1.0 - (1.0 - late(s)).sqrt());
        let pieces = |limit: f64| fit(time, density, &[0.0, 1.0], 1.0, NONE, limit).pieces;
        let coarse = pieces(NONE);
        assert_eq!(coarse.len(), 1);
        let expected = 0.5 * 0.8 * (4.0 - 3.0 * 0.8);
        // Rounding of coefficients of the order 1.
        assert!((end_acceleration(&coarse[0]) - expected).abs() < 1e-14, "{coarse:?}");
        // Halved twice, the break at 1/4 is the end of a piece: each is the motion itself.
        let fine = pieces(0.5 + 1e-4);
        assert_eq!(fine.iter().map(|p| p.end).collect::<Vec<_>>(), [0.25, 0.5, 1.0]);
        let accelerations = fine.iter().map(end_acceleration);
        for (found, expected) in accelerations.zip([0.0, 0.5, 0.5]) {
            // Rounding of the same, over pieces of a quarter.
            assert!((found - expected).abs() < 1e-13, "{found} {expected}");
        }
    }

    #[test]
    fn the_velocity_limit_is_kept_by_shorter_pieces() {
        // v = 1 until s = 2.5, then slower: one piece bulges above 1 to make up for its slow end.
        let late = |s: f64| (s - 2.5).max(0.0);
        let time = |s: f64| s + 10.0 / 3.0 * late(s).powi(3);
        let density = |s: f64| 1.0 + 10.0 * late(s).powi(2);
        let peak = |p: &TimingPiece| range(&derivative(&p.coefficient), p.duration).max;
        let fastest = |limit: f64| {
            let fit = fit(time, density, &[0.0, 3.0], 1.0, limit, NONE);
            fit.pieces.iter().map(peak).fold(0.0, f64::max)
        };
        assert!(fastest(NONE) > 1.01, "{}", fastest(NONE));
        assert!(fastest(1.0 + 1e-6) <= 1.0 + 1e-6);
    }

    #[test]
    fn constant_feed_is_exact_in_one_piece() {
        let fit = fit(|s| 0.5 * s, |_| 0.5, &[1.0, 4.0], 1e-12, NONE, NONE);
        assert_eq!(fit.pieces.len(), 1);
        assert_eq!(fit.pieces[0].coefficient, [1.0, 2.0, 0.0, 0.0]);
    }
}
