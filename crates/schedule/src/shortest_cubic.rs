//! Motion from one state to another by one cubic per axis, in the shortest time within the limits.
//!
//! ```text
//! p(u) = Hermite cubic of (p, v), (q, w) over T          least T with |p'| <= v_max, |p''| <= a_max
//! ```
//!
//! For long T the acceleration tends to 0, and the velocity to `v (1 - 4 x + 3 x^2) + w (3 x^2 - 2 x)`
//! with x = u/T, which is never faster than its ends. So a time within the limits always exists.
//! The cubic is not the fastest motion, which has several phases. But it is smooth, and only one
//! polynomial has to be checked. A cubic that turns around swings beyond its ends; the tool is off.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | p, v | `from` | (2) each | mm, mm/s |
//! | q, w | `to` | (2) each | mm, mm/s |
//! | T | `duration_s` | - | s |

use planish_types::Limits;

use crate::hermite::{accelerations, coefficients, peak_velocity};

/// Part of the acceleration limit that the cubic leaves free, relative: room for the rounding of its
/// coefficients. Larger: links take longer. Smaller: rounding can exceed the limit.
const MARGIN: f64 = 1e-6;

/// Position and velocity of the tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct State {
    /// Position [x, y], mm.
    pub position_mm: [f64; 2],
    /// Velocity [x, y], mm/s.
    pub velocity_mm_per_s: [f64; 2],
}

impl State {
    /// Returns the state of rest at the point [x, y], mm.
    pub(crate) fn at_rest(position_mm: [f64; 2]) -> Self {
        Self { position_mm, velocity_mm_per_s: [0.0; 2] }
    }
}

/// One cubic segment of a trajectory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CubicSegment {
    /// Duration, s.
    pub duration_s: f64,
    /// Coefficients of the position of [x, y] in the local time, ascending, mm/s^order.
    pub coefficient_mm: [[f64; 4]; 2],
}

/// Returns the shortest cubic segment between two states within the limits that lasts at least `least_s`. `None` if
/// displacement, velocities, `least_s` and the shortest segment of the controller are all zero. An end that is faster
/// than the velocity limit keeps its velocity.
pub(crate) fn shortest_cubic(
    from: State,
    to: State,
    limits: &Limits,
    least_s: f64,
) -> Option<CubicSegment> {
    let v_max = limits.max_velocity_mm_per_s();
    let a_max = limits.max_acceleration_mm_per_s2();
    let dp = [0, 1].map(|a| to.position_mm[a] - from.position_mm[a]);
    let v = from.velocity_mm_per_s;
    let w = to.velocity_mm_per_s;
    let least_s = least_s.max(limits.min_segment_s());
    let fits = |h: f64| {
        (0..2).all(|a| {
            let (start, end) = accelerations(dp[a], v[a], w[a], h);
            let fastest = v_max[a].max(v[a].abs()).max(w[a].abs()) * (1.0 + 1e-12);
            start.abs().max(end.abs()) <= a_max[a] * (1.0 - MARGIN)
                && peak_velocity(dp[a], v[a], w[a], h).0 <= fastest
        })
    };
    let scale = (0..2).map(|a| dp[a].abs() / v_max[a] + (v[a] - w[a]).abs() / a_max[a]);
    let scale: f64 = scale.sum();
    if scale == 0.0 && v == [0.0; 2] && least_s == 0.0 {
        return None;
    }
    // The same velocity at the same place needs a loop; its time is at least that of braking.
    let braking = (0..2).map(|a| v[a].abs() / a_max[a]).fold(0.0, f64::max);
    let mut low = least_s.max(if scale > 0.0 { 0.1 * scale } else { braking });
    if !fits(low) {
        // Short enough steps that no feasible time of practical use is passed over.
        let mut high = low;
        while !fits(high) {
            low = high;
            high *= 1.05;
        }
        for _ in 0..30 {
            let middle = 0.5 * (low + high);
            if fits(middle) { high = middle } else { low = middle }
        }
        low = high;
    }
    let coefficient_mm = [0, 1].map(|a| coefficients(from.position_mm[a], dp[a], v[a], w[a], low));
    Some(CubicSegment { duration_s: low, coefficient_mm })
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{MachineFile, MachineFileAxis};

    fn limits(v: f64, a: f64) -> Limits {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: v,
            max_acceleration_mm_per_s2: a,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        MachineFile {
            name: "m".into(),
            axes: vec![axis("x"), axis("y")],
            min_segment_s: 0.0,
            ..MachineFile::default()
        }
        .checked()
        .unwrap()
    }

    fn end(x: f64, v: f64) -> State {
        State { position_mm: [x, 0.0], velocity_mm_per_s: [v, 0.0] }
    }

    #[test]
    fn rest_to_rest_is_as_fast_as_one_cubic_can_be() {
        // a = 6 d / T^2, v = 1.5 d / T
        let t = shortest_cubic(end(0.0, 0.0), end(6.0, 0.0), &limits(1e3, 4.0), 0.0)
            .unwrap()
            .duration_s;
        assert!((t - 3.0).abs() < 1e-5 && t >= 3.0, "{t}");
        let t = shortest_cubic(end(0.0, 0.0), end(6.0, 0.0), &limits(1.5, 1e3), 0.0)
            .unwrap()
            .duration_s;
        assert!((t - 6.0).abs() < 1e-5, "{t}");
        let t = shortest_cubic(end(0.0, 0.0), end(6.0, 0.0), &limits(1e3, 4.0), 7.0)
            .unwrap()
            .duration_s;
        assert_eq!(t, 7.0);
        assert!(shortest_cubic(end(1.0, 0.0), end(1.0, 0.0), &limits(1.0, 1.0), 0.0).is_none());
    }

    #[test]
    fn a_turn_around_and_a_loop_exist() {
        // Back at the same place with the opposite velocity: a = 2 v / T.
        let turn = shortest_cubic(end(1.0, 3.0), end(1.0, -3.0), &limits(5.0, 2.0), 0.0).unwrap();
        assert!((turn.duration_s - 3.0).abs() < 1e-4, "{turn:?}");
        let same = shortest_cubic(end(1.0, 3.0), end(1.0, 3.0), &limits(5.0, 2.0), 0.0).unwrap();
        // a = 6 v / T at both ends.
        assert!((same.duration_s - 9.0).abs() < 1e-3, "{same:?}");
    }
}
