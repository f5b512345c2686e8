//! `planish schedule pvt`.

use clap::Args;
use planish_schedule::{ScheduleError, claim::Claim, pvt};
use planish_types::{DwellTime, Limits, ToolPath};
use serde_json::json;

use super::{Made, MotionCommand};

#[derive(Args)]
pub struct Pvt {
    /// Shape of the PVT motion
    #[arg(long, value_enum, default_value = "auto")]
    mode: pvt::ModeChoice,
    /// Refuse dwell times that the machine cannot follow instead of stretching them
    #[arg(long)]
    no_stretch: bool,
}

impl MotionCommand for Pvt {
    const METHOD: &'static str = "pvt";

    type SchedulerSettings = pvt::PvtSettings;

    fn settings(&self, machine: &Limits, max_path_distance_mm: f64) -> pvt::PvtSettings {
        pvt::PvtSettings {
            stretch: !self.no_stretch,
            max_path_distance_mm: Some(max_path_distance_mm),
            ..pvt::PvtSettings::new(self.mode.on(machine))
        }
    }

    fn kind(settings: &pvt::PvtSettings) -> Option<&'static str> {
        Some(settings.mode.name())
    }

    fn make(
        path: &ToolPath,
        dwell: &DwellTime,
        machine: &Limits,
        settings: &pvt::PvtSettings,
    ) -> Result<Made, ScheduleError> {
        let s = pvt::schedule(path, dwell, machine, settings)?;
        let remark = format!(
            "; {} segments stretched by {:.4} s with the tool on, {:.4} s lifted; {} nodes held near the path",
            s.report.stretched.len(),
            s.report.added_tool_on_s,
            s.report.added_tool_off_s,
            s.report.held_nodes
        );
        Ok(Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark })
    }

    fn advice(settings: &pvt::PvtSettings, claim: &Claim) -> Option<String> {
        let other = settings.mode.for_jerk(claim)?;
        Some(format!("--mode {} keeps a limit on jerk", other.name()))
    }
}
