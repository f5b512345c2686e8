//! Solution of a linear system in the space of its large eigenvalues:
//!
//! ```text
//! x = sum over theta_i > cut theta_1 of  u_i (u_i' g) / theta_i,     H u_i = theta_i u_i   (1)
//! ```
//!
//! for a symmetric positive semidefinite H that is known by its products only. With `H = A' A` and
//! `g = A' b` this is the truncated singular value decomposition of `min ||A x - b||`, cut at
//! `sigma_i > sqrt(cut) sigma_1`.
//!
//! The process of Lanczos from g spans the eigenvectors that g contains. It finds the small
//! eigenvalues last, which are those that (1) leaves out. Every new vector is made orthogonal to
//! all previous ones, twice, so no eigenvalue appears twice.
//!
//! Source: Golub and Van Loan, Matrix Computations, 4th ed., sections 10.1 and 10.3.

use nalgebra::{DMatrix, Dyn, SymmetricEigen};
use ndarray::{Array1, Array2, ArrayView1, s};

/// Number of steps of the Lanczos process before the first test of convergence. A test needs the eigenvalues of a
/// small matrix; the next one follows after half as many steps again. Larger: more steps than necessary. Smaller: more
/// tests.
const FIRST_LOOK: usize = 20;

/// Length of a new vector, relative to the largest diagonal element of the tridiagonal matrix, below which it is
/// rounding.
/// Larger: the process ends before all of g is spanned. Smaller: it continues with vectors of
/// rounding.
const SPANNED: f64 = 1e-13;

/// Number of steps of [`largest_eigenvalue`] before the first test. Larger: more steps than necessary. Smaller: more
/// tests.
const FIRST_LOOK_AT_LARGEST: usize = 8;
/// Largest number of steps for the largest eigenvalue. Larger: more time if eigenvalues are
/// crowded. Smaller: a less exact eigenvalue.
const MAX_STEPS_FOR_LARGEST: usize = 150;

/// Residual of the largest eigenvalue, relative to it, at which [`largest_eigenvalue`] ends. The error of its square
/// root is then at most 1e-3 of it. Larger: a less exact eigenvalue. Smaller: more steps.
const RESIDUAL_OF_LARGEST: f64 = 2e-3;

/// Result of (1) of the module: a solution without the small eigenvalues.
#[derive(Clone, Debug)]
pub struct Truncated {
    /// Solution x (n).
    pub value: Vec<f64>,
    /// Number of eigenvalues that were found above the cut, which is a fraction of the largest one.
    pub rank: usize,
    /// Largest eigenvalue of H.
    pub largest: f64,
    /// Smallest eigenvalue above the cut; infinite if there is none.
    pub smallest: f64,
    /// Number of steps of the Lanczos process, one product with H each.
    pub steps: usize,
    /// True if x changed by at most the tolerance between the last two tests, or if the process spanned all of g or
    /// took n steps. Also true for g = 0.
    pub converged: bool,
}

/// Computes the solution (1) of the module. `apply` is the product with H. Eigenvalues up to `cut` times the largest
/// are left out.
///
/// The process ends when it has spanned all of g, when x changed by at most `tolerance` of its length in the last third
/// of the steps, or after `max_steps` steps. At every test `watch` gets the ratio of that change to the tolerance.
pub fn truncated(
    apply: impl Fn(&[f64]) -> Vec<f64>,
    g: &[f64],
    cut: f64,
    tolerance: f64,
    max_steps: usize,
    mut watch: impl FnMut(f64),
) -> Truncated {
    let n = g.len();
    let max_steps = max_steps.min(n);
    let start = Array1::from(g.to_vec());
    let length = start.dot(&start).sqrt();
    let mut result = Truncated {
        value: vec![0.0; n],
        rank: 0,
        largest: 0.0,
        smallest: 0.0,
        steps: 0,
        converged: length == 0.0,
    };
    if result.converged {
        return result;
    }
    // Rows are the vectors v_k; H v_k = beta_{k-1} v_{k-1} + alpha_k v_k + beta_k v_{k+1}.
    let mut v = Array2::<f64>::zeros((max_steps, n));
    v.row_mut(0).assign(&(&start / length));
    let mut alpha: Vec<f64> = Vec::new();
    let mut beta: Vec<f64> = Vec::new();
    let mut next_look = FIRST_LOOK;
    for k in 0..max_steps {
        let row = v.row(k).to_vec();
        let mut w = Array1::from(apply(&row));
        alpha.push(w.dot(&ArrayView1::from(&row)));
        for _ in 0..2 {
            let basis = v.slice(s![..=k, ..]);
            let components = basis.dot(&w);
            w -= &basis.t().dot(&components);
        }
        let b = w.dot(&w).sqrt();
        // All of g is spanned if the new vector is rounding.
        let scale = alpha.iter().copied().fold(0.0, f64::max);
        let spanned = b <= SPANNED * scale;
        let last = spanned || k + 1 == max_steps;
        if last || k + 1 == next_look {
            let before = Array1::from(result.value);
            result = solve(&alpha, &beta, &v, length, cut);
            let change = &Array1::from(result.value.clone()) - &before;
            let size = ArrayView1::from(&result.value);
            let enough = (tolerance * tolerance) * size.dot(&size);
            let settled = change.dot(&change) <= enough;
            watch((change.dot(&change) / enough).sqrt());
            result.converged = spanned || max_steps == n && last || settled;
            if last || settled {
                break;
            }
            next_look += next_look / 2;
        }
        beta.push(b);
        v.row_mut(k + 1).assign(&(&w / b));
    }
    result
}

