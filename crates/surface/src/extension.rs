//! Heights beyond the clear aperture.
//!
//! The map is enlarged by a margin on every side and every invalid pixel gets a height; valid
//! pixels stay bit for bit. Four methods, siblings in this folder:
//!
//! * [`nearest`]: the height of the nearest valid pixel;
//! * [`gaussian_decay`]: the same, decaying to zero with the distance;
//! * [`gerchberg_papoulis`]: the continuation without high spatial frequencies;
//! * [`polynomial`]: the continuation of a polynomial fit.
//!
//! An extension is needed for a method that works on the whole rectangle at once (an inverse filter by
//! Fourier transform, an adjoint iteration, a deconvolution without a mask). Its margin is then at least
//! half the size of the tool. Least squares with a mask needs no extension: pixels beyond the aperture have
//! no weight there, and an extension would only constrain the dwell times.

use ndarray::{Array2, s};
use planish_types::{Axis, Grid, Invalid, Surface, budget};
use serde::Serialize;
use serde_json::Value;

pub mod gaussian_decay;
pub mod gerchberg_papoulis;
pub mod nearest;
pub mod polynomial;

/// Largest number of pixels of an extended map; a larger map is refused. Larger: more memory for a margin
/// that was mistyped. Smaller: refuses large maps. At this value a map takes 200 MB as 64-bit floats.
const MAX_PIXELS: usize = 25_000_000;

/// Memory that a pixel of an extended map needs in all, bytes. Larger: refuses maps that would fit into the
/// memory. Smaller: an extension can exceed the memory of the process. Measured: 300 MB for 4 million
/// pixels.
const BYTES_PER_PIXEL: usize = 80;

/// Settings of an extension.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ExtensionSettings {
    /// Margin on every side, rounded up to whole pixels, mm; >= 0. At 0 only the invalid pixels of
    /// the map itself get a height.
    pub margin_mm: f64,
    /// Method that gives the new pixels their heights.
    pub method: ExtensionMethod,
}

/// Method that gives the new pixels their heights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExtensionMethod {
    /// Height of the nearest valid pixel.
    Nearest,
    /// Height of the nearest valid pixel, decaying to zero with the distance.
    GaussianDecay(gaussian_decay::GaussianDecaySettings),
    /// Continuation without high spatial frequencies.
    GerchbergPapoulis(gerchberg_papoulis::GerchbergPapoulisSettings),
    /// Continuation of a polynomial fit.
    Polynomial(polynomial::PolynomialSettings),
}

/// Extent of the extension, and numbers of its heights.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ExtensionReport {
    /// Pixels added on every side (rows, columns).
    pub margin_px: (usize, usize),
    /// Number of pixels that got a height.
    pub extended_pixels: usize,
    /// Smallest and largest of the new heights, nm; those of the map if there are no new heights.
    pub range_nm: [f64; 2],
    /// Population RMS of the height steps at the edge, between neighbours of which one is valid and the other new, nm;
    /// 0 without such neighbours.
    pub step_rms_nm: f64,
    /// Further numbers of the method, such as its number of steps; `null` if it has none.
    #[serde(flatten)]
    pub own: Value,
}

/// Extends `surface` by the margin on every side. The result has no invalid pixel.
///
/// # Errors
/// Refuses a margin that makes too many pixels, settings of the method out of their range, and a map that does not
/// determine the terms of a polynomial.
pub fn extend(
    surface: &Surface,
    settings: &ExtensionSettings,
) -> Result<(Surface, ExtensionReport), Invalid> {
    let (grid, margin_px) = enlarged(surface.grid(), settings.margin_mm)?;
    let (ny, nx) = surface.height_nm().dim();
    let mut map = Array2::from_elem(grid.shape(), f64::NAN);
    map.slice_mut(s![margin_px.0..margin_px.0 + ny, margin_px.1..margin_px.1 + nx])
        .assign(surface.height_nm());
    let (mut extended, own) = match &settings.method {
        ExtensionMethod::Nearest => (nearest::extend(&map, &grid), Value::Null),
        ExtensionMethod::GaussianDecay(s) => (gaussian_decay::extend(&map, &grid, s)?, Value::Null),
        ExtensionMethod::GerchbergPapoulis(s) => gerchberg_papoulis::extend(&map, &grid, s)?,
        ExtensionMethod::Polynomial(s) => polynomial::extend(&map, &grid, settings.margin_mm, s)?,
    };
    let mut range_nm = [f64::INFINITY, f64::NEG_INFINITY];
    let mut extended_pixels = 0;
    for (z, measured) in extended.iter_mut().zip(&map) {
        if measured.is_nan() {
            extended_pixels += 1;
            range_nm = [range_nm[0].min(*z), range_nm[1].max(*z)];
        } else {
            *z = *measured;
        }
    }
    if extended_pixels == 0 {
        let s = surface.statistics();
        range_nm = [s.min, s.max];
    }
    let step_rms_nm = step_rms(&map, &extended);
    let report = ExtensionReport { margin_px, extended_pixels, range_nm, step_rms_nm, own };
    Ok((Surface::new(grid, extended)?, report))
}

