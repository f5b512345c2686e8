//! Runs of a program with hostile flags and inputs, for the `hostile` tests of the stages.
//!
//! A program must end by itself with exit code 0, 1 or 2, without a panic, within a time limit, whatever
//! its inputs. With exit code 2 it states the reason in one message and has written nothing. With 0 or 1 no
//! outcome holds `null`, which is what JSON makes of NaN and infinity.

use std::{fs, path::Path, time::Duration};

use ndarray::{Array1, ArrayD};
use planish_handoff::npy::ArrayData;

use crate::program::{run_within, save, save_array, stage, text};

/// Longest time for one run, s. Larger: the test finds an endless loop later. Smaller: it fails on a busy
/// machine or in a build without optimisation. Chosen: far above the time of any of these small cases.
const TIME_LIMIT: Duration = Duration::from_secs(120);

/// Values for a flag that takes a number: valid and invalid ones that no user means.
pub const FLOATS: [&str; 10] =
    ["0", "-1", "NaN", "inf", "-inf", "1e-300", "1e-9", "1e-3", "1e9", "1e300"];

/// Values for a flag that takes a count: valid and invalid ones that no user means.
pub const COUNTS: [&str; 5] = ["0", "1", "-1", "1000000000", "18446744073709551615"];

/// Writes numbers as the array `name` of a directory without a manifest.
pub fn npy(dir: &Path, name: &str, shape: &[usize], values: &[f64]) {
    let array =
        ArrayD::from_shape_vec(shape, values.to_vec()).expect("as many numbers as the shape says");
    save(dir, name, array);
}

/// Writes integers as the array `name` of a directory without a manifest.
pub fn integers(dir: &Path, name: &str, values: &[i64]) {
    save_array(dir, name, ArrayData::I64(Array1::from(values.to_vec()).into_dyn().into()));
}

/// Writes a map of `name` (height_nm, rate_nm_per_s) on the axes.
pub fn map(dir: &Path, name: &str, x: &[f64], y: &[f64], of: impl Fn(usize, usize) -> f64) {
    let all: Vec<f64> = (0..y.len())
        .flat_map(|r| (0..x.len()).map(move |c| (r, c)))
        .map(|(r, c)| of(r, c))
        .collect();
    npy(dir, "x_mm", &[x.len()], x);
    npy(dir, "y_mm", &[y.len()], y);
    npy(dir, name, &[y.len(), x.len()], &all);
}

/// Writes a path through points, with the tool on; a pass begins where y changes.
pub fn path(dir: &Path, points: &[[f64; 2]]) {
    let n = points.len() - 1;
    let middle = |w: &[[f64; 2]]| [0.5 * (w[0][0] + w[1][0]), 0.5 * (w[0][1] + w[1][1])];
    npy(dir, "point_mm", &[n + 1, 2], points.as_flattened());
    let middles: Vec<[f64; 2]> = points.windows(2).map(middle).collect();
    npy(dir, "dwell_point_mm", &[n, 2], middles.as_flattened());
    let mut pass = 0;
    let pass_of = |w: &[[f64; 2]]| {
        pass += i64::from(w[0][1] != w[1][1]);
        pass
    };
    integers(dir, "pass_idx", &points.windows(2).map(pass_of).collect::<Vec<i64>>());
}

fn steps(start: f64, step: f64, n: usize) -> Vec<f64> {
    (0..n).map(|i| start + step * i as f64).collect()
}

/// A raster of 1 mm over the map of [`inputs`] and 2 mm beyond it, times `scale`.
fn raster(scale: f64) -> Vec<[f64; 2]> {
    let line = |r: i32| (0..=14).map(move |k| [if r % 2 == 0 { k } else { 14 - k } - 2, r - 2]);
    (0..=12).flat_map(line).map(|p| p.map(|v| scale * f64::from(v))).collect()
}

