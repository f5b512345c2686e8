//! Statistics of a tool path that do not depend on the dwell times.
//!
//! ```text
//! length            sum of |P_{i+1} - P_i| over the segments with the tool on
//! effective pitch   (area of the valid pixels) / (length whose dwell point lies in one of them)
//! coverage          max over the valid pixels of min over the segments with the tool on of
//!                   |pixel centre - segment|
//! turn              angle between the directions of two segments that follow each other with the
//!                   tool on; segments without a length have none
//! crossings         pairs of segments with the tool on that have a point in common, other than
//!                   neighbours, and the first and the last segment of a closed line
//! least time        sum over the segments of max over the axes of |d| / v_max
//! ```
//!
//! A percentile of n sorted values is the value number ceil(q n). Whether two segments meet is
//! decided without rounding (module `segments`).
//!
//! The pitch limit keeps the ripple of parallel lines below `r` (peak to valley over mean) for a Gaussian TIF of
//! standard deviation sigma. It follows from `r = 4 exp(-2 pi^2 sigma^2 / p^2)`, the first harmonic of Poisson's sum
//! (at these pitches the third is below 1e-20):
//!
//! ```text
//! p = sigma sqrt(2 pi^2 / ln(4 / r)),     sigma = sqrt(VRR / (2 pi peak))
//! ```
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | P | `point_mm` | (n+1, 2) | mm |
//! | r | `RIPPLE` | - | 1 |
//! | sigma | `sigma_mm` | - | mm |

use std::f64::consts::PI;

use ndarray::Axis;
use planish_types::{Grid, Limits, Surface, Tif, ToolPath, progress};
use rayon::prelude::*;
use serde::Serialize;

use crate::{region::nearest_pixel, segments::meet};

/// Ripple that the pitch limit allows, peak to valley over mean, dimensionless (0.1 %). Larger: a larger pitch, and
/// visible lines. Smaller: a smaller pitch, and a longer path.
const RIPPLE: f64 = 1e-3;

/// Largest number of cells per axis of the search grid: at most 1024 x 1024 lists of segments. Larger: more memory.
/// Smaller: longer searches in long lists.
const MAX_CELLS: f64 = 1024.0;

/// Largest mean number of cells that a segment touches; 4 for segments as long as the cells are wide. Larger: more
/// memory for long segments. Smaller: larger cells, and longer searches.
const TOUCHED: f64 = 8.0;

/// Statistics of a path that do not depend on the dwell times.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PathStatistics {
    /// Number of points of the path, at which the velocity is controlled (segments + 1).
    pub points: usize,
    /// Length with the tool on, mm.
    pub length_mm: f64,
    /// Length with the tool lifted, mm.
    pub lift_length_mm: f64,
    /// Number of passes: runs of segments with one `pass_idx`.
    pub passes: usize,
    /// Number of lifts: runs of consecutive segments with the tool lifted.
    pub lifts: usize,
    /// Shortest segment with the tool on, mm.
    pub shortest_step_mm: f64,
    /// Median length of the segments with the tool on, mm.
    pub median_step_mm: f64,
    /// 99th percentile of the length of the segments with the tool on, mm.
    pub p99_step_mm: f64,
    /// Longest segment with the tool on, mm.
    pub longest_step_mm: f64,
    /// Mean change of direction between consecutive segments with the tool on, degrees; 0 without such a pair.
    pub mean_turn_deg: f64,
    /// 90th percentile of these changes of direction, degrees; 0 without any.
    pub p90_turn_deg: f64,
    /// 99th percentile of these changes of direction, degrees; 0 without any.
    pub p99_turn_deg: f64,
    /// Largest of these changes of direction, degrees; 0 without any.
    pub largest_turn_deg: f64,
    /// Number of pairs of segments with the tool on that have a point in common. Neighbours, and the first and last
    /// segment of a closed line, do not count.
    pub crossings: usize,
    /// Effective pitch: area of the valid pixels over the length of the path within them, mm; left out when no dwell
    /// point lies in a valid pixel.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub effective_pitch_mm: Option<f64>,
    /// Largest distance of a valid pixel's centre from the nearest segment with the tool on, mm; left out if no such
    /// segment has a length.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coverage_mm: Option<f64>,
}

