//! The steps of a stage, made one by one. A later step may depend on what an earlier one found, so they are not a
//! list.

use std::collections::BTreeMap;

use planish_handoff::{as_command, words};

use crate::{
    action::Action,
    phrase::{DefinitionLine, Term},
    scope::{Origins, Scope, Words},
};

/// A command of a stage: a program with its arguments, and how to treat its failure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StageCommand {
    /// Name of the program.
    pub program: String,
    /// Arguments of the program, fully expanded.
    pub arguments: Vec<String>,
    /// True if a negative verdict, exit code 1, lets the run go on.
    pub may_be_negative: bool,
    /// Directory for the message of the command, if the command may refuse: the stage then ends, and the run goes on.
    /// `None` if a refusal ends the run.
    pub refusal_dir: Option<String>,
    /// Settings that give the flags of the command.
    pub origins: Origins,
}

/// Next action of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// Run this command.
    Run(StageCommand),
    /// Show this sentence to the user.
    Say(String),
}

/// A running stage: the lines that are left, and the words that its call gave to names.
#[derive(Clone)]
struct Frame<'a> {
    lines: std::slice::Iter<'a, DefinitionLine>,
    /// Directory for the message of the first command; `None` if that may not refuse, and after it has been made.
    optional: Option<&'a DefinitionLine>,
    note: Option<&'a DefinitionLine>,
    local: Words,
    /// Settings that give the flags in the words of `local`.
    origins: BTreeMap<String, Origins>,
}

/// Execution state of a stage: the stages that are running, the innermost last, and the settings.
#[derive(Clone)]
pub struct Walk<'a> {
    /// Settings, values and facts; the caller may change them between two steps, for the steps that follow.
    pub scope: Scope<'a>,
    frames: Vec<Frame<'a>>,
}

impl<'a> Walk<'a> {
    /// Begins the steps of the stage named `stage`.
    ///
    /// # Errors
    /// Fails with a message if there is no such stage.
    pub fn new(scope: Scope<'a>, stage: &str) -> Result<Self, String> {
        let mut walk = Self { scope, frames: vec![] };
        walk.enter(stage, Words::new(), BTreeMap::new())?;
        Ok(walk)
    }

    /// Returns all commands of a stage at once. This requires that no step depends on the result of another one.
    ///
    /// # Errors
    /// Fails with a message where [`Walk::new`] or [`Walk::step`] does.
    pub fn commands(scope: Scope<'a>, stage: &str) -> Result<Vec<StageCommand>, String> {
        let mut walk = Self::new(scope, stage)?;
        let mut commands = Vec::new();
        while let Some(step) = walk.step()? {
            if let Step::Run(command) = step {
                commands.push(command);
            }
        }
        Ok(commands)
    }

    /// Makes the next step; returns `None` after the last one.
    ///
    /// # Errors
    /// Fails with a message if a line is no step, or if a name in it stands for nothing.
    pub fn step(&mut self) -> Result<Option<Step>, String> {
        while let Some(frame) = self.frames.last_mut() {
            let Some(DefinitionLine { text, condition }) = frame.lines.next() else {
                let note = frame.note;
                let text = self.text_of(note)?;
                self.frames.pop();
                if text.is_some() {
                    return Ok(text.map(Step::Say));
                }
                continue;
            };
            if !self.holds(condition)? {
                continue;
            }
            match Action::read(text)? {
                Action::Stage(stage, values) => {
                    let (mut local, mut origins) = (self.local().clone(), self.origins().clone());
                    for (name, value) in values {
                        let words = self.scope.expand(&value, self.local())?;
                        origins.insert(name.clone(), self.origins_of(&value)?);
                        local.insert(name, words);
                    }
                    self.enter(&stage, local, origins)?;
                }
                Action::Command { text, may_be_negative } => {
                    return self.command(text, may_be_negative).map(|made| Some(Step::Run(made)));
                }
            }
        }
        Ok(None)
    }

    /// Ends the innermost running stage without its note. The stage that called it goes on.
    pub fn leave(&mut self) {
        self.frames.pop();
    }

    fn enter(
        &mut self,
        stage: &str,
        local: Words,
        origins: BTreeMap<String, Origins>,
    ) -> Result<(), String> {
        let definition = self.scope.definition;
        let stage = definition.stage(stage).ok_or_else(|| {
            let all: Vec<&str> = definition.stages.iter().map(|(name, _)| name.as_str()).collect();
            format!("{} has no stage '{stage}'; there are: {}", definition.name, all.join(" "))
        })?;
        let lines = stage.steps.iter();
        let optional = stage.optional.as_ref();
        self.frames.push(Frame { lines, optional, note: stage.note.as_ref(), local, origins });
        Ok(())
    }

    fn local(&self) -> &Words {
        const NONE: &Words = &Words::new();
        self.frames.last().map_or(NONE, |frame| &frame.local)
    }

