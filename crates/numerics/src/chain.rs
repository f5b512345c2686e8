//! Convex quadratic programs on a chain, where every bound couples two neighbours at most:
//!
//! ```text
//! min 1/2 x' P x - c' x + p' e                                                          (1)
//! subject to  a0 x_i + a1 x_{i+1} - k e_i <= b   for the rows of link i,   e >= 0
//! ```
//!
//! `P` is tridiagonal and positive definite; `x_i` and `x_{i+1}` are the ends of link `i`. Without
//! prices `p` there is no `e` and the rows are hard; with them a row may be exceeded by `k e_i`.
//!
//! The method is Mehrotra's predictor-corrector interior point method (SIAM J. Optim. 2 (1992)
//! 575). With the slacks `s = b - G x`, the multipliers `l` and `D = diag(l / s)`, a step solves
//!
//! ```text
//! (P + G' D G) dx = -r_d + G' (r_c / s - D r_p)                                         (2)
//! ds = -r_p - G dx,   dl = -(r_c + l ds) / s
//! r_d = P x - c + G' l,   r_p = G x + s - b,   r_c = s l + ds dl - sigma mu
//! ```
//!
//! and since a row couples neighbours only, the matrix of (2) is tridiagonal: time and memory of
//! an iteration are proportional to the length of the chain. The `e_i` of a link is eliminated
//! within the link; what is left is a sum of squares again, without a difference,
//!
//! ```text
//! sum_j D_j (a_j - k_j m) (a_j - k_j m)',   m = sum_j D_j k_j a_j / sum_j D_j k_j^2      (3)
//! ```

/// Program (1) with n variables and n - 1 links.
#[derive(Clone, Debug, Default)]
pub struct Program {
    /// P_ii (n); > 0.
    pub diagonal: Vec<f64>,
    /// P_{i,i+1} (n-1).
    pub beside: Vec<f64>,
    /// c (n).
    pub linear: Vec<f64>,
    /// Whether the variable is free (n); the others are zero.
    pub free: Vec<bool>,
    /// Bounds, in ascending order of their links.
    pub rows: Vec<Row>,
    /// p (n-1), > 0; or empty: the rows are hard.
    pub price: Vec<f64>,
}

/// `a[0] x_link + a[1] x_{link+1} - slack e_link <= bound`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// i.
    pub link: usize,
    /// a0, a1.
    pub a: [f64; 2],
    /// k; >= 0.
    pub slack: f64,
    /// b.
    pub bound: f64,
}

/// Why there is no solution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Failure {
    /// The rows contradict each other: some `l >= 0` has `G' l = 0` and `b' l < 0`.
    Infeasible,
    /// The iteration did not reach the tolerance.
    NotConverged,
}

/// r_p and mean complementarity at the end, in units in which P has a unit diagonal and the
/// largest linear term is 1. The error of y at a row that is only just active is its root.
const TOLERANCE: f64 = 1e-14;

/// r_d at the end, an error of the same size in y. Its rounding is that of `D r`, where D is up to
/// 1 / [`TOLERANCE`] at an active row.
const DUAL_TOLERANCE: f64 = 1e-9;

/// What r_p and the complementarity may be where rounding ends the iteration early.
const ACCEPTED: f64 = 1e-9;

/// Most iterations. Programs of 1e6 links take 20 to 40.
const MAX_ITERATIONS: usize = 150;

/// x of (1).
pub fn solve(program: &Program) -> Result<Vec<f64>, Failure> {
    let n = program.diagonal.len();
    // x = w y with w_i = unit / sqrt(P_ii): a unit diagonal, the largest linear term 1.
    let root: Vec<f64> = program.diagonal.iter().map(|d| 1.0 / d.sqrt()).collect();
    let free = (0..n).filter(|i| program.free[*i]);
    let unit = free.map(|i| (program.linear[i] * root[i]).abs()).fold(0.0, f64::max);
    let unit = if unit > 0.0 { unit } else { 1.0 };
    let w: Vec<f64> = (0..n).map(|i| if program.free[i] { unit * root[i] } else { 0.0 }).collect();
    let scaled = Scaled::new(program, &w, unit)?;
    let y = scaled.solve()?;
    Ok(y.iter().zip(&w).map(|(y, w)| y * w).collect())
}

