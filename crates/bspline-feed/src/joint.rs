//! The control values of the feed of all passes at once, and a proof of how close they are to the best ones.
//!
//! ```text
//! min f(d)   subject to   c_j(d) >= 0                                                        (1)
//! ```
//!
//! f is (1) of [`crate::deconvolution`]. The c_j are the bounds `d_i - 1/F` and, at places along every pass, rows (2)
//! of [`crate::limited`]: the tangents of the acceleration limit at the densities D_k. With these (1) is a convex
//! quadratic program, which an interior point method solves (S. Mehrotra, SIAM J. Optim. 2 (1992) 575):
//!
//! ```text
//! (H + J' W/S J) step = -f' + J' (w + (sigma mu - s w - ds dw - w (c - s)) / s)              (2)
//! ```
//!
//! with m slacks s, dual variables w >= 0 and the rows' coefficients J. The predictor is (2) with 0 in place of
//! `sigma mu - ds dw`. The corrector has its ds and dw, and, with the longest step a <= 1 of the predictor,
//!
//! ```text
//! mu = s'w / m,   sigma = ((s + a ds)'(w + a dw) / s'w)^3,   sigma mu at least 0.3 of the tolerance over m
//! ```
//!
//! All lines change together, where sweeps over the
//! lines leave what no line can change alone. The tangents are drawn again after every step: D^3 is convex, so a slack
//! only grows by it. When the steps gain no more, the tangents are kept for the proof of the feed where they touch.
//!
//! *Proof.* For every w >= 0 and every d' with `c(d') >= 0`
//!
//! ```text
//! f(d') >= f(d) - w' c(d) - r' P0^-1 r / 2,     r = f'(d) - J' w                             (3)
//! ```
//!
//! where P0, the penalties of f, is at most H. The gap of D_k is `f(D_k)` less the right side, over `f(D_k)`: no feed
//! within the tangents at D_k lowers the objective by more. A tangent keeps the density above 2/3 D_k. So even
//! without an active acceleration limit, nothing is proven of feeds that are more than 1.5 times as fast somewhere.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | d | `d` | (n) | s/mm |
//! | c, s | `c`, `s` | (m) | s/mm |
//! | w | `w` | (m) | nm^2 mm/s |

use ndarray::Array2;
use planish_numerics::{
    linear::{
        skyline::{Skyline, dot},
        woodbury::Woodbury,
    },
    parallel,
};
use planish_types::{Surface, budget, progress};

use crate::{
    FeedError,
    deconvolution::{DeconvolutionSettings, Problem, Start, State, share_pixels, subtract_mean},
    limited::{self, ACCEPTED, ASKED},
};

/// Initial number of places per span between two knots at which the acceleration limit is a constraint, (2) of
/// [`crate::limited`]. Others are added where the acceleration exceeds the limit between them. Larger: larger quadratic
/// programs. Smaller: more rounds with added constraints.
const PLACES: usize = 16;

/// Fraction of the way to the boundary of the slacks and dual variables that a step may take. Larger: iterates close
/// to the boundary, and short steps after it. Smaller: more steps.
const STEP_TO_BOUNDARY: f64 = 0.99;

/// Duality gap at the start, as a fraction of the objective there. Larger: more steps. Smaller: a start near the
/// boundary, and short steps.
const FIRST_GAP: f64 = 0.3;

/// Smallest slack at the start, as a fraction of the density at its place. From an iterate near the boundary the first
/// steps are short. If a slack is above its c, the steps close the difference. Larger: a larger difference to close.
/// Smaller: short first steps.
const FIRST_SLACK: f64 = 0.1;

/// Smallest slack of an added constraint, as a fraction of the density at its place. Larger: a larger difference to
/// close. Smaller: short steps after the constraint is added.
const LEAST_SLACK: f64 = 1e-3;

/// Fraction of the wanted gap to which a quadratic program with kept tangents is solved before its bound is compared.
/// The rest is for the change of the tangents. Larger: more rounds of tangents. Smaller: more steps per quadratic
/// program.
const PROGRAM_TOLERANCE: f64 = 0.3;

/// Smallest complementarity (sum of the products s w) at which a step aims, as a fraction of the tolerance to which a
/// quadratic program is solved. Closer to the boundary nothing is gained, and the next tangents would make the steps
/// short. Larger: the quadratic program may not reach its tolerance. Smaller: short steps.
const CENTRED: f64 = 0.3;

/// Smallest objective to which a gap is compared, as a fraction of the objective without removal: 1e-5 of the RMS of
/// the map. Larger: an earlier end. Smaller: nothing can be proven for a map that a feed can remove entirely.
const EXACT: f64 = 1e-10;

/// Smallest ratio of the density at the start to its lower bound: an interior point method starts inside. Larger: the
/// start is farther from the given feed. Smaller: short first steps.
const INSIDE: f64 = 1.0 + 1e-3;

