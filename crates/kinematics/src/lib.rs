//! Positions of the axes of a machine while its tool touches a point of a part, and the contact point of given
//! positions.
//!
//! ```text
//! X = (M p + o, f(p))     contact point on the machine: part_to_axes (M, o) and the form f
//! n = (M n_xy, n_z)       unit normal there, out of the material
//!
//! xy          x, y = X_x, X_y
//! xyz         x, y = X_x, X_y;  z = z0 + X_z
//! xyz-tilts   (x, y, z) = X + L n + (0, 0, z0 - L),  n = R (0, 0, 1)                                  (1)
//!             a carries b: R = Rx(a) Ry(b),  b = atan2(n_x, hypot(n_y, n_z)),  a = atan2(-n_y, n_z)   (2)
//!             b carries a: R = Ry(b) Rx(a),  a = atan2(-n_y, hypot(n_x, n_z)),  b = atan2(n_x, n_z)   (3)
//! spindle     c = atan2(X_y, X_x),  r = hypot(X_x, X_y);  z = z0 + X_z                                (4)
//!             with a tilt: b = atan2(n_r, n_z),  (r, z) += L (sin b, cos b - 1),  n_r = n . X_xy / r   (5)
//! ```
//!
//! The tool stands along n, out of the material; its pivot is the distance L from the contact point. Without a tilt,
//! the linear axes stand at the coordinates (or the radius) of the contact point, with z0 added to z. In (5) the tool
//! stays in the plane of the radius and z, so that it follows the part of the normal in this plane.
//! [`Contact::off_normal_deg`] is the angle between tool and normal.
//!
//! A point of the machine goes back to the part along the tool: the contact point is where the axis of the tool meets
//! the surface, and the gap is the distance from there to the tip of the tool.
//!
//! | symbol | meaning | unit |
//! |---|---|---|
//! | p | contact point in the plane of the part | mm |
//! | L | `pivot_mm` | mm |
//! | z0 | `part_origin_z_mm` | mm |
//! | a, b, c | rotary axes | deg |

mod series;

use planish_form::Form;
use planish_types::{Invalid, Kinematics, Machine, Tilt, Transform};

pub use series::Series;

/// Step of the difference that gives the third derivatives of the form, mm.
///
/// Larger: truncation, step^2 / 6 times the fifth derivative (below 1e-14 /mm^2 within 10 mm of the axis of a sphere of
/// radius 100 mm). Smaller: rounding of the second derivatives (1e-18 /mm) divided by the step, 1e-15 /mm^2. Derived:
/// both are far below the third derivatives that matter for a tilt.
const STEP_MM: f64 = 1e-3;

/// Distance from the centre of the spindle, mm, below which the direction of the motion, not that of the point, decides
/// on the angle c. Larger: the path's own azimuth is lost. Smaller: rounding of the coordinates decides. Chosen: far
/// below any count of an encoder.
pub const CENTRE_MM: f64 = 1e-9;

/// Change of the position along the tool at which the contact point has converged, mm. Larger: contact points are less
/// exact. Smaller: rounding of coordinates of 1 m keeps the steps going.
const CONVERGED_MM: f64 = 1e-12;

/// Largest number of Newton steps from the tip of the tool to the surface. Larger: no effect, they converge
/// quadratically. Smaller: tools far from the surface are given up.
const NEWTON_STEPS: usize = 30;

/// Map from a contact point on the part to the positions of the axes of a machine, and back.
#[derive(Clone, Debug)]
pub struct AxisMap {
    form: Form,
    kinematics: Kinematics,
    origin_z_mm: f64,
    to_axes: Option<(Transform, Transform)>,
    axes: usize,
}

/// Contact of the tool with the part at given positions of the axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Contact point [x, y] in the coordinates of the part, mm.
    pub point_mm: [f64; 2],
    /// Distance from the surface to the tip of the tool, along the tool, mm; positive if the tip is outside of the
    /// material. It is 0 for kinematics without an axis z.
    pub gap_mm: f64,
    /// Angle between the tool and the normal at the contact point, degrees. Without an axis z it is the slope of the
    /// form there, and 0 outside of the form.
    pub off_normal_deg: f64,
}

