//! Schedulers for the closed loop, by name. A new scheduler needs a row here, and `planish-refine` then takes it.
//!
//! The baselines are not here: no machine can execute their motion, or the motion is not within its limits.

use planish_types::Limits;

use crate::{Scheduler, constant_acceleration, pvt, stop_at_corners, trig_spline};

/// Settings that a user can choose together with the name. A scheduler without such a setting ignores it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Choices {
    /// Shape of the motion of `pvt`.
    pub mode: pvt::ModeChoice,
    /// Repair of the densities of `trig-spline`.
    pub repair: trig_spline::Repair,
}

/// A row of the table.
#[derive(Clone, Copy, Debug)]
pub struct Named {
    /// Name: that of the subcommand of `planish-schedule`.
    pub name: &'static str,
    /// Its motion, in a phrase.
    pub about: &'static str,
    make: fn(&Choices, &Limits) -> Box<dyn Scheduler>,
}

impl Named {
    /// The scheduler for a machine, with the chosen settings and the default of every other one.
    pub fn scheduler(&self, choices: &Choices, limits: &Limits) -> Box<dyn Scheduler> {
        (self.make)(choices, limits)
    }
}

/// The schedulers; the first one is the default.
pub static SCHEDULERS: [Named; 4] = [
    Named {
        name: "pvt",
        about: "Cubic segments, stretched if the limits demand it",
        make: |choices, limits| {
            Box::new(pvt::Settings { mode: choices.mode.on(limits), stretch: true })
        },
    },
    Named {
        name: "constant-acceleration",
        about: "One constant acceleration, then constant velocity, per segment; no look-ahead",
        make: |_, _| Box::new(constant_acceleration::Settings),
    },
    Named {
        name: "stop-at-corners",
        about: "Constant acceleration along the path with look-ahead, at rest in every corner",
        make: |_, _| Box::new(stop_at_corners::Settings),
    },
    Named {
        name: "trig-spline",
        about: "Dwell-time density as a trigonometric spline along the path, raised until the limits are kept",
        make: |choices, _| {
            Box::new(trig_spline::Settings { repair: choices.repair, ..Default::default() })
        },
    },
];

/// The row of a name.
pub fn by_name(name: &str) -> Option<&'static Named> {
    SCHEDULERS.iter().find(|named| named.name == name)
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
        let choices = Choices { mode: pvt::ModeChoice::Smooth, repair: trig_spline::Repair::Local };
        let kind = |name: &str| by_name(name).unwrap().scheduler(&choices, &limits).kind();
        assert_eq!((kind("pvt"), kind("trig-spline")), (Some("smooth"), Some("local")));
        assert_eq!(kind("stop-at-corners"), None);
    }

    /// A fast stairway with a stand, a lift and a segment that is far too fast: the times that a scheduler states are
    /// those of its motion.
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
