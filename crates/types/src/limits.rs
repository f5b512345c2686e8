//! What a machine can do.

use serde::{Deserialize, Serialize};

use crate::Invalid;

/// A machine: the limits of its x and y axes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Name of the machine.
    pub name: String,
    /// The axes, x first, then y.
    pub axes: Vec<AxisLimits>,
    /// Shortest segment that the controller accepts, s; 0 when it does not matter.
    #[serde(default)]
    pub min_segment_s: f64,
}

/// Limits of one axis, all on magnitudes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AxisLimits {
    /// "x" or "y".
    pub name: String,
    /// Largest velocity, mm/s.
    pub max_velocity_mm_per_s: f64,
    /// Largest acceleration, mm/s^2.
    pub max_acceleration_mm_per_s2: f64,
    /// Largest jerk, mm/s^3; absent when the machine does not limit it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_jerk_mm_per_s3: Option<f64>,
}

impl Limits {
    /// Checks what the JSON types do not: two axes named x and y, every limit positive and finite.
    pub fn validated(self) -> Result<Self, Invalid> {
        let names: Vec<&str> = self.axes.iter().map(|a| a.name.as_str()).collect();
        if names != ["x", "y"] {
            return Err(Invalid::whole(
                "axes",
                format!("are {names:?}"),
                "give exactly two axes named \"x\" and \"y\", in this order",
            ));
        }
        for (i, axis) in self.axes.iter().enumerate() {
            let limits = [
                ("max_velocity_mm_per_s", Some(axis.max_velocity_mm_per_s)),
                ("max_acceleration_mm_per_s2", Some(axis.max_acceleration_mm_per_s2)),
                ("max_jerk_mm_per_s3", axis.max_jerk_mm_per_s3),
            ];
            for (name, value) in limits {
                if let Some(v) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
                    let problem = format!("{name} is {v}");
                    return Err(Invalid::at("axes", i, problem, "a limit is positive and finite"));
                }
            }
        }
        if !(self.min_segment_s.is_finite() && self.min_segment_s >= 0.0) {
            return Err(Invalid::whole(
                "min_segment_s",
                format!("is {}", self.min_segment_s),
                "give a time in seconds, or leave it out",
            ));
        }
        Ok(self)
    }

    /// Largest velocity of (x, y), mm/s.
    pub fn max_velocity_mm_per_s(&self) -> [f64; 2] {
        [0, 1].map(|a| self.axes[a].max_velocity_mm_per_s)
    }

    /// Largest acceleration of (x, y), mm/s^2.
    pub fn max_acceleration_mm_per_s2(&self) -> [f64; 2] {
        [0, 1].map(|a| self.axes[a].max_acceleration_mm_per_s2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(velocity: f64, names: [&str; 2]) -> Limits {
        let axis = |name: &str| AxisLimits {
            name: name.into(),
            max_velocity_mm_per_s: velocity,
            max_acceleration_mm_per_s2: 10.0,
            max_jerk_mm_per_s3: None,
        };
        Limits { name: "m".into(), axes: names.map(axis).to_vec(), min_segment_s: 0.0 }
    }

    #[test]
    fn limits_must_be_positive_on_two_named_axes() {
        assert!(machine(1.0, ["x", "y"]).validated().is_ok());
        for v in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let message = machine(v, ["x", "y"]).validated().unwrap_err().to_string();
            assert!(message.contains("axes[0]: max_velocity_mm_per_s is"), "{message}");
        }
        assert!(machine(1.0, ["y", "x"]).validated().is_err());
        let mut one = machine(1.0, ["x", "y"]);
        one.axes.pop();
        assert!(one.validated().unwrap_err().to_string().contains("exactly two axes"));
    }
}