/// Upper limits of the pitch that a TIF sets.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PitchLimit {
    /// A sixth of the smaller side of the TIF's array, mm; larger pitches leave visible lines.
    pub tif_size_sixth_mm: f64,
    /// Pitch at which a Gaussian TIF of the same peak and volume leaves a ripple of 0.1 % of the
    /// mean removal, peak to valley, mm. A TIF that ends abruptly leaves more.
    pub ripple_mm: f64,
}

impl PitchLimit {
    /// Returns the largest pitch within both limits, mm.
    pub fn pitch_mm(&self) -> f64 {
        self.tif_size_sixth_mm.min(self.ripple_mm)
    }
}

/// Computes the statistics of `path` over the clear aperture: the valid pixels of `surface`.
pub fn statistics(path: &ToolPath, surface: &Surface) -> PathStatistics {
    let [on, lifted] = [true, false].map(|on| -> Vec<f64> {
        let segments = (0..path.len()).filter(|i| path.tool_on()[*i] == on);
        segments.map(|i| path.segment_length_mm(i)).collect()
    });
    // An empty sum of floats is -0.
    let [length_mm, lift_length_mm] =
        [&on, &lifted].map(|lengths| lengths.iter().fold(0.0, |sum, l| sum + l));
    let changes = path.pass_idx().windows(2).filter(|w| w[0] != w[1]).count();
    let lifts = path.tool_on().chunk_by(|a, b| a == b).filter(|run| !run[0]).count();
    let steps = sorted(on);
    let turns = sorted(turns_deg(path));
    PathStatistics {
        points: path.point_mm().len(),
        length_mm,
        lift_length_mm,
        passes: changes + 1,
        lifts,
        shortest_step_mm: percentile(&steps, 0.0),
        median_step_mm: percentile(&steps, 0.5),
        p99_step_mm: percentile(&steps, 0.99),
        longest_step_mm: percentile(&steps, 1.0),
        mean_turn_deg: turns.iter().fold(0.0, |sum, t| sum + t) / turns.len().max(1) as f64,
        p90_turn_deg: percentile(&turns, 0.9),
        p99_turn_deg: percentile(&turns, 0.99),
        largest_turn_deg: percentile(&turns, 1.0),
        crossings: crossings(path),
        effective_pitch_mm: effective_pitch_mm(path, surface),
        coverage_mm: coverage_mm(path, surface),
    }
}

/// Returns the sum of the times of all segments, lifts included, at the largest velocity that the axes allow, s. No
/// motion through all points of the path is faster.
pub fn time_lower_bound_s(path: &ToolPath, limits: &Limits) -> f64 {
    let v_max = limits.max_velocity_mm_per_s();
    // sum of max |d| / v_max
    let each = (0..path.len()).map(|i| {
        let d = path.displacement_mm(i);
        (d[0].abs() / v_max[0]).max(d[1].abs() / v_max[1])
    });
    each.sum()
}

fn sorted(mut values: Vec<f64>) -> Vec<f64> {
    values.sort_unstable_by(f64::total_cmp);
    values
}

