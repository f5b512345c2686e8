//! The virtual machine: what is hidden does what its equation says, and is drawn as the process states.

use std::{fs, path::Path};

use ndarray::Array2;
use planish_simulate::{
    SimulationSettings as Simulation,
    deviation::Deviation,
    error_budget::{ErrorBudget, ErrorBudgetFile, Scalar},
    runs::Runs,
    simulate,
    virtual_machine::{VirtualMachineSettings, VirtualRun, draw_run, measure, run},
};
use planish_testkit::program::{text, write};
use planish_types::{Axis, Grid, Surface, Tif, Trajectory, TrajectoryBuilder};
use serde_json::{Value, json};

const SIGMA_MM: f64 = 1.0;

fn before() -> Surface {
    let axis = |n| Axis::new(0.0, 0.25, n).unwrap();
    let grid = Grid { x: axis(49), y: axis(33) };
    let mut height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        30.0 + (0.4 * grid.x.coordinate_mm(c)).sin()
            + 0.05 * grid.x.coordinate_mm(c) * grid.y.coordinate_mm(r)
    });
    height[[5, 9]] = f64::NAN;
    Surface::new(grid, height).unwrap()
}

/// Makes a round TIF out to 6 sigma.
fn tif() -> Tif {
    let axis = Axis::new(-6.0, 0.125, 97).unwrap();
    let grid = Grid { x: axis, y: axis };
    let rate = |(r, c): (usize, usize)| {
        8.0 * (-(axis.coordinate_mm(c).powi(2) + axis.coordinate_mm(r).powi(2))
            / (2.0 * SIGMA_MM * SIGMA_MM))
            .exp()
    };
    Tif::new(grid, Array2::from_shape_fn(grid.shape(), rate)).unwrap()
}

/// Makes a raster of lines 1 mm apart whose feeds differ, displaced by `by_mm`.
fn raster(by_mm: [f64; 2]) -> Trajectory {
    let mut motion = TrajectoryBuilder::default();
    for line in 0..13 {
        let y = f64::from(line) - 2.0 + by_mm[1];
        let speed = 4.0 + f64::from(line % 3);
        let (from, way) = if line % 2 == 0 { (-3.0, 18.0) } else { (15.0, -18.0) };
        let h = 18.0 / speed;
        motion.push(h, [[from + by_mm[0], way / h, 0.0, 0.0], [y, 0.0, 0.0, 0.0]], true, None);
    }
    motion.build().unwrap()
}

fn error(kind: &str, size: f64, unit: &str, distribution: &str) -> Value {
    json!({ "kind": kind, "size": size, "unit": unit, "distribution": distribution, "note": "" })
}

fn process(errors: &[Value]) -> ErrorBudget {
    let file: ErrorBudgetFile =
        serde_json::from_value(json!({ "name": "test", "errors": errors })).unwrap();
    file.checked().unwrap()
}

fn of(errors: &[Value], seed: u64) -> VirtualRun {
    let settings = VirtualMachineSettings { seed, run: 1, known: false, tif_as_sampled: true };
    run(&raster([0.0; 2]), &tif(), &before(), &process(errors), &settings).unwrap()
}

fn removal(trajectory: &Trajectory) -> Array2<f64> {
    let found = simulate(trajectory, &tif(), &before(), Simulation::Gridded).unwrap();
    found.removal.removal_nm().clone()
}

/// Returns the largest difference over the pixels that are valid in both maps.
fn apart(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).filter(|d| !d.is_nan()).fold(0.0, f64::max)
}

#[test]
fn without_errors_the_map_after_is_the_map_before_less_the_removal() {
    let found = of(&[error("rate_scale", 0.0, "%", "normal")], 3);
    let expected = before().height_nm() - &removal(&raster([0.0; 2]));
    assert!(apart(found.measured.height_nm(), &expected) == 0.0);
    assert!(found.measured.height_nm()[[5, 9]].is_nan());
}

#[test]
fn a_rate_and_a_displacement_do_what_they_say() {
    // 5 % more rate removes 5 % more: sums of some thousand terms, relative to 20 nm.
    let rate = of(&[error("rate_scale", 5.0, "%", "fixed")], 3);
    let plan = removal(&raster([0.0; 2]));
    assert!(apart(rate.removal.removal_nm(), &(1.05 * &plan)) < 1e-9);
    assert_eq!(rate.hidden.truth.rate_scale, 0.05);
    // The tool 0.1 mm further along x and -0.2 mm along y is another trajectory.
    let errors =
        [error("offset_x", 100.0, "um", "fixed"), error("tif_offset_y", -0.2, "mm", "fixed")];
    let moved = of(&errors, 3);
    // As above.
    assert!(apart(moved.removal.removal_nm(), &removal(&raster([0.1, -0.2]))) < 1e-9);
    assert!(apart(moved.removal.removal_nm(), &removal(&raster([-0.1, 0.2]))) > 0.1);
    // Rounding.
    assert!((moved.hidden.truth.offset_y_mm + 0.2).abs() < 1e-15);
}

