//! `planish dwell several-tools` and `planish dwell choose-tools`: dwell times of a rack of tools, or of its best
//! subset.

mod setup_draws;

use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

use clap::Args;
use ndarray::Array2;
use planish_dwell::{
    bounded_least_squares::{
        Bound, BoundedReport, BoundedSettings, KeptPlan, RackTool, SeveralSolution, SolvedSubset,
        ToolChoice, ToolTask, choose_tools, solve_keeping, solve_several,
    },
    problem::rms_before,
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task, warn,
};
use planish_types::{
    DwellTime, Rack, RackEntry, Surface, Tif, ToolPath, doubts,
    outcome::plan::{ChoiceReport, Keeping, PlanOutcome, Reserve, SubsetRow, ToolShare},
    plausible,
    reach::Reach,
};
use serde::Serialize;

use self::setup_draws::DrawsReport;
use super::{bounded_least_squares::ObjectiveArgs, status, warn_of};

/// Part of the residual, in RMS, from which a warning says that no tool reaches its waves. Larger: a rack without a
/// narrow tool passes in silence. Smaller: warnings about noise that nobody wants removed. At half, these waves are a
/// quarter of the mean square.
const SHORT_PART: f64 = 0.5;

#[derive(Args)]
pub struct SeveralTools {
    #[command(flatten)]
    rack: RackArgs,
    /// Residual that the plan shall keep, RMS, nm: the prices of a second are lowered by one factor until it does. After
    /// a map between two tools, give the residual that was planned. [default: the prices as the rack states them]
    #[arg(long, value_name = "NM")]
    keep_rms_nm: Option<f64>,
    /// Runs that are drawn with the set-up errors of the tools, each with and without the maps between them
    #[arg(long, value_name = "N")]
    setup_draws: Option<NonZeroUsize>,
    /// Random seed
    #[arg(long, value_name = "S", requires = "setup_draws", default_value_t = 1)]
    seed: u64,
}

/// Wishes beside a plan that only `several-tools` takes.
#[derive(Clone, Copy, Default)]
struct Wishes {
    keep_rms_nm: Option<f64>,
    /// Number of runs that are drawn, and the seed.
    setup_draws: Option<(usize, u64)>,
}

#[derive(Args)]
pub struct ChooseTools {
    #[command(flatten)]
    rack: RackArgs,
}

/// Flags of the commands that plan with a rack.
#[derive(Args)]
struct RackArgs {
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

/// A tool of the rack with what its files hold.
struct Loaded {
    tool: RackEntry,
    tif: Tif,
    path: ToolPath,
    min_dwell: Bound,
    max_dwell: Option<Bound>,
}

/// Report on the dwell times of one tool: its name, the shares of all tools, the choice of them if it was made here,
/// and the report on all of them together.
#[derive(Serialize)]
struct ReportOfTool<'a> {
    tool: &'a str,
    tools: &'a [ToolShare],
    #[serde(skip_serializing_if = "Option::is_none")]
    choice: Option<&'a ChoiceReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    keeping: Option<Keeping>,
    /// Expected RMS of the set-up errors that no map shows, nm.
    #[serde(skip_serializing_if = "Option::is_none")]
    unseen_setup_rms_nm: Option<f64>,
    /// Results of runs with set-up errors.
    #[serde(skip_serializing_if = "Option::is_none")]
    setup_draws: Option<&'a DrawsReport>,
    #[serde(flatten)]
    all: &'a BoundedReport,
}

/// Settings as the manifests state them.
#[derive(Serialize)]
struct Resolved {
    tools: Vec<RackEntry>,
    /// True if the best subset of the tools was to be found.
    chosen: bool,
    /// Residual that the plan shall keep, RMS, nm.
    #[serde(skip_serializing_if = "Option::is_none")]
    keep_rms_nm: Option<f64>,
    /// Number of runs that are drawn with set-up errors, and their seed.
    #[serde(skip_serializing_if = "Option::is_none")]
    setup_draws: Option<(usize, u64)>,
    #[serde(flatten)]
    settings: BoundedSettings,
}

/// A plan with what the commands report beside it.
struct Planned {
    solution: SeveralSolution,
    choice: Option<ChoiceReport>,
    keeping: Option<Keeping>,
}

