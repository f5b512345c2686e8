//! Low-order terms of a map: products of Legendre polynomials on the rectangle of its grid, and their fit to a map.

use nalgebra::{DMatrix, DVector};
use ndarray::Array2;
use planish_numerics::orthogonal::legendre;
use planish_types::{Grid, Invalid};

/// Highest total order i + j of the products P_i(u) P_j(v). Larger: the terms fit features of the part. Smaller: less
/// of a drift is fitted.
pub(crate) const MOST_ORDER: usize = 8;

/// Smallest eigenvalue of the normal matrix over its trace, below which the pixels do not determine the terms. Larger:
/// refuses narrow overlaps. Smaller: rounding decides a term.
pub(crate) const LEAST_EIGENVALUE: f64 = 1e-9;

/// Values of the low-order Legendre terms on the pixels of a grid. u and v run from -1 to 1 across the columns and the
/// rows.
pub(crate) struct LowOrder {
    /// Legendre polynomials P_0 to P_order at the coordinate u of every column.
    along_x: Vec<Vec<f64>>,
    /// Legendre polynomials P_0 to P_order at the coordinate v of every row.
    along_y: Vec<Vec<f64>>,
    order: usize,
}

impl LowOrder {
    /// Evaluates the Legendre polynomials of the total order 0 to `order` on the rectangle of `grid`. Refuses an order
    /// above [`MOST_ORDER`].
    pub fn new(grid: &Grid, order: usize) -> Result<Self, Invalid> {
        if order > MOST_ORDER {
            let remedy = format!("give 0 to {MOST_ORDER}");
            return Err(Invalid::whole("free_order", format!("is {order}"), remedy));
        }
        let [along_x, along_y] = [&grid.x, &grid.y].map(|axis| {
            let mut values = vec![vec![0.0; order + 1]; axis.len()];
            for (i, values) in values.iter_mut().enumerate() {
                legendre(2.0 * i as f64 / (axis.len() - 1) as f64 - 1.0, values);
            }
            values
        });
        Ok(Self { along_x, along_y, order })
    }

    /// Returns the number of terms: (order + 1)(order + 2)/2.
    pub fn len(&self) -> usize {
        (self.order + 1) * (self.order + 2) / 2
    }

    /// Writes the terms P_i(u) P_j(v), i + j <= order, at a pixel (row, column) to `out`. j varies fastest.
    pub fn write_terms(&self, (row, column): (usize, usize), out: &mut [f64]) {
        let x = &self.along_x[column];
        let y = &self.along_y[row];
        let mut k = 0;
        for i in 0..=self.order {
            for j in 0..=self.order - i {
                out[k] = x[i] * y[j];
                k += 1;
            }
        }
    }

    /// Returns the sum of the terms with these coefficients on every pixel (ny, nx), in the unit of the coefficients.
    pub fn sum(&self, coefficients: &[f64]) -> Array2<f64> {
        let mut terms = vec![0.0; self.len()];
        Array2::from_shape_fn((self.along_y.len(), self.along_x.len()), |pixel| {
            self.write_terms(pixel, &mut terms);
            terms.iter().zip(coefficients).map(|(t, c)| t * c).sum()
        })
    }

    /// Fits the terms to the valid pixels (not NaN) of a map by least squares. Returns the fitted surface on every
    /// pixel (ny, nx), in the unit of the map. Refuses pixels that do not determine the terms.
    pub fn fit(&self, map: &Array2<f64>) -> Result<Array2<f64>, Invalid> {
        let n = self.len();
        let mut normal = DMatrix::<f64>::zeros(n, n);
        let mut right = DVector::<f64>::zeros(n);
        let mut terms = vec![0.0; n];
        let mut pixels = 0_usize;
        for (pixel, z) in map.indexed_iter().filter(|(_, z)| !z.is_nan()) {
            self.write_terms(pixel, &mut terms);
            pixels += 1;
            for i in 0..n {
                right[i] += terms[i] * z;
                for j in 0..n {
                    normal[(i, j)] += terms[i] * terms[j];
                }
            }
        }
        let trace = normal.trace();
        let least = normal.clone().symmetric_eigenvalues().min();
        let solved = normal.cholesky().filter(|_| least > LEAST_EIGENVALUE * trace);
        let solved = solved.ok_or_else(|| {
            let problem = format!(
                "has {pixels} valid pixel(s) in common with the first map, which do not determine {n} term(s)"
            );
            Invalid::whole("map", problem, "give maps of the same area, or a lower `free_order`")
        })?;
        Ok(self.sum(solved.solve(&right).as_slice()))
    }
}
