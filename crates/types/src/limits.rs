//! Limits of the axes of a machine.
//!
//! [`MachineFile`] is the content of a machine file, unchecked. [`MachineFile::checked`] makes
//! [`Limits`] from it, which the stages use. No stage therefore divides by a limit of zero, or by
//! one so small that durations overflow. [`crate::Machine`] adds the travel of the axes and the
//! position of a part on them.

use serde::{Deserialize, Serialize};

use crate::{ControllerFile, Invalid, KinematicsFile, MachineFileRotaryAxis};

/// Names of the axes, in their order.
pub(crate) const AXES: [&str; 2] = ["x", "y"];

/// Smallest plausible limit of an axis, mm/s, mm/s^2 or mm/s^3. 1e-9 mm/s is a millimetre in 30
/// years. Smaller: durations and their cubes in a polynomial leave the range of 64-bit floats.
/// Larger: a slow machine could be refused.
const LEAST_LIMIT: f64 = 1e-9;

/// Largest plausible velocity, mm/s: three times the velocity of light, so that a machine file can
/// state a limit that nothing reaches. The bound on acceleration is a thousand times larger, that
/// on jerk a million times. Much larger: products overflow.
const LARGEST_VELOCITY_MM_PER_S: f64 = 1e12;

/// Time from rest to the full acceleration, s, of a machine whose file states neither this time nor a limit on jerk.
/// Larger: smoother and slower plans. 0.1 s of 2000 mm/s^2 is a jerk of 2e4 mm/s^3, which stages for optics reach.
pub const DEFAULT_TIME_TO_FULL_ACCELERATION_S: f64 = 0.1;

/// Shortest and longest plausible `time_to_full_acceleration_s` beside 0, s: drives build up their current in some
/// 0.1 ms, and no axis takes minutes.
const TIMES_TO_FULL_ACCELERATION_S: [f64; 2] = [1e-6, 100.0];

/// Longest plausible `min_segment_s`, s: as long as any time in Planish may be. Controllers ask for milliseconds.
const LARGEST_MIN_SEGMENT_S: f64 = 1e9;

/// Limits of the axes x and y of a machine: every limit is positive and finite.
#[derive(Clone, Debug, PartialEq)]
pub struct Limits {
    name: String,
    axes: [AxisLimits; 2],
    min_segment_s: f64,
}

/// Limits of one axis, all on magnitudes; positive and finite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AxisLimits {
    name: &'static str,
    max_velocity_mm_per_s: f64,
    max_acceleration_mm_per_s2: f64,
    max_jerk_mm_per_s3: Option<f64>,
}

/// A machine as its JSON file states it, not checked yet.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "Limits")]
pub struct MachineFile {
    /// Name of the machine.
    pub name: String,
    /// The linear axes: x, then y; with `kinematics`, those of its kind in their order.
    pub axes: Vec<MachineFileAxis>,
    /// The rotary axes of the kind of `kinematics`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rotary_axes: Vec<MachineFileRotaryAxis>,
    /// Kinematics of a machine; absent for one with the axes x and y only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kinematics: Option<KinematicsFile>,
    /// Time from rest to the full acceleration, s: the jerk limit of an axis that states none is its acceleration limit
    /// over this time. 0: such an axis has no jerk limit. Absent: the same, but a pipeline takes
    /// [`DEFAULT_TIME_TO_FULL_ACCELERATION_S`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_to_full_acceleration_s: Option<f64>,
    /// Shortest segment that the controller accepts, s; 0 if it accepts any.
    #[serde(default)]
    pub min_segment_s: f64,
    /// Readings of the axes at the origin of the part, mm; [0, 0] if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part_origin_mm: Option<[f64; 2]>,
    /// Reading of the axis z where the tool, without tilt, touches the height 0 of the part, mm; 0 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part_origin_z_mm: Option<f64>,
    /// Angle by which the part is turned on the machine, from x towards y, degrees; 0 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part_rotation_deg: Option<f64>,
    /// The controller; if absent, programs have the default grids of their kind.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub controller: Option<ControllerFile>,
}

