//! Power spectral densities of a rectangle of a map: along x, along y, in two dimensions, radial.
//!
//! The mathematics is [`planish_numerics::spectrum`], in nm and mm; the plane or the mean of the rectangle
//! is subtracted first.
//!
//! ```text
//! radial           mean of S over the ring |f| = (k +- 1/2) df,  nm^2 mm^2
//! band RMS^2 = sum of S df over the bins with f_0 <= f < f_1
//! ```
//!
//! The rectangle is the largest one without an invalid pixel; on a circular aperture that is the
//! inscribed square. A report takes its spectra from the same rectangle.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | rectangle of the map | (ny, nx) | nm |
//! | f | `frequency_*_per_mm` | | 1/mm |
//! | S | `psd_*` | | nm^2 mm^2, nm^2 mm |

use ndarray::{Array2, ArrayView2, s};
use planish_numerics::{
    spectrum::{
        Density, MIN_SAMPLES, along_rows, hann, largest_rectangle, without_mean, without_plane,
    },
    statistics::statistics,
};
use planish_types::{Grid, Invalid, Surface};
use serde::Serialize;

/// Settings with which the spectra are computed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PsdSettings {
    /// Window that weights the pixels along both axes.
    pub window: Window,
    /// Function that is subtracted from the rectangle before the transform.
    pub detrend: Detrend,
    /// Bands [f_0, f_1) whose RMS is wanted, 1/mm.
    pub band_per_mm: Vec<[f64; 2]>,
}

/// Weight of the pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Window {
    /// `w[i] = (1 - cos(2 pi i / n)) / 2` (periodic).
    Hann,
    /// 1.
    Rectangular,
}

/// Function that is subtracted from the rectangle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Detrend {
    /// The mean.
    Mean,
    /// The least-squares plane.
    Plane,
}

/// Spectra of the largest rectangle of valid pixels of a map.
#[derive(Clone, Debug)]
pub struct Psd {
    /// Frequencies along x of `psd_2d_nm2_mm2` (nx), 1/mm; ascending, from negative to positive.
    pub frequency_2d_x_per_mm: Vec<f64>,
    /// Frequencies along y of `psd_2d_nm2_mm2` (ny), 1/mm; ascending, from negative to positive.
    pub frequency_2d_y_per_mm: Vec<f64>,
    /// Two-dimensional PSD for both signs of the frequencies (ny, nx), nm^2 mm^2.
    pub psd_2d_nm2_mm2: Array2<f64>,
    /// Frequencies of `psd_x_nm2_mm` (nx / 2 + 1), from 0, 1/mm.
    pub frequency_x_per_mm: Vec<f64>,
    /// One-sided PSD along x, the mean over the rows, nm^2 mm.
    pub psd_x_nm2_mm: Vec<f64>,
    /// Frequencies of `psd_y_nm2_mm` (ny / 2 + 1), from 0, 1/mm.
    pub frequency_y_per_mm: Vec<f64>,
    /// One-sided PSD along y, the mean over the columns, nm^2 mm.
    pub psd_y_nm2_mm: Vec<f64>,
    /// Middles of the rings of the radial PSD, 1/mm.
    pub frequency_radial_per_mm: Vec<f64>,
    /// Radial PSD: the mean of the two-dimensional PSD over rings of equal |f|, nm^2 mm^2; NaN for a ring without a
    /// frequency.
    pub psd_radial_nm2_mm2: Vec<f64>,
    /// Numbers of the spectra for the manifest.
    pub report: PsdReport,
}

/// Numbers of the spectra, for the manifest.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PsdReport {
    /// Smallest and largest x of a pixel centre of the rectangle, mm.
    pub x_mm: [f64; 2],
    /// Smallest and largest y of a pixel centre of the rectangle, mm.
    pub y_mm: [f64; 2],
    /// Number of pixels of the rectangle (rows, columns).
    pub shape: (usize, usize),
    /// Ratio of the number of pixels of the rectangle to that of valid pixels of the map.
    pub fraction_of_valid_pixels: f64,
    /// RMS of the detrended rectangle without a window, nm.
    pub rms_nm: f64,
    /// Root of the integral of the two-dimensional PSD, nm: the RMS of the rectangle, weighted by the window.
    pub spectral_rms_nm: f64,
    /// RMS in each band, in the order of the settings.
    pub bands: Vec<BandRms>,
}

