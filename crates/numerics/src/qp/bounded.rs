//! Bounded least squares in normal form:
//!
//! ```text
//! min 1/2 t' H t - g' t   subject to   lo <= t <= hi,   H symmetric positive definite     (1)
//! ```
//!
//! There are three algorithms and one certificate. With the gradient `q = H t - g`, `t` is the
//! solution if and only if no component moves in a projected step. The *natural residual*
//!
//! ```text
//! max_j | t_j - clip(t_j - q_j / H_jj, lo_j, hi_j) |                                      (2)
//! ```
//!
//! is zero there. Elsewhere it is the largest move of a component in such a step.

use crate::linear::{
    power::power_method,
    skyline::{Skyline, dot},
    woodbury::Woodbury,
};

/// Number of steps of the power method for the largest eigenvalue of the scaled H, which bounds the steps of
/// [`projected_gradient`]. Larger: more products. Smaller: a lower estimate, so that [`EIGENVALUE_MARGIN`] may not
/// cover its error.
const POWER_STEPS: usize = 40;

/// Factor on the estimate of the largest eigenvalue, which is a lower bound, to make it an upper
/// one. Larger: shorter steps. Smaller: steps that are too long, so that the iteration may diverge.
const EIGENVALUE_MARGIN: f64 = 1.02;

/// Number of steps of [`projected_gradient`] between two tests of convergence. A test takes one more product with H.
/// Larger: more steps than necessary. Smaller: more tests.
const STEPS_BETWEEN_LOOKS: usize = 50;

/// Number of steps of [`projected_gradient`] that a caller should do after an active set method has failed. Larger:
/// more time. Smaller: less progress.
pub const DESCENT_STEPS: usize = 300;

/// Number of products with H without a smaller `r' z` after which [`conjugate_gradients`] has reached the rounding of
/// its coarse solutions and ends. Larger: more products without an effect. Smaller: it ends in a plateau.
const PRODUCTS_WITHOUT_PROGRESS: usize = 60;

/// Number of factorisations without a smaller natural residual after which [`active_set`] is
/// cycling. Larger: more factorisations of a cycle. Smaller: the slow rule of single components
/// begins without need.
const CYCLING_AFTER: usize = 10;

/// Matrix `H = K - U U'` (n, n) of the quadratic program: a skyline matrix less a few outer products.
#[derive(Clone, Debug)]
pub struct Quadratic {
    /// Matrix K (n, n), positive definite.
    pub k: Skyline,
    /// Columns of the matrix U, n elements each.
    pub u: Vec<Vec<f64>>,
}

impl Quadratic {
    /// Returns the product `H t` (n) for a vector t (n).
    pub fn product(&self, t: &[f64]) -> Vec<f64> {
        let mut h_t = self.k.product(t);
        for u in &self.u {
            let c = dot(u, t);
            h_t.iter_mut().zip(u).for_each(|(h, u)| *h -= u * c);
        }
        h_t
    }

    /// Returns the diagonal of H (n).
    pub fn diagonal(&self) -> Vec<f64> {
        (0..self.k.len())
            .map(|j| self.k.diagonal(j) - self.u.iter().map(|u| u[j] * u[j]).sum::<f64>())
            .collect()
    }

    /// Returns the solution x of `H_II x = r`, where H_II has the rows and columns I = `keep` of H. `last` keeps the
    /// factor for the next call. `None` if H_II is not positive definite.
    fn solve(&self, keep: &[usize], mut r: Vec<f64>, last: &mut LastFactor) -> Option<Vec<f64>> {
        if last.0.as_ref().is_none_or(|(set, _)| set != keep) {
            // The last factor is dropped first, so that only one is in memory.
            last.0 = None;
            let factor = self.k.principal(keep).factorise()?;
            let u: Vec<Vec<f64>> =
                self.u.iter().map(|u| keep.iter().map(|j| u[*j]).collect()).collect();
            last.0 = Some((keep.to_vec(), Woodbury::new(factor, &u)?));
        }
        last.0.as_ref()?.1.solve(&mut r);
        Some(r)
    }
}

/// The last set I of free components that [`active_set`] solved for, and the factor of its submatrix H_II. It can be
/// used again for another g with the same H, if the set of free components is the same. This is soon so if one solution
/// is corrected by another.
#[derive(Debug, Default)]
pub struct LastFactor(Option<(Vec<usize>, Woodbury)>);

