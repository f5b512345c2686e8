//! Siemens SINUMERIK: lines in inverse time (`G93`, `G1 X Y F`), or polynomials (`POLY`, `PO[X]=(end,a2,a3)`, `PL`)
//! along a virtual axis.
//!
//! | word | meaning |
//! |---|---|
//! | `G0 X Y` | to the start, before the motion |
//! | `G93`, `G1 X Y F` | straight in 60/F s, F in every line |
//! | `G642`, `CTOL=p` | lines are joined within p mm, as in `super::lines`; without CTOL, or with `G64`, they are not |
//! | `G4 F` | stand for F seconds |
//! | `FGROUP(W)` | F is the feed of W: a block lasts as long as W needs for its way |
//! | `UPATH` | all axes follow the parameter p of W |
//! | `POLY`, `PO[X]=(end,a2,a3)` | the position is a0 + a1 p + a2 p^2 + a3 p^3, p from 0 to PL |
//! | `PL=` | end of p in this block, 1 without it |
//! | `X1.5`, `X=1.5` in a block with POLY | linear in p |
//! | `G17 G40 G54 G60 G64 G71 G90 G710 FGROUP()` | accepted |
//! | `M30`, `M2`, `M17` | end |
//!
//! A semicolon begins a comment, `N` a number of a block. The reader refuses everything else with its line: arcs,
//! distances (G91), variables, frames, synchronized actions. The program switches no tool.
//!
//! Source: as in the manuals that `docs/controllers.md` names.

use planish_types::{AxesMotion, Invalid};

use super::{
    Layout, finite,
    lines::{Part, motion},
    wrong,
};

/// Range of PL (SINUMERIK 840D, PGA, 5.4).
const PL: std::ops::RangeInclusive<f64> = 1e-4..=99_999.999_9;

/// G codes that change no motion which is read here: plane, no compensation, coordinate system, exact stop, mm,
/// absolute.
const WITHOUT_EFFECT: [u32; 7] = [17, 40, 54, 60, 71, 90, 710];

/// Word of a block.
#[derive(Debug)]
enum BlockWord {
    /// `X1.5`, `X=1.5`, `G93`, `CTOL=0.005`.
    Value(String, f64),
    /// `PO[X]=(1,2,3)`.
    Element(String, String, Vec<f64>),
    /// `FGROUP(X,Y)`.
    Call(String, Vec<String>),
    /// `POLY`.
    Plain(String),
}

/// Interpolation of the axes.
#[derive(Clone, Copy, PartialEq)]
enum Mode {
    Rapid,
    Line,
    Polynomial,
}

struct Sinumerik {
    letters: Vec<String>,
    position: Vec<Option<f64>>,
    mode: Mode,
    inverse_time: bool,
    follows_parameter: bool,
    feed: Option<f64>,
    /// Axes whose feed is F; empty for all.
    group: Vec<String>,
    /// Position of the virtual axis.
    virtual_mm: f64,
    is_smoothed: bool,
    tolerance_mm: f64,
    lines: Vec<Part>,
    /// Times of the ends of the polynomials, s, and their cubics, axis by axis.
    times: Vec<f64>,
    cubics: Vec<[f64; 4]>,
}

/// Reads the motion of a program. Refuses what the module names, a program that has no end, moves nothing, or has both
/// lines and polynomials.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let mut state = Sinumerik {
        letters: layout.letters().iter().map(char::to_string).collect(),
        position: vec![None; layout.len()],
        mode: Mode::Rapid,
        inverse_time: false,
        follows_parameter: false,
        feed: None,
        group: Vec::new(),
        virtual_mm: 0.0,
        is_smoothed: false,
        tolerance_mm: 0.0,
        lines: Vec::new(),
        times: vec![0.0],
        cubics: Vec::new(),
    };
    let mut ended = false;
    for (i, line) in text.lines().enumerate() {
        let words = words(i + 1, line)?;
        if ended && !words.is_empty() {
            return Err(wrong(i + 1, "goes on after the end of the program"));
        }
        ended |= state.block(i + 1, &words)?;
    }
    if !ended {
        let remedy = "end it with M30 if it is whole";
        return Err(Invalid::whole("program", "does not end with M30: it was cut off", remedy));
    }
    let n = state.times.len() - 1;
    match (state.lines.is_empty(), n) {
        (true, 0) => Err(Invalid::whole("program", "moves nothing", "give a program with motion")),
        (false, 0) => motion(&state.lines, layout, state.tolerance_mm),
        (true, n) => AxesMotion::new(state.times, state.cubics, vec![true; n], vec![None; n]),
        (false, _) => {
            let problem =
                "has lines and polynomials, whose velocities are not known where they meet";
            Err(Invalid::whole("program", problem, "write all of it as one of them"))
        }
    }
}

