//! The directory of a session. Every read and write of the server goes through here.

use std::{
    fs::{self, File, TryLockError},
    io::{self, Read},
    path::{Path, PathBuf},
};

use planish_app::{
    guard::Role,
    refusal::Refusal,
    session::{Session, StepName},
};
use planish_handoff::{Failure, Inputs, OutputFile, read_regular, words};

/// File with the state of the session.
const SESSION: &str = "session.json";
/// The session as a script.
const SCRIPT: &str = "session.sh";
/// File that the server locks while it uses the directory.
const LOCK: &str = "app.lock";
/// Largest file that is sent whole, bytes: a report or a program. Larger: more memory. Smaller: reports of large mirrors
/// are refused.
const MOST_SENT_BYTES: u64 = 512 << 20;
/// Part of the messages of a step that the page shows, bytes, from the end.
const SHOWN_BYTES: usize = 24 << 10;

/// The directory of a session, which this process has alone.
pub struct Files {
    /// Absolute path, without links.
    pub dir: PathBuf,
    /// Holds the lock until the process ends.
    _lock: File,
}

impl Files {
    /// Makes the directory if there is none, and locks it.
    ///
    /// # Errors
    /// Fails if the directory cannot be written, or if another server uses it.
    pub fn open(dir: &Path) -> Result<Self, Failure> {
        let failed = |e: &dyn std::fmt::Display| {
            Failure::new(format!("{}: cannot be the directory of a session: {e}", dir.display()))
        };
        fs::create_dir_all(dir).map_err(|e| failed(&e))?;
        let dir = dir.canonicalize().map_err(|e| failed(&e))?;
        let lock = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .open(dir.join(LOCK))
            .map_err(|e| failed(&e))?;
        match lock.try_lock() {
            Ok(()) => Ok(Self { dir, _lock: lock }),
            Err(TryLockError::WouldBlock) => {
                Err(failed(&"another planish app uses it; end that one, or give another directory"))
            }
            Err(TryLockError::Error(e)) => Err(failed(&e)),
        }
    }

    /// Reads the state of the session; an empty one if there is none.
    ///
    /// # Errors
    /// Fails if the file cannot be read or is no session.
    pub fn session(&self) -> Result<Session, Failure> {
        let path = self.dir.join(SESSION);
        match read_regular(&path) {
            Ok(text) => serde_json::from_slice(&text).map_err(|e| {
                Failure::new(format!(
                    "{}: is no session of this version: {e}; move the file away to begin anew",
                    path.display()
                ))
            }),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(Session::default()),
            Err(e) => Err(Failure::new(format!("{}: cannot be read: {e}", path.display()))),
        }
    }

    /// Writes the state of the session and its script, each whole or not at all.
    ///
    /// # Errors
    /// Fails if the disk refuses it.
    pub fn save_session(&self, session: &Session) -> Result<(), Refusal> {
        let text = serde_json::to_string_pretty(session).map_err(|e| on_disk(&e))?;
        self.write(SESSION, text.as_bytes())?;
        self.write(SCRIPT, script(session).as_bytes())
    }

