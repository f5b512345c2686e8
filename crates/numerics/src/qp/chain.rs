//! Convex quadratic programs on a chain, in which every bound couples at most two neighbours:
//!
//! ```text
//! min 1/2 x' P x - c' x + p' e                                                          (1)
//! subject to  a0 x_i + a1 x_{i+1} - k e_i <= b   for the rows of link i,   e >= 0
//! ```
//!
//! `P` is tridiagonal and positive definite; `x_i` and `x_{i+1}` are the ends of link `i`. Without
//! prices `p` there is no `e`, and the rows are hard. With prices, `k e_i` is the allowed excess
//! over the bound of a row.
//!
//! The method is Mehrotra's predictor-corrector interior point method (SIAM J. Optim. 2 (1992)
//! 575). With the slacks `s = b - G x`, the multipliers `l` and `D = diag(l / s)`, a step solves
//!
//! ```text
//! (P + G' D G) dx = c - P x - G' (t + D r_p)                                            (2)
//! ds = -r_p - G dx,   dl = t - l - D ds,   r_p = G x + s - b
//! predictor: t = 0;   corrector: t = (sigma mu - ds dl) / s  with ds, dl of the predictor
//! ```
//!
//! (`s (l + dl) + l ds = s t` is the target of the complementarity.) With m rows, and the longest step
//! a <= 1 of the predictor that keeps s and l at or above 0,
//!
//! ```text
//! mu = s'l / m,   sigma = ((s + a ds)'(l + a dl) / s'l)^3                                (4)
//! ```
//!
//! If mu has not fallen by a tenth below its lowest value so far, the corrector has sigma = 0.3 and no
//! `ds dl`. Its step, one length for x, s and l, ends a little before s or l would be 0.
//!
//! Since a row couples neighbours
//! only, the matrix of (2) is tridiagonal. Time and memory of an iteration are therefore
//! proportional to the length of the chain. The `e_i` of a link is eliminated within the link. The
//! remainder is a sum of squares again, without a difference,
//!
//! ```text
//! sum_j D_j (a_j - k_j m) (a_j - k_j m)',   m = sum_j D_j k_j a_j / sum_j D_j k_j^2      (3)
//! ```
//!
//! A long chain does not fit into the caches, so an iteration passes over it only four times.
//! Predictor and corrector take two passes each: forward (residual, factorisation, right-hand side)
//! and back (substitution). `r_p` and the predictor's `ds`, `dl` are computed again where they are
//! needed. The chain is eliminated from both ends towards the node in its middle, one half per
//! thread. The halves are the same on one thread, so the result is identical to the last bit.

use std::ops::Range;

use rayon::prelude::*;

/// Objective of the program (1) of the module, with n variables and n - 1 links between neighbours, without its
/// constraint rows.
#[derive(Clone, Debug, Default)]
pub struct ChainProgram {
    /// Diagonal elements P_ii (n) of the matrix P; > 0.
    pub diagonal: Vec<f64>,
    /// Elements P_{i,i+1} (n-1) of P beside the diagonal.
    pub beside: Vec<f64>,
    /// Linear coefficients c (n); the objective contains -c' x.
    pub linear: Vec<f64>,
    /// True for every free variable (n); the other variables are fixed at zero.
    pub free: Vec<bool>,
    /// Prices p (n-1) of the excess e_i of every link, > 0; empty if the rows are hard.
    pub price: Vec<f64>,
}

/// Constraint rows of a half of the chain, in the scaled variables y and with a largest coefficient of 1. Rows whose
/// coefficients are all zero are left out.
#[derive(Debug)]
pub struct ChainRows {
    row: Vec<ChainRow>,
    /// Coefficients k of the excess in every row; empty if the rows are hard.
    slack: Vec<f64>,
    /// Number of rows of the links 0 .. k, for every link k.
    end: Vec<usize>,
    elastic: bool,
    /// True if links and their two nodes come in descending order: in the upper half of the chain.
    up: bool,
    /// Scales w (x = w y) of the two nodes of the link to which rows are being added.
    w: [f64; 2],
    /// True if the program cannot be solved: a row without coefficients has a bound below zero.
    infeasible: bool,
}

#[derive(Clone, Copy, Debug)]
struct ChainRow {
    /// Coefficients of the two nodes of the link: the outer one (towards the end of the chain), and the inner one.
    a: [f64; 2],
    bound: f64,
}

impl ChainRows {
    /// Adds the constraint `a[0] x_i + a[1] x_{i+1} - k e_i <= bound` to the link i for which `rows` of [`solve`] was
    /// called. Without prices, `k` is ignored.
    pub fn add(&mut self, a: [f64; 2], k: f64, bound: f64) {
        let a = [a[0] * self.w[0], a[1] * self.w[1]];
        let k = if self.elastic { k } else { 0.0 };
        let size = a[0].abs().max(a[1].abs()).max(k);
        if size > 0.0 {
            let a = if self.up { [a[1] / size, a[0] / size] } else { a.map(|a| a / size) };
            self.row.push(ChainRow { a, bound: bound / size });
            if self.elastic {
                self.slack.push(k / size);
            }
        } else {
            self.infeasible |= bound < 0.0;
        }
    }

    /// Completes the rows of the present link; if it has a price, with the row `e >= 0`.
    fn end_link(&mut self) {
        let start = self.end.last().copied().unwrap_or(0);
        if self.elastic && self.row.len() > start {
            self.add([0.0; 2], 1.0, 0.0); // e >= 0
        }
        self.end.push(self.row.len());
    }

