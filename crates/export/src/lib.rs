//! A trajectory as the program of a motion controller.
//!
//! Every program goes the same way:
//!
//! 1. [`table`]: the ends of the segments with their positions and velocities. A PVT program has one
//!    position and one velocity per end; a motion that has two there is refused.
//! 2. [`mod@quantise`]: positions to whole counts and times to whole ticks, both rounded from the start
//!    of the motion, so that the remainder of one segment is carried into the next and nothing
//!    drifts.
//! 3. one module per controller: its limits, its text.
//!
//! | module | program | cubic between two lines |
//! |---|---|---|
//! | [`galil`] | Galil DMC, PVT mode | yes |
//! | [`xps`] | Newport XPS, PVT trajectory file | yes |
//! | [`pmac`] | Delta Tau / Omron PMAC, PVT mode | yes |
//! | [`gcode`] | G-code with inverse time or feed | no, straight |
//! | [`csv`] | table of the motion | yes |
//!
//! Only this crate and `planish-import` convert units.

pub mod csv;
pub mod galil;
pub mod gcode;
pub mod pmac;
pub mod quantise;
pub mod table;
pub mod xps;

use planish_types::{Invalid, Limits, Trajectory};
use serde::Serialize;

use crate::{
    quantise::{Quanta, Quantised, quantise},
    table::{Ends, Table},
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
#[derive(Clone, Debug, PartialEq)]
pub struct Origin {
    /// The trajectory: where it was, and its hash.
    pub made_from: String,
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
    /// Where the axes (x, y) stand before the program, mm.
    pub start_mm: [f64; 2],
    /// Size of a count of (x, y), mm.
    pub count_mm: [f64; 2],
    /// Sample time, s, where the program counts samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sample_s: Option<f64>,
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
    /// What the user should know.
    pub warnings: Vec<String>,
}

/// Writes the program of `trajectory` for `controller` on `machine`.
pub fn program(
    trajectory: &Trajectory,
    machine: &Limits,
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
    match controller {
        Controller::Galil(settings) => galil::write(&job, settings),
        Controller::Xps(settings) => xps::write(&job, settings),
        Controller::Pmac(settings) => pmac::write(&job, settings),
        Controller::Gcode(settings) => gcode::write(&job, settings),
        Controller::Csv(settings) => csv::write(&job, settings),
    }
}

/// What the modules of the controllers work on.
struct Job<'a> {
    trajectory: &'a Trajectory,
    machine: &'a Limits,
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
    ends: Ends,
    /// Whether the program can switch the tool.
    switches_tool: bool,
    /// Whether it must start and end at rest.
    from_rest: bool,
}

impl Job<'_> {
    /// The table in counts and ticks, within the abilities of the controller.
    fn quantised(&self, can: &Abilities) -> Result<(Quantised, About), Invalid> {
        let tick_s = positive("tick_s", can.tick_s)?;
        // A segment that is rounded up by a tick must still fit.
        let longest = (can.ticks[1] - 1) as f64 * tick_s;
        let step_s = self.common.max_step_s.map_or(longest, |s| s.min(longest));
        let table = Table::of(self.trajectory, step_s, can.ends)?;
        let mut warnings = Vec::new();
        if !can.switches_tool && table.tool_on.iter().any(|on| !on) {
            if !self.common.always_on {
                return Err(Invalid::whole(
                    "tool_on",
                    format!("is 0 somewhere; a {} program cannot switch the tool", can.controller),
                    "give --always-on (the tool then removes there too), or use gcode or csv",
                ));
            }
            warnings.push("the tool is on where the plan has it off: simulate the program".into());
        }
        if can.from_rest {
            table.check_rest()?;
        }
        let quanta = Quanta { count_mm: self.common.count_mm, tick_s };
        let q = quantise(&table, &quanta, can.ticks)?;
        self.check_machine(&q)?;
        let n = q.ticks.len() - 1;
        let about = About {
            controller: can.controller,
            machine: self.machine.name.clone(),
            made_from: self.origin.made_from.clone(),
            made_by: self.origin.made_by.clone(),
            start_mm: q.position_mm(0),
            count_mm: self.common.count_mm,
            sample_s: None,
            feedrate_time_unit_s: None,
            tick_s,
            segments: n,
            total_time_s: q.time_s(n),
            buffer_segments: None,
            buffer_lasts_s: None,
            rounding_mm: q.rounding_mm,
            rounding_s: q.rounding_s,
            warnings,
        };
        Ok((q, about))
    }

    fn check_machine(&self, q: &Quantised) -> Result<(), Invalid> {
        let least = self.machine.min_segment_s;
        for i in 0..q.ticks.len() - 1 {
            let lasts = q.time_s(i + 1) - q.time_s(i);
            // Half a tick is lost or won at both ends.
            if lasts < least - q.quanta.tick_s {
                let problem = format!("lasts {lasts} s, the machine wants {least} s at least");
                return Err(Invalid::at("segment", i, problem, "plan longer dwell times"));
            }
            for (axis, limits) in self.machine.axes.iter().enumerate() {
                let v = q.velocity_mm_per_s[i + 1][axis].abs();
                // What is more than rounding.
                if v > limits.max_velocity_mm_per_s * (1.0 + 1e-6) {
                    let problem = format!(
                        "ends with {v} mm/s along {}, the machine does {}",
                        limits.name, limits.max_velocity_mm_per_s
                    );
                    return Err(Invalid::at("segment", i, problem, "schedule for this machine"));
                }
            }
        }
        Ok(())
    }
}

impl About {
    /// The lines of a header.
    fn header(&self, units: &str) -> Vec<String> {
        let [x, y] = self.start_mm;
        let mut lines = vec![
            format!("{} for {}, written by {}", self.controller, self.machine, self.made_by),
            format!("made from: {}", self.made_from),
            format!("units: {units}"),
            format!("start: x {} mm, y {} mm", decimal(x, 9), decimal(y, 9)),
            format!("{} segments, total time {} s", self.segments, decimal(self.total_time_s, 9)),
        ];
        if let (Some(segments), Some(s)) = (self.buffer_segments, self.buffer_lasts_s) {
            lines.push(format!(
                "buffer: {segments} segments, which last {} s at least: the host adds lines faster",
                decimal(s, 6)
            ));
        }
        lines.extend(self.warnings.iter().map(|w| format!("warning: {w}")));
        // A comment is one line of plain text in every controller; brackets end it in G-code.
        let plain = |c: char| if (' '..='~').contains(&c) && !"()".contains(c) { c } else { '_' };
        lines.into_iter().map(|l| l.chars().map(plain).collect()).collect()
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
