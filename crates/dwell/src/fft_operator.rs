//! The removal model without a matrix: `B t` by spreading the dwell times on the pixels of the map
//! and one FFT convolution, for problems of any size.
//!
//! ```text
//! B = C S,   S: dwell times -> seconds on the lattice (Keys' weights),   C: convolution with R
//! ```
//!
//! R is taken at the pixels of the map. What Keys' interpolation lets leak over the border of the
//! TIF is not removed, an error of the border rate over about one pixel (the simulator removes
//! it): enough to plan by, not to judge by.

use ndarray::Array2;
use planish_numerics::{fft::Convolution, keys};
use planish_types::{Axis, Grid, Tif};
use rayon::prelude::*;

use crate::columns::Place;

/// B of [`crate::columns`] as an operator.
pub struct FftOperator {
    /// Per dwell point: lattice index and weight of what it spreads.
    spread: Vec<Vec<(usize, f64)>>,
    /// R at the pixels of the map.
    kernel: Array2<f64>,
    convolution: Convolution,
    /// Lattice (y, x): the map and the pixels from which the tool reaches it.
    shape: (usize, usize),
}

impl FftOperator {
    /// Plans for the columns of one path, TIF and map.
    pub fn new(places: &[Vec<Place>], tif: &Tif, grid: &Grid) -> Self {
        let x = Lattice::new(&grid.x, &tif.grid().x);
        let y = Lattice::new(&grid.y, &tif.grid().y);
        let kernel = Array2::from_shape_fn((y.samples, x.samples), |(j, i)| {
            tif.rate_at(x.offset_mm(i), y.offset_mm(j))
        });
        let shape = (y.length(), x.length());
        let spread = places
            .par_iter()
            .map(|places| {
                let mut entries = Vec::new();
                for Place { position_mm: p, part } in places {
                    for (r, wy) in y.spread(p[1]) {
                        let row = x.spread(p[0]);
                        entries.extend(row.map(|(c, wx)| (r * shape.1 + c, part * wx * wy)));
                    }
                }
                entries
            })
            .collect();
        let convolution = Convolution::new(kernel.view(), shape);
        Self { spread, kernel, convolution, shape }
    }

    /// `B t`: (ny, nx), nm.
    pub fn apply(&self, t: &[f64]) -> Array2<f64> {
        let mut seconds = vec![0.0; self.shape.0 * self.shape.1];
        for (entries, t) in self.spread.iter().zip(t) {
            for (i, w) in entries {
                seconds[*i] += w * t;
            }
        }
        let seconds = Array2::from_shape_vec(self.shape, seconds).expect("the lattice's size");
        self.convolution.valid(seconds.view())
    }

    /// `B' m` for a map (ny, nx).
    pub fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        self.gather(&self.convolution.adjoint(map.view()))
    }

    /// `B' m` with R^2 in place of R.
    pub fn adjoint_of_squared_tif(&self, map: &Array2<f64>) -> Vec<f64> {
        let squared = self.kernel.mapv(|r| r * r);
        self.gather(&Convolution::new(squared.view(), self.shape).adjoint(map.view()))
    }

    /// `S' f`.
    fn gather(&self, field: &Array2<f64>) -> Vec<f64> {
        let field = field.as_slice().expect("in C order");
        let of = |entries: &Vec<(usize, f64)>| entries.iter().map(|(i, w)| w * field[*i]).sum();
        self.spread.par_iter().map(of).collect()
    }
}

/// One axis: pixel i of the map, sample j of R, tools from pixel -(samples-1) on.
struct Lattice {
    start_mm: f64,
    step_mm: f64,
    pixels: usize,
    tif_start_mm: f64,
    samples: usize,
}

impl Lattice {
    fn new(map: &Axis, tif: &Axis) -> Self {
        let extent = (tif.end_mm() - tif.start_mm()) / map.step_mm();
        Self {
            start_mm: map.start_mm(),
            step_mm: map.step_mm(),
            pixels: map.len(),
            tif_start_mm: tif.start_mm(),
            // The tolerance of a shared pitch that is rounded differently in the two files.
            samples: (extent + 1e-4).floor() as usize + 1,
        }
    }

