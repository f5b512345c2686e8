//! The steps to the minimum of (1) of [`crate::bounded_least_squares`]. The exact H is too large to be solved
//! with, its surrogate H~ is not exact: so each step is found with H~ and corrected with the exact gradient.

use ndarray::{Array2, Zip};
use planish_numerics::{
    linear::skyline::dot,
    qp::bounded::{self, GradientSettings},
};
use planish_types::{End, progress};

use super::{
    certificate::gap,
    prepared::BoundedProblem,
    settings::{Product, Settings},
};
use crate::{
    DwellError,
    objective::{Basis, Penalty},
    surrogate::Surrogate,
};

/// Corrections that a problem usually takes, for an estimate of the time, and the part after so many of them.
const USUAL_CORRECTIONS: f64 = 6.0;
const BEFORE_LAST: f64 = 0.9;

/// Most steps of H~; measured problems take 3 to 6.
const MAX_CORRECTIONS: usize = 100;

/// An easier problem than (1), see [`BoundedProblem::approach`].
struct Rough {
    /// Weights of the penalty over those of (1).
    weight: f64,
    /// Pitch of the splines over that for (1).
    splines: f64,
    /// Side of the cells over that for (1).
    cells: usize,
}

/// One after the other. By the time that problems took: a third one, or smaller steps of the weights, cost what they
/// save.
const ROUGH_PROBLEMS: [Rough; 2] = [
    Rough { weight: 1e3, splines: 2.0, cells: 2 },
    Rough { weight: 30.0, splines: 1.35, cells: 1 },
];

/// alpha from which on a problem is no way to another: the penalty decides all of it.
const MAX_ROUGH_TIKHONOV: f64 = 1e-2;

/// Relative gap that an easier problem may leave. The bound is by the penalty alone; what it finds is nearer.
const ROUGH_GAP: f64 = 10.0;

/// Most steps of H~ for an easier problem; measured ones take 1.
const MAX_ROUGH_CORRECTIONS: usize = 3;

/// A step that leaves more than this fraction of the natural residual is a slow one ...
const SLOW_RESIDUAL_FRACTION: f64 = 0.5;

/// ... and after so many slow ones in a row the factorised surrogate gets smaller cells.
const SLOW_STEPS_BEFORE_SHARPENING: usize = 2;

/// The gradient method ends when 50 steps change the mean square of the residual by less than this
/// fraction, its RMS by half of it; the corrections of its result end when one changes it by less.
const STAGNATION: f64 = 2e-4;

/// Fraction of the natural residual that a step of the two-level method may leave.
const RESIDUAL_FRACTION_TWO_LEVEL: f64 = 0.1;

/// The same for gradient steps, which are not restarted as cheaply.
const RESIDUAL_FRACTION_GRADIENT: f64 = 0.01;

/// A step that promises to lower (1) by less than this fraction of it is rounding.
const STEP_ROUNDING: f64 = 1e-15;

/// A step from which on the best one is taken to be the whole: only that puts the components that the
/// surrogate has at their bounds on them.
const WHOLE_STEP_FROM: f64 = 0.6;

/// Two directions are as good as parallel when the determinant of their products is below this fraction of
/// that of orthogonal ones.
const MIN_DETERMINANT_FRACTION: f64 = 1e-9;

/// A dwell time nearer to its bound than this fraction of itself differs from it by rounding.
const BOUND_ROUNDING: f64 = 1e-13;

/// Where the iteration is.
pub struct Iterate {
    pub t: Vec<f64>,
    /// B t.
    pub removal_nm: Array2<f64>,
    /// Factorisations, or products with H~.
    pub iterations: usize,
    /// Steps of H~.
    pub corrections: usize,
    pub natural_residual: f64,
    pub relative_gap: Option<f64>,
    pub end: End,
}

