//! PMAC, PVT mode: `PVT<t>` sets the time of the segments that follow, in ms; `X<p>:<v> Y<p>:<v>` is
//! a segment to a position (`ABS`) or by a distance (`INC`) with the velocity at its end, in mm per
//! feedrate time unit. A velocity that is left out is zero, an axis that is left out stands still.
//!
//! `M<n>==1` and `M<n>==0` switch the tool with the start of the next move, `M<n>=0` and `M<n>=1` when the
//! line is read, which is known before the first move only; `DWELL` stands and executes what is queued.
//! `RAPID` or `LINEAR` before the first `PVT` goes to where the motion starts; a program without it starts where the axes
//! stand.
//!
//! A file may have what a host sends around the program: `OPEN PROG n CLEAR`, `OPEN ROT`, `CLOSE`, `&1B1R`, definitions
//! of axes. The
//! words are in upper or lower case, several in a line or one, with comments after `;` and `//` and within `/* */`. `Isx90`
//! sets the unit of time of the velocities. Labels and variables that no move uses change nothing. A second program, a
//! PLC program, `CMD` and every other word are refused.
//! A program without switches has the tool on always; one that has them ends with the tool off.
//!
//! Source: Turbo PMAC software reference, program commands PVT, RAPID, {axis}{data}:{data}, M{data}==, M{data}=,
//! DWELL; Turbo PMAC user manual, Synchronous M-Variable Assignment.

use planish_types::{AxesMotion, Invalid};

use super::{Configuration, Knot, Layout, finite, needed, positive, through, wrong};

/// Reads the motion of a PMAC program. Refuses what the module names, and absent settings.
pub(super) fn read(
    text: &str,
    configuration: &Configuration,
    layout: &Layout,
) -> Result<AxesMotion, Invalid> {
    let mut program = PmacProgram::new(configuration, layout);
    let mut is_comment = false;
    for (i, line) in text.lines().enumerate() {
        let plain = without_comments(line, &mut is_comment);
        program.line(i + 1, &statements(i + 1, &plain)?)?;
    }
    program.output.end()?;
    through(&program.knots)
}

/// A statement of the program: a word of letters, its number, and the velocity or value after it.
struct Statement {
    word: String,
    number: Option<f64>,
    tail: Tail,
    /// Text of the statement as the program writes it.
    raw: String,
}

/// Part of a statement after its number: a velocity, a value, or nothing.
enum Tail {
    None,
    /// Velocity `:v` at the end of a move.
    Velocity(f64),
    /// Assignment: `=v`, or (synchronous) `==v`, which happens at the start of the next move.
    Value {
        value: f64,
        is_synchronous: bool,
    },
}

/// Returns a line without its comments. A comment `/* */` may extend over several lines; `is_comment` is true if the
/// line begins within one, and is updated to its end.
fn without_comments(line: &str, is_comment: &mut bool) -> String {
    let mut plain = String::new();
    let mut rest = line;
    loop {
        if *is_comment {
            let Some(end) = rest.find("*/") else { return plain };
            rest = &rest[end + 2..];
            *is_comment = false;
        }
        let ends = rest.find(';').into_iter().chain(rest.find("//"));
        let end = ends.min().unwrap_or(rest.len());
        match rest.find("/*").filter(|begin| *begin < end) {
            Some(begin) => {
                plain += &rest[..begin];
                plain.push(' ');
                rest = &rest[begin + 2..];
                *is_comment = true;
            }
            None => return plain + &rest[..end],
        }
    }
}

/// Splits the text of a line into its statements; `line` is its number, for messages. Refuses text that is no
/// statement, and `CMD`.
fn statements(line: usize, text: &str) -> Result<Vec<Statement>, Invalid> {
    let upper = text.to_ascii_uppercase();
    let mut rest = upper.trim_start();
    let mut statements = Vec::new();
    while !rest.is_empty() {
        let whole = rest;
        if rest.starts_with(['&', '#']) {
            // The coordinate system, or the definition of an axis, which may go on to the end of the line.
            let end = if rest.starts_with('#') { None } else { rest.find(char::is_whitespace) };
            let word = rest[..1].to_string();
            let raw = rest[..end.unwrap_or(rest.len())].to_string();
            rest = rest[raw.len()..].trim_start();
            statements.push(Statement { word, number: None, tail: Tail::None, raw });
            continue;
        }
        let letters = rest.find(|c: char| !c.is_ascii_alphabetic()).unwrap_or(rest.len());
        if letters == 0 {
            return Err(wrong(line, format!("has {:?} where a word should be", short(rest))));
        }
        let word = rest[..letters].to_string();
        rest = rest[letters..].trim_start();
        if word == "CMD" {
            let remedy = "leave it out if it moves nothing and switches nothing";
            let problem = "has CMD: what the command does is not read";
            return Err(Invalid::at_index("program line", line, problem, remedy));
        }
        let number = data(line, &mut rest)?;
        let mut tail = Tail::None;
        if let Some(after) = rest.strip_prefix(':') {
            rest = after.trim_start();
            let velocity = data(line, &mut rest)?;
            tail = Tail::Velocity(velocity.ok_or_else(|| missing(line, whole))?);
        } else if let Some(after) = rest.strip_prefix('=') {
            let is_synchronous = after.starts_with('=');
            rest = after.trim_start_matches('=').trim_start();
            let value = data(line, &mut rest)?.ok_or_else(|| missing(line, whole))?;
            tail = Tail::Value { value, is_synchronous };
        }
        let raw = whole[..whole.len() - rest.len()].trim_end().to_string();
        statements.push(Statement { word, number, tail, raw });
    }
    Ok(statements)
}

