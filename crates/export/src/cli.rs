//! The subcommands of `planish-export`: one for each controller, with the flags that all share and its own.

mod near_path;

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::{ArgMatches, Args, Command, FromArgMatches, Subcommand, error::ErrorKind};
use planish_export::{
    About, Origin, PATH_DEVIATION_MM, Program, ProgramSettings, check, gcode, pmac, program,
    program_of_axes,
};
use planish_form::{Form, FormFile};
use planish_handoff::{
    Failure, Inputs, Manifest, OutputFile, Status,
    flags::{AxesArgs, NearPathArgs, OnAxes, OutputFileArgs, TrajectoryArgs},
    say, warn,
};
use planish_types::{
    AxesMotion, ControllerKind, Counts, Kinematics, Machine, PathDistance, TransformNumbers,
};
use serde::Serialize;

/// Content of the JSON file beside a program.
#[derive(Serialize)]
struct AboutFile<'a> {
    #[serde(flatten)]
    about: &'a About,
    /// Distance of the plan from its tool path; left out if it is unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    path_distance: Option<PathDistance>,
}

/// A program to write: the subcommand, which is the name of a [`ControllerKind`], and its flags.
#[derive(Debug)]
pub struct Export {
    controller: ControllerKind,
    /// Clock that the flags give, s: for a Galil two samples. `None` for that of the machine's controller.
    tick_s: Option<f64>,
    pmac: pmac::PmacSettings,
    gcode: gcode::GcodeSettings,
    common: CommonArgs,
}

/// The clock of any controller but a Galil.
#[derive(Debug, Args)]
struct ClockArgs {
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    tick_s: Option<f64>,
}

#[derive(Debug, Args)]
struct GalilArgs {
    /// Sample time of the controller, s; a segment has an even number of them [default: half the clock of the
    /// machine's controller, else 1/1024, that of TM 1000]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    sample_s: Option<f64>,
}

#[derive(Debug, Args)]
struct PmacArgs {
    /// Unit of time of the velocities of a PMAC, s: Isx90 / 1000
    #[arg(long, value_name = "T", default_value_t = 1.0, allow_negative_numbers = true)]
    feedrate_time_unit_s: f64,
    /// M-variable that switches the tool, 1 for on [default: the program does not switch it]
    #[arg(long, value_name = "M")]
    tool_output: Option<u32>,
}

#[derive(Debug, Args)]
struct GcodeArgs {
    /// Convention of the F word: inverse time of each line (G93), or units per minute (G94)
    #[arg(long, value_enum, default_value = "inverse-time")]
    f_word: gcode::Feed,
    /// Largest distance of the path from the corners between lines, mm (G64 P); 0 for an exact path (G61) [default: the
    /// path deviation]
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    path_tolerance_mm: Option<f64>,
    /// Write lines of rotary axes, for a planner that was tried with them: LinuxCNC 2.9 takes longer over such lines and
    /// exceeds the limits
    #[arg(long)]
    rotary_lines: bool,
}

/// Adds the flag `--tick-s` of the clock to a subcommand, with the default of this controller in its help.
fn with_clock(command: Command, kind: ControllerKind) -> Command {
    ClockArgs::augment_args(command).mut_arg("tick_s", |flag| {
        flag.help(format!(
            "Clock, s: times are rounded to it [default: that of the machine's controller, else {:e}]",
            kind.model().tick_s
        ))
    })
}

impl Subcommand for Export {
    fn augment_subcommands(command: Command) -> Command {
        command.subcommands(ControllerKind::ALL.map(|kind| {
            let own = Command::new(kind.name());
            let own = match kind {
                ControllerKind::Galil => GalilArgs::augment_args(own),
                ControllerKind::Pmac => PmacArgs::augment_args(with_clock(own, kind)),
                ControllerKind::Gcode => GcodeArgs::augment_args(with_clock(own, kind)),
                _ => with_clock(own, kind),
            };
            CommonArgs::augment_args(own).about(kind.about())
        }))
    }

    fn augment_subcommands_for_update(command: Command) -> Command {
        Self::augment_subcommands(command)
    }

