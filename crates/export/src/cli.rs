//! The subcommands, one file for each controller, and what they have in common.

mod csv;
mod galil;
mod gcode;
mod pmac;
mod xps;

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::{Args, Subcommand};
use planish_export::{Common, Controller, Origin, PATH_DEVIATION_MM, program};
use planish_handoff::{
    Failure, Inputs, OutputFile, Status,
    flags::{AxesArgs, OutputFileArgs, TrajectoryArgs},
    pair, say, warn,
};
use planish_types::{Kinematics, TransformNumbers};

#[derive(Debug, Subcommand)]
pub enum Method {
    /// Galil DMC, PVT mode: counts, counts/s, samples
    Galil(galil::Galil),
    /// Newport XPS, PVT trajectory file: dt, dx, vx, dy, vy
    Xps(xps::Xps),
    /// Delta Tau / Omron PMAC, PVT mode
    Pmac(pmac::Pmac),
    /// G-code for LinuxCNC and its relatives: straight lines, each in its time
    Gcode(gcode::Gcode),
    /// Table of the motion: t, x, vx, y, vy, tool on
    Csv(csv::Csv),
}

impl Method {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Galil(arguments) => arguments.run(),
            Self::Xps(arguments) => arguments.run(),
            Self::Pmac(arguments) => arguments.run(),
            Self::Gcode(arguments) => arguments.run(),
            Self::Csv(arguments) => arguments.run(),
        }
    }
}

#[derive(Debug, Args)]
pub struct CommonArgs {
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    #[command(flatten)]
    machine: AxesArgs,
    /// Size of a count, mm: one number, or two for X,Y [default: that of the machine's controller, else 0.0001]
    #[arg(long, value_name = "C", value_parser = pair, allow_hyphen_values = true)]
    count_mm: Option<[f64; 2]>,
    /// Longest segment, s [default: that of the controller]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    max_step_s: Option<f64>,
    /// Largest distance of the program's path from the plan's, mm; larger for fewer segments
    #[arg(long, value_name = "D", default_value_t = PATH_DEVIATION_MM, allow_negative_numbers = true)]
    path_deviation_mm: f64,
    /// Leave the tool on where the motion has it off and the program cannot switch it
    #[arg(long)]
    always_on: bool,
    #[command(flatten)]
    output: OutputFileArgs,
}

impl CommonArgs {
    /// Writes the program, and what is to be known of it beside it.
    fn export(&self, controller: &Controller, tick_s: Option<f64>) -> Result<Status, Failure> {
        let OutputFileArgs { out, force } = &self.output;
        let about = PathBuf::from(format!("{}.json", out.display()));
        let version = env!("CARGO_PKG_VERSION");
        let mut inputs = Inputs::new();
        let on_axes = self.trajectory.read_on_axes(&self.machine, &mut inputs)?;
        if *on_axes.machine.kinematics() != Kinematics::Xy {
            let names: Vec<&str> = on_axes.machine.axes().iter().map(|a| a.name).collect();
            return Err(Failure::new(format!(
                "{}: has the axes {}, and a program is for x and y; give a machine with x and y alone, or use the motion \
                 of planish-axes motion",
                self.machine.machine.machine.display(),
                names.join(", ")
            )));
        }
        let program_file = self.output.begin(&inputs)?;
        let about_file = OutputFile::begin("--out", &about, *force, &inputs)?;
        refuse_foreign_about(&about)?;

        let digest = inputs.digest("trajectory").unwrap_or_default();
        let by = on_axes
            .manifest
            .as_ref()
            .map_or(String::new(), |m| format!(" by {} {}", m.tool, m.method));
        let origin = Origin {
            made_from: format!(
                "trajectory {}{by}, BLAKE3 {digest}",
                self.trajectory.trajectory.display()
            ),
            made_by: format!("planish-export {version}"),
            part_to_axes: on_axes.part_to_axes.as_ref().map(TransformNumbers::from),
            was_on_axes: on_axes.was_there,
        };
        let common = Common {
            count_mm: self.count_mm,
            tick_s,
            max_step_s: self.max_step_s,
            path_deviation_mm: self.path_deviation_mm,
            always_on: self.always_on,
        };
        let made = program(&on_axes.motion, &on_axes.machine, controller, &common, &origin)
            .map_err(Failure::with_flags)?;
        for warning in &made.about.warnings {
            warn(warning);
        }
        let about_text = format!("{}\n", serde_json::to_string_pretty(&made.about)?);
        let files = [(program_file, made.text.as_bytes()), (about_file, about_text.as_bytes())];
        OutputFile::write_together(files)?;
        let a = &made.about;
        say(format!(
            "planish-export: {} segments, {:.4} s, {:.4} s longer than the plan, path within {:.2} um of it, limits kept \
             -> {}",
            a.segments,
            a.total_time_s,
            a.added_time_s,
            1e3 * a.path_deviation_mm,
            out.display()
        ));
        Ok(Status::Done)
    }
}

/// The name of the file beside the program follows from that of the program; the user did not give it,
/// so `--force` replaces there only what an export wrote.
fn refuse_foreign_about(about: &Path) -> Result<(), Failure> {
    let Ok(found) = fs::metadata(about) else { return Ok(()) };
    // A pipe would never end.
    let text = if found.is_file() { fs::read_to_string(about).ok() } else { None };
    let is_ours = text.is_some_and(|text| {
        serde_json::from_str::<serde_json::Value>(&text)
            .is_ok_and(|json| json.get("controller").is_some() && json.get("segments").is_some())
    });
    match is_ours {
        true => Ok(()),
        false => Err(Failure::new(format!(
            "{}: would be replaced by what planish-export says of its program, and Planish did not \
             write it; give another --out",
            about.display()
        ))),
    }
}
