//! What a mirror is bought by: slope errors, heights after the best shape, bands, spectra.
//!
//! ```text
//! slope          s = (z(x + base) - z(x)) / base, nrad; RMS without the mean
//! slope PSD      (2 pi f)^2 S(f), nrad^2 mm
//! slope in band  RMS^2 = sum of (2 pi f)^2 S df,   f_0 <= f < f_1, f along the axis of the slope
//! autocorrelation length    the lag at which <z(x) z(x + lag)> / <z^2> falls to 1/e
//! Strehl (Marechal)         exp(-(4 pi sin(g) RMS / wavelength)^2),   g the grazing angle
//! ```
//!
//! A map gives slopes along both axes, a measured profile along x. Heights of a profile of slopes are their
//! integral (trapezoids) after the shape is taken off; slopes of heights that are not measured are differences
//! over the base. From a map the heights of the best shape are taken off, whose slopes are not those of least
//! squares; from the slopes of a profile, measured or not, the slopes of least squares, as profilers do.
//!
//! Spectra are those of [`crate::psd`]: of the largest rectangle of valid pixels, or of the longest run of valid
//! positions, under a Hann window; along a direction the mean of every line is taken off first. Where the positions of a profile are uneven, its values are interpolated
//! linearly at as many even ones.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | z | `height_nm` | nm |
//! | s | `slope_*_nrad` | nrad |
//! | S | `psd_*` | nm^2 mm, nm^2 mm^2 |

use std::{cell::OnceCell, f64::consts::PI};

use ndarray::{Array2, ArrayView2, s};
use planish_numerics::{
    fft::transform,
    slope::{self, slopes, steps_of_base},
    spectrum::{MIN_SAMPLES, along_rows, hann, largest_rectangle, without_plane},
    statistics::{Statistics, statistics},
};
use planish_types::{Invalid, Surface, text::significant};
use serde::{Deserialize, Serialize};

use crate::{
    profile::{Profile, Values},
    psd::{Detrend, Psd, PsdSettings, Window, psd},
    shape::{EllipseSettings, Heights, Shape, ShapeReport, without_shape, without_shape_of_slopes},
};

/// A base length that is off by more than this fraction from the one asked for is worth a note.
const NOTEWORTHY_BASE: f64 = 0.02;

/// A standard error of an ellipse's parameter above this says that the data hardly tell it.
const NOTEWORTHY_ERROR: f64 = 0.1;

/// A phase error above this, rad, is beyond what Marechal's formula is for (Strehl 0.37).
const LARGEST_PHASE_RAD: f64 = 1.0;

/// What is measured.
#[derive(Clone, Debug)]
pub enum Subject {
    /// A map.
    Map(Surface),
    /// A line.
    Profile(Profile),
}

/// Along which direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Direction {
    /// Along x.
    X,
    /// Along y.
    Y,
    /// In two dimensions, averaged over the directions.
    Radial,
}

/// How it is measured.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct QualitySettings {
    /// The shape that is taken off before anything is measured.
    pub after: Shape,
    /// The ellipse, where one is known.
    pub ellipse: Option<EllipseSettings>,
    /// Base length of slopes, mm.
    pub base_mm: f64,
    /// Bands [f_0, f_1) of spatial frequencies, 1/mm.
    pub band_per_mm: Vec<[f64; 2]>,
    /// Width of the strip about the middle of y whose mean is the centre line, mm; 0 for one row.
    pub centre_line_width_mm: f64,
    /// Light for which the Strehl ratio is wanted.
    pub light: Option<Light>,
}

/// The light that a mirror reflects.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Light {
    /// Wavelength, nm.
    pub wavelength_nm: f64,
    /// Grazing angle, mrad; 1570.8 is normal incidence.
    pub grazing_mrad: f64,
}

/// Everything that was measured.
#[derive(Clone, Debug, Serialize)]
pub struct Quality {
    /// The shape that was taken off.
    pub shape: ShapeReport,
    /// Height after that shape.
    pub height: HeightReport,
    /// Slopes along x after that shape.
    pub slope_x: SlopeReport,
    /// Along y; `null` of a profile, and where the base does not fit.
    pub slope_y: Option<SlopeReport>,
    /// Height and slope after each shape that can be told.
    pub after: Vec<AfterShape>,
    /// The bands.
    pub bands: Vec<BandReport>,
    /// The line along x through the middle; `null` of a profile, which is one.
    pub centre_line: Option<LineReport>,
    /// Autocorrelation length along x, mm; `null` where it is longer than the map.
    pub autocorrelation_length_x_mm: Option<f64>,
    /// Along y.
    pub autocorrelation_length_y_mm: Option<f64>,
    /// The Strehl ratio, where light was given.
    pub strehl: Option<StrehlReport>,
    /// What else is worth knowing.
    pub notes: Vec<String>,
    /// The arrays.
    #[serde(skip)]
    pub arrays: QualityArrays,
}

