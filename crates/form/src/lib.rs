//! The form of a part: its height along z over the plane of the part, with its slopes, normal and second derivatives.
//!
//! ```text
//! sphere, conic, paraboloid     z = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)),   c = 1 / R             (1)
//! asphere                       the same plus A4 r^4 + A6 r^6 + ...                                  (2)
//! cylinder                      (1) or (2) with r = x
//! toroid                        z = g + x^2 / (a + sqrt(a^2 - x^2) sign a),   a = R_x - g            (3)
//! imaging cylinders             [`ImagingConic`]: ellipse, parabola, hyperbola from p, q and theta
//! map                           bicubic, from splines along the runs of valid pixels ([`sampled`])
//! ```
//!
//! g is (1) with r = y, R = R_y and k = 0: the toroid is this circle, turned about an axis along y at the height R_x.
//! R is positive where the ends of the part are above its vertex (concave). The terms of (1) and (2) are those of ISO
//! 10110-12. A form can lie off the axis of its parent, turned in the plane, and have Zernike terms ([`Numbering`]).
//!
//! | module | contents |
//! |---|---|
//! | `jet` | values with first and second derivatives |
//! | `imaging` | elliptic, parabolic and hyperbolic cylinders |
//! | `zernike` | Zernike terms |
//! | `sampled` | a form that is a map |
//! | `file` | the form file, and its parameters |
//! | `development` | coordinates along the surface |
//! | `low_order` | low-order part of a map: Zernike, Legendre or Chebyshev terms |
//! | `basis` | least squares with these terms |
//!
//! | symbol | in the form file | unit |
//! |---|---|---|
//! | R | `radius_mm` | mm |
//! | R_x, R_y | `radius_x_mm`, `radius_y_mm` | mm |
//! | k | `conic_constant` | 1 |
//! | A4, A6, ... | `even_terms` | mm^-3, mm^-5, ... |

pub mod basis;
pub mod development;
pub mod file;
pub mod imaging;
mod jet;
pub mod low_order;
pub mod sampled;
mod zernike;

pub use development::Development;
pub use file::{Axis, FormFile, FormKind, ParameterFit, ZernikeFile};
pub use imaging::ImagingConic;
pub use jet::Jet;
pub use sampled::Sampled;
pub use zernike::Numbering;

use planish_types::{Invalid, Surface};

/// Number of nm in a mm.
const NM_PER_MM: f64 = 1e6;

/// Largest number of Newton steps to a point of a tilted parent, which converge quadratically from the tangent plane.
/// Larger: no effect. Smaller: steep parts are refused.
const NEWTON_STEPS: usize = 30;

/// Change of the height by a step, relative to 1 mm plus the height, below which the height has converged. Larger:
/// heights are less exact. Smaller: rounding of the coordinates keeps the steps going.
const CONVERGED: f64 = 1e-12;

/// Number of steps after the height has converged. Each of them makes one more order of the derivatives exact.
const STEPS_FOR_DERIVATIVES: usize = 3;

/// Form of a part, checked: the height along z as a function of x and y.
#[derive(Clone, Debug)]
pub struct Form {
    shape: Shape,
    vertex_mm: [f64; 2],
    /// Cosine and sine of the angle by which the axes of the form are turned in the plane of the part.
    turn: [f64; 2],
    off_axis: Option<OffAxis>,
    terms: Option<Terms>,
}

/// Height of a form over its own axes, from its vertex.
#[derive(Clone, Debug)]
enum Shape {
    Plane,
    /// Conic and asphere, (1) and (2) of the module: of the radius, or of x alone if `is_cylinder`.
    Even {
        curvature_per_mm: f64,
        conic_constant: f64,
        terms: Vec<f64>,
        is_cylinder: bool,
    },
    /// Toroid, (3) of the module.
    Toroid {
        radius_x_mm: f64,
        radius_y_mm: f64,
    },
    Imaging(ImagingConic),
    Sampled(Box<Sampled>),
}

