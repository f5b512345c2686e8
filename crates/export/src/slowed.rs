//! The plan on the clock of the program: the same path, a little slower where the plan uses a limit fully.
//!
//! ```text
//! dt = k(s) ds            s: time of the plan,  t: time of the program,  k >= 1
//! p(t) = P(s)
//! p'   = P' / k
//! p''  = P'' / k^2 - P' k' / k^3
//! ```
//!
//! Rounding to counts and ticks adds acceleration, so a motion that shall keep the limits after it must leave some of
//! them unused. On cells of the plan's time, `k` is the least that leaves the margin d of every limit:
//!
//! ```text
//! k >= |P'| / ((1 - d_v) V),   k^2 >= |P''| / ((1 - d_a) A),   k^3 >= |P'''| / ((1 - d_j) J)
//! ```
//!
//! times a factor that the generator raises where a program still exceeds a limit. Between cells `k` is linear, no
//! steeper than `|P'| |k'| <= d_a A / 2`.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | s, t | `plan_s`, `time_s` | s |
//! | k | `factor` | - |

use planish_numerics::polynomial::{derivative, evaluate, range};
use planish_types::{Limits, Trajectory};

/// Fraction of the velocity limit that stays unused. Larger: slower programs. Smaller: more rounds. Chosen: rounding
/// of positions adds 1.5 counts per segment time.
const VELOCITY_MARGIN: f64 = 1e-3;

/// Fraction of the acceleration limit that stays unused. Larger: more time where the plan is at its limit. Smaller:
/// more rounds. Chosen.
const ACCELERATION_MARGIN: f64 = 0.02;

/// Fraction of the jerk limit that stays unused. Larger: slower programs. Smaller: more rounds. Chosen: a cubic
/// segment that spans a step of the jerk exceeds the plan's by some percent.
const JERK_MARGIN: f64 = 0.06;

/// Length of a cell, s, and largest number of cells of a plan. Longer: a plan is slowed down for longer than needed.
/// More and shorter: more memory and time. Chosen: shorter than a stage can follow.
const CELL_S: f64 = 2e-3;
const MOST_CELLS: f64 = 2e6;

/// Largest slope of `k` where the plan stands, 1/s. Larger: the clock may change more abruptly there. Smaller: the
/// program stays slow for longer. Chosen.
const STEEPEST_PER_S: f64 = 2.0;

/// Position, velocity and acceleration of [x, y] at an instant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct State {
    pub position_mm: [f64; 2],
    pub velocity: [f64; 2],
    pub acceleration: [f64; 2],
}

/// The path moved inwards near the ends of the travel, where the motion between two nodes goes beyond it:
///
/// ```text
/// p - e (d / L)^2      d = p - (end - L) > 0
/// ```
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Inwards {
    pub travel_mm: [Option<[f64; 2]>; 2],
    /// e at the lower and at the upper end of (x, y), mm.
    pub by_mm: [[f64; 2]; 2],
}

/// L, mm: length over which the path is moved inwards. Larger: more of the path is moved. Smaller: more acceleration.
/// Chosen: the tool reaches the end at a low speed, so a change of micrometres over this adds little acceleration.
const INWARDS_OVER_MM: f64 = 0.5;

impl Inwards {
    /// The largest e, mm.
    pub fn most_mm(&self) -> f64 {
        self.by_mm.iter().flatten().copied().fold(0.0, f64::max)
    }

    fn apply(&self, state: &mut State) {
        for axis in 0..2 {
            let Some([low, high]) = self.travel_mm[axis] else { continue };
            let length = INWARDS_OVER_MM.min(0.25 * (high - low));
            // Outwards is +1 at the upper end, -1 at the lower one.
            for (e, end, out) in
                [(self.by_mm[axis][0], low, -1.0), (self.by_mm[axis][1], high, 1.0)]
            {
                let d = out * (state.position_mm[axis] - end) + length;
                if e > 0.0 && d > 0.0 {
                    let slope = 1.0 - 2.0 * e * d / (length * length);
                    let v = state.velocity[axis];
                    state.position_mm[axis] -= out * e * (d / length).powi(2);
                    state.velocity[axis] = v * slope;
                    state.acceleration[axis] = state.acceleration[axis] * slope
                        - out * 2.0 * e * v * v / (length * length);
                }
            }
        }
    }
}

/// A plan and its slower clock.
pub(crate) struct Slowed<'a> {
    plan: &'a Trajectory,
    inwards: Inwards,
    cell_s: f64,
    /// k at the borders of the cells (m+1).
    factor: Vec<f64>,
    /// Time of the program at the borders of the cells (m+1), s.
    time_s: Vec<f64>,
}

