//! Lower bounds of the residual on any path against dense problems, plans and a closed form.

use ndarray::{Array1, Array2};
use planish_dwell::{
    bounded_least_squares::{BoundedSettings, solve},
    columns::Columns,
    path_free_bound::{BoundSettings, PathFreeBounds, bounds_on_any_path},
};
use planish_numerics::qp::nnls::nnls;
use planish_types::{Axis, Grid, Surface, Tif, ToolPath};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn square(half: f64, step: f64) -> Grid {
    let axis = Axis::new(-half, step, (2.0 * half / step).round() as usize + 1).unwrap();
    Grid { x: axis, y: axis }
}

/// Returns a Gaussian TIF of `peak` nm/s with this sigma out to `half`, mm, that ends in a step.
fn gaussian(peak: f64, sigma_mm: f64, half: f64, step: f64) -> Tif {
    let g = square(half, step);
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let squared = g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2);
        peak * (-0.5 * squared / (sigma_mm * sigma_mm)).exp()
    });
    Tif::new(g, rate).unwrap()
}

fn bounds(desired: &Surface, tif: &Tif, time_s: &[f64]) -> PathFreeBounds {
    let settings = BoundSettings { time_s: time_s.to_vec(), ..BoundSettings::default() };
    bounds_on_any_path(desired, tif, &settings).unwrap()
}

/// Returns the columns of the valid pixels without their means (pixels, places), and the desired removal without its
/// mean, by the definition of the TIF.
fn dense(desired: &Surface, tif: &Tif, places: &[[f64; 2]]) -> (Array2<f64>, Array1<f64>) {
    let g = desired.grid();
    let valid: Vec<(usize, usize)> = desired
        .height_nm()
        .indexed_iter()
        .filter(|(_, z)| !z.is_nan())
        .map(|(index, _)| index)
        .collect();
    let mut k = Array2::from_shape_fn((valid.len(), places.len()), |(i, j)| {
        let ((r, c), [x, y]) = (valid[i], places[j]);
        tif.rate_at(g.x.coordinate_mm(c) - x, g.y.coordinate_mm(r) - y)
    });
    for mut column in k.columns_mut() {
        let mean = column.mean().unwrap();
        column -= mean;
    }
    let z: Array1<f64> = valid.iter().map(|index| desired.height_nm()[*index]).collect();
    let mean = z.mean().unwrap();
    (k, z - mean)
}

/// Returns the run time and the residual RMS of the best dwell times at a dense grid of places for a price `lambda`, in
/// half the mean square of the residual.
fn dense_optimum(desired: &Surface, tif: &Tif, places: &[[f64; 2]], lambda: f64) -> (f64, f64) {
    let (k, z) = dense(desired, tif, places);
    let n = z.len() as f64;
    let h = k.t().dot(&k);
    let g = k.t().dot(&z) - lambda * n;
    let found = nnls(&h, g.as_slice().unwrap(), 1e-12, 10_000, |_| ());
    let t = Array1::from_vec(found.value);
    let residual = &z - &k.dot(&t);
    (t.sum(), (residual.dot(&residual) / n).sqrt())
}

/// Returns a TIF that falls smoothly to zero at `half` mm: `peak (1 - r^2 / half^2)^4`, nm/s.
fn bell(peak: f64, half: f64, step: f64) -> Tif {
    let g = square(half, step);
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let squared = g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2);
        peak * (1.0 - squared / (half * half)).max(0.0).powi(4)
    });
    Tif::new(g, rate).unwrap()
}

/// Returns a map of 16 x 12 pixels of 0.25 mm with random waves, and some invalid pixels. Every fifth tool ends in a
/// step.
fn random_map(seed: u64) -> (Surface, Tif) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let step = 0.25;
    let g = Grid { x: Axis::new(0.0, step, 16).unwrap(), y: Axis::new(0.0, step, 12).unwrap() };
    let waves: Vec<[f64; 4]> = (0..6)
        .map(|_| {
            let amplitude = rng.random_range(0.5..4.0);
            [
                amplitude,
                rng.random_range(0.2..2.0),
                rng.random_range(0.2..2.0),
                rng.random_range(0.0..6.0),
            ]
        })
        .collect();
    let mut height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
        let sum: f64 = waves.iter().map(|[a, u, v, p]| a * (u * x + v * y + p).sin()).sum();
        sum + rng.random_range(-0.3..0.3)
    });
    for _ in 0..seed % 4 {
        height[[rng.random_range(0..12), rng.random_range(0..16)]] = f64::NAN;
    }
    let peak = rng.random_range(2.0..9.0);
    // Every third TIF has another pitch than the map, and is sampled anew.
    let pitch = if seed.is_multiple_of(3) { 0.17 } else { step };
    let tif = if seed.is_multiple_of(5) {
        gaussian(peak, rng.random_range(0.6..0.9), 9.0 * pitch, pitch)
    } else {
        bell(peak, 9.0 * pitch, pitch)
    };
    (Surface::new(g, height).unwrap(), tif)
}

