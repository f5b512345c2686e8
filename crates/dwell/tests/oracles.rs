//! Bounded least squares against planted solutions, invariances and its second algorithm.

use ndarray::{Array2, s};
use planish_dwell::{
    DwellError,
    bounded_least_squares::{Bound, Free, Program, Settings, Solution, solve, solve_columns},
    columns::{Columns, patches},
};
use planish_types::{Axis, Grid, Surface, Tif, ToolPath};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn grid() -> Grid {
    Grid { x: Axis::new(0.0, 0.25, 41).unwrap(), y: Axis::new(0.0, 0.25, 29).unwrap() }
}

/// Bell of 3.25 mm radius (2.2 mm wide at half its height) on the pixels of the map.
fn tif() -> Tif {
    let a = Axis::new(-3.25, 0.25, 27).unwrap();
    let g = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.at(c) / 3.25, g.y.at(r) / 3.25);
        8.0 * (1.0 - x * x - y * y).max(0.0).powi(6)
    });
    Tif::new(g, rate).unwrap()
}

/// Boustrophedon of 1 mm over the map and `over` mm beyond.
fn path(over: f64) -> ToolPath {
    let (nx, ny) = ((10.0 + 2.0 * over) as usize, (7.0 + 2.0 * over) as usize);
    let mut points = Vec::new();
    for j in 0..=ny {
        for i in 0..=nx {
            let i = if j % 2 == 0 { i } else { nx - i };
            points.push([i as f64 - over, j as f64 - over]);
        }
    }
    let n = points.len() - 1;
    ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
}

/// B t.
fn removal(path: &ToolPath, columns: Columns, t: &[f64]) -> Array2<f64> {
    let mut out = Array2::zeros(grid().shape());
    for (p, t) in patches(&columns.places(path), &tif(), &grid()).iter().zip(t) {
        let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
        out.slice_mut(s![r..r + ny, c..c + nx]).scaled_add(*t, &p.rate_nm_per_s);
    }
    out
}

fn random(n: usize, low: f64, high: f64, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..n).map(|_| rng.random_range(low..high)).collect()
}

fn surface(height: Array2<f64>) -> Surface {
    Surface::new(grid(), height).unwrap()
}

/// A smooth desired removal of some 10 nm.
fn bowl() -> Array2<f64> {
    let g = grid();
    Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.at(c) - 4.0, g.y.at(r) - 3.0);
        30.0 + 0.6 * x * x - 0.3 * x * y + 0.4 * y * y + 3.0 * (1.3 * x).sin()
    })
}

fn settings() -> Settings {
    // The certificate to rounding; a plan is content with less.
    let (tolerance_s, relative_gap) = (1e-11, 0.0);
    let min_dwell = Bound::Seconds(0.05);
    Settings { min_dwell, tolerance_s, relative_gap, ..Settings::default() }
}

fn run(desired: &Surface, path: &ToolPath, settings: &Settings) -> Solution {
    solve(desired, &tif(), path, None, settings).unwrap()
}

