//! Computes the effect of an error budget on a plan: the table of the errors, the distribution of the residual, and the
//! error to improve first.

use planish_types::{
    Invalid, Surface, Tif, Trajectory,
    outcome::tolerance::{ErrorLine, First, Quantiles, ToleranceOutcome},
    progress,
};

use crate::{
    distribution::{Errors, Span},
    draws::{ResidualModel, quantile},
    error_budget::{Effect, ErrorBudget, Noise, Scalar},
    field::Tool,
    noise::{Columns, Response},
    reach::Reach,
    report::{LEVELS, MEAN_TOOL, Pair, Tolerance},
    settings::ToleranceSettings,
    tool::{Moved, moved},
    work::Work,
};

/// Departure of an error from its first order, as a fraction of the RMS that it adds, above which the distribution
/// comes from simulated runs. A departure of less than [`SEEN`] does not count. Larger: fewer simulations, less exact
/// results. Smaller: more simulations.
pub const LARGEST_DEPARTURE: f64 = 0.1;

/// Departure of an error from its first order, as a fraction of the expected RMS, up to which it is ignored; it changes
/// that RMS by at most 5e-5. Larger: less exact results. Smaller: more simulations.
pub const SEEN: f64 = 0.01;

/// Departure of an error of one number from its first order, as a fraction of the RMS that it adds, above which its row
/// of the table comes from simulated runs. That holds whether the departure is visible in the distribution or not. The
/// first order of a sharp TIF that turns is up to twice its effect: an edge that moves by more than its width adds no
/// more. Larger: less exact rows. Smaller: more simulations.
pub const LARGEST_DEPARTURE_OF_LINE: f64 = 0.02;

/// Number of simulated runs from which the distribution comes if the first order is not enough. Larger: more time.
/// Smaller: larger standard errors of the quantiles.
const RUNS_OF_ALL: usize = 200;

/// Largest number of draws for the 95 % quantile of the runs without one of the errors. Larger: more time per error.
/// Smaller: the error to improve first is less certain.
const DRAWS_WITHOUT_ONE: usize = 10_000;

/// Number of parts of the work that have equal shares of the progress bar: derivatives, second order, and runs.
const PARTS: usize = 3;

/// Returns the RMS values of runs, nm, in ascending order.
fn sorted(mut rms: Vec<f64>) -> Vec<f64> {
    rms.sort_unstable_by(f64::total_cmp);
    rms
}

/// Returns the quantiles of RMS values in ascending order, nm.
fn quantiles(sorted_rms: &[f64]) -> Quantiles {
    let [low, median, below, high] =
        [0.025, 0.5, 0.95, 0.975].map(|part| quantile(sorted_rms, part));
    Quantiles { median_nm: median, below_95_percent_nm: below, interval_95_percent_nm: [low, high] }
}

