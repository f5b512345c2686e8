//! `planish-dwell bound` from its flags to its manifest and exit codes.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::artifact::Manifest;
use planish_testkit::program::{stage, text, write};
use planish_types::{Axis, Grid, Surface, Tif, outcome::bound::PathFreeBounds};

fn prepare(dir: &Path) {
    let g = Grid { x: Axis::new(0.0, 0.25, 25).unwrap(), y: Axis::new(0.0, 0.25, 17).unwrap() };
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.coordinate_mm(c) - 3.0, g.y.coordinate_mm(r) - 2.0);
        2.0 * x * x + y * y + (2.0 * x).sin() * (3.0 * y).cos()
    });
    write(dir, "surface", &Surface::new(g, height).unwrap());
    let a = Axis::new(-2.5, 0.25, 21).unwrap();
    let g = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        5.0 * (-(g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2)) / 1.28).exp()
    });
    write(dir, "tif", &Tif::new(g, rate).unwrap());
}

fn run(dir: &Path, more: &[&str]) -> Output {
    let arguments = ["bound", "--surface=surface", "--tif=tif", "--out=bound"];
    stage("planish-dwell").current_dir(dir).args(arguments).args(more).output().unwrap()
}

#[test]
fn times_and_prices_have_their_bounds_in_order() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let output = run(tmp.path(), &["--time-s=10,20", "--time-weight-nm2-per-s=1e-2"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert_eq!(text(&output.stdout).matches("no path and no motion").count(), 3);
    let manifest = fs::read_to_string(tmp.path().join("bound/manifest.json")).unwrap();
    let manifest: Manifest = serde_json::from_str(&manifest).unwrap();
    let found: PathFreeBounds = serde_json::from_value(manifest.outcome).unwrap();
    assert_eq!(found.pixels, 425);
    let [ten, twenty, price] = found.bounds[..] else { panic!("{found:?}") };
    assert_eq!((ten.time_s, twenty.time_s), (10.0, 20.0));
    for bound in [ten, twenty, price] {
        assert!(bound.bound_rms_nm <= bound.reached_rms_nm, "{bound:?}");
        assert!(bound.reached_rms_nm < found.desired_rms_nm, "{bound:?}");
    }
    assert!(twenty.bound_rms_nm < ten.bound_rms_nm);
    let again = run(tmp.path(), &["--time-s=10,20", "--time-weight-nm2-per-s=1e-2"]);
    assert!(text(&again.stdout).contains("unchanged"));
}

#[test]
fn what_is_no_time_is_refused_and_nothing_is_written() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    for bad in [&[][..], &["--time-s=0"], &["--time-s=1,nan"], &["--time-weight=-1"]] {
        let output = run(tmp.path(), bad);
        assert_eq!(output.status.code(), Some(2), "{bad:?}");
        let message = text(&output.stderr);
        assert!(message.contains("time"), "{message}");
        assert!(!tmp.path().join("bound").exists());
    }
}
