//! How what a run writes appears: whole, all of it together, and still there after a power failure.
//!
//! A kill, a full disk or a power failure may come at any moment, and another run may write the same
//! place. So nothing is ever written where it is to stand:
//!
//! 1. every directory and file is written as a sibling of its place, `.planish-PID-N.tmp`, which the
//!    process holds by an advisory lock;
//! 2. the contents, then the directories, are synchronised with the disk;
//! 3. where several appear together, a journal `.planish-PID-N.journal` says what is to go where;
//! 4. each is renamed into its place, in exchange for what stood there, and the directory above is
//!    synchronised; the journal goes, then what was replaced.
//!
//! During steps 3 and 4 the process holds advisory locks on all directories in which something appears,
//! so that what two runs write together does not mix. A process that ends there leaves its
//! journal. Whoever reads or writes there next finishes the renames under the same locks, so that a
//! reader sees all of a run or nothing of it. A process that ends earlier leaves siblings without a
//! journal; their lock is free, so the next run removes them. On SIGINT and SIGTERM a process removes its
//! own. A file system without advisory locks (some network file systems) keeps all of this but for the
//! order of two runs into one place.

use std::{
    fs::{self, File, TryLockError},
    io::{self, ErrorKind, Write},
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use serde::{Deserialize, Serialize};

use crate::{HandoffError, artifact::refuse_foreign_files, kind, kind::Kind};

/// What the names of everything temporary begin with.
const PREFIX: &str = ".planish-";

/// What stands at the end of a sibling that is not shown yet, and of a journal.
const TEMPORARY: &str = ".tmp";
const JOURNAL: &str = ".journal";

/// Temporary siblings of this process, for the handler of signals.
static SIBLINGS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Held while a run appears: a signal waits until all of it is there.
static APPEARING: Mutex<()> = Mutex::new(());

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // What the mutexes hold is whole whatever panicked meanwhile.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A directory or file that is written and not shown yet; removed when it is dropped before that.
#[derive(Debug)]
pub(crate) struct Staged {
    /// Where it is written.
    sibling: PathBuf,
    /// Where it is to appear.
    place: PathBuf,
    what: What,
    /// Open and locked as long as this process may need the sibling.
    file: File,
}

#[derive(Clone, Copy, Debug)]
enum What {
    /// An artifact; only a directory with files of its kind is replaced, and only where `replace`.
    Directory { kind: &'static Kind, replace: bool },
    /// A single file, and whether one that stands there is replaced.
    File { replace: bool },
}

impl Staged {
    /// An empty directory that is to appear as `place`, which may be a link to a directory.
    pub(crate) fn directory(
        place: &Path,
        kind: &'static Kind,
        replace: bool,
    ) -> Result<Self, HandoffError> {
        let create = |sibling: &Path| fs::create_dir(sibling).and_then(|()| File::open(sibling));
        Self::new(place, What::Directory { kind, replace }, create)
    }

    /// An empty file that is to appear as `place`.
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
            false => place.to_path_buf(),
        };
        let parent = parent_of(&place);
        create_directories(&parent).map_err(|e| HandoffError::io(&parent, "create", &e))?;
        finish_interrupted(&parent);
        remove_abandoned(&parent);
        let (sibling, file) = create_sibling(&parent, create)
            .map_err(|e| HandoffError::io(&parent, "create a file there", &e))?;
        Ok(Self { sibling, place, what, file })
    }

    /// Where to write it.
    pub(crate) fn path(&self) -> &Path {
        &self.sibling
    }

    /// The file to write it to.
    pub(crate) fn open_file(&mut self) -> &mut File {
        &mut self.file
    }

    /// Writes all of a file.
    pub(crate) fn write_all(&mut self, bytes: &[u8]) -> Result<(), HandoffError> {
        self.file.write_all(bytes).map_err(|e| HandoffError::io(&self.place, "write", &e))
    }

    /// Refuses a place that has been taken since the run began.
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
        // What was written in vain, or after an exchange what stood there before.
        remove_sibling(&self.sibling);
        lock(&SIBLINGS).retain(|sibling| *sibling != self.sibling);
    }
}

