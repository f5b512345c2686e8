//! `planish schedule average-velocity`.

use clap::Args;
use planish_schedule::{
    ScheduleError,
    baselines::average_velocity,
    claim::{Claim, JUMPS},
};
use planish_types::{DwellTime, Limits, ToolPath};
use serde_json::json;

use super::{Made, MotionCommand, NoSettings};

#[derive(Args)]
pub struct AverageVelocity {}

impl MotionCommand for AverageVelocity {
    const METHOD: &'static str = "average-velocity";

    type SchedulerSettings = NoSettings;

    fn settings(&self, _: &Limits, _: f64) -> NoSettings {
        NoSettings {}
    }

    fn make(
        path: &ToolPath,
        dwell: &DwellTime,
        machine: &Limits,
        _: &NoSettings,
    ) -> Result<Made, ScheduleError> {
        let s = average_velocity::schedule(path, dwell, machine)?;
        let [x, y] = s.report.largest_velocity_step_mm_per_s;
        let remark = format!("; velocity steps of up to {x:.3} and {y:.3} mm/s");
        Ok(Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark })
    }

    fn advice(_: &NoSettings, _: &Claim) -> Option<String> {
        Some(JUMPS.into())
    }
}
