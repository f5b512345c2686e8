//! Claim on the directory of a run: it checks the inputs, locks the directory, and writes its owner.

use std::{
    fs::{self, File, OpenOptions, TryLockError},
    io::{ErrorKind, Read, Seek, Write},
    path::{Path, PathBuf},
    process, thread,
    time::Duration,
};

use planish_handoff::{Failure, Inputs, OutputFile, is_temporary, read_regular, system};
use planish_pipeline::{
    definition::Setting,
    kind::Kind,
    scope::{Scope, Words},
};
use planish_run::owner::{Mirror, Owner};
use planish_types::{DEFAULT_TIME_TO_FULL_ACCELERATION_S, MachineFile};

/// Flag that names an output, the file for the time of a stage. All other flags of a setting name inputs.
const WALL_TIME: &str = "--wall-time";
/// Name of the file that states the owner of the directory.
const OWNER: &str = "run.json";
/// Name of the directory in a run that holds its copy of the machine file, under the name of the original. If the file
/// states no jerk limit, the copy states an assumed one.
const MACHINE: &str = "machine";
/// Name of the file that a run locks while it uses the directory; it names the process. It stays after the run: to
/// remove it would let two runs lock two files of the same name.
const LOCK: &str = "run.lock";

/// Number of times that a run reads the name of the process that has locked the directory: with [`BETWEEN_READS`] a
/// second in all, for a slow disk. Larger: the message comes later. Smaller: it names no process if the disk is slow.
const READS_OF_HOLDER: usize = 20;
/// Time between two reads of that name. Larger: the message comes later. Smaller: more reads are needed for a slow
/// disk.
const BETWEEN_READS: Duration = Duration::from_millis(50);

/// Directory that a run wants to use alone, and the inputs of the run.
pub struct Claim {
    /// Output directory of the run, which the claim locks.
    pub out: PathBuf,
    /// Name of the pipeline, such as `raster`.
    pub pipeline: String,
    /// Path of the recipe of a simulated mirror; `None` if the mirror is measured.
    pub fixture: Option<PathBuf>,
    /// Path of the measured surface error map; `None` for a simulated mirror.
    pub surface: Option<PathBuf>,
    /// Path of the tool influence function of a measured mirror; `None` for a simulated one.
    pub tif: Option<PathBuf>,
    /// Path of the machine file.
    pub machine: PathBuf,
    /// Further words of settings that may name a file or a directory, each with the name of its setting.
    pub named: Vec<Named>,
}

/// Word in the value of a setting that may name a file or a directory.
pub struct Named {
    /// Name of the setting whose value contains the word.
    pub setting: String,
    /// Word, read as a path.
    pub path: PathBuf,
    /// True if the setting is a path, so that the word is a path even if nothing exists there.
    pub is_path: bool,
}

impl Claim {
    /// Checks the inputs, locks the directory and copies the machine file into it. The lock holds until the returned
    /// file is closed, here and in all processes that have inherited it. Other runs that want the directory are shown
    /// `command`. The text beside the lock is a warning that a jerk limit is assumed; `None` if the machine file states
    /// one.
    ///
    /// # Errors
    /// Fails if an input is missing or overlaps the directory, or if the directory belongs to another run or is in use.
    pub fn take(&self, command: &str) -> Result<(File, Option<String>), Failure> {
        let Self { out, machine, .. } = self;
        // The reader is that of the stages.
        Inputs::new().read_machine(machine)?;
        let copy = out.join(MACHINE).join(machine.file_name().unwrap_or_default());
        let (machine_text, assumed) = with_limit_on_jerk(machine, &copy)?;
        let owner = Owner { pipeline: self.pipeline.clone(), mirror: self.mirror()? };
        for (input, path) in [("surface", &self.surface), ("tif", &self.tif)] {
            path.as_ref().map_or(Ok(()), |path| refuse_overlap(out, input, path))?;
        }
        refuse_overlap(out, "machine", machine)?;
        self.named.iter().try_for_each(|named| named.refuse_inside(out))?;
        let lock = take(out, &owner, command)?;
        system::let_inherit(&lock)?;
        fs::create_dir_all(out.join(MACHINE))
            .map_err(|e| Failure::new(format!("{}: cannot write in it: {e}", out.display())))?;
        OutputFile::begin("out", &copy, true, &Inputs::new())?.write(&machine_text)?;
        Ok((lock, assumed))
    }

