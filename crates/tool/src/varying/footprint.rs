//! The footprint of a tool on a curved part, in the coordinates of the map.
//!
//! ```text
//! X(x) = (x, y, f(x, y)),   d = X(x) - X(p),   n = normal,   n_z = its component along z
//! along the normal    K(x; p) = R(d . t1, d . t2) / n_z(x)                                              (1)
//! fixed along z       K(x; p) = R(w) (D / (D + e))^2 c(x) / (n_z(x) cos a) Y(b) / Y(a)                  (2)
//!                     e = f(p) - f(x),   w = (x - p) D / (D + e),   tan a = |x - p| / (D + e)
//!                     c = cos b = - n . r,   r = direction of the ray at x
//! ```
//!
//! K is the rate along z, and R the TIF as it was measured on a flat part; p is the position of the tool, x a point of
//! the part. In (1), t1 and t2 are where the tilts of the machine ([`ToolFrame`]) turn the axes x and y of the TIF. The
//! first factor of (1) is the shorter projection of the spot, and 1 / n_z turns the rate along the normal into that
//! along z.
//!
//! In (2) rays leave a source at the distance D above the contact point, and e is how much deeper than this point the
//! part lies at x. A ray that passes the plane of the contact point at w was measured there under the angle a. On the
//! part its flux is lower by the square of the distances, and arrives under the angle b; Y is the yield by the angle.
//! Without a distance the rays are parallel, a is 0, and (2) is R(x - p) Y(b) / Y(0): in projection the footprint is
//! unchanged.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | R, K | `tif` | nm/s |
//! | D | `source_distance_mm` | mm |
//! | Y | `rate_law` | 1 |

use ndarray::Array2;
use planish_form::FormPoint;
use planish_types::{Axis, Grid, Invalid, Kinematics, Machine, Pose, Tif, Tilt, Transform};
use serde::Serialize;

use super::{causes::RateLaw, place::Places};

/// Direction of a tool over a curved part.
#[derive(Clone, Debug, PartialEq)]
pub enum Direction {
    /// Along the normal at the contact point, turned into it by the tilts of a machine.
    Normal(Box<ToolFrame>),
    /// Along z everywhere.
    Fixed {
        /// Law of the yield as a function of the angle of incidence, degrees (Y of the module).
        rate_law: RateLaw,
        /// Distance of the point from which the rays come, mm; `None` for parallel rays.
        source_distance_mm: Option<f64>,
    },
}

/// Rotary axis of a machine that carries the other rotary axis, with which it turns the tool to the normal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Carrier {
    /// The tilt about x carries the tilt about y.
    A,
    /// The tilt about y carries the tilt about x.
    B,
    /// A spindle turns the part, and a tilt in the plane of its radius tilts the tool.
    Spindle,
}

/// Directions to which the axes of the TIF turn when a machine turns its tool to the normal n of the part.
///
/// ```text
/// a carries b    t2 = (0, n_z, -n_y) / |..|,   t1 = t2 x n        the axis y of the tool stays in the plane of y and z
/// b carries a    t1 = (n_z, 0, -n_x) / |..|,   t2 = n x t1        the axis x stays in the plane of x and z         (3)
/// spindle        t = e - (e . n) (n + z) / (1 + n_z)               turned about the axis across the radius
/// ```
///
/// The first two differ by a turn about n, of about the product of the slopes along x and y, rad. (3) is in the
/// directions of the machine; the last one holds for a part that is a surface of revolution about the spindle.
#[derive(Clone, Debug, PartialEq)]
pub struct ToolFrame {
    carrier: Carrier,
    /// Transforms of directions from the part to the machine, and back; `None` if the axes of both coincide.
    to_machine: Option<(Transform, Transform)>,
}

impl ToolFrame {
    /// Makes the frame of a machine whose x and y are those of the part.
    pub fn of_carrier(carrier: Carrier) -> Self {
        Self { carrier, to_machine: None }
    }

    /// Makes the frame of a machine from its kinematics. Refuses one whose tool stays along z.
    pub fn of_machine(machine: &Machine) -> Result<Self, Invalid> {
        let carrier = match machine.kinematics() {
            Kinematics::Tilts { tilts: [Tilt::A, _], .. } => Carrier::A,
            Kinematics::Tilts { .. } => Carrier::B,
            Kinematics::Spindle { pivot_mm: Some(_), .. } => Carrier::Spindle,
            Kinematics::Xy | Kinematics::Xyz | Kinematics::Spindle { .. } => {
                let problem = "has no tilts, so that its tool stays along z";
                let remedy = "give `direction` fixed, or a machine with tilts";
                return Err(Invalid::whole("machine", problem, remedy));
            }
        };
        let to_machine = match machine.part_to_axes() {
            Some(there) => Some((there.clone(), there.inverse()?)),
            None => None,
        };
        Ok(Self { carrier, to_machine })
    }

