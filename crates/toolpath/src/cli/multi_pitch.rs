//! `planish toolpath multi-pitch`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Begin, Failure, Status, flags::OutputArgs, task};
use planish_toolpath::{MultiPitchSettings, multi_pitch, multi_pitch::Links, pitch_limit};

use super::{FormArgs, Region, RegionArgs};

#[derive(Debug, Args)]
pub struct MultiPitchArgs {
    /// Map of the desired removal; its valid pixels (their centres) are the clear aperture [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Tool influence function [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Largest feed of the classes but the first, mm/s
    #[arg(long, value_name = "V", allow_negative_numbers = true)]
    max_velocity_mm_per_s: f64,
    /// Number of classes of depth
    #[arg(long, value_name = "M", default_value_t = 4)]
    classes: usize,
    /// Smallest pitch: what the machine can position, mm
    #[arg(long, value_name = "A", default_value_t = 0.1, allow_negative_numbers = true)]
    min_pitch_mm: f64,
    /// Largest pitch, mm [default: a sixth of the TIF's size, or less where the lines of a Gaussian
    /// as large would leave a ripple of 0.1 %]
    #[arg(long, value_name = "B", allow_negative_numbers = true)]
    max_pitch_mm: Option<f64>,
    /// Least area of a region, mm^2 [default: 25 pitches squared, at least 50]
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    min_area_mm2: Option<f64>,
    /// Longest segment, mm
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: f64,
    /// Distance that the path goes beyond the aperture, mm [default: half the side of the square about the centroid of the
    /// TIF with all but 0.05 % of its volume]
    #[arg(long, value_name = "O", allow_negative_numbers = true)]
    overscan_mm: Option<f64>,
    /// Machine and its limits, for a warning if the path leaves the travel of its axes [JSON]
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
    /// Refuse a path that leaves the travel, instead of a warning: no program can run it
    #[arg(long, requires = "machine")]
    within_travel: bool,
    /// Links between lines on which the tool stays on: all, those beyond the aperture (but not along the border of
    /// another region), or none
    #[arg(long, value_enum, default_value_t = Links::On)]
    links: Links,
    #[command(flatten)]
    output: OutputArgs,
}

impl MultiPitchArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let on = Region::read(&RegionArgs {
            surface: self.surface.clone(),
            tif: Some(self.tif.clone()),
            pitch_mm: self.min_pitch_mm,
            overscan_mm: self.overscan_mm,
            machine: self.machine.clone(),
            within_travel: self.within_travel,
            form: FormArgs::default(),
            output: self.output.clone(),
        })?;
        let tif = on.tif.as_ref().ok_or_else(|| Failure::new("tif: give --tif"))?;
        let settings = MultiPitchSettings {
            classes: self.classes,
            max_velocity_mm_per_s: self.max_velocity_mm_per_s,
            min_pitch_mm: self.min_pitch_mm,
            max_pitch_mm: self.max_pitch_mm.unwrap_or_else(|| pitch_limit(tif).pitch_mm()),
            min_area_mm2: self.min_area_mm2,
            step_mm: self.step_mm,
            overscan_mm: on.overscan_mm,
            links: self.links,
        };
        let mut output = match on.begin(&task!("multi-pitch", &on.stated(&settings)))? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let made = multi_pitch(&on.surface, tif, &settings).map_err(Failure::with_flags)?;
        let warnings = made.report.warnings(&settings);
        let largest_pitch_mm = made.report.classes[0].pitch_mm;
        on.write(&mut output, &made.path, largest_pitch_mm, &made.report, warnings)
    }
}
