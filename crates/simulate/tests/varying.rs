//! Tools that are not the same everywhere: the gridded removal beside the midpoint rule and closed forms.

use ndarray::Array2;
use planish_simulate::{SimulationPlan, SimulationSettings, direct, gridded};
use planish_types::{
    Axis, AzimuthWeights, Grid, PixelFactor, Tif, TimeFactor, Trajectory, TrajectoryBuilder,
    TurnWeights, VaryingTif,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn axis(start: f64, step: f64, n: usize) -> Axis {
    Axis::new(start, step, n).unwrap()
}

fn samples(grid: &Grid, of: impl Fn(f64, f64) -> f64) -> Array2<f64> {
    Array2::from_shape_fn(grid.shape(), |(r, c)| {
        of(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
    })
}

/// Makes three kernels on one grid: a bell, its change with the width, and one that leans.
fn kernels(offsets: &Grid) -> Vec<Array2<f64>> {
    let bell = |x: f64, y: f64| 20.0 * (-(x * x + 1.2 * y * y) / 0.6).exp();
    vec![
        samples(offsets, bell),
        samples(offsets, |x, y| bell(x, y) * (x * x + y * y - 1.0) * 0.2),
        samples(offsets, |x, y| bell(x, y) * (0.3 * x - 0.2 * y)),
    ]
}

/// Makes a tool that varies smoothly over 12 x 9 mm. If `factors` is true it has a factor of every pixel and of the
/// time.
fn varying(seed: u64, pitch_mm: f64, factors: bool) -> Tif {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = (6.0 / pitch_mm).round() as usize + 1;
    let offsets = Grid { x: axis(-3.0, pitch_mm, n), y: axis(-3.0, pitch_mm, n) };
    let positions = Grid { x: axis(-1.0, 1.7, 9), y: axis(-1.0, 1.5, 8) };
    let mut smooth = || -> [f64; 4] { [(); 4].map(|()| rng.random_range(-0.4..0.4)) };
    let weights = [1.0, 0.0, 0.0].map(|mean| {
        let [a, b, c, d] = smooth();
        samples(&positions, |x, y| mean + a * (0.3 * x + b).sin() + c * (0.25 * y + d).cos())
    });
    let map = Grid { x: axis(0.0, 0.25, 41), y: axis(0.0, 0.25, 29) };
    let pixels = PixelFactor { grid: map, factor: samples(&map, |x, y| 1.0 + 0.03 * x - 0.02 * y) };
    let time = TimeFactor { time_s: vec![0.0, 3.0, 20.0], factor: vec![1.1, 1.0, 0.8] };
    // About a point that the motion does not come near, where the azimuth is smooth.
    let degrees: Vec<f64> = (0..24).map(|i| 15.0 * f64::from(i)).collect();
    let row =
        |order: f64| degrees.iter().map(|a| 1.0 + 0.2 * (order * a.to_radians()).cos()).collect();
    let rows = vec![row(1.0), row(2.0), row(3.0)];
    let azimuth = AzimuthWeights::new([-6.0, -5.0], degrees.clone(), rows).unwrap();
    let rows = vec![row(2.0), row(1.0), row(1.0)];
    let heading = TurnWeights::by_heading(degrees.clone(), rows).unwrap();
    Tif::varying(VaryingTif {
        kernels: kernels(&offsets),
        offsets,
        positions,
        weights: weights.to_vec(),
        azimuth: factors.then_some(azimuth),
        heading: factors.then_some(heading),
        pixels: factors.then_some(pixels),
        time: factors.then_some(time),
    })
    .unwrap()
}

/// Makes a motion with rests, uniform and bent pieces over the map and beyond.
fn motion(seed: u64) -> Trajectory {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut builder = TrajectoryBuilder::default();
    let mut at = [1.0, 1.0];
    for k in 0..12 {
        let h = rng.random_range(0.3..1.2);
        let to = [rng.random_range(-1.0..11.0), rng.random_range(-1.0..8.0)];
        let c = [0, 1].map(|a| match k % 3 {
            0 => [at[a], 0.0, 0.0, 0.0],
            1 => [at[a], (to[a] - at[a]) / h, 0.0, 0.0],
            _ => {
                let d = to[a] - at[a];
                [at[a], 0.0, 3.0 * d / (h * h), -2.0 * d / (h * h * h)]
            }
        });
        builder.push(h, c, k != 7, Some(k));
        if k % 3 != 0 {
            at = to;
        }
    }
    builder.build().unwrap()
}

fn largest(map: &Array2<f64>) -> f64 {
    map.iter().fold(0.0, |m, v| v.abs().max(m))
}

#[test]
fn the_gridded_removal_is_that_of_the_midpoint_rule() {
    let map = Grid { x: axis(0.0, 0.25, 41), y: axis(0.0, 0.25, 29) };
    for seed in 0..8 {
        let factors = seed % 2 == 1;
        let (tif, motion) = (varying(seed, 0.25, factors), motion(seed));
        let (found, _) = gridded::removal_nm(&motion, &tif, &map).unwrap();
        // Two step sizes of a rule of second order: their extrapolation.
        let [coarse, fine] =
            [250, 500].map(|steps| direct::removal_nm(&motion, &tif, &map, steps).unwrap().0);
        let expected = &fine + &((&fine - &coarse) / 3.0);
        let error = largest(&(&found - &expected)) / largest(&expected);
        // What the extrapolation leaves, of third order at the kinks of Keys' second derivative: 1e-6 with half the steps.
        assert!(error < 1e-6, "{seed}: {error}");
    }
}

/// Tests a spot that leans towards where it goes, on a parabola there and on the way back: headings of more than half a
/// turn.
#[test]
fn a_spot_that_turns_with_a_bent_motion_is_that_of_the_midpoint_rule() {
    let offsets = Grid { x: axis(-3.0, 0.25, 25), y: axis(-3.0, 0.25, 25) };
    let positions = Grid { x: axis(0.0, 10.0, 2), y: axis(0.0, 7.0, 2) };
    let bell = kernels(&offsets).swap_remove(0);
    let lean = |x: f64, y: f64| &bell * &samples(&offsets, |u, v| x * u + y * v);
    let degrees: Vec<f64> = (0..72).map(|i| 5.0 * f64::from(i)).collect();
    let row = |of: fn(f64) -> f64| degrees.iter().map(|a| of(a.to_radians())).collect();
    let rows = vec![row(|_| 1.0), row(f64::cos), row(f64::sin)];
    let tif = Tif::varying(VaryingTif {
        offsets,
        kernels: vec![bell.clone(), lean(0.2, 0.0), lean(0.0, 0.2)],
        positions,
        weights: vec![Array2::ones((2, 2)); 3],
        azimuth: None,
        heading: Some(TurnWeights::by_heading(degrees.clone(), rows).unwrap()),
        pixels: None,
        time: None,
    })
    .unwrap();
    // (2 + 2 u, 1 + 4 u - 2 u^2), a rest, and a line back: a removal in two pieces and one at rest.
    let there = [[2.0, 2.0, 0.0, 0.0], [1.0, 4.0, -2.0, 0.0]];
    let rest = [[6.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]];
    let back = [[6.0, -1.0, 0.0, 0.0], [1.0, 0.5, 0.0, 0.0]];
    let breaks = vec![0.0, 2.0, 2.5, 4.5];
    let motion =
        Trajectory::new(breaks, vec![there, rest, back], vec![true; 3], vec![None; 3]).unwrap();
    let map = Grid { x: axis(0.0, 0.25, 41), y: axis(0.0, 0.25, 29) };
    let (found, _) = gridded::removal_nm(&motion, &tif, &map).unwrap();
    // The closed form of the tool, by the midpoint rule: K = bell(u) (1 + 0.2 u . direction).
    let mut expected = Array2::<f64>::zeros(map.shape());
    let at = Tif::new(offsets, bell).unwrap();
    let steps = 4000;
    for (k, (duration, direction)) in
        [(2.0, None), (0.5, Some([2.0, -4.0])), (2.0, Some([-1.0, 0.5]))].into_iter().enumerate()
    {
        let steps = if k == 1 { 1 } else { steps };
        let h = duration / f64::from(steps);
        for q in 0..steps {
            let u = (f64::from(q) + 0.5) * h;
            let p = motion.segment(k).position_mm(u);
            let [dx, dy] = direction.unwrap_or([2.0, 4.0 - 4.0 * u]);
            let length = f64::hypot(dx, dy);
            for ((r, c), v) in expected.indexed_iter_mut() {
                let (x, y) = (map.x.coordinate_mm(c) - p[0], map.y.coordinate_mm(r) - p[1]);
                *v += h * at.rate_at(x, y) * (1.0 + 0.2 * (x * dx + y * dy) / length);
            }
        }
    }
    let error = largest(&(&found - &expected)) / largest(&expected);
    // Keys' convolution of a bell times a coordinate at its 0.25 mm, and cosines at 5 degrees: 2e-4 and 1e-5.
    assert!(error < 5e-4, "{error}");
    // A tool that does not turn would be wrong by some percent.
    let [coarse, fine] =
        [500, 1000].map(|steps| direct::removal_nm(&motion, &tif, &map, steps).unwrap().0);
    let midpoint = &fine + &((&fine - &coarse) / 3.0);
    let error = largest(&(&found - &midpoint)) / largest(&midpoint);
    // As for the other tools above.
    assert!(error < 1e-6, "{error}");
}

#[test]
fn one_kernel_of_weight_one_is_a_tif_to_the_last_bit() {
    let offsets = Grid { x: axis(-3.0, 0.25, 25), y: axis(-3.0, 0.25, 25) };
    let positions = Grid { x: axis(0.0, 5.0, 3), y: axis(0.0, 5.0, 3) };
    let map = Grid { x: axis(0.0, 0.25, 41), y: axis(0.0, 0.25, 29) };
    let kernel = kernels(&offsets).swap_remove(0);
    let one = Tif::varying(VaryingTif {
        offsets,
        kernels: vec![kernel.clone()],
        positions,
        weights: vec![Array2::ones((3, 3))],
        azimuth: None,
        heading: None,
        pixels: None,
        time: None,
    })
    .unwrap();
    let plain = Tif::new(offsets, kernel).unwrap();
    assert!(one.variation().is_none());
    let of = |tif: &Tif| gridded::removal_nm(&motion(3), tif, &map).unwrap().0;
    assert_eq!(of(&one), of(&plain));
}

#[test]
fn a_rate_that_rises_along_a_line_has_a_closed_form() {
    // a(p) = 1 + 0.02 x, along an infinite line at the feedrate v: the removal at x is that of the constant tool times
    // 1 + 0.02 (x - m), m the mean offset x - p of the removal, 0 for a symmetric tool.
    let offsets = Grid { x: axis(-3.0, 0.25, 25), y: axis(-3.0, 0.25, 25) };
    let positions = Grid { x: axis(-20.0, 10.0, 7), y: axis(-20.0, 10.0, 5) };
    let given = |weight: Array2<f64>| VaryingTif {
        offsets,
        kernels: vec![kernels(&offsets).swap_remove(0)],
        positions,
        weights: vec![weight],
        azimuth: None,
        heading: None,
        pixels: None,
        time: None,
    };
    let rising = Tif::varying(given(samples(&positions, |x, _| 1.0 + 0.02 * x))).unwrap();
    let constant = Tif::varying(given(Array2::ones(positions.shape()))).unwrap();
    let map = Grid { x: axis(0.0, 0.25, 41), y: axis(0.0, 0.25, 29) };
    let line = [[-10.0, 2.0, 0.0, 0.0], [3.3, 0.0, 0.0, 0.0]];
    let motion = Trajectory::new(vec![0.0, 15.0], vec![line], vec![true], vec![Some(0)]).unwrap();
    let of = |tif: &Tif| gridded::removal_nm(&motion, tif, &map).unwrap().0;
    let (rising, constant) = (of(&rising), of(&constant));
    for ((r, c), v) in rising.indexed_iter() {
        let expected = constant[[r, c]] * (1.0 + 0.02 * map.x.coordinate_mm(c));
        // Rounding of transforms of numbers of order 100.
        assert!((v - expected).abs() < 1e-11, "{r} {c}: {v} {expected}");
    }
}

#[test]
fn a_known_wear_is_the_integral_of_its_factor() {
    // A tool at rest for 8 s with the factor 1 - 0.05 t removes for 8 - 0.025 * 64 = 6.4 s.
    let offsets = Grid { x: axis(-3.0, 0.25, 25), y: axis(-3.0, 0.25, 25) };
    let positions = Grid { x: axis(0.0, 5.0, 3), y: axis(0.0, 5.0, 3) };
    let kernel = kernels(&offsets).swap_remove(0);
    let tif = Tif::varying(VaryingTif {
        offsets,
        kernels: vec![kernel.clone()],
        positions,
        weights: vec![Array2::ones((3, 3))],
        azimuth: None,
        heading: None,
        pixels: None,
        time: Some(TimeFactor { time_s: vec![0.0, 10.0], factor: vec![1.0, 0.5] }),
    })
    .unwrap();
    let rest = [[5.0, 0.0, 0.0, 0.0], [4.0, 0.0, 0.0, 0.0]];
    let motion = Trajectory::new(vec![0.0, 8.0], vec![rest], vec![true], vec![Some(0)]).unwrap();
    let map = Grid { x: axis(0.0, 0.25, 41), y: axis(0.0, 0.25, 29) };
    for settings in [SimulationSettings::Gridded, SimulationSettings::Direct { steps: 1 }] {
        let removal =
            SimulationPlan::new(&tif, &map, settings).unwrap().removal_nm(&motion).unwrap().0;
        let centre = removal[[16, 20]];
        // Rounding.
        assert!((centre / (6.4 * kernel[[12, 12]]) - 1.0).abs() < 1e-12, "{centre}");
    }
}
