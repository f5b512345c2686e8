//! `planish-import program`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, controller, flags::OutputArgs, kind,
    kind::MACHINE_FRAME, pair, say, task, warn,
};
use planish_import::program::{self, Configuration};
use planish_types::{ControllerKind, Invalid, Trajectory, outcome::settings::ProgramSettings};
use serde::Serialize;

use super::{about, foreign};

#[derive(Debug, Args)]
pub struct ProgramArgs {
    /// Program of a controller
    file: PathBuf,
    /// Controller of the program
    #[arg(long, value_name = "NAME", value_parser = controller())]
    controller: ControllerKind,
    /// File that planish-export wrote beside the program; the flags below take precedence over it
    #[arg(long, value_name = "FILE")]
    about: Option<PathBuf>,
    /// Place of the axes before the program, mm
    #[arg(long, value_name = "X,Y", value_parser = pair, allow_hyphen_values = true)]
    start_mm: Option<[f64; 2]>,
    /// Size of a count, mm: one number, or two for X,Y
    #[arg(long, value_name = "C", value_parser = pair, allow_hyphen_values = true)]
    count_mm: Option<[f64; 2]>,
    /// Sample time of the controller, s
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    sample_s: Option<f64>,
    /// Unit of time of the velocities of a PMAC, s
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    feedrate_time_unit_s: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

/// Configuration of the controller, as the manifest records it.
#[derive(Serialize)]
struct ConfigurationSetting<'a> {
    configuration: &'a Configuration,
}

/// Outcome of reading a program, as the manifest records it.
#[derive(Serialize)]
struct ProgramOutcome<'a> {
    segments: usize,
    total_time_s: f64,
    /// True if the tool removes in every segment.
    always_on: bool,
    /// Names of the axes, if the configuration lists them.
    #[serde(skip_serializing_if = "Option::is_none")]
    axes: Option<Vec<&'a String>>,
    /// Units of these axes, mm or deg.
    #[serde(skip_serializing_if = "Option::is_none")]
    units: Option<Vec<&'a String>>,
}

impl ProgramArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let by_flags = Configuration {
            start_mm: self.start_mm,
            count_mm: self.count_mm,
            sample_s: self.sample_s,
            feedrate_time_unit_s: self.feedrate_time_unit_s,
            ..Configuration::default()
        };
        let configuration = match &self.about {
            Some(path) => {
                let bytes = foreign(&mut inputs, "about", path)?;
                let of_file = serde_json::from_slice(&bytes)
                    .map_err(|e| Failure::new(format!("{}: {e}", path.display())))?;
                by_flags.completed_by(of_file)
            }
            None => by_flags,
        };
        let controller = self.controller;
        let more = ConfigurationSetting { configuration: &configuration };
        let task = task!("program", ProgramSettings { controller, more });
        let bytes = foreign(&mut inputs, "file", &self.file)?;
        let is_of_all_axes = !configuration.axes.is_empty();
        let kind = if is_of_all_axes { &kind::AXES } else { Trajectory::KIND };
        let mut output = match Output::directory(&self.output, kind).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let refused = |e: Invalid| about(&self.file, &e);
        if let Some(doubt) = program::doubt(controller, &bytes) {
            warn(format!("{}: {doubt}", self.file.display()));
        }
        let (segments, total_time_s) = if is_of_all_axes {
            let motion = program::read_axes(controller, &bytes, &configuration).map_err(refused)?;
            let outcome = ProgramOutcome {
                segments: motion.len(),
                total_time_s: motion.total_time_s(),
                always_on: motion.tool_on().iter().all(|on| *on),
                axes: Some(configuration.axes.iter().map(|axis| &axis.name).collect()),
                units: Some(configuration.axes.iter().map(|axis| &axis.unit).collect()),
            };
            output.write(&motion, outcome, &Status::Done)?;
            (motion.len(), motion.total_time_s())
        } else {
            let motion = program::read(controller, &bytes, &configuration).map_err(refused)?;
            if configuration.was_on_axes {
                output.set_frame(MACHINE_FRAME);
            }
            let outcome = ProgramOutcome {
                segments: motion.len(),
                total_time_s: motion.total_time_s(),
                always_on: motion.tool_on().iter().all(|on| *on),
                axes: None,
                units: None,
            };
            output.write(&motion, outcome, &Status::Done)?;
            (motion.len(), motion.total_time_s())
        };
        say(format!(
            "planish-import: {segments} segments, {total_time_s:.4} s -> {}",
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
