//! The multi-pitch raster: narrow lines where much is to be removed, wide ones where little is.
//!
//! At the feed v, lines of pitch d remove the depth `r = VRR / (d v)`. Wide lines would have to
//! be slow where r is large, narrow ones faster than the machine where r is small. So the
//! aperture is divided by depth, and every region gets a raster of its own pitch:
//!
//! ```text
//! depth     r = Gaussian(z - min(0, min z)),  sigma = FWHM of the TIF / 4, over valid pixels
//! classes   e_k = r_min + k (r_max - r_min) / m,  k = 0 .. m
//! pitch     d_k = VRR / (r_k v_max),  r_k = e_{k-1},  r_1 = max(e_0, (e_1 - e_0) / 2),
//!           from d_min to d_max; classes of equal pitch become one
//! feed      v = VRR / (d_k r) <= v_max for all r >= r_k
//! ```
//!
//! (Eq. 4, 5, 9 and 12 of the multi-pitch paper, with two corrections: Eq. 5 forgets r_min, and
//! the paper's r_k is the middle of its depth bands, which the lower half of a band exceeds v_max
//! with. Below r_1 the feed stays at v_max and more is removed than asked for.)
//!
//! * A region is a 4-connected component of a class. The smallest one below the least area joins
//!   the class that is most frequent on its border, until none is left that has a neighbour.
//! * The region of the tool goes beyond the aperture by the overscan (a square); each pixel there
//!   belongs to the region of the nearest valid pixel. So every pixel belongs to one region.
//! * Lines run along x, from one edge of the region to the other: at a border both regions end on
//!   the same pixel edge. Between two regions the first line is 1/4 to 3/4 of a pitch from the
//!   border; towards the outside as in a raster. Pixels that lie farther than their pitch from
//!   all lines in their column (slivers) are added to a line of their region.
//! * Lines that continue each other one to one form a cell and are joined with the tool on, where
//!   a link along a border is at most 4 pitches (or pixels) long. From cell to cell the tool is
//!   lifted.
//! * A tool that is on in the links along borders removes there with the lines beside them, and so do the links of
//!   the region beyond the border: a feed law that knows lines alone leaves its worst place there. [`Links`] lifts
//!   it along borders, or everywhere. Where it is on, and because a tool turns at rest, the dwell
//!   times take that back, if the steps are short (half a standard deviation of the TIF; on a
//!   200 mm plate steps of 2 mm instead of 1 double the residual of the executed motion).
//!   Drawing the ends back by half a link, which makes the length per area that of the lines,
//!   leaves holes that no dwell time fills: 3.6 nm instead of 1.8 there.
//! * The cells of a region follow each other; the order of regions, cells and directions is the
//!   nearest end first, then improved by reversing parts (2-opt).
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | r | `depth_nm` | (ny, nx) | nm |
//! | e | `edge_nm` | (m+1) | nm |
//! | d_k | `pitch_mm` | (m) | mm |
//! | v_max | `max_velocity_mm_per_s` | - | mm/s |

mod cells;
mod regions;

use std::f64::consts::PI;

use ndarray::Array2;
use planish_types::{Invalid, Surface, Tif, ToolPath};
use serde::Serialize;

use crate::{
    ToolPathError,
    region::{Aperture, SLACK, check_length},
};
use cells::{Cell, Raster, Visit};
use regions::{Field, OUTSIDE, range};

/// Largest number of depth classes; more are refused. Larger: regions so narrow that their borders decide the result.
/// Smaller: fewer choices of the pitch.
const MAX_CLASSES: usize = 100;

/// Settings for the regions of the aperture and for their scan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MultiPitchSettings {
    /// Number of depth classes m, from 1 to 100.
    pub classes: usize,
    /// Largest feed, mm/s; > 0. Only the class of the smallest depth, or a pitch at its upper limit, may need more.
    pub max_velocity_mm_per_s: f64,
    /// Smallest pitch, mm; > 0: the finest that the machine can position.
    pub min_pitch_mm: f64,
    /// Largest pitch, mm; at least the smallest. [`crate::pitch_limit`] gives the largest one that leaves no visible
    /// lines.
    pub max_pitch_mm: f64,
    /// Least area of a region, mm^2; >= 0. `None` for 25 pitches squared, and at least 50 mm^2.
    pub min_area_mm2: Option<f64>,
    /// Longest segment, mm; > 0.
    pub step_mm: f64,
    /// Distance that the path goes beyond the clear aperture, mm; >= 0.
    pub overscan_mm: f64,
    /// Links between lines on which the tool stays on.
    pub links: Links,
}

