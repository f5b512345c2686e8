//! The dwell times that leave the smallest residual, within bounds.
//!
//! ```text
//! min over lo <= t <= hi, and a free piston c:
//!   1/2 sum_i w_i (z_i - c - (B t)_i)^2
//!   + 1/2 alpha K A sum_j (t_j - lo_j)^2 / a_j
//!   + 1/2 beta K A^2 sum_k p m_k ((r_k - r_{k-1}) / m_k)^2,     r_k = t_k / a_k            (1)
//!   + lambda sum_i w_i sum_j t_j
//!   + 1/2 t' Q t
//!   + 1/2 (z - c - B t)' S (z - c - B t)
//! ```
//!
//! `w` are the weights of the pixels (0 where the map is invalid). `K` is the diagonal element of `B' W B - U U'` of
//! (2) for the column at which it is largest. If B is applied by FFT, an estimate of the diagonal finds the column, and
//! the element itself is exact. `A` is the effective area of the TIF (at least that of 36 dwell points). `p` is the
//! distance of neighbouring lines of the path, `l_k` the length of segment k, and `m_k` the distance between the
//! middles of segments k - 1 and k. `a_k = p l_k` is the area of dwell point k, and `r` the dwell time per area.
//!
//! `alpha` decides the dwell times that the map does not decide (outside the clear aperture). `beta` keeps neighbours
//! alike, so that a machine can execute them. `lambda` is the weight of one second in half the mean square of the
//! residual. Q, if the problem ([`Program`]) has one, is any symmetric positive semidefinite matrix, for example of the
//! scatter that the process adds; only its products are needed. S, if it is asked for, weighs the slope of the residual
//! ([`crate::residual_slope`]).
//!
//! A plane may be free in place of the piston. The free functions are implicit: with functions `f` orthonormal under
//! the weights and `U = B' W f`, (1) is t' H t / 2 - g' t and a constant, with
//!
//! ```text
//! H = B' W B - U U' + L + Q + B' P' S P B,     L the matrix of the terms with alpha and beta (2)
//! g_j = (B' W P z + B' P' S P z)_j + alpha K A lo_j / a_j - lambda sum_i w_i
//! ```
//!
//! P subtracts the component of a map in f. With S and a free plane, the plane is the one that (1) has without S.
//!
//! **Huber loss.** For maps with pits, a loss that is linear beyond the threshold `k` may replace the first square of
//! (1), with the residual `e = P (z - B t)`:
//!
//! ```text
//! sum_i w_i rho(e_i),   rho(e) = e^2 / 2 up to |e| = k,   k |e| - k^2 / 2 beyond it               (3)
//! v_i = w_i min(1, k / |e_i|)                        so that v_i e_i = w_i rho'(e_i)              (4)
//! ```
//!
//! Every step minimises (1) with the weights v of the residual before it in place of w (iteratively reweighted least
//! squares). v also takes the place of w in P, but not in K, A, p and lambda sum w. The gap and the objective are those
//! of (1) with the weights v at the last step. Where the free part of a residual is the same under v and under the v
//! before, (1) has the gradient of (3) at t. The gap then bounds the distance from the least (3), too, because its
//! proof needs no more than that gradient, the convexity, and the Tikhonov term (`certificate`).
//!
//! Source of the loss: P. J. Huber, Ann. Math. Stat. 35 (1964) 73; of (4): P. W. Holland and R. E. Welsch, Commun.
//! Stat. A 6 (1977) 813.
//!
//! **Weights that mean the same at every pitch and pixel.** The two sums of squares are integrals over the part, `alpha
//! K A int (r - lo)^2` and `beta K A^2 int (dr/ds)^2`. K grows with the number of pixels as the first term does. So
//! with closer lines, points or pixels the minimum tends to that of one continuous problem. In units of the size of the
//! TIF, a small tool on a small part has the same minimum. If lines and points are so far apart that the area of the
//! TIF has less than 36 points, neighbours have the weights of 36, because a machine has to move from point to point.
//!
//! H is never made. Steps come from a cheap surrogate H~ of it without Q and S (`surrogate`), and each is corrected by
//! the gradient of (1) itself, which also certifies the result. H~ on cells of pixels is minimised by the primal-dual
//! active set method, with a skyline Cholesky factorisation. For many points, it is applied by FFT and minimised by
//! conjugate gradients with a spline lattice, after easier problems. If no lattice suits the problem, by projected
//! gradient steps. B is applied by FFT, which is exact if the TIF has the pitch of the map. Otherwise its columns are
//! stored, unless they are too many. Columns whose effect on the map is below 1e-9 of the largest stay at their lower
//! bound in (1). In the result they have the density of their neighbours (`continuation`), which removes less than 1e-4
//! of a column there.
//!
//! Source: the bounded least squares of constrained dwell-time optimisation, e.g. T. Wang et al.,
//! Opt. Express 29 (2021) 38737, with the free piston, the density smoothness and the certificate.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `desired` | (ny, nx) | nm |
//! | w | `weight` | (ny, nx) | 1 |
//! | B | [`crate::columns`] | (pixels, n) | nm/s |
//! | t, lo, hi | `dwell_s`, bounds | (n) | s |
//!
//! | module | what it holds |
//! |---|---|
//! | `settings` | how to solve, and the columns and bounds of a problem |
//! | `several` | several tools in one problem |
//! | `setup` | set-up errors of several tools: reserves, and the expected square of what no map shows |
//! | `choice` | the subset of a rack of tools that costs least |
//! | `prepared` | (1) and (2) with everything that is computed once |
//! | `minimise` | the steps, and the robust weights |
//! | `weighted` | (1) itself, its gradient, and its least value along steps |
//! | `certificate` | the upper bound of the distance of the objective from its minimum |
//! | `unbounded` | steps of the two-level method that make that bound small |
//! | `discrepancy` | the choice of the smoothness by the noise |
//! | `report` | the result in numbers |

