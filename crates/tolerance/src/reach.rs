//! Split of a residual into wavelengths that the tool corrects (the reached part) and shorter ones.
//!
//! ```text
//! f(x, y) = sum over j, k of f_jk cos(pi j (x - x0) / Lx) cos(pi k (y - y0) / Ly)
//! ```
//!
//! The cosines of the rectangle of the map are orthonormal over its pixels. So the mean square of the map (0 where it
//! is invalid) is the sum of the squares of its coefficients. A wave of the dwell-time density at a spatial frequency
//! removes a wave that is smaller by the transfer function of the TIF, its Fourier transform over its volume. The
//! tool reaches the cosines at which that is at least [`LEAST_TRANSFER`].

use std::f64::consts::PI;

use ndarray::{Array2, Zip, s};
use planish_numerics::spectrum::{LEAST_TRANSFER, transfer};
use planish_types::{Axis, Tif};

use crate::inner::Inner;

/// Largest spatial frequency that is considered, times the width of the TIF, dimensionless. The transfer function of a
/// Gaussian is exp(-2 pi^2) there. Larger: more time. Smaller: frequencies that the tool reaches are left out.
const LARGEST_FREQUENCY: f64 = 1.0;

/// The cosines over the map that the tool reaches: those with a transfer function of at least [`LEAST_TRANSFER`].
pub struct Reach {
    /// Cosines along y (rows k) on the pixels, orthonormal.
    y: Array2<f64>,
    /// Cosines along x (rows j) on the pixels, orthonormal.
    x: Array2<f64>,
    /// True for the pairs (k, j) of cosines along y and x that the tool reaches.
    reached: Array2<bool>,
    /// The reached pairs (k, j).
    pairs: Vec<(usize, usize)>,
    x_axis: Axis,
    y_axis: Axis,
}

/// Returns the value of the orthonormal cosine j of n at the position `i` in pixels, which may lie between two pixels.
fn cosine(j: usize, n: usize, i: f64) -> f64 {
    let scale = if j == 0 { 1.0 } else { 2.0_f64.sqrt() };
    scale / (n as f64).sqrt() * (PI * j as f64 * (i + 0.5) / n as f64).cos()
}

impl Reach {
    /// Computes the reached cosines for maps on the pixels of `inner`; `width_mm` is the width of the TIF.
    pub fn new(inner: &Inner, tif: &Tif, width_mm: f64) -> Self {
        let x_axis = inner.grid.x;
        let y_axis = inner.grid.y;
        let [f_x, f_y] = [&x_axis, &y_axis].map(|a| -> Vec<f64> {
            let all = (0..a.len()).map(|j| j as f64 / (2.0 * a.len() as f64 * a.step_mm()));
            all.take_while(|f| *f <= LARGEST_FREQUENCY / width_mm).collect()
        });
        // A cosine is a wave and the one mirrored along y, in equal parts.
        let mirrored: Vec<f64> = f_y.iter().map(|f| -f).collect();
        let [x, y] = [&tif.grid().x, &tif.grid().y].map(Axis::coordinates);
        let [plus, minus] = [&f_y, &mirrored]
            .map(|f_y| transfer(tif.rate_nm_per_s().view(), [&x, &y], [&f_x, f_y]));
        let both = Zip::from(&plus).and(&minus).map_collect(|p, m| ((p * p + m * m) / 2.0).sqrt());
        let reached = both.mapv(|transfer| transfer >= LEAST_TRANSFER);
        // Only as far as the last that is reached.
        let [ny, nx] = [0, 1].map(|axis| {
            let lanes: Vec<bool> =
                reached.axis_iter(ndarray::Axis(axis)).map(|l| l.iter().any(|r| *r)).collect();
            lanes.iter().rposition(|any| *any).map_or(1, |i| i + 1)
        });
        let reached = reached.slice(s![..ny, ..nx]).to_owned();
        let pairs = reached.indexed_iter().filter(|(_, r)| **r).map(|(p, _)| p).collect();
        let [y, x] = [(ny, &y_axis), (nx, &x_axis)].map(|(n, axis)| {
            Array2::from_shape_fn((n, axis.len()), |(j, i)| cosine(j, axis.len(), i as f64))
        });
        Self { y, x, reached, pairs, x_axis, y_axis }
    }

    /// Returns the part of the mean square of a map, in its unit squared, that is in the reached cosines. The map is 0
    /// at invalid pixels.
    pub fn mean_square(&self, inner: &Inner, map: &Array2<f64>) -> f64 {
        let coefficients = self.y.dot(map).dot(&self.x.t());
        let reached = coefficients.iter().zip(&self.reached).filter(|(_, r)| **r);
        reached.map(|(c, _)| c * c).sum::<f64>() / inner.count
    }

