//! The best shape of a mirror: plane, cylinder, sphere or elliptical cylinder by least squares.
//!
//! ```text
//! plane        z = c0 + bx x + by y
//! cylinder-x   z = c0 + by y + w(x),      w - A (x^2 + w^2) = bx x         (curved along x)
//! cylinder-y   the same with x and y exchanged
//! sphere       z = c0 + w(x, y),          w - A (x^2 + y^2 + w^2) = bx x + by y
//! ellipse      z = c0 + by y + bx x + e(x - x0)                            (`ellipse.rs`)
//! w = 2 g / (1 + sqrt(1 - 4 A g)),   g = bx x + by y + A (x^2 + y^2)
//! ```
//!
//! Circle and sphere are exact, not parabolas: at 50 mm from the middle of a sphere of 10 m the difference is
//! 0.8 nm. x and y count from the middle of the valid pixels. Radius 1 / (2 A) times sqrt(1 + bx^2 + by^2),
//! positive where the mirror is concave (ends above the middle).
//!
//! What depends on x alone but for a tilt along y is fitted to the columns: the squares of a column are those of
//! its mean, with the weight of its pixels, and those of the deviations from it, which only the tilt can lessen.
//! So an ellipse on a million pixels is a problem of some thousand rows. The columns of its Jacobian are nearly
//! parallel (p, q and theta differ in the third and fourth order only), so it is solved by Levenberg and Marquardt's
//! steps with a QR decomposition, and where all three are fitted they move along
//!
//! ```text
//! ln(sin theta (1/p + 1/q)),   k = (1/q - 1/p) / (1/p + 1/q) from -1 to 1,   ln(1/p + 1/q)
//! ```
//!
//! the curvature, the lopsidedness, and what is left: along p, q and theta themselves the valley of equal curvature is
//! bent, and noise has p wander to infinity and beyond.
//!
//! The elements of a profile are fitted alike; measured slopes by the derivatives of these shapes.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `height_mm` | (ny, nx) | mm |
//! | c0, bx, by, A | `parameter` | | mm, rad, rad, 1/mm |

use nalgebra::{DMatrix, DVector, Matrix4, Vector4};
use ndarray::Array2;
use planish_numerics::statistics::{Plane, fit_plane};
use planish_types::Invalid;
use serde::{Deserialize, Serialize};

use crate::ellipse::Ellipse;

/// nm in a mm.
const NM_PER_MM: f64 = 1e6;

/// Steps of a fit, accepted or not: an ellipse takes twenty, a bad guess with noise up to a hundred.
const MAX_STEPS: usize = 400;

/// Damping of the first step, of Jacobian columns of length 1; a tenth of it after a step that lessens the squares,
/// ten times as much, and at least [`LEAST_DAMPING`], after one that does not.
const FIRST_DAMPING: f64 = 1e-3;
const LEAST_DAMPING: f64 = 1e-10;

/// Damping above which no step lessens the squares: it goes less than 1e-8 down the gradient.
const LAST_DAMPING: f64 = 1e8;

/// A step that lessens the squares by less than this fraction is the last.
const LAST_GAIN: f64 = 1e-12;

/// A step of this fraction of the parameters is the last: their rounding in ill-conditioned fits.
const LAST_STEP: f64 = 1e-13;

/// The distances and the angle of an ellipse are looked for within this factor, e^3 = 20, of the given ones.
const LARGEST_LOGARITHM: f64 = 3.0;

/// Step of the differences by the parameters of an ellipse: extrapolated, they are off by its fourth power, 1e-12,
/// and by rounding, 1e-13.
const DIFFERENCE: f64 = 1e-3;

/// A column of the Jacobian of which the others leave less than this fraction is not determined: with
/// heights in double precision nothing but rounding would decide it.
const INDEPENDENT: f64 = 1e-11;

/// The shape that is taken off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "kebab-case")]
pub enum Shape {
    /// The mean.
    Piston,
    /// The least-squares plane; of a profile the line.
    Plane,
    /// A circular cylinder that is curved along x, and a tilt; of a profile the circle.
    CylinderX,
    /// A circular cylinder that is curved along y, and a tilt; not of a profile.
    CylinderY,
    /// A sphere, and a tilt; of a profile the circle.
    Sphere,
    /// The elliptical cylinder of `ellipse`, and a tilt.
    Ellipse,
}

impl Shape {
    /// As flags and files name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Piston => "piston",
            Self::Plane => "plane",
            Self::CylinderX => "cylinder-x",
            Self::CylinderY => "cylinder-y",
            Self::Sphere => "sphere",
            Self::Ellipse => "ellipse",
        }
    }
}

/// A parameter of an ellipse.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "kebab-case")]
pub enum EllipseParameter {
    /// Source to pole.
    P,
    /// Pole to image.
    Q,
    /// Grazing angle.
    Theta,
}

/// The ellipse that a mirror shall be.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EllipseSettings {
    /// As designed; the first guess of what is fitted.
    pub design: Ellipse,
    /// What is fitted beside piston and tilt.
    pub free: Vec<EllipseParameter>,
    /// Where the pole is, mm; `None` for the middle of the valid pixels.
    pub pole_mm: Option<f64>,
}

