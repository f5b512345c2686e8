//! Fields on a box of the cells: the removal by a piece of the motion, or its change. A cell is a block of pixels
//! ([`crate::inner`]).

use std::ops::Range;

use planish_numerics::{polynomial::evaluate, quadrature::gauss_legendre};
use planish_types::{Pose, Tif};

use crate::{inner::Inner, motion::MotionPiece as Piece};

/// Number of Gauss points of a piece, over which the tool moves by at most half the width of the TIF. Larger: more
/// time. Smaller: a larger error of the fields.
const POINTS: usize = 3;

/// Values on a rectangle (box) of the cells; 0 elsewhere.
#[derive(Clone, Debug, Default)]
pub struct Field {
    /// Range of the rows of cells.
    pub rows: Range<usize>,
    /// Range of the columns of cells.
    pub columns: Range<usize>,
    /// Values, row by row.
    pub value: Vec<f64>,
}

impl Field {
    /// Makes a field of zeros on a box.
    pub fn on(rows: Range<usize>, columns: Range<usize>) -> Self {
        let value = vec![0.0; rows.len() * columns.len()];
        Self { rows, columns, value }
    }

    /// Returns the rows of the field: for each the index of its first cell, counted row by row over all cells of the
    /// map, and its values. `cells_per_row` is the number of cells in a row of the map.
    pub fn lines(&self, cells_per_row: usize) -> impl Iterator<Item = (usize, &[f64])> {
        let first = self.rows.start * cells_per_row + self.columns.start;
        let width = self.columns.len().max(1);
        let lines = self.value.chunks_exact(width).enumerate();
        lines.map(move |(r, line)| (first + r * cells_per_row, line))
    }

    /// Returns the sum of fields, each times a number, on a box that holds them all.
    pub fn sum(parts: &[(&Self, f64)]) -> Self {
        let filled: Vec<_> = parts.iter().filter(|(f, _)| !f.value.is_empty()).collect();
        let rows = hull(filled.iter().map(|(f, _)| &f.rows));
        let columns = hull(filled.iter().map(|(f, _)| &f.columns));
        let mut sum = Self::on(rows, columns);
        let width = sum.columns.len();
        for (field, by) in filled {
            for (r, line) in field.value.chunks_exact(field.columns.len()).enumerate() {
                let row = field.rows.start + r - sum.rows.start;
                let first = row * width + field.columns.start - sum.columns.start;
                let into = &mut sum.value[first..first + line.len()];
                into.iter_mut().zip(line).for_each(|(s, v)| *s += by * v);
            }
        }
        sum
    }
}

/// Returns the smallest range that holds all `ranges`; an empty one if there are none.
fn hull<'a>(ranges: impl Iterator<Item = &'a Range<usize>>) -> Range<usize> {
    let all = ranges.cloned().reduce(|a, b| a.start.min(b.start)..a.end.max(b.end));
    all.unwrap_or_default()
}

/// The TIF that errors change, on the cells of a map. It has no factor of the time, which the motion holds.
pub struct Tool {
    /// TIF without the factor of the time.
    pub tif: Tif,
    /// Mean factor of the pixels in every cell; `None` if the tool has no such factor.
    factor: Option<Vec<f64>>,
}

impl Tool {
    /// Makes the tool on the cells of `inner`.
    pub fn new(tif: &Tif, inner: &Inner) -> Self {
        let tif = tif.without_time().into_owned();
        let factor = tif.variation().and_then(|v| v.factor_on(&inner.grid));
        let factor = factor.map(|g| inner.to_cells(&inner.masked(g.into_owned())));
        Self { tif, factor }
    }

    /// Returns the weights of the kernels of the tool at a place of the part; empty for a tool that is the same
    /// everywhere.
    pub fn weights(&self, place_mm: [f64; 2]) -> Vec<f64> {
        let Some(v) = self.tif.variation() else { return Vec::new() };
        // Tools that turn with their motion are refused: every heading is as good.
        let pose = Pose::along_x(place_mm);
        (0..v.components().len()).map(|k| v.weight(k, pose)).collect()
    }

    /// Returns the mean factor of the pixels in a cell; 1 if the tool has none.
    pub fn factor(&self, cell: usize) -> f64 {
        self.factor.as_ref().map_or(1.0, |factor| factor[cell])
    }

    /// Returns the rate of a tool with these weights of its kernels at the offset (x, y) mm, nm/s, without the factor
    /// of the pixels.
    fn rate(&self, weights: &[f64], x: f64, y: f64) -> f64 {
        let Some(v) = self.tif.variation() else { return self.tif.rate_at(x, y) };
        let each = v.components().iter().zip(weights);
        each.map(|(component, a)| a * component.kernel().rate_at(x, y)).sum()
    }
}

/// Quantity of the tool that is integrated: its rate, or the change of the rate with its position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Change {
    /// The rate itself, nm/s.
    AsItIs,
    /// The derivative of the rate at a fixed pixel by the position of the tool along the axis 0 (x) or 1 (y), nm/s/mm.
    Along(usize),
}

