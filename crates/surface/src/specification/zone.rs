//! Zones of a mirror, and the pixels in them.
//!
//! ```text
//! `inside_mm`: w      the valid pixels at least w from the outline
//! `edge_mm`: w        the valid pixels nearer than w to it
//! ```
//!
//! The outline is where valid pixels meet the rim of the map or invalid pixels that reach to it: a hole in the
//! middle has no edge zone. A pixel is half a step wide about its centre.

use ndarray::{Array2, s};
use planish_types::{Axis, ClearAperture, Grid, Invalid, Surface};
use serde::{Deserialize, Serialize};

use crate::{distance::to_marked, quality::Subject};

/// Part of a mirror. It has exactly one of the keys other than the name, or `x_mm` and `y_mm` together.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "zone")]
pub struct Zone {
    /// Name by which limits refer to the zone.
    pub name: String,
    /// Smallest and largest x, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub x_mm: Option<[f64; 2]>,
    /// Smallest and largest y, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub y_mm: Option<[f64; 2]>,
    /// Centre x, centre y and radius of a circle, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub circle_mm: Option<[f64; 3]>,
    /// Smallest distance of a pixel from the outline, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inside_mm: Option<f64>,
    /// Distance of a pixel from the outline below which it is in the zone, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edge_mm: Option<f64>,
}

impl Zone {
    /// Refuses zone `i` of the specification if it is described in no or in several ways, a range that does not ascend,
    /// and a length that is not above 0.
    pub(super) fn check(&self, i: usize) -> Result<(), Invalid> {
        let rectangle = self.x_mm.is_some() || self.y_mm.is_some();
        let kinds =
            [rectangle, self.circle_mm.is_some(), self.inside_mm.is_some(), self.edge_mm.is_some()];
        let count = kinds.iter().filter(|is_there| **is_there).count();
        if count != 1 {
            let problem = format!("\"{}\" is described in {count} ways", self.name);
            let remedy =
                "give x_mm and y_mm (or one of them), or circle_mm, or inside_mm, or edge_mm";
            return Err(Invalid::at_index("zones", i, problem, remedy));
        }
        let ranges = [("x_mm", self.x_mm), ("y_mm", self.y_mm)];
        for (key, [low, high]) in ranges.iter().filter_map(|(k, r)| r.map(|r| (k, r))) {
            if !(low.is_finite() && high.is_finite() && low < high) {
                let problem = format!("{key} is {low} .. {high}");
                let remedy = "give finite smallest < largest in mm";
                return Err(Invalid::at_index("zones", i, problem, remedy));
            }
        }
        let sizes = [
            ("the radius of circle_mm", self.circle_mm.map(|c| c[2])),
            ("inside_mm", self.inside_mm),
            ("edge_mm", self.edge_mm),
        ];
        for (key, mm) in sizes.iter().filter_map(|(k, v)| v.map(|v| (k, v))) {
            if !(mm.is_finite() && mm > 0.0) {
                let problem = format!("{key} is {mm}");
                return Err(Invalid::at_index("zones", i, problem, "give a length in mm, above 0"));
            }
        }
        Ok(())
    }
}

/// Zones of a mirror as masks, each of which is computed once.
pub(super) struct Zones<'a> {
    /// Map or profile of the mirror.
    pub subject: &'a Subject,
    zones: &'a [Zone],
    /// Distance of every pixel from the outline (ny, nx), mm; `None` until a zone needs it.
    outline: Option<Array2<f64>>,
    /// Masks that were computed so far, with the names of their zones.
    masks: Vec<(String, Array2<bool>)>,
}

impl<'a> Zones<'a> {
    /// Returns the zones, of which no mask is computed before it is asked for.
    pub fn new(subject: &'a Subject, zones: &'a [Zone]) -> Self {
        Self { subject, zones, outline: None, masks: Vec::new() }
    }

