//! Publication of the outputs of a run: it moves finished outputs to their final places. Each appears whole, never as
//! a mixture of two runs, and survives a power failure.
//!
//! A kill, a full disk or a power failure may happen at any moment, and another run may write to
//! the same place. Therefore nothing is ever written in its final place:
//!
//! 1. every directory and file is written as a sibling of its place, `.planish-PID-N.tmp`, which the
//!    process holds by an advisory lock;
//! 2. the contents, then the directories, are synchronised with the disk;
//! 3. a single output is renamed into its place, in exchange for the previous one;
//! 4. of several outputs, the previous ones are first renamed to siblings, and then the new ones to
//!    their places.
//!
//! A process that ends within step 4 leaves some places empty. No place holds an output of another
//! run than its neighbour, and the same command makes all of them. Nothing but the run itself ever renames
//! its outputs: a reader reads, and does nothing else.
//!
//! During steps 3 and 4 the process holds advisory locks on all parent directories, so that the
//! outputs of two runs do not mix. A process that is killed leaves siblings whose lock is free, so the next
//! run removes them. On SIGINT, SIGTERM and SIGHUP a process removes its own siblings. On a file
//! system without advisory locks (some network file systems), all of this holds, except for the
//! order of two runs into one place.

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
    place::{
        absolute, create_directories, is_absent, parent_of, plain, refuse_foreign_files,
        special_file, sync_directory,
    },
    system::{file_identity, rename_or_exchange},
};

pub(crate) use self::{
    sibling::{remove_abandoned, remove_all_siblings},
    signals::{clean_up_on_signals, wait_for_signal_under_way},
};
pub use sibling::is_temporary;

/// Largest number of attempts to rename one output into its place while other runs create or remove
/// something there. Larger: a later message if the place accepts no name at all. Smaller: a run can
/// fail because of others. A run holds the directory, so that more than a few attempts mean such a
/// place.
const MOST_ATTEMPTS_TO_APPEAR: usize = 100;

/// A directory or file that is written to a temporary path and not visible yet. It is removed if it is dropped before
/// it is published.
#[derive(Debug)]
pub(crate) struct Staged {
    /// Temporary path, beside the final one, where the output is written.
    sibling: PathBuf,
    /// Final path of the output.
    place: PathBuf,
    what: What,
    /// Open file or directory, locked as long as this process may need the temporary path.
    file: File,
    /// Temporary path of the previous output, which was set aside, with its lock; `None` if there was none.
    previous: Option<(PathBuf, File)>,
    /// State of the rename to the final path.
    state: State,
}

/// State of the rename of a staged output to its final path.
#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    Hidden,
    /// Renamed to the final path, at which there was nothing.
    Renamed,
    /// Exchanged with the previous output, which now has the temporary path.
    Exchanged,
}