/// The quadratic program (1) of the module, with the parts of (2) that are the same in all steps; n is the number of
/// control values.
pub(crate) struct Joint<'a> {
    problem: &'a Problem,
    surface: &'a Surface,
    settings: &'a DeconvolutionSettings,
    /// Index of the first control value of every pass, and the number of all control values at the end.
    first: Vec<usize>,
    /// Lower bound 1/F of every control value, s/mm, length n.
    least: Vec<f64>,
    /// Index of every control value in the skyline matrix, length n.
    place: Vec<usize>,
    /// Products G'G and penalties of the objective, in the order of the skyline.
    normal: Skyline,
    /// Vector G'1 over the root of the number of valid pixels, in the order of the skyline; `None` if the piston is not
    /// free.
    uniform: Option<Vec<f64>>,
    /// Weights alpha K and beta K of the penalties.
    weights: [f64; 2],
}

/// Constraints of the acceleration limit: tangents, (2) of [`crate::limited`], at places along the passes.
struct AccelerationRows {
    /// Index of the pass and arc length on it, mm, of every place.
    places: Vec<(usize, f64)>,
    /// For every place: index of the first control value, four coefficients of `c = coefficient d - 2/3 D` for both
    /// signs of the acceleration, and density D there, s/mm.
    tangent: Vec<(usize, [[f64; 4]; 2], f64)>,
}

/// Variables of the interior point method: control values d, slacks s and dual variables w. Slacks are first those of
/// the n lower bounds, then of both signs of every tangent.
struct Iterate {
    d: Vec<f64>,
    s: Vec<f64>,
    w: Vec<f64>,
}

/// Objective, its gradient, the residual of the map, and the best piston, for given control values.
struct Value {
    objective: f64,
    gradient: Vec<f64>,
    residual_nm: Array2<f64>,
    piston_nm: f64,
}

impl<'a> Joint<'a> {
    /// Prepares the matrix of (2) of the module without the constraints. Refuses a matrix that takes too much memory.
    pub(crate) fn new(
        problem: &'a Problem,
        surface: &'a Surface,
        settings: &'a DeconvolutionSettings,
    ) -> Result<Self, FeedError> {
        let mut first = vec![0];
        for line in &problem.lines {
            first.push(first[first.len() - 1] + line.knots.len());
        }
        let least = problem
            .lines
            .iter()
            .flat_map(|l| vec![l.limits.min_density_s_per_mm; l.knots.len()])
            .collect();
        let (place, begin) = order(problem, &first);
        let elements: f64 = begin.iter().enumerate().map(|(i, b)| (i - b) as f64).sum();
        budget::affordable(
            "knot_spacing_mm",
            elements,
            2 * size_of::<f64>(),
            "give a larger `knot_spacing_mm`, or larger pixels of TIF and map",
        )?;
        let weights = problem.weights(settings);
        let normal = normal(problem, &first, &place, begin, weights);
        let mut uniform = None;
        if settings.free_piston {
            let valid = surface.height_nm().iter().filter(|z| !z.is_nan()).count();
            let mut u = vec![0.0; place.len()];
            for (i, column) in problem.all_columns().enumerate() {
                u[place[i]] = column.removal.sum() / (valid as f64).sqrt();
            }
            uniform = Some(u);
        }
        Ok(Self { problem, surface, settings, first, least, place, normal, uniform, weights })
    }

