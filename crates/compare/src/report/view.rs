//! Data of a run for the report page, down-sampled if there are more than the page can show. A view is the data of
//! one run.

use std::borrow::Cow;

use ndarray::{Array2, Array3};
use planish_types::{
    Axis, DwellTime, Grid, Removal, Surface, ToolPath, Trajectory, outcome::verdict::Verdict,
};
use rayon::prelude::*;

use super::{
    map::{Histogram, ScreenMap, block_side, histogram, screen_map},
    motion::{self, Dwell, Ranges, SpeedLine},
    spectrum::{Spectrum, spectrum},
    tool::Picture,
};
use crate::{made::Made, summary::Summary};

/// Largest number of pixels of one map of a page; `MAX_ALL_PIXELS` is that of all its maps together. A pixel takes 2
/// bytes, 2.7 in base64. Larger: larger, slower pages. Smaller: coarser maps. Chosen: all maps take at most 5.4 MB of a
/// page.
pub const MAX_MAP_PIXELS: usize = 400_000;
const MAX_ALL_PIXELS: usize = 2_000_000;

/// Largest number of points that draw the motions of all methods (16 bytes each, 22 in base64). Larger: larger,
/// slower pages. Smaller: coarser lines. Chosen: at most 1.7 MB of a page.
const MAX_ALL_POINTS: usize = 75_000;

/// Largest number of pieces (groups of segments) with ranges of velocity, acceleration and jerk, of all motions (32
/// bytes each, 43 in base64). Larger: larger, slower pages. Smaller: coarser ranges. Chosen: at most 0.9 MB of a
/// page.
const MAX_ALL_PIECES: usize = 21_000;

/// Largest number of dwell points of all plans on the page (12 bytes each, 16 in base64). Larger: larger, slower
/// pages. Smaller: fewer points. Chosen: at most 0.64 MB of a page.
const MAX_ALL_DWELL: usize = 40_000;

/// Largest number of pixels of all frames (maps at chosen times; 2 bytes each, 2.7 in base64). Larger: larger, slower
/// pages. Smaller: fewer frames. Chosen: at most 1.2 MB of a page.
const MAX_ALL_FRAME_PIXELS: usize = 450_000;

/// All data of one run, at full resolution.
#[derive(Debug)]
pub struct RunData {
    /// Name of the run.
    pub name: String,
    /// Numbers of the run. Its methods are those of `methods`, maybe in another order.
    pub summary: Summary,
    /// Map of the desired removal.
    pub desired: Surface,
    /// Map as it was measured, before anything was done to it; `None` if it is not known.
    pub measured: Option<Surface>,
    /// Tool path; `None` if the run has none.
    pub path: Option<ToolPath>,
    /// Pictures of the tool or tools; empty if none is known.
    pub tool: Vec<Picture>,
    /// Data of the methods (schedulers or solvers) of the run.
    pub methods: Vec<RunMethod>,
    /// Manifests of the artifacts that the methods share, for the section of the page that says how they were made.
    pub provenance: Vec<Made>,
}

/// All data of one method, at full resolution.
#[derive(Debug)]
pub struct RunMethod {
    /// Name of the method, which is that of its scheduler.
    pub name: String,
    /// Motion along the path.
    pub trajectory: Trajectory,
    /// Predicted removal of the motion, with the residual that it leaves.
    pub removal: Removal,
    /// Removal of this motion alone (ny, nx), nm, if motions before it have removed a part of `removal`.
    pub shown_removal_nm: Option<Array2<f64>>,
    /// Verdict on the limits of the machine.
    pub verdict: Verdict,
    /// Tool path of the method; `None` if it is that of the run.
    pub path: Option<ToolPath>,
    /// Planned dwell times; `None` if they are not known.
    pub dwell: Option<DwellTime>,
    /// Removal at chosen times of the run; `None` if it was not simulated.
    pub frames: Option<Frames>,
    /// Rounds of the refinement; `None` if there was none.
    pub rounds: Option<Rounds>,
    /// Picture of the motion of all axes as SVG; `None` if there is none.
    pub on_axes: Option<String>,
    /// Manifests of the artifacts of the method, for the section of the page that says how they were made.
    pub provenance: Vec<Made>,
}

