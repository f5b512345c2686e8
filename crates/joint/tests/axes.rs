//! Axes beyond x and y: the plan keeps their limits, and the motion without them is the same where they never bind.

use std::f64::consts::TAU;

use crate::example::{at_price, hill, merit, through, tif, two_axes};
use planish_joint::{
    FurtherAxes, FurtherLimits, JointError, JointPlan, JointSettings, plan, plan_with_further_axes,
};
use planish_types::{Axis, End, Grid, Limits, Surface, ToolPath, Trajectory};
use planish_verify::{VerifySettings, verify};

/// Position of an axis at a point of the part: its value, its gradient, and its second derivatives by xx, xy and yy.
struct Jet(f64, [f64; 2], [f64; 3]);

type Field = Box<dyn Fn([f64; 2]) -> Option<Vec<Jet>> + Sync>;

/// Axes whose positions are analytic functions of the point of the part.
struct Analytic {
    limits: Vec<FurtherLimits>,
    of: Field,
}

impl FurtherAxes for Analytic {
    fn limits(&self) -> &[FurtherLimits] {
        &self.limits
    }

    fn along(&self, p: [f64; 2], [tx, ty]: [f64; 2], curvature: f64) -> Option<Vec<[f64; 3]>> {
        let of = |Jet(q, [gx, gy], [xx, xy, yy]): Jet| {
            let across = gy * tx - gx * ty;
            let second = xx * tx * tx + 2.0 * xy * tx * ty + yy * ty * ty + curvature * across;
            [q, gx * tx + gy * ty, second]
        };
        Some((self.of)(p)?.into_iter().map(of).collect())
    }
}

fn limits_of(name: &str, velocity: f64, acceleration: f64, jerk: Option<f64>) -> FurtherLimits {
    FurtherLimits {
        name: name.into(),
        max_velocity_per_s: velocity,
        max_acceleration_per_s2: acceleration,
        max_jerk_per_s3: jerk,
    }
}

/// Returns the axes z and two tilts, in degrees, of a tool normal to a sphere of this radius.
fn sphere(radius: f64, limits: [FurtherLimits; 3]) -> Analytic {
    let of = move |[x, y]: [f64; 2]| {
        let w = (radius * radius - x * x - y * y).sqrt();
        let z = Jet(
            radius - w,
            [x / w, y / w],
            [1.0 / w + x * x / w.powi(3), x * y / w.powi(3), 1.0 / w + y * y / w.powi(3)],
        );
        let tilt = |u: f64| {
            let root = (radius * radius - u * u).sqrt();
            [(u / radius).asin(), 1.0 / root, u / root.powi(3)].map(f64::to_degrees)
        };
        let ([a, da, dda], [b, db, ddb]) = (tilt(x), tilt(y));
        Some(vec![z, Jet(a, [da, 0.0], [dda, 0.0, 0.0]), Jet(b, [0.0, db], [0.0, 0.0, ddb])])
    };
    Analytic { limits: limits.into(), of: Box::new(of) }
}

/// Returns the axes r and c (rad) of a spindle at the origin.
fn spindle(limits: [FurtherLimits; 2]) -> Analytic {
    let of = |[x, y]: [f64; 2]| {
        let r = x.hypot(y);
        if r == 0.0 {
            return None;
        }
        let r2 = r * r;
        let radius = Jet(
            r,
            [x / r, y / r],
            [(1.0 - x * x / r2) / r, -x * y / (r2 * r), (1.0 - y * y / r2) / r],
        );
        let turn = 2.0 * x * y / (r2 * r2);
        let angle = Jet(y.atan2(x), [-y / r2, x / r2], [turn, (y * y - x * x) / (r2 * r2), -turn]);
        Some(vec![radius, angle])
    };
    Analytic { limits: limits.into(), of: Box::new(of) }
}

