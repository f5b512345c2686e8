//! The raster: parallel lines at one pitch, scanned back and forth, joined by turn-arounds; and
//! its variants: any angle, one direction, another order of the lines, a pitch that follows the
//! map.
//!
//! The valid pixels of a map are the clear aperture, each as its centre. With u along the lines,
//! w across them, and the overscan o:
//!
//! ```text
//! axes       u = x cos a + y sin a,  w = y cos a - x sin a;  for scans along y w = x
//! lines      w_k = w_mid + (k - (n-1)/2) p,  n = floor(H/p) + 1,  H = extent of the region
//!            or w_k = C + k p, every k in the region
//!            or N(w_k) = (N_H - floor(N_H))/2 + k,  N(w) = integral of dw / d(w) over the region,
//!            d(w) = clamp(p mean r / r(w), d_min, d_max),  r(w) the mean of the map in a row
//! interval   union over the pixel rows of what they have in |w - w_k| <= max(o, p/2, h/2), as
//!            [u_first - o, u_last + o]; touching intervals are one
//! nodes      L / ceil(L/s) apart
//! ```
//!
//! * The region is the aperture dilated by a square of half-width o along the lines (h is the
//!   pixel). A line never serves less than the half pitch beside it, and the first and the last
//!   line serve all that lies beyond them, so that every pixel is at most p from the path,
//!   whatever o. Where the pitch follows the map, the half pitch is half the way to the
//!   neighbouring line, and the largest distance d_max takes the place of p.
//! * d(w) is the distance at which a constant feed removes r(w). Negative maps are lifted to 0.
//!   The harmonic mean of d between two lines is their distance: from d_min to d_max.
//! * Gaps along a line that are left after that are bridged with the tool on when they are at
//!   most one pitch or two pixels wide: dropouts and masked pits. Wider ones are lifts.
//! * An interval shorter than a pixel is widened to one, so that every pass has a length.
//! * Consecutive lines whose intervals overlap are joined with the tool on: both are extended to
//!   the outer of their two ends on that side, so that the turn is perpendicular, and joined by a
//!   straight step or a semicircle. A line that has several intervals, or does not overlap with
//!   the next one, ends in a lift: one straight segment with the tool off. Lines in one direction
//!   and lines in random order are joined by lifts only.
//! * The first line has the smallest w and runs towards larger u; every other line runs back,
//!   lines without an interval included. Each interval is one pass; a link belongs to the pass
//!   that it leaves.
//! * Bi-step: every other line, then back over the lines between them. Neighbouring lines are run
//!   at different times, so that a drift of the tool is spread, and turns are twice as wide. Lines
//!   do not cross, but lines of the second raster meet links of the first one, and the other way
//!   round: with an overscan of the TIF's reach that is off the aperture.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | p | `pitch_mm` | - | mm |
//! | s | `step_mm` | - | mm |
//! | o | `overscan_mm` | - | mm |
//! | C | `line_origin_mm` | - | mm |
//! | a | `angle_deg` | - | deg |
//! | d_min, d_max | `pitch_range_mm` | (2) | mm |
//! | w_k | `lines` | (n) | mm |

mod lines;
mod runs;

use std::f64::consts::PI;

use planish_types::{Invalid, Surface, ToolPath};
use serde::Serialize;

use crate::{
    MAX_SEGMENTS, ToolPathError,
    draft::{Draft, parts},
    region::{Interval, SLACK, check_length},
};
use runs::Runs;

/// Smallest number of chords of a semicircular turn: 45 degrees between neighbours. Larger: rounder turns, and more
/// segments. Smaller: sharper corners.
const MIN_CHORDS: usize = 4;

/// Settings of a raster.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RasterSettings {
    /// Distance between the lines, mm; > 0. With a `pitch_range_mm` it is the distance where the map has its mean
    /// value.
    pub pitch_mm: f64,
    /// Longest segment, mm; > 0.
    pub step_mm: f64,
    /// Distance that the path goes beyond the clear aperture, mm; >= 0. The usual one, half the TIF's size, keeps the
    /// removal at the edge equal to that inside.
    pub overscan_mm: f64,
    /// Direction of the lines.
    pub scan: Scan,
    /// Turns between consecutive lines.
    pub turn: Turn,
    /// Coordinate w across the lines of one line (y for lines along x), mm; `None` centres the lines on the region.
    pub line_origin_mm: Option<f64>,
    /// Order of the lines.
    pub order: LineOrder,
    /// True if all lines run towards larger u, the coordinate along them; needs [`Turn::Lift`].
    pub one_directional: bool,
    /// Smallest and largest distance between lines, mm, if it follows the desired removal; 0 < smallest <= largest.
    /// `None` for one pitch.
    pub pitch_range_mm: Option<[f64; 2]>,
}

impl RasterSettings {
    /// Returns settings for lines along x, centred and one after the other, joined by square turns: the defaults of
    /// `planish toolpath raster`.
    pub fn new(pitch_mm: f64, step_mm: f64, overscan_mm: f64) -> Self {
        Self {
            pitch_mm,
            step_mm,
            overscan_mm,
            scan: Scan::X,
            turn: Turn::Square,
            line_origin_mm: None,
            order: LineOrder::Sequential,
            one_directional: false,
            pitch_range_mm: None,
        }
    }

    /// Returns the largest distance between neighbouring lines, mm.
    pub fn largest_pitch_mm(&self) -> f64 {
        self.pitch_range_mm.map_or(self.pitch_mm, |[_, most]| most)
    }

