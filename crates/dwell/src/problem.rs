//! Input of every solver, and the output that all solvers have in common.
//!
//! ```text
//! z' = z - B lo        the floor is in the model: what remains for t' = t - lo >= 0        (1)
//! A  = P W^1/2 B,   P = I - q q',   q = W^1/2 1 / |W^1/2 1|      the piston is free         (2)
//! ```
//!
//! Least-squares solvers without bounds find `t = t_ref + u`, deviations u from reference dwell times `t_ref = c l_j /
//! l` (l_j the length of segment j, l their median) with a level c, s. Both the map and the level enter linearly,
//!
//! ```text
//! t = a + c b,   a from z,   b = l_j / l + (solution for z = -B l_j / l)                    (3)
//! ```
//!
//! so the least level c at which no dwell time is below its floor follows from two solutions. A piston of the map in
//! place of the level would not do: where the tool hardly reaches the map, it asks for absurd times.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `desired` | (ny, nx) | nm |
//! | w | `weight` | (ny, nx) | 1 |
//! | B | `operator` | (pixels, n) | nm/s |
//! | lo | `lo` | (n) | s |

use std::borrow::Cow;

use ndarray::{Array2, ArrayView2, Zip, s};
use planish_numerics::{parallel, statistics};
use planish_types::{
    DwellTime, Invalid, OnLattice, PARTS_TOLERANCE, Surface, Tif, TifLattice, ToolPath,
    plausible::{self, Rms},
};

use serde::Serialize;

use crate::{
    DwellError,
    bounds::{self, Bound, pixel_weights},
    continuation::Continuation,
    model::{
        FFT_ROUNDING, ROWS_PER_TASK, UNREACHED_FRACTION,
        columns::{Columns, ToolPlace},
        operator::Operator,
    },
    objective::{REST_FRACTION, median_length_mm},
};

/// Input of every solver: a desired removal, a tool, a path, and the least dwell times.
#[derive(Clone, Copy, Debug)]
pub struct Problem<'a> {
    /// Desired removal, a map of heights, nm.
    pub desired: &'a Surface,
    /// TIF of the tool.
    pub tif: &'a Tif,
    /// Tool path along which the dwell times are found.
    pub path: &'a ToolPath,
    /// Weights of the pixels (ny, nx) >= 0. Without them the weights follow from the standard deviations of the map, if
    /// it has any; otherwise every valid pixel counts 1.
    pub weight: Option<&'a Array2<f64>>,
    /// Columns of the removal model: the tool stands at the dwell point, or moves along the segment.
    pub columns: Columns,
    /// Lower bound of every dwell time, called the floor.
    pub min_dwell: Bound,
}

impl<'a> Problem<'a> {
    /// Returns the same problem with the map and the TIF of `centred` (from [`Tif::centred_on`]) in place of its own;
    /// unchanged if `centred` is `None`.
    pub(crate) fn with(&self, centred: Option<&'a (Surface, Tif)>) -> Self {
        centred.map_or(*self, |(desired, tif)| Self { desired, tif, ..*self })
    }
}

/// Returns the RMS of the desired map before the plan, over the valid pixels whose weight is not 0. If no such pixel
/// exists, all valid pixels count. Weights of another shape do not fail here; the solver refuses them later.
pub fn rms_before(desired: &Surface, weight: Option<&Array2<f64>>) -> Rms {
    let Some(weight) = weight else { return Rms::of_surface(desired) };
    let mut height = desired.height_nm().clone();
    height.iter_mut().zip(weight).filter(|(_, w)| **w == 0.0).for_each(|(z, _)| *z = f64::NAN);
    let counted = Surface::new(*desired.grid(), height);
    counted.map_or_else(|_| Rms::of_surface(desired), |surface| Rms::of_surface(&surface))
}

/// Dwell times, their effect, and the report of the solver.
#[derive(Clone, Debug)]
pub struct Solution<R> {
    /// Dwell times along the path.
    pub dwell: DwellTime,
    /// Effect of the dwell times, which every solver reports.
    pub outcome: Outcome,
    /// Report of the solver that found them.
    pub report: R,
}

