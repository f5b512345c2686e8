//! The binary from its flags to its files and exit codes.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::{Tool, artifact, npy::ArrayData};
use planish_testkit::program::{save_array, text, write};
use planish_types::{Axis, DwellTime, Grid, Surface, Tif, TimeFactor, ToolPath, VaryingTif};
use serde_json::{Value, json};

fn axis(start: f64, step: f64, n: usize) -> Axis {
    Axis::new(start, step, n).unwrap()
}

/// Returns the grid of the map: 12 x 8 mm in pixels of 0.25 mm.
fn map_grid() -> Grid {
    Grid { x: axis(0.0, 0.25, 49), y: axis(0.0, 0.25, 33) }
}

/// Returns a Gaussian TIF of 5 nm/s and sigma 0.8 mm, out to 3 mm.
fn tif() -> Tif {
    let g = Grid { x: axis(-3.0, 0.25, 25), y: axis(-3.0, 0.25, 25) };
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        5.0 * (-(g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2)) / (2.0 * 0.8 * 0.8))
            .exp()
    });
    Tif::new(g, rate).unwrap()
}

/// Returns a path of two passes of four dwell points each, 2 mm apart, off the pixel centres.
fn path() -> ToolPath {
    let dwell: Vec<[f64; 2]> = (0..8)
        .map(|i| {
            let (line, k) = (i / 4, f64::from(i % 4));
            let k = if line == 0 { k } else { 3.0 - k };
            [3.05 + 2.0 * k, 2.9 + 2.0 * f64::from(line)]
        })
        .collect();
    let mut points = vec![[3.05, 2.9]];
    points.extend(dwell.iter().map(|p| [p[0] + 1.0, p[1]]));
    ToolPath::new(points, dwell, vec![true; 8], vec![0, 0, 0, 0, 1, 1, 1, 1]).unwrap()
}

const PLANTED_S: [f64; 8] = [0.4, 1.0, 0.7, 0.2, 0.9, 1.3, 0.5, 0.8];

/// Returns the removal by `seconds` at the dwell points of `path` (ny, nx), nm, by the definition of the TIF.
fn removal(path: &ToolPath, seconds: &[f64]) -> Array2<f64> {
    let (g, tif) = (map_grid(), tif());
    Array2::from_shape_fn(g.shape(), |(r, c)| {
        let at =
            |p: &[f64; 2]| tif.rate_at(g.x.coordinate_mm(c) - p[0], g.y.coordinate_mm(r) - p[1]);
        path.dwell_point_mm().iter().zip(seconds).map(|(p, t)| t * at(p)).sum()
    })
}

/// Writes the inputs: among them a surface that the planted dwell times remove up to a piston of 20 nm.
fn prepare(dir: &Path) {
    let height = removal(&path(), &PLANTED_S) + 20.0;
    write(dir, "surface", &Surface::new(map_grid(), height).unwrap());
    write(dir, "tif", &tif());
    write(dir, "tool_path", &path());
}

const INPUTS: [&str; 7] =
    ["bounded-least-squares", "--surface", "surface", "--tif", "tif", "--tool-path", "tool_path"];
/// Flags for columns at the dwell points and no regularisation: the planted dwell times are the solution.
const EXACT: [&str; 4] = ["--columns=point", "--tikhonov=0", "--slope-weight=0", "--out=dwell"];

fn run_on(threads: &str, dir: &Path, arguments: &[&str]) -> Output {
    planish_testkit::program::stage("planish-dwell")
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", threads)
        .args(arguments)
        .output()
        .unwrap()
}

fn run(dir: &Path, more: &[&str]) -> Output {
    run_on("2", dir, &[&INPUTS[..], more].concat())
}

fn done(output: &Output) {
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
}

fn dwell_s(dir: &Path) -> Vec<f64> {
    artifact::read::<DwellTime>(&dir.join("dwell")).unwrap().value.dwell_s().to_vec()
}

