//! `planish register maps`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task,
};
use planish_register::maps::{MapSettings, register};
use planish_types::{Surface, Transform, text::significant};
use serde_json::json;

use super::with_error;

#[derive(Debug, Args)]
pub struct MapsArgs {
    /// Map measured before the tool acted [surface artifact]
    #[arg(long, value_name = "DIR")]
    before: PathBuf,
    /// Map measured after the tool acted [surface artifact]
    #[arg(long, value_name = "DIR")]
    after: PathBuf,
    /// Largest shift along an axis, mm
    #[arg(long, value_name = "S", default_value_t = 1.0, allow_negative_numbers = true)]
    most_shift_mm: f64,
    /// Largest rotation, degree
    #[arg(long, value_name = "A", default_value_t = 1.0, allow_negative_numbers = true)]
    most_rotation_deg: f64,
    /// Highest order of the Legendre terms that are free (0 piston, 1 plane, 2 power and astigmatism)
    #[arg(long, value_name = "N", default_value_t = 2)]
    free_order: usize,
    /// Wavelength above which features are filtered out of both maps, mm; give the shortest that the tool
    /// has changed [default: keep all]
    #[arg(long, value_name = "L", allow_negative_numbers = true)]
    shorter_than_mm: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

impl MapsArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = MapSettings {
            most_shift_mm: self.most_shift_mm,
            most_rotation_deg: self.most_rotation_deg,
            free_order: self.free_order,
            shorter_than_mm: self.shorter_than_mm,
        };
        let mut inputs = Inputs::new();
        let before: Surface = inputs.read("before", &self.before)?;
        let after: Surface = inputs.read("after", &self.after)?;
        let output = Output::directory(&self.output, Transform::KIND);
        let mut output = match output.begin(&task!("maps", settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let registration = register(&before, &after, &settings).map_err(Failure::with_flags)?;
        let report = &registration.report;
        output.write(&registration.transform, json!({ "registration": report }), &Status::Done)?;
        say(format!(
            "planish register: the map after lies {} mm along x, {} mm along y, turned by {} degree",
            with_error(report.shift_x_mm, 4),
            with_error(report.shift_y_mm, 4),
            with_error(report.rotation_deg, 5)
        ));
        say(format!(
            "planish register: {} pixels in common, correlation {}, {} nm RMS remain -> {}",
            report.pixels,
            significant(report.correlation, 3),
            significant(report.rms_nm, 4),
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
