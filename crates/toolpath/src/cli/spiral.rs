//! `planish toolpath spiral`.

use clap::Args;
use planish_handoff::{Begin, Failure, Status, task};
use planish_toolpath::{SpiralSettings, spiral};
use serde_json::json;

use super::{Region, RegionArgs};

#[derive(Debug, Args)]
pub struct SpiralArgs {
    #[command(flatten)]
    region: RegionArgs,
    /// Longest segment, mm
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: f64,
}

impl SpiralArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let on = Region::read(&self.region)?;
        let pitch_mm = self.region.pitch_mm;
        let settings =
            SpiralSettings { pitch_mm, step_mm: self.step_mm, overscan_mm: on.overscan_mm };
        let mut output = match on.begin(&task!("spiral", &on.stated(&settings)))? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let path = spiral(&on.surface, &settings)?;
        on.write(&mut output, &path, pitch_mm, json!({}), Vec::new())
    }
}
