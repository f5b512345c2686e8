//! The subcommands of `planish export`: one for each controller, with the flags that all share and its own.

mod near_path;
mod parts;

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::{Arg, ArgMatches, Args, Command, FromArgMatches, Subcommand, error::ErrorKind};
use planish_export::{
    About, Origin, PATH_DEVIATION_MM, Program, ProgramSettings, check, gcode,
    pmac::{self, PmacBuffer},
    program, program_of_axes, scan_arrays,
    xps::{self, XpsGroup},
};
use planish_form::{Form, FormFile};
use planish_handoff::{
    Failure, Inputs, Manifest, OutputFile, Status, as_command,
    flags::{AxesArgs, NearPathArgs, OnAxes, OutputFileArgs, PartArgs, TrajectoryArgs},
    say, warn,
};
use planish_types::{
    AxesMotion, ControllerKind, Counts, Kinematics, Machine, Part, PathDistance, TransformNumbers,
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
    /// File beside the program for whoever runs it; `None` if none is asked for.
    companion: Option<Companion>,
    common: CommonArgs,
}

/// A file for whoever runs a program, made of the program.
#[derive(Debug)]
enum Companion {
    /// Host script of a Galil.
    GalilHost(PathBuf),
    /// Calls of an XPS with this group of positioners.
    XpsCommands(PathBuf, XpsGroup),
    /// Arrays of the trajectory-scan program of a PMAC.
    PmacScan(PathBuf),
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
    /// Write a host in Python beside the program, which sends it through gclib, refills the buffer and switches the tool
    #[arg(long, value_name = "FILE")]
    host_script: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct XpsArgs {
    #[command(flatten)]
    clock: ClockArgs,
    /// Write the calls that check and run the trajectory, one per line
    #[arg(long, value_name = "FILE", requires = "group")]
    commands: Option<PathBuf>,
    /// Name of the MultipleAxes group on the controller, for --commands
    #[arg(long, value_name = "NAME", requires = "commands")]
    group: Option<String>,
    /// Names of the positioners of the group, in the order of the axes, to ask what the verification found
    #[arg(long, value_name = "P,Q", value_delimiter = ',', requires = "commands")]
    positioners: Vec<String>,
}

#[derive(Debug, Args)]
struct PmacArgs {
    /// Unit of time of the velocities of a PMAC, s: Isx90 / 1000
    #[arg(long, value_name = "T", default_value_t = 1.0, allow_negative_numbers = true)]
    feedrate_time_unit_s: f64,
    /// M-variable that switches the tool, 1 for on [default: the program does not switch it]
    #[arg(long, value_name = "M")]
    tool_output: Option<u32>,
    /// Number of the motion program into which the text loads itself: OPEN PROG N CLEAR to CLOSE
    #[arg(long, value_name = "N", conflicts_with = "rotary")]
    open_program: Option<u32>,
    /// Coordinate system into whose rotary buffer the text loads itself: OPEN ROT to CLOSE. Parts then join without a
    /// stop
    #[arg(long, value_name = "CS")]
    rotary: Option<u32>,
    /// Write the arrays of the public trajectory-scan program, as pymalcolm and ophyd-async fill them [JSON]
    #[arg(long, value_name = "FILE")]
    scan_arrays: Option<PathBuf>,
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
    /// Choose the feeds so that the planner of LinuxCNC takes the times of the plan. For LinuxCNC alone, with the
    /// acceleration limits of the machine file in its configuration
    #[arg(long, conflicts_with = "rotary_lines")]
    linuxcnc_feeds: bool,
}

/// Adds the flag `--tick-s` of the clock to a subcommand, with the default of this controller in its help.
fn with_clock(command: Command, kind: ControllerKind) -> Command {
    ClockArgs::augment_args(command).mut_arg("tick_s", clock_help(kind))
}

/// Returns the function that gives the flag `--tick-s` its help for this controller.
fn clock_help(kind: ControllerKind) -> impl FnOnce(Arg) -> Arg {
    move |flag| {
        flag.help(format!(
            "Clock, s: times are rounded to it [default: that of the machine's controller, else {:e}]",
            kind.model().tick_s
        ))
    }
}

impl Subcommand for Export {
    fn augment_subcommands(command: Command) -> Command {
        command.subcommands(ControllerKind::ALL.map(|kind| {
            let own = Command::new(kind.name());
            let own = match kind {
                ControllerKind::Galil => GalilArgs::augment_args(own),
                ControllerKind::Pmac => PmacArgs::augment_args(with_clock(own, kind)),
                ControllerKind::Gcode => GcodeArgs::augment_args(with_clock(own, kind)),
                ControllerKind::Xps => {
                    XpsArgs::augment_args(own).mut_arg("tick_s", clock_help(kind))
                }
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
            companion: None,
            common: CommonArgs::from_arg_matches(own)?,
        };
        if controller == ControllerKind::Galil {
            let GalilArgs { sample_s, host_script } = GalilArgs::from_arg_matches(own)?;
            export.tick_s = sample_s.map(|s| 2.0 * s);
            export.companion = host_script.map(Companion::GalilHost);
            return Ok(export);
        }
        export.tick_s = ClockArgs::from_arg_matches(own)?.tick_s;
        if controller == ControllerKind::Pmac {
            let PmacArgs { feedrate_time_unit_s, tool_output, open_program, rotary, scan_arrays } =
                PmacArgs::from_arg_matches(own)?;
            let buffer = match (open_program, rotary) {
                (Some(n), _) => PmacBuffer::Program(n),
                (None, Some(n)) => PmacBuffer::Rotary(n),
                (None, None) => PmacBuffer::OfTheHost,
            };
            export.pmac = pmac::PmacSettings { feedrate_time_unit_s, tool_output, buffer };
            export.companion = scan_arrays.map(Companion::PmacScan);
        }
        if controller == ControllerKind::Xps {
            let XpsArgs { clock, commands, group, positioners } = XpsArgs::from_arg_matches(own)?;
            export.tick_s = clock.tick_s;
            export.companion = commands
                .zip(group)
                .map(|(file, name)| Companion::XpsCommands(file, XpsGroup { name, positioners }));
        }
        if controller == ControllerKind::Gcode {
            let GcodeArgs { f_word, path_tolerance_mm, rotary_lines, linuxcnc_feeds } =
                GcodeArgs::from_arg_matches(own)?;
            export.gcode = gcode::GcodeSettings {
                feed: f_word,
                path_tolerance_mm,
                rotary_lines,
                linuxcnc_feeds,
            };
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
    /// Write the same motion with the tool off. The name of --out then has "dry-run" in it
    #[arg(long)]
    dry_run: bool,
    /// Write the rest from this mark of the program on, with a run-up from rest and the tool off in it: the number of
    /// segments that have run
    #[arg(long, value_name = "N", conflicts_with_all = ["parts", "max_lines"])]
    from_mark: Option<usize>,
    /// Write the program in N files: FILE.part-1-of-N and so on
    #[arg(long, value_name = "N", conflicts_with = "max_lines")]
    parts: Option<usize>,
    /// Write the program in files of at most N lines
    #[arg(long, value_name = "N")]
    max_lines: Option<usize>,
    #[command(flatten)]
    part: PartArgs,
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
        self.check_name()?;
        let about = beside(out);
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
        if common.parts.is_some() || common.max_lines.is_some() {
            let made = self.in_parts(&motion, &settings, &inputs)?;
            near_path::tell(distance.as_ref());
            return self.write_parts(&made, distance, &inputs);
        }
        let program_file = common.output.begin(&inputs)?;
        // A run that was ended between its two files has left this one.
        let is_alone = fs::symlink_metadata(out).is_err();
        let about_file = OutputFile::begin("--out", &about, *force || is_alone, &inputs)?;
        refuse_foreign_about(&about)?;
        let part = common.part.part();
        let companion_file = self.begin_companion(*force, &inputs)?;
        let mut made = motion.program(self.controller, &settings, &part, &inputs)?;
        if let Some(mark) = common.from_mark.filter(|mark| *mark > 0) {
            let settings = ProgramSettings { marks: Some([mark, made.about.segments]), ..settings };
            made = motion.program(self.controller, &settings, &part, &inputs)?;
        }
        let companion = self.companion_text(&made)?;
        for warning in &made.about.warnings {
            warn(warning);
        }
        let about_json = AboutFile { about: &made.about, path_distance: distance };
        let about_text = format!("{}\n", serde_json::to_string_pretty(&about_json)?);
        let mut files =
            vec![(about_file, about_text.as_bytes()), (program_file, made.text.as_bytes())];
        files.extend(companion_file.map(|file| (file, companion.as_bytes())));
        OutputFile::write_together(files)?;
        let a = &made.about;
        let contact = a.contact_deviation_mm.map_or(String::new(), |mm| {
            format!(", contact point within {:.2} um of the plan's", 1e3 * mm)
        });
        say(format!(
            "planish export: {} segments, {:.4} s, {:.4} s longer than the plan, path within {:.2} um of it{contact}, \
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

    /// Refuses a dry run whose file name does not say so, and another program whose name does.
    fn check_name(&self) -> Result<(), Failure> {
        let OutputFileArgs { out, .. } = &self.common.output;
        let name = out.file_name().unwrap_or_default().to_string_lossy();
        let problem = match (self.common.dry_run, name.contains("dry-run")) {
            (true, false) => "is the name of a dry run; give one with \"dry-run\" in it",
            (false, true) => {
                "names a dry run, and the tool of this program goes on; give --dry-run, or another --out"
            }
            _ => return Ok(()),
        };
        Err(Failure::new(format!("{}: {problem}", out.display())))
    }

    /// Begins the file for whoever runs the program; `None` if none is asked for.
    fn begin_companion(&self, force: bool, inputs: &Inputs) -> Result<Option<OutputFile>, Failure> {
        let (flag, path) = match &self.companion {
            None => return Ok(None),
            Some(Companion::GalilHost(path)) => ("--host-script", path),
            Some(Companion::XpsCommands(path, _)) => ("--commands", path),
            Some(Companion::PmacScan(path)) => ("--scan-arrays", path),
        };
        let OutputFileArgs { out, .. } = &self.common.output;
        if path == out || *path == beside(out) {
            return Err(Failure::new(format!("{flag}: {} is the program, too", path.display())));
        }
        Ok(Some(OutputFile::begin(flag, path, force, inputs)?))
    }

    /// Returns the text of the file for whoever runs the program; empty if none is asked for.
    fn companion_text(&self, made: &Program) -> Result<String, Failure> {
        match &self.companion {
            None => Ok(String::new()),
            Some(Companion::GalilHost(_)) => Ok(include_str!("galil_host.py").into()),
            Some(Companion::XpsCommands(_, group)) => {
                let OutputFileArgs { out, .. } = &self.common.output;
                let name = out.file_name().unwrap_or_default().to_string_lossy();
                xps::commands(&made.about, group, &name).map_err(Failure::with_flags)
            }
            Some(Companion::PmacScan(_)) => scan_arrays(made).map_err(Failure::with_flags),
        }
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
            dry_run: common.dry_run,
            marks: None,
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
                         planish axes motion makes",
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
    /// Makes the program of the motion for a controller. `inputs` gives the hash of the motion for the header, which
    /// also states what the user says about the part.
    fn program(
        &self,
        controller: ControllerKind,
        settings: &ProgramSettings,
        part: &Part,
        inputs: &Inputs,
    ) -> Result<Program, Failure> {
        let origin = |role: &str, dir: &Path, manifest: Option<&Manifest>| {
            let digest = inputs.digest(role).unwrap_or_default();
            let by = manifest
                .map_or(String::new(), |m| format!(" by {} {}", as_command(&m.tool), m.method));
            Origin {
                made_from: format!("{role} {}{by}, BLAKE3 {digest}", dir.display()),
                made_by: format!("planish export {}", env!("CARGO_PKG_VERSION")),
                part: part.clone(),
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

/// Returns the path of the JSON file beside a program.
fn beside(program: &Path) -> PathBuf {
    let mut path = program.to_path_buf().into_os_string();
    path.push(".json");
    PathBuf::from(path)
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
        "{}: would be replaced by what planish export says of its program, and Planish did not \
         write it; give another --out",
        about.display()
    )))
}
