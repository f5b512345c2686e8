//! Environment variables by which `planish run` tells a program that it starts how the user sees its flags.
//!
//! [`SETTINGS_OF_FLAGS`] has a line for each flag: the flag, a tab, and the setting that a user gives in its place. A
//! line without a flag names the setting that takes all other flags of the program. Messages then name the settings.
//!
//! [`REHEARSAL`] makes the program end with exit code 0 at the point where it would begin its work, or where it needs
//! an input that has not been made. Until then it checks its flags and the inputs that exist. The value is a list of
//! paths as JSON: first the directory of the run, then the paths in it that are made already.

use std::{borrow::Cow, env, path::Path, process::exit};

use crate::place::is_within;

/// Name of the environment variable that lists, for each flag, the setting that a user gives in its place.
pub const SETTINGS_OF_FLAGS: &str = "PLANISH_SETTINGS_OF_FLAGS";

/// Name of the environment variable that makes the run of a program a rehearsal, which only checks flags and inputs.
pub const REHEARSAL: &str = "PLANISH_REHEARSAL";

/// Flags that every program has and that no setting stands for.
const OF_EVERY_PROGRAM: [&str; 2] = ["--help", "--version"];

/// Returns true if `planish run` started the program as a stage.
pub(crate) fn is_stage() -> bool {
    env::var_os(SETTINGS_OF_FLAGS).is_some()
}

/// Returns true if the program only checks its flags and the inputs that are there.
pub fn is_rehearsal() -> bool {
    env::var_os(REHEARSAL).is_some()
}

/// Ends a rehearsal with exit code 0 where the work of the program would begin.
pub(crate) fn before_the_work() {
    if is_rehearsal() {
        exit(0)
    }
}

/// Ends a rehearsal with exit code 0 if the input at `path` lies in the run and has not been made yet.
pub(crate) fn before_reading(path: &Path) {
    let Ok(text) = env::var(REHEARSAL) else { return };
    let paths: Vec<String> = serde_json::from_str(&text).unwrap_or_default();
    let Some((run, made)) = paths.split_first() else { return };
    if is_within(path, Path::new(run)) && !made.iter().any(|made| is_within(path, Path::new(made)))
    {
        exit(0)
    }
}

/// Returns the message with settings in place of the flags, as [`SETTINGS_OF_FLAGS`] states; unchanged if the
/// variable is absent.
pub(crate) fn in_settings(message: &str) -> Cow<'_, str> {
    match env::var(SETTINGS_OF_FLAGS) {
        Ok(settings) => Cow::Owned(with_settings(message, &settings)),
        Err(_) => Cow::Borrowed(message),
    }
}

fn with_settings(message: &str, settings: &str) -> String {
    let mut text = String::new();
    let mut rest = message;
    while let Some((before, after)) = rest.split_once("--") {
        text += before;
        let end = after.find(|c: char| !(c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-'));
        let end = end.unwrap_or(after.len());
        let flag = format!("--{}", &after[..end]);
        let begins =
            text.chars().next_back().is_none_or(|c| c.is_whitespace() || "'\"`(,".contains(c));
        let setting = if begins && end > 0 { setting_of(&flag, settings) } else { None };
        text += &setting.unwrap_or(flag);
        rest = &after[end..];
    }
    text + rest
}

/// Returns the setting that a user gives in place of `flag`; `None` if no setting stands for it. `settings` is the
/// text of [`SETTINGS_OF_FLAGS`].
fn setting_of(flag: &str, settings: &str) -> Option<String> {
    let mut lines = settings.lines().filter_map(|line| line.split_once('\t'));
    if let Some((_, setting)) = lines.clone().find(|(known, _)| *known == flag) {
        return Some(setting.to_string());
    }
    if OF_EVERY_PROGRAM.contains(&flag) {
        return None;
    }
    let (_, setting) = lines.find(|(known, _)| known.is_empty())?;
    Some(format!("{setting}={flag}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_names_the_settings_behind_its_flags() {
        let settings = "--always-on\texport_settings=--always-on\n--machine\tmachine\n--trajectory\t--trajectory\n\
                        \texport_settings";
        for (message, told) in [
            ("--always-on: no", "export_settings=--always-on: no"),
            ("give '--count-mm' (or --machine)", "give 'export_settings=--count-mm' (or machine)"),
            ("export_settings=--always-on -- and a--b", "export_settings=--always-on -- and a--b"),
            ("--trajectory, try --help", "--trajectory, try --help"),
            ("é --machine=x é", "é machine=x é"),
            ("", ""),
        ] {
            assert_eq!(with_settings(message, settings), told, "{message}");
        }
        assert_eq!(with_settings("--a and --b", "--a\ta"), "a and --b");
    }
}
