//! Does the motion keep the limits of the machine? Proven from the polynomials, never from samples.
//!
//! Two motions are looked at.
//!
//! 1. The plan ([`check_plan`]): the trajectory as it is. Its velocity, acceleration and jerk on the whole of every
//!    segment, its steps in position and velocity (from rest, to rest), and with a limit on jerk its steps in
//!    acceleration keep the limits to rounding. Its segments may be shorter than those of the controller.
//! 2. The motion that the controller executes ([`prove`]): the cubics through the rounded positions and velocities at
//!    the rounded times, or the joined lines. It keeps every limit and the travel of the axes.

use planish_numerics::polynomial::{derivative, evaluate, range};
use planish_types::{AxisLimits, Interpolation, Invalid, Machine, Trajectory};
use serde::Serialize;

use crate::generate::Nodes;

/// Fraction of a limit that is rounding of the plan's own numbers. Larger: plans may exceed a limit by it. Smaller:
/// plans at their limits are refused. Chosen: a schedule that uses a limit fully reaches it to some 1e-10, and no
/// drive resolves 1e-9 of its limit.
const LIMIT_ROUNDING: f64 = 1e-9;

/// Largest steps in position, mm, and in velocity, mm/s, that are rounding; 1e-9 of the largest velocity is added to
/// the second. Larger: plans with real steps are accepted. Smaller: schedules are refused. Chosen: the accuracy to
/// which a schedule is fitted by cubics.
pub(crate) const STEP_MM: f64 = 1e-6;
const STEP_MM_PER_S: f64 = 1e-6;

/// Largest excess of the travel that is rounding of a coordinate, mm. Larger: axes may leave their travel by it.
/// Smaller: programs at the end of the travel are refused. Chosen far below a count.
const TRAVEL_MM: f64 = 1e-9;

const REMEDY_OF_TRAVEL: &str =
    "move the part (part_origin_mm of the machine), or plan with a smaller overscan";

/// Largest step in the acceleration that is rounding, over the largest acceleration. Larger: real steps are accepted
/// on machines with a limit on jerk. Smaller: smooth plans are refused. Chosen.
const ACCELERATION_STEP: f64 = 1e-6;

/// Largest magnitude of a coefficient or a time, in its unit. Larger: products may overflow. Smaller: no motion is
/// affected. Chosen so that products stay finite.
const LARGEST_NUMBER: f64 = 1e60;

/// A proof, with the largest values that the program asks for.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Proof {
    /// Sentence on what holds for the executed motion.
    pub proven: &'static str,
    /// Sentence on what this does not say.
    pub not_proven: &'static str,
    /// The largest values that the program asks for, with their limits.
    pub largest: Vec<Peak>,
    /// Lowest and highest position of (x, y) on the whole motion, mm.
    pub reach_mm: [[f64; 2]; 2],
}

/// The largest magnitude of a quantity.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Peak {
    /// Quantity and axis.
    pub quantity: String,
    /// Unit of the numbers.
    pub unit: &'static str,
    /// Largest magnitude (the shortest time, for the duration of a segment).
    pub value: f64,
    /// Limit of the machine.
    pub limit: f64,
    /// Segment of the program where it occurs.
    pub segment: usize,
}

/// Refuses a plan that does not keep the limits of `machine` or leaves its travel; names the worst place.
pub fn check_plan(trajectory: &Trajectory, machine: &Machine) -> Result<(), Invalid> {
    check_magnitudes(trajectory)?;
    check_travel(trajectory, machine)?;
    let machine = machine.limits();
    let mut worst = Worst::default();
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

/// Refuses a motion that goes where the axes cannot.
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
            return Err(Invalid::at("segment", i, problem, REMEDY_OF_TRAVEL));
        }
    }
    Ok(())
}

