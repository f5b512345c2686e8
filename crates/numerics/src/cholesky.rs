//! Blocked Cholesky factorisation `A = L L'` of a dense symmetric positive definite matrix.
//!
//! Left-looking by block columns: with the blocks left of column `k` known,
//!
//! ```text
//! A[k.., k] -= L[k.., ..k] L[k, ..k]'        (matrix products, nearly all of the n^3/3 flops)
//! A[k, k] = L[k, k] L[k, k]'                 (unblocked)
//! L[i, k] = A[i, k] L[k, k]^-T,  i > k       (row by row)
//! ```
//!
//! Rows are shared among threads in blocks of fixed size, so the result does not depend on
//! their number. Source: Golub and Van Loan, Matrix Computations, 4th ed., section 4.2.

use ndarray::{Array2, ArrayView2, Axis, linalg::general_mat_mul, s};
use rayon::prelude::*;

/// Columns of a block: small enough for the unblocked part to be negligible, large enough for
/// the matrix products to run at full speed.
const BLOCK: usize = 64;

/// Rows that a thread takes at a time.
const ROWS: usize = 192;

/// The lower triangular factor.
#[derive(Clone, Debug)]
pub struct Cholesky {
    /// L in the lower triangle; what is above the diagonal is left over.
    factor: Array2<f64>,
}

impl Cholesky {
    /// Factorises `a` (n, n), of which only the lower triangle is read; `None` when it is not
    /// positive definite to rounding.
    pub fn new(a: Array2<f64>) -> Option<Self> {
        let n = a.nrows();
        assert_eq!(a.dim(), (n, n), "a square matrix");
        let mut factor = a;
        for start in (0..n).step_by(BLOCK) {
            let width = BLOCK.min(n - start);
            let below = factor.slice_mut(s![start.., ..start + width]);
            let (left, mut block) = below.split_at(Axis(1), start);
            if start > 0 {
                // A[k.., k] -= L[k.., ..k] L[k, ..k]'
                let top = left.slice(s![..width, ..]);
                block
                    .axis_chunks_iter_mut(Axis(0), ROWS)
                    .into_par_iter()
                    .zip(left.axis_chunks_iter(Axis(0), ROWS))
                    .for_each(|(mut rows, l)| general_mat_mul(-1.0, &l, &top.t(), 1.0, &mut rows));
            }
            let (mut diagonal, mut rest) = block.split_at(Axis(0), width);
            let mut l = diagonal.to_owned();
            factorise_unblocked(&mut l)?;
            diagonal.assign(&l);
            // L[i, k] L[k, k]' = A[i, k]: forward substitution with the columns of L[k, k].
            let columns = l.t().as_standard_layout().into_owned();
            rest.axis_chunks_iter_mut(Axis(0), ROWS).into_par_iter().for_each(|mut rows| {
                for mut row in rows.outer_iter_mut() {
                    let row = row.as_slice_mut().expect("rows are contiguous");
                    substitute(row, columns.view());
                }
            });
        }
        Some(Self { factor })
    }

    /// Solves `A x = b` in place.
    pub fn solve(&self, b: &mut [f64]) {
        let n = self.factor.nrows();
        assert_eq!(b.len(), n, "length of the right-hand side");
        // L y = b
        for i in 0..n {
            let row = self.factor.slice(s![i, ..i]);
            let known = row.dot(&ndarray::aview1(&b[..i]));
            b[i] = (b[i] - known) / self.factor[[i, i]];
        }
        // L' x = y
        for i in (0..n).rev() {
            b[i] /= self.factor[[i, i]];
            let x = b[i];
            let row = self.factor.slice(s![i, ..i]);
            b[..i].iter_mut().zip(row).for_each(|(b, l)| *b -= x * l);
        }
    }
}

/// `x L' = row` in place, `columns[j, ..]` the j-th column of L.
fn substitute(row: &mut [f64], columns: ArrayView2<f64>) {
    for j in 0..row.len() {
        let column = columns.row(j);
        let column = column.as_slice().expect("rows are contiguous");
        row[j] /= column[j];
        let x = row[j];
        row[j + 1..].iter_mut().zip(&column[j + 1..]).for_each(|(r, l)| *r -= x * l);
    }
}

fn factorise_unblocked(a: &mut Array2<f64>) -> Option<()> {
    let n = a.nrows();
    for j in 0..n {
        for i in j..n {
            let sum: f64 = (0..j).map(|k| a[[i, k]] * a[[j, k]]).sum();
            let value = a[[i, j]] - sum;
            if i == j {
                // Below rounding of what was subtracted the matrix is singular.
                if value.is_nan() || value <= f64::EPSILON * a[[j, j]].abs() {
                    return None;
                }
                a[[j, j]] = value.sqrt();
            } else {
                a[[i, j]] = value / a[[j, j]];
            }
        }
        for i in 0..j {
            a[[i, j]] = 0.0;
        }
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// G G' / n + I: eigenvalues from 1 to about 5.
    fn spd(n: usize) -> Array2<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
        let g = Array2::from_shape_simple_fn((n, n), || rng.random_range(-1.0..1.0));
        g.dot(&g.t()) / n as f64 + Array2::<f64>::eye(n)
    }

    #[test]
    fn agrees_with_another_factorisation_across_block_edges() {
        for n in [1, 2, 63, 64, 65, 200, 257] {
            let a = spd(n);
            let mut x: Vec<f64> = (0..n).map(|i| (i as f64).sin()).collect();
            let b = DVector::from_vec(x.clone());
            let other = DMatrix::from_fn(n, n, |i, j| a[[i, j]]).cholesky().unwrap().solve(&b);
            Cholesky::new(a).unwrap().solve(&mut x);
            // Condition number about 5, order 1 values.
            assert!((0..n).all(|i| (x[i] - other[i]).abs() < 1e-13), "n {n}");
        }
    }

    #[test]
    fn only_the_lower_triangle_is_read() {
        let (a, mut upper) = (spd(100), spd(100));
        for i in 0..100 {
            for j in i + 1..100 {
                upper[[i, j]] = f64::NAN;
            }
        }
        let (mut x, mut y) = (vec![1.0; 100], vec![1.0; 100]);
        Cholesky::new(a).unwrap().solve(&mut x);
        Cholesky::new(upper).unwrap().solve(&mut y);
        assert_eq!(x, y);
    }

    #[test]
    fn indefinite_singular_and_nan_are_refused() {
        let mut a = spd(80);
        a[[70, 70]] = -1.0;
        assert!(Cholesky::new(a.clone()).is_none());
        a[[70, 70]] = f64::NAN;
        assert!(Cholesky::new(a).is_none());
        assert!(Cholesky::new(Array2::ones((3, 3))).is_none());
    }
}
