//! Types of settings, which check a value before anything runs.

use planish_handoff::words;
use planish_types::ControllerKind;

/// Type of a setting. Each variant quotes the words that name the type in a definition file.
#[derive(Clone, Debug, PartialEq)]
pub enum Kind {
    /// `word`: any text without further checks.
    Word,
    /// `path`: a path, relative to the directory in which the user works.
    Path,
    /// `flags`: several words, separated and quoted as in a shell.
    Flags,
    /// `number above 0`, `number from 0`, `number from 0 to 1`: a finite number.
    Number {
        /// Lower bound of the number.
        least: f64,
        /// True if the lower bound itself is allowed.
        closed: bool,
        /// Upper bound, which itself is allowed; `None` for no bound.
        most: Option<f64>,
    },
    /// `whole number from 1 to 99`: an integer without sign, written with digits only.
    Whole {
        /// Smallest allowed value.
        least: u64,
        /// Largest allowed value; `None` for no bound.
        most: Option<u64>,
    },
    /// `one of x, y, or a number`: one of these words, or a number if that is allowed. `controller`: one of the
    /// motion controllers for which Planish writes programs.
    OneOf {
        /// The allowed words.
        words: Vec<String>,
        /// True if a number is allowed, too.
        number: bool,
    },
}

impl Kind {
    /// Reads the type that a definition names; returns `None` if there is no such type.
    pub fn read(text: &str) -> Option<Self> {
        if let Some(list) = text.strip_prefix("one of ") {
            let before_number = list.strip_suffix(", or a number");
            let words = before_number.unwrap_or(list).split(", ").map(String::from).collect();
            return Some(Self::OneOf { words, number: before_number.is_some() });
        }
        if let Some(range) = text.strip_prefix("whole number from ") {
            let (least, most) =
                range.split_once(" to ").map_or((range, None), |(a, b)| (a, Some(b)));
            let most = most.map(str::parse).transpose().ok()?;
            return Some(Self::Whole { least: least.parse().ok()?, most });
        }
        if let Some(least) = text.strip_prefix("number above ") {
            return Some(Self::Number { least: least.parse().ok()?, closed: false, most: None });
        }
        if let Some(range) = text.strip_prefix("number from ") {
            let (least, most) =
                range.split_once(" to ").map_or((range, None), |(a, b)| (a, Some(b)));
            let most = most.map(str::parse).transpose().ok()?;
            return Some(Self::Number { least: least.parse().ok()?, closed: true, most });
        }
        match text {
            "controller" => {
                let words = ControllerKind::ALL.map(|kind| kind.name().into()).to_vec();
                Some(Self::OneOf { words, number: false })
            }
            "word" => Some(Self::Word),
            "path" => Some(Self::Path),
            "flags" => Some(Self::Flags),
            _ => None,
        }
    }

    /// Returns true if a value is a number or one of the words of the setting, so that it can name no file.
    pub fn is_plain(&self) -> bool {
        matches!(self, Self::Number { .. } | Self::Whole { .. } | Self::OneOf { .. })
    }

    /// Describes the allowed values, as a phrase that follows `give` in a message.
    pub fn wanted(&self) -> String {
        match self {
            Self::Word => "a word".into(),
            Self::Path => "a path".into(),
            Self::Flags => "flags".into(),
            Self::Number { least, closed: false, .. } => format!("a number above {least}"),
            Self::Number { least, most: None, .. } => format!("a number of {least} or more"),
            Self::Number { least, most: Some(most), .. } => {
                format!("a number from {least} to {most}")
            }
            Self::Whole { least, most: None } => format!("a whole number of {least} or more"),
            Self::Whole { least, most: Some(most) } => {
                format!("a whole number from {least} to {most}")
            }
            Self::OneOf { words, number: true } => format!("{} or a number", words.join(", ")),
            Self::OneOf { words, number: false } => match words.split_last() {
                Some((last, rest)) if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
                _ => words.concat(),
            },
        }
    }

