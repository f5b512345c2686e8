//! Power spectral density of a map, averaged over the directions, and the RMS of three bands.
//!
//! It is that of `planish surface psd` with its defaults, of the same rectangle: the largest one
//! without an invalid pixel, its plane taken off, under a Hann window
//! ([`planish_numerics::spectrum`]). Before and after have their invalid pixels at the same places, so their spectra
//! are of the same rectangle. The fraction of the map that it covers stands next to them.
//!
//! ```text
//! PSD(|f|) = mean of S over the ring of |f|             nm^2 mm^2
//! mean square of a band  = sum of S df over it, at most what the shorter bands leave of that of the rectangle
//! contribution of a band = sqrt(mean square of the band * pixels of the rectangle / valid pixels of the map)
//! not in the spectrum    = sqrt(mean square of z - contributions^2)
//! ```
//!
//! where z is the map without the plane of all its valid pixels. So the squares of all contributions add up to the
//! mean square of z. The sums of S alone do not, and may exceed it. The window gives the middle of the rectangle more
//! weight than its edges, and a long wave is rarely the same in both. Not in the spectrum are the pixels outside of
//! the rectangle, heights at its edges, and its own plane.
//!
//! The band of long periods is not resolved if the longer side of the rectangle is at most 10 mm, and the band of short
//! periods if the smaller pixel pitch is above 0.5 mm. The frequencies of a band that is not resolved (the mean, the
//! corners of the plane of frequencies) count in the middle band.

use ndarray::{Array2, ArrayView2, s};
use planish_numerics::{
    spectrum::{Density, MIN_SAMPLES, Ring, hann, largest_rectangle, without_plane},
    statistics::{fit_plane, statistics, subtract_plane},
};
use planish_types::Grid;
use serde::Serialize;

/// Periods that separate the three bands, mm. Longer or shorter: residual moves from one band to the next. Chosen.
pub const BAND_PERIOD_MM: [f64; 2] = [10.0, 1.0];

/// Number of rings per decade of spatial frequency. A ring is an interval of frequencies over all directions. Larger:
/// finer frequencies with more noise. Smaller: a smoother, coarser spectrum. Chosen.
const PER_DECADE: f64 = 20.0;

/// Fraction of the width of a ring by which a frequency may lie below the first ring. Larger: frequencies that belong
/// to no ring are counted. Smaller: rounding loses the first frequency. Chosen far above rounding.
const SLACK: f64 = 1e-9;

/// Power spectral density of a map, averaged over directions, and the RMS of its bands.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Spectrum {
    /// Lengths along x and y of the rectangle whose spectrum it is, mm.
    pub size_mm: [f64; 2],
    /// Pixels of the rectangle divided by the valid pixels of the map.
    pub fraction_of_valid_pixels: f64,
    /// Mean frequency of each ring, 1/mm.
    pub frequency_per_mm: Vec<f64>,
    /// Mean over each ring of the two-dimensional power spectral density, nm^2 mm^2.
    pub psd_nm2_mm2: Vec<f64>,
    /// RMS of all valid pixels of the map without their plane, nm, also of those outside of the rectangle.
    pub rms_detilted_nm: f64,
    /// Contributions to `rms_detilted_nm`, nm, of the periods p > 10 mm, 10 mm >= p > 1 mm, and p <= 1 mm in the
    /// rectangle. `null` for a band that the rectangle does not resolve; its frequencies then count in the middle band,
    /// which is never `null`.
    pub band_rms_nm: [Option<f64>; 3],
    /// Rest of the RMS beside the bands, nm: pixels outside of the rectangle, and the part that the window and the
    /// plane of the rectangle hide.
    pub not_in_spectrum_rms_nm: f64,
}

