//! The raster: parallel lines at one pitch, scanned back and forth, joined by turn-arounds.
//!
//! The valid pixels of a map are the clear aperture, each as its centre. With u along the lines,
//! w across them, and the overscan o:
//!
//! ```text
//! lines      w_k = w_mid + (k - (n-1)/2) p,  n = floor(H/p) + 1,  H = extent of the region
//!            or w_k = C + k p, every k in the region
//! interval   union over the pixel rows w with |w - w_k| <= max(o, p/2, h/2) of their runs
//!            [u_first - o, u_last + o] of valid pixels; touching intervals are one
//! nodes      L / ceil(L/s) apart
//! ```
//!
//! * The region is the aperture dilated by a square of half-width o (h is the pixel). A line
//!   never serves less than the half pitch beside it, and the first and the last line serve all
//!   that lies beyond them, so that every pixel is at most p from the path, whatever o.
//! * Gaps along a line that are left after that are bridged with the tool on when they are at
//!   most one pitch or two pixels wide: dropouts and masked pits. Wider ones are lifts.
//! * An interval shorter than a pixel is widened to one, so that every pass has a length.
//! * Consecutive lines whose intervals overlap are joined with the tool on: both are extended to
//!   the outer of their two ends on that side, so that the turn is perpendicular, and joined by a
//!   straight step or a semicircle of radius p/2. A line that has several intervals, or does not
//!   overlap with the next one, ends in a lift: one straight segment with the tool off.
//! * The first line has the smallest w and runs towards larger u; every other line runs back,
//!   lines without an interval included. Each interval is one pass; a link belongs to the pass
//!   that it leaves.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | p | `pitch_mm` | - | mm |
//! | s | `step_mm` | - | mm |
//! | o | `overscan_mm` | - | mm |
//! | C | `line_origin_mm` | - | mm |
//! | w_k | `lines` | (n) | mm |

use std::f64::consts::PI;

use planish_types::{Invalid, Surface, ToolPath};
use serde::Serialize;

use crate::{
    MAX_SEGMENTS, ToolPathError,
    draft::{Draft, parts},
    region::{Aperture, Interval, SLACK, check_length},
};

/// Fewest chords of a semicircle: 45 degrees between neighbours.
const MIN_CHORDS: usize = 4;

/// How to scan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RasterSettings {
    /// Distance between the lines, mm; > 0.
    pub pitch_mm: f64,
    /// Longest segment, mm; > 0.
    pub step_mm: f64,
    /// How far the path goes beyond the clear aperture, mm; >= 0. Half the TIF's size keeps the
    /// removal at the edge equal to that inside.
    pub overscan_mm: f64,
    /// Direction of the lines.
    pub scan: Scan,
    /// How consecutive lines are joined.
    pub turn: Turn,
    /// Coordinate of one line (y for lines along x), mm; `None` centres the lines.
    pub line_origin_mm: Option<f64>,
}

/// Direction of the lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Scan {
    /// Lines along x.
    #[default]
    X,
    /// Lines along y.
    Y,
}

/// How consecutive lines are joined.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Turn {
    /// A straight step across; two corners of 90 degrees.
    #[default]
    Square,
    /// A semicircle beyond the ends of the lines; no corner.
    Semicircle,
}

/// A raster over the valid pixels of `surface`.
pub fn raster(surface: &Surface, settings: &RasterSettings) -> Result<ToolPath, ToolPathError> {
    check(settings)?;
    let (grid, map) = (surface.grid(), surface.height_nm().view());
    let aperture = match settings.scan {
        Scan::X => Aperture::new(&grid.x, &grid.y, map),
        Scan::Y => Aperture::new(&grid.y, &grid.x, map.reversed_axes()),
    };
    let lines = lines(&aperture, settings)?;
    let mut passes = passes(&aperture, &lines, settings)?;
    let links = link(&mut passes);
    let mut path = walk(&passes, &links, settings).ok_or_else(|| too_many(&aperture, settings))?;
    if settings.scan == Scan::Y {
        path.point_mm.iter_mut().for_each(|p| p.swap(0, 1));
    }
    Ok(path.finish()?)
}