    /// Returns the warning that `path` with these settings has one line only; empty if it has more.
    pub fn warnings(&self, path: &ToolPath) -> Vec<String> {
        let across = self.scan.axes()[1];
        let mut w = path.point_mm().iter().map(|p| p[0] * across[0] + p[1] * across[1]);
        let first = w.clone().next().unwrap_or(0.0);
        let pitch_mm = self.pitch_mm;
        // Less than any pitch that can be meant, more than rounding.
        if w.any(|w| (w - first).abs() >= 1e-6 * pitch_mm) {
            return Vec::new();
        }
        vec![format!("one line only: a pitch of {pitch_mm} mm leaves no room for a second one")]
    }
}

/// Direction of the lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Scan {
    /// Lines along x.
    #[default]
    X,
    /// Lines along y.
    Y,
    /// Lines turned from x towards y.
    Angle {
        /// Angle from x towards y, degrees; 0 and 90 are the scans along x and y.
        angle_deg: f64,
    },
}

impl Scan {
    /// Returns the unit vectors (x, y) along and across the lines.
    pub fn axes(self) -> [[f64; 2]; 2] {
        match self {
            Self::X => [[1.0, 0.0], [0.0, 1.0]],
            Self::Y => [[0.0, 1.0], [1.0, 0.0]],
            Self::Angle { angle_deg } => match angle_deg.rem_euclid(360.0) {
                0.0 => Self::X.axes(),
                90.0 => Self::Y.axes(),
                180.0 => [[-1.0, 0.0], [0.0, -1.0]],
                270.0 => [[0.0, -1.0], [-1.0, 0.0]],
                a => {
                    let (sin, cos) = a.to_radians().sin_cos();
                    [[cos, sin], [-sin, cos]]
                }
            },
        }
    }
}

/// Order of the lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum LineOrder {
    /// Each line is followed by its neighbour.
    #[default]
    Sequential,
    /// Every other line, then back over the lines between them.
    BiStep,
    /// A random order of the lines; needs [`Turn::Lift`].
    Random {
        /// Seed of the random numbers; the same seed gives the same order.
        seed: u64,
    },
}

/// Turns between consecutive lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Turn {
    /// A straight step across; two corners of 90 degrees.
    #[default]
    Square,
    /// A semicircle beyond the ends of the lines; no corner.
    Semicircle,
    /// A straight segment with the tool off.
    Lift,
}

impl Turn {
    /// Returns the default turn: a lift for lines in one direction or in random order, otherwise a square turn.
    pub fn usual(order: LineOrder, one_directional: bool) -> Self {
        let lifts = one_directional || matches!(order, LineOrder::Random { .. });
        if lifts { Self::Lift } else { Self::Square }
    }
}

/// Makes a raster over the valid pixels of `surface`.
///
/// # Errors
/// Refuses settings out of their range, turns other than lifts for lines in one direction or in random order, an origin
/// together with a pitch range, an origin of lines that leaves none in the region, and too many segments.
pub fn raster(surface: &Surface, settings: &RasterSettings) -> Result<ToolPath, ToolPathError> {
    check(settings)?;
    let axes = settings.scan.axes();
    let runs = Runs::new(surface, axes);
    let lines = lines::positions(surface, &runs, settings)?;
    let lines = lines.ok_or_else(|| too_many(&runs, settings))?;
    let mut passes = passes(&runs, &lines, settings).ok_or_else(|| too_many(&runs, settings))?;
    let links = link(&mut passes, settings.turn);
    let mut path = walk(&passes, &links, settings).ok_or_else(|| too_many(&runs, settings))?;
    for point in &mut path.point_mm {
        let [u, w] = *point;
        *point = [0, 1].map(|a| u * axes[0][a] + w * axes[1][a]);
    }
    Ok(path.finish()?)
}

fn check(settings: &RasterSettings) -> Result<(), Invalid> {
    check_length("pitch_mm", settings.pitch_mm, false)?;
    check_length("step_mm", settings.step_mm, false)?;
    check_length("overscan_mm", settings.overscan_mm, true)?;
    if let Some(origin) = settings.line_origin_mm.filter(|origin| !origin.is_finite()) {
        let remedy = "give a finite coordinate in mm";
        return Err(Invalid::whole("line_origin_mm", format!("is {origin}"), remedy));
    }
    if let Scan::Angle { angle_deg } = settings.scan
        && !angle_deg.is_finite()
    {
        let remedy = "give a finite angle in degrees";
        return Err(Invalid::whole("angle_deg", format!("is {angle_deg}"), remedy));
    }
    if let Some([least, most]) = settings.pitch_range_mm {
        check_length("pitch_range_mm", least, false)?;
        check_length("pitch_range_mm", most, false)?;
        if least > most {
            let problem = format!("is {least} to {most}");
            return Err(Invalid::whole("pitch_range_mm", problem, "give the smaller pitch first"));
        }
        if settings.line_origin_mm.is_some() {
            let problem = "is given, but the lines follow the map";
            return Err(Invalid::whole("line_origin_mm", problem, "leave it out"));
        }
    }
    let random = matches!(settings.order, LineOrder::Random { .. });
    if settings.turn != Turn::Lift && (settings.one_directional || random) {
        let problem = "joins lines with the tool on, back and forth";
        let remedy = "lines in one direction or in random order need lifts";
        return Err(Invalid::whole("turn", problem, remedy));
    }
    Ok(())
}

fn too_many(runs: &Runs, settings: &RasterSettings) -> ToolPathError {
    let extent = [0, 1].map(|a| runs.extent(a, settings.overscan_mm));
    ToolPathError::TooManySegments {
        pitch_mm: settings.pitch_range_mm.map_or(settings.pitch_mm, |[least, _]| least),
        step_mm: settings.step_mm,
        extent_mm: extent.map(|e| e.high - e.low),
    }
}

