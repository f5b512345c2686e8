//! A trajectory as the program of a motion controller.
//!
//! Every program goes the same way:
//!
//! 1. [`limits::check_plan`]: a motion that does not keep the limits of the machine is refused, and one that
//!    leaves the travel of its axes.
//! 2. [`mod@generate`]: nodes on the clock and in the counts of the controller. The motion between them keeps the limits
//!    of the machine and a stated distance from the path of the plan.
//! 3. [`limits::prove`]: the motion that the controller executes keeps the limits on the whole of every segment.
//! 4. one module per controller: its limits, its text, how it switches the tool.
//!
//! | module | program | cubic between two lines | switches the tool |
//! |---|---|---|---|
//! | `galil` | Galil DMC, PVT mode | yes | no |
//! | `xps` | Newport XPS, PVT trajectory file | yes | no |
//! | [`pmac`] | Delta Tau / Omron PMAC, PVT mode | yes | by an M-variable that is named |
//! | [`gcode`] | G-code with inverse time or feed | no, lines that are joined | by digital output 0 |
//! | `csv` | table of the motion | yes | by a column |
//!
//! Only this crate and `planish-import` convert units.

mod csv;
mod galil;
pub mod gcode;
pub mod generate;
mod header;
pub mod limits;
mod nodes;
pub mod pmac;
mod preamble;
mod slowed;
mod velocities;
mod xps;

use planish_types::{
    ControllerKind, ControllerModel, Invalid, Machine, Trajectory, TransformNumbers,
};
use serde::Serialize;

use crate::{
    generate::{Nodes, generate},
    limits::Proof,
};

/// Controller with its settings.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "controller", rename_all = "kebab-case")]
pub enum Controller {
    /// Galil DMC.
    Galil,
    /// Newport XPS.
    Xps,
    /// PMAC.
    Pmac(pmac::Settings),
    /// G-code.
    Gcode(gcode::Settings),
    /// Table.
    Csv,
}

impl Controller {
    /// The kind, by which a machine file states the grids of the controller.
    pub fn kind(&self) -> ControllerKind {
        match self {
            Self::Galil => ControllerKind::Galil,
            Self::Xps => ControllerKind::Xps,
            Self::Pmac(_) => ControllerKind::Pmac,
            Self::Gcode(_) => ControllerKind::Gcode,
            Self::Csv => ControllerKind::Csv,
        }
    }
}

/// Settings of every program.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Common {
    /// Size of a count of (x, y), mm. Absent: that of the machine's controller.
    pub count_mm: Option<[f64; 2]>,
    /// Clock, s. Absent: that of the machine's controller.
    pub tick_s: Option<f64>,
    /// Longest segment, s. Absent: what the controller allows.
    pub max_step_s: Option<f64>,
    /// Largest distance of the program's path from the plan's, mm. Smaller: more segments.
    pub path_deviation_mm: f64,
    /// True if a motion that lifts the tool may go to a controller whose program cannot switch it; the tool then
    /// stays on.
    pub always_on: bool,
}

/// Default of the largest distance of the program's path from the plan's, mm. Larger: fewer segments, and a removal
/// that differs more. Smaller: more segments. Chosen: a hundredth of the pixels of a fine map.
pub const PATH_DEVIATION_MM: f64 = 0.005;

impl Default for Common {
    fn default() -> Self {
        Self {
            count_mm: None,
            tick_s: None,
            max_step_s: None,
            path_deviation_mm: PATH_DEVIATION_MM,
            always_on: false,
        }
    }
}

/// Origin of a program, for its header.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Origin {
    /// The trajectory: where it was, and its hash.
    pub made_from: String,
    /// Transform of the motion from the part to the axes, where they read other coordinates.
    pub part_to_axes: Option<TransformNumbers>,
    /// True if the motion was in the coordinates of the machine before the export.
    pub was_on_axes: bool,
    /// Program that writes.
    pub made_by: String,
}

/// A program.
#[derive(Clone, Debug)]
pub struct Program {
    /// The text of the file.
    pub text: String,
    /// Content of the header, for the file beside the program.
    pub about: About,
}

