//! State that all connections share: the session, the running job, and the guard.

use std::{
    collections::BTreeMap,
    env, fs,
    process::Command,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use planish_app::{
    after::{AfterChoice, MeasuredRun},
    choice::{
        MachineChoice, OWN_MACHINE, PartChoice, PartSource, PlanChoice, Reading, TARGET,
        TOOL_RECIPE, ToolChoice, ToolSource, UPLOADED_VARYING, VARYING_TOOL,
    },
    guard::{Guard, check_file_name},
    refusal::Refusal,
    session::{Session, SessionStep, StepName},
};
use planish_form::FormFile;
use planish_handoff::{Failure, Inputs};
use planish_pipeline::description::PipelineDescription;
use planish_types::outcome::report::AnsweredSummary;
use rand::RngExt;
use serde::Deserialize;

use super::{
    estimate::{BinnedFor, Latest},
    files::Files,
    job::{self, Job, Task},
};

/// Pipelines that the page offers.
const PIPELINES: [&str; 5] = ["raster", "maze", "spiral", "random-adaptive", "multi-pitch"];
/// Fixture of the demonstration, and its machine.
const DEMO: [&str; 2] = ["coupon", "ion-beam"];

/// A server of one session.
pub struct Server {
    /// Guard of the requests.
    pub guard: Guard,
    /// Directory of the session.
    pub files: Files,
    /// Pipelines that the page offers, as data.
    pub pipelines: BTreeMap<String, PipelineDescription>,
    /// Map of the estimates; locked while one is made.
    pub binned: Mutex<Option<BinnedFor>>,
    live: Mutex<Live>,
}

/// State that changes while the server runs.
pub struct Live {
    /// State of the session.
    pub session: Session,
    /// The job that runs; `None` if none does.
    pub job: Option<Job>,
    /// The estimate that runs.
    pub estimate: Latest,
}

/// Body of a request that chooses the machine.
#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum MachineRequest {
    /// A machine of the fixtures, by its name.
    Fixture(String),
    /// Text of a machine file.
    Own(String),
}

impl Server {
    /// Opens the session, and reads what the pipelines take.
    ///
    /// # Errors
    /// Fails if the session or the pipelines cannot be read.
    pub fn open(files: Files, port: u16) -> Result<Arc<Self>, Failure> {
        let mut pipelines = BTreeMap::new();
        for name in PIPELINES {
            let output = Command::new(env::current_exe()?)
                .args(["show", name, "--json"])
                .current_dir(&files.dir)
                .output()?;
            if !output.status.success() {
                return Err(Failure::new(String::from_utf8_lossy(&output.stderr).trim()));
            }
            pipelines.insert(name.into(), serde_json::from_slice(&output.stdout)?);
        }
        let mut session = files.session()?;
        session.reopen();
        let [token, report_token] = [token(), token()];
        let live = Mutex::new(Live { session, job: None, estimate: Latest::default() });
        let guard = Guard::new(port, token, report_token);
        Ok(Arc::new(Self { guard, files, pipelines, binned: Mutex::new(None), live }))
    }

    /// Returns the state, for one thread at a time.
    pub fn live(&self) -> MutexGuard<'_, Live> {
        self.live.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Prefix of the path of `fixtures/`.
    pub fn folder(&self) -> &str {
        self.pipelines.values().next().map_or("", |pipeline| &pipeline.folder)
    }

    /// Begins the step of the part.
    ///
    /// # Errors
    /// Refuses a choice that names nothing that is there, and any choice while a job runs.
    pub fn choose_part(self: &Arc<Self>, choice: PartChoice) -> Result<(), Refusal> {
        let mut live = self.idle()?;
        let task = self.part_task(&mut live.session, choice)?;
        job::start(self, live, vec![task])
    }

    /// Begins the step of the tool.
    ///
    /// # Errors
    /// The same as [`Server::choose_part`].
    pub fn choose_tool(self: &Arc<Self>, choice: ToolChoice) -> Result<(), Refusal> {
        let mut live = self.idle()?;
        let task = self.tool_task(&mut live.session, choice)?;
        job::start(self, live, vec![task])
    }

    /// Chooses the machine, from the body of a request.
    ///
    /// # Errors
    /// Refuses a file that describes no machine; the machine before it stays.
    pub fn choose_machine(&self, body: &[u8]) -> Result<(), Refusal> {
        let request: MachineRequest = read_json(body)?;
        let mut live = self.idle()?;
        let choice = match request {
            MachineRequest::Fixture(name) => MachineChoice::Fixture(name),
            MachineRequest::Own(text) => {
                // The reader is that of the stages, and it reads a file.
                let trial = format!("trial-of-{OWN_MACHINE}");
                self.files.write(&trial, text.as_bytes())?;
                let read = Inputs::new().read_machine(&self.files.dir.join(&trial));
                let _ = fs::remove_file(self.files.dir.join(&trial));
                read.map_err(|e| Refusal::of_value(e.problem))?;
                self.files.write(OWN_MACHINE, text.as_bytes())?;
                MachineChoice::Own
            }
        };
        self.check_machine(&choice)?;
        live.session.machine = Some(choice);
        live.session.outdate_plan();
        self.files.save_session(&live.session)
    }

