//! Child processes, which this process starts and which end with it.
//!
//! If SIGINT, SIGTERM or SIGHUP ends this process, its children get SIGTERM first, and it waits for their end: whatever
//! they have locked is then free. A child that goes on for [`PATIENCE`] is killed.

use std::{
    io,
    process::{Child, ChildStderr, Command, ExitStatus},
    sync::{Mutex, MutexGuard, PoisonError},
    thread,
    time::{Duration, Instant},
};

use crate::system::{self, EndSignal};

/// Time that a child has to end after SIGTERM before it is killed. Larger: a child that hangs delays the end of this
/// process. Smaller: a child on a slow disk is killed while it removes its unfinished files. Chosen: a stage ends
/// within milliseconds.
const PATIENCE: Duration = Duration::from_secs(10);

/// Time between two checks of a child that is ending. Larger: this process ends later. Smaller: more checks.
const BETWEEN_LOOKS: Duration = Duration::from_millis(2);

/// Process ids of the children that are running, or that have ended while the system still reserves their ids.
static RUNNING: Mutex<Vec<u32>> = Mutex::new(Vec::new());

fn running() -> MutexGuard<'static, Vec<u32>> {
    RUNNING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A running child process, which is ended if this process ends.
pub struct Running {
    child: Child,
}

impl Running {
    /// Starts a command as a child. It waits while a signal is ending this process.
    ///
    /// # Errors
    /// Fails if the system cannot start it.
    pub fn start(command: &mut Command) -> io::Result<Self> {
        let mut running = running();
        let child = command.spawn()?;
        running.push(child.id());
        Ok(Self { child })
    }

    /// Returns the process id of the child, by which another thread can end it ([`Running::end`]).
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Asks the child with this process id to end, by SIGTERM. A child that has ended is left alone.
    pub fn end(id: u32) {
        let running = running();
        if running.contains(&id) {
            system::send(id, EndSignal::Term);
        }
    }

    /// Returns the pipe of the child's standard error; `None` if it is not piped or was taken before.
    pub fn stderr(&mut self) -> Option<ChildStderr> {
        self.child.stderr.take()
    }

    /// Waits for the end of the child and returns its exit status.
    ///
    /// # Errors
    /// Fails if the system does not tell how it ended.
    pub fn wait(mut self) -> io::Result<ExitStatus> {
        // Its number stays its own until it is off the list, so that a signal reaches no other process.
        system::wait_for_end(self.child.id());
        let mut running = running();
        let status = self.child.wait();
        running.retain(|number| *number != self.child.id());
        status
    }
}

/// Ends all children and waits for their ends. While the returned guard is held, no child starts and no process id is
/// released.
pub(crate) fn end_all() -> MutexGuard<'static, Vec<u32>> {
    let running = running();
    running.iter().for_each(|number| system::send(*number, EndSignal::Term));
    let since = Instant::now();
    for number in running.iter() {
        while !system::has_ended(*number) && since.elapsed() < PATIENCE {
            thread::sleep(BETWEEN_LOOKS);
        }
        if !system::has_ended(*number) {
            system::send(*number, EndSignal::Kill);
            system::wait_for_end(*number);
        }
        system::reap(*number);
    }
    running
}
