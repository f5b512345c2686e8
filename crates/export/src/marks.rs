//! Marks of a program: line, time and position of every segment, so that the line of an abort is found.

use planish_types::outcome::abort::ProgramMark;
use serde::Serialize;

/// Marks of a program, while its text grows.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Marks {
    /// One mark per segment, in the order of their lines.
    all: Vec<ProgramMark>,
    /// Number of bytes of the text whose lines are counted.
    #[serde(skip)]
    bytes: usize,
    /// Number of lines that end within these bytes.
    #[serde(skip)]
    lines: usize,
}

impl Marks {
    /// Returns the number of the line of mark `index`, from 1; 0 if there is no such mark.
    pub(crate) fn line(&self, index: usize) -> usize {
        self.all.get(index).map_or(0, |mark| mark.line)
    }

    /// Returns all marks, in the order of their lines.
    pub fn all(&self) -> &[ProgramMark] {
        &self.all
    }

    /// Returns these marks as those of a text of their own.
    pub(crate) fn from_list(all: Vec<ProgramMark>) -> Self {
        Self { all, ..Self::default() }
    }

    /// Marks the end of `text`, at which the first line of a segment follows. The segment begins at `time_s` with the
    /// axes at `position`.
    pub(crate) fn add<const N: usize>(&mut self, text: &str, time_s: f64, position: [f64; N]) {
        let new = &text.as_bytes()[self.bytes..];
        self.lines += new.iter().filter(|byte| **byte == b'\n').count();
        self.bytes = text.len();
        let position = position.to_vec();
        self.all.push(ProgramMark { line: self.lines + 1, time_s, position });
    }
}
