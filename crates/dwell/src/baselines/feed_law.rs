//! The feed law of multi-pitch rasters: the dwell time of a segment is its removal depth times its area over the VRR,
//! without a solver.
//!
//! ```text
//! v = VRR / (d r) <= v_max                                                                (1)
//! t = l max(d r / (k VRR), 1 / v_max)                                                     (2)
//! ```
//!
//! Lines a distance d apart, run at the feed v, remove the depth r on average. The law is right where the depth varies
//! slowly over the width of the TIF, and leaves the ripple of the lines. It ignores the removal of a line on its
//! neighbours. `1 / v_max` is the floor of the dwell times, s/mm.
//!
//! * *Lines* are sequences of consecutive segments with the tool on in the direction that most of the path has. The
//!   segments between them have the floor as dwell time.
//! * *Pitch* d of a line: in a pass of several lines, as a region of a multi-pitch path is, the median of their
//!   distances to the nearest one beside them; in a pass of one line, as of a raster, half the distance between the
//!   lines on both sides of it, or the distance to the only one.
//! * *Runs* k of a segment: the number of lines over its dwell point, as on a path that is run several times; each
//!   removes 1/k of the depth.
//! * *Depth* r of a segment: the mean of the map, linear between its pixels, over a square of the area l d around the
//!   point where the tool removes (dwell point plus centroid of the TIF); where the square holds no valid pixel, that
//!   of the nearest one. If the map has negative heights, a constant is added so that its minimum is 0.
//!
//! Source: Development of multi-pitch tool path in computer-controlled optical surfacing processes, JEOS-RP 13 (2017),
//! Eqs 11 and 12.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | l | `segment_length_mm` | (n) | mm |
//! | d | `pitch_mm` | (n) | mm |
//! | k | `runs` | - | 1 |
//! | r | `depth_nm` | - | nm |

use std::collections::BTreeMap;

use planish_types::{Axis, DwellTime, End, Invalid, Surface, Tif, ToolPath, progress};
use serde::Serialize;

use crate::{
    DwellError,
    bounds::{self, Bound},
    problem::{DwellModel, Problem, Solution, check},
};

/// Sine of the angle to the common direction up to which a segment belongs to a line. Larger: segments of curves count
/// as lines. Smaller: rounding of coordinates splits lines.
const PARALLEL: f64 = 1e-3;

/// Distance below which two lines are the same line, mm. Larger: lines of a fine pitch are merged. Smaller: rounding
/// of coordinates makes two lines of one, and a pitch near zero.
const SAME_LINE_MM: f64 = 1e-6;

/// Smallest fraction of the length with the tool on that must lie on parallel lines, dimensionless; the law refuses a
/// path with less. Larger: rasters with long links are refused. Smaller: paths without a pitch are accepted. Chosen:
/// above one half, the fraction of a maze path along one of its two directions.
const LEAST_PART_OF_LINES: f64 = 0.6;

/// Settings of the feed law.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct FeedLawSettings {
    /// Pitch d of all lines, mm; measured line by line if absent.
    pub pitch_mm: Option<f64>,
}

/// Report of the feed law.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FeedLawReport {
    /// Always `direct`: nothing is solved for.
    pub end: End,
    /// Number of lines of the raster.
    pub lines: usize,
    /// Smallest and largest pitch d of the lines, mm.
    pub pitch_mm: [f64; 2],
    /// Number of segments of lines whose dwell time by the law is below the floor, which is used instead. The tool
    /// removes more there than is desired.
    pub too_fast: usize,
    /// Height that was added to the map so that no height is negative, nm.
    pub lifted_nm: f64,
}

/// Computes the dwell times (2) of the module, and their effect in the removal model of the solvers.
///
/// # Errors
/// Refuses what [`dwell`] refuses, weights out of range, a TIF that varies in time, and a tool that does not reach the
/// map.
pub fn solve(
    problem: &Problem<'_>,
    settings: &FeedLawSettings,
) -> Result<Solution<FeedLawReport>, DwellError> {
    let Problem { desired, tif, path, min_dwell, .. } = *problem;
    // What they remove takes as long.
    let (dwell, report) = progress::part(0, 2, || dwell(desired, tif, path, min_dwell, settings))?;
    DwellModel::with_any_floor(problem)?.finish_as_they_are(dwell.dwell_s().to_vec(), report)
}

