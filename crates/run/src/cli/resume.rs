//! `planish resume`: plans the rest of a run that was interrupted.
//!
//! | directory | content |
//! |---|---|
//! | `log` | motion of the machine, where a log is given |
//! | `executed` | executed motion: up to the abort, the stop, and the tool that stays on |
//! | `removal`, `remaining` | its removal, and the map that is left |
//! | `same-path`, `new-path` | a run each for the map that is left: along the rest of the path, and along a new one |
//! | `resume.json` | the ways, their marks, and the recommended one |

use std::{
    fs,
    io::{Read, Seek},
    path::Path,
};

use clap::Args;
use planish_handoff::{
    Artifact, Failure, Inputs, OutputFile, Status, kind, read_regular, say, warn, words,
};
use planish_pipeline::definition::Definition;
use planish_run::owner::{Mirror, Owner};
use planish_types::{
    ControllerKind, Removal, Surface, Trajectory,
    outcome::{
        StageStatus,
        abort::{AbortOutcome, MarkOutcome, MarkedProgram, ResumeOutcome, WayOutcome},
        removal::RemovalOutcome,
    },
};

use super::{
    claim::{Claim, Named},
    execute::{Messages, Programs, as_typed, run},
    place::{Installation, directory_name, name_of},
    program::{plan_of, read_answer},
    several::{UserSettings, command, is_directory, log},
};

/// Largest residual RMS of a way that mends the part, over that of the undisturbed run. Larger: marks stay unnamed.
/// Smaller: the stop and the start, which no plan undoes, count as marks.
const MENDED: f64 = 1.05;

#[derive(Args)]
pub struct Resume {
    /// Settings: run=DIR, the interrupted run; one of abort_s=T, abort_line=N of its program, and log=FILE. A log is a
    /// trajectory artifact, or a file for planish import trace with its flags in trace="FLAGS". Further ones are
    /// tool_on_s=T (time for which the tool removed after the abort), plan=NAME, tif=DIR, new_path=no, pipeline (of the
    /// new path), out=DIR, and those of the pipelines
    #[arg(value_name = "NAME=VALUE", trailing_var_arg = true, allow_hyphen_values = true)]
    settings: Vec<String>,
}

/// The interrupted run: what was planned, and what is known of the abort.
struct Interrupted {
    run: String,
    /// Directory of the plan that was run: its trajectory and its removal.
    plan: String,
    /// Motion of the plan before it became a program: it knows its dwell points.
    motion: String,
    tif: String,
    machine: String,
    /// Pipeline of a new path; `None` if none is wanted.
    pipeline: Option<String>,
    abort_s: Option<String>,
    log: Option<String>,
    trace: Vec<String>,
    tool_on_s: String,
}

