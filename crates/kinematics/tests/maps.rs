//! Positions of the axes against closed forms, differences, and the way back.

use planish_form::Form;
use planish_kinematics::{AxisMap, Series};
use planish_types::Machine;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

const XYZ: [&str; 3] = ["x", "y", "z"];

fn machine(kinematics: Value, linear: &[&str], rotary: &[&str], more: Value) -> Machine {
    let linear = linear.iter().map(|name| {
        json!({"name": name, "max_velocity_mm_per_s": 100.0, "max_acceleration_mm_per_s2": 1000.0})
    });
    let rotary = rotary.iter().map(|name| {
        json!({"name": name, "max_velocity_deg_per_s": 50.0, "max_acceleration_deg_per_s2": 500.0})
    });
    let mut file = json!({"name": "m", "kinematics": kinematics, "axes": linear.collect::<Vec<_>>(),
        "rotary_axes": rotary.collect::<Vec<_>>()});
    for (key, value) in more.as_object().unwrap() {
        file[key] = value.clone();
    }
    Machine::new(serde_json::from_value(file).unwrap()).unwrap()
}

fn tilts(pivot_mm: f64, tilts: [&str; 2], more: Value) -> Machine {
    let kinematics = json!({"kind": "xyz-tilts", "pivot_mm": pivot_mm, "tilts": tilts});
    machine(kinematics, &XYZ, &["a", "b"], more)
}

fn spindle(pivot_mm: Option<f64>, linear: &[&str], more: Value) -> Machine {
    let contact = json!({"max_velocity_mm_per_s": 20.0, "max_acceleration_mm_per_s2": 100.0});
    let mut kinematics = json!({"kind": "spindle", "contact": contact});
    if let Some(pivot) = pivot_mm {
        kinematics["pivot_mm"] = pivot.into();
    }
    let rotary: &[&str] = if pivot_mm.is_some() { &["c", "b"] } else { &["c"] };
    machine(kinematics, linear, rotary, more)
}

/// Returns a placement of the part on the machine: turned, mirrored and moved.
fn placed() -> Value {
    json!({"part_rotation_deg": 30.0, "part_origin_mm": [7.0, -3.0], "part_origin_z_mm": 11.0})
}

fn form(text: &str) -> Form {
    Form::new(&serde_json::from_str(text).unwrap(), None).unwrap()
}

fn forms() -> [Form; 3] {
    [
        form(r#"{"kind": "plane"}"#),
        Form::sphere(-90.0, [2.0, 1.0]).unwrap(),
        form(
            r#"{"kind": "conic", "radius_mm": 300, "conic_constant": -0.8, "off_axis_mm": [60, 10],
                "height_along": "normal"}"#,
        ),
    ]
}

/// Returns machines of the four kinematics, each also with the part placed elsewhere.
fn machines() -> Vec<Machine> {
    vec![
        machine(json!({"kind": "xy"}), &["x", "y"], &[], json!({"part_rotation_deg": 30.0})),
        machine(json!({"kind": "xyz"}), &XYZ, &[], placed()),
        tilts(80.0, ["a", "b"], json!({})),
        tilts(-150.0, ["b", "a"], placed()),
        spindle(None, &["r"], json!({})),
        spindle(None, &["r", "z"], placed()),
        spindle(Some(60.0), &["r", "z"], json!({"part_origin_mm": [7.0, -3.0]})),
    ]
}

fn values(axes: &[Series]) -> Vec<f64> {
    axes.iter().map(|q| q.value).collect()
}

fn resting(point_mm: [f64; 2]) -> [Series; 2] {
    point_mm.map(Series::constant)
}

