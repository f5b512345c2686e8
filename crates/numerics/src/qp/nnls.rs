//! Non-negative least squares in normal form:
//!
//! ```text
//! min 1/2 x' H x - g' x   subject to   x >= 0,   H symmetric positive definite             (1)
//! ```
//!
//! The classic active set method frees the component at zero with the most negative gradient, and solves for the free
//! components without their bounds. Components that turn negative on the way are fixed at zero again. Every step lowers
//! the objective, so the method ends. The factor of the free part of H gains and loses single rows.
//!
//! Source: C. L. Lawson, R. J. Hanson, Solving Least Squares Problems (1974), chapter 23; on the
//! normal equations, R. Bro, S. de Jong, J. Chemometrics 11 (1997) 393; the rows that leave the
//! factor, Golub and Van Loan, Matrix Computations, 4th ed., section 6.5.

use ndarray::{Array2, ArrayView1};

/// A solution of the non-negative least squares problem (1) of the module.
#[derive(Clone, Debug)]
pub struct NonNegative {
    /// Solution x (n).
    pub value: Vec<f64>,
    /// Number of changes of the active set: components freed, or fixed at zero again.
    pub iterations: usize,
    /// Largest violation of the optimality conditions, with `q = H x - g`: `|q_j| / H_jj` of a free
    /// component, and `max(0, -q_j) / H_jj` of a component at zero.
    pub violation: f64,
    /// True if the method ended because no component at zero would grow; false if it ended at its limit of iterations.
    pub converged: bool,
}

/// Solves the non-negative least squares problem (1) of the module; components with `H_jj <= 0` stay 0.
///
/// Ends when no component at zero would grow, that is, with the gradient q = H x - g, if `-q_j <= tolerance max |g|`
/// for all of them, or after about `max_iterations` changes. Components whose columns depend on those of the free ones
/// are left out. Before every change of the active set `watch` gets the largest ratio of the left side to the right
/// one.
pub fn nnls(
    h: &Array2<f64>,
    g: &[f64],
    tolerance: f64,
    max_iterations: usize,
    mut watch: impl FnMut(f64),
) -> NonNegative {
    let n = g.len();
    let floor = tolerance * g.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let mut x = vec![0.0; n];
    let mut free = Free { rows: Vec::new(), members: Vec::new() };
    // Components whose column depends on the free ones; cleared when the free ones change.
    let mut barred = vec![false; n];
    let mut iterations = 0;
    let mut converged = false;
    while iterations < max_iterations {
        let q = gradient(h, g, &x, &free.members);
        let candidate = (0..n)
            .filter(|j| x[*j] == 0.0 && !barred[*j] && h[[*j, *j]] > 0.0 && -q[*j] > floor)
            .min_by(|a, b| q[*a].total_cmp(&q[*b]));
        let Some(j) = candidate else {
            converged = true;
            break;
        };
        watch(-q[j] / floor);
        iterations += 1;
        if !free.add(h, j) {
            barred[j] = true;
            continue;
        }
        let mut wanted = free.solve(g);
        if wanted[free.members.len() - 1] <= 0.0 {
            // Descent by rounding only: the new component would turn negative at once.
            free.remove(free.members.len() - 1);
            barred[j] = true;
            continue;
        }
        barred.fill(false);
        // Move towards the free solution until the first component reaches zero.
        while wanted.iter().any(|v| *v <= 0.0) {
            let fraction = (free.members.iter().zip(&wanted))
                .filter(|(_, w)| **w <= 0.0)
                .map(|(j, w)| x[*j] / (x[*j] - w))
                .fold(1.0, f64::min);
            for (j, w) in free.members.iter().zip(&wanted) {
                x[*j] += fraction * (w - x[*j]);
            }
            for k in (0..free.members.len()).rev() {
                let j = free.members[k];
                if wanted[k] <= 0.0 && x[j] <= 1e-14 * wanted.iter().fold(0.0, |m, v| v.max(m)) {
                    x[j] = 0.0;
                    free.remove(k);
                    iterations += 1;
                }
            }
            wanted = free.solve(g);
        }
        for (j, w) in free.members.iter().zip(&wanted) {
            x[*j] = *w;
        }
    }
    let q = gradient(h, g, &x, &free.members);
    let violation = (0..n)
        .filter(|j| h[[*j, *j]] > 0.0)
        .map(|j| (if x[j] > 0.0 { q[j].abs() } else { (-q[j]).max(0.0) }) / h[[j, j]])
        .fold(0.0, f64::max);
    NonNegative { value: x, iterations, violation, converged }
}

/// Returns the gradient `H x - g`; only the free components `members` of x may differ from zero.
fn gradient(h: &Array2<f64>, g: &[f64], x: &[f64], members: &[usize]) -> Vec<f64> {
    let mut q: Vec<f64> = g.iter().map(|v| -v).collect();
    for &k in members.iter().filter(|k| x[**k] != 0.0) {
        // H is symmetric: its rows are its columns.
        for (q, h) in q.iter_mut().zip(h.row(k)) {
            *q += h * x[k];
        }
    }
    q
}

