//! Residual and time of a plan by position on the part: worst points, edge zone, regions, travel.
//!
//! ```text
//! tool radius      = sqrt(area where R >= max R / 2  /  pi)          width of the edge zone
//! edge zone        = valid pixels nearer than that to a pixel that is invalid or beyond the map
//! RMS of a zone    = sqrt(mean over its pixels of (e - mean e)^2)    mean e of the whole map
//! time of a region = time of the motion, tool on, whose position lies in it
//! travel           = smallest and largest position of the motion along each axis
//! ```
//!
//! The RMS of all zones is about one mean, that of the map. So their squares, weighted by their pixels, add up to the
//! square of the RMS. Travel and times are exact, because the motion is cut where it enters another pixel.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | e | `residual` | (ny, nx) | nm |
//! | R | `tif` | (my, mx) | nm/s |

use std::f64::consts::PI;

use ndarray::Array2;
use planish_numerics::polynomial::{
    derivative, evaluate, monotone_crossing, quadratic_roots, range,
};
use planish_types::{Axis, Grid, Segment, Surface, Tif, Trajectory};
use serde::Serialize;

/// Number of the worst points that are listed. Larger: points that are hardly worse than others. Smaller: a bad point
/// is missed. Chosen.
const WORST_COUNT: usize = 5;

/// Smallest distance of two listed points, as a fraction of the longer side of the map. Larger: neighbouring pits are
/// missed. Smaller: one pit is listed several times. Chosen.
const WORST_APART: f64 = 0.05;

/// Number of regions along each side of the map. Larger: finer regions, in a table that is larger. Smaller: coarser
/// ones. Chosen.
const REGIONS: usize = 3;

/// Numbers of the division of a mirror into an edge zone and regions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DivisionReport {
    /// Width of the edge zone, mm: the radius of a disc as large as the area where the tool removes at least half of
    /// its peak rate; `null` if the tool is not known.
    pub edge_width_mm: Option<f64>,
    /// Fraction of the valid pixels that lie in the edge zone; `null` if the tool is not known.
    pub edge_fraction: Option<f64>,
    /// Bounds of the regions along [x, y], ascending, mm: the outer edges of pixels.
    pub region_bounds_mm: [[f64; REGIONS + 1]; 2],
    /// Smallest distance of two of the listed worst points, mm.
    pub worst_apart_mm: f64,
}

/// A mirror whose pixels are divided into an edge zone and its inside, and into regions.
#[derive(Clone, Debug)]
pub struct Division {
    grid: Grid,
    /// True for the pixels that have a height, shape (ny, nx).
    valid: Array2<bool>,
    /// True for the valid pixels of the edge zone (ny, nx); `None` if the tool is not known.
    edge: Option<Array2<bool>>,
    report: DivisionReport,
}

/// A pixel whose residual is among the farthest from the mean of the map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct WorstPlace {
    /// Centre of the pixel along x, mm.
    pub x_mm: f64,
    /// Centre of the pixel along y, mm.
    pub y_mm: f64,
    /// Residual minus the mean of the map, nm; positive = material that stays.
    pub from_mean_nm: f64,
    /// True if the point lies in the edge zone; `null` if the tool is not known.
    pub at_edge: Option<bool>,
}

/// RMS of a map in the edge zone and inside of it, both about the mean of the whole map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ZoneRms {
    /// RMS of the edge zone, nm; `null` if it has no pixels or the tool is not known.
    pub edge_nm: Option<f64>,
    /// RMS of the other valid pixels, nm; `null` if there are none or the tool is not known.
    pub inside_nm: Option<f64>,
}

/// Duration of a motion, divided by the position and the state of the tool, s.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Times {
    /// Time with the tool on above valid pixels of the edge zone, s; `null` if the tool is not known.
    pub edge_s: Option<f64>,
    /// Time with the tool on above the other valid pixels, s; above all valid pixels if the tool is not known.
    pub inside_s: f64,
    /// Time with the tool on beyond the valid pixels, s: overscan and turn-arounds.
    pub beyond_s: f64,
    /// Time with the tool off, s, wherever the tool is.
    pub tool_off_s: f64,
}