/// Computes the dwell times (2) of the module alone, without their effect.
///
/// # Errors
/// Refuses a pitch that is not positive, a path of which too little lies on parallel lines, a line without another one
/// beside it if no pitch is given, a floor out of range, and a TIF that varies over the part.
pub fn dwell(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    min_dwell: Bound,
    settings: &FeedLawSettings,
) -> Result<(DwellTime, FeedLawReport), Invalid> {
    if let Some(pitch_mm) = settings.pitch_mm {
        check("pitch_mm", pitch_mm, |p| p > 0.0, "give a distance above 0")?;
    }
    let mut dwell_s = bounds::lower(path, min_dwell)?;
    let (lines, along) = lines(path)?;
    let same_place = in_the_same_place(&lines);
    let pitches = match settings.pitch_mm {
        Some(pitch_mm) => vec![pitch_mm; lines.len()],
        None => measured(&lines)?,
    };
    let lifted_nm = (-desired.statistics().min).max(0.0);
    tif.same_everywhere("the feed law")?;
    let vrr = tif.vrr_nm_mm2_per_s();
    let [off_x, off_y] = tif.centroid_mm();
    let mut too_fast = 0;
    for (line_idx, (line, pitch_mm)) in lines.iter().zip(&pitches).enumerate() {
        progress::done(line_idx as f64 / lines.len() as f64);
        for i in line.segments.clone() {
            let length_mm = path.segment_length_mm(i);
            let side_mm = (length_mm * pitch_mm).sqrt();
            // Where the tool removes when it is at the dwell point
            let [x, y] = path.dwell_point_mm()[i];
            let depth_nm = depth_nm(desired, [x + off_x, y + off_y], side_mm) + lifted_nm;
            let position_mm = x * along[0] + y * along[1];
            let others = same_place[line_idx].iter();
            let runs = 1 + others
                .filter(|[low, high]| *low <= position_mm && position_mm <= *high)
                .count();
            // (2)
            let time_s = length_mm * pitch_mm * depth_nm / (runs as f64 * vrr);
            too_fast += usize::from(time_s < dwell_s[i]);
            dwell_s[i] = dwell_s[i].max(time_s);
        }
    }
    let report = FeedLawReport {
        end: End::Direct,
        lines: lines.len(),
        pitch_mm: [
            pitches.iter().copied().fold(f64::INFINITY, f64::min),
            pitches.iter().copied().fold(0.0, f64::max),
        ],
        too_fast,
        lifted_nm,
    };
    Ok((DwellTime::new(dwell_s)?, report))
}

/// A line of the raster: consecutive segments in the common direction.
#[derive(Clone, Debug)]
struct RasterLine {
    segments: std::ops::Range<usize>,
    pass: i64,
    /// Coordinate across the lines, from an origin that all lines share, mm.
    across_mm: f64,
    /// Start and end along the direction of the lines, from an origin that all lines share, mm.
    along_mm: [f64; 2],
}

/// Returns the lines of a path, in its order, and the unit vector [x, y] of their direction. Refuses a path with less
/// than [`LEAST_PART_OF_LINES`] of its length on parallel lines.
fn lines(path: &ToolPath) -> Result<(Vec<RasterLine>, [f64; 2]), Invalid> {
    let is_on = |i: &usize| path.tool_on()[*i] && path.segment_length_mm(*i) > 0.0;
    let on: Vec<usize> = (0..path.len()).filter(is_on).collect();
    let length_mm = on.iter().fold(0.0, |sum, i| sum + path.segment_length_mm(*i));
    // Of all segments at first, and of the lines alone in the end: slanted links turn it.
    let mut along = main_direction(path, &on);
    let mut parallel = Vec::new();
    for within in [0.1, 0.01, PARALLEL] {
        let across = [-along[1], along[0]];
        let segments = on.iter().copied();
        parallel = segments.filter(|i| dot(unit(path, *i), across).abs() <= within).collect();
        along = main_direction(path, &parallel);
    }
    let across = [-along[1], along[0]];
    let mut lines: Vec<RasterLine> = Vec::new();
    let mut of_lines_mm = 0.0;
    for i in parallel {
        of_lines_mm += path.segment_length_mm(i);
        let [a, b] = [path.point_mm()[i], path.point_mm()[i + 1]].map(|p| dot(p, along));
        let low = a.min(b);
        let high = a.max(b);
        let pass = path.pass_idx()[i];
        let across_mm = dot(path.dwell_point_mm()[i], across);
        match lines.last_mut() {
            Some(line) if line.segments.end == i && line.pass == pass => {
                line.segments.end = i + 1;
                line.along_mm = [line.along_mm[0].min(low), line.along_mm[1].max(high)];
            }
            _ => lines.push(RasterLine {
                segments: i..i + 1,
                pass,
                across_mm,
                along_mm: [low, high],
            }),
        }
    }
    if of_lines_mm < LEAST_PART_OF_LINES * length_mm || lines.is_empty() {
        let problem = format!(
            "has no lines in one direction: {of_lines_mm:.1} of {length_mm:.1} mm with the tool on are parallel"
        );
        let remedy = "give a raster or a multi-pitch path, or use a solver: bounded-least-squares";
        return Err(Invalid::whole("point_mm", problem, remedy));
    }
    Ok((lines, along))
}

