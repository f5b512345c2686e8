//! The reference mirror: a flat silicon mirror and an ion beam, with published tool paths and dwell
//! times (T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005).
//!
//! `PLANISH_REFERENCE` names the folder that holds `nsls2-mirror/`; without it the tests are
//! counted as skipped.

use std::{env, fs, process::Command, time::Duration};

use planish_dwell::{
    bounded_least_squares::{self, Bound},
    columns::{Columns, patches},
};
use planish_schedule::{
    baselines::{position, pvt_as_published, pvt_as_published::RestCondition},
    constant_acceleration, pvt, trig_spline,
};
use planish_simulate::{direct, simulate};
use planish_testkit::{
    case_generator, ion_beam,
    mirror::{Mirror, mirror},
    program::{run_within, text},
};
use planish_toolpath::{RasterSettings, raster};
use planish_types::{DwellTime, Removal, Tif, ToolPath, Trajectory};
use planish_verify::{Verdict, VerifySettings, verify};
use rand::RngExt;
use rayon::prelude::*;

const GRIDDED: planish_simulate::SimulationSettings = planish_simulate::SimulationSettings::Gridded;

/// Removal of `trajectory` on the mirror.
fn simulated(
    mirror: &Mirror,
    trajectory: &Trajectory,
    settings: planish_simulate::SimulationSettings,
) -> Removal {
    simulate(trajectory, &mirror.tif, &mirror.desired, settings).unwrap().removal
}

/// The spline of the publication, which has no tolerance of its distance from the path.
fn smooth(path: &ToolPath, dwell: &DwellTime) -> planish_schedule::Schedule<pvt::PvtReport> {
    let settings = pvt::PvtSettings {
        max_path_distance_mm: Some(1e9),
        ..pvt::PvtSettings::new(pvt::Mode::Smooth)
    };
    pvt::schedule(path, dwell, &ion_beam(), &settings).unwrap()
}

fn judge(trajectory: &Trajectory) -> Verdict {
    verify(trajectory, &ion_beam(), &VerifySettings::default()).unwrap()
}

fn near(what: &str, found: f64, expected: f64, tolerance: f64) {
    println!("{what}: {found} (expected {expected} +- {tolerance})");
    assert!((found - expected).abs() <= tolerance, "{what}: {found}, expected {expected}");
}

#[test]
fn a_test_without_its_data_says_so_and_is_counted() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut one = Command::new(env::current_exe().unwrap());
    one.args([
        "--exact",
        "reference::initial_rms",
        "reference::best_dwell_on_the_published_raster_points",
    ]);
    one.env("CARGO_PKG_NAME", "planish-testkit");
    one.env_remove("PLANISH_REFERENCE").env("PLANISH_SKIPPED", file.path());
    let ended = run_within(&mut one, Duration::from_secs(60));
    assert!(ended.status.success(), "{}", text(&ended.stdout));
    let mut counted: Vec<String> =
        fs::read_to_string(file.path()).unwrap().lines().map(String::from).collect();
    counted.sort();
    let names = ["reference::best_dwell_on_the_published_raster_points", "reference::initial_rms"];
    assert_eq!(counted, names.map(|name| format!("planish-testkit: {name}")));
    // Past the harness, which keeps what a passing test prints.
    for name in names {
        let line = format!("skipped: planish-testkit: {name}: PLANISH_REFERENCE is not set\n");
        assert!(text(&ended.stderr).contains(&line), "{}", text(&ended.stderr));
    }
}

#[test]
fn initial_rms() {
    let Some(mirror) = mirror() else { return };
    // Stated to four decimals.
    near("initial RMS, nm", mirror.desired.statistics().rms, 6.3167, 5e-5);
}

#[test]
fn published_dwell_at_the_dwell_points_gives_the_published_maps() {
    let Some(mirror) = mirror() else { return };
    for (name, rms) in [("raster", 0.20434), ("maze", 0.26263)] {
        let trajectory = position::schedule(&mirror.path(name), &mirror.dwell(name)).unwrap();
        let published = mirror.map(&format!("{name}_udo_removal_nm"));
        // Term by term the sum is the published one up to rounding. The gridded method takes the
        // samples of the TIF, whose pitch differs from the map's by 2.5e-8, for its pixels.
        let direct = planish_simulate::SimulationSettings::Direct { steps: 1 };
        for (method, tolerance_nm) in [(direct, 1e-9), (GRIDDED, 1e-5)] {
            let removal = simulated(&mirror, &trajectory, method);
            near(name, removal.residual().detilted_rms_nm(), rms, 1e-5);
            let off = (removal.removal_nm() - &published).fold(0.0, |m: f64, v| m.max(v.abs()));
            near(&format!("{name}: largest difference, nm, {method:?}"), off, 0.0, tolerance_nm);
        }
    }
}

