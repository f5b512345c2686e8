//! Parameters of a place of the part.

use planish_types::{Axis, Grid, Invalid, Surface};
use serde::Serialize;

/// Parameter of a place on which a tool depends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "kebab-case")]
pub enum Parameter {
    /// Coordinate x, mm.
    X,
    /// Coordinate y, mm.
    Y,
    /// Distance from the middle of the valid pixels, mm.
    Radius,
    /// Distance to the edge of the valid pixels, mm; negative outside.
    EdgeDistance,
    /// Angle between the axis z and the normal of the part, degrees; needs its form.
    Incidence,
}

/// Form of the part: its height along z, as far as its slopes matter.
#[derive(Clone, Debug)]
pub enum Form {
    /// Sphere of this radius of curvature, mm, whose vertex is in the middle of the valid pixels.
    Sphere {
        /// Radius of curvature, mm; its sign does not matter.
        radius_mm: f64,
    },
    /// Measured or computed height, nm, on its own pixels.
    Sampled(Surface),
}

/// A map whose places have parameters.
#[derive(Debug)]
pub struct Places<'a> {
    surface: &'a Surface,
    form: Option<&'a Form>,
    middle_mm: [f64; 2],
    /// Valid pixels with an invalid or no neighbour.
    border_mm: Vec<[f64; 2]>,
}

impl<'a> Places<'a> {
    /// Places of the map `surface`, of a part with this form.
    pub fn new(surface: &'a Surface, form: Option<&'a Form>) -> Result<Self, Invalid> {
        if let Some(Form::Sphere { radius_mm }) = form
            && !(radius_mm.is_finite() && *radius_mm != 0.0)
        {
            let remedy = "give a radius of curvature in mm";
            return Err(Invalid::whole("sphere_radius_mm", format!("is {radius_mm}"), remedy));
        }
        let (z, grid) = (surface.height_nm(), surface.grid());
        let (ny, nx) = grid.shape();
        let valid = |r: isize, c: isize| {
            let inside = (0..ny as isize).contains(&r) && (0..nx as isize).contains(&c);
            inside && !z[[r as usize, c as usize]].is_nan()
        };
        let all = z.indexed_iter().filter(|(_, z)| !z.is_nan()).map(|(place, _)| place);
        let none = ([usize::MAX; 2], [0; 2]);
        let (low, high) = all.clone().fold(none, |(low, high), (r, c)| {
            ([low[0].min(c), low[1].min(r)], [high[0].max(c), high[1].max(r)])
        });
        let middle = |axis: &Axis, k: usize| 0.5 * (axis.at(low[k]) + axis.at(high[k]));
        let border = all.filter(|&(r, c)| {
            let (r, c) = (r as isize, c as isize);
            ![(1, 0), (-1, 0), (0, 1), (0, -1)].iter().all(|(i, k)| valid(r + i, c + k))
        });
        let border_mm = border.map(|(r, c)| [grid.x.at(c), grid.y.at(r)]).collect();
        Ok(Self { surface, form, middle_mm: [middle(&grid.x, 0), middle(&grid.y, 1)], border_mm })
    }

    /// Middle of the valid pixels [x, y], mm.
    pub fn middle_mm(&self) -> [f64; 2] {
        self.middle_mm
    }

    /// Largest distance of a valid pixel from the middle, mm.
    pub fn radius_mm(&self) -> f64 {
        let from = |q: &[f64; 2]| (q[0] - self.middle_mm[0]).hypot(q[1] - self.middle_mm[1]);
        self.border_mm.iter().map(from).fold(0.0, f64::max)
    }

    /// Returns true if a point lies in a valid pixel.
    fn is_on_part(&self, [x, y]: [f64; 2]) -> bool {
        let grid = self.surface.grid();
        let pixel = |axis: &Axis, mm: f64| {
            let i = ((mm - axis.start_mm()) / axis.step_mm()).round();
            (i >= 0.0 && i < axis.len() as f64).then_some(i as usize)
        };
        let (r, c) = (pixel(&grid.y, y), pixel(&grid.x, x));
        matches!((r, c), (Some(r), Some(c)) if !self.surface.height_nm()[[r, c]].is_nan())
    }

