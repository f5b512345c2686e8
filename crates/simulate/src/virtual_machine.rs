//! Virtual machine for tests of learning: a run with hidden errors, and the map that is measured after it.
//!
//! ```text
//! true before = measured before + m_1
//! true after  = true before - M(run)
//! measured after = true after - m_2
//! ```
//!
//! M(run) is the removal of the motion with one draw of the errors of a process ([`Runs`]). m_1 and m_2 are the
//! errors of the two measurements (`map_noise` and `map_low_order`). They are drawn independently, so that the
//! difference of the two maps has twice the variance of either. A reader of the measured map sees neither. The truth
//! is written elsewhere, for comparison with what is learnt.
//!
//! Every error has its own random numbers, by its index in the error budget: an error added at the end of the file
//! changes none of the others. The machine of a seed runs more than once ([`VirtualMachineSettings::run`]). An error of
//! one number is the same in all of its runs; noise is new in each. The map after a run is the map before the next one,
//! with the same error of its measurement. So the measurements of a campaign are counted: run k is between the
//! measurements k - 1 and k, and [`measure`] makes the first of a mirror.

use ndarray::Array2;
use planish_types::{
    Invalid, Removal, Surface, Tif, Trajectory,
    outcome::virtual_machine::{Drawn, Hidden},
    progress,
};
use rand::Rng;
use serde::Serialize;

use crate::{
    deviation::Deviation,
    error_budget::{Distribution, Effect, ErrorBudget},
    runs::Runs,
    sample::{draw, legendre_terms, low_orders, sample, stream, white},
    tool::moved,
};

/// Number of streams of random numbers reserved for one error. It uses one for the run, and one each for the
/// measurements of even and of odd number. With fewer than three, two errors share a stream.
const STREAMS_PER_ERROR: u64 = 4;

/// Distance between the streams of consecutive runs, and of consecutive pairs of measurements, of one machine.
/// Smaller: the streams of many errors overlap those of the next run.
const STREAMS_PER_RUN: u64 = 1 << 32;

/// Largest number of a run of one machine; larger ones are refused. It keeps the number of the stream within 64 bits.
const MOST_RUNS: u64 = 1_000_000;

/// Settings of the virtual machine.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct VirtualMachineSettings {
    /// Random seed of the hidden errors.
    pub seed: u64,
    /// Number of the run of the machine with this seed, from 1.
    pub run: u64,
    /// True if rate, position, width and shape of the tool are known and corrected exactly; all other errors stay.
    pub known: bool,
    /// True if errors change the TIF as sampled, with the noise and the border of its measurement, and not that of
    /// [`crate::tool`].
    pub tif_as_sampled: bool,
}

/// A run of the virtual machine and its measurement.
#[derive(Clone, Debug)]
pub struct VirtualRun {
    /// Map that is measured after the run; invalid (NaN) where the map before is.
    pub measured: Surface,
    /// True removal of the run, and true residual after it.
    pub removal: Removal,
    /// Hidden errors of the run.
    pub hidden: Hidden,
}

/// Runs `trajectory` on the mirror with the measured map `before`, with one draw of the errors of `process`.
///
/// # Errors
///
/// Refuses the number of a run out of its range, a tool and sizes of errors that [`Runs::check_sizes`] refuses, and
/// what [`Runs::new`] refuses.
pub fn run(
    trajectory: &Trajectory,
    tif: &Tif,
    before: &Surface,
    process: &ErrorBudget,
    settings: &VirtualMachineSettings,
) -> Result<VirtualRun, Invalid> {
    check_run(settings.run)?;
    let moved = moved(tif, before.grid(), settings.tif_as_sampled)?;
    let runs = progress::part(0, 2, || Runs::new(trajectory, tif, &moved.tif, before.grid()))?;
    runs.check_sizes(process)?;
    let known = if settings.known { without_what_is_learnt(process) } else { process.clone() };
    progress::part(1, 2, || draw_run(&runs, before, &known, settings.seed, settings.run))
}

fn check_run(run: u64) -> Result<(), Invalid> {
    if (1..=MOST_RUNS).contains(&run) {
        return Ok(());
    }
    Err(Invalid::whole("run", format!("is {run}"), format!("give 1 to {MOST_RUNS}")))
}