#[test]
fn published_dwell_executed_by_pvt() {
    let Some(mirror) = mirror() else { return };
    // Detilted RMS and largest accelerations of the clamped cubic spline, computed independently.
    for (name, rms, acceleration) in
        [("raster", 0.1962, [87.7, 53.2]), ("maze", 0.1998, [183.9, 214.9])]
    {
        let schedule = smooth(&mirror.path(name), &mirror.dwell(name));
        let verdict = judge(&schedule.trajectory);
        assert!(verdict.limits_respected, "{:?}", verdict.violations);
        assert!(schedule.report.stretched.is_empty(), "{name}: {:?}", schedule.report.stretched);
        for axis in 0..2 {
            let (found, expected) = (verdict.max_acceleration_mm_per_s2[axis], acceleration[axis]);
            near(&format!("{name}: acceleration of axis {axis}"), found, expected, 0.02 * expected);
        }
        let residual = simulated(&mirror, &schedule.trajectory, GRIDDED);
        near(name, residual.residual().detilted_rms_nm(), rms, 0.003);
    }
}

#[test]
fn published_maze_executed_by_constant_acceleration() {
    let Some(mirror) = mirror() else { return };
    let (path, dwell) = (mirror.path("maze"), mirror.dwell("maze"));
    let schedule = constant_acceleration::schedule(&path, &dwell, &ion_beam()).unwrap();
    let residual = simulated(&mirror, &schedule.trajectory, GRIDDED);
    near("maze", residual.residual().detilted_rms_nm(), 0.223, 0.003);
    // The count of an independent prototype, at its threshold of 1 nm: they are integers.
    let report = &schedule.report;
    assert_eq!(report.overshoot_segments, [478, 628]);
    assert_eq!(report.visible_overshoot_segments, [379, 379]);
    for (axis, micron) in [24.5, 55.7].into_iter().enumerate() {
        let what = format!("maze: overshoot of axis {axis}, um");
        near(&what, 1e3 * report.largest_overshoot_mm[axis], micron, 0.01 * micron);
    }
}

/// The source's least squares misses positions and moves resting axes; the node velocities do not. Here it
/// misses by up to 0.37 mm, and by 24 to 89 um RMS. An independent prototype found up to 0.49 mm, and 14 to
/// 90 um RMS.
#[test]
fn pvt_as_published_and_its_defects() {
    let Some(mirror) = mirror() else { return };
    for (name, rms, um, um_as_printed) in [
        ("raster", 0.1956, [366.0, 271.7], [495.1, 271.7]),
        ("maze", 0.1999, [269.6, 367.8], [269.6, 494.8]),
    ] {
        let (path, dwell) = (mirror.path(name), mirror.dwell(name));
        let with = |rest_condition| {
            let settings = pvt_as_published::AsPublishedSettings { rest_condition };
            pvt_as_published::schedule(&path, &dwell, &ion_beam(), &settings).unwrap()
        };
        let published = with(RestCondition::Corrected);
        println!("{name}: {:?}", published.report);
        let largest = published.report.largest_position_error_mm;
        // All 6N unknowns by clarabel (Python), um; Eq. 16 as printed makes 0.37 mm 0.495 mm.
        let printed = with(RestCondition::AsPrinted);
        println!("{name}, Eq. 16 as printed: {:?}", printed.report);
        let as_printed = printed.report.largest_position_error_mm;
        for axis in 0..2 {
            near(name, 1e3 * largest[axis], um[axis], 0.1);
            near(name, 1e3 * as_printed[axis], um_as_printed[axis], 0.1);
        }
        assert!(published.report.largest_resting_velocity_mm_per_s[1] > 1.0, "{name}");
        let hermite = smooth(&path, &dwell);
        let step = |t: &Trajectory| {
            judge(t).axes.each_ref().map(|a| {
                let inner = t.segments().zip(t.segments().skip(1)).map(|(s, n)| {
                    let x = usize::from(a.name == "y");
                    let (c, d) = (s.coefficient_mm[x], n.coefficient_mm[x]);
                    (2.0 * d[2] - 2.0 * c[2] - 6.0 * c[3] * s.duration_s).abs()
                });
                inner.fold(0.0, f64::max)
            })
        };
        // The published one's acceleration steps by more than 100 mm/s^2, the spline's by rounding.
        assert!(step(&published.trajectory).iter().all(|s| *s > 100.0));
        assert!(step(&hermite.trajectory).iter().all(|s| *s < 1e-6));
        let residual = simulated(&mirror, &published.trajectory, GRIDDED);
        near(name, residual.residual().detilted_rms_nm(), rms, 0.003);
    }
}