/// Returns the largest eigenvalue of the matrix H (n, n), whose product with a vector is `apply`. The result is a
/// lower bound. Unless another eigenvalue is near, its relative error is about the square of the residual at the end,
/// 2e-3.
///
/// The vectors are not made orthogonal to all previous ones, so three vectors are enough. An
/// eigenvalue may then appear twice, which does no harm here. For an eigenvector s of T with the
/// eigenvalue theta, the residual of `V s` is `beta_k |s_k|`, and an eigenvalue of H lies within
/// this distance of theta. The power method is slow if eigenvalues are crowded below the largest,
/// as for a tool that is narrow for its part. Small steps of that method then prove nothing.
pub fn largest_eigenvalue(apply: impl Fn(&[f64]) -> Vec<f64>, n: usize) -> f64 {
    let start = Array1::from_iter((0..n as u64).map(without_structure));
    let length = start.dot(&start).sqrt();
    let mut before = Array1::<f64>::zeros(n);
    let mut v = start / length;
    let mut alpha: Vec<f64> = Vec::new();
    let mut beta: Vec<f64> = Vec::new();
    let mut largest = 0.0;
    let mut next_look = FIRST_LOOK_AT_LARGEST;
    let max_steps = MAX_STEPS_FOR_LARGEST.min(n);
    for k in 1..=max_steps {
        let mut w = Array1::from(apply(v.as_slice().expect("one axis")));
        let a = w.dot(&v);
        w.scaled_add(-a, &v);
        w.scaled_add(-beta.last().copied().unwrap_or(0.0), &before);
        alpha.push(a);
        let b = w.dot(&w).sqrt();
        // If the new vector is rounding, everything that the start contains is spanned.
        let spanned = b <= SPANNED * alpha.iter().copied().fold(0.0, f64::max);
        if spanned || k == max_steps || k == next_look {
            let eigen = eigen(&alpha, &beta);
            let top = eigen.eigenvalues.imax();
            largest = eigen.eigenvalues[top].max(0.0);
            let residual = b * eigen.eigenvectors[(k - 1, top)].abs();
            if spanned || residual <= RESIDUAL_OF_LARGEST * largest {
                break;
            }
            next_look += next_look / 2;
        }
        beta.push(b);
        before = std::mem::replace(&mut v, w / b);
    }
    largest
}

