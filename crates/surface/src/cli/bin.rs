//! `planish surface bin`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task,
};
use planish_surface::binning::bin;
use planish_types::Surface;
use serde_json::json;

#[derive(Debug, Args)]
pub struct BinArgs {
    /// Map with many pixels [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Side of the squares whose means become the pixels, px
    #[arg(long, value_name = "N")]
    square_px: usize,
    #[command(flatten)]
    output: OutputArgs,
}

impl BinArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let surface: Surface = inputs.read("surface", &self.surface)?;
        let task = task!("bin", json!({ "square_px": self.square_px }));
        let mut output =
            match Output::directory(&self.output, Surface::KIND).begin(&task, &inputs)? {
                Begin::Unchanged(status) => return Ok(status),
                Begin::Run(output) => output,
            };
        let binned = bin(&surface, self.square_px).map_err(Failure::with_flags)?;
        let (rows, columns) = binned.surface.grid().shape();
        let report = &binned.report;
        say(format!(
            "planish surface: {columns} x {rows} px, RMS {:.4} nm, and {:.4} nm within the squares; {} of {} valid \
             pixels are in squares that are not half valid",
            binned.surface.statistics().rms,
            report.within_rms_nm,
            report.left_out_pixels,
            report.valid_pixels
        ));
        output.write(&binned.surface, report, &Status::Done)?;
        Ok(Status::Done)
    }
}
