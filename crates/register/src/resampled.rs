//! Heights of a map at the pixels of another grid.

use planish_types::{Axis, Grid, Surface};

use crate::field::Field;

/// Distance of pixel centres, in steps, up to which two grids have the same pixels. Larger: maps are displaced by as
/// much. Smaller: rounded coordinates are interpolated, which smooths the noise of the map.
const SAME_PIXEL: f64 = 1e-6;

/// Reads heights of one map at points of another grid.
pub(crate) struct Resampled<'a> {
    map: &'a Surface,
    field: Field,
    /// Row and column of the map at the first pixel of the grid, if both have the same pixels.
    offset: Option<[isize; 2]>,
}

impl<'a> Resampled<'a> {
    /// Prepares to read `map` at the pixels of `grid`.
    pub fn new(map: &'a Surface, grid: &Grid) -> Self {
        let own = map.grid();
        let offset = |to: &Axis, of: &Axis| {
            let begin = (to.start_mm() - of.start_mm()) / of.step_mm();
            let end = (to.end_mm() - of.start_mm()) / of.step_mm();
            let whole = |v: f64| (v - v.round()).abs() <= SAME_PIXEL;
            let steps = (to.len() - 1) as f64;
            let same = whole(begin) && (end - begin - steps).abs() <= SAME_PIXEL;
            same.then_some(begin.round() as isize)
        };
        let rows_columns = offset(&grid.y, &own.y).zip(offset(&grid.x, &own.x));
        let offset = rows_columns.map(|(row, column)| [row, column]);
        Self { map, field: Field::new(map.clone()), offset }
    }

    /// Returns true if the grid has the pixels of the map, so that nothing is interpolated.
    pub fn is_exact(&self) -> bool {
        self.offset.is_some()
    }

    /// Height, nm, at the pixel (row, column) of the grid, which lies at `p` [x, y], mm. `None` beyond the map and where
    /// a pixel that it needs is invalid.
    pub fn at_pixel(&self, (row, column): (usize, usize), p: [f64; 2]) -> Option<f64> {
        let Some([first_row, first_column]) = self.offset else { return self.at(p) };
        let height = self.map.height_nm();
        let index = [row as isize + first_row, column as isize + first_column];
        let [r, c] = index.map(|i| usize::try_from(i).ok());
        height.get([r?, c?]).copied().filter(|z| !z.is_nan())
    }

    /// Height, nm, at a point [x, y], mm, by Keys' cubic convolution.
    pub fn at(&self, p: [f64; 2]) -> Option<f64> {
        Some(self.field.at(p)?.0)
    }
}