/// A candidate solution of the bounded least squares problem (1) of the module.
#[derive(Clone, Debug)]
pub struct Solution {
    /// Candidate t (n), within the bounds.
    pub value: Vec<f64>,
    /// Natural residual (2) of the module: the largest move of a component in a projected step, in the unit of t.
    pub natural_residual: f64,
    /// Number of iterations. By [`active_set`]: sets of free components up to the one that gave `value`. By
    /// [`active_set_by_products`]: products with H. By [`projected_gradient`]: steps.
    pub iterations: usize,
    /// Reason why the iteration ended.
    pub end: End,
}

/// Reason why an iteration ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The natural residual is within the tolerance, or the sets of components at their bounds repeat.
    Optimal,
    /// The objective no longer falls by enough between two tests.
    Stagnated,
    /// The allowed iterations are used up.
    IterationLimit,
}

/// Returns the natural residual (2) of the module at `t`, with the gradient H t - g and the diagonal of H, over the
/// components with H_jj > 0.
pub fn natural_residual(
    t: &[f64],
    gradient: &[f64],
    diagonal: &[f64],
    lo: &[f64],
    hi: &[f64],
) -> f64 {
    (0..t.len())
        .filter(|j| diagonal[*j] > 0.0)
        .map(|j| (t[j] - (t[j] - gradient[j] / diagonal[j]).clamp(lo[j], hi[j])).abs())
        .fold(0.0, f64::max)
}

/// Solves the bounded least squares problem (1) of the module by the primal-dual active set method, for an H that can
/// be factorised.
///
/// Source: Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002) 865, algorithm of section 2. The sets of components at
/// a bound are guessed from `t - q / c`, and the other components are solved for. If the sets are the same in two
/// iterations, (2) is zero to rounding. The method may cycle. Then the guess changes one component at a time (the one
/// of largest index, Murty's rule), which ends after finitely many steps.
///
/// The components of `start` at a bound give the first sets. The method ends when the sets repeat, as soon as the
/// natural residual (2) is below `enough`, or after `max_iterations` sets, and returns the point with the smallest
/// natural residual. `last` holds the last factor of the same H, or is empty. `None` if H is not positive definite on
/// the free components.
pub fn active_set(
    h: &Quadratic,
    g: &[f64],
    (lo, hi): (&[f64], &[f64]),
    start: &[f64],
    enough: f64,
    max_iterations: usize,
    last: &mut LastFactor,
) -> Option<Solution> {
    let n = g.len();
    let diagonal = h.diagonal();
    let mut sorted = diagonal.clone();
    sorted.sort_by(f64::total_cmp);
    let c = sorted[n / 2].max(f64::MIN_POSITIVE);

    let mut state: Vec<BoundState> = (0..n)
        .map(|j| match start[j] {
            t if t <= lo[j] => BoundState::Low,
            t if t >= hi[j] => BoundState::High,
            _ => BoundState::Free,
        })
        .collect();
    let mut best: Option<Solution> = None;
    let mut without_progress = 0;
    for iterations in 1..=max_iterations {
        // Free components: H_II t_I = g_I - H_IA t_A
        let t = solve_free(h, g, (lo, hi), &state, last)?;
        let gradient_at_t = gradient(h, g, &t);
        let clipped = clip(&t, lo, hi);
        let at_clipped;
        let gradient_at_clipped = if clipped == t {
            &gradient_at_t
        } else {
            at_clipped = gradient(h, g, &clipped);
            &at_clipped
        };
        let residual = natural_residual(&clipped, gradient_at_clipped, &diagonal, lo, hi);
        let wanted: Vec<BoundState> = (0..n)
            .map(|j| {
                let multiplier = if state[j] == BoundState::Free { 0.0 } else { gradient_at_t[j] };
                BoundState::of_target(t[j] - multiplier / c, lo[j], hi[j])
            })
            .collect();
        let better = best.as_ref().is_none_or(|b| residual < b.natural_residual);
        without_progress = if better { 0 } else { without_progress + 1 };
        let done = wanted == state || residual < enough;
        if better || done {
            best = Some(Solution {
                value: clipped,
                natural_residual: residual,
                iterations,
                end: if done { End::Optimal } else { End::IterationLimit },
            });
        }
        if done {
            break;
        }
        if without_progress >= CYCLING_AFTER {
            // Cycling: change only the last component whose place differs from the wanted one.
            if let Some(j) = (0..n).rev().find(|j| wanted[*j] != state[*j]) {
                state[j] = wanted[j];
            }
        } else {
            state = wanted;
        }
    }
    best
}

