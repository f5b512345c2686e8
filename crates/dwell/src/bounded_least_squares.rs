//! The dwell times that leave the smallest residual, within bounds.
//!
//! ```text
//! min over lo <= t <= hi, and a free piston c:
//!   1/2 sum_i w_i (z_i - c - (B t)_i)^2
//!   + 1/2 alpha D A sum_j (t_j - lo_j)^2 / a_j
//!   + 1/2 beta D A^2 sum_k p m_k ((r_k - r_{k-1}) / m_k)^2,     r_k = t_k / a_k            (1)
//!   + lambda sum_i w_i sum_j t_j
//!   + 1/2 t' Q t
//!   + 1/2 (z - c - B t)' S (z - c - B t)
//! ```
//!
//! `w` are the weights of the pixels (0 where the map is invalid). `D` is the largest diagonal element of `B' W B`,
//! and `A` the effective area of the TIF (at least that of 36 dwell points). `p` is the distance of neighbouring
//! lines of the path, `l_k` the length of segment k, and `m_k` the distance between the middles of segments k - 1 and
//! k. `a_k = p l_k` is the area of dwell point k, and `r` the dwell time per area.
//!
//! `alpha` decides the dwell times that the map does not decide (outside the clear aperture). `beta` keeps neighbours
//! alike, so that a machine can execute them. `lambda` is the weight of a second in half a mean square. Q, if a
//! program has one, is any symmetric positive semidefinite matrix, of which only products are needed: the scatter
//! that a process adds. S, if it is asked for, weighs the slope of the residual ([`crate::residual_slope`]).
//!
//! A plane may be free in place of the piston. A Huber loss may replace the square; it counts residuals above `k`
//! linearly, for maps with pits. The free functions are implicit: with functions `f` orthonormal under the weights
//! and `U = B' W f`,
//!
//! ```text
//! H = B' W B - U U' + L + Q + B' P' S P B,     L the matrix of the terms with alpha and beta (2)
//! g = B' W (z - its component in f) + alpha D A lo_j / a_j
//! ```
//!
//! P takes the component in f away. With S and a free plane, the plane is the one that (1) has without S.
//!
//! **Weights that mean the same at every pitch and pixel.** The two sums of squares are integrals over the part,
//! `alpha D A int (r - lo)^2` and `beta D A^2 int (dr/ds)^2`. D grows with the number of pixels as the first term
//! does. So with closer lines, points or pixels the minimum tends to that of one continuous problem. In units of the
//! size of the TIF, a small tool on a small part has the same minimum. If lines and points are so far apart that the
//! TIF has less than 36 of them, neighbours have the weights of 36: a machine executes a motion from point to point.
//!
//! H is never made. Steps come from a cheap surrogate H~ of it without Q and S (`surrogate`), and each is corrected by the
//! gradient of (1) itself, which also certifies the result. H~ has cells of pixels and the primal-dual active set
//! method, with a skyline Cholesky factorisation. For many points it has the FFT and conjugate gradients with a
//! spline lattice, after easier problems. If the lattice would be too large, it has projected gradient steps. B is
//! applied by FFT, which is exact if the TIF has the pitch of the map. Otherwise its columns are stored, unless they
//! are too many.
//! Columns whose effect on the map is below 1e-9 of the largest stay at their lower bound in (1). In the result they
//! have the density of their neighbours (`continuation`), which removes less than 1e-4 of a column there.
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
//! | `settings` | how to solve, and the columns and bounds of a program |
//! | `prepared` | (1) and (2) with everything that is computed once |
//! | `minimise` | the steps, and the robust weights |
//! | `weighted` | (1) itself, its gradient, and its least value along steps |
//! | `certificate` | the bound on what is missing |
//! | `unbounded` | how the two-level method comes to that bound |
//! | `discrepancy` | the smoothness that the noise asks for |
//! | `report` | what is told of the result |

mod certificate;
mod descent;
mod discrepancy;
mod minimise;
mod prepared;
mod report;
mod settings;
mod unbounded;
mod weighted;

use ndarray::Array2;
use planish_types::{Invalid, Surface, Tif, TimeFactor, ToolPath, Variation};

use crate::{
    DwellError,
    bounds::{self, pixel_weights},
    columns::Place,
    residual_slope::ResidualSlope,
};
pub use crate::{
    bounds::{Bound, noise_of_deviations},
    objective::Free,
};
use prepared::BoundedProblem;
pub use report::{Algorithm, BoundedSolution, Report};
pub use settings::{Product, Program, Settings};