/// Links from a line to the next one of its cell (a group of lines that continue each other) on which the tool stays
/// on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Links {
    /// All links: the tool stays on.
    #[default]
    On,
    /// Links beyond the aperture only. Along a border at which the other region has links too, the tool is lifted.
    Outside,
    /// No links: the tool is lifted between lines.
    Off,
}

/// A multi-pitch path.
#[derive(Clone, Debug, PartialEq)]
pub struct MultiPitch {
    /// The path; `pass_idx` is the index of the region.
    pub path: ToolPath,
    /// Index of the region of every pixel of the map, shape (ny, nx); -1 where the pixel is not valid.
    pub region_idx: Array2<i64>,
    /// Classes and regions into which the aperture was divided.
    pub report: MultiPitchReport,
}

/// Classes and regions into which the aperture was divided.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MultiPitchReport {
    /// Volumetric removal rate of the TIF, nm mm^2/s.
    pub vrr_nm_mm2_per_s: f64,
    /// Standard deviation of the Gaussian that smoothed the depth, mm.
    pub smoothing_mm: f64,
    /// Classes from the smallest depth to the largest; classes of equal pitch are merged.
    pub classes: Vec<DepthClass>,
    /// Regions in the order of the path: region i has the `pass_idx` i.
    pub regions: Vec<PitchRegion>,
}

impl MultiPitchReport {
    /// Returns a warning for each class but the first whose smallest depth needs a larger feed than the settings allow.
    pub fn warnings(&self, settings: &MultiPitchSettings) -> Vec<String> {
        let limit = settings.max_velocity_mm_per_s;
        let too_fast = self.classes.iter().enumerate().skip(1).filter_map(|(k, class)| {
            // A little more is the rounding of the pitches.
            let v = class.least_depth_velocity_mm_per_s.filter(|v| *v > limit * 1.001)?;
            Some(format!(
                "class {k} (pitch {:.4} mm) needs up to {v:.4} mm/s, more than {limit} mm/s; give a \
                 larger `max_pitch_mm`, or expect more removal there than asked for",
                class.pitch_mm
            ))
        });
        too_fast.collect()
    }
}

/// A range of removal depths whose regions have the same pitch.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DepthClass {
    /// Smallest and largest depth of the class, nm.
    pub edge_nm: [f64; 2],
    /// Distance between the lines, mm.
    pub pitch_mm: f64,
    /// Feed that removes the smallest depth, mm/s; left out where that depth is 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub least_depth_velocity_mm_per_s: Option<f64>,
    /// Feed that removes the largest depth, mm/s; left out where that depth is 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub largest_depth_velocity_mm_per_s: Option<f64>,
    /// Area of the regions of the class, mm^2.
    pub area_mm2: f64,
    /// Part of that area where the depth would need more than the largest feed, mm^2.
    pub too_fast_mm2: f64,
    /// Number of regions of the class.
    pub components: usize,
}

/// A connected region that is scanned at one pitch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PitchRegion {
    /// Index of its class in the report.
    pub class: usize,
    /// Area within the aperture, mm^2.
    pub area_mm2: f64,
    /// Number of its cells: groups of lines that continue each other. The tool is lifted between cells.
    pub cells: usize,
}

