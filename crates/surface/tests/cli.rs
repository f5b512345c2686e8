//! The binary from end to end.

use std::{fs, path::Path, process::Output};

use ndarray::{Array1, Array2, ArrayD};
use planish_handoff::{
    artifact::{self, Manifest},
    npy::ArrayData,
};
use planish_testkit::program::save;
use planish_types::Surface;

/// Writes a bare directory of arrays: a map of 80 x 60 pixels of 0.1 mm, tilted, with one pit.
fn write_surface(dir: &Path) {
    let mut map = Array2::from_shape_fn((60, 80), |(r, c)| 10.0 + 0.2 * c as f64 + 0.1 * r as f64);
    map.slice_mut(ndarray::s![20..26, 30..36]).mapv_inplace(|v| v - 20.0);
    save(dir, "height_nm", map);
    save(dir, "x_mm", Array1::from_iter((0..80).map(|i| -4.0 + 0.1 * f64::from(i))));
    save(dir, "y_mm", Array1::from_iter((0..60).map(|i| 0.1 * f64::from(i))));
}

fn run(dir: &Path, arguments: &[&str]) -> Output {
    planish_testkit::program::stage("planish-surface")
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
    // Rounding of a slope of 2 nm/mm, from JSON.
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
    fs::write(tmp.path().join("mask.npy"), ArrayData::U8(mask.into_dyn().into()).to_npy()).unwrap();
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

/// Runs `planish-surface` with these arguments in `dir`, and returns its output.
fn surface_command(dir: &Path, arguments: &[&str]) -> Output {
    planish_testkit::program::stage("planish-surface")
        .current_dir(dir)
        .args(arguments)
        .output()
        .unwrap()
}

pub fn array(dir: &Path, name: &str) -> ArrayD<f64> {
    let path = dir.join(format!("{name}.npy"));
    match planish_handoff::npy::read(&path, planish_handoff::kind::Dtype::F64).unwrap().array {
        ArrayData::F64(a) => a.into_owned(),
        other => panic!("{other:?}"),
    }
}

pub fn manifest(dir: &Path) -> serde_json::Value {
    serde_json::from_slice(&fs::read(dir.join("manifest.json")).unwrap()).unwrap()
}

/// Writes a TIF, an even, off-centre Gaussian: 40 x 30 samples of 0.25 mm about (0.4, -0.3), 5 nm/s, sigma 0.7.
pub fn write_tif(dir: &Path) {
    let axis = |n: usize| (0..n).map(move |i| -0.125 * (n as f64 - 1.0) + 0.25 * i as f64);
    let rate = Array2::from_shape_fn((30, 40), |(r, c)| {
        let (x, y) = (axis(40).nth(c).unwrap() - 0.4, axis(30).nth(r).unwrap() + 0.3);
        5.0 * (-0.5 * (x * x + y * y) / 0.49).exp()
    });
    save(dir, "rate_nm_per_s", rate);
    save(dir, "x_mm", Array1::from_iter(axis(40)));
    save(dir, "y_mm", Array1::from_iter(axis(30)));
}

#[test]
fn low_order_fill_and_extension_are_told_in_the_manifest() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    let arguments = "prepare --surface in --out out --level legendre --level-order 2 \
                     --mask-outliers --feature-mm 3 --outlier-dilate-px 1 --fill \
                     --extend nearest --extend-mm 0.95";
    let output = surface_command(tmp.path(), &arguments.split_whitespace().collect::<Vec<_>>());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("1 hole(s) filled (64 px)"), "{said}");
    let (surface, manifest) = read(&tmp.path().join("out"));
    // 0.95 mm are 10 px; nothing is invalid; the map is a plane, of which nothing is left.
    assert_eq!(surface.height_nm().dim(), (80, 100));
    // Rounding of a coordinate.
    assert!((surface.grid().x.start_mm() + 5.0).abs() < 1e-9);
    // Rounding of a plane, times the condition of the terms.
    assert!(surface.height_nm().iter().all(|v| v.abs() < 1e-9));
    let terms = manifest.outcome["removed_low_order"]["terms"].as_array().unwrap();
    // Half the width times the slope: 39.5 px * 0.2 nm.
    assert_eq!((terms.len(), terms[1]["order"][0].as_i64()), (6, Some(1)));
    // Rounding of 7.9 nm, times the condition of the terms.
    assert!((terms[1]["coefficient_nm"].as_f64().unwrap() - 7.9).abs() < 1e-9);
    assert!(manifest.outcome["removed_low_order"]["convention"].as_str().unwrap().contains("P_i"));
    assert_eq!(manifest.settings["extension"]["method"], "nearest");
    assert_eq!(manifest.outcome["extended"]["margin_px"], serde_json::json!([10, 10]));
}

