//! The lines of the regions, the cells that they form, and the order of the cells. A cell is a group of lines that
//! continue each other and are run without a lift.

use ndarray::s;

use super::{
    Links,
    regions::{Field, OUTSIDE},
};
use crate::{
    MAX_SEGMENTS,
    draft::{Draft, parts},
    region::SLACK,
};

/// Longest distance along x between the ends of two neighbouring lines that are linked along a border between regions,
/// in units of the larger of pitch and pixel. At 4 the border has a slope of 14 degrees. Larger: longer links along
/// borders. Smaller: more lifts.
const LONGEST_LINK: f64 = 4.0;

/// Largest number of rounds of 2-opt. Larger: more time. Smaller: longer lifts between the cells.
const MAX_ROUNDS: usize = 30;
/// Largest number of cells of the order that one step of 2-opt reverses. Larger: more time with many cells. Smaller:
/// longer lifts between the cells.
const MAX_REVERSED: usize = 1000;

/// Interval of a line along x with the tool on, mm.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Stretch {
    low: f64,
    high: f64,
    /// True for the ends [low, high] that lie on the border of another region.
    inner: [bool; 2],
}

/// The raster lines of one region; line k has the y `first_mm + k * pitch_mm`.
pub(super) struct Raster {
    pitch_mm: f64,
    /// Longest distance along x between the ends of two lines that are linked along a border, mm.
    link_mm: f64,
    first_mm: f64,
    /// Intervals of each line with the tool on, ascending.
    lines: Vec<Vec<Stretch>>,
}

/// Returns the raster of every region, with the pitch `pitch_mm` of each; `None` if their lines cross more than twice
/// [`MAX_SEGMENTS`] columns of pixels in all.
pub(super) fn rasters(field: &Field, pitch_mm: &[f64]) -> Option<Vec<Raster>> {
    let [hx, hy] = field.pixel_mm;
    let [x0, y0] = field.first_mm;
    // Rows and columns of every region: first, last.
    let mut boxes = vec![[usize::MAX, 0, usize::MAX, 0]; pitch_mm.len()];
    for ((r, c), id) in field.label.indexed_iter().filter(|(_, id)| **id != OUTSIDE) {
        let b = &mut boxes[*id];
        *b = [b[0].min(r), b[1].max(r), b[2].min(c), b[3].max(c)];
    }
    let mut total = 0.0;
    // Lines over every column, ascending.
    let mut over: Vec<Vec<f64>> = vec![Vec::new(); field.label.ncols()];
    let mut rasters = Vec::with_capacity(pitch_mm.len());
    for (id, (d, [r0, r1, c0, c1])) in pitch_mm.iter().copied().zip(boxes).enumerate() {
        let (first_mm, count) = line_positions(field, id, d, [r0, r1, c0, c1]);
        total += count * (c1 - c0 + 1) as f64;
        if total.is_nan() || total > 2.0 * MAX_SEGMENTS as f64 {
            return None;
        }
        let mut lines = Vec::with_capacity(count as usize);
        for k in 0..count as usize {
            let w = first_mm + k as f64 * d;
            // The row that the line lies in; of two, by more than rounding, the upper one.
            let row = ((w - y0) / hy + SLACK).round().clamp(r0 as f64, r1 as f64) as usize;
            let line = stretches(field, id, row, [c0, c1], d);
            for s in &line {
                let columns = [((s.low - x0) / hx - SLACK).ceil(), (s.high - x0) / hx + SLACK];
                let last = (columns[1].floor() as usize).min(over.len() - 1);
                over[columns[0].max(0.0) as usize..=last].iter_mut().for_each(|o| o.push(w));
            }
            lines.push(line);
        }
        rasters.push(Raster { pitch_mm: d, link_mm: LONGEST_LINK * d.max(hx), first_mm, lines });
    }
    over.iter_mut().for_each(|o| o.sort_unstable_by(f64::total_cmp));
    add_slivers(field, &mut rasters, &mut over);
    Some(rasters)
}

