//! `planish several`: a plan of several tools, tool by tool from coarse to fine.
//!
//! | directory | content |
//! |---|---|
//! | `import/surface` | map of the file of an instrument |
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
//! | `several.json` | tools and settings, from which `next-run` goes on after a measured map |
//! | `others/TOOLS` | with compare=yes: the same with these tools of the rack |
//! | `others/prices=FACTOR` | with price_factors: the same with the prices of the rack times this factor |
//! | `report` | the page of the run |

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, OutputFile, Status, as_command,
    flags::OutputArgs,
    kind::{self, Kind},
    say, task, warn, words,
};
use planish_types::{
    Rack, RackEntry, Removal, Surface, assumed_machine,
    outcome::{
        plan::{PlanOutcome, SeveralReport, ToolShare},
        removal::RemovalOutcome,
        verdict::Verdict,
    },
};

use super::{
    claim::{Claim, Named, with_limit_on_jerk},
    execute::{Messages, Programs, as_typed},
    place::{Installation, directory_name, kind_of, name_of},
    rack::{CheckedRack, refuse_other_axes},
    record::Record,
    several::{UserSettings, command},
    several_page::{PageOfRun, PageSettings},
};

/// Name under which `planish run` knows this command beside the pipelines.
pub const NAME: &str = "several";

/// Settings of a run with one tool that several tools do not take, and what to do instead.
const NOT_OF_SEVERAL: [(&str, &str); 8] = [
    (
        "specification",
        "it plans heights; judge its map with planish surface spec --surface OUT/after",
    ),
    ("form", "its part is flat; plan a curved part with planish run raster, tool by tool"),
    ("kinematics", "its machines have the axes x and y; plan others with planish run raster"),
    ("varying", "give the directory of the tool that varies as tif of the rack"),
    (
        "error_budget",
        "give setup_shift_mm, setup_rate_fraction and measured_after of the tools in the rack",
    ),
    ("residual_slope_weight_mm2", "it plans heights; planish dwell several-tools weighs slopes"),
    ("tif", "give the TIF of every tool in the rack"),
    ("pitch_mm", "give the pitch of every tool in the rack"),
];

/// End of the messages about a missing setting.
const NEEDED: &str = "give surface=DIR rack=FILE";

/// Remedy for an artifact of this run that lacks a number.
const REMEDY: &str = "run it again";

#[derive(Args)]
pub struct Several {
    /// Settings: surface=DIR and rack=FILE (the map, and the tools of the lab), machine=FILE, prepare="--level piston",
    /// choose=yes or no, motion=refine or joint. To compare: compare=yes (each tool alone, and each subset of the rack
    /// that may cost less as executed), price_factors=0.3,3 (the plan at these multiples of the prices). For programs:
    /// export=CONTROLLER, export_settings. For the page: part_name, part_number, date, operator, out=DIR. For a file of
    /// an instrument: surface=FILE and surface_settings (flags of planish import)
    #[arg(value_name = "NAME=VALUE", trailing_var_arg = true, allow_hyphen_values = true)]
    settings: Vec<String>,
}

impl Several {
    pub fn run(&self) -> Result<Status, Failure> {
        run(&self.settings)
    }
}

