//! Helpers for paths on the disk: their parent directories, and their content.

use std::{
    fs::{self, File},
    io::{self, ErrorKind},
    path::{Path, PathBuf},
};

use crate::{
    HandoffError,
    kind::{Kind, MANIFEST},
};

/// Returns the path without redundant parts: a `.` within or at its end, and slashes at its end. The operating system
/// accepts such an end only for an existing directory.
pub(crate) fn plain(path: &Path) -> PathBuf {
    path.components().collect()
}

/// Returns the nearest existing parent of `path` if it is not a directory, so that `path` cannot be created. It is a
/// file, or a link that leads nowhere or to itself. `None` if nothing is in the way.
pub(crate) fn obstacle(path: &Path) -> Option<PathBuf> {
    let mut above = path.ancestors().skip(1).filter(|p| !p.as_os_str().is_empty());
    let there = above.find(|p| fs::symlink_metadata(p).is_ok())?;
    if there.is_dir() { None } else { Some(there.to_path_buf()) }
}

/// Returns the parent directory of `path`.
pub(crate) fn parent_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p.to_path_buf(),
        _ => PathBuf::from("."),
    }
}

/// Creates `dir` and its missing parents. All of them are on the disk when the function returns.
pub(crate) fn create_directories(dir: &Path) -> io::Result<()> {
    if dir.is_dir() {
        return Ok(());
    }
    let parent = parent_of(dir);
    create_directories(&parent)?;
    match fs::create_dir(dir) {
        // Another run has just created it.
        Err(e) if e.kind() == ErrorKind::AlreadyExists && dir.is_dir() => Ok(()),
        Err(e) => Err(e),
        Ok(()) => sync_directory(&parent),
    }
}

/// Writes the entries of a directory through to the disk (fsync).
pub(crate) fn sync_directory(dir: &Path) -> io::Result<()> {
    match File::open(dir).and_then(|dir| dir.sync_all()) {
        // The file system cannot synchronise directories.
        Err(e) if matches!(e.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        result => result,
    }
}

/// Returns the absolute path, so that a process with another current directory can use it.
pub(crate) fn absolute(path: &Path) -> PathBuf {
    path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.into())
}

/// Returns true if nothing exists at `path`. A broken link or an unreadable file counts as something.
pub(crate) fn is_absent(path: &Path) -> bool {
    fs::symlink_metadata(path).is_err_and(|e| e.kind() == ErrorKind::NotFound)
}

/// Returns why a file must not replace what is at `path`: a pipe, a device, a socket, or a link that leads nowhere.
/// `None` for a regular file, for a link to one, and if nothing is there.
pub(crate) fn special_file(path: &Path) -> Option<String> {
    match fs::metadata(path) {
        Ok(metadata) if metadata.is_file() => None,
        Ok(_) => Some("is not a regular file, and nothing replaces it".into()),
        Err(_) if is_absent(path) => None,
        Err(e) if e.kind() == ErrorKind::NotFound => Some("is a link to nothing".into()),
        Err(e) => Some(format!("cannot be written: {e}")),
    }
}

/// Refuses a directory that holds what would be lost: a directory, a file that no artifact of `kind` has, a pipe or
/// device, or any file if there is no manifest. An empty directory passes.
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
        if let Some(problem) = special_file(&entry.path()) {
            let remedy = "move it elsewhere, or choose another --out";
            return Err(HandoffError::new(&entry.path(), format!("{problem}; {remedy}")));
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

/// Returns true if `path` is `dir` or leads into it. Links are followed as far as they exist.
pub(crate) fn is_within(path: &Path, dir: &Path) -> bool {
    resolved(path).starts_with(resolved(dir))
}

/// Returns the absolute path without links and `..`. A part that does not exist yet is appended unchanged.
fn resolved(path: &Path) -> PathBuf {
    if let Ok(whole) = path.canonicalize() {
        return whole;
    }
    match path.file_name() {
        Some(name) => resolved(&parent_of(path)).join(name),
        None => std::path::absolute(Path::new(".").join(path)).unwrap_or_else(|_| path.into()),
    }
}
