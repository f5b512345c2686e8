//! Claim of a schedule: the limits of the machine that its motion keeps, measured on the cubics of the motion.
//!
//! ```text
//! v(u) = c1 + 2 c2 u + 3 c3 u^2      largest at an end or at u = -c2 / (3 c3)
//! a(u) = 2 c2 + 6 c3 u               largest at an end
//! j    = 6 c3
//! ```
//!
//! The claim goes into the manifest of every schedule. `planish verify`, which shares no code with this file, must come
//! to the same result. A step (jump) below the tolerances counts as rounding: the motion is then continuous.

pub use planish_types::outcome::plan::Claim;
use planish_types::{Limits, Trajectory, plausible};

/// Largest step of the position that counts as continuous, mm: rounding, or the default tolerance of
/// the fit of `trig_spline`. Larger: real jumps are missed. Smaller: fitted motions count as jumps.
const POSITION_STEP_MM: f64 = 1e-6;

/// Largest step of the velocity that counts as continuous, mm/s; 1e-9 of the limit is added. It
/// covers the rounding of break times. Larger: real steps are missed. Smaller: rounding is reported.
const VELOCITY_STEP_MM_PER_S: f64 = 1e-6;

/// Excess over a limit that counts as rounding, relative to the limit. Larger: real excesses are
/// missed. Smaller: motions exactly at a limit are reported.
const ROUNDING: f64 = 1e-9;

/// Largest step of the acceleration that counts as continuous, relative to its limit. Larger: real
/// steps are missed. Smaller: rounding of the coefficients is reported as a step.
const ACCELERATION_STEP: f64 = 1e-6;

/// Advice for the motion of a baseline (`position`, `average-velocity`), which no machine can execute.
pub const JUMPS: &str = "its position or its velocity jumps, which no machine can do";

/// Returns the claim: the limits that `trajectory` keeps, measured on its polynomials. Before the first and after the
/// last segment the tool counts as at rest.
pub fn measured_claim(trajectory: &Trajectory, limits: &Limits) -> Claim {
    let mut claim = Claim {
        limits_respected: false,
        continuous_position: true,
        continuous_velocity: true,
        velocity: true,
        acceleration: true,
        jerk: None,
        jerk_inside_segments: None,
        min_segment: true,
        max_jerk_mm_per_s3: [0.0; 2],
        max_acceleration_step_mm_per_s2: [0.0; 2],
    };
    for s in trajectory.segments() {
        // The duration is the difference of two sums up to the end of the segment.
        let rounding_s = 2.0 * f64::EPSILON * (s.start_s.abs() + s.duration_s);
        let least_s = limits.min_segment_s() * (1.0 - ROUNDING) - rounding_s;
        claim.min_segment &= s.duration_s >= least_s;
    }
    for axis in 0..2 {
        measure(&mut claim, trajectory, limits, axis);
    }
    claim.limits_respected = claim.continuous_position
        && claim.continuous_velocity
        && claim.velocity
        && claim.acceleration
        && claim.jerk.unwrap_or(true)
        && claim.min_segment;
    claim
}

fn measure(claim: &mut Claim, trajectory: &Trajectory, limits: &Limits, axis: usize) {
    let limit = &limits.axes()[axis];
    let v_max = limit.max_velocity_mm_per_s();
    let a_max = limit.max_acceleration_mm_per_s2();
    let velocity_step = VELOCITY_STEP_MM_PER_S + ROUNDING * v_max;
    // Position, velocity and acceleration before the next break; rest before the first one.
    let mut before: Option<[f64; 3]> = None;
    for s in trajectory.segments() {
        let c = &s.coefficient_mm[axis];
        let h = s.duration_s;
        let vertex = -c[2] / (3.0 * c[3]);
        let inner = if vertex > 0.0 && vertex < h { velocity(c, vertex) } else { 0.0 };
        let start = [c[0], velocity(c, 0.0), acceleration(c, 0.0)];
        let end = [c[0] + h * (c[1] + h * (c[2] + h * c[3])), velocity(c, h), acceleration(c, h)];
        claim.velocity &= [start[1], inner, end[1]].iter().all(|v| within(*v, v_max));
        claim.acceleration &= within(start[2], a_max) && within(end[2], a_max);
        claim.max_jerk_mm_per_s3[axis] = claim.max_jerk_mm_per_s3[axis].max(6.0 * c[3].abs());
        let before_start = before.unwrap_or([c[0], 0.0, 0.0]);
        measure_step(claim, axis, velocity_step, [before_start, start]);
        before = Some(end);
    }
    let end = before.unwrap_or_default();
    measure_step(claim, axis, velocity_step, [end, [end[0], 0.0, 0.0]]);
    if let Some(j_max) = limit.max_jerk_mm_per_s3() {
        let inside = within(claim.max_jerk_mm_per_s3[axis], j_max);
        let steps = claim.max_acceleration_step_mm_per_s2[axis] > ACCELERATION_STEP * a_max;
        let before = claim.jerk_inside_segments.unwrap_or(true);
        claim.jerk_inside_segments = Some(before && inside);
        claim.jerk = Some(claim.jerk.unwrap_or(true) && inside && !steps);
    }
}

/// Adds the steps at a break to the claim: `before` and `after` are position, velocity and acceleration of one axis
/// (mm, mm/s, mm/s^2) on the two sides. A velocity step above `velocity_step`, mm/s, makes the velocity discontinuous.
fn measure_step(
    claim: &mut Claim,
    axis: usize,
    velocity_step: f64,
    [before, after]: [[f64; 3]; 2],
) {
    claim.continuous_position &= (after[0] - before[0]).abs() <= POSITION_STEP_MM;
    claim.continuous_velocity &= (after[1] - before[1]).abs() <= velocity_step;
    let largest = &mut claim.max_acceleration_step_mm_per_s2[axis];
    *largest = largest.max((after[2] - before[2]).abs());
}

