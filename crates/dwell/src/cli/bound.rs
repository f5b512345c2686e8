//! `planish dwell bound`.

use std::path::PathBuf;

use clap::Args;
use planish_dwell::path_free_bound::{BoundSettings, bounds_on_any_path};
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status,
    flags::{MirrorArgs, OutputArgs},
    kind, say, task,
};
use planish_types::Trajectory;

use super::warn_of;

#[derive(Args)]
pub struct BoundArgs {
    #[command(flatten)]
    mirror: MirrorArgs,
    /// Run times, s, separated by commas
    #[arg(
        long,
        value_name = "T",
        value_delimiter = ',',
        required_unless_present_any = ["time_weight_nm2_per_s", "trajectory"]
    )]
    time_s: Vec<f64>,
    /// Price of a second, relative to half the mean square of the residual, nm^2/s. Several are separated by commas. The
    /// bound is for the run time that is best at the price
    #[arg(long, visible_alias = "time-weight", value_name = "L", value_delimiter = ',')]
    time_weight_nm2_per_s: Vec<f64>,
    /// Motion whose run time is one of the times [trajectory artifact]
    #[arg(long, value_name = "DIR")]
    trajectory: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
}

impl BoundArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let (surface, tif) = self.mirror.read(&mut inputs)?;
        let mut time_s = self.time_s.clone();
        if let Some(dir) = &self.trajectory {
            let motion: Trajectory = inputs.read("trajectory", dir)?;
            time_s.push(motion.total_time_s());
        }
        let settings =
            BoundSettings { time_s, time_weight_nm2_per_s: self.time_weight_nm2_per_s.clone() };
        let task = task!("bound", &settings);
        let mut output =
            match Output::directory(&self.output, &kind::BOUND).begin(&task, &inputs)? {
                Begin::Unchanged(status) => return Ok(status),
                Begin::Run(output) => output,
            };
        let outcome = bounds_on_any_path(&surface, &tif, &settings).map_err(Failure::with_flags)?;
        output.write_arrays(&kind::BOUND, &[], &[], &outcome, &Status::Done)?;
        warn_of(outcome.tif_lattice);
        for bound in &outcome.bounds {
            say(format!(
                "in {:.2} s no path and no motion of this tool leaves less than {:.4} nm RMS; dwell times at any place \
                 leave {:.4} nm (gap {:.2} %)",
                bound.time_s,
                bound.bound_rms_nm,
                bound.reached_rms_nm,
                100.0 * bound.gap
            ));
        }
        Ok(Status::Done)
    }
}
