//! The binary from its flags to its files and exit codes.

use std::{f64::consts::PI, fs, path::Path, process::Output};

use ndarray::{Array1, Array2, Array3};
use planish_handoff::{
    artifact,
    kind::Dtype,
    npy::{self, ArrayData},
};
use planish_testkit::program::{save_array, text, write};
use planish_types::{Axis, Grid, Removal, Surface, Tif, Trajectory};
use serde_json::{Value, json};

const PEAK: f64 = 8.0;
const SIGMA: f64 = 1.0;

fn axis(start: f64, step: f64, n: usize) -> Axis {
    Axis::new(start, step, n).unwrap()
}

/// Returns the grid of the map: 10 x 6 mm in pixels of 0.2 mm.
fn map_grid() -> Grid {
    Grid { x: axis(0.0, 0.2, 51), y: axis(0.0, 0.2, 31) }
}

/// Makes a Gaussian TIF out to 6 sigma: 1.5e-8 of the peak is cut.
fn tif() -> Tif {
    let a = axis(-6.0, 0.2, 61);
    let g = Grid { x: a, y: a };
    Tif::new(
        g,
        Array2::from_shape_fn(g.shape(), |(r, c)| {
            gaussian(g.x.coordinate_mm(c), g.y.coordinate_mm(r))
        }),
    )
    .unwrap()
}

fn gaussian(dx: f64, dy: f64) -> f64 {
    PEAK * (-(dx * dx + dy * dy) / (2.0 * SIGMA * SIGMA)).exp()
}

/// Makes a pass along x at y = 2.53 from far before to far beyond the map at 4 mm/s, then 3 s elsewhere with the tool
/// off.
fn pass() -> Trajectory {
    let coefficients = vec![
        [[-20.0, 4.0, 0.0, 0.0], [2.53, 0.0, 0.0, 0.0]],
        [[5.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]],
    ];
    Trajectory::new(vec![0.0, 12.5, 15.5], coefficients, vec![true, false], vec![Some(0), None])
        .unwrap()
}

/// Makes a map that is asymmetric about both axes, with an invalid pixel.
fn desired() -> Surface {
    let g = map_grid();
    let mut z = Array2::from_shape_fn(g.shape(), |(r, c)| {
        10.0 + g.x.coordinate_mm(c) - 0.1 * g.y.coordinate_mm(r).exp()
    });
    z[[7, 11]] = f64::NAN;
    Surface::new(g, z).unwrap()
}

fn prepare(dir: &Path) {
    write(dir, "trajectory", &pass());
    write(dir, "tif", &tif());
    write(dir, "surface", &desired());
}

fn run_on(threads: &str, dir: &Path, more: &[&str]) -> Output {
    planish_testkit::program::stage("planish-simulate")
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", threads)
        .args(["--trajectory", "trajectory", "--tif", "tif", "--surface", "surface"])
        .args(if more.contains(&"--out") { &[][..] } else { &["--out", "removal"] })
        .args(more)
        .output()
        .unwrap()
}

fn simulate(dir: &Path, more: &[&str]) -> Removal {
    let output = run_on("2", dir, more);
    // These motions are there to be computed, whatever they make of the surface.
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", text(&output.stderr));
    artifact::read::<Removal>(&dir.join("removal")).unwrap().value
}

