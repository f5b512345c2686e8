//! Quantities that specify a mirror: slope errors, heights after the best shape, bands and spectra.
//!
//! ```text
//! slope          s = (z(x + base) - z(x)) / base, nrad; RMS without the mean
//! slope PSD      (2 pi f)^2 S(f), nrad^2 mm
//! slope in band  RMS^2 = sum of (2 pi f)^2 S df,   f_0 <= f < f_1, f along the axis of the slope
//! autocorrelation length    the lag at which <z(x) z(x + lag)> / <z^2> falls to 1/e
//! Strehl (Marechal)         exp(-(4 pi sin(g) RMS / wavelength)^2),   g the grazing angle
//! ```
//!
//! A map has slopes along both axes, a profile along x. The shape is fitted to the measured values: heights
//! of a map or a profile, or slopes. It is subtracted once, so a profile of heights has the slopes of a map
//! with the same rows. The slopes of measured heights are differences over the base. The heights of a
//! profile of measured slopes are the integral (by trapezoids) of these slopes after the shape is
//! subtracted. From this integral a second shape is subtracted, because least squares of slopes leave a
//! line or a circle of heights.
//!
//! Spectra are those of [`crate::psd`]: of the largest rectangle of valid pixels, or of the longest run of
//! valid positions, under a Hann window. For a spectrum along a direction, the mean of every line is
//! subtracted first. If the positions of a profile are uneven, its values are interpolated linearly at as
//! many even ones.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | z | `height_nm` | nm |
//! | s | `slope_*_nrad` | nrad |
//! | S | `psd_*` | nm^2 mm, nm^2 mm^2 |

use planish_types::{Invalid, Surface, text::significant};
use serde::Serialize;

use crate::{
    profile::{Profile, Values},
    shape::{EllipseSettings, Shape, ShapeReport},
};

mod residual;
mod spectrum;
mod strehl;

pub(crate) use residual::ShapeResidual;
pub use residual::{Direction, SlopeReport, Subject};
pub use spectrum::SpectrumLine;
pub(crate) use strehl::strehl;
pub use strehl::{Light, StrehlReport};

use spectrum::Spectra;
pub(crate) use spectrum::at_even_steps;

/// Relative difference of the base length that was used from the requested one, above which the report has a note.
/// Larger: no note on slopes over another base. Smaller: notes on usual maps.
const NOTEWORTHY_BASE: f64 = 0.02;

/// Ratio of the RMS after a fitted ellipse to that after the best circle, above which the report has a note. Larger: no
/// note on a wrong ellipse. Smaller: notes on differences that come from what is fitted, heights or slopes.
const NOTEWORTHY_CIRCLE: f64 = 1.02;

/// RMS phase error, rad, above which the report has a note, because Marechal's formula is for small phase errors.
/// Larger: no note on a meaningless Strehl ratio. Smaller: notes on usual mirrors. At this value the Strehl ratio is
/// 0.37.
const LARGEST_PHASE_RAD: f64 = 1.0;

/// Settings with which the quality of a map or a profile is measured.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct QualitySettings {
    /// Shape that is fitted and subtracted before anything is measured.
    pub after: Shape,
    /// Ellipse that the mirror is made for; `None` if it is not known.
    pub ellipse: Option<EllipseSettings>,
    /// Base length over which slopes are differences of heights, mm.
    pub base_mm: f64,
    /// Bands [f_0, f_1) of spatial frequencies in which an RMS is computed, 1/mm.
    pub band_per_mm: Vec<[f64; 2]>,
    /// Width of the strip about the middle of y whose mean is the centre line, mm; 0 for one row.
    pub centre_line_width_mm: f64,
    /// Light for the Strehl ratio; `None` if no ratio is wanted.
    pub light: Option<Light>,
}

