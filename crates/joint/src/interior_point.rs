//! Interior point method for the densities of least objective under the limits.
//!
//! ```text
//! min f(D)   subject to   c_i(D_j, D_k) >= 0,   D >= lo                                          (1)
//! ```
//!
//! f is convex. The rows c are not concave everywhere, so (1) is not convex. Every step is that of a primal-dual
//! method. It takes into account only the part of the curvature of every row that bends it downwards (C_i, positive
//! semidefinite):
//!
//! ```text
//! (H + sum_i z_i C_i + J' Z/c J + Y/(D - lo)) d = -f' + J' (mu/c) + mu/(D - lo)
//! dz = mu/c - z - Z/c J d,   dy = mu/(D - lo) - y - Y/(D - lo) d                                  (2)
//! ```
//!
//! with H the surrogate of the curvature of f, f' exact, and mu by Mehrotra's predictor and corrector. Gondzio's
//! corrections then bring outlying products of slacks and dual variables back towards mu. Without them the steps end
//! early at a few rows that are far from being active. A step ends where a row would lose more than most of its
//! slack, measured on c itself, so every iterate can be executed. If the bends of the rows end a step much before the
//! tangents do, a second-order correction follows. Its right-hand side has the distance of the rows from their
//! tangents at the end of the step, and the factor is the same. The matrix keeps the skyline of H, because a row
//! couples neighbours only.
//!
//! f and f' are those of [`crate::merit`]. They are computed with the removal itself whenever the complementarity has
//! fallen to a tenth, and at every iterate of which something is to be proven. Between these iterates H gives the
//! change.
//!
//! An objective that no longer falls need not be the least one: z fits rows that bend from step to step, and is
//! always a step late. So when the complementarity is as small as the gap that is wanted, the iterate stays where it
//! is and its tangents are kept. The steps go on for the convex program with these tangents in the place of the rows.
//! Its slacks may first be larger than the tangents allow (an infeasible start). They end when its dual variables
//! prove how far the iterate is above its least value ([`crate::certificate`]). If that is more than is wanted, the
//! iterate moves towards the solution of this program, as far as the rows themselves allow. The steps under the rows
//! then go on.
//!
//! Sources: S. Mehrotra, SIAM J. Optim. 2 (1992) 575; J. Gondzio, Comput. Optim. Appl. 6 (1996) 137; for programs that
//! are convex but for their rows T. Lipp and S. Boyd, Optim. Eng. 17 (2016) 263; for the second-order correction
//! A. Wächter and L. T. Biegler, Math. Program. 106 (2006) 25.

use planish_dwell::residual::Normal;
use planish_numerics::{
    linear::{
        skyline::{Element, dot},
        woodbury::Woodbury,
    },
    qp::bounded::Quadratic,
};
use planish_types::{End, progress};

use crate::{
    JointError, certificate,
    limits::{Constraint, Rows},
    merit::{Merit, Objective, Progress},
};

/// Largest fraction of a slack or of a dual variable that one step may take away, dimensionless; below 1. Larger:
/// longer steps, but the next ones are short at rows that are nearly active. Smaller: more steps. Chosen.
const STEP_TO_BOUNDARY: f64 = 0.95;

/// Factor on the length of a step until no row loses too much, dimensionless; below 1. Larger: a length nearer to the
/// longest one, with more evaluations of the rows. Smaller: fewer evaluations, shorter steps. Chosen.
const BACKTRACKING: f64 = 0.8;

/// Fraction of the progress bar for the steps until the complementarity is small enough; the rest is for the proof.
/// It changes only what is shown. Larger or smaller: the bar moves faster or slower towards its end. Chosen.
const BEFORE_PROOF: f64 = 0.75;

/// Least ratio of mu to the mean product of a slack and its dual variable before the step. Larger: the
/// complementarity falls more slowly. Smaller: products may become so unequal that the next steps are short. Chosen.
const LEAST_CENTRING: f64 = 1e-3;

/// Largest number of corrections of a step that bends of the rows end early. Larger: more solutions with the factor.
/// Smaller: shorter steps at rows that bend much. Chosen: of a hundred steps none needed a third correction.
const MAX_BEND_CORRECTIONS: usize = 4;

/// Length of a step over that by the tangents above which it is long enough and no bend is corrected. Larger: more
/// corrections. Smaller: more, shorter steps. Chosen: a ratio between this one and 1 is usual without a correction.
const LONG_ENOUGH: f64 = 0.5;

/// Largest number of Gondzio's corrections of a step. Larger: more solutions with the factor per step. Smaller:
/// shorter steps, because outlying products are left. Chosen.
const MAX_CENTRALITY_CORRECTIONS: usize = 3;

/// Length by which Gondzio's correction extends the primal and the dual step (1 is a full step) before it measures
/// the products. Larger: corrections aim at longer steps and fail more often. Smaller: corrections gain less. Chosen.
const FURTHER: f64 = 0.3;

/// Least gain of a correction in the length of one of the two steps, over [`FURTHER`], for it to be kept and another
/// one to be tried. Larger: fewer corrections. Smaller: corrections that gain little. Chosen.
const LEAST_GAIN: f64 = 0.1;

/// Largest ratio of a product to mu, and of mu to a product, that is no outlier. Larger: fewer products are
/// corrected, and steps end early at them. Smaller: corrections of products that hold no step back. Chosen: a decade.
const OUTLIER: f64 = 10.0;

/// Complementarity at a start without dual variables, over the objective there. Larger: more steps until it has
/// fallen. Smaller: dual variables that are too small for the first steps to be long. Chosen.
const FIRST_RELATIVE_GAP: f64 = 0.3;