/// Heights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct HeightReport {
    /// RMS without the mean, nm.
    pub rms_nm: f64,
    /// Largest minus smallest, nm.
    pub pv_nm: f64,
    /// Valid pixels or positions.
    pub valid_count: usize,
}

/// Slopes along one axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SlopeReport {
    /// Base length, mm; 0 where slopes were measured.
    pub base_mm: f64,
    /// RMS without the mean, nrad.
    pub rms_nrad: f64,
    /// Largest distance from the mean, nrad.
    pub peak_nrad: f64,
    /// The middle of the base of the largest one, [x, y], mm.
    pub peak_at_mm: [f64; 2],
}

/// What is left after a shape.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AfterShape {
    /// The shape, as it was fitted.
    pub shape: ShapeReport,
    /// RMS height, nm.
    pub height_rms_nm: f64,
    /// PV, nm.
    pub height_pv_nm: f64,
    /// RMS slope along x, nrad.
    pub slope_x_rms_nrad: Option<f64>,
    /// RMS slope along y, nrad.
    pub slope_y_rms_nrad: Option<f64>,
}

/// RMS within a band.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BandReport {
    /// [f_0, f_1), 1/mm.
    pub band_per_mm: [f64; 2],
    /// Of the heights, nm: of a map over |f| in two dimensions.
    pub height_rms_nm: f64,
    /// Of the slopes along x, nrad, over the frequency along x.
    pub slope_x_rms_nrad: f64,
    /// Of the slopes along y, nrad; `null` of a profile.
    pub slope_y_rms_nrad: Option<f64>,
}

/// The centre line.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LineReport {
    /// Smallest and largest y of its rows, mm.
    pub y_mm: [f64; 2],
    /// RMS height, nm.
    pub height_rms_nm: f64,
    /// PV, nm.
    pub height_pv_nm: f64,
    /// RMS slope, nrad.
    pub slope_rms_nrad: Option<f64>,
}

/// The Strehl ratio after Marechal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StrehlReport {
    /// The light.
    pub light: Light,
    /// RMS of the phase, rad.
    pub phase_rms_rad: f64,
    /// The ratio.
    pub strehl: f64,
}

/// What is stored beside the numbers; empty where there is none.
#[derive(Clone, Debug, Default)]
pub struct QualityArrays {
    /// Positions of the centre line, or of the profile (n), mm.
    pub position_mm: Vec<f64>,
    /// Its heights (n), nm; NaN where invalid.
    pub height_nm: Vec<f64>,
    /// Positions of its slopes (m), mm.
    pub slope_position_mm: Vec<f64>,
    /// Its slopes (m), nrad; NaN where invalid.
    pub slope_nrad: Vec<f64>,
    /// Densities along x, along y, and over rings.
    pub lines: [SpectrumLine; 3],
}

/// A density of heights and that of the slopes.
#[derive(Clone, Debug, Default)]
pub struct SpectrumLine {
    /// Frequencies, ascending from 0, 1/mm.
    pub frequency_per_mm: Vec<f64>,
    /// Of heights: nm^2 mm, over rings nm^2 mm^2.
    pub height: Vec<f64>,
    /// Of slopes: nrad^2 mm, over rings nrad^2 mm^2.
    pub slope: Vec<f64>,
}

impl SpectrumLine {
    /// (2 pi f)^2 S in nrad^2 from S in nm^2; nm/mm is urad.
    fn of_heights(frequency_per_mm: Vec<f64>, height: Vec<f64>) -> Self {
        let slope = frequency_per_mm.iter().zip(&height);
        let slope = slope.map(|(f, s)| (2.0 * PI * f * 1e3).powi(2) * s).collect();
        Self { frequency_per_mm, height, slope }
    }

    /// The same the other way round; the mean slope says nothing of a height.
    fn of_slopes(frequency_per_mm: Vec<f64>, slope: Vec<f64>) -> Self {
        let height = frequency_per_mm.iter().zip(&slope);
        let height = height.map(|(f, s)| match *f > 0.0 {
            true => s / (2.0 * PI * f * 1e3).powi(2),
            false => 0.0,
        });
        let height = height.collect();
        Self { frequency_per_mm, height, slope }
    }