/// Removes a number, with or without parentheses, from the beginning of `rest`, and returns it; returns `None` if there
/// is none. Refuses a number that is not finite, or whose parenthesis does not close.
fn data(line: usize, rest: &mut &str) -> Result<Option<f64>, Invalid> {
    let text = *rest;
    let (number, end) = if let Some(inner) = text.strip_prefix('(') {
        let close = inner.find(')').ok_or_else(|| missing(line, text))?;
        (&inner[..close], close + 2)
    } else {
        let end = text.find(|c: char| !(c.is_ascii_digit() || "+-.".contains(c)));
        let end = end.unwrap_or(text.len());
        if end == 0 {
            return Ok(None);
        }
        (&text[..end], end)
    };
    *rest = text[end..].trim_start();
    finite(line, number).map(Some)
}

fn missing(line: usize, text: &str) -> Invalid {
    wrong(line, format!("has {:?} where a number should be", short(text)))
}

/// State of a program while it is read: states of the axes so far (knots), and modes of the controller.
struct PmacProgram<'a> {
    layout: &'a Layout,
    letters: Vec<char>,
    last: Knot,
    knots: Vec<Knot>,
    /// True if the position of the axes is known, from the settings or from a move to the start.
    is_placed: bool,
    unit_s: Option<f64>,
    segment_ms: Option<f64>,
    /// True after RAPID or LINEAR, so that moves before the first PVT go to the start position.
    is_approach: bool,
    is_absolute: bool,
    total_ms: f64,
    output: Output,
    is_open: bool,
    is_closed: bool,
    is_rotary: bool,
}

impl<'a> PmacProgram<'a> {
    fn new(configuration: &'a Configuration, layout: &'a Layout) -> Self {
        let n = layout.len();
        let position = layout.start.clone().unwrap_or_else(|| vec![0.0; n]);
        let last = Knot { time_s: 0.0, position, velocity: vec![0.0; n], tool_on: true };
        Self {
            layout,
            letters: layout.letters(),
            knots: vec![last.clone()],
            last,
            is_placed: layout.start.is_some(),
            unit_s: configuration.feedrate_time_unit_s,
            segment_ms: None,
            is_approach: false,
            is_absolute: true,
            total_ms: 0.0,
            output: Output::default(),
            is_open: false,
            is_closed: false,
            is_rotary: false,
        }
    }

    fn line(&mut self, line: usize, statements: &[Statement]) -> Result<(), Invalid> {
        let mut rest = statements;
        while let Some(statement) = rest.first() {
            let axes = rest.iter().position(|s| !self.is_axis(s)).unwrap_or(rest.len());
            if axes > 0 && !self.is_closed {
                self.go(line, &rest[..axes])?;
                rest = &rest[axes..];
                continue;
            }
            self.run(line, statement)?;
            rest = &rest[1..];
        }
        Ok(())
    }

    /// Returns true if the statement is the letter of an axis with a number, even of an axis that the program may not
    /// move.
    fn is_axis(&self, statement: &Statement) -> bool {
        let is_letter = statement.word.len() == 1 && "XYZUVWABC".contains(&statement.word);
        is_letter && statement.number.is_some()
    }