/// Residual and time of one plan by position on the part.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Places {
    /// Points whose residual is farthest from the mean of the map, the worst first: at most five, not close together.
    pub worst: Vec<WorstPlace>,
    /// RMS of the residual in the edge zone and inside of it, about the mean of the whole map.
    pub zone_rms: ZoneRms,
    /// RMS of the residual in each region, nm; rows from small y, columns from small x; `null` for a region without
    /// valid pixels.
    pub region_rms_nm: [[Option<f64>; REGIONS]; REGIONS],
    /// Time with the tool on above the valid pixels of each region, s, in the same order.
    pub region_time_s: [[f64; REGIONS]; REGIONS],
    /// Time in the edge zone, inside, beyond the part, and with the tool off.
    pub time: Times,
    /// Smallest and largest position of the motion along [x, y], mm.
    pub travel_mm: [[f64; 2]; 2],
}

impl Division {
    /// Divides the valid pixels of `surface`. The edge zone is as wide as the radius of `tif`; without a tool there
    /// is no edge zone.
    pub fn new(surface: &Surface, tif: Option<&Tif>) -> Self {
        let grid = *surface.grid();
        let valid = surface.height_nm().mapv(|v| !v.is_nan());
        let edge_width_mm = tif.map(tool_radius_mm);
        let edge = edge_width_mm.map(|width_mm| edge_zone(&valid, &grid, width_mm));
        let sides = [&grid.x, &grid.y].map(|axis| axis.len() as f64 * axis.step_mm());
        let report = DivisionReport {
            edge_width_mm,
            edge_fraction: edge.as_ref().map(|edge| count(edge) / count(&valid)),
            region_bounds_mm: [bounds_mm(&grid.x), bounds_mm(&grid.y)],
            worst_apart_mm: WORST_APART * sides[0].max(sides[1]),
        };
        Self { grid, valid, edge, report }
    }

    /// Returns the numbers that describe the division.
    pub fn report(&self) -> DivisionReport {
        self.report.clone()
    }

    /// Returns residual and time by position for the motion `trajectory` and its `residual`, a map on the pixels of
    /// this mirror.
    pub fn places(&self, residual: &Surface, trajectory: &Trajectory) -> Places {
        let (time, region_time_s) = self.times(trajectory);
        Places {
            worst: self.worst(residual),
            zone_rms: self.zone_rms(residual),
            region_rms_nm: self.region_rms_nm(residual),
            region_time_s,
            time,
            travel_mm: travel_mm(trajectory),
        }
    }

    /// Returns the RMS of `map`, on the pixels of this mirror, in the edge zone and inside, about the mean of the whole
    /// map.
    pub fn zone_rms(&self, map: &Surface) -> ZoneRms {
        let Some(edge) = &self.edge else { return ZoneRms::default() };
        let [inside_nm, edge_nm] = self.rms_by(map, |index| usize::from(edge[index]));
        ZoneRms { edge_nm, inside_nm }
    }

    /// Returns the row and the column of the region that contains the pixel in row r and column c, all from 0.
    fn region(&self, (r, c): (usize, usize)) -> (usize, usize) {
        let (ny, nx) = self.grid.shape();
        ((r * REGIONS / ny).min(REGIONS - 1), (c * REGIONS / nx).min(REGIONS - 1))
    }

    /// Returns the RMS of `map` in each region about the mean of the whole map, nm; rows from small y, columns from
    /// small x. `None` for a region without valid pixels.
    fn region_rms_nm(&self, map: &Surface) -> [[Option<f64>; REGIONS]; REGIONS] {
        let flat: [Option<f64>; REGIONS * REGIONS] = self.rms_by(map, |pixel| {
            let (row, column) = self.region(pixel);
            row * REGIONS + column
        });
        std::array::from_fn(|row| std::array::from_fn(|column| flat[row * REGIONS + column]))
    }