#[test]
fn an_error_moves_the_tool_by_less_than_the_tif_is_wide_wherever_it_removes() {
    // 12 mm wide; its samples beside the tool reach 20 mm from it.
    let grid = tif().grid().moved([14.0, 0.0]).unwrap();
    let beside = Tif::new(grid, tif().rate_nm_per_s().clone()).unwrap();
    let settings = VirtualMachineSettings { seed: 1, run: 1, known: false, tif_as_sampled: true };
    let moved_by = |mm: f64| {
        let errors = [error("offset_y", mm, "mm", "normal")];
        run(&raster([0.0; 2]), &beside, &before(), &process(&errors), &settings)
    };
    assert!(moved_by(11.9).is_ok());
    let message = moved_by(12.1).unwrap_err().to_string();
    assert!(message.contains("the TIF is 12 mm wide"), "{message}");
}

#[test]
fn errors_are_drawn_as_the_process_states_and_anew_for_every_seed() {
    let errors =
        [error("rate_scale", 2.0, "%", "normal"), error("offset_x", 50.0, "um", "uniform")];
    let (tif, before) = (tif(), before());
    let prepared = Runs::new(&raster([0.0; 2]), &tif, &tif, before.grid()).unwrap();
    let draw = |seed| draw_run(&prepared, &before, &process(&errors), seed, 1).unwrap();
    let runs: Vec<VirtualRun> = (0..100).map(draw).collect();
    let square = |of: &dyn Fn(&VirtualRun) -> f64| {
        runs.iter().map(|r| of(r).powi(2)).sum::<f64>() / runs.len() as f64
    };
    // The mean square of 100 normal numbers scatters by sqrt(2 / 100) = 14 %, of uniform ones by 9 %: three of each.
    let rate = square(&|r| r.hidden.truth.rate_scale / 0.02);
    let offset = square(&|r| r.hidden.truth.offset_x_mm / 0.05) * 3.0;
    assert!((rate - 1.0).abs() < 0.42 && (offset - 1.0).abs() < 0.27, "{rate} {offset}");
    let again = of(&errors, 7);
    assert_eq!(again.hidden, runs[7].hidden);
    // Numbers of their own: an error added at the end changes none of the others.
    let more = of(&[&errors[..], &[error("rotation", 1.0, "mrad", "normal")]].concat(), 7);
    assert_eq!(more.hidden.errors[..2], again.hidden.errors[..]);
}

#[test]
fn both_measurements_have_noise_of_their_own() {
    let noisy = of(&[error("map_noise", 0.3, "nm", "normal")], 5);
    let valid = |map: &Array2<f64>| map.iter().copied().filter(|v| !v.is_nan()).collect::<Vec<_>>();
    let plan = removal(&raster([0.0; 2]));
    let true_before = noisy.removal.residual().height_nm() + &plan;
    let m_1 = valid(&(&true_before - before().height_nm()));
    let m_2 = valid(&(noisy.removal.residual().height_nm() - noisy.measured.height_nm()));
    let dot =
        |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / a.len() as f64;
    // 1616 pixels: a variance scatters by sqrt(2 / 1616) = 3.5 %, a correlation by 2.5 %; three of each.
    for m in [&m_1, &m_2] {
        assert!((dot(m, m) / 0.09 - 1.0).abs() < 0.11);
    }
    assert!((dot(&m_1, &m_2) / 0.09).abs() < 0.075);
}

