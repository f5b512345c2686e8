//! Further axes of a machine while its tool follows a path over a form: [`FurtherAxes`] from its kinematics.
//!
//! | kinematics | axes with rows of their own |
//! |---|---|
//! | `xy` | none: x and y are those of the contact point |
//! | `xyz` | z |
//! | `xyz-tilts` | x, y, z, a, b: with a pivot, x and y are not those of the contact point |
//! | `spindle` | all axes: the limits of x and y are those of the contact point, as the machine file states them |
//!
//! Derivatives by arc length are those of [`AxisMap::along`]. They are exact, but for the third derivatives of the form
//! in the second derivative of a tilt. These are differences over 1e-3 mm on both sides; `planish_kinematics` states
//! their error.

use planish_form::Form;
use planish_kinematics::AxisMap;
use planish_types::{Invalid, Kinematics, Machine};

use crate::{FurtherAxes, FurtherLimits};

/// Distance from the centre of a spindle below which its axis c has no direction, mm. Larger: paths that pass near the
/// centre are refused early. Smaller: rounding of the coordinates decides on c. Chosen: three orders above that
/// rounding, and far below what a tool resolves.
const CENTRE_MM: f64 = 1e-6;

/// Axes of a machine whose positions are not simply x or y of the contact point, with their limits.
#[derive(Clone, Debug)]
pub struct MachineAxes {
    map: AxisMap,
    /// Index of the first axis with rows (limits) of its own in the plan.
    first: usize,
    is_spindle: bool,
    limits: Vec<FurtherLimits>,
}

impl MachineAxes {
    /// Returns the axes of a machine over the form of the part; `None` if the machine has only x and y.
    ///
    /// # Errors
    ///
    /// Fails if the placement of the part on the machine has no inverse.
    pub fn new(machine: &Machine, form: &Form) -> Result<Option<Self>, Invalid> {
        let first = match machine.kinematics() {
            Kinematics::Xy => return Ok(None),
            Kinematics::Xyz => 2,
            Kinematics::Tilts { .. } | Kinematics::Spindle { .. } => 0,
        };
        let limits = machine.axes()[first..].iter().map(|axis| FurtherLimits {
            name: axis.name.to_owned(),
            max_velocity_per_s: axis.max_velocity,
            max_acceleration_per_s2: axis.max_acceleration,
            max_jerk_per_s3: axis.max_jerk,
        });
        Ok(Some(Self {
            map: AxisMap::new(machine, form)?,
            first,
            is_spindle: matches!(machine.kinematics(), Kinematics::Spindle { .. }),
            limits: limits.collect(),
        }))
    }
}

impl FurtherAxes for MachineAxes {
    fn limits(&self) -> &[FurtherLimits] {
        &self.limits
    }

    fn along(
        &self,
        point_mm: [f64; 2],
        tangent: [f64; 2],
        curvature_per_mm: f64,
    ) -> Option<Vec<[f64; 3]>> {
        if self.is_spindle && self.map.radius_mm(point_mm) < CENTRE_MM {
            return None;
        }
        let mut axes = self.map.along(point_mm, tangent, curvature_per_mm)?;
        Some(axes.split_off(self.first))
    }
}
