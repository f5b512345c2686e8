//! Three ways in which a program tells its result: as text, with `--quiet` only by warnings, verdicts and errors, and
//! with `--json` as one JSON object.
//!
//! ```json
//! { "exit_code": 1, "message": "verdict: ...", "outputs": [ { "path": "out/v", "kind": "verdict", "outcome": {} } ],
//!   "text": [ "..." ] }
//! ```
//!
//! `message` is the verdict or the error, and null if there is none. `outcome` is that of the manifest, and null for a
//! file. `text` has the lines that the program prints without the flag.

use std::{
    ffi::OsString,
    path::Path,
    sync::{Mutex, PoisonError},
};

use clap::{Arg, ArgAction, Command};
use serde_json::{Value, json};

/// Way of a program to tell its result.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Telling {
    Text,
    Quiet,
    Json,
}

/// State of the telling: its way, and the outputs and lines so far.
struct Told {
    telling: Telling,
    outputs: Vec<Value>,
    text: Vec<String>,
}

static TOLD: Mutex<Told> =
    Mutex::new(Told { telling: Telling::Text, outputs: Vec::new(), text: Vec::new() });

/// Names and descriptions of the two flags, which every program has.
const FLAGS: [(&str, Telling, &str); 2] = [
    ("quiet", Telling::Quiet, "Print only warnings, verdicts and errors"),
    (
        "json",
        Telling::Json,
        "Print the outcome as one JSON object, and nothing else on standard output",
    ),
];

/// Changes what is told, or reads it.
fn with_told<T>(work: impl FnOnce(&mut Told) -> T) -> T {
    work(&mut TOLD.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Returns the two flags for the help of a program. [`take_flags`] takes them from the command line.
pub(crate) fn flags() -> impl Iterator<Item = Arg> {
    FLAGS.into_iter().map(|(name, _, help)| {
        Arg::new(name).long(name).action(ArgAction::SetTrue).global(true).help(help)
    })
}

/// Returns true if `argument` is one of the flags that every program has, and not one of the command itself.
pub(crate) fn is_shared(argument: &Arg) -> bool {
    argument.is_global_set() && FLAGS.iter().any(|(name, ..)| argument.get_id() == *name)
}

/// Takes the two flags out of a command line, wherever they stand before a `--`, and obeys them. A command that
/// defines a flag of this name itself keeps it.
pub(crate) fn take_flags(command: &Command, arguments: &mut Vec<OsString>) {
    let mut leaf = command;
    for word in arguments.iter().skip(1) {
        leaf = word.to_str().and_then(|word| leaf.find_subcommand(word)).unwrap_or(leaf);
    }
    let end = arguments.iter().position(|word| word == "--").unwrap_or(arguments.len());
    let rest = arguments.split_off(end);
    for (name, telling, _) in FLAGS {
        let is_own = leaf.get_arguments().any(|a| a.get_id() == name && !a.is_global_set());
        let flag = format!("--{name}");
        if !is_own && arguments.iter().any(|word| *word == *flag) {
            arguments.retain(|word| *word != *flag);
            with_told(|told| told.telling = telling);
        }
    }
    arguments.extend(rest);
}

/// Moves the flags that stand before the first command to the end: `planish --json dwell ...` is `planish dwell ...
/// --json`.
pub(crate) fn move_flags_behind(words: &mut Vec<OsString>) {
    let is_flag = |word: &OsString| FLAGS.iter().any(|(name, ..)| *word == *format!("--{name}"));
    while words.len() > 2 && is_flag(&words[1]) {
        let flag = words.remove(1);
        words.push(flag);
    }
}

/// Returns true if the program prints its results as text: neither `--quiet` nor `--json` was given.
pub fn tells_text() -> bool {
    with_told(|told| told.telling == Telling::Text)
}

/// Keeps a text for the JSON object, if there is one.
pub(crate) fn keep_text(text: &str) {
    with_told(|told| {
        if told.telling == Telling::Json {
            told.text.push(text.into());
        }
    });
}

/// Keeps an output at `path` for the JSON object: its kind, and its outcome (null for a file).
pub fn keep_output(path: &Path, kind: &str, outcome: Value) {
    let path = path.display().to_string();
    with_told(|told| {
        told.outputs.push(json!({ "path": path, "kind": kind, "outcome": outcome }));
    });
}

/// Prints the JSON object if `--json` was given. Call it once, at the end of the program. `message` is the verdict or
/// the error, as it was printed.
pub(crate) fn tell_end(exit_code: u8, message: Option<&str>) {
    let object = with_told(|told| {
        let is_json = told.telling == Telling::Json;
        // What is said from now on is the object.
        told.telling = Telling::Text;
        is_json.then(|| {
            json!({ "exit_code": exit_code, "message": message, "outputs": told.outputs, "text": told.text })
        })
    });
    if let Some(object) = object {
        crate::say(format!("{object:#}"));
    }
}

/// Ends the program with this exit code; the reason was printed by the program that failed.
pub fn exit(code: u8) -> ! {
    tell_end(code, None);
    std::process::exit(code.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flags_stand_anywhere_but_for_a_command_with_its_own() {
        let own = Arg::new("json").long("json").action(ArgAction::SetTrue);
        let command = Command::new("a")
            .args(flags())
            .subcommand(Command::new("run"))
            .subcommand(Command::new("show").arg(own));
        let left = |words: &str| {
            let mut words: Vec<OsString> = words.split(' ').map(OsString::from).collect();
            take_flags(&command, &mut words);
            let told = with_told(|told| std::mem::replace(&mut told.telling, Telling::Text));
            (words.join(" ".as_ref()).into_string().unwrap(), told)
        };
        assert_eq!(left("a run x=1 --json"), ("a run x=1".into(), Telling::Json));
        assert_eq!(left("a --quiet run"), ("a run".into(), Telling::Quiet));
        assert_eq!(left("a show --json"), ("a show --json".into(), Telling::Text));
        assert_eq!(left("a run -- sh --quiet"), ("a run -- sh --quiet".into(), Telling::Text));
        assert_eq!(left("a run pitch=--json"), ("a run pitch=--json".into(), Telling::Text));
    }
}