/// Returns the spectrum of `map` (ny, nx), nm. `None` if the largest rectangle of valid pixels has fewer than
/// [`MIN_SAMPLES`] pixels along x or y. `grid` has the pixel centres, mm.
pub fn spectrum(map: ArrayView2<f64>, grid: &Grid) -> Option<Spectrum> {
    let valid = map.mapv(|v| !v.is_nan());
    let ((row, column), (ny, nx)) = largest_rectangle(&valid);
    if ny < MIN_SAMPLES || nx < MIN_SAMPLES {
        return None;
    }
    let x = grid.x.coordinates();
    let y = grid.y.coordinates();
    let columns = column..column + nx;
    let rows = row..row + ny;
    let rectangle = map.slice(s![rows.clone(), columns.clone()]);
    let z = without_plane(rectangle, &x[columns], &y[rows]);
    let step_mm = [grid.x.step_mm(), grid.y.step_mm()];
    let density = Density::new(z.view(), step_mm, [&hann(nx), &hann(ny)]);

    let size_mm = [nx as f64 * step_mm[0], ny as f64 * step_mm[1]];
    // Frequencies below that of the rectangle itself are not resolved.
    let lowest = 1.0 / size_mm[0].max(size_mm[1]);
    let highest = 0.5 / step_mm[0].max(step_mm[1]);
    let count = ((highest / lowest).log10() * PER_DECADE).ceil().max(1.0) as usize;
    let ring_of = |f: f64| {
        let ring = ((f / lowest).log10() * PER_DECADE + SLACK).floor();
        if ring >= 0.0 { Some(ring as usize) } else { None }
    };
    let rings: Vec<Ring> = density.rings(count, ring_of).into_iter().flatten().collect();
    // Sums of squares of the map without its plane, in the rectangle and in all.
    let z = without_mean_of_valid(map, &x, &y);
    let all = sum_of_squares(z.view());
    let inside = sum_of_squares(z.slice(s![row..row + ny, column..column + nx])).min(all);
    let count = valid.iter().filter(|v| **v).count() as f64;
    let pixels = (nx * ny) as f64;
    let contributions = bands(&density, size_mm, step_mm, inside / pixels)
        .map(|band| band.map(|nm2| nm2 * pixels / count));
    let seen: f64 = contributions.iter().flatten().sum();
    Some(Spectrum {
        size_mm,
        fraction_of_valid_pixels: pixels / count,
        frequency_per_mm: rings.iter().map(|ring| ring.frequency).collect(),
        psd_nm2_mm2: rings.iter().map(|ring| ring.density).collect(),
        rms_detilted_nm: (all / count).sqrt(),
        band_rms_nm: contributions.map(|band| band.map(f64::sqrt)),
        not_in_spectrum_rms_nm: (all / count - seen).max(0.0).sqrt(),
    })
}

/// Returns the sum of the squares of the valid pixels.
fn sum_of_squares(z: ArrayView2<f64>) -> f64 {
    z.iter().filter(|v| !v.is_nan()).map(|v| v * v).sum::<f64>()
}

/// Returns `map` without the least-squares plane of its valid pixels and without their mean. `x` and `y` are the
/// pixel centres, mm.
fn without_mean_of_valid(map: ArrayView2<f64>, x: &[f64], y: &[f64]) -> Array2<f64> {
    let z = match fit_plane(map, x, y) {
        Some(plane) => subtract_plane(map, x, y, plane),
        None => map.to_owned(),
    };
    let mean = statistics(z.view()).map_or(0.0, |s| s.mean);
    z - mean
}