/// Returns the scalar product of two vectors [x, y].
fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

/// Returns the unit vector [x, y] along segment i.
fn unit(path: &ToolPath, i: usize) -> [f64; 2] {
    path.displacement_mm(i).map(|d| d / path.segment_length_mm(i))
}

/// Returns the unit vector [x, y] of the direction in which most of the length of some segments lies. It comes from
/// the sum of l exp(2 i angle), in which opposite directions are the same.
fn main_direction(path: &ToolPath, segments: &[usize]) -> [f64; 2] {
    let mut cosine = 0.0;
    let mut sine = 0.0;
    for i in segments {
        let l = path.segment_length_mm(*i);
        let [x, y] = unit(path, *i);
        cosine += l * (x * x - y * y);
        sine += l * 2.0 * x * y;
    }
    let angle = 0.5 * f64::atan2(sine, cosine);
    [angle.cos(), angle.sin()]
}

/// Returns, for each line, the intervals [start, end] along the lines, mm, of all other lines whose coordinate across
/// differs by at most [`SAME_LINE_MM`].
fn in_the_same_place(lines: &[RasterLine]) -> Vec<Vec<[f64; 2]>> {
    let order = across_order(lines);
    let mut others = vec![Vec::new(); lines.len()];
    for (place, k) in order.iter().enumerate() {
        let is_same =
            |other: &&usize| lines[**other].across_mm - lines[*k].across_mm <= SAME_LINE_MM;
        for other in order[place + 1..].iter().take_while(is_same) {
            others[*k].push(lines[*other].along_mm);
            others[*other].push(lines[*k].along_mm);
        }
    }
    others
}

/// Returns the indices of the lines in the order of their coordinates across them.
fn across_order(lines: &[RasterLine]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..lines.len()).collect();
    order.sort_by(|a, b| lines[*a].across_mm.total_cmp(&lines[*b].across_mm));
    order
}

/// Returns the distance of a line to another one that is beside it, mm. `None` if the other one has the same
/// coordinate across, or does not overlap it along.
fn distance_beside_mm(line: &RasterLine, other: &RasterLine) -> Option<f64> {
    let distance_mm = (other.across_mm - line.across_mm).abs();
    let is_beside = distance_mm > SAME_LINE_MM
        && other.along_mm[0] < line.along_mm[1]
        && other.along_mm[1] > line.along_mm[0];
    if is_beside { Some(distance_mm) } else { None }
}

