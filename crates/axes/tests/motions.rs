//! Motions of the axes against closed forms and against a judge that samples them densely.

use std::env;

use planish_axes::{MotionSettings, contact, motion};
use planish_form::{Form, FormFile};
use planish_testkit::{case_generator, workspace};
use planish_types::{AxesMotion, Machine, Trajectory};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

fn fixture(name: &str, change: impl FnOnce(&mut Value)) -> Machine {
    let path = workspace().join(format!("fixtures/machines/{name}.json"));
    let mut file = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    change(&mut file);
    Machine::new(serde_json::from_value(file).unwrap()).unwrap()
}

fn plane() -> Form {
    Form::new(&FormFile::plane(), None).unwrap()
}

/// Returns the motion of cubics through points, mm, with velocities, mm/s, each of the duration `h`, s.
fn through(points: &[[f64; 2]], velocities: &[[f64; 2]], h: f64) -> Trajectory {
    let segment = |i: usize| {
        [0, 1].map(|k| {
            let (p, v0, v1) = (points[i][k], velocities[i][k], velocities[i + 1][k]);
            let mean = (points[i + 1][k] - p) / h;
            [p, v0, (3.0 * mean - 2.0 * v0 - v1) / h, (v0 + v1 - 2.0 * mean) / (h * h)]
        })
    };
    let k = points.len() - 1;
    let breaks = (0..=k).map(|i| i as f64 * h).collect();
    Trajectory::new(
        breaks,
        (0..k).map(segment).collect(),
        vec![true; k],
        (0..k).map(Some).collect(),
    )
    .unwrap()
}

/// Returns one long straight pass from rest to rest, as one cubic.
fn pass(from: [f64; 2], to: [f64; 2], duration_s: f64) -> Trajectory {
    through(&[from, to], &[[0.0; 2]; 2], duration_s)
}

/// Returns a smooth random motion from rest to rest that comes near most of a disk of 40 mm.
fn wander(random: &mut ChaCha8Rng) -> Trajectory {
    let n = random.random_range(2..12);
    let h = random.random_range(0.05..1.0);
    let mut point = [0, 1].map(|_| random.random_range(-25.0..25.0));
    let mut direction: f64 = random.random_range(-3.0..3.0);
    let mut points = vec![point];
    let mut velocities = vec![[0.0; 2]];
    for i in 0..n {
        direction += random.random_range(-1.0..1.0);
        let speed: f64 = random.random_range(1.0..60.0);
        let way = (speed * h).min(15.0);
        for (k, unit) in [direction.cos(), direction.sin()].into_iter().enumerate() {
            point[k] = (point[k] + way * unit).clamp(-40.0, 40.0);
        }
        let last = i == n - 1;
        let v = if last { 0.0 } else { way / h };
        points.push(point);
        velocities.push([v * direction.cos(), v * direction.sin()]);
    }
    through(&points, &velocities, h)
}

/// Returns a sentence for each limit that a motion exceeds, from values at 65 instants of every segment. The jerk limit
/// allows steps of the acceleration as in a controller's program: from the middle of a segment to that of the next.
fn exceeded(motion: &AxesMotion, machine: &Machine) -> Vec<String> {
    let mut found = Vec::new();
    // Rounding of the values and of the durations: what planish-verify allows.
    let over = |value: f64, limit: f64| value > limit * (1.0 + 1e-9);
    for (axis, limits) in machine.axes().iter().enumerate() {
        let mut last = [0.0, 0.0];
        let mut before_s = 0.0;
        for i in 0..motion.len() {
            let [_, c1, c2, c3] = motion.segment(i)[axis];
            let h = motion.duration_s(i);
            let mut say = |what: &str, value: f64, limit: f64| {
                if over(value, limit) {
                    found.push(format!("{} {what} {value} of {limit} in segment {i}", limits.name));
                }
            };
            for j in 0..=64 {
                let u = h * f64::from(j) / 64.0;
                say("velocity", (c1 + u * (2.0 * c2 + 3.0 * u * c3)).abs(), limits.max_velocity);
                say("acceleration", (2.0 * c2 + 6.0 * u * c3).abs(), limits.max_acceleration);
            }
            let velocity_step = (c1 - last[0]).abs();
            say("velocity step", velocity_step, 1e-6 + 1e-9 * limits.max_velocity);
            if let Some(jerk) = limits.max_jerk {
                say("jerk", (6.0 * c3).abs(), jerk);
                let rounding = 1e-6 * limits.max_acceleration;
                let step = (2.0 * c2 - last[1]).abs() - rounding;
                say("acceleration step", step, 0.5 * jerk * (before_s + h));
            }
            last = [c1 + h * (2.0 * c2 + 3.0 * h * c3), 2.0 * c2 + 6.0 * h * c3];
            before_s = h;
        }
        if last[0].abs() > 1e-6 + 1e-9 * limits.max_velocity {
            found.push(format!("{} does not end at rest: {}", limits.name, last[0]));
        }
    }
    found
}

