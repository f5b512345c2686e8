//! The solvers on the reference mirror (T. Wang et al., J. Manuf. Process. 2023,
//! doi 10.1016/j.jmapro.2023.01.005) with its published paths and dwell times.
//!
//! `PLANISH_REFERENCE` names the folder that holds `nsls2-mirror/`; without it the tests are
//! counted as skipped.

use planish_dwell::{
    baselines::non_negative_least_squares,
    bounded_least_squares::Bound,
    columns::{Columns, patches},
    lucy_richardson,
    problem::Problem,
    udo::{self, Floor},
};
use planish_testkit::mirror::{Mirror, mirror};
use planish_types::{End, ToolPath};

/// Returns the problem with the published settings: columns at the dwell points, and at least 0.1 s each.
fn problem<'a>(mirror: &'a Mirror, path: &'a ToolPath) -> Problem<'a> {
    Problem {
        desired: &mirror.desired,
        tif: &mirror.tif,
        path,
        weight: None,
        columns: Columns::Point,
        min_dwell: Bound::Seconds(0.1),
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
            let settings = udo::UdoSettings { floor, max_iterations: 10, ..Default::default() };
            udo::solve(&problem(&mirror, &path), &settings).unwrap()
        };
        let (shift, model) = (with(Floor::Shift), with(Floor::Model));
        let alike = correlation(shift.dwell.dwell_s(), mirror.dwell(name).dwell_s());
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
    let settings =
        non_negative_least_squares::NonNegativeSettings { tikhonov: 2.8e-8, ..Default::default() };
    let found = non_negative_least_squares::solve(&problem(&mirror, &path), &settings).unwrap();
    println!("{:?} {:?}", found.outcome, found.report);
    assert_eq!(found.report.end, End::Optimal);
    // Computed independently (a generic solver of quadratic programs): 0.14845 nm in 434.7 s.
    assert!((found.outcome.model_rms_detilted_nm - 0.14845).abs() < 2e-5, "{:?}", found.outcome);
    // There the dwell points that do not reach the map are at the floor of 0.1 s; here the density of their
    // neighbours, which without a smoothness are rough, goes on.
    let columns =
        patches(&Columns::Point.places(&path, &mirror.tif), &mirror.tif, mirror.desired.grid());
    let at_floor: f64 = (found.dwell.dwell_s().iter().zip(&columns))
        .map(|(t, p)| if p.rate_nm_per_s.iter().all(|r| *r == 0.0) { 0.1 } else { *t })
        .sum();
    assert!((at_floor - 434.7).abs() < 0.5, "{at_floor} {:?}", found.outcome);
}

#[test]
fn lucy_richardson_needs_no_extension() {
    let Some(mirror) = mirror() else { return };
    let path = mirror.path("raster");
    let settings =
        lucy_richardson::LucyRichardsonSettings { max_iterations: 60, ..Default::default() };
    let found = lucy_richardson::solve(&problem(&mirror, &path), &settings).unwrap();
    println!("{:?}", found.outcome);
    // Regression bound: measured 0.1605 nm on the published raster. A prototype of the same iteration had 0.1581 nm
    // after 50 steps, without a floor; here the floor of 0.1 s, which the published dwell times keep too, costs some.
    assert!(found.outcome.model_rms_detilted_nm < 0.18, "{:?}", found.outcome);
}