/// Measured quality of a map or a profile.
#[derive(Clone, Debug, Serialize)]
pub struct Quality {
    /// The shape that was subtracted.
    pub shape: ShapeReport,
    /// Statistics of the heights after that shape.
    pub height: HeightReport,
    /// Statistics of the slopes along x after that shape.
    pub slope_x: SlopeReport,
    /// Statistics of the slopes along y after that shape; `null` for a profile, and if the base does not fit into the
    /// map.
    pub slope_y: Option<SlopeReport>,
    /// Heights and slopes after each shape that the valid points determine.
    pub after: Vec<AfterShape>,
    /// RMS within each band, in the order of the settings.
    pub bands: Vec<BandReport>,
    /// Numbers of the line along x through the middle of the map; `null` for a profile, which is a line itself.
    pub centre_line: Option<LineReport>,
    /// Autocorrelation length of the heights along x, mm; `null` if it is longer than the map, or if there are too few
    /// pixels.
    pub autocorrelation_length_x_mm: Option<f64>,
    /// Autocorrelation length of the heights along y, mm; `null` for a profile, if it is longer than the map, or if
    /// there are too few pixels.
    pub autocorrelation_length_y_mm: Option<f64>,
    /// Strehl ratio; `null` if no light was given.
    pub strehl: Option<StrehlReport>,
    /// Remarks on the measurement, such as a base length other than the one asked for, in words.
    pub notes: Vec<String>,
    /// Arrays that are stored beside these numbers.
    #[serde(skip)]
    pub arrays: QualityArrays,
}

/// Statistics of the heights after a shape.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct HeightReport {
    /// RMS without the mean, nm.
    pub rms_nm: f64,
    /// Largest minus smallest height, nm.
    pub pv_nm: f64,
    /// Number of valid pixels or positions.
    pub valid_count: usize,
}

/// Numbers of what remains after subtraction of a shape.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AfterShape {
    /// Parameters of the shape as it was fitted.
    pub shape: ShapeReport,
    /// RMS of the remaining heights, mean removed, nm.
    pub height_rms_nm: f64,
    /// Largest minus smallest remaining height, nm.
    pub height_pv_nm: f64,
    /// RMS of the remaining slopes along x, mean removed, nrad; `null` if there are none over the base.
    pub slope_x_rms_nrad: Option<f64>,
    /// RMS of the remaining slopes along y, mean removed, nrad; `null` for a profile, or if there are none over the
    /// base.
    pub slope_y_rms_nrad: Option<f64>,
}

/// RMS of heights and slopes within a band of spatial frequencies.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BandReport {
    /// Band [f_0, f_1), 1/mm.
    pub band_per_mm: [f64; 2],
    /// RMS of the heights, nm; for a map over all frequencies in two dimensions with |f| in the band.
    pub height_rms_nm: f64,
    /// RMS of the slopes along x, nrad, over the frequencies along x in the band.
    pub slope_x_rms_nrad: f64,
    /// RMS of the slopes along y, nrad, over the frequencies along y in the band; `null` for a profile.
    pub slope_y_rms_nrad: Option<f64>,
}

/// Numbers of the centre line of a map: the mean of its rows about the middle of y.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LineReport {
    /// Smallest and largest y of these rows, mm.
    pub y_mm: [f64; 2],
    /// RMS of the heights of the line, mean removed, nm.
    pub height_rms_nm: f64,
    /// Largest minus smallest height of the line, nm.
    pub height_pv_nm: f64,
    /// RMS of the slopes of the line, mean removed, nrad; `null` if there are none over the base.
    pub slope_rms_nrad: Option<f64>,
}

/// Arrays that are stored beside the numbers of the quality; empty if there are none.
#[derive(Clone, Debug, Default)]
pub struct QualityArrays {
    /// Positions of the centre line, or of the profile (n), mm.
    pub position_mm: Vec<f64>,
    /// Heights of that line (n), nm; NaN where invalid.
    pub height_nm: Vec<f64>,
    /// Positions of the slopes of that line, the middles of the bases (m), mm.
    pub slope_position_mm: Vec<f64>,
    /// Slopes of that line (m), nrad; NaN where invalid.
    pub slope_nrad: Vec<f64>,
    /// Power spectral densities along x, along y, and averaged over rings.
    pub lines: [SpectrumLine; 3],
}