impl Sinumerik {
    /// Executes a block; returns true if the program ends with it.
    fn block(&mut self, line: usize, words: &[BlockWord]) -> Result<bool, Invalid> {
        let mut ends: Vec<Option<Vec<f64>>> = vec![None; self.letters.len()];
        let mut virtual_end = None;
        let mut feed = None;
        let mut pl = None;
        let [mut end, mut dwell] = [false; 2];
        for word in words {
            let axis = |name: &str| self.letters.iter().position(|letter| letter == name);
            match word {
                BlockWord::Value(name, v) => match (name.as_str(), axis(name)) {
                    (_, Some(axis)) => set_once(line, name, &mut ends[axis], vec![*v])?,
                    ("G", _) => dwell |= self.code(line, *v)?,
                    ("M", _) if [2.0, 17.0, 30.0].contains(v) => end = true,
                    ("F", _) => set_once(line, name, &mut feed, *v)?,
                    ("PL", _) => set_once(line, name, &mut pl, *v)?,
                    ("CTOL", _) if *v >= 0.0 && self.lines.is_empty() => self.tolerance_mm = *v,
                    ("N", _) => {}
                    _ if self.is_virtual(name) => set_once(line, name, &mut virtual_end, *v)?,
                    _ => {
                        return Err(wrong(line, format!("has {name}{v}, which is not understood")));
                    }
                },
                BlockWord::Element(name, index, values) => match (name.as_str(), axis(index)) {
                    ("PO", Some(axis)) if (1..=3).contains(&values.len()) => {
                        set_once(line, index, &mut ends[axis], values.clone())?;
                        if self.mode != Mode::Polynomial && !words.iter().any(is_poly) {
                            return Err(wrong(line, "has PO without POLY: it would run straight"));
                        }
                    }
                    _ => {
                        let problem = format!("has {name}[{index}], which is not understood");
                        return Err(wrong(line, problem));
                    }
                },
                BlockWord::Call(name, axes) if name == "FGROUP" => {
                    self.group.clone_from(axes);
                }
                BlockWord::Plain(name) if name == "POLY" => self.mode = Mode::Polynomial,
                BlockWord::Plain(name) if name == "UPATH" => self.follows_parameter = true,
                BlockWord::Plain(name) | BlockWord::Call(name, _) => {
                    return Err(wrong(line, format!("has {name}, which is not understood")));
                }
            }
        }
        if let Some(feed) = feed.filter(|f: &f64| *f <= 0.0) {
            return Err(wrong(line, format!("F is {feed}")));
        }
        let moves = virtual_end.is_some() || ends.iter().any(Option::is_some);
        match (dwell, moves) {
            (true, true) => return Err(wrong(line, "has G4 with a motion")),
            (true, false) => self.stand(line, feed)?,
            (false, true) => {
                self.feed = feed.or(self.feed.filter(|_| !self.inverse_time));
                match self.mode {
                    Mode::Rapid => self.start(line, &ends, virtual_end)?,
                    Mode::Line => self.line(line, &ends)?,
                    Mode::Polynomial => self.polynomial(line, &ends, virtual_end, pl)?,
                }
            }
            (false, false) => self.feed = feed.or(self.feed),
        }
        Ok(end)
    }

    /// Returns true if an axis of this name is the only one whose feed is F, and none of the motion, or may become so.
    fn is_virtual(&self, name: &str) -> bool {
        match &self.group[..] {
            [] => self.mode == Mode::Rapid && name == "W",
            [only] => only == name,
            _ => false,
        }
    }

