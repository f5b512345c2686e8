//! `planish program`: prints the plan from which the controller program of a run was written, and the
//! recommendation of the report.

use std::path::{Path, PathBuf};

use clap::Args;
use planish_handoff::{Failure, Status, controller, read_regular, say, warn};
use planish_types::{
    ControllerKind,
    outcome::report::{Answer, AnsweredSummary},
};

#[derive(Args)]
pub struct ProgramCommand {
    /// Directory of the run, in which its report and the program (such as program.galil) are
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Plan from which the program was written
    #[arg(long, value_name = "NAME")]
    of: String,
    /// Controller of the program
    #[arg(long, value_name = "NAME", value_parser = controller())]
    controller: ControllerKind,
}

/// Reads the recommendation of the report of the run in the directory `run`.
///
/// # Errors
/// Fails if there is no report, or if it cannot be read.
pub fn read_answer(run: &Path) -> Result<Answer, Failure> {
    let path = run.join("report/summary.json");
    let about = |e: &dyn std::fmt::Display| {
        Failure::new(format!("{}: cannot be read: {e}; run the report first", path.display()))
    };
    let text = read_regular(&path).map_err(|e| about(&e))?;
    let summary: AnsweredSummary = serde_json::from_slice(&text).map_err(|e| about(&e))?;
    Ok(summary.answer)
}

/// Returns the name of the plan without the controller that may follow it: `pvt` for `pvt+galil`. Other names are
/// unchanged.
pub fn plan_of(method: &str) -> &str {
    match method.rsplit_once('+') {
        Some((plan, controller)) if ControllerKind::named(controller).is_some() => plan,
        _ => method,
    }
}

impl ProgramCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        let answer = read_answer(&self.run)?;
        let plan = &self.of;
        let controller = self.controller.name();
        let program = self.run.join(format!("program.{controller}"));
        let read_back = format!("{plan}+{controller}");
        say(format!(
            "program: {} is of the plan {plan}; {read_back} is that program, read back and judged",
            program.display()
        ));
        match answer.method.as_deref() {
            Some(best) if plan_of(best) == plan => {
                say(format!(
                    "program: the plan is the one that the report recommends: {}",
                    answer.why
                ));
            }
            Some(best) => warn(format!(
                "the program is of the plan {plan}, and the report recommends {best}: {} For a program of it give \
                 program_of={best}",
                answer.why
            )),
            None => warn(format!("the report recommends no plan of this run: {}", answer.why)),
        }
        Ok(Status::Done)
    }
}
