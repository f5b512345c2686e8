//! `planish refine`: the refinement itself.

use std::path::{Path, PathBuf};

use clap::{
    Args,
    builder::{PossibleValue, PossibleValuesParser, TypedValueParser},
};
use planish_dwell::{
    bounded_least_squares::{Bound, noise_of_deviations},
    residual_slope::ResidualSlope,
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{self, FloorArgs, MachineArgs, MirrorArgs, OutputArgs, PathArgs, PathDistanceArgs},
    kind, say, task, warn, with_flags,
};
use planish_refine::{
    RefineSettings, Refined,
    error_budget::{Price, refine_for},
    refine,
};
use planish_schedule::{Choices, Named, SCHEDULERS, Scheduler, by_name, pvt, trig_spline};
use planish_tolerance::error_budget::{ErrorBudget, ErrorBudgetFile};
use planish_types::{
    DwellTime, PathDistance, Surface, TifLattice, Trajectory, outcome::plan::PlanOutcome, plausible,
};
use serde::Serialize;

use super::iterations;

/// The group names its required member: clap leaves a group with flattened members empty.
#[derive(Args)]
#[group(args = ["surface"])]
pub struct Refine {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    machine: MachineArgs,
    /// Dwell times of the first round [dwell artifact] [default: those of bounded least squares]
    #[arg(long, value_name = "DIR")]
    dwell: Option<PathBuf>,
    #[command(flatten)]
    floor: FloorArgs,
    /// Tikhonov weight of the squared dwell time per area above its floor; larger values shorten the run. Its effect
    /// does not depend on pitch, pixel and tool
    #[arg(long, value_name = "A", default_value_t = RefineSettings::default().dwell.tikhonov)]
    tikhonov: f64,
    /// Weight of the square of the slope of the dwell time per area along the path, in the last corrections; larger
    /// values give smoother dwell times and a larger residual
    #[arg(long, value_name = "B", default_value_t = RefineSettings::default().dwell.slope_weight)]
    slope_weight: f64,
    /// Price of a second, relative to half the mean square of the residual, nm^2/s; larger values shorten
    /// the run
    #[arg(long, visible_alias = "time-weight", value_name = "L", default_value_t = 0.0)]
    time_weight_nm2_per_s: f64,
    /// RMS of the noise of the map, nm. The smoothness is raised until the residual reaches it. [default: the RMS of
    /// the standard deviations of the map, if it has them]
    #[arg(long, value_name = "S")]
    noise_rms_nm: Option<f64>,
    /// Weight of the mean square slope of the residual beside its mean square, mm^2: a wave of length L counts
    /// 1 + W (2 pi / L)^2 times [default: heights alone]
    #[arg(long, value_name = "W")]
    residual_slope_weight_mm2: Option<f64>,
    /// Base length of the slopes of the residual, mm [default: one step of the map]
    #[arg(long, value_name = "B", requires = "residual_slope_weight_mm2")]
    residual_slope_base_mm: Option<f64>,
    /// Scheduler that makes the motion
    #[arg(long, value_parser = scheduler_of_name(), default_value = SCHEDULERS[0].name)]
    scheduler: &'static Named,
    /// Shape of the PVT motion
    #[arg(long, value_enum, default_value = "auto")]
    mode: pvt::ModeChoice,
    /// Repair of the dwell-time densities that the machine cannot follow, by trig-spline
    #[arg(long, value_enum, default_value = "offset")]
    repair: trig_spline::Repair,
    /// Error budget of the process [JSON]; the expected square of the residual replaces the square
    #[arg(long, value_name = "FILE")]
    error_budget: Option<PathBuf>,
    /// Largest number of rounds; to stop at a given number is no failure [default: 50, and a negative
    /// verdict if the rounds still improve]
    #[arg(long, value_name = "N")]
    max_rounds: Option<usize>,
    #[command(flatten)]
    distance: PathDistanceArgs,
    #[command(flatten)]
    output: OutputArgs,
}

/// Returns the parser of the flag for the scheduler, which takes the names in the table of schedulers.
fn scheduler_of_name() -> impl TypedValueParser<Value = &'static Named> {
    let names = SCHEDULERS.iter().map(|named| PossibleValue::new(named.name).help(named.about));
    PossibleValuesParser::new(names)
        .map(|name| by_name(&name).expect("clap takes these names only"))
}

/// All settings for the manifest; `stop_at_max_rounds` is true if the user gave the number of rounds.
#[derive(Serialize)]
struct Resolved<'a> {
    #[serde(flatten)]
    settings: RefineSettings<'a>,
    stop_at_max_rounds: bool,
    max_path_distance_mm: f64,
}

