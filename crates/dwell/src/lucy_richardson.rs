//! Lucy-Richardson deconvolution with total-variation smoothing.
//!
//! ```text
//! E = max(z - B lo - low, 0) + c                           positive on the aperture            (1)
//! t <- t / (1 - mu kappa) * (B' (w E / B t)) / (B' w)      kappa = div(grad t / |grad t|)      (2)
//! ```
//!
//! `low` is the lowest height except for a given fraction of the pixels; otherwise one pit would decide the removal
//! everywhere. The multiplicative step maximises the likelihood `sum w (E ln m - m)`, m = B t, of a Poisson process,
//! which here serves to keep t positive. Without smoothing the likelihood never falls, and after every step the removed
//! volume is the desired one.
//!
//! `B' w` in place of the volume of the TIF is the only treatment of the boundary. A dwell point near it counts by the
//! pixels that it reaches, so the map needs no extension. Dwell points whose `B' w` is at most 2 % of the largest are
//! no unknowns. They get the density of their neighbours in every step, so that their removal is counted.
//!
//! The unknowns are the dwell times of the path, with smoothness of the density along the path. Or they are a map of
//! dwell times on the pixels, as in the source, with smoothness in two dimensions. The map is then transferred to the
//! path (`dwell_map.rs`).
//!
//! If the TIF is many pixels wide, a map of dwell times needs no detail at the scale of a pixel: on large maps it is
//! solved on squares of pixels (`coarse.rs`). The steps then compare means over the squares; the residual of the result
//! is computed on all pixels.
//!
//! Accelerated, a step starts from a point extrapolated along the last two,
//!
//! ```text
//! y = max(x_k + a (x_k - x_{k-1}), 0),   x_{k+1} = (2) of y,   g_k = x_{k+1} - y
//! a = g_{k-1}' g_{k-2} / g_{k-2}' g_{k-2},   0 <= a <= 1                                   (3)
//! ```
//!
//! which has the same fixed points, reaches the same likelihood in several times fewer steps, and
//! need not raise it in every one (D. Biggs and M. Andrews, Appl. Opt. 36 (1997) 1766, Eqs 4-9).
//!
//! The steps end when ten of them lower the RMS of the residual by less than a given fraction.
//!
//! Source: trigonometric-spline scheduling, Opt. Express 32 (2024) 9255, Eq. 2, with the curvature in
//! place of the printed Laplacian over gradient (N. Dey et al., Microsc. Res. Tech. 69 (2006) 260),
//! and `B' w` in place of the integral of R.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | E | `e` | (ny, nx) | nm |
//! | t | `t` | (n) or lattice | s |
//! | mu | `total_variation` | - | 1 |
//! | lo | `min_dwell` | (n) | s |

use ndarray::{Array2, ArrayView2, Zip};
use planish_numerics::{linear::skyline::dot, parallel};
use planish_types::{Axis, End, Invalid, Surface, Tif, progress};

use serde::Serialize;

use crate::{
    DwellError,
    coarse::{self, CoarseMap, MAX_SQUARE_PIXELS},
    continuation::Continuation,
    dwell_map::{NodeOwners, Spread},
    problem::{DwellModel, Problem, Solution, check, check_steps},
};

/// Unknowns of the solver.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Unknowns {
    /// The dwell times of the path.
    Path,
    /// A map of dwell times, which then goes to the path.
    Map,
}

