//! Fastest motion of two axes from one position and velocity to another, within limits.
//!
//! ```text
//! per axis  p(0) = p0, p'(0) = v0, p(T) = p1, p'(T) = v1,  |p'| <= V,  |p''| <= A             (1)
//! ```
//!
//! For a given T, the velocities that satisfy (1) except for `p1` are a convex set. The largest
//! displacement among them is reached by this motion: accelerate by A to `w`, hold, brake by A,
//!
//! ```text
//! w = min(V, (v0 + v1 + A T)/2),   T >= |v1 - v0|/A                                           (2)
//! d_max = (2 w^2 - v0^2 - v1^2)/(2 A) + w (T - (2 w - v0 - v1)/A)                             (3)
//! ```
//!
//! The smallest displacement is that of its mirror image. An axis can therefore arrive at T if and only if its
//! displacement `p1 - p0` is from d_min to d_max; then a weighted mean of both motions arrives. The result is the
//! smallest duration that both axes can do, searched from below. Any duration is possible that is at least the one in
//! which both axes brake to rest, move and start again.
//!
//! | symbol | variable |
//! |---|---|
//! | p0, v0 | `from` |
//! | p1, v1 | `to` |
//! | V, A | `max_velocity`, `max_acceleration` |

/// Positions and velocities of one axis at both ends of the motion, and its limits. Any unit of length and time, the
/// same everywhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AxisLink {
    /// Position and velocity at the start, [p0, v0].
    pub from: [f64; 2],
    /// Position and velocity at the end, [p1, v1].
    pub to: [f64; 2],
    /// Largest magnitude of the velocity; > 0 and at least those at the ends.
    pub max_velocity: f64,
    /// Largest magnitude of the acceleration; > 0.
    pub max_acceleration: f64,
}

/// Piece of the motion of both axes: its duration, and per axis the ascending coefficients of the position in the time
/// since the start of the piece.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkPiece {
    /// Duration of the piece; > 0.
    pub duration: f64,
    /// Ascending coefficients of the position per axis; the cubic one is zero.
    pub coefficient: [[f64; 4]; 2],
}

/// Number of durations tried between the smallest conceivable one and one that is surely possible.
/// Larger: more time. Smaller: a range of possible durations that is narrower than a step can be
/// missed. The link is then slower than necessary.
const TRIALS: u32 = 400;

/// Returns the fastest motion of both axes, as pieces of constant acceleration in order. Empty if both axes are
/// already in their final state.
pub fn link(axes: &[AxisLink; 2]) -> Vec<LinkPiece> {
    let duration = least_duration(axes);
    if duration == 0.0 {
        return Vec::new();
    }
    let profiles = axes.map(|axis| axis.profiles(duration));
    let mut times: Vec<f64> = profiles.iter().flatten().flat_map(|p| p.corner).collect();
    times.extend([0.0, duration]);
    times.sort_by(f64::total_cmp);
    // Corners closer than this are merged. The velocity differs by less than the rounding of A T.
    times.dedup_by(|b, a| *b - *a <= 1e-12 * duration);
    *times.last_mut().expect("it holds 0 and T") = duration;

    let mut state = axes.map(|axis| axis.from);
    let mut pieces = Vec::with_capacity(times.len());
    for w in times.windows(2) {
        let h = w[1] - w[0];
        let middle = 0.5 * (w[0] + w[1]);
        let coefficient = [0, 1].map(|k| {
            let [lowest, highest] = &profiles[k];
            let part = axes[k].weight(lowest, highest);
            let a =
                (1.0 - part) * lowest.acceleration(middle) + part * highest.acceleration(middle);
            let [p, v] = state[k];
            state[k] = [p + (v + 0.5 * a * h) * h, v + a * h];
            [p, v, 0.5 * a, 0.0]
        });
        pieces.push(LinkPiece { duration: h, coefficient });
    }
    pieces
}