/// Least product of a slack and its dual variable at a start with dual variables, over the mean product. Larger: dual
/// variables from before are lost. Smaller: products far below the mean make the first steps short. Chosen.
const LEAST_PRODUCT: f64 = 0.1;

/// Gap at which the program of the tangents is taken as solved, over the gap that is wanted. Larger: the method moves
/// on earlier, towards a less exact solution. Smaller: more steps for a program that does not prove enough. Chosen.
const PROGRAM_SOLVED: f64 = 0.1;

/// Largest fall of the objective in a step, over the gap that is wanted, at which tangents are kept. Larger: proofs
/// begin earlier and fail more often. Smaller: steps after the objective has nearly stopped to fall. Chosen.
const STILL_FALLING: f64 = 0.3;

/// Factor on the largest complementarity at which tangents are kept, after each proof that failed. Larger: the next
/// proof begins sooner and may fail again. Smaller: more steps before the next proof. Chosen.
const KEPT_AGAIN: f64 = 0.25;

/// Least value of that largest complementarity, over the gap that is wanted. Larger: proofs begin earlier. Smaller:
/// many steps where rows bend much, because the way along them is long. Chosen.
const LEAST_KEPT_BELOW: f64 = 0.06;

/// Least number of steps under the rows themselves after a proof that failed. Larger: later proofs. Smaller: the next
/// proof begins at nearly the same iterate and fails as well, up to the last step. Chosen.
const LEAST_STEPS_BETWEEN_PROOFS: usize = 3;

/// Number of last steps that are left for the proof: in these, tangents are kept as soon as the complementarity is as
/// small as the gap that is wanted. Larger: fewer steps lower the objective. Smaller: the last proof is not finished.
/// Chosen: a proof usually takes about as many.
const STEPS_OF_A_PROOF: usize = 25;

/// Least fraction of the way to the solution under the tangents that the iterate moves; if the rows allow less it
/// stays. Larger: it moves less often. Smaller: it ends where many rows are nearly active, so the next steps are
/// short. Chosen.
const LEAST_PART: f64 = 0.5;

/// Least product of a slack and its dual variable over their mean, where tangents begin to be kept. Slacks below
/// [`ACTIVE_SLACK`] are raised first, and the steps take the excess away again; then dual variables are raised.
/// Larger: more steps until the complementarity has fallen again. Smaller: short first steps, because the dual
/// variables fit rows that are bent. Chosen.
const RAISED_PRODUCT: f64 = 100.0;

/// Slack below which a row counts as active when tangents begin to be kept, dimensionless (1 at rest). Larger: slacks
/// of more rows are raised. Smaller: the dual variables of such rows are raised in their place. Chosen. See
/// [`RAISED_PRODUCT`].
const ACTIVE_SLACK: f64 = 0.1;

/// Ratio of the complementarity to that at the last reference at which f is computed with the removal itself again.
/// Larger: more convolutions of the map. Smaller: f is less exact, because the cells of the normal matrix lose a
/// part. Chosen.
const REFERRED_AGAIN: f64 = 0.1;

/// Complementarity over f at which an [`approach`] may end. Larger: dual variables that do not tell the rows that
/// decide. Smaller: more steps on a mesh that is not the last one. Chosen: by then the dual variables of the rows
/// that decide are far above the others.
pub const NEAR_THE_MINIMUM: f64 = 0.3;

/// Least number of steps of an [`approach`]. Larger: more time per mesh. Smaller: dual variables that still belong to
/// the rows of the coarser mesh. Chosen.
const LEAST_STEPS_OF_AN_APPROACH: usize = 3;

/// Least remainder of the matrix along the free functions ([`Woodbury::least_left`]), relative, at which a factor in
/// single precision is used as it is. If less is left it is refined; if that fails, the factor is made in double
/// precision. Larger: more refinements. Smaller: steps by a wrong inverse. Derived: a thousand times the rounding of
/// the products.
const LEFT_TO_SINGLE: f64 = 1e-4;

/// Progress before any step.
const FIRST: Progress = Progress { iteration: 0, complementarity: f64::INFINITY };

/// The program (1).
pub struct Program<'a> {
    /// Curvature of f without its chain, in an order of its own.
    pub normal: &'a Normal,
    /// Curvature of f beside it: diagonal (n), and element (j, j - 1) for every j (n; the first unused).
    pub chain: (&'a [f64], &'a [f64]),
    /// lo (n).
    pub lo: &'a [f64],
    /// c.
    pub rows: &'a Rows<'a>,
}