    /// Writes a file of the session, whole or not at all.
    ///
    /// # Errors
    /// Fails if the disk refuses it.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), Refusal> {
        let file = OutputFile::begin("DIR", &self.dir.join(name), true, &Inputs::new());
        file.and_then(|file| file.write(bytes)).map_err(|e| on_disk(&e))
    }

    /// Writes an uploaded file of `length` bytes, whole or not at all.
    ///
    /// # Errors
    /// Fails if the upload ends early, if the folder leads elsewhere, or if the disk refuses it.
    pub fn receive(
        &self,
        role: Role,
        name: &str,
        length: u64,
        body: &mut dyn Read,
    ) -> Result<(), Refusal> {
        let folder = self.dir.join("files").join(role.folder());
        fs::create_dir_all(&folder).map_err(|e| on_disk(&e))?;
        let folder = self.inside(&format!("files/{}", role.folder()))?;
        let file = OutputFile::begin("DIR", &folder.join(name), true, &Inputs::new());
        let written = file.map_err(|e| on_disk(&e))?.write_by(|file| {
            let copied = io::copy(&mut body.take(length), file)?;
            if copied == length {
                Ok(())
            } else {
                Err(Failure::new(format!("the upload ended after {copied} of {length} bytes")))
            }
        });
        written.map_err(|e| on_disk(&e))
    }

    /// Copies the files `names` of the folder `from` into a new directory, which replaces `to` as a whole if `check`
    /// accepts it.
    ///
    /// # Errors
    /// Fails if a file is not there, if `check` refuses the copies, if a folder leads elsewhere, or if the disk refuses
    /// it.
    pub fn replace_by_copies(
        &self,
        [from, to]: [&str; 2],
        names: &[String],
        check: impl FnOnce(&Path) -> Result<(), Refusal>,
    ) -> Result<(), Refusal> {
        let place = self.dir.join(to);
        let [copies, before] = ["new", "old"].map(|end| place.with_extension(end));
        fs::create_dir_all(&copies).map_err(|e| on_disk(&e))?;
        self.inside(&format!("{to}.new"))?;
        // Those of a choice that was refused go away.
        remove_directory(&copies)?;
        fs::create_dir(&copies).map_err(|e| on_disk(&e))?;
        for name in names {
            let file = self.inside(&format!("{from}/{name}"))?;
            fs::copy(file, copies.join(name)).map_err(|e| on_disk(&e))?;
        }
        check(&copies)?;
        remove_directory(&before)?;
        if place.exists() {
            fs::rename(&place, &before).map_err(|e| on_disk(&e))?;
        }
        fs::rename(&copies, &place).map_err(|e| on_disk(&e))?;
        // If it stays, the next replacement removes it.
        let _ = remove_directory(&before);
        Ok(())
    }

    /// Returns the absolute path of something that exists in the directory of the session.
    ///
    /// # Errors
    /// Refuses what is not there, and a link that leads out of the directory.
    pub fn inside(&self, path: &str) -> Result<PathBuf, Refusal> {
        let whole = self.dir.join(path).canonicalize();
        let whole = whole.map_err(|_| Refusal::new(404, format!("there is no {path} yet")))?;
        if whole.starts_with(&self.dir) {
            Ok(whole)
        } else {
            Err(Refusal::new(403, format!("{path} leads out of the directory of the session")))
        }
    }

    /// Reads a whole file in the directory of the session, or of the fixtures.
    ///
    /// # Errors
    /// Refuses what is no regular file, and one that is too large.
    pub fn read(&self, path: &Path) -> Result<Vec<u8>, Refusal> {
        let length = fs::metadata(path).map_err(|e| on_disk(&e))?.len();
        if length > MOST_SENT_BYTES {
            return Err(Refusal::new(413, format!("{} is too large for the page", path.display())));
        }
        read_regular(path).map_err(|e| on_disk(&e))
    }

    /// Returns the script of the session.
    ///
    /// # Errors
    /// Fails before the first step.
    pub fn script(&self) -> Result<Vec<u8>, Refusal> {
        self.read(&self.inside(SCRIPT)?)
    }

    /// Opens the file for the messages of a step, empty.
    ///
    /// # Errors
    /// Fails if the disk refuses it.
    pub fn begin_log(&self, step: StepName) -> io::Result<File> {
        File::create(self.dir.join(step.log()))
    }

    /// Returns the end of a file of messages; empty if it is not there.
    pub fn text_end(&self, name: &str) -> String {
        let bytes = read_regular(&self.dir.join(name)).unwrap_or_default();
        String::from_utf8_lossy(&bytes[bytes.len().saturating_sub(SHOWN_BYTES)..]).into_owned()
    }
}

/// Returns the session as a script for a shell.
fn script(session: &Session) -> String {
    let mut text = String::from(
        "#!/bin/sh\n# What planish app did in this directory. In place of `planish run`, `just run` takes the same settings.\n\
         set -e\ncd \"$(dirname \"$0\")\"\n",
    );
    for command in session.commands() {
        text.push_str(&words::join(command));
        text.push('\n');
    }
    text
}

