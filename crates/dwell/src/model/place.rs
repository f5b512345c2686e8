//! A place of the tool in a column of the removal model.

/// The tool is at `position_mm` for this fraction of a dwell time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Position [x, y], mm.
    pub position_mm: [f64; 2],
    /// Fraction of the dwell time; those of a column sum to 1, but for the factor of the time of a tool that has
    /// one.
    pub fraction: f64,
}