    /// Returns the reached part of the mean square of P w. Here w is white noise of variance one on the m valid pixels,
    /// and P removes the free terms q. With the coefficients C of the reached cosines c it is `tr(P C' C P) / m = (sum
    /// over the cosines of |c|^2 on the valid pixels - sum_q |C q|^2 / m) / m`.
    pub fn of_white(&self, inner: &Inner) -> f64 {
        let [y, x] = [&self.y, &self.x].map(|a| a.mapv(|v| v * v));
        let on_valid = y.dot(&inner.validity()).dot(&x.t());
        let all: f64 = on_valid.iter().zip(&self.reached).filter(|(_, r)| **r).map(|c| c.0).sum();
        let free: f64 = inner.free().iter().map(|q| self.mean_square(inner, q)).sum();
        ((all - free) / inner.count).max(0.0)
    }

    /// Returns the reached cosines at the centres of the cells. The coefficient f_jk of a field is the sum over the
    /// cells of its value, the cosines and the number of valid pixels, multiplied.
    pub fn on_cells(&self, inner: &Inner) -> CosinesOnCells {
        let cells = &inner.cells;
        let (ny, nx) = self.reached.dim();
        let (rows, columns) = cells.shape;
        // Rows (and columns) of cells have one coordinate where the map is whole; at its border a centroid
        // is elsewhere, which the mean over the row stands for.
        let mean = |members: Vec<usize>, axis: usize, of_map: &Axis| {
            let total: f64 = members.iter().map(|i| cells.weight[*i]).sum();
            let sum: f64 =
                members.iter().map(|i| cells.weight[*i] * cells.centre_mm[*i][axis]).sum();
            let mean_mm = sum / total;
            if total > 0.0 { (mean_mm - of_map.start_mm()) / of_map.step_mm() } else { 0.0 }
        };
        let y = (0..rows)
            .map(|r| mean((0..columns).map(|c| r * columns + c).collect(), 1, &self.y_axis));
        let x = (0..columns)
            .map(|c| mean((0..rows).map(|r| r * columns + c).collect(), 0, &self.x_axis));
        CosinesOnCells {
            y: cosines(ny, self.y_axis.len(), &y.collect::<Vec<f64>>()),
            x: cosines(nx, self.x_axis.len(), &x.collect::<Vec<f64>>()),
            pairs: self.pairs.clone(),
        }
    }
}

/// Returns the values of the first n of `len` cosines (columns) at the positions `places`, in pixels (rows).
fn cosines(n: usize, len: usize, places: &[f64]) -> Array2<f64> {
    Array2::from_shape_fn((places.len(), n), |(i, j)| cosine(j, len, places[i]))
}

/// The reached cosines at the centres of the rows and columns of the cells.
pub struct CosinesOnCells {
    /// Cosines along y, shape (rows of cells, k).
    pub y: Array2<f64>,
    /// Cosines along x, shape (columns of cells, j).
    pub x: Array2<f64>,
    /// The reached pairs (k, j).
    pub pairs: Vec<(usize, usize)>,
}

#[cfg(test)]
mod tests {
    use planish_types::{Grid, Surface};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::settings::Free;

    /// The part of white noise that the tool reaches agrees with the mean over drawn maps, on a disk, which fills 3/5
    /// of its rectangle.
    #[test]
    fn of_white_noise_the_tool_reaches_what_drawn_maps_say() {
        let axis = |n| Axis::new(0.0, 0.5, n).unwrap();
        let grid = Grid { x: axis(48), y: axis(40) };
        let disk = |(r, c): (usize, usize)| {
            let (x, y) = (grid.x.coordinate_mm(c) - 12.0, grid.y.coordinate_mm(r) - 10.0);
            if x * x + y * y < 90.0 { 0.0 } else { f64::NAN }
        };
        let desired = Surface::new(grid, Array2::from_shape_fn(grid.shape(), disk)).unwrap();
        let of = Axis::new(-5.0, 0.5, 21).unwrap();
        let rate = |(r, c): (usize, usize)| {
            (-(of.coordinate_mm(r).powi(2) + of.coordinate_mm(c).powi(2)) / 2.0).exp()
        };
        let tif = Tif::new(Grid { x: of, y: of }, Array2::from_shape_fn((21, 21), rate)).unwrap();
        for free in [Free::Piston, Free::Plane] {
            let inner = Inner::new(&desired, free, 1.0);
            let reach = Reach::new(&inner, &tif, 1.0);
            let mut rng = ChaCha8Rng::seed_from_u64(7);
            let maps = 400;
            let drawn: Vec<f64> = (0..maps)
                .map(|_| {
                    let draw = |_| StandardNormal.sample(&mut rng);
                    let white = Array2::from_shape_fn(grid.shape(), draw);
                    reach.mean_square(&inner, &inner.judged(white))
                })
                .collect();
            let mean = drawn.iter().sum::<f64>() / f64::from(maps);
            let square = drawn.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / f64::from(maps);
            // Four standard errors of the mean.
            let bound = 4.0 * (square / f64::from(maps)).sqrt();
            assert!(bound < 0.1 * mean && (reach.of_white(&inner) - mean).abs() < bound);
        }
    }
}