/// A mirror is measured, runs, is measured, runs again: what is on it goes on from run to run, and every error of one
/// number is that of the machine.
#[test]
fn the_runs_of_one_machine_follow_each_other() {
    let errors = process(&[
        error("rate_scale", 2.0, "%", "normal"),
        error("map_noise", 0.3, "nm", "normal"),
        with_correlation(error("rate_noise", 1.0, "%", "normal"), 2.0),
        with_degree(error("map_low_order", 0.2, "nm", "normal"), 2),
    ]);
    let mirror = before();
    let ran = |map: &Surface, run_: u64, known: bool| {
        let settings = VirtualMachineSettings { seed: 11, run: run_, known, tif_as_sampled: true };
        run(&raster([0.0; 2]), &tif(), map, &errors, &settings).unwrap()
    };
    let measured = measure(&mirror, &errors, 11, 1).unwrap();
    let difference = measured.height_nm() - mirror.height_nm();
    let values: Vec<f64> = difference.iter().copied().filter(|v| !v.is_nan()).collect();
    let square = values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64;
    // 0.3^2 + 0.2^2 times the mean of five squares, which scatters by sqrt(2 / 5): at most three of it.
    assert!((0.08..0.21).contains(&square), "{square}");
    let first = ran(&measured, 1, false);
    let second = ran(&first.measured, 2, false);
    let true_before =
        |run: &VirtualRun| run.removal.residual().height_nm() + run.removal.removal_nm();
    // Sums of a few numbers of 30 nm, to rounding.
    assert!(apart(&true_before(&first), mirror.height_nm()) < 1e-12);
    // As above.
    assert!(apart(&true_before(&second), first.removal.residual().height_nm()) < 1e-12);
    assert_eq!(first.hidden, second.hidden);
    // The rate fluctuates anew, and the errors of the three measurements are three.
    assert!(apart(first.removal.removal_nm(), second.removal.removal_nm()) > 0.01);
    let wrong = |run: &VirtualRun| run.removal.residual().height_nm() - run.measured.height_nm();
    assert!(apart(&wrong(&first), &-&difference) > 0.5);
    assert!(apart(&wrong(&first), &wrong(&second)) > 0.5);
    // Another mirror before the second run has the error of its own measurement.
    let other = measure(&mirror, &errors, 11, 2).unwrap();
    // As above.
    assert!(apart(&true_before(&ran(&other, 2, false)), mirror.height_nm()) < 1e-12);
    // A tool that is known has the noise of the run, and nothing of the rate.
    let known = ran(&measured, 1, true);
    assert_eq!((known.hidden.truth.rate_scale, known.hidden.errors[0].value), (0.0, Some(0.0)));
    let rate = 1.0 + first.hidden.truth.rate_scale;
    let plan = removal(&raster([0.0; 2]));
    // (rate + noise) M: the noise acts on the rate of the plan.
    let expected = first.removal.removal_nm() - &((rate - 1.0) * &plan);
    // Sums of some thousand terms of 20 nm.
    assert!(apart(known.removal.removal_nm(), &expected) < 1e-9);
    let none = VirtualMachineSettings { seed: 11, run: 0, known: false, tif_as_sampled: true };
    let said = run(&raster([0.0; 2]), &tif(), &mirror, &errors, &none).unwrap_err().to_string();
    assert!(said.contains("run: is 0; give 1 to 1000000"), "{said}");
}

fn with_correlation(mut error: Value, seconds: f64) -> Value {
    error["correlation_s"] = json!(seconds);
    error
}

fn with_degree(mut error: Value, degree: usize) -> Value {
    error["degree"] = json!(degree);
    error
}

/// A beam with half of its current removes half, also where other errors act.
#[test]
fn a_current_is_a_factor_of_every_rate() {
    let half = raster([0.0; 2]).with_rate_factor(vec![0.5; 13]).unwrap();
    let errors =
        process(&[error("rate_scale", 4.0, "%", "fixed"), error("offset_x", 0.1, "mm", "fixed")]);
    let settings = VirtualMachineSettings { seed: 1, run: 1, known: false, tif_as_sampled: true };
    let ran = |motion: &Trajectory| {
        run(motion, &tif(), &before(), &errors, &settings).unwrap().removal.removal_nm().clone()
    };
    // Below: sums of some thousand terms of 20 nm.
    assert!(apart(&(2.0 * ran(&half)), &ran(&raster([0.0; 2]))) < 1e-9);
    assert!(apart(&ran(&half), &(0.52 * removal(&raster([0.1, 0.0])))) < 1e-9);
}

/// A round TIF stretched along the diagonal, by its own equation and by the turned stretch along x.
#[test]
fn another_shape_of_a_tool_that_is_off_centre_stays_where_it_removes() {
    // 3 mm and -2 mm beside the tool, which stands as much on the other side: the same machine, referred to another point.
    let off = [3.0, -2.0];
    let beside = Tif::new(tif().grid().moved(off).unwrap(), tif().rate_nm_per_s().clone()).unwrap();
    let map = before();
    let on = |tif: &Tif, trajectory: &Trajectory, scalar: Scalar, size: f64| {
        let runs = Runs::new(trajectory, tif, tif, map.grid()).unwrap();
        let mut change = Deviation::default();
        // An ellipse, so that a rotation shows.
        change.add(Scalar::TifEllipticity, 0.3);
        change.add(scalar, size);
        runs.moved_nm(&change).unwrap()
    };
    for scalar in [Scalar::TifWidth, Scalar::TifDiagonalEllipticity, Scalar::TifRotation] {
        let centred = on(&tif(), &raster([0.0; 2]), scalar, 0.1);
        let found = on(&beside, &raster(off.map(|mm| -mm)), scalar, 0.1);
        let plain = on(&tif(), &raster([0.0; 2]), scalar, 0.0);
        let change = apart(&centred, &plain);
        let apart = apart(&centred, &found);
        println!("{scalar:?} changes {change:.1e} nm, and is apart by {apart:.1e} nm");
        // Rounding of the coordinates of tens of nm, beside what the shape changes under lines as close as these.
        assert!(change > 1e-3 && apart < 1e-9, "{scalar:?}: {change} {apart}");
    }
}

