//! Parameters of a place, a point [x, y] of the part: coordinates, radius, distance to the edge, and incidence.

use planish_form::Form;
use planish_types::{Invalid, Surface};
use serde::Serialize;

/// Parameter of a place on which a tool depends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
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

/// A part given by its map and form, at whose points the parameters are computed.
#[derive(Debug)]
pub struct Places<'a> {
    surface: &'a Surface,
    form: Option<Form>,
    middle_mm: [f64; 2],
    /// Centres of the valid pixels that have an invalid or no neighbour, mm.
    border_mm: Vec<[f64; 2]>,
}

impl<'a> Places<'a> {
    /// Makes the places of the part with the valid pixels of `surface`, without a form.
    pub fn new(surface: &'a Surface) -> Self {
        let z = surface.height_nm();
        let grid = surface.grid();
        let all = z.indexed_iter().filter(|(_, z)| !z.is_nan()).map(|(place, _)| place);
        let none = ([usize::MAX; 2], [0; 2]);
        let (low, high) = all.clone().fold(none, |(low, high), (r, c)| {
            ([low[0].min(c), low[1].min(r)], [high[0].max(c), high[1].max(r)])
        });
        let middle_mm = [(&grid.x, 0), (&grid.y, 1)]
            .map(|(axis, k)| 0.5 * (axis.coordinate_mm(low[k]) + axis.coordinate_mm(high[k])));
        let border = all.filter(|&(r, c)| {
            let neighbours =
                [(r + 1, c), (r.wrapping_sub(1), c), (r, c + 1), (r, c.wrapping_sub(1))];
            neighbours.iter().any(|n| z.get(*n).is_none_or(|z| z.is_nan()))
        });
        let border_mm =
            border.map(|(r, c)| [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)]).collect();
        Self { surface, form: None, middle_mm, border_mm }
    }

    /// Adds a form: a sphere of this radius of curvature, mm, with its vertex in the middle of the valid pixels.
    /// Refuses a sphere that is smaller than the part.
    pub fn on_sphere(self, radius_mm: f64) -> Result<Self, Invalid> {
        let name = "sphere_radius_mm";
        let remedy = "give a radius of curvature in mm";
        let sphere = Form::sphere(radius_mm, self.middle_mm)
            .map_err(|_| Invalid::whole(name, format!("is {radius_mm}"), remedy))?;
        let reach = self.radius_mm();
        if reach >= radius_mm.abs() {
            let problem = format!("is {radius_mm} mm, but the map reaches {reach} mm");
            let remedy = "give the radius of curvature, which is larger than the part";
            return Err(Invalid::whole(name, problem, remedy));
        }
        Ok(Self { form: Some(sphere), ..self })
    }

    /// Adds the form of the part. Refuses one that is undefined at a valid pixel, because its slope there would be a
    /// guess.
    pub fn with_form(self, form: Form) -> Result<Self, Invalid> {
        form.check_over(self.surface)?;
        Ok(Self { form: Some(form), ..self })
    }

    /// Returns the form of the part; `None` if it has none.
    pub fn form(&self) -> Option<&Form> {
        self.form.as_ref()
    }

    /// Returns the distance of a point from the middle of the valid pixels, mm.
    fn radius_mm_of(&self, [x, y]: [f64; 2]) -> f64 {
        (x - self.middle_mm[0]).hypot(y - self.middle_mm[1])
    }

    /// Returns the middle of the valid pixels [x, y], mm.
    pub fn middle_mm(&self) -> [f64; 2] {
        self.middle_mm
    }

    /// Returns the largest distance of a valid pixel from the middle, mm.
    pub fn radius_mm(&self) -> f64 {
        self.border_mm.iter().map(|q| self.radius_mm_of(*q)).fold(0.0, f64::max)
    }

    /// Returns the larger side of a pixel, mm.
    pub fn pixel_mm(&self) -> f64 {
        self.surface.grid().x.step_mm().max(self.surface.grid().y.step_mm())
    }

    /// Returns the area of the valid pixels, mm^2.
    pub fn valid_mm2(&self) -> f64 {
        let valid = self.surface.height_nm().iter().filter(|z| !z.is_nan()).count();
        valid as f64 * self.surface.grid().pixel_mm2()
    }

    /// Returns the centres of valid pixels [x, y], mm, on a lattice whose distance is at most `apart_mm`, but at least
    /// one pixel.
    pub fn valid_places(&self, apart_mm: f64) -> Vec<[f64; 2]> {
        let grid = self.surface.grid();
        let [every_x, every_y] =
            [&grid.x, &grid.y].map(|axis| ((apart_mm / axis.step_mm()) as usize).max(1));
        let valid = self.surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan());
        valid
            .filter(|((r, c), _)| r % every_y == 0 && c % every_x == 0)
            .map(|((r, c), _)| [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)])
            .collect()
    }

    /// Returns the centres [x, y] of the valid pixels that have an invalid or no neighbour, mm.
    pub fn border_mm(&self) -> &[[f64; 2]] {
        &self.border_mm
    }

    /// Returns true if a point lies in a valid pixel.
    fn is_on_part(&self, [x, y]: [f64; 2]) -> bool {
        let grid = self.surface.grid();
        let [c, r] = [(&grid.x, x), (&grid.y, y)]
            .map(|(axis, mm)| ((mm - axis.start_mm()) / axis.step_mm()).round());
        self.is_valid(r, c)
    }
    /// Returns true if the pixel of this row and column exists and is valid.
    fn is_valid(&self, r: f64, c: f64) -> bool {
        let z = self.surface.height_nm();
        r >= 0.0 && c >= 0.0 && z.get((r as usize, c as usize)).is_some_and(|z| !z.is_nan())
    }

    /// Returns how far a point (mm) counts as on the part, 0 to 1: bilinear between the centres of the pixels, with 1
    /// at a valid one and 0 at an invalid one or beyond the map.
    pub fn covered(&self, [x, y]: [f64; 2]) -> f64 {
        let grid = self.surface.grid();
        let [(c, fx), (r, fy)] = [(&grid.x, x), (&grid.y, y)].map(|(axis, mm)| {
            let s = (mm - axis.start_mm()) / axis.step_mm();
            (s.floor(), s - s.floor())
        });
        let [lower, upper] = [r, r + 1.0].map(|r| {
            let [left, right] = [c, c + 1.0].map(|c| f64::from(u8::from(self.is_valid(r, c))));
            (1.0 - fx) * left + fx * right
        });
        (1.0 - fy) * lower + fy * upper
    }

    /// Returns the value of a parameter at the point `p` of the part, in mm, or degrees for the incidence. Where the
    /// form does not exist at `p`, the incidence is that of its nearest point. Refuses the incidence on a part without
    /// a form, or with one that exists neither at `p` nor in the middle.
    pub fn parameter(&self, parameter: Parameter, p: [f64; 2]) -> Result<f64, Invalid> {
        Ok(match parameter {
            Parameter::X => p[0],
            Parameter::Y => p[1],
            Parameter::Radius => self.radius_mm_of(p),
            Parameter::EdgeDistance => {
                let distances = self.border_mm.iter().map(|q| (p[0] - q[0]).hypot(p[1] - q[1]));
                let nearest = distances.fold(f64::INFINITY, f64::min);
                // The edge is half a pixel outside of the centres of the border.
                let half =
                    0.25 * (self.surface.grid().x.step_mm() + self.surface.grid().y.step_mm());
                if self.is_on_part(p) { nearest + half } else { -(nearest - half).max(0.0) }
            }
            Parameter::Incidence => {
                let Some(form) = &self.form else {
                    let remedy = "give the form of the part: `sphere_radius_mm` or `form`";
                    return Err(Invalid::whole("by", "is incidence, without a form", remedy));
                };
                // Beyond the part the tool sees the nearest place of the form.
                let Some(point) = form.nearest(p, self.middle_mm) else {
                    let [x, y] = self.middle_mm;
                    let problem =
                        format!("does not exist in the middle of the part, ({x}, {y}) mm");
                    return Err(Invalid::whole(
                        "form",
                        problem,
                        "give a form that covers the part",
                    ));
                };
                point.slope_deg()
            }
        })
    }
}