impl AxisMap {
    /// Builds the map from contact points on the part `form` to the axes of `machine`.
    ///
    /// # Errors
    ///
    /// Fails if the placement of the part on the machine has no inverse.
    pub fn new(machine: &Machine, form: &Form) -> Result<Self, Invalid> {
        let to_axes = match machine.part_to_axes() {
            Some(there) => Some((there.clone(), there.inverse()?)),
            None => None,
        };
        Ok(Self {
            form: form.clone(),
            kinematics: machine.kinematics().clone(),
            origin_z_mm: machine.part_origin_z_mm(),
            to_axes,
            axes: machine.axes().len(),
        })
    }

    /// Returns the number of axes of the machine.
    pub fn axes(&self) -> usize {
        self.axes
    }

    /// Returns the positions of the axes, mm and deg, in the order of the machine. The contact point is `p`, mm, in the
    /// coordinates of the part. The derivatives are by the parameter of `p`. `None` if the machine has an axis z and
    /// the form does not exist at `p`. The axis c of a spindle is between -180 and 180 deg.
    ///
    /// In the centre of a spindle, c is the azimuth of the direction in which the point moves, and 0 if it rests.
    pub fn positions(&self, p: [Series; 2]) -> Option<Vec<Series>> {
        let [x, y] = self.on_machine(p);
        let origin_z = Series::constant(self.origin_z_mm);
        Some(match &self.kinematics {
            Kinematics::Xy => vec![x, y],
            Kinematics::Xyz => vec![x, y, self.surface(p, false)?.0 + origin_z],
            Kinematics::Tilts { pivot_mm, tilts } => {
                let (z, [nx, ny, nz]) = self.surface(p, true)?;
                let (a, b) = match tilts[0] {
                    Tilt::A => (Series::angle([nz, -ny]), Series::angle([hypot(ny, nz), nx])),
                    Tilt::B => (Series::angle([hypot(nx, nz), -ny]), Series::angle([nz, nx])),
                };
                let [px, py, pz] = [(x, nx), (y, ny), (z, nz)].map(|(v, n)| v + n.times(*pivot_mm));
                let lowered = origin_z - Series::constant(*pivot_mm);
                vec![px, py, pz + lowered, degrees(a), degrees(b)]
            }
            Kinematics::Spindle { has_z, pivot_mm } => {
                let (r, c, [ux, uy]) = polar(x, y);
                match pivot_mm {
                    Some(pivot) => {
                        let (z, [nx, ny, nz]) = self.surface(p, true)?;
                        let nr = nx * ux + ny * uy;
                        let length = hypot(nr, nz);
                        let [pr, pz] =
                            [(r, nr), (z, nz)].map(|(v, n)| v + (n / length).times(*pivot));
                        let lowered = origin_z - Series::constant(*pivot);
                        let b = Series::angle([nz, nr]);
                        vec![pr, pz + lowered, degrees(c), degrees(b)]
                    }
                    None if *has_z => vec![r, self.surface(p, false)?.0 + origin_z, degrees(c)],
                    None => vec![r, degrees(c)],
                }
            }
        })
    }

    /// Returns the position of every axis, with its first and second derivative by the arc length in the plane of the
    /// part: mm or deg, per mm and per mm^2. The path goes through `point_mm` along the unit vector `tangent`, with
    /// this curvature (positive to the left). `None` if the machine has an axis z and the form does not exist there.
    pub fn along(
        &self,
        point_mm: [f64; 2],
        tangent: [f64; 2],
        curvature_per_mm: f64,
    ) -> Option<Vec<[f64; 3]>> {
        let left = [-tangent[1], tangent[0]];
        let p = [0, 1].map(|k| Series {
            value: point_mm[k],
            first: tangent[k],
            second: curvature_per_mm * left[k],
        });
        let axes = self.positions(p)?;
        Some(axes.iter().map(|q| [q.value, q.first, q.second]).collect())
    }

