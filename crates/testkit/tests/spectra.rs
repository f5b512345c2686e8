//! A report and `planish-surface psd` take the same spectrum of a map, whatever of it is invalid.

use ndarray::Array2;
use planish_compare::report::spectrum::{BAND_PERIOD_MM, spectrum};
use planish_surface::psd::{Detrend, PsdSettings, Window, psd};
use planish_types::{Axis, Grid, Surface};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[test]
fn a_report_has_the_bands_of_the_spectrum_of_a_surface() {
    let mut rng = ChaCha8Rng::seed_from_u64(21);
    let axis = |n| Axis::new(-3.0, 0.25, n).unwrap();
    let grid = Grid { x: axis(150), y: axis(131) };
    let noise = Array2::from_shape_simple_fn(grid.shape(), || rng.random_range(-1.0..1.0));
    type Aperture = fn(f64, f64) -> bool;
    let apertures: [(&str, Aperture); 3] = [
        ("whole", |_, _| true),
        ("disc", |u, v| u.hypot(v) < 1.0),
        ("pit", |u, v| (u - 0.3).hypot(v + 0.2) > 0.05),
    ];
    for (name, inside) in apertures {
        let height_nm = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (u, v) = (c as f64 / 74.5 - 1.0, r as f64 / 65.0 - 1.0);
            let z = 30.0 * u * v + 8.0 * (3.0 * u).cos() + noise[[r, c]];
            if inside(u, v) { z } else { f64::NAN }
        });
        let surface = Surface::new(grid, height_nm).unwrap();
        let [long, short] = BAND_PERIOD_MM.map(|period| 1.0 / period);
        let settings = PsdSettings {
            window: Window::Hann,
            detrend: Detrend::Plane,
            band_per_mm: vec![[0.0, long], [long, short], [short, 99.0]],
        };
        let of_surface = psd(&surface, &settings).unwrap().report;
        let of_report = spectrum(surface.height_nm().view(), surface.grid()).unwrap();
        // The same sums of the same bins in the short bands, where the report counts what they add to the whole map; the
        // longest band of the report holds the rest.
        for band in [1, 2] {
            let rms_nm = of_surface.bands[band].rms_nm * of_report.fraction_of_valid_pixels.sqrt();
            let found = of_report.band_rms_nm[band].unwrap();
            assert!((found / rms_nm - 1.0).abs() < 1e-12, "{name}: {found} {rms_nm}");
        }
        assert_eq!(
            of_report.fraction_of_valid_pixels, of_surface.fraction_of_valid_pixels,
            "{name}"
        );
    }
}
