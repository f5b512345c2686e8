//! Kinematics of a machine: its axes, also beyond x and y, their limits, and which axis carries which.
//!
//! | kinematics | linear axes | rotary axes |
//! |---|---|---|
//! | none, or `xy` | x, y | - |
//! | `xyz` | x, y, z | - |
//! | `xyz-tilts` | x, y, z | a (about x), b (about y) |
//! | `spindle` | r, and z if it has one | c (about z), and b (in the plane of r and z) if it has one |
//!
//! The crate `planish-kinematics` maps a contact point to the positions of these axes.

use serde::{Deserialize, Serialize};

use crate::{
    AxisLimits, Invalid, MachineFile, is_plausible_mm,
    limits::{AXES, StatedLimits},
};

/// Kinematics as the machine file states them, not checked yet. The table of the module lists the axes of each kind.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum KinematicsFile {
    /// Two linear axes x and y, as without `kinematics`.
    Xy {},
    /// Three linear axes; the tool stays along z.
    Xyz {},
    /// Three linear axes that carry two tilts.
    XyzTilts {
        /// Distance from the contact point to the pivot of the tilts, along the tool, mm. Negative: the pivot is on the
        /// other side of the surface.
        pivot_mm: f64,
        /// Order of the tilts: the first one carries the second.
        tilts: [Tilt; 2],
    },
    /// A rotary axis c that turns the part, and a linear axis r along its radius; z and the tilt b are optional.
    Spindle {
        /// Distance from the contact point to the pivot of the tilt b, mm. Needed with the axis b, refused without it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pivot_mm: Option<f64>,
        /// Limits of the contact point along x and y of the part, which plans keep.
        contact: ContactLimits,
    },
}

/// Rotary axis that tilts the tool.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Tilt {
    /// Rotation about x.
    A,
    /// Rotation about y.
    B,
}

/// Limits of the contact point of a machine without the axes x and y, not checked yet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactLimits {
    /// Largest velocity along x and along y, mm/s.
    pub max_velocity_mm_per_s: f64,
    /// Largest acceleration along x and along y, mm/s^2.
    pub max_acceleration_mm_per_s2: f64,
    /// Largest jerk along x and along y, mm/s^3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_jerk_mm_per_s3: Option<f64>,
}

/// A rotary axis as the machine file states it, not checked yet.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MachineFileRotaryAxis {
    /// Name of the axis: "a", "b" or "c".
    pub name: String,
    /// Largest velocity, deg/s.
    pub max_velocity_deg_per_s: f64,
    /// Largest acceleration, deg/s^2.
    pub max_acceleration_deg_per_s2: f64,
    /// Largest jerk, deg/s^3; absent when the machine does not limit it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_jerk_deg_per_s3: Option<f64>,
    /// Smallest and largest position of the axis, degrees; absent if the travel has no limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub travel_deg: Option<[f64; 2]>,
}

/// Kinematics of a machine, checked. The table of the module lists the axes of each kind.
#[derive(Clone, Debug, PartialEq)]
pub enum Kinematics {
    /// Linear axes x and y.
    Xy,
    /// Axes x, y and z; the tool stays along z.
    Xyz,
    /// Axes x, y, z, a and b.
    Tilts {
        /// Distance from the contact point to the pivot of the tilts, mm; negative if the pivot is on the other side of
        /// the surface.
        pivot_mm: f64,
        /// Order of the tilts: the first one carries the second.
        tilts: [Tilt; 2],
    },
    /// Axes r and c, with z and b if the machine has them.
    Spindle {
        /// True if there is an axis z.
        has_z: bool,
        /// Distance from the contact point to the pivot of b, mm; `None` without an axis b.
        pivot_mm: Option<f64>,
    },
}

