//! A motion as the program of a motion controller: a trajectory for the axes x and y, or a motion of all axes.
//!
//! Every program is made in the same steps, for any number of axes. The plan is the given motion; a node is an end of a
//! segment of the program:
//!
//! 1. `limits::check_plan`: a motion that does not keep the limits of the machine is refused, and one that
//!    leaves the travel of its axes.
//! 2. `generate`: nodes on the clock and in the counts of the controller. The motion between them keeps the limits
//!    of the machine and a stated distance from the path of the plan.
//! 3. `limits::prove`: the motion that the controller executes keeps the limits on the whole of every segment.
//! 4. one module per controller: its limits, its text, how it switches the tool.
//!
//! | module | program | cubic between two lines | switches the tool |
//! |---|---|---|---|
//! | `galil` | Galil DMC, PVT mode | yes | no |
//! | `xps` | Newport XPS, PVT or PT trajectory file | yes, or no | no |
//! | [`pmac`] | Delta Tau / Omron PMAC, PVT mode | yes | by an M-variable that is named |
//! | [`gcode`] | G-code with inverse time or feed | no, lines that are joined | by digital output 0 |
//! | `csv` | table of the motion | yes | by a column |
//! | `aerotech` | Aerotech Ensemble, AeroBasic PVT | yes | no |
//! | `automation1` | Aerotech Automation1, AeroScript MovePvt | yes | no |
//! | `ros` | ROS message JointTrajectory | yes | no |
//! | `sinumerik` | Siemens SINUMERIK, G93 lines or polynomials | no, or yes | no |
//! | `twincat` | Beckhoff TwinCAT, table of setpoints per cycle | yes | by a column |
//! | `zaber` | Zaber, PVT sequence as CSV | yes | no |
//!
//! Around the motion: `around` (checksum, lines of the machine file, how to run the program), `excerpt` (the part between
//! two marks, from rest to rest), `parts` (several files), `scan` (arrays for the trajectory-scan program of the PMAC).
//!
//! Only this crate and `planish import` convert units.

// The command line names this library as any other program does.
extern crate self as planish_export;

mod aerotech;
mod around;
mod automation1;
mod cli;
pub mod command;
mod csv;
mod excerpt;
mod galil;
pub mod gcode;
mod generate;
mod header;
mod limits;
mod lines;
mod marks;
mod nodes;
mod parts;
mod plan;
mod planner;
pub mod pmac;
mod preamble;
mod ros;
mod scan;
mod sinumerik;
mod slowed;
mod twincat;
mod velocities;
pub mod xps;
mod zaber;

use std::array::from_fn;

use planish_form::Form;
use planish_kinematics::AxisMap;
use planish_types::{
    AxesMotion, ControllerKind, ControllerModel, Counts, Interpolation, Invalid, Kinematics,
    Machine, MachineAxis, Part, Trajectory, TransformNumbers,
};
use serde::Serialize;

use crate::{
    generate::{Nodes, generate},
    plan::{AxesPlan, Contact},
};
pub use crate::{
    limits::{Peak, Proof},
    marks::Marks,
    parts::{ProgramPart, cuts, in_parts, joins_without_stop},
    scan::scan_arrays,
};

/// Settings of a program.
#[derive(Clone, Debug, PartialEq)]
pub struct ProgramSettings {
    /// Sizes of the counts, the units of position of the axes. Those left out are the ones of the machine's controller.
    pub counts: Counts,
    /// Clock to which times are rounded, s; `None` for that of the machine's controller.
    pub tick_s: Option<f64>,
    /// Longest segment, s; `None` for the longest that the controller allows.
    pub max_step_s: Option<f64>,
    /// Largest distance of the program's path from the plan's, mm. Smaller: more segments.
    pub path_deviation_mm: f64,
    /// True if the tool may stay on where the motion lifts it and the program cannot switch it; otherwise such a motion
    /// is refused.
    pub always_on: bool,
    /// True for the same motion with the tool off.
    pub dry_run: bool,
    /// First and last mark of the part of the program that is written, from rest to rest; `None` for the whole program.
    pub marks: Option<[usize; 2]>,
    /// Further settings of a program for a PMAC; other programs do not read them.
    pub pmac: pmac::PmacSettings,
    /// Further settings of a G-code program; other programs do not read them.
    pub gcode: gcode::GcodeSettings,
}

