//! `planish tool prepare`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, as_command, flags::OutputArgs, say, warn,
    with_flags,
};
use planish_tool::{
    tif::{Centre, TifReport, TifSettings, prepare_tif, tif_statistics},
    tif_fit::{self, FitReport},
};
use planish_types::Tif;
use serde::Serialize;
use serde_json::json;

use super::Name;

/// Results of `prepare`, as the manifest (the record of the run) states them.
#[derive(Serialize)]
struct TifOutcome<'a> {
    #[serde(flatten)]
    report: &'a TifReport,
    /// Report on the fitted formula; left out if none was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    fit: Option<FitReport>,
}

#[derive(Debug, Args)]
pub struct PrepareArgs {
    /// Tool influence function as it was measured [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Subtract the least-squares plane through the border samples; negative noise stays, so the volume has no bias
    #[arg(long)]
    subtract_border: bool,
    /// Point from which the offsets are counted; the samples stay as they are
    #[arg(long, value_enum, default_value_t = Centre::Given)]
    centre: Centre,
    /// Turn counterclockwise, degrees, about the centre; multiples of 90 are exact
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    rotate_deg: f64,
    /// Distance of pixel centres, mm, to which the TIF is resampled, with a sample at the centre
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    pixel_mm: Option<f64>,
    /// Outer fraction of the half size over which a cosine takes the TIF to zero, in (0, 1]; 0.15 is usual
    #[arg(long, value_name = "F", allow_negative_numbers = true)]
    taper_fraction: Option<f64>,
    /// Fit a formula to the result and report it
    #[arg(long, value_enum)]
    fit_formula: Option<tif_fit::TifModel>,
    /// Write the formula's samples instead of the measured ones
    #[arg(long, requires = "fit_formula")]
    use_fit: bool,
    #[command(flatten)]
    output: OutputArgs,
}

impl PrepareArgs {
    pub fn run(&self, name: Name) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let tif: Tif = inputs.read("tif", &self.tif)?;
        let settings = TifSettings {
            subtract_border: self.subtract_border,
            centre: self.centre,
            rotate_deg: self.rotate_deg,
            pixel_mm: self.pixel_mm,
            taper_fraction: self.taper_fraction,
        };
        let model = self.fit_formula;
        let task = name.task(json!({ "tif": settings, "fit": model, "use_fit": self.use_fit }));
        let mut output = match Output::directory(&self.output, Tif::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let (mut made, mut report) = prepare_tif(&tif, &settings).map_err(Failure::with_flags)?;
        report.note = report.note.map(|note| with_flags(&note));
        let mut fitted = None;
        let mut status = Status::Done;
        if let Some(model) = model {
            let (formula, fit) = tif_fit::fit(&made, model)?;
            status = fit.negative().map_or(Status::Done, Status::Negative);
            say(format!(
                "{}: fit: residual {:.3} % of the peak RMS, VRR of the formula {:.4} of the samples'",
                as_command(name.program),
                100.0 * fit.residual_rms_to_peak,
                fit.vrr_ratio
            ));
            fitted = Some(fit);
            if self.use_fit {
                made = formula;
            }
        }
        output.write(&made, TifOutcome { report: &report, fit: fitted }, &status)?;
        let s = tif_statistics(&made);
        say(format!(
            "{}: TIF {} x {} samples, {:.4} x {:.4} mm; peak {:.4} nm/s, VRR {:.4} nm mm^2/s, \
             centroid ({:.4}, {:.4}) mm, border {:.2} % of the peak",
            as_command(name.program),
            s.shape.1,
            s.shape.0,
            s.pitch_mm[0],
            s.pitch_mm[1],
            s.peak_nm_per_s,
            s.vrr_nm_mm2_per_s,
            s.centroid_mm[0],
            s.centroid_mm[1],
            100.0 * s.border_to_peak
        ));
        report.doubts.iter().for_each(warn);
        report
            .note
            .iter()
            .for_each(|note| say(format!("{}: note: {note}", as_command(name.program))));
        Ok(status)
    }
}
