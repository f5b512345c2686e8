//! `planish dwell front`.

use clap::Args;
use planish_dwell::{
    bounded_least_squares::Bound,
    front::{FrontSettings, Worth, front},
};
use planish_handoff::{
    Failure, Inputs, Status,
    flags::{FloorArgs, MirrorArgs, OutputFileArgs, PathArgs},
    say, warn,
};
use planish_types::plausible;

#[derive(Args)]
pub struct FrontArgs {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    floor: FloorArgs,
    /// Elasticity of the plan: percentage by which one percent more time would lower the mean square of the residual
    /// [default: 0.5]
    #[arg(long, value_name = "X", conflicts_with = "time_weight_nm2_per_s")]
    time_elasticity: Option<f64>,
    /// Price of a second, relative to half the mean square of the residual, nm^2/s
    #[arg(long, value_name = "L")]
    time_weight_nm2_per_s: Option<f64>,
    #[command(flatten)]
    output: OutputFileArgs,
}

impl FrontArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let (surface, tif) = self.mirror.read(&mut inputs)?;
        let path = self.path.read(&mut inputs)?;
        let worth = match (self.time_weight_nm2_per_s, self.time_elasticity) {
            (Some(price), _) => Worth::Nm2PerS(price),
            (None, elasticity) => Worth::Elasticity(elasticity.unwrap_or(0.5)),
        };
        let min_dwell = self.floor.bound(Bound::Seconds, Bound::SecondsPerMm)?;
        let output = self.output.begin(&inputs)?;
        plausible::check_path(&surface, &tif, &path)?;
        let settings = FrontSettings { min_dwell, worth };
        let front = front(&surface, &tif, &path, &settings).map_err(Failure::with_flags)?;
        output.write(&serde_json::to_vec_pretty(&front)?)?;
        front.doubts.iter().for_each(warn);
        for point in &front.points {
            say(format!(
                "{:.4} nm RMS in {:.2} s at {:.3e} nm^2/s{}",
                point.rms_nm,
                point.time_s,
                point.price_nm2_per_s,
                if *point == front.chosen { ": the wanted worth of time" } else { "" }
            ));
        }
        Ok(Status::Done)
    }
}
