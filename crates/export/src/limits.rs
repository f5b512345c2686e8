//! Does the motion keep the limits of the machine? Proven from the polynomials, never from samples.
//!
//! Two motions are looked at.
//!
//! 1. The plan ([`check_plan`]): the trajectory as it is. Its velocity, acceleration and jerk on the
//!    whole of every segment, its steps in position and velocity (from rest, to rest), and with a limit
//!    on jerk its steps in acceleration keep the limits to rounding.
//! 2. What the controller executes ([`prove`]): the cubic through the rounded positions and velocities
//!    in the rounded time (or the straight line in that time). Rounding moves the plan, so this motion
//!    may exceed a limit that the plan uses fully, by what the rounding explains and no more:
//!
//! ```text
//! m = d / h                               mean velocity of a segment: distance by time
//! dm = (c + |m| t) / (h - t)              c: a count,  t: a tick,  dv: rounding of a velocity
//!
//! v(s)    = (1 - 4 s + 3 s^2) v0 + (3 s^2 - 2 s) v1 + 6 s (1 - s) m            0 <= s <= 1
//! a(s) h  = 6 m (1 - 2 s) - (4 - 6 s) v0 - (2 - 6 s) v1
//! j h^2   = 6 (v0 + v1 - 2 m)
//!
//! velocity      1.5 dm + dv
//! acceleration  (6 dm + 6 dv + |a| t) / (h - t)
//! jerk          (12 dm + 12 dv + |j| t (2 h + t)) / (h - t)^2
//! ```
//!
//! Each line is the sum of the moduli of the derivatives above it. Beyond [`MOST_EXCESS`] of a limit the
//! program is refused whatever explains it.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | d, h | `distance`, `time_s` | mm, s |
//! | m, dm | `mean`, `mean_error` | mm/s |
//! | c, t, dv | `Rounding` | mm, s, mm/s |

use planish_numerics::polynomial::{derivative, evaluate, range};
use planish_types::{AxisLimits, Invalid, Limits, Machine, Trajectory};
use serde::Serialize;

use crate::quantise::Quantised;

/// Part of a limit that is rounding of the plan's own numbers: a schedule that uses a limit fully
/// reaches it to some 1e-10, and no drive resolves 1e-9 of its limit.
const LIMIT_ROUNDING: f64 = 1e-9;

/// Steps in position and velocity that are rounding, mm and mm/s: the accuracy to which a schedule
/// is fitted by cubics. 1e-9 of the largest velocity is added to the second.
pub(crate) const STEP_MM: f64 = 1e-6;
const STEP_MM_PER_S: f64 = 1e-6;

/// Part of the largest acceleration up to which a step in it is rounding.
const ACCELERATION_STEP: f64 = 1e-6;

/// Most of a limit that rounding may add to it. Limits are stated to two digits (250 mm/s,
/// 2000 mm/s^2); half of the second one, 5 percent, is within the statement.
pub const MOST_EXCESS: f64 = 0.05;

/// Coefficients and times beyond this are refused, so that their products stay finite.
const LARGEST_NUMBER: f64 = 1e60;

/// What the controller does between two ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Between {
    /// The cubic through positions and velocities.
    Cubic,
    /// A straight line at constant speed, which its planner joins to the next one.
    Straight,
}

/// What is proven of a program, for the file beside it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Proof {
    /// What holds for the motion that the controller executes.
    pub proven: &'static str,
    /// What is left to the controller.
    pub not_proven: &'static str,
    /// The largest values that the program asks for, with their limits.
    pub largest: Vec<Peak>,
}

/// The largest magnitude of a quantity.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Peak {
    /// What, along which axis.
    pub quantity: String,
    /// Unit of the numbers.
    pub unit: &'static str,
    /// Largest magnitude (the shortest time, for the duration of a segment).
    pub value: f64,
    /// Limit of the machine.
    pub limit: f64,
    /// Part of the limit by which rounding exceeds it; 0 where it is kept.
    pub excess: f64,
    /// Segment of the program where it occurs.
    pub segment: usize,
}

impl Peak {
    /// "x acceleration of 2003 mm/s^2 in segment 12 exceeds the limit of 2000 mm/s^2 by 0.15 %".
    pub fn sentence(&self) -> String {
        let Self { quantity, unit, value, limit, excess, segment } = self;
        let percent = 100.0 * excess;
        format!(
            "{quantity} of {value:.6} {unit} in segment {segment} is {percent:.3} % beyond the limit of \
             {limit} {unit}: that is what rounding to counts and ticks adds"
        )
    }
}

