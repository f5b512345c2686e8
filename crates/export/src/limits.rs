//! Checks that a motion keeps the limits of the machine. They are proofs from the polynomials of the motion, not tests
//! of samples.
//!
//! Two motions are checked.
//!
//! 1. The plan ([`check_plan`]): the trajectory as it is. Its velocity, acceleration and jerk on the whole of every
//!    segment, its steps in position and velocity (from rest, to rest), and with a limit on jerk its steps in
//!    acceleration keep the limits to rounding. Its segments may be shorter than those of the controller.
//! 2. The motion that the controller executes ([`prove`]): the cubics through the rounded positions and velocities at
//!    the rounded times, or the joined lines. It keeps every limit and the travel of the axes.

use planish_numerics::polynomial::{derivative, evaluate, range};
use planish_types::{Interpolation, Invalid, MachineAxis};
use serde::Serialize;

use crate::{
    generate::{ExecutedCubic, Nodes, acceleration_steps},
    plan::AxesPlan,
};

/// Excess of a limit, as a fraction of it, that counts as rounding of the plan's own numbers. Larger: plans may exceed
/// a limit by it. Smaller: plans at their limits are refused. Chosen: a schedule that uses a limit fully reaches it to
/// some 1e-10, and no drive resolves 1e-9 of its limit.
const LIMIT_ROUNDING: f64 = 1e-9;

/// Steps that count as rounding: in position, mm or deg, and in velocity, mm/s or deg/s; 1e-9 of the largest velocity
/// is added to the second. Larger: plans with real steps are accepted. Smaller: schedules are refused. Chosen: the
/// accuracy to which a schedule is fitted by cubics.
const STEP: f64 = 1e-6;
const STEP_PER_S: f64 = 1e-6;

/// Excess of the travel that counts as rounding of a coordinate, mm or deg. Larger: axes may leave their travel by it.
/// Smaller: programs at the end of the travel are refused. Chosen far below a count.
const TRAVEL: f64 = 1e-9;

/// Returns the remedy for a motion beyond the travel of an axis.
fn remedy_of_travel<const N: usize>(plan: &AxesPlan<N>) -> &'static str {
    if plan.may_step {
        "move the part (part_origin_mm, part_origin_z_mm of the machine), or plan with a smaller overscan"
    } else {
        "move the part (part_origin_mm of the machine), or plan with a smaller overscan"
    }
}

/// Step in the acceleration that counts as rounding, as a fraction of the largest acceleration. Larger: real steps are
/// accepted on machines with a limit on jerk. Smaller: smooth plans are refused. Chosen.
const ACCELERATION_STEP: f64 = 1e-6;

/// Largest magnitude of a coefficient or a time, in its unit. Larger: products may overflow. Smaller: no motion is
/// affected. Chosen so that products stay finite.
const LARGEST_NUMBER: f64 = 1e60;

/// Proof that the executed motion keeps the limits, with the largest values that it reaches.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Proof {
    /// Sentence that says what the proof covers.
    pub proven: &'static str,
    /// Sentence that says what the proof does not cover.
    pub not_proven: &'static str,
    /// The largest value of every limited quantity on the motion, with its limit.
    pub largest: Vec<Peak>,
    /// Lowest and highest position of x and of y on the whole motion, mm. Empty in a program of all axes, whose list of
    /// axes has them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub reach_mm: Vec<[f64; 2]>,
}

/// Largest magnitude of a limited quantity on the motion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Peak {
    /// Name of the axis and of the quantity, for example "x velocity".
    pub quantity: String,
    /// Unit of value and limit.
    pub unit: &'static str,
    /// Largest magnitude, or the shortest time for the duration of a segment.
    pub value: f64,
    /// Limit of the machine.
    pub limit: f64,
    /// Index of the segment of the program in which it occurs.
    pub segment: usize,
}

/// Refuses a plan that exceeds the limits of the machine, leaves its travel, has steps, or does not begin and end at
/// rest; the error names the worst excess. Also refuses numbers beyond [`LARGEST_NUMBER`].
pub(crate) fn check_plan<const N: usize>(plan: &AxesPlan<N>) -> Result<(), Invalid> {
    check_magnitudes(plan)?;
    check_travel(plan)?;
    let remedy = if plan.may_step { REMEDY_OF_AXES } else { REMEDY };
    let mut worst = WorstExcess { fault: None, remedy };
    for (axis, limits) in plan.axes.iter().enumerate() {
        // [position, velocity, acceleration] before a break, and the duration before; at rest before the first.
        let mut before: Option<([f64; 3], f64)> = None;
        for (i, segment) in plan.segments().enumerate() {
            let orders = derivatives(&segment.coefficient[axis]);
            let state = |u: f64| [0, 1, 2].map(|order| evaluate(&orders[order], u));
            let start = state(0.0);
            let (from, before_s) = before.unwrap_or(([start[0], 0.0, 0.0], 0.0));
            let beside_s = if plan.may_step { before_s + segment.duration_s } else { 0.0 };
            worst.steps(i, from, start, limits, beside_s);
            for (name, unit, limit, c) in limited(limits, &orders) {
                let (value, at_s) = range(c, segment.duration_s).peak();
                worst.most(i, (limits.name, name, unit), value, at_s, limit);
            }
            before = Some((state(segment.duration_s), segment.duration_s));
        }
        let (end, before_s) = before.unwrap_or_default();
        let beside_s = if plan.may_step { before_s } else { 0.0 };
        worst.steps(plan.len(), end, [end[0], 0.0, 0.0], limits, beside_s);
    }
    worst.verdict(plan.machine.name())
}

