//! Tridiagonal systems, in time and memory proportional to their size.
//!
//! Neither method exchanges rows: the matrix is diagonally dominant, at least weakly, or positive
//! definite. Source: Golub and Van Loan, Matrix Computations, 4th ed., section 4.3.

/// Row k of a tridiagonal system of n unknowns: its elements at the unknowns k - 1, k and k + 1, and its right-hand
/// side. The elements at the unknowns -1 and n are not used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TridiagonalRow {
    /// Elements at the unknowns [k - 1, k, k + 1], called below, own and above.
    pub elements: [f64; 3],
    /// Right-hand side of the row.
    pub right: f64,
}

impl TridiagonalRow {
    /// Makes the row that sets its unknown to `value`, in place of its own equation.
    pub fn held(value: f64) -> Self {
        Self { elements: [0.0, 1.0, 0.0], right: value }
    }
}

/// Solves the system with the rows `row(k)`, k = 0 .. n-1, by Gaussian elimination without exchanges (Thomas'
/// algorithm). Returns x (n):
///
/// ```text
/// u_k = above_k / (own_k - below_k u_{k-1})
/// y_k = (right_k - below_k y_{k-1}) / (own_k - below_k u_{k-1})
/// x_k = y_k - u_k x_{k+1}
/// ```
pub fn solve(n: usize, row: impl Fn(usize) -> TridiagonalRow) -> Vec<f64> {
    let mut upper = vec![0.0; n];
    let mut x = vec![0.0; n];
    for k in 0..n {
        let TridiagonalRow { elements: [below, own, above], right } = row(k);
        let (left, past) = if k == 0 { (0.0, 0.0) } else { (upper[k - 1], x[k - 1]) };
        let pivot = own - below * left;
        upper[k] = above / pivot;
        x[k] = (right - below * past) / pivot;
    }
    for k in (1..n).rev() {
        x[k - 1] -= upper[k - 1] * x[k];
    }
    x
}

/// Factors `A = C P C'` of a symmetric positive definite tridiagonal matrix A, of which some rows and columns may be
/// left out. C is unit lower bidiagonal, and P contains the pivots on its diagonal.
#[derive(Clone, Debug)]
pub struct Factor {
    /// Pivots, the diagonal of P; 0 if the row is left out.
    pivot: Vec<f64>,
    /// Elements C[j, j-1] below the diagonal; element 0 is not used.
    below: Vec<f64>,
}

impl Factor {
    /// Factorises the matrix with the elements `diagonal[j]` and `A[j, j-1] = below[j]`; `below[0]` is not
    /// used.
    ///
    /// Rows and columns with a diagonal of 0 are left out; they must not be coupled to others. In
    /// exact arithmetic no pivot is smaller than the smallest eigenvalue of A. `least_pivot` > 0 is
    /// a lower bound for it, and keeps rounding from making a pivot smaller.
    pub fn new(diagonal: Vec<f64>, mut below: Vec<f64>, least_pivot: f64) -> Self {
        let mut pivot = diagonal;
        for j in 1..pivot.len() {
            if below[j] != 0.0 {
                // C[j, j-1] = A[j, j-1] / P[j-1],   P[j] = A[j, j] - C[j, j-1] A[j, j-1]
                let c = below[j] / pivot[j - 1];
                pivot[j] = (pivot[j] - c * below[j]).max(least_pivot);
                below[j] = c;
            }
        }
        Self { pivot, below }
    }

    /// Returns the solution x of `A x = r`; 0 where a row is left out.
    pub fn solve(&self, r: &[f64]) -> Vec<f64> {
        let mut x = r.to_vec();
        // C y = r
        for j in 1..x.len() {
            x[j] -= self.below[j] * x[j - 1];
        }
        // C' x = P^-1 y
        x.iter_mut().zip(&self.pivot).for_each(|(x, p)| *x = if *p > 0.0 { *x / p } else { 0.0 });
        for j in (1..x.len()).rev() {
            x[j - 1] -= self.below[j] * x[j];
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Rounding of solutions, for condition numbers below 10, values of order 1, and at most 200
    /// rows.
    const ROUNDING: f64 = 1e-13;

    #[test]
    fn elimination_agrees_with_a_dense_solution_with_and_without_held_rows() {
        let mut rng = ChaCha8Rng::seed_from_u64(21);
        for n in [1, 2, 3, 50, 200] {
            let rows: Vec<TridiagonalRow> = (0..n)
                .map(|k| match k % 7 {
                    5 => TridiagonalRow::held(rng.random_range(-1.0..1.0)),
                    _ => {
                        let [below, above] = [0, 1].map(|_| rng.random_range(-1.0..1.0));
                        let right = rng.random_range(-1.0..1.0);
                        TridiagonalRow { elements: [below, 2.5, above], right }
                    }
                })
                .collect();
            let dense = DMatrix::from_fn(n, n, |i, j| match j + 1 {
                k if k >= i && k <= i + 2 => rows[i].elements[k - i],
                _ => 0.0,
            });
            let right = DVector::from_fn(n, |i, _| rows[i].right);
            let expected = dense.lu().solve(&right).unwrap();
            let found = solve(n, |k| rows[k]);
            assert!((0..n).all(|k| (found[k] - expected[k]).abs() < ROUNDING), "{n}");
            assert!((0..n).filter(|k| k % 7 == 5).all(|k| found[k] == rows[k].right), "{n}");
        }
    }

    #[test]
    fn no_row_is_no_unknown() {
        assert!(solve(0, |_| TridiagonalRow::held(1.0)).is_empty());
        assert!(Factor::new(Vec::new(), Vec::new(), 1.0).solve(&[]).is_empty());
    }

    #[test]
    fn the_factor_inverts_what_is_not_left_out() {
        let mut rng = ChaCha8Rng::seed_from_u64(22);
        for n in [1, 2, 40, 200] {
            let out = |j: usize| j % 11 == 4;
            let diagonal: Vec<f64> = (0..n).map(|j| if out(j) { 0.0 } else { 2.5 }).collect();
            let below: Vec<f64> = (0..n)
                .map(|j| match j {
                    0 => 0.0,
                    j if out(j) || out(j - 1) => 0.0,
                    _ => rng.random_range(-1.0..1.0),
                })
                .collect();
            let r: Vec<f64> = (0..n).map(|_| rng.random_range(-1.0..1.0)).collect();
            // The eigenvalues are within 2.5 +- 2 (Gershgorin).
            let x = Factor::new(diagonal.clone(), below.clone(), 0.5).solve(&r);
            for j in 0..n {
                let left = if j > 0 { below[j] * x[j - 1] } else { 0.0 };
                let right = if j + 1 < n { below[j + 1] * x[j + 1] } else { 0.0 };
                let error = left + diagonal[j] * x[j] + right - r[j];
                assert!(if out(j) { x[j] == 0.0 } else { error.abs() < ROUNDING }, "{n} {j}");
            }
        }
    }
}
