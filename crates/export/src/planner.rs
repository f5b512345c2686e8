//! Model of the trajectory planner of LinuxCNC 2.9: the time that it takes for the lines of a program, and the feeds with
//! which it takes the times of the plan.
//!
//! The planner runs pieces: lines, and arcs that blend two lines. With the feed F of a line, its acceleration a along the
//! line, and the turn b between two lines of L1 and L2:
//!
//! ```text
//! at an end of a piece    v <= min(F of both pieces), and as much as the later pieces can slow down
//! tangent                 |u2 - u1| (v / dt + a) < 0.1 A on every axis     u: direction, A: its acceleration, dt: 1 ms
//! arc                     R <= min(L1, L2) / 2 / tan(b/2),  v <= sqrt(0.866 A_min R),  a = A_min / 2
//! a piece under 10 ms     t = 2 L / (v0 + v1)                              one ramp from end to end
//! another piece           t of the ramp with a to F, of F, and of the ramp with a to v1
//! ```
//!
//! The first part of a servo period in a piece is run with the full acceleration in both cases, on average half a
//! period. Source: LinuxCNC, `src/emc/tp` (`tp.c`, `tc.c`, `blendmath.c`), and the samples of `just test-planners`: of
//! the time that the planner adds to the lines of a plan the model finds 97 % and more.
//!
//! Left out: the depth of the look-ahead (50 pieces), feed override, and rotary axes.

use std::{
    array::from_fn,
    f64::consts::{FRAC_PI_2, PI},
};

use planish_types::MachineAxis;

/// Servo period of LinuxCNC, s, that nearly all configurations have.
const SERVO_PERIOD_S: f64 = 0.001;

/// Part of an acceleration limit that a tangent corner may use in a servo period; default of ARC_BLEND_KINK_RATIO.
const KINK: f64 = 0.1;

/// Duration below which a piece has one ramp, s; the default of ARC_BLEND_RAMP_FREQ is 100 Hz.
const RAMP_S: f64 = 0.01;

/// Servo periods below which the rest of a line before an arc becomes a part of it; default of ARC_BLEND_GAP_CYCLES.
const GAP_PERIODS: f64 = 4.0;

/// Parts of the smallest acceleration limit across and along an arc.
const ACROSS_ARC: f64 = 0.866;
const ALONG_ARC: f64 = 0.5;

/// Angle to the reversal from which a corner is a stop, 2 degrees in rad.
const SHARP: f64 = PI / 90.0;

/// Half of the length of path over which times are made up for, mm. Larger: more of what a bend costs is made up for
/// before and after it, and a small tool sees more of it. Smaller: less. Chosen: a quarter of a tool of 4 mm.
pub(crate) const NEARBY_MM: f64 = 1.0;

/// Largest factor between the feed of a line and its mean speed. Larger: feeds that no piece reaches. Smaller: ramps
/// that are not made up for.
const MOST_CHANGE: f64 = 2.0;

/// Number of rounds that correct each line by itself, and of those that make up for the rest near it. Larger: feeds that
/// alternate from line to line, and more time. Smaller: times that are not reached. Measured: the error falls no further.
const ROUNDS_OF_LINES: usize = 4;
const ROUNDS_NEARBY: usize = 6;

/// Part of the error of a line that a round corrects. Larger: feeds that alternate from line to line.
const CORRECTED: f64 = 0.6;

/// Consecutive lines of a program, from rest to rest, for axes that are all linear; n is their number.
pub(crate) struct Lines<const N: usize> {
    /// Lengths, mm, and unit vectors (n).
    length: Vec<f64>,
    direction: Vec<[f64; N]>,
    /// Largest acceleration (mm/s^2) and velocity (mm/s) along every line (n).
    acceleration: Vec<f64>,
    velocity: Vec<f64>,
    /// Turn at the end of every line but the last, rad, and change of the unit vector over the acceleration limits of
    /// the axes, the largest, s^2/mm (n-1).
    turn: Vec<f64>,
    kink: Vec<f64>,
    /// Smallest acceleration limit of the axes, mm/s^2.
    least_acceleration: f64,
    /// Tolerance P of G64, mm; 0 for an exact path.
    tolerance_mm: f64,
}