/// Corners of the maze cost `smooth` 168 um of overshoot and `monotone` nothing, says the judge.
#[test]
fn smooth_overshoots_corners_and_monotone_does_not() {
    let Some(mirror) = mirror() else { return };
    let (path, dwell) = (mirror.path("maze"), mirror.dwell("maze"));
    let largest = |t: &Trajectory| judge(t).max_overshoot_mm.into_iter().fold(0.0, f64::max);
    near("smooth, um", 1e3 * largest(&smooth(&path, &dwell).trajectory), 168.0, 1.0);
    let settings = pvt::PvtSettings::new(pvt::Mode::Monotone);
    let monotone = pvt::schedule(&path, &dwell, &ion_beam(), &settings).unwrap();
    near("monotone, um", 1e3 * largest(&monotone.trajectory), 0.0, 1e-9);
}

/// Nothing of the published plans is too fast for the machine, so the trigonometric spline keeps
/// every dwell time, corners included.
#[test]
fn published_dwell_executed_by_the_trigonometric_spline() {
    let Some(mirror) = mirror() else { return };
    // Between the smooth motion and the uniform one on straight segments.
    for (name, rms) in [("raster", 0.1956), ("maze", 0.2257)] {
        let (path, dwell) = (mirror.path(name), mirror.dwell(name));
        let s = trig_spline::schedule(&path, &dwell, &ion_beam(), &Default::default()).unwrap();
        let verdict = judge(&s.trajectory);
        assert!(verdict.limits_respected, "{:?}", verdict.violations);
        assert_eq!((s.report.offset_added_s, s.report.slowed_corners), (0.0, 0), "{:?}", s.report);
        let residual = simulated(&mirror, &s.trajectory, GRIDDED);
        near(name, residual.residual().detilted_rms_nm(), rms, 0.003);
    }
}

/// The two methods share nothing but the TIF. It ends with a step, so the midpoint
/// rule is of order 1.
#[test]
fn gridded_agrees_with_direct_quadrature() {
    let Some(mirror) = mirror() else { return };
    let trajectory = smooth(&mirror.path("raster"), &mirror.dwell("raster")).trajectory;
    let gridded = simulated(&mirror, &trajectory, GRIDDED);
    let grid = mirror.desired.grid();
    let mut generator = case_generator(2023, 0, 0);
    let (ny, nx) = grid.shape();
    let pixels: Vec<(usize, usize)> =
        (0..200).map(|_| (generator.random_range(0..ny), generator.random_range(0..nx))).collect();
    let error = |steps: usize| {
        let off = |&(r, c): &(usize, usize)| {
            let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
            let near = within_reach(&trajectory, &mirror.tif, x, y);
            direct::removal_at_nm(&near, &mirror.tif, x, y, steps) - gridded.removal_nm()[[r, c]]
        };
        let squares: Vec<f64> = pixels.par_iter().map(|p| off(p).powi(2)).collect();
        (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
    };
    let steps = [64, 256, 1024];
    let errors = steps.map(error);
    let order = (errors[0] / errors[2]).log2() / 4.0;
    println!("steps {steps:?}: {errors:?} nm RMS, order {order:.3}");
    assert!(errors[0] > errors[1] && errors[1] > errors[2], "{errors:?}");
    // 200 pixels and the phase of the steps against the border scatter the order about 1.
    assert!((0.7..1.5).contains(&order), "{order}");
    assert!(errors[2] <= 1e-3, "{errors:?}");
}

/// The motion with the tool off where the TIF cannot reach (x, y).
fn within_reach(trajectory: &Trajectory, tif: &Tif, x: f64, y: f64) -> Trajectory {
    let [half_x, half_y] = tif.half_size_mm();
    // Segments are short; a millimetre on top of the TIF covers their curvature.
    let near = |s: planish_types::Segment<'_>| {
        [0.0, 0.5, 1.0].iter().any(|u| {
            let p = s.position_mm(u * s.duration_s);
            (p[0] - x).abs() <= half_x + 1.0 && (p[1] - y).abs() <= half_y + 1.0
        })
    };
    Trajectory::new(
        trajectory.break_time_s().to_vec(),
        trajectory.coefficient_mm().to_vec(),
        trajectory.segments().map(near).collect(),
        trajectory.dwell_index().to_vec(),
    )
    .unwrap()
}