/// (1) in the variables y, rows with a largest coefficient of 1, the objective divided so that no
/// price is above 1. Variables that are not free have no coefficient but the one on the diagonal.
struct Scaled {
    /// P_ii, all the same; 1 without prices.
    diagonal: f64,
    beside: Vec<f64>,
    linear: Vec<f64>,
    price: Vec<f64>,
    rows: Vec<Row>,
    /// Rows of link i: start[i] .. start[i+1].
    start: Vec<usize>,
}

/// The iterate.
struct Point {
    y: Vec<f64>,
    e: Vec<f64>,
    s: Vec<f64>,
    l: Vec<f64>,
}

/// r_d for y and e, r_p, and what decides on the end.
#[derive(Default)]
struct Residual {
    dual: Vec<f64>,
    dual_e: Vec<f64>,
    primal: Vec<f64>,
    /// Mean complementarity.
    mu: f64,
    /// Largest |r_d|.
    largest_dual: f64,
    /// Largest |r_p| and complementarity.
    largest: f64,
}

/// A step.
#[derive(Default)]
struct Step {
    y: Vec<f64>,
    e: Vec<f64>,
    s: Vec<f64>,
    l: Vec<f64>,
}

/// The matrix of (2), factorised, with what the elimination of e left per link.
#[derive(Default)]
struct Factor {
    /// D_ii of L D L'.
    pivot: Vec<f64>,
    /// L_{i+1,i}.
    below: Vec<f64>,
    /// m of (3).
    mean: Vec<[f64; 2]>,
    /// 1 / sum_j D_j k_j^2.
    inverse: Vec<f64>,
}

impl Scaled {
    fn new(program: &Program, w: &[f64], unit: f64) -> Result<Self, Failure> {
        let links = program.beside.len();
        let elastic = !program.price.is_empty();
        let highest = program.price.iter().copied().fold(0.0, f64::max) / (unit * unit);
        // The objective is divided by unit^2 (1 + highest price).
        let diagonal = 1.0 / (1.0 + highest);
        let root = |i: usize| w[i] / unit;
        let beside = (0..links).map(|i| diagonal * program.beside[i] * root(i) * root(i + 1));
        let linear = program.linear.iter().enumerate().map(|(i, c)| diagonal * c * root(i) / unit);
        let mut rows = Vec::with_capacity(program.rows.len() + program.price.len());
        let mut start = vec![0];
        let mut next = program.rows.iter().peekable();
        for link in 0..links {
            while let Some(row) = next.next_if(|r| r.link == link) {
                let a = [row.a[0] * w[link], row.a[1] * w[link + 1]];
                let slack = if elastic { row.slack } else { 0.0 };
                let size = a[0].abs().max(a[1].abs()).max(slack);
                if size > 0.0 {
                    let bound = row.bound / size;
                    rows.push(Row { link, a: a.map(|a| a / size), slack: slack / size, bound });
                } else if row.bound < 0.0 {
                    return Err(Failure::Infeasible);
                }
            }
            if elastic && rows.len() > start[link] {
                rows.push(Row { link, a: [0.0; 2], slack: 1.0, bound: 0.0 }); // e >= 0
            }
            start.push(rows.len());
        }
        debug_assert!(next.next().is_none(), "rows are in the order of the links");
        let price = program.price.iter().map(|p| diagonal * p / (unit * unit)).collect();
        Ok(Self {
            diagonal,
            beside: beside.collect(),
            linear: linear.collect(),
            price,
            rows,
            start,
        })
    }

    fn links(&self) -> usize {
        self.beside.len()
    }

