//! Verdict: does a trajectory keep the limits of a machine? Proven from the polynomials, never from samples.
//!
//! ```text
//! p(u) = c0 + c1 u + c2 u^2 + c3 u^3      u in [0, h], per segment and axis
//! v = p',  a = p'',  j = p'''             largest and smallest value: ends and roots of the
//!                                         next derivative inside (0, h)
//! step at a break = value after - value before
//! ```
//!
//! The machine is at rest before the first and after the last break, so the velocity and the
//! acceleration there are steps too. A step in position is a jump; a step in velocity is an
//! infinite acceleration; a step in acceleration is an infinite jerk, and counts only against a
//! machine with a limit on jerk. Where an axis has a travel, its position stays within it.
//!
//! A program of a controller ([`VerifySettings::program`]) gives positions and velocities at nodes, and the controller
//! runs cubics between them, whose acceleration steps at every node. With a limit J on jerk it may step by
//!
//! ```text
//! J (T1 + T2) / 2                        T1, T2 = times of the segments beside the node                (1)
//! ```
//!
//! which a motion within the limit may do from the middle of one segment to the middle of the next. Cubics through
//! nodes of a motion within the limit step by at most 8/27 J (T1 + T2) and have a jerk of at most J inside (Peano
//! kernels of the cubic Hermite interpolant); the rest of (1) is for the rounding of the nodes to the grids of the
//! controller. A program of straight lines leaves it to its controller how it joins them, so that its jerk is not
//! judged.
//!
//! A motion of all axes of a machine ([`verify_axes`]) is such a program: a controller runs it as cubics between nodes.
//!
//! Source: the extreme value theorem; for cubics in Hermite form de Boor, *A Practical Guide to
//! Splines*, chapter IV. The judge shares no code with the schedulers that it judges.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | c | `coefficient_mm` | (k, 2, 4) | mm/s^order |
//! | h | `duration_s` | (k) | s |
//! | v, a, j | [`AxisVerdict`] | per axis | mm/s, mm/s^2, mm/s^3 |

// The command line names this library as any other program does.
extern crate self as planish_verify;

pub mod command;
mod tally;
mod verdict;

use planish_numerics::polynomial::{derivative, evaluate, range};
pub use planish_types::outcome::verdict::{
    AxesVerdict, AxisVerdict, Check, Excursions, MachineAxisVerdict, PlacedValue, Verdict,
};
use planish_types::{AxesMotion, Invalid, Limits, Machine, MachineAxis, Trajectory};
use serde::Serialize;

use tally::{Bound, Tally};
use verdict::{Span, add_excursion};

/// Excess over a limit that is taken for rounding, relative to the limit.
///
/// A scheduler that uses a limit fully reaches it up to rounding. The rounding of its coefficients
/// is about 1e-13 relative. The rounding of a break time is 1e-13 s at 500 s, which is 1e-10 of a
/// segment of 1 ms. Smaller: such motions fail. Larger: real excesses pass. No drive resolves 1e-9
/// of its limit.
pub const LIMIT_ALLOWANCE: f64 = 1e-9;

/// Allowance for a step in velocity, relative to the largest velocity; added to the tolerance of
/// the settings.
///
/// The velocity before a break is a sum of terms up to the largest velocity, so its rounding is
/// relative to that. Smaller: rounding at high velocities fails. Larger: real steps pass. Derived:
/// the same 1e-9 as [`LIMIT_ALLOWANCE`].
const VELOCITY_STEP_ALLOWANCE: f64 = 1e-9;

/// Allowance for a step in acceleration, relative to the largest acceleration.
///
/// Smaller: the rounding of a continuous acceleration fails. It is `6 dp / h^2`, which is 1e-8
/// mm/s^2 for a position of 100 mm and h = 3 ms. Larger: real steps pass. No drive notices a step
/// of 1e-6 of its limit.
const ACCELERATION_STEP_ALLOWANCE: f64 = 1e-6;