    fn run(&mut self, line: usize, statement: &Statement) -> Result<(), Invalid> {
        let Statement { word, number, tail, raw } = statement;
        let needs = || number.ok_or_else(|| missing(line, raw));
        match (word.as_str(), tail) {
            ("CLOSE", _) => self.is_closed = self.is_open,
            // The next lines of a rotary buffer, which go on without a stop.
            ("OPEN", _) if self.is_closed && self.is_rotary => self.is_closed = false,
            // Lines that a host sends: coordinate system, program, run.
            ("&" | "#" | "B" | "R", _)
                if self.is_closed || !word.starts_with(char::is_alphabetic) => {}
            _ if self.is_closed => {
                let remedy = "give the text up to the first CLOSE";
                let problem = format!("has {:?} after CLOSE, which ends the program", short(raw));
                return Err(Invalid::at_index("program line", line, problem, remedy));
            }
            ("OPEN", _) if self.is_open && !self.is_rotary => {
                let remedy = "give a file with one program";
                return Err(Invalid::at_index(
                    "program line",
                    line,
                    "opens a second program",
                    remedy,
                ));
            }
            ("OPEN", _) => self.is_open = true,
            ("ROTARY" | "ROT", _) if self.is_open => self.is_rotary = true,
            ("PLC" | "PLCC" | "ROTARY" | "ROT", _) => {
                let remedy = "give the motion program alone, OPEN PROG to CLOSE";
                let problem = format!("has {}, which is no motion program", short(raw));
                return Err(Invalid::at_index("program line", line, problem, remedy));
            }
            // They move nothing: labels, memory, ramps and feed of other modes, variables.
            (
                "PROG" | "CLEAR" | "N" | "O" | "DELETE" | "GATHER" | "ENDGATHER" | "UNDEFINE"
                | "ALL",
                _,
            )
            | ("TA" | "TS" | "TM" | "F" | "NORMAL" | "RET" | "RETURN", _)
            | ("P" | "Q", Tail::Value { .. }) => {}
            ("ABS", _) => self.is_absolute = true,
            ("INC", _) => self.is_absolute = false,
            ("RAPID" | "RPD" | "LINEAR" | "LIN", _) if self.segment_ms.is_none() => {
                self.is_approach = true;
            }
            ("RAPID" | "RPD" | "LINEAR" | "LIN", _) => {
                return Err(wrong(line, format!("goes elsewhere by {word} among the segments")));
            }
            ("PVT", _) => {
                let ms = needs()?;
                if ms <= 0.0 {
                    return Err(wrong(line, format!("lasts {ms} ms")));
                }
                self.segment_ms = Some(ms);
            }
            ("DWELL" | "DWE" | "DELAY" | "DLY", _) => self.dwell(line, needs()?)?,
            ("I", Tail::Value { value, .. }) => self.set(line, needs()?, *value, raw)?,
            ("M", Tail::Value { .. }) => {
                self.output.assign(line, statement, self.knots.len() > 1)?
            }
            _ => {
                let known: Vec<String> = self.letters.iter().map(char::to_string).collect();
                let problem = format!("has {:?}, not {} or PVT", short(raw), known.join(" or "));
                return Err(wrong(line, problem));
            }
        }
        Ok(())
    }

    /// Sets an I-variable. Isx90 is the time unit of the velocities, ms; Isx87 to Isx89 belong to other modes and
    /// change nothing. Refuses a unit other than the one that is known, and all other variables.
    fn set(&mut self, line: usize, number: f64, value: f64, raw: &str) -> Result<(), Invalid> {
        match number as u32 % 100 {
            87..=89 => Ok(()),
            90 => {
                let unit_s = value / 1e3;
                if let Some(other) = self.unit_s.filter(|u| (u - unit_s).abs() > 1e-9 * u.abs()) {
                    let remedy =
                        "give `feedrate_time_unit_s` as the program has it, or leave it out";
                    let problem =
                        format!("sets {raw}, a unit of {unit_s} s, and {other} s are given");
                    return Err(Invalid::at_index("program line", line, problem, remedy));
                }
                self.unit_s = Some(unit_s);
                Ok(())
            }
            _ => {
                let remedy = "leave it out if it does not change the motion";
                let problem = format!("sets {raw}: what it changes is not read");
                Err(Invalid::at_index("program line", line, problem, remedy))
            }
        }
    }

    fn dwell(&mut self, line: usize, ms: f64) -> Result<(), Invalid> {
        if ms < 0.0 || self.last.velocity.iter().any(|v| *v != 0.0) {
            return Err(wrong(line, format!("dwells for {ms} ms, or while it moves")));
        }
        self.output.execute();
        if ms > 0.0 {
            self.add(ms);
        }
        Ok(())
    }

    /// Appends the last position and velocity as a knot, `ms` milliseconds after the knot before it. The tool is in the
    /// state of the output up to it.
    fn add(&mut self, ms: f64) {
        self.knots.last_mut().expect("one knot").tool_on = self.output.on;
        // Milliseconds add up; dividing every one of them would round every one.
        self.total_ms += ms;
        self.last.time_s = self.total_ms / 1e3;
        self.knots.push(self.last.clone());
    }