#[test]
fn no_dense_optimum_is_below_the_bound() {
    for seed in 0..20 {
        let (desired, tif) = random_map(seed);
        let on_lattice = tif.on_lattice_of(desired.grid(), 1e-4).unwrap().tif;
        // Places that are on no lattice of the method.
        let mut rng = ChaCha8Rng::seed_from_u64(1000 + seed);
        let shift = [rng.random_range(0.0..0.3), rng.random_range(0.0..0.3)];
        let places: Vec<[f64; 2]> = (0..21 * 17)
            .map(|k| {
                let i = f64::from(k % 21);
                let j = f64::from(k / 21);
                [0.31 * i - 1.3 + shift[0], 0.31 * j - 1.2 + shift[1]]
            })
            .collect();
        let (time_s, rms_nm) = dense_optimum(&desired, &on_lattice, &places, 2e-3);
        let bound = bounds(&desired, &tif, &[time_s]).bounds[0];
        // The bound is a proof: only rounding is allowed.
        assert!(
            bound.bound_rms_nm <= rms_nm * (1.0 + 1e-9),
            "seed {seed}: {bound:?}, a plan of {time_s} s leaves {rms_nm}"
        );
        assert!(bound.bound_rms_nm <= bound.reached_rms_nm, "seed {seed}: {bound:?}");
    }
}

#[test]
fn a_bound_falls_with_the_time_and_holds_at_other_times() {
    let (desired, tif) = random_map(1);
    let times_s = [2.0, 4.0, 8.0];
    let found = bounds(&desired, &tif, &times_s).bounds;
    for pair in found.windows(2) {
        assert!(pair[1].reached_rms_nm < pair[0].reached_rms_nm, "{pair:?}");
        assert!(pair[1].bound_rms_nm < pair[0].bound_rms_nm, "{pair:?}");
    }
    // Every bound holds at every time.
    for (bound, reached) in found.iter().flat_map(|a| found.iter().map(move |b| (a, b))) {
        let there = bound.at_time_nm(reached.time_s);
        assert!(there <= reached.reached_rms_nm, "{bound:?} {reached:?}");
    }
}

#[test]
fn a_bound_of_a_long_time_holds_at_a_short_one() {
    let (desired, tif) = random_map(1);
    let [short, long] = bounds(&desired, &tif, &[2.0, 1e5]).bounds[..] else { panic!("two times") };
    assert!(long.at_time_nm(2.0) <= short.reached_rms_nm, "{long:?} {short:?}");
}

#[test]
fn a_price_and_its_time_have_the_same_bound() {
    let (desired, tif) = random_map(2);
    let settings = BoundSettings { time_weight_nm2_per_s: vec![2e-3], ..BoundSettings::default() };
    let by_price = bounds_on_any_path(&desired, &tif, &settings).unwrap().bounds[0];
    let by_time = bounds(&desired, &tif, &[by_price.time_s]).bounds[0];
    // Both are within their gaps of the same number.
    let apart = (by_price.bound_rms_nm / by_time.bound_rms_nm - 1.0).abs();
    assert!(apart <= by_price.gap + by_time.gap, "{by_price:?} {by_time:?}");
}

#[test]
fn a_dimple_of_the_tool_takes_its_dwell_time() {
    // z = t R(x - p): with T < t seconds the least residual is (t - T) times the RMS of R without its mean, from a stay
    // at p, because R without its mean is nowhere more like itself than at p.
    let g = square(4.0, 0.25);
    let tif = gaussian(5.0, 0.8, 2.5, 0.25);
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| {
        7.0 * tif.rate_at(g.x.coordinate_mm(c), g.y.coordinate_mm(r))
    });
    let desired = Surface::new(g, height).unwrap();
    let found = bounds(&desired, &tif, &[4.0]);
    let exact = found.desired_rms_nm * (7.0 - 4.0) / 7.0;
    let bound = found.bounds[0];
    assert!(bound.bound_rms_nm <= exact * (1.0 + 1e-9), "{bound:?} {exact}");
    // The splines see the step of the TIF at its edge poorly: a regression bound.
    assert!(bound.bound_rms_nm > 0.97 * exact, "{bound:?} {exact}");
    assert!((bound.reached_rms_nm / exact - 1.0).abs() < 0.02, "{bound:?} {exact}");
}

