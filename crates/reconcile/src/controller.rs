//! Identification of an unknown controller, from one log of a known test motion.
//!
//! ```text
//! q(t) = L_tau S_w K r((t - b) / (1 + e))                                                      (1)
//! ```
//!
//! r is the commanded motion, K the planner that slows down at corners, S the moving average of the planner and L the
//! axis of first order (`planish_simulate::planner`, `planish_simulate::servo`). The unknowns minimise the squares of
//! the log minus (1), over all samples and both axes. Gauss and Newton's steps with Levenberg's damping start from the
//! best pair (d, a) of a grid. The fit begins with the first part of the log and goes on with longer ones, because a
//! wrong d moves all that comes after a corner.
//!
//! The beginning b is free: the clock of a log has its own zero. A pure delay of the whole motion is a part of b. It
//! changes no removal, unless the tool is switched without it.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | b | `begins_s` | s |
//! | e | `clock` | 1 |
//! | tau | `lag_s` | s |
//! | w | `smoothing_s` | s |
//! | d | `corner_mm_per_s` | mm/s |
//! | a | `acceleration_mm_per_s2` | mm/s^2 |

use nalgebra::{DMatrix, DVector};
use planish_numerics::{parallel, polynomial::evaluate};
use planish_simulate::{
    error_budget::{Distribution, ErrorBudgetFile, ErrorFile, Kind},
    motion::{Motion, MotionPiece},
    planner::{Planner, largest_corner_mm_per_s},
    servo::Servo,
};
use planish_types::{Invalid, Trajectory, text::significant};
use serde::Serialize;

/// Number of unknowns, and the index of each.
const UNKNOWNS: usize = 6;
const BEGINS: usize = 0;
const CLOCK: usize = 1;
const LAG: usize = 2;
const SMOOTHING: usize = 3;
const CORNER: usize = 4;
const ACCELERATION: usize = 5;

/// Number of samples that a fit of a part of the log compares, and the fit of the whole log. Larger: more time.
/// Smaller: larger standard errors.
const SAMPLES_OF_PART: usize = 2_000;
const SAMPLES_OF_LOG: usize = 100_000;

/// Parts of the log that are fitted, one after the other.
const PARTS_OF_LOG: [f64; 5] = [1.0 / 16.0, 1.0 / 8.0, 1.0 / 4.0, 1.0 / 2.0, 1.0];

/// Lag and smoothing from which the fit starts, s. Real ones are between 1 and 100 ms.
const FIRST_LAG_S: f64 = 0.005;
const FIRST_SMOOTHING_S: f64 = 0.01;

/// Number of halvings of the largest corner, and of doublings of the acceleration, on the grid of first guesses.
const GRID_OF_CORNERS: i32 = 8;
const GRID_OF_ACCELERATIONS: i32 = 12;
/// Longest time in which a planner changes its speed fully, s: the smallest acceleration of the grid.
const SLOWEST_CHANGE_S: f64 = 4.0;

/// Part of the extent of the motion that the machine has left its start by when the motion counts as begun.
const BEGUN: f64 = 0.01;

/// Largest number of steps of a fit, and relative fall of the sum of squares below which it has ended.
const MOST_STEPS: usize = 60;
const SETTLED: f64 = 1e-10;

/// Ratio of a value to its standard error from which it is known. Smaller: noise becomes a property of the controller.
const KNOWN: f64 = 5.0;

/// Ratio of the RMS of the fit to the noise of the log above which the controller does more than (1).
const MOST_OVER_NOISE: f64 = 3.0;
/// RMS of the fit, mm, up to which the controller is what it is taken for, whatever the noise: 1 nm. Larger: other rules
/// stay unsaid in logs without noise. Smaller: the cubics of the model count as other rules.
const LEAST_LEFT_MM: f64 = 1e-6;

/// A value with its standard error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Value {
    /// The value, in the unit that its name ends with.
    pub value: f64,
    /// Standard error of the value, if what the fit leaves is white noise.
    pub standard_error: f64,
}

/// A controller as a log shows it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Controller {
    /// Beginning of the program, s after the first sample of the log, the pure delay of the motion included.
    pub begins_s: Value,
    /// Relative excess of the duration of the motion over that of the program, without the time of corners.
    pub clock: Option<Value>,
    /// Time constant of the axes, s.
    pub lag_s: Option<Value>,
    /// Time over which the planner averages, s.
    pub smoothing_s: Option<Value>,
    /// Change of the velocity at a corner that the planner lets pass, mm/s; `None` if no corner of the program is
    /// faster.
    pub corner_mm_per_s: Option<Value>,
    /// Acceleration of the planner along the path, mm/s^2; `None` without a corner.
    pub acceleration_mm_per_s2: Option<Value>,
    /// RMS of the log minus the fitted motion, per axis, mm.
    pub left_rms_mm: f64,
    /// Noise of the log from its fourth differences, per axis, mm.
    pub noise_mm: f64,
    /// Largest change of the velocity at a corner of the program, mm/s.
    pub largest_corner_mm_per_s: f64,
}

