//! Paths whose pitch and step count along the surface of a curved part.
//!
//! A path is made in the coordinates (u, v) along the surface ([`planish_form::Development`]), over the clear aperture in
//! these coordinates, and then projected along z, point by point:
//!
//! ```text
//! aperture in (u, v)     the pixel (u, v) is valid where its place (x, y) lies in a valid pixel
//! path of the part       (x, y) = projection of the path in (u, v)
//! ```
//!
//! On a cylinder all lengths are kept. On a form with curvature in both directions [`AlongReport::stretches`] says by how
//! much a length along the surface differs from the same length in (u, v).

use ndarray::Array2;
use planish_form::{Development, Form};
use planish_types::{Axis, Grid, Invalid, Surface, ToolPath};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    region::{nearest_pixel, valid_mm},
    statistics::{PathStatistics, statistics},
};

/// Ratio of a length along the surface to its projection, or of lengths along the surface to those in (u, v) or the
/// inverse, above which a warning is given. Larger: users are not told of wider lines. Smaller: warnings for parts
/// where nothing can be seen.
const NOTEWORTHY: f64 = 1.05;

/// Largest number of valid pixels at which the ratios of lengths along the surface to those in (u, v) are computed;
/// they change slowly over a part. Larger: more time. Smaller: the extreme ratios may be missed.
const MOST_PLACES: usize = 400;

/// The surface of a curved part, along which a path is made. The coordinates (u, v) along it are unrolled about the
/// middle of the valid pixels.
#[derive(Clone, Debug)]
pub struct OnForm {
    form: Form,
    middle_mm: [f64; 2],
    size_mm: f64,
}

/// Report on a path that was made along a surface.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AlongReport {
    /// Lengths, steps and turns of the path in the coordinates (u, v) along the surface.
    pub along_surface: PathStatistics,
    /// Smallest (at most 1) and largest (at least 1) ratio of a length along the surface to the same length in the
    /// coordinates (u, v) in which the path was made, over the valid pixels.
    pub stretches: [f64; 2],
    /// Largest ratio of a length along the surface to its projection, over the valid pixels.
    pub largest_over_projection: f64,
}

impl AlongReport {
    /// Returns one sentence for each of two ratios that differs from 1 by more than 5 %: along the surface to
    /// projection, and along the surface to (u, v). Empty if none does.
    pub fn warnings(&self) -> Vec<String> {
        let [low, high] = self.stretches;
        let mut warnings = Vec::new();
        if self.largest_over_projection > NOTEWORTHY {
            warnings.push(format!(
                "lengths along the surface are up to {:.1} % longer than their projections; pitch and step count along the \
                 surface, and lie closer in projection by as much",
                100.0 * (self.largest_over_projection - 1.0)
            ));
        }
        if high.max(1.0 / low) > NOTEWORTHY {
            warnings.push(format!(
                "a part that is curved in both directions cannot be unrolled: pitch and step along the surface are between \
                 {low:.3} and {high:.3} of the given ones; a spiral keeps its pitch on a part that is round"
            ));
        }
        warnings
    }
}

