//! A map of dwell times on squares of K x K pixels.
//!
//! The unknowns are the times t at every K-th tool position (*coarse node*) along x and y; between them the dwell map
//! tau is linear. Removal and desired removal are compared by their means over K x K pixels (*squares*). With hat(u) =
//! max(1 - |u| / K, 0), on each axis
//!
//! ```text
//! tau[n] = sum_J hat(n - K J) t[J] / K                 the time is kept                     (1)
//! mean over a < K of (R * tau)[K I + a] = sum_J G[I - J] t[J]
//! G[D] = sum_a sum_k R[k] hat(K D + a + s - 1 - k) / K^2                                  (2)
//! ```
//!
//! for the s samples of R. For dwell maps of this form the means are exact, unless pixels of a square have no weight.
//! The desired mean of such a square is moved from the centroid of its pixels to its middle, along the plane through
//! the neighbouring squares.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | t | `t` | coarse nodes | s |
//! | tau | - | tool positions at the pitch of the map | s |
//! | G | `kernel` | coarse nodes of one square | nm/s |

use ndarray::{Array2, ArrayView2};
use planish_numerics::{
    fft::{convolution::Convolution, plan::Planned},
    parallel,
    vectors::Lanes,
};
use planish_types::{Grid, Invalid, Surface, Tif};

use crate::dwell_map::lattice;

/// Number of pixels of a map from which on the automatic choice solves on squares of several pixels. Larger: more
/// maps are solved on their pixels, which takes longer. Smaller: smaller maps are solved on squares, too.
const MIN_PIXELS_FOR_SQUARES: usize = 1_000_000;

/// Number of squares in the length of peak over steepest slope of the TIF, dimensionless. For a Gaussian this length is
/// 0.70 of its full width at half maximum, so that there are ten squares in that width. Larger: smaller squares, and
/// more time. Smaller: larger squares, which resolve the TIF less. Chosen by the residuals with other values
/// (docs/dwell.md).
const SQUARES_ON_RISE: f64 = 7.0;

/// Largest K, pixels along the side of a square; the settings accept no larger one. Larger: wider squares for TIFs that
/// are very many pixels wide. Smaller: more squares, and more time, for such tools.
pub(crate) const MAX_SQUARE_PIXELS: usize = 64;

/// Returns the side K of the squares for a map, pixels: the largest that [`SQUARES_ON_RISE`] allows on both axes, from
/// 1 to [`MAX_SQUARE_PIXELS`]. It is 1 for a map below [`MIN_PIXELS_FOR_SQUARES`].
pub(crate) fn automatic_size(tif: &Tif, desired: &Surface) -> usize {
    let grid = desired.grid();
    if grid.x.len() * grid.y.len() < MIN_PIXELS_FOR_SQUARES {
        return 1;
    }
    let rate = tif.rate_nm_per_s();
    let peak = rate.iter().copied().fold(0.0, f64::max);
    // Largest slopes, per pixel of the map; what the TIF drops to beyond its samples counts too.
    let mut steepest = [0.0_f64; 2];
    for r in -1..rate.nrows() as isize {
        for c in -1..rate.ncols() as isize {
            let [own, right, above] =
                [(r, c), (r, c + 1), (r + 1, c)].map(|p| rate_or_zero(rate, p));
            steepest[0] = steepest[0].max((right - own).abs());
            steepest[1] = steepest[1].max((above - own).abs());
        }
    }
    let [x, y] = [(steepest[0], tif.grid().x, grid.x), (steepest[1], tif.grid().y, grid.y)]
        .map(|(slope, tif, map)| peak / slope * tif.step_mm() / map.step_mm());
    ((x.min(y) / SQUARES_ON_RISE) as usize).clamp(1, MAX_SQUARE_PIXELS)
}

/// Returns the sample (row, column) of the TIF, nm/s; 0 beyond its samples.
fn rate_or_zero(rate: &Array2<f64>, (r, c): (isize, isize)) -> f64 {
    let inside = r >= 0 && c >= 0;
    let sample = if inside { rate.get([r as usize, c as usize]) } else { None };
    sample.copied().unwrap_or(0.0)
}

/// Operators (1) and (2) of the module for a map of dwell times on squares. `T` is the number type of the FFT.
pub(crate) struct CoarseMap<T: Lanes + Planned> {
    size: usize,
    /// Grid of all tool positions, not only of the coarse nodes.
    nodes: Grid,
    /// Shape of the map (ny, nx), in pixels.
    pixels: (usize, usize),
    /// Shape of the lattice of coarse nodes, (rows, columns).
    shape: (usize, usize),
    convolution: Convolution<T>,
}