impl Controller {
    /// Returns the reason why the controller is not what the fit takes it for: the fit leaves more than the noise of
    /// the log. `None` if it is.
    pub fn drawback(&self) -> Option<String> {
        if self.left_rms_mm <= LEAST_LEFT_MM.max(MOST_OVER_NOISE * self.noise_mm) {
            return None;
        }
        Some(format!(
            "the fit leaves {} um RMS, and the noise of the log is {} um: the controller does more than to lag, to \
             smooth and to slow down at corners, or the log is of another motion",
            significant(1e3 * self.left_rms_mm, 3),
            significant(1e3 * self.noise_mm, 3)
        ))
    }

    /// Returns the error budget that holds the controller. An unknown that the log does not determine is left out.
    /// `None` if there is nothing in it.
    pub fn error_budget(&self) -> Option<ErrorBudgetFile> {
        let mut errors = Vec::new();
        if let Some(d) = self.corner_mm_per_s
            && let Some(a) = self.acceleration_mm_per_s2
        {
            let acceleration_mm_per_s2 = Some(a.value);
            errors.push(ErrorFile {
                acceleration_mm_per_s2,
                ..fixed(Kind::CornerSpeed, d, 1.0, "mm/s")
            });
        }
        errors.extend(self.smoothing_s.map(|w| fixed(Kind::Smoothing, w, 1e3, "ms")));
        errors.extend(self.lag_s.map(|tau| fixed(Kind::ServoFirstOrder, tau, 1e3, "ms")));
        // A run that takes 1 + e times as long removes 1 + e times as much.
        errors.extend(self.clock.map(|e| fixed(Kind::RateScale, e, 1.0, "1")));
        let name = "a controller, identified from a log".into();
        if errors.is_empty() { None } else { Some(ErrorBudgetFile { name, errors }) }
    }
}

fn fixed(kind: Kind, value: Value, per_unit: f64, unit: &str) -> ErrorFile {
    let standard_error = significant(per_unit * value.standard_error, 2);
    ErrorFile {
        kind,
        size: per_unit * value.value,
        unit: unit.into(),
        distribution: Distribution::Fixed,
        note: format!("identified from a log, standard error {standard_error} {unit}"),
        correlation_s: None,
        time_constant_s: None,
        damping_ratio: None,
        acceleration_mm_per_s2: None,
        degree: None,
    }
}

/// Identifies the controller that made the recorded motion `log` of the commanded motion `planned`. Every break of the
/// log is a sample.
///
/// # Errors
/// Refuses a log that does not begin at rest at the start of the commanded motion, and one that is too short.
pub fn identify(log: &Trajectory, planned: &Trajectory) -> Result<Controller, Invalid> {
    let fit = Fit::new(log, planned)?;
    let mut values = fit.first_guess();
    let mut result = None;
    for part in PARTS_OF_LOG {
        let samples = if part < 1.0 { SAMPLES_OF_PART } else { SAMPLES_OF_LOG };
        let solved = fit.solve(values, part, samples);
        values = solved.values;
        result = Some(solved);
    }
    let Solved { values, errors, rms_mm } = result.expect("the whole log is the last part");
    let known = |i: usize| {
        let value = Value { value: values[i], standard_error: errors[i]? };
        let is_known = value.value.abs() > KNOWN * value.standard_error;
        if is_known { Some(value) } else { None }
    };
    let corner = known(CORNER);
    Ok(Controller {
        begins_s: Value {
            value: values[BEGINS],
            standard_error: errors[BEGINS].unwrap_or(f64::INFINITY),
        },
        clock: known(CLOCK),
        lag_s: known(LAG),
        smoothing_s: known(SMOOTHING),
        acceleration_mm_per_s2: corner.and_then(|_| known(ACCELERATION)),
        corner_mm_per_s: corner,
        left_rms_mm: rms_mm,
        noise_mm: noise_mm(&fit.position_mm),
        largest_corner_mm_per_s: fit.largest_corner_mm_per_s,
    })
}

