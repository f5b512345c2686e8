//! Helpers of the tests of a program: its inputs on disk, its run, its output.

use std::{
    fs,
    io::{Read, Seek},
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
    sync::OnceLock,
    thread::sleep,
    time::{Duration, Instant},
};

use ndarray::{Array, Dimension};
use planish_handoff::{Artifact, npy::ArrayData};

/// Returns the program `planish` of the profile of this test. Cargo builds it for the tests of `crates/planish`, which
/// are those that run programs.
pub fn planish() -> &'static Path {
    static PLANISH: OnceLock<PathBuf> = OnceLock::new();
    PLANISH.get_or_init(|| {
        // This test program is target/<profile>/deps/NAME-<hash>.
        let test = std::env::current_exe().unwrap();
        let profile = test.parent().and_then(Path::parent).unwrap();
        let planish = profile.join(format!("planish{}", std::env::consts::EXE_SUFFIX));
        assert!(planish.is_file(), "{} is not built", planish.display());
        planish
    })
}

/// Returns the command of a stage, such as `planish-dwell`.
pub fn stage(name: &str) -> Command {
    let mut command = Command::new(planish());
    command.arg(name);
    command
}

/// Writes the artifact `name` in `dir`, without a history.
pub fn write<T: Artifact>(dir: &Path, name: &str, value: &T) {
    planish_handoff::save(&dir.join(name), value).unwrap();
}

/// Writes the numbers `name` of a directory without a manifest.
pub fn save<D: Dimension>(dir: &Path, name: &str, array: Array<f64, D>) {
    save_array(dir, name, ArrayData::F64(array.into_dyn().into()));
}

/// Writes the array `name`, of any kind, of a directory without a manifest.
pub fn save_array(dir: &Path, name: &str, array: ArrayData) {
    fs::create_dir_all(dir).unwrap();
    fs::write(dir.join(format!("{name}.npy")), array.to_npy()).unwrap();
}

/// Text that a program printed.
pub fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("a program speaks UTF-8")
}

/// Runs a command to its end. If this takes longer than `limit`, ends the program and panics.
///
/// The output goes to files: a pipe that nobody reads stops the program when it is full.
pub fn run_within(command: &mut Command, limit: Duration) -> Output {
    let mut said = [tempfile::tempfile().unwrap(), tempfile::tempfile().unwrap()];
    let [stdout, stderr] = said.each_ref().map(|file| Stdio::from(file.try_clone().unwrap()));
    let mut child = command.stdin(Stdio::null()).stdout(stdout).stderr(stderr).spawn().unwrap();
    let begun = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if begun.elapsed() > limit {
            child.kill().unwrap();
            child.wait().unwrap();
            panic!("{command:?} takes more than {limit:?}");
        }
        sleep(Duration::from_millis(2));
    };
    let [stdout, stderr] = said.each_mut().map(|file| {
        let mut bytes = Vec::new();
        file.rewind().unwrap();
        file.read_to_end(&mut bytes).unwrap();
        bytes
    });
    Output { status, stdout, stderr }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_than_a_pipe_holds_is_read_to_the_end() {
        let mut long = Command::new("sh");
        long.args(["-c", "yes | head -c 1000000; echo oops >&2; exit 3"]);
        let ended = run_within(&mut long, Duration::from_secs(60));
        assert_eq!((ended.status.code(), ended.stdout.len()), (Some(3), 1_000_000));
        assert_eq!(text(&ended.stderr), "oops\n");
    }

    #[test]
    #[should_panic(expected = "takes more than 50ms")]
    fn what_does_not_end_is_ended() {
        run_within(Command::new("sleep").arg("60"), Duration::from_millis(50));
    }
}
