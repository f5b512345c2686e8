//! The quadratic of the dwell times against the table, which is found from simulations, and against itself.

use crate::example::{desired, error, process, raster, tif, with};
use planish_simulate::{SimulationSettings as Simulation, simulate};
use planish_tolerance::{Free, ToleranceSettings, quadratic::Sources, tolerance};
use planish_types::{Removal, Surface, Trajectory, TrajectoryBuilder};
use serde_json::{Value, json};

/// Returns one error of every kind whose effect the dwell times decide.
fn decided() -> Vec<Value> {
    vec![
        error("rate_scale", 1.0, "%", "normal"),
        error("rate_drift", 5.0, "%", "uniform"),
        with(error("rate_warm_up", 2.0, "%", "normal"), "time_constant_s", 30.0),
        with(error("rate_noise", 1.0, "%", "normal"), "correlation_s", 5.0),
        with(error("rate_noise", 1.0, "%", "normal"), "correlation_s", 0.05),
        error("offset_x", 10.0, "um", "normal"),
        error("offset_y", 0.01, "mm", "uniform"),
        error("rotation", 0.01, "deg", "normal"),
        error("magnification", 0.05, "%", "normal"),
        error("shear", 0.05, "%", "normal"),
        error("tif_width", 1.0, "%", "normal"),
        error("tif_ellipticity", 1.0, "%", "normal"),
        error("tif_offset_x", 10.0, "um", "normal"),
        error("position_noise", 5.0, "um", "normal"),
    ]
}

fn sources(errors: &Value) -> Sources {
    let process = process(&json!({ "name": "test", "errors": errors })).unwrap();
    Sources::new(&desired(), &tif(), &process, Free::Piston).unwrap()
}

/// Makes the raster with its dwell times times a factor that differs from point to point.
fn other() -> Trajectory {
    let mut motion = TrajectoryBuilder::default();
    for segment in raster().segments() {
        let j = motion.len();
        let by = 1.0 + 0.5 * (0.7 * j as f64).sin();
        let c = segment.coefficient_mm.map(|c| [c[0], c[1] / by, 0.0, 0.0]);
        let on = segment.dwell_index.is_some();
        let (h, c) = if on {
            (by * segment.duration_s, c)
        } else {
            (segment.duration_s, *segment.coefficient_mm)
        };
        motion.push(h, c, true, segment.dwell_index);
    }
    motion.build().unwrap()
}

fn times(motion: &Trajectory) -> Vec<f64> {
    motion.served_s(motion.len(), |_| true).unwrap()
}

/// RMS that an error adds, nm, by the table, from simulations of the motion.
fn adds(motion: &Trajectory, error: &Value) -> f64 {
    let process = process(&json!({ "name": "test", "errors": [error] })).unwrap();
    let settings =
        ToleranceSettings { draws: 100, simulated_runs: 0, ..ToleranceSettings::default() };
    let found = tolerance(motion, &tif(), &desired(), &process, &settings).unwrap();
    assert!(!found.outcome.errors[0].simulated);
    found.outcome.errors[0].adds_rms_nm
}

#[test]
fn every_error_adds_what_its_line_says() {
    let motion = raster();
    for error in decided() {
        let sources = sources(&json!([error]));
        assert_eq!((sources.included.len(), sources.left_out.len()), (1, 0));
        let found =
            sources.quadratic(&motion, motion.len()).unwrap().variance_nm2(&times(&motion)).sqrt();
        let line = adds(&motion, &error);
        println!("{} {found:.5} nm, {line:.5} nm", error["kind"]);
        // The cells at the border of the map err by 1/216 of what lies there (`inner`), and Keys' convolution of
        // the sampled derivatives of this TIF, whose width is four samples, by 1 %.
        assert!((found / line - 1.0).abs() < 0.01, "{}: {found} {line}", error["kind"]);
    }
}

/// Along lines of constant feed nothing changes with x, and a diagonal ellipticity adds nothing: it needs times that
/// differ from point to point.
#[test]
fn a_diagonal_ellipticity_adds_what_its_line_says() {
    let error = error("tif_diagonal_ellipticity", 1.0, "%", "normal");
    let motion = other();
    let quadratic = sources(&json!([error]));
    let found = quadratic.quadratic(&motion, motion.len()).unwrap();
    let found = found.variance_nm2(&times(&motion)).sqrt();
    let line = adds(&motion, &error);
    // The bound of the other times below: their ripple is not smooth on the cells.
    assert!(line > 1e-3 && (found / line - 1.0).abs() < 0.02, "{found} {line}");
}