/// Default of the largest distance of the program's path from the plan's, mm. Larger: fewer segments, and a removal
/// that differs more. Smaller: more segments. Chosen: a hundredth of the pixels (0.5 mm) of a fine map.
pub const PATH_DEVIATION_MM: f64 = 0.005;

impl Default for ProgramSettings {
    fn default() -> Self {
        Self {
            counts: Counts::default(),
            tick_s: None,
            max_step_s: None,
            path_deviation_mm: PATH_DEVIATION_MM,
            always_on: false,
            dry_run: false,
            marks: None,
            pmac: pmac::PmacSettings::default(),
            gcode: gcode::GcodeSettings::default(),
        }
    }
}

/// Origin of the motion of a program, stated in its header.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Origin {
    /// Sentence with the directory of the motion, the program that made it, and its BLAKE3 hash.
    pub made_from: String,
    /// Transform of the motion from the coordinates of the part to those of the axes; `None` if both are the same.
    pub part_to_axes: Option<TransformNumbers>,
    /// True if the motion was in the coordinates of the machine before the export.
    pub was_on_axes: bool,
    /// Name and version of the program that writes.
    pub made_by: String,
    /// Statements of the user about the part.
    pub part: Part,
}

/// A program for a controller, with its description.
#[derive(Clone, Debug)]
pub struct Program {
    /// Text of the program file.
    pub text: String,
    /// Description of the program, for the file beside it.
    pub about: About,
}

/// Description of a program, for the file beside it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct About {
    /// Kind of the controller, such as `galil`.
    pub controller: &'static str,
    /// Name of the machine.
    pub machine: String,
    /// Sentence with the directory of the motion, the program that made it, and its BLAKE3 hash.
    pub made_from: String,
    /// Name and version of the program that wrote it.
    pub made_by: String,
    /// Transform of the motion from the coordinates of the part to those of the axes; left out if both are the same. A
    /// reader of the program applies its inverse.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub part_to_axes: Option<TransformNumbers>,
    /// True if the tool stays off: a dry run. Left out if false.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub dry_run: bool,
    /// Place of this program in the whole one; left out if it is the whole one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub excerpt: Option<Excerpt>,
    /// Place of this file among the parts of a program; left out for a program in one file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub part: Option<ProgramPart>,
    /// Lines of the machine file before the motion.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub prologue: Vec<String>,
    /// Lines of the machine file after the motion.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub epilogue: Vec<String>,
    /// Lines of the machine file by which the host switches the tool on.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tool_on_lines: Vec<String>,
    /// Lines of the machine file by which the host switches the tool off.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tool_off_lines: Vec<String>,
    /// True if the motion was in the coordinates of the machine before the export.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub was_on_axes: bool,
    /// Position of the axes (x, y) before the program, mm; left out in a program of all axes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_mm: Option<[f64; 2]>,
    /// Size of a count of (x, y), mm; left out in a program of all axes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub count_mm: Option<[f64; 2]>,
    /// The axes of a program of all axes; empty in a program for x and y.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub axes: Vec<AboutAxis>,
    /// Sample time of the controller, s; left out if the program does not count samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sample_s: Option<f64>,
    /// Sentence that says who switches the tool, the program or the host, and how.
    pub tool: String,
    /// Sentences for the operator before the program runs. They also stand at the head of a program that can have
    /// comments.
    pub preamble: Vec<String>,
    /// Unit of time of the velocities of a PMAC, s; left out for other controllers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub feedrate_time_unit_s: Option<f64>,
    /// Clock to which times are rounded, s.
    pub tick_s: f64,
    /// Number of segments of the program.
    pub segments: usize,
    /// Duration of the motion that the program executes, s.
    pub total_time_s: f64,
    /// Number of segments that the buffer of the controller holds; left out if the buffer is no limit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub buffer_segments: Option<usize>,
    /// Shortest time that a full buffer lasts, s: the host must add lines faster than that. Left out if the buffer is
    /// no limit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub buffer_lasts_s: Option<f64>,
    /// Largest distance of the executed path from that of the plan, mm. A rotary axis counts with its lever, the
    /// distance that a point at its radius moves per degree.
    pub path_deviation_mm: f64,
    /// Largest distance of the executed contact point from that of the motion of the axes, mm, at eight points of every
    /// cubic of the executed motion. Absent in a program for x and y.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub contact_deviation_mm: Option<f64>,
    /// Difference between the time of the program and that of the plan, s; positive if the program takes longer.
    pub added_time_s: f64,
    /// Proof that the motion which the controller executes keeps the limits.
    pub limits: Proof,
    /// Warnings for the user.
    pub warnings: Vec<String>,
    /// Line, time and position of every segment.
    pub marks: Marks,
    /// BLAKE3 hash of the bytes of the program. The reader refuses this file with another program.
    pub program_blake3: String,
}

