//! The command line of `planish simulate`.

mod virtual_run;

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use ndarray::Array1;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, Writer,
    flags::{MirrorArgs, OutputArgs, TrajectoryArgs},
    kind,
    npy::ArrayData,
    say, task, warn,
};
use planish_simulate::{
    Numerics, SimulationSettings,
    between::Between,
    coverage::Coverage,
    deviation::Deviation,
    error_budget::ErrorBudgetFile,
    frames::{Frames, frames},
    motion::Motion,
    simulate,
};
use planish_types::{
    Removal, Surface, doubts,
    outcome::removal::{MeasuredOutcome, RemovalOutcome, ServoOutcome},
    plausible, progress,
};
use serde::Serialize;
use serde_json::json;

#[derive(Args)]
pub struct Simulate {
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    #[command(flatten)]
    mirror: MirrorArgs,
    /// Predict the removal of axes that follow the motion as planner and servos of this process do. Of its errors only
    /// corner_speed, smoothing, velocity_lag, servo_first_order and servo_second_order of a fixed size count [JSON]
    #[arg(long, value_name = "FILE", conflicts_with_all = ["error_budget", "frames"])]
    servo_of: Option<PathBuf>,
    /// Method of integration along the motion
    #[arg(long, value_enum, default_value = "gridded", conflicts_with = "error_budget")]
    integral: IntegrationMethod,
    /// Time steps per segment of the direct method
    #[arg(long, default_value_t = 16)]
    steps: usize,
    /// Write the removal at N equal steps of time instead [frames artifact of at most 20 000 pixels
    /// a frame]
    #[arg(long, value_name = "N", conflicts_with = "error_budget")]
    frames: Option<usize>,
    /// Output directory of the residual as a map, from which the next plan starts [surface artifact]
    #[arg(long, value_name = "DIR", conflicts_with_all = ["error_budget", "frames"])]
    remaining_out: Option<PathBuf>,
    #[command(flatten)]
    virtual_run: virtual_run::VirtualRun,
    #[command(flatten)]
    output: OutputArgs,
}

/// Results of a prediction for the manifest, besides the numbers of the residual.
#[derive(Serialize)]
struct PredictionReport<'a> {
    numerics: &'a Numerics,
    coverage: &'a Coverage,
    tif_between_samples: Option<Between>,
    #[serde(flatten)]
    servo: ServoOutcome,
}

#[derive(Clone, Copy, ValueEnum)]
enum IntegrationMethod {
    /// Exact quadrature and FFT convolution
    Gridded,
    /// Midpoint quadrature pixel by pixel: slow, to check the gridded method
    Direct,
}

