//! `planish-dwell several-tools`.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use clap::Args;
use planish_dwell::{
    bounded_least_squares::{
        Bound, BoundedReport, BoundedSettings, ShareOfTool, ToolTask, solve_several,
    },
    problem::rms_before,
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task, warn,
};
use planish_types::{DwellTime, Surface, Tif, ToolPath, outcome::plan::PlanOutcome, plausible};
use serde::{Deserialize, Serialize};

use super::{bounded_least_squares::ObjectiveArgs, status, warn_of};

#[derive(Args)]
pub struct SeveralTools {
    /// Map of the desired removal [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// The tools, each with its TIF, tool path, bounds and price of a second [JSON]; paths in it start at its directory
    #[arg(long, value_name = "FILE")]
    rack: PathBuf,
    /// Weight of every pixel [.npy file (ny, nx), >= 0] [default: from the standard deviations of the map, or 1 if it
    /// has none]
    #[arg(long, value_name = "FILE")]
    weight: Option<PathBuf>,
    #[command(flatten)]
    objective: ObjectiveArgs,
    #[command(flatten)]
    output: OutputArgs,
}

/// The file of the flag `--rack`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RackFile {
    tools: Vec<RackTool>,
}

/// One tool as the rack states it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RackTool {
    /// Name of the tool, and of the directory of its dwell times.
    name: String,
    /// Directory of its TIF, or of a tool that varies over the part.
    tif: PathBuf,
    /// Directory of its tool path.
    tool_path: PathBuf,
    /// Smallest dwell time of every dwell point, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    min_dwell_s: Option<f64>,
    /// Smallest dwell time per length, s/mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    min_dwell_s_per_mm: Option<f64>,
    /// Largest dwell time of every dwell point, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    max_dwell_s: Option<f64>,
    /// Largest dwell time per length, s/mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    max_dwell_s_per_mm: Option<f64>,
    /// Price of a second of this tool, relative to half the mean square of the residual, nm^2/s.
    #[serde(default)]
    time_weight_nm2_per_s: f64,
}

/// A tool of the rack with what its files hold.
struct Loaded {
    tool: RackTool,
    tif: Tif,
    path: ToolPath,
    min_dwell: Bound,
    max_dwell: Option<Bound>,
}

/// Report on the dwell times of one tool: its name, the shares of all tools, and the report on all of them together.
#[derive(Serialize)]
struct ReportOfTool<'a> {
    tool: &'a str,
    tools: &'a [ShareOfTool],
    #[serde(flatten)]
    all: &'a BoundedReport,
}

/// Settings as the manifests state them.
#[derive(Serialize)]
struct Resolved {
    tools: Vec<RackTool>,
    #[serde(flatten)]
    settings: BoundedSettings,
}

impl SeveralTools {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let surface: Surface = inputs.read("surface", &self.surface)?;
        let loaded = self.read_rack(&mut inputs)?;
        let weight =
            self.weight.as_ref().map(|file| inputs.read_map("weight", file)).transpose()?;
        let weight = weight.as_ref();
        let settings = self.objective.settings(&surface, weight)?;
        let tools = loaded.iter().map(|loaded| loaded.tool.clone()).collect();
        let task = task!("several-tools", Resolved { tools, settings });
        let names: Vec<&str> = loaded.iter().map(|loaded| loaded.tool.name.as_str()).collect();
        let output = Output::of_one_kind(&self.output, &names, DwellTime::KIND);
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        for Loaded { tool, tif, path, .. } in &loaded {
            plausible::check_path(&surface, tif, path)
                .map_err(|e| failure_of(&tool.name, e.to_string()))?;
            if let Some(doubt) = doubt_of_width(&surface, tif) {
                warn(format!("tool {:?}: {doubt}", tool.name));
            }
        }
        let tasks: Vec<ToolTask<'_>> = loaded.iter().map(Loaded::task).collect();
        let solution =
            solve_several(&surface, &tasks, weight, &settings).map_err(Failure::with_flags)?;

