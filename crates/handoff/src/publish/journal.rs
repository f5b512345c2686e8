//! Journal of the outputs that appear together, and locks on their parent directories.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{
    rename::{put_in_place_anyhow, take_back},
    sibling::{self, JOURNAL, temporaries},
};
use crate::{
    HandoffError,
    place::{absolute, parent_of, sync_directory},
    system::{file_identity, inode},
};

/// Largest number of attempts to finish the journals in the directories of a run. Larger: more time
/// if a journal cannot be removed. Smaller: a run can start beside an unfinished journal. Each
/// attempt beyond the first needs another process that ended between its renames meanwhile. A
/// journal that remains after all of them cannot be removed, and its files do not come back.
const MOST_ATTEMPTS_TO_FINISH: usize = 16;

/// Renames that belong together.
#[derive(Default, Serialize, Deserialize)]
struct Journal {
    renames: Vec<Rename>,
}

/// One rename of a journal.
#[derive(Serialize, Deserialize)]
struct Rename {
    from: PathBuf,
    to: PathBuf,
    /// Inode of the new file. If `from` has another one, the rename is done.
    inode: u64,
}

/// Locks directories by advisory locks, always in the same order, so that no two processes wait for
/// each other. On a file system without locks, nothing is locked.
pub(super) fn hold(directories: &[PathBuf]) -> Vec<File> {
    let mut opened: Vec<File> = directories.iter().filter_map(|d| File::open(d).ok()).collect();
    opened.sort_by_key(file_identity);
    // A directory under two names would wait for itself.
    opened.dedup_by(|a, b| file_identity(a).is_some() && file_identity(a) == file_identity(b));
    opened.retain(|directory| directory.lock().is_ok());
    opened
}

/// Locks directories after finishing the journals that ended processes left in them.
pub(super) fn hold_without_journals(directories: &[PathBuf]) -> Vec<File> {
    let mut held = Vec::new();
    for _ in 0..MOST_ATTEMPTS_TO_FINISH {
        // The locks are released first, because finishing a journal locks its directories itself.
        held.clear();
        directories.iter().for_each(|directory| finish_interrupted(directory));
        held = hold(directories);
        let waits = |d: &PathBuf| !temporaries(d, JOURNAL).is_empty();
        // Without locks, a journal may belong to a running process, which removes it.
        if held.is_empty() || !directories.iter().any(waits) {
            break;
        }
    }
    held
}

/// Writes a journal with the renames of siblings to places into every directory in `parents`.
pub(super) fn write<'a>(
    renames: impl Iterator<Item = (&'a Path, &'a Path)>,
    parents: &[PathBuf],
) -> Result<Vec<PathBuf>, HandoffError> {
    let rename = |(sibling, place): (&Path, &Path)| Rename {
        from: absolute(sibling),
        to: absolute(&parent_of(place)).join(place.file_name().unwrap_or_default()),
        inode: inode(sibling).unwrap_or(0),
    };
    let journal = Journal { renames: renames.map(rename).collect() };
    let bytes = serde_json::to_vec(&journal).expect("a journal serialises");
    let write = |parent: &PathBuf| {
        let io = |e| HandoffError::io(parent, "write a journal there", &e);
        // The file is complete before it gets the name of a journal.
        let (path, mut file) =
            sibling::create(parent, |path| File::create_new(path)).map_err(io)?;
        let name = path.with_extension(&JOURNAL[1..]);
        let written = file
            .write_all(&bytes)
            .and_then(|()| file.sync_all())
            .and_then(|()| fs::rename(&path, &name))
            .and_then(|()| sync_directory(parent));
        if written.is_err() {
            sibling::remove(&path);
        }
        sibling::forget(&path);
        written.map(|()| name).map_err(io)
    };
    parents.iter().map(write).collect()
}

/// Finishes, or undoes, the journals that ended processes left in `parent`. Waits for a process that is still
/// publishing.
pub(crate) fn finish_interrupted(parent: &Path) {
    for path in temporaries(parent, JOURNAL) {
        // An unreadable journal is left for a process that can read it. A file that is no journal
        // has no renames.
        let Ok(bytes) = fs::read(&path) else { continue };
        let journal: Journal = serde_json::from_slice(&bytes).unwrap_or_default();
        let mut directories: Vec<PathBuf> =
            journal.renames.iter().map(|rename| parent_of(&rename.to)).collect();
        directories.push(parent.to_path_buf());
        let held = hold(&directories);
        // Its process, or another that finished it, has removed it meanwhile.
        if held.is_empty() || fs::symlink_metadata(&path).is_err() {
            continue;
        }
        if finish(&journal.renames).is_ok() {
            let _ = fs::remove_file(&path);
        }
    }
}

/// Does the renames that are not done. If one fails, undoes all of them. Fails if that fails too, and then the journal
/// stays for a process that may rename there.
fn finish(renames: &[Rename]) -> io::Result<()> {
    let is_done = |r: &Rename| inode(&r.from) != Some(r.inode);
    let mut waiting = renames.iter().filter(|r| !is_done(r));
    let finished: io::Result<()> = waiting.try_for_each(|r| {
        put_in_place_anyhow(&r.from, &r.to)?;
        let _ = sync_directory(&parent_of(&r.to));
        Ok(())
    });
    if finished.is_ok() {
        return Ok(());
    }
    let mut undone = renames.iter().rev().filter(|r| is_done(r) && inode(&r.to) == Some(r.inode));
    undone.try_for_each(|r| {
        take_back(&r.from, &r.to, inode(&r.from).is_some())?;
        let _ = sync_directory(&parent_of(&r.to));
        Ok(())
    })
}