    /// Computes the feed of the smallest objective from `start`, and its proven gap. Without a proof after `max_sweeps`
    /// steps, or if the matrix cannot be factorised, it returns the last feed, brought within the limits, and no gap.
    /// `other_nm` (ny, nx) is the removal by other parts of the motion.
    pub(crate) fn solve(&self, other_nm: &Array2<f64>, start: Start) -> Result<State, FeedError> {
        let target_nm =
            (self.surface.height_nm() - other_nm).mapv(|z| if z.is_nan() { 0.0 } else { z });
        let tolerance = self.settings.tolerance;
        let nothing = 0.5 * target_nm.iter().map(|z| z * z).sum::<f64>();
        let scale = |objective: f64| objective.max(EXACT * nothing);
        let mut d: Vec<f64> = start.d.concat();
        d.iter_mut().zip(&self.least).for_each(|(d, least)| *d = d.max(INSIDE * least));
        let mut rows = AccelerationRows { places: self.places(), tangent: Vec::new() };
        rows.draw(self, &d);
        let mut now = self.value(&target_nm, &d);
        let mut iterate = self.first_iterate(d, &rows, now.objective);
        let mut held: Option<(Vec<f64>, f64)> = None;
        let mut objective = vec![now.objective];
        let mut steps = 0;
        let mut first_gap = None;
        let mut gap = None;
        while steps < self.settings.max_sweeps {
            // How far a quadratic program is solved before its bound is compared.
            let solved = PROGRAM_TOLERANCE * tolerance * scale(now.objective);
            let complementarity = dot(&iterate.s, &iterate.w);
            if let Some((d, held_objective)) = &held {
                let open = self.open(&iterate, &rows, &now);
                if open <= solved {
                    let proven = (held_objective - (now.objective - open)) / scale(*held_objective);
                    let first = *first_gap.get_or_insert(proven);
                    progress::done(progress::of_convergence(first, proven, tolerance));
                    if proven <= tolerance {
                        iterate.d.clone_from(d);
                        gap = Some(proven.max(0.0));
                        break;
                    }
                    held = None;
                }
            }
            if held.is_none() {
                // Not `solved`: tangents that are drawn after every step keep the complementarity above it.
                let near = complementarity <= tolerance * scale(now.objective);
                let excess = if near { self.excess(&iterate.d) } else { Vec::new() };
                let fell =
                    objective.iter().rev().nth(1).map_or(f64::INFINITY, |f| f - now.objective);
                let is_within =
                    excess.is_empty() && iterate.d.iter().zip(&self.least).all(|(d, l)| d >= l);
                if near && is_within && fell.abs() <= solved {
                    held = Some((iterate.d.clone(), now.objective));
                }
                self.renew(&mut iterate, &mut rows, excess);
            }
            if !self.step(&mut iterate, &rows, &now, CENTRED * solved) {
                break;
            }
            now = self.value(&target_nm, &iterate.d);
            objective.push(now.objective);
            steps += 1;
        }
        let d = if gap.is_some() { iterate.d } else { self.within(&iterate.d)? };
        let value = self.value(&target_nm, &d);
        Ok(State {
            d: self.lines(&d),
            piston_nm: value.piston_nm,
            residual_nm: value.residual_nm,
            objective,
            converged: gap.is_some(),
            gap,
            steps,
            ..self.problem.untouched()
        })
    }

    /// Splits the control values `d` of all passes, s/mm, into one vector per pass.
    fn lines(&self, d: &[f64]) -> Vec<Vec<f64>> {
        self.first.windows(2).map(|w| d[w[0]..w[1]].to_vec()).collect()
    }

    /// Returns control values within the limits, s/mm, that are close to `d`; see [`limited::next_within`].
    fn within(&self, d: &[f64]) -> Result<Vec<f64>, FeedError> {
        let lines = parallel::map(self.problem.lines.len(), &|m| {
            let line = &self.problem.lines[m];
            let d = d[self.first[m]..self.first[m + 1]].to_vec();
            limited::next_within(&line.knots, line.limits, d)
                .map_err(|status| FeedError::Solver { pass: m, status })
        });
        Ok(lines.into_iter().collect::<Result<Vec<_>, _>>()?.concat())
    }

    /// Returns the initial places of the acceleration constraints: index of the pass and arc length on it, mm.
    fn places(&self) -> Vec<(usize, f64)> {
        let mut places = Vec::new();
        for (m, line) in self.problem.lines.iter().enumerate() {
            for span in line.knots.breaks().windows(2) {
                let length = span[1] - span[0];
                let parts = (0..PLACES).map(|k| span[0] + length * k as f64 / PLACES as f64);
                places.extend(parts.map(|s| (m, s)));
            }
            places.extend(line.knots.breaks().last().map(|s| (m, *s)));
        }
        places
    }

    /// Makes the variables at the start, with slacks and dual variables inside of their bounds.
    fn first_iterate(&self, d: Vec<f64>, rows: &AccelerationRows, objective: f64) -> Iterate {
        let mut s = rows.values(&d, &self.least);
        for (j, s) in s.iter_mut().enumerate() {
            let density = match j.checked_sub(d.len()) {
                None => d[j],
                Some(k) => rows.tangent[k / 2].2,
            };
            *s = s.max(FIRST_SLACK * density);
        }
        let mu = FIRST_GAP * objective / s.len() as f64;
        let w = s.iter().map(|s| mu / s).collect();
        Iterate { d, s, w }
    }

    /// Computes the tangents anew at the control values of the iterate, and adds the places `excess` (pass, arc length
    /// in mm). Scales the dual variables with their rows, raises slacks that have grown, and adds slacks and dual
    /// variables for the new places.
    fn renew(&self, iterate: &mut Iterate, rows: &mut AccelerationRows, excess: Vec<(usize, f64)>) {
        let n = iterate.d.len();
        let mu = dot(&iterate.s, &iterate.w) / iterate.s.len() as f64;
        let before: Vec<f64> = rows.tangent.iter().map(|t| t.2).collect();
        rows.places.extend(excess);
        rows.draw(self, &iterate.d);
        // A tangent at D is divided by 3 A D^2.
        for (k, before) in before.into_iter().enumerate() {
            let factor = (rows.tangent[k].2 / before).powi(2);
            iterate.w[n + 2 * k..n + 2 * k + 2].iter_mut().for_each(|w| *w *= factor);
        }
        let c = rows.values(&iterate.d, &self.least);
        for (j, c) in c.into_iter().enumerate() {
            let least = match j.checked_sub(n) {
                None => 0.0,
                Some(k) => LEAST_SLACK * rows.tangent[k / 2].2,
            };
            if j >= iterate.s.len() {
                iterate.s.push(c.max(least));
                iterate.w.push(mu / iterate.s[j]);
            } else {
                iterate.s[j] = iterate.s[j].max(c);
            }
        }
    }

