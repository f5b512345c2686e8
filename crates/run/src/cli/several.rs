//! Parts that the commands for several runs share: settings of their own beside those of the pipelines, commands that are
//! no stages of a pipeline, and runs in silence.

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

/// Words of a command line: settings, and words without a value.
pub struct UserSettings {
    /// Settings that are for the pipelines, in their order.
    pub settings: Vec<String>,
    /// Words without a value.
    pub words: Vec<String>,
}

impl UserSettings {
    /// Parses the words of a command line. Refuses a setting that is given twice.
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

    /// Returns the fixture that is named by a word, or as `fixture=NAME`. Refuses two of them.
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

    /// Returns the name of the machine that is used for a part or a tool of the user; `None` if the user named the machine.
    ///
    /// # Errors
    /// Fails if the machine file cannot be read.
    pub fn assumed_machine(&self, machine: &str) -> Result<Option<String>, Failure> {
        if self.get("machine").is_some() {
            return Ok(None);
        }
        Ok(Some(Inputs::new().read_machine(Path::new(machine))?.name().into()))
    }

    /// Takes out the value of a setting that is not for the pipelines, if the user gave it.
    pub fn take(&mut self, name: &str) -> Option<String> {
        let value = self.get(name);
        self.settings.retain(|word| word.split_once('=').is_none_or(|(key, _)| key != name));
        value
    }

    /// Takes out the value of a setting that is not for the pipelines; `default` if the user gave none.
    pub fn take_or(&mut self, name: &str, default: &str) -> String {
        self.take(name).unwrap_or(default.into())
    }

    /// Returns the value of a setting.
    pub fn get(&self, name: &str) -> Option<String> {
        let values = self.settings.iter().filter_map(|word| word.split_once('='));
        values.filter(|(key, _)| *key == name).map(|(_, value)| value.to_string()).next()
    }

    /// Takes out the path of a setting that is not for the pipelines, if the user gave one that is not empty.
    pub fn take_path(&mut self, name: &str) -> Option<String> {
        self.take(name).filter(|path| !path.is_empty()).map(|path| no_flag(&path))
    }
}

/// Returns a path that is no flag: one that begins with a hyphen gets its directory.
pub fn no_flag(path: &str) -> String {
    if path.starts_with('-') { format!("./{path}") } else { path.into() }
}

/// Creates a command with arguments of which none is taken apart.
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

/// Runs whose plans are made in silence: what they say is shown if one of them fails.
pub struct Silent<'a> {
    place: &'a Installation,
    log: File,
}

impl<'a> Silent<'a> {
    /// Creates runs of this installation.
    ///
    /// # Errors
    /// Fails if the folder for temporary files does not take one.
    pub fn new(place: &'a Installation) -> Result<Self, Failure> {
        Ok(Self { place, log: log()? })
    }

    /// Runs a command. Returns its exit code, 0, or 1 for a negative verdict. With another one, prints what it said and ends
    /// this process.
    ///
    /// # Errors
    /// Fails if it cannot be run.
    pub fn command(&mut self, command: &StageCommand) -> Result<u8, Failure> {
        self.clear()?;
        let code =
            Programs::new(self.place, Messages::Kept(self.log.try_clone()?))?.run(command)?;
        self.checked(code)
    }

    /// Runs a pipeline. If it fails, prints what it said and ends this process.
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
        std::process::exit(2)
    }
}

/// Number of files that were made, so that each has its own name.
static COUNT: AtomicUsize = AtomicUsize::new(0);

/// Creates a file without a name, which is gone when the program has ended.
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

/// Returns the settings of a plan among several: without others by the user no pictures, and no plan whose times allow for
/// no errors.
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

/// Parses a whole number from 1 to `most`. Refuses zeros or a sign before it.
pub fn count(name: &str, text: &str, most: u32) -> Result<u32, Failure> {
    let number = text.parse().ok().filter(|n| (1..=most).contains(n));
    let number = number.filter(|_| !text.starts_with(['0', '+']));
    number.ok_or_else(|| Failure::new(format!("{name} is '{text}'; give 1 to {most}")))
}

/// Refuses an input that is a file, or not there.
pub fn is_directory(name: &str, path: &str) -> Result<(), Failure> {
    if Path::new(path).is_file() {
        return Err(Failure::new(format!(
            "{name} {path} is a file; read it with planish-import, and give the directory"
        )));
    }
    if !Path::new(path).is_dir() {
        return Err(Failure::new(format!("{name} {path} is not there; give a directory")));
    }
    Ok(())
}
