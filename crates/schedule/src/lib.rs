//! Schedulers: each one makes a motion from a tool path and dwell times.
//!
//! Every scheduler is a file or a folder with the same items: its settings, a function `schedule`, and a report.
//! [`Schedule`] holds the trajectory and that report.
//!
//! | scheduler | motion |
//! |---|---|
//! | [`pvt`] | cubic Hermite segments through the control points at the dwell times |
//! | [`baselines::pvt_as_published`] | the same by the least squares of its source; reports their defects |
//! | [`constant_acceleration`] | one constant acceleration, then constant velocity, per segment |
//! | [`stop_at_corners`] | the same along the path, at rest in corners, within all limits |
//! | [`trig_spline`] | dwell-time density as a half-period trigonometric spline of arc length |
//! | [`baselines::average_velocity`] | constant velocity per segment (a baseline: its velocity steps) |
//! | [`baselines::position`] | stands at the dwell points; jumps between them (a baseline, no motion) |
//!
//! The closed loop (`planish refine`) takes any [`Scheduler`]; [`SCHEDULERS`] has them by name. [`claim`] measures
//! every motion against the limits of the machine. [`interpolator`] turns the dwell-time density of `trig_spline`
//! into reference positions, tick by tick. [`abort`] cuts a motion where a run was interrupted.
//!
//! Segment `i` of a path runs from control point `i` to the next one, and has one dwell point and one dwell time. A
//! node of `pvt` is a control point, a node of `trig_spline` a dwell point or a corner. A lift is a segment with the
//! tool off, and a pass a run of segments with the tool on. To stretch a segment means to give it more time than its
//! dwell time.

// The command line names this library as any other program does.
extern crate self as planish_schedule;

pub mod abort;
pub mod baselines;
pub mod claim;
mod cli;
pub mod command;
pub mod constant_acceleration;
mod hermite;
pub mod interpolator;
pub mod pvt;
mod shortest_cubic;
pub mod stop_at_corners;
pub mod trig_spline;

use planish_types::{DwellTime, Invalid, Limits, NotConverged, ToolPath, Trajectory};

/// A scheduler with its settings. The closed loop (`planish refine`) calls every scheduler through this trait.
pub trait Scheduler: std::fmt::Debug {
    /// Returns the name of the scheduler, which is also its subcommand of `planish schedule`.
    fn name(&self) -> &'static str;

    /// Returns the name of the kind of motion; `None` if the scheduler has one kind only.
    fn kind(&self) -> Option<&'static str> {
        None
    }

    /// Returns the motion along `path` with the dwell times `dwell`, and the segments whose time it changed, on a
    /// machine with these limits.
    fn schedule(
        &self,
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
    ) -> Result<Scheduled, ScheduleError>;
}

/// Trajectory of a scheduler, with the report `R` of that scheduler.
#[derive(Clone, Debug)]
pub struct Schedule<R> {
    /// Motion of the tool.
    pub trajectory: Trajectory,
    /// Report: the segments whose time the scheduler changed, and the limits or steps that the motion does not keep.
    pub report: R,
}

/// Trajectory, with the segments of the path whose time in it differs from their dwell time.
#[derive(Clone, Debug, PartialEq)]
pub struct Scheduled {
    /// Motion of the tool.
    pub trajectory: Trajectory,
    /// Segments whose time in the motion is not their dwell time, in order: index of the segment, and time in the
    /// motion, s. For `pvt` they are those that it stretched.
    pub changed: Vec<(usize, f64)>,
}

impl Scheduled {
    /// Returns the trajectory with the segments whose time in it differs from their dwell time by more than rounding.
    ///
    /// # Errors
    ///
    /// Fails if the trajectory serves a segment that `dwell` does not have.
    pub fn compared(trajectory: Trajectory, dwell: &DwellTime) -> Result<Self, Invalid> {
        let served_s = trajectory.served_s(dwell.dwell_s().len(), |_| true)?;
        // Break times are sums: their differences round with the total.
        let rounding_s = 1e-12 * trajectory.total_time_s();
        let times = dwell.dwell_s().iter().zip(served_s).enumerate();
        let differs = times.filter(|(_, (dwell_s, took))| (took - **dwell_s).abs() > rounding_s);
        let changed = differs.map(|(segment, (_, took))| (segment, took)).collect();
        Ok(Self { trajectory, changed })
    }
}