    /// Sum of S df over the frequencies in [f_0, f_1).
    fn mean_square(&self, density: &[f64], [low, high]: [f64; 2]) -> f64 {
        let f = &self.frequency_per_mm;
        let inside = f.iter().zip(density).filter(|(f, _)| **f >= low && **f < high);
        inside.map(|(_, s)| s).sum::<f64>() * (f[1] - f[0])
    }

    /// RMS of heights in the band, nm.
    pub(crate) fn height_rms(&self, band: [f64; 2]) -> f64 {
        self.mean_square(&self.height, band).sqrt()
    }

    /// RMS of slopes in the band, nrad.
    pub(crate) fn slope_rms(&self, band: [f64; 2]) -> f64 {
        self.mean_square(&self.slope, band).sqrt()
    }

    /// Whether a frequency is in the band.
    pub(crate) fn holds(&self, [low, high]: [f64; 2]) -> bool {
        self.frequency_per_mm.iter().any(|f| *f > 0.0 && *f >= low && *f < high)
    }
}

/// The spectra of a piece: along x, along y (of a map), in two dimensions (of a map).
pub(crate) struct Spectra {
    pub(crate) x: SpectrumLine,
    pub(crate) y: Option<SpectrumLine>,
    pub(crate) radial: Option<SpectrumLine>,
    two_dimensional: Option<Psd>,
}

impl Spectra {
    /// RMS of heights in a band, nm: of a map in two dimensions.
    pub(crate) fn height_rms_nm(&self, [low, high]: [f64; 2]) -> f64 {
        let Some(psd) = &self.two_dimensional else { return self.x.height_rms([low, high]) };
        let (fx, fy) = (&psd.frequency_2d_x_per_mm, &psd.frequency_2d_y_per_mm);
        let bin = (fx[1] - fx[0]) * (fy[1] - fy[0]);
        let of = psd.psd_2d_nm2_mm2.indexed_iter().filter(|((r, c), _)| {
            let f = fx[*c].hypot(fy[*r]);
            f >= low && f < high
        });
        (of.map(|(_, s)| s).sum::<f64>() * bin).sqrt()
    }
}

/// A map or a profile after its best shape.
pub(crate) struct Piece {
    x_mm: Vec<f64>,
    y_mm: Vec<f64>,
    /// (ny, nx), nm.
    height_nm: Array2<f64>,
    /// Of a profile: its measured slopes after the shape (nx), nrad.
    measured_slope_nrad: Option<Vec<f64>>,
    /// The map, for its spectra.
    surface: Option<Surface>,
    pub(crate) shape: ShapeReport,
    pub(crate) notes: Vec<String>,
    spectra: OnceCell<Result<Spectra, Invalid>>,
}

impl Piece {
    /// `subject` where `inside` (all of it without one) after `shape`.
    pub(crate) fn new(
        subject: &Subject,
        inside: Option<&Array2<bool>>,
        shape: Shape,
        ellipse: Option<&EllipseSettings>,
    ) -> Result<Self, Invalid> {
        let masked = |map: &Array2<f64>| match inside {
            Some(inside) => {
                let mut map = map.clone();
                map.zip_mut_with(inside, |z, inside| {
                    if !inside {
                        *z = f64::NAN
                    }
                });
                map
            }
            None => map.clone(),
        };
        let row = |values: &[f64]| {
            let row = Array2::from_shape_fn((1, values.len()), |(_, c)| values[c]);
            masked(&row)
        };
        match subject {
            Subject::Map(surface) => {
                let (x_mm, y_mm) = (surface.grid().x.coordinates(), surface.grid().y.coordinates());
                let heights = masked(surface.height_nm());
                let heights = Heights { x_mm: &x_mm, y_mm: &y_mm, height_nm: &heights };
                let (height_nm, report) = without_shape(&heights, shape, ellipse)?;
                let surface = Some(Surface::new(*surface.grid(), height_nm.clone())?);
                Ok(Self::of(x_mm, y_mm, height_nm, None, surface, report))
            }
            Subject::Profile(profile) => {
                let x_mm = profile.position_mm().to_vec();
                let (height_nm, slope, report) = match profile.values() {
                    Values::HeightNm(heights) => {
                        let heights = row(heights);
                        let heights = Heights { x_mm: &x_mm, y_mm: &[0.0], height_nm: &heights };
                        let (left, report) = without_shape(&heights, shape, ellipse)?;
                        (left, None, report)
                    }
                    Values::SlopeNrad(slopes) => {
                        let slopes = row(slopes).into_raw_vec_and_offset().0;
                        let (left, report) =
                            without_shape_of_slopes(&x_mm, &slopes, shape, ellipse)?;
                        let heights = integrated(&x_mm, &left);
                        let heights = Heights { x_mm: &x_mm, y_mm: &[0.0], height_nm: &heights };
                        let (heights, _) = without_shape(&heights, rest_of(shape), None)?;
                        (heights, Some(left), report)
                    }
                };
                let mut piece = Self::of(x_mm, vec![0.0], height_nm, slope, None, report);
                if let Some([low, high]) = profile.uneven_steps_mm() {
                    piece.notes.push(format!(
                        "the positions are not uniform (steps of {} to {} mm): spectra are of values \
                         interpolated linearly at steps of {} mm",
                        significant(low, 6),
                        significant(high, 6),
                        significant(profile.step_mm(), 6)
                    ));
                }
                Ok(piece)
            }
        }
    }