    /// Returns, for each of `N` classes, the RMS of its valid pixels about the mean of the whole map. `class` returns
    /// the class of a pixel (row, column). `None` for a class without pixels.
    fn rms_by<const N: usize>(
        &self,
        map: &Surface,
        class: impl Fn((usize, usize)) -> usize,
    ) -> [Option<f64>; N] {
        let mean = map.statistics().mean;
        let mut sums = [(0.0, 0.0); N];
        for (index, z) in map.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
            let (squares, count) = &mut sums[class(index)];
            *squares += (z - mean).powi(2);
            *count += 1.0;
        }
        sums.map(|(squares, count)| if count > 0.0 { Some((squares / count).sqrt()) } else { None })
    }

    /// Returns up to [`WORST_COUNT`] pixels whose residual is farthest from the mean of the map, the worst first. Two
    /// of them are at least `worst_apart_mm` of the division apart.
    fn worst(&self, residual: &Surface) -> Vec<WorstPlace> {
        let mean = residual.statistics().mean;
        let apart_mm = self.report.worst_apart_mm;
        let mut worst: Vec<WorstPlace> = Vec::new();
        while worst.len() < WORST_COUNT {
            // The first of equals, in the order of the rows.
            let mut next: Option<((usize, usize), f64)> = None;
            for (index, z) in residual.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
                let farther = next.is_none_or(|(_, most)| (z - mean).abs() > f64::abs(most));
                if !farther {
                    continue;
                }
                let [x_mm, y_mm] =
                    [self.grid.x.coordinate_mm(index.1), self.grid.y.coordinate_mm(index.0)];
                if worst.iter().all(|p| (p.x_mm - x_mm).hypot(p.y_mm - y_mm) >= apart_mm) {
                    next = Some((index, z - mean));
                }
            }
            let Some(((r, c), from_mean_nm)) = next else { break };
            worst.push(WorstPlace {
                x_mm: self.grid.x.coordinate_mm(c),
                y_mm: self.grid.y.coordinate_mm(r),
                from_mean_nm,
                at_edge: self.edge.as_ref().map(|edge| edge[[r, c]]),
            });
        }
        worst
    }

    /// Returns the time of a motion by zone, and the time with the tool on by region, s.
    fn times(&self, trajectory: &Trajectory) -> (Times, [[f64; REGIONS]; REGIONS]) {
        let mut times = Times { edge_s: self.edge.as_ref().map(|_| 0.0), ..Times::default() };
        let mut regions = [[0.0; REGIONS]; REGIONS];
        for segment in trajectory.segments() {
            if !segment.tool_on {
                times.tool_off_s += segment.duration_s;
                continue;
            }
            let mut from_s = 0.0;
            for to_s in self.pixel_changes_s(&segment) {
                let part_s = to_s - from_s;
                let middle_s = 0.5 * (from_s + to_s);
                from_s = to_s;
                let [x_mm, y_mm] = segment.position_mm(middle_s);
                let pixel = pixel_at(&self.grid.y, y_mm).zip(pixel_at(&self.grid.x, x_mm));
                let Some(pixel) = pixel.filter(|index| self.valid[*index]) else {
                    times.beyond_s += part_s;
                    continue;
                };
                let (row, column) = self.region(pixel);
                regions[row][column] += part_s;
                match &mut times.edge_s {
                    Some(edge_s) if self.edge.as_ref().is_some_and(|edge| edge[pixel]) => {
                        *edge_s += part_s;
                    }
                    _ => times.inside_s += part_s,
                }
            }
        }
        (times, regions)
    }

    /// Returns the times, s from the start of the segment, at which the motion enters another pixel, ascending. The
    /// last one is the end of the segment.
    fn pixel_changes_s(&self, segment: &Segment<'_>) -> Vec<f64> {
        let end_s = segment.duration_s;
        let mut times_s = vec![end_s];
        for (axis, c) in [&self.grid.x, &self.grid.y].into_iter().zip(segment.coefficient_mm) {
            // Pixel i reaches from i to i + 1.
            let mut p = c.map(|c| c / axis.step_mm());
            p[0] += 0.5 - axis.start_mm() / axis.step_mm();
            let d = derivative(&p);
            let mut from_s = 0.0;
            for to_s in quadratic_roots(d[0], d[1], d[2], end_s).chain([end_s]) {
                let [a, b] = [from_s, to_s].map(|time_s| evaluate(&p, time_s));
                let first = a.min(b).max(0.0).ceil() as usize;
                let last = a.max(b).min(axis.len() as f64).floor();
                let borders = (first..).map(|i| i as f64).take_while(|border| *border <= last);
                times_s.extend(borders.map(|border| monotone_crossing(&p, border, from_s, to_s)));
                from_s = to_s;
            }
        }
        times_s.sort_by(f64::total_cmp);
        times_s
    }
}