/// Returns the y of the first line of region `id`, mm, and the number of its lines (at least 1), at the pitch `d`, mm.
/// The array is its bounding box in pixels: first and last row, first and last column.
fn line_positions(field: &Field, id: usize, d: f64, [r0, r1, c0, c1]: [usize; 4]) -> (f64, f64) {
    // Whether the outermost row has another region beyond it.
    let inner = [(r0, r0.wrapping_sub(1)), (r1, r1 + 1)].map(|(row, beyond)| {
        beyond < field.label.nrows() && {
            let rows = [row, beyond].map(|r| field.label.slice(s![r, c0..=c1]));
            rows[0].iter().zip(&rows[1]).any(|(own, other)| *own == id && *other != OUTSIDE)
        }
    });
    let margin = inner.map(|i| if i { 0.5 * field.pixel_mm[1] } else { field.rest_mm[1] });
    let low = field.centre_mm(1, r0) - margin[0];
    let high = field.centre_mm(1, r1) + margin[1];
    // The line on an outer edge serves half a pitch beyond it.
    let beyond = inner.map(|i| if i { 0.0 } else { 0.5 * d });
    let from = low - beyond[0];
    let to = high + beyond[1];
    let fitting = (to - from) / d;
    // With two outer edges a raster: n = floor(H / d) + 1.
    let count = if inner == [false; 2] { (fitting + SLACK).floor() } else { fitting.round() };
    let count = count.max(1.0);
    // w_k = w_mid + (k - (n-1)/2) d; a single line stays in the region.
    let first = 0.5 * (from + to) - 0.5 * (count - 1.0) * d;
    (if count == 1.0 { first.clamp(low, high) } else { first }, count)
}

/// Returns the intervals of a row of pixels, columns c0 to c1, that belong to region `id`. Gaps up to the pitch `d` or
/// two pixels are bridged if no pixel in them belongs to another region.
fn stretches(field: &Field, id: usize, row: usize, [c0, c1]: [usize; 2], d: f64) -> Vec<Stretch> {
    let h = field.pixel_mm[0];
    let labels = field.label.row(row);
    let mut stretches: Vec<Stretch> = Vec::new();
    let mut c = c0;
    while c <= c1 {
        if labels[c] != id {
            c += 1;
            continue;
        }
        let begin = c;
        while c <= c1 && labels[c] == id {
            c += 1;
        }
        let inner = [begin.wrapping_sub(1), c]
            .map(|beyond| labels.get(beyond).is_some_and(|other| *other != OUTSIDE));
        let mut margins = inner.map(|i| if i { 0.5 * h } else { field.rest_mm[0] });
        // Every stretch has a length.
        if begin + 1 == c {
            let least = if inner == [false; 2] { 0.5 * h } else { 0.0 };
            margins = margins.map(|m| m.max(least));
        }
        let next = Stretch {
            low: field.centre_mm(0, begin) - margins[0],
            high: field.centre_mm(0, c - 1) + margins[1],
            inner,
        };
        match stretches.last_mut() {
            Some(last)
                if !last.inner[1]
                    && !inner[0]
                    && next.low - last.high <= d.max(2.0 * h) * (1.0 + SLACK)
                    && between_is_outside(field, row, [last.high, next.low]) =>
            {
                last.high = next.high;
                last.inner[1] = inner[1];
            }
            _ => stretches.push(next),
        }
    }
    stretches
}

/// Returns true if no pixel of a region lies between two x coordinates of a row.
fn between_is_outside(field: &Field, row: usize, [low, high]: [f64; 2]) -> bool {
    let [low, high] = [low, high].map(|x| (x - field.first_mm[0]) / field.pixel_mm[0]);
    // Ends reach less than a pixel beyond their last centre.
    let from = low.floor() as usize + 1;
    let to = high.ceil() as usize;
    (from..to).all(|c| field.label[[row, c]] == OUTSIDE)
}

/// Adds pixels that lie farther than their pitch from every line in their column to a line of their region. `over` has
/// the y of the lines over each column.
fn add_slivers(field: &Field, rasters: &mut [Raster], over: &mut [Vec<f64>]) {
    let hx = field.pixel_mm[0];
    for ((r, c), _) in field.inside.indexed_iter().filter(|(_, inside)| **inside) {
        let raster = &mut rasters[field.label[[r, c]]];
        let d = raster.pitch_mm;
        let (x, y) = (field.centre_mm(0, c), field.centre_mm(1, r));
        let reach = d * (1.0 + SLACK);
        let next = over[c].partition_point(|w| *w < y - reach);
        if over[c].get(next).is_some_and(|w| *w <= y + reach) {
            continue;
        }
        let last = raster.lines.len() as f64 - 1.0;
        let k = ((y - raster.first_mm) / d).round().clamp(0.0, last);
        let w = raster.first_mm + k * d;
        let line = &mut raster.lines[k as usize];
        line.push(Stretch { low: x - 0.5 * hx, high: x + 0.5 * hx, inner: [true; 2] });
        line.sort_unstable_by(|a, b| a.low.total_cmp(&b.low));
        let mut joined: Vec<Stretch> = Vec::with_capacity(line.len());
        for next in line.drain(..) {
            match joined.last_mut() {
                Some(last) if next.low - last.high <= SLACK * hx => {
                    if next.high > last.high {
                        last.high = next.high;
                        last.inner[1] = next.inner[1];
                    }
                }
                _ => joined.push(next),
            }
        }
        *line = joined;
        let place = over[c].partition_point(|v| *v < w);
        over[c].insert(place, w);
    }
}