    /// Takes a G code; returns true for a dwell.
    fn code(&mut self, line: usize, v: f64) -> Result<bool, Invalid> {
        let code = if v.fract() == 0.0 && (0.0..1000.0).contains(&v) { v as u32 } else { 1000 };
        match code {
            0 => self.mode = Mode::Rapid,
            1 => self.mode = Mode::Line,
            4 => return Ok(true),
            64 | 642 if self.lines.is_empty() => self.is_smoothed = code == 642,
            93 => self.inverse_time = true,
            94 => self.inverse_time = false,
            code if WITHOUT_EFFECT.contains(&code) => {}
            _ => return Err(wrong(line, format!("has G{v}, which is not understood here"))),
        }
        Ok(false)
    }

    /// Moves to the start by G0.
    fn start(
        &mut self,
        line: usize,
        ends: &[Option<Vec<f64>>],
        virtual_end: Option<f64>,
    ) -> Result<(), Invalid> {
        if !self.lines.is_empty() || !self.cubics.is_empty() {
            return Err(wrong(line, "has G0 within the motion: its time is not known"));
        }
        for (position, end) in self.position.iter_mut().zip(ends) {
            *position = end.as_ref().map(|end| end[0]).or(*position);
        }
        self.virtual_mm = virtual_end.unwrap_or(self.virtual_mm);
        Ok(())
    }

    /// Returns the positions of all axes. Refuses a program that has not yet set them by G0.
    fn here(&self, line: usize) -> Result<Vec<f64>, Invalid> {
        let here: Option<Vec<f64>> = self.position.iter().copied().collect();
        here.ok_or_else(|| {
            let axes = self.letters.join(" ");
            wrong(line, format!("comes before G0 {axes} sets the start"))
        })
    }

    /// Stands for `seconds`.
    fn stand(&mut self, line: usize, seconds: Option<f64>) -> Result<(), Invalid> {
        let seconds = seconds.ok_or_else(|| wrong(line, "has G4 without F, the seconds"))?;
        let states = self.here(line)?.into_iter().map(|p| [p, 0.0]).collect();
        self.lines.push(Part { seconds, states, tool_on: true, is_stop: true });
        Ok(())
    }

    /// Moves straight to `ends` in 60 / F s.
    fn line(&mut self, line: usize, ends: &[Option<Vec<f64>>]) -> Result<(), Invalid> {
        let here = self.here(line)?;
        if !self.inverse_time {
            return Err(wrong(line, "moves by G94; only lines in inverse time (G93) are read"));
        }
        let Some(feed) = self.feed.take() else {
            return Err(wrong(line, "has no F; G93 wants one in every line"));
        };
        if self.letters.iter().any(|l| !self.group.is_empty() && !self.group.contains(l)) {
            return Err(wrong(line, "moves axes that are not in FGROUP: their time is not F's"));
        }
        let to: Vec<f64> = (ends.iter().zip(&here))
            .map(|(end, here)| end.as_ref().map_or(*here, |end| end[0]))
            .collect();
        if to == here {
            return Err(wrong(line, "has no length, so its time is lost"));
        }
        let seconds = 60.0 / feed;
        let states = here.iter().zip(&to).map(|(p, q)| [*p, (q - p) / seconds]).collect();
        self.lines.push(Part { seconds, states, tool_on: true, is_stop: false });
        if !self.is_smoothed {
            self.tolerance_mm = 0.0;
        }
        self.position = to.into_iter().map(Some).collect();
        Ok(())
    }