/// Proves the limits and the travel of `machine` for the motion that the controller executes.
pub fn prove(nodes: &Nodes, machine: &Machine) -> Result<Proof, Invalid> {
    let mut peaks = Peaks::default();
    let limits = machine.limits();
    let least_s = limits.min_segment_s();
    if least_s > 0.0 {
        for k in 0..nodes.segments() {
            let what = What { slot: DURATION, axis: "shortest", name: "duration", unit: "s" };
            let time_s = nodes.duration(k) as f64 * nodes.tick_s;
            peaks.take(k, &what, time_s, least_s, least_s / time_s)?;
        }
    }
    let mut reach_mm = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for piece in nodes.pieces() {
        for (axis, limits) in limits.axes().iter().enumerate() {
            let orders = derivatives(&piece.coefficient_mm[axis]);
            let r = range(&orders[0], piece.time_s);
            let [low, high] = &mut reach_mm[axis];
            (*low, *high) = (low.min(r.min), high.max(r.max));
            for (order, (name, unit, limit, c)) in limited(limits, &orders).enumerate() {
                // The acceleration of joined lines has steps.
                if nodes.interpolation == Interpolation::Linear && order > 1 {
                    break;
                }
                let value = range(c, piece.time_s).peak().0;
                let what = What { slot: 3 * axis + order, axis: limits.name(), name, unit };
                peaks.take(piece.segment, &what, value, limit, value / limit)?;
            }
        }
    }
    for (axis, travel) in machine.travel_mm().iter().enumerate() {
        let Some([from, to]) = *travel else { continue };
        let [low, high] = reach_mm[axis];
        let beyond = (from - low).max(high - to);
        if exceeds(beyond, TRAVEL_MM) {
            let name = limits.axes()[axis].name();
            let problem = format!(
                "{name} goes from {low:.6} to {high:.6} mm, {beyond:.6} mm beyond its travel from {from} to {to} mm"
            );
            return Err(Invalid::whole("program", problem, REMEDY_OF_TRAVEL));
        }
    }
    let (proven, not_proven) = match nodes.interpolation {
        Interpolation::Hermite => (
            "position and velocity are continuous, at rest at start and end; position within the travel, velocity, \
             acceleration, jerk (where the machine limits it) and the least duration hold on the whole of every segment",
            "the steps in acceleration between two segments; the servo loop; the move to the start",
        ),
        Interpolation::Linear => (
            "joined by parabolas over the halves of the shorter lines beside a node, the lines are a motion with \
             continuous velocity, at rest before and after; its position within the travel, velocity and acceleration, \
             and the least duration of a line hold everywhere",
            "the planner of the controller, which may join lines otherwise and take longer; jerk; the servo loop; the \
             move to the start",
        ),
    };
    Ok(Proof { proven, not_proven, largest: peaks.0.into_iter().flatten().collect(), reach_mm })
}

/// p, p', p'', p'''.
fn derivatives(c: &[f64; 4]) -> [[f64; 4]; 4] {
    let v = derivative(c);
    let a = derivative(&v);
    [*c, v, a, derivative(&a)]
}

type Limited<'a> = (&'static str, &'static str, f64, &'a [f64; 4]);

/// Quantities that have a limit: name, unit, limit, polynomial; velocity, acceleration, jerk in this order.
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

/// Returns true if `value` is beyond `limit`, or is not a number.
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
    /// `value` of segment `segment` uses the part `used` of `limit`.
    fn take(
        &mut self,
        segment: usize,
        what: &What,
        value: f64,
        limit: f64,
        used: f64,
    ) -> Result<(), Invalid> {
        let quantity = || format!("{} {}", what.axis, what.name);
        let unit = what.unit;
        if exceeds(used, 1.0 + LIMIT_ROUNDING) {
            let problem = format!(
                "{} is {value:.6} {unit} in the program, the limit is {limit} {unit}",
                quantity()
            );
            let remedy = "give a smaller count or tick, or plan with lower limits";
            return Err(Invalid::at("segment", segment, problem, remedy));
        }
        let slot = &mut self.0[what.slot];
        let beyond = slot.as_ref().is_none_or(|old| match what.slot {
            DURATION => value < old.value,
            _ => value > old.value,
        });
        if beyond {
            *slot = Some(Peak { quantity: quantity(), unit, value, limit, segment });
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