    fn of(
        x_mm: Vec<f64>,
        y_mm: Vec<f64>,
        height_nm: Array2<f64>,
        measured_slope_nrad: Option<Vec<f64>>,
        surface: Option<Surface>,
        shape: ShapeReport,
    ) -> Self {
        let mut notes = Vec::new();
        if let Some(ellipse) = &shape.ellipse {
            let names = ["p", "q", "theta"].iter().zip(ellipse.standard_error);
            for (name, error) in names.filter(|(_, e)| *e > NOTEWORTHY_ERROR) {
                let how = match error.is_finite() {
                    true => format!("standard error {} %", significant(100.0 * error, 2)),
                    false => "it is infinite".into(),
                };
                notes.push(format!(
                    "the data hardly tell {name} of the ellipse ({how}); what is left is of the best one all the same"
                ));
            }
        }
        Self {
            x_mm,
            y_mm,
            height_nm,
            measured_slope_nrad,
            surface,
            shape,
            notes,
            spectra: OnceCell::new(),
        }
    }

    fn is_profile(&self) -> bool {
        self.surface.is_none()
    }

    pub(crate) fn height(&self) -> Result<Statistics, Invalid> {
        statistics(self.height_nm.view())
            .ok_or_else(|| Invalid::whole("map", "has no valid pixel here", "give another zone"))
    }

    /// Where the height is farthest from its mean, [x, y], mm, and by how much, nm.
    pub(crate) fn farthest_height(&self) -> Result<([f64; 2], f64), Invalid> {
        let mean = self.height()?.mean;
        let ((r, c), distance) = farthest(self.height_nm.view(), mean);
        Ok(([self.x_mm[c], self.y_mm[r]], distance))
    }

    /// Slopes along an axis over the whole number of steps nearest to the base; measured ones as they are.
    pub(crate) fn slope(&self, along: Direction, base_mm: f64) -> Result<SlopeReport, Invalid> {
        let (positions, values, base_mm) = self.slopes(along, base_mm)?;
        let found = statistics(values.view()).ok_or_else(|| {
            let problem = format!("no two valid pixels are {} mm apart", significant(base_mm, 4));
            Invalid::whole("slope", problem, "give a shorter `base_mm`, or another zone")
        })?;
        let ((r, c), peak_nrad) = farthest(values.view(), found.mean);
        let peak_at_mm = match along {
            Direction::Y => [self.x_mm[c], positions[r]],
            _ => [positions[c], self.y_mm[r]],
        };
        Ok(SlopeReport { base_mm, rms_nrad: found.rms, peak_nrad, peak_at_mm })
    }

    /// Middles of the bases, mm, the slopes there, nrad, and the base that was used, mm.
    fn slopes(
        &self,
        along: Direction,
        base_mm: f64,
    ) -> Result<(Vec<f64>, Array2<f64>, f64), Invalid> {
        let (at, axis) = match along {
            Direction::X => (&self.x_mm, slope::Along::X),
            Direction::Y => (&self.y_mm, slope::Along::Y),
            Direction::Radial => {
                let remedy = "give x or y; slopes are along a direction";
                return Err(Invalid::whole("slope", "`along` is radial", remedy));
            }
        };
        if let (Direction::X, Some(slopes)) = (along, &self.measured_slope_nrad) {
            let row = Array2::from_shape_fn((1, slopes.len()), |(_, c)| slopes[c]);
            return Ok((self.x_mm.clone(), row, 0.0));
        }
        if self.is_profile() && along == Direction::Y {
            let remedy = "a profile has slopes along x only";
            return Err(Invalid::whole("slope", "`along` is y", remedy));
        }
        if !(base_mm.is_finite() && base_mm > 0.0) {
            let problem = format!("`base_mm` is {base_mm}");
            return Err(Invalid::whole("slope", problem, "give a length in mm, above 0"));
        }
        let n = at.len();
        let step_mm = (at[n - 1] - at[0]) / (n - 1) as f64;
        let steps = steps_of_base(base_mm, step_mm, n).ok_or_else(|| {
            let problem = format!(
                "`base_mm` is {base_mm}, the map is {} mm long",
                significant(at[n - 1] - at[0], 4)
            );
            Invalid::whole("slope", problem, "give a shorter one")
        })?;
        // nm/mm is urad.
        let mut values = slopes(self.height_nm.view(), at, axis, steps);
        values.mapv_inplace(|s| 1e3 * s);
        let middles: Vec<f64> = (0..n - steps).map(|i| 0.5 * (at[i] + at[i + steps])).collect();
        if self.is_profile() {
            let row: Vec<f64> = values.iter().copied().collect();
            let rest = rest_of(self.shape.shape);
            let (row, _) = without_shape_of_slopes(&middles, &row, rest, None)?;
            values = Array2::from_shape_fn(values.dim(), |(_, c)| row[c]);
        }
        Ok((middles, values, steps as f64 * step_mm))
    }

