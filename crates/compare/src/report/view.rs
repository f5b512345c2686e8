//! Data of a run for the screen, down-sampled where there are more.

use std::borrow::Cow;

use ndarray::Array3;
use planish_types::{
    Axis, DwellTime, Grid, Removal, Surface, ToolPath, Trajectory, outcome::verdict::Verdict,
};
use rayon::prelude::*;

use super::{
    map::{Histogram, ScreenMap, block_side, histogram, screen_map},
    motion::{self, Dwell, Ranges, SpeedLine},
    spectrum::{Spectrum, spectrum},
};
use crate::{made::Made, summary::Summary};

/// Largest number of pixels of a map, and of all maps together (2 bytes each, 2.7 in base64). Larger: larger, slower
/// pages. Smaller: coarser maps. Chosen: all maps take at most 5.4 MB of a page.
pub const MAX_MAP_PIXELS: usize = 400_000;
const MAX_ALL_PIXELS: usize = 2_000_000;

/// Largest number of points of the lines of all motions (16 bytes each, 22 in base64). Larger: larger, slower pages.
/// Smaller: coarser lines. Chosen: at most 1.7 MB of a page.
const MAX_ALL_POINTS: usize = 75_000;

/// Largest number of pieces with ranges of all motions (32 bytes each, 43 in base64). Larger: larger, slower pages.
/// Smaller: coarser ranges. Chosen: at most 0.9 MB of a page.
const MAX_ALL_PIECES: usize = 21_000;

/// Largest number of dwell points of all plans (12 bytes each, 16 in base64). Larger: larger, slower pages. Smaller:
/// fewer points. Chosen: at most 0.64 MB of a page.
const MAX_ALL_DWELL: usize = 40_000;

/// Largest number of pixels of all frames (2 bytes each, 2.7 in base64). Larger: larger, slower pages. Smaller: fewer
/// frames. Chosen: at most 1.2 MB of a page.
const MAX_ALL_FRAME_PIXELS: usize = 450_000;

/// Everything of one run.
#[derive(Debug)]
pub struct RunData {
    /// Name.
    pub name: String,
    /// Numbers; its methods are those of `methods`, maybe in another order.
    pub summary: Summary,
    /// Desired removal.
    pub desired: Surface,
    /// The map as it was measured, where it is known.
    pub measured: Option<Surface>,
    /// Path, where the run has one.
    pub path: Option<ToolPath>,
    /// Picture of the tool as SVG, where it varies.
    pub tool: Option<String>,
    /// Results of the methods.
    pub methods: Vec<RunMethod>,
    /// Manifests of the artifacts that the methods share.
    pub provenance: Vec<Made>,
}

/// Everything of one method.
#[derive(Debug)]
pub struct RunMethod {
    /// Scheduler.
    pub name: String,
    /// Motion.
    pub trajectory: Trajectory,
    /// Prediction.
    pub removal: Removal,
    /// Verdict on its motion.
    pub verdict: Verdict,
    /// Planned dwell times, where they are known.
    pub dwell: Option<DwellTime>,
    /// Removal in the course of the run, where it was simulated.
    pub frames: Option<Frames>,
    /// Rounds of the refinement, where there was one.
    pub rounds: Option<Rounds>,
    /// Picture of the motion of all axes as SVG, where there is one.
    pub on_axes: Option<String>,
    /// Manifests of its artifacts.
    pub provenance: Vec<Made>,
}

/// The removal at several times.
#[derive(Clone, Debug)]
pub struct Frames {
    /// Times (m), s.
    pub time_s: Vec<f64>,
    /// Removal until then (m, ny, nx), nm.
    pub removal_nm: Array3<f64>,
    /// Pixel centres.
    pub grid: Grid,
}

/// The rounds of a refinement.
#[derive(Clone, Debug)]
pub struct Rounds {
    /// RMS of the executed residual (m), nm.
    pub rms_nm: Vec<f64>,
    /// Time of the motion (m), s.
    pub total_time_s: Vec<f64>,
    /// Round that was kept.
    pub best: Option<usize>,
}

/// Data of a run for the screen.
#[derive(Debug)]
pub struct View {
    pub(super) name: String,
    pub(super) summary: Summary,
    pub(super) desired: ScreenMap,
    pub(super) measured: Option<ScreenMap>,
    pub(super) before: (Histogram, Option<Spectrum>),
    pub(super) tool: Option<String>,
    pub(super) methods: Vec<MethodView>,
    pub(super) provenance: Vec<Made>,
}

/// Data of a method for the screen.
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

/// The surface in the course of the run.
#[derive(Debug)]
pub(super) struct FrameView {
    pub(super) time_s: Vec<f64>,
    /// Residual at these times, (m) maps of (ny, nx), nm.
    pub(super) residual_nm: Array3<f64>,
    pub(super) grid: Grid,
}

/// Returns the data of `runs` for the screen, the methods in the order of their summaries.
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

/// Largest numbers of pixels, points, pieces and dwell points of a method.
struct Allotment {
    pixels: usize,
    points: usize,
    pieces: usize,
    dwell: usize,
    frame_pixels: usize,
}

/// Returns the motion that the verdict is about: that of the axes, where they do not read the coordinates of the part.
fn on_axes<'a>(motion: &'a Trajectory, verdict: &Verdict) -> Cow<'a, Trajectory> {
    verdict
        .part_to_axes
        .and_then(|numbers| numbers.checked().ok()?.trajectory(motion).ok())
        .map_or(Cow::Borrowed(motion), Cow::Owned)
}

/// Returns the data of one run for the screen.
fn view(run: RunData, allotment: &Allotment) -> View {
    let grid = *run.desired.grid();
    let every = block_side(&grid, allotment.pixels);
    let mut methods = run.methods;
    methods.sort_by_key(|m| run.summary.methods.iter().position(|(name, _)| *name == m.name));
    let methods = methods.into_par_iter().map(|m| MethodView {
        removal: screen_map(m.removal.removal_nm().view(), &grid, every),
        residual: on_screen(m.removal.residual(), every),
        after: analysed(m.removal.residual()),
        line: motion::line(&m.trajectory, allotment.points),
        ranges: motion::ranges(&on_axes(&m.trajectory, &m.verdict), allotment.pieces),
        dwell: run
            .path
            .as_ref()
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

/// Returns a surface for the screen, in means over blocks of `every` x `every` pixels.
fn on_screen(surface: &Surface, every: usize) -> ScreenMap {
    screen_map(surface.height_nm().view(), surface.grid(), every)
}

/// Returns the histogram of the heights, and their spectrum if they have one.
fn analysed(surface: &Surface) -> (Histogram, Option<Spectrum>) {
    let height_nm = surface.height_nm().view();
    (histogram(height_nm), spectrum(height_nm, surface.grid()))
}

/// Returns residual(t) = desired - removal(t) on the pixels of the frames; every k-th frame, the last in
/// any case, where there are too many.
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

/// Returns the pixel of `axis` that is nearest to each pixel of `other`.
fn nearest_pixels(axis: &Axis, other: &Axis) -> Vec<usize> {
    let positions =
        (0..other.len()).map(|i| (other.coordinate_mm(i) - axis.start_mm()) / axis.step_mm());
    positions.map(|i| (i.round().max(0.0) as usize).min(axis.len() - 1)).collect()
}
