//! PMAC, PVT mode: `PVT<t>` in ms, then `X<p>:<v> Y<p>:<v>` with the absolute position in mm and the velocity at the
//! end in mm per feedrate time unit (Isx90). Further axes are Z, A, B and C, the rotary ones in degrees; a radius is X.
//!
//! A segment takes up to 4095.9998 ms (Turbo PMAC, I42 = 0) in steps of the tick: 1 ms on a PMAC, down
//! to 1/4 us on a Turbo PMAC. Absolute positions do not drift whatever the controller rounds.
//!
//! The tool: with `tool_output` an M-variable that the controller maps to its output (M1 to M8 are outputs
//! in the suggested definitions). `M1==1` takes effect with the start of the next move, `M1=0` when the
//! line is read, which is one or two moves early within a motion; so `=` stands before the first move
//! only, and `==` before the first move of every change. A `==` after the last move is not executed
//! unless a DWELL follows it: the program ends with `M1==0` and `DWELL0`. `A`, `K` and a fatal following
//! error end the program without executing what is queued and leave the output as it is: a PLC program of
//! the controller has to switch it off when no motion program runs. Without `tool_output` the host
//! switches, and a motion that lifts the tool is refused.
//!
//! The start: positions are absolute, so from elsewhere the first segment would be a leap. A program that switches the
//! tool goes to the start by itself (`RAPID`, each axis at its own speed, then `DWELL0`, so that the first segment
//! begins from rest); without `tool_output` the host, which has to know when the motion begins, goes there before.
//!
//! The buffer: the lines are those of a motion program, which a host puts into a buffer. With [`PmacBuffer`] the text
//! opens it itself: `OPEN PROG n CLEAR` to `CLOSE`, or `OPEN ROT` to `CLOSE`. A rotary buffer takes lines while it runs,
//! so that parts join without a stop; it takes no loops.
//!
//! Source: Turbo PMAC software reference, OPEN PROGRAM, OPEN ROTARY, CLEAR, program commands PVT{data}, {axis}{data}:{data},
//! M{data}=={expression}, M{data}={expression}, RAPID, DWELL; Turbo PMAC user manual, Synchronous M-Variable
//! Assignment (with its note on the last move). Neither states a length of a line; 80 characters are those
//! of a terminal.

use planish_types::{ControllerLines, ControllerModel, Invalid};

use crate::{
    Abilities, About, Approach, Job, Tool, decimal, header::Comment, letter, positive, tick_s,
};

/// Longest segment, s. A fact of the controller: longer segments are refused.
const LONGEST_S: f64 = 4.095_999_8;

/// Resolution of a time on a Turbo PMAC, s. A fact of the controller: smaller ticks are refused.
const RESOLUTION_S: f64 = 2.5e-7;

/// Largest number of an M-variable, a fact of the controller.
const LAST_M_VARIABLE: u32 = 8191;

pub(crate) const COMMENT: Comment = Comment { open: "; ", close: "", line: 80 };

/// Number of decimals of a position in mm, and of a velocity in mm/s. Larger: longer lines. Smaller: rounding that
/// the controller may notice. Chosen: counts below 1e-9 mm are refused.
const DIGITS: usize = 9;

/// Settings of a motion program.
#[derive(Clone, Debug, PartialEq)]
pub struct PmacSettings {
    /// Unit of time of the velocities, s: the variable Isx90, which is in ms, over 1000.
    pub feedrate_time_unit_s: f64,
    /// Number of the M-variable that switches the tool, 1 being on; `None` if the program does not switch it.
    pub tool_output: Option<u32>,
    /// Buffer of the controller into which the text loads the program.
    pub buffer: PmacBuffer,
}

/// Buffer of the controller into which the text of a program loads it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PmacBuffer {
    /// The text has the lines of the program only, for a host that opens a buffer.
    OfTheHost,
    /// Fixed motion program of this number: `OPEN PROG n CLEAR` to `CLOSE`.
    Program(u32),
    /// Rotary buffer of this coordinate system, which takes lines while it runs: `OPEN ROT` to `CLOSE`.
    Rotary(u32),
}

