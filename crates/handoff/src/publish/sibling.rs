//! Siblings: temporary files and directories beside the final path of an output, held by advisory locks.

use std::{
    fs::{self, DirEntry, File, TryLockError},
    io::{self, ErrorKind},
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
};

use crate::{kind, system::is_at};

/// Prefix of the names of all siblings.
const PREFIX: &str = ".planish-";

/// Suffix of the names of all siblings.
const TEMPORARY: &str = ".tmp";

/// Largest number of names that are tried for a sibling. Larger: a later message if no name can be
/// taken, as in a current directory that has been removed. Smaller: a run fails beside many others.
/// Each failed name belongs to another run or to the remains of one, or another run took the new
/// sibling for abandoned.
const MOST_NAMES: u32 = 10_000;

/// Paths of the siblings of this process, which the signal handler removes.
static SIBLINGS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Locks the list of siblings of this process. While it is locked, no other thread can create one.
pub(super) fn known() -> MutexGuard<'static, Vec<PathBuf>> {
    // The list is valid even if a thread has panicked while it held the lock.
    SIBLINGS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes a sibling from the list, because it has been removed or renamed.
pub(super) fn forget(sibling: &Path) {
    known().retain(|known| known != sibling);
}

/// Removes all siblings of this process, which is about to end.
pub(crate) fn remove_all_siblings() {
    // A thread that runs out of memory may hold the list.
    if let Ok(siblings) = SIBLINGS.try_lock() {
        siblings.iter().for_each(|sibling| remove(sibling));
    }
}

/// Creates a new sibling in `parent` by the function `create`, locks it, and adds it to the list for the signal
/// handler. Its name contains a count, because a container gives every run the same process id.
pub(super) fn create(
    parent: &Path,
    create: impl Fn(&Path) -> io::Result<File>,
) -> io::Result<(PathBuf, File)> {
    let mut count = 0;
    loop {
        let sibling = parent.join(format!("{PREFIX}{}-{count}{TEMPORARY}", std::process::id()));
        count += 1;
        // The list stays locked, so that the signal handler sees the sibling as soon as it exists.
        let mut siblings = known();
        match create(&sibling) {
            Ok(file) => {
                siblings.push(sibling.clone());
                drop(siblings);
                // On a file system without locks, no other run can take it for abandoned either.
                let locked = !matches!(file.try_lock(), Err(TryLockError::WouldBlock));
                if locked && is_at(&file, &sibling) {
                    return Ok((sibling, file));
                }
                // Another run took it for abandoned between its creation and the lock.
                forget(&sibling);
            }
            // Not found: another run removed it (see above).
            Err(e) => {
                let again = matches!(e.kind(), ErrorKind::AlreadyExists | ErrorKind::NotFound);
                if !again || !parent.is_dir() || count > MOST_NAMES {
                    return Err(e);
                }
            }
        }
    }
}

/// Returns true if `name` is that of a sibling, of a running or a killed run. The next run into the same directory
/// removes the siblings of killed runs.
pub fn is_temporary(name: &str) -> bool {
    name.starts_with(PREFIX) && name.ends_with(TEMPORARY)
}

/// Removes the siblings in `parent` whose process has ended, so that their lock is free.
pub(crate) fn remove_abandoned(parent: &Path) {
    for entry in fs::read_dir(parent).into_iter().flatten().flatten() {
        if !entry.file_name().to_str().is_some_and(is_temporary) || is_special(&entry) {
            continue;
        }
        let sibling = entry.path();
        let Ok(file) = File::open(&sibling) else { continue };
        if file.try_lock().is_ok() && is_at(&file, &sibling) {
            remove(&sibling);
        }
    }
}

/// Returns true if the entry is neither a file nor a directory. No run makes such a sibling, and opening a pipe could
/// wait for ever.
fn is_special(entry: &DirEntry) -> bool {
    !entry.file_type().is_ok_and(|kind| kind.is_file() || kind.is_dir())
}

/// Removes a sibling. In a directory it removes only files that an artifact may hold. A file that
/// somebody put into the old artifact at the moment of the exchange stays there.
pub(super) fn remove(sibling: &Path) {
    if !sibling.is_dir() {
        let _ = fs::remove_file(sibling);
        return;
    }
    for entry in fs::read_dir(sibling).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let known = kind::ALL.iter().any(|kind| kind.file_names().any(|known| *known == *name));
        if known {
            let _ = fs::remove_file(entry.path());
        }
    }
    let _ = fs::remove_dir(sibling);
}
