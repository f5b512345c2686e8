//! A place: position of the tool with its fraction of a dwell time. A column of the removal model consists of such
//! places.

use planish_types::Pose;

/// A position of the tool in a column of the removal model, with the fraction of the dwell time that it spends there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolPlace {
    /// Position [x, y], mm.
    pub position_mm: [f64; 2],
    /// Direction of the motion there, rad from positive x towards positive y.
    pub heading_rad: f64,
    /// Fraction of the dwell time; those of a column sum to 1 unless they include factors of the removal rate, for
    /// example that of the time of the run.
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