/// One interval of one line with the tool on: coordinate `across` of the line and interval `along` it, mm.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pass {
    /// Position of its line in the order in which the lines are run.
    place: usize,
    across: f64,
    along: Interval,
    /// True if it runs towards larger coordinates along the line.
    forward: bool,
}

impl Pass {
    /// Returns the start and the end of the pass, as coordinates along the line, mm.
    fn ends(&self) -> (f64, f64) {
        let Interval { low, high } = self.along;
        if self.forward { (low, high) } else { (high, low) }
    }
}

/// Returns the passes in the order in which they are run; `None` if they have too many segments. `lines` has the
/// coordinates of the lines across.
fn passes(runs: &Runs, lines: &[f64], settings: &RasterSettings) -> Option<Vec<Pass>> {
    let mut passes = Vec::new();
    let mut segments = 0.0;
    for (place, line) in lines::order(lines.len(), settings.order).into_iter().enumerate() {
        let forward = settings.one_directional || place % 2 == 0;
        let mut intervals = intervals(runs, lines, line, settings);
        if !forward {
            intervals.reverse();
        }
        for along in intervals {
            segments += ((along.high - along.low) / settings.step_mm).ceil();
            passes.push(Pass { place, across: lines[line], along, forward });
        }
        if segments > MAX_SEGMENTS as f64 {
            return None;
        }
    }
    Some(passes)
}

/// Returns the intervals of a line with the tool on, mm, ascending and disjoint. `line` is its index in `lines`.
fn intervals(runs: &Runs, lines: &[f64], line: usize, settings: &RasterSettings) -> Vec<Interval> {
    let o = settings.overscan_mm;
    let [pixel_along, pixel_across] = runs.pixel_mm;
    // The half pitch on either side; none where there is no other line.
    let half = |a: usize, b: usize| match settings.pitch_range_mm {
        Some(_) => 0.5 * (lines[b] - lines[a]),
        None => 0.5 * settings.pitch_mm,
    };
    let below = line.checked_sub(1).map_or(f64::INFINITY, |before| half(before, line));
    let above = if line + 1 < lines.len() { half(line, line + 1) } else { f64::INFINITY };
    // max(o, p/2, h/2)
    let reach =
        [below, above].map(|p| o.max(p).max(0.5 * pixel_across) + SLACK * settings.pitch_mm);
    let pitch = settings.pitch_range_mm.map_or(settings.pitch_mm, |[_, most]| most);
    let bridge = pitch.max(2.0 * pixel_along) * (1.0 + SLACK);
    let mut merged = runs.stretches([lines[line] - reach[0], lines[line] + reach[1]], o, bridge);
    for i in &mut merged {
        // Half a pixel on either side stays clear of the neighbours: gaps exceed two pixels.
        let short = 0.5 * (pixel_along - (i.high - i.low)).max(0.0);
        i.low -= short;
        i.high += short;
    }
    merged
}

/// Connection of a pass to the next one.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Link {
    TurnAround,
    Lift,
}

/// Returns the connection of each pass to the next (one fewer than passes), and extends passes that a turn-around joins
/// to the outer of their two ends.
fn link(passes: &mut [Pass], turn: Turn) -> Vec<Link> {
    let own: Vec<Interval> = passes.iter().map(|p| p.along).collect();
    (1..passes.len())
        .map(|i| {
            let (a, b) = (passes[i - 1], passes[i]);
            // The extension to an earlier turn-around does not count.
            let overlap = own[i - 1].low.max(own[i].low) <= own[i - 1].high.min(own[i].high);
            if turn == Turn::Lift || b.place != a.place + 1 || !overlap {
                return Link::Lift;
            }
            if a.forward {
                let outer = a.along.high.max(b.along.high);
                passes[i - 1].along.high = outer;
                passes[i].along.high = outer;
            } else {
                let outer = a.along.low.min(b.along.low);
                passes[i - 1].along.low = outer;
                passes[i].along.low = outer;
            }
            Link::TurnAround
        })
        .collect()
}