/// An axis of a machine, checked. The unit of its numbers is mm, or degrees if the axis is rotary.
#[derive(Clone, Debug, PartialEq)]
pub struct MachineAxis {
    /// Name of the axis: x, y, z, r, a, b or c.
    pub name: &'static str,
    /// True if the axis turns: its unit is degrees. The unit of the others is mm.
    pub is_rotary: bool,
    /// Largest velocity, mm/s or deg/s.
    pub max_velocity: f64,
    /// Largest acceleration, mm/s^2 or deg/s^2.
    pub max_acceleration: f64,
    /// Largest jerk, mm/s^3 or deg/s^3; `None` if the machine does not limit it.
    pub max_jerk: Option<f64>,
    /// Smallest and largest position, mm or degrees; `None` if the travel has no limit.
    pub travel: Option<[f64; 2]>,
}

impl MachineAxis {
    /// Returns the linear axis with these limits.
    pub fn linear(limits: &AxisLimits, travel: Option<[f64; 2]>) -> Self {
        Self {
            name: limits.name(),
            is_rotary: false,
            max_velocity: limits.max_velocity_mm_per_s(),
            max_acceleration: limits.max_acceleration_mm_per_s2(),
            max_jerk: limits.max_jerk_mm_per_s3(),
            travel,
        }
    }

    /// Returns the unit of the positions: "mm", or "deg" for a rotary axis.
    pub fn unit(&self) -> &'static str {
        if self.is_rotary { "deg" } else { "mm" }
    }
}

impl ContactLimits {
    pub(crate) fn stated(&self) -> StatedLimits {
        StatedLimits {
            list: "kinematics.contact",
            index: None,
            unit: "mm",
            velocity: self.max_velocity_mm_per_s,
            acceleration: self.max_acceleration_mm_per_s2,
            jerk: self.max_jerk_mm_per_s3,
        }
    }
}

impl MachineFileRotaryAxis {
    fn stated(&self, index: usize) -> StatedLimits {
        StatedLimits {
            list: "rotary_axes",
            index: Some(index),
            unit: "deg",
            velocity: self.max_velocity_deg_per_s,
            acceleration: self.max_acceleration_deg_per_s2,
            jerk: self.max_jerk_deg_per_s3,
        }
    }
}

