//! The verdict of all segments: numbers for programs, one sentence for people.

use planish_types::{
    AxesMotion, Segment, Trajectory,
    outcome::verdict::{
        AxesVerdict, AxisVerdict, Check, Excursions, MachineAxisVerdict, PlacedValue, Verdict,
    },
};

use crate::LIMIT_ALLOWANCE;

/// Times and dwell point of a segment, without its polynomials.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    pub(crate) start_s: f64,
    pub(crate) duration_s: f64,
    pub(crate) dwell_index: Option<usize>,
}

impl Span {
    pub(crate) fn new(segment: &Segment<'_>) -> Self {
        let Segment { start_s, duration_s, dwell_index, .. } = *segment;
        Self { start_s, duration_s, dwell_index }
    }

    pub(crate) fn of_axes(motion: &AxesMotion, i: usize) -> Self {
        let start_s = motion.break_time_s()[i];
        let dwell_index = motion.dwell_index()[i];
        Self { start_s, duration_s: motion.duration_s(i), dwell_index }
    }

    /// Returns `value` with its position in the motion: the segment of the number `index`, at the local time `u_s`.
    pub(crate) fn place(&self, index: usize, u_s: f64, value: f64) -> PlacedValue {
        PlacedValue { index, dwell_index: self.dwell_index, time_s: self.start_s + u_s, value }
    }
}

/// Adds an excursion at `place` to the count and the maximum, unless it is within the noise.
pub(crate) fn add_excursion(excursions: &mut Excursions, place: PlacedValue) {
    if place.value > excursions.noise {
        excursions.count += 1;
        if excursions.largest.is_none_or(|largest| place.value > largest.value) {
            excursions.largest = Some(place);
        }
    }
}

/// Returns the checks of an axis of a motion in the plane that can fail, the gravest first.
fn checks(axis: &AxisVerdict) -> [&Check; 7] {
    [
        &axis.position_mm,
        &axis.position_step_mm,
        &axis.velocity_step_mm_per_s,
        &axis.velocity_mm_per_s,
        &axis.acceleration_mm_per_s2,
        &axis.jerk_mm_per_s3,
        &axis.acceleration_step_mm_per_s2,
    ]
}

/// Returns the checks of an axis of a motion of all axes that can fail, the gravest first.
fn machine_checks(axis: &MachineAxisVerdict) -> [&Check; 7] {
    [
        &axis.position,
        &axis.position_step,
        &axis.velocity_step,
        &axis.velocity,
        &axis.acceleration,
        &axis.jerk,
        &axis.acceleration_step,
    ]
}

/// Returns one sentence per exceeded limit, sorted by kind of limit, then by axis.
fn violations(axes: &[[&Check; 7]], segment_duration_s: &Check) -> Vec<String> {
    let by_kind = (0..7).flat_map(|kind| axes.iter().map(move |axis| axis[kind]));
    by_kind.chain([segment_duration_s]).filter_map(|c| c.complaint.clone()).collect()
}

/// Returns the verdict on a motion in the plane, from the verdicts on its axes x and y.
pub(crate) fn verdict(
    trajectory: &Trajectory,
    axes: [AxisVerdict; 2],
    segment_duration_s: Check,
) -> Verdict {
    let violations = violations(&axes.each_ref().map(checks), &segment_duration_s);
    let magnitude =
        |check: fn(&AxisVerdict) -> &Check| axes.each_ref().map(|axis| check(axis).magnitude());
    Verdict {
        limits_respected: violations.is_empty(),
        violations,
        total_time_s: trajectory.total_time_s(),
        segment_count: trajectory.len(),
        max_velocity_mm_per_s: magnitude(|a| &a.velocity_mm_per_s),
        max_acceleration_mm_per_s2: magnitude(|a| &a.acceleration_mm_per_s2),
        max_jerk_mm_per_s3: magnitude(|a| &a.jerk_mm_per_s3),
        max_position_step_mm: magnitude(|a| &a.position_step_mm),
        max_velocity_step_mm_per_s: magnitude(|a| &a.velocity_step_mm_per_s),
        max_acceleration_step_mm_per_s2: magnitude(|a| &a.acceleration_step_mm_per_s2),
        max_overshoot_mm: axes.each_ref().map(|a| a.overshoot_mm.largest.map_or(0.0, |l| l.value)),
        limit_allowance: LIMIT_ALLOWANCE,
        segment_duration_s,
        axes,
        path_distance: None,
        machine: None,
        part_to_axes: None,
    }
}

/// Returns the verdict on a motion of all axes, from the verdicts on the axes.
pub(crate) fn axes_verdict(
    motion: &AxesMotion,
    axes: Vec<MachineAxisVerdict>,
    segment_duration_s: Check,
) -> AxesVerdict {
    let checks: Vec<[&Check; 7]> = axes.iter().map(machine_checks).collect();
    let violations = violations(&checks, &segment_duration_s);
    AxesVerdict {
        limits_respected: violations.is_empty(),
        violations,
        total_time_s: motion.total_time_s(),
        segment_count: motion.len(),
        limit_allowance: LIMIT_ALLOWANCE,
        segment_duration_s,
        axes,
        machine: None,
    }
}