/// Refuses a plan that does not keep the limits of `machine` or leaves its travel; names the worst place.
pub fn check_plan(trajectory: &Trajectory, machine: &Machine) -> Result<(), Invalid> {
    check_magnitudes(trajectory)?;
    check_travel(trajectory, machine)?;
    let machine = machine.limits();
    let mut worst = Worst::default();
    for (i, segment) in trajectory.segments().enumerate() {
        // The duration is the difference of two rounded times.
        let rounding_s = 2.0 * f64::EPSILON * (segment.start_s.abs() + segment.duration_s);
        worst.least(i, segment.duration_s, machine.min_segment_s(), rounding_s);
    }
    for (axis, limits) in machine.axes().iter().enumerate() {
        // [position, velocity, acceleration] before a break; at rest before the first.
        let mut before: Option<[f64; 3]> = None;
        for (i, segment) in trajectory.segments().enumerate() {
            let orders = derivatives(&segment.coefficient_mm[axis]);
            let state = |u: f64| [0, 1, 2].map(|order| evaluate(&orders[order], u));
            let start = state(0.0);
            worst.steps(i, before.unwrap_or([start[0], 0.0, 0.0]), start, limits);
            for (name, unit, limit, c) in limited(limits, &orders) {
                let (value, at_s) = range(c, segment.duration_s).peak();
                worst.most(i, (limits.name(), name, unit), value, at_s, limit);
            }
            before = Some(state(segment.duration_s));
        }
        let end = before.unwrap_or_default();
        worst.steps(trajectory.len(), end, [end[0], 0.0, 0.0], limits);
    }
    worst.verdict(machine.name())
}

/// Refuses a motion that goes where the axes cannot; what the controller's rounding adds is less than a count.
fn check_travel(trajectory: &Trajectory, machine: &Machine) -> Result<(), Invalid> {
    for (axis, travel) in machine.travel_mm().iter().enumerate() {
        let Some([low, high]) = *travel else { continue };
        let reached = trajectory.segments().enumerate().map(|(i, segment)| {
            let r = range(&segment.coefficient_mm[axis], segment.duration_s);
            let (below, above) = (low - r.min, r.max - high);
            if below > above { (i, below, r.min) } else { (i, above, r.max) }
        });
        let farthest = reached.max_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((i, beyond, position)) = farthest.filter(|f| exceeds(f.1, STEP_MM)) {
            let name = machine.limits().axes()[axis].name();
            let problem = format!(
                "{name} reaches {position:.4} mm, {beyond:.4} mm beyond its travel from {low} to {high} mm"
            );
            let remedy =
                "move the part (part_origin_mm of the machine), or plan with a smaller overscan";
            return Err(Invalid::at("segment", i, problem, remedy));
        }
    }
    Ok(())
}

/// Proves the limits of `machine` for the rounded motion.
pub fn prove(q: &Quantised, machine: &Limits, between: Between) -> Result<Proof, Invalid> {
    let mut peaks = Peaks::default();
    for k in 0..q.tool_on.len() {
        let time_s = q.time_s(k + 1) - q.time_s(k);
        if machine.min_segment_s() > 0.0 {
            let least = machine.min_segment_s();
            let what = What { slot: DURATION, axis: "shortest", name: "duration", unit: "s" };
            // Half a tick is lost at both ends.
            let explained = q.quanta.tick_s / least;
            peaks.take(k, &what, time_s, least, 1.0 - time_s / least, explained)?;
        }
        for (axis, limits) in machine.axes().iter().enumerate() {
            let rounding = Rounding::of(q, axis, limits);
            let distance = q.position_mm(k + 1)[axis] - q.position_mm(k)[axis];
            let v = [q.velocity_mm_per_s[k][axis], q.velocity_mm_per_s[k + 1][axis]];
            let c = match between {
                Between::Cubic => hermite(distance, v, time_s),
                Between::Straight => [0.0, distance / time_s, 0.0, 0.0],
            };
            let orders = derivatives(&c);
            let mean = distance.abs() / time_s;
            for (order, (name, unit, limit, c)) in limited(limits, &orders).enumerate() {
                // A straight line has a velocity; its corners are the planner's.
                if between == Between::Straight && order > 0 {
                    break;
                }
                let value = range(c, time_s).peak().0;
                let explained = rounding.explains(order, mean, time_s, value);
                let what = What { slot: 3 * axis + order, axis: limits.name(), name, unit };
                let excess = value / limit - 1.0;
                peaks.take(k, &what, value, limit, excess, explained / limit)?;
            }
        }
    }
    let (proven, not_proven) = match between {
        Between::Cubic => (
            "position and velocity are continuous, at rest at start and end; velocity, acceleration, jerk \
             (where the machine limits it) and the least duration hold on the whole of every segment",
            "the steps in acceleration between two segments, where the machine limits no jerk; the \
             servo loop; the move to the start",
        ),
        Between::Straight => (
            "the plan keeps all limits of the machine; the nominal velocity of every line and its least \
             duration hold",
            "the steps in velocity between two lines: the controller's planner rounds the corners within \
             its own limits and may take longer; the move to the start",
        ),
    };
    Ok(Proof { proven, not_proven, largest: peaks.0.into_iter().flatten().collect() })
}

