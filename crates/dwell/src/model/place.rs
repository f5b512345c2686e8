//! A place of the tool in a column of the removal model.

use planish_types::Pose;

/// The tool is at `position_mm` for this fraction of a dwell time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolPlace {
    /// Position [x, y], mm.
    pub position_mm: [f64; 2],
    /// Direction of the motion there, rad from positive x towards positive y.
    pub heading_rad: f64,
    /// Fraction of the dwell time; those of a column sum to 1, but for the factor of the time of a tool that has
    /// one.
    pub fraction: f64,
}

impl ToolPlace {
    /// Makes a place of a tool that does not turn with its motion.
    pub fn new(position_mm: [f64; 2], fraction: f64) -> Self {
        Self { position_mm, heading_rad: 0.0, fraction }
    }

    /// Returns the position and the direction of the motion.
    pub fn pose(&self) -> Pose {
        Pose { position_mm: self.position_mm, heading_rad: self.heading_rad }
    }
}
