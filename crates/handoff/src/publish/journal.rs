//! The journal of what appears together, and the locks on the directories in which it appears.

use std::{
    fs::{self, File},
    io::Write,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{
    rename::{is_exchange_unknown, put_in_place, put_in_place_by_plain_renames},
    sibling::{self, JOURNAL, identity, inode, temporaries},
};
use crate::{
    HandoffError,
    place::{absolute, parent_of, sync_directory},
};

/// A process would have to end between its renames as often as this while another waits for its turn;
/// a journal that is still there cannot be removed, and what it names does not come back.
const MOST_ATTEMPTS_TO_FINISH: usize = 16;

/// What is to appear together.
#[derive(Default, Serialize, Deserialize)]
struct Journal {
    renames: Vec<Rename>,
}

/// One of them.
#[derive(Serialize, Deserialize)]
struct Rename {
    from: PathBuf,
    to: PathBuf,
    /// Of what is to appear: it tells whether the rename has been done.
    inode: u64,
}

/// Holds directories by their advisory locks, always in the same order, so that no two processes wait for
/// each other. Where the file system has no locks, nothing is held.
pub(super) fn hold(directories: &[PathBuf]) -> Vec<File> {
    let mut opened: Vec<File> = directories.iter().filter_map(|d| File::open(d).ok()).collect();
    opened.sort_by_key(identity);
    // One directory under two names would wait for itself.
    opened.dedup_by(|a, b| identity(a).is_some() && identity(a) == identity(b));
    opened.retain(|directory| directory.lock().is_ok());
    opened
}

/// Holds directories in which no journal of a process that is gone waits to be finished.
pub(super) fn hold_without_journals(directories: &[PathBuf]) -> Vec<File> {
    let mut held = Vec::new();
    for _ in 0..MOST_ATTEMPTS_TO_FINISH {
        // Released first: what finishes a journal holds its directories itself.
        held.clear();
        directories.iter().for_each(|directory| finish_interrupted(directory));
        held = hold(directories);
        let waits = |d: &PathBuf| !temporaries(d, JOURNAL).is_empty();
        // Without locks a journal may be of a process that lives, which removes it.
        if held.is_empty() || !directories.iter().any(waits) {
            break;
        }
    }
    held
}

/// Writes the journal into every directory in `parents`: each sibling is to become its place.
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
        // Complete before it is called a journal.
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

/// Finishes what a process that is gone began to show in `parent`; waits for one that is at it.
pub(crate) fn finish_interrupted(parent: &Path) {
    for path in temporaries(parent, JOURNAL) {
        // What cannot be read is left to who can read it; what is no journal asks for nothing.
        let Ok(bytes) = fs::read(&path) else { continue };
        let journal: Journal = serde_json::from_slice(&bytes).unwrap_or_default();
        let mut directories: Vec<PathBuf> =
            journal.renames.iter().map(|rename| parent_of(&rename.to)).collect();
        directories.push(parent.to_path_buf());
        let held = hold(&directories);
        // Its process, or another that finished it, removed it meanwhile.
        if held.is_empty() || fs::symlink_metadata(&path).is_err() {
            continue;
        }
        for rename in journal.renames {
            if inode(&rename.from) != Some(rename.inode) {
                continue; // it is done
            }
            let put = match put_in_place(&rename.from, &rename.to) {
                Err(e) if is_exchange_unknown(&e) => {
                    put_in_place_by_plain_renames(&rename.from, &rename.to)
                }
                result => result,
            };
            if put.is_ok() {
                let _ = sync_directory(&parent_of(&rename.to));
            }
        }
        let _ = fs::remove_file(&path);
    }
}
