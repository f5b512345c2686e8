//! Rules of the workspace, checked on `cargo metadata` and on the sources: names between crates, forbidden
//! calls in stage libraries, and files that every crate has.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use cargo_metadata::{DependencyKind, MetadataCommand, Package, TargetKind};
use planish_compare::plan::BASELINES;
use planish_testkit::workspace;

/// A folder under `crates/`, and the folders that it may name.
type Room = (&'static str, &'static [&'static str]);

/// Crates of layers 0 to 2, the stages that see others, crates that run several stages, and the tests that
/// see all.
const ROOMS: [Room; 21] = [
    ("numerics", &[]),
    ("types", &["numerics"]),
    ("draw", &["types"]),
    (LAUNCH, &[]),
    ("form", &["numerics", "types"]),
    ("handoff", &["types", "form"]),
    ("kinematics", &["types", "form"]),
    ("tool", &["numerics", "types", "form", "handoff", "import"]),
    ("axes", &["numerics", "types", "form", "kinematics", "handoff"]),
    (
        "refine",
        &[
            "numerics",
            "types",
            "draw",
            "handoff",
            "dwell",
            "schedule",
            "simulate",
            "verify",
            "joint",
            "tolerance",
        ],
    ),
    (
        "joint",
        &["numerics", "types", "form", "kinematics", "handoff", "dwell", "simulate", "verify"],
    ),
    ("tolerance", &["numerics", "types", "handoff", "dwell", "simulate"]),
    ("reconcile", &["numerics", "types", "draw", "handoff", "simulate"]),
    ("campaign", &["types", "draw", "handoff", "simulate"]),
    (
        "benchmark",
        &["numerics", "types", "handoff", "fixture", "dwell", "simulate", "verify", "tolerance"],
    ),
    ("pipeline", &["types", "handoff"]),
    ("app", &["types", "form", "draw", "handoff", "pipeline"]),
    ("run", &["types", "handoff", "pipeline"]),
    ("sweep", &["numerics", "types", "handoff", "pipeline"]),
    ("planish", &ALL),
    ("testkit", &ALL),
];

/// Layer 3: the stages. None names another one; `handoff` is for their `main.rs`.
const STAGES: [&str; 12] = [
    "fixture",
    "import",
    "surface",
    "toolpath",
    "dwell",
    "schedule",
    "bspline-feed",
    "simulate",
    "verify",
    "export",
    "compare",
    "register",
];
/// Stages whose libraries call those of others.
const STAGES_THAT_NAME_STAGES: [&str; 8] =
    ["axes", "tool", "refine", "joint", "tolerance", "reconcile", "campaign", "benchmark"];
const STAGE_MAY_NAME: [&str; 6] = ["numerics", "types", "draw", "form", "kinematics", "handoff"];

const ALL: [&str; 30] = [
    "app",
    "numerics",
    "types",
    "draw",
    "form",
    "handoff",
    "pipeline",
    "kinematics",
    "axes",
    "fixture",
    "import",
    "surface",
    "tool",
    "toolpath",
    "dwell",
    "schedule",
    "bspline-feed",
    "simulate",
    "verify",
    "export",
    "compare",
    "refine",
    "joint",
    "tolerance",
    "reconcile",
    "campaign",
    "benchmark",
    "run",
    "sweep",
    "register",
];

/// What the `main.rs` of every stage program names.
const LAUNCH: &str = "launch";

/// Crates that the library of `testkit` may name, because the tests of every stage use it.
const TESTKIT_MAY_NAME: [&str; 3] = ["types", "handoff", "pipeline"];

/// Pairs (judge, judged): a judge must not depend on what it judges, also not through other crates.
const NEVER: [(&str, &str); 4] =
    [("simulate", "dwell"), ("simulate", "schedule"), ("verify", "dwell"), ("verify", "schedule")];

/// Words that a library of the layers 0, 1 and 3 must not contain: files, the shell, printing, the clock,
/// the environment.
const IMPURE: [&str; 14] = [
    "planish_handoff",
    "clap",
    "std::fs",
    "fs::",
    "std::io",
    "std::env",
    "env::",
    "println!",
    "eprintln!",
    "print!",
    "eprint!",
    "dbg!",
    "Instant",
    "SystemTime",
];

/// Flags in the sources of libraries that are no settings of the library: a comment in a program for a
/// controller, whose reader has the command line before him.
const FLAGS_FOR_OPERATORS: [(&str, &str); 4] = [
    ("pmac.rs", "--tool-output"),
    ("around.rs", "--host-script"),
    ("around.rs", "--commands"),
    ("around.rs", "--from-mark"),
];

/// Marks of unfinished code; they are split so that this file does not contain them.
const UNFINISHED: [&str; 3] =
    [concat!("unimplemented", "!"), concat!("to", "do!"), concat!("#[ig", "nore")];

/// Names of modules that say nothing about their contents.
const DRAWERS: [&str; 5] = ["utils", "util", "common", "core", "misc"];

// ---------------------------------------------------------------------------------------------
// Checkers: functions from facts to complaints, so that tests can show that they complain

/// Arrows (from, to) between folders that the layers forbid.
fn forbidden_arrows(arrows: &[(String, String)]) -> Vec<String> {
    let mut complaints = Vec::new();
    for (from, to) in arrows {
        let allowed = if STAGES.contains(&from.as_str()) {
            &STAGE_MAY_NAME[..]
        } else {
            ROOMS.iter().find(|(name, _)| name == from).map_or(&[][..], |(_, may_name)| may_name)
        };
        if to != LAUNCH && !allowed.contains(&to.as_str()) {
            complaints.push(format!("{from} names {to}; it may name {allowed:?}"));
        }
    }
    let reached = closure(arrows);
    for (judge, judged) in NEVER {
        if reached.contains(&(judge.into(), judged.into())) {
            complaints.push(format!("{judge} sees {judged}"));
        }
    }
    complaints
}

/// Complaints about names of `testkit` outside of tests, and about names in its library. Each dependency is
/// (from, to, only for tests).
fn misuse_of_testkit(dependencies: &[(String, String, bool)]) -> Vec<String> {
    let mut complaints = Vec::new();
    for (from, to, _) in dependencies.iter().filter(|(.., for_tests)| !for_tests) {
        if to == "testkit" {
            complaints.push(format!("{from} names testkit; only its tests may"));
        } else if from == "testkit" && !TESTKIT_MAY_NAME.contains(&to.as_str()) {
            complaints.push(format!(
                "the library of testkit names {to}; it may name {TESTKIT_MAY_NAME:?}"
            ));
        }
    }
    complaints
}

/// All pairs that a chain of arrows joins.
fn closure(arrows: &[(String, String)]) -> BTreeSet<(String, String)> {
    let mut reached: BTreeSet<_> = arrows.iter().cloned().collect();
    loop {
        let longer: Vec<_> = reached
            .iter()
            .flat_map(|(a, b)| {
                arrows
                    .iter()
                    .filter(move |(from, _)| from == b)
                    .map(|(_, c)| (a.clone(), c.clone()))
            })
            .filter(|pair| !reached.contains(pair))
            .collect();
        if longer.is_empty() {
            return reached;
        }
        reached.extend(longer);
    }
}

/// The only derive of the command line that a library may have: names of the values of a setting.
const NAMES_OF_VALUES: &str = "clap::ValueEnum";

/// Modules of the command line of a stage beside `command.rs`, `cli.rs` and `cli/`.
const COMMAND_LINE_FILES: [&str; 3] =
    ["compare/src/files.rs", "sweep/src/files.rs", "sweep/src/runner.rs"];

/// Words of `words` that the code contains, without comments and unit tests.
fn mentions(source: &str, words: &[&'static str]) -> Vec<&'static str> {
    let tests = source.find("#[cfg(test)]\nmod tests").unwrap_or(source.len());
    let code: Vec<&str> = source[..tests].lines().map(without_comment).collect();
    let code = code.join("\n").replace(NAMES_OF_VALUES, "");
    words.iter().copied().filter(|word| contains_word(&code, word)).collect()
}

/// Flags that the code names, without comments and unit tests. Flags of a command that the code tells to
/// run do not count; the program of such a command stands before them in the line.
fn flags(source: &str) -> Vec<&str> {
    let tests = source.find("#[cfg(test)]\nmod tests").unwrap_or(source.len());
    let mut flags = Vec::new();
    for line in source[..tests].lines().map(without_comment) {
        for (at, _) in line.match_indices("--") {
            let (before, flag) = line.split_at(at);
            let begins = flag[2..].starts_with(|c: char| c.is_ascii_lowercase());
            if begins && !before.ends_with('-') && !before.contains("planish ") {
                let end = flag.find(|c: char| !(c.is_ascii_alphanumeric() || c == '-'));
                flags.push(&flag[..end.unwrap_or(flag.len())]);
            }
        }
    }
    flags
}

/// The line up to `//`; no line of ours has `//` in a string before something that matters.
fn without_comment(line: &str) -> &str {
    line.split("//").next().unwrap_or_default()
}

/// Places where the code takes a value out of JSON by a key, as `value["key"]` or `outcome.get("key")`, without comments
/// and unit tests.
fn accesses_by_key(source: &str) -> Vec<String> {
    let tests = source.find("#[cfg(test)]\nmod tests").unwrap_or(source.len());
    let mut found = Vec::new();
    for line in source[..tests].lines().map(without_comment) {
        let parts: Vec<&str> = line.split('"').collect();
        // A text stands between the quotation marks of a pair; a key is a text of small letters and `_`.
        for (before, key, after) in
            parts.windows(3).step_by(2).map(|part| (part[0], part[1], part[2]))
        {
            let is_key = !key.is_empty() && key.chars().all(|c| c.is_ascii_lowercase() || c == '_');
            let value = before.strip_suffix('[').unwrap_or_default();
            let is_index = after.starts_with(']')
                && value.ends_with(|c: char| c.is_alphanumeric() || "_])".contains(c));
            let is_look_up =
                ["outcome.get(", "settings.get(", "outcome.pointer(", "settings.pointer("]
                    .iter()
                    .any(|call| before.ends_with(call));
            if is_key && is_index || is_look_up {
                found.push(format!("[\"{key}\"]"));
            }
        }
    }
    found
}

/// Returns true if `word` occurs in `code`, not as the end or the beginning of a longer name.
fn contains_word(code: &str, word: &str) -> bool {
    let part_of_name = |c: char| c.is_alphanumeric() || c == '_';
    let open_end = !word.ends_with(part_of_name);
    code.match_indices(word).any(|(at, _)| {
        let before = code[..at].chars().next_back();
        let after = code[at + word.len()..].chars().next();
        !before.is_some_and(part_of_name) && (open_end || !after.is_some_and(part_of_name))
    })
}

/// Modules that name each other, directly or through others. A module and its submodules are one
/// subject: what they name of each other does not count.
fn circles(arrows: &[(String, String)]) -> Vec<String> {
    let within = |a: &str, b: &str| a.strip_prefix(b).is_some_and(|rest| rest.starts_with("::"));
    let apart = |(a, b): &&(String, String)| a != b && !within(a, b) && !within(b, a);
    let reached = closure(&arrows.iter().filter(apart).cloned().collect::<Vec<_>>());
    reached.into_iter().filter(|(from, to)| from == to).map(|(from, _)| from).collect()
}

/// The modules of its own crate that the code of module `own` names, of those in `all`.
fn named_modules(own: &str, source: &str, all: &BTreeSet<String>) -> BTreeSet<String> {
    let tests = source.find("#[cfg(test)]\nmod tests").unwrap_or(source.len());
    let code: Vec<&str> = source[..tests].lines().map(without_comment).collect();
    let code = code.join("\n");
    let mut paths = Vec::new();
    for statement in code.split_inclusive(';') {
        // A name that a module only re-exports is no use of it.
        if statement.trim_start().starts_with("pub use ") {
            continue;
        }
        for root in ["crate", "super", "self"] {
            let is_root = |at: &usize| {
                let before = statement[..*at].chars().next_back();
                !before.is_some_and(|c| c.is_alphanumeric() || "_:".contains(c))
            };
            for (at, _) in statement.match_indices(&format!("{root}::")) {
                if is_root(&at) {
                    let mut rest = &statement[at..];
                    expand(&mut rest, &[], &mut paths);
                }
            }
        }
    }
    let mut named = BTreeSet::new();
    for path in paths {
        let mut at: Vec<&str> = own.split("::").collect();
        for word in path {
            match word {
                "crate" => at.clear(),
                "self" => {}
                "super" => drop(at.pop()),
                // A name that is no module is an item of the one before it.
                word if all.contains(&[&at[..], &[word]].concat().join("::")) => at.push(word),
                _ => break,
            }
        }
        named.insert(at.join("::"));
    }
    named.remove("");
    named.remove(own);
    named
}

/// The paths that begin at `rest`, such as `a::{b, c::d}`: each after `prefix`.
fn expand<'a>(rest: &mut &'a str, prefix: &[&'a str], paths: &mut Vec<Vec<&'a str>>) {
    let mut path = prefix.to_vec();
    loop {
        *rest = rest.trim_start();
        let end = rest.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(rest.len());
        let (word, after) = rest.split_at(end);
        *rest = after.trim_start();
        path.push(word);
        let Some(after) = rest.strip_prefix("::") else { break };
        *rest = after.trim_start();
        if let Some(list) = rest.strip_prefix('{') {
            *rest = list.trim_start();
            while !rest.is_empty() && !rest.starts_with('}') {
                expand(rest, &path, paths);
                // To the next element: over `as name` and the comma.
                let next = rest.find([',', '}']).unwrap_or(rest.len());
                *rest = rest[next..].trim_start_matches(',').trim_start();
            }
            *rest = rest.strip_prefix('}').unwrap_or(rest);
            return;
        }
    }
    paths.push(path);
}

// ---------------------------------------------------------------------------------------------
// Facts

/// Crates of the workspace by folder; what stands for a crate of others has nothing of ours.
fn packages() -> BTreeMap<String, Package> {
    let metadata = MetadataCommand::new()
        .manifest_path(workspace().join("Cargo.toml"))
        .no_deps()
        .other_options(["--offline".to_string()])
        .exec()
        .expect("cargo metadata of the workspace");
    let ours = |p: &Package| p.manifest_path.starts_with(workspace().join("crates"));
    metadata.packages.into_iter().filter(ours).map(|p| (folder_of(&p), p)).collect()
}

fn folder_of(package: &Package) -> String {
    let manifest = package.manifest_path.as_std_path();
    let folder = manifest.parent().and_then(Path::file_name).expect("a manifest is in a folder");
    folder.to_string_lossy().into_owned()
}

/// Dependencies between folders, and whether only tests have them.
fn dependencies() -> Vec<(String, String, bool)> {
    let mut found = Vec::new();
    for (from, package) in packages() {
        for dependency in &package.dependencies {
            if let Some(to) = dependency.name.strip_prefix("planish-") {
                let for_tests = dependency.kind == DependencyKind::Development;
                found.push((from.clone(), to.to_string(), for_tests));
            }
        }
    }
    found
}

/// Arrows of all kinds of dependencies, but for what tests use of `testkit`.
fn arrows() -> Vec<(String, String)> {
    let tests_use = |(_, to, for_tests): &(String, String, bool)| *for_tests && to == "testkit";
    let others = dependencies().into_iter().filter(|dependency| !tests_use(dependency));
    others.map(|(from, to, _)| (from, to)).collect()
}

fn directory_of(folder: &str) -> PathBuf {
    workspace().join("crates").join(folder)
}

/// The `.rs` files under `dir`, at any depth; none when there is no such directory.
fn sources_under(dir: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(dir) else { return Vec::new() };
    let mut files = Vec::new();
    for entry in entries {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(sources_under(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// Returns `root` and the files of the modules that it declares, at any depth; nothing where there is no such file.
fn module_tree(root: &Path) -> BTreeSet<PathBuf> {
    let mut files = BTreeSet::new();
    if !root.exists() {
        return files;
    }
    let mut open = vec![root.to_path_buf()];
    while let Some(file) = open.pop() {
        let parent = file.parent().unwrap();
        let own = match file.file_stem().unwrap().to_str().unwrap() {
            "lib" | "main" | "mod" => parent.to_path_buf(),
            stem => parent.join(stem),
        };
        for line in fs::read_to_string(&file).unwrap().lines() {
            let declaration = without_comment(line).trim().strip_suffix(';');
            let name = declaration.and_then(|d| {
                ["mod ", "pub mod ", "pub(crate) mod "].iter().find_map(|p| d.strip_prefix(p))
            });
            if let Some(name) = name {
                let flat = own.join(format!("{name}.rs"));
                open.push(if flat.exists() { flat } else { own.join(name).join("mod.rs") });
            }
        }
        files.insert(file);
    }
    files
}

/// Files of the library of a crate, without those of its command line.
fn library_files(folder: &str) -> BTreeSet<PathBuf> {
    let src = directory_of(folder).join("src");
    let mut files = module_tree(&src.join("lib.rs"));
    files.retain(|file| {
        let own = file.strip_prefix(&src).unwrap();
        let is_command_line = own.starts_with("cli")
            || own == Path::new("cli.rs")
            || own == Path::new("command.rs")
            || COMMAND_LINE_FILES.iter().any(|known| file.ends_with(known));
        !is_command_line
    });
    files
}

fn no_complaints(complaints: &[String]) {
    assert!(complaints.is_empty(), "{}", complaints.join("\n"));
}

// ---------------------------------------------------------------------------------------------
// Rules

#[test]
fn every_crate_has_its_place_in_the_layers() {
    for folder in packages().keys() {
        let known = STAGES.contains(&folder.as_str()) || ROOMS.iter().any(|(r, _)| r == folder);
        assert!(known, "crates/{folder} is in no layer; give it a place in this test");
        assert!(!DRAWERS.contains(&folder.as_str()), "crates/{folder}: a drawer, not a room");
    }
}

#[test]
fn arrows_point_down_and_no_stage_names_another() {
    no_complaints(&forbidden_arrows(&arrows()));
}

#[test]
fn testkit_is_for_tests_and_its_library_names_no_stage() {
    no_complaints(&misuse_of_testkit(&dependencies()));
}

#[test]
fn the_sources_name_only_declared_layers() {
    // A `use` needs a manifest entry; this catches names in the code that the manifest of the
    // library's layer would not allow, such as a dev-dependency of a stage's tests.
    let mut found = Vec::new();
    for from in packages().keys() {
        for file in ["src", "tests", "examples", "benches"]
            .iter()
            .flat_map(|d| sources_under(&directory_of(from).join(d)))
        {
            let text = fs::read_to_string(&file).unwrap();
            for to in ALL.iter().filter(|to| *to != from) {
                let name = format!("planish_{}", to.replace('-', "_"));
                if text.lines().any(|l| contains_word(without_comment(l), &name)) {
                    found.push((from.clone(), to.to_string()));
                }
            }
        }
    }
    found.retain(|(from, _)| from != "testkit" && from != "planish");
    no_complaints(&forbidden_arrows(&found));
}

#[test]
fn libraries_have_no_files_no_shell_and_no_clock() {
    let mut complaints = Vec::new();
    for folder in packages().keys() {
        if ["handoff", LAUNCH, "testkit", "planish"].contains(&folder.as_str()) {
            continue;
        }
        let files = library_files(folder);
        assert!(!files.is_empty());
        for file in files {
            let mut found = mentions(&fs::read_to_string(&file).unwrap(), &IMPURE);
            // A definition holds flags, whose words are those of the command line.
            found.retain(|word| !(folder == "pipeline" && *word == "planish_handoff"));
            if !found.is_empty() {
                complaints.push(format!("{} has {found:?}", file.display()));
            }
        }
    }
    no_complaints(&complaints);
}

#[test]
fn the_messages_of_stage_libraries_name_settings_and_no_flags() {
    let mut complaints = Vec::new();
    for folder in STAGES.iter().chain(&STAGES_THAT_NAME_STAGES) {
        for file in library_files(folder) {
            let source = fs::read_to_string(&file).unwrap();
            for flag in flags(&source) {
                let known = |(end, known): &(&str, &str)| file.ends_with(end) && flag == *known;
                if !FLAGS_FOR_OPERATORS.iter().any(known) {
                    complaints.push(format!("{}: {flag}; name the setting", file.display()));
                }
            }
        }
    }
    no_complaints(&complaints);
}

#[test]
fn no_two_modules_of_a_library_name_each_other() {
    let mut complaints = Vec::new();
    for folder in packages().keys() {
        let src = directory_of(folder).join("src");
        let name_of = |file: &Path| {
            let path = file.strip_prefix(&src).unwrap().with_extension("");
            let words: Vec<_> = path.iter().map(|w| w.to_string_lossy().into_owned()).collect();
            words.into_iter().filter(|w| w != "lib" && w != "mod").collect::<Vec<_>>().join("::")
        };
        let files = library_files(folder);
        let all: BTreeSet<String> = files.iter().map(|file| name_of(file)).collect();
        let mut arrows = Vec::new();
        for file in &files {
            let own = name_of(file);
            // The root declares the others and passes on what they make.
            if !own.is_empty() {
                let source = fs::read_to_string(file).unwrap();
                let named = named_modules(&own, &source, &all);
                arrows.extend(named.into_iter().map(|to| (own.clone(), to)));
            }
        }
        let found = circles(&arrows);
        if !found.is_empty() {
            complaints.push(format!("crates/{folder}: modules in a circle: {found:?}"));
        }
    }
    no_complaints(&complaints);
}

#[test]
fn every_source_file_belongs_to_the_library_or_the_binary() {
    for folder in packages().keys() {
        let src = directory_of(folder).join("src");
        let mut reached = module_tree(&src.join("lib.rs"));
        let main = src.join("main.rs");
        if main.exists() {
            reached.extend(module_tree(&main));
        }
        let all: BTreeSet<PathBuf> = sources_under(&src).into_iter().collect();
        let lost: Vec<_> = all.difference(&reached).collect();
        assert!(lost.is_empty(), "no module declares {lost:?}");
    }
}

#[test]
fn every_test_file_is_a_module_of_a_test_program() {
    let programs: String = packages()
        .keys()
        .filter_map(|folder| {
            let text = fs::read_to_string(directory_of(folder).join("tests/all.rs")).ok()?;
            Some(
                text.replace("#[path = \"../../", "#[path = \"")
                    .replace("#[path = \"", &format!("#[path = \"{folder}/")),
            )
        })
        .collect();
    let mut lost = Vec::new();
    for folder in packages().keys() {
        for entry in fs::read_dir(directory_of(folder).join("tests")).into_iter().flatten() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            let own = format!("\"{folder}/{name}\"");
            let by_processes = format!("\"planish/{folder}/tests/{name}\"");
            let is_module = programs.contains(&own) || programs.contains(&by_processes);
            let stands_alone = folder == "planish"
                || ["all.rs", "corpus.rs", "pipelines.rs", "commands_as_printed.rs"]
                    .contains(&name.as_str());
            if name.ends_with(".rs") && !is_module && !stands_alone {
                lost.push(format!("crates/{folder}/tests/{name}: name it in a tests/all.rs"));
            }
        }
    }
    no_complaints(&lost);
}

#[test]
fn the_one_program_has_every_stage() {
    let source = |file: &str| fs::read_to_string(directory_of("planish").join(file)).unwrap();
    assert!(source("src/main.rs").contains("static ALLOCATOR: Allocator"), "no memory budget");
    let table = source("src/stages.rs");
    for folder in packages().keys() {
        if directory_of(folder).join("src/command.rs").exists() {
            let line = format!("    planish_{}::command::", folder.replace('-', "_"));
            assert!(table.contains(&line), "crates/planish/src/stages.rs: add {line}");
        }
    }
}

#[test]
fn every_stage_has_completions_a_manual_page_examples_and_a_program() {
    for folder in packages().keys() {
        let command = directory_of(folder).join("src/command.rs");
        if command.exists() {
            let text = fs::read_to_string(&command).unwrap();
            assert!(text.contains("planish_handoff::program"), "{folder}: run through handoff");
            assert!(text.contains("after_help = EXAMPLES"), "{folder}: no examples in --help");
            let main = fs::read_to_string(directory_of(folder).join("src/main.rs")).unwrap();
            assert!(
                main.contains("planish_launch::launch"),
                "{folder}: its program starts planish"
            );
        }
    }
}

#[test]
fn every_crate_has_name_licence_description_and_the_lints() {
    for (folder, package) in packages() {
        let name = match folder.as_str() {
            "planish" => folder.clone(),
            _ => format!("planish-{folder}"),
        };
        assert_eq!(package.name.as_str(), name);
        let program = STAGES.contains(&folder.as_str())
            || STAGES_THAT_NAME_STAGES.contains(&folder.as_str())
            || ["app", "run", "sweep", "planish"].contains(&folder.as_str());
        let binaries: Vec<&str> = package
            .targets
            .iter()
            .filter(|t| t.kind.contains(&TargetKind::Bin))
            .map(|t| t.name.as_str())
            .collect();
        assert_eq!(binaries, if program { vec![name.as_str()] } else { vec![] }, "{folder}");
        assert_eq!(package.license.as_deref(), Some("MIT OR Apache-2.0"), "{folder}");
        let description = package.description.unwrap_or_default();
        assert!(description.len() > 20, "{folder}: description {description:?}");
        assert_eq!(package.publish, Some(vec![]), "{folder} is not to be published");
        let manifest = fs::read_to_string(directory_of(&folder).join("Cargo.toml")).unwrap();
        assert!(manifest.contains("[lints]\nworkspace = true"), "{folder}: no workspace lints");
    }
}

#[test]
fn nothing_is_unfinished_and_no_test_is_switched_off() {
    let mut complaints = Vec::new();
    for folder in packages().keys() {
        for file in sources_under(&directory_of(folder)) {
            let text = fs::read_to_string(&file).unwrap();
            for (number, line) in text.lines().enumerate() {
                let line = without_comment(line);
                for word in UNFINISHED.iter().filter(|word| contains_word(line, word)) {
                    complaints.push(format!("{}:{}: {word}", file.display(), number + 1));
                }
            }
        }
    }
    no_complaints(&complaints);
}

/// Words of code that asks for the operating system, or uses what one system alone has.
const OF_ONE_SYSTEM: [&str; 8] = [
    "cfg(unix)",
    "cfg(windows)",
    "cfg(target_os",
    "cfg(not(unix",
    "cfg(not(target_os",
    "os::unix",
    "os::windows",
    "rustix",
];

#[test]
fn one_module_depends_on_the_operating_system() {
    let system = directory_of("handoff").join("src/system.rs");
    // A stage program becomes another one, and has nothing but the standard library.
    let launch = directory_of(LAUNCH).join("src/lib.rs");
    assert!(!mentions(&fs::read_to_string(&system).unwrap(), &OF_ONE_SYSTEM).is_empty());
    let mut complaints = Vec::new();
    for folder in packages().keys() {
        for file in sources_under(&directory_of(folder).join("src")) {
            if file != system && file != launch {
                for word in mentions(&fs::read_to_string(&file).unwrap(), &OF_ONE_SYSTEM) {
                    complaints.push(format!(
                        "{}: {word} belongs in handoff/src/system.rs",
                        file.display()
                    ));
                }
            }
        }
    }
    no_complaints(&complaints);
}

/// A key of a manifest is a field of a type in `types::outcome`, so that the compiler finds who reads a renamed one.
#[test]
fn nobody_reads_json_by_a_key() {
    let mut complaints = Vec::new();
    for folder in packages().keys() {
        for file in sources_under(&directory_of(folder).join("src")) {
            for key in accesses_by_key(&fs::read_to_string(&file).unwrap()) {
                complaints.push(format!(
                    "{}: {key}: read and write it as a field of a type in types/src/outcome, so that a renamed field is \
                     a compile error",
                    file.display()
                ));
            }
        }
    }
    no_complaints(&complaints);
}

/// The folders `baselines` and the list by which a report knows their plans.
#[test]
fn a_report_knows_every_baseline() {
    let mut found = BTreeSet::new();
    for folder in ["dwell", "schedule"] {
        let modules = fs::read_to_string(directory_of(folder).join("src/baselines.rs")).unwrap();
        for line in modules.lines() {
            if let Some(name) = line.strip_prefix("pub mod ") {
                let method = name.trim_end_matches(';').replace('_', "-");
                found.insert((format!("planish-{folder}"), method));
            }
        }
    }
    let known = BASELINES.map(|(program, method)| (program.to_string(), method.to_string()));
    assert_eq!(found, BTreeSet::from(known));
}

// ---------------------------------------------------------------------------------------------
// The checkers complain

#[test]
fn a_forbidden_arrow_is_caught() {
    let arrow = |from: &str, to: &str| vec![(from.to_string(), to.to_string())];
    for (from, to) in [
        ("numerics", "types"),
        ("types", "handoff"),
        ("handoff", "surface"),
        ("draw", "numerics"),
        ("toolpath", "surface"),
        ("compare", "verify"),
        ("refine", "compare"),
        ("simulate", "refine"),
        ("run", "compare"),
        ("sweep", "joint"),
        ("verify", "run"),
        ("newcomer", "types"),
    ] {
        let complaints = forbidden_arrows(&arrow(from, to));
        assert_eq!(complaints.len(), 1, "{from} -> {to}: {complaints:?}");
    }
    for (from, to) in [("types", "numerics"), ("dwell", "handoff"), ("refine", "simulate")] {
        assert!(forbidden_arrows(&arrow(from, to)).is_empty(), "{from} -> {to}");
    }
    // Twice forbidden: by its layer, and as a judge; also when another crate lies between.
    assert_eq!(forbidden_arrows(&arrow("verify", "schedule")).len(), 2);
    let detour = [arrow("simulate", "numerics"), arrow("numerics", "dwell")].concat();
    assert!(forbidden_arrows(&detour).contains(&"simulate sees dwell".to_string()));
}

#[test]
fn a_misuse_of_testkit_is_caught() {
    for (from, to, for_tests, caught) in [
        ("dwell", "testkit", true, 0),
        ("dwell", "testkit", false, 1),
        ("testkit", "dwell", true, 0),
        ("testkit", "dwell", false, 1),
        ("testkit", "types", false, 0),
    ] {
        let complaints = misuse_of_testkit(&[(from.into(), to.into(), for_tests)]);
        assert_eq!(complaints.len(), caught, "{from} -> {to}: {complaints:?}");
    }
}

#[test]
fn an_impure_library_is_caught() {
    for (source, found) in [
        ("use std::fs;", vec!["std::fs"]),
        ("use clap::Parser;", vec!["clap"]),
        ("#[derive(clap::Parser)]\nstruct E;", vec!["clap"]),
        ("#[derive(Clone, clap::ValueEnum)]\nenum E {}", vec![]),
        ("    println!(\"{x}\");", vec!["println!"]),
        ("let t = std::time::Instant::now();", vec!["Instant"]),
        ("planish_handoff::say(1);", vec!["planish_handoff"]),
        // Not the thing itself.
        ("// planish_handoff reads it with std::fs", vec![]),
        ("let overclap = clapper(InstantValue);", vec![]),
        ("pure();\n#[cfg(test)]\nmod tests { fn f() { println!(); } }", vec![]),
    ] {
        assert_eq!(mentions(source, &IMPURE), found, "{source}");
    }
    assert!(contains_word(concat!("#[ig", "nore = \"slow\"]"), UNFINISHED[2]));
}

#[test]
fn a_flag_in_a_library_is_caught() {
    for (source, found) in [
        ("let remedy = \"give a larger --count-mm\";", vec!["--count-mm"]),
        ("\"leave out --x and --y, or \\\n --unit\"", vec!["--x", "--y", "--unit"]),
        ("let remedy = \"give a larger `count_mm`\"; // --count-mm", vec![]),
        ("\"run planish simulate --frames again\"", vec![]),
        ("let a = b - -c; // ----", vec![]),
        ("pure();\n#[cfg(test)]\nmod tests { fn f() { g(\"--out\"); } }", vec![]),
    ] {
        assert_eq!(flags(source), found, "{source}");
    }
}

#[test]
fn an_access_by_key_is_caught() {
    for (source, found) in [
        ("let kept = verdict[\"limits_respected\"] == true;", vec!["[\"limits_respected\"]"]),
        ("m[\"a\"][0][\"b\"]", vec!["[\"a\"]", "[\"b\"]"]),
        ("manifest.settings.get(\"free\")", vec!["[\"free\"]"]),
        ("array(\"x_mm\", Dtype::F64, &[\"nx\"], &[\"x\"])", vec![]),
        ("#[group(args = [\"surface\"])] // m[\"a\"]", vec![]),
        ("f();\n#[cfg(test)]\nmod tests { fn f() { m[\"a\"] } }", vec![]),
    ] {
        assert_eq!(accesses_by_key(source), found, "{source}");
    }
}

#[test]
fn a_circle_of_modules_is_caught() {
    let all: BTreeSet<String> = ["a", "b", "b::c", "b::d"].into_iter().map(String::from).collect();
    for (own, source, named) in [
        ("a", "use crate::{b::{Item, c::{self, f as g}}, a::x};", vec!["b", "b::c"]),
        ("b::c", "fn f() { super::d::g(crate::a::Z) }", vec!["a", "b::d"]),
        ("b", "pub use self::c::Item;\nuse self::d::X;\nlet a = b;", vec!["b::d"]),
        ("b::d", "// crate::a\n#[cfg(test)]\nmod tests { use crate::a::X; }", vec![]),
    ] {
        let found = named_modules(own, source, &all);
        assert_eq!(found.into_iter().collect::<Vec<_>>(), named, "{own}: {source}");
    }
    let arrow = |from: &str, to: &str| (from.to_string(), to.to_string());
    let chain = [arrow("a", "b::c"), arrow("b::c", "b::d"), arrow("b", "b::c")];
    assert!(circles(&chain).is_empty());
    let closed = [&chain[..], &[arrow("b::d", "a")]].concat();
    assert_eq!(circles(&closed), ["a", "b::c", "b::d"]);
    assert!(circles(&[arrow("b", "b::c"), arrow("b::c", "b")]).is_empty());
}