impl<T: Lanes + Planned> CoarseMap<T> {
    /// Makes the operators for maps on `grid` in squares of `size` x `size` pixels; with 1, the coarse nodes are all
    /// tool positions.
    ///
    /// # Errors
    /// Refuses a TIF that varies over the part.
    pub fn new(tif: &Tif, grid: &Grid, size: usize) -> Result<Self, Invalid> {
        let (samples, nodes) = lattice(tif, grid)?;
        let kernel = coarse_kernel(&samples, size);
        let pixels = grid.shape();
        let (ny, nx) = (pixels.0.div_ceil(size), pixels.1.div_ceil(size));
        let shape = (ny + kernel.nrows() - 1, nx + kernel.ncols() - 1);
        let convolution = Convolution::new(kernel.view(), shape);
        Ok(Self { size, nodes, pixels, shape, convolution })
    }

    /// Returns the grid of all tool positions, not only of the coarse nodes.
    pub fn nodes(&self) -> &Grid {
        &self.nodes
    }

    /// Returns the shape of the lattice of coarse nodes, (rows, columns).
    pub fn shape(&self) -> (usize, usize) {
        self.shape
    }

    /// Returns the mean removal over every square, (2) of the module, nm, for the times at the coarse nodes, s.
    pub fn removal(&self, t: ArrayView2<f64>) -> Array2<f64> {
        self.convolution.valid(t)
    }

    /// Applies the adjoint of [`Self::removal`] to a map with one value per square; the result has one value per coarse
    /// node.
    pub fn adjoint(&self, map: &Array2<f64>) -> Array2<f64> {
        self.convolution.adjoint(map.view())
    }

    /// Returns the values, at the coarse nodes, of a mask over all tool positions (rows, columns). The outermost coarse
    /// nodes may lie beyond all tool positions; they get the value at the border.
    pub fn at_nodes(&self, fine: &Array2<bool>) -> Array2<bool> {
        let (ny, nx) = fine.dim();
        Array2::from_shape_fn(self.shape, |(r, c)| {
            fine[[(r * self.size).min(ny - 1), (c * self.size).min(nx - 1)]]
        })
    }

    /// Returns the times on all tool positions, s, from those at the coarse nodes, by (1) of the module.
    pub fn prolong(&self, t: Array2<f64>) -> Array2<f64> {
        if self.size == 1 {
            return t;
        }
        let size = self.size;
        // hat / K of the coarse node below and of the one above
        let weights: Vec<[f64; 2]> = (0..size)
            .map(|f| [(size - f) as f64, f as f64].map(|w| w / (size * size) as f64))
            .collect();
        let last = (self.shape.0 - 1, self.shape.1 - 1);
        let mut tau = Array2::zeros(self.nodes.shape());
        parallel::consume_with(
            tau.outer_iter_mut(),
            &|| vec![0.0; self.shape.1],
            &|line, r, mut row| {
                let (j, [below, above]) = (r / size, weights[r % size]);
                let (a, b) = (t.row(j), t.row((j + 1).min(last.0)));
                for (l, (a, b)) in line.iter_mut().zip(a.iter().zip(b)) {
                    *l = below * a + above * b;
                }
                let row = row.as_slice_mut().expect("in C order");
                for (i, part) in row.chunks_mut(size).enumerate() {
                    let (a, b) = (line[i], line[(i + 1).min(last.1)]);
                    for (v, [below, above]) in part.iter_mut().zip(&weights) {
                        *v = below * a + above * b;
                    }
                }
            },
        );
        tau
    }

    /// Returns the desired removal in the middle of every square, and the weight of every square (sum over its pixels),
    /// from the desired removal e and the weights w of the pixels (ny, nx).
    pub fn restrict(&self, e: &Array2<f64>, w: &Array2<f64>) -> (Array2<f64>, Array2<f64>) {
        if self.size == 1 {
            return (e.clone(), w.clone());
        }
        let size = self.size;
        let (py, px) = self.pixels;
        let shape = (py.div_ceil(size), px.div_ceil(size));
        let [w, e] = [w, e].map(|map| map.as_slice().expect("in C order"));
        // Weight, mean, and centroid from the middle of the square [x, y].
        let mut squares = Array2::from_elem(shape, Square::default());
        parallel::consume(squares.outer_iter_mut(), &|i, mut row| {
            let rows = i * size..((i + 1) * size).min(py);
            let middle = 0.5 * (size - 1) as f64;
            let mut sums = vec![[0.0; 4]; shape.1];
            for (k, r) in rows.enumerate() {
                let y = k as f64 - middle;
                let [w, e] = [w, e].map(|map| map[r * px..(r + 1) * px].chunks(size));
                for (sums, (w, e)) in sums.iter_mut().zip(w.zip(e)) {
                    for (k, (w, e)) in w.iter().zip(e).enumerate() {
                        let x = k as f64 - middle;
                        for (sum, v) in sums.iter_mut().zip([*w, w * e, w * x, w * y]) {
                            *sum += v;
                        }
                    }
                }
            }
            for (square, [weight, mean, x, y]) in row.iter_mut().zip(sums) {
                if weight > 0.0 {
                    *square = Square {
                        weight,
                        mean: mean / weight,
                        centroid: [x, y].map(|v| v / weight),
                    };
                }
            }
        });
        let desired = Array2::from_shape_fn(shape, |p| in_the_middle(&squares, p, size));
        (desired, squares.mapv(|square| square.weight))
    }
}