/// A piece of the planner's motion: a line, an arc, or an arc with the rest of the line before it.
struct Piece {
    length: f64,
    /// Largest speed within it and at its end, mm/s.
    speed: f64,
    exit: f64,
    acceleration: f64,
    /// Index of its line, and the part of its time that is of the line after that.
    line: usize,
    after: f64,
}

/// Treatment of a corner by the planner.
enum Corner {
    Stop,
    /// Largest speed, and part of the acceleration along both lines that is left out.
    Tangent(f64, f64),
    /// Length of the arc and of each line that it replaces, mm; largest speed.
    Arc {
        length: f64,
        cut: f64,
        speed: f64,
    },
}

impl<const N: usize> Lines<N> {
    /// Makes the lines between the positions `nodes` (n+1), all of them apart.
    pub fn new(nodes: &[[f64; N]], axes: &[MachineAxis; N], tolerance_mm: f64) -> Self {
        let limits = axes.each_ref().map(|axis| axis.max_acceleration);
        let along = |u: &[f64; N], limit: [f64; N]| -> f64 {
            u.iter().zip(limit).map(|(u, l)| l / u.abs()).fold(f64::INFINITY, f64::min)
        };
        let mut lines = Self {
            length: vec![],
            direction: vec![],
            acceleration: vec![],
            velocity: vec![],
            turn: vec![],
            kink: vec![],
            least_acceleration: limits.into_iter().fold(f64::INFINITY, f64::min),
            tolerance_mm,
        };
        for ends in nodes.windows(2) {
            let way: [f64; N] = from_fn(|a| ends[1][a] - ends[0][a]);
            let length = norm(way);
            let u = way.map(|d| d / length);
            lines.length.push(length);
            lines.acceleration.push(along(&u, limits));
            lines.velocity.push(along(&u, axes.each_ref().map(|axis| axis.max_velocity)));
            lines.direction.push(u);
        }
        for u in lines.direction.windows(2) {
            let change: [f64; N] = from_fn(|a| u[1][a] - u[0][a]);
            lines.turn.push(2.0 * (0.5 * norm(change)).min(1.0).asin());
            let part = change.iter().zip(limits).map(|(d, limit)| d.abs() / limit);
            lines.kink.push(part.fold(0.0, f64::max));
        }
        lines
    }

    /// Returns the time that the planner takes for every line (n) with the feeds `feed` (n, mm/s), s. An arc counts half
    /// for each of its lines.
    pub fn times(&self, feed: &[f64]) -> Vec<f64> {
        let pieces = self.pieces(feed);
        // The largest speed at the start of every piece: v0^2 = v1^2 + 2 a L
        let mut start = vec![0.0; pieces.len() + 1];
        for (k, piece) in pieces.iter().enumerate().rev() {
            let before = if k > 0 { pieces[k - 1].speed.min(pieces[k - 1].exit) } else { 0.0 };
            let reached = reached(start[k + 1], piece.acceleration, piece.length);
            start[k] = reached.min(piece.speed).min(before);
        }
        let mut times = vec![0.0; feed.len()];
        let mut v = 0.0;
        for (piece, end) in pieces.iter().zip(&start[1..]) {
            let (time, reached) = piece.run(v, *end);
            times[piece.line] += time * (1.0 - piece.after);
            if piece.after > 0.0 {
                times[piece.line + 1] += time * piece.after;
            }
            v = reached;
        }
        times
    }

    /// Returns the mean speeds (n), mm/s, of lines that take the times `time_s` (n).
    pub fn mean_speeds(&self, time_s: &[f64]) -> Vec<f64> {
        self.length.iter().zip(time_s).map(|(l, t)| l / t).collect()
    }