    fn rows_of(&self, link: usize) -> std::ops::Range<usize> {
        self.start[link]..self.start[link + 1]
    }

    fn e_of(&self, e: &[f64], link: usize) -> f64 {
        e.get(link).copied().unwrap_or(0.0)
    }

    /// G (y, e), row by row.
    fn product(&self, y: &[f64], e: &[f64], product: &mut Vec<f64>) {
        product.clear();
        product.extend(
            self.rows.iter().map(|r| {
                r.a[0] * y[r.link] + r.a[1] * y[r.link + 1] - r.slack * self.e_of(e, r.link)
            }),
        );
    }

    fn solve(&self) -> Result<Vec<f64>, Failure> {
        let (n, m) = (self.linear.len(), self.rows.len());
        let mut at = Point {
            y: vec![0.0; n],
            e: vec![0.0; self.price.len()],
            s: Vec::new(),
            l: vec![1.0; m],
        };
        // The free minimiser is a good start.
        let mut factor = Factor::default();
        factor.update(self, None);
        at.y.clone_from(&self.linear);
        factor.substitute(&mut at.y);
        if m == 0 {
            return Ok(at.y);
        }
        self.product(&at.y, &at.e, &mut at.s);
        at.s.iter_mut().zip(&self.rows).for_each(|(s, r)| *s = (r.bound - *s).max(1.0));
        // Filled anew in every iteration: a long chain would spend as much time on fresh pages.
        let (mut r, mut step) = (Residual::default(), Step::default());
        let mut target = vec![0.0; m];
        // The last point that would be accepted: rounding may spoil the next.
        let mut accepted = None;
        let mut lowest = f64::INFINITY;
        for _ in 0..MAX_ITERATIONS {
            self.residual(&at, &mut r);
            if r.is_within(TOLERANCE) {
                return Ok(at.y);
            }
            if r.is_within(ACCEPTED) {
                accepted = Some(at.y.clone());
            } else if accepted.is_some() || !r.largest.is_finite() {
                break;
            }
            if self.is_infeasible(&at) {
                return Err(Failure::Infeasible);
            }
            factor.update(self, Some(&at));
            // Predictor: sigma = 0, no second-order term.
            (0..m).for_each(|j| target[j] = at.s[j] * at.l[j]);
            self.step(&factor, &at, &r, &target, &mut step);
            let a = at.longest(&step).min(1.0);
            let after: f64 =
                (0..m).map(|j| (at.s[j] + a * step.s[j]) * (at.l[j] + a * step.l[j])).sum::<f64>()
                    / m as f64;
            let sigma = (after / r.mu).powi(3);
            // Corrector. Where mu did not fall the second-order term can make the iteration go in
            // circles: then a step towards the centre without it.
            let (second, sigma) = if r.mu < 0.9 * lowest { (1.0, sigma) } else { (0.0, 0.3) };
            lowest = lowest.min(r.mu);
            for (j, target) in target.iter_mut().enumerate() {
                *target = at.s[j] * at.l[j] + second * step.s[j] * step.l[j] - sigma * r.mu;
            }
            self.step(&factor, &at, &r, &target, &mut step);
            let a = (at.longest(&step) * (1.0 - r.mu).clamp(0.995, 0.9999)).min(1.0);
            if a.is_nan() || a <= 1e-13 {
                break;
            }
            at.advance(&step, a);
        }
        accepted.ok_or(Failure::NotConverged)
    }