/// Refuses a plan that leaves the travel of an axis by more than [`STEP`].
fn check_travel<const N: usize>(plan: &AxesPlan<N>) -> Result<(), Invalid> {
    for (axis, limits) in plan.axes.iter().enumerate() {
        let Some([low, high]) = limits.travel else { continue };
        let reached = plan.segments().enumerate().map(|(i, segment)| {
            let r = range(&segment.coefficient[axis], segment.duration_s);
            let below = low - r.min;
            let above = r.max - high;
            if below > above { (i, below, r.min) } else { (i, above, r.max) }
        });
        let farthest = reached.max_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((i, beyond, position)) = farthest.filter(|f| exceeds(f.1, STEP)) {
            let name = limits.name;
            let unit = limits.unit();
            let problem = format!(
                "{name} reaches {position:.4} {unit}, {beyond:.4} {unit} beyond its travel from {low} to {high} {unit}"
            );
            return Err(Invalid::at_index("segment", i, problem, remedy_of_travel(plan)));
        }
    }
    Ok(())
}

/// A proof, and the lowest and highest position of every axis on the whole motion.
type Proven<const N: usize> = (Proof, [[f64; 2]; N]);

/// Proves that the motion which the controller executes keeps the limits, the travel and the shortest segment of the
/// machine. Refuses a program that does not.
pub(crate) fn prove<const N: usize>(
    nodes: &Nodes<N>,
    plan: &AxesPlan<N>,
) -> Result<Proven<N>, Invalid> {
    prove_pieces(nodes, &nodes.pieces(), plan)
}

/// Proves the same of a motion that goes on from its last node: what the axes do there is not judged.
pub(crate) fn prove_to_last_node<const N: usize>(
    nodes: &Nodes<N>,
    plan: &AxesPlan<N>,
) -> Result<Proven<N>, Invalid> {
    prove_pieces(nodes, &nodes.pieces_to_last_node(), plan)
}

