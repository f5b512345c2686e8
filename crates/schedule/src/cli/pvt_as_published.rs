//! `planish schedule pvt-as-published`.

use clap::Args;
use planish_schedule::{ScheduleError, baselines::pvt_as_published};
use planish_types::{DwellTime, Limits, ToolPath};
use serde_json::json;

use super::{Made, MotionCommand, micron};

#[derive(Args)]
pub struct PvtAsPublished {
    /// Node at which the tool rests besides the end: as Eq. 16 of the publication means, or as it is misprinted
    #[arg(long, value_enum, default_value = "corrected")]
    rest_condition: pvt_as_published::RestCondition,
}

impl MotionCommand for PvtAsPublished {
    const METHOD: &'static str = "pvt-as-published";

    type SchedulerSettings = pvt_as_published::AsPublishedSettings;

    fn settings(&self, _: &Limits, _: f64) -> pvt_as_published::AsPublishedSettings {
        pvt_as_published::AsPublishedSettings { rest_condition: self.rest_condition }
    }

    fn make(
        path: &ToolPath,
        dwell: &DwellTime,
        machine: &Limits,
        settings: &pvt_as_published::AsPublishedSettings,
    ) -> Result<Made, ScheduleError> {
        let s = pvt_as_published::schedule(path, dwell, machine, settings)?;
        let [x, y] = s.report.largest_position_error_mm.map(micron);
        let [vx, vy] = s.report.largest_resting_velocity_mm_per_s;
        let remark = format!(
            "; its least squares miss positions by up to {x:.1} and {y:.1} um, its resting axes move at up \
             to {vx:.3} and {vy:.3} mm/s"
        );
        Ok(Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark })
    }
}