/// An axis as the JSON file of a machine states it, not checked yet.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "AxisLimits")]
pub struct MachineFileAxis {
    /// Name of the axis: "x" or "y"; "z" or "r" for `kinematics` that have such an axis.
    pub name: String,
    /// Largest velocity, mm/s.
    pub max_velocity_mm_per_s: f64,
    /// Largest acceleration, mm/s^2.
    pub max_acceleration_mm_per_s2: f64,
    /// Largest jerk, mm/s^3; absent when the machine does not limit it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_jerk_mm_per_s3: Option<f64>,
    /// Smallest and largest position of the axis, mm; absent if the travel has no limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub travel_mm: Option<[f64; 2]>,
    /// Direction in which the tool moves over the turned part when the axis reading increases:
    /// "+x", "-x", "+y" or "-y". If absent, the axis x moves along "+x" and y along "+y".
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub along: Option<String>,
}

impl MachineFile {
    /// Returns the names of the axes for which the file states neither a jerk limit nor that there is none.
    pub fn axes_without_word_on_jerk(&self) -> Vec<&str> {
        if self.time_to_full_acceleration_s.is_some() {
            return Vec::new();
        }
        let linear = self.axes.iter().filter(|a| a.max_jerk_mm_per_s3.is_none());
        let rotary = self.rotary_axes.iter().filter(|a| a.max_jerk_deg_per_s3.is_none());
        linear.map(|a| a.name.as_str()).chain(rotary.map(|a| a.name.as_str())).collect()
    }

    /// Returns the time from rest to the full acceleration, s; 0 if it is absent, which means no limit on jerk. Refuses
    /// implausible times.
    pub(crate) fn checked_time_to_full_acceleration_s(&self) -> Result<f64, Invalid> {
        let [shortest, longest] = TIMES_TO_FULL_ACCELERATION_S;
        let time_s = self.time_to_full_acceleration_s.unwrap_or_default();
        if time_s != 0.0 && !(shortest..=longest).contains(&time_s) {
            return Err(Invalid::whole(
                "time_to_full_acceleration_s",
                format!("is {time_s:?}"),
                format!("give seconds, from {shortest:e} to {longest}, or 0 for no limit on jerk"),
            ));
        }
        Ok(time_s)
    }

    /// Returns the limits along x and y.
    ///
    /// # Errors
    /// Refuses what the JSON types do not: other axes than those that the kinematics ask for (x and y without them),
    /// and limits that are not positive and of a plausible size.
    pub fn checked(self) -> Result<Limits, Invalid> {
        self.check_names()?;
        let time_s = self.checked_time_to_full_acceleration_s()?;
        let axes = [self.checked_axis(0, time_s)?, self.checked_axis(1, time_s)?];
        if !(0.0..=LARGEST_MIN_SEGMENT_S).contains(&self.min_segment_s) {
            return Err(Invalid::whole(
                "min_segment_s",
                format!("is {:?}", self.min_segment_s),
                format!("give seconds, at most {LARGEST_MIN_SEGMENT_S:e}, or leave it out"),
            ));
        }
        Ok(Limits { name: self.name, axes, min_segment_s: self.min_segment_s })
    }

    /// Returns the limits along x (`i` = 0) or y (1), with the time to full acceleration `time_s`. For a spindle
    /// machine they are the stated limits of the contact point.
    fn checked_axis(&self, i: usize, time_s: f64) -> Result<AxisLimits, Invalid> {
        let stated = match &self.kinematics {
            Some(KinematicsFile::Spindle { contact, .. }) => contact.stated(),
            _ => self.axes[i].stated(i),
        };
        let ([max_velocity_mm_per_s, max_acceleration_mm_per_s2], max_jerk_mm_per_s3) =
            stated.checked(time_s)?;
        Ok(AxisLimits {
            name: AXES[i],
            max_velocity_mm_per_s,
            max_acceleration_mm_per_s2,
            max_jerk_mm_per_s3,
        })
    }
}

impl MachineFileAxis {
    /// Returns the limits of this axis, which has the index `index` in the list `axes` of the file, as stated.
    pub(crate) fn stated(&self, index: usize) -> StatedLimits {
        StatedLimits {
            list: "axes",
            index: Some(index),
            unit: "mm",
            velocity: self.max_velocity_mm_per_s,
            acceleration: self.max_acceleration_mm_per_s2,
            jerk: self.max_jerk_mm_per_s3,
        }
    }
}