/// Writes sensible inputs: `surface` (10 x 8 mm), `tif` (4 mm), `tool_path`, `dwell` and `machine.json`.
/// Beside them it writes maps, TIFs and paths that no measurement gives, and returns their names.
pub fn inputs(dir: &Path) -> [Vec<&'static str>; 3] {
    let (x, y) = (steps(0.0, 0.25, 41), steps(0.0, 0.25, 33));
    let z = |r: usize, c: usize| {
        0.8 * (0.25 * c as f64 - 5.0).powi(2) + 0.5 * (0.25 * r as f64 - 3.0).powi(2)
    };
    let scaled = |v: &[f64], by: f64| v.iter().map(|v| v * by).collect::<Vec<_>>();
    map(&dir.join("surface"), "height_nm", &x, &y, z);
    let height = |name: &str, of: &dyn Fn(usize, usize) -> f64| {
        map(&dir.join(name), "height_nm", &x, &y, of);
    };
    let only = |keep: bool, z: f64| if keep { z } else { f64::NAN };
    height("one-valid-pixel", &|r, c| only((r, c) == (16, 20), 5.0));
    height("one-row", &|r, c| only(r == 16, z(r, c)));
    height("one-column", &|r, c| only(c == 20, z(r, c)));
    height("chess-board", &|r, c| only((r + c) % 2 == 0, z(r, c)));
    height("nan", &|_, _| f64::NAN);
    height("constant", &|_, _| 5.0);
    height("zero", &|_, _| 0.0);
    height("marked", &|r, c| if r.abs_diff(16) > 12 { -9999.0 } else { z(r, c) });
    height("in-metres", &|r, c| 1e-9 * z(r, c));
    map(&dir.join("two-by-two"), "height_nm", &x[..2], &y[..2], z);
    map(&dir.join("one-pixel"), "height_nm", &x[..1], &y[..1], z);
    map(&dir.join("axes-in-metres"), "height_nm", &scaled(&x, 1e-3), &scaled(&y, 1e-3), z);
    map(&dir.join("axes-in-um"), "height_nm", &scaled(&x, 1e3), &scaled(&y, 1e3), z);

    let t = steps(-2.0, 0.25, 17);
    let bell = |r: usize, c: usize| {
        let d = |k: usize| 0.25 * k as f64 - 2.0;
        6.0 * (-(d(r).powi(2) + d(c).powi(2)) / (2.0 * 0.7 * 0.7)).exp()
    };
    let rate = |name: &str, t: &[f64], of: &dyn Fn(usize, usize) -> f64| {
        map(&dir.join(name), "rate_nm_per_s", t, t, of);
    };
    rate("tif", &t, &bell);
    rate("tif-one-pixel", &t, &|r, c| if (r, c) == (8, 8) { 6.0 } else { 0.0 });
    rate("tif-hot-pixel", &t, &|r, c| if (r, c) == (3, 3) { 1e9 } else { bell(r, c) });
    rate("tif-zero", &t, &|_, _| 0.0);
    rate("tif-negative", &t, &|r, c| -bell(r, c));
    rate("tif-two-by-two", &[-0.1, 0.1], &|_, _| 1.0);
    rate("tif-in-metres", &scaled(&t, 1e-3), &bell);
    rate("tif-in-um", &scaled(&t, 1e3), &bell);
    rate("tif-from-zero", &steps(0.0, 0.25, 17), &bell);
    rate("tif-in-m-per-s", &t, &|r, c| 1e-9 * bell(r, c));

    path(&dir.join("tool_path"), &raster(1.0));
    npy(&dir.join("dwell"), "dwell_s", &[194], &[0.2; 194]);
    path(&dir.join("path-in-um"), &raster(1e3));
    path(&dir.join("path-in-metres"), &raster(1e-3));
    path(
        &dir.join("path-far"),
        &raster(1.0).iter().map(|p| p.map(|v| v + 1e6)).collect::<Vec<_>>(),
    );
    path(&dir.join("path-at-rest"), &[[5.0, 4.0]; 195]);
    path(&dir.join("path-wide"), &[[-1e7, -1e7], [1e7, 1e7], [0.0, 0.0]]);
    let axis = |name: &str| {
        format!(
            r#"{{"name": "{name}", "max_velocity_mm_per_s": 100, "max_acceleration_mm_per_s2": 1000}}"#
        )
    };
    let machine = format!(r#"{{"name": "m", "axes": [{}, {}]}}"#, axis("x"), axis("y"));
    fs::write(dir.join("machine.json"), machine).unwrap();
    [
        vec![
            "one-valid-pixel",
            "one-row",
            "one-column",
            "chess-board",
            "nan",
            "constant",
            "zero",
            "marked",
            "in-metres",
            "two-by-two",
            "one-pixel",
            "axes-in-metres",
            "axes-in-um",
        ],
        vec![
            "tif-one-pixel",
            "tif-hot-pixel",
            "tif-zero",
            "tif-negative",
            "tif-two-by-two",
            "tif-in-metres",
            "tif-in-um",
            "tif-from-zero",
            "tif-in-m-per-s",
        ],
        vec!["path-in-um", "path-in-metres", "path-far", "path-at-rest", "path-wide"],
    ]
}

/// Runs `binary` in `dir`; returns its exit code and its standard error. Panics if the program does not end
/// as the module states. `out` is the output that it would write.
pub fn survives(binary: &str, dir: &Path, arguments: &[&str], out: &str) -> (i32, String) {
    let out = dir.join(out);
    let _ = fs::remove_dir_all(&out);
    let _ = fs::remove_file(&out);
    let ended = run_within(stage(binary).current_dir(dir).args(arguments), TIME_LIMIT);
    let (status, said) = (ended.status, text(&ended.stderr));
    let code =
        status.code().unwrap_or_else(|| panic!("{arguments:?} was killed: {status}: {said}"));
    let what = format!("{arguments:?} ended with {code}: {said}");
    assert!((0..=2).contains(&code), "{what}");
    assert!(!said.contains("internal error") && !said.contains("panicked"), "{what}");
    let errors = said.lines().filter(|line| line.starts_with("error:")).count();
    assert_eq!(errors, usize::from(code == 2), "{what}");
    if code == 2 {
        assert!(!out.exists(), "it wrote: {what}");
    } else {
        manifests(&out, &mut |manifest| {
            let outcome = manifest.split("\"outcome\":").nth(1).unwrap_or_default();
            let outcome = outcome.split("\"arrays\":").next().unwrap_or_default();
            assert!(!outcome.contains("null"), "{what}: {outcome}");
        });
    }
    (code, said)
}

fn manifests(dir: &Path, check: &mut impl FnMut(String)) {
    for entry in fs::read_dir(dir).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            manifests(&path, check);
        } else if path.ends_with("manifest.json") {
            check(fs::read_to_string(path).unwrap());
        }
    }
}

/// [`survives`] for every value of every flag, each as `--flag=value`.
pub fn every_value(
    binary: &str,
    dir: &Path,
    arguments: &[&str],
    flags: &[&str],
    values: &[&str],
    out: &str,
) {
    for flag in flags {
        for value in values {
            let set = format!("{flag}={value}");
            survives(binary, dir, &[arguments, &[set.as_str()]].concat(), out);
        }
    }
}
