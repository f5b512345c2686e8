//! The random-adaptive path: closed, random in direction, denser where more is to be removed.
//!
//! The local distance d between neighbouring strands of the path (the spacing) follows the desired removal r, smoothed
//! over two pitches and continued beyond the aperture by its nearest value:
//!
//! ```text
//! rho = (clamp(r, mean r / 4, 4 mean r) / mean r)^b,     d = p / sqrt(rho)
//! ```
//!
//! so that the length of the path per area varies by 2^b down and up from its mean. d is lowered where it would
//! change by more than an eighth of the distance. Then it is scaled as a whole until the aperture's area over the
//! length within it is the pitch.
//!
//! The region is the clear aperture (centres of the valid pixels) dilated by a square of
//! half-width max(o, p/2, h/2); h is the pixel. Gaps of at most 4p/3 are closed. Islands wider
//! apart get a path each, one pass, and lifts between them.
//!
//! * [`Construction::MeshTree`]: around a random tree of the triangles of a mesh. Closed; steps of
//!   a third of a mesh edge at most (about 1.5 d); steps cannot cross, whatever the region.
//! * [`Construction::Tour`]: a short tour through random points. Its turns are sharper.
//!
//! Corner treatment: passes of Chaikin's subdivision, each halves the turning angles about; what
//! still turns by more than 90 degrees after them becomes two corners of half the angle. So no
//! turn exceeds 90 degrees, but for `corners_kept`. A division into steps of a wanted length makes
//! steps shorter where the path turns by more than 90 degrees along one; it makes turns of up to
//! about 125 degrees.
//! A tour does not pass a hole or a notch where it can avoid it, and a mesh does where its
//! triangles are larger than these; a step that still goes more than 2p/3 beyond the region is run with the
//! tool off.
//! Whatever is done to the path afterwards, steps that would cross are taken back: in the end
//! nothing crosses.
//!
//! Source: this project. Unlike a path that grows step by step, the order of the tour is improved
//! as a whole, so that no long jumps are left.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | p | `pitch_mm` | - | mm |
//! | b | `contrast` | - | 1 |
//! | d | `spacing_mm` | - | mm |
//! | o | `overscan_mm` | - | mm |

mod crossing;
mod field;
mod mesh_tree;
mod points;
mod rounding;
mod tour;

use planish_types::{Invalid, Surface, ToolPath, progress};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use crate::{MAX_SEGMENTS, ToolPathError, region::check_length};
use field::Field;

/// Smallest area of the largest island (connected part of the region), in squared pitches; with a smaller one the pitch
/// is refused. Larger: more parts are refused. Smaller: regions without room for a random path are accepted.
const MIN_AREA: f64 = 16.0;
/// Largest number of passes of rounding that the settings accept. Each doubles the number of points. Larger: paths
/// with more points. Smaller: sharper corners.
const MAX_ROUNDING_PASSES: u32 = 4;
/// Logarithm of the ratio of reached to wanted pitch (about their relative difference) below which the spacing is not
/// scaled again. Larger: the pitch is less exact. Smaller: more trials.
const PITCH_TOLERANCE: f64 = 0.02;
/// Largest number of times that the path is made anew with a scaled spacing. Larger: more time if the pitch is not
/// reached. Smaller: the pitch may miss its tolerance.
const TRIALS: usize = 5;
/// Mesh edge over the spacing of the path, dimensionless. With this value the length per area of a uniform path with
/// one rounding pass is that of its spacing (measured, to 2 %). Another value: more trials until the pitch is
/// reached.
const EDGE_PER_SPACING: f64 = 2.4;

type Point = [f64; 2];

/// Settings of a random-adaptive path.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RandomAdaptiveSettings {
    /// Wanted mean pitch, mm; > 0: the area of the aperture over the length of the path within it.
    pub pitch_mm: f64,
    /// Distance that the region goes beyond the clear aperture, mm; >= 0. Half the TIF's size keeps the removal at
    /// the edge equal to that inside.
    pub overscan_mm: f64,
    /// Longest step (segment), mm; > 0. Steps are also at most twice the local spacing. `None` keeps the nodes of the
    /// construction.
    pub step_mm: Option<f64>,
    /// Exponent b of the density law of the module, 0 ..= 1: 0 is a uniform path, 1 a density proportional to the
    /// removal.
    pub contrast: f64,
    /// Method that makes the nodes and their order.
    pub construction: Construction,
    /// Number of passes of corner cutting, 0 ..= 4; each about halves the turning angles.
    pub rounding_passes: u32,
    /// Seed of the random numbers; the same seed gives the same path.
    pub seed: u64,
}

/// Methods to make and join the nodes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Construction {
    /// Around a random spanning tree of triangles.
    #[default]
    MeshTree,
    /// A short tour through random points.
    Tour,
}

/// A random-adaptive path and its report.
#[derive(Clone, Debug, PartialEq)]
pub struct RandomAdaptive {
    /// The path: one pass per island (connected part of the region), with lifts between them. Each is closed, unless a
    /// step leaves the region.
    pub path: ToolPath,
    /// Report on the path.
    pub report: RandomAdaptiveReport,
}

