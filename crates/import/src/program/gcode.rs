//! G-code as LinuxCNC runs it, the part that a plan needs:
//!
//! | word | meaning |
//! |---|---|
//! | G0 | to the start; later only where the axes stand already |
//! | G1 X Y (Z A B C) F | straight at constant speed; G93: in 60/F s, F in every line; G94: at F mm/min |
//! | G64 P | lines are joined: near a node the motion is the parabola over half of the shorter line on both sides |
//! | G4 P | stand for P seconds, after the motion before has ended |
//! | M62 P0, M63 P0 | tool on, tool off with the next motion (G0, G1; a G4 is none) |
//! | M64 P0, M65 P0 | tool on, tool off at once, after the motion before has ended |
//! | G53 on a line | positions are those of the axes; on all lines of the motion, or on none |
//! | G92.2, M48, M49 | no offset by G92; override of the feed on, off |
//! | G17 G21 G40 G49 G54 G61 G64 G80 G90 G91.1 G97 G98 G99 | accepted: plane, mm, no compensation, path mode, absolute, no cycle |
//! | O, S, T | accepted: number of the program, speed and tool that no M word uses |
//! | M2, M30, or a second % | end; a program without one was cut off |
//!
//! A feed means nothing for rotary axes, so that lines of them run in inverse time. P bounds the linear axes only.
//!
//! Joined lines run at continuous velocity, from rest to rest: half a line before the first node begins the motion, and half
//! a line after the last one ends it. A dwell, and an output that switches at once, end a motion and begin another. With
//! a_k = (m_k - m_{k-1}) / b_k, b_k = min(T_{k-1}, T_k) and the mean velocity m of a line, the joined motion stays within
//! |m_k - m_{k-1}| b_k / 8 of the corner. Where that is more than P, or the path mode is G61 or G64 without P, the lines
//! are read as they stand, with steps of the velocity. The times are nominal: a planner that joins lines otherwise, or
//! is held by its limits, takes longer.
//!
//! The reader refuses what LinuxCNC refuses, and names the line. It also refuses whatever would change the
//! motion without a trace:
//!
//! * a word twice, two words of one modal group, a word without a number or that nothing on the line uses;
//! * a comment within a comment, a comment that does not end, a bracket without a comment;
//! * a line that a switch of the machine may leave out (/);
//! * more than 252 characters (the interpreter ends at 253).
//!
//! If the head says that the feeds make up for the planner of LinuxCNC, F is no time: the comment of each line states its
//! time.
//!
//! In a program without M62 to M65 the tool is always on. A program with them must switch the tool before
//! it moves, and must end with the tool off.
//!
//! Source: LinuxCNC documentation: G-codes, M-codes (M62 - M65 Digital Output Control), G-code Overview
//! (Format of a line, Numbers, Comments, modal groups).

use planish_types::{AxesMotion, Invalid};

use super::{
    Layout, finite,
    lines::{Part, motion},
    wrong,
};

/// Reads the motion of a G-code program. Refuses a program that has no end or moves nothing, and what the module names.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let mut machine = Machine::new(layout);
    let [mut percent, mut begun, mut ended] = [false; 3];
    for (i, line) in text.lines().enumerate() {
        let plain = line.trim();
        ended = match plain {
            // Around the program, as its first line and its last.
            "%" if !begun => {
                percent = true;
                false
            }
            "%" if percent => true,
            _ => machine.line(i + 1, line)?,
        };
        begun |= !plain.is_empty();
        if ended {
            break;
        }
    }
    if !ended {
        let problem = "does not end with M2, M30 or a second %: it was cut off";
        return Err(Invalid::whole("program", problem, "end it with M2 if it is whole"));
    }
    machine.end()?;
    if machine.parts.iter().all(|part| part.seconds == 0.0) {
        return Err(Invalid::whole("program", "moves nothing", "give a program with motion"));
    }
    motion(&machine.parts, machine.layout, machine.tolerance_mm)
}

