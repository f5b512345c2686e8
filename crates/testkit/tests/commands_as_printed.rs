//! Every command in README.md and docs/*.md, run as it is printed there, from top to bottom, in a copy of
//! what a clone has: what a reader copies works. `just test-commands` runs this file; it needs `just`,
//! the release build, and `target/python` with NumPy.
//!
//! What counts as a command: each line of a code block marked `sh`; the blocks marked `python` make the
//! arrays that the next commands read. Files that a user would have are made by `user_files.py`.
//!
//! A code block below the line `<!-- printed by: COMMAND -->` shows what that command prints. Its words and numbers are
//! compared with what the command prints here; `just printed-numbers` writes them anew. COMMAND may be the beginning of a
//! long one, followed by ` ...`. In tutorials and how-to pages every command that prints something has such a block. A
//! block below `<!-- file: PATH -->` is written to that file.
//!
//! With words in PLANISH_PAGES, only README.md and the pages whose names contain one of them are run.
#![cfg(unix)]

use std::{
    fs, iter,
    os::unix::fs::{PermissionsExt, symlink},
    path::{Path, PathBuf},
    process::{Command, Output},
    time::Instant,
};

use planish_testkit::workspace;
use serde_json::Value;

/// Commands that are not run here, with the reason.
const EXCEPTIONS: [(&str, &str); 21] = [
    ("planish run bspline", "two minutes"),
    ("just programs-table", "half an hour"),
    ("just programs-table --grids", "minutes"),
    (
        "just programs-table --controllers automation1,sinumerik,sinumerik-poly,twincat,xps-pt,zaber \
         --rows \"coupon raster,coupon maze,raster,maze\"",
        "minutes",
    ),
    ("planish sweep sweeps/small.yaml refine_front=yes", "a minute"),
    (
        "planish sweep sweeps/reference.yaml profile=slurm \
         snakemake='--default-resources slurm_partition=NAME slurm_account=NAME'",
        "needs a cluster; `just test-slurm` has one on this machine",
    ),
    ("just test-faults", "minutes; .ci/run disturbs a twentieth as often"),
    ("just test-killed", "half an hour; .ci/run kills one pipeline"),
    (
        "planish run raster fixture=coupon out=out/warming varying=\"time --table warm-up.txt\"",
        "ends with 1, as the page says; `just test-pipelines` runs such a tool",
    ),
    ("just test-schedulers-long", "an hour; a piece of it is run"),
    ("just fuzz 50000", "minutes; .ci/run gives every reader 2000 inputs"),
    ("just fuzz 10000000 2 hdf5", "a quarter of an hour"),
    ("just fuzz-binaries 500 1", "minutes"),
    (
        "cargo install --locked --debug just && just test",
        "it runs this workspace's tests; .ci/run runs it",
    ),
    ("just reproduce", "minutes; `just ci-long` runs it"),
    ("just reproduce pvt", "part of `just reproduce`"),
    ("PLANISH_REFERENCE=DIR just reproduce", "needs the reference mirror"),
    ("planish app sessions/mirror-7", "ends with Ctrl-C alone"),
    (
        "python3 benchmark/example/submission.py coupon submission.csv",
        "reads benchmark/, which is not in the copy",
    ),
    (
        "planish benchmark score benchmark/problems/coupon-ion-beam-no-jerk-limit.json \
         submission.csv",
        "reads benchmark/, which is not in the copy",
    ),
    (
        "planish dwell bound --surface surface --tif tif --time-s 120,200 --out bound",
        "needs a map and a tool of the reader",
    ),
];

/// Page with the machine file that other pages name.
const DESCRIBE_A_MACHINE: &str = "docs/how-to/describe-a-machine.md";

/// How-to pages, whose commands are run and whose outputs are checked, but for those without commands. One that needs
/// files of another stands after it.
const HOW_TO_WITH_OUTPUT: [&str; 27] = [
    "import-a-map",
    "import-a-tif",
    "prepare-a-map",
    "4d",
    "add-material",
    "after-exit-code-1",
    "bruker",
    "check-a-specification",
    "choose-a-plan",
    "choose-pitch-overscan-floor",
    "choose-tools",
    "compare-many-plans",
    "edge-and-aperture",
    "estimate-process-errors",
    "export-a-program",
    "first-run",
    "go-on-after-an-abort",
    "gwyddion",
    "identify-a-controller",
    "load-and-start",
    "many-parts",
    "maps-in-series",
    "place-the-part",
    "read-a-log",
    "shorten-a-run",
    "stitched-profiles",
    "zygo",
];

