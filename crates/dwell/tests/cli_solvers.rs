//! Every solver through the binary: files, exit codes, the same bytes on one and two threads.

use std::{fs, path::Path, process::Output};

use ndarray::{Array2, array};
use planish_handoff::{artifact, npy::ArrayData};
use planish_testkit::program::{save_array, text, write};
use planish_types::{Axis, DwellTime, Grid, Surface, Tif, ToolPath};
use serde_json::{Value, json};

/// Writes the inputs: a bowl of 10 x 8 mm, a bell-shaped TIF of +-2 mm, a raster of 1 mm with 2 mm of overscan, and a
/// machine.
fn prepare(dir: &Path) {
    let axis = |start: f64, n: usize| Axis::new(start, 0.25, n).unwrap();
    let g = Grid { x: axis(0.0, 41), y: axis(0.0, 33) };
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        0.8 * (g.x.coordinate_mm(c) - 5.0).powi(2) + 0.5 * (g.y.coordinate_mm(r) - 3.0).powi(2)
    });
    write(dir, "surface", &Surface::new(g, height).unwrap());
    let t = Grid { x: axis(-2.0, 17), y: axis(-2.0, 17) };
    let rate = Array2::from_shape_fn(t.shape(), |(r, c)| {
        6.0 * (-(t.x.coordinate_mm(c).powi(2) + t.y.coordinate_mm(r).powi(2)) / (2.0 * 0.7 * 0.7))
            .exp()
    });
    write(dir, "tif", &Tif::new(t, rate).unwrap());
    let line = |r: i32| {
        (0..=14)
            .map(move |k| [f64::from(if r % 2 == 0 { k } else { 14 - k } - 2), f64::from(r - 2)])
    };
    let points: Vec<[f64; 2]> = (0..=12).flat_map(line).collect();
    let n = points.len() - 1;
    let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
    write(dir, "tool_path", &path);
    let machine = json!({ "name": "m", "axes": [
        { "name": "x", "max_velocity_mm_per_s": 20, "max_acceleration_mm_per_s2": 100 },
        { "name": "y", "max_velocity_mm_per_s": 20, "max_acceleration_mm_per_s2": 100 },
    ]});
    fs::write(dir.join("machine.json"), machine.to_string()).unwrap();
}

/// Every solver as a subcommand, with one of its own flags.
const SOLVERS: [&[&str]; 11] = [
    &["bcls", "--machine=machine.json"],
    &["non-negative-least-squares", "--min-dwell-s=0.05"],
    &["tikhonov-lsqr", "--min-dwell-s=0.05", "--damping=0.03"],
    &["tikhonov-lsqr", "--min-dwell-s=0.05", "--l-curve"],
    &["truncated-svd", "--min-dwell-s=0.05", "--cut=0.05"],
    &["lucy-richardson", "--min-dwell-s=0.05", "--total-variation=0.01", "--max-iterations=300"],
    &["lucy-richardson", "--min-dwell-s-per-mm=0.05", "--unknowns=map", "--max-iterations=300"],
    &[
        "lucy-richardson",
        "--min-dwell-s=0.05",
        "--unknowns=map",
        "--pixels-per-cell=2",
        "--max-iterations=300",
    ],
    &["rifta", "--min-dwell-s=0.05"],
    &["udo", "--min-dwell-s=0.05", "--floor=shift"],
    &["feed-law", "--min-dwell-s-per-mm=0.05"],
];

fn run(dir: &Path, threads: &str, solver: &[&str], surface: &str, tif: &str) -> Output {
    planish_testkit::program::stage("planish-dwell")
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", threads)
        .args(solver)
        .args(["--surface", surface, "--tif", tif, "--tool-path=tool_path", "--out=dwell"])
        .output()
        .unwrap()
}