/// Settings of a run with several tools.
pub struct Settings {
    /// Directory of the map before the run, or the file of an instrument.
    pub surface: String,
    /// Flags of planish import for the file of an instrument.
    pub surface_settings: Vec<String>,
    /// File of the rack, or the record of the run that this one goes on with.
    pub rack: String,
    pub machine: String,
    pub is_assumed: bool,
    pub prepare: Vec<String>,
    pub chooses: bool,
    /// True if dwell times and motion of a tool are planned as one problem, by `planish joint`.
    pub is_joint: bool,
    pub export: Option<String>,
    pub export_settings: Vec<String>,
    /// Settings of the page.
    pub page: PageSettings,
    /// Residual that the plan shall keep, RMS, nm; `None` if the prices of the rack decide.
    pub keep_rms_nm: Option<f64>,
    pub out: String,
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
    /// True if the rack has a machine for it; otherwise it has that of the run.
    has_machine: bool,
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
    /// Sentences on the reserve of the later tools, the set-up errors that no map shows, and the part of the map beyond
    /// the path of this tool.
    remarks: Vec<String>,
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
    let rack = CheckedRack::read(&settings.rack)?;
    settings.run(&place, rack, NAME)
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
        if !Path::new(&surface).exists() {
            return Err(Failure::new(format!(
                "surface {surface} is not there; give the directory of a map, or the file of an instrument"
            )));
        }
        let own_machine = user.take_path("machine");
        let is_assumed = own_machine.is_none();
        let machine = own_machine
            .unwrap_or_else(|| format!("{}fixtures/machines/ion-beam.json", place.repository()));
        let mut flags = |name: &str, default: &str| {
            let text = user.take_or(name, default);
            words::split(&text).map_err(|e| Failure::new(format!("{name}={text}: {e}")))
        };
        let [prepare, export_settings, surface_settings] = [
            flags("prepare", "--level piston")?,
            flags("export_settings", "")?,
            flags("surface_settings", "")?,
        ];
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
        let page = PageSettings::take(&mut user)?;
        let export = user.take("export").filter(|controller| !controller.is_empty());
        let out = user.take_path("out").unwrap_or_else(|| {
            let map = std::path::absolute(&surface).unwrap_or_default();
            format!("out/{NAME}/{}", directory_name(&name_of(&map)))
        });
        for (name, instead) in NOT_OF_SEVERAL {
            if user.get(name).is_some() {
                return Err(Failure::new(format!("{NAME} takes no {name}: {instead}")));
            }
        }
        if let Some(word) = user.settings.iter().chain(&user.words).next() {
            return Err(Failure::new(format!(
                "'{word}' is no setting of {NAME}; it has surface, surface_settings, rack, machine, prepare, choose, \
                 motion, compare, price_factors, export, export_settings, part_name, part_number, date, operator and out"
            )));
        }
        let settings = Self {
            surface,
            surface_settings,
            rack,
            machine,
            is_assumed,
            prepare,
            chooses,
            is_joint,
            export,
            export_settings,
            page,
            keep_rms_nm: None,
            out,
        };
        settings.checked()
    }

    /// Runs a plan with the tools of a rack, in the directory that belongs to this run alone.
    ///
    /// # Errors
    /// Refuses what does not fit together, and a directory of another run.
    pub fn run(
        self,
        place: &Installation,
        rack: CheckedRack,
        pipeline: &str,
    ) -> Result<Status, Failure> {
        if self.is_joint
            && let Some(tool) = rack.rack.tools.iter().find(|tool| tool.min_dwell_s.is_some())
        {
            return Err(Failure::new(format!(
                "{}: tool {:?} has min_dwell_s, which motion=joint does not take; give min_dwell_s_per_mm",
                self.rack, tool.name
            )));
        }
        refuse_other_axes(Path::new(&self.machine))?;
        // The map of a file of an instrument is known after its import.
        let is_map = kind_of(&self.surface) != "file";
        if is_map {
            rack.warn(&Inputs::new().read("surface", Path::new(&self.surface))?);
        }
        let claim = Claim {
            out: self.out.clone().into(),
            pipeline: pipeline.into(),
            fixture: None,
            surface: Some(self.surface.clone().into()),
            tif: Some(self.rack.clone().into()),
            machine: self.machine.clone().into(),
            named: Named::words("surface_settings", &self.surface_settings, false),
        };
        let (_lock, assumed) = claim.take(&as_typed())?;
        assumed.iter().for_each(warn);
        let mut doubt = None;
        if self.is_assumed {
            let machine = Inputs::new().read_machine(Path::new(&self.machine))?;
            doubt = Some(assumed_machine(machine.name()));
        }
        doubt.iter().for_each(warn);
        let programs = Programs::new(place, Messages::Shown)?;
        let mut course = Course { settings: self, programs, negative: Vec::new() };
        let map = course.map()?;
        if !is_map {
            rack.warn(&Inputs::new().read("surface", Path::new(&map))?);
        }
        course.plan(rack.rack, &map)?;
        doubt.iter().for_each(warn);
        if course.negative.is_empty() {
            return Ok(Status::Done);
        }
        Ok(Status::Negative(course.negative.join("; ")))
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
                self.negative.push(format!("{} ({})", out.unwrap_or(&""), as_command(program)));
                Ok(())
            }
            _ => planish_handoff::exit(2),
        }
    }

    /// Makes the map before the run, from the arrays of the user or from the file of an instrument. Returns its path.
    fn map(&mut self) -> Result<String, Failure> {
        let map = self.path("surface");
        let given = self.settings.surface.clone();
        let mut from = given.clone();
        match kind_of(&given) {
            "file" => {
                from = self.path("import/surface");
                let more = self.settings.surface_settings.clone();
                let picture = format!("{from}.svg");
                let mut flags = vec!["surface", &given];
                flags.extend(more.iter().map(String::as_str));
                flags.extend(["--picture", &picture, "--out", &from, "--force"]);
                self.go_on("planish-import", &flags)?;
            }
            // Arrays without a manifest get one, so that a doubt about them is stated once.
            "bare" => {
                from = self.path("import/surface");
                let flags = ["prepare", "--surface", &given, "--level", "none", "--out", &from];
                self.go_on("planish-surface", &[&flags[..], &["--force"]].concat())?;
            }
            _ => {}
        }
        let prepare = self.settings.prepare.clone();
        let mut flags = vec!["prepare", "--surface", &from];
        flags.extend(prepare.iter().map(String::as_str));
        flags.extend(["--out", &map, "--force"]);
        self.go_on("planish-surface", &flags)?;
        Ok(map)
    }

    /// Plans with the tools of the rack for this map: their paths, the choice, then tool by tool.
    fn plan(&mut self, rack: Rack, map: &str) -> Result<(), Failure> {
        let mut tools = Vec::new();
        for entry in rack.tools {
            tools.push(self.tool(entry, map)?);
        }
        let rack: Vec<RackEntry> = tools.iter().map(RunTool::stated).collect();
        let mut chosen = self.choose(tools, map)?;
        chosen.sort_by(|a, b| b.width_mm.total_cmp(&a.width_mm));
        // Nobody shall run the program of a tool that an earlier run had chosen.
        let earlier = self.path("tools");
        if Path::new(&earlier).exists() {
            fs::remove_dir_all(&earlier)?;
        }
        let order: Vec<RackEntry> = chosen.iter().map(RunTool::stated).collect();
        let mut rows: Vec<Row> = Vec::new();
        let mut before = map.to_string();
        while !chosen.is_empty() {
            let (row, after) = self.run_tool(&chosen, &before)?;
            if rows.is_empty() {
                self.record(order.clone(), map, row.planned_rms_nm)?.write(&self.settings.out)?;
            }
            rows.push(row);
            before = after;
            chosen.remove(0);
        }
        self.tell(map, &rows)?;
        self.write_page(rack, &rows)
    }

    /// Makes the record of a run with these tools for this map, whose plan leaves `planned_rms_nm`.
    fn record(
        &self,
        tools: Vec<RackEntry>,
        map: &str,
        planned_rms_nm: f64,
    ) -> Result<Record, Failure> {
        let settings = &self.settings;
        Ok(Record {
            rack: Rack { tools },
            machine: std::path::absolute(&settings.machine)?,
            is_assumed: settings.is_assumed,
            prepare: settings.prepare.clone(),
            is_joint: settings.is_joint,
            export: settings.export.clone(),
            export_settings: settings.export_settings.clone(),
            page: settings.page.clone(),
            surface: std::path::absolute(map)?,
            planned_rms_nm: settings.keep_rms_nm.unwrap_or(planned_rms_nm),
        })
    }

    /// Writes the page of the run to `report`.
    fn write_page(&mut self, rack: Vec<RackEntry>, rows: &[Row]) -> Result<(), Failure> {
        let Settings { surface, machine, is_assumed, is_joint, out, page, .. } = &self.settings;
        let mut assumed = None;
        if *is_assumed {
            assumed = Some(Inputs::new().read_machine(Path::new(machine))?.name().to_string());
        }
        let mirror = name_of(&std::path::absolute(surface)?);
        let mut choice = None;
        if self.settings.chooses
            && let Some(row) = rows.first()
        {
            choice = report_of(&self.path(&format!("choice/{}", row.tool)))?.choice;
        }
        let rms_nm = rows.last().map_or(0.0, |row| row.executed_rms_nm);
        let times: Vec<(&str, f64)> =
            rows.iter().map(|row| (row.tool.as_str(), row.time_s)).collect();
        let rack = Rack { tools: rack };
        let run = PageOfRun {
            out,
            mirror: &mirror,
            assumed_machine: assumed.as_deref(),
            motion: if *is_joint { "joint" } else { "refine" },
            machine: self.machine_copy(),
            choice,
            order: times.iter().map(|(name, _)| *name).collect(),
            cost_nm2: rack.cost_nm2(rms_nm, &times),
            rack: rack.tools,
        };
        match page.write(&self.programs, &run)? {
            0 => Ok(()),
            1 => {
                self.negative.push(format!("{} (planish compare)", self.path("report")));
                Ok(())
            }
            _ => std::process::exit(2),
        }
    }

    /// Returns the path of the copy of the machine of the run.
    fn machine_copy(&self) -> String {
        let file = Path::new(&self.settings.machine).file_name().unwrap_or_default();
        self.path(&format!("machine/{}", file.to_string_lossy()))
    }

    /// Prepares a tool: copies the file of its machine, and makes its tool path unless the rack has one.
    fn tool(&mut self, mut entry: RackEntry, map: &str) -> Result<RunTool, Failure> {
        let tif = entry.tif.display().to_string();
        let width_mm = Inputs::new().read_tool("tif", &entry.tif)?.half_maximum_width_mm();
        let name = entry.name.clone();
        let has_machine = entry.machine.is_some();
        let machine = match entry.machine.take() {
            Some(file) => {
                let copy = PathBuf::from(self.path(&format!("machine/{name}.json")));
                let (text, assumed) = with_limit_on_jerk(&file, &copy)?;
                assumed.iter().for_each(warn);
                OutputFile::begin("out", &copy, true, &Inputs::new())?.write(&text)?;
                copy.display().to_string()
            }
            None => self.machine_copy(),
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
        Ok(RunTool { entry, tif, tool_path, width_mm, machine, has_machine })
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
        let RackEntry { name, change_s, .. } = &tool.entry;
        let at = self.path(&format!("tools/{name}"));
        let rack = self.write_rack(&format!("tools/{name}/rack.json"), tools, true)?;
        let plan = format!("{at}/plan");
        let keep = self.settings.keep_rms_nm.map(|nm| format!("--keep-rms-nm={nm}"));
        let mut flags =
            vec!["several-tools", "--surface", before, "--rack", &rack, "--out", &plan, "--force"];
        flags.extend(keep.as_deref());
        self.go_on("planish-dwell", &flags)?;
        // What the later tools will remove is not for this one
        let mut target = before.to_string();
        for other in later {
            target = self.without(other, &target, &plan, &at)?;
        }
        let dwell = format!("{plan}/{name}");
        let planned = report_of(&dwell)?;
        let own_share = planned.tools.iter().find(|share| share.name == *name);
        let price_nm2_per_s = own_share.map_or(0.0, |share| share.time_weight_nm2_per_s);
        let mirror = ["--surface", &target, "--tif", &tool.tif, "--tool-path", &tool.tool_path];
        let price = format!("--time-weight-nm2-per-s={price_nm2_per_s}");
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
        let removal: RemovalOutcome = outcome(&format!("{executed}/removal"), &kind::REMOVAL)?;
        let judged: Verdict = outcome(&format!("{executed}/verdict"), &kind::VERDICT)?;
        let row = Row {
            tool: name.clone(),
            planned_rms_nm: planned.model_rms_nm,
            executed_rms_nm: removal.rms_nm,
            time_s: removal.total_time_s,
            change_s: *change_s,
            limits_respected: judged.limits_respected,
            remarks: remarks(name, &planned),
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
        match self.programs.refusal(&command(program, flags))? {
            Some((2.., message)) => Err(Failure::new(message)),
            _ => Ok(()),
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
        let more = [&self.settings.export_settings[..], self.settings.page.stated()].concat();
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
            lines.extend(row.remarks.iter().map(|remark| format!("  {remark}")));
        }
        let time_s: f64 = rows.iter().map(|row| row.time_s).sum();
        let change_s: f64 = rows.iter().map(|row| row.change_s).sum();
        lines.push(format!(
            "{} {}, {:.2} s with changes; map after the last one: {}",
            rows.len(),
            if rows.len() == 1 { "tool" } else { "tools" },
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

impl RunTool {
    /// Returns the tool as a rack states it, with the copy of the file of its machine.
    fn stated(&self) -> RackEntry {
        let machine = if self.has_machine {
            Some(std::path::absolute(&self.machine).unwrap_or_else(|_| self.machine.clone().into()))
        } else {
            None
        };
        RackEntry { machine, ..self.entry.clone() }
    }
}

/// Returns the sentences of a row of the table, for the tool of this name and the plan of it and the later ones.
fn remarks(name: &str, planned: &SeveralReport) -> Vec<String> {
    let mut remarks = Vec::new();
    for ToolShare { name: other, total_time_s, reserve, unreached_part, .. } in &planned.tools {
        if let Some(reserve) =
            reserve.as_ref().filter(|reserve| reserve.errors_of.contains(&name.into()))
        {
            remarks.push(format!(
                "{:.2} nm (at most {:.2} nm) are left for {other}, which then dwells up to {total_time_s:.2} s",
                reserve.mean_nm, reserve.largest_nm
            ));
        }
        if other == name && *unreached_part > 0.0 {
            remarks.push(format!(
                "{name} does not reach {:.1} % of the part along its path",
                100.0 * unreached_part
            ));
        }
    }
    if let Some(unseen_nm) = planned.unseen_setup_rms_nm {
        remarks.push(format!(
            "set-up errors that no map shows are expected to add {unseen_nm:.4} nm RMS"
        ));
    }
    if let Some(keeping) = planned.keeping {
        remarks.push(format!(
            "{:.4} nm are {}kept, at {:.3} of the prices of the rack",
            keeping.keep_rms_nm,
            if keeping.is_kept { "" } else { "not " },
            keeping.price_factor
        ));
    }
    remarks
}

/// Returns the report on the dwell times `dir` of a plan of several tools.
fn report_of(dir: &str) -> Result<SeveralReport, Failure> {
    let outcome: PlanOutcome<SeveralReport> = outcome(dir, &kind::DWELL)?;
    outcome.report.ok_or_else(|| Failure::new(format!("{dir}: has no report; {REMEDY}")))
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