/// Page whose blocks of Python are one script.
const FIRST_MIRROR: &str = "docs/tutorials/first-mirror.md";

/// Smallest ratio of the surface error to the executed residual of docs/replace_a_stage.py. Larger: the
/// test may fail after a small change. Smaller: a worse example passes. Measured: 35 on this mirror, whose
/// error is within reach of the tool but for a pit.
const EXAMPLE_IMPROVES: f64 = 20.0;

/// Definitions of the variables that the python block of README.md uses.
const ARRAYS: &str = "
import os
import numpy as np
made = lambda name: np.load(f'made/{name}.npy')
height, x, y = made('surface/height_nm'), made('surface/x_mm'), made('surface/y_mm')
rate, dx, dy = made('tif/rate_nm_per_s'), made('tif/x_mm'), made('tif/y_mm')
os.makedirs('mirror'), os.makedirs('tool')
";

/// Largest difference of a printed number from the one that a command prints, in units of its last digit. Larger: stale
/// numbers pass. Smaller: numbers fail that another processor rounds another way.
const LAST_DIGITS: f64 = 2.0;

/// The same, relative to the number. The arrays are the same bytes on any number of threads, but another processor may
/// round another way, and a solver that ends within 1e-3 of the least objective then ends elsewhere. Measured: the largest
/// acceleration of the plan `joint` differs by 0.75 % between two processors.
const OTHER_PROCESSOR: f64 = 1e-2;

/// The same for the numbers of a row of the plan `joint`, in their order: four residuals, two times, two velocities and
/// two accelerations. Its solver stops within 1e-3 of the least objective. There the objective is flat, so time and
/// extremes of the motion differ more than the residual. Measured between two processors: 1.03 % of the time, 3.3 % of a
/// velocity, 3.8 % of an acceleration.
const JOINT_ON_OTHER_PROCESSOR: [f64; 10] =
    [1e-2, 1e-2, 1e-2, 1e-2, 2e-2, 2e-2, 5e-2, 5e-2, 5e-2, 5e-2];

/// Beginning of the line above a block that a command prints.
const PRINTED_BY: &str = "<!-- printed by: ";
/// Beginning of the part of that line that excludes the last N numbers, for times and memory.
const BUT_FOR: &str = ", but for the last ";

/// Beginning of the line above a block that is the text of a file.
const FILE: &str = "<!-- file: ";

/// A code block: its mark, its text, the file that holds it, and the command that prints it.
#[derive(Debug, Default, PartialEq)]
struct Block {
    mark: String,
    text: String,
    file: Option<String>,
    printed: Option<Printed>,
}

/// A command of a page that was run, what it printed, and whether the page shows this.
#[derive(Debug, Default, PartialEq)]
struct Ran {
    command: String,
    output: String,
    is_shown: bool,
}

/// The command that prints a block, and the count of numbers at the end of every line that differ from run
/// to run.
#[derive(Clone, Debug, Default, PartialEq)]
struct Printed {
    by: String,
    varying: usize,
}

impl Printed {
    /// Reads the line above a block.
    fn from_line(line: &str) -> Option<Self> {
        let inside = line.strip_prefix(PRINTED_BY)?.strip_suffix(" -->").expect("the comment ends");
        let Some((by, varying)) = inside.split_once(BUT_FOR) else {
            return Some(Self { by: inside.into(), varying: 0 });
        };
        let count = varying.split(' ').next().and_then(|n| n.parse().ok());
        Some(Self { by: by.into(), varying: count.expect("a count of numbers") })
    }
}