/// Cells of a plan, with the slowing down that each needs.
pub(crate) struct Cells {
    cell_s: f64,
    /// Least k of every cell (m), without the raised factors.
    need: Vec<f64>,
    /// Steepest k of every cell (m), 1/s.
    steepest: Vec<f64>,
    /// Factors of the need that the generator asks for besides (m); >= 1.
    pub raised: Vec<f64>,
    /// Longest segments (m), s.
    pub longest_s: Vec<f64>,
}

impl Cells {
    /// The cells of `plan` on a machine with `limits`.
    pub fn new(plan: &Trajectory, limits: &Limits) -> Self {
        let total_s = plan.total_time_s();
        let cell_s = CELL_S.max(total_s / MOST_CELLS);
        let m = (total_s / cell_s).ceil().max(1.0) as usize;
        let mut cells = Self {
            cell_s,
            need: vec![1.0; m],
            steepest: vec![STEEPEST_PER_S; m],
            raised: vec![1.0; m],
            longest_s: vec![f64::INFINITY; m],
        };
        let start_s = plan.break_time_s()[0];
        for segment in plan.segments() {
            let from_s = segment.start_s - start_s;
            let first = cells.of(from_s);
            let last = cells.of(from_s + segment.duration_s);
            for i in first..=last {
                let begin = (i as f64 * cell_s - from_s).max(0.0).min(segment.duration_s);
                let end = ((i + 1) as f64 * cell_s - from_s).clamp(begin, segment.duration_s);
                for (axis, limit) in limits.axes().iter().enumerate() {
                    let c =
                        planish_numerics::polynomial::shifted(&segment.coefficient_mm[axis], begin);
                    let v = derivative(&c);
                    let a = derivative(&v);
                    let peak = |c: &[f64; 4]| range(c, end - begin).peak().0;
                    let (speed, acceleration) = (peak(&v), peak(&a));
                    let most_a = limit.max_acceleration_mm_per_s2();
                    let need = &mut cells.need[i];
                    let most_v = (1.0 - VELOCITY_MARGIN) * limit.max_velocity_mm_per_s();
                    *need = need.max(speed / most_v);
                    *need =
                        need.max((acceleration / ((1.0 - ACCELERATION_MARGIN) * most_a)).sqrt());
                    if let Some(jerk) = limit.max_jerk_mm_per_s3() {
                        let used = derivative(&a)[0].abs() / ((1.0 - JERK_MARGIN) * jerk);
                        *need = need.max(used.cbrt());
                    }
                    let steepest = 0.5 * ACCELERATION_MARGIN * most_a / speed.max(1e-9 * most_v);
                    cells.steepest[i] = cells.steepest[i].min(steepest);
                }
            }
        }
        cells
    }

    /// The cell of a time of the plan.
    pub fn of(&self, plan_s: f64) -> usize {
        ((plan_s / self.cell_s).max(0.0) as usize).min(self.need.len() - 1)
    }

    /// `k` at the borders: above the need of both cells beside a border, and nowhere steeper than allowed.
    fn factor(&self) -> Vec<f64> {
        let m = self.need.len();
        let cell = |i: usize| self.need[i] * self.raised[i];
        let mut k: Vec<f64> =
            (0..=m).map(|i| cell(i.saturating_sub(1)).max(cell(i.min(m - 1)))).collect();
        for i in 0..m {
            k[i + 1] = k[i + 1].max(k[i] - self.steepest[i] * self.cell_s);
        }
        for i in (0..m).rev() {
            k[i] = k[i].max(k[i + 1] - self.steepest[i] * self.cell_s);
        }
        k
    }
}

impl<'a> Slowed<'a> {
    /// The plan on the clock that `cells` ask for.
    pub fn new(plan: &'a Trajectory, cells: &Cells, inwards: Inwards) -> Self {
        let factor = cells.factor();
        let mut time_s = Vec::with_capacity(factor.len());
        let (mut sum, mut lost) = (0.0, 0.0);
        time_s.push(0.0);
        let m = cells.need.len();
        for i in 0..m {
            let length = match i + 1 == m {
                true => plan.total_time_s() - i as f64 * cells.cell_s,
                false => cells.cell_s,
            };
            // The factors lie at the borders of whole cells.
            let end = factor[i] + (factor[i + 1] - factor[i]) * length / cells.cell_s;
            // Compensated: a plan has up to 2e6 cells, and a program that is not slowed has the plan's times.
            let add = 0.5 * (factor[i] + end) * length - lost;
            let next: f64 = sum + add;
            lost = (next - sum) - add;
            sum = next;
            time_s.push(sum);
        }
        Self { plan, inwards, cell_s: cells.cell_s, factor, time_s }
    }

