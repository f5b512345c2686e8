//! `planish-run several`: a plan of several tools, tool by tool from coarse to fine.
//!
//! | directory | content |
//! |---|---|
//! | `surface` | map before the run |
//! | `paths/NAME`, `rack.json` | tool path of each tool, and the rack with these paths |
//! | `choice` | dwell times of the chosen tools, with the table of the subsets |
//! | `tools/NAME/map` | map before this tool |
//! | `tools/NAME/plan` | dwell times of this tool and of those after it, for this map |
//! | `tools/NAME/target` | removal that this tool is planned for, as a map |
//! | `tools/NAME/refined` or `joint` | its dwell times and motion |
//! | `tools/NAME/removal`, `verdict` | the removal as executed, and the verdict on the limits |
//! | `tools/NAME/program` | motion, removal and verdict of its program, read back |
//! | `after` | map after the last tool |
//! | `table.txt` | the table of the run |

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, OutputFile, Status,
    flags::OutputArgs,
    kind::{self, Kind},
    say, task, warn, words,
};
use planish_types::{
    Rack, RackEntry, Removal, Surface, ToolPath, assumed_machine,
    outcome::{
        plan::{PlanOutcome, SeveralReport},
        removal::RemovalOutcome,
        verdict::Verdict,
    },
};

use super::{
    claim::{Claim, with_limit_on_jerk},
    execute::{Messages, Programs, as_typed},
    place::{Installation, directory_name, name_of},
    several::{UserSettings, command, is_directory},
};

/// Name under which `planish run` knows this command beside the pipelines.
pub const NAME: &str = "several";

/// End of the messages about a missing setting.
const NEEDED: &str = "give surface=DIR rack=FILE";

/// Remedy for an artifact of this run that lacks a number.
const REMEDY: &str = "run it again";

#[derive(Args)]
pub struct Several {
    /// Settings: surface=DIR and rack=FILE (the map, and the tools of the lab), machine=FILE, prepare="--level piston",
    /// choose=yes or no, motion=refine or joint, export=CONTROLLER, export_settings, out=DIR
    #[arg(value_name = "NAME=VALUE", trailing_var_arg = true, allow_hyphen_values = true)]
    settings: Vec<String>,
}

impl Several {
    pub fn run(&self) -> Result<Status, Failure> {
        run(&self.settings)
    }
}

/// Settings of a run with several tools.
struct Settings {
    surface: String,
    rack: String,
    machine: String,
    is_assumed: bool,
    prepare: Vec<String>,
    chooses: bool,
    /// True if dwell times and motion of a tool are planned as one problem, by `planish-joint`.
    is_joint: bool,
    export: Option<String>,
    export_settings: Vec<String>,
    out: String,
}

/// A tool of the rack, with the paths of its files in the run.
struct RunTool {
    entry: RackEntry,
    tif: String,
    tool_path: String,
    /// Width at half of its peak, mm; the widest tool runs first.
    width_mm: f64,
    /// Copy of the file of its machine.
    machine: String,
}

/// A row of the table: one tool, as it will run.
struct Row {
    tool: String,
    /// Residual of the dwell times of this tool and those after it, RMS, nm.
    planned_rms_nm: f64,
    /// Residual after the executed motion of this tool, RMS, nm.
    executed_rms_nm: f64,
    time_s: f64,
    change_s: f64,
    limits_respected: bool,
}

/// A run: its settings, its programs, and the negative verdicts so far.
struct Course {
    settings: Settings,
    programs: Programs,
    negative: Vec<String>,
}

