//! Heights of a map at the pixels of another grid; interpolated only if the pixels differ.

use planish_types::{Axis, Grid, Surface};

use crate::field::Field;

/// Largest distance of corresponding pixel centres, in pixels, at which two grids count as the same. Larger: maps are
/// displaced by as much. Smaller: rounded coordinates are interpolated, which smooths the noise of the map.
const SAME_PIXEL: f64 = 1e-6;

/// A map that can be read at the pixels of another grid.
pub(crate) struct Resampled<'a> {
    map: &'a Surface,
    field: Field,
    /// Row and column of the map at the first pixel of the grid; `None` if the pixels of the two do not coincide.
    offset: Option<[isize; 2]>,
}

impl<'a> Resampled<'a> {
    /// Prepares to read `map` at the pixels of `grid`, and compares the pixels of both.
    pub fn new(map: &'a Surface, grid: &Grid) -> Self {
        let own = map.grid();
        let rows_columns = offset(&grid.y, &own.y).zip(offset(&grid.x, &own.x));
        let offset = rows_columns.map(|(row, column)| [row, column]);
        Self { map, field: Field::new(map.clone()), offset }
    }

    /// Returns true if the pixels of the grid are pixels of the map, so that no height is interpolated.
    pub fn is_exact(&self) -> bool {
        self.offset.is_some()
    }

    /// Returns the height, nm, at the pixel (row, column) of the grid, whose centre is `p` [x, y], mm. Returns `None`
    /// beyond the map and where a pixel that it needs is invalid.
    pub fn at_pixel(&self, (row, column): (usize, usize), p: [f64; 2]) -> Option<f64> {
        let Some([first_row, first_column]) = self.offset else { return self.at_point(p) };
        let height = self.map.height_nm();
        let index = [row as isize + first_row, column as isize + first_column];
        let [r, c] = index.map(|i| usize::try_from(i).ok());
        height.get([r?, c?]).copied().filter(|z| !z.is_nan())
    }

    /// Returns the height, nm, at a point [x, y], mm, by Keys' cubic convolution, or `None` if a pixel around it is
    /// absent or invalid.
    pub fn at_point(&self, p: [f64; 2]) -> Option<f64> {
        Some(self.field.height_and_gradient(p)?.0)
    }
}

/// Returns the index on the axis `own` of the first pixel of `other`; it may be negative or beyond the end. Returns
/// `None` if the pixels of the two axes do not coincide.
fn offset(other: &Axis, own: &Axis) -> Option<isize> {
    let [begin, end] =
        [other.start_mm(), other.end_mm()].map(|mm| (mm - own.start_mm()) / own.step_mm());
    let steps = (other.len() - 1) as f64;
    let is_whole = (begin - begin.round()).abs() <= SAME_PIXEL;
    if is_whole && (end - begin - steps).abs() <= SAME_PIXEL {
        Some(begin.round() as isize)
    } else {
        None
    }
}
