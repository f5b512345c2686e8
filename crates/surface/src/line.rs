//! A mirror line: a profile becomes the desired removal of a strip, and the tool is integrated across it.
//!
//! A profile z(x) says nothing of the other direction, so the removal has to be the same across. The tool moves along
//! the middle of a strip, and what counts is the mean of the removal across:
//!
//! ```text
//! R1(x) = 1 / W  int from -W/2 to W/2  R(x, y) dy      a strip of the width W, one pass                  (1)
//! R1(x) = 1 / d  int over all y        R(x, y) dy      a part much wider than the tool, lines d apart    (2)
//! int R1(x - p) D(p) dp = z(x)
//! ```
//!
//! Both are written as artifacts of the usual kinds, so that every stage plans and judges them as it does maps. The map
//! has three equal rows at y = -W/2, 0, W/2 (in (2) W = d). The TIF has R1 in its rows at these offsets, and zeros at
//! -W and W: at the rows of the map, a tool at y = 0 has R1 exactly, because the cubic interpolation passes through the
//! samples.
//!
//! The integral is that of Keys' interpolant of the samples, by Gauss's rule with two nodes between neighbouring
//! samples, which is exact for its cubics. Slopes are integrated by trapezoids: `s[i]` are those of the profile, and
//! `z[i] = z[i-1] + (s[i-1] + s[i]) (x[i] - x[i-1]) / 2`.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `surface` | (3, nx), rows alike | nm |
//! | R | `tif` | (my, mx) | nm/s |
//! | R1 | `across` | (5, mx) | nm/s |
//! | W, d | [`Across`] | - | mm |

use ndarray::{Array1, Array2};
use planish_numerics::{quadrature::gauss_legendre, slope, statistics::statistics};
use planish_types::{Axis, Grid, Invalid, Surface, Tif, text::significant};
use serde::Serialize;

use crate::{
    profile::{Profile, Values},
    quality::{ShapeResidual, Subject, at_even_steps},
    shape::{Shape, ShapeReport},
};

/// Extent of the part across the line, and the passes of the tool over it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Across {
    /// A strip of this width, mm, that the tool passes once along its middle.
    StripWidthMm(f64),
    /// A part much wider than the tool, which passes it along lines of this distance, mm, with the same dwell times.
    PitchMm(f64),
}

impl Across {
    /// Returns the width W or the distance of lines d of the module, mm.
    fn width_mm(self) -> f64 {
        let (Self::StripWidthMm(width) | Self::PitchMm(width)) = self;
        width
    }

    /// Returns the name of the setting, for messages.
    fn name(self) -> &'static str {
        match self {
            Self::StripWidthMm(_) => "strip_width_mm",
            Self::PitchMm(_) => "pitch_mm",
        }
    }

    fn check(self) -> Result<(), Invalid> {
        let width = self.width_mm();
        if width.is_finite() && width > 0.0 {
            return Ok(());
        }
        Err(Invalid::whole(self.name(), format!("is {width}"), "give a positive number of mm"))
    }
}

/// Meaning of positive heights of a profile, and of slopes that are positive along its positions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Positive {
    /// Material above the target; slopes rise towards it.
    Hill,
    /// Material missing; slopes fall towards it.
    Hole,
}

/// Settings with which a profile becomes the desired removal of a line.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LineSettings {
    /// Extent of the part across the line.
    pub across: Across,
    /// Meaning of the sign of the profile.
    pub positive: Positive,
    /// Best shape that is subtracted from the profile.
    pub subtract: Shape,
    /// Distance of the pixel centres of the line, mm; `None` for the mean step of the profile.
    pub pixel_mm: Option<f64>,
}

/// A mirror line in the form in which the stages take a map.
#[derive(Clone, Debug)]
pub struct PreparedLine {
    /// Desired removal (3, nx), nm: three equal rows.
    pub surface: Surface,
    /// Numbers of the line for the manifest.
    pub report: LineReport,
}

