//! The dwell times that leave the smallest residual, within bounds.
//!
//! ```text
//! min over lo <= t <= hi, and a free piston c:
//!   1/2 sum_i w_i (z_i - c - (B t)_i)^2
//!   + 1/2 alpha D sum_j (t_j - lo_j)^2
//!   + 1/2 beta D sum_k (q_{k+1} - q_k)^2,     q_k = t_k l / l_k                          (1)
//!   + lambda sum_i w_i sum_j t_j
//! ```
//!
//! `w` are the weights of the pixels (0 where the map is invalid), `D` the largest diagonal element
//! of `B' W B`, `l_k` the length of segment k and `l` the median length: `q` is the dwell-time
//! density along the path. `alpha` decides the dwell times that the map does not (outside the
//! clear aperture), `beta` keeps neighbours alike, which is what a machine can execute, `lambda`
//! is the price of a second in half a mean square. In place of
//! the piston a plane may be free, and in place of the square a Huber loss may stand, which counts
//! residuals above `k` linearly: pits. What is free is implicit: with functions `f` orthonormal
//! under the weights and `U = B' W f`,
//!
//! ```text
//! H = B' W B - U U' + alpha D I + beta D G' G                                            (2)
//! g = B' W (z - its part in f) + alpha D lo
//! ```
//!
//! H is never made. Steps come from a cheap surrogate of it (`surrogate`: cells of pixels and the
//! primal-dual active set method, by a skyline Cholesky factorisation or, for many points, by the FFT and
//! conjugate gradients with a spline lattice; where the lattice would be too large, projected
//! gradient steps), and each is corrected by the gradient of (1) itself, which also certifies the
//! result. B is applied by FFT, which is exact where the TIF has the pitch of the map; otherwise its
//! columns are stored, unless they are too many.
//! Columns that reach the map by less than 1e-9 of the largest stay at their lower bound.
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

use std::fmt;

use ndarray::{Array2, Zip};
use planish_numerics::{
    linear::skyline::dot,
    qp::bounded::{self, GradientSettings},
    statistics,
};
use planish_types::{DwellTime, End, Grid, Invalid, Surface, Tif, ToolPath};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    DwellError,
    columns::{self, Place, Stored},
    fft_operator::FftOperator,
    surrogate::{self, Convolved, Ordered},
};

/// A bound on the dwell times.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Bound {
    /// The same time for every dwell point, s.
    Seconds(f64),
    /// Proportional to the length of the segment, s/mm.
    SecondsPerMm(f64),
}

/// What need not be removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Free {
    /// A constant.
    Piston,
    /// A plane: the part keeps the tilt that this leaves.
    Plane,
}

/// How to solve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// What a dwell time is spent on.
    pub columns: columns::Columns,
    /// Lower bound.
    pub min_dwell: Bound,
    /// Upper bound; none when absent.
    pub max_dwell: Option<Bound>,
    /// alpha: weight of the distance to the lower bound; >= 0.
    pub tikhonov: f64,
    /// beta: weight of the roughness of the dwell-time density along the path; >= 0.
    pub smoothness: f64,
    /// Weight of the total time beside half the mean square of the residual, nm^2/s; >= 0.
    pub time_weight_nm2_per_s: f64,
    /// What need not be removed.
    pub free: Free,
    /// Residual above which a pixel counts linearly instead of squared (Huber), nm: pits.
    pub huber_nm: Option<f64>,
    /// RMS of the noise of the map, nm: beta is raised until the residual is no smaller.
    pub noise_rms_nm: Option<f64>,
    /// Dwell points up to which the surrogate of H is factorised.
    pub max_factorised_points: usize,
    /// Natural residual that is enough, s.
    pub tolerance_s: f64,
    /// Bound on how far (1) is above its minimum, relative to it, that is enough.
    pub relative_gap: f64,
    /// Most products with the surrogate of H where it is not factorised.
    pub max_iterations: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            columns: columns::Columns::Segment,
            min_dwell: Bound::Seconds(0.0),
            max_dwell: None,
            // Both as measured to be flat optima of the executed residual on a real mirror.
            tikhonov: 1e-5,
            smoothness: 1e-2,
            time_weight_nm2_per_s: 0.0,
            free: Free::Piston,
            huber_nm: None,
            noise_rms_nm: None,
            max_factorised_points: 6000,
            tolerance_s: 1e-6,
            // RMS within 5e-5 of the least.
            relative_gap: 1e-4,
            max_iterations: 10_000,
        }
    }
}

/// How the steps of the approximation are found; manifests hold its name in kebab case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Algorithm {
    /// Active sets on the factorised surrogate of H.
    ActiveSet,
    /// Conjugate gradients on the active set, preconditioned on a lattice of B-splines.
    TwoLevel,
    /// Projected gradient steps.
    ProjectedGradient,
}