        let r = &solution.report;
        let status = status(r.negative(rms_before(&surface, weight)));
        for (share, dwell) in solution.shares.iter().zip(&solution.dwell) {
            let report = ReportOfTool { tool: &share.name, tools: &solution.shares, all: r };
            let outcome = PlanOutcome {
                end: Some(r.end.into()),
                report: Some(report),
                ..PlanOutcome::default()
            };
            output.write(dwell, outcome, &status)?;
            warn_of(share.tif_lattice);
        }
        self.print(r, &solution.shares);
        Ok(status)
    }

    /// Prints one line for all tools together, and one for each tool.
    fn print(&self, r: &BoundedReport, shares: &[ShareOfTool]) {
        let gap = match r.proven.relative_gap {
            Some(gap) => format!("gap {gap:.1e}"),
            None => format!("KKT residual {:.1e} s", r.kkt_residual_s),
        };
        say(format!(
            "several tools: {} tools, {:.2} s, {:.4} nm RMS in their own model; {} {} after {} iterations, {gap} -> {}",
            shares.len(),
            r.total_time_s,
            r.model_rms_nm,
            r.algorithm,
            r.end,
            r.iterations,
            self.output.out.display()
        ));
        for share in shares {
            say(format!(
                "  {}: {:.2} s, {:.4} nm on average; {} of {} dwell times at the lower bound, {} out of reach",
                share.name,
                share.total_time_s,
                share.mean_removal_nm,
                share.at_lower_bound,
                share.points,
                share.unreached_points
            ));
        }
    }

    /// Reads the rack, and the TIF and tool path of each of its tools.
    fn read_rack(&self, inputs: &mut Inputs) -> Result<Vec<Loaded>, Failure> {
        let rack: RackFile = inputs.read_json("rack", &self.rack)?;
        check_names(&rack)
            .map_err(|problem| Failure::new(format!("{}: {problem}", self.rack.display())))?;
        let directory = self.rack.parent().unwrap_or(Path::new(""));
        rack.tools.into_iter().map(|tool| Loaded::read(tool, directory, inputs)).collect()
    }
}

impl Loaded {
    /// Reads the TIF and the tool path of a tool. Their paths start at the directory of the rack.
    fn read(tool: RackTool, directory: &Path, inputs: &mut Inputs) -> Result<Self, Failure> {
        let name = &tool.name;
        let tif =
            inputs.read_tool_with_doubt(&format!("tif-{name}"), &directory.join(&tool.tif))?;
        let path = inputs.read(&format!("tool-path-{name}"), &directory.join(&tool.tool_path))?;
        let min_dwell = bound("min_dwell", tool.min_dwell_s, tool.min_dwell_s_per_mm);
        let max_dwell = bound("max_dwell", tool.max_dwell_s, tool.max_dwell_s_per_mm);
        let min_dwell = min_dwell.map_err(|problem| failure_of(name, problem))?;
        let min_dwell = min_dwell.unwrap_or(Bound::Seconds(0.0));
        let max_dwell = max_dwell.map_err(|problem| failure_of(name, problem))?;
        Ok(Self { tif, path, min_dwell, max_dwell, tool })
    }

    fn task(&self) -> ToolTask<'_> {
        ToolTask {
            name: &self.tool.name,
            tif: &self.tif,
            path: &self.path,
            min_dwell: self.min_dwell,
            max_dwell: self.max_dwell,
            time_weight_nm2_per_s: self.tool.time_weight_nm2_per_s,
        }
    }
}

/// Returns the failure of a tool with its name.
fn failure_of(name: &str, problem: String) -> Failure {
    Failure::new(format!("tool {name:?}: {problem}"))
}

/// Refuses a rack without tools, a name that cannot name a directory, and two tools of one name.
fn check_names(rack: &RackFile) -> Result<(), String> {
    if rack.tools.is_empty() {
        return Err("has no tools; give at least one".to_string());
    }
    let mut names = BTreeSet::new();
    for (k, RackTool { name, .. }) in rack.tools.iter().enumerate() {
        check_name(name).map_err(|problem| format!("tools[{k}].name {problem}"))?;
        // Two directories that differ in case are one on some systems.
        if !names.insert(name.to_lowercase()) {
            return Err(format!("tools[{k}].name is {name:?} again; give every tool its own name"));
        }
    }
    Ok(())
}

/// Returns the bound by a time, s, or by a time per length, s/mm; `None` if neither is there. Refuses both.
fn bound(
    name: &str,
    seconds: Option<f64>,
    seconds_per_mm: Option<f64>,
) -> Result<Option<Bound>, String> {
    match (seconds, seconds_per_mm) {
        (Some(_), Some(_)) => Err(format!("has {name}_s and {name}_s_per_mm; give one of them")),
        (Some(time), None) => Ok(Some(Bound::Seconds(time))),
        (None, rate) => Ok(rate.map(Bound::SecondsPerMm)),
    }
}

/// Refuses a name that cannot name a directory on every system.
fn check_name(name: &str) -> Result<(), String> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if name.starts_with(|c: char| c.is_ascii_alphanumeric()) && name.chars().all(is_plain) {
        return Ok(());
    }
    Err(format!(
        "is {name:?}, which names a directory of the output; give letters, digits, `-`, `_` and `.`, a letter or digit \
         first"
    ))
}

/// Returns a sentence if the effective area of the TIF is larger than the map, so that the tool removes little more
/// than a piston or a tilt; otherwise `None`.
fn doubt_of_width(surface: &Surface, tif: &Tif) -> Option<String> {
    let [x, y] = surface.grid().size_mm();
    let area_mm2 = tif.effective_area_mm2();
    if area_mm2 <= x * y {
        return None;
    }
    Some(format!(
        "is wider than the part (effective area {area_mm2:.0} mm^2, map {:.0} mm^2): it removes little more than a \
         piston or a tilt; leave it out unless that is its task",
        x * y
    ))
}