fn manifest(dir: &Path) -> Value {
    let text = fs::read_to_string(dir.join("dwell/manifest.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

#[test]
fn planted_dwell_times_come_back_and_the_manifest_has_the_report() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let output = run(tmp.path(), &EXACT);
    done(&output);
    let found = dwell_s(tmp.path());
    for (t, planted) in found.iter().zip(PLANTED_S) {
        // Rounding times the condition of H, about 1e2 for points 2.5 sigma apart.
        assert!((t - planted).abs() < 1e-11, "{found:?}");
    }
    let manifest = manifest(tmp.path());
    let report = &manifest["outcome"]["report"];
    assert_eq!(manifest["outcome"]["status"], "done");
    assert_eq!((&report["algorithm"], &report["end"]), (&json!("active-set"), &json!("optimal")));
    // Rounding of heights of some ten nm, from the same solution.
    assert!(number(&report["model_rms_nm"]) < 1e-11, "{report}");
    let total: f64 = PLANTED_S.iter().sum();
    // Eight times that of one.
    assert!((number(&report["total_time_s"]) - total).abs() < 1e-10);
    assert_eq!((&report["at_lower_bound"], &report["unreached_points"]), (&json!(0), &json!(0)));
    assert_eq!(manifest["settings"]["columns"], "point");
    assert_eq!(manifest["settings"]["min_dwell"], json!({"seconds": 0.0}));
    let roles: Vec<_> = manifest["inputs"].as_array().unwrap().iter().map(|i| &i["role"]).collect();
    assert_eq!(roles, ["surface", "tif", "tool-path"]);
    assert!(text(&output.stdout).contains("8 dwell times, 5.80 s"), "{output:?}");

    let again = run(tmp.path(), &EXACT);
    done(&again);
    assert!(text(&again.stdout).contains("unchanged"));
}

/// The rate halves in 6 s. Each dwell time removes at the rates of its own time in the run, which begins after all
/// dwell times before it.
#[test]
fn planted_dwell_times_come_back_where_the_rate_halves_in_the_course_of_the_run() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    // The integral of c = 1 - t / 12 s from the start to the end of each.
    let mut start_s = 0.0;
    let effective_s = PLANTED_S.map(|t| {
        let mean = 1.0 - (start_s + 0.5 * t) / 12.0;
        start_s += t;
        t * mean
    });
    let height = removal(&path(), &effective_s) + 20.0;
    write(tmp.path(), "surface", &Surface::new(map_grid(), height).unwrap());
    let time = TimeFactor { time_s: vec![0.0, 6.0], factor: vec![1.0, 0.5] };
    let wears = Tif::varying(VaryingTif { time: Some(time), ..tif().numbers() }).unwrap();
    fs::remove_dir_all(tmp.path().join("tif")).unwrap();
    write(tmp.path(), "tif", &Tool(wears));
    done(&run(tmp.path(), &EXACT));
    let found = dwell_s(tmp.path());
    for (t, planted) in found.iter().zip(PLANTED_S) {
        // Rounding times the condition of H, as without a change of the rate, and of the sums of the times.
        assert!((t - planted).abs() < 1e-10, "{found:?}");
    }
    let manifest = manifest(tmp.path());
    let report = &manifest["outcome"]["report"];
    assert!(number(&report["model_rms_nm"]) < 1e-10, "{report}");
    assert!(number(&report["rates_of_time"]["rate_error"]) < 1e-5, "{report}");

    // A solver that assumes a constant rate refuses the tool.
    for solver in ["tikhonov-lsqr", "non-negative-least-squares", "lucy-richardson", "rifta", "udo"]
    {
        let inputs = [&[solver], &INPUTS[1..], &["--out=refused"]].concat();
        let output = run_on("2", tmp.path(), &inputs);
        let refused = output.status.code() == Some(2);
        assert!(refused && text(&output.stderr).contains("tif"), "{solver}: {output:?}");
        assert!(!tmp.path().join("refused").exists());
    }
}

#[test]
fn bounds_hold_and_are_counted() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let bounds = ["--min-dwell-s=0.45", "--max-dwell-s=0.95"];
    done(&run(tmp.path(), &[&EXACT[..], &bounds].concat()));
    let found = dwell_s(tmp.path());
    assert!(found.iter().all(|t| (0.45..=0.95).contains(t)), "{found:?}");
    // The planted 0.2 and 1.3 are far beyond.
    assert_eq!((found[3], found[5]), (0.45, 0.95));
    let report = manifest(tmp.path())["outcome"]["report"].clone();
    let at = |bound: f64| json!(found.iter().filter(|t| **t == bound).count());
    assert_eq!((&report["at_lower_bound"], &report["at_upper_bound"]), (&at(0.45), &at(0.95)));

    // Bounds per length: the first segment has 1 mm, the others 2 mm.
    let bounds = ["--min-dwell-s-per-mm=0.5", "--max-dwell-s-per-mm=0.5", "--force"];
    done(&run(tmp.path(), &[&EXACT[..], &bounds].concat()));
    for (i, t) in dwell_s(tmp.path()).iter().enumerate() {
        // Rounding of the lengths.
        assert!((t - 0.5 * path().segment_length_mm(i)).abs() < 1e-15, "{i}: {t}");
    }
}