    pub(crate) fn spectra(&self) -> Result<&Spectra, Invalid> {
        let found = self.spectra.get_or_init(|| match &self.surface {
            Some(surface) => spectra_of_map(surface),
            None => spectra_of_profile(self),
        });
        found.as_ref().map_err(Clone::clone)
    }

    /// Lag along the axis at which the autocorrelation falls to 1/e, mm.
    pub(crate) fn autocorrelation_length_mm(&self, along: Direction) -> Option<f64> {
        let (at, turned) = match along {
            Direction::Y => (&self.y_mm, self.height_nm.t().to_owned()),
            _ => (&self.x_mm, self.height_nm.clone()),
        };
        let n = at.len();
        if n < MIN_SAMPLES {
            return None;
        }
        let step_mm = (at[n - 1] - at[0]) / (n - 1) as f64;
        let turned = if self.is_profile() { even(at, turned.as_slice()?, step_mm) } else { turned };
        autocorrelation_length(turned.view()).map(|lag| lag * step_mm)
    }
}

/// What of a shape is left in the slopes where it was taken off the heights, or the other way round: the best
/// line, or circle.
fn rest_of(shape: Shape) -> Shape {
    match shape {
        Shape::CylinderX | Shape::CylinderY | Shape::Sphere => Shape::CylinderX,
        Shape::Piston => Shape::Piston,
        Shape::Plane | Shape::Ellipse => Shape::Plane,
    }
}

/// The trapezoidal integral of slopes (nrad) over x (mm), nm; an invalid slope has no height, and its
/// neighbours are joined over it.
fn integrated(x_mm: &[f64], slope_nrad: &[f64]) -> Array2<f64> {
    let mut height = Array2::from_elem((1, x_mm.len()), f64::NAN);
    let mut last: Option<(usize, f64)> = None;
    for (i, s) in slope_nrad.iter().enumerate().filter(|(_, s)| !s.is_nan()) {
        let z = match last {
            // nrad mm is 1e-3 nm.
            Some((k, z)) => z + 0.5e-3 * (slope_nrad[k] + s) * (x_mm[i] - x_mm[k]),
            None => 0.0,
        };
        height[[0, i]] = z;
        last = Some((i, z));
    }
    height
}

/// The valid element that is farthest from `mean`, and its distance.
fn farthest(map: ArrayView2<f64>, mean: f64) -> ((usize, usize), f64) {
    let valid = map.indexed_iter().filter(|(_, v)| !v.is_nan());
    valid.fold(((0, 0), 0.0), |best, (at, v)| match (v - mean).abs() > best.1 {
        true => (at, (v - mean).abs()),
        false => best,
    })
}

/// `values` at `x` as one row at even steps, linear between valid neighbours.
fn even(x: &[f64], values: &[f64], step: f64) -> Array2<f64> {
    let n = x.len();
    Array2::from_shape_fn((1, n), |(_, c)| {
        let at = x[0] + c as f64 * step;
        let i = x.partition_point(|v| *v <= at).clamp(1, n - 1);
        let part = ((at - x[i - 1]) / (x[i] - x[i - 1])).clamp(0.0, 1.0);
        // On a position but for rounding it is that value: its neighbour may be invalid.
        match part {
            p if p < 1e-9 => values[i - 1],
            p if p > 1.0 - 1e-9 => values[i],
            p => (1.0 - p) * values[i - 1] + p * values[i],
        }
    })
}

