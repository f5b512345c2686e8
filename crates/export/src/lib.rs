//! A trajectory as the program of a motion controller.
//!
//! Every program goes the same way:
//!
//! 1. [`limits::check_plan`]: a motion that does not keep the limits of the machine is refused, and one that
//!    leaves the travel of its axes.
//! 2. [`table`]: the ends of the segments with their positions and velocities.
//! 3. [`mod@quantise`]: positions to whole counts and times to whole ticks, both rounded from the start
//!    of the motion, so that the remainder of one segment is carried into the next and nothing
//!    drifts.
//! 4. [`limits::prove`]: the rounded motion, as the controller executes it, keeps the limits but for
//!    what the rounding explains, and the program says how much that is.
//! 5. one module per controller: its limits, its text, how it switches the tool.
//!
//! | module | program | cubic between two lines | switches the tool |
//! |---|---|---|---|
//! | [`galil`] | Galil DMC, PVT mode | yes | no |
//! | [`xps`] | Newport XPS, PVT trajectory file | yes | no |
//! | [`pmac`] | Delta Tau / Omron PMAC, PVT mode | yes | by an M-variable that is named |
//! | [`gcode`] | G-code with inverse time or feed | no, straight | by digital output 0 |
//! | [`csv`] | table of the motion | yes | by a column |
//!
//! Only this crate and `planish-import` convert units.

pub mod csv;
pub mod galil;
pub mod gcode;
mod header;
pub mod limits;
pub mod pmac;
mod preamble;
pub mod quantise;
pub mod table;
pub mod xps;

use planish_types::{Invalid, Machine, Trajectory, TransformNumbers};
use serde::Serialize;

use crate::{
    limits::{Between, Proof},
    quantise::{Quanta, Quantised, quantise},
    table::Table,
};

/// Which controller, with its settings.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "controller", rename_all = "kebab-case")]
pub enum Controller {
    /// Galil DMC.
    Galil(galil::Settings),
    /// Newport XPS.
    Xps(xps::Settings),
    /// PMAC.
    Pmac(pmac::Settings),
    /// G-code.
    Gcode(gcode::Settings),
    /// Table.
    Csv(csv::Settings),
}

/// What every program is made with.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Common {
    /// Size of a count of (x, y), mm.
    pub count_mm: [f64; 2],
    /// Longest time between two lines, s: longer segments are split on their cubic. Absent: what the
    /// controller allows.
    pub max_step_s: Option<f64>,
    /// Whether a motion that lifts the tool may go to a controller whose program cannot switch it;
    /// the tool then stays on.
    pub always_on: bool,
}

/// What the header says besides the numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Origin {
    /// The trajectory: where it was, and its hash.
    pub made_from: String,
    /// What took the motion from the part to the axes, where they read other coordinates.
    pub part_to_axes: Option<TransformNumbers>,
    /// Whether the motion was in the coordinates of the machine before the export.
    pub was_on_axes: bool,
    /// Program that writes.
    pub made_by: String,
}

/// A program.
#[derive(Clone, Debug)]
pub struct Program {
    /// The text of the file.
    pub text: String,
    /// The same as its header, for programs; goes beside the file.
    pub about: About,
}

/// What a program is, for the file beside it.
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
    /// What took the motion from the part to the axes, where they read other coordinates: whoever reads the
    /// program back goes the other way.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub part_to_axes: Option<TransformNumbers>,
    /// Whether the motion was in the coordinates of the machine before the export.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub was_on_axes: bool,
    /// Where the axes (x, y) stand before the program, mm.
    pub start_mm: [f64; 2],
    /// Size of a count of (x, y), mm.
    pub count_mm: [f64; 2],
    /// Sample time, s, where the program counts samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sample_s: Option<f64>,
    /// How the tool is switched, or who has to.
    pub tool: String,
    /// What an operator is to know and to do before the program runs; at the head of it where it can have one.
    pub preamble: Vec<String>,
    /// Unit of time of the velocities of a PMAC, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub feedrate_time_unit_s: Option<f64>,
    /// What times are rounded to, s.
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
    /// Largest difference between a position and its counts, mm.
    pub rounding_mm: [f64; 2],
    /// Largest difference between a time and its ticks, s.
    pub rounding_s: f64,
    /// Of a program of straight lines, its largest distance from the plan at equal times, mm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_straight_mm: Option<f64>,
    /// What is proven of the motion that the controller executes.
    pub limits: Proof,
    /// What the user should know.
    pub warnings: Vec<String>,
    /// BLAKE3 of the bytes of the program: the reader refuses another program with this file.
    pub program_blake3: String,
}