impl fmt::Display for Algorithm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// What was reached.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// How the steps were found.
    pub algorithm: Algorithm,
    /// Factorisations, or products with the surrogate of H.
    pub iterations: usize,
    /// Steps of the approximation, each corrected by the exact gradient.
    pub corrections: usize,
    /// Pixels along the side of a cell of the approximation; 1: exact.
    pub cell_pixels: usize,
    /// How it ended: `optimal`, `stagnated` (the objective changes no more) or
    /// `iteration-limit`.
    pub end: End,
    /// Largest |t - clip(t - gradient / H_jj)|: by how much a dwell time would still move, s.
    pub kkt_residual_s: f64,
    /// Bound on how far (1) is above its minimum, relative to it; left out when alpha is 0: then
    /// `kkt_residual_s` alone certifies the result.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub relative_gap: Option<f64>,
    /// beta that was used: the given one, or what the noise level asked for.
    pub smoothness: f64,
    /// Dwell points at their lower bound, unreached and lifted ones not counted.
    pub at_lower_bound: usize,
    /// Dwell points at their upper bound.
    pub at_upper_bound: usize,
    /// Dwell points that do not reach the map, at their lower bound.
    pub unreached_points: usize,
    /// Valid pixels that no dwell point reaches: nothing can be corrected there.
    pub unreached_pixels: usize,
    /// RMS (mean removed) of the residual in the removal model of the solver, nm.
    pub model_rms_nm: f64,
    /// The same, plane removed, nm.
    pub model_rms_detilted_nm: f64,
    /// Sum of the dwell times, s.
    pub total_time_s: f64,
}

/// Dwell times and what was reached.
#[derive(Clone, Debug)]
pub struct Solution {
    /// Dwell times.
    pub dwell: DwellTime,
    /// What was reached.
    pub report: Report,
}

/// Solves (1) for `desired` along `path`.
///
/// `weight` (ny, nx) >= 0 weighs the pixels; without it every valid pixel counts 1.
pub fn solve(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    weight: Option<&Array2<f64>>,
    settings: &Settings,
) -> Result<Solution, DwellError> {
    let (lo, hi) = bounds(path, settings)?;
    let columns = settings.columns.places(path);
    solve_columns(
        desired,
        tif,
        path,
        weight,
        settings,
        &Program { places: &columns, lo, hi, guess: None },
    )
}

/// The columns of B and the bounds of their dwell times.
#[derive(Clone, Debug)]
pub struct Program<'a> {
    /// Where the tool is in each column (n).
    pub places: &'a [Vec<Place>],
    /// Lower bounds (n), s.
    pub lo: Vec<f64>,
    /// Upper bounds (n), s.
    pub hi: Vec<f64>,
    /// Dwell times of a similar problem (n), s: a first guess, which only saves time.
    pub guess: Option<Vec<f64>>,
}

/// [`solve`] with given columns and bounds in place of those of the settings.
pub fn solve_columns(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    weight: Option<&Array2<f64>>,
    settings: &Settings,
    program: &Program<'_>,
) -> Result<Solution, DwellError> {
    let weight = pixel_weights(desired, weight)?;
    let weights = [
        ("tikhonov", settings.tikhonov),
        ("smoothness", settings.smoothness),
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
    let Program { places, lo, hi, guess } = program;
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

    let pixels =
        tif.rate_nm_per_s().len() as f64 * tif.grid().pixel_mm2() / desired.grid().pixel_mm2();
    if pixels > MAX_TIF_PIXELS {
        return Err(Invalid::whole(
            "rate_nm_per_s",
            format!("covers {pixels:.0} pixels of the map"),
            "check that the TIF and the map are both in mm",
        )
        .into());
    }
    let stored = !FftOperator::is_exact(tif, desired.grid())
        && path.len() <= settings.max_factorised_points
        && path.len() as f64 * pixels <= MAX_STORED_ELEMENTS;
    let columns = if stored {
        Columns::Stored(Stored::new(places, tif, desired.grid()))
    } else {
        Columns::Convolved(Box::new(FftOperator::new(places, tif, desired.grid())))
    };
    let mut problem = Problem::new(desired, tif, path, program, weight, columns, settings)?;
    problem.solve()
}

/// The given weights, zero on invalid pixels.
pub(crate) fn pixel_weights(
    desired: &Surface,
    weight: Option<&Array2<f64>>,
) -> Result<Array2<f64>, Invalid> {
    let height = desired.height_nm();
    let mut w = height.mapv(|z| if z.is_nan() { 0.0 } else { 1.0 });
    if let Some(given) = weight {
        if given.dim() != height.dim() {
            let problem = format!("has shape {:?}, the map {:?}", given.dim(), height.dim());
            return Err(Invalid::whole("weight", problem, "give one weight per pixel"));
        }
        let bad = given.indexed_iter().find(|(_, v)| !(v.is_finite() && **v >= 0.0));
        if let Some((index, v)) = bad {
            return Err(Invalid::at("weight", index, format!("is {v}"), "give weights >= 0"));
        }
        w *= given;
        if w.iter().all(|v| *v == 0.0) {
            return Err(Invalid::whole("weight", "is 0 on every valid pixel", "give a weight > 0"));
        }
    }
    Ok(w)
}

/// Lower and upper bound of every dwell point (n), s, by the settings.
pub fn bounds(path: &ToolPath, settings: &Settings) -> Result<(Vec<f64>, Vec<f64>), Invalid> {
    let of = |name: &'static str, bound: Bound| -> Result<Vec<f64>, Invalid> {
        let (Bound::Seconds(value) | Bound::SecondsPerMm(value)) = bound;
        if !(value.is_finite() && value >= 0.0) {
            return Err(Invalid::whole(name, format!("is {value}"), "give a finite bound >= 0"));
        }
        Ok((0..path.len())
            .map(|j| match bound {
                Bound::Seconds(t) => t,
                Bound::SecondsPerMm(tau) => tau * path.segment_length_mm(j),
            })
            .collect())
    };
    let lo = of("min_dwell", settings.min_dwell)?;
    if let Some(j) = lo.iter().position(|t| *t > LONGEST_FLOOR_S) {
        let problem = format!("is {:?} s", lo[j]);
        let remedy = format!("a least dwell time is at most {LONGEST_FLOOR_S:e} s; give seconds");
        return Err(Invalid::at("min_dwell", j, problem, remedy));
    }
    let hi = match settings.max_dwell {
        Some(bound) => of("max_dwell", bound)?,
        None => vec![f64::INFINITY; path.len()],
    };
    Ok((lo, hi))
}

