//! Publication of the outputs of a run: whole, all of them together, and safe against power
//! failures.
//!
//! A kill, a full disk or a power failure may happen at any moment, and another run may write to
//! the same place. Therefore nothing is ever written in its final place:
//!
//! 1. every directory and file is written as a sibling of its place, `.planish-PID-N.tmp`, which the
//!    process holds by an advisory lock;
//! 2. the contents, then the directories, are synchronised with the disk;
//! 3. if several outputs appear together, a journal `.planish-PID-N.journal` lists their renames;
//! 4. each output is renamed into its place, in exchange for the previous one, and its parent
//!    directory is synchronised; then the journal is removed, and after it the previous outputs.
//!
//! During steps 3 and 4 the process holds advisory locks on all parent directories, so that the
//! outputs of two runs do not mix. A process that ends there leaves its journal. The next reader or
//! writer finishes the renames under the same locks, so a reader sees all of a run or nothing of
//! it. Where one of them fails, it undoes the others. A process that ends earlier leaves siblings without a
//! journal; their lock is free, so the next run removes them. On SIGINT and SIGTERM a process removes its own siblings. On a file
//! system without advisory locks (some network file systems), all of this holds, except for the
//! order of two runs into one place.

mod journal;
mod rename;
mod sibling;
mod signals;

use std::{
    fs::{self, File},
    io::{self, ErrorKind, Write},
    path::{Path, PathBuf},
};

use crate::{
    HandoffError,
    kind::Kind,
    place::{absolute, create_directories, parent_of, plain, refuse_foreign_files, sync_directory},
    system::inode,
};
use rename::{is_exchange_unknown, put_in_place, put_in_place_by_plain_renames, take_back};

pub(crate) use self::{
    journal::finish_interrupted,
    sibling::{remove_abandoned, remove_all_siblings},
    signals::{clean_up_on_signals, wait_for_signal_under_way},
};
pub use sibling::is_temporary;

/// Largest number of attempts to rename one output into its place while other runs create or remove
/// something there. Larger: a later message if the place accepts no name at all. Smaller: a run can
/// fail because of others. A run holds the directory, so that more than a few attempts mean such a
/// place.
const MOST_ATTEMPTS_TO_APPEAR: usize = 100;

/// A directory or file that is written and not visible yet. It is removed if it is dropped before
/// that.
#[derive(Debug)]
pub(crate) struct Staged {
    /// Temporary path where it is written.
    sibling: PathBuf,
    /// Final path.
    place: PathBuf,
    what: What,
    /// Open and locked as long as this process may need the sibling.
    file: File,
}

#[derive(Clone, Copy, Debug)]
enum What {
    /// An artifact. It replaces only a directory with files of its kind, and only if `replace` is
    /// true.
    Directory { kind: &'static Kind, replace: bool },
    /// A single file. It replaces an existing one only if `replace` is true.
    File { replace: bool },
}

impl Staged {
    /// An empty directory with the final path `place`, which may be a link to a directory.
    pub(crate) fn directory(
        place: &Path,
        kind: &'static Kind,
        replace: bool,
    ) -> Result<Self, HandoffError> {
        let create = |sibling: &Path| fs::create_dir(sibling).and_then(|()| File::open(sibling));
        Self::new(place, What::Directory { kind, replace }, create)
    }

    /// An empty file with the final path `place`.
    pub(crate) fn file(place: &Path, replace: bool) -> Result<Self, HandoffError> {
        Self::new(place, What::File { replace }, |sibling| File::create_new(sibling))
    }

    fn new(
        place: &Path,
        what: What,
        create: impl Fn(&Path) -> io::Result<File>,
    ) -> Result<Self, HandoffError> {
        let place = match place.exists() {
            true => place.canonicalize().map_err(|e| HandoffError::io(place, "resolve", &e))?,
            // A rename fails if the new name ends with a dot or a slash.
            false => plain(place),
        };
        let parent = parent_of(&place);
        create_directories(&parent).map_err(|e| HandoffError::io(&parent, "create", &e))?;
        finish_interrupted(&parent);
        remove_abandoned(&parent);
        let (sibling, file) = sibling::create(&parent, create)
            .map_err(|e| HandoffError::io(&parent, "create a file there", &e))?;
        Ok(Self { sibling, place, what, file })
    }

