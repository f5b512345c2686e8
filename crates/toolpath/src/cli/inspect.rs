//! `planish toolpath inspect`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Inputs, Status, flags::PathArgs, say};
use planish_toolpath::{AlongReport, PathStatistics, statistics, time_lower_bound_s};
use planish_types::Surface;
use serde::Serialize;

use super::FormArgs;

/// Results of `inspect`, as JSON: statistics of the path, its report along the form, and the least time in s.
#[derive(Serialize)]
struct Inspected {
    #[serde(flatten)]
    statistics: PathStatistics,
    #[serde(skip_serializing_if = "Option::is_none")]
    form: Option<AlongReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    least_time_s: Option<f64>,
}

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
        let form = match self.form.read(&surface, &mut inputs)? {
            Some(on) => {
                let developed = on.developed(&surface)?;
                Some(on.report(&on.unrolled(&path)?, &surface, &developed)?)
            }
            None => None,
        };
        let least_time_s = match &self.machine {
            Some(file) => {
                let limits = inputs.read_machine(file)?.limits_on_part();
                Some(time_lower_bound_s(&path, &limits))
            }
            None => None,
        };
        let inspected = Inspected { statistics: statistics(&path, &surface), form, least_time_s };
        say(serde_json::to_string_pretty(&inspected)?);
        Ok(Status::Done)
    }
}