/// Returns the largest velocity, acceleration and jerk of every axis over their limits. It takes differences of q(p(t))
/// at equal times, which are means of derivatives.
fn differences(
    motion: &Trajectory,
    axes: &Analytic,
    step_s: f64,
    turns: &[usize],
) -> Vec<[f64; 3]> {
    let breaks = motion.break_time_s();
    let count = (motion.total_time_s() / step_s) as usize;
    let mut segment = 0;
    let mut last: Vec<f64> = Vec::new();
    let mut positions: Vec<Vec<f64>> = Vec::new();
    for k in 0..=count {
        let t = k as f64 * step_s;
        while segment + 1 < motion.len() && breaks[segment + 1] <= t {
            segment += 1;
        }
        let p = motion.segment(segment).position_mm(t - breaks[segment]);
        let mut q: Vec<f64> = (axes.of)(p).expect("a position").iter().map(|jet| jet.0).collect();
        for i in turns {
            if let Some(last) = last.get(*i) {
                q[*i] -= TAU * ((q[*i] - last) / TAU).round();
            }
        }
        last.clone_from(&q);
        positions.push(q);
    }
    let of_axis = |i: usize| {
        let q = |k: usize| positions[k][i];
        let mut largest = [0.0f64; 3];
        for k in 3..positions.len() {
            let [a, b, c, d] = [q(k - 3), q(k - 2), q(k - 1), q(k)];
            let of = [
                (d - c) / step_s,
                (d - 2.0 * c + b) / step_s.powi(2),
                (d - 3.0 * c + 3.0 * b - a) / step_s.powi(3),
            ];
            for order in 0..3 {
                largest[order] = largest[order].max(of[order].abs());
            }
        }
        let limits = &axes.limits[i];
        [
            largest[0] / limits.max_velocity_per_s,
            largest[1] / limits.max_acceleration_per_s2,
            limits.max_jerk_per_s3.map_or(0.0, |jerk| largest[2] / jerk),
        ]
    };
    (0..axes.limits.len()).map(of_axis).collect()
}

fn stage() -> Limits {
    two_axes([100.0, 60.0], [1000.0, 600.0], None)
}

/// Returns a desired removal of 14 x 14 mm about the origin.
fn desired() -> Surface {
    let a = Axis::new(-7.0, 0.25, 57).unwrap();
    hill(Grid { x: a, y: a }, [0.0, 0.0])
}

/// Returns lines 1 mm apart, half a millimetre beside the origin.
fn raster() -> ToolPath {
    let mut points = Vec::new();
    for line in 0..18 {
        let y = f64::from(line) - 8.5;
        let ends = if line % 2 == 0 { [-9.5, 9.5] } else { [9.5, -9.5] };
        points.extend(ends.map(|x| [x, y]));
    }
    through(points)
}

/// Returns a spiral of 1 mm per turn about the origin, from the radius `from_mm` on.
fn spiral(from_mm: f64) -> ToolPath {
    let mut points = Vec::new();
    let mut angle = 0.0f64;
    loop {
        let r = from_mm + angle / TAU;
        if r > 9.0 {
            return through(points);
        }
        points.push([r * angle.cos(), r * angle.sin()]);
        angle += (0.6 / r.max(0.6)).min(0.6);
    }
}

/// Price of a second, nm^2/s.
const PRICE: f64 = 1e-3;

fn settings() -> JointSettings {
    at_price(PRICE)
}

fn on(axes: &Analytic, path: &ToolPath, limits: &Limits) -> Result<JointPlan, JointError> {
    plan_with_further_axes(&desired(), &tif(), path, (limits, axes), &settings())
}

/// Returns a plan after checking that both judges find every limit kept, and that a further axis is used.
fn kept(axes: &Analytic, path: &ToolPath, limits: &Limits, turns: &[usize]) -> JointPlan {
    let plan = on(axes, path, limits).unwrap();
    assert_eq!((plan.report.end, &plan.refused), (End::Optimal, &None));
    assert_eq!(plan.report.slowed_by, None);
    let verdict = verify(&plan.trajectory, limits, &VerifySettings::default()).unwrap();
    assert!(verdict.limits_respected, "{:?}", verdict.violations);
    // Positions of some 10 units are rounded to 2e-15: 1e-8 of 100 unit/s^2 in second differences, and 1e-4 of 1e3 unit/s^3
    // in third ones.
    let used = differences(&plan.trajectory, axes, 1e-3, turns);
    for (axis, used) in axes.limits.iter().zip(&used) {
        println!("{}: {used:?}", axis.name);
        assert!(used[0] < 1.0 + 1e-6 && used[1] < 1.0 + 1e-6 && used[2] < 1.0 + 1e-3, "{used:?}");
    }
    // The report says the same: differences are means, and a limit is reached for an instant. Between its times the judge
    // knows a velocity by a parabola, with an error below 1e-5 of the limit.
    for (report, used) in plan.report.axes[2..].iter().zip(&used) {
        println!("{report:?}");
        let reported = [report.velocity_over_limit, report.acceleration_over_limit];
        for (reported, used) in reported.into_iter().zip(used) {
            assert!(reported >= used - 1e-5 && reported < 1.0 + 1e-6, "{reported} {used}");
        }
    }
    let most = used.iter().flatten().copied().fold(0.0, f64::max);
    assert!(most > 0.9, "{used:?}");
    println!(
        "{} rounds, {:.3} s, {:.4} nm",
        plan.report.rounds,
        plan.trajectory.total_time_s(),
        plan.removal.residual().statistics().rms
    );
    plan
}