/// Runs a plan of several tools with these settings NAME=VALUE. Refuses settings that do not fit, and what the stages
/// refuse.
pub fn run(words: &[String]) -> Result<Status, Failure> {
    let place = Installation::find()?;
    let settings = Settings::take(words, &place)?;
    let rack = read_rack(&settings.rack)?;
    if settings.is_joint
        && let Some(tool) = rack.tools.iter().find(|tool| tool.min_dwell_s.is_some())
    {
        return Err(Failure::new(format!(
            "{}: tool {:?} has min_dwell_s, which motion=joint does not take; give min_dwell_s_per_mm",
            settings.rack, tool.name
        )));
    }
    let claim = Claim {
        out: settings.out.clone().into(),
        pipeline: NAME.into(),
        fixture: None,
        surface: Some(settings.surface.clone().into()),
        tif: Some(settings.rack.clone().into()),
        machine: settings.machine.clone().into(),
        named: Vec::new(),
    };
    let (_lock, assumed) = claim.take(&as_typed())?;
    assumed.iter().for_each(warn);
    let mut doubt = None;
    if settings.is_assumed {
        let machine = Inputs::new().read_machine(Path::new(&settings.machine))?;
        doubt = Some(assumed_machine(machine.name()));
    }
    doubt.iter().for_each(warn);
    let programs = Programs::new(&place, Messages::Shown)?;
    let mut course = Course { settings, programs, negative: Vec::new() };
    course.plan(rack)?;
    doubt.iter().for_each(warn);
    if course.negative.is_empty() {
        return Ok(Status::Done);
    }
    Ok(Status::Negative(course.negative.join("; ")))
}

impl Settings {
    /// Takes the settings out of the words of the command line. Refuses missing ones and unknown ones.
    fn take(words: &[String], place: &Installation) -> Result<Self, Failure> {
        let mut user = UserSettings::new(words)?;
        let mut needed = |name: &str| {
            let path = user.take_path(name);
            path.ok_or_else(|| Failure::new(format!("{name} is not given; {NEEDED}")))
        };
        let [surface, rack] = [needed("surface")?, needed("rack")?];
        is_directory("surface", &surface)?;
        let own_machine = user.take_path("machine");
        let is_assumed = own_machine.is_none();
        let machine = own_machine
            .unwrap_or_else(|| format!("{}fixtures/machines/ion-beam.json", place.repository()));
        let mut flags = |name: &str, default: &str| {
            let text = user.take_or(name, default);
            words::split(&text).map_err(|e| Failure::new(format!("{name}={text}: {e}")))
        };
        let [prepare, export_settings] =
            [flags("prepare", "--level piston")?, flags("export_settings", "")?];
        let chooses = match user.take_or("choose", "yes").as_str() {
            "yes" => true,
            "no" => false,
            other => return Err(Failure::new(format!("choose is '{other}'; give yes or no"))),
        };
        let is_joint = match user.take_or("motion", "refine").as_str() {
            "refine" => false,
            "joint" => true,
            other => {
                return Err(Failure::new(format!("motion is '{other}'; give refine or joint")));
            }
        };
        let export = user.take("export").filter(|controller| !controller.is_empty());
        let out = user.take_path("out").unwrap_or_else(|| {
            let map = std::path::absolute(&surface).unwrap_or_default();
            format!("out/{NAME}/{}", directory_name(&name_of(&map)))
        });
        if let Some(word) = user.settings.iter().chain(&user.words).next() {
            return Err(Failure::new(format!(
                "'{word}' is no setting of {NAME}; it has surface, rack, machine, prepare, choose, motion, \
                 export, export_settings and out"
            )));
        }
        let settings = Self {
            surface,
            rack,
            machine,
            is_assumed,
            prepare,
            chooses,
            is_joint,
            export,
            export_settings,
            out,
        };
        settings.checked()
    }

    /// Refuses a program for a machine that nobody named.
    fn checked(self) -> Result<Self, Failure> {
        match &self.export {
            Some(controller) if self.is_assumed => Err(Failure::new(format!(
                "export={controller} writes programs for the machine that will run them, and none is named; give \
                 machine=FILE with the limits of your machine (docs/formats.md)"
            ))),
            _ => Ok(self),
        }
    }
}