fn settings() -> MotionSettings {
    MotionSettings::default()
}

/// Returns machines of the four kinematics, with and without a limit on jerk.
fn machines() -> Vec<Machine> {
    let mut all = Vec::new();
    for time_s in [0.0, 0.1] {
        for name in ["ion-beam", "ion-beam-xyz", "bonnet-five-axis", "spindle"] {
            all.push(fixture(name, |file| file["time_to_full_acceleration_s"] = time_s.into()));
        }
    }
    all
}

/// The environment variable PLANISH_CASES sets the number of motions per machine: 12500 make 1e5 in all.
#[test]
fn random_motions_keep_every_limit_and_the_path() {
    let cases: u64 = env::var("PLANISH_CASES").map_or(25, |n| n.parse().unwrap());
    let forms = [
        plane(),
        Form::sphere(-120.0, [0.0; 2]).unwrap(),
        Form::new(
            &serde_json::from_value(
                json!({"kind": "conic", "radius_mm": 400.0, "conic_constant": -1.2,
                "off_axis_mm": [80.0, 0.0], "height_along": "normal"}),
            )
            .unwrap(),
            None,
        )
        .unwrap(),
    ];
    let (mut refused, mut slowed) = (0, 0);
    for (m, machine) in machines().iter().enumerate() {
        for case in 0..cases {
            let mut random = case_generator(14, m as u64, case);
            let plan = wander(&mut random);
            let form = &forms[case as usize % forms.len()];
            let made = match motion(&plan, machine, form, &settings()) {
                Ok(made) => made,
                Err(e) => {
                    // Only a path through the centre of the spindle cannot be followed.
                    assert!(e.to_string().contains("from the centre of the spindle"), "{e}");
                    refused += 1;
                    continue;
                }
            };
            let (axes, report) = made;
            let problems = exceeded(&axes, machine);
            assert!(problems.is_empty(), "{} case {case}: {problems:?}", machine.name());
            // The tolerance of the settings.
            assert!(
                report.contact_deviation_um < 2.0,
                "{} case {case}: {report:?}",
                machine.name()
            );
            // Rounding of a sum of some hundred durations.
            assert!(report.total_time_s >= report.planned_time_s * (1.0 - 1e-12), "{report:?}");
            slowed += usize::from(report.slowed.is_some());
        }
    }
    let all = 8 * cases as usize;
    assert!(refused <= all / 50, "{refused} of {all} refused");
    assert!(slowed > all / 10, "{slowed} of {all} needed to be slowed down");
}

#[test]
fn a_flat_part_on_a_machine_of_two_axes_keeps_every_bit() {
    let plan = wander(&mut case_generator(14, 100, 0));
    // Limits that nothing reaches.
    let fast = |file: &mut Value| {
        for axis in file["axes"].as_array_mut().unwrap() {
            axis["max_velocity_mm_per_s"] = 1e6.into();
            axis["max_acceleration_mm_per_s2"] = 1e9.into();
        }
        file["time_to_full_acceleration_s"] = 0.into();
    };
    let machine = fixture("ion-beam", fast);
    let (axes, report) = motion(&plan, &machine, &plane(), &settings()).unwrap();
    assert_eq!(axes.break_time_s(), plan.break_time_s());
    for i in 0..plan.len() {
        assert_eq!(axes.segment(i), plan.coefficient_mm()[i]);
    }
    assert_eq!((report.contact_deviation_um, report.slowed), (0.0, None));
    // On a part that lies elsewhere: what planish-verify and planish-export make of the motion.
    let placed = fixture("ion-beam-lab", fast);
    let there = placed.part_to_axes().unwrap().trajectory(&plan).unwrap();
    let (axes, _) = motion(&plan, &placed, &plane(), &settings()).unwrap();
    assert!((0..plan.len()).all(|i| axes.segment(i) == there.coefficient_mm()[i]));
}