/// Returns the smallest duration in which both axes can reach their final states at the same time.
fn least_duration(axes: &[AxisLink; 2]) -> f64 {
    let low = axes[0].least_for_velocity().max(axes[1].least_for_velocity());
    let high = axes[0].stop_and_go().max(axes[1].stop_and_go());
    if both_can_take(axes, low) {
        return low;
    }
    let trial = |k: u32| low + (high - low) * f64::from(k) / f64::from(TRIALS);
    let first = (1..=TRIALS).find(|k| both_can_take(axes, trial(*k))).unwrap_or(TRIALS);
    let mut below = trial(first - 1);
    let mut above = trial(first);
    // Halving ends at rounding.
    for _ in 0..60 {
        let middle = 0.5 * (below + above);
        if both_can_take(axes, middle) {
            above = middle;
        } else {
            below = middle;
        }
    }
    above
}

/// Returns true if both axes can reach their final states in exactly this duration.
fn both_can_take(axes: &[AxisLink; 2], duration: f64) -> bool {
    axes.iter().all(|axis| axis.can_take(duration))
}

/// Motion of one axis that accelerates, holds its velocity and brakes (largest displacement), or its mirror image
/// (smallest).
#[derive(Clone, Copy, Debug)]
struct Profile {
    /// Acceleration before the first corner time; the acceleration after the second corner time is its opposite.
    acceleration: f64,
    corner: [f64; 2],
    displacement: f64,
}

impl Profile {
    /// Returns the acceleration at the time t since the start.
    fn acceleration(&self, t: f64) -> f64 {
        match t {
            _ if t < self.corner[0] => self.acceleration,
            _ if t < self.corner[1] => 0.0,
            _ => -self.acceleration,
        }
    }
}

impl AxisLink {
    /// Returns the displacement p1 - p0 from the start to the end.
    fn displacement(&self) -> f64 {
        self.to[0] - self.from[0]
    }

    /// Returns the shortest duration of the change of velocity from v0 to v1 alone, at the largest acceleration.
    fn least_for_velocity(&self) -> f64 {
        (self.to[1] - self.from[1]).abs() / self.max_acceleration
    }

    /// Returns the duration of the motion that brakes to rest, moves from rest to rest, and accelerates to the final
    /// velocity.
    fn stop_and_go(&self) -> f64 {
        let v = self.max_velocity;
        let a = self.max_acceleration;
        let [v0, v1] = [self.from[1], self.to[1]];
        let rest = self.displacement() - (v0 * v0.abs() + v1 * v1.abs()) / (2.0 * a);
        let d = rest.abs();
        let between = if d * a < v * v { 2.0 * (d / a).sqrt() } else { d / v + v / a };
        // The factor keeps the rounding of the sum from making the duration too short.
        ((v0.abs() + v1.abs()) / a + between) * (1.0 + 1e-12)
    }

    /// Returns true if the axis can reach its final state in exactly this duration.
    fn can_take(&self, duration: f64) -> bool {
        let [lowest, highest] = self.profiles(duration);
        let d = self.displacement();
        lowest.displacement <= d && d <= highest.displacement
    }

    /// Returns the motions with the smallest and with the largest displacement in this duration, by (2) and (3) of the
    /// module.
    fn profiles(&self, duration: f64) -> [Profile; 2] {
        let a = self.max_acceleration;
        [-1.0, 1.0].map(|sign| {
            let v0 = sign * self.from[1];
            let v1 = sign * self.to[1];
            // w = min(V, (v0 + v1 + A T)/2)
            let w = self.max_velocity.min(0.5 * (v0 + v1 + a * duration)).max(v0).max(v1);
            let rise = (w - v0) / a;
            let fall = (w - v1) / a;
            let hold = (duration - rise - fall).max(0.0);
            // d = (2 w^2 - v0^2 - v1^2)/(2 A) + w hold
            let d = 0.5 * ((w + v0) * rise + (w + v1) * fall) + w * hold;
            Profile { acceleration: sign * a, corner: [rise, rise + hold], displacement: sign * d }
        })
    }