/// Reads the rack and makes its paths absolute. Refuses a tool that has neither a tool path nor a pitch, and a file
/// that cannot be read.
fn read_rack(path: &str) -> Result<Rack, Failure> {
    let path = Path::new(path);
    let mut rack: Rack = Inputs::new().read_json("rack", path)?;
    rack.check_names().map_err(|problem| Failure::new(format!("{}: {problem}", path.display())))?;
    let directory = std::path::absolute(path.parent().unwrap_or(Path::new("")).join("."))?;
    for tool in &mut rack.tools {
        if tool.tool_path.is_none() && tool.pitch_mm.is_none() {
            return Err(Failure::new(format!(
                "{}: tool {:?} has neither tool_path nor pitch_mm; give pitch_mm, the distance of its lines",
                path.display(),
                tool.name
            )));
        }
        tool.tif = directory.join(&tool.tif);
        tool.tool_path = tool.tool_path.as_ref().map(|own| directory.join(own));
        tool.machine = tool.machine.as_ref().map(|own| directory.join(own));
        // A missing file is found before anything is written.
        let mut inputs = Inputs::new();
        inputs.read_tool("tif", &tool.tif)?;
        if let Some(path) = &tool.tool_path {
            inputs.read::<ToolPath>("tool-path", path)?;
        }
        if let Some(machine) = &tool.machine {
            inputs.read_machine(machine)?;
        }
    }
    Ok(rack)
}

impl Course {
    /// Returns the path of `part` in the output directory.
    fn path(&self, part: &str) -> String {
        format!("{}/{part}", self.settings.out)
    }

    /// Runs a command. Exit code 1 is a negative verdict, which the end of the run states; any other but 0 ends this
    /// process with code 2.
    fn go_on(&mut self, program: &str, flags: &[&str]) -> Result<(), Failure> {
        match self.programs.run(&command(program, flags))? {
            0 => Ok(()),
            1 => {
                let out = flags.iter().skip_while(|flag| **flag != "--out").nth(1);
                self.negative.push(format!("{} ({program})", out.unwrap_or(&"")));
                Ok(())
            }
            _ => planish_handoff::exit(2),
        }
    }

    /// Plans with the tools of the rack: their paths, the choice, then tool by tool.
    fn plan(&mut self, rack: Rack) -> Result<(), Failure> {
        let map = self.path("surface");
        let given = self.settings.surface.clone();
        let prepare = self.settings.prepare.clone();
        let mut flags = vec!["prepare", "--surface", &given];
        flags.extend(prepare.iter().map(String::as_str));
        flags.extend(["--out", &map, "--force"]);
        self.go_on("planish-surface", &flags)?;
        let mut tools = Vec::new();
        for entry in rack.tools {
            tools.push(self.tool(entry, &map)?);
        }
        let mut chosen = self.choose(tools, &map)?;
        chosen.sort_by(|a, b| b.width_mm.total_cmp(&a.width_mm));
        // Nobody shall run the program of a tool that an earlier run had chosen.
        let earlier = self.path("tools");
        if Path::new(&earlier).exists() {
            fs::remove_dir_all(&earlier)?;
        }
        let mut rows = Vec::new();
        let mut before = map.clone();
        while !chosen.is_empty() {
            let (row, after) = self.run_tool(&chosen, &before)?;
            rows.push(row);
            before = after;
            chosen.remove(0);
        }
        self.tell(&map, &rows)
    }

    /// Prepares a tool: copies the file of its machine, and makes its tool path unless the rack has one.
    fn tool(&mut self, mut entry: RackEntry, map: &str) -> Result<RunTool, Failure> {
        let tif = entry.tif.display().to_string();
        let width_mm = Inputs::new().read_tool("tif", &entry.tif)?.half_maximum_width_mm();
        let name = entry.name.clone();
        let machine = match entry.machine.take() {
            Some(file) => {
                Inputs::new().read_machine(&file)?;
                let copy = PathBuf::from(self.path(&format!("machine/{name}.json")));
                let (text, assumed) = with_limit_on_jerk(&file, &copy)?;
                assumed.iter().for_each(warn);
                OutputFile::begin("out", &copy, true, &Inputs::new())?.write(&text)?;
                copy.display().to_string()
            }
            None => {
                let file = Path::new(&self.settings.machine).file_name().unwrap_or_default();
                self.path(&format!("machine/{}", file.to_string_lossy()))
            }
        };
        let tool_path = match &entry.tool_path {
            Some(own) => own.display().to_string(),
            None => {
                let out = self.path(&format!("paths/{name}"));
                self.raster(&entry, &tif, &machine, map, &out)?;
                out
            }
        };
        let entry = RackEntry {
            tool_path: Some(std::path::absolute(&tool_path)?),
            pitch_mm: None,
            overscan_mm: None,
            ..entry
        };
        Ok(RunTool { entry, tif, tool_path, width_mm, machine })
    }