/// What a fit found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ShapeReport {
    /// Which shape.
    pub shape: Shape,
    /// Slope of the shape at the middle along x and y, urad.
    pub tilt_urad: [f64; 2],
    /// Radius of curvature, m; positive is concave; `null` of a plane, and of what is not curved.
    pub radius_m: Option<f64>,
    /// The ellipse, with the parameters that were fitted.
    pub ellipse: Option<EllipseReport>,
}

/// An ellipse as the field states it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EllipseReport {
    /// Source to pole, mm; `null` for infinity, a parabola.
    pub p_mm: f64,
    /// Pole to image, mm; `null` for infinity, a parabola.
    pub q_mm: f64,
    /// Grazing angle, mrad.
    pub theta_mrad: f64,
    /// Where the pole is, mm.
    pub pole_mm: f64,
    /// What was fitted.
    pub fitted: Vec<EllipseParameter>,
    /// Standard errors of p, q and theta, relative, as if the residual were white; 0 where given, `null` where infinite.
    pub standard_error: [f64; 3],
}

/// Heights at points; NaN marks an invalid one.
pub(crate) struct Heights<'a> {
    /// (nx), mm, ascending.
    pub x_mm: &'a [f64],
    /// (ny), mm, ascending.
    pub y_mm: &'a [f64],
    /// (ny, nx), nm.
    pub height_nm: &'a Array2<f64>,
}

/// `heights` minus the best `shape`.
pub(crate) fn without_shape(
    heights: &Heights,
    shape: Shape,
    ellipse: Option<&EllipseSettings>,
) -> Result<(Array2<f64>, ShapeReport), Invalid> {
    let of_lines = |report: ShapeReport, value: &dyn Fn(f64, f64) -> f64| {
        let mut left = heights.height_nm.clone();
        for ((r, c), v) in left.indexed_iter_mut() {
            *v -= NM_PER_MM * value(heights.x_mm[c], heights.y_mm[r]);
        }
        (left, report)
    };
    let flat = |plane: Plane| ShapeReport {
        shape,
        // nm/mm is urad.
        tilt_urad: [plane.b, plane.c],
        radius_m: None,
        ellipse: None,
    };
    let is_line = heights.y_mm.len() == 1;
    match shape {
        Shape::Piston => {
            let valid = heights.height_nm.iter().filter(|v| !v.is_nan());
            let (n, sum) = valid.fold((0.0, 0.0), |(n, sum), v| (n + 1.0, sum + v));
            let plane = Plane { a: sum / n, b: 0.0, c: 0.0 };
            Ok((heights.height_nm - plane.a, flat(plane)))
        }
        Shape::Plane if !is_line => {
            let (x, y) = (heights.x_mm, heights.y_mm);
            let plane = fit_plane(heights.height_nm.view(), x, y)
                .ok_or_else(|| too_few(shape, "all on one line"))?;
            let nm = |x: f64, y: f64| (plane.a + plane.b * x + plane.c * y) / NM_PER_MM;
            Ok(of_lines(flat(plane), &nm))
        }
        Shape::Sphere if !is_line => {
            let sphere = Sphere::of(heights)?;
            Ok(of_lines(sphere.report(), &|x, y| sphere.height_mm(x, y)))
        }
        Shape::CylinderY if is_line => {
            let remedy = "a profile has no y: take `cylinder-x`, or measure a map";
            Err(Invalid::whole("shape", "cylinder-y is of a profile", remedy))
        }
        Shape::CylinderY => {
            let turned = heights.height_nm.t().to_owned();
            let turned = Heights { x_mm: heights.y_mm, y_mm: heights.x_mm, height_nm: &turned };
            let (left, report) = without_shape(&turned, Shape::CylinderX, None)?;
            let [along, across] = report.tilt_urad;
            let report = ShapeReport { shape, tilt_urad: [across, along], ..report };
            Ok((left.t().as_standard_layout().into_owned(), report))
        }
        Shape::Plane | Shape::CylinderX | Shape::Sphere | Shape::Ellipse => {
            let columns = Columns::of(heights);
            let curve = Curve::new(shape, ellipse, &columns.x_mm)?;
            let fitted = curve.fitted(&columns, shape)?;
            Ok(of_lines(fitted.report(shape), &|x, y| fitted.height_mm(x, y)))
        }
    }
}

/// `slope_nrad` at `x_mm` minus the slope of the best `shape`; NaN marks an invalid element.
pub(crate) fn without_shape_of_slopes(
    x_mm: &[f64],
    slope_nrad: &[f64],
    shape: Shape,
    ellipse: Option<&EllipseSettings>,
) -> Result<(Vec<f64>, ShapeReport), Invalid> {
    const NRAD: f64 = 1e-9;
    if shape == Shape::CylinderY {
        let remedy = "a profile has no y: take `cylinder-x`, or measure a map";
        return Err(Invalid::whole("shape", "cylinder-y is of a profile", remedy));
    }
    let valid = x_mm.iter().zip(slope_nrad).filter(|(_, s)| !s.is_nan());
    let (x, slope): (Vec<f64>, Vec<f64>) = valid.map(|(x, s)| (*x, NRAD * s)).unzip();
    if shape == Shape::Piston {
        // A piston has no slope.
        let curve = Curve::new(Shape::Plane, None, &x)?;
        return Ok((slope_nrad.to_vec(), curve.report(Shape::Piston)));
    }
    let curve = Curve::new(shape, ellipse, &x)?;
    let columns = Columns { x_mm: x, mean_mm: slope, ..Columns::default() };
    let fitted = curve.fitted(&columns, shape)?;
    let left = x_mm.iter().zip(slope_nrad).map(|(x, s)| s - fitted.slope(*x) / NRAD);
    Ok((left.collect(), fitted.report(shape)))
}