    fn has_subcommand(name: &str) -> bool {
        ControllerKind::named(name).is_some()
    }
}

impl FromArgMatches for Export {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let chosen = matches.subcommand();
        let chosen = chosen.and_then(|(name, own)| Some((ControllerKind::named(name)?, own)));
        let Some((controller, own)) = chosen else {
            return Err(clap::Error::new(ErrorKind::MissingSubcommand));
        };
        let mut export = Self {
            controller,
            tick_s: None,
            pmac: pmac::PmacSettings::default(),
            gcode: gcode::GcodeSettings::default(),
            common: CommonArgs::from_arg_matches(own)?,
        };
        if controller == ControllerKind::Galil {
            let GalilArgs { sample_s } = GalilArgs::from_arg_matches(own)?;
            export.tick_s = sample_s.map(|s| 2.0 * s);
            return Ok(export);
        }
        export.tick_s = ClockArgs::from_arg_matches(own)?.tick_s;
        if controller == ControllerKind::Pmac {
            let PmacArgs { feedrate_time_unit_s, tool_output } = PmacArgs::from_arg_matches(own)?;
            export.pmac = pmac::PmacSettings { feedrate_time_unit_s, tool_output };
        }
        if controller == ControllerKind::Gcode {
            let GcodeArgs { f_word, path_tolerance_mm, rotary_lines } =
                GcodeArgs::from_arg_matches(own)?;
            export.gcode = gcode::GcodeSettings { feed: f_word, path_tolerance_mm, rotary_lines };
        }
        Ok(export)
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// The flags of every program.
#[derive(Debug, Args)]
struct CommonArgs {
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
    #[command(flatten)]
    near_path: NearPathArgs,
    /// Size of a count, mm, of the linear axes: one number, or one for each axis as in X,Y [default: that of the
    /// machine's controller, or of the kind]
    #[arg(long, value_name = "C", value_delimiter = ',', allow_hyphen_values = true)]
    count_mm: Option<Vec<f64>>,
    /// Size of a count of the rotary axes, degrees: one number, or one for each axis [default: that of the machine's
    /// controller, or of the kind]
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

impl Export {
    /// Writes the program, and the JSON file beside it that describes the program.
    ///
    /// # Errors
    /// Fails if the motion cannot be read, if no program of it keeps the limits, or if a file cannot be written.
    pub fn run(&self) -> Result<Status, Failure> {
        let common = &self.common;
        let OutputFileArgs { out, force } = &common.output;
        let mut about = out.clone().into_os_string();
        about.push(".json");
        let about = PathBuf::from(about);
        let settings = self.settings();
        // Before the motion, which may be large, or not there yet
        let machine = Inputs::new().read_machine(&common.machine.machine.machine)?;
        check(&machine, self.controller, &settings).map_err(|e| {
            let flag = format!("`{}`: {}; {}", e.array, e.problem, e.remedy);
            Failure::new(planish_handoff::with_flags(&flag))
        })?;
        let mut inputs = Inputs::new();
        let motion = common.read(&mut inputs)?;
        let distance = near_path::checked(&common.near_path, &motion, &mut inputs)?;
        let program_file = common.output.begin(&inputs)?;
        // A run that was ended between its two files has left this one.
        let is_alone = fs::symlink_metadata(out).is_err();
        let about_file = OutputFile::begin("--out", &about, *force || is_alone, &inputs)?;
        refuse_foreign_about(&about)?;
        let made = motion.program(self.controller, &settings, &inputs)?;
        for warning in &made.about.warnings {
            warn(warning);
        }
        let about_json = AboutFile { about: &made.about, path_distance: distance };
        let about_text = format!("{}\n", serde_json::to_string_pretty(&about_json)?);
        let files = [(about_file, about_text.as_bytes()), (program_file, made.text.as_bytes())];
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
        near_path::tell(distance.as_ref());
        Ok(Status::Done)
    }