/// Longest least dwell time of one point, s: four months are a mistake in the units.
const LONGEST_FLOOR_S: f64 = 1e7;

/// B.
enum Columns {
    Stored(Stored),
    Convolved(Box<FftOperator>),
}

impl Columns {
    /// `B t`, nm.
    fn apply(&self, t: &[f64]) -> Array2<f64> {
        match self {
            Self::Stored(b) => b.apply(t),
            Self::Convolved(b) => b.apply(t),
        }
    }

    /// `B' m`.
    fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        match self {
            Self::Stored(b) => b.adjoint(map),
            Self::Convolved(b) => b.adjoint(map),
        }
    }
}

/// H~.
enum Surrogate {
    Ordered(Ordered),
    Convolved(Box<Convolved>),
}

fn convolved(
    places: &[Vec<Place>],
    reached: &[bool],
    tif: &Tif,
    grid: &Grid,
    weight: &Array2<f64>,
    free: Free,
    cells: (usize, Option<f64>),
) -> Result<Surrogate, Invalid> {
    let h = Convolved::new(places, reached, tif, grid, weight, free, cells)?;
    Ok(Surrogate::Convolved(Box::new(h)))
}

/// Sum of `w B^2` of every column. By FFT the mean of R^2 stands for the square of the mean, and
/// what spills counts: not where that decides whether a column reaches the map at all.
fn energies(
    columns: &Columns,
    places: &[Vec<Place>],
    tif: &Tif,
    grid: &Grid,
    weight: &Array2<f64>,
) -> Vec<f64> {
    let b = match columns {
        Columns::Stored(b) => return b.energy(weight),
        Columns::Convolved(b) => b,
    };
    let mut energy = b.adjoint_of_squared_tif(weight);
    let largest = energy.iter().copied().fold(0.0, f64::max);
    let weak: Vec<usize> = (0..energy.len()).filter(|j| energy[*j] < WEAK * largest).collect();
    let of = |j: &usize| Stored::new(&places[*j..=*j], tif, grid).energy(weight)[0];
    let exact: Vec<f64> = weak.par_iter().map(of).collect();
    weak.iter().zip(exact).for_each(|(j, e)| energy[*j] = e);
    energy
}

/// What the removal need not remove, as functions orthonormal under the weights:
/// `sum_i w_i f_l(x_i) f_m(x_i) = [l = m]`.
pub(crate) struct Basis {
    x_mm: Vec<f64>,
    y_mm: Vec<f64>,
    /// f = a + b (x - x0) + c (y - y0) with the middle of the map at (x0, y0).
    functions: Vec<[f64; 3]>,
}