impl<'a> Program<'a> {
    /// The inverse of the normal matrix with a chain added: its diagonal (n) and its elements (j, j - 1) (n). `None` if
    /// that is singular to rounding.
    fn inverse(
        &self,
        row_of: &[usize],
        (diagonal, below): (&[f64], &[f64]),
    ) -> Option<Inverse<'a>> {
        let mut added = Vec::with_capacity(2 * row_of.len());
        for (j, row) in row_of.iter().enumerate() {
            added.push(Element { row: *row, column: *row, value: diagonal[j] });
            if j > 0 && below[j] != 0.0 {
                let before = row_of[j - 1];
                let (row, column) = (before.max(*row), before.min(*row));
                added.push(Element { row, column, value: below[j] });
            }
        }
        added.sort_unstable_by_key(|e| (e.row, e.column));
        let Quadratic { k, u } = &self.normal.matrix;
        let product = |x: &[f64]| {
            let mut product = k.product(x);
            for e in &added {
                product[e.row] += e.value * x[e.column];
                if e.column != e.row {
                    product[e.column] += e.value * x[e.row];
                }
            }
            product
        };
        let single = k
            .factorise_in_single(&added)
            .and_then(|factor| Woodbury::refined(factor, u, LEFT_TO_SINGLE, product));
        let by_rows = match single {
            Some(woodbury) => ByRows::Single(woodbury),
            None => {
                let mut k = k.clone();
                added.iter().for_each(|e| k.add(e.row, e.column, e.value));
                ByRows::Double(Woodbury::new(k.factorise()?, u)?)
            }
        };
        Some(Inverse { order: &self.normal.order, by_rows })
    }

    /// The longest part of the step `length d` after which every row keeps more than a twentieth of its slack `c`,
    /// and the densities where it ends.
    fn farthest(&self, density: &[f64], d: &[f64], c: &[f64], mut length: f64) -> (f64, Vec<f64>) {
        loop {
            let to = moved(density, d, length);
            let after = self.rows.slacks(&to);
            let keeps = |(after, before): (&f64, &f64)| *after >= (1.0 - STEP_TO_BOUNDARY) * before;
            if after.iter().zip(c).all(keeps) || length < f64::EPSILON {
                return (length, to);
            }
            length *= BACKTRACKING;
        }
    }
}

/// `D + length d`.
fn moved(density: &[f64], d: &[f64], length: f64) -> Vec<f64> {
    density.iter().zip(d).map(|(u, d)| u + length * d).collect()
}

/// The inverse of a matrix over the nodes.
struct Inverse<'a> {
    /// Node of every row.
    order: &'a [usize],
    by_rows: ByRows,
}

/// The inverse of a matrix over the rows, of a factor in single or in double precision.
enum ByRows {
    Single(Woodbury<f32>),
    Double(Woodbury),
}

impl Inverse<'_> {
    fn solve(&self, rhs: &[f64]) -> Vec<f64> {
        let mut b: Vec<f64> = self.order.iter().map(|j| rhs[*j]).collect();
        match &self.by_rows {
            ByRows::Single(woodbury) => woodbury.solve(&mut b),
            ByRows::Double(woodbury) => woodbury.solve(&mut b),
        }
        let mut x = vec![0.0; rhs.len()];
        self.order.iter().zip(b).for_each(|(j, b)| x[*j] = b);
        x
    }
}

/// Conditions under which the method stops.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// Proven gap over the objective.
    pub relative_gap: f64,
    /// Most steps.
    pub max_iterations: usize,
}

/// The best iterate.
#[derive(Clone, Debug)]
pub struct Solution {
    /// D (n).
    pub density: Vec<f64>,
    /// f at every iterate, nm^2; see [`crate::merit`] for where it is exact.
    pub objective: Vec<f64>,
    /// Steps.
    pub iterations: usize,
    /// z (rows) and y (n) at the last one.
    pub duals: [Vec<f64>; 2],
    /// Proven gap over f at the last one.
    pub relative_gap: f64,
    /// `optimal` or `iteration-limit`.
    pub end: End,
}

/// J d.
fn along(rows: &[Constraint], d: &[f64]) -> Vec<f64> {
    let of =
        |row: &Constraint| (0..2).map(|k| row.nodes[k].map_or(0.0, |n| row.by[k] * d[n])).sum();
    rows.iter().map(of).collect()
}

/// `out += J' v`.
fn add_adjoint(rows: &[Constraint], v: impl Fn(usize) -> f64, out: &mut [f64]) {
    for (i, row) in rows.iter().enumerate() {
        let v = v(i);
        for k in 0..2 {
            if let Some(n) = row.nodes[k] {
                out[n] += row.by[k] * v;
            }
        }
    }
}

/// Densities and dual variables from which the method begins.
#[derive(Clone, Debug)]
pub struct Start {
    /// D (n), strictly inside.
    pub density: Vec<f64>,
    /// z and y of a program with nearly the same rows, if there was one.
    pub duals: Option<[Vec<f64>; 2]>,
}