/// A tool at one position, prepared for the values of its rate or of the change.
struct PlacedChange<'a> {
    tool: &'a Tool,
    place_mm: [f64; 2],
    change: Change,
    /// Half a sample of the TIF along the axis of the change, mm.
    half_mm: f64,
    /// Weights of the kernels at the position; for a change, half a sample before it and after it.
    weights: [Vec<f64>; 2],
}

impl<'a> PlacedChange<'a> {
    fn new(tool: &'a Tool, place_mm: [f64; 2], change: Change) -> Self {
        let Change::Along(axis) = change else {
            let weights = [tool.weights(place_mm), Vec::new()];
            return Self { tool, place_mm, change, half_mm: 0.0, weights };
        };
        let steps = [tool.tif.grid().x.step_mm(), tool.tif.grid().y.step_mm()];
        let half_mm = 0.5 * steps[axis];
        let weights = [-half_mm, half_mm].map(|by| {
            let mut moved = place_mm;
            moved[axis] += by;
            tool.weights(moved)
        });
        Self { tool, place_mm, change, half_mm, weights }
    }

    /// Returns the rate or its change at the point (x, y) mm of the part, in the unit of the change.
    fn value(&self, x: f64, y: f64) -> f64 {
        let Self { tool, half_mm: h, weights: [before, after], .. } = self;
        let x = x - self.place_mm[0];
        let y = y - self.place_mm[1];
        let difference = match self.change {
            Change::AsItIs => return tool.rate(before, x, y),
            Change::Along(0) => tool.rate(after, x - h, y) - tool.rate(before, x + h, y),
            Change::Along(_) => tool.rate(after, x, y - h) - tool.rate(before, x, y + h),
        };
        difference / (2.0 * h)
    }
}

/// Returns an upper bound of the number of cells that a resting tool reaches.
pub fn cells_of_tif(inner: &Inner, tif: &Tif) -> usize {
    let tool = tif.grid();
    let [px, py] = inner.cells.pixels;
    let axes = [(&inner.grid.x, &tool.x, px), (&inner.grid.y, &tool.y, py)];
    let [x, y] = axes.map(|(map, tool, pixels)| {
        let cells = (tool.end_mm() - tool.start_mm()) / (map.step_mm() * pixels as f64);
        (cells as usize + 3).min(map.len().div_ceil(pixels))
    });
    x * y
}

/// Returns the rows and columns of the cells within the samples of the TIF of a tool at any of the `places`, and at
/// least one more on every side, as far as the map has them.
pub fn reached(
    places: impl Iterator<Item = [f64; 2]> + Clone,
    inner: &Inner,
    tif: &Tif,
) -> (Range<usize>, Range<usize>) {
    let (rows, columns) = inner.cells.shape;
    let axes = [(&inner.grid.x, &tif.grid().x, columns), (&inner.grid.y, &tif.grid().y, rows)];
    let [columns, rows] = [0, 1].map(|axis| {
        let (map, tool, last) = axes[axis];
        let low = places.clone().map(|p| p[axis]).fold(f64::INFINITY, f64::min);
        let high = places.clone().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max);
        let size = inner.cells.pixels[axis] as f64 * map.step_mm();
        let [first, end] =
            [low + tool.start_mm(), high + tool.end_mm()].map(|mm| (mm - map.start_mm()) / size);
        let from = (first - 1.0).floor().clamp(0.0, last as f64);
        let to = (end + 2.0).ceil().clamp(0.0, last as f64);
        from as usize..(to as usize).max(from as usize)
    });
    (rows, columns)
}

/// Returns the integral over a piece of the rate of the tool, or of its change, on the cells that it reaches; empty if
/// the tool is off.
pub fn field(piece: &Piece, inner: &Inner, tool: &Tool, change: Change) -> Field {
    if !piece.tool_on {
        return Field::default();
    }
    let points = gauss_legendre::<POINTS>().map(|(node, weight)| {
        let u = node * piece.duration_s;
        let place = [0, 1].map(|a| evaluate(&piece.coefficient_mm[a], u));
        (PlacedChange::new(tool, place, change), weight * piece.duration_s * piece.rate_factor)
    });
    let cells = &inner.cells;
    let (rows, columns) = reached(points.iter().map(|(p, _)| p.place_mm), inner, &tool.tif);
    let mut field = Field::on(rows, columns);
    let width = field.columns.len();
    if width == 0 {
        return Field::default();
    }
    for (r, line) in field.value.chunks_exact_mut(width).enumerate() {
        let first = (field.rows.start + r) * cells.shape.1 + field.columns.start;
        for (c, v) in line.iter_mut().enumerate().filter(|(c, _)| cells.weight[first + c] > 0.0) {
            let [x, y] = cells.centre_mm[first + c];
            let sum: f64 = points.iter().map(|(placed, t)| t * placed.value(x, y)).sum();
            *v = tool.factor(first + c) * sum;
        }
    }
    field
}