/// State of a component: free, at its lower bound, or at its upper bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum BoundState {
    Free,
    Low,
    High,
}

impl BoundState {
    /// Returns the state of a component that should move to `aim`: at a bound if `aim` is beyond it, otherwise free.
    fn of_target(aim: f64, lo: f64, hi: f64) -> Self {
        match aim {
            aim if aim < lo => Self::Low,
            aim if aim > hi => Self::High,
            _ if lo == hi => Self::Low,
            _ => Self::Free,
        }
    }
}

/// Returns the point within the bounds that is nearest to `t`, component by component.
pub fn clip(t: &[f64], lo: &[f64], hi: &[f64]) -> Vec<f64> {
    (0..t.len()).map(|j| t[j].clamp(lo[j], hi[j])).collect()
}

/// Returns the gradient `H t - g` of the objective at t.
fn gradient(h: &Quadratic, g: &[f64], t: &[f64]) -> Vec<f64> {
    difference(&h.product(t), g)
}

/// Returns `a - b`, element by element.
fn difference(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

/// Returns the objective `1/2 t' H t - g' t` of (1) of the module from t, the product `h_t` = H t, and g.
fn objective(t: &[f64], h_t: &[f64], g: &[f64]) -> f64 {
    (0..t.len()).map(|j| t[j] * (0.5 * h_t[j] - g[j])).sum()
}

/// Returns the point whose components are at their bounds where `state` says so, and whose gradient is zero in the
/// free ones. `None` if the free part of H is not positive definite.
fn solve_free(
    h: &Quadratic,
    g: &[f64],
    (lo, hi): (&[f64], &[f64]),
    state: &[BoundState],
    last: &mut LastFactor,
) -> Option<Vec<f64>> {
    let n = g.len();
    let mut t: Vec<f64> = (0..n)
        .map(|j| match state[j] {
            BoundState::Free => 0.0,
            BoundState::Low => lo[j],
            BoundState::High => hi[j],
        })
        .collect();
    let free: Vec<usize> = (0..n).filter(|j| state[*j] == BoundState::Free).collect();
    if free.is_empty() {
        return Some(t);
    }
    let at_bounds = h.product(&t);
    let x = h.solve(&free, free.iter().map(|&i| g[i] - at_bounds[i]).collect(), last)?;
    for (x, &i) in x.iter().zip(&free) {
        t[i] = *x;
    }
    Some(t)
}

/// Conditions at which [`active_set_by_products`] ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProductSettings {
    /// Natural residual, (2) of the module, at which the method ends.
    pub enough: f64,
    /// Largest error of a linear solve in the norm of H, relative to the step that it finds; see
    /// [`conjugate_gradients`].
    pub inexact: f64,
    /// Largest number of sets of free components.
    pub max_sets: usize,
    /// Largest number of products with H within the linear solves, all together.
    pub max_products: usize,
}

/// Preconditioner of conjugate gradients on the free components: the exact solution in a small coarse space, spanned
/// by the columns of V, and an approximate one for the remainder.
pub trait Deflation {
    /// Returns `V (V' H V)^-1 V' r` on the free components, the solution for r in the coarse space; 0 elsewhere.
    fn coarse(&self, r: &[f64]) -> Vec<f64>;
    /// Returns the product of r with an approximate inverse of H on the free components (the smoother), for r
    /// orthogonal to V.
    fn smooth(&self, r: &[f64]) -> Vec<f64>;
}

/// Result of [`active_set_by_products`].
#[derive(Clone, Debug)]
pub struct ProductSolution {
    /// The point with the smallest objective (1) of the module that the iteration met.
    pub solution: Solution,
    /// The minimiser of the objective over the free components of the last set, which may be beyond their bounds. The
    /// other components are at their bounds.
    pub unbounded: Vec<f64>,
    /// True for every component that was free in the last set.
    pub free: Vec<bool>,
}