    /// Returns the objective f, its gradient, the residual and the best piston for the control values `d`. `target_nm`
    /// is the desired removal less that of other parts of the motion; it has to be 0 where the map is invalid.
    fn value(&self, target_nm: &Array2<f64>, d: &[f64]) -> Value {
        let mut residual_nm = target_nm.clone();
        for (column, d) in self.problem.all_columns().zip(d) {
            column.add_to(&mut residual_nm, -d);
        }
        let mut piston_nm = 0.0;
        if self.settings.free_piston {
            piston_nm = -subtract_mean(self.surface, &mut residual_nm);
        }
        let [alpha, beta] = self.weights;
        let lines: Vec<(f64, Vec<f64>)> = parallel::map(self.problem.lines.len(), &|m| {
            let d = &d[self.first[m]..self.first[m + 1]];
            let least = self.problem.lines[m].limits.min_density_s_per_mm;
            let columns = self.problem.columns(m);
            let mut g: Vec<f64> = columns.iter().map(|c| -c.dot(&residual_nm)).collect();
            let mut penalty = 0.0;
            for (g, d) in g.iter_mut().zip(d) {
                *g += alpha * (d - least);
                penalty += alpha * (d - least).powi(2);
            }
            for (i, w) in d.windows(3).enumerate() {
                let second = w[0] - 2.0 * w[1] + w[2];
                penalty += beta * second * second;
                for (k, v) in [1.0, -2.0, 1.0].into_iter().enumerate() {
                    g[i + k] += beta * v * second;
                }
            }
            (penalty, g)
        });
        let squares: f64 = residual_nm.iter().map(|r| r * r).sum();
        let penalties: f64 = lines.iter().map(|l| l.0).sum();
        let gradient = lines.into_iter().flat_map(|l| l.1).collect();
        Value { objective: 0.5 * (squares + penalties), gradient, residual_nm, piston_nm }
    }

    /// Returns the distance of the objective from its lower bound (3) of the module, `w' c + r' P0^-1 r / 2`, nm^2.
    fn open(&self, iterate: &Iterate, rows: &AccelerationRows, now: &Value) -> f64 {
        let c = rows.values(&iterate.d, &self.least);
        let r = self.dual_residual(iterate, rows, now);
        let [alpha, beta] = self.weights;
        let of_lines = (0..self.problem.lines.len()).map(|m| {
            let r = &r[self.first[m]..self.first[m + 1]];
            let mut p = Skyline::zeros((0..r.len()).map(|i| i.saturating_sub(2)).collect());
            add_penalties(&mut p, r.len(), [alpha, beta], |i| i);
            let Some(factor) = p.factorise() else { return f64::INFINITY };
            let mut x = r.to_vec();
            factor.solve(&mut x);
            dot(r, &x)
        });
        let of_lines: f64 = of_lines.sum();
        dot(&iterate.w, &c) + 0.5 * of_lines
    }

    /// Returns the vector r of (3) of the module: the gradient less the constraints' transpose times the dual
    /// variables.
    fn dual_residual(&self, iterate: &Iterate, rows: &AccelerationRows, now: &Value) -> Vec<f64> {
        let of_rows = rows.transposed(&iterate.w, iterate.d.len());
        now.gradient.iter().zip(of_rows).map(|(g, w)| g - w).collect()
    }

    /// Does a predictor step, and a corrector step that aims at a complementarity of at least `least`. Returns false if
    /// the matrix cannot be factorised.
    fn step(
        &self,
        iterate: &mut Iterate,
        rows: &AccelerationRows,
        now: &Value,
        least: f64,
    ) -> bool {
        let m = iterate.s.len();
        let Some(factor) = self.factor(iterate, rows) else { return false };
        let system = System {
            joint: self,
            rows,
            factor,
            r: self.dual_residual(iterate, rows, now),
            short: (rows.values(&iterate.d, &self.least).iter().zip(&iterate.s))
                .map(|(c, s)| c - s)
                .collect(),
        };
        let mu = dot(&iterate.s, &iterate.w) / m as f64;
        let predictor = system.direction(iterate, |_| 0.0);
        let a = predictor.longest(iterate);
        let Iterate { s: ds, w: dw, .. } = &predictor;
        let after: f64 =
            (0..m).map(|j| (iterate.s[j] + a * ds[j]) * (iterate.w[j] + a * dw[j])).sum();
        let aim = ((after / m as f64 / mu).powi(3) * mu).max(least / m as f64);
        let corrector = system.direction(iterate, |j| aim - ds[j] * dw[j]);
        let a = corrector.longest(iterate);
        add(&mut iterate.d, a, &corrector.d);
        add(&mut iterate.s, a, &corrector.s);
        add(&mut iterate.w, a, &corrector.w);
        true
    }