/// Settings that a user can choose together with the name of a scheduler. A scheduler without such a setting ignores
/// it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Choices {
    /// Shape of the motion of `pvt`: smooth, monotone, or the default of the machine.
    pub mode: pvt::ModeChoice,
    /// Repair of the dwell-time densities of `trig-spline` where the motion exceeds a limit.
    pub repair: trig_spline::Repair,
    /// Largest distance of the motion of `pvt` from its path, mm; `None`: the usual tolerance of the path.
    pub max_path_distance_mm: Option<f64>,
}

/// Row of the table [`SCHEDULERS`].
#[derive(Clone, Copy, Debug)]
pub struct Named {
    /// Name of the scheduler, which is also its subcommand of `planish schedule`.
    pub name: &'static str,
    /// Phrase that describes the motion of the scheduler.
    pub about: &'static str,
    make: fn(&Choices, &Limits) -> Box<dyn Scheduler>,
}

impl Named {
    /// Returns the scheduler for a machine with these limits, with the chosen settings and the default of every other
    /// setting.
    pub fn scheduler(&self, choices: &Choices, limits: &Limits) -> Box<dyn Scheduler> {
        (self.make)(choices, limits)
    }
}

/// The schedulers for the closed loop; the first one is the default. The baselines are not here: no machine can execute
/// their motion, or the motion is not within its limits.
pub static SCHEDULERS: [Named; 4] = [
    Named {
        name: "pvt",
        about: "Cubic segments, stretched if the limits demand it",
        make: |choices, limits| {
            Box::new(pvt::PvtSettings {
                max_path_distance_mm: choices.max_path_distance_mm,
                ..pvt::PvtSettings::new(choices.mode.on(limits))
            })
        },
    },
    Named {
        name: "constant-acceleration",
        about: "One constant acceleration, then constant velocity, per segment; no look-ahead",
        make: |_, _| Box::new(constant_acceleration::ConstantAccelerationSettings),
    },
    Named {
        name: "stop-at-corners",
        about: "Constant acceleration along the path with look-ahead, at rest in every corner",
        make: |_, _| Box::new(stop_at_corners::StopAtCornersSettings),
    },
    Named {
        name: "trig-spline",
        about: "Dwell-time density as a trigonometric spline along the path, raised until the limits are kept",
        make: |choices, _| {
            Box::new(trig_spline::TrigSplineSettings {
                repair: choices.repair,
                ..Default::default()
            })
        },
    },
];

/// Returns the scheduler of this name; `None` if there is none.
pub fn by_name(name: &str) -> Option<&'static Named> {
    SCHEDULERS.iter().find(|named| named.name == name)
}

/// Reasons for which a scheduler returns no motion.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScheduleError {
    /// The inputs or the settings are invalid or do not belong together.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The machine cannot move at the dwell times, and the settings forbid stretching.
    #[error(
        "no motion within the limits at the given dwell times: segment {segment} \
         ({length_mm:.6} mm in {dwell_s:.6} s) {reason}; allow stretching or raise its dwell time"
    )]
    Infeasible {
        /// Index of the segment that exceeds the limits most.
        segment: usize,
        /// Length of the segment, mm.
        length_mm: f64,
        /// Dwell time of the segment, s.
        dwell_s: f64,
        /// Time that the segment needs, or the factor by which its time must grow, as text.
        reason: String,
    },
    /// An iteration ended before it reached its tolerance.
    #[error(transparent)]
    NotConverged(#[from] NotConverged),
    /// The limits are still exceeded after the largest number of rounds of stretching.
    #[error(
        "no motion within the limits after {rounds} rounds of stretching; segment {segment} would still need \
         {excess:.6} times its time; check the machine's limits"
    )]
    StretchLimit {
        /// Number of rounds of stretching that were made.
        rounds: usize,
        /// Index of the segment that exceeds the limits most.
        segment: usize,
        /// Factor, above 1, by which the time of that segment would still have to grow.
        excess: f64,
    },
}

