//! The command line of `planish tolerance`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status,
    flags::{MirrorArgs, OutputArgs, TrajectoryArgs},
    from_run::is_rehearsal,
    kind, say, task, warn,
};
use planish_tolerance::{
    Free, ToleranceSettings,
    deviation::check_tool,
    error_budget::{Distribution, ErrorBudget, ErrorBudgetFile},
    tolerance,
};
use planish_types::{outcome::tolerance::ToleranceArrays, plausible, text::significant};

#[derive(Args)]
pub struct Tolerance {
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    #[command(flatten)]
    mirror: MirrorArgs,
    /// Error budget of the process [JSON]
    #[arg(long, value_name = "FILE")]
    error_budget: PathBuf,
    /// Low-order terms of the map that need not be removed; they are no part of the residual
    #[arg(long, value_enum, default_value = "piston")]
    free: Free,
    /// Runs that are drawn to first order, for the distribution
    #[arg(long, value_name = "N", default_value_t = ToleranceSettings::default().draws)]
    draws: usize,
    /// Runs with all errors that are simulated, to check the first order
    #[arg(long, value_name = "N", default_value_t = ToleranceSettings::default().simulated_runs)]
    simulated_runs: usize,
    /// Use the TIF as it is sampled, with the noise and the border step of its measurement
    #[arg(long)]
    tif_as_sampled: bool,
    /// Random seed
    #[arg(long, value_name = "S", default_value_t = ToleranceSettings::default().seed)]
    seed: u64,
    #[command(flatten)]
    output: OutputArgs,
}

impl Tolerance {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = ToleranceSettings {
            free: self.free,
            draws: self.draws,
            simulated_runs: self.simulated_runs,
            tif_as_sampled: self.tif_as_sampled,
            seed: self.seed,
        };
        if is_rehearsal() {
            self.rehearse()?;
        }
        let mut inputs = Inputs::new();
        let (trajectory, tif, surface) = self.trajectory.read_over(&self.mirror, &mut inputs)?;
        let process = self.process(&mut inputs)?;
        process.doubt().iter().for_each(warn);
        let task = task!("tolerance", settings);
        let output = Output::directory(&self.output, &kind::TOLERANCE);
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        plausible::check_tool(&surface, &tif)?;

        let outcome = tolerance(&trajectory, &tif, &surface, &process, &settings).map_err(|e| {
            match e.array {
                "errors" => Failure::new(format!("{}: {e}", self.error_budget.display())),
                _ => Failure::with_flags(e),
            }
        })?;

        let arrays = ToleranceArrays {
            part: outcome.levels.iter().map(|level| level.0).collect(),
            rms_nm: outcome.levels.iter().map(|level| level.1).collect(),
            deviation_nm: outcome.deviation_nm.clone(),
            grid: *surface.grid(),
        };
        if let Some(warning) = outcome.coverage.warning() {
            warn(warning);
        }
        let status = outcome.coverage.drawback().map_or(Status::Done, Status::Negative);
        output.write(&arrays, &outcome, &status)?;
        say(table(&outcome, settings.free));
        say(format!("-> {}", self.output.out.display()));
        Ok(status)
    }

    /// Reads and checks the error budget; refuses one that is not valid.
    fn process(&self, inputs: &mut Inputs) -> Result<ErrorBudget, Failure> {
        let file: ErrorBudgetFile = inputs.read_json("error-budget", &self.error_budget)?;
        file.checked().map_err(|e| Failure::new(format!("{}: {e}", self.error_budget.display())))
    }

    /// Checks the error budget and the tool in a rehearsal, in which the other inputs do not exist yet.
    fn rehearse(&self) -> Result<(), Failure> {
        let process = self.process(&mut Inputs::new())?;
        let tif = Inputs::new().read_tool("tif", &self.mirror.tif)?;
        check_tool(&process, &tif).map_err(Failure::with_flags)
    }
}

/// Returns the table of results that the command prints; `free` says which terms of the map do not count.
fn table(report: &planish_tolerance::Tolerance, free: Free) -> String {
    let without = match free {
        Free::Piston => "",
        Free::Plane => " without the best plane",
    };
    let mut lines = vec![
        format!(
            "{}: {:.4} nm RMS{without} as planned",
            report.outcome.error_budget, report.outcome.nominal_rms_nm
        ),
        String::new(),
        "                                             adds   reached  not reached  departs by"
            .into(),
        "error                            size      nm RMS    nm RMS       nm RMS      nm RMS"
            .into(),
    ];
    for line in &report.outcome.errors {
        let sign = if line.distribution == Distribution::Fixed { "" } else { "+-" };
        let size = format!("{sign}{} {}", significant(line.size, 4), line.unit);
        lines.push(format!(
            "{:<22} {:>14} {:>11.4} {:>9.4} {:>12.4} {:>11.4}{}",
            line.kind,
            size,
            line.adds_rms_nm,
            line.reached_rms_nm,
            line.unreached_rms_nm,
            line.departs_by_rms_nm,
            simulated_note(line.simulated, line.standard_error_nm)
        ));
    }
    let q = &report.outcome.residual;
    let [low, high] = q.interval_95_percent_nm;
    lines.push(String::new());
    lines.push(format!(
        "with this process expect {low:.4} to {high:.4} nm (95 % of the runs{}); half of the runs are below \
         {:.4} nm, 95 % below {:.4} nm",
        if report.outcome.simulated { ", simulated" } else { "" },
        q.median_nm,
        q.below_95_percent_nm
    ));
    if let Some(first) = &report.outcome.first {
        lines.push(format!(
            "improve {} first: without it 95 % of the runs are below {:.4} nm{}",
            first.kind,
            first.without_it_95_percent_nm,
            if report.outcome.simulated { " (to first order)" } else { "" }
        ));
    }
    if !report.runs.is_empty() {
        lines.push(format!(
            "{} simulated runs differ from the first order by at most {:.2} % of their RMS; {} of them are in the \
             interval",
            report.runs.len(),
            100.0 * report.largest_difference,
            report.within_interval
        ));
    }
    if report.tif_resampling_error > 0.0 {
        lines.push(format!(
            "errors are simulated with the TIF sampled anew on the pixels of the map, to {} % of its peak",
            significant(100.0 * report.tif_resampling_error, 2)
        ));
    }
    lines.extend(report.backlash_start.map(String::from));
    lines.extend(report.mean_tool.map(String::from));
    lines.join("\n")
}

/// Returns the note at the end of a row of the table: that the row comes from simulated runs, and its standard error if
/// it has one. Empty if it does not come from simulated runs.
fn simulated_note(simulated: bool, standard_error_nm: Option<f64>) -> String {
    match standard_error_nm {
        _ if !simulated => String::new(),
        None => "  simulated".into(),
        Some(e) => format!("  simulated, +-{e:.4} (standard error)"),
    }
}