/// Minimises (1) from densities strictly inside. The objective may change from step to step while its price is still
/// being found; nothing is proven, or compared, before it is. `None` where the matrix is singular to rounding.
pub fn solve(
    program: &Program<'_>,
    start: Start,
    stop: &Stop,
    merit: &mut Merit<'_>,
) -> Result<Option<Solution>, JointError> {
    let row_of = program.normal.row_of();
    let (f, mut settled) = merit.evaluate(FIRST, &start.density);
    let mut at = Iterate::new(program, start, f);
    let (mut best, mut best_is_settled): (Option<Executable>, bool) = (None, false);
    // Of f alone, made when the certificate asks for it.
    let mut of_curvature: Option<Inverse<'_>> = None;
    let (mut values, mut iteration) = (Vec::new(), 0);
    let (mut value_before, mut kept_below) = (f64::INFINITY, 1.0);
    // From which step on tangents may be kept.
    let mut keeps_from = 0;
    let first_complementarity = at.complementarity();
    let mut referred_at = first_complementarity;
    let end = loop {
        let complementarity = at.complementarity();
        let there = Progress { iteration, complementarity };
        let enough = stop.relative_gap * at.f.value;
        let near_enough = progress::of_convergence(first_complementarity, complementarity, enough);
        progress::done(BEFORE_PROOF * near_enough);
        let falls = value_before - at.f.value > STILL_FALLING * enough;
        let to_go = stop.max_iterations.saturating_sub(iteration);
        let near = settled
            && complementarity <= enough
            && (at.kept.is_some()
                || complementarity <= kept_below * enough && !falls && iteration >= keeps_from
                || to_go <= STEPS_OF_A_PROOF);
        let last = to_go == 0;
        if near || last || complementarity <= REFERRED_AGAIN * referred_at {
            merit.refer_to(there, &at.density, at.kept.is_some())?;
            (at.f, settled) = merit.evaluate(there, &at.density);
            referred_at = complementarity;
        }
        let near = near && settled;
        value_before = at.f.value;
        if at.kept.is_none() {
            values.push(at.f.value);
        }
        if near || last {
            if near && of_curvature.is_none() {
                of_curvature = program.inverse(&row_of, program.chain);
                if of_curvature.is_none() {
                    return Ok(None);
                }
            }
            let gap = at.gap(of_curvature.as_ref().filter(|_| near), stop.relative_gap, merit);
            let executable = at.executable(gap);
            let optimal = settled && executable.relative_gap <= stop.relative_gap;
            // Values at a price that is still being found cannot be compared.
            let comparable = settled && best_is_settled && !optimal;
            if !comparable || best.as_ref().is_none_or(|b| executable.value <= b.value) {
                (best, best_is_settled) = (Some(executable), settled);
            }
            if optimal {
                break End::Optimal;
            }
            if last {
                break End::IterationLimit;
            }
            if at.kept.is_some() && gap <= PROGRAM_SOLVED * enough {
                at.move_towards_solution();
                kept_below = (kept_below * KEPT_AGAIN).max(LEAST_KEPT_BELOW);
                keeps_from = iteration + LEAST_STEPS_BETWEEN_PROOFS;
                (at.f, settled) = merit.evaluate(there, &at.density);
                continue;
            }
            if at.kept.is_none() {
                at.keep_tangents(gap);
            }
        }
        let Some(step) = at.step(&row_of) else { return Ok(None) };
        let complementarity = at.advance(&step);
        iteration += 1;
        (at.f, settled) = merit.evaluate(Progress { iteration, complementarity }, &at.density);
    };
    let duals = [at.z, at.y];
    let solution = |Executable { density, relative_gap, .. }| Solution {
        density,
        objective: values,
        duals,
        iterations: iteration,
        relative_gap,
        end,
    };
    Ok(best.map(solution))
}

/// Iterate near the minimum, of which nothing is proven.
#[derive(Clone, Debug)]
pub struct Approach {
    /// D (n).
    pub density: Vec<f64>,
    /// z (rows) and y (n).
    pub duals: [Vec<f64>; 2],
    /// f, nm^2.
    pub value: f64,
    /// Mean product of a slack and its dual variable, nm^2.
    pub mean_product: f64,
    /// Steps.
    pub iterations: usize,
}

/// Goes towards the minimum of (1) without proving anything, until the complementarity is below the fraction `near`
/// of f. `None` where the matrix is singular to rounding.
pub fn approach(
    program: &Program<'_>,
    start: Start,
    near: f64,
    max_iterations: usize,
    merit: &mut Merit<'_>,
) -> Result<Option<Approach>, JointError> {
    let row_of = program.normal.row_of();
    let f = merit.evaluate(FIRST, &start.density).0;
    let mut at = Iterate::new(program, start, f);
    let mut iterations = 0;
    let mut complementarity = at.complementarity();
    let mut referred_at = complementarity;
    while iterations < max_iterations
        && (iterations < LEAST_STEPS_OF_AN_APPROACH || complementarity > near * at.f.value)
    {
        let Some(step) = at.step(&row_of) else { return Ok(None) };
        let by_tangents = at.advance(&step);
        iterations += 1;
        let there = Progress { iteration: iterations, complementarity: by_tangents };
        complementarity = at.complementarity();
        if complementarity <= REFERRED_AGAIN * referred_at {
            merit.refer_to(there, &at.density, true)?;
            referred_at = complementarity;
        }
        at.f = merit.evaluate(there, &at.density).0;
    }
    let mean_product = complementarity / (at.c.len() + at.room.len()) as f64;
    let Iterate { density, z, y, f, .. } = at;
    Ok(Some(Approach { density, duals: [z, y], value: f.value, mean_product, iterations }))
}

/// An iterate that keeps the rows themselves.
struct Executable {
    density: Vec<f64>,
    value: f64,
    relative_gap: f64,
}

/// The step by (2).
struct Step {
    density: Vec<f64>,
    /// Change of the slacks by the tangents: J d, less the excess.
    c: Vec<f64>,
    z: Vec<f64>,
    y: Vec<f64>,
}

/// Products of slacks and their dual variables: c z (rows) and (D - lo) y (n).
struct Products {
    rows: Vec<f64>,
    bounds: Vec<f64>,
}

impl Products {
    fn sum(&self) -> f64 {
        self.rows.iter().sum::<f64>() + self.bounds.iter().sum::<f64>()
    }

    fn combined(&self, other: &Self, of: impl Fn(f64, f64) -> f64) -> Self {
        let each = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| of(*a, *b)).collect();
        Self { rows: each(&self.rows, &other.rows), bounds: each(&self.bounds, &other.bounds) }
    }

    fn plus(&self, other: &Self) -> Self {
        self.combined(other, |a, b| a + b)
    }

    fn minus(&self, other: &Self) -> Self {
        self.combined(other, |a, b| a - b)
    }

    /// Change of the products that brings outliers back to within a decade of `mu`.
    fn correction(&self, mu: f64) -> Self {
        let of = |v: &f64| (v.clamp(mu / OUTLIER, mu * OUTLIER) - v).max(-mu * OUTLIER);
        Self {
            rows: self.rows.iter().map(of).collect(),
            bounds: self.bounds.iter().map(of).collect(),
        }
    }
}