    /// Returns the feeds (n), mm/s, with which the planner takes the times `time_s` (n) as nearly as it can.
    ///
    /// ```text
    /// F <- F (t / T)^0.6             for each line: t of the planner, T wanted
    /// F <- F exp(mean mean (t/T - 1))     means over the lines within 1 mm of path, weighted by T: positive definite
    /// ```
    pub fn feeds(&self, time_s: &[f64]) -> Vec<f64> {
        let own = self.mean_speeds(time_s);
        let nearby = self.nearby();
        let mut feed = own.clone();
        let mut best = (f64::INFINITY, feed.clone());
        for round in 0..ROUNDS_OF_LINES + ROUNDS_NEARBY {
            let times = self.times(&feed);
            let late: Vec<f64> =
                times.iter().zip(time_s).map(|(t, wanted)| t / wanted - 1.0).collect();
            let even = means(&means(&late, time_s, &nearby), time_s, &nearby);
            let error: f64 = even.iter().zip(time_s).map(|(e, t)| e * e * t).sum();
            if error < best.0 {
                best = (error, feed.clone());
            }
            for (k, feed) in feed.iter_mut().enumerate() {
                let of_line = round < ROUNDS_OF_LINES;
                let factor = if of_line { (1.0 + late[k]).powf(CORRECTED) } else { even[k].exp() };
                let most = (own[k] * MOST_CHANGE).min(self.velocity[k].max(own[k]));
                *feed = (*feed * factor).clamp(own[k] / MOST_CHANGE, most);
            }
        }
        best.1
    }

    /// Returns for every line (n) the range of the lines whose middles are within [`NEARBY_MM`] of path of its own.
    pub fn nearby(&self) -> Vec<[usize; 2]> {
        let mut at = 0.0;
        let middles = self.length.iter().map(|l| {
            at += l;
            at - 0.5 * l
        });
        let middles: Vec<f64> = middles.collect();
        let range = middles.iter().map(|s| {
            let [from, to] = [s - NEARBY_MM, s + NEARBY_MM];
            [middles.partition_point(|m| *m < from), middles.partition_point(|m| *m <= to)]
        });
        range.collect()
    }

    fn pieces(&self, feed: &[f64]) -> Vec<Piece> {
        let feed: Vec<f64> = feed.iter().zip(&self.velocity).map(|(f, v)| f.min(*v)).collect();
        let n = feed.len();
        let mut left_out = vec![0.0_f64; n];
        let mut pieces = Vec::with_capacity(2 * n);
        // Pieces that are lines, whose acceleration is known once both ends are.
        let mut cut_before = 0.0;
        for k in 0..n {
            let rest = self.length[k] - cut_before;
            cut_before = 0.0;
            let corner =
                if k + 1 < n { self.corner(k, rest, [feed[k], feed[k + 1]]) } else { Corner::Stop };
            let line = Piece {
                length: rest,
                speed: feed[k],
                exit: 0.0,
                acceleration: 0.0,
                line: k,
                after: 0.0,
            };
            match corner {
                Corner::Stop => pieces.push(line),
                Corner::Tangent(exit, part) => {
                    for k in [k, k + 1] {
                        left_out[k] = left_out[k].max(part);
                    }
                    pieces.push(Piece { exit, ..line });
                }
                Corner::Arc { length, cut, speed } => {
                    let acceleration = ALONG_ARC * self.least_acceleration;
                    let mut arc =
                        Piece { length, speed, exit: speed, acceleration, line: k, after: 0.5 };
                    cut_before = cut;
                    let rest = rest - cut;
                    if rest < GAP_PERIODS * SERVO_PERIOD_S * speed {
                        arc.length += rest;
                        arc.after = 0.5 * length / arc.length;
                    } else {
                        pieces.push(Piece { length: rest, exit: speed, ..line });
                    }
                    pieces.push(arc);
                }
            }
        }
        for piece in pieces.iter_mut().filter(|piece| piece.acceleration == 0.0) {
            piece.acceleration = self.acceleration[piece.line] * (1.0 - left_out[piece.line]);
        }
        pieces
    }