impl Shape {
    fn jet(&self, [x, y]: [Jet; 2]) -> Jet {
        match self {
            Self::Plane => Jet::constant(0.0),
            Self::Even { curvature_per_mm: c, conic_constant: k, terms, is_cylinder } => {
                let square = if *is_cylinder { x * x } else { x * x + y * y };
                let one = Jet::constant(1.0);
                // z = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + A4 r^4 + A6 r^6 + ...
                let root = (one - square.times((1.0 + k) * c * c)).sqrt();
                let mut z = square.times(*c) / (one + root);
                let mut power = square;
                for term in terms {
                    power = power * square;
                    z = z + power.times(*term);
                }
                z
            }
            Self::Toroid { radius_x_mm, radius_y_mm } => {
                let one = Jet::constant(1.0);
                let c = 1.0 / radius_y_mm;
                let g = (y * y).times(c) / (one + (one - (y * y).times(c * c)).sqrt());
                // z = g + (x^2 / a) / (1 + sqrt(1 - (x / a)^2)),   a = R_x - g
                let a = Jet::constant(*radius_x_mm) - g;
                let ratio = x / a;
                g + ratio * x / (one + (one - ratio * ratio).sqrt())
            }
            Self::Imaging(conic) => conic.jet(x),
            Self::Sampled(map) => map.jet([x, y]),
        }
    }

    /// Returns true if the height over the axes of the form depends on x alone.
    fn is_cylinder(&self) -> bool {
        matches!(self, Self::Imaging(_) | Self::Even { is_cylinder: true, .. })
    }
}

/// Off-axis section: the part lies on its parent form away from the vertex.
#[derive(Clone, Copy, Debug)]
enum OffAxis {
    /// Section with heights along the axis of the parent. They count from `height_mm`, the height at the point `at_mm`
    /// [x, y] from the vertex.
    Parent { at_mm: [f64; 2], height_mm: f64 },
    /// Section with heights along the normal of the parent at the point `origin_mm`. `axes` are the unit vectors of x,
    /// y and z of the section.
    Normal { origin_mm: [f64; 3], axes: [[f64; 3]; 3] },
}

/// Zernike terms that are added to the height.
#[derive(Clone, Debug)]
struct Terms {
    numbering: Numbering,
    centre_mm: [f64; 2],
    radius_mm: f64,
    /// Index and coefficient, mm, of each term.
    terms: Vec<(u32, f64)>,
}

/// A point of a form, with the slopes and the second derivatives there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FormPoint {
    jet: Jet,
}

impl FormPoint {
    /// Returns the height along z, mm, above the vertex or the middle of the section.
    pub fn sag_mm(&self) -> f64 {
        self.jet.value
    }

    /// Returns the slopes of the height along [x, y], mm/mm.
    pub fn gradient(&self) -> [f64; 2] {
        self.jet.gradient
    }

    /// Returns the second derivatives [xx, xy, yy] of the height, 1/mm.
    pub fn hessian(&self) -> [f64; 3] {
        self.jet.hessian
    }

    /// Returns the unit normal, out of the material: `(-f_x, -f_y, 1) / sqrt(1 + f_x^2 + f_y^2)`.
    pub fn normal(&self) -> [f64; 3] {
        let [x, y] = self.jet.gradient;
        let n = self.cosine();
        [-x * n, -y * n, n]
    }

    /// Returns the cosine of the slope angle, the z component of the normal.
    pub fn cosine(&self) -> f64 {
        let [x, y] = self.jet.gradient;
        1.0 / (1.0 + x * x + y * y).sqrt()
    }

    /// Returns the slope angle: between the normal and z, degrees.
    pub fn slope_deg(&self) -> f64 {
        let [x, y] = self.jet.gradient;
        x.hypot(y).atan().to_degrees()
    }
}

