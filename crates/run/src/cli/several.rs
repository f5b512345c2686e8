//! Parts shared by the commands that make several runs: their own settings beside those of the pipelines, commands
//! outside a pipeline, and runs without printed messages.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, Read, Seek},
    path::Path,
    sync::atomic::{AtomicUsize, Ordering},
};

use planish_handoff::{Failure, Inputs};
use planish_pipeline::{
    definition::Definition,
    scope::{Origins, Scope, refuse_second},
    walk::StageCommand,
};

use super::{
    execute::{Ended, Messages, Programs, run},
    place::Installation,
};

/// Words of a command line, split into settings NAME=VALUE and single words.
pub struct UserSettings {
    /// Settings NAME=VALUE that are left for the pipelines, in the order given.
    pub settings: Vec<String>,
    /// Words without `=`, such as the name of a fixture.
    pub words: Vec<String>,
}

impl UserSettings {
    /// Splits the words of a command line into settings and single words. Refuses a setting that is given twice.
    pub fn new(words: &[String]) -> Result<Self, Failure> {
        let (settings, words): (Vec<String>, _) =
            words.iter().cloned().partition(|word: &String| word.contains('='));
        let mut seen = BTreeMap::new();
        for (name, value) in settings.iter().filter_map(|word| word.split_once('=')) {
            let first = seen.insert(name, value).map(String::from);
            refuse_second(first, name, value).map_err(Failure::new)?;
        }
        Ok(Self { settings, words })
    }

    /// Takes out the fixture that a single word or `fixture=NAME` names; `None` without either. Refuses two names.
    pub fn take_fixture(&mut self) -> Result<Option<String>, Failure> {
        let named: Vec<String> = self.take("fixture").iter().chain(&self.words).cloned().collect();
        self.words.clear();
        match &named[..] {
            [] => Ok(None),
            [one] => Ok(Some(one.clone())),
            [first, second, ..] => Err(Failure::new(format!(
                "'{second}' is one word too many beside '{first}'; give one fixture, and settings as NAME=VALUE"
            ))),
        }
    }

    /// Returns the name in the machine file `machine`, which is assumed if the user named none. Returns `None` if the
    /// user did.
    ///
    /// # Errors
    /// Fails if the machine file cannot be read.
    pub fn assumed_machine(&self, machine: &str) -> Result<Option<String>, Failure> {
        if self.get("machine").is_some() {
            return Ok(None);
        }
        Ok(Some(Inputs::new().read_machine(Path::new(machine))?.name().into()))
    }

    /// Removes a setting that is not for the pipelines, and returns its value; `None` if the user did not give it.
    pub fn take(&mut self, name: &str) -> Option<String> {
        let value = self.get(name);
        self.settings.retain(|word| word.split_once('=').is_none_or(|(key, _)| key != name));
        value
    }

    /// Removes a setting that is not for the pipelines, and returns its value, or `default` if the user did not give
    /// it.
    pub fn take_or(&mut self, name: &str, default: &str) -> String {
        self.take(name).unwrap_or(default.into())
    }

    /// Returns the value of a setting; `None` if the user did not give it.
    pub fn get(&self, name: &str) -> Option<String> {
        let values = self.settings.iter().filter_map(|word| word.split_once('='));
        values.filter(|(key, _)| *key == name).map(|(_, value)| value.to_string()).next()
    }

    /// Removes a setting that is not for the pipelines, and returns its path, with `./` before a hyphen. `None` if the
    /// user did not give it or left it empty.
    pub fn take_path(&mut self, name: &str) -> Option<String> {
        self.take(name).filter(|path| !path.is_empty()).map(|path| no_flag(&path))
    }
}

/// Returns a path that cannot be read as a flag: `./` is put before one that begins with a hyphen.
pub fn no_flag(path: &str) -> String {
    if path.starts_with('-') { format!("./{path}") } else { path.into() }
}

/// Creates a command from a program and its arguments, which are passed on unchanged. A negative verdict does not count
/// as a failure.
pub fn command<S: AsRef<str>>(program: &str, arguments: &[S]) -> StageCommand {
    let arguments = arguments.iter().map(|word| word.as_ref().to_string()).collect();
    let origins = Origins::default();
    StageCommand {
        program: program.into(),
        arguments,
        may_be_negative: true,
        refusal_dir: None,
        origins,
    }
}

