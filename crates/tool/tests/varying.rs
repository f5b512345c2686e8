//! Tools that vary over the part, through the program: footprints against a sum in three dimensions, pads, rates.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::{Tool, artifact};
use planish_testkit::program::{text, write};
use planish_types::{Axis, Grid, Pose, Surface, Tif};

/// Radius of the sphere, mm; its edge is 30 degrees steep.
pub const RADIUS_MM: f64 = 36.0;

/// Standard deviations of the spot along x and y, mm.
const SIGMA_MM: [f64; 2] = [1.6, 1.1];

fn run(dir: &Path, arguments: &[&str]) -> Output {
    let mut command = planish_testkit::program::stage("planish-tool");
    command.current_dir(dir).args(arguments).output().unwrap()
}

fn done(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    text(&output.stdout)
}

fn refused(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, arguments);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}");
    assert!(!dir.join("refused").exists());
    text(&output.stderr)
}

pub fn grid() -> Grid {
    let axis = Axis::new(-18.0, 0.5, 73).unwrap();
    Grid { x: axis, y: axis }
}

/// Makes the map of a disk of 36 mm diameter; `nm` gives the height, nm, at [x, y].
pub fn disk(nm: impl Fn(f64, f64) -> f64) -> Surface {
    let grid = grid();
    let map = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
        if x.hypot(y) <= 18.0 { nm(x, y) } else { f64::NAN }
    });
    Surface::new(grid, map).unwrap()
}

pub fn sphere_mm(x: f64, y: f64) -> f64 {
    RADIUS_MM - (RADIUS_MM * RADIUS_MM - x * x - y * y).sqrt()
}

pub fn spot() -> Tif {
    let axis = Axis::new(-6.0, 0.25, 49).unwrap();
    let grid = Grid { x: axis, y: axis };
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        gaussian([axis.coordinate_mm(c), axis.coordinate_mm(r)])
    });
    Tif::new(grid, rate).unwrap()
}

fn gaussian([x, y]: [f64; 2]) -> f64 {
    let [a, b] = SIGMA_MM;
    10.0 * (-0.5 * ((x / a).powi(2) + (y / b).powi(2))).exp()
}

#[test]
fn an_invalid_pixel_of_the_form_is_refused_where_the_part_has_one() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "part", &disk(|_, _| 0.0));
    write(dir, "spot", &spot());
    let holed = |x: f64, y: f64| {
        if (x - 9.0).hypot(y) < 0.4 { f64::NAN } else { 1e6 * sphere_mm(x, y) }
    };
    write(dir, "form", &disk(holed));
    write(dir, "whole", &disk(|x, y| 1e6 * sphere_mm(x, y)));
    let base =
        ["rate", "--tif", "spot", "--surface", "part", "--by", "incidence", "--exponent=-1.7"];
    let said = refused(dir, &[&base[..], &["--form", "form", "--out", "refused"]].concat());
    assert!(
        said.contains("form: form[36, 54]: is invalid or absent at (9.0000, 0.0000) mm"),
        "{said}"
    );
    assert!(said.contains("prepare --fill"), "{said}");
    // Footprints and spots take the same form.
    let foot = ["footprint", "--tif", "spot", "--surface", "part", "--direction", "normal"];
    let said = refused(dir, &[&foot[..], &["--form", "form", "--out", "refused"]].concat());
    assert!(said.contains("is invalid or absent at (9.0000, 0.0000) mm"), "{said}");

    // A map, a form file and the flag for a sphere say the same.
    fs::write(
        dir.join("sphere.json"),
        format!(r#"{{"kind": "sphere", "radius_mm": {RADIUS_MM}}}"#),
    )
    .unwrap();
    fs::write(dir.join("map.json"), r#"{"kind": "map", "surface": "whole"}"#).unwrap();
    let mut factors = Vec::new();
    let radius = RADIUS_MM.to_string();
    for (k, form) in [
        ["--form", "whole"],
        ["--form", "map.json"],
        ["--form", "sphere.json"],
        ["--sphere-radius-mm", radius.as_str()],
    ]
    .into_iter()
    .enumerate()
    {
        let out = format!("tool{k}");
        done(dir, &[&base[..], &form[..], &["--out", &out]].concat());
        let tool = artifact::read::<Tool>(&dir.join(&out)).unwrap().value.0;
        let factor = tool.variation().unwrap().pixel_factor().unwrap().factor.clone();
        factors.push(factor);
    }
    for ((r, c), z) in disk(|_, _| 0.0).height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
        let sine = grid().x.coordinate_mm(c).hypot(grid().y.coordinate_mm(r)) / RADIUS_MM + *z;
        let want = (1.0 - sine * sine).powf(-0.85);
        for (factor, most) in factors.iter().zip([3e-4, 3e-4, 1e-12, 1e-12]) {
            // At the edge the splines continue a height of 30 degrees quadratically: 1.4e-4 rad.
            let error = (factor[[r, c]] / want - 1.0).abs();
            assert!(error < most, "({r}, {c}): {error:e}");
        }
    }
    let said =
        refused(dir, &[&base[..], &["--sphere-radius-mm", "17", "--out", "refused"]].concat());
    assert!(said.contains("sphere_radius_mm: is 17 mm, but the map reaches 18 mm"), "{said}");
}