/// Maps of the removal at several times of the run.
#[derive(Clone, Debug)]
pub struct Frames {
    /// Times of the maps from the start of the motion (m), s.
    pub time_s: Vec<f64>,
    /// Removal until each time (m, ny, nx), nm.
    pub removal_nm: Array3<f64>,
    /// Pixel centres of the maps; the pixels may be fewer than those of the desired removal.
    pub grid: Grid,
}

/// Rounds of a refinement of the dwell times.
#[derive(Clone, Debug)]
pub struct Rounds {
    /// RMS of the executed residual in each round (m), nm.
    pub rms_nm: Vec<f64>,
    /// Duration of the motion in each round (m), s.
    pub total_time_s: Vec<f64>,
    /// Index of the round that was kept; `None` if it is not known.
    pub best: Option<usize>,
}

/// Data of a run for the report page: down-sampled maps, points of the motion, histograms and spectra.
#[derive(Debug)]
pub struct View {
    pub(super) name: String,
    pub(super) summary: Summary,
    pub(super) desired: ScreenMap,
    pub(super) measured: Option<ScreenMap>,
    pub(super) before: (Histogram, Option<Spectrum>),
    pub(super) tool: Vec<Picture>,
    pub(super) methods: Vec<MethodView>,
    pub(super) provenance: Vec<Made>,
}

/// Data of a method for the report page: down-sampled maps, points and ranges of the motion, histogram and spectrum.
#[derive(Debug)]
pub(super) struct MethodView {
    pub(super) name: String,
    pub(super) removal: ScreenMap,
    pub(super) residual: ScreenMap,
    pub(super) after: (Histogram, Option<Spectrum>),
    pub(super) line: SpeedLine,
    pub(super) ranges: Ranges,
    pub(super) verdict: Verdict,
    pub(super) dwell: Option<Dwell>,
    pub(super) frames: Option<FrameView>,
    pub(super) rounds: Option<Rounds>,
    pub(super) on_axes: Option<String>,
    pub(super) provenance: Vec<Made>,
}

/// Maps of the residual at several times of the run.
#[derive(Debug)]
pub(super) struct FrameView {
    pub(super) time_s: Vec<f64>,
    /// Residual at these times (m, ny, nx), nm.
    pub(super) residual_nm: Array3<f64>,
    pub(super) grid: Grid,
}

/// Returns the data of `runs` for the report page, with the methods in the order of their summaries.
pub fn views(runs: Vec<RunData>) -> Vec<View> {
    let methods: usize = runs.iter().map(|r| r.methods.len()).sum::<usize>().max(1);
    let maps = 2 * methods + runs.len() + runs.iter().filter(|r| r.measured.is_some()).count();
    let allotment = Allotment {
        pixels: MAX_MAP_PIXELS.min(MAX_ALL_PIXELS / maps),
        points: MAX_ALL_POINTS / methods,
        pieces: MAX_ALL_PIECES / methods,
        dwell: MAX_ALL_DWELL / methods,
        frame_pixels: MAX_ALL_FRAME_PIXELS
            / runs.iter().flat_map(|r| &r.methods).filter(|m| m.frames.is_some()).count().max(1),
    };
    runs.into_iter().map(|run| view(run, &allotment)).collect()
}

/// Largest amounts of data on the page: pixels of one map, and, for one method, points of the motion, pieces with
/// ranges, dwell points and pixels of all its frames.
struct Allotment {
    pixels: usize,
    points: usize,
    pieces: usize,
    dwell: usize,
    frame_pixels: usize,
}

