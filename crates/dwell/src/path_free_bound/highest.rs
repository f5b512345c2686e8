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
//! coefficients of that cubic in the Bernstein basis of the interval are (1) with the blossoms of w_a in place of w_a,
//! and the cubic is nowhere above the largest of them (convex hull). So correlations of e with few kernels bound q at
//! all places. f = 0, where one more sample is within the edges, is an interval of its own. Nothing is approximated: R
//! may jump to zero at its edge.
//!
//! Source: blossoms and convex hulls, L. Ramshaw, Comput. Aided Geom. Des. 6 (1989) 323.

use ndarray::{Array2, s};
use planish_numerics::fft::convolution::Convolution;
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

/// Largest length of an interval of f, relative to the length of the flanks of the tool. Larger: a larger bound of q, by
/// about the square of this number. Smaller: more correlations.
const LONGEST_INTERVAL: f64 = 1.0 / 36.0;

/// Rounding of a correlation by FFT, relative to the product of the Euclidean norms of map and kernel. It is at most 20
/// log2(N) unit roundoffs for N = 1e6 elements.
const ROUNDING: f64 = 1e-13;

/// Weights of the samples along one axis in one kernel.
struct Weights {
    /// Number of samples j from 0 on that are within the edges.
    cells: usize,
    /// Weights of the nodes j .. j + 3 of the samples with ghost nodes.
    weights: [f64; 4],
    /// Middle of the interval of f.
    middle: f64,
}

/// Returns the upper bound of q of (1) of the module for a residual e (ny, nx) that is 0 on the invalid pixels of a map
/// on `grid`. The TIF has a whole number of samples for each pixel.
pub fn highest(residual: &Array2<f64>, tif: &Tif, grid: &Grid) -> Highest {
    let axes = [(0, &grid.x, &tif.grid().x), (1, &grid.y, &tif.grid().y)];
    let flanks_mm = flanks_mm(tif);
    let parts = axes.map(|(_, map, samples)| (map.step_mm() / samples.step_mm()).round() as usize);
    let [columns, rows] = axes.map(|(axis, _, samples)| {
        let beyond = (tif.edge_mm()[axis] - samples.end_mm()) / samples.step_mm();
        let intervals = samples.step_mm() / (LONGEST_INTERVAL * flanks_mm[axis]);
        weights_along(samples.len(), beyond, intervals.ceil().max(1.0) as usize)
    });
    let fine = upsampled(residual, parts);
    let norm = fine.iter().map(|e| e * e).sum::<f64>().sqrt();
    let mut highest = Highest { value: 0.0, place_mm: None };
    for y in &rows {
        for x in &columns {
            let kernel = kernel(tif.with_ghosts(), y, x);
            let size = kernel.iter().map(|r| r * r).sum::<f64>().sqrt();
            let (ky, kx) = kernel.dim();
            let shape = (fine.nrows() + ky - 1, fine.ncols() + kx - 1);
            let q = Convolution::<f64>::new(kernel.view(), shape).adjoint(fine.view());
            for ((r, c), value) in q.indexed_iter() {
                let value = value + ROUNDING * size * norm;
                if value > highest.value {
                    let place_mm = [
                        place_mm(&grid.x, &tif.grid().x, x, c),
                        place_mm(&grid.y, &tif.grid().y, y, r),
                    ];
                    highest = Highest { value, place_mm: Some(place_mm) };
                }
            }
        }
    }
    highest
}

/// Returns the coordinate of the tool, mm, in the middle of an interval of f, at an index of the correlation with the
/// kernel of these weights. `map` and `samples` are the axes of the map and of the TIF.
fn place_mm(map: &Axis, samples: &Axis, weights: &Weights, index: usize) -> f64 {
    let steps = (weights.cells - 1) as f64 - index as f64 + weights.middle;
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

/// Returns the weights of all kernels along an axis with `samples` samples whose edge is `beyond` steps after the last
/// one. Every interval of f is divided into `intervals` parts.
fn weights_along(samples: usize, beyond: f64, intervals: usize) -> Vec<Weights> {
    let mut all = vec![Weights { cells: samples, weights: [0.0, 1.0, 0.0, 0.0], middle: 0.0 }];
    let whole = if beyond > 0.0 {
        vec![(0.0, beyond, samples), (beyond, 1.0, samples - 1)]
    } else {
        vec![(0.0, 1.0, samples - 1)]
    };
    for (low, high, cells) in whole {
        let step = (high - low) / intervals as f64;
        for i in 0..intervals {
            let ends = [low + i as f64 * step, low + (i + 1) as f64 * step];
            for b in 0..4 {
                let weights = KEYS.map(|powers| blossom(powers, ends, b));
                all.push(Weights { cells, weights, middle: 0.5 * (ends[0] + ends[1]) });
            }
        }
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

/// Returns the kernel (cells along y, cells along x) of these weights, nm/s, from the samples with ghost nodes.
fn kernel(nodes: &Array2<f64>, y: &Weights, x: &Weights) -> Array2<f64> {
    let mut rows = Array2::zeros((y.cells, nodes.ncols()));
    for (b, w) in y.weights.iter().enumerate().filter(|(_, w)| **w != 0.0) {
        rows.scaled_add(*w, &nodes.slice(s![b..b + y.cells, ..]));
    }
    let mut kernel = Array2::zeros((y.cells, x.cells));
    for (a, w) in x.weights.iter().enumerate().filter(|(_, w)| **w != 0.0) {
        kernel.scaled_add(*w, &rows.slice(s![.., a..a + x.cells]));
    }
    kernel
}