impl Form {
    /// Makes the form that a file states. `map` contains the heights of a form of the kind `map`; other kinds do not
    /// use it.
    ///
    /// # Errors
    /// Refuses a file that [`FormFile::check`] refuses, a map without 2 x 2 valid pixels, and a section where the
    /// parent does not exist.
    pub fn new(file: &FormFile, map: Option<&Surface>) -> Result<Self, Invalid> {
        file.check()?;
        let shape = match file.kind {
            FormKind::Map => {
                let map = map.expect("a caller reads the map of a form of the kind map");
                Shape::Sampled(Box::new(Sampled::new(map)?))
            }
            FormKind::EllipticCylinder
            | FormKind::HyperbolicCylinder
            | FormKind::ParabolicCylinder => Shape::Imaging(file.imaging()?),
            FormKind::Plane => Shape::Plane,
            FormKind::Toroid => Shape::Toroid {
                radius_x_mm: file.radius_x_mm.expect("checked: a toroid has both radii"),
                radius_y_mm: file.radius_y_mm.expect("checked: a toroid has both radii"),
            },
            kind => Shape::Even {
                curvature_per_mm: 1.0 / file.radius_mm.expect("checked: the kind has a radius"),
                conic_constant: match kind {
                    FormKind::Paraboloid => -1.0,
                    _ => file.conic_constant.unwrap_or_default(),
                },
                terms: file.even_terms.clone().unwrap_or_default(),
                is_cylinder: kind == FormKind::Cylinder,
            },
        };
        let (sine, cosine) = file.rotation_deg.unwrap_or_default().to_radians().sin_cos();
        let terms = file.zernike.as_ref().map(|z| Terms {
            numbering: z.numbering,
            centre_mm: z.centre_mm,
            radius_mm: z.radius_mm,
            terms: z.indexed().map(|(j, nm)| (j, nm / NM_PER_MM)).collect(),
        });
        let mut form = Self {
            shape,
            vertex_mm: file.vertex_mm.unwrap_or_default(),
            turn: [cosine, sine],
            off_axis: None,
            terms,
        };
        if let Some(at_mm) = file.off_axis_mm {
            form.off_axis = Some(form.section(at_mm, file.height_along.unwrap_or(Axis::Parent))?);
        }
        Ok(form)
    }

    /// Returns a sphere of this radius of curvature, mm, with its vertex at [x, y], mm. A positive radius is concave.
    /// Refuses 0, NaN and a magnitude above 1e12 mm.
    pub fn sphere(radius_mm: f64, vertex_mm: [f64; 2]) -> Result<Self, Invalid> {
        let file = FormFile {
            kind: FormKind::Sphere,
            radius_mm: Some(radius_mm),
            vertex_mm: Some(vertex_mm),
            ..FormFile::plane()
        };
        Self::new(&file, None)
    }

    /// Returns a form that is a map of its heights along z, nm. Refuses a map without 2 x 2 valid pixels.
    pub fn sampled(map: &Surface) -> Result<Self, Invalid> {
        let shape = Shape::Sampled(Box::new(Sampled::new(map)?));
        Ok(Self { shape, vertex_mm: [0.0; 2], turn: [1.0, 0.0], off_axis: None, terms: None })
    }