/// Effect of the dwell times, by the removal model of the solver: not by the independent prediction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// Form of the removal operator: `columns` (exact) or `fft` (large problems).
    pub operator: &'static str,
    /// RMS (mean removed) of the residual, nm.
    pub model_rms_nm: f64,
    /// RMS of the residual without its best plane, nm.
    pub model_rms_detilted_nm: f64,
    /// Sum of the dwell times, s.
    pub total_time_s: f64,
    /// Number of reached dwell points whose dwell time is at the floor.
    pub at_floor: usize,
    /// Number of dwell points that do not reach the map, those with the tool off included. Most solvers continue the
    /// dwell time per length of the neighbours there.
    pub unreached_points: usize,
    /// Number of valid pixels with a weight above 0 that no dwell point reaches: nothing can be corrected there.
    pub unreached_pixels: usize,
    /// Mean removal by the least allowed dwell times alone, nm.
    pub floor_removal_nm: f64,
    /// Lattice of the map on which the TIF was sampled anew; left out where the samples are its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tif_lattice: Option<TifLattice>,
}

impl Outcome {
    /// Returns the reason for which the dwell times are no plan although the solver ended well; `None` if there is no
    /// such reason. Example: the residual is larger than the map, whose RMS is `before`.
    pub fn drawback(&self, before: Rms) -> Option<String> {
        let after = Rms { rms_nm: self.model_rms_nm, detilted_nm: self.model_rms_detilted_nm };
        plausible::drawback(before, after, self.total_time_s)
    }
}

/// A problem prepared for a solver: weights of the pixels, floor of the dwell times ((1) of the module), and removal
/// operator B.
pub(crate) struct DwellModel<'a> {
    pub problem: Problem<'a>,
    /// TIF of the problem, sampled anew if its samples are not on the lattice of the map.
    pub tif: Cow<'a, Tif>,
    lattice: TifLattice,
    pub places: Vec<Vec<ToolPlace>>,
    pub operator: Operator,
    /// Weights of the pixels (ny, nx), zero on invalid pixels.
    pub weight: Array2<f64>,
    pub lo: Vec<f64>,
    /// Removal B lo by the floor alone (ny, nx), nm; `None` if no floor is above 0.
    floor_removal: Option<Array2<f64>>,
    /// Sensitivity of every dwell point (n), nm/s: the sum over the pixels of its removal rate times their weights, B'
    /// w.
    pub sensitivity: Vec<f64>,
    unreached_below: f64,
    /// Length of every segment over their median, l_j / l (n); at least [`REST_FRACTION`].
    pub shape: Vec<f64>,
}

/// Largest number of steps that the solvers accept as their limit. Larger: a mistyped limit runs for days. Smaller:
/// long runs are refused. Chosen: no plan needs a thousandth of it.
const MAX_STEPS: usize = 1_000_000;

/// Refuses a limit of steps above [`MAX_STEPS`].
pub(crate) fn check_steps(steps: usize) -> Result<(), Invalid> {
    if steps <= MAX_STEPS {
        return Ok(());
    }
    let remedy = format!("give at most {MAX_STEPS}");
    Err(Invalid::whole("max_iterations", format!("is {steps}"), remedy))
}

impl<'a> DwellModel<'a> {
    /// Makes the model for a solver.
    ///
    /// # Errors
    /// Refuses what [`Self::with_any_floor`] refuses, and a floor that alone removes more on average than the PV of the
    /// map.
    pub fn new(problem: &Problem<'a>) -> Result<Self, DwellError> {
        let model = Self::with_any_floor(problem)?;
        model.refuse_a_floor_above_the_map()?;
        Ok(model)
    }

    /// Makes the model for dwell times that follow a rule without an optimisation; the removal by the floor may have
    /// any size.
    ///
    /// # Errors
    /// Refuses a TIF that varies in time, covers too many pixels or cannot be sampled on the lattice of the map.
    /// Refuses weights and floors out of range, and a tool that does not reach the map.
    pub fn with_any_floor(problem: &Problem<'a>) -> Result<Self, DwellError> {
        Self::with_sensitivity(problem, Operator::adjoint)
    }

    /// Makes the model for solvers whose unknown is a map of dwell times. They only need to know whether a dwell point
    /// reaches the map. With the FFT, a point whose TIF ends a few pixels before the map counts as reached, too.
    ///
    /// # Errors
    /// Refuses what [`Self::new`] refuses.
    pub fn for_map(problem: &Problem<'a>) -> Result<Self, DwellError> {
        let model = Self::with_sensitivity(problem, Operator::adjoint_with_spill)?;
        model.refuse_a_floor_above_the_map()?;
        Ok(model)
    }

