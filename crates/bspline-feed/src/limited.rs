//! Minimum of a quadratic objective in the control values of one pass, within the limits of its feed and acceleration.
//!
//! ```text
//! min 1/2 d'P d - q'd   subject to   d_i >= 1/F,   |D'(s)| <= A D(s)^3 for all s              (1)
//! ```
//!
//! The first bound is on the control values, so D >= 1/F everywhere. The second is the acceleration
//! `a = -D'/D^3`. It is not convex; two ways to deal with it:
//!
//! *Convex-concave procedure.* D^3 is convex where D > 0, so it lies above its tangent at any D_k:
//!
//! ```text
//! |D'(s)| <= A (3 D_k^2 D - 2 D_k^3)                                                        (2)
//! ```
//!
//! implies (1), is linear in d, and holds for D = D_k where D_k is feasible. So every step is
//! feasible and none is worse than the one before; a D_k that is not feasible is no obstacle, as a
//! large constant satisfies (2) as well. Rows (2) are added where a solution exceeds the limit, at
//! the extrema of a(s), until it exceeds it nowhere.
//!
//! *Knot removal*, the source's way: while the limit is exceeded, the interior knot next to the
//! largest |a| is removed and the problem without (2) is solved again.
//!
//! Source: the B-spline deconvolution of feed profiles, Eq. 10 and Fig. 2, with a = -D'/D^3 stated;
//! T. Lipp, S. Boyd, Optim. Eng. 17 (2016) 263 (the procedure).
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | d, D | `d`, values of the spline | s/mm |
//! | 1/F | `min_density_s_per_mm` | s/mm |
//! | A | `max_acceleration_mm_per_s2` | mm/s^2 |

use clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus,
        SupportedConeT::NonnegativeConeT,
    },
};
use ndarray::{Array2, ArrayView1};
use planish_numerics::bspline::Knots;

/// Quadratic objective `1/2 d'P d - q'd` of the n control values; P is symmetric and positive semidefinite.
#[derive(Clone, Debug)]
pub struct Quadratic {
    /// Matrix P, shape (n, n).
    pub p: Array2<f64>,
    /// Vector q, length n.
    pub q: Vec<f64>,
}

impl Quadratic {
    /// Returns the value of the objective at the control values `d`.
    pub fn value(&self, d: &[f64]) -> f64 {
        let d = ArrayView1::from(d);
        0.5 * d.dot(&self.p.dot(&d)) - d.dot(&ArrayView1::from(&self.q))
    }

    /// Returns the objective as a function of the control values c on coarser knots, with `d = K c`.
    fn of_coarser(&self, k: &Array2<f64>) -> Self {
        Self { p: k.t().dot(&self.p).dot(k), q: k.t().dot(&ArrayView1::from(&self.q)).to_vec() }
    }
}

/// Limits of the feed along one pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FeedLimits {
    /// Smallest dwell-time density, s/mm: the inverse of the largest feed.
    pub min_density_s_per_mm: f64,
    /// Largest acceleration along the pass, mm/s^2.
    pub max_acceleration_mm_per_s2: f64,
}

/// Number of samples of the acceleration a(s) per span between two knots, for the search of its extrema. Larger: more
/// time. Smaller: an extremum between two samples may be missed.
const SAMPLES: u32 = 40;

/// Fraction of the acceleration limit that the constraints (2) of the module ask for. The distance to [`ACCEPTED`] is
/// for the tolerance of the solver and of the search for the extrema. Larger: solutions that are not accepted, and more
/// rounds. Smaller: slower feeds.
pub(crate) const ASKED: f64 = 0.998;
/// Fraction of the acceleration limit up to which a solution is accepted. The rest is for the cubic pieces that are
/// fitted to the motion. Larger: the motion may exceed the limit. Smaller: more rounds, or slower feeds.
pub(crate) const ACCEPTED: f64 = 0.9995;