    /// Returns the contact of the tool where the axes are at `positions`, mm and deg. `None` if the search along the
    /// tool leaves the form or does not converge; never for a machine without an axis z.
    pub fn contact(&self, positions: &[f64]) -> Option<Contact> {
        let q = positions;
        let vertical = [0.0, 0.0, 1.0];
        let (tip, tool) = match &self.kinematics {
            Kinematics::Xy => {
                return Some(self.below_z(self.on_part([q[0], q[1]])));
            }
            Kinematics::Xyz => ([q[0], q[1], q[2] - self.origin_z_mm], vertical),
            Kinematics::Tilts { pivot_mm, tilts } => {
                let [[sa, ca], [sb, cb]] = [q[3], q[4]].map(sine_cosine);
                let tool = match tilts[0] {
                    Tilt::A => [sb, -sa * cb, ca * cb],
                    Tilt::B => [ca * sb, -sa, ca * cb],
                };
                let pivot = [q[0], q[1], q[2] - self.origin_z_mm + pivot_mm];
                ([0, 1, 2].map(|k| pivot[k] - pivot_mm * tool[k]), tool)
            }
            Kinematics::Spindle { has_z, pivot_mm } => {
                let [s, c] = sine_cosine(q[if *has_z { 2 } else { 1 }]);
                if !has_z {
                    return Some(self.below_z(self.on_part([q[0] * c, q[0] * s])));
                }
                let (pivot, [sb, cb]) = match pivot_mm {
                    Some(pivot) => (*pivot, sine_cosine(q[3])),
                    None => (0.0, [0.0, 1.0]),
                };
                let r = q[0] - pivot * sb;
                let z = q[1] - self.origin_z_mm + pivot * (1.0 - cb);
                ([r * c, r * s, z], [sb * c, sb * s, cb])
            }
        };
        // h(l) = z of tip + l tool, minus the form below it;  h' = tool_z - grad f . tool_xy
        let direction = self.direction_on_part([tool[0], tool[1]]);
        let mut l = 0.0;
        for _ in 0..NEWTON_STEPS {
            let point_mm = self.on_part([tip[0] + l * tool[0], tip[1] + l * tool[1]]);
            let place = self.form.point(point_mm)?;
            let [fx, fy] = place.gradient();
            let slope = tool[2] - fx * direction[0] - fy * direction[1];
            let step = (tip[2] + l * tool[2] - place.sag_mm()) / slope;
            if step.abs() <= CONVERGED_MM * (1.0 + tip[2].abs()) {
                // tan of the angle = |n x tool| / n . tool
                let n = place.normal();
                let tool = [direction[0], direction[1], tool[2]];
                let dot = (0..3).map(|k| n[k] * tool[k]).sum::<f64>();
                let cross = [1, 2, 0].map(|i: usize| {
                    let j = (i + 1) % 3;
                    let k = (i + 2) % 3;
                    n[j] * tool[k] - n[k] * tool[j]
                });
                let sine = cross.iter().map(|v| v * v).sum::<f64>().sqrt();
                let off_normal_deg = sine.atan2(dot).to_degrees();
                return Some(Contact { point_mm, gap_mm: -l, off_normal_deg });
            }
            l -= step;
        }
        None
    }

    /// Returns the contact at `point_mm`, in the coordinates of the part, of a machine without an axis z; its tool is
    /// parallel to z.
    fn below_z(&self, point_mm: [f64; 2]) -> Contact {
        let off_normal_deg = self.form.point(point_mm).map_or(0.0, |place| place.slope_deg());
        Contact { point_mm, gap_mm: 0.0, off_normal_deg }
    }

    /// Returns the distance of a contact point, given in the coordinates of the part, from the axis of the spindle, mm.
    pub fn radius_mm(&self, point_mm: [f64; 2]) -> f64 {
        let [x, y] = self.on_machine(point_mm.map(Series::constant));
        x.value.hypot(y.value)
    }

    /// Returns the height of the form at `p`, mm, and its unit normal in the directions of the machine. The normal is
    /// zero unless `normal` is true; `None` if the form does not exist there.
    fn surface(&self, p: [Series; 2], normal: bool) -> Option<(Series, [Series; 3])> {
        let at = p.map(|v| v.value);
        let place = self.form.point(at)?;
        let gradient = place.gradient();
        let hessian = place.hessian();
        let v = p.map(|s| s.first);
        let w = p.map(|s| s.second);
        let bent = times(hessian, v);
        // f' = grad f . p',  f'' = grad f . p'' + p' H p'
        let f = Series {
            value: place.sag_mm(),
            first: gradient[0] * v[0] + gradient[1] * v[1],
            second: gradient[0] * w[0] + gradient[1] * w[1] + bent[0] * v[0] + bent[1] * v[1],
        };
        if !normal {
            return Some((f, [Series::default(); 3]));
        }
        // (grad f)' = H p',  (grad f)'' = H p'' + H' p'
        let change = times(self.hessian_change(at, v)?, v);
        let turned = times(hessian, w);
        let slope = [0, 1].map(|k| Series {
            value: gradient[k],
            first: bent[k],
            second: turned[k] + change[k],
        });
        let one = Series::constant(1.0);
        let nz = one / (one + slope[0] * slope[0] + slope[1] * slope[1]).sqrt();
        let [nx, ny] = slope.map(|s| -(s * nz));
        let [nx, ny] = match &self.to_axes {
            None => [nx, ny],
            Some((there, _)) => there.matrix().map(|row| nx.times(row[0]) + ny.times(row[1])),
        };
        Some((f, [nx, ny, nz]))
    }

