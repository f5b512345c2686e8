//! Execution of the commands of a stage: each is printed before it runs, and one function decides on exit codes.

use std::{
    collections::BTreeMap,
    env, ffi,
    fs::{self, File},
    io::{self, Read, Write},
    path::{Path, PathBuf},
    process::{Command as Process, ExitStatus, Stdio},
    time::Instant,
};

use planish_handoff::{
    Failure, Inputs, Running, as_command,
    from_run::{REHEARSAL, SETTINGS_OF_FLAGS},
    say, stage_command, tells_text, words,
};
use planish_pipeline::{
    scope::{Origins, Scope, Words},
    walk::{StageCommand, Step, Walk},
};
use planish_types::{ControllerKind, ToolPath};

use super::{
    claim::{Claim, Named, refuse_special},
    place::Installation,
    program::{plan_of, read_answer},
};

/// Artifacts that are removed if a scheduler, a dwell solver or the bound refuses; the comparison then leaves it out.
const LEFT_OUT: [&str; 3] = ["dwell", "trajectory", "bound"];
/// Name of the file for the messages of a command that may refuse, in the directory of its result.
const MESSAGE: &str = "message.txt";

/// Exit code that stands for a process that a signal ended, or whose own code is not from 0 to 255. No stage uses it.
const KILLED: u8 = 128;

/// Programs that make mirror, tool and tool path, in short time. The programs after them may take hours.
const SHORT: [&str; 5] =
    ["planish-fixture", "planish-import", "planish-surface", "planish-tool", "planish-toolpath"];

/// Programs without a trial before the run: they read a whole run, or a large file that the first stage reads anyway.
const NOT_REHEARSED: [&str; 4] =
    ["planish-run", "planish-compare", "planish-fixture", "planish-import"];

/// Destination of the commands and messages that a run prints.
pub enum Messages {
    /// The user's terminal.
    Shown,
    /// A log file, which the caller shows if a command fails.
    Kept(File),
    /// The user's terminal, for warnings, verdicts and errors alone (`--quiet`, `--json`).
    Quiet,
}

/// End of a run: exit code 0, 1 or 2, and the final values of the settings. The reason for a code above 0 was printed.
pub struct Ended<'a> {
    /// Exit code: 0 done, 1 negative verdict, 2 refused or failed.
    pub code: u8,
    /// Settings and facts of the pipeline at the end of the run, by name.
    pub scope: Scope<'a>,
}

/// Starter of the programs of Planish: their search path, and the destination of their messages.
pub struct Programs {
    path: ffi::OsString,
    messages: Messages,
}

impl Programs {
    /// Creates a starter for the programs of this installation.
    ///
    /// # Errors
    /// Fails if their folder cannot be in the PATH.
    pub fn new(place: &Installation, messages: Messages) -> Result<Self, Failure> {
        let rest = env::var_os("PATH").unwrap_or_default();
        let folders = [place.programs.clone()].into_iter().chain(env::split_paths(&rest));
        let path = env::join_paths(folders).map_err(|e| {
            Failure::new(format!("{}: cannot be in the PATH: {e}", place.programs.display()))
        })?;
        let messages = match messages {
            Messages::Shown if !tells_text() => Messages::Quiet,
            other => other,
        };
        Ok(Self { path, messages })
    }

    /// Prints a command and runs it. Returns its exit code, or [`KILLED`] if a signal ended it.
    ///
    /// # Errors
    /// Fails if the command cannot be run.
    pub fn run(&self, command: &StageCommand) -> Result<u8, Failure> {
        self.print(&command.line());
        let mut process = self.process(command);
        match &self.messages {
            Messages::Shown => {}
            Messages::Kept(file) => {
                process.stdout(file.try_clone()?).stderr(file.try_clone()?);
            }
            Messages::Quiet => {
                process.stdout(Stdio::null());
            }
        }
        Ok(code(self.ended(command, ended(&mut process))?))
    }