/// Solves (1) for `desired` along `path`.
///
/// `weight` (ny, nx) >= 0 weighs the pixels; without it every valid pixel counts 1.
pub fn solve(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    weight: Option<&Array2<f64>>,
    settings: &Settings,
) -> Result<BoundedSolution, DwellError> {
    let (lo, hi) = bounds(path, settings)?;
    let columns = settings.columns.places(path, tif);
    let at = |places: &[Vec<Place>], guess: Option<Vec<f64>>| {
        let (lo, hi) = (lo.clone(), hi.clone());
        let program = Program { places, lo, hi, guess, quadratic: None };
        solve_columns(desired, tif, path, weight, settings, &program)
    };
    let mut solution = at(&columns, None)?;
    let Some(time) = tif.variation().and_then(Variation::time_factor) else { return Ok(solution) };
    let mut before = vec![1.0; path.len()];
    for _ in 0..MAX_ROUNDS_OF_TIMES {
        let factors = time_factors(time, solution.dwell.dwell_s());
        let change = factors.iter().zip(&before).map(|(a, b)| (a / b - 1.0).abs());
        if change.fold(0.0, f64::max) <= SAME_TIME_FACTOR {
            break;
        }
        let of = |(places, factor): (&Vec<Place>, &f64)| -> Vec<Place> {
            places.iter().map(|p| Place { fraction: factor * p.fraction, ..*p }).collect()
        };
        let places: Vec<Vec<Place>> = columns.iter().zip(&factors).map(of).collect();
        solution = at(&places, Some(solution.dwell.dwell_s().to_vec()))?;
        before = factors;
    }
    Ok(solution)
}

/// Largest number of times that a tool whose rate depends on the time of the run is solved for. The times of a round
/// are those of the solution before, which converges by the relative change of the rate in each round. Larger: more
/// time. Smaller: tools that wear fast are solved for with the rates of other times.
const MAX_ROUNDS_OF_TIMES: usize = 8;

/// Relative change of a rate from one round to the next up to which it is the same. Larger: dwell times for rates that
/// are wrong by it. Smaller: more rounds.
const SAME_TIME_FACTOR: f64 = 1e-5;

/// Mean factor of the time over each of some dwell times (n), s, one after the other from the start of the run.
fn time_factors(time: &TimeFactor, dwell_s: &[f64]) -> Vec<f64> {
    let mut start_s = 0.0;
    let of = |t: &f64| {
        let from = start_s;
        start_s += t;
        time.mean(from, start_s)
    };
    dwell_s.iter().map(of).collect()
}

/// [`solve`] with given columns and bounds in place of those of the settings.
pub fn solve_columns(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    weight: Option<&Array2<f64>>,
    settings: &Settings,
    program: &Program<'_>,
) -> Result<BoundedSolution, DwellError> {
    let tif = &*tif.without_zero_margins();
    let weight = pixel_weights(desired, weight)?;
    let weights = [
        ("tikhonov", settings.tikhonov),
        ("slope_weight", settings.slope_weight),
        ("time_weight_nm2_per_s", settings.time_weight_nm2_per_s),
    ];
    for (name, value) in weights {
        if !(value.is_finite() && value >= 0.0) {
            return Err(Invalid::whole(name, format!("is {value}"), "give a number >= 0").into());
        }
    }
    for (name, value) in [("huber_nm", settings.huber_nm), ("noise_rms_nm", settings.noise_rms_nm)]
    {
        if let Some(value) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
            return Err(Invalid::whole(name, format!("is {value}"), "give a number > 0").into());
        }
    }
    settings.residual_slope.iter().try_for_each(ResidualSlope::check)?;
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
        return Err(Invalid::at("max_dwell", j, problem, "give a larger upper bound").into());
    }

    let problem = BoundedProblem::new(desired, tif, path, program, weight, settings)?;
    discrepancy::solve(problem)
}

/// Lower and upper bound of every dwell point (n), s, by the settings.
pub fn bounds(path: &ToolPath, settings: &Settings) -> Result<(Vec<f64>, Vec<f64>), Invalid> {
    Ok((bounds::lower(path, settings.min_dwell)?, bounds::upper(path, settings.max_dwell)?))
}
