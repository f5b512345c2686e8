//! `planish sweep run`: the stages of one job.

use std::{
    collections::BTreeSet,
    fs::{self, File, OpenOptions, TryLockError},
    path::{Path, PathBuf},
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Instant, SystemTime},
};

use clap::{Args, ValueEnum};
use planish_handoff::{
    Failure, Inputs, Manifest, Status, kind::MANIFEST, read_regular, say, system, warn,
};
use planish_sweep::{
    batch::{Size, estimated_s, members},
    plan::{Round, Sweep, SweptPlan},
    row::PlanRow,
};
use planish_types::{
    Surface,
    outcome::{
        removal::RemovalOutcome,
        specification::SpecificationOutcome,
        sweep::{PlanNumbers, PlanStatus},
        tolerance::ToleranceOutcome,
        verdict::Verdict,
    },
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::super::{
    files::{read_row, read_sweep, row_path, unreadable, write_json},
    runner::{End, Stages, each, processor_s_of_stages},
};

#[derive(Args)]
pub struct RunJob {
    /// Directory of the sweep
    dir: PathBuf,
    #[command(flatten)]
    job: Job,
    /// Stages that run at the same time, each on one core
    #[arg(long, value_name = "N", default_value_t = 1)]
    at_once: usize,
    /// End when the program that started this one ends, however it does (Linux)
    #[arg(long)]
    end_with_parent: bool,
}

/// Part of a sweep.
#[derive(Args)]
pub struct Job {
    /// Layer to make
    #[arg(long, value_enum)]
    pub layer: Layer,
    /// Round of the search, by its name in sweep.json [default: the grid]
    #[arg(long, value_name = "NAME")]
    pub round: Option<String>,
    /// Number of the job, from 1
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub job: usize,
    /// Number of jobs that share the layer
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub jobs: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Layer {
    /// The mirror: map, tool, desired removal
    Mirror,
    /// Files that plans share: tool paths, first dwell times
    Paths,
    /// The plans
    Plans,
}

/// Content of the file that a job writes when it is finished: the number of its plans or tool paths, and how many of
/// those that it made now failed.
#[derive(Serialize, Deserialize)]
struct Finished {
    made_or_found: usize,
    failed: usize,
}

/// Content of the file that stands in place of a tool path that could not be made.
#[derive(Serialize, Deserialize)]
struct NoPath {
    message: String,
}

/// Times of a job. They are kept apart from the results, which do not depend on them.
#[derive(Serialize)]
struct JobTime {
    wall_s: f64,
    processor_s: Option<f64>,
    at_once: usize,
    made: usize,
}

impl Job {
    /// Returns the plans of the job, the most expensive first. In the layer of the tool paths, it returns one plan
    /// for each path.
    ///
    /// # Errors
    /// Fails if there is no such job or round.
    pub fn plans<'a>(&self, sweep: &'a Sweep, size: &Size) -> Result<Vec<&'a SweptPlan>, Failure> {
        let Self { job, jobs: of, layer, .. } = *self;
        if !(1..=of).contains(&job) {
            return Err(Failure::new(format!("--job is {job} of {of}; give 1 to {of}")));
        }
        let plans = &self.round(sweep)?.plans;
        let mut all: Vec<&SweptPlan> = plans.iter().collect();
        if layer == Layer::Paths {
            let mut seen = BTreeSet::new();
            all.retain(|plan| seen.insert(&plan.path_id));
        }
        Ok(members(all, |plan| estimated_s(plan, size), job - 1, of))
    }

    /// Returns the round of the job: the one that its flag names, or the first one (the grid).
    fn round<'a>(&self, sweep: &'a Sweep) -> Result<&'a Round, Failure> {
        let Some(wanted) = &self.round else { return Ok(&sweep.rounds[0]) };
        let round = sweep.rounds.iter().find(|round| round.id == *wanted);
        round.ok_or_else(|| {
            let known: Vec<&str> = sweep.rounds.iter().map(|round| round.id.as_str()).collect();
            Failure::new(format!("--round is {wanted}; the sweep has {}", known.join(", ")))
        })
    }

    /// Returns the path of the file that marks the job as finished.
    fn finished(&self, sweep: &Sweep, dir: &Path) -> Result<PathBuf, Failure> {
        let Self { job, jobs: of, .. } = self;
        let layer = match self.layer {
            Layer::Mirror => return Ok(dir.join(sweep.mirror_file())),
            Layer::Paths => "paths",
            Layer::Plans => "plans",
        };
        let round = &self.round(sweep)?.id;
        Ok(dir.join(format!("done/{layer}-{round}-{job}-of-{of}.json")))
    }
}

