//! How large the cells and how wide the splines of the surrogates are.

use planish_types::{Axis, Grid, Tif};

use crate::model::columns::Place;

/// Fraction of the energy of the TIF that the cells may lose where H~ is factorised.
pub const MAX_LOSS_FACTORISED: f64 = 5e-3;

/// The same where the two-level method solves for dwell points so dense that what they cannot remove
/// decides.
pub const MAX_LOSS_TWO_LEVEL: f64 = 1.3e-3;

/// The same for gradient steps, where products with H~ are what costs.
pub const MAX_LOSS_GRADIENT: f64 = 2e-2;

/// Most pixels of the map along the side of a cell.
const MAX_CELL_PIXELS: usize = 16;

/// Pitch of the splines over the width of the TIF `(<R^2> / <|grad R|^2>)^1/2` (sigma of a Gaussian). By the
/// time that problems took.
const SPLINE_PITCH_OVER_TIF_WIDTH: f64 = 0.7;

/// Least pitch over the mean spacing of the columns: many more splines than columns are dependent, and
/// their matrix is singular to rounding.
const MIN_SPLINE_PITCH_OVER_SPACING: f64 = 1.5;

/// Longest column that a spline can be made of, over the pitch.
const MAX_COLUMN_OVER_SPLINE_PITCH: f64 = 2.0;

/// Most elements of the matrix of the splines (three copies of 120 MB).
const MAX_SPLINE_MATRIX_ELEMENTS: f64 = 1.5e7;

/// Most elements of the removal by all splines (200 MB).
const MAX_SPLINE_PATCH_ELEMENTS: f64 = 2.5e7;

/// Pixels of the map along the side of the largest cell that loses at most this fraction of the energy.
pub fn cell_size(tif: &Tif, map: &Grid, max_loss: f64) -> usize {
    let [along_x, along_y] = tif.slope_energy_per_mm2();
    let (hx, hy) = (map.x.step_mm(), map.y.step_mm());
    let loss = |s: usize| (s * s) as f64 * (hx * hx * along_x + hy * hy * along_y) / 12.0;
    (2..=MAX_CELL_PIXELS).rev().find(|s| loss(*s) <= max_loss).unwrap_or(1)
}

/// Largest extent of the places of a column along an axis, mm.
pub fn length_mm(places: &[Place]) -> f64 {
    let (low, high) = extent(places.iter().map(|p| &p.position_mm));
    (high[0] - low[0]).max(high[1] - low[1]).max(0.0)
}

/// Which of the reached columns a spline of this pitch can be made of.
pub fn are_short(places: &[Vec<Place>], reached: &[bool], pitch_mm: f64) -> Vec<bool> {
    places
        .iter()
        .zip(reached)
        .map(|(places, reached)| {
            *reached && length_mm(places) <= MAX_COLUMN_OVER_SPLINE_PITCH * pitch_mm
        })
        .collect()
}

/// Pitch of splines that can say what the TIF resolves, mm; none where most columns are longer, or
/// where their matrix would be too large, which depends on the area under the reached columns, not on
/// their number.
pub fn spline_pitch(
    places: &[Vec<Place>],
    reached: &[bool],
    tif: &Tif,
    map: &Grid,
    cell: usize,
) -> Option<f64> {
    let [along_x, along_y] = tif.slope_energy_per_mm2();
    let of_reached =
        places.iter().zip(reached).filter(|(_, reached)| **reached).flat_map(|(p, _)| p);
    let (low, high) = extent(of_reached.map(|p| &p.position_mm));
    let size_mm = [high[0] - low[0], high[1] - low[1]];
    let count = |of: &[bool]| of.iter().filter(|of| **of).count();
    let spacing = (size_mm[0] * size_mm[1] / count(reached) as f64).sqrt();
    let pitch = (SPLINE_PITCH_OVER_TIF_WIDTH / (along_x + along_y).sqrt())
        .max(MIN_SPLINE_PITCH_OVER_SPACING * spacing);
    let wide = |axis: &Axis| axis.end_mm() - axis.start_mm();
    let reach = [&tif.grid().x, &tif.grid().y].map(|axis| wide(axis) + 4.0 * pitch);
    let (nodes, row) = lattice_size(size_mm, reach, pitch);
    let cells = |k: usize, step: f64| reach[k] / (cell as f64 * step) + 4.0;
    let patched = nodes * cells(0, map.x.step_mm()) * cells(1, map.y.step_mm());
    let dense = count(&are_short(places, reached, pitch)) * 2 > count(reached);
    (dense && nodes * row <= MAX_SPLINE_MATRIX_ELEMENTS && patched <= MAX_SPLINE_PATCH_ELEMENTS)
        .then_some(pitch)
}

/// Nodes of a lattice of splines over a rectangle of this size [x, y], and most elements of a row of its
/// matrix when what a dwell point removes is `reach_mm` wide.
fn lattice_size(size_mm: [f64; 2], reach_mm: [f64; 2], pitch_mm: f64) -> (f64, f64) {
    let nodes = size_mm.map(|v| v / pitch_mm + 4.0);
    let row = if nodes[0] < nodes[1] {
        (reach_mm[1] / pitch_mm + 4.0).min(nodes[1]) * nodes[0]
    } else {
        (reach_mm[0] / pitch_mm + 4.0).min(nodes[0]) * nodes[1]
    };
    (nodes[0] * nodes[1], row)
}

/// Least and largest [x, y].
pub fn extent<'a>(points: impl Iterator<Item = &'a [f64; 2]>) -> ([f64; 2], [f64; 2]) {
    let start = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    points.fold(start, |(low, high), p| {
        ([low[0].min(p[0]), low[1].min(p[1])], [high[0].max(p[0]), high[1].max(p[1])])
    })
}