/// Cholesky factor of the rows and columns of H whose components are free, in the order in which they were freed.
struct Free {
    rows: Vec<Vec<f64>>,
    members: Vec<usize>,
}

impl Free {
    /// Frees component j. Returns false, and changes nothing, if its column depends on those of the free components.
    fn add(&mut self, h: &Array2<f64>, j: usize) -> bool {
        // L l = H[members, j],  d = H_jj - l' l
        let mut row = Vec::with_capacity(self.members.len() + 1);
        for (k, r) in self.rows.iter().enumerate() {
            let sum = ArrayView1::from(&r[..k]).dot(&ArrayView1::from(&row[..]));
            row.push((h[[j, self.members[k]]] - sum) / r[k]);
        }
        let l = ArrayView1::from(&row[..]);
        let d = h[[j, j]] - l.dot(&l);
        // A smaller d is the rounding of the difference.
        if d <= 1e-13 * h[[j, j]] {
            return false;
        }
        row.push(d.sqrt());
        self.rows.push(row);
        self.members.push(j);
        true
    }

    /// Fixes the k-th free component again. Rotations bring the rows below back to triangular form.
    fn remove(&mut self, k: usize) {
        self.rows.remove(k);
        self.members.remove(k);
        for i in k..self.rows.len() {
            // Row i has i + 2 elements; rotate the columns i, i + 1 of it and of those below.
            let a = self.rows[i][i];
            let b = self.rows[i][i + 1];
            let r = a.hypot(b);
            let c = a / r;
            let s = b / r;
            for row in &mut self.rows[i..] {
                let u = row[i];
                let v = row[i + 1];
                row[i] = c * u + s * v;
                row[i + 1] = c * v - s * u;
            }
            self.rows[i].truncate(i + 1);
        }
    }

    /// Returns the solution y of `L L' y = g` for the free components, with the factor L.
    fn solve(&self, g: &[f64]) -> Vec<f64> {
        let mut y: Vec<f64> = Vec::with_capacity(self.members.len());
        for (k, row) in self.rows.iter().enumerate() {
            let sum = ArrayView1::from(&row[..k]).dot(&ArrayView1::from(&y[..]));
            y.push((g[self.members[k]] - sum) / row[k]);
        }
        for (k, row) in self.rows.iter().enumerate().rev() {
            y[k] /= row[k];
            let value = y[k];
            for (y, l) in y.iter_mut().zip(&row[..k]) {
                *y -= l * value;
            }
        }
        y
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        linear::skyline::Skyline,
        qp::bounded::{LastFactor, Quadratic, active_set},
    };
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random_problem(rows: usize, n: usize, ridge: f64, seed: u64) -> (Array2<f64>, Vec<f64>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let a = Array2::from_shape_simple_fn((rows, n), || rng.random_range(-1.0..1.0));
        let g = (0..n).map(|_| rng.random_range(-2.0..2.0)).collect();
        (a.t().dot(&a) + ridge * Array2::<f64>::eye(n), g)
    }

    #[test]
    fn a_diagonal_problem_is_clipped() {
        let h = Array2::from_diag(&ndarray::array![1.0, 4.0, 16.0, 0.0]);
        let found = nnls(&h, &[3.0, -2.0, 4.0, 5.0], 1e-12, 50, |_| ());
        assert_eq!(found.value, [3.0, 0.0, 0.25, 0.0]);
        assert!(found.converged && found.violation == 0.0);
    }

    #[test]
    fn dependent_columns_end_it_at_the_least_residual() {
        // Rank 5 of 12, right-hand side in the range of H: the optimality conditions still hold.
        let (h, _) = random_problem(5, 12, 0.0, 3);
        let planted = ndarray::Array1::from_iter((0..12).map(|j| f64::from(j % 3)));
        let g = h.dot(&planted).to_vec();
        let found = nnls(&h, &g, 1e-11, 500, |_| ());
        // What would grow is below 1e-11 of the largest g, of some ten, over H_jj of the order 1.
        assert!(found.converged && found.violation < 1e-9, "{found:?}");
        assert!(found.value.iter().all(|v| *v >= 0.0));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        /// The conditions hold, and the primal-dual active set method finds the same point.
        #[test]
        fn agrees_with_the_active_set_method(n in 1..40_usize, seed in any::<u64>()) {
            let (h, g) = random_problem(n, n, 0.3, seed);
            let found = nnls(&h, &g, 1e-13, 1000, |_| ());
            prop_assert!(found.converged);
            prop_assert!(found.violation < 1e-10, "{}", found.violation);
            let (lo, hi) = (vec![0.0; n], vec![f64::INFINITY; n]);
            let quadratic = Quadratic { k: Skyline::from_dense(&h), u: Vec::new() };
            let other = active_set(&quadratic, &g, (&lo, &hi), &lo, 0.0, 200, &mut LastFactor::default()).unwrap();
            for j in 0..n {
                // Both at rounding times a condition number below about 1e3.
                prop_assert!((found.value[j] - other.value[j]).abs() < 1e-9);
            }
        }
    }
}