/// Smallest excursion beyond the ends of a segment that counts, mm. Smaller: rounding counts (2e-13
/// mm for a coordinate of 1 m). Larger: small overshoots are missed. Chosen: far above rounding,
/// and far below any motion that changes the removal.
const EXCURSION_NOISE_MM: f64 = 1e-9;

/// Smallest distance outside the travel that counts, mm or deg. Smaller: rounding counts, also that of the
/// rotation from the part to the axes. Larger: small excursions are missed. Chosen as
/// [`EXCURSION_NOISE_MM`].
const TRAVEL_NOISE_MM: f64 = 1e-9;

/// Smallest speed against the direction of a segment that counts, mm/s. Smaller: rounding counts.
/// Larger: slow reversals are missed. Chosen: far above the rounding of a velocity.
const REVERSAL_NOISE_MM_PER_S: f64 = 1e-6;

/// Largest magnitude of a coefficient or a time, in mm/s^order, deg/s^order or s. [`verify`] refuses larger
/// ones. Derived: squares and cubes of numbers up to 1e60 are finite, so no comparison meets an
/// infinity. No length in mm and no time in s comes near it.
const LARGEST_NUMBER: f64 = 1e60;

const REMEDY_OF_NUMBERS: &str = "numbers beyond 1e60 are not mm and s; check the units";

/// Units of position, velocity, acceleration and jerk of a linear axis; [`UNITS_DEG`] has those of a rotary axis.
const UNITS_MM: [&str; 4] = ["mm", "mm/s", "mm/s^2", "mm/s^3"];
const UNITS_DEG: [&str; 4] = ["deg", "deg/s", "deg/s^2", "deg/s^3"];

/// Law by which a controller runs the motion between the nodes of its program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Program {
    /// Along cubics through positions and velocities. With a limit on jerk their acceleration may step at a node, by
    /// (1) of the module at most.
    Cubics,
    /// Along straight lines, which the controller joins in its own way; a limit on jerk is not judged.
    Lines,
}

/// Thresholds above which a change counts as a step, and the law of a controller's program.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct VerifySettings {
    /// Largest step in position that is taken for rounding, mm. Default 1e-6 mm = 1 nm: below the
    /// count of a stage's encoder, and equal to the tolerance to which curved motions are fitted.
    pub position_step_mm: f64,
    /// Largest step in velocity that is taken for rounding, mm/s; 1e-9 of the largest velocity is
    /// added. Default 1e-6 mm/s. Rounding of the break times causes steps of `a ulp(t)`: 3e-8 mm/s
    /// at 2000 mm/s^2 and 1e5 s. At only 10 mm/s^2, a drive takes 0.1 us for 1e-6 mm/s, less than
    /// any servo cycle.
    pub velocity_step_mm_per_s: f64,
    /// Law of the controller's program that the motion was read from. Default `None`: the motion is no program, and a
    /// limit on jerk allows no step of the acceleration.
    pub program: Option<Program>,
}

impl Default for VerifySettings {
    fn default() -> Self {
        Self { position_step_mm: 1e-6, velocity_step_mm_per_s: 1e-6, program: None }
    }
}

/// Judges the motion of the axes x and y of `machine` against its limits and its travel.
///
/// Refuses the same inputs as [`verify`].
pub fn verify_on_axes(
    motion: &Trajectory,
    machine: &Machine,
    settings: &VerifySettings,
) -> Result<Verdict, Invalid> {
    judge(motion, machine.limits(), machine.travel_mm(), settings)
}

/// Judges `trajectory` against `limits` of the axes x and y, without any travel.
///
/// Refuses tolerances that are negative or not finite, and coefficients or times beyond 1e60. It
/// passes over the segments once; its memory does not depend on their number.
pub fn verify(
    trajectory: &Trajectory,
    limits: &Limits,
    settings: &VerifySettings,
) -> Result<Verdict, Invalid> {
    judge(trajectory, limits, &[None; 2], settings)
}