impl Refine {
    pub fn run(&self) -> Result<Status, Failure> {
        self.check_choices()?;
        let mut inputs = Inputs::new();
        let (surface, tif) = self.mirror.read(&mut inputs)?;
        let (path, overscan_mm) = self.path.read_with_overscan(&mut inputs)?;
        let machine = self.machine.read(&mut inputs)?;
        let tolerance_mm =
            self.distance.tolerance_mm(&path, overscan_mm).map_err(Failure::with_flags)?;
        let choices = Choices {
            mode: self.mode,
            repair: self.repair,
            max_path_distance_mm: Some(tolerance_mm),
        };
        let scheduler = self.scheduler.scheduler(&choices, &machine);
        let settings = self.settings(&surface, &*scheduler)?;
        let process = self.error_budget.as_ref().map(|path| read_process(path, &mut inputs));
        let process = process.transpose()?;
        let resolved = Resolved {
            settings,
            stop_at_max_rounds: self.max_rounds.is_some(),
            max_path_distance_mm: tolerance_mm,
        };
        let task = task!(self.scheduler.name, resolved);
        let first =
            self.dwell.as_ref().map(|dir| flags::read_dwell(dir, &mut inputs)).transpose()?;
        let parts = [
            ("dwell", DwellTime::KIND),
            ("trajectory", Trajectory::KIND),
            ("iterations", &kind::ITERATIONS),
        ];
        let mut output = match Output::directories(&self.output, parts).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };

        plausible::check_path(&surface, &tif, &path)?;
        let (refined, price) = match &process {
            None => (refine(&surface, &tif, &path, &machine, first, &settings), None),
            Some(process) => {
                match refine_for(&surface, &tif, &path, &machine, first, &settings, process) {
                    Ok((refined, price)) => (Ok(refined), Some(price)),
                    Err(e) => (Err(e), None),
                }
            }
        };
        let refined = refined.map_err(Failure::with_flags)?;

        let distance = PathDistance::new(&refined.trajectory, &path, Some(tolerance_mm))?;
        let outcome = outcome(&refined, price.as_ref(), &distance);
        let negative = refined.negative(&surface, self.max_rounds.is_some());
        let excess = distance.excess().map(|excess| {
            format!("{excess}; the scheduler pvt stays within it, or give a larger tolerance")
        });
        let reasons: Vec<String> = negative.into_iter().chain(excess).collect();
        let status = if reasons.is_empty() {
            Status::Done
        } else {
            Status::Negative(with_flags(&reasons.join("; ")))
        };
        output.write(&refined.dwell, &outcome, &status)?;
        output.write(&refined.trajectory, &outcome, &status)?;
        let arrays = iterations(refined.iterates.iter());
        output.write_arrays(&kind::ITERATIONS, &arrays, &[], &outcome, &status)?;
        self.tell(&refined, &settings, &output.round_s());
        say(format!("the motion is {distance}"));
        if let Some(warning) = refined.tif_lattice.and_then(|lattice| lattice.warning()) {
            warn(warning);
        }
        if let Some(price) = &price {
            say(words(price));
        }
        Ok(status)
    }

    /// Refuses a flag that belongs to another scheduler than the chosen one.
    fn check_choices(&self) -> Result<(), Failure> {
        let own = [
            ("--mode", "pvt", self.mode == pvt::ModeChoice::default()),
            ("--repair", "trig-spline", self.repair == trig_spline::Repair::default()),
        ];
        let chosen = self.scheduler.name;
        match own.into_iter().find(|(_, owner, is_default)| !is_default && chosen != *owner) {
            Some((flag, owner, _)) => Err(Failure::new(format!(
                "{flag} is of the scheduler {owner}, and --scheduler is {chosen}; leave {flag} out, or give \
                 --scheduler {owner}"
            ))),
            None => Ok(()),
        }
    }

    fn settings<'a>(
        &self,
        surface: &Surface,
        scheduler: &'a dyn Scheduler,
    ) -> Result<RefineSettings<'a>, Failure> {
        let mut settings = RefineSettings { scheduler, ..RefineSettings::default() };
        settings.max_rounds = self.max_rounds.unwrap_or(settings.max_rounds);
        settings.dwell.time_weight_nm2_per_s = self.time_weight_nm2_per_s;
        settings.dwell.min_dwell = self.floor.bound(Bound::Seconds, Bound::SecondsPerMm)?;
        settings.dwell.tikhonov = self.tikhonov;
        settings.dwell.slope_weight = self.slope_weight;
        let of_map = noise_of_deviations(surface, None).map_err(Failure::with_flags)?;
        settings.dwell.noise_rms_nm = self.noise_rms_nm.or(of_map);
        let base_mm = self.residual_slope_base_mm.unwrap_or(surface.grid().x.step_mm());
        settings.dwell.residual_slope =
            self.residual_slope_weight_mm2.map(|weight_mm2| ResidualSlope { weight_mm2, base_mm });
        Ok(settings)
    }

    /// Prints the result of every round, and the reason why the loop ended. `round_s` are the computing times of the
    /// rounds, s.
    fn tell(&self, refined: &Refined, settings: &RefineSettings, round_s: &[f64]) {
        let best = &refined.iterates[refined.best];
        for ((round, i), cost_s) in refined.iterates.iter().enumerate().zip(round_s) {
            say(format!(
                "round {round}: {:.4} nm RMS executed in {:.2} s{}, {} segments stretched{}, computed in {cost_s:.2} s{}",
                i.rms_nm,
                i.total_time_s,
                i.expected_rms_nm.map_or(String::new(), |e| format!(" ({e:.4} nm expected)")),
                i.stretched,
                if i.limits_respected { "" } else { ", limits exceeded" },
                if round == refined.best { "  <- best" } else { "" }
            ));
        }
        let before = &refined.iterates[0];
        let kind = settings.scheduler.kind().map_or(String::new(), |kind| format!(" ({kind})"));
        say(format!(
            "{}{kind}: {} after {} rounds, {} of {} dwell times at a bound (the least that the floor or the machine allows): \
             {:.4} nm in {:.2} s before, {:.4} nm in {:.2} s after -> {}",
            settings.scheduler.name(),
            refined.end,
            refined.iterates.len(),
            refined.at_bound,
            refined.dwell.dwell_s().len(),
            before.rms_nm,
            before.total_time_s,
            best.rms_nm,
            best.total_time_s,
            self.output.out.display()
        ));
    }
}

