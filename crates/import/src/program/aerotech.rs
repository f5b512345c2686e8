//! Aerotech Ensemble, AeroBasic: `PVT X p,v Y p,v TIME t` per segment, in mm and mm/s (degrees and deg/s), with
//! absolute positions. After `PVT INIT TIME ABS` the time counts since the start, after `PVT INIT TIME INC` since the
//! line before.
//!
//! | statement | meaning |
//! |---|---|
//! | `PROGRAM`, `END PROGRAM` | begin and end |
//! | `ABS` | positions are absolute |
//! | `VELOCITY ON` | the velocity goes on from line to line |
//! | `LINEAR X p Y p F v` | the way to the start, before the first `PVT` |
//! | `PLANE`, `RECONCILE`, `ENABLE`, `WAIT MOVEDONE`, `RAMP` | no motion |
//!
//! A quotation mark `'` begins a comment. Capital and small letters are the same. The program switches no tool.
//!
//! Source: EPICS motor module, `AerotechSrc/doCommand.ab`; Lauecollect, `image_scan.py`.

use planish_types::{AxesMotion, Invalid};

use super::{Knot, Layout, finite, needed, through, wrong};

/// Statements that move nothing and change no later motion.
const NO_MOTION: [&str; 5] = ["PLANE ", "RECONCILE ", "ENABLE ", "WAIT MOVEDONE", "RAMP "];

/// Origin of the times of the lines.
#[derive(Clone, Copy)]
enum Clock {
    /// Times count since the start of the motion.
    SinceStart,
    /// Times count since the end of the line before.
    SinceLineBefore,
}

/// Settings of the lines before, and the motion up to them.
struct AerotechState<'a> {
    layout: &'a Layout,
    letters: Vec<char>,
    start: Option<Vec<f64>>,
    absolute: bool,
    keeps_velocity: bool,
    clock: Option<Clock>,
    ended: bool,
    knots: Vec<Knot>,
}

/// Reads the motion of an AeroBasic program, with a cubic per `PVT` line. Refuses statements that it does not know,
/// relative positions, lines before `VELOCITY ON` and `PVT INIT`, times that do not ascend, lines without all axes,
/// motion after the first `PVT` that is none, a velocity at the end, and a program without `END PROGRAM`.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let mut state = AerotechState {
        layout,
        letters: layout.letters(),
        start: layout.start.clone(),
        absolute: false,
        keeps_velocity: false,
        clock: None,
        ended: false,
        knots: Vec::new(),
    };
    for (i, line) in text.lines().enumerate() {
        let statement = line.split('\'').next().unwrap_or_default().to_uppercase();
        let words: Vec<&str> = statement.split_whitespace().collect();
        if !words.is_empty() {
            state.take(i + 1, &words.join(" "))?;
        }
    }
    if !state.ended {
        let remedy = "end it with END PROGRAM, or export it again: it was cut off";
        return Err(Invalid::whole("program", "has no END PROGRAM", remedy));
    }
    if let Some(last) = state.knots.last().filter(|last| last.velocity.iter().any(|v| *v != 0.0)) {
        let problem = format!("ends with the velocity {:?} mm/s or deg/s", last.velocity);
        return Err(Invalid::whole("program", problem, "end it at rest"));
    }
    through(&state.knots)
}

