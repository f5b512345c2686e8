//! `planish-dwell`: dwell times for a desired removal along a tool path.

mod flags;

use std::{path::PathBuf, process::ExitCode};

use clap::{Args, Parser, Subcommand};
use planish_dwell::{
    bounded_least_squares::{self, Bound, Free, Program, Settings},
    columns::Columns,
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{FloorArgs, MirrorArgs, OutputArgs, PathArgs},
    run, say, task,
};
use planish_types::{DwellTime, plausible};
use serde_json::json;

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-dwell bounded-least-squares --surface out/surface --tif tool --tool-path out/tool_path --min-dwell-s 0.1 --out out/dwell\n\
    \x20 planish-dwell lucy-richardson --surface out/surface --tif tool --tool-path out/tool_path --out out/dwell";

/// Find the dwell times that remove what is desired
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    solver: Solver,
}

#[derive(Subcommand)]
enum Solver {
    /// Smallest RMS residual with a free piston and bounds on every dwell time
    BoundedLeastSquares(BoundedLeastSquares),
    /// The same within the dwell times that feed and acceleration limits allow
    Bcls(flags::Bcls),
    /// The same with a floor only, one component at a time (Lawson and Hanson); slow
    NonNegativeLeastSquares(flags::NonNegativeLeastSquares),
    /// Damped least squares without bounds; damping given, by discrepancy, or by L-curve
    TikhonovLsqr(flags::TikhonovLsqr),
    /// Least squares in the space of the large singular values, without bounds
    TruncatedSvd(flags::TruncatedSvd),
    /// Positive multiplicative steps with total-variation smoothing
    LucyRichardson(flags::LucyRichardson),
    /// Inverse filter with an optimised cap of its gain
    Rifta(flags::Rifta),
    /// Adjoint image of the extended map, refined by its residual
    Udo(flags::Udo),
}

#[derive(Args)]
struct BoundedLeastSquares {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    /// Weight of every pixel [.npy file (ny, nx), >= 0]; without it valid pixels count 1
    #[arg(long, value_name = "FILE")]
    weight: Option<PathBuf>,
    #[command(flatten)]
    floor: FloorArgs,
    /// Largest dwell time of every dwell point, s
    #[arg(long, value_name = "T", conflicts_with = "max_dwell_s_per_mm")]
    max_dwell_s: Option<f64>,
    /// Largest dwell time per length of the segment, s/mm
    #[arg(long, value_name = "T")]
    max_dwell_s_per_mm: Option<f64>,
    /// Least dwell times point by point [dwell artifact]
    #[arg(long, value_name = "DIR", conflicts_with_all = ["min_dwell_s", "min_dwell_s_per_mm"])]
    min_dwell: Option<PathBuf>,
    /// Largest dwell times point by point [dwell artifact]
    #[arg(long, value_name = "DIR", conflicts_with_all = ["max_dwell_s", "max_dwell_s_per_mm"])]
    max_dwell: Option<PathBuf>,
    /// Price of a second beside half the mean square of the residual, nm^2/s
    #[arg(long, visible_alias = "time-weight", value_name = "L", default_value_t = 0.0)]
    time_weight_nm2_per_s: f64,
    /// What need not be removed
    #[arg(long, value_enum, default_value = "piston")]
    free: Free,
    /// Residual above which a pixel counts linearly instead of squared, nm: robust to pits
    #[arg(long, value_name = "K")]
    huber_nm: Option<f64>,
    /// RMS of the noise of the map, nm: the smoothness is raised until the residual reaches it
    #[arg(long, value_name = "S")]
    noise_rms_nm: Option<f64>,
    /// What a dwell time is spent on
    #[arg(long, value_enum, default_value = "segment")]
    columns: Columns,
    /// Weight of the distance to the least dwell time, relative to the strongest column
    #[arg(long, value_name = "A", default_value_t = Settings::default().tikhonov)]
    tikhonov: f64,
    /// Weight of the roughness of the dwell-time density along the path
    #[arg(long, value_name = "B", default_value_t = Settings::default().smoothness)]
    smoothness: f64,
    #[command(flatten)]
    output: OutputArgs,
}

fn main() -> ExitCode {
    let cli: Cli = planish_handoff::parse();
    run(|| match &cli.solver {
        Solver::BoundedLeastSquares(arguments) => bounded_least_squares(arguments),
        Solver::Bcls(arguments) => flags::bcls(arguments),
        Solver::NonNegativeLeastSquares(arguments) => flags::non_negative_least_squares(arguments),
        Solver::TikhonovLsqr(arguments) => flags::tikhonov_lsqr(arguments),
        Solver::TruncatedSvd(arguments) => flags::truncated_svd(arguments),
        Solver::LucyRichardson(arguments) => flags::lucy_richardson(arguments),
        Solver::Rifta(arguments) => flags::rifta(arguments),
        Solver::Udo(arguments) => flags::udo(arguments),
    })
}

fn bounded_least_squares(cli: &BoundedLeastSquares) -> Result<Status, Failure> {
    let defaults = Settings::default();
    let settings = Settings {
        columns: cli.columns,
        min_dwell: cli.floor.bound(Bound::Seconds, Bound::SecondsPerMm),
        max_dwell: cli
            .max_dwell_s
            .map(Bound::Seconds)
            .or(cli.max_dwell_s_per_mm.map(Bound::SecondsPerMm)),
        tikhonov: cli.tikhonov,
        smoothness: cli.smoothness,
        time_weight_nm2_per_s: cli.time_weight_nm2_per_s,
        free: cli.free,
        huber_nm: cli.huber_nm,
        noise_rms_nm: cli.noise_rms_nm,
        ..defaults
    };
    let mut inputs = Inputs::new();
    let (surface, tif) = cli.mirror.read(&mut inputs)?;
    let path = cli.path.read(&mut inputs)?;
    let weight = cli.weight.as_ref().map(|file| inputs.read_map("weight", file)).transpose()?;
    let least: Option<DwellTime> =
        cli.min_dwell.as_ref().map(|dir| inputs.read("min-dwell", dir)).transpose()?;
    let most: Option<DwellTime> =
        cli.max_dwell.as_ref().map(|dir| inputs.read("max-dwell", dir)).transpose()?;
    let task = task!("bounded-least-squares", settings);
    let mut output = match Output::directory(&cli.output, DwellTime::KIND).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };

    plausible::check_path(&surface, &tif, &path)?;
    let (lo, hi) = bounded_least_squares::bounds(&path, &settings)?;
    let program = Program {
        places: &settings.columns.places(&path),
        lo: least.map_or(lo, |least| least.dwell_s().to_vec()),
        hi: most.map_or(hi, |most| most.dwell_s().to_vec()),
        guess: None,
    };
    let solution = bounded_least_squares::solve_columns(
        &surface,
        &tif,
        &path,
        weight.as_ref(),
        &settings,
        &program,
    )?;

    let r = &solution.report;
    let status = flags::bounded_status(r, flags::before(&surface, weight.as_ref()));
    output.write(&solution.dwell, json!({ "end": r.end, "report": r }), &status)?;
    say(format!(
        "bounded least squares: {} dwell times, {:.2} s, {:.4} nm RMS in its own model; {} {} after {} \
         iterations, KKT residual {:.1e} s; {} at the lower bound, {} out of reach -> {}",
        solution.dwell.dwell_s().len(),
        r.total_time_s,
        r.model_rms_nm,
        r.algorithm,
        r.end,
        r.iterations,
        r.kkt_residual_s,
        r.at_lower_bound,
        r.unreached_points,
        cli.output.out.display()
    ));
    Ok(status)
}
