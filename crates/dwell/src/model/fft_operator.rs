//! The removal model without a matrix: `B t` by spreading the dwell times on the pixels of the map
//! and one FFT convolution, for problems of any size.
//!
//! ```text
//! B = E - E ly - E lx + E ly lx,   E = C S                                                (1)
//! S: dwell times -> seconds on the lattice (Keys' weights),   C: convolution with the samples of R
//! ```
//!
//! Keys' interpolation continues the samples of the TIF R, with ghost nodes beyond its border, a few pixels further,
//! while R is zero beyond its last samples. E includes that removal, which is called *spill* here. `ly` and `lx` are
//! the indicators of the pixel rows and columns that only spill reaches, at most three on each side of the TIF. In
//! pixel row k, counted from the cell C of a tool at the offset f there, the spill comes from few rows of samples,
//!
//! ```text
//! (E ly)[C + k, :] = sum_d w_d(f) g[k - d, :] * (seconds along the row)                   (2)
//! ```
//!
//! with Keys' weights w_d, d = -1 .. 2, and the rows g of the samples. So (1) takes convolutions along rows and
//! columns, one transform for each cell and d, and a few pixels for each corner. Nothing is approximated for a TIF on
//! the lattice of the map ([`planish_types::TifLattice`]): only sums are reordered. Where a pixel has several samples
//! of the TIF, (1) is for all nodes of that lattice, of which the pixels are some. A surrogate samples a TIF at the
//! pitch of its map.

mod lattice;
mod spill;
mod sums;

use std::borrow::Cow;

use ndarray::{Array2, Axis as NdAxis, s};
use planish_numerics::{fft::convolution::Convolution, parallel};
use planish_types::{Axis, Grid, Tif};

use crate::model::{columns::ToolPlace, varying};
pub use lattice::Spread;
use lattice::{Lattice, Placed, kernel, placed, samples, without_ghosts};
use spill::{Across, Corners, LINES_PER_TASK};
pub use sums::Sums;

/// The removal matrix B of [`crate::model::columns`] as an operator: (1) of the module for every kernel of the tool.
pub struct FftOperator {
    kernels: Vec<KernelOperator>,
    /// Factor of the removal at every pixel, if the tool has one.
    factor: Option<Array2<f64>>,
    /// For a tool that varies: the operator of the mean TIF, with places whose fractions are multiplied as
    /// [`varying::by_energy`] says; `None` for other tools.
    by_energy: Option<Box<KernelOperator>>,
    /// Shape of the map (ny, nx).
    shape: (usize, usize),
    /// Number of nodes of the lattice for each pixel along [x, y].
    parts: [usize; 2],
}

/// Operator (1) of the module for one kernel of the tool and its places, on the nodes of the lattice.
struct KernelOperator {
    columns: usize,
    /// Samples g[j] of the TIF with ghost nodes, j = -1 ..= last on both axes.
    samples: Array2<f64>,
    corners: Corners,
    convolution: Convolution,
    rows: Across,
    /// The same as `rows` with the axes swapped.
    columns_across: Across,
    spread: Spread,
    spills: bool,
}

/// Size of the samples at the border of the TIF, as a fraction of the peak, up to which the spill is not subtracted. It
/// is subtracted if any sample there is larger. Larger: the removal errs by that fraction at the rim of the tool.
/// Smaller: rounding in the margin of a TIF costs the time of the subtraction.
const NEGLIGIBLE_SPILL: f64 = 1e-14;

impl FftOperator {
    /// Makes the operator for the places of the tool in each column, on the pixels of `grid`.
    pub fn new(places: &[Vec<ToolPlace>], tif: &Tif, grid: &Grid) -> Self {
        Self::spreading(places, tif, grid, Spread::Keys, true)
    }

    /// Makes the part E = C S of (1) of the module alone, for a surrogate: the spill is not subtracted, the ghost nodes
    /// are zero, and the nodes are the points of `grid`. `spread` chooses the weights.
    pub fn without_border(
        places: &[Vec<ToolPlace>],
        tif: &Tif,
        grid: &Grid,
        spread: Spread,
    ) -> Self {
        Self::spreading(places, tif, grid, spread, false)
    }

