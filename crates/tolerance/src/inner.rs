//! The inner product of residuals: the mean over the valid pixels, after the free terms (low-order terms that need not
//! be removed) are taken off.
//!
//! ```text
//! <f, g> = 1/m sum f g over the m valid pixels,    |f|^2 = <f, f>
//! P f    = f - sum_q <q, f> q                       the free terms q (piston, or a plane) removed
//! ```
//!
//! Fields that are smooth on the scale of the TIF (all that noise along the run removes) are stored on cells of
//! pixels. A cell is a third of the TIF's width wide; its value is that at the centroid of its valid pixels.

use ndarray::Array2;
use planish_types::{Grid, Surface};

use crate::settings::Free;

/// Number of cells per width of the TIF. The product of two Gaussians of this width is summed over cells with an error
/// of exp(-pi^2 3^2) in the interior; at a border the error is (1/3)^2 / 24 of the part there. Larger: more cells, more
/// time. Smaller: a larger error.
const CELLS_PER_WIDTH: f64 = 3.0;

/// Fraction of a free term that must remain after the terms before it are taken off; a term with less is left out, for
/// example a plane on one row of pixels. Larger: tilts on narrow maps are not free. Smaller: rounding passes as a free
/// term.
const INDEPENDENT: f64 = 1e-9;

/// The valid pixels of a map, its free terms, and its cells (blocks of pixels).
pub struct Inner {
    /// Pixels of the map.
    pub grid: Grid,
    valid: Array2<bool>,
    /// Number of valid pixels.
    pub count: f64,
    /// Orthonormal free terms, shape (ny, nx); 0 where invalid.
    free: Vec<Array2<f64>>,
    /// Blocks of pixels into which the map is divided.
    pub cells: CellGrid,
}

/// Blocks of pixels (cells), numbered row by row.
pub struct CellGrid {
    /// Number of pixels per cell [along x, along y].
    pub pixels: [usize; 2],
    /// Number of cells (rows, columns).
    pub shape: (usize, usize),
    /// Number of valid pixels of each cell.
    pub weight: Vec<f64>,
    /// Centroid [x, y] of the valid pixels of each cell, mm.
    pub centre_mm: Vec<[f64; 2]>,
    /// Orthonormal free terms on the cells.
    pub free: Vec<Vec<f64>>,
}

impl Inner {
    /// Makes the cells of the map `desired` for a TIF of the width `width_mm`; `free` says which terms do not count.
    pub fn new(desired: &Surface, free: Free, width_mm: f64) -> Self {
        let grid = *desired.grid();
        let valid = desired.height_nm().mapv(|z| !z.is_nan());
        let count = valid.iter().filter(|v| **v).count() as f64;
        let pixels = [&grid.x, &grid.y].map(|axis| {
            let pixels = (width_mm / CELLS_PER_WIDTH / axis.step_mm()) as usize;
            pixels.clamp(1, axis.len())
        });
        let shape = (grid.y.len().div_ceil(pixels[1]), grid.x.len().div_ceil(pixels[0]));
        let mut weight = vec![0.0; shape.0 * shape.1];
        let mut centre_mm = vec![[0.0; 2]; weight.len()];
        for ((r, c), _) in valid.indexed_iter().filter(|(_, v)| **v) {
            let cell = r / pixels[1] * shape.1 + c / pixels[0];
            weight[cell] += 1.0;
            centre_mm[cell][0] += grid.x.coordinate_mm(c);
            centre_mm[cell][1] += grid.y.coordinate_mm(r);
        }
        for (centre, w) in centre_mm.iter_mut().zip(&weight).filter(|(_, w)| **w > 0.0) {
            centre.iter_mut().for_each(|v| *v /= w);
        }
        let cells = CellGrid { pixels, shape, weight, centre_mm, free: Vec::new() };
        let mut inner = Self { grid, valid, count, free: Vec::new(), cells };
        let middle = [&grid.x, &grid.y].map(|a| 0.5 * (a.start_mm() + a.end_mm()));
        let terms: &[fn(f64, f64) -> f64] = match free {
            Free::Piston => &[|_, _| 1.0],
            Free::Plane => &[|_, _| 1.0, |x, _| x, |_, y| y],
        };
        for term in terms {
            let mut map = inner.masked(Array2::from_shape_fn(grid.shape(), |(r, c)| {
                term(grid.x.coordinate_mm(c) - middle[0], grid.y.coordinate_mm(r) - middle[1])
            }));
            let before = inner.dot(&map, &map);
            inner.project(&mut map);
            let norm = inner.dot(&map, &map);
            if norm > INDEPENDENT * before {
                map /= norm.sqrt();
                inner.cells.free.push(inner.to_cells(&map));
                inner.free.push(map);
            }
        }
        inner
    }

