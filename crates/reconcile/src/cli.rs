//! The command line of `planish reconcile`.

pub mod controller;

use std::path::PathBuf;

use clap::Args;
use ndarray::Array1;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, Tool, Writer,
    flags::{OutputArgs, TrajectoryArgs},
    kind,
    npy::ArrayData,
    say, task, with_flags,
};
use planish_reconcile::{Comparison, ReconcileSettings, Reconciled, draw::picture, reconcile};
use planish_simulate::error_budget::{ErrorBudget, ErrorBudgetFile};
use planish_types::{
    Surface, Tif, Transform,
    outcome::reconciliation::{Band, Estimate, Evidence, ReconciliationOutcome},
    plausible,
    text::significant,
};

#[derive(Args)]
pub struct Reconcile {
    /// Map measured before the tool acted [surface artifact]
    #[arg(long, value_name = "DIR")]
    before: PathBuf,
    /// Map measured after the tool acted. On other pixels than those of the map before it is resampled there by
    /// Lagrange interpolation of degree five along each axis [surface artifact]
    #[arg(long, value_name = "DIR")]
    after: PathBuf,
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    /// Tool influence function of the plan [tif artifact, or tool artifact if it varies over the part]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Error budget of the process: the errors that were expected before the run [JSON]
    #[arg(long, value_name = "FILE")]
    error_budget: Option<PathBuf>,
    /// Parameter to learn, while the others are held; may be repeated [default: all]. The exit code is 1 if the data do
    /// not determine it. One of rate_scale, offset_x, offset_y, rotation, magnification, tif_width, tif_ellipticity,
    /// tif_diagonal_ellipticity, rate_drift
    #[arg(long, value_name = "NAME")]
    fit: Vec<String>,
    /// Hold this parameter, or this term of the metrology [piston, tilt_x, tilt_y, power], at its value in the plan
    /// (again for more)
    #[arg(long, value_name = "NAME")]
    hold: Vec<String>,
    /// Legendre terms of the metrology up to these orders along x and y are free, too
    #[arg(long, num_args = 2, value_names = ["M", "N"])]
    metrology_order: Option<Vec<usize>>,
    /// Use the TIF as it is sampled, with the noise and the border step of its measurement. By default the fit
    /// also tries a TIF without them, and one with a tail beyond its samples, and keeps the one with the smallest
    /// residual
    #[arg(long)]
    tif_as_sampled: bool,
    /// State that both maps were measured and read in the same way: one sign, unit and orientation. Give it if the plan
    /// leaves less than the noise of the maps, so that they cannot show it. Maps that contradict it are still refused
    #[arg(long)]
    same_measurement: bool,
    /// Transform from part to machine that was applied to the plan of this run [transform artifact]
    #[arg(long, value_name = "DIR")]
    transform: Option<PathBuf>,
    /// TIF with the rate and the shape that were learnt, written in addition [tif artifact, or tool artifact if the
    /// tool varies over the part]
    #[arg(long, value_name = "DIR")]
    corrected_tif: Option<PathBuf>,
    /// Transform that takes the next plan to the machine, so that the tool acts where it is planned, written in
    /// addition [transform artifact]
    #[arg(long, value_name = "DIR")]
    corrected_transform: Option<PathBuf>,
    /// Error budget with standard errors in the place of the errors that were learnt, written in addition [JSON]
    #[arg(long, value_name = "FILE")]
    learnt_error_budget: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
}