    /// Returns the mask of the zone `name`, one of the given zones, true at valid pixels in it. Refuses a circle on a
    /// profile, and a zone without a valid pixel.
    pub fn mask(&mut self, name: &str) -> Result<Array2<bool>, Invalid> {
        if let Some((_, mask)) = self.masks.iter().find(|(n, _)| n == name) {
            return Ok(mask.clone());
        }
        let zone =
            self.zones.iter().find(|z| z.name == name).expect("the specification is checked");
        let (valid, x_mm, y_mm) = match self.subject {
            Subject::Map(surface) => {
                let grid = surface.grid();
                let valid = surface.height_nm().mapv(|z| !z.is_nan());
                (valid, grid.x.coordinates(), grid.y.coordinates())
            }
            Subject::Profile(profile) => {
                let n = profile.position_mm().len();
                (Array2::from_elem((1, n), true), profile.position_mm().to_vec(), vec![0.0])
            }
        };
        let mask = if let Some([cx, cy, radius_mm]) = zone.circle_mm {
            let Subject::Map(surface) = self.subject else {
                let remedy = "a profile has zones by x_mm, inside_mm or edge_mm";
                return Err(Invalid::whole("zone", "circle_mm is of a profile", remedy));
            };
            ClearAperture::Circle { centre_mm: [cx, cy], radius_mm }.mask(surface.grid())?
        } else if let Some(width) = zone.inside_mm.or(zone.edge_mm) {
            let distance = match &mut self.outline {
                Some(distance) => distance,
                none => none.insert(match self.subject {
                    Subject::Map(surface) => from_outline(surface)?,
                    Subject::Profile(_) => from_ends(&x_mm),
                }),
            };
            let inside = zone.inside_mm.is_some();
            distance.mapv(|d| (d >= width) == inside)
        } else {
            Array2::from_shape_fn(valid.dim(), |(r, c)| {
                is_within(x_mm[c], zone.x_mm) && is_within(y_mm[r], zone.y_mm)
            })
        };
        let mask = mask & &valid;
        if !mask.iter().any(|inside| *inside) {
            let problem = format!("\"{name}\" holds no valid pixel");
            return Err(Invalid::whole("zone", problem, "check its place and units"));
        }
        self.masks.push((name.into(), mask.clone()));
        Ok(mask)
    }
}

fn is_within(coordinate_mm: f64, range: Option<[f64; 2]>) -> bool {
    range.is_none_or(|[low, high]| coordinate_mm >= low && coordinate_mm <= high)
}

/// Returns the distance of every pixel from the outline of the valid pixels (ny, nx), mm.
fn from_outline(surface: &Surface) -> Result<Array2<f64>, Invalid> {
    let (ny, nx) = surface.height_nm().dim();
    let Grid { x, y } = surface.grid();
    let [x, y] = [x, y].map(|a| Axis::new(a.start_mm() - a.step_mm(), a.step_mm(), a.len() + 2));
    let grid = Grid { x: x?, y: y? };
    let mut invalid = Array2::from_elem((ny + 2, nx + 2), true);
    invalid.slice_mut(s![1..=ny, 1..=nx]).assign(&surface.height_nm().mapv(f64::is_nan));
    // The invalid pixels that reach to the rim, found from the rim inwards.
    let mut outside = Array2::from_elem((ny + 2, nx + 2), false);
    let mut open: Vec<(usize, usize)> = vec![(0, 0)];
    outside[[0, 0]] = true;
    while let Some((r, c)) = open.pop() {
        let steps = [(r.wrapping_sub(1), c), (r + 1, c), (r, c.wrapping_sub(1)), (r, c + 1)];
        for (r, c) in steps.into_iter().filter(|(r, c)| *r < ny + 2 && *c < nx + 2) {
            if !outside[[r, c]] && invalid[[r, c]] {
                outside[[r, c]] = true;
                open.push((r, c));
            }
        }
    }
    Ok(to_marked(&outside, &grid).slice_move(s![1..=ny, 1..=nx]))
}

/// Returns the distance of every position of a profile (valid or not) from its nearer end, mm, as a map of one row.
fn from_ends(x_mm: &[f64]) -> Array2<f64> {
    let ends = [x_mm[0], x_mm[x_mm.len() - 1]];
    Array2::from_shape_fn((1, x_mm.len()), |(_, c)| (x_mm[c] - ends[0]).min(ends[1] - x_mm[c]))
}