#[derive(Clone, Copy, Debug)]
enum What {
    /// An artifact. It replaces only a directory with files of its kind, and only if `replace` is
    /// true.
    Directory { kind: &'static Kind, replace: bool },
    /// A single file. It replaces an existing regular one only if `replace` is true.
    File { replace: bool },
    /// Nothing: an artifact of this kind goes away.
    Removal { kind: &'static Kind },
}

impl Staged {
    /// Creates an empty temporary directory for the final path `place`, which may be a link to a directory. If
    /// `replace` is true, it may replace an artifact of this kind.
    pub(crate) fn directory(
        place: &Path,
        kind: &'static Kind,
        replace: bool,
    ) -> Result<Self, HandoffError> {
        Self::new(place, What::Directory { kind, replace }, |sibling| {
            fs::create_dir(sibling).and_then(|()| File::open(sibling))
        })
    }

    /// Prepares the removal of the artifact of this kind at `place`, which may be a link to a directory.
    pub(crate) fn removal(place: &Path, kind: &'static Kind) -> Result<Self, HandoffError> {
        Self::new(place, What::Removal { kind }, |sibling| {
            fs::create_dir(sibling).and_then(|()| File::open(sibling))
        })
    }

    /// Creates an empty temporary file for the final path `place`. If `replace` is true, it may replace a regular
    /// file.
    pub(crate) fn file(place: &Path, replace: bool) -> Result<Self, HandoffError> {
        Self::new(place, What::File { replace }, |sibling| File::create_new(sibling))
    }

    fn new(
        place: &Path,
        what: What,
        create: impl Fn(&Path) -> io::Result<File>,
    ) -> Result<Self, HandoffError> {
        let place = if place.exists() {
            place.canonicalize().map_err(|e| HandoffError::io(place, "resolve", &e))?
        } else {
            // A rename fails if the new name ends with a dot or a slash.
            plain(place)
        };
        let parent = parent_of(&place);
        create_directories(&parent).map_err(|e| HandoffError::io(&parent, "create", &e))?;
        remove_abandoned(&parent);
        let (sibling, file) = sibling::create(&parent, create)
            .map_err(|e| HandoffError::io(&parent, "create a file there", &e))?;
        Ok(Self { sibling, place, what, file, previous: None, state: State::Hidden })
    }

    /// Returns true for a single file, false for a directory.
    pub(crate) fn is_file(&self) -> bool {
        matches!(self.what, What::File { .. })
    }

    /// Returns the temporary path to write to.
    pub(crate) fn path(&self) -> &Path {
        &self.sibling
    }

    /// Returns the open temporary file to write to.
    pub(crate) fn open_file(&mut self) -> &mut File {
        &mut self.file
    }

    /// Writes `bytes` as the whole content of a file.
    pub(crate) fn write_all(&mut self, bytes: &[u8]) -> Result<(), HandoffError> {
        self.file.write_all(bytes).map_err(|e| HandoffError::io(&self.place, "write", &e))
    }

    /// Refuses the final path if something is there that this output may not replace, because another program has put
    /// it there since the run began.
    fn check_place(&self) -> Result<(), HandoffError> {
        let taken = match (self.what, is_absent(&self.place)) {
            (_, true) => false,
            (What::File { replace }, false) => {
                if let Some(problem) = special_file(&self.place) {
                    return Err(HandoffError::new(
                        &self.place,
                        format!("{problem}; give another name"),
                    ));
                }
                !replace
            }
            (What::Directory { kind, replace }, false) => {
                refuse_foreign_files(&self.place, kind)?;
                let is_empty = fs::read_dir(&self.place).is_ok_and(|mut e| e.next().is_none());
                !(replace || is_empty)
            }
            (What::Removal { kind }, false) => {
                refuse_foreign_files(&self.place, kind)?;
                false
            }
        };
        if taken {
            let problem =
                "exists, made while this ran; give --force to replace it, or another name";
            return Err(HandoffError::new(&self.place, problem));
        }
        Ok(())
    }

    /// Renames the previous output to a temporary path, so that the final path is free; does nothing if nothing is
    /// there.
    fn set_aside(&mut self) -> Result<(), HandoffError> {
        let failed = |e: io::Error| HandoffError::io(&self.place, "write", &e);
        if is_absent(&self.place) {
            return Ok(());
        }
        // What another program has just put there stays.
        self.check_place()?;
        // The lock keeps other runs from taking it for abandoned.
        let lock = File::open(&self.place).map_err(failed)?;
        let _ = lock.try_lock();
        let aside = self.sibling.with_extension("old.tmp");
        fs::rename(&self.place, &aside).map_err(failed)?;
        self.previous = Some((aside, lock));
        Ok(())
    }

    /// Renames the output to its final path, in exchange for what may be there.
    fn appear(&mut self) -> Result<(), HandoffError> {
        if matches!(self.what, What::Removal { .. }) {
            return self.set_aside();
        }
        let mut failed = ErrorKind::AlreadyExists.into();
        for _ in 0..MOST_ATTEMPTS_TO_APPEAR {
            match rename_or_exchange(&self.sibling, &self.place) {
                Ok(exchanged) => {
                    self.state = if exchanged { State::Exchanged } else { State::Renamed };
                    return Ok(());
                }
                // The file system knows plain renames alone, between which the place is empty.
                Err(e) if matches!(e.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => {
                    self.set_aside()?;
                    fs::rename(&self.sibling, &self.place)
                        .map_err(|e| HandoffError::io(&self.place, "write", &e))?;
                    self.state = State::Renamed;
                    return Ok(());
                }
                // Another run has just created or removed something there.
                Err(e) if matches!(e.kind(), ErrorKind::AlreadyExists | ErrorKind::NotFound) => {
                    self.check_place()?;
                    failed = e;
                    if is_absent(&self.sibling) {
                        break;
                    }
                }
                Err(e) => return Err(HandoffError::io(&self.place, "write", &e)),
            }
        }
        Err(HandoffError::io(&self.place, "write", &failed))
    }

    /// Undoes the renames of this output. Whatever another program has put at the final path in the meantime stays
    /// there.
    fn take_back(&mut self) {
        let _ = match self.state {
            State::Hidden => Ok(()),
            State::Renamed => fs::rename(&self.place, &self.sibling),
            State::Exchanged => rename_or_exchange(&self.sibling, &self.place).map(drop),
        };
        self.state = State::Hidden;
        if let Some((aside, _)) = &self.previous
            && is_absent(&self.place)
            && fs::rename(aside, &self.place).is_ok()
        {
            self.previous = None;
        }
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        // The sibling is an output that was not published or, after an exchange, the previous one.
        sibling::remove(&self.sibling);
        sibling::forget(&self.sibling);
        if let Some((aside, _)) = &self.previous {
            sibling::remove(aside);
        }
    }
}

/// Makes all staged outputs visible, in their order. If one of them cannot be made visible, none is.
pub(crate) fn publish(mut staged: Vec<Staged>) -> Result<(), HandoffError> {
    for s in &staged {
        s.file.sync_all().map_err(|e| HandoffError::io(&s.place, "write", &e))?;
    }
    let mut parents: Vec<PathBuf> = staged.iter().map(|s| absolute(&parent_of(&s.place))).collect();
    parents.sort();
    parents.dedup();
    let _held = hold(&parents);
    // This check comes after the wait for the locks, because another run may have taken a place
    // meanwhile.
    staged.iter().try_for_each(Staged::check_place)?;
    let _appearing = signals::appearing();
    let shown = show(&mut staged, &parents);
    if shown.is_err() {
        staged.iter_mut().rev().for_each(Staged::take_back);
        let _ = synchronise(&parents);
    }
    // The previous outputs are removed while the locks are held.
    drop(staged);
    shown
}

/// Renames the outputs to their final paths. If there are several, all previous ones are removed before a new one
/// appears, also after a power failure. `parents` are their directories.
fn show(staged: &mut [Staged], parents: &[PathBuf]) -> Result<(), HandoffError> {
    if staged.len() > 1 {
        staged.iter_mut().try_for_each(Staged::set_aside)?;
        synchronise(parents)?;
    }
    staged.iter_mut().try_for_each(Staged::appear)?;
    synchronise(parents)
}

/// Writes the entries of directories through to the disk.
fn synchronise(directories: &[PathBuf]) -> Result<(), HandoffError> {
    for directory in directories {
        sync_directory(directory).map_err(|e| HandoffError::io(directory, "write", &e))?;
    }
    Ok(())
}

/// Locks directories by advisory locks, always in the same order, so that no two processes wait for each other. The
/// locks last as long as the returned files. On a file system without locks, nothing is locked.
fn hold(directories: &[PathBuf]) -> Vec<File> {
    let mut opened: Vec<File> = directories.iter().filter_map(|d| File::open(d).ok()).collect();
    opened.sort_by_key(file_identity);
    // A directory under two names would wait for itself.
    opened.dedup_by(|a, b| file_identity(a).is_some() && file_identity(a) == file_identity(b));
    opened.retain(|directory| directory.lock().is_ok());
    opened
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn text(path: &Path) -> String {
        fs::read_to_string(path).unwrap_or_default()
    }

    fn texts(dir: &Path) -> [String; 2] {
        ["a", "b"].map(|name| text(&dir.join(name)))
    }

    /// Returns two staged files that replace old ones.
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

    /// Forgets staged files and releases their locks. That leaves the same files as a process that was killed.
    fn leave(staged: Vec<Staged>) {
        for mut s in staged {
            s.file.unlock().unwrap();
            if let Some((_, lock)) = s.previous.take() {
                lock.unlock().unwrap();
            }
            std::mem::forget(s);
        }
    }

    /// Checks the files that a run leaves if it is killed after any of its renames.
    #[test]
    fn outputs_of_two_runs_never_stand_beside_each_other_and_the_next_run_is_whole() {
        for renames_done in 0..=4 {
            let dir = tempfile::tempdir().unwrap();
            let mut run = staged(dir.path());
            for (i, s) in run.iter_mut().enumerate() {
                if i < renames_done {
                    s.set_aside().unwrap();
                }
            }
            for (i, s) in run.iter_mut().enumerate() {
                if i + 2 < renames_done {
                    s.appear().unwrap();
                }
            }
            leave(run);
            let left = texts(dir.path());
            assert!(!(left.contains(&"old".into()) && left.contains(&"new".into())), "{left:?}");
            publish(staged(dir.path())).unwrap();
            assert_eq!(texts(dir.path()), ["new", "new"]);
            assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2, "{renames_done}");
        }
    }

    /// Checks that two runs into one directory do not leave a mixture of their artifacts.
    #[test]
    fn a_run_waits_while_another_lets_its_artifacts_appear() {
        let dir = tempfile::tempdir().unwrap();
        let run = staged(dir.path());
        let other = hold(&[dir.path().to_path_buf()]);
        let publishing = std::thread::spawn(|| publish(run));
        std::thread::sleep(Duration::from_millis(100));
        let meanwhile = texts(dir.path());
        drop(other);
        publishing.join().unwrap().unwrap();
        assert_eq!(meanwhile, ["old", "old"]);
        assert_eq!(texts(dir.path()), ["new", "new"]);
    }

    /// Checks that a run refuses a final path that was free when it was ready, and taken when its turn came.
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

    /// Checks that no reader or writer carries out renames that a file in the directory lists.
    #[test]
    fn a_file_beside_an_output_is_not_carried_out() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        fs::write(at("mine"), "mine").unwrap();
        fs::write(at("payload"), "evil").unwrap();
        let inode = std::os::unix::fs::MetadataExt::ino(&fs::metadata(at("payload")).unwrap());
        let journal = format!(
            r#"{{"renames": [{{"from": "{}", "to": "{}", "inode": {inode}}}]}}"#,
            at("payload").display(),
            at("mine").display()
        );
        fs::write(at(".planish-1-0.journal"), &journal).unwrap();
        publish(staged(dir.path())).unwrap();
        assert_eq!([text(&at("mine")), text(&at("payload"))], ["mine", "evil"]);
        assert_eq!(text(&at(".planish-1-0.journal")), journal);
    }

    #[test]
    fn siblings_of_a_living_run_are_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let mut run = staged(dir.path());
        run.iter_mut().try_for_each(Staged::set_aside).unwrap();
        remove_abandoned(dir.path());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 4);
        run.iter_mut().try_for_each(Staged::appear).unwrap();
        drop(run);
        assert_eq!(texts(dir.path()), ["new", "new"]);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    }

    #[test]
    fn renames_are_undone_from_every_state() {
        let dir = tempfile::tempdir().unwrap();
        let mut run = staged(dir.path());
        run.push(Staged::file(&dir.path().join("c"), false).unwrap());
        // a is exchanged, b is set aside and renamed, c is renamed to an empty place.
        run[1].set_aside().unwrap();
        run.iter_mut().try_for_each(Staged::appear).unwrap();
        assert_eq!(texts(dir.path()), ["new", "new"]);
        run.iter_mut().rev().for_each(Staged::take_back);
        assert_eq!(texts(dir.path()), ["old", "old"]);
        assert!(!run[2].place.exists());
        drop(run);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    }

    #[test]
    fn one_of_several_that_cannot_appear_takes_the_others_back() {
        let dir = tempfile::tempdir().unwrap();
        let mut run = staged(dir.path());
        run.push(Staged::file(&dir.path().join("c"), false).unwrap());
        // Another program takes the place after the run began.
        fs::write(dir.path().join("c"), "mine").unwrap();
        assert!(publish(run).unwrap_err().to_string().contains("c: exists"));
        // And after the check of all places.
        let mut run = staged(dir.path());
        run.push(Staged::file(&dir.path().join("c"), false).unwrap());
        let shown = show(&mut run, &[dir.path().to_path_buf()]);
        assert!(shown.unwrap_err().to_string().contains("c: exists"));
        run.iter_mut().rev().for_each(Staged::take_back);
        drop(run);
        let left = ["a", "b", "c"].map(|name| text(&dir.path().join(name)));
        assert_eq!(left, ["old", "old", "mine"]);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 3);
    }
}
