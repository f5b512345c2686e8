//! Heights from two maps of slopes, as a deflectometer or a Hartmann sensor measures them.
//!
//! ```text
//! minimise  sum w_x (z[r, c+1] - z[r, c] - D_x[r, c])^2 + sum w_y (z[r+1, c] - z[r, c] - D_y[r, c])^2             (1)
//! D_x[r, c] = h_x (-s[c-1] + 13 s[c] + 13 s[c+1] - s[c+2]) / 24                                                  (2)
//! w = 1 / h^2
//! ```
//!
//! (1) is the least squares of W. H. Southwell, "Wave-front estimation from wave-front slope measurements", J. Opt. Soc.
//! Am. 70 (1980) 998, with a slope at every pixel. (2) is the integral of the cubic through four slopes in place of the
//! trapezoid (G. Li, Y. Li, K. Liu, X. Ma, H. Wang, J. Opt. Soc. Am. A 30 (2013) 1448); at the ends of a run of valid pixels
//! it is that of the cubic, parabola or line through the nearest ones. The error of the heights falls with h^4, and at the
//! edge of a mask, where runs of two and three pixels are, with h^3.
//!
//! The normal equations are the Laplacian of the pixels that are connected. Conjugate gradients solve them. Their
//! preconditioner is the exact inverse of the Laplacian on the whole rectangle, by the Fourier transform of the map
//! mirrored at its edges: without invalid pixels the first step is the solution, and with any mask the number of steps does
//! not depend on the number of pixels.
//!
//! A surface has slopes without curl, so the residual of (1) says whether the two maps belong together. With the other
//! sign of the slopes along y the same two integrals give the other residual, and the sign with far less of it is
//! right.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | s | `slope` | (ny, nx) | urad = nm/mm |
//! | D | `differences` | (ny, nx), 0 where a neighbour is absent | nm |
//! | z | `height_nm` | (ny, nx) | nm |
//! | h | `pitch_mm` | (2) | mm |

use ndarray::{Array2, ArrayView1, Axis as NdAxis, s};
use planish_numerics::fft::transform;
use planish_types::{
    Axis, Grid, Invalid, Surface,
    text::significant,
    units::{self, Quantity},
};
use serde::Serialize;

use crate::reading::{Reading, ReadingSettings, Statement, surface};

/// Norm of the residual of the normal equations, relative to that of their right side, at which the iteration ends.
/// Larger: heights are less exact. Smaller: rounding prevents the end.
const TOLERANCE: f64 = 1e-12;

/// Largest number of steps of the iteration, which then ends without having reached the tolerance. Larger: more time
/// where rounding prevents the tolerance. Smaller: masks of many narrow pieces are not solved. Measured: 15 for a disc,
/// 60 for a comb.
const MOST_STEPS: usize = 500;

/// Largest ratio of the residual slopes, RMS, to the slopes without their means, RMS; above it a warning doubts the
/// maps. Larger: maps that do not belong together pass. Smaller: noisy maps are doubted.
const MOST_RESIDUAL: f64 = 0.3;

/// Ratio of the residuals with the two signs of the slopes along y above which the sign with the smaller one is
/// certainly right. Larger: the wrong sign is refused less often. Smaller: noise decides.
const DECISIVE: f64 = 3.0;

/// Statements of the user about two maps of slopes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SlopeSettings {
    /// Unit of the slopes in both files; `None` if the files state it.
    pub unit: Option<SlopeUnit>,
    /// True to change the sign of the slopes along x, because the file counts them as positive where the surface rises
    /// towards smaller x.
    pub negate_x: bool,
    /// True to change the sign of the slopes along y, because the file counts them as positive where the surface rises
    /// towards smaller y.
    pub negate_y: bool,
    /// True to keep the signs of the maps, even if the other sign along y fits far better; otherwise such maps are
    /// refused.
    pub trust_signs: bool,
    /// Settings that a map of slopes shares with a map of heights, such as pitch, origin and orientation.
    pub map: ReadingSettings,
}

/// Unit of slopes: an angle, or a ratio of two lengths.
#[derive(Clone, Debug, PartialEq)]
pub struct SlopeUnit {
    name: String,
    /// Size of the unit: in rad for an angle, otherwise the ratio of the two lengths, dimensionless.
    size: f64,
    is_angle: bool,
}

impl Serialize for SlopeUnit {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.name)
    }
}

