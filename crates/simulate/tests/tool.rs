//! The TIF that errors move, and how a prediction depends on what is between the samples of a TIF, against tools that are
//! known everywhere.

use ndarray::Array2;
use planish_simulate::{
    SimulationSettings,
    between::Between,
    deviation::Deviation,
    error_budget::Scalar,
    runs::Runs,
    simulate,
    tool::{moved, smooth},
};
use planish_types::{Axis, Grid, Surface, Tif, Trajectory, TrajectoryBuilder};

fn grid(half_mm: f64, step_mm: f64) -> Grid {
    let n = (half_mm / step_mm).round();
    let axis = Axis::new(-n * step_mm, step_mm, 2 * n as usize + 1).unwrap();
    Grid { x: axis, y: axis }
}

fn tif(grid: Grid, rate: impl Fn(f64, f64) -> f64) -> Tif {
    let at = |(r, c)| rate(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
    Tif::new(grid, Array2::from_shape_fn(grid.shape(), at)).unwrap()
}

/// Makes a map of 24 x 16 mm in pixels of 0.2 mm, with waves of several lengths.
fn map() -> Surface {
    let axis = |n| Axis::new(0.0, 0.2, n).unwrap();
    let grid = Grid { x: axis(121), y: axis(81) };
    let height = |(r, c)| {
        let (x, y): (f64, f64) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
        30.0 + 5.0 * (0.7 * x).sin() * (0.5 * y).cos() + 0.1 * x * y
    };
    Surface::new(grid, Array2::from_shape_fn(grid.shape(), height)).unwrap()
}

/// Makes lines 0.8 mm apart, from 6 mm before the map to 6 mm beyond, each in pieces of 1 mm of their own feed.
fn raster() -> Trajectory {
    let mut motion = TrajectoryBuilder::default();
    for line in 0..36 {
        let y = 0.8 * f64::from(line) - 6.0;
        for k in 0..36 {
            let (from, way) = if line % 2 == 0 { (k, 1.0) } else { (36 - k, -1.0) };
            let from = f64::from(from) - 6.0;
            let h = 0.3 + 0.1 * (0.7 * from).sin() * (0.5 * y).cos();
            motion.push(h, [[from, way / h, 0.0, 0.0], [y, 0.0, 0.0, 0.0]], true, None);
        }
    }
    motion.build().unwrap()
}

fn rms(map: &Array2<f64>) -> f64 {
    let mean = map.mean().unwrap();
    map.mapv(|v| (v - mean).powi(2)).mean().unwrap().sqrt()
}

/// Returns what the error `effect` of the size `size` adds to the removal on the raster, nm, if the TIF is `moved`.
fn added(moved: &Tif, effect: Scalar, size: f64) -> Array2<f64> {
    let map = map();
    let runs = Runs::new(&raster(), moved, moved, map.grid()).unwrap();
    let mut run = Deviation::default();
    run.add(effect, size);
    runs.moved_nm(&run).unwrap() - &runs.unchanged
}

const SIGMA: [f64; 2] = [1.7, 1.4];

fn gaussian(x: f64, y: f64) -> f64 {
    8.0 * (-0.5 * ((x / SIGMA[0]).powi(2) + (y / SIGMA[1]).powi(2))).exp()
}

/// Errors of a ring that ends within its samples are those of the ring without any smoothing.
#[test]
fn errors_of_the_shape_of_a_tool_that_ends_by_itself_are_those_of_the_tool() {
    let ring = |x: f64, y: f64| {
        let r = (1.1 * x).hypot(0.9 * y);
        if (r - 2.0).abs() < 1.0 { 5.0 * (1.0 - (r - 2.0).powi(2)).powi(2) } else { 0.0 }
    };
    let tool = tif(grid(4.4, 0.1), ring);
    let smooth = smooth(&tool, tool.width_mm()).unwrap();
    for effect in [
        Scalar::TifWidth,
        Scalar::TifEllipticity,
        Scalar::TifDiagonalEllipticity,
        Scalar::TifRotation,
    ] {
        let (truth, found) = (added(&tool, effect, 0.01), added(&smooth, effect, 0.01));
        let apart = rms(&(&found - &truth)) / rms(&truth);
        println!("{effect:?}: {} nm, apart by {apart}", rms(&truth));
        // Regression bound: quadratics over half the width of the ring.
        assert!(apart < 0.15, "{effect:?}: {apart}");
    }
}

/// A spot whose measurement ended at 4.7 % of the peak changes what the whole spot changes: it is stretched after it is led
/// to zero. Stretched before, its border would stand still while the tool grows, and half of the change would be lost.
#[test]
fn errors_of_the_shape_of_a_spot_that_was_cut_are_nearly_those_of_the_whole_spot() {
    let whole = tif(grid(8.0, 0.1), gaussian);
    let cut = tif(grid(4.2, 0.1), gaussian);
    let cut = smooth(&cut, cut.width_mm()).unwrap();
    for effect in [Scalar::TifWidth, Scalar::TifEllipticity, Scalar::TifRotation] {
        let (truth, found) = (added(&whole, effect, 0.01), added(&cut, effect, 0.01));
        let ratio = rms(&found) / rms(&truth);
        println!("{effect:?}: {} nm, of the cut spot {ratio} of it", rms(&truth));
        // Between the second moment that the fade leaves and what the cut has lost.
        assert!((0.8..1.05).contains(&ratio), "{effect:?}: {ratio}");
    }
}

/// Tests a TIF on other pixels than those of the map: sampled on these, errors add the same to within 1 %.
#[test]
fn a_tif_that_is_sampled_anew_adds_the_same() {
    let fine = tif(grid(7.0, 0.07), gaussian);
    let anew = moved(&fine, map().grid(), false).unwrap();
    // Rounding of coordinates.
    assert!((anew.tif.grid().x.step_mm() / 0.2 - 1.0).abs() < 1e-12);
    // Keys' convolution of a Gaussian of seven samples per sigma.
    assert!(
        anew.resampling_error > 0.0 && anew.resampling_error < 1e-3,
        "{}",
        anew.resampling_error
    );
    let smooth = smooth(&fine, fine.width_mm()).unwrap();
    for effect in [Scalar::TifWidth, Scalar::OffsetX] {
        let (a, b) = (added(&smooth, effect, 0.01), added(&anew.tif, effect, 0.01));
        let apart = rms(&(&b - &a)) / rms(&a);
        // Regression bound: 2.1e-3 of what a width adds, whose derivative errs more than the TIF.
        assert!(apart < 0.01, "{effect:?}: {apart}");
    }
    // As sampled is as sampled.
    let same = moved(&fine, map().grid(), true).unwrap();
    assert_eq!(same.tif.rate_nm_per_s(), fine.rate_nm_per_s());
    // A TIF on the pixels of the map stays on them.
    let own = moved(&anew.tif, map().grid(), false).unwrap();
    assert_eq!(own.resampling_error, 0.0);
}

/// Compares the stated change of the residual by straight lines between the samples with that of a TIF that has them.
#[test]
fn the_change_by_straight_lines_is_that_of_a_tif_with_straight_lines() {
    let pad = |x: f64, y: f64| if x.hypot(y) <= 0.8 { 60.0 } else { 0.0 };
    let fine = |coarse: &Tif, parts: usize| {
        let axis = coarse.grid().x;
        let finer =
            Axis::new(axis.start_mm(), axis.step_mm() / parts as f64, (axis.len() - 1) * parts + 1);
        let grid = Grid { x: finer.clone().unwrap(), y: finer.unwrap() };
        let rate = coarse.rate_nm_per_s();
        let at = |(r, c): (usize, usize)| {
            let split = |i: usize| (i / parts).min(axis.len() - 2);
            let (j, i) = (split(r), split(c));
            let (v, u) =
                ((r - j * parts) as f64 / parts as f64, (c - i * parts) as f64 / parts as f64);
            (1.0 - v) * ((1.0 - u) * rate[[j, i]] + u * rate[[j, i + 1]])
                + v * ((1.0 - u) * rate[[j + 1, i]] + u * rate[[j + 1, i + 1]])
        };
        Tif::new(grid, Array2::from_shape_fn(grid.shape(), at)).unwrap()
    };
    let residual = |tif: &Tif| {
        let prediction = simulate(&raster(), tif, &map(), SimulationSettings::Gridded).unwrap();
        let between = Between::new(&raster(), tif, &prediction.removal).unwrap();
        (prediction.removal.residual().statistics().rms, between)
    };
    let coarse = tif(grid(1.2, 0.12), pad);
    let (cubic, found) = residual(&coarse);
    let (straight, _) = residual(&fine(&coarse, 8));
    let change = straight / cubic - 1.0;
    println!("{cubic} nm, {straight} nm: {change}, {found:?}");
    assert!((found.residual_change - change).abs() < 3.0 * found.standard_error + 1e-3);
    assert!(found.warning().is_some_and(|w| w.contains("smaller pitch")) == (change.abs() > 0.01));
    // The threshold of the warning, here as the setup.
    assert!(change.abs() > 0.01);
    // Of a tool that is smooth over its samples nothing depends on it.
    let (_, smooth) = residual(&tif(grid(7.0, 0.1), gaussian));
    assert_eq!(smooth.warning(), None, "{smooth:?}");
}
