//! Further axes: the axes of a machine beyond x and y, with their limits and their positions at points of the part.

/// Limits of a further axis in its own unit (mm or deg), all on magnitudes.
#[derive(Clone, Debug, PartialEq)]
pub struct FurtherLimits {
    /// Name of the axis.
    pub name: String,
    /// Largest velocity, unit/s.
    pub max_velocity_per_s: f64,
    /// Largest acceleration, unit/s^2.
    pub max_acceleration_per_s2: f64,
    /// Largest jerk, unit/s^3; `None` if the machine does not limit it.
    pub max_jerk_per_s3: Option<f64>,
}

/// Axes of a machine beyond x and y, whose positions follow from the position of the tool on the part.
pub trait FurtherAxes: Sync {
    /// Returns the limits of the further axes, in their order.
    fn limits(&self) -> &[FurtherLimits];

    /// Returns the position of every axis with its first and second derivative by arc length: in the unit of the axis,
    /// per mm and per mm^2. Returns `None` where an axis has no position or no derivative.
    ///
    /// The curve goes through `point_mm` along the unit vector `tangent`, with a curvature that is positive to the
    /// left. The position of an axis may depend on the point only, so that derivatives by x and y exist. Only the
    /// derivatives are used; an angle may jump by a full turn.
    fn along(
        &self,
        point_mm: [f64; 2],
        tangent: [f64; 2],
        curvature_per_mm: f64,
    ) -> Option<Vec<[f64; 3]>>;
}