    /// Returns the off-axis section about the point `at_mm` [x, y] of the parent, from its vertex. Refuses a point at
    /// which the parent does not exist.
    fn section(&self, at_mm: [f64; 2], along: Axis) -> Result<OffAxis, Invalid> {
        let jet = self.shape.jet(Jet::coordinates(at_mm));
        if !jet.is_finite() {
            let problem = format!("is {at_mm:?}, where the parent does not exist");
            let remedy = "give a place within the parent, in mm from its vertex";
            return Err(Invalid::whole("off_axis_mm", problem, remedy));
        }
        if along == Axis::Parent {
            return Ok(OffAxis::Parent { at_mm, height_mm: jet.value });
        }
        let [fx, _] = jet.gradient;
        let z = FormPoint { jet }.normal();
        let length = fx.hypot(1.0);
        let x = [1.0 / length, 0.0, fx / length];
        let y = [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]];
        let origin_mm = [at_mm[0], at_mm[1], jet.value];
        Ok(OffAxis::Normal { origin_mm, axes: [x, y, z] })
    }

    /// Checks that the form exists over every valid pixel of a map of the part.
    ///
    /// # Errors
    /// Refuses a form that does not, with the first such pixel and the number of the others.
    pub fn check_over(&self, surface: &Surface) -> Result<(), Invalid> {
        let grid = surface.grid();
        let valid = surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan());
        let mut lacking = valid.filter(|((r, c), _)| {
            self.point([grid.x.coordinate_mm(*c), grid.y.coordinate_mm(*r)]).is_none()
        });
        let Some(((r, c), _)) = lacking.next() else { return Ok(()) };
        let x = grid.x.coordinate_mm(c);
        let y = grid.y.coordinate_mm(r);
        let more = lacking.count();
        let problem = format!(
            "is invalid or absent at ({x:.4}, {y:.4}) mm, where the map of the part has a valid pixel (and at {more} \
             more)"
        );
        let remedy = "fill the form by `planish surface prepare --fill`, give a formula in a form file, or make these \
                      pixels of the map of the part invalid";
        Err(Invalid::at_index("form", (r, c), problem, remedy))
    }

    /// Returns the point of the form over the point `p` [x, y] of the part, mm; `None` where the form does not exist.
    pub fn point(&self, p: [f64; 2]) -> Option<FormPoint> {
        let jet = self.jet(p);
        if jet.is_finite() { Some(FormPoint { jet }) } else { None }
    }

    /// Returns the height along z over the point `p` [x, y] of the part, mm; `None` where the form does not exist.
    pub fn sag_mm(&self, p: [f64; 2]) -> Option<f64> {
        self.point(p).map(|place| place.sag_mm())
    }

    /// Returns the position of the vertex of the form on the part [x, y], mm; for a map it is the origin.
    pub fn vertex_mm(&self) -> [f64; 2] {
        self.vertex_mm
    }

    /// Returns the direction [cosine, sine] on the part along which the form is curved. `None` if its height does not
    /// depend on one coordinate alone.
    fn cylinder_direction(&self) -> Option<[f64; 2]> {
        let tilted = matches!(self.off_axis, Some(OffAxis::Normal { .. }));
        if self.shape.is_cylinder() && !tilted && self.terms.is_none() {
            Some(self.turn)
        } else {
            None
        }
    }

    /// Returns the map of a form of the kind `map`; `None` for other forms.
    fn map(&self) -> Option<&Sampled> {
        match &self.shape {
            Shape::Sampled(map) => Some(map),
            _ => None,
        }
    }

    fn jet(&self, p: [f64; 2]) -> Jet {
        let part = Jet::coordinates(p);
        let [cosine, sine] = self.turn;
        let [dx, dy] = [0, 1].map(|k| part[k] - Jet::constant(self.vertex_mm[k]));
        let local = [dx.times(cosine) + dy.times(sine), dy.times(cosine) - dx.times(sine)];
        let mut z = match &self.off_axis {
            None => self.shape.jet(local),
            Some(OffAxis::Parent { at_mm, height_mm }) => {
                let on_parent = [0, 1].map(|k| local[k] + Jet::constant(at_mm[k]));
                self.shape.jet(on_parent) - Jet::constant(*height_mm)
            }
            Some(OffAxis::Normal { origin_mm, axes }) => self.tilted(local, *origin_mm, axes),
        };
        if let Some(terms) = &self.terms {
            let on_circle = [0, 1].map(|k| {
                (part[k] - Jet::constant(terms.centre_mm[k])).times(1.0 / terms.radius_mm)
            });
            for (index, mm) in &terms.terms {
                let term = terms.numbering.term(*index, on_circle).expect("checked with the file");
                z = z + term.times(*mm);
            }
        }
        z
    }

    /// Returns the height z over a tilted section, with its derivatives: the z at which `origin + x e1 + y e2 + z e3`
    /// lies on the parent. It is found by Newton's method, and NaN if the method does not converge.
    fn tilted(&self, [x, y]: [Jet; 2], origin: [f64; 3], [e1, e2, e3]: &[[f64; 3]; 3]) -> Jet {
        let mut z = Jet::constant(0.0);
        let mut exact = 0;
        for _ in 0..NEWTON_STEPS {
            let [px, py, pz] = [0, 1, 2].map(|k| {
                Jet::constant(origin[k]) + x.times(e1[k]) + y.times(e2[k]) + z.times(e3[k])
            });
            // G = P_z - F(P_x, P_y),   dG/dz = e3_z - F_x e3_x - F_y e3_y
            let f = self.shape.jet([px, py]);
            let [fx, fy] = self.shape.jet(Jet::coordinates([px.value, py.value])).gradient;
            let step = (pz - f).times(1.0 / (e3[2] - fx * e3[0] - fy * e3[1]));
            z = z - step;
            if step.value.abs() <= CONVERGED * (1.0 + z.value.abs()) || exact > 0 {
                exact += 1;
            }
            if exact == STEPS_FOR_DERIVATIVES {
                return z;
            }
        }
        Jet::constant(f64::NAN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl FormPoint {
        /// The principal curvatures, 1/mm, the smaller first; positive where the part is concave. They are the roots of
        /// the characteristic polynomial of the shape operator of a graph (M. do Carmo, Differential Geometry of Curves
        /// and Surfaces, section 3-3).
        fn principal_curvatures_per_mm(&self) -> [f64; 2] {
            let ([p, q], [r, s, t]) = (self.jet.gradient, self.jet.hessian);
            let w = 1.0 + p * p + q * q;
            // H = ((1 + q^2) r - 2 p q s + (1 + p^2) t) / (2 w^(3/2)),   K = (r t - s^2) / w^2
            let mean =
                ((1.0 + q * q) * r - 2.0 * p * q * s + (1.0 + p * p) * t) / (2.0 * w.powf(1.5));
            let gauss = (r * t - s * s) / (w * w);
            let half = (mean * mean - gauss).max(0.0).sqrt();
            [mean - half, mean + half]
        }
    }
    use proptest::prelude::*;

    fn form(json: &str) -> Form {
        Form::new(&serde_json::from_str(json).unwrap(), None).unwrap()
    }

    #[test]
    fn a_sphere_has_its_radius_everywhere() {
        for radius in [80.0, -80.0] {
            let sphere = Form::sphere(radius, [3.0, -2.0]).unwrap();
            for p in [[3.0, -2.0], [13.0, 8.0], [3.0, 58.0], [-40.0, -30.0]] {
                let at = sphere.point(p).unwrap();
                let centre = [3.0, -2.0, radius];
                let point = [p[0], p[1], at.sag_mm()];
                let n = at.normal();
                // The centre of curvature lies along the normal; coordinates of 80 mm carry roundings of 1e-14.
                for k in 0..3 {
                    assert!((point[k] + radius * n[k] - centre[k]).abs() < 1e-11, "{p:?}");
                }
                for curvature in at.principal_curvatures_per_mm() {
                    // Two equal curvatures are told apart by the root of a rounding: sqrt(1e-16).
                    assert!((curvature * radius - 1.0).abs() < 1e-7, "{p:?}: {curvature}");
                }
            }
            assert!(sphere.point([90.0, 0.0]).is_none());
        }
    }

    #[test]
    fn a_paraboloid_has_the_curvatures_of_its_formula() {
        // Meridional 1 / (R w^3), sagittal 1 / (R w), w = sqrt(1 + r^2 / R^2).
        let parabola = form(r#"{"kind": "paraboloid", "radius_mm": 100}"#);
        let at = parabola.point([30.0, 40.0]).unwrap();
        let w = 1.25_f64.sqrt();
        // Below: rounding of 12.5 mm, of quotients, and of degrees.
        assert!((at.sag_mm() - 12.5).abs() < 1e-13);
        let [low, high] = at.principal_curvatures_per_mm();
        assert!(
            (low * 100.0 * w.powi(3) - 1.0).abs() < 1e-12 && (high * 100.0 * w - 1.0).abs() < 1e-12
        );
        assert!((at.slope_deg() - 0.5_f64.atan().to_degrees()).abs() < 1e-12);
    }

    #[test]
    fn a_section_along_the_normal_is_the_parent_itself() {
        for json in [
            r#"{"kind": "paraboloid", "radius_mm": 400, "off_axis_mm": [120, 50], "height_along": "normal"}"#,
            r#"{"kind": "asphere", "radius_mm": -300, "conic_constant": 0.4, "even_terms": [1e-9, -2e-14],
                "off_axis_mm": [-60, 80], "height_along": "normal"}"#,
        ] {
            let section = form(json);
            let Some(OffAxis::Normal { origin_mm, axes }) = section.off_axis else { panic!() };
            // Below: rounding of coordinates of up to 400 mm, of curvatures below 0.01 / mm, and of a unit vector.
            assert!(section.point([0.0; 2]).unwrap().sag_mm().abs() < 1e-14);
            for p in [[0.0, 0.0], [10.0, -20.0], [-25.0, 3.0]] {
                let at = section.point(p).unwrap();
                let point = [0, 1, 2].map(|k| {
                    origin_mm[k] + p[0] * axes[0][k] + p[1] * axes[1][k] + at.sag_mm() * axes[2][k]
                });
                let parent =
                    FormPoint { jet: section.shape.jet(Jet::coordinates([point[0], point[1]])) };
                // Rounding of coordinates of up to 400 mm.
                assert!((parent.sag_mm() - point[2]).abs() < 1e-13);
                // Curvatures and normal do not depend on the frame.
                let (a, b) =
                    (at.principal_curvatures_per_mm(), parent.principal_curvatures_per_mm());
                // Rounding of curvatures below 0.01 / mm.
                assert!((0..2).all(|k| (a[k] - b[k]).abs() < 1e-14), "{a:?} {b:?}");
                let n = at.normal();
                for k in 0..3 {
                    let turned: f64 = (0..3).map(|i| n[i] * axes[i][k]).sum();
                    // Rounding of a unit vector.
                    assert!((turned - parent.normal()[k]).abs() < 1e-14, "{p:?}");
                }
            }
        }
        // The section of a sphere is that sphere.
        let section = form(
            r#"{"kind": "sphere", "radius_mm": 200, "off_axis_mm": [70, -20], "height_along": "normal"}"#,
        );
        let sphere = Form::sphere(200.0, [0.0; 2]).unwrap();
        for p in [[5.0, 9.0], [-30.0, 40.0]] {
            // Rounding of coordinates of 200 mm.
            assert!((section.sag_mm(p).unwrap() - sphere.sag_mm(p).unwrap()).abs() < 1e-12);
        }
    }

    #[test]
    fn a_turned_cylinder_is_straight_across() {
        let cylinder = form(
            r#"{"kind": "cylinder", "radius_mm": 50, "rotation_deg": 30, "vertex_mm": [1, 2]}"#,
        );
        let (s, c) = 30_f64.to_radians().sin_cos();
        for (along, across) in [(0.0, 7.0), (20.0, -3.0), (-31.0, 0.0)] {
            let at = cylinder
                .point([1.0 + along * c - across * s, 2.0 + along * s + across * c])
                .unwrap();
            let want = 50.0 - (2500.0 - along * along).sqrt();
            // Rounding of 50 mm.
            assert!((at.sag_mm() - want).abs() < 1e-13);
            let [low, high] = at.principal_curvatures_per_mm();
            // Rounding of a difference of curvatures of 0.02 / mm.
            assert!(low.abs() < 1e-9 && (high * 50.0 - 1.0).abs() < 1e-9, "{low} {high}");
        }
    }

    /// The distance of every point from the circle that the middles of the circles over y make is |R_y|:
    /// `(sqrt(x^2 + (z - R_x)^2) - |R_x - R_y|)^2 + y^2 = R_y^2`, the equation of a torus about an axis along y.
    #[test]
    fn a_toroid_is_a_torus_with_its_radii() {
        for [x_mm, y_mm] in
            [[300e3_f64, 60.0], [400.0, 60.0], [-400.0, -60.0], [-400.0, 60.0], [80.0, 200.0]]
        {
            let json = format!(
                r#"{{"kind": "toroid", "radius_x_mm": {x_mm}, "radius_y_mm": {y_mm}, "vertex_mm": [1, -2]}}"#
            );
            let toroid = form(&json);
            for [x, y] in [[0.0, 0.0], [30.0, 0.0], [0.0, -25.0], [-50.0, 20.0]] {
                let z = toroid.sag_mm([1.0 + x, y - 2.0]).unwrap();
                let about = x_mm - x_mm.signum() * x.hypot(z - x_mm) - y_mm;
                // Rounding of 3e5 mm is 6e-11 mm; over 60 mm of the radius.
                assert!((about.hypot(y) / y_mm.abs() - 1.0).abs() < 5e-12, "{json} {x} {y}");
            }
            let mut radii = toroid.point([1.0, -2.0]).unwrap().hessian().map(|c| 1.0 / c);
            radii[1] = 0.0;
            // Quotients of the radii.
            assert!((radii[0] / x_mm - 1.0).abs() < 1e-14 && (radii[2] / y_mm - 1.0).abs() < 1e-14);
            assert!(toroid.sag_mm([1.0, 300.0]).is_none());
        }
    }

    #[test]
    fn zernike_terms_add_their_height() {
        let form = form(
            r#"{"kind": "plane", "zernike": {"numbering": "fringe", "centre_mm": [5, 0], "radius_mm": 20,
                "terms_nm": {"4": 100, "5": 30}}}"#,
        );
        // 100 (2 rho^2 - 1) + 30 rho^2 cos 2 phi
        let (x, y) = (8.0 / 20.0, -6.0 / 20.0);
        let want = 100.0 * (2.0 * (x * x + y * y) - 1.0) + 30.0 * (x * x - y * y);
        // Rounding of 100 nm.
        assert!((1e6 * form.sag_mm([13.0, -6.0]).unwrap() - want).abs() < 1e-12);
    }

    proptest! {
        /// The derivatives against differences: h^2 = 1e-6 times third derivatives below 1e-4, and rounding of 1e-13
        /// over h = 1e-3.
        #[test]
        fn gradient_and_hessian_are_derivatives(x in -20.0..20.0_f64, y in -20.0..20.0_f64, kind in 0..7_usize) {
            let form = form([
                r#"{"kind": "conic", "radius_mm": 120, "conic_constant": -2.1, "vertex_mm": [4, 1]}"#,
                r#"{"kind": "asphere", "radius_mm": 90, "conic_constant": 0.5, "even_terms": [1e-7, 1e-11]}"#,
                r#"{"kind": "elliptic-cylinder", "p_mm": 300, "q_mm": 150, "theta_mrad": 300, "rotation_deg": 20}"#,
                r#"{"kind": "hyperbolic-cylinder", "p_mm": 300, "q_mm": -150, "theta_mrad": 300}"#,
                r#"{"kind": "parabolic-cylinder", "q_mm": 150, "theta_mrad": 300}"#,
                r#"{"kind": "toroid", "radius_x_mm": 150, "radius_y_mm": -90, "rotation_deg": 20}"#,
                r#"{"kind": "conic", "radius_mm": 150, "conic_constant": -1.5, "off_axis_mm": [40, 10],
                    "height_along": "normal", "rotation_deg": -70}"#,
            ][kind]);
            let at = form.point([x, y]).unwrap();
            let h = 1e-3;
            for k in 0..2 {
                let moved = |by: f64| {
                    let mut p = [x, y];
                    p[k] += by;
                    form.point(p).unwrap()
                };
                let (up, down) = (moved(h), moved(-h));
                let slope = (up.sag_mm() - down.sag_mm()) / (2.0 * h);
                prop_assert!((slope - at.gradient()[k]).abs() < 1e-8, "{slope} {:?}", at.gradient());
                for j in 0..2 {
                    let second = (up.gradient()[j] - down.gradient()[j]) / (2.0 * h);
                    prop_assert!((second - at.hessian()[j + k]).abs() < 1e-8, "{second}");
                }
            }
        }
    }
}