impl BoundedProblem<'_> {
    /// Minimises (1) by steps of its surrogate:
    ///
    /// ```text
    /// repeat  q = gradient of (1) at t                           exact
    ///         d = argmin q'd + d'H~d / 2,  lo <= t + d <= hi     by H~
    ///         p = argmin of (1) over t + a d + b p, clipped      exact
    ///         t += p
    /// ```
    ///
    /// d is a descent direction whatever H~ is, and vanishes only at the minimum of (1). With the
    /// step before, p, this is the conjugate gradient method preconditioned by H~ as soon as the
    /// components at their bounds are settled. With a Huber loss every q has the weights of its own
    /// residual ([`huber_weights`]).
    pub(super) fn minimise(&mut self, smoothness: f64) -> Result<Iterate, DwellError> {
        self.minimise_by(&Settings { smoothness, ..*self.settings }, MAX_CORRECTIONS)
    }

    /// Takes the two-level method near the minimum by easier problems, and returns the products with their surrogates:
    /// with larger weights of the penalty the dwell times are smoother, so that wider splines and larger cells can say
    /// them, and which of them are at their bounds is settled in fewer and cheaper steps. Afterwards some percent of
    /// them change.
    ///
    /// Does nothing for other methods, or where a guess is given.
    pub(super) fn approach(&mut self, smoothness: f64) -> Result<usize, DwellError> {
        let (cell, Some(pitch_mm)) = (self.cell, self.splines_mm) else { return Ok(0) };
        let mut iterations = 0;
        for (k, rough) in ROUGH_PROBLEMS.iter().enumerate() {
            let tikhonov = rough.weight * self.settings.tikhonov;
            if self.is_guessed || tikhonov > MAX_ROUGH_TIKHONOV {
                continue;
            }
            let cells = (rough.cells * cell, Some(rough.splines * pitch_mm));
            let surrogate = self.convolved(cells)?;
            let fine = std::mem::replace(&mut self.surrogate, surrogate);
            let settings = Settings {
                tikhonov,
                smoothness: rough.weight * smoothness,
                relative_gap: ROUGH_GAP,
                ..*self.settings
            };
            let found = progress::part(k, 2 * ROUGH_PROBLEMS.len(), || {
                self.minimise_by(&settings, MAX_ROUGH_CORRECTIONS)
            });
            self.surrogate = fine;
            let found = found?;
            iterations += found.iterations;
            self.start = found.t;
        }
        Ok(iterations)
    }

    /// [`Self::minimise`] with the weights and limits of these settings, in at most so many corrections.
    fn minimise_by(
        &mut self,
        settings: &Settings,
        max_corrections: usize,
    ) -> Result<Iterate, DwellError> {
        let weights = settings.penalty_weights();
        let penalty = Penalty::new(self.path, self.lo, &self.scale, &weights);
        let own = penalty.diagonal();
        let diagonal: Vec<f64> = (0..own.len())
            .map(|j| if self.reached[j] { self.diagonal[j] + own[j] } else { 0.0 })
            .collect();
        let grid = *self.desired.grid();
        let mut basis = Basis::new(&grid, &self.weight, settings.free);
        let mut weight = self.weight.clone();
        let mut t = self.start.clone();
        let mut removal_nm = if t.iter().all(|t| *t == 0.0) {
            Array2::zeros(self.z.dim())
        } else {
            self.b.apply(&t)
        };
        let (mut iterations, mut corrections, mut slow) = (0, 0, 0);
        let mut residual_before = f64::INFINITY;
        let mut first_gap = None;
        let (mut before, mut settled): (Option<(Vec<f64>, Array2<f64>)>, _) = (None, None);
        loop {
            // r = z - B t without its free part,  q = -B' W r + penalty
            let mut r = &self.z - &removal_nm;
            basis.project(&weight, &mut r);
            if let Some(k) = settings.huber_nm.filter(|_| corrections > 0) {
                weight = huber_weights(&self.weight, &r, k);
                basis = Basis::new(&grid, &weight, settings.free);
                basis.project(&weight, &mut r);
            }
            let mut q = self.b.adjoint(&(&r * &weight));
            q.iter_mut().for_each(|q| *q = -*q);
            penalty.add_gradient(&t, &mut q);
            let mut objective = 0.5
                * Zip::from(&r).and(&weight).fold(0.0, |sum, r, w| sum + w * r * r)
                + penalty.value(&t);
            if let Some(product) = self.quadratic {
                let more = product(&t);
                objective += 0.5 * dot(&t, &more);
                q.iter_mut().zip(&more).for_each(|(q, more)| *q += more);
            }

            let natural_residual = bounded::natural_residual(&t, &q, &diagonal, self.lo, &self.hi);
            let relative_gap = gap(&t, &q, self.lo, &self.hi, penalty.alpha(), &self.reached)
                .map(|gap| gap / objective.max(f64::MIN_POSITIVE));
            let usual = (corrections as f64 / USUAL_CORRECTIONS).min(BEFORE_LAST);
            let proven = relative_gap.map_or(0.0, |gap| {
                let first = *first_gap.get_or_insert(gap);
                progress::of_convergence(first, gap, settings.relative_gap)
            });
            progress::done(usual.max(proven));
            // Where there is a gap it decides, and how far a dwell time would still move where no step falls any more.
            let is_still = natural_residual <= settings.tolerance_s;
            let proven = relative_gap.map_or(is_still, |gap| gap <= settings.relative_gap);
            let mut end = if proven || (is_still && settled.is_some()) {
                Some(End::Optimal)
            } else {
                settled
            };
            if end.is_none() && corrections >= max_corrections {
                end = Some(End::IterationLimit);
            }
            slow = if natural_residual > SLOW_RESIDUAL_FRACTION * residual_before {
                slow + 1
            } else {
                0
            };
            residual_before = natural_residual;
            let factorised = matches!(self.surrogate, Surrogate::Ordered(_));
            let by_gradient = !factorised && self.splines_mm.is_none();
            if slow >= SLOW_STEPS_BEFORE_SHARPENING && factorised && end.is_none() {
                slow = 0;
                self.sharpen(&penalty);
            }
            // d by H~; where that is singular, by smaller cells
            let mut to = t.clone();
            while end.is_none() {
                match &mut self.surrogate {
                    Surrogate::Ordered(h) => {
                        let h = h.penalised(&penalty);
                        if let Some((found, count)) = h.minimum(&t, &q, self.lo, &self.hi) {
                            (to, iterations) = (found, iterations + count);
                            break;
                        }
                        if !self.sharpen(&penalty) {
                            return Err(DwellError::Singular { tikhonov: settings.tikhonov });
                        }
                    }
                    Surrogate::Convolved(h) => {
                        let steps = GradientSettings {
                            tolerance: if by_gradient {
                                (RESIDUAL_FRACTION_GRADIENT * natural_residual)
                                    .max(0.5 * settings.tolerance_s)
                            } else {
                                RESIDUAL_FRACTION_TWO_LEVEL * natural_residual
                            },
                            max_iterations: settings.max_iterations.saturating_sub(iterations),
                            stagnation: STAGNATION,
                            offset: objective,
                        };
                        let bounds = (self.lo, self.hi.as_slice());
                        let (found, count) =
                            h.minimum(&penalty, &t, &q, &self.reached, bounds, &steps);
                        (to, iterations) = (found, iterations + count);
                        if iterations >= settings.max_iterations {
                            end = Some(End::IterationLimit);
                        }
                        break;
                    }
                }
            }
            let d: Vec<f64> = to.iter().zip(&t).map(|(to, t)| to - t).collect();
            let slope: f64 = q.iter().zip(&d).map(|(q, d)| q * d).sum();
            if end.is_none() && -slope <= STEP_ROUNDING * objective {
                end = Some(if is_still { End::Optimal } else { End::Stagnated });
            }
            if let Some(end) = end {
                return Ok(Iterate {
                    t,
                    removal_nm,
                    iterations,
                    corrections,
                    natural_residual,
                    relative_gap,
                    end,
                });
            }
            let quadratic = Along {
                penalty: &penalty,
                basis: &basis,
                weight: &weight,
                quadratic: self.quadratic,
            };
            let d_nm = self.b.apply(&d);
            let curvature = quadratic.value(&d, &d_nm);
            // The whole step lands on the bounds: nearly whole is made whole.
            let s = -slope / curvature;
            let s = if s > WHOLE_STEP_FROM { 1.0 } else { s };
            let mut fall = -s * slope - 0.5 * s * s * curvature;
            let mut step: Vec<f64> = d.iter().map(|d| s * d).collect();
            let mut step_nm = &d_nm * s;
            if let Some((p, p_nm)) = &before {
                let [a, b] = quadratic.plane_minimum(&q, (&d, &d_nm, curvature), (p, p_nm));
                let wanted: Vec<f64> = d.iter().zip(p).map(|(d, p)| a * d + b * p).collect();
                let e: Vec<f64> = (0..t.len())
                    .map(|j| (t[j] + wanted[j]).clamp(self.lo[j], self.hi[j]) - t[j])
                    .collect();
                // B e = a B d + b B p + B (what was clipped: few columns)
                let clipped: Vec<f64> = e.iter().zip(&wanted).map(|(e, w)| e - w).collect();
                let mut e_nm = &d_nm * a;
                e_nm.scaled_add(b, p_nm);
                e_nm += &self.b.apply(&clipped);
                let other = -dot(&q, &e) - 0.5 * quadratic.value(&e, &e_nm);
                if other > fall {
                    (fall, step, step_nm) = (other, e, e_nm);
                }
            }
            // The exact step of a descent direction falls but for rounding.
            let enough = if by_gradient { STAGNATION * objective } else { 0.0 };
            if fall <= enough {
                settled = Some(End::Stagnated);
            }
            if fall <= 0.0 {
                continue;
            }
            for j in 0..t.len() {
                t[j] = snapped(t[j] + step[j], self.lo[j], self.hi[j]);
            }
            removal_nm += &step_nm;
            before = Some((step, step_nm));
            corrections += 1;
        }
    }
}