    /// Makes the raster of a tool over the map, in the directory `out`.
    fn raster(
        &mut self,
        entry: &RackEntry,
        tif: &str,
        machine: &str,
        map: &str,
        out: &str,
    ) -> Result<(), Failure> {
        let pitch = entry.pitch_mm.map(|pitch| pitch.to_string()).unwrap_or_default();
        let [lines, step] = [format!("--pitch-mm={pitch}"), format!("--step-mm={pitch}")];
        let overscan = entry.overscan_mm.map(|mm| format!("--overscan-mm={mm}"));
        let mut flags = vec!["raster", "--surface", map, "--tif", tif, &lines, &step];
        flags.extend(overscan.as_deref());
        flags.extend(["--machine", machine, "--out", out, "--force"]);
        self.go_on("planish-toolpath", &flags)
    }

    /// Writes a rack of these tools as the file `part` of the run, and returns its path. With `floors`, a tool whose
    /// entry states no least dwell time has that of its machine, which no motion can undercut.
    fn write_rack(&self, part: &str, tools: &[RunTool], floors: bool) -> Result<String, Failure> {
        let mut entries = Vec::new();
        for tool in tools {
            let mut entry = tool.entry.clone();
            if floors && !has_floor(&entry) {
                let machine = Inputs::new().read_machine(Path::new(&tool.machine))?;
                let axes = machine.limits().axes().iter();
                let fastest = axes.map(|axis| axis.max_velocity_mm_per_s()).fold(0.0, f64::max);
                entry.min_dwell_s_per_mm = Some(1.0 / fastest);
            }
            entries.push(entry);
        }
        let path = self.path(part);
        let text = serde_json::to_string_pretty(&Rack { tools: entries })? + "\n";
        if let Some(folder) = Path::new(&path).parent() {
            fs::create_dir_all(folder)?;
        }
        OutputFile::begin("out", Path::new(&path), true, &Inputs::new())?.write(text.as_bytes())?;
        Ok(path)
    }

    /// Returns the tools of the best subset, or all of them if the user wants no choice.
    fn choose(&mut self, tools: Vec<RunTool>, map: &str) -> Result<Vec<RunTool>, Failure> {
        let rack = self.write_rack("rack.json", &tools, false)?;
        if !self.settings.chooses {
            return Ok(tools);
        }
        let out = self.path("choice");
        let flags = ["choose-tools", "--surface", map, "--rack", &rack, "--out", &out, "--force"];
        self.go_on("planish-dwell", &flags)?;
        let is_chosen = |tool: &RunTool| Path::new(&out).join(&tool.entry.name).exists();
        Ok(tools.into_iter().filter(is_chosen).collect())
    }

