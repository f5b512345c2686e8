//! Fields on a box of the cells: what a piece of the motion removes.

use std::ops::Range;

use planish_numerics::{polynomial::evaluate, quadrature::gauss_legendre};
use planish_types::{Axis, Tif};

use crate::{inner::Inner, motion::Piece};

/// Number of Gauss points of a piece, over which the tool goes half the width of the TIF at most. Larger: more time.
/// Smaller: a larger error of the fields.
const POINTS: usize = 3;

/// A field on a box of the cells.
#[derive(Clone, Debug, Default)]
pub struct Field {
    /// Rows of cells.
    pub rows: Range<usize>,
    /// Columns of cells.
    pub columns: Range<usize>,
    /// Row by row.
    pub value: Vec<f64>,
}

impl Field {
    /// 0 on a box.
    pub fn on(rows: Range<usize>, columns: Range<usize>) -> Self {
        let value = vec![0.0; rows.len() * columns.len()];
        Self { rows, columns, value }
    }

    /// Index on the cells of each row's first value, and its values.
    pub fn lines(&self, cells_per_row: usize) -> impl Iterator<Item = (usize, &[f64])> {
        let first = move |r: usize| (self.rows.start + r) * cells_per_row + self.columns.start;
        let width = self.columns.len().max(1);
        self.value.chunks_exact(width).enumerate().map(move |(r, line)| (first(r), line))
    }

    /// Sum of fields times numbers, on a box that holds them all.
    pub fn sum(parts: &[(&Self, f64)]) -> Self {
        let filled: Vec<_> = parts.iter().filter(|(f, _)| !f.value.is_empty()).collect();
        let hull = |of: fn(&Self) -> &Range<usize>| {
            let low = filled.iter().map(|(f, _)| of(f).start).min().unwrap_or(0);
            low..filled.iter().map(|(f, _)| of(f).end).max().unwrap_or(0)
        };
        let mut sum = Self::on(hull(|f| &f.rows), hull(|f| &f.columns));
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

/// dR/dx at a fixed place for a tool that moves along x.
pub fn slope_x(tif: &Tif, x: f64, y: f64) -> f64 {
    let h = 0.5 * tif.grid().x.step_mm();
    (tif.rate_at(x - h, y) - tif.rate_at(x + h, y)) / (2.0 * h)
}

/// dR/dy at a fixed place for a tool that moves along y.
pub fn slope_y(tif: &Tif, x: f64, y: f64) -> f64 {
    let h = 0.5 * tif.grid().y.step_mm();
    (tif.rate_at(x, y - h) - tif.rate_at(x, y + h)) / (2.0 * h)
}

/// Cells that a resting tool reaches, at most.
pub fn cells_of_tif(inner: &Inner, tif: &Tif) -> usize {
    let across = |map: &Axis, tif: &Axis, pixels: usize| {
        let cells = (tif.end_mm() - tif.start_mm()) / (map.step_mm() * pixels as f64);
        (cells as usize + 3).min(map.len().div_ceil(pixels))
    };
    let (map, tool) = (&inner.grid, tif.grid());
    let [px, py] = inner.cells.pixels;
    across(&map.x, &tool.x, px) * across(&map.y, &tool.y, py)
}

/// Rows and columns of the cells whose pixels are within the TIF of a tool at any of the places, and one more on
/// every side.
pub fn reached(
    places: impl Iterator<Item = [f64; 2]> + Clone,
    inner: &Inner,
    tif: &Tif,
) -> (Range<usize>, Range<usize>) {
    let along = |axis: usize| {
        let (map, tool) = match axis {
            0 => (&inner.grid.x, &tif.grid().x),
            _ => (&inner.grid.y, &tif.grid().y),
        };
        let low = places.clone().map(|p| p[axis]).fold(f64::INFINITY, f64::min);
        let high = places.clone().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max);
        let (rows, columns) = inner.cells.shape;
        let last = if axis == 0 { columns } else { rows };
        let size = inner.cells.pixels[axis] as f64 * map.step_mm();
        let cell = |mm: f64| (mm - map.start_mm()) / size;
        let from = (cell(low + tool.start_mm()) - 1.0).floor().clamp(0.0, last as f64);
        let to = (cell(high + tool.end_mm()) + 2.0).ceil().clamp(0.0, last as f64);
        from as usize..(to as usize).max(from as usize)
    };
    (along(1), along(0))
}

/// The integral of `of` over a piece, on the cells it reaches.
pub fn field(piece: &Piece, inner: &Inner, tif: &Tif, of: fn(&Tif, f64, f64) -> f64) -> Field {
    if !piece.tool_on {
        return Field::default();
    }
    let points = gauss_legendre::<POINTS>().map(|(node, weight)| {
        let u = node * piece.duration_s;
        let place = [0, 1].map(|a| evaluate(&piece.coefficient_mm[a], u));
        (place, weight * piece.duration_s)
    });
    let cells = &inner.cells;
    let (rows, columns) = reached(points.iter().map(|(p, _)| *p), inner, tif);
    let mut field = Field::on(rows, columns);
    let width = field.columns.len();
    if width == 0 {
        return Field::default();
    }
    for (r, line) in field.value.chunks_exact_mut(width).enumerate() {
        let first = (field.rows.start + r) * cells.shape.1 + field.columns.start;
        for (c, v) in line.iter_mut().enumerate().filter(|(c, _)| cells.weight[first + c] > 0.0) {
            let [x, y] = cells.centre_mm[first + c];
            *v = points.iter().map(|([px, py], t)| t * of(tif, x - px, y - py)).sum();
        }
    }
    field
}
