//! Flags of the solvers that face [`Problem`], and what they print.

use std::path::PathBuf;

use clap::Args;
use ndarray::Array2;
use planish_dwell::{
    DwellError, bcls,
    bounded_least_squares::{self, Bound},
    columns::Columns,
    lucy_richardson, non_negative_least_squares,
    problem::{Outcome, Problem, Solution},
    rifta, tikhonov_lsqr, truncated_svd, udo,
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{FloorArgs, MachineArgs, MirrorArgs, OutputArgs, PathArgs},
    say, task,
};
use planish_types::{
    DwellTime, End, Surface, Tif, ToolPath,
    plausible::{self, Rms},
};
use serde::Serialize;
use serde_json::json;

/// What every solver is given.
#[derive(Args)]
pub struct Given {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    /// Weight of every pixel [.npy file (ny, nx), >= 0]; without it valid pixels count 1
    #[arg(long, value_name = "FILE")]
    weight: Option<PathBuf>,
    /// What a dwell time is spent on
    #[arg(long, value_enum, default_value = "segment")]
    columns: Columns,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Args)]
pub struct LucyRichardson {
    #[command(flatten)]
    given: Given,
    #[command(flatten)]
    least: FloorArgs,
    /// What is solved for
    #[arg(long, value_enum, default_value = "path")]
    unknowns: lucy_richardson::Unknowns,
    /// Weight of the total variation, useful from 0 to 0.02
    #[arg(long, value_name = "MU", default_value_t = lucy_richardson::Settings::default().total_variation)]
    total_variation: f64,
    /// Removal at the lowest pixel, as a fraction of the PV of what is to be removed
    #[arg(long, value_name = "PART", default_value_t = lucy_richardson::Settings::default().margin)]
    margin: f64,
    /// Part of the pixels, the lowest ones, that may be cut off as pits
    #[arg(long, value_name = "PART", default_value_t = lucy_richardson::Settings::default().pits)]
    pits: f64,
    /// End when ten steps lower the RMS by less than this part
    #[arg(long, value_name = "PART", default_value_t = lucy_richardson::Settings::default().tolerance)]
    tolerance: f64,
    /// Most steps; where a number is given, to stop there is what is wanted [default: 300, and a negative
    /// verdict where they do not settle]
    #[arg(long, value_name = "N")]
    max_iterations: Option<usize>,
    /// Start every step from a point extrapolated along the last two: fewer steps
    #[arg(long)]
    accelerated: bool,
    /// Solve for the map on squares of this many pixels a side [default: 1, and what the TIF allows
    /// from a million pixels on]
    #[arg(long, value_name = "K")]
    pixels_per_cell: Option<usize>,
}

#[derive(Args)]
pub struct Rifta {
    #[command(flatten)]
    given: Given,
    #[command(flatten)]
    least: FloorArgs,
    /// RMS that a smaller margin around the aperture may cost, nm
    #[arg(long, value_name = "NM", default_value_t = rifta::Settings::default().margin_tolerance_nm)]
    margin_tolerance_nm: f64,
    /// Part of the pixels, the lowest ones, that do not decide how much is removed
    #[arg(long, value_name = "PART", default_value_t = rifta::Settings::default().pits)]
    pits: f64,
}

#[derive(Args)]
pub struct Udo {
    #[command(flatten)]
    given: Given,
    #[command(flatten)]
    least: FloorArgs,
    /// How the floor is kept
    #[arg(long, value_enum, default_value = "model")]
    floor: udo::Floor,
    /// Part of the best step that is taken from the second round on
    #[arg(long, value_name = "BETA", default_value_t = udo::Settings::default().step)]
    step: f64,
    /// RMS at which it ends, nm
    #[arg(long, value_name = "NM", default_value_t = udo::Settings::default().threshold_nm)]
    threshold_nm: f64,
    /// Most rounds
    #[arg(long, value_name = "N", default_value_t = udo::Settings::default().max_iterations)]
    max_iterations: usize,
}

#[derive(Args)]
pub struct TikhonovLsqr {
    #[command(flatten)]
    given: Given,
    #[command(flatten)]
    least: FloorArgs,
    /// Damping as a fraction of the largest singular value [default: 0.01]
    #[arg(long, value_name = "PART", group = "choice")]
    damping: Option<f64>,
    /// RMS of the noise of the map, nm: the largest damping whose residual is at most that
    #[arg(long, value_name = "S", group = "choice")]
    noise_rms_nm: Option<f64>,
    /// Choose the damping at the corner of the L-curve
    #[arg(long, group = "choice")]
    l_curve: bool,
    /// Most steps of LSQR
    #[arg(long, value_name = "N", default_value_t = tikhonov_lsqr::Settings::default().max_iterations)]
    max_iterations: usize,
}