    /// Begins the plan.
    ///
    /// # Errors
    /// Refuses a plan without part, tool and machine, and settings that the pipeline does not take.
    pub fn choose_plan(self: &Arc<Self>, choice: PlanChoice) -> Result<(), Refusal> {
        let mut live = self.idle()?;
        let missing = Refusal::of_value("part, tool and machine come first; finish these steps");
        let session = &live.session;
        let part = session.part.as_ref().and_then(SessionStep::done).cloned();
        let tool = session.tool.as_ref().and_then(SessionStep::done).cloned();
        let (Some(part), Some(tool), Some(machine)) = (part, tool, session.machine.clone()) else {
            return Err(missing);
        };
        let task = self.plan_task(&mut live.session, choice, (&part, &tool, &machine))?;
        job::start(self, live, vec![task])
    }

    /// Begins the demonstration: part, tool, machine and plan of a fixture.
    ///
    /// # Errors
    /// Refuses it while a job runs.
    pub fn begin_demo(self: &Arc<Self>) -> Result<(), Refusal> {
        let [fixture, machine] = DEMO.map(String::from);
        let part = PartChoice {
            source: PartSource::Fixture(fixture.clone()),
            reading: Reading::default(),
            aperture: None,
            target: None,
            level: "piston".into(),
            feature_mm: None,
        };
        let source = ToolSource::Fixture(fixture);
        let tool = ToolChoice { source, reading: Reading::default(), fit: None };
        let machine = MachineChoice::Fixture(machine);
        let plan = PlanChoice { pipeline: "raster".into(), settings: BTreeMap::new() };
        let mut live = self.idle()?;
        let session = &mut live.session;
        session.machine = Some(machine.clone());
        let tasks = vec![
            self.part_task(session, part.clone())?,
            self.tool_task(session, tool.clone())?,
            self.plan_task(session, plan, (&part, &tool, &machine))?,
        ];
        job::start(self, live, tasks)
    }

    /// Begins the step after the run.
    ///
    /// # Errors
    /// Refuses it before there is a run with a plan, and the same as [`Server::choose_part`].
    pub fn choose_after(self: &Arc<Self>, choice: AfterChoice) -> Result<(), Refusal> {
        let mut live = self.idle()?;
        let session = &live.session;
        let part = session.part.as_ref().and_then(SessionStep::done);
        let plan = session.plan.as_ref().and_then(SessionStep::done);
        let (Some(part), Some(plan), Some(machine)) = (part, plan, &session.machine) else {
            return Err(Refusal::of_value(
                "a run comes first: plan it, and measure the part after it",
            ));
        };
        match &choice.source {
            PartSource::File(name) => drop(self.files.inside(&format!("files/after/{name}"))?),
            _ => drop(self.files.inside("files/after/height_nm.npy")?),
        }
        let trajectory = format!("{}/trajectory", self.executed(session, plan)?);
        let tif = session.tool.as_ref().map_or("", |step| step.choice.source.tif());
        let run = MeasuredRun { part, tif, machine, plan, trajectory: &trajectory };
        let description = self.pipelines.get(&plan.pipeline);
        let description =
            description.ok_or_else(|| Refusal::of_value("there is no such pipeline"))?;
        let commands = choice.commands(&run, description)?;
        live.session.after = live.session.begin(choice, commands.clone());
        job::start(self, live, vec![Task { step: StepName::After, commands }])
    }

    /// Returns the directory of the plan that ran, in that of the session: the program as it was read back, else the
    /// plan that the report recommends.
    ///
    /// # Errors
    /// Refuses a run without either.
    fn executed(&self, session: &Session, plan: &PlanChoice) -> Result<String, Refusal> {
        let recommended = self.recommended(session)?;
        let Some(controller) = plan.controller() else { return Ok(recommended) };
        let end = format!("+{controller}");
        let of_recommended = format!("{recommended}{end}");
        if recommended.ends_with(&end) || self.files.inside(&of_recommended).is_err() {
            return Ok(recommended);
        }
        Ok(of_recommended)
    }

    /// Returns the directory of the plan that the report recommends, in that of the session.
    ///
    /// # Errors
    /// Refuses a run without one.
    pub fn recommended(&self, session: &Session) -> Result<String, Refusal> {
        let none = || Refusal::new(404, "the run recommends no plan");
        if session.run.is_empty() {
            return Err(none());
        }
        let path = self.files.inside(&format!("{}/report/summary.json", session.run))?;
        let answered: AnsweredSummary = read_json(&self.files.read(&path)?)?;
        let method = answered.answer.method.filter(|name| check_file_name(name).is_ok());
        Ok(format!("{}/methods/{}", session.run, method.ok_or_else(none)?))
    }

    /// Asks the running job and the running estimate to end.
    pub fn cancel(&self) {
        let mut live = self.live();
        live.estimate.replace();
        if let Some(job) = &mut live.job {
            job.cancel();
        }
    }