impl RunJob {
    pub fn run(&self) -> Result<Status, Failure> {
        if self.at_once == 0 {
            return Err(Failure::new("--at-once is 0; give the number of cores"));
        }
        if self.end_with_parent {
            // A job whose workflow was killed ends with it, and leaves nothing half done.
            system::end_with_parent();
        }
        let begun = Instant::now();
        let sweep = read_sweep(&self.dir)?;
        let finished = self.job.finished(&sweep, &self.dir)?;
        let _lock = alone(&finished)?;
        let stages = Stages::beside(&self.dir)?;
        let made = match self.job.layer {
            Layer::Mirror => {
                let (size, made) = mirror(&sweep, &stages, &self.dir)?;
                write_json(&finished, &size)?;
                made
            }
            Layer::Paths | Layer::Plans => {
                let size = read_size(&sweep, &self.dir)?;
                let plans = self.job.plans(&sweep, &size)?;
                let work =
                    Work { sweep: &sweep, stages: &stages, dir: &self.dir, at_once: self.at_once };
                let (made, failed) = match self.job.layer {
                    Layer::Paths => work.paths(&self.job, &plans)?,
                    _ => work.plans(&plans)?,
                };
                write_json(&finished, &Finished { made_or_found: plans.len(), failed })?;
                made
            }
        };
        let took = JobTime {
            wall_s: begun.elapsed().as_secs_f64(),
            processor_s: processor_s_of_stages(),
            at_once: self.at_once,
            made,
        };
        write_json(&finished.with_extension("took.json"), &took)?;
        let used = took.processor_s.map(|s| {
            let part = 100.0 * s / (took.wall_s * self.at_once as f64);
            format!(", {s:.1} s of processor time in the stages ({part:.0} % of {})", self.at_once)
        });
        let used = used.unwrap_or_default();
        say(format!("{}: {made} made in {:.1} s{used}", finished.display(), took.wall_s));
        Ok(Status::Done)
    }
}

/// Reads the size of the mirror from the file that the job of the layer `mirror` has written.
///
/// # Errors
/// Fails if it is not there or cannot be read.
pub fn read_size(sweep: &Sweep, dir: &Path) -> Result<Size, Failure> {
    let path = dir.join(sweep.mirror_file());
    let bytes = read_regular(&path).map_err(|e| {
        let problem = format!("cannot read: {e}; make the mirror first (--layer mirror)");
        Failure::new(format!("{}: {problem}", path.display()))
    })?;
    serde_json::from_slice(&bytes).map_err(|e| unreadable(&path, &e))
}

/// Waits until no other process runs the same job, and returns its lock. A job that is started again while its first
/// run goes on then finds the results of that run. The lock file stays, because two processes could lock two files of
/// the same name.
fn alone(finished: &Path) -> Result<File, Failure> {
    let path = finished.with_extension("lock");
    let failed = |e: std::io::Error| Failure::new(format!("{}: cannot lock: {e}", path.display()));
    fs::create_dir_all(path.parent().unwrap_or(Path::new("."))).map_err(failed)?;
    let open = OpenOptions::new().write(true).create(true).truncate(false).open(&path);
    let file = open.map_err(failed)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            warn(format!(
                "{} is locked: another process runs this job; waiting for its end",
                path.display()
            ));
            file.lock().map_err(failed)?;
        }
        // A network file system without locks: two runs of a job do the same work twice, no harm.
        Err(TryLockError::Error(e)) => warn(format!("{}: cannot lock: {e}", path.display())),
    }
    Ok(file)
}

/// Makes the map, the tool and the desired removal. Returns the size of the mirror, and the number of stages that
/// ran.
fn mirror(sweep: &Sweep, stages: &Stages, dir: &Path) -> Result<(Size, usize), Failure> {
    for step in &sweep.mirror_steps {
        match stages.run(step)? {
            End::Done => {}
            // A tool that is less exact than was asked for is the tool all the same, as in `planish run`.
            End::Negative(text)
                if step.arguments.first().is_some_and(|a| a.starts_with("tool-")) =>
            {
                warn(text);
            }
            End::Negative(text) | End::Failed(text) | End::Killed(text) => {
                return Err(Failure::new(text));
            }
        }
    }
    let mut inputs = Inputs::new();
    let surface: Surface = inputs.read("surface", &dir.join(&sweep.surface))?;
    let tif = inputs.read_tool("tif", &dir.join(&sweep.tools[0].1))?;
    for (name, other) in &sweep.tools[1..] {
        inputs.read_tool(name, &dir.join(other))?;
    }
    let pixels = surface.height_nm().len() as f64;
    let area_mm2 = pixels * surface.grid().pixel_mm2();
    let size = Size { pixels, area_mm2, tool_width_mm: tif.width_mm() };
    Ok((size, sweep.mirror_steps.len()))
}