    /// Prints and runs a command whose messages go to the file `message`. Returns its exit code, or [`KILLED`].
    fn attempt(&self, command: &StageCommand, message: &Path) -> Result<u8, Failure> {
        self.print(&format!("{} 2> {}", command.line(), words::quote(&message.to_string_lossy())));
        let mut process = self.process(command);
        refuse_special(message)?;
        let file = File::create(message)
            .map_err(|e| Failure::new(format!("{}: cannot write: {e}", message.display())))?;
        process.stderr(file);
        match &self.messages {
            Messages::Shown => {}
            Messages::Kept(file) => {
                process.stdout(file.try_clone()?);
            }
            Messages::Quiet => {
                process.stdout(Stdio::null());
            }
        }
        Ok(code(self.ended(command, ended(&mut process))?))
    }

    /// Runs a command without showing its output. Returns its exit code and its message if the code is not 0; otherwise
    /// `None`.
    ///
    /// # Errors
    /// Fails if the command cannot be run.
    pub fn refusal(&self, command: &StageCommand) -> Result<Option<(u8, String)>, Failure> {
        self.print(&command.line());
        let mut process = self.process(command);
        process.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        let (status, message) = self.ended(command, heard(&mut process))?;
        if status.success() {
            return Ok(None);
        }
        Ok(Some((code(status), String::from_utf8_lossy(&message).trim().to_string())))
    }

    /// Runs a command up to the point where its work begins. `run` is the directory of the run, and `made` the paths in
    /// it that exist already. Returns the message of a command that refuses its flags or inputs (exit code 2); `None`
    /// for any other end.
    fn rehearsal(
        &self,
        command: &StageCommand,
        run: &str,
        made: &[String],
    ) -> Result<Option<String>, Failure> {
        let mut process = self.process(command);
        let paths = serde_json::to_string(&[&[run.to_string()], made].concat())?;
        process.env(REHEARSAL, paths).stdin(Stdio::null()).stdout(Stdio::null());
        let (status, message) = self.ended(command, heard(process.stderr(Stdio::piped())))?;
        let message = String::from_utf8_lossy(&message).trim().to_string();
        Ok(if code(status) == 2 { Some(message) } else { None })
    }

    /// Prepares the process of a command. An environment variable tells it which settings its flags come from, for its
    /// messages.
    fn process(&self, command: &StageCommand) -> Process {
        let mut process = stage_command(&command.program, env::split_paths(&self.path));
        process.args(&command.arguments).env("PATH", &self.path);
        let Origins { of_flag, more_flags, .. } = &command.origins;
        let more = more_flags.iter().map(|setting| format!("\t{setting}"));
        let flags = of_flag.iter().filter(|(flag, _)| !flag.contains(char::is_control));
        let lines = flags.map(|(flag, text)| format!("{flag}\t{text}")).chain(more);
        process.env(SETTINGS_OF_FLAGS, lines.collect::<Vec<_>>().join("\n"));
        process
    }

    /// Passes the result of a process on. Fails with a message that names the program if it could not be started.
    fn ended<T>(&self, command: &StageCommand, ended: io::Result<T>) -> Result<T, Failure> {
        ended.map_err(|e| {
            Failure::new(format!(
                "cannot run {}: {e}; build the programs with cargo build --release",
                as_command(&command.program)
            ))
        })
    }

    /// Prints a line on standard error or to the log file; a closed pipe is not an error.
    fn print(&self, line: &str) {
        let _ = match &self.messages {
            Messages::Shown => writeln!(io::stderr(), "{line}"),
            Messages::Kept(file) => writeln!(&*file, "{line}"),
            Messages::Quiet => Ok(()),
        };
    }

    /// Prints a warning or an error, also if the messages are quiet.
    fn complain(&self, line: &str) {
        match &self.messages {
            Messages::Quiet => {
                let _ = writeln!(io::stderr(), "{line}");
            }
            Messages::Shown | Messages::Kept(_) => self.print(line),
        }
    }

    /// Prints a line on standard output, or to the log file if the messages are kept there.
    fn say(&self, line: &str) {
        match &self.messages {
            Messages::Shown | Messages::Quiet => say(line),
            Messages::Kept(_) => self.print(line),
        }
    }
}