    /// Returns the corner at the end of line `k`, of which `rest` mm are left, between lines of these feeds.
    fn corner(&self, k: usize, rest: f64, feed: [f64; 2]) -> Corner {
        let turn = self.turn[k];
        if turn > PI - SHARP {
            return Corner::Stop;
        }
        let slower = feed[0].min(feed[1]);
        let used = self.kink[k] * (slower / SERVO_PERIOD_S + self.acceleration[k + 1]);
        if used < KINK {
            return Corner::Tangent(slower, used);
        }
        if self.tolerance_mm == 0.0 {
            return Corner::Stop;
        }
        // d <= P cos h / (1 - sin h),  R = d tan h,  h = (pi - b) / 2
        let half = FRAC_PI_2 - 0.5 * turn;
        let [before, after] = [self.length[k], self.length[k + 1]];
        let tolerance = self.tolerance_mm.min(0.25 * before.min(after));
        let by_tolerance = half.cos() * tolerance / (1.0 - half.sin());
        let cut = rest.min(0.5 * before.min(after)).min(by_tolerance);
        let largest = cut * half.tan();
        let across = ACROSS_ARC * self.least_acceleration;
        let speed = (across * largest).sqrt().min(feed[0].max(feed[1]));
        // With the time of a parabola: R >= v t / b
        let parabolic = 0.5 * self.least_acceleration;
        let time = speed.min((2.0 * parabolic * cut).sqrt()) / parabolic;
        let radius = (speed * time / turn).min(largest).max(speed * speed / across);
        let as_kink = slower * KINK / used;
        if as_kink > speed {
            return Corner::Tangent(as_kink, KINK);
        }
        Corner::Arc { length: radius * turn, cut: radius / half.tan(), speed }
    }
}

impl Piece {
    /// Returns the time of the piece, s, and the speed at its end, from the speed `v` at its start. `end` is the
    /// largest speed that the pieces after it allow.
    fn run(&self, v: f64, end: f64) -> (f64, f64) {
        let a = self.acceleration;
        let (mut v, mut length, mut time) = (v, self.length, 0.0);
        // The part of a servo period, from a piece that moves.
        let first = 0.5 * SERVO_PERIOD_S;
        let faster = v + (a * first).min((self.speed - v).max(0.0));
        let way = 0.5 * (v + faster) * first;
        if v > 0.0 && way < length && faster <= reached(end, a, length - way) {
            (v, length, time) = (faster, length - way, first);
        }
        let last = end.min(reached(v, a, length));
        let has_ramp = 2.0 * length < RAMP_S * (v + self.exit.min(self.speed));
        if has_ramp && end > 0.0 {
            return (time + 2.0 * length / (v + last), last);
        }
        // The top of both ramps if they meet: w^2 = (v0^2 + v1^2) / 2 + a L
        let meet = (0.5 * (v * v + last * last) + a * length).sqrt();
        let top = self.speed.min(meet).max(v).max(last);
        let ramps = (2.0 * top * top - v * v - last * last) / (2.0 * a);
        time += (2.0 * top - v - last) / a + (length - ramps).max(0.0) / top;
        (time, last)
    }
}

/// Returns the speed after `length` mm with the acceleration `a` from the speed `v`.
fn reached(v: f64, a: f64, length: f64) -> f64 {
    (v * v + 2.0 * a * length).sqrt()
}

fn norm<const N: usize>(v: [f64; N]) -> f64 {
    v.into_iter().fold(0.0, f64::hypot)
}

/// Returns the means of the values `v` (n) over the ranges `nearby` (n), with the weights `weight` (n).
fn means(v: &[f64], weight: &[f64], nearby: &[[usize; 2]]) -> Vec<f64> {
    let mut sums = vec![[0.0; 2]];
    for (v, w) in v.iter().zip(weight) {
        let [sum, weights] = sums[sums.len() - 1];
        sums.push([sum + v * w, weights + w]);
    }
    let mean = nearby.iter().map(|[from, to]| {
        let [sum, weights] = from_fn(|i| sums[*to][i] - sums[*from][i]);
        sum / weights
    });
    mean.collect()
}