fn too_few(shape: Shape, how: &str) -> Invalid {
    Invalid::whole(
        "shape",
        format!("the valid points do not define the shape {} ({how})", shape.name()),
        "give more of them, or a simpler shape",
    )
}

/// The columns of a map, or the points of a profile.
#[derive(Default)]
struct Columns {
    x_mm: Vec<f64>,
    /// Mean height, mm; or slope, rad.
    mean_mm: Vec<f64>,
    /// Roots of the numbers of pixels; empty for slopes, which have weight 1.
    weight: Vec<f64>,
    /// Mean y, mm; empty for slopes.
    y_mm: Vec<f64>,
    /// Middle of y, mm.
    y_middle_mm: f64,
    /// Root of the sum of (y - mean y)^2 within the columns, mm, and the sum of (y - mean y)(z - mean z) over it.
    within: Option<[f64; 2]>,
}

impl Columns {
    fn of(heights: &Heights) -> Self {
        let y = heights.y_mm;
        let mut columns = Self { y_middle_mm: 0.5 * (y[0] + y[y.len() - 1]), ..Self::default() };
        let (mut yy, mut yz) = (0.0, 0.0);
        for (c, column) in heights.height_nm.columns().into_iter().enumerate() {
            let valid = || column.iter().zip(y).filter(|(z, _)| !z.is_nan());
            let (mut n, mut z_sum, mut y_sum) = (0.0, 0.0, 0.0);
            for (z, y) in valid() {
                n += 1.0;
                z_sum += z;
                y_sum += y - columns.y_middle_mm;
            }
            if n == 0.0 {
                continue;
            }
            let (z_mean, y_mean) = (z_sum / n, y_sum / n);
            for (z, y) in valid() {
                let y = y - columns.y_middle_mm - y_mean;
                yy += y * y;
                yz += y * (z - z_mean);
            }
            columns.x_mm.push(heights.x_mm[c]);
            columns.mean_mm.push(z_mean / NM_PER_MM);
            columns.weight.push(f64::sqrt(n));
            columns.y_mm.push(y_mean);
        }
        if y.len() > 1 {
            columns.within = (yy > 0.0).then(|| [yy.sqrt(), yz / yy.sqrt() / NM_PER_MM]);
        }
        columns
    }

    fn of_heights(&self) -> bool {
        !self.weight.is_empty()
    }

    /// Whether a tilt along y can be told.
    fn has_y(&self) -> bool {
        self.within.is_some()
    }
}

/// A curve of x, with a tilt along y.
#[derive(Clone, Debug)]
struct Curve {
    /// c0, mm.
    piston_mm: f64,
    /// bx and by, rad.
    tilt: [f64; 2],
    /// A, 1/mm; of an ellipse 0.
    curvature_per_mm: f64,
    /// The ellipse, and how far it was moved from the given one.
    ellipse: Option<(EllipseSettings, Vec<f64>)>,
    /// Whether A is fitted.
    curved: bool,
    /// Where x and y count from, mm.
    middle_mm: [f64; 2],
    standard_error: [f64; 3],
}

impl Curve {
    fn new(shape: Shape, ellipse: Option<&EllipseSettings>, x_mm: &[f64]) -> Result<Self, Invalid> {
        let (Some(first), Some(last)) = (x_mm.first(), x_mm.last()) else {
            return Err(too_few(shape, "there are none"));
        };
        let ellipse = match (shape, ellipse) {
            (Shape::Ellipse, Some(settings)) => {
                let mut settings = settings.clone();
                settings.free.sort_by_key(|parameter| *parameter as usize);
                settings.free.dedup();
                let moved = vec![0.0; settings.free.len()];
                Some((settings, moved))
            }
            (Shape::Ellipse, None) => {
                let remedy = "give `ellipse`: p and q in mm, theta in mrad";
                return Err(Invalid::whole("ellipse", "is not known", remedy));
            }
            _ => None,
        };
        let middle_mm = 0.5 * (first + last);
        let pole_mm = ellipse.as_ref().and_then(|(s, _)| s.pole_mm).unwrap_or(middle_mm);
        Ok(Self {
            piston_mm: 0.0,
            tilt: [0.0; 2],
            curvature_per_mm: 0.0,
            curved: matches!(shape, Shape::CylinderX | Shape::Sphere),
            ellipse,
            middle_mm: [pole_mm, 0.0],
            standard_error: [0.0; 3],
        })
    }

    /// w and its derivatives by bx and A, over the middle.
    fn circle(&self, u: f64) -> [f64; 3] {
        let (a, g) = (self.curvature_per_mm, self.tilt[0] * u + self.curvature_per_mm * u * u);
        let w = 2.0 * g / (1.0 + (1.0 - 4.0 * a * g).sqrt());
        let steep = 1.0 - 2.0 * a * w;
        [w, u / steep, (u * u + w * w) / steep]
    }