struct Machine<'a> {
    layout: &'a Layout,
    letters: Vec<char>,
    position: Vec<Option<f64>>,
    inverse_time: bool,
    feed: Option<f64>,
    /// Motion mode: 0 for G0, 1 for G1.
    motion: u32,
    tool_on: bool,
    /// Tool state that an M62 or M63 has requested for the next motion.
    queued: Option<bool>,
    /// True if the program contains M62 to M65, so that it switches the tool.
    switches: bool,
    /// Path tolerance P of G64, mm; 0 if lines are not joined (G61, or G64 without P).
    tolerance_mm: f64,
    parts: Vec<Part>,
    /// Sum of the dwells with the tool off, s, that the program makes before it sets the start position. They count
    /// once it is set.
    wait_s: f64,
    /// True if the feeds make up for the planner of LinuxCNC: the times of lines are in their comments then.
    has_times_in_comments: bool,
    /// True if the positions are those of the axes (G53), false if they are work coordinates; `None` before the first.
    is_of_axes: Option<bool>,
}

impl<'a> Machine<'a> {
    fn new(layout: &'a Layout) -> Self {
        Self {
            layout,
            letters: layout.letters(),
            position: vec![None; layout.len()],
            inverse_time: false,
            feed: None,
            motion: 0,
            tool_on: true,
            queued: None,
            switches: false,
            tolerance_mm: 0.0,
            parts: Vec::new(),
            wait_s: 0.0,
            has_times_in_comments: false,
            is_of_axes: None,
        }
    }

    /// Executes a line of the program, whose `number` counts from 1; returns true if the program ends with it. Refuses
    /// what the module names.
    fn line(&mut self, number: usize, line: &str) -> Result<bool, Invalid> {
        let words = words(number, line)?;
        self.has_times_in_comments |= line.contains(FEEDS_OF_PLANNER);
        check_words(number, &words, &self.letters)?;
        let value = |letter: char| words.iter().find(|w| w.0 == letter).map(|w| w.1);
        let mut dwell = false;
        let mut end = false;
        let mut output = None;
        for (letter, v) in &words {
            match (letter, code(*v)) {
                ('G', Some(0)) => self.motion = 0,
                ('G', Some(10)) => self.motion = 1,
                ('G', Some(40)) => dwell = true,
                ('G', Some(930)) => self.inverse_time = true,
                ('G', Some(940)) => self.inverse_time = false,
                ('G', Some(mode @ (610 | 640))) => {
                    if !self.parts.is_empty() {
                        return Err(wrong(number, "changes the path mode within the motion"));
                    }
                    self.tolerance_mm = if mode == 640 { value('P').unwrap_or(0.0) } else { 0.0 };
                }
                ('M', Some(20 | 300)) => end = true,
                ('M', Some(620)) => output = Some((true, true)),
                ('M', Some(630)) => output = Some((false, true)),
                ('M', Some(640)) => output = Some((true, false)),
                ('M', Some(650)) => output = Some((false, false)),
                _ => {}
            }
        }
        if let Some((on, with_motion)) = output {
            if value('P') != Some(0.0) {
                return Err(wrong(number, "switches another output than P0"));
            }
            self.switch(number, on, with_motion)?;
        }
        if let Some(feed) = value('F') {
            if feed <= 0.0 {
                return Err(wrong(number, format!("F is {feed}")));
            }
            self.feed = Some(feed);
        }
        if dwell {
            let seconds = value('P').filter(|p| *p >= 0.0);
            let seconds = seconds.ok_or_else(|| {
                let remedy = "write the seconds as G4 P: LinuxCNC knows no G4 with X, U or S";
                Invalid::at_index("program line", number, "has G4 without P >= 0", remedy)
            })?;
            match self.here(number) {
                Ok(here) => self.stop(here, seconds),
                // Where the axes stand before the rapid to the start is not known.
                Err(_) if !self.tool_on => self.wait_s += seconds,
                Err(e) => return Err(e),
            }
        } else if self.letters.iter().any(|letter| value(*letter).is_some()) {
            let is_of_axes = has(&words, 'G', &[530]);
            if self.is_of_axes.replace(is_of_axes).is_some_and(|before| before != is_of_axes) {
                let problem = "has positions of the axes (G53) beside work coordinates";
                return Err(wrong(number, problem));
            }
            let axes = self.letters.iter().zip(&self.position);
            let target = axes.map(|(letter, here)| value(*letter).or(*here)).collect();
            let mut stated = None;
            if self.has_times_in_comments && self.motion == 1 {
                stated = Some(stated_s(number, line)?);
            } else if self.inverse_time && stated_s(number, line).is_ok() {
                let problem =
                    "states its time in a comment, and no line before says that F is none";
                return Err(wrong(number, problem));
            }
            self.go(number, target, value('F'), stated)?;
        }
        Ok(end)
    }

