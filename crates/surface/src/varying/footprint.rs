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
//! K is the rate along z, and R the TIF as it was measured on a flat part. In (1), t1 is the axis x of the part,
//! projected onto the tangent plane at p, and t2 is perpendicular to it there. The first factor of (1) is the shorter
//! projection of the spot, and 1 / n_z turns the rate along the normal into that along z.
//!
//! In (2) rays leave a source at the distance D above the contact point, and e is how much deeper than this point the
//! part lies at x. A ray that passes the plane of the contact point at w was measured there under the angle a. On the part
//! its flux is lower by the square of the distances, and arrives under the angle b; Y is the yield by the angle. Without
//! a distance the rays are parallel, a is 0, and (2) is R(x - p) Y(b) / Y(0): in projection the footprint is unchanged.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | R, K | `tif` | nm/s |
//! | D | `source_distance_mm` | mm |
//! | Y | `rate_law` | 1 |

use ndarray::Array2;
use planish_form::Place;
use planish_types::{Axis, Grid, Invalid, Pose, Tif};

use super::{causes::RateLaw, place::Places};

/// Direction of a tool over a curved part.
#[derive(Clone, Debug, PartialEq)]
pub enum Direction {
    /// Along the normal at the contact point.
    Normal,
    /// Along z everywhere.
    Fixed {
        /// Yield by the angle of incidence.
        rate_law: RateLaw,
        /// Distance of the point from which the rays come, mm; `None` for parallel rays.
        source_distance_mm: Option<f64>,
    },
}

/// A tool on the form of a part.
#[derive(Debug)]
pub struct Footprint<'a> {
    tif: &'a Tif,
    places: &'a Places<'a>,
    direction: Direction,
    offsets: Grid,
}

/// Height and slopes of a part relative to the contact point.
struct Relative {
    height_mm: f64,
    gradient: [f64; 2],
}

impl<'a> Footprint<'a> {
    /// A tool of this direction; refuses a part without a form, and a source below the part.
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
            let slope = |p: &[f64; 2]| {
                let [x, y] =
                    form.nearest(*p, places.middle_mm()).map_or([0.0; 2], |f| f.gradient());
                x.hypot(y)
            };
            let [x, y] = tif.half_size_mm();
            let depth = places.border_mm().iter().map(slope).fold(0.0, f64::max) * x.hypot(y);
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

    /// Offsets of the samples.
    pub fn offsets(&self) -> Grid {
        self.offsets
    }

    /// Samples of the rate along z of a tool at a place, nm/s.
    pub fn at(&self, tool_mm: [f64; 2]) -> Array2<f64> {
        let form = self.places.form().expect("checked in the constructor");
        let here = form.at(tool_mm);
        let nearest = here.or_else(|| form.nearest(tool_mm, self.places.middle_mm()));
        let contact = nearest.expect("a form exists somewhere on the part");
        Array2::from_shape_fn(self.offsets.shape(), |(r, c)| {
            let u = [self.offsets.x.at(c), self.offsets.y.at(r)];
            // Beyond the part nothing is removed; there the form continues quadratically, so that the tool is smooth.
            let there = form.at([tool_mm[0] + u[0], tool_mm[1] + u[1]]).filter(|_| here.is_some());
            let relative = match there {
                Some(place) => Relative {
                    height_mm: place.sag_mm() - contact.sag_mm(),
                    gradient: place.gradient(),
                },
                None => continued(&contact, u),
            };
            self.rate(tool_mm, u, &contact, &relative)
        })
    }

    /// (1) or (2), nm/s.
    fn rate(&self, tool_mm: [f64; 2], u: [f64; 2], contact: &Place, at: &Relative) -> f64 {
        let [fx, fy] = at.gradient;
        let n_z = 1.0 / (1.0 + fx * fx + fy * fy).sqrt();
        match &self.direction {
            Direction::Normal => {
                let [p, _] = contact.gradient();
                let n = contact.normal();
                // t1 = (1, 0, p) / sqrt(1 + p^2),   t2 = n x t1
                let length = p.hypot(1.0);
                let d = [u[0], u[1], at.height_mm];
                let t1 = [1.0 / length, 0.0, p / length];
                let t2 = [
                    n[1] * t1[2] - n[2] * t1[1],
                    n[2] * t1[0] - n[0] * t1[2],
                    n[0] * t1[1] - n[1] * t1[0],
                ];
                let [a, b] = [t1, t2].map(|t| (0..3).map(|k| d[k] * t[k]).sum::<f64>());
                self.tif.rate_of_tool_at(Pose::along_x(tool_mm), [a, b]) / n_z
            }
            Direction::Fixed { rate_law, source_distance_mm: None } => {
                let angle = n_z.acos().to_degrees();
                self.tif.rate_of_tool_at(Pose::along_x(tool_mm), u) * rate_law.factor(angle)
                    / rate_law.factor(0.0)
            }
            Direction::Fixed { rate_law, source_distance_mm: Some(source) } => {
                let depth = source - at.height_mm;
                let scale = source / depth;
                let ray = u[0].hypot(u[1]).hypot(depth);
                // - n . r with r = (u, -depth) / |..|
                let cos_b = n_z * (depth + fx * u[0] + fy * u[1]) / ray;
                // Beyond the source, or turned away from it: only far beyond the part.
                if depth <= 0.0 || cos_b <= 0.0 {
                    return 0.0;
                }
                let cos_a = depth / ray;
                let angle = |cosine: f64| rate_law.factor(cosine.min(1.0).acos().to_degrees());
                let flux = scale * scale * cos_b / (n_z * cos_a);
                let measured =
                    self.tif.rate_of_tool_at(Pose::along_x(tool_mm), u.map(|v| v * scale));
                measured * flux * angle(cos_b) / angle(cos_a)
            }
        }
    }
}

/// Height and slopes at an offset from a place, by its Taylor polynomial of second order.
fn continued(contact: &Place, [x, y]: [f64; 2]) -> Relative {
    let ([p, q], [r, s, t]) = (contact.gradient(), contact.hessian());
    let (of_x, of_y) = (r * x + s * y, s * x + t * y);
    Relative {
        height_mm: p * x + q * y + 0.5 * (of_x * x + of_y * y),
        gradient: [p + of_x, q + of_y],
    }
}

/// A grid of the same pitch that is larger by a factor.
fn wider(grid: &Grid, factor: f64) -> Result<Grid, Invalid> {
    let axis = |axis: &Axis| {
        let size = axis.end_mm() - axis.start_mm();
        let more = (0.5 * (factor - 1.0) * size / axis.step_mm()).ceil();
        let start = axis.start_mm() - more * axis.step_mm();
        Axis::new(start, axis.step_mm(), axis.len() + 2 * more as usize)
    };
    Ok(Grid { x: axis(&grid.x)?, y: axis(&grid.y)? })
}