impl Basis {
    pub(crate) fn new(grid: &Grid, weight: &Array2<f64>, free: Free) -> Self {
        let centred = |a: &planish_types::Axis| -> Vec<f64> {
            let middle = 0.5 * (a.start_mm() + a.end_mm());
            a.coordinates().iter().map(|v| v - middle).collect()
        };
        let (x_mm, y_mm) = (centred(&grid.x), centred(&grid.y));
        // Moments m[k][l] = sum of w f_k f_l with f = 1, x, y.
        let mut m = [[0.0; 3]; 3];
        for (r, row) in weight.outer_iter().enumerate() {
            for (c, w) in row.iter().enumerate() {
                let f = [1.0, x_mm[c], y_mm[r]];
                for k in 0..3 {
                    for l in 0..=k {
                        m[k][l] += w * f[k] * f[l];
                    }
                }
            }
        }
        let product = |a: &[f64; 3], b: &[f64; 3]| -> f64 {
            let mut sum = 0.0;
            for k in 0..3 {
                for l in 0..3 {
                    sum += a[k] * b[l] * m[k.max(l)][k.min(l)];
                }
            }
            sum
        };
        // Gram-Schmidt; a function that is none (a map of one column) is left out.
        let count = match free {
            Free::Piston => 1,
            Free::Plane => 3,
        };
        let mut functions: Vec<[f64; 3]> = Vec::new();
        for k in 0..count {
            let mut f = [0.0; 3];
            f[k] = 1.0;
            let before = product(&f, &f);
            for _ in 0..2 {
                for g in &functions {
                    let c = product(&f, g);
                    (0..3).for_each(|l| f[l] -= c * g[l]);
                }
            }
            let after = product(&f, &f);
            if after > 1e-12 * before {
                functions.push(f.map(|v| v / after.sqrt()));
            }
        }
        Self { x_mm, y_mm, functions }
    }

    fn at(&self, f: &[f64; 3], r: usize, c: usize) -> f64 {
        f[0] + f[1] * self.x_mm[c] + f[2] * self.y_mm[r]
    }

    /// `sum_i w_i m_i f(x_i)` for every function.
    fn coefficients(&self, weight: &Array2<f64>, map: &Array2<f64>) -> Vec<f64> {
        // By rows: sums of w m and of w m x.
        let mut sums = vec![0.0; self.functions.len()];
        for (r, (w, m)) in weight.outer_iter().zip(map.outer_iter()).enumerate() {
            let (mut plain, mut along) = (0.0, 0.0);
            for ((w, m), x) in w.iter().zip(m).zip(&self.x_mm) {
                plain += w * m;
                along += w * m * x;
            }
            for (sum, f) in sums.iter_mut().zip(&self.functions) {
                *sum += (f[0] + f[2] * self.y_mm[r]) * plain + f[1] * along;
            }
        }
        sums
    }

    /// The map without its part in the functions.
    fn project(&self, weight: &Array2<f64>, map: &mut Array2<f64>) {
        let coefficients = self.coefficients(weight, map);
        for (mut row, y) in map.outer_iter_mut().zip(&self.y_mm) {
            let (mut at_0, mut slope) = (0.0, 0.0);
            for (k, f) in coefficients.iter().zip(&self.functions) {
                at_0 += k * (f[0] + f[2] * y);
                slope += k * f[1];
            }
            row.iter_mut().zip(&self.x_mm).for_each(|(m, x)| *m -= at_0 + slope * x);
        }
    }

    /// `U = B' W f` for every function, `adjoint` being B'.
    pub(crate) fn columns(
        &self,
        weight: &Array2<f64>,
        adjoint: impl Fn(&Array2<f64>) -> Vec<f64>,
    ) -> Vec<Vec<f64>> {
        let of = |f: &[f64; 3]| {
            adjoint(&Array2::from_shape_fn(weight.dim(), |(r, c)| {
                weight[[r, c]] * self.at(f, r, c)
            }))
        };
        self.functions.iter().map(of).collect()
    }
}

/// The terms of (1) beside the residual: `alpha D` and `beta D`.
#[derive(Clone)]
pub(crate) struct Penalty {
    alpha: f64,
    beta: f64,
    /// Price of a second in the unit of (1).
    time: f64,
    lo: Vec<f64>,
    /// k and the factors of t_{k-1} and t_k in q_k - q_{k-1}.
    steps: Vec<(usize, f64, f64)>,
}

impl Penalty {
    pub(crate) fn new(
        path: &ToolPath,
        lo: &[f64],
        d: f64,
        weight: f64,
        settings: &Settings,
    ) -> Self {
        let mut steps = Vec::new();
        let lengths: Vec<f64> = (0..lo.len()).map(|j| path.segment_length_mm(j)).collect();
        let mut sorted: Vec<f64> = lengths.iter().copied().filter(|l| *l > 0.0).collect();
        sorted.sort_by(f64::total_cmp);
        if let Some(median) = sorted.get(sorted.len() / 2) {
            // A density needs a length (here at least 1 % of the median: shorter segments are
            // rests, whose density says nothing about their neighbours).
            let has_density = |j: usize| path.tool_on()[j] && lengths[j] > 0.01 * median;
            steps = (1..lo.len())
                .filter(|k| has_density(k - 1) && has_density(*k))
                .map(|k| (k, median / lengths[k - 1], median / lengths[k]))
                .collect();
        }
        let (alpha, beta) = (settings.tikhonov * d, settings.smoothness * d);
        let time = settings.time_weight_nm2_per_s * weight;
        Self { alpha, beta, time, lo: lo.to_vec(), steps }
    }

