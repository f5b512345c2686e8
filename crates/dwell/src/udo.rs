//! Universal dwell time optimisation: the adjoint image of the extended map, refined by its residual.
//!
//! ```text
//! b = B_e' (z_e - mean z_e),   gamma = cov(B b, z) / var(B b)                             (1)
//! t <- t + beta gamma (b - min b)      for the map, then for what remains of it            (2)
//! ```
//!
//! z_e is the map, extended beyond the aperture by half the size of the TIF, by polynomials (`extension.rs`). B_e is
//! the removal on the extended map. The TIF is centred first ([`planish_types::Tif::centred_on`]). gamma is the step
//! with the least RMS, in closed form: the objective is quadratic in it. The rounds (2) end when the RMS falls below a
//! threshold, when it rises (that step is discarded), or after a number of rounds.
//!
//! The published method then adds the same time to all dwell times, so that none is below the floor. If the dwell
//! points are not uniformly spaced, this changes the removed shape. Here the floor is in the model: z is the map minus
//! the removal by the floor, and t are the times above it. From the second round on the step is `b` itself, and t is
//! cut at 0, so that the time does not grow with every round.
//!
//! Source: T. Wang et al., Opt. Express 29 (2021) 38737, with the step in closed form and the odd
//! reflection as the ring of the extension.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `target` | (ny, nx) | nm |
//! | t | `t` | (n) | s |
//! | beta | `step` | - | 1 |

use ndarray::{Array2, Zip};
use planish_types::{End, progress};
use serde::Serialize;

use crate::{
    DwellError,
    extension::Extension,
    model::operator::Operator,
    problem::{DwellModel, Problem, Solution, check, check_steps},
    rifta::refuse_a_tif_larger_than_the_map,
};

/// Methods to keep the dwell times above their floor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Floor {
    /// The removal by the floor is part of the model.
    Model,
    /// All dwell times are lifted alike at the end, as published.
    Shift,
}

/// Settings of the universal dwell time optimisation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct UdoSettings {
    /// Method to keep the dwell times above their floor.
    pub floor: Floor,
    /// Fraction beta of the best step that is taken from the second round on; in (0, 1].
    pub step: f64,
    /// RMS of the residual at which the solver ends, nm; >= 0, 0 for no threshold.
    pub threshold_nm: f64,
    /// Largest number of rounds of (2) of the module.
    pub max_iterations: usize,
}

impl Default for UdoSettings {
    fn default() -> Self {
        // The source has a threshold of 1 nm, which on a good mirror is one round.
        Self { floor: Floor::Model, step: 0.5, threshold_nm: 0.0, max_iterations: 30 }
    }
}

/// Report of the universal dwell time optimisation.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct UdoReport {
    /// Reason for the end: `threshold` (reached), `stopped` (another round would raise the RMS), `iteration-limit`
    /// (the threshold was not reached), or `rounds-done` (there is no threshold, and all rounds were done).
    pub end: End,
    /// Number of rounds after the first adjoint image.
    pub iterations: usize,
    /// RMS of the residual (mean removed), nm, after the first adjoint image and after each round.
    pub rms_nm: Vec<f64>,
}

impl UdoReport {
    /// Returns the reason of a negative verdict; none if the steps ended as the settings ask for.
    pub fn negative(&self, settings: &UdoSettings) -> Option<String> {
        let threshold_nm = settings.threshold_nm;
        let last = self.rms_nm.last()?;
        let is_missed =
            self.end == End::IterationLimit || self.end == End::Stopped && threshold_nm > 0.0;
        if !is_missed {
            return None;
        }
        Some(format!("the threshold of {threshold_nm} nm is not reached: {last:.4} nm RMS"))
    }
}