/// Returns the number of pixels that are true.
fn count(map: &Array2<bool>) -> f64 {
    map.iter().filter(|v| **v).count() as f64
}

/// Returns the radius of a disc, mm, with the area in which the tool removes at least half of its peak rate. It counts
/// the samples of `tif`.
fn tool_radius_mm(tif: &Tif) -> f64 {
    let half = 0.5 * tif.peak_nm_per_s();
    let count = tif.rate_nm_per_s().iter().filter(|rate| **rate >= half).count();
    (count as f64 * tif.grid().pixel_mm2() / PI).sqrt()
}

/// Returns the edge zone: the valid pixels whose centres are nearer than `width_mm` to the centre of an invalid pixel
/// or of one beyond the map. `valid` is true for the valid pixels, (ny, nx), and `grid` has their centres.
fn edge_zone(valid: &Array2<bool>, grid: &Grid, width_mm: f64) -> Array2<bool> {
    let (ny, nx) = valid.dim();
    let dx = grid.x.step_mm();
    let dy = grid.y.step_mm();
    // Along the row, columns to the next invalid pixel or to the first one beyond the map.
    let mut along = Array2::<usize>::zeros((ny, nx));
    for r in 0..ny {
        let mut since = 0;
        for c in 0..nx {
            since = if valid[[r, c]] { since + 1 } else { 0 };
            along[[r, c]] = since;
        }
        since = 0;
        for c in (0..nx).rev() {
            since = if valid[[r, c]] { since + 1 } else { 0 };
            along[[r, c]] = along[[r, c]].min(since);
        }
    }
    // d^2 = (columns dx)^2 + (rows dy)^2, the least over the rows that are near enough: of each, how many columns are
    // nearer than the width.
    let reach = (width_mm / dy).ceil() as isize;
    let mut nearer: Vec<(isize, usize)> = Vec::new();
    for offset in -reach..=reach {
        let distances = (0..=nx).map(|columns| (columns as f64 * dx).hypot(offset as f64 * dy));
        nearer.push((offset, distances.take_while(|mm| *mm < width_mm).count()));
    }
    let mut zone = Array2::from_elem((ny, nx), false);
    for (r, mut row) in zone.rows_mut().into_iter().enumerate() {
        for (offset, count) in &nearer {
            match r.checked_add_signed(*offset).filter(|row| *row < ny) {
                Some(other) => {
                    for (zone, columns) in row.iter_mut().zip(along.row(other)) {
                        *zone |= columns < count;
                    }
                }
                None => row.iter_mut().for_each(|zone| *zone |= *count > 0),
            }
        }
        row.iter_mut().zip(valid.row(r)).for_each(|(zone, valid)| *zone &= *valid);
    }
    zone
}

/// Returns the bounds of the regions along an axis, ascending, mm: from the outer edge of its first pixel to that of
/// its last one.
fn bounds_mm(axis: &Axis) -> [f64; REGIONS + 1] {
    // Whole pixels, as a pixel belongs to one region: the first whose i REGIONS / n is k.
    std::array::from_fn(|k| {
        let first = (k * axis.len()).div_ceil(REGIONS);
        axis.start_mm() + (first as f64 - 0.5) * axis.step_mm()
    })
}

/// Returns the index of the pixel that contains the coordinate `mm`; `None` beyond the axis.
fn pixel_at(axis: &Axis, mm: f64) -> Option<usize> {
    let i = ((mm - axis.start_mm()) / axis.step_mm()).round();
    if i >= 0.0 && i < axis.len() as f64 { Some(i as usize) } else { None }
}