    pub(crate) fn len(&self) -> usize {
        self.lo.len()
    }

    /// alpha D
    pub(crate) fn alpha(&self) -> f64 {
        self.alpha
    }

    /// beta D
    pub(crate) fn beta(&self) -> f64 {
        self.beta
    }

    /// k and the factors u, v of `(v t_k - u t_{k-1})^2`.
    pub(crate) fn steps(&self) -> &[(usize, f64, f64)] {
        &self.steps
    }

    /// Elements (j, k), k <= j, of the matrix.
    pub(crate) fn for_each(&self, mut add: impl FnMut(usize, usize, f64)) {
        for j in 0..self.len() {
            add(j, j, self.alpha);
        }
        for &(k, u, v) in &self.steps {
            add(k - 1, k - 1, self.beta * u * u);
            add(k, k, self.beta * v * v);
            add(k, k - 1, -self.beta * u * v);
        }
    }

    pub(crate) fn diagonal(&self) -> Vec<f64> {
        let mut diagonal = vec![0.0; self.len()];
        self.for_each(|j, k, v| {
            if j == k {
                diagonal[j] += v;
            }
        });
        diagonal
    }

    /// `out += (alpha D + beta D G' G) t`.
    pub(crate) fn add_product(&self, t: &[f64], out: &mut [f64]) {
        out.iter_mut().zip(t).for_each(|(o, t)| *o += self.alpha * t);
        for &(k, u, v) in &self.steps {
            let step = self.beta * (v * t[k] - u * t[k - 1]);
            out[k] += v * step;
            out[k - 1] -= u * step;
        }
    }

    /// `out += ` the gradient.
    fn add_gradient(&self, t: &[f64], out: &mut [f64]) {
        self.add_product(t, out);
        out.iter_mut().zip(&self.lo).for_each(|(o, lo)| *o += self.time - self.alpha * lo);
    }

    /// The terms themselves.
    fn value(&self, t: &[f64]) -> f64 {
        let far: f64 = t.iter().zip(&self.lo).map(|(t, lo)| (t - lo).powi(2)).sum();
        let rough: f64 =
            self.steps.iter().map(|(k, u, v)| (v * t[*k] - u * t[k - 1]).powi(2)).sum();
        0.5 * (self.alpha * far + self.beta * rough) + self.time * t.iter().sum::<f64>()
    }
}

/// (1) with everything that defines it.
struct Problem<'a> {
    desired: &'a Surface,
    tif: &'a Tif,
    path: &'a ToolPath,
    places: &'a [Vec<Place>],
    settings: &'a Settings,
    columns: Columns,
    /// z minus its weighted mean, 0 where the weight is 0.
    z: Array2<f64>,
    /// As given.
    weight: Array2<f64>,
    lo: &'a [f64],
    /// Upper bounds; the lower ones of unreached columns, which keep them whatever the others do.
    hi: Vec<f64>,
    reached: Vec<bool>,
    /// Diagonal of H without the penalty.
    diagonal: Vec<f64>,
    /// D.
    strongest: f64,
    u: Vec<Vec<f64>>,
    surrogate: Surrogate,
    /// Pixels along the side of a cell of `surrogate`.
    cell: usize,
    /// Pitch of its splines, mm.
    splines_mm: Option<f64>,
    start: Vec<f64>,
}

/// A column below this fraction of the largest diagonal element does not reach the map.
const UNREACHED_FRACTION: f64 = 1e-9;

/// Below this fraction of the largest the energy of a column is not estimated.
const WEAK: f64 = 1e-3;

/// Where the iteration is.
struct Iterate {
    t: Vec<f64>,
    removal_nm: Array2<f64>,
    /// Factorisations, or products with H~.
    iterations: usize,
    corrections: usize,
    natural_residual: f64,
    relative_gap: Option<f64>,
    end: End,
}