/// Returns the standard deviation of white noise in the positions [x, y] (n), mm, from the median magnitude of their
/// fourth differences: of samples at equal times, these have 70 times the variance of the noise.
fn noise_mm(position_mm: &[[f64; 2]]) -> f64 {
    let mut fourth: Vec<f64> = Vec::with_capacity(2 * position_mm.len());
    for p in position_mm.windows(5) {
        for a in 0..2 {
            fourth.push((p[0][a] - 4.0 * p[1][a] + 6.0 * p[2][a] - 4.0 * p[3][a] + p[4][a]).abs());
        }
    }
    let middle = fourth.len() / 2;
    // The median magnitude of a normal variable is 0.6745 standard deviations.
    let median = *fourth.select_nth_unstable_by(middle, f64::total_cmp).1;
    median / (0.6745 * 70.0_f64.sqrt())
}

/// Least number of samples of a log.
const LEAST_SAMPLES: usize = 50;

/// A log and the command of the motion in it.
struct Fit {
    time_s: Vec<f64>,
    position_mm: Vec<[f64; 2]>,
    /// Pieces of the command, and a rest after them.
    command: Vec<MotionPiece>,
    total_s: f64,
    largest_corner_mm_per_s: f64,
    largest_speed_mm_per_s: f64,
    /// Distance from the start beyond which the motion has begun, mm.
    begun_mm: f64,
    /// Time of the first sample beyond it, s.
    begun_s: f64,
}

/// Result of a least-squares fit.
struct Solved {
    values: [f64; UNKNOWNS],
    /// Standard errors; `None` for an unknown that the samples do not depend on.
    errors: [Option<f64>; UNKNOWNS],
    /// RMS of the rest, per axis, mm.
    rms_mm: f64,
}

impl Fit {
    fn new(log: &Trajectory, planned: &Trajectory) -> Result<Self, Invalid> {
        let mut time_s = log.break_time_s().to_vec();
        let first_s = time_s[0];
        time_s.iter_mut().for_each(|t| *t -= first_s);
        let mut position_mm: Vec<[f64; 2]> =
            log.coefficient_mm().iter().map(|c| [c[0][0], c[1][0]]).collect();
        let last = log.segment(log.len() - 1);
        position_mm.push(last.position_mm(last.duration_s));
        if time_s.len() < LEAST_SAMPLES {
            let problem = format!("has {} samples", time_s.len());
            let remedy = "record the whole test motion, at 200 Hz or more";
            return Err(Invalid::whole("trajectory", problem, remedy));
        }
        let motion = Motion::new(planned, f64::INFINITY)?;
        let largest_speed_mm_per_s = motion.largest_speed_mm_per_s();
        let mut command = motion.pieces;
        let total_s = motion.total_s;
        let end = command[command.len() - 1];
        let rest =
            [0, 1].map(|a| [evaluate(&end.coefficient_mm[a], end.duration_s), 0.0, 0.0, 0.0]);
        command.push(MotionPiece {
            start_s: end.start_s + end.duration_s,
            duration_s: time_s[time_s.len() - 1] + 1.0,
            coefficient_mm: rest,
            ..end
        });
        let start = command[0].coefficient_mm.map(|c| c[0]);
        let distance = |p: &[f64; 2]| (p[0] - start[0]).hypot(p[1] - start[1]);
        let extent_mm = command.iter().map(|p| distance(&p.coefficient_mm.map(|c| c[0])));
        let begun_mm = BEGUN * extent_mm.fold(0.0, f64::max);
        let begun = position_mm.iter().position(|p| distance(p) > begun_mm);
        let Some(begun) = begun.filter(|i| *i > 0) else {
            let problem = format!(
                "does not begin at rest within {} mm of the start of the plan at ({}, {}) mm, or does not leave it",
                significant(begun_mm, 3),
                significant(start[0], 6),
                significant(start[1], 6)
            );
            let remedy = "record the whole motion from rest, and give the plan in the coordinates of the log";
            return Err(Invalid::whole("trajectory", problem, remedy));
        };
        Ok(Self {
            begun_s: time_s[begun],
            begun_mm,
            largest_corner_mm_per_s: largest_corner_mm_per_s(&command),
            largest_speed_mm_per_s,
            total_s,
            command,
            time_s,
            position_mm,
        })
    }

    fn has_corners(&self) -> bool {
        // A PVT program starts and ends at rest, and rounding is no corner.
        self.largest_corner_mm_per_s > 1e-3 * self.largest_speed_mm_per_s
    }

