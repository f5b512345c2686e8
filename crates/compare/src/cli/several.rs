//! `planish compare several`.

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::Args;
use ndarray::{Array2, Zip};
use planish_compare::{
    answer::answer,
    places::Division,
    plan::PlanStatus,
    report::{RunData, RunMethod, tool},
    several::{OtherExecuted, Several, Subset, ToolOfPlan, WavesLeft},
    summary::{MethodFacts, MethodResult, Summary, WallTimes},
};
use planish_handoff::{
    Artifact, Failure, Inputs, Output, Status,
    flags::{OutputArgs, PartArgs},
    kind, say, task,
};
use planish_types::{
    DwellTime, Rack, RackEntry, Removal, Surface, Tif, ToolPath, Trajectory,
    outcome::{
        plan::{ChoiceReport, PlanOutcome, SeveralReport},
        verdict::Verdict,
    },
    reach::Reach,
    text::visible,
};
use serde::Deserialize;
use serde_json::json;

use super::{
    super::files::{self, Provenance, add_manifest, machine_of, manifest_of},
    report::report_files,
};

/// Remedy for artifacts of a run that do not belong together.
const AGAIN: &str = "run planish run several again";

#[derive(Args)]
pub struct SeveralCommand {
    /// Run of several tools: a directory with surface/, rack.json and tools/NAME/{removal,verdict}/
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// Name of the mirror
    #[arg(long, value_name = "NAME", default_value = "")]
    mirror: String,
    /// Name of the machine, if nobody named one and it is that of the fixtures; the result says so
    #[arg(long, value_name = "NAME")]
    assumed_machine: Option<String>,
    #[command(flatten)]
    part: PartArgs,
    #[command(flatten)]
    output: OutputArgs,
}

impl SeveralCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        let Self { run, mirror, assumed_machine, part, output } = self;
        let mut inputs = Inputs::new();
        let part = part.part();
        let task = task!(
            "several",
            json!({ "run": files::name_of(run), "mirror": mirror, "assumed_machine": assumed_machine, "part": part })
        );
        let reader = Reader { run, to_run: to_run(run, &output.out) };
        let mut data = reader.read(&mut inputs, mirror)?;
        data.summary.part = part;
        let assumed = assumed_machine.iter().map(|name| planish_types::assumed_machine(name));
        data.summary.remarks.extend(assumed);
        let name = data.name.clone();
        let summary = data.summary.clone();
        let status = match &summary.best {
            Some(_) => Status::Done,
            None => Status::Negative(answer(&summary).problems.join(" ")),
        };
        let writer = Output::directory(output, &kind::REPORT).begin(&task, &inputs)?.writer();
        if let Some(mut writer) = writer {
            let beside = report_files(vec![data], &[(&name, &summary)])?;
            let beside: Vec<(&str, Vec<u8>)> =
                beside.iter().map(|(name, bytes)| (name.as_str(), bytes.clone())).collect();
            writer.write_arrays(&kind::REPORT, &[], &beside, json!({}), &status)?;
        }
        say(visible(&answer(&summary).sentence));
        for warning in summary.several.iter().flat_map(|several| &several.warnings) {
            say(visible(warning));
        }
        say(visible(&output.out.join("report.html").to_string_lossy()));
        Ok(status)
    }
}

/// Returns the prefix of links from the page in `out` to the run: `../` if the page is in the run, else its path.
fn to_run(run: &Path, out: &Path) -> String {
    let canonical = |path: &Path| Path::new(".").join(path).canonicalize().ok();
    let parent = out.parent().and_then(|parent| canonical(&Path::new(".").join(parent)));
    match canonical(run) {
        Some(run) if Some(&run) == parent.as_ref() => "../".into(),
        Some(run) => format!("{}/", run.display()),
        None => String::new(),
    }
}

/// Reader of a run of several tools, with the prefix of links from the page to it.
struct Reader<'a> {
    run: &'a Path,
    to_run: String,
}

