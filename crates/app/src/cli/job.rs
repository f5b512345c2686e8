//! The job of a session: the command lines of one or several steps, one after another, in a thread.

use std::{
    env,
    fs::File,
    io::Write,
    process::{Command, Stdio},
    sync::{Arc, MutexGuard},
    thread,
    time::Instant,
};

use planish_app::{
    choice::Words,
    refusal::Refusal,
    session::{StepEnd, StepName},
};
use planish_handoff::{Running, words};

use super::server::{Live, Server};

/// Commands of a step.
pub struct Task {
    /// Step that they belong to.
    pub step: StepName,
    /// Command lines, in their order.
    pub commands: Vec<Words>,
}

/// The job that runs.
pub struct Job {
    /// Step whose commands run.
    pub step: StepName,
    /// Begin of this step.
    pub begun: Instant,
    child: Option<u32>,
    is_cancelled: bool,
}

impl Job {
    /// Asks the running command to end, and lets none follow it.
    pub fn cancel(&mut self) {
        self.is_cancelled = true;
        if let Some(child) = self.child {
            Running::end(child);
        }
    }
}

/// Saves the session, and runs the tasks in a thread. `live` is the state, in which no job runs.
///
/// # Errors
/// Fails if the disk takes no session, or the system gives no thread.
pub fn start(
    server: &Arc<Server>,
    mut live: MutexGuard<'_, Live>,
    tasks: Vec<Task>,
) -> Result<(), Refusal> {
    let Some(first) = tasks.first() else { return Ok(()) };
    server.files.save_session(&live.session)?;
    live.estimate.replace();
    live.job =
        Some(Job { step: first.step, begun: Instant::now(), child: None, is_cancelled: false });
    drop(live);
    let shared = Arc::clone(server);
    let spawned = thread::Builder::new().spawn(move || run(&shared, &tasks));
    if let Err(e) = spawned {
        server.live().job = None;
        return Err(Refusal::new(500, format!("cannot start the step: {e}")));
    }
    Ok(())
}

/// Runs the tasks up to the first one that fails, and writes the end of each into the session.
fn run(server: &Server, tasks: &[Task]) {
    let mut has_failed = false;
    for (i, task) in tasks.iter().enumerate() {
        if let Some(job) = &mut server.live().job {
            job.step = task.step;
            job.begun = Instant::now();
        }
        let end = if has_failed { StepEnd::Cancelled } else { run_task(server, task) };
        has_failed |= !matches!(end, StepEnd::Done | StepEnd::Negative);
        let mut live = server.live();
        if let Some(known) = live.session.end_mut(task.step) {
            *known = end;
        }
        if task.step == StepName::Plan && matches!(end, StepEnd::Done | StepEnd::Negative) {
            live.session.plan_took_s =
                live.job.as_ref().map(|job| job.begun.elapsed().as_secs_f64());
        }
        if i + 1 == tasks.len() {
            live.job = None;
        }
        // The commands have written their results; without this file the page asks for the step again.
        let _ = server.files.save_session(&live.session);
    }
}

/// Runs the commands of a step, with their messages in its log.
fn run_task(server: &Server, task: &Task) -> StepEnd {
    let Ok(mut log) = server.files.begin_log(task.step) else { return StepEnd::Refused };
    for command in &task.commands {
        let _ = writeln!(log, "$ {}", words::join(command));
        match run_command(server, command, &log) {
            Ok(Some(0)) => {}
            // The exit code of a negative verdict; what follows would work on a result that is not good.
            Ok(Some(1)) => return StepEnd::Negative,
            Ok(_) if is_cancelled(server) => return StepEnd::Cancelled,
            Ok(_) => return StepEnd::Refused,
            Err(e) => {
                let _ = writeln!(log, "error: cannot run it: {e}");
                return StepEnd::Refused;
            }
        }
        if is_cancelled(server) {
            return StepEnd::Cancelled;
        }
    }
    StepEnd::Done
}

/// Runs a command in the directory of the session. Returns its exit code, `None` if a signal ended it.
fn run_command(server: &Server, command: &Words, log: &File) -> std::io::Result<Option<i32>> {
    // `planish STAGE ...` is a command of this program itself.
    let mut process = Command::new(env::current_exe()?);
    process
        .args(command.get(1..).unwrap_or_default())
        .current_dir(&server.files.dir)
        .stdin(Stdio::null())
        .stdout(log.try_clone()?)
        .stderr(log.try_clone()?);
    let running = {
        let mut live = server.live();
        let Some(job) = live.job.as_mut().filter(|job| !job.is_cancelled) else { return Ok(None) };
        let running = Running::start(&mut process)?;
        job.child = Some(running.id());
        running
    };
    let status = running.wait()?;
    if let Some(job) = &mut server.live().job {
        job.child = None;
    }
    Ok(status.code())
}

fn is_cancelled(server: &Server) -> bool {
    server.live().job.as_ref().is_some_and(|job| job.is_cancelled)
}
