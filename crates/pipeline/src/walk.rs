//! The steps of a stage, one by one. A later step may depend on what an earlier one found, so they are not a list.

use std::collections::BTreeMap;

use planish_handoff::words;

use crate::{
    action::Action,
    phrase::{Line, Term},
    scope::{Origins, Scope, Words},
};

/// A program with its arguments.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Command {
    /// Name of the program.
    pub program: String,
    /// Its arguments.
    pub arguments: Vec<String>,
    /// True if a negative verdict, exit code 1, lets the run go on.
    pub may_be_negative: bool,
    /// True if its standard output is not shown.
    pub is_quiet: bool,
    /// Settings that give its flags.
    pub origins: Origins,
}

/// Next action of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// A command.
    Run(Command),
    /// A command that may refuse. The message is then that of `message.txt` in this directory, and the stage ends.
    Attempt(String, Command),
    /// A stage that ends with a message in this directory, as if its command had refused.
    LeaveOut(String, String),
    /// A line for the user.
    Say(String),
    /// Copies the files of one directory to another one.
    Copy(String, String),
    /// Gives the name `to` the plan that the report recommends, if there is one and the commands of the stage `tried_by`
    /// accept it, or else `otherwise`.
    Choose {
        /// Name to be given.
        to: String,
        /// Plan without a recommendation.
        otherwise: String,
        /// Stage whose commands refuse a plan that cannot be chosen.
        tried_by: Option<String>,
    },
}

/// A stage that runs: its lines that are left, and the values that it was given.
#[derive(Clone)]
struct Frame<'a> {
    lines: std::slice::Iter<'a, Line>,
    local: Words,
    /// Settings that give the flags in these words.
    origins: BTreeMap<String, Origins>,
}

/// The steps of a stage.
#[derive(Clone)]
pub struct Walk<'a> {
    /// Settings and values; a step may change them for those that follow.
    pub scope: Scope<'a>,
    frames: Vec<Frame<'a>>,
}

impl<'a> Walk<'a> {
    /// The steps of this stage.
    pub fn new(scope: Scope<'a>, stage: &str) -> Result<Self, String> {
        let mut walk = Self { scope, frames: vec![] };
        walk.enter(stage, Words::new(), BTreeMap::new())?;
        Ok(walk)
    }

    /// The commands of a stage, if no step of it depends on what another one finds.
    pub fn commands(scope: Scope<'a>, stage: &str) -> Result<Vec<Command>, String> {
        let mut walk = Self::new(scope, stage)?;
        let mut commands = Vec::new();
        while let Some(step) = walk.step()? {
            match step {
                Step::Run(command) | Step::Attempt(_, command) => commands.push(command),
                Step::Say(_) | Step::LeaveOut(..) | Step::Copy(..) => {}
                Step::Choose { to, otherwise, .. } => walk.scope.set(&to, vec![otherwise]),
            }
        }
        Ok(commands)
    }

    /// The next step; `None` at the end.
    pub fn step(&mut self) -> Result<Option<Step>, String> {
        while let Some(frame) = self.frames.last_mut() {
            let Some(Line { text, condition }) = frame.lines.next() else {
                self.frames.pop();
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
                action => return self.made(action).map(Some),
            }
        }
        Ok(None)
    }

    /// Ends the stage that runs; that which named it goes on.
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
        let lines = definition.stage(stage).ok_or_else(|| {
            let all: Vec<&str> = definition.stages.iter().map(|(name, _)| name.as_str()).collect();
            format!("{} has no stage '{stage}'; there are: {}", definition.name, all.join(" "))
        })?;
        self.frames.push(Frame { lines: lines.iter(), local, origins });
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

    /// Returns the settings that give the flags in a text of the stage that runs.
    fn origins_of(&self, text: &str) -> Result<Origins, String> {
        self.scope.origins(text, self.local(), self.origins())
    }

    fn holds(&self, condition: &[Term]) -> Result<bool, String> {
        self.scope.holds(condition, self.local())
    }

