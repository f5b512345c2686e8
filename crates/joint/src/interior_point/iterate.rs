//! Iterate of the method: densities, slacks and dual variables, with its steps by (2) of [`super`] and kept tangents.

use planish_numerics::linear::skyline::dot;

use super::program::{Inverse, Program, add_adjoint, along, longest, moved};
use crate::{
    certificate,
    limits::Constraint,
    merit::{Merit, Objective},
};

/// Least ratio of the target (mu) of a step to the mean product of a slack and its dual variable before the step.
/// Larger: the complementarity falls more slowly. Smaller: products may become so unequal that the next steps are
/// short. Chosen.
const LEAST_CENTRING: f64 = 1e-3;

/// Largest number of corrections of a step that the bends of the rows (their second-order terms) end early. Larger:
/// more solutions with the factor. Smaller: shorter steps at rows that bend much. Chosen: of a hundred steps none
/// needed a third correction.
const MAX_BEND_CORRECTIONS: usize = 4;

/// Ratio of the length of a step to that by the tangents above which the step is long enough and no bend is corrected.
/// Larger: more corrections. Smaller: more, shorter steps. Chosen: a ratio between this one and 1 is usual without a
/// correction.
const LONG_ENOUGH: f64 = 0.5;

/// Largest number of Gondzio's corrections of a step; they bring outlying products of slacks and dual variables back
/// towards the target. Larger: more solutions with the factor per step. Smaller: shorter steps, because outlying
/// products are left. Chosen.
const MAX_CENTRALITY_CORRECTIONS: usize = 3;

/// Length by which Gondzio's correction extends the primal and the dual step (1 is a full step) before it measures
/// the products. Larger: corrections aim at longer steps and fail more often. Smaller: corrections gain less. Chosen.
const FURTHER: f64 = 0.3;

/// Least gain of a correction in the length of the primal or the dual step, over [`FURTHER`], for it to be kept and
/// another one to be tried. Neither step may become shorter. Larger: fewer corrections. Smaller: corrections that gain
/// little. Chosen.
const LEAST_GAIN: f64 = 0.1;

/// Largest ratio of a product to the target mu, or of mu to a product, that is no outlier. Larger: fewer products are
/// corrected, and steps end early at them. Smaller: corrections of products that hold no step back. Chosen: a decade.
const OUTLIER: f64 = 10.0;

/// Ratio of the complementarity to the objective at a start without dual variables. Larger: more steps until it has
/// fallen. Smaller: dual variables that are too small for the first steps to be long. Chosen.
const FIRST_RELATIVE_GAP: f64 = 0.3;

/// Least product of a slack and its dual variable at a start with dual variables, over the mean product. Larger: more
/// of the given dual variables are changed. Smaller: products far below the mean make the first steps short. Chosen.
const LEAST_PRODUCT: f64 = 0.1;

/// Gap at which the convex program of the tangents counts as solved, over the gap that is wanted. Larger: the method
/// moves on earlier, towards a less exact solution. Smaller: more steps for a convex program that does not prove
/// enough. Chosen.
pub(super) const PROGRAM_SOLVED: f64 = 0.1;

/// Least fraction of the way to the solution under the tangents that the iterate moves; if the rows allow less it
/// stays. Larger: it moves less often. Smaller: it ends where many rows are nearly active, so the next steps are
/// short. Chosen.
const LEAST_PART: f64 = 0.5;

/// Least product of a slack and its dual variable, over the mean product, when the method begins to keep tangents.
/// Slacks below [`ACTIVE_SLACK`] are raised first, and the steps take the excess away again; then dual variables are
/// raised. Larger: more steps until the complementarity has fallen again. Smaller: short first steps, because the dual
/// variables fit rows that are bent. Chosen.
const RAISED_PRODUCT: f64 = 100.0;

/// Slack below which a row counts as active when the method begins to keep tangents, dimensionless (1 at rest). Larger:
/// slacks of more rows are raised. Smaller: the dual variables of such rows are raised in their place. Chosen. See
/// [`RAISED_PRODUCT`].
const ACTIVE_SLACK: f64 = 0.1;

/// Densities and dual variables from which the interior point method begins.
#[derive(Clone, Debug)]
pub struct Start {
    /// Densities of the nodes (D, n), s/mm, strictly inside the limits.
    pub density: Vec<f64>,
    /// Dual variables of the rows (z) and of the bounds (y) of a problem with nearly the same rows; `None` if there was
    /// none.
    pub duals: Option<[Vec<f64>; 2]>,
}

/// Iterate that keeps the limits themselves, not only their tangents, with its objective and proven gap.
pub(super) struct Executable {
    pub(super) density: Vec<f64>,
    pub(super) value: f64,
    pub(super) relative_gap: f64,
}