/// Q of one motion holds for other times along the same path, where the errors do not depend on the time.
#[test]
fn other_dwell_times_add_what_their_own_motion_says() {
    let (motion, other) = (raster(), other());
    let (from, to) = (times(&motion), times(&other));
    for error in decided() {
        let kind = error["kind"].as_str().unwrap();
        if ["rate_drift", "rate_warm_up", "rate_noise"].contains(&kind) {
            continue;
        }
        let sources = sources(&json!([error]));
        let quadratic = sources.quadratic(&motion, motion.len()).unwrap();
        let [before, after] = [&from, &to].map(|t| quadratic.variance_nm2(t).sqrt());
        let line = adds(&other, &error);
        // The times matter, or there is no test. Their ripple from line to line is not smooth on the cells: regression
        // bound, 1.4 % is what was found.
        assert!((after / before - 1.0).abs() > 0.02, "{kind}: {before} {after}");
        assert!((after / line - 1.0).abs() < 0.02, "{kind}: {after} {line}");
    }
}

#[test]
fn products_are_those_of_a_symmetric_positive_semidefinite_matrix() {
    let motion = raster();
    let sources = sources(&json!(decided()));
    let quadratic = sources.quadratic(&motion, motion.len()).unwrap();
    let wave = |of: f64| -> Vec<f64> {
        times(&motion).iter().enumerate().map(|(j, t)| t * (of * j as f64).sin()).collect()
    };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let (u, v) = (wave(0.3), wave(1.9));
    let (of_u, of_v) = (quadratic.product(&u), quadratic.product(&v));
    let largest = (dot(&u, &of_u) * dot(&v, &of_v)).sqrt();
    // Sums of some 1e4 terms.
    assert!((dot(&u, &of_v) - dot(&v, &of_u)).abs() < 1e-12 * largest);
    assert!(dot(&u, &of_u) > 0.0 && dot(&v, &of_v) > 0.0);
    // What they have in common is less than the larger of both (Cauchy and Schwarz).
    assert!(dot(&u, &of_v).abs() < largest);
}

#[test]
fn fixed_errors_are_a_bias_and_what_the_times_do_not_decide_is_left_out() {
    let motion = raster();
    let constant = json!([
        error("timing_jitter", 2.0, "ms", "normal"),
        error("timing_tick", 2.0, "ms", "uniform"),
        error("velocity_lag", 5.0, "ms", "normal"),
        error("backlash", 10.0, "um", "uniform"),
        error("map_noise", 0.1, "nm", "normal"),
        error("rate_scale", 0.0, "%", "normal"),
    ]);
    let nothing = sources(&constant);
    let names = ["timing_jitter", "timing_tick", "velocity_lag", "backlash", "map_noise"];
    assert!(nothing.is_empty() && nothing.left_out == names);
    assert_eq!(
        nothing.quadratic(&motion, motion.len()).unwrap().variance_nm2(&times(&motion)),
        0.0
    );

    // A rate that is 2 % larger removes 2 % more; what is smoothed of the TIF is less than 1 % of its removal.
    let fixed = sources(&json!([error("rate_scale", 2.0, "%", "fixed")]));
    let quadratic = fixed.quadratic(&motion, motion.len()).unwrap();
    assert_eq!(quadratic.variance_nm2(&times(&motion)), 0.0);
    let bias = quadratic.bias_nm.unwrap();
    let executed = simulate(&motion, &tif(), &desired(), Simulation::Gridded).unwrap().removal;
    for (more, removal) in bias.iter().zip(executed.removal_nm()) {
        assert!((more - 0.02 * removal).abs() < 0.02 * 0.01 * removal, "{more} {removal}");
    }
    // The residual of a flat map with the same pixels is minus the bias, where it counts.
    let flat = Surface::new(*desired().grid(), desired().height_nm() * 0.0).unwrap();
    let square = Removal::new(&flat, bias).unwrap().residual().statistics().rms;
    let scatters = error("rate_scale", 2.0, "%", "normal");
    let line = adds(&motion, &scatters);
    // Both are simulations of the same motion.
    assert!((square / line - 1.0).abs() < 1e-6, "{square} {line}");
}