    /// Returns the rotary axis of the machine that carries the other one.
    pub fn carrier(&self) -> Carrier {
        self.carrier
    }

    /// Returns the directions of the axes x and y of the TIF (t1 and t2 of the module) by (3). `n` is the unit normal
    /// of the part, and all directions are in coordinates of the part.
    fn axes(&self, n: [f64; 3]) -> [[f64; 3]; 2] {
        let Some((there, back)) = &self.to_machine else { return self.axes_on_machine(n) };
        let [nx, ny] = there.direction([n[0], n[1]]);
        let [t1, t2] = self.axes_on_machine([nx, ny, n[2]]);
        // An axis of the TIF is a sum of the directions of the machine.
        [[1.0, 0.0], [0.0, 1.0]].map(|axis| {
            let [along_x, along_y] = there.direction(axis);
            let t = [0, 1, 2].map(|k| along_x * t1[k] + along_y * t2[k]);
            let [x, y] = back.direction([t[0], t[1]]);
            [x, y, t[2]]
        })
    }

    fn axes_on_machine(&self, n: [f64; 3]) -> [[f64; 3]; 2] {
        match self.carrier {
            Carrier::A => {
                let length = n[1].hypot(n[2]);
                let t2 = [0.0, n[2] / length, -n[1] / length];
                [cross(t2, n), t2]
            }
            Carrier::B => {
                let length = n[0].hypot(n[2]);
                let t1 = [n[2] / length, 0.0, -n[0] / length];
                [t1, cross(n, t1)]
            }
            Carrier::Spindle => [0, 1].map(|k| {
                let by = n[k] / (1.0 + n[2]);
                let mut t = [-by * n[0], -by * n[1], -by * (n[2] + 1.0)];
                t[k] += 1.0;
                t
            }),
        }
    }
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// A tool on a curved part: its TIF in the coordinates of the map.
#[derive(Debug)]
pub struct Footprint<'a> {
    tif: &'a Tif,
    places: &'a Places<'a>,
    direction: Direction,
    offsets: Grid,
}

/// Largest number of positions at which two footprints are compared. Larger: more time. Smaller: a position with a
/// larger difference may be missed.
const MOST_COMPARED: usize = 64;

/// Height and slopes of a part at a point, relative to the contact point.
struct Relative {
    height_mm: f64,
    gradient: [f64; 2],
}

impl<'a> Footprint<'a> {
    /// Makes the footprint of `tif` on the part of `places`. Refuses a part without a form, and a source at a distance
    /// of at most twice the depth by which the part falls under the tool.
    pub fn new(
        tif: &'a Tif,
        places: &'a Places<'a>,
        direction: Direction,
    ) -> Result<Self, Invalid> {
        let Some(form) = places.form() else {
            let remedy = "give the form of the part: `sphere_radius_mm` or `form`";
            return Err(Invalid::whole("form", "is missing", remedy));
        };
        let mut offsets = *tif.grid();
        if let Direction::Fixed { source_distance_mm: Some(mm), .. } = direction {
            // Where the part falls away, the rays spread: by the largest slope over half the TIF.
            let slopes = places.border_mm().iter().map(|p| {
                let [x, y] =
                    form.nearest(*p, places.middle_mm()).map_or([0.0; 2], |f| f.gradient());
                x.hypot(y)
            });
            let [x, y] = tif.half_size_mm();
            let depth = slopes.fold(0.0, f64::max) * x.hypot(y);
            if !(mm.is_finite() && mm > 2.0 * depth) {
                let problem =
                    format!("is {mm}, and the part falls by {depth:.3} mm under the tool");
                let remedy = "give the distance of the source in mm, more than twice that depth";
                return Err(Invalid::whole("source_distance_mm", problem, remedy));
            }
            offsets = wider(&offsets, mm / (mm - depth))?;
        }
        Ok(Self { tif, places, direction, offsets })
    }

    /// Returns the grid of the offsets of the samples from the tool, mm.
    pub fn offsets(&self) -> Grid {
        self.offsets
    }