/// Returns the vector from `a` to `b`.
fn between(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|k| b[k] - a[k])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

/// Returns the point of the sphere over [x, y], and its normal towards the centre (0, 0, R), which lies above.
fn on_sphere([x, y]: [f64; 2]) -> ([f64; 3], [f64; 3]) {
    let point = [x, y, sphere_mm(x, y)];
    let normal = between(point, [0.0, 0.0, RADIUS_MM]).map(|v| v / RADIUS_MM);
    (point, normal)
}

/// Returns the removal along z at a pixel of a tool along the normal at p, in three dimensions: the depth along the
/// normal at the pixel, of a spot whose first axis is x turned with the normal by the shortest way in the plane of x
/// and z.
fn along_normal(p: [f64; 2], pixel: [f64; 2]) -> f64 {
    let ((contact, n), (point, at)) = (on_sphere(p), on_sphere(pixel));
    let d = between(contact, point);
    // The tangent in the plane y = const, of unit length, and the one perpendicular to it.
    let length = n[0].hypot(n[2]);
    let t1 = [n[2] / length, 0.0, -n[0] / length];
    let across: Vec<f64> = (0..3).map(|k| d[k] - dot(d, t1) * t1[k] - dot(d, n) * n[k]).collect();
    let sign = if across[1] < 0.0 { -1.0 } else { 1.0 };
    let b = sign * across.iter().map(|v| v * v).sum::<f64>().sqrt();
    gaussian([dot(d, t1), b]) / at[2]
}

/// Angle by which the part lies turned on the machine of [`along_normal_by_tilts`], degrees.
const PART_ROTATION_DEG: f64 = 25.0;

/// Returns the same where a tilt a about x carries a tilt b about y, by the rotation `Rx(a) Ry(b)` of the machine, on
/// which the part lies turned: the offset goes to the machine, back through the tilts, and back to the part.
fn along_normal_by_tilts(p: [f64; 2], pixel: [f64; 2]) -> f64 {
    let ((contact, n), (point, at)) = (on_sphere(p), on_sphere(pixel));
    let (sine, cosine) = PART_ROTATION_DEG.to_radians().sin_cos();
    let to_machine = |v: [f64; 3]| [cosine * v[0] - sine * v[1], sine * v[0] + cosine * v[1], v[2]];
    let (n, d) = (to_machine(n), to_machine(between(contact, point)));
    let (a, b) = ((-n[1]).atan2(n[2]), n[0].atan2(n[1].hypot(n[2])));
    // Rx(-a), then Ry(-b).
    let y = a.cos() * d[1] + a.sin() * d[2];
    let z = a.cos() * d[2] - a.sin() * d[1];
    let x = b.cos() * d[0] - b.sin() * z;
    gaussian([cosine * x + sine * y, cosine * y - sine * x]) / at[2]
}

