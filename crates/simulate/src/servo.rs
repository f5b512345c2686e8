//! Models of axes that follow their command r(t) with a lag; q(t) is their position.
//!
//! ```text
//! lag             q(t) = r(t) - tau r'(t)
//! first order     tau q' = r - q
//! second order    q'' + 2 zeta w q' = w^2 (r - q),    w = 2 zeta / tau
//! ```
//!
//! All three lag by `tau v` at the constant velocity v. The first is the quasi-static limit of the others.
//! Of those the solution in a piece, where r is a cubic, is a cubic and an exponential that decays; the latter is
//! exact at chosen times, and a cubic between them. The axes rest where the motion begins.

use planish_numerics::polynomial::{derivative, evaluate};

use crate::motion::MotionPiece;

/// Model of the response of the axes to their command.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)] // the lag at constant velocity, s, of each; the equations are above
pub enum Servo {
    Lag { lag_s: f64 },
    FirstOrder { lag_s: f64 },
    SecondOrder { lag_s: f64, damping_ratio: f64 },
}

/// First step between the times at which the transient is exact, in units of its fastest time constant. A cubic between
/// two of them errs by 0.5^4 / 384 of it. The steps grow as the fourth root of the remaining transient falls, so that
/// the error stays the same. Larger: a larger error. Smaller: more pieces.
const STEP: f64 = 0.5;

/// Time over which the transient is followed, in units of its slowest time constant; then exp(-16) of it is left.
/// Larger: more pieces. Smaller: a step where the transient is dropped.
const FOLLOWED: f64 = 16.0;

/// Size of a transient below which it is not followed, mm; it is 0.1 nm. Larger: a larger error. Smaller: more pieces
/// without effect.
const LEAST_TRANSIENT_MM: f64 = 1e-7;

/// Position, mm, and velocity, mm/s, of an axis.
type State = [f64; 2];

impl Servo {
    /// Returns the motion of the axes under the command `pieces`. `origin` has one index per piece of the command;
    /// every new piece gets that of the piece of which it is a part.
    pub fn follow(
        self,
        pieces: &[MotionPiece],
        origin: &[usize],
    ) -> (Vec<MotionPiece>, Vec<usize>) {
        let lag_s = match self {
            Self::Lag { lag_s } | Self::FirstOrder { lag_s } | Self::SecondOrder { lag_s, .. } => {
                lag_s
            }
        };
        // No lag is no servo; a negative one, which only the first can have, is an early tool.
        if matches!(self, Self::Lag { .. }) || lag_s <= 0.0 {
            let late = pieces.iter().map(|p| MotionPiece {
                coefficient_mm: p.coefficient_mm.map(|c| lagging(&c, lag_s)),
                ..*p
            });
            return (late.collect(), origin.to_vec());
        }
        let mut motion = Vec::new();
        let mut from = Vec::new();
        let Some(first) = pieces.first() else { return (motion, from) };
        let mut state: [State; 2] = first.coefficient_mm.map(|c| [c[0], 0.0]);
        for (p, command) in pieces.iter().zip(origin) {
            let steady = p.coefficient_mm.map(|c| self.steady(&c));
            let transient: [State; 2] =
                std::array::from_fn(|a| [state[a][0] - steady[a][0], state[a][1] - steady[a][1]]);
            let (fastest_s, slowest_s) = self.times_s();
            let is_seen = transient.iter().any(|t| {
                t[0].abs() > LEAST_TRANSIENT_MM || t[1].abs() * slowest_s > LEAST_TRANSIENT_MM
            });
            let mut times = vec![0.0];
            if is_seen {
                let until = (FOLLOWED * slowest_s).min(p.duration_s);
                let mut u = STEP * fastest_s;
                while u < until {
                    times.push(u);
                    u += STEP * fastest_s * (u / (4.0 * slowest_s)).exp();
                }
                if until < p.duration_s {
                    times.push(until);
                }
            }
            times.push(p.duration_s);
            let response = |axis: usize, u: f64| -> State {
                let [h, dh] = self.decayed(transient[axis], u);
                let s = &steady[axis];
                [evaluate(s, u) + h, evaluate(&derivative(s), u) + dh]
            };
            for w in times.windows(2).filter(|w| w[1] > w[0]) {
                let h = w[1] - w[0];
                let coefficient_mm =
                    std::array::from_fn(|a| hermite(response(a, w[0]), response(a, w[1]), h));
                motion.push(MotionPiece {
                    start_s: p.start_s + w[0],
                    duration_s: h,
                    coefficient_mm,
                    ..*p
                });
                from.push(*command);
            }
            state = std::array::from_fn(|a| response(a, p.duration_s));
        }
        (motion, from)
    }

