//! Least squares whose rows couple neighbouring nodes, within bounds.
//!
//! ```text
//! min |J x - r|^2   with   low <= x <= high,   a row of J in the unknowns of two neighbouring nodes
//! ```
//!
//! With some unknowns held at bounds, Givens rotations of the rows solve for the others. The normal equations would
//! contain the squares of entries, which vanish in rounding. Primal-dual active sets find the held unknowns. If the
//! sets repeat, `descend` changes one bound at a time, starting from the solution of an interior point method.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | J, r | `rows` | - | - |
//! | low, high, x | `low`, `high`, `x` | (`unknowns`) | - |

use clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettingsBuilder, DefaultSolver, IPSolver,
        SupportedConeT::{NonnegativeConeT, ZeroConeT},
    },
};

/// Number of unknowns per node of the path: velocity (v), acceleration of the cubics (A) and acceleration (a).
pub(super) const PER_NODE: usize = 3;

/// Number of superdiagonals of the triangular factor: a row has the unknowns of two neighbouring nodes.
const BAND: usize = 5;

/// Largest number of rounds of the active set method. It ends after 4 to 12 on real paths; after 60 it
/// repeats itself. Larger: more factorisations before the slower method begins. Smaller: paths on which
/// the active sets would end are solved by the slower method.
pub(super) const MAX_ROUNDS: usize = 60;

/// Largest number of steps of `descend`, which changes one bound per step; a random path of 60 segments needs some
/// tens. Larger: a hopeless case runs longer. Smaller: the method ends before the minimum, and the caller refuses the
/// result.
const MAX_CHANGES: usize = 2000;

/// Derivative by an unknown over the norm of its column in J that counts as zero, relative to the norm of the
/// right-hand side. Larger: the method ends before the minimum. Smaller: rounding releases bounds without end.
const ROUNDING: f64 = 1e-13;

/// State of an unknown: held at its lower bound, free, or held at its upper bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Side {
    Low,
    Free,
    High,
}

impl Side {
    /// Returns the bound at which an unknown between `low` and `high` is held; `None` if it is free.
    fn bound(self, low: f64, high: f64) -> Option<f64> {
        match self {
            Self::Low => Some(low),
            Self::High => Some(high),
            Self::Free => None,
        }
    }
}

/// Row of the least-squares matrix with its right-hand side: the terms `value[k] x[first + k]` shall add up to `right`.
#[derive(Clone, Copy, Debug)]
pub(super) struct ResidualRow {
    pub(super) first: usize,
    pub(super) value: [f64; 2 * PER_NODE],
    pub(super) right: f64,
}

impl ResidualRow {
    pub(super) fn residual(&self, x: &[f64]) -> f64 {
        let terms = self.value.iter().zip(&x[self.first..]).map(|(c, x)| c * x);
        terms.sum::<f64>() - self.right
    }
}

/// Least-squares problem min |J x - r|^2. The rows ascend in their first unknown `first`.
#[derive(Clone, Debug)]
pub(super) struct LeastSquares {
    pub(super) rows: Vec<ResidualRow>,
    pub(super) unknowns: usize,
}

impl LeastSquares {
    /// Returns the gradient J'(J x - r), and the diagonal of J'J.
    pub(super) fn gradient(&self, x: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let mut gradient = vec![0.0; self.unknowns];
        let mut square = vec![0.0; self.unknowns];
        for row in &self.rows {
            let residual = row.residual(x);
            for (k, c) in row.value.iter().enumerate() {
                gradient[row.first + k] += c * residual;
                square[row.first + k] += c * c;
            }
        }
        (gradient, square)
    }

    /// Returns the relative distance of `x` from the minimum, max_j |J_j| |x_j - clamp(x_j - gradient_j / |J_j|^2)| /
    /// |r|, with J_j the column j of J. It is 0 at the minimum and only there.
    pub(super) fn optimality(&self, low: &[f64], high: &[f64], x: &[f64]) -> f64 {
        let (gradient, square) = self.gradient(x);
        let scale = self.right_norm();
        let steps = (0..self.unknowns).map(|j| {
            let wanted = (x[j] - gradient[j] / square[j]).clamp(low[j], high[j]);
            square[j].sqrt() * (x[j] - wanted).abs()
        });
        let largest = steps.fold(0.0, f64::max);
        // For an axis at rest the right-hand side is zero.
        if largest == 0.0 { 0.0 } else { largest / scale }
    }

