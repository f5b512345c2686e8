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
//! So an ellipse on a million pixels is a problem of some thousand rows, solved by a QR decomposition of its
//! Jacobian, whose columns are nearly parallel (p, q and theta differ in the third and fourth order only).
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

/// Steps after which a fit is given up: from a guess within a factor of two an ellipse takes ten.
const MAX_STEPS: usize = 200;

/// Halvings of a step that does not lessen the squares, until they count as least.
const MAX_HALVINGS: usize = 30;

/// A step of this fraction of the parameters is the last: their rounding in ill-conditioned fits.
const LAST_STEP: f64 = 1e-13;

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
    /// Source to pole, mm.
    pub p_mm: f64,
    /// Pole to image, mm.
    pub q_mm: f64,
    /// Grazing angle, mrad.
    pub theta_mrad: f64,
    /// Where the pole is, mm.
    pub pole_mm: f64,
    /// What was fitted.
    pub fitted: Vec<EllipseParameter>,
    /// Standard errors of p, q and theta, relative, as if the residual were white; 0 where given.
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
    /// The ellipse, with its logarithms as parameters.
    ellipse: Option<(Ellipse, EllipseSettings)>,
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
            (Shape::Ellipse, Some(settings)) => Some((settings.design, settings.clone())),
            (Shape::Ellipse, None) => {
                let remedy = "give `ellipse`: p and q in mm, theta in mrad";
                return Err(Invalid::whole("ellipse", "is not known", remedy));
            }
            _ => None,
        };
        let middle_mm = 0.5 * (first + last);
        let pole_mm = ellipse.as_ref().and_then(|(_, s)| s.pole_mm).unwrap_or(middle_mm);
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
            Some((ellipse, _)) => ellipse.height_mm(u) + self.tilt[0] * u,
            None => self.circle(u)[0],
        };
        self.piston_mm + self.tilt[1] * (y_mm - self.middle_mm[1]) + curve
    }

    fn slope(&self, x_mm: f64) -> f64 {
        let u = x_mm - self.middle_mm[0];
        match &self.ellipse {
            Some((ellipse, _)) => ellipse.slope(u) + self.tilt[0],
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
            Some((ellipse, settings)) => {
                row.push(if heights { u } else { 1.0 });
                let all = match heights {
                    true => ellipse.height_derivatives_mm(u),
                    false => ellipse.slope_derivatives(u),
                };
                row.extend(settings.free.iter().map(|parameter| all[*parameter as usize]));
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
        if let Some((ellipse, settings)) = &mut curve.ellipse {
            for parameter in &settings.free {
                let value = match parameter {
                    EllipseParameter::P => &mut ellipse.p_mm,
                    EllipseParameter::Q => &mut ellipse.q_mm,
                    EllipseParameter::Theta => &mut ellipse.theta_rad,
                };
                *value *= next().exp();
            }
        }
        curve
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

    /// The curve of least squares: Gauss and Newton's steps, halved where they do not lessen the squares.
    fn fitted(mut self, columns: &Columns, shape: Shape) -> Result<Self, Invalid> {
        self.middle_mm[1] = columns.y_middle_mm;
        let mut left = self.left(columns);
        for step in 0..MAX_STEPS {
            let mut jacobian = self.jacobian(columns);
            if jacobian.nrows() < jacobian.ncols() {
                let how = format!("{} for {} unknowns", jacobian.nrows(), jacobian.ncols());
                return Err(too_few(shape, &how));
            }
            let scale: Vec<f64> = jacobian.column_iter().map(|c| c.norm()).collect();
            if !(scale.iter().all(|s| s.is_finite() && *s > 0.0) && left.norm().is_finite()) {
                let how = match step {
                    0 => "they lie beyond the ends of the ellipse, or in one place",
                    _ => "no ellipse near the given one fits them; fit fewer of p, q and theta",
                };
                return Err(too_few(shape, how));
            }
            jacobian.column_iter_mut().zip(&scale).for_each(|(mut c, s)| c /= *s);
            let qr = jacobian.qr();
            let r = qr.r();
            if (0..r.ncols()).any(|k| r[(k, k)].abs() < INDEPENDENT) {
                let problem =
                    format!("the points do not tell the parameters of the {} apart", shape.name());
                let remedy = match shape {
                    Shape::Ellipse => "fit fewer of p, q and theta",
                    _ => "give points along more of x and y",
                };
                return Err(Invalid::whole("shape", problem, remedy));
            }
            let mut projected = left.clone();
            qr.q_tr_mul(&mut projected);
            let projected = projected.rows(0, r.ncols()).into_owned();
            let solved = r.solve_upper_triangular(&projected).expect("its diagonal is not zero");
            let change: Vec<f64> = solved.iter().zip(&scale).map(|(v, s)| v / s).collect();
            // The size of what the step changes, against what is fitted.
            let small = solved.norm() <= LAST_STEP * self.size(columns);
            let mut factor = 1.0;
            let moved = (0..MAX_HALVINGS).find_map(|_| {
                let scaled: Vec<f64> = change.iter().map(|v| factor * v).collect();
                let curve = self.moved(&scaled, columns);
                let then = curve.left(columns);
                factor *= 0.5;
                (then.norm() < left.norm()).then_some((curve, then))
            });
            let ended = moved.is_none() || small;
            if let Some((curve, then)) = moved {
                (self, left) = (curve, then);
            }
            if ended {
                self.standard_error = self.errors(&r, &scale, &left);
                return Ok(self);
            }
        }
        let problem = format!("has no best {} after {MAX_STEPS} steps", shape.name());
        Err(Invalid::whole("shape", problem, "fit fewer parameters, or give a better first guess"))
    }

    /// Norm of the heights, or slopes, that are fitted.
    fn size(&self, columns: &Columns) -> f64 {
        let weighted = columns.mean_mm.iter().enumerate();
        let squares = weighted.map(|(i, v)| (v * columns.weight.get(i).unwrap_or(&1.0)).powi(2));
        squares.sum::<f64>().sqrt()
    }

    /// Standard errors of p, q, theta: s^2 (J' J)^-1 with s^2 = |left|^2 / (rows - unknowns).
    fn errors(&self, r: &DMatrix<f64>, scale: &[f64], left: &DVector<f64>) -> [f64; 3] {
        let mut errors = [0.0; 3];
        let Some((_, settings)) = &self.ellipse else { return errors };
        let unknowns = r.ncols();
        let spare = left.len().saturating_sub(unknowns).max(1) as f64;
        let Some(inverse) = r.clone().try_inverse() else { return errors };
        let first = unknowns - settings.free.len();
        for (i, parameter) in settings.free.iter().enumerate() {
            let k = first + i;
            errors[*parameter as usize] =
                inverse.row(k).norm() * left.norm() / spare.sqrt() / scale[k];
        }
        errors
    }

    fn report(&self, shape: Shape) -> ShapeReport {
        let [bx, by] = self.tilt;
        // A / sqrt(1 + bx^2 + ...) is half the curvature; a profile has no by.
        let radius = (1.0 + bx * bx).sqrt() / (2.0 * self.curvature_per_mm);
        ShapeReport {
            shape,
            tilt_urad: [1e6 * bx, 1e6 * by],
            radius_m: (self.curved && radius.is_finite()).then_some(1e-3 * radius),
            ellipse: self.ellipse.as_ref().map(|(ellipse, settings)| EllipseReport {
                p_mm: ellipse.p_mm,
                q_mm: ellipse.q_mm,
                theta_mrad: 1e3 * ellipse.theta_rad,
                pole_mm: self.middle_mm[0],
                fitted: settings.free.clone(),
                standard_error: self.standard_error,
            }),
        }
    }
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
        let message = without_shape(&heights, Shape::Ellipse, Some(&all)).unwrap_err().to_string();
        assert!(message.contains("fit fewer of p, q and theta"), "{message}");
    }
}