fn spectra_of_map(surface: &Surface) -> Result<Spectra, Invalid> {
    let settings =
        PsdSettings { window: Window::Hann, detrend: Detrend::Plane, band_per_mm: vec![] };
    let found = psd(surface, &settings)?;
    let (origin, (ny, nx)) = largest_rectangle(&surface.height_nm().mapv(|v| !v.is_nan()));
    let (rows, columns) = (origin.0..origin.0 + ny, origin.1..origin.1 + nx);
    let (x, y) = (surface.grid().x.coordinates(), surface.grid().y.coordinates());
    let z = surface.height_nm().slice(s![rows.clone(), columns.clone()]);
    let z = without_plane(z, &x[columns], &y[rows]);
    // The mean of a line has no slope along it, and would leak into the lowest frequencies.
    let lines = |z: ArrayView2<f64>, step_mm: f64| {
        let mut z = z.to_owned();
        for mut line in z.outer_iter_mut() {
            let mean = line.mean().unwrap_or(0.0);
            line.mapv_inplace(|v| v - mean);
        }
        let (f, density) = along_rows(z.view(), step_mm, &hann(z.ncols()));
        SpectrumLine::of_heights(f, density)
    };
    let radial = SpectrumLine::of_heights(
        found.frequency_radial_per_mm.clone(),
        found.psd_radial_nm2_mm2.clone(),
    );
    Ok(Spectra {
        x: lines(z.view(), surface.grid().x.step_mm()),
        y: Some(lines(z.t(), surface.grid().y.step_mm())),
        radial: Some(radial),
        two_dimensional: Some(found),
    })
}

fn spectra_of_profile(piece: &Piece) -> Result<Spectra, Invalid> {
    let (x, n) = (&piece.x_mm, piece.x_mm.len());
    let step_mm = (x[n - 1] - x[0]) / (n - 1) as f64;
    let heights = piece.height_nm.as_slice().expect("a row is contiguous");
    let values = even(x, piece.measured_slope_nrad.as_deref().unwrap_or(heights), step_mm);
    let (origin, (_, length)) = largest_rectangle(&values.mapv(|v| !v.is_nan()));
    if length < MIN_SAMPLES {
        let problem = format!("the longest run of valid positions has {length}");
        let remedy = format!("a spectrum needs at least {MIN_SAMPLES} without a gap");
        return Err(Invalid::whole("profile", problem, remedy));
    }
    let mut run = values.slice(s![.., origin.1..origin.1 + length]).to_owned();
    let even_mm: Vec<f64> = (0..length).map(|i| i as f64 * step_mm).collect();
    let rest = match piece.measured_slope_nrad {
        Some(_) => Shape::Piston,
        None => Shape::Plane,
    };
    let line = Heights { x_mm: &even_mm, y_mm: &[0.0], height_nm: &run };
    run = without_shape(&line, rest, None)?.0;
    let (f, density) = along_rows(run.view(), step_mm, &hann(length));
    let x = match piece.measured_slope_nrad {
        Some(_) => SpectrumLine::of_slopes(f, density),
        None => SpectrumLine::of_heights(f, density),
    };
    Ok(Spectra { x, y: None, radial: None, two_dimensional: None })
}

/// Lag in samples at which the autocorrelation of the rows falls to 1/e; `None` where it does not.
///
/// C(k) = sum of z_i z_(i+k) over the pairs of valid samples, over their number: both sums are correlations,
/// whose transforms are squares.
fn autocorrelation_length(rows: ArrayView2<f64>) -> Option<f64> {
    let mean = statistics(rows)?.mean;
    let (count, n) = rows.dim();
    let m = (2 * n).next_power_of_two();
    // Rows with zeros beyond their end: no lag below n wraps round.
    let padded = |value: &dyn Fn(f64) -> f64| {
        let mut power = vec![0.0; m];
        for r in 0..count {
            let line = Array2::from_shape_fn((1, m), |(_, c)| {
                let v = if c < n { rows[[r, c]] } else { f64::NAN };
                if v.is_nan() { 0.0 } else { value(v) }
            });
            let spectrum = transform::forward(line.view());
            power.iter_mut().zip(&spectrum).for_each(|(p, f)| *p += f.norm_sqr());
        }
        let power = Array2::from_shape_fn((1, m), |(_, k)| transform_of(power[k]));
        transform::inverse(power)
    };
    let (products, pairs) = (padded(&|v| v - mean), padded(&|_| 1.0));
    // At least half a pair: the counts are whole but for rounding.
    let at = |k: usize| (pairs[[0, k]] > 0.5).then(|| products[[0, k]] / pairs[[0, k]]);
    let variance = at(0).filter(|v| *v > 0.0)?;
    let mut before = 1.0;
    for k in 1..n {
        let now = at(k)? / variance;
        if now <= (-1.0_f64).exp() {
            let part = (before - (-1.0_f64).exp()) / (before - now);
            return Some((k - 1) as f64 + part);
        }
        before = now;
    }
    None
}