#[derive(Args)]
pub struct TruncatedSvd {
    #[command(flatten)]
    given: Given,
    #[command(flatten)]
    least: FloorArgs,
    /// Leave out singular values up to this fraction of the largest
    #[arg(long, value_name = "PART", default_value_t = truncated_svd::Settings::default().cut)]
    cut: f64,
    /// Most steps; each keeps a vector of the number of dwell points
    #[arg(long, value_name = "N", default_value_t = truncated_svd::Settings::default().max_iterations)]
    max_iterations: usize,
}

#[derive(Args)]
pub struct NonNegativeLeastSquares {
    #[command(flatten)]
    given: Given,
    #[command(flatten)]
    least: FloorArgs,
    /// Weight of the distance to the least dwell time, relative to the strongest column
    #[arg(long, value_name = "A", default_value_t = non_negative_least_squares::Settings::default().tikhonov)]
    tikhonov: f64,
}

#[derive(Args)]
pub struct Bcls {
    #[command(flatten)]
    given: Given,
    #[command(flatten)]
    machine: MachineArgs,
    /// Least feed as a fraction of the largest that is reachable on a segment; 0 for none
    #[arg(long, value_name = "ETA", default_value_t = bcls::Settings::default().least_feed)]
    least_feed: f64,
    /// Weight of the distance to the least dwell time, relative to the strongest column
    #[arg(long, value_name = "A", default_value_t = bcls::Settings::default().tikhonov)]
    tikhonov: f64,
}

/// Settings of a solver with those that all have.
#[derive(Serialize)]
struct Resolved<S> {
    columns: Columns,
    min_dwell: Bound,
    #[serde(flatten)]
    solver: S,
}

/// The solver's own report with the numbers that all have.
#[derive(Serialize)]
struct Reported<'a, R> {
    #[serde(flatten)]
    outcome: &'a Outcome,
    #[serde(flatten)]
    report: &'a R,
}

/// The nouns that a solver is given.
struct Nouns {
    desired: Surface,
    tif: Tif,
    path: ToolPath,
    weight: Option<Array2<f64>>,
}

impl Given {
    fn read(&self, inputs: &mut Inputs) -> Result<Nouns, Failure> {
        let weight = |inputs: &mut Inputs| {
            self.weight.as_ref().map(|file| inputs.read_map("weight", file)).transpose()
        };
        let (desired, tif) = self.mirror.read(inputs)?;
        Ok(Nouns { desired, tif, path: self.path.read(inputs)?, weight: weight(inputs)? })
    }
}

/// What a report says of its end.
struct Ended {
    /// The word for it.
    end: End,
    /// Why the verdict is negative, if it is.
    negative: Option<String>,
    /// What else there is to say.
    words: String,
}