    /// Switches the tool at once, or with the next motion (`with_motion`). Refuses the first switch within the motion.
    fn switch(&mut self, number: usize, on: bool, with_motion: bool) -> Result<(), Invalid> {
        if !self.switches && !self.parts.is_empty() {
            let problem = "switches the tool first here: whether it was on before is not known";
            return Err(wrong(number, problem));
        }
        if !self.switches {
            // Not switched yet: off, as when the controller starts.
            self.tool_on = false;
        }
        self.switches = true;
        if with_motion {
            self.queued = Some(on);
        } else {
            self.tool_on = on;
            if !self.parts.is_empty() {
                self.stop(self.here(number)?, 0.0);
            }
        }
        Ok(())
    }

    /// Moves to the position `target` by G1, or sets the start position by G0; `None` is an axis whose position is not
    /// yet known. `feed` is the number of the F word of the line, and `stated_s` its time if F is none. Refuses a move whose time is not known, or of no
    /// length.
    fn go(
        &mut self,
        number: usize,
        target: Vec<Option<f64>>,
        feed: Option<f64>,
        stated_s: Option<f64>,
    ) -> Result<(), Invalid> {
        if self.motion == 0 {
            if !self.parts.is_empty() && target != self.position {
                return Err(wrong(number, "has G0 within the motion: its time is not known"));
            }
            if target != self.position {
                self.tool_on = self.queued.take().unwrap_or(self.tool_on);
            }
            self.position = target;
            if self.wait_s > 0.0 && self.position.iter().all(Option::is_some) {
                // With the tool off it does not matter where.
                let is_on = std::mem::replace(&mut self.tool_on, false);
                let wait_s = std::mem::take(&mut self.wait_s);
                self.stop(self.here(number)?, wait_s);
                self.tool_on = is_on;
            }
            return Ok(());
        }
        if self.inverse_time && feed.is_none() {
            return Err(wrong(number, "has no F; G93 wants one in every line"));
        }
        let feed = self.feed.ok_or_else(|| wrong(number, "has no F before it"))?;
        let here = self.here(number)?;
        if !self.inverse_time && self.layout.turns() {
            return Err(wrong(number, "moves by G94, and a feed means nothing for rotary axes"));
        }
        let to: Option<Vec<f64>> = target.into_iter().collect();
        let to = to.ok_or_else(|| wrong(number, "moves an axis while another one is nowhere"))?;
        let away = to.iter().zip(&here).map(|(p, q)| p - q);
        let length = away.fold(0.0, f64::hypot);
        if length == 0.0 {
            return Err(wrong(number, "has no length: the interpreter drops it and its time"));
        }
        // G93: 60 / F seconds; G94: length at F mm/min
        let by_feed = if self.inverse_time { 60.0 / feed } else { 60.0 * length / feed };
        let seconds = stated_s.unwrap_or(by_feed);
        self.tool_on = self.queued.take().unwrap_or(self.tool_on);
        self.push(number, &here, &to, seconds)
    }