    fn spreading(
        places: &[Vec<ToolPlace>],
        tif: &Tif,
        grid: &Grid,
        spread: Spread,
        border: bool,
    ) -> Self {
        let parts = if border { parts(tif, grid) } else { [1, 1] };
        let nodes = nodes(grid, parts);
        let kernels = varying::kernels(places, tif);
        let kernels = kernels
            .map(|(kernel, places)| KernelOperator::new(&places, kernel, &nodes, spread, border))
            .collect();
        let by_energy = tif.variation().map(|_| {
            let places = varying::by_energy(places, tif);
            Box::new(KernelOperator::new(&places, &tif.mean_tool(), &nodes, spread, false))
        });
        let factor = tif.variation().and_then(|v| v.factor_on(grid)).map(Cow::into_owned);
        Self { kernels, factor, by_energy, shape: grid.shape(), parts }
    }

    /// Returns true if (1) of the module is exact but for rounding: a pixel has a whole number of samples of the TIF
    /// along either axis.
    pub fn is_exact(tif: &Tif, grid: &Grid) -> bool {
        let nodes = nodes(grid, parts(tif, grid));
        [0, 1].iter().all(|axis| Lattice::new(&nodes, tif, *axis, Spread::Keys).own)
    }

    /// Returns true if (1) of the module is exact but for rounding, and the TIF has the pitch of the map: every node of
    /// the lattice is a pixel.
    pub fn has_pitch_of(tif: &Tif, grid: &Grid) -> bool {
        parts(tif, grid) == [1, 1] && Self::is_exact(tif, grid)
    }

    /// Returns the removal `B t` (ny, nx), nm, for dwell times t (n), s.
    pub fn apply(&self, t: &[f64]) -> Array2<f64> {
        let sum = self.kernels.iter().map(|kernel| kernel.apply(t)).reduce(|a, b| a + b);
        let mut map = self.on_pixels(sum.expect("a tool has a kernel"));
        if let Some(factor) = &self.factor {
            map *= factor;
        }
        map
    }

    /// Returns the adjoint product `B' m` (n) for a map m (ny, nx).
    pub fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        self.sum_of_adjoints(map, KernelOperator::adjoint)
    }

    /// Returns the adjoint product `E' m` (n) for a map m (ny, nx), with E of (1) of the module, so the spill is not
    /// subtracted.
    pub fn adjoint_with_spill(&self, map: &Array2<f64>) -> Vec<f64> {
        self.sum_of_adjoints(map, KernelOperator::adjoint_with_spill)
    }

    fn sum_of_adjoints(
        &self,
        map: &Array2<f64>,
        adjoint: impl Fn(&KernelOperator, &Array2<f64>) -> Vec<f64>,
    ) -> Vec<f64> {
        let map = match &self.factor {
            Some(factor) => Cow::Owned(map * factor),
            None => Cow::Borrowed(map),
        };
        let map = self.on_nodes(map);
        let mut kernels = self.kernels.iter().map(|kernel| adjoint(kernel, &map));
        let mut sums = kernels.next().expect("a tool has a kernel");
        for of_kernel in kernels {
            sums.iter_mut().zip(of_kernel).for_each(|(sum, v)| *sum += v);
        }
        sums
    }

    /// Returns the adjoint product `B' m` (n) for a map m (ny, nx) with the squared TIF, and the squared factor of the
    /// pixels, in place of these; the spill is not subtracted. For a tool that varies, it is the squared mean TIF,
    /// scaled at every place to the energy of the TIF there.
    pub fn adjoint_of_squared_tif(&self, map: &Array2<f64>) -> Vec<f64> {
        let map = match &self.factor {
            Some(factor) => Cow::Owned(map * factor * factor),
            None => Cow::Borrowed(map),
        };
        let map = self.on_nodes(map);
        self.by_energy.as_deref().unwrap_or(&self.kernels[0]).adjoint_of_squared_tif(&map)
    }

    /// Returns the values on those nodes of the lattice that are pixels (ny, nx).
    fn on_pixels(&self, nodes: Array2<f64>) -> Array2<f64> {
        match self.parts {
            [1, 1] => nodes,
            [nx, ny] => nodes.slice(s![..;ny, ..;nx]).to_owned(),
        }
    }

    /// Returns a map (ny, nx) on all nodes of the lattice, zero between the pixels: the adjoint of
    /// [`Self::on_pixels`].
    fn on_nodes<'a>(&self, map: Cow<'a, Array2<f64>>) -> Cow<'a, Array2<f64>> {
        let [nx, ny] = self.parts;
        if self.parts == [1, 1] {
            return map;
        }
        let (rows, columns) = self.shape;
        let mut nodes = Array2::zeros(((rows - 1) * ny + 1, (columns - 1) * nx + 1));
        nodes.slice_mut(s![..;ny, ..;nx]).assign(&map);
        Cow::Owned(nodes)
    }
}