fn outcome(dir: &Path) -> Value {
    let text = fs::read_to_string(dir.join("removal/manifest.json")).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["outcome"].clone()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

fn largest(a: &Array2<f64>, f: impl Fn(usize, usize) -> f64) -> f64 {
    a.indexed_iter().map(|((r, c), v)| (v - f(r, c)).abs()).fold(0.0, f64::max)
}

/// Returns the removal by an infinite straight pass at the distance `y_mm`: A sigma sqrt(2 pi) / v exp(-y^2 / 2
/// sigma^2).
fn trough(y_mm: f64) -> f64 {
    let dy = y_mm - 2.53;
    PEAK * SIGMA * (2.0 * PI).sqrt() / 4.0 * (-dy * dy / (2.0 * SIGMA * SIGMA)).exp()
}

#[test]
fn a_straight_pass_is_the_closed_form_and_the_lifted_tool_removes_nothing() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let removal = simulate(tmp.path(), &[]);
    let g = map_grid();
    let error = largest(removal.removal_nm(), |r, _| trough(g.y.coordinate_mm(r)));
    // Keys' interpolation of the Gaussian at a fifth of sigma: 4e-4 of the removal of 5 nm.
    assert!(error < 4e-3, "{error}");
    // residual = desired - removal to rounding; NaN stays.
    let z = desired();
    for ((r, c), v) in removal.residual().height_nm().indexed_iter() {
        let expected = z.height_nm()[[r, c]] - removal.removal_nm()[[r, c]];
        assert!((v - expected).abs() < 1e-13 || (v.is_nan() && (r, c) == (7, 11)), "{r} {c}: {v}");
    }
    let outcome = outcome(tmp.path());
    let statistics = removal.residual().statistics();
    assert_eq!(outcome["status"], "done");
    for (key, value) in [
        ("rms_nm", statistics.rms),
        ("pv_nm", statistics.pv),
        ("rms_detilted_nm", removal.residual().detilted_rms_nm()),
    ] {
        // The parser of JSON may miss the last bit of a number.
        assert!((number(&outcome[key]) / value - 1.0).abs() < 1e-15, "{key}: {outcome}");
    }
    assert_eq!(number(&outcome["total_time_s"]), 15.5);
    assert_eq!(outcome["numerics"]["tif_interpolation_error"], 0.0);

    let again = run_on("2", tmp.path(), &[]);
    assert_eq!(again.status.code(), Some(0));
    assert!(text(&again.stdout).contains("unchanged"));
}

#[test]
fn a_resting_tool_removes_its_tif_at_pixel_minus_tool() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    // Asymmetric: the sign of the offset shows.
    let g = Grid { x: axis(-0.8, 0.2, 9), y: axis(-0.4, 0.2, 8) };
    let rate = |dx: f64, dy: f64| 5.0 + 2.0 * dx - dy + dx * dy;
    let tif = Tif::new(
        g,
        Array2::from_shape_fn(g.shape(), |(r, c)| rate(g.x.coordinate_mm(c), g.y.coordinate_mm(r))),
    );
    write(tmp.path(), "tif", &tif.unwrap());
    let c = [[3.33, 0.0, 0.0, 0.0], [2.71, 0.0, 0.0, 0.0]];
    let rest = Trajectory::new(vec![0.0, 2.5], vec![c], vec![true], vec![Some(0)]).unwrap();
    write(tmp.path(), "trajectory", &rest);
    let removal = simulate(tmp.path(), &[]);
    let map = map_grid();
    let error = largest(removal.removal_nm(), |r, c| {
        let (dx, dy) = (map.x.coordinate_mm(c) - 3.33, map.y.coordinate_mm(r) - 2.71);
        let inside = (-0.8..=0.8).contains(&dx) && (-0.4..=1.0).contains(&dy);
        if inside { 2.5 * rate(dx, dy) } else { 0.0 }
    });
    // Keys reproduces quadratics; rounding of an FFT of values up to 20.
    assert!(error < 1e-11, "{error}");
}

#[test]
fn the_direct_method_converges_to_the_gridded_one_with_the_second_order_of_the_midpoint_rule() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    // A curved, accelerated motion inside the map.
    let c = vec![[[2.0, 1.0, 0.7, -0.2], [1.0, 2.0, -0.3, 0.1]]];
    let t = Trajectory::new(vec![0.0, 2.0], c, vec![true], vec![Some(0)]).unwrap();
    write(tmp.path(), "trajectory", &t);
    let gridded = simulate(tmp.path(), &[]);
    let error = |steps: &str| {
        let direct = simulate(tmp.path(), &["--integral=direct", "--steps", steps, "--force"]);
        largest(direct.removal_nm(), |r, c| gridded.removal_nm()[[r, c]])
    };
    let (coarse, fine) = (error("40"), error("160"));
    // A quarter of the step: a sixteenth of the error.
    assert!((14.0..18.0).contains(&(coarse / fine)), "{coarse} {fine}");
    assert!(fine < 1e-3, "{fine}");
    let settings = fs::read_to_string(tmp.path().join("removal/manifest.json")).unwrap();
    assert!(settings.contains("\"steps\": 160"));
}

