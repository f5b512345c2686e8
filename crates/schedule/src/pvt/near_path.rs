//! Distance of a PVT motion from its path, and the node velocities that keep it within a tolerance.
//!
//! A Hermite cubic of duration h from p0 to p0 + dp lies in the hull of its Bernstein coefficients
//!
//! ```text
//! p0,   p0 + v0 h/3,   p0 + dp - v1 h/3,   p0 + dp                                      (1)
//! ```
//!
//! The points within eps of the chord are a convex set. So the cubic stays within eps of its chord if both middle
//! coefficients do, which are conditions on one node velocity each. Rest always keeps them. Per axis, a rectangle
//! around a point c of the chord, with the normal n of the chord, is within eps if its half widths are eps / (2 |n_x|)
//! and eps / (2 |n_y|): along an axis it has no width to keep. With the rectangle, (1) is a bound of each velocity by
//! itself, and joins the quadratic program of each axis.
//!
//! A box of eps around both ends of the segment, in place of the chord, bounds the distance for chords along an axis
//! only: a motion inside of the box leaves a diagonal by up to half its length.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | dp | `displacement_mm` | (N) | mm |
//! | eps | `tolerance_mm` | - | mm |

use planish_numerics::distance::{Point, from_chord, largest};

use super::timing::parallel;
use crate::hermite::coefficients;
use rayon::prelude::*;

/// Part of the tolerance that a motion may use. Larger: the solver's tolerance and rounding exceed it. Smaller: motions
/// are slower.
const USABLE_PART: f64 = 1.0 - 1e-6;

/// Largest part of a segment that a held (reduced) velocity may cover in a third of the time. With at most half at both
/// ends, the motion does not reverse inside of the segment. Larger: it may swing within the tolerance. Smaller: it is
/// slower at its ends than in the middle.
const HELD_PART: f64 = 0.5;

/// Number of halvings in the search for the largest part of a velocity within the tolerance; 30 resolve it to 1e-9.
/// Larger: more time, no effect. Smaller: motions that are slower than the tolerance needs.
const BISECTIONS: usize = 30;

/// Segments of a path, and the largest distance of a motion from them.
#[derive(Debug)]
pub(super) struct NearPath {
    displacement_mm: Vec<Point>,
    tolerance_mm: f64,
}

/// Smallest and largest velocity of a node, per axis [x, y], mm/s.
pub(super) type VelocityRange = [[f64; 2]; 2];

impl NearPath {
    pub(super) fn new(displacement_mm: Vec<Point>, tolerance_mm: f64) -> Self {
        Self { displacement_mm, tolerance_mm: USABLE_PART * tolerance_mm }
    }

    /// Returns true if both middle coefficients of segment `i`, (1) of the module, are within the tolerance of the
    /// segment. `from` and `to` are the velocities at its ends, mm/s.
    pub(super) fn hull_is_near(&self, i: usize, from: Point, to: Point, h: f64) -> bool {
        let dp = self.displacement_mm[i];
        self.is_near(i, from.map(|v| v * h / 3.0))
            && self.is_near(i, [0, 1].map(|a| dp[a] - to[a] * h / 3.0))
    }

    /// Returns true if `point`, mm, relative to the start of segment `i`, is within the tolerance of the segment.
    fn is_near(&self, i: usize, point: Point) -> bool {
        from_chord(point, &[[0.0; 2], self.displacement_mm[i]]) <= self.tolerance_mm
    }

    /// Returns true if the Hermite cubic of segment `i` with the end velocities `from` and `to`, mm/s, and the duration
    /// `h`, s, stays within the tolerance.
    fn cubic_is_near(&self, i: usize, from: Point, to: Point, h: f64) -> bool {
        if self.hull_is_near(i, from, to, h) {
            return true;
        }
        let dp = self.displacement_mm[i];
        self.pieces_are_near(
            i,
            [([0, 1].map(|a| coefficients(0.0, dp[a], from[a], to[a], h)), h)].into_iter(),
        )
    }

    /// Returns true if cubics stay within the tolerance of segment `i`. Each one is a pair of coefficients, relative to
    /// the start of the segment, and duration, s.
    pub(super) fn pieces_are_near(
        &self,
        i: usize,
        mut pieces: impl Iterator<Item = ([[f64; 4]; 2], f64)>,
    ) -> bool {
        let chord = [[0.0; 2], self.displacement_mm[i]];
        pieces.all(|(cubic, h)| {
            let farthest_mm = largest(&cubic, h, self.tolerance_mm, |points, _| {
                points.iter().map(|p| from_chord(*p, &chord)).fold(0.0, f64::max)
            });
            farthest_mm <= self.tolerance_mm * (1.0 + 1e-9)
        })
    }

    /// Returns the indices of the segments whose Hermite cubics leave the tolerance, with these node velocities per
    /// axis, mm/s.
    pub(super) fn far_segments(&self, velocity: [&[f64]; 2], h: &[f64]) -> Vec<usize> {
        let far = parallel(h.len()).filter(|i| {
            let [from, to] = [*i, *i + 1].map(|node| [velocity[0][node], velocity[1][node]]);
            !self.cubic_is_near(*i, from, to, h[*i])
        });
        far.collect()
    }