    fn with_sensitivity(
        problem: &Problem<'a>,
        adjoint: impl Fn(&Operator, &Array2<f64>) -> Vec<f64>,
    ) -> Result<Self, DwellError> {
        let Problem { desired, tif, path, weight, columns, min_dwell } = *problem;
        tif.same_at_all_times("this solver")?;
        let OnLattice { tif, lattice } = tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?;
        let weight = pixel_weights(desired, weight)?;
        let lo = bounds::lower(path, min_dwell)?;
        let places = columns.places(path, &tif);
        let operator = Operator::new(&places, &tif, desired.grid())?;
        let sensitivity = adjoint(&operator, &weight);
        let largest = sensitivity.iter().copied().fold(0.0, f64::max);
        if largest <= FFT_ROUNDING * tif.peak_nm_per_s() {
            return Err(DwellError::OutOfReach { points: path.len() });
        }
        let has_floor = lo.iter().any(|t| *t > 0.0);
        let floor_removal = if has_floor { Some(operator.apply(&lo)) } else { None };
        Ok(Self {
            problem: *problem,
            tif,
            lattice,
            places,
            operator,
            weight,
            lo,
            floor_removal,
            unreached_below: UNREACHED_FRACTION * largest,
            sensitivity,
            shape: shape(path),
        })
    }

    /// Refuses a floor whose removal is larger on average than the PV of the map over the counted pixels.
    fn refuse_a_floor_above_the_map(&self) -> Result<(), Invalid> {
        let Some(floor_removal) = &self.floor_removal else { return Ok(()) };
        let (low, high) = self.range(self.problem.desired.height_nm());
        let floor = self.mean(floor_removal);
        let pv = high - low;
        if floor <= pv {
            return Ok(());
        }
        let worst = (0..self.lo.len()).rev().max_by(|a, b| self.lo[*a].total_cmp(&self.lo[*b]));
        let j = worst.expect("a path has a dwell point");
        let problem = format!(
            "is {} s; the floor alone removes {floor:.4} nm on average, more than the {pv:.4} nm from \
             the lowest to the highest pixel of the map",
            self.lo[j]
        );
        let path = self.problem.path;
        let remedy = match median_length_mm(path) {
            Some(step) => format!(
                "the path has {} dwell points, {step:.3} mm apart: give a least dwell time per mm \
                 (`min_dwell_s_per_mm`), a path with longer steps or a wider pitch, or a lower floor",
                path.len()
            ),
            None => "lower the least dwell time".to_string(),
        };
        Err(Invalid::at_index("min_dwell", j, problem, remedy))
    }

    /// Calls `evaluate` in parallel with bands of rows of `map` and the weights there. Returns the results in the order
    /// of the bands.
    fn by_bands<T: Send + Sync>(
        &self,
        map: &Array2<f64>,
        evaluate: impl Fn(ArrayView2<f64>, ArrayView2<f64>) -> T + Sync,
    ) -> Vec<T> {
        parallel::map(map.nrows().div_ceil(ROWS_PER_TASK), &|band| {
            let from = band * ROWS_PER_TASK;
            let rows = s![from..(from + ROWS_PER_TASK).min(map.nrows()), ..];
            evaluate(map.slice(rows), self.weight.slice(rows))
        })
    }

    /// Returns the smallest and the largest value of `map` (ny, nx) where the weight is not zero.
    pub fn range(&self, map: &Array2<f64>) -> (f64, f64) {
        let none = (f64::INFINITY, f64::NEG_INFINITY);
        let bands = self.by_bands(map, |z, w| {
            Zip::from(z).and(w).fold(none, |(low, high), z, w| {
                if *w > 0.0 { (low.min(*z), high.max(*z)) } else { (low, high) }
            })
        });
        bands.into_iter().fold(none, |a, b| (a.0.min(b.0), a.1.max(b.1)))
    }

    /// Returns the weighted mean of a map (ny, nx), in its unit.
    pub fn mean(&self, map: &Array2<f64>) -> f64 {
        let bands = self.by_bands(map, |z, w| {
            Zip::from(z).and(w).fold((0.0, 0.0), |(sum, weight), z, w| {
                if *w > 0.0 { (sum + w * z, weight + w) } else { (sum, weight) }
            })
        });
        let (sum, weight) = bands.iter().fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
        sum / weight
    }

    /// Returns the lowest value of a map (ny, nx) where the weight is not zero, after the lowest `fraction` of these
    /// pixels is left out.
    pub fn lowest(&self, map: &Array2<f64>, fraction: f64) -> f64 {
        statistics::lowest(map.view(), Some(self.weight.view()), fraction)
            .expect("a model has a pixel that counts")
    }

    /// Returns a map (ny, nx) minus its weighted mean; 0 where the weight is 0.
    pub fn centred(&self, map: &Array2<f64>) -> Array2<f64> {
        let mean = self.mean(map);
        Zip::from(map).and(&self.weight).map_collect(|z, w| if *w > 0.0 { z - mean } else { 0.0 })
    }