mod certificate;
mod choice;
mod descent;
mod discrepancy;
mod minimise;
mod prepared;
mod report;
mod settings;
mod setup;
mod several;
mod unbounded;
mod weighted;

use ndarray::Array2;
use planish_types::{
    DwellTime, Invalid, OnLattice, PARTS_TOLERANCE, Surface, Tif, TimeFactor, ToolPath, Variation,
};

use crate::{
    DwellError,
    bounds::{self, pixel_weights},
    columns::ToolPlace,
};
pub use crate::{
    bounds::{Bound, noise_of_deviations},
    objective::Free,
};
pub use choice::{RackTool, SolvedSubset, ToolChoice, choose_tools};
use prepared::BoundedProblem;
use report::SAME_TIME_FACTOR;
pub use report::{Algorithm, BoundedReport, BoundedSolution, RatesOfTime};
use settings::ToolColumns;
pub use settings::{BoundedSettings, Product, Program, ToolTask};
pub use several::{
    ExecutedPlan, KeptPlan, SetupDraw, SeveralSolution, execute_with_errors, solve_keeping,
    solve_several,
};

/// Finds the dwell times that minimise the objective (1) of the module for the desired removal along `path`, within
/// the bounds of the settings.
///
/// `weight` (ny, nx) >= 0 weighs the pixels. Without it the weights follow from the standard deviations of the map, if
/// it has any; otherwise every valid pixel counts 1.
///
/// # Errors
/// Refuses inputs that [`solve_within`] or [`bounds()`] refuses.
pub fn solve(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    weight: Option<&Array2<f64>>,
    settings: &BoundedSettings,
) -> Result<BoundedSolution, DwellError> {
    solve_within(desired, tif, path, weight, settings, bounds(path, settings)?)
}

/// Finds the dwell times that minimise the objective (1) of the module for the desired removal along `path`, within
/// these bounds (n), s.
///
/// If the rate of the tool depends on the time of the run, the problem is solved in rounds. Each round uses the rates
/// at the times of the run that follow from the dwell times of the round before. The rounds end if the rates no longer
/// change, or after 12.
///
/// # Errors
/// Refuses weights, settings and bounds that are not in their range, a TIF that cannot be sampled on the lattice of the
/// map or covers too many pixels, and a tool that does not reach the map. Fails if the surrogate of H is singular in
/// every form.
pub fn solve_within(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    weight: Option<&Array2<f64>>,
    settings: &BoundedSettings,
    (lo, hi): (Vec<f64>, Vec<f64>),
) -> Result<BoundedSolution, DwellError> {
    let tif = &*tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?.tif;
    let columns = settings.columns.places(path, tif);
    let first = program(&columns, (&lo, &hi), None);
    let solution = solve_columns(desired, tif, path, weight, settings, &first)?;
    let Some(time) = tif.variation().and_then(Variation::time_factor) else { return Ok(solution) };

    // What the dwell times remove, as times at the factor 1, changes little from round to round.
    let mut effective_s = solution.dwell.dwell_s().to_vec();
    let mut rounds = 1;
    loop {
        let guess = times_of_effective(time, &effective_s);
        let factors = time_factors(time, &guess);
        let pairs = columns.iter().zip(&factors);
        let with_rates: Vec<Vec<ToolPlace>> =
            pairs.map(|(p, factor)| at_rate(p, *factor)).collect();
        let program = program(&with_rates, (&lo, &hi), Some(guess));
        let mut solution = solve_columns(desired, tif, path, weight, settings, &program)?;
        rounds += 1;
        let dwell_s = solution.dwell.dwell_s();
        let rates = time_factors(time, dwell_s);
        let change = rates.iter().zip(&factors).map(|(a, b)| (a / b - 1.0).abs());
        let rate_error = change.fold(0.0, f64::max);
        effective_s = dwell_s.iter().zip(&factors).map(|(t, factor)| t * factor).collect();
        if rate_error <= SAME_TIME_FACTOR || rounds == MAX_ROUNDS_OF_TIMES {
            // The times that remove just that at the rates of their own times.
            let times = times_of_effective(time, &effective_s);
            let within =
                times.iter().zip(lo.iter().zip(&hi)).map(|(t, (lo, hi))| t.clamp(*lo, *hi));
            solution.dwell = DwellTime::new(within.collect())?;
            solution.report.total_time_s = solution.dwell.dwell_s().iter().sum();
            solution.report.rates_of_time = Some(RatesOfTime { rounds, rate_error });
            return Ok(solution);
        }
    }
}

