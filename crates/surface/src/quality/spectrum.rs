//! Spectra of the heights and slopes that remain after the best shape, and their autocorrelation length.

use std::f64::consts::PI;

use ndarray::{Array2, ArrayView2, s};
use planish_numerics::{
    fft::{Complex64, transform},
    spectrum::{MIN_SAMPLES, along_rows, hann, largest_rectangle, without_plane},
    statistics::statistics,
};
use planish_types::{Invalid, Surface};

use crate::{
    psd::{Detrend, Psd, PsdSettings, Window, mean_square, psd},
    shape::{Heights, Shape, without_shape},
};

/// Power spectral densities of the heights and of the slopes, at the same frequencies.
#[derive(Clone, Debug, Default)]
pub struct SpectrumLine {
    /// Frequencies, ascending from 0, 1/mm.
    pub frequency_per_mm: Vec<f64>,
    /// Density of the heights: one-sided along an axis, nm^2 mm; as means over rings, nm^2 mm^2.
    pub height: Vec<f64>,
    /// Density of the slopes: one-sided along an axis, nrad^2 mm; as means over rings, nrad^2 mm^2.
    pub slope: Vec<f64>,
}

impl SpectrumLine {
    /// Makes both densities from the density S of the heights. The density of the slopes is (2 pi f)^2 S, in nrad^2
    /// from nm^2 (1 nm/mm is 1 urad).
    fn of_heights(frequency_per_mm: Vec<f64>, height: Vec<f64>) -> Self {
        let slope = frequency_per_mm.iter().zip(&height);
        let slope = slope.map(|(f, s)| (2.0 * PI * f * 1e3).powi(2) * s).collect();
        Self { frequency_per_mm, height, slope }
    }

    /// Makes both densities along the rows of a map of heights `z`, nm, as means over the rows. The mean of each row is
    /// subtracted first, because the window would spread it over the lowest frequencies.
    fn of_rows(z: ArrayView2<f64>, step_mm: f64) -> Self {
        let mut z = z.to_owned();
        for mut line in z.outer_iter_mut() {
            let mean = line.mean().unwrap_or(0.0);
            line.mapv_inplace(|v| v - mean);
        }
        let (f, density) = along_rows(z.view(), step_mm, &hann(z.ncols()));
        Self::of_heights(f, density)
    }
    /// Makes both densities from the density of the slopes. The density of the heights is that over (2 pi f)^2, and 0
    /// at f = 0, where it is not defined.
    fn of_slopes(frequency_per_mm: Vec<f64>, slope: Vec<f64>) -> Self {
        let height = frequency_per_mm.iter().zip(&slope);
        let height = height
            .map(|(f, s)| if *f > 0.0 { s / (2.0 * PI * f * 1e3).powi(2) } else { 0.0 })
            .collect();
        Self { frequency_per_mm, height, slope }
    }

    /// Makes both densities at the same frequencies from a constant density of the heights.
    fn flat(&self, density: f64) -> Self {
        let f = self.frequency_per_mm.clone();
        let density = vec![density; f.len()];
        Self::of_heights(f, density)
    }
    /// Returns both densities of white noise of `noise_nm` RMS along a line, at the same frequencies. The noise is
    /// spread from 0 to the last frequency.
    fn white(&self, noise_nm: f64) -> Self {
        let highest = self.frequency_per_mm.last().copied().unwrap_or(1.0);
        self.flat(noise_nm * noise_nm / highest)
    }

    /// Returns the RMS of the heights in the band [f_0, f_1), 1/mm, in nm.
    pub(crate) fn height_rms(&self, band: [f64; 2]) -> f64 {
        mean_square(&self.frequency_per_mm, &self.height, band).sqrt()
    }

    /// Returns the RMS of the slopes in the band [f_0, f_1), 1/mm, in nrad.
    pub(crate) fn slope_rms(&self, band: [f64; 2]) -> f64 {
        mean_square(&self.frequency_per_mm, &self.slope, band).sqrt()
    }

    /// Returns true if a frequency of the spectrum above 0 is in the band [f_0, f_1), 1/mm.
    pub(crate) fn holds(&self, [low, high]: [f64; 2]) -> bool {
        self.frequency_per_mm.iter().any(|f| *f > 0.0 && *f >= low && *f < high)
    }
}