/// Weights with which the gradient of the weighted squares is that of the Huber loss: `w min(k / |r|, 1)`,
/// for the residual r without its free part.
fn huber_weights(weight: &Array2<f64>, r: &Array2<f64>, k: f64) -> Array2<f64> {
    Zip::from(weight).and(r).map_collect(|w, r| w * (k / r.abs()).min(1.0))
}

/// H of (1) along directions e with their removal B e.
struct Along<'a> {
    penalty: &'a Penalty,
    basis: &'a Basis,
    weight: &'a Array2<f64>,
    quadratic: Option<Product<'a>>,
}

impl Along<'_> {
    /// `e' H e`.
    fn value(&self, e: &[f64], e_nm: &Array2<f64>) -> f64 {
        self.between((e, e_nm), (e, e_nm))
    }

    /// `d' H p`.
    fn between(&self, d: (&[f64], &Array2<f64>), p: (&[f64], &Array2<f64>)) -> f64 {
        let mut curved = vec![0.0; p.0.len()];
        self.penalty.add_product(p.0, &mut curved);
        if let Some(product) = self.quadratic {
            curved.iter_mut().zip(product(p.0)).for_each(|(c, more)| *c += more);
        }
        let free = |nm: &Array2<f64>| self.basis.coefficients(self.weight, nm);
        Zip::from(d.1).and(p.1).and(self.weight).fold(0.0, |s, d, p, w| s + w * d * p)
            - dot(&free(d.1), &free(p.1))
            + dot(&curved, d.0)
    }

    /// Where `q'e + e'He / 2` is least for `e = a d + b p`:
    ///
    /// ```text
    /// [d'Hd d'Hp; d'Hp p'Hp] [a; b] = -[q'd; q'p]
    /// ```
    fn plane_minimum(
        &self,
        q: &[f64],
        (d, d_nm, dd): (&[f64], &Array2<f64>, f64),
        (p, p_nm): (&[f64], &Array2<f64>),
    ) -> [f64; 2] {
        let (dp, pp) = (self.between((d, d_nm), (p, p_nm)), self.value(p, p_nm));
        let (qd, qp) = (dot(q, d), dot(q, p));
        let determinant = dd * pp - dp * dp;
        if determinant <= MIN_DETERMINANT_FRACTION * dd * pp {
            return [-qd / dd, 0.0];
        }
        [(dp * qp - pp * qd) / determinant, (dp * qd - dd * qp) / determinant]
    }
}

/// `t` within its bounds, and on them where it differs by rounding.
fn snapped(t: f64, lo: f64, hi: f64) -> f64 {
    let rounding = BOUND_ROUNDING * t.abs().max(lo.abs());
    match t {
        t if t <= lo + rounding => lo,
        t if t >= hi - rounding => hi,
        t => t,
    }
}
