//! `planish schedule trig-spline`.

use std::path::{Path, PathBuf};

use clap::Args;
use planish_schedule::{ScheduleError, trig_spline};
use planish_types::{DwellTime, Limits, ToolPath};
use serde_json::json;

use super::{Made, MotionCommand};

#[derive(Args)]
pub struct TrigSpline {
    /// Repair of the dwell-time densities that the machine cannot follow
    #[arg(long, value_enum, default_value = "offset")]
    repair: trig_spline::Repair,
    /// Largest distance of the motion from a corner of the path, mm, but at most the usual tolerance of the path; larger
    /// values let the tool pass corners faster
    #[arg(long, value_name = "MM", default_value_t = trig_spline::TrigSplineSettings::default().corner_deviation_mm)]
    corner_deviation_mm: f64,
    /// Largest error of the position in the fit of the motion by cubics, mm
    #[arg(long, value_name = "MM", default_value_t = trig_spline::TrigSplineSettings::default().fit_tolerance_mm)]
    fit_tolerance_mm: f64,
    /// Output directory of the nodes of the spline, for `interpolate` and `program` [dwell_density artifact]
    #[arg(long, value_name = "DIR")]
    dwell_density_out: Option<PathBuf>,
}

impl MotionCommand for TrigSpline {
    const METHOD: &'static str = "trig-spline";

    type SchedulerSettings = trig_spline::TrigSplineSettings;

    fn settings(&self, _: &Limits, _: f64) -> trig_spline::TrigSplineSettings {
        trig_spline::TrigSplineSettings {
            repair: self.repair,
            corner_deviation_mm: self.corner_deviation_mm,
            fit_tolerance_mm: self.fit_tolerance_mm,
        }
    }

    fn dwell_density(&self) -> Option<&Path> {
        self.dwell_density_out.as_deref()
    }

    fn make(
        path: &ToolPath,
        dwell: &DwellTime,
        machine: &Limits,
        settings: &trig_spline::TrigSplineSettings,
    ) -> Result<Made, ScheduleError> {
        let s = trig_spline::schedule(path, dwell, machine, settings)?;
        let r = &s.report;
        let offset = r.feed_offset_s_per_mm + r.acceleration_offset_s_per_mm;
        let remark = format!(
            "; offset {offset:.6} s/mm adds {:.3} s; {} of {} corners slowed, adding {:.3} s; {} links take \
             {:.3} s",
            r.offset_added_s, r.slowed_corners, r.corners, r.corner_added_s, r.links, r.link_s
        );
        Ok(Made { trajectory: s.trajectory, density: s.density, report: json!(s.report), remark })
    }
}