/// An iterate of the method.
struct Iterate<'a> {
    program: &'a Program<'a>,
    density: Vec<f64>,
    f: Objective,
    /// The rows here; or the tangents that are kept, with what they leave here.
    here: Vec<Constraint>,
    /// Slacks of the rows and of the bounds, and their dual variables.
    c: Vec<f64>,
    room: Vec<f64>,
    z: Vec<f64>,
    y: Vec<f64>,
    /// Excess of c over the slacks that the tangents that are kept allow.
    excess: Vec<f64>,
    /// The iterate whose tangents are kept; `None` while the rows themselves are used.
    kept: Option<Kept>,
}

/// An iterate whose tangents are kept.
struct Kept {
    density: Vec<f64>,
    value: f64,
    c: Vec<f64>,
    /// Smallest proven gap, nm^2.
    gap: f64,
}

impl<'a> Iterate<'a> {
    fn new(program: &'a Program<'a>, start: Start, f: Objective) -> Self {
        let density = start.density;
        let here = program.rows.constraints(&density);
        let c: Vec<f64> = here.iter().map(|row| row.slack).collect();
        let room: Vec<f64> = density.iter().zip(program.lo).map(|(d, lo)| d - lo).collect();
        let members = (c.len() + room.len()) as f64;
        let [z, y] = match start.duals {
            Some([z, y]) => {
                // Products far below their mean would hold the steps back.
                let least = LEAST_PRODUCT * (dot(&c, &z) + dot(&room, &y)) / members;
                let raised = |v: Vec<f64>, slack: &[f64]| -> Vec<f64> {
                    v.into_iter().zip(slack).map(|(v, slack)| v.max(least / slack)).collect()
                };
                [raised(z, &c), raised(y, &room)]
            }
            None => {
                let mu = FIRST_RELATIVE_GAP * f.value / members;
                [&c, &room].map(|slack| slack.iter().map(|c| mu / c).collect())
            }
        };
        let excess = vec![0.0; c.len()];
        Self { program, density, f, here, c, room, z, y, excess, kept: None }
    }

    fn complementarity(&self) -> f64 {
        dot(&self.c, &self.z) + dot(&self.room, &self.y)
    }

    /// Upper bound on the excess of f over its least value under the tangents, nm^2. With the inverse of its
    /// curvature a closer bound is tried, if it can decide whether `relative_gap` is reached.
    fn gap(&self, inverse: Option<&Inverse<'_>>, relative_gap: f64, merit: &Merit<'_>) -> f64 {
        let alpha = merit.alpha;
        // f' - J' z
        let mut r = self.f.gradient.clone();
        add_adjoint(&self.here, |i| -self.z[i], &mut r);
        let of_tangents = dot(&self.c, &self.z) - dot(&self.excess, &self.z);
        let simple = of_tangents + certificate::by_alpha(&r, &self.room, alpha);
        let Some(inverse) = inverse else { return simple };
        r.iter_mut().zip(&self.y).for_each(|(r, y)| *r -= y);
        let products = of_tangents + dot(&self.room, &self.y);
        // Gap that proves that the iterate whose tangents are kept is good enough, or that their program is solved.
        let wanted = match &self.kept {
            None => relative_gap * self.f.value,
            Some(kept) => (relative_gap * kept.value - (kept.value - self.f.value))
                .max(PROGRAM_SOLVED * relative_gap * self.f.value),
        };
        if products > wanted {
            return simple;
        }
        let of_use = wanted - products;
        let product = |d: &[f64]| merit.lower_curvature(d);
        let square = certificate::by_curvature(&r, alpha, of_use, product, |e| inverse.solve(e));
        simple.min(products + square)
    }

    /// The iterate whose rows the tangents are, and its proven gap: the excess over their least value, from the `gap`
    /// here.
    fn executable(&mut self, gap: f64) -> Executable {
        let (density, value, gap) = match &mut self.kept {
            None => (&self.density, self.f.value, gap),
            Some(kept) => {
                kept.gap = kept.gap.min(kept.value - self.f.value + gap);
                (&kept.density, kept.value, kept.gap)
            }
        };
        Executable { density: density.clone(), value, relative_gap: gap / value }
    }

    /// Replaces the rows by their tangents for the steps that follow; `gap` is the proven gap so far, nm^2.
    fn keep_tangents(&mut self, gap: f64) {
        let (density, value, c) = (self.density.clone(), self.f.value, self.c.clone());
        self.kept = Some(Kept { density, value, c, gap });
        self.here.iter_mut().for_each(|row| row.bend = [0.0; 3]);
        let mean = self.complementarity() / (self.c.len() + self.room.len()) as f64;
        let product = RAISED_PRODUCT * mean;
        for ((c, z), excess) in self.c.iter_mut().zip(&mut self.z).zip(&mut self.excess) {
            if *c < ACTIVE_SLACK {
                let before = *c;
                *c = (product / *z).clamp(before, ACTIVE_SLACK);
                *excess = *c - before;
            }
            *z = z.max(product / *c);
        }
        self.y.iter_mut().zip(&self.room).for_each(|(y, room)| *y = y.max(product / room));
    }