    /// Returns the weighted RMS of a map (ny, nx) minus its mean, in the unit of the map.
    pub fn rms(&self, map: &Array2<f64>) -> f64 {
        let z = self.centred(map);
        ((&z * &z * &self.weight).sum() / self.weight.sum()).sqrt()
    }

    /// Returns the removal that the dwell times above the floor have to make, `z - B lo` of (1) of the module: (ny,
    /// nx), nm; 0 where the weight is 0.
    pub fn target(&self) -> Array2<f64> {
        let z = Zip::from(self.problem.desired.height_nm()).and(&self.weight);
        match &self.floor_removal {
            Some(floor) => z.and(floor).map_collect(|z, w, f| if *w > 0.0 { z - f } else { 0.0 }),
            None => z.map_collect(|z, w| if *w > 0.0 { *z } else { 0.0 }),
        }
    }

    /// Returns true if dwell point j reaches the map. At the rim of a tool, the interpolation of steep flanks and the
    /// noise of a measured TIF may add more material than the tool removes; this counts as within reach, too.
    pub fn reached(&self, j: usize) -> bool {
        self.sensitivity[j].abs() > self.unreached_below
    }

    /// Returns the weighted removal without piston, `A t` of (2) of the module, nm, for dwell times t (n), s: one
    /// element per pixel, row by row.
    pub fn weighted(&self, t: &[f64]) -> Vec<f64> {
        self.project(&self.operator.apply(t))
    }

    /// Returns `P W^1/2 z` of (2) of the module for a map z (ny, nx): its deviation from the mean times the root of
    /// the weight, one element per pixel, row by row.
    pub fn project(&self, map: &Array2<f64>) -> Vec<f64> {
        // P W^1/2 z = W^1/2 (z - mean z)
        let centred = self.centred(map);
        centred.iter().zip(&self.weight).map(|(z, w)| w.sqrt() * z).collect()
    }

    /// Returns the adjoint product `A' y` of (2) of the module (n), for y with one element per pixel, row by row.
    pub fn weighted_adjoint(&self, y: &[f64]) -> Vec<f64> {
        let y = ArrayView2::from_shape(self.weight.dim(), y).expect("one per pixel");
        // W^1/2 P y = W^1/2 (y - W^1/2 sum(W^1/2 y) / sum(w))
        let root = self.weight.mapv(f64::sqrt);
        let mean = (&root * &y).sum() / self.weight.sum();
        self.operator.adjoint(&((&y - &(&root * mean)) * &root))
    }

    /// Returns `B' W P z` (n) of (2) of the module for a map z (ny, nx): the right-hand side of the normal equations.
    pub fn gradient(&self, map: &Array2<f64>) -> Vec<f64> {
        self.operator.adjoint(&(self.centred(map) * &self.weight))
    }

    /// Returns the dwell times `a + c b` of (3) of the module. The level c >= 0 is the least one at which no reached
    /// dwell time with b > 0.1 is below its floor. Others that are still below are set to their floor and counted.
    /// Unreached dwell points are set to their floor, but not counted.
    pub fn levelled(&self, a: &[f64], b: &[f64]) -> Levelled {
        let n = self.lo.len();
        let level = (0..n)
            .filter(|j| self.reached(*j) && b[*j] > 0.1)
            .map(|j| (self.lo[j] - a[j]) / b[j])
            .fold(f64::NEG_INFINITY, f64::max)
            .max(0.0);
        let mut clipped = 0;
        let dwell_s = (0..n)
            .map(|j| {
                let t = a[j] + level * b[j];
                if !self.reached(j) {
                    return self.lo[j];
                }
                // The one that decides the level is at its floor but for rounding.
                if t < self.lo[j] - 1e-9 * level.max(1.0) {
                    clipped += 1;
                }
                t.max(self.lo[j])
            })
            .collect();
        Levelled { dwell_s, level_s: level, clipped }
    }

