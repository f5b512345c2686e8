//! The dwell times that leave the smallest residual, within bounds.
//!
//! ```text
//! min over lo <= t <= hi, and a free piston c:
//!   1/2 sum_i w_i (z_i - c - (B t)_i)^2
//!   + 1/2 alpha D sum_j (t_j - lo_j)^2
//!   + 1/2 beta D sum_k (q_{k+1} - q_k)^2,     q_k = t_k l / l_k                          (1)
//! ```
//!
//! `w` are the weights of the pixels (0 where the map is invalid), `D` the largest diagonal element
//! of `B' W B`, `l_k` the length of segment k and `l` the median length: `q` is the dwell-time
//! density along the path. `alpha` decides the dwell times that the map does not (outside the
//! clear aperture), `beta` keeps neighbours alike, which is what a machine can execute. The optimal
//! piston is implicit: with `b = B' w`,
//!
//! ```text
//! H = B' W B - b b' / sum(w) + alpha D I + beta D G' G                                    (2)
//! g = B' W (z - mean z) + alpha D lo
//! ```
//!
//! Small problems are solved by the primal-dual active set method with H as a matrix, large ones
//! by the accelerated projected gradient with `H t` by FFT ([`planish_numerics::bounded`]).
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

use ndarray::{Array2, ArrayView1, ArrayView2, Zip, s};
use planish_numerics::{
    bounded::{self, End, GradientSettings},
    statistics,
};
use planish_types::{DwellTime, Invalid, Surface, Tif, ToolPath};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    DwellError,
    columns::{self, Patch, Place},
    fft_operator::FftOperator,
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
    /// Dwell points up to which H is a matrix; above, products by FFT.
    pub max_dense_points: usize,
    /// Natural residual at which the gradient method ends, s.
    pub tolerance_s: f64,
    /// Most steps of the gradient method.
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
            // 288 MB of H; a factorisation takes seconds.
            max_dense_points: 6000,
            tolerance_s: 1e-6,
            max_iterations: 3000,
        }
    }
}

/// What was reached.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// `active-set` or `projected-gradient`.
    pub algorithm: &'static str,
    /// Factorisations, or gradient steps.
    pub iterations: usize,
    /// How it ended: `optimal`, `stagnated` (the objective changes no more) or
    /// `iteration-limit`.
    pub end: &'static str,
    /// Largest |t - clip(t - gradient / H_jj)|: by how much a dwell time would still move, s.
    pub kkt_residual_s: f64,
    /// Dwell points at their lower bound, dead and lifted ones not counted.
    pub at_lower_bound: usize,
    /// Dwell points at their upper bound.
    pub at_upper_bound: usize,
    /// Dwell points that do not reach the map, at their lower bound.
    pub dead: usize,
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
    for (name, value) in [("tikhonov", settings.tikhonov), ("smoothness", settings.smoothness)] {
        if !(value.is_finite() && value >= 0.0) {
            return Err(Invalid::whole(name, format!("is {value}"), "give a number >= 0").into());
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

    let problem =
        Problem { desired, tif, path, places, weight, lo, hi, guess: guess.as_deref(), settings };
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
    let fits = path.len() as f64 * pixels <= MAX_DENSE_ELEMENTS;
    let (solution, model) = if path.len() <= settings.max_dense_points && fits {
        problem.solve_dense()?
    } else {
        problem.solve_by_fft()?
    };
    Ok(problem.finish(solution, model)?)
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
    let hi = match settings.max_dwell {
        Some(bound) => of("max_dwell", bound)?,
        None => vec![f64::INFINITY; path.len()],
    };
    Ok((lo, hi))
}

/// (1) with everything that defines it.
struct Problem<'a> {
    desired: &'a Surface,
    tif: &'a Tif,
    path: &'a ToolPath,
    places: &'a [Vec<Place>],
    weight: Array2<f64>,
    lo: &'a [f64],
    hi: &'a [f64],
    guess: Option<&'a [f64]>,
    settings: &'a Settings,
}

/// What a solver knows beside the dwell times.
struct Model {
    algorithm: &'static str,
    /// Diagonal of H without regularisation; 0 where the tool does not reach the map.
    diagonal: Vec<f64>,
    /// B t.
    removal_nm: Array2<f64>,
    unreached_pixels: usize,
}

/// A column below this part of the largest diagonal element does not reach the map.
const DEAD: f64 = 1e-9;

