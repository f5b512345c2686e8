//! A flag has one meaning in all programs. `docs/prose/flags.txt` states the meaning of a flag that several commands
//! describe in different words, and every description begins with it.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
};

use planish_testkit::workspace;
use serde_json::Value;

/// File of the flags that several commands describe in different words.
const MEANINGS: &str = "docs/prose/flags.txt";

/// A flag of one command.
struct Flag {
    /// Program and command.
    command: String,
    name: String,
    help: String,
    takes_a_value: bool,
}

/// The programs of the workspace.
fn programs() -> BTreeSet<String> {
    let crates = fs::read_dir(workspace().join("crates")).unwrap().map(|e| e.unwrap().path());
    let programs = crates.filter(|path| path.join("src/command.rs").exists());
    programs.map(|p| format!("planish-{}", p.file_name().unwrap().to_str().unwrap())).collect()
}

/// Every flag of every command, as `--describe` prints it; positional arguments have no name that a user types.
fn flags() -> Vec<Flag> {
    let mut flags = Vec::new();
    for program in programs() {
        let output = planish_testkit::program::stage(&program).arg("--describe").output().unwrap();
        let described: Value = serde_json::from_slice(&output.stdout).unwrap();
        for command in described["commands"].as_array().unwrap() {
            let place = format!("{program} {}", command["name"].as_str().unwrap());
            for flag in command["flags"].as_array().unwrap() {
                if flag["positional"] == false {
                    let help = flag["help"].as_str().unwrap();
                    flags.push(Flag {
                        command: place.trim().to_string(),
                        name: flag["name"].as_str().unwrap().to_string(),
                        help: help.split_whitespace().collect::<Vec<_>>().join(" "),
                        takes_a_value: flag["value"].is_string(),
                    });
                }
            }
        }
    }
    assert!(flags.len() > 300, "{} flags", flags.len());
    flags
}

/// The meanings of shared flags by the name of the flag: "--name: meaning".
fn meanings() -> BTreeMap<String, String> {
    let page = fs::read_to_string(workspace().join(MEANINGS)).unwrap();
    let row = |line: &str| {
        let (name, meaning) = line.strip_prefix("--")?.split_once(": ")?;
        Some((name.to_string(), meaning.trim().to_string()))
    };
    page.lines().filter_map(row).collect()
}

/// Returns true if the description begins with the meaning, as whole words.
fn begins_with(help: &str, meaning: &str) -> bool {
    let rest = help.strip_prefix(meaning);
    rest.is_some_and(|rest| !rest.starts_with(|c: char| c.is_alphanumeric() || c == '_'))
}

/// Mistakes in the descriptions of the flags, one line each.
fn mistakes(flags: &[Flag], meanings: &BTreeMap<String, String>) -> Vec<String> {
    let mut by_name: BTreeMap<&str, Vec<&Flag>> = BTreeMap::new();
    for flag in flags {
        by_name.entry(&flag.name).or_default().push(flag);
    }
    let mut found = Vec::new();
    for (name, all) in &by_name {
        let place = |flag: &Flag| format!("  {}: {}", flag.command, flag.help);
        let texts: BTreeSet<&str> = all.iter().map(|flag| flag.help.as_str()).collect();
        if all.iter().any(|flag| flag.takes_a_value != all[0].takes_a_value) {
            found.push(format!("--{name} takes a value in some commands only"));
        }
        match meanings.get(*name) {
            None if texts.len() > 1 => {
                let places: Vec<_> = all.iter().map(|flag| place(flag)).collect();
                found.push(format!(
                    "--{name} has {} descriptions, and {MEANINGS} does not state one meaning. If the meanings \
                     differ, rename a flag:\n{}",
                    texts.len(),
                    places.join("\n")
                ));
            }
            Some(meaning) => {
                found.extend(all.iter().filter(|flag| !begins_with(&flag.help, meaning)).map(
                    |flag| format!("--{name} does not begin with \"{meaning}\":\n{}", place(flag)),
                ))
            }
            None => {}
        }
    }
    let once = |name: &str| by_name.get(name).is_none_or(|all| all.len() < 2);
    let stale = meanings.keys().filter(|name| once(name));
    found.extend(stale.map(|name| format!("{MEANINGS}: no two commands have --{name}")));
    found
}

#[test]
fn a_flag_has_one_meaning_in_all_programs() {
    let found = mistakes(&flags(), &meanings());
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn a_second_meaning_is_found() {
    let flag = |command: &str, help: &str| Flag {
        command: command.into(),
        name: "after".into(),
        help: help.into(),
        takes_a_value: true,
    };
    let two = [flag("a", "Map measured after the run"), flag("b", "Shape to subtract")];
    let meaning = |text: &str| BTreeMap::from([("after".to_string(), text.to_string())]);
    assert!(mistakes(&two, &BTreeMap::new())[0].contains("has 2 descriptions"));
    assert!(mistakes(&two, &meaning("Map"))[0].contains("b: Shape to subtract"));
    assert!(mistakes(&two[..1], &BTreeMap::new()).is_empty());
    assert!(mistakes(&two[..1], &meaning("Map"))[0].contains("no two commands"));
    let same = [flag("a", "Map, before"), flag("b", "Map; after")];
    assert!(mistakes(&same, &meaning("Map")).is_empty());
    assert!(!begins_with("Mapping", "Map"));
}