    /// Moves from where the tangents were kept towards this iterate, as far as the rows allow, and returns to the
    /// rows.
    fn move_towards_solution(&mut self) {
        let Some(kept) = self.kept.take() else { return };
        self.excess.fill(0.0);
        let by: Vec<f64> = self.density.iter().zip(&kept.density).map(|(d, k)| d - k).collect();
        let (t, to) = self.program.farthest(&kept.density, &by, &kept.c, 1.0);
        self.move_to(if t >= LEAST_PART { to } else { kept.density });
    }

    /// The rows at other densities.
    fn move_to(&mut self, density: Vec<f64>) {
        self.here = self.program.rows.constraints(&density);
        self.c = self.here.iter().map(|row| row.slack).collect();
        self.room = density.iter().zip(self.program.lo).map(|(d, lo)| d - lo).collect();
        self.density = density;
    }

    /// (2) with Mehrotra's mu, and Gondzio's corrections.
    fn step(&self, row_of: &[usize]) -> Option<Step> {
        let inverse = self.inverse(row_of)?;
        let (rows, bounds) = (self.c.len(), self.room.len());
        let complementarity = self.complementarity();
        let towards = |t: &Products| self.direction(&inverse, t, &self.excess);
        let zero = Products { rows: vec![0.0; rows], bounds: vec![0.0; bounds] };
        let predictor = towards(&zero);
        let after = self.products(&predictor, self.primal(&predictor).0, self.dual(&predictor));
        let centring = (after.sum() / complementarity).powi(3).clamp(LEAST_CENTRING, 1.0);
        let mu = centring * complementarity / (rows + bounds) as f64;
        let second = self.second_order(&predictor);
        let centred = Products { rows: vec![mu; rows], bounds: vec![mu; bounds] };
        let mut target = centred.minus(&second);
        let mut step = towards(&target);
        for _ in 0..MAX_CENTRALITY_CORRECTIONS {
            let (a, b) = (self.by_tangents(&step), self.dual(&step));
            let [further_a, further_b] = [a, b].map(|v| (v + FURTHER).min(1.0));
            let correction = self.products(&step, further_a, further_b).correction(mu);
            let corrected = target.plus(&correction);
            let next = towards(&corrected);
            let gained = (self.by_tangents(&next) - a, self.dual(&next) - b);
            if gained.0.min(gained.1) < 0.0 || gained.0.max(gained.1) < LEAST_GAIN * FURTHER {
                break;
            }
            (target, step) = (corrected, next);
        }
        if self.kept.is_none() {
            step = self.around_bends(&inverse, &target, step);
        }
        Some(step)
    }

    /// A longer step where bends end it early.
    ///
    /// ```text
    /// c(D + t d) = c + t J d - q,   and d' instead of d with   J d' = J d + q / t as far as (2) allows   (3)
    /// ```
    ///
    /// The curvature C of (2) makes d shorter where a bend costs much, but it makes no step avoid a row. So a row
    /// with little slack, along which the other rows let the iterate go far, ends one step after another, wherever
    /// its tangent points.
    fn around_bends(&self, inverse: &Inverse<'_>, target: &Products, mut step: Step) -> Step {
        let mut length = self.primal(&step).0;
        let mut wanted = self.by_tangents(&step);
        for _ in 0..MAX_BEND_CORRECTIONS {
            if length >= LONG_ENOUGH * wanted {
                break;
            }
            let there = self.program.rows.slacks(&moved(&self.density, &step.density, wanted));
            let by_tangents = along(&self.here, &step.density);
            let bends = (self.c.iter().zip(&by_tangents).zip(&there))
                .map(|((c, d), there)| ((c - there) / wanted + d).max(0.0));
            let next = self.direction(inverse, target, &bends.collect::<Vec<f64>>());
            let farther = self.primal(&next).0;
            if farther > length {
                (step, length) = (next, farther);
                wanted = wanted.min(self.by_tangents(&step));
            } else {
                // (3) of a shorter step: q is of the second order in its length.
                wanted = (wanted * length).sqrt();
            }
        }
        step
    }

    /// Goes the longest step that is allowed, and returns the complementarity there by the tangents.
    fn advance(&mut self, step: &Step) -> f64 {
        let (length, to) = self.primal(step);
        let b = self.dual(step);
        let after = self.products(step, length, b).sum();
        self.z.iter_mut().zip(&step.z).for_each(|(z, d)| *z += b * d);
        self.y.iter_mut().zip(&step.y).for_each(|(y, d)| *y += b * d);
        if self.kept.is_some() {
            self.c.iter_mut().zip(&step.c).for_each(|(c, d)| *c += length * d);
            self.excess.iter_mut().for_each(|e| *e *= 1.0 - length);
            self.room.iter_mut().zip(&step.density).for_each(|(room, d)| *room += length * d);
            self.density = to;
        } else {
            self.move_to(to);
        }
        after
    }