    /// Returns the range, in `row`, of the constraint rows of link k, counted from the end of the chain.
    fn of_link(&self, k: usize) -> Range<usize> {
        let start = if k == 0 { 0 } else { self.end[k - 1] };
        start..self.end[k]
    }
}

/// Reason why [`solve`] returns no solution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Failure {
    /// The constraint rows contradict each other: some multipliers `l >= 0` have `G' l = 0` and `b' l < 0`.
    Infeasible,
    /// The iteration did not reach the tolerance.
    NotConverged,
}

/// Largest primal residual r_p and mean complementarity at the end, in units in which P has a unit diagonal and the
/// largest linear term is 1. Larger: a less exact solution; at a row that is barely active, the error of y is the
/// square root of it. Smaller: rounding prevents convergence.
const TOLERANCE: f64 = 1e-14;

/// Largest dual residual r_d = P y - c + G' l at the end, in the units of [`TOLERANCE`]. It causes an error of the
/// same size in y. Larger: a less exact solution. Smaller: the iteration does not end, because r_d has the rounding of
/// `D r`, where D is up to 1 / [`TOLERANCE`] at an active row.
const DUAL_TOLERANCE: f64 = 1e-9;

/// Largest primal residual r_p and complementarity at which the iteration may end early, when rounding prevents more.
/// Larger: a less exact solution is accepted. Smaller: more programs fail.
const EARLY_END_TOLERANCE: f64 = 1e-9;

/// Largest number of iterations. Programs of 1e6 links take 7 to 40. Larger: more time before a
/// failure. Smaller: programs fail that would converge.
const MAX_ITERATIONS: usize = 150;

/// Smallest number of links at which a second thread is a gain. Larger: one thread for longer
/// chains. Smaller: the overhead of the thread exceeds its gain. It does not change the result.
const MIN_LINKS_PER_THREAD: usize = 2048;

/// Returns the solution x (n) of the program (1) of the module. `rows(i, to)` adds the rows of link i to `to`, in any
/// order, but in the same order at every call. The program is scaled in place, because a copy of a long one would take
/// as long as an iteration.
///
/// # Errors
/// Returns a failure if the rows contradict each other, or if the iteration does not reach the tolerance.
pub fn solve(
    mut program: ChainProgram,
    rows: impl Fn(usize, &mut ChainRows) + Sync,
) -> Result<Vec<f64>, Failure> {
    if program.diagonal.is_empty() {
        return Ok(Vec::new());
    }
    let (w, diagonal) = program.scale();
    if program.price.is_empty() {
        Chain::<false> { program: &program, diagonal }.solve(w, rows)
    } else {
        Chain::<true> { program: &program, diagonal }.solve(w, rows)
    }
}

impl ChainProgram {
    /// Scales (1) of the module to the variables y, x = w y. Then all diagonal elements are equal (1 without prices),
    /// the largest linear term is 1, and the objective is divided so that no price is above 1.
    ///
    /// Variables that are not free keep only their diagonal coefficient. Returns the scales w (n) and the common
    /// diagonal element; `diagonal` is empty afterwards.
    fn scale(&mut self) -> (Vec<f64>, f64) {
        // w_i = unit / sqrt(P_ii)
        let mut w = std::mem::take(&mut self.diagonal);
        let unit = (w.par_iter_mut().zip(&self.free).zip(&self.linear))
            .with_min_len(MIN_LINKS_PER_THREAD)
            .map(|((w, free), c)| {
                *w = if *free { 1.0 / w.sqrt() } else { 0.0 };
                (c * *w).abs()
            })
            .reduce(|| 0.0, f64::max);
        let unit = if unit > 0.0 { unit } else { 1.0 };
        // The objective is divided by unit^2 (1 + highest price).
        let highest = self.price.iter().copied().fold(0.0, f64::max) / (unit * unit);
        let diagonal = 1.0 / (1.0 + highest);
        for (beside, w) in self.beside.iter_mut().zip(w.windows(2)) {
            *beside *= diagonal * w[0] * w[1];
        }
        for (linear, w) in self.linear.iter_mut().zip(&mut w) {
            *linear *= diagonal * *w / unit;
            *w *= unit;
        }
        self.price.iter_mut().for_each(|p| *p *= diagonal / (unit * unit));
        (w, diagonal)
    }
}

/// State of a scaled variable y_k, called node, in the iteration.
#[derive(Clone, Copy, Default)]
struct Node {
    y: f64,
    /// In the forward pass: the right-hand side of (2) of the module, eliminated and divided by the pivot. In the
    /// backward pass: the step of y.
    dy: f64,
    /// Inverse of the pivot of this node in the elimination of the matrix of (2).
    inverse: f64,
    /// Element that couples this node with the next one towards the middle, divided by the pivot.
    below: f64,
}
impl Node {
    /// Moves y by the fraction `length` of its step, and returns the new y.
    fn advance(&mut self, length: f64) -> f64 {
        self.y += length * self.dy;
        self.y
    }
}
/// Slack s and multiplier l of a constraint row, or their steps ds and dl.
#[derive(Clone, Copy, Default)]
struct Pair {
    s: f64,
    l: f64,
}

/// Values of a constraint row during a step: coefficients a of its nodes, coefficient k of its excess (`slack`), slack
/// s, multiplier l, and step ds of s.
struct RowStep {
    a: [f64; 2],
    slack: f64,
    s: f64,
    l: f64,
    /// Element of the primal residual r_p = G y + s - b of this row.
    primal: f64,
    ds: f64,
}