impl std::str::FromStr for SlopeUnit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let name = text.trim().to_string();
        let unit = |text: &str| units::Unit::read(text, &[Quantity::Angle, Quantity::Length]);
        if let Some(angle) = unit(text).filter(|unit| unit.quantity() == Quantity::Angle) {
            return Ok(Self { name, size: angle.size(0), is_angle: true });
        }
        if matches!(text.trim(), "1" | "") {
            return Ok(Self { name, size: 1.0, is_angle: false });
        }
        let lower = text.replace(" per ", "/").replace("_per_", "/");
        let lengths = lower.split_once('/').and_then(|(a, b)| Some((unit(a)?, unit(b)?)));
        match lengths {
            Some((a, b)) if [a, b].iter().all(|u| u.quantity() == Quantity::Length) => {
                Ok(Self { name, size: a.size(0) / b.size(0), is_angle: false })
            }
            _ => Err(
                "give rad, mrad, urad, nrad, deg, arcsec, or a length over a length such as nm/mm"
                    .into(),
            ),
        }
    }
}

impl SlopeUnit {
    /// Returns the slope in urad (1e-6 of rise over run) of a value in this unit. An angle becomes its tangent.
    fn urad(&self, value: f64) -> f64 {
        let ratio = value * self.size;
        1e6 * if self.is_angle { ratio.tan() } else { ratio }
    }
}