/// Makes a multi-pitch raster for the desired removal `surface` with `tif`.
///
/// # Errors
/// Refuses settings out of their range, an aperture that is smaller in y than the largest pitch in use, and too many
/// segments.
pub fn multi_pitch(
    surface: &Surface,
    tif: &Tif,
    settings: &MultiPitchSettings,
) -> Result<MultiPitch, ToolPathError> {
    check(settings)?;
    let vrr = tif.vrr_nm_mm2_per_s();
    let smoothing_mm = 0.25 * full_width_mm(tif);
    let depth_nm = regions::depth_nm(surface, smoothing_mm);
    let mut classes = classes(&depth_nm, vrr, settings);
    let pitches: Vec<f64> = classes.iter().map(|c| c.pitch_mm).collect();
    check_size(surface, &pitches)?;

    let pixel_mm2 = surface.grid().pixel_mm2();
    let class_of = depth_nm.map(|r| {
        if r.is_nan() {
            return OUTSIDE;
        }
        classes.partition_point(|c| c.edge_nm[1] <= *r).min(classes.len() - 1)
    });
    let least_pixels = pitches.iter().map(|d| {
        let area_mm2 = settings.min_area_mm2.unwrap_or((25.0 * d * d).max(50.0));
        area_mm2 / pixel_mm2 * (1.0 - SLACK)
    });
    let components = regions::components(&class_of, &least_pixels.collect::<Vec<_>>());

    let too_many = || too_many(surface, settings, &pitches);
    let field = Field::new(surface.grid(), &components.label, settings.overscan_mm);
    let field = field.ok_or_else(too_many)?;
    let region_pitch: Vec<f64> = components.class.iter().map(|k| pitches[*k]).collect();
    let rasters = cells::rasters(&field, &region_pitch).ok_or_else(too_many)?;
    let cells: Vec<Cell> =
        rasters.iter().enumerate().flat_map(|(i, r): (_, &Raster)| r.cells(i)).collect();
    let visits: Vec<Visit> = cells::order(&cells);
    let path = cells::walk(&cells, &visits, settings.step_mm, settings.links)
        .ok_or_else(too_many)?
        .finish()?;

    // Regions are numbered as they are visited.
    let mut number = vec![OUTSIDE; components.class.len()];
    let mut regions: Vec<PitchRegion> = Vec::new();
    for visit in &visits {
        let id = cells[visit.cell].region;
        if number[id] == OUTSIDE {
            number[id] = regions.len();
            let class = components.class[id];
            let area_mm2 = components.pixels[id] as f64 * pixel_mm2;
            classes[class].components += 1;
            classes[class].area_mm2 += area_mm2;
            regions.push(PitchRegion { class, area_mm2, cells: 0 });
        }
        regions[number[id]].cells += 1;
    }
    for (id, r) in components.label.iter().zip(&depth_nm).filter(|(id, _)| **id != OUTSIDE) {
        let class = &mut classes[components.class[*id]];
        // v = VRR / (d r)
        let velocity = vrr / (class.pitch_mm * r);
        if velocity > settings.max_velocity_mm_per_s * (1.0 + SLACK) {
            class.too_fast_mm2 += pixel_mm2;
        }
    }
    let region_idx =
        components.label.map(|id| if *id == OUTSIDE { -1 } else { number[*id] as i64 });
    let report = MultiPitchReport { vrr_nm_mm2_per_s: vrr, smoothing_mm, classes, regions };
    Ok(MultiPitch { path, region_idx, report })
}

/// Returns the pitches (d_k of the module) of the m classes between the m+1 ascending depths `edge_nm`, nm, in mm.
///
/// `vrr_per_velocity` is the VRR over the largest feed, VRR / v_max, nm mm. `limits_mm` are the smallest and the
/// largest pitch.
pub fn class_pitches_mm(edge_nm: &[f64], vrr_per_velocity: f64, limits_mm: [f64; 2]) -> Vec<f64> {
    let lower = edge_nm.windows(2).enumerate().map(|(k, e)| match k {
        // r_1 = max(e_0, (e_1 - e_0) / 2)
        0 => e[0].max(0.5 * (e[1] - e[0])),
        _ => e[0],
    });
    // d_k = VRR / (r_k v_max)
    lower.map(|r| (vrr_per_velocity / r).clamp(limits_mm[0], limits_mm[1])).collect()
}