    /// Returns the coefficients of the steady solution for the cubic command r: with D = d/dt, q = r / (1 + A D + B
    /// D^2). A is the lag, and B is 1 / w^2 of the second order, else 0.
    fn steady(self, r: &[f64; 4]) -> [f64; 4] {
        let (a, b) = match self {
            Self::Lag { lag_s } | Self::FirstOrder { lag_s } => (lag_s, 0.0),
            Self::SecondOrder { lag_s, damping_ratio } => {
                (lag_s, (lag_s / (2.0 * damping_ratio)).powi(2))
            }
        };
        let d1 = derivative(r);
        let d2 = derivative(&d1);
        let d3 = derivative(&d2);
        let third = a * a * a - 2.0 * a * b;
        std::array::from_fn(|k| r[k] - a * d1[k] + (a * a - b) * d2[k] - third * d3[k])
    }

    /// Returns the fastest and the slowest time constant of the transient, s.
    fn times_s(self) -> (f64, f64) {
        match self {
            Self::Lag { lag_s } | Self::FirstOrder { lag_s } => (lag_s, lag_s),
            Self::SecondOrder { lag_s, damping_ratio: z } => {
                let period = lag_s / (2.0 * z);
                let spread = if z > 1.0 { z + (z * z - 1.0).sqrt() } else { 1.0 };
                (period / spread, period * if z > 1.0 { spread } else { 1.0 / z })
            }
        }
    }

    /// Returns position, mm, and velocity, mm/s, of the transient the time `u`, s, after it was `[h, dh]`.
    fn decayed(self, [h, dh]: State, u: f64) -> State {
        match self {
            Self::Lag { lag_s } | Self::FirstOrder { lag_s } => {
                let h = h * (-u / lag_s).exp();
                [h, -h / lag_s]
            }
            Self::SecondOrder { lag_s, damping_ratio: z } => {
                let w = 2.0 * z / lag_s;
                // h = exp(-z w u) (h0 C + (h0' + z w h0) S),  C' = -k S, S' = C,  k = w^2 (1 - z^2)
                let k = w * w * (1.0 - z * z);
                let (c, s) = if k * u * u > 1e-12 {
                    let f = k.sqrt();
                    ((f * u).cos(), (f * u).sin() / f)
                } else if k * u * u < -1e-12 {
                    let f = (-k).sqrt();
                    ((f * u).cosh(), (f * u).sinh() / f)
                } else {
                    (1.0, u)
                };
                let decay = (-z * w * u).exp();
                let b = dh + z * w * h;
                let now = h * c + b * s;
                [decay * now, decay * (b * c - k * h * s - z * w * now)]
            }
        }
    }
}

/// Returns the coefficients of r - tau r' for a lag tau of `lag_s`.
fn lagging(r: &[f64; 4], lag_s: f64) -> [f64; 4] {
    let v = derivative(r);
    std::array::from_fn(|k| r[k] - lag_s * v[k])
}