    /// The matrix of (2), factorised; `row_of` has the row of every node. `None` if it is singular to rounding.
    fn inverse(&self, row_of: &[usize]) -> Option<Inverse<'_>> {
        let chain = self.program.chain;
        let mut diagonal: Vec<f64> =
            (0..row_of.len()).map(|j| chain.0[j] + self.y[j] / self.room[j]).collect();
        let mut below = chain.1.to_vec();
        for ((row, z), c) in self.here.iter().zip(&self.z).zip(&self.c) {
            let (s, by, bend) = (z / c, row.by, row.bend.map(|b| z * b));
            for e in 0..2 {
                if let Some(j) = row.nodes[e] {
                    diagonal[j] += s * by[e] * by[e] + bend[2 * e];
                }
            }
            if let [Some(_), Some(b)] = row.nodes {
                below[b] += s * by[0] * by[1] + bend[1];
            }
        }
        self.program.inverse(row_of, (&diagonal, &below))
    }

    /// The step by (2) with `target` in the place of mu, and slacks that are `excess` (rows) larger than they should
    /// be.
    fn direction(&self, inverse: &Inverse<'_>, target: &Products, excess: &[f64]) -> Step {
        let Self { f, here, c, room, z, y, .. } = self;
        let t = target.bounds.iter().zip(room).map(|(t, room)| t / room);
        let mut rhs: Vec<f64> = f.gradient.iter().zip(t).map(|(g, t)| t - g).collect();
        add_adjoint(here, |i| (target.rows[i] + z[i] * excess[i]) / c[i], &mut rhs);
        let d = inverse.solve(&rhs);
        let mut j_d = along(here, &d);
        j_d.iter_mut().zip(excess).for_each(|(c, e)| *c -= e);
        let of_z = |i: usize| (target.rows[i] - z[i] * j_d[i]) / c[i] - z[i];
        let of_y = |j: usize| (target.bounds[j] - y[j] * d[j]) / room[j] - y[j];
        Step {
            z: (0..c.len()).map(of_z).collect(),
            y: (0..d.len()).map(of_y).collect(),
            c: j_d,
            density: d,
        }
    }

    /// The longest step by the tangents of the rows.
    fn by_tangents(&self, step: &Step) -> f64 {
        longest(&self.room, &step.density).min(longest(&self.c, &step.c))
    }

    /// The longest step, and where it ends: by the rows themselves, unless their tangents are kept.
    fn primal(&self, step: &Step) -> (f64, Vec<f64>) {
        // The tangents say nearly how far.
        let length = self.by_tangents(step);
        match self.kept {
            None => self.program.farthest(&self.density, &step.density, &self.c, length),
            Some(_) => (length, moved(&self.density, &step.density, length)),
        }
    }

    fn dual(&self, step: &Step) -> f64 {
        longest(&self.z, &step.z).min(longest(&self.y, &step.y))
    }

    /// The products after a primal step of length `a` and a dual one of length `b`, by the tangents.
    fn products(&self, step: &Step, a: f64, b: f64) -> Products {
        let of = |v: &[f64], dv: &[f64], z: &[f64], dz: &[f64]| {
            (0..v.len()).map(|i| (v[i] + a * dv[i]) * (z[i] + b * dz[i])).collect()
        };
        Products {
            rows: of(&self.c, &step.c, &self.z, &step.z),
            bounds: of(&self.room, &step.density, &self.y, &step.y),
        }
    }

    /// Second-order terms of the products after a full step.
    fn second_order(&self, step: &Step) -> Products {
        let of = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect();
        Products { rows: of(&step.c, &step.z), bounds: of(&step.density, &step.y) }
    }
}