/// Tools of a problem with the map and its weights.
struct Task<'a> {
    surface: &'a Surface,
    loaded: &'a [Loaded],
    weight: Option<&'a Array2<f64>>,
    settings: &'a BoundedSettings,
}

impl SeveralTools {
    pub fn run(&self) -> Result<Status, Failure> {
        let setup_draws = self.setup_draws.map(|runs| (runs.get(), self.seed));
        self.rack.run(false, Wishes { keep_rms_nm: self.keep_rms_nm, setup_draws })
    }
}

impl ChooseTools {
    pub fn run(&self) -> Result<Status, Failure> {
        self.rack.run(true, Wishes::default())
    }
}

impl RackArgs {
    /// Plans with all tools of the rack, or with its best subset if `chosen`, and writes the dwell times of each tool.
    fn run(&self, chosen: bool, wishes: Wishes) -> Result<Status, Failure> {
        let Wishes { keep_rms_nm, setup_draws } = wishes;
        let mut inputs = Inputs::new();
        let surface: Surface = inputs.read("surface", &self.surface)?;
        let loaded = self.read_rack(&mut inputs)?;
        let weight =
            self.weight.as_ref().map(|file| inputs.read_map("weight", file)).transpose()?;
        let weight = weight.as_ref();
        let settings = self.objective.settings(&surface, weight)?;
        let tools = loaded.iter().map(|loaded| loaded.tool.clone()).collect();
        let task =
            task!("several-tools", Resolved { tools, chosen, keep_rms_nm, setup_draws, settings });
        let names: Vec<&str> = loaded.iter().map(|loaded| loaded.tool.name.as_str()).collect();
        let output = Output::of_one_kind(&self.output, &names, DwellTime::KIND);
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        for Loaded { tool, tif, path, .. } in &loaded {
            plausible::check_path(&surface, tif, path)
                .map_err(|e| failure_of(&tool.name, e.to_string()))?;
            if let Some(doubt) = doubts::of_width(&surface, tif) {
                warn(format!("tool {:?}: {doubt}", tool.name));
            }
        }
        let task = Task { surface: &surface, loaded: &loaded, weight, settings: &settings };
        let planned = match keep_rms_nm {
            _ if chosen => task.choose()?,
            Some(keep_rms_nm) => task.keep(keep_rms_nm)?,
            None => {
                let tools: Vec<&Loaded> = loaded.iter().collect();
                Planned { solution: task.solve(&tools)?, choice: None, keeping: None }
            }
        };
        self.print(&planned);
        let tasks: Vec<ToolTask<'_>> = loaded.iter().map(Loaded::task).collect();
        let problem = (&surface, weight, &settings);
        let draws = match setup_draws {
            Some(runs) => Some(setup_draws::draw(problem, &tasks, &planned.solution, runs)?),
            None => None,
        };
        let SeveralSolution { dwell, shares, report: r, unseen_rms_nm } = &planned.solution;
        let negative = r.negative(rms_before(&surface, weight));
        let status = status(negative.or_else(|| planned.keeping.and_then(not_kept)));
        task.warn_of_short_waves(&planned.solution);
        for name in names {
            if !shares.iter().any(|share| share.name == name) {
                output.leave_out(name);
            }
        }
        for (share, dwell) in shares.iter().zip(dwell) {
            let report = ReportOfTool {
                tool: &share.name,
                tools: shares,
                choice: planned.choice.as_ref(),
                keeping: planned.keeping,
                unseen_setup_rms_nm: *unseen_rms_nm,
                setup_draws: draws.as_ref(),
                all: r,
            };
            let outcome = PlanOutcome {
                end: Some(r.end.into()),
                report: Some(report),
                ..PlanOutcome::default()
            };
            output.write(dwell, outcome, &status)?;
            warn_of(share.tif_lattice);
        }
        Ok(status)
    }