#[test]
fn a_sphere_keeps_the_limits_of_z_and_tilts() {
    // Slopes up to 35 degrees; the limits of every axis are met in turn.
    for (z, tilt) in [([20.0, 100.0], [500.0, 5e3]), ([1e3, 1e5], [40.0, 200.0])] {
        let limits = [
            limits_of("z", z[0], z[1], None),
            limits_of("a", tilt[0], tilt[1], None),
            limits_of("b", tilt[0], tilt[1], None),
        ];
        let axes = sphere(20.0, limits);
        let free = plan(&desired(), &tif(), &raster(), &stage(), &settings()).unwrap();
        let used = differences(&free.trajectory, &axes, 1e-3, &[]);
        assert!(used.iter().flatten().any(|u| *u > 1.2), "{used:?}");
        let plan = kept(&axes, &raster(), &stage(), &[]);
        assert!(merit(&plan, PRICE) > merit(&free, PRICE));
    }
}

#[test]
fn a_spindle_slows_down_towards_its_centre() {
    for velocity in [2.0 * TAU, 20.0] {
        let axes =
            spindle([limits_of("r", 50.0, 500.0, None), limits_of("c", velocity, 60.0, None)]);
        let plan = kept(&axes, &spiral(0.4), &stage(), &[1]);
        let report = &plan.report.axes[3];
        println!("{report:?}");
    }
}

#[test]
fn limits_on_jerk_of_further_axes_are_kept() {
    let jerk = Some(2e3);
    let limits = [
        limits_of("z", 20.0, 200.0, jerk),
        limits_of("a", 100.0, 500.0, None),
        limits_of("b", 100.0, 500.0, None),
    ];
    kept(&sphere(20.0, limits), &raster(), &stage(), &[]);
    let of_spindle =
        [limits_of("r", 50.0, 500.0, None), limits_of("c", 2.0 * TAU, 60.0, Some(1e3))];
    kept(&spindle(of_spindle), &spiral(0.4), &two_axes([100.0; 2], [1e3; 2], Some(2e4)), &[1]);
}

#[test]
fn limits_that_never_bind_change_nothing() {
    let free = ["z", "a", "b"].map(|name| limits_of(name, 1e6, 1e9, None));
    for path in [raster(), spiral(0.4)] {
        let own = plan(&desired(), &tif(), &path, &stage(), &settings()).unwrap();
        let with = on(&sphere(20.0, free.clone()), &path, &stage()).unwrap();
        assert_eq!(own.trajectory, with.trajectory);
        assert!(own.report.axes.is_empty());
        assert_eq!(with.report.axes.len(), 5);
    }
}

#[test]
fn a_copy_of_x_with_half_its_limits_is_a_machine_with_half_the_limits_of_x() {
    let copy = Analytic {
        limits: vec![limits_of("u", 50.0, 500.0, None)],
        of: Box::new(|p: [f64; 2]| Some(vec![Jet(p[0], [1.0, 0.0], [0.0; 3])])),
    };
    for path in [raster(), spiral(0.4)] {
        let half = two_axes([50.0, 60.0], [500.0, 600.0], None);
        let own = plan(&desired(), &tif(), &path, &half, &settings()).unwrap();
        let with = on(&copy, &path, &stage()).unwrap();
        let whole = plan(&desired(), &tif(), &path, &stage(), &settings()).unwrap();
        let [own, with, whole] = [own, with, whole].map(|plan| merit(&plan, PRICE));
        println!("{own} {with} {whole}");
        // The rows of a further axis leave up to 1 % of a limit free, where those of x on lines leave nothing.
        assert!((with / own - 1.0).abs() < 1e-2, "{own} {with}");
        assert!(with > whole, "{with} {whole}");
    }
}

#[test]
fn a_path_through_the_centre_of_a_spindle_is_refused() {
    let limits = || [limits_of("r", 50.0, 500.0, None), limits_of("c", 20.0, 60.0, None)];
    let refused = |path: &ToolPath| match on(&spindle(limits()), path, &stage()) {
        Err(refused) => refused.to_string(),
        Ok(plan) => plan.refused.expect("refused"),
    };
    let message = refused(&spiral(0.0));
    assert!(message.contains("no position or no derivative"), "{message}");
    // Straight through it, where r steps from falling to rising
    for points in [vec![[-8.0, -0.01], [3.0, 0.0], [8.0, 4.0]], vec![[-8.0, -3.001], [8.0, 3.0]]] {
        let message = refused(&through(points));
        assert!(message.contains("turns within"), "{message}");
    }
    let mut still = limits();
    still[1].max_velocity_per_s = 0.0;
    let message = on(&spindle(still), &raster(), &stage()).unwrap_err().to_string();
    assert!(message.contains("max_velocity_per_s of the axis c is 0.0"), "{message}");
}