/// RMS within a band of spatial frequencies.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BandRms {
    /// Band [f_0, f_1) of spatial frequencies, 1/mm.
    pub band_per_mm: [f64; 2],
    /// RMS from the two-dimensional PSD, over all frequencies with |f| in the band, nm.
    pub rms_nm: f64,
    /// RMS from the PSD along x, over the frequencies along x in the band, nm.
    pub rms_x_nm: f64,
    /// RMS from the PSD along y, over the frequencies along y in the band, nm.
    pub rms_y_nm: f64,
}

/// Computes the spectra of the largest rectangle of valid pixels of `surface`. Refuses a map whose largest rectangle
/// has too few pixels along an axis, and a band that holds no frequency of the map.
pub fn psd(surface: &Surface, settings: &PsdSettings) -> Result<Psd, Invalid> {
    let (origin, (ny, nx)) = largest_rectangle(&surface.height_nm().mapv(|v| !v.is_nan()));
    if ny < MIN_SAMPLES || nx < MIN_SAMPLES {
        return Err(Invalid::whole(
            "psd",
            format!("the largest rectangle of valid pixels has {nx} x {ny} px"),
            format!(
                "give a map with at least {MIN_SAMPLES} x {MIN_SAMPLES} px without a hole \
                 (prepare with `fill` fills them)"
            ),
        ));
    }
    let rectangle = s![origin.0..origin.0 + ny, origin.1..origin.1 + nx];
    let grid = Grid {
        x: surface.grid().x.crop(origin.1, origin.1 + nx - 1)?,
        y: surface.grid().y.crop(origin.0, origin.0 + ny - 1)?,
    };
    let z = detrended(surface.height_nm().slice(rectangle), &grid, settings.detrend);
    let [dx, dy] = [grid.x, grid.y].map(|axis| axis.step_mm());
    let [w_x, w_y] = [nx, ny].map(|n| weights(settings.window, n));

    let density = Density::new(z.view(), [dx, dy], [&w_x, &w_y]);
    let (frequency_x_per_mm, psd_x_nm2_mm) = along_rows(z.view(), dx, &w_x);
    let (frequency_y_per_mm, psd_y_nm2_mm) = along_rows(z.t(), dy, &w_y);
    let (frequency_radial_per_mm, psd_radial_nm2_mm2) = radial(&density);

    let highest = (0.5 / dx).hypot(0.5 / dy);
    let mut bands = Vec::new();
    for band in &settings.band_per_mm {
        check_band(*band, (frequency_x_per_mm[1]).min(frequency_y_per_mm[1]), highest)?;
        bands.push(BandRms {
            band_per_mm: *band,
            rms_nm: density.mean_square(*band).sqrt(),
            rms_x_nm: mean_square(&frequency_x_per_mm, &psd_x_nm2_mm, *band).sqrt(),
            rms_y_nm: mean_square(&frequency_y_per_mm, &psd_y_nm2_mm, *band).sqrt(),
        });
    }
    let report = PsdReport {
        x_mm: [grid.x.start_mm(), grid.x.end_mm()],
        y_mm: [grid.y.start_mm(), grid.y.end_mm()],
        shape: (ny, nx),
        fraction_of_valid_pixels: (nx * ny) as f64 / surface.statistics().valid_count as f64,
        rms_nm: statistics(z.view()).map_or(0.0, |s| s.rms),
        spectral_rms_nm: density.total().sqrt(),
        bands,
    };
    Ok(Psd {
        frequency_2d_x_per_mm: density.frequency_x,
        frequency_2d_y_per_mm: density.frequency_y,
        psd_2d_nm2_mm2: density.density,
        frequency_x_per_mm,
        psd_x_nm2_mm,
        frequency_y_per_mm,
        psd_y_nm2_mm,
        frequency_radial_per_mm,
        psd_radial_nm2_mm2,
        report,
    })
}