/// Returns the state of every component at the start `t` with the gradient `q`: at a bound if it is there and descent
/// points beyond the bound, otherwise free. Components that do not move (false in `moves`) count as at their lower
/// bound.
fn first_places(
    t: &[f64],
    q: &[f64],
    moves: &[bool],
    (lo, hi): (&[f64], &[f64]),
) -> Vec<BoundState> {
    (0..t.len())
        .map(|j| match t[j] {
            _ if !moves[j] => BoundState::Low,
            v if v <= lo[j] && q[j] >= 0.0 => BoundState::Low,
            v if v >= hi[j] && q[j] <= 0.0 => BoundState::High,
            _ => BoundState::Free,
        })
        .collect()
}

/// Solves (1) of the module as [`active_set`] does, for an H of which only products are known. Conjugate gradients
/// solve for the free components, and `deflation(free)` makes their preconditioner.
///
/// `apply(t)` is H t; components with H_jj <= 0 or equal bounds stay at `start`. The result is the point with the
/// smallest objective during the iteration, `start` included. The method ends when the sets repeat, when the natural
/// residual (2) is small enough, or at the limits of `settings`.
pub fn active_set_by_products<D: Deflation>(
    apply: impl Fn(&[f64]) -> Vec<f64>,
    mut deflation: impl FnMut(&[bool]) -> D,
    diagonal: &[f64],
    g: &[f64],
    (lo, hi): (&[f64], &[f64]),
    start: &[f64],
    settings: &ProductSettings,
) -> ProductSolution {
    let n = g.len();
    let moves: Vec<bool> = (0..n).map(|j| diagonal[j] > 0.0 && lo[j] < hi[j]).collect();
    let mut sorted: Vec<f64> = (0..n).filter(|j| moves[*j]).map(|j| diagonal[j]).collect();
    sorted.sort_by(f64::total_cmp);
    let c = sorted.get(sorted.len() / 2).copied().unwrap_or(1.0);

    let mut t = start.to_vec();
    let h_t = apply(&t);
    let mut q = difference(&h_t, g);
    let mut best = objective(&t, &h_t, g);
    let mut residual = natural_residual(&t, &q, diagonal, lo, hi);
    let mut wanted = first_places(&t, &q, &moves, (lo, hi));
    let mut products = 0;
    let mut end = End::IterationLimit;
    let mut x = t.clone();
    let mut free = vec![false; n];
    for _ in 0..settings.max_sets {
        if residual <= settings.enough {
            end = End::Optimal;
            break;
        }
        if products >= settings.max_products {
            break;
        }
        let state = wanted;
        free = (0..n).map(|j| moves[j] && state[j] == BoundState::Free).collect();
        // x: bound components at their bounds, the free ones where their gradient vanishes
        put_on_bounds(&mut x, &state, &moves, (lo, hi));
        let mut q_x = difference(&apply(&x), g);
        let most = settings.max_products - products;
        products += conjugate_gradients(
            &apply,
            &deflation(&free),
            &free,
            &mut x,
            &mut q_x,
            settings.inexact,
            most,
        );
        let to: Vec<f64> =
            (0..n).map(|j| if moves[j] { x[j].clamp(lo[j], hi[j]) } else { x[j] }).collect();
        let h_to = apply(&to);
        products += 1;
        let value = objective(&to, &h_to, g);
        if value < best {
            best = value;
            q = difference(&h_to, g);
            t = to;
            residual = natural_residual(&t, &q, diagonal, lo, hi);
        }
        wanted = (0..n)
            .map(|j| {
                if moves[j] {
                    let multiplier = if free[j] { 0.0 } else { q_x[j] / c };
                    BoundState::of_target(x[j] - multiplier, lo[j], hi[j])
                } else {
                    BoundState::Low
                }
            })
            .collect();
        if wanted == state {
            end = End::Optimal;
            break;
        }
    }
    let solution = Solution { value: t, natural_residual: residual, iterations: products, end };
    ProductSolution { solution, unbounded: x, free }
}

/// Puts the components that move (true in `moves`) on the bound that `state` says or, if they are free, within their
/// bounds.
fn put_on_bounds(x: &mut [f64], state: &[BoundState], moves: &[bool], (lo, hi): (&[f64], &[f64])) {
    for j in (0..x.len()).filter(|j| moves[*j]) {
        match state[j] {
            BoundState::Low => x[j] = lo[j],
            BoundState::High => x[j] = hi[j],
            BoundState::Free => x[j] = x[j].clamp(lo[j], hi[j]),
        }
    }
}