/// State of the excess e of a link, by which its rows may exceed their bounds.
#[derive(Clone, Copy, Default)]
struct Excess {
    e: f64,
    /// Right-hand side of e in the forward pass, step of e in the backward pass.
    de: f64,
    /// Vector m of (3) of the module: the weighted mean of the row coefficients of the link.
    mean: [f64; 2],
    /// Inverse of the pivot of e: 1 / sum_j D_j k_j^2 over the rows j of the link.
    inverse: f64,
}

/// Numbers that the elimination of a node adds to the next node towards the middle.
#[derive(Clone, Copy, Default)]
struct Carry {
    /// Addition to the pivot of that node.
    pivot: f64,
    /// Addition to its right-hand side of (2) of the module.
    right: f64,
    /// Addition to its element of c - P y.
    gradient: f64,
    /// Addition to its element of G' l.
    multipliers: f64,
}

impl Carry {
    /// Returns the sum of both contributions, which come from the two halves.
    fn plus(self, other: Self) -> Self {
        Self {
            pivot: self.pivot + other.pivot,
            right: self.right + other.right,
            gradient: self.gradient + other.gradient,
            multipliers: self.multipliers + other.multipliers,
        }
    }
}

/// Elements of the system (2) of the module in the two nodes of a link: pivots, the element that couples them, and
/// right-hand sides.
struct Block {
    pivot: [f64; 2],
    off: f64,
    right: [f64; 2],
}

impl Block {
    /// Adds a constraint row: D b b' to the matrix, and -D r_p a to the right-hand side. `a` has its coefficients, `d`
    /// is D = l / s, and `primal` is its primal residual r_p. `b` is the vector `a_j - k_j m` of (3) of the module, or
    /// a if the row is hard.
    #[inline(always)]
    fn add(&mut self, b: [f64; 2], a: [f64; 2], d: f64, primal: f64) {
        self.pivot[0] += d * b[0] * b[0];
        self.pivot[1] += d * b[1] * b[1];
        self.off += d * b[0] * b[1];
        self.right[0] -= a[0] * d * primal;
        self.right[1] -= a[1] * d * primal;
    }

    /// Eliminates the outer node of the link (towards the end of the chain), and returns the numbers that this adds to
    /// the inner one.
    #[inline(always)]
    fn eliminate(self, node: &mut Node) -> Carry {
        let Self { pivot, off, right } = self;
        node.inverse = 1.0 / pivot[0];
        node.below = off * node.inverse;
        node.dy = right[0] * node.inverse;
        let right = right[1] - node.below * right[0];
        let pivot = pivot[1] - node.below * off;
        Carry { pivot, right, ..Carry::default() }
    }
}

/// Residuals that decide whether the iteration ends.
#[derive(Clone, Copy, Default)]
struct Residual {
    /// Sum over the rows, and later the mean, of the complementarity s l.
    mu: f64,
    /// Largest magnitude of the dual residual r_d = P y - c + G' l.
    largest_dual: f64,
    /// Largest magnitude of the primal residual r_p, and later the larger of that and mu.
    largest: f64,
    /// Sum -b' l over the rows, for the proof that the rows contradict each other.
    gain: f64,
    /// Sum of the multipliers l.
    total: f64,
    /// Largest magnitude of an element of G' l.
    largest_multipliers: f64,
}

impl Residual {
    /// Returns the residuals of both halves together.
    fn plus(self, other: Self) -> Self {
        Self {
            mu: self.mu + other.mu,
            largest_dual: worse(self.largest_dual, other.largest_dual),
            largest: worse(self.largest, other.largest),
            gain: self.gain + other.gain,
            total: self.total + other.total,
            largest_multipliers: worse(self.largest_multipliers, other.largest_multipliers),
        }
    }

    /// Returns true if primal residual and complementarity are at most `tolerance`, and the dual residual at most
    /// [`DUAL_TOLERANCE`] or `tolerance`, whichever is larger.
    fn is_within(&self, tolerance: f64) -> bool {
        self.largest <= tolerance && self.largest_dual <= DUAL_TOLERANCE.max(tolerance)
    }

    /// Returns true if the multipliers prove that no point satisfies the hard rows. A point y with
    /// G y <= b would have `-gain >= (G' l) . y >= -largest |y|_1`, so it would be huge.
    fn is_infeasible(&self) -> bool {
        self.gain > 1e-9 * self.total && self.largest_multipliers < 1e-10 * self.gain
    }
}

/// Inverse of the longest possible step, and the effect of the predictor's step on the complementarity s l.
#[derive(Clone, Copy, Default)]
struct Reach {
    /// Largest -ds / s or -dl / l over the rows: the inverse of the longest step with s >= 0 and l >= 0.
    inverse: f64,
    /// Sum of -ds dl over the rows, with the steps of the predictor.
    product: f64,
}

impl Reach {
    /// Returns the reach of both halves together.
    fn plus(self, other: Self) -> Self {
        let inverse = self.inverse.max(other.inverse);
        Self { inverse, product: self.product + other.product }
    }
}

/// Returns the larger number; NaN counts as the largest.
fn worse(a: f64, b: f64) -> f64 {
    if a >= b || a.is_nan() { a } else { b }
}