/// Runs a process to its end, and returns its status. The process is ended if this program ends.
fn ended(process: &mut Process) -> io::Result<ExitStatus> {
    Running::start(process)?.wait()
}

/// Runs a process to its end, and returns its status and standard error. The process is ended if this program ends.
fn heard(process: &mut Process) -> io::Result<(ExitStatus, Vec<u8>)> {
    let mut running = Running::start(process)?;
    let mut message = Vec::new();
    if let Some(mut stderr) = running.stderr() {
        stderr.read_to_end(&mut message)?;
    }
    Ok((running.wait()?, message))
}

/// Returns the exit code of a process; [`KILLED`] if a signal ended it, or if its code is not from 0 to 255.
fn code(status: ExitStatus) -> u8 {
    status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(KILLED)
}

/// Runs a stage of a pipeline while its directory is locked. The commands whose flags come from settings of the user
/// are tried first, so that mistakes in settings are found early; if one is refused, the run ends with exit code 2.
///
/// # Errors
/// Fails if an input is missing, if the directory belongs to another run or is in use, or if a command cannot be run.
pub fn run<'a>(
    place: &Installation,
    scope: Scope<'a>,
    stage: &str,
    messages: Messages,
) -> Result<Ended<'a>, Failure> {
    let text = |name: &str| scope.text(name).map_err(Failure::new);
    let [recipe, surface, tif] = [text("recipe")?, text("surface")?, text("tif")?]
        .map(|path| if path.is_empty() { None } else { Some(PathBuf::from(path)) });
    let is_own = text("own")? == "yes";
    let claim = Claim {
        out: text("out")?.into(),
        pipeline: text("pipeline")?,
        fixture: recipe.filter(|_| !is_own),
        surface: surface.filter(|_| is_own),
        tif: tif.filter(|_| is_own),
        machine: text("machine")?.into(),
        named: Named::all(&scope)?,
    };
    let programs = Programs::new(place, messages)?;
    let assumed_machine = assumed_machine(&scope)?;
    let mut walk = Walk::new(scope, stage).map_err(Failure::new)?;
    let mut rehearsed = Rehearsal::new(&walk.scope)?;
    if !rehearsed.before_the_run(&programs, &walk)? {
        return Ok(Ended { code: 2, scope: walk.scope });
    }
    let (_lock, assumed) = claim.take(&as_typed())?;
    if walk.scope.text("bound").is_ok_and(|bound| bound != "yes") {
        // It is of the plan of an earlier run.
        forget(&claim.out.join("any-path/bound"))?;
    }
    for text in assumed.iter().chain(&assumed_machine) {
        programs.complain(&format!("warning: {text}"));
    }
    let mut count = Count::new(&walk)?;
    let mut last = 0;
    let mut took_s = BTreeMap::new();
    let mut has_report = false;
    loop {
        let ahead = walk.clone();
        let Some(step) = walk.step().map_err(Failure::new)? else { break };
        if !rehearsed.before(&step, &programs, ahead)? {
            last = 2;
            break;
        }
        let program = match &step {
            Step::Run(command) => command.program.clone(),
            Step::Say(_) => String::new(),
        };
        if !program.is_empty() {
            count.next(&programs);
        }
        if let Some(estimate) = estimate_of_rounds(&program, &took_s) {
            programs.print(&estimate);
        }
        let is_first_report = !has_report && is_report(&step);
        let begun = Instant::now();
        last = take_step(&programs, &mut walk, step)?;
        took_s.insert(program, begun.elapsed().as_secs_f64());
        if last != 0 {
            break;
        }
        if is_first_report {
            state_recommended(&programs, &mut walk.scope)?;
            has_report = true;
        }
    }
    if last < 2
        && let Some(text) = assumed_machine
    {
        programs.complain(&format!("warning: {text}"));
    }
    Ok(Ended { code: last, scope: walk.scope })
}

/// Environment variable of a caller that wants a line with the number of every command, such as the Python module.
const PROGRESS: &str = "PLANISH_PROGRESS";

/// Number of the commands of a run, for a caller that wants it.
struct Count {
    done: usize,
    /// Number of commands to run, as far as is known before the run; `None` if nobody wants it.
    total: Option<usize>,
}