    /// The step of a line that names no stage.
    fn made(&self, action: Action) -> Result<Step, String> {
        let words = |text: &str| self.scope.expand(text, self.local());
        let word = |text: &str| Ok::<_, String>(words(text)?.join(" "));
        Ok(match action {
            Action::Say(text) => Step::Say(word(text)?),
            Action::LeaveOut(dir, reason) => Step::LeaveOut(word(dir)?, word(reason)?),
            Action::Copy(from, to) => Step::Copy(word(from)?, word(to)?),
            Action::Choose { to, otherwise, tried_by } => Step::Choose {
                to: to.into(),
                otherwise: word(otherwise)?,
                tried_by: tried_by.map(String::from),
            },
            Action::Command { text, is_quiet, attempt, may_be_negative } => {
                let mut words = words(text)?.into_iter();
                let program = words.next().unwrap_or_default();
                let arguments = words.collect();
                let origins = self.origins_of(text)?;
                let command = Command { program, arguments, may_be_negative, is_quiet, origins };
                match attempt.map(word).transpose()?.filter(|dir| !dir.is_empty()) {
                    Some(dir) => Step::Attempt(dir, command),
                    None => Step::Run(command),
                }
            }
            Action::Stage(stage, _) => return Err(format!("the stage '{stage}' is no step")),
        })
    }
}

impl Command {
    /// The command as one line that a shell reads back. A value keeps its flag outside of the quotation marks.
    pub fn line(&self) -> String {
        let word = |word: &String| match word.split_once('=') {
            Some((flag, value))
                if flag.starts_with("--") && !value.is_empty() && words::quote(flag) == flag =>
            {
                format!("{flag}={}", words::quote(value))
            }
            _ => words::quote(word),
        };
        let mut line = self.program.clone();
        for argument in &self.arguments {
            line.push(' ');
            line.push_str(&word(argument));
        }
        if self.is_quiet {
            line.push_str(" > /dev/null");
        }
        line
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
  plan: [none]
  may: []
stages:
  run:
    - one label=x flags='--p {a} --q'
    - one label=y flags='' when a
    - may label=z may='out/z'
    - may label=z
    - say the end of {pipeline}
    - choose plan otherwise {pipeline} tried by try
    - planish-z {plan} ?
  one:
    - leave-out {at} not wanted when label in a
    - attempt {at} planish-x {flags} --out {at}
    - quietly planish-y {label}
  may: ['attempt {may} planish-x {label}']
  try: ['planish-try {plan}']
";

    fn steps(settings: &[&str], leave: bool) -> Vec<Step> {
        let definition = Definition::read("p", SHARED, "title: T").unwrap();
        let mut walk = Walk::new(Scope::new(&definition, settings).unwrap(), "run").unwrap();
        let mut steps = Vec::new();
        while let Some(step) = walk.step().unwrap() {
            if let Step::Choose { to, .. } = &step {
                walk.scope.set(to, vec!["best".into()]);
            }
            if leave && matches!(step, Step::Attempt(..) | Step::LeaveOut(..)) {
                walk.leave();
            }
            steps.push(step);
        }
        steps
    }

    fn line(step: &Step) -> String {
        match step {
            Step::Run(command) => command.line(),
            Step::Attempt(dir, command) => format!("{dir}: {}", command.line()),
            other => format!("{other:?}"),
        }
    }

    #[test]
    fn stages_have_values_and_a_chosen_name_counts_afterwards() {
        let found: Vec<String> = steps(&["a=1 2"], false).iter().map(line).collect();
        let choose = "Choose { to: \"plan\", otherwise: \"p\", tried_by: Some(\"try\") }";
        assert_eq!(
            found,
            [
                "out/x: planish-x --p '1 2' --q --out out/x",
                "planish-y x > /dev/null",
                "out/y: planish-x --out out/y",
                "planish-y y > /dev/null",
                "out/z: planish-x z",
                "planish-x z",
                "Say(\"the end of p\")",
                choose,
                "planish-z best"
            ]
        );
    }

    #[test]
    fn a_stage_that_is_left_does_no_more() {
        let found: Vec<String> = steps(&["a=x"], true).iter().map(line).collect();
        assert_eq!(
            found[..2],
            ["LeaveOut(\"out/x\", \"not wanted\")", "out/y: planish-x --out out/y"]
        );
        assert_eq!(found[2..4], ["out/z: planish-x z", "planish-x z"]);
        assert_eq!(found[4], "Say(\"the end of p\")");
    }

    #[test]
    fn a_line_can_be_copied() {
        let arguments =
            ["--a=1", "--b=x y", "--c", "it's", "--d=", "$(e)"].map(String::from).to_vec();
        let command = Command {
            program: "planish-x".into(),
            arguments,
            may_be_negative: false,
            is_quiet: false,
            origins: Origins::default(),
        };
        assert_eq!(command.line(), r"planish-x --a=1 --b='x y' --c 'it'\''s' '--d=' '$(e)'");
    }
}