/// A tool of the plan with what its run made.
struct ToolFiles {
    entry: RackEntry,
    tif: Tif,
    path: ToolPath,
    /// Map before this tool.
    before: Surface,
    trajectory: Trajectory,
    dwell: Option<DwellTime>,
    removal: Removal,
    verdict: Verdict,
    machine: Option<String>,
    planned_rms_nm: Option<f64>,
    program: Option<String>,
    provenance: Provenance,
}

impl Reader<'_> {
    /// Reads and summarises the run.
    ///
    /// # Errors
    /// Fails if an artifact cannot be read, if no tool has run, or if a removal is of another motion or map than that
    /// which is there.
    fn read(&self, inputs: &mut Inputs, mirror: &str) -> Result<RunData, Failure> {
        let desired: Surface = inputs.read("surface", &self.run.join("surface"))?;
        let rack: Rack = inputs.read_json("rack", &self.run.join("rack.json"))?;
        let rack_size = rack.tools.len();
        let mut tools = Vec::new();
        for entry in &rack.tools {
            if self.run.join("tools").join(&entry.name).join("removal").exists() {
                tools.push(self.tool(inputs, entry.clone(), &desired)?);
            }
        }
        if tools.is_empty() {
            let problem = "holds no tool that has run";
            return Err(Failure::new(format!("{}: {problem}; {AGAIN}", self.run.display())));
        }
        let tools = in_order(tools, self.run, &desired);
        let choice = self.choice(inputs, &rack)?;
        let others = self.others(inputs, &rack)?;
        let narrowest = tools.iter().min_by(|a, b| width_mm(&a.tif).total_cmp(&width_mm(&b.tif)));
        let tifs: Vec<&Tif> = tools.iter().map(|tool| &tool.tif).collect();
        let reach = Reach::new(&desired, &tifs);
        let division = Division::new(&desired, narrowest.map(|tool| &tool.tif));
        let picture: Vec<tool::Picture> = tools
            .iter()
            .flat_map(|files| tool::pictures(&files.tif, &desired, &files.entry.name))
            .collect();
        let mut several = Several { tools: rows(&tools), rack_size, others, ..Several::default() };
        several.total_time_s = several.tools.last().map_or(0.0, |tool| tool.elapsed_s);
        several.cost_nm2 = cost_nm2(&rack, &several.tools);
        if let Some(choice) = choice {
            several.relative_gap_of_choice =
                choice.relative_gap_of_choice.filter(|gap| gap.is_finite());
            several.subsets = subsets(&choice);
        }
        let waves = waves_left(reach.as_ref(), &tools);
        several.warnings = several.own_warnings(waves);
        several.warnings.extend(breaks(&tools));
        let name = files::name_of(self.run);
        let mut numbers = Vec::new();
        let mut methods = Vec::new();
        for files in tools {
            let (number, method) = files.method(&desired, &division, reach.as_ref())?;
            numbers.push((method.name.clone(), number));
            methods.push(method);
        }
        let order: Vec<String> = numbers.iter().map(|(name, _)| name.clone()).collect();
        let mut summary =
            Summary::new("several", mirror, &desired, &division, numbers, vec![], vec![]).with(
                &desired,
                reach.as_ref(),
                Default::default(),
            );
        // The tools stand in the order in which they run, and the last one ends the plan.
        summary.methods.sort_by_key(|(name, _)| order.iter().position(|other| other == name));
        summary.best = order.last().filter(|_| several.keeps_limits()).cloned();
        summary.several = Some(several);
        let provenance = Provenance::default();
        Ok(RunData {
            name,
            summary,
            desired,
            measured: None,
            path: None,
            tool: picture,
            methods,
            provenance,
        })
    }

    /// Reads what the run made for a tool of the rack; `first` is the map before the first tool. If the run wrote a
    /// program, the motion is that of the program.
    fn tool(
        &self,
        inputs: &mut Inputs,
        entry: RackEntry,
        first: &Surface,
    ) -> Result<ToolFiles, Failure> {
        let name = entry.name.clone();
        let at = self.run.join("tools").join(&name);
        let role = |part: &str| format!("{name}/{part}");
        let planned = ["joint", "refined"].map(|part| at.join(part));
        let planned = planned.iter().find(|dir| dir.join("trajectory").exists());
        let planned = planned.ok_or_else(|| {
            Failure::new(format!("{}: has no motion of {name}; {AGAIN}", at.display()))
        })?;
        let program = at.join("program");
        let has_program = program.join("removal").exists();
        let (motion, judged) = if has_program {
            (program.join("trajectory"), &program)
        } else {
            (planned.join("trajectory"), &at)
        };
        let mut provenance = Provenance::default();
        let (trajectory, manifest) = inputs.read_with_manifest(&role("trajectory"), &motion)?;
        if let Some(manifest) = &manifest {
            add_manifest(&mut provenance, "trajectory", &motion, manifest)?;
        }
        let place = judged.join("removal");
        let (removal, manifest): (Removal, _) =
            inputs.read_with_manifest(&role("removal"), &place)?;
        let map = at.join("map");
        let before = if map.exists() { inputs.read(&role("map"), &map)? } else { first.clone() };
        if let Some(manifest) = &manifest {
            add_manifest(&mut provenance, "removal", &place, manifest)?;
            let made_from = manifest.inputs.iter().find(|input| input.role == "trajectory");
            if made_from.map(|input| input.blake3.as_str()) != inputs.digest(&role("trajectory")) {
                let problem = "is of another motion than that which is there";
                return Err(Failure::new(format!("{}: {problem}; {AGAIN}", place.display())));
            }
        }
        let place = judged.join("verdict");
        let manifest = inputs.read_manifest(&role("verdict"), &place, &kind::VERDICT)?;
        let verdict: Verdict = manifest.read_outcome(&place, AGAIN)?;
        let machine = machine_of(&verdict, &manifest);
        add_manifest(&mut provenance, "verdict", &place, &manifest)?;
        let dwell = planned.join("dwell");
        let dwell = if dwell.exists() { Some(inputs.read(&role("dwell"), &dwell)?) } else { None };
        let path = entry.tool_path.clone().unwrap_or_default();
        Ok(ToolFiles {
            tif: inputs.read_tool(&role("tif"), &entry.tif)?,
            path: inputs.read(&role("tool_path"), &path)?,
            before,
            trajectory,
            dwell,
            removal,
            verdict,
            machine,
            planned_rms_nm: self.planned_rms_nm(inputs, &name)?,
            program: self.program(&name)?,
            provenance,
            entry,
        })
    }

    /// Returns the RMS that the dwell times of a tool and of those after it leave, nm; `None` if they are not there.
    fn planned_rms_nm(&self, inputs: &mut Inputs, name: &str) -> Result<Option<f64>, Failure> {
        let place = self.run.join("tools").join(name).join("plan").join(name);
        if !place.exists() {
            return Ok(None);
        }
        let manifest = inputs.read_manifest(&format!("{name}/plan"), &place, DwellTime::KIND)?;
        let outcome: PlanOutcome<SeveralReport> = manifest.read_outcome(&place, AGAIN)?;
        Ok(outcome.report.map(|report| report.model_rms_nm))
    }

    /// Returns the path from the page to the program of a tool; `None` without one.
    fn program(&self, name: &str) -> Result<Option<String>, Failure> {
        let mut programs = Vec::new();
        for entry in fs::read_dir(self.run.join("tools").join(name))? {
            let file = entry?.file_name().to_string_lossy().into_owned();
            if file.starts_with("program.") && !file.ends_with(".json") {
                programs.push(format!("{}tools/{name}/{file}", self.to_run));
            }
        }
        Ok(programs.into_iter().min())
    }

    /// Returns the choice of the tools; `None` if the run made none.
    fn choice(&self, inputs: &mut Inputs, rack: &Rack) -> Result<Option<ChoiceReport>, Failure> {
        let places = rack.tools.iter().map(|tool| self.run.join("choice").join(&tool.name));
        let Some(place) = places.into_iter().find(|place| place.exists()) else { return Ok(None) };
        let manifest = inputs.read_manifest("choice", &place, DwellTime::KIND)?;
        let outcome: PlanOutcome<SeveralReport> = manifest.read_outcome(&place, AGAIN)?;
        Ok(outcome.report.and_then(|report| report.choice))
    }

    /// Returns the other plans of the rack, which the settings compare and price_factors of the run make in
    /// `others/LABEL`, by their labels.
    fn others(&self, inputs: &mut Inputs, rack: &Rack) -> Result<Vec<OtherExecuted>, Failure> {
        let folder = self.run.join("others");
        let mut labels = Vec::new();
        if folder.exists() {
            for entry in fs::read_dir(&folder)? {
                let entry = entry?;
                if entry.path().is_dir() {
                    labels.push(entry.file_name().to_string_lossy().into_owned());
                }
            }
        }
        labels.sort();
        let mut rows = Vec::new();
        for label in labels {
            let report = folder.join(&label).join("report");
            let role = format!("others/{label}");
            let page: PageOfOther = inputs.read_json(&role, &report.join("summary.json"))?;
            let tools = &page.several.tools;
            rows.push(OtherExecuted {
                tools: tools.iter().map(|tool| tool.name.clone()).collect(),
                price_factor: label
                    .strip_prefix("prices=")
                    .and_then(|factor| factor.parse().ok())
                    .unwrap_or(1.0),
                rms_nm: tools.last().map_or(0.0, |tool| tool.rms_nm),
                time_s: tools.iter().map(|tool| tool.time_s).collect(),
                time_with_changes_s: page.several.total_time_s,
                cost_nm2: cost_nm2(rack, tools),
                limits_kept: page.several.keeps_limits(),
                report: format!("{}others/{label}/report/report.html", self.to_run),
                label,
            });
        }
        Ok(rows)
    }
}