#[test]
fn best_dwell_on_the_published_raster_points() {
    let Some(mirror) = mirror() else { return };
    let path = mirror.path("raster");
    let settings = bounded_least_squares::BoundedSettings {
        columns: Columns::Point,
        min_dwell: Bound::Seconds(0.1),
        tikhonov: 2.8e-8,
        slope_weight: 0.0,
        ..Default::default()
    };
    let solution =
        bounded_least_squares::solve(&mirror.desired, &mirror.tif, &path, None, &settings).unwrap();
    let trajectory = position::schedule(&path, &solution.dwell).unwrap();
    let removal = simulated(&mirror, &trajectory, GRIDDED);
    // The dwell points that do not reach the map at the floor, as in the independent computation.
    let columns =
        patches(&Columns::Point.places(&path, &mirror.tif), &mirror.tif, mirror.desired.grid());
    let at_floor: f64 = (solution.dwell.dwell_s().iter().zip(&columns))
        .map(|(t, p)| if p.rate_nm_per_s.iter().all(|r| *r == 0.0) { 0.1 } else { *t })
        .sum();
    near("total time, s", at_floor, 434.7, 0.5);
    near("residual, nm detilted", removal.residual().detilted_rms_nm(), 0.14845, 2e-5);
}

#[test]
fn best_dwell_within_its_own_model() {
    let Some(mirror) = mirror() else { return };
    for name in ["raster", "maze"] {
        let settings = bounded_least_squares::BoundedSettings {
            columns: Columns::Point,
            min_dwell: Bound::Seconds(0.1),
            tikhonov: 2.8e-8,
            slope_weight: 0.0,
            ..Default::default()
        };
        let path = mirror.path(name);
        let solution =
            bounded_least_squares::solve(&mirror.desired, &mirror.tif, &path, None, &settings)
                .unwrap();
        println!("{name}: {:?}", solution.report);
        // Regression bound: measured 0.1484 nm (raster) and 0.1480 nm (maze) on the published points.
        assert!(solution.report.model_rms_nm <= 0.149, "{:?}", solution.report);
        // The certificate: the mean square is within 1e-4 of the least, its root within 5e-5.
        assert!(solution.report.proven.relative_gap.unwrap() <= 1e-4, "{:?}", solution.report);
    }
}

#[test]
fn refined_on_the_published_paths() {
    let Some(mirror) = mirror() else { return };
    let floors = [Bound::Seconds(0.1), Bound::SecondsPerMm(0.02)];
    for (name, goals) in
        [("raster", [(0.141, 7.3), (0.141, 4.2)]), ("maze", [(0.142, 7.4), (0.142, 5.0)])]
    {
        for (min_dwell, (rms, minutes)) in floors.into_iter().zip(goals) {
            let mut settings = planish_refine::RefineSettings::default();
            settings.dwell.min_dwell = min_dwell;
            let path = mirror.path(name);
            let refined = planish_refine::refine(
                &mirror.desired,
                &mirror.tif,
                &path,
                &ion_beam(),
                None,
                &settings,
            )
            .unwrap();
            assert!(judge(&refined.trajectory).limits_respected);
            let found =
                simulated(&mirror, &refined.trajectory, GRIDDED).residual().statistics().rms;
            let took = refined.trajectory.total_time_s() / 60.0;
            println!("{name} {min_dwell:?}: {found} nm in {took} min");
            assert!(
                found <= rms && took <= minutes,
                "{name} {min_dwell:?}: {found} nm, {took} min"
            );
        }
    }
}

#[test]
fn own_raster_own_dwell_executed_by_pvt() {
    let Some(mirror) = mirror() else { return };
    let [x, y] = mirror.tif.half_size_mm();
    let settings = RasterSettings::new(1.0, 1.0, x.max(y));
    let path = raster(&mirror.desired, &settings).unwrap();
    let settings = bounded_least_squares::BoundedSettings {
        min_dwell: Bound::Seconds(0.1),
        ..Default::default()
    };
    let solution =
        bounded_least_squares::solve(&mirror.desired, &mirror.tif, &path, None, &settings).unwrap();
    let schedule = smooth(&path, &solution.dwell);
    let verdict = judge(&schedule.trajectory);
    assert!(verdict.limits_respected, "{:?}", verdict.violations);
    let rms = simulated(&mirror, &schedule.trajectory, GRIDDED).residual().statistics().rms;
    let minutes = schedule.trajectory.total_time_s() / 60.0;
    println!("executed {rms} nm RMS in {minutes} min, {} points", path.len());
    // Regression bound: measured 0.1417 nm and 7.29 min on this raster.
    assert!(rms <= 0.150 && minutes <= 7.6, "{rms} nm, {minutes} min");
}