    /// Returns the motion (1) of the command, before its beginning and its clock are applied.
    fn motion(&self, values: &[f64; UNKNOWNS]) -> Vec<MotionPiece> {
        let origin = vec![0; self.command.len()];
        let mut followed = (self.command.clone(), origin);
        if self.has_corners() {
            let corners = Planner::Corners {
                step_mm_per_s: values[CORNER],
                acceleration_mm_per_s2: values[ACCELERATION],
            };
            followed = corners.follow(&followed.0, &followed.1);
        }
        followed =
            Planner::Smoothing { window_s: values[SMOOTHING] }.follow(&followed.0, &followed.1);
        Servo::FirstOrder { lag_s: values[LAG] }.follow(&followed.0, &followed.1).0
    }

    /// Returns the positions (1) at every `stride`-th of the first `count` samples, x and y in turn, mm.
    fn predicted(&self, values: &[f64; UNKNOWNS], count: usize, stride: usize) -> Vec<f64> {
        let motion = self.motion(values);
        let mut k = 0;
        let mut positions = Vec::with_capacity(2 * count.div_ceil(stride));
        for t in self.time_s[..count].iter().step_by(stride) {
            let t = (t - values[BEGINS]) / (1.0 + values[CLOCK]);
            while k + 1 < motion.len() && motion[k + 1].start_s <= t {
                k += 1;
            }
            let u = (t - motion[k].start_s).clamp(0.0, motion[k].duration_s);
            positions.extend(motion[k].coefficient_mm.map(|c| evaluate(&c, u)));
        }
        positions
    }

    /// Returns the log minus (1) at the same samples, mm.
    fn rest(&self, values: &[f64; UNKNOWNS], count: usize, stride: usize) -> Vec<f64> {
        let measured = self.position_mm[..count].iter().step_by(stride).flatten();
        measured.zip(self.predicted(values, count, stride)).map(|(m, p)| m - p).collect()
    }

    /// Returns the values from which the fit starts: of a grid of corners and accelerations the pair with the least
    /// sum of squares over the first quarter of the log.
    fn first_guess(&self) -> [f64; UNKNOWNS] {
        let start = [0.0, 0.0, FIRST_LAG_S, FIRST_SMOOTHING_S, 1.0, 1.0];
        if !self.has_corners() {
            return self.with_beginning(start);
        }
        let mut guesses = Vec::new();
        // The first of them slows down nowhere.
        for i in -1..GRID_OF_CORNERS {
            for j in 0..GRID_OF_ACCELERATIONS {
                let mut guess = start;
                guess[CORNER] = 0.9 * self.largest_corner_mm_per_s / 2_f64.powi(i);
                guess[ACCELERATION] =
                    self.largest_speed_mm_per_s / SLOWEST_CHANGE_S * 2_f64.powi(j);
                guesses.push(guess);
            }
        }
        let count = self.time_s.len() / 4;
        let stride = count.div_ceil(SAMPLES_OF_PART).max(1);
        let tried = parallel::map(guesses.len(), &|i| {
            let guess = self.with_beginning(guesses[i]);
            let rest = self.rest(&guess, count, stride);
            (rest.iter().map(|e| e * e).sum::<f64>(), guess)
        });
        let best = tried.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
        best.expect("the grid has points").1
    }

    /// Returns the values with the beginning at which the motion has begun when the log has.
    fn with_beginning(&self, mut values: [f64; UNKNOWNS]) -> [f64; UNKNOWNS] {
        let motion = self.motion(&values);
        let start = self.command[0].coefficient_mm.map(|c| c[0]);
        // Of a few points per piece the first beyond the distance.
        for p in &motion {
            for part in 1..=16 {
                let u = p.duration_s * f64::from(part) / 16.0;
                let [x, y] = p.coefficient_mm.map(|c| evaluate(&c, u));
                if (x - start[0]).hypot(y - start[1]) > self.begun_mm {
                    values[BEGINS] = self.begun_s - p.start_s - u;
                    return values;
                }
            }
        }
        values
    }

    /// Returns the step of the derivative by an unknown.
    fn step(&self, values: &[f64; UNKNOWNS], i: usize) -> f64 {
        match i {
            BEGINS => 1e-5,
            CLOCK => 1e-4 / self.total_s,
            LAG | SMOOTHING => 1e-4,
            _ => 1e-4 * values[i],
        }
    }