/// A scaled program. `ELASTIC` is true if it has prices, so that rows may exceed their bounds.
struct Chain<'a, const ELASTIC: bool> {
    program: &'a ChainProgram,
    /// Diagonal element of the scaled matrix P, the same for all variables.
    diagonal: f64,
}

impl<const ELASTIC: bool> Chain<'_, ELASTIC> {
    /// Returns the solution x = w y (n) of the program before it was scaled, from the scales `w` (n) and the rows as in
    /// the public [`solve`].
    fn solve(
        &self,
        mut w: Vec<f64>,
        rows: impl Fn(usize, &mut ChainRows) + Sync,
    ) -> Result<Vec<f64>, Failure> {
        let n = w.len();
        let diagonal = self.diagonal;
        let (mut low, mut high) = self.halves(&w, rows);
        if low.rows.infeasible || high.rows.infeasible {
            return Err(Failure::Infeasible);
        }
        let m = low.rows.row.len() + high.rows.row.len();
        let linear = self.program.linear[n / 2];
        /// Calls a method of both halves, on two threads if that is a gain.
        macro_rules! both {
            ($method:ident($($argument:expr),*)) => {
                if n < MIN_LINKS_PER_THREAD {
                    (low.$method($($argument),*), high.$method($($argument),*))
                } else {
                    rayon::join(|| low.$method($($argument),*), || high.$method($($argument),*))
                }
            };
        }

        // The minimiser without rows is a good start.
        let (a, b) = both!(eliminate_free());
        let c = a.plus(b);
        let mut y = (linear + c.right) / (diagonal + c.pivot);
        let mut dy = 0.0;
        both!(start(y));
        // The last point that would be accepted: rounding may spoil the next.
        let mut accepted: Option<Vec<f64>> = None;
        let mut lowest = f64::INFINITY;
        let mut length = 0.0;
        let mut solved = m == 0;
        for _ in 0..if solved { 0 } else { MAX_ITERATIONS } {
            y += length * dy;
            let ((a, ra), (b, rb)) = both!(advance_and_eliminate(length, y));
            let c = a.plus(b);
            let mut r = ra.plus(rb);
            let gradient = linear - diagonal * y + c.gradient;
            r.largest_dual = worse(r.largest_dual, (c.multipliers - gradient).abs());
            r.largest_multipliers = worse(r.largest_multipliers, c.multipliers.abs());
            r.mu /= m as f64;
            r.largest = worse(r.largest, r.mu);
            solved = r.is_within(TOLERANCE);
            if solved {
                break;
            }
            if r.is_within(EARLY_END_TOLERANCE) {
                accepted = Some(values(&low, y, &high));
            } else if accepted.is_some() || !r.largest.is_finite() {
                break;
            }
            if !ELASTIC && r.is_infeasible() {
                return Err(Failure::Infeasible);
            }
            // Predictor: sigma = 0, no second-order term.
            let inverse = 1.0 / (diagonal + c.pivot);
            dy = (gradient + c.right) * inverse;
            let (a, b) = both!(predict(y, dy));
            let sigma = centring(r.mu, a.plus(b), m);
            // Corrector. If mu did not fall, the second-order term can make the iteration cycle.
            // Then a step towards the centre without that term is taken.
            let (second, sigma) = if r.mu < 0.9 * lowest { (1.0, sigma) } else { (0.0, 0.3) };
            lowest = lowest.min(r.mu);
            let (a, b) = both!(eliminate_corrector(second, sigma * r.mu, y, dy));
            dy = (gradient + a.right + b.right) * inverse;
            let (a, b) = both!(correct(y, dy));
            length = ((1.0 - r.mu).clamp(0.995, 0.9999) / a.plus(b).inverse).min(1.0);
            if length.is_nan() || length <= 1e-13 {
                break;
            }
        }
        let y =
            if solved { values(&low, y, &high) } else { accepted.ok_or(Failure::NotConverged)? };
        w.iter_mut().zip(y).for_each(|(w, y)| *w *= y);
        Ok(w)
    }

    /// Makes the two halves of the chain (low, high), with the links from either end to the middle.
    fn halves(
        &self,
        w: &[f64],
        rows: impl Fn(usize, &mut ChainRows) + Sync,
    ) -> (Half<'_, ELASTIC>, Half<'_, ELASTIC>) {
        let half = |up| Half::new(self.program, self.diagonal, up, w, &rows);
        if w.len() < MIN_LINKS_PER_THREAD {
            (half(false), half(true))
        } else {
            rayon::join(|| half(false), || half(true))
        }
    }
}

/// Returns y of all nodes in order: those of the low half, the middle, those of the high half.
fn values<const ELASTIC: bool>(low: &Half<ELASTIC>, middle: f64, high: &Half<ELASTIC>) -> Vec<f64> {
    let nodes = low.node.iter().map(|node| node.y).chain([middle]);
    nodes.chain(high.node.iter().rev().map(|node| node.y)).collect()
}

/// Returns the centring parameter sigma of the corrector (Mehrotra, (4) of the module), from the mean complementarity
/// mu, the reach of the predictor and the number of rows m:
///
/// ```text
/// a     = min(1, 1 / max(-ds/s, -dl/l))
/// sigma = (sum (s + a ds) (l + a dl) / sum s l)^3,   the sum = sum s l (1 - a) + a^2 sum ds dl
/// ```
fn centring(mu: f64, reach: Reach, m: usize) -> f64 {
    let a = (1.0 / reach.inverse).min(1.0);
    let after = mu * (1.0 - a) - a * a * reach.product / m as f64;
    (after / mu).max(0.0).powi(3)
}