#[test]
fn a_flat_part_on_five_axes_moves_x_and_y_alone() {
    let plan = wander(&mut case_generator(14, 101, 0));
    let machine = fixture("bonnet-five-axis", |file| {
        file["kinematics"]["pivot_mm"] = 0.into();
        file["time_to_full_acceleration_s"] = 0.into();
        for axis in file["axes"].as_array_mut().unwrap() {
            axis["max_velocity_mm_per_s"] = 1e6.into();
            axis["max_acceleration_mm_per_s2"] = 1e9.into();
        }
    });
    let (axes, report) = motion(&plan, &machine, &plane(), &settings()).unwrap();
    assert_eq!(axes.len(), plan.len());
    for i in 0..plan.len() {
        for (k, c) in axes.segment(i).iter().enumerate() {
            for (order, v) in c.iter().enumerate() {
                let expected = if k < 2 { plan.coefficient_mm()[i][k][order] } else { 0.0 };
                // Rounding of positions of 40 mm over h^order, h >= 0.05 s.
                let rounding = 40.0 * 1e-15 * 0.05_f64.powi(-(order as i32)) * 6.0;
                assert!(
                    (v - expected).abs() <= rounding,
                    "axis {k}, order {order}: {v} {expected}"
                );
            }
        }
    }
    // Rounding of positions of 40 mm: 1e-11 um.
    assert!(report.contact_deviation_um < 1e-9 && report.slowed.is_none(), "{report:?}");
}

#[test]
fn a_pivot_in_the_centre_of_a_sphere_moves_the_tilts_alone() {
    let machine =
        fixture("bonnet-five-axis", |file| file["kinematics"]["pivot_mm"] = (-150).into());
    let sphere = Form::sphere(-150.0, [0.0; 2]).unwrap();
    let plan = pass([-40.0, -20.0], [40.0, 25.0], 20.0);
    let (axes, report) = motion(&plan, &machine, &sphere, &settings()).unwrap();
    for i in 0..axes.len() {
        for c in &axes.segment(i)[..3] {
            // Roundings of 150 mm, and over a duration of 0.1 s and more.
            let h = axes.duration_s(i);
            let motion = c.iter().enumerate().map(|(order, v)| (v * h.powi(order as i32)).abs());
            assert!(motion.fold(0.0, f64::max) < 1e-12, "segment {i}: {c:?}");
        }
    }
    // The tolerance of the settings.
    assert!(axes.segment(0)[3] != [0.0; 4] && report.contact_deviation_um < 2.0, "{report:?}");
}

#[test]
fn along_a_cylinder_the_tilts_stand_still() {
    let machine = fixture("bonnet-five-axis", |_| {});
    let cylinder = Form::new(
        &serde_json::from_value(json!({"kind": "cylinder", "radius_mm": 90.0})).unwrap(),
        None,
    )
    .unwrap();
    let plan = pass([25.0, -40.0], [25.0, 40.0], 20.0);
    let (axes, _) = motion(&plan, &machine, &cylinder, &settings()).unwrap();
    let tilt = -(25.0_f64 / 90.0).asin().to_degrees();
    for i in 0..axes.len() {
        let [a, b] = [axes.segment(i)[3], axes.segment(i)[4]];
        // Rounding of angles of 16 degrees.
        assert!(a.iter().all(|v| v.abs() < 1e-12), "{a:?}");
        assert!((b[0] - tilt).abs() < 1e-12 && b[1..].iter().all(|v| v.abs() < 1e-12), "{b:?}");
    }
}