/// Moves the free components of t until the gradient is zero there, `q_I = 0`, by deflated conjugate gradients. `q` is
/// the gradient at t, of all components, and is updated. With `Q = V (V' H V)^-1 V'` and the smoother S of
/// [`Deflation`],
///
/// ```text
/// t += Q r,   z = S r + Q (r - H S r)        then the residuals r stay orthogonal to V
/// ```
///
/// Source: J. M. Tang, R. Nabben, C. Vuik, Y. A. Erlangga, J. Sci. Comput. 39 (2009) 340, method A-DEF2. Ends if `r' z
/// <= inexact^2 * (decrease of the objective so far)`, if `r' z` no longer falls, if a direction has no positive
/// curvature, or after about `most` products with H. Returns the number of products.
pub fn conjugate_gradients(
    apply: &impl Fn(&[f64]) -> Vec<f64>,
    deflation: &impl Deflation,
    free: &[bool],
    t: &mut [f64],
    q: &mut [f64],
    inexact: f64,
    most: usize,
) -> usize {
    let first = deflation.coarse(&descent(q, free));
    let h_first = apply(&first);
    let mut fall = -dot(q, &first) - 0.5 * dot(&first, &h_first);
    step(t, q, 1.0, (&first, &h_first));
    let mut r = descent(q, free);
    let mut p = vec![0.0; t.len()];
    let mut rz = 0.0;
    let mut products = 1;
    let mut least = f64::INFINITY;
    let mut at_least = products;
    while products < most {
        let mut z = deflation.smooth(&r);
        let left: Vec<f64> = apply(&z).iter().zip(&r).map(|(h, r)| r - h).collect();
        products += 1;
        z.iter_mut().zip(deflation.coarse(&left)).for_each(|(z, c)| *z += c);
        let next = dot(&r, &z);
        if next < least {
            least = next;
            at_least = products;
        }
        let is_rounding = products > at_least + PRODUCTS_WITHOUT_PROGRESS;
        if next <= inexact * inexact * fall || is_rounding {
            break;
        }
        let b = if rz > 0.0 { next / rz } else { 0.0 };
        rz = next;
        p.iter_mut().zip(&z).for_each(|(p, z)| *p = z + b * *p);
        let h_p = apply(&p);
        products += 1;
        // a = r'z / p'Hp
        let curvature = dot(&p, &h_p);
        if curvature <= 0.0 {
            break;
        }
        let a = rz / curvature;
        step(t, q, a, (&p, &h_p));
        fall += 0.5 * a * rz;
        r = descent(q, free);
    }
    products
}

/// Returns the negative gradient of the free components, and 0 for the others.
fn descent(q: &[f64], free: &[bool]) -> Vec<f64> {
    q.iter().zip(free).map(|(q, free)| if *free { -q } else { 0.0 }).collect()
}

/// Adds `a p` to t, and `a h_p`, with h_p = H p, to its gradient q.
fn step(t: &mut [f64], q: &mut [f64], a: f64, (p, h_p): (&[f64], &[f64])) {
    for j in 0..t.len() {
        t[j] += a * p[j];
        q[j] += a * h_p[j];
    }
}

/// Conditions at which [`projected_gradient`] ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GradientSettings {
    /// Natural residual, (2) of the module, at which the iteration ends as optimal.
    pub tolerance: f64,
    /// Largest number of steps.
    pub max_iterations: usize,
    /// Smallest relative decrease between two tests, 50 steps apart: the iteration ends if the objective plus `offset`
    /// falls by a smaller fraction.
    pub stagnation: f64,
    /// Constant that makes the objective of (1) of the module a sum of squares, so that its relative decrease has a
    /// meaning.
    pub offset: f64,
}