/// Half of the chain: links from one of its ends to its middle. Link k joins node k and node k + 1, counted from the
/// end. Node k + 1 of the last link is the middle, which is not in `node`.
struct Half<'a, const ELASTIC: bool> {
    program: &'a ChainProgram,
    /// Diagonal element of the scaled matrix P, the same for all variables.
    diagonal: f64,
    /// True if this is the half with the last nodes of the chain.
    up: bool,
    rows: ChainRows,
    node: Vec<Node>,
    pair: Vec<Pair>,
    /// Steps ds and dl of every row; before the backward pass of the corrector, `l` contains the t of (2) of the
    /// module.
    step: Vec<Pair>,
    excess: Vec<Excess>,
}

impl<'a, const ELASTIC: bool> Half<'a, ELASTIC> {
    /// Collects the constraint rows of the links of one half; `add(i, rows)` adds those of link i of the whole chain.
    /// `w` has the scales of the variables (n).
    fn new(
        program: &'a ChainProgram,
        diagonal: f64,
        up: bool,
        w: &[f64],
        add: impl Fn(usize, &mut ChainRows),
    ) -> Self {
        let n = w.len();
        let links = if up { n - 1 - n / 2 } else { n / 2 };
        let mut rows = ChainRows {
            row: Vec::new(),
            slack: Vec::new(),
            end: Vec::with_capacity(links),
            elastic: ELASTIC,
            up,
            w: [0.0; 2],
            infeasible: false,
        };
        for k in 0..links {
            let link = if up { n - 2 - k } else { k };
            rows.w = [w[link], w[link + 1]];
            add(link, &mut rows);
            rows.end_link();
        }
        let m = rows.row.len();
        Self {
            program,
            diagonal,
            up,
            rows,
            node: vec![Node::default(); links],
            pair: vec![Pair::default(); m],
            step: vec![Pair::default(); m],
            excess: vec![Excess::default(); if ELASTIC { links } else { 0 }],
        }
    }

    /// Returns the number of links of this half.
    fn links(&self) -> usize {
        self.node.len()
    }

    /// Returns the linear term c of the outer node of link k, and the element of P that couples both nodes.
    fn terms(&self, k: usize) -> (f64, f64) {
        let ChainProgram { linear, beside, .. } = self.program;
        if self.up {
            (linear[linear.len() - 1 - k], beside[beside.len() - 1 - k])
        } else {
            (linear[k], beside[k])
        }
    }

    /// Returns the price of the excess of link k.
    fn price(&self, k: usize) -> f64 {
        let price = &self.program.price;
        price[if self.up { price.len() - 1 - k } else { k }]
    }

    /// Returns the values of row j: its coefficients [outer, inner node], the coefficient k of its excess, and its
    /// bound.
    fn row(&self, j: usize) -> ([f64; 2], f64, f64) {
        let ChainRow { a, bound } = self.rows.row[j];
        (a, if ELASTIC { self.rows.slack[j] } else { 0.0 }, bound)
    }

    /// Eliminates the system P y = c, without constraint rows, from the end of the chain towards the middle. Returns
    /// what this adds to the middle node.
    fn eliminate_free(&mut self) -> Carry {
        let mut carry = Carry::default();
        for k in 0..self.links() {
            let (linear, beside) = self.terms(k);
            let node = &mut self.node[k];
            node.inverse = 1.0 / (self.diagonal + carry.pivot);
            node.below = beside * node.inverse;
            let right = linear + carry.right;
            node.dy = right * node.inverse;
            carry.pivot = -node.below * beside;
            carry.right = -node.below * right;
        }
        carry
    }

    /// Computes y by substitution from the middle, whose y is `middle`, and the first slacks and multipliers.
    fn start(&mut self, middle: f64) {
        let mut y1 = middle;
        for k in (0..self.links()).rev() {
            let node = &mut self.node[k];
            node.y = node.dy - node.below * y1;
            let y0 = node.y;
            for j in self.rows.of_link(k) {
                let (a, _, bound) = self.row(j);
                let s = (bound - (a[0] * y0 + a[1] * y1)).max(1.0);
                self.pair[j] = Pair { s, l: 1.0 };
                self.step[j] = Pair::default();
            }
            y1 = y0;
        }
    }