/// Returns the motion that the verdict is about: that of the machine axes if the verdict states how their coordinates
/// follow from those of the part, otherwise `motion` itself.
fn on_axes<'a>(motion: &'a Trajectory, verdict: &Verdict) -> Cow<'a, Trajectory> {
    verdict
        .part_to_axes
        .and_then(|numbers| numbers.checked().ok()?.trajectory(motion).ok())
        .map_or(Cow::Borrowed(motion), Cow::Owned)
}

/// Returns the data of one run for the report page. `allotment` bounds the amount of data of each method.
fn view(run: RunData, allotment: &Allotment) -> View {
    let grid = *run.desired.grid();
    let every = block_side(&grid, allotment.pixels);
    let mut methods = run.methods;
    methods.sort_by_key(|m| run.summary.methods.iter().position(|(name, _)| *name == m.name));
    let methods = methods.into_par_iter().map(|m| MethodView {
        removal: screen_map(
            m.shown_removal_nm.as_ref().unwrap_or(m.removal.removal_nm()).view(),
            &grid,
            every,
        ),
        residual: on_screen(m.removal.residual(), every),
        after: analysed(m.removal.residual()),
        line: motion::line(&m.trajectory, allotment.points),
        ranges: motion::ranges(&on_axes(&m.trajectory, &m.verdict), allotment.pieces),
        dwell: m
            .path
            .as_ref()
            .or(run.path.as_ref())
            .zip(m.dwell.as_ref())
            .and_then(|(path, plan)| motion::dwell(path, plan, &m.trajectory, allotment.dwell)),
        frames: m.frames.map(|f| frame_view(f, &run.desired, allotment.frame_pixels)),
        name: m.name,
        verdict: m.verdict,
        rounds: m.rounds,
        on_axes: m.on_axes,
        provenance: m.provenance,
    });
    let methods = methods.collect();
    View {
        name: run.name,
        summary: run.summary,
        desired: on_screen(&run.desired, every),
        measured: run.measured.map(|s| on_screen(&s, block_side(s.grid(), allotment.pixels))),
        before: analysed(&run.desired),
        tool: run.tool,
        methods,
        provenance: run.provenance,
    }
}

/// Returns a surface for the report page, as means over blocks of `every` x `every` pixels.
fn on_screen(surface: &Surface, every: usize) -> ScreenMap {
    screen_map(surface.height_nm().view(), surface.grid(), every)
}

/// Returns the histogram of the heights, and their spectrum; `None` if no rectangle of valid pixels is large enough.
fn analysed(surface: &Surface) -> (Histogram, Option<Spectrum>) {
    let height_nm = surface.height_nm().view();
    (histogram(height_nm), spectrum(height_nm, surface.grid()))
}

/// Returns the residual (desired minus removal) at the times of the frames, on their pixels. If they have more than
/// `most_pixels`, it keeps every second, third ... frame, and always the last.
fn frame_view(frames: Frames, desired: &Surface, most_pixels: usize) -> FrameView {
    let (m, ny, nx) = frames.removal_nm.dim();
    let every = m.div_ceil((most_pixels / (ny * nx)).max(1));
    let mut shown: Vec<usize> = (0..m).rev().step_by(every).collect();
    shown.reverse();
    let columns = nearest_pixels(&desired.grid().x, &frames.grid.x);
    let rows = nearest_pixels(&desired.grid().y, &frames.grid.y);
    let residual_nm = Array3::from_shape_fn((shown.len(), ny, nx), |(i, r, c)| {
        desired.height_nm()[[rows[r], columns[c]]] - frames.removal_nm[[shown[i], r, c]]
    });
    let time_s = shown.iter().map(|i| frames.time_s[*i]).collect();
    FrameView { time_s, residual_nm, grid: frames.grid }
}

/// Returns, for each pixel of `other`, the index of the nearest pixel of `axis`.
fn nearest_pixels(axis: &Axis, other: &Axis) -> Vec<usize> {
    let positions =
        (0..other.len()).map(|i| (other.coordinate_mm(i) - axis.start_mm()) / axis.step_mm());
    positions.map(|i| (i.round().max(0.0) as usize).min(axis.len() - 1)).collect()
}