#[test]
fn one_dwell_point_is_a_weighted_straight_line_fit() {
    let tmp = tempfile::tempdir().unwrap();
    let path = ToolPath::through(vec![[5.1, 4.0], [7.1, 4.0]], vec![true], vec![0]).unwrap();
    let rate = removal(&path, &[1.0]);
    let g = map_grid();
    let mut height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        2.0 * rate[[r, c]] + 0.3 * g.x.coordinate_mm(c) + (1.7 * g.y.coordinate_mm(r)).sin()
    });
    height[[16, 24]] = f64::NAN;
    let weight = Array2::from_shape_fn(g.shape(), |(r, c)| ((r * 7 + c * 3) % 5) as f64);
    write(tmp.path(), "surface", &Surface::new(g, height.clone()).unwrap());
    write(tmp.path(), "tif", &tif());
    write(tmp.path(), "tool_path", &path);
    save_array(tmp.path(), "weight", ArrayData::F64(weight.clone().into_dyn().into()));
    done(&run(tmp.path(), &[&EXACT[..], &["--weight=weight.npy"]].concat()));

    // t = sum w (R - mean R)(z - mean z) / sum w (R - mean R)^2
    let valid: Vec<(f64, f64, f64)> = (weight.iter().zip(&rate).zip(&height))
        .filter(|(_, z)| !z.is_nan())
        .map(|((w, r), z)| (*w, *r, *z))
        .collect();
    let sum = |f: &dyn Fn(f64, f64, f64) -> f64| -> f64 {
        valid.iter().map(|(w, r, z)| f(*w, *r, *z)).sum()
    };
    let total = sum(&|w, _, _| w);
    let (r0, z0) = (sum(&|w, r, _| w * r) / total, sum(&|w, _, z| w * z) / total);
    let expected =
        sum(&|w, r, z| w * (r - r0) * (z - z0)) / sum(&|w, r, _| w * (r - r0) * (r - r0));
    let found = dwell_s(tmp.path())[0];
    // Rounding of some thousand terms.
    assert!((found - expected).abs() < 1e-12, "{found} {expected}");
}

#[test]
fn a_tif_larger_than_the_map_is_used_as_it_is() {
    let tmp = tempfile::tempdir().unwrap();
    let g = Grid { x: axis(4.0, 0.25, 9), y: axis(3.0, 0.25, 7) };
    let all = removal(&path(), &PLANTED_S);
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| all[[r + 12, c + 16]]);
    write(tmp.path(), "surface", &Surface::new(g, height).unwrap());
    write(tmp.path(), "tif", &tif());
    let p = ToolPath::through(vec![[4.05, 2.9], [6.05, 4.9]], vec![true], vec![0]).unwrap();
    write(tmp.path(), "tool_path", &p);
    done(&run(tmp.path(), &EXACT));
    // One unknown: t = <b, z> / <b, b> of the removal b in one second and the map z, without their means.
    let centred = |map: Array2<f64>| {
        let mean = map.mean().unwrap();
        map - mean
    };
    let b = centred(Array2::from_shape_fn(g.shape(), |(r, c)| {
        tif().rate_at(g.x.coordinate_mm(c) - 5.05, g.y.coordinate_mm(r) - 3.9)
    }));
    let z = centred(Array2::from_shape_fn(g.shape(), |(r, c)| all[[r + 12, c + 16]]));
    let expected = (&b * &z).sum() / (&b * &b).sum();
    let found = dwell_s(tmp.path())[0];
    // Rounding of sums over 63 pixels.
    assert!(expected > 0.01 && (found / expected - 1.0).abs() < 1e-12, "{found} {expected}");
}