/// Solves (1) of the module by scaled accelerated projected gradient steps with restart, for any H of which products
/// are known.
///
/// Source: Beck and Teboulle, SIAM J. Imaging Sci. 2 (2009) 183, Eqs 4.1-4.3, with the restart of
/// O'Donoghue and Candes, Found. Comput. Math. 15 (2015) 715, Eq. 3.2, in the scale
/// `S = diag(H)^-1/2`:
///
/// ```text
/// step_j = 1 / (H_jj L),   L >= largest eigenvalue of S H S
/// t+ = clip(y - step (H y - g));   restart if (H y - g)'(t+ - t) > 0
/// theta+ = (1 + sqrt(1 + 4 theta^2)) / 2,   y = t+ + (theta - 1)/theta+ (t+ - t)
/// ```
///
/// `apply(t)` is H t, and `diagonal` its diagonal. Components with H_jj <= 0 are set to `lo`. `start` is the first
/// guess, clipped to the bounds.
pub fn projected_gradient(
    apply: impl Fn(&[f64]) -> Vec<f64>,
    diagonal: &[f64],
    g: &[f64],
    lo: &[f64],
    hi: &[f64],
    start: &[f64],
    settings: &GradientSettings,
) -> Solution {
    let n = g.len();
    let moves: Vec<bool> = diagonal.iter().map(|d| *d > 0.0).collect();
    let bound = EIGENVALUE_MARGIN * largest_eigenvalue(&apply, diagonal);
    let step: Vec<f64> =
        (0..n).map(|j| if moves[j] { 1.0 / (diagonal[j] * bound) } else { 0.0 }).collect();

    let mut t: Vec<f64> =
        (0..n).map(|j| if moves[j] { start[j].clamp(lo[j], hi[j]) } else { lo[j] }).collect();
    let mut y = t.clone();
    let mut theta = 1.0_f64;
    let mut objective_before = f64::INFINITY;
    let mut iterations = 0;
    loop {
        let mut q = apply(&y);
        q.iter_mut().zip(g).for_each(|(q, g)| *q -= g);
        let next: Vec<f64> = (0..n).map(|j| (y[j] - step[j] * q[j]).clamp(lo[j], hi[j])).collect();
        iterations += 1;
        let uphill: f64 = (0..n).map(|j| q[j] * (next[j] - t[j])).sum();
        if uphill > 0.0 {
            theta = 1.0;
            y.clone_from(&next);
        } else {
            let theta_next = 0.5 * (1.0 + (1.0 + 4.0 * theta * theta).sqrt());
            let w = (theta - 1.0) / theta_next;
            for j in 0..n {
                y[j] = next[j] + w * (next[j] - t[j]);
            }
            theta = theta_next;
        }
        t = next;
        if iterations % STEPS_BETWEEN_LOOKS == 0 || iterations >= settings.max_iterations {
            let h_t = apply(&t);
            let q = difference(&h_t, g);
            let natural_residual = natural_residual(&t, &q, diagonal, lo, hi);
            let objective = settings.offset + objective(&t, &h_t, g);
            let end = if natural_residual <= settings.tolerance {
                Some(End::Optimal)
            } else if objective_before - objective <= settings.stagnation * objective.abs() {
                Some(End::Stagnated)
            } else if iterations >= settings.max_iterations {
                Some(End::IterationLimit)
            } else {
                None
            };
            if let Some(end) = end {
                return Solution { value: t, natural_residual, iterations, end };
            }
            objective_before = objective;
        }
    }
}