#[test]
fn no_plan_along_a_raster_is_below_the_bound() {
    let (desired, tif) = random_map(5);
    let points: Vec<[f64; 2]> = (0..9)
        .flat_map(|j| {
            let y = 0.75 * f64::from(j) - 0.8;
            (0..16).map(move |i| [0.5 * f64::from(if j % 2 == 0 { i } else { 15 - i }) - 0.8, y])
        })
        .collect();
    let n = points.len() - 1;
    let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
    for time_weight_nm2_per_s in [1e-4, 1e-3, 1e-2] {
        let settings = BoundedSettings {
            columns: Columns::Segment,
            time_weight_nm2_per_s,
            ..BoundedSettings::default()
        };
        let plan = solve(&desired, &tif, &path, None, &settings).unwrap().report;
        let bound = bounds(&desired, &tif, &[plan.total_time_s]).bounds[0];
        assert!(bound.bound_rms_nm < plan.model_rms_nm, "{bound:?} {plan:?}");
    }
}

#[test]
fn refusals_name_the_setting() {
    let (desired, tif) = random_map(1);
    let refusal = |time_s: Vec<f64>| {
        let settings = BoundSettings { time_s, ..BoundSettings::default() };
        bounds_on_any_path(&desired, &tif, &settings).unwrap_err().to_string()
    };
    assert!(refusal(Vec::new()).contains("time_s"), "{}", refusal(Vec::new()));
    for bad in [0.0, -1.0, f64::NAN] {
        let message = refusal(vec![3.0, bad]);
        assert!(message.contains("time_s[1]"), "{message}");
    }
}

/// On a strip of three rows, splines at the distance of a pixel depend on each other. At long times the equations were
/// singular, and the bound was 0.
#[test]
fn a_strip_has_a_bound_at_a_long_time() {
    let step = 0.5;
    let g = Grid { x: Axis::new(0.0, step, 60).unwrap(), y: Axis::new(0.0, 1.5, 3).unwrap() };
    let mut rng = ChaCha8Rng::seed_from_u64(69);
    let height = Array2::from_shape_fn(g.shape(), |(_, c)| {
        3.0 * (0.4 * g.x.coordinate_mm(c)).sin() + rng.random_range(-0.3..0.3)
    });
    let desired = Surface::new(g, height).unwrap();
    let tif = gaussian(8.0, 1.5, 4.5, step);
    let found = bounds(&desired, &tif, &[10.0, 40.0, 100.0]);
    for bound in &found.bounds {
        // The goal of the bound is a gap of 1 %. With 60 columns of noise of 0.17 nm RMS, half of it stays on any path.
        assert!(bound.gap < 0.01, "{bound:?}");
        assert!(bound.bound_rms_nm > 0.05, "{bound:?}");
    }
    let reached: Vec<f64> = found.bounds.iter().map(|bound| bound.reached_rms_nm).collect();
    assert!(reached.is_sorted_by(|a, b| a >= b), "{reached:?}");
}

/// The lattice of places had one row and one column less, because their offsets in steps of the map were off by 1e-6:
/// beside the places the adjoint was 33 % higher than at them on a measured mirror.
#[test]
fn steps_that_differ_by_their_rounding_have_the_same_bound() {
    let (desired, _) = random_map(3);
    let step = desired.grid().x.step_mm();
    let [same, rounded] = [step, step * (1.0 - 2e-7)]
        .map(|step| bounds(&desired, &gaussian(8.0, 1.0, 9.0 * step, step), &[4.0]).bounds[0]);
    // The tool is 2e-7 narrower, and ends in a step of 8 % of its peak; the rounds end at 1e-3.
    assert!((rounded.bound_rms_nm / same.bound_rms_nm - 1.0).abs() < 1e-3, "{same:?} {rounded:?}");
    // The goal of the bound is a gap of 1 %.
    assert!(rounded.gap < 0.01, "{rounded:?}");
}

/// The edge of these TIFs is beyond their last sample by 1e-15 of a step, which ended in a panic.
#[test]
fn an_edge_beyond_the_last_sample_by_rounding_is_at_it() {
    let g = Grid { x: Axis::new(1.9, 0.3, 13).unwrap(), y: Axis::new(-2.3, 0.3, 9).unwrap() };
    let height = Array2::from_shape_fn(g.shape(), |(r, c)| ((3 * r + 5 * c) as f64).sin());
    let desired = Surface::new(g, height).unwrap();
    for pitch in [0.6, 0.45, 0.15, 0.2, 0.25, 0.4, 0.7] {
        let tif = gaussian(4.0, 1.0, 4.0 * pitch, pitch);
        let on_lattice = tif.on_lattice_of(&g, 1e-4).unwrap().tif;
        let axes = [on_lattice.grid().x, on_lattice.grid().y];
        for (edge_mm, samples) in on_lattice.edge_mm().into_iter().zip(axes) {
            let beyond = (edge_mm - samples.end_mm()) / samples.step_mm();
            // SNAP of Keys' interpolation.
            assert!(beyond == 0.0 || beyond > 1e-9, "{pitch} mm: {beyond} steps");
        }
        let bound = bounds(&desired, &tif, &[0.05]).bounds[0];
        assert!(
            bound.bound_rms_nm > 0.0 && bound.bound_rms_nm <= bound.reached_rms_nm,
            "{bound:?}"
        );
    }
}
