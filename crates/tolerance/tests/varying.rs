//! A tool that is not the same everywhere and at all times: every line of the table against the difference of two
//! simulations, one of them of a motion or a tool that has the error in it, made here.

use crate::example::{
    assert_line_is_mean_over_runs, desired, error, noises, process, raster, rms, with,
};
use ndarray::Array2;
use planish_simulate::{SimulationSettings as Simulation, simulate};
use planish_tolerance::{Free, Tolerance, ToleranceSettings, quadratic::Sources, tolerance};
use planish_types::{
    Axis, AzimuthWeights, Grid, PixelFactor, Tif, TimeFactor, Trajectory, TrajectoryBuilder,
    VaryingTif,
};
use serde_json::{Value, json};

/// Middle of the map and radius of the sphere, mm: its slope is 20 degrees in the corners.
const MIDDLE_MM: [f64; 2] = [10.0, 6.0];
const RADIUS_MM: f64 = 35.0;

/// Play of the axes of one of the errors, mm.
const PLAY_MM: f64 = 0.05;

fn axis(start: f64, step: f64, n: usize) -> Axis {
    Axis::new(start, step, n).unwrap()
}

fn samples(grid: &Grid, of: impl Fn(f64, f64) -> f64) -> Array2<f64> {
    Array2::from_shape_fn(grid.shape(), |(r, c)| {
        of(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
    })
}

/// Returns the tangent of the slope of the sphere times the direction of the slope.
fn slope(x: f64, y: f64) -> [f64; 2] {
    let (x, y) = (x - MIDDLE_MM[0], y - MIDDLE_MM[1]);
    let root = (RADIUS_MM * RADIUS_MM - x * x - y * y).sqrt();
    [x / root, y / root]
}

/// Returns a factor of the rate that falls by a tenth over the run, times 1 + `drift` (t / T - 1/2).
fn wear(drift: f64) -> TimeFactor {
    let total = raster().total_time_s();
    let part: Vec<f64> = (0..=400).map(|i| f64::from(i) / 400.0).collect();
    let factor = part.iter().map(|u| (1.05 - 0.1 * u) * (1.0 + drift * (u - 0.5))).collect();
    TimeFactor { time_s: part.iter().map(|u| u * total).collect(), factor }
}

/// Makes a beam along the normal of the sphere, whose rate depends on the incidence at the pixel and on the time. In
/// the plane it is exp(-(u^2 + (u . q)^2) / 2) with the tangent q, to the second order of (u . q)^2; `inverse` takes
/// offsets to those of the beam without errors, of `volume` times its volume.
fn beam(inverse: [[f64; 2]; 2], volume: f64, time: Option<TimeFactor>) -> Tif {
    let offsets = Grid { x: axis(-5.0, 0.25, 41), y: axis(-5.0, 0.25, 41) };
    let positions = Grid { x: axis(-6.5, 1.5, 23), y: axis(-5.0, 1.5, 17) };
    let (mut kernels, mut weights) = (Vec::new(), Vec::new());
    // (-1/2)^n / n! times the binomial coefficients of 2 n
    let coefficients: [&[f64]; 3] = [&[1.0], &[-0.5, -1.0, -0.5], &[0.125, 0.5, 0.75, 0.5, 0.125]];
    for row in coefficients {
        let power = row.len() as i32 - 1;
        for (k, c) in (0..).zip(row) {
            kernels.push(samples(&offsets, |x, y| {
                let [u, v] = inverse.map(|row| row[0] * x + row[1] * y);
                let bell = 8.0 / volume * (-0.5 * (u * u + v * v)).exp();
                c * u.powi(power - k) * v.powi(k) * bell
            }));
            weights.push(samples(&positions, |x, y| {
                let [a, b] = slope(x, y);
                a.powi(power - k) * b.powi(k)
            }));
        }
    }
    let map = *desired().grid();
    let factor = samples(&map, |x, y| {
        let [a, b] = slope(x, y);
        (1.0 + a * a + b * b).powf(0.85)
    });
    let pixels = Some(PixelFactor { grid: map, factor });
    Tif::varying(VaryingTif {
        offsets,
        kernels,
        positions,
        weights,
        azimuth: None,
        heading: None,
        pixels,
        time,
    })
    .unwrap()
}

const SAME: [[f64; 2]; 2] = [[1.0, 0.0], [0.0, 1.0]];

/// Makes the tool of the plan: the beam without errors, which wears.
fn tool() -> Tif {
    beam(SAME, 1.0, Some(wear(0.0)))
}

fn settings(simulated_runs: usize) -> ToleranceSettings {
    ToleranceSettings { draws: 1000, simulated_runs, ..ToleranceSettings::default() }
}

fn of(motion: &Trajectory, tif: &Tif, errors: Value, settings: &ToleranceSettings) -> Tolerance {
    let process = process(&json!({ "name": "test", "errors": errors })).unwrap();
    tolerance(motion, tif, &desired(), &process, settings).unwrap()
}

fn removal(motion: &Trajectory, tif: &Tif) -> Array2<f64> {
    let found = simulate(motion, tif, &desired(), Simulation::Gridded).unwrap();
    found.removal.removal_nm().clone()
}

/// Makes the raster with every point where `place` says. Its arguments are the planned point, mm, the velocity, mm/s,
/// and the start of the piece, s.
fn moved(place: impl Fn([f64; 2], [f64; 2], f64) -> [f64; 2]) -> Trajectory {
    let mut builder = TrajectoryBuilder::default();
    for s in raster().segments() {
        let (c, h) = (s.coefficient_mm, s.duration_s);
        let speed = [c[0][1], c[1][1]];
        // Lines at constant feed stay lines: the ends decide.
        let [from, to] = [0.0, h]
            .map(|u| place([c[0][0] + speed[0] * u, c[1][0] + speed[1] * u], speed, s.start_s));
        let line = |a: usize| [from[a], (to[a] - from[a]) / h, 0.0, 0.0];
        builder.push(h, [line(0), line(1)], s.tool_on, s.dwell_index);
    }
    builder.build().unwrap()
}

/// Returns every error of one number, with the difference that it makes to the removal, nm: of the place, the rate, the
/// shape, the axes.
fn planted() -> Vec<(Value, Array2<f64>)> {
    let nominal = removal(&raster(), &tool());
    let by_motion = |motion: Trajectory| removal(&motion, &tool()) - &nominal;
    let by_tool = |tif: Tif| removal(&raster(), &tif) - &nominal;
    let [cx, cy] = MIDDLE_MM;
    let angle = 0.01_f64.to_radians();
    let rotated = |[x, y]: [f64; 2]| {
        let (s, c) = angle.sin_cos();
        [cx + c * (x - cx) - s * (y - cy), cy + s * (x - cx) + c * (y - cy)]
    };
    // Along a line x is short of its command by half the play; the steps from line to line ascend after the first line.
    let loose = |[x, y]: [f64; 2], [vx, vy]: [f64; 2], t: f64| {
        let back = vx < 0.0 || (vx == 0.0 && x < 0.0);
        let up = (t > 0.0 && y > -3.0) || vy > 0.0;
        let half = 0.5 * PLAY_MM;
        [x - if back { -half } else { half }, y - if up { half } else { 0.0 }]
    };
    let wider = [[1.0 / 1.01, 0.0], [0.0, 1.0 / 1.01]];
    let longer = [[1.0 / 1.005, 0.0], [0.0, 1.0 / 0.995]];
    let (s, c) = 0.02_f64.sin_cos();
    let turned = [[c, s], [-s, c]];
    let beam_of = |inverse: [[f64; 2]; 2]| {
        let volume = 1.0 / (inverse[0][0] * inverse[1][1] - inverse[0][1] * inverse[1][0]);
        beam(inverse, volume, Some(wear(0.0)))
    };
    let fixed = |kind: &str, size: f64, unit: &str| error(kind, size, unit, "fixed");
    vec![
        (fixed("rate_scale", 1.0, "%"), 0.01 * &nominal),
        (fixed("rate_drift", 1.0, "%"), by_tool(beam(SAME, 1.0, Some(wear(0.01))))),
        (fixed("offset_x", 50.0, "um"), by_motion(moved(|[x, y], _, _| [x + 0.05, y]))),
        (fixed("offset_y", 50.0, "um"), by_motion(moved(|[x, y], _, _| [x, y + 0.05]))),
        (fixed("rotation", 0.01, "deg"), by_motion(moved(|p, _, _| rotated(p)))),
        (
            fixed("magnification", 0.1, "%"),
            by_motion(moved(|[x, y], _, _| [cx + 1.001 * (x - cx), cy + 1.001 * (y - cy)])),
        ),
        (fixed("shear", 0.1, "%"), by_motion(moved(|[x, y], _, _| [x + 0.001 * (y - cy), y]))),
        (fixed("tif_width", 1.0, "%"), by_tool(beam_of(wider))),
        (fixed("tif_ellipticity", 1.0, "%"), by_tool(beam_of(longer))),
        (fixed("tif_rotation", 20.0, "mrad"), by_tool(beam_of(turned))),
        (fixed("backlash", 1000.0 * PLAY_MM, "um"), by_motion(moved(loose))),
    ]
}

/// Every error of one number adds what a simulation with it differs by from one without it: within 3 %, of which the
/// first order is 1 % at these sizes, and the smoothing of the tool that errors move 1 %.
#[test]
fn every_error_adds_the_difference_of_two_simulations() {
    for (error, difference) in planted() {
        let found = of(&raster(), &tool(), json!([error]), &settings(0));
        let (line, simulated) = (&found.outcome.errors[0], rms(difference));
        let constant = of(&raster(), &tool().mean_tool(), json!([error]), &settings(0));
        println!(
            "{:<18} {:.5} nm, simulated {simulated:.5} nm, mean tool {:.5} nm",
            line.kind, line.adds_rms_nm, constant.outcome.errors[0].adds_rms_nm
        );
        let ratio = line.adds_rms_nm / simulated;
        assert!((ratio - 1.0).abs() < 0.03, "{}: {ratio}", line.kind);
        // Regression bound: 0.038 was seen.
        assert!(line.departs_by_rms_nm < 0.1 * simulated, "{}", line.kind);
        assert!(found.mean_tool.is_some() && constant.mean_tool.is_none());
    }
}

/// The mean square over drawn runs, each simulated, is that of the line; every kind of noise.
#[test]
fn the_line_of_a_noise_is_the_mean_over_simulated_runs() {
    for noise in noises() {
        let runs = 100;
        let found = of(&raster(), &tool(), json!([noise]), &settings(runs));
        let line = &found.outcome.errors[0];
        // A run of the noise alone, and its first order on the cells of the map. The second order of a displacement by 50 um
        // is some per cent of the first (5.5 % seen), because 50 um are some per cent of the width of the tool.
        assert!(line.departs_by_rms_nm < 0.08 * line.adds_rms_nm, "{line:?}");
        assert_eq!(found.runs.len(), runs);
        assert_line_is_mean_over_runs(&found);
    }
}

/// The quadratic of the dwell times, by which a plan is made for a process, adds what the line says.
#[test]
fn the_quadratic_of_the_dwell_times_adds_what_the_line_says() {
    let motion = raster();
    let times = motion.served_s(motion.len(), |_| true).unwrap();
    for error in [
        error("rate_scale", 1.0, "%", "normal"),
        error("rate_drift", 5.0, "%", "uniform"),
        with(error("rate_noise", 1.0, "%", "normal"), "correlation_s", 5.0),
        error("offset_x", 10.0, "um", "normal"),
        error("rotation", 0.01, "deg", "normal"),
        error("tif_width", 1.0, "%", "normal"),
        error("tif_ellipticity", 1.0, "%", "normal"),
        error("position_noise", 5.0, "um", "normal"),
    ] {
        let budget = process(&json!({ "name": "test", "errors": [error] })).unwrap();
        let sources = Sources::new(&desired(), &tool(), &budget, Free::Piston).unwrap();
        let found = sources.quadratic(&motion, motion.len()).unwrap().variance_nm2(&times).sqrt();
        let line = of(&motion, &tool(), json!([error]), &settings(0)).outcome.errors[0].adds_rms_nm;
        println!("{} {found:.5} nm, {line:.5} nm", error["kind"]);
        // As for a constant tool: cells at the border of the map, and Keys' convolution of sampled derivatives; the
        // kernels of the second order are steeper than the beam.
        assert!((found / line - 1.0).abs() < 0.015, "{}: {found} {line}", error["kind"]);
    }
}

/// The ellipticity of a spot that turns with the azimuth is refused by its index; its width and rotation are not.
#[test]
fn an_ellipticity_of_a_spot_that_turns_is_refused() {
    let offsets = Grid { x: axis(-5.0, 0.25, 41), y: axis(-5.0, 0.25, 41) };
    let bell = |x: f64, y: f64| 8.0 * (-0.5 * (x * x + y * y)).exp();
    let degrees: Vec<f64> = (0..36).map(|i| 10.0 * f64::from(i)).collect();
    let row = |of: fn(f64) -> f64| degrees.iter().map(|a| of(a.to_radians())).collect();
    let rows = vec![row(|_| 1.0), row(f64::cos), row(f64::sin)];
    let positions = Grid { x: axis(-10.0, 40.0, 2), y: axis(-10.0, 40.0, 2) };
    let turning = Tif::varying(VaryingTif {
        offsets,
        kernels: vec![
            samples(&offsets, bell),
            samples(&offsets, |x, y| 0.02 * x * bell(x, y)),
            samples(&offsets, |x, y| 0.02 * y * bell(x, y)),
        ],
        positions,
        weights: vec![Array2::ones((2, 2)); 3],
        azimuth: Some(AzimuthWeights::new(MIDDLE_MM, degrees, rows).unwrap()),
        heading: None,
        pixels: None,
        time: None,
    })
    .unwrap();
    let errors = json!([
        error("tif_width", 1.0, "%", "normal"),
        error("tif_rotation", 5.0, "mrad", "normal"),
        error("tif_ellipticity", 1.0, "%", "normal"),
    ]);
    let budget = process(&json!({ "name": "test", "errors": errors })).unwrap();
    let refused = tolerance(&raster(), &turning, &desired(), &budget, &settings(0));
    let of_plans = Sources::new(&desired(), &turning, &budget, Free::Piston);
    for said in [refused.err().unwrap().to_string(), of_plans.err().unwrap().to_string()] {
        assert!(said.contains("errors[2]: is a tif_ellipticity"), "{said}");
        assert!(said.contains("turns with the azimuth"), "{said}");
    }
    // Of a spot that turns with its motion errors change the direction too.
    let VaryingTif { azimuth, .. } = turning.numbers();
    let heading = azimuth.map(|a| a.turn().clone());
    let steered = Tif::varying(VaryingTif { azimuth: None, heading, ..turning.numbers() }).unwrap();
    let said = tolerance(&raster(), &steered, &desired(), &budget, &settings(0));
    let said = said.err().unwrap().to_string();
    assert!(said.contains("turns with the direction of the motion"), "{said}");
    let two = json!([errors[0], errors[1]]);
    let found = of(&raster(), &turning, two, &settings(0));
    assert!(
        found.outcome.errors.iter().all(|line| line.adds_rms_nm > 0.0),
        "{:?}",
        found.outcome.errors
    );
}