fn read_process(path: &Path, inputs: &mut Inputs) -> Result<ErrorBudget, Failure> {
    let file: ErrorBudgetFile = inputs.read_json("error-budget", path)?;
    let process = file.checked().map_err(|e| Failure::new(format!("{}: {e}", path.display())))?;
    process.doubt().iter().for_each(warn);
    Ok(process)
}

/// Results of the refinement, as the manifests (the records of the run) state them.
#[derive(Clone, Serialize)]
struct RefineOutcome<'a> {
    #[serde(flatten)]
    plan: PlanOutcome,
    /// Comparison of the plans without and with the error budget; left out without an error budget.
    #[serde(skip_serializing_if = "Option::is_none")]
    error_budget: Option<&'a Price>,
    /// Lattice of the map on which the TIF was resampled; left out if the TIF was used as it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    tif_lattice: Option<TifLattice>,
}

/// Returns the results of the best round for the manifests.
fn outcome<'a>(
    refined: &Refined,
    price: Option<&'a Price>,
    distance: &PathDistance,
) -> RefineOutcome<'a> {
    let best = &refined.iterates[refined.best];
    let plan = PlanOutcome {
        best_round: Some(refined.best),
        end: Some(refined.end.into()),
        at_bound: Some(refined.at_bound),
        rms_nm: Some(best.rms_nm),
        total_time_s: Some(best.total_time_s),
        path_distance: Some(*distance),
        ..PlanOutcome::default()
    };
    RefineOutcome { plan, error_budget: price, tif_lattice: refined.tif_lattice }
}

/// Returns the sentence that compares residuals and times of the plans made without and with the error budget.
fn words(price: &Price) -> String {
    let Price { name, without, with, kept, not_in_the_objective, .. } = price;
    let objective = match not_in_the_objective.as_slice() {
        [] => String::new(),
        kinds => format!("; not in the objective: {}", kinds.join(", ")),
    };
    let plan = if *kept { "" } else { ": the plan made without it is kept" };
    format!(
        "{name}{plan}: without errors {:.4} -> {:.4} nm, expected {:.4} -> {:.4} nm, 95 % of the runs below {:.4} -> \
         {:.4} nm, {:.2} -> {:.2} s{objective}",
        without.nominal_rms_nm,
        with.nominal_rms_nm,
        without.expected_rms_nm,
        with.expected_rms_nm,
        without.below_95_percent_nm,
        with.below_95_percent_nm,
        without.total_time_s,
        with.total_time_s
    )
}
