//! `planish schedule constant-acceleration`.

use clap::Args;
use planish_schedule::{ScheduleError, constant_acceleration};
use planish_types::{DwellTime, Limits, ToolPath};
use serde_json::json;

use super::{Made, MotionCommand, NoSettings, micron};

#[derive(Args)]
pub struct ConstantAcceleration {}

impl MotionCommand for ConstantAcceleration {
    const METHOD: &'static str = "constant-acceleration";

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
        let s = constant_acceleration::schedule(path, dwell, machine)?;
        let r = &s.report;
        let remark = format!(
            "; overshoot beyond 1 nm in {} x and {} y segments, up to {:.1} and {:.1} um; {} segments late \
             by {:.4} s",
            r.overshoot_segments[0],
            r.overshoot_segments[1],
            micron(r.largest_overshoot_mm[0]),
            micron(r.largest_overshoot_mm[1]),
            r.late_segments,
            r.added_s
        );
        Ok(Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark })
    }
}