    /// Minimises the squares over the first `part` of the log, of which at most `most_samples` are compared.
    fn solve(&self, mut values: [f64; UNKNOWNS], part: f64, most_samples: usize) -> Solved {
        // The part of a log counts from the beginning of the motion.
        let last_s = self.time_s[self.time_s.len() - 1];
        let until_s = self.begun_s + part * (last_s - self.begun_s);
        let count = self.time_s.partition_point(|t| *t <= until_s).max(LEAST_SAMPLES);
        let stride = count.div_ceil(most_samples).max(1);
        let mut rest = self.rest(&values, count, stride);
        let mut squares: f64 = rest.iter().map(|e| e * e).sum();
        let mut damping = 1e-3;
        let mut normal = self.normal(&values, &rest, count, stride);
        for _ in 0..MOST_STEPS {
            let tried = damped_step(&values, &normal, damping);
            let tried_rest = self.rest(&tried, count, stride);
            let tried_squares: f64 = tried_rest.iter().map(|e| e * e).sum();
            if tried_squares < squares {
                let fall = (squares - tried_squares) / squares;
                (values, rest, squares) = (tried, tried_rest, tried_squares);
                damping = (0.1 * damping).max(1e-12);
                normal = self.normal(&values, &rest, count, stride);
                if fall < SETTLED {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e8 {
                    break;
                }
            }
        }
        let variance = squares / (rest.len() as f64 - UNKNOWNS as f64).max(1.0);
        Solved { values, errors: normal.standard_errors(variance), rms_mm: variance.sqrt() }
    }

    /// Returns J'J and J'r at `values`, with the derivatives J of (1) and the rest r.
    fn normal(
        &self,
        values: &[f64; UNKNOWNS],
        rest: &[f64],
        count: usize,
        stride: usize,
    ) -> Normal {
        let columns: Vec<Vec<f64>> = parallel::map(UNKNOWNS, &|i| {
            let h = self.step(values, i);
            let [mut below, mut above] = [*values; 2];
            above[i] += h;
            // Neither a lag nor a window is negative.
            let is_at_zero = matches!(i, LAG | SMOOTHING) && values[i] < h;
            below[i] -= if is_at_zero { 0.0 } else { h };
            let width = above[i] - below[i];
            let [low, high] = [below, above].map(|v| self.predicted(&v, count, stride));
            high.iter().zip(&low).map(|(high, low)| (high - low) / width).collect()
        });
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let n = UNKNOWNS;
        Normal {
            matrix: DMatrix::from_fn(n, n, |i, j| product(&columns[i], &columns[j])),
            right: DVector::from_fn(n, |i, _| product(&columns[i], rest)),
        }
    }
}

/// The normal equations of a Gauss-Newton step.
struct Normal {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
}

impl Normal {
    /// Returns the indices of the unknowns on which the samples depend.
    fn active(&self) -> Vec<usize> {
        (0..UNKNOWNS).filter(|i| self.matrix[(*i, *i)] > 0.0).collect()
    }

    /// Returns the standard errors of the unknowns, for noise of this variance.
    fn standard_errors(&self, variance: f64) -> [Option<f64>; UNKNOWNS] {
        let active = self.active();
        let scale: Vec<f64> = active.iter().map(|i| self.matrix[(*i, *i)].sqrt()).collect();
        let scaled = DMatrix::from_fn(active.len(), active.len(), |a, b| {
            self.matrix[(active[a], active[b])] / (scale[a] * scale[b])
        });
        let mut errors = [None; UNKNOWNS];
        let Some(inverse) = scaled.cholesky().map(|factor| factor.inverse()) else { return errors };
        for (a, i) in active.iter().enumerate() {
            errors[*i] = Some((variance * inverse[(a, a)]).sqrt() / scale[a]);
        }
        errors
    }
}

/// Returns the values after a step with Levenberg's damping, relative to the diagonal. A lag and a window stay at least
/// 0; a corner and an acceleration change by a factor of at most two.
fn damped_step(values: &[f64; UNKNOWNS], normal: &Normal, damping: f64) -> [f64; UNKNOWNS] {
    let active = normal.active();
    let n = active.len();
    let scale: Vec<f64> = active.iter().map(|i| normal.matrix[(*i, *i)].sqrt()).collect();
    let matrix = DMatrix::from_fn(n, n, |a, b| {
        let more = if a == b { damping } else { 0.0 };
        normal.matrix[(active[a], active[b])] / (scale[a] * scale[b]) + more
    });
    let right = DVector::from_fn(n, |a, _| normal.right[active[a]] / scale[a]);
    let mut next = *values;
    let Some(factor) = matrix.cholesky() else { return next };
    let step = factor.solve(&right);
    for (a, i) in active.iter().enumerate() {
        let value = values[*i] + step[a] / scale[a];
        next[*i] = match *i {
            LAG | SMOOTHING => value.max(0.0),
            CORNER | ACCELERATION => value.clamp(0.5 * values[*i], 2.0 * values[*i]),
            _ => value,
        };
    }
    next
}