/// Results of a random-adaptive path beyond its statistics.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RandomAdaptiveReport {
    /// Number of closed paths, usually one per island (connected part of the region).
    pub islands: usize,
    /// Number of nodes before rounding, each visited once: small triangles (6 per triangle of the mesh) or random
    /// points.
    pub visits: usize,
    /// Smallest local distance between strands (spacing) in the region, mm.
    pub smallest_spacing_mm: f64,
    /// Largest local distance between strands (spacing) in the region, mm.
    pub largest_spacing_mm: f64,
    /// Length of the longest step, those with the tool off included, as a multiple of the local spacing at its middle.
    pub longest_step_per_spacing: f64,
    /// Number of steps that would leave the region; the tool is off there, and the path is open.
    pub steps_off: usize,
    /// Number of corners that were not cut, because the cut would have crossed another step.
    pub corners_kept: usize,
    /// Number of additional points, closer than the wanted step, that were kept because a longer step would have
    /// crossed another.
    pub points_kept: usize,
}

impl RandomAdaptiveReport {
    /// Returns the largest local distance between strands (spacing), mm, rounded up to whole micrometres.
    pub fn largest_pitch_mm(&self) -> f64 {
        (1e3 * self.largest_spacing_mm).ceil() / 1e3
    }
}

/// A closed path, its first node not repeated, with the number of nodes of its construction (`visits`).
#[derive(Clone, Debug, Default)]
struct Loop {
    node_mm: Vec<Point>,
    visits: usize,
}

/// Makes a random-adaptive path over the valid pixels of `desired_removal`.
///
/// # Errors
/// Refuses settings out of their range, a region that is too small for the pitch, and too many segments.
pub fn random_adaptive(
    desired_removal: &Surface,
    settings: &RandomAdaptiveSettings,
) -> Result<RandomAdaptive, ToolPathError> {
    check(settings)?;
    let field = Field::new(desired_removal, settings)?;
    let p = settings.pitch_mm;
    let largest = field.island_area_mm2.iter().fold(0.0_f64, |m, a| m.max(*a));
    if largest < MIN_AREA * p * p {
        let problem =
            format!("is {p} mm, but the largest island of the region is {largest:.6} mm^2");
        let remedy = format!(
            "give at most {:.6} mm (a quarter of the island's side), or a larger overscan",
            (largest / MIN_AREA).sqrt()
        );
        return Err(Invalid::whole("pitch_mm", problem, remedy).into());
    }

    // Scale the spacing until the area over the length is the pitch; the best trial counts.
    // d is such that the mean of 1/d over the aperture is 1/p.
    let normal = field.mean_inverse_spacing() * p;
    let mut scale = normal;
    let mut best: Option<(f64, Trial)> = None;
    for k in 0..TRIALS {
        let trial = progress::part(k, TRIALS, || Trial::new(&field, settings, scale));
        let mut trial = trial.ok_or_else(|| ToolPathError::TooManySegments {
            pitch_mm: p,
            step_mm: settings.step_mm.unwrap_or(p),
            extent_mm: field.extent_mm(),
        })?;
        let ratio = trial.effective_pitch_mm(&field) / p;
        trial.pitch_scale = normal * ratio;
        let error = ratio.ln().abs();
        scale /= ratio;
        if best.as_ref().is_none_or(|(smallest, _)| error < *smallest) {
            best = Some((error, trial));
        }
        if error < PITCH_TOLERANCE {
            break;
        }
    }
    let (_, trial) = best.expect("there is a trial");
    let report = trial.report(&field);
    Ok(RandomAdaptive { path: trial.path(&field)?, report })
}

fn check(settings: &RandomAdaptiveSettings) -> Result<(), Invalid> {
    check_length("pitch_mm", settings.pitch_mm, false)?;
    if let Some(step_mm) = settings.step_mm {
        check_length("step_mm", step_mm, false)?;
    }
    check_length("overscan_mm", settings.overscan_mm, true)?;
    if !(0.0..=1.0).contains(&settings.contrast) {
        let problem = format!("is {}", settings.contrast);
        return Err(Invalid::whole("contrast", problem, "give an exponent in 0 ..= 1"));
    }
    if settings.rounding_passes > MAX_ROUNDING_PASSES {
        let problem = format!("is {}", settings.rounding_passes);
        let remedy = "give at most 4; every pass doubles the points";
        return Err(Invalid::whole("rounding_passes", problem, remedy));
    }
    Ok(())
}

/// The closed paths that one scale factor of the spacing gives.
struct Trial {
    loops: Vec<Vec<Point>>,
    /// Factor that turns the wanted spacing d into the spacing of this path: mean of 1/d over the aperture, times the
    /// aperture's area, over the length within it.
    pitch_scale: f64,
    visits: usize,
    corners_kept: usize,
    points_kept: usize,
}