/// Computes the contribution of each error of `process` to the residual of `trajectory` on `desired`, and the
/// distribution of the residual.
///
/// # Errors
/// Refuses settings out of range, a log with the rate of its beam, errors that the tool cannot have, errors that
/// displace the tool by more than the TIF is long, and a motion or a map that takes too much memory.
pub fn tolerance(
    trajectory: &Trajectory,
    tif: &Tif,
    desired: &Surface,
    process: &ErrorBudget,
    settings: &ToleranceSettings,
) -> Result<Tolerance, Invalid> {
    settings.check()?;
    let seed = settings.seed;
    let width = tif.width_mm();
    let Moved { tif: moved, resampling_error } =
        moved(tif, desired.grid(), settings.tif_as_sampled)?;
    let work = Work::new(trajectory, tif, &moved, desired, process, settings.free, width)?;

    // f_i, and n
    let linear = progress::part(0, PARTS, || work.linear(width))?;
    let span = Span::new(&work, &linear);
    let reach = Reach::new(&work.inner, &moved, width);
    let noises = work.noises();
    let displaced = noises.iter().any(|(_, n, _)| *n == Noise::Position);
    let columns = if noises.is_empty() {
        None
    } else {
        Some(Columns::new(
            work.motion(),
            &work.inner,
            &Tool::new(&moved, &work.inner),
            reach.on_cells(&work.inner),
            span.basis.clone(),
            displaced,
        )?)
    };
    let columns = columns.as_ref();
    let responses: Vec<(usize, f64, Response)> = columns.map_or(Vec::new(), |columns| {
        noises.iter().map(|(i, noise, size)| (*i, *size, columns.response(*noise))).collect()
    });

    // What each adds alone
    let departures = progress::part(1, PARTS, || work.departures(&linear, columns, seed))?;
    let mut lines = work.lines(&linear, &responses, &reach, &departures);
    // What all add together
    let errors = Errors::new(&work, &linear, &responses, &span, columns, seed);
    let whole = errors.model(None);
    let expected_rms_nm = whole.mean_square().sqrt();
    let simulated = simulate_departing(&work, &mut lines, expected_rms_nm, &reach, seed)?;
    let least = if simulated { RUNS_OF_ALL } else { 0 };
    let count = settings.simulated_runs.max(least);
    let runs = progress::part(2, PARTS, || work.runs(count, &linear, columns, seed))?;
    let rms = if simulated {
        sorted(runs.iter().map(|r| r.simulated_rms_nm).collect())
    } else {
        whole.sorted(settings.draws, seed)
    };
    let residual = quantiles(&rms);
    let [low, high] = residual.interval_95_percent_nm;
    let differences = runs.iter().filter(|p| p.first_order_rms_nm > 0.0).map(Pair::difference);
    let levels = (0..LEVELS).map(|k| k as f64 / (LEVELS - 1) as f64);
    Ok(Tolerance {
        outcome: ToleranceOutcome {
            error_budget: process.name.clone(),
            nominal_rms_nm: work.rms(&work.nominal),
            expected_rms_nm,
            residual,
            simulated,
            first: first(&errors, &lines, settings),
            errors: lines,
        },
        largest_difference: differences.fold(0.0, f64::max),
        within_interval: runs.iter().filter(|p| (low..=high).contains(&p.simulated_rms_nm)).count(),
        runs,
        levels: levels.map(|level| (level, quantile(&rms, level))).collect(),
        deviation_nm: work.deviation_map(&linear, &responses),
        coverage: work.coverage.clone(),
        tif_resampling_error: resampling_error,
        backlash_start: process.play_start(),
        mean_tool: tif.variation().map(|_| MEAN_TOOL),
    })
}

/// Returns true if the departure of an error from its first order is above [`LARGEST_DEPARTURE`] and above [`SEEN`], so
/// that it is visible in the sum of all errors.
fn departs(line: &ErrorLine, expected_rms_nm: f64) -> bool {
    line.departs_by_rms_nm > LARGEST_DEPARTURE * line.adds_rms_nm
        && line.departs_by_rms_nm > SEEN * expected_rms_nm
}

/// Replaces the rows of the table whose first order is not enough by those of simulated runs. Play, which has no first
/// order, is replaced only if its departure is visible in the distribution. Returns true if the first order is not
/// enough for the distribution either.
fn simulate_departing(
    work: &Work<'_>,
    lines: &mut [ErrorLine],
    expected_rms_nm: f64,
    reach: &Reach,
    seed: u64,
) -> Result<bool, Invalid> {
    let simulated = lines.iter().any(|line| departs(line, expected_rms_nm));
    for (i, line) in lines.iter_mut().enumerate() {
        // Play has no first order: its line is that of the two signs of the play.
        let is_curved = matches!(work.process.errors[i].effect, Effect::Scalar(effect) if effect != Scalar::Backlash)
            && line.departs_by_rms_nm > LARGEST_DEPARTURE_OF_LINE * line.adds_rms_nm;
        if is_curved || departs(line, expected_rms_nm) {
            work.simulate_line(i, line, reach, seed)?;
        }
    }
    Ok(simulated)
}

/// Returns the error without which the 95 % quantile of the residual is smallest, with runs drawn to first order;
/// `None` if no error lowers it when left out.
fn first(errors: &Errors<'_>, lines: &[ErrorLine], settings: &ToleranceSettings) -> Option<First> {
    // With the same random numbers for all: what differs is the error that is left out.
    let draws = settings.draws.min(DRAWS_WITHOUT_ONE);
    let below = |model: &ResidualModel| quantile(&model.sorted(draws, settings.seed), 0.95);
    let without: Vec<f64> = (0..lines.len()).map(|i| below(&errors.model(Some(i)))).collect();
    let (index, least) = without.into_iter().enumerate().min_by(|a, b| a.1.total_cmp(&b.1))?;
    if least >= below(&errors.model(None)) {
        return None;
    }
    let kind = lines[index].kind.clone();
    Some(First { index, kind, without_it_95_percent_nm: least })
}