    /// Refuses a program that ends with the tool on, or with a switch that no motion follows.
    fn end(&self) -> Result<(), Invalid> {
        let problem = match (self.switches, self.queued, self.tool_on) {
            (true, Some(_), _) => {
                "ends with an M62 or M63 that no motion follows: it never happens"
            }
            (true, None, true) => "ends with the tool on",
            _ => return Ok(()),
        };
        Err(Invalid::whole("program", problem, "end it with M65 P0"))
    }

    /// Returns the positions of all axes. Refuses a program that has not yet set the position of every axis by G0.
    fn here(&self, number: usize) -> Result<Vec<f64>, Invalid> {
        let here: Option<Vec<f64>> = self.position.iter().copied().collect();
        here.ok_or_else(|| {
            let axes: Vec<String> = self.letters.iter().map(char::to_string).collect();
            wrong(number, format!("comes before G0 {} sets the start", axes.join(" ")))
        })
    }

    /// Appends a straight line from `from` to `to` that takes `seconds`. `number` is the line of the program, for
    /// messages. Refuses a time that is not finite.
    fn push(
        &mut self,
        number: usize,
        from: &[f64],
        to: &[f64],
        seconds: f64,
    ) -> Result<(), Invalid> {
        if !seconds.is_finite() {
            return Err(wrong(number, format!("lasts {seconds} s")));
        }
        let axes = from.iter().zip(to);
        let states = axes.map(|(p, q)| [*p, (q - p) / seconds]).collect();
        self.parts.push(Part { seconds, states, tool_on: self.tool_on, is_stop: false });
        self.position = to.iter().copied().map(Some).collect();
        Ok(())
    }

    /// Appends a stop of `seconds` at the positions `here`, after the motion before it has ended.
    fn stop(&mut self, here: Vec<f64>, seconds: f64) {
        let states = here.iter().map(|p| [*p, 0.0]).collect();
        self.parts.push(Part { seconds, states, tool_on: self.tool_on, is_stop: true });
    }
}

/// Comment of a program whose feeds are no times, but those with which the planner of LinuxCNC takes the
/// times of the plan.
const FEEDS_OF_PLANNER: &str = "(planner: the feeds make up for the planner of LinuxCNC";

/// Returns the time that the comment of a line states, s. Refuses a line without it.
fn stated_s(number: usize, line: &str) -> Result<f64, Invalid> {
    let comment = line.split_once('(').and_then(|(_, comment)| comment.split_once(" s)"));
    let seconds = comment.and_then(|(text, _)| text.parse().ok());
    seconds.filter(|s: &f64| s.is_finite() && *s > 0.0).ok_or_else(|| {
        let remedy = "write it as (0.002 s) after the words, or export the program again";
        let problem = "has no comment with its time, and the head says that F is none";
        Invalid::at_index("program line", number, problem, remedy)
    })
}

/// Shortest dwell (G4) of whole seconds, s, that may be meant in milliseconds. Larger: short dwells in ms pass.
/// Smaller: dwells in s are doubted.
const LEAST_DOUBTED_S: f64 = 100.0;

/// Returns a doubt about the unit of the longest dwell of 100 or more whole seconds, because other controllers count it
/// in ms. Returns `None` without such a dwell.
pub(super) fn doubt_of_dwell(text: &str) -> Option<String> {
    let dwells = text.lines().enumerate().filter_map(|(i, line)| {
        let words = words(i + 1, line).ok()?;
        let is_dwell = words.iter().any(|w| w.0 == 'G' && code(w.1) == Some(40));
        let seconds = words.iter().find(|w| w.0 == 'P')?.1;
        if is_dwell && seconds >= LEAST_DOUBTED_S && seconds.fract() == 0.0 {
            Some((i + 1, seconds))
        } else {
            None
        }
    });
    let (line, seconds) = dwells.max_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(format!(
        "line {line} stands for {seconds} s: P of G4 in ms? LinuxCNC counts seconds, so write P{} for ms",
        seconds / 1e3
    ))
}