impl OnForm {
    /// Makes the surface with the height `form` of a part whose valid pixels are those of `surface`. Refuses a form
    /// that is undefined at one of them, or in the middle of their extent.
    pub fn new(form: Form, surface: &Surface) -> Result<Self, Invalid> {
        form.check_over(surface)?;
        let [x, y] = bounding_box(&valid_mm(surface));
        let middle_mm = [0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1])];
        let on = Self { form, middle_mm, size_mm: (x[1] - x[0]).hypot(y[1] - y[0]) };
        on.development()?;
        Ok(on)
    }

    fn development(&self) -> Result<Development<'_>, Invalid> {
        Development::new(&self.form, self.middle_mm, self.size_mm)
    }

    /// Returns the largest ratio of a length along the surface to its projection over the valid pixels, `1 /
    /// cos(slope)`; pixels without a form do not count.
    fn largest_over_projection(&self, surface: &Surface) -> f64 {
        let places = valid_mm(surface).into_iter();
        let cosines = places.map(|p| self.form.point(p).map_or(1.0, |point| point.cosine()));
        1.0 / cosines.fold(1.0, f64::min)
    }

    /// Returns a warning for a path that was made in projection over a part with this form. Returns `None` if lengths
    /// along the surface are at most 5 % longer than in projection at all valid pixels.
    pub fn warning_of_projection(&self, surface: &Surface) -> Option<String> {
        let ratio = self.largest_over_projection(surface);
        if ratio <= NOTEWORTHY {
            return None;
        }
        Some(format!(
            "lengths along the surface are up to {:.1} % longer than their projections, in which pitch and step count \
   here; give `form`, and they count along the surface",
            100.0 * (ratio - 1.0)
        ))
    }

    /// Returns the map of the heights in the coordinates (u, v) along the surface, on pixels of the same pitch; NaN
    /// where a pixel does not lie on a valid one. Refuses a map without a valid pixel there.
    pub fn developed(&self, surface: &Surface) -> Result<Surface, Invalid> {
        let development = self.development()?;
        let grid = surface.grid();
        let border = border_mm(surface);
        let corners: Vec<[f64; 2]> = border.par_iter().map(|p| development.along(*p)).collect();
        let [u, v] = bounding_box(&corners);
        let wide = Grid { x: continued(&grid.x, u)?, y: continued(&grid.y, v)? };
        let (ny, nx) = wide.shape();
        let heights = (0..ny * nx).into_par_iter().map(|i| {
            let place =
                development.projected([wide.x.coordinate_mm(i % nx), wide.y.coordinate_mm(i / nx)]);
            nearest_pixel(grid, place).map_or(f64::NAN, |pixel| surface.height_nm()[pixel])
        });
        let heights =
            Array2::from_shape_vec((ny, nx), heights.collect()).expect("one height per pixel");
        Surface::new(wide, heights)
    }

    /// Moves the points of a path from the coordinates (u, v) along the surface to (x, y) of the part, along z. Refuses
    /// a result that is no valid path.
    pub fn projected(&self, path: &ToolPath) -> Result<ToolPath, Invalid> {
        let development = self.development()?;
        moved(path, |uv| development.projected(uv))
    }
    /// Converts a path of the part to the coordinates along the surface: the inverse of [`Self::projected`]. Refuses a
    /// result that is no valid path.
    pub fn unrolled(&self, path: &ToolPath) -> Result<ToolPath, Invalid> {
        let development = self.development()?;
        moved(path, |p| development.along(p))
    }

    /// Describes `path`, given in the coordinates (u, v) along the surface. `surface` is the map of the part in
    /// projection, `developed` the same map in (u, v). Refuses a form that is undefined in the middle of the part.
    pub fn report(
        &self,
        path: &ToolPath,
        surface: &Surface,
        developed: &Surface,
    ) -> Result<AlongReport, Invalid> {
        let development = self.development()?;
        let valid = valid_mm(surface);
        let taken = valid.len().min(MOST_PLACES);
        let stretches: Vec<[f64; 2]> = (0..taken)
            .into_par_iter()
            .filter_map(|k| {
                development.stretches(development.along(valid[k * valid.len() / taken]))
            })
            .collect();
        let stretches =
            stretches.iter().fold([1.0_f64; 2], |[low, high], v| [low.min(v[0]), high.max(v[1])]);
        Ok(AlongReport {
            along_surface: statistics(path, developed),
            stretches,
            largest_over_projection: self.largest_over_projection(surface),
        })
    }
}

/// Returns the path with its points and dwell points moved by the function `to`. Refuses a result that is no valid
/// path.
fn moved(path: &ToolPath, to: impl Fn([f64; 2]) -> [f64; 2] + Sync) -> Result<ToolPath, Invalid> {
    let [points, dwell_points] = [path.point_mm(), path.dwell_point_mm()]
        .map(|points| points.par_iter().map(|p| to(*p)).collect());
    ToolPath::new(points, dwell_points, path.tool_on().to_vec(), path.pass_idx().to_vec())
}

/// Returns the smallest and largest x, and the smallest and largest y, of the points, mm.
fn bounding_box(points: &[[f64; 2]]) -> [[f64; 2]; 2] {
    [0, 1].map(|k| {
        let values = points.iter().map(|p| p[k]);
        values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
    })
}

/// Returns the axis with pixels added on both sides, at the same pitch, so that it covers the coordinates from `low` to
/// `high`, mm.
fn continued(axis: &Axis, [low, high]: [f64; 2]) -> Result<Axis, Invalid> {
    let before = ((low - axis.start_mm()) / axis.step_mm() - 0.5).floor();
    let after = ((high - axis.start_mm()) / axis.step_mm() + 0.5).ceil();
    let start_mm = axis.coordinate_mm(0) + before * axis.step_mm();
    Axis::new(start_mm, axis.step_mm(), (after - before) as usize + 1)
}

