//! Models of a controller's planner: what it makes of the commanded motion r(t) before the axes follow it.
//!
//! ```text
//! smoothing   q(t) = 1/w int_{t-w}^t r(s) ds                   the moving average over the time w
//! corners     q(t) = r(s(t)),  s' = f,  f <= 1                 the planner slows down at a corner
//!             f <= min(1, d / |v+ - v-|)  at a corner          d: change of the velocity that it lets pass
//!             |f'| <= a / v               beside it            a: acceleration along the path, v: speed of the line
//! ```
//!
//! A corner is a place where the commanded velocity jumps from v- to v+; at both ends of the motion the machine is at
//! rest. Between equal speeds v with a turn of the angle b the rule lets the speed `d / (2 sin(b/2))` pass. A motion
//! without jumps of the velocity has no corner. The acceleration of the command itself does not count in the second
//! rule.

use planish_numerics::polynomial::{derivative, evaluate, shifted};

use crate::{motion::MotionPiece, servo::hermite};

/// Change of the commanded motion by a planner.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)] // the equations above have w, d and a
pub enum Planner {
    Smoothing { window_s: f64 },
    Corners { step_mm_per_s: f64, acceleration_mm_per_s2: f64 },
}

impl Planner {
    /// Returns the motion that this planner makes of the command `pieces`. `origin` has an index for each of the
    /// pieces, which its parts get. A window of 0 changes nothing.
    pub fn follow(self, pieces: &[MotionPiece], origin: &[usize]) -> Followed {
        match self {
            Self::Smoothing { window_s } if pieces.is_empty() || window_s <= 0.0 => {
                (pieces.to_vec(), origin.to_vec())
            }
            Self::Smoothing { window_s } => smoothed(pieces, origin, window_s),
            Self::Corners { step_mm_per_s, acceleration_mm_per_s2 } => {
                slowed_at_corners(pieces, origin, step_mm_per_s, acceleration_mm_per_s2)
            }
        }
    }
}

/// Pieces of a motion, and for each of them the index of the piece of the command of which it is a part.
type Followed = (Vec<MotionPiece>, Vec<usize>);

/// Number of parts of an interval in which a motion that is no cubic is replaced by cubics. Larger: more pieces.
/// Smaller: a larger error, which falls with the fourth power: a jump of 1e4 mm/s^3 of the jerk errs by 13 nm with a
/// window of 20 ms.
const PARTS: usize = 2;

/// Change of the velocity at a corner, relative to the velocities, that is rounding.
const ROUNDING: f64 = 1e-9;

/// Returns the moving average of the command `pieces` over the time `window_s`, > 0, before every time. `origin` has an
/// index for each of the pieces, which its parts get.
fn smoothed(pieces: &[MotionPiece], origin: &[usize], window_s: f64) -> Followed {
    let mut late = Past::new(pieces);
    let now = Past::new(pieces);
    let (mut motion, mut from) = (Vec::new(), Vec::new());
    for (k, p) in pieces.iter().enumerate() {
        let end_s = p.start_s + p.duration_s;
        let mut start_s = p.start_s;
        while start_s < end_s {
            // Up to the next break of the command, or of the command one window before.
            let next_late_s = late.next_break_s(start_s - window_s) + window_s;
            let until_s = if next_late_s < end_s { next_late_s } else { end_s };
            let parts = if until_s - start_s > window_s { 1 } else { PARTS };
            let h = (until_s - start_s) / parts as f64;
            if h <= f64::EPSILON * end_s {
                break;
            }
            for part in 0..parts {
                let t = start_s + part as f64 * h;
                let [q0, q1] = [t, t + h].map(|t| {
                    let area = now.area_until(k, t);
                    let (area_late, r_late) = late.at_time(t - window_s);
                    // q' = (r(t) - r(t - w)) / w
                    [0, 1].map(|a| {
                        let r = evaluate(&p.coefficient_mm[a], t - p.start_s);
                        [(area[a] - area_late[a]) / window_s, (r - r_late[a]) / window_s]
                    })
                });
                let coefficient_mm = [0, 1].map(|a| hermite(q0[a], q1[a], h));
                motion.push(MotionPiece { start_s: t, duration_s: h, coefficient_mm, ..*p });
                from.push(origin[k]);
            }
            start_s = until_s;
        }
    }
    (motion, from)
}

/// Positions and their integrals over time of a command that rests before its start.
struct Past<'a> {
    pieces: &'a [MotionPiece],
    /// Integral of the position from the start of the motion to the start of every piece, mm s.
    area: Vec<[f64; 2]>,
    /// Index of the piece of the last call.
    piece: usize,
}