/// Numbers of a prepared line, for the manifest.
#[derive(Clone, Debug, Serialize)]
pub struct LineReport {
    /// RMS of the heights after subtraction of the shape (mean removed), nm.
    pub rms_nm: f64,
    /// RMS of the slopes between neighbouring pixels after subtraction of the shape (mean removed), nrad.
    pub slope_rms_nrad: f64,
    /// True if the profile has slopes, which were integrated.
    pub integrated: bool,
    /// True if the positions of the profile are not the pixel centres, so that heights were interpolated.
    pub interpolated: bool,
    /// Shape that was subtracted from the profile.
    pub shape: ShapeReport,
    /// Notes for the user, in words.
    pub notes: Vec<String>,
}

/// Largest number of pixels of a line. Larger: more memory and time for a pitch that was mistyped. Smaller: refuses
/// long profiles at fine pitches.
const MOST_PIXELS: f64 = 1e5;

/// Largest relative difference between the distance of pixels and the mean step of a profile, up to which its positions
/// serve as pixel centres. Larger: heights are displaced. Smaller: rounding in the file makes the line an interpolated
/// one.
const SAME_STEP: f64 = 1e-6;

/// Returns the mean of the valid pixels of every column of a map as a profile of heights along x. Refuses a map whose
/// columns do not make a valid [`Profile`].
pub fn mean_profile(surface: &Surface) -> Result<Profile, Invalid> {
    let means = surface.height_nm().columns().into_iter().map(|column| {
        let valid: Vec<f64> = column.iter().copied().filter(|z| !z.is_nan()).collect();
        valid.iter().sum::<f64>() / valid.len() as f64
    });
    let height = means.collect();
    Profile::new(surface.grid().x.coordinates(), Values::HeightNm(height))
}

/// Makes the desired removal of a mirror line from its profile.
///
/// # Errors
/// Refuses a width across the line that is not positive, a distance of the pixels that is longer than the line or makes
/// more than 1e5 of them, and a profile that does not determine the shape to subtract.
pub fn line(profile: &Profile, settings: &LineSettings) -> Result<PreparedLine, Invalid> {
    settings.across.check()?;
    let signed = match settings.positive {
        Positive::Hill => profile.clone(),
        Positive::Hole => {
            let values = match profile.values() {
                Values::HeightNm(v) => Values::HeightNm(v.iter().map(|v| -v).collect()),
                Values::SlopeNrad(v) => Values::SlopeNrad(v.iter().map(|v| -v).collect()),
            };
            Profile::new(profile.position_mm().to_vec(), values)?
        }
    };
    let x = profile.position_mm().to_vec();
    let first = x[0];
    let length = x[x.len() - 1] - x[0];
    let step = settings.pixel_mm.unwrap_or(profile.step_mm());
    if !(step.is_finite() && step > 0.0 && length / step <= MOST_PIXELS && step <= length) {
        let problem = format!("is {step} mm for a line of {} mm", significant(length, 6));
        let remedy = format!("give a length that makes 2 to {MOST_PIXELS} pixels");
        return Err(Invalid::whole("pixel_mm", problem, remedy));
    }
    let residual = ShapeResidual::new(&Subject::Profile(signed), None, settings.subtract, None)?;
    let height = residual.height_nm.row(0).to_vec();
    let same =
        profile.uneven_steps_mm().is_none() && (step / profile.step_mm() - 1.0).abs() <= SAME_STEP;
    let row: Array1<f64> = if same {
        height.into()
    } else {
        let pixels = (length / step * (1.0 + SAME_STEP)).floor() as usize + 1;
        let even = at_even_steps(&x, &height, step, pixels);
        even.row(0).to_owned()
    };
    let lowest = row.iter().copied().filter(|z| !z.is_nan()).fold(f64::INFINITY, f64::min);
    let half = 0.5 * settings.across.width_mm();
    let nx = row.len();
    let grid = Grid { x: Axis::new(first, step, nx)?, y: Axis::new(-half, half, 3)? };
    let rows = Array2::from_shape_fn((3, nx), |(_, c)| row[c] - lowest);
    let slopes = slope::slopes(rows.view(), &grid.x.coordinates(), slope::Along::X, 1);
    // nm/mm are 1e3 nrad.
    let slope_rms_nrad = statistics(slopes.view()).map_or(0.0, |s| 1e3 * s.rms);
    let surface = Surface::new(grid, rows)?;
    let mut notes = residual.notes.clone();
    notes.retain(|note| !note.contains("spectra"));
    if !same {
        let step = significant(step, 6);
        notes.push(format!("the profile is interpolated linearly at steps of {step} mm"));
    }
    let report = LineReport {
        rms_nm: surface.statistics().rms,
        slope_rms_nrad,
        integrated: matches!(profile.values(), Values::SlopeNrad(_)),
        interpolated: !same,
        shape: residual.shape,
        notes,
    };
    Ok(PreparedLine { surface, report })
}