fn prove_pieces<const N: usize>(
    nodes: &Nodes<N>,
    pieces: &[ExecutedCubic<N>],
    plan: &AxesPlan<N>,
) -> Result<Proven<N>, Invalid> {
    // The last slot is that of the duration.
    let mut peaks = Peaks(vec![None; 3 * N + 1]);
    let least_s = plan.machine.limits().min_segment_s();
    if least_s > 0.0 {
        for k in 0..nodes.segments() {
            let what = What { slot: 3 * N, axis: "shortest", name: "duration", unit: "s" };
            let time_s = nodes.duration(k) as f64 * nodes.tick_s;
            peaks.take(k, &what, time_s, least_s, least_s / time_s)?;
        }
    }
    let mut reach = [[f64::INFINITY, f64::NEG_INFINITY]; N];
    for piece in pieces {
        for (axis, limits) in plan.axes.iter().enumerate() {
            let orders = derivatives(&piece.coefficient[axis]);
            let r = range(&orders[0], piece.time_s);
            let [low, high] = &mut reach[axis];
            *low = low.min(r.min);
            *high = high.max(r.max);
            for (order, (name, unit, limit, c)) in limited(limits, &orders).enumerate() {
                // The acceleration of joined lines has steps.
                if nodes.interpolation == Interpolation::Linear && order > 1 {
                    break;
                }
                let value = range(c, piece.time_s).peak().0;
                let what = What { slot: 3 * axis + order, axis: limits.name, name, unit };
                peaks.take(piece.segment, &what, value, limit, value / limit)?;
            }
        }
    }
    check_reach(plan, &reach)?;
    if plan.may_step && nodes.interpolation == Interpolation::Hermite {
        check_acceleration_steps(plan, pieces)?;
    }
    let (proven, not_proven) = match nodes.interpolation {
        Interpolation::Hermite if plan.may_step => (
            "position and velocity are continuous, at rest at start and end; position within the travel, velocity, \
             acceleration, jerk (where the machine limits it) and the least duration hold on the whole of every \
             segment; a step of the acceleration is at most what the jerk limit allows between the middles of two \
             segments",
            "the servo loop; the move to the start",
        ),
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
    let reach_mm = if plan.may_step { vec![] } else { reach.to_vec() };
    let largest = peaks.0.into_iter().flatten().collect();
    Ok((Proof { proven, not_proven, largest, reach_mm }, reach))
}

/// Refuses a program that leaves the travel of an axis; `reach` is the lowest and highest position of each.
fn check_reach<const N: usize>(plan: &AxesPlan<N>, reach: &[[f64; 2]; N]) -> Result<(), Invalid> {
    for (limits, [low, high]) in plan.axes.iter().zip(*reach) {
        let Some([from, to]) = limits.travel else { continue };
        let beyond = (from - low).max(high - to);
        if exceeds(beyond, TRAVEL) {
            let name = limits.name;
            let unit = limits.unit();
            let problem = format!(
                "{name} goes from {low:.6} to {high:.6} {unit}, {beyond:.6} {unit} beyond its travel from {from} to {to} \
                 {unit}"
            );
            return Err(Invalid::whole("program", problem, remedy_of_travel(plan)));
        }
    }
    Ok(())
}

/// Refuses steps of the acceleration that exceed what a limit on jerk allows.
fn check_acceleration_steps<const N: usize>(
    plan: &AxesPlan<N>,
    pieces: &[ExecutedCubic<N>],
) -> Result<(), Invalid> {
    for step in acceleration_steps(pieces, plan.axes) {
        if !exceeds(step.value, step.allowed * (1.0 + LIMIT_ROUNDING)) {
            continue;
        }
        let limits = &plan.axes[step.axis];
        let problem = format!(
            "{} steps by {:.6} {unit}/s^2 in its acceleration, where the jerk limit allows {:.6} {unit}/s^2",
            limits.name,
            step.value,
            step.allowed,
            unit = limits.unit()
        );
        return Err(Invalid::at_index("node", step.node, problem, REMEDY_OF_ROUNDING));
    }
    Ok(())
}

/// Returns the coefficients of the polynomial `c` and of its first, second and third derivative.
fn derivatives(c: &[f64; 4]) -> [[f64; 4]; 4] {
    let v = derivative(c);
    let a = derivative(&v);
    [*c, v, a, derivative(&a)]
}

type Limited<'a> = (&'static str, &'static str, f64, &'a [f64; 4]);

/// Returns the limited quantities of an axis, each as name, unit, limit and polynomial: velocity, acceleration and,
/// with a limit on it, jerk. `orders` are the coefficients of its position and of the first three derivatives.
fn limited<'a>(
    limits: &MachineAxis,
    orders: &'a [[f64; 4]; 4],
) -> impl Iterator<Item = Limited<'a>> {
    let [_, v, a, j] = orders;
    let units = units(limits);
    let jerk = limits.max_jerk.map(|limit| ("jerk", units[3], limit, j));
    [
        ("velocity", units[1], limits.max_velocity, v),
        ("acceleration", units[2], limits.max_acceleration, a),
    ]
    .into_iter()
    .chain(jerk)
}

/// Returns the units of position, velocity, acceleration and jerk of an axis.
fn units(axis: &MachineAxis) -> [&'static str; 4] {
    if axis.is_rotary {
        ["deg", "deg/s", "deg/s^2", "deg/s^3"]
    } else {
        ["mm", "mm/s", "mm/s^2", "mm/s^3"]
    }
}

/// Returns true if `value` is beyond `limit`, or is not a number.
fn exceeds(value: f64, limit: f64) -> bool {
    value > limit || value.is_nan()
}

/// Returns the largest step in the velocity of an axis that counts as rounding, in the unit of the axis per s.
fn velocity_step(limits: &MachineAxis) -> f64 {
    STEP_PER_S + LIMIT_ROUNDING * limits.max_velocity
}

/// Name of a limited quantity, and its index in [`Peaks`].
struct What<'a> {
    slot: usize,
    axis: &'a str,
    name: &'static str,
    unit: &'static str,
}

/// The largest value of velocity, acceleration and jerk of every axis, and the shortest duration of a segment; `None`
/// where there is no limit.
struct Peaks(Vec<Option<Peak>>);

const REMEDY_OF_ROUNDING: &str = "give a smaller count or tick, or plan with lower limits";

