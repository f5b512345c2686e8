//! `planish toolpath random-adaptive`.

use clap::Args;
use planish_handoff::{Begin, Failure, Status, task};
use planish_toolpath::{Construction, RandomAdaptiveSettings, random_adaptive};

use super::{Region, RegionArgs};

#[derive(Debug, Args)]
pub struct RandomAdaptiveArgs {
    #[command(flatten)]
    region: RegionArgs,
    /// Longest segment, mm, by which the path is divided anew [default: the nodes of the construction]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: Option<f64>,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Exponent of the density in the desired removal: 0 (uniform) to 1 (proportional)
    #[arg(long, value_name = "B", default_value_t = 1.0, allow_negative_numbers = true)]
    contrast: f64,
    /// Construction of the path: around a random spanning tree of triangles, or a short tour
    /// through random points
    #[arg(long, value_enum, default_value_t = Construction::MeshTree)]
    construction: Construction,
    /// Number of passes of corner cutting; each halves the turns and doubles the points
    #[arg(long, value_name = "K", default_value_t = 1)]
    rounding_passes: u32,
}

impl RandomAdaptiveArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let on = Region::read(&self.region)?;
        let settings = RandomAdaptiveSettings {
            pitch_mm: self.region.pitch_mm,
            overscan_mm: on.overscan_mm,
            step_mm: self.step_mm,
            contrast: self.contrast,
            construction: self.construction,
            rounding_passes: self.rounding_passes,
            seed: self.seed,
        };
        let mut output = match on.begin(&task!("random-adaptive", &on.stated(&settings)))? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let made = random_adaptive(&on.surface, &settings)?;
        on.write(&mut output, &made.path, made.report.largest_pitch_mm(), made.report, Vec::new())
    }
}