    /// Factorises the matrix of (2) of the module; `None` if it is not positive definite to rounding.
    fn factor(&self, iterate: &Iterate, rows: &AccelerationRows) -> Option<Woodbury> {
        let n = iterate.d.len();
        let theta: Vec<f64> = iterate.w.iter().zip(&iterate.s).map(|(w, s)| w / s).collect();
        let mut matrix = self.normal.clone();
        for (i, theta) in theta[..n].iter().enumerate() {
            matrix.add(self.place[i], self.place[i], *theta);
        }
        for (k, (first, coefficient, _)) in rows.tangent.iter().enumerate() {
            for (sign, row) in coefficient.iter().enumerate() {
                let theta = theta[n + 2 * k + sign];
                for a in 0..4 {
                    for b in 0..=a {
                        let p = self.place[first + a];
                        let q = self.place[first + b];
                        matrix.add(p.max(q), p.min(q), theta * row[a] * row[b]);
                    }
                }
            }
        }
        let uniform: Vec<Vec<f64>> = self.uniform.iter().cloned().collect();
        matrix.factorise().and_then(|factor| Woodbury::new(factor, &uniform))
    }

    /// Returns the places (index of the pass, arc length in mm) of the peaks at which the acceleration exceeds the
    /// accepted limit. Places a little before and after each peak are included.
    fn excess(&self, d: &[f64]) -> Vec<(usize, f64)> {
        let lines = parallel::map(self.problem.lines.len(), &|m| {
            let line = &self.problem.lines[m];
            let d = &d[self.first[m]..self.first[m + 1]];
            let limit = ACCEPTED * line.limits.max_acceleration_mm_per_s2;
            let breaks = line.knots.breaks();
            let end = breaks.last().copied().unwrap_or(0.0);
            let beside = (breaks[1] - breaks[0]) / (4 * PLACES) as f64;
            let peaks = limited::peaks(&line.knots, d, limit);
            // Beside it, too: a peak moves as the feed changes.
            let places = peaks.iter().flat_map(|p| [-beside, 0.0, beside].map(|by| p.s_mm + by));
            places.map(|s| (m, s.clamp(0.0, end))).collect::<Vec<_>>()
        });
        lines.into_iter().flatten().collect()
    }
}
/// The factorised equations (2) of the module at an iterate.
struct System<'a> {
    joint: &'a Joint<'a>,
    rows: &'a AccelerationRows,
    factor: Woodbury,
    /// Vector r of (3) of the module.
    r: Vec<f64>,
    /// Differences c - s between the constraints and their slacks.
    short: Vec<f64>,
}

impl System<'_> {
    /// Solves (2) of the module for the step after which the product s w of constraint j would be `target(j)`, to first
    /// order.
    fn direction(&self, iterate: &Iterate, target: impl Fn(usize) -> f64) -> Iterate {
        let Iterate { d, s, w } = iterate;
        let n = d.len();
        let m = s.len();
        let y: Vec<f64> =
            (0..m).map(|j| (target(j) - w[j] * (s[j] + self.short[j])) / s[j]).collect();
        let of_rows = self.rows.transposed(&y, n);
        let place = &self.joint.place;
        let mut x = vec![0.0; n];
        for i in 0..n {
            x[place[i]] = of_rows[i] - self.r[i];
        }
        self.factor.solve(&mut x);
        let step: Vec<f64> = (0..n).map(|i| x[place[i]]).collect();
        let changes = self.rows.changes(&step).into_iter();
        let ds: Vec<f64> = changes.zip(&self.short).map(|(c, short)| c + short).collect();
        let dw = (0..m).map(|j| (target(j) - w[j] * (s[j] + ds[j])) / s[j]).collect();
        Iterate { d: step, s: ds, w: dw }
    }
}

impl Iterate {
    /// Returns the fraction of this step, at most 1, that may be taken from `iterate`. Its slacks and dual variables go
    /// at most the fraction [`STEP_TO_BOUNDARY`] of the way to 0.
    fn longest(&self, iterate: &Self) -> f64 {
        let slack = longest_positive(&iterate.s, &self.s);
        (STEP_TO_BOUNDARY * slack.min(longest_positive(&iterate.w, &self.w))).min(1.0)
    }
}

/// Returns the largest factor a for which no element of `v + a dv` is negative; infinity if none falls.
fn longest_positive(v: &[f64], dv: &[f64]) -> f64 {
    let falling = v.iter().zip(dv).filter(|(_, dv)| **dv < 0.0);
    falling.map(|(v, dv)| -v / dv).fold(f64::INFINITY, f64::min)
}