#[derive(Clone, Copy, Default)]
struct Square {
    weight: f64,
    mean: f64,
    /// Offset of the weighted centroid of the pixels from the middle of the square, pixels [x, y].
    centroid: [f64; 2],
}

/// Returns the value of a square in its middle: its weighted mean, moved from the centroid of its pixels along the
/// plane through the squares around. It is at least half the mean, so that a desired removal stays positive. The mean
/// itself is returned if the square has no weight, if the centroid is in the middle, or if the squares around determine
/// no plane.
fn in_the_middle(squares: &Array2<Square>, (r, c): (usize, usize), size: usize) -> f64 {
    let own = squares[[r, c]];
    let off = own.centroid.iter().any(|d| d.abs() > 1e-9);
    if own.weight == 0.0 || !off {
        return own.mean;
    }
    // Normal equations of z = own + gx dx + gy dy, distances from the centroid of this square.
    let [mut xx, mut xy, mut yy, mut xz, mut yz] = [0.0; 5];
    for i in r.saturating_sub(1)..(r + 2).min(squares.nrows()) {
        for j in c.saturating_sub(1)..(c + 2).min(squares.ncols()) {
            let other = squares[[i, j]];
            let x = (j as f64 - c as f64) * size as f64 + other.centroid[0] - own.centroid[0];
            let y = (i as f64 - r as f64) * size as f64 + other.centroid[1] - own.centroid[1];
            let w = other.weight;
            let z = other.mean - own.mean;
            xx += w * x * x;
            xy += w * x * y;
            yy += w * y * y;
            xz += w * x * z;
            yz += w * y * z;
        }
    }
    let determinant = xx * yy - xy * xy;
    // Squares in one line say nothing across it.
    if determinant <= 1e-6 * xx * yy {
        return own.mean;
    }
    let gx = (yy * xz - xy * yz) / determinant;
    let gy = (xx * yz - xy * xz) / determinant;
    (own.mean - gx * own.centroid[0] - gy * own.centroid[1]).max(0.5 * own.mean)
}

/// Returns the kernel G of (2) of the module, applied along both axes, nm/s, from the samples of the TIF; for a `size`
/// of 1 these samples.
fn coarse_kernel(samples: &Array2<f64>, size: usize) -> Array2<f64> {
    if size == 1 {
        return samples.clone();
    }
    let rows = coarse_lines(samples.view(), size);
    coarse_lines(rows.t(), size).t().as_standard_layout().into_owned()
}

