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
use planish_export::{
    Common, Controller, Origin, PATH_DEVIATION_MM, Program, program, program_of_axes,
};
use planish_form::{Form, FormFile};
use planish_handoff::{
    Failure, Inputs, Manifest, OutputFile, Status,
    flags::{AxesArgs, OnAxes, OutputFileArgs, TrajectoryArgs},
    say, warn,
};
use planish_types::{AxesMotion, Counts, Kinematics, Machine, TransformNumbers};

#[derive(Debug, Subcommand)]
pub enum Method {
    /// Galil DMC, PVT mode: counts, counts/s, samples
    Galil(galil::Galil),
    /// Newport XPS, PVT trajectory file: dt, dx, vx, dy, vy, further axes
    Xps(xps::Xps),
    /// Delta Tau / Omron PMAC, PVT mode
    Pmac(pmac::Pmac),
    /// G-code for LinuxCNC and its relatives: straight lines, each in its time
    Gcode(gcode::Gcode),
    /// Table of the motion: t, x, vx, y, vy, further axes, tool on
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
    /// Motion of the axes x and y [trajectory artifact]
    #[arg(long, value_name = "DIR", required_unless_present = "axes", conflicts_with = "axes")]
    trajectory: Option<PathBuf>,
    /// Motion of all axes [axes artifact]
    #[arg(long, value_name = "DIR")]
    axes: Option<PathBuf>,
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]; a plane without it
    #[arg(long, value_name = "PATH", conflicts_with = "trajectory")]
    form: Option<PathBuf>,
    #[command(flatten)]
    machine: AxesArgs,
    /// Size of a count, mm, of the linear axes: one number, or one for each axis as in X,Y [default: that of the
    /// machine's controller, else 0.0001]
    #[arg(long, value_name = "C", value_delimiter = ',', allow_hyphen_values = true)]
    count_mm: Option<Vec<f64>>,
    /// Size of a count of the rotary axes, degrees: one number, or one for each axis [default: that of the machine's
    /// controller, else 0.0001]
    #[arg(
        long,
        value_name = "C",
        value_delimiter = ',',
        allow_hyphen_values = true,
        conflicts_with = "trajectory"
    )]
    count_deg: Option<Vec<f64>>,
    /// Longest segment, s [default: that of the controller]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    max_step_s: Option<f64>,
    /// Largest distance of the program's path from the plan's, mm; larger for fewer segments. A rotary axis counts with
    /// its distance from the contact point
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
        let mut inputs = Inputs::new();
        let motion = self.read(&mut inputs)?;
        let program_file = self.output.begin(&inputs)?;
        let about_file = OutputFile::begin("--out", &about, *force, &inputs)?;
        refuse_foreign_about(&about)?;
        let common = Common {
            counts: Counts { mm: self.count_mm.clone(), deg: self.count_deg.clone() },
            tick_s,
            max_step_s: self.max_step_s,
            path_deviation_mm: self.path_deviation_mm,
            always_on: self.always_on,
        };
        let made = motion.program(controller, &common, &inputs)?;
        for warning in &made.about.warnings {
            warn(warning);
        }
        let about_text = format!("{}\n", serde_json::to_string_pretty(&made.about)?);
        let files = [(program_file, made.text.as_bytes()), (about_file, about_text.as_bytes())];
        OutputFile::write_together(files)?;
        let a = &made.about;
        let contact = a.contact_deviation_mm.map_or(String::new(), |mm| {
            format!(", contact point within {:.2} um of the plan's", 1e3 * mm)
        });
        say(format!(
            "planish-export: {} segments, {:.4} s, {:.4} s longer than the plan, path within {:.2} um of it{contact}, \
             limits kept -> {}",
            a.segments,
            a.total_time_s,
            a.added_time_s,
            1e3 * a.path_deviation_mm,
            out.display()
        ));
        Ok(Status::Done)
    }

    /// Reads the motion that is given, its machine, and the form of the part.
    fn read(&self, inputs: &mut Inputs) -> Result<Given, Failure> {
        match (&self.axes, &self.trajectory) {
            (Some(axes), _) => {
                let (motion, manifest): (AxesMotion, _) =
                    inputs.read_with_manifest("axes", axes)?;
                let machine = self.machine.read(axes, manifest.as_ref(), inputs)?;
                let form = match &self.form {
                    Some(path) => inputs.read_form("form", path)?.form,
                    None => Form::new(&FormFile::plane(), None)?,
                };
                Ok(Given::Axes(Box::new(GivenAxes {
                    dir: axes.clone(),
                    motion,
                    manifest,
                    machine,
                    form,
                })))
            }
            (None, Some(trajectory)) => {
                let given = TrajectoryArgs { trajectory: trajectory.clone() };
                let on_axes = given.read_on_axes(&self.machine, inputs)?;
                if *on_axes.machine.kinematics() != Kinematics::Xy {
                    let names: Vec<&str> = on_axes.machine.axes().iter().map(|a| a.name).collect();
                    return Err(Failure::new(format!(
                        "{}: has the axes {}, and --trajectory moves x and y; give --axes with the motion that \
                         planish-axes motion makes",
                        self.machine.machine.machine.display(),
                        names.join(", ")
                    )));
                }
                Ok(Given::Trajectory(trajectory.clone(), Box::new(on_axes)))
            }
            (None, None) => Err(Failure::new("give --trajectory or --axes")),
        }
    }
}

/// Motion for a program.
enum Given {
    /// Motion of x and y, in the coordinates of the axes, and its directory.
    Trajectory(PathBuf, Box<OnAxes>),
    /// Motion of all axes.
    Axes(Box<GivenAxes>),
}

struct GivenAxes {
    dir: PathBuf,
    motion: AxesMotion,
    manifest: Option<Manifest>,
    machine: Machine,
    form: Form,
}

impl Given {
    fn program(
        &self,
        controller: &Controller,
        common: &Common,
        inputs: &Inputs,
    ) -> Result<Program, Failure> {
        let origin = |role: &str, dir: &Path, manifest: Option<&Manifest>| {
            let digest = inputs.digest(role).unwrap_or_default();
            let by = manifest.map_or(String::new(), |m| format!(" by {} {}", m.tool, m.method));
            Origin {
                made_from: format!("{role} {}{by}, BLAKE3 {digest}", dir.display()),
                made_by: format!("planish-export {}", env!("CARGO_PKG_VERSION")),
                ..Origin::default()
            }
        };
        match self {
            Self::Trajectory(dir, given) => {
                let origin = Origin {
                    part_to_axes: given.part_to_axes.as_ref().map(TransformNumbers::from),
                    was_on_axes: given.was_there,
                    ..origin("trajectory", dir, given.manifest.as_ref())
                };
                program(&given.motion, &given.machine, controller, common, &origin)
            }
            Self::Axes(given) => {
                let origin = origin("axes", &given.dir, given.manifest.as_ref());
                let GivenAxes { motion, machine, form, .. } = given.as_ref();
                program_of_axes(motion, machine, form, controller, common, &origin)
            }
        }
        .map_err(Failure::with_flags)
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
