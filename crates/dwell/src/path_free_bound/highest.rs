//! The largest mean product of a residual with the tool, over all places of the tool: between the nodes of every
//! lattice, too.
//!
//! ```text
//! q(p) = sum_i e_i R(x_i - p)                                                                     (1)
//! ```
//!
//! Count offsets from the first sample of R in its steps g: `(x_i - p - start) / g = j + f`, with a whole number j for
//! every pixel and one fraction f, 0 <= f < 1, for all of them. Between its samples R is Keys' interpolant, so that
//! with his weights w_a and the samples r (ghost nodes included), along each axis,
//!
//! ```text
//! R = sum_a w_a(f) r[j + a],   a = 0 .. 3                                                         (2)
//! ```
//!
//! While f stays in an interval in which the same j are within the edges of R, q is a cubic in f along each axis. The
//! coefficients of that cubic in the Bernstein basis of the interval are (1) with the blossoms of w_a in place of w_a:
//! 16 correlations of e with kernels give those of all cells of the plane. A cubic is nowhere above the largest of its
//! coefficients (convex hull), and reaches those at the corners. So a cell with a coefficient above the largest corner
//! of all cells is divided into four, again and again (de Casteljau), until none of its parts has one. f = 0, where one
//! more sample is within the edges, is an interval of its own. Nothing is approximated: R may jump to zero at its edge.
//!
//! Source: blossoms and convex hulls, L. Ramshaw, Comput. Aided Geom. Des. 6 (1989) 323.

use ndarray::{Array2, s};
use planish_numerics::{fft::convolution::Convolution, parallel, polynomial::halves};
use planish_types::{Axis, Grid, Tif};

use crate::model::columns::longest_part_mm;

/// Upper bound of q of (1) of the module over all places.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Highest {
    /// Upper bound, nm^2/s times pixels; at least 0, the value of a tool beside the part.
    pub value: f64,
    /// Place [x, y] near which q is that large, mm; `None` if q is above 0 nowhere.
    pub place_mm: Option<[f64; 2]>,
}

/// Coefficients of Keys' weights in powers of f, the lowest first.
const KEYS: [[f64; 4]; 4] =
    [[0.0, -0.5, 1.0, -0.5], [1.0, 0.0, -2.5, 1.5], [0.0, 0.5, 2.0, -1.5], [0.0, 0.0, -0.5, 0.5]];

/// Excess of the upper bound over a value that q reaches, relative to it, that is small enough. Larger: a larger bound.
/// Smaller: more divisions.
const SMALL_EXCESS: f64 = 1e-5;

/// Rounding of a correlation by FFT, relative to the product of the Euclidean norms of map and kernel. It is at most 20
/// log2(N) unit roundoffs for N = 1e6 elements.
const ROUNDING: f64 = 1e-13;

/// Interval of f along an axis.
struct Interval {
    /// Number of samples j from 0 on that are within the edges.
    cells: usize,
    ends: [f64; 2],
}

/// q on a rectangle of f, by its coefficients (along y, along x) in the Bernstein basis.
#[derive(Clone, Copy)]
struct Bicubic {
    coefficients: [[f64; 4]; 4],
    /// Ends of f along [x, y].
    ends: [[f64; 2]; 2],
}

