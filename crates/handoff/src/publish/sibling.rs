//! The siblings of places: what a process writes before it appears, held by advisory locks.

use std::{
    fs::{self, File, TryLockError},
    io::{self, ErrorKind},
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
};

use crate::kind;

/// What the names of everything temporary begin with.
const PREFIX: &str = ".planish-";

/// What stands at the end of a sibling that is not shown yet, and of a journal.
const TEMPORARY: &str = ".tmp";
pub(super) const JOURNAL: &str = ".journal";

/// Most names that are tried for a sibling: other runs, and what they left, have taken one each, or have taken a new one
/// for abandoned. In a directory that has been removed while it is the current one no name can be taken.
const MOST_NAMES: u32 = 10_000;

/// Temporary siblings of this process, for the handler of signals.
static SIBLINGS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// The temporary siblings of this process; who holds the list lets no other thread create one.
pub(super) fn known() -> MutexGuard<'static, Vec<PathBuf>> {
    // The list is whole whatever panicked meanwhile.
    SIBLINGS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Takes a sibling off the list: it has been removed, or has got another name.
pub(super) fn forget(sibling: &Path) {
    known().retain(|known| known != sibling);
}

/// Removes every temporary sibling of this process: it is about to end.
pub(crate) fn remove_all_siblings() {
    // Whoever runs out of memory may hold the list.
    if let Ok(siblings) = SIBLINGS.try_lock() {
        siblings.iter().for_each(|sibling| remove(sibling));
    }
}

/// A new sibling in `parent`, locked and known to the handler of signals. Numbers count up because a
/// container gives every run the same process id.
pub(super) fn create(
    parent: &Path,
    create: impl Fn(&Path) -> io::Result<File>,
) -> io::Result<(PathBuf, File)> {
    let mut count = 0;
    loop {
        let sibling = parent.join(format!("{PREFIX}{}-{count}{TEMPORARY}", std::process::id()));
        count += 1;
        // Under one lock, so that the handler of signals sees it as soon as it is there.
        let mut siblings = known();
        match create(&sibling) {
            Ok(file) => {
                siblings.push(sibling.clone());
                drop(siblings);
                // Where the file system has no locks, nobody can take it for abandoned either.
                let locked = !matches!(file.try_lock(), Err(TryLockError::WouldBlock));
                if locked && is_at(&file, &sibling) {
                    return Ok((sibling, file));
                }
                // Another run took it for abandoned between its creation and the lock.
                forget(&sibling);
            }
            // Not found: removed by another run, see above.
            Err(e) => {
                let again = matches!(e.kind(), ErrorKind::AlreadyExists | ErrorKind::NotFound);
                if !again || !parent.is_dir() || count > MOST_NAMES {
                    return Err(e);
                }
            }
        }
    }
}

/// Whether this is the name of something that a run has not finished, or left when it was killed;
/// the next run into the same directory clears it away.
pub fn is_temporary(name: &str) -> bool {
    name.starts_with(PREFIX) && (name.ends_with(TEMPORARY) || name.ends_with(JOURNAL))
}

/// Names in `parent` that begin as ours and end with `end`.
pub(super) fn temporaries(parent: &Path, end: &str) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(parent) else { return Vec::new() };
    let names = entries.filter_map(|entry| entry.ok().map(|e| e.file_name()));
    let ours = names
        .filter(|name| name.to_str().is_some_and(|n| n.starts_with(PREFIX) && n.ends_with(end)));
    ours.map(|name| parent.join(name)).collect()
}

/// Removes the siblings in `parent` whose process is gone: their lock is free.
pub(crate) fn remove_abandoned(parent: &Path) {
    for sibling in temporaries(parent, TEMPORARY) {
        let Ok(file) = File::open(&sibling) else { continue };
        // A journal that its process left is finished first, by the next run: it needs the siblings.
        let gone = file.try_lock().is_ok() && is_at(&file, &sibling);
        if gone && temporaries(parent, JOURNAL).is_empty() {
            remove(&sibling);
        }
    }
}

/// Removes a sibling. Of a directory only what an artifact may hold: a file that somebody put into the
/// old artifact at the moment of the exchange is left there.
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

/// Whether the open `file` is what stands at `path`.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let opened = identity(file);
    opened.is_some() && opened == fs::symlink_metadata(path).ok().map(|m| (m.dev(), m.ino()))
}

/// What tells an open file or directory from every other: its device and its inode.
#[cfg(unix)]
pub(super) fn identity(file: &File) -> Option<(u64, u64)> {
    use std::os::unix::fs::MetadataExt;
    file.metadata().ok().map(|m| (m.dev(), m.ino()))
}

#[cfg(not(unix))]
pub(super) fn identity(_: &File) -> Option<(u64, u64)> {
    None
}

#[cfg(not(unix))]
fn is_at(_: &File, path: &Path) -> bool {
    path.exists()
}

/// The inode of what stands at `path`: it tells whether that has been renamed.
#[cfg(unix)]
pub(super) fn inode(path: &Path) -> Option<u64> {
    use std::os::unix::fs::MetadataExt;
    fs::symlink_metadata(path).ok().map(|m| m.ino())
}

#[cfg(not(unix))]
pub(super) fn inode(_: &Path) -> Option<u64> {
    None
}