/// Returns the percentile of n ascending values for the fraction `q`: value number ceil(q n), the first for q = 0.
/// Returns 0 without values.
fn percentile(sorted: &[f64], q: f64) -> f64 {
    let rank = (q * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied().unwrap_or(0.0)
}

fn turns_deg(path: &ToolPath) -> Vec<f64> {
    let mut turns = Vec::with_capacity(path.len());
    // The direction in which the tool last moved, unless it was lifted since.
    let mut before: Option<[f64; 2]> = None;
    for i in 0..path.len() {
        let d = path.displacement_mm(i);
        if !path.tool_on()[i] {
            before = None;
        } else if d != [0.0, 0.0] {
            if let Some(b) = before {
                let cross = b[0] * d[1] - b[1] * d[0];
                let dot = b[0] * d[0] + b[1] * d[1];
                turns.push(cross.abs().atan2(dot).to_degrees());
            }
            before = Some(d);
        }
    }
    turns
}

/// Returns the upper limits of the pitch for this TIF.
pub fn pitch_limit(tif: &Tif) -> PitchLimit {
    let [x, y] = tif.grid().size_mm();
    let sigma_mm = (tif.vrr_nm_mm2_per_s() / (2.0 * PI * tif.peak_nm_per_s())).sqrt();
    PitchLimit {
        tif_size_sixth_mm: x.min(y) / 6.0,
        ripple_mm: sigma_mm * (2.0 * PI * PI / (4.0 / RIPPLE).ln()).sqrt(),
    }
}

fn effective_pitch_mm(path: &ToolPath, surface: &Surface) -> Option<f64> {
    let grid = surface.grid();
    let inside = (0..path.len()).filter(|i| {
        let pixel = nearest_pixel(grid, path.dwell_point_mm()[*i]);
        path.tool_on()[*i] && pixel.is_some_and(|pixel| !surface.height_nm()[pixel].is_nan())
    });
    let length: f64 = inside.map(|i| path.segment_length_mm(i)).sum();
    let area_mm2 = surface.statistics().valid_count as f64 * grid.pixel_mm2();
    if length > 0.0 { Some(area_mm2 / length) } else { None }
}

fn coverage_mm(path: &ToolPath, surface: &Surface) -> Option<f64> {
    let point = path.point_mm();
    let on = (0..path.len()).filter(|i| path.tool_on()[*i]);
    let segments: Vec<_> = on.map(|i| [point[i], point[i + 1]]).collect();
    let cells = SegmentCells::new(&segments)?;
    let Grid { x, y } = *surface.grid();
    // From a path beside the map an outermost pixel is farthest: what is nearer need not be looked at.
    let beside = [(x.start_mm(), y.start_mm()), (x.end_mm(), y.end_mm())]
        .into_iter()
        .any(|(x, y)| cells.beside([x, y]) > cells.side_mm);
    let outermost = if beside { outermost(surface) } else { Vec::new() };
    let distances = outermost
        .into_iter()
        .map(|(r, c)| cells.distance_mm([x.coordinate_mm(c), y.coordinate_mm(r)]));
    let seed = distances.fold(0.0, f64::max);
    let pieces = progress::PieceCounter::new(y.len().div_ceil(BAND));
    let bands = surface.height_nm().axis_chunks_iter(Axis(0), BAND).into_par_iter().enumerate();
    let farthest = bands.map(|(band, rows)| {
        let mut worst = seed;
        for (r, row) in rows.outer_iter().enumerate() {
            let mut near = 0;
            for (c, _) in row.iter().enumerate().filter(|(_, v)| !v.is_nan()) {
                if c < near {
                    continue;
                }
                let distance =
                    cells.distance_mm([x.coordinate_mm(c), y.coordinate_mm(band * BAND + r)]);
                worst = worst.max(distance);
                // k pixels further on it is k steps larger at most; the last one is for rounding.
                near = c + ((worst - distance) / x.step_mm()) as usize;
            }
        }
        progress::done(pieces.one_more());
        worst
    });
    Some(farthest.reduce(|| 0.0, f64::max))
}

/// Number of pixel rows of the map that one thread takes at a time. Larger: fewer tasks for the threads. Smaller: more
/// overhead.
const BAND: usize = 64;

/// Returns the outermost valid pixels in eight directions, as (row, column).
fn outermost(surface: &Surface) -> Vec<(usize, usize)> {
    let grid = surface.grid();
    let pixels = surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan());
    let ends = [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [-1.0, 1.0]].into_iter().flat_map(|[u, v]| {
        let along = pixels
            .clone()
            .map(|((r, c), _)| (u * grid.x.coordinate_mm(c) + v * grid.y.coordinate_mm(r), (r, c)));
        let first = along.clone().min_by(|a, b| a.0.total_cmp(&b.0));
        [first, along.max_by(|a, b| a.0.total_cmp(&b.0))]
    });
    ends.flatten().map(|(_, pixel)| pixel).collect()
}