    /// Prints one line for all tools together, one for each tool, and one for each reserve.
    fn print(&self, planned: &Planned) {
        let SeveralSolution { shares, report: r, unseen_rms_nm, .. } = &planned.solution;
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
            if share.unreached_part > 0.0 {
                say(format!(
                    "  {} does not reach {:.1} % of the part along its path",
                    share.name,
                    100.0 * share.unreached_part
                ));
            }
            if let Some(Reserve { errors_of, mean_nm, largest_nm, time_s }) = &share.reserve {
                say(format!(
                    "  {mean_nm:.2} nm (at most {largest_nm:.2} nm) are left for {}, for the set-up errors of {}: at \
                     least {time_s:.2} s",
                    share.name,
                    errors_of.join(" and ")
                ));
            }
        }
        if let Some(unseen_nm) = unseen_rms_nm {
            say(format!(
                "  set-up errors that no map shows add {unseen_nm:.4} nm RMS (expected, not in the residual above)"
            ));
        }
        if let Some(Keeping { keep_rms_nm, price_factor, is_kept: true }) = planned.keeping {
            say(format!(
                "  {keep_rms_nm:.4} nm are kept at {price_factor:.3} of the prices of a second"
            ));
        }
    }

    /// Reads the rack, and the TIF and tool path of each of its tools.
    fn read_rack(&self, inputs: &mut Inputs) -> Result<Vec<Loaded>, Failure> {
        let rack: Rack = inputs.read_json("rack", &self.rack)?;
        rack.check()
            .map_err(|problem| Failure::new(format!("{}: {problem}", self.rack.display())))?;
        let directory = self.rack.parent().unwrap_or(Path::new(""));
        rack.tools.into_iter().map(|tool| Loaded::read(tool, directory, inputs)).collect()
    }
}

impl Task<'_> {
    /// Plans with these tools.
    fn solve(&self, tools: &[&Loaded]) -> Result<SeveralSolution, Failure> {
        let tasks: Vec<ToolTask<'_>> = tools.iter().map(|loaded| loaded.task()).collect();
        solve_several(self.surface, &tasks, self.weight, self.settings).map_err(Failure::with_flags)
    }

    /// Plans with all tools at prices at which this residual is kept.
    fn keep(&self, keep_rms_nm: f64) -> Result<Planned, Failure> {
        let tasks: Vec<ToolTask<'_>> = self.loaded.iter().map(Loaded::task).collect();
        let KeptPlan { solution, price_factor, is_kept } =
            solve_keeping(self.surface, &tasks, self.weight, self.settings, keep_rms_nm)
                .map_err(Failure::with_flags)?;
        let keeping = Some(Keeping { keep_rms_nm, price_factor, is_kept });
        Ok(Planned { solution, choice: None, keeping })
    }

    /// Plans with the best subset of the tools, and prints a row of the table for every subset when it is solved. So an
    /// interrupted search has told the best one so far, with its gap. If its tools have set-up errors, they are planned
    /// again with them.
    fn choose(&self) -> Result<Planned, Failure> {
        let rack: Vec<RackTool<'_>> = self.loaded.iter().map(Loaded::rack_tool).collect();
        say(format!(
            "{:<32} {:>10} {:>10} {:>14} {:>12} {:>9}  time of each tool, s",
            "tools", "RMS nm", "time s", "with changes", "cost nm^2", "best: gap"
        ));
        let choice = choose_tools(self.surface, &rack, self.weight, self.settings, |so_far| {
            self.print_row(so_far);
        })
        .map_err(Failure::with_flags)?;
        let rows = choice.solved.iter().map(|subset| self.row(subset));
        let report = ChoiceReport {
            subsets: rows.collect(),
            best: choice.best,
            bound_nm2: Some(choice.bound_nm2),
            relative_gap_of_choice: Some(choice.relative_gap()),
        };
        let best = &report.subsets[report.best];
        say(format!(
            "chosen: {}, {:.2} s with changes; no subset costs less by more than {:.1e} of its cost; {} of {} solved",
            best.tools.join(" + "),
            best.time_with_changes_s,
            choice.relative_gap(),
            report.subsets.len(),
            (1_usize << rack.len()) - 1
        ));
        let tools: Vec<&Loaded> = choice.best().tools.iter().map(|k| &self.loaded[*k]).collect();
        let solution = if tools.iter().all(|loaded| loaded.tool.setup_errors().are_zero()) {
            choice.best().solution.clone()
        } else {
            self.solve(&tools)?
        };
        Ok(Planned { solution, choice: Some(report), keeping: None })
    }

    /// Prints the row of the subset that was solved last, with the gap of the best one so far.
    fn print_row(&self, so_far: &ToolChoice) {
        let row = self.row(so_far.solved.last().expect("a subset was solved"));
        let times: Vec<String> = row.time_s.iter().map(|time| format!("{time:.2}")).collect();
        let is_best = so_far.best + 1 == so_far.solved.len();
        say(format!(
            "{:<32} {:>10.4} {:>10.2} {:>14.2} {:>12.4} {}{:>8.1e}  {}",
            row.tools.join(" + "),
            row.model_rms_nm,
            row.time_s.iter().sum::<f64>(),
            row.time_with_changes_s,
            row.cost_nm2,
            if is_best { "*" } else { " " },
            so_far.relative_gap(),
            times.join(" + ")
        ));
    }

    fn row(&self, subset: &SolvedSubset) -> SubsetRow {
        let tools = subset.tools.iter().map(|k| &self.loaded[*k].tool);
        let changes_s: f64 = tools.clone().map(|tool| tool.change_s).sum();
        let SeveralSolution { shares, report, .. } = &subset.solution;
        SubsetRow {
            tools: tools.map(|tool| tool.name.clone()).collect(),
            model_rms_nm: report.model_rms_nm,
            time_s: shares.iter().map(|share| share.total_time_s).collect(),
            time_with_changes_s: report.total_time_s + changes_s,
            cost_nm2: subset.cost_nm2,
            bound_nm2: Some(subset.bound_nm2),
        }
    }

    /// Warns if most of the residual has waves that none of the tools reaches.
    fn warn_of_short_waves(&self, solution: &SeveralSolution) {
        let is_used =
            |loaded: &&Loaded| solution.shares.iter().any(|share| share.name == loaded.tool.name);
        let tifs: Vec<&Tif> = self.loaded.iter().filter(is_used).map(|l| &l.tif).collect();
        let Some(reach) = Reach::new(self.surface, &tifs) else { return };
        let Some(wavelength_mm) = reach.longest_mm() else { return };
        let rms_nm = reach.short_wave_rms_nm(self.surface);
        if rms_nm > SHORT_PART * solution.report.model_rms_nm {
            warn(format!(
                "waves shorter than {wavelength_mm:.2} mm remain, {rms_nm:.4} nm RMS of the map: no tool reaches them; \
                 add a narrower tool to the rack if they matter"
            ));
        }
    }
}