impl Problem<'_> {
    /// z minus its weighted mean, 0 where the weight is 0.
    fn centred(&self) -> Array2<f64> {
        let z = self.desired.height_nm();
        let (mut sum, mut total) = (0.0, 0.0);
        Zip::from(z).and(&self.weight).for_each(|z, w| {
            if *w > 0.0 {
                sum += w * z;
                total += w;
            }
        });
        let mean = sum / total;
        Zip::from(z).and(&self.weight).map_collect(|z, w| if *w > 0.0 { z - mean } else { 0.0 })
    }

    /// H as a matrix, active set method.
    fn solve_dense(&self) -> Result<(bounded::Solution, Model), DwellError> {
        // W^1/2 B; what it removes where w = 0 is not needed.
        let mut patches = columns::patches(self.places, self.tif, self.desired.grid());
        let root = self.weight.mapv(f64::sqrt);
        patches.par_iter_mut().for_each(|p| {
            let w = p.of(&root).to_owned();
            p.rate_nm_per_s *= &w;
        });

        // b = B' w,  g = B' W (z - mean z)
        let of = |map: &Array2<f64>| -> Vec<f64> {
            patches.par_iter().map(|p| (&p.rate_nm_per_s * &p.of(map)).sum()).collect()
        };
        let b = of(&root);
        let mut g = of(&(self.centred() * &root));
        // H = B' W B - b b' / sum(w)
        let total = self.weight.sum();
        let n = self.path.len();
        let mut h = Array2::zeros((n, n));
        h.outer_iter_mut().into_par_iter().enumerate().for_each(|(j, mut row)| {
            for k in 0..=j {
                row[k] = patches[j].dot(&patches[k]) - b[j] * b[k] / total;
            }
        });
        for j in 0..n {
            for k in 0..j {
                h[[k, j]] = h[[j, k]];
            }
        }
        let diagonal: Vec<f64> = (0..n).map(|j| h[[j, j]]).collect();
        let largest = self.largest(&diagonal)?;
        let live: Vec<bool> = diagonal.iter().map(|d| *d > DEAD * largest).collect();

        self.regularise(largest, &mut g, |j, k, v| h[[j, k]] += v);
        // Dead columns keep their lower bound whatever the others do.
        let hi: Vec<f64> = (0..n).map(|j| if live[j] { self.hi[j] } else { self.lo[j] }).collect();
        // Without a guess gradient steps find most of the active set for the price of a few
        // factorisations.
        let scaled: Vec<f64> = (0..n).map(|j| if live[j] { h[[j, j]] } else { 0.0 }).collect();
        let apply = |t: &[f64]| h.dot(&ArrayView1::from(t)).to_vec();
        let gradient = |start: &[f64], max_iterations: usize| {
            let steps = GradientSettings {
                tolerance: self.settings.tolerance_s,
                max_iterations,
                stagnation: 0.0,
                offset: 0.0,
            };
            bounded::projected_gradient(apply, &scaled, &g, self.lo, &hi, start, &steps)
        };
        let start = match self.guess {
            Some(guess) => guess.to_vec(),
            None => gradient(self.lo, WARM_START).value,
        };
        let mut solution = bounded::active_set(&h, &g, self.lo, &hi, &start, MAX_FACTORISATIONS)
            .ok_or(DwellError::Singular { tikhonov: self.settings.tikhonov })?;
        let mut algorithm = "active-set";
        if solution.end != End::Optimal {
            algorithm = "projected-gradient";
            solution = gradient(&solution.value, self.settings.max_iterations);
        }
        drop(h);

        let mut removal_nm = Array2::zeros(self.weight.dim());
        let mut reached = Array2::zeros(self.weight.dim());
        for (p, t) in patches.iter().zip(&solution.value) {
            p.add_to(&mut removal_nm, *t);
            p.add_to(&mut reached, 1.0);
        }
        // Back from W^1/2 B t to B t.
        Zip::from(&mut removal_nm).and(&root).for_each(|r, w| {
            if *w > 0.0 {
                *r /= w;
            }
        });
        let model = Model {
            algorithm,
            diagonal: (0..n).map(|j| if live[j] { diagonal[j] } else { 0.0 }).collect(),
            unreached_pixels: self.unreached(&reached),
            removal_nm,
        };
        Ok((solution, model))
    }

    /// H t by spreading, FFT convolution and its adjoint; projected gradient.
    fn solve_by_fft(&self) -> Result<(bounded::Solution, Model), DwellError> {
        let n = self.path.len();
        let operator = FftOperator::new(self.places, self.tif, self.desired.grid());
        let z = self.centred();
        let b = operator.adjoint(&self.weight);
        let total = self.weight.sum();
        let mut g = operator.adjoint(&(&z * &self.weight));
        // diag H = (R^2)' w - b^2 / sum(w); the mean of R^2 stands for the square of the mean.
        let mut diagonal = operator.adjoint_of_squared_tif(&self.weight);
        for j in 0..n {
            diagonal[j] = (diagonal[j] - b[j] * b[j] / total).max(0.0);
        }
        let largest = self.largest(&diagonal)?;
        // D decides the weights of (1): the diagonal element itself, not the estimate.
        let strongest = (0..n).max_by(|a, b| diagonal[*a].total_cmp(&diagonal[*b])).unwrap_or(0);
        let scale = self.diagonal_element(strongest, total);
        for d in &mut diagonal {
            *d = if *d > DEAD * largest { *d } else { 0.0 };
        }

        let mut entries = Vec::new();
        self.regularise(scale, &mut g, |j, k, v| entries.push((j, k, v)));
        let mut scaled = diagonal.clone();
        for &(j, k, v) in &entries {
            if j == k && scaled[j] > 0.0 {
                scaled[j] += v;
            }
        }
        let apply = |t: &[f64]| {
            let removal = operator.apply(t);
            let mut h_t = operator.adjoint(&(removal * &self.weight));
            let piston = b.iter().zip(t).map(|(b, t)| b * t).sum::<f64>() / total;
            for j in 0..n {
                h_t[j] -= b[j] * piston;
            }
            for &(j, k, v) in &entries {
                h_t[j] += v * t[k];
            }
            h_t
        };
        let gradient = GradientSettings {
            tolerance: self.settings.tolerance_s,
            max_iterations: self.settings.max_iterations,
            stagnation: STAGNATION,
            offset: 0.5 * (&z * &z * &self.weight).sum(),
        };
        let solution = bounded::projected_gradient(
            apply,
            &scaled,
            &g,
            self.lo,
            self.hi,
            self.guess.unwrap_or(self.lo),
            &gradient,
        );
        let model = Model {
            algorithm: "projected-gradient",
            unreached_pixels: self.unreached(&operator.apply(&vec![1.0; n])),
            removal_nm: operator.apply(&solution.value),
            diagonal,
        };
        Ok((solution, model))
    }

    /// `H_jj` without regularisation, from the column itself.
    fn diagonal_element(&self, j: usize, total: f64) -> f64 {
        let p = columns::patch(&self.places[j], self.tif, self.desired.grid());
        let (mut sum, mut squares) = (0.0, 0.0);
        Zip::from(&p.rate_nm_per_s).and(p.of(&self.weight)).for_each(|r, w| {
            sum += w * r;
            squares += w * r * r;
        });
        squares - sum * sum / total
    }

    fn largest(&self, diagonal: &[f64]) -> Result<f64, DwellError> {
        let largest = diagonal.iter().copied().fold(0.0, f64::max);
        if largest > 0.0 {
            Ok(largest)
        } else {
            Err(DwellError::OutOfReach { points: diagonal.len() })
        }
    }

    fn unreached(&self, removal_nm: &Array2<f64>) -> usize {
        // An FFT leaves rounding where nothing is reached.
        let floor = 1e-12 * removal_nm.iter().copied().fold(0.0, f64::max);
        removal_nm.iter().zip(&self.weight).filter(|(r, w)| **w > 0.0 && **r <= floor).count()
    }

    /// alpha D I, alpha D lo, and beta D G' G with G t = q_{k+1} - q_k.
    fn regularise(&self, d: f64, g: &mut [f64], mut add: impl FnMut(usize, usize, f64)) {
        let alpha = self.settings.tikhonov * d;
        for j in 0..g.len() {
            add(j, j, alpha);
            g[j] += alpha * self.lo[j];
        }
        let beta = self.settings.smoothness * d;
        let lengths: Vec<f64> = (0..g.len()).map(|j| self.path.segment_length_mm(j)).collect();
        let mut sorted: Vec<f64> = lengths.iter().copied().filter(|l| *l > 0.0).collect();
        sorted.sort_by(f64::total_cmp);
        let Some(median) = sorted.get(sorted.len() / 2) else { return };
        let on = self.path.tool_on();
        for k in 1..g.len() {
            // A density needs a length (here at least 1 % of the median: shorter segments are
            // rests, whose density says nothing about their neighbours).
            let has_density = |j: usize| on[j] && lengths[j] > 0.01 * median;
            if has_density(k - 1) && has_density(k) {
                let (u, v) = (median / lengths[k - 1], median / lengths[k]);
                add(k - 1, k - 1, beta * u * u);
                add(k, k, beta * v * v);
                add(k - 1, k, -beta * u * v);
                add(k, k - 1, -beta * u * v);
            }
        }
    }

    fn finish(&self, solution: bounded::Solution, model: Model) -> Result<Solution, Invalid> {
        let t = &solution.value;
        let live = |j: &usize| model.diagonal[*j] > 0.0;
        let mut residual = self.desired.height_nm() - &model.removal_nm;
        Zip::from(&mut residual).and(&self.weight).for_each(|r, w| {
            if *w == 0.0 {
                *r = f64::NAN;
            }
        });
        let grid = self.desired.grid();
        let rms = statistics::statistics(residual.view()).map_or(0.0, |s| s.rms);
        let (x, y) = (grid.x.coordinates(), grid.y.coordinates());
        let report = Report {
            algorithm: model.algorithm,
            iterations: solution.iterations,
            end: match solution.end {
                End::Optimal => "optimal",
                End::Stagnated => "stagnated",
                End::IterationLimit => "iteration-limit",
            },
            kkt_residual_s: solution.natural_residual,
            at_lower_bound: (0..t.len()).filter(live).filter(|j| t[*j] <= self.lo[*j]).count(),
            at_upper_bound: (0..t.len()).filter(live).filter(|j| t[*j] >= self.hi[*j]).count(),
            dead: (0..t.len()).filter(|j| !live(j)).count(),
            unreached_pixels: model.unreached_pixels,
            model_rms_nm: rms,
            model_rms_detilted_nm: statistics::detilted_rms(residual.view(), &x, &y).unwrap_or(rms),
            total_time_s: t.iter().sum(),
        };
        Ok(Solution { dwell: DwellTime::new(solution.value)?, report })
    }
}

