//! `planish schedule stop-at-corners`.

use clap::Args;
use planish_schedule::{ScheduleError, stop_at_corners};
use planish_types::{DwellTime, Limits, ToolPath};
use serde_json::json;

use super::{Made, MotionCommand, NoSettings};

#[derive(Args)]
pub struct StopAtCorners {}

impl MotionCommand for StopAtCorners {
    const METHOD: &'static str = "stop-at-corners";

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
        let s = stop_at_corners::schedule(path, dwell, machine)?;
        let r = &s.report;
        let remark = format!(
            "; at rest in {} corners; {} segments late by {:.4} s, {} lifts by {:.4} s",
            r.stops, r.late_segments, r.added_s, r.lifts, r.added_lifted_s
        );
        Ok(Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark })
    }
}
