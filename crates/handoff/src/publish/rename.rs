//! Rename of an output into its place.

use std::{
    fs::{self, File},
    io::{self, ErrorKind},
    path::Path,
};

pub(super) use crate::system::rename_or_exchange as put_in_place;

/// Renames `from` to `to`, by plain renames where the file system cannot exchange two names. Only a journal may know the
/// place between them. Returns true if both were exchanged.
pub(super) fn put_in_place_anyhow(from: &Path, to: &Path) -> io::Result<bool> {
    match put_in_place(from, to) {
        Err(e) if is_exchange_unknown(&e) => put_in_place_by_plain_renames(from, to),
        result => result,
    }
}

/// Undoes a rename of `from` to `to`, which has exchanged them or not.
pub(super) fn take_back(from: &Path, to: &Path, exchanged: bool) -> io::Result<()> {
    match exchanged {
        true => put_in_place_anyhow(from, to).map(drop),
        false => fs::rename(to, from),
    }
}

/// Returns true if the error means that the file system cannot exchange two names.
pub(super) fn is_exchange_unknown(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported)
}

/// Renames `from` to `to` as [`put_in_place`] does, but in three steps. Between the first two, the
/// old output has a temporary name, and its place is empty.
pub(super) fn put_in_place_by_plain_renames(from: &Path, to: &Path) -> io::Result<bool> {
    if fs::symlink_metadata(to).is_err() {
        return fs::rename(from, to).map(|()| false);
    }
    let old = from.with_extension("old.tmp");
    // The lock keeps other runs from taking it for abandoned.
    let held = File::open(to)?;
    let _ = held.try_lock();
    fs::rename(to, &old)?;
    match fs::rename(from, to) {
        Ok(()) => fs::rename(&old, from).map(|()| true),
        Err(e) => fs::rename(&old, to).and(Err(e)),
    }
}