impl Loaded {
    /// Reads the TIF and the tool path of a tool. Their paths start at the directory of the rack.
    fn read(tool: RackEntry, directory: &Path, inputs: &mut Inputs) -> Result<Self, Failure> {
        let name = &tool.name;
        let Some(tool_path) = &tool.tool_path else {
            let problem =
                "has no tool_path; give the directory of one, as planish toolpath makes it";
            return Err(failure_of(name, problem.into()));
        };
        let tif =
            inputs.read_tool_with_doubt(&format!("tif-{name}"), &directory.join(&tool.tif))?;
        let path = inputs.read(&format!("tool-path-{name}"), &directory.join(tool_path))?;
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
            setup: self.tool.setup_errors(),
        }
    }

    /// Returns the tool with the price of mounting it, in half the mean square of the residual.
    fn rack_tool(&self) -> RackTool<'_> {
        RackTool { task: self.task(), change_nm2: self.tool.change_nm2() }
    }
}

/// Returns the reason of a negative verdict: the residual is not kept at any price. `None` if it is.
fn not_kept(keeping: Keeping) -> Option<String> {
    let Keeping { keep_rms_nm, price_factor, is_kept } = keeping;
    if is_kept {
        return None;
    }
    Some(format!(
        "more than {keep_rms_nm:.4} nm remain even at {price_factor:.1e} of the prices of a second; add a tool that \
         reaches shorter waves, or keep a larger residual"
    ))
}

/// Returns the failure of a tool with its name.
fn failure_of(name: &str, problem: String) -> Failure {
    Failure::new(format!("tool {name:?}: {problem}"))
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
