//! Least squares with a polynomial basis on the valid pixels of a map.
//!
//! ```text
//! c = argmin sum over valid pixels (z - sum_k c_k phi_k)^2,   G c = b,
//! G_kl = sum phi_k phi_l,   b_k = sum phi_k z
//! ```
//!
//! The basis is nearly orthogonal on the shapes it is meant for, so the normal equations, scaled to a unit
//! diagonal, lose few digits. Two steps of iterative refinement recover them. The equations need memory for
//! the map and G only. A QR factorisation of a map of 1641 x 1641 pixels would need every term on every
//! pixel.
//!
//! | symbol | variable | shape |
//! |---|---|---|
//! | z | `map` | (ny, nx) |
//! | phi | `Basis::row` | (nx, k) |
//! | c | `coefficients` | (k) |

use nalgebra::{DMatrix, DVector};
use ndarray::{Array1, Array2, ArrayView2, Axis as Dimension};
use planish_numerics::orthogonal;
use planish_types::{Grid, Invalid};
use rayon::prelude::*;

/// Number of rows of the map that one task sums together. It is fixed, so that the order of the sums does not depend on
/// the threads. Larger: fewer tasks for the threads. Smaller: more memory for partial sums. Another value changes the
/// last digits of the result.
const BAND: usize = 16;

/// Smallest ratio of the least to the largest eigenvalue of G, scaled to a unit diagonal; with a smaller ratio the fit
/// is refused. Larger: refuses apertures on which the terms are hard to tell apart. Smaller: accepts terms that depend
/// on each other on the valid pixels, for which the refinement does not converge.
const LEAST_EIGENVALUE: f64 = 1e-10;

/// Number of steps of iterative refinement. Larger: more time, no more digits. Smaller: the coefficients
/// lose the digits that the normal equations lose.
const REFINEMENTS: usize = 2;

/// Terms phi_k of the fit (see the module), as functions on the pixels of a grid.
pub enum Basis {
    /// Products `f_i(u) f_j(v)` of polynomials of one variable, one for every [i, j] in `terms`.
    Tensor {
        /// Orders [i, j] of the terms.
        terms: Vec<[u32; 2]>,
        /// Polynomials f_i at the columns (nx, orders).
        along_x: Array2<f64>,
        /// Polynomials f_j at the rows (ny, orders).
        along_y: Array2<f64>,
    },
    /// All Zernike terms up to `order`, of unit RMS on the unit disc; `x` and `y` are the pixel centres over its
    /// radius.
    Zernike {
        /// Highest radial order n.
        order: u32,
        /// x of the columns, from the centre of the disc (nx).
        x: Vec<f64>,
        /// y of the rows, from the centre of the disc (ny).
        y: Vec<f64>,
    },
}

/// Family of the polynomials of one variable in a product.
#[derive(Clone, Copy)]
pub enum Polynomial {
    /// Legendre polynomials, which are orthogonal with equal weights.
    Legendre,
    /// Chebyshev polynomials of the first kind.
    Chebyshev,
}

impl Basis {
    /// Returns the products of polynomials in u and v, which run from -1 to 1 over the ranges `x_mm` and `y_mm`.
    pub fn tensor(
        grid: &Grid,
        [x_mm, y_mm]: [[f64; 2]; 2],
        polynomial: Polynomial,
        terms: Vec<[u32; 2]>,
    ) -> Self {
        let [along_x, along_y] = [0, 1].map(|which| {
            let axis = [&grid.x, &grid.y][which];
            let [low, high] = [x_mm, y_mm][which];
            let orders = terms.iter().map(|t| t[which]).max().unwrap_or(0) as usize + 1;
            let mut out = Array2::zeros((axis.len(), orders));
            for (i, mut row) in out.outer_iter_mut().enumerate() {
                let u = (2.0 * axis.coordinate_mm(i) - low - high) / (high - low);
                let row = row.as_slice_mut().expect("rows are contiguous");
                match polynomial {
                    Polynomial::Legendre => orthogonal::legendre(u, row),
                    Polynomial::Chebyshev => orthogonal::chebyshev(u, row),
                }
            }
            out
        });
        Self::Tensor { terms, along_x, along_y }
    }

