//! Command line of every program: its flags, completions, manual page and description.
//!
//! `PROGRAM --completions SHELL` prints a completion script, `PROGRAM --man` a manual page in roff,
//! and `--describe` the flags as JSON. All are made from the same definition as `--help`, so they
//! cannot differ from it. Every program also has `--memory-gib`, the memory that it may take
//! ([`planish_types::budget`]).

use std::{borrow::Cow, ffi::OsString, io::Write, process::exit};

use clap::{
    Arg, CommandFactory, Parser, ValueEnum,
    builder::{PossibleValue, PossibleValuesParser, TypedValueParser},
    error::ErrorKind,
    value_parser,
};
use clap_complete::Shell;
use planish_types::{ControllerKind, budget};

use crate::{
    arguments::{arguments, as_command},
    describe, from_run,
    message::{complain, shortened},
    telling, words,
};

/// Name of the flag for the memory budget, which every program has.
const MEMORY: &str = "memory-gib";

/// Last paragraph of every help page.
pub(crate) const ALSO: &str = "Also: --completions bash|zsh|fish|elvish|powershell prints a completion script, \
                    --man a manual page, --describe the flags as JSON.";

/// Parses the command line. For `--completions`, `--man`, `--describe`, `--help` and wrong usage,
/// it prints a text and ends the program.
pub(crate) fn parse<C: Parser>() -> C {
    let mut arguments = arguments();
    telling::take_flags(&command::<C>(), &mut arguments);
    if let Some(text) = generated(command::<C>, &arguments[1..]) {
        match text {
            Ok(bytes) => {
                // A closed pipe is not an error.
                let _ = std::io::stdout().write_all(&bytes);
                exit(0)
            }
            Err(message) => {
                complain(&format!("error: {message}"));
                exit(2)
            }
        }
    }
    let matches = command::<C>().try_get_matches_from(arguments).unwrap_or_else(|e| end(&e));
    let gib = matches.get_one::<f64>(MEMORY).copied().unwrap_or(budget::DEFAULT_MEMORY_GIB);
    if let Err(invalid) = budget::set_memory_gib(gib) {
        let message = format!("--{MEMORY} {}; {}", invalid.problem, invalid.remedy);
        end(&command::<C>().error(ErrorKind::ValueValidation, message))
    }
    C::from_arg_matches(&matches).unwrap_or_else(|e| end(&e.format(&mut command::<C>())))
}

/// Ends the program with the requested help, or with a message about wrong usage. The message may
/// contain a damaged value of any length.
pub(crate) fn end(error: &clap::Error) -> ! {
    let mut text = error.render().to_string();
    if from_run::is_stage() {
        // The usage is that of flags which the user of a pipeline does not see.
        text.truncate(text.find("\n\nUsage:").unwrap_or(text.len()));
        text += &format!("\n{} --help lists its flags", arguments()[0].display());
    }
    let is_changed = matches!(shortened(&text), Cow::Owned(_)) || from_run::is_stage();
    if error.use_stderr() && is_changed {
        complain(text.trim_end());
        exit(error.exit_code())
    }
    error.exit()
}

/// Returns the definition of the program's command line, with the flags that every program has.
fn command<C: CommandFactory>() -> clap::Command {
    let memory = Arg::new(MEMORY)
        .long(MEMORY)
        .value_name("GIB")
        .value_parser(value_parser!(f64))
        .allow_negative_numbers(true)
        .global(true)
        .help(format!(
            "Memory that the program may take, GiB: it refuses what needs more [default: {}]",
            budget::DEFAULT_MEMORY_GIB
        ));
    C::command().arg(memory).args(telling::flags()).after_help(after_help::<C>())
}

/// Returns the command line of the stage program `tool` with the arguments of this process, quoted for a shell.
pub(crate) fn as_typed(tool: &str) -> String {
    let arguments = arguments();
    let arguments = arguments.iter().skip(1).map(|a| a.to_string_lossy().into_owned());
    format!("{} {}", as_command(tool), words::join(arguments))
}