/// A line as its words and its numbers; a number is `#` among the words.
fn words_and_numbers(line: &str) -> (String, Vec<String>) {
    let (mut words, mut numbers) = (Vec::new(), Vec::new());
    for word in line.split_whitespace() {
        let bare = word.trim_end_matches([',', ';', ':', '%', ')']).trim_start_matches('(');
        if bare.parse::<f64>().is_ok() {
            numbers.push(bare.to_string());
            words.push(word.replacen(bare, "#", 1));
        } else {
            words.push(word.into());
        }
    }
    (words.join(" "), numbers)
}

/// Returns true if two numbers differ by at most [`LAST_DIGITS`] of the one that is shown, or the fraction `relative` of
/// it.
fn same_number(shown: &str, printed: &str, relative: f64) -> bool {
    let decimals = shown.split_once('.').map_or(0, |(_, fraction)| fraction.len());
    let [shown, printed] = [shown, printed].map(|text| text.parse::<f64>().unwrap());
    // A thousandth of a digit allows for the rounding of the two decimal fractions.
    let of_digits = (LAST_DIGITS + 1e-3) * 10_f64.powi(-(decimals as i32));
    (shown - printed).abs() <= of_digits.max(relative * shown.abs())
}

/// Returns true if `printed` has the words of `shown`, and its numbers but for the last `varying`.
fn same_line(shown: &str, printed: &str, varying: usize) -> bool {
    let own: &[f64] = if shown.starts_with("joint") { &JOINT_ON_OTHER_PROCESSOR } else { &[] };
    let tolerances = own.iter().copied().chain(iter::repeat(OTHER_PROCESSOR));
    let (shown, printed) = (words_and_numbers(shown), words_and_numbers(printed));
    let fixed = shown.1.len().saturating_sub(varying);
    let mut numbers = shown.1[..fixed].iter().zip(&printed.1).zip(tolerances);
    shown.0 == printed.0 && numbers.all(|((a, b), relative)| same_number(a, b, relative))
}

/// The lines of `output` that a block shows: as many as it has, from a line that begins with its first word. Of several
/// such places it is the one where most lines have the words of the block, and the last of these.
fn shown_lines<'a>(block: &Block, output: &'a str) -> Option<Vec<&'a str>> {
    let first = block.text.split_whitespace().next()?;
    let lines: Vec<&str> = output.lines().map(str::trim_end).collect();
    let places = lines.windows(block.text.lines().count());
    let places = places.filter(|place| place[0].split_whitespace().next() == Some(first));
    places.max_by_key(|place| lines_with_words(block, place)).map(<[&str]>::to_vec)
}

/// Number of lines of a block whose words stand in the same line of `place`.
fn lines_with_words(block: &Block, place: &[&str]) -> usize {
    let same =
        |(shown, line): &(&str, &&str)| words_and_numbers(shown).0 == words_and_numbers(line).0;
    block.text.lines().zip(place).filter(same).count()
}

/// The command `by` of those of a page so far. `by` may be the beginning of a long command, followed by ` ...`: the last
/// such command.
fn ran_by<'a>(ran: &'a mut [Ran], by: &str) -> Option<&'a mut Ran> {
    let mut commands = ran.iter_mut().rev();
    match by.strip_suffix(" ...") {
        Some(beginning) => commands.find(|ran| ran.command.starts_with(beginning)),
        None => commands.find(|ran| ran.command == by),
    }
}

/// The code blocks of a page.
fn blocks(page: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut open: Option<Block> = None;
    let mut above = "";
    for line in page.lines() {
        match (line.strip_prefix("```"), &mut open) {
            (Some(mark), None) => {
                let file = above.strip_prefix(FILE).and_then(|path| path.strip_suffix(" -->"));
                let (file, printed) = (file.map(String::from), Printed::from_line(above));
                open = Some(Block { mark: mark.into(), file, printed, ..Block::default() });
            }
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (None, Some(block)) => block.text.extend([line, "\n"]),
            (None, None) => {}
        }
        above = line;
    }
    assert!(open.is_none(), "a code block is not closed");
    blocks
}

/// The commands of a block: its lines, where one that ends with a backslash goes on.
fn commands(text: &str) -> Vec<String> {
    let joined = text.replace("\\\n", "\\\0");
    let lines = joined.lines().map(|line| line.replace('\0', "\n"));
    lines.filter(|line| !line.trim().is_empty() && !line.starts_with('#')).collect()
}