/// The pass has the distance d from the centre of a spindle: c turns by half a turn, at most at the speed v / d.
#[test]
fn a_spindle_is_slowed_down_near_its_centre_and_says_what_that_costs() {
    let machine = fixture("spindle", |file| file["time_to_full_acceleration_s"] = 0.into());
    let d = 0.5;
    let plan = pass([-30.0, d], [30.0, d], 6.0);
    let (axes, report) = motion(&plan, &machine, &plane(), &settings()).unwrap();
    assert!(exceeded(&axes, &machine).is_empty());
    let spindle = report.spindle.as_ref().unwrap();
    let slowed = report.slowed.as_ref().unwrap();
    assert_eq!(slowed.axis, "c");
    // The speed in the middle is 1.5 times the mean, 15 mm/s: v d / r^2 > C below r = sqrt(v d / C).
    let limit_rad: f64 = 1800.0_f64.to_radians();
    assert!(15.0 / d < limit_rad, "the velocity alone would be kept");
    assert_eq!(spindle.c_limit_radius_mm, 0.0);
    // The nearest node is the one in the middle of the pass. Regression bound: no difference was seen.
    assert!((spindle.least_radius_mm / d - 1.0).abs() < 0.05, "{spindle:?}");
    // c turns from 180 - e to e, e = atan(d / 30).
    let turned = axes.position(axes.len() - 1, axes.duration_s(axes.len() - 1))[2]
        - axes.position(0, 0.0)[2];
    let expected = -(180.0 - 2.0 * (d / 30.0_f64).atan().to_degrees());
    // The ends are nodes: rounding of 180 degrees.
    assert!((turned - expected).abs() < 1e-9, "{turned} {expected}");
    // Half a turn at 3600 deg/s^2, to and fro, takes 2 sqrt(180 / 3600) s at least; the plan gives about d / v.
    assert!(
        report.total_time_s > report.planned_time_s && report.total_time_s < 12.0,
        "{report:?}"
    );
    // The tolerance of the settings.
    assert!(report.contact_deviation_um < 2.0, "{report:?}");

    let near = pass([-30.0, 0.05], [30.0, 0.05], 6.0);
    let (_, report) = motion(&near, &machine, &plane(), &settings()).unwrap();
    let spindle = report.spindle.unwrap();
    // r = sqrt(v d / C) = sqrt(15 * 0.05 / 31.4) mm; nodes beside it are known to their distance only.
    let radius = (15.0 * 0.05 / limit_rad).sqrt();
    assert!(
        spindle.c_limit_radius_mm > 0.5 * radius && spindle.c_limit_radius_mm < 1.01 * radius,
        "{spindle:?}"
    );
    assert!(spindle.added_time_within_s > 0.0);

    let through = pass([-30.0, 0.0], [30.0, 0.0], 6.0);
    let message = motion(&through, &machine, &plane(), &settings()).unwrap_err().to_string();
    assert!(
        message.contains("mm from the centre of the spindle; lead the path farther"),
        "{message}"
    );
}

/// Returns `plan` after adding `velocity`, mm/s, and `acceleration` (half of it, mm/s^2) to the coefficients of its
/// first cubic.
fn disturbed(plan: &Trajectory, velocity: [f64; 2], acceleration: [f64; 2]) -> Trajectory {
    let mut c = plan.coefficient_mm().to_vec();
    for k in 0..2 {
        c[0][k][1] += velocity[k];
        c[0][k][2] += acceleration[k];
    }
    let (on, index) = (plan.tool_on().to_vec(), plan.dwell_index().to_vec());
    Trajectory::new(plan.break_time_s().to_vec(), c, on, index).unwrap()
}