    /// Returns the settings of the program that the flags state.
    fn settings(&self) -> ProgramSettings {
        let common = &self.common;
        ProgramSettings {
            counts: Counts { mm: common.count_mm.clone(), deg: common.count_deg.clone() },
            tick_s: self.tick_s,
            max_step_s: common.max_step_s,
            path_deviation_mm: common.path_deviation_mm,
            always_on: common.always_on,
            pmac: self.pmac.clone(),
            gcode: self.gcode.clone(),
        }
    }
}

impl CommonArgs {
    /// Reads the motion of --trajectory or --axes, its machine, and the form of the part.
    fn read(&self, inputs: &mut Inputs) -> Result<MotionInput, Failure> {
        match (&self.axes, &self.trajectory) {
            (Some(axes), _) => {
                let (motion, manifest): (AxesMotion, _) =
                    inputs.read_with_manifest("axes", axes)?;
                let machine = self.machine.read(axes, manifest.as_ref(), inputs)?;
                let form = match &self.form {
                    Some(path) => inputs.read_form("form", path)?.form,
                    None => Form::new(&FormFile::plane(), None)?,
                };
                Ok(MotionInput::Axes(Box::new(AxesInput {
                    dir: axes.clone(),
                    motion,
                    manifest,
                    machine,
                    form,
                })))
            }
            (None, Some(trajectory)) => {
                let arguments = TrajectoryArgs { trajectory: trajectory.clone() };
                let on_axes = arguments.read_on_axes(&self.machine, inputs)?;
                if *on_axes.machine.kinematics() != Kinematics::Xy {
                    let names: Vec<&str> = on_axes.machine.axes().iter().map(|a| a.name).collect();
                    return Err(Failure::new(format!(
                        "{}: has the axes {}, and --trajectory moves x and y; give --axes with the motion that \
                         planish-axes motion makes",
                        self.machine.machine.machine.display(),
                        names.join(", ")
                    )));
                }
                Ok(MotionInput::Trajectory(trajectory.clone(), Box::new(on_axes)))
            }
            (None, None) => Err(Failure::new("give --trajectory or --axes")),
        }
    }
}

/// The motion of which a program is written.
enum MotionInput {
    /// Directory of a trajectory, and its motion of x and y in the coordinates of the axes.
    Trajectory(PathBuf, Box<OnAxes>),
    /// Motion of all axes, with its machine and the form of the part.
    Axes(Box<AxesInput>),
}

struct AxesInput {
    dir: PathBuf,
    motion: AxesMotion,
    manifest: Option<Manifest>,
    machine: Machine,
    form: Form,
}

impl MotionInput {
    /// Makes the program of the motion for a controller. `inputs` gives the hash of the motion for the header.
    fn program(
        &self,
        controller: ControllerKind,
        settings: &ProgramSettings,
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
            Self::Trajectory(dir, on_axes) => {
                let origin = Origin {
                    part_to_axes: on_axes.part_to_axes.as_ref().map(TransformNumbers::from),
                    was_on_axes: on_axes.was_there,
                    ..origin("trajectory", dir, on_axes.manifest.as_ref())
                };
                program(&on_axes.motion, &on_axes.machine, controller, settings, &origin)
            }
            Self::Axes(input) => {
                let origin = origin("axes", &input.dir, input.manifest.as_ref());
                let AxesInput { motion, machine, form, .. } = input.as_ref();
                program_of_axes(motion, machine, form, controller, settings, &origin)
            }
        }
        .map_err(Failure::with_flags)
    }
}

/// Refuses to replace the JSON file beside the program if no export wrote it, even with `--force`. Its name follows
/// from that of the program, so the user did not name it. A file counts as written by an export if it is JSON with the
/// keys `controller` and `segments`.
fn refuse_foreign_about(about: &Path) -> Result<(), Failure> {
    let Ok(metadata) = fs::metadata(about) else { return Ok(()) };
    // A pipe would never end.
    let text = if metadata.is_file() { fs::read_to_string(about).ok() } else { None };
    let is_ours = text.is_some_and(|text| {
        serde_json::from_str::<serde_json::Value>(&text)
            .is_ok_and(|json| json.get("controller").is_some() && json.get("segments").is_some())
    });
    if is_ours {
        return Ok(());
    }
    Err(Failure::new(format!(
        "{}: would be replaced by what planish-export says of its program, and Planish did not \
         write it; give another --out",
        about.display()
    )))
}