impl Trial {
    /// Makes the paths with the spacing multiplied by `scale`; `None` if they have more than [`MAX_SEGMENTS`] segments.
    fn new(field: &Field, settings: &RandomAdaptiveSettings, scale: f64) -> Option<Self> {
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        let made = match settings.construction {
            Construction::MeshTree => mesh_tree::mesh_tree(field, scale, &mut rng),
            Construction::Tour => tour::tour(field, scale, &mut rng),
        };
        let visits = made.iter().map(|l| l.visits).sum();
        let mut loops: Vec<Vec<Point>> = made.into_iter().map(|l| l.node_mm).collect();
        let mut corners_kept: usize =
            (0..settings.rounding_passes).map(|_| rounding::round(&mut loops)).sum();
        if settings.rounding_passes > 0 {
            corners_kept += rounding::blunt(&mut loops);
        }
        let spacing = |p: Point| scale * field.spacing_mm(p);
        let points_kept = match settings.step_mm {
            Some(step_mm) => rounding::divide(&mut loops, step_mm, &spacing, MAX_SEGMENTS)?,
            None => 0,
        };
        Some(Self { loops, pitch_scale: scale, visits, corners_kept, points_kept })
    }

    /// Returns the area of the aperture over the length of the path within it, mm. If no step lies within it, it is the
    /// area of the region over the whole length.
    fn effective_pitch_mm(&self, field: &Field) -> f64 {
        let mut inside = 0.0;
        let mut all = 0.0;
        for [a, b] in self.steps() {
            let length = distance(a, b);
            all += length;
            if field.in_aperture(middle(a, b)) {
                inside += length;
            }
        }
        if inside > 0.0 {
            field.aperture_mm2() / inside
        } else {
            field.island_area_mm2.iter().sum::<f64>() / all
        }
    }

    fn steps(&self) -> impl Iterator<Item = [Point; 2]> + '_ {
        self.loops.iter().flat_map(|l| {
            let ends = l.iter().zip(l.iter().cycle().skip(1));
            ends.map(|(a, b)| [*a, *b])
        })
    }

    fn report(&self, field: &Field) -> RandomAdaptiveReport {
        let (smallest_spacing_mm, largest_spacing_mm) = field
            .cells()
            .map(|k| self.pitch_scale * field.spacing_mm(field.centre(k)))
            .fold((f64::INFINITY, 0.0), |(low, high), d| (f64::min(low, d), f64::max(high, d)));
        let relative_steps = self
            .steps()
            .map(|[a, b]| distance(a, b) / (self.pitch_scale * field.spacing_mm(middle(a, b))));
        RandomAdaptiveReport {
            islands: self.loops.len(),
            visits: self.visits,
            smallest_spacing_mm,
            largest_spacing_mm,
            longest_step_per_spacing: relative_steps.fold(0.0, f64::max),
            steps_off: self.steps().filter(|[a, b]| field.leaves(*a, *b)).count(),
            corners_kept: self.corners_kept,
            points_kept: self.points_kept,
        }
    }

    /// Joins the closed paths to one with lifts between them. The first starts at the node of smallest x + y, each next
    /// one at the node nearest to the last end. Steps that leave the region have the tool off.
    fn path(mut self, field: &Field) -> Result<ToolPath, Invalid> {
        let mut point_mm = Vec::new();
        let mut tool_on = Vec::new();
        let mut pass_idx = Vec::new();
        let mut pass = 0;
        while !self.loops.is_empty() {
            let far = |p: Point| match point_mm.last() {
                Some(end) => distance(*end, p),
                None => p[0] + p[1],
            };
            let nodes = self
                .loops
                .iter()
                .enumerate()
                .flat_map(|(l, nodes)| nodes.iter().enumerate().map(move |(i, p)| (*p, l, i)));
            let (_, l, i) = nodes
                .map(|(p, l, i)| (far(p), l, i))
                .reduce(|a, b| if b.0 < a.0 { b } else { a })
                .expect("a loop has nodes");
            let mut nodes = self.loops.swap_remove(l);
            let n = nodes.len();
            let off = |k: usize| field.leaves(nodes[k % n], nodes[(k + 1) % n]);
            match (0..n).find(|k| off(*k) && !off(k + 1)) {
                // Open: it begins after a lift, and ends before one.
                Some(k) => {
                    nodes.rotate_left((k + 1) % n);
                    while nodes.len() > 2
                        && field.leaves(nodes[nodes.len() - 2], nodes[nodes.len() - 1])
                    {
                        nodes.pop();
                    }
                }
                None => {
                    nodes.rotate_left(i);
                    nodes.push(nodes[0]);
                }
            }
            if !point_mm.is_empty() {
                tool_on.push(false);
                pass_idx.push(pass);
                pass += 1;
            }
            tool_on.extend(nodes.windows(2).map(|w| !field.leaves(w[0], w[1])));
            pass_idx.extend((1..nodes.len()).map(|_| pass));
            point_mm.extend(nodes);
        }
        ToolPath::through(point_mm, tool_on, pass_idx)
    }
}

fn distance(a: Point, b: Point) -> f64 {
    (b[0] - a[0]).hypot(b[1] - a[1])
}

fn middle(a: Point, b: Point) -> Point {
    [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])]
}