/// Settings of the Lucy-Richardson deconvolution.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LucyRichardsonSettings {
    /// Quantities that are solved for: dwell times of the path, or a map of dwell times.
    pub unknowns: Unknowns,
    /// Weight mu of the total variation, dimensionless; >= 0, useful up to 0.02.
    pub total_variation: f64,
    /// Removal c that is added everywhere, (1) of the module, as a fraction of the range of the desired removal from
    /// `low` to its maximum; > 0.
    pub margin: f64,
    /// Fraction of the pixels, the lowest ones, that lie below `low` of (1) of the module; in [0, 1).
    pub pits: f64,
    /// Relative decrease of the RMS over ten steps below which the solver ends; with 0 it does all steps, unless the
    /// RMS rises.
    pub min_decrease: f64,
    /// Largest number of steps.
    pub max_iterations: usize,
    /// True if stopping after `max_iterations` steps is intended, and not to be reported as a failure. More steps fit
    /// more noise, so that a limited number of steps can be a choice.
    pub stop_at_max: bool,
    /// True if steps start from extrapolated points, (3) of the module.
    pub accelerated: bool,
    /// Side of the squares on which a map of dwell times is solved, pixels, from 1 to 64. Default: 1 for maps below a
    /// million pixels, and for larger maps the largest side that the steepest slope of the TIF allows.
    pub pixels_per_cell: Option<usize>,
}

impl Default for LucyRichardsonSettings {
    fn default() -> Self {
        Self {
            unknowns: Unknowns::Path,
            total_variation: 1e-3,
            margin: 0.02,
            pits: 1e-3,
            min_decrease: 1e-3,
            max_iterations: 300,
            stop_at_max: false,
            accelerated: false,
            pixels_per_cell: None,
        }
    }
}

/// Report of the Lucy-Richardson deconvolution.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LucyRichardsonReport {
    /// Reason for the end: `settled` (the RMS changes no more), `iteration-limit`, or `steps-done` if all steps were
    /// done and the settings say that this is intended.
    pub end: End,
    /// Number of steps.
    pub iterations: usize,
    /// Log-likelihood sum w (E ln m - m) over the pixels, with the weights w, the positive desired removal E and the
    /// removal m, before the first step and after each.
    pub log_likelihood: Vec<f64>,
    /// RMS of the difference E - m of desired and actual removal (mean removed), before the first step and after each,
    /// nm.
    pub rms_nm: Vec<f64>,
    /// Number of unknowns that are solved for: those whose sensitivity `B' w` is above 2 % of the largest.
    pub active: usize,
    /// Number of negative samples of the TIF that were taken as zero.
    pub clipped_tif_samples: usize,
    /// Side of the squares of pixels on which a map of dwell times was solved. Likelihood and RMS above are those of
    /// the means over the squares.
    pub pixels_per_cell: usize,
}

impl LucyRichardsonReport {
    /// Returns the reason of a negative verdict; none if the end is the one that the settings ask for.
    pub fn negative(&self, settings: &LucyRichardsonSettings) -> Option<String> {
        if self.end != End::IterationLimit {
            return None;
        }
        Some(format!(
            "not settled: after {} steps ten more still lower the RMS by more than {} of it; give \
             `accelerated`, a larger `min_decrease`, or `max_iterations` to stop there on purpose",
            self.iterations, settings.min_decrease
        ))
    }
}

/// Sensitivity `B' w` of a dwell point or node, as a fraction of the largest, up to which its time is continued from
/// its neighbours. Larger: fewer dwell points at the rim are solved for. Smaller: dwell times at the rim, which hardly
/// change the map, may become very long.
const MIN_SENSITIVITY_FRACTION: f64 = 0.02;

/// Upper limit of a dwell time, as a multiple of the mean over the unknowns. Larger: dwell times at the edge of the
/// reach of the tool may grow without use. Smaller: the limit cuts dwell times that the map needs.
const MAX_TIME_OVER_MEAN: f64 = 20.0;