/// The cubic (position from 0) over `distance` in `time_s` with the velocities `v` at its ends.
fn hermite(distance: f64, v: [f64; 2], time_s: f64) -> [f64; 4] {
    let mean = distance / time_s;
    [
        0.0,
        v[0],
        (3.0 * mean - 2.0 * v[0] - v[1]) / time_s,
        (v[0] + v[1] - 2.0 * mean) / (time_s * time_s),
    ]
}

/// p, p', p'', p'''.
fn derivatives(c: &[f64; 4]) -> [[f64; 4]; 4] {
    let v = derivative(c);
    let a = derivative(&v);
    [*c, v, a, derivative(&a)]
}

type Limited<'a> = (&'static str, &'static str, f64, &'a [f64; 4]);

/// What has a limit: name, unit, limit, polynomial; velocity, acceleration, jerk in this order.
fn limited<'a>(
    limits: &AxisLimits,
    orders: &'a [[f64; 4]; 4],
) -> impl Iterator<Item = Limited<'a>> {
    let [_, v, a, j] = orders;
    let jerk = limits.max_jerk_mm_per_s3().map(|limit| ("jerk", "mm/s^3", limit, j));
    [
        ("velocity", "mm/s", limits.max_velocity_mm_per_s(), v),
        ("acceleration", "mm/s^2", limits.max_acceleration_mm_per_s2(), a),
    ]
    .into_iter()
    .chain(jerk)
}

/// What rounding does to one axis.
struct Rounding {
    /// Error of a distance: a count, and what a plan's position may jump, mm.
    distance_mm: f64,
    /// Error of a time: a tick, s.
    time_s: f64,
    /// Error of a velocity: its unit, and what a plan's velocity may jump, mm/s.
    velocity_mm_per_s: f64,
}

impl Rounding {
    fn of(q: &Quantised, axis: usize, limits: &AxisLimits) -> Self {
        let quanta = &q.quanta;
        Self {
            distance_mm: quanta.count_mm[axis] + STEP_MM,
            time_s: quanta.tick_s,
            velocity_mm_per_s: quanta.velocity_mm_per_s[axis] + velocity_step(limits),
        }
    }

    /// By how much a quantity (order 0: velocity, 1: acceleration, 2: jerk) that is `value` now can
    /// differ from its plan; see the formulas above.
    fn explains(&self, order: usize, mean: f64, time_s: f64, value: f64) -> f64 {
        let (t, dv) = (self.time_s, self.velocity_mm_per_s);
        let planned_s = time_s - t;
        if planned_s <= 0.0 {
            return f64::INFINITY;
        }
        let mean_error = (self.distance_mm + mean * t) / planned_s;
        match order {
            0 => 1.5 * mean_error + dv,
            1 => (6.0 * mean_error + 6.0 * dv + value * t) / planned_s,
            _ => {
                let whole = 12.0 * mean_error + 12.0 * dv + value * t * (2.0 * time_s + t);
                whole / (planned_s * planned_s)
            }
        }
    }
}

/// Whether `value` is beyond `limit`; what is not a number is beyond every limit.
fn exceeds(value: f64, limit: f64) -> bool {
    value > limit || value.is_nan()
}

fn velocity_step(limits: &AxisLimits) -> f64 {
    STEP_MM_PER_S + LIMIT_ROUNDING * limits.max_velocity_mm_per_s()
}

/// A quantity that has a limit.
struct What<'a> {
    slot: usize,
    axis: &'a str,
    name: &'static str,
    unit: &'static str,
}

/// Slot of the duration, after velocity, acceleration and jerk of two axes.
const DURATION: usize = 6;

/// The largest value of every quantity, the shortest duration.
#[derive(Default)]
struct Peaks([Option<Peak>; DURATION + 1]);