/// Returns the process with size 0 for the errors that maps can determine; every error keeps its index.
fn without_what_is_learnt(process: &ErrorBudget) -> ErrorBudget {
    let mut process = process.clone();
    for error in &mut process.errors {
        if matches!(error.effect, Effect::Scalar(effect) if effect.is_learnt()) {
            error.size = 0.0;
            error.stated.size = 0.0;
        }
    }
    process
}

/// Draws the map that is measured before run number `run` of the machine with the seed `seed`. `mirror` is the true
/// map, and only the errors of the map in `process` act.
///
/// # Errors
///
/// Refuses the number of a run out of its range.
pub fn measure(
    mirror: &Surface,
    process: &ErrorBudget,
    seed: u64,
    run: u64,
) -> Result<Surface, Invalid> {
    check_run(run)?;
    // true before = measured before + m_1
    Surface::new(
        *mirror.grid(),
        mirror.height_nm() - &measurement_error(mirror, process, seed, run - 1),
    )
}

/// Executes a plan as [`run`] does, with all errors of `process`; `runs` holds the preparation that is the same for all
/// seeds. It checks neither the number `run` (from 1) nor the sizes of the errors.
///
/// # Errors
///
/// Fails as [`Runs::removal_nm`] does.
pub fn draw_run(
    runs: &Runs<'_>,
    before: &Surface,
    process: &ErrorBudget,
    seed: u64,
    run: u64,
) -> Result<VirtualRun, Invalid> {
    let mut deviation = Deviation::default();
    let mut errors = Vec::with_capacity(process.errors.len());
    for (i, error) in process.errors.iter().enumerate() {
        let first_stream = STREAMS_PER_ERROR * i as u64;
        let mut value = None;
        match error.effect {
            Effect::Scalar(effect) => {
                let eta = draw(error.stated.distribution, &mut stream(seed, first_stream));
                deviation.add(effect, eta * error.size);
                value = Some(eta * error.stated.size);
            }
            Effect::Noise(noise) => {
                let mut rng = stream(seed, first_stream + (run - 1) * STREAMS_PER_RUN);
                sample(noise, error.size, &runs.motion, &mut rng, &mut deviation);
            }
            Effect::MapLowOrder { .. } | Effect::MapNoise => {}
        }
        let stated = &error.stated;
        errors.push(Drawn { kind: stated.kind.name(), value, unit: stated.unit.clone() });
    }
    let removal = runs.removal_nm(&deviation)?;
    let [m_1, m_2] = [run - 1, run].map(|k| measurement_error(before, process, seed, k));
    // true before = measured before + m_1, true after = true before - M, measured after = true after - m_2
    let true_before = Surface::new(*before.grid(), before.height_nm() + &m_1)?;
    let removal = Removal::new(&true_before, removal)?;
    let measured = Surface::new(*before.grid(), removal.residual().height_nm() - &m_2)?;
    Ok(VirtualRun { measured, removal, hidden: Hidden { truth: deviation.truth(), errors } })
}

/// Returns the error of measurement `number` of the machine with this seed, shape (ny, nx), nm.
fn measurement_error(map: &Surface, process: &ErrorBudget, seed: u64, number: u64) -> Array2<f64> {
    let mut wrong = Array2::zeros(map.grid().shape());
    for (i, error) in process.errors.iter().enumerate() {
        if matches!(error.effect, Effect::MapLowOrder { .. } | Effect::MapNoise) {
            let of_error = STREAMS_PER_ERROR * i as u64 + 1 + number % 2;
            let mut rng = stream(seed, of_error + number / 2 * STREAMS_PER_RUN);
            wrong += &map_error(error.effect, error.size, map, &mut rng);
        }
    }
    wrong
}

/// Draws the error of one measurement of `map` that one error of the budget causes, shape (ny, nx), nm. `size` is in
/// nm.
fn map_error(effect: Effect, size: f64, map: &Surface, rng: &mut impl Rng) -> Array2<f64> {
    let shape = map.grid().shape();
    match effect {
        Effect::MapNoise => white(size, shape, rng),
        Effect::MapLowOrder { degree } => {
            let terms = legendre_terms(map.grid(), &low_orders(degree));
            let each = size / (terms.len() as f64).sqrt();
            let mut sum = Array2::zeros(shape);
            for term in terms {
                sum.scaled_add(each * draw(Distribution::Normal, rng), &term);
            }
            sum
        }
        Effect::Scalar(_) | Effect::Noise(_) => Array2::zeros(shape),
    }
}