    /// Part of a pixel around a point that is valid, from 0 to 1: linear between the centres of the pixels.
    pub fn covered(&self, [x, y]: [f64; 2]) -> f64 {
        let (z, grid) = (self.surface.height_nm(), self.surface.grid());
        let cell = |axis: &Axis, mm: f64| {
            let s = (mm - axis.start_mm()) / axis.step_mm();
            (s.floor(), s - s.floor())
        };
        let ((c, fx), (r, fy)) = (cell(&grid.x, x), cell(&grid.y, y));
        let valid = |r: f64, c: f64| {
            let inside = r >= 0.0 && c >= 0.0 && r < grid.y.len() as f64 && c < grid.x.len() as f64;
            f64::from(u8::from(inside && !z[[r as usize, c as usize]].is_nan()))
        };
        let row = |r: f64| (1.0 - fx) * valid(r, c) + fx * valid(r, c + 1.0);
        (1.0 - fy) * row(r) + fy * row(r + 1.0)
    }

    /// A parameter at a point of the part, in its unit.
    pub fn parameter(&self, parameter: Parameter, p: [f64; 2]) -> Result<f64, Invalid> {
        let from_middle = [p[0] - self.middle_mm[0], p[1] - self.middle_mm[1]];
        let radius = from_middle[0].hypot(from_middle[1]);
        Ok(match parameter {
            Parameter::X => p[0],
            Parameter::Y => p[1],
            Parameter::Radius => radius,
            Parameter::EdgeDistance => {
                let to = |q: &[f64; 2]| (p[0] - q[0]).hypot(p[1] - q[1]);
                let nearest = self.border_mm.iter().map(to).fold(f64::INFINITY, f64::min);
                // The edge is half a pixel outside of the centres of the border.
                let half =
                    0.25 * (self.surface.grid().x.step_mm() + self.surface.grid().y.step_mm());
                if self.is_on_part(p) { nearest + half } else { -(nearest - half).max(0.0) }
            }
            Parameter::Incidence => match self.form {
                Some(Form::Sphere { radius_mm }) => {
                    let sine = radius / radius_mm.abs();
                    if sine >= 1.0 {
                        let problem = format!("is {radius_mm} mm, but the map reaches {radius} mm");
                        let remedy = "give the radius of curvature, which is larger than the part";
                        return Err(Invalid::whole("sphere_radius_mm", problem, remedy));
                    }
                    sine.asin().to_degrees()
                }
                Some(Form::Sampled(form)) => slope(form, p).atan().to_degrees(),
                None => {
                    let remedy = "give the form of the part: `sphere_radius_mm` or `form`";
                    return Err(Invalid::whole("by", "is incidence, without a form", remedy));
                }
            },
        })
    }
}

/// Magnitude of the slope of a form at a point, mm/mm, by differences of its pixels around it; at its border and beyond
/// by those of the nearest pixels.
fn slope(form: &Surface, [x, y]: [f64; 2]) -> f64 {
    let (z, Grid { x: of_x, y: of_y }) = (form.height_nm(), form.grid());
    let cell = |axis: &Axis, mm: f64| {
        let s = ((mm - axis.start_mm()) / axis.step_mm()).clamp(0.0, (axis.len() - 1) as f64);
        let i = (s as usize).min(axis.len() - 2);
        (i, s - i as f64)
    };
    let ((c, fx), (r, fy)) = (cell(of_x, x), cell(of_y, y));
    // The bilinear form in the cell, nm.
    let [a, b, d, e] = [z[[r, c]], z[[r, c + 1]], z[[r + 1, c]], z[[r + 1, c + 1]]];
    let along_x = ((1.0 - fy) * (b - a) + fy * (e - d)) / of_x.step_mm();
    let along_y = ((1.0 - fx) * (d - a) + fx * (e - b)) / of_y.step_mm();
    let slope = 1e-6 * along_x.hypot(along_y);
    if slope.is_nan() { 0.0 } else { slope }
}