    fn residual(&self, at: &Point, r: &mut Residual) {
        let n = at.y.len();
        let Residual { dual, dual_e, primal, .. } = r;
        // r_d = P y - c + G' l
        dual.clear();
        dual.extend((0..n).map(|i| self.diagonal * at.y[i] - self.linear[i]));
        for i in 0..self.links() {
            dual[i] += self.beside[i] * at.y[i + 1];
            dual[i + 1] += self.beside[i] * at.y[i];
        }
        dual_e.clone_from(&self.price);
        self.product(&at.y, &at.e, primal);
        let (mut mu, mut largest) = (0.0, 0.0_f64);
        for link in 0..self.links() {
            for j in self.rows_of(link) {
                let (row, s, l) = (&self.rows[j], at.s[j], at.l[j]);
                dual[link] += row.a[0] * l;
                dual[link + 1] += row.a[1] * l;
                if let Some(d) = dual_e.get_mut(link) {
                    *d -= row.slack * l;
                }
                primal[j] += s - row.bound;
                // Its rounding is that of a sum of numbers of order 1.
                let rounding = 16.0 * f64::EPSILON * (1.0 + row.bound.abs() + s);
                largest = worse(largest, primal[j].abs() - rounding);
                mu += s * l;
            }
            if self.rows_of(link).is_empty()
                && let Some(d) = dual_e.get_mut(link)
            {
                *d = 0.0; // no row, no e
            }
        }
        mu /= self.rows.len() as f64;
        largest = worse(largest, mu);
        let largest_dual = dual.iter().map(|d| d.abs()).fold(0.0, worse);
        let largest_dual = dual_e.iter().map(|d| d.abs()).fold(largest_dual, worse);
        (r.mu, r.largest_dual, r.largest) = (mu, largest_dual, largest);
    }

    /// Whether the multipliers prove that no point satisfies the rows.
    fn is_infeasible(&self, at: &Point) -> bool {
        if !self.price.is_empty() {
            return false; // a large e satisfies all
        }
        let gain: f64 = -self.rows.iter().zip(&at.l).map(|(r, l)| r.bound * l).sum::<f64>();
        let total: f64 = at.l.iter().sum();
        if gain <= 1e-9 * total {
            return false;
        }
        let mut sum = vec![0.0; at.y.len()];
        for (r, l) in self.rows.iter().zip(&at.l) {
            sum[r.link] += r.a[0] * l;
            sum[r.link + 1] += r.a[1] * l;
        }
        // Any y with G y <= b has  -gain >= sum . y >= -largest |y|_1: it would be huge.
        let largest = sum.iter().map(|v| v.abs()).fold(0.0, f64::max);
        largest < 1e-10 * gain
    }

    /// The solution of (2) with the given r_c.
    fn step(&self, factor: &Factor, at: &Point, r: &Residual, target: &[f64], step: &mut Step) {
        let Step { y, e, s, l } = step;
        y.clear();
        y.extend(r.dual.iter().map(|v| -v));
        e.clear();
        e.resize(self.price.len(), 0.0);
        for link in 0..self.links() {
            let rows = self.rows_of(link);
            if rows.is_empty() {
                continue;
            }
            let mut right_e = -r.dual_e.get(link).copied().unwrap_or(0.0);
            for j in rows {
                let row = &self.rows[j];
                let v = (target[j] - at.l[j] * r.primal[j]) / at.s[j];
                y[link] += row.a[0] * v;
                y[link + 1] += row.a[1] * v;
                right_e -= row.slack * v;
            }
            if let Some(e) = e.get_mut(link) {
                // M_ye = -sum D a k, and M_ye / M_ee = -m
                let m = factor.mean[link];
                y[link] += m[0] * right_e;
                y[link + 1] += m[1] * right_e;
                *e = right_e;
            }
        }
        factor.substitute(y);
        for (link, e) in e.iter_mut().enumerate() {
            // M_ee de = right_e - M_ey dy
            let m = factor.mean[link];
            *e = *e * factor.inverse[link] + m[0] * y[link] + m[1] * y[link + 1];
        }
        self.product(y, e, s);
        s.iter_mut().zip(&r.primal).for_each(|(s, p)| *s = -p - *s);
        l.clear();
        l.extend((0..s.len()).map(|j| -(target[j] + at.l[j] * s[j]) / at.s[j]));
    }
}

/// The larger; NaN is the largest of all.
fn worse(a: f64, b: f64) -> f64 {
    if a >= b || a.is_nan() { a } else { b }
}

