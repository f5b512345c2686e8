//! The loop on a zigzag whose corners the motion cuts: it must gain, keep what it promises, and
//! say why it ends.

use ndarray::Array2;
use planish_dwell::bounded_least_squares::Bound;
use planish_refine::{RefineError, Scheduler, Settings, refine};
use planish_schedule::pvt;
use planish_simulate::simulate;
use planish_types::{Axis, AxisLimits, DwellTime, Grid, Limits, Surface, Tif, ToolPath};
use planish_verify::{VerifySettings, verify};

fn machine(velocity: f64, acceleration: f64) -> Limits {
    let axis = |name: &str| AxisLimits {
        name: name.into(),
        max_velocity_mm_per_s: velocity,
        max_acceleration_mm_per_s2: acceleration,
        max_jerk_mm_per_s3: None,
    };
    Limits { name: "test".into(), axes: vec![axis("x"), axis("y")], min_segment_s: 0.0 }
}

fn tif() -> Tif {
    let a = Axis::new(-3.0, 0.2, 31).unwrap();
    let g = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.at(c) / 3.0, g.y.at(r) / 3.0);
        8.0 * (1.0 - x * x - y * y).max(0.0).powi(4)
    });
    Tif::new(g, rate).unwrap()
}

fn desired() -> Surface {
    let g = Grid { x: Axis::new(0.0, 0.2, 51).unwrap(), y: Axis::new(0.0, 0.2, 41).unwrap() };
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.at(c) - 5.0, g.y.at(r) - 4.0);
        20.0 + 0.8 * x * x + 0.5 * y * y + 4.0 * (1.1 * x + 0.7 * y).sin()
    });
    Surface::new(g, height).unwrap()
}

/// Square meander of 1 mm steps: a corner of 90 degrees at every second node.
fn meander() -> ToolPath {
    let mut points = Vec::new();
    for row in 0..7 {
        let y = -2.0 + 2.0 * f64::from(row);
        let corner = |i: i32| {
            let x = f64::from(i / 2 + i % 2) - 2.0;
            [if row % 2 == 0 { x } else { 10.0 - x }, y + f64::from((i / 2) % 2)]
        };
        points.extend((0..28).map(corner));
    }
    points.dedup();
    let n = points.len() - 1;
    ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
}

fn settings(mode: pvt::Mode) -> Settings {
    let mut s = Settings { scheduler: Scheduler::Pvt(mode), ..Settings::default() };
    s.dwell.min_dwell = Bound::Seconds(0.05);
    s
}

#[test]
fn the_executed_residual_falls_and_the_promise_is_what_the_judges_find() {
    let (desired, tif, path, machine) = (desired(), tif(), meander(), machine(250.0, 2000.0));
    for mode in [pvt::Mode::Smooth, pvt::Mode::Monotone] {
        let refined = refine(&desired, &tif, &path, &machine, None, &settings(mode)).unwrap();
        let rms: Vec<f64> = refined.iterates.iter().map(|i| i.rms_nm).collect();
        assert!(rms[refined.best] < 0.9 * rms[0], "{mode:?}: {rms:?}");
        assert!(rms.iter().all(|r| rms[refined.best] <= *r), "{mode:?}: {rms:?}");
        // The trajectory is the one that was judged, and the dwell is its own.
        let p = simulate(&refined.trajectory, &tif, &desired, planish_simulate::Settings::Gridded);
        assert_eq!(p.unwrap().removal.residual().statistics().rms, rms[refined.best]);
        let v = verify(&refined.trajectory, &machine, &VerifySettings::default()).unwrap();
        assert!(v.limits_respected, "{:?}", v.violations);
        let how = pvt::Settings { mode, stretch: false };
        let again = pvt::schedule(&path, &refined.dwell, &machine, &how).unwrap();
        assert_eq!(again.trajectory, refined.trajectory);
        assert!(refined.dwell.dwell_s().iter().all(|t| *t >= 0.05));
    }
}

#[test]
fn a_slow_machine_gets_its_time_and_the_limits_hold() {
    let (desired, tif, path, machine) = (desired(), tif(), meander(), machine(8.0, 20.0));
    let how = settings(pvt::Mode::Smooth);
    let refined = refine(&desired, &tif, &path, &machine, None, &how).unwrap();
    assert!(refined.iterates[0].stretched > 0, "the first plan is feasible: no test");
    let best = &refined.iterates[refined.best];
    assert!(best.limits_respected && best.rms_nm < refined.iterates[0].rms_nm);
}

#[test]
fn a_given_plan_is_the_first_round_and_the_loop_can_end_there() {
    let (desired, tif, path, machine) = (desired(), tif(), meander(), machine(250.0, 2000.0));
    let how = settings(pvt::Mode::Smooth);
    let best = refine(&desired, &tif, &path, &machine, None, &how).unwrap();
    let again = refine(&desired, &tif, &path, &machine, Some(best.dwell.clone()), &how).unwrap();
    // Nothing left to gain: it says so, and returns no worse a plan.
    assert_eq!(again.end, "no-improvement");
    assert!(again.iterates[again.best].rms_nm <= best.iterates[best.best].rms_nm);
    assert_eq!(again.iterates[0].dwell_s, best.dwell.dwell_s());
    let none = Settings { max_rounds: 0, ..how };
    let uniform = DwellTime::new(vec![0.3; path.len()]).unwrap();
    let only = refine(&desired, &tif, &path, &machine, Some(uniform), &none).unwrap();
    assert_eq!((only.iterates.len(), only.best, only.end), (1, 0, "round-limit"));
}

#[test]
fn a_bound_below_the_machines_need_is_named() {
    let mut how = settings(pvt::Mode::Smooth);
    how.dwell.min_dwell = Bound::Seconds(0.0);
    how.dwell.max_dwell = Some(Bound::Seconds(0.1));
    let machine = machine(8.0, 20.0);
    let error = refine(&desired(), &tif(), &meander(), &machine, None, &how).unwrap_err();
    assert!(matches!(error, RefineError::BoundBelowNeed { bound_s: 0.1, .. }), "{error}");
    assert!(error.to_string().contains("no plan within limits and bounds"), "{error}");
}