/// Largest number of rounds in which constraints are added. After them a slower feed removes the excess that is left.
/// Larger: more time. Smaller: slower feeds.
const MAX_ROUNDS: usize = 60;

/// A local extremum of the acceleration along a pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Peak {
    /// Arc length from the start of the pass, mm.
    pub s_mm: f64,
    /// Magnitude of the acceleration, mm/s^2.
    pub acceleration_mm_per_s2: f64,
}

/// Returns the local maxima of the magnitude of the acceleration above `threshold`, mm/s^2, in the order of the arc
/// length. Both ends of the pass can be among them.
pub(crate) fn peaks(knots: &Knots, d: &[f64], threshold: f64) -> Vec<Peak> {
    let mut places: Vec<f64> = Vec::new();
    for span in knots.breaks().windows(2) {
        let length = span[1] - span[0];
        places.extend((0..SAMPLES).map(|k| span[0] + length * f64::from(k) / f64::from(SAMPLES)));
    }
    places.extend(knots.breaks().last());
    let a: Vec<f64> = places.iter().map(|s| acceleration(knots, d, *s)).collect();
    let mut peaks = Vec::new();
    for k in 0..places.len() {
        let before = k.saturating_sub(1);
        let after = (k + 1).min(places.len() - 1);
        if a[k] >= a[before] && a[k] >= a[after] && a[k] > 0.5 * threshold {
            // Golden section between the neighbours.
            let mut low = places[before];
            let mut high = places[after];
            for _ in 0..30 {
                let inner = 0.381_966 * (high - low);
                if acceleration(knots, d, low + inner) >= acceleration(knots, d, high - inner) {
                    high -= inner;
                } else {
                    low += inner;
                }
            }
            let refined = 0.5 * (low + high);
            let value = acceleration(knots, d, refined);
            let (s_mm, value) = if value >= a[k] { (refined, value) } else { (places[k], a[k]) };
            if value > threshold {
                peaks.push(Peak { s_mm, acceleration_mm_per_s2: value });
            }
        }
    }
    peaks
}

/// Returns the magnitude of the acceleration at the arc length `s`, |D'| / D^3, mm/s^2.
fn acceleration(knots: &Knots, d: &[f64], s: f64) -> f64 {
    let density = knots.value(d, s);
    knots.derivative(d, s).abs() / (density * density * density)
}

/// Returns the extremum with the largest magnitude of the acceleration; 0 at the start if the acceleration is 0
/// everywhere.
pub fn highest_peak(knots: &Knots, d: &[f64]) -> Peak {
    let none = Peak { s_mm: 0.0, acceleration_mm_per_s2: 0.0 };
    peaks(knots, d, 0.0)
        .into_iter()
        .fold(none, |m, p| if p.acceleration_mm_per_s2 > m.acceleration_mm_per_s2 { p } else { m })
}

/// Does one step of the convex-concave procedure of the module from the control values `current` (positive), s/mm.
///
/// `rows_mm` are the arc lengths of the constraints (2), mm. On entry they are those of the step before, on return
/// those at which the acceleration exceeds half of its limit. If the limit is still exceeded after the rounds, a
/// constant is added to all control values until it is kept.
///
/// # Errors
/// Returns the status or the error of the solver if it does not solve a quadratic program.
pub fn convex_concave_step(
    objective: &Quadratic,
    knots: &Knots,
    limits: FeedLimits,
    current: &[f64],
    rows_mm: &mut Vec<f64>,
) -> Result<Vec<f64>, String> {
    let limit = limits.max_acceleration_mm_per_s2;
    for _ in 0..MAX_ROUNDS {
        let rows: Vec<TangentRow> =
            rows_mm.iter().map(|s| tangent(knots, current, *s, ASKED * limit)).collect();
        let d = quadratic_program(objective, limits.min_density_s_per_mm, &rows)?;
        let excess = peaks(knots, &d, ACCEPTED * limit);
        if excess.is_empty() {
            rows_mm.retain(|s| acceleration(knots, &d, *s) > 0.5 * limit);
            return Ok(d);
        }
        rows_mm.extend(excess.iter().map(|p| p.s_mm));
        rows_mm.sort_by(f64::total_cmp);
        rows_mm.dedup();
        if rows_mm.len() > 50 * knots.len() {
            break;
        }
    }
    // Not reached with a sound program; what it left is mended by a slower feed.
    let rows: Vec<TangentRow> =
        rows_mm.iter().map(|s| tangent(knots, current, *s, ASKED * limit)).collect();
    Ok(slowed(knots, quadratic_program(objective, limits.min_density_s_per_mm, &rows)?, limit))
}