fn check(settings: &RasterSettings) -> Result<(), Invalid> {
    check_length("pitch_mm", settings.pitch_mm, false)?;
    check_length("step_mm", settings.step_mm, false)?;
    check_length("overscan_mm", settings.overscan_mm, true)?;
    match settings.line_origin_mm {
        Some(c) if !c.is_finite() => Err(Invalid::whole(
            "line_origin_mm",
            format!("is {c}"),
            "give a finite coordinate in mm",
        )),
        _ => Ok(()),
    }
}

fn too_many(aperture: &Aperture, settings: &RasterSettings) -> ToolPathError {
    let along = aperture.along(settings.overscan_mm);
    let across = aperture.across(settings.overscan_mm);
    ToolPathError::TooManySegments {
        pitch_mm: settings.pitch_mm,
        step_mm: settings.step_mm,
        extent_mm: [along.high - along.low, across.high - across.low],
    }
}

/// Coordinates of the lines, ascending.
fn lines(aperture: &Aperture, settings: &RasterSettings) -> Result<Vec<f64>, ToolPathError> {
    let p = settings.pitch_mm;
    let region = aperture.across(settings.overscan_mm);
    let (first, spaces) = match settings.line_origin_mm {
        None => {
            // w_k = w_mid + (k - (n-1)/2) p,  n = floor(H/p) + 1
            let spaces = ((region.high - region.low) / p + SLACK).floor();
            (0.5 * (region.low + region.high) - 0.5 * spaces * p, spaces)
        }
        Some(origin) => {
            // w_k = C + k p in the region
            let first = ((region.low - origin) / p - SLACK).ceil();
            let last = ((region.high - origin) / p + SLACK).floor();
            if first > last {
                return Err(ToolPathError::NoLine {
                    origin_mm: origin,
                    pitch_mm: p,
                    low_mm: region.low,
                    high_mm: region.high,
                });
            }
            (origin + first * p, last - first)
        }
    };
    // Every line has a segment, and every turn.
    if spaces.is_nan() || 2.0 * spaces >= MAX_SEGMENTS as f64 {
        return Err(too_many(aperture, settings));
    }
    Ok((0..=spaces as usize).map(|k| first + k as f64 * p).collect())
}

/// One stretch of one line with the tool on.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pass {
    line: usize,
    across: f64,
    along: Interval,
    /// Towards larger coordinates.
    forward: bool,
}

impl Pass {
    /// Where the pass begins and ends, along the line.
    fn ends(&self) -> (f64, f64) {
        let Interval { low, high } = self.along;
        if self.forward { (low, high) } else { (high, low) }
    }
}

/// The passes in the order in which they are run.
fn passes(
    aperture: &Aperture,
    lines: &[f64],
    settings: &RasterSettings,
) -> Result<Vec<Pass>, ToolPathError> {
    let mut passes = Vec::new();
    let mut segments = 0.0;
    for (line, &across) in lines.iter().enumerate() {
        let forward = line % 2 == 0;
        let mut intervals = intervals(aperture, lines, line, settings);
        if !forward {
            intervals.reverse();
        }
        for along in intervals {
            segments += ((along.high - along.low) / settings.step_mm).ceil();
            passes.push(Pass { line, across, along, forward });
        }
        if segments > MAX_SEGMENTS as f64 {
            return Err(too_many(aperture, settings));
        }
    }
    Ok(passes)
}

/// Where the tool is on along a line, ascending and apart from each other.
fn intervals(
    aperture: &Aperture,
    lines: &[f64],
    line: usize,
    settings: &RasterSettings,
) -> Vec<Interval> {
    let o = settings.overscan_mm;
    let [pixel_along, pixel_across] = aperture.pixel_mm;
    let reach = o.max(0.5 * settings.pitch_mm).max(0.5 * pixel_across);
    let reach = reach + SLACK * settings.pitch_mm;
    let low = if line == 0 { f64::NEG_INFINITY } else { lines[line] - reach };
    let high = if line + 1 == lines.len() { f64::INFINITY } else { lines[line] + reach };
    let bridge = settings.pitch_mm.max(2.0 * pixel_along) * (1.0 + SLACK);
    // |w - w_k| <= max(o, p/2, h/2),  [u_first - o, u_last + o]
    let mut merged = aperture.stretches(low, high, o, bridge);
    for i in &mut merged {
        // Half a pixel on either side stays clear of the neighbours: gaps exceed two pixels.
        let short = 0.5 * (pixel_along - (i.high - i.low)).max(0.0);
        (i.low, i.high) = (i.low - short, i.high + short);
    }
    merged
}