impl Interrupted {
    /// Takes the settings of the interrupted run out of `user`. Refuses missing ones, and settings that do not fit.
    fn take(user: &mut UserSettings) -> Result<Self, Failure> {
        if let Some(word) = user.words.first() {
            return Err(Failure::new(format!("'{word}' is no setting; give run=DIR abort_s=T")));
        }
        for name in ["surface", "fixture", "path_before", "aborted"] {
            if user.get(name).is_some() {
                return Err(Failure::new(format!("run=DIR has its {name}; leave {name} out")));
            }
        }
        let run = user.take_path("run").ok_or_else(|| {
            Failure::new("run is not given; give run=DIR, the directory of the interrupted run")
        })?;
        is_directory("run", &run)?;
        let owner: Owner = serde_json::from_slice(&read(&format!("{run}/run.json"))?)
            .map_err(|e| Failure::new(format!("{run}/run.json: cannot be read: {e}")))?;
        let mut abort_s = user.take("abort_s");
        let line = user.take("abort_line");
        let log = user.take_path("log");
        if [&abort_s, &line, &log].into_iter().flatten().count() != 1 {
            return Err(Failure::new(
                "give one of abort_s=T (time of the abort since the start of the motion), abort_line=N and log=FILE",
            ));
        }
        let mut plan = match user.take("plan") {
            Some(plan) => plan,
            None => read_answer(Path::new(&run))?.method.ok_or_else(|| {
                Failure::new(format!("the report of {run} recommends no plan; give plan=NAME"))
            })?,
        };
        if let Some(line) = &line {
            let controller = controller_of(&run)?;
            plan = format!("{}+{}", plan_of(&plan), controller.name());
            let program = format!("{run}/program.{}", controller.name());
            abort_s = Some(time_of(&program, line)?);
        }
        let motion = format!("{run}/methods/{}/trajectory", plan_of(&plan));
        if Path::new(&format!("{run}/methods/{}/on-axes", plan_of(&plan))).is_dir() {
            check_log_of_axes(log.as_deref())?;
        }
        let plan = format!("{run}/methods/{plan}");
        is_directory("plan", &format!("{plan}/trajectory"))?;
        is_directory("plan", &motion)?;
        let trace = user.take_or("trace", "");
        let trace =
            words::split(&trace).map_err(|e| Failure::new(format!("trace={trace}: {e}")))?;
        let tif = match user.take_path("tif") {
            Some(tif) => tif,
            None => tool_of(&run, &owner)?,
        };
        let machine = match user.take_path("machine") {
            Some(machine) => machine,
            None => machine_of(&run)?,
        };
        let of_run = if owner.pipeline == "rest" { "raster".into() } else { owner.pipeline };
        let pipeline = user.take_or("pipeline", &of_run);
        let pipeline = match user.take_or("new_path", "yes").as_str() {
            "yes" => Some(pipeline),
            "no" => None,
            other => return Err(Failure::new(format!("new_path is '{other}'; give yes or no"))),
        };
        let tool_on_s = user.take_or("tool_on_s", "0");
        Ok(Self { run, plan, motion, tif, machine, pipeline, abort_s, log, trace, tool_on_s })
    }

    /// Returns the paths of the inputs, each with the name of its setting, for the claim on the directory.
    fn named(&self) -> Vec<Named> {
        let mut named = Named::words("run", std::slice::from_ref(&self.run), true);
        named.extend(
            self.log.iter().flat_map(|log| Named::words("log", std::slice::from_ref(log), true)),
        );
        named.extend(Named::words("trace", &self.trace, false));
        named
    }
}

/// Checks the log of a machine with more axes than x and y. Its columns are axes, and the removal is that of the
/// contact point, so a file is refused. Without a log, warns that the motion is taken from the plan of x and y.
fn check_log_of_axes(log: Option<&str>) -> Result<(), Failure> {
    match log {
        Some(log) if !Path::new(log).is_dir() => Err(Failure::new(format!(
            "log={log}: the machine has more axes than x and y, and removes at the contact point; make its motion by \
             planish import trace --machine FILE and planish axes contact, and give log=DIR"
        ))),
        Some(_) => Ok(()),
        None => {
            warn(
                "the machine has more axes than x and y: the executed motion is taken from the plan of x and y, which \
                 the other axes may slow down; log=DIR with the motion of the contact point is exact",
            );
            Ok(())
        }
    }
}

/// Reads a file of the interrupted run.
fn read(path: &str) -> Result<Vec<u8>, Failure> {
    read_regular(Path::new(path)).map_err(|e| {
        Failure::new(format!("{path}: cannot be read: {e}; give run=DIR, the directory of a run"))
    })
}

/// Returns the controller of the program in a run.
fn controller_of(run: &str) -> Result<ControllerKind, Failure> {
    let mut all = ControllerKind::ALL.iter();
    let there = all.find(|kind| Path::new(run).join(format!("program.{}", kind.name())).is_file());
    there.copied().ok_or_else(|| {
        Failure::new(format!(
            "abort_line is a line of a program, and {run} has none; give abort_s=T"
        ))
    })
}

