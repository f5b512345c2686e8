//! Coverage of the standard errors: many runs of the virtual machine, each reconciled.
//!
//! `cargo run --release -p planish-reconcile --example coverage -- SURFACE TIF TRAJECTORY PROCESS [RUNS [BLOCK]]`
//! prints, for every parameter, in how many of RUNS (500) it is within two of its standard errors, the RMS of its error
//! over that of its standard errors, and how often it was refused. The noise of the maps is averaged over BLOCK x BLOCK
//! pixels (1) and scaled back to its standard deviation: correlated noise.

use std::{env, path::Path, process::ExitCode};

use ndarray::{Array2, s};
use planish_handoff::Inputs;
use planish_reconcile::{
    Comparison, ReconcileSettings,
    determined::{all_moves, refusal},
    fit::{Start, fit},
    model::RemovalModel,
    parameter::Parameter,
};
use planish_simulate::{
    error_budget::{Effect, ErrorBudget, ErrorBudgetFile},
    runs::Runs,
    sample::{stream, white},
    virtual_machine::draw_run,
};
use planish_types::{Surface, Tif, Trajectory};

/// First stream of the correlated noise. Larger or smaller: no difference, as long as it is apart from the streams of
/// the virtual machine. Chosen.
const NOISE_STREAM: u64 = 1 << 40;

fn main() -> ExitCode {
    match study(&env::args().skip(1).collect::<Vec<_>>()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("coverage: {e}");
            ExitCode::from(2)
        }
    }
}

fn study(words: &[String]) -> Result<(), Box<dyn std::error::Error>> {
    let [surface, tif, trajectory, process, more @ ..] = words else {
        return Err("give SURFACE TIF TRAJECTORY PROCESS [RUNS [BLOCK]]".into());
    };
    let number = |k: usize, default| more.get(k).map_or(Ok(default), |w| w.parse::<usize>());
    let (count, block) = (number(0, 500)?, number(1, 1)?);
    let mut inputs = Inputs::new();
    let before: Surface = inputs.read("surface", Path::new(surface))?;
    let tif: Tif = inputs.read("tif", Path::new(tif))?;
    let trajectory: Trajectory = inputs.read("trajectory", Path::new(trajectory))?;
    let file: ErrorBudgetFile = inputs.read_json("error-budget", Path::new(process))?;
    let process = file.checked()?;
    let (process, sigma_nm) = match block {
        1 => (process, 0.0),
        _ => without_map_noise(process),
    };

    let settings = ReconcileSettings::default();
    let (parameters, terms) = settings.chosen(|_| true)?;
    let first = Comparison {
        before: &before,
        after: &before,
        trajectory: &trajectory,
        tif: &tif,
        error_budget: None,
        transform: None,
    };
    let moved = first.moved_tif(&settings)?;
    let runs = Runs::new(&trajectory, &tif, &moved, before.grid())?;
    let model = RemovalModel::new(&runs, &moved, parameters.clone(), Parameter::usual_scale);
    let start = Start::new(&model)?;
    let mut tally = vec![Tally::default(); parameters.len()];
    for seed in 0..count as u64 {
        let run = draw_run(&runs, &before, &process, seed, 1)?;
        let mut after = run.measured.height_nm().clone();
        for k in 0..2 {
            if block > 1 {
                after += &blurred(sigma_nm, after.dim(), block, seed, k);
            }
        }
        let after = Surface::new(*before.grid(), after)?;
        let data = Comparison { after: &after, ..first }.data(parameters.len() + terms.len())?;
        let found = fit(&model, &terms, &data, &start)?;
        let moved_by = all_moves(&found, &data, None);
        for (i, parameter) in parameters.iter().enumerate() {
            let truth = of(*parameter, &run.hidden.truth);
            let refused = refusal(&found, i, parameter.usual_scale(), &moved_by[i]);
            tally[i].add(found.values[i] - truth, found.standard_error(i), refused.is_some());
        }
    }
    println!("{count} runs, noise over {block} x {block} pixels");
    println!("parameter                  within 2     RMS error   standard error   ratio  refused");
    for (parameter, t) in parameters.iter().zip(&tally) {
        let (unit, factor) = parameter.unit();
        let n = count as f64;
        let [error, stated] = [t.square, t.variance].map(|sum| (sum / n).sqrt() / factor);
        println!(
            "{:<26} {:>6.1} % {error:>10.4} {unit:<3} {stated:>10.4} {unit:<3} {:>7.3} {:>8}",
            parameter.name(),
            100.0 * t.within as f64 / n,
            error / stated,
            t.refused
        );
    }
    Ok(())
}

/// Counts and sums of one parameter over the runs.
#[derive(Clone, Default)]
struct Tally {
    within: usize,
    refused: usize,
    square: f64,
    variance: f64,
}

impl Tally {
    fn add(&mut self, error: f64, standard_error: f64, refused: bool) {
        self.within += usize::from(error.abs() <= 2.0 * standard_error);
        self.refused += usize::from(refused);
        self.square += error * error;
        self.variance += standard_error * standard_error;
    }
}

/// Returns the true value of a parameter for a round TIF, whose ellipticity e turned by phi is e cos 2 phi and e sin 2
/// phi.
fn of(parameter: Parameter, truth: &planish_types::outcome::virtual_machine::Truth) -> f64 {
    let turned = 2.0 * truth.tif_rotation_rad;
    match parameter {
        Parameter::RateScale => truth.rate_scale,
        Parameter::OffsetX => truth.offset_x_mm,
        Parameter::OffsetY => truth.offset_y_mm,
        Parameter::Rotation => truth.rotation_rad,
        Parameter::Magnification => truth.magnification,
        Parameter::TifWidth => truth.tif_width,
        Parameter::TifEllipticity => truth.tif_ellipticity * turned.cos(),
        Parameter::TifDiagonalEllipticity => truth.tif_ellipticity * turned.sin(),
        // The processes of this study have none.
        Parameter::RateDrift => 0.0,
    }
}

/// Returns the process without the noise of the map, and the standard deviation of that noise, nm.
fn without_map_noise(mut process: ErrorBudget) -> (ErrorBudget, f64) {
    let mut square = 0.0;
    process.errors.retain(|e| {
        let noise = e.effect == Effect::MapNoise;
        square += if noise { e.size * e.size } else { 0.0 };
        !noise
    });
    (process, square.sqrt())
}

/// Returns white noise averaged over a moving square of `block` pixels and scaled to the standard deviation `sigma_nm`.
/// The numbers follow from `seed` and `map`.
fn blurred(
    sigma_nm: f64,
    (ny, nx): (usize, usize),
    block: usize,
    seed: u64,
    map: u64,
) -> Array2<f64> {
    let mut rng = stream(seed, NOISE_STREAM + map);
    let fine = white(sigma_nm, (ny + block, nx + block), &mut rng);
    let of = |(r, c)| fine.slice(s![r..r + block, c..c + block]).sum() / block as f64;
    Array2::from_shape_fn((ny, nx), of)
}