/// Spectra of a profile (along x), or of a map (along x, along y and in two dimensions).
pub(crate) struct Spectra {
    pub(crate) x: SpectrumLine,
    pub(crate) y: Option<SpectrumLine>,
    /// Two-dimensional spectrum, averaged over rings of equal |f|; `None` for a profile.
    pub(crate) radial: Option<SpectrumLine>,
    two_dimensional: Option<Psd>,
}

impl Spectra {
    /// Returns the RMS of the heights in the band [f_0, f_1), 1/mm, in nm; for a map over all frequencies in two
    /// dimensions.
    pub(crate) fn height_rms_nm(&self, [low, high]: [f64; 2]) -> f64 {
        let Some(psd) = &self.two_dimensional else { return self.x.height_rms([low, high]) };
        let (fx, fy) = (&psd.frequency_2d_x_per_mm, &psd.frequency_2d_y_per_mm);
        let bin = (fx[1] - fx[0]) * (fy[1] - fy[0]);
        let inside = psd.psd_2d_nm2_mm2.indexed_iter().filter(|((r, c), _)| {
            let f = fx[*c].hypot(fy[*r]);
            f >= low && f < high
        });
        (inside.map(|(_, s)| s).sum::<f64>() * bin).sqrt()
    }

    /// Returns the spectra of white noise of `noise_nm` RMS at the same frequencies. Its density is constant, and the
    /// integral of the density is the mean square.
    pub(crate) fn white(&self, noise_nm: f64) -> Self {
        let two_dimensional = self.two_dimensional.as_ref().map(|psd| {
            let (fx, fy) = (&psd.frequency_2d_x_per_mm, &psd.frequency_2d_y_per_mm);
            let area = (fx[1] - fx[0]) * (fy[1] - fy[0]) * psd.psd_2d_nm2_mm2.len() as f64;
            let mut white = psd.clone();
            white.psd_2d_nm2_mm2.fill(noise_nm * noise_nm / area);
            white
        });
        let radial = self.radial.as_ref().zip(two_dimensional.as_ref());
        Self {
            x: self.x.white(noise_nm),
            y: self.y.as_ref().map(|y| y.white(noise_nm)),
            radial: radial.map(|(line, white)| line.flat(white.psd_2d_nm2_mm2[[0, 0]])),
            two_dimensional,
        }
    }

    /// Returns the spectra of a map from which the shape has been subtracted.
    pub(super) fn of_map(surface: &Surface) -> Result<Self, Invalid> {
        let settings =
            PsdSettings { window: Window::Hann, detrend: Detrend::Plane, band_per_mm: vec![] };
        let psd = psd(surface, &settings)?;
        let (origin, (ny, nx)) = largest_rectangle(&surface.height_nm().mapv(|v| !v.is_nan()));
        let rows = origin.0..origin.0 + ny;
        let columns = origin.1..origin.1 + nx;
        let (x, y) = (surface.grid().x.coordinates(), surface.grid().y.coordinates());
        let z = surface.height_nm().slice(s![rows.clone(), columns.clone()]);
        let z = without_plane(z, &x[columns], &y[rows]);
        let radial = SpectrumLine::of_heights(
            psd.frequency_radial_per_mm.clone(),
            psd.psd_radial_nm2_mm2.clone(),
        );
        Ok(Self {
            x: SpectrumLine::of_rows(z.view(), surface.grid().x.step_mm()),
            y: Some(SpectrumLine::of_rows(z.t(), surface.grid().y.step_mm())),
            radial: Some(radial),
            two_dimensional: Some(psd),
        })
    }

    /// Returns the spectra of the heights of a profile, nm, from which the shape has been subtracted.
    pub(super) fn of_heights(x_mm: &[f64], height_nm: &[f64]) -> Result<Self, Invalid> {
        let (f, density) = density_of_profile(x_mm, height_nm, Shape::Plane)?;
        Ok(Self::of_line(SpectrumLine::of_heights(f, density)))
    }

    /// Returns the spectra of the measured slopes of a profile, nrad, from which those of the shape have been
    /// subtracted.
    pub(super) fn of_slopes(x_mm: &[f64], slope_nrad: &[f64]) -> Result<Self, Invalid> {
        let (f, density) = density_of_profile(x_mm, slope_nrad, Shape::Piston)?;
        Ok(Self::of_line(SpectrumLine::of_slopes(f, density)))
    }

    fn of_line(x: SpectrumLine) -> Self {
        Self { x, y: None, radial: None, two_dimensional: None }
    }
}