/// Returns a pseudorandom number from -1/2 to 1/2 for the index j: the finaliser of SplitMix64 (G. L. Steele, D. Lea,
/// C. H. Flood, OOPSLA 2014, Fig. 17).
fn without_structure(j: u64) -> f64 {
    let z = (j + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
}

/// Returns the eigenvalues and eigenvectors of the symmetric tridiagonal matrix T with the diagonal `alpha` and the
/// elements `beta` next to it.
fn eigen(alpha: &[f64], beta: &[f64]) -> SymmetricEigen<f64, Dyn> {
    let k = alpha.len();
    let mut t = DMatrix::zeros(k, k);
    for i in 0..k {
        t[(i, i)] = alpha[i];
        if i + 1 < k {
            t[(i, i + 1)] = beta[i];
            t[(i + 1, i)] = beta[i];
        }
    }
    SymmetricEigen::new(t)
}

/// Solves (1) of the module in the space of the first Lanczos vectors, the rows of `v`. The tridiagonal matrix T of
/// alpha and beta stands for H; `length` is the norm of g.
fn solve(alpha: &[f64], beta: &[f64], v: &Array2<f64>, length: f64, cut: f64) -> Truncated {
    let k = alpha.len();
    let eigen = eigen(alpha, beta);
    let largest = eigen.eigenvalues.iter().copied().fold(0.0, f64::max);
    let above: Vec<usize> = (0..k).filter(|i| eigen.eigenvalues[*i] > cut * largest).collect();
    let mut y = Array1::<f64>::zeros(k);
    for &i in &above {
        // s_i (s_i' e_1 |g|) / theta_i
        let factor = eigen.eigenvectors[(0, i)] * length / eigen.eigenvalues[i];
        for r in 0..k {
            y[r] += factor * eigen.eigenvectors[(r, i)];
        }
    }
    let value = v.slice(s![..k, ..]).t().dot(&y).to_vec();
    let smallest = above.iter().map(|i| eigen.eigenvalues[*i]).fold(f64::INFINITY, f64::min);
    Truncated { value, rank: above.len(), largest, smallest, steps: k, converged: false }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DVector;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn agrees_with_the_singular_value_decomposition() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let random = |r: usize, c: usize, rng: &mut ChaCha8Rng| {
            DMatrix::from_fn(r, c, |_, _| rng.random_range(-1.0..1.0))
        };
        // Singular values 1, 0.7, 0.49, ... down to 1e-6.
        let u = random(60, 40, &mut rng).qr().q();
        let w = random(40, 40, &mut rng).qr().q();
        let sigma = DMatrix::from_diagonal(&DVector::from_fn(40, |i, _| 0.7_f64.powi(i as i32)));
        let a = &u * sigma * w.transpose();
        let b = DVector::from_fn(60, |_, _| rng.random_range(-1.0..1.0));
        let apply = |x: &[f64]| a.tr_mul(&(&a * DVector::from_row_slice(x))).as_slice().to_vec();
        let g = a.tr_mul(&b);
        // Between 0.7^9 = 0.040 and 0.7^10 = 0.028: ten are kept.
        let found = truncated(apply, g.as_slice(), 0.03_f64.powi(2), 1e-12, 40, |_| ());
        assert!(found.converged, "{found:?}");
        let svd = a.svd(true, true);
        let expected = svd.solve(&b, 0.03).unwrap();
        let error = (DVector::from_row_slice(&found.value) - &expected).norm();
        assert_eq!(found.rank, 10);
        // Rounding times the condition number 1.2e3 of the kept eigenvalues.
        assert!(error < 1e-10 * expected.norm(), "{error}");
        // Below: rounding of the largest eigenvalue, of which the smallest is 0.7^18 = 1.6e-3.
        assert!((found.largest - 1.0).abs() < 1e-12);
        assert!((found.smallest / 0.7_f64.powi(18) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn the_largest_of_crowded_eigenvalues_is_found() {
        let close = |h: &DMatrix<f64>, what: &str| {
            let expected = h.clone().symmetric_eigen().eigenvalues.max();
            let apply = |x: &[f64]| (h * DVector::from_row_slice(x)).as_slice().to_vec();
            let ratio = largest_eigenvalue(apply, h.nrows()) / expected;
            // Rounding above, and the residual of the largest eigenvalue below: the result is a lower bound.
            assert!(ratio < 1.0 + 1e-12 && ratio > 1.0 - RESIDUAL_OF_LARGEST, "{what}: {ratio}");
        };
        // A narrow tool along n points, on a map whose mean is free and whose weights rise in one place.
        for (n, width) in [(20, 2.0), (200, 1.5), (300, 8.0)] {
            let tool = DMatrix::from_fn(n, n, |i, j| {
                let (i, j, n) = (i as f64, j as f64, n as f64);
                let weight = 1.0 + 0.2 * (-((i - 0.7 * n) / 4.0).powi(2)).exp();
                weight * (-0.5 * ((i - j) / width).powi(2)).exp()
            });
            let mean = tool.row_mean();
            let a = DMatrix::from_fn(n, n, |i, j| tool[(i, j)] - mean[j]);
            close(&a.tr_mul(&a), &format!("{n} {width}"));
        }
        // One half wave over all points above many equal ones: steps of the power method from a start that is nearly
        // orthogonal to it change nothing at first.
        let n = 300;
        let wave = DVector::from_fn(n, |j, _| {
            (std::f64::consts::PI * (j as f64 + 0.5) / n as f64).cos() * (2.0 / n as f64).sqrt()
        });
        close(&(DMatrix::identity(n, n) * 0.86 + &wave * wave.transpose() * 0.14), "half wave");
        assert_eq!(largest_eigenvalue(|x| vec![0.0; x.len()], 5), 0.0);
        assert_eq!(largest_eigenvalue(|x| x.to_vec(), 0), 0.0);
        // Rounding of a product.
        assert!((largest_eigenvalue(|x| vec![3.0 * x[0]], 1) - 3.0).abs() < 1e-15);
    }

    #[test]
    fn no_right_hand_side_no_solution() {
        let found = truncated(|x| x.to_vec(), &[0.0; 4], 1e-3, 1e-9, 4, |_| ());
        assert!(found.converged && found.value == [0.0; 4] && found.rank == 0);
    }
}