/// Every byte of the output is the same for any number of threads, for both algorithms.
#[test]
fn the_bytes_do_not_depend_on_the_threads() {
    let by_threads = |more: &[&str], prepare: &dyn Fn(&Path)| {
        let bytes: Vec<_> = ["1", "2"]
            .iter()
            .map(|threads| {
                let tmp = tempfile::tempdir().unwrap();
                prepare(tmp.path());
                let output = run_on(threads, tmp.path(), &[&INPUTS[..], more].concat());
                assert!(output.status.code() <= Some(1), "{}", text(&output.stderr));
                ["dwell_s.npy", "manifest.json"]
                    .map(|file| fs::read(tmp.path().join("dwell").join(file)).unwrap())
            })
            .collect();
        assert!(bytes[0] == bytes[1]);
        String::from_utf8(bytes[0][1].clone()).unwrap()
    };
    let rough = |dir: &Path| {
        prepare(dir);
        let height = removal(&path(), &PLANTED_S);
        let rough = |(r, c): (usize, usize)| ((r * 31 + c * 17) as f64).sin();
        let height = &height + &Array2::from_shape_fn(height.dim(), rough);
        write(dir, "surface", &Surface::new(map_grid(), height).unwrap());
    };
    assert!(by_threads(&["--out=dwell"], &rough).contains("active-set"));
    // More dwell points than the matrix is used for.
    let many = |dir: &Path| {
        rough(dir);
        let line = |r: u32| {
            (0..101).map(move |k| {
                let x = 0.12 * f64::from(k);
                [if r.is_multiple_of(2) { x } else { 12.0 - x }, 8.0 / 60.0 * f64::from(r)]
            })
        };
        let points: Vec<[f64; 2]> = (0..61).flat_map(line).collect();
        let n = points.len() - 1;
        let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
        write(dir, "tool_path", &path);
    };
    let manifest = by_threads(&["--out=dwell"], &many);
    assert!(manifest.contains("\"two-level\"") && manifest.contains("\"optimal\""), "{manifest}");
}

/// Runs the command with the flags `more`, and checks for exit code 2, one message that contains `expected`, and no
/// output.
fn refused(dir: &Path, more: &[&str], expected: &[&str]) {
    let output = run(dir, more);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    let errors: Vec<&str> = message.lines().filter(|l| l.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{message}");
    for part in expected {
        assert!(errors[0].contains(part), "no {part:?} in: {message}");
    }
    assert!(!dir.join("dwell").exists() && output.stdout.is_empty(), "{output:?}");
}

#[test]
fn bad_flags_end_with_2_a_message_and_no_output() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    for (flags, expected) in [
        (&["--min-dwell-s=2", "--max-dwell-s=1"][..], "max_dwell[0]: is 1 s, below the lower"),
        (&["--min-dwell-s=1", "--max-dwell-s-per-mm=0.6"], "max_dwell[0]: is 0.6"),
        (&["--min-dwell-s=-1"], "min_dwell: is -1; give a finite bound >= 0"),
        (&["--min-dwell-s=nan"], "min_dwell: is NaN"),
        (&["--max-dwell-s=inf"], "max_dwell: is inf"),
        (&["--tikhonov=-1e-5"], "tikhonov: is -0.00001; give a number >= 0"),
        (&["--slope-weight=nan"], "slope_weight: is NaN"),
        (&["--min-dwell-s=1", "--min-dwell-s-per-mm=1"], "cannot be used with"),
        (&["--columns=spline"], "invalid value 'spline'"),
        (&["--weight=nowhere.npy"], "nowhere.npy: cannot read"),
    ] {
        refused(tmp.path(), &[flags, &["--out=dwell"]].concat(), &[expected]);
    }
    refused(tmp.path(), &[], &["required"]);
}

#[test]
fn bad_maps_end_with_2_and_name_file_place_and_remedy() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let bad = tmp.path().join("bad");
    let bare = |height: Array2<f64>, grid: Grid| {
        save_array(&bad, "height_nm", ArrayData::F64(height.into_dyn().into()));
        for (name, a) in [("x_mm", grid.x), ("y_mm", grid.y)] {
            save_array(
                &bad,
                name,
                ArrayData::F64(ndarray::Array1::from(a.coordinates()).into_dyn().into()),
            );
        }
    };
    let surface = |expected: &[&str]| {
        refused(tmp.path(), &["--out=dwell", "--surface=bad"], expected);
    };
    // clap refuses a flag that is given twice, so the good one is left out here.
    let inputs = INPUTS.map(|s| if s == "surface" { "bad" } else { s });
    let refused_map = |expected: &[&str]| {
        let output = run_on("2", tmp.path(), &[&inputs[..], &["--out=dwell"]].concat());
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        for part in expected {
            assert!(message.contains(part), "no {part:?} in: {message}");
        }
        assert!(!tmp.path().join("dwell").exists());
    };
    surface(&["cannot be used multiple times"]);
    refused_map(&["bad: does not exist; give a surface directory"]);

    let g = map_grid();
    bare(Array2::from_elem(g.shape(), f64::NAN), g);
    refused_map(&["bad/height_nm.npy: ", "every pixel is NaN; give at least one valid pixel"]);
    let mut infinite = Array2::zeros(g.shape());
    infinite[[3, 4]] = f64::INFINITY;
    bare(infinite, g);
    refused_map(&["bad/height_nm.npy: element [3, 4] is inf; mark an invalid pixel by NaN"]);
    save_array(&bad, "height_nm", ArrayData::F64(Array2::zeros((0, 49)).into_dyn().into()));
    refused_map(&["bad/height_nm.npy: is empty (shape [0, 49])"]);
    save_array(
        &bad,
        "height_nm",
        ArrayData::I64(Array2::from_elem((33, 49), i64::MAX).into_dyn().into()),
    );
    refused_map(&["bad/height_nm.npy: element [0, 0] is 9223372036854775807 of dtype <i8"]);
    bare(Array2::zeros((49, 33)), g);
    refused_map(&["bad/x_mm.npy: has shape [49]", "33 from height_nm.npy"]);
}