/// Part of the summary of another run of several tools.
#[derive(Deserialize)]
struct PageOfOther {
    several: Several,
}

/// Returns the cost of a plan as executed, at the prices of the rack, nm^2.
fn cost_nm2(rack: &Rack, tools: &[ToolOfPlan]) -> f64 {
    let times: Vec<(&str, f64)> =
        tools.iter().map(|tool| (tool.name.as_str(), tool.time_s)).collect();
    rack.cost_nm2(tools.last().map_or(0.0, |tool| tool.rms_nm), &times)
}

/// Returns the tools in the order in which they run: the first begins with the map of the run, and each other one with
/// the map that the one before leaves, or else, if the map was measured in between, the widest that is left.
fn in_order(mut tools: Vec<ToolFiles>, run: &Path, desired: &Surface) -> Vec<ToolFiles> {
    tools.sort_by(|a, b| width_mm(&b.tif).total_cmp(&width_mm(&a.tif)));
    let is_first =
        |files: &ToolFiles| !run.join("tools").join(&files.entry.name).join("map").exists();
    let mut ordered: Vec<ToolFiles> = Vec::new();
    while !tools.is_empty() {
        let follows = |files: &ToolFiles| match ordered.last() {
            None => is_first(files) || is_same(&files.before, desired),
            Some(last) => is_same(&files.before, last.removal.residual()),
        };
        let next = tools.iter().position(follows).unwrap_or(0);
        ordered.push(tools.remove(next));
    }
    ordered
}