/// Returns ten times the number `v` of a G or M code as a whole number, because codes have at most one decimal. Returns
/// `None` if ten times `v` is more than 1e-4 from a whole number.
fn code(v: f64) -> Option<i64> {
    let tenfold = 10.0 * v;
    if (tenfold - tenfold.round()).abs() <= 1e-4 { Some(tenfold.round() as i64) } else { None }
}

/// Refuses words that are unknown or twice there, two words of one modal group, and words that nothing on the line
/// uses.
fn check_words(number: usize, words: &[(char, f64)], axes: &[char]) -> Result<(), Invalid> {
    let mut groups = Vec::new();
    // With the words of a motion G53 says in which coordinates they are.
    let is_frame = axes.iter().any(|letter| has_letter(words, *letter));
    for (i, (letter, v)) in words.iter().enumerate() {
        let not_understood = || wrong(number, format!("has {letter}{v}, which is not understood"));
        match letter {
            'G' | 'M' => {
                let group = match (letter, code(*v).ok_or_else(not_understood)?) {
                    ('G', 40) => "not modal",
                    ('G', 0 | 10) => "motion",
                    ('G', 170) => "plane",
                    ('G', 210) => "unit",
                    ('G', 400) => "cutter compensation",
                    ('G', 490) => "tool length",
                    ('G', 540) => "coordinate system",
                    ('G', 610 | 640) => "path mode",
                    ('G', 800 | 970 | 980 | 990) => "cycles and spindle mode",
                    ('G', 911) => "distance mode of arcs",
                    ('G', 900) => "distance mode",
                    ('G', 930 | 940) => "feed mode",
                    ('G', 200) => return Err(wrong(number, "has G20: inches; write it in mm")),
                    ('G', 20 | 30) => {
                        let problem = format!("has G{v}, an arc");
                        let remedy = "write it as short lines (G1)";
                        return Err(Invalid::at_index("program line", number, problem, remedy));
                    }
                    ('G', 910) => {
                        let problem = "has G91, which is not understood: distances, not positions";
                        let remedy = "write the program with G90";
                        return Err(Invalid::at_index("program line", number, problem, remedy));
                    }
                    ('G', 530) if is_frame => "not modal",
                    ('G', 922) => "not modal",
                    ('M', 480 | 490) => "override",
                    ('G', 280 | 300 | 530) => {
                        let problem = format!(
                            "has G{v}, which is not understood: the machine goes to a place of its own"
                        );
                        let remedy = "leave it out: the motion begins with G0 to the start";
                        return Err(Invalid::at_index("program line", number, problem, remedy));
                    }
                    ('M', 30 | 40 | 50 | 60 | 70 | 80 | 90) => {
                        let problem = format!(
                            "has M{v}, which is not understood: spindle, tool change or coolant"
                        );
                        let remedy =
                            "leave it out if it is not the tool; the tool is M62 to M65 P0";
                        return Err(Invalid::at_index("program line", number, problem, remedy));
                    }
                    ('M', 20 | 300) => "end",
                    ('M', 620 | 630 | 640 | 650) => "output",
                    _ => return Err(not_understood()),
                };
                if groups.contains(&group) {
                    return Err(wrong(
                        number,
                        format!("has {letter}{v} beside another word of its group ({group})"),
                    ));
                }
                groups.push(group);
            }
            _ if axes.contains(letter) || "FPQ".contains(*letter) => {
                if words[..i].iter().any(|w| w.0 == *letter) {
                    return Err(wrong(number, format!("has the word {letter} twice")));
                }
            }
            'N' if i == 0 && *v >= 0.0 => {}
            // Speed and tool without their M words, and the number of the program, move nothing.
            'S' | 'T' if *v >= 0.0 => {}
            'O' if i == 0 && words.len() == 1 => {}
            'N' => return Err(wrong(number, "has N not at its beginning, or below zero")),
            _ => return Err(wrong(number, format!("has the word {letter}{v}"))),
        }
    }
    check_belonging(number, words, axes)
}