#[test]
fn every_solver_writes_the_same_bytes_on_one_and_two_threads() {
    for solver in SOLVERS {
        let bytes = ["1", "2"].map(|threads| {
            let tmp = tempfile::tempdir().unwrap();
            prepare(tmp.path());
            let output = run(tmp.path(), threads, solver, "surface", "tif");
            assert_eq!(output.status.code(), Some(0), "{solver:?}: {}", text(&output.stderr));
            assert!(text(&output.stdout).starts_with(solver[0]), "{output:?}");
            let dwell = artifact::read::<DwellTime>(&tmp.path().join("dwell")).unwrap().value;
            // The least dwell time that is asked for is 0.05 s. Regression bound: nothing below it was seen.
            assert!(dwell.dwell_s().iter().all(|t| *t >= 0.0499), "{solver:?}");
            ["dwell_s.npy", "manifest.json"]
                .map(|file| fs::read(tmp.path().join("dwell").join(file)).unwrap())
        });
        assert!(bytes[0] == bytes[1], "{solver:?}");
        let manifest: Value = serde_json::from_slice(&bytes[0][1]).unwrap();
        let report = &manifest["outcome"]["report"];
        for key in ["model_rms_nm", "total_time_s", "unreached_pixels", "unreached_points"] {
            assert!(report[key].is_number(), "{solver:?}: no {key} in {report}");
        }
        assert_eq!(
            (&manifest["method"], &report["unreached_pixels"]),
            (&json!(solver[0]), &json!(0))
        );
        // Regression bound: 0.87 nm was seen.
        assert!(report["model_rms_nm"].as_f64().unwrap() < 1.0, "{solver:?}: {report}");
        assert_eq!(manifest["settings"]["columns"], "segment");
    }
}

#[test]
fn bad_maps_and_tools_end_with_2_a_message_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let coordinates = |dir: &Path| {
        for name in ["x_mm", "y_mm"] {
            save_array(dir, name, ArrayData::F64(array![-1.0, 0.0, 1.0].into_dyn().into()));
        }
    };
    let map = |name: &str, array: &str, value: f64| {
        let dir = tmp.path().join(name);
        save_array(&dir, array, ArrayData::F64(Array2::from_elem((3, 3), value).into_dyn().into()));
        coordinates(&dir);
    };
    map("all-nan", "height_nm", f64::NAN);
    map("zero", "rate_nm_per_s", 0.0);
    map("negative", "rate_nm_per_s", -1.0);
    for solver in SOLVERS {
        for (surface, tif, expected) in [
            ("all-nan", "tif", "every pixel is NaN; give at least one valid pixel"),
            ("surface", "zero", "has no positive rate (largest 0 nm/s)"),
            ("surface", "negative", "has no positive rate (largest -1 nm/s)"),
        ] {
            let output = run(tmp.path(), "2", solver, surface, tif);
            let message = text(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{solver:?}: {message}");
            let errors: Vec<&str> = message.lines().filter(|l| l.starts_with("error: ")).collect();
            assert!(errors.len() == 1 && errors[0].contains(expected), "{solver:?}: {message}");
            assert!(!tmp.path().join("dwell").exists());
        }
    }
}

#[test]
fn bad_flags_and_verdicts() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    for (solver, code, expected) in [
        (&["udo", "--step=2"][..], 2, "step: is 2; give a number above 0"),
        (&["rifta", "--margin-tolerance-nm=nan"], 2, "margin_tolerance_nm: is NaN"),
        (&["lucy-richardson", "--min-dwell-s=30"], 2, "min_dwell[0]: is 30 s; the floor alone"),
        // What to do instead.
        (
            &["lucy-richardson", "--min-dwell-s=30"],
            2,
            "the path has 194 dwell points, 1.000 mm apart: give a least dwell time per mm \
             (--min-dwell-s-per-mm)",
        ),
        (&["lucy-richardson", "--pixels-per-cell=2"], 2, "pixels_per_cell: is 2, but the unknowns"),
        (&["lucy-richardson", "--unknowns=map", "--pixels-per-cell=0"], 2, "pixels_per_cell: is 0"),
        (&["tikhonov-lsqr", "--l-curve", "--damping=0.1"], 2, "cannot be used with"),
        (&["bcls", "--machine=nowhere.json"], 2, "nowhere.json: cannot read"),
        (
            &["bcls", "--machine=machine.json", "--least-feed=1"],
            2,
            "least_feed: is 1; give a fraction",
        ),
        (&["feed-law", "--pitch-mm=0"], 2, "pitch_mm: is 0; give a distance above 0"),
        // Done, but not what was asked for.
        (&["tikhonov-lsqr", "--noise-rms-nm=1e-9"], 1, "above the noise"),
        (&["truncated-svd", "--cut=0.001", "--max-iterations=3"], 1, "not converged after 3 steps"),
    ] {
        let output = run(tmp.path(), "2", solver, "surface", "tif");
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{solver:?}: {message}");
        assert!(message.contains(expected), "{solver:?}: {message}");
        assert_eq!(tmp.path().join("dwell").exists(), code == 1);
        let _ = fs::remove_dir_all(tmp.path().join("dwell"));
    }
}
