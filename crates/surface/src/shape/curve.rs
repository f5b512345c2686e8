//! A curve of x with a tilt along y: line, circle or ellipse, and its derivatives by the fitted parameters.

use nalgebra::{DMatrix, DVector};
use planish_types::Invalid;

use super::{
    EllipseReport, EllipseSettings, Shape, ShapeReport, columns::Columns,
    moved_ellipse::MovedEllipse, too_few,
};

/// A curve of x, with a tilt along y; a fit changes its parameters.
#[derive(Clone, Debug)]
pub(super) struct Curve {
    /// Height of the curve at the middle (c0 of the shapes), mm.
    piston_mm: f64,
    /// Tilts along x and y (bx and by of the shapes), rad.
    tilt: [f64; 2],
    /// Half the curvature of a circle without tilt (A of the shapes), 1/mm; 0 for an ellipse.
    curvature_per_mm: f64,
    /// Ellipse with its fitted parameters; `None` for other shapes.
    pub ellipse: Option<MovedEllipse>,
    /// True if the curvature A is fitted.
    curved: bool,
    /// Point [x, y] from which x and y count, mm.
    pub middle_mm: [f64; 2],
    /// Relative standard errors of p, q and theta; see [`EllipseReport`].
    pub standard_error: [f64; 3],
}

impl Curve {
    /// Returns the curve from which a fit of `shape` to points at `x_mm` begins. Refuses no points, and an ellipse
    /// without its settings.
    pub fn new(
        shape: Shape,
        ellipse: Option<&EllipseSettings>,
        x_mm: &[f64],
    ) -> Result<Self, Invalid> {
        let (Some(first), Some(last)) = (x_mm.first(), x_mm.last()) else {
            return Err(too_few(shape, "there are none"));
        };
        let ellipse = match (shape, ellipse) {
            (Shape::Ellipse, Some(settings)) => Some(MovedEllipse::new(settings)),
            (Shape::Ellipse, None) => {
                let remedy = "give `ellipse`: p and q in mm, theta in mrad";
                return Err(Invalid::whole("ellipse", "is not known", remedy));
            }
            _ => None,
        };
        let middle_mm = 0.5 * (first + last);
        let pole_mm = ellipse.as_ref().and_then(|e| e.settings.pole_mm).unwrap_or(middle_mm);
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

    /// Returns the height w of the circle at the distance `u` from the middle, mm, and its derivatives by the tilt bx
    /// and the curvature A.
    fn circle(&self, u: f64) -> [f64; 3] {
        let a = self.curvature_per_mm;
        let g = self.tilt[0] * u + self.curvature_per_mm * u * u;
        let w = 2.0 * g / (1.0 + (1.0 - 4.0 * a * g).sqrt());
        let steep = 1.0 - 2.0 * a * w;
        [w, u / steep, (u * u + w * w) / steep]
    }

    /// Returns the height of the curve at (x, y), mm.
    pub fn height_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        let u = x_mm - self.middle_mm[0];
        let curve = match &self.ellipse {
            Some(moved) => moved.ellipse().height_mm(u) + self.tilt[0] * u,
            None => self.circle(u)[0],
        };
        self.piston_mm + self.tilt[1] * (y_mm - self.middle_mm[1]) + curve
    }

    /// Returns the slope of the curve along x at `x_mm`, rad.
    pub fn slope(&self, x_mm: f64) -> f64 {
        let u = x_mm - self.middle_mm[0];
        match &self.ellipse {
            Some(moved) => moved.ellipse().slope(u) + self.tilt[0],
            // w' (1 - 2 A w) = bx + 2 A x
            None => {
                let [w, ..] = self.circle(u);
                let a = self.curvature_per_mm;
                (self.tilt[0] + 2.0 * a * u) / (1.0 - 2.0 * a * w)
            }
        }
    }