#[test]
fn a_tif_larger_than_the_map_removes_what_is_in_reach() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let g = Grid { x: axis(4.0, 0.2, 3), y: axis(2.0, 0.2, 4) };
    let flat = Array2::from_shape_fn((4, 3), |(r, c)| (r * c) as f64);
    write(tmp.path(), "surface", &Surface::new(g, flat).unwrap());
    let removal = simulate(tmp.path(), &[]);
    // As on the larger map.
    let error = largest(removal.removal_nm(), |r, _| trough(g.y.coordinate_mm(r)));
    // As above, on the larger map.
    assert!(error < 4e-3, "{error}");
}

#[test]
fn bare_directories_of_a_numpy_user_are_read_with_a_warning() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let whole = simulate(tmp.path(), &[]);
    for name in ["trajectory", "tif", "surface"] {
        fs::remove_file(tmp.path().join(name).join("manifest.json")).unwrap();
    }
    let output = run_on("2", tmp.path(), &["--force"]);
    assert_eq!(output.status.code(), Some(0));
    assert_eq!(text(&output.stderr).matches("warning: ").count(), 3, "{output:?}");
    // The same arrays are the same input: nothing to do.
    assert!(text(&output.stdout).contains("unchanged"));
    // Without tool_on the tool is on: 3 s of rest at (5, 3) more.
    fs::remove_file(tmp.path().join("trajectory/tool_on.npy")).unwrap();
    let more = simulate(tmp.path(), &["--force"]);
    let g = map_grid();
    let error = largest(more.removal_nm(), |r, c| {
        whole.removal_nm()[[r, c]]
            + 3.0 * gaussian(g.x.coordinate_mm(c) - 5.0, g.y.coordinate_mm(r) - 3.0)
    });
    // (5, 3) is a pixel centre; rounding of an FFT of values up to 30.
    assert!(error < 1e-11, "{error}");
}

#[test]
fn the_bytes_do_not_depend_on_the_threads() {
    for more in [&[][..], &["--integral=direct"]] {
        let bytes: Vec<_> = ["1", "2"]
            .iter()
            .map(|threads| {
                let tmp = tempfile::tempdir().unwrap();
                prepare(tmp.path());
                // A TIF of another pitch: the longer way.
                let a = axis(-3.0, 0.13, 47);
                let g = Grid { x: a, y: a };
                let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
                    gaussian(g.x.coordinate_mm(c), g.y.coordinate_mm(r))
                });
                write(tmp.path(), "tif", &Tif::new(g, rate).unwrap());
                let segments = (0..200).map(|i| {
                    let u = f64::from(i);
                    [[0.05 * u, 0.7, -0.4, 0.1], [3.0 + 2.0 * (0.1 * u).sin(), -0.3, 0.2, 0.0]]
                });
                let breaks = (0..=200).map(|i| 0.3 * f64::from(i)).collect();
                let t = Trajectory::new(
                    breaks,
                    segments.collect(),
                    vec![true; 200],
                    (0..200).map(Some).collect(),
                );
                write(tmp.path(), "trajectory", &t.unwrap());
                let output = run_on(threads, tmp.path(), more);
                assert!(matches!(output.status.code(), Some(0 | 1)), "{}", text(&output.stderr));
                let out = tmp.path().join("removal");
                ["removal_nm.npy", "residual_nm.npy", "manifest.json"]
                    .map(|file| fs::read(out.join(file)).unwrap())
            })
            .collect();
        assert!(bytes[0] == bytes[1], "{more:?}");
    }
}