    /// Returns the largest multiple, up to 1, of `velocity` with which both segments beside an inner node stay near.
    /// The condition is that the middle coefficient beside the node, (1) of the module, is within half of the tolerance
    /// of the nearer half of its segment. It is 0 if the velocity points back along one of them. `h` (N) are the
    /// durations, s.
    pub(super) fn held(&self, node: usize, velocity: Point, h: &[f64]) -> Point {
        let ahead = [0, 1].map(|a| self.displacement_mm[node][a]);
        let backwards = [0, 1].map(|a| self.displacement_mm[node - 1][a]);
        if [ahead, backwards].iter().any(|dp| dp[0] * velocity[0] + dp[1] * velocity[1] < 0.0) {
            return [0.0; 2];
        }
        let is_near = |part: f64| {
            [(ahead, h[node]), (backwards, h[node - 1])].into_iter().all(|(dp, h)| {
                let point = velocity.map(|v| part * v * h / 3.0);
                from_chord(point, &[[0.0; 2], dp.map(|d| HELD_PART * d)]) <= 0.5 * self.tolerance_mm
            })
        };
        if is_near(1.0) {
            return velocity;
        }
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..BISECTIONS {
            let middle = 0.5 * (low + high);
            if is_near(middle) { low = middle } else { high = middle }
        }
        velocity.map(|v| low * v)
    }

    /// Returns ranges of the velocity of an inner node around the velocity `held`. Within them the middle coefficients
    /// beside it, (1) of the module, stay within the tolerance, whatever the velocities of the other nodes are.
    pub(super) fn velocity_range(&self, node: usize, held: Point, h: &[f64]) -> VelocityRange {
        let ahead = self.rectangle(self.displacement_mm[node], held, h[node]);
        let backwards = self.rectangle(self.displacement_mm[node - 1], held, h[node - 1]);
        [0, 1].map(|a| {
            let [low, high] = [ahead[a][0].max(backwards[a][0]), ahead[a][1].min(backwards[a][1])];
            // Rounding does not exclude it.
            [low.min(held[a]), high.max(held[a])]
        })
    }

    /// Returns a rectangle of velocities around `held` with which one middle coefficient stays within the tolerance of
    /// a segment along `dp` of duration `h`. By symmetry the condition is the same for a segment that starts at the
    /// node and for one that ends there.
    fn rectangle(&self, dp: Point, held: Point, h: f64) -> VelocityRange {
        let length = dp[0].hypot(dp[1]);
        let point = held.map(|v| v * h / 3.0);
        let square = (length * length).max(f64::MIN_POSITIVE);
        let place = ((point[0] * dp[0] + point[1] * dp[1]) / square).clamp(0.0, 1.0);
        let half = 0.5 * self.tolerance_mm;
        let mut rectangle = [0, 1].map(|a| {
            // The part of the normal along this axis is that of the chord along the other one.
            let across = if length > 0.0 { dp[1 - a].abs() / length } else { 1.0 };
            let width = if across > 0.0 { half / across } else { f64::INFINITY };
            let [low, high] = [dp[a].min(0.0) - half, dp[a].max(0.0) + half];
            [(place * dp[a] - width).max(low), (place * dp[a] + width).min(high)]
        });
        // Beyond the ends of a chord its corners may be too far.
        for _ in 0..BISECTIONS {
            let mut corners = (0..4).map(|k| [rectangle[0][k & 1], rectangle[1][k >> 1]]);
            if !corners.any(|corner| from_chord(corner, &[[0.0; 2], dp]) > 2.0 * half) {
                break;
            }
            rectangle = [0, 1].map(|a| rectangle[a].map(|v| point[a] + 0.9 * (v - point[a])));
        }
        rectangle.map(|range| range.map(|mm| 3.0 * mm / h))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_testkit::numbers;

    /// Returns segments of random directions and lengths, and times over two decades, s.
    fn random(seed: u64) -> (NearPath, Vec<f64>) {
        let mut random = numbers(seed);
        let dp = (0..40)
            .map(|_| {
                let (length, turn) = (10f64.powf(2.0 * random() - 1.0), 6.3 * random());
                [length * turn.cos(), length * turn.sin()]
            })
            .collect();
        (NearPath::new(dp, 0.2), (0..40).map(|_| 10f64.powf(2.0 * random() - 2.0)).collect())
    }

    #[test]
    fn held_velocities_and_their_ranges_keep_the_tolerance() {
        let mut moving = 0;
        for seed in 0..20 {
            let (near, h) = random(seed);
            let mut random = numbers(100 + seed);
            let mut node = |i: usize| {
                let wanted = [100.0 * random() - 50.0, 100.0 * random() - 50.0];
                let held = if i == 0 || i == h.len() { [0.0; 2] } else { near.held(i, wanted, &h) };
                moving += usize::from(held != [0.0; 2]);
                if i == 0 || i == h.len() {
                    return held;
                }
                let range = near.velocity_range(i, held, &h);
                for a in 0..2 {
                    assert!(range[a][0] <= held[a] && held[a] <= range[a][1], "{range:?} {held:?}");
                }
                // Any velocity of the range.
                [0, 1].map(|a| range[a][0] + random() * (range[a][1] - range[a][0]))
            };
            let velocity: Vec<Point> = (0..=h.len()).map(&mut node).collect();
            for i in 0..h.len() {
                assert!(near.hull_is_near(i, velocity[i], velocity[i + 1], h[i]), "{seed} {i}");
            }
            let axis = |a: usize| velocity.iter().map(|v| v[a]).collect::<Vec<_>>();
            assert!(near.far_segments([&axis(0), &axis(1)], &h).is_empty());
        }
        assert!(moving > 200, "{moving}");
    }

    #[test]
    fn along_an_axis_the_range_is_the_whole_box() {
        // 3 mm in 1 s, there and on: up to half a tolerance beyond the ends, and across.
        let near = NearPath::new(vec![[3.0, 0.0]; 2], 0.2);
        let [x, y] = near.velocity_range(1, [1.0, 0.0], &[1.0; 2]);
        let expected = [-0.3, 9.3, -0.3, 0.3];
        // The part of the tolerance that is not used.
        for (found, expected) in [x, y].as_flattened().iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{x:?} {y:?}");
        }
    }
}