/// Maximises the likelihood by the steps (2) of the module, with the dwell times of the path or a map of dwell times
/// as unknowns.
///
/// # Errors
/// Refuses settings out of range, squares of pixels for the dwell times of a path, and a map of dwell times if the TIF
/// varies over the part. Every solver refuses weights and floors out of range, a floor that alone removes more than the
/// PV of the map, a TIF that varies in time, and a tool that does not reach the map.
pub fn solve(
    problem: &Problem<'_>,
    settings: &LucyRichardsonSettings,
) -> Result<Solution<LucyRichardsonReport>, DwellError> {
    check("total_variation", settings.total_variation, |m| m >= 0.0, "give a number >= 0")?;
    check("margin", settings.margin, |m| m > 0.0, "give a number > 0")?;
    check("pits", settings.pits, |p| (0.0..1.0).contains(&p), "give a fraction from 0 to below 1")?;
    check("min_decrease", settings.min_decrease, |t| t >= 0.0, "give a number >= 0")?;
    check_steps(settings.max_iterations)?;
    check_size(settings)?;
    let (tif, clipped_tif_samples) = without_negatives(problem.tif)?;
    let solved = &Problem { tif: &tif, ..*problem };
    let mut model = ready(solved, settings.unknowns)?;
    let e = positive_target(&model, settings);
    let (t, mut report) = match settings.unknowns {
        Unknowns::Path => on_path(&model, &e, settings),
        Unknowns::Map => on_map(&model, &e, settings)?,
    };
    drop(e);
    report.clipped_tif_samples = clipped_tif_samples;
    if clipped_tif_samples > 0 {
        // What the dwell times do is what the tool does, not the one that they were found with.
        model = ready(problem, settings.unknowns)?;
    }
    model.finish(model.lo.iter().zip(t).map(|(lo, t)| lo + t).collect(), report)
}

/// Makes the removal model that these unknowns need.
fn ready<'a>(problem: &Problem<'a>, unknowns: Unknowns) -> Result<DwellModel<'a>, DwellError> {
    match unknowns {
        Unknowns::Path => DwellModel::new(problem),
        Unknowns::Map => DwellModel::for_map(problem),
    }
}

/// Refuses squares whose side is 0 or above [`MAX_SQUARE_PIXELS`], and squares of more than one pixel if the unknowns
/// are the dwell times of the path.
fn check_size(settings: &LucyRichardsonSettings) -> Result<(), DwellError> {
    let problem = match settings.pixels_per_cell {
        Some(size) if !(1..=MAX_SQUARE_PIXELS).contains(&size) => format!("is {size}"),
        Some(size) if size > 1 && settings.unknowns == Unknowns::Path => {
            format!("is {size}, but the unknowns are those of the path")
        }
        _ => return Ok(()),
    };
    let remedy =
        format!("give a number from 1 to {MAX_SQUARE_PIXELS} with `unknowns` map, or none");
    Err(Invalid::whole("pixels_per_cell", problem, remedy).into())
}

/// Returns a TIF without negative rates, as the likelihood needs it: they become zero, and the others are scaled to the
/// same volume. Returns the number of negative rates, too. A TIF that varies stays as it is (number 0), because its
/// kernels may be negative.
fn without_negatives(tif: &Tif) -> Result<(Tif, usize), DwellError> {
    if tif.variation().is_some() {
        return Ok((tif.clone(), 0));
    }
    let negative = tif.rate_nm_per_s().iter().filter(|r| **r < 0.0).count();
    if negative == 0 {
        return Ok((tif.clone(), 0));
    }
    let positive = tif.rate_nm_per_s().mapv(|r| r.max(0.0));
    let rate = &positive * (tif.rate_nm_per_s().sum() / positive.sum());
    Ok((Tif::new(*tif.grid(), rate)?, negative))
}

/// Returns the positive desired removal E of (1) of the module, (ny, nx), nm; 0 where the weight is 0.
fn positive_target(model: &DwellModel<'_>, settings: &LucyRichardsonSettings) -> Array2<f64> {
    let mut e = model.target();
    let low = model.lowest(&e, settings.pits);
    let high = model.range(&e).1;
    // A flat map asks for the same everywhere: any positive number.
    let c = if high > low { settings.margin * (high - low) } else { 1.0 };
    Zip::from(&mut e)
        .and(&model.weight)
        .for_each(|e, w| *e = if *w > 0.0 { (*e - low).max(0.0) + c } else { 0.0 });
    e
}