impl Peaks {
    /// `value` of segment `segment` is beyond `limit` by the part `excess` of it, of which rounding
    /// explains the part `explained`.
    fn take(
        &mut self,
        segment: usize,
        what: &What,
        value: f64,
        limit: f64,
        excess: f64,
        explained: f64,
    ) -> Result<(), Invalid> {
        let quantity = || format!("{} {}", what.axis, what.name);
        let unit = what.unit;
        if exceeds(excess, LIMIT_ROUNDING + explained.min(MOST_EXCESS)) {
            let problem = format!(
                "{} is {value:.6} {unit}, {:.2} % beyond the limit of {limit} {unit}; rounding to counts \
                 and ticks explains {:.2} %, and {:.0} % is the most",
                quantity(),
                100.0 * excess,
                100.0 * explained,
                100.0 * MOST_EXCESS,
            );
            let remedy =
                "give a smaller count or tick, or plan with lower limits or longer dwell times";
            return Err(Invalid::at("segment", segment, problem, remedy));
        }
        let excess = if excess <= LIMIT_ROUNDING { 0.0 } else { excess };
        let slot = &mut self.0[what.slot];
        let beyond = slot.as_ref().is_none_or(|old| match what.slot {
            DURATION => value < old.value,
            _ => value > old.value,
        });
        if beyond {
            *slot = Some(Peak { quantity: quantity(), unit, value, limit, excess, segment });
        }
        Ok(())
    }
}

/// The worst place of a plan: how far beyond, and what to say of it.
#[derive(Default)]
struct Worst(Option<(f64, Invalid)>);

const REMEDY: &str = "schedule for this machine with planish-schedule pvt or stop-at-corners, \
                      and see planish-verify";

impl Worst {
    fn add(&mut self, ratio: f64, make: impl FnOnce() -> Invalid) {
        if self.0.as_ref().is_none_or(|(worst, _)| exceeds(ratio, *worst)) {
            self.0 = Some((ratio, make()));
        }
    }

    fn most(
        &mut self,
        i: usize,
        (axis, name, unit): (&str, &str, &str),
        value: f64,
        at_s: f64,
        limit: f64,
    ) {
        if exceeds(value, limit * (1.0 + LIMIT_ROUNDING)) {
            self.add(value / limit, || {
                let problem = format!(
                    "{axis} {name} reaches {value:.6} {unit} after {at_s:.6} s, the limit is {limit} {unit}"
                );
                Invalid::at("segment", i, problem, REMEDY)
            });
        }
    }

    fn least(&mut self, i: usize, time_s: f64, limit_s: f64, rounding_s: f64) {
        if time_s < limit_s * (1.0 - LIMIT_ROUNDING) - rounding_s {
            self.add(limit_s / time_s, || {
                let problem = format!("lasts {time_s} s, the machine wants {limit_s} s at least");
                Invalid::at("segment", i, problem, "plan longer dwell times")
            });
        }
    }

    /// The steps into segment `i` (one beyond the last: into rest).
    fn steps(&mut self, i: usize, before: [f64; 3], after: [f64; 3], limits: &AxisLimits) {
        let acceleration = limits
            .max_jerk_mm_per_s3()
            .map_or(f64::INFINITY, |_| ACCELERATION_STEP * limits.max_acceleration_mm_per_s2());
        for (name, unit, order, allowed) in [
            ("position", "mm", 0, STEP_MM),
            ("velocity", "mm/s", 1, velocity_step(limits)),
            ("acceleration", "mm/s^2", 2, acceleration),
        ] {
            let step = after[order] - before[order];
            if exceeds(step.abs(), allowed) {
                self.add(f64::INFINITY, || {
                    let axis = limits.name();
                    let problem = format!(
                        "begins with a step of {step:.6} {unit} in the {name} of {axis}, where \
                         {allowed:.1e} {unit} is rounding (the machine rests before and after the motion)"
                    );
                    Invalid::at("segment", i, problem, REMEDY)
                });
            }
        }
    }

    fn verdict(self, machine: &str) -> Result<(), Invalid> {
        match self.0 {
            None => Ok(()),
            Some((_, mut invalid)) => {
                let machine: String = machine.escape_debug().collect();
                invalid.problem += &format!(" (machine \"{machine}\")");
                Err(invalid)
            }
        }
    }
}

fn check_magnitudes(trajectory: &Trajectory) -> Result<(), Invalid> {
    let large = |v: &f64| v.abs() > LARGEST_NUMBER;
    let remedy = "numbers beyond 1e60 are not mm and s; check the units";
    if let Some(i) = trajectory.break_time_s().iter().position(large) {
        return Err(Invalid::at("break_time_s", i, "is beyond 1e60 s", remedy));
    }
    let coefficients = trajectory.coefficient_mm();
    if let Some(i) = coefficients.iter().position(|c| c.iter().flatten().any(large)) {
        return Err(Invalid::at("coefficient_mm", i, "is beyond 1e60", remedy));
    }
    Ok(())
}
