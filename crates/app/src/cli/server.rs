//! State that all connections share: the session, the running job, and the guard.

use std::{
    collections::BTreeMap,
    env,
    process::Command,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use planish_app::{
    choice::{
        MachineChoice, OWN_MACHINE, PartChoice, PartSource, PlanChoice, Reading, TOOL_RECIPE,
        ToolChoice, ToolSource,
    },
    guard::Guard,
    refusal::Refusal,
    session::{Session, SessionStep, StepName},
};
use planish_handoff::{Failure, Inputs};
use planish_pipeline::description::PipelineDescription;
use rand::RngExt;
use serde::Deserialize;

use super::{
    files::Files,
    job::{self, Job, Task},
};

/// Pipelines that the page offers.
const PIPELINES: [&str; 3] = ["raster", "maze", "spiral"];
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
    live: Mutex<Live>,
}

/// State that changes while the server runs.
pub struct Live {
    /// State of the session.
    pub session: Session,
    /// The job that runs; `None` if none does.
    pub job: Option<Job>,
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
        let live = Mutex::new(Live { session, job: None });
        Ok(Arc::new(Self { guard: Guard::new(port, token, report_token), files, pipelines, live }))
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
                let _ = std::fs::remove_file(self.files.dir.join(&trial));
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
            level: "piston".into(),
            feature_mm: None,
        };
        let tool = ToolChoice { source: ToolSource::Fixture(fixture), reading: Reading::default() };
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

    /// Asks the running job to end.
    pub fn cancel(&self) {
        if let Some(job) = &mut self.live().job {
            job.cancel();
        }
    }

    /// Returns the state if no job runs.
    fn idle(&self) -> Result<MutexGuard<'_, Live>, Refusal> {
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