/// Returns the time of a line of a program, s: the middle of its segment. Says between which times the line runs.
fn time_of(program: &str, line: &str) -> Result<String, Failure> {
    let beside = format!("{program}.json");
    let marked: MarkedProgram = serde_json::from_slice(&read(&beside)?)
        .map_err(|e| Failure::new(format!("{beside}: cannot be read: {e}; export it again")))?;
    let times_s = line.parse().ok().and_then(|line| marked.times_s(line));
    let [begin_s, end_s] = times_s.ok_or_else(|| {
        let first = marked.marks.first().map_or(0, |mark| mark.line);
        Failure::new(format!(
            "abort_line is '{line}', and the motion of {program} begins at line {first}"
        ))
    })?;
    let middle_s = 0.5 * (begin_s + end_s);
    say(format!(
        "line {line} of {program} runs from {begin_s:.4} to {end_s:.4} s; the abort is taken to be at {middle_s:.4} s"
    ));
    Ok(middle_s.to_string())
}

/// Returns the tool of a run: the one that varies, else that of its fixture, of its import, or of its user.
fn tool_of(run: &str, owner: &Owner) -> Result<String, Failure> {
    let parts = ["tool", "fixture/tif", "import/tif", "line/tif"];
    let mut places: Vec<String> = parts.iter().map(|part| format!("{run}/{part}")).collect();
    if let Mirror::Measured { tif, .. } = &owner.mirror {
        places.push(tif.clone());
    }
    let there = places.into_iter().find(|place| Path::new(place).is_dir());
    there.ok_or_else(|| Failure::new(format!("{run} holds no tool; give tif=DIR")))
}

/// Returns the machine file in a run.
fn machine_of(run: &str) -> Result<String, Failure> {
    let folder = format!("{run}/machine");
    let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
    let mut files: Vec<String> =
        entries.map(|entry| entry.path().to_string_lossy().into_owned()).collect();
    files.sort();
    files
        .into_iter()
        .next()
        .ok_or_else(|| Failure::new(format!("{folder} holds no machine file; give machine=FILE")))
}

impl Resume {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Installation::find()?;
        let mut user = UserSettings::new(&self.settings)?;
        let interrupted = Interrupted::take(&mut user)?;
        let out = user.take_path("out").unwrap_or_else(|| {
            let run = std::path::absolute(&interrupted.run).unwrap_or_default();
            format!("out/resume/{}", directory_name(&name_of(&run)))
        });
        let same = place.definition("rest")?;
        let new = match &interrupted.pipeline {
            Some(name) => Some(place.definition_of_plans(name)?),
            None => None,
        };
        refuse_unknown(&user, &same, new.as_ref())?;
        let claim = Claim {
            out: out.clone().into(),
            pipeline: "resume".into(),
            fixture: None,
            surface: Some(format!("{}/surface", interrupted.run).into()),
            tif: Some(interrupted.tif.clone().into()),
            machine: interrupted.machine.clone().into(),
            named: interrupted.named(),
        };
        let (_lock, _) = claim.take(&as_typed())?;
        let rest = Rest { place: &place, user: &user, interrupted: &interrupted, out };
        rest.execute()?;
        let before = rest.before()?;
        let mut ways = vec![before.stop];
        let path = [
            format!("path_before={}/tool_path", interrupted.run),
            format!("aborted={}/executed", rest.out),
        ];
        ways.extend(rest.way("same-path", &same, &path, &before.undisturbed)?);
        if let Some(new) = &new {
            ways.extend(rest.way("new-path", new, &[], &before.undisturbed)?);
        }
        let outcome = recommend(before.executed, &before.plan, before.mark, ways);
        let file = Path::new(&rest.out).join("resume.json");
        let text = format!("{}\n", serde_json::to_string_pretty(&outcome)?);
        OutputFile::begin("out", &file, true, &Inputs::new())?.write(text.as_bytes())?;
        Ok(told(&outcome))
    }
}