    /// Returns the largest difference between this footprint and `other` at the edge of the part: root mean square over
    /// the offsets, relative to this footprint.
    pub fn largest_difference(&self, other: &Self) -> f64 {
        let border = self.places.border_mm();
        let every = border.len().div_ceil(MOST_COMPARED).max(1);
        let differences = border.iter().step_by(every).map(|p| {
            let own = self.tool(*p);
            let [difference, own] = [&own - &other.tool(*p), own]
                .map(|samples| samples.iter().map(|v| v * v).sum::<f64>());
            (difference / own).sqrt()
        });
        differences.fold(0.0, f64::max)
    }
    /// Returns the samples of the removal rate along z for a tool at `tool_mm`, nm/s, on the offsets of
    /// [`Self::offsets`].
    pub fn tool(&self, tool_mm: [f64; 2]) -> Array2<f64> {
        let form = self.places.form().expect("checked in the constructor");
        let here = form.point(tool_mm);
        let nearest = here.or_else(|| form.nearest(tool_mm, self.places.middle_mm()));
        let contact = nearest.expect("a form exists somewhere on the part");
        Array2::from_shape_fn(self.offsets.shape(), |(r, c)| {
            let u = [self.offsets.x.coordinate_mm(c), self.offsets.y.coordinate_mm(r)];
            // Beyond the part nothing is removed; there the form continues quadratically, so that the tool is smooth.
            let there =
                form.point([tool_mm[0] + u[0], tool_mm[1] + u[1]]).filter(|_| here.is_some());
            let relative = match there {
                Some(point) => Relative {
                    height_mm: point.sag_mm() - contact.sag_mm(),
                    gradient: point.gradient(),
                },
                None => continued(&contact, u),
            };
            self.rate(tool_mm, u, &contact, &relative)
        })
    }

    /// Returns the removal rate along z at the offset `u` from the tool, nm/s, by (1) or (2) of the module.
    fn rate(
        &self,
        tool_mm: [f64; 2],
        u: [f64; 2],
        contact: &FormPoint,
        relative: &Relative,
    ) -> f64 {
        let [fx, fy] = relative.gradient;
        let n_z = 1.0 / (1.0 + fx * fx + fy * fy).sqrt();
        match &self.direction {
            Direction::Normal(frame) => {
                let d = [u[0], u[1], relative.height_mm];
                let axes = frame.axes(contact.normal());
                let [a, b] = axes.map(|t| (0..3).map(|k| d[k] * t[k]).sum::<f64>());
                self.tif.rate_of_tool_at(Pose::along_x(tool_mm), [a, b]) / n_z
            }
            Direction::Fixed { rate_law, source_distance_mm: None } => {
                let angle = n_z.acos().to_degrees();
                self.tif.rate_of_tool_at(Pose::along_x(tool_mm), u) * rate_law.factor(angle)
                    / rate_law.factor(0.0)
            }
            Direction::Fixed { rate_law, source_distance_mm: Some(source) } => {
                let depth = source - relative.height_mm;
                let scale = source / depth;
                let ray = u[0].hypot(u[1]).hypot(depth);
                // - n . r with r = (u, -depth) / |..|
                let cos_b = n_z * (depth + fx * u[0] + fy * u[1]) / ray;
                // Beyond the source, or turned away from it: only far beyond the part.
                if depth <= 0.0 || cos_b <= 0.0 {
                    return 0.0;
                }
                let cos_a = depth / ray;
                let [yield_a, yield_b] = [cos_a, cos_b]
                    .map(|cosine| rate_law.factor(cosine.min(1.0).acos().to_degrees()));
                let flux = scale * scale * cos_b / (n_z * cos_a);
                let measured =
                    self.tif.rate_of_tool_at(Pose::along_x(tool_mm), u.map(|v| v * scale));
                measured * flux * yield_b / yield_a
            }
        }
    }
}

/// Returns height and slopes, relative to the contact point, at the offset (x, y), mm, from it: the Taylor polynomial
/// of second order there.
fn continued(contact: &FormPoint, [x, y]: [f64; 2]) -> Relative {
    let [p, q] = contact.gradient();
    let [r, s, t] = contact.hessian();
    let [more_p, more_q] = [r * x + s * y, s * x + t * y];
    Relative {
        height_mm: p * x + q * y + 0.5 * (more_p * x + more_q * y),
        gradient: [p + more_p, q + more_q],
    }
}

/// Returns a grid of the same pitch whose size is larger by `factor`, about the same middle.
fn wider(grid: &Grid, factor: f64) -> Result<Grid, Invalid> {
    let [x, y] = [grid.x, grid.y].map(|axis| {
        let size = axis.end_mm() - axis.start_mm();
        let more = (0.5 * (factor - 1.0) * size / axis.step_mm()).ceil();
        let start = axis.start_mm() - more * axis.step_mm();
        Axis::new(start, axis.step_mm(), axis.len() + 2 * more as usize)
    });
    Ok(Grid { x: x?, y: y? })
}
