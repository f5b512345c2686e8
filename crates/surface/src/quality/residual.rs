//! A map or a profile after its best shape: its heights, slopes, spectra and autocorrelation length.

use std::cell::OnceCell;

use ndarray::{Array2, ArrayView2};
use planish_numerics::{
    slope::{self, slopes, steps_of_base},
    spectrum::MIN_SAMPLES,
    statistics::{Statistics, statistics},
};
use planish_types::{Invalid, Surface, text::significant};
use serde::{Deserialize, Serialize};

use super::spectrum::{Spectra, at_even_steps, autocorrelation_length};
use crate::{
    profile::{Profile, Values},
    shape::{EllipseSettings, Heights, Shape, ShapeReport, without_shape, without_shape_of_slopes},
};

/// Relative standard error of a parameter of the ellipse above which the report has a note, because the data hardly
/// determine the parameter. Larger: no note on meaningless parameters. Smaller: notes on usual fits.
const NOTEWORTHY_ERROR: f64 = 0.1;

/// Measured object whose quality is computed.
#[derive(Clone, Debug)]
pub enum Subject {
    /// A map of heights.
    Map(Surface),
    /// A profile of heights or slopes along a line.
    Profile(Profile),
}

/// Direction of a slope, a spectrum or a radius.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Direction {
    /// Along x.
    X,
    /// Along y.
    Y,
    /// All directions of a map: means over rings of equal frequency, or the radius of a sphere.
    Radial,
}

/// Statistics of the slopes along one axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SlopeReport {
    /// Base length over which slopes are differences of heights, mm; 0 if slopes were measured.
    pub base_mm: f64,
    /// RMS of the slopes without their mean, nrad.
    pub rms_nrad: f64,
    /// Largest magnitude of the deviation of a slope from the mean slope, nrad.
    pub peak_nrad: f64,
    /// Position [x, y] of that slope, the middle of its base, mm.
    pub peak_at_mm: [f64; 2],
}

/// A map or a profile, or a zone of it, after subtraction of the best shape.
pub(crate) struct ShapeResidual {
    /// Positions along x (nx), mm.
    pub(super) x_mm: Vec<f64>,
    /// Positions along y (ny), mm; for a profile one, 0.
    y_mm: Vec<f64>,
    /// Heights after the shape (ny, nx), nm; NaN where invalid.
    pub(crate) height_nm: Array2<f64>,
    /// Measured slopes of a profile after the shape (nx), nrad; `None` if heights were measured.
    measured_slope_nrad: Option<Vec<f64>>,
    /// The map after the shape, for its spectra; `None` for a profile.
    surface: Option<Surface>,
    pub(crate) shape: ShapeReport,
    pub(crate) notes: Vec<String>,
    spectra: OnceCell<Result<Spectra, Invalid>>,
}

impl ShapeResidual {
    /// Subtracts the best `shape` from the pixels of `subject` at which `inside` is true; without `inside`, from all
    /// pixels.
    pub(crate) fn new(
        subject: &Subject,
        inside: Option<&Array2<bool>>,
        shape: Shape,
        ellipse: Option<&EllipseSettings>,
    ) -> Result<Self, Invalid> {
        match subject {
            Subject::Map(surface) => {
                let (x_mm, y_mm) = (surface.grid().x.coordinates(), surface.grid().y.coordinates());
                let heights = masked(surface.height_nm().clone(), inside);
                let heights = Heights { x_mm: &x_mm, y_mm: &y_mm, height_nm: &heights };
                let (height_nm, report) = without_shape(&heights, shape, ellipse)?;
                let surface = Some(Surface::new(*surface.grid(), height_nm.clone())?);
                Ok(Self::with_notes(x_mm, y_mm, height_nm, None, surface, report))
            }
            Subject::Profile(profile) => {
                let x_mm = profile.position_mm().to_vec();
                let (height_nm, slope, report) = match profile.values() {
                    Values::HeightNm(heights) => {
                        let heights = masked(as_row(heights), inside);
                        let heights = Heights { x_mm: &x_mm, y_mm: &[0.0], height_nm: &heights };
                        let (left, report) = without_shape(&heights, shape, ellipse)?;
                        (left, None, report)
                    }
                    Values::SlopeNrad(slopes) => {
                        let slopes = masked(as_row(slopes), inside).into_raw_vec_and_offset().0;
                        let (left, report) =
                            without_shape_of_slopes(&x_mm, &slopes, shape, ellipse)?;
                        let heights = integrated(&x_mm, &left);
                        let heights = Heights { x_mm: &x_mm, y_mm: &[0.0], height_nm: &heights };
                        let (heights, _) = without_shape(&heights, rest_of(shape), None)?;
                        (heights, Some(left), report)
                    }
                };
                let mut residual =
                    Self::with_notes(x_mm, vec![0.0], height_nm, slope, None, report);
                if let Some([low, high]) = profile.uneven_steps_mm() {
                    residual.notes.push(format!(
                        "the positions are not uniform (steps of {} to {} mm): spectra are of values \
                         interpolated linearly at steps of {} mm",
                        significant(low, 6),
                        significant(high, 6),
                        significant(profile.step_mm(), 6)
                    ));
                }
                Ok(residual)
            }
        }
    }