/// A plan that rests in the centre of the spindle has no direction there; the first derivative that moves it gives one.
/// Rounding of the lower derivatives, in any direction, changes nothing.
#[test]
fn a_plan_that_starts_or_ends_in_the_centre_does_not_depend_on_rounding() {
    let machine = fixture("spindle", |_| {});
    // From rest, with an acceleration, or with a jerk alone, towards (2, -1); and an arc of a spiral r = 4 t^2 mm.
    let straight = pass([0.0, 0.0], [20.0, -10.0], 3.0);
    let slowly = Trajectory::new(
        vec![0.0, 1.0, 3.0],
        vec![
            [[0.0, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, -1.0]],
            // From 2 mm at 6 mm/s to rest at 10 mm.
            [[2.0, 6.0, 0.0, -0.5], [-1.0, -3.0, 0.0, 0.25]],
        ],
        vec![true; 2],
        vec![Some(0), Some(1)],
    )
    .unwrap();
    let spiral = {
        let point = |k: u32| {
            let t = 0.05 * f64::from(k);
            let (r, angle) = (4.0 * t * t, 0.5 + 1.2 * t);
            [r * angle.cos(), r * angle.sin()]
        };
        let velocity = |k: u32| {
            let t = 0.05 * f64::from(k);
            let (r, angle, dr) = (4.0 * t * t, 0.5 + 1.2 * t, 8.0 * t);
            let (s, c) = angle.sin_cos();
            if k == 40 { [0.0; 2] } else { [dr * c - 1.2 * r * s, dr * s + 1.2 * r * c] }
        };
        let points: Vec<[f64; 2]> = (0..=40).map(point).collect();
        let velocities: Vec<[f64; 2]> = (0..=40).map(velocity).collect();
        through(&points, &velocities, 0.05)
    };
    for (plan, angle_rad) in
        [(straight, (-0.5_f64).atan()), (slowly, (-0.5_f64).atan()), (spiral, 0.5)]
    {
        let (axes, report) = motion(&plan, &machine, &plane(), &settings()).unwrap();
        assert!(exceeded(&axes, &machine).is_empty(), "{:?}", exceeded(&axes, &machine));
        let c_deg = axes.position(0, 0.0)[2];
        // The cubic through the first points of the spiral begins within 2 degrees of its direction.
        assert!((c_deg - angle_rad.to_degrees()).abs() < 2.0, "{c_deg} {angle_rad}");
        for k in 0..6 {
            let (s, c) = f64::from(k).sin_cos();
            let noisy = disturbed(&plan, [1e-16 * c, 1e-16 * s], [0.0; 2]);
            let noisier = disturbed(&plan, [-1e-15 * s, 1e-15 * c], [1e-14 * c, 1e-14 * s]);
            for plan in [noisy, noisier] {
                let (_, other) = motion(&plan, &machine, &plane(), &settings()).unwrap();
                let longer_s = other.total_time_s - report.total_time_s;
                // The slowing ends within 1e-4 of a limit.
                assert!(longer_s.abs() < 1e-4 * report.total_time_s, "{k}: {longer_s}");
            }
        }
    }
    let arriving = pass([20.0, -10.0], [0.0, 0.0], 3.0);
    let (axes, _) = motion(&arriving, &machine, &plane(), &settings()).unwrap();
    let last = axes.len() - 1;
    let turned = axes.position(last, axes.duration_s(last))[2] - axes.position(0, 0.0)[2];
    // A straight line to the centre: c rests. Rounding of coordinates over the last radius of the pieces.
    assert!(turned.abs() < 1e-6, "{turned}");
}

#[test]
fn the_largest_angle_to_the_normal_is_found_between_the_ends_of_segments() {
    // The centre of a sphere of 100 mm lies 10 mm beside that of the spindle, which tilts in the plane of the radius
    // alone: the sine of the angle is 10 / 100 times that of the azimuth, most where the tool passes beside the centre.
    let machine = fixture("spindle", |file| file["part_origin_mm"] = json!([10.0, 0.0]));
    let sphere = Form::sphere(100.0, [0.0, 0.0]).unwrap();
    let largest = 0.1_f64.asin().to_degrees();
    for from in [-30.0, -33.0, -41.0] {
        let plan = pass([from, 24.0], [15.0, 24.0], 6.0);
        let (_, report) = motion(&plan, &machine, &sphere, &settings()).unwrap();
        // The tolerance of the contact point, 1 um, beside 24 mm.
        assert!((report.off_normal_deg / largest - 1.0).abs() < 1e-4, "{report:?} {largest}");
    }
    // A tool along z is off by the slope: at the far end of a pass that no segment of its own ends at.
    let xyz = fixture("ion-beam-xyz", |_| {});
    let (_, report) =
        motion(&pass([-20.0, 0.0], [30.0, 0.0], 6.0), &xyz, &sphere, &settings()).unwrap();
    assert!((report.off_normal_deg - 0.3_f64.asin().to_degrees()).abs() < 1e-3, "{report:?}");
}

#[test]
fn a_motion_is_slowed_down_only_where_a_limit_asks_for_it() {
    // The plan moves at 15 mm/s at most; the middle of the sphere asks for 8.6 deg/s of b.
    let machine = fixture("bonnet-five-axis", |file| {
        file["rotary_axes"][1]["max_velocity_deg_per_s"] = 8.0.into();
        file["time_to_full_acceleration_s"] = 0.into();
    });
    let sphere = Form::sphere(-100.0, [0.0; 2]).unwrap();
    let plan = pass([-40.0, 0.0], [40.0, 0.0], 8.0);
    let (axes, report) = motion(&plan, &machine, &sphere, &settings()).unwrap();
    assert!(exceeded(&axes, &machine).is_empty());
    let slowed = report.slowed.unwrap();
    assert_eq!((slowed.axis.as_str(), slowed.quantity.as_str()), ("b", "velocity"));
    // b' = v / (R cos b): the speed 1.5 * 80 / 8 mm/s in the middle gives 8.59 deg/s, and more beside it.
    let least = 15.0 / 100.0 * 1_f64.to_degrees() / 8.0;
    // At the edge b = 23.6 degrees, where the speed is lower: the ratio stays below that of the largest speed there.
    assert!(slowed.ratio >= least * 0.999 && slowed.ratio < least * 1.1, "{slowed:?}");
    // Regression bound: 1.0001 was seen.
    assert!(slowed.largest_stretch < slowed.ratio * 1.05, "{slowed:?}");
    assert!(report.total_time_s < report.planned_time_s * slowed.ratio, "{}", report.total_time_s);
    let added = report.total_time_s - report.planned_time_s;
    // Rounding of a sum of some hundred durations.
    assert!((report.added_tool_on_time_s - added).abs() < 1e-9);
}