/// Returns the upper bound of q of (1) of the module for a residual e (ny, nx) that is 0 on the invalid pixels of a map
/// on `grid`. The TIF has a whole number of samples for each pixel.
pub fn highest(residual: &Array2<f64>, tif: &Tif, grid: &Grid) -> Highest {
    let axes = [(0, &grid.x, &tif.grid().x), (1, &grid.y, &tif.grid().y)];
    let parts = axes.map(|(_, map, samples)| (map.step_mm() / samples.step_mm()).round() as usize);
    let [columns, rows] = axes.map(|(axis, _, samples)| {
        let beyond = (tif.edge_mm()[axis] - samples.end_mm()) / samples.step_mm();
        intervals(samples.len(), beyond)
    });
    let fine = upsampled(residual, parts);
    let norm = fine.iter().map(|e| e * e).sum::<f64>().sqrt();
    let size = tif.with_ghosts().iter().map(|r| r * r).sum::<f64>().sqrt();
    // No blossom on [0, 1] has weights of more than 4/3 in all: the norm of a kernel is at most (4/3)^2 of that.
    let rounding = ROUNDING * 16.0 / 9.0 * size * norm;
    let mut highest = Highest { value: 0.0, place_mm: None };
    for y in &rows {
        for x in &columns {
            let maps = coefficients(&fine, tif.with_ghosts(), y, x);
            let mut raise = |cell: &Bicubic, (r, c): (usize, usize)| {
                let (value, [f, g]) = cell.highest_corner();
                if value > highest.value {
                    let along_x = place_mm(&grid.x, &tif.grid().x, x.cells, c, f);
                    let along_y = place_mm(&grid.y, &tif.grid().y, y.cells, r, g);
                    highest = Highest { value, place_mm: Some([along_x, along_y]) };
                }
                highest.value + (SMALL_EXCESS * highest.value).max(rounding)
            };
            let cell = |index| Bicubic::new(&maps, index, [x.ends, y.ends]);
            for (index, _) in maps[0].indexed_iter() {
                raise(&cell(index), index);
            }
            for (index, _) in maps[0].indexed_iter() {
                let mut above = vec![cell(index)];
                while let Some(cell) = above.pop() {
                    if cell.largest() > raise(&cell, index) {
                        above.extend(cell.quarters());
                    }
                }
            }
        }
    }
    let Highest { value, place_mm } = highest;
    Highest { value: value + (SMALL_EXCESS * value).max(rounding) + rounding, place_mm }
}

/// Returns the maps of the 16 coefficients of q in these intervals, those along x first.
fn coefficients(
    fine: &Array2<f64>,
    nodes: &Array2<f64>,
    y: &Interval,
    x: &Interval,
) -> Vec<Array2<f64>> {
    parallel::map(16, &|k| {
        let kernel = kernel(nodes, (y, k / 4), (x, k % 4));
        let (ky, kx) = kernel.dim();
        let shape = (fine.nrows() + ky - 1, fine.ncols() + kx - 1);
        Convolution::<f64>::new(kernel.view(), shape).adjoint(fine.view())
    })
}

/// Returns the coordinate of the tool, mm, at f in an interval with these `cells`, at an index of its maps. `map` and
/// `samples` are the axes of the map and of the TIF.
fn place_mm(map: &Axis, samples: &Axis, cells: usize, index: usize, f: f64) -> f64 {
    let steps = (cells - 1) as f64 - index as f64 + f;
    map.start_mm() - samples.start_mm() - steps * samples.step_mm()
}

/// Returns the length of the flanks of the tool along x and y, mm: the standard deviation, for a Gaussian.
pub fn flanks_mm(tif: &Tif) -> [f64; 2] {
    longest_part_mm(tif).map(|part| 0.5 * part)
}

/// Returns a map (ny, nx) on the lattice with `parts` nodes for each pixel along [x, y], zero between the pixels.
pub fn upsampled(map: &Array2<f64>, parts: [usize; 2]) -> Array2<f64> {
    let (ny, nx) = map.dim();
    let mut fine = Array2::zeros(((ny - 1) * parts[1] + 1, (nx - 1) * parts[0] + 1));
    fine.slice_mut(s![..;parts[1], ..;parts[0]]).assign(map);
    fine
}

/// Returns the intervals of f along an axis with `samples` samples whose edge is `beyond` steps after the last one.
fn intervals(samples: usize, beyond: f64) -> Vec<Interval> {
    let mut all = vec![Interval { cells: samples, ends: [0.0; 2] }];
    if beyond > 0.0 {
        all.push(Interval { cells: samples, ends: [0.0, beyond] });
        all.push(Interval { cells: samples - 1, ends: [beyond, 1.0] });
    } else {
        all.push(Interval { cells: samples - 1, ends: [0.0, 1.0] });
    }
    all
}