/// Returns the same of rays from a source at this distance above the contact point, by the area that a bundle of rays
/// has on a flat part in the plane of the contact point and on the sphere; the yield is cos^-0.8.
fn along_rays(p: [f64; 2], pixel: [f64; 2], distance: f64) -> f64 {
    let ((contact, _), (point, n)) = (on_sphere(p), on_sphere(pixel));
    let source = [contact[0], contact[1], contact[2] + distance];
    let ray = between(source, point);
    let length = dot(ray, ray).sqrt();
    let meets = |k: usize| source[k] + ray[k] * (contact[2] - source[2]) / ray[2];
    let flat = [meets(0), meets(1), contact[2]];
    let of_flat = between(source, flat);
    let there = dot(of_flat, of_flat).sqrt();
    let cosine = |n: [f64; 3]| -dot(ray, n) / length;
    let (on_flat, on_part) = (cosine([0.0, 0.0, 1.0]), cosine(n));
    // The same solid angle: area of the surface = distance^2 / cosine of the incidence.
    let flux = (on_part / (length * length)) / (on_flat / (there * there));
    let rate = gaussian([flat[0] - contact[0], flat[1] - contact[1]]);
    rate * flux / n[2] * (on_part / on_flat).powf(-0.8)
}

#[test]
fn a_footprint_is_the_sum_in_three_dimensions() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let part = disk(|_, _| 0.0);
    write(dir, "part", &part);
    write(dir, "spot", &spot());
    fs::write(
        dir.join("sphere.json"),
        format!(r#"{{"kind": "sphere", "radius_mm": {RADIUS_MM}}}"#),
    )
    .unwrap();
    let base = [
        "footprint",
        "--tif",
        "spot",
        "--surface",
        "part",
        "--form",
        "sphere.json",
        "--error",
        "3e-4",
    ];
    let unstated = run(dir, &[&base[..], &["--direction", "normal", "--out", "normal"]].concat());
    let warned = text(&unstated.stderr);
    assert!(warned.contains("where a carries b, the spot lies turned"), "{warned}");
    let machine = planish_testkit::workspace().join("fixtures/machines/bonnet-five-axis.json");
    let mut machine: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(machine).unwrap()).unwrap();
    machine["kinematics"]["tilts"] = serde_json::json!(["a", "b"]);
    machine["part_rotation_deg"] = PART_ROTATION_DEG.into();
    fs::write(dir.join("machine.json"), machine.to_string()).unwrap();
    let tilts = ["--direction", "normal", "--machine", "machine.json", "--out", "tilts"];
    let stated = run(dir, &[&base[..], &tilts[..]].concat());
    assert_eq!(stated.status.code(), Some(0), "{}", text(&stated.stderr));
    assert!(!text(&stated.stderr).contains("warning"), "{}", text(&stated.stderr));
    let manifest = fs::read_to_string(dir.join("tilts/manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["settings"]["settings"]["carrier"], "a", "{manifest}");
    let beam = ["--direction", "fixed", "--exponent=-0.8", "--out", "parallel"];
    done(dir, &[&base[..], &beam[..]].concat());
    let beam = [
        "--direction",
        "fixed",
        "--exponent=-0.8",
        "--source-distance-mm",
        "60",
        "--out",
        "spread",
    ];
    done(dir, &[&base[..], &beam[..]].concat());

    // Forty places of the tool with times of 1 to 2 s: the removal of every pixel, by the tool that was written, and by
    // the sum in space.
    let places: Vec<([f64; 2], f64)> = (0..40)
        .map(|k| {
            let k = f64::from(k);
            let (r, phi) = (15.0 * (k / 40.0).sqrt(), 2.4 * k);
            ([r * phi.cos(), r * phi.sin()], 1.0 + (0.618 * k).fract())
        })
        .collect();
    type Sum = fn([f64; 2], [f64; 2]) -> f64;
    let cases: [(&str, Sum); 4] = [
        ("normal", along_normal),
        ("tilts", along_normal_by_tilts),
        ("parallel", |p, pixel| {
            let u = [pixel[0] - p[0], pixel[1] - p[1]];
            gaussian(u) * on_sphere(pixel).1[2].powf(-0.8)
        }),
        ("spread", |p, pixel| along_rays(p, pixel, 60.0)),
    ];
    for (name, in_space) in cases {
        let tool = artifact::read::<Tool>(&dir.join(name)).unwrap().value.0;
        let (mut squares, mut missed, mut flat) = (0.0, 0.0, 0.0);
        for ((r, c), _) in part.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
            let pixel = [grid().x.coordinate_mm(c), grid().y.coordinate_mm(r)];
            let (mut written, mut direct, mut as_flat) = (0.0, 0.0, 0.0);
            for (p, time) in &places {
                let u = [pixel[0] - p[0], pixel[1] - p[1]];
                written += time * tool.rate_of_tool_at(Pose::along_x(*p), u);
                direct += time * in_space(*p, pixel);
                as_flat += time * gaussian(u);
            }
            squares += direct * direct;
            missed += (written - direct).powi(2);
            flat += (as_flat - direct).powi(2);
        }
        let (error, ignored) = ((missed / squares).sqrt(), (flat / squares).sqrt());
        println!("{name}: error {error:.1e}, as on a flat part {ignored:.3}");
        // The wanted error of 3e-4, and Keys' interpolation of the spot at a quarter of a millimetre, 1e-3.
        assert!(error < 1.5e-3, "{name}: {error:e}");
        // Regression bound: 0.034 was seen.
        assert!(ignored > 0.02, "{name}: {ignored}");
    }
    let said = refused(
        dir,
        &[&base[..], &["--direction", "normal", "--exponent", "2", "--out", "refused"]].concat(),
    );
    assert!(said.contains("--direction: is normal, where the incidence is 0"), "{said}");
    machine["kinematics"] = serde_json::json!({ "kind": "xyz" });
    machine["rotary_axes"] = serde_json::json!([]);
    fs::write(dir.join("machine.json"), machine.to_string()).unwrap();
    let tilts = ["--direction", "normal", "--machine", "machine.json", "--out", "refused"];
    let said = refused(dir, &[&base[..], &tilts[..]].concat());
    assert!(said.contains("machine: has no tilts"), "{said}");
    let source = ["--direction", "fixed", "--source-distance-mm", "5", "--out", "refused"];
    let said = refused(dir, &[&base[..], &source[..]].concat());
    assert!(said.contains("source_distance_mm: is 5, and the part falls by"), "{said}");
}