/// Largest numbers of a motion program and of a coordinate system, facts of the controller (Turbo PMAC software
/// reference, OPEN PROGRAM; user manual, 16 rotary buffers).
const LAST_PROGRAM: u32 = 32767;
const LAST_COORDINATE_SYSTEM: u32 = 16;

impl PmacBuffer {
    /// Returns the lines that open the buffer.
    pub(crate) fn opening(self) -> String {
        match self {
            Self::OfTheHost => String::new(),
            Self::Program(n) => format!("CLOSE\nOPEN PROG {n} CLEAR\n"),
            Self::Rotary(n) => format!("CLOSE\n&{n}\nOPEN ROT\n"),
        }
    }

    /// Refuses numbers that the controller does not have, and lines of the machine file that wait in a loop, which a
    /// rotary buffer does not take.
    fn check(self, lines: &ControllerLines) -> Result<(), Invalid> {
        let (name, number, last) = match self {
            Self::OfTheHost => return Ok(()),
            Self::Program(n) => ("open_program", n, LAST_PROGRAM),
            Self::Rotary(n) => ("rotary", n, LAST_COORDINATE_SYSTEM),
        };
        if number < 1 || number > last {
            let problem = format!("is {number}");
            return Err(Invalid::whole(name, problem, format!("give a number from 1 to {last}")));
        }
        let mut around = lines.prologue.iter().chain(&lines.epilogue);
        if matches!(self, Self::Rotary(_))
            && around.any(|line| line.to_uppercase().contains("WHILE"))
        {
            let problem = "is asked for, and the machine file states a line with WHILE";
            let remedy = "wait by the host: a rotary buffer takes no loops";
            return Err(Invalid::whole(name, problem, remedy));
        }
        Ok(())
    }
}

impl Default for PmacSettings {
    fn default() -> Self {
        Self { feedrate_time_unit_s: 1.0, tool_output: None, buffer: PmacBuffer::OfTheHost }
    }
}

/// Returns the tick in s, the unit of time of the velocities in s, and the largest number of ticks of a segment.
/// Refuses settings that no PMAC has. Also refuses a missing M-variable if the machine file says that the controller
/// switches the tool.
pub(crate) fn checked(
    grids: &ControllerModel,
    settings: &PmacSettings,
) -> Result<[f64; 3], Invalid> {
    let tick_s = tick_s(grids)?;
    let unit_s = positive("feedrate_time_unit_s", settings.feedrate_time_unit_s)?;
    let most = (LONGEST_S / tick_s).floor();
    // A little less is the rounding of a number that was typed.
    if tick_s < RESOLUTION_S * (1.0 - 1e-9) {
        let problem = format!("is {tick_s}, a Turbo PMAC resolves {RESOLUTION_S} s");
        return Err(Invalid::whole("tick_s", problem, "give a larger tick"));
    }
    if !(1e-6..=1e6).contains(&unit_s) {
        let problem = format!("is {unit_s}; Isx90 is in ms, 1000 for velocities in mm/s");
        return Err(Invalid::whole("feedrate_time_unit_s", problem, "give Isx90 / 1000"));
    }
    if let Some(m) = settings.tool_output.filter(|m| *m > LAST_M_VARIABLE) {
        let problem = format!("is M{m}, the last M-variable is M{LAST_M_VARIABLE}");
        return Err(Invalid::whole("tool_output", problem, "give the M-variable of the output"));
    }
    if most < 2.0 {
        let problem = format!("is {tick_s}, a segment takes {LONGEST_S} s at most");
        return Err(Invalid::whole("tick_s", problem, "give a smaller tick"));
    }
    if grids.switches_tool && settings.tool_output.is_none() {
        let problem =
            "is not given, and the machine file says that the controller switches the tool";
        return Err(Invalid::whole("tool_output", problem, "give the M-variable of the output"));
    }
    Ok([tick_s, unit_s, most])
}