impl<'a> Past<'a> {
    fn new(pieces: &'a [MotionPiece]) -> Self {
        let mut sum = [0.0; 2];
        let mut area = Vec::with_capacity(pieces.len());
        for p in pieces {
            area.push(sum);
            for a in 0..2 {
                sum[a] += integral(&p.coefficient_mm[a], p.duration_s);
            }
        }
        Self { pieces, area, piece: 0 }
    }

    /// Returns the integral from the start of the motion to the time `t_s` in piece `k`, mm s.
    fn area_until(&self, k: usize, t_s: f64) -> [f64; 2] {
        let p = &self.pieces[k];
        [0, 1].map(|a| self.area[k][a] + integral(&p.coefficient_mm[a], t_s - p.start_s))
    }

    /// Moves on to the piece at the time `t_s`. Returns its index, or `None` before the motion.
    fn find(&mut self, t_s: f64) -> Option<usize> {
        if t_s < self.pieces[0].start_s {
            return None;
        }
        while self.piece + 1 < self.pieces.len() && self.pieces[self.piece + 1].start_s <= t_s {
            self.piece += 1;
        }
        while self.piece > 0 && self.pieces[self.piece].start_s > t_s {
            self.piece -= 1;
        }
        Some(self.piece)
    }

    /// Returns the integral until the time `t_s`, mm s, and the position then, mm.
    fn at_time(&mut self, t_s: f64) -> ([f64; 2], [f64; 2]) {
        let first = &self.pieces[0];
        match self.find(t_s) {
            None => {
                let rest = [0, 1].map(|a| first.coefficient_mm[a][0]);
                (rest.map(|r| r * (t_s - first.start_s)), rest)
            }
            Some(k) => {
                let p = &self.pieces[k];
                let r = [0, 1].map(|a| evaluate(&p.coefficient_mm[a], t_s - p.start_s));
                (self.area_until(k, t_s), r)
            }
        }
    }

    /// Returns the first break of the command after the time `t_s`; infinity after the last one.
    fn next_break_s(&mut self, t_s: f64) -> f64 {
        // A break that rounding has moved to this time is before it.
        let after_s = t_s + 1e-12 * t_s.abs().max(1.0);
        match self.find(after_s) {
            None => self.pieces[0].start_s,
            Some(k) if k + 1 < self.pieces.len() => self.pieces[k + 1].start_s,
            Some(_) => f64::INFINITY,
        }
    }
}

/// Returns the integral of the cubic `c` from 0 to `u`.
fn integral(c: &[f64; 4], u: f64) -> f64 {
    u * (c[0] + u * (c[1] / 2.0 + u * (c[2] / 3.0 + u * c[3] / 4.0)))
}

/// Returns the motion of a planner that slows down at the corners of the command `pieces`. It lets changes of the
/// velocity of `step_mm_per_s` pass, and changes its speed by `acceleration_mm_per_s2`. `origin` has an index for each
/// of the pieces, which its parts get.
fn slowed_at_corners(
    pieces: &[MotionPiece],
    origin: &[usize],
    step_mm_per_s: f64,
    acceleration_mm_per_s2: f64,
) -> Followed {
    // g = a / v of every line: f^2 rises by 2 g ds
    let rise: Vec<f64> = pieces.iter().map(|p| acceleration_mm_per_s2 / mean_speed(p)).collect();
    let mut factor = factors_of_corners(pieces, step_mm_per_s);
    for (k, p) in pieces.iter().enumerate() {
        let reached = (factor[k] * factor[k] + 2.0 * rise[k] * p.duration_s).sqrt();
        factor[k + 1] = factor[k + 1].min(reached);
    }
    for (k, p) in pieces.iter().enumerate().rev() {
        let reached = (factor[k + 1] * factor[k + 1] + 2.0 * rise[k] * p.duration_s).sqrt();
        factor[k] = factor[k].min(reached);
    }
    let (mut motion, mut from) = (Vec::new(), Vec::new());
    let mut start_s = pieces.first().map_or(0.0, |p| p.start_s);
    for (k, p) in pieces.iter().enumerate() {
        for [s0, s1, f0, f1] in law(p.duration_s, factor[k], factor[k + 1], rise[k]) {
            let is_as_planned = f0 == 1.0 && f1 == 1.0;
            let duration_s = if is_as_planned { s1 - s0 } else { 2.0 * (s1 - s0) / (f0 + f1) };
            let coefficient_mm = p.coefficient_mm.map(|c| {
                if is_as_planned {
                    return shifted(&c, s0);
                }
                let v = derivative(&c);
                let [q0, q1] =
                    [(s0, f0), (s1, f1)].map(|(s, f)| [evaluate(&c, s), f * evaluate(&v, s)]);
                hermite(q0, q1, duration_s)
            });
            motion.push(MotionPiece { start_s, duration_s, coefficient_mm, ..*p });
            from.push(origin[k]);
            start_s += duration_s;
        }
    }
    (motion, from)
}