    /// Plans and judges the first of `tools` for the map `before`, with the dwell times of all of them. Returns its
    /// row, and the map after it.
    fn run_tool(&mut self, tools: &[RunTool], before: &str) -> Result<(Row, String), Failure> {
        let (tool, later) = tools.split_first().expect("a tool is left");
        let RackEntry { name, change_s, time_weight_nm2_per_s, .. } = &tool.entry;
        let at = self.path(&format!("tools/{name}"));
        let rack = self.write_rack(&format!("tools/{name}/rack.json"), tools, true)?;
        let plan = format!("{at}/plan");
        let flags =
            ["several-tools", "--surface", before, "--rack", &rack, "--out", &plan, "--force"];
        self.go_on("planish-dwell", &flags)?;
        // What the later tools will remove is not for this one
        let mut target = before.to_string();
        for other in later {
            target = self.without(other, &target, &plan, &at)?;
        }
        let dwell = format!("{plan}/{name}");
        let mirror = ["--surface", &target, "--tif", &tool.tif, "--tool-path", &tool.tool_path];
        let price = format!("--time-weight-nm2-per-s={time_weight_nm2_per_s}");
        let floor = floor_flag(&tool.entry, &tool.machine);
        let own = ["--machine", &tool.machine, &price];
        let motion = format!("{at}/{}", if self.settings.is_joint { "joint" } else { "refined" });
        let to = ["--out", &motion, "--force"];
        if self.settings.is_joint {
            // Its motion has the limits of the machine, so it needs no floor of theirs
            let floor: &[&str] = if has_floor(&tool.entry) { &[&floor] } else { &[] };
            self.go_on("planish-joint", &[&mirror[..], &own, floor, &to].concat())?;
        } else {
            let from = ["--dwell", &dwell, &floor];
            self.go_on("planish-refine", &[&mirror[..], &own, &from, &to].concat())?;
        }
        let trajectory = format!("{motion}/trajectory");
        self.judge(tool, &trajectory, before, &at)?;
        let mut executed = at.clone();
        if let Some(controller) = self.settings.export.clone() {
            executed = self.program(tool, &controller, &trajectory, before)?;
        }
        let after = if later.is_empty() {
            self.path("after")
        } else {
            self.path(&format!("tools/{}/map", later[0].entry.name))
        };
        write_residual(&format!("{executed}/removal"), &after)?;
        let planned: PlanOutcome<SeveralReport> = outcome(&dwell, &kind::DWELL)?;
        let removal: RemovalOutcome = outcome(&format!("{executed}/removal"), &kind::REMOVAL)?;
        let judged: Verdict = outcome(&format!("{executed}/verdict"), &kind::VERDICT)?;
        let row = Row {
            tool: name.clone(),
            planned_rms_nm: planned.report.map_or(f64::NAN, |report| report.model_rms_nm),
            executed_rms_nm: removal.rms_nm,
            time_s: removal.total_time_s,
            change_s: *change_s,
            limits_respected: judged.limits_respected,
        };
        Ok((row, after))
    }

    /// Returns the map `target` without what the dwell times of `other` in `plan` remove. The work goes to `at`.
    fn without(
        &mut self,
        other: &RunTool,
        target: &str,
        plan: &str,
        at: &str,
    ) -> Result<String, Failure> {
        let name = &other.entry.name;
        let dwell = format!("{plan}/{name}");
        let [stays, share, rest] =
            ["stays", "share", "target"].map(|part| format!("{at}/without/{name}/{part}"));
        let flags = ["position", "--tool-path", &other.tool_path, "--dwell", &dwell, "--machine"];
        let own = [other.machine.as_str(), "--out", &stays, "--force"];
        self.quiet("planish-schedule", &[&flags[..], &own].concat())?;
        let flags = ["--trajectory", &stays, "--tif", &other.tif, "--surface", target];
        self.quiet("planish-simulate", &[&flags[..], &["--out", &share, "--force"]].concat())?;
        write_residual(&share, &rest)?;
        Ok(rest)
    }

    /// Runs a command on a motion that nobody executes: a negative verdict on it does not count.
    fn quiet(&self, program: &str, flags: &[&str]) -> Result<(), Failure> {
        match self.programs.run(&command(program, flags))? {
            0 | 1 => Ok(()),
            _ => planish_handoff::exit(2),
        }
    }

    /// Simulates a motion of a tool on the map `before`, and proves its limits. Both results go to `at`.
    fn judge(
        &mut self,
        tool: &RunTool,
        trajectory: &str,
        before: &str,
        at: &str,
    ) -> Result<(), Failure> {
        let [removal, verdict] = ["removal", "verdict"].map(|part| format!("{at}/{part}"));
        let flags = ["--trajectory", trajectory, "--tif", &tool.tif, "--surface", before];
        self.go_on("planish-simulate", &[&flags[..], &["--out", &removal, "--force"]].concat())?;
        let flags = ["--trajectory", trajectory, "--machine", &tool.machine, "--tool-path"];
        let own = [tool.tool_path.as_str(), "--out", &verdict, "--force"];
        self.go_on("planish-verify", &[&flags[..], &own].concat())
    }