/// Place of a program in a whole one, from one mark to another.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Excerpt {
    /// Index of the first mark.
    pub from_mark: usize,
    /// Index of the mark at which it ends; the number of marks for the end of the whole program.
    pub to_mark: usize,
    /// Number of the line of the first mark in the whole program.
    pub from_line: usize,
    /// BLAKE3 hash of the whole program.
    pub whole_blake3: String,
    /// Number of segments before the first mark, from rest, with the tool off, and their time, s.
    pub run_up_segments: usize,
    /// Time of the run-up, s.
    pub run_up_s: f64,
    /// Number of segments after the last mark, to rest, with the tool off.
    pub run_down_segments: usize,
    /// Time of the run-down, s.
    pub run_down_s: f64,
}

/// An axis of a program of all axes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AboutAxis {
    /// Name of the axis in the machine file.
    pub name: &'static str,
    /// Unit of the numbers of this axis, mm or deg.
    pub unit: &'static str,
    /// Position of the axis before the program, in `unit`.
    pub start: f64,
    /// Size of a count, in `unit`.
    pub count: f64,
    /// Lowest and highest position on the whole motion, in `unit`.
    pub reach: [f64; 2],
}

impl About {
    /// Returns the name, unit and position before the program of every axis.
    fn starts(&self) -> Vec<(&'static str, &'static str, f64)> {
        match self.start_mm {
            Some([x, y]) => vec![("x", "mm", x), ("y", "mm", y)],
            None => self.axes.iter().map(|a| (a.name, a.unit, a.start)).collect(),
        }
    }
}

/// Largest time that a program may add without a warning, as a fraction of the time of the plan. Larger: slower
/// programs without a warning. Smaller: warnings for what rounding adds. Chosen: a plan that needs more was made for
/// other limits.
const WARNED_ADDED: f64 = 0.03;

/// Largest relative change of the dwell times of a plan by lines: root mean square over the time of the plan, of sums
/// within 2 mm of path. Larger: programs whose residual is above 1.02 times that of the plan. Smaller: good programs
/// are refused. Chosen: of 50 plans at their limits, those above 1.02 have at least 4e-3 (`programs-table.py
/// --at-limits`).
const MOST_UNEVEN: f64 = 2e-3;

/// Writes the program of `trajectory`, in the coordinates of the axes, for `controller` on `machine`. `settings` are
/// those of the program, and `origin` says where the motion comes from, for the header.
///
/// # Errors
/// Refuses a machine with other axes than x and y, of which [`program_of_axes`] writes programs, and what [`check`]
/// refuses. Refuses a motion whose removal rate is not that of the TIF, that does not keep the limits of the machine,
/// or that lifts the tool where the program cannot (unless `always_on`). Also refuses it if no program within the
/// limits, the segments of the controller and the dwell times of the plan is found.
pub fn program(
    trajectory: &Trajectory,
    machine: &Machine,
    controller: ControllerKind,
    settings: &ProgramSettings,
    origin: &Origin,
) -> Result<Program, Invalid> {
    let axes = <&[MachineAxis; 2]>::try_from(machine.axes());
    let (Ok(axes), Kinematics::Xy) = (axes, machine.kinematics()) else {
        let problem = "has other axes than x and y, and a trajectory moves x and y";
        let remedy = "give `axes` with the motion that planish axes motion makes";
        return Err(Invalid::whole("machine", problem, remedy));
    };
    let grids = grids(machine, controller, settings)?;
    trajectory.check_rate_is_constant()?;
    let plan = AxesPlan {
        break_time_s: trajectory.break_time_s(),
        coefficient: trajectory.coefficient_mm(),
        tool_on: trajectory.tool_on(),
        machine,
        axes,
        grids: of_axes(&grids.grids(axes)),
        lever: [1.0; 2],
        may_step: false,
        contact: None,
    };
    write(&Job { plan: &plan, settings, origin, grids }, controller)
}