#[test]
fn a_diagonal_ellipticity_is_one_along_x_turned_by_45_degrees() {
    let mut diagonal = Deviation::default();
    diagonal.add(Scalar::TifDiagonalEllipticity, 0.1);
    diagonal.add(Scalar::TifWidth, 0.03);
    let mut turned = Deviation::default();
    turned.add(Scalar::TifEllipticity, 0.1);
    turned.add(Scalar::TifWidth, 0.03);
    turned.add(Scalar::TifRotation, std::f64::consts::FRAC_PI_4);
    let tif = tif();
    let [diagonal, turned] = [diagonal, turned].map(|d| d.tif(&tif).unwrap().unwrap());
    // Keys' convolution of a Gaussian of eight samples per sigma errs by 1e-4 of its peak.
    let difference = apart(diagonal.rate_nm_per_s(), turned.rate_nm_per_s());
    assert!(difference < 2e-4 * 8.0, "{difference}");
    // It is longer from lower left to upper right.
    let at = |x: f64, y: f64| diagonal.rate_at(x, y);
    // Regression bound: a factor of 1.21 was seen.
    assert!(at(1.0, 1.0) > 1.1 * at(1.0, -1.0));
    // The volume is kept by construction: rounding.
    assert!((diagonal.vrr_nm_mm2_per_s() / tif.vrr_nm_mm2_per_s() - 1.0).abs() < 1e-12);
}

fn program(threads: &str, dir: &Path, more: &[&str]) -> std::process::Output {
    let errors = [error("rate_scale", 2.0, "%", "normal"), error("map_noise", 0.1, "nm", "normal")];
    let file = json!({ "name": "test", "errors": errors });
    fs::write(dir.join("error_budget.json"), file.to_string()).unwrap();
    planish_testkit::program::stage("planish-simulate")
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", threads)
        .args(["--trajectory", "trajectory", "--tif", "tif", "--surface", "surface"])
        .args(more)
        .output()
        .unwrap()
}

#[test]
fn the_program_hides_the_truth_from_the_reader_of_the_map() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "trajectory", &raster([0.0; 2]));
    write(dir, "tif", &tif());
    write(dir, "surface", &before());
    let out = |k: &str| [format!("after{k}"), format!("truth{k}")];
    for (threads, k) in [("1", "1"), ("2", "2")] {
        let [after, truth] = out(k);
        let flags = [
            "--error-budget",
            "error_budget.json",
            "--seed",
            "9",
            "--measured-out",
            &after,
            "--out",
            &truth,
        ];
        let ended = program(threads, dir, &flags);
        assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    }
    for file in ["after1/height_nm.npy", "truth1/removal_nm.npy", "truth1/residual_nm.npy"] {
        let other = file.replace('1', "2");
        assert!(fs::read(dir.join(file)).unwrap() == fs::read(dir.join(other)).unwrap(), "{file}");
    }
    let manifest = |name: &str| -> Value {
        let text = fs::read_to_string(dir.join(name).join("manifest.json")).unwrap();
        serde_json::from_str(&text).unwrap()
    };
    let (after, truth) = (manifest("after1"), manifest("truth1"));
    assert_eq!(after["settings"]["seed"], 9);
    assert!(!after.to_string().contains("hidden"), "{after}");
    assert!(truth["outcome"]["hidden"]["truth"]["rate_scale"].as_f64().unwrap() != 0.0);
}

#[test]
fn what_is_no_run_is_refused_and_writes_nothing() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "trajectory", &raster([0.0; 2]));
    write(dir, "tif", &tif());
    write(dir, "surface", &before());
    let both = ["--error-budget", "error_budget.json", "--measured-out", "after", "--out", "truth"];
    for (flags, said) in [
        (&both[..2], "--measured-out"),
        (&["--measured-out", "after", "--out", "truth"], "--error-budget"),
        (&[&both[..], &["--frames", "3"]].concat(), "--frames"),
        (
            &["--error-budget", "none.json", "--measured-out", "after", "--out", "truth"],
            "none.json",
        ),
        (
            &[
                "--error-budget",
                "error_budget.json",
                "--measured-out",
                "truth/in",
                "--out",
                "truth",
            ],
            "--measured-out",
        ),
    ] {
        let ended = program("2", dir, flags);
        let stderr = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(2), "{stderr}");
        assert!(stderr.contains(said), "{said}: {stderr}");
        assert!(!dir.join("after").exists() && !dir.join("truth").exists(), "{stderr}");
    }
}