#[test]
fn the_contact_point_of_the_axes_is_the_point_they_were_made_for() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for (m, machine) in machines().iter().enumerate() {
        for form in &forms() {
            let map = AxisMap::new(machine, form).unwrap();
            for _ in 0..200 {
                let p = [0, 1].map(|_| random.random_range(-30.0..30.0));
                let axes = map.positions(resting(p)).unwrap();
                assert_eq!(axes.len(), machine.axes().len());
                let contact = map.contact(&values(&axes)).unwrap();
                // Coordinates and pivots of 150 mm have roundings of 3e-14 mm, angles in degrees of 1e-14 of 150 mm.
                let off = (0..2).map(|k| (contact.point_mm[k] - p[k]).abs()).fold(0.0, f64::max);
                assert!(
                    off < 1e-11 && contact.gap_mm.abs() < 1e-11,
                    "machine {m}: {off} {contact:?}"
                );
            }
        }
    }
}

#[test]
fn derivatives_along_a_curve_are_those_of_differences() {
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for (m, machine) in machines().iter().enumerate() {
        for form in &forms() {
            let map = AxisMap::new(machine, form).unwrap();
            for _ in 0..20 {
                let angle: f64 = random.random_range(-3.0..3.0);
                // Away from the axis of the spindle, where derivatives of the azimuth are large.
                let p = [30.0 * angle.sin() + 3.0, 30.0 * angle.cos()];
                let turn: f64 = random.random_range(-3.0..3.0);
                let (t, k) = ([turn.cos(), turn.sin()], random.random_range(-0.1..0.1));
                let found = map.along(p, t, k).unwrap();
                // A point of the circle of curvature at the arc length s.
                let at = |s: f64| {
                    let (sine, cosine) = (k * s).sin_cos();
                    let (u, v) = (sine / k, (1.0 - cosine) / k);
                    let q = [p[0] + u * t[0] - v * t[1], p[1] + u * t[1] + v * t[0]];
                    values(&map.positions(resting(q)).unwrap())
                };
                let d = 1e-2;
                let (before, here, after) = (at(-d), at(0.0), at(d));
                for (i, [value, first, second]) in found.iter().enumerate() {
                    // The same formulas: rounding.
                    assert!((value - here[i]).abs() < 1e-12 * (1.0 + here[i].abs()), "axis {i}");
                    let (b, h, a) = (before[i], here[i], after[i]);
                    if (a - b).abs() > 180.0 {
                        continue; // the azimuth jumps by a turn
                    }
                    // Errors d^2 / 6 q''' and d^2 / 12 q'''': angles in degrees change over lengths of 10 mm and more,
                    // so that q''' is below 0.1 and q'''' below 0.01; rounding is 1e-13 / d^2.
                    let slope = (a - b) / (2.0 * d);
                    let bend = (a - 2.0 * h + b) / (d * d);
                    assert!((first - slope).abs() < 5e-6, "machine {m}, axis {i}: {first} {slope}");
                    assert!((second - bend).abs() < 5e-6, "machine {m}, axis {i}: {second} {bend}");
                }
            }
        }
    }
}

#[test]
fn a_flat_part_leaves_x_and_y_as_they_are() {
    let plane = Form::new(&planish_form::FormFile::plane(), None).unwrap();
    let map = AxisMap::new(&tilts(0.0, ["a", "b"], json!({})), &plane).unwrap();
    let found = map.along([12.5, -3.25], [0.6, 0.8], 0.02).unwrap();
    assert_eq!(found[..2], [[12.5, 0.6, 0.02 * -0.8], [-3.25, 0.8, 0.02 * 0.6]]);
    assert!(found[2..].iter().flatten().all(|v| *v == 0.0), "{found:?}");
}

