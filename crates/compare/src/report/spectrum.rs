//! Power spectral density of a map, averaged over the directions.
//!
//! ```text
//! S(f) = |FFT(w (z - plane))|^2 dx dy / sum(w^2)        nm^2 mm^2, two-sided
//! PSD(|f|) = mean of S over the ring of |f|
//! RMS of a band = sqrt(sum of S df_x df_y over the band)
//! ```
//!
//! `w` is a separable Hann window over the map, zero on invalid pixels; the sum over all bands is
//! the variance weighted with w^2. A mask with an edge inside the window spreads some of the low
//! frequencies over the others.

use ndarray::{Array2, ArrayView2};
use planish_numerics::{
    fft::smooth_size,
    fft::transform::{forward, frequency},
    statistics::{fit_plane, statistics, subtract_plane},
};
use planish_types::Grid;
use serde::Serialize;

/// Periods that separate the bands, mm.
pub const BAND_PERIOD_MM: [f64; 2] = [10.0, 1.0];

/// Rings per decade of frequency.
const PER_DECADE: f64 = 20.0;

/// A spectrum and the RMS of its bands.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Spectrum {
    /// Mean frequency of each ring, 1/mm.
    pub frequency_per_mm: Vec<f64>,
    /// Mean of the two-dimensional density over the ring, nm^2 mm^2.
    pub psd_nm2_mm2: Vec<f64>,
    /// RMS of the periods above 10 mm, between, and below 1 mm; nm.
    pub band_rms_nm: [f64; 3],
}

/// The spectrum of `map` (ny, nx), plane removed.
pub fn spectrum(map: ArrayView2<f64>, grid: &Grid) -> Spectrum {
    let (x, y) = (grid.x.coordinates(), grid.y.coordinates());
    let level = match fit_plane(map, &x, &y) {
        Some(plane) => subtract_plane(map, &x, &y, plane),
        None => map.mapv(|v| v - statistics(map).map_or(0.0, |s| s.mean)),
    };
    let (wx, wy) = (hann(x.len()), hann(y.len()));
    let mut weight = 0.0;
    // Padded with zeros to sizes that are fast.
    let (py, px) = (smooth_size(y.len()), smooth_size(x.len()));
    let mut windowed = Array2::zeros((py, px));
    for ((r, c), z) in level.indexed_iter().filter(|(_, z)| !z.is_nan()) {
        let w = wx[c] * wy[r];
        weight += w * w;
        windowed[[r, c]] = w * z;
    }

    let field = forward(windowed.view());
    let (dx, dy) = (grid.x.step_mm(), grid.y.step_mm());
    let (dfx, dfy) = (1.0 / (px as f64 * dx), 1.0 / (py as f64 * dy));
    // Frequencies below that of the map itself are not resolved.
    let lowest = 1.0 / (dx * x.len() as f64).max(dy * y.len() as f64);
    let highest = 0.5 / dx.max(dy);
    let rings = ((highest / lowest).log10() * PER_DECADE).ceil().max(1.0) as usize;
    let mut sums = vec![[0.0_f64; 3]; rings]; // S, |f|, count
    let mut band_power = [0.0; 3];
    for ((ky, kx), a) in field.indexed_iter() {
        let f = (frequency(kx, px) / dx).hypot(frequency(ky, py) / dy);
        let s = a.norm_sqr() * dx * dy / weight.max(f64::MIN_POSITIVE);
        let band = BAND_PERIOD_MM.iter().filter(|period| f * *period > 1.0).count();
        band_power[band] += s * dfx * dfy;
        let ring = ((f / lowest).log10() * PER_DECADE).floor();
        if ring >= 0.0 && (ring as usize) < rings {
            let sum = &mut sums[ring as usize];
            *sum = [sum[0] + s, sum[1] + f, sum[2] + 1.0];
        }
    }
    sums.retain(|s| s[2] > 0.0);
    Spectrum {
        frequency_per_mm: sums.iter().map(|s| s[1] / s[2]).collect(),
        psd_nm2_mm2: sums.iter().map(|s| s[0] / s[2]).collect(),
        band_rms_nm: band_power.map(f64::sqrt),
    }
}

fn hann(n: usize) -> Vec<f64> {
    let phase = |i: usize| std::f64::consts::PI * (i as f64 + 0.5) / n as f64;
    (0..n).map(|i| phase(i).sin().powi(2)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Axis;
    use std::f64::consts::PI;

    fn grid(nx: usize, ny: usize) -> Grid {
        Grid { x: Axis::new(3.0, 0.2, nx).unwrap(), y: Axis::new(0.0, 0.25, ny).unwrap() }
    }

    #[test]
    fn a_ripple_has_its_power_in_its_band_and_its_peak_at_its_frequency() {
        let g = grid(240, 200);
        // 3 nm at a period of 2.5 mm, 0.5 nm at 0.7 mm, and a tilt that counts nothing.
        let z = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.at(c), g.y.at(r));
            3.0 * (2.0 * PI * x / 2.5).sin() + 0.5 * (2.0 * PI * y / 0.7).cos() + 40.0 * y - x
        });
        let s = spectrum(z.view(), &g);
        // Power a^2/2; the window sees 19 and 71 periods, so its leakage is far below 1e-3.
        assert!((s.band_rms_nm[1] - 3.0 / 2.0_f64.sqrt()).abs() < 1e-3, "{:?}", s.band_rms_nm);
        assert!((s.band_rms_nm[2] - 0.5 / 2.0_f64.sqrt()).abs() < 1e-3, "{:?}", s.band_rms_nm);
        // The plane takes a little of a ripple that is cut off: 1 % of it.
        assert!(s.band_rms_nm[0] < 0.05, "{:?}", s.band_rms_nm);
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
        let mut z = Array2::from_shape_fn(g.shape(), |(r, c)| noise(r * 160 + c));
        z[[5, 7]] = f64::NAN;
        let s = spectrum(z.view(), &g);
        // Variance 1/12 over the band of 1 / (dx dy): 1/12 dx dy.
        let expected = 0.2 * 0.25 / 12.0;
        let last = s.psd_nm2_mm2.len() - 1;
        for k in last - 5..=last {
            // Rings of more than 1000 elements, a quarter of them independent under the window: 6 %.
            assert!((s.psd_nm2_mm2[k] / expected - 1.0).abs() < 0.2, "{k} {}", s.psd_nm2_mm2[k]);
        }
        let total: f64 = s.band_rms_nm.iter().map(|b| b * b).sum();
        assert!((total * 12.0 - 1.0).abs() < 0.05, "{total}");
    }

    #[test]
    fn a_flat_map_and_a_line_have_a_spectrum() {
        for z in [Array2::zeros((3, 4)), Array2::from_elem((2, 2), 1.0)] {
            let (ny, nx) = z.dim();
            let s = spectrum(z.view(), &grid(nx, ny));
            assert!(s.psd_nm2_mm2.iter().all(|p| *p < 1e-25) && s.band_rms_nm[0] < 1e-12);
        }
    }
}