/// Accepted lists of names of the linear axes, accepted lists for the rotary axes, and the remedy for other names.
type Accepted =
    (&'static [&'static [&'static str]], &'static [&'static [&'static str]], &'static str);

/// Returns the lists of axis names that these kinematics accept, and the remedy for others.
fn accepted(kinematics: Option<&KinematicsFile>) -> Accepted {
    match kinematics {
        None | Some(KinematicsFile::Xy {}) => {
            (&[&AXES], &[&[]], "give exactly two axes named \"x\" and \"y\", in this order")
        }
        Some(KinematicsFile::Xyz {}) => (
            &[&["x", "y", "z"]],
            &[&[]],
            "the kinematics \"xyz\" have the axes x, y, z, in this order",
        ),
        Some(KinematicsFile::XyzTilts { .. }) => (
            &[&["x", "y", "z"]],
            &[&["a", "b"]],
            "the kinematics \"xyz-tilts\" have the axes x, y, z and the rotary axes a, b, in this order",
        ),
        Some(KinematicsFile::Spindle { .. }) => (
            &[&["r"], &["r", "z"]],
            &[&["c"], &["c", "b"]],
            "the kinematics \"spindle\" have the axes r (and z), and the rotary axes c (and b), in this order",
        ),
    }
}

impl MachineFile {
    /// Refuses axes whose names and order the kinematics do not accept.
    pub(crate) fn check_names(&self) -> Result<(), Invalid> {
        let (linear, rotary, remedy) = accepted(self.kinematics.as_ref());
        let names: Vec<&str> = self.axes.iter().map(|a| a.name.as_str()).collect();
        if !linear.contains(&&names[..]) {
            return Err(Invalid::whole("axes", format!("are {names:?}"), remedy));
        }
        let names: Vec<&str> = self.rotary_axes.iter().map(|a| a.name.as_str()).collect();
        if !rotary.contains(&&names[..]) {
            return Err(Invalid::whole("rotary_axes", format!("are {names:?}"), remedy));
        }
        Ok(())
    }
}

/// Returns all axes of a file, the linear ones first, with their limits and travel. The names of the axes were checked
/// before.
pub(crate) fn checked_axes(file: &MachineFile) -> Result<Vec<MachineAxis>, Invalid> {
    let (linear, rotary, _) = accepted(file.kinematics.as_ref());
    // The last list is the longest one.
    let [linear, rotary] =
        [linear, rotary].map(|lists| *lists.last().expect("a list for each kind"));
    let time_s = file.checked_time_to_full_acceleration_s()?;
    let mut axes = Vec::new();
    for (i, (axis, name)) in file.axes.iter().zip(linear).enumerate() {
        let travel = checked_travel(("axes", i), "mm", axis.travel_mm)?;
        if axis.along.is_some() && !AXES.contains(name) {
            let problem = format!("along is given for the axis {name}");
            let remedy = "leave it out: only x and y go along a direction of the part";
            return Err(Invalid::at_index("axes", i, problem, remedy));
        }
        axes.push(checked_axis(name, axis.stated(i), time_s, travel)?);
    }
    for (i, (axis, name)) in file.rotary_axes.iter().zip(rotary).enumerate() {
        let travel = checked_travel(("rotary_axes", i), "deg", axis.travel_deg)?;
        axes.push(checked_axis(name, axis.stated(i), time_s, travel)?);
    }
    Ok(axes)
}

/// Returns the axis `name` with the limits that the file states. `time_s` is the time to full acceleration, from which
/// a missing jerk limit follows.
fn checked_axis(
    name: &'static str,
    stated: StatedLimits,
    time_s: f64,
    travel: Option<[f64; 2]>,
) -> Result<MachineAxis, Invalid> {
    let ([max_velocity, max_acceleration], max_jerk) = stated.checked(time_s)?;
    let is_rotary = stated.unit == "deg";
    Ok(MachineAxis { name, is_rotary, max_velocity, max_acceleration, max_jerk, travel })
}

/// Returns the travel of an axis as stated; refuses one whose ends are not finite and ascending. The list and the index
/// of the axis are for the message.
fn checked_travel(
    (list, index): (&'static str, usize),
    unit: &str,
    travel: Option<[f64; 2]>,
) -> Result<Option<[f64; 2]>, Invalid> {
    let Some([low, high]) = travel else { return Ok(None) };
    // Degrees have the bound of mm: no axis makes 3e4 turns and knows where it is.
    if !([low, high].iter().all(|v| is_plausible_mm(*v)) && low < high) {
        let problem = format!("travel_{unit} is [{low}, {high}]");
        let remedy = format!("give the smallest and the largest position in {unit}, in this order");
        return Err(Invalid::at_index(list, index, problem, remedy));
    }
    Ok(travel)
}

impl Kinematics {
    /// Returns the kinematics of a file whose axis names were checked before. Refuses a distance to a pivot that is
    /// missing, not wanted or not plausible.
    pub(crate) fn from_file(file: &MachineFile) -> Result<Self, Invalid> {
        let refused =
            |problem: String, remedy: &str| Err(Invalid::whole("kinematics", problem, remedy));
        let in_mm = "give mm from the contact point to the pivot; negative below the surface";
        match &file.kinematics {
            None | Some(KinematicsFile::Xy {}) => Ok(Self::Xy),
            Some(KinematicsFile::Xyz {}) => Ok(Self::Xyz),
            Some(KinematicsFile::XyzTilts { pivot_mm, tilts }) => {
                if !is_plausible_mm(*pivot_mm) {
                    return refused(format!("pivot_mm is {pivot_mm}"), in_mm);
                }
                if tilts[0] == tilts[1] {
                    let problem = format!("tilts are {tilts:?}");
                    return refused(
                        problem,
                        "give [\"a\", \"b\"] or [\"b\", \"a\"]: the first carries the second",
                    );
                }
                Ok(Self::Tilts { pivot_mm: *pivot_mm, tilts: *tilts })
            }
            Some(KinematicsFile::Spindle { pivot_mm, .. }) => {
                let tilts = file.rotary_axes.iter().any(|a| a.name == "b");
                let has_z = file.axes.iter().any(|a| a.name == "z");
                if tilts && !has_z {
                    return refused(
                        "have a tilt b without an axis z".into(),
                        "add the axis z, or leave out b",
                    );
                }
                match pivot_mm {
                    Some(mm) if !is_plausible_mm(*mm) => {
                        return refused(format!("pivot_mm is {mm}"), in_mm);
                    }
                    Some(_) if !tilts => {
                        return refused(
                            "have pivot_mm without a tilt b".into(),
                            "leave it out, or add the rotary axis b",
                        );
                    }
                    None if tilts => {
                        return refused("have a tilt b without pivot_mm".into(), in_mm);
                    }
                    _ => {}
                }
                Ok(Self::Spindle { has_z, pivot_mm: *pivot_mm })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Machine;

    const X_Y_Z: &str = r#"{"name": "x", "max_velocity_mm_per_s": 100, "max_acceleration_mm_per_s2": 500},
        {"name": "y", "max_velocity_mm_per_s": 90, "max_acceleration_mm_per_s2": 400},
        {"name": "z", "max_velocity_mm_per_s": 50, "max_acceleration_mm_per_s2": 300, "travel_mm": [-5, 60]}"#;
    const A_B: &str = r#"{"name": "a", "max_velocity_deg_per_s": 30, "max_acceleration_deg_per_s2": 100},
        {"name": "b", "max_velocity_deg_per_s": 20, "max_acceleration_deg_per_s2": 80, "travel_deg": [-40, 40]}"#;

    fn machine(axes: &str, rotary: &str, more: &str) -> Result<Machine, String> {
        let text = format!(r#"{{"name": "m", "axes": [{axes}], "rotary_axes": [{rotary}]{more}}}"#);
        let file = serde_json::from_str(&text).map_err(|e| e.to_string())?;
        Machine::new(file).map_err(|e| e.to_string())
    }

    const TILTS: &str =
        r#", "kinematics": {"kind": "xyz-tilts", "pivot_mm": 80, "tilts": ["b", "a"]}"#;

    #[test]
    fn a_machine_with_tilts_has_five_axes_and_the_limits_of_x_and_y() {
        let more =
            format!(r#"{TILTS}, "time_to_full_acceleration_s": 0.1, "part_origin_z_mm": 20"#);
        let found = machine(X_Y_Z, A_B, &more).unwrap();
        let names: Vec<_> = found.axes().iter().map(|a| (a.name, a.unit())).collect();
        assert_eq!(names, [("x", "mm"), ("y", "mm"), ("z", "mm"), ("a", "deg"), ("b", "deg")]);
        assert_eq!(found.axes()[4].max_jerk, Some(800.0));
        assert_eq!(
            (found.axes()[4].travel, found.axes()[2].travel),
            (Some([-40.0, 40.0]), Some([-5.0, 60.0]))
        );
        assert_eq!(found.limits().max_velocity_mm_per_s(), [100.0, 90.0]);
        assert_eq!(found.limits_on_part(), *found.limits());
        assert_eq!(
            *found.kinematics(),
            Kinematics::Tilts { pivot_mm: 80.0, tilts: [Tilt::B, Tilt::A] }
        );
        assert_eq!(found.part_origin_z_mm(), 20.0);
    }

    #[test]
    fn a_spindle_machine_has_the_stated_limits_of_the_contact_point() {
        let r = r#"{"name": "r", "max_velocity_mm_per_s": 60, "max_acceleration_mm_per_s2": 500, "travel_mm": [-1, 70]}"#;
        let c =
            r#"{"name": "c", "max_velocity_deg_per_s": 3600, "max_acceleration_deg_per_s2": 9000}"#;
        let more = r#", "kinematics": {"kind": "spindle",
            "contact": {"max_velocity_mm_per_s": 40, "max_acceleration_mm_per_s2": 200, "max_jerk_mm_per_s3": 1000}}"#;
        let found = machine(r, c, more).unwrap();
        assert_eq!(found.limits().max_velocity_mm_per_s(), [40.0; 2]);
        assert_eq!(found.limits().axes()[1].max_jerk_mm_per_s3(), Some(1000.0));
        assert_eq!((found.axes().len(), found.travel_mm()), (2, &[None; 2]));
        assert_eq!(*found.kinematics(), Kinematics::Spindle { has_z: false, pivot_mm: None });
        // However the part lies on the spindle, the limits are along x and y of the part.
        let turned = machine(r, c, &format!(r#"{more}, "part_rotation_deg": 30"#)).unwrap();
        assert!(turned.part_to_axes().is_some() && turned.limits_on_part() == *turned.limits());
    }

    #[test]
    fn a_machine_without_kinematics_and_one_that_states_xy_are_equal() {
        let x_y = X_Y_Z.rsplit_once(",\n").unwrap().0;
        let found = machine(x_y, "", "").unwrap();
        assert_eq!(machine(x_y, "", r#", "kinematics": {"kind": "xy"}"#).unwrap(), found);
        assert_eq!(found, Machine::from(found.limits().clone()));
    }

    #[test]
    fn axes_that_the_kinematics_do_not_have_are_refused() {
        let x_y = X_Y_Z.rsplit_once(",\n").unwrap().0;
        let with_limit = |old: &str, new: &str| A_B.replace(old, new);
        for (axes, rotary, more, words) in [
            (X_Y_Z, "", "", "axes: are [\"x\", \"y\", \"z\"]; give exactly two axes"),
            (x_y, A_B, "", "rotary_axes: are [\"a\", \"b\"]; give exactly two axes"),
            (
                x_y,
                A_B,
                TILTS,
                "axes: are [\"x\", \"y\"]; the kinematics \"xyz-tilts\" have the axes x, y, z",
            ),
            (X_Y_Z, "", TILTS, "rotary_axes: are []"),
            (X_Y_Z, A_B, r#", "kinematics": {"kind": "hexapod"}"#, "unknown variant `hexapod`"),
            (
                X_Y_Z,
                A_B,
                &TILTS.replace("\"b\", \"a\"", "\"b\", \"b\""),
                "tilts are [B, B]; give [\"a\", \"b\"]",
            ),
            (X_Y_Z, A_B, &TILTS.replace("80", "1e9"), "pivot_mm is 1000000000"),
            (X_Y_Z, A_B, &TILTS.replace("\"pivot_mm\": 80, ", ""), "missing field `pivot_mm`"),
            (
                X_Y_Z,
                &with_limit("20,", "-20,"),
                TILTS,
                "rotary_axes[1]: max_velocity_deg_per_s is -20",
            ),
            (
                X_Y_Z,
                &with_limit("[-40, 40]", "[40, -40]"),
                TILTS,
                "rotary_axes[1]: travel_deg is [40, -40]",
            ),
            (
                X_Y_Z,
                &with_limit("velocity_deg", "velocity_mm"),
                TILTS,
                "unknown field `max_velocity_mm_per_s`",
            ),
            (x_y, "", r#", "part_origin_z_mm": 1"#, "part_origin_z_mm: is given without an axis z"),
        ] {
            let message = machine(axes, rotary, more).unwrap_err();
            assert!(message.contains(words), "{message:?} lacks {words:?}");
        }
        let r = r#"{"name": "r", "max_velocity_mm_per_s": 60, "max_acceleration_mm_per_s2": 500}"#;
        let c_b = A_B.replace("\"a\"", "\"c\"");
        let spindle = r#", "kinematics": {"kind": "spindle",
            "contact": {"max_velocity_mm_per_s": 40, "max_acceleration_mm_per_s2": 200}}"#;
        assert!(machine(r, &c_b, spindle).unwrap_err().contains("a tilt b without an axis z"));
        let r_z = format!("{r}, {}", X_Y_Z.rsplit_once(",\n").unwrap().1);
        assert!(machine(&r_z, &c_b, spindle).unwrap_err().contains("a tilt b without pivot_mm"));
        let along = r.replace("500", "500, \"along\": \"+x\"");
        let c = c_b.rsplit_once(",\n").unwrap().0;
        assert!(machine(&along, c, spindle).unwrap_err().contains("along is given for the axis r"));
        let slow = spindle.replace("40", "0");
        assert!(
            machine(r, c, &slow)
                .unwrap_err()
                .contains("kinematics.contact: max_velocity_mm_per_s is 0")
        );
    }
}