impl Simulate {
    pub fn run(&self) -> Result<Status, Failure> {
        if let Some(files) = self.virtual_run.files() {
            return self.virtual_run.run(files, &self.trajectory, &self.mirror, &self.output);
        }
        let settings = self.settings();
        let task = match (self.frames, &self.servo_of) {
            (Some(count), _) => task!("frames", json!({ "method": settings, "frames": count })),
            (None, Some(_)) => task!("after-servo", settings),
            (None, None) => task!("simulate", settings),
        };
        let mut inputs = Inputs::new();
        let (command, tif, surface) = self.trajectory.read_over(&self.mirror, &mut inputs)?;
        let servos = self.servos(&mut inputs)?;
        if servos.servo_count() > 0 {
            tif.same_in_all_directions("a servo").map_err(Failure::with_flags)?;
        }
        let trajectory = match servos.servo_count() {
            0 => command,
            // A servo follows a cubic of any length.
            _ => servos.trajectory(&Motion::new(&command, f64::INFINITY)?, surface.grid())?,
        };
        let kind = if self.frames.is_some() { &kind::FRAMES } else { Removal::KIND };
        let mut to = Output::directory(&self.output, kind);
        if let Some(dir) = &self.remaining_out {
            to = to.and_directory("--remaining-out", dir, Surface::KIND);
        }
        let mut output = match to.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        plausible::check_tool(&surface, &tif)?;
        if let Some(count) = self.frames {
            let frames = frames(&trajectory, &tif, &surface, settings, count)?;
            return write_frames(&mut output, frames, &self.output);
        }

        // To write the maps takes about as long.
        let prediction = progress::part(0, 2, || simulate(&trajectory, &tif, &surface, settings))?;

        let residual = prediction.removal.residual();
        let statistics = residual.statistics();
        let detilted = residual.detilted_rms_nm();
        let coverage = Coverage::new(prediction.removal.removal_nm(), &trajectory, &tif, &surface);
        let status = status(&coverage, prediction.drawback(&surface, trajectory.total_time_s()));
        let between = Between::new(&trajectory, &tif, &prediction.removal);
        let servos_of_process = self.servo_of.as_ref().map(|_| servos.servo_count());
        let outcome = RemovalOutcome {
            rms_nm: statistics.rms,
            rms_detilted_nm: Some(detilted),
            pv_nm: Some(statistics.pv),
            total_time_s: trajectory.total_time_s(),
            more: PredictionReport {
                numerics: &prediction.numerics,
                coverage: &coverage,
                tif_between_samples: between,
                servo: ServoOutcome { servos: servos_of_process },
            },
        };
        output.write(&prediction.removal, outcome, &status)?;
        if self.remaining_out.is_some() {
            let measured = MeasuredOutcome { rms_nm: statistics.rms, pv_nm: Some(statistics.pv) };
            output.write(residual, measured, &Status::Done)?;
        }
        if let Some(warning) = between.and_then(|b| b.warning()) {
            warn(warning);
        }
        if status == Status::Done {
            doubts::of_residual(&surface, &prediction.removal).iter().for_each(warn);
        }
        say(format!(
            "{}residual {:.4} nm RMS ({:.4} nm detilted), {:.2} nm PV after {:.2} s -> {}",
            after_servo(servos_of_process),
            statistics.rms,
            detilted,
            statistics.pv,
            trajectory.total_time_s(),
            self.output.out.display()
        ));
        Ok(status)
    }

    fn settings(&self) -> SimulationSettings {
        match self.integral {
            IntegrationMethod::Gridded => SimulationSettings::Gridded,
            IntegrationMethod::Direct => SimulationSettings::Direct { steps: self.steps },
        }
    }

    fn servos(&self, inputs: &mut Inputs) -> Result<Deviation, Failure> {
        let Some(path) = &self.servo_of else { return Ok(Deviation::default()) };
        let file: ErrorBudgetFile = inputs.read_json("error-budget", path)?;
        let process =
            file.checked().map_err(|e| Failure::new(format!("{}: {e}", path.display())))?;
        Ok(Deviation::servos_of(&process))
    }
}

/// Returns the words before the residual that say which servos the axes follow; `servos` is their number, `None` without
/// `--servo-of`.
fn after_servo(servos: Option<usize>) -> &'static str {
    match servos {
        None => "",
        Some(0) => "the process states no servo of a fixed lag, so the axes follow exactly: ",
        Some(_) => "after the servo of the process: ",
    }
}

/// Warns if the motion covers the map poorly. Returns the status of the run, which is negative if there is a
/// `drawback`.
fn status(coverage: &Coverage, drawback: Option<String>) -> Status {
    if let Some(warning) = coverage.warning() {
        warn(warning);
    }
    coverage.drawback().or(drawback).map_or(Status::Done, Status::Negative)
}

fn write_frames(
    writer: &mut Writer,
    frames: Frames,
    output: &OutputArgs,
) -> Result<Status, Failure> {
    let x = frames.grid.x.coordinates();
    let y = frames.grid.y.coordinates();

    let count = frames.time_s.len();
    let stride = frames.stride;
    let removal = ArrayData::F64(frames.removal_nm.into_dyn().into());
    let [time, x, y] =
        [frames.time_s, x, y].map(|values| ArrayData::F64(Array1::from(values).into_dyn().into()));
    let arrays = [time, removal, x, y];
    let status = status(&frames.coverage, None);
    let outcome = json!({ "every_pixel": stride, "coverage": frames.coverage });
    writer.write_arrays(&kind::FRAMES, &arrays, &[], outcome, &status)?;
    let [sx, sy] = stride;
    let shape = format!("{} x {} pixels", frames.grid.x.len(), frames.grid.y.len());
    say(format!(
        "{count} frames of {shape} (one in {sx} columns, {sy} rows) -> {}",
        output.out.display()
    ));
    Ok(status)
}
