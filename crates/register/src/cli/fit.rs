//! `planish register fit`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task, warn,
};
use planish_register::{
    fiducials,
    fit::{TransformModel, fit, fit_mirrored},
};
use planish_types::{Transform, text::significant};
use serde_json::json;

use super::with_error;

/// Largest file of fiducials, bytes; a larger one is refused. Larger: more memory for a file that is no
/// list of fiducials. Smaller: a long list is refused. Chosen: 16 MiB hold 100 000 lines of 160 bytes.
const MOST_BYTES: u64 = 1 << 24;

#[derive(Debug, Args)]
pub struct FitArgs {
    /// Fiducials: CSV with the columns map_x_mm, map_y_mm, machine_x_mm, machine_y_mm, uncertainty_mm, or JSON
    file: PathBuf,
    /// Parameters of the transform from map to machine that are fitted
    #[arg(long, value_enum, default_value = "rigid")]
    model: TransformModel,
    /// Machine and its limits: the machine that measured the fiducials, if its file says that its axes mirror the part
    /// [JSON]
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
}

impl FitArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let bytes = inputs.read_bytes("fiducials", &self.file, MOST_BYTES)?;
        let mirrors = match &self.machine {
            Some(file) => inputs.read_machine(file)?.part_to_axes().is_some_and(Transform::mirrors),
            None => false,
        };
        let task = task!("fit", json!({ "model": self.model }));
        let output = Output::directory(&self.output, Transform::KIND);
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let about =
            |e: &dyn std::error::Error| Failure::new(format!("{}: {e}", self.file.display()));
        let fiducials = fiducials::read(&bytes).map_err(|e| about(&e))?;
        let registration = if mirrors { fit_mirrored } else { fit }(&fiducials, self.model);
        let registration = registration.map_err(|e| {
            Failure::new(planish_handoff::with_flags(&format!("{}: {e}", self.file.display())))
        })?;
        let report = &registration.report;
        let status = report.drawback().map_or(Status::Done, Status::Negative);
        output.write(&registration.transform, json!({ "registration": report }), &status)?;
        for warning in &report.warnings {
            warn(warning);
        }
        say(format!(
            "planish register: {} fiducials, turned by {} degree, scale {}",
            report.fiducials,
            with_error(report.angle_deg, 5),
            with_error(report.scale, 6)
        ));
        say(format!(
            "planish register: the fiducials miss by {} um RMS; a place among them is known to {} um -> {}",
            significant(1e3 * report.rms_mm, 3),
            significant(1e3 * report.largest_standard_error_mm, 3),
            self.output.out.display()
        ));
        Ok(status)
    }
}