/// Refuses a setting of the user that neither pipeline has.
fn refuse_unknown(
    user: &UserSettings,
    same: &Definition,
    new: Option<&Definition>,
) -> Result<(), Failure> {
    for word in &user.settings {
        let name = word.split('=').next().unwrap_or_default();
        if !has_setting(same, name) && !new.is_some_and(|new| has_setting(new, name)) {
            return Err(Failure::new(format!(
                "{name} is no setting of the pipelines of the rest; leave it out"
            )));
        }
    }
    Ok(())
}

/// Returns true if the pipeline has a setting of this name.
fn has_setting(definition: &Definition, name: &str) -> bool {
    definition.settings.iter().any(|setting| setting.name == name)
}

/// State of the part at the abort, beside the run without the abort.
struct Before {
    executed: AbortOutcome,
    plan: RemovalOutcome,
    mark: MarkOutcome,
    /// Residual of the run without the abort.
    undisturbed: Surface,
    /// The way of doing nothing more.
    stop: WayOutcome,
}

/// The rest of the interrupted run, in the directory of its plans.
struct Rest<'a> {
    place: &'a Installation,
    user: &'a UserSettings,
    interrupted: &'a Interrupted,
    out: String,
}

impl Rest<'_> {
    /// Runs a command. Exit codes 0 and 1 (a negative verdict) count as success; any other ends this process with code
    /// 2.
    fn go_on(&self, program: &str, flags: &[&str]) -> Result<(), Failure> {
        let programs = Programs::new(self.place, Messages::Shown)?;
        match programs.run(&command(program, flags))? {
            0 | 1 => Ok(()),
            _ => planish_handoff::exit(2),
        }
    }

    /// Writes the executed motion, its removal and the map that is left.
    fn execute(&self) -> Result<(), Failure> {
        let Interrupted { run, plan, motion, tif, machine, abort_s, log, trace, tool_on_s, .. } =
            self.interrupted;
        let [log_dir, executed, removal, remaining] =
            ["log", "executed", "removal", "remaining"].map(|part| format!("{}/{part}", self.out));
        let plan = format!("{plan}/trajectory");
        let abort = abort_s.as_ref().map(|time| format!("--abort-s={time}"));
        let tool = format!("--tool-stays-on-s={tool_on_s}");
        let mut flags = vec!["abort", "--machine", machine, &tool];
        flags.extend(abort.as_deref());
        match log {
            None => flags.extend(["--trajectory", &plan, "--planned", motion]),
            Some(log) if Path::new(log).is_dir() => {
                flags.extend(["--trajectory", log, "--planned", motion]);
            }
            Some(log) => {
                let own = ["trace", log, "--planned", &plan, "--out", &log_dir, "--force"];
                let more = trace.iter().map(String::as_str);
                let words: Vec<&str> = own.into_iter().chain(more).collect();
                self.go_on("planish-import", &words)?;
                flags.extend(["--trajectory", &log_dir, "--planned", motion]);
            }
        }
        flags.extend(["--out", &executed, "--force"]);
        self.go_on("planish-schedule", &flags)?;
        let map = format!("{run}/surface");
        let of = ["--trajectory", &executed, "--tif", tif, "--surface", &map];
        let to = ["--remaining-out", &remaining, "--out", &removal, "--force"];
        self.go_on("planish-simulate", &[&of[..], &to[..]].concat())
    }

    /// Reads what the executed motion did, beside the run without the abort.
    fn before(&self) -> Result<Before, Failure> {
        let planned = format!("{}/removal", self.interrupted.plan);
        let removal = format!("{}/removal", self.out);
        let mut inputs = Inputs::new();
        let undisturbed: Removal = inputs.read("planned", Path::new(&planned))?;
        let done: Removal = inputs.read("executed", Path::new(&removal))?;
        let at = format!("{}/executed", self.out);
        let manifest = inputs.read_manifest("motion", Path::new(&at), Trajectory::KIND)?;
        let executed = manifest.read_outcome(Path::new(&at), "run it again")?;
        let now = outcome_of(&removal)?;
        let stop = WayOutcome {
            name: "stop".into(),
            rms_nm: now.rms_nm,
            time_s: 0.0,
            mark: mark(done.residual(), undisturbed.residual(), true)?,
            plan: self.out.clone(),
            is_negative: false,
        };
        Ok(Before {
            executed,
            plan: outcome_of(&planned)?,
            mark: mark(done.residual(), undisturbed.residual(), false)?,
            undisturbed: undisturbed.residual().clone(),
            stop,
        })
    }

    /// Plans a way to finish the part by the pipeline `definition`, with these settings of its own. Returns `None`, and
    /// prints the reason, if the pipeline refuses.
    fn way(
        &self,
        name: &str,
        definition: &Definition,
        own: &[String],
        undisturbed: &Surface,
    ) -> Result<Option<WayOutcome>, Failure> {
        let out = format!("{}/{name}", self.out);
        let Interrupted { tif, machine, .. } = self.interrupted;
        let mut settings = self.user.settings.clone();
        settings.retain(|word| has_setting(definition, word.split('=').next().unwrap_or_default()));
        if self.user.get("frames").is_none() && has_setting(definition, "frames") {
            settings.push("frames=0".into());
        }
        settings.extend([
            format!("surface={}/remaining", self.out),
            format!("tif={tif}"),
            format!("machine={machine}"),
            format!("out={out}"),
        ]);
        settings.extend_from_slice(own);
        say(format!("{name}: planning in {out}"));
        let mut messages = log()?;
        let scope = self.place.scope(definition, &settings)?;
        let ended = run(self.place, scope, "run", Messages::Kept(messages.try_clone()?))?;
        let executed = ended.scope.text("executed").map_err(Failure::new)?;
        if ended.code > 1 {
            let mut text = String::new();
            messages.rewind()?;
            messages.read_to_string(&mut text)?;
            let reason = text.lines().rev().find_map(|line| line.strip_prefix("error: "));
            say(format!("{name} is not possible: {}", reason.unwrap_or("a stage broke")));
            return Ok(None);
        }
        if ended.code == 1 {
            warn(format!("{name}: a stage has a negative verdict, which {out}/report names"));
        }
        let plan = format!("{out}/methods/{executed}");
        let removal = format!("{plan}/removal");
        let residual: Removal = Inputs::new().read("removal", Path::new(&removal))?;
        let outcome = outcome_of(&removal)?;
        let dir = format!("{plan}/verdict");
        let verdict = Inputs::new().read_manifest("verdict", Path::new(&dir), &kind::VERDICT)?;
        Ok(Some(WayOutcome {
            name: name.into(),
            rms_nm: outcome.rms_nm,
            time_s: outcome.total_time_s,
            mark: mark(residual.residual(), undisturbed, true)?,
            plan,
            is_negative: verdict.end().status == Some(StageStatus::Negative),
        }))
    }
}

