//! A small plan: a raster of twelve lines, each in pieces of its own feed, over a map with a round corner.

use ndarray::Array2;
use planish_tolerance::{
    Tolerance,
    error_budget::{ErrorBudget, ErrorBudgetFile},
};
use planish_types::{Axis, Grid, Surface, Tif, Trajectory, TrajectoryBuilder};
use serde_json::{Value, json};

/// Makes a map of 20 x 12 mm in pixels of 0.25 mm.
pub fn desired() -> Surface {
    let axis = |n| Axis::new(0.0, 0.25, n).unwrap();
    let grid = Grid { x: axis(81), y: axis(49) };
    let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
        let cut = x + y > 28.0;
        if cut {
            f64::NAN
        } else {
            20.0 + 4.0 * (0.4 * x).sin() + 3.0 * (0.5 * y).cos() + 0.05 * x * y
        }
    });
    Surface::new(grid, height).unwrap()
}

/// Makes a Gaussian TIF with a standard deviation of 1 mm, out to 5 mm.
#[allow(dead_code)] // the tests of a tool that varies have one of their own
pub fn tif() -> Tif {
    let axis = Axis::new(-5.0, 0.25, 41).unwrap();
    let grid = Grid { x: axis, y: axis };
    let rate = |(r, c): (usize, usize)| {
        let (x, y): (f64, f64) = (axis.coordinate_mm(c), axis.coordinate_mm(r));
        8.0 * (-(x * x + y * y) / 2.0).exp()
    };
    Tif::new(grid, Array2::from_shape_fn(grid.shape(), rate)).unwrap()
}

/// Makes lines 1 mm apart from 4 mm before the map to 4 mm beyond, in pieces of 1 mm whose time follows the map.
pub fn raster() -> Trajectory {
    let mut motion = TrajectoryBuilder::default();
    for line in 0..19 {
        let y = f64::from(line) - 3.0;
        for k in 0..28 {
            let (from, to) = if line % 2 == 0 { (k, k + 1) } else { (28 - k, 27 - k) };
            let (from, to) = (f64::from(from) - 4.0, f64::from(to) - 4.0);
            let x = 0.5 * (from + to);
            let height = 20.0 + 4.0 * (0.4 * x).sin() + 3.0 * (0.5 * y).cos() + 0.05 * x * y;
            // Height times the area of the piece over the volumetric removal rate 2 pi 8
            let h = (height / 50.3).max(0.05);
            let index = Some(motion.len());
            motion.push(h, [[from, (to - from) / h, 0.0, 0.0], [y, 0.0, 0.0, 0.0]], true, index);
        }
        // Beyond the map, to the next line.
        let x = if line % 2 == 0 { 24.0 } else { -4.0 };
        motion.push(0.2, [[x, 0.0, 0.0, 0.0], [y, 5.0, 0.0, 0.0]], true, None);
    }
    motion.build().unwrap()
}

/// Reads and checks a process from the JSON of its file; returns the message of an error as text.
#[allow(dead_code)] // the tests of the program write the file
pub fn process(file: &Value) -> Result<ErrorBudget, String> {
    let file: ErrorBudgetFile = serde_json::from_value(file.clone()).map_err(|e| e.to_string())?;
    file.checked().map_err(|e| e.to_string())
}

/// Makes the JSON of one error of a process.
#[allow(dead_code)] // the tests of the program write the file
pub fn error(kind: &str, size: f64, unit: &str, distribution: &str) -> Value {
    json!({ "kind": kind, "size": size, "unit": unit, "distribution": distribution, "note": "" })
}

/// Returns the JSON of an error with a setting of its kind added.
#[allow(dead_code)] // the tests of the program write the file
pub fn with(mut error: Value, setting: &str, value: f64) -> Value {
    error[setting] = if setting == "degree" { json!(value as usize) } else { json!(value) };
    error
}

/// Returns the RMS of a difference of maps over the valid pixels of [`desired`], about its mean.
#[allow(dead_code)] // for the tests that simulate an error themselves
pub fn rms(difference: Array2<f64>) -> f64 {
    let valid = desired().height_nm().mapv(|z| !z.is_nan());
    let values: Vec<f64> =
        difference.iter().zip(&valid).filter(|(_, v)| **v).map(|(d, _)| *d).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}

/// Returns one error of every kind of noise, each large enough to be seen in a hundred runs.
#[allow(dead_code)] // for the tests of noise
pub fn noises() -> [Value; 4] {
    [
        with(error("rate_noise", 2.0, "%", "normal"), "correlation_s", 3.0),
        error("position_noise", 50.0, "um", "normal"),
        error("timing_jitter", 10.0, "ms", "normal"),
        error("timing_tick", 20.0, "ms", "uniform"),
    ]
}

/// Asserts that the mean square over the simulated runs of one noise is that of its line.
#[allow(dead_code)] // for the tests of noise
pub fn assert_line_is_mean_over_runs(found: &Tolerance) {
    let (line, runs) = (&found.outcome.errors[0], found.runs.len() as f64);
    let squares: Vec<f64> = found.runs.iter().map(|r| r.simulated_rms_nm.powi(2)).collect();
    let mean = squares.iter().sum::<f64>() / runs;
    let added = mean - found.outcome.nominal_rms_nm.powi(2);
    let spread = (squares.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / runs).sqrt();
    // Four standard errors of the mean, and 3 % for the first order and the cells.
    let bound = 4.0 * spread / runs.sqrt() + 0.03 * line.adds_rms_nm.powi(2);
    let error = (added - line.adds_rms_nm.powi(2)).abs();
    println!("{:<16} {added:.6} {:.6} nm^2", line.kind, line.adds_rms_nm.powi(2));
    assert!(error < bound, "{}: {added} {}", line.kind, line.adds_rms_nm.powi(2));
}