fn crossings(path: &ToolPath) -> usize {
    let point = path.point_mm();
    let on = (0..path.len()).filter(|i| path.tool_on()[*i] && point[*i] != point[i + 1]);
    let segments: Vec<_> = on.map(|i| [point[i], point[i + 1]]).collect();
    let mut closes = vec![usize::MAX; segments.len()];
    let mut first = 0;
    for i in 0..segments.len() {
        if i > 0 && segments[i - 1][1] != segments[i][0] {
            first = i;
        }
        if segments[i][1] == segments[first][0] {
            closes[i] = first;
        }
    }
    let Some(cells) = SegmentCells::new(&segments) else { return 0 };
    let cell_numbers = (0..cells.start.len() - 1).into_par_iter();
    cell_numbers.map(|k| crossings_in_cell(&cells, k, &closes)).sum()
}

/// Returns the number of crossing pairs of segments whose common bounding box begins in cell `k`. For the last segment
/// of a closed line `closes` has its first one, with which it does not cross.
fn crossings_in_cell(cells: &SegmentCells, k: usize, closes: &[usize]) -> usize {
    let segments = cells.segments;
    let size = [0, 1].map(|c| {
        let sizes = cells.members(k).iter().map(|i| {
            let [a, b] = segments[*i as usize];
            (b[c] - a[c]).abs()
        });
        sizes.sum::<f64>()
    });
    // Ascending along the axis across which they are thin: where the boxes of two are apart, so are
    // those of all that follow, and lines that are much denser than long stay cheap.
    let across = usize::from(size[1] < size[0]);
    let ends = cells.members(k).iter().map(|i| {
        let [a, b] = segments[*i as usize].map(|p| p[across]);
        (a.min(b), a.max(b), *i as usize)
    });
    let mut members: Vec<(f64, f64, usize)> = ends.collect();
    members.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then_with(|| a.2.cmp(&b.2)));
    let mut count = 0;
    for (n, (_, high, p)) in members.iter().enumerate() {
        for (.., q) in members[n + 1..].iter().take_while(|(low, ..)| low <= high) {
            let (i, j) = (*p.min(q), *p.max(q));
            let (a, b) = (&segments[i], &segments[j]);
            if (j == i + 1 && a[1] == b[0]) || closes[j] == i {
                continue;
            }
            // Once per pair: in the cell of the lowest corner that the boxes share.
            let low = [0, 1].map(|c| a[0][c].min(a[1][c]).max(b[0][c].min(b[1][c])));
            let [x, y] = cells.cell(low);
            let here = (y * cells.count[0] as isize + x) as usize == k;
            count += usize::from(here && meet(a, b));
        }
    }
    count
}

/// Segments sorted into the square cells that their bounding boxes touch.
struct SegmentCells<'a> {
    segments: &'a [[[f64; 2]; 2]],
    origin_mm: [f64; 2],
    side_mm: f64,
    count: [usize; 2],
    /// Start of each list in `member`: cell (i, j), k = j * count[0] + i, holds the segments `member[start[k]..start[k
    /// + 1]]`.
    start: Vec<u32>,
    member: Vec<u32>,
}

impl<'a> SegmentCells<'a> {
    /// Sorts the segments into cells; `None` if there are none, or none has a length.
    fn new(segments: &'a [[[f64; 2]; 2]]) -> Option<Self> {
        let ends = segments.iter().flatten();
        let low = [0, 1].map(|a| ends.clone().map(|p| p[a]).fold(f64::MAX, f64::min));
        let high = [0, 1].map(|a| ends.clone().map(|p| p[a]).fold(f64::MIN, f64::max));
        let sizes = segments.iter().map(|[a, b]| [0, 1].map(|c| (b[c] - a[c]).abs()));
        let extent = (high[0] - low[0]).max(high[1] - low[1]);
        let mean = sizes.clone().map(|d| d[0].max(d[1])).sum::<f64>() / segments.len() as f64;
        let mut side_mm = mean.max(extent / MAX_CELLS);
        if segments.is_empty() || side_mm <= 0.0 {
            return None;
        }
        // As fine as the segments, but so that the lists of the cells stay short when few of them
        // are much longer than the others.
        let most = TOUCHED * segments.len() as f64;
        while sizes.clone().map(|d| (d[0] / side_mm + 1.0) * (d[1] / side_mm + 1.0)).sum::<f64>()
            > most
        {
            side_mm *= 2.0;
        }
        let count = [0, 1].map(|a| ((high[a] - low[a]) / side_mm) as usize + 1);
        let mut cells = Self {
            segments,
            origin_mm: low,
            side_mm,
            count,
            start: Vec::new(),
            member: Vec::new(),
        };
        let mut start = vec![0_u32; count[0] * count[1] + 1];
        segments.iter().for_each(|s| cells.touched(s).for_each(|k| start[k + 1] += 1));
        for k in 1..start.len() {
            start[k] += start[k - 1];
        }
        let mut next = start.clone();
        let mut member = vec![0; start[start.len() - 1] as usize];
        for (i, segment) in segments.iter().enumerate() {
            for k in cells.touched(segment) {
                member[next[k] as usize] = i as u32;
                next[k] += 1;
            }
        }
        cells.start = start;
        cells.member = member;
        Some(cells)
    }