/// A tilted plane: the tilts stand still at its angle, and the linear axes move as on the plane that lies flat, turned.
#[test]
fn a_tilted_plane_turns_the_motion() {
    // A map that is linear in x is the plane tilted about y by the angle alpha.
    let alpha: f64 = 0.2;
    let slope = alpha.tan();
    let axis =
        planish_types::Axis::from_coordinates("x_mm", &[-40.0, -20.0, 0.0, 20.0, 40.0]).unwrap();
    let heights = |j: usize| (axis.coordinate_mm(j) * slope) * 1e6;
    let grid = planish_types::Grid { x: axis, y: axis };
    let map = ndarray_of(5, heights);
    let plane = Form::sampled(&planish_types::Surface::new(grid, map).unwrap()).unwrap();
    for order in [["a", "b"], ["b", "a"]] {
        let map = AxisMap::new(&tilts(50.0, order, json!({})), &plane).unwrap();
        let found = map.along([10.0, 5.0], [1.0, 0.0], 0.0).unwrap();
        // The normal (-sin, 0, cos): a = 0, b = -alpha. Heights of the map are rounded to 1e-10 mm.
        let expected = [
            [10.0 - 50.0 * alpha.sin(), 1.0, 0.0],
            [5.0, 0.0, 0.0],
            [10.0 * slope + 50.0 * (alpha.cos() - 1.0), slope, 0.0],
            [0.0; 3],
            [-alpha.to_degrees(), 0.0, 0.0],
        ];
        for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
            assert!((found - expected).abs() < 1e-8, "{found} {expected}");
        }
    }
}

fn ndarray_of(n: usize, height: impl Fn(usize) -> f64) -> ndarray::Array2<f64> {
    ndarray::Array2::from_shape_fn((n, n), |(_, j)| height(j))
}

#[test]
fn a_pivot_in_the_centre_of_a_sphere_lets_the_linear_axes_stand_still() {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    for (radius, order) in [(120.0, ["a", "b"]), (-120.0, ["b", "a"])] {
        let sphere = Form::sphere(radius, [4.0, -2.0]).unwrap();
        // Concave: the centre is above the vertex, along the normal. Convex: below.
        let map = AxisMap::new(&tilts(radius, order, json!({})), &sphere).unwrap();
        for _ in 0..100 {
            let p = [0, 1].map(|_| random.random_range(-50.0..50.0));
            let angle: f64 = random.random_range(-3.0..3.0);
            let found = map.along(p, [angle.cos(), angle.sin()], 0.05).unwrap();
            for (axis, centre) in found.iter().zip([4.0, -2.0, 0.0]) {
                // Roundings of 120 mm, and of 120 mm times curvatures of 1/120 mm from differences over 1e-3 mm.
                let [value, first, second] = *axis;
                assert!((value - centre).abs() < 1e-12 && first.abs() < 1e-13, "{found:?}");
                assert!(second.abs() < 1e-9, "{found:?}");
            }
            // The normal turns by 1 / R over the length of the surface, which is longer than that in the plane.
            let turns = found[3][1].hypot(found[4][1]);
            // Longer but for the rounding of derivatives from differences.
            assert!(turns > (1.0 - 1e-9) * 120_f64.recip().to_degrees(), "the tilts move: {turns}");
        }
    }
}