    /// Moves by the fraction `length` of the last step, computes the residuals there, and eliminates (2) of the
    /// predictor towards the middle. `middle` is the new y of the middle node. Returns what this adds to the middle
    /// node, and the residuals.
    fn advance_and_eliminate(&mut self, length: f64, middle: f64) -> (Carry, Residual) {
        let mut carry = Carry::default();
        let mut r = Residual::default();
        let mut y1 = if self.links() > 0 { self.node[0].advance(length) } else { middle };
        for k in 0..self.links() {
            let y0 = y1;
            y1 = if k + 1 < self.links() { self.node[k + 1].advance(length) } else { middle };
            let (linear, beside) = self.terms(k);
            // c - P y
            let gradient = linear - self.diagonal * y0 - beside * y1 + carry.gradient;
            let mut multipliers = [carry.multipliers, 0.0];
            let mut block = Block {
                pivot: [self.diagonal + carry.pivot, 0.0],
                off: beside,
                right: [gradient + carry.right, 0.0],
            };
            let rows = self.rows.of_link(k);
            let mut excess = Excess::default();
            if ELASTIC {
                excess.e = self.excess[k].e + length * self.excess[k].de;
            }
            let price = if ELASTIC && !rows.is_empty() { self.price(k) } else { 0.0 };
            let mut dual_e = price;
            let mut square = 0.0;
            let mut right_e = -price;
            for j in rows.clone() {
                let (a, slack, bound) = self.row(j);
                let pair = &mut self.pair[j];
                let step = &mut self.step[j];
                pair.s += length * step.s;
                pair.l += length * step.l;
                let Pair { s, l } = *pair;
                let primal = a[0] * y0 + a[1] * y1 - slack * excess.e + (s - bound);
                // Its rounding is that of a sum of numbers of order 1.
                let rounding = 16.0 * f64::EPSILON * (1.0 + bound.abs() + s);
                r.largest = worse(r.largest, primal.abs() - rounding);
                r.mu += s * l;
                multipliers[0] += a[0] * l;
                multipliers[1] += a[1] * l;
                r.gain -= bound * l;
                r.total += l;
                let d = l / s;
                if ELASTIC {
                    dual_e -= slack * l;
                    excess.mean[0] += d * slack * a[0];
                    excess.mean[1] += d * slack * a[1];
                    square += d * slack * slack;
                    right_e += slack * d * primal;
                    // The loop below uses these values.
                    *step = Pair { s: primal, l: d };
                } else {
                    block.add(a, a, d, primal);
                }
            }
            if ELASTIC && !rows.is_empty() {
                excess.mean = excess.mean.map(|c| c / square);
                excess.inverse = 1.0 / square;
                excess.de = right_e;
                let m = excess.mean;
                for j in rows {
                    let (a, slack, _) = self.row(j);
                    let Pair { s: primal, l: d } = self.step[j];
                    block.add([a[0] - slack * m[0], a[1] - slack * m[1]], a, d, primal);
                }
                // M_ye = -sum D a k, and M_ye / M_ee = -m
                block.right[0] += m[0] * right_e;
                block.right[1] += m[1] * right_e;
                r.largest_dual = worse(r.largest_dual, dual_e.abs());
            }
            if ELASTIC {
                self.excess[k] = excess;
            }
            r.largest_dual = worse(r.largest_dual, (multipliers[0] - gradient).abs());
            r.largest_multipliers = worse(r.largest_multipliers, multipliers[0].abs());
            carry = block.eliminate(&mut self.node[k]);
            carry.gradient = -beside * y0;
            carry.multipliers = multipliers[1];
        }
        (carry, r)
    }

    /// Computes the step of node k and of the excess of its link by substitution, from the step `dy1` of the inner
    /// node. Returns the step of node k.
    fn substitute(&mut self, k: usize, dy1: f64) -> f64 {
        let node = &mut self.node[k];
        node.dy -= node.below * dy1;
        let dy0 = node.dy;
        if ELASTIC {
            // M_ee de = right_e - M_ey dy
            let excess = &mut self.excess[k];
            let m = excess.mean;
            excess.de = excess.de * excess.inverse + m[0] * dy0 + m[1] * dy1;
        }
        dy0
    }

    /// Returns the excess e of link k and its step; zeros if the rows are hard.
    fn excess_of(&self, k: usize) -> (f64, f64) {
        if ELASTIC { (self.excess[k].e, self.excess[k].de) } else { (0.0, 0.0) }
    }

    /// Returns the values of row j during a step. The arguments are y of the two nodes of its link and their steps, and
    /// the excess e of the link and its step.
    #[inline(always)]
    fn step_of(&self, j: usize, y: [f64; 2], dy: [f64; 2], (e, de): (f64, f64)) -> RowStep {
        let (a, slack, bound) = self.row(j);
        let Pair { s, l } = self.pair[j];
        let primal = a[0] * y[0] + a[1] * y[1] - slack * e + (s - bound);
        let ds = -primal - (a[0] * dy[0] + a[1] * dy[1] - slack * de);
        RowStep { a, slack, s, l, primal, ds }
    }

    /// Computes the steps of the predictor by substitution from the middle outwards, and returns their reach. `middle`
    /// and `step` are y of the middle node and its step.
    fn predict(&mut self, middle: f64, step: f64) -> Reach {
        let mut reach = Reach::default();
        let mut y1 = middle;
        let mut dy1 = step;
        for k in (0..self.links()).rev() {
            let y0 = self.node[k].y;
            let dy0 = self.substitute(k, dy1);
            let excess = self.excess_of(k);
            for j in self.rows.of_link(k) {
                let RowStep { s, l, ds, .. } = self.step_of(j, [y0, y1], [dy0, dy1], excess);
                // dl = -l - D ds = -l (1 + ds/s)
                let ratio = ds / s;
                reach.inverse = reach.inverse.max(-ratio).max(1.0 + ratio);
                reach.product += s * l * ratio * (1.0 + ratio);
            }
            y1 = y0;
            dy1 = dy0;
        }
        reach
    }

