//! A small part of 57 pixels along x, a Gaussian tool, and a machine of two axes.

use ndarray::Array2;
use planish_joint::{JointPlan, JointSettings, Price};
use planish_types::{Axis, Grid, Limits, MachineFile, MachineFileAxis, Surface, Tif, ToolPath};

/// Returns a machine with these limits along [x, y]: velocities, mm/s, accelerations, mm/s^2, and one jerk, mm/s^3.
pub fn two_axes(velocity: [f64; 2], acceleration: [f64; 2], jerk: Option<f64>) -> Limits {
    let axis = |i: usize| MachineFileAxis {
        name: ["x", "y"][i].into(),
        max_velocity_mm_per_s: velocity[i],
        max_acceleration_mm_per_s2: acceleration[i],
        max_jerk_mm_per_s3: jerk,
        ..MachineFileAxis::default()
    };
    let axes = vec![axis(0), axis(1)];
    MachineFile { name: "test".into(), axes, min_segment_s: 0.0, ..MachineFile::default() }
        .checked()
        .unwrap()
}

/// Returns a Gaussian TIF of 1 mm, out to a radius of 3 mm.
pub fn tif() -> Tif {
    let a = Axis::new(-3.0, 0.25, 25).unwrap();
    let g = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        20.0 * (-(g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2)) / 2.0).exp()
    });
    Tif::new(g, rate).unwrap()
}

/// Returns a desired removal with a hill and a wave over 40 nm; `middle` is the position of the hill, mm.
pub fn hill(g: Grid, middle: [f64; 2]) -> Surface {
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.coordinate_mm(c) - middle[0], g.y.coordinate_mm(r) - middle[1]);
        40.0 + 15.0 * (-(x * x + 2.0 * y * y) / 9.0).exp() + 4.0 * (0.9 * x + 0.5 * y).sin()
    });
    Surface::new(g, height).unwrap()
}

pub fn through(points: Vec<[f64; 2]>) -> ToolPath {
    let n = points.len() - 1;
    ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
}

/// Returns settings with this price of time, nm^2/s, and nodes as far apart as on a large part. The closer nodes of a
/// plan with little work test nothing more here.
pub fn at_price(price: f64) -> JointSettings {
    let node_spacing_mm = Some(0.6);
    JointSettings { price: Price::Nm2PerS(price), node_spacing_mm, ..JointSettings::default() }
}

/// Returns the objective of the plan from its executed motion, without the pull to the least densities, nm^2.
pub fn merit(plan: &JointPlan, price: f64) -> f64 {
    let rms = plan.removal.residual().statistics().rms;
    0.5 * rms * rms + price * plan.trajectory.total_time_s()
}