/// Returns the mean square in the band [f_0, f_1) of a one-sided `density` S at equally spaced frequencies from 0: the
/// sum of S df.
pub(crate) fn mean_square(frequency_per_mm: &[f64], density: &[f64], [low, high]: [f64; 2]) -> f64 {
    let all = frequency_per_mm.iter().zip(density);
    let inside = all.filter(|(f, _)| **f >= low && **f < high);
    inside.map(|(_, s)| s).sum::<f64>() * (frequency_per_mm[1] - frequency_per_mm[0])
}

fn check_band([low, high]: [f64; 2], lowest: f64, highest: f64) -> Result<(), Invalid> {
    if low >= 0.0 && low < high && high.is_finite() && low < highest && high > lowest {
        return Ok(());
    }
    Err(Invalid::whole(
        "band",
        format!("{low} .. {high} /mm holds no frequency of the map ({lowest} .. {highest} /mm)"),
        "give 0 <= low < high in 1/mm; a wavelength L is 1 / L",
    ))
}

fn detrended(z: ArrayView2<f64>, grid: &Grid, detrend: Detrend) -> Array2<f64> {
    match detrend {
        Detrend::Plane => without_plane(z, &grid.x.coordinates(), &grid.y.coordinates()),
        Detrend::Mean => without_mean(z),
    }
}

fn weights(window: Window, n: usize) -> Vec<f64> {
    match window {
        Window::Hann => hann(n),
        Window::Rectangular => vec![1.0; n],
    }
}