/// Returns the grid with a margin on every side, rounded up to whole pixels, and the margin (rows, columns) in pixels.
/// Refuses a negative margin, and one that makes too many pixels.
fn enlarged(grid: &Grid, margin_mm: f64) -> Result<(Grid, (usize, usize)), Invalid> {
    if !(margin_mm.is_finite() && margin_mm >= 0.0) {
        return Err(Invalid::whole(
            "extension margin",
            format!("is {margin_mm} mm"),
            "give at least 0 mm; half the size of the tool is usual",
        ));
    }
    // A margin of whole pixels is not rounded up by rounding.
    let pixels = |axis: &Axis| (margin_mm / axis.step_mm() - 1e-9).ceil().max(0.0);
    let size = |axis: &Axis| axis.len() as f64 + 2.0 * pixels(axis);
    if size(&grid.x) * size(&grid.y) > MAX_PIXELS as f64 {
        return Err(Invalid::whole(
            "extension margin",
            format!(
                "of {margin_mm} mm makes a map of {} x {} pixels",
                size(&grid.x),
                size(&grid.y)
            ),
            format!("give a margin in mm that makes at most {MAX_PIXELS} pixels"),
        ));
    }
    let array = "extended map";
    budget::affordable(
        array,
        size(&grid.x) * size(&grid.y),
        BYTES_PER_PIXEL,
        "give a smaller margin",
    )?;
    let longer = |axis: &Axis| {
        let k = pixels(axis) as usize;
        Axis::new(axis.start_mm() - k as f64 * axis.step_mm(), axis.step_mm(), axis.len() + 2 * k)
    };
    let grid_px = (pixels(&grid.y) as usize, pixels(&grid.x) as usize);
    Ok((Grid { x: longer(&grid.x)?, y: longer(&grid.y)? }, grid_px))
}