/// Smallest length of a segment, mm: a picometre. Segments up to it count as having no length. Larger: short
/// segments of a real path lose their length, too. Smaller: the density at a corner beside a short segment becomes so
/// large that rounding keeps the motion from being proven within the limits.
const LEAST_LENGTH_MM: f64 = 1e-9;

/// Returns the length up to which the segment of this index counts as having no length, mm: the larger of
/// [`LEAST_LENGTH_MM`] and four roundings of its largest coordinate. A computed closed path ends with such a segment.
fn rounding_mm(path: &ToolPath, segment: usize) -> f64 {
    let ends = [path.point_mm()[segment], path.point_mm()[segment + 1]];
    let largest = ends.as_flattened().iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    (4.0 * f64::EPSILON * largest).max(LEAST_LENGTH_MM)
}

/// Returns the largest magnitude of a vector along the unit vector `direction` whose x and y components keep the limits
/// `max`. The result has the unit of `max`; an axis across the direction does not limit it.
fn largest_along(direction: [f64; 2], max: [f64; 2]) -> f64 {
    let [x, y] = [0, 1].map(|a| max[a] / direction[a].abs()); // infinite across
    x.min(y)
}

/// Returns an error if the dwell times and the path have different numbers of segments.
fn check_lengths(path: &ToolPath, dwell: &DwellTime) -> Result<(), Invalid> {
    let segments = path.len();
    let times = dwell.dwell_s().len();
    if segments == times {
        return Ok(());
    }
    Err(Invalid::whole(
        "dwell_s",
        format!("has {times} elements, the tool path {segments} dwell points"),
        "give the dwell time of this path",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_testkit::machine;
    use planish_types::{DwellTime, ToolPath};

    #[test]
    fn a_row_has_the_name_of_its_scheduler_and_its_choices_take_effect() {
        let limits = machine([100.0; 2], [1000.0; 2]);
        for named in &SCHEDULERS {
            let scheduler = named.scheduler(&Choices::default(), &limits);
            assert_eq!(scheduler.name(), named.name);
            assert_eq!(by_name(named.name).map(|found| found.name), Some(named.name));
        }
        assert!(by_name("position").is_none());
        let (mode, repair) = (pvt::ModeChoice::Smooth, trig_spline::Repair::Local);
        let choices = Choices { mode, repair, ..Choices::default() };
        let kind = |name: &str| by_name(name).unwrap().scheduler(&choices, &limits).kind();
        assert_eq!((kind("pvt"), kind("trig-spline")), (Some("smooth"), Some("local")));
        assert_eq!(kind("stop-at-corners"), None);
    }

    /// Uses a fast stairway with a stand, a lift and a segment that is far too fast. The times that a scheduler states
    /// must be those of its motion.
    #[test]
    fn the_times_that_a_scheduler_states_are_those_of_its_motion() {
        let limits = machine([20.0; 2], [100.0; 2]);
        let mut points: Vec<[f64; 2]> =
            (0..=12).map(|i| [f64::from(i / 2), f64::from((i + 1) / 2)]).collect();
        points[8] = points[7];
        let tool_on: Vec<bool> = (0..12).map(|i| i != 4).collect();
        let path = ToolPath::through(points, tool_on, vec![0; 12]).unwrap();
        let mut dwell_s = vec![1.0; 12];
        dwell_s[10] = 1e-3;
        let dwell = DwellTime::new(dwell_s).unwrap();
        for named in &SCHEDULERS {
            let found = named.scheduler(&Choices::default(), &limits);
            let found = found.schedule(&path, &dwell, &limits).unwrap();
            let mut said_s = dwell.dwell_s().to_vec();
            for (segment, took) in &found.changed {
                said_s[*segment] = *took;
            }
            let served_s = found.trajectory.served_s(12, |_| true).unwrap();
            // Rounding of times of 15 s.
            for (i, (said, served)) in said_s.iter().zip(&served_s).enumerate() {
                assert!((said - served).abs() < 1e-12, "{}: {i}: {said} {served}", named.name);
            }
            assert!(found.changed.iter().any(|(i, took)| *i == 10 && *took > 0.05));
        }
    }
}
