//! G-code as LinuxCNC runs it, the part that a plan in x and y needs:
//!
//! | word | meaning |
//! |---|---|
//! | G0 | to the start; later only where the axes stand already |
//! | G1 X Y F | straight at constant speed; G93: in 60/F s, F in every line; G94: at F mm/min |
//! | G4 P | stand for P seconds |
//! | M62 P0, M63 P0 | tool on, tool off with the next motion |
//! | G17 G21 G40 G49 G54 G61 G64 G90 | accepted: plane, mm, no compensation, path mode, absolute |
//! | M2, M30, % | end |
//!
//! The times are nominal: a planner that blends corners or is held by its limits takes longer.
//!
//! Source: LinuxCNC documentation, G-codes and M-codes.

use planish_types::{Invalid, Trajectory};

use super::{finite, wrong};

/// The motion of a program.
pub fn read(text: &str) -> Result<Trajectory, Invalid> {
    let mut machine = Machine::default();
    for (i, line) in text.lines().enumerate() {
        if machine.line(i + 1, line)? {
            break;
        }
    }
    let n = machine.segments.len();
    if n == 0 {
        return Err(Invalid::whole("program", "moves nothing", "give a program with motion"));
    }
    Trajectory::new(machine.times, machine.segments, machine.tool, vec![-1; n])
}

struct Machine {
    position: [Option<f64>; 2],
    inverse_time: bool,
    feed: Option<f64>,
    /// 0 or 1 of G0, G1.
    motion: u32,
    tool_on: bool,
    times: Vec<f64>,
    segments: Vec<[[f64; 4]; 2]>,
    tool: Vec<bool>,
}

impl Default for Machine {
    fn default() -> Self {
        Self {
            position: [None; 2],
            inverse_time: false,
            feed: None,
            motion: 0,
            tool_on: true,
            times: vec![0.0],
            segments: Vec::new(),
            tool: Vec::new(),
        }
    }
}

impl Machine {
    /// Runs a line; whether the program ends with it.
    fn line(&mut self, number: usize, line: &str) -> Result<bool, Invalid> {
        let words = words(number, line)?;
        let value = |letter: char| words.iter().find(|w| w.0 == letter).map(|w| w.1);
        let (mut dwell, mut end, mut output) = (false, false, None);
        for (letter, v) in &words {
            // Codes have at most one decimal.
            let code = (10.0 * v).round() as i64;
            match (letter, code) {
                ('G', 0) => self.motion = 0,
                ('G', 10) => self.motion = 1,
                ('G', 40) => dwell = true,
                ('G', 930) => self.inverse_time = true,
                ('G', 940) => self.inverse_time = false,
                ('G', 170 | 210 | 400 | 490 | 540 | 610 | 640 | 900) => {}
                ('G', 200) => return Err(wrong(number, "has G20: inches; write it in mm")),
                ('M', 20 | 300) => end = true,
                ('M', 620) => output = Some(true),
                ('M', 630) => output = Some(false),
                ('G' | 'M', _) => {
                    return Err(wrong(number, format!("has {letter}{v}, which is not understood")));
                }
                ('X' | 'Y' | 'F' | 'P' | 'Q' | 'N', _) => {}
                _ => return Err(wrong(number, format!("has the word {letter}{v}"))),
            }
        }
        if let Some(on) = output {
            if value('P') != Some(0.0) {
                return Err(wrong(number, "switches another output than P0"));
            }
            self.tool_on = on;
        }
        if let Some(feed) = value('F') {
            if feed <= 0.0 {
                return Err(wrong(number, format!("F is {feed}")));
            }
            self.feed = Some(feed);
        }
        if dwell {
            let seconds = value('P').filter(|p| *p > 0.0);
            let seconds = seconds.ok_or_else(|| wrong(number, "has G4 without P > 0"))?;
            let here = self.here(number)?;
            self.push(number, here, here, seconds)?;
        } else if value('X').is_some() || value('Y').is_some() {
            let target = [value('X').or(self.position[0]), value('Y').or(self.position[1])];
            self.go(number, target, value('F'))?;
        }
        Ok(end)
    }

    fn go(
        &mut self,
        number: usize,
        target: [Option<f64>; 2],
        feed: Option<f64>,
    ) -> Result<(), Invalid> {
        if self.motion == 0 {
            if !self.segments.is_empty() && target != self.position {
                return Err(wrong(number, "has G0 within the motion: its time is not known"));
            }
            self.position = target;
            return Ok(());
        }
        if self.inverse_time && feed.is_none() {
            return Err(wrong(number, "has no F; G93 wants one in every line"));
        }
        let feed = self.feed.ok_or_else(|| wrong(number, "has no F before it"))?;
        let here = self.here(number)?;
        let [Some(x), Some(y)] = target else {
            return Err(wrong(number, "moves one axis, the other one is nowhere"));
        };
        let length = (x - here[0]).hypot(y - here[1]);
        if length == 0.0 {
            return Err(wrong(number, "has no length: the interpreter drops it and its time"));
        }
        // G93: 60 / F seconds; G94: length at F mm/min
        let seconds = if self.inverse_time { 60.0 / feed } else { 60.0 * length / feed };
        self.push(number, here, [x, y], seconds)
    }

    fn here(&self, number: usize) -> Result<[f64; 2], Invalid> {
        match self.position {
            [Some(x), Some(y)] => Ok([x, y]),
            _ => Err(wrong(number, "comes before G0 X Y sets the start")),
        }
    }

    fn push(
        &mut self,
        number: usize,
        from: [f64; 2],
        to: [f64; 2],
        seconds: f64,
    ) -> Result<(), Invalid> {
        let end = self.times[self.times.len() - 1] + seconds;
        if !end.is_finite() {
            return Err(wrong(number, format!("lasts {seconds} s")));
        }
        self.times.push(end);
        self.segments.push([0, 1].map(|a| [from[a], (to[a] - from[a]) / seconds, 0.0, 0.0]));
        self.tool.push(self.tool_on);
        self.position = to.map(Some);
        Ok(())
    }
}

/// Letters with their numbers, comments left out.
fn words(number: usize, line: &str) -> Result<Vec<(char, f64)>, Invalid> {
    let mut plain = String::new();
    let mut depth = 0;
    for c in line.split([';', '%']).next().unwrap_or_default().chars() {
        match c {
            '(' => depth += 1,
            ')' => depth -= 1,
            _ if depth == 0 && !c.is_whitespace() => plain.push(c.to_ascii_uppercase()),
            _ => {}
        }
    }
    let mut words = Vec::new();
    let mut rest = plain.as_str();
    while let Some(letter) = rest.chars().next() {
        if !letter.is_ascii_alphabetic() {
            return Err(wrong(number, format!("has \"{letter}\" where a letter should be")));
        }
        let end = rest[1..].find(|c: char| c.is_ascii_alphabetic()).map_or(rest.len(), |e| e + 1);
        words.push((letter, finite(number, &rest[1..end])?));
        rest = &rest[end..];
    }
    Ok(words)
}