#[test]
fn along_a_cylinder_the_tilts_stand_still() {
    let cylinder = form(r#"{"kind": "cylinder", "radius_mm": 70}"#);
    for machine in [tilts(40.0, ["a", "b"], json!({})), tilts(40.0, ["b", "a"], placed())] {
        let map = AxisMap::new(&machine, &cylinder).unwrap();
        let found = map.along([20.0, 8.0], [0.0, 1.0], 0.0).unwrap();
        let tilt = found[4][0];
        assert!(tilt.abs() > 10.0, "{found:?}");
        for axis in &found[3..] {
            // Below: rounding of angles, of which nothing changes.
            assert!(axis[1].abs() < 1e-13 && axis[2].abs() < 1e-13, "{found:?}");
        }
        let not_tilted = map.along([0.0, 8.0], [0.0, 1.0], 0.0).unwrap();
        // Rounding of angles.
        assert!(not_tilted[3][0].abs() < 1e-12 && not_tilted[4][0].abs() < 1e-12);
    }
}

#[test]
fn a_spiral_at_constant_speed_turns_as_the_root_of_time() {
    // r = e c, v t = e c^2 / 2 to relative order 1 / c^2 (the length of an Archimedean spiral).
    let plane = form(r#"{"kind": "plane"}"#);
    let map = AxisMap::new(&spindle(None, &["r"], json!({})), &plane).unwrap();
    let (e, speed) = (0.1, 5.0);
    let angle = |turns: f64| turns * std::f64::consts::TAU;
    let length = |c: f64| 0.5 * e * (c * (1.0 + c * c).sqrt() + c.asinh());
    let at = |turns: f64| {
        let c = angle(turns);
        let p = [e * c * c.cos(), e * c * c.sin()];
        (values(&map.positions(resting(p)).unwrap()), length(c) / speed)
    };
    // Whole turns and an eighth: the azimuth is 45 degrees, r grows by 2 pi e a turn.
    for turns in [20.125, 40.125, 80.125] {
        let (q, t) = at(turns);
        // Rounding of degrees after up to 80 turns, and of a radius.
        assert!((q[1] - 45.0).abs() < 1e-10 && (q[0] - e * angle(turns)).abs() < 1e-12, "{q:?}");
        let root = (2.0 * speed * t / e).sqrt();
        assert!(
            (root / angle(turns) - 1.0).abs() < 2.0 * angle(turns).powi(-2) * angle(turns).ln(),
            "{root}"
        );
    }
}

#[test]
fn the_centre_of_a_spindle_takes_the_direction_of_the_motion() {
    let plane = form(r#"{"kind": "plane"}"#);
    let map = AxisMap::new(&spindle(None, &["r"], json!({})), &plane).unwrap();
    // A circle of radius 4 through the centre: the azimuth turns by half the angle of the circle.
    let found = map.along([0.0, 0.0], [0.0, 1.0], -0.25).unwrap();
    assert_eq!(found[0][..2], [0.0, 1.0]);
    // Below: rounding of degrees.
    assert!(
        (found[1][0] - 90.0).abs() < 1e-13 && (found[1][1] + 0.125_f64.to_degrees()).abs() < 1e-13
    );
    let s: f64 = 0.01;
    let beside = [4.0 - 4.0 * (s / 4.0).cos(), 4.0 * (s / 4.0).sin()];
    let q = values(&map.positions(resting(beside)).unwrap());
    // The azimuth is linear along the circle. A place of 1e-16 mm at 0.01 mm from the axis is 1e-12 degrees.
    assert!((q[1] - found[1][0] - s * found[1][1]).abs() < 1e-10, "{q:?}");
}

#[test]
fn the_tool_is_off_the_normal_by_what_the_machine_cannot_tilt() {
    let sphere = Form::sphere(100.0, [0.0, 0.0]).unwrap();
    let at = |machine: &Machine, p| {
        let map = AxisMap::new(machine, &sphere).unwrap();
        let q = values(&map.positions(resting(p)).unwrap());
        map.contact(&q).unwrap().off_normal_deg
    };
    let slope = 0.3_f64.asin().to_degrees();
    let xyz = machine(json!({"kind": "xyz"}), &XYZ, &[], json!({}));
    // Below: the contact point is found to 1e-12 mm of a sphere of 100 mm, and to the rounding of degrees.
    assert!((at(&xyz, [18.0, 24.0]) - slope).abs() < 1e-11);
    assert!(at(&tilts(50.0, ["a", "b"], json!({})), [18.0, 24.0]) < 1e-11);
    // Centred, the normal lies in the plane of the radius. With the centre at distance 10 beside it, at the same radius
    // across: the normal has 10 / 100 across the plane.
    assert!(at(&spindle(Some(50.0), &["r", "z"], json!({})), [18.0, 24.0]) < 1e-11);
    let beside = spindle(Some(50.0), &["r", "z"], json!({"part_origin_mm": [10.0, 0.0]}));
    let found = at(&beside, [-10.0, 24.0]);
    // As above.
    assert!((found - 0.1_f64.asin().to_degrees()).abs() < 1e-11, "{found}");
}