/// Reads, solves, writes, and prints one line.
fn solve<S: Serialize, R: Serialize>(
    method: &'static str,
    given: &Given,
    floor: &FloorArgs,
    settings: S,
    solver: impl FnOnce(&Problem<'_>, &S) -> Result<Solution<R>, DwellError>,
    ended: impl FnOnce(&R) -> Ended,
) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let resolved = Resolved {
        columns: given.columns,
        min_dwell: floor.bound(Bound::Seconds, Bound::SecondsPerMm),
        solver: settings,
    };
    let task = task!(method, &resolved);
    let nouns = given.read(&mut inputs)?;
    let mut output =
        match Output::directory(&given.output, DwellTime::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
    let problem = Problem {
        desired: &nouns.desired,
        tif: &nouns.tif,
        path: &nouns.path,
        weight: nouns.weight.as_ref(),
        columns: resolved.columns,
        min_dwell: resolved.min_dwell,
    };
    plausible::check_path(&nouns.desired, &nouns.tif, &nouns.path)?;
    let solution = solver(&problem, &resolved.solver)?;
    let Ended { end, negative, words } = ended(&solution.report);
    let Solution { dwell, outcome, report } = &solution;
    let after = Rms { rms_nm: outcome.model_rms_nm, detilted_nm: outcome.model_rms_detilted_nm };
    let before = before(&nouns.desired, nouns.weight.as_ref());
    let negative = negative.or_else(|| plausible::drawback(before, after, outcome.total_time_s));
    let status = negative.map_or(Status::Done, Status::Negative);
    let written = json!({ "end": end, "report": Reported { outcome, report } });
    output.write(dwell, written, &status)?;
    let unreached = match outcome.unreached_pixels {
        0 => String::new(),
        n => format!("; {n} valid pixels out of reach"),
    };
    say(format!(
        "{method}: {} dwell times, {:.2} s, {:.4} nm RMS in its own model; {words}; {} at the floor, {} \
         out of reach{unreached} -> {}",
        dwell.dwell_s().len(),
        outcome.total_time_s,
        outcome.model_rms_nm,
        outcome.at_floor,
        outcome.unreached_points,
        given.output.out.display()
    ));
    Ok(status)
}

/// The map before the plan, where it counts.
pub fn before(desired: &Surface, weight: Option<&Array2<f64>>) -> Rms {
    let Some(weight) = weight else { return Rms::of(desired) };
    let mut height = desired.height_nm().clone();
    // Whether the shapes agree is for the solver to say.
    height.iter_mut().zip(weight).filter(|(_, w)| **w == 0.0).for_each(|(z, _)| *z = f64::NAN);
    let counted = Surface::new(*desired.grid(), height);
    counted.map_or_else(|_| Rms::of(desired), |surface| Rms::of(&surface))
}

/// The verdict on bounded least squares: without its certificate a result is not known to be the best.
pub fn bounded_status(r: &bounded_least_squares::Report, before: Rms) -> Status {
    let after = Rms { rms_nm: r.model_rms_nm, detilted_nm: r.model_rms_detilted_nm };
    let gap = r.relative_gap.map_or_else(String::new, |gap| {
        format!(", and the objective may be {:.1e} of itself above its minimum", gap)
    });
    let unproven = format!(
        "after {} iterations a dwell time would still move by {:.1e} s{gap}; raise --tikhonov or --smoothness",
        r.iterations, r.kkt_residual_s
    );
    let negative = match r.end {
        End::Optimal => plausible::drawback(before, after, r.total_time_s),
        End::Stagnated => {
            Some(format!("not proven optimal, the steps change nothing any more: {unproven}"))
        }
        _ => Some(format!("not converged: {unproven}")),
    };
    negative.map_or(Status::Done, Status::Negative)
}

pub fn lucy_richardson(cli: &LucyRichardson) -> Result<Status, Failure> {
    let settings = lucy_richardson::Settings {
        unknowns: cli.unknowns,
        total_variation: cli.total_variation,
        margin: cli.margin,
        pits: cli.pits,
        tolerance: cli.tolerance,
        max_iterations: cli
            .max_iterations
            .unwrap_or(lucy_richardson::Settings::default().max_iterations),
        stop_at_max: cli.max_iterations.is_some(),
        accelerated: cli.accelerated,
        pixels_per_cell: cli.pixels_per_cell,
    };
    let solver = lucy_richardson::solve;
    solve("lucy-richardson", &cli.given, &cli.least, settings, solver, |r| {
        let clipped = match r.clipped_tif_samples {
            0 => String::new(),
            n => format!(", {n} negative samples of the TIF taken as 0"),
        };
        let cells = match r.pixels_per_cell {
            1 => String::new(),
            k => format!(" on cells of {k} x {k} pixels"),
        };
        let negative = (r.end == End::IterationLimit).then(|| {
            format!(
                "not settled: after {} steps ten more still lower the RMS by more than {} of it; give \
                 --accelerated, a larger --tolerance, or --max-iterations to stop there on purpose",
                r.iterations, cli.tolerance
            )
        });
        Ended {
            end: r.end,
            negative,
            words: format!("{} after {} steps{cells}{clipped}", r.end, r.iterations),
        }
    })
}

pub fn rifta(cli: &Rifta) -> Result<Status, Failure> {
    let settings = rifta::Settings {
        margin_tolerance_nm: cli.margin_tolerance_nm,
        pits: cli.pits,
        ..rifta::Settings::default()
    };
    solve("rifta", &cli.given, &cli.least, settings, rifta::solve, |r| {
        let negative = (r.end == End::LiftLimit).then(|| {
            "not settled: every lift of the map that is allowed was taken, and another would lower the RMS"
                .to_string()
        });
        let words = format!(
            "gain capped at {:.1}, margin {:.2} mm, {:.4} nm RMS before the path",
            r.relative_gamma, r.margin_mm, r.map_rms_nm
        );
        Ended { end: r.end, negative, words }
    })
}

pub fn udo(cli: &Udo) -> Result<Status, Failure> {
    let settings = udo::Settings {
        floor: cli.floor,
        step: cli.step,
        threshold_nm: cli.threshold_nm,
        max_iterations: cli.max_iterations,
    };
    solve("udo", &cli.given, &cli.least, settings, udo::solve, |r| {
        let last = r.rms_nm[r.rms_nm.len() - 1];
        let negative = (r.end == End::IterationLimit
            || r.end == End::Stopped && cli.threshold_nm > 0.0)
            .then(|| {
                format!("the threshold of {} nm is not reached: {last:.4} nm RMS", cli.threshold_nm)
            });
        Ended { end: r.end, negative, words: format!("{} after {} rounds", r.end, r.iterations) }
    })
}

pub fn tikhonov_lsqr(cli: &TikhonovLsqr) -> Result<Status, Failure> {
    let defaults = tikhonov_lsqr::Settings::default();
    let damping = match (cli.damping, cli.noise_rms_nm, cli.l_curve) {
        (Some(part), ..) => tikhonov_lsqr::Damping::Relative(part),
        (_, Some(noise), _) => tikhonov_lsqr::Damping::Discrepancy(noise),
        (.., true) => tikhonov_lsqr::Damping::LCurve,
        _ => defaults.damping,
    };
    let settings =
        tikhonov_lsqr::Settings { damping, max_iterations: cli.max_iterations, ..defaults };
    let solver = tikhonov_lsqr::solve;
    solve("tikhonov-lsqr", &cli.given, &cli.least, settings, solver, |r| {
        let negative = if !r.noise_reached {
            let least = r.searched_rms_nm.iter().copied().fold(f64::INFINITY, f64::min);
            Some(format!("the least residual of the search is {least:.4} nm RMS, above the noise"))
        } else if r.end != End::Converged {
            Some(format!("not converged after {} steps of LSQR", r.iterations))
        } else {
            None
        };
        let words = format!(
            "damping {:.2e}, {} after {} steps, level {:.4} s, {} clipped",
            r.relative_damping, r.end, r.iterations, r.level_s, r.clipped
        );
        Ended { end: r.end, negative, words }
    })
}

pub fn truncated_svd(cli: &TruncatedSvd) -> Result<Status, Failure> {
    let settings = truncated_svd::Settings {
        cut: cli.cut,
        max_iterations: cli.max_iterations,
        ..truncated_svd::Settings::default()
    };
    let solver = truncated_svd::solve;
    solve("truncated-svd", &cli.given, &cli.least, settings, solver, |r| {
        let negative = (r.end != End::Converged)
            .then(|| format!("not converged after {} steps; raise --max-iterations", r.steps));
        let words = format!(
            "rank {}, {} after {} steps, level {:.4} s, {} clipped",
            r.rank, r.end, r.steps, r.level_s, r.clipped
        );
        Ended { end: r.end, negative, words }
    })
}

pub fn non_negative_least_squares(cli: &NonNegativeLeastSquares) -> Result<Status, Failure> {
    let settings = non_negative_least_squares::Settings {
        tikhonov: cli.tikhonov,
        ..non_negative_least_squares::Settings::default()
    };
    let solver = non_negative_least_squares::solve;
    solve("non-negative-least-squares", &cli.given, &cli.least, settings, solver, |r| {
        let moves = format!("a dwell time would still move by {:.1e} s", r.kkt_residual_s);
        let negative = (r.end != End::Optimal)
            .then(|| format!("not converged after {} changes: {moves}", r.iterations));
        let words = format!("{} after {} changes, {moves}", r.end, r.iterations);
        Ended { end: r.end, negative, words }
    })
}

pub fn bcls(cli: &Bcls) -> Result<Status, Failure> {
    let settings = bcls::Settings {
        columns: cli.given.columns,
        least_feed: cli.least_feed,
        tikhonov: cli.tikhonov,
    };
    let task = task!("bcls", settings);
    let mut inputs = Inputs::new();
    let Nouns { desired, tif, path, weight } = cli.given.read(&mut inputs)?;
    let machine = cli.machine.read(&mut inputs)?;
    let mut output =
        match Output::directory(&cli.given.output, DwellTime::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
    plausible::check_path(&desired, &tif, &path)?;
    let found = bcls::solve(&desired, &tif, &path, weight.as_ref(), &machine, &settings)?;
    let (r, bounds) = (&found.solution.report, &found.report);
    let status = bounded_status(r, before(&desired, weight.as_ref()));
    let dwell = &found.solution.dwell;
    output.write(dwell, json!({ "end": r.end, "report": r, "bounds": bounds }), &status)?;
    say(format!(
        "bcls: {} dwell times, {:.2} s, {:.4} nm RMS in its own model; {} {} after {} iterations; pitch \
         limit {:.4} mm, {} of the segments are shorter, feeds up to {:.2} mm/s; {} at the least dwell \
         time, {} at the largest -> {}",
        dwell.dwell_s().len(),
        r.total_time_s,
        r.model_rms_nm,
        r.algorithm,
        r.end,
        r.iterations,
        bounds.pitch_limit_mm,
        bounds.below_pitch_limit,
        bounds.reachable_mm_per_s[1],
        r.at_lower_bound,
        r.at_upper_bound,
        cli.given.output.out.display()
    ));
    Ok(status)
}
