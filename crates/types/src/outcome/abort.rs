//! Outcomes about a run that was interrupted.

use std::fmt::{self, Display};

use serde::{Deserialize, Serialize};

/// Outcome of `planish schedule abort`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AbortOutcome {
    /// Duration of the executed motion, with its stop and the time of the tool after it, s.
    pub executed_s: f64,
    /// Place [x, y] where the machine stands, mm.
    pub place_mm: [f64; 2],
}

/// Outcome of `planish resume`: its file `resume.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResumeOutcome {
    /// Motion that was executed.
    pub executed: AbortOutcome,
    /// Residual RMS of the run without the abort, nm.
    pub undisturbed_rms_nm: f64,
    /// Time of the undisturbed run, s.
    pub undisturbed_s: f64,
    /// Pixel where the executed motion removed most beyond the whole plan.
    pub mark: MarkOutcome,
    /// Ways to finish the part, in the order in which they were planned.
    pub ways: Vec<WayOutcome>,
    /// Name of the recommended way.
    pub recommended: String,
    /// True if the recommended way leaves at most 1.05 times the residual of the undisturbed run.
    pub is_mended: bool,
}

/// A mark: place and depth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MarkOutcome {
    /// Depth, nm; 0 for none.
    pub depth_nm: f64,
    /// Pixel [x, y], mm.
    pub place_mm: [f64; 2],
}

/// A way to finish the part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WayOutcome {
    /// Name of the way: `stop`, `same-path` or `new-path`.
    pub name: String,
    /// Predicted residual RMS of the whole map, nm.
    pub rms_nm: f64,
    /// Time of the rest, s.
    pub time_s: f64,
    /// Pixel where the residual is deepest below that of the undisturbed run, both without their means.
    pub mark: MarkOutcome,
    /// Directory of the plan, its residual and its verdict.
    pub plan: String,
    /// True if a verdict of the plan is negative.
    pub is_negative: bool,
}

/// Part of the file beside a program that says where its lines are.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct MarkedProgram {
    /// Marks of the program, one per segment, in the order of its lines.
    pub marks: Vec<ProgramMark>,
    /// Duration of the program, s.
    pub total_time_s: f64,
}

/// Mark of a program: the line of a segment, and time and position at which the segment begins. A file has it as the
/// text `LINE TIME_S POSITION...`, which a person can search for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct ProgramMark {
    /// Number of the first line of the segment, from 1.
    pub line: usize,
    /// Time since the start of the motion, s.
    pub time_s: f64,
    /// Position of every axis, mm or deg.
    pub position: Vec<f64>,
}

impl Display for ProgramMark {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {:.6}", self.line, self.time_s)?;
        self.position.iter().try_for_each(|p| write!(f, " {p:.6}"))
    }
}

impl From<ProgramMark> for String {
    fn from(mark: ProgramMark) -> Self {
        mark.to_string()
    }
}

impl TryFrom<String> for ProgramMark {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let refusal = || format!("mark {text:?} is not LINE TIME_S POSITION...");
        let (line, numbers) = text.split_once(' ').ok_or_else(refusal)?;
        let line = line.parse().map_err(|_| refusal())?;
        let numbers: Result<Vec<f64>, _> = numbers.split(' ').map(str::parse).collect();
        match numbers.map_err(|_| refusal())?.split_first() {
            Some((time_s, position)) => {
                Ok(Self { line, time_s: *time_s, position: position.to_vec() })
            }
            None => Err(refusal()),
        }
    }
}

impl MarkedProgram {
    /// Returns the times at which the segment of this line begins and ends, s; `None` for a line before the motion.
    pub fn times_s(&self, line: usize) -> Option<[f64; 2]> {
        let after = self.marks.partition_point(|mark| mark.line <= line);
        let begin_s = self.marks.get(after.checked_sub(1)?)?.time_s;
        Some([begin_s, self.marks.get(after).map_or(self.total_time_s, |mark| mark.time_s)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_between_two_marks_belongs_to_the_first() {
        let text =
            r#"{ "marks": ["7 0.000000 1.0 -2.5", "9 0.250000 1.5 -2.5"], "total_time_s": 1.0 }"#;
        let program: MarkedProgram = serde_json::from_str(text).unwrap();
        assert_eq!(program.marks[0].position, [1.0, -2.5]);
        assert_eq!(program.marks[1].to_string(), "9 0.250000 1.500000 -2.500000");
        for (line, times) in
            [(6, None), (7, Some([0.0, 0.25])), (8, Some([0.0, 0.25])), (99, Some([0.25, 1.0]))]
        {
            assert_eq!(program.times_s(line), times);
        }
        for wrong in ["", "7", "7 x", "x 1 2"] {
            assert!(ProgramMark::try_from(wrong.to_string()).is_err(), "{wrong:?}");
        }
    }
}
