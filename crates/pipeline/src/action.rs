//! The two forms of a line in a stage of a pipeline: a command to run, or the call of another stage.

use planish_handoff::words;

use crate::phrase::is_name;

/// Verbs that earlier versions of the pipelines had, each with the advice for a message on what to write instead.
const REPLACED: [(&str, &str); 6] = [
    ("quietly", "give the command a flag for it, such as --quiet of planish compare report"),
    (
        "attempt",
        "state the directory as `optional` of a stage, and the command as the first of its `steps`",
    ),
    ("leave-out", "end the line that names the stage with `when`"),
    (
        "copy",
        "name the artifact where it is, by a value such as tool_path: [\"{path} when path\", ...]",
    ),
    ("choose", "write {recommended}, which is the plan that the report recommends"),
    ("say", "state the text as `note` of a stage"),
];

/// A line of a stage, after it is read: a command, or a call of another stage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Action<'a> {
    /// Command of the form `planish-NAME WORD... [?]`.
    Command {
        /// Program and arguments of the command, with names in braces still unexpanded.
        text: &'a str,
        /// True if the line ends with a question mark: a negative verdict (exit code 1) then lets the run go on.
        may_be_negative: bool,
    },
    /// Call of the form `STAGE NAME=VALUE...`: name of the stage, and the names with the values they have in it.
    Stage(String, Vec<(String, String)>),
}

impl<'a> Action<'a> {
    /// Reads a line of a stage.
    ///
    /// # Errors
    /// Fails with a message if the line has the form of neither a command nor a call; whether the stage exists is not
    /// checked here. For a word of earlier pipelines the message names its replacement.
    pub fn read(text: &'a str) -> Result<Self, String> {
        let verb = text.split(' ').next().unwrap_or_default();
        if verb.starts_with("planish-") {
            let command = text.strip_suffix(" ?");
            return Ok(Self::Command {
                text: command.unwrap_or(text),
                may_be_negative: command.is_some(),
            });
        }
        if let Some((_, remedy)) = REPLACED.iter().find(|(word, _)| *word == verb) {
            return Err(format!("pipelines have no '{verb}' any more; {remedy}"));
        }
        call(text)
    }

    /// Returns the name of the stage that the line calls; `None` if the line is a command.
    pub fn stage(&self) -> Option<&str> {
        match self {
            Self::Stage(stage, _) => Some(stage),
            Self::Command { .. } => None,
        }
    }
}

fn call(text: &str) -> Result<Action<'_>, String> {
    let split = words::split(text).map_err(|e| e.to_string())?;
    let mut split = split.into_iter();
    let stage = split.next().ok_or("the line is empty; leave it out")?;
    let mut values = Vec::new();
    for word in split {
        let Some((name, value)) = word.split_once('=').filter(|(name, _)| is_name(name)) else {
            return Err(format!(
                "'{word}' is no NAME=VALUE of the stage '{stage}'; a command begins with planish-"
            ));
        };
        values.push((name.to_string(), value.to_string()));
    }
    Ok(Action::Stage(stage, values))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_line_is_refused() {
        for text in ["rm x", "one x", "one 'x", ""] {
            assert!(Action::read(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_word_of_earlier_pipelines_names_its_replacement() {
        for (text, remedy) in [
            ("say the end", "`note`"),
            ("attempt d planish-x", "`optional`"),
            ("quietly planish-x", "--quiet"),
            ("copy a b", "by a value"),
            ("leave-out d not wanted", "`when`"),
            ("choose plan otherwise pvt tried by export", "{recommended}"),
        ] {
            let message = Action::read(text).unwrap_err();
            assert!(message.contains("any more") && message.contains(remedy), "{message}");
        }
    }
}