impl<'a> Problem<'a> {
    fn new(
        desired: &'a Surface,
        tif: &'a Tif,
        path: &'a ToolPath,
        program: &'a Program<'a>,
        weight: Array2<f64>,
        columns: Columns,
        settings: &'a Settings,
    ) -> Result<Self, DwellError> {
        let (n, grid) = (path.len(), desired.grid());
        let basis = Basis::new(grid, &weight, settings.free);
        let u = basis.columns(&weight, |m| columns.adjoint(m));
        let factorised = n <= settings.max_factorised_points;
        let loss = if factorised { surrogate::LOSS } else { surrogate::LOSS_TWO_LEVEL };
        let mut cell = surrogate::cell_size(tif, grid, loss);
        // diag H = sum of w B^2 less U^2
        let (cells, energy) = if factorised {
            let (cells, energy) = columns::on_cells(program.places, tif, grid, &weight, cell);
            (Some(cells), energy)
        } else {
            (None, energies(&columns, program.places, tif, grid, &weight))
        };
        let mut diagonal: Vec<f64> = (0..n)
            .map(|j| (energy[j] - u.iter().map(|u| u[j] * u[j]).sum::<f64>()).max(0.0))
            .collect();
        let largest = diagonal.iter().copied().fold(0.0, f64::max);
        if largest.is_nan() || largest <= 0.0 {
            return Err(DwellError::OutOfReach { points: n });
        }
        let reached: Vec<bool> =
            diagonal.iter().map(|d| *d > UNREACHED_FRACTION * largest).collect();
        let strongest = match &cells {
            Some(_) => largest,
            // D decides the weights of (1): the element itself, not the estimate.
            None => {
                let j = (0..n).max_by(|a, b| diagonal[*a].total_cmp(&diagonal[*b])).unwrap_or(0);
                let p = Stored::new(&program.places[j..=j], tif, grid);
                let u = basis.columns(&weight, |m| p.adjoint(m));
                p.energy(&weight)[0] - u.iter().map(|u| u[0] * u[0]).sum::<f64>()
            }
        };
        for j in (0..n).filter(|j| !reached[*j]) {
            diagonal[j] = 0.0;
        }

        let hi: Vec<f64> =
            (0..n).map(|j| if reached[j] { program.hi[j] } else { program.lo[j] }).collect();
        let first = program.guess.as_ref().unwrap_or(&program.lo);
        let start = (0..n).map(|j| first[j].clamp(program.lo[j], hi[j])).collect();
        let penalty = Penalty::new(path, &program.lo, strongest, weight.sum(), settings);
        let mut splines_mm = None;
        let surrogate = match &cells {
            Some(cells) => {
                Surrogate::Ordered(Ordered::new(cells, &u, &reached, &penalty, cell == 1))
            }
            None => {
                if settings.tikhonov >= LEAST_TIKHONOV {
                    splines_mm = surrogate::spline_pitch(program.places, &reached, tif, grid, cell);
                }
                if splines_mm.is_none() {
                    cell = surrogate::cell_size(tif, grid, surrogate::LOSS_GRADIENT);
                }
                let cells = (cell, splines_mm);
                convolved(program.places, &reached, tif, grid, &weight, settings.free, cells)?
            }
        };
        Ok(Self {
            z: centred(desired.height_nm(), &weight),
            desired,
            tif,
            path,
            places: program.places,
            settings,
            columns,
            weight,
            lo: &program.lo,
            hi,
            reached,
            diagonal,
            strongest,
            u,
            surrogate,
            cell,
            splines_mm,
            start,
        })
    }

    fn solve(&mut self) -> Result<Solution, DwellError> {
        let given = self.settings.smoothness;
        let first = self.minimise(given)?;
        let (smoothness, iterate) = match self.settings.noise_rms_nm {
            Some(noise) if self.rms_nm(&first) < noise => self.stop_at(noise, first)?,
            _ => (given, first),
        };
        Ok(self.finish(iterate, smoothness)?)
    }

    /// The largest beta at which the residual does not exceed the noise (Morozov's discrepancy
    /// principle), and its minimum; `first` is that of the given beta, which fits the noise.
    fn stop_at(&mut self, noise_nm: f64, first: Iterate) -> Result<(f64, Iterate), DwellError> {
        let (mut low, mut best) = (self.settings.smoothness.max(LEAST_SMOOTHNESS), first);
        let mut high = low;
        while high < MOST_SMOOTHNESS {
            high *= 10.0;
            self.start.clone_from(&best.t);
            let rougher = self.minimise(high)?;
            if self.rms_nm(&rougher) > noise_nm {
                break;
            }
            (low, best) = (high, rougher);
        }
        while high / low > 1.05 && low < MOST_SMOOTHNESS {
            let middle = (low * high).sqrt();
            self.start.clone_from(&best.t);
            let found = self.minimise(middle)?;
            if self.rms_nm(&found) > noise_nm {
                high = middle;
            } else {
                (low, best) = (middle, found);
            }
        }
        Ok((low, best))
    }

    /// RMS of the residual without its free part, nm.
    fn rms_nm(&self, iterate: &Iterate) -> f64 {
        let mut r = &self.z - &iterate.removal_nm;
        Basis::new(self.desired.grid(), &self.weight, self.settings.free)
            .project(&self.weight, &mut r);
        let squares = Zip::from(&r).and(&self.weight).fold(0.0, |sum, r, w| sum + w * r * r);
        (squares / self.weight.sum()).sqrt()
    }

    /// H~ of smaller cells; `false` when there are none.
    fn sharpen(&mut self, penalty: &Penalty) -> Result<bool, DwellError> {
        if self.cell == 1 {
            return Ok(false);
        }
        self.cell /= 2;
        let (tif, grid, weight) = (self.tif, self.desired.grid(), &self.weight);
        self.surrogate = match &self.surrogate {
            Surrogate::Ordered(_) => {
                let (cells, _) = columns::on_cells(self.places, tif, grid, weight, self.cell);
                Surrogate::Ordered(Ordered::new(
                    &cells,
                    &self.u,
                    &self.reached,
                    penalty,
                    self.cell == 1,
                ))
            }
            Surrogate::Convolved(_) => {
                let cells = (self.cell, self.splines_mm);
                convolved(self.places, &self.reached, tif, grid, weight, self.settings.free, cells)?
            }
        };
        Ok(true)
    }