impl Stretch {
    /// Returns the index of the stretch of a neighbouring line that this one overlaps; `None` if it overlaps none or
    /// several.
    fn only_neighbour(&self, others: &[Stretch]) -> Option<usize> {
        let mut met = (0..others.len())
            .filter(|i| self.low.max(others[*i].low) <= self.high.min(others[*i].high));
        let first = met.next();
        if met.next().is_some() { None } else { first }
    }
}

/// Group of lines of a region that continue each other one to one from line to line, by ascending y. It is run without
/// a lift unless [`Links`] lifts the tool between lines.
pub(super) struct Cell {
    /// Index of the region that it belongs to.
    pub region: usize,
    lines: Vec<CellLine>,
}

/// A line of a cell: its y (`across`) and the x of its ends, mm.
#[derive(Clone, Copy)]
struct CellLine {
    across: f64,
    /// The x of the end at smaller x, then that of the end at larger x, mm.
    ends: [f64; 2],
    /// True for the ends that lie on the border of another region.
    inner: [bool; 2],
}

impl Raster {
    /// Groups the lines of this raster into cells; `region` is the index of its region.
    pub fn cells(&self, region: usize) -> Vec<Cell> {
        let mut cells: Vec<Cell> = Vec::new();
        // Cell of every stretch of the line before.
        let mut open: Vec<usize> = Vec::new();
        for (k, line) in self.lines.iter().enumerate() {
            let before = if k == 0 { &[][..] } else { &self.lines[k - 1][..] };
            let w = self.first_mm + k as f64 * self.pitch_mm;
            let mut now = Vec::with_capacity(line.len());
            for s in line {
                let continued = s.only_neighbour(before).filter(|i| {
                    before[*i].only_neighbour(line).is_some() && self.can_link(&before[*i], s)
                });
                let cell = continued.map_or(cells.len(), |i| open[i]);
                if cell == cells.len() {
                    cells.push(Cell { region, lines: Vec::new() });
                }
                cells[cell].lines.push(CellLine {
                    across: w,
                    ends: [s.low, s.high],
                    inner: s.inner,
                });
                now.push(cell);
            }
            open = now;
        }
        cells
    }

    /// Returns true if the tool may stay on from `a` to `b`: ends on the border of another region are at most `link_mm`
    /// apart along x.
    fn can_link(&self, a: &Stretch, b: &Stretch) -> bool {
        let ends = [(a.low, b.low), (a.high, b.high)];
        (0..2).all(|i| {
            let outer = !a.inner[i] && !b.inner[i];
            outer || (ends[i].0 - ends[i].1).abs() <= self.link_mm
        })
    }
}

/// A cell of the order, with one of the four directions in which it can be run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Visit {
    /// Index of the cell in the list of all cells.
    pub cell: usize,
    /// True if its lines are run from the largest y to the smallest.
    downwards: bool,
    /// True if the line that is run first is run towards smaller x.
    backwards: bool,
}

impl Visit {
    fn all(cell: usize) -> [Self; 4] {
        [(false, false), (false, true), (true, false), (true, true)]
            .map(|(downwards, backwards)| Self { cell, downwards, backwards })
    }

    /// Returns true if the line that is run last is run towards smaller x.
    fn ends_backwards(self, cells: &[Cell]) -> bool {
        self.backwards ^ cells[self.cell].lines.len().is_multiple_of(2)
    }

    fn start(self, cells: &[Cell]) -> [f64; 2] {
        let lines = &cells[self.cell].lines;
        let line = lines[if self.downwards { lines.len() - 1 } else { 0 }];
        [line.ends[usize::from(self.backwards)], line.across]
    }

    fn end(self, cells: &[Cell]) -> [f64; 2] {
        self.reversed(cells).start(cells)
    }

