//! A machine to learn on: a run with hidden errors, and the map that is measured after it.
//!
//! ```text
//! true before = measured before + m_1
//! true after  = true before - R(run)
//! measured after = true after - m_2
//! ```
//!
//! R(run) is what the motion removes with one draw of the errors of a process ([`Runs`]); m_1 and m_2 are what the
//! two measurements have wrong (`map_noise` and `map_low_order`), drawn independently of each other, so that the
//! difference of the two maps has twice the variance of either. Whoever reads the measured map sees neither; the truth
//! goes elsewhere, to be compared with what is learnt.
//!
//! Every error has random numbers of its own, by its place in the process file: an error added at the end of the file
//! changes none of the others.

use ndarray::Array2;
use planish_types::{Invalid, Removal, Surface, Tif, Trajectory};
use rand::Rng;
use serde::Serialize;

use crate::{
    deviation::{Deviation, Truth},
    process::{Distribution, Effect, Process},
    runs::Runs,
    sample::{draw, legendre_terms, low_orders, sample, stream, white},
    tool::smooth,
};

/// Streams of random numbers of one error: of the run, of the map before, and of the map after.
const STREAMS_PER_ERROR: u64 = 4;

/// How the machine is made.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// Random seed of what is hidden.
    pub seed: u64,
    /// Whether errors move the TIF with the noise and the border of its measurement, and not [`crate::tool`]'s.
    pub tif_as_sampled: bool,
}

/// What one error was in this run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Drawn {
    /// Its kind.
    pub kind: String,
    /// The number that it drew, in `unit`; `None` of noise, which draws many.
    pub value: Option<f64>,
    /// The unit that the process file states.
    pub unit: String,
}

/// What nobody at the machine sees.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Hidden {
    /// Sums of what acts on the same quantity.
    pub truth: Truth,
    /// Every error of the process.
    pub errors: Vec<Drawn>,
}

/// A run and its measurement.
#[derive(Clone, Debug)]
pub struct Run {
    /// What is measured after it; invalid where the map before is.
    pub measured: Surface,
    /// What it truly removed, and what truly remains.
    pub removal: Removal,
    /// What went wrong.
    pub hidden: Hidden,
}

/// Runs `trajectory` on the mirror that was measured as `before`, with one draw of the errors of `process`.
pub fn run(
    trajectory: &Trajectory,
    tif: &Tif,
    before: &Surface,
    process: &Process,
    settings: &Settings,
) -> Result<Run, Invalid> {
    let moved = if settings.tif_as_sampled { tif.clone() } else { smooth(tif, tif.width_mm())? };
    let runs = Runs::new(trajectory, tif, &moved, before.grid())?;
    runs.check_sizes(process)?;
    draw_run(&runs, before, process, settings.seed)
}

/// [`run`] of a plan that is ready, for many seeds.
pub fn draw_run(
    runs: &Runs<'_>,
    before: &Surface,
    process: &Process,
    seed: u64,
) -> Result<Run, Invalid> {
    let mut deviation = Deviation::default();
    let mut errors = Vec::with_capacity(process.errors.len());
    let mut wrong = [0, 1].map(|_| Array2::zeros(before.grid().shape()));
    for (i, error) in process.errors.iter().enumerate() {
        let of = |use_: u64| stream(seed, STREAMS_PER_ERROR * i as u64 + use_);
        let mut value = None;
        match error.effect {
            Effect::Scalar(effect) => {
                let eta = draw(error.stated.distribution, &mut of(0));
                deviation.add(effect, eta * error.size);
                value = Some(eta * error.stated.size);
            }
            Effect::Noise(noise) => {
                sample(noise, error.size, &runs.motion, &mut of(0), &mut deviation);
            }
            Effect::MapLowOrder { .. } | Effect::MapNoise => {
                for (k, wrong) in wrong.iter_mut().enumerate() {
                    *wrong += &map_error(error.effect, error.size, before, &mut of(1 + k as u64));
                }
            }
        }
        let stated = &error.stated;
        errors.push(Drawn { kind: stated.kind.name(), value, unit: stated.unit.clone() });
    }
    let removal = runs.removal_nm(&deviation)?;
    let [m_1, m_2] = wrong;
    // true before = measured before + m_1, true after = true before - R, measured after = true after - m_2
    let true_before = Surface::new(*before.grid(), before.height_nm() + &m_1)?;
    let removal = Removal::new(&true_before, removal)?;
    let measured = Surface::new(*before.grid(), removal.residual().height_nm() - &m_2)?;
    Ok(Run { measured, removal, hidden: Hidden { truth: deviation.truth(), errors } })
}

/// What one measurement has wrong by one error of the map, nm.
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