/// Returns true if a word with this letter has one of these codes, which are ten times the number of the word.
fn has(words: &[(char, f64)], letter: char, codes: &[i64]) -> bool {
    words.iter().any(|w| w.0 == letter && code(w.1).is_some_and(|c| codes.contains(&c)))
}

/// Returns true if a word has this letter.
fn has_letter(words: &[(char, f64)], letter: char) -> bool {
    words.iter().any(|w| w.0 == letter)
}

/// Refuses words that belong to no command of the line, or to two of them: P, Q, and words beside G4.
fn check_belonging(number: usize, words: &[(char, f64)], axes: &[char]) -> Result<(), Invalid> {
    let dwell = has(words, 'G', &[40]);
    let output = has(words, 'M', &[620, 630, 640, 650]);
    let blending = has(words, 'G', &[640]);
    if dwell && (output || blending || axes.iter().any(|letter| has_letter(words, *letter))) {
        return Err(wrong(number, "has G4 with words that belong to something else"));
    }
    if has_letter(words, 'P') && (output && blending || !(dwell || output || blending)) {
        return Err(wrong(number, "has a word P that belongs to nothing, or to two things"));
    }
    if has_letter(words, 'Q') && !blending {
        return Err(wrong(number, "has a word Q that belongs to nothing"));
    }
    Ok(())
}

/// Largest number of characters of a line that the interpreter `rs274` accepts; with one more it reports "Command too
/// long".
const MOST_CHARACTERS: usize = 252;

/// Splits a line into words, a letter with its number each; comments are left out. Refuses a line that is too long,
/// begins with `/`, or has broken comments or words.
fn words(number: usize, line: &str) -> Result<Vec<(char, f64)>, Invalid> {
    if line.len() > MOST_CHARACTERS {
        let problem =
            format!("has {} characters, the controller takes {MOST_CHARACTERS}", line.len());
        return Err(wrong(number, problem));
    }
    let mut plain = String::new();
    let mut comment = false;
    for c in line.chars() {
        match c {
            '(' if comment => return Err(wrong(number, "has a comment within a comment")),
            '(' => comment = true,
            ')' if !comment => return Err(wrong(number, "has ) without a comment")),
            ')' => comment = false,
            _ if comment => {}
            ';' => break,
            '/' if plain.is_empty() => {
                let problem = "begins with /: whether it runs depends on a switch of the machine";
                return Err(wrong(number, problem));
            }
            _ if c.is_whitespace() => {}
            _ => plain.push(c.to_ascii_uppercase()),
        }
    }
    if comment {
        return Err(wrong(number, "has a comment that does not end"));
    }
    let mut words = Vec::new();
    let mut rest = plain.as_str();
    while let Some(letter) = rest.chars().next() {
        if !letter.is_ascii_alphabetic() {
            return Err(wrong(number, format!("has {letter:?} where a letter should be")));
        }
        let end = rest[1..].find(|c: char| c.is_ascii_alphabetic()).map_or(rest.len(), |e| e + 1);
        match &rest[1..end] {
            "" => return Err(wrong(number, format!("has the word {letter} without a number"))),
            text if text.chars().all(|c| c.is_ascii_digit() || "+-.".contains(c)) => {
                words.push((letter, finite(number, text)?))
            }
            text => {
                let short: String = text.chars().take(20).collect();
                return Err(wrong(number, format!("has {short:?} where a number should be")));
            }
        }
        rest = &rest[end..];
    }
    Ok(words)
}