#[test]
fn every_extension_runs_through_the_binary() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    for (k, flags) in [
        "gaussian-decay --extend-sigma-mm 0.5",
        "gaussian-decay",
        "gerchberg-papoulis --extend-cutoff-per-mm 0.4 --extend-iterations 20",
        "polynomial --extend-order 3 2",
        "polynomial --extend-order 1 1 --extend-without-ring",
    ]
    .iter()
    .enumerate()
    {
        let line = format!(
            "prepare --surface in --aperture-circle-mm 0 3 2 --out out{k} --extend-mm 1 --extend {flags}"
        );
        let output = surface_command(tmp.path(), &line.split_whitespace().collect::<Vec<_>>());
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let (surface, _) = read(&tmp.path().join(format!("out{k}")));
        assert_eq!(surface.statistics().valid_count, 61 * 61, "{flags}");
    }
}

#[test]
fn statistics_and_spectrum_of_a_wave() {
    let tmp = tempfile::tempdir().unwrap();
    // 8 periods of 2 nm amplitude along x in 80 px of 0.1 mm: 1 /mm.
    let wave = |c: usize| 2.0 * (2.0 * std::f64::consts::PI * 8.0 * c as f64 / 80.0).sin();
    let dir = tmp.path().join("in");
    write_surface(&dir);
    save(&dir, "height_nm", Array2::from_shape_fn((60, 80), |(_, c)| wave(c)));
    let output = surface_command(tmp.path(), &["statistics", "--surface", "in"]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    // Rounding of a mean square.
    assert!((found["rms_nm"].as_f64().unwrap() - 2.0_f64.sqrt()).abs() < 1e-12);
    assert_eq!(found["pvr"]["family"], "legendre");
    let line =
        "psd --surface in --detrend mean --band-per-mm 0.5 1.5 --band-per-mm 1.5 4 --out out";
    let arguments: Vec<_> = line.split_whitespace().collect();
    let output = surface_command(tmp.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(
        said.contains("0.5 .. 1.5 /mm: 1.4142 nm RMS (along x 1.4142, along y 0.0000)"),
        "{said}"
    );
    let out = tmp.path().join("out");
    let (f, s) = (array(&out, "frequency_x_per_mm"), array(&out, "psd_x_nm2_mm"));
    let strongest = s.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).unwrap().0;
    // The bins lie on multiples of 1 / 8 mm: rounding.
    assert!((f[strongest] - 1.0).abs() < 1e-12);
    // The sum of the density is the mean square: 2 nm^2.
    assert!((s.sum() * f[1] - 2.0).abs() < 1e-12);
    let two = array(&out, "psd_2d_nm2_mm2").sum() * f[1] * array(&out, "frequency_y_per_mm")[1];
    // As above.
    assert!((two - 2.0).abs() < 1e-12, "{two}");
    assert_eq!(manifest(&out)["settings"]["window"], "hann");
    assert!(fs::read_to_string(out.join("psd.svg")).unwrap().starts_with("<svg"));
    let again = surface_command(tmp.path(), &arguments);
    assert!(String::from_utf8(again.stdout).unwrap().contains("unchanged"));
}

#[test]
fn maps_and_tools_are_drawn() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    write_tif(&tmp.path().join("tif"));
    for line in [
        "draw --surface in --surface in --outline in --common-scale --out a.svg",
        "draw --tif tif --out b.svg",
    ] {
        let arguments: Vec<_> = line.split_whitespace().collect();
        let output = surface_command(tmp.path(), &arguments);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let again = surface_command(tmp.path(), &arguments);
        assert_eq!(again.status.code(), Some(2));
        assert!(String::from_utf8(again.stderr).unwrap().contains("--force"));
    }
    let svg = fs::read_to_string(tmp.path().join("a.svg")).unwrap();
    // Two titles, two names in the legend.
    assert_eq!((svg.matches(">in</text>").count(), svg.matches(">in</tspan>").count()), (2, 2));
}