/// Runs the inputs after `change` of their directory, with the arguments `more`. Expects exit code 2, one message with
/// every part of `expected`, and no output.
fn refused_after(change: impl FnOnce(&Path), more: &[&str], expected: &[&str]) {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    change(tmp.path());
    let output = run_on("2", tmp.path(), more);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    let errors: Vec<&str> = message.lines().filter(|l| l.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{message}");
    for part in expected {
        assert!(errors[0].contains(part), "no {part:?} in: {message}");
    }
    assert!(!tmp.path().join("removal").exists() && output.stdout.is_empty(), "{output:?}");
}

/// Removes the manifest of an input, for tests that put their own arrays in, and returns the directory of the input.
fn bare(dir: &Path, name: &str) -> std::path::PathBuf {
    fs::remove_file(dir.join(name).join("manifest.json")).unwrap();
    dir.join(name)
}

#[test]
fn bad_trajectories_end_with_2_and_name_file_place_and_remedy() {
    let trajectory = |name: &'static str, array: ArrayData<'static>| {
        move |dir: &Path| save_array(&bare(dir, "trajectory"), name, array)
    };
    let times = |t: [f64; 3]| ArrayData::F64(Array1::from(t.to_vec()).into_dyn().into());
    let file = "trajectory/break_time_s.npy: ";
    refused_after(
        trajectory("break_time_s", times([0.0, 2.0, 1.0])),
        &[],
        &[file, "break_time_s[2]: is 1 after 2; break times ascend strictly"],
    );
    refused_after(
        trajectory("break_time_s", times([0.0, f64::NAN, 1.0])),
        &[],
        &[file, "element [1] is NaN; give finite values"],
    );
    let mut c = Array3::zeros((2, 2, 4));
    c[[1, 0, 3]] = f64::INFINITY;
    refused_after(
        trajectory("coefficient_mm", ArrayData::F64(c.into_dyn().into())),
        &[],
        &["trajectory/coefficient_mm.npy: element [1, 0, 3] is inf; give finite values"],
    );
    refused_after(
        trajectory("coefficient_mm", ArrayData::F64(Array3::zeros((2, 4, 2)).into_dyn().into())),
        &[],
        &["trajectory/coefficient_mm.npy: has shape [2, 4, 2], needs (k, 2, 4)"],
    );
    refused_after(
        trajectory("dwell_index", ArrayData::F64(Array1::from(vec![0.0, 0.5]).into_dyn().into())),
        &[],
        &["trajectory/dwell_index.npy: element [1] is 0.5 of dtype <f8, which <i8 does not have"],
    );
    refused_after(
        trajectory("coefficient_mm", ArrayData::F64(Array3::zeros((0, 2, 4)).into_dyn().into())),
        &[],
        &["trajectory/coefficient_mm.npy: is empty (shape [0, 2, 4])"],
    );
}

#[test]
fn bad_maps_tifs_and_flags_end_with_2() {
    let map = |input: &'static str, name: &'static str, value: f64, shape: (usize, usize)| {
        move |dir: &Path| {
            let array = Array2::from_elem(shape, value);
            save_array(&bare(dir, input), name, ArrayData::F64(array.into_dyn().into()));
        }
    };
    let (rate, height) = ("tif/rate_nm_per_s.npy: ", "surface/height_nm.npy: ");
    let tif = |value| map("tif", "rate_nm_per_s", value, (61, 61));
    refused_after(tif(0.0), &[], &[rate, "no positive rate (largest 0 nm/s)", "check its sign"]);
    refused_after(tif(f64::NAN), &[], &[rate, "element [0, 0] is NaN; give finite values"]);
    let surface = |value| map("surface", "height_nm", value, (31, 51));
    refused_after(surface(f64::NAN), &[], &[height, "every pixel is NaN; give at least one"]);
    refused_after(surface(f64::INFINITY), &[], &[height, "element [0, 0] is inf"]);
    let turned = map("surface", "height_nm", 0.0, (51, 31));
    refused_after(turned, &[], &["surface/x_mm.npy: has shape [51]", "nx = 31 from height_nm"]);
    let swap = |dir: &Path| {
        fs::rename(dir.join("tif"), dir.join("t")).unwrap();
        fs::rename(dir.join("surface"), dir.join("tif")).unwrap();
        fs::rename(dir.join("t"), dir.join("surface")).unwrap();
    };
    refused_after(swap, &[], &["tif: holds a surface, needs a tif; check the order of the flags"]);
    refused_after(|d| fs::remove_dir_all(d.join("tif")).unwrap(), &[], &["tif: does not exist"]);
    refused_after(|_| (), &["--integral=direct", "--steps=0"], &["steps: is 0"]);
    refused_after(|_| (), &["--integral=exact"], &["invalid value 'exact'"]);
    refused_after(|_| (), &["--steps=-1"], &["invalid value '-1'"]);
}

/// Runs with the trajectory `t`. Returns the exit code, the verdict and warnings as printed, the directory of the
/// output, and the temporary one that holds it.
fn said_of(t: Trajectory, more: &[&str]) -> (i32, String, std::path::PathBuf, tempfile::TempDir) {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    write(tmp.path(), "trajectory", &t);
    let output = run_on("2", tmp.path(), more);
    let out = tmp.path().join("removal");
    (output.status.code().unwrap(), text(&output.stderr), out, tmp)
}

/// Returns the pass, moved by `x_mm` along x, with the tool on or off as given for its two segments.
fn moved_pass(x_mm: f64, tool_on: [bool; 2]) -> Trajectory {
    let pass = pass();
    let mut c = pass.coefficient_mm().to_vec();
    c.iter_mut().for_each(|c| c[0][0] += x_mm);
    Trajectory::new(pass.break_time_s().to_vec(), c, tool_on.to_vec(), vec![Some(0), None]).unwrap()
}

#[test]
fn a_motion_that_never_touches_the_map_is_a_negative_verdict() {
    let far = moved_pass(500.0, [true, false]);
    let process = r#"{"name":"p","errors":[{"kind":"offset_x","size":1,"unit":"um","distribution":"normal","note":""}]}"#;
    for more in [
        &[][..],
        &["--integral=direct"],
        &["--frames=3"],
        &["--error-budget=error_budget.json", "--measured-out=after"],
    ] {
        let tmp = tempfile::tempdir().unwrap();
        prepare(tmp.path());
        write(tmp.path(), "trajectory", &far);
        fs::write(tmp.path().join("error_budget.json"), process).unwrap();
        let output = run_on("2", tmp.path(), more);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{more:?}: {said}");
        let expected = "verdict: the tool never touches the map: with the tool on the motion is within x 480 .. 530 \
                        mm, y 2.53 .. 2.53 mm, and the map within x 0 .. 10 mm, y 0 .. 6 mm";
        assert!(said.contains(expected), "{said}");
        assert_eq!(outcome(tmp.path())["status"], "negative");
    }
    // What is predicted is still written: nothing is removed.
    let (_, _, out, _kept) = said_of(far, &[]);
    let removal = artifact::read::<Removal>(&out).unwrap().value;
    assert!(removal.removal_nm().iter().all(|r| *r == 0.0));
    let (code, said, ..) = said_of(moved_pass(0.0, [false, false]), &[]);
    assert_eq!(code, 1);
    assert!(
        said.contains("tool_on is 0 in every segment; is it inverted, or a dry run?"),
        "{said}"
    );
}

#[test]
fn a_motion_that_touches_little_of_the_map_is_named() {
    // The tool ends 4 mm before the map, and its TIF reaches 6 mm.
    let c = vec![[[-9.0, 1.0, 0.0, 0.0], [2.53, 0.0, 0.0, 0.0]], [[0.0; 4]; 2]];
    let t =
        Trajectory::new(vec![0.0, 5.0, 6.0], c, vec![true, false], vec![Some(0), None]).unwrap();
    let (code, said, out, _kept) = said_of(t, &[]);
    assert!(said.contains("warning: the tool removes material from ") && code != 2, "{said}");
    assert!(said.contains("it is on for 5 s of 6 s, within x -9 .. -4 mm"), "{said}");
    let text = fs::read_to_string(out.join("manifest.json")).unwrap();
    let coverage = serde_json::from_str::<Value>(&text).unwrap()["outcome"]["coverage"].clone();
    // Pixels that are less than 6 mm from a tool that ends at -4 mm: 10 of 51 columns.
    assert_eq!(coverage["touched_pixels"], json!(10 * 31));
    assert_eq!(coverage["valid_pixels"], json!(51 * 31 - 1));
    // A plan that removes all over the map says nothing.
    let (_, said, ..) = said_of(pass(), &[]);
    assert!(!said.contains("warning: "), "{said}");
}

#[test]
fn a_hard_edge_between_coarse_samples_is_named() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let a = axis(-1.2, 0.12, 21);
    let g = Grid { x: a, y: a };
    let pad = |(r, c): (usize, usize)| {
        if a.coordinate_mm(c).hypot(a.coordinate_mm(r)) <= 0.8 { 60.0 } else { 0.0 }
    };
    write(tmp.path(), "tif", &Tif::new(g, Array2::from_shape_fn(g.shape(), pad)).unwrap());
    let output = run_on("2", tmp.path(), &[]);
    let between = &outcome(tmp.path())["tif_between_samples"];
    let change = number(&between["residual_change"]);
    let named = text(&output.stderr).contains("warning: the TIF is sampled too coarsely");
    let error = number(&between["standard_error"]);
    // The thresholds of the warning.
    assert_eq!(named, change.abs() > 0.01 && change.abs() > 2.0 * error, "{between}");
    assert!(number(&between["difference_rms_nm"]) > 0.0 && number(&between["pixels"]) >= 64.0);
}