    fn height_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        let u = x_mm - self.middle_mm[0];
        let curve = match &self.ellipse {
            Some((settings, moved)) => ellipse_at(settings, moved).height_mm(u) + self.tilt[0] * u,
            None => self.circle(u)[0],
        };
        self.piston_mm + self.tilt[1] * (y_mm - self.middle_mm[1]) + curve
    }

    fn slope(&self, x_mm: f64) -> f64 {
        let u = x_mm - self.middle_mm[0];
        match &self.ellipse {
            Some((settings, moved)) => ellipse_at(settings, moved).slope(u) + self.tilt[0],
            // w' (1 - 2 A w) = bx + 2 A x
            None => {
                let [w, ..] = self.circle(u);
                let a = self.curvature_per_mm;
                (self.tilt[0] + 2.0 * a * u) / (1.0 - 2.0 * a * w)
            }
        }
    }

    /// Derivatives by the parameters that are fitted, in the order of [`Self::moved`].
    fn derivatives(&self, x_mm: f64, y_mm: f64, columns: &Columns) -> Vec<f64> {
        let u = x_mm - self.middle_mm[0];
        let mut row = Vec::with_capacity(6);
        let heights = columns.of_heights();
        if heights {
            row.push(1.0);
        }
        if columns.has_y() {
            row.push(y_mm);
        }
        match &self.ellipse {
            Some((settings, moved)) => {
                row.push(if heights { u } else { 1.0 });
                let value = |ellipse: Ellipse| match heights {
                    true => ellipse.height_mm(u),
                    false => ellipse.slope(u),
                };
                row.extend((0..moved.len()).map(|k| by_coordinate(settings, moved, k, value)));
            }
            None => {
                let [w, by_tilt, by_curvature] = self.circle(u);
                if heights {
                    row.push(by_tilt);
                    row.extend(self.curved.then_some(by_curvature));
                } else {
                    // d/dx of the two; what is left out is of the order of the squared slope.
                    let steep = 1.0 - 2.0 * self.curvature_per_mm * w;
                    row.push(1.0 / steep);
                    row.extend(self.curved.then_some(2.0 * u / steep));
                }
            }
        }
        row
    }

    /// The curve with its parameters moved by `step`.
    fn moved(&self, step: &[f64], columns: &Columns) -> Self {
        let mut curve = self.clone();
        let mut step = step.iter();
        let mut next = || step.next().copied().unwrap_or(0.0);
        if columns.of_heights() {
            curve.piston_mm += next();
        }
        if columns.has_y() {
            curve.tilt[1] += next();
        }
        curve.tilt[0] += next();
        if curve.curved {
            curve.curvature_per_mm += next();
        }
        if let Some((_, moved)) = &mut curve.ellipse {
            moved.iter_mut().for_each(|v| *v += next());
        }
        curve
    }

    /// How far the last parameters, those of the ellipse, may still move.
    fn room(&self) -> Vec<[f64; 2]> {
        let Some((settings, moved)) = &self.ellipse else { return Vec::new() };
        let k = lopsidedness(&settings.design);
        let whole = |i: usize| match (moved.len(), i) {
            (3, 1) => [-1.0 - k, 1.0 - k],
            _ => [-LARGEST_LOGARITHM, LARGEST_LOGARITHM],
        };
        moved.iter().enumerate().map(|(i, v)| whole(i).map(|end| end - v)).collect()
    }

    /// What is left of the columns, weighted, and of the deviations from them.
    fn left(&self, columns: &Columns) -> DVector<f64> {
        let n = columns.x_mm.len();
        let mut left = DVector::zeros(n + usize::from(columns.has_y()));
        for i in 0..n {
            let x = columns.x_mm[i];
            left[i] = match columns.of_heights() {
                true => {
                    let y = columns.y_mm[i] + self.middle_mm[1];
                    columns.weight[i] * (columns.mean_mm[i] - self.height_mm(x, y))
                }
                false => columns.mean_mm[i] - self.slope(x),
            };
        }
        if let Some([spread, rise]) = columns.within {
            left[n] = rise - self.tilt[1] * spread;
        }
        left
    }

    fn jacobian(&self, columns: &Columns) -> DMatrix<f64> {
        let n = columns.x_mm.len();
        let rows: Vec<Vec<f64>> = (0..n)
            .map(|i| {
                let weight = columns.weight.get(i).copied().unwrap_or(1.0);
                let y = columns.y_mm.get(i).copied().unwrap_or(0.0);
                let row = self.derivatives(columns.x_mm[i], y, columns);
                row.into_iter().map(|v| weight * v).collect()
            })
            .collect();
        let count = rows.first().map_or(0, Vec::len);
        DMatrix::from_fn(n + usize::from(columns.has_y()), count, |i, k| match columns.within {
            Some([spread, _]) if i == n => {
                if k == 1 {
                    spread
                } else {
                    0.0
                }
            }
            _ => rows[i][k],
        })
    }

    /// The curve of least squares: Levenberg and Marquardt's steps within the bounds of the ellipse.
    fn fitted(mut self, columns: &Columns, shape: Shape) -> Result<Self, Invalid> {
        self.middle_mm[1] = columns.y_middle_mm;
        let mut left = self.left(columns);
        let mut damping = FIRST_DAMPING;
        let mut jacobian = self.scaled_jacobian(columns, shape)?;
        if !left.norm().is_finite() {
            let how = "they lie beyond the ends of the ellipse";
            return Err(too_few(shape, how));
        }
        if jacobian.0.nrows() < jacobian.0.ncols() {
            let how = format!("{} for {} unknowns", jacobian.0.nrows(), jacobian.0.ncols());
            return Err(too_few(shape, &how));
        }
        for _ in 0..MAX_STEPS {
            let (matrix, scale) = &jacobian;
            let unknowns = matrix.ncols();
            // A parameter at a bound that would go beyond it rests.
            let gradient = matrix.tr_mul(&left);
            let room = self.room();
            let first = unknowns - room.len();
            let rests = |k: usize| {
                k >= first && {
                    let [low, high] = room[k - first];
                    low >= 0.0 && gradient[k] < 0.0 || high <= 0.0 && gradient[k] > 0.0
                }
            };
            let moving: Vec<usize> = (0..unknowns).filter(|k| !rests(*k)).collect();
            // [J; sqrt(damping) I] step = [left; 0]
            let (n, m) = (matrix.nrows(), moving.len());
            let damped = DMatrix::from_fn(n + m, m, |i, k| match i.checked_sub(n) {
                None => matrix[(i, moving[k])],
                Some(row) => f64::from(u8::from(row == k)) * damping.sqrt(),
            });
            let mut right = DVector::zeros(n + m);
            right.rows_mut(0, n).copy_from(&left);
            let qr = damped.qr();
            qr.q_tr_mul(&mut right);
            let right = right.rows(0, m).into_owned();
            let solved = qr.r().solve_upper_triangular(&right).unwrap_or_else(|| DVector::zeros(m));
            let small = solved.norm() <= LAST_STEP * self.size(columns);
            let mut step = vec![0.0; unknowns];
            for (k, v) in moving.iter().zip(&solved) {
                step[*k] = v / scale[*k];
                if *k >= first {
                    let [low, high] = room[*k - first];
                    step[*k] = step[*k].clamp(low.min(0.0), high.max(0.0));
                }
            }
            let curve = self.moved(&step, columns);
            let then = curve.left(columns);
            if then.norm() < left.norm() {
                let gains = left.norm_squared() - then.norm_squared();
                let ended = small || gains <= LAST_GAIN * left.norm_squared();
                (self, left) = (curve, then);
                damping *= 0.1;
                jacobian = self.scaled_jacobian(columns, shape)?;
                if ended {
                    break;
                }
            } else if small || damping > LAST_DAMPING {
                break;
            } else {
                damping = 10.0 * damping.max(LEAST_DAMPING);
            }
        }
        let (matrix, scale) = jacobian;
        let r = matrix.qr().r();
        if (0..r.ncols()).any(|k| r[(k, k)].abs() < INDEPENDENT) {
            let problem = format!(
                "the points do not tell the parameters of the shape {} apart",
                shape.name()
            );
            let remedy = match shape {
                Shape::Ellipse => "fit fewer of p, q and theta",
                _ => "give points along more of x and y",
            };
            return Err(Invalid::whole("shape", problem, remedy));
        }
        self.standard_error = self.errors(&r, &scale, &left);
        Ok(self)
    }

    /// The Jacobian with columns of length 1, and their lengths.
    fn scaled_jacobian(
        &self,
        columns: &Columns,
        shape: Shape,
    ) -> Result<(DMatrix<f64>, Vec<f64>), Invalid> {
        let mut jacobian = self.jacobian(columns);
        let scale: Vec<f64> = jacobian.column_iter().map(|c| c.norm()).collect();
        if !scale.iter().all(|s| s.is_finite() && *s > 0.0) {
            let how = "they lie beyond the ends of the ellipse, or in one place";
            return Err(too_few(shape, how));
        }
        jacobian.column_iter_mut().zip(&scale).for_each(|(mut c, s)| c /= *s);
        Ok((jacobian, scale))
    }

    /// Norm of the heights, or slopes, that are fitted.
    fn size(&self, columns: &Columns) -> f64 {
        let weighted = columns.mean_mm.iter().enumerate();
        let squares = weighted.map(|(i, v)| (v * columns.weight.get(i).unwrap_or(&1.0)).powi(2));
        squares.sum::<f64>().sqrt()
    }

    /// Relative standard errors of p, q, theta: those of G C G' with C = s^2 (J' J)^-1 of what was fitted, s^2 =
    /// |left|^2 / (rows - unknowns), and G the derivatives of their logarithms by it.
    fn errors(&self, r: &DMatrix<f64>, scale: &[f64], left: &DVector<f64>) -> [f64; 3] {
        let Some((settings, moved)) = &self.ellipse else { return [0.0; 3] };
        let unknowns = r.ncols();
        let spare = left.len().saturating_sub(unknowns).max(1) as f64;
        let Some(inverse) = r.clone().try_inverse() else { return [0.0; 3] };
        let first = unknowns - moved.len();
        [0, 1, 2].map(|parameter| {
            let logarithm = |ellipse: Ellipse| {
                [ellipse.p_mm, ellipse.q_mm, ellipse.theta_rad][parameter].abs().ln()
            };
            let mut row = DVector::zeros(unknowns);
            for k in 0..moved.len() {
                row[first + k] = by_coordinate(settings, moved, k, logarithm) / scale[first + k];
            }
            let error = inverse.tr_mul(&row).norm() * left.norm() / spare.sqrt();
            if error.is_nan() { f64::INFINITY } else { error }
        })
    }

    fn report(&self, shape: Shape) -> ShapeReport {
        let [bx, by] = self.tilt;
        // A / sqrt(1 + bx^2 + ...) is half the curvature; a profile has no by.
        let radius = (1.0 + bx * bx).sqrt() / (2.0 * self.curvature_per_mm);
        ShapeReport {
            shape,
            tilt_urad: [1e6 * bx, 1e6 * by],
            radius_m: (self.curved && radius.is_finite()).then_some(1e-3 * radius),
            ellipse: self.ellipse.as_ref().map(|(settings, moved)| {
                let ellipse = ellipse_at(settings, moved);
                EllipseReport {
                    p_mm: ellipse.p_mm,
                    q_mm: ellipse.q_mm,
                    theta_mrad: 1e3 * ellipse.theta_rad,
                    pole_mm: self.middle_mm[0],
                    fitted: settings.free.clone(),
                    standard_error: self.standard_error,
                }
            }),
        }
    }
}