/// Returns true if a line is a command of its own, and neither a message of a program nor a line of a script.
fn is_command(line: &str) -> bool {
    let mut words = line.split_whitespace();
    let first = words.next().unwrap_or_default();
    let is_message = words.next().is_some_and(|word| word.ends_with(':'));
    ["just", "cargo"].contains(&first) || line.starts_with("planish ") && !is_message
}

/// Reason why a command is not run here, if there is one.
fn exception(command: &str) -> Option<&'static str> {
    let found = EXCEPTIONS.iter().find(|(excepted, _)| bare(command) == *excepted);
    found.map(|(_, reason)| *reason)
}

/// A command without its remark.
fn bare(command: &str) -> &str {
    command.split(" #").next().unwrap().trim()
}

/// README.md, then docs/*.md by name, then the tutorials, then the how-to pages that show output. With words in
/// PLANISH_PAGES, only README.md and those that one of the words is a part of.
fn pages() -> Vec<(String, String)> {
    let mut names = vec!["README.md".to_string()];
    for folder in ["docs", "docs/tutorials"] {
        let docs = fs::read_dir(workspace().join(folder)).unwrap();
        let docs = docs.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut docs: Vec<_> = docs.filter(|name| name.ends_with(".md")).collect();
        docs.sort();
        names.extend(docs.into_iter().map(|name| format!("{folder}/{name}")));
    }
    names.extend(HOW_TO_WITH_OUTPUT.map(|name| format!("docs/how-to/{name}.md")));
    let wanted = wanted_pages();
    names.retain(|name| {
        name == "README.md" || wanted.is_empty() || wanted.iter().any(|word| name.contains(word))
    });
    let read = |name: String| {
        let text = fs::read_to_string(workspace().join(&name)).unwrap();
        (name, text)
    };
    names.into_iter().map(read).collect()
}

/// The words in PLANISH_PAGES.
fn wanted_pages() -> Vec<String> {
    let words = std::env::var("PLANISH_PAGES").unwrap_or_default();
    words.split_whitespace().map(String::from).collect()
}

/// A copy of what a clone has, without the sources: a command of cargo runs in the workspace, so that
/// nothing is built a second time.
struct Clone {
    dir: PathBuf,
    path: String,
}

impl Clone {
    fn new(name: &str) -> Self {
        let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        let _ = fs::remove_dir_all(&dir);
        fs::create_dir_all(dir.join("shims")).unwrap();
        for part in [
            "README.md",
            "justfile",
            "docs",
            "fixtures",
            "pipelines",
            "scripts",
            "sweeps",
            "workflow",
        ] {
            let copy = Command::new("cp").arg("-r").arg(workspace().join(part)).arg(&dir).status();
            assert!(copy.unwrap().success(), "{part}");
        }
        // The files of instruments that the how-to pages read.
        fs::create_dir_all(dir.join("crates/import/tests")).unwrap();
        symlink(workspace().join("crates/import/tests/data"), dir.join("crates/import/tests/data"))
            .unwrap();
        symlink(workspace().join("target"), dir.join("target")).unwrap();
        let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
        let shim = format!("#!/bin/sh\ncd '{}' && exec '{cargo}' \"$@\"\n", workspace().display());
        let file = dir.join("shims/cargo");
        fs::write(&file, shim).unwrap();
        fs::set_permissions(&file, fs::Permissions::from_mode(0o755)).unwrap();
        let target = workspace().join("target");
        let path = format!(
            "{}:{}:{}:{}",
            dir.join("shims").display(),
            target.join("release").display(),
            target.join("python/bin").display(),
            std::env::var("PATH").unwrap()
        );
        Self { dir, path }
    }

    /// Writes the machine file that the page on machines shows, which the other pages call `machine.json`.
    fn write_machine(&self) {
        let page = fs::read_to_string(workspace().join(DESCRIBE_A_MACHINE)).unwrap();
        let machine = blocks(&page).into_iter().find(|block| block.mark == "json").unwrap();
        fs::write(self.dir.join("machine.json"), machine.text).unwrap();
    }