/// Tests a TIF whose size of 12 mm is given in nm.
#[test]
fn a_tif_in_the_wrong_unit_is_refused() {
    let huge = |dir: &Path| {
        let bare = bare(dir, "tif");
        for name in ["x_mm", "y_mm"] {
            let a = Array1::linspace(-6e6, 6e6, 61);
            save_array(&bare, name, ArrayData::F64(a.into_dyn().into()));
        }
    };
    refused_after(
        huge,
        &[],
        &["x_mm: of the TIF: it extends over", "a TIF in um? give both in mm"],
    );
}

#[test]
fn frames_end_with_the_removal_and_are_the_same_on_one_thread() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let removal = simulate(tmp.path(), &[]);
    let frames = |threads: &str, out: &str| {
        let output = run_on(threads, tmp.path(), &["--frames", "5", "--out", out]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert!(text(&output.stdout).contains("5 frames of 51 x 31 pixels"));
        ["time_s.npy", "removal_nm.npy", "x_mm.npy", "y_mm.npy", "manifest.json"]
            .map(|file| fs::read(tmp.path().join(out).join(file)).unwrap())
    };
    let found = frames("2", "frames");
    let read = |i: usize| match npy::parse(&found[i], Dtype::F64).unwrap() {
        ArrayData::F64(a) => a,
        other => panic!("{other:?}"),
    };
    assert_eq!(read(0).as_slice().unwrap(), [3.1, 6.2, 9.3, 12.4, 15.5]);
    let last = read(1).index_axis_move(ndarray::Axis(0), 4);
    // Sums of the same order 1 terms, the quadrature cut at other places.
    let off = |(a, b): (&f64, &f64)| (a - b).abs();
    assert!(last.iter().zip(removal.removal_nm()).map(off).fold(0.0, f64::max) < 1e-9);
    assert!(frames("1", "frames-1")[..4] == found[..4]);

    let refused = run_on("1", tmp.path(), &["--frames", "0", "--out", "none"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("frames: are 0; give 1 to 1000"));
    assert!(!tmp.path().join("none").exists());
}