#[cfg(test)]
mod tests {
    use planish_types::{Machine, MachineFile, MachineFileAxis};

    use super::*;

    fn lines(nodes: &[[f64; 2]], limits: [f64; 2]) -> Lines<2> {
        let axis = |(name, max_acceleration_mm_per_s2): (&str, f64)| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 250.0,
            max_acceleration_mm_per_s2,
            ..MachineFileAxis::default()
        };
        let axes = ["x", "y"].into_iter().zip(limits).map(axis).collect();
        let machine = Machine::new(MachineFile { axes, ..MachineFile::default() }).unwrap();
        let axes: &[MachineAxis; 2] = machine.axes().try_into().unwrap();
        Lines::new(nodes, axes, 0.005)
    }

    #[test]
    fn a_line_from_rest_to_rest_has_two_ramps() {
        // t = L / F + F / a: 10 / 20 + 20 / 1000
        let along_y = lines(&[[0.0, 0.0], [0.0, 10.0]], [2000.0, 1000.0]);
        assert!((along_y.times(&[20.0])[0] - 0.52).abs() < 1e-12);
        // Too short for F: t = 2 sqrt(L / a)
        let short = lines(&[[0.0, 0.0], [0.1, 0.0]], [1000.0, 1000.0]);
        assert!((short.times(&[200.0])[0] - 0.02).abs() < 1e-12);
    }

    #[test]
    fn a_reversal_is_a_stop_and_a_bend_has_the_smallest_limit() {
        let back = lines(&[[0.0, 0.0], [10.0, 0.0], [0.0, 0.0]], [1000.0, 1000.0]);
        assert!((back.times(&[20.0; 2]).iter().sum::<f64>() - 1.04).abs() < 1e-12);
        // Around a circle of 1 mm radius: v = sqrt(0.866 A R), from rest to rest with A / 2.
        let at = |k: usize| [(0.02 * k as f64).cos(), (0.02 * k as f64).sin()];
        let nodes: Vec<[f64; 2]> = (0..=1000).map(at).collect();
        let times = lines(&nodes, [2000.0, 1000.0]).times(&[100.0; 1000]);
        let v = (0.866_f64 * 1000.0).sqrt();
        // 800 lines of 0.02 mm in the middle: the polygon is shorter than the circle by 2e-5 of it, and the arcs are, too.
        let middle: f64 = times[100..900].iter().sum();
        assert!((middle * v / 16.0 - 1.0).abs() < 1e-3, "{middle}");
    }

    /// Tests lines of 3 ms of a motion with half of the acceleration: with the mean speeds the planner is late by half a
    /// line on every line, with its feeds it is not.
    #[test]
    fn feeds_make_up_for_ramps() {
        let t = |k: usize| 0.05 + 0.003 * k as f64;
        let nodes: Vec<[f64; 2]> = (0..=60).map(|k| [500.0 * t(k) * t(k), 0.0]).collect();
        let accelerated = lines(&nodes, [2000.0, 2000.0]);
        let wanted = [0.003; 60];
        // From rest and to rest the first and the last 25 lines take longer.
        let late = |feed: &[f64]| {
            let times = accelerated.times(feed);
            times[20..35].iter().sum::<f64>() / (15.0 * 0.003) - 1.0
        };
        let nominal = late(&accelerated.mean_speeds(&wanted));
        let made_up = late(&accelerated.feeds(&wanted));
        // 1000 mm/s^2 over 1.5 ms is 1.4 % of 105 mm/s; the part of a servo period takes a sixth off.
        assert!((0.008..0.016).contains(&nominal), "{nominal}");
        assert!(made_up.abs() < 0.15 * nominal, "{made_up} for {nominal}");
    }
}
