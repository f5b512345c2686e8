//! `planish-refine`: dwell times corrected against the motion that will run.

mod pareto;

use std::{path::PathBuf, process::ExitCode};

use clap::{Args, Parser, Subcommand, ValueEnum};
use ndarray::{Array1, Array2};
use planish_dwell::bounded_least_squares::Bound;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags,
    flags::{FloorArgs, MachineArgs, MirrorArgs, OutputArgs, PathArgs},
    kind,
    npy::ArrayData,
    run, say, task,
};
use planish_refine::{Iterate, Scheduler, Settings, refine};
use planish_schedule::pvt;
use planish_types::{
    DwellTime, End, Trajectory,
    plausible::{self, Rms},
};
use serde::Serialize;
use serde_json::json;

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-refine --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --min-dwell-s 0.1 --out out/refined\n\
    \x20 planish-refine pareto --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --out out/pareto";

/// Correct the dwell times against the removal of the scheduled motion, round by round
///
/// Writes DIR/dwell and DIR/trajectory of the best round, and DIR/iterations with all of them.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    refine: Option<Refine>,
}

#[derive(Subcommand)]
enum Command {
    /// Refine at rising prices of a second: residual against total time
    Pareto(pareto::Pareto),
}

/// The group names its required member: clap leaves a group with flattened members empty.
#[derive(Args)]
#[group(args = ["surface"])]
struct Refine {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    machine: MachineArgs,
    /// First dwell times [dwell artifact]; without it, bounded least squares
    #[arg(long, value_name = "DIR")]
    dwell: Option<PathBuf>,
    #[command(flatten)]
    floor: FloorArgs,
    /// Weight of the distance to the least dwell time, relative to the strongest column
    #[arg(long, value_name = "A", default_value_t = Settings::default().dwell.tikhonov)]
    tikhonov: f64,
    /// Weight of the roughness of the dwell-time density along the path, in the last corrections
    #[arg(long, value_name = "B", default_value_t = Settings::default().dwell.smoothness)]
    smoothness: f64,
    /// Price of a second beside half the mean square of the residual, nm^2/s
    #[arg(long, visible_alias = "time-weight", value_name = "L", default_value_t = 0.0)]
    time_weight_nm2_per_s: f64,
    /// RMS of the noise of the map, nm: the smoothness is raised until the residual reaches it
    #[arg(long, value_name = "S")]
    noise_rms_nm: Option<f64>,
    /// What makes the motion
    #[arg(long, value_enum, default_value = "pvt")]
    scheduler: SchedulerKind,
    /// Shape of the PVT motion
    #[arg(long, value_enum, default_value = "auto")]
    mode: pvt::ModeChoice,
    /// Most rounds; where a number is given, to stop there is what is wanted [default: 12, and a negative
    /// verdict where they still improve]
    #[arg(long, value_name = "N")]
    max_rounds: Option<usize>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum SchedulerKind {
    /// Cubic segments, stretched where the limits ask for it
    Pvt,
    /// One constant acceleration, then constant velocity, per segment; no look-ahead
    ConstantAcceleration,
}

fn main() -> ExitCode {
    let cli: Cli = planish_handoff::parse();
    run(|| match (&cli.command, &cli.refine) {
        (Some(Command::Pareto(arguments)), _) => pareto::pareto(arguments),
        (None, Some(arguments)) => body(arguments),
        (None, None) => Err(Failure::new("no arguments; planish-refine --help shows them")),
    })
}

fn body(cli: &Refine) -> Result<Status, Failure> {
    let mut settings = Settings::default();
    settings.max_rounds = cli.max_rounds.unwrap_or(settings.max_rounds);
    settings.dwell.time_weight_nm2_per_s = cli.time_weight_nm2_per_s;
    settings.dwell.noise_rms_nm = cli.noise_rms_nm;
    settings.dwell.min_dwell = cli.floor.bound(Bound::Seconds, Bound::SecondsPerMm);
    settings.dwell.tikhonov = cli.tikhonov;
    settings.dwell.smoothness = cli.smoothness;
    let method = match cli.scheduler {
        SchedulerKind::Pvt => "pvt",
        SchedulerKind::ConstantAcceleration => "constant-acceleration",
    };
    let mut inputs = Inputs::new();
    let (surface, tif) = cli.mirror.read(&mut inputs)?;
    let path = cli.path.read(&mut inputs)?;
    let machine = cli.machine.read(&mut inputs)?;
    settings.scheduler = match cli.scheduler {
        SchedulerKind::ConstantAcceleration => Scheduler::ConstantAcceleration,
        SchedulerKind::Pvt => Scheduler::Pvt(cli.mode.on(&machine)),
    };
    let resolved = Resolved { settings, stop_at_max_rounds: cli.max_rounds.is_some() };
    let task = task!(method, resolved);
    let first = cli.dwell.as_ref().map(|dir| flags::read_dwell(dir, &mut inputs)).transpose()?;
    let parts = [
        ("dwell", DwellTime::KIND),
        ("trajectory", Trajectory::KIND),
        ("iterations", &kind::ITERATIONS),
    ];
    let mut output = match Output::directories(&cli.output, parts).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };

    plausible::check_path(&surface, &tif, &path)?;
    let refined = refine(&surface, &tif, &path, &machine, first, &settings)?;

    let best = &refined.iterates[refined.best];
    let outcome = json!({
        "best_round": refined.best,
        "end": refined.end,
        "at_bound": refined.at_bound,
        "rms_nm": best.rms_nm,
        "total_time_s": best.total_time_s,
    });
    let (before, after) =
        (Rms::of(&surface), Rms { rms_nm: best.rms_nm, detilted_nm: best.detilted_nm });
    let negative = if !best.limits_respected {
        Some("no round keeps the limits of the machine".into())
    } else if refined.end == End::RoundLimit && cli.max_rounds.is_none() {
        Some(format!(
            "not converged: {} rounds were done before they ceased to improve; the best plan is kept, and \
             --max-rounds allows more, or says that these are enough",
            refined.iterates.len()
        ))
    } else {
        plausible::drawback(before, after, best.total_time_s)
    };
    let status = negative.map_or(Status::Done, Status::Negative);
    output.write(&refined.dwell, outcome.clone(), &status)?;
    output.write(&refined.trajectory, outcome.clone(), &status)?;
    let arrays = iterations(&refined.iterates);
    output.write_arrays(&kind::ITERATIONS, &arrays, &[], outcome, &status)?;
    for (round, i) in refined.iterates.iter().enumerate() {
        say(format!(
            "round {round}: {:.4} nm RMS executed in {:.2} s, {} segments stretched{}{}",
            i.rms_nm,
            i.total_time_s,
            i.stretched,
            if i.limits_respected { "" } else { ", limits exceeded" },
            if round == refined.best { "  <- best" } else { "" }
        ));
    }
    let before = &refined.iterates[0];
    let mode = match settings.scheduler {
        Scheduler::Pvt(pvt::Mode::Smooth) => "pvt (smooth)",
        Scheduler::Pvt(pvt::Mode::Monotone) => "pvt (monotone)",
        Scheduler::ConstantAcceleration => "constant-acceleration",
    };
    say(format!(
        "{mode}: {} after {} rounds, {} of {} dwell times at a bound: {:.4} nm in {:.2} s before, {:.4} nm \
         in {:.2} s after -> {}",
        refined.end,
        refined.iterates.len(),
        refined.at_bound,
        path.len(),
        before.rms_nm,
        before.total_time_s,
        best.rms_nm,
        best.total_time_s,
        cli.output.out.display()
    ));
    Ok(status)
}

/// Every setting, and whether the number of rounds was given.
#[derive(Serialize)]
struct Resolved {
    #[serde(flatten)]
    settings: Settings,
    stop_at_max_rounds: bool,
}

/// The arrays of `kind::ITERATIONS`.
fn iterations(iterates: &[Iterate]) -> Vec<ArrayData> {
    let column = |f: fn(&Iterate) -> f64| {
        ArrayData::F64(iterates.iter().map(f).collect::<Array1<f64>>().into_dyn())
    };
    let (m, n) = (iterates.len(), iterates[0].dwell_s.len());
    let dwell = Array2::from_shape_fn((m, n), |(i, j)| iterates[i].dwell_s[j]);
    let stretched: Array1<i64> = iterates.iter().map(|i| i.stretched as i64).collect();
    vec![
        ArrayData::F64(dwell.into_dyn()),
        column(|i| i.rms_nm),
        column(|i| i.total_time_s),
        ArrayData::I64(stretched.into_dyn()),
    ]
}