fn transform_of(power: f64) -> planish_numerics::fft::Complex64 {
    planish_numerics::fft::Complex64::new(power, 0.0)
}

/// exp(-(4 pi sin(g) RMS / wavelength)^2)
pub(crate) fn strehl(light: Light, rms_nm: f64) -> Result<StrehlReport, Invalid> {
    let Light { wavelength_nm, grazing_mrad } = light;
    if !(wavelength_nm.is_finite() && wavelength_nm > 0.0) {
        let problem = format!("`wavelength_nm` is {wavelength_nm}");
        return Err(Invalid::whole("light", problem, "give a wavelength in nm, above 0"));
    }
    let largest_mrad = 1e3 * PI / 2.0;
    // 1570.8 stands for a right angle.
    if !(grazing_mrad > 0.0 && grazing_mrad <= largest_mrad + 0.01) {
        let problem = format!("`grazing_mrad` is {grazing_mrad}");
        let remedy =
            "give the angle to the surface in mrad, above 0 and at most 1570.8 (normal incidence)";
        return Err(Invalid::whole("light", problem, remedy));
    }
    let grazing = (1e-3 * grazing_mrad).min(PI / 2.0);
    let phase_rms_rad = 4.0 * PI * grazing.sin() * rms_nm / wavelength_nm;
    Ok(StrehlReport { light, phase_rms_rad, strehl: (-phase_rms_rad * phase_rms_rad).exp() })
}

/// Measures `subject`.
pub fn quality(subject: &Subject, settings: &QualitySettings) -> Result<Quality, Invalid> {
    let ellipse = settings.ellipse.as_ref();
    let base_mm = settings.base_mm;
    let piece = Piece::new(subject, None, settings.after, ellipse)?;
    let height = piece.height()?;
    let slope_x = piece.slope(Direction::X, base_mm)?;
    let slope_y = match subject {
        Subject::Map(_) => Some(piece.slope(Direction::Y, base_mm)),
        Subject::Profile(_) => None,
    };
    let mut notes = piece.notes.clone();
    for (along, slope) in
        [("x", Some(&slope_x)), ("y", slope_y.as_ref().and_then(|s| s.as_ref().ok()))]
    {
        let Some(used_mm) = slope.map(|s| s.base_mm).filter(|b| *b > 0.0) else { continue };
        if (used_mm / base_mm - 1.0).abs() > NOTEWORTHY_BASE {
            notes.push(format!(
                "the base along {along} is {} mm, the whole number of pixels nearest to {base_mm} mm",
                significant(used_mm, 4)
            ));
        }
    }
    if let Some(Err(e)) = &slope_y {
        notes.push(format!("no slopes along y: {}", e.problem));
    }
    let strehl = settings.light.map(|light| strehl(light, height.rms)).transpose()?;
    if let Some(s) = strehl.filter(|s| s.phase_rms_rad > LARGEST_PHASE_RAD) {
        notes.push(format!(
            "the phase of {} rad RMS is beyond Marechal's formula, which is for less than 1 rad",
            significant(s.phase_rms_rad, 3)
        ));
    }
    let spectra = piece.spectra();
    if let Err(e) = &spectra {
        notes.push(format!("no spectra: {}", e.problem));
    }
    let mut bands = Vec::new();
    for band in &settings.band_per_mm {
        bands.push(band_report(spectra.clone()?, *band)?);
    }
    let (centre_line, line) = match subject {
        Subject::Map(surface) => {
            let (y_mm, line) = centre_line(surface, settings.centre_line_width_mm)?;
            let line = Piece::new(&Subject::Profile(line), None, settings.after, ellipse)?;
            let (height, slope) = (line.height()?, line.slope(Direction::X, base_mm).ok());
            let report = LineReport {
                y_mm,
                height_rms_nm: height.rms,
                height_pv_nm: height.pv,
                slope_rms_nrad: slope.map(|s| s.rms_nrad),
            };
            (Some(report), Some(line))
        }
        Subject::Profile(_) => (None, None),
    };
    let line = line.as_ref().unwrap_or(&piece);
    let (slope_position_mm, slopes, _) = line.slopes(Direction::X, base_mm)?;
    let lines = match &spectra {
        Ok(s) => {
            [s.x.clone(), s.y.clone().unwrap_or_default(), s.radial.clone().unwrap_or_default()]
        }
        Err(_) => Default::default(),
    };
    let length = |along| piece.autocorrelation_length_mm(along);
    Ok(Quality {
        height: HeightReport {
            rms_nm: height.rms,
            pv_nm: height.pv,
            valid_count: height.valid_count,
        },
        slope_x,
        slope_y: slope_y.and_then(Result::ok),
        after: after_shapes(subject, settings),
        bands,
        centre_line,
        autocorrelation_length_x_mm: length(Direction::X),
        autocorrelation_length_y_mm: match subject {
            Subject::Map(_) => length(Direction::Y),
            Subject::Profile(_) => None,
        },
        strehl,
        arrays: QualityArrays {
            position_mm: line.x_mm.clone(),
            height_nm: line.height_nm.iter().copied().collect(),
            slope_position_mm,
            slope_nrad: slopes.iter().copied().collect(),
            lines,
        },
        notes,
        shape: piece.shape,
    })
}