/// Distance of straight lines from the plan at equal times that is worth a warning, mm: as far as corners are rounded.
const WARNED_FROM_STRAIGHT_MM: f64 = 0.02;

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
    let job = Job { trajectory, machine, common, origin };
    let (text, mut about) = match controller {
        Controller::Galil(settings) => galil::write(&job, settings),
        Controller::Xps(settings) => xps::write(&job, settings),
        Controller::Pmac(settings) => pmac::write(&job, settings),
        Controller::Gcode(settings) => gcode::write(&job, settings),
        Controller::Csv(settings) => csv::write(&job, settings),
    }?;
    about.program_blake3 = blake3::hash(text.as_bytes()).to_hex().to_string();
    Ok(Program { text, about })
}

/// What the modules of the controllers work on.
struct Job<'a> {
    trajectory: &'a Trajectory,
    machine: &'a Machine,
    common: &'a Common,
    origin: &'a Origin,
}

/// What a controller can do.
struct Abilities {
    controller: &'static str,
    /// What a time is rounded to, s.
    tick_s: f64,
    /// Ticks of a segment, least and most.
    ticks: [i64; 2],
    /// Unit of the velocity of (x, y), mm/s.
    velocity_mm_per_s: [f64; 2],
    between: Between,
    tool: Tool,
    approach: Approach,
}

/// How the axes come to where the program begins.
enum Approach {
    /// The program goes there by itself: how.
    InProgram(&'static str),
    /// Whoever runs it goes there before: how, and what happens otherwise.
    Before(&'static str),
}

/// Whether the program switches the tool, and how, or who has to.
enum Tool {
    Switched(String),
    LeftToTheHost(&'static str),
}

impl Job<'_> {
    /// The table in counts and ticks, within the abilities of the controller.
    fn quantised(&self, can: Abilities) -> Result<(Quantised, About), Invalid> {
        limits::check_plan(self.trajectory, self.machine)?;
        self.trajectory.check_rate_is_constant()?;
        let mut warnings = Vec::new();
        let tool = match can.tool {
            Tool::Switched(how) => how,
            Tool::LeftToTheHost(who) => {
                if self.trajectory.tool_on().iter().any(|on| !on) {
                    if !self.common.always_on {
                        let problem = format!(
                            "is 0 somewhere; a {} program cannot switch the tool",
                            can.controller
                        );
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
        // A segment that is rounded up by a tick must still fit.
        let longest = (can.ticks[1] - 1) as f64 * can.tick_s;
        let (step_s, remedy) = match self.common.max_step_s {
            Some(step_s) if step_s < longest => (step_s, "give a longer `max_step_s`"),
            _ => (longest, "give a larger tick"),
        };
        let table = Table::of(self.trajectory, step_s, remedy)?;
        let quanta = Quanta {
            count_mm: self.common.count_mm,
            tick_s: can.tick_s,
            velocity_mm_per_s: can.velocity_mm_per_s,
        };
        let q = quantise(&table, &quanta, can.ticks)?;
        let proof = limits::prove(&q, self.machine.limits(), can.between)?;
        warnings
            .extend(proof.largest.iter().filter(|p| p.excess > 0.0).map(limits::Peak::sentence));
        let from_straight_mm = (can.between == Between::Straight).then_some(table.from_straight_mm);
        if let Some(mm) = from_straight_mm.filter(|mm| *mm > WARNED_FROM_STRAIGHT_MM) {
            warnings.push(format!(
                "straight lines in the plan's times are up to {mm:.3} mm from where the plan is then: give a shorter \
                 `max_step_s`, or simulate the program"
            ));
        }
        let n = q.ticks.len() - 1;
        let about = About {
            controller: can.controller,
            machine: self.machine.name().into(),
            made_from: self.origin.made_from.clone(),
            made_by: self.origin.made_by.clone(),
            part_to_axes: self.origin.part_to_axes,
            was_on_axes: self.origin.was_on_axes,
            start_mm: q.position_mm(0),
            count_mm: self.common.count_mm,
            sample_s: None,
            tool,
            preamble: preamble::sentences(&q, self.machine, self.origin, &proof, &can.approach),
            feedrate_time_unit_s: None,
            tick_s: can.tick_s,
            segments: n,
            total_time_s: q.time_s(n),
            buffer_segments: None,
            buffer_lasts_s: None,
            rounding_mm: q.rounding_mm,
            rounding_s: q.rounding_s,
            from_straight_mm,
            limits: proof,
            warnings,
            program_blake3: String::new(),
        };
        Ok((q, about))
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

/// A tick that the nine decimals of a time in s can hold.
fn tick(tick_s: f64) -> Result<f64, Invalid> {
    const SMALLEST_S: f64 = 1e-9;
    match positive("tick_s", tick_s)? {
        tick_s if tick_s >= SMALLEST_S => Ok(tick_s),
        _ => {
            let problem = format!("is {tick_s}, a program has nine decimals of a second");
            Err(Invalid::whole("tick_s", problem, "give a larger tick"))
        }
    }
}