    /// Returns all Zernike terms up to the radial order `order` on the disc about `centre_mm` [x, y].
    pub fn zernike(grid: &Grid, centre_mm: [f64; 2], radius_mm: f64, order: u32) -> Self {
        let [x, y] = [(&grid.x, centre_mm[0]), (&grid.y, centre_mm[1])].map(|(axis, centre)| {
            axis.coordinates().into_iter().map(|v| (v - centre) / radius_mm).collect()
        });
        Self::Zernike { order, x, y }
    }

    /// Returns the number of terms.
    #[expect(clippy::len_without_is_empty, reason = "a basis has at least one term")]
    pub fn len(&self) -> usize {
        match self {
            Self::Tensor { terms, .. } => terms.len(),
            Self::Zernike { order, .. } => orthogonal::zernike_terms(*order),
        }
    }

    /// Returns the orders of all terms: [order along x, order along y], or [n, m] of Zernike terms.
    pub fn terms(&self) -> Vec<[i32; 2]> {
        match self {
            Self::Tensor { terms, .. } => terms.iter().map(|t| t.map(|k| k as i32)).collect(),
            Self::Zernike { order, .. } => {
                (0..=*order as i32).flat_map(|n| (-n..=n).step_by(2).map(move |m| [n, m])).collect()
            }
        }
    }

    /// Returns the values of all terms phi_k on row `r` of the map, (nx, k).
    fn row(&self, r: usize) -> Array2<f64> {
        match self {
            Self::Tensor { terms, along_x, along_y } => {
                Array2::from_shape_fn((along_x.nrows(), terms.len()), |(c, k)| {
                    let [i, j] = terms[k].map(|v| v as usize);
                    along_x[[c, i]] * along_y[[r, j]]
                })
            }
            Self::Zernike { order, x, y } => {
                let mut out = Array2::zeros((x.len(), self.len()));
                for (x, mut row) in x.iter().zip(out.outer_iter_mut()) {
                    let row = row.as_slice_mut().expect("rows are contiguous");
                    orthogonal::zernike(*order, *x, y[r], row);
                    for n in 0..=*order {
                        for m in (-(n as i32)..=n as i32).step_by(2) {
                            // The RMS of Z_n^m on the disc is 1 / sqrt(n + 1), or 1 / sqrt(2 (n + 1)).
                            let twice = if m == 0 { 1.0 } else { 2.0 };
                            row[orthogonal::zernike_index(n, m)] *=
                                (twice * f64::from(n + 1)).sqrt();
                        }
                    }
                }
                out
            }
        }
    }

    /// Returns the sum of the terms times their `coefficients` (k), on every pixel of a map of this shape (ny, nx).
    pub fn sum(&self, shape: (usize, usize), coefficients: &[f64]) -> Array2<f64> {
        let c = Array1::from(coefficients.to_vec());
        let mut out = Array2::zeros(shape);
        let rows = out.outer_iter_mut().into_par_iter().enumerate();
        rows.for_each(|(r, mut row)| row.assign(&self.row(r).dot(&c)));
        out
    }
}

/// Result of a least-squares fit of the terms.
pub struct BasisFit {
    /// Coefficients c of the module, one per term, in the unit of the map.
    pub coefficients: Vec<f64>,
    /// Sum of the fitted terms on every pixel, (ny, nx).
    pub map: Array2<f64>,
    /// Condition number of the matrix of the terms on the valid pixels, each term scaled to the same RMS there: the
    /// root of that of G.
    pub condition: f64,
    /// Largest magnitude of the correlation of two terms on the valid pixels; 0 if they are orthogonal.
    pub largest_correlation: f64,
}