/// Quality of heights from slopes, and how the two files were read.
#[derive(Clone, Debug, Serialize)]
pub struct SlopeReport {
    /// Conversion of the map of slopes along x. Its numbers in nm are urad here.
    pub x: Statement,
    /// Conversion of the map of slopes along y, also in urad.
    pub y: Statement,
    /// Unit of the slopes in both files.
    pub unit: SlopeUnit,
    /// RMS of the slopes along [x, y] after subtraction of their means, urad.
    pub slope_rms_urad: [f64; 2],
    /// RMS of the part of the slopes that belongs to no surface, urad: the residual of (1) of the module, over both
    /// axes.
    pub residual_urad: f64,
    /// RMS of that part if the slopes along y had the other sign, urad. It tells which sign is right.
    pub residual_of_other_sign_urad: f64,
    /// Number of valid pixels outside of the largest connected region, which are left out.
    pub unconnected_pixels: usize,
    /// Number of steps of the conjugate gradients: the larger one of the two solutions, along x and along y.
    pub steps: usize,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Integrates two maps of slopes, along x and along y, to a map of heights in nm.
///
/// Refuses maps on two grids, signs that contradict each other, and a unit that is missing, no slope or not the same in
/// both maps. Refuses fewer than 4 connected pixels that are valid in both maps, and what [`surface`] refuses.
/// # Errors
/// Refuses maps of two grids, a unit that is missing, no slope or not the same in both maps, and signs that contradict
/// each other. Refuses fewer than 4 connected pixels that are valid in both maps.
pub fn slopes(
    along_x: Reading,
    along_y: Reading,
    settings: &SlopeSettings,
) -> Result<(Surface, SlopeReport), Invalid> {
    let mut warnings = Vec::new();
    let unit = unit(&along_x, &along_y, settings, &mut warnings)?;
    let has_place =
        along_x.coordinates.is_some() || along_x.rule.is_some() || along_x.window.is_some();
    let plain = ReadingSettings {
        unit: None,
        flip_x: false,
        flip_y: false,
        rotation: crate::Rotation::None,
        origin: crate::Origin::File,
        place_mm: None,
        ..settings.map.clone()
    };
    let (x_map, x) = map_of_slopes(along_x, &unit, settings.negate_x, &plain)?;
    let (y_map, y) = map_of_slopes(along_y, &unit, settings.negate_y, &plain)?;
    let grid = *x_map.grid();
    let other = y_map.grid();
    if differ(&grid.x, &other.x) || differ(&grid.y, &other.y) {
        let problem = format!(
            "have {:?} and {:?} pixels of {} and {} mm",
            grid.shape(),
            other.shape(),
            significant(grid.x.step_mm(), 6),
            significant(other.x.step_mm(), 6)
        );
        return Err(Invalid::whole("slopes", problem, "give both on the same pixels"));
    }
    for (statement, axis) in [(&x, "x"), (&y, "y")] {
        warnings.extend(statement.warnings.iter().map(|w| format!("slopes along {axis}: {w}")));
    }
    let made = integrate(x_map.height_nm(), y_map.height_nm(), &grid)?;
    judge_signs(&made, settings, &mut warnings)?;
    if made.unconnected_pixels > 0 {
        warnings.push(format!(
            "{} valid pixels are not connected with the largest region and are left out: slopes do not tell their height \
             against it",
            made.unconnected_pixels
        ));
    }
    let mut heights = Reading::of_map(&grid, &made.height_nm);
    if !has_place {
        heights.coordinates = None;
        heights.pixel_mm = Some([grid.x.step_mm(), grid.y.step_mm()]);
    }
    let own = ReadingSettings {
        unit: None,
        wavelength_nm: None,
        pixel_mm: None,
        coordinate_unit: None,
        surface_per_value: 1.0,
        negate: false,
        no_data: None,
        first_row: None,
        ..settings.map.clone()
    };
    let (map, _) = surface(heights, &own)?;
    let report = SlopeReport {
        x,
        y,
        unit,
        slope_rms_urad: made.slope_rms_urad,
        residual_urad: made.residual_urad,
        residual_of_other_sign_urad: made.residual_of_other_sign_urad,
        unconnected_pixels: made.unconnected_pixels,
        steps: made.steps,
        warnings,
    };
    Ok((map, report))
}

/// Returns true if two axes differ in their number of pixels, or at their first or last pixel by more than 1e-3 of the
/// pitch.
fn differ(a: &Axis, b: &Axis) -> bool {
    let ends = [(a.start_mm(), b.start_mm()), (a.end_mm(), b.end_mm())];
    a.len() != b.len() || ends.iter().any(|(a_mm, b_mm)| (a_mm - b_mm).abs() > 1e-3 * a.step_mm())
}

/// Returns the unit of both maps, as the files or the user state it. Refuses different units, a unit that is no slope,
/// one that nobody states, and one of the user that contradicts the files without `override_file`.
fn unit(
    along_x: &Reading,
    along_y: &Reading,
    settings: &SlopeSettings,
    warnings: &mut Vec<String>,
) -> Result<SlopeUnit, Invalid> {
    let remedy = "give `unit` urad, mrad, rad, deg, arcsec or a length over a length such as nm/mm";
    let mut stated: Option<SlopeUnit> = None;
    for reading in [along_x, along_y] {
        let Some(word) = &reading.unit_word else { continue };
        let unit = match (word.parse::<SlopeUnit>(), &settings.unit) {
            (Ok(unit), _) => unit,
            (Err(_), Some(requested)) if settings.map.override_file => requested.clone(),
            (Err(_), _) => {
                let short: String = word.chars().filter(|c| !c.is_control()).take(40).collect();
                let problem = format!("is \"{short}\", which is no slope");
                return Err(Invalid::whole(
                    "unit",
                    problem,
                    format!("{remedy}, and `override_file`"),
                ));
            }
        };
        if let Some(before) = stated.as_ref().filter(|b| b.size != unit.size) {
            let problem = format!("is {} along x and {} along y", before.name, unit.name);
            return Err(Invalid::whole("unit", problem, "give both maps in the same unit"));
        }
        stated = Some(unit);
    }
    match (stated, &settings.unit) {
        (None, None) => Err(Invalid::whole("unit", "of the slopes is not in the file", remedy)),
        (Some(stated), Some(requested)) if stated.size != requested.size => {
            if !settings.map.override_file {
                let problem =
                    format!("is {} in the file, {} was asked for", stated.name, requested.name);
                let remedy = "leave out `unit`, or give `override_file` where the file is wrong";
                return Err(Invalid::whole("unit", problem, remedy));
            }
            let text =
                format!("`unit` {} takes the place of {} in the file", requested.name, stated.name);
            warnings.push(text);
            Ok(requested.clone())
        }
        (Some(stated), _) => Ok(stated),
        (None, Some(requested)) => Ok(requested.clone()),
    }
}

/// Returns the slopes of a reading on their grid, as a surface whose heights in nm are the slopes in urad. `unit` is
/// that of the slopes in the file; `negate` changes their sign.
fn map_of_slopes(
    mut reading: Reading,
    unit: &SlopeUnit,
    negate: bool,
    settings: &ReadingSettings,
) -> Result<(Surface, Statement), Invalid> {
    if let Some(marker) = settings.no_data {
        reading.invalidate(marker);
    }
    let Reading { factor, offset, .. } = reading;
    let sign = if negate { -1.0 } else { 1.0 };
    reading.values.mapv_inplace(|v| sign * unit.urad(offset + factor * v));
    reading.factor = 1.0;
    reading.offset = 0.0;
    reading.unit = Some(crate::Unit::named("nm"));
    reading.unit_problem = None;
    reading.lone_unit = None;
    surface(reading, &ReadingSettings { no_data: None, ..settings.clone() })
}

/// Refuses maps if the other sign of the slopes along y fits [`DECISIVE`] times better, unless the settings trust the
/// signs. Adds a warning if the maps may not belong together, or if both signs fit.
fn judge_signs(
    made: &Integrated,
    settings: &SlopeSettings,
    warnings: &mut Vec<String>,
) -> Result<(), Invalid> {
    let size = made.slope_rms_urad[0].hypot(made.slope_rms_urad[1]);
    let residual = made.residual_urad;
    let other = made.residual_of_other_sign_urad;
    let [residual_text, other_text, size_text] = [residual, other, size].map(|v| significant(v, 3));
    if residual > DECISIVE * other && residual > 1e-6 * size && !settings.trust_signs {
        let problem = format!(
            "contradict each other: {residual_text} urad RMS belong to no surface, and {other_text} urad with the \
             other sign along y"
        );
        let remedy = if settings.negate_y {
            "leave out `negate_y`; `trust_signs` takes them as they are"
        } else {
            "give `negate_y` where slopes along y count down the rows, or `first_row`; `trust_signs` takes them \
             as they are"
        };
        return Err(Invalid::whole("slopes", problem, remedy));
    }
    if residual > MOST_RESIDUAL * size {
        warnings.push(format!(
            "{residual_text} of {size_text} urad RMS of the slopes belong to no surface: noise, another order of x and \
             y, or maps of two parts?"
        ));
    } else if other <= DECISIVE * residual || other <= 1e-6 * size {
        warnings.push(
            "these slopes are those of a surface with either sign along y: check that the map is not upside down".into(),
        );
    }
    Ok(())
}

/// Heights from two maps of slopes, with the quantities of [`SlopeReport`].
struct Integrated {
    height_nm: Array2<f64>,
    slope_rms_urad: [f64; 2],
    residual_urad: f64,
    residual_of_other_sign_urad: f64,
    unconnected_pixels: usize,
    steps: usize,
}

/// Integrates slopes along x and y, urad, both (ny, nx) with NaN at invalid pixels, on `grid`. Pixels outside of the
/// largest connected region become invalid. Refuses fewer than 4 connected pixels.
fn integrate(
    slope_x: &Array2<f64>,
    slope_y: &Array2<f64>,
    grid: &Grid,
) -> Result<Integrated, Invalid> {
    let mut valid = Array2::from_shape_fn(slope_x.dim(), |pixel| {
        slope_x[pixel].is_finite() && slope_y[pixel].is_finite()
    });
    let unconnected_pixels = keep_largest_region(&mut valid);
    let count = valid.iter().filter(|v| **v).count();
    if count < 4 {
        let problem = format!("have {count} connected pixels that are valid in both");
        return Err(Invalid::whole("slopes", problem, "give maps with a connected region"));
    }
    let pitch_mm = [grid.x.step_mm(), grid.y.step_mm()];
    let laplacian = Laplacian::new(valid, pitch_mm);
    let along_x = differences(slope_x, &laplacian.valid, pitch_mm[0], 1);
    let along_y = differences(slope_y, &laplacian.valid, pitch_mm[1], 0);
    let none = Array2::zeros(along_x.dim());
    // (1) is linear: with either sign along y, the heights are a sum or a difference of these.
    let (of_x, steps_x) = laplacian.solve(&laplacian.divergence(&along_x, &none));
    let (of_y, steps_y) = laplacian.solve(&laplacian.divergence(&none, &along_y));
    let height = &of_x + &of_y;
    let residual_urad = laplacian.residual_urad(&height, &along_x, &along_y);
    let residual_of_other_sign_urad =
        laplacian.residual_urad(&(&of_x - &of_y), &along_x, &along_y.mapv(|v| -v));
    let mean = height.sum() / count as f64;
    let height_nm = Array2::from_shape_fn(height.dim(), |pixel| {
        if laplacian.valid[pixel] { height[pixel] - mean } else { f64::NAN }
    });
    let slope_rms_urad = [slope_x, slope_y].map(|slope| {
        let slopes = slope.iter().zip(&laplacian.valid).filter(|(_, v)| **v).map(|(s, _)| *s);
        let mean = slopes.clone().sum::<f64>() / count as f64;
        (slopes.map(|s| (s - mean).powi(2)).sum::<f64>() / count as f64).sqrt()
    });
    Ok(Integrated {
        height_nm,
        slope_rms_urad,
        residual_urad,
        residual_of_other_sign_urad,
        unconnected_pixels,
        steps: steps_x.max(steps_y),
    })
}

/// Makes all pixels of `valid` false outside of its largest connected region, whose pixels share edges. Returns how
/// many of them were true.
fn keep_largest_region(valid: &mut Array2<bool>) -> usize {
    let (rows, columns) = valid.dim();
    let mut region = Array2::<usize>::zeros((rows, columns));
    let mut sizes = vec![0usize];
    for start in (0..rows).flat_map(|r| (0..columns).map(move |c| (r, c))) {
        if !valid[start] || region[start] != 0 {
            continue;
        }
        let number = sizes.len();
        sizes.push(0);
        let mut next = vec![start];
        region[start] = number;
        while let Some((r, c)) = next.pop() {
            sizes[number] += 1;
            let neighbours =
                [(r.wrapping_sub(1), c), (r + 1, c), (r, c.wrapping_sub(1)), (r, c + 1)];
            for pixel in neighbours {
                if pixel.0 < rows && pixel.1 < columns && valid[pixel] && region[pixel] == 0 {
                    region[pixel] = number;
                    next.push(pixel);
                }
            }
        }
    }
    let total: usize = sizes.iter().sum();
    let largest = (0..sizes.len()).rev().max_by_key(|k| sizes[*k]).unwrap_or(0);
    valid.zip_mut_with(&region, |v, number| *v = *number == largest && largest > 0);
    total - sizes[largest]
}

/// Returns the height differences (2) of the module, nm, between every pixel and the next one along `axis` (0: along y,
/// 1: along x), `step_mm` away. They are 0 if one of the two is invalid. `slope` is in urad.
fn differences(
    slope: &Array2<f64>,
    valid: &Array2<bool>,
    step_mm: f64,
    axis: usize,
) -> Array2<f64> {
    let mut all = Array2::zeros(slope.dim());
    let lines = slope.lanes(NdAxis(axis)).into_iter().zip(valid.lanes(NdAxis(axis)));
    for ((slope, valid), mut line) in lines.zip(all.lanes_mut(NdAxis(axis))) {
        let mut start = 0;
        while start < slope.len() {
            let run = valid.iter().skip(start).take_while(|v| **v).count();
            for i in 0..run.saturating_sub(1) {
                line[start + i] = step_mm * step_of_run(slope.slice(s![start..start + run]), i);
            }
            start += run + 1;
        }
    }
    all
}

/// Returns the integral of the slopes from pixel `i` of a run to the next one, in the unit of the slopes times the
/// pitch. `s` holds the slopes of a run of at least two valid pixels.
fn step_of_run(s: ArrayView1<f64>, i: usize) -> f64 {
    let n = s.len();
    match n {
        2 => 0.5 * (s[0] + s[1]),
        3 if i == 0 => (5.0 * s[0] + 8.0 * s[1] - s[2]) / 12.0,
        3 => (5.0 * s[2] + 8.0 * s[1] - s[0]) / 12.0,
        _ if i == 0 => (9.0 * s[0] + 19.0 * s[1] - 5.0 * s[2] + s[3]) / 24.0,
        _ if i + 2 == n => (9.0 * s[n - 1] + 19.0 * s[n - 2] - 5.0 * s[n - 3] + s[n - 4]) / 24.0,
        _ => (13.0 * (s[i] + s[i + 1]) - s[i - 1] - s[i + 2]) / 24.0,
    }
}

/// Returns the sum of the products of corresponding elements of two arrays of the same shape.
fn dot(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// The matrix of the normal equations of (1) of the module, a weighted Laplacian on the valid pixels.
struct Laplacian {
    valid: Array2<bool>,
    /// Weights w = 1/h^2 along [x, y], 1/mm^2.
    weight: [f64; 2],
    /// Inverse eigenvalues of the Laplacian on the rectangle mirrored at its edges (2 ny, 2 nx), mm^2; 0 for the
    /// constant map.
    inverse: Array2<f64>,
}

impl Laplacian {
    fn new(valid: Array2<bool>, pitch_mm: [f64; 2]) -> Self {
        let weight = pitch_mm.map(|h| 1.0 / (h * h));
        let (rows, columns) = valid.dim();
        let inverse = Array2::from_shape_fn((2 * rows, 2 * columns), |(k, l)| {
            let [along_y, along_x] = [(k, rows), (l, columns)]
                .map(|(k, n)| 2.0 - 2.0 * (std::f64::consts::PI * k as f64 / n as f64).cos());
            let eigenvalue = weight[1] * along_y + weight[0] * along_x;
            if (k, l) == (0, 0) { 0.0 } else { 1.0 / eigenvalue }
        });
        Self { valid, weight, inverse }
    }

    /// Calls `visit` for every pair of valid neighbours: the pixels (row, column) of both, and the axis along which
    /// they are neighbours (0: x, 1: y).
    fn for_each_edge(&self, mut visit: impl FnMut((usize, usize), (usize, usize), usize)) {
        let (rows, columns) = self.valid.dim();
        for r in 0..rows {
            for c in 0..columns {
                if !self.valid[[r, c]] {
                    continue;
                }
                if c + 1 < columns && self.valid[[r, c + 1]] {
                    visit((r, c), (r, c + 1), 0);
                }
                if r + 1 < rows && self.valid[[r + 1, c]] {
                    visit((r, c), (r + 1, c), 1);
                }
            }
        }
    }

    /// Returns the right side of the normal equations, nm/mm^2, from the height differences along x and y, nm.
    fn divergence(&self, along_x: &Array2<f64>, along_y: &Array2<f64>) -> Array2<f64> {
        let mut sum = Array2::zeros(along_x.dim());
        self.for_each_edge(|a, b, axis| {
            let value = self.weight[axis] * if axis == 0 { along_x[a] } else { along_y[a] };
            sum[a] -= value;
            sum[b] += value;
        });
        sum
    }

    /// Returns the left side of the normal equations, nm/mm^2: the matrix times the heights `z`, nm.
    fn apply(&self, z: &Array2<f64>) -> Array2<f64> {
        let mut sum = Array2::zeros(z.dim());
        self.for_each_edge(|a, b, axis| {
            let value = self.weight[axis] * (z[b] - z[a]);
            sum[a] -= value;
            sum[b] += value;
        });
        sum
    }

    /// Applies the inverse of the Laplacian on the whole rectangle to a residual of the normal equations. The result is
    /// 0 at invalid pixels.
    fn precondition(&self, residual: &Array2<f64>) -> Array2<f64> {
        let (rows, columns) = residual.dim();
        let fold = |i: usize, n: usize| if i < n { i } else { 2 * n - 1 - i };
        let mirrored = Array2::from_shape_fn((2 * rows, 2 * columns), |(r, c)| {
            residual[[fold(r, rows), fold(c, columns)]]
        });
        let mut spectrum = transform::forward(mirrored.view());
        spectrum.zip_mut_with(&self.inverse, |f, inverse| *f *= *inverse);
        let solved = transform::inverse(spectrum);
        Array2::from_shape_fn(
            (rows, columns),
            |pixel| {
                if self.valid[pixel] { solved[pixel] } else { 0.0 }
            },
        )
    }

    /// Solves the normal equations with the right side `right` by preconditioned conjugate gradients. Returns the
    /// heights, nm, which are known up to a constant, and the number of steps, at most [`MOST_STEPS`].
    fn solve(&self, right: &Array2<f64>) -> (Array2<f64>, usize) {
        let mut z = Array2::zeros(right.dim());
        let mut residual = right.clone();
        let goal = TOLERANCE * dot(right, right).sqrt();
        let mut direction = self.precondition(&residual);
        let mut product = dot(&residual, &direction);
        for step in 0..MOST_STEPS {
            if dot(&residual, &residual).sqrt() <= goal || product <= 0.0 {
                return (z, step);
            }
            let image = self.apply(&direction);
            let length = product / dot(&direction, &image);
            z.scaled_add(length, &direction);
            residual.scaled_add(-length, &image);
            let next = self.precondition(&residual);
            let next_product = dot(&residual, &next);
            direction = next + &(direction * (next_product / product));
            product = next_product;
        }
        (z, MOST_STEPS)
    }

    /// Returns the RMS of the slopes that the heights `z` (nm) do not explain, urad: the residual of (1) of the module.
    /// `along_x` and `along_y` are the height differences, nm.
    fn residual_urad(&self, z: &Array2<f64>, along_x: &Array2<f64>, along_y: &Array2<f64>) -> f64 {
        let mut sum = 0.0;
        let mut count = 0usize;
        self.for_each_edge(|a, b, axis| {
            let difference = if axis == 0 { along_x[a] } else { along_y[a] };
            sum += self.weight[axis] * (z[b] - z[a] - difference).powi(2);
            count += 1;
        });
        // Both axes have about as many pairs; the slopes have two components per pixel.
        (2.0 * sum / count.max(1) as f64).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Axis;
    use std::f64::consts::PI;

    /// Returns the height in nm of `40 sin(a x + b y) cos(c y) + x y`, and its slopes along x and y in urad. They are
    /// not separable.
    fn field(x: f64, y: f64) -> [f64; 3] {
        let [a, b, c] = [2.0 * PI / 9.0, 0.3, 2.0 * PI / 7.0];
        let (sine, cosine) = (a * x + b * y).sin_cos();
        let (across, turned) = ((c * y).cos(), (c * y).sin());
        [
            40.0 * sine * across + x * y,
            40.0 * a * cosine * across + y,
            40.0 * (b * cosine * across - c * sine * turned) + x,
        ]
    }

    fn grid(n: usize) -> Grid {
        let step = 12.0 / n as f64;
        Grid {
            x: Axis::new(-6.0, step, n + 1).unwrap(),
            y: Axis::new(-4.0, 1.25 * step, n * 3 / 4 + 1).unwrap(),
        }
    }

    /// Integrates the slopes of [`field`] on a grid of `n` pixels, valid where `inside` is true. Returns the largest
    /// error of the heights, nm, and the number of steps.
    fn error(n: usize, inside: fn(f64, f64) -> bool) -> (f64, usize) {
        let g = grid(n);
        let maps = [0, 1, 2].map(|k| {
            Array2::from_shape_fn(g.shape(), |(r, c)| {
                let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
                if inside(x, y) { field(x, y)[k] } else { f64::NAN }
            })
        });
        let made = integrate(&maps[1], &maps[2], &g).unwrap();
        let differences: Vec<f64> = made
            .height_nm
            .iter()
            .zip(&maps[0])
            .filter(|(z, _)| !z.is_nan())
            .map(|(z, right)| z - right)
            .collect();
        let mean = differences.iter().sum::<f64>() / differences.len() as f64;
        let worst = differences.iter().fold(0.0_f64, |m, d| m.max((d - mean).abs()));
        (worst, made.steps)
    }

    #[test]
    fn the_error_falls_with_the_fourth_power_of_the_pitch() {
        let whole = |_: f64, _: f64| true;
        // A disc with a hole and a slit.
        let ring = |x: f64, y: f64| {
            let r = x.hypot(y - 0.5);
            (1.0..4.3).contains(&r) && !(x.abs() < 0.4 && y < 0.0)
        };
        for inside in [whole as fn(f64, f64) -> bool, ring] {
            let errors: Vec<(f64, usize)> = [48, 96, 192].map(|n| error(n, inside)).to_vec();
            let order = (errors[0].0 / errors[2].0).log2() / 2.0;
            // At the edge of a mask are runs of two pixels, whose trapezoids miss h^3 each.
            let is_whole = inside(0.0, 0.5);
            assert!(order > if is_whole { 3.8 } else { 3.0 }, "{order} {errors:?}");
            // Waves of 7 mm at 0.06 mm: (2 pi 0.06 / 7)^4 of 40 nm.
            assert!(errors[2].0 < 1e-3, "{errors:?}");
            // The number of steps does not grow with that of the pixels.
            assert!(errors[2].1 <= errors[0].1 + 5 && errors[2].1 < 60, "{errors:?}");
        }
        // Without a mask the first step is the solution; the second finds nothing above rounding.
        assert!(error(96, whole).1 <= 3);
    }

    #[test]
    fn a_cubic_is_integrated_exactly() {
        let g = grid(16);
        let z = |x: f64, y: f64| 2.0 * x * x * x - x * y * y + 3.0 * x * y - 5.0 * y;
        let sx = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
            6.0 * x * x - y * y + 3.0 * y
        });
        let sy = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
            -2.0 * x * y + 3.0 * x - 5.0
        });
        let made = integrate(&sx, &sy, &g).unwrap();
        let at = |r: usize, c: usize| {
            made.height_nm[[r, c]] - z(g.x.coordinate_mm(c), g.y.coordinate_mm(r))
        };
        for ((r, c), _) in made.height_nm.indexed_iter() {
            // Rounding of heights of 500 nm, times the condition of the Laplacian of 16 pixels.
            assert!((at(r, c) - at(0, 0)).abs() < 1e-8, "{r} {c}");
        }
        assert!(made.residual_urad < 1e-9, "{}", made.residual_urad);
    }

    #[test]
    fn the_sign_along_y_is_judged_and_islands_are_left_out() {
        let g = grid(48);
        let map = |k: usize, sign: f64| {
            let values = Array2::from_shape_fn(g.shape(), |(r, c)| {
                sign * field(g.x.coordinate_mm(c), g.y.coordinate_mm(r))[k]
            });
            let mut reading = Reading::of_map(&g, &values);
            (reading.unit, reading.unit_word) = (None, Some("urad".into()));
            reading
        };
        let settings = SlopeSettings {
            unit: None,
            negate_x: false,
            negate_y: false,
            trust_signs: false,
            map: ReadingSettings::default(),
        };
        let (right, report) = slopes(map(1, 1.0), map(2, 1.0), &settings).unwrap();
        assert!(report.warnings.is_empty(), "{:?}", report.warnings);
        let message = slopes(map(1, 1.0), map(2, -1.0), &settings).unwrap_err().to_string();
        assert!(
            message.contains("with the other sign along y") && message.contains("negate_y"),
            "{message}"
        );
        let negated = SlopeSettings { negate_y: true, ..settings.clone() };
        let (again, _) = slopes(map(1, 1.0), map(2, -1.0), &negated).unwrap();
        assert_eq!(again.height_nm(), right.height_nm());
        // In mrad, stated by the user.
        let mut in_mrad = [1, 2].map(|k| map(k, 1e-3));
        in_mrad.iter_mut().for_each(|reading| reading.unit_word = None);
        let [x, y] = in_mrad;
        let message = slopes(x.clone(), y.clone(), &settings).unwrap_err().to_string();
        assert!(message.contains("give `unit` urad"), "{message}");
        let given = SlopeSettings { unit: Some("mrad".parse().unwrap()), ..settings.clone() };
        let (scaled, _) = slopes(x, y, &given).unwrap();
        // Rounding of a factor.
        assert!(
            scaled.height_nm().iter().zip(right.height_nm()).all(|(a, b)| (a - b).abs() < 1e-9)
        );
        let message = slopes(map(1, 1.0), map(2, 1.0), &given).unwrap_err().to_string();
        assert!(message.contains("is urad in the file, mrad was asked for"), "{message}");
        // An island of four pixels beyond a wall.
        let mut x = map(1, 1.0);
        x.values.slice_mut(s![.., 3]).fill(f64::NAN);
        x.values.slice_mut(s![4.., ..3]).fill(f64::NAN);
        let (cut, report) = slopes(x, map(2, 1.0), &settings).unwrap();
        assert_eq!((report.unconnected_pixels, cut.statistics().valid_count), (12, 37 * 45));
        assert!(report.warnings[0].contains("12 valid pixels are not connected"));
    }

    #[test]
    fn units_of_slopes() {
        for (text, urad) in [
            ("urad", 1.0),
            ("µrad", 1.0),
            ("mrad", 1e3),
            ("arcsec", PI / 0.648),
            ("nm/mm", 1.0),
            ("um/mm", 1e3),
            ("1", 1e6),
        ] {
            let unit: SlopeUnit = text.parse().unwrap();
            // The tangent of 1 mrad is 3e-7 of it more; quotients of powers of ten.
            assert!((unit.urad(1e-3) / (1e-3 * urad) - 1.0).abs() < 1e-9, "{text}");
        }
        assert!("nm".parse::<SlopeUnit>().is_err() && "furlong".parse::<SlopeUnit>().is_err());
    }
}