/// Returns true if two maps have the same heights and the same invalid pixels.
fn is_same(a: &Surface, b: &Surface) -> bool {
    let same = |x: &f64, y: &f64| x == y || x.is_nan() && y.is_nan();
    a.height_nm().dim() == b.height_nm().dim()
        && a.height_nm().iter().zip(b.height_nm()).all(|(x, y)| same(x, y))
}

/// Returns a sentence for each map that is not what the tool before it leaves.
fn breaks(tools: &[ToolFiles]) -> Vec<String> {
    let mut sentences = Vec::new();
    for pair in tools.windows(2) {
        if !is_same(&pair[1].before, pair[0].removal.residual()) {
            sentences.push(format!(
                "The map before {} is not the one that {} leaves in the simulation; it was measured, or is of an older \
                 run.",
                pair[1].entry.name, pair[0].entry.name
            ));
        }
    }
    sentences
}

/// Returns the waves after the last tool that no tool of the plan corrects; `None` if the map has no spectrum.
fn waves_left(reach: Option<&Reach>, tools: &[ToolFiles]) -> Option<WavesLeft> {
    let reach = reach?;
    let rms_nm = reach.short_wave_rms_nm(tools.last()?.removal.residual());
    Some(WavesLeft { period_mm: reach.report().period_mm, rms_nm })
}