/// Returns the coefficients of the cubic that leads from the first state to the second in the time h, s.
pub(crate) fn hermite([p, v]: State, [q, w]: State, h: f64) -> [f64; 4] {
    let mean = (q - p) / h;
    [p, v, (3.0 * mean - 2.0 * v - w) / h, (v + w - 2.0 * mean) / (h * h)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_numerics::polynomial::shifted;

    /// Makes a command in three pieces: it runs, brakes and rests.
    fn command() -> Vec<MotionPiece> {
        let c = [[0.0, 3.0, 0.5, -0.2], [1.0, 0.0, 1.0, 0.1]];
        let d = [c[0], c[1]].map(|c| shifted(&c, 1.0));
        let brake = d.map(|c| [c[0], -0.5 * c[1], 0.3, 0.0]);
        let rest = brake.map(|c| [evaluate(&c, 0.7), 0.0, 0.0, 0.0]);
        let piece = |start_s, duration_s, coefficient_mm| MotionPiece {
            start_s,
            duration_s,
            coefficient_mm,
            tool_on: true,
            rate_factor: 1.0,
            stay: 0,
        };
        vec![piece(0.0, 1.0, c), piece(1.0, 0.7, brake), piece(1.7, 2.0, rest)]
    }

    /// Both servos against small steps of their equations (Runge and Kutta's).
    #[test]
    fn a_servo_solves_its_equation() {
        let pieces = command();
        for servo in [
            Servo::FirstOrder { lag_s: 0.05 },
            Servo::SecondOrder { lag_s: 0.05, damping_ratio: 0.3 },
            Servo::SecondOrder { lag_s: 0.05, damping_ratio: 1.0 },
            Servo::SecondOrder { lag_s: 0.05, damping_ratio: 2.0 },
        ] {
            let (motion, origin) = servo.follow(&pieces, &[0, 1, 2]);
            assert_eq!((motion.len(), origin[0]), (origin.len(), 0));
            let slope = |q: State, r: f64| -> State {
                match servo {
                    Servo::SecondOrder { lag_s, damping_ratio: z } => {
                        let w = 2.0 * z / lag_s;
                        [q[1], w * w * (r - q[0]) - 2.0 * z * w * q[1]]
                    }
                    _ => [(r - q[0]) / 0.05, 0.0],
                }
            };
            let mut q: State = [pieces[0].coefficient_mm[0][0], 0.0];
            let mut worst: f64 = 0.0;
            for p in &pieces {
                let n = 4000;
                let h = p.duration_s / f64::from(n);
                for k in 0..n {
                    let r = |f: f64| evaluate(&p.coefficient_mm[0], (f64::from(k) + f) * h);
                    let plus =
                        |q: State, d: State, f: f64| [q[0] + f * h * d[0], q[1] + f * h * d[1]];
                    let a = slope(q, r(0.0));
                    let b = slope(plus(q, a, 0.5), r(0.5));
                    let c = slope(plus(q, b, 0.5), r(0.5));
                    let d = slope(plus(q, c, 1.0), r(1.0));
                    q = std::array::from_fn(|i| {
                        q[i] + h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i])
                    });
                    let t = p.start_s + f64::from(k + 1) * h;
                    let of =
                        |m: &&MotionPiece| t >= m.start_s && t <= m.start_s + m.duration_s + 1e-12;
                    let m = motion.iter().find(of).unwrap();
                    worst = worst.max((evaluate(&m.coefficient_mm[0], t - m.start_s) - q[0]).abs());
                }
            }
            // The transient is some 0.2 mm; its cubic errs by 0.5^4 / 384 of it, and exp(-8) of it is given up.
            assert!(worst < 1.5e-4, "{servo:?}: {worst}");
        }
    }

    #[test]
    fn at_constant_velocity_every_servo_lags_by_its_lag() {
        let run = MotionPiece {
            start_s: 0.0,
            duration_s: 5.0,
            coefficient_mm: [[1.0, 4.0, 0.0, 0.0], [0.0; 4]],
            tool_on: true,
            rate_factor: 1.0,
            stay: 0,
        };
        for servo in [
            Servo::Lag { lag_s: 0.1 },
            Servo::FirstOrder { lag_s: 0.1 },
            Servo::SecondOrder { lag_s: 0.1, damping_ratio: 0.7 },
        ] {
            let (motion, _) = servo.follow(&[run], &[0]);
            let last = motion.last().unwrap();
            let end = evaluate(&last.coefficient_mm[0], last.duration_s);
            // exp(-50) of the transient is left.
            assert!((end - (21.0 - 0.4)).abs() < 1e-12, "{servo:?}: {end}");
        }
    }
}