/// k = (1/q - 1/p) / (1/p + 1/q)
fn lopsidedness(ellipse: &Ellipse) -> f64 {
    let (u, v) = (1.0 / ellipse.p_mm, 1.0 / ellipse.q_mm);
    (v - u) / (u + v)
}

/// The ellipse that is `moved` from the given one: see the module where all three parameters are free, else along
/// the logarithms of those that are.
fn ellipse_at(settings: &EllipseSettings, moved: &[f64]) -> Ellipse {
    let mut ellipse = settings.design;
    if let [curvature, lopsided, rest] = moved {
        let sum = 1.0 / ellipse.p_mm + 1.0 / ellipse.q_mm;
        let k = lopsidedness(&ellipse) + lopsided;
        let sum_then = sum * rest.exp();
        let sine = ellipse.theta_rad.sin() * (curvature - rest).exp();
        // Beyond a right angle there is no mirror: NaN, which lessens no squares.
        return Ellipse {
            p_mm: 2.0 / (sum_then * (1.0 - k)),
            q_mm: 2.0 / (sum_then * (1.0 + k)),
            theta_rad: sine.asin(),
        };
    }
    for (parameter, by) in settings.free.iter().zip(moved) {
        let value = match parameter {
            EllipseParameter::P => &mut ellipse.p_mm,
            EllipseParameter::Q => &mut ellipse.q_mm,
            EllipseParameter::Theta => &mut ellipse.theta_rad,
        };
        *value *= by.exp();
    }
    ellipse
}