fn judge(
    trajectory: &Trajectory,
    limits: &Limits,
    travel_mm: &[Option<[f64; 2]>; 2],
    settings: &VerifySettings,
) -> Result<Verdict, Invalid> {
    check_settings(settings)?;
    check_magnitudes(trajectory)?;
    let mut axes = [0, 1].map(|axis| {
        let axis = MachineAxis::linear(&limits.axes()[axis], travel_mm[axis]);
        AxisTally::new(&axis, settings)
    });
    let mut duration = durations(limits);
    for (i, segment) in trajectory.segments().enumerate() {
        let span = Span::new(&segment);
        add_duration(&mut duration, i, &span);
        for (axis, tally) in axes.iter_mut().enumerate() {
            tally.add_segment(i, &span, &segment.coefficient_mm[axis]);
        }
    }
    let last = Span::new(&trajectory.segment(trajectory.len() - 1));
    for tally in &mut axes {
        tally.add_stop(trajectory.len(), &last);
    }

    let [x, y] = axes.map(AxisTally::finish);
    Ok(verdict::verdict(trajectory, [x, y], duration.finish()))
}

/// Judges a motion of all axes of `machine` against their limits and travels. It is judged as a program of cubics,
/// whose acceleration may step at a break by (1) of the module, unless the settings say that it is one of lines.
///
/// Refuses the same inputs as [`verify`], and a motion whose number of axes is not that of the machine.
pub fn verify_axes(
    motion: &AxesMotion,
    machine: &Machine,
    settings: &VerifySettings,
) -> Result<AxesVerdict, Invalid> {
    let program = settings.program.unwrap_or(Program::Cubics);
    let settings = VerifySettings { program: Some(program), ..*settings };
    check_settings(&settings)?;
    let axes = machine.axes();
    if motion.axes() != axes.len() {
        let names: Vec<&str> = axes.iter().map(|a| a.name).collect();
        let problem =
            format!("has {} axes, and the machine has {}", motion.axes(), names.join(", "));
        let remedy = "give the machine file that the motion was made for";
        return Err(Invalid::whole("coefficient_mm_or_deg", problem, remedy));
    }
    check_times(motion.break_time_s())?;
    let mut tallies: Vec<AxisTally> =
        axes.iter().map(|axis| AxisTally::new(axis, &settings)).collect();
    let mut duration = durations(machine.limits());
    for i in 0..motion.len() {
        let cubics = motion.segment(i);
        if cubics.iter().flatten().any(|c| c.abs() > LARGEST_NUMBER) {
            let problem = format!("is {cubics:?}");
            return Err(Invalid::at_index("coefficient_mm_or_deg", i, problem, REMEDY_OF_NUMBERS));
        }
        let span = Span::of_axes(motion, i);
        add_duration(&mut duration, i, &span);
        for (tally, c) in tallies.iter_mut().zip(cubics) {
            tally.add_segment(i, &span, c);
        }
    }
    let last = Span::of_axes(motion, motion.len() - 1);
    for tally in &mut tallies {
        tally.add_stop(motion.len(), &last);
    }
    let verdicts = tallies.into_iter().zip(axes);
    let verdicts = verdicts.map(|(tally, axis)| tally.finish_for(axis.unit())).collect();
    Ok(verdict::axes_verdict(motion, verdicts, duration.finish()))
}

/// Returns the empty tally of the durations of segments, with the shortest one that the controller accepts as its
/// bound.
fn durations(limits: &Limits) -> Tally {
    let least_s = limits.min_segment_s();
    let bound = if least_s > 0.0 { Some(Bound::AtLeast(least_s)) } else { None };
    Tally::new("segment duration", "s", bound)
}

fn add_duration(duration: &mut Tally, i: usize, span: &Span) {
    // The duration is the difference of two rounded break times.
    let rounding_s = 2.0 * f64::EPSILON * (span.start_s.abs() + span.duration_s);
    let place = span.place(i, 0.0, span.duration_s);
    duration.add(place, place, rounding_s);
}

/// Position, velocity and acceleration of an axis at an instant, in mm or deg and s.
type State = [f64; 3];

