//! `planish schedule position`.

use clap::Args;
use planish_schedule::{
    ScheduleError,
    baselines::position,
    claim::{Claim, JUMPS},
};
use planish_types::{DwellTime, Limits, ToolPath};
use serde_json::json;

use super::{Made, MotionCommand, NoSettings};

#[derive(Args)]
pub struct Position {}

impl MotionCommand for Position {
    const METHOD: &'static str = "position";

    type SchedulerSettings = NoSettings;

    fn settings(&self, _: &Limits, _: f64) -> NoSettings {
        NoSettings {}
    }

    fn make(
        path: &ToolPath,
        dwell: &DwellTime,
        _: &Limits,
        _: &NoSettings,
    ) -> Result<Made, ScheduleError> {
        let trajectory = position::schedule(path, dwell)?;
        let remark = "; jumps between the points".into();
        Ok(Made { trajectory, density: None, report: json!({}), remark })
    }

    fn advice(_: &NoSettings, _: &Claim) -> Option<String> {
        Some(JUMPS.into())
    }
}