    /// Returns the mirror of the claim. Refuses a mirror that does not exist, or a map without its tool influence
    /// function.
    fn mirror(&self) -> Result<Mirror, Failure> {
        match (&self.fixture, &self.surface, &self.tif) {
            (Some(recipe), ..) => fixture(recipe).map(Mirror::Fixture),
            (None, Some(surface), Some(tif)) => Ok(Mirror::Measured {
                surface: existing("surface", surface)?,
                tif: existing("tif", tif)?,
            }),
            (None, Some(_), None) => Err(Failure::new("surface is given without tif; give both")),
            (None, None, Some(_)) => Err(Failure::new("tif is given without surface; give both")),
            (None, None, None) => {
                Err(Failure::new("no mirror; give surface and tif, or a fixture"))
            }
        }
    }
}

/// Returns the content of the machine file as the stages of the run get it, from `copy`. If an axis has no jerk limit
/// stated, it gets an assumed time to full acceleration, and a warning is returned; otherwise `None`. Refuses a file that
/// is no machine file.
pub fn with_limit_on_jerk(
    machine: &Path,
    copy: &Path,
) -> Result<(Vec<u8>, Option<String>), Failure> {
    let failed = |e: &dyn std::fmt::Display| {
        Failure::new(format!("{}: cannot be read: {e}", machine.display()))
    };
    let text = read_regular(machine).map_err(|e| failed(&e))?;
    let file: MachineFile = serde_json::from_slice(&text).map_err(|e| failed(&e))?;
    let silent = file.axes_without_word_on_jerk();
    if silent.is_empty() {
        return Ok((text, None));
    }
    let time_s = DEFAULT_TIME_TO_FULL_ACCELERATION_S;
    let warning = format!(
        "{} states no jerk limit of {}, so this run assumes {time_s} s from rest to full acceleration and plans for {}; \
         state \"time_to_full_acceleration_s\" in the machine file, where 0 means no jerk limit",
        machine.display(),
        silent.join(" and "),
        copy.display()
    );
    let file = MachineFile { time_to_full_acceleration_s: Some(time_s), ..file };
    let text = format!("{}\n", serde_json::to_string_pretty(&file)?);
    Ok((text.into_bytes(), Some(warning)))
}

/// Returns the name of the recipe without its ending. Refuses a recipe that does not exist.
fn fixture(recipe: &Path) -> Result<String, Failure> {
    let name = recipe.file_stem().map(|name| name.to_string_lossy().into_owned());
    if let Some(name) = name.clone().filter(|_| recipe.is_file()) {
        return Ok(name);
    }
    let siblings = recipe.parent().and_then(|dir| fs::read_dir(dir).ok()).into_iter().flatten();
    let siblings = siblings.filter_map(|entry| Some(entry.ok()?.path()));
    let mut names: Vec<String> = siblings
        .filter(|path| path.extension().is_some_and(|e| e == "json"))
        .filter_map(|path| Some(path.file_stem()?.to_string_lossy().into_owned()))
        .collect();
    names.sort();
    let mut there = String::from("there are none beside it");
    if !names.is_empty() {
        there = format!("there are: {}", names.join(", "));
    }
    let name = name.unwrap_or_default();
    Err(Failure::new(format!("no fixture '{name}' ({}); {there}", recipe.display())))
}

/// Returns the absolute path of an existing input, with links resolved. `role` names the input in the message.
fn existing(role: &str, path: &Path) -> Result<String, Failure> {
    let here = path.canonicalize().map_err(|e| {
        Failure::new(format!(
            "{role} {}: cannot read: {e}; give a directory or a file",
            path.display()
        ))
    })?;
    here.into_os_string().into_string().map_err(|path| {
        Failure::new(format!("{role} {}: is not UTF-8; give another name", path.display()))
    })
}