    /// Runs `text` by `program`, which takes it from its last argument.
    fn run(&self, program: &[&str], text: &str) -> Output {
        let mut command = Command::new(program[0]);
        // The commands find `cargo` and their own settings as a user's shell would.
        for (name, _) in std::env::vars() {
            if name.starts_with("CARGO_") && !name.starts_with("CARGO_HOME")
                || name == "RUST_BACKTRACE"
            {
                command.env_remove(name);
            }
        }
        command.args(&program[1..]).arg(text).current_dir(&self.dir).env("PATH", &self.path);
        command.output().unwrap_or_else(|e| panic!("{}: {e}", program[0]))
    }

    /// [`Self::run`]. Says what runs, and for how long; returns what it prints, with the exit status if the command fails.
    fn attempt(&self, place: &str, program: &[&str], text: &str) -> Result<String, String> {
        let started = Instant::now();
        let output = self.run(program, text);
        println!("{place}, {:.1} s: {text}", started.elapsed().as_secs_f64());
        let (out, err) =
            (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        if !output.status.success() {
            return Err(format!("{place}: {text}\nends with {}\n{out}\n{err}", output.status));
        }
        Ok(format!("{out}{err}"))
    }

    /// [`Self::attempt`], which must succeed.
    fn succeed(&self, place: &str, program: &[&str], text: &str) -> String {
        self.attempt(place, program, text).unwrap_or_else(|failure| panic!("{failure}"))
    }

    /// RMS before the run and of the row `mine` in the report that README.md makes, nm.
    fn row_of_the_example(&self) -> (f64, f64) {
        let file = self.dir.join("out/raster/flat-92x16/report/summary.json");
        let summary: Value = serde_json::from_str(&fs::read_to_string(file).unwrap()).unwrap();
        let rms_nm = |of: &Value| of["rms_nm"].as_f64().expect("the row has an RMS");
        (rms_nm(&summary["initial"]), rms_nm(&summary["methods"]["mine"]))
    }
}

/// Findings on the pages: commands that fail or whose output is not shown, lines that show another output, and the
/// number of commands.
#[derive(Default)]
struct Findings {
    failures: Vec<String>,
    stale: Vec<String>,
    commands: usize,
}

impl Findings {
    /// Runs the commands of a page, and compares the outputs that it shows. Returns the page with what is printed now.
    fn of_page(&mut self, clone: &Clone, name: &str, page: &str) -> String {
        let mut ran: Vec<Ran> = Vec::new();
        let mut written = page.to_string();
        for block in blocks(page) {
            match (block.mark.as_str(), &block.file, &block.printed) {
                ("sh", ..) => ran.extend(self.run(clone, name, &block)),
                (_, Some(file), _) => {
                    let file = clone.dir.join(file);
                    fs::create_dir_all(file.parent().unwrap()).unwrap();
                    fs::write(file, &block.text).unwrap();
                }
                ("python", ..) if name == FIRST_MIRROR => {}
                ("python", ..) => {
                    clone.succeed(name, &["python3", "-c"], &format!("{ARRAYS}{}", block.text));
                }
                (.., Some(by)) => {
                    let Some(ran) = ran_by(&mut ran, &by.by) else {
                        self.failures.push(format!("{name}: `{}` is not run, or fails", by.by));
                        continue;
                    };
                    ran.is_shown = true;
                    if let Some(lines) = self.compare(name, &block, by, &ran.output) {
                        written = written.replacen(&block.text, &(lines.join("\n") + "\n"), 1);
                    }
                }
                _ => {}
            }
        }
        if name.starts_with("docs/tutorials/") || name.starts_with("docs/how-to/") {
            let hidden = ran.iter().filter(|ran| !ran.is_shown && !ran.output.trim().is_empty());
            self.failures.extend(hidden.map(|Ran { command, output, .. }| {
                format!("{name}: no block below shows what `{command}` prints:\n{output}")
            }));
        }
        written
    }

    /// Runs the commands of a block. Returns those that succeed.
    fn run(&mut self, clone: &Clone, name: &str, block: &Block) -> Vec<Ran> {
        let mut all = Vec::new();
        for command in commands(&block.text) {
            self.commands += 1;
            if let Some(reason) = exception(&command) {
                println!("{name}, left out ({reason}): {command}");
                continue;
            }
            match clone.attempt(name, &["bash", "-c"], &command) {
                Ok(output) => {
                    all.push(Ran { command: bare(&command).into(), output, is_shown: false });
                }
                Err(failure) => self.failures.push(failure),
            }
        }
        all
    }

