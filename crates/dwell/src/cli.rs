//! The subcommands, one file each, with the arguments, input and output that the solvers of a [`Problem`] share.

mod bcls;
mod bound;
mod bounded_least_squares;
mod feed_law;
mod front;
mod lucy_richardson;
mod non_negative_least_squares;
mod rifta;
mod several_tools;
mod tikhonov_lsqr;
mod truncated_svd;
mod udo;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use ndarray::Array2;
use planish_dwell::{
    DwellError,
    bounded_least_squares::Bound,
    columns::Columns,
    problem::{Outcome, Problem, Solution, rms_before},
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{FloorArgs, MirrorArgs, OutputArgs, PathArgs},
    say, task, warn, with_flags,
};
use planish_types::{
    DwellTime, End, Surface, Tif, TifLattice, ToolPath, outcome::plan::PlanOutcome, plausible,
};
use serde::Serialize;

/// Solvers. The hidden ones are baselines; the help lists them under a heading of their own.
#[derive(Subcommand)]
pub enum Solver {
    /// Smallest RMS residual with a free piston and bounds on every dwell time
    BoundedLeastSquares(bounded_least_squares::BoundedLeastSquares),
    /// The same for several tools in one problem: which tool removes what
    SeveralTools(several_tools::SeveralTools),
    /// The subset of a rack of up to six tools that costs least with its changes, and its dwell times
    ChooseTools(several_tools::ChooseTools),
    /// Residual that no path and no motion of this tool can beat in a run time, with its gap
    Bound(bound::BoundArgs),
    /// Residual against run time along a path, estimated from dwell times without a motion
    Front(front::FrontArgs),
    /// Least squares with bounds from the limits of a machine
    #[command(hide = true)]
    Bcls(bcls::Bcls),
    /// Least squares with a lower bound only (Lawson and Hanson); slow
    #[command(hide = true)]
    NonNegativeLeastSquares(non_negative_least_squares::NonNegativeLeastSquares),
    /// Damped least squares without bounds; damping given, by discrepancy, or by L-curve
    TikhonovLsqr(tikhonov_lsqr::TikhonovLsqr),
    /// Least squares in the space of the large singular values
    #[command(hide = true)]
    TruncatedSvd(truncated_svd::TruncatedSvd),
    /// Positive multiplicative steps with total-variation smoothing
    LucyRichardson(lucy_richardson::LucyRichardson),
    /// Inverse filter with an optimised cap of its gain
    Rifta(rifta::Rifta),
    /// Adjoint image of the extended map, refined by its residual
    Udo(udo::Udo),
    /// Feed law of rasters: the area of every segment decides; no solver
    #[command(hide = true)]
    FeedLaw(feed_law::FeedLaw),
}

impl Solver {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::BoundedLeastSquares(arguments) => arguments.run(),
            Self::SeveralTools(arguments) => arguments.run(),
            Self::ChooseTools(arguments) => arguments.run(),
            Self::Bound(arguments) => arguments.run(),
            Self::Front(arguments) => arguments.run(),
            Self::Bcls(arguments) => arguments.run(),
            Self::NonNegativeLeastSquares(arguments) => arguments.run(),
            Self::TikhonovLsqr(arguments) => arguments.run(),
            Self::TruncatedSvd(arguments) => arguments.run(),
            Self::LucyRichardson(arguments) => arguments.run(),
            Self::Rifta(arguments) => arguments.run(),
            Self::Udo(arguments) => arguments.run(),
            Self::FeedLaw(arguments) => arguments.run(),
        }
    }
}

/// Arguments that every solver has in common.
#[derive(Args)]
struct CommonArgs {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    /// Weight of every pixel [.npy file (ny, nx), >= 0] [default: from the standard deviations of the map, or 1 if it
    /// has none]
    #[arg(long, value_name = "FILE")]
    weight: Option<PathBuf>,
    /// Columns of the removal model: the tool stands at the dwell point, or moves along the segment
    #[arg(long, value_enum, default_value = "segment")]
    columns: Columns,
    #[command(flatten)]
    output: OutputArgs,
}

/// Settings of a solver together with those that all solvers have, as the manifest states them.
#[derive(Serialize)]
struct Resolved<S> {
    columns: Columns,
    min_dwell: Bound,
    #[serde(flatten)]
    solver: S,
}

/// Report of a solver together with the [`Outcome`] that all solvers have, as the manifest states them.
#[derive(Serialize)]
struct Reported<'a, R> {
    #[serde(flatten)]
    outcome: &'a Outcome,
    #[serde(flatten)]
    report: &'a R,
}

/// The inputs of a solver, as read from the files: desired removal, TIF, path, and weights of the pixels if given.
struct Nouns {
    desired: Surface,
    tif: Tif,
    path: ToolPath,
    weight: Option<Array2<f64>>,
}

impl CommonArgs {
    fn read(&self, inputs: &mut Inputs) -> Result<Nouns, Failure> {
        let (desired, tif) = self.mirror.read(inputs)?;
        let path = self.path.read(inputs)?;
        let weight = match &self.weight {
            Some(file) => Some(inputs.read_map("weight", file)?),
            None => None,
        };
        Ok(Nouns { desired, tif, path, weight })
    }
}

/// End of a solver, as the command reports it.
struct Ended {
    /// Reason for which the solver ended.
    end: End,
    /// Reason of a negative verdict; none if the verdict is positive.
    negative: Option<String>,
    /// Further words for the user, within the printed line.
    words: String,
}

/// Reads the inputs, runs the solver, writes the dwell times, and prints one line. Returns without running it if the
/// output of the same task and inputs exists.
fn solve<S: Serialize, R: Serialize>(
    method: &'static str,
    common: &CommonArgs,
    floor: &FloorArgs,
    settings: S,
    solver: impl FnOnce(&Problem<'_>, &S) -> Result<Solution<R>, DwellError>,
    ended: impl FnOnce(&R, &S) -> Ended,
) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let resolved = Resolved {
        columns: common.columns,
        min_dwell: floor.bound(Bound::Seconds, Bound::SecondsPerMm)?,
        solver: settings,
    };
    let task = task!(method, &resolved);
    let nouns = common.read(&mut inputs)?;
    let mut output =
        match Output::directory(&common.output, DwellTime::KIND).begin(&task, &inputs)? {
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
    let solution = solver(&problem, &resolved.solver).map_err(Failure::with_flags)?;
    let Ended { end, negative, words } = ended(&solution.report, &resolved.solver);
    let Solution { dwell, outcome, report } = &solution;
    let before = rms_before(&nouns.desired, nouns.weight.as_ref());
    let status = status(negative.or_else(|| outcome.drawback(before)));
    let written = PlanOutcome {
        end: Some(end.into()),
        report: Some(Reported { outcome, report }),
        ..PlanOutcome::default()
    };
    output.write(dwell, written, &status)?;
    warn_of(outcome.tif_lattice);
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
        common.output.out.display()
    ));
    Ok(status)
}

/// Warns if the TIF is too sharp for the lattice of the map.
fn warn_of(lattice: Option<TifLattice>) {
    if let Some(warning) = lattice.and_then(|lattice| lattice.warning()) {
        warn(warning);
    }
}

/// Returns the status of the command: negative with this reason, in which names of settings become flags; done if
/// there is no reason.
fn status(negative: Option<String>) -> Status {
    negative.map_or(Status::Done, |reason| Status::Negative(with_flags(&reason)))
}