/// Step of the method by (2) of [`super`]: changes of densities, slacks and dual variables.
pub(super) struct Step {
    density: Vec<f64>,
    /// Change of the slacks by the tangents of the rows: J d, less the excess of the slacks.
    c: Vec<f64>,
    z: Vec<f64>,
    y: Vec<f64>,
}

/// Products of slacks and their dual variables: c z of the rows (rows), and (D - lo) y of the bounds (n).
struct Products {
    rows: Vec<f64>,
    bounds: Vec<f64>,
}

impl Products {
    fn sum(&self) -> f64 {
        self.rows.iter().sum::<f64>() + self.bounds.iter().sum::<f64>()
    }

    /// Combines each product with the same product of `other`.
    fn combined(&self, other: &Self, combine: fn(f64, f64) -> f64) -> Self {
        Self {
            rows: zip_with(&self.rows, &other.rows, combine),
            bounds: zip_with(&self.bounds, &other.bounds, combine),
        }
    }

    /// Returns the change of the products by (4) of [`super`], which brings outliers back to within a decade of the
    /// target `mu`. It lowers no product by more than ten times `mu`.
    fn correction(&self, mu: f64) -> Self {
        let [rows, bounds] = [&self.rows, &self.bounds].map(|products| {
            let clamped = products.iter().map(|v| v.clamp(mu / OUTLIER, mu * OUTLIER));
            clamped.zip(products).map(|(c, v)| (c - v).max(-mu * OUTLIER)).collect()
        });
        Self { rows, bounds }
    }
}

/// Returns the combination of two vectors of equal length, component by component.
fn zip_with(a: &[f64], b: &[f64], combine: fn(f64, f64) -> f64) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| combine(*a, *b)).collect()
}

/// Iterate of the interior point method: densities, slacks and dual variables.
pub(super) struct Iterate<'a> {
    program: &'a Program<'a>,
    pub(super) density: Vec<f64>,
    pub(super) f: Objective,
    /// Rows (constraints) at the present densities, or the tangents that are kept, with their slacks here.
    here: Vec<Constraint>,
    /// Slacks of the rows (c) and of the bounds (room = D - lo), and their dual variables (z, y).
    pub(super) c: Vec<f64>,
    pub(super) room: Vec<f64>,
    pub(super) z: Vec<f64>,
    pub(super) y: Vec<f64>,
    /// Excess of the slacks over those that the kept tangents allow (rows).
    excess: Vec<f64>,
    /// Iterate whose tangents are kept; `None` while the rows themselves are used.
    pub(super) anchor: Option<Anchor>,
}

/// Iterate at which the method began to keep tangents.
pub(super) struct Anchor {
    pub(super) density: Vec<f64>,
    pub(super) value: f64,
    c: Vec<f64>,
    /// Smallest proven gap of this iterate, nm^2.
    pub(super) gap: f64,
}

impl<'a> Iterate<'a> {
    pub(super) fn new(program: &'a Program<'a>, start: Start, f: Objective) -> Self {
        let density = start.density;
        let here = program.rows.constraints(&density);
        let c: Vec<f64> = here.iter().map(|row| row.slack).collect();
        let room: Vec<f64> = density.iter().zip(program.lo).map(|(d, lo)| d - lo).collect();
        let members = (c.len() + room.len()) as f64;
        let [z, y] = match start.duals {
            Some([z, y]) => {
                // Products far below their mean would hold the steps back.
                let least = LEAST_PRODUCT * (dot(&c, &z) + dot(&room, &y)) / members;
                [(z, &c), (y, &room)].map(|(duals, slacks)| {
                    duals.into_iter().zip(slacks).map(|(v, slack)| v.max(least / slack)).collect()
                })
            }
            None => {
                let mu = FIRST_RELATIVE_GAP * f.value / members;
                [&c, &room].map(|slack| slack.iter().map(|c| mu / c).collect())
            }
        };
        let excess = vec![0.0; c.len()];
        Self { program, density, f, here, c, room, z, y, excess, anchor: None }
    }

    pub(super) fn complementarity(&self) -> f64 {
        dot(&self.c, &self.z) + dot(&self.room, &self.y)
    }