/// Adds `a dv` to the vector v.
fn add(v: &mut [f64], a: f64, dv: &[f64]) {
    v.iter_mut().zip(dv).for_each(|(v, dv)| *v += a * dv);
}
impl AccelerationRows {
    /// Computes the tangents at the densities of the control values `d`.
    fn draw(&mut self, joint: &Joint<'_>, d: &[f64]) {
        self.tangent = parallel::map(self.places.len(), &|k| {
            let (m, s) = self.places[k];
            let line = &joint.problem.lines[m];
            let first = joint.first[m];
            let end = joint.first[m + 1];
            let limit = ASKED * line.limits.max_acceleration_mm_per_s2;
            let row = limited::tangent(&line.knots, &d[first..end], s, limit);
            // coefficient d <= bound = -2/3 D
            let coefficient = row.coefficient.map(|c| c.map(|v| -v));
            (first + row.first, coefficient, -1.5 * row.bound)
        });
    }

    /// Returns the change of all constraints by a step of the control values, the product `J step` in (2) of the
    /// module.
    fn changes(&self, step: &[f64]) -> Vec<f64> {
        let mut c = step.to_vec();
        for (first, coefficient, _) in &self.tangent {
            let here = &step[*first..first + 4];
            c.extend(coefficient.iter().map(|row| dot(row, here)));
        }
        c
    }

    /// Returns the values c of all constraints at the control values `d`, s/mm.
    fn values(&self, d: &[f64], least: &[f64]) -> Vec<f64> {
        let mut c = self.changes(d);
        c.iter_mut().zip(least).for_each(|(c, least)| *c -= least);
        for (k, (_, _, density)) in self.tangent.iter().enumerate() {
            c[d.len() + 2 * k] -= 2.0 / 3.0 * density;
            c[d.len() + 2 * k + 1] -= 2.0 / 3.0 * density;
        }
        c
    }

    /// Returns the transpose of the matrix of the constraints times `y`, J' y, for n control values.
    fn transposed(&self, y: &[f64], n: usize) -> Vec<f64> {
        let mut x = y[..n].to_vec();
        for (k, (first, coefficient, _)) in self.tangent.iter().enumerate() {
            for (sign, row) in coefficient.iter().enumerate() {
                let y = y[n + 2 * k + sign];
                row.iter().zip(&mut x[*first..]).for_each(|(v, x)| *x += v * y);
            }
        }
        x
    }
}

/// Returns the index of every control value in a skyline matrix, and the first column of each of its rows. Control
/// values are ordered pass by pass, or by their position along the passes, whichever takes fewer multiplications.
fn order(problem: &Problem, first: &[usize]) -> (Vec<usize>, Vec<usize>) {
    let n = first[first.len() - 1];
    let boxes: Vec<_> = problem.all_columns().map(|c| c.pixels()).collect();
    let lines: Vec<_> = (0..problem.lines.len()).map(|m| problem.pixels(m)).collect();
    let begin = |place: &[usize]| {
        let mut begin: Vec<usize> = (0..n).collect();
        for m in 0..lines.len() {
            for i in first[m]..first[m + 1] {
                // The penalties and the rows of the limit couple four in a row.
                let own = i.saturating_sub(3).max(first[m])..(i + 4).min(first[m + 1]);
                let others = (0..lines.len())
                    .filter(|k| share_pixels(boxes[i], lines[*k]))
                    .flat_map(|k| first[k]..first[k + 1])
                    .filter(|j| share_pixels(boxes[i], boxes[*j]));
                let lowest = own.chain(others).map(|j| place[j]).min().unwrap_or(place[i]);
                begin[place[i]] = lowest.min(place[i]);
            }
        }
        begin
    };
    let by_line: Vec<usize> = (0..n).collect();
    // Along the lines: by the middle of what a control value reaches, in the direction in which a line is longer.
    let (wide, high) = lines
        .iter()
        .flatten()
        .fold((0, 0), |(wide, high), [t, b, l, r]| (wide + r - l, high + b - t));
    // What reaches no pixel stays beside its neighbour.
    let mut key: Vec<usize> = (boxes.iter())
        .map(|pixels| match pixels {
            Some([_, _, l, r]) if wide >= high => l + r,
            Some([t, b, _, _]) => t + b,
            None => 0,
        })
        .collect();
    for m in 0..lines.len() {
        let reached: Vec<usize> =
            (first[m]..first[m + 1]).filter(|i| boxes[*i].is_some()).collect();
        for i in (first[m]..first[m + 1]).filter(|i| boxes[*i].is_none()) {
            let near = reached.iter().min_by_key(|j| j.abs_diff(i));
            key[i] = near.map_or(0, |j| key[*j]);
        }
    }
    let mut sorted = by_line.clone();
    sorted.sort_by_key(|i| (key[*i], *i));
    let mut along = vec![0; n];
    sorted.iter().enumerate().for_each(|(place, i)| along[*i] = place);
    let [of_lines, of_along] = [begin(&by_line), begin(&along)];
    if cost(&of_along) < cost(&of_lines) { (along, of_along) } else { (by_line, of_lines) }
}