/// Returns the RMS of the differences in `extended` between neighbours of which exactly one is valid in `map`, nm; 0
/// without such neighbours.
fn step_rms(map: &Array2<f64>, extended: &Array2<f64>) -> f64 {
    let mut sum = 0.0;
    let mut count = 0;
    for ((r, c), v) in map.indexed_iter() {
        for neighbour in [(r + 1, c), (r, c + 1)] {
            if map.get(neighbour).is_some_and(|n| v.is_nan() != n.is_nan()) {
                sum += (extended[(r, c)] - extended[neighbour]).powi(2);
                count += 1;
            }
        }
    }
    if count == 0 { 0.0 } else { (sum / f64::from(count)).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    const METHODS: [ExtensionMethod; 4] = [
        ExtensionMethod::Nearest,
        ExtensionMethod::GaussianDecay(gaussian_decay::GaussianDecaySettings { sigma_mm: 0.4 }),
        ExtensionMethod::GerchbergPapoulis(gerchberg_papoulis::GerchbergPapoulisSettings {
            cutoff_per_mm: 0.3,
            max_iterations: 50,
            tolerance_nm: 1e-3,
        }),
        ExtensionMethod::Polynomial(polynomial::PolynomialSettings { order: [5, 4], ring: true }),
    ];

    fn disc(f: impl Fn(f64, f64) -> f64) -> Surface {
        let grid =
            Grid { x: Axis::new(-2.0, 0.1, 41).unwrap(), y: Axis::new(7.0, 0.125, 33).unwrap() };
        let map = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r) - 9.0);
            if x.hypot(y) <= 2.0 { f(x, y) } else { f64::NAN }
        });
        Surface::new(grid, map).unwrap()
    }

    #[test]
    fn every_method_keeps_valid_pixels_and_coordinates_and_fills_the_rest() {
        let surface = disc(|x, y| 10.0 + 3.0 * x - y + (2.0 * x).sin());
        for method in METHODS {
            let settings = ExtensionSettings { margin_mm: 1.0, method };
            let (extended, report) = extend(&surface, &settings).unwrap();
            assert_eq!((report.margin_px, extended.height_nm().dim()), ((8, 10), (49, 61)));
            // Below: rounding of coordinates.
            assert!((extended.grid().x.coordinate_mm(10) + 2.0).abs() < 1e-12);
            assert!((extended.grid().y.coordinate_mm(8) - 7.0).abs() < 1e-12);
            assert!(extended.height_nm().iter().all(|v| v.is_finite()), "{method:?}");
            for ((r, c), z) in surface.height_nm().indexed_iter() {
                let e = extended.height_nm()[[r + 8, c + 10]];
                assert!(z.is_nan() || z.to_bits() == e.to_bits());
            }
            assert_eq!(report.extended_pixels, 49 * 61 - surface.statistics().valid_count);
        }
    }

    #[test]
    fn a_constant_is_continued_by_all_but_the_decay_which_falls_to_zero() {
        let surface = disc(|_, _| 5.0);
        for method in METHODS {
            let (extended, report) =
                extend(&surface, &ExtensionSettings { margin_mm: 1.5, method }).unwrap();
            if let ExtensionMethod::GaussianDecay(_) = method {
                // The corner is sqrt(2) * 3.5 - 2 = 2.95 mm away: 7 sigma.
                assert!(extended.height_nm()[[0, 0]].abs() < 1e-9);
                // One pixel beside the rim: 5 exp(-0.1^2 / 0.32).
                let z = extended.height_nm()[[12 + 16, 15 + 41]];
                // Rounding of 5 nm.
                assert!((z - 5.0 * (-0.01_f64 / 0.32).exp()).abs() < 1e-12, "{z}");
            } else {
                // Rounding of 5 nm, of which fits and transforms lose some digits.
                assert!(report.range_nm.iter().all(|v| (v - 5.0).abs() < 1e-10), "{method:?}");
            }
        }
    }

    #[test]
    fn a_band_limited_map_comes_back_with_every_iteration() {
        // Waves of the enlarged rectangle's own periods, below the cutoff; 64 x 48 px.
        let grid =
            Grid { x: Axis::new(0.0, 0.1, 40).unwrap(), y: Axis::new(0.0, 0.1, 24).unwrap() };
        let wave = |x: f64, y: f64| {
            4.0 * (2.0 * PI * (x / 6.4 + 0.1)).cos() + 3.0 * (2.0 * PI * (y / 4.8 - x / 6.4)).sin()
        };
        let map = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            wave(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
        });
        let surface = Surface::new(grid, map).unwrap();
        let error = |max_iterations: usize| {
            let method =
                ExtensionMethod::GerchbergPapoulis(gerchberg_papoulis::GerchbergPapoulisSettings {
                    cutoff_per_mm: 0.28,
                    max_iterations,
                    tolerance_nm: 0.0,
                });
            let (e, _) = extend(&surface, &ExtensionSettings { margin_mm: 1.2, method }).unwrap();
            let g = e.grid();
            let squares = e.height_nm().indexed_iter();
            squares
                .map(|((r, c), z)| (z - wave(g.x.coordinate_mm(c), g.y.coordinate_mm(r))).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        let errors: Vec<f64> = [0, 1, 2, 5, 10, 20, 50, 100, 200, 400].map(error).into();
        assert!(errors.windows(2).all(|e| e[1] < e[0]), "{errors:?}");
        assert!(errors[9] < 0.05 * errors[0], "{errors:?}");
    }

    #[test]
    fn a_polynomial_without_ring_is_continued_exactly() {
        let f = |x: f64, y: f64| 1.0 + 20.0 * x - 4.0 * x * x * y + y.powi(4) - x.powi(5);
        let surface = disc(f);
        let method = ExtensionMethod::Polynomial(polynomial::PolynomialSettings {
            order: [5, 4],
            ring: false,
        });
        let settings = ExtensionSettings { margin_mm: 0.8, method };
        let (extended, report) = extend(&surface, &settings).unwrap();
        let g = extended.grid();
        for ((r, c), z) in extended.height_nm().indexed_iter() {
            let want = f(g.x.coordinate_mm(c), g.y.coordinate_mm(r) - 9.0);
            // Rounding of 300 nm, magnified by the extrapolation: T_5 T_4 beyond its data.
            assert!((z - want).abs() < 1e-7 * want.abs().max(100.0), "{r} {c}: {z} {want}");
        }
        // Rounding of 300 nm in sums over some thousand pixels.
        assert!(report.own["misfit_rms_nm"].as_f64().unwrap() < 1e-9);
    }

    #[test]
    fn a_polynomial_explodes_without_the_ring_and_not_with_it() {
        // Not a polynomial: a bowl with ripple.
        let surface = disc(|x, y| 10.0 * (x * x + y * y) + 3.0 * (5.0 * x).sin() * (4.0 * y).cos());
        let range = |ring: bool| {
            let method =
                ExtensionMethod::Polynomial(polynomial::PolynomialSettings { order: [9, 6], ring });
            let settings = ExtensionSettings { margin_mm: 1.5, method };
            extend(&surface, &settings).unwrap().1.range_nm
        };
        let (with, without) = (range(true), range(false));
        // The rim of the map is between 36 and 44 nm. The same fit by a QR factorisation in NumPy has
        // 35.89 .. 54.24 nm with the ring, -2.7e6 .. 2.7e6 nm without.
        assert!((with[0] - 35.89).abs() < 0.01 && (with[1] - 54.24).abs() < 0.01, "{with:?}");
        assert!(without[1] - without[0] > 1e6, "{without:?}");
    }

    #[test]
    fn the_nearest_pixel_is_copied() {
        let surface = disc(|x, y| 7.0 * x + y);
        let settings = ExtensionSettings { margin_mm: 1.0, method: ExtensionMethod::Nearest };
        let (e, report) = extend(&surface, &settings).unwrap();
        let s = surface.statistics();
        assert!(report.range_nm[0] >= s.min && report.range_nm[1] <= s.max);
        // The row through the middle: x = -2 and x = 2 continue.
        let row = e.height_nm().row(8 + 16);
        // Rounding of 14 nm.
        assert!(row.iter().take(10).all(|z| (z + 14.0).abs() < 1e-12));
        assert!(row.iter().skip(51).all(|z| (z - 14.0).abs() < 1e-12));
    }

    #[test]
    fn settings_that_make_no_sense_are_refused() {
        let surface = disc(|x, _| x);
        let message = |margin_mm, method| {
            extend(&surface, &ExtensionSettings { margin_mm, method }).unwrap_err().to_string()
        };
        assert!(message(-1.0, ExtensionMethod::Nearest).contains("is -1 mm"));
        assert!(message(f64::NAN, ExtensionMethod::Nearest).contains("is NaN mm"));
        assert!(message(1e6, ExtensionMethod::Nearest).contains("at most 25000000 pixels"));
        let decay =
            ExtensionMethod::GaussianDecay(gaussian_decay::GaussianDecaySettings { sigma_mm: 0.0 });
        assert!(message(1.0, decay).contains("is 0 mm"));
        let gp = |cutoff_per_mm| {
            ExtensionMethod::GerchbergPapoulis(gerchberg_papoulis::GerchbergPapoulisSettings {
                cutoff_per_mm,
                max_iterations: 10,
                tolerance_nm: 0.0,
            })
        };
        assert!(message(1.0, gp(0.01)).contains("no wave"));
        assert!(message(1.0, gp(9.0)).contains("is 9 /mm"));
        let polynomial = ExtensionMethod::Polynomial(polynomial::PolynomialSettings {
            order: [40, 3],
            ring: true,
        });
        assert!(message(1.0, polynomial).contains("40"));
    }
}