/// Finds the dwell times by the adjoint image (1) and the rounds (2) of the module.
///
/// # Errors
/// Refuses settings out of range, a TIF that varies over the part or is larger than the map along x or y. Every solver
/// refuses weights and floors out of range, a floor that alone removes more than the PV of the map, a TIF that varies
/// in time, and a tool that does not reach the map.
pub fn solve(
    problem: &Problem<'_>,
    settings: &UdoSettings,
) -> Result<Solution<UdoReport>, DwellError> {
    check("step", settings.step, |s| s > 0.0 && s <= 1.0, "give a number above 0 and at most 1")?;
    check("threshold_nm", settings.threshold_nm, |t| t >= 0.0, "give a number >= 0")?;
    check_steps(settings.max_iterations)?;
    problem.tif.same_everywhere("udo")?;
    refuse_a_tif_larger_than_the_map(problem)?;
    let centred = problem.tif.centred_on(problem.desired)?;
    let problem = &problem.with(centred.as_ref());
    let model = DwellModel::new(problem)?;
    let image = Image::new(&model)?;
    let z = match settings.floor {
        Floor::Model => model.target(),
        Floor::Shift => problem.desired.height_nm().clone(),
    };
    let z = model.centred(&z);
    // First image: (1), (2) with the whole step.
    let b = image.adjoint(&z);
    let least = b.iter().copied().fold(f64::INFINITY, f64::min);
    let lifted: Vec<f64> = b.iter().map(|b| b - least).collect();
    let removal = image.removal(&lifted);
    let gamma = best_step(&model, &removal, &z);
    let mut t: Vec<f64> = lifted.iter().map(|b| gamma * b).collect();
    let mut residual = &z - &(removal * gamma);
    let mut rms_nm = vec![model.rms(&residual)];
    let mut end = if settings.threshold_nm > 0.0 { End::IterationLimit } else { End::RoundsDone };
    for _ in 0..settings.max_iterations {
        let now = rms_nm[rms_nm.len() - 1];
        if now < settings.threshold_nm {
            end = End::Threshold;
            break;
        }
        let b = image.adjoint(&model.centred(&residual));
        let least = match settings.floor {
            Floor::Model => 0.0,
            Floor::Shift => b.iter().copied().fold(f64::INFINITY, f64::min),
        };
        let lifted: Vec<f64> = b.iter().map(|b| b - least).collect();
        let step = settings.step * best_step(&model, &image.removal(&lifted), &residual);
        let next: Vec<f64> = t.iter().zip(&lifted).map(|(t, b)| (t + step * b).max(0.0)).collect();
        let after = &z - &image.removal(&next);
        let rms = model.rms(&after);
        if rms > now {
            end = End::Stopped;
            break;
        }
        rms_nm.push(rms);
        (t, residual) = (next, after);
        progress::done((rms_nm.len() - 1) as f64 / settings.max_iterations as f64);
    }
    let report = UdoReport { end, iterations: rms_nm.len() - 1, rms_nm };
    match settings.floor {
        Floor::Model => {
            let dwell =
                (0..t.len()).map(|j| model.lo[j] + if model.reached(j) { t[j] } else { 0.0 });
            model.finish(dwell.collect(), report)
        }
        Floor::Shift => {
            // t - min t + the floor; a floor that differs from point to point is met everywhere.
            let lift = (0..t.len()).map(|j| model.lo[j] - t[j]).fold(f64::NEG_INFINITY, f64::max);
            let dwell_s = t.iter().zip(&model.lo).map(|(t, lo)| (t + lift).max(*lo)).collect();
            // As published: what is not reached has its image of the extended map, too.
            model.finish_as_they_are(dwell_s, report)
        }
    }
}

/// Returns the step gamma of (1) of the module: the one >= 0 with the least RMS of `z - gamma m` (means removed), for
/// the maps m and z (ny, nx). It is 0 if m is constant.
fn best_step(model: &DwellModel<'_>, m: &Array2<f64>, z: &Array2<f64>) -> f64 {
    let m = model.centred(m);
    let mut cov = 0.0;
    let mut var = 0.0;
    Zip::from(&m).and(z).and(&model.weight).for_each(|m, z, w| {
        if *w > 0.0 {
            cov += w * m * z;
            var += w * m * m;
        }
    });
    if var > 0.0 { (cov / var).max(0.0) } else { 0.0 }
}

/// The extended map, and the removal operator B_e on it.
struct Image {
    extension: Extension,
    operator: Operator,
}

impl Image {
    fn new(model: &DwellModel<'_>) -> Result<Self, DwellError> {
        let Problem { desired, tif, .. } = model.problem;
        let grid = desired.grid();
        let [half_x, half_y] = tif.half_size_mm();
        let half = half_x.max(half_y);
        let steps_mm = [grid.y.step_mm(), grid.x.step_mm()];
        let border = steps_mm.map(|step_mm| (half / step_mm).floor().max(1.0));
        let valid = model.weight.mapv(|w| w > 0.0);
        // The outermost pixels are the ring, on every side: where it is missing on one, the polynomials run away there.
        let ring_mm = ((border[0] - 0.5) * steps_mm[0]).min((border[1] - 0.5) * steps_mm[1]);
        let extension = Extension::new(grid, &valid, border.map(|b| b as usize), ring_mm)?;
        let operator = Operator::new(&model.places, tif, &extension.grid)?;
        Ok(Self { extension, operator })
    }

    /// Returns the adjoint image b of (1) of the module (n), for a map z (ny, nx).
    fn adjoint(&self, z: &Array2<f64>) -> Vec<f64> {
        let mut z = self.extension.rise(z);
        let mean = z.sum() / z.len() as f64;
        z -= mean;
        self.operator.adjoint(&z)
    }

    /// Returns the removal B t on the pixels of the map (ny, nx), nm, for dwell times t (n), s.
    fn removal(&self, t: &[f64]) -> Array2<f64> {
        self.extension.inner(&self.operator.apply(t))
    }
}