    /// Writes the program of the motion of a tool, reads it back and judges it on the map `before`. Returns the
    /// directory of the results.
    fn program(
        &mut self,
        tool: &RunTool,
        controller: &str,
        trajectory: &str,
        before: &str,
    ) -> Result<String, Failure> {
        let at = self.path(&format!("tools/{}", tool.entry.name));
        let file = format!("{at}/program.{controller}");
        let about = format!("{file}.json");
        let read_back = format!("{at}/program");
        let back = format!("{read_back}/trajectory");
        let more = self.settings.export_settings.clone();
        let mut flags = vec![controller, "--trajectory", trajectory, "--machine", &tool.machine];
        flags.extend(["--tool-path", &tool.tool_path]);
        flags.extend(more.iter().map(String::as_str));
        flags.extend(["--out", &file, "--force"]);
        self.go_on("planish-export", &flags)?;
        let flags = ["program", &file, "--controller", controller, "--about", &about];
        self.go_on("planish-import", &[&flags[..], &["--out", &back, "--force"]].concat())?;
        self.judge(tool, &back, before, &read_back)?;
        Ok(read_back)
    }

    /// Prints the table of the run, and writes it to `table.txt`.
    fn tell(&self, map: &str, rows: &[Row]) -> Result<(), Failure> {
        let before: Surface = Inputs::new().read("surface", Path::new(map))?;
        let mut lines = vec![format!(
            "{:<24} {:>14} {:>14} {:>10} {:>10}  limits",
            "after", "planned RMS nm", "executed RMS nm", "time s", "change s"
        )];
        lines.push(format!("{:<24} {:>14} {:>15.4}", "(map before)", "", before.statistics().rms));
        for row in rows {
            lines.push(format!(
                "{:<24} {:>14.4} {:>15.4} {:>10.2} {:>10.2}  {}",
                row.tool,
                row.planned_rms_nm,
                row.executed_rms_nm,
                row.time_s,
                row.change_s,
                if row.limits_respected { "kept" } else { "not kept" }
            ));
        }
        let time_s: f64 = rows.iter().map(|row| row.time_s).sum();
        let change_s: f64 = rows.iter().map(|row| row.change_s).sum();
        lines.push(format!(
            "{} tools, {:.2} s with changes; map after the last one: {}",
            rows.len(),
            time_s + change_s,
            self.path("after")
        ));
        let text = lines.join("\n");
        let path = self.path("table.txt");
        OutputFile::begin("out", Path::new(&path), true, &Inputs::new())?
            .write(format!("{text}\n").as_bytes())?;
        say(format!("\n{text}"));
        Ok(())
    }
}

/// Returns true if the rack states a least dwell time of the tool.
fn has_floor(entry: &RackEntry) -> bool {
    entry.min_dwell_s.is_some() || entry.min_dwell_s_per_mm.is_some()
}

/// Returns the flag of the least dwell time of a tool: that of its entry, or that of its machine.
fn floor_flag(entry: &RackEntry, machine: &str) -> String {
    match (entry.min_dwell_s, entry.min_dwell_s_per_mm) {
        (Some(floor_s), _) => format!("--min-dwell-s={floor_s}"),
        (None, Some(floor)) => format!("--min-dwell-s-per-mm={floor}"),
        (None, None) => format!("--min-dwell-of-machine={machine}"),
    }
}

/// Writes the residual of a removal as a map.
fn write_residual(removal: &str, out: &str) -> Result<(), Failure> {
    let mut inputs = Inputs::new();
    let from: Removal = inputs.read("removal", Path::new(removal))?;
    let args = OutputArgs { out: out.into(), force: true, wall_time: None };
    let task = task!("residual", serde_json::json!({}));
    match Output::directory(&args, Surface::KIND).begin(&task, &inputs)? {
        Begin::Unchanged(_) => Ok(()),
        Begin::Run(mut output) => {
            Ok(output.write(from.residual(), serde_json::json!({}), &Status::Done)?)
        }
    }
}

/// Returns the outcome of the artifact `dir` of this kind.
fn outcome<O: serde::de::DeserializeOwned>(dir: &str, kind: &Kind) -> Result<O, Failure> {
    let dir = Path::new(dir);
    let manifest = Inputs::new().read_manifest(kind.name, dir, kind)?;
    Ok(manifest.read_outcome(dir, REMEDY)?)
}
