//! Description of a program as data, which `PROGRAM --describe` prints. Other languages make
//! functions from it.
//!
//! ```json
//! { "program": "planish-verify", "version": "0.1.0", "about": "...",
//!   "commands": [ { "name": "", "about": "...", "baseline": false, "flags": [
//!     { "name": "machine", "help": "...", "value": "FILE", "type": "path", "values": [1, 1], "required": true,
//!       "repeats": false, "positional": false, "default": null, "choices": [] } ] } ] }
//! ```
//!
//! A program without subcommands has one command without a name. `values` is the smallest and the
//! largest number of values of a flag; a switch has none. `type` is that of each value: `number`, `integer`, `path` or
//! `text`. The description is made from the
//! definition that parses the command line, so the two cannot differ.

use std::{any::TypeId, path::PathBuf};

use clap::{Arg, ArgAction, Command};
use serde_json::{Value, json};

use crate::telling;

/// Returns the description of a program's command line as JSON, in the form that the module head shows.
pub(crate) fn program(mut command: Command) -> Value {
    command.build();
    let mut commands = Vec::new();
    // A program with subcommands may also run without one.
    if !command.is_subcommand_required_set() {
        commands.push(one("", &command));
    }
    for own in command.get_subcommands().filter(|c| c.get_name() != "help") {
        commands.push(one(own.get_name(), own));
    }
    json!({
        "program": command.get_name(),
        "version": command.get_version(),
        "about": about(&command),
        "commands": commands,
    })
}

fn one(name: &str, command: &Command) -> Value {
    let flags = command.get_arguments().filter(|a| !is_help(a) && !telling::is_shared(a)).map(flag);
    json!({
        "name": name,
        "about": about(command),
        "baseline": command.is_hide_set(),
        "flags": flags.collect::<Vec<_>>(),
    })
}

fn about(command: &Command) -> String {
    let text = command.get_long_about().or(command.get_about());
    text.map(ToString::to_string).unwrap_or_default()
}

fn is_help(argument: &Arg) -> bool {
    use ArgAction::{Help, HelpLong, HelpShort, Version};
    matches!(argument.get_action(), Help | HelpShort | HelpLong | Version)
}

fn flag(argument: &Arg) -> Value {
    let takes = argument.get_action().takes_values();
    let values = argument.get_num_args().filter(|_| takes);
    let default = argument.get_default_values().iter().map(|v| v.to_string_lossy()).next();
    let choices = argument.get_possible_values();
    let choices = choices.iter().filter(|_| takes).map(|c| c.get_name());
    let help = argument.get_long_help().or(argument.get_help());
    json!({
        "name": argument.get_long().unwrap_or(argument.get_id().as_str()),
        "help": help.map(ToString::to_string).unwrap_or_default(),
        "value": argument.get_value_names().filter(|_| takes).map(|names| names.join(" ")),
        "type": value_type(argument),
        "values": values.map_or([0, 0], |range| [range.min_values(), range.max_values()]),
        "required": argument.is_required_set(),
        "repeats": matches!(argument.get_action(), ArgAction::Append),
        "positional": argument.is_positional(),
        "default": default,
        "choices": choices.collect::<Vec<_>>(),
    })
}

/// Returns the type of each value of a flag, for functions of other languages.
fn value_type(argument: &Arg) -> &'static str {
    let id = argument.get_value_parser().type_id();
    let integers = [TypeId::of::<u64>(), TypeId::of::<u32>(), TypeId::of::<usize>()];
    if id == TypeId::of::<f64>() {
        "number"
    } else if integers.iter().any(|integer| id == *integer) {
        "integer"
    } else if id == TypeId::of::<PathBuf>() {
        "path"
    } else {
        "text"
    }
}

#[cfg(test)]
mod tests {
    use clap::{Parser, ValueEnum};

    use super::*;

    #[derive(Clone, ValueEnum)]
    enum Mode {
        Smooth,
        Monotone,
    }

    /// Do this
    #[derive(Parser)]
    #[command(name = "planish-example", version = "7")]
    struct Cli {
        /// Map [surface artifact]
        #[arg(long, value_name = "DIR")]
        surface: String,
        /// Shape
        #[arg(long, value_enum, default_value = "monotone")]
        mode: Mode,
        /// Distance from A to B, mm
        #[arg(long, num_args = 2, value_names = ["A", "B"])]
        range_mm: Option<Vec<f64>>,
        /// Replace
        #[arg(long)]
        force: bool,
        /// Runs
        runs: Vec<String>,
    }

    #[test]
    fn a_program_is_described_flag_by_flag() {
        let found = program(<Cli as clap::CommandFactory>::command());
        assert_eq!(
            (&found["program"], &found["version"]),
            (&json!("planish-example"), &json!("7"))
        );
        let command = &found["commands"][0];
        assert_eq!((&command["name"], &command["about"]), (&json!(""), &json!("Do this")));
        let flags = command["flags"].as_array().unwrap();
        let flag = |name: &str| flags.iter().find(|f| f["name"] == name).unwrap();
        assert_eq!(flags.len(), 5, "neither --help nor --version: {flags:?}");
        assert_eq!(flag("surface")["required"], true);
        assert_eq!(flag("surface")["help"], "Map [surface artifact]");
        assert_eq!(flag("mode")["default"], "monotone");
        assert_eq!(flag("mode")["choices"], json!(["smooth", "monotone"]));
        assert_eq!(flag("range-mm")["values"], json!([2, 2]));
        assert_eq!(flag("range-mm")["type"], "number");
        assert_eq!(flag("surface")["type"], "text");
        assert_eq!(
            (&flag("force")["values"], &flag("force")["value"]),
            (&json!([0, 0]), &json!(null))
        );
        assert_eq!(
            (&flag("runs")["positional"], &flag("runs")["repeats"]),
            (&json!(true), &json!(true))
        );
    }
}
