//! Cubic Hermite segment of one axis, from the velocities of its ends.
//!
//! From `p` to `p + dp` in the time `h`, with the velocities `v0` and `v1` at its ends and `u` the
//! local time:
//!
//! ```text
//! p(u) = p + v0 u + (3 dp/h^2 - (2 v0 + v1)/h) u^2 + (-2 dp/h^3 + (v0 + v1)/h^2) u^3    (1)
//! a+ = 6 dp/h^2 - (4 v0 + 2 v1)/h       acceleration at its start                      (2)
//! a- = -6 dp/h^2 + (2 v0 + 4 v1)/h      acceleration at its end
//! v(u) = quadratic Bezier curve of (v0, V, v1),  V = 3 dp/h - v0 - v1                   (3)
//! ```

/// Returns the ascending coefficients of the cubic in the local time u, (1) of the module, in mm, mm/s, mm/s^2, mm/s^3.
/// The arguments are those of the module, in mm, mm/s and s.
pub(crate) fn coefficients(p: f64, dp: f64, v0: f64, v1: f64, h: f64) -> [f64; 4] {
    [p, v0, (3.0 * dp / h - 2.0 * v0 - v1) / h, (-2.0 * dp / h + v0 + v1) / (h * h)]
}

/// Returns the accelerations of the cubic at its start and at its end, (a+, a-) of (2) of the module, mm/s^2.
pub(crate) fn accelerations(dp: f64, v0: f64, v1: f64, h: f64) -> (f64, f64) {
    let mean = 6.0 * dp / (h * h);
    (mean - (4.0 * v0 + 2.0 * v1) / h, -mean + (2.0 * v0 + 4.0 * v1) / h)
}

/// Returns the largest |velocity| of the cubic, mm/s, and the time at which it occurs as a part in [0, 1] of the
/// duration. It follows from (3) of the module.
pub(crate) fn peak_velocity(dp: f64, v0: f64, v1: f64, h: f64) -> (f64, f64) {
    let middle = 3.0 * dp / h - v0 - v1;
    let mut peak = if v0.abs() >= v1.abs() { (v0.abs(), 0.0) } else { (v1.abs(), 1.0) };
    // v'(u) = 0 at u = (v0 - V) / (v0 - 2V + v1), where v = (v0 v1 - V^2) / (v0 - 2V + v1)
    let curvature = v0 - 2.0 * middle + v1;
    let u = (v0 - middle) / curvature;
    if u > 0.0 && u < 1.0 {
        let value = (1.0 - u) * ((1.0 - u) * v0 + u * middle) + u * ((1.0 - u) * middle + u * v1);
        if value.abs() > peak.0 {
            peak = (value.abs(), u);
        }
    }
    peak
}