/// Returns the input (columns, bounds and first guess) for the places of the tool in each column, with bounds (n),
/// s.
fn program<'a>(
    places: &'a [Vec<ToolPlace>],
    (lo, hi): (&[f64], &[f64]),
    guess: Option<Vec<f64>>,
) -> Program<'a> {
    Program { places, lo: lo.to_vec(), hi: hi.to_vec(), guess, quadratic: None }
}

/// Largest number of rounds for a tool whose rate depends on the time of the run. The first solution removes nearly as
/// much as the last one, so that few rounds are enough. Larger: more time. Smaller: more plans are reported as not
/// converged.
const MAX_ROUNDS_OF_TIMES: usize = 12;

/// Returns the mean of the rate factor c(t) over each dwell time (n). The dwell times, s, follow each other from the
/// start of the run.
fn time_factors(time: &TimeFactor, dwell_s: &[f64]) -> Vec<f64> {
    let mut start_s = 0.0;
    let mut factors = Vec::with_capacity(dwell_s.len());
    for t in dwell_s {
        factors.push(time.mean(start_s, start_s + t));
        start_s += t;
    }
    factors
}

/// Returns the dwell times (n), s, that remove as much as the dwell times `effective_s` would at a rate factor of 1.
/// They follow each other from the start of the run.
fn times_of_effective(time: &TimeFactor, effective_s: &[f64]) -> Vec<f64> {
    let mut start_s = 0.0;
    let mut dwell_s = Vec::with_capacity(effective_s.len());
    for effective_s in effective_s {
        let t = time.duration_s(start_s, *effective_s);
        dwell_s.push(t);
        start_s += t;
    }
    dwell_s
}

/// Returns the places with their fractions multiplied by the factor of the rate.
fn at_rate(places: &[ToolPlace], factor: f64) -> Vec<ToolPlace> {
    places.iter().map(|p| ToolPlace { fraction: factor * p.fraction, ..*p }).collect()
}

/// Finds the dwell times that minimise (1) of the module with the columns and bounds of `program`. The fractions of
/// its places include the factors of a rate that depends on the time of the run.
///
/// # Errors
/// Refuses what [`solve_within`] refuses, and a `program` that does not have one column, bound and guess for every
/// dwell point.
pub fn solve_columns(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    weight: Option<&Array2<f64>>,
    settings: &BoundedSettings,
    program: &Program<'_>,
) -> Result<BoundedSolution, DwellError> {
    let OnLattice { tif, lattice } = tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?;
    let tif = &*tif;
    let weight = pixel_weights(desired, weight)?;
    settings.check()?;
    let Program { places, lo, hi, guess, .. } = program;
    let guess_len = guess.as_ref().map_or(path.len(), Vec::len);
    let lengths =
        [("places", places.len()), ("lo", lo.len()), ("hi", hi.len()), ("guess", guess_len)];
    for (name, len) in lengths {
        if len != path.len() {
            let problem = format!("has {len} elements for {} dwell points", path.len());
            return Err(Invalid::whole(name, problem, "give one per dwell point").into());
        }
    }
    if let Some(j) = (0..lo.len()).find(|j| lo[*j] > hi[*j]) {
        let problem = format!("is {} s, below the lower bound of {} s", hi[j], lo[j]);
        return Err(Invalid::at_index("max_dwell", j, problem, "give a larger upper bound").into());
    }

    let tool = ToolColumns {
        name: "",
        tif,
        path,
        columns: 0..path.len(),
        time_weight_nm2_per_s: settings.time_weight_nm2_per_s,
    };
    let mut problem = BoundedProblem::new(desired, &[tool], program, weight, settings)?;
    let mut solution = discrepancy::solve(&mut problem)?;
    solution.report.tif_lattice = lattice.if_anew();
    Ok(solution)
}

/// Returns the lower and the upper bound of every dwell point (n), s, by the settings.
///
/// # Errors
/// Refuses bounds that are negative or not finite, and a lower bound above 1e7 s.
pub fn bounds(
    path: &ToolPath,
    settings: &BoundedSettings,
) -> Result<(Vec<f64>, Vec<f64>), Invalid> {
    Ok((bounds::lower(path, settings.min_dwell)?, bounds::upper(path, settings.max_dwell)?))
}
