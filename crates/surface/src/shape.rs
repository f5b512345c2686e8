//! The best shape of a mirror: plane, cylinder, sphere or elliptical cylinder by least squares.
//!
//! ```text
//! plane        z = c0 + bx x + by y
//! cylinder-x   z = c0 + by y + w(x),      w - A (x^2 + w^2) = bx x         (curved along x)
//! cylinder-y   the same with x and y exchanged
//! sphere       z = c0 + w(x, y),          w - A (x^2 + y^2 + w^2) = bx x + by y
//! ellipse      z = c0 + by y + bx x + e(x - x0)                            ([`ImagingConic`])
//! w = 2 g / (1 + sqrt(1 - 4 A g)),   g = bx x + by y + A (x^2 + y^2)
//! ```
//!
//! Circle and sphere are exact, not parabolas: at 50 mm from the middle of a sphere of 10 m the difference is
//! 0.8 nm. x and y count from the middle of the valid pixels. Radius 1 / (2 A) times sqrt(1 + bx^2 + by^2),
//! positive where the mirror is concave (ends above the middle).
//!
//! Cylinder and ellipse are curves of x with a tilt along y; they are fitted to the columns of the map
//! (`columns.rs`, `curve.rs`) by the Levenberg-Marquardt method (`fit.rs`). The parameters of an ellipse move
//! along coordinates of their own (`moved_ellipse.rs`). Plane and sphere are fitted to the pixels (`sphere.rs`).
//!
//! Heights of a profile are fitted as a map of one row, and measured slopes by the derivatives of these shapes.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `height_mm` | (ny, nx) | mm |
//! | c0, bx, by, A | `piston_mm`, `tilt`, `curvature_per_mm` | | mm, rad, rad, 1/mm |

use ndarray::Array2;
use planish_form::ImagingConic;
use planish_numerics::statistics::{Plane, fit_plane};
use planish_types::Invalid;
use serde::{Deserialize, Serialize};

mod columns;
mod curve;
pub(crate) mod fit;
mod moved_ellipse;
mod sphere;

use columns::Columns;
use curve::Curve;
use fit::fitted;
use sphere::Sphere;

/// Number of nm in a mm.
const NM_PER_MM: f64 = 1e6;

/// Largest number of steps of a fit, accepted or not; after the last one the fit stays where it is. Larger: more time
/// on a fit that does not end. Smaller: a fit may stop before its minimum. Measured: an ellipse takes twenty steps, a
/// bad guess with noise up to a hundred.
const MAX_STEPS: usize = 400;

/// Change of the fitted values by a step, relative to the fitted values, below which a fit ends. Larger: the fit stops
/// before its minimum. Smaller: rounding keeps it going.
const LAST_STEP: f64 = 1e-13;

/// Shape that is fitted and subtracted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
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
    /// Returns the name of the shape in flags and files, such as `cylinder-x`.
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum EllipseParameter {
    /// Distance from source to pole.
    P,
    /// Distance from pole to image.
    Q,
    /// Grazing angle.
    Theta,
}

/// Ellipse that a mirror is made for, and the parameters of it that are fitted.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EllipseSettings {
    /// Ellipse as designed: the first guess of the parameters that are fitted.
    pub design: ImagingConic,
    /// Parameters of the ellipse that are fitted in addition to piston and tilt.
    pub free: Vec<EllipseParameter>,
    /// Position of the pole along x, mm; `None` for the middle of the valid pixels.
    pub pole_mm: Option<f64>,
}

/// Parameters of a shape that was fitted and subtracted.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ShapeReport {
    /// Shape that was fitted.
    pub shape: Shape,
    /// Slopes of the shape along x and y in the middle of the valid pixels, urad.
    pub tilt_urad: [f64; 2],
    /// Radius of curvature, m; positive for a concave mirror. `null` for a plane, and for other shapes without a single
    /// radius.
    pub radius_m: Option<f64>,
    /// Ellipse with its fitted parameters; `null` for other shapes.
    pub ellipse: Option<EllipseReport>,
}