/// Applies (2) of the module along the first axis: returns G[D], D = -(n - 1) ..= 0, for every column of `samples`.
fn coarse_lines(samples: ArrayView2<f64>, size: usize) -> Array2<f64> {
    let (s, width) = samples.dim();
    let (k, n) = (size as isize, (s + 2 * size - 3) / size + 1);
    let mut g = Array2::zeros((n, width));
    for (b, mut line) in g.outer_iter_mut().enumerate() {
        let d = b as isize - (n as isize - 1);
        for (i, r) in samples.outer_iter().enumerate() {
            // K hat of (2), summed over a.
            let hats = (0..k).map(|a| (k - (k * d + a + s as isize - 1 - i as isize).abs()).max(0));
            let sum: isize = hats.sum();
            if sum > 0 {
                line.scaled_add(sum as f64 / (k * k * k) as f64, &r);
            }
        }
    }
    g
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::s;
    use planish_types::Axis;

    fn case() -> (Tif, Grid) {
        // Neither even nor centred, cut off at its border; 23 x 17 pixels are no whole squares.
        let axis = |start: f64, n: usize| Axis::new(start, 0.1, n).unwrap();
        let t = Grid { x: axis(-0.3, 9), y: axis(-0.2, 6) };
        let rate = Array2::from_shape_fn(t.shape(), |(r, c)| 1.0 + r as f64 + 0.3 * (c * c) as f64);
        (Tif::new(t, rate).unwrap(), Grid { x: axis(1.0, 23), y: axis(2.0, 17) })
    }

    #[test]
    fn coarse_removal_is_the_mean_of_the_removal_of_the_linear_map() {
        let (tif, grid) = case();
        let fine = CoarseMap::<f64>::new(&tif, &grid, 1).unwrap();
        for size in 1..=5 {
            let map = CoarseMap::<f64>::new(&tif, &grid, size).unwrap();
            let t = Array2::from_shape_fn(map.shape(), |(r, c)| {
                1.0 + (0.9 * r as f64).sin() * (1.3 * c as f64).cos()
            });
            let found = map.removal(t.view());
            let tau = map.prolong(t);
            let removal = fine.removal(tau.view());
            for (r, c) in ndarray::indices((17 / size, 23 / size)) {
                let square = s![r * size..(r + 1) * size, c * size..(c + 1) * size];
                let expected = removal.slice(square).mean().unwrap();
                // Rounding of FFTs of sums of order 300.
                assert!((found[[r, c]] / expected - 1.0).abs() < 1e-12, "{size}: {r} {c}");
            }
        }
    }

    #[test]
    fn between_coarse_nodes_the_map_is_linear_and_keeps_the_time() {
        let (tif, grid) = case();
        let map = CoarseMap::<f64>::new(&tif, &grid, 3).unwrap();
        // 9 t at the coarse nodes: tau = t / 9.
        let t = Array2::from_shape_fn(map.shape(), |(r, c)| 27.0 * r as f64 + 9.0 * c as f64);
        let tau = map.prolong(t);
        for ((r, c), tau) in tau.indexed_iter() {
            let expected = r as f64 + c as f64 / 3.0;
            // Rounding of sums of up to 20.
            assert!((tau - expected).abs() < 1e-12, "{r} {c}: {tau} {expected}");
        }
    }

    #[test]
    fn squares_keep_the_weight_and_a_plane_whatever_is_missing() {
        let (tif, grid) = case();
        let plane = |x: f64, y: f64| 40.0 + 0.7 * x - 1.1 * y;
        let e = Array2::from_shape_fn(grid.shape(), |(r, c)| plane(c as f64, r as f64));
        let w = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let outside = (r as f64 - 8.0).hypot(c as f64 - 11.0) > 8.3;
            if outside { 0.0 } else { 1.0 + 0.1 * ((r * 5 + c * 3) % 7) as f64 }
        });
        let map = CoarseMap::<f64>::new(&tif, &grid, 3).unwrap();
        let (means, weight) = map.restrict(&(&e * &w.mapv(|w| f64::from(w > 0.0))), &w);
        // Rounding of a sum of 400 weights, relative.
        assert!((weight.sum() / w.sum() - 1.0).abs() < 1e-14);
        let mut partial = 0;
        for ((r, c), w) in weight.indexed_iter().filter(|(_, w)| **w > 0.0) {
            let middle = |k: usize| 3.0 * k as f64 + 1.0;
            let expected = plane(middle(c), middle(r));
            assert!((means[[r, c]] - expected).abs() < 1e-10, "{r} {c}");
            partial += usize::from(*w < 9.0);
        }
        assert!(partial > 5);
    }

    #[test]
    fn only_large_maps_under_wide_tools_are_solved_on_squares() {
        let axis = |step: f64, n: usize| Axis::new(0.0, step, n).unwrap();
        let bell = |sigma: f64| {
            let t = Axis::new(-5.0, 0.1, 101).unwrap();
            let g = Grid { x: t, y: t };
            let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
                (-(g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2))
                    / (2.0 * sigma * sigma))
                    .exp()
            });
            Tif::new(g, rate).unwrap()
        };
        let map = |step: f64, n: usize| {
            let grid = Grid { x: axis(step, n), y: axis(step, n) };
            Surface::new(grid, Array2::zeros(grid.shape())).unwrap()
        };
        assert_eq!(automatic_size(&bell(1.6), &map(0.1, 900)), 1);
        // It rises on sigma e^(1/2) = 26.4 pixels.
        assert_eq!(automatic_size(&bell(1.6), &map(0.1, 1001)), 3);
        assert_eq!(automatic_size(&bell(1.6), &map(0.05, 1001)), 7);
        assert_eq!(automatic_size(&bell(0.5), &map(0.1, 1001)), 1);
        // 0.14 of the peak at the border: it falls by that within a pixel, and rises on 7.
        assert_eq!(automatic_size(&bell(2.5), &map(0.1, 1001)), 1);
    }
}