    /// Checks a value of the setting; an empty value must not be passed.
    ///
    /// # Errors
    /// Fails with a message, without the name of the setting, if the value does not fit.
    pub fn check(&self, value: &str) -> Result<(), String> {
        let number = value.parse::<f64>().ok().filter(|x| x.is_finite());
        let fits = match self {
            Self::Word | Self::Path => true,
            Self::Flags => return words::split(value).map(|_| ()).map_err(|e| e.to_string()),
            Self::Number { least, closed, most } => number.is_some_and(|x| {
                (x > *least || *closed && x == *least) && most.is_none_or(|most| x <= most)
            }),
            Self::Whole { least, most } => {
                let digits = value.bytes().all(|b| b.is_ascii_digit())
                    && (value == "0" || !value.starts_with('0'));
                let number = value.parse::<u64>().ok().filter(|_| digits);
                number.is_some_and(|x| x >= *least && most.is_none_or(|most| x <= most))
            }
            Self::OneOf { words, number: allowed } => {
                words.iter().any(|word| word == value) || *allowed && number.is_some()
            }
        };
        if fits { Ok(()) } else { Err(self.wanted()) }
    }
}

/// Endings of the names of settings with the unit that each ending stands for, the longest first.
const UNITS: [(&str, &str); 9] = [
    ("_nm2_per_s", "nm^2/s"),
    ("_s_per_mm", "s/mm"),
    ("_mm_per_s", "mm/s"),
    ("_percent", "%"),
    ("_mm2", "mm^2"),
    ("_deg", "degree"),
    ("_mm", "mm"),
    ("_nm", "nm"),
    ("_s", "s"),
];

/// Returns the unit of the setting `name`, from the ending of the name; empty if it has no unit.
pub fn unit(name: &str) -> &'static str {
    UNITS.iter().find(|(end, _)| name.ends_with(end)).map_or("", |(_, unit)| unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_takes_its_values_and_no_others() {
        for (kind, good, bad) in [
            (
                "number above 0",
                &["1", "1e-3", "0.5"][..],
                &["0", "-1", "x", "inf", "1 mm", "1; x"][..],
            ),
            ("number from 0", &["0", "2"], &["-0.1", "nan"]),
            ("number from 0 to 1", &["0", "1"], &["1.1"]),
            ("whole number from 1 to 99", &["1", "99"], &["0", "100", "01", "+1", "1.0", "x"]),
            ("whole number from 0", &["0", "18446744073709551615"], &["-1"]),
            ("one of yes, no", &["yes", "no"], &["maybe", "yes, no"]),
            ("one of x, y, or a number", &["x", "30", "-1.5"], &["z", "$(x)"]),
            ("flags", &["--a 'b c'"], &["--a 'b"]),
            ("path", &["-x", "a b"], &[]),
        ] {
            let read = Kind::read(kind).unwrap();
            for value in good {
                assert_eq!(read.check(value), Ok(()), "{kind}: {value}");
            }
            for value in bad {
                assert!(read.check(value).is_err(), "{kind}: {value}");
            }
        }
        assert_eq!(Kind::read("number"), None);
        assert_eq!(Kind::read("one of galil, xps, csv").unwrap().wanted(), "galil, xps or csv");
        let controllers = "galil, xps, xps-pt, pmac, gcode, csv, ros, aerotech, automation1, sinumerik, \
                           sinumerik-poly, twincat or zaber";
        assert_eq!(Kind::read("controller").unwrap().wanted(), controllers);
    }

    #[test]
    fn the_unit_is_the_end_of_the_name() {
        for (name, expected) in [
            ("pitch_mm", "mm"),
            ("time_weight_nm2_per_s", "nm^2/s"),
            ("min_dwell_s_per_mm", "s/mm"),
            ("min_area_mm2", "mm^2"),
            ("cycle_s", "s"),
            ("passes", ""),
        ] {
            assert_eq!(unit(name), expected, "{name}");
        }
    }
}