impl Residual {
    fn is_within(&self, tolerance: f64) -> bool {
        self.largest <= tolerance && self.largest_dual <= DUAL_TOLERANCE.max(tolerance)
    }
}

impl Point {
    /// Largest step that keeps s and l at least zero.
    fn longest(&self, step: &Step) -> f64 {
        let limit = |v: &[f64], d: &[f64]| {
            v.iter().zip(d).filter(|(_, d)| **d < 0.0).map(|(v, d)| -v / d).fold(1e30, f64::min)
        };
        limit(&self.s, &step.s).min(limit(&self.l, &step.l))
    }

    fn advance(&mut self, step: &Step, a: f64) {
        let add = |v: &mut [f64], d: &[f64]| v.iter_mut().zip(d).for_each(|(v, d)| *v += a * d);
        add(&mut self.y, &step.y);
        add(&mut self.e, &step.e);
        add(&mut self.s, &step.s);
        add(&mut self.l, &step.l);
    }
}

impl Factor {
    /// P + G' D G, or P alone.
    fn update(&mut self, program: &Scaled, at: Option<&Point>) {
        let n = program.linear.len();
        let Self { pivot, below, mean, inverse } = self;
        pivot.clear();
        pivot.resize(n, program.diagonal);
        below.clone_from(&program.beside);
        let elastic = program.price.len();
        mean.clear();
        mean.resize(elastic, [0.0; 2]);
        inverse.clear();
        inverse.resize(elastic, 0.0);
        for link in (0..program.links()).filter(|_| at.is_some()) {
            let Some(at) = at else { continue };
            let rows = program.rows_of(link);
            let weight = |j: usize| at.l[j] / at.s[j];
            let mut m = [0.0; 2];
            if elastic > 0 && !rows.is_empty() {
                let (mut cross, mut square) = ([0.0; 2], 0.0);
                for j in rows.clone() {
                    let (row, d) = (&program.rows[j], weight(j));
                    cross[0] += d * row.slack * row.a[0];
                    cross[1] += d * row.slack * row.a[1];
                    square += d * row.slack * row.slack;
                }
                m = cross.map(|c| c / square);
                mean[link] = m;
                inverse[link] = 1.0 / square;
            }
            for j in rows {
                let (row, d) = (&program.rows[j], weight(j));
                let a = [row.a[0] - row.slack * m[0], row.a[1] - row.slack * m[1]];
                pivot[link] += d * a[0] * a[0];
                pivot[link + 1] += d * a[1] * a[1];
                below[link] += d * a[0] * a[1];
            }
        }
        // L D L': the next pivot loses what the elimination of this one takes.
        for i in 0..below.len() {
            let factor = below[i] / pivot[i];
            pivot[i + 1] -= factor * below[i];
            below[i] = factor;
        }
    }