    /// Duration of the slower motion, s.
    pub fn total_s(&self) -> f64 {
        self.time_s[self.time_s.len() - 1]
    }

    /// Time of the plan at a time of the program, with k and k'.
    pub fn plan_time(&self, time_s: f64) -> (f64, f64, f64) {
        let i = self.time_s.partition_point(|t| *t <= time_s).clamp(1, self.factor.len() - 1) - 1;
        let dt = (time_s - self.time_s[i]).max(0.0);
        let (k, slope) = (self.factor[i], (self.factor[i + 1] - self.factor[i]) / self.cell_s);
        // t = k u + k' u^2 / 2
        let u = 2.0 * dt / (k + (k * k + 2.0 * slope * dt).max(0.0).sqrt());
        let plan_s = (i as f64 * self.cell_s + u).min(self.plan.total_time_s());
        (plan_s, k + slope * u, slope)
    }

    /// Time of the program at a time of the plan, s.
    pub fn program_time(&self, plan_s: f64) -> f64 {
        let i = ((plan_s / self.cell_s).max(0.0) as usize).min(self.factor.len() - 2);
        let u = plan_s - i as f64 * self.cell_s;
        let slope = (self.factor[i + 1] - self.factor[i]) / self.cell_s;
        self.time_s[i] + self.factor[i] * u + 0.5 * slope * u * u
    }

    /// The motion at a time of the program; at rest beyond its end.
    pub fn at(&self, time_s: f64) -> State {
        let (plan_s, k, slope) = self.plan_time(time_s);
        let mut state = at_plan(self.plan, plan_s);
        for axis in 0..2 {
            let v = state.velocity[axis];
            state.velocity[axis] = v / k;
            state.acceleration[axis] = state.acceleration[axis] / (k * k) - v * slope / (k * k * k);
        }
        self.inwards.apply(&mut state);
        if time_s <= 0.0 || time_s >= self.total_s() {
            state.velocity = [0.0; 2];
        }
        state
    }

    /// The breaks of the plan within a stretch of the program, as times of the program.
    pub fn breaks_within(&self, from_s: f64, to_s: f64) -> impl Iterator<Item = f64> + '_ {
        let start_s = self.plan.break_time_s()[0];
        let [low, high] = [from_s, to_s].map(|t| start_s + self.plan_time(t).0);
        let breaks = self.plan.break_time_s();
        let first = breaks.partition_point(|b| *b <= low);
        let end = breaks.partition_point(|b| *b < high).max(first);
        breaks[first..end].iter().map(move |b| self.program_time(b - start_s))
    }

    /// Shortest distance of `position_mm` from the path near the program's time, mm: the plan is asked a little
    /// earlier or later, where its velocity says that it is nearer.
    pub fn distance_mm(&self, time_s: f64, position_mm: [f64; 2]) -> [f64; 2] {
        let here = self.at(time_s);
        let off = |s: &State| [0, 1].map(|a| position_mm[a] - s.position_mm[a]);
        let length = |e: [f64; 2]| e[0].hypot(e[1]);
        let e = off(&here);
        let v = here.velocity;
        let (speed2, along) = (v[0] * v[0] + v[1] * v[1], e[0] * v[0] + e[1] * v[1]);
        let at_once = length(e);
        let shift_s = along / speed2;
        if !(shift_s.is_finite() && shift_s.abs() < SHIFT_S) {
            return [at_once, at_once];
        }
        [at_once.min(length(off(&self.at(time_s + shift_s)))), at_once]
    }
}

/// Largest shift in time by which [`Slowed::distance_mm`] looks for a nearer point, s. Larger: points of another pass
/// may count as near. Smaller: distances along the path count as deviations. Chosen.
const SHIFT_S: f64 = 0.01;

/// State of the plan at a time since its start.
pub(crate) fn at_plan(plan: &Trajectory, plan_s: f64) -> State {
    let time_s = plan.break_time_s()[0] + plan_s;
    let i = plan.break_time_s().partition_point(|b| *b <= time_s).clamp(1, plan.len()) - 1;
    let segment = plan.segment(i);
    let u = (time_s - segment.start_s).clamp(0.0, segment.duration_s);
    let [p, v, a] = {
        let c = segment.coefficient_mm;
        let first = c.each_ref().map(derivative);
        let second = first.each_ref().map(derivative);
        [
            c.each_ref().map(|c| evaluate(c, u)),
            first.each_ref().map(|c| evaluate(c, u)),
            second.each_ref().map(|c| evaluate(c, u)),
        ]
    };
    State { position_mm: p, velocity: v, acceleration: a }
}