/// Description of a program, for the file beside it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct About {
    /// Controller.
    pub controller: &'static str,
    /// Name of the machine.
    pub machine: String,
    /// The trajectory.
    pub made_from: String,
    /// Program that wrote it.
    pub made_by: String,
    /// Transform of the motion from the part to the axes, where they read other coordinates. A reader of the program
    /// applies its inverse.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub part_to_axes: Option<TransformNumbers>,
    /// True if the motion was in the coordinates of the machine before the export.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub was_on_axes: bool,
    /// Position of the axes (x, y) before the program, mm.
    pub start_mm: [f64; 2],
    /// Size of a count of (x, y), mm.
    pub count_mm: [f64; 2],
    /// Sample time, s, where the program counts samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sample_s: Option<f64>,
    /// Sentence on the switching of the tool: by the program, or by the host.
    pub tool: String,
    /// Sentences for the operator before the program runs; at the head of a program that can have comments.
    pub preamble: Vec<String>,
    /// Unit of time of the velocities of a PMAC, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub feedrate_time_unit_s: Option<f64>,
    /// Clock to which times are rounded, s.
    pub tick_s: f64,
    /// Segments of the program.
    pub segments: usize,
    /// Total time, s.
    pub total_time_s: f64,
    /// Segments that the controller's buffer holds, where it is small.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub buffer_segments: Option<usize>,
    /// The least time that a full buffer lasts, s: the host must add lines faster than that.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub buffer_lasts_s: Option<f64>,
    /// Largest distance of the executed path from the plan's, mm.
    pub path_deviation_mm: f64,
    /// Time that the program takes longer than the plan, s.
    pub added_time_s: f64,
    /// Proof for the motion that the controller executes.
    pub limits: Proof,
    /// Warnings for the user.
    pub warnings: Vec<String>,
    /// BLAKE3 of the bytes of the program: the reader refuses another program with this file.
    pub program_blake3: String,
}

/// Largest time that a program may add without a warning, over the time of the plan. Larger: slower programs without
/// a warning. Smaller: warnings for what rounding adds. Chosen: a plan that needs more was made for other limits.
const WARNED_ADDED: f64 = 0.03;

/// Writes the program of `trajectory`, in the coordinates of the axes, for `controller` on `machine`.
pub fn program(
    trajectory: &Trajectory,
    machine: &Machine,
    controller: &Controller,
    common: &Common,
    origin: &Origin,
) -> Result<Program, Invalid> {
    if let Some(step) = common.max_step_s.filter(|s| !(s.is_finite() && *s > 0.0)) {
        return Err(Invalid::whole(
            "max_step_s",
            format!("is {step}"),
            "give a positive time in s",
        ));
    }
    let grids = machine.controller_for(controller.kind()).with(common.tick_s, common.count_mm)?;
    let job = Job { trajectory, machine, common, origin, grids };
    let (text, mut about) = match controller {
        Controller::Galil => galil::write(&job),
        Controller::Xps => xps::write(&job),
        Controller::Pmac(settings) => pmac::write(&job, settings),
        Controller::Gcode(settings) => gcode::write(&job, settings),
        Controller::Csv => csv::write(&job),
    }?;
    about.program_blake3 = blake3::hash(text.as_bytes()).to_hex().to_string();
    Ok(Program { text, about })
}

/// Inputs of the modules of the controllers.
struct Job<'a> {
    trajectory: &'a Trajectory,
    machine: &'a Machine,
    common: &'a Common,
    origin: &'a Origin,
    grids: ControllerModel,
}

/// Abilities of a controller.
struct Abilities {
    /// Most ticks of a segment.
    most_ticks: i64,
    tool: Tool,
    approach: Approach,
}