/// Removes a directory with its files; does nothing if there is none.
///
/// # Errors
/// Fails if the disk refuses it.
fn remove_directory(dir: &Path) -> Result<(), Refusal> {
    match fs::remove_dir_all(dir) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => Err(on_disk(&e)),
        _ => Ok(()),
    }
}

/// Returns the refusal for a failure of the disk.
fn on_disk(problem: &dyn std::fmt::Display) -> Refusal {
    Refusal::new(500, problem.to_string())
}

#[cfg(test)]
mod tests {
    use planish_handoff::system::symbolic_link;

    use super::*;

    #[test]
    fn a_directory_has_one_server_and_nothing_leaves_it() {
        let temporary = tempfile::tempdir().unwrap();
        let files = Files::open(&temporary.path().join("session")).unwrap();
        assert!(Files::open(&temporary.path().join("session")).is_err());
        fs::write(temporary.path().join("secret"), "secret").unwrap();
        for path in ["../secret", "/etc/hostname", "absent"] {
            assert!(files.inside(path).is_err(), "{path}");
        }
        let body = &mut &b"abc"[..];
        files.receive(Role::Part, "map.xyz", 3, body).unwrap();
        assert_eq!(fs::read(files.inside("files/part/map.xyz").unwrap()).unwrap(), b"abc");
        // An upload that ends early leaves the file before it.
        assert!(files.receive(Role::Part, "map.xyz", 9, &mut &b"no"[..]).is_err());
        assert_eq!(fs::read(files.inside("files/part/map.xyz").unwrap()).unwrap(), b"abc");
    }

    #[test]
    fn copies_replace_a_directory_as_a_whole_or_not_at_all() {
        let temporary = tempfile::tempdir().unwrap();
        let files = Files::open(&temporary.path().join("session")).unwrap();
        let upload = |name: &str, bytes: &[u8]| {
            files.receive(Role::Varying, name, bytes.len() as u64, &mut &bytes[..]).unwrap();
        };
        let copied = |name: &str| fs::read(files.dir.join("tool/varying").join(name)).ok();
        let places = ["files/varying", "tool/varying"];
        let replace = |name: &str, check: fn(&Path) -> Result<(), Refusal>| {
            files.replace_by_copies(places, &[name.to_string()], check)
        };
        upload("a", b"1");
        replace("a", |_| Ok(())).unwrap();
        upload("a", b"2");
        upload("b", b"3");
        assert_eq!(copied("a").unwrap(), b"1");
        assert!(replace("b", |_| Err(Refusal::of_value("no tool"))).is_err());
        assert!(replace("absent", |_| Ok(())).is_err());
        assert_eq!([copied("a"), copied("b")], [Some(b"1".to_vec()), None]);
        replace("b", |_| Ok(())).unwrap();
        assert_eq!([copied("a"), copied("b")], [None, Some(b"3".to_vec())]);
        assert_eq!(fs::read_dir(files.dir.join("tool")).unwrap().count(), 1);
    }

    #[test]
    fn a_link_out_of_the_session_is_refused() {
        let temporary = tempfile::tempdir().unwrap();
        let files = Files::open(&temporary.path().join("session")).unwrap();
        let outside = temporary.path().join("outside");
        fs::create_dir(&outside).unwrap();
        fs::write(outside.join("secret"), "secret").unwrap();
        fs::create_dir(files.dir.join("files")).unwrap();
        symbolic_link(&outside, &files.dir.join("files/part")).unwrap();
        symbolic_link(&outside.join("secret"), &files.dir.join("link")).unwrap();
        if fs::symlink_metadata(files.dir.join("link")).is_ok() {
            assert_eq!(files.inside("link").unwrap_err().status, 403);
            assert!(files.receive(Role::Part, "new", 1, &mut &b"x"[..]).is_err());
            assert!(!outside.join("new").exists());
        }
    }
}