    /// Returns the weight, 0 to 1, of the motion with the largest displacement in the weighted mean of both motions
    /// whose displacement is p1 - p0. It is 1 if both have the same displacement.
    fn weight(&self, lowest: &Profile, highest: &Profile) -> f64 {
        let room = highest.displacement - lowest.displacement;
        if room <= 0.0 {
            return 1.0;
        }
        ((self.displacement() - lowest.displacement) / room).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn axis(from: [f64; 2], to: [f64; 2], max_velocity: f64, max_acceleration: f64) -> AxisLink {
        AxisLink { from, to, max_velocity, max_acceleration }
    }

    fn duration(pieces: &[LinkPiece]) -> f64 {
        pieces.iter().map(|p| p.duration).sum()
    }

    const STILL: AxisLink =
        AxisLink { from: [0.0; 2], to: [0.0; 2], max_velocity: 1.0, max_acceleration: 1.0 };

    #[test]
    fn rest_to_rest_takes_the_least_time() {
        // T = 2 sqrt(d/a), and d/v + v/a where the velocity limit is reached.
        for (d, v, t) in [(8.0, 10.0, 4.0), (-8.0, 10.0, 4.0), (8.0, 2.0, 5.0)] {
            let pieces = link(&[axis([1.0, 0.0], [1.0 + d, 0.0], v, 2.0), STILL]);
            assert!((duration(&pieces) - t).abs() < 1e-9, "{d}: {}", duration(&pieces));
        }
    }

    #[test]
    fn a_turn_around_brakes_and_returns() {
        // From 3 outwards to 3 inwards at the same place: 2 v/a = 3 s, going out v^2/2a = 2.25.
        let x = axis([5.0, 3.0], [5.0, -3.0], 10.0, 2.0);
        let y = axis([0.0, 0.0], [0.5, 0.0], 10.0, 2.0);
        let pieces = link(&[x, y]);
        assert!((duration(&pieces) - 3.0).abs() < 1e-9);
        let furthest = pieces.iter().map(|p| p.coefficient[0][0]).fold(0.0, f64::max);
        assert!(furthest <= 7.25 + 1e-9, "{furthest}");
    }

    #[test]
    fn nothing_to_do_has_no_pieces() {
        assert!(link(&[STILL, STILL]).is_empty());
    }

    fn one() -> impl Strategy<Value = AxisLink> {
        (-5.0..5.0_f64, -1.0..1.0_f64, -1.0..1.0_f64, 0.1..5.0_f64, 0.1..5.0_f64, 0..4_u8).prop_map(
            |(d, v0, v1, v, a, degenerate)| {
                let still = |bit: u8, x: f64| if degenerate & bit == 0 { x } else { 0.0 };
                axis([0.3, still(1, v0 * v)], [0.3 + d, still(2, v1 * v)], v, a)
            },
        )
    }

    proptest! {
        #[test]
        fn links_arrive_within_the_limits(x in one(), y in one()) {
            let pieces = link(&[x, y]);
            for (k, axis) in [x, y].iter().enumerate() {
                let mut state = axis.from;
                for piece in &pieces {
                    let [p, v, half, zero] = piece.coefficient[k];
                    prop_assert!(piece.duration > 0.0 && zero == 0.0);
                    prop_assert_eq!(state, [p, v], "pieces join exactly");
                    let (h, a) = (piece.duration, 2.0 * half);
                    // Rounding of the weighted mean of two numbers of magnitude A.
                    prop_assert!(a.abs() <= axis.max_acceleration * (1.0 + 1e-14));
                    state = [p + (v + 0.5 * a * h) * h, v + a * h];
                    // Up to ten pieces, each rounding A T: 1e-15 of velocities and times up to 100.
                    prop_assert!(state[1].abs() <= axis.max_velocity + 1e-11);
                }
                // Merged corners, 1e-12 of a duration up to 200 at velocities up to 5.
                prop_assert!((state[0] - axis.to[0]).abs() < 1e-8, "{:?} {:?}", state, axis);
                prop_assert!((state[1] - axis.to[1]).abs() < 1e-9, "{:?} {:?}", state, axis);
            }
            // Not longer than stopping first, and not shorter than the change of velocity asks.
            let stop = x.stop_and_go().max(y.stop_and_go());
            prop_assert!(duration(&pieces) <= stop * (1.0 + 1e-9));
        }
    }
}
