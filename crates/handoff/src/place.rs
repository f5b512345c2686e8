//! Places on the disk: the directories above them, and what stands in them.

use std::{
    fs::{self, File},
    io::{self, ErrorKind},
    path::{Path, PathBuf},
};

use crate::{
    HandoffError,
    kind::{Kind, MANIFEST},
};

/// The path without what changes nothing: a `.` within or at its end, and slashes at its end. The system accepts such an
/// end for a directory that exists, and for nothing that is still to be made.
pub(crate) fn plain(path: &Path) -> PathBuf {
    path.components().collect()
}

/// The first part of `path`, from its root, that exists and is no directory, although the rest is to be made in it: a
/// file, or a link that leads nowhere or to itself.
pub(crate) fn obstacle(path: &Path) -> Option<PathBuf> {
    let mut above = path.ancestors().skip(1).filter(|p| !p.as_os_str().is_empty());
    let there = above.find(|p| fs::symlink_metadata(p).is_ok())?;
    (!there.is_dir()).then(|| there.to_path_buf())
}

/// The directory in which `path` stands.
pub(crate) fn parent_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p.to_path_buf(),
        _ => PathBuf::from("."),
    }
}

/// Creates `dir` and what lacks above it, each synchronised with the disk.
pub(crate) fn create_directories(dir: &Path) -> io::Result<()> {
    if dir.is_dir() {
        return Ok(());
    }
    let parent = parent_of(dir);
    create_directories(&parent)?;
    match fs::create_dir(dir) {
        // By another run a moment ago.
        Err(e) if e.kind() == ErrorKind::AlreadyExists && dir.is_dir() => Ok(()),
        Err(e) => Err(e),
        Ok(()) => sync_directory(&parent),
    }
}

/// What a directory holds is on the disk afterwards.
pub(crate) fn sync_directory(dir: &Path) -> io::Result<()> {
    match File::open(dir).and_then(|dir| dir.sync_all()) {
        // A file system that cannot synchronise directories.
        Err(e) if matches!(e.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        result => result,
    }
}

/// The path from the root, so that another process finds it.
pub(crate) fn absolute(path: &Path) -> PathBuf {
    path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.into())
}

/// Whether there is nothing of this name; a broken link or an unreadable file is something.
pub(crate) fn is_absent(path: &Path) -> bool {
    fs::symlink_metadata(path).is_err_and(|e| e.kind() == ErrorKind::NotFound)
}

/// Refuses a directory with anything in it that no artifact of `kind` has: it would be lost.
pub(crate) fn refuse_foreign_files(dir: &Path, kind: &Kind) -> Result<(), HandoffError> {
    let is_bare = is_absent(&dir.join(MANIFEST));
    let entries = fs::read_dir(dir).map_err(|e| HandoffError::io(dir, "read", &e))?;
    for entry in entries {
        let entry = entry.map_err(|e| HandoffError::io(dir, "read", &e))?;
        let name = entry.file_name();
        let is_directory = entry.file_type().map_or(true, |t| t.is_dir());
        if is_directory || !kind.file_names().any(|known| *known == *name) {
            return Err(HandoffError::new(
                dir,
                format!(
                    "holds {}, which no {} has; choose another --out",
                    name.display(),
                    kind.name
                ),
            ));
        }
        if is_bare {
            return Err(HandoffError::new(
                dir,
                format!(
                    "holds {} and no {MANIFEST}, so Planish did not write it; choose another --out",
                    name.display()
                ),
            ));
        }
    }
    Ok(())
}