    /// Returns the side of every unknown j. It is the bound that the step `-gradient_j / |J_j|^2` to the minimum along
    /// this unknown would exceed, or free. An unknown whose two bounds are equal counts as held at the lower one.
    fn sides(&self, low: &[f64], high: &[f64], x: &[f64]) -> Vec<Side> {
        let (gradient, square) = self.gradient(x);
        (0..self.unknowns)
            .map(|j| {
                let wanted = x[j] - gradient[j] / square[j];
                if low[j] == high[j] || wanted < low[j] {
                    Side::Low
                } else if wanted > high[j] {
                    Side::High
                } else {
                    Side::Free
                }
            })
            .collect()
    }

    /// Returns the minimum by primal-dual active sets, and the number of rounds. A round solves with the unknowns held
    /// on their sides and chooses the sides again, until they no longer change. `side` has the first sides. Returns
    /// `None` if they still change after [`MAX_ROUNDS`], or if the rows are dependent.
    pub(super) fn active_set(
        &self,
        low: &[f64],
        high: &[f64],
        mut side: Vec<Side>,
    ) -> Option<(Vec<f64>, usize)> {
        for j in 0..self.unknowns {
            if low[j] == high[j] {
                side[j] = Side::Low;
            }
        }
        for round in 1..=MAX_ROUNDS {
            let x = self.solve_with_fixed(|j| side[j].bound(low[j], high[j]))?;
            let next = self.sides(low, high, &x);
            if next == side {
                return Some((x, round));
            }
            side = next;
        }
        None
    }

    /// Descends from a feasible `x` to the minimum, and returns it with the number of changes of one bound each; `None`
    /// if the rows are dependent. Each step goes to the solution of the free unknowns, or to the first bound before it,
    /// which is then held. At the solution of the free unknowns it releases the bound with the largest gradient. The
    /// sum of squares never grows. After [`MAX_CHANGES`] it returns the point that it has reached.
    pub(super) fn descend(
        &self,
        low: &[f64],
        high: &[f64],
        x: Vec<f64>,
    ) -> Option<(Vec<f64>, usize)> {
        let mut x = x;
        let mut side = self.sides(low, high, &x);
        for (j, x) in x.iter_mut().enumerate() {
            *x = side[j].bound(low[j], high[j]).unwrap_or(*x);
        }
        let scale = self.right_norm();
        for change in 1..=MAX_CHANGES {
            let wanted = self.solve_with_fixed(|j| side[j].bound(low[j], high[j]))?;
            let mut step = 1.0;
            let mut first = None;
            for j in 0..x.len() {
                let (at, hit) = match wanted[j] {
                    w if w < low[j] => (low[j], Side::Low),
                    w if w > high[j] => (high[j], Side::High),
                    _ => continue,
                };
                let part = (at - x[j]) / (wanted[j] - x[j]);
                if part < step {
                    step = part;
                    first = Some((j, hit));
                }
            }
            if let Some((hit, at)) = first {
                side[hit] = at;
                for (j, x) in x.iter_mut().enumerate() {
                    let moved = *x + step * (wanted[j] - *x);
                    let bound = side[j].bound(low[j], high[j]);
                    *x = bound.unwrap_or_else(|| moved.clamp(low[j], high[j]));
                }
                continue;
            }
            x = (0..x.len()).map(|j| wanted[j].clamp(low[j], high[j])).collect();
            let (gradient, square) = self.gradient(&x);
            let pull = |j: usize| match side[j] {
                _ if low[j] == high[j] => 0.0,
                Side::Low => -gradient[j] / square[j].sqrt(),
                Side::High => gradient[j] / square[j].sqrt(),
                Side::Free => 0.0,
            };
            let most = (0..x.len()).max_by(|a, b| pull(*a).total_cmp(&pull(*b)))?;
            if pull(most) <= ROUNDING * scale {
                return Some((x, change));
            }
            side[most] = Side::Free;
        }
        Some((x, MAX_CHANGES))
    }

