//! Lines of a stage: a command, another stage, or one of a few words.

use planish_handoff::words;

use crate::phrase::is_name;

/// A line of a stage, as it is read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Action<'a> {
    /// `[quietly | attempt DIR] planish-NAME WORD... [?]`
    Command {
        /// Words of the command.
        text: &'a str,
        /// True without standard output.
        is_quiet: bool,
        /// Directory of an attempt; if it stands for nothing, the command may not refuse.
        attempt: Option<&'a str>,
        /// True with a question mark.
        may_be_negative: bool,
    },
    /// `leave-out DIR REASON`
    LeaveOut(&'a str, &'a str),
    /// `say TEXT`
    Say(&'a str),
    /// `copy FROM TO`
    Copy(&'a str, &'a str),
    /// `choose NAME otherwise VALUE [tried by STAGE]`
    Choose {
        /// Name.
        to: &'a str,
        /// Value.
        otherwise: &'a str,
        /// Stage.
        tried_by: Option<&'a str>,
    },
    /// `STAGE NAME=VALUE...`
    Stage(String, Vec<(String, String)>),
}

impl<'a> Action<'a> {
    /// Reads a line.
    pub fn read(text: &'a str) -> Result<Self, String> {
        let (verb, rest) = text.split_once(' ').unwrap_or((text, ""));
        let rest = rest.trim();
        let words: Vec<&str> = rest.split_whitespace().collect();
        match (verb, &words[..]) {
            ("say", [_, ..]) => Ok(Self::Say(rest)),
            ("leave-out", [dir, _, ..]) => Ok(Self::LeaveOut(dir, rest[dir.len()..].trim())),
            ("copy", [from, to]) => Ok(Self::Copy(from, to)),
            ("choose", [to, "otherwise", otherwise]) => {
                Ok(Self::Choose { to, otherwise, tried_by: None })
            }
            ("choose", [to, "otherwise", otherwise, "tried", "by", stage]) => {
                Ok(Self::Choose { to, otherwise, tried_by: Some(stage) })
            }
            ("quietly", _) => command(rest, true, None),
            ("attempt", [dir, _, ..]) => command(rest[dir.len()..].trim(), false, Some(dir)),
            _ if verb.starts_with("planish-") => command(text, false, None),
            _ => call(text),
        }
    }

    /// Stages that the line names.
    pub fn stages(&self) -> impl Iterator<Item = &str> {
        let stage = match self {
            Self::Stage(stage, _) => Some(stage.as_str()),
            Self::Choose { tried_by, .. } => *tried_by,
            _ => None,
        };
        stage.into_iter()
    }

    /// Names that the line gives to the stage that it names.
    pub fn gives(&self) -> Vec<String> {
        match self {
            Self::Stage(_, values) => values.iter().map(|(name, _)| name.clone()).collect(),
            _ => vec![],
        }
    }
}

fn command<'a>(
    text: &'a str,
    is_quiet: bool,
    attempt: Option<&'a str>,
) -> Result<Action<'a>, String> {
    if !text.starts_with("planish-") {
        return Err("a command begins with the name of a program, planish-NAME".into());
    }
    let (text, may_be_negative) =
        text.strip_suffix(" ?").map_or((text, false), |text| (text, true));
    Ok(Action::Command { text, is_quiet, attempt, may_be_negative })
}

fn call(text: &str) -> Result<Action<'_>, String> {
    let split = words::split(text).map_err(|e| e.to_string())?;
    let mut split = split.into_iter();
    let stage = split.next().ok_or("the line is empty; leave it out")?;
    let value = |word: String| match word.split_once('=') {
        Some((name, value)) if is_name(name) => Ok((name.to_string(), value.to_string())),
        _ => Err(format!(
            "'{word}' is no NAME=VALUE of the stage '{stage}'; a command begins with planish-"
        )),
    };
    let values = split.map(value).collect::<Result<_, String>>()?;
    Ok(Action::Stage(stage, values))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_line_is_refused() {
        for text in ["quietly rm x", "attempt d rm x", "one x", "one 'x", "choose a b", "copy a"] {
            assert!(Action::read(text).is_err(), "{text}");
        }
    }
}
