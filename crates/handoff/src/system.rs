//! Everything that depends on the operating system. No other module asks which system it runs on.
//!
//! The module `calls` below has three parts: `unix`, `other`, and what Linux alone knows. A port begins here, and
//! `docs/stability.md` says what each system lacks.

use std::{
    fs::{self, File},
    io,
    path::Path,
    process::{Command, Stdio},
};

pub(crate) use calls::{
    directory_stamp, fail_beyond_largest_file, file_identity, has_ended, is_at, on_end_signals,
    reap, send, wait_for_end,
};

/// Signals that end a process.
#[derive(Clone, Copy, Debug)]
pub(crate) enum EndSignal {
    Term,
    Kill,
}

/// Exchanges `from` and `to` in one step, or renames `from` to `to` where nothing is there. Returns true if they were
/// exchanged. The error is of the kind `Unsupported` or `InvalidInput` if the system or the file system cannot do it.
#[cfg(target_os = "linux")]
pub(crate) fn rename_or_exchange(from: &Path, to: &Path) -> io::Result<bool> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    let exchange = fs::symlink_metadata(to).is_ok();
    let flags = if exchange { RenameFlags::EXCHANGE } else { RenameFlags::NOREPLACE };
    renameat_with(CWD, from, CWD, to, flags)?;
    Ok(exchange)
}

/// Always fails as unsupported: only Linux can exchange two paths.
#[cfg(not(target_os = "linux"))]
pub(crate) fn rename_or_exchange(_: &Path, _: &Path) -> io::Result<bool> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Asks the system to end this process by SIGTERM when its parent ends. If the system is not Linux or refuses that, the
/// process goes on to its own end, which does no harm.
pub fn end_with_parent() {
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Signal, set_parent_process_death_signal};
        let _ = set_parent_process_death_signal(Some(Signal::TERM));
    }
}

/// Runs `command` in place of this process, so that signals reach it and its exit code is that of the run.
///
/// All processes that it starts inherit the open `lock`: it is free when the last of them has ended, and not before.
/// Elsewhere than on Unix this process waits with the lock, and ends with the exit code. Returns only if the command
/// cannot be run.
pub fn become_command(command: Command, lock: File) -> io::Error {
    calls::become_command(command, lock)
}

/// Passes the open `lock` on to every process that this one starts: it is free when the last of them has ended, and not
/// before, even if some are killed. Elsewhere than on Unix this process alone has it.
///
/// # Errors
/// Fails if the system refuses it.
pub fn let_inherit(lock: &File) -> io::Result<()> {
    calls::let_inherit(lock)
}

/// Asks the system to open `address` in the user's browser. Returns false if it has no program for that.
pub fn open_in_browser(address: &str) -> bool {
    let words: &[&str] = match std::env::consts::OS {
        "macos" => &["open"],
        "windows" => &["rundll32", "url.dll,FileProtocolHandler"],
        _ => &["xdg-open"],
    };
    let mut command = Command::new(words[0]);
    command.args(&words[1..]).arg(address);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().is_ok()
}

/// Makes a symbolic link at `link` to `target`. A system without them makes none, which is no error.
pub fn symbolic_link(target: &Path, link: &Path) -> io::Result<()> {
    calls::symbolic_link(target, link)
}

#[cfg(unix)]
mod calls {
    use super::*;
    use std::{
        os::unix::{
            fs::{MetadataExt, symlink},
            process::CommandExt,
        },
        thread,
    };

    use rustix::process::{Pid, WaitId, WaitIdOptions, waitid};

    /// Returns true if the open `file` is the one at `path`.
    pub(crate) fn is_at(file: &File, path: &Path) -> bool {
        let opened = file_identity(file);
        opened.is_some() && opened == fs::symlink_metadata(path).ok().map(|m| (m.dev(), m.ino()))
    }

    /// Returns the identity of an open file or directory: its device and inode; `None` if the system does not tell it.
    pub(crate) fn file_identity(file: &File) -> Option<(u64, u64)> {
        file.metadata().ok().map(|m| (m.dev(), m.ino()))
    }

    /// Returns a value that changes when another directory replaces `dir`: inode and time of change. `None` if it
    /// cannot be read.
    pub(crate) fn directory_stamp(dir: &Path) -> Option<impl PartialEq + use<>> {
        let metadata = fs::metadata(dir).ok()?;
        Some((metadata.ino(), metadata.ctime(), metadata.ctime_nsec()))
    }

    /// Runs `before_the_end` on SIGINT, SIGTERM and SIGHUP, and then ends the process as usual.
    pub(crate) fn on_end_signals<T>(before_the_end: impl Fn() -> T + Send + 'static) {
        use signal_hook::{consts::signal, iterator::Signals, low_level::emulate_default_handler};
        let Ok(mut signals) = Signals::new([signal::SIGINT, signal::SIGTERM, signal::SIGHUP])
        else {
            return;
        };
        thread::spawn(move || {
            for signal in &mut signals {
                let _held = before_the_end();
                let _ = emulate_default_handler(signal);
            }
        });
    }