/// Returns the pitch of the map over that of the TIF along [x, y], rounded to whole numbers, at least 1: the number of
/// samples of the TIF for each pixel.
fn parts(tif: &Tif, grid: &Grid) -> [usize; 2] {
    [(&grid.x, &tif.grid().x), (&grid.y, &tif.grid().y)]
        .map(|(map, samples)| (map.step_mm() / samples.step_mm()).round().max(1.0) as usize)
}

/// Returns the lattice that has `parts` nodes for each pixel of a map along [x, y].
fn nodes(grid: &Grid, parts: [usize; 2]) -> Grid {
    let [x, y] = [(&grid.x, parts[0]), (&grid.y, parts[1])].map(|(axis, parts)| {
        let step_mm = axis.step_mm() / parts as f64;
        let finer = Axis::new(axis.start_mm(), step_mm, (axis.len() - 1) * parts + 1);
        finer.expect("a finer axis within the same ends")
    });
    Grid { x, y }
}

impl KernelOperator {
    fn new(
        places: &[Vec<ToolPlace>],
        tif: &Tif,
        grid: &Grid,
        spread: Spread,
        border: bool,
    ) -> Self {
        let [x, y] = [0, 1].map(|axis| Lattice::new(grid, tif, axis, spread));
        let mut samples = samples(tif, &x, &y);
        if !border {
            samples = without_ghosts(samples);
        }
        let shape = (y.sources(), x.sources());
        let across = || {
            let placed = placed(places, &x, &y);
            let swapped = placed.iter().map(Placed::swapped).collect();
            rayon::join(
                || Across::new(y, x, samples.view(), placed),
                || Across::new(x, y, samples.t(), swapped),
            )
        };
        let (convolution, (rows, columns_across)) =
            rayon::join(|| Convolution::new(kernel(&samples, spread).view(), shape), across);
        let corners = rows.corners(&samples);
        let peak = samples.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        let (my, mx) = samples.dim();
        let spills = border
            && samples.indexed_iter().any(|((r, c), v)| {
                (is_border(r, my) || is_border(c, mx)) && v.abs() > NEGLIGIBLE_SPILL * peak
            });
        let columns = places.len();
        Self { columns, samples, corners, convolution, rows, columns_across, spread, spills }
    }

    /// Returns the removal `B t` of this kernel on the nodes, nm, for dwell times t (n), s.
    fn apply(&self, t: &[f64]) -> Array2<f64> {
        let mut map = self.convolution.valid(self.rows.seconds(t).view());
        if self.spills {
            let spill = self.rows.spill(t, Some(&self.corners));
            map -= &spill;
            drop(spill);
            let spill = self.columns_across.spill(t, None);
            parallel::consume(
                map.axis_chunks_iter_mut(NdAxis(0), LINES_PER_TASK)
                    .zip(spill.axis_chunks_iter(NdAxis(1), LINES_PER_TASK)),
                &|_, (mut map, spill)| map -= &spill.t(),
            );
        }
        map
    }