/// Writes the program of a motion of all axes of `machine` over the part `form` for `controller`.
///
/// The acceleration of the motion may step at its nodes as far as a limit on jerk allows it between the middles of two
/// segments.
///
/// # Errors
/// Refuses a motion with another number of axes, a placement of the part that has no inverse, and what [`check`]
/// refuses. Refuses a motion that does not keep the limits of the machine, or that lifts the tool where the program
/// cannot (unless `always_on`). Also refuses it if no program within the limits, the segments of the controller and the
/// dwell times of the plan is found.
pub fn program_of_axes(
    motion: &AxesMotion,
    machine: &Machine,
    form: &Form,
    controller: ControllerKind,
    settings: &ProgramSettings,
    origin: &Origin,
) -> Result<Program, Invalid> {
    let map = AxisMap::new(machine, form)?;
    let contact = |positions: &[f64]| map.contact(positions).map(|c| c.point_mm);
    let all = AllAxes { motion, machine, contact: &contact, settings, origin };
    match machine.axes().len() {
        2 => all.program::<2>(controller),
        3 => all.program::<3>(controller),
        4 => all.program::<4>(controller),
        _ => all.program::<5>(controller),
    }
}

/// Checks the settings that do not depend on the motion: the clock, the counts and the further settings of a program,
/// for `controller` on `machine`.
///
/// # Errors
/// Refuses what [`program`] and [`program_of_axes`] refuse of these settings. The sample time of a Galil is checked for
/// two axes, which allow the shortest one.
pub fn check(
    machine: &Machine,
    controller: ControllerKind,
    settings: &ProgramSettings,
) -> Result<(), Invalid> {
    let grids = grids(machine, controller, settings)?;
    let turns = machine.axes().iter().any(|axis| axis.is_rotary);
    positive("path_deviation_mm", settings.path_deviation_mm)?;
    match controller {
        // The fewest axes: a motion of more is refused when it is there.
        ControllerKind::Galil => galil::sample_s(&grids, 2).map(|_| ()),
        ControllerKind::Pmac => {
            pmac::checked(&grids, &settings.pmac)?;
            pmac::check_lines(around::lines_for(machine, controller), &settings.pmac)
        }
        ControllerKind::Gcode => gcode::tolerance_mm(settings, turns).map(|_| ()),
        ControllerKind::SinumerikPoly => sinumerik::checked(&grids).map(|_| ()),
        _ => tick_s(&grids).map(|_| ()),
    }
}

/// Inputs of a program of all axes; `contact` gives the contact point on the part.
struct AllAxes<'a> {
    motion: &'a AxesMotion,
    machine: &'a Machine,
    contact: &'a Contact<'a>,
    settings: &'a ProgramSettings,
    origin: &'a Origin,
}

impl AllAxes<'_> {
    fn program<const N: usize>(&self, controller: ControllerKind) -> Result<Program, Invalid> {
        let Self { motion, machine, .. } = *self;
        let coefficient = plan::by_segment::<N>(motion)?;
        let axes = <&[MachineAxis; N]>::try_from(machine.axes()).map_err(|_| {
            let problem = format!("has {} axes", machine.axes().len());
            Invalid::whole("machine", problem, "give a machine of up to 5 axes")
        })?;
        let grids = grids(machine, controller, self.settings)?;
        let plan = AxesPlan {
            break_time_s: motion.break_time_s(),
            coefficient: &coefficient,
            tool_on: motion.tool_on(),
            machine,
            axes,
            grids: of_axes(&grids.grids(axes)),
            lever: of_axes(&plan::levers(machine, motion)),
            may_step: true,
            contact: Some(self.contact),
        };
        let job = Job { plan: &plan, settings: self.settings, origin: self.origin, grids };
        write(&job, controller)
    }
}

