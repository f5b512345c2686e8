//! The figure of a map, without the pits in it.
//!
//! ```text
//! q(u, v) = sum_(i + j <= p) c_ij P_i(u) P_j(v),   u, v from -1 to 1 over the map,   c = argmin sum rho(z - q)
//! rho(e)  = e^2 / 2 for |e| <= t, t |e| - t^2 / 2 beyond;   t = median |z - q|
//! ```
//!
//! Squares of a pit of 20 nm would draw the fit to it; its absolute values are outvoted by the other pixels, as in a
//! median, and unlike a median a polynomial follows a slope and a curvature.
//!
//! Source: rho, P. J. Huber, Ann. Math. Stat. 35 (1964) 73; its minimum by least squares with the weights
//! min(1, t / |e|), solved again and again, P. W. Holland, R. E. Welsch, Commun. Stat. A 6 (1977) 813.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `map` | (ny, nx) | nm |
//! | c_ij | `c` | (terms) | nm |
//! | t | `middle` | - | nm |

use nalgebra::{DMatrix, DVector};
use ndarray::{Array2, ArrayView2};
use planish_numerics::orthogonal::legendre;

/// p + 1: order 10 follows one wave over the map to 1e-5 of its height.
const ORDERS: usize = 11;

/// Samples per term that outvote a pit; where there are fewer, the order is lower.
const SAMPLES_PER_TERM: usize = 10;

/// Samples along an axis, at most: ten times the order; the time is theirs.
const MAX_SAMPLES: usize = 100;

/// Weighted fits.
const ROUNDS: usize = 8;

/// Added to the diagonal of the normal equations, relative to its mean: far above rounding, so that pixels on a line
/// can be fitted too, and far below what moves a height.
const RIDGE: f64 = 1e-10;

/// The figure at every pixel.
pub fn figure(map: ArrayView2<f64>) -> Array2<f64> {
    let (ny, nx) = map.dim();
    let (along_y, along_x) = (polynomials(ny), polynomials(nx));
    let at: Vec<_> = samples(ny)
        .flat_map(|r| samples(nx).map(move |c| (r, c)))
        .filter(|at| !map[*at].is_nan())
        .collect();
    // The highest order p whose (p + 1)(p + 2) / 2 terms have samples enough.
    let enough = |p: &usize| SAMPLES_PER_TERM * (p + 1) * (p + 2) / 2 <= at.len();
    let order = (0..ORDERS).rev().find(enough).unwrap_or(0);
    let terms: Vec<(usize, usize)> =
        (0..=order).flat_map(|i| (0..=order - i).map(move |j| (i, j))).collect();
    let row = |(r, c): &(usize, usize)| {
        let (u, v) = (along_x[*c], along_y[*r]);
        terms.iter().map(move |&(i, j)| u[i] * v[j])
    };
    let matrix = DMatrix::from_row_iterator(at.len(), terms.len(), at.iter().flat_map(row));
    let heights = DVector::from_iterator(at.len(), at.iter().map(|at| map[*at]));
    let Some(c) = fit(&matrix, &heights) else {
        return Array2::zeros((ny, nx));
    };
    let mut figure = Array2::zeros((ny, nx));
    for (v, mut line) in along_y.iter().zip(figure.outer_iter_mut()) {
        // sum_ij c_ij P_i(u) P_j(v) = sum_i a_i P_i(u)
        let mut a = [0.0; ORDERS];
        terms.iter().zip(c.iter()).for_each(|(&(i, j), c)| a[i] += c * v[j]);
        for (u, q) in along_x.iter().zip(line.iter_mut()) {
            *q = a.iter().zip(u).map(|(a, u)| a * u).sum();
        }
    }
    figure
}

/// P_0 ... P_p at `n` pixels from -1 to 1.
fn polynomials(n: usize) -> Vec<[f64; ORDERS]> {
    let half = 0.5 * (n - 1) as f64;
    let at = |i: usize| {
        let mut out = [0.0; ORDERS];
        legendre((i as f64 - half) / half.max(1.0), &mut out);
        out
    };
    (0..n).map(at).collect()
}

/// Equally spaced pixels of an axis.
fn samples(n: usize) -> impl Iterator<Item = usize> + Clone {
    let step = n.div_ceil(MAX_SAMPLES).max(1);
    ((step - 1) / 2..n).step_by(step)
}

/// argmin sum rho(z - A c); `None` without a sample.
fn fit(a: &DMatrix<f64>, z: &DVector<f64>) -> Option<DVector<f64>> {
    let mut weighted = a.clone();
    let mut found = None;
    for _ in 0..=ROUNDS {
        // A' w A c = A' w z
        let mut normal = a.tr_mul(&weighted);
        let ridge = RIDGE * normal.trace() / normal.nrows() as f64;
        (0..normal.nrows()).for_each(|k| normal[(k, k)] += ridge);
        let c = normal.cholesky()?.solve(&weighted.tr_mul(z));
        // w = min(1, t / |e|)
        let errors = (z - a * &c).abs();
        found = Some(c);
        let mut sorted = errors.as_slice().to_vec();
        let half = sorted.len() / 2;
        let middle = *sorted.select_nth_unstable_by(half, f64::total_cmp).1;
        if middle == 0.0 {
            break; // Most samples are on the polynomial.
        }
        let w = errors.map(|e| middle / e.max(middle));
        for (mut to, from) in weighted.column_iter_mut().zip(a.column_iter()) {
            to.copy_from(&from.component_mul(&w));
        }
    }
    found
}