impl AerotechState<'_> {
    /// Takes one statement, in capitals and with single blanks; `line` is the number of its line.
    fn take(&mut self, line: usize, statement: &str) -> Result<(), Invalid> {
        let moves = !self.knots.is_empty();
        if self.ended {
            return Err(wrong(line, format!("has \"{statement}\" after END PROGRAM")));
        }
        match statement {
            "PROGRAM" if !moves => Ok(()),
            "ABS" if !moves => {
                self.absolute = true;
                Ok(())
            }
            "VELOCITY ON" => {
                self.keeps_velocity = true;
                Ok(())
            }
            "VELOCITY OFF" => {
                self.keeps_velocity = false;
                Ok(())
            }
            "PVT INIT TIME ABS" if !moves => {
                self.clock = Some(Clock::SinceStart);
                Ok(())
            }
            "PVT INIT TIME INC" if !moves => {
                self.clock = Some(Clock::SinceLineBefore);
                Ok(())
            }
            "END PROGRAM" => {
                self.ended = true;
                Ok(())
            }
            _ if NO_MOTION.iter().any(|word| statement.starts_with(word)) => Ok(()),
            _ => match (statement.strip_prefix("PVT "), statement.strip_prefix("LINEAR ")) {
                (Some(words), _) if !words.starts_with("INIT ") => self.segment(line, words),
                (None, Some(words)) if !moves => self.approach(line, words),
                _ => Err(wrong(line, format!("has \"{statement}\", which is not understood here"))),
            },
        }
    }

    /// Takes the way to the start, `X p Y p F v`. Refuses it with relative positions, or without all axes.
    fn approach(&mut self, line: usize, words: &str) -> Result<(), Invalid> {
        let places = words.split(" F ").next().unwrap_or_default();
        if !self.absolute {
            return Err(wrong(line, "goes to the start before ABS"));
        }
        let start = self.numbers::<1>(line, places)?;
        self.start = Some(start.into_iter().map(|[p]| p).collect());
        Ok(())
    }

    /// Takes a segment, `X p,v Y p,v TIME t`.
    fn segment(&mut self, line: usize, words: &str) -> Result<(), Invalid> {
        let Some((states, time)) = words.split_once(" TIME ") else {
            return Err(wrong(line, "has no TIME"));
        };
        let Some(clock) = self.clock.filter(|_| self.absolute && self.keeps_velocity) else {
            return Err(wrong(line, "comes before ABS, VELOCITY ON and PVT INIT TIME"));
        };
        if self.knots.is_empty() {
            let position = needed("start_mm", self.start.clone())?;
            let velocity = vec![0.0; self.layout.len()];
            self.knots.push(Knot { time_s: 0.0, position, velocity, tool_on: true });
        }
        let before_s = self.knots[self.knots.len() - 1].time_s;
        let stated_s = finite(line, time)?;
        let time_s = match clock {
            Clock::SinceStart => stated_s,
            Clock::SinceLineBefore => before_s + stated_s,
        };
        if time_s <= before_s {
            return Err(wrong(
                line,
                format!("ends at {time_s} s, the line before at {before_s} s"),
            ));
        }
        let states = self.numbers::<2>(line, states)?;
        self.knots.push(Knot {
            time_s,
            position: states.iter().map(|[p, _]| *p).collect(),
            velocity: states.iter().map(|[_, v]| *v).collect(),
            tool_on: true,
        });
        Ok(())
    }

    /// Returns the `K` numbers of every axis, in the order of the axes, from words such as `X 1,0 Y 2,0`. Refuses words
    /// without all axes, each once.
    fn numbers<const K: usize>(&self, line: usize, words: &str) -> Result<Vec<[f64; K]>, Invalid> {
        let spaced = words.replace(',', " ");
        let words: Vec<&str> = spaced.split_whitespace().collect();
        let mut numbers = vec![None; self.letters.len()];
        for group in words.chunks(1 + K) {
            let axis = self.letters.iter().position(|letter| group[0] == letter.to_string());
            let Some(axis) = axis.filter(|axis| group.len() == 1 + K && numbers[*axis].is_none())
            else {
                let names: Vec<String> = self.letters.iter().map(char::to_string).collect();
                let expected = format!("each of {} once, with {K} number(s)", names.join(", "));
                return Err(wrong(line, format!("has \"{}\", not {expected}", group.join(" "))));
            };
            let mut values = [0.0; K];
            for (value, word) in values.iter_mut().zip(&group[1..]) {
                *value = finite(line, word)?;
            }
            numbers[axis] = Some(values);
        }
        let all: Option<Vec<[f64; K]>> = numbers.into_iter().collect();
        all.ok_or_else(|| {
            wrong(line, "does not have all axes: what moves without them is not stated")
        })
    }
}