/// Returns control values within the limits close to the positive `wanted`. They are `wanted` itself if it keeps the
/// limits, and otherwise the result of the convex-concave procedure for `min |d - wanted|^2`.
///
/// # Errors
/// Returns the failure of the quadratic program.
pub fn next_within(
    knots: &Knots,
    limits: FeedLimits,
    wanted: Vec<f64>,
) -> Result<Vec<f64>, String> {
    let limit = ACCEPTED * limits.max_acceleration_mm_per_s2;
    let least = limits.min_density_s_per_mm;
    if wanted.iter().all(|d| *d >= least)
        && highest_peak(knots, &wanted).acceleration_mm_per_s2 <= limit
    {
        return Ok(wanted);
    }
    let objective = Quadratic { p: Array2::eye(wanted.len()), q: wanted.clone() };
    closest_within(&objective, knots, limits, wanted)
}

/// Does six steps of the convex-concave procedure from `start`, after which the control values hardly change.
///
/// # Errors
/// Returns the failure of the quadratic program.
pub fn closest_within(
    objective: &Quadratic,
    knots: &Knots,
    limits: FeedLimits,
    start: Vec<f64>,
) -> Result<Vec<f64>, String> {
    let mut rows_mm = Vec::new();
    (0..STEPS_TO_SETTLE)
        .try_fold(start, |d, _| convex_concave_step(objective, knots, limits, &d, &mut rows_mm))
}

/// Number of steps of the convex-concave procedure from a feed beyond the limits; the feed changes by less than 1e-3 of
/// itself after five. Larger: more time. Smaller: the feed depends on its start.
const STEPS_TO_SETTLE: usize = 6;

/// Adds constants to all control values `d` until the acceleration is within the limit. The first constant is 1e-3 of
/// the smallest control value; every further one is twice the one before.
fn slowed(knots: &Knots, mut d: Vec<f64>, limit: f64) -> Vec<f64> {
    let mut more = 1e-3 * d.iter().copied().fold(f64::INFINITY, f64::min);
    while highest_peak(knots, &d).acceleration_mm_per_s2 > ACCEPTED * limit {
        d.iter_mut().for_each(|d| *d += more);
        more *= 2.0;
    }
    d
}

/// Solves (1) of the module by knot removal. Returns the control values on `knots`, and the knots that are left; `None`
/// if the limit is exceeded without an interior knot.
///
/// # Errors
/// Returns the failure of the quadratic program.
pub fn knot_removal(
    objective: &Quadratic,
    knots: &Knots,
    limits: FeedLimits,
) -> Result<Option<(Vec<f64>, Knots)>, String> {
    let mut left = knots.clone();
    loop {
        let k = left.refinement(knots);
        let coarser = objective.of_coarser(&k);
        let c = quadratic_program(&coarser, limits.min_density_s_per_mm, &[])?;
        let peak = highest_peak(&left, &c);
        if peak.acceleration_mm_per_s2 <= ACCEPTED * limits.max_acceleration_mm_per_s2 {
            return Ok(Some((k.dot(&ArrayView1::from(&c)).to_vec(), left)));
        }
        let breaks = left.breaks();
        let inner = 1..breaks.len() - 1;
        let closest = inner.min_by(|a, b| {
            let [a, b] = [a, b].map(|i| (breaks[*i] - peak.s_mm).abs());
            a.total_cmp(&b)
        });
        let Some(closest) = closest else {
            return Ok(None);
        };
        left = left.without(closest);
    }
}

