//! Signal handler: it ends the child processes, removes the siblings (temporary outputs), and ends the process.

use std::{
    fs,
    sync::{Mutex, MutexGuard, PoisonError},
    thread,
    time::Duration,
};

use super::sibling;
use crate::{children, system::on_end_signals};

/// Largest number of attempts to empty a directory into which another thread is writing, 1 ms
/// apart. Larger: the end of the process can take longer. Smaller: a sibling can remain.
const MOST_REMOVALS: usize = 100;

/// Lock that is held while the outputs of a run become visible. A signal waits until all of them are visible.
static APPEARING: Mutex<()> = Mutex::new(());

/// Delays signals: none ends this process while the returned guard is held.
pub(super) fn appearing() -> MutexGuard<'static, ()> {
    APPEARING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for the end of the process if a signal is ending it; otherwise returns at once.
pub(crate) fn wait_for_signal_under_way() {
    drop(sibling::known());
}

/// Installs the handler: SIGINT, SIGTERM and SIGHUP end the children, remove the siblings, and then end the process as
/// usual.
pub(crate) fn clean_up_on_signals() {
    on_end_signals(|| {
        let children = children::end_all();
        let appearing = appearing();
        let siblings = sibling::known();
        for path in siblings.iter() {
            // Other threads may still be creating files in the directory.
            for _ in 0..MOST_REMOVALS {
                sibling::remove(path);
                if fs::symlink_metadata(path).is_err() {
                    break;
                }
                thread::sleep(Duration::from_millis(1));
            }
        }
        // The locks are held to the end, so that other threads stage nothing more and do not end the process.
        (children, appearing, siblings)
    });
}