/// What is left after each shape; those that the points do not tell are left out.
fn after_shapes(subject: &Subject, settings: &QualitySettings) -> Vec<AfterShape> {
    let mut shapes = vec![Shape::Plane, Shape::CylinderX];
    if matches!(subject, Subject::Map(_)) {
        shapes.extend([Shape::CylinderY, Shape::Sphere]);
    }
    shapes.extend(settings.ellipse.as_ref().map(|_| Shape::Ellipse));
    let found = shapes.into_iter().filter_map(|shape| {
        let piece = Piece::new(subject, None, shape, settings.ellipse.as_ref()).ok()?;
        let height = piece.height().ok()?;
        let slope = |along| piece.slope(along, settings.base_mm).ok().map(|s| s.rms_nrad);
        Some(AfterShape {
            height_rms_nm: height.rms,
            height_pv_nm: height.pv,
            slope_x_rms_nrad: slope(Direction::X),
            slope_y_rms_nrad: slope(Direction::Y),
            shape: piece.shape,
        })
    });
    found.collect()
}

fn band_report(spectra: &Spectra, band: [f64; 2]) -> Result<BandReport, Invalid> {
    let [low, high] = band;
    let is_band = low >= 0.0 && low < high && high.is_finite();
    if !is_band || !spectra.x.holds(band) {
        let f = &spectra.x.frequency_per_mm;
        let problem = format!(
            "{low} .. {high} /mm holds no frequency along x ({} .. {} /mm)",
            significant(f[1], 3),
            significant(f[f.len() - 1], 3)
        );
        let remedy = "give 0 <= low < high in 1/mm; a wavelength L is 1 / L";
        return Err(Invalid::whole("band", problem, remedy));
    }
    Ok(BandReport {
        band_per_mm: band,
        height_rms_nm: spectra.height_rms_nm(band),
        slope_x_rms_nrad: spectra.x.slope_rms(band),
        slope_y_rms_nrad: spectra.y.as_ref().map(|y| y.slope_rms(band)),
    })
}

/// The mean of the rows within `width_mm` about the middle of y, one row at least, and their y.
fn centre_line(surface: &Surface, width_mm: f64) -> Result<([f64; 2], Profile), Invalid> {
    if !(width_mm.is_finite() && width_mm >= 0.0) {
        let problem = format!("`centre_line_width_mm` is {width_mm}");
        return Err(Invalid::whole("centre line", problem, "give a width in mm, 0 for one row"));
    }
    let (map, y) = (surface.height_nm(), surface.grid().y.coordinates());
    let used: Vec<usize> =
        (0..y.len()).filter(|r| map.row(*r).iter().any(|v| !v.is_nan())).collect();
    let middle_mm = 0.5 * (y[used[0]] + y[used[used.len() - 1]]);
    let nearest = used
        .iter()
        .copied()
        .min_by(|a, b| (y[*a] - middle_mm).abs().total_cmp(&(y[*b] - middle_mm).abs()));
    let rows: Vec<usize> = used
        .iter()
        .copied()
        .filter(|r| (y[*r] - middle_mm).abs() <= 0.5 * width_mm || Some(*r) == nearest)
        .collect();
    let mean = (0..map.ncols()).map(|c| {
        let valid = rows.iter().map(|r| map[[*r, c]]).filter(|v| !v.is_nan());
        let (n, sum) = valid.fold((0.0, 0.0), |(n, sum), v| (n + 1.0, sum + v));
        sum / n
    });
    let line = Profile::new(surface.grid().x.coordinates(), Values::HeightNm(mean.collect()))?;
    Ok(([y[rows[0]], y[rows[rows.len() - 1]]], line))
}
