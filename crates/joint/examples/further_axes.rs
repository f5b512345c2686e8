//! Tables of axes beyond x and y: times of plans on spheres and spindles, and the time that planning takes.
//!
//! `cargo run --release -p planish-joint --example further_axes -- sphere spindle cost`

use std::{f64::consts::TAU, time::Instant};

use ndarray::Array2;
use planish_joint::{FurtherAxes, FurtherLimits, Plan, Price, Settings, plan, plan_with_further_axes};
use planish_types::{
    Axis, Grid, Limits, MachineFile, MachineFileAxis, Surface, Tif, ToolPath, plausible::Rms,
};

/// Half the side of the part, mm. Larger: longer paths. Smaller: shorter ones.
const HALF_MM: f64 = 20.0;

/// Number of points of the path whose planning is timed. Larger: more time. Smaller: the fixed part of the time counts.
const POINTS: usize = 10_000;

/// z and two tilts (degrees) normal to a sphere, without an offset of the pivot.
struct Sphere {
    radius_mm: f64,
    limits: [FurtherLimits; 3],
}

impl FurtherAxes for Sphere {
    fn limits(&self) -> &[FurtherLimits] {
        &self.limits
    }

    fn along(&self, [x, y]: [f64; 2], [tx, ty]: [f64; 2], curvature: f64) -> Option<Vec<[f64; 3]>> {
        let r2 = self.radius_mm * self.radius_mm;
        let w = (r2 - x * x - y * y).sqrt();
        let (out, across) = (x * tx + y * ty, y * tx - x * ty);
        let z = [-w, out / w, (1.0 + curvature * across) / w + out * out / w.powi(3)];
        let tilt = |u: f64, along: f64, bend: f64| {
            let root = (r2 - u * u).sqrt();
            [(u / self.radius_mm).asin(), along / root, bend / root + u * along * along / root.powi(3)]
                .map(f64::to_degrees)
        };
        let (a, b) = (tilt(x, tx, -curvature * ty), tilt(y, ty, curvature * tx));
        Some(vec![z, a, b])
    }
}

/// r and c (rad) of a spindle.
struct Spindle([FurtherLimits; 2]);

impl FurtherAxes for Spindle {
    fn limits(&self) -> &[FurtherLimits] {
        &self.0
    }

    fn along(&self, [x, y]: [f64; 2], [tx, ty]: [f64; 2], curvature: f64) -> Option<Vec<[f64; 3]>> {
        let r = x.hypot(y);
        if r == 0.0 {
            return None;
        }
        // Components of the tangent and of q'' along the radius and across it
        let [out, around] = [(x * tx + y * ty) / r, (x * ty - y * tx) / r];
        let [bend_out, bend_around] = [-curvature * around, curvature * out];
        let radius = [r, out, bend_out + around * around / r];
        let angle = [y.atan2(x), around / r, bend_around / r - 2.0 * out * around / (r * r)];
        Some(vec![radius, angle])
    }
}

fn limits_of(name: &str, velocity: f64, acceleration: f64) -> FurtherLimits {
    FurtherLimits {
        name: name.into(),
        max_velocity_per_s: velocity,
        max_acceleration_per_s2: acceleration,
        max_jerk_per_s3: None,
    }
}

/// z of 100 mm/s and 1000 mm/s^2, tilts of 20 deg/s and 100 deg/s^2.
fn sphere(slope_deg: f64) -> Sphere {
    let tilt = |name: &str| limits_of(name, 20.0, 100.0);
    let limits = [limits_of("z", 100.0, 1000.0), tilt("a"), tilt("b")];
    Sphere { radius_mm: HALF_MM / slope_deg.to_radians().sin(), limits }
}

/// r of 100 mm/s and 1000 mm/s^2, c of this many turns per minute, reached in a quarter of a second.
fn spindle(rpm: f64) -> Spindle {
    let velocity = rpm * TAU / 60.0;
    Spindle([limits_of("r", 100.0, 1000.0), limits_of("c", velocity, velocity / 0.25)])
}

fn machine() -> Limits {
    let axis = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: 100.0,
        max_acceleration_mm_per_s2: 1000.0,
        ..MachineFileAxis::default()
    };
    let axes = vec![axis("x"), axis("y")];
    let file = MachineFile { name: "example".into(), axes, ..MachineFile::default() };
    file.checked().expect("limits")
}

fn tif() -> Tif {
    let a = Axis::new(-5.0, 0.5, 21).expect("an axis");
    let grid = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        20.0 * (-(a.at(c).powi(2) + a.at(r).powi(2)) / 4.5).exp()
    });
    Tif::new(grid, rate).expect("a tool")
}