/// Returns coefficient b of a cubic in the Bernstein basis of the interval `ends`: its blossom with b arguments at the
/// upper end, the others at the lower one. `powers` are its coefficients in powers, the lowest first.
fn blossom(powers: [f64; 4], ends: [f64; 2], b: usize) -> f64 {
    let [u, v, w] = [0, 1, 2].map(|k| if k < b { ends[1] } else { ends[0] });
    powers[0]
        + powers[1] * (u + v + w) / 3.0
        + powers[2] * (u * v + v * w + w * u) / 3.0
        + powers[3] * u * v * w
}

/// Returns the numbers a of the nodes j + a with a weight in coefficient b, and these weights.
fn weights(ends: [f64; 2], b: usize) -> impl Iterator<Item = (usize, f64)> {
    let weights = KEYS.map(|powers| blossom(powers, ends, b));
    weights.into_iter().enumerate().filter(|(_, weight)| *weight != 0.0)
}

/// Returns the kernel (cells along y, cells along x), nm/s, of a coefficient along y and one along x, from the samples
/// with ghost nodes.
fn kernel(
    nodes: &Array2<f64>,
    (y, by): (&Interval, usize),
    (x, bx): (&Interval, usize),
) -> Array2<f64> {
    let mut rows = Array2::zeros((y.cells, nodes.ncols()));
    for (a, weight) in weights(y.ends, by) {
        rows.scaled_add(weight, &nodes.slice(s![a..a + y.cells, ..]));
    }
    let mut kernel = Array2::zeros((y.cells, x.cells));
    for (a, weight) in weights(x.ends, bx) {
        kernel.scaled_add(weight, &rows.slice(s![.., a..a + x.cells]));
    }
    kernel
}

impl Bicubic {
    /// Makes the cell at an index of the maps of its coefficients.
    fn new(maps: &[Array2<f64>], index: (usize, usize), ends: [[f64; 2]; 2]) -> Self {
        let row = |b: usize| [0, 1, 2, 3].map(|k| maps[4 * b + k][index]);
        Self { coefficients: [0, 1, 2, 3].map(row), ends }
    }

    /// Returns the largest value at a corner, and f [along x, along y] there.
    fn highest_corner(&self) -> (f64, [f64; 2]) {
        let [x, y] = self.ends;
        let [first, .., last] = &self.coefficients;
        let mut highest = (first[0], [x[0], y[0]]);
        for (value, f) in
            [(first[3], [x[1], y[0]]), (last[0], [x[0], y[1]]), (last[3], [x[1], y[1]])]
        {
            if value > highest.0 {
                highest = (value, f);
            }
        }
        highest
    }

    /// Returns the largest coefficient.
    fn largest(&self) -> f64 {
        self.coefficients.iter().flatten().copied().fold(f64::NEG_INFINITY, f64::max)
    }

    /// Returns the four parts between the middles of the ends.
    fn quarters(&self) -> [Self; 4] {
        let [x, y] = self.ends.map(|[low, high]| {
            let middle = 0.5 * (low + high);
            [[low, middle], [middle, high]]
        });
        let [lower, upper] = halves(&self.coefficients).map(|half| halves(&transposed(&half)));
        let part = |half: &[[f64; 4]; 4], ends| Self { coefficients: transposed(half), ends };
        [
            part(&lower[0], [x[0], y[0]]),
            part(&lower[1], [x[1], y[0]]),
            part(&upper[0], [x[0], y[1]]),
            part(&upper[1], [x[1], y[1]]),
        ]
    }
}

fn transposed(matrix: &[[f64; 4]; 4]) -> [[f64; 4]; 4] {
    [0, 1, 2, 3].map(|k| matrix.map(|row| row[k]))
}