/// Refuses a buffer that the controller does not have, and lines of the machine file that do not go with the settings:
/// loops in a rotary buffer, and lines that assign the M-variable of the tool.
pub(crate) fn check_lines(lines: &ControllerLines, settings: &PmacSettings) -> Result<(), Invalid> {
    settings.buffer.check(lines)?;
    let Some(m) = settings.tool_output else { return Ok(()) };
    let assigns = |line: &String| {
        let line = line.to_uppercase().replace(' ', "");
        line.strip_prefix('M')
            .and_then(|l| l.split_once('='))
            .is_some_and(|(n, _)| n.parse() == Ok(m))
    };
    match lines.prologue.iter().chain(&lines.epilogue).find(|line| assigns(line)) {
        None => Ok(()),
        Some(line) => {
            let problem = format!("is M{m}, and the machine file states the line {line:?}");
            let remedy = "take the line out of the machine file: the program switches the tool";
            Err(Invalid::whole("tool_output", problem, remedy))
        }
    }
}

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let settings = &job.settings.pmac;
    let [tick_s, unit_s, most] = checked(&job.grids, settings)?;
    check_lines(job.lines(), settings)?;
    let tool = match settings.tool_output {
        None => Tool::LeftToTheHost(
            "this program does not switch it, --tool-output names an M-variable that does: the host \
             switches it on and off, and off on every stop",
        ),
        Some(m) => Tool::Switched(format!(
            "M{m}==1 switches it on and M{m}==0 off with the start of the next move, off on the way to the start and \
             at the end. On an abort it stays as it is, a PLC program has to switch it off when no program runs"
        )),
    };
    let approach = match settings.tool_output {
        Some(_) => Approach::InProgram(
            "the way from where the axes stand to the start is free: the program goes there by RAPID, each axis at \
             its own speed, not in a straight line",
        ),
        None => Approach::Before(
            "go to the start, tool off: positions are absolute, from elsewhere the first segment is a leap",
        ),
    };
    let (q, mut about) = job.nodes(Abilities { most_ticks: most as i64, tool, approach })?;
    about.feedrate_time_unit_s = Some(unit_s);
    let resolutions = tick_s / RESOLUTION_S;
    if (resolutions - resolutions.round()).abs() > 1e-6 * resolutions {
        about.warnings.push(format!(
            "a tick of {tick_s} s is no multiple of {RESOLUTION_S} s, to which a Turbo PMAC rounds every segment"
        ));
    }
    let lengths = if job.turns() { "mm or deg" } else { "mm" };
    let units = format!(
        "{lengths}, {lengths} per {unit_s} s with Isx90 = {}, ms",
        decimal(unit_s * 1e3, 6)
    );
    // A velocity per millisecond needs three more.
    let more = (-unit_s.log10()).ceil().clamp(0.0, 9.0) as usize;
    let mut text = about.header(&COMMENT, &units);
    let opening = settings.buffer.opening();
    text += &opening;
    let switch = |on: bool, how: &str| {
        let output = settings.tool_output.map(|m| format!("M{m}{how}{}\n", u8::from(on)));
        output.unwrap_or_default()
    };
    text += &switch(false, "=");
    text += &job.prologue();
    text += "ABS\n";
    if settings.tool_output.is_some() {
        text += &format!("RAPID\n{}\nDWELL0\n", job.words(q.position(0), DIGITS));
    }
    let mut on = false;
    for k in 0..about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        if q.tool_on[k] != on {
            on = q.tool_on[k];
            text += &switch(on, "==");
        }
        let states = q.position(k + 1).into_iter().zip(q.velocity[k + 1]);
        let words = job.plan.axes.iter().zip(states).map(|(axis, (p, v))| {
            let v = decimal(v * unit_s, DIGITS + more);
            format!("{}{}:{v}", letter(axis), decimal(p, DIGITS))
        });
        text += &format!(
            "PVT{}\n{}\n",
            decimal(q.duration(k) as f64 * tick_s * 1e3, 6),
            words.collect::<Vec<_>>().join(" ")
        );
    }
    if settings.tool_output.is_some() {
        text += &switch(false, "==");
        // Executes the line before it.
        text += "DWELL0\n";
    }
    text += &job.epilogue();
    if !opening.is_empty() {
        text += "CLOSE\n";
    }
    Ok((text, about))
}
