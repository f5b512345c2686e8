//! PMAC, PVT mode: `PVT<t>` sets the time of the segments that follow, in ms; `X<p>:<v> Y<p>:<v>` is
//! a segment to a position (`ABS`) or by a distance (`INC`) with the velocity at its end, in mm per
//! feedrate time unit. A velocity that is left out is zero, an axis that is left out stands still.
//!
//! `M<n>==1` and `M<n>==0` switch the tool with the start of the next move, `M<n>=0` and `M<n>=1` when the
//! line is read, which is known before the first move only; `DWELL` stands and executes what is queued.
//! `RAPID` before the first `PVT` goes to where the motion starts; a program without it starts where the axes stand.
//! A program without switches has the tool on always; one that has them ends with the tool off.
//!
//! Source: Turbo PMAC software reference, program commands PVT, RAPID, {axis}{data}:{data}, M{data}==, M{data}=,
//! DWELL; Turbo PMAC user manual, Synchronous M-Variable Assignment.

use planish_types::{AxesMotion, Invalid};

use super::{Configuration, Knot, Layout, finite, needed, positive, through, wrong};

/// The motion of a program.
pub(super) fn read(
    text: &str,
    configuration: &Configuration,
    layout: &Layout,
) -> Result<AxesMotion, Invalid> {
    let (n, letters) = (layout.len(), layout.letters());
    let goes_there = text.lines().any(|line| code(line) == "RAPID");
    let position = match goes_there {
        // The place of the axes before the program does not matter.
        true => layout.start.clone().unwrap_or_else(|| vec![0.0; n]),
        false => needed("start_mm", layout.start.clone())?,
    };
    let unit_s = needed("feedrate_time_unit_s", configuration.feedrate_time_unit_s)?;
    let unit_s = positive("feedrate_time_unit_s", unit_s)?;
    let mut last = Knot { time_s: 0.0, position, velocity: vec![0.0; n], tool_on: true };
    let mut knots = vec![last.clone()];
    let (mut segment_ms, mut absolute, mut total_ms) = (None, true, 0.0);
    let mut rapid = false;
    let mut output = Output::default();
    for (i, line) in text.lines().enumerate() {
        let line = code(line);
        match line {
            "" => continue,
            "ABS" => absolute = true,
            "INC" => absolute = false,
            "RAPID" if segment_ms.is_none() => rapid = true,
            "RAPID" => return Err(wrong(i + 1, "goes elsewhere by RAPID among the segments")),
            _ if rapid && segment_ms.is_none() && line.starts_with(&letters[..]) => {
                last.position = rapid_to(i + 1, line, absolute, &letters)?;
                knots = vec![last.clone()];
            }
            _ if line.starts_with("PVT") => {
                let ms = constant(i + 1, &line[3..])?;
                if ms <= 0.0 {
                    return Err(wrong(i + 1, format!("lasts {ms} ms")));
                }
                segment_ms = Some(ms);
            }
            _ if line.starts_with("DWELL") => {
                let ms = constant(i + 1, &line[5..])?;
                if ms < 0.0 || last.velocity.iter().any(|v| *v != 0.0) {
                    return Err(wrong(i + 1, format!("dwells for {ms} ms, or while it moves")));
                }
                output.execute();
                if ms > 0.0 {
                    knots.last_mut().expect("one knot").tool_on = output.on;
                    total_ms += ms;
                    last.time_s = total_ms / 1e3;
                    knots.push(last.clone());
                }
            }
            _ if line.starts_with('M') => output.assign(i + 1, line, knots.len() > 1)?,
            _ => {
                let Some(ms) = segment_ms else {
                    return Err(wrong(i + 1, "moves before PVT sets a time"));
                };
                // Milliseconds add up; dividing every one of them would round every one.
                total_ms += ms;
                last.time_s = total_ms / 1e3;
                last.velocity.fill(0.0);
                output.execute();
                knots.last_mut().expect("one knot").tool_on = output.on;
                go(i + 1, line, (absolute, unit_s), &letters, &mut last)?;
                knots.push(last.clone());
            }
        }
    }
    output.end()?;
    through(&knots)
}

/// Takes the axes to the words of a move, with the velocities at its end.
fn go(
    line: usize,
    text: &str,
    (absolute, unit_s): (bool, f64),
    letters: &[char],
    last: &mut Knot,
) -> Result<(), Invalid> {
    let mut seen = vec![false; letters.len()];
    for word in text.split_whitespace() {
        let letter = word.chars().next().unwrap_or_default();
        let Some(axis) = letters.iter().position(|l| *l == letter) else {
            let known: Vec<String> = letters.iter().map(char::to_string).collect();
            let known = known.join(" or ");
            return Err(wrong(line, format!("has \"{}\", not {known}", short(word))));
        };
        if std::mem::replace(&mut seen[axis], true) {
            return Err(wrong(line, format!("has {} twice", &word[..1])));
        }
        let (p, v) = word[1..].split_once(':').unwrap_or((&word[1..], "0"));
        let (p, v) = (finite(line, p)?, finite(line, v)?);
        last.position[axis] = if absolute { p } else { last.position[axis] + p };
        last.velocity[axis] = v / unit_s;
    }
    Ok(())
}

/// A line without its comment.
fn code(line: &str) -> &str {
    line.split(';').next().unwrap_or_default().trim()
}

/// Target of a rapid move: all axes, absolute, so that the place of the axes before it does not matter.
fn rapid_to(
    line: usize,
    text: &str,
    absolute: bool,
    letters: &[char],
) -> Result<Vec<f64>, Invalid> {
    let whole =
        "goes to the start without all axes, or by a distance: the motion would start anywhere";
    let words: Vec<&str> = text.split_whitespace().collect();
    if words.len() != letters.len() || !absolute {
        return Err(wrong(line, whole));
    }
    let to = words.iter().zip(letters).map(|(word, letter)| match word.strip_prefix(*letter) {
        Some(number) => finite(line, number),
        None => Err(wrong(line, whole)),
    });
    to.collect()
}

/// The M-variable that switches the tool.
struct Output {
    number: Option<u32>,
    on: bool,
    /// Assigned with the start of the next move.
    queued: Option<bool>,
}

impl Default for Output {
    fn default() -> Self {
        Self { number: None, on: true, queued: None }
    }
}

impl Output {
    /// `M<n>==<0|1>` or `M<n>=<0|1>`.
    fn assign(&mut self, line: usize, text: &str, moved: bool) -> Result<(), Invalid> {
        let unknown = || wrong(line, format!("has {:?}, not M<n>==0 or M<n>==1", short(text)));
        let (name, value) = text.split_once('=').ok_or_else(unknown)?;
        let (value, synchronous) = match value.strip_prefix('=') {
            Some(value) => (value, true),
            None => (value, false),
        };
        let number = name[1..].trim().parse::<u32>().map_err(|_| unknown())?;
        let on = match value.trim() {
            "0" => false,
            "1" => true,
            _ => return Err(unknown()),
        };
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

    /// A move or a dwell begins.
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

/// A number, in brackets or without.
fn constant(line: usize, text: &str) -> Result<f64, Invalid> {
    let text = text.trim();
    let inner = text.strip_prefix('(').and_then(|t| t.strip_suffix(')')).unwrap_or(text);
    finite(line, inner)
}

fn short(word: &str) -> String {
    word.chars().take(20).collect()
}