    /// Returns the upper bound on the excess of the objective over its least value under the tangents, nm^2. With the
    /// inverse of the curvature it tries a closer bound, if that can decide whether `relative_gap` is reached.
    pub(super) fn gap(
        &self,
        inverse: Option<&Inverse<'_>>,
        relative_gap: f64,
        merit: &Merit<'_>,
    ) -> f64 {
        let alpha = merit.alpha;
        // f' - J' z
        let mut r = self.f.gradient.clone();
        add_adjoint(&self.here, |i| -self.z[i], &mut r);
        let of_tangents = dot(&self.c, &self.z) - dot(&self.excess, &self.z);
        let simple = of_tangents + certificate::by_alpha(&r, &self.room, alpha);
        let Some(inverse) = inverse else { return simple };
        r.iter_mut().zip(&self.y).for_each(|(r, y)| *r -= y);
        let products = of_tangents + dot(&self.room, &self.y);
        // Gap that proves that the iterate whose tangents are kept is good enough, or that their convex program is
        // solved.
        let wanted = match &self.anchor {
            None => relative_gap * self.f.value,
            Some(anchor) => (relative_gap * anchor.value - (anchor.value - self.f.value))
                .max(PROGRAM_SOLVED * relative_gap * self.f.value),
        };
        if products > wanted {
            return simple;
        }
        let of_use = wanted - products;
        let square = certificate::by_curvature(
            &r,
            alpha,
            of_use,
            |d| merit.lower_curvature(d),
            |e| inverse.solve(e),
        );
        simple.min(products + square)
    }

    /// Returns the iterate that keeps the limits, with its proven gap. While tangents are kept this is the anchor,
    /// whose gap follows by (5) of [`super`] from the proven `gap` of the present iterate, nm^2.
    pub(super) fn executable(&mut self, gap: f64) -> Executable {
        let (density, value, gap) = match &mut self.anchor {
            None => (&self.density, self.f.value, gap),
            Some(anchor) => {
                anchor.gap = anchor.gap.min(anchor.value - self.f.value + gap);
                (&anchor.density, anchor.value, anchor.gap)
            }
        };
        Executable { density: density.clone(), value, relative_gap: gap / value }
    }

