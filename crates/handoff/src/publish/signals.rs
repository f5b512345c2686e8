//! A signal ends a process without leaving its siblings on the disk.

use std::sync::{Mutex, MutexGuard, PoisonError};
#[cfg(unix)]
use std::{fs, thread, time::Duration};

use super::sibling;

/// How often a directory is emptied into which another thread is writing.
#[cfg(unix)]
const MOST_REMOVALS: usize = 100;

/// Held while a run appears: a signal waits until all of it is there.
static APPEARING: Mutex<()> = Mutex::new(());

/// Nothing ends this process by a signal as long as the guard is held.
pub(super) fn appearing() -> MutexGuard<'static, ()> {
    APPEARING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns unless a signal is ending the process, which then ends by it.
pub(crate) fn wait_for_signal_under_way() {
    drop(sibling::known());
}

/// From now on SIGINT, SIGTERM and SIGHUP end the process as they always do, and its siblings with it.
#[cfg(unix)]
pub(crate) fn clean_up_on_signals() {
    use signal_hook::{consts::signal, iterator::Signals, low_level::emulate_default_handler};
    let Ok(mut signals) = Signals::new([signal::SIGINT, signal::SIGTERM, signal::SIGHUP]) else {
        return;
    };
    thread::spawn(move || {
        for signal in &mut signals {
            let _appearing = appearing();
            // Held to the end: from now on the other threads stage nothing more, nor end the process.
            let siblings = sibling::known();
            for path in siblings.iter() {
                // The other threads may still be creating files in it.
                for _ in 0..MOST_REMOVALS {
                    sibling::remove(path);
                    if fs::symlink_metadata(path).is_err() {
                        break;
                    }
                    thread::sleep(Duration::from_millis(1));
                }
            }
            let _ = emulate_default_handler(signal);
        }
    });
}

#[cfg(not(unix))]
pub(crate) fn clean_up_on_signals() {}
