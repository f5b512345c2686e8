//! `planish import program`.

use std::path::{Path, PathBuf};

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
    /// Program of a controller, or all its parts in their order; the JSON file beside each part is read
    #[arg(required = true)]
    file: Vec<PathBuf>,
    /// Controller of the program
    #[arg(long, value_name = "NAME", value_parser = controller())]
    controller: ControllerKind,
    /// File that planish export wrote beside the program; the flags below take precedence over it
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
    /// True if the program is a dry run.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    dry_run: bool,
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
        let controller = self.controller;
        let (bytes, configuration) = match &self.file[..] {
            [file] => {
                let configuration = match &self.about {
                    Some(path) => by_flags.completed_by(configuration_of(&mut inputs, path)?),
                    None => by_flags,
                };
                (foreign(&mut inputs, "file", file)?, configuration)
            }
            _ => self.joined(by_flags, &mut inputs)?,
        };
        let file = &self.file[0];
        let more = ConfigurationSetting { configuration: &configuration };
        let task = task!("program", ProgramSettings { controller, more });
        let is_of_all_axes = !configuration.axes.is_empty();
        let kind = if is_of_all_axes { &kind::AXES } else { Trajectory::KIND };
        let mut output = match Output::directory(&self.output, kind).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let refused = |e: Invalid| about(file, &e);
        if let Some(doubt) = program::doubt(controller, &bytes) {
            warn(format!("{}: {doubt}", file.display()));
        }
        let dry_run = program::is_dry_run(&bytes, &configuration);
        let (segments, total_time_s) = if is_of_all_axes {
            let motion = program::read_axes(controller, &bytes, &configuration).map_err(refused)?;
            let outcome = ProgramOutcome {
                segments: motion.len(),
                total_time_s: motion.total_time_s(),
                always_on: motion.tool_on().iter().all(|on| *on),
                dry_run,
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
                dry_run,
                axes: None,
                units: None,
            };
            output.write(&motion, outcome, &Status::Done)?;
            (motion.len(), motion.total_time_s())
        };
        say(format!(
            "planish import: {segments} segments, {total_time_s:.4} s{} -> {}",
            if dry_run { ", a dry run with the tool off" } else { "" },
            self.output.out.display()
        ));
        Ok(Status::Done)
    }

    /// Returns the program whose parts are given, and its configuration, which is that of the first part.
    fn joined(
        &self,
        by_flags: Configuration,
        inputs: &mut Inputs,
    ) -> Result<(Vec<u8>, Configuration), Failure> {
        if self.about.is_some() {
            let problem =
                "--about: is for a program in one file; the file beside each part is read";
            return Err(Failure::new(problem));
        }
        let mut parts = Vec::with_capacity(self.file.len());
        for path in &self.file {
            let mut beside = path.clone().into_os_string();
            beside.push(".json");
            let configuration = configuration_of(inputs, Path::new(&beside))?;
            parts.push((foreign(inputs, "file", path)?, configuration));
        }
        let bytes = program::join(&parts).map_err(|(i, e)| about(&self.file[i], &e))?;
        let (_, first) = parts.swap_remove(0);
        let configuration = by_flags.completed_by(Configuration { program_blake3: None, ..first });
        Ok((bytes, configuration))
    }
}

/// Returns the configuration in the file that planish export wrote beside a program.
fn configuration_of(inputs: &mut Inputs, path: &Path) -> Result<Configuration, Failure> {
    let bytes = foreign(inputs, "about", path)?;
    serde_json::from_slice(&bytes).map_err(|e| Failure::new(format!("{}: {e}", path.display())))
}