/// Returns the largest factor of the speed at the start of every piece and at the end of the last one:
/// `min(1, d / |v+ - v-|)` with d of `step_mm_per_s`.
fn factors_of_corners(pieces: &[MotionPiece], step_mm_per_s: f64) -> Vec<f64> {
    let mut before = [0.0; 2];
    let mut factors = Vec::with_capacity(pieces.len() + 1);
    for p in pieces {
        factors.push(factor_of_corner(before, velocity(p, 0.0), step_mm_per_s));
        before = velocity(p, p.duration_s);
    }
    factors.push(factor_of_corner(before, [0.0; 2], step_mm_per_s));
    factors
}

fn factor_of_corner(before: [f64; 2], after: [f64; 2], step_mm_per_s: f64) -> f64 {
    let jump = (after[0] - before[0]).hypot(after[1] - before[1]);
    let speed = before[0].hypot(before[1]) + after[0].hypot(after[1]);
    if jump <= step_mm_per_s.max(ROUNDING * speed) { 1.0 } else { step_mm_per_s / jump }
}

/// Returns the largest jump of the velocity in the command `pieces`, its start and end at rest included, mm/s.
pub fn largest_corner_mm_per_s(pieces: &[MotionPiece]) -> f64 {
    // min(1, d / jump) with a small d is d / jump.
    let least = factors_of_corners(pieces, f64::MIN_POSITIVE.sqrt());
    let least = least.into_iter().fold(1.0, f64::min);
    if least < 1.0 { f64::MIN_POSITIVE.sqrt() / least } else { 0.0 }
}

fn velocity(p: &MotionPiece, u: f64) -> [f64; 2] {
    p.coefficient_mm.map(|c| evaluate(&derivative(&c), u))
}

/// Returns the mean speed of a piece along its chord, mm/s.
fn mean_speed(p: &MotionPiece) -> f64 {
    let [x, y] = p.coefficient_mm.map(|c| evaluate(&c, p.duration_s) - c[0]);
    x.hypot(y) / p.duration_s
}