    /// Returns the state if no job runs.
    ///
    /// # Errors
    /// Refuses it while one runs.
    pub fn idle(&self) -> Result<MutexGuard<'_, Live>, Refusal> {
        let live = self.live();
        if live.job.is_some() {
            return Err(Refusal::new(409, "a step is running; wait for its end, or cancel it"));
        }
        Ok(live)
    }

    fn part_task(&self, session: &mut Session, choice: PartChoice) -> Result<Task, Refusal> {
        let commands = choice.commands(self.folder())?;
        match &choice.source {
            PartSource::Fixture(name) => self.check_fixture(name)?,
            PartSource::File(name) => drop(self.files.inside(&format!("files/part/{name}"))?),
            PartSource::Arrays => drop(self.files.inside("files/part/height_nm.npy")?),
        }
        if let Some(target) = &choice.target {
            self.files.write(TARGET, checked_target(target)?.as_bytes())?;
        }
        session.outdate_plan();
        session.part = session.begin(choice, commands.clone());
        Ok(Task { step: StepName::Part, commands })
    }

    fn tool_task(&self, session: &mut Session, choice: ToolChoice) -> Result<Task, Refusal> {
        let commands = choice.commands(self.folder())?;
        match &choice.source {
            ToolSource::Fixture(name) => self.check_fixture(name)?,
            ToolSource::Rates(name) => drop(self.files.inside(&format!("files/tool/{name}"))?),
            ToolSource::Arrays => drop(self.files.inside("files/tool/rate_nm_per_s.npy")?),
            ToolSource::Spot { file, before, .. } => {
                self.files.inside(&format!("files/tool/{file}"))?;
                if let Some(before) = before {
                    self.files.inside(&format!("files/before/{before}"))?;
                }
            }
            ToolSource::Varying(names) => {
                // A later upload changes neither this tool nor a plan that runs.
                self.files.replace_by_copies([UPLOADED_VARYING, VARYING_TOOL], names, |dir| {
                    let read = Inputs::new().read_tool("tif", dir);
                    read.map(drop).map_err(|e| Refusal::of_value(e.to_string()))
                })?;
            }
            ToolSource::Formula { .. } => {}
        }
        if let Some(recipe) = choice.recipe()? {
            self.files.write(TOOL_RECIPE, recipe.as_bytes())?;
        }
        session.outdate_plan();
        session.tool = session.begin(choice, commands.clone());
        Ok(Task { step: StepName::Tool, commands })
    }

    fn plan_task(
        &self,
        session: &mut Session,
        choice: PlanChoice,
        (part, tool, machine): (&PartChoice, &ToolChoice, &MachineChoice),
    ) -> Result<Task, Refusal> {
        let description = self.pipelines.get(&choice.pipeline);
        let description =
            description.ok_or_else(|| Refusal::of_value("there is no such pipeline"))?;
        let (command, run) = choice.command(part, tool, machine, description)?;
        session.run = run;
        session.outdate_after();
        session.plan = session.begin(choice, vec![command.clone()]);
        Ok(Task { step: StepName::Plan, commands: vec![command] })
    }

    fn check_fixture(&self, name: &str) -> Result<(), Refusal> {
        let is_known =
            self.pipelines.values().any(|p| p.fixtures.iter().any(|known| known == name));
        if is_known {
            Ok(())
        } else {
            Err(Refusal::of_value(format!("there is no fixture '{name}'")))
        }
    }

    fn check_machine(&self, choice: &MachineChoice) -> Result<(), Refusal> {
        let MachineChoice::Fixture(name) = choice else { return Ok(()) };
        let is_known =
            self.pipelines.values().any(|p| p.machines.iter().any(|known| known == name));
        if is_known {
            Ok(())
        } else {
            Err(Refusal::of_value(format!("there is no machine '{name}'")))
        }
    }
}

/// Returns the text of a form file that names no other file.
///
/// # Errors
/// Refuses what is no form file, and the form of a map, which is a path.
fn checked_target(text: &str) -> Result<&str, Refusal> {
    let file: FormFile = serde_json::from_str(text)
        .map_err(|e| Refusal::of_value(format!("the form cannot be read: {e} (docs/forms.md)")))?;
    if file.surface.is_some() {
        return Err(Refusal::of_value(
            "the form names a map by its path, which this page does not take; use planish surface prepare --target",
        ));
    }
    Ok(text)
}

/// Reads the body of a request.
///
/// # Errors
/// Refuses what is not the JSON of this choice.
pub fn read_json<'a, T: Deserialize<'a>>(body: &'a [u8]) -> Result<T, Refusal> {
    serde_json::from_slice(body)
        .map_err(|e| Refusal::of_value(format!("the choice cannot be read: {e}")))
}

/// Returns a token of 128 random bits, as 32 digits. The generator is a cryptographic one, with a seed of the system.
fn token() -> String {
    format!("{:032x}", rand::rng().random::<u128>())
}