/// Limits of an axis with the place in the file that states them, not checked yet.
pub(crate) struct StatedLimits {
    /// Key of the machine file under which the limits stand.
    pub(crate) list: &'static str,
    /// Index of the axis in that list; `None` if the key is no list.
    pub(crate) index: Option<usize>,
    /// Unit of the positions: "mm" or "deg".
    pub(crate) unit: &'static str,
    pub(crate) velocity: f64,
    pub(crate) acceleration: f64,
    pub(crate) jerk: Option<f64>,
}

impl StatedLimits {
    /// Returns the limits of velocity and acceleration, and the jerk limit. If none is stated, the jerk limit is the
    /// acceleration over `time_s`, or `None` if that is 0. Refuses limits that are not positive and of a plausible
    /// size.
    pub(crate) fn checked(&self, time_s: f64) -> Result<([f64; 2], Option<f64>), Invalid> {
        let largest = LARGEST_VELOCITY_MM_PER_S;
        let unit = self.unit;
        let limits = [
            ("velocity", "", Some(self.velocity), largest),
            ("acceleration", "2", Some(self.acceleration), 1e3 * largest),
            ("jerk", "3", self.jerk, 1e6 * largest),
        ];
        for (name, power, value, most) in limits {
            let Some(v) = value else { continue };
            if (LEAST_LIMIT..=most).contains(&v) {
                continue;
            }
            let problem = format!("max_{name}_{unit}_per_s{power} is {v:?}");
            let remedy = if v.is_finite() && v > 0.0 {
                let over = if power.is_empty() { "s".into() } else { format!("s^{power}") };
                format!("give {unit}/{over}, from {LEAST_LIMIT:e} to {most:e}")
            } else {
                "a limit is positive and finite".into()
            };
            return Err(match self.index {
                Some(index) => Invalid::at_index(self.list, index, problem, remedy),
                None => Invalid::whole(self.list, problem, remedy),
            });
        }
        let mut jerk = self.jerk;
        if jerk.is_none() && time_s > 0.0 {
            jerk = Some((self.acceleration / time_s).clamp(LEAST_LIMIT, 1e6 * largest));
        }
        Ok(([self.velocity, self.acceleration], jerk))
    }
}

/// Returns the machine file that states these limits, so that one of them can be changed and checked again.
impl From<&Limits> for MachineFile {
    fn from(limits: &Limits) -> Self {
        let axes = limits.axes.map(|a| MachineFileAxis {
            name: a.name.into(),
            max_velocity_mm_per_s: a.max_velocity_mm_per_s,
            max_acceleration_mm_per_s2: a.max_acceleration_mm_per_s2,
            max_jerk_mm_per_s3: a.max_jerk_mm_per_s3,
            ..MachineFileAxis::default()
        });
        Self {
            name: limits.name.clone(),
            axes: axes.into(),
            min_segment_s: limits.min_segment_s,
            ..Self::default()
        }
    }
}

impl Limits {
    /// Returns the name of the machine.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the limits of the axes x and y.
    pub fn axes(&self) -> &[AxisLimits; 2] {
        &self.axes
    }

    /// Returns the shortest segment that the controller accepts, s; 0 if it accepts any.
    pub fn min_segment_s(&self) -> f64 {
        self.min_segment_s
    }

    /// Returns the machine with other limits of (x, y). Velocity, acceleration and jerk have to be positive
    /// and finite.
    pub(crate) fn with_axes(
        &self,
        velocity: [f64; 2],
        acceleration: [f64; 2],
        jerk: [Option<f64>; 2],
    ) -> Self {
        let axes = [0, 1].map(|i| AxisLimits {
            name: AXES[i],
            max_velocity_mm_per_s: velocity[i],
            max_acceleration_mm_per_s2: acceleration[i],
            max_jerk_mm_per_s3: jerk[i],
        });
        Self { axes, ..self.clone() }
    }

    /// Returns the largest velocities of [x, y], mm/s.
    pub fn max_velocity_mm_per_s(&self) -> [f64; 2] {
        self.axes.map(|a| a.max_velocity_mm_per_s)
    }