#[test]
fn bad_input_of_the_other_commands_ends_with_2_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    let nothing = tmp.path().join("nothing");
    write_surface(&nothing);
    save(&nothing, "height_nm", Array2::from_elem((60, 80), f64::NAN));
    for (line, message) in [
        ("prepare --surface nothing", "every pixel is NaN"),
        ("prepare --surface in --level zernike", "--level-order: is missing"),
        ("prepare --surface in --level-order 3", "--level-order: has no terms"),
        ("prepare --surface in --level legendre --level-order 99", "the order is 99"),
        ("prepare --surface in --level plane --zernike-circle-mm 0 0 1", "without zernike"),
        (
            "prepare --surface in --level zernike --level-order 2 --zernike-circle-mm 0 3 1",
            "a valid pixel is at",
        ),
        ("prepare --surface in --extend nearest", "--extend-mm"),
        ("prepare --surface in --extend nearest --extend-mm NaN", "is NaN mm"),
        ("prepare --surface in --extend nearest --extend-mm 1e5", "at most 25000000 pixels"),
        ("prepare --surface in --extend nearest --extend-mm 1 --extend-sigma-mm 1", "has no use"),
        (
            "prepare --surface in --extend gerchberg-papoulis --extend-mm 1",
            "cutoff-per-mm: is missing",
        ),
        ("psd --surface in --band-per-mm 90 100", "holds no frequency"),
        ("psd --surface in --removal in", "cannot be used with"),
    ] {
        let line = format!("{line} --out out");
        let output = surface_command(tmp.path(), &line.split_whitespace().collect::<Vec<_>>());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{line}: {said}");
        assert!(said.contains(message), "{line}: {said}");
        assert!(!tmp.path().join("out").exists(), "{line}");
    }
}

