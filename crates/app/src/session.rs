//! The state of a session, as its file `session.json` holds it: what was chosen in each step, and how it ended.

use serde::{Deserialize, Serialize};

use crate::{
    after::AfterChoice,
    choice::{MachineChoice, PartChoice, PlanChoice, ToolChoice, Words},
};

/// All steps of a session.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Session {
    /// The part.
    pub part: Option<SessionStep<PartChoice>>,
    /// The tool.
    pub tool: Option<SessionStep<ToolChoice>>,
    /// The machine.
    pub machine: Option<MachineChoice>,
    /// The plan.
    pub plan: Option<SessionStep<PlanChoice>>,
    /// The map after the run.
    pub after: Option<SessionStep<AfterChoice>>,
    /// Directory of the run, in that of the session; empty before the first plan.
    pub run: String,
    /// Time that the last plan took which ran to its end, s; `None` before one has.
    pub plan_took_s: Option<f64>,
    /// Number of steps that were begun, which makes two that are alike distinct.
    pub steps: u64,
}

/// A step: what was chosen, the command lines that do it, and how they ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SessionStep<Choice> {
    /// Number of the step among all that were begun in the session.
    pub number: u64,
    /// Choice of the user.
    pub choice: Choice,
    /// Command lines, in their order.
    pub commands: Vec<Words>,
    /// End of the commands.
    pub end: StepEnd,
}

/// Ends of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StepEnd {
    /// Its commands run.
    Running,
    /// Done.
    Done,
    /// Done, with a negative verdict.
    Negative,
    /// A command refused, or broke.
    Refused,
    /// The user ended it.
    Cancelled,
    /// The server ended while the commands ran.
    Interrupted,
    /// Done, but an earlier step has changed since.
    Outdated,
}

/// Steps that run commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum StepName {
    /// The part.
    Part,
    /// The tool.
    Tool,
    /// The plan.
    Plan,
    /// The map after the run.
    After,
}

impl StepName {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Part, Self::Tool, Self::Plan, Self::After];

    /// Returns the name of the file with the messages of the step.
    pub fn log(self) -> &'static str {
        match self {
            Self::Part => "part.log",
            Self::Tool => "tool.log",
            Self::Plan => "plan.log",
            Self::After => "after.log",
        }
    }
}

impl<Choice> SessionStep<Choice> {
    /// Returns the choice if the step is done, also with a negative verdict.
    pub fn done(&self) -> Option<&Choice> {
        match self.end {
            StepEnd::Done | StepEnd::Negative => Some(&self.choice),
            _ => None,
        }
    }
}

impl Session {
    /// Begins a step.
    pub fn begin<Choice>(
        &mut self,
        choice: Choice,
        commands: Vec<Words>,
    ) -> Option<SessionStep<Choice>> {
        self.steps += 1;
        Some(SessionStep { number: self.steps, choice, commands, end: StepEnd::Running })
    }

    /// Returns the end of a step, to be changed; `None` if the step was not begun.
    pub fn end_mut(&mut self, step: StepName) -> Option<&mut StepEnd> {
        match step {
            StepName::Part => self.part.as_mut().map(|step| &mut step.end),
            StepName::Tool => self.tool.as_mut().map(|step| &mut step.end),
            StepName::Plan => self.plan.as_mut().map(|step| &mut step.end),
            StepName::After => self.after.as_mut().map(|step| &mut step.end),
        }
    }

    /// Marks what runs as interrupted: the server that ran it has ended.
    pub fn reopen(&mut self) {
        for step in StepName::ALL {
            if let Some(end) = self.end_mut(step)
                && *end == StepEnd::Running
            {
                *end = StepEnd::Interrupted;
            }
        }
    }

    /// Marks the plan, and what was learnt after its run, as outdated, because an earlier step changes.
    pub fn outdate_plan(&mut self) {
        if let Some(plan) = &mut self.plan
            && plan.done().is_some()
        {
            plan.end = StepEnd::Outdated;
        }
        self.outdate_after();
    }

    /// Marks what was learnt after the run as outdated, because the plan changes.
    pub fn outdate_after(&mut self) {
        if let Some(after) = &mut self.after
            && after.done().is_some()
        {
            after.end = StepEnd::Outdated;
        }
    }

    /// Returns the command lines of all steps, in their order.
    pub fn commands(&self) -> Vec<&Words> {
        let part = self.part.iter().flat_map(|step| &step.commands);
        let tool = self.tool.iter().flat_map(|step| &step.commands);
        let plan = self.plan.iter().flat_map(|step| &step.commands);
        let after = self.after.iter().flat_map(|step| &step.commands);
        part.chain(tool).chain(plan).chain(after).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::choice::{PartSource, Reading};

    #[test]
    fn what_ran_when_the_server_ended_is_interrupted() {
        let source = PartSource::Fixture("coupon".into());
        let choice = PartChoice {
            source,
            reading: Reading::default(),
            aperture: None,
            target: None,
            level: "piston".into(),
            feature_mm: None,
        };
        let mut session = Session::default();
        session.part = session.begin(choice, vec![vec!["planish".into()]]);
        let text = serde_json::to_string(&session).unwrap();
        assert_eq!(serde_json::from_str::<Session>(&text).unwrap(), session);
        session.reopen();
        assert_eq!(session.part.as_ref().unwrap().end, StepEnd::Interrupted);
        assert!(session.part.as_ref().unwrap().done().is_none());
        assert_eq!(session.commands().len(), 1);
    }
}