/// Parses the value of a flag for x and y: a number for both, or two numbers as `X,Y`.
///
/// # Errors
/// Refuses what is neither one number nor two.
pub fn pair(text: &str) -> Result<[f64; 2], String> {
    let numbers = text.split(',').map(|n| n.trim().parse::<f64>());
    match numbers.collect::<Result<Vec<_>, _>>().as_deref() {
        Ok([both]) => Ok([*both; 2]),
        Ok([x, y]) => Ok([*x, *y]),
        _ => Err("give a number, or two as X,Y".into()),
    }
}

/// Returns the parser of a flag whose value is the name of a motion controller, such as `galil`.
pub fn controller() -> impl TypedValueParser<Value = ControllerKind> {
    let names = ControllerKind::ALL.map(|kind| PossibleValue::new(kind.name()).help(kind.about()));
    PossibleValuesParser::new(names)
        .try_map(|name| ControllerKind::named(&name).ok_or("is no controller"))
}

/// Returns the message of a library in terms of the command line. A setting in backquotes, such as `pitch_mm`,
/// becomes the flag of the same name, --pitch-mm.
pub fn with_flags(message: &str) -> String {
    let mut text = String::new();
    let mut rest = message;
    while let Some((before, after)) = rest.split_once('`') {
        text += before;
        rest = match after.split_once('`') {
            Some((name, after)) if is_name(name) => {
                text += &format!("--{}", name.replace('_', "-"));
                after
            }
            _ => {
                text.push('`');
                after
            }
        };
    }
    text + rest
}

/// Returns true if a word is the name of a setting, such as `pitch_mm`.
fn is_name(word: &str) -> bool {
    word.starts_with(|c: char| c.is_ascii_lowercase())
        && word.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
}

/// Returns the end of the help page: the list of baselines, the examples of the program, and [`ALSO`].
fn after_help<C: CommandFactory>() -> String {
    let command = C::command();
    let examples = command.get_after_help().map(ToString::to_string);
    let paragraphs = baselines(&command).into_iter().chain(examples);
    paragraphs.chain([ALSO.to_string()]).collect::<Vec<_>>().join("\n\n")
}

/// Lists the subcommands that exist to compare with the literature, under a heading; `None` if a program has none.
/// These are the hidden subcommands, which the list of the others leaves out.
fn baselines(command: &clap::Command) -> Option<String> {
    let names: Vec<&clap::Command> =
        command.get_subcommands().filter(|c| c.is_hide_set()).collect();
    let widest = names.iter().map(|c| c.get_name().len()).max()?;
    let mut text = String::from("Baselines, to compare with the literature:");
    for command in names {
        let about = command.get_about().map(ToString::to_string).unwrap_or_default();
        text += &format!("\n  {:widest$}  {about}", command.get_name());
    }
    Some(text)
}

/// Returns the text that `arguments` ask for with `--completions`, `--man` or `--describe`; `None` for other arguments.
/// The text also shows the hidden subcommands. The error is the message for a wrong value. `definition` makes the
/// definition of the command line.
pub(crate) fn generated(
    definition: impl Fn() -> clap::Command,
    arguments: &[OsString],
) -> Option<Result<Vec<u8>, String>> {
    let whole = || definition().mut_subcommands(|c| c.hide(false));
    if let [names @ .., last] = arguments
        && last == "--man"
    {
        // A word that is no command is for the stage to refuse.
        return named(whole(), names).map(man_page);
    }
    let first = arguments.first()?.to_str()?;
    let (flag, value) = first.split_once('=').map_or((first, None), |(f, v)| (f, Some(v)));
    let value = value.or_else(|| arguments.get(1)?.to_str());
    match flag {
        "--completions" => {
            let names = "bash, zsh, fish, elvish or powershell";
            let Some(shell) = value.and_then(|name| Shell::from_str(name, true).ok()) else {
                let value = value.unwrap_or_default();
                return Some(Err(format!("--completions is '{value}'; give {names}")));
            };
            let mut command = whole();
            let name = command.get_name().to_string();
            let mut bytes = Vec::new();
            clap_complete::generate(shell, &mut command, name, &mut bytes);
            Some(Ok(bytes))
        }
        "--describe" => Some(Ok(format!("{:#}\n", describe::program(definition())).into_bytes())),
        _ => None,
    }
}