impl Peaks {
    /// Keeps the `value` of a segment if it is the worst so far. Refuses it if `used`, the fraction of its `limit`, is
    /// above 1. `what` names the quantity.
    fn take(
        &mut self,
        segment: usize,
        what: &What,
        value: f64,
        limit: f64,
        used: f64,
    ) -> Result<(), Invalid> {
        let quantity = format!("{} {}", what.axis, what.name);
        let unit = what.unit;
        if exceeds(used, 1.0 + LIMIT_ROUNDING) {
            let problem = format!(
                "{quantity} is {value:.6} {unit} in the program, the limit is {limit} {unit}"
            );
            return Err(Invalid::at_index("segment", segment, problem, REMEDY_OF_ROUNDING));
        }
        let is_duration = what.slot + 1 == self.0.len();
        let slot = &mut self.0[what.slot];
        let is_worse = slot
            .as_ref()
            .is_none_or(|old| if is_duration { value < old.value } else { value > old.value });
        if is_worse {
            *slot = Some(Peak { quantity, unit, value, limit, segment });
        }
        Ok(())
    }
}

/// The worst excess of a plan so far: its ratio to the limit, and the error that describes it.
struct WorstExcess {
    fault: Option<(f64, Invalid)>,
    remedy: &'static str,
}

const REMEDY: &str = "schedule for this machine with planish schedule pvt or stop-at-corners, \
                      and see planish verify";
const REMEDY_OF_AXES: &str = "make the motion for this machine with planish axes motion, from a plan that rests at both \
                              ends, and see planish verify --axes";

impl WorstExcess {
    /// Keeps a fault if its `ratio` to the limit is the worst so far; `make` returns the error.
    fn add(&mut self, ratio: f64, make: impl FnOnce() -> Invalid) {
        if self.fault.as_ref().is_none_or(|(worst, _)| exceeds(ratio, *worst)) {
            self.fault = Some((ratio, make()));
        }
    }

    /// Adds the largest value of a quantity of segment `i`, at the time `at_s`, if it is beyond its limit.
    fn most(
        &mut self,
        i: usize,
        (axis, name, unit): (&str, &str, &str),
        value: f64,
        at_s: f64,
        limit: f64,
    ) {
        let remedy = self.remedy;
        if exceeds(value, limit * (1.0 + LIMIT_ROUNDING)) {
            self.add(value / limit, || {
                let problem = format!(
                    "{axis} {name} reaches {value:.6} {unit} after {at_s:.6} s, the limit is {limit} {unit}"
                );
                Invalid::at_index("segment", i, problem, remedy)
            });
        }
    }

    /// Adds the steps of position, velocity and acceleration at the start of segment `i`; after the last segment the
    /// axis rests. `beside_s` is the duration of both segments if the acceleration may step, else 0. `before` and
    /// `after` are position, velocity and acceleration on both sides.
    fn steps(
        &mut self,
        i: usize,
        before: [f64; 3],
        after: [f64; 3],
        limits: &MachineAxis,
        beside_s: f64,
    ) {
        let remedy = self.remedy;
        let acceleration = limits.max_jerk.map_or(f64::INFINITY, |jerk| {
            ACCELERATION_STEP * limits.max_acceleration + 0.5 * jerk * beside_s
        });
        let units = units(limits);
        for (name, unit, order, allowed) in [
            ("position", units[0], 0, STEP),
            ("velocity", units[1], 1, velocity_step(limits)),
            ("acceleration", units[2], 2, acceleration),
        ] {
            let step = after[order] - before[order];
            if exceeds(step.abs(), allowed) {
                self.add(f64::INFINITY, || {
                    let axis = limits.name;
                    let problem = format!(
                        "begins with a step of {step:.6} {unit} in the {name} of {axis}, where \
                         {allowed:.1e} {unit} is rounding (the machine rests before and after the motion)"
                    );
                    Invalid::at_index("segment", i, problem, remedy)
                });
            }
        }
    }

    /// Returns the worst fault as an error; `Ok` if the plan has none. `machine` is the name in the message.
    fn verdict(self, machine: &str) -> Result<(), Invalid> {
        match self.fault {
            None => Ok(()),
            Some((_, mut invalid)) => {
                let machine: String = machine.escape_debug().collect();
                invalid.problem += &format!(" (machine \"{machine}\")");
                Err(invalid)
            }
        }
    }
}

/// Refuses times and coefficients so large that their products would overflow.
fn check_magnitudes<const N: usize>(plan: &AxesPlan<N>) -> Result<(), Invalid> {
    let large = |v: &f64| v.abs() > LARGEST_NUMBER;
    let remedy = "numbers beyond 1e60 are not mm and s; check the units";
    if let Some(i) = plan.break_time_s.iter().position(large) {
        return Err(Invalid::at_index("break_time_s", i, "is beyond 1e60 s", remedy));
    }
    if let Some(i) = plan.coefficient.iter().position(|c| c.iter().flatten().any(large)) {
        let name = if plan.may_step { "coefficient_mm_or_deg" } else { "coefficient_mm" };
        return Err(Invalid::at_index(name, i, "is beyond 1e60", remedy));
    }
    Ok(())
}