    /// Makes the residual with a note for each parameter of the ellipse that the data hardly determine.
    fn with_notes(
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
                let how = if error.is_finite() {
                    format!("standard error {} %", significant(100.0 * error, 2))
                } else {
                    "it is infinite".into()
                };
                notes.push(format!(
                    "the data hardly tell {name} of the ellipse ({how}); the residual is that of the best ellipse found from all \
                     starts of the fit"
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

    /// Returns the position [x, y], mm, of the height that is farthest from the mean height, and its distance from it,
    /// nm. Refuses a zone without a valid pixel.
    pub(crate) fn farthest_height(&self) -> Result<([f64; 2], f64), Invalid> {
        let mean = self.height()?.mean;
        let ((r, c), distance) = farthest(self.height_nm.view(), mean);
        Ok(([self.x_mm[c], self.y_mm[r]], distance))
    }

    /// Returns the statistics of the slopes along an axis. The base is the whole number of steps nearest to `base_mm`;
    /// measured slopes are used as they are. Refuses what [`Self::slopes`] refuses, and no two valid pixels a base
    /// apart.
    pub(crate) fn slope(&self, along: Direction, base_mm: f64) -> Result<SlopeReport, Invalid> {
        let (positions, values, base_mm) = self.slopes(along, base_mm)?;
        let slopes = statistics(values.view()).ok_or_else(|| {
            let problem = format!("no two valid pixels are {} mm apart", significant(base_mm, 4));
            Invalid::whole("slope", problem, "give a shorter `base_mm`, or another zone")
        })?;
        let ((r, c), peak_nrad) = farthest(values.view(), slopes.mean);
        let peak_at_mm = match along {
            Direction::Y => [self.x_mm[c], positions[r]],
            _ => [positions[c], self.y_mm[r]],
        };
        Ok(SlopeReport { base_mm, rms_nrad: slopes.rms, peak_nrad, peak_at_mm })
    }

    /// Returns the positions of the slopes along an axis (the middles of the bases), mm, the slopes, nrad, and the base
    /// that was used, mm (0 for measured slopes). Refuses the radial direction, y of a profile, and a base that is not
    /// positive or longer than the map.
    pub(super) fn slopes(
        &self,
        along: Direction,
        base_mm: f64,
    ) -> Result<(Vec<f64>, Array2<f64>, f64), Invalid> {
        let (position_mm, axis) = match along {
            Direction::X => (&self.x_mm, slope::Along::X),
            Direction::Y => (&self.y_mm, slope::Along::Y),
            Direction::Radial => {
                let remedy = "give x or y; slopes are along a direction";
                return Err(Invalid::whole("slope", "`along` is radial", remedy));
            }
        };
        if let (Direction::X, Some(slopes)) = (along, &self.measured_slope_nrad) {
            return Ok((self.x_mm.clone(), as_row(slopes), 0.0));
        }
        if self.is_profile() && along == Direction::Y {
            let remedy = "a profile has slopes along x only";
            return Err(Invalid::whole("slope", "`along` is y", remedy));
        }
        if !(base_mm.is_finite() && base_mm > 0.0) {
            let problem = format!("`base_mm` is {base_mm}");
            return Err(Invalid::whole("slope", problem, "give a length in mm, above 0"));
        }
        let n = position_mm.len();
        let length_mm = position_mm[n - 1] - position_mm[0];
        let step_mm = length_mm / (n - 1) as f64;
        let steps = steps_of_base(base_mm, step_mm, n).ok_or_else(|| {
            let length_mm = significant(length_mm, 4);
            let problem = format!("`base_mm` is {base_mm}, the map is {length_mm} mm long");
            Invalid::whole("slope", problem, "give a shorter one")
        })?;
        // nm/mm is urad.
        let mut values = slopes(self.height_nm.view(), position_mm, axis, steps);
        values.mapv_inplace(|s| 1e3 * s);
        let middles = (0..n - steps).map(|i| 0.5 * (position_mm[i] + position_mm[i + steps]));
        Ok((middles.collect(), values, steps as f64 * step_mm))
    }

    pub(crate) fn spectra(&self) -> Result<&Spectra, Invalid> {
        let spectra = self.spectra.get_or_init(|| match &self.surface {
            Some(surface) => Spectra::of_map(surface),
            None => match &self.measured_slope_nrad {
                Some(slopes) => Spectra::of_slopes(&self.x_mm, slopes),
                None => {
                    let heights = self.height_nm.as_slice().expect("a row is contiguous");
                    Spectra::of_heights(&self.x_mm, heights)
                }
            },
        });
        spectra.as_ref().map_err(Clone::clone)
    }

    /// Returns the lag along the axis at which the autocorrelation of the heights falls to 1/e, mm. Returns `None` if
    /// it does not fall so far, or if there are too few positions.
    pub(crate) fn autocorrelation_length_mm(&self, along: Direction) -> Option<f64> {
        let (position_mm, turned) = match along {
            Direction::Y => (&self.y_mm, self.height_nm.t().to_owned()),
            _ => (&self.x_mm, self.height_nm.clone()),
        };
        let n = position_mm.len();
        if n < MIN_SAMPLES {
            return None;
        }
        let step_mm = (position_mm[n - 1] - position_mm[0]) / (n - 1) as f64;
        let turned = if self.is_profile() {
            at_even_steps(position_mm, turned.as_slice()?, step_mm, n)
        } else {
            turned
        };
        autocorrelation_length(turned.view()).map(|lag| lag * step_mm)
    }
}

/// Returns `map` with NaN where `inside` is false.
fn masked(mut map: Array2<f64>, inside: Option<&Array2<bool>>) -> Array2<f64> {
    if let Some(inside) = inside {
        map.zip_mut_with(inside, |z, inside| {
            if !inside {
                *z = f64::NAN
            }
        });
    }
    map
}

/// Returns values as a map of one row.
fn as_row(values: &[f64]) -> Array2<f64> {
    Array2::from_shape_fn((1, values.len()), |(_, c)| values[c])
}

/// Returns the shape to subtract from the integral of measured slopes after the best `shape`. Least squares of slopes
/// are not those of heights, and leave a line or a circle.
fn rest_of(shape: Shape) -> Shape {
    match shape {
        Shape::CylinderX | Shape::CylinderY | Shape::Sphere => Shape::CylinderX,
        Shape::Piston => Shape::Piston,
        Shape::Plane | Shape::Ellipse => Shape::Plane,
    }
}

/// Returns the trapezoidal integral of slopes (nrad) over x (mm) as heights of one row, nm, from 0. An invalid slope
/// has the height NaN, and its neighbours are joined over it.
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

/// Returns the index of the valid element that is farthest from `mean`, and its distance from `mean`.
fn farthest(map: ArrayView2<f64>, mean: f64) -> ((usize, usize), f64) {
    let valid = map.indexed_iter().filter(|(_, v)| !v.is_nan());
    valid.fold(((0, 0), 0.0), |best, (pixel, v)| {
        let distance = (v - mean).abs();
        if distance > best.1 { (pixel, distance) } else { best }
    })
}