/// Returns the middles of rings in the frequency plane, 1/mm, and the mean density over each. Rings are as wide as the
/// coarser of the two frequency steps, up to the lower Nyquist frequency. The ring about 0 contains frequencies nearer
/// to 0 than half a step.
fn radial(density: &Density) -> (Vec<f64>, Vec<f64>) {
    let Density { frequency_x: fx, frequency_y: fy, .. } = density;
    let df = (fx[1] - fx[0]).max(fy[1] - fy[0]);
    let nyquist = fx[fx.len() - 1].min(fy[fy.len() - 1]);
    let count = (nyquist / df + 1e-9).floor() as usize + 1;
    let rings = density.rings(count, |f| Some((f / df).round() as usize));
    // Rings are as wide as the coarser step: each has a bin on an axis.
    let means = rings.iter().map(|ring| ring.map_or(f64::NAN, |r| r.density)).collect();
    ((0..count).map(|k| k as f64 * df).collect(), means)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the frequency at which a density is largest, 1/mm; the first bin does not count.
    fn strongest_per_mm(frequency_per_mm: &[f64], density: &[f64]) -> f64 {
        let points = frequency_per_mm.iter().zip(density).skip(1);
        points.fold((0.0, 0.0), |best, (f, s)| if *s > best.1 { (*f, *s) } else { best }).0
    }
    use planish_numerics::spectrum::mean_square;
    use planish_types::Axis;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};
    use std::f64::consts::PI;

    const WINDOWS: [Window; 2] = [Window::Hann, Window::Rectangular];

    fn grid(nx: usize, ny: usize) -> Grid {
        Grid { x: Axis::new(3.0, 0.1, nx).unwrap(), y: Axis::new(-1.0, 0.15, ny).unwrap() }
    }

    fn settings(window: Window, band_per_mm: Vec<[f64; 2]>) -> PsdSettings {
        PsdSettings { window, detrend: Detrend::Mean, band_per_mm }
    }

    fn map(g: Grid, f: impl FnMut((usize, usize)) -> f64) -> Surface {
        Surface::new(g, Array2::from_shape_fn(g.shape(), f)).unwrap()
    }

    #[test]
    fn the_band_of_a_sine_holds_half_its_amplitude_squared_in_all_spectra() {
        // 20 periods in 200 px of 0.1 mm along x: 1 /mm; amplitude 1 nm.
        let g = grid(200, 64);
        let wave = |c: usize| (2.0 * PI * 20.0 * c as f64 / 200.0 + 0.3).sin();
        let surface = map(g, |(_, c)| wave(c));
        for window in WINDOWS {
            let found = psd(&surface, &settings(window, vec![[0.8, 1.2], [1.2, 3.0]])).unwrap();
            let [band, other] = found.report.bands[..] else { panic!() };
            // 1 / sqrt(2) to rounding: the window's own spectrum ends within three bins of 0.05.
            assert!((band.rms_nm - 0.5_f64.sqrt()).abs() < 1e-12, "{window:?} {band:?}");
            assert!((band.rms_x_nm - 0.5_f64.sqrt()).abs() < 1e-12, "{window:?} {band:?}");
            // Along y there is nothing but the same height everywhere: it is at f = 0.
            assert!(band.rms_y_nm < 1e-12 && other.rms_nm < 1e-12 && other.rms_x_nm < 1e-12);
            let strongest = strongest_per_mm(&found.frequency_x_per_mm, &found.psd_x_nm2_mm);
            // The bins lie on multiples of 0.05 / mm: rounding.
            assert!((strongest - 1.0).abs() < 1e-12);
        }
        // Transposed, it is along y.
        let g = Grid { x: g.x, y: Axis::new(0.0, 0.1, 200).unwrap() };
        let found = psd(&map(g, |(r, _)| wave(r)), &settings(Window::Hann, vec![[0.8, 1.2]]));
        let band = found.unwrap().report.bands[0];
        // Rounding, as above.
        assert!((band.rms_y_nm - 0.5_f64.sqrt()).abs() < 1e-12 && band.rms_x_nm < 1e-12);
    }

    #[test]
    fn parseval_holds_for_every_parity_and_window() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        for (nx, ny) in [(30, 21), (31, 22), (16, 16), (17, 9)] {
            let surface = map(grid(nx, ny), |_| rng.random_range(-3.0..5.0));
            for window in WINDOWS {
                let p = psd(&surface, &settings(window, vec![[0.0, 99.0]])).unwrap();
                let (w_x, w_y) = (weights(window, nx), weights(window, ny));
                let mean = surface.statistics().mean;
                let z = |r: usize, c: usize| surface.height_nm()[[r, c]] - mean;
                let (mut both, mut along_x) = (0.0, 0.0);
                for (r, c) in (0..ny).flat_map(|r| (0..nx).map(move |c| (r, c))) {
                    both += (z(r, c) * w_y[r] * w_x[c]).powi(2);
                    along_x += (z(r, c) * w_x[c]).powi(2);
                }
                let n = (nx * ny) as f64;
                both /= n * mean_square(&w_x) * mean_square(&w_y);
                along_x /= n * mean_square(&w_x);
                let report = &p.report;
                // Sums of a few hundred terms.
                assert!((report.spectral_rms_nm.powi(2) / both - 1.0).abs() < 1e-12);
                // As above.
                assert!((report.bands[0].rms_nm.powi(2) / both - 1.0).abs() < 1e-12);
                assert!((report.bands[0].rms_x_nm.powi(2) / along_x - 1.0).abs() < 1e-12);
                if window == Window::Rectangular {
                    assert!((report.spectral_rms_nm / report.rms_nm - 1.0).abs() < 1e-12);
                    // PSD along x = integral of the two-dimensional one over f_y (both signs).
                    let df_y = 1.0 / (ny as f64 * 0.15);
                    for (k, f) in p.frequency_x_per_mm.iter().enumerate() {
                        let at = |sign: f64| {
                            let near = |v: &f64| (v - sign * f).abs() < 1e-9;
                            p.frequency_2d_x_per_mm.iter().position(near)
                        };
                        let columns = if k == 0 || 2 * k == nx {
                            vec![at(1.0)]
                        } else {
                            vec![at(1.0), at(-1.0)]
                        };
                        let sum: f64 = columns
                            .into_iter()
                            .map(|c| p.psd_2d_nm2_mm2.column(c.unwrap()).sum() * df_y)
                            .sum();
                        // As above; where the sum is small, of 1e-3.
                        assert!((sum - p.psd_x_nm2_mm[k]).abs() < 1e-12 * sum.max(1e-3));
                    }
                }
            }
        }
    }

    #[test]
    fn white_noise_has_the_level_of_its_variance_times_the_pixel() {
        let sigma = 0.7;
        let normal = Normal::new(0.0, sigma).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let surface = map(grid(256, 256), |_| normal.sample(&mut rng));
        for window in WINDOWS {
            let p = psd(&surface, &settings(window, vec![])).unwrap();
            let mean = |s: &[f64]| s[2..s.len() - 1].iter().sum::<f64>() / (s.len() - 3) as f64;
            // Two-sided and two-dimensional: sigma^2 dx dy. One-sided along a line: 2 sigma^2 dx.
            // 65536 samples: the mean is known to 1 / 256; 1 % is 2.5 standard deviations, 2 with
            // the window's weights.
            let level = sigma * sigma;
            // As above: 2 %.
            assert!((mean(&p.psd_radial_nm2_mm2) / (level * 0.1 * 0.15) - 1.0).abs() < 0.02);
            assert!((mean(&p.psd_x_nm2_mm) / (2.0 * level * 0.1) - 1.0).abs() < 0.02);
            assert!((mean(&p.psd_y_nm2_mm) / (2.0 * level * 0.15) - 1.0).abs() < 0.02);
        }
    }

    #[test]
    fn a_slanted_wave_is_where_its_vector_points() {
        // 6 periods along x in 20 mm, 4 along y in 9.6 mm.
        let g = Grid { x: Axis::new(0.0, 0.1, 200).unwrap(), y: Axis::new(0.0, 0.1, 96).unwrap() };
        let surface =
            map(g, |(r, c)| (2.0 * PI * (6.0 * c as f64 / 200.0 + 4.0 * r as f64 / 96.0)).cos());
        let p = psd(&surface, &settings(Window::Rectangular, vec![])).unwrap();
        let peaks: Vec<_> =
            p.psd_2d_nm2_mm2.indexed_iter().filter(|(_, s)| **s > 1e-6).map(|(at, _)| at).collect();
        let at: Vec<_> = peaks
            .iter()
            .map(|(r, c)| [p.frequency_2d_x_per_mm[*c] * 20.0, p.frequency_2d_y_per_mm[*r] * 9.6])
            .collect();
        assert_eq!(at.len(), 2);
        for (found, want) in at.iter().zip([[-6.0, -4.0], [6.0, 4.0]]) {
            // The bins lie on these frequencies: rounding.
            assert!((0..2).all(|k| (found[k] - want[k]).abs() < 1e-12), "{at:?}");
        }
        // |f| = hypot(0.3, 0.4167) = 0.5134; rings of 0.1042: the fifth.
        let ring = strongest_per_mm(&p.frequency_radial_per_mm, &p.psd_radial_nm2_mm2);
        assert!((ring - 5.0 / 9.6).abs() < 1e-12, "{ring}");
    }

    #[test]
    fn a_tilt_leaks_unless_it_is_taken_off() {
        let surface = map(grid(100, 80), |(r, c)| 3.0 * c as f64 - r as f64);
        let band = vec![[1.0, 2.0]];
        let with = PsdSettings { detrend: Detrend::Plane, ..settings(Window::Hann, band.clone()) };
        // Rounding of heights of 300 nm.
        assert!(psd(&surface, &with).unwrap().report.bands[0].rms_nm < 1e-10);
        let without = psd(&surface, &settings(Window::Rectangular, band)).unwrap();
        assert!(without.report.bands[0].rms_nm > 1.0);
    }

    #[test]
    fn what_has_no_spectrum_says_why() {
        let surface = map(grid(40, 40), |(r, c)| if r % 7 == c % 7 { f64::NAN } else { 1.0 });
        let error = psd(&surface, &settings(Window::Hann, vec![])).unwrap_err().to_string();
        assert!(error.contains("largest rectangle of valid pixels has"), "{error}");
        let surface = map(grid(40, 40), |(r, _)| r as f64);
        for band in [[2.0, 1.0], [-1.0, 2.0], [20.0, 30.0], [0.0, 0.01], [f64::NAN, 1.0]] {
            let error = psd(&surface, &settings(Window::Hann, vec![band])).unwrap_err();
            assert!(error.to_string().contains("holds no frequency"), "{error}");
        }
    }
}