    /// Moves along the polynomials in `ends`, in the time that the virtual axis needs to `virtual_end`.
    fn polynomial(
        &mut self,
        line: usize,
        ends: &[Option<Vec<f64>>],
        virtual_end: Option<f64>,
        pl: Option<f64>,
    ) -> Result<(), Invalid> {
        let here = self.here(line)?;
        let is_alone = matches!(&self.group[..], [only] if !self.letters.contains(only));
        if !is_alone || !self.follows_parameter || self.inverse_time {
            let problem = "moves by POLY without G94, UPATH and a virtual axis in FGROUP: its time along the path is \
                           not that of the polynomial";
            return Err(wrong(line, problem));
        }
        let feed = self.feed.ok_or_else(|| wrong(line, "has no F before it"))?;
        let end = virtual_end.ok_or_else(|| wrong(line, "does not move the axis in FGROUP"))?;
        let seconds = 60.0 * (end - self.virtual_mm) / feed;
        let pl = pl.unwrap_or(1.0);
        if !(seconds.is_finite() && seconds > 0.0 && PL.contains(&pl)) {
            return Err(wrong(line, format!("lasts {seconds} s with PL={pl}")));
        }
        for (axis, here) in here.into_iter().enumerate() {
            let values = ends[axis].as_deref().unwrap_or(&[]);
            let value = |i: usize| values.get(i).copied().unwrap_or(0.0);
            let [a2, a3] = [value(1), value(2)];
            let end = values.first().copied().unwrap_or(here);
            // f(PL) = end:  a1 = (end - a0) / PL - a2 PL - a3 PL^2
            let a1 = (end - here) / pl - a2 * pl - a3 * pl * pl;
            // p = u PL / T
            let s = pl / seconds;
            self.cubics.push([here, a1 * s, a2 * s * s, a3 * s * s * s]);
            self.position[axis] = Some(end);
        }
        self.times.push(self.times[self.times.len() - 1] + seconds);
        self.virtual_mm = end;
        Ok(())
    }
}

fn is_poly(word: &BlockWord) -> bool {
    matches!(word, BlockWord::Plain(name) if name == "POLY")
}

/// Sets a value that a block states once.
fn set_once<T>(line: usize, name: &str, slot: &mut Option<T>, value: T) -> Result<(), Invalid> {
    match slot.replace(value) {
        None => Ok(()),
        Some(_) => Err(wrong(line, format!("has {name} twice"))),
    }
}

/// Splits a block into words; a comment is left out. Refuses text that is no word, and a block that a switch of the
/// machine may leave out.
fn words(line: usize, text: &str) -> Result<Vec<BlockWord>, Invalid> {
    let plain = text.split(';').next().unwrap_or_default().to_uppercase();
    let mut rest = plain.trim();
    let mut words = Vec::new();
    while !rest.is_empty() {
        let letters = rest.find(|c: char| !(c.is_ascii_alphabetic() || c == '_'));
        let (name, after) = rest.split_at(letters.unwrap_or(rest.len()));
        let not_understood = || {
            let short: String = rest.chars().take(20).collect();
            wrong(line, format!("has {short:?}, which is not understood"))
        };
        if name.is_empty() {
            return Err(not_understood());
        }
        let (word, left) = if let Some(inner) = after.strip_prefix('(') {
            let (list, left) = inner.split_once(')').ok_or_else(not_understood)?;
            let names = list.split(',').map(|a| a.trim().to_string()).filter(|a| !a.is_empty());
            (BlockWord::Call(name.into(), names.collect()), left)
        } else if let Some(inner) = after.strip_prefix('[') {
            let (index, value) = inner.split_once("]=(").ok_or_else(not_understood)?;
            let (list, left) = value.split_once(')').ok_or_else(not_understood)?;
            let numbers: Result<_, _> = list.split(',').map(|v| finite(line, v)).collect();
            (BlockWord::Element(name.into(), index.into(), numbers?), left)
        } else {
            let number = after.strip_prefix('=').unwrap_or(after);
            let digits = number.find(|c: char| !(c.is_ascii_digit() || "+-.".contains(c)));
            let (number, left) = number.split_at(digits.unwrap_or(number.len()));
            match (number.is_empty(), name.len() == 1 || after.starts_with('=')) {
                (true, _) if after.starts_with('=') => return Err(not_understood()),
                (true, _) => (BlockWord::Plain(name.into()), left),
                (false, true) => (BlockWord::Value(name.into(), finite(line, number)?), left),
                (false, false) => return Err(not_understood()),
            }
        };
        words.push(word);
        rest = left.trim_start();
    }
    Ok(words)
}