    /// Returns the norm |r| of the right-hand side.
    fn right_norm(&self) -> f64 {
        self.rows.iter().map(|row| row.right * row.right).sum::<f64>().sqrt()
    }

    /// Solves for the unknowns for which `fixed` returns `None`; the others keep the value that it returns. Givens
    /// rotations bring the rows into a banded upper triangle; back substitution follows. Returns `None` if the rows are
    /// dependent.
    fn solve_with_fixed(&self, fixed: impl Fn(usize) -> Option<f64>) -> Option<Vec<f64>> {
        let n = self.unknowns;
        let value: Vec<Option<f64>> = (0..n).map(fixed).collect();
        // Row k: the columns k, k+1, ...; then the right-hand side.
        let mut triangle = vec![[0.0_f64; BAND + 1]; n];
        let mut right = vec![0.0; n];
        for row in &self.rows {
            let mut c = row.value;
            let mut b = row.right;
            for (k, c) in c.iter_mut().enumerate() {
                if let Some(value) = value[row.first + k] {
                    b -= *c * value;
                    *c = 0.0;
                }
            }
            for k in 0..c.len() {
                if c[k] == 0.0 {
                    continue;
                }
                let own = &mut triangle[row.first + k];
                let size = own[0].hypot(c[k]);
                let (cosine, sine) = (own[0] / size, c[k] / size);
                for l in k..c.len() {
                    let (upper, lower) = (own[l - k], c[l]);
                    own[l - k] = cosine * upper + sine * lower;
                    c[l] = cosine * lower - sine * upper;
                }
                let (upper, lower) = (right[row.first + k], b);
                right[row.first + k] = cosine * upper + sine * lower;
                b = cosine * lower - sine * upper;
            }
        }
        let mut x = vec![0.0; n];
        for k in (0..n).rev() {
            x[k] = match value[k] {
                Some(value) => value,
                None => {
                    let later = (1..=BAND.min(n - 1 - k)).map(|d| triangle[k][d] * x[k + d]);
                    (right[k] - later.sum::<f64>()) / triangle[k][0]
                }
            };
        }
        if x.iter().all(|x| x.is_finite()) { Some(x) } else { None }
    }

    /// Returns the minimum by the interior point solver Clarabel, to its tolerance of 1e-8, moved into the bounds;
    /// zeros if the solver cannot start. The problem is min |z|^2/2 with J x - z = r.
    pub(super) fn interior_point(&self, low: &[f64], high: &[f64]) -> Vec<f64> {
        let n = self.unknowns;
        let m = self.rows.len();
        let mut r = Vec::new();
        let mut c = Vec::new();
        let mut v = Vec::new();
        let mut bound = Vec::new();
        for (i, row) in self.rows.iter().enumerate() {
            for (k, value) in row.value.iter().enumerate().filter(|(_, value)| **value != 0.0) {
                r.push(i);
                c.push(row.first + k);
                v.push(*value);
            }
            r.push(i);
            c.push(n + i);
            v.push(-1.0);
            bound.push(row.right);
        }
        for j in 0..n {
            for (limit, sign) in [(high[j], 1.0), (low[j], -1.0)] {
                if limit.is_finite() {
                    r.push(bound.len());
                    c.push(j);
                    v.push(sign);
                    bound.push(sign * limit);
                }
            }
        }
        let a = CscMatrix::new_from_triplets(bound.len(), n + m, r, c, v);
        let residuals: Vec<usize> = (n..n + m).collect();
        let p =
            CscMatrix::new_from_triplets(n + m, n + m, residuals.clone(), residuals, vec![1.0; m]);
        let settings = DefaultSettingsBuilder::default().verbose(false).build().expect("valid");
        let cones = [ZeroConeT(m), NonnegativeConeT(bound.len() - m)];
        let q = vec![0.0; n + m];
        let Ok(mut solver) = DefaultSolver::new(&p, &q, &a, &bound, &cones, settings) else {
            return vec![0.0; n];
        };
        solver.solve();
        // Any point within the bounds is a start for `descend`, also the last point of a run that did not
        // converge.
        let solution = solver.solution.x[..n].iter().zip(low.iter().zip(high));
        solution
            .map(|(x, (low, high))| if x.is_finite() { x.clamp(*low, *high) } else { 0.0 })
            .collect()
    }
}
