//! `planish-refine pareto`: residual against total time.

use ndarray::{Array1, Array2};
use planish_dwell::bounded_least_squares::Bound;
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status,
    flags::{FloorArgs, MachineArgs, MirrorArgs, OutputArgs, PathArgs},
    kind,
    npy::ArrayData,
    say, task,
};
use planish_refine::{Scheduler, Settings, trade_off};
use planish_schedule::pvt::ModeChoice;
use planish_types::{End, Invalid, plausible};
use serde_json::json;

/// Refine at rising prices of a second: residual against total time
///
/// Writes the plans as iterations and DIR/pareto.svg, and prints the table.
#[derive(clap::Args)]
pub struct Pareto {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    machine: MachineArgs,
    #[command(flatten)]
    floor: FloorArgs,
    /// Shape of the PVT motion
    #[arg(long, value_enum, default_value = "auto")]
    mode: ModeChoice,
    /// Prices beside that of nothing
    #[arg(long, value_name = "N", default_value_t = 8)]
    prices: usize,
    /// Most rounds of every refinement but the first
    #[arg(long, value_name = "N", default_value_t = 6)]
    max_rounds: usize,
    #[command(flatten)]
    output: OutputArgs,
}

/// Most prices: a curve of more points looks the same, and takes days.
const MOST_PRICES: usize = 1000;

/// The plans, their table and their picture.
pub fn pareto(cli: &Pareto) -> Result<Status, Failure> {
    let mut settings = Settings { max_rounds: cli.max_rounds, ..Settings::default() };
    settings.dwell.min_dwell = cli.floor.bound(Bound::Seconds, Bound::SecondsPerMm);
    let mut inputs = Inputs::new();
    let (surface, tif) = cli.mirror.read(&mut inputs)?;
    let path = cli.path.read(&mut inputs)?;
    let machine = cli.machine.read(&mut inputs)?;
    settings.scheduler = Scheduler::Pvt(cli.mode.on(&machine));
    let task = task!("pareto", json!({ "prices": cli.prices, "refine": settings }));
    let mut output =
        match Output::directory(&cli.output, &kind::ITERATIONS).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };

    plausible::check_path(&surface, &tif, &path)?;
    if cli.prices > MOST_PRICES {
        let problem = format!("is {}", cli.prices);
        let remedy = format!("give at most {MOST_PRICES}: every price is a refinement");
        return Err(Invalid::whole("prices", problem, remedy).into());
    }
    let prices = trade_off::prices(&surface, &tif, cli.prices);
    let points = trade_off::trade_off(&surface, &tif, &path, &machine, &prices, &settings)?;
    let least_time_s = trade_off::least_time_s(&surface, &tif);

    say("| price, nm^2/s | total time, s | residual RMS, nm | limits |");
    say("|---|---|---|---|");
    for p in &points {
        say(format!(
            "| {:.2e} | {:.1} | {:.4} | {} |",
            p.time_weight_nm2_per_s,
            p.best.total_time_s,
            p.best.rms_nm,
            if p.best.limits_respected { "kept" } else { "exceeded" }
        ));
    }
    say(format!("volume / VRR: {least_time_s:.1} s"));
    let (m, n) = (points.len(), path.len());
    let column = |f: fn(&trade_off::Point) -> f64| {
        ArrayData::F64(points.iter().map(f).collect::<Array1<f64>>().into_dyn())
    };
    let dwell = Array2::from_shape_fn((m, n), |(i, j)| points[i].best.dwell_s[j]);
    let stretched: Array1<i64> = points.iter().map(|p| p.best.stretched as i64).collect();
    let arrays = [
        ArrayData::F64(dwell.into_dyn()),
        column(|p| p.best.rms_nm),
        column(|p| p.best.total_time_s),
        ArrayData::I64(stretched.into_dyn()),
    ];
    let picture = trade_off::svg(&points, least_time_s).into_bytes();
    let ends: Vec<End> = points.iter().map(|p| p.end).collect();
    let outcome = json!({
        "end": End::AllPrices,
        "ends": ends,
        "time_weight_nm2_per_s": prices,
        "least_time_s": least_time_s,
    });
    let kept = points.iter().all(|p| p.best.limits_respected);
    let status = if kept {
        Status::Done
    } else {
        Status::Negative("some plan exceeds the limits of the machine".into())
    };
    let beside = [("pareto.svg", picture)];
    output.write_arrays(&kind::ITERATIONS, &arrays, &beside, outcome, &status)?;
    say(format!("-> {}", cli.output.out.display()));
    Ok(status)
}