/// Returns the command that `names` lead to, one subcommand in the other; `None` if one of them is no subcommand.
fn named(mut command: clap::Command, names: &[OsString]) -> Option<clap::Command> {
    command.build();
    names.iter().try_fold(command, |command, name| command.find_subcommand(name).cloned())
}

/// Returns the manual page in roff: the program, then each subcommand with its flags.
fn man_page(mut command: clap::Command) -> Result<Vec<u8>, String> {
    command.build();
    let mut bytes = Vec::new();
    let mut add = |command: &clap::Command| {
        clap_mangen::Man::new(command.clone())
            .source(format!("Planish {}", env!("CARGO_PKG_VERSION")))
            .render(&mut bytes)
            .map_err(|e| e.to_string())
    };
    add(&command)?;
    for sub in command.get_subcommands().filter(|c| c.get_name() != "help") {
        add(sub)?;
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Does this and that
    #[derive(Parser)]
    #[command(name = "planish-example", after_help = "Examples:\n  planish-example --pitch-mm 2")]
    struct Cli {
        /// Distance of the lines [mm]
        #[arg(long)]
        pitch_mm: f64,
    }

    #[test]
    fn one_number_or_two() {
        assert_eq!(pair("0.5"), Ok([0.5, 0.5]));
        assert_eq!(pair("-1, 2e3"), Ok([-1.0, 2000.0]));
        for wrong in ["", "1,", "1,2,3", "x"] {
            assert!(pair(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn settings_in_backquotes_are_flags() {
        for (message, told) in [
            ("give a larger `count_mm`", "give a larger --count-mm"),
            ("`x` or `y`: both", "--x or --y: both"),
            (
                "raise `tikhonov` (now 0), or `smoothness`",
                "raise --tikhonov (now 0), or --smoothness",
            ),
            // No settings: a quoted text, a single backquote, a command.
            ("`Z map` has `tif", "`Z map` has `tif"),
            ("in `My File` `pitch_mm` is 1", "in `My File` --pitch-mm is 1"),
            ("`a`b`", "--ab`"),
            ("", ""),
        ] {
            assert_eq!(with_flags(message), told, "{message}");
        }
    }

    fn ask(arguments: &[&str]) -> Option<Result<String, String>> {
        let arguments: Vec<OsString> = arguments.iter().map(OsString::from).collect();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        generated(command::<Cli>, &arguments).map(|result| result.map(text))
    }

    #[test]
    fn completions_know_the_flags() {
        for shell in ["bash", "zsh", "fish"] {
            let text = ask(&["--completions", shell]).unwrap().unwrap();
            assert!(text.contains("planish-example") && text.contains("pitch-mm"), "{shell}");
        }
        assert_eq!(ask(&["--completions=bash"]), ask(&["--completions", "bash"]));
        assert!(ask(&["--completions"]).unwrap().unwrap_err().contains("give bash, zsh"));
        assert!(ask(&["--completions", "cmd"]).unwrap().unwrap_err().contains("is 'cmd'"));
    }

    #[test]
    fn the_manual_page_has_flags_and_examples() {
        let page = ask(&["--man"]).unwrap().unwrap();
        for part in
            [".TH planish", "pitch\\-mm", "Distance of the lines", "planish\\-example \\-\\-pitch"]
        {
            assert!(page.contains(part), "{part}: {page}");
        }
    }

    #[test]
    fn anything_else_is_for_the_stage() {
        assert_eq!(ask(&[]), None);
        assert_eq!(ask(&["--pitch-mm", "1"]), None);
        assert_eq!(ask(&["no-command", "--man"]), None);
    }
}