/// Operators and vectors that the step (2) of the module needs for the unknowns t: dwell times of the path, or of a
/// map.
struct Unknown<'a> {
    forward: &'a dyn Fn(&[f64]) -> Array2<f64>,
    adjoint: &'a dyn Fn(&Array2<f64>) -> Vec<f64>,
    /// Curvature kappa of (2) of the module, one per unknown, from t and the mean of t over the active unknowns.
    curvature: &'a dyn Fn(&[f64], f64) -> Vec<f64>,
    /// Sensitivity `B' w` of every unknown, with the nodes or dwell points that follow it, nm/s.
    sensitivity: &'a [f64],
    active: &'a [bool],
    /// Times t of a uniform dwell time per length or area, in any unit.
    uniform: &'a [f64],
}

/// Solves for the dwell times of the path; returns them, s, and the report.
fn on_path(
    model: &DwellModel<'_>,
    e: &Array2<f64>,
    settings: &LucyRichardsonSettings,
) -> (Vec<f64>, LucyRichardsonReport) {
    let largest = model.sensitivity.iter().copied().fold(0.0, f64::max);
    let active: Vec<bool> =
        model.sensitivity.iter().map(|s| *s > MIN_SENSITIVITY_FRACTION * largest).collect();
    let beyond = Continuation::new(model.problem.path, |j| active[j]);
    let mut sensitivity = model.sensitivity.clone();
    beyond.gather(&mut sensitivity);
    let unknown = Unknown {
        forward: &|t| {
            let mut t = t.to_vec();
            beyond.apply(&mut t);
            model.operator.apply(&t)
        },
        adjoint: &|m| {
            let mut s = model.operator.adjoint(m);
            beyond.gather(&mut s);
            s
        },
        curvature: &|t, mean| curvature_along_path(t, &model.shape, &active, mean),
        sensitivity: &sensitivity,
        active: &active,
        uniform: &model.shape,
    };
    let (mut t, report) = iterate(&model.weight, e, &unknown, settings);
    beyond.apply(&mut t);
    (t, report)
}

/// Returns the curvature kappa of (2) of the module along the path (n), with the density q = t / (l_j / l), eps a
/// thousandth of the mean of t, and no difference across the border of the active points: `kappa_j = p_j - p_{j-1}`,
/// `p_j = (q_{j+1} - q_j) / sqrt((q_{j+1} - q_j)^2 + eps^2)`.
fn curvature_along_path(t: &[f64], shape: &[f64], active: &[bool], mean: f64) -> Vec<f64> {
    let mut before = 0.0;
    let mut kappa = Vec::with_capacity(t.len());
    for j in 0..t.len() {
        let p = if j + 1 >= t.len() || !(active[j] && active[j + 1]) {
            0.0
        } else {
            let d = t[j + 1] / shape[j + 1] - t[j] / shape[j];
            d / d.hypot(1e-3 * mean)
        };
        kappa.push(p - before);
        before = p;
    }
    kappa
}