fn desired() -> Surface {
    let n = (4.0 * HALF_MM) as usize + 1;
    let a = Axis::new(-HALF_MM, 0.5, n).expect("an axis");
    let grid = Grid { x: a, y: a };
    let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (a.at(c), a.at(r));
        60.0 + 30.0 * (-(x * x + 2.0 * y * y) / 80.0).exp() + 8.0 * (0.4 * x + 0.25 * y).sin()
    });
    Surface::new(grid, height).expect("a map")
}

fn through(points: Vec<[f64; 2]>) -> ToolPath {
    let n = points.len() - 1;
    ToolPath::through(points, vec![true; n], vec![0; n]).expect("a path")
}

/// Lines 1.5 mm apart, 4 mm beyond the part.
fn raster() -> ToolPath {
    let reach = HALF_MM + 4.0;
    let mut points = Vec::new();
    for line in 0..=32 {
        let y = 1.5 * f64::from(line) - reach;
        let ends = if line % 2 == 0 { [-reach, reach] } else { [reach, -reach] };
        points.extend(ends.map(|x| [x, y]));
    }
    through(points)
}

/// A spiral from this radius to the corners of the part, with points this far apart.
fn spiral(from_mm: f64, pitch_mm: f64, apart_mm: f64) -> ToolPath {
    let mut points = Vec::new();
    let mut angle = 0.0f64;
    loop {
        let r = from_mm + pitch_mm * angle / TAU;
        if r > 1.5 * HALF_MM {
            return through(points);
        }
        points.push([r * angle.cos(), r * angle.sin()]);
        angle += (apart_mm / r).min(0.5);
    }
}

/// A price of time: the same for all machines, so that the times compare.
fn settings() -> Settings {
    Settings { price: Price::Nm2PerS(2e-3), ..Settings::default() }
}

fn planned(path: &ToolPath, axes: Option<&dyn FurtherAxes>) -> (Plan, f64) {
    let (desired, tif, limits, settings) = (desired(), tif(), machine(), settings());
    let start = Instant::now();
    let plan = match axes {
        None => plan(&desired, &tif, path, &limits, &settings),
        Some(axes) => plan_with_further_axes(&desired, &tif, path, (&limits, axes), &settings),
    };
    (plan.expect("a plan"), start.elapsed().as_secs_f64())
}

fn row(name: &str, path: &ToolPath, axes: Option<&dyn FurtherAxes>) -> f64 {
    let (plan, seconds) = planned(path, axes);
    let r = &plan.report;
    let rms_nm = Rms::of(plan.removal.residual()).rms_nm;
    println!(
        "| {name} | {:.2} | {rms_nm:.3} | {} | {} | {} | {seconds:.1} |",
        plan.trajectory.total_time_s(),
        r.end,
        r.rounds,
        plan.refused.as_deref().unwrap_or("yes"),
    );
    for axis in &r.axes {
        println!(
            "    {}: velocity {:.4}, acceleration {:.4}; near {:.1} % and {:.1} % of the time; near its velocity within {:?} mm",
            axis.name,
            axis.velocity_over_limit,
            axis.acceleration_over_limit,
            100.0 * axis.time_near_velocity_limit,
            100.0 * axis.time_near_acceleration_limit,
            axis.near_velocity_limit_mm
        );
    }
    seconds
}

fn main() {
    let names: Vec<String> = std::env::args().skip(1).collect();
    let wanted = |name: &str| names.is_empty() || names.iter().any(|n| n == name);
    println!("| axes | time, s | residual, nm | end | rounds | limits kept | planning, s |");
    println!("|---|---|---|---|---|---|---|");
    if wanted("sphere") {
        row("raster, flat", &raster(), None);
        for slope_deg in [5.0, 10.0, 20.0, 30.0] {
            row(&format!("raster, {slope_deg} degrees"), &raster(), Some(&sphere(slope_deg)));
        }
    }
    if wanted("spindle") {
        let path = spiral(0.5, 1.5, 1.0);
        row("spiral, x and y", &path, None);
        for rpm in [60.0, 200.0] {
            row(&format!("spiral, spindle of {rpm} rpm"), &path, Some(&spindle(rpm)));
        }
    }
    if wanted("cost") {
        let area = std::f64::consts::PI * (1.5 * HALF_MM).powi(2);
        let pitch_mm = 1.0;
        let path = spiral(0.5, pitch_mm, area / pitch_mm / POINTS as f64);
        let name = |axes: &str| format!("spiral of {} points, {axes}", path.len() + 1);
        let own = row(&name("2 axes"), &path, None);
        let five = row(&name("5 axes"), &path, Some(&sphere(20.0)));
        println!("planning with five axes over two: {:.2}", five / own);
    }
}
