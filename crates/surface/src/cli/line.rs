//! `planish surface line`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task,
};
use planish_surface::{
    line::{Across, LineSettings, Positive, integrated_across, line, mean_profile},
    profile::Profile,
    shape::Shape,
};
use planish_types::{Surface, Tif};
use serde_json::json;

use super::profile::ProfileArgs;

#[derive(Debug, Args)]
pub struct LineArgs {
    #[command(flatten)]
    source: SourceArgs,
    #[command(flatten)]
    columns: ProfileArgs,
    /// Meaning of positive heights of the profile, and of slopes that are positive along its positions
    #[arg(long, value_enum, requires = "profile")]
    positive: Option<Positive>,
    /// Shape to subtract
    #[arg(long, value_enum, default_value_t = Shape::Plane)]
    subtract: Shape,
    /// Tool influence function [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    #[command(flatten)]
    across: AcrossArgs,
    /// Distance of pixel centres, mm, along the line [default: the mean step of the profile]
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    pixel_mm: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct SourceArgs {
    /// Measured line: a table as text, or a .npy file of shape (positions, columns)
    #[arg(long, value_name = "FILE", requires_all = ["value_unit", "positive"])]
    profile: Option<PathBuf>,
    /// Map, whose mean over every column is the profile [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct AcrossArgs {
    /// Width of the strip that the tool passes once along its middle, mm; the removal counts by its mean over it
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    strip_width_mm: Option<f64>,
    /// Distance of neighbouring lines, mm, on a part much wider than the tool; all lines have the dwell times of the plan
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    pitch_mm: Option<f64>,
}

impl LineArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let across = match (self.across.strip_width_mm, self.across.pitch_mm) {
            (Some(width), _) => Across::StripWidthMm(width),
            (None, Some(pitch)) => Across::PitchMm(pitch),
            (None, None) => {
                return Err(Failure::new("--strip-width-mm: is missing; give it or --pitch-mm"));
            }
        };
        let settings = LineSettings {
            across,
            positive: self.positive.unwrap_or(Positive::Hill),
            subtract: self.subtract,
            pixel_mm: self.pixel_mm,
        };
        let mut inputs = Inputs::new();
        let profile = self.profile(&mut inputs)?;
        let tif: Tif = inputs.read("tif", &self.tif)?;
        let columns = self.source.profile.as_ref().map(|_| self.columns.settings()).transpose()?;
        let task = task!("line", json!({ "line": settings, "profile": columns }));
        let parts = [("surface", Surface::KIND), ("tif", Tif::KIND)];
        let mut output = match Output::directories(&self.output, parts).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let made = line(&profile, &settings).map_err(Failure::with_flags)?;
        let tool = integrated_across(&tif, across).map_err(Failure::with_flags)?;
        let report = &made.report;
        output.write(&made.surface, serde_json::to_value(report)?, &Status::Done)?;
        let peak = tool.peak_nm_per_s();
        output.write(&tool, json!({ "peak_nm_per_s": peak }), &Status::Done)?;
        say(format!(
            "planish surface: line of {} pixels of {} mm, RMS {:.4} nm, slopes {:.1} nrad RMS; the tool removes at most \
             {:.4} nm/s in the mean across -> {}",
            made.surface.grid().x.len(),
            made.surface.grid().x.step_mm(),
            report.rms_nm,
            report.slope_rms_nrad,
            peak,
            self.output.out.display()
        ));
        report.notes.iter().for_each(|note| say(format!("planish surface: note: {note}")));
        Ok(Status::Done)
    }

    fn profile(&self, inputs: &mut Inputs) -> Result<Profile, Failure> {
        match (&self.source.profile, &self.source.surface) {
            (Some(file), _) => self.columns.read(inputs, file),
            (None, Some(dir)) => {
                let surface: Surface = inputs.read("surface", dir)?;
                mean_profile(&surface).map_err(Failure::with_flags)
            }
            (None, None) => Err(Failure::new("--profile: is missing; give it or --surface")),
        }
    }
}