/// Returns the intervals [s0, s1, f0, f1] of a line of `duration_s` in the time s of the command, with the factor of
/// the speed at both ends. It is `first` at the start and `last` at the end, and its square changes by `2 rise` per
/// second.
fn law(duration_s: f64, first: f64, last: f64, rise: f64) -> Vec<[f64; 4]> {
    let (up, down) = (first * first, last * last);
    let full_s = (1.0 - up) / (2.0 * rise);
    let brake_s = duration_s - (1.0 - down) / (2.0 * rise);
    // Without full speed the two laws meet: up + 2 g s = down + 2 g (D - s)
    let meet_s = (0.5 * duration_s + (down - up) / (4.0 * rise)).clamp(0.0, duration_s);
    let places = if full_s < brake_s { [full_s, brake_s] } else { [meet_s; 2] };
    let factor = |s: f64| {
        let square = (up + 2.0 * rise * s).min(down + 2.0 * rise * (duration_s - s));
        square.min(1.0).sqrt()
    };
    let [a, b] = places;
    let mut intervals = Vec::new();
    for [s0, s1] in [[0.0, a], [a, b], [b, duration_s]] {
        if s1 - s0 <= f64::EPSILON * duration_s {
            continue;
        }
        let is_full = full_s < brake_s && s0 == a && s1 == b;
        let parts = if is_full { 1 } else { PARTS };
        for part in 0..parts {
            let [u0, u1] = [part, part + 1].map(|i| s0 + (s1 - s0) * i as f64 / parts as f64);
            let [f0, f1] = if is_full { [1.0; 2] } else { [factor(u0), factor(u1)] };
            intervals.push([u0, u1, f0, f1]);
        }
    }
    intervals
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(start_s: f64, duration_s: f64, coefficient_mm: [[f64; 4]; 2]) -> MotionPiece {
        MotionPiece {
            start_s,
            duration_s,
            coefficient_mm,
            tool_on: true,
            rate_factor: 1.0,
            stay: 0,
        }
    }

    fn position(motion: &[MotionPiece], t_s: f64) -> [f64; 2] {
        let k = motion.partition_point(|p| p.start_s <= t_s).max(1) - 1;
        motion[k].coefficient_mm.map(|c| evaluate(&c, t_s - motion[k].start_s))
    }

    /// A cubic, a brake with a jump of the acceleration, and a rest, whose breaks are no multiples of the window.
    #[test]
    fn the_moving_average_is_that_of_many_samples() {
        let c = [[0.0, 3.0, 0.5, -0.2], [1.0, 0.0, 1.0, 0.1]];
        let brake = c.map(|c| {
            let c = shifted(&c, 1.0);
            [c[0], c[1], -0.5 * c[1] / 0.7, 0.0]
        });
        let rest = brake.map(|c| [evaluate(&c, 0.7), 0.0, 0.0, 0.0]);
        let command = [piece(0.0, 1.0, c), piece(1.0, 0.7, brake), piece(1.7, 0.31, rest)];
        let window_s = 0.02;
        let (motion, origin) = Planner::Smoothing { window_s }.follow(&command, &[0, 1, 2]);
        assert_eq!(origin.len(), motion.len());
        let end_s: f64 = motion.iter().map(|p| p.duration_s).sum();
        assert!((end_s - 2.01).abs() < 1e-12, "{end_s}");
        let n = 2000;
        for t in [0.003, 0.015, 0.4, 0.999, 1.007, 1.0199, 1.3, 1.7, 1.705, 1.9] {
            // The midpoint rule errs by v h^2 / (8 w) where the command starts: 2e-9 mm.
            let mut mean = [0.0; 2];
            for k in 0..n {
                let s = t - window_s * (f64::from(k) + 0.5) / f64::from(n);
                let r = position(&command, s.max(0.0));
                mean.iter_mut().zip(r).for_each(|(m, r)| *m += r / f64::from(n));
            }
            let q = position(&motion, t);
            for a in 0..2 {
                // The mean is quartic where the jerk changes by J in the window: a Hermite cubic errs by w^3 J / 384, here
                // 2.5e-8 mm.
                assert!((q[a] - mean[a]).abs() < 3e-8, "{t}: {} for {}", q[a], mean[a]);
            }
        }
    }

    /// The ramps from d to v and back on a line cost (v - d)^2 / (a v).
    #[test]
    fn a_corner_costs_the_time_of_its_ramps() {
        let (v, d, a) = (20.0, 4.0, 150.0);
        let command = [piece(0.0, 1.0, [[0.0, v, 0.0, 0.0], [0.0; 4]])];
        let corners = Planner::Corners { step_mm_per_s: d, acceleration_mm_per_s2: a };
        let (motion, _) = corners.follow(&command, &[0]);
        let total_s: f64 = motion.iter().map(|p| p.duration_s).sum();
        let expected_s = 1.0 + (v - d).powi(2) / (a * v);
        assert!((total_s - expected_s).abs() < 1e-12, "{total_s} for {expected_s}");
        for p in &motion {
            for u in [0.0, p.duration_s] {
                let [vx, _] = velocity(p, u);
                assert!((d - 1e-9..=v + 1e-9).contains(&vx), "{vx}");
            }
            assert!(2.0 * p.coefficient_mm[0][2].abs() <= a * (1.0 + 1e-9));
            assert!(p.coefficient_mm[0][3].abs() < 1e-6 * a, "the ramps are parabolas");
        }
        let last = motion.last().unwrap();
        assert!((evaluate(&last.coefficient_mm[0], last.duration_s) - v).abs() < 1e-12);
    }

    /// Too short for its full speed: both ramps meet in the middle, at d^2 + a L.
    #[test]
    fn a_short_line_does_not_reach_its_speed() {
        let (v, d, a, length) = (20.0, 4.0, 150.0, 0.5);
        let command = [piece(0.0, length / v, [[0.0, v, 0.0, 0.0], [0.0; 4]])];
        let corners = Planner::Corners { step_mm_per_s: d, acceleration_mm_per_s2: a };
        let (motion, _) = corners.follow(&command, &[0]);
        let total_s: f64 = motion.iter().map(|p| p.duration_s).sum();
        let peak = (d * d + a * length).sqrt();
        assert!((total_s - 2.0 * (peak - d) / a).abs() < 1e-12, "{total_s}");
    }

    #[test]
    fn a_motion_without_corners_stays_as_it_is() {
        // From rest to rest in 1 s
        let command = [piece(0.0, 1.0, [[0.0, 0.0, 3.0, -2.0], [0.0; 4]])];
        assert_eq!(largest_corner_mm_per_s(&command), 0.0);
        let corners = Planner::Corners { step_mm_per_s: 0.1, acceleration_mm_per_s2: 1.0 };
        let (motion, _) = corners.follow(&command, &[0]);
        assert_eq!((motion.len(), motion[0].coefficient_mm), (1, command[0].coefficient_mm));
        let line = [piece(0.0, 1.0, [[0.0, 3.0, 0.0, 0.0], [0.0, 4.0, 0.0, 0.0]])];
        assert!((largest_corner_mm_per_s(&line) - 5.0).abs() < 1e-12);
    }
}