#[test]
fn the_executed_contact_point_is_that_of_the_axes() {
    for (m, name) in
        ["ion-beam", "ion-beam-xyz", "bonnet-five-axis", "spindle"].into_iter().enumerate()
    {
        let machine = fixture(name, |file| file["time_to_full_acceleration_s"] = 0.into());
        let sphere = Form::sphere(200.0, [0.0; 2]).unwrap();
        // Away from the centre of the spindle.
        let plan = pass([-20.0, 12.0], [30.0, 25.0], 5.0);
        let (axes, report) = motion(&plan, &machine, &sphere, &settings()).unwrap();
        let (executed, found) = contact(&axes, &machine, &sphere).unwrap();
        // The executed contact point is found within 1e-3 um.
        assert!(found.deviation_um <= 1e-3, "{name}: {found:?}");
        // Rounding of a sum of some hundred durations of 5 s in all.
        assert!((executed.total_time_s() - axes.total_time_s()).abs() < 1e-12);
        // Distance from the line of the pass: 50 x 13 mm.
        let (mut farthest, length): (f64, f64) = (0.0, 50.0_f64.hypot(13.0));
        let mut end = [[0.0; 2]; 2];
        for (i, segment) in executed.segments().enumerate() {
            for j in 0..=8 {
                let p = segment.position_mm(segment.duration_s * f64::from(j) / 8.0);
                farthest =
                    farthest.max((((p[0] + 20.0) * 13.0 - (p[1] - 12.0) * 50.0) / length).abs());
            }
            let at = |u: f64| {
                [0, 1].map(|k| {
                    let [c0, c1, c2, c3] = segment.coefficient_mm[k];
                    [c0 + u * (c1 + u * (c2 + u * c3)), c1 + u * (2.0 * c2 + 3.0 * u * c3)]
                })
            };
            let start = at(0.0);
            if i > 0 {
                // Positions to rounding, velocities to the 1e-9 of their differences.
                let off = |k: usize, order: usize| (start[k][order] - end[k][order]).abs();
                assert!(
                    (0..2).all(|k| off(k, 0) < 1e-10 && off(k, 1) < 1e-6),
                    "machine {m}: {start:?} {end:?}"
                );
            }
            end = at(segment.duration_s);
        }
        // The largest distance may lie between the points that the report looks at.
        assert!(
            farthest < 2e-3 && farthest <= 1.2e-3 * report.contact_deviation_um + 2e-6,
            "{name}: {farthest} {report:?}"
        );
    }
}

#[test]
fn what_cannot_be_made_is_refused() {
    let machine = fixture("bonnet-five-axis", |_| {});
    let plan = pass([-20.0, 0.0], [20.0, 0.0], 5.0);
    let small = Form::sphere(15.0, [0.0; 2]).unwrap();
    let said = |form: &Form, um| {
        motion(&plan, &machine, form, &MotionSettings { contact_tolerance_um: um })
            .unwrap_err()
            .to_string()
    };
    assert!(said(&small, 2.0).contains("where the form does not exist; give a form that covers"));
    for um in [0.0, -1.0, f64::NAN, 1e9] {
        assert!(said(&plane(), um).contains("contact_tolerance_um: is"), "{um}");
    }
    let (axes, _) = motion(&plan, &machine, &plane(), &settings()).unwrap();
    let other = fixture("ion-beam", |_| {});
    let message = contact(&axes, &other, &plane()).unwrap_err().to_string();
    assert!(
        message.contains("coefficient_mm_or_deg: has 5 axes, and the machine has 2"),
        "{message}"
    );
}