    /// Replaces the rows by their tangents for the steps that follow; `gap` is the proven gap so far, nm^2.
    pub(super) fn keep_tangents(&mut self, gap: f64) {
        self.anchor = Some(Anchor {
            density: self.density.clone(),
            value: self.f.value,
            c: self.c.clone(),
            gap,
        });
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

    /// Moves from the anchor, at which the tangents were kept, towards this iterate, as far as the rows allow. It stays
    /// at the anchor if that is less than [`LEAST_PART`] of the way. The following steps use the rows again.
    pub(super) fn move_towards_solution(&mut self) {
        let Some(anchor) = self.anchor.take() else { return };
        self.excess.fill(0.0);
        let by: Vec<f64> = self.density.iter().zip(&anchor.density).map(|(d, k)| d - k).collect();
        let (t, to) = self.program.farthest(&anchor.density, &by, &anchor.c, 1.0);
        self.move_to(if t >= LEAST_PART { to } else { anchor.density });
    }

    /// Moves to other densities and evaluates the rows there.
    fn move_to(&mut self, density: Vec<f64>) {
        self.here = self.program.rows.constraints(&density);
        self.c = self.here.iter().map(|row| row.slack).collect();
        self.room = density.iter().zip(self.program.lo).map(|(d, lo)| d - lo).collect();
        self.density = density;
    }

    /// Returns the step by (2) of [`super`] with Mehrotra's target mu and corrections; `None` if the matrix is singular
    /// to rounding.
    pub(super) fn step(&self, row_of: &[usize]) -> Option<Step> {
        let inverse = self.inverse(row_of)?;
        let (mu, target) = self.centred(&inverse);
        let (target, step) = self.without_outliers(&inverse, mu, target);
        Some(match self.anchor {
            None => self.around_bends(&inverse, &target, step),
            Some(_) => step,
        })
    }

    /// Returns Mehrotra's target mu, from a predictor step that aims at products of 0, and the products at which the
    /// step aims: (3) of [`super`].
    fn centred(&self, inverse: &Inverse<'_>) -> (f64, Products) {
        let rows = self.c.len();
        let bounds = self.room.len();
        let complementarity = self.complementarity();
        let zero = Products { rows: vec![0.0; rows], bounds: vec![0.0; bounds] };
        let predictor = self.direction(inverse, &zero, &self.excess);
        let after = self.products(&predictor, self.primal(&predictor).0, self.dual(&predictor));
        let centring = (after.sum() / complementarity).powi(3).clamp(LEAST_CENTRING, 1.0);
        let mu = centring * complementarity / (rows + bounds) as f64;
        let centred = Products { rows: vec![mu; rows], bounds: vec![mu; bounds] };
        (mu, centred.combined(&self.second_order(&predictor), |a, b| a - b))
    }

    /// Returns the step towards the products `target` with Gondzio's corrections, (4) of [`super`], and the products at
    /// which it then aims.
    fn without_outliers(
        &self,
        inverse: &Inverse<'_>,
        mu: f64,
        mut target: Products,
    ) -> (Products, Step) {
        let mut step = self.direction(inverse, &target, &self.excess);
        for _ in 0..MAX_CENTRALITY_CORRECTIONS {
            let a = self.by_tangents(&step);
            let b = self.dual(&step);
            let [further_a, further_b] = [a, b].map(|v| (v + FURTHER).min(1.0));
            let correction = self.products(&step, further_a, further_b).correction(mu);
            let corrected = target.combined(&correction, |a, b| a + b);
            let next = self.direction(inverse, &corrected, &self.excess);
            let gained = (self.by_tangents(&next) - a, self.dual(&next) - b);
            if gained.0.min(gained.1) < 0.0 || gained.0.max(gained.1) < LEAST_GAIN * FURTHER {
                break;
            }
            (target, step) = (corrected, next);
        }
        (target, step)
    }

    /// Returns a step that goes farther than `step` if the bends of the rows end that one early.
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

    /// Goes the longest allowed part of a step, for densities and slacks and separately for dual variables. Returns the
    /// complementarity at its end by the tangents of the rows.
    pub(super) fn advance(&mut self, step: &Step) -> f64 {
        let (length, to) = self.primal(step);
        let b = self.dual(step);
        let after = self.products(step, length, b).sum();
        self.z.iter_mut().zip(&step.z).for_each(|(z, d)| *z += b * d);
        self.y.iter_mut().zip(&step.y).for_each(|(y, d)| *y += b * d);
        if self.anchor.is_some() {
            self.c.iter_mut().zip(&step.c).for_each(|(c, d)| *c += length * d);
            self.excess.iter_mut().for_each(|e| *e *= 1.0 - length);
            self.room.iter_mut().zip(&step.density).for_each(|(room, d)| *room += length * d);
            self.density = to;
        } else {
            self.move_to(to);
        }
        after
    }

    /// Returns the factorised matrix of (2) of [`super`]; `row_of` has the row of the matrix of every node. `None` if
    /// it is singular to rounding.
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

    /// Returns the step by (2) of [`super`] that aims at the products `target` in the place of mu. `excess` (rows) is
    /// the amount by which the slacks are larger than they should be.
    fn direction(&self, inverse: &Inverse<'_>, target: &Products, excess: &[f64]) -> Step {
        let Self { f, here, c, room, z, y, .. } = self;
        let t = target.bounds.iter().zip(room).map(|(t, room)| t / room);
        let mut rhs: Vec<f64> = f.gradient.iter().zip(t).map(|(g, t)| t - g).collect();
        add_adjoint(here, |i| (target.rows[i] + z[i] * excess[i]) / c[i], &mut rhs);
        let d = inverse.solve(&rhs);
        let mut j_d = along(here, &d);
        j_d.iter_mut().zip(excess).for_each(|(c, e)| *c -= e);
        Step {
            z: (0..c.len()).map(|i| (target.rows[i] - z[i] * j_d[i]) / c[i] - z[i]).collect(),
            y: (0..d.len()).map(|j| (target.bounds[j] - y[j] * d[j]) / room[j] - y[j]).collect(),
            c: j_d,
            density: d,
        }
    }

    /// Returns the length of the longest step that the tangents of the rows and the bounds allow, at most 1.
    fn by_tangents(&self, step: &Step) -> f64 {
        longest(&self.room, &step.density).min(longest(&self.c, &step.c))
    }

    /// Returns the length of the longest step and the densities at its end. The rows themselves limit it, unless their
    /// tangents are kept.
    fn primal(&self, step: &Step) -> (f64, Vec<f64>) {
        // The tangents say nearly how far.
        let length = self.by_tangents(step);
        match self.anchor {
            None => self.program.farthest(&self.density, &step.density, &self.c, length),
            Some(_) => (length, moved(&self.density, &step.density, length)),
        }
    }

    fn dual(&self, step: &Step) -> f64 {
        longest(&self.z, &step.z).min(longest(&self.y, &step.y))
    }

    /// Returns the products after a primal step of length `a` and a dual step of length `b`, by the tangents.
    fn products(&self, step: &Step, a: f64, b: f64) -> Products {
        let after_step = |v: &[f64], dv: &[f64], z: &[f64], dz: &[f64]| {
            (0..v.len()).map(|i| (v[i] + a * dv[i]) * (z[i] + b * dz[i])).collect()
        };
        Products {
            rows: after_step(&self.c, &step.c, &self.z, &step.z),
            bounds: after_step(&self.room, &step.density, &self.y, &step.y),
        }
    }

    /// Returns the second-order terms of the products after a full step: change of slack times change of dual variable.
    fn second_order(&self, step: &Step) -> Products {
        Products {
            rows: zip_with(&step.c, &step.z, |dc, dz| dc * dz),
            bounds: zip_with(&step.density, &step.y, |d, dy| d * dy),
        }
    }
}