    /// Returns the adjoint product `B' m` (n) of this kernel for a map m on the nodes.
    fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        let mut sums = self.adjoint_with_spill(map);
        if self.spills {
            self.rows.subtract_spill(map.view(), Some(&self.corners), &mut sums);
            let mut transposed = Array2::zeros(map.t().dim());
            parallel::consume(
                transposed
                    .axis_chunks_iter_mut(NdAxis(0), LINES_PER_TASK)
                    .zip(map.axis_chunks_iter(NdAxis(1), LINES_PER_TASK)),
                &|_, (mut to, from)| to.assign(&from.t()),
            );
            self.columns_across.subtract_spill(transposed.view(), None, &mut sums);
        }
        sums
    }

    /// Returns the adjoint product `E' m` (n) for a map m on the nodes, with E of (1) of the module, so the spill is
    /// not subtracted.
    fn adjoint_with_spill(&self, map: &Array2<f64>) -> Vec<f64> {
        self.rows.gather(&self.convolution.adjoint(map.view()), self.columns)
    }

    /// Returns the adjoint product `B' m` (n) for a map m on the nodes, with the squared kernel in place of the kernel;
    /// the spill is not subtracted.
    fn adjoint_of_squared_tif(&self, map: &Array2<f64>) -> Vec<f64> {
        let squared = kernel(&self.samples.mapv(|r| r * r), self.spread);
        let shape = (self.rows.across.sources(), self.rows.along.sources());
        let field = Convolution::<f64>::new(squared.view(), shape).adjoint(map.view());
        self.rows.gather(&field, self.columns)
    }
}