/// Makes the map of a ring with an outer diameter of 36 mm and a hole of 12 mm diameter.
fn ring() -> Surface {
    let grid = grid();
    let map = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let radius = grid.x.coordinate_mm(c).hypot(grid.y.coordinate_mm(r));
        if (6.0..=18.0).contains(&radius) { 0.0 } else { f64::NAN }
    });
    Surface::new(grid, map).unwrap()
}

#[test]
fn a_pad_beside_a_hole_that_is_wider_than_it_has_the_pressure_of_its_covered_part() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "part", &ring());
    write(dir, "spot", &spot());
    let pad = ["edge", "--tif", "spot", "--surface", "part", "--error", "3e-2"];
    for law in ["uniform", "linear"] {
        let own = ["--pad-radius-mm", "4", "--pressure", law, "--out", law];
        done(dir, &[&pad[..], &own[..]].concat());
    }
    let tool = artifact::read::<Tool>(&dir.join("uniform")).unwrap().value.0;
    // On the part, over the edge of the hole and over the outer edge by up to a quarter of the diameter.
    for radius in [5.0, 7.0, 8.0, 12.0, 16.0, 18.0] {
        let steps = 400;
        let offset = |k: usize| 4.0 * (2.0 * (k as f64 + 0.5) / steps as f64 - 1.0);
        let pad = (0..steps * steps).map(|k| [offset(k % steps), offset(k / steps)]);
        let of_pad: Vec<_> = pad.filter(|u| u[0].hypot(u[1]) <= 4.0).collect();
        // The edge lies half a pixel of 0.5 mm beyond the centres of the border.
        let covers = |u: &&[f64; 2]| (5.75..=18.25).contains(&(radius + u[0]).hypot(u[1]));
        let covered = of_pad.iter().filter(covers).count() as f64 / of_pad.len() as f64;
        let found = tool.rate_of_tool_at(Pose::along_x([radius, 0.0]), [0.0, 0.0]) / 10.0;
        // The largest error of the kernels, where the pad begins to hang over; 0.14 of the tool was stated.
        assert!((found * covered - 1.0).abs() < 0.15, "{radius}: {found} {covered}");
    }
    // The ring covers (18.25^2 - 5.75^2) / 40^2 = 19 % of a pad of 40 mm radius.
    let own = ["--pad-radius-mm", "40", "--out", "refused"];
    let said = refused(dir, &[&pad[..], &own[..]].concat());
    assert!(said.contains("pad_radius_mm: is 40 mm, and nowhere 60 % of such a pad"), "{said}");
}