/// Reads the outcome of a prediction in the directory `removal`.
fn outcome_of(removal: &str) -> Result<RemovalOutcome, Failure> {
    let dir = Path::new(removal);
    let manifest = Inputs::new().read_manifest("removal", dir, Removal::KIND)?;
    Ok(manifest.read_outcome(dir, "make it again")?)
}

/// Returns the pixel where `residual` is deepest below `undisturbed`, both without their means if `is_level_free`.
///
/// # Errors
/// Refuses maps of other pixels.
fn mark(
    residual: &Surface,
    undisturbed: &Surface,
    is_level_free: bool,
) -> Result<MarkOutcome, Failure> {
    if residual.grid() != undisturbed.grid() {
        return Err(Failure::new(
            "the map of the rest has other pixels than that of the run; leave prepare out",
        ));
    }
    let mut level_nm = 0.0;
    if is_level_free {
        level_nm = undisturbed.statistics().mean - residual.statistics().mean;
    }
    let mut deepest = MarkOutcome { depth_nm: 0.0, place_mm: [0.0; 2] };
    let grid = residual.grid();
    for ((j, i), height_nm) in residual.height_nm().indexed_iter() {
        let depth_nm = undisturbed.height_nm()[[j, i]] - height_nm - level_nm;
        if depth_nm > deepest.depth_nm {
            let place_mm = [grid.x.coordinate_mm(i), grid.y.coordinate_mm(j)];
            deepest = MarkOutcome { depth_nm, place_mm };
        }
    }
    Ok(deepest)
}