/// Returns the centres [x, y] of the first and the last valid pixel of every row, and of every column, mm.
fn border_mm(surface: &Surface) -> Vec<[f64; 2]> {
    let z = surface.height_nm();
    let grid = surface.grid();
    let mut border = Vec::new();
    for (r, row) in z.outer_iter().enumerate() {
        let mut valid = (0..row.len()).filter(|c| !row[*c].is_nan());
        let ends = [valid.next(), valid.next_back()];
        border.extend(
            ends.into_iter().flatten().map(|c| [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)]),
        );
    }
    for (c, column) in z.columns().into_iter().enumerate() {
        let mut valid = (0..column.len()).filter(|r| !column[*r].is_nan());
        let ends = [valid.next(), valid.next_back()];
        border.extend(
            ends.into_iter().flatten().map(|r| [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)]),
        );
    }
    border
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RasterSettings, SpiralSettings, raster, spiral};

    fn disk(radius_mm: f64) -> Surface {
        let axis = Axis::new(-25.0, 0.5, 101).unwrap();
        let grid = Grid { x: axis, y: axis };
        let map = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            if axis.coordinate_mm(c).hypot(axis.coordinate_mm(r)) <= radius_mm {
                0.0
            } else {
                f64::NAN
            }
        });
        Surface::new(grid, map).unwrap()
    }

    fn cylinder(json: &str) -> Form {
        Form::new(&serde_json::from_str(json).unwrap(), None).unwrap()
    }

    /// Returns the report on `path`, given along the surface, over the map `part`.
    fn reported(on: &OnForm, path: &ToolPath, part: &Surface) -> AlongReport {
        on.report(path, part, &on.developed(part).unwrap()).unwrap()
    }

    #[test]
    fn lines_on_a_cylinder_are_one_pitch_apart_along_its_arc() {
        // Curved along y: the lines along x lie at equal arcs 30 asin(y / 30).
        let form = cylinder(r#"{"kind": "cylinder", "radius_mm": 30, "rotation_deg": 90}"#);
        let part = disk(24.0);
        let on = OnForm::new(form, &part).unwrap();
        let flat =
            raster(&on.developed(&part).unwrap(), &RasterSettings::new(1.0, 0.5, 0.0)).unwrap();
        let path = on.projected(&flat).unwrap();
        let mut arcs: Vec<f64> = (0..path.len())
            .filter(|i| path.displacement_mm(*i)[1].abs() < 1e-9)
            .map(|i| 30.0 * (path.dwell_point_mm()[i][1] / 30.0).asin())
            .collect();
        arcs.sort_by(f64::total_cmp);
        arcs.dedup_by(|a, b| (*a - *b).abs() < 1e-6);
        assert!(arcs.len() > 50, "{}", arcs.len());
        for pair in arcs.windows(2) {
            // Arcs on a cylinder keep 1e-10 mm (planish-form, development.rs).
            assert!((pair[1] - pair[0] - 1.0).abs() < 1e-9, "{pair:?}");
        }
        let report = reported(&on, &flat, &part);
        // Differences over 1e-3 mm are exact to 1e-7.
        assert!(report.stretches.iter().all(|s| (s - 1.0).abs() < 1e-6), "{:?}", report.stretches);
        // 1 / cos at 24 mm of 30 mm is 1 / 0.6.
        assert!((report.largest_over_projection - 1.0 / 0.6).abs() < 1e-9);
        assert_eq!(report.warnings().len(), 1);
        // The length along the surface is that of the chords in (u, v).
        assert!((report.along_surface.length_mm - statistics(&flat, &part).length_mm).abs() < 1e-9);
        let back = on.unrolled(&path).unwrap();
        for (a, b) in back.point_mm().iter().zip(flat.point_mm()) {
            // There and back: 1e-10 mm, twice.
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-9);
        }
    }

    #[test]
    fn turns_of_a_spiral_on_a_sphere_are_one_pitch_apart_along_its_arc() {
        let on = OnForm::new(Form::sphere(40.0, [0.0; 2]).unwrap(), &disk(20.0)).unwrap();
        let part = disk(20.0);
        let settings = SpiralSettings { pitch_mm: 1.0, step_mm: 0.5, overscan_mm: 0.0 };
        let flat = spiral(&on.developed(&part).unwrap(), &settings).unwrap();
        let path = on.projected(&flat).unwrap();
        let mut turns = 0.0;
        let mut first = None;
        for pair in path.point_mm().windows(2) {
            let [a, b] = [pair[0], pair[1]];
            turns += (a[0] * b[1] - a[1] * b[0]).atan2(a[0] * b[0] + a[1] * b[1])
                / std::f64::consts::TAU;
            let arc = 40.0 * (b[0].hypot(b[1]) / 40.0).asin();
            let offset = *first.get_or_insert(arc - turns);
            // Arcs on a sphere keep 1e-10 mm.
            assert!((arc - turns - offset).abs() < 1e-9, "{arc} {turns}");
        }
        // 30 degrees of slope at the edge: b / sin b = 1.047, and 1 / cos b = 1.155.
        let report = reported(&on, &flat, &part);
        let angle = 30_f64.to_radians();
        assert!((report.stretches[0] - angle.sin() / angle).abs() < 1e-4, "{:?}", report.stretches);
        // Rounding of a cosine.
        assert!((report.largest_over_projection - 1.0 / angle.cos()).abs() < 1e-9);
        assert!(on.warning_of_projection(&part).unwrap().contains("up to 15.5 % longer"));
    }

    #[test]
    fn on_a_plane_nothing_changes() {
        let part = disk(20.0);
        let plane = cylinder(r#"{"kind": "plane"}"#);
        let on = OnForm::new(plane, &part).unwrap();
        let path = raster(&part, &RasterSettings::new(1.0, 0.5, 2.0)).unwrap();
        let there = on.unrolled(&path).unwrap();
        for (a, b) in there.point_mm().iter().zip(path.point_mm()) {
            // Roundings of coordinates of 20 mm.
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-13, "{a:?} {b:?}");
        }
        assert!(on.warning_of_projection(&part).is_none());
        assert!(reported(&on, &there, &part).warnings().is_empty());
    }
}