    fn substitute(&self, y: &mut [f64]) {
        for i in 0..self.below.len() {
            y[i + 1] -= self.below[i] * y[i];
        }
        y.iter_mut().zip(&self.pivot).for_each(|(y, p)| *y /= p);
        for i in (0..self.below.len()).rev() {
            y[i] -= self.below[i] * y[i + 1];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clarabel::{
        algebra::CscMatrix,
        solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT},
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Bounds of both signs around a known point, so that hard rows have a solution.
    fn random(n: usize, elastic: bool, rng: &mut ChaCha8Rng) -> Program {
        let size: Vec<f64> = (0..n).map(|_| 10.0_f64.powf(rng.random_range(-1.5..1.5))).collect();
        let inside: Vec<f64> = (0..n).map(|i| rng.random_range(-1.0..1.0) / size[i]).collect();
        let free: Vec<bool> = (0..n).map(|_| rng.random_range(0.0..1.0) < 0.9).collect();
        let mut program = Program {
            diagonal: size.iter().map(|s| 4.0 * s * s).collect(),
            beside: size.windows(2).map(|s| s[0] * s[1]).collect(),
            linear: size.iter().map(|s| rng.random_range(-9.0..9.0) * s).collect(),
            free,
            ..Program::default()
        };
        for link in 0..n - 1 {
            for _ in 0..rng.random_range(0..5) {
                let a = [size[link], size[link + 1]].map(|s| rng.random_range(-1.0..1.0) * s);
                let at =
                    (0..2).map(|k| a[k] * inside[link + k] * f64::from(program.free[link + k]));
                let room =
                    if elastic { rng.random_range(-0.5..0.3) } else { rng.random_range(0.0..0.3) };
                program.rows.push(Row { link, a, slack: 1.0, bound: at.sum::<f64>() + room });
            }
        }
        if elastic {
            program.price = (1..n).map(|_| rng.random_range(3.0..30.0)).collect();
        }
        program
    }

    /// The same by a general conic solver.
    fn clarabel(program: &Program) -> Option<Vec<f64>> {
        let (n, elastic) = (program.diagonal.len(), !program.price.is_empty());
        let variables = n + program.price.len();
        let mut p: Vec<(usize, usize, f64)> =
            program.diagonal.iter().enumerate().map(|(i, d)| (i, i, *d)).collect();
        p.extend(program.beside.iter().enumerate().map(|(i, b)| (i, i + 1, *b)));
        let mut q: Vec<f64> = program.linear.iter().map(|c| -c).collect();
        q.extend(&program.price);
        let (mut a, mut b) = (Vec::new(), Vec::new());
        for i in (0..n).filter(|i| !program.free[*i]) {
            a.push((b.len(), i, 1.0));
            b.push(0.0);
        }
        let fixed = b.len();
        for row in &program.rows {
            a.push((b.len(), row.link, row.a[0]));
            a.push((b.len(), row.link + 1, row.a[1]));
            if elastic {
                a.push((b.len(), n + row.link, -row.slack));
            }
            b.push(row.bound);
        }
        for i in 0..program.price.len() {
            a.push((b.len(), n + i, -1.0));
            b.push(0.0);
        }
        let matrix = |t: &[(usize, usize, f64)], rows: usize| {
            let (r, (c, v)) = t.iter().map(|(r, c, v)| (*r, (*c, *v))).unzip();
            CscMatrix::new_from_triplets(rows, variables, r, c, v)
        };
        let settings = DefaultSettingsBuilder::default()
            .verbose(false)
            .tol_gap_rel(1e-12)
            .tol_gap_abs(1e-10)
            .tol_feas(1e-10)
            .build()
            .unwrap();
        let cones =
            [SupportedConeT::ZeroConeT(fixed), SupportedConeT::NonnegativeConeT(b.len() - fixed)];
        let (p, a) = (matrix(&p, variables), matrix(&a, b.len()));
        let mut solver = DefaultSolver::new(&p, &q, &a, &b, &cones, settings).unwrap();
        solver.solve();
        let solved = matches!(solver.solution.status, SolverStatus::Solved);
        solved.then(|| solver.solution.x[..n].to_vec())
    }

    #[test]
    fn agrees_with_a_general_conic_solver() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut compared = 0;
        for case in 0..200 {
            let program = random(2 + case % 40, case % 2 == 1, &mut rng);
            let Some(expected) = clarabel(&program) else { continue };
            let found = solve(&program).unwrap();
            compared += 1;
            for i in 0..found.len() {
                // Its gap of 1e-10, or 1e-12 of an objective of up to 1e3, bounds half the square
                // of the error in units of 1 / sqrt(P_ii).
                let error = (found[i] - expected[i]).abs() * program.diagonal[i].sqrt();
                assert!(error < 5e-5, "case {case}, variable {i}: {error}");
            }
        }
        assert!(compared > 190, "{compared}");
    }

    #[test]
    fn without_active_rows_it_is_the_tridiagonal_solution() {
        // [4 1; 1 4] x = [9 9]: 1.8 each; the ends are not free.
        let program = Program {
            diagonal: vec![4.0; 4],
            beside: vec![1.0; 3],
            linear: vec![7.0, 9.0, 9.0, 7.0],
            free: vec![false, true, true, false],
            rows: vec![Row { link: 1, a: [1.0, 1.0], slack: 0.0, bound: 5.0 }],
            price: Vec::new(),
        };
        let x = solve(&program).unwrap();
        assert!(x.iter().zip([0.0, 1.8, 1.8, 0.0]).all(|(x, e)| (x - e).abs() < 1e-11), "{x:?}");
        // With x1 + x2 <= 3 both lose the same.
        let mut tight = program;
        tight.rows[0].bound = 3.0;
        let x = solve(&tight).unwrap();
        assert!((x[1] - 1.5).abs() < 1e-11 && (x[2] - 1.5).abs() < 1e-11, "{x:?}");
        // At a price of 1 the row x1 + x2 - e <= 3 is kept or broken as the multiplier says: it
        // is 9 - 5 * 1.5 = 1.5 at the hard bound. Above: hard. Below: 5 x = 9 - price.
        for (price, expected) in [(2.0, 1.5), (1.0, 1.6)] {
            tight.rows[0].slack = 1.0;
            tight.price = vec![price; 3];
            let x = solve(&tight).unwrap();
            assert!((x[1] - expected).abs() < 1e-10, "{price}: {x:?}");
        }
    }

    #[test]
    fn contradictions_are_found() {
        let mut program = Program {
            diagonal: vec![1.0; 3],
            beside: vec![0.1; 2],
            linear: vec![1.0; 3],
            free: vec![true; 3],
            rows: vec![
                Row { link: 0, a: [1.0, 0.5], slack: 1.0, bound: -1.0 },
                Row { link: 0, a: [-1.0, -0.5], slack: 1.0, bound: 0.99 },
            ],
            price: Vec::new(),
        };
        assert_eq!(solve(&program), Err(Failure::Infeasible));
        program.rows[1].bound = 1.01;
        assert!(solve(&program).is_ok());
        program.rows[1] = Row { link: 1, a: [0.0; 2], slack: 1.0, bound: -1e-3 };
        assert_eq!(solve(&program), Err(Failure::Infeasible));
        program.price = vec![1.0; 2];
        assert!(solve(&program).is_ok());
    }

    #[test]
    fn the_solution_does_not_depend_on_units_or_direction() {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        for case in 0..20 {
            let program = random(30, case % 2 == 1, &mut rng);
            let x = solve(&program).unwrap();
            let mut other = program.clone();
            // x in other units: P / 64, c / 8, a / 8; the objective a thousand times as large.
            other.diagonal.iter_mut().chain(&mut other.beside).for_each(|v| *v *= 1000.0 / 64.0);
            other.linear.iter_mut().for_each(|v| *v *= 1000.0 / 8.0);
            other.price.iter_mut().for_each(|v| *v *= 1000.0);
            other.rows.iter_mut().for_each(|r| r.a = r.a.map(|a| a / 8.0));
            let y = solve(&other).unwrap();
            for i in 0..30 {
                let (d, x) = (program.diagonal[i].sqrt(), x[i]);
                // The stop is at 1e-12 of the complementarity; its root in x where a row is only
                // just active.
                assert!((y[i] / 8.0 - x).abs() * d < 1e-5, "{} {x}", y[i] / 8.0);
            }
            other = program.clone();
            for v in [&mut other.diagonal, &mut other.beside, &mut other.linear, &mut other.price] {
                v.reverse();
            }
            other.free.reverse();
            other.rows.reverse();
            other.rows.iter_mut().for_each(|r| {
                r.link = 28 - r.link;
                r.a.reverse();
            });
            let y = solve(&other).unwrap();
            for i in 0..30 {
                let error = (y[29 - i] - x[i]).abs() * program.diagonal[i].sqrt();
                assert!(error < 1e-5, "{case} {i} {error}");
            }
        }
    }
}
