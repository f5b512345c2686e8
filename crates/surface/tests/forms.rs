//! Forms of parts through the program: subtraction, and the tool of a form by the name that it has in this stage.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::artifact::{self, Manifest};
use planish_testkit::program::{text, write};
use planish_types::{Axis, Grid, Surface};

use crate::tool_varying::{RADIUS_MM, disk, sphere_mm, spot};

fn run(dir: &Path, arguments: &[&str]) -> Output {
    let mut command = planish_testkit::program::stage("planish-surface");
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

#[test]
fn a_form_is_subtracted_fitted_and_written_beside_the_map() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    // 5 nm of error on a sphere that is tilted on the instrument.
    let error = |x: f64, y: f64| 5.0 * (0.7 * x).sin() * (0.9 * y).cos();
    write(dir, "map", &disk(|x, y| 1e6 * sphere_mm(x, y) + 250.0 * x + error(x, y)));
    let file = r#"{"kind": "sphere", "radius_mm": 35.0, "fit": {"radius_mm": [30, 40]}}"#;
    fs::write(dir.join("sphere.json"), file).unwrap();
    let said =
        done(dir, &["prepare", "--surface", "map", "--target", "sphere.json", "--out", "out"]);
    assert!(said.contains("form subtracted") && said.contains("(given 35)"), "{said}");
    let loaded = artifact::read::<Surface>(&dir.join("out")).unwrap();
    let manifest: Manifest = loaded.manifest.unwrap();
    let found = manifest.outcome["target"]["parameters"][0]["value"].as_f64().unwrap();
    // The error changes the best radius by about 5 nm over the sag of 5e6 nm.
    assert!((found / RADIUS_MM - 1.0).abs() < 1e-6, "{found}");
    let expected = disk(error).statistics().rms;
    let rms = loaded.value.statistics().rms;
    // The form is fitted to the error, too. Regression bound: 3e-4 was seen.
    assert!((rms / expected - 1.0).abs() < 0.02, "{rms} {expected}");
    assert_eq!(manifest.settings["target"]["fit"]["radius_mm"][1], 40.0);
    let beside: serde_json::Value =
        serde_json::from_slice(&fs::read(dir.join("out/form.json")).unwrap()).unwrap();
    assert_eq!(beside["radius_mm"].as_f64(), Some(found));
    assert!(beside.get("fit").is_none() && manifest.files.contains_key("form.json"));
    // It stays with the map in a later step.
    done(dir, &["prepare", "--surface", "out", "--level", "plane", "--out", "later"]);
    assert_eq!(
        fs::read(dir.join("out/form.json")).unwrap(),
        fs::read(dir.join("later/form.json")).unwrap()
    );
    // The written file is a form file itself.
    let tool = ["tool-rate", "--by", "incidence", "--exponent=-1.7", "--form", "out/form.json"];
    write(dir, "spot", &spot());
    done(dir, &[&tool[..], &["--tif", "spot", "--surface", "out", "--out", "tool"]].concat());
    let (again, other) = (["--out", "out"], ["--target", "sphere.json"]);
    let said = done(dir, &[&["prepare", "--surface", "map"], &other[..], &again[..]].concat());
    assert!(said.contains("unchanged"), "{said}");
}

#[test]
fn heights_along_the_normal_become_heights_along_z() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "map", &disk(|_, _| 100.0));
    fs::write(
        dir.join("sphere.json"),
        format!(r#"{{"kind": "sphere", "radius_mm": {RADIUS_MM}}}"#),
    )
    .unwrap();
    let base = ["prepare", "--surface", "map", "--level", "none"];
    let form = ["--form", "sphere.json", "--heights", "normal", "--out", "out"];
    done(dir, &[&base[..], &form[..]].concat());
    let loaded = artifact::read::<Surface>(&dir.join("out")).unwrap();
    let (middle, edge) = (loaded.value.height_nm()[[36, 36]], loaded.value.height_nm()[[36, 72]]);
    // Below: rounding of 100 nm, and of a cosine.
    assert!((middle - 100.0).abs() < 1e-10);
    assert!((edge - 100.0 / 30_f64.to_radians().cos()).abs() < 1e-9, "{edge}");
    let settings = loaded.manifest.unwrap().settings;
    assert_eq!(
        (&settings["heights"], &settings["lateral"]),
        (&"normal".into(), &"projected".into())
    );
    for (more, part) in [
        (&["--heights", "normal"][..], "--heights: is normal, of an unknown form; give --form"),
        (&["--lateral", "surface"], "--lateral: is surface, of an unknown form; give --form"),
        (&["--form", "sphere.json"], "has no effect on heights along z"),
        (&["--target", "map"], "--target: map is a directory; give a form file"),
    ] {
        let said = refused(dir, &[&base[..], more, &["--out", "refused"]].concat());
        assert!(said.contains(part), "{said}");
    }
}