    /// Returns the largest accelerations of [x, y], mm/s^2.
    pub fn max_acceleration_mm_per_s2(&self) -> [f64; 2] {
        self.axes.map(|a| a.max_acceleration_mm_per_s2)
    }
}

impl AxisLimits {
    /// Returns the name of the axis, "x" or "y".
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Returns the largest velocity, mm/s.
    pub fn max_velocity_mm_per_s(&self) -> f64 {
        self.max_velocity_mm_per_s
    }

    /// Returns the largest acceleration, mm/s^2.
    pub fn max_acceleration_mm_per_s2(&self) -> f64 {
        self.max_acceleration_mm_per_s2
    }

    /// Returns the largest jerk, mm/s^3, or `None` if the machine does not limit it.
    pub fn max_jerk_mm_per_s3(&self) -> Option<f64> {
        self.max_jerk_mm_per_s3
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(velocity: f64, names: [&str; 2]) -> MachineFile {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: velocity,
            max_acceleration_mm_per_s2: 10.0,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        let axes = names.map(axis).to_vec();
        MachineFile { name: "m".into(), axes, ..MachineFile::default() }
    }

    #[test]
    fn limits_must_be_positive_on_two_named_axes() {
        let file = machine(1.0, ["x", "y"]);
        let limits = file.clone().checked().unwrap();
        assert_eq!((limits.name(), limits.axes().map(|a| a.name())), ("m", AXES));
        assert_eq!(MachineFile::from(&limits), file);
        for v in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let message = machine(v, ["x", "y"]).checked().unwrap_err().to_string();
            assert!(message.contains("axes[0]: max_velocity_mm_per_s is"), "{message}");
            let mut slow = file.clone();
            slow.axes[1].max_jerk_mm_per_s3 = Some(v);
            let message = slow.checked().unwrap_err().to_string();
            assert!(message.contains("axes[1]: max_jerk_mm_per_s3 is"), "{message}");
        }
        for v in [-1.0, f64::NAN, f64::INFINITY, 1e10, 1e300] {
            let refused = MachineFile { min_segment_s: v, ..file.clone() }.checked();
            assert!(refused.unwrap_err().to_string().contains("min_segment_s: is"));
        }
        // The smallest 64-bit float, the smallest normal one, and numbers whose products overflow.
        for v in [5e-324, 1e-308, 1e-10, 1e300] {
            let message = machine(v, ["x", "y"]).checked().unwrap_err().to_string();
            let said =
                format!("axes[0]: max_velocity_mm_per_s is {v:?}; give mm/s, from 1e-9 to 1e12");
            assert_eq!(message, said);
        }
        for v in [1e-9, 1e12] {
            assert!(machine(v, ["x", "y"]).checked().is_ok());
        }
        for v in [-1.0, f64::NAN, f64::INFINITY, 1e-7, 101.0] {
            let refused =
                MachineFile { time_to_full_acceleration_s: Some(v), ..file.clone() }.checked();
            let message = refused.unwrap_err().to_string();
            assert!(message.contains("time_to_full_acceleration_s: is"), "{message}");
        }
        assert!(machine(1.0, ["y", "x"]).checked().is_err());
        let mut one = file;
        one.axes.pop();
        assert!(one.checked().unwrap_err().to_string().contains("exactly two axes"));
    }

    #[test]
    fn an_axis_takes_its_own_jerk_limit_or_that_of_the_machines_time() {
        let mut file = machine(1.0, ["x", "y"]);
        assert_eq!(file.axes_without_word_on_jerk(), ["x", "y"]);
        file.axes[1].max_jerk_mm_per_s3 = Some(7.0);
        assert_eq!(file.axes_without_word_on_jerk(), ["x"]);
        // 10 mm/s^2 in 0.1 s.
        for (time_s, jerk) in [(None, None), (Some(0.0), None), (Some(0.1), Some(100.0))] {
            let file = MachineFile { time_to_full_acceleration_s: time_s, ..file.clone() };
            assert_eq!(file.axes_without_word_on_jerk().is_empty(), time_s.is_some());
            let limits = file.checked().unwrap();
            assert_eq!(limits.axes().map(|a| a.max_jerk_mm_per_s3()), [jerk, Some(7.0)]);
        }
    }
}