impl Count {
    fn new(walk: &Walk) -> Result<Self, Failure> {
        if env::var_os(PROGRESS).is_none() {
            return Ok(Self { done: 0, total: None });
        }
        let mut ahead = walk.clone();
        let mut total = 0;
        while let Some(step) = ahead.step().map_err(Failure::new)? {
            total += usize::from(matches!(step, Step::Run(_)));
        }
        Ok(Self { done: 0, total: Some(total) })
    }

    /// Counts a command that begins, and prints its number.
    fn next(&mut self, programs: &Programs) {
        self.done += 1;
        if let Some(total) = self.total {
            programs.print(&format!("progress: {} of {}", self.done, total.max(self.done)));
        }
    }
}

/// Returns true if the step is the command that makes the report of the run.
fn is_report(step: &Step) -> bool {
    match step {
        Step::Run(command) => {
            command.program == "planish-compare"
                && command.arguments.first().is_some_and(|word| word == "report")
        }
        Step::Say(_) => false,
    }
}

/// Executes a step of a pipeline, a command or a line to print. Returns 0 if the run goes on, 1 for a negative verdict
/// that ends it, and 2 for a command that refused or broke.
fn take_step(programs: &Programs, walk: &mut Walk, step: Step) -> Result<u8, Failure> {
    Ok(match step {
        Step::Run(command) => match &command.refusal_dir {
            Some(dir) => attempt(programs, walk, Path::new(dir), &command)?,
            None => match (programs.run(&command)?, command.may_be_negative) {
                (0, _) | (1, true) => 0,
                (1, false) => 1,
                _ => 2,
            },
        },
        Step::Say(line) => {
            programs.say(&line);
            0
        }
    })
}

/// Returns the command line of this process, quoted as for a shell.
pub fn as_typed() -> String {
    words::join(env::args_os().map(|word| word.to_string_lossy().into_owned()))
}

/// Usual smallest and largest number of rounds after which `planish refine` ends. Larger or smaller: longer or shorter
/// estimates. Measured on the fixtures; the largest is the limit of that program.
const ROUNDS: [f64; 2] = [10.0, 50.0];

/// Smallest duration of `planish refine`, s, that a run announces before it starts. Smaller: notes on runs that nobody
/// waits for. Chosen.
const TOLD_FROM_S: f64 = 60.0;

/// Returns a note on the duration of `planish refine`, the closed loop of dwell, schedule and simulate. `took_s` holds
/// the seconds that each program took once. Returns `None` for another program, and for a short loop.
fn estimate_of_rounds(program: &str, took_s: &BTreeMap<String, f64>) -> Option<String> {
    if program != "planish-refine" {
        return None;
    }
    let repeated = ["planish-dwell", "planish-schedule", "planish-simulate"];
    let round_s: f64 = repeated.iter().filter_map(|name| took_s.get(*name)).sum();
    let [least_s, most_s] = ROUNDS.map(|rounds| rounds * round_s);
    if least_s < TOLD_FROM_S {
        return None;
    }
    Some(format!(
        "note: the closed loop repeats dwell, schedule and simulate, which took {round_s:.0} s together, in {} to {} rounds: \
         expect {:.0} to {:.0} minutes; refine=no leaves it out",
        ROUNDS[0],
        ROUNDS[1],
        (least_s / 60.0).ceil(),
        (most_s / 60.0).ceil()
    ))
}

/// Returns the sentence that names the assumed machine, for a pipeline that plans for a part or a tool of the user.
/// Returns `None` if the user named a machine, or if part and tool are those of a fixture.
///
/// # Errors
/// Fails if the pipeline does not define these names.
pub fn assumed_machine(scope: &Scope) -> Result<Option<String>, Failure> {
    let [users, title] = ["users", "machine_title"].map(|name| scope.text(name));
    let is_assumed = !scope.is_given("machine") && users.map_err(Failure::new)? == "yes";
    let title = title.map_err(Failure::new)?;
    Ok(if is_assumed { Some(planish_types::assumed_machine(&title)) } else { None })
}

