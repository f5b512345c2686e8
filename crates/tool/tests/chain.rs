//! Test of the library's steps one after the other, from two maps of a spot to the formula of the tool.

use ndarray::Array2;
use planish_tool::{
    Alignment, Baseline, SpotSettings, spot,
    tif::{Centre, TifSettings, prepare_tif, tif_statistics},
    tif_fit,
};
use planish_types::{Axis, Grid, Surface};

/// Removal of the spot, nm: a Gaussian of 240 nm in 30 s, with these standard deviations along x and y, mm.
const SIGMA_MM: [f64; 2] = [0.5, 0.35];

#[test]
fn two_maps_of_a_turned_spot_become_its_formula() {
    let axis = |n: usize| Axis::new(-4.0, 0.1, n).unwrap();
    let grid = Grid { x: axis(101), y: axis(91) };
    let map = |nm: &dyn Fn(f64, f64) -> f64| {
        let heights = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            nm(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
        });
        Surface::new(grid, heights).unwrap()
    };
    // The part has waves, and lies 0.237 mm further along x and tilted in the second measurement.
    let waves = |x: f64, y: f64| 10.0 * (1.1 * x + 0.3 * y).sin() + 7.0 * (0.7 * y - 0.2 * x).cos();
    let depth = |x: f64, y: f64| {
        let [a, b] = SIGMA_MM;
        240.0 * (-0.5 * ((x / a).powi(2) + (y / b).powi(2))).exp()
    };
    let before = map(&waves);
    let after = map(&|x, y| waves(x - 0.237, y) - depth(x - 0.237 - 0.6, y) + 3.0 * x);
    let settings = SpotSettings {
        dwell_s: 30.0,
        half_size_mm: 2.0,
        spot_mm: None,
        align: Alignment::Shift,
        baseline: Baseline::Plane,
        clip_negative: false,
    };
    let measured = spot(Some(&before), &after, &settings).unwrap();
    let turned = TifSettings {
        subtract_border: true,
        centre: Centre::Centroid,
        rotate_deg: 30.0,
        pixel_mm: Some(0.1),
        taper_fraction: None,
    };
    let (tif, _) = prepare_tif(&measured.tif, &turned).unwrap();
    assert!(tif_statistics(&tif).sample_at_centre);
    let (formula, fit) = tif_fit::fit(&tif, tif_fit::TifModel::Gaussian).unwrap();
    let component = fit.components[0];
    // Keys' interpolation, of the shift and of the turn, each (0.1 / 0.35)^3 / 6 = 0.4 % of the peak.
    assert!((component.peak_nm_per_s / 8.0 - 1.0).abs() < 0.01, "{fit:?}");
    for (sigma, expected) in component.sigma_mm.into_iter().zip(SIGMA_MM) {
        assert!((sigma / expected - 1.0).abs() < 0.01, "{fit:?}");
    }
    // The ratio of the axes is 1.4: 1 % of an axis turns it by a degree.
    assert!((component.angle_deg - 30.0).abs() < 1.0, "{fit:?}");
    // Peak, 2 pi sigma_x sigma_y.
    let volume = 8.0 * std::f64::consts::TAU * SIGMA_MM[0] * SIGMA_MM[1];
    assert!((formula.vrr_nm_mm2_per_s() / volume - 1.0).abs() < 0.01, "{fit:?}");
}