fn apart(a: &Solution, b: &Solution) -> f64 {
    let pairs = a.dwell.dwell_s().iter().zip(b.dwell.dwell_s());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn the_removal_of_a_planted_dwell_is_recovered() {
    for columns in [Columns::Point, Columns::Segment] {
        let path = path(0.0);
        let planted = random(path.len(), 0.5, 2.0, 1);
        let desired = surface(removal(&path, columns, &planted));
        let exact = Settings { columns, tikhonov: 1e-12, smoothness: 0.0, ..settings() };
        let found = run(&desired, &path, &exact);
        // What is left is the regularisation: 1e-12 of the largest column energy.
        assert!(found.report.model_rms_nm < 1e-5, "{:?}", found.report);
        assert!(found.report.kkt_residual_s < 1e-8, "{:?}", found.report);
    }
}

#[test]
fn the_certificate_holds_by_an_independent_computation() {
    let (path, desired) = (path(3.0), surface(bowl()));
    let found = run(&desired, &path, &settings());
    assert_eq!(found.report.end, "optimal");
    assert!(found.report.at_lower_bound > 0, "the bound is not active: {:?}", found.report);
    // Gradient of the objective from its definition: residual with the mean removed, penalties.
    let t = found.dwell.dwell_s();
    let b = patches(&Columns::Segment.places(&path), &tif(), &grid());
    let mut residual = bowl() - removal(&path, Columns::Segment, t);
    let mean = residual.mean().unwrap();
    residual -= mean;
    let total = residual.len() as f64;
    let energy: Vec<f64> = b
        .iter()
        .map(|p| {
            let sum = p.rate_nm_per_s.sum();
            p.rate_nm_per_s.mapv(|v| v * v).sum() - sum * sum / total
        })
        .collect();
    let d = energy.iter().copied().fold(0.0, f64::max);
    let (alpha, beta) = (1e-5 * d, 1e-2 * d);
    for j in 0..path.len() {
        let ((r, c), (ny, nx)) = (b[j].origin, b[j].rate_nm_per_s.dim());
        let data = (&residual.slice(s![r..r + ny, c..c + nx]) * &b[j].rate_nm_per_s).sum();
        // All segments have the same length, so q = t.
        let before = if j > 0 { t[j] - t[j - 1] } else { 0.0 };
        let after = if j + 1 < t.len() { t[j] - t[j + 1] } else { 0.0 };
        let gradient = -data + alpha * (t[j] - 0.05) + beta * (before + after);
        if energy[j] <= 1e-9 * d {
            assert_eq!(t[j], 0.05, "a dead column stays at its bound");
        } else if t[j] > 0.05 {
            assert!(gradient.abs() < 1e-9 * d, "free {j}: {gradient}");
        } else {
            assert!(gradient > -1e-9 * d, "at the bound {j}: {gradient}");
        }
    }
}

#[test]
fn both_algorithms_give_the_same_dwell() {
    // Exact columns against the FFT operator: this TIF ends with the sixth power of the distance,
    // so what the operator leaks over its border is (2 * 0.25 / 3.25)^6 = 1e-5 of the peak.
    let (path, desired) = (path(2.0), surface(bowl()));
    let dense = run(&desired, &path, &settings());
    let by_fft = Settings {
        max_factorised_points: 0,
        tolerance_s: 1e-7,
        max_iterations: 20_000,
        ..settings()
    };
    let by_fft = run(&desired, &path, &by_fft);
    assert_eq!(dense.report.algorithm, "active-set");
    assert_eq!(by_fft.report.algorithm, "projected-gradient");
    let rms = by_fft.report.model_rms_nm;
    assert!((rms / dense.report.model_rms_nm - 1.0).abs() < 1e-2, "{rms} {:?}", dense.report);
    assert!(apart(&dense, &by_fft) < 1e-2, "{}", apart(&dense, &by_fft));
    assert_eq!(dense.report.dead, by_fft.report.dead);
}

#[test]
fn a_piston_changes_nothing_and_more_room_never_hurts() {
    let path = path(2.0);
    let a = run(&surface(bowl()), &path, &settings());
    let b = run(&surface(bowl() + 1000.0), &path, &settings());
    // 1000 nm cost two digits of the heights.
    assert!(apart(&a, &b) < 1e-8, "{}", apart(&a, &b));
    let bounded = |low: f64, high: f64| {
        let free = Settings {
            min_dwell: Bound::Seconds(low),
            max_dwell: Some(Bound::Seconds(high)),
            tikhonov: 1e-9,
            smoothness: 0.0,
            ..settings()
        };
        run(&surface(bowl()), &path, &free)
    };
    let (tight, wide) = (bounded(0.3, 0.9), bounded(0.1, 3.0));
    let rms = |s: &Solution| s.report.model_rms_nm;
    assert!(rms(&tight) > 1.01 * rms(&wide), "{:?} {:?}", tight.report, wide.report);
    assert!(tight.report.at_upper_bound > 0 && tight.report.at_lower_bound > 0);
    assert!(tight.dwell.dwell_s().iter().all(|t| (0.3..=0.9).contains(t)));
}

#[test]
fn invalid_and_weightless_pixels_do_not_count() {
    let path = path(2.0);
    let clean = run(&surface(bowl()), &path, &settings());
    // A pit of -500 nm: NaN, weight 0, or (wrongly) believed.
    let mut pit = bowl();
    pit.slice_mut(s![10..13, 20..23]).fill(-500.0);
    let mut masked = pit.clone();
    masked.slice_mut(s![10..13, 20..23]).fill(f64::NAN);
    let by_nan = run(&surface(masked), &path, &settings());
    let mut weight = Array2::ones(grid().shape());
    weight.slice_mut(s![10..13, 20..23]).fill(0.0);
    let by_weight =
        solve(&surface(pit.clone()), &tif(), &path, Some(&weight), &settings()).unwrap();
    let believed = run(&surface(pit), &path, &settings());
    assert!(apart(&by_nan, &by_weight) < 1e-10);
    assert!(apart(&by_nan, &clean) < 0.05, "{}", apart(&by_nan, &clean));
    assert!(apart(&believed, &clean) > 0.5, "{}", apart(&believed, &clean));
    // Equal weights other than 1 are no weights.
    let twos = Array2::from_elem(grid().shape(), 2.0);
    let doubled = solve(&surface(bowl()), &tif(), &path, Some(&twos), &settings()).unwrap();
    assert!(apart(&doubled, &clean) < 1e-10);
}

#[test]
fn lifted_segments_keep_their_bound_and_unreached_pixels_are_counted() {
    let full = path(2.0);
    // Lift the tool on the left half: its pixels further than the TIF are out of reach.
    let on: Vec<bool> = full.dwell_point_mm().iter().map(|p| p[0] > 5.0).collect();
    let path = ToolPath::through(full.point_mm().to_vec(), on.clone(), vec![0; on.len()]).unwrap();
    let found = run(&surface(bowl()), &path, &settings());
    let t = found.dwell.dwell_s();
    assert!((0..on.len()).filter(|j| !on[*j]).all(|j| t[j] == 0.05));
    // The first tool position is a Gauss node at 5.1127 mm, the TIF reaches 3.25 mm; next to its
    // edge it is below the floor at which a pixel counts as reached.
    let columns =
        |reach: f64| grid().x.coordinates().iter().filter(|x| **x < 5.1127 - reach).count();
    let unreached = found.report.unreached_pixels;
    assert!(unreached >= columns(3.25) * 29 && unreached <= columns(2.75) * 29, "{unreached}");
}

#[test]
fn contradictions_are_refused() {
    let (path, desired) = (path(0.0), surface(bowl()));
    let message = |s: Settings| solve(&desired, &tif(), &path, None, &s).unwrap_err().to_string();
    let crossing = Settings { max_dwell: Some(Bound::Seconds(0.01)), ..settings() };
    assert!(message(crossing).contains("max_dwell[0]: is 0.01 s, below the lower bound of 0.05 s"));
    let negative = Settings { min_dwell: Bound::SecondsPerMm(-1.0), ..settings() };
    assert!(message(negative).contains("min_dwell: is -1"));
    assert!(message(Settings { huber_nm: Some(0.0), ..settings() }).contains("huber_nm: is 0"));
    let noiseless = Settings { noise_rms_nm: Some(f64::NAN), ..settings() };
    assert!(message(noiseless).contains("noise_rms_nm: is NaN"));
    assert!(message(Settings { tikhonov: f64::NAN, ..settings() }).contains("tikhonov: is NaN"));
    let far: Vec<[f64; 2]> = path.point_mm().iter().map(|p| [p[0] + 1e3, p[1]]).collect();
    let far = ToolPath::through(far, vec![true; path.len()], vec![0; path.len()]).unwrap();
    let error = solve(&desired, &tif(), &far, None, &settings()).unwrap_err();
    assert!(matches!(error, DwellError::OutOfReach { .. }), "{error}");
    let zero = Array2::zeros(grid().shape());
    let error = solve(&desired, &tif(), &path, Some(&zero), &settings()).unwrap_err();
    assert!(error.to_string().contains("weight: is 0 on every valid pixel"));
}

#[test]
fn a_pit_is_left_to_itself_by_the_huber_loss() {
    let path = path(2.0);
    let clean = run(&surface(bowl()), &path, &settings());
    let mut pit = bowl();
    pit.slice_mut(s![10..13, 20..23]).fill(-500.0);
    let squared = run(&surface(pit.clone()), &path, &settings());
    let huber_nm = Some(0.5);
    // A step that lowers 1e3 nm^2 by rounding moves a dwell time by 1e-8 s.
    let robust = run(&surface(pit), &path, &Settings { huber_nm, tolerance_s: 1e-7, ..settings() });
    assert_eq!(robust.report.end, "optimal");
    // Nine of 1189 pixels pull with 0.5 nm in place of 500 nm.
    let (with, without) = (apart(&robust, &clean), apart(&squared, &clean));
    assert!(with < 0.02 * without, "{with} {without}");
    // The gradient of the Huber loss by its definition: what is beyond 0.5 nm pulls with 0.5 nm.
    let t = robust.dwell.dwell_s();
    let b = patches(&Columns::Segment.places(&path), &tif(), &grid());
    let mut pitted = bowl();
    pitted.slice_mut(s![10..13, 20..23]).fill(-500.0);
    let residual = pitted - removal(&path, Columns::Segment, t);
    // The free piston: sum of clip(r - c) = 0, by bisection.
    let (mut low, mut high) = (-1000.0, 1000.0);
    for _ in 0..200 {
        let c = 0.5 * (low + high);
        let sum: f64 = residual.iter().map(|r: &f64| (r - c).clamp(-0.5, 0.5)).sum();
        (low, high) = if sum > 0.0 { (c, high) } else { (low, c) };
    }
    let pull = residual.mapv(|r| (r - low).clamp(-0.5, 0.5));
    let total = pull.len() as f64;
    let energy = b.iter().map(|p| {
        let sum = p.rate_nm_per_s.sum();
        p.rate_nm_per_s.mapv(|v| v * v).sum() - sum * sum / total
    });
    let d = energy.fold(0.0, f64::max);
    for j in (1..path.len() - 1).filter(|j| t[*j] > 0.05) {
        let ((r, c), (ny, nx)) = (b[j].origin, b[j].rate_nm_per_s.dim());
        let data = (&pull.slice(s![r..r + ny, c..c + nx]) * &b[j].rate_nm_per_s).sum();
        let rough = 2.0 * t[j] - t[j - 1] - t[j + 1];
        let gradient = -data + 1e-5 * d * (t[j] - 0.05) + 1e-2 * d * rough;
        assert!(gradient.abs() < 2e-7 * d, "{j}: {gradient} of {d}");
    }
}

#[test]
fn a_free_plane_ignores_a_tilt() {
    let path = path(2.0);
    let g = grid();
    let tilt = Array2::from_shape_fn(g.shape(), |(r, c)| 3.0 * g.x.at(c) - 2.0 * g.y.at(r));
    let free = Settings { free: Free::Plane, ..settings() };
    let a = run(&surface(bowl()), &path, &free);
    let b = run(&surface(bowl() + &tilt), &path, &free);
    assert!(apart(&a, &b) < 1e-8, "{}", apart(&a, &b));
    let c = run(&surface(bowl() + &tilt), &path, &settings());
    assert!(apart(&b, &c) > 0.1, "the tilt is no test");
    assert!(b.report.model_rms_detilted_nm <= c.report.model_rms_detilted_nm);
    // A plane that weights leave undetermined is refused by none: one column of pixels counts.
    let mut weight = Array2::zeros(g.shape());
    weight.slice_mut(s![.., 20]).fill(1.0);
    solve(&surface(bowl()), &tif(), &path, Some(&weight), &free).unwrap();
}

#[test]
fn bounds_point_by_point_hold() {
    let path = path(2.0);
    let lo = random(path.len(), 0.1, 0.4, 3);
    let hi: Vec<f64> = lo.iter().map(|lo| lo + 0.3).collect();
    let places = Columns::Segment.places(&path);
    let program = Program { places: &places, lo: lo.clone(), hi: hi.clone(), guess: None };
    let found =
        solve_columns(&surface(bowl()), &tif(), &path, None, &settings(), &program).unwrap();
    let t = found.dwell.dwell_s();
    assert!((0..t.len()).all(|j| (lo[j]..=hi[j]).contains(&t[j])));
    assert!(found.report.at_lower_bound > 10 && found.report.at_upper_bound > 10);
    assert_eq!(found.report.end, "optimal");
}

#[test]
fn stopping_at_the_noise_is_closer_to_the_true_surface() {
    let path = path(2.0);
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    // 2 nm of noise on a bowl that a smooth dwell removes.
    let smooth: Vec<f64> = path
        .dwell_point_mm()
        .iter()
        .map(|p| 1.0 + 0.3 * (0.5 * p[0]).sin() * (0.4 * p[1]).cos())
        .collect();
    let truth = removal(&path, Columns::Segment, &smooth);
    let noise_nm = 2.0;
    let uniform = rand::distr::Uniform::new(-1.0, 1.0).unwrap();
    let measured = truth.mapv(|z| z + noise_nm * 3.0_f64.sqrt() * rng.sample::<f64, _>(uniform));
    let weak = Settings { smoothness: 1e-6, ..settings() };
    let fitted = run(&surface(measured.clone()), &path, &weak);
    let stopping = Settings { noise_rms_nm: Some(noise_nm), ..weak };
    let stopped = run(&surface(measured), &path, &stopping);
    let missed = |s: &Solution| {
        let left = &truth - &removal(&path, Columns::Segment, s.dwell.dwell_s());
        left.std(0.0)
    };
    let (with, without) = (missed(&stopped), missed(&fitted));
    println!("residual against the truth: {without} nm, stopped at the noise {with} nm");
    assert!(fitted.report.model_rms_nm < 0.98 * noise_nm, "{:?}", fitted.report);
    assert!((0.95..=1.0).contains(&(stopped.report.model_rms_nm / noise_nm)));
    assert!(stopped.report.smoothness > 10.0 * weak.smoothness);
    // Measured: 0.41 nm instead of 0.56 nm.
    assert!(with < 0.8 * without, "{with} {without}");
}

#[test]
fn a_price_on_time_is_its_derivative() {
    // At the optimum of f + L T the fall of f per second is L: between two prices,
    // L1 <= -(f2 - f1) / (T2 - T1) <= L2 with f half the mean square plus the other terms.
    let path = path(2.0);
    let free = Settings { tikhonov: 1e-9, smoothness: 0.0, ..settings() };
    let at = |price: f64| {
        let priced = Settings { time_weight_nm2_per_s: price, ..free };
        let r = run(&surface(bowl()), &path, &priced).report;
        (0.5 * r.model_rms_nm * r.model_rms_nm, r.total_time_s)
    };
    let prices = [1e-4, 1e-3, 1e-2];
    let [a, b, c] = prices.map(at);
    for (k, (low, high)) in [(a, b), (b, c)].into_iter().enumerate() {
        let slope = (high.0 - low.0) / (low.1 - high.1);
        assert!(low.1 > high.1 && (prices[k]..=prices[k + 1]).contains(&slope), "{slope}");
    }
}