    fn cell(&self, p: [f64; 2]) -> [isize; 2] {
        [0, 1].map(|a| ((p[a] - self.origin_mm[a]) / self.side_mm).floor() as isize)
    }

    /// Returns the distance of a point from the rectangle of cells, mm; 0 within it.
    fn beside(&self, p: [f64; 2]) -> f64 {
        let [x, y] = [0, 1].map(|a| {
            let end = self.origin_mm[a] + self.count[a] as f64 * self.side_mm;
            p[a] - p[a].clamp(self.origin_mm[a], end)
        });
        x.hypot(y)
    }

    fn touched(&self, [a, b]: &[[f64; 2]; 2]) -> impl Iterator<Item = usize> + use<> {
        let [p, q] = [a, b].map(|end| self.cell(*end));
        let columns = p[0].min(q[0])..=p[0].max(q[0]);
        let width = self.count[0] as isize;
        (p[1].min(q[1])..=p[1].max(q[1]))
            .flat_map(move |j| columns.clone().map(move |i| (j * width + i) as usize))
    }

    /// Returns the distance of a point from the nearest segment, mm.
    fn distance_mm(&self, p: [f64; 2]) -> f64 {
        // Rings of cells outwards from the cell of the grid that is nearest to the point.
        let count = self.count.map(|n| n as isize);
        let own = self.cell(p);
        let centre = [0, 1].map(|a| own[a].clamp(0, count[a] - 1));
        // The nearest point q of the grid: |p - r|^2 >= |p - q|^2 + |q - r|^2 for every r in the grid.
        let beside = self.beside(p).powi(2);
        let [x, y] = [0, 1].map(|a| centre[a].max(count[a] - 1 - centre[a]));
        let last = x.max(y);
        let mut best = f64::INFINITY;
        for ring in 0..=last {
            // What lies in this ring is at least (ring - 1) cells away from q.
            if ring > 1 && beside + ((ring - 1) as f64 * self.side_mm).powi(2) > best {
                break;
            }
            let columns = (centre[0] - ring).max(0)..=(centre[0] + ring).min(count[0] - 1);
            for j in (centre[1] - ring).max(0)..=(centre[1] + ring).min(count[1] - 1) {
                let whole_row = (j - centre[1]).abs() == ring;
                let stride = if whole_row { 1 } else { 2 * ring };
                // The ends of the row where it is not whole, as far as they are in the grid.
                let from = if whole_row { *columns.start() } else { centre[0] - ring };
                let ends = (from..=centre[0] + ring).step_by(stride.max(1) as usize);
                for i in ends.take_while(|i| i <= columns.end()).filter(|i| *i >= 0) {
                    best = best.min(self.nearest_in((j * count[0] + i) as usize, p));
                }
            }
        }
        best.sqrt()
    }

    /// Returns the indices of the segments that touch cell `k`, ascending.
    fn members(&self, k: usize) -> &[u32] {
        &self.member[self.start[k] as usize..self.start[k + 1] as usize]
    }

    /// Returns the square of the distance of `p` from the nearest segment of cell `k`, mm^2; infinity in an empty cell.
    fn nearest_in(&self, k: usize, p: [f64; 2]) -> f64 {
        self.members(k)
            .iter()
            .map(|i| square_of_distance(p, &self.segments[*i as usize]))
            .fold(f64::INFINITY, f64::min)
    }
}