impl Reconcile {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = ReconcileSettings {
            free: self.fit.clone(),
            hold: self.hold.clone(),
            metrology_order: self.metrology_order.as_ref().map(|n| [n[0], n[1]]),
            tif_as_sampled: self.tif_as_sampled,
            same_measurement: self.same_measurement,
        };
        let mut inputs = Inputs::new();
        let (trajectory, manifest) = self.trajectory.read_on_part(&mut inputs)?;
        let tif = inputs.read_tool_with_doubt("tif", &self.tif)?;
        let tool_kind = if tif.variation().is_some() { Tool::KIND } else { Tif::KIND };
        inputs.warn_unrelated("trajectory", manifest.as_ref(), "tif");
        let before: Surface = inputs.read("before", &self.before)?;
        let after: Surface = inputs.read("after", &self.after)?;
        let process = self.read_process(&mut inputs)?;
        let transform: Option<Transform> = match &self.transform {
            Some(dir) => Some(inputs.read("transform", dir)?),
            None => None,
        };
        let mut output = Output::directory(&self.output, &kind::RECONCILIATION);
        if let Some(dir) = &self.corrected_tif {
            output = output.and_directory("--corrected-tif", dir, tool_kind);
        }
        if let Some(dir) = &self.corrected_transform {
            output = output.and_directory("--corrected-transform", dir, Transform::KIND);
        }
        if let Some(file) = &self.learnt_error_budget {
            output = output.and_file("--learnt-error-budget", file);
        }
        let mut output = match output.begin(&task!("reconcile", &settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        plausible::check_tool(&before, &tif)?;
        let comparison = Comparison {
            before: &before,
            after: &after,
            trajectory: &trajectory,
            tif: &tif,
            error_budget: process.as_ref(),
            transform: transform.as_ref(),
        };

        let reconciled = reconcile(&comparison, &settings).map_err(|e| match e.array {
            "x_mm" | "y_mm" | "height_nm" => Failure::new(format!("{}: {e}", self.after.display())),
            _ => Failure::with_flags(e),
        })?;

        let drawback = reconciled.drawback.as_deref().map(with_flags);
        let status = drawback.map_or(Status::Done, Status::Negative);
        let maps = [
            &reconciled.measured_nm,
            &reconciled.planned_nm,
            &reconciled.predicted_nm,
            &reconciled.metrology_nm,
            &reconciled.rest_nm,
            &reconciled.correlation,
        ];
        let grid = before.grid();
        let axes = [&grid.x, &grid.y].map(|axis| Array1::from(axis.coordinates()).into_dyn());
        let maps = maps.into_iter().map(|map| ArrayData::F64(map.view().into_dyn().into()));
        let axes = axes.into_iter().map(|axis| ArrayData::F64(axis.into()));
        let arrays: Vec<ArrayData<'_>> = maps.chain(axes).collect();
        let beside = [("reconcile.svg", picture(&reconciled, grid).into_bytes())];
        let outcome = &reconciled.outcome;
        output.write_arrays(&kind::RECONCILIATION, &arrays, &beside, outcome, &status)?;
        self.write_corrected(&reconciled, &mut output, &status)?;
        say(table(outcome));
        say(format!("-> {}", self.output.out.display()));
        Ok(status)
    }

    /// Writes the corrected tool, transform and error budget, each if its flag names a file.
    fn write_corrected(
        &self,
        reconciled: &Reconciled,
        output: &mut Writer,
        status: &Status,
    ) -> Result<(), Failure> {
        if self.corrected_tif.is_some() {
            let tif = &reconciled.tif;
            let outcome = serde_json::json!({
                "peak_nm_per_s": tif.peak_nm_per_s(),
                "vrr_nm_mm2_per_s": tif.vrr_nm_mm2_per_s(),
                "width_mm": tif.width_mm(),
            });
            match tif.variation() {
                Some(_) => output.write(&Tool(tif.clone()), outcome, status)?,
                None => output.write(tif, outcome, status)?,
            }
        }
        if self.corrected_transform.is_some() {
            output.write(&reconciled.transform, serde_json::json!({}), status)?;
        }
        if let Some(file) = &self.learnt_error_budget {
            let text = format!("{}\n", serde_json::to_string_pretty(&reconciled.error_budget)?);
            output.write_file(file, text.as_bytes())?;
        }
        Ok(())
    }

    fn read_process(&self, inputs: &mut Inputs) -> Result<Option<ErrorBudget>, Failure> {
        let Some(path) = &self.error_budget else { return Ok(None) };
        let file: ErrorBudgetFile = inputs.read_json("error-budget", path)?;
        let process =
            file.checked().map_err(|e| Failure::new(format!("{}: {e}", path.display())))?;
        Ok(Some(process))
    }
}

/// Returns the table of results that the command prints.
fn table(outcome: &ReconciliationOutcome) -> String {
    let mut lines =
        vec!["parameter                      found  +- standard error   known beforehand".into()];
    lines.extend(outcome.parameters.iter().map(line_of_estimate));
    lines.push(String::new());
    lines.push("metrology".into());
    lines.extend(outcome.metrology.iter().map(line_of_estimate));
    if let Some(e) = &outcome.ellipse
        && let (Some(direction), Some(error)) = (e.direction_deg, e.direction_standard_error_deg)
    {
        lines.push(format!(
            "the TIF is longer by {:.2} % (+- {:.2}) along {direction:.0} degrees (+- {error:.0})",
            e.ellipticity_percent, e.standard_error_percent
        ));
    }
    if outcome.tif_is_continued {
        lines.push(
            "the samples of the TIF end before the tool does: the maps fit better with a tail beyond them, and the corrected \
             TIF has it"
                .into(),
        );
    }
    lines.push(String::new());
    lines.push("period, mm        measured   less plan's       rest nm RMS   transfer".into());
    lines.extend(outcome.bands.iter().map(line_of_band));
    if let Some(method) = &outcome.resampled {
        lines.push(format!(
            "the map after has other pixels: it is resampled on those of the map before by {method}"
        ));
    }
    let little: Vec<&str> = outcome
        .parameters
        .iter()
        .filter(|e| e.held_because.is_none() && e.name != "rate_drift")
        .filter(|e| e.value.is_some_and(|v| e.applied.abs() < 0.5 * v.abs()))
        .map(|e| e.name.as_str())
        .collect();
    if !little.is_empty() && outcome.explains_nothing.is_none() {
        lines.push(format!(
            "the written tool and transform correct less than half of what was found of {}: the data leave it too \
             uncertain, and more would raise the expected residual",
            little.join(", ")
        ));
    }
    let weak: Vec<&str> = outcome
        .parameters
        .iter()
        .filter(|e| e.refused.is_some() && e.applied != 0.0)
        .map(|e| e.name.as_str())
        .collect();
    if !weak.is_empty() {
        lines.push(format!(
            "{}: no number is stated, but the written tool and transform contain a correction, because the data \
             determine what it does together with others",
            weak.join(", ")
        ));
    }
    let noise = &outcome.noise;
    let fitted = &outcome.fitted;
    lines.push(format!(
        "the plan missed {:.4} nm RMS of {:.4}; with what was learnt {:.4} are left, correlated over {:.2} mm{}: {} \
         independent pixels of {}",
        fitted.measured_less_planned_rms_nm,
        fitted.measured_removal_rms_nm,
        fitted.rest_rms_nm,
        noise.correlation_length_mm,
        if noise.window_is_cut {
            " or more (further than the map can tell: standard errors are too small)"
        } else {
            ""
        },
        noise.effective_pixels.round(),
        noise.pixels
    ));
    lines.push(line_of_evidence(&outcome.evidence));
    lines.join("\n")
}

/// Returns the row of the table for one band of spatial frequency.
fn line_of_band(band: &Band) -> String {
    let period = match band.period_mm {
        [Some(short), None] => format!("over {short:.1}"),
        [Some(short), Some(long)] => format!("{short:.1} to {long:.1}"),
        _ => "all".into(),
    };
    let transfer = band.transfer.map_or("-".into(), |t| format!("{t:.3}"));
    format!(
        "{period:<16} {:>9.4} {:>13.4} {:>10.4} {transfer:>17}",
        band.measured_rms_nm, band.measured_less_planned_rms_nm, band.rest_rms_nm
    )
}

/// Returns the sentence that states what both maps have in common, as evidence that they belong to one run.
fn line_of_evidence(evidence: &Evidence) -> String {
    let removal = match (evidence.removal_factor, evidence.removal_factor_standard_error) {
        (Some(factor), Some(error)) => format!(
            "the maps differ by {} +- {} times the planned removal; ",
            significant(factor, 3),
            significant(error, 1)
        ),
        _ => String::new(),
    };
    let scale = match evidence.scale {
        Some([low, high]) => format!(
            ", and the map after has {} to {} times the heights that are expected",
            significant(low, 2),
            significant(high, 2)
        ),
        None => String::new(),
    };
    format!(
        "{removal}beside what the fit explains they have {} nm RMS in common ({} standard errors){scale}",
        significant(evidence.common_rms_nm, 2),
        significant(evidence.common_standard_errors, 2)
    )
}

/// Returns the row of the table for one unknown, and below it the reason if it is held or refused.
fn line_of_estimate(estimate: &Estimate) -> String {
    // Both end at the second digit of the standard error.
    let decimals = estimate.standard_error.filter(|e| *e > 0.0).map_or(4, |e| {
        // At most 12: a value of that many digits is none of a measurement.
        (1.0 - e.log10().floor()).clamp(0.0, 12.0) as usize
    });
    let number = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.decimals$}"));
    let beforehand = match estimate.known_beforehand {
        Some(scale) => format!("+- {} {}", significant(scale, 3), estimate.unit),
        None => String::new(),
    };
    let error = number(estimate.standard_error);
    let value = if estimate.held {
        "held".into()
    } else if estimate.refused.is_some() {
        "not determined".into()
    } else {
        format!("{} {}", number(estimate.value), estimate.unit)
    };
    let mut line = format!("{:<26} {value:>14}  +- {error:<10} {beforehand:>18}", estimate.name);
    for reason in estimate.held_because.iter().chain(&estimate.refused) {
        line += &format!("\n    {}: {reason}", estimate.name);
    }
    line
}
