//! Residuals that an imperfect process adds, on the reference mirror, if `PLANISH_REFERENCE` names its
//! folder.

use planish_schedule::pvt;
use planish_testkit::{ion_beam, mirror::mirror};
use planish_tolerance::{
    Free, Tolerance, ToleranceSettings, error_budget::ErrorBudgetFile, tolerance,
};
use planish_toolpath::{PassesSettings, passes};
use planish_types::{DwellTime, Surface, Tif, ToolPath, Trajectory};
use serde_json::{Value, json};

fn motion(path: &ToolPath, dwell: &DwellTime) -> Trajectory {
    let how = pvt::PvtSettings::new(pvt::Mode::Monotone);
    pvt::schedule(path, dwell, &ion_beam(), &how).unwrap().trajectory
}

fn of(
    motion: &Trajectory,
    tif: &Tif,
    desired: &Surface,
    errors: Value,
    settings: &ToleranceSettings,
) -> Tolerance {
    let file: ErrorBudgetFile =
        serde_json::from_value(json!({ "name": "reference", "errors": errors })).unwrap();
    tolerance(motion, tif, desired, &file.checked().unwrap(), settings).unwrap()
}

fn error(kind: &str, size: f64, unit: &str) -> Value {
    json!({ "kind": kind, "size": size, "unit": unit, "distribution": "normal", "note": "" })
}

/// The published dwell times moved to the points where each pass has its half.
fn halves(dwell: &DwellTime) -> DwellTime {
    let there = dwell.dwell_s().iter().map(|t| 0.5 * t);
    DwellTime::new(there.clone().chain(there.rev()).collect()).unwrap()
}

/// Residuals that single errors add to the published plans, nm RMS without the best plane, on the raster
/// and on the maze. The expected values were computed independently of this program (NumPy): dwell times at
/// the dwell points, with the error in them, convolved with the bilinear TIF. The noise of the rate is one
/// draw there.
#[test]
fn single_errors_add_what_was_found_independently() {
    let Some(mirror) = mirror() else { return };
    let mut noise = error("rate_noise", 1.0, "%");
    noise["correlation_s"] = json!(20.0);
    let errors = json!([
        error("rate_scale", 1.0, "%"),
        error("rate_drift", 5.0, "%"),
        error("position_noise", 10.0, "um"),
        error("timing_jitter", 1.0, "ms"),
        error("magnification", 0.5, "%"),
        noise,
    ]);
    // Relative bounds. The scale is that of the map. The executed motion leaves the dwell points by tenths
    // of the width of the TIF, which changes the effect of a drift and of a displacement. A draw of the
    // noise has some ten degrees of freedom.
    let expected = [
        ("raster", [0.063, 0.055, 0.029, 0.022, 0.117, 0.13]),
        ("maze", [0.063, 0.200, 0.029, 0.022, 0.117, 0.16]),
    ];
    let bounds = [0.01, 0.2, 0.2, 0.2, 0.2, 0.4];
    let settings = ToleranceSettings {
        free: Free::Plane,
        draws: 1000,
        simulated_runs: 2,
        ..ToleranceSettings::default()
    };
    for (name, expected) in expected {
        let motion = motion(&mirror.path(name), &mirror.dwell(name));
        let found = of(&motion, &mirror.tif, &mirror.desired, errors.clone(), &settings);
        for ((line, expected), bound) in found.outcome.errors.iter().zip(expected).zip(bounds) {
            let ratio = line.adds_rms_nm / expected;
            println!("{name} {} {:.4} nm, {expected} nm", line.kind, line.adds_rms_nm);
            assert!((ratio - 1.0).abs() < bound, "{name} {}: {ratio}", line.kind);
        }
    }
}

/// At 1 % of the rate, 50 um, 2 ms and 0.01 degree, the first-order residual is within 2 % of the one that
/// a simulated run adds. The line and the departure from it are at right angles or less.
#[test]
fn small_errors_are_of_first_order() {
    let Some(mirror) = mirror() else { return };
    let errors = json!([
        error("rate_scale", 1.0, "%"),
        error("offset_x", 50.0, "um"),
        error("offset_y", 50.0, "um"),
        error("timing_jitter", 2.0, "ms"),
        error("rotation", 0.01, "deg"),
    ]);
    let settings =
        ToleranceSettings { draws: 1000, simulated_runs: 20, ..ToleranceSettings::default() };
    for name in ["raster", "maze"] {
        let motion = motion(&mirror.path(name), &mirror.dwell(name));
        let found = of(&motion, &mirror.tif, &mirror.desired, errors.clone(), &settings);
        assert!(
            !found.outcome.simulated && found.largest_difference < 0.02,
            "{}",
            found.largest_difference
        );
        for line in &found.outcome.errors {
            let apart = line.departs_by_rms_nm / line.adds_rms_nm;
            println!("{name} {}: departs by {:.2} %", line.kind, 100.0 * apart);
            // A second order at right angles to the first adds apart^2 / 2 of its RMS.
            assert!(0.5 * apart * apart < 0.02, "{name} {}: {apart}", line.kind);
        }
    }
}

/// Two passes there and back: a linear drift of 5 % adds less than 0.005 nm, whatever the path.
#[test]
fn a_linear_drift_cancels_between_two_passes() {
    let Some(mirror) = mirror() else { return };
    let settings =
        ToleranceSettings { draws: 1000, simulated_runs: 1, ..ToleranceSettings::default() };
    for name in ["raster", "maze"] {
        let (path, dwell) = (mirror.path(name), mirror.dwell(name));
        let twice = passes(&path, &PassesSettings { passes: 2, back: true }).unwrap();
        let adds = |motion: &Trajectory| {
            let drift = json!([error("rate_drift", 5.0, "%")]);
            of(motion, &mirror.tif, &mirror.desired, drift, &settings).outcome.errors[0].adds_rms_nm
        };
        let (once, twice) = (adds(&motion(&path, &dwell)), adds(&motion(&twice, &halves(&dwell))));
        println!("{name}: {once:.4} nm once, {twice:.6} nm there and back");
        assert!(once > 0.1 && twice <= 0.005, "{name}: {once} {twice}");
    }
}