/// Ellipse by the distances and the grazing angle with which mirrors are specified.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EllipseReport {
    /// Distance from source to pole, mm; `null` for infinity, a parabola.
    pub p_mm: f64,
    /// Distance from pole to image, mm; `null` for infinity, a parabola.
    pub q_mm: f64,
    /// Grazing angle at the pole, mrad.
    pub theta_mrad: f64,
    /// Position of the pole along x, mm.
    pub pole_mm: f64,
    /// Parameters of the ellipse that were fitted; the others are as given.
    pub fitted: Vec<EllipseParameter>,
    /// Relative standard errors of p, q and theta, under the assumption that the residual is white noise. 0 for given
    /// parameters, `null` for infinite errors.
    pub standard_error: [f64; 3],
}

/// Heights at the points of a lattice; NaN marks an invalid one.
pub(crate) struct Heights<'a> {
    /// Positions along x (nx), mm, ascending.
    pub x_mm: &'a [f64],
    /// Positions along y (ny), mm, ascending; one for a profile.
    pub y_mm: &'a [f64],
    /// Heights (ny, nx), nm.
    pub height_nm: &'a Array2<f64>,
}

/// Returns the heights minus the best `shape` (ny, nx), nm, and the parameters of the shape. Refuses heights that do
/// not determine the shape, and an ellipse without its settings.
pub(crate) fn without_shape(
    heights: &Heights,
    shape: Shape,
    ellipse: Option<&EllipseSettings>,
) -> Result<(Array2<f64>, ShapeReport), Invalid> {
    let is_line = heights.y_mm.len() == 1;
    match shape {
        Shape::Piston => {
            let valid = heights.height_nm.iter().filter(|v| !v.is_nan());
            let (n, sum) = valid.fold((0.0, 0.0), |(n, sum), v| (n + 1.0, sum + v));
            let plane = Plane { a: sum / n, b: 0.0, c: 0.0 };
            Ok((heights.height_nm - plane.a, plane_report(shape, plane)))
        }
        Shape::Plane if !is_line => {
            let Heights { x_mm: x, y_mm: y, .. } = *heights;
            let plane = fit_plane(heights.height_nm.view(), x, y)
                .ok_or_else(|| too_few(shape, "all on one line"))?;
            let left = heights.minus(|x, y| (plane.a + plane.b * x + plane.c * y) / NM_PER_MM);
            Ok((left, plane_report(shape, plane)))
        }
        Shape::Sphere if !is_line => {
            let sphere = Sphere::fitted(heights)?;
            Ok((heights.minus(|x, y| sphere.height_mm(x, y)), sphere.report()))
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
            let columns = Columns::of_map(heights);
            let curve = Curve::new(shape, ellipse, &columns.x_mm)?;
            let best = fitted(curve, &columns, shape)?;
            Ok((heights.minus(|x, y| best.height_mm(x, y)), best.report(shape)))
        }
    }
}

impl Heights<'_> {
    /// Returns the heights minus those of a shape, nm; `shape_mm` returns the height of the shape at x and y, all in
    /// mm.
    fn minus(&self, shape_mm: impl Fn(f64, f64) -> f64) -> Array2<f64> {
        let mut left = self.height_nm.clone();
        for ((r, c), v) in left.indexed_iter_mut() {
            *v -= NM_PER_MM * shape_mm(self.x_mm[c], self.y_mm[r]);
        }
        left
    }
}

fn plane_report(shape: Shape, plane: Plane) -> ShapeReport {
    // nm/mm is urad.
    ShapeReport { shape, tilt_urad: [plane.b, plane.c], radius_m: None, ellipse: None }
}

/// Returns the slopes `slope_nrad` at `x_mm` minus those of the best `shape`, nrad, and the parameters of the shape.
/// NaN marks an invalid element.
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
    let best = fitted(curve, &columns, shape)?;
    let left = x_mm.iter().zip(slope_nrad).map(|(x, s)| s - best.slope(*x) / NRAD);
    Ok((left.collect(), best.report(shape)))
}