/// Lets everything that was staged appear together.
pub(crate) fn publish(staged: Vec<Staged>) -> Result<(), HandoffError> {
    for s in &staged {
        s.file.sync_all().map_err(|e| HandoffError::io(&s.place, "write", &e))?;
    }
    let mut parents: Vec<PathBuf> = staged.iter().map(|s| absolute(&parent_of(&s.place))).collect();
    parents.sort();
    parents.dedup();
    let _held = hold_without_journals(&parents);
    // Only now: while this run waited for its turn another may have taken a place.
    staged.iter().try_for_each(Staged::check_place)?;
    let _appearing = lock(&APPEARING);
    let mut journals = match staged.len() {
        0 | 1 => Vec::new(),
        _ => write_journals(&staged, &parents)?,
    };
    let mut shown = Vec::new();
    let mut renamed = Ok(());
    for s in &staged {
        let mut exchanged = None;
        while renamed.is_ok() && exchanged.is_none() {
            match put_in_place(&s.sibling, &s.place) {
                Ok(done) => exchanged = Some(done),
                // Another run put something there or took it away a moment ago.
                Err(e) if matches!(e.kind(), ErrorKind::AlreadyExists | ErrorKind::NotFound) => {
                    renamed = s.check_place().and_then(|()| match inode(&s.sibling) {
                        None => Err(HandoffError::io(&s.place, "write", &e)),
                        Some(_) => Ok(()),
                    });
                }
                // Without an exchange there is a moment in which only the journal knows the place.
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
        // All or nothing: back with those that stand already.
        for (s, exchanged) in shown.into_iter().rev() {
            let _ = match exchanged {
                true => put_in_place(&s.sibling, &s.place).map(drop),
                false => fs::rename(&s.place, &s.sibling),
            };
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

/// Removes every temporary sibling of this process: it is about to end.
pub(crate) fn remove_all_siblings() {
    // Whoever runs out of memory may hold the list.
    if let Ok(siblings) = SIBLINGS.try_lock() {
        siblings.iter().for_each(|sibling| remove_sibling(sibling));
    }
}

/// Returns unless a signal is ending the process, which then ends by it.
pub(crate) fn wait_for_signal_under_way() {
    drop(lock(&SIBLINGS));
}

/// From now on SIGINT, SIGTERM and SIGHUP end the process as they always do, and its siblings with it.
#[cfg(unix)]
pub(crate) fn clean_up_on_signals() {
    use signal_hook::{consts::signal, iterator::Signals, low_level::emulate_default_handler};
    let Ok(mut signals) = Signals::new([signal::SIGINT, signal::SIGTERM, signal::SIGHUP]) else {
        return;
    };
    std::thread::spawn(move || {
        for signal in &mut signals {
            let _appearing = lock(&APPEARING);
            // Held to the end: from now on the other threads stage nothing more, nor end the process.
            let siblings = lock(&SIBLINGS);
            for sibling in siblings.iter() {
                // The other threads may still be creating files in it.
                for _ in 0..MOST_REMOVALS {
                    remove_sibling(sibling);
                    if fs::symlink_metadata(sibling).is_err() {
                        break;
                    }
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
            let _ = emulate_default_handler(signal);
        }
    });
}

/// How often a directory is emptied into which another thread is writing.
#[cfg(unix)]
const MOST_REMOVALS: usize = 100;

#[cfg(not(unix))]
pub(crate) fn clean_up_on_signals() {}

// ---- siblings ------------------------------------------------------------------------------------

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

/// A new sibling in `parent`, locked and known to the handler of signals. Numbers count up because a
/// container gives every run the same process id.
fn create_sibling(
    parent: &Path,
    create: impl Fn(&Path) -> io::Result<File>,
) -> io::Result<(PathBuf, File)> {
    let mut count = 0;
    loop {
        let sibling = parent.join(format!("{PREFIX}{}-{count}{TEMPORARY}", std::process::id()));
        count += 1;
        // Under one lock, so that the handler of signals sees it as soon as it is there.
        let mut siblings = lock(&SIBLINGS);
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
                lock(&SIBLINGS).retain(|known| *known != sibling);
            }
            // Not found: removed by another run, see above.
            Err(e) => {
                let again = matches!(e.kind(), ErrorKind::AlreadyExists | ErrorKind::NotFound);
                if !again || !parent.is_dir() {
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
fn temporaries(parent: &Path, end: &str) -> Vec<PathBuf> {
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
            remove_sibling(&sibling);
        }
    }
}

/// Removes a sibling. Of a directory only what an artifact may hold: a file that somebody put into the
/// old artifact at the moment of the exchange is left there.
fn remove_sibling(sibling: &Path) {
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
fn identity(file: &File) -> Option<(u64, u64)> {
    use std::os::unix::fs::MetadataExt;
    file.metadata().ok().map(|m| (m.dev(), m.ino()))
}

#[cfg(not(unix))]
fn identity(_: &File) -> Option<(u64, u64)> {
    None
}

#[cfg(not(unix))]
fn is_at(_: &File, path: &Path) -> bool {
    path.exists()
}

/// What a directory holds is on the disk afterwards.
fn sync_directory(dir: &Path) -> io::Result<()> {
    match File::open(dir).and_then(|dir| dir.sync_all()) {
        // A file system that cannot synchronise directories.
        Err(e) if matches!(e.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        result => result,
    }
}

// ---- the journal ---------------------------------------------------------------------------------

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

#[cfg(unix)]
fn inode(path: &Path) -> Option<u64> {
    use std::os::unix::fs::MetadataExt;
    fs::symlink_metadata(path).ok().map(|m| m.ino())
}

#[cfg(not(unix))]
fn inode(_: &Path) -> Option<u64> {
    None
}

/// The path from the root, so that another process finds it.
fn absolute(path: &Path) -> PathBuf {
    path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.into())
}

/// Holds directories by their advisory locks, always in the same order, so that no two processes wait for
/// each other. Where the file system has no locks, nothing is held.
fn hold(directories: &[PathBuf]) -> Vec<File> {
    let mut opened: Vec<File> = directories.iter().filter_map(|d| File::open(d).ok()).collect();
    opened.sort_by_key(identity);
    // One directory under two names would wait for itself.
    opened.dedup_by(|a, b| identity(a).is_some() && identity(a) == identity(b));
    opened.retain(|directory| directory.lock().is_ok());
    opened
}

/// Holds directories in which no journal of a process that is gone waits to be finished.
fn hold_without_journals(directories: &[PathBuf]) -> Vec<File> {
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

/// A process would have to end between its renames as often as this while another waits for its turn;
/// a journal that is still there cannot be removed, and what it names does not come back.
const MOST_ATTEMPTS_TO_FINISH: usize = 16;

/// Writes the journal into every directory in which something is to appear.
fn write_journals(staged: &[Staged], parents: &[PathBuf]) -> Result<Vec<PathBuf>, HandoffError> {
    let rename = |s: &Staged| Rename {
        from: absolute(&s.sibling),
        to: absolute(&parent_of(&s.place)).join(s.place.file_name().unwrap_or_default()),
        inode: inode(&s.sibling).unwrap_or(0),
    };
    let journal = Journal { renames: staged.iter().map(rename).collect() };
    let bytes = serde_json::to_vec(&journal).expect("a journal serialises");
    let write = |parent: &PathBuf| {
        let io = |e| HandoffError::io(parent, "write a journal there", &e);
        // Complete before it is called a journal.
        let (sibling, mut file) =
            create_sibling(parent, |path| File::create_new(path)).map_err(io)?;
        let name = sibling.with_extension(&JOURNAL[1..]);
        let written = file
            .write_all(&bytes)
            .and_then(|()| file.sync_all())
            .and_then(|()| fs::rename(&sibling, &name))
            .and_then(|()| sync_directory(parent));
        if written.is_err() {
            remove_sibling(&sibling);
        }
        lock(&SIBLINGS).retain(|known| *known != sibling);
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

// ---- one rename ----------------------------------------------------------------------------------

/// `from` becomes `to`; where `to` exists the two are exchanged, in one step. Whether they were.
#[cfg(target_os = "linux")]
fn put_in_place(from: &Path, to: &Path) -> io::Result<bool> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    let exchange = fs::symlink_metadata(to).is_ok();
    let flags = if exchange { RenameFlags::EXCHANGE } else { RenameFlags::NOREPLACE };
    renameat_with(CWD, from, CWD, to, flags)?;
    Ok(exchange)
}

#[cfg(not(target_os = "linux"))]
fn put_in_place(_: &Path, _: &Path) -> io::Result<bool> {
    Err(ErrorKind::Unsupported.into())
}

/// Whether the file system cannot exchange two names.
fn is_exchange_unknown(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported)
}

/// The same in three steps: between the first two the old one stands under a temporary name, and
/// nothing in its place.
fn put_in_place_by_plain_renames(from: &Path, to: &Path) -> io::Result<bool> {
    if fs::symlink_metadata(to).is_err() {
        return fs::rename(from, to).map(|()| false);
    }
    let old = from.with_extension("old.tmp");
    // Locked, so that no other run takes it for abandoned.
    let held = File::open(to)?;
    let _ = held.try_lock();
    fs::rename(to, &old)?;
    match fs::rename(from, to) {
        Ok(()) => fs::rename(&old, from).map(|()| true),
        Err(e) => fs::rename(&old, to).and(Err(e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(path: &Path) -> String {
        fs::read_to_string(path).unwrap_or_default()
    }

    /// Two files that replace old ones, staged; what a process that is gone leaves of them is what is
    /// there when `Staged` is forgotten and its lock is released.
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
            // A writer that has no journal of its own must not take the siblings away.
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

    /// Two runs renamed one artifact each before the other: the directory then held a mixture.
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

    /// Its journal, finished by a later reader, took the place of what the second run had shown.
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
        // Taken by somebody else after the run began.
        fs::write(dir.path().join("c"), "mine").unwrap();
        assert!(publish(run).unwrap_err().to_string().contains("c: exists"));
        let left = ["a", "b", "c"].map(|name| text(&dir.path().join(name)));
        assert_eq!(left, ["old", "old", "mine"]);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 3);
    }
}