impl Named {
    /// Returns the words of the settings of a pipeline that may name an input: settings of the kind path, and the words
    /// of those of the kind flags.
    ///
    /// # Errors
    /// Fails if a setting cannot be split into words.
    pub fn all(scope: &Scope) -> Result<Vec<Self>, Failure> {
        let mut named = Vec::new();
        for Setting { name, kind, .. } in &scope.definition.settings {
            let is_path = *kind == Kind::Path;
            if name == "out" || !(is_path || *kind == Kind::Flags) {
                continue;
            }
            let words = scope.words(name, &Words::new()).map_err(Failure::new)?;
            named.extend(Self::words(name, &words, is_path));
        }
        Ok(named)
    }

    /// Returns the words of one setting that may name an input. Of `--flag=path` only the path counts. The file after
    /// `--wall-time` is an output and is left out.
    pub fn words(setting: &str, words: &[String], is_path: bool) -> Vec<Self> {
        let mut named = Vec::new();
        let mut is_output = false;
        for word in words {
            let value = match word.split_once('=').filter(|_| !is_path) {
                Some((flag, value)) if flag.starts_with('-') => {
                    is_output = flag == WALL_TIME;
                    value
                }
                _ => word.as_str(),
            };
            if !is_output && !value.is_empty() {
                named.push(Self { setting: setting.into(), path: value.into(), is_path });
            }
            is_output = word == WALL_TIME;
        }
        named
    }

    /// Refuses a path inside the output directory, where a stage may replace it, and a link there, even if it leads
    /// elsewhere. For a setting of the kind path it also refuses the output directory itself and a directory that
    /// contains it. A word of flags counts only if something exists at its path.
    fn refuse_inside(&self, out: &Path) -> Result<(), Failure> {
        let Self { setting, path, is_path } = self;
        if *is_path {
            refuse_overlap(out, setting, path)?;
        }
        let out_resolved = resolved(out);
        let is_there = fs::symlink_metadata(path).is_ok();
        let mut places = [resolved(path), place_of(path)].into_iter();
        let is_inside =
            places.any(|place| place != out_resolved && place.starts_with(&out_resolved));
        if (is_there || *is_path) && is_inside {
            return Err(Failure::new(format!(
                "{setting} names {}, which lies in out {}, where the run writes; copy it to another place, or give \
                 another out",
                path.display(),
                out.display()
            )));
        }
        Ok(())
    }
}

/// Returns the absolute path of a file or link. Links in the folders above it are resolved, but the last name is not.
fn place_of(path: &Path) -> PathBuf {
    match (path.parent(), path.file_name()) {
        (Some(parent), Some(name)) => resolved(parent).join(name),
        _ => resolved(path),
    }
}

/// Refuses an output directory that is, contains or lies inside the input `role`.
fn refuse_overlap(out: &Path, role: &str, input: &Path) -> Result<(), Failure> {
    let [o, i] = [out, input].map(resolved);
    let how = if o == i {
        "is"
    } else if i.starts_with(&o) {
        "contains"
    } else if o.starts_with(&i) {
        "lies inside"
    } else {
        return Ok(());
    };
    Err(Failure::new(format!(
        "out {} {how} the {role} {}; give another out, a new directory",
        out.display(),
        input.display()
    )))
}

/// Returns the absolute path, with links resolved in the part that exists.
fn resolved(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.into());
    for there in path.ancestors() {
        if let (Ok(real), Ok(rest)) = (there.canonicalize(), path.strip_prefix(there)) {
            return if rest.as_os_str().is_empty() { real } else { real.join(rest) };
        }
    }
    path
}