    /// Compares the lines of a block with those of an output. Returns the lines of the block, those that differ as the
    /// output has them.
    fn compare<'a>(
        &mut self,
        name: &str,
        block: &'a Block,
        printed: &Printed,
        output: &'a str,
    ) -> Option<Vec<&'a str>> {
        let Printed { by, varying } = printed;
        let Some(mut lines) = shown_lines(block, output) else {
            let text = &block.text;
            self.failures.push(format!("{name}: `{by}` prints nothing like\n{text}\n{output}"));
            return None;
        };
        for (shown, line) in block.text.lines().zip(&mut lines) {
            if same_line(shown, line, *varying) {
                *line = shown;
            } else {
                self.stale.push(format!("{name}, `{by}`:\n  {shown}\n  {line}"));
            }
        }
        Some(lines)
    }
}

#[test]
fn the_commands_of_readme_and_docs_run_as_they_are_printed() {
    let clone = Clone::new("commands");
    clone.succeed("user files", &["bash", "-c"], "planish fixture fixtures/coupon.json --out made");
    let user_files = workspace().join("crates/testkit/tests/user_files.py");
    clone.succeed("user files", &["python3", user_files.to_str().unwrap()], "made");
    clone.write_machine();

    let mut findings = Findings::default();
    let mut example = None;
    for (name, page) in pages() {
        let written = findings.of_page(&clone, &name, &page);
        if std::env::var_os("PLANISH_WRITE_PRINTED").is_some() && written != page {
            fs::write(workspace().join(&name), written).unwrap();
        }
        // The stage of the section on own stages is a row of the report, and improves the mirror.
        if page.contains("docs/replace_a_stage.py") {
            example = Some(clone.row_of_the_example());
        }
    }
    let Findings { failures, stale, commands } = findings;
    assert!(failures.is_empty(), "commands of the pages fail:\n{}", failures.join("\n"));
    assert!(
        stale.is_empty(),
        "pages show other numbers than their commands print (below each line what is printed now); \
         `just printed-numbers` writes them anew:\n{}",
        stale.join("\n")
    );
    if !wanted_pages().is_empty() {
        return;
    }
    assert!(commands > 20, "only {commands} commands are found");
    let (before, after) = example.expect("a page has the example of an own stage");
    println!("docs/replace_a_stage.py: {before:.4} nm RMS become {after:.4} nm");
    assert!(after * EXAMPLE_IMPROVES < before, "{before} nm become {after} nm");
}

#[test]
fn the_tutorial_of_the_first_mirror_runs_as_it_is_printed() {
    let clone = Clone::new("first-mirror");
    clone.write_machine();
    let page = fs::read_to_string(workspace().join(FIRST_MIRROR)).unwrap();
    let script: String =
        blocks(&page).into_iter().filter(|block| block.mark == "python").map(|b| b.text).collect();
    let module = format!("import sys; sys.path.insert(0, {:?})\n", workspace().join("python"));
    let printed = clone.succeed(FIRST_MIRROR, &["python3", "-c"], &format!("{module}{script}"));
    let line = printed.lines().find(|line| line.ends_with("nm RMS after")).unwrap();
    println!("{FIRST_MIRROR}: {line}");
    let is_shown = |block: &Block| block.mark.is_empty() && block.text.contains("nm RMS before");
    let shown = blocks(&page).into_iter().find(is_shown).expect("the page shows what it prints");
    assert!(
        same_line(shown.text.trim(), line, 0),
        "the page shows {}, printed is {line}",
        shown.text
    );
    assert!(
        clone.dir.join("program.galil").is_file() && clone.dir.join("program.galil.json").is_file()
    );
}