    /// Path to write to.
    pub(crate) fn path(&self) -> &Path {
        &self.sibling
    }

    /// Open file to write to.
    pub(crate) fn open_file(&mut self) -> &mut File {
        &mut self.file
    }

    /// Writes the whole content of a file.
    pub(crate) fn write_all(&mut self, bytes: &[u8]) -> Result<(), HandoffError> {
        self.file.write_all(bytes).map_err(|e| HandoffError::io(&self.place, "write", &e))
    }

    /// Refuses a place that another program has taken since the run began.
    fn check_place(&self) -> Result<(), HandoffError> {
        let taken = match (self.what, fs::symlink_metadata(&self.place).is_ok()) {
            (_, false) | (What::File { replace: true }, _) => false,
            (What::File { replace: false }, _) => true,
            (What::Directory { kind, replace }, _) => {
                refuse_foreign_files(&self.place, kind)?;
                let is_empty = fs::read_dir(&self.place).is_ok_and(|mut e| e.next().is_none());
                !(replace || is_empty)
            }
        };
        match taken {
            true => Err(HandoffError::new(
                &self.place,
                "exists, made while this ran; give --force to replace it, or another name",
            )),
            false => Ok(()),
        }
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        // The sibling is an output that was not published or, after an exchange, the previous one.
        sibling::remove(&self.sibling);
        sibling::forget(&self.sibling);
    }
}

/// Makes all staged outputs visible together.
pub(crate) fn publish(staged: Vec<Staged>) -> Result<(), HandoffError> {
    for s in &staged {
        s.file.sync_all().map_err(|e| HandoffError::io(&s.place, "write", &e))?;
    }
    let mut parents: Vec<PathBuf> = staged.iter().map(|s| absolute(&parent_of(&s.place))).collect();
    parents.sort();
    parents.dedup();
    let _held = journal::hold_without_journals(&parents);
    // This check comes after the wait for the locks, because another run may have taken a place
    // meanwhile.
    staged.iter().try_for_each(Staged::check_place)?;
    let _appearing = signals::appearing();
    let mut journals = match staged.len() {
        0 | 1 => Vec::new(),
        _ => write_journals(&staged, &parents)?,
    };
    let mut shown = Vec::new();
    let mut renamed = Ok(());
    for s in &staged {
        let mut exchanged = None;
        let mut attempts = 0;
        while renamed.is_ok() && exchanged.is_none() {
            match put_in_place(&s.sibling, &s.place) {
                Ok(done) => exchanged = Some(done),
                // Another run has just created or removed something there.
                Err(e) if matches!(e.kind(), ErrorKind::AlreadyExists | ErrorKind::NotFound) => {
                    attempts += 1;
                    let again = attempts < MOST_ATTEMPTS_TO_APPEAR && inode(&s.sibling).is_some();
                    renamed = s.check_place().and_then(|()| match again {
                        false => Err(HandoffError::io(&s.place, "write", &e)),
                        true => Ok(()),
                    });
                }
                // Without an exchange, there is a moment in which only the journal knows the place.
                Err(e) if is_exchange_unknown(&e) && journals.is_empty() => {
                    match write_journals(&staged, &parents) {
                        Ok(written) => journals = written,
                        Err(e) => renamed = Err(e),
                    }
                }
                Err(e) if is_exchange_unknown(&e) => {
                    match put_in_place_by_plain_renames(&s.sibling, &s.place) {
                        Ok(done) => exchanged = Some(done),
                        Err(e) => renamed = Err(HandoffError::io(&s.place, "write", &e)),
                    }
                }
                Err(e) => renamed = Err(HandoffError::io(&s.place, "write", &e)),
            }
        }
        shown.extend(exchanged.map(|exchanged| (s, exchanged)));
    }
    if renamed.is_err() {
        // All or nothing: undo the renames that are done.
        for (s, exchanged) in shown.into_iter().rev() {
            let _ = take_back(&s.sibling, &s.place, exchanged);
        }
    }
    for parent in &parents {
        sync_directory(parent).map_err(|e| HandoffError::io(parent, "write", &e))?;
    }
    for journal in journals {
        let _ = fs::remove_file(journal);
    }
    renamed
}

/// Writes the journals of the staged outputs, one in each parent directory.
fn write_journals(staged: &[Staged], parents: &[PathBuf]) -> Result<Vec<PathBuf>, HandoffError> {
    journal::write(staged.iter().map(|s| (&*s.sibling, &*s.place)), parents)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::{journal::hold, *};

    fn text(path: &Path) -> String {
        fs::read_to_string(path).unwrap_or_default()
    }

    /// Two staged files that replace old ones. A `Staged` that is forgotten, with its lock
    /// released, leaves the same files as a process that was killed.
    fn staged(dir: &Path) -> Vec<Staged> {
        for name in ["a", "b"] {
            fs::write(dir.join(name), "old").unwrap();
        }
        let stage = |name| {
            let mut staged = Staged::file(&dir.join(name), true).unwrap();
            staged.write_all(b"new").unwrap();
            staged
        };
        vec![stage("a"), stage("b")]
    }

    fn leave(staged: Vec<Staged>) {
        for s in staged {
            s.file.unlock().unwrap();
            std::mem::forget(s);
        }
    }

    #[test]
    fn a_run_that_ended_between_its_renames_is_finished_by_the_next() {
        for renames_done in 0..=2 {
            let dir = tempfile::tempdir().unwrap();
            let run = staged(dir.path());
            write_journals(&run, &[dir.path().to_path_buf()]).unwrap();
            for s in &run[..renames_done] {
                put_in_place(&s.sibling, &s.place).unwrap();
            }
            leave(run);
            // A writer without a journal of its own must not remove the siblings.
            remove_abandoned(dir.path());
            finish_interrupted(dir.path());
            assert_eq!(
                (text(&dir.path().join("a")), text(&dir.path().join("b"))),
                ("new".into(), "new".into())
            );
            remove_abandoned(dir.path());
            assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2, "{renames_done}");
        }
    }