/// Returns the numbers of `list`, one for every axis, as an array.
fn of_axes<T: Copy, const N: usize>(list: &[T]) -> [T; N] {
    from_fn(|axis| list[axis])
}

/// Returns the clock and counts of the controller, with those of `settings` in place of the machine's. Refuses a
/// longest segment that is not positive.
fn grids(
    machine: &Machine,
    controller: ControllerKind,
    settings: &ProgramSettings,
) -> Result<ControllerModel, Invalid> {
    if let Some(step) = settings.max_step_s.filter(|s| !(s.is_finite() && *s > 0.0)) {
        return Err(Invalid::whole(
            "max_step_s",
            format!("is {step}"),
            "give a positive time in s",
        ));
    }
    let model = machine.controller_for(controller);
    model.with(settings.tick_s, &settings.counts, machine.axes())
}

fn write<const N: usize>(job: &Job<N>, controller: ControllerKind) -> Result<Program, Invalid> {
    let (text, mut about) = match controller {
        ControllerKind::Galil => galil::write(job),
        ControllerKind::Xps => xps::write(job),
        ControllerKind::Pmac => pmac::write(job),
        ControllerKind::Gcode => gcode::write(job),
        ControllerKind::Csv => csv::write(job),
        ControllerKind::Ros => ros::write(job),
        ControllerKind::Aerotech => aerotech::write(job),
        ControllerKind::Automation1 => automation1::write(job),
        ControllerKind::Sinumerik => sinumerik::write_lines(job),
        ControllerKind::SinumerikPoly => sinumerik::write_polynomials(job),
        ControllerKind::Twincat => twincat::write(job),
        ControllerKind::XpsPt => xps::write_pt(job),
        ControllerKind::Zaber => zaber::write(job),
    }?;
    let text = around::sealed(&text);
    about.program_blake3 = blake3::hash(text.as_bytes()).to_hex().to_string();
    if let Some(excerpt) = &mut about.excerpt {
        let settings = ProgramSettings { marks: None, ..job.settings.clone() };
        let whole = write(&Job { settings: &settings, ..*job }, controller)?.about;
        excerpt.from_line = whole.marks.line(excerpt.from_mark);
        excerpt.whole_blake3 = whole.program_blake3;
    }
    Ok(Program { text, about })
}

/// Inputs from which the module of a controller writes its program.
struct Job<'a, const N: usize> {
    plan: &'a AxesPlan<'a, N>,
    settings: &'a ProgramSettings,
    origin: &'a Origin,
    grids: ControllerModel,
}

/// Properties of a controller that decide about the nodes and the header.
struct Abilities {
    /// Largest number of ticks of a segment.
    most_ticks: i64,
    tool: Tool,
    approach: Approach,
}