    /// Eliminates (2) of the corrector towards the middle. `second` is the factor of the second-order term ds dl, and
    /// `sigma_mu` the target of the complementarity. `middle` and `step` are y of the middle node and its step by the
    /// predictor.
    fn eliminate_corrector(&mut self, second: f64, sigma_mu: f64, middle: f64, step: f64) -> Carry {
        let mut carry = Carry::default();
        let mut inner = self.y_and_step(0, middle, step);
        for k in 0..self.links() {
            let (y0, dy0) = inner;
            inner = self.y_and_step(k + 1, middle, step);
            let (y1, dy1) = inner;
            let (linear, beside) = self.terms(k);
            let gradient = linear - self.diagonal * y0 - beside * y1 + carry.gradient;
            let mut right = [gradient + carry.right, 0.0];
            let rows = self.rows.of_link(k);
            let excess = self.excess_of(k);
            let mut right_e = if ELASTIC && !rows.is_empty() { -self.price(k) } else { 0.0 };
            for j in rows {
                let RowStep { a, slack, s, l, primal, ds } =
                    self.step_of(j, [y0, y1], [dy0, dy1], excess);
                // t = (sigma mu - ds dl) / s,  dl = -l (1 + ds/s)
                let inverse = 1.0 / s;
                let ratio = ds * inverse;
                let t = second * l * ratio * (1.0 + ratio) + sigma_mu * inverse;
                self.step[j].l = t;
                let v = t + l * inverse * primal;
                right[0] -= a[0] * v;
                right[1] -= a[1] * v;
                right_e += slack * v;
            }
            if ELASTIC {
                let excess = &mut self.excess[k];
                excess.de = right_e;
                right[0] += excess.mean[0] * right_e;
                right[1] += excess.mean[1] * right_e;
            }
            let node = &mut self.node[k];
            node.dy = right[0] * node.inverse;
            carry.right = right[1] - node.below * right[0];
            carry.gradient = -beside * y0;
        }
        carry
    }

    /// Returns y of node k and its step; those of the middle node if k is beyond the last one.
    #[inline(always)]
    fn y_and_step(&self, k: usize, middle: f64, step: f64) -> (f64, f64) {
        self.node.get(k).map_or((middle, step), |node| (node.y, node.dy))
    }

