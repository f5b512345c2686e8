//! `planish refine pareto`: residual against total time.

use clap::Args;
use planish_dwell::bounded_least_squares::Bound;
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status,
    flags::{FloorArgs, MachineArgs, MirrorArgs, OutputArgs, PathArgs},
    kind, say, task,
};
use planish_refine::{
    RefineSettings,
    trade_off::{self, PlanMethod},
};
use planish_schedule::pvt::{self, ModeChoice};
use planish_types::{End, plausible, progress};
use serde_json::json;

use super::iterations;

/// Plan at rising prices of a second: residual against total time
///
/// Each price has a plan of the closed loop, and a joint plan of motion and times (planish joint). The program
/// writes the plans as iterations and DIR/pareto.svg, and prints a table. It also prints the least total time of
/// any plan: the volume to be removed over the volumetric removal rate (VRR) of the tool.
#[derive(Args)]
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
    /// Number of prices besides zero
    #[arg(long, value_name = "N", default_value_t = 8)]
    prices: usize,
    /// Largest number of rounds of the refinement at each price of a second after the first
    #[arg(long, value_name = "N", default_value_t = 6)]
    max_rounds: usize,
    #[command(flatten)]
    output: OutputArgs,
}

impl Pareto {
    /// Computes the plans and writes them with their table and their picture.
    ///
    /// # Errors
    ///
    /// Refuses inputs that cannot be read or do not fit each other. Fails where a plan fails or the output cannot be
    /// written.
    pub fn run(&self) -> Result<Status, Failure> {
        let mut settings =
            RefineSettings { max_rounds: self.max_rounds, ..RefineSettings::default() };
        settings.dwell.min_dwell = self.floor.bound(Bound::Seconds, Bound::SecondsPerMm)?;
        let mut inputs = Inputs::new();
        let (surface, tif) = self.mirror.read(&mut inputs)?;
        let path = self.path.read(&mut inputs)?;
        let machine = self.machine.read(&mut inputs)?;
        let scheduler = pvt::PvtSettings::new(self.mode.on(&machine));
        settings.scheduler = &scheduler;
        let task = task!("pareto", json!({ "prices": self.prices, "refine": settings }));
        let mut output =
            match Output::directory(&self.output, &kind::ITERATIONS).begin(&task, &inputs)? {
                Begin::Unchanged(status) => return Ok(status),
                Begin::Run(output) => output,
            };

        plausible::check_path(&surface, &tif, &path)?;
        let prices = trade_off::prices(&surface, &tif, self.prices)?;
        let mut points = progress::part(0, 2, || {
            trade_off::trade_off(&surface, &tif, &path, &machine, &prices, &settings)
        })
        .map_err(Failure::with_flags)?;
        // A floor per dwell point does not apply to a motion without points.
        let floor = self.floor.bound(|_| 0.0, |s_per_mm| s_per_mm)?;
        let of_joint_plans = progress::part(1, 2, || {
            trade_off::feed_trade_off(&surface, &tif, &path, &machine, &prices, floor)
        });
        points.extend(of_joint_plans.map_err(Failure::with_flags)?);
        let least_time_s = trade_off::least_time_s(&surface, &tif);

        say("| method | price, nm^2/s | total time, s | residual RMS, nm | limits |");
        say("|---|---|---|---|---|");
        for p in &points {
            say(format!(
                "| {} | {:.2e} | {:.1} | {:.4} | {} |",
                p.method.name(),
                p.time_weight_nm2_per_s,
                p.best.total_time_s,
                p.best.rms_nm,
                if p.best.limits_respected { "kept" } else { "exceeded" }
            ));
        }
        say(format!(
            "volume / VRR: {least_time_s:.1} s, the least total time of any plan: the volume to be removed over the \
             volumetric removal rate of the tool"
        ));
        let arrays = iterations(points.iter().map(|p| &p.best));
        let picture = trade_off::svg(&points, least_time_s).into_bytes();
        let ends: Vec<End> = points.iter().map(|p| p.end).collect();
        let methods: Vec<PlanMethod> = points.iter().map(|p| p.method).collect();
        let of_points: Vec<f64> = points.iter().map(|p| p.time_weight_nm2_per_s).collect();
        let outcome = json!({
            "end": End::AllPrices,
            "ends": ends,
            "methods": methods,
            "time_weight_nm2_per_s": of_points,
            "least_time_s": least_time_s,
        });
        let status = trade_off::negative(&points).map_or(Status::Done, Status::Negative);
        let beside = [("pareto.svg", picture)];
        output.write_arrays(&kind::ITERATIONS, &arrays, &beside, outcome, &status)?;
        say(format!("-> {}", self.output.out.display()));
        Ok(status)
    }
}