/// Pair of constraints `sum_j coefficient_j d_(first + j) <= bound`, one for each sign of the acceleration.
pub(crate) struct TangentRow {
    pub(crate) first: usize,
    pub(crate) coefficient: [[f64; 4]; 2],
    pub(crate) bound: f64,
}

/// Returns the constraints (2) of the module at the arc length `s`, divided by 3 A D_k^2: +-D'/(3 A D_k^2) - D <= -2/3
/// D_k.
pub(crate) fn tangent(knots: &Knots, current: &[f64], s: f64, limit: f64) -> TangentRow {
    let (first, b) = knots.basis(s);
    let (_, slope) = knots.basis_derivative(s);
    let now = knots.value(current, s);
    let w = 1.0 / (3.0 * limit * now * now);
    let coefficient = [1.0, -1.0].map(|sign| [0, 1, 2, 3].map(|j| sign * w * slope[j] - b[j]));
    TangentRow { first, coefficient, bound: -2.0 / 3.0 * now }
}

/// Minimises the objective under `d >= least` and the constraints `rows`, and returns `d`. Fails with the status of the
/// solver, or if the diagonal of P has no positive element.
fn quadratic_program(
    objective: &Quadratic,
    least: f64,
    rows: &[TangentRow],
) -> Result<Vec<f64>, String> {
    let n = objective.q.len();
    let strongest = (0..n).map(|i| objective.p[[i, i]]).fold(0.0, f64::max);
    if strongest <= 0.0 {
        return Err("an objective without curvature".into());
    }
    // The size of the solution, and the value of the objective there.
    let aim = objective.q.iter().map(|q| q.abs()).fold(0.0, f64::max) / strongest;
    let scale = aim.max(least);

    let mut pr = Vec::new();
    let mut pc = Vec::new();
    let mut pv = Vec::new();
    for c in 0..n {
        for r in 0..=c {
            let v = objective.p[[r, c]];
            if v != 0.0 {
                pr.push(r);
                pc.push(c);
                pv.push(v / strongest);
            }
        }
    }
    let q: Vec<f64> = objective.q.iter().map(|q| -q / (strongest * scale)).collect();
    let mut ar = Vec::new();
    let mut ac = Vec::new();
    let mut av = Vec::new();
    let mut b = Vec::new();
    for i in 0..n {
        // -d_i <= -least
        ar.push(i);
        ac.push(i);
        av.push(-1.0);
        b.push(-least / scale);
    }
    for row in rows {
        for coefficient in row.coefficient {
            for (j, v) in coefficient.iter().enumerate() {
                ar.push(b.len());
                ac.push(row.first + j);
                av.push(*v);
            }
            b.push(row.bound / scale);
        }
    }
    let p = CscMatrix::new_from_triplets(n, n, pr, pc, pv);
    let a = CscMatrix::new_from_triplets(b.len(), n, ar, ac, av);
    let settings = DefaultSettingsBuilder::default()
        .verbose(false)
        .max_iter(200)
        .max_threads(1)
        .build()
        .expect("the settings are valid");
    let cones = [NonnegativeConeT(b.len())];
    let mut solver = DefaultSolver::new(&p, &q, &a, &b, &cones, settings)
        .map_err(|e| format!("the error {e:?}"))?;
    solver.solve();
    match solver.solution.status {
        SolverStatus::Solved | SolverStatus::AlmostSolved => {
            // The bound holds to the tolerance of the solver; then exactly.
            Ok(solver.solution.x.iter().map(|x| (x * scale).max(least)).collect())
        }
        status => Err(format!("{status:?}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns half of the squared distance to the control values `wanted`, as a quadratic objective.
    fn towards(wanted: &[f64]) -> Quadratic {
        Quadratic { p: Array2::eye(wanted.len()), q: wanted.to_vec() }
    }

    fn wave(n: usize) -> Vec<f64> {
        (0..n).map(|i| 0.5 + 0.45 * (1.7 * i as f64).sin()).collect()
    }

    const LIMITS: FeedLimits =
        FeedLimits { min_density_s_per_mm: 0.1, max_acceleration_mm_per_s2: 3.0 };

    #[test]
    fn without_a_need_for_acceleration_it_is_the_bounded_minimum() {
        let knots = Knots::uniform(10.0, 12);
        let wanted: Vec<f64> = (0..knots.len()).map(|i| if i == 4 { -1.0 } else { 1.0 }).collect();
        let limits = FeedLimits { max_acceleration_mm_per_s2: 1e9, ..LIMITS };
        let d =
            convex_concave_step(&towards(&wanted), &knots, limits, &wave(15), &mut vec![]).unwrap();
        for (i, d) in d.iter().enumerate() {
            // The tolerance of the interior point method.
            assert!((d - if i == 4 { 0.1 } else { 1.0 }).abs() < 1e-6, "{i} {d}");
        }
    }

    #[test]
    fn every_step_is_feasible_and_no_worse() {
        let knots = Knots::uniform(10.0, 12);
        let objective = towards(&wave(knots.len()));
        let (mut d, mut rows) = (vec![1.0; knots.len()], Vec::new());
        let mut before = objective.value(&d);
        for step in 0..10 {
            d = convex_concave_step(&objective, &knots, LIMITS, &d, &mut rows).unwrap();
            let a = (0..=10_000)
                .map(|k| acceleration(&knots, &d, 1e-3 * f64::from(k)))
                .fold(0.0, f64::max);
            assert!(a <= LIMITS.max_acceleration_mm_per_s2, "step {step}: {a}");
            // At the limit in the end: the problem is one that needs it. A step lowers D to no less
            // than 2/3 of what it was where (2) counts.
            assert!(step < 7 || a > 0.99 * LIMITS.max_acceleration_mm_per_s2, "{a}");
            let now = objective.value(&d);
            // ASKED instead of ACCEPTED when the step before used the gap.
            assert!(now <= before + 1e-3 * before.abs(), "step {step}: {now} after {before}");
            before = now;
        }
    }

    #[test]
    fn the_procedure_beats_knot_removal() {
        let knots = Knots::uniform(10.0, 12);
        let objective = towards(&wave(knots.len()));
        let (removed, kept) =
            knot_removal(&objective, &knots, LIMITS).unwrap().expect("it can be kept");
        assert!(kept.len() < knots.len());
        assert!(highest_peak(&knots, &removed).acceleration_mm_per_s2 <= 3.0);
        let (mut d, mut rows) = (vec![1.0; knots.len()], Vec::new());
        for _ in 0..10 {
            d = convex_concave_step(&objective, &knots, LIMITS, &d, &mut rows).unwrap();
        }
        assert!(objective.value(&d) < objective.value(&removed));
    }

    #[test]
    fn peaks_are_those_of_a_dense_search() {
        let knots = Knots::uniform(10.0, 12);
        let d = wave(knots.len());
        let dense = (0..=1_000_000)
            .map(|k| acceleration(&knots, &d, 1e-5 * f64::from(k)))
            .fold(0.0, f64::max);
        let found = highest_peak(&knots, &d).acceleration_mm_per_s2;
        // A dense search misses a peak by half the curvature times (5e-6 mm)^2: 1e-9 of it. Regression bound: 1e-16 was
        // seen.
        assert!((found / dense - 1.0).abs() < 1e-6, "{found} {dense}");
    }

    #[test]
    fn what_no_row_mends_a_slower_feed_does() {
        let knots = Knots::uniform(10.0, 12);
        let d = slowed(&knots, wave(knots.len()), 1e-3);
        assert!(highest_peak(&knots, &d).acceleration_mm_per_s2 <= 1e-3);
    }
}