#[test]
fn a_toroid_is_subtracted_with_stated_and_with_fitted_radii() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let axis = |half: f64, n: usize| Axis::new(-half, 2.0 * half / (n - 1) as f64, n).unwrap();
    let grid = Grid { x: axis(50.0, 41), y: axis(8.0, 33) };
    let [long, short] = [300e3, 60.0];
    // The surface of a torus: a circle of 60 mm over y, whose middle runs on a circle of 300 m - 60 mm.
    let torus_mm = |x: f64, y: f64| {
        let across = (short * short - y * y).sqrt() + long - short;
        long - (across * across - x * x).sqrt()
    };
    let error = |x: f64, y: f64| 8.0 * (0.5 * x).sin() * (1.3 * y).cos();
    let map = |tilt: f64| {
        let heights = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
            1e6 * torus_mm(x, y) + tilt * x + error(x, y)
        });
        Surface::new(grid, heights).unwrap()
    };
    write(dir, "map", &map(3.0));
    let heights = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        error(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
    });
    let expected = Surface::new(grid, heights).unwrap().detilted_rms_nm();
    let stated = r#"{"kind": "toroid", "radius_x_mm": 3e5, "radius_y_mm": 60}"#;
    let fitted = r#"{"kind": "toroid", "radius_x_mm": 2.8e5, "radius_y_mm": 61,
                     "fit": {"radius_x_mm": [2e5, 4e5], "radius_y_mm": "free"}}"#;
    for (name, file) in [("stated", stated), ("fitted", fitted)] {
        fs::write(dir.join("toroid.json"), file).unwrap();
        done(dir, &["prepare", "--surface", "map", "--target", "toroid.json", "--out", name]);
        let loaded = artifact::read::<Surface>(&dir.join(name)).unwrap();
        let rms = loaded.value.detilted_rms_nm();
        // Heights of 1e6 nm from radii of 3e8 um carry 1e-4 nm; two radii take some of the waves of the error.
        let tolerance = if name == "stated" { 1e-3 } else { 0.02 * expected };
        assert!((rms - expected).abs() < tolerance, "{name}: {rms} {expected}");
        if name == "fitted" {
            let found = loaded.manifest.unwrap().outcome["target"]["parameters"].clone();
            for (k, right) in [long, short].into_iter().enumerate() {
                let value = found[k]["value"].as_f64().unwrap();
                // 8 nm beside the sag of 4 um along x, and of 5e5 nm along y.
                assert!((value / right - 1.0).abs() < [1e-3, 1e-5][k], "{found}");
            }
        }
    }
    // A convex toroid of the same magnitude is another part.
    fs::write(dir.join("toroid.json"), stated.replace("60}", "-60}")).unwrap();
    done(dir, &["prepare", "--surface", "map", "--target", "toroid.json", "--out", "convex"]);
    let convex = artifact::read::<Surface>(&dir.join("convex")).unwrap().value;
    assert!(convex.statistics().rms > 1e5);
    fs::write(dir.join("toroid.json"), r#"{"kind": "toroid", "radius_x_mm": 3e5}"#).unwrap();
    let said = refused(
        dir,
        &["prepare", "--surface", "map", "--target", "toroid.json", "--out", "refused"],
    );
    assert!(said.contains("radius_y_mm") && said.contains("missing"), "{said}");
}