    /// Minimises (1) by steps of its approximation:
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
    /// components at their bounds are settled. With a Huber loss every q has the weights of its own residual, which is the gradient of that loss.
    fn minimise(&mut self, smoothness: f64) -> Result<Iterate, DwellError> {
        let settings = Settings { smoothness, ..*self.settings };
        let penalty =
            Penalty::new(self.path, self.lo, self.strongest, self.weight.sum(), &settings);
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
            self.columns.apply(&t)
        };
        let (mut iterations, mut corrections, mut slow) = (0, 0, 0);
        let mut residual_before = f64::INFINITY;
        let (mut before, mut settled): (Option<(Vec<f64>, Array2<f64>)>, _) = (None, None);
        loop {
            // r = z - B t without its free part,  q = -B' W r + penalty
            let mut r = &self.z - &removal_nm;
            basis.project(&weight, &mut r);
            if let Some(k) = settings.huber_nm.filter(|_| corrections > 0) {
                Zip::from(&mut weight).and(&self.weight).and(&r).for_each(|w, given, r| {
                    *w = given * (k / r.abs()).min(1.0);
                });
                basis = Basis::new(&grid, &weight, settings.free);
                basis.project(&weight, &mut r);
            }
            let mut q = self.columns.adjoint(&(&r * &weight));
            q.iter_mut().for_each(|q| *q = -*q);
            penalty.add_gradient(&t, &mut q);
            let objective = 0.5 * Zip::from(&r).and(&weight).fold(0.0, |sum, r, w| sum + w * r * r)
                + penalty.value(&t);

            let natural_residual = bounded::natural_residual(&t, &q, &diagonal, self.lo, &self.hi);
            let relative_gap = gap(&t, &q, self.lo, &self.hi, penalty.alpha, &self.reached)
                .map(|gap| gap / objective.max(f64::MIN_POSITIVE));
            let optimal = natural_residual <= settings.tolerance_s
                || relative_gap.is_some_and(|gap| gap <= settings.relative_gap);
            let mut end = if optimal { Some(End::Optimal) } else { settled };
            if end.is_none() && corrections >= MAX_CORRECTIONS {
                end = Some(End::IterationLimit);
            }
            slow = if natural_residual > 0.5 * residual_before { slow + 1 } else { 0 };
            residual_before = natural_residual;
            let factorised = matches!(self.surrogate, Surrogate::Ordered(_));
            let by_gradient = !factorised && self.splines_mm.is_none();
            if slow >= 2 && factorised && end.is_none() {
                slow = 0;
                self.sharpen(&penalty)?;
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
                        if !self.sharpen(&penalty)? {
                            return Err(DwellError::Singular { tikhonov: settings.tikhonov });
                        }
                    }
                    Surrogate::Convolved(h) => {
                        let steps = GradientSettings {
                            tolerance: if by_gradient {
                                (0.01 * natural_residual).max(0.5 * settings.tolerance_s)
                            } else {
                                ENOUGH * natural_residual
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
            if end.is_none() && -slope <= ROUNDING * objective {
                end = Some(End::Stagnated);
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
            let quadratic = Along { penalty: &penalty, basis: &basis, weight: &weight };
            let d_nm = self.columns.apply(&d);
            let curvature = quadratic.value(&d, &d_nm);
            // The whole step lands on the bounds: nearly whole is made whole.
            let s = -slope / curvature;
            let s = if s > 0.6 { 1.0 } else { s };
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
                e_nm += &self.columns.apply(&clipped);
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

    fn finish(&self, iterate: Iterate, smoothness: f64) -> Result<Solution, Invalid> {
        let t = &iterate.t;
        let reached = |j: &usize| self.reached[*j];
        let mut residual = self.desired.height_nm() - &iterate.removal_nm;
        Zip::from(&mut residual).and(&self.weight).for_each(|r, w| {
            if *w == 0.0 {
                *r = f64::NAN;
            }
        });
        let unreached = |map: &Array2<f64>| {
            // An FFT leaves rounding where nothing is reached.
            let floor = 1e-12 * map.iter().copied().fold(0.0, f64::max);
            map.iter().zip(&self.weight).filter(|(r, w)| **w > 0.0 && **r <= floor).count()
        };
        // Where something is removed the tool was; where nothing is, it may not have dwelt.
        let mut unreached_pixels = unreached(&iterate.removal_nm);
        if unreached_pixels > 0 {
            unreached_pixels = unreached(&self.columns.apply(&vec![1.0; t.len()]));
        }
        let grid = self.desired.grid();
        let rms = statistics::statistics(residual.view()).map_or(0.0, |s| s.rms);
        let (x, y) = (grid.x.coordinates(), grid.y.coordinates());
        let report = Report {
            algorithm: match &self.surrogate {
                Surrogate::Ordered(_) => Algorithm::ActiveSet,
                Surrogate::Convolved(_) if self.splines_mm.is_some() => Algorithm::TwoLevel,
                Surrogate::Convolved(_) => Algorithm::ProjectedGradient,
            },
            iterations: iterate.iterations,
            corrections: iterate.corrections,
            cell_pixels: self.cell,
            end: iterate.end,
            kkt_residual_s: iterate.natural_residual,
            relative_gap: iterate.relative_gap,
            smoothness,
            at_lower_bound: (0..t.len()).filter(reached).filter(|j| t[*j] <= self.lo[*j]).count(),
            at_upper_bound: (0..t.len()).filter(reached).filter(|j| t[*j] >= self.hi[*j]).count(),
            unreached_points: (0..t.len()).filter(|j| !reached(j)).count(),
            unreached_pixels,
            model_rms_nm: rms,
            model_rms_detilted_nm: statistics::detilted_rms(residual.view(), &x, &y).unwrap_or(rms),
            total_time_s: t.iter().sum(),
        };
        Ok(Solution { dwell: DwellTime::new(iterate.t)?, report })
    }
}

/// H of (1) along directions e with their removal B e.
struct Along<'a> {
    penalty: &'a Penalty,
    basis: &'a Basis,
    weight: &'a Array2<f64>,
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
        if determinant <= 1e-9 * dd * pp {
            return [-qd / dd, 0.0];
        }
        [(dp * qp - pp * qd) / determinant, (dp * qd - dd * qp) / determinant]
    }
}

/// `t` within its bounds, and on them where it differs by rounding.
fn snapped(t: f64, lo: f64, hi: f64) -> f64 {
    let rounding = 1e-13 * t.abs().max(lo.abs());
    match t {
        t if t <= lo + rounding => lo,
        t if t >= hi - rounding => hi,
        t => t,
    }
}

/// z minus its weighted mean, 0 where the weight is 0.
fn centred(z: &Array2<f64>, weight: &Array2<f64>) -> Array2<f64> {
    let (mut sum, mut total) = (0.0, 0.0);
    Zip::from(z).and(weight).for_each(|z, w| {
        if *w > 0.0 {
            sum += w * z;
            total += w;
        }
    });
    let mean = sum / total;
    let mut centred = Array2::zeros(z.dim());
    Zip::from(&mut centred).and(z).and(weight).for_each(|c, z, w| {
        if *w > 0.0 {
            *c = z - mean;
        }
    });
    centred
}

/// By how much (1) can still fall, at most. H is at least `alpha D`, so
///
/// ```text
/// f(t) - min f <= sum_j max over lo <= s <= hi of q_j (t_j - s) - alpha D (t_j - s)^2 / 2
/// ```
///
/// It is the gap of Fenchel's dual at the residual of t, with the alpha D alone of the penalty's
/// curvature: the bounds are exact in it, and where they are finite a component adds at most
/// `q_j (t_j - lo_j)` or `q_j (t_j - hi_j)`, whatever alpha.
///
/// `None` without alpha.
fn gap(t: &[f64], q: &[f64], lo: &[f64], hi: &[f64], alpha: f64, reached: &[bool]) -> Option<f64> {
    let of = |j: usize| {
        let p = t[j] - (t[j] - q[j] / alpha).clamp(lo[j], hi[j]);
        p * (q[j] - 0.5 * alpha * p)
    };
    (alpha > 0.0).then(|| (0..t.len()).filter(|j| reached[*j]).map(of).sum())
}

/// Most pixels of the map under the TIF: it may exceed the map, but not by orders of magnitude.
const MAX_TIF_PIXELS: f64 = 2.7e8;

/// Most elements of B that are stored (2 GB).
const MAX_STORED_ELEMENTS: f64 = 2.5e8;

/// Range of the smoothness that the noise level chooses from.
const LEAST_SMOOTHNESS: f64 = 1e-6;
const MOST_SMOOTHNESS: f64 = 1e6;

/// The gradient method ends when 50 steps change the mean square of the residual by less than this
/// fraction, its RMS by half of it; the corrections of its result end when one changes it by less.
const STAGNATION: f64 = 2e-4;

/// Steps of H~; measured problems take 3 to 6.
const MAX_CORRECTIONS: usize = 100;

/// Part of the natural residual that a step of the two-level method may leave.
const ENOUGH: f64 = 0.1;

/// Below this alpha the rounding of the two-level method is larger.
const LEAST_TIKHONOV: f64 = 1e-7;

/// A step that promises to lower (1) by less than this fraction of it is rounding.
const ROUNDING: f64 = 1e-15;