/// Returns the measured pitch d of every line, mm; refuses a line without another one beside it.
fn measured(lines: &[RasterLine]) -> Result<Vec<f64>, Invalid> {
    let order = across_order(lines);
    // Distances to the nearest line beside one, before and after it: of its own pass, or of all.
    let beside = |place: usize, own: bool| {
        let line = &lines[order[place]];
        let distance = |other: &usize| {
            let other = &lines[*other];
            if own && other.pass != line.pass { None } else { distance_beside_mm(line, other) }
        };
        let before = order[..place].iter().rev().find_map(distance);
        [before, order[place + 1..].iter().find_map(distance)]
    };
    let mut of_pass: BTreeMap<i64, Vec<f64>> = BTreeMap::new();
    for (place, k) in order.iter().enumerate() {
        let nearest = beside(place, true).into_iter().flatten().reduce(f64::min);
        of_pass.entry(lines[*k].pass).or_default().extend(nearest);
    }
    let mut pitches = vec![0.0; lines.len()];
    for (place, k) in order.iter().enumerate() {
        let own = of_pass.get_mut(&lines[*k].pass).filter(|distances| !distances.is_empty());
        pitches[*k] = match (own, beside(place, false)) {
            (Some(own), _) => {
                let middle = own.len() / 2;
                *own.select_nth_unstable_by(middle, f64::total_cmp).1
            }
            (None, [Some(before), Some(after)]) => 0.5 * (before + after),
            (None, [Some(distance_mm), None] | [None, Some(distance_mm)]) => distance_mm,
            (None, [None, None]) => {
                let problem = "is on a line without another one beside it, so that it has no pitch";
                let first = lines[*k].segments.start;
                return Err(Invalid::at_index("point_mm", first, problem, "give `pitch_mm`"));
            }
        };
    }
    Ok(pitches)
}

/// Returns the mean height over a square with the side `side_mm` around the point `p` [x, y], mm, of the map, linear
/// between its valid pixels, nm. If the square holds no valid pixel, returns the height of the nearest one.
fn depth_nm(desired: &Surface, p: [f64; 2], side_mm: f64) -> f64 {
    let grid = desired.grid();
    let z = desired.height_nm();
    let rows = weights(&grid.y, p[1], side_mm);
    let columns = weights(&grid.x, p[0], side_mm);
    let mut sum = 0.0;
    let mut total = 0.0;
    for (r, by_row) in &rows {
        for (c, by_column) in &columns {
            if !z[[*r, *c]].is_nan() {
                sum += by_row * by_column * z[[*r, *c]];
                total += by_row * by_column;
            }
        }
    }
    if total > 0.0 { sum / total } else { z[desired.nearest_valid(p)] }
}

/// Returns the pixels of an axis that take part in the mean, over `v` - side/2 to `v` + side/2, of a function that is
/// linear between them. Each comes with its weight, in pixels:
///
/// ```text
/// w_i = H(b - i) - H(a - i),   H' = max(1 - |u|, 0)     a, b the ends, in pixels
/// ```
fn weights(axis: &Axis, v: f64, side_mm: f64) -> Vec<(usize, f64)> {
    let [a, b] = [-0.5, 0.5].map(|side| (v + side * side_mm - axis.start_mm()) / axis.step_mm());
    let [first, end] =
        [a.floor(), b.ceil() + 1.0].map(|pixel| pixel.clamp(0.0, axis.len() as f64) as usize);
    let parts = (first..end).map(|i| (i, hat_integral(b - i as f64) - hat_integral(a - i as f64)));
    parts.filter(|(_, w)| *w > 0.0).collect()
}