fn width_mm(tif: &Tif) -> f64 {
    tif.half_maximum_width_mm()
}

/// Returns the rows of the tools in their order.
fn rows(tools: &[ToolFiles]) -> Vec<ToolOfPlan> {
    let mut elapsed_s = 0.0;
    let mut rows = Vec::new();
    for files in tools {
        let time_s = files.trajectory.total_time_s();
        elapsed_s += time_s + files.entry.change_s;
        let before = files.before.statistics();
        let after = files.removal.residual().statistics();
        rows.push(ToolOfPlan {
            name: files.entry.name.clone(),
            width_mm: width_mm(&files.tif),
            before_rms_nm: before.rms,
            mean_removal_nm: before.mean - after.mean,
            planned_rms_nm: files.planned_rms_nm,
            rms_nm: after.rms,
            time_s,
            change_s: files.entry.change_s,
            elapsed_s,
            max_velocity_mm_per_s: files.verdict.max_velocity_mm_per_s,
            limits_kept: files.verdict.limits_respected,
            machine: files.machine.clone(),
            program: files.program.clone(),
        });
    }
    rows
}

fn subsets(choice: &ChoiceReport) -> Vec<Subset> {
    let rows = choice.subsets.iter().enumerate();
    let rows = rows.map(|(i, row)| Subset {
        tools: row.tools.clone(),
        rms_nm: row.model_rms_nm,
        time_s: row.time_s.clone(),
        time_with_changes_s: row.time_with_changes_s,
        cost_nm2: row.cost_nm2,
        is_chosen: i == choice.best,
    });
    rows.collect()
}

impl ToolFiles {
    /// Computes the numbers of the map after this tool, and returns them with the data for the page. `first` is the
    /// map before the first tool.
    fn method(
        self,
        first: &Surface,
        division: &Division,
        reach: Option<&Reach>,
    ) -> Result<(MethodResult, RunMethod), Failure> {
        let name = self.entry.name.clone();
        let after = self.removal.residual();
        // All that was removed since the first map; an invalid pixel has no removal.
        let mut removed: Array2<f64> = first.height_nm() - after.height_nm();
        Zip::from(&mut removed).for_each(|r| {
            if r.is_nan() {
                *r = 0.0;
            }
        });
        let whole = Removal::new(first, removed)?;
        let trajectory = manifest_of(&self.provenance, "trajectory");
        let plan = PlanStatus::of_method(&name, trajectory, None, &[]);
        let facts = MethodFacts {
            wall: WallTimes::default(),
            machine: self.machine,
            plan,
            short_wave_rms_nm: reach.map(|reach| reach.short_wave_rms_nm(after)),
            specification: None,
            after_servo_rms_nm: None,
            on_axes: None,
            remarks: vec![],
        };
        let numbers = MethodResult::new(
            first,
            division,
            &whole,
            &self.trajectory,
            self.dwell.as_ref(),
            &self.verdict,
            facts,
        )
        .map_err(|e| Failure::new(format!("{name}: {e}; {AGAIN}")))?;
        let method = RunMethod {
            name,
            trajectory: self.trajectory,
            shown_removal_nm: Some(self.removal.removal_nm().clone()),
            removal: whole,
            verdict: self.verdict,
            path: Some(self.path),
            dwell: self.dwell,
            frames: None,
            rounds: None,
            on_axes: None,
            provenance: self.provenance,
        };
        Ok((numbers, method))
    }
}