/// Trial of the commands to come, so that a mistake in a setting is found before the long stages. It takes place before
/// the run, and again when mirror, tool and tool path exist.
struct Rehearsal {
    /// Output directory of the run.
    out: String,
    /// Paths of the artifacts that the run has made so far.
    made: Vec<String>,
    /// True once the second trial, before the first long step, has begun; no further trial follows.
    is_over: bool,
}

impl Rehearsal {
    fn new(scope: &Scope) -> Result<Self, Failure> {
        let out = scope.text("out").map_err(Failure::new)?;
        Ok(Self { made: vec![format!("{out}/machine")], out, is_over: false })
    }

    /// Tries the commands before anything is made (see `all`). Returns false, and prints the reason, if one of them
    /// refuses.
    fn before_the_run(&self, programs: &Programs, walk: &Walk) -> Result<bool, Failure> {
        let mut ahead = walk.clone();
        // The copy in the directory of the run is made later.
        let machine = ahead.scope.words("machine", &Words::new()).map_err(Failure::new)?;
        ahead.scope.set("limits", machine);
        self.all(programs, ahead, &[])
    }

    /// Records the output of a short step. Before the first long step, tries the commands `ahead`, which begin with it.
    /// Returns false, and prints the reason, if one of them refuses.
    fn before(&mut self, step: &Step, programs: &Programs, ahead: Walk) -> Result<bool, Failure> {
        let Step::Run(command) = step else { return Ok(true) };
        if self.is_over {
            return Ok(true);
        }
        if SHORT.contains(&command.program.as_str()) {
            let flag = command.arguments.iter().position(|word| word == "--out");
            self.made.extend(flag.and_then(|i| command.arguments.get(i + 1)).cloned());
            return Ok(true);
        }
        self.is_over = true;
        if let Some(refusal) = cannot_switch_tool(&ahead)? {
            programs.complain(&format!("error: {refusal}"));
            return Ok(false);
        }
        self.all(programs, ahead, &self.made)
    }

    /// Tries the commands of a pipeline whose flags come from settings that the user gave, or from a setting that holds
    /// flags. It skips commands that may refuse without an end of the run, and the programs in [`NOT_REHEARSED`].
    /// Returns false, and prints the reason, if one refuses. `made` are the paths in the run that exist already.
    fn all(&self, programs: &Programs, mut ahead: Walk, made: &[String]) -> Result<bool, Failure> {
        while let Some(step) = ahead.step().map_err(Failure::new)? {
            let Step::Run(command) = step else { continue };
            if command.refusal_dir.is_some() {
                continue;
            }
            let Origins { more_flags, settings, .. } = &command.origins;
            let depends =
                more_flags.is_some() || settings.iter().any(|name| ahead.scope.is_given(name));
            if !depends || NOT_REHEARSED.contains(&command.program.as_str()) {
                continue;
            }
            if let Some(refusal) = programs.rehearsal(&command, &self.out, made)? {
                programs.complain(&refusal);
                return Ok(false);
            }
        }
        Ok(true)
    }
}

/// Returns the reason why the program of a run cannot follow its tool path: the path lifts the tool, and the controller
/// cannot switch it. Returns `None` if the run writes no program, if its path does not exist or never lifts the tool,
/// or if the export settings switch the tool or leave it on.
fn cannot_switch_tool(walk: &Walk) -> Result<Option<String>, Failure> {
    let text = |name: &str| walk.scope.text(name).map_err(Failure::new);
    let export = text("export")?;
    let Some(kind) = ControllerKind::named(&export) else { return Ok(None) };
    let machine = Inputs::new().read_machine(Path::new(&text("machine")?))?;
    let words = walk.scope.words("export_settings", &Words::new()).map_err(Failure::new)?;
    let mut flags = words.iter().filter_map(|word| word.split('=').next());
    if machine.controller_for(kind).switches_tool
        || flags.any(|flag| flag == "--always-on" || flag == "--tool-output")
    {
        return Ok(None);
    }
    let path = text("tool_path")?;
    if !Path::new(&path).exists() {
        return Ok(None);
    }
    let path: ToolPath = Inputs::new().read("tool-path", Path::new(&path))?;
    let lifted = path.tool_on().iter().filter(|on| !**on).count();
    if lifted == 0 {
        return Ok(None);
    }
    Ok(Some(format!(
        "export={export}: the tool path lifts the tool on {lifted} of its {} segments, and a {export} program cannot switch \
         it. Give export_settings=--always-on (the tool then removes there too), export=csv, export=gcode, or export=pmac \
         with export_settings=\"--tool-output M\"",
        path.len()
    )))
}

