//! Least-squares fit of a sphere to a map.

use nalgebra::{Matrix4, Vector4};
use planish_types::Invalid;

use super::{Heights, LAST_STEP, MAX_STEPS, NM_PER_MM, Shape, ShapeReport, too_few};

/// A sphere, and the point from which its coordinates count.
pub(super) struct Sphere {
    /// Parameters of the module `shape`: piston c0, mm; tilts bx and by, rad; A, 1/mm.
    parameter: [f64; 4],
    /// Point [x, y] from which x and y count, mm.
    middle_mm: [f64; 2],
}

impl Sphere {
    /// Fits the sphere of least squares by the Gauss-Newton method: the normal equations of these four unknowns are
    /// well conditioned. Refuses heights that lie on one or two lines, or are steeper than any sphere.
    pub fn fitted(heights: &Heights) -> Result<Self, Invalid> {
        let Heights { x_mm: x, y_mm: y, .. } = *heights;
        let middle_mm = [0.5 * (x[0] + x[x.len() - 1]), 0.5 * (y[0] + y[y.len() - 1])];
        let half = (x[x.len() - 1] - x[0]).hypot(y[y.len() - 1] - y[0]) / 2.0;
        let scale = [1.0, half, half, half * half];
        let mut sphere = Self { parameter: [0.0; 4], middle_mm };
        let mut before = f64::INFINITY;
        for _ in 0..MAX_STEPS {
            let mut normal = Matrix4::<f64>::zeros();
            let mut right = Vector4::<f64>::zeros();
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
            let mut moved = 0.0_f64;
            let mut size = 0.0_f64;
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

    /// Returns the height z at (x, y), mm, and its derivatives by c0, bx, by and A.
    fn with_derivatives(&self, x_mm: f64, y_mm: f64) -> [f64; 5] {
        let [c0, bx, by, a] = self.parameter;
        let (u, v) = (x_mm - self.middle_mm[0], y_mm - self.middle_mm[1]);
        let g = bx * u + by * v + a * (u * u + v * v);
        let w = 2.0 * g / (1.0 + (1.0 - 4.0 * a * g).sqrt());
        let steep = 1.0 - 2.0 * a * w;
        [c0 + w, 1.0, u / steep, v / steep, (u * u + v * v + w * w) / steep]
    }

    /// Returns the height of the sphere at (x, y), mm.
    pub fn height_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        self.with_derivatives(x_mm, y_mm)[0]
    }

    /// Returns the parameters of the sphere as the report on its fit.
    pub fn report(&self) -> ShapeReport {
        let [_, bx, by, a] = self.parameter;
        let radius_m = 1e-3 * (1.0 + bx * bx + by * by).sqrt() / (2.0 * a);
        ShapeReport {
            shape: Shape::Sphere,
            tilt_urad: [1e6 * bx, 1e6 * by],
            radius_m: Some(radius_m).filter(|r| r.is_finite()),
            ellipse: None,
        }
    }
}