    fn origins(&self) -> &BTreeMap<String, Origins> {
        const NONE: &BTreeMap<String, Origins> = &BTreeMap::new();
        self.frames.last().map_or(NONE, |frame| &frame.origins)
    }

    /// Returns the settings that give the flags in a text of the innermost running stage.
    fn origins_of(&self, text: &str) -> Result<Origins, String> {
        self.scope.origins(text, self.local(), self.origins())
    }

    fn holds(&self, condition: &[Term]) -> Result<bool, String> {
        self.scope.holds(condition, self.local())
    }

    /// Returns the expanded text of a property (`optional` or `note`) of the innermost running stage. It is `None` if
    /// there is no such property, its condition does not hold, or the text is empty.
    fn text_of(&self, property: Option<&DefinitionLine>) -> Result<Option<String>, String> {
        let Some(DefinitionLine { text, condition }) = property else { return Ok(None) };
        if !self.holds(condition)? {
            return Ok(None);
        }
        let text = self.scope.expand(text, self.local())?.join(" ");
        Ok(Some(text).filter(|text| !text.is_empty()))
    }

    /// Makes the command of a line of the innermost running stage. `text` is the line before expansion.
    fn command(&mut self, text: &str, may_be_negative: bool) -> Result<StageCommand, String> {
        let optional = self.frames.last_mut().and_then(|frame| frame.optional.take());
        let mut words = self.scope.expand(text, self.local())?.into_iter();
        Ok(StageCommand {
            program: words.next().unwrap_or_default(),
            arguments: words.collect(),
            may_be_negative,
            refusal_dir: self.text_of(optional)?,
            origins: self.origins_of(text)?,
        })
    }
}

impl StageCommand {
    /// Returns the command as one line for a shell. In `--flag=value`, only the value is in quotation marks.
    pub fn line(&self) -> String {
        let mut line = as_command(&self.program);
        for argument in &self.arguments {
            line.push(' ');
            line.push_str(&quote_argument(argument));
        }
        line
    }
}

fn quote_argument(argument: &str) -> String {
    match argument.split_once('=') {
        Some((flag, value))
            if flag.starts_with("--") && !value.is_empty() && words::quote(flag) == flag =>
        {
            format!("{flag}={}", words::quote(value))
        }
        _ => words::quote(argument),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::definition::Definition;

    const SHARED: &str = "
settings:
  a: {type: word, help: A}
values:
  at: ['out/{label}']
  plan: ['{recommended}', none]
  may: []
stages:
  run:
    - one label=x flags='--p {a} --q'
    - one label=y flags='' when a
    - two label=z may='out/z'
    - two label=z
    - planish-z {recommended} ?
  one:
    optional: '{at} when label is not x'
    steps: ['planish-x {flags} --out {at}', 'planish-y {label}']
  two: {optional: '{may}', steps: ['planish-x {label}'], note: 'the end of {label} when may'}
";

    /// Returns the steps of the stage `run` as text. With `leave`, a stage is left at its first command if that may
    /// refuse.
    fn steps(settings: &[&str], leave: bool) -> Vec<String> {
        let definition = Definition::read("p", SHARED, "title: T").unwrap();
        let mut walk = Walk::new(Scope::new(&definition, settings).unwrap(), "run").unwrap();
        let mut steps = Vec::new();
        while let Some(step) = walk.step().unwrap() {
            steps.push(match step {
                Step::Run(command) => {
                    walk.scope.set("recommended", vec!["best".into()]);
                    match &command.refusal_dir {
                        Some(dir) => {
                            if leave {
                                walk.leave();
                            }
                            format!("{dir}: {}", command.line())
                        }
                        None => command.line(),
                    }
                }
                Step::Say(text) => format!("say {text}"),
            });
        }
        steps
    }

    #[test]
    fn stages_have_values_and_a_recommended_plan_counts_afterwards() {
        assert_eq!(
            steps(&["a=1 2"], false),
            [
                "planish x --p '1 2' --q --out out/x",
                "planish y x",
                "out/y: planish x --out out/y",
                "planish y y",
                "out/z: planish x z",
                "say the end of z",
                "planish x z",
                "planish z best"
            ]
        );
    }

    #[test]
    fn a_stage_that_is_left_does_no_more() {
        assert_eq!(
            steps(&["a=x"], true)[2..],
            ["out/y: planish x --out out/y", "out/z: planish x z", "planish x z", "planish z best"]
        );
    }

    #[test]
    fn a_line_can_be_copied() {
        let arguments =
            ["--a=1", "--b=x y", "--c", "it's", "--d=", "$(e)"].map(String::from).to_vec();
        let command = StageCommand {
            program: "planish-x".into(),
            arguments,
            may_be_negative: false,
            refusal_dir: None,
            origins: Origins::default(),
        };
        assert_eq!(command.line(), r"planish x --a=1 --b='x y' --c 'it'\''s' '--d=' '$(e)'");
    }
}