/// Solves for a map of dwell times and transfers it to the path; returns the dwell times, s, and the report.
fn on_map(
    model: &DwellModel<'_>,
    e: &Array2<f64>,
    settings: &LucyRichardsonSettings,
) -> Result<(Vec<f64>, LucyRichardsonReport), DwellError> {
    let Problem { desired, tif, path, .. } = model.problem;
    let size = settings.pixels_per_cell.unwrap_or_else(|| coarse::automatic_size(tif, desired));
    // In single precision, whose error is far below what a step changes.
    let map = CoarseMap::<f32>::new(tif, desired.grid(), size)?;
    let cells = NodeOwners::new(path, map.nodes(), |p| counts(desired, &model.weight, p));
    let (e, weight) = map.restrict(e, &model.weight);
    let shape = map.shape();
    let sensitivity = map.adjoint(&weight);
    let largest = sensitivity.iter().copied().fold(0.0, f64::max);
    let owned = map.at_nodes(&cells.owned());
    let active: Vec<bool> = (sensitivity.iter().zip(&owned))
        .map(|(s, owned)| *owned && *s > MIN_SENSITIVITY_FRACTION * largest)
        .collect();
    if !active.iter().any(|a| *a) {
        return Err(DwellError::OutOfReach { points: path.len() });
    }
    let beyond = Spread::new(&owned, &active);
    let mut sensitivity = sensitivity.into_raw_vec_and_offset().0;
    beyond.gather(&mut sensitivity);
    // Differences over `size` pixels, and a curvature in cells: `size` times that in pixels.
    let step = size as f64;
    let unknown = Unknown {
        forward: &|t| {
            let mut t = t.to_vec();
            beyond.apply(&mut t);
            map.removal(ArrayView2::from_shape(shape, &t).expect("one per node"))
        },
        adjoint: &|m| {
            let mut s = map.adjoint(m).into_raw_vec_and_offset().0;
            beyond.gather(&mut s);
            s
        },
        curvature: &|t, mean| {
            let mut kappa = curvature_2d(t, &active, shape, 1e-3 * step * mean);
            if size > 1 {
                kappa.iter_mut().for_each(|k| *k /= step);
            }
            kappa
        },
        sensitivity: &sensitivity,
        active: &active,
        uniform: &vec![1.0; active.len()],
    };
    let (mut t, mut report) = iterate(&weight, &e, &unknown, settings);
    beyond.apply(&mut t);
    report.pixels_per_cell = size;
    let seconds = map.prolong(Array2::from_shape_vec(shape, t).expect("one per node"));
    let mut t = cells.to_path(&seconds, path.len());
    // Where the lattice of tool positions ends within the cell of a dwell point, its time is not all there.
    let most = model.sensitivity.iter().copied().fold(0.0, f64::max);
    Continuation::new(path, |j| model.sensitivity[j] > MIN_SENSITIVITY_FRACTION * most)
        .apply(&mut t);
    Ok((t, report))
}

/// Returns true if the pixel that contains the point `p` [x, y], mm, has a positive weight; false outside the map.
pub(crate) fn counts(desired: &Surface, weight: &Array2<f64>, p: [f64; 2]) -> bool {
    let grid = desired.grid();
    match (index_of_cell(&grid.y, p[1]), index_of_cell(&grid.x, p[0])) {
        (Some(r), Some(c)) => weight[[r, c]] > 0.0,
        _ => false,
    }
}

/// Returns the index of the pixel that contains the coordinate p, mm; `None` beyond the axis.
fn index_of_cell(axis: &Axis, p: f64) -> Option<usize> {
    let i = (p - axis.start_mm()) / axis.step_mm() + 0.5;
    if i >= 0.0 && i < axis.len() as f64 { Some(i as usize) } else { None }
}

/// Returns the curvature `div(grad t / sqrt(|grad t|^2 + eps^2))` of a map t (ny, nx), by forward differences, and
/// backward ones of their result. No difference is taken across the border of the active nodes.
fn curvature_2d(t: &[f64], active: &[bool], (ny, nx): (usize, usize), eps: f64) -> Vec<f64> {
    let mut normal = vec![[0.0; 2]; t.len()];
    parallel::for_each_piece(&mut normal, nx, &|r, normal| {
        for (c, normal) in normal.iter_mut().enumerate() {
            let k = r * nx + c;
            let dx = if c + 1 < nx && active[k] && active[k + 1] { t[k + 1] - t[k] } else { 0.0 };
            let dy = if r + 1 < ny && active[k] && active[k + nx] { t[k + nx] - t[k] } else { 0.0 };
            let length = (dx * dx + dy * dy + eps * eps).sqrt();
            if length > 0.0 {
                *normal = [dx / length, dy / length];
            }
        }
    });
    let divergence = (0..t.len()).map(|k| {
        let left = if !k.is_multiple_of(nx) { normal[k - 1][0] } else { 0.0 };
        let below = if k >= nx { normal[k - nx][1] } else { 0.0 };
        normal[k][0] - left + normal[k][1] - below
    });
    divergence.collect()
}