/// How the tool comes from a pass to the next.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Link {
    TurnAround,
    Lift,
}

/// Decides every link (one fewer than passes) and extends the passes to their turn-arounds.
fn link(passes: &mut [Pass]) -> Vec<Link> {
    let own: Vec<Interval> = passes.iter().map(|p| p.along).collect();
    (1..passes.len())
        .map(|i| {
            let (a, b) = (passes[i - 1], passes[i]);
            // The extension to an earlier turn-around does not count.
            let overlap = own[i - 1].low.max(own[i].low) <= own[i - 1].high.min(own[i].high);
            if b.line != a.line + 1 || !overlap {
                return Link::Lift;
            }
            if a.forward {
                let outer = a.along.high.max(b.along.high);
                (passes[i - 1].along.high, passes[i].along.high) = (outer, outer);
            } else {
                let outer = a.along.low.min(b.along.low);
                (passes[i - 1].along.low, passes[i].along.low) = (outer, outer);
            }
            Link::TurnAround
        })
        .collect()
}

/// All nodes in order; `None` when there are too many.
fn walk(passes: &[Pass], links: &[Link], settings: &RasterSettings) -> Option<Draft> {
    let (p, s) = (settings.pitch_mm, settings.step_mm);
    let mut path = Draft::default();
    for (i, pass) in passes.iter().enumerate() {
        let (begin, end) = pass.ends();
        let w = pass.across;
        match i.checked_sub(1).map(|before| links[before]) {
            None => path.begin([begin, w]),
            Some(Link::Lift) => path.to([begin, w], false, i - 1),
            Some(Link::TurnAround) => {
                let from = passes[i - 1].across;
                match settings.turn {
                    Turn::Square => {
                        let n = parts(p, s, path.tool_on.len())?;
                        for k in 1..=n {
                            let f = k as f64 / n as f64;
                            path.to(
                                [begin, if k == n { w } else { from + f * (w - from) }],
                                true,
                                i - 1,
                            );
                        }
                    }
                    Turn::Semicircle => {
                        // The chords of an arc of length pi p/2 are shorter than their arcs.
                        let n = parts(0.5 * PI * p, s, path.tool_on.len())?.max(MIN_CHORDS);
                        let (r, outwards) = (0.5 * p, if pass.forward { -1.0 } else { 1.0 });
                        for k in 1..n {
                            let (sin, cos) = (PI * k as f64 / n as f64).sin_cos();
                            let middle = 0.5 * (from + w);
                            path.to([begin + outwards * r * sin, middle - r * cos], true, i - 1);
                        }
                        path.to([begin, w], true, i - 1);
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
    use planish_types::{Axis, Grid};
    use proptest::prelude::*;

    fn settings(pitch_mm: f64, step_mm: f64, overscan_mm: f64) -> RasterSettings {
        RasterSettings {
            pitch_mm,
            step_mm,
            overscan_mm,
            scan: Scan::X,
            turn: Turn::Square,
            line_origin_mm: None,
        }
    }

    /// Pixels of 0.5 mm where `inside(x, y)` holds.
    fn map(nx: usize, ny: usize, inside: impl Fn(f64, f64) -> bool) -> Surface {
        let grid =
            Grid { x: Axis::new(0.0, 0.5, nx).unwrap(), y: Axis::new(0.0, 0.5, ny).unwrap() };
        let height = Array2::from_shape_fn((ny, nx), |(r, c)| {
            if inside(grid.x.at(c), grid.y.at(r)) { 0.0 } else { f64::NAN }
        });
        Surface::new(grid, height).unwrap()
    }

    fn disc(x: f64, y: f64) -> bool {
        (x - 20.0).hypot(y - 20.0) <= 20.0
    }

    fn lifts(path: &ToolPath) -> usize {
        path.tool_on().iter().filter(|on| !**on).count()
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
            (RasterSettings { overscan_mm: 1e300, ..good.clone() }, "more than 20000000"),
            (
                RasterSettings { line_origin_mm: Some(1e308), pitch_mm: 1e-9, ..good.clone() },
                "more",
            ),
            (
                RasterSettings { pitch_mm: 100.0, line_origin_mm: Some(50.0), ..good.clone() },
                "no line 50 + k * 100 mm lies in the region (-1 .. 11 mm)",
            ),
        ];
        for (settings, message) in cases {
            let error = raster(&surface, &settings).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
    }

    /// Whether two segments have a point in common.
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
        /// Blobs and holes, from nearly full to nearly empty.
        fn random_map()(
            nx in 2..24_usize,
            ny in 2..24_usize,
            blobs in prop::collection::vec(
                (0.0..12.0_f64, 0.0..12.0_f64, 0.3..6.0_f64, any::<bool>()), 0..7,
            ),
            base in any::<bool>(),
            keep in (0.0..1.0_f64, 0.0..1.0_f64),
        ) -> Surface {
            let kept = (
                (keep.0 * nx as f64).floor() * 0.5,
                (keep.1 * ny as f64).floor() * 0.5,
            );
            map(nx, ny, |x, y| {
                (x, y) == kept || blobs.iter().fold(base, |inside, (bx, by, r, fill)| {
                    if (x - bx).hypot(y - by) <= *r { *fill } else { inside }
                })
            })
        }
    }

    prop_compose! {
        fn random_settings()(
            pitch_mm in 0.3..3.0_f64,
            step_mm in 0.3..3.0_f64,
            overscan_mm in prop_oneof![Just(0.0), 0.0..3.0_f64],
            scan in prop_oneof![Just(Scan::X), Just(Scan::Y)],
            turn in prop_oneof![Just(Turn::Square), Just(Turn::Semicircle)],
        ) -> RasterSettings {
            RasterSettings {
                pitch_mm, step_mm, overscan_mm, scan, turn, line_origin_mm: None,
            }
        }
    }

    proptest! {
        #[test]
        fn what_holds_for_every_aperture(surface in random_map(), settings in random_settings()) {
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
            let limit = settings.pitch_mm.max(settings.step_mm);
            prop_assert!(covered <= limit, "{covered}");
            prop_assert!(covered <= 0.5 * settings.pitch_mm + 1e-6, "{covered}");
            // The tool never meets its own track.
            let tracks: Vec<_> =
                (0..path.len()).filter(|i| on[*i]).map(|i| (i, [p[i], p[i + 1]])).collect();
            for (k, (i, a)) in tracks.iter().enumerate() {
                for (j, b) in &tracks[k + 1..] {
                    prop_assert!(*j == i + 1 || !touch(*a, *b), "{a:?} meets {b:?}");
                }
            }
            prop_assert_eq!(raster(&surface, &settings).unwrap(), path);
        }

        #[test]
        fn a_scan_along_y_is_the_transposed_scan_along_x(
            surface in random_map(), settings in random_settings(),
        ) {
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
            surface in random_map(), settings in random_settings(), origin in -20.0..20.0_f64,
        ) {
            let settings = RasterSettings { line_origin_mm: Some(origin), ..settings };
            let Ok(path) = raster(&surface, &settings) else { return Ok(()) };
            let across = if settings.scan == Scan::X { 1 } else { 0 };
            let k = (path.point_mm()[0][across] - origin) / settings.pitch_mm;
            prop_assert!((k - k.round()).abs() < 1e-9);
            let covered = statistics(&path, &surface).coverage_mm.unwrap();
            prop_assert!(covered <= settings.pitch_mm * (1.0 + 1e-9), "{covered}");
        }
    }
}
