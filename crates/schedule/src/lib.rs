//! Tool path and dwell times become a motion.
//!
//! Every scheduler is a file or a folder of the same shape: `Settings`, `schedule`, and what it reports
//! beside the trajectory.
//!
//! | scheduler | motion |
//! |---|---|
//! | [`pvt`] | cubic Hermite segments through the control points at the dwell times |
//! | [`pvt_as_published`] | the same by the least squares of its source, whose defects it reports |
//! | [`constant_acceleration`] | one constant acceleration, then constant velocity, per segment |
//! | [`stop_at_corners`] | the same along the path, at rest in corners, within all limits |
//! | [`trig_spline`] | dwell-time density as a half-period trigonometric spline of arc length |
//! | [`average_velocity`] | constant velocity per segment (a baseline: its velocity steps) |
//! | [`position`] | stands at the dwell points; jumps between them (a baseline, no motion) |
//!
//! [`claim`] is what every schedule says about the limits; [`interpolator`] turns the feed of
//! `trig_spline` into reference positions, tick by tick.

pub mod average_velocity;
pub mod claim;
pub mod constant_acceleration;
mod hermite;
pub mod interpolator;
pub mod position;
pub mod pvt;
pub mod pvt_as_published;
mod shortest_cubic;
pub mod stop_at_corners;
pub mod trig_spline;

use planish_types::{DwellTime, Invalid, NotConverged, ToolPath};

/// Why a motion could not be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScheduleError {
    /// The inputs do not belong together.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The dwell times ask for more than the machine can do, and stretching was forbidden.
    #[error(
        "no motion within the limits at the given dwell times: segment {segment} \
         ({length_mm:.6} mm in {dwell_s:.6} s) {reason}; allow stretching or raise its dwell time"
    )]
    Infeasible {
        /// Index of the segment that is furthest from feasible.
        segment: usize,
        /// Its length, mm.
        length_mm: f64,
        /// Its dwell time, s.
        dwell_s: f64,
        /// Which limit stands in the way.
        reason: String,
    },
    /// A system of equations was not solved to its tolerance.
    #[error(transparent)]
    NotConverged(#[from] NotConverged),
    /// Stretching did not end.
    #[error(
        "no motion within the limits after {rounds} rounds of stretching; the worst segment is \
         {segment} at {excess:.6} of its limit; check the machine's limits"
    )]
    StretchLimit {
        /// Rounds of stretching.
        rounds: usize,
        /// Worst segment.
        segment: usize,
        /// Its use of the limit; 1 = at the limit.
        excess: f64,
    },
}

/// Least length of a segment, mm: a picometre. A corner beside a shorter one would be passed at a density that no proof
/// can follow.
const LEAST_LENGTH_MM: f64 = 1e-9;

/// Length below which a segment is none, mm: [`LEAST_LENGTH_MM`], or four roundings of its largest coordinate. A closed
/// path that was computed ends with one.
fn rounding_mm(path: &ToolPath, segment: usize) -> f64 {
    let ends = [path.point_mm()[segment], path.point_mm()[segment + 1]];
    let largest = ends.as_flattened().iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    (4.0 * f64::EPSILON * largest).max(LEAST_LENGTH_MM)
}

/// Refuses a dwell time that belongs to another path.
fn check_lengths(path: &ToolPath, dwell: &DwellTime) -> Result<(), Invalid> {
    let (segments, times) = (path.len(), dwell.dwell_s().len());
    if segments == times {
        return Ok(());
    }
    Err(Invalid::whole(
        "dwell_s",
        format!("has {times} elements, the tool path {segments} dwell points"),
        "give the dwell time of this path",
    ))
}