/// Number of elements of a partial sum of a long vector. Another value changes the last digits of the result.
const ELEMENTS_PER_PIECE: usize = 1 << 13;

/// Replaces t by the extrapolated point (3) of the module, from which the next step starts. `x` is the result of the
/// step (2) from t. `extrapolated` has x_k and g_k of the step before (`None` before the first step), and is updated.
fn extrapolate(t: &mut Vec<f64>, x: Vec<f64>, extrapolated: &mut Option<(Vec<f64>, Vec<f64>)>) {
    // t becomes g, then the point to go on from.
    t.iter_mut().zip(&x).for_each(|(t, x)| *t = x - *t);
    let a = extrapolated.as_ref().map_or(0.0, |(_, g)| {
        let a = sum_of_products(t, g) / sum_of_products(g, g);
        if a.is_finite() { a.clamp(0.0, 1.0) } else { 0.0 }
    });
    let mut y = x.clone();
    if let Some((before, _)) = &*extrapolated {
        y.iter_mut().zip(before).for_each(|(y, before)| *y = (*y + a * (*y - before)).max(0.0));
    }
    *extrapolated = Some((x, std::mem::replace(t, y)));
}

/// Repeats the step (2) of the module until the RMS settles or all steps are done; returns the times of the unknowns,
/// s, and the report. `w` are the weights, `e` the desired removal E.
fn iterate(
    w: &Array2<f64>,
    e: &Array2<f64>,
    unknown: &Unknown<'_>,
    settings: &LucyRichardsonSettings,
) -> (Vec<f64>, LucyRichardsonReport) {
    let Unknown { forward, adjoint, curvature, sensitivity: s, active, uniform } = unknown;
    // The uniform density whose removed volume is the desired one.
    let desired: f64 = (e * w).sum();
    let volume: f64 = (0..s.len()).filter(|j| active[*j]).map(|j| s[j] * uniform[j]).sum();
    let mut t: Vec<f64> =
        (0..s.len()).map(|j| if active[j] { uniform[j] * desired / volume } else { 0.0 }).collect();
    let count = active.iter().filter(|a| **a).count();
    let floor = 1e-9 * e.iter().copied().fold(0.0, f64::max);
    let mut log_likelihood = Vec::new();
    let mut rms_nm = Vec::new();
    let wanted = settings.stop_at_max || settings.min_decrease == 0.0;
    let mut end = if wanted { End::StepsDone } else { End::IterationLimit };
    let mut iterations = 0;
    // x_k and g_k of (3)
    let mut extrapolated: Option<(Vec<f64>, Vec<f64>)> = None;
    let mut tell_excess = progress::of_excess();
    loop {
        // rho = w E / m
        let mut rho = forward(&t);
        let (likelihood, rms) = compared(e, w, floor, &mut rho);
        log_likelihood.push(likelihood);
        rms_nm.push(rms);
        if iterations >= 10 {
            let before = rms_nm[iterations - 10];
            let fall = before - rms_nm[iterations];
            if fall < settings.min_decrease * before {
                end = End::Settled;
                break;
            }
            tell_excess(fall / (settings.min_decrease * before));
        }
        progress::done(iterations as f64 / settings.max_iterations as f64);
        if iterations == settings.max_iterations {
            break;
        }
        // x = t (B' rho) / (B' w) / (1 - mu kappa)
        let mut x = adjoint(&rho);
        let sums = t.chunks(ELEMENTS_PER_PIECE).map(|t| t.iter().sum::<f64>());
        let mean = sums.sum::<f64>() / count as f64;
        let kappa = if settings.total_variation > 0.0 { curvature(&t, mean) } else { Vec::new() };
        for (j, x) in x.iter_mut().enumerate() {
            if !active[j] {
                *x = t[j];
                continue;
            }
            // An FFT leaves a rounding that may be negative.
            let mut next = t[j] * (*x / s[j]).max(0.0);
            if let Some(kappa) = kappa.get(j) {
                next /= (1.0 - settings.total_variation * kappa).clamp(0.5, 2.0);
            }
            *x = next.min(MAX_TIME_OVER_MEAN * mean);
        }
        if settings.accelerated {
            extrapolate(&mut t, x, &mut extrapolated);
        } else {
            t = x;
        }
        iterations += 1;
    }
    let report = LucyRichardsonReport {
        end,
        iterations,
        log_likelihood,
        rms_nm,
        active: count,
        clipped_tif_samples: 0,
        pixels_per_cell: 1,
    };
    (t, report)
}