/// Returns the smallest and largest position of the motion along [x, y], mm.
fn travel_mm(trajectory: &Trajectory) -> [[f64; 2]; 2] {
    let mut travel = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for segment in trajectory.segments() {
        for (ends, c) in travel.iter_mut().zip(segment.coefficient_mm) {
            let r = range(c, segment.duration_s);
            *ends = [ends[0].min(r.min), ends[1].max(r.max)];
        }
    }
    travel
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(nx: usize, ny: usize) -> Grid {
        Grid { x: Axis::new(0.5, 1.0, nx).unwrap(), y: Axis::new(0.5, 1.0, ny).unwrap() }
    }

    /// Returns a tool that removes at the same rate in all pixels whose centre is within `radius_mm`.
    fn top_hat(radius_mm: f64) -> Tif {
        let axis = Axis::new(-5.0, 0.05, 201).unwrap();
        let grid = Grid { x: axis, y: axis };
        let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            f64::from(u8::from(axis.coordinate_mm(c).hypot(axis.coordinate_mm(r)) <= radius_mm))
        });
        Tif::new(grid, rate).unwrap()
    }

    /// Returns a residual of 0 nm except for 8 nm at column 2, row 1, and -6 nm at column 10, row 4.
    fn residual() -> Surface {
        let mut map = Array2::zeros((6, 12));
        map[[1, 2]] = 8.0;
        map[[4, 10]] = -6.0;
        Surface::new(grid(12, 6), map).unwrap()
    }

    fn along_x(parts: &[(f64, f64, f64, bool)]) -> Trajectory {
        // From x with velocity v for t, at y = 2.5.
        let mut times = vec![0.0];
        times.extend(parts.iter().scan(0.0, |sum, (_, _, t, _)| {
            *sum += t;
            Some(*sum)
        }));
        let c = parts.iter().map(|(x, v, ..)| [[*x, *v, 0.0, 0.0], [2.5, 0.0, 0.0, 0.0]]);
        let on = parts.iter().map(|p| p.3).collect();
        Trajectory::new(times, c.collect(), on, vec![None; parts.len()]).unwrap()
    }

    #[test]
    fn an_edge_zone_is_as_wide_as_the_tool() {
        let radius = tool_radius_mm(&top_hat(2.0));
        // The area of a disc counted in pixels of 0.05 mm: its rim is 2 pi 40 of 5027 pixels.
        assert!((radius - 2.0).abs() < 0.02, "{radius}");
        let valid = Array2::from_elem((6, 12), true);
        // Pixels are 1 mm: beyond the map the first centre is 1 mm from the first row.
        let zone = |width| edge_zone(&valid, &grid(12, 6), width);
        assert_eq!(zone(1.5).iter().filter(|v| **v).count(), 72 - 4 * 10);
        assert_eq!(zone(2.5).iter().filter(|v| **v).count(), 72 - 2 * 8);
        assert!(zone(3.5).iter().all(|v| *v));
        assert!(zone(0.5).iter().all(|v| !*v));
        // Around a hole: its eight neighbours within sqrt(2), and itself not.
        let mut holed = Array2::from_elem((9, 9), true);
        holed[[4, 4]] = false;
        let found = edge_zone(&holed, &grid(9, 9), 1.42);
        let middle = found.slice(ndarray::s![2..7, 2..7]);
        assert_eq!(middle.iter().filter(|v| **v).count(), 8);
        assert!(!found[[4, 4]] && found[[3, 3]] && !found[[4, 2]]);
    }

    #[test]
    fn squares_of_zones_and_regions_add_up_to_that_of_the_rms() {
        let tif = top_hat(1.5);
        let map = residual();
        let division = Division::new(&map, Some(&tif));
        let report = division.report();
        let ZoneRms { edge_nm, inside_nm } = division.zone_rms(&map);
        let share = report.edge_fraction.unwrap();
        assert!((share - 32.0 / 72.0).abs() < 1e-12);
        let square = map.statistics().rms.powi(2);
        let found = share * edge_nm.unwrap().powi(2) + (1.0 - share) * inside_nm.unwrap().powi(2);
        assert!((found - square).abs() < 1e-12 * square);
        // 8 nm and -6 nm are both inside, more than a pixel from the edge.
        assert!(inside_nm.unwrap() > 10.0 * edge_nm.unwrap());
        let regions = division.region_rms_nm(&map);
        let sum: f64 = regions.as_flattened().iter().map(|v| v.unwrap().powi(2)).sum();
        assert!((sum / 9.0 - square).abs() < 1e-12 * square);
        assert_eq!(report.region_bounds_mm, [[0.0, 4.0, 8.0, 12.0], [0.0, 2.0, 4.0, 6.0]]);
        // Low y and low x first.
        assert!(regions[0][0].unwrap() > 2.0 && regions[2][2].unwrap() > 2.0);
        assert!(regions[0][2].unwrap() < 0.1 && regions[2][0].unwrap() < 0.1);
        let unknown = Division::new(&map, None);
        assert_eq!(unknown.zone_rms(&map), ZoneRms::default());
        assert_eq!(unknown.report().edge_width_mm, None);
    }

    #[test]
    fn the_worst_places_are_apart_and_signed() {
        let map = residual();
        let division = Division::new(&map, Some(&top_hat(1.5)));
        let worst = division.worst(&map);
        let mean = 2.0 / 72.0;
        assert_eq!(worst.len(), WORST_COUNT);
        let first =
            WorstPlace { x_mm: 2.5, y_mm: 1.5, from_mean_nm: 8.0 - mean, at_edge: Some(false) };
        assert_eq!(worst[0], first);
        assert_eq!((worst[1].x_mm, worst[1].y_mm), (10.5, 4.5));
        assert!((worst[1].from_mean_nm + 6.0 + mean).abs() < 1e-12);
        let apart = division.report().worst_apart_mm;
        assert!((apart - 0.6).abs() < 1e-12);
        // One valid pixel is one place.
        let mut one = Array2::from_elem((2, 2), f64::NAN);
        one[[1, 0]] = 3.0;
        let one = Surface::new(grid(2, 2), one).unwrap();
        assert_eq!(Division::new(&one, None).worst(&one).len(), 1);
    }

    #[test]
    fn time_goes_where_the_motion_is_and_none_is_lost() {
        let map = residual();
        let division = Division::new(&map, Some(&top_hat(1.5)));
        // 2 s of overscan, 12 mm at 2 mm/s above the mirror, 1 s lifted, 3 s of rest in the last column.
        let motion = along_x(&[
            (-2.0, 1.0, 2.0, true),
            (0.0, 2.0, 6.0, true),
            (12.0, -0.5, 1.0, false),
            (11.5, 0.0, 3.0, true),
        ]);
        let places = division.places(&map, &motion);
        let Times { edge_s, inside_s, beyond_s, tool_off_s } = places.time;
        // The row y = 2.5 is inside; its first and last pixel are in the edge zone: 0.5 s each, and the rest.
        let near = |found: f64, wanted: f64| (found - wanted).abs() < 1e-9;
        assert!(near(edge_s.unwrap(), 4.0) && near(inside_s, 5.0), "{:?}", places.time);
        assert!(near(beyond_s, 2.0) && near(tool_off_s, 1.0), "{:?}", places.time);
        let row = places.region_time_s[1];
        assert!(near(row[0], 2.0) && near(row[1], 2.0) && near(row[2], 5.0), "{row:?}");
        assert_eq!(places.region_time_s[0], [0.0; 3]);
        assert_eq!(places.travel_mm, [[-2.0, 12.0], [2.5, 2.5]]);
        // The border of the mirror is crossed within a segment: x = u^2 - 2 for 3 s, above pixels from u = 2^(1/2) on.
        let faster = Trajectory::new(
            vec![0.0, 3.0],
            vec![[[-2.0, 0.0, 1.0, 0.0], [2.5, 0.0, 0.0, 0.0]]],
            vec![true],
            vec![None],
        );
        let time = division.places(&map, &faster.unwrap()).time;
        // Roundings of numbers up to 3. The first pixel is of the edge zone, up to x = 1.
        assert!((time.beyond_s - 2.0_f64.sqrt()).abs() < 1e-14, "{time:?}");
        assert!((time.edge_s.unwrap() - 3.0_f64.sqrt() + 2.0_f64.sqrt()).abs() < 1e-14, "{time:?}");
        // An excursion inside a segment counts: x = 4 u - u^2 for 3 s reaches 4 mm.
        let hump = Trajectory::new(
            vec![0.0, 3.0],
            vec![[[0.0, 4.0, -1.0, 0.0], [0.0; 4]]],
            vec![true],
            vec![None],
        );
        assert_eq!(travel_mm(&hump.unwrap()), [[0.0, 4.0], [0.0, 0.0]]);
    }
}