    /// Earlier, each of two runs renamed one artifact before the other, and the directory held a
    /// mixture.
    #[test]
    fn a_run_waits_while_another_lets_its_artifacts_appear() {
        let dir = tempfile::tempdir().unwrap();
        let run = staged(dir.path());
        let other = hold(&[dir.path().to_path_buf()]);
        let publishing = std::thread::spawn(|| publish(run));
        std::thread::sleep(Duration::from_millis(100));
        let meanwhile = ["a", "b"].map(|name| text(&dir.path().join(name)));
        drop(other);
        publishing.join().unwrap().unwrap();
        assert_eq!(meanwhile, ["old", "old"]);
        assert_eq!(["a", "b"].map(|name| text(&dir.path().join(name))), ["new", "new"]);
    }

    /// A place that was free when the run was ready, and taken when its turn came.
    #[test]
    fn a_place_that_is_taken_while_a_run_waits_is_not_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let other = hold(&[dir.path().to_path_buf()]);
        let run = vec![Staged::file(&dir.path().join("c"), false).unwrap()];
        let publishing = std::thread::spawn(|| publish(run));
        std::thread::sleep(Duration::from_millis(100));
        fs::write(dir.path().join("c"), "mine").unwrap();
        drop(other);
        let message = publishing.join().unwrap().unwrap_err().to_string();
        assert!(message.contains("c: exists"), "{message}");
        assert_eq!(text(&dir.path().join("c")), "mine");
    }

    /// Earlier, a later reader finished the journal of the first run, and replaced the outputs of
    /// the second run.
    #[test]
    fn a_run_that_ended_between_its_renames_is_finished_before_the_next_appears() {
        let dir = tempfile::tempdir().unwrap();
        let first = staged(dir.path());
        let mut second = staged(dir.path());
        for s in &mut second {
            s.write_all(b"er").unwrap();
        }
        write_journals(&first, &[dir.path().to_path_buf()]).unwrap();
        leave(first);
        publish(second).unwrap();
        finish_interrupted(dir.path());
        assert_eq!(["a", "b"].map(|name| text(&dir.path().join(name))), ["newer", "newer"]);
        remove_abandoned(dir.path());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    }

    #[test]
    fn what_is_no_journal_is_no_obstacle() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join(".planish-1-0.journal"), "{").unwrap();
        publish(staged(dir.path())).unwrap();
        assert_eq!(["a", "b"].map(|name| text(&dir.path().join(name))), ["new", "new"]);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    }

    #[test]
    fn a_run_that_ended_before_its_journal_never_was() {
        let dir = tempfile::tempdir().unwrap();
        leave(staged(dir.path()));
        finish_interrupted(dir.path());
        remove_abandoned(dir.path());
        assert_eq!(
            (text(&dir.path().join("a")), text(&dir.path().join("b"))),
            ("old".into(), "old".into())
        );
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    }

    #[test]
    fn siblings_of_a_living_run_are_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let run = staged(dir.path());
        remove_abandoned(dir.path());
        publish(run).unwrap();
        assert_eq!(
            (text(&dir.path().join("a")), text(&dir.path().join("b"))),
            ("new".into(), "new".into())
        );
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    }

    /// Earlier, the undoing of a rename needed the exchange that the file system does not have.
    #[test]
    fn a_rename_is_undone_where_names_cannot_be_exchanged() {
        let dir = tempfile::tempdir().unwrap();
        let mut run = staged(dir.path());
        run.push(Staged::file(&dir.path().join("c"), false).unwrap());
        for s in &run {
            let exchanged = put_in_place_by_plain_renames(&s.sibling, &s.place).unwrap();
            assert_eq!(exchanged, !s.place.ends_with("c"));
            take_back(&s.sibling, &s.place, exchanged).unwrap();
        }
        assert_eq!(["a", "b"].map(|name| text(&dir.path().join(name))), ["old", "old"]);
        assert!(!run[2].place.exists() && run[2].sibling.exists());
    }

    /// Earlier, the journal was removed and left the first output of the run beside the old second one.
    #[test]
    fn a_journal_that_cannot_be_finished_is_undone() {
        for renames_done in 0..=1 {
            let dir = tempfile::tempdir().unwrap();
            let run = staged(dir.path());
            // The second place is in a directory that a file has replaced meanwhile.
            fs::write(dir.path().join("d"), "mine").unwrap();
            let places = [run[0].place.clone(), dir.path().join("d/b")];
            let renames = run.iter().map(|s| &*s.sibling).zip(places.iter().map(|p| &**p));
            journal::write(renames, &[dir.path().to_path_buf()]).unwrap();
            for s in &run[..renames_done] {
                put_in_place(&s.sibling, &s.place).unwrap();
            }
            leave(run);
            finish_interrupted(dir.path());
            assert_eq!(text(&dir.path().join("a")), "old");
            remove_abandoned(dir.path());
            assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 3, "{renames_done}");
        }
    }

    #[test]
    fn where_names_cannot_be_exchanged_three_renames_do_it() {
        let dir = tempfile::tempdir().unwrap();
        let run = staged(dir.path());
        assert!(put_in_place_by_plain_renames(&run[0].sibling, &run[0].place).unwrap());
        assert_eq!((text(&run[0].place), text(&run[0].sibling)), ("new".into(), "old".into()));
    }

    #[test]
    fn one_of_several_that_cannot_appear_takes_the_others_back() {
        let dir = tempfile::tempdir().unwrap();
        let mut run = staged(dir.path());
        run.push(Staged::file(&dir.path().join("c"), false).unwrap());
        // Another program takes the place after the run began.
        fs::write(dir.path().join("c"), "mine").unwrap();
        assert!(publish(run).unwrap_err().to_string().contains("c: exists"));
        let left = ["a", "b", "c"].map(|name| text(&dir.path().join(name)));
        assert_eq!(left, ["old", "old", "mine"]);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 3);
    }
}