/// Returns `sum a_i b_i`, as the sum of the sums over pieces of [`ELEMENTS_PER_PIECE`] elements.
fn sum_of_products(a: &[f64], b: &[f64]) -> f64 {
    a.chunks(ELEMENTS_PER_PIECE).zip(b.chunks(ELEMENTS_PER_PIECE)).map(|(a, b)| dot(a, b)).sum()
}

/// Returns the log-likelihood `sum w (E ln m - m)` and the RMS (mean removed) of E - m for the removal m (ny, nx), nm.
/// Replaces m by w E / m, where m counts at least `floor`; 0 where w is 0.
fn compared(e: &Array2<f64>, w: &Array2<f64>, floor: f64, m: &mut Array2<f64>) -> (f64, f64) {
    let mut parts = vec![[0.0; 4]; m.nrows()];
    parallel::consume(m.outer_iter_mut().zip(&mut parts), &|r, (mut m, sums)| {
        for ((m, e), w) in m.iter_mut().zip(e.row(r)).zip(w.row(r)) {
            if *w > 0.0 {
                let d = e - *m;
                let positive = m.max(floor);
                sums[0] += w * (e * positive.ln() - positive);
                sums[1] += w;
                sums[2] += w * d;
                sums[3] += w * d * d;
                *m = w * e / positive;
            } else {
                *m = 0.0;
            }
        }
    });
    let [likelihood, weight, differences, squares] =
        [0, 1, 2, 3].map(|k| parts.iter().map(|p| p[k]).sum::<f64>());
    // The mean of E - m is small: a step keeps the volume.
    let mean = differences / weight;
    (likelihood, (squares / weight - mean * mean).max(0.0).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curvature_of_a_cone_is_one_over_the_radius() {
        // t = |p - p0|: div(grad t / |grad t|) = 1 / r in the plane.
        let (ny, nx) = (61, 71);
        let r = |k: usize| ((k / nx) as f64 - 30.3).hypot((k % nx) as f64 - 35.4);
        let t: Vec<f64> = (0..ny * nx).map(r).collect();
        let found = curvature_2d(&t, &vec![true; t.len()], (ny, nx), 1e-9);
        for k in (0..t.len()).filter(|k| r(*k) > 10.0 && r(*k) < 25.0) {
            // First-order differences: the error is of the order 1 / r^2.
            assert!((found[k] - 1.0 / r(k)).abs() < 2.0 / r(k).powi(2), "{k}: {}", found[k]);
        }
        // No flux over the border of the active nodes: the sum of a divergence is zero.
        let active: Vec<bool> = (0..t.len()).map(|k| r(k) < 20.0).collect();
        let sum: f64 = curvature_2d(&t, &active, (ny, nx), 0.1).iter().sum();
        // Rounding: some thousand fluxes of up to 1, each of which enters twice with opposite signs.
        assert!(sum.abs() < 1e-10, "{sum}");
    }
}