/// Derivative of a value of the ellipse by one of what is moved.
fn by_coordinate(
    settings: &EllipseSettings,
    moved: &[f64],
    k: usize,
    value: impl Fn(Ellipse) -> f64,
) -> f64 {
    let at = |step: f64| {
        let mut moved = moved.to_vec();
        moved[k] += step;
        value(ellipse_at(settings, &moved))
    };
    let difference = |step: f64| (at(step) - at(-step)) / (2.0 * step);
    (4.0 * difference(DIFFERENCE) - difference(2.0 * DIFFERENCE)) / 3.0
}

/// A sphere over a map.
struct Sphere {
    /// c0 mm, bx, by rad, A 1/mm.
    parameter: [f64; 4],
    middle_mm: [f64; 2],
}

impl Sphere {
    /// Gauss and Newton's steps with the normal equations of four well-told unknowns.
    fn of(heights: &Heights) -> Result<Self, Invalid> {
        let (x, y) = (heights.x_mm, heights.y_mm);
        let middle_mm = [0.5 * (x[0] + x[x.len() - 1]), 0.5 * (y[0] + y[y.len() - 1])];
        let half = (x[x.len() - 1] - x[0]).hypot(y[y.len() - 1] - y[0]) / 2.0;
        let scale = [1.0, half, half, half * half];
        let mut sphere = Self { parameter: [0.0; 4], middle_mm };
        let mut before = f64::INFINITY;
        for _ in 0..MAX_STEPS {
            let (mut normal, mut right) = (Matrix4::<f64>::zeros(), Vector4::<f64>::zeros());
            let mut squares = 0.0;
            for ((r, c), z) in heights.height_nm.indexed_iter().filter(|(_, z)| !z.is_nan()) {
                let [value, row @ ..] = sphere.with_derivatives(x[c], y[r]);
                let left = z / NM_PER_MM - value;
                squares += left * left;
                for i in 0..4 {
                    right[i] += row[i] / scale[i] * left;
                    for k in 0..4 {
                        normal[(i, k)] += row[i] / scale[i] * row[k] / scale[k];
                    }
                }
            }
            if squares.is_nan() {
                return Err(too_few(Shape::Sphere, "the heights are steeper than any"));
            }
            if squares >= before {
                return Ok(sphere);
            }
            before = squares;
            let condition = normal.symmetric_eigenvalues();
            if condition.min() <= 1e-12 * condition.max() {
                return Err(too_few(Shape::Sphere, "they lie on one or two lines"));
            }
            let step = normal.lu().solve(&right).expect("its eigenvalues are not zero");
            let (mut moved, mut size) = (0.0_f64, 0.0_f64);
            for i in 0..4 {
                sphere.parameter[i] += step[i] / scale[i];
                moved = moved.max(step[i].abs());
                size = size.max((sphere.parameter[i] * scale[i]).abs());
            }
            if moved <= LAST_STEP * size {
                return Ok(sphere);
            }
        }
        Ok(sphere)
    }