/// Description of how the axes reach the start of the program.
enum Approach {
    /// The program moves there by itself; the text says how.
    InProgram(&'static str),
    /// The operator or the host moves there before; the text says how, and what happens otherwise.
    Before(&'static str),
}

/// Description of who switches the tool: the program, or the host. The text says how.
enum Tool {
    Switched(String),
    LeftToTheHost(&'static str),
}

impl<const N: usize> Job<'_, N> {
    /// Makes the nodes of the program within the abilities `can` of the controller, and the description for the file
    /// beside it. Refuses a plan that exceeds the limits, or of which the controller has no program within them and
    /// within its number of segments. Lines may change the dwell times by at most [`MOST_UNEVEN`].
    fn nodes(&self, can: Abilities) -> Result<(Nodes<N>, About), Invalid> {
        if self.plan.machine.name().trim().is_empty() {
            let problem = "has no name, and a program states the machine that it is for";
            return Err(Invalid::whole("machine", problem, "give it a `name` in its file"));
        }
        limits::check_plan(self.plan)?;
        let name = self.grids.kind.name();
        let follows_tool = matches!(can.tool, Tool::Switched(_));
        let (tool, warning) = self.tool(can.tool)?;
        let mut warnings: Vec<String> = warning.into_iter().collect();
        warnings.extend(self.lines_left_out());
        let tick_s = self.grids.tick_s;
        let (nodes, excerpt) = self.placed(can.most_ticks, follows_tool)?;
        let n = nodes.segments();
        if let Some(most) = self.grids.max_segments.filter(|most| n > *most) {
            let problem = format!("has {n} segments, the controller takes {most}");
            let remedy = "give a larger `path_deviation_mm`, or plan fewer lines in one run";
            return Err(Invalid::whole("program", problem, remedy));
        }
        let added_s = nodes.added_s;
        let (proof, reach) = limits::prove(&nodes, self.plan)?;
        let plan_s = self.plan.total_time_s();
        if added_s > WARNED_ADDED * plan_s {
            warnings.push(format!(
                "the program takes {:.3} s, {:.1} % longer than the plan: the plan asks for more than this controller \
                 can be told; simulate the program",
                plan_s + added_s,
                100.0 * added_s / plan_s
            ));
        }
        let mut preamble =
            preamble::sentences(self.plan, self.origin, (&proof, &reach), &can.approach);
        preamble.extend(around::handling(self.grids.kind, self.settings.pmac.buffer));
        preamble.extend(excerpt.as_ref().map(Excerpt::sentence));
        let about = About {
            controller: name,
            machine: self.plan.machine.name().into(),
            made_from: self.origin.made_from.clone(),
            made_by: self.origin.made_by.clone(),
            part_to_axes: self.origin.part_to_axes,
            dry_run: self.settings.dry_run,
            excerpt,
            part: None,
            prologue: self.lines().prologue.clone(),
            epilogue: self.lines().epilogue.clone(),
            tool_on_lines: self.lines().tool_on.clone(),
            tool_off_lines: self.lines().tool_off.clone(),
            was_on_axes: self.origin.was_on_axes,
            start_mm: self.of_x_and_y(nodes.position(0)),
            count_mm: self.of_x_and_y(nodes.count),
            axes: self.about_axes(&nodes, &reach),
            sample_s: None,
            tool,
            preamble,
            feedrate_time_unit_s: None,
            tick_s,
            segments: n,
            total_time_s: nodes.total_s(),
            buffer_segments: None,
            buffer_lasts_s: None,
            path_deviation_mm: nodes.deviation_mm,
            contact_deviation_mm: nodes.contact_mm,
            added_time_s: added_s,
            limits: proof,
            warnings,
            marks: Marks::default(),
            program_blake3: String::new(),
        };
        Ok((nodes, about))
    }

    /// Returns the nodes of the program, or of its part between two marks with run-up and run-down, and the place of
    /// that part. `most_ticks` is the longest segment of the controller; `follows_tool` is true if the program switches
    /// the tool. In a dry run the tool is off in every segment.
    fn placed(
        &self,
        most_ticks: i64,
        follows_tool: bool,
    ) -> Result<(Nodes<N>, Option<Excerpt>), Invalid> {
        let tick_s = self.grids.tick_s;
        // Fewer than one are a step that no segment is as short as; the generator refuses it.
        let longest_ticks = match self.settings.max_step_s {
            Some(step_s) => (step_s / tick_s).floor().min(most_ticks as f64) as i64,
            None => most_ticks,
        };
        if longest_ticks < 1 {
            let problem = format!("is shorter than one tick of {tick_s} s");
            let array = if most_ticks < 1 { "longest segment" } else { "max_step_s" };
            let remedy = "give a longer `max_step_s`, or a smaller tick";
            return Err(Invalid::whole(array, problem, remedy));
        }
        let settings = generate::GeneratorSettings {
            controller: self.grids,
            most_ticks: longest_ticks,
            path_deviation_mm: self.settings.path_deviation_mm,
            follows_tool,
        };
        let mut nodes = generate(self.plan, &settings)?;
        if nodes.interpolation == Interpolation::Linear && nodes.uneven > MOST_UNEVEN {
            return Err(self.too_uneven(&nodes));
        }
        let mut excerpt = None;
        if let Some(marks) = self.settings.marks {
            let least_s = self.grids.min_segment_s.max(self.plan.machine.limits().min_segment_s());
            // A hair less is the rounding of a number that was typed.
            let least_ticks = ((least_s / tick_s) * (1.0 - 1e-9)).ceil() as i64;
            let tolerance_mm = self.settings.gcode.path_tolerance_mm;
            let run_up = excerpt::RunUpLimits {
                ticks: [least_ticks.max(1), longest_ticks],
                tolerance_mm: tolerance_mm.unwrap_or(self.settings.path_deviation_mm),
            };
            let (inside, ramps) = excerpt::between(&nodes, self.plan, marks, &run_up)?;
            nodes = inside;
            excerpt = Some(excerpt_of(&nodes, marks, ramps));
        }
        if self.settings.dry_run {
            nodes.tool_on.fill(false);
        }
        Ok((nodes, excerpt))
    }

    /// Returns the error for lines that change the dwell times of the plan too much. It names finer counts and a finer
    /// clock, or asks for a plan with less acceleration if they are fine already.
    fn too_uneven(&self, nodes: &Nodes<N>) -> Invalid {
        let fine = self.grids.kind.model();
        let mut finer = Vec::new();
        for (is_rotary, name, own) in
            [(false, "count_mm", fine.linear[0].count), (true, "count_deg", fine.rotary[0].count)]
        {
            let counts = self.plan.grids.iter().zip(self.plan.axes);
            let mut counts = counts.filter(|(_, axis)| axis.is_rotary == is_rotary);
            if counts.any(|(grid, _)| grid.count > own) {
                finer.push(format!("`{name}` {}", decimal(own, 9)));
            }
        }
        if self.grids.tick_s > fine.tick_s {
            finer.push(format!("`tick_s` {}", decimal(fine.tick_s, 9)));
        }
        let problem = format!(
            "changes the dwell times of the plan by {:.2} % RMS over 4 mm of the path and takes {:.3} s longer: the plan \
             is at its acceleration limit, and lines on this clock and these counts are not",
            100.0 * nodes.uneven,
            nodes.added_s
        );
        let remedy = if finer.is_empty() {
            "plan with 5 % less max_acceleration_mm_per_s2 in the machine file".into()
        } else {
            let finer = finer.join(" and ");
            let why = match self.grids.kind {
                ControllerKind::Gcode => {
                    "LinuxCNC computes with the numbers of the program as they stand"
                }
                _ => {
                    "such a program states its numbers that finely, see the grids of the controller"
                }
            };
            format!("give {finer}: {why}")
        };
        Invalid::whole("program", problem, remedy)
    }

    /// Returns the sentence on the switching of the tool, and a warning if the tool stays on. Refuses a motion that
    /// lifts the tool if the program cannot switch it, unless the tool may stay on. Without a warning the second value
    /// is `None`.
    fn tool(&self, tool: Tool) -> Result<(String, Option<String>), Invalid> {
        if self.settings.dry_run {
            return Ok((
                "off throughout, because this is a dry run: nobody switches it on".into(),
                None,
            ));
        }
        let who = match tool {
            Tool::Switched(how) => return Ok((how, None)),
            Tool::LeftToTheHost(who) => who.to_string(),
        };
        if self.plan.tool_on.iter().all(|on| *on) {
            return Ok((who, None));
        }
        if !self.settings.always_on {
            let name = self.grids.kind.name();
            let problem = format!("is 0 somewhere; a {name} program cannot switch the tool");
            let remedy = "give `always_on` (the tool then removes there too), or use gcode, csv, or pmac with \
                          `tool_output`";
            return Err(Invalid::whole("tool_on", problem, remedy));
        }
        let warning = "the tool is on where the plan has it off: simulate the program";
        Ok((who, Some(warning.into())))
    }

    /// Returns the description of every axis, from its positions `reach` on the motion; empty in a program for x and y.
    fn about_axes(&self, nodes: &Nodes<N>, reach: &[[f64; 2]; N]) -> Vec<AboutAxis> {
        if !self.is_of_all_axes() {
            return Vec::new();
        }
        let start = nodes.position(0);
        let axes = self.plan.axes.iter().enumerate();
        axes.map(|(i, axis)| AboutAxis {
            name: axis.name,
            unit: axis.unit(),
            start: start[i],
            count: nodes.count[i],
            reach: reach[i],
        })
        .collect()
    }

    /// Returns the numbers of x and y; `None` in a program of all axes.
    fn of_x_and_y(&self, numbers: [f64; N]) -> Option<[f64; 2]> {
        <[f64; 2]>::try_from(&numbers[..]).ok().filter(|_| !self.is_of_all_axes())
    }

    /// Returns true if the motion was one of all axes (an [`AxesMotion`]).
    fn is_of_all_axes(&self) -> bool {
        self.plan.contact.is_some()
    }

    /// Returns true if the positions of the program are readings of the axes of the machine: the machine file states
    /// where the part lies, or the motion was on the axes. If false, they are positions on the part.
    fn is_on_machine(&self) -> bool {
        self.is_of_all_axes() || self.origin.was_on_axes || self.origin.part_to_axes.is_some()
    }

    /// Returns true if an axis is rotary.
    fn turns(&self) -> bool {
        self.plan.axes.iter().any(|axis| axis.is_rotary)
    }

    /// Returns a position as words of a program: the letter of every axis with its number, of at most `digits`
    /// decimals.
    fn words(&self, position: [f64; N], digits: usize) -> String {
        let axes = self.plan.axes.iter().zip(position);
        let words = axes.map(|(axis, p)| format!("{}{}", letter(axis), decimal(p, digits)));
        words.collect::<Vec<_>>().join(" ")
    }

    /// Returns the tick (clock of the program), s. Refuses one below 1e-9 s, which nine decimals of a second cannot
    /// hold.
    fn tick(&self) -> Result<f64, Invalid> {
        tick_s(&self.grids)
    }
}

/// Returns the place of the nodes between two marks, with these numbers of segments of run-up and run-down, in the whole
/// program, whose line and hash are not known yet.
fn excerpt_of<const N: usize>(nodes: &Nodes<N>, marks: [usize; 2], ramps: [usize; 2]) -> Excerpt {
    let n = nodes.segments();
    Excerpt {
        from_mark: marks[0],
        to_mark: marks[1],
        from_line: 0,
        whole_blake3: String::new(),
        run_up_segments: ramps[0],
        run_up_s: nodes.time_s(ramps[0]),
        run_down_segments: ramps[1],
        run_down_s: nodes.time_s(n) - nodes.time_s(n - ramps[1]),
    }
}

impl Excerpt {
    /// Returns the sentence for the operator on the marks, run-up and run-down.
    fn sentence(&self) -> String {
        let Self { run_up_segments, run_down_segments, .. } = self;
        format!(
            "from mark {} to mark {} of the whole program. The first {run_up_segments} segments, {} s, run up from rest, \
             and the last {run_down_segments}, {} s, run down to rest: tool off in both",
            self.from_mark,
            self.to_mark,
            decimal(self.run_up_s, 6),
            decimal(self.run_down_s, 6)
        )
    }
}

/// Returns the tick (clock of the program), s. Refuses one below 1e-9 s, which nine decimals of a second cannot hold.
fn tick_s(grids: &ControllerModel) -> Result<f64, Invalid> {
    const SMALLEST_S: f64 = 1e-9;
    let tick_s = positive("tick_s", grids.tick_s)?;
    if tick_s < SMALLEST_S {
        let problem = format!("is {tick_s}, a program has nine decimals of a second");
        return Err(Invalid::whole("tick_s", problem, "give a larger tick"));
    }
    Ok(tick_s)
}

/// Returns the letter of an axis in a PMAC or G-code program. A radius is X: neither language has an axis R.
fn letter(axis: &MachineAxis) -> &'static str {
    match axis.name {
        "x" | "r" => "X",
        "y" => "Y",
        "z" => "Z",
        "a" => "A",
        "b" => "B",
        _ => "C",
    }
}

/// Returns `v` with at most `digits` decimals, without zeros at the end; never "-0".
fn decimal(v: f64, digits: usize) -> String {
    let text = format!("{v:.digits$}");
    let text =
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".into() } else { text.into() }
}

/// Returns `v`; refuses it if it is not positive and finite. `name` is the setting in the message.
fn positive(name: &'static str, v: f64) -> Result<f64, Invalid> {
    if v.is_finite() && v > 0.0 {
        Ok(v)
    } else {
        Err(Invalid::whole(name, format!("is {v}"), "give a positive number"))
    }
}