    /// Moves the axes as the words of a line say, in one segment: position or distance, and velocity at the end. Before
    /// the first PVT it moves them to the start. Refuses absent settings, unknown axes and one named twice.
    fn go(&mut self, line: usize, words: &[Statement]) -> Result<(), Invalid> {
        let Some(ms) = self.segment_ms else {
            return self.approach(line, words);
        };
        if !self.is_placed {
            needed("start_mm", self.layout.start.clone())?;
        }
        let unit_s = needed("feedrate_time_unit_s", self.unit_s)?;
        let unit_s = positive("feedrate_time_unit_s", unit_s)?;
        self.last.velocity.fill(0.0);
        self.output.execute();
        let mut seen = vec![false; self.letters.len()];
        for word in words {
            let axis = self.axis(line, word)?;
            if std::mem::replace(&mut seen[axis], true) {
                return Err(wrong(line, format!("has {} twice", word.word)));
            }
            let (Some(p), Tail::None | Tail::Velocity(_)) = (word.number, &word.tail) else {
                return Err(missing(line, &word.raw));
            };
            let v = if let Tail::Velocity(v) = word.tail { v } else { 0.0 };
            let from = if self.is_absolute { 0.0 } else { self.last.position[axis] };
            self.last.position[axis] = from + p;
            self.last.velocity[axis] = v / unit_s;
        }
        self.add(ms);
        Ok(())
    }

    /// Moves the axes to the start position, which begins the motion anew. The move must follow RAPID or LINEAR, and
    /// name all axes in absolute positions without velocities.
    fn approach(&mut self, line: usize, words: &[Statement]) -> Result<(), Invalid> {
        if !self.is_approach {
            return Err(wrong(line, "moves before PVT sets a time"));
        }
        let mut seen = vec![false; self.letters.len()];
        for word in words {
            let Ok(axis) = self.axis(line, word) else { continue };
            if let (Some(p), Tail::None) = (word.number, &word.tail) {
                self.last.position[axis] = p;
                seen[axis] = true;
            }
        }
        if words.len() != self.letters.len() || !seen.iter().all(|s| *s) || !self.is_absolute {
            let problem = "goes to the start without all axes, or by a distance: the motion would start anywhere";
            return Err(wrong(line, problem));
        }
        self.knots = vec![self.last.clone()];
        self.is_placed = true;
        Ok(())
    }

    /// Returns the index of the axis that a word names. Refuses an axis that the program does not move.
    fn axis(&self, line: usize, word: &Statement) -> Result<usize, Invalid> {
        self.letters.iter().position(|l| word.word.starts_with(*l)).ok_or_else(|| {
            let known: Vec<String> = self.letters.iter().map(char::to_string).collect();
            wrong(line, format!("has {:?}, not {}", short(&word.raw), known.join(" or ")))
        })
    }
}

/// State of the M-variable that switches the tool: its number once it is known, and true if the tool is on.
struct Output {
    number: Option<u32>,
    on: bool,
    /// Value that is assigned at the start of the next move, if any.
    queued: Option<bool>,
}

impl Default for Output {
    fn default() -> Self {
        Self { number: None, on: true, queued: None }
    }
}

impl Output {
    /// Executes `M<n>==<0|1>` or `M<n>=<0|1>`. `moved` is true if the program has moved already. Refuses other values,
    /// another variable, a first switch after a move, and `=` after a move.
    fn assign(&mut self, line: usize, statement: &Statement, moved: bool) -> Result<(), Invalid> {
        let (number, value, synchronous) = match (statement.number, &statement.tail) {
            (Some(n), Tail::Value { value, is_synchronous }) if n >= 0.0 && n.fract() == 0.0 => {
                (n as u32, *value, *is_synchronous)
            }
            _ => (0, f64::NAN, false),
        };
        if value != 0.0 && value != 1.0 {
            let problem = format!("has {:?}, not M<n>==0 or M<n>==1", short(&statement.raw));
            return Err(wrong(line, problem));
        }
        let on = value == 1.0;
        if self.number.is_some_and(|n| n != number) {
            return Err(wrong(line, "switches another M-variable than the lines before it"));
        }
        if self.number.is_none() && moved {
            return Err(wrong(
                line,
                "switches first here: whether the tool was on before is not known",
            ));
        }
        self.number = Some(number);
        match (synchronous, moved) {
            (true, _) => self.queued = Some(on),
            (false, false) => self.on = on,
            (false, true) => {
                return Err(wrong(
                    line,
                    "assigns with = among moves: that happens one or two moves early",
                ));
            }
        }
        Ok(())
    }

    /// Applies the assignment that waits for the next move or dwell, if there is one.
    fn execute(&mut self) {
        self.on = self.queued.take().unwrap_or(self.on);
    }

    fn end(&self) -> Result<(), Invalid> {
        if self.number.is_some() && (self.on || self.queued.is_some()) {
            let problem =
                "ends with the tool on: what is assigned after the last move does not happen";
            return Err(Invalid::whole("program", problem, "end with M<n>==0 and DWELL0"));
        }
        Ok(())
    }
}

fn short(word: &str) -> String {
    word.chars().take(20).collect()
}