    /// Counts the pixels with a weight above 0 at which one second at every dwell point would remove no more than
    /// rounding. `removal` is the removal by the dwell times `dwell_s`, nm.
    fn unreached(&self, removal: &Array2<f64>, dwell_s: &[f64]) -> usize {
        // With R >= 0 what is removed in B t is at most max(t) of what is in B 1, and that at most
        // 2 n peak (Keys' interpolation stays below 1.3 peak): most maps need no second removal.
        let rate = self.problem.tif.rate_nm_per_s();
        let longest = dwell_s.iter().copied().fold(0.0, f64::max);
        let most = self.range(removal).1.max(0.0);
        let least_nm = (2.0
            * FFT_ROUNDING
            * dwell_s.len() as f64
            * self.problem.tif.peak_nm_per_s()
            * longest)
            .max(1e-9 * most);
        if rate.iter().all(|r| *r >= 0.0) && self.pixels_up_to(removal, least_nm) == 0 {
            return 0;
        }
        let ones = self.operator.apply(&vec![1.0; dwell_s.len()]);
        self.pixels_up_to(&ones, FFT_ROUNDING * ones.iter().copied().fold(0.0, f64::max))
    }

    /// Counts the pixels with a weight above 0 at which a map (ny, nx) is at most `limit`.
    fn pixels_up_to(&self, map: &Array2<f64>, limit: f64) -> usize {
        let counts = self.by_bands(map, |z, w| {
            z.iter().zip(w).filter(|(z, w)| **w > 0.0 && **z <= limit).count()
        });
        counts.iter().sum()
    }

    /// Returns the solution with these dwell times (n), s. Unreached dwell points get the dwell time per length of
    /// their neighbours ([`Continuation`]), but not less than their floor.
    ///
    /// # Errors
    /// Refuses dwell times that are negative or not finite.
    pub fn finish<R>(&self, mut dwell_s: Vec<f64>, report: R) -> Result<Solution<R>, DwellError> {
        let hi = vec![f64::INFINITY; dwell_s.len()];
        let unreached = Continuation::new(self.problem.path, |j| self.reached(j));
        unreached.apply_within(&mut dwell_s, &self.lo, &hi);
        self.finish_as_they_are(dwell_s, report)
    }

    /// Returns the solution with exactly these dwell times (n), s.
    ///
    /// # Errors
    /// Refuses dwell times that are negative or not finite.
    pub fn finish_as_they_are<R>(
        &self,
        dwell_s: Vec<f64>,
        report: R,
    ) -> Result<Solution<R>, DwellError> {
        let removal = self.operator.apply(&dwell_s);
        let residual = Zip::from(self.problem.desired.height_nm())
            .and(&removal)
            .and(&self.weight)
            .map_collect(|z, r, w| if *w > 0.0 { z - r } else { f64::NAN });
        let grid = self.problem.desired.grid();
        let (x, y) = (grid.x.coordinates(), grid.y.coordinates());
        let rms = statistics::statistics(residual.view()).map_or(0.0, |s| s.rms);
        let n = dwell_s.len();
        let outcome = Outcome {
            operator: self.operator.name(),
            model_rms_nm: rms,
            model_rms_detilted_nm: statistics::detilted_rms(residual.view(), &x, &y).unwrap_or(rms),
            total_time_s: dwell_s.iter().sum(),
            at_floor: (0..n).filter(|j| self.reached(*j) && dwell_s[*j] <= self.lo[*j]).count(),
            unreached_points: (0..n).filter(|j| !self.reached(*j)).count(),
            unreached_pixels: self.unreached(&removal, &dwell_s),
            floor_removal_nm: self.floor_removal.as_ref().map_or(0.0, |f| self.mean(f)),
            tif_lattice: self.lattice.if_anew(),
        };
        Ok(Solution { dwell: DwellTime::new(dwell_s)?, outcome, report })
    }
}

/// Dwell times (n), s, raised to their floor by a common level of dwell ((3) of the module).
pub(crate) struct Levelled {
    pub dwell_s: Vec<f64>,
    /// Level of dwell c of (3) of the module, s.
    pub level_s: f64,
    /// Number of reached dwell times below their floor at this level, which were set to it.
    pub clipped: usize,
}

/// Returns the length of every segment over their median, l_j / l (n), at least [`REST_FRACTION`]; 1 for all if no
/// segment has a length.
fn shape(path: &ToolPath) -> Vec<f64> {
    match median_length_mm(path) {
        Some(median) => (0..path.len())
            .map(|j| (path.segment_length_mm(j) / median).max(REST_FRACTION))
            .collect(),
        None => vec![1.0; path.len()],
    }
}

/// Refuses a setting that is not finite or not in its `range`; the message names it, and gives the remedy.
pub(crate) fn check(
    name: &'static str,
    value: f64,
    range: impl Fn(f64) -> bool,
    remedy: &str,
) -> Result<(), Invalid> {
    if value.is_finite() && range(value) {
        Ok(())
    } else {
        Err(Invalid::whole(name, format!("is {value}"), remedy))
    }
}