/// The longest step, at most 1, after which no component of `v` is below a twentieth of itself.
fn longest(v: &[f64], d: &[f64]) -> f64 {
    let of = |(v, d): (&f64, &f64)| if *d < 0.0 { -STEP_TO_BOUNDARY * v / d } else { 1.0 };
    v.iter().zip(d).map(of).fold(1.0, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        curve::{Rounding, curves},
        merit::Price,
        mesh::Mesh,
    };
    use clarabel::{
        algebra::CscMatrix,
        solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, SupportedConeT},
    };
    use ndarray::Array2;
    use planish_dwell::residual::{Free, Residual};
    use planish_types::{Axis, Grid, Limits, MachineFile, MachineFileAxis, Surface, Tif, ToolPath};

    fn machine(velocity: f64, acceleration: f64) -> Limits {
        let axis = |name: &str, factor: f64| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: factor * velocity,
            max_acceleration_mm_per_s2: factor * acceleration,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x", 1.0), axis("y", 0.6)];
        MachineFile { name: "test".into(), axes, min_segment_s: 0.0, ..MachineFile::default() }
            .checked()
            .unwrap()
    }

    fn sparse(rows: &[Vec<(usize, f64)>], columns: usize) -> CscMatrix<f64> {
        let mut triplets: (Vec<usize>, Vec<usize>, Vec<f64>) = Default::default();
        for (i, row) in rows.iter().enumerate() {
            for (j, v) in row.iter().filter(|(_, v)| *v != 0.0) {
                triplets.0.push(i);
                triplets.1.push(*j);
                triplets.2.push(*v);
            }
        }
        CscMatrix::new_from_triplets(rows.len(), columns, triplets.0, triplets.1, triplets.2)
    }

    /// Another solver on the convex program of the last iterate: f is exactly quadratic, the rows are tangents.
    #[test]
    fn the_certificate_holds_by_another_solver() {
        let own = Axis::new(-2.0, 0.25, 17).unwrap();
        let g = Grid { x: own, y: own };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            20.0 * (-(g.x.at(c).powi(2) + g.y.at(r).powi(2)) / 0.8).exp()
        });
        let tif = Tif::new(g, rate).unwrap();
        let axis = |n: usize| Axis::new(0.0, 0.25, n).unwrap();
        let grid = Grid { x: axis(41), y: axis(21) };
        let z = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let bump = (-((c as f64 - 14.0).powi(2) + (r as f64 - 9.0).powi(2)) / 30.0).exp();
            20.0 + 15.0 * bump + 3.0 * (0.2 * c as f64).sin()
        });
        let desired = Surface::new(grid, z).unwrap();
        let mut points = Vec::new();
        for line in 0..8 {
            let (y, ends) = (0.9 * f64::from(line) - 0.6, [-2.0, 12.0]);
            let (from, to) = if line % 2 == 0 { (ends[0], ends[1]) } else { (ends[1], ends[0]) };
            points.extend([[from, y], [to, y]]);
        }
        let n = points.len() - 1;
        let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
        let curves = curves(&path, &Rounding { deviation_mm: 0.1, radius_mm: 0.5 }).curves;
        let mesh = Mesh::new(&curves, &path, 0.7).unwrap();
        let residual = Residual::new(&desired, &tif, &mesh.points_mm, None, Free::Piston).unwrap();
        let normal = residual.normal(&mesh.columns(), None).unwrap();
        let strongest = normal.matrix.diagonal().into_iter().fold(0.0, f64::max);
        let lengths = mesh.lengths_mm();
        for (acceleration, price, alpha) in [(400.0, 1e-4, 1e-4), (4000.0, 1e-3, 1e-3)] {
            let rows = Rows::new(&curves, &mesh, &machine(60.0, acceleration), 0.1);
            let lo = rows.least_density().to_vec();
            let tikhonov = alpha;
            let alpha = alpha * strongest;
            let objective = |d: &[f64]| {
                let at = residual.evaluate(&mesh.times_s(d));
                let mut gradient = mesh.collect(&at.gradient_nm2_per_s);
                let mut value = at.half_mean_square_nm2;
                for j in 0..mesh.nodes {
                    value += price * lengths[j] * d[j] + 0.5 * alpha * (d[j] - lo[j]).powi(2);
                    gradient[j] += price * lengths[j] + alpha * (d[j] - lo[j]);
                }
                (value, gradient)
            };
            let least = lo.iter().copied().fold(rows.least_uniform_density(), f64::max);
            let stop = Stop { relative_gap: 1e-3, max_iterations: 100 };
            let density = vec![(1.05 * least).max(0.3); mesh.nodes];
            let wanted = Price::Nm2PerS(price);
            let weights = (tikhonov, 0.0);
            let mut merit = Merit::new(&residual, &normal, &mesh, &lo, weights, wanted, &density);
            let chain = merit.chain();
            let chain = (&chain.0[..], &chain.1[..]);
            let program = Program { normal: &normal, chain, lo: &lo, rows: &rows };
            let start = Start { density: density.clone(), duals: None };
            let solution = solve(&program, start, &stop, &mut merit).unwrap().unwrap();
            assert_eq!(solution.end, End::Optimal);
            let d = &solution.density;
            // Where it ended f is that of the removal itself; far from there what the cells lose is missing, some percent
            // of what the difference of the densities removes.
            let there = Progress { iteration: 0, complementarity: 0.0 };
            let (value, gradient) = objective(d);
            assert!((solution.objective.last().unwrap() / value - 1.0).abs() < 1e-9);
            let (far, before) = (merit.evaluate(there, &density).0, objective(&density));
            let x: Vec<f64> = density.iter().zip(d).map(|(a, b)| a - b).collect();
            let linear = value + dot(&gradient, &x);
            assert!((far.value - before.0).abs() < 0.02 * (before.0 - linear), "{}", far.value);
            // Cells are of one pixel here, so what proves is the curvature of the removal, exactly: f is quadratic.
            let product = merit.lower_curvature(&x);
            let largest = product.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            for ((found, a), b) in product.iter().zip(&before.1).zip(&gradient) {
                assert!((found - (a - b)).abs() < 1e-9 * largest, "{found} {}", a - b);
            }
            assert!(rows.slacks(d).iter().all(|c| *c > 0.0));
            assert!(d.iter().zip(&lo).all(|(d, lo)| d > lo));

            // f(D + x) = f + f' x + x' H x / 2, H column by column from differences, exact for a quadratic
            let mut h = vec![Vec::new(); mesh.nodes];
            for j in 0..mesh.nodes {
                let mut moved = d.clone();
                moved[j] += 1.0;
                let column = objective(&moved).1;
                for i in 0..=j {
                    h[i].push((j, column[i] - gradient[i]));
                }
            }
            // -J x <= c, -x <= D - lo
            let constraints = rows.constraints(d);
            let mut a: Vec<Vec<(usize, f64)>> = constraints
                .iter()
                .map(|row| (0..2).filter_map(|k| row.nodes[k].map(|n| (n, -row.by[k]))).collect())
                .collect();
            a.extend((0..mesh.nodes).map(|j| vec![(j, -1.0)]));
            let mut b: Vec<f64> = constraints.iter().map(|row| row.slack).collect();
            b.extend(d.iter().zip(&lo).map(|(d, lo)| d - lo));
            let settings = DefaultSettingsBuilder::default().verbose(false).build().unwrap();
            let cones = [SupportedConeT::NonnegativeConeT(b.len())];
            let (h, a) = (sparse(&h, mesh.nodes), sparse(&a, mesh.nodes));
            let mut other = DefaultSolver::new(&h, &gradient, &a, &b, &cones, settings).unwrap();
            other.solve();
            let could_fall = -other.solution.obj_val;
            // What is left to gain is real, and within the certificate; clarabel's tolerance is 1e-8.
            assert!(could_fall > -1e-7 * value, "{could_fall} of {value}");
            assert!(could_fall <= solution.relative_gap * value * (1.0 + 1e-6));
            assert!(solution.relative_gap <= 1e-3);
            // Rows decide: without them the objective would be lower.
            let active = constraints.iter().filter(|row| row.slack < 1e-3).count();
            assert!(active > 5, "{active} rows are active");
        }
    }
}