/// Most pixels of the map under the TIF: it may exceed the map, but not by orders of magnitude.
const MAX_TIF_PIXELS: f64 = 2.7e8;

/// Most elements of B that are stored (2 GB).
const MAX_DENSE_ELEMENTS: f64 = 2.5e8;

/// Gradient steps before the active set method.
const WARM_START: usize = 300;

/// The active set method takes 10 to 20 on measured problems; more means that it cycles.
const MAX_FACTORISATIONS: usize = 100;

/// The gradient method ends when 50 steps change the mean square of the residual by less than this
/// fraction, its RMS by half of it.
const STAGNATION: f64 = 2e-4;

impl Patch {
    /// The part of `map` under the patch.
    fn of<'m>(&self, map: &'m Array2<f64>) -> ArrayView2<'m, f64> {
        let ((r, c), (ny, nx)) = (self.origin, self.rate_nm_per_s.dim());
        map.slice(s![r..r + ny, c..c + nx])
    }

    fn add_to(&self, map: &mut Array2<f64>, factor: f64) {
        let ((r, c), (ny, nx)) = (self.origin, self.rate_nm_per_s.dim());
        map.slice_mut(s![r..r + ny, c..c + nx]).scaled_add(factor, &self.rate_nm_per_s);
    }

    /// Sum of the products where both patches are.
    pub(crate) fn dot(&self, other: &Self) -> f64 {
        let overlap = |a: usize, n: usize, b: usize, m: usize| (a.max(b), (a + n).min(b + m));
        let ((ny, nx), (my, mx)) = (self.rate_nm_per_s.dim(), other.rate_nm_per_s.dim());
        let (r0, r1) = overlap(self.origin.0, ny, other.origin.0, my);
        let (c0, c1) = overlap(self.origin.1, nx, other.origin.1, mx);
        if r0 >= r1 || c0 >= c1 {
            return 0.0;
        }
        let row = |p: &'_ Self, r: usize| -> std::ops::Range<usize> {
            let start = (r - p.origin.0) * p.rate_nm_per_s.ncols() + c0 - p.origin.1;
            start..start + (c1 - c0)
        };
        let (a, b) = (slice(&self.rate_nm_per_s), slice(&other.rate_nm_per_s));
        (r0..r1).map(|r| dot(&a[row(self, r)], &b[row(other, r)])).sum()
    }
}

fn slice(a: &Array2<f64>) -> &[f64] {
    a.as_slice().expect("patches are in C order")
}

/// Sum of products in eight independent sums, which a compiler turns into vectors.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let (a8, b8) = (a.chunks_exact(8), b.chunks_exact(8));
    let tail: f64 = a8.remainder().iter().zip(b8.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a8.zip(b8) {
        for k in 0..8 {
            sums[k] += a[k] * b[k];
        }
    }
    sums.iter().sum::<f64>() + tail
}
