//! `planish-toolpath inspect`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Inputs, Status, flags::PathArgs, say};
use planish_toolpath::{statistics, time_lower_bound_s};
use planish_types::Surface;

use super::FormArgs;

#[derive(Debug, Args)]
pub struct InspectArgs {
    #[command(flatten)]
    path: PathArgs,
    /// Map whose valid pixels are the clear aperture [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    #[command(flatten)]
    form: FormArgs,
    /// Machine and its limits, for the least time [JSON]
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
}

impl InspectArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let path = self.path.read(&mut inputs)?;
        let surface: Surface = inputs.read("surface", &self.surface)?;
        let mut found = serde_json::to_value(statistics(&path, &surface))?;
        if let Some(on) = self.form.read(&surface, &mut inputs)? {
            let developed = on.developed(&surface)?;
            let report = on.report(&on.unrolled(&path)?, &surface, &developed)?;
            found["form"] = serde_json::to_value(report)?;
        }
        if let Some(file) = &self.machine {
            found["least_time_s"] =
                time_lower_bound_s(&path, &inputs.read_machine(file)?.limits_on_part()).into();
        }
        say(serde_json::to_string_pretty(&found)?);
        Ok(Status::Done)
    }
}