fn check(settings: &MultiPitchSettings) -> Result<(), Invalid> {
    let MultiPitchSettings { classes, max_velocity_mm_per_s: v, .. } = *settings;
    if !(1..=MAX_CLASSES).contains(&classes) {
        let remedy = format!("give 1 to {MAX_CLASSES} classes");
        return Err(Invalid::whole("classes", format!("is {classes}"), remedy));
    }
    if !(v.is_finite() && v > 0.0) {
        let remedy = "give a positive feed in mm/s";
        return Err(Invalid::whole("max_velocity_mm_per_s", format!("is {v}"), remedy));
    }
    check_length("min_pitch_mm", settings.min_pitch_mm, false)?;
    check_length("max_pitch_mm", settings.max_pitch_mm, false)?;
    check_length("step_mm", settings.step_mm, false)?;
    check_length("overscan_mm", settings.overscan_mm, true)?;
    let low = settings.min_pitch_mm;
    let high = settings.max_pitch_mm;
    if low > high {
        let problem = format!("is {low}, above the largest pitch of {high} mm");
        let remedy = "give a smaller `min_pitch_mm` or a larger `max_pitch_mm`";
        return Err(Invalid::whole("min_pitch_mm", problem, remedy));
    }
    match settings.min_area_mm2 {
        Some(area) if !(area.is_finite() && area >= 0.0) => {
            let remedy = "give an area of at least 0 mm^2";
            Err(Invalid::whole("min_area_mm2", format!("is {area}"), remedy))
        }
        _ => Ok(()),
    }
}

/// Refuses an aperture that is smaller in y than the pitch of the class of the smallest depth, the largest of
/// `pitches`.
fn check_size(surface: &Surface, pitches: &[f64]) -> Result<(), Invalid> {
    let grid = surface.grid();
    let aperture = Aperture::new(&grid.x, &grid.y, surface.height_nm().view());
    let extent = aperture.across(0.5 * grid.y.step_mm());
    let size = extent.high - extent.low;
    let pitch = pitches[0];
    if pitch > size * (1.0 + SLACK) {
        let problem = format!("a pitch of {pitch} mm is larger than the aperture, {size} mm in y");
        let remedy = "give a smaller `max_pitch_mm`, or check the units";
        return Err(Invalid::whole("max_pitch_mm", problem, remedy));
    }
    Ok(())
}

fn too_many(surface: &Surface, settings: &MultiPitchSettings, pitches: &[f64]) -> ToolPathError {
    let grid = surface.grid();
    ToolPathError::TooManySegments {
        pitch_mm: pitches.iter().copied().fold(f64::MAX, f64::min),
        step_mm: settings.step_mm,
        extent_mm: [&grid.x, &grid.y]
            .map(|axis| axis.end_mm() - axis.start_mm() + 2.0 * settings.overscan_mm),
    }
}

/// Returns the classes of depth with their pitches; areas and numbers of regions are still 0.
fn classes(depth_nm: &Array2<f64>, vrr: f64, settings: &MultiPitchSettings) -> Vec<DepthClass> {
    let [low, high] = range(depth_nm);
    let m = settings.classes;
    let v_max = settings.max_velocity_mm_per_s;
    // e_k = r_min + k (r_max - r_min) / m
    let edge_nm: Vec<f64> = (0..=m)
        .map(|k| if k == m { high } else { low + (high - low) * k as f64 / m as f64 })
        .collect();
    let limits = [settings.min_pitch_mm, settings.max_pitch_mm];
    let pitches = class_pitches_mm(&edge_nm, vrr / v_max, limits);
    let mut classes: Vec<DepthClass> = Vec::new();
    for (e, pitch_mm) in edge_nm.windows(2).zip(pitches) {
        match classes.last_mut() {
            Some(last) if last.pitch_mm == pitch_mm => last.edge_nm[1] = e[1],
            _ => classes.push(DepthClass {
                edge_nm: [e[0], e[1]],
                pitch_mm,
                least_depth_velocity_mm_per_s: None,
                largest_depth_velocity_mm_per_s: None,
                area_mm2: 0.0,
                too_fast_mm2: 0.0,
                components: 0,
            }),
        }
    }
    for class in &mut classes {
        // v = VRR / (d r)
        let [least, largest] =
            class.edge_nm.map(|r| if r > 0.0 { Some(vrr / (class.pitch_mm * r)) } else { None });
        class.least_depth_velocity_mm_per_s = least;
        class.largest_depth_velocity_mm_per_s = largest;
    }
    classes
}

/// Returns the full width at half maximum of the TIF, mm: the diameter of the disc with the area where it is above half
/// its peak.
fn full_width_mm(tif: &Tif) -> f64 {
    let half = 0.5 * tif.peak_nm_per_s();
    let count = tif.rate_nm_per_s().iter().filter(|r| **r >= half).count();
    2.0 * (count as f64 * tif.grid().pixel_mm2() / PI).sqrt()
}