/// Makes the tool of a line: the rate (1) or (2) of the module in the rows at -W/2, 0 and W/2, and zeros at -W and W.
///
/// # Errors
/// Refuses a width across the line that is not positive, a TIF that varies over the part, and a strip that does not
/// lie under the tool.
pub fn integrated_across(tif: &Tif, across: Across) -> Result<Tif, Invalid> {
    across.check()?;
    tif.same_everywhere("a line")?;
    let own = tif.grid();
    let width_mm = across.width_mm();
    let (low, high) = match across {
        Across::StripWidthMm(width) => (-0.5 * width, 0.5 * width),
        Across::PitchMm(_) => (own.y.start_mm(), own.y.end_mm()),
    };
    // Ends of the smooth pieces of the integrand within the strip.
    let mut ends = vec![low.max(own.y.start_mm()), high.min(own.y.end_mm())];
    ends.extend(own.y.coordinates().into_iter().filter(|y| low < *y && *y < high));
    ends.sort_by(f64::total_cmp);
    let nodes = gauss_legendre::<2>();
    let rate: Vec<f64> = own
        .x
        .coordinates()
        .into_iter()
        .map(|x| {
            let pieces = ends.windows(2).map(|ends| {
                let length = (ends[1] - ends[0]).max(0.0);
                let at_nodes = nodes.iter().map(|(u, w)| w * tif.rate_at(x, ends[0] + length * u));
                length * at_nodes.sum::<f64>()
            });
            pieces.sum::<f64>() / width_mm
        })
        .collect();
    let grid = Grid { x: own.x, y: Axis::new(-width_mm, 0.5 * width_mm, 5)? };
    let rows =
        Array2::from_shape_fn(grid.shape(), |(r, c)| if r == 0 || r == 4 { 0.0 } else { rate[c] });
    Tif::new(grid, rows).map_err(|e| match across {
        Across::StripWidthMm(_) => {
            Invalid { remedy: format!("{}; the strip may not lie under the tool", e.remedy), ..e }
        }
        Across::PitchMm(_) => e,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    /// Returns a Gaussian TIF of sigma 3 mm that ends at 15 mm; samples of 0.5 mm give its integrals to 1e-4.
    fn tool() -> Tif {
        let a = Axis::new(-15.0, 0.5, 61).unwrap();
        let g = Grid { x: a, y: a };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            2.0 * (-(a.coordinate_mm(r).powi(2) + a.coordinate_mm(c).powi(2)) / 18.0).exp()
        });
        Tif::new(g, rate).unwrap()
    }

    /// `1 / W int R dy = 2 e^(-x^2 / 18) sqrt(2 pi) 3 erf(W / (2 sqrt(2) 3)) / W`; erf from tables.
    #[test]
    fn the_tool_is_integrated_across_the_strip() {
        let whole = 2.0 * (2.0 * PI).sqrt() * 3.0;
        for (across, want) in [
            // erf(1 / sqrt 2) = 0.682689492137
            (Across::StripWidthMm(6.0), whole * 0.682_689_492_137 / 6.0),
            // W = 2.5 ends between samples: the series of the integral of exp(-y^2 / 18), whose next term is 2e-5.
            (
                Across::StripWidthMm(2.5),
                2.0 * (1.0 - 1.25_f64.powi(2) / 54.0 + 1.25_f64.powi(4) / 3240.0),
            ),
            (Across::StripWidthMm(100.0), whole / 100.0),
            (Across::PitchMm(2.0), whole / 2.0),
        ] {
            let made = integrated_across(&tool(), across).unwrap();
            for (dx, factor) in
                [(0.0, 1.0), (3.0, (-0.5_f64).exp()), (-6.5, (-42.25 / 18.0_f64).exp())]
            {
                let half = 0.5 * across.width_mm();
                for dy in [-half, 0.0, half] {
                    let found = made.rate_at(dx, dy) / (factor * want);
                    // The third order of Keys' interpolation, at samples of a sixth of the standard deviation.
                    assert!((found - 1.0).abs() < 3e-4, "{across:?} {dx} {dy} {found}");
                }
                assert_eq!(made.rate_at(dx, 2.0 * half), 0.0);
            }
        }
    }

    fn settings() -> LineSettings {
        LineSettings {
            across: Across::StripWidthMm(10.0),
            positive: Positive::Hill,
            subtract: Shape::Plane,
            pixel_mm: None,
        }
    }

    #[test]
    fn slopes_and_heights_of_one_line_give_one_removal() {
        let x: Vec<f64> = (0..401).map(f64::from).collect();
        let (k, a) = (2.0 * PI / 80.0, 5.0);
        let heights = Values::HeightNm(x.iter().map(|x| 3.0 + a * (k * x).cos()).collect());
        // nm/mm are 1e3 nrad; a slope and a tilt of 7 urad.
        let slope = |x: &f64| -1e3 * a * k * (k * x).sin() + 7e3;
        let slopes = Values::SlopeNrad(x.iter().map(slope).collect());
        let by_height = line(&Profile::new(x.clone(), heights).unwrap(), &settings()).unwrap();
        let by_slope = line(&Profile::new(x, slopes.clone()).unwrap(), &settings()).unwrap();
        let (z, w) = (by_height.surface.height_nm(), by_slope.surface.height_nm());
        assert_eq!(z.dim(), (3, 401));
        assert_eq!(z.row(0), z.row(2));
        // Trapezoids of the slope shrink its amplitude by (k h)^2 / 12 = 5e-4 of 5 nm.
        assert!(z.iter().zip(w).all(|(z, w)| (z - w).abs() < 8e-3));
        assert!(by_slope.report.integrated && !by_height.report.integrated);
        let rms = 1e3 * a * k / 2.0_f64.sqrt();
        // The slope between neighbours of a wave is sinc(k h / 2) of its slope, 3e-4 less.
        assert!((by_height.report.slope_rms_nrad / rms - 1.0).abs() < 1e-3);
        let hole = LineSettings { positive: Positive::Hole, ..settings() };
        let x: Vec<f64> = (0..401).map(f64::from).collect();
        let turned = line(&Profile::new(x, slopes).unwrap(), &hole).unwrap();
        let sum = turned.surface.height_nm() + w;
        let [least, most] =
            sum.iter().fold([f64::MAX, f64::MIN], |[a, b], v| [a.min(*v), b.max(*v)]);
        // Rounding of sums over 400 slopes of heights of up to 3e3 nm.
        assert!(most - least < 1e-9 && most > 0.0);
    }

    #[test]
    fn uneven_positions_are_interpolated_and_invalid_ones_stay() {
        let x: Vec<f64> =
            (0..101).map(|i| f64::from(i) + if i % 2 == 0 { 0.0 } else { 0.2 }).collect();
        let mut height: Vec<f64> = x.iter().map(|x| 0.5 * x).collect();
        height[50] = f64::NAN;
        let profile = Profile::new(x, Values::HeightNm(height)).unwrap();
        let flat = LineSettings { subtract: Shape::Piston, pixel_mm: Some(0.4), ..settings() };
        let made = line(&profile, &flat).unwrap();
        assert!(made.report.interpolated && !made.report.notes.is_empty());
        let z = made.surface.height_nm();
        assert_eq!(z.ncols(), 251);
        // A straight line stays one: 0.5 nm/mm.
        assert!((z[[1, 200]] - 0.5 * 80.0).abs() < 1e-9);
        assert!(z[[1, 125]].is_nan() && !z[[1, 130]].is_nan());
        for pixel_mm in [Some(0.0), Some(1e-5), Some(1e3), Some(f64::NAN)] {
            let e = line(&profile, &LineSettings { pixel_mm, ..flat }).unwrap_err();
            assert_eq!(e.array, "pixel_mm");
        }
        let across = Across::StripWidthMm(-1.0);
        let e = line(&profile, &LineSettings { across, ..flat }).unwrap_err().to_string();
        assert!(e.contains("strip_width_mm: is -1"), "{e}");
    }
}