/// Returns the frequencies, 1/mm, and the density of the longest run of valid values of a profile at even steps. `rest`
/// is subtracted from the run first: its mean or its line.
fn density_of_profile(
    x_mm: &[f64],
    values: &[f64],
    rest: Shape,
) -> Result<(Vec<f64>, Vec<f64>), Invalid> {
    let n = x_mm.len();
    let step_mm = (x_mm[n - 1] - x_mm[0]) / (n - 1) as f64;
    let values = at_even_steps(x_mm, values, step_mm, x_mm.len());
    let (origin, (_, length)) = largest_rectangle(&values.mapv(|v| !v.is_nan()));
    if length < MIN_SAMPLES {
        let problem = format!("the longest run of valid positions has {length}");
        let remedy = format!("a spectrum needs at least {MIN_SAMPLES} without a gap");
        return Err(Invalid::whole("profile", problem, remedy));
    }
    let run = values.slice(s![.., origin.1..origin.1 + length]).to_owned();
    let even_mm: Vec<f64> = (0..length).map(|i| i as f64 * step_mm).collect();
    let line = Heights { x_mm: &even_mm, y_mm: &[0.0], height_nm: &run };
    let (run, _) = without_shape(&line, rest, None)?;
    Ok(along_rows(run.view(), step_mm, &hann(length)))
}

/// Returns `values` at positions `x`, interpolated linearly, as one row of `count` positions at distances of `step`
/// from the first. NaN next to an invalid value.
pub(crate) fn at_even_steps(x: &[f64], values: &[f64], step: f64, count: usize) -> Array2<f64> {
    let n = x.len();
    Array2::from_shape_fn((1, count), |(_, c)| {
        let position = x[0] + c as f64 * step;
        let i = x.partition_point(|v| *v <= position).clamp(1, n - 1);
        let part = ((position - x[i - 1]) / (x[i] - x[i - 1])).clamp(0.0, 1.0);
        // If an even step meets a position but for rounding, the value there is used as it is: its
        // neighbour may be invalid.
        match part {
            p if p < 1e-9 => values[i - 1],
            p if p > 1.0 - 1e-9 => values[i],
            p => (1.0 - p) * values[i - 1] + p * values[i],
        }
    })
}

/// Returns the lag, in samples, at which the autocorrelation C of the rows falls to 1/e of C(0), between two samples if
/// need be. `None` if it does not.
///
/// C(k) = sum of z_i z_(i+k) over the pairs of valid samples, over their number: both sums are correlations,
/// whose transforms are squares.
pub(super) fn autocorrelation_length(rows: ArrayView2<f64>) -> Option<f64> {
    let mean = statistics(rows)?.mean;
    let n = rows.ncols();
    let products = correlations(rows, |v| v - mean);
    let pairs = correlations(rows, |_| 1.0);
    let variance = products[[0, 0]] / pairs[[0, 0]];
    if !(pairs[[0, 0]] > 0.5 && variance > 0.0) {
        return None;
    }
    let mut before = 1.0;
    for k in 1..n {
        // At least half a pair: the counts are whole but for rounding.
        if pairs[[0, k]] <= 0.5 {
            return None;
        }
        let now = products[[0, k]] / pairs[[0, k]] / variance;
        if now <= (-1.0_f64).exp() {
            let part = (before - (-1.0_f64).exp()) / (before - now);
            return Some((k - 1) as f64 + part);
        }
        before = now;
    }
    None
}

/// Returns, for every lag k, the sum over the rows of f(z_i) f(z_(i+k)) over the pairs of valid samples, with f =
/// `value`.
fn correlations(rows: ArrayView2<f64>, value: impl Fn(f64) -> f64) -> Array2<f64> {
    let (count, n) = rows.dim();
    // Rows with zeros beyond their end: no lag below n wraps round.
    let m = (2 * n).next_power_of_two();
    let mut power = vec![0.0; m];
    for r in 0..count {
        let line = Array2::from_shape_fn((1, m), |(_, c)| {
            let v = if c < n { rows[[r, c]] } else { f64::NAN };
            if v.is_nan() { 0.0 } else { value(v) }
        });
        let spectrum = transform::forward(line.view());
        power.iter_mut().zip(&spectrum).for_each(|(p, f)| *p += f.norm_sqr());
    }
    let power = Array2::from_shape_fn((1, m), |(_, k)| Complex64::new(power[k], 0.0));
    transform::inverse(power)
}