/// Checks as [`refused`] does, after `change` has replaced an input.
fn refused_after(change: impl FnOnce(&Path), more: &[&str], expected: &[&str]) {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    change(tmp.path());
    refused(tmp.path(), &[&["--out=dwell"], more].concat(), expected);
}

#[test]
fn bad_tifs_paths_and_weights_end_with_2() {
    let bare_tif = |value: f64| {
        move |dir: &Path| {
            fs::remove_dir_all(dir.join("tif")).unwrap();
            let dir = dir.join("tif");
            save_array(
                &dir,
                "rate_nm_per_s",
                ArrayData::F64(Array2::from_elem((3, 3), value).into_dyn().into()),
            );
            for name in ["x_mm", "y_mm"] {
                let a = ndarray::array![-1.0, 0.0, 1.0];
                save_array(&dir, name, ArrayData::F64(a.into_dyn().into()));
            }
        }
    };
    let rate = "tif/rate_nm_per_s.npy: ";
    refused_after(bare_tif(0.0), &[], &[rate, "no positive rate (largest 0 nm/s)", "check its"]);
    refused_after(bare_tif(-1.0), &[], &[rate, "no positive rate"]);
    refused_after(bare_tif(f64::NAN), &[], &[rate, "element [0, 0] is NaN; give finite values"]);

    let far = |dir: &Path| {
        let points = path().point_mm().iter().map(|p| [p[0] + 1e3, p[1]]).collect();
        let path = ToolPath::through(points, vec![true; 8], vec![0; 8]).unwrap();
        write(dir, "tool_path", &path);
    };
    refused_after(far, &[], &["reaches no valid pixel", "none of the 8 dwell points", "in mm"]);
    let lifted = |dir: &Path| {
        let path = path();
        let (p, d) = (path.point_mm().to_vec(), path.dwell_point_mm().to_vec());
        write(dir, "tool_path", &ToolPath::new(p, d, vec![false; 8], vec![0; 8]).unwrap());
    };
    refused_after(lifted, &[], &["reaches no valid pixel"]);
    let mixed = |dir: &Path| {
        fs::remove_dir_all(dir.join("tool_path")).unwrap();
        fs::rename(dir.join("tif"), dir.join("tool_path")).unwrap();
        write(dir, "tif", &tif());
    };
    refused_after(mixed, &[], &["tool_path: holds a tif, needs a tool_path; check the order"]);

    let weight = |w: Array2<f64>| {
        move |dir: &Path| save_array(dir, "weight", ArrayData::F64(w.clone().into_dyn().into()))
    };
    let flag = ["--weight=weight.npy"];
    let shape = map_grid().shape();
    let mut negative = Array2::ones(shape);
    negative[[5, 6]] = -0.5;
    refused_after(weight(negative), &flag, &["weight[5, 6]: is -0.5; give weights >= 0"]);
    refused_after(weight(Array2::zeros(shape)), &flag, &["weight: is 0 on every valid pixel"]);
    refused_after(weight(Array2::ones((3, 4))), &flag, &["weight: has shape (3, 4), the map (33"]);
    refused_after(weight(Array2::from_elem(shape, f64::NAN)), &flag, &["weight[0, 0]: is NaN"]);
}

#[test]
fn dwell_points_on_one_spot_need_a_regularisation() {
    let same = |dir: &Path| {
        let points = vec![[6.0, 4.0]; 3];
        let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
        write(dir, "tool_path", &path);
    };
    refused_after(
        same,
        &["--tikhonov=0", "--slope-weight=0"],
        &["not determined by the surface; raise --tikhonov (now 0) above 0"],
    );
}