/// Recommends a way: the shortest of those that mend the part, otherwise the one with the smallest residual. A way
/// that exceeds a limit of the machine counts only if all do.
fn recommend(
    executed: AbortOutcome,
    undisturbed: &RemovalOutcome,
    mark: MarkOutcome,
    ways: Vec<WayOutcome>,
) -> ResumeOutcome {
    let limit_nm = MENDED * undisturbed.rms_nm;
    let best = ways.iter().min_by(|a, b| {
        let [(a_is_worse, a_value), (b_is_worse, b_value)] = [a, b].map(|way| rank(way, limit_nm));
        a_is_worse.cmp(&b_is_worse).then(a_value.total_cmp(&b_value))
    });
    let best = best.expect("to stop is always a way");
    ResumeOutcome {
        executed,
        undisturbed_rms_nm: undisturbed.rms_nm,
        undisturbed_s: undisturbed.total_time_s,
        mark,
        recommended: best.name.clone(),
        is_mended: !best.is_negative && best.rms_nm <= limit_nm,
        ways,
    }
}

/// Returns the rank of a way, the smaller the better: limits exceeded, residual above `limit_nm`; then the residual of
/// a way that is above, and otherwise the time.
fn rank(way: &WayOutcome, limit_nm: f64) -> ([bool; 2], f64) {
    let is_above = way.rms_nm > limit_nm;
    ([way.is_negative, is_above], if is_above { way.rms_nm } else { way.time_s })
}

/// Prints the ways and the recommended one. Returns the status of the command: negative if a mark stays.
fn told(outcome: &ResumeOutcome) -> Status {
    let ResumeOutcome { executed, undisturbed_rms_nm, mark, ways, recommended, .. } = outcome;
    let [x, y] = executed.place_mm;
    say(format!(
        "\nexecuted: {:.2} of {:.2} s; the machine stands at ({x:.3}, {y:.3}) mm\nundisturbed run: \
         {undisturbed_rms_nm:.4} nm RMS\nmark of the abort: {}\n\n{:<12} {:>12} {:>10}  deepest below the undisturbed run",
        executed.executed_s,
        outcome.undisturbed_s,
        depth(mark, "beyond the whole plan"),
        "way",
        "residual nm",
        "time s",
    ));
    for way in ways {
        let verdict = if way.is_negative { "; exceeds a limit of the machine" } else { "" };
        let WayOutcome { name, rms_nm, time_s, .. } = way;
        say(format!("{name:<12} {rms_nm:>12.4} {time_s:>10.2}  {}{verdict}", depth(&way.mark, "")));
    }
    let best = ways.iter().find(|way| way.name == *recommended).expect("one of the ways");
    let part = match (best.name == "stop", outcome.is_mended) {
        (true, true) => "nothing is left to do",
        (true, false) => "no plan leaves less",
        (false, _) => "start at rest, tool off",
    };
    let ratio = best.rms_nm / undisturbed_rms_nm;
    say(format!("\nrecommended: {recommended} ({part}): {}", best.plan));
    if outcome.is_mended {
        return Status::Done;
    }
    Status::Negative(format!(
        "the recommended way leaves {:.4} nm RMS, {ratio:.3} times that of the undisturbed run; its deepest mark is {}",
        best.rms_nm,
        depth(&best.mark, "below the undisturbed run")
    ))
}

/// Returns depth and place of a mark in words; `below` says below what.
fn depth(mark: &MarkOutcome, below: &str) -> String {
    let MarkOutcome { depth_nm, place_mm: [x, y] } = mark;
    if *depth_nm < 5e-4 {
        return "none".into();
    }
    let below = if below.is_empty() { String::new() } else { format!(" {below}") };
    format!("{depth_nm:.3} nm{below} at ({x:.3}, {y:.3}) mm")
}