#[test]
fn a_rate_that_becomes_0_is_refused_at_once_where_the_tool_is_used_and_taken_beyond() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "part", &disk(|_, _| 0.0));
    write(dir, "spot", &spot());
    // The kinks of the tables are as exact as the grid of the weights is fine.
    let part = ["--tif", "spot", "--surface", "part", "--error", "2e-2"];
    let rate = [&["rate", "--by", "edge-distance"], &part[..]].concat();
    // 0 at 6.5 mm outside: beyond the half size of the TIF of 6 mm, up to which the tool is used.
    fs::write(dir.join("beyond.txt"), "-6.5 0\n0 1\n").unwrap();
    done(dir, &[&rate[..], &["--table", "beyond.txt", "--out", "beyond"]].concat());
    let tool = artifact::read::<Tool>(&dir.join("beyond")).unwrap().value.0;
    let at = |x: f64| tool.rate_of_tool_at(Pose::along_x([x, 0.0]), [0.0, 0.0]) / 10.0;
    // The edge lies a quarter of a millimetre beyond the last pixel: half of the rate 3.25 mm outside of it. The wanted
    // error.
    assert!((at(0.0) - 1.0).abs() < 0.04 && (at(21.5) - 0.5).abs() < 0.04, "{}", at(21.5));
    fs::write(dir.join("inside.txt"), "2 0\n4 1\n").unwrap();
    let said = refused(dir, &[&rate[..], &["--table", "inside.txt", "--out", "refused"]].concat());
    assert!(said.contains("tool: removes nothing at x = "), "{said}");
    assert!(said.contains("--beyond-mm"), "{said}");
    // Where the tool need not be known outside, the same table is refused for a place of the part.
    fs::write(dir.join("edge.txt"), "-1 0\n0 1\n").unwrap();
    let near = ["--table", "edge.txt", "--beyond-mm", "0.5", "--out", "near"];
    done(dir, &[&rate[..], &near[..]].concat());
}

#[test]
fn the_stated_largest_error_is_that_of_dense_places() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "part", &disk(|_, _| 0.0));
    write(dir, "spot", &spot());
    fs::write(dir.join("step.txt"), "0 1\n7 1\n10 2\n40 2\n").unwrap();
    let rate = ["rate", "--tif", "spot", "--surface", "part", "--by", "radius"];
    for error in ["0.1", "0.03", "0.01"] {
        let own = ["--table", "step.txt", "--error", error, "--out", "tool", "--force"];
        done(dir, &[&rate[..], &own[..]].concat());
        let manifest = fs::read_to_string(dir.join("tool/manifest.json")).unwrap();
        let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
        let stated = manifest["outcome"]["report"]["largest_error"].as_f64().unwrap();
        let tool = artifact::read::<Tool>(&dir.join("tool")).unwrap().value.0;
        let (mut largest, mut squares, mut count) = (0.0_f64, 0.0, 0.0);
        for k in 0..240 * 240 {
            let [x, y] = [k % 240, k / 240].map(|i| 0.2 * (f64::from(i) + 0.5) - 24.0);
            let radius = x.hypot(y);
            if radius > 23.5 {
                continue;
            }
            let factor = 1.0 + ((radius - 7.0) / 3.0).clamp(0.0, 1.0);
            let found = tool.rate_of_tool_at(Pose::along_x([x, y]), [0.0, 0.0]) / 10.0;
            largest = largest.max((found - factor).abs());
            squares += factor * factor;
            count += 1.0;
        }
        let dense = largest / f64::sqrt(squares / count);
        println!("wanted {error}: stated {stated:.4}, dense {dense:.4}");
        // The mean square of the factor is that of the places of the weights, and the search ends between two of its
        // places.
        assert!((0.85..1.15).contains(&(stated / dense)), "{error}: {stated} {dense}");
    }
}