/// Fits the basis to the valid pixels of `map` (ny, nx). Refuses fewer than two pixels per term, and pixels that do not
/// determine the terms.
pub fn fit(basis: &Basis, map: ArrayView2<f64>) -> Result<BasisFit, Invalid> {
    let terms = basis.len();
    let valid = map.iter().filter(|v| !v.is_nan()).count();
    if valid < 2 * terms {
        return Err(Invalid::whole(
            "low order",
            format!("{valid} valid pixel(s) for {terms} terms"),
            "give at least two pixels per term, or a lower order",
        ));
    }
    let (gram, mut moments) = sums(basis, map, true);
    // G scaled to a unit diagonal: S G S, S = diag(1 / sqrt(G_kk))
    let scale =
        DVector::from_fn(
            terms,
            |k, _| {
                if gram[(k, k)] > 0.0 { 1.0 / gram[(k, k)].sqrt() } else { 0.0 }
            },
        );
    let scaled = DMatrix::from_fn(terms, terms, |k, l| gram[(k, l)] * scale[k] * scale[l]);
    let mut largest_correlation = 0.0_f64;
    for l in 0..terms {
        for k in (0..terms).filter(|k| *k != l) {
            largest_correlation = largest_correlation.max(scaled[(k, l)].abs());
        }
    }
    let eigen = scaled.symmetric_eigen();
    let least = eigen.eigenvalues.min();
    let most = eigen.eigenvalues.max();
    let distinguishable = least > LEAST_EIGENVALUE * most;
    if !distinguishable {
        return Err(Invalid::whole(
            "low order",
            format!("{terms} terms cannot be told apart on the {valid} valid pixels"),
            "give a lower order, or a map that is wider",
        ));
    }
    let solve = |b: &DVector<f64>| {
        let along = eigen.eigenvectors.transpose() * b.component_mul(&scale);
        (&eigen.eigenvectors * along.component_div(&eigen.eigenvalues)).component_mul(&scale)
    };
    let mut c = solve(&moments);
    let mut fitted = basis.sum(map.dim(), c.as_slice());
    for _ in 0..REFINEMENTS {
        moments = sums(basis, (&map - &fitted).view(), false).1;
        c += solve(&moments);
        fitted = basis.sum(map.dim(), c.as_slice());
    }
    Ok(BasisFit {
        coefficients: c.as_slice().to_vec(),
        map: fitted,
        condition: (most / least).sqrt(),
        largest_correlation,
    })
}

/// Returns the matrix G and the right-hand side b of the module for `map`, whose NaN do not count. Without `with_gram`,
/// G is zero.
fn sums(basis: &Basis, map: ArrayView2<f64>, with_gram: bool) -> (DMatrix<f64>, DVector<f64>) {
    let terms = basis.len();
    let bands: Vec<_> = map
        .axis_chunks_iter(Dimension(0), BAND)
        .into_par_iter()
        .enumerate()
        .map(|(band, rows)| {
            let mut gram = Array2::<f64>::zeros((terms, terms));
            let mut moments = Array1::<f64>::zeros(terms);
            for (i, line) in rows.outer_iter().enumerate() {
                let mut phi = basis.row(band * BAND + i);
                let mut z = line.to_owned();
                for (mut terms, z) in phi.outer_iter_mut().zip(z.iter_mut()) {
                    if z.is_nan() {
                        terms.fill(0.0);
                        *z = 0.0;
                    }
                }
                moments += &phi.t().dot(&z);
                if with_gram {
                    gram += &phi.t().dot(&phi);
                }
            }
            (gram, moments)
        })
        .collect();
    let mut gram = DMatrix::zeros(terms, terms);
    let mut moments = DVector::zeros(terms);
    for (g, b) in bands {
        gram += DMatrix::from_fn(terms, terms, |k, l| g[[k, l]]);
        moments += DVector::from_fn(terms, |k, _| b[k]);
    }
    (gram, moments)
}