/// Measures the quality of a map or a profile.
///
/// # Errors
/// Refuses a map or a profile that does not define the shape to subtract or the slopes, and settings out of their
/// range, such as a band without a frequency. Other quantities that cannot be measured are left out, with a note.
pub fn quality(subject: &Subject, settings: &QualitySettings) -> Result<Quality, Invalid> {
    let base_mm = settings.base_mm;
    let residual = ShapeResidual::new(subject, None, settings.after, settings.ellipse.as_ref())?;
    let height = residual.height()?;
    let slope_x = residual.slope(Direction::X, base_mm)?;
    let slope_y = match subject {
        Subject::Map(_) => Some(residual.slope(Direction::Y, base_mm)),
        Subject::Profile(_) => None,
    };
    let strehl = settings.light.map(|light| strehl(light, height.rms)).transpose()?;
    let spectra = residual.spectra();
    let mut notes = residual.notes.clone();
    notes.extend(notes_on_slopes(base_mm, &slope_x, slope_y.as_ref()));
    let after = after_shapes(subject, settings);
    notes.extend(note_on_ellipse(&after));
    if let Some(s) = strehl.filter(|s| s.phase_rms_rad > LARGEST_PHASE_RAD) {
        notes.push(format!(
            "the phase of {} rad RMS is beyond Marechal's formula, which is for less than 1 rad",
            significant(s.phase_rms_rad, 3)
        ));
    }
    if let Err(e) = &spectra {
        notes.push(format!("no spectra: {}", e.problem));
    }
    let mut bands = Vec::new();
    for band in &settings.band_per_mm {
        bands.push(band_report(spectra.clone()?, *band)?);
    }
    let (centre_line, line) = match subject {
        Subject::Map(surface) => Some(centre_line_report(surface, settings)?).unzip(),
        Subject::Profile(_) => (None, None),
    };
    let line = line.as_ref().unwrap_or(&residual);
    let (slope_position_mm, slopes, _) = line.slopes(Direction::X, base_mm)?;
    let lines = match &spectra {
        Ok(s) => {
            [s.x.clone(), s.y.clone().unwrap_or_default(), s.radial.clone().unwrap_or_default()]
        }
        Err(_) => Default::default(),
    };
    Ok(Quality {
        height: HeightReport {
            rms_nm: height.rms,
            pv_nm: height.pv,
            valid_count: height.valid_count,
        },
        slope_x,
        slope_y: slope_y.and_then(Result::ok),
        after,
        bands,
        centre_line,
        autocorrelation_length_x_mm: residual.autocorrelation_length_mm(Direction::X),
        autocorrelation_length_y_mm: match subject {
            Subject::Map(_) => residual.autocorrelation_length_mm(Direction::Y),
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
        shape: residual.shape,
    })
}

/// Returns notes on base lengths that differ from the requested one, and on slopes along y that a map does not have.
fn notes_on_slopes(
    base_mm: f64,
    slope_x: &SlopeReport,
    slope_y: Option<&Result<SlopeReport, Invalid>>,
) -> Vec<String> {
    let mut notes = Vec::new();
    for (along, slope) in [("x", Some(slope_x)), ("y", slope_y.and_then(|s| s.as_ref().ok()))] {
        let Some(used_mm) = slope.map(|s| s.base_mm).filter(|b| *b > 0.0) else { continue };
        if (used_mm / base_mm - 1.0).abs() > NOTEWORTHY_BASE {
            notes.push(format!(
                "the base along {along} is {} mm, the whole number of pixels nearest to {base_mm} mm",
                significant(used_mm, 4)
            ));
        }
    }
    if let Some(Err(e)) = slope_y {
        notes.push(format!("no slopes along y: {}", e.problem));
    }
    notes
}

/// Returns a note on an ellipse after which more RMS is left than after a plane, as with values of the opposite sign.
/// The same holds for a fitted ellipse against the best circle. Returns `None` if it leaves less, or if the shapes were
/// not determined.
fn note_on_ellipse(after: &[AfterShape]) -> Option<String> {
    let [plane, circle, ellipse] = [Shape::Plane, Shape::CylinderX, Shape::Ellipse]
        .map(|shape| after.iter().find(|a| a.shape.shape == shape).map(|a| a.height_rms_nm));
    let plane = plane?;
    let ellipse = ellipse?;
    if ellipse > plane {
        return Some(format!(
            "the ellipse leaves more than a plane ({} against {} nm RMS): a mirror that focuses is concave, its slope \
             rises with the position; are the values of the opposite sign, of another unit, or without the ellipse \
             already?",
            significant(ellipse, 4),
            significant(plane, 4)
        ));
    }
    let circle = circle?;
    let is_fitted = after
        .iter()
        .filter_map(|a| a.shape.ellipse.as_ref())
        .any(|ellipse| !ellipse.fitted.is_empty());
    if !is_fitted || ellipse <= NOTEWORTHY_CIRCLE * circle {
        return None;
    }
    Some(format!(
        "the best ellipse within the bounds leaves more than a circle ({} against {} nm RMS); check p, q and theta of \
  the design, or fit more of them",
        significant(ellipse, 4),
        significant(circle, 4)
    ))
}

/// Returns the numbers after each shape; shapes that the points do not determine are left out.
fn after_shapes(subject: &Subject, settings: &QualitySettings) -> Vec<AfterShape> {
    let mut shapes = vec![Shape::Plane, Shape::CylinderX];
    if matches!(subject, Subject::Map(_)) {
        shapes.extend([Shape::CylinderY, Shape::Sphere]);
    }
    shapes.extend(settings.ellipse.as_ref().map(|_| Shape::Ellipse));
    let residuals = shapes.into_iter().filter_map(|shape| {
        let residual = ShapeResidual::new(subject, None, shape, settings.ellipse.as_ref()).ok()?;
        let height = residual.height().ok()?;
        let [slope_x_rms_nrad, slope_y_rms_nrad] = [Direction::X, Direction::Y]
            .map(|along| residual.slope(along, settings.base_mm).ok().map(|s| s.rms_nrad));
        Some(AfterShape {
            height_rms_nm: height.rms,
            height_pv_nm: height.pv,
            slope_x_rms_nrad,
            slope_y_rms_nrad,
            shape: residual.shape,
        })
    });
    residuals.collect()
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

/// Returns the numbers of the centre line of a map, and that line after the best shape.
fn centre_line_report(
    surface: &Surface,
    settings: &QualitySettings,
) -> Result<(LineReport, ShapeResidual), Invalid> {
    let (y_mm, line) = centre_line(surface, settings.centre_line_width_mm)?;
    let line = Subject::Profile(line);
    // A cylinder along y is a straight line there.
    let after = match settings.after {
        Shape::CylinderY => Shape::Plane,
        shape => shape,
    };
    let line = ShapeResidual::new(&line, None, after, settings.ellipse.as_ref())?;
    let height = line.height()?;
    let report = LineReport {
        y_mm,
        height_rms_nm: height.rms,
        height_pv_nm: height.pv,
        slope_rms_nrad: line.slope(Direction::X, settings.base_mm).ok().map(|s| s.rms_nrad),
    };
    Ok((report, line))
}

/// Returns the smallest and largest y, mm, and the mean of the rows within `width_mm` about the middle of y, as a
/// profile. There is at least one row. Refuses a negative width, and a line with too few valid values.
fn centre_line(surface: &Surface, width_mm: f64) -> Result<([f64; 2], Profile), Invalid> {
    if !(width_mm.is_finite() && width_mm >= 0.0) {
        let problem = format!("`centre_line_width_mm` is {width_mm}");
        return Err(Invalid::whole("centre line", problem, "give a width in mm, 0 for one row"));
    }
    let map = surface.height_nm();
    let y = surface.grid().y.coordinates();
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