/// Returns about the number of multiplications of a factorisation of a skyline matrix, from the first column of every
/// row.
fn cost(begin: &[usize]) -> f64 {
    begin.iter().enumerate().map(|(i, b)| ((i - b) as f64).powi(2)).sum()
}

/// Returns the skyline matrix of the products G'G and the penalties of the objective.
fn normal(
    problem: &Problem,
    first: &[usize],
    place: &[usize],
    begin: Vec<usize>,
    weights: [f64; 2],
) -> Skyline {
    let columns: Vec<_> = problem.all_columns().collect();
    let mut value_at = vec![0; place.len()];
    place.iter().enumerate().for_each(|(i, place)| value_at[*place] = i);
    let mut normal = Skyline::zeros(begin.clone());
    normal.fill(|row, elements| {
        for (j, v) in elements.iter_mut().enumerate() {
            *v = columns[value_at[row]].dot_column(columns[value_at[begin[row] + j]]);
        }
    });
    for w in first.windows(2) {
        add_penalties(&mut normal, w[1] - w[0], weights, |i| place[w[0] + i]);
    }
    normal
}

/// Adds the penalty `alpha K + beta K (second differences)'(second differences)` for a pass of n control values, whose
/// indices in the matrix are `place(i)`.
fn add_penalties(
    matrix: &mut Skyline,
    n: usize,
    [alpha, beta]: [f64; 2],
    place: impl Fn(usize) -> usize,
) {
    for i in 0..n {
        matrix.add(place(i), place(i), alpha);
    }
    for i in 1..n - 1 {
        let row = [(i - 1, 1.0), (i, -2.0), (i + 1, 1.0)];
        for (a, va) in row {
            for (b, vb) in row {
                let p = place(a);
                let q = place(b);
                if q <= p {
                    matrix.add(p, q, beta * va * vb);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use planish_numerics::bspline::Knots;
    use planish_testkit::numbers;
    use planish_types::{Axis, Grid, Limits, Tif, ToolPath};

    use crate::{deconvolution::Refinement, passes::passes};

    /// Makes a map of 5 x 2 mm with random waves.
    fn surface(seed: u64) -> Surface {
        let axis = |n: usize| Axis::new(0.0, 0.125, n).unwrap();
        let grid = Grid { x: axis(41), y: axis(17) };
        let mut random = numbers(seed);
        let wave: Vec<f64> = (0..6).map(|_| 3.0 * random()).collect();
        let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
            30.0 + 10.0 * (wave[0] * x + wave[1]).sin()
                + 10.0 * (wave[2] * x - wave[3] * y).cos()
                + 3.0 * random()
        });
        Surface::new(grid, height).unwrap()
    }

    /// Makes the problem of five lines 0.5 mm apart, with a Gaussian TIF of sigma 0.4 mm.
    fn problem(surface: &Surface, limits: &Limits) -> Problem {
        let a = Axis::new(-1.5, 0.125, 25).unwrap();
        let rate = Array2::from_shape_fn((25, 25), |(r, c)| {
            10.0 * (-(a.coordinate_mm(c).powi(2) + a.coordinate_mm(r).powi(2)) / 0.32).exp()
        });
        let tif = Tif::new(Grid { x: a, y: a }, rate).unwrap();
        let (mut points, mut idx) = (Vec::new(), Vec::new());
        for k in 0..5 {
            let y = 0.5 * f64::from(k);
            let ends = if k % 2 == 0 { [-1.5, 6.5] } else { [6.5, -1.5] };
            if k > 0 {
                idx.push(i64::from(k) - 1);
            }
            points.extend(ends.map(|x| [x, y]));
            idx.push(i64::from(k));
        }
        let path = ToolPath::through(points, vec![true; idx.len()], idx).unwrap();
        let passes = passes(&path, surface, limits).unwrap();
        let knots = passes.iter().map(|p| Knots::uniform(p.length_mm(), 20)).collect();
        Problem::new(&passes, knots, &tif, surface).unwrap()
    }

    fn settings(free_piston: bool, tolerance: f64) -> DeconvolutionSettings {
        DeconvolutionSettings {
            refinement: Refinement::ConvexConcave,
            free_piston,
            tikhonov: 1e-5,
            curvature_weight: 1e-4,
            tolerance,
            max_sweeps: 300,
        }
    }

    fn start(problem: &Problem) -> Start {
        Start {
            d: problem
                .lines
                .iter()
                .map(|l| vec![l.limits.min_density_s_per_mm; l.knots.len()])
                .collect(),
            piston_nm: 0.0,
        }
    }

    /// Minimises the objective under the bounds alone, by changing one control value after the other.
    fn by_coordinates(joint: &Joint<'_>, target_nm: &Array2<f64>) -> f64 {
        let n = joint.place.len();
        let columns: Vec<_> = joint.problem.all_columns().collect();
        let mut d: Vec<f64> = joint.least.clone();
        let mut gradient = joint.value(target_nm, &d).gradient;
        let element = |i: usize, j: usize| {
            let (p, q) = (joint.place[i].max(joint.place[j]), joint.place[i].min(joint.place[j]));
            joint.normal.element(p, q)
                - joint.uniform.as_ref().map_or(0.0, |u| u[joint.place[i]] * u[joint.place[j]])
        };
        let matrix = Array2::from_shape_fn((n, n), |(i, j)| element(i, j));
        assert_eq!(columns.len(), n);
        for _ in 0..20_000 {
            for i in 0..n {
                let to = (d[i] - gradient[i] / matrix[[i, i]]).max(joint.least[i]);
                let step = to - d[i];
                d[i] = to;
                if step != 0.0 {
                    gradient.iter_mut().zip(matrix.row(i)).for_each(|(g, m)| *g += step * m);
                }
            }
        }
        joint.value(target_nm, &d).objective
    }

    #[test]
    fn without_a_need_for_acceleration_it_is_the_least_objective_of_another_method() {
        for seed in 0..6 {
            let surface = surface(seed);
            let limits = planish_testkit::machine([5.0; 2], [1e9; 2]);
            let problem = problem(&surface, &limits);
            let settings = settings(seed % 2 == 1, 1e-5);
            let joint = Joint::new(&problem, &surface, &settings).unwrap();
            let none = Array2::zeros(surface.grid().shape());
            let state = joint.solve(&none, start(&problem)).unwrap();
            let found = joint.value(surface.height_nm(), &state.d.concat()).objective;
            let least = by_coordinates(&joint, surface.height_nm());
            println!("{seed}: {found} after {} steps, {least} by coordinates", state.steps);
            assert!(state.converged, "{seed}");
            // The bound is below the least objective, which the descent approaches from above. The tangents exclude
            // densities below 2/3 D_k, to which those that the tool hardly sees fall by and by: 1e-9 of the objective.
            let bound = found * (1.0 - state.gap.unwrap());
            assert!(bound <= least * (1.0 + 1e-7), "{seed}: {bound} {least}");
            // The tolerance of the settings: the gap at which it ends.
            assert!(found <= least * (1.0 + 1e-5), "{seed}: {found} {least}");
        }
    }

    #[test]
    fn no_step_of_the_procedure_by_lines_gains_more_than_the_gap() {
        for (seed, acceleration) in [(11, 2.0), (12, 20.0), (13, 0.5)] {
            let surface = surface(seed);
            let limits = planish_testkit::machine([5.0; 2], [acceleration; 2]);
            let problem = problem(&surface, &limits);
            let settings = settings(false, 1e-3);
            let joint = Joint::new(&problem, &surface, &settings).unwrap();
            let none = Array2::zeros(surface.grid().shape());
            let state = joint.solve(&none, start(&problem)).unwrap();
            assert!(state.converged, "{acceleration}");
            let d = state.d.concat();
            let found = joint.value(surface.height_nm(), &d);
            for (m, line) in problem.lines.iter().enumerate() {
                let peak = limited::highest_peak(&line.knots, &state.d[m]);
                assert!(peak.acceleration_mm_per_s2 <= line.limits.max_acceleration_mm_per_s2);
                // The same line, alone, under its tangents: by the quadratic program of another solver.
                let range = joint.first[m]..joint.first[m + 1];
                let n = range.len();
                let p = Array2::from_shape_fn((n, n), |(i, j)| {
                    let (a, b) = (joint.place[range.start + i], joint.place[range.start + j]);
                    joint.normal.element(a.max(b), a.min(b))
                });
                let q = (0..n)
                    .map(|i| {
                        (0..n).map(|j| p[[i, j]] * state.d[m][j]).sum::<f64>()
                            - found.gradient[range.start + i]
                    })
                    .collect();
                let objective = limited::Quadratic { p, q };
                let mut rows = Vec::new();
                let better = limited::convex_concave_step(
                    &objective,
                    &line.knots,
                    line.limits,
                    &state.d[m],
                    &mut rows,
                )
                .unwrap();
                let gained = objective.value(&state.d[m]) - objective.value(&better);
                let gap = state.gap.unwrap() * found.objective;
                // The other solver's 1e-8 of the terms of its objective.
                let rounding = 1e-6 * objective.value(&better).abs();
                assert!(gained <= gap + rounding, "{acceleration}, line {m}: {gained} {gap}");
            }
        }
    }
}