#[test]
fn strips_flat_maps_and_hostile_names_are_drawn() {
    let tmp = tempfile::tempdir().unwrap();
    let name = "a<b>&\u{1b}[31m\u{8}";
    let strip = |name: &str, shape: (usize, usize), row: f64| {
        let dir = tmp.path().join(name);
        let mut map = Array2::from_elem(shape, -1e-9);
        // A border, and the row of the section, without a valid pixel.
        map.row_mut(shape.0 / 2).fill(row);
        map.column_mut(0).fill(f64::NAN);
        save(&dir, "height_nm", map);
        let axis = |n: usize| Array1::from_iter((0..n).map(|i| 0.1 * i as f64)).into_dyn();
        save(&dir, "x_mm", axis(shape.1));
        save(&dir, "y_mm", axis(shape.0));
    };
    strip(name, (2, 400), f64::NAN);
    strip("tall", (400, 2), -1e-9);
    for (i, dir) in [name, "tall"].iter().enumerate() {
        let out = format!("{i}.svg");
        let output = surface_command(tmp.path(), &["draw", "--surface", dir, "--out", &out]);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let svg = fs::read_to_string(tmp.path().join(out)).unwrap();
        for word in ["NaN", "inf", ">-0.0<", ">-0.00<", "d=\"\""] {
            assert!(!svg.contains(word), "{dir}: {word}");
        }
        assert!(!svg.contains(|c: char| c != '\n' && c.is_control()));
        let height: f64 =
            svg.split("height=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap();
        // The map is at most two widths (1120 px) high and has at least the height of its scale.
        assert!((400.0..2000.0).contains(&height), "{dir}: {height}");
    }
    let svg = fs::read_to_string(tmp.path().join("0.svg")).unwrap();
    assert!(svg.contains(r"a&lt;b&gt;&amp;\u{1b}[31m\u{8}"), "{svg}");
}

fn spec(dir: &Path, arguments: &[&str]) -> Output {
    planish_testkit::program::stage("planish-surface")
        .current_dir(dir)
        .arg("spec")
        .args(arguments)
        .output()
        .unwrap()
}

#[test]
fn a_specification_that_is_not_kept_ends_with_1_and_says_why() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    let limits = |nm: f64| {
        format!(
            r#"{{ "name": "flat", "limits": [ {{ "quantity": "height_pv", "at_most_nm": {nm} }},
                {{ "quantity": "slope_rms", "along": "x", "base_mm": 0.5, "at_most_nrad": 1e6 }} ] }}"#
        )
    };
    fs::write(tmp.path().join("strict.json"), limits(1.0)).unwrap();
    fs::write(tmp.path().join("easy.json"), limits(100.0)).unwrap();
    let with = |file: &str, out: &str| {
        spec(tmp.path(), &["--surface", "in", "--specification", file, "--out", out])
    };
    let easy = with("easy.json", "easy");
    assert_eq!(easy.status.code(), Some(0), "{easy:?}");
    let strict = with("strict.json", "strict");
    assert_eq!(strict.status.code(), Some(1), "{strict:?}");
    let said = String::from_utf8(strict.stderr).unwrap();
    assert!(said.contains("1 of 2 limits of flat are exceeded: PV height after plane: "), "{said}");
    assert!(said.contains(" nm, at most 1 nm, ") && said.contains("worst at x "), "{said}");
    let table = String::from_utf8(strict.stdout).unwrap();
    assert!(
        table.contains("FAILS  PV height") && table.contains("kept   RMS slope along x"),
        "{table}"
    );

    let text = fs::read_to_string(tmp.path().join("strict/manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(manifest["kind"], "specification");
    assert_eq!(manifest["outcome"]["status"], "negative");
    assert_eq!(manifest["outcome"]["specification"]["passed"], false);
    assert_eq!(manifest["outcome"]["slope_x"]["base_mm"], 1.0);
    // Density and frequencies of the slopes: (2 pi f)^2 of the heights', in nrad and nm.
    let array = |name: &str| {
        let file = tmp.path().join("strict").join(format!("{name}.npy"));
        match planish_handoff::npy::read(&file, planish_handoff::kind::Dtype::F64).unwrap().array {
            ArrayData::F64(a) => a,
            other => panic!("{other:?}"),
        }
    };
    let (f, z, s) =
        (array("frequency_x_per_mm"), array("psd_x_nm2_mm"), array("slope_psd_x_nrad2_mm"));
    for i in 0..f.len() {
        let want = (2e3 * std::f64::consts::PI * f[i]).powi(2) * z[i];
        // Rounding of products.
        assert!((s[i] - want).abs() <= 1e-12 * want, "{i}");
    }
    assert_eq!(array("position_mm").len(), 80);
    let again = with("strict.json", "strict");
    assert_eq!(again.status.code(), Some(1));
    assert!(String::from_utf8(again.stdout).unwrap().contains("unchanged"));
}

#[test]
fn a_profile_is_read_from_text_and_from_an_array() {
    let tmp = tempfile::tempdir().unwrap();
    let slope = |i: usize| 2.0 * (i as f64 / 7.0).sin();
    let rows: Vec<String> =
        (0..300).map(|i| format!("{i};{};{}", 0.001 * i as f64, slope(i))).collect();
    let text = format!("LTP scan 4\nn;x (m);slope (urad)\n{}\n", rows.join("\n"));
    fs::write(tmp.path().join("scan.txt"), text).unwrap();
    let table =
        Array2::from_shape_fn((300, 2), |(i, k)| if k == 0 { i as f64 } else { 1e-6 * slope(i) });
    save(tmp.path(), "scan", table);
    let text = ["--profile", "scan.txt", "--profile-columns", "2", "3", "--position-unit", "m"];
    let text = [&text[..], &["--value-unit", "urad", "--out", "a"]].concat();
    let array = ["--profile", "scan.npy", "--value-unit", "rad", "--out", "b"];
    let number = |out: &str| {
        let text = fs::read_to_string(tmp.path().join(out).join("manifest.json")).unwrap();
        let manifest: serde_json::Value = serde_json::from_str(&text).unwrap();
        manifest["outcome"]["slope_x"]["rms_nrad"].as_f64().unwrap()
    };
    for arguments in [&text[..], &array[..]] {
        let output = spec(tmp.path(), arguments);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
    }
    // sin over 6.8 periods: 2 urad / sqrt 2, within what the rest of a period changes.
    assert!((number("a") / number("b") - 1.0).abs() < 1e-12);
    assert!((number("a") / 1414.2 - 1.0).abs() < 0.05, "{}", number("a"));
}

#[test]
fn what_cannot_be_specified_ends_with_2_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    write_surface(&tmp.path().join("in"));
    fs::write(tmp.path().join("scan.txt"), "0 1\n1 2\n1 3\n2 1\n3 1\n4 1\n5 1\n6 1\n7 1\n")
        .unwrap();
    fs::write(tmp.path().join("typo.json"), r#"{ "name": "a", "limit": [] }"#).unwrap();
    fs::write(
        tmp.path().join("zone.json"),
        r#"{ "name": "a", "zones": [ { "name": "far", "x_mm": [50, 60] } ],
             "limits": [ { "quantity": "height_pv", "zone": "far", "at_most_nm": 1 } ] }"#,
    )
    .unwrap();
    save(tmp.path(), "narrow", Array2::zeros((20, 1)));
    let profile = |unit| ["--profile", "scan.txt", "--value-unit", unit];
    let map = ["--surface", "in"];
    let cases: [(&[&[&str]], &str); 11] = [
        (&[&map, &["--base-mm", "0"]], "--base-mm is 0; give a length in mm"),
        (&[&map, &["--base-mm", "7.9999"]], "--base-mm is 7.9999, the map is 7.9 mm long"),
        (&[&map, &["--subtract", "ellipse"]], "give --ellipse"),
        (&[&map, &["--ellipse", "1", "0", "3"]], "ellipse: q is 0 mm; give a distance"),
        (&[&map, &["--band-per-mm", "20", "30"]], "holds no frequency along x"),
        (&[&map, &["--specification", "typo.json"]], "typo.json: unknown field `limit`"),
        (
            &[&map, &["--specification", "zone.json"]],
            "limits[0]: cannot be judged: zone \"far\" holds no",
        ),
        (&[&profile("urad")], "position[2]: 1 mm follows 1 mm; sort"),
        (&[&profile("urad"), &["--profile-columns", "1", "1"]], "give two different ones"),
        (&[&profile("urad"), &["--profile-columns", "1", "4"]], "give the right --profile-columns"),
        (
            &[&["--profile", "narrow.npy", "--value-unit", "nm"]],
            "narrow.npy: has 1 column(s), not 2",
        ),
    ];
    for (arguments, message) in cases {
        let arguments = [&arguments.concat()[..], &["--out", "out"]].concat();
        let output = spec(tmp.path(), &arguments);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(message), "{arguments:?}: {said}");
        assert!(!tmp.path().join("out").exists(), "{arguments:?}");
    }
}