/// The work of a job: its sweep, its programs, the directory of the sweep, and the number of stages that run at the
/// same time.
struct Work<'a> {
    sweep: &'a Sweep,
    stages: &'a Stages,
    dir: &'a Path,
    at_once: usize,
}

impl Work<'_> {
    /// Makes the tool paths of these plans and their first dwell times. Returns how many were tried, and how many of
    /// them failed.
    fn paths(&self, job: &Job, plans: &[&SweptPlan]) -> Result<(usize, usize), Failure> {
        let made = AtomicUsize::new(0);
        let failed = AtomicUsize::new(0);
        each(plans, self.at_once, |plan| {
            let mut steps = self.sweep.path_steps(plan);
            let mut seen = BTreeSet::new();
            let round = job.round(self.sweep)?;
            for other in round.plans.iter().filter(|other| other.path_id == plan.path_id) {
                if other.dwell_id.as_ref().is_some_and(|id| seen.insert(id)) {
                    steps.extend(self.sweep.dwell_step(other));
                }
            }
            made.fetch_add(1, Ordering::Relaxed);
            let problem = self.no_path(plan);
            match self.stages.run_all(&steps)? {
                // Dwell times that have not converged are the beginning of a loop, which says how it ends.
                End::Done | End::Negative(_) => match fs::remove_file(&problem) {
                    Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                        Err(unreadable(&problem, &e))
                    }
                    _ => Ok(()),
                },
                End::Failed(message) | End::Killed(message) => {
                    failed.fetch_add(1, Ordering::Relaxed);
                    warn(format!("{}: {message}", plan.path_id));
                    write_json(&problem, &NoPath { message })
                }
            }
        })?;
        Ok((made.into_inner(), failed.into_inner()))
    }

    fn no_path(&self, plan: &SweptPlan) -> PathBuf {
        self.dir.join("paths").join(&plan.path_id).join("failed.json")
    }

    /// Makes the plans that are not made yet and writes their rows of the table. Returns how many were tried now, and
    /// how many of them failed.
    fn plans(&self, plans: &[&SweptPlan]) -> Result<(usize, usize), Failure> {
        let newest = self.stages.newest(&[
            "planish-joint",
            "planish-refine",
            "planish-simulate",
            "planish-verify",
            "planish-surface",
            "planish-tool",
            "planish-tolerance",
            "planish-compare",
        ]);
        let mut to_do = Vec::new();
        for plan in plans {
            if !self.is_made(plan, newest)? {
                to_do.push(*plan);
            }
        }
        if to_do.len() < plans.len() {
            say(format!(
                "{} of {} plans are there already",
                plans.len() - to_do.len(),
                plans.len()
            ));
        }
        let done = AtomicUsize::new(0);
        let failed = AtomicUsize::new(0);
        let begun = Instant::now();
        let keep = |row: &PlanRow| {
            if row.status == PlanStatus::Failed {
                failed.fetch_add(1, Ordering::Relaxed);
                warn(format!("{}: {}", row.id, row.message.as_deref().unwrap_or_default()));
            }
            let count = done.fetch_add(1, Ordering::Relaxed) + 1;
            if count.is_multiple_of(to_do.len().div_ceil(10)) {
                let left_s =
                    begun.elapsed().as_secs_f64() * (to_do.len() - count) as f64 / count as f64;
                say(format!("{count} of {} plans, about {left_s:.0} s left", to_do.len()));
            }
            write_json(&row_path(self.dir, &row.id), row)
        };
        let killed = Mutex::new(Vec::new());
        each(&to_do, self.at_once, |plan| match self.plan(plan)? {
            Ok(row) => keep(&row),
            Err(message) => {
                warn(format!("{}: {message}; it is tried once more, alone", plan.id));
                killed.lock().expect("no worker panics with the lock").push(*plan);
                Ok(())
            }
        })?;
        // What ends by a signal lacked memory, most likely: alone it has all of it.
        let mut killed = killed.into_inner().expect("no worker panics with the lock");
        killed.sort_by(|a, b| a.id.cmp(&b.id));
        for plan in killed {
            let row = self.plan(plan)?.unwrap_or_else(|message| {
                PlanRow::failed(
                    &plan.id,
                    format!("{message}, twice, the second time alone; give the job more memory"),
                )
            });
            keep(&row)?;
        }
        Ok((to_do.len(), failed.into_inner()))
    }

    /// Returns true if the row of a plan exists, is not that of a failure, and is not older than the programs. `newest`
    /// is the build time of the newest program; `None` if it is not known.
    fn is_made(&self, plan: &SweptPlan, newest: Option<SystemTime>) -> Result<bool, Failure> {
        let path = row_path(self.dir, &plan.id);
        let modified = fs::metadata(&path).and_then(|m| m.modified()).ok();
        let is_older = matches!((modified, newest), (Some(row), Some(program)) if row < program);
        if is_older {
            return Ok(false);
        }
        Ok(read_row(self.dir, &plan.id)?.is_some_and(|row| row.status != PlanStatus::Failed))
    }

    /// Makes a plan. Returns its row of the table, or the message of a stage that was killed.
    fn plan(&self, plan: &SweptPlan) -> Result<Result<PlanRow, String>, Failure> {
        let problem = self.no_path(plan);
        if let Ok(bytes) = read_regular(&problem) {
            let NoPath { message } =
                serde_json::from_slice(&bytes).map_err(|e| unreadable(&problem, &e))?;
            return Ok(Ok(PlanRow::failed(&plan.id, message)));
        }
        let (status, message) = match self.stages.run_all(&self.sweep.plan_steps(plan))? {
            End::Done => (PlanStatus::Done, None),
            End::Negative(message) => (PlanStatus::Negative, Some(message)),
            End::Failed(message) => return Ok(Ok(PlanRow::failed(&plan.id, message))),
            End::Killed(message) => return Ok(Err(message)),
        };
        self.link(plan)?;
        if self.sweep.reports {
            // Exit code 1 says of its only method what its verdict has said.
            match self.stages.run(&self.sweep.report_step(plan))? {
                End::Done | End::Negative(_) => {}
                End::Failed(message) => return Ok(Ok(PlanRow::failed(&plan.id, message))),
                End::Killed(message) => return Ok(Err(message)),
            }
        }
        let numbers = Some(self.numbers(plan)?);
        Ok(Ok(PlanRow { id: plan.id.clone(), status, message, numbers }))
    }

    /// Reads the results of a plan (residual, time, verdict ...) from the manifests that its stages have written.
    fn numbers(&self, plan: &SweptPlan) -> Result<PlanNumbers, Failure> {
        let dir = plan.method_dir();
        let removal: RemovalOutcome = self.outcome(&format!("{dir}/removal"))?;
        let verdict: Verdict = self.outcome(&format!("{dir}/verdict"))?;
        let below_95_percent_nm = match &self.sweep.process {
            None => None,
            Some(_) => {
                let tolerance: ToleranceOutcome =
                    self.outcome(&format!("{}/tolerance", plan.dir()))?;
                Some(tolerance.residual.below_95_percent_nm)
            }
        };
        let specification = match &self.sweep.specification {
            None => None,
            Some(_) => {
                let dir = format!("{}/specified/{}/specification", plan.dir(), plan.method);
                let judged: SpecificationOutcome = self.outcome(&dir)?;
                let without = "its map was measured without a specification";
                let report = judged
                    .specification
                    .ok_or_else(|| unreadable(&self.dir.join(dir), &without))?;
                Some(report.into())
            }
        };
        let rms_detilted_nm = removal.rms_detilted_nm.ok_or_else(|| {
            unreadable(&self.dir.join(dir).join("removal"), &"its outcome has no rms_detilted_nm")
        })?;
        Ok(PlanNumbers {
            total_time_s: removal.total_time_s,
            rms_nm: removal.rms_nm,
            rms_detilted_nm,
            below_95_percent_nm,
            limits_kept: verdict.limits_respected,
            specification,
        })
    }

    /// Reads the outcome from the manifest of the artifact in `dir`, relative to the directory of the sweep.
    fn outcome<T: DeserializeOwned>(&self, dir: &str) -> Result<T, Failure> {
        let path = self.dir.join(dir).join(MANIFEST);
        let bytes = read_regular(&path).map_err(|e| unreadable(&path, &e))?;
        let manifest: Manifest =
            serde_json::from_slice(&bytes).map_err(|e| unreadable(&path, &e))?;
        Ok(manifest.read_outcome(&path, "run the stage again that makes it")?)
    }

    /// Adds links to the shared map and tool path to the directory of a plan. The directory then looks like that of a
    /// single run, from which reports and figures are made.
    fn link(&self, plan: &SweptPlan) -> Result<(), Failure> {
        for (name, target) in
            [("surface", &self.sweep.surface), ("tool_path", &self.sweep.tool_path(plan))]
        {
            let link = self.dir.join(plan.dir()).join(name);
            match system::symbolic_link(&Path::new("../..").join(target), &link) {
                Err(e) if e.kind() != std::io::ErrorKind::AlreadyExists => {
                    return Err(Failure::new(format!(
                        "{}: cannot make a link: {e}",
                        link.display()
                    )));
                }
                _ => {}
            }
        }
        Ok(())
    }
}
