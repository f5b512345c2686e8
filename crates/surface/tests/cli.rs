//! The binary from end to end.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use ndarray::{Array1, Array2, ArrayD};
use planish_handoff::{
    artifact::{self, Manifest},
    npy::ArrayData,
};
use planish_types::Surface;

fn save(dir: &Path, name: &str, array: ArrayD<f64>) {
    fs::create_dir_all(dir).unwrap();
    fs::write(dir.join(format!("{name}.npy")), ArrayData::F64(array).to_npy()).unwrap();
}

/// A bare directory of arrays: 80 x 60 pixels of 0.1 mm, tilted, with one pit.
fn write_surface(dir: &Path) {
    let mut map = Array2::from_shape_fn((60, 80), |(r, c)| 10.0 + 0.2 * c as f64 + 0.1 * r as f64);
    map.slice_mut(ndarray::s![20..26, 30..36]).mapv_inplace(|v| v - 20.0);
    save(dir, "height_nm", map.into_dyn());
    save(dir, "x_mm", Array1::from_iter((0..80).map(|i| -4.0 + 0.1 * f64::from(i))).into_dyn());
    save(dir, "y_mm", Array1::from_iter((0..60).map(|i| 0.1 * f64::from(i))).into_dyn());
}

fn run(dir: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_planish-surface"))
        .current_dir(dir)
        .arg("prepare")
        .args(arguments)
        .output()
        .unwrap()
}

fn read(dir: &Path) -> (Surface, Manifest) {
    let loaded = artifact::read::<Surface>(dir).unwrap();
    (loaded.value, loaded.manifest.unwrap())
}

#[test]
fn piston_is_the_default_and_the_manifest_tells_what_was_done() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    let output = run(tmp.path(), &["--surface", "in", "--out", "out"]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let (surface, manifest) = read(&tmp.path().join("out"));
    assert_eq!((surface.statistics().min, surface.height_nm().dim()), (0.0, (60, 80)));
    assert_eq!(manifest.settings["level"], "piston");
    assert_eq!(manifest.settings["aperture"], "whole map");
    for when in ["before", "in_aperture", "after"] {
        let s = &manifest.outcome[when];
        assert_eq!(s["valid_pixels"], 4800);
        for key in ["rms_nm", "rms_detilted_nm", "pv_nm"] {
            assert!(s[key].as_f64().unwrap() > 0.0, "{when} {key}");
        }
    }
}

#[test]
fn crop_mask_and_level_together() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    let arguments = [
        "--surface",
        "in",
        "--out",
        "out",
        "--level",
        "plane",
        "--mask-outliers",
        "--feature-mm",
        "3",
        "--outlier-dilate-px",
        "0",
        "--aperture-rectangle-mm",
        "-3",
        "3",
        "1",
        "5",
    ];
    let output = run(tmp.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("61 x 41 px") && said.contains("1 outlier(s) masked (36 px)"), "{said}");
    let (surface, manifest) = read(&tmp.path().join("out"));
    // Without its pit the map is a plane.
    assert!(surface.statistics().pv < 1e-12);
    assert_eq!(surface.statistics().valid_count, 61 * 41 - 36);
    let slope = &manifest.outcome["removed_plane"]["slope_nm_per_mm"];
    assert!((slope[0].as_f64().unwrap() - 2.0).abs() < 1e-9, "{slope}");
    assert_eq!(manifest.outcome["outliers"]["core_pixels"], 36);

    let again = run(tmp.path(), &arguments);
    assert!(String::from_utf8(again.stdout).unwrap().contains("unchanged"));
}

#[test]
fn a_mask_file_is_an_aperture_and_an_input() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    let mask = Array2::from_shape_fn((60, 80), |(r, c)| u8::from(r < 10 && c < 20 && r + c > 3));
    fs::write(tmp.path().join("mask.npy"), ArrayData::U8(mask.into_dyn()).to_npy()).unwrap();
    let arguments = ["--surface", "in", "--out", "out", "--aperture-mask", "mask.npy"];
    let output = run(tmp.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let (surface, manifest) = read(&tmp.path().join("out"));
    assert_eq!((surface.height_nm().dim(), surface.statistics().valid_count), ((10, 20), 190));
    assert_eq!(manifest.inputs[1].role, "aperture-mask");
}

#[test]
fn bad_input_ends_with_2_a_message_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    let cases: [(&[&str], &str); 9] = [
        (&["--surface", "nowhere"], "nowhere: does not exist"),
        (&["--surface", "in", "--mask-outliers"], "--feature-mm"),
        (&["--surface", "in", "--feature-mm", "3"], "--mask-outliers"),
        (&["--surface", "in", "--mask-outliers", "--feature-mm", "0"], "feature_mm: is 0"),
        (&["--surface", "in", "--mask-outliers", "--feature-mm", "NaN"], "feature_mm: is NaN"),
        (&["--surface", "in", "--aperture-circle-mm", "0", "3", "0"], "positive radius"),
        (&["--surface", "in", "--aperture-rectangle-mm", "1", "0", "0", "1"], "min < max"),
        (&["--surface", "in", "--aperture-circle-mm", "0", "3", "0.02"], "1 row(s)"),
        (
            &["--surface", "in", "--aperture-circle-mm", "0", "3", "1", "--aperture-mask", "m"],
            "cannot be used with",
        ),
    ];
    for (arguments, message) in cases {
        let output = run(tmp.path(), &[arguments, &["--out", "out"]].concat());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(message), "{arguments:?}: {said}");
        assert!(!tmp.path().join("out").exists(), "{arguments:?}");
    }
}