/// Returns true if node k of the n nodes of the TIF along an axis, ghost nodes included, is one of the first three or
/// of the last four. Only these can spill.
fn is_border(k: usize, n: usize) -> bool {
    k <= 2 || k + 4 >= n
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::columns::{self, Columns};
    use planish_testkit::maps::largest_magnitude;
    use planish_types::{PixelFactor, ToolPath, VaryingTif};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn case(border: f64) -> (ToolPath, Tif, Grid) {
        let axis = |n: usize| Axis::new(-0.1 * (n / 2) as f64, 0.1, n).unwrap();
        let g = Grid { x: axis(31), y: axis(25) };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c) / 1.5, g.y.coordinate_mm(r) / 1.2);
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

    /// Returns the removal B t by the columns of B.
    fn by_columns(places: &[Vec<ToolPlace>], tif: &Tif, map: &Grid, t: &[f64]) -> Array2<f64> {
        let mut removal = Array2::zeros(map.shape());
        for (p, t) in columns::patches(places, tif, map).iter().zip(t) {
            let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
            removal.slice_mut(s![r..r + ny, c..c + nx]).scaled_add(*t, &p.rate_nm_per_s);
        }
        removal
    }

    fn largest(map: &Array2<f64>) -> f64 {
        largest_magnitude(map.iter().copied())
    }

    /// Returns columns of one place each: on nodes, between them, and around the map.
    fn places(map: &Grid) -> Vec<Vec<ToolPlace>> {
        let at = |axis: &Axis, k: usize| axis.start_mm() + k as f64 * 0.45 * axis.step_mm();
        (0..2600)
            .map(|j| {
                let (kx, ky) = ((7 * j) % 173, (11 * j) % 139);
                let p = [at(&map.x, kx) - 1.8, at(&map.y, ky) - 1.5];
                vec![ToolPlace::new(p, 1.0)]
            })
            .collect()
    }

    #[test]
    fn agrees_with_the_columns_whatever_the_border() {
        for border in [0.0, 0.3] {
            let (path, tif, map) = case(border);
            assert!(FftOperator::is_exact(&tif, &map));
            let cases = [
                Columns::Point.places(&path, &tif),
                Columns::Segment.places(&path, &tif),
                places(&map),
            ];
            for places in &cases {
                let t: Vec<f64> = (0..places.len()).map(|j| 1.0 + (j as f64).sin()).collect();
                let operator = FftOperator::new(places, &tif, &map);
                let expected = by_columns(places, &tif, &map, &t);
                let error = largest(&(operator.apply(&t) - &expected)) / largest(&expected);
                // Sums of at most 2600 terms; a spill left in would be 1e-2.
                assert!(error < 1e-12, "border {border}, {} columns: {error}", places.len());
            }
        }
    }

    #[test]
    fn agrees_with_the_columns_where_the_tif_is_little_more_than_its_border() {
        let (_, _, map) = case(0.3);
        let places = places(&map);
        let t: Vec<f64> = (0..places.len()).map(|j| 1.0 + (j as f64).sin()).collect();
        let m = Array2::from_shape_fn(map.shape(), |(r, c)| ((r * 3 + c) as f64).sin());
        for (nx, ny) in [(2, 5), (3, 2), (4, 3), (5, 6), (7, 4)] {
            let axis = |n: usize| Axis::new(-0.05 * (n - 1) as f64, 0.1, n).unwrap();
            let g = Grid { x: axis(nx), y: axis(ny) };
            let rate = |(r, c): (usize, usize)| 1.0 + ((5 * r + 3 * c) as f64).sin();
            let tif = Tif::new(g, Array2::from_shape_fn(g.shape(), rate)).unwrap();
            let operator = FftOperator::new(&places, &tif, &map);
            let expected = by_columns(&places, &tif, &map, &t);
            let error = largest(&(operator.apply(&t) - &expected)) / largest(&expected);
            assert!(error < 1e-12, "{nx} x {ny}: {error}");
            let adjoint: f64 = operator.adjoint(&m).iter().zip(&t).map(|(b, t)| b * t).sum();
            let of_products = expected.iter().zip(&m).map(|(b, m)| (b * m).abs()).sum::<f64>();
            assert!((adjoint - (&expected * &m).sum()).abs() < 1e-12 * of_products, "{nx} x {ny}");
        }
    }

    #[test]
    fn a_tif_of_another_pitch_has_its_border_too() {
        let (path, tif, _) = case(0.3);
        let coarse =
            Grid { x: Axis::new(0.03, 0.13, 46).unwrap(), y: Axis::new(-0.4, 0.11, 41).unwrap() };
        let places = Columns::Segment.places(&path, &tif);
        let t = vec![1.0; places.len()];
        let expected = by_columns(&places, &tif, &coarse, &t);
        let operator = FftOperator::new(&places, &tif, &coarse);
        let error = largest(&(operator.apply(&t) - &expected)) / largest(&expected);
        let spilling = FftOperator::without_border(&places, &tif, &coarse, Spread::Keys);
        let spill = largest(&(spilling.apply(&t) - &expected)) / largest(&expected);
        // Keys' interpolation of samples at 0.13 mm of a bell of 0.7 mm; the border is 0.3 of 1.3.
        assert!(error < 5e-3 && spill > 10.0 * error, "{error} {spill}");
    }

    #[test]
    fn without_a_border_it_follows_a_smooth_tif_by_the_fourth_power_of_the_pitch() {
        // exp(-(x^2 + 1.3 y^2) / 2), 1e-14 at its edge, of a tool at 40 places between the nodes, over every pixel
        let bell = |x: f64, y: f64| (-(x * x + 1.3 * y * y) / 2.0).exp();
        let error = |h: f64, operator: fn(&[Vec<ToolPlace>], &Tif, &Grid) -> FftOperator| {
            let axis = |half: f64| {
                let n = (half / h).round();
                Axis::new(-n * h, h, 2 * n as usize + 1).unwrap()
            };
            let own = Grid { x: axis(8.0), y: axis(8.0) };
            let rate = Array2::from_shape_fn(own.shape(), |(r, c)| {
                bell(own.x.coordinate_mm(c), own.y.coordinate_mm(r))
            });
            let (tif, map) = (Tif::new(own, rate).unwrap(), Grid { x: axis(3.0), y: axis(2.0) });
            let of = |k: usize| {
                let at = [0.7 * (k as f64).sin(), 0.4 * (1.7 * k as f64).cos()];
                let places = vec![vec![ToolPlace::new(at, 1.0)]];
                let found = operator(&places, &tif, &map).apply(&[1.0]);
                let exact =
                    |(r, c)| bell(map.x.coordinate_mm(c) - at[0], map.y.coordinate_mm(r) - at[1]);
                largest(&(found - Array2::from_shape_fn(map.shape(), exact)))
            };
            (0..40).map(of).fold(0.0, f64::max)
        };
        let [coarse, fine] = [0.4, 0.2]
            .map(|h| error(h, |p, t, g| FftOperator::without_border(p, t, g, Spread::Splines)));
        // 2^4 and the next order; Keys' weights are of the third.
        assert!((13.0..26.0).contains(&(coarse / fine)), "{coarse} {fine}");
        let by_keys = error(0.4, FftOperator::new);
        assert!(coarse < 0.25 * by_keys, "{coarse} {by_keys}");
    }

    #[test]
    fn sums_of_few_columns_are_those_of_the_operator() {
        let (path, tif, map) = case(0.3);
        let places = [Columns::Segment.places(&path, &tif), places(&map)].concat();
        let whole = 0..places.len();
        for (spread, columns) in [
            (Spread::Keys, 0..3),
            (Spread::Splines, 17..18),
            (Spread::Keys, 40..200),
            (Spread::Keys, whole.clone()),
            (Spread::Splines, whole),
        ] {
            let operator = FftOperator::without_border(&places, &tif, &map, spread);
            let sums = Sums::new(&places, &tif, &map, 20.0, spread);
            let t: Vec<(usize, f64)> = columns.map(|j| (j, 1.0 + (j as f64).cos())).collect();
            let mut all = vec![0.0; places.len()];
            t.iter().for_each(|(j, t)| all[*j] = *t);
            let expected = operator.apply(&all);
            let patch = sums.patch(&t);
            let (rows, columns) = sums.extent(t.iter().map(|t| t.0));
            assert_eq!(patch.origin, (rows.start, columns.start));
            let mut found = Array2::zeros(map.shape());
            found.slice_mut(s![rows, columns]).assign(&patch.rate_nm_per_s);
            // The two round differently.
            let error = largest(&(&found - &expected)) / largest(&expected).max(1e-300);
            assert!(error < 1e-12, "{} columns: {error}", t.len());
        }
    }

    /// Returns a tool of three kernels, with weights that change over the part and a factor of every pixel.
    fn varying(constant: &Tif, map: &Grid) -> Tif {
        let offsets = *constant.grid();
        let kernel = |by: fn([f64; 2]) -> f64| {
            let of = |(r, c): (usize, usize)| {
                by([offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r)])
            };
            constant.rate_nm_per_s() * &Array2::from_shape_fn(offsets.shape(), of)
        };
        let positions =
            Grid { x: Axis::new(-3.0, 6.0, 3).unwrap(), y: Axis::new(-3.0, 5.0, 3).unwrap() };
        let weight = |by: fn(f64, f64) -> f64| {
            Array2::from_shape_fn(positions.shape(), |(r, c)| by(r as f64, c as f64))
        };
        let rows = 0..map.shape().0 * map.shape().1;
        let factor = rows.map(|i| 1.0 + 0.2 * (i as f64).sin()).collect();
        let tool = VaryingTif {
            offsets,
            kernels: vec![kernel(|_| 1.0), kernel(|[x, _]| x), kernel(|[x, y]| x * y)],
            positions,
            weights: vec![
                weight(|r, c| 1.0 + 0.1 * r - 0.05 * c),
                weight(|r, c| 0.1 * r * c - 0.2),
                weight(|r, _| 0.1 * r),
            ],
            azimuth: None,
            heading: None,
            pixels: Some(PixelFactor {
                grid: *map,
                factor: Array2::from_shape_vec(map.shape(), factor).unwrap(),
            }),
            time: None,
        };
        Tif::varying(tool).unwrap()
    }

    #[test]
    fn the_adjoint_is_the_adjoint() {
        let (path, constant, map) = case(0.3);
        for tif in [varying(&constant, &map), constant] {
            let places = [Columns::Segment.places(&path, &tif), places(&map)].concat();
            let operator = FftOperator::new(&places, &tif, &map);
            let t: Vec<f64> = (0..places.len()).map(|j| (0.7 * j as f64).cos()).collect();
            let m = Array2::from_shape_fn(map.shape(), |(r, c)| ((r * 3 + c) as f64).sin());
            let removal = operator.apply(&t);
            // Sums of at most 2600 terms, of the kernels together.
            let error = largest(&(&removal - &by_columns(&places, &tif, &map, &t)));
            assert!(error < 1e-12 * largest(&removal), "{error}");
            let left = (&removal * &m).sum();
            let right: f64 = operator.adjoint(&m).iter().zip(&t).map(|(b, t)| b * t).sum();
            let size = removal.mapv(|v| v * v).sum().sqrt() * m.mapv(|v| v * v).sum().sqrt();
            assert!((left - right).abs() <= 1e-12 * size, "{left} {right}");
        }
    }
}