/// Returns the mean squares of the three bands in the rectangle, nm^2; `None` for a band that is not resolved. Together
/// they do not exceed the mean square of the rectangle, `rectangle_nm2`. `size_mm` is the size of the rectangle, and
/// `step_mm` that of its pixels. `density` is the two-dimensional spectrum of the rectangle.
fn bands(
    density: &Density,
    size_mm: [f64; 2],
    step_mm: [f64; 2],
    rectangle_nm2: f64,
) -> [Option<f64>; 3] {
    let [long, short] = BAND_PERIOD_MM.map(|period| 1.0 / period);
    let has_long = size_mm[0].max(size_mm[1]) > BAND_PERIOD_MM[0];
    let has_short = 2.0 * step_mm[0].min(step_mm[1]) <= BAND_PERIOD_MM[1];
    let from = if has_long { long } else { 0.0 };
    let to = if has_short { short } else { f64::INFINITY };
    let mut left_nm2 = rectangle_nm2;
    // The shortest first: the window weights them with the least bias.
    let mut take = |low: f64, high: f64| {
        let taken = density.mean_square([low, high]).min(left_nm2);
        left_nm2 -= taken;
        taken
    };
    let below = if has_short { Some(take(short, f64::INFINITY)) } else { None };
    let between = take(from, to);
    let above = if has_long { Some(take(0.0, long)) } else { None };
    [above, Some(between), below]
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{Axis, Surface};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use std::f64::consts::PI;

    fn grid(nx: usize, ny: usize) -> Grid {
        Grid { x: Axis::new(3.0, 0.2, nx).unwrap(), y: Axis::new(0.0, 0.25, ny).unwrap() }
    }

    #[test]
    fn a_ripple_has_its_power_in_its_band_and_its_peak_at_its_frequency() {
        let g = grid(240, 200);
        // 3 nm at a period of 2.5 mm, 0.5 nm at 0.7 mm, and a tilt that counts nothing.
        let z = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
            3.0 * (2.0 * PI * x / 2.5).sin() + 0.5 * (2.0 * PI * y / 0.7).cos() + 40.0 * y - x
        });
        let s = spectrum(z.view(), &g).unwrap();
        // Power a^2/2; the window sees 19 and 71 periods, so its leakage is far below 1e-3.
        let band = s.band_rms_nm.map(Option::unwrap);
        // The mean square over cut periods differs from a^2/2 by up to 1 / (2 pi 19) of it, and the plane takes as
        // little.
        assert!((band[1] / 3.0 * 2.0_f64.sqrt() - 1.0).abs() < 0.01, "{band:?}");
        assert!((band[2] / 0.5 * 2.0_f64.sqrt() - 1.0).abs() < 0.01, "{band:?}");
        // What is left of that difference: up to 1 % of 4.5 nm^2.
        assert!(band[0].powi(2) < 0.045, "{band:?}");
        let peak =
            (0..s.psd_nm2_mm2.len()).max_by(|a, b| s.psd_nm2_mm2[*a].total_cmp(&s.psd_nm2_mm2[*b]));
        let f = s.frequency_per_mm[peak.unwrap()];
        // A ring is 12 % wide.
        assert!((f * 2.5 - 1.0).abs() < 0.12, "{f}");
    }

    #[test]
    fn white_noise_is_flat_at_its_variance_times_the_pixel() {
        let g = grid(160, 128);
        // splitmix64 (Steele et al. 2014): independent of its index for this purpose.
        let noise = |i: usize| {
            let mut h = (i as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            h = (h ^ (h >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            h = (h ^ (h >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            ((h ^ (h >> 31)) >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        let z = Array2::from_shape_fn(g.shape(), |(r, c)| noise(r * 160 + c));
        let s = spectrum(z.view(), &g).unwrap();
        // Variance 1/12 over the band of 1 / (dx dy): 1/12 dx dy.
        let expected = 0.2 * 0.25 / 12.0;
        let last = s.psd_nm2_mm2.len() - 1;
        for k in last - 5..=last {
            // Rings of more than 1000 elements, a quarter of them independent under the window: 6 %.
            assert!((s.psd_nm2_mm2[k] / expected - 1.0).abs() < 0.2, "{k} {}", s.psd_nm2_mm2[k]);
        }
        let total: f64 = s.band_rms_nm.iter().flatten().map(|b| b * b).sum();
        assert!((total * 12.0 - 1.0).abs() < 0.05, "{total}");
    }

    #[test]
    fn a_disc_has_the_spectrum_of_its_inscribed_square() {
        let g = Grid { x: Axis::new(0.0, 0.5, 121).unwrap(), y: Axis::new(0.0, 0.5, 121).unwrap() };
        // 20 nm of low order, a ripple of 0.1 nm at 2 mm: a mask of zeros would leak from the first
        // into the second.
        let height = |r: usize, c: usize| {
            let (x, y) = (g.x.coordinate_mm(c) - 30.0, g.y.coordinate_mm(r) - 30.0);
            let ripple = 0.1 * (PI * x).sin();
            if x.hypot(y) <= 30.0 { 20.0 * (x / 30.0) * (y / 30.0) + ripple } else { f64::NAN }
        };
        let z = Array2::from_shape_fn(g.shape(), |(r, c)| height(r, c));
        let s = spectrum(z.view(), &g).unwrap();
        // Two over pi of the disc, less the pixels at the corners.
        assert!((s.fraction_of_valid_pixels - 2.0 / PI).abs() < 0.03, "{s:?}");
        let [width, height] = s.size_mm;
        assert!(width.hypot(height) <= 61.0, "{s:?}");
        // 0.1 / sqrt(2) between 1 and 10 mm, and what the window lets through of the low order.
        let ripple = s.band_rms_nm[1].unwrap() / s.fraction_of_valid_pixels.sqrt();
        assert!((ripple * 2.0_f64.sqrt() / 0.1 - 1.0).abs() < 0.05, "{s:?}");
        // Of the sum of squares of the saddle x y, pi r^6 / 24 over the disc, its square |x|, |y| < a = r / sqrt(2)
        // holds 4 a^6 / 9: 2/3 of 2/pi. The rest at least is not in the spectrum; the rows of pixels at its edge are 2
        // % of it.
        let missing = s.not_in_spectrum_rms_nm.powi(2) / s.rms_detilted_nm.powi(2);
        assert!(missing > 1.0 - 2.0 / PI * 2.0 / 3.0 - 0.05, "{missing}");
    }

    #[test]
    fn a_hole_makes_the_rectangle_smaller_and_leaks_nothing() {
        let g = grid(240, 200);
        // A slope of low order and a ripple of 0.01 nm at 0.8 mm; a hole near the left edge.
        let mut z = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c) - 3.0, g.y.coordinate_mm(r));
            10.0 * (x / 24.0).powi(2) + 5.0 * (y / 25.0).powi(3) + 0.01 * (2.5 * PI * y).sin()
        });
        z[[100, 3]] = f64::NAN;
        let s = spectrum(z.view(), &g).unwrap();
        assert!((s.size_mm[0] - 236.0 * 0.2).abs() < 1e-9, "{s:?}");
        assert!((s.fraction_of_valid_pixels - 236.0 * 200.0 / 47999.0).abs() < 1e-12);
        // 0.01 / sqrt(2), and what the window lets through of 5 nm: 2 % of the ripple.
        let ripple = s.band_rms_nm[2].unwrap() / s.fraction_of_valid_pixels.sqrt();
        assert!((ripple * 2.0_f64.sqrt() / 0.01 - 1.0).abs() < 0.02, "{s:?}");
    }

    #[test]
    fn the_squares_of_the_bands_add_up_to_that_of_the_rms() {
        let mut rng = ChaCha8Rng::seed_from_u64(57);
        for round in 0..40 {
            // Steps of 0.1 to 1.2 mm, sides of 2 to 90 mm: each band is resolved in some, and not in others.
            let [dx, dy] = [(); 2].map(|()| rng.random_range(0.1..1.2));
            let [nx, ny] = [(); 2].map(|()| rng.random_range(20..75));
            let axis = |step, n| Axis::new(-4.0, step, n).unwrap();
            let g = Grid { x: axis(dx, nx), y: axis(dy, ny) };
            let (centre, radius) = (rng.random_range(0.3..0.7), rng.random_range(0.4..1.2));
            let mut z = Array2::from_shape_fn(g.shape(), |(r, c)| {
                let (u, v) = (c as f64 / nx as f64, r as f64 / ny as f64);
                let noise: f64 = rng.random_range(-1.0..1.0);
                let inside = (u - centre).hypot(v - 0.5) < radius;
                if inside { 20.0 * u * v + 3.0 * u - noise } else { f64::NAN }
            });
            z[[ny / 2, nx / 2]] = f64::NAN;
            let s = spectrum(z.view(), &g).unwrap();
            let surface = Surface::new(g, z).unwrap();
            let bands = s.band_rms_nm.iter().flatten().chain([&s.not_in_spectrum_rms_nm]);
            let sum: f64 = bands.map(|b| b * b).sum();
            // Sums of up to 5000 terms.
            let ratio = sum / surface.detilted_rms_nm().powi(2);
            assert!((ratio - 1.0).abs() < 1e-12, "{round}: {ratio} {s:?}");
            let side = s.size_mm[0].max(s.size_mm[1]);
            assert_eq!(s.band_rms_nm[0].is_some(), side > 10.0, "{s:?}");
            assert_eq!(s.band_rms_nm[2].is_some(), 2.0 * dx.min(dy) <= 1.0, "{s:?}");
        }
    }

    #[test]
    fn a_flat_map_has_a_spectrum_and_a_line_has_none() {
        let s = spectrum(Array2::from_elem((9, 8), 1.0).view(), &grid(8, 9)).unwrap();
        assert!(s.psd_nm2_mm2.iter().all(|p| *p < 1e-25) && s.rms_detilted_nm < 1e-12);
        assert_eq!(spectrum(Array2::zeros((7, 40)).view(), &grid(40, 7)), None);
    }
}