fn too_few(shape: Shape, how: &str) -> Invalid {
    Invalid::whole(
        "shape",
        format!("the valid points do not define the shape {} ({how})", shape.name()),
        "give more of them, or a simpler shape",
    )
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
        let design = ImagingConic::ellipse(p, q, theta).unwrap();
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
            let truth = ImagingConic::ellipse(p, q, theta).unwrap();
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

    /// Earlier, a design that ends within the data was the end of the fit, although p was free.
    #[test]
    fn a_design_whose_ellipse_ends_within_the_data_is_fitted_from_other_starts() {
        let x = coordinates(-45.0, 0.5, 181);
        let truth = ImagingConic::ellipse(200.0, 30_000.0, 3e-3).unwrap();
        let heights = map(&x, &[0.0], |x, _| truth.height_mm(x));
        let heights = Heights { x_mm: &x, y_mm: &[0.0], height_nm: &heights };
        let guess = design(20.0, 30_000.0, 3e-3, &[EllipseParameter::P]);
        let (left, report) = without_shape(&heights, Shape::Ellipse, Some(&guess)).unwrap();
        assert!((report.ellipse.unwrap().p_mm / 200.0 - 1.0).abs() < 1e-6);
        assert!(largest(&left) < 1e-3, "{} nm", largest(&left));
    }

    #[test]
    fn measured_slopes_of_an_ellipse_are_fitted_alike() {
        let x = coordinates(-110.0, 1.0, 221);
        let truth = ImagingConic::ellipse(25_000.0, 800.0, 3.5e-3).unwrap();
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
            let truth = ImagingConic::ellipse(p, q, theta).unwrap();
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
    fn a_design_that_is_far_off_does_not_keep_a_fit_from_the_best_ellipse() {
        // p, q and theta of the design are off by up to a factor of e, within the bounds of e^3; coarse noise. The fit
        // leaves no more than the truth and the circle.
        let mut rng = ChaCha8Rng::seed_from_u64(29);
        for case in 0..40 {
            let length = rng.random_range(60.0..600.0);
            let x = coordinates(-0.5 * length, length / 120.0, 121);
            let p = 10_f64.powf(rng.random_range(3.7..4.7));
            let q = length.max(150.0) * rng.random_range(1.0..20.0);
            let truth = ImagingConic::ellipse(p, q, rng.random_range(2e-3..1.2e-2)).unwrap();
            let mut walk = 0.0;
            let slopes: Vec<f64> = x
                .iter()
                .map(|x| {
                    walk = 0.98 * walk + rng.random_range(-500.0..500.0);
                    1e9 * truth.slope(*x) + walk
                })
                .collect();
            let off = |v: f64, rng: &mut ChaCha8Rng| v * rng.random_range(-1.0_f64..1.0).exp();
            let guess = design(
                off(p, &mut rng),
                off(q, &mut rng).max(0.6 * length),
                off(truth.theta_rad, &mut rng),
                &ALL,
            );
            let squares = |shape, ellipse: Option<&EllipseSettings>| {
                let (left, _) = without_shape_of_slopes(&x, &slopes, shape, ellipse).unwrap();
                left.iter().map(|s| s * s).sum::<f64>()
            };
            let found = squares(Shape::Ellipse, Some(&guess));
            let given = design(truth.p_mm, truth.q_mm, truth.theta_rad, &[]);
            let at_most = [
                squares(Shape::Ellipse, Some(&given)),
                squares(Shape::CylinderX, None),
                squares(Shape::Plane, None),
            ];
            let least = at_most.into_iter().fold(f64::INFINITY, f64::min);
            // An ellipse within the bounds is a circle but for terms of the fourth order, 1e-3 of the noise.
            assert!(found <= least * (1.0 + 1e-3), "{case}: {found} {at_most:?}");
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
        // Over 0.2 mm a flat surface fits ellipses of any distances equally well, and the standard errors
        // must show it.
        let (_, report) = without_shape(&heights, Shape::Ellipse, Some(&all)).unwrap();
        assert!(report.ellipse.unwrap().standard_error.iter().all(|e| *e > 1.0));
    }
}
