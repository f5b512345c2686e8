//! The solvers on the reference mirror (T. Wang et al., J. Manuf. Process. 2023,
//! doi 10.1016/j.jmapro.2023.01.005) with its published paths and dwell times.
//!
//! `PLANISH_REFERENCE` names the folder that holds `nsls2-mirror/`; without it the tests say so and
//! pass.

use std::path::{Path, PathBuf};

use ndarray::{ArrayD, Ix2};
use planish_dwell::{
    bounded_least_squares::Bound,
    columns::Columns,
    lucy_richardson, non_negative_least_squares,
    problem::Problem,
    udo::{self, Floor},
};
use planish_handoff::{
    kind::Dtype,
    npy::{self, ArrayData},
};
use planish_types::{Axis, End, Grid, Surface, Tif, ToolPath};

struct Mirror {
    dir: PathBuf,
    desired: Surface,
    tif: Tif,
}

fn mirror() -> Option<Mirror> {
    let Some(reference) = std::env::var_os("PLANISH_REFERENCE") else {
        println!("skipped: PLANISH_REFERENCE is not set");
        return None;
    };
    let dir = Path::new(&reference).join("nsls2-mirror");
    let map = |name: &str| load(&dir, name).into_dimensionality::<Ix2>().unwrap();
    let desired = Surface::new(grid(&dir, ""), map("height_nm")).unwrap();
    let tif = Tif::new(grid(&dir, "tif_"), map("tif_nm_per_s")).unwrap();
    Some(Mirror { dir, desired, tif })
}

fn load(dir: &Path, name: &str) -> ArrayD<f64> {
    match npy::read(&dir.join(format!("{name}.npy")), Dtype::F64).unwrap().array {
        ArrayData::F64(a) => a,
        other => panic!("{name}: {:?}", other.dtype()),
    }
}

fn grid(dir: &Path, prefix: &str) -> Grid {
    let axis = |name: &'static str| {
        let mm: Vec<f64> = load(dir, &format!("{prefix}{name}")).iter().copied().collect();
        Axis::from_coordinates(name, &mm).unwrap()
    };
    Grid { x: axis("x_mm"), y: axis("y_mm") }
}

impl Mirror {
    fn points(&self, name: &str) -> Vec<[f64; 2]> {
        let points = load(&self.dir, name).into_dimensionality::<Ix2>().unwrap();
        points.outer_iter().map(|p| [p[0], p[1]]).collect()
    }

    /// The published path; a missing last control point mirrors the one before about the last
    /// dwell point.
    fn path(&self, name: &str) -> ToolPath {
        let mut points = self.points(&format!("{name}_path_mm"));
        let dwell_points = self.points(&format!("{name}_dwell_point_mm"));
        let n = dwell_points.len();
        if points.len() == n {
            let (p, d) = (points[n - 1], dwell_points[n - 1]);
            points.push([2.0 * d[0] - p[0], 2.0 * d[1] - p[1]]);
        }
        ToolPath::new(points, dwell_points, vec![true; n], vec![0; n]).unwrap()
    }

    /// Published: point columns, 0.1 s.
    fn problem<'a>(&'a self, path: &'a ToolPath) -> Problem<'a> {
        Problem {
            desired: &self.desired,
            tif: &self.tif,
            path,
            weight: None,
            columns: Columns::Point,
            min_dwell: Bound::Seconds(0.1),
        }
    }

    fn published(&self, name: &str) -> Vec<f64> {
        load(&self.dir, &format!("{name}_udo_dwell_s")).iter().copied().collect()
    }
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
        a.iter().zip(b).map(|(a, b)| f(a - ma, b - mb)).sum()
    };
    sum(&|a, b| a * b) / (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt()
}

#[test]
fn udo_is_the_published_dwell_and_better_with_the_floor_in_the_model() {
    let Some(mirror) = mirror() else { return };
    // The published residuals are 0.204 and 0.263 nm, plane removed; what to reach is stated with
    // the number of rounds of the source unknown.
    for (name, limit_nm) in [("raster", 0.22), ("maze", 0.28)] {
        let path = mirror.path(name);
        let with = |floor| {
            let settings = udo::Settings { floor, max_iterations: 10, ..Default::default() };
            udo::solve(&mirror.problem(&path), &settings).unwrap()
        };
        let (shift, model) = (with(Floor::Shift), with(Floor::Model));
        let alike = correlation(shift.dwell.dwell_s(), &mirror.published(name));
        let rms = [&shift, &model].map(|s| s.outcome.model_rms_detilted_nm);
        let time = [&shift, &model].map(|s| s.outcome.total_time_s);
        println!("{name}: shift, model {rms:?} nm, {time:?} s, correlation {alike}");
        assert!(rms[0] <= limit_nm && alike > 0.99, "{name}: {rms:?} {alike}");
        assert!(rms[1] < rms[0] && time[1] < time[0], "{name}: {rms:?} {time:?}");
        let least = shift.dwell.dwell_s().iter().copied().fold(f64::INFINITY, f64::min);
        // Rounding of t - min t + 0.1.
        assert!((least - 0.1).abs() < 1e-12, "{least}");
    }
}

#[test]
fn nnls_finds_the_least_residual() {
    let Some(mirror) = mirror() else { return };
    let path = mirror.path("raster");
    let settings = non_negative_least_squares::Settings { tikhonov: 1e-6, ..Default::default() };
    let found = non_negative_least_squares::solve(&mirror.problem(&path), &settings).unwrap();
    println!("{:?} {:?}", found.outcome, found.report);
    assert_eq!(found.report.end, End::Optimal);
    // Computed independently (a generic solver of quadratic programs): 0.14845 nm in 434.7 s.
    assert!((found.outcome.model_rms_detilted_nm - 0.14845).abs() < 2e-5, "{:?}", found.outcome);
    assert!((found.outcome.total_time_s - 434.7).abs() < 0.5, "{:?}", found.outcome);
}

#[test]
fn lucy_richardson_needs_no_extension() {
    let Some(mirror) = mirror() else { return };
    let path = mirror.path("raster");
    let settings = lucy_richardson::Settings { max_iterations: 60, ..Default::default() };
    let found = lucy_richardson::solve(&mirror.problem(&path), &settings).unwrap();
    println!("{:?}", found.outcome);
    // A regression bound: a prototype of the same iteration had 0.1581 nm after 50 steps, without a floor; here the floor
    // of 0.1 s, which the published dwell times keep too, costs some.
    assert!(found.outcome.model_rms_detilted_nm < 0.18, "{:?}", found.outcome);
}
