//! A run of the virtual machine: a run with hidden errors, and the map that is measured after it.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{MirrorArgs, OutputArgs, TrajectoryArgs},
    say, task,
};
use planish_simulate::{
    coverage::Coverage,
    error_budget::ErrorBudgetFile,
    virtual_machine::{VirtualMachineSettings, run},
};
use planish_types::{
    Removal, Surface,
    outcome::{
        removal::MeasuredOutcome,
        virtual_machine::{HiddenOutcome, TruthOutcome},
    },
    plausible,
};
use serde::Serialize;

#[derive(Args)]
pub struct VirtualRun {
    /// Error budget of the process: its hidden errors, drawn with the seed, act on the run. `--out` is the truth, and
    /// `--measured-out` the map that is measured after the run [JSON]
    #[arg(long, value_name = "FILE", requires = "measured_out")]
    error_budget: Option<PathBuf>,
    /// Output directory of the map that is measured after the run with errors [surface artifact]
    #[arg(long, value_name = "DIR", requires = "error_budget")]
    measured_out: Option<PathBuf>,
    /// Random seed of the hidden errors
    #[arg(long, value_name = "S", requires = "error_budget", default_value_t = 1)]
    seed: u64,
    /// Number of the run, from 1, on the machine of this seed. Errors of one number are those of its first run, and
    /// noise is new; --surface is the map measured after the run before
    #[arg(long = "run-number", value_name = "K", requires = "error_budget", default_value_t = 1)]
    number: u64,
    /// Assume that rate, place, width and shape of the tool are known and corrected exactly; all other errors stay
    #[arg(long, requires = "error_budget")]
    known: bool,
    /// Use the TIF as it is sampled, with the noise and the border step of its measurement
    #[arg(long, requires = "error_budget")]
    tif_as_sampled: bool,
}

/// Results of a run of the virtual machine for the manifest of the true removal; the manifest of the measured map has
/// none of them.
#[derive(Serialize)]
struct RunReport {
    coverage: Coverage,
    /// Sentence on the state in which an axis with play begins; left out without play.
    #[serde(skip_serializing_if = "Option::is_none")]
    backlash_start: Option<&'static str>,
}

impl VirtualRun {
    /// Returns the file of the error budget and the directory for the measured map; `None` without these flags.
    pub fn files(&self) -> Option<(&PathBuf, &PathBuf)> {
        self.error_budget.as_ref().zip(self.measured_out.as_ref())
    }

    pub fn run(
        &self,
        (process, measured): (&PathBuf, &PathBuf),
        trajectory: &TrajectoryArgs,
        mirror: &MirrorArgs,
        output: &OutputArgs,
    ) -> Result<Status, Failure> {
        let settings = VirtualMachineSettings {
            seed: self.seed,
            run: self.number,
            known: self.known,
            tif_as_sampled: self.tif_as_sampled,
        };
        let mut inputs = Inputs::new();
        let (trajectory, tif, before) = trajectory.read_on_machine(mirror, &mut inputs)?;
        let file: ErrorBudgetFile = inputs.read_json("error-budget", process)?;
        let in_file = |e| Failure::new(format!("{}: {e}", process.display()));
        let errors = file.checked().map_err(in_file)?;
        let to = Output::directory(output, Removal::KIND).and_directory(
            "--measured-out",
            measured,
            Surface::KIND,
        );
        let mut writer = match to.begin(&task!("virtual-machine", settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(writer) => writer,
        };
        plausible::check_tool(&before, &tif)?;

        let run =
            run(&trajectory, &tif, &before, &errors, &settings).map_err(|e| match e.array {
                "errors" => in_file(e),
                _ => Failure::with_flags(e),
            })?;

        let coverage = Coverage::new(run.removal.removal_nm(), &trajectory, &tif, &before);
        let status = super::status(&coverage, None);

        // What is hidden stands in the manifest of the truth alone.
        let statistics = run.measured.statistics();
        let seen = MeasuredOutcome { rms_nm: statistics.rms, pv_nm: Some(statistics.pv) };
        writer.write(&run.measured, seen, &status)?;
        let remains = run.removal.residual().statistics();
        let truth = TruthOutcome {
            rms_nm: remains.rms,
            rms_detilted_nm: None,
            pv_nm: Some(remains.pv),
            total_time_s: trajectory.total_time_s(),
            more: HiddenOutcome {
                hidden: run.hidden,
                more: RunReport { coverage, backlash_start: errors.play_start() },
            },
        };
        writer.write(&run.removal, truth, &status)?;
        say(format!(
            "measured {:.4} nm RMS, {:.2} nm PV after run {} of {} with seed {} -> {}; the truth -> {}",
            statistics.rms,
            statistics.pv,
            self.number,
            errors.name,
            self.seed,
            measured.display(),
            output.out.display()
        ));
        Ok(status)
    }
}