/// Starter of commands and pipelines without printed messages; they are printed only if one fails.
pub struct Silent<'a> {
    place: &'a Installation,
    log: File,
}

impl<'a> Silent<'a> {
    /// Creates a starter for the programs of this installation, with a temporary log file.
    ///
    /// # Errors
    /// Fails if the folder for temporary files does not take one.
    pub fn new(place: &'a Installation) -> Result<Self, Failure> {
        Ok(Self { place, log: log()? })
    }

    /// Runs a command. Returns its exit code, 0, or 1 for a negative verdict. With any other code, prints its messages
    /// and ends this process.
    ///
    /// # Errors
    /// Fails if it cannot be run.
    pub fn command(&mut self, command: &StageCommand) -> Result<u8, Failure> {
        self.clear()?;
        let code =
            Programs::new(self.place, Messages::Kept(self.log.try_clone()?))?.run(command)?;
        self.checked(code)
    }

    /// Runs a pipeline with these settings. If it fails, prints its messages and ends this process.
    ///
    /// # Errors
    /// Fails if a setting, an input or the directory is refused, or if a command cannot be run.
    pub fn pipeline<'b>(
        &mut self,
        definition: &'b Definition,
        settings: &[String],
    ) -> Result<Ended<'b>, Failure> {
        self.clear()?;
        let scope: Scope<'b> = self.place.scope(definition, settings)?;
        let ended = run(self.place, scope, "run", Messages::Kept(self.log.try_clone()?))?;
        self.checked(ended.code)?;
        Ok(ended)
    }

    fn clear(&mut self) -> Result<(), Failure> {
        self.log.set_len(0)?;
        Ok(self.log.rewind()?)
    }

    fn checked(&mut self, code: u8) -> Result<u8, Failure> {
        if code <= 1 {
            return Ok(code);
        }
        let mut messages = Vec::new();
        self.log.rewind()?;
        self.log.read_to_end(&mut messages)?;
        let _ = io::copy(&mut &messages[..], &mut io::stderr());
        planish_handoff::exit(2)
    }
}

/// Number of log files that this process has created, so that each gets its own name.
static COUNT: AtomicUsize = AtomicUsize::new(0);

/// Creates a temporary file without a name; the system deletes it when the program ends.
///
/// # Errors
/// Fails if the folder for temporary files does not take it.
pub fn log() -> Result<File, Failure> {
    let path = std::env::temp_dir().join(format!(
        "planish-run-{}-{}",
        std::process::id(),
        COUNT.fetch_add(1, Ordering::Relaxed)
    ));
    let file = File::options().read(true).append(true).create_new(true).open(&path)?;
    std::fs::remove_file(&path)?;
    Ok(file)
}

/// Returns the settings of a plan that is one of several. Unless the user says otherwise, they ask for no frames (maps
/// of the removal over time) and no joint plan, if the pipeline `definition` has these settings.
pub fn with_plain(definition: &Definition, user: &UserSettings) -> Vec<String> {
    let mut settings = user.settings.clone();
    for (name, value) in [("frames", "0"), ("plan_joint", "no")] {
        let is_known = definition.settings.iter().any(|setting| setting.name == name);
        if is_known && user.get(name).is_none() {
            settings.push(format!("{name}={value}"));
        }
    }
    settings
}

/// Parses a whole number from 1 to `most`. Refuses leading zeros and signs. `name` is that of the setting.
pub fn count(name: &str, text: &str, most: u32) -> Result<u32, Failure> {
    let number = text.parse().ok().filter(|n| (1..=most).contains(n));
    let number = number.filter(|_| !text.starts_with(['0', '+']));
    number.ok_or_else(|| Failure::new(format!("{name} is '{text}'; give 1 to {most}")))
}

/// Refuses an input that is not an existing directory. `name` is that of the setting.
pub fn is_directory(name: &str, path: &str) -> Result<(), Failure> {
    if Path::new(path).is_file() {
        return Err(Failure::new(format!(
            "{name} {path} is a file; read it with planish import, and give the directory"
        )));
    }
    if !Path::new(path).is_dir() {
        return Err(Failure::new(format!("{name} {path} is not there; give a directory")));
    }
    Ok(())
}