    /// Computes the steps of the corrector by substitution from the middle outwards, and returns their reach. `middle`
    /// and `step` are y of the middle node and its step.
    fn correct(&mut self, middle: f64, step: f64) -> Reach {
        let mut reach = Reach::default();
        let mut y1 = middle;
        let mut dy1 = step;
        for k in (0..self.links()).rev() {
            let y0 = self.node[k].y;
            let dy0 = self.substitute(k, dy1);
            let excess = self.excess_of(k);
            for j in self.rows.of_link(k) {
                let RowStep { s, l, ds, .. } = self.step_of(j, [y0, y1], [dy0, dy1], excess);
                // 1/s and 1/l by one division.
                let inverse = 1.0 / (s * l);
                let dl = self.step[j].l - l - l * (l * inverse) * ds;
                self.step[j] = Pair { s: ds, l: dl };
                reach.inverse = reach.inverse.max(-ds * (l * inverse)).max(-dl * (s * inverse));
            }
            y1 = y0;
            dy1 = dy0;
        }
        reach
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

    /// Constraint row `a[0] x_link + a[1] x_{link+1} - slack e_link <= bound` of a test program.
    #[derive(Clone, Copy)]
    struct Bound {
        link: usize,
        a: [f64; 2],
        slack: f64,
        bound: f64,
    }

    /// A test program (1) of the module, with its rows in any order within their links.
    #[derive(Clone)]
    struct Case {
        program: ChainProgram,
        rows: Vec<Bound>,
    }

    impl Case {
        fn solve(&self) -> Result<Vec<f64>, Failure> {
            solve(self.program.clone(), |link, rows| {
                for r in self.rows.iter().filter(|r| r.link == link) {
                    rows.add(r.a, r.slack, r.bound);
                }
            })
        }
    }

    /// Makes a random program of n variables. Its bounds hold around a known point, so that hard rows have a solution.
    fn random(n: usize, elastic: bool, rng: &mut ChaCha8Rng) -> Case {
        let size: Vec<f64> = (0..n).map(|_| 10.0_f64.powf(rng.random_range(-1.5..1.5))).collect();
        let inside: Vec<f64> = (0..n).map(|i| rng.random_range(-1.0..1.0) / size[i]).collect();
        let free: Vec<bool> = (0..n).map(|_| rng.random_range(0.0..1.0) < 0.9).collect();
        let linear = size.iter().map(|s| rng.random_range(-9.0..9.0) * s).collect();
        let mut rows = Vec::new();
        for link in 0..n - 1 {
            for _ in 0..rng.random_range(0..5) {
                let a = [size[link], size[link + 1]].map(|s| rng.random_range(-1.0..1.0) * s);
                let at = (0..2).map(|k| a[k] * inside[link + k] * f64::from(free[link + k]));
                let room =
                    if elastic { rng.random_range(-0.5..0.3) } else { rng.random_range(0.0..0.3) };
                rows.push(Bound { link, a, slack: 1.0, bound: at.sum::<f64>() + room });
            }
        }
        let mut price = Vec::new();
        if elastic {
            price = (1..n).map(|_| rng.random_range(3.0..30.0)).collect();
        }
        let diagonal = size.iter().map(|s| 4.0 * s * s).collect();
        let beside = size.windows(2).map(|s| s[0] * s[1]).collect();
        Case { program: ChainProgram { diagonal, beside, linear, free, price }, rows }
    }

    /// Returns the solution of the same program by a general conic solver; `None` if that fails.
    fn clarabel(Case { program, rows: bounds }: &Case) -> Option<Vec<f64>> {
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
        for row in bounds {
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
            let problem = random(2 + case % 40, case % 2 == 1, &mut rng);
            let Some(expected) = clarabel(&problem) else { continue };
            let found = problem.solve().unwrap();
            compared += 1;
            for i in 0..found.len() {
                // Its gap of 1e-10, or 1e-12 of an objective of up to 1e3, bounds half the square
                // of the error in units of 1 / sqrt(P_ii).
                let error = (found[i] - expected[i]).abs() * problem.program.diagonal[i].sqrt();
                assert!(error < 5e-5, "case {case}, variable {i}: {error}");
            }
        }
        assert!(compared > 190, "{compared}");
    }

    #[test]
    fn without_active_rows_it_is_the_tridiagonal_solution() {
        // [4 1; 1 4] x = [9 9]: 1.8 each; the ends are not free.
        let program = ChainProgram {
            diagonal: vec![4.0; 4],
            beside: vec![1.0; 3],
            linear: vec![7.0, 9.0, 9.0, 7.0],
            free: vec![false, true, true, false],
            price: Vec::new(),
        };
        let rows = vec![Bound { link: 1, a: [1.0, 1.0], slack: 0.0, bound: 5.0 }];
        let wide = Case { program, rows };
        let x = wide.solve().unwrap();
        // Below: the stop is at 1e-14 in scaled units, and r_d, which has the same error in x, is smaller than its
        // bound here.
        assert!(x.iter().zip([0.0, 1.8, 1.8, 0.0]).all(|(x, e)| (x - e).abs() < 1e-11), "{x:?}");
        // With x1 + x2 <= 3 both lose the same.
        let mut tight = wide;
        tight.rows[0].bound = 3.0;
        let x = tight.solve().unwrap();
        // As above.
        assert!((x[1] - 1.5).abs() < 1e-11 && (x[2] - 1.5).abs() < 1e-11, "{x:?}");
        // The multiplier of the row x1 + x2 - e <= 3 at the hard bound is 9 - 5 * 1.5 = 1.5. At a
        // higher price the row is hard. At a lower price it is exceeded, and 5 x = 9 - price.
        for (price, expected) in [(2.0, 1.5), (1.0, 1.6)] {
            tight.rows[0].slack = 1.0;
            tight.program.price = vec![price; 3];
            let x = tight.solve().unwrap();
            // As above; a price of the order 1 beside x.
            assert!((x[1] - expected).abs() < 1e-10, "{price}: {x:?}");
        }
    }

    #[test]
    fn contradictions_are_found() {
        let program = ChainProgram {
            diagonal: vec![1.0; 3],
            beside: vec![0.1; 2],
            linear: vec![1.0; 3],
            free: vec![true; 3],
            price: Vec::new(),
        };
        let rows = vec![
            Bound { link: 0, a: [1.0, 0.5], slack: 1.0, bound: -1.0 },
            Bound { link: 0, a: [-1.0, -0.5], slack: 1.0, bound: 0.99 },
        ];
        let mut case = Case { program, rows };
        assert_eq!(case.solve(), Err(Failure::Infeasible));
        case.rows[1].bound = 1.01;
        assert!(case.solve().is_ok());
        case.rows[1] = Bound { link: 1, a: [0.0; 2], slack: 1.0, bound: -1e-3 };
        assert_eq!(case.solve(), Err(Failure::Infeasible));
        case.program.price = vec![1.0; 2];
        assert!(case.solve().is_ok());
    }

    #[test]
    fn a_long_chain_is_the_same_on_one_thread_and_two() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for elastic in [false, true] {
            let long = random(2 * MIN_LINKS_PER_THREAD, elastic, &mut rng);
            let [one, two] = [1, 2].map(|threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| long.solve().unwrap())
            });
            assert!(one.iter().zip(&two).all(|(a, b)| a.to_bits() == b.to_bits()));
        }
    }

    #[test]
    fn the_solution_does_not_depend_on_units_or_direction() {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        for case in 0..20 {
            let problem = random(30, case % 2 == 1, &mut rng);
            let Case { program, .. } = &problem;
            let x = problem.solve().unwrap();
            let mut other = problem.clone();
            let scaled = &mut other.program;
            // x in other units: P / 64, c / 8, a / 8; the objective a thousand times as large.
            scaled.diagonal.iter_mut().chain(&mut scaled.beside).for_each(|v| *v *= 1000.0 / 64.0);
            scaled.linear.iter_mut().for_each(|v| *v *= 1000.0 / 8.0);
            scaled.price.iter_mut().for_each(|v| *v *= 1000.0);
            other.rows.iter_mut().for_each(|r| r.a = r.a.map(|a| a / 8.0));
            let y = other.solve().unwrap();
            for i in 0..30 {
                let (d, x) = (program.diagonal[i].sqrt(), x[i]);
                // The stop is at 1e-12 of the complementarity; its root in x where a row is only
                // just active.
                assert!((y[i] / 8.0 - x).abs() * d < 1e-5, "{} {x}", y[i] / 8.0);
            }
            other = problem.clone();
            let turned = &mut other.program;
            let ChainProgram { diagonal, beside, linear, price, .. } = turned;
            for v in [diagonal, beside, linear, price] {
                v.reverse();
            }
            turned.free.reverse();
            other.rows.reverse();
            other.rows.iter_mut().for_each(|r| {
                r.link = 28 - r.link;
                r.a.reverse();
            });
            let y = other.solve().unwrap();
            for i in 0..30 {
                let error = (y[29 - i] - x[i]).abs() * program.diagonal[i].sqrt();
                // As above: the root of the complementarity.
                assert!(error < 1e-5, "{case} {i} {error}");
            }
        }
    }
}