/// Returns the square of the distance of `p` from the segment `a b`, mm^2.
fn square_of_distance(p: [f64; 2], [a, b]: &[[f64; 2]; 2]) -> f64 {
    let d = [b[0] - a[0], b[1] - a[1]];
    let q = [p[0] - a[0], p[1] - a[1]];
    let square = d[0] * d[0] + d[1] * d[1];
    // f = clamp(<q, d> / <d, d>): the foot of the perpendicular, or the nearer end.
    let f = if square > 0.0 { ((q[0] * d[0] + q[1] * d[1]) / square).clamp(0.0, 1.0) } else { 0.0 };
    (q[0] - f * d[0]).powi(2) + (q[1] - f * d[1]).powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use planish_types::{Axis, Grid};
    use proptest::prelude::*;

    fn surface(nx: usize, ny: usize, step: f64) -> Surface {
        let grid =
            Grid { x: Axis::new(0.0, step, nx).unwrap(), y: Axis::new(0.0, step, ny).unwrap() };
        Surface::new(grid, Array2::zeros((ny, nx))).unwrap()
    }

    /// Makes a path of rows at the pitch `p`, each one segment between x = 0 and 10, moved by (dx, dy).
    fn rows(n: usize, p: f64, [dx, dy]: [f64; 2]) -> ToolPath {
        let ends = |k: usize| if k.is_multiple_of(2) { [0.0, 10.0] } else { [10.0, 0.0] };
        let points = (0..n).flat_map(|k| ends(k).map(|x| [x + dx, k as f64 * p + dy]));
        let points: Vec<[f64; 2]> = points.collect();
        let m = points.len() - 1;
        ToolPath::through(points, vec![true; m], vec![0; m]).unwrap()
    }

    #[test]
    fn the_coverage_of_a_path_beside_the_map_is_that_of_its_farthest_pixel() {
        let map = surface(41, 21, 0.25);
        // From 10 and 1e6 mm beside the map; straight beside it and beyond its corners.
        for away in [10.0, 1e6] {
            for [dx, dy] in [[away, 0.0], [-away, 0.0], [0.0, away], [away, away], [-away, away]] {
                let path = rows(6, 1.0, [dx, dy]);
                let direct = |x: f64, y: f64| {
                    let of = |w: &[[f64; 2]]| square_of_distance([x, y], &[w[0], w[1]]);
                    path.point_mm().windows(2).map(of).fold(f64::INFINITY, f64::min).sqrt()
                };
                let pixels =
                    (0..41).flat_map(|c| (0..21).map(move |r| [c, r].map(|i| 0.25 * f64::from(i))));
                let farthest = pixels.map(|[x, y]| direct(x, y)).fold(0.0, f64::max);
                let found = statistics(&path, &map).coverage_mm.unwrap();
                // Squares of 1e6 round to 1e-4.
                assert!((found - farthest).abs() <= 1e-9 * away, "{found} {farthest}");
            }
        }
    }

    #[test]
    fn crossings_of_lines_much_denser_than_long_are_counted_in_time() {
        // 40 000 lines of 10 mm in 40 um, each crossed by one line: all pairs would be 8e8.
        let n = 40_000;
        let mut points = rows(n, 1e-6, [0.0; 2]).point_mm().to_vec();
        let top = (n - 1) as f64 * 1e-6;
        points.extend([[12.0, top + 1.0], [12.0, -1.0], [5.0, -1.0], [5.0, top + 1.0]]);
        let m = points.len() - 1;
        let path = ToolPath::through(points, vec![true; m], vec![0; m]).unwrap();
        // And the way to them is crossed once.
        assert_eq!(crossings(&path), n + 1);
    }

    #[test]
    fn a_path_counted_by_hand() {
        // Two lines of 3 mm, 2 mm apart, a lift of sqrt(4 + 9) mm between them.
        let points = vec![[0.0, 0.0], [1.5, 0.0], [3.0, 0.0], [0.0, 2.0], [3.0, 2.0]];
        let on = vec![true, true, false, true];
        let path = ToolPath::through(points, on, vec![0, 0, 0, 1]).unwrap();
        let s = statistics(&path, &surface(31, 21, 0.1));
        assert_eq!((s.points, s.length_mm, s.passes, s.lifts), (5, 6.0, 2, 1));
        assert_eq!((s.shortest_step_mm, s.longest_step_mm), (1.5, 3.0));
        assert_eq!(s.lift_length_mm, 13.0_f64.sqrt());
        // The middle row, 1 mm from either line.
        assert!((s.coverage_mm.unwrap() - 1.0).abs() < 1e-12);
        // 31 * 21 pixels of 0.01 mm^2 over 6 mm.
        assert!((s.effective_pitch_mm.unwrap() - 1.085).abs() < 1e-12);
    }

    #[test]
    fn a_path_with_the_tool_off_covers_nothing() {
        let path = ToolPath::through(vec![[0.0, 0.0], [1.0, 0.0]], vec![false], vec![0]).unwrap();
        let s = statistics(&path, &surface(3, 3, 1.0));
        assert_eq!((s.coverage_mm, s.effective_pitch_mm, s.length_mm), (None, None, 0.0));
    }

    #[test]
    fn pitch_limits_of_a_gaussian() {
        let axis = Axis::new(-6.0, 0.1, 121).unwrap();
        let rate = Array2::from_shape_fn((121, 121), |(r, c)| {
            (-0.5 * (axis.coordinate_mm(c).powi(2) + axis.coordinate_mm(r).powi(2))).exp()
        });
        let limit = pitch_limit(&Tif::new(Grid { x: axis, y: axis }, rate).unwrap());
        // Rounding of a sixth of 12 mm.
        assert!((limit.tif_size_sixth_mm - 2.0).abs() < 1e-12);
        // sigma = 1 mm to 1e-7 (the tail beyond 6 sigma): the ripple at this pitch, by its own sum.
        let p = limit.ripple_mm;
        let line = |y: f64| -> f64 {
            (-40..=40).map(|k| (-0.5 * (y - f64::from(k) * p).powi(2)).exp()).sum()
        };
        let mean = (2.0 * PI).sqrt() / p;
        assert!(((line(0.0) - line(0.5 * p)) / mean / RIPPLE - 1.0).abs() < 1e-5);
    }

    fn through(points: &[[f64; 2]]) -> ToolPath {
        let n = points.len() - 1;
        ToolPath::through(points.to_vec(), vec![true; n], vec![0; n]).unwrap()
    }

    #[test]
    fn percentiles_and_turns_counted_by_hand() {
        // Steps 1, 2, 3, 4 with turns of 90, 45 and 180 degrees, a step of no length among them.
        let h = 0.5_f64.sqrt();
        let points = [
            [0.0, 0.0],
            [1.0, 0.0],
            [1.0, 2.0],
            [1.0, 2.0],
            [1.0 + 3.0 * h, 2.0 + 3.0 * h],
            [1.0 - h, 2.0 - h],
        ];
        let s = statistics(&through(&points), &surface(31, 21, 0.1));
        assert_eq!((s.shortest_step_mm, s.median_step_mm), (0.0, 2.0));
        // Rounding of h.
        assert!((s.longest_step_mm - 4.0).abs() < 1e-12 && s.p99_step_mm == s.longest_step_mm);
        // Below: rounding of angles in degrees.
        assert!(
            (s.mean_turn_deg - 105.0).abs() < 1e-9 && (s.largest_turn_deg - 180.0).abs() < 1e-9
        );
        assert_eq!((percentile(&[1.0, 2.0, 3.0], 0.9), percentile(&[], 0.5)), (3.0, 0.0));
        // A lift has no turn.
        let lifted =
            ToolPath::through(points.to_vec(), vec![true, false, true, true, true], vec![0; 5]);
        // As above.
        assert!(
            (statistics(&lifted.unwrap(), &surface(9, 9, 0.1)).mean_turn_deg - 180.0).abs() < 1e-9
        );
    }

    #[test]
    fn the_least_time_is_that_of_the_slower_axis() {
        let axis = |name: &str, v| planish_types::MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: v,
            max_acceleration_mm_per_s2: 1.0,
            max_jerk_mm_per_s3: None,
            ..planish_types::MachineFileAxis::default()
        };
        let machine = planish_types::MachineFile {
            name: "m".into(),
            axes: vec![axis("x", 4.0), axis("y", 2.0)],
            min_segment_s: 0.0,
            ..planish_types::MachineFile::default()
        }
        .checked()
        .unwrap();
        let path = through(&[[0.0, 0.0], [8.0, 2.0], [7.0, -4.0]]);
        assert_eq!(time_lower_bound_s(&path, &machine), 2.0 + 3.0);
    }

    #[test]
    fn crossings_counted_by_hand() {
        let count = |points: &[[f64; 2]]| crossings(&through(points));
        let square = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]];
        assert_eq!(count(&square), 0, "a closed line");
        assert_eq!(count(&[&square[..], &[[0.0, -1.0]]].concat()), 1, "and on from its start");
        assert_eq!(count(&[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [2.0, 3.0], [2.0, -1.0]]), 1);
        assert_eq!(
            count(&[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [2.0, 3.0], [2.0, 0.0]]),
            1,
            "touch"
        );
        assert_eq!(count(&[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [2.0, 3.0], [2.0, 1e-300]]), 0);
        // A star of five points.
        let star: Vec<[f64; 2]> =
            (0..6).map(|k| f64::from(k) * 0.8 * PI).map(|a| [a.cos(), a.sin()]).collect();
        let closed = [&star[..5], &star[..1]].concat();
        assert_eq!(count(&closed), 5);
        // The same segments with the crossing one lifted.
        let points = vec![[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [2.0, 3.0], [2.0, -1.0]];
        let lifted = ToolPath::through(points, vec![true, true, true, false], vec![0; 4]).unwrap();
        assert_eq!(crossings(&lifted), 0);
    }
    proptest! {
        #[test]
        fn coverage_is_the_brute_force_maximum(
            points in prop::collection::vec(prop::array::uniform2(-3.0..8.0_f64), 2..40),
            lift in any::<u64>(),
        ) {
            let n = points.len() - 1;
            let on: Vec<bool> = (0..n).map(|i| i == 0 || lift >> i & 1 == 1).collect();
            let path = ToolPath::through(points.clone(), on.clone(), vec![0; n]).unwrap();
            let map = surface(14, 9, 0.4);
            let mut worst = 0.0_f64;
            for (r, c) in (0..9).flat_map(|r| (0..14).map(move |c| (r, c))) {
                let p = [map.grid().x.coordinate_mm(c), map.grid().y.coordinate_mm(r)];
                let each = (0..n).filter(|i| on[*i]);
                let near = each.map(|i| square_of_distance(p, &[points[i], points[i + 1]]).sqrt());
                worst = worst.max(near.fold(f64::INFINITY, f64::min));
            }
            prop_assert_eq!(coverage_mm(&path, &map), Some(worst));
        }

        #[test]
        fn crossings_are_those_of_all_pairs(
            // On a coarse lattice, so that segments touch, overlap and have no length too.
            points in prop::collection::vec(prop::array::uniform2(0..12_i32), 2..40),
            far in any::<bool>(),
        ) {
            let stretch = if far { 37.0 } else { 1.0 };
            let points: Vec<[f64; 2]> = points
                .iter()
                .enumerate()
                .map(|(i, p)| p.map(|v| f64::from(v) * if i == 3 { stretch } else { 1.0 }))
                .collect();
            let path = through(&points);
            let kept: Vec<_> = points
                .windows(2)
                .filter(|w| w[0] != w[1])
                .map(|w| [w[0], w[1]])
                .collect();
            let mut count = 0;
            for j in 0..kept.len() {
                for i in 0..j {
                    let neighbours = j == i + 1 || (i == 0 && kept[j][1] == kept[0][0]);
                    // In whole numbers the cross product is exact.
                    let cross = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| {
                        ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).signum()
                            * f64::from(u8::from(
                                (b[0] - a[0]) * (c[1] - a[1]) != (b[1] - a[1]) * (c[0] - a[0]),
                            ))
                    };
                    let ([a, b], [c, d]) = (kept[i], kept[j]);
                    let crossed = cross(a, b, c) * cross(a, b, d) <= 0.0
                        && cross(c, d, a) * cross(c, d, b) <= 0.0;
                    let overlap = (0..2).all(|k| {
                        a[k].max(b[k]) >= c[k].min(d[k]) && c[k].max(d[k]) >= a[k].min(b[k])
                    });
                    count += usize::from(!neighbours && crossed && overlap);
                }
            }
            prop_assert_eq!(crossings(&path), count);
        }
    }
}