/// Way of the axes to the start of the program.
enum Approach {
    /// The program goes there by itself: how.
    InProgram(&'static str),
    /// Whoever runs it goes there before: how, and what happens otherwise.
    Before(&'static str),
}

/// Switching of the tool: by the program, or by the host.
enum Tool {
    Switched(String),
    LeftToTheHost(&'static str),
}

impl Job<'_> {
    /// The nodes of the program, within the abilities of the controller.
    fn nodes(&self, can: Abilities) -> Result<(Nodes, About), Invalid> {
        limits::check_plan(self.trajectory, self.machine)?;
        self.trajectory.check_rate_is_constant()?;
        let name = self.grids.kind.name();
        let mut warnings = Vec::new();
        let follows_tool = matches!(can.tool, Tool::Switched(_));
        let tool = match can.tool {
            Tool::Switched(how) => how,
            Tool::LeftToTheHost(who) => {
                if self.trajectory.tool_on().iter().any(|on| !on) {
                    if !self.common.always_on {
                        let problem =
                            format!("is 0 somewhere; a {name} program cannot switch the tool");
                        let remedy = "give `always_on` (the tool then removes there too), or use gcode, csv, \
                                      or pmac with `tool_output`";
                        return Err(Invalid::whole("tool_on", problem, remedy));
                    }
                    warnings.push(
                        "the tool is on where the plan has it off: simulate the program".into(),
                    );
                }
                who.into()
            }
        };
        let tick_s = self.grids.tick_s;
        // Fewer than one are a step that no segment is as short as; the generator refuses it.
        let most_ticks = match self.common.max_step_s {
            Some(step_s) => (step_s / tick_s).floor().min(can.most_ticks as f64) as i64,
            None => can.most_ticks,
        };
        if most_ticks < 1 {
            let problem = format!("is shorter than one tick of {tick_s} s");
            let array = if can.most_ticks < 1 { "longest segment" } else { "max_step_s" };
            let remedy = "give a longer `max_step_s`, or a smaller tick";
            return Err(Invalid::whole(array, problem, remedy));
        }
        let settings = generate::Settings {
            controller: self.grids,
            most_ticks,
            path_deviation_mm: self.common.path_deviation_mm,
            follows_tool,
        };
        let nodes = generate(self.trajectory, self.machine, &settings)?;
        let n = nodes.segments();
        if let Some(most) = self.grids.max_segments.filter(|most| n > *most) {
            let problem = format!("has {n} segments, the controller takes {most}");
            let remedy = "give a larger `path_deviation_mm`, or plan fewer lines in one run";
            return Err(Invalid::whole("program", problem, remedy));
        }
        let proof = limits::prove(&nodes, self.machine)?;
        let plan_s = self.trajectory.total_time_s();
        if nodes.added_s > WARNED_ADDED * plan_s {
            warnings.push(format!(
                "the program takes {:.3} s, {:.1} % longer than the plan: the plan asks for more than this controller \
                 can be told; simulate the program",
                nodes.time_s(n),
                100.0 * nodes.added_s / plan_s
            ));
        }
        let about = About {
            controller: name,
            machine: self.machine.name().into(),
            made_from: self.origin.made_from.clone(),
            made_by: self.origin.made_by.clone(),
            part_to_axes: self.origin.part_to_axes,
            was_on_axes: self.origin.was_on_axes,
            start_mm: nodes.position_mm(0),
            count_mm: self.grids.count_mm,
            sample_s: None,
            tool,
            preamble: preamble::sentences(self.machine, self.origin, &proof, &can.approach),
            feedrate_time_unit_s: None,
            tick_s,
            segments: n,
            total_time_s: nodes.time_s(n),
            buffer_segments: None,
            buffer_lasts_s: None,
            path_deviation_mm: nodes.deviation_mm,
            added_time_s: nodes.added_s,
            limits: proof,
            warnings,
            program_blake3: String::new(),
        };
        Ok((nodes, about))
    }

    /// The tick, where a text with nine decimals of a second can hold it.
    fn tick(&self) -> Result<f64, Invalid> {
        const SMALLEST_S: f64 = 1e-9;
        let tick_s = positive("tick_s", self.grids.tick_s)?;
        if tick_s < SMALLEST_S {
            let problem = format!("is {tick_s}, a program has nine decimals of a second");
            return Err(Invalid::whole("tick_s", problem, "give a larger tick"));
        }
        Ok(tick_s)
    }
}

/// `v` with at most `digits` decimals, without zeros at the end; never "-0".
fn decimal(v: f64, digits: usize) -> String {
    let text = format!("{v:.digits$}");
    let text =
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".into() } else { text.into() }
}

fn positive(name: &'static str, v: f64) -> Result<f64, Invalid> {
    if v.is_finite() && v > 0.0 {
        Ok(v)
    } else {
        Err(Invalid::whole(name, format!("is {v}"), "give a positive number"))
    }
}