    /// Returns the derivatives of a fitted value by the fitted parameters, in the order of [`Self::moved`]. The value
    /// is the height at (x, y), or the slope if the columns contain slopes.
    fn derivatives(&self, x_mm: f64, y_mm: f64, columns: &Columns) -> Vec<f64> {
        let u = x_mm - self.middle_mm[0];
        let mut row = Vec::with_capacity(6);
        let heights = columns.are_heights();
        if heights {
            row.push(1.0);
        }
        if columns.has_y() {
            row.push(y_mm);
        }
        match &self.ellipse {
            Some(moved) => {
                row.push(if heights { u } else { 1.0 });
                row.extend((0..moved.count()).map(|k| {
                    moved.derivative(k, |e| if heights { e.height_mm(u) } else { e.slope(u) })
                }));
            }
            None => {
                let [w, mut by_tilt, mut by_curvature] = self.circle(u);
                if !heights {
                    // The derivatives of those of the height by x, but for terms of the order of the squared slope.
                    let steep = 1.0 - 2.0 * self.curvature_per_mm * w;
                    by_tilt = 1.0 / steep;
                    by_curvature = 2.0 * u / steep;
                }
                row.push(by_tilt);
                if self.curved {
                    row.push(by_curvature);
                }
            }
        }
        row
    }

    /// Returns the curve with `step` added to its fitted parameters: piston, tilt along y, tilt along x, then curvature
    /// or ellipse. Parameters that the columns do not determine are left out.
    pub fn moved(&self, step: &[f64], columns: &Columns) -> Self {
        let mut curve = self.clone();
        let mut step = step.iter();
        let mut next = || step.next().copied().unwrap_or(0.0);
        if columns.are_heights() {
            curve.piston_mm += next();
        }
        if columns.has_y() {
            curve.tilt[1] += next();
        }
        curve.tilt[0] += next();
        if curve.curved {
            curve.curvature_per_mm += next();
        }
        if let Some(moved) = &mut curve.ellipse {
            moved.add(next);
        }
        curve
    }

    /// Returns curves with other ellipses within the bounds, from which further fits begin; empty for other shapes, and
    /// if no parameter of the ellipse is fitted.
    pub fn starts(&self) -> Vec<Self> {
        let moved = self.ellipse.as_ref().map_or(Vec::new(), MovedEllipse::starts);
        moved.into_iter().map(|e| Self { ellipse: Some(e), ..self.clone() }).collect()
    }

    /// Returns the room of the last parameters, those of the ellipse, to move down and up to their bounds; empty for
    /// other shapes.
    pub fn room(&self) -> Vec<[f64; 2]> {
        self.ellipse.as_ref().map_or(Vec::new(), MovedEllipse::room)
    }

    /// Returns the weighted differences of the column means (mm) or slopes (rad) from the curve. If the columns
    /// determine a tilt along y, one more element follows, for the deviations from these means.
    pub fn left(&self, columns: &Columns) -> DVector<f64> {
        let n = columns.x_mm.len();
        let mut left = DVector::zeros(n + usize::from(columns.has_y()));
        for i in 0..n {
            let x = columns.x_mm[i];
            left[i] = if columns.are_heights() {
                let y = columns.y_mm[i] + self.middle_mm[1];
                columns.weight[i] * (columns.mean_mm[i] - self.height_mm(x, y))
            } else {
                columns.mean_mm[i] - self.slope(x)
            };
        }
        if let Some([spread, rise]) = columns.within {
            left[n] = rise - self.tilt[1] * spread;
        }
        left
    }

    /// Returns the derivatives of the fitted values by the parameters, with the weights and in the row order of
    /// [`Self::left`].
    pub fn jacobian(&self, columns: &Columns) -> DMatrix<f64> {
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
            Some([spread, _]) if (i, k) == (n, 1) => spread,
            Some(_) if i == n => 0.0,
            _ => rows[i][k],
        })
    }

    /// Returns the parameters of the curve as the report on a fit of `shape`.
    pub fn report(&self, shape: Shape) -> ShapeReport {
        let [bx, by] = self.tilt;
        // A / sqrt(1 + bx^2 + ...) is half the curvature; a profile has no by.
        let radius = (1.0 + bx * bx).sqrt() / (2.0 * self.curvature_per_mm);
        ShapeReport {
            shape,
            tilt_urad: [1e6 * bx, 1e6 * by],
            radius_m: Some(1e-3 * radius).filter(|_| self.curved && radius.is_finite()),
            ellipse: self.ellipse.as_ref().map(|moved| {
                let ellipse = moved.ellipse();
                EllipseReport {
                    p_mm: ellipse.p_mm,
                    q_mm: ellipse.q_mm,
                    theta_mrad: 1e3 * ellipse.theta_rad,
                    pole_mm: self.middle_mm[0],
                    fitted: moved.settings.free.clone(),
                    standard_error: self.standard_error,
                }
            }),
        }
    }
}