/// Returns true if the magnitude of a value exceeds its limit by rounding at most ([`ROUNDING`]).
fn within(value: f64, limit: f64) -> bool {
    value.abs() <= limit * (1.0 + ROUNDING)
}

/// Returns the velocity of the cubic with the coefficients `c` at the time `u` after its start, mm/s.
fn velocity(c: &[f64; 4], u: f64) -> f64 {
    c[1] + u * (2.0 * c[2] + 3.0 * c[3] * u)
}

/// Returns the acceleration of the cubic with the coefficients `c` at the time `u` after its start, mm/s^2.
fn acceleration(c: &[f64; 4], u: f64) -> f64 {
    2.0 * c[2] + 6.0 * c[3] * u
}

/// Returns one phrase per limit that the claim does not keep; empty if it keeps every limit.
pub fn broken_limits(claim: &Claim) -> Vec<&'static str> {
    let jerk = match claim.jerk_inside_segments {
        Some(true) => "the acceleration steps, which no limit on jerk allows",
        _ => "the jerk exceeds its limit",
    };
    let broken = [
        ("the position jumps", claim.continuous_position),
        ("the velocity steps", claim.continuous_velocity),
        ("the velocity exceeds its limit", claim.velocity),
        ("the acceleration exceeds its limit", claim.acceleration),
        (jerk, claim.jerk.unwrap_or(true)),
        ("segments are shorter than the controller accepts", claim.min_segment),
    ];
    broken.iter().filter(|(_, is_respected)| !is_respected).map(|(b, _)| *b).collect()
}

/// Returns the reason not to execute the motion; `None` if there is none. Reasons are an exceeded limit, followed by
/// the `advice` of the scheduler, or a run that takes too long.
pub fn drawback(claim: &Claim, total_time_s: f64, advice: Option<&str>) -> Option<String> {
    if claim.limits_respected {
        return plausible::too_long(total_time_s);
    }
    let advice = advice.map_or(String::new(), |advice| format!("; {advice}"));
    Some(format!("a limit of the machine is exceeded: {}{advice}", broken_limits(claim).join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{MachineFile, MachineFileAxis};

    fn limits(v: f64, a: f64, j: Option<f64>, min_segment_s: f64) -> Limits {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: v,
            max_acceleration_mm_per_s2: a,
            max_jerk_mm_per_s3: j,
            ..MachineFileAxis::default()
        };
        MachineFile {
            name: "m".into(),
            axes: vec![axis("x"), axis("y")],
            min_segment_s,
            ..MachineFile::default()
        }
        .checked()
        .unwrap()
    }

    /// Returns a motion of 1 mm in 1 s from rest to rest: v(1/2) = 1.5, |a| <= 6, j = -12 in mm and s.
    fn rest_to_rest() -> Trajectory {
        let c = [[0.0, 0.0, 3.0, -2.0], [0.0; 4]];
        Trajectory::new(vec![0.0, 1.0], vec![c], vec![true], vec![None]).unwrap()
    }

    #[test]
    fn every_limit_is_found_at_its_value() {
        let t = rest_to_rest();
        let kept = measured_claim(&t, &limits(1.5, 6.0, None, 1.0));
        assert!(kept.limits_respected);
        assert_eq!(drawback(&kept, 1.0, Some("see there")), None);
        assert!(drawback(&kept, 1e8, None).unwrap().contains("days"));
        assert!(!measured_claim(&t, &limits(1.499, 6.0, None, 1.0)).velocity);
        assert!(!measured_claim(&t, &limits(1.5, 5.999, None, 1.0)).acceleration);
        assert!(!measured_claim(&t, &limits(1.5, 6.0, None, 1.001)).min_segment);
        // The acceleration starts with a step, which no limit on jerk allows.
        let jerk = measured_claim(&t, &limits(1.5, 6.0, Some(13.0), 0.0));
        assert_eq!((jerk.jerk, jerk.limits_respected), (Some(false), false));
        assert_eq!(jerk.jerk_inside_segments, Some(true));
        assert_eq!(jerk.max_jerk_mm_per_s3, [12.0, 0.0]);
        assert_eq!(jerk.max_acceleration_step_mm_per_s2, [6.0, 0.0]);
        assert!(broken_limits(&jerk)[0].contains("the acceleration steps"));
        let drawback = drawback(&jerk, 1.0, Some("see there")).unwrap();
        assert!(
            drawback.ends_with("the acceleration steps, which no limit on jerk allows; see there")
        );
        let jerk = measured_claim(&t, &limits(1.5, 6.0, Some(11.0), 0.0));
        assert_eq!((jerk.jerk, jerk.jerk_inside_segments), (Some(false), Some(false)));
        assert_eq!(broken_limits(&jerk), ["the jerk exceeds its limit"]);
    }

    #[test]
    fn jumps_and_a_moving_start_are_steps() {
        let at = |x: f64, v: f64| [[x, v, 0.0, 0.0], [0.0; 4]];
        let t = |c: Vec<[[f64; 4]; 2]>| {
            Trajectory::new(vec![0.0, 1.0, 2.0], c, vec![true; 2], vec![None; 2]).unwrap()
        };
        let free = limits(1e3, 1e9, None, 0.0);
        let jump = measured_claim(&t(vec![at(0.0, 0.0), at(1.0, 0.0)]), &free);
        assert!(!jump.continuous_position && jump.continuous_velocity);
        let moving = measured_claim(&t(vec![at(0.0, 1.0), at(1.0, 1.0)]), &free);
        assert!(moving.continuous_position && !moving.continuous_velocity);
    }
}