/// Ranges, steps and excursions of one axis over the segments so far.
struct AxisTally {
    name: &'static str,
    travel: Option<[f64; 2]>,
    /// Ranges of position, velocity, acceleration and jerk.
    ranges: [Tally; 4],
    /// Steps at the breaks of position, velocity and acceleration.
    steps: [Tally; 3],
    overshoot: Excursions,
    reversal: Excursions,
    /// Half the jerk limit if the motion is a program of cubics, else 0. Times the durations of both segments beside a
    /// break it is the allowed step of the acceleration, (1) of the module.
    step_per_s: f64,
    /// State before the next break, and duration of the segment that ends there, s; `None` before the first segment.
    before: Option<(State, f64)>,
}

impl AxisTally {
    fn new(axis: &MachineAxis, settings: &VerifySettings) -> Self {
        let v = axis.max_velocity;
        let a = axis.max_acceleration;
        let velocity_step = settings.velocity_step_mm_per_s + VELOCITY_STEP_ALLOWANCE * v;
        // Without a limit on jerk any step in acceleration is allowed.
        let acceleration_step = axis.max_jerk.map(|_| ACCELERATION_STEP_ALLOWANCE * a);
        let acceleration_step = acceleration_step.and_then(|tolerance| match settings.program {
            None => Some(Bound::StepWithin(tolerance)),
            Some(Program::Cubics) => Some(Bound::StepOfProgram(tolerance)),
            Some(Program::Lines) => None,
        });
        let position_step = Bound::StepWithin(settings.position_step_mm);
        let velocity_step = Bound::StepWithin(velocity_step);
        let jerk = axis.max_jerk.map(Bound::Within);
        let name = axis.name;
        let travel = axis.travel;
        let units = if axis.is_rotary { UNITS_DEG } else { UNITS_MM };
        Self {
            ranges: [
                Tally::new(format!("{name} position"), units[0], travel.map(Bound::Between)),
                Tally::new(format!("{name} velocity"), units[1], Some(Bound::Within(v))),
                Tally::new(format!("{name} acceleration"), units[2], Some(Bound::Within(a))),
                Tally::new(format!("{name} jerk"), units[3], jerk),
            ],
            steps: [
                Tally::new(format!("{name} position"), units[0], Some(position_step)),
                Tally::new(format!("{name} velocity"), units[1], Some(velocity_step)),
                Tally::new(format!("{name} acceleration"), units[2], acceleration_step),
            ],
            step_per_s: match settings.program {
                Some(Program::Cubics) => 0.5 * axis.max_jerk.unwrap_or_default(),
                _ => 0.0,
            },
            name,
            travel,
            overshoot: Excursions { noise: EXCURSION_NOISE_MM, ..Excursions::default() },
            reversal: Excursions { noise: REVERSAL_NOISE_MM_PER_S, ..Excursions::default() },
            before: None,
        }
    }

    /// Adds segment `i`, with the coefficients `c` of this axis, and the steps at the break at which it starts.
    fn add_segment(&mut self, i: usize, segment: &Span, c: &[f64; 4]) {
        let h = segment.duration_s;
        // p, v = p', a = p'', j = p'''
        let v = derivative(c);
        let a = derivative(&v);
        let orders = [*c, v, a, derivative(&a)];
        let ranges = orders.map(|q| range(&q, h));
        let roundings = [TRAVEL_NOISE_MM, 0.0, 0.0, 0.0];
        for ((tally, r), rounding) in self.ranges.iter_mut().zip(&ranges).zip(roundings) {
            tally.add(
                segment.place(i, r.min_at, r.min),
                segment.place(i, r.max_at, r.max),
                rounding,
            );
        }

        let [start, end] = [0.0, h].map(|u| [0, 1, 2].map(|order| evaluate(&orders[order], u)));
        self.add_steps(start, h, segment.place(i, 0.0, 0.0));
        self.before = Some((end, h));

        // Distance of the position from the interval between both ends of its own segment.
        let (low, high) = (start[0].min(end[0]), start[0].max(end[0]));
        let [p, v] = [&ranges[0], &ranges[1]];
        let above = p.max - high;
        let below = low - p.min;
        let farthest = if below > above { p.min_at } else { p.max_at };
        add_excursion(&mut self.overshoot, segment.place(i, farthest, above.max(below)));
        // A velocity of both signs: the slower of the two directions is the reverse one.
        let slower = if -v.min < v.max { v.min_at } else { v.max_at };
        add_excursion(&mut self.reversal, segment.place(i, slower, v.max.min(-v.min)));
    }