/// Returns an estimate of the largest eigenvalue of S H S with the scale S = diag(H)^-1/2; 1 if H is zero.
fn largest_eigenvalue(apply: &impl Fn(&[f64]) -> Vec<f64>, diagonal: &[f64]) -> f64 {
    let scale: Vec<f64> =
        diagonal.iter().map(|d| if *d > 0.0 { d.sqrt().recip() } else { 0.0 }).collect();
    let estimates = power_method(apply, &scale).take(POWER_STEPS);
    estimates.last().filter(|eigenvalue| *eigenvalue > 0.0).unwrap_or(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, ArrayView1};
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Makes H = G'G + ridge I (n, n) from a random square G, moderately conditioned, and a random g (n).
    fn random_problem(n: usize, ridge: f64, seed: u64) -> (Array2<f64>, Vec<f64>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let a = Array2::from_shape_simple_fn((n, n), || rng.random_range(-1.0..1.0));
        let g = (0..n).map(|_| rng.random_range(-2.0..2.0)).collect();
        (a.t().dot(&a) + ridge * Array2::<f64>::eye(n), g)
    }

    /// Returns H in two forms: without outer products, and as a matrix with more nonzero elements minus two of them.
    fn forms(h: &Array2<f64>) -> [Quadratic; 2] {
        let n = h.nrows();
        let u: Vec<Vec<f64>> = (1..3_u32)
            .map(|m| (0..n).map(|j| 0.5 + (f64::from(m) * j as f64).sin()).collect())
            .collect();
        let mut fuller = h.clone();
        for u in &u {
            for ((i, j), v) in fuller.indexed_iter_mut() {
                *v += u[i] * u[j];
            }
        }
        let (k, fuller) = (Skyline::from_dense(h), Skyline::from_dense(&fuller));
        [Quadratic { k, u: Vec::new() }, Quadratic { k: fuller, u }]
    }

    /// Runs [`active_set`] to its end, without a factor from an earlier call.
    fn active_set_alone(
        h: &Quadratic,
        g: &[f64],
        bounds: (&[f64], &[f64]),
        start: &[f64],
        max_iterations: usize,
    ) -> Option<Solution> {
        active_set(h, g, bounds, start, 0.0, max_iterations, &mut LastFactor::default())
    }

    #[test]
    fn a_factor_at_hand_changes_nothing_but_the_time() {
        let (h, g) = random_problem(24, 0.5, 7);
        let (lo, hi) = (vec![-0.3; 24], vec![0.3; 24]);
        for h in forms(&h) {
            let mut last = LastFactor::default();
            let mut start = lo.clone();
            let mut again = 0;
            // The right side moves: first the free components stay the same ones, then they change.
            for by in [0.0, 1e-6, 2e-6, 0.8, -1.5] {
                let g: Vec<f64> = g.iter().map(|g| g + by).collect();
                let of = |last: &LastFactor| last.0.as_ref().map(|(keep, _)| keep.clone());
                let before = of(&last);
                let found = active_set(&h, &g, (&lo, &hi), &start, 0.0, 50, &mut last).unwrap();
                let alone = active_set_alone(&h, &g, (&lo, &hi), &start, 50).unwrap();
                assert_eq!((found.value.clone(), found.end), (alone.value, End::Optimal));
                again += usize::from(before == of(&last));
                start = found.value;
            }
            assert_eq!(again, 2);
        }
    }

    /// Preconditioner with a coarse space of some sines on the free components, and the diagonal for the rest.
    struct OfSines {
        v: Vec<Vec<f64>>,
        factor: crate::linear::skyline::Factor,
        diagonal: Vec<f64>,
    }

    impl OfSines {
        fn new(h: &Array2<f64>, free: &[bool], count: u32) -> Self {
            let masked = |j: usize, v: f64| if free[j] { v } else { 0.0 };
            let v: Vec<Vec<f64>> = (0..count)
                .map(|k| {
                    (0..free.len())
                        .map(|j| masked(j, (f64::from(k + 1) * j as f64 + 1.0).sin()))
                        .collect()
                })
                .collect();
            let h_v: Vec<_> = v.iter().map(|v| h.dot(&ArrayView1::from(v)).to_vec()).collect();
            // 1e-12: more sines than free components.
            let matrix = Array2::from_shape_fn((v.len(), v.len()), |(i, k)| {
                dot(&v[i], &h_v[k]) + if i == k { 1e-12 } else { 0.0 }
            });
            let factor = Skyline::from_dense(&matrix).factorise().unwrap();
            let diagonal = (0..free.len()).map(|j| masked(j, 1.0 / h[[j, j]])).collect();
            Self { v, factor, diagonal }
        }
    }

    impl Deflation for OfSines {
        fn coarse(&self, r: &[f64]) -> Vec<f64> {
            let mut c: Vec<f64> = self.v.iter().map(|v| dot(v, r)).collect();
            self.factor.solve(&mut c);
            (0..r.len()).map(|j| self.v.iter().zip(&c).map(|(v, c)| v[j] * c).sum()).collect()
        }

        fn smooth(&self, r: &[f64]) -> Vec<f64> {
            r.iter().zip(&self.diagonal).map(|(r, d)| r * d).collect()
        }
    }

    #[test]
    fn an_exact_coarse_space_ends_conjugate_gradients_at_once() {
        // All of the space: one solve, and one product to see that nothing is left.
        let (h, g) = random_problem(12, 0.3, 5);
        let apply = |t: &[f64]| h.dot(&ArrayView1::from(t)).to_vec();
        let free = [true; 12];
        let mut t = vec![0.0; 12];
        let mut q: Vec<f64> = g.iter().map(|g| -g).collect();
        let all = OfSines::new(&h, &free, 12);
        let products = conjugate_gradients(&apply, &all, &free, &mut t, &mut q, 1e-3, 100);
        assert!(products <= 2, "{products}");
        // The condition number of the sines squared costs about eight digits.
        assert!(q.iter().all(|q| q.abs() < 1e-6), "{q:?}");
    }

    const SETTINGS: GradientSettings =
        GradientSettings { tolerance: 1e-9, max_iterations: 100_000, stagnation: 0.0, offset: 0.0 };

    #[test]
    fn a_diagonal_problem_is_clipped() {
        let h = Array2::from_diag(&ndarray::array![1.0, 4.0, 16.0, 64.0]);
        let g = [3.0, 2.0, -4.0, 64.0];
        for (h, rounding) in forms(&h).iter().zip([0.0, 1e-14]) {
            let s = active_set_alone(h, &g, (&[0.0; 4], &[2.0; 4]), &[1.0; 4], 50).unwrap();
            let expected = [2.0, 0.5, 0.0, 1.0];
            assert!((0..4).all(|j| (s.value[j] - expected[j]).abs() <= rounding), "{s:?}");
            assert!(s.end == End::Optimal && s.natural_residual <= rounding, "{s:?}");
        }
    }

    #[test]
    fn unbounded_is_the_linear_solve() {
        let (h, g) = random_problem(30, 0.1, 7);
        let (lo, hi) = (vec![f64::NEG_INFINITY; 30], vec![f64::INFINITY; 30]);
        for h in forms(&h) {
            let s = active_set_alone(&h, &g, (&lo, &hi), &[0.0; 30], 50).unwrap();
            let q = gradient(&h, &g, &s.value);
            // Rounding of H x: eigenvalues of up to 40 times x of up to |g| / 0.1 = 60.
            assert!(q.iter().all(|q| q.abs() < 1e-10), "{q:?}");
        }
    }

    #[test]
    fn not_positive_definite_is_refused() {
        let h = Array2::from_diag(&ndarray::array![1.0, -1.0]);
        for h in forms(&h) {
            assert!(
                active_set_alone(&h, &[1.0; 2], (&[-9.0; 2], &[9.0; 2]), &[0.0; 2], 50).is_none()
            );
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        /// Two independent methods find the same point, and it satisfies the certificate.
        #[test]
        fn both_methods_agree(n in 1..40_usize, seed in any::<u64>(), low in -1.0..0.5_f64) {
            let (h, g) = random_problem(n, 0.3, seed);
            let (lo, hi) = (vec![low; n], vec![low + 0.8; n]);
            let [plain, split] = forms(&h);
            let a = active_set_alone(&plain, &g, (&lo, &hi), &lo, 200).unwrap();
            prop_assert_eq!(a.end, End::Optimal);
            prop_assert!(a.natural_residual < 1e-11);
            let c = active_set_alone(&split, &g, (&lo, &hi), &lo, 200).unwrap();
            // The outer products cost the digits of their size, some 1e2.
            prop_assert!((0..n).all(|j| (a.value[j] - c.value[j]).abs() < 1e-9));
            let diagonal: Vec<f64> = (0..n).map(|j| h[[j, j]]).collect();
            let apply = |t: &[f64]| h.dot(&ArrayView1::from(t)).to_vec();
            let b = projected_gradient(apply, &diagonal, &g, &lo, &hi, &lo, &SETTINGS);
            prop_assert_eq!(b.end, End::Optimal);
            let settings =
                ProductSettings { enough: 1e-10, inexact: 1e-9, max_sets: 200, max_products: 100_000 };
            for coarse in [0, 3] {
                let deflation = |free: &[bool]| OfSines::new(&h, free, coarse);
                let d = active_set_by_products(
                    apply, deflation, &diagonal, &g, (&lo, &hi), &lo, &settings,
                ).solution;
                prop_assert_eq!(d.end, End::Optimal);
                for j in 0..n {
                    // Natural residuals of 1e-9 with a condition number below about 1e3.
                    for value in [b.value[j], d.value[j]] {
                        prop_assert!((a.value[j] - value).abs() < 1e-6, "{} {value}", a.value[j]);
                    }
                }
            }
        }
    }
}