/// Runs a command that may refuse; its messages go to a file in `dir`. If it refuses (exit code 2), the artifacts
/// [`LEFT_OUT`] of an earlier run in `dir` are removed, the stage ends, and the run goes on. Returns 0 then and for a
/// negative verdict, and 2 if the command broke.
fn attempt(
    programs: &Programs,
    walk: &mut Walk,
    dir: &Path,
    command: &StageCommand,
) -> Result<u8, Failure> {
    fs::create_dir_all(dir)?;
    let message = dir.join(MESSAGE);
    let code = programs.attempt(command, &message)?;
    if code == 2 {
        for made in LEFT_OUT {
            forget(&dir.join(made))?;
        }
        walk.leave();
        return Ok(0);
    }
    // Warnings, the reason of a negative verdict, or of a program that broke.
    let text = fs::read(&message)?;
    String::from_utf8_lossy(&text).lines().for_each(|line| programs.print(line));
    Ok(if code > 1 { 2 } else { 0 })
}

/// Sets the fact `recommended` of the pipeline to the plan that the report recommends. The fact stays empty if the run
/// writes no program, if the user named a plan, or if the report recommends none. It also stays empty, with a message,
/// if a command of the stage `export` refuses that plan; a program of all axes is not tried.
fn state_recommended(programs: &Programs, scope: &mut Scope) -> Result<(), Failure> {
    let text = |name: &str| scope.text(name).map_err(Failure::new);
    let export = text("export")?;
    if export.is_empty() || !text("named")?.is_empty() {
        return Ok(());
    }
    let Some(best) = read_answer(Path::new(&text("out")?))?.method else { return Ok(()) };
    let best = plan_of(&best).to_string();
    let is_tried = text("program")? == "best" && best != text("exported")?;
    let mut trial = scope.clone();
    trial.set("recommended", vec![best.clone()]);
    let commands = if is_tried { Walk::commands(trial, "export") } else { Ok(vec![]) };
    for command in commands.map_err(Failure::new)? {
        if let Some((_, refusal)) = programs.refusal(&command)? {
            let refusal = refusal.trim_start_matches("error: ");
            programs.print(&format!(
                "the plan marked as the best, {best}, is none for {export}: {refusal}"
            ));
            return Ok(());
        }
    }
    scope.set("recommended", vec![best]);
    Ok(())
}

/// Removes an artifact of an earlier run: its manifest and arrays, and the directory if it is then empty.
fn forget(artifact: &Path) -> Result<(), Failure> {
    let Ok(entries) = fs::read_dir(artifact) else { return Ok(()) };
    for path in entries.flatten().map(|entry| entry.path()) {
        let is_array = path.extension().is_some_and(|e| e == "npy");
        if is_array || path.file_name().is_some_and(|name| name == "manifest.json") {
            fs::remove_file(path)?;
        }
    }
    let _ = fs::remove_dir(artifact);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_closed_loop_is_told_beforehand() {
        let times = |dwell_s: f64| {
            let times =
                [("planish-dwell", dwell_s), ("planish-schedule", 1.0), ("planish-simulate", 2.0)];
            BTreeMap::from(times.map(|(name, s)| (name.to_string(), s)))
        };
        // 10 and 50 rounds of 93 s are 15.5 and 77.5 minutes.
        let told = estimate_of_rounds("planish-refine", &times(90.0)).unwrap();
        assert!(
            told.contains("93 s together") && told.contains("expect 16 to 78 minutes"),
            "{told}"
        );
        assert_eq!(estimate_of_rounds("planish-refine", &times(2.0)), None);
        assert_eq!(estimate_of_rounds("planish-joint", &times(90.0)), None);
    }
}