    /// Adds the steps at the break at `place`. `after` is the state after it, and `after_s` the duration of the segment
    /// that begins there.
    fn add_steps(&mut self, after: State, after_s: f64, place: PlacedValue) {
        // Before the first break the machine stands where the motion starts.
        let (before, before_s) = self.before.unwrap_or(([after[0], 0.0, 0.0], 0.0));
        let allowed = [0.0, 0.0, self.step_per_s * (before_s + after_s)];
        for (order, tally) in self.steps.iter_mut().enumerate() {
            let step = PlacedValue { value: after[order] - before[order], ..place };
            tally.add(step, step, allowed[order]);
        }
    }

    /// Adds the steps at the last break, of the number `index`; after it the machine rests where the motion ends.
    fn add_stop(&mut self, index: usize, last: &Span) {
        let position = self.before.map_or(0.0, |(before, _)| before[0]);
        self.add_steps([position, 0.0, 0.0], 0.0, last.place(index, last.duration_s, 0.0));
    }

    fn finish(self) -> AxisVerdict {
        let [position_mm, velocity_mm_per_s, acceleration_mm_per_s2, jerk_mm_per_s3] =
            self.ranges.map(Tally::finish);
        let [position_step_mm, velocity_step_mm_per_s, acceleration_step_mm_per_s2] =
            self.steps.map(Tally::finish);
        AxisVerdict {
            name: self.name.into(),
            travel_mm: self.travel,
            position_mm,
            velocity_mm_per_s,
            acceleration_mm_per_s2,
            jerk_mm_per_s3,
            position_step_mm,
            velocity_step_mm_per_s,
            acceleration_step_mm_per_s2,
            overshoot_mm: self.overshoot,
            reversal_mm_per_s: self.reversal,
        }
    }

    /// Returns the verdict on an axis of a motion of all axes, whose positions have the unit `unit`.
    fn finish_for(self, unit: &'static str) -> MachineAxisVerdict {
        let [position, velocity, acceleration, jerk] = self.ranges.map(Tally::finish);
        let [position_step, velocity_step, acceleration_step] = self.steps.map(Tally::finish);
        MachineAxisVerdict {
            name: self.name.into(),
            unit: unit.into(),
            travel: self.travel,
            position,
            velocity,
            acceleration,
            jerk,
            position_step,
            velocity_step,
            acceleration_step,
        }
    }
}

fn check_settings(settings: &VerifySettings) -> Result<(), Invalid> {
    for (name, value) in [
        ("position_step_mm", settings.position_step_mm),
        ("velocity_step_mm_per_s", settings.velocity_step_mm_per_s),
    ] {
        if !(value.is_finite() && value >= 0.0) {
            let problem = format!("is {value}");
            return Err(Invalid::whole(name, problem, "a tolerance is finite and not negative"));
        }
    }
    Ok(())
}

fn check_times(times: &[f64]) -> Result<(), Invalid> {
    match times.iter().position(|t| t.abs() > LARGEST_NUMBER) {
        None => Ok(()),
        Some(i) => Err(Invalid::at_index(
            "break_time_s",
            i,
            format!("is {} s", times[i]),
            REMEDY_OF_NUMBERS,
        )),
    }
}

fn check_magnitudes(trajectory: &Trajectory) -> Result<(), Invalid> {
    check_times(trajectory.break_time_s())?;
    let coefficients = trajectory.coefficient_mm();
    let too_large = coefficients
        .iter()
        .position(|axes| axes.iter().flatten().any(|c| c.abs() > LARGEST_NUMBER));
    if let Some(i) = too_large {
        let problem = format!("is {:?}", coefficients[i]);
        return Err(Invalid::at_index("coefficient_mm", i, problem, REMEDY_OF_NUMBERS));
    }
    Ok(())
}
