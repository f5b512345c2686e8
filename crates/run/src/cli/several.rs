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
    walk::Command,
};

use super::{
    execute::{Ended, Programs, Said, run},
    place::Place,
};

/// Words of a command line: settings, and words without a value.
pub struct Given {
    /// Settings that are for the pipelines, in their order.
    pub settings: Vec<String>,
    /// Words without a value.
    pub words: Vec<String>,
}

impl Given {
    /// The words of a command line. Refuses a setting that is given twice.
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
        let given = self.take("fixture");
        let named = given.iter().chain(&self.words).cloned().collect::<Vec<_>>();
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
    pub fn assumed_machine(&self, machine: &str) -> Result<Option<String>, Failure> {
        if self.get("machine").is_some() {
            return Ok(None);
        }
        Ok(Some(Inputs::new().read_machine(Path::new(machine))?.name().into()))
    }

    /// The value of a setting that is not for the pipelines, if it is given.
    pub fn take(&mut self, name: &str) -> Option<String> {
        let found = self.get(name);
        self.settings.retain(|word| word.split_once('=').is_none_or(|(key, _)| key != name));
        found
    }

    /// The value of a setting.
    pub fn get(&self, name: &str) -> Option<String> {
        let values = self.settings.iter().filter_map(|word| word.split_once('='));
        values.filter(|(key, _)| *key == name).map(|(_, value)| value.to_string()).next()
    }

    /// The path of a setting that is not for the pipelines, if it is given and not empty.
    pub fn take_path(&mut self, name: &str) -> Option<String> {
        self.take(name).filter(|path| !path.is_empty()).map(|path| no_flag(&path))
    }
}

/// A path that is no flag: one that begins with a hyphen gets its directory.
pub fn no_flag(path: &str) -> String {
    if path.starts_with('-') { format!("./{path}") } else { path.into() }
}

/// A command with arguments of which none is taken apart.
pub fn command<S: AsRef<str>>(program: &str, arguments: &[S]) -> Command {
    let arguments = arguments.iter().map(|word| word.as_ref().to_string()).collect();
    let origins = Origins::default();
    Command {
        program: program.into(),
        arguments,
        may_be_negative: true,
        refusal_dir: None,
        origins,
    }
}

/// Runs whose plans are made in silence: what they say is shown if one of them fails.
pub struct Silent<'a> {
    place: &'a Place,
    log: File,
}

impl<'a> Silent<'a> {
    /// Runs of this place.
    pub fn new(place: &'a Place) -> Result<Self, Failure> {
        Ok(Self { place, log: log()? })
    }

    /// Runs a command: exit code 0, or 1 for a negative verdict. With another one, what it said is the end of all.
    pub fn command(&mut self, command: &Command) -> Result<u8, Failure> {
        self.clear()?;
        let code = Programs::new(self.place, Said::Kept(self.log.try_clone()?))?.run(command)?;
        self.checked(code)
    }

    /// Runs a pipeline.
    pub fn pipeline<'b>(
        &mut self,
        definition: &'b Definition,
        settings: &[String],
    ) -> Result<Ended<'b>, Failure> {
        self.clear()?;
        let scope: Scope<'b> = self.place.scope(definition, settings)?;
        let ended = run(self.place, scope, "run", Said::Kept(self.log.try_clone()?))?;
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
        let mut said = Vec::new();
        self.log.rewind()?;
        self.log.read_to_end(&mut said)?;
        let _ = io::copy(&mut &said[..], &mut io::stderr());
        std::process::exit(2)
    }
}

/// Number of files that were made, so that each has its own name.
static COUNT: AtomicUsize = AtomicUsize::new(0);

/// A file without a name, which is gone when the program has ended.
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

/// Settings of a plan among several: without others by the user no pictures, and no plan whose times allow for no errors.
pub fn with_plain(definition: &Definition, given: &Given) -> Vec<String> {
    let known = |name: &str| definition.settings.iter().any(|setting| setting.name == name);
    let mut settings = given.settings.clone();
    for (name, value) in [("frames", "0"), ("plan_joint", "no")] {
        if known(name) && given.get(name).is_none() {
            settings.push(format!("{name}={value}"));
        }
    }
    settings
}

/// A whole number from 1 to `most`, without zeros or a sign before it.
pub fn count(name: &str, text: &str, most: u32) -> Result<u32, Failure> {
    let number = text.parse().ok().filter(|n| (1..=most).contains(n));
    let number = number.filter(|_| !text.starts_with(['0', '+']));
    number.ok_or_else(|| Failure::new(format!("{name} is '{text}'; give 1 to {most}")))
}

/// Refuses an input that is a file, or not there.
pub fn is_directory(name: &str, path: &str) -> Result<(), Failure> {
    match () {
        () if Path::new(path).is_file() => Err(Failure::new(format!(
            "{name} {path} is a file; read it with planish-import, and give the directory"
        ))),
        () if !Path::new(path).is_dir() => {
            Err(Failure::new(format!("{name} {path} is not there; give a directory")))
        }
        () => Ok(()),
    }
}