    /// z, and its derivatives by c0, bx, by and A.
    fn with_derivatives(&self, x_mm: f64, y_mm: f64) -> [f64; 5] {
        let [c0, bx, by, a] = self.parameter;
        let (u, v) = (x_mm - self.middle_mm[0], y_mm - self.middle_mm[1]);
        let g = bx * u + by * v + a * (u * u + v * v);
        let w = 2.0 * g / (1.0 + (1.0 - 4.0 * a * g).sqrt());
        let steep = 1.0 - 2.0 * a * w;
        [c0 + w, 1.0, u / steep, v / steep, (u * u + v * v + w * w) / steep]
    }

    fn height_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        self.with_derivatives(x_mm, y_mm)[0]
    }

    fn report(&self) -> ShapeReport {
        let [_, bx, by, a] = self.parameter;
        let radius_m = 1e-3 * (1.0 + bx * bx + by * by).sqrt() / (2.0 * a);
        ShapeReport {
            shape: Shape::Sphere,
            tilt_urad: [1e6 * bx, 1e6 * by],
            radius_m: radius_m.is_finite().then_some(radius_m),
            ellipse: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn coordinates(from: f64, step: f64, n: u32) -> Vec<f64> {
        (0..n).map(|i| from + step * f64::from(i)).collect()
    }

    fn map(x: &[f64], y: &[f64], mm: impl Fn(f64, f64) -> f64) -> Array2<f64> {
        Array2::from_shape_fn((y.len(), x.len()), |(r, c)| NM_PER_MM * mm(x[c], y[r]))
    }

    fn largest(map: &Array2<f64>) -> f64 {
        map.iter().filter(|v| !v.is_nan()).fold(0.0, |m, v| m.max(v.abs()))
    }

    fn design(p: f64, q: f64, theta: f64, free: &[EllipseParameter]) -> EllipseSettings {
        let design = Ellipse::new(p, q, theta).unwrap();
        EllipseSettings { design, free: free.to_vec(), pole_mm: Some(0.0) }
    }

    const ALL: [EllipseParameter; 3] =
        [EllipseParameter::P, EllipseParameter::Q, EllipseParameter::Theta];

    #[test]
    fn an_ellipse_is_removed_to_a_picometre_and_fitted_to_a_millionth() {
        // Holes at random, a tilt along both axes, a piston; guesses that are off by 20 and 30 %.
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (x, y) = (coordinates(-50.0, 0.5, 201), coordinates(-3.0, 0.25, 25));
        for (p, q, theta) in
            [(30_000.0, 300.0, 3e-3), (40_000.0, 1500.0, 2.5e-3), (900.0, 700.0, 0.02)]
        {
            let truth = Ellipse::new(p, q, theta).unwrap();
            let mut heights = map(&x, &y, |x, y| truth.height_mm(x) + 2e-4 + 1e-6 * y);
            heights.mapv_inplace(|z| if rng.random_range(0.0..1.0) < 0.2 { f64::NAN } else { z });
            let heights = Heights { x_mm: &x, y_mm: &y, height_nm: &heights };
            let given = design(p, q, theta, &[]);
            let (left, report) = without_shape(&heights, Shape::Ellipse, Some(&given)).unwrap();
            // 1e-12 m = 1e-3 nm, of heights of 1e5 nm.
            assert!(largest(&left) < 1e-3, "{} nm", largest(&left));
            assert!((report.tilt_urad[1] - 1.0).abs() < 1e-6, "{report:?}");

            let guess = design(1.2 * p, 0.8 * q, 1.3 * theta, &ALL);
            let (left, report) = without_shape(&heights, Shape::Ellipse, Some(&guess)).unwrap();
            let found = report.ellipse.unwrap();
            for (found, want) in [(found.p_mm, p), (found.q_mm, q), (found.theta_mrad, 1e3 * theta)]
            {
                assert!((found / want - 1.0).abs() < 1e-6, "{found} for {want}");
            }
            assert!(largest(&left) < 1e-3, "{} nm", largest(&left));
        }
    }

    #[test]
    fn measured_slopes_of_an_ellipse_are_fitted_alike() {
        let x = coordinates(-110.0, 1.0, 221);
        let truth = Ellipse::new(25_000.0, 800.0, 3.5e-3).unwrap();
        let slopes: Vec<f64> = x.iter().map(|x| 1e9 * (truth.slope(*x) + 4e-6)).collect();
        let guess = design(20_000.0, 900.0, 3e-3, &ALL);
        let (left, report) =
            without_shape_of_slopes(&x, &slopes, Shape::Ellipse, Some(&guess)).unwrap();
        let found = report.ellipse.unwrap();
        for (found, want) in [(found.p_mm, 25_000.0), (found.q_mm, 800.0), (found.theta_mrad, 3.5)]
        {
            assert!((found / want - 1.0).abs() < 1e-6, "{found} for {want}");
        }
        // Slopes of 1e6 nrad in double precision.
        assert!(left.iter().all(|s| s.abs() < 1e-6), "{:?}", &left[..4]);
        assert!((report.tilt_urad[0] - 4.0).abs() < 1e-6, "{:?}", report.tilt_urad);
    }

    #[test]
    fn noise_that_hides_the_ellipse_leaves_a_fit_no_worse_than_the_truth() {
        // Slopes with noise as coarse as polished mirrors have it, short and long mirrors, strong and weak
        // ellipses, a guess that is off by 3 %: least squares are below those of the truth and of the circle.
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for case in 0..60 {
            let length = rng.random_range(30.0..1000.0);
            let x = coordinates(-0.5 * length, length / 200.0, 201);
            let p = 10_f64.powf(rng.random_range(3.5..5.0));
            let q = 10_f64.powf(rng.random_range(f64::max(length, 150.0).log10()..4.3));
            let theta = rng.random_range(2e-3..1.2e-2);
            let truth = Ellipse::new(p, q, theta).unwrap();
            let mut walk = 0.0;
            let noise: Vec<f64> = x
                .iter()
                .map(|_| {
                    walk = 0.98 * walk + rng.random_range(-100.0..100.0);
                    walk + rng.random_range(-300.0..300.0)
                })
                .collect();
            let slopes: Vec<f64> =
                x.iter().zip(&noise).map(|(x, n)| 1e9 * truth.slope(*x) + n).collect();
            let off = |v: f64, rng: &mut ChaCha8Rng| v * rng.random_range(0.97..1.03);
            let guess = design(off(p, &mut rng), off(q, &mut rng), off(theta, &mut rng), &ALL);
            let squares = |v: &[f64]| v.iter().map(|s| s * s).sum::<f64>();
            let (left, _) =
                without_shape_of_slopes(&x, &slopes, Shape::Ellipse, Some(&guess)).unwrap();
            let given = design(p, q, theta, &[]);
            let (true_left, _) =
                without_shape_of_slopes(&x, &slopes, Shape::Ellipse, Some(&given)).unwrap();
            assert!(
                squares(&left) <= squares(&true_left) * (1.0 + 1e-9),
                "{case}: {} {}",
                squares(&left),
                squares(&true_left)
            );
        }
    }

    #[test]
    fn cylinders_and_spheres_are_exact() {
        let (x, y) = (coordinates(10.0, 1.0, 101), coordinates(-20.0, 0.8, 51));
        // 10 m, convex and concave, tilted by turning the sphere about its centre: exact for any tilt.
        for radius in [10_000.0_f64, -800.0] {
            let sag = |u: f64, v: f64| {
                let (cx, cy) = (0.002 * radius, -0.001 * radius);
                let cz = (radius * radius - cx * cx - cy * cy).sqrt() * radius.signum();
                cz - (radius * radius - (u - cx).powi(2) - (v - cy).powi(2)).sqrt()
                    * radius.signum()
            };
            let sphere = map(&x, &y, |x, y| sag(x - 60.0, y));
            let heights = Heights { x_mm: &x, y_mm: &y, height_nm: &sphere };
            let (left, report) = without_shape(&heights, Shape::Sphere, None).unwrap();
            // Heights of 2e6 nm, as differences of 8e8 nm: rounding of 1e-7 nm; the fit is as good.
            assert!(largest(&left) < 1e-5, "{}", largest(&left));
            let found = report.radius_m.unwrap();
            assert!((found / (1e-3 * radius) - 1.0).abs() < 1e-9, "{found}");
            // Along x alone: a cylinder, with a tilt along y beside it.
            for turned in [false, true] {
                let cylinder = map(&x, &y, |x, y| match turned {
                    false => sag(x - 60.0, 0.0) + 3e-5 * y,
                    true => sag(0.0, y) + 3e-5 * x,
                });
                let heights = Heights { x_mm: &x, y_mm: &y, height_nm: &cylinder };
                let shape = if turned { Shape::CylinderY } else { Shape::CylinderX };
                let (left, report) = without_shape(&heights, shape, None).unwrap();
                assert!(largest(&left) < 1e-5, "{} {turned}", largest(&left));
                let across = report.tilt_urad[usize::from(!turned)];
                assert!((across - 30.0).abs() < 1e-6, "{across}");
            }
        }
    }

    #[test]
    fn what_the_points_do_not_tell_is_refused_with_its_remedy() {
        let (x, y) = (coordinates(0.0, 1.0, 3), coordinates(0.0, 1.0, 2));
        let flat = Array2::zeros((2, 3));
        let heights = Heights { x_mm: &x, y_mm: &y, height_nm: &flat };
        let message = |settings: Option<&EllipseSettings>| {
            without_shape(&heights, Shape::Ellipse, settings).unwrap_err().to_string()
        };
        assert!(message(None).contains("give `ellipse`"));
        let all = design(900.0, 700.0, 0.02, &ALL);
        assert!(message(Some(&all)).contains("4 for 6 unknowns"), "{}", message(Some(&all)));
        let (x, y) = (coordinates(-0.1, 0.01, 21), coordinates(0.0, 1.0, 2));
        let flat = Array2::zeros((2, 21));
        let heights = Heights { x_mm: &x, y_mm: &y, height_nm: &flat };
        let all = design(90_000.0, 90_000.0, 3e-3, &ALL);
        // What is flat over 0.2 mm is no worse an ellipse of any distances: the errors say so.
        let (_, report) = without_shape(&heights, Shape::Ellipse, Some(&all)).unwrap();
        assert!(report.ellipse.unwrap().standard_error.iter().all(|e| *e > 1.0));
    }
}
