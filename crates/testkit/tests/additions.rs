//! What is added in one place is also in the others that need it. Where it lacks, the file to touch is named
//! (CONTRIBUTING.md, "Where things go"). What the compiler demands by itself is not here.

use std::{fs, path::PathBuf};

use planish_compare::plan::BASELINES;
use planish_testkit::workspace;

fn text(file: &str) -> String {
    fs::read_to_string(workspace().join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

/// The files of a folder with this ending, in order: their names without it, and their texts.
fn files(folder: &str, ending: &str) -> Vec<(String, String)> {
    let entries = fs::read_dir(workspace().join(folder)).unwrap();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|e| e == ending));
    paths.sort();
    let name = |path: &PathBuf| path.file_stem().unwrap().to_string_lossy().into_owned();
    paths.iter().map(|path| (name(path), fs::read_to_string(path).unwrap())).collect()
}

/// What stands between `open` and `close`, wherever `open` occurs.
fn between<'a>(text: &'a str, open: &'a str, close: &'a str) -> impl Iterator<Item = &'a str> {
    text.split(open).skip(1).filter_map(move |rest| rest.split(close).next())
}

/// Every name of `names` must occur in the file, written as by `as_written`.
#[track_caller]
fn all_in(what: &str, names: &[String], file: &str, as_written: impl Fn(&str) -> String) {
    assert!(names.len() > 3, "{what}: {names:?}");
    let text = text(file);
    let missing: Vec<_> = names.iter().filter(|name| !text.contains(&as_written(name))).collect();
    assert!(missing.is_empty(), "{what}: add {missing:?} to {file}");
}

#[test]
fn every_scheduler_is_compared_and_described() {
    let sources = files("crates/schedule/src/cli", "rs");
    let method = |(_, text): &(String, String)| {
        Some(between(text, "const METHOD: &'static str = \"", "\"").next()?.to_string())
    };
    let names: Vec<String> = sources.iter().filter_map(method).collect();
    let pipelines = text("pipelines/shared.yaml");
    let compared = between(&pipelines, "every-scheduler:\n", "\n  #").next().unwrap();
    let is_missing = |name: &&String| {
        !compared.contains(&format!("scheduler={name}\n"))
            && !compared.contains(&format!("scheduler='{name} "))
    };
    let missing: Vec<_> = names.iter().filter(is_missing).collect();
    assert!(missing.is_empty(), "add {missing:?} to every-scheduler in pipelines/shared.yaml");
    all_in("scheduler", &names, "docs/schedulers.md", |name| format!("`{name}"));
    let is_baseline = |name: &str| BASELINES.contains(&("planish-schedule", name));
    let chosen: Vec<String> = names.into_iter().filter(|name| !is_baseline(name)).collect();
    // Its row there also has it tried along random paths.
    let table = "crates/schedule/src/lib.rs";
    all_in("scheduler of the closed loop", &chosen, table, |name| format!("name: \"{name}\""));
}

#[test]
fn every_tool_path_is_tried_with_absurd_flags() {
    let sources = files("crates/toolpath/src/cli", "rs");
    let method = |(_, text): &(String, String)| {
        Some(between(text, "on.begin(&task!(\"", "\"").next()?.to_string())
    };
    let names: Vec<String> = sources.iter().filter_map(method).collect();
    all_in("path", &names, "crates/toolpath/tests/hostile.rs", |name| format!("\"{name}\","));
}

#[test]
fn every_dwell_solver_is_compared_and_described() {
    let solvers = files("crates/dwell/src/cli", "rs").into_iter();
    let names: Vec<String> = solvers.map(|(name, _)| name.replace('_', "-")).collect();
    all_in("dwell solver", &names, "docs/dwell.md", |name| format!("`{name}"));
    // Several tools have a path each, and the pipeline has one tool. The bound has no path, and a front many times.
    let is_of_one_path =
        |name: &String| !["several-tools", "bound", "front"].contains(&name.as_str());
    let of_one_path: Vec<String> = names.into_iter().filter(is_of_one_path).collect();
    all_in("dwell solver", &of_one_path, "pipelines/compare-dwell.yaml", |name| {
        format!("solver='{name} ")
    });
}

#[test]
fn every_pipeline_is_built_in() {
    let names: Vec<String> = files("pipelines", "yaml").into_iter().map(|(name, _)| name).collect();
    let file = "crates/pipeline/src/definition.rs";
    all_in("pipeline", &names, file, |name| format!("pipelines/{name}.yaml"));
}

#[test]
fn every_reader_of_maps_is_fuzzed() {
    let source = text("crates/import/src/format.rs");
    let read = source.split("pub fn read(").nth(1).unwrap();
    // Arms such as `Format::Gsf => gsf::read(bytes),`. A directory is no file.
    let arms = read.lines().filter(|line| line.contains(" => ") && line.contains("::read("));
    let name = |line: &str| between(line, "Format::", " ").next().unwrap_or_default().to_string();
    let names: Vec<String> = arms.map(name).collect();
    all_in("format", &names, "fuzz/src/readers.rs", |name| format!("Format::{name}, bytes)"));
}

#[test]
fn every_controller_is_in_the_list_of_all_and_described() {
    let file = "crates/types/src/controller.rs";
    let source = text(file);
    let words = source.split("fn words(self)").nth(1).unwrap().split("    }\n\n").next().unwrap();
    let variants: Vec<String> = between(words, "Self::", " ").map(String::from).collect();
    let all = between(&source, "pub const ALL", ";\n").next().unwrap();
    let missing: Vec<_> =
        variants.iter().filter(|name| !all.contains(&format!("Self::{name}"))).collect();
    assert!(variants.len() > 3 && missing.is_empty(), "add {missing:?} to ALL in {file}");
    let names: Vec<String> = between(words, "(\"", "\"").map(String::from).collect();
    all_in("controller", &names, "docs/controllers.md", |name| format!("\n| `{name}` |"));
}