    fn reversed(self, cells: &[Cell]) -> Self {
        let backwards = !self.ends_backwards(cells);
        Self { downwards: !self.downwards, backwards, ..self }
    }
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Returns an order and directions of the cells with short lifts between them; the cells of a region follow each other.
pub(super) fn order(cells: &[Cell]) -> Vec<Visit> {
    let lowest = (0..cells.len()).min_by(|a, b| {
        let [a, b] = [a, b].map(|i| cells[*i].lines[0]);
        a.across.total_cmp(&b.across).then_with(|| a.ends[0].total_cmp(&b.ends[0]))
    });
    let Some(first) = lowest else { return Vec::new() };
    // The nearest end first.
    let mut left: Vec<usize> = (0..cells.len()).filter(|i| *i != first).collect();
    let mut visits = vec![Visit::all(first)[0]];
    while !left.is_empty() {
        let here = visits[visits.len() - 1];
        let end = here.end(cells);
        let region = cells[here.cell].region;
        let within = left.iter().any(|i| cells[*i].region == region);
        let candidates = left.iter().enumerate();
        let nearest = candidates
            .filter(|(_, i)| !within || cells[**i].region == region)
            .flat_map(|(n, i)| Visit::all(*i).map(|v| (n, v)))
            .min_by(|a, b| {
                distance(end, a.1.start(cells)).total_cmp(&distance(end, b.1.start(cells)))
            });
        let Some((n, visit)) = nearest else { break };
        left.remove(n);
        visits.push(visit);
    }
    for _ in 0..MAX_ROUNDS {
        if !improve(cells, &mut visits) {
            break;
        }
    }
    visits
}

/// Makes one round of 2-opt; returns true if it shortened the lifts.
fn improve(cells: &[Cell], visits: &mut [Visit]) -> bool {
    let n = visits.len();
    let region = |v: &Visit| cells[v.cell].region;
    // Length of the lift from `a` to `b`; none beyond the ends.
    let lift = |a: Option<Visit>, b: Option<Visit>| match (a, b) {
        (Some(a), Some(b)) => distance(a.end(cells), b.start(cells)),
        _ => 0.0,
    };
    let mut is_shorter = false;
    for i in 0..n {
        let before = i.checked_sub(1).map(|b| visits[b]);
        let after = visits.get(i + 1).copied();
        let around = |v| lift(before, Some(v)) + lift(Some(v), after);
        for other in Visit::all(visits[i].cell) {
            if around(other) < around(visits[i]) - SLACK {
                visits[i] = other;
                is_shorter = true;
            }
        }
        for j in i + 1..n.min(i + MAX_REVERSED) {
            // Within a region, or whole regions.
            let starts = before.is_none_or(|b| region(&b) != region(&visits[i]));
            let ends = visits.get(j + 1).is_none_or(|a| region(a) != region(&visits[j]));
            if region(&visits[i]) != region(&visits[j]) && !(starts && ends) {
                continue;
            }
            let after = visits.get(j + 1).copied();
            let old = lift(before, Some(visits[i])) + lift(Some(visits[j]), after);
            let head = visits[j].reversed(cells);
            let tail = visits[i].reversed(cells);
            if lift(before, Some(head)) + lift(Some(tail), after) < old - SLACK {
                visits[i..=j].reverse();
                visits[i..=j].iter_mut().for_each(|v| *v = v.reversed(cells));
                is_shorter = true;
            }
        }
    }
    is_shorter
}

/// Returns the path through the cells in the order `visits`, with steps of at most `step` mm; `None` if it has more
/// than [`MAX_SEGMENTS`] segments. `links` says where the tool stays on between lines.
pub(super) fn walk(cells: &[Cell], visits: &[Visit], step: f64, links: Links) -> Option<Draft> {
    let mut path = Draft::default();
    let mut pass = 0;
    for (i, visit) in visits.iter().enumerate() {
        let Cell { region, lines } = &cells[visit.cell];
        let start = visit.start(cells);
        match path.point_mm.last() {
            None => path.begin(start),
            // Neighbouring regions may end and begin in the same point.
            Some(here) if distance(*here, start) > SLACK => path.to(start, false, pass),
            Some(_) => {}
        }
        pass += usize::from(i > 0 && cells[visits[i - 1].cell].region != *region);
        let mut backwards = visit.backwards;
        let mut before: Option<CellLine> = None;
        for n in 0..lines.len() {
            let line = lines[if visit.downwards { lines.len() - 1 - n } else { n }];
            // The side that it begins on, where the line before it ended.
            let side = usize::from(backwards);
            let begin = [line.ends[side], line.across];
            if let Some(before) = before {
                let on = match links {
                    Links::On => true,
                    Links::Outside => !(line.inner[side] || before.inner[side]),
                    Links::Off => false,
                };
                if on {
                    straight(&mut path, begin, step, pass)?;
                } else {
                    path.to(begin, false, pass);
                }
            }
            straight(&mut path, [line.ends[1 - side], line.across], step, pass)?;
            backwards = !backwards;
            before = Some(line);
        }
    }
    Some(path)
}

/// Adds equal steps of at most `step` mm to the point `to`, with the tool on; `None` if the path would have too many
/// segments.
fn straight(path: &mut Draft, to: [f64; 2], step: f64, pass: usize) -> Option<()> {
    let from = path.point_mm[path.point_mm.len() - 1];
    let n = parts(distance(from, to), step, path.tool_on.len())?;
    for k in 1..=n {
        let f = k as f64 / n as f64;
        let between = [0, 1].map(|i| from[i] + f * (to[i] - from[i]));
        path.to(if k == n { to } else { between }, true, pass);
    }
    Some(())
}