    /// Returns the derivative of the second derivatives of the form (xx, xy, yy) by the parameter of a point that moves
    /// with the velocity `v`. It is a difference over [`STEP_MM`] on both sides, or on one where the form ends. It is 0
    /// if the form exists on neither side, and `None` if it does not exist at `at`.
    fn hessian_change(&self, at: [f64; 2], v: [f64; 2]) -> Option<[f64; 3]> {
        let speed = v[0].hypot(v[1]);
        if speed == 0.0 {
            return Some([0.0; 3]);
        }
        let beside = |d: f64| {
            let place = self.form.point([0, 1].map(|k| at[k] + d * v[k] / speed))?;
            Some((d, place.hessian()))
        };
        let (d0, h0) = beside(-STEP_MM).or_else(|| beside(0.0))?;
        let (d1, h1) = beside(STEP_MM).or_else(|| beside(0.0))?;
        if d0 == d1 {
            return Some([0.0; 3]);
        }
        Some([0, 1, 2].map(|k| (h1[k] - h0[k]) / (d1 - d0) * speed))
    }

    fn on_machine(&self, p: [Series; 2]) -> [Series; 2] {
        let Some((there, _)) = &self.to_axes else { return p };
        let [x, y] = there.point(p.map(|s| s.value));
        let [dx, dy] = there.direction(p.map(|s| s.first));
        let [ddx, ddy] = there.direction(p.map(|s| s.second));
        [Series { value: x, first: dx, second: ddx }, Series { value: y, first: dy, second: ddy }]
    }

    fn on_part(&self, q: [f64; 2]) -> [f64; 2] {
        self.to_axes.as_ref().map_or(q, |(_, back)| back.point(q))
    }

    fn direction_on_part(&self, v: [f64; 2]) -> [f64; 2] {
        self.to_axes.as_ref().map_or(v, |(_, back)| back.direction(v))
    }
}

/// Returns the product of a symmetric matrix, given by its elements xx, xy and yy, with a vector.
fn times([xx, xy, yy]: [f64; 3], v: [f64; 2]) -> [f64; 2] {
    [xx * v[0] + xy * v[1], xy * v[0] + yy * v[1]]
}

/// Returns the radius, mm, the azimuth, rad, and the unit vector along the radius of the point (x, y), mm. Within
/// [`CENTRE_MM`] of the origin the direction of the motion decides on azimuth and unit vector; at rest there the
/// azimuth is 0.
fn polar(x: Series, y: Series) -> (Series, Series, [Series; 2]) {
    if x.value.hypot(y.value) >= CENTRE_MM {
        let r = hypot(x, y);
        return (r, Series::angle([x, y]), [x / r, y / r]);
    }
    // p = v t + w t^2 / 2: the azimuth is that of v + w t / 2, and the radius is |v t + w t^2 / 2|.
    let speed = x.first.hypot(y.first);
    if speed == 0.0 {
        let one = Series::constant(1.0);
        return (Series::default(), Series::default(), [one, Series::default()]);
    }
    let [vx, vy] = [x.first / speed, y.first / speed];
    let across = vx * y.second - vy * x.second;
    let azimuth = Series { value: vy.atan2(vx), first: 0.5 * across / speed, second: 0.0 };
    let r = Series { value: 0.0, first: speed, second: vx * x.second + vy * y.second };
    let turned = azimuth.first;
    let unit = [
        Series { value: vx, first: -turned * vy, second: 0.0 },
        Series { value: vy, first: turned * vx, second: 0.0 },
    ];
    (r, azimuth, unit)
}

fn hypot(x: Series, y: Series) -> Series {
    (x * x + y * y).sqrt()
}

fn degrees(angle: Series) -> Series {
    angle.times(1_f64.to_degrees())
}

fn sine_cosine(angle_deg: f64) -> [f64; 2] {
    let (sine, cosine) = angle_deg.to_radians().sin_cos();
    [sine, cosine]
}
