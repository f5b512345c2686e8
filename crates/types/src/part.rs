//! Statements of a user about a part, for the head of a report and of a program.

use serde::{Deserialize, Serialize};

/// Statements of a user about the part. None has a default: the date, too, is the user's and not that of a clock.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// Name of the part.
    pub name: Option<String>,
    /// Number of the part, or of its order.
    pub number: Option<String>,
    /// Date, as the user writes it.
    pub date: Option<String>,
    /// Person who runs the machine.
    pub operator: Option<String>,
}

impl Part {
    /// Returns the statements as one line, such as `part M1, number 47-11`; empty if there are none.
    pub fn line(&self) -> String {
        let all = [
            ("part", &self.name),
            ("number", &self.number),
            ("date", &self.date),
            ("operator", &self.operator),
        ];
        let mut stated = Vec::new();
        for (what, value) in all {
            if let Some(value) = value {
                stated.push(format!("{what} {value}"));
            }
        }
        stated.join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_stated_is_left_out() {
        assert_eq!(Part::default().line(), "");
        let [number, date] = ["47-11", "2026-03-01"].map(|text| Some(text.to_string()));
        let part = Part { number, date, ..Part::default() };
        assert_eq!(part.line(), "number 47-11, date 2026-03-01");
    }
}