    fn offset_mm(&self, j: usize) -> f64 {
        self.tif_start_mm + j as f64 * self.step_mm
    }

    fn length(&self) -> usize {
        self.pixels + self.samples - 1
    }

    /// Lattice nodes and Keys' weights of a tool at `p`.
    fn spread(&self, p: f64) -> impl Iterator<Item = (usize, f64)> {
        let (cell, f) = keys::split((p + self.tif_start_mm - self.start_mm) / self.step_mm);
        let (shift, length) = (self.samples as isize - 1, self.length());
        keys::weights(f).into_iter().enumerate().filter_map(move |(d, w)| {
            let node = usize::try_from(cell + d as isize - 1 + shift).ok()?;
            (node < length && w != 0.0).then_some((node, w))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::columns::{self, Columns};
    use ndarray::s;
    use planish_types::ToolPath;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn case(border: f64) -> (ToolPath, Tif, Grid) {
        let axis = |n: usize| Axis::new(-0.1 * (n / 2) as f64, 0.1, n).unwrap();
        let g = Grid { x: axis(31), y: axis(25) };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.at(c) / 1.5, g.y.at(r) / 1.2);
            border + (1.0 + x + 0.5 * y) * ((1.0 - x * x) * (1.0 - y * y)).max(0.0).powi(6)
        });
        let map =
            Grid { x: Axis::new(0.03, 0.1, 60).unwrap(), y: Axis::new(-0.4, 0.1, 45).unwrap() };
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let points: Vec<[f64; 2]> =
            (0..40).map(|_| [rng.random_range(-2.0..8.0), rng.random_range(-2.0..6.0)]).collect();
        let n = points.len() - 1;
        (
            ToolPath::through(points, vec![true; n], vec![0; n]).unwrap(),
            Tif::new(g, rate).unwrap(),
            map,
        )
    }

    #[test]
    fn agrees_with_the_columns_where_the_tif_ends_smoothly() {
        let (path, tif, map) = case(0.0);
        let t: Vec<f64> = (0..path.len()).map(|j| 1.0 + (j as f64).sin()).collect();
        for kind in [Columns::Point, Columns::Segment] {
            let mut expected = Array2::zeros(map.shape());
            for (p, t) in columns::patches(&kind.places(&path), &tif, &map).iter().zip(&t) {
                let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
                expected.slice_mut(s![r..r + ny, c..c + nx]).scaled_add(*t, &p.rate_nm_per_s);
            }
            let found = FftOperator::new(&kind.places(&path), &tif, &map).apply(&t);
            let largest = expected.iter().copied().fold(0.0, f64::max);
            let error = (&found - &expected).iter().fold(0.0_f64, |m, e| m.max(e.abs()));
            // The TIF vanishes like (distance to the border)^6: two pixels inside it is
            // (4 * 0.1 / 1.5)^6 = 4e-4 of its peak, and what leaks is a tenth of that.
            assert!(error < 1e-4 * largest, "{error} of {largest}");
        }
    }

    #[test]
    fn the_adjoint_is_the_adjoint() {
        let (path, tif, map) = case(0.3);
        let operator = FftOperator::new(&Columns::Segment.places(&path), &tif, &map);
        let t: Vec<f64> = (0..path.len()).map(|j| (0.7 * j as f64).cos()).collect();
        let m = Array2::from_shape_fn(map.shape(), |(r, c)| ((r * 3 + c) as f64).sin());
        let left = (&operator.apply(&t) * &m).sum();
        let right: f64 = operator.adjoint(&m).iter().zip(&t).map(|(b, t)| b * t).sum();
        let size = operator.apply(&t).mapv(|v| v * v).sum().sqrt() * m.mapv(|v| v * v).sum().sqrt();
        assert!((left - right).abs() <= 1e-12 * size, "{left} {right}");
    }
}