/// Returns H(u) of [`weights`]: the integral of the hat function `max(1 - |u|, 0)` from -1 to u.
fn hat_integral(u: f64) -> f64 {
    let rest = 1.0 - u.abs().min(1.0);
    if u < 0.0 { 0.5 * rest * rest } else { 1.0 - 0.5 * rest * rest }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{columns::Columns, model::operator::Operator};
    use ndarray::Array2;
    use planish_types::Grid;

    /// Returns a Gaussian TIF of sigma 1 mm and 10 nm/s, out to 7 sigma, on pixels of 0.25 mm.
    fn tif() -> Tif {
        let axis = Axis::new(-7.0, 0.25, 57).unwrap();
        let g = |k: usize| (-0.5 * axis.coordinate_mm(k).powi(2)).exp();
        let rate = Array2::from_shape_fn((57, 57), |(r, c)| 10.0 * g(r) * g(c));
        Tif::new(Grid { x: axis, y: axis }, rate).unwrap()
    }

    fn part(height: impl Fn(f64, f64) -> f64) -> Surface {
        let axis = Axis::new(0.0, 0.25, 81).unwrap();
        let z = Array2::from_shape_fn((81, 81), |(r, c)| {
            height(axis.coordinate_mm(c), axis.coordinate_mm(r))
        });
        Surface::new(Grid { x: axis, y: axis }, z).unwrap()
    }

    /// Returns a path of lines from x = -8 to 28 mm at these y coordinates, mm, run to and fro in steps of 1 mm. Every
    /// line is its own pass if `apart`. The path is turned by `angle`, rad, about (10, 10) mm.
    fn raster(places_mm: &[f64], apart: bool, angle: f64) -> ToolPath {
        let (sine, cosine) = angle.sin_cos();
        let turned = |x: f64, y: f64| {
            let (x, y) = (x - 10.0, y - 10.0);
            [10.0 + cosine * x - sine * y, 10.0 + sine * x + cosine * y]
        };
        let (mut points, mut pass) = (Vec::new(), Vec::new());
        for (k, y) in places_mm.iter().enumerate() {
            let line = (0..=36).map(|i| f64::from(if k % 2 == 0 { i } else { 36 - i }) - 8.0);
            points.extend(line.map(|x| turned(x, *y)));
            pass.extend([if apart { k as i64 } else { 0 }; 37]);
        }
        pass.pop();
        ToolPath::through(points, vec![true; pass.len()], pass).unwrap()
    }

    fn places(pitch_mm: f64) -> Vec<f64> {
        let n = (36.0 / pitch_mm).round() as usize;
        (0..=n).map(|k| -8.0 + pitch_mm * k as f64).collect()
    }

    fn removal_nm(desired: &Surface, path: &ToolPath) -> (Array2<f64>, FeedLawReport) {
        let floor = Bound::SecondsPerMm(1e-6);
        let (dwell, report) =
            dwell(desired, &tif(), path, floor, &FeedLawSettings::default()).unwrap();
        let places = Columns::Segment.places(path, &tif());
        let operator = Operator::new(&places, &tif(), desired.grid()).unwrap();
        (operator.apply(dwell.dwell_s()), report)
    }

    /// The path runs there and back over the same lines, and a third time over half of the middle line.
    #[test]
    fn lines_that_are_run_several_times_remove_the_depth_once() {
        let flat = part(|_, _| 50.0);
        for angle in [0.0, 0.5] {
            let once = raster(&places(1.0), true, angle);
            let (there, passes) = (once.point_mm(), once.pass_idx());
            let mut points: Vec<[f64; 2]> =
                there.iter().chain(there.iter().rev()).copied().collect();
            let half = &there[18 * 37..=18 * 37 + 18];
            points.extend(half);
            let mut pass = passes.to_vec();
            pass.push(99);
            pass.extend(passes.iter().rev().map(|p| 200 + p));
            pass.push(299);
            pass.extend([300; 18]);
            let several = ToolPath::through(points, vec![true; pass.len()], pass).unwrap();
            let (removed, report) = removal_nm(&flat, &several);
            assert_eq!(report.lines, 2 * places(1.0).len() + 1);
            // Rounding of positions of up to 40 mm.
            assert!(
                report.pitch_mm.iter().all(|d| (d - 1.0).abs() < 1e-9),
                "{:?}",
                report.pitch_mm
            );
            let (alone, _) = removal_nm(&flat, &once);
            // What is run at the floor of 1e-6 s/mm, the links, is there twice.
            let differs = (&removed - &alone).mapv(f64::abs).fold(0.0, |a: f64, b| a.max(*b));
            assert!(differs < 1e-3, "{angle}: {differs} nm");
        }
    }

    #[test]
    fn lines_remove_the_depth_of_a_flat_map_whatever_their_pitch_and_angle() {
        let flat = part(|_, _| 50.0);
        for pitch_mm in [0.5, 1.0, 1.2] {
            for (apart, angle) in [(false, 0.0), (true, 0.0), (true, 0.5), (false, -1.2)] {
                let path = raster(&places(pitch_mm), apart, angle);
                let (removed, report) = removal_nm(&flat, &path);
                assert_eq!((report.lines, report.too_fast), (places(pitch_mm).len(), 0));
                // Rounding of positions of up to 40 mm.
                assert!(report.pitch_mm.iter().all(|d| (d / pitch_mm - 1.0).abs() < 1e-9));
                // In the middle, farther than 7 mm from the ends of the lines: the mean is the depth, and the
                // ripple of lines is 4 exp(-2 pi^2 / d^2) of it.
                let ripple = 2.0 * (-2.0 * (std::f64::consts::PI / pitch_mm).powi(2)).exp();
                for at in [[40, 40], [38, 43], [42, 39]] {
                    let off = removed[at] / 50.0 - 1.0;
                    // The tail of the TIF beyond 7 sigma; for places between the samples of the TIF the error of
                    // Keys' interpolation, up to 1.4e-4 at a distance of 0.25 sigma.
                    let on_samples = angle == 0.0 && pitch_mm != 1.2;
                    let rounding = if on_samples { 1e-8 } else { 5e-4 };
                    assert!(off.abs() < ripple + rounding, "{pitch_mm} {angle} {at:?}: {off}");
                }
            }
        }
    }

    #[test]
    fn every_line_has_the_pitch_around_it_and_every_region_its_own() {
        // Neighbours at different distances: half the distance between them.
        let uneven = raster(&[0.0, 1.0, 3.0, 4.0], true, 0.0);
        let found = |path: &ToolPath| measured(&lines(path).unwrap().0).unwrap();
        // Rounding of positions of up to 40 mm.
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
        assert!(near(&found(&uneven), &[1.0, 1.5, 1.5, 1.0]));
        // Two regions, 0.3 mm from each other, the first with a part beyond the second: the lines at the borders
        // have the pitch of their region, and so has a part of one line.
        let regions = raster(&[0.0, 1.0, 2.0, 2.3, 2.8, 3.3, 3.6], false, 0.0);
        let pass = (0..regions.len()).map(|i| i64::from((3 * 37..6 * 37).contains(&i))).collect();
        let points = regions.point_mm().to_vec();
        let regions = ToolPath::through(points, vec![true; regions.len()], pass).unwrap();
        assert!(
            near(&found(&regions), &[1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 1.0]),
            "{:?}",
            found(&regions)
        );
    }

    #[test]
    fn slanted_links_do_not_turn_the_lines() {
        // Lines of 36 mm whose ends move by 0.3 mm from one to the next, so that every link is slanted the same way.
        let mut points = Vec::new();
        for k in 0..20 {
            let (y, x) = (f64::from(k), 0.3 * f64::from(k));
            let line = [[x, y], [x + 18.0, y], [x + 36.0, y]];
            points.extend(if k % 2 == 0 { line } else { [line[2], line[1], line[0]] });
        }
        let n = points.len() - 1;
        let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
        let (lines, _) = lines(&path).unwrap();
        assert_eq!(lines.len(), 20);
        // Rounding of positions up to 42 mm.
        assert!(measured(&lines).unwrap().iter().all(|d| (d - 1.0).abs() < 1e-12));
    }

    #[test]
    fn the_depth_of_a_plane_is_exact_wherever_the_square_lies() {
        let plane = |x: f64, y: f64| 3.0 * x - 2.0 * y + 100.0;
        let map = part(plane);
        for [x, y] in [[7.123, 9.456], [10.0, 10.125], [1.01, 18.9]] {
            for side_mm in [0.01, 0.3, 0.9, 1.7] {
                let off = depth_nm(&map, [x, y], side_mm) - plane(x, y);
                // Rounding of weights of a pixel in a square of 0.04 pixels.
                assert!(off.abs() < 1e-10, "{x} {y} {side_mm}: {off}");
            }
        }
        // Beyond the map that of its nearest pixel.
        assert_eq!(depth_nm(&map, [-3.0, 25.0], 1.0), plane(0.0, 20.0));
    }

    #[test]
    fn a_tool_that_removes_beside_its_centre_is_a_path_beside_the_map() {
        let wedge = part(|x, y| 20.0 * x + 5.0 * y);
        let path = raster(&places(1.0), false, 0.0);
        let floor = Bound::SecondsPerMm(1e-6);
        let of = |tif: &Tif, path: &ToolPath| {
            let (dwell, _) = dwell(&wedge, tif, path, floor, &FeedLawSettings::default()).unwrap();
            dwell.dwell_s().to_vec()
        };
        let tif = tif();
        let Grid { x, y } = *tif.grid();
        let moved = |a: Axis, by: f64| Axis::new(a.start_mm() + by, a.step_mm(), a.len()).unwrap();
        let grid = Grid { x: moved(x, 1.5), y: moved(y, -0.5) };
        let off = Tif::new(grid, tif.rate_nm_per_s().clone()).unwrap();
        let points = path.point_mm().iter().map(|p| [p[0] - 1.5, p[1] + 0.5]).collect();
        let n = path.len();
        let beside = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
        for (a, b) in of(&tif, &path).iter().zip(of(&off, &beside)) {
            // Rounding of positions of 30 mm on slopes of 20 nm/mm.
            assert!((a - b).abs() < 1e-11 * a.max(1.0), "{a} {b}");
        }
    }

    #[test]
    fn links_and_shallow_places_are_run_at_the_floor_and_negative_maps_are_lifted() {
        let path = raster(&places(1.0), false, 0.0);
        let wedge = part(|x, _| 20.0 * x - 100.0);
        let (tif, floor) = (tif(), 0.01);
        let found =
            dwell(&wedge, &tif, &path, Bound::SecondsPerMm(floor), &FeedLawSettings::default());
        let (found, report) = found.unwrap();
        assert_eq!(report.lifted_nm, 100.0);
        let vrr = tif.vrr_nm_mm2_per_s();
        let mut at_floor = 0;
        for (i, t) in found.dwell_s().iter().enumerate() {
            let x = path.dwell_point_mm()[i][0];
            let is_link = path.displacement_mm(i)[0] == 0.0;
            // The mean of a wedge over a square is that in its middle, where the map holds the square.
            if is_link || 20.0 * x / vrr < floor - 1e-3 {
                assert_eq!(*t, floor, "{i}");
                at_floor += usize::from(!is_link);
            } else if (1.0..19.0).contains(&x) && 20.0 * x / vrr > floor {
                // Rounding of a sum over the pixels of a square.
                assert!((t / (20.0 * x / vrr) - 1.0).abs() < 1e-9, "{i}: {t}");
            } else if x > 20.5 {
                // As above.
                assert!((t / (400.0 / vrr) - 1.0).abs() < 1e-9, "{i}: {t}");
            }
        }
        assert!(at_floor > 0 && report.too_fast >= at_floor);
    }

    #[test]
    fn a_flat_map_is_lowered_and_where_that_is_less_than_the_floor_removes_the_floor_is_run() {
        let path = raster(&places(1.0), false, 0.0);
        let tif = tif();
        let vrr = tif.vrr_nm_mm2_per_s();
        for (depth_nm, floor) in [(5.0, 0.001), (5.0, 0.2), (0.0, 0.01)] {
            let problem = Problem {
                desired: &part(|_, _| depth_nm),
                tif: &tif,
                path: &path,
                weight: None,
                columns: Columns::Segment,
                min_dwell: Bound::SecondsPerMm(floor),
            };
            let found = solve(&problem, &FeedLawSettings::default()).unwrap();
            // Lines of 1 mm in steps of 1 mm.
            let time_s = (depth_nm / vrr).max(floor);
            let is_line = |i: &usize| path.displacement_mm(*i)[1] == 0.0;
            for i in (0..path.len()).filter(is_line) {
                // Rounding of a product.
                assert!(
                    (found.dwell.dwell_s()[i] - time_s).abs() < 1e-12,
                    "{depth_nm} {floor} {i}"
                );
            }
        }
    }

    #[test]
    fn paths_without_lines_and_lines_without_neighbours_are_refused() {
        let stairs = (0..41).map(|i| [f64::from(i / 2), f64::from((i + 1) / 2)]).collect();
        let stairs = ToolPath::through(stairs, vec![true; 40], vec![0; 40]).unwrap();
        let flat = part(|_, _| 50.0);
        let of = |path: &ToolPath, pitch_mm| {
            let settings = FeedLawSettings { pitch_mm };
            dwell(&flat, &tif(), path, Bound::Seconds(0.0), &settings).map_err(|e| e.to_string())
        };
        assert!(of(&stairs, None).unwrap_err().contains("no lines in one direction"));
        let alone = raster(&[3.0], true, 0.0);
        assert!(of(&alone, None).unwrap_err().contains("give `pitch_mm`"));
        let (times, _) = of(&alone, Some(0.5)).unwrap();
        // Rounding of a product of 25 nm mm^2.
        assert!((times.dwell_s()[9] * tif().vrr_nm_mm2_per_s() - 25.0).abs() < 1e-9);
        for pitch_mm in [0.0, -1.0, f64::NAN] {
            assert!(of(&alone, Some(pitch_mm)).unwrap_err().contains("pitch_mm"));
        }
    }
}