#[test]
fn every_command_is_in_a_block_that_is_run_and_every_exception_is_needed() {
    if !wanted_pages().is_empty() {
        return;
    }
    let pages = pages();
    let all: Vec<String> = pages
        .iter()
        .flat_map(|(_, page)| blocks(page))
        .filter(|block| block.mark == "sh")
        .flat_map(|block| commands(&block.text))
        .collect();
    for (excepted, _) in EXCEPTIONS {
        let used =
            all.iter().any(|command| exception(command).is_some() && command.contains(excepted));
        assert!(used, "no page has {excepted} any more");
    }
    for (name, page) in &pages {
        for block in blocks(page).iter().filter(|block| block.mark != "sh") {
            for line in block.text.lines() {
                assert!(!is_command(line), "{name}: mark the block of `{line}` with sh");
            }
        }
    }
}

#[test]
fn blocks_and_commands_are_found() {
    let page = "text\n```sh\na b \\\n    c\n\n# no\nd # e\n```\n```\nshown\n```\n";
    let found = blocks(page);
    assert_eq!(found.len(), 2);
    assert_eq!((found[0].mark.as_str(), found[1].mark.as_str()), ("sh", ""));
    assert_eq!(commands(&found[0].text), ["a b \\\n    c", "d # e"]);
    assert!(is_command("planish run raster") && !is_command("planish run: 1 plan"));
    assert!(exception("just reproduce     # minutes").is_some());
    assert!(exception("just reproduce trig-spline").is_none());
}

#[test]
fn a_stale_number_is_found_and_a_time_of_computation_is_not() {
    let page = "```sh\njust x # a\n```\n<!-- printed by: just x, but for the last 1 numbers -->\n```\nrms 0.154 nm, 12 s\nof (3.0 mm)\n```\n";
    let block = blocks(page).pop().unwrap();
    assert_eq!(block.printed, Some(Printed { by: "just x".into(), varying: 1 }));
    let printed = "rms 9 nm\nbefore\nrms 0.1559 nm, 77 s\nof (3.0 mm)\nafter\n";
    let lines = shown_lines(&block, printed).unwrap();
    assert_eq!(lines, ["rms 0.1559 nm, 77 s", "of (3.0 mm)"]);
    // Two units of the third decimal are 0.002.
    assert!(same_line("rms 0.154 nm, 12 s", lines[0], 1));
    assert!(!same_line("rms 0.154 nm, 12 s", lines[0], 0), "the time is another");
    assert!(!same_line("rms 0.154 nm, 12 s", "rms 0.1562 nm, 12 s", 1), "2.2 units");
    assert!(!same_line("of (3.0 mm)", "of (3.0 um)", 0), "another unit");
    // The time of a joint plan may differ by 2 %, its residual by 1 %, and another plan by 1 %.
    let row =
        |name: &str, rms: &str, s: &str| format!("{name} {rms} 0.1 0.1 0.9 {s} 11 31.03, 5.7");
    assert!(same_line(&row("joint", "0.1169", "678.50"), &row("joint", "0.1172", "666.00"), 0));
    assert!(!same_line(&row("joint", "0.1169", "678.50"), &row("joint", "0.1192", "678.50"), 0));
    assert!(!same_line(&row("pvt", "0.1169", "678.50"), &row("pvt", "0.1169", "666.00"), 0));
    assert_eq!(shown_lines(&block, "nothing\n"), None);
    // Two lines that begin alike: the place where both lines have the words of the block.
    let page = "```\na: 1 x\na: 2 y\n```\n";
    let block = blocks(page).pop().unwrap();
    assert_eq!(
        shown_lines(&block, "a: 3 x\na: 4 y\na: 5 z\na: 6 z\n").unwrap(),
        ["a: 3 x", "a: 4 y"]
    );
    let mut of_page = [("a --b 1", "first"), ("a --b 2", "second")].map(|(command, output)| Ran {
        command: command.into(),
        output: output.into(),
        is_shown: false,
    });
    for (by, output) in [("a --b 1", Some("first")), ("a --b ...", Some("second")), ("c ...", None)]
    {
        assert_eq!(ran_by(&mut of_page, by).map(|ran| ran.output.as_str()), output);
    }
    let page = "<!-- file: out/a.json -->\n```json\n{}\n```\n";
    assert_eq!(blocks(page)[0].file.as_deref(), Some("out/a.json"));
}