    /// Lets a write beyond the largest file size (`ulimit -f`) fail with an error, which has a message, in place of
    /// SIGXFSZ, which ends the process without one. Programs that this one starts have the signal as it was.
    pub(crate) fn fail_beyond_largest_file() {
        use signal_hook::{consts::signal::SIGXFSZ, flag};
        let _ = flag::register(SIGXFSZ, std::sync::Arc::default());
    }

    /// Sends a signal to a child whose end nobody has waited for yet.
    pub(crate) fn send(child: u32, signal: EndSignal) {
        use rustix::process::{Signal, kill_process};
        let signal = match signal {
            EndSignal::Term => Signal::TERM,
            EndSignal::Kill => Signal::KILL,
        };
        if let Some(child) = process(child) {
            let _ = kill_process(child, signal);
        }
    }

    /// Waits until the child with this process id has ended. The system does not reuse the id before `reap`.
    pub(crate) fn wait_for_end(child: u32) {
        look_at(child, WaitIdOptions::NOWAIT);
    }

    /// Returns true if the child with this process id has ended. The system does not reuse the id before `reap`.
    pub(crate) fn has_ended(child: u32) -> bool {
        look_at(child, WaitIdOptions::NOWAIT | WaitIdOptions::NOHANG)
    }

    /// Releases the process id of a child that has ended, so that the system can use it again.
    pub(crate) fn reap(child: u32) {
        look_at(child, WaitIdOptions::NOHANG);
    }

    /// Returns true if the process has ended, or is not a child of this one. `how` says whether the call waits.
    fn look_at(child: u32, how: WaitIdOptions) -> bool {
        let Some(child) = process(child) else { return true };
        loop {
            match waitid(WaitId::Pid(child), WaitIdOptions::EXITED | how) {
                Ok(ended) => return ended.is_some(),
                Err(rustix::io::Errno::INTR) => {}
                Err(_) => return true,
            }
        }
    }

    fn process(number: u32) -> Option<Pid> {
        i32::try_from(number).ok().and_then(Pid::from_raw)
    }

    pub(super) fn become_command(mut command: Command, lock: File) -> io::Error {
        match let_inherit(&lock) {
            Ok(()) => command.exec(),
            Err(error) => error,
        }
    }

    pub(super) fn let_inherit(lock: &File) -> io::Result<()> {
        Ok(rustix::io::fcntl_setfd(lock, rustix::io::FdFlags::empty())?)
    }

    pub(super) fn symbolic_link(target: &Path, link: &Path) -> io::Result<()> {
        symlink(target, link)
    }
}

#[cfg(not(unix))]
mod calls {
    use super::*;

    /// Returns true if something is at `path`. This system does not tell whether it is the open `file`.
    pub(crate) fn is_at(_: &File, path: &Path) -> bool {
        path.exists()
    }

    /// Returns `None`: this system does not tell the identity of an open file.
    pub(crate) fn file_identity(_: &File) -> Option<(u64, u64)> {
        None
    }

    /// Returns the time at which a directory was made, which changes when another directory replaces it. `None` if
    /// the system does not tell it.
    pub(crate) fn directory_stamp(dir: &Path) -> Option<impl PartialEq + use<>> {
        fs::metadata(dir).ok()?.created().ok()
    }

    /// Does nothing on this system: unfinished files stay until the next run removes them.
    pub(crate) fn on_end_signals<T>(_: impl Fn() -> T + Send + 'static) {}

    /// Does nothing: no signal ends a process on this system.
    pub(crate) fn fail_beyond_largest_file() {}

    /// Does nothing: no signal ends a process on this system.
    pub(crate) fn send(_: u32, _: EndSignal) {}

    /// Does nothing: the standard library waits for the child afterwards.
    pub(crate) fn wait_for_end(_: u32) {}

    /// Does nothing: the standard library releases the process id.
    pub(crate) fn reap(_: u32) {}

    /// Returns true: on this system no process has to wait for its children.
    pub(crate) fn has_ended(_: u32) -> bool {
        true
    }

    pub(super) fn become_command(mut command: Command, lock: File) -> io::Error {
        match command.status() {
            Ok(status) => {
                drop(lock);
                std::process::exit(status.code().unwrap_or(2))
            }
            Err(error) => error,
        }
    }

    pub(super) fn let_inherit(_: &File) -> io::Result<()> {
        Ok(())
    }

    pub(super) fn symbolic_link(_: &Path, _: &Path) -> io::Result<()> {
        Ok(())
    }
}