    /// Returns the map with 0 at its invalid pixels.
    pub fn masked(&self, mut map: Array2<f64>) -> Array2<f64> {
        map.zip_mut_with(&self.valid, |v, valid| {
            if !valid {
                *v = 0.0;
            }
        });
        map
    }

    /// Returns the map with NaN at its invalid pixels.
    pub fn with_nan(&self, mut map: Array2<f64>) -> Array2<f64> {
        map.zip_mut_with(&self.valid, |v, valid| {
            if !valid {
                *v = f64::NAN;
            }
        });
        map
    }

    /// Returns 1 where the map is valid, 0 elsewhere.
    pub fn validity(&self) -> Array2<f64> {
        self.valid.mapv(|valid| if valid { 1.0 } else { 0.0 })
    }

    /// Returns the orthonormal free terms, shape (ny, nx); 0 where the map is invalid.
    pub fn free(&self) -> &[Array2<f64>] {
        &self.free
    }

    /// Removes the free terms from a map that is 0 at invalid pixels.
    pub fn project(&self, map: &mut Array2<f64>) {
        for q in &self.free {
            let c = self.dot(q, map);
            map.zip_mut_with(q, |v, q| *v -= c * q);
        }
    }

    /// Returns a map as the RMS judges it: 0 at invalid pixels, and without the free terms.
    pub fn judged(&self, map: Array2<f64>) -> Array2<f64> {
        let mut map = self.masked(map);
        self.project(&mut map);
        map
    }

    /// Returns the inner product of two maps that are 0 at invalid pixels: the mean of their product over the valid
    /// pixels.
    pub fn dot(&self, f: &Array2<f64>, g: &Array2<f64>) -> f64 {
        let rows = f.outer_iter().zip(g.outer_iter());
        rows.map(|(f, g)| f.iter().zip(g).map(|(f, g)| f * g).sum::<f64>()).sum::<f64>()
            / self.count
    }

    /// Returns the mean over the valid pixels of each cell, for a map that is 0 at invalid pixels.
    pub fn to_cells(&self, map: &Array2<f64>) -> Vec<f64> {
        let CellGrid { pixels, shape, weight, .. } = &self.cells;
        let mut sum = vec![0.0; weight.len()];
        for ((r, c), v) in map.indexed_iter() {
            sum[r / pixels[1] * shape.1 + c / pixels[0]] += v;
        }
        sum.iter_mut().zip(weight).filter(|(_, w)| **w > 0.0).for_each(|(s, w)| *s /= w);
        sum
    }

    /// Returns the map with the value of its cell at every valid pixel, and 0 elsewhere.
    pub fn from_cells(&self, of_cell: &[f64]) -> Array2<f64> {
        let CellGrid { pixels, shape, .. } = &self.cells;
        self.masked(Array2::from_shape_fn(self.grid.shape(), |(r, c)| {
            of_cell[r / pixels[1] * shape.1 + c / pixels[0]]
        }))
    }

    /// Returns the inner product of two fields on the cells: the mean of their product, weighted by the valid pixels.
    pub fn dot_on_cells(&self, f: &[f64], g: &[f64]) -> f64 {
        let each = f.iter().zip(g).zip(&self.cells.weight);
        each.map(|((f, g), w)| w * f * g).sum::<f64>() / self.count
    }

    /// Removes the free terms from a field on the cells.
    pub fn project_on_cells(&self, field: &mut [f64]) {
        for q in &self.cells.free {
            let c = self.dot_on_cells(q, field);
            field.iter_mut().zip(q).for_each(|(v, q)| *v -= c * q);
        }
    }
}