/// Locks the directory and returns the lock file. A directory without an owner gets `owner`. Refuses that of another
/// owner, one with other content, and one in use. `command` describes this process to other runs.
fn take(out: &Path, owner: &Owner, command: &str) -> Result<File, Failure> {
    let failed = |doing: &str, e: std::io::Error| {
        Failure::new(format!("{}: cannot {doing}: {e}; give another out", out.display()))
    };
    let path = out.join(LOCK);
    // Nothing is written into a directory of another owner. If there is a lock file, even a new one,
    // another run may be about to write the owner: that is checked below, under the lock.
    if !path.exists()
        && let Err(refusal) = owned(out, owner)
        && !path.exists()
    {
        return Err(refusal);
    }
    fs::create_dir_all(out).map_err(|e| failed("create", e))?;
    refuse_special(&path)?;
    let options =
        OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
    let mut lock = options.map_err(|e| failed("write in it", e))?;
    match lock.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let holder = holder(&mut lock);
            return Err(Failure::new(format!(
                "{} is in use by {holder}; wait until it has ended, or give another out",
                out.display()
            )));
        }
        Err(TryLockError::Error(e)) => return Err(failed("lock it", e)),
    }
    if !owned(out, owner)? {
        write_owner(out, owner)?;
    }
    // A command may take over this process, with its number.
    let holder = format!("process {} ({command})\n", process::id());
    lock.set_len(0)
        .and_then(|()| lock.write_all(holder.as_bytes()))
        .map_err(|e| failed("write in it", e))?;
    Ok(lock)
}

/// Refuses a link, a pipe or a device at a path where a run writes a file.
pub fn refuse_special(path: &Path) -> Result<(), Failure> {
    match fs::symlink_metadata(path) {
        Ok(metadata) if !metadata.is_file() => Err(Failure::new(format!(
            "{} is not a regular file, and the run writes one there; remove it, or give another out",
            path.display()
        ))),
        _ => Ok(()),
    }
}

/// Returns the description of the process that holds a lock. That process writes it a moment after it has taken the
/// lock, when `run.json` is on the disk.
fn holder(lock: &mut File) -> String {
    for _ in 0..READS_OF_HOLDER {
        let mut holder = String::new();
        if lock.rewind().and_then(|()| lock.read_to_string(&mut holder)).is_ok()
            && !holder.is_empty()
        {
            return holder.trim().into();
        }
        thread::sleep(BETWEEN_READS);
    }
    "another run".into()
}

/// Returns true if the directory belongs to `owner`, and false if it has no owner yet. Refuses the directory of another
/// owner, and one with other content.
fn owned(out: &Path, owner: &Owner) -> Result<bool, Failure> {
    let refused = |problem: String| Err(Failure::new(format!("{} {problem}", out.display())));
    let text = match read_regular(&out.join(OWNER)) {
        Ok(text) => text,
        Err(e) if e.kind() == ErrorKind::NotFound => {
            return match foreign(out) {
                Ok(None) => Ok(false),
                Ok(Some(name)) => refused(format!(
                    "holds {name} and no {OWNER}: it is not the directory of a run; give another out, a \
                     new directory"
                )),
                Err(e) => refused(format!("cannot be read ({e}); give another out")),
            };
        }
        Err(e) => return refused(format!("cannot be read ({e}); give another out")),
    };
    match serde_json::from_slice::<Owner>(&text) {
        Ok(other) if other == *owner => Ok(true),
        Ok(other) => refused(format!(
            "belongs to another run ({}; this is {}); give another out, or remove it",
            other.describe(),
            owner.describe()
        )),
        Err(e) => {
            refused(format!("holds a {OWNER} that no run has written ({e}); give another out"))
        }
    }
}

/// Returns the first file of the directory, by name, that is neither the lock nor a temporary file. Returns `None`
/// without such a file, or without the directory.
fn foreign(out: &Path) -> std::io::Result<Option<String>> {
    let entries = match fs::read_dir(out) {
        Ok(entries) => entries,
        // A link may lead nowhere. Whatever else is there by now, another run has just created.
        Err(e) if e.kind() == ErrorKind::NotFound && !out.is_symlink() => return Ok(None),
        Err(e) => return Err(e),
    };
    let names = entries.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()));
    let mut names = names.collect::<std::io::Result<Vec<_>>>()?;
    names.retain(|name| name != LOCK && !is_temporary(name));
    Ok(names.into_iter().min())
}

/// Writes the owner to `run.json`. The lock is held, so no other run writes it.
fn write_owner(out: &Path, owner: &Owner) -> Result<(), Failure> {
    let text = format!("{}\n", serde_json::to_string_pretty(owner)?);
    let file = OutputFile::begin("out", &out.join(OWNER), false, &Inputs::new())?;
    Ok(file.write(text.as_bytes())?)
}
