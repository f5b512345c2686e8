//! `planish campaign measure`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task,
};
use planish_simulate::{error_budget::ErrorBudgetFile, virtual_machine::measure};
use planish_types::Surface;
use serde_json::json;

#[derive(Args)]
pub struct Measure {
    /// Map of the true figure of the mirror [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Error budget of the process: the measurement has its map_noise and map_low_order [JSON]
    #[arg(long, value_name = "FILE")]
    error_budget: PathBuf,
    /// Random seed of the virtual machine
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Number of the run, from 1, before which the mirror is measured
    #[arg(long = "run-number", value_name = "K", default_value_t = 1)]
    run: u64,
    #[command(flatten)]
    output: OutputArgs,
}

impl Measure {
    pub fn write(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let mirror: Surface = inputs.read("surface", &self.surface)?;
        let file: ErrorBudgetFile = inputs.read_json("error-budget", &self.error_budget)?;
        let process = file
            .checked()
            .map_err(|e| Failure::new(format!("{}: {e}", self.error_budget.display())))?;
        let task = task!("measure", json!({ "seed": self.seed, "run": self.run }));
        let output = Output::directory(&self.output, Surface::KIND);
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let measured =
            measure(&mirror, &process, self.seed, self.run).map_err(Failure::with_flags)?;
        let statistics = measured.statistics();
        let seen = json!({ "rms_nm": statistics.rms, "pv_nm": statistics.pv });
        output.write(&measured, seen, &Status::Done)?;
        say(format!(
            "measured {:.4} nm RMS, {:.2} nm PV before run {} -> {}",
            statistics.rms,
            statistics.pv,
            self.run,
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