/// Returns the path along all passes and links, in (u, w) along and across the lines; `None` if it has too many
/// segments.
fn walk(passes: &[Pass], links: &[Link], settings: &RasterSettings) -> Option<Draft> {
    let s = settings.step_mm;
    let mut path = Draft::default();
    for (i, pass) in passes.iter().enumerate() {
        let (begin, end) = pass.ends();
        let w = pass.across;
        match i.checked_sub(1).map(|before| links[before]) {
            None => path.begin([begin, w]),
            Some(Link::Lift) => path.to([begin, w], false, i - 1),
            Some(Link::TurnAround) => {
                let from = passes[i - 1].across;
                let apart = (w - from).abs();
                if settings.turn == Turn::Semicircle {
                    // The chords of an arc of length pi p/2 are shorter than their arcs.
                    let n = parts(0.5 * PI * apart, s, path.tool_on.len())?.max(MIN_CHORDS);
                    let out = if pass.forward { -0.5 * apart } else { 0.5 * apart };
                    let middle = 0.5 * (from + w);
                    let half = 0.5 * (w - from);
                    for k in 1..n {
                        let (sin, cos) = (PI * k as f64 / n as f64).sin_cos();
                        path.to([begin + out * sin, middle - half * cos], true, i - 1);
                    }
                    path.to([begin, w], true, i - 1);
                } else {
                    let n = parts(apart, s, path.tool_on.len())?;
                    for k in 1..=n {
                        let f = k as f64 / n as f64;
                        let across = if k == n { w } else { from + f * (w - from) };
                        path.to([begin, across], true, i - 1);
                    }
                }
            }
        }
        let n = parts((end - begin).abs(), s, path.tool_on.len())?;
        for k in 1..=n {
            let f = k as f64 / n as f64;
            path.to([if k == n { end } else { begin + f * (end - begin) }, w], true, i);
        }
    }
    Some(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::statistics;
    use ndarray::Array2;
    use planish_testkit::maps::random_aperture;
    use planish_types::{Axis, Grid};
    use proptest::prelude::*;

    fn settings(pitch_mm: f64, step_mm: f64, overscan_mm: f64) -> RasterSettings {
        RasterSettings::new(pitch_mm, step_mm, overscan_mm)
    }

    /// Makes a map with pixels of 0.5 mm and the height `z(x, y)`, nm, NaN outside.
    fn relief(nx: usize, ny: usize, z: impl Fn(f64, f64) -> f64) -> Surface {
        let grid =
            Grid { x: Axis::new(0.0, 0.5, nx).unwrap(), y: Axis::new(0.0, 0.5, ny).unwrap() };
        let height = Array2::from_shape_fn((ny, nx), |(r, c)| {
            z(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
        });
        Surface::new(grid, height).unwrap()
    }

    /// Makes a map with pixels of 0.5 mm, valid where `inside(x, y)` is true.
    fn map(nx: usize, ny: usize, inside: impl Fn(f64, f64) -> bool) -> Surface {
        let z = |x: f64, y: f64| (0.3 * x).sin() + 2.0 * (0.4 * y).cos();
        relief(nx, ny, |x, y| if inside(x, y) { z(x, y) } else { f64::NAN })
    }

    fn disc(x: f64, y: f64) -> bool {
        (x - 20.0).hypot(y - 20.0) <= 20.0
    }

    fn lifts(path: &ToolPath) -> usize {
        path.tool_on().iter().filter(|on| !**on).count()
    }

    #[test]
    fn a_raster_of_one_line_is_told_and_a_usual_turn_can_be_driven() {
        let surface = map(41, 41, |_, _| true);
        for (pitch_mm, told) in [(5.0, 0), (30.0, 1)] {
            let settings = settings(pitch_mm, 1.0, 0.0);
            let path = raster(&surface, &settings).unwrap();
            assert_eq!(settings.warnings(&path).len(), told, "{pitch_mm}");
        }
        for order in [LineOrder::Sequential, LineOrder::BiStep, LineOrder::Random { seed: 2 }] {
            for one_directional in [false, true] {
                let turn = Turn::usual(order, one_directional);
                let settings =
                    RasterSettings { turn, order, one_directional, ..settings(5.0, 1.0, 0.0) };
                assert!(raster(&surface, &settings).is_ok(), "{settings:?}");
            }
        }
    }

    #[test]
    fn the_published_node_pattern_comes_back_exactly() {
        // The reference raster: 26 lines 1 mm apart, nodes at x = -5, -4, .. 97, here on a map
        // whose width is a whole number of mm. The published one starts at the largest y.
        let grid = Grid {
            x: Axis::new(0.0, 0.1, 921).unwrap(),
            y: Axis::new(0.0, 15.670111 / 167.0, 168).unwrap(),
        };
        let surface = Surface::new(grid, Array2::zeros((168, 921))).unwrap();
        let settings =
            RasterSettings { line_origin_mm: Some(20.670111 - 25.0), ..settings(1.0, 1.0, 5.0) };
        let path = raster(&surface, &settings).unwrap();
        assert_eq!((path.point_mm().len(), lifts(&path)), (26 * 103, 0));
        for (i, p) in path.point_mm().iter().enumerate() {
            let (line, k) = (i / 103, i % 103);
            let x = if line % 2 == 0 { -5.0 + k as f64 } else { 97.0 - k as f64 };
            let y = 20.670111 - 25.0 + line as f64;
            // Rounding of coordinates up to 100.
            assert!((p[0] - x).abs() < 1e-12 && (p[1] - y).abs() < 1e-12, "{i}: {p:?}");
        }
    }

    #[test]
    fn centred_lines_leave_the_same_margin_on_both_sides() {
        let path = raster(&map(21, 21, |_, _| true), &settings(3.0, 1.0, 0.0)).unwrap();
        // 10 mm: 4 lines over 9 mm, from 0.5 mm.
        let mut y: Vec<f64> = path.point_mm().iter().map(|p| p[1]).collect();
        assert_eq!((y[0], y[y.len() - 1]), (0.5, 9.5));
        y.retain(|v| (v - 0.5).rem_euclid(3.0) > 1e-12);
        assert_eq!(y.len(), 3 * 2, "nodes within the turn-arounds: {y:?}");
    }

    #[test]
    fn a_pitch_above_the_region_gives_one_line_in_the_middle() {
        let path = raster(&map(21, 21, |_, _| true), &settings(40.0, 2.0, 1.0)).unwrap();
        assert!(path.point_mm().iter().all(|p| p[1] == 5.0));
        assert_eq!((path.point_mm()[0][0], path.len()), (-1.0, 6));
    }

    #[test]
    fn a_semicircle_has_the_radius_of_half_the_pitch_and_leaves_along_the_line() {
        let turn = Turn::Semicircle;
        let settings = RasterSettings { turn, ..settings(2.0, 0.25, 1.0) };
        let path = raster(&map(21, 21, |_, _| true), &settings).unwrap();
        // Beyond the ends (x = -1, 11) all nodes are 1 mm from the middle of their turn.
        let beyond: Vec<_> =
            path.point_mm().iter().filter(|p| p[0] < -1.0 - 1e-9 || p[0] > 11.0 + 1e-9).collect();
        // ceil(pi / 0.25) = 13 chords, 12 inner nodes, 6 turns between 7 lines.
        assert_eq!(beyond.len(), 12 * 6);
        for p in beyond {
            let x = if p[0] < 0.0 { -1.0 } else { 11.0 };
            let y = (p[1] + 1.0).rem_euclid(2.0) - 1.0;
            // Rounding of coordinates of up to 12 mm.
            assert!(((p[0] - x).hypot(y) - 1.0).abs() < 1e-12, "{p:?}");
        }
        // Right first: the second line runs back.
        assert!(path.point_mm().iter().any(|p| (p[0] - 12.0).abs() < 0.01 && p[1] < 1.0));
    }

    #[test]
    fn a_disc_is_one_path_and_an_annulus_lifts_over_its_hole() {
        let path = raster(&map(81, 81, disc), &settings(1.0, 1.0, 3.0)).unwrap();
        assert_eq!((lifts(&path), *path.pass_idx().last().unwrap()), (0, 46));

        let annulus = |x: f64, y: f64| disc(x, y) && (x - 20.0).hypot(y - 20.0) >= 8.0;
        let path = raster(&map(81, 81, annulus), &settings(1.0, 1.0, 3.0)).unwrap();
        // A hole of radius 8 less a square of half-width 3: about 10 mm high, 10 mm wide.
        assert!((9..=11).contains(&lifts(&path)), "{}", lifts(&path));
        let s = statistics(&path, &map(81, 81, annulus));
        assert_eq!((s.lifts, s.passes), (lifts(&path), 47 + lifts(&path)));
    }

    #[test]
    fn islands_apart_along_the_scan_and_across_it() {
        let beside = |x: f64, _: f64| !(10.0..30.0).contains(&x);
        let path = raster(&map(81, 21, beside), &settings(1.0, 1.0, 1.0)).unwrap();
        assert_eq!(lifts(&path), 13);
        let above = |_: f64, y: f64| !(10.0..30.0).contains(&y);
        let path = raster(&map(21, 81, above), &settings(1.0, 1.0, 1.0)).unwrap();
        assert_eq!(lifts(&path), 1);
    }

    #[test]
    fn a_dropout_is_bridged_and_a_wider_hole_is_not() {
        let hole = |width: f64| {
            move |x: f64, y: f64| !((x - 10.0).abs() < 0.5 * width && (y - 10.0).abs() < 4.0)
        };
        // Pixels of 0.5 mm: a hole of "1 mm" leaves 9.5 and 10.5 valid, a gap of 1 mm.
        let count = |width, pitch| {
            lifts(&raster(&map(41, 41, hole(width)), &settings(pitch, 1.0, 0.0)).unwrap())
        };
        assert_eq!(count(1.0, 0.5), 0); // two pixels
        assert_eq!(count(3.0, 3.0), 0); // one pitch
        assert!(count(3.0, 0.5) > 10);
    }

    #[test]
    fn both_lines_reach_the_outer_of_their_ends() {
        // An L: 20 mm wide below y = 5, 5 mm wide above.
        let path =
            raster(&map(41, 41, |x, y| y < 5.0 || x < 5.0), &settings(1.0, 1.0, 2.0)).unwrap();
        assert_eq!(lifts(&path), 0);
        let p = path.point_mm();
        for i in 1..p.len() {
            let (dx, dy) = ((p[i][0] - p[i - 1][0]).abs(), (p[i][1] - p[i - 1][1]).abs());
            assert!(dx == 0.0 || dy == 0.0, "{:?} {:?}", p[i - 1], p[i]);
        }
    }

    #[test]
    fn an_extended_line_does_not_reach_for_an_island() {
        // Lines at y = 0, 1, 2: 0 .. 20, then 0 .. 5 (extended to 20 by its turn), then 10 .. 20.
        let steps =
            map(41, 5, |x, y| y == 0.0 || (y <= 1.0 && x <= 5.0) || (y == 2.0 && x >= 10.0));
        let path = raster(&steps, &settings(1.0, 1.0, 0.0)).unwrap();
        assert_eq!(lifts(&path), 1);
        let lift = path.tool_on().iter().position(|on| !on).unwrap();
        assert_eq!(path.point_mm()[lift..lift + 2], [[0.0, 1.0], [10.0, 2.0]]);
    }

    #[test]
    fn a_single_pixel_gets_a_pass() {
        let one = map(21, 21, |x, y| x == 5.0 && y == 7.5);
        let path = raster(&one, &settings(1.0, 1.0, 0.0)).unwrap();
        assert_eq!(path.point_mm(), [[4.75, 7.5], [5.25, 7.5]]);
    }

    /// Returns the distances of the lines from the first one, mm, in the order in which they are run.
    fn line_order(path: &ToolPath, scan: Scan) -> Vec<f64> {
        let across = scan.axes()[1];
        let w = |i: usize| {
            path.dwell_point_mm()[i][0] * across[0] + path.dwell_point_mm()[i][1] * across[1]
        };
        let on_line = |i: &usize| {
            let d = path.displacement_mm(*i);
            path.tool_on()[*i] && (d[0] * across[0] + d[1] * across[1]).abs() < 1e-9
        };
        let mut lines: Vec<f64> = (0..path.len()).filter(on_line).map(w).collect();
        lines.dedup_by(|a, b| (*a - *b).abs() < 1e-9);
        lines
    }

    fn at_angle(angle_deg: f64) -> RasterSettings {
        RasterSettings { scan: Scan::Angle { angle_deg }, ..settings(1.0, 1.0, 2.0) }
    }

    #[test]
    fn the_angles_0_and_90_are_the_scans_along_x_and_y() {
        let surface = map(41, 31, |x, y| disc(x + 8.0, y + 12.0) && x != 7.0);
        for (angle_deg, scan) in [(0.0, Scan::X), (90.0, Scan::Y), (360.0, Scan::X)] {
            let along = RasterSettings { scan, ..at_angle(0.0) };
            let turned = raster(&surface, &at_angle(angle_deg)).unwrap();
            assert_eq!(turned, raster(&surface, &along).unwrap());
        }
        // From the other side, in the other direction: the same lines of a rectangle.
        let rectangle = map(41, 31, |_, _| true);
        let [a, b] = [0.0, 180.0].map(|a| raster(&rectangle, &at_angle(a)).unwrap());
        let turned: Vec<_> = a.point_mm().iter().map(|p| [20.0 - p[0], 15.0 - p[1]]).collect();
        assert_eq!(turned, b.point_mm());
    }

    #[test]
    fn lines_at_an_angle_are_parallel_a_pitch_apart_and_as_long_as_the_region() {
        let surface = map(81, 41, |_, _| true);
        for angle_deg in [-30.0_f64, 10.0, 45.0, 60.0, 133.0] {
            let settings = RasterSettings { turn: Turn::Lift, ..at_angle(angle_deg) };
            let path = raster(&surface, &settings).unwrap();
            let lines = line_order(&path, settings.scan);
            let (sin, cos) = angle_deg.to_radians().sin_cos();
            // H = 40 |sin a| + 20 |cos a| + 2 o
            let height = 40.0 * sin.abs() + 20.0 * cos.abs() + 4.0;
            assert_eq!(lines.len(), height as usize + 1, "{angle_deg}");
            // Below: rounding of coordinates of up to 50 mm, and of degrees.
            assert!(lines.windows(2).all(|w| (w[1] - w[0] - 1.0).abs() < 1e-9));
            // A convex region: one stretch each; the first runs along the angle.
            assert_eq!(lifts(&path), lines.len() - 1);
            let d = path.displacement_mm(0);
            let away = d[1].atan2(d[0]).to_degrees() - angle_deg;
            assert!(away.abs() < 1e-9, "{away}");
            // The rectangle dilated by a square of half-width o that is turned by a, in lines a
            // pitch apart: A + o P (|sin| + |cos|) + 4 o^2 up to the rounding of the ends by a
            // pixel or a pitch, P = 120 mm.
            let length: f64 = (0..path.len())
                .filter(|i| path.tool_on()[*i])
                .map(|i| path.segment_length_mm(i))
                .sum();
            let area = 800.0 + 2.0 * 120.0 * (sin.abs() + cos.abs()) + 16.0;
            assert!((length / area - 1.0).abs() < 0.05, "{angle_deg}: {length} {area}");
        }
    }

    #[test]
    fn one_direction_returns_with_the_tool_off() {
        let one = RasterSettings { turn: Turn::Lift, one_directional: true, ..at_angle(30.0) };
        let path = raster(&map(41, 31, |_, _| true), &one).unwrap();
        let along = one.scan.axes()[0];
        for i in 0..path.len() {
            let d = path.displacement_mm(i);
            let forward = d[0] * along[0] + d[1] * along[1] > 0.0;
            assert!(path.tool_on()[i] == forward || !path.tool_on()[i], "{i}");
        }
        assert_eq!(lifts(&path) + 1, line_order(&path, one.scan).len());
    }

    #[test]
    fn bi_step_runs_every_other_line_and_comes_back() {
        for (ny, expected) in [
            (11, vec![0.0, 2.0, 4.0, 5.0, 3.0, 1.0]),
            (13, vec![0.0, 2.0, 4.0, 6.0, 5.0, 3.0, 1.0]),
        ] {
            let bi_step = RasterSettings { order: LineOrder::BiStep, ..settings(1.0, 1.0, 0.0) };
            let path = raster(&map(41, ny, |_, _| true), &bi_step).unwrap();
            assert_eq!((line_order(&path, Scan::X), lifts(&path)), (expected, 0));
            let round = RasterSettings { turn: Turn::Semicircle, ..bi_step };
            let path = raster(&map(41, ny, |_, _| true), &round).unwrap();
            // Turns of the radius of a pitch.
            let far = path.point_mm().iter().map(|p| p[0]).fold(0.0, f64::max);
            // Rounding of 21 mm.
            assert!((far - 21.0).abs() < 1e-12, "{far}");
        }
    }

    #[test]
    fn a_random_order_has_every_line_once_and_a_seed() {
        let order = |seed| {
            let order = LineOrder::Random { seed };
            let settings = RasterSettings { order, turn: Turn::Lift, ..settings(1.0, 1.0, 0.0) };
            let path = raster(&map(41, 61, |_, _| true), &settings).unwrap();
            assert_eq!(lifts(&path), 30);
            line_order(&path, Scan::X)
        };
        let mut first = order(3);
        assert_eq!(first, order(3));
        assert_ne!(first, order(4));
        first.sort_unstable_by(f64::total_cmp);
        assert_eq!(first, (0..31).map(f64::from).collect::<Vec<_>>());
    }

    #[test]
    fn the_distance_of_the_lines_is_inverse_to_the_mean_of_the_rows() {
        let ranged =
            |range| RasterSettings { pitch_range_mm: Some(range), ..settings(1.2, 1.0, 1.0) };
        let gaps = |surface: &Surface, settings: &RasterSettings| -> Vec<f64> {
            let lines = line_order(&raster(surface, settings).unwrap(), settings.scan);
            lines.windows(2).map(|w| w[1] - w[0]).collect()
        };
        // r = 1 below y = 10, 3 above (half of the rows each, but for one): p mean r / r.
        let two = relief(41, 40, |_, y| if y < 10.0 { 1.0 } else { 3.0 });
        let found = gaps(&two, &ranged([0.1, 10.0]));
        // Below: rounding of positions of up to 21 mm, which are differences of sums over the rows.
        assert!((found[0] - 2.4).abs() < 1e-9, "{found:?}");
        assert!((found[found.len() - 1] - 0.8).abs() < 1e-9, "{found:?}");
        // At the edge of the bands there is one of mixed size.
        let mixed = found.iter().filter(|g| (**g - 2.4).abs() > 1e-9 && (**g - 0.8).abs() > 1e-9);
        assert!(mixed.count() <= 1, "{found:?}");
        // Bounded; 4 lines of a harmonic mean between the bounds.
        let found = gaps(&two, &ranged([1.0, 2.0]));
        assert!(found.iter().all(|g| (1.0 - 1e-9..=2.0 + 1e-9).contains(g)), "{found:?}");
        assert!(found[0] > 2.0 - 1e-9 && found[found.len() - 1] < 1.0 + 1e-9, "{found:?}");
        // Bands along y: the same for lines along y.
        let turned = relief(40, 41, |x, _| if x < 10.0 { 1.0 } else { 3.0 });
        let along_y = RasterSettings { scan: Scan::Y, ..ranged([0.1, 10.0]) };
        assert_eq!(gaps(&turned, &along_y), gaps(&two, &ranged([0.1, 10.0])));
        // Lines along x do not see them; a flat map and one of zeros are a raster.
        for surface in [&turned, &relief(41, 40, |_, _| 7.0), &relief(41, 40, |_, _| 0.0)] {
            let found = gaps(surface, &ranged([0.1, 10.0]));
            assert_eq!(found.len(), gaps(surface, &settings(1.2, 1.0, 1.0)).len());
            // As above.
            assert!(found.iter().all(|g| (g - 1.2).abs() < 1e-9), "{found:?}");
        }
    }

    #[test]
    fn bad_settings_are_refused_with_the_value() {
        let surface = map(21, 21, |_, _| true);
        let good = settings(1.0, 1.0, 1.0);
        let cases = [
            (RasterSettings { pitch_mm: 0.0, ..good.clone() }, "pitch_mm: is 0"),
            (RasterSettings { pitch_mm: f64::NAN, ..good.clone() }, "pitch_mm: is NaN"),
            (RasterSettings { step_mm: -1.0, ..good.clone() }, "step_mm: is -1"),
            (RasterSettings { step_mm: f64::INFINITY, ..good.clone() }, "step_mm: is inf"),
            (RasterSettings { overscan_mm: -0.5, ..good.clone() }, "overscan_mm: is -0.5"),
            (RasterSettings { line_origin_mm: Some(f64::NAN), ..good.clone() }, "line_origin_mm"),
            (RasterSettings { pitch_mm: 1e-9, ..good.clone() }, "more than 20000000"),
            (RasterSettings { step_mm: 1e-7, ..good.clone() }, "more than 20000000"),
            (RasterSettings { step_mm: 5e-324, ..good.clone() }, "more than 20000000"),
            (RasterSettings { overscan_mm: 1e300, ..good.clone() }, "overscan_mm: is 1e300"),
            (
                RasterSettings { line_origin_mm: Some(1e308), pitch_mm: 1e-9, ..good.clone() },
                "more",
            ),
            (
                RasterSettings { pitch_mm: 100.0, line_origin_mm: Some(50.0), ..good.clone() },
                "no line 50 + k * 100 mm lies in the region (-1 .. 11 mm)",
            ),
        ];
        let ranged = |range| RasterSettings { pitch_range_mm: Some(range), ..good.clone() };
        let random = LineOrder::Random { seed: 1 };
        let variants = [
            (at_angle(f64::NAN), "angle_deg: is NaN"),
            (ranged([0.0, 1.0]), "pitch_range_mm: is 0"),
            (ranged([2.0, 1.0]), "pitch_range_mm: is 2 to 1"),
            (ranged([1e-9, 1e-9]), "a pitch of 1e-9 mm"),
            (RasterSettings { line_origin_mm: Some(0.0), ..ranged([1.0, 2.0]) }, "follow the map"),
            (RasterSettings { one_directional: true, ..good.clone() }, "need lifts"),
            (RasterSettings { order: random, ..good.clone() }, "need lifts"),
        ];
        for (settings, message) in cases.into_iter().chain(variants) {
            let error = raster(&surface, &settings).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
    }

    /// Returns true if two segments have a point in common.
    fn touch(a: [[f64; 2]; 2], b: [[f64; 2]; 2]) -> bool {
        let side = |p: [f64; 2], q: [f64; 2], r: [f64; 2]| {
            (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        };
        let between = |i: usize| {
            a[0][i].max(a[1][i]) >= b[0][i].min(b[1][i])
                && b[0][i].max(b[1][i]) >= a[0][i].min(a[1][i])
        };
        between(0)
            && between(1)
            && side(a[0], a[1], b[0]) * side(a[0], a[1], b[1]) <= 0.0
            && side(b[0], b[1], a[0]) * side(b[0], b[1], a[1]) <= 0.0
    }

    prop_compose! {
        fn random_settings()(
            pitch_mm in 0.3..3.0_f64,
            step_mm in 0.3..3.0_f64,
            overscan_mm in prop_oneof![Just(0.0), 0.0..3.0_f64],
            scan in prop_oneof![
                Just(Scan::X),
                Just(Scan::Y),
                (-360.0..360.0_f64).prop_map(|angle_deg| Scan::Angle { angle_deg }),
            ],
            (order, one_directional, turn) in prop::sample::select(vec![
                (LineOrder::Sequential, false, Turn::Square),
                (LineOrder::Sequential, false, Turn::Semicircle),
                (LineOrder::Sequential, false, Turn::Lift),
                (LineOrder::Sequential, true, Turn::Lift),
                (LineOrder::BiStep, false, Turn::Square),
                (LineOrder::BiStep, false, Turn::Semicircle),
                (LineOrder::BiStep, true, Turn::Lift),
                (LineOrder::Random { seed: 5 }, false, Turn::Lift),
                (LineOrder::Random { seed: 6 }, true, Turn::Lift),
            ]),
            range in prop::option::of((0.3..1.0_f64, 1.0..3.0_f64)),
        ) -> RasterSettings {
            let pitch_range_mm = range.map(|(least, most)| [least, most]);
            RasterSettings {
                scan, turn, order, one_directional, pitch_range_mm,
                ..settings(pitch_mm, step_mm, overscan_mm)
            }
        }
    }

    proptest! {
        #[test]
        fn what_holds_for_every_aperture(surface in random_aperture(2..24), settings in random_settings()) {
            let path = raster(&surface, &settings).unwrap();
            let (p, on) = (path.point_mm(), path.tool_on());
            for i in 0..path.len() {
                let length = path.segment_length_mm(i);
                prop_assert!(length > 0.0, "segment {i} has no length");
                prop_assert!(!on[i] || length <= settings.step_mm * (1.0 + 1e-9), "{i}: {length}");
                // A lift ends its pass, a pass begins and ends with the tool on.
                let pass = path.pass_idx();
                let ends_pass = i + 1 == path.len() || pass[i + 1] == pass[i] + 1;
                prop_assert!(on[i] || (ends_pass && i > 0 && i + 1 < path.len()));
                prop_assert!(ends_pass || pass[i + 1] == pass[i]);
            }
            prop_assert_eq!(path.pass_idx()[0], 0);
            // Every pixel is served: within half a pitch of a line, which spans it, or which a
            // step of that line crosses.
            let covered = statistics(&path, &surface).coverage_mm.unwrap();
            let widest = settings.pitch_range_mm.map_or(settings.pitch_mm, |[_, most]| most);
            prop_assert!(covered <= 0.5 * widest + 1e-6, "{covered}");
            // The tool never meets its own track, but for the links of a bi-step raster.
            let [along, across] = settings.scan.axes();
            let over = |i: usize, axis: [f64; 2]| {
                let d = path.displacement_mm(i);
                d[0] * axis[0] + d[1] * axis[1]
            };
            let link = |i: usize| over(i, across).abs() > 1e-9;
            let tracks: Vec<_> =
                (0..path.len()).filter(|i| on[*i]).map(|i| (i, [p[i], p[i + 1]])).collect();
            for (k, (i, a)) in tracks.iter().enumerate() {
                for (j, b) in &tracks[k + 1..] {
                    let may = settings.order == LineOrder::BiStep && (link(*i) || link(*j));
                    prop_assert!(may || *j == i + 1 || !touch(*a, *b), "{a:?} meets {b:?}");
                }
                prop_assert!(settings.turn != Turn::Lift || !link(*i), "{i}");
                prop_assert!(!settings.one_directional || over(*i, along) > 0.0, "{i}");
            }
            if settings.turn == Turn::Lift {
                // Not drawn out to turns, the lines stay by the aperture: a pixel is as near as
                // the overscan and half of a bridged gap along, the reach of a line across. A
                // pixel is at most 0.5 sqrt(2) mm.
                let pixel = 0.5 * 2.0_f64.sqrt();
                let o = settings.overscan_mm;
                let far = [o + 0.5 * widest.max(2.0 * pixel), o.max(0.5 * widest).max(0.5 * pixel)];
                let grid = surface.grid();
                for (i, _) in &tracks {
                    let [x, y] = path.dwell_point_mm()[*i];
                    let valid = surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan());
                    let near = valid.map(|((r, c), _)| [grid.x.coordinate_mm(c) - x, grid.y.coordinate_mm(r) - y]).any(|d| {
                        let at = [along, across].map(|axis| (d[0] * axis[0] + d[1] * axis[1]).abs());
                        // A band between two pixels, and rounding.
                        at[0] <= far[0] + pixel && at[1] <= far[1] + 1e-6 + pixel
                    });
                    prop_assert!(near, "{x} {y}");
                }
            }
            prop_assert_eq!(raster(&surface, &settings).unwrap(), path);
        }

        #[test]
        fn a_scan_along_y_is_the_transposed_scan_along_x(
            surface in random_aperture(2..24), settings in random_settings(),
        ) {
            let scan = if settings.scan == Scan::Y { Scan::Y } else { Scan::X };
            let settings = RasterSettings { scan, ..settings };
            let g = *surface.grid();
            let transposed = Surface::new(
                Grid { x: g.y, y: g.x },
                surface.height_nm().t().to_owned(),
            ).unwrap();
            let other = RasterSettings {
                scan: if settings.scan == Scan::X { Scan::Y } else { Scan::X },
                ..settings.clone()
            };
            let a = raster(&surface, &settings).unwrap();
            let b = raster(&transposed, &other).unwrap();
            prop_assert!(a.point_mm().iter().zip(b.point_mm()).all(|(a, b)| *a == [b[1], b[0]]));
            prop_assert_eq!((a.tool_on(), a.pass_idx()), (b.tool_on(), b.pass_idx()));
        }

        #[test]
        fn lines_with_an_origin_pass_through_it_and_cover(
            surface in random_aperture(2..24), settings in random_settings(), origin in -20.0..20.0_f64,
        ) {
            let line_origin_mm = Some(origin);
            let settings = RasterSettings { line_origin_mm, pitch_range_mm: None, ..settings };
            let Ok(path) = raster(&surface, &settings) else { return Ok(()) };
            let (across, p) = (settings.scan.axes()[1], path.point_mm()[0]);
            let w = p[0] * across[0] + p[1] * across[1];
            let k = (w - origin) / settings.pitch_mm;
            prop_assert!((k - k.round()).abs() < 1e-9);
            let covered = statistics(&path, &surface).coverage_mm.unwrap();
            prop_assert!(covered <= settings.pitch_mm * (1.0 + 1e-9), "{covered}");
        }
    }
}
