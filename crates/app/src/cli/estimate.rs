//! Estimates: residual against time without a motion, on a map of few pixels, made while the user chooses.
//!
//! An estimate runs the stage `estimate` of a pipeline. A later one replaces it, and so does a step of the session.
//!
//! ```text
//! residual^2 = R^2 + W^2                                                                                             (1)
//! ```
//!
//! R is the residual of the plan on the binned map, RMS, and W the RMS within its pixels about their planes. The tool is
//! wider than these pixels, so that it removes almost nothing of W.

use std::{
    fs::{self, File},
    io::Write,
    process::{Command, Stdio},
    sync::PoisonError,
    time::Instant,
};

use planish_app::{
    choice::{
        BINNED_MAP, Estimate, EstimateInputs, MachineChoice, PartSource, PlanChoice, ToolSource,
        Words,
    },
    refusal::Refusal,
};
use planish_handoff::{Artifact, Inputs, Running, words};
use planish_types::{Surface, Tif, ToolPath};
use serde::{Deserialize, Serialize};

use super::{
    map::unreadable,
    server::{Server, read_json},
};

/// Pixels of the binned map within the full width at half maximum of the tool. Larger: more pixels, and slower
/// estimates. Smaller: the map no longer shows what the tool can correct. Derived: a Gaussian tool lets through less than
/// 1e-13 of a wave of two such pixels, exp(-2 (pi sigma / L)^2) with L = FWHM / 3 and FWHM = 2.355 sigma.
const PIXELS_PER_WIDTH: f64 = 6.0;
/// Messages of the last estimate, in the directory of the session.
const LOG: &str = "estimate.log";

/// The estimate that runs, and the number of the latest one that was asked for.
#[derive(Default)]
pub struct Latest {
    number: u64,
    child: Option<u32>,
}

/// Part and tool, by the numbers of their steps, for which the binned map was made, and what it hides.
#[derive(Clone, Copy, PartialEq)]
pub struct BinnedFor {
    steps: [u64; 2],
    square_px: usize,
    within_rms_nm: f64,
    width_mm: f64,
    area_mm2: f64,
}

/// Answers to a wish for an estimate. Each is an answer that the page expects, and no error of HTTP.
#[derive(Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum EstimateAnswer {
    /// The estimate.
    Estimate(Box<EstimateReport>),
    /// A later choice has replaced it, or a step runs.
    Replaced,
    /// The choice has none: the sentence that says why.
    Refused(String),
}

/// An estimate, as the page gets it.
#[derive(Serialize)]
pub struct EstimateReport {
    /// Command line of the estimate.
    command: Words,
    /// Residual against time, with rising time.
    points: Vec<Point>,
    /// The point of the wanted worth of time.
    chosen: Point,
    /// Length of the path of the plan, mm.
    length_mm: f64,
    /// Factor by which the lines are further apart than those of the plan, at least 1.
    coarser: f64,
    /// Side of the squares of pixels that became one, px.
    square_px: usize,
    /// Wall time of the estimate, s.
    took_s: f64,
    /// Warnings of the programs.
    warnings: Vec<String>,
}

/// A point of the front, as its file has it.
#[derive(Clone, Copy, Serialize, Deserialize)]
struct Point {
    price_nm2_per_s: f64,
    rms_nm: f64,
    time_s: f64,
}

/// The front, as its file has it.
#[derive(Deserialize)]
struct FrontFile {
    points: Vec<Point>,
    chosen: Point,
}

/// Outcome of the binning, as its manifest has it.
#[derive(Deserialize)]
struct BinningOutcome {
    within_rms_nm: f64,
}

impl Latest {
    /// Ends the estimate that runs, and lets no earlier one go on. Returns the number of the next one.
    pub fn replace(&mut self) -> u64 {
        self.number += 1;
        if let Some(child) = self.child {
            Running::end(child);
        }
        self.number
    }
}

/// Returns the answer to the wish for an estimate of a plan.
///
/// # Errors
/// Fails if the disk or the system does.
pub fn answer(server: &Server, choice: &PlanChoice) -> Result<EstimateAnswer, Refusal> {
    match estimate(server, choice) {
        Ok(report) => Ok(EstimateAnswer::Estimate(Box::new(report))),
        Err(Refusal { status: 409, .. }) => Ok(EstimateAnswer::Replaced),
        Err(Refusal { status: 400, sentence }) => Ok(EstimateAnswer::Refused(sentence)),
        Err(refusal) => Err(refusal),
    }
}

/// Returns an estimate of a plan.
///
/// # Errors
/// Refuses it (400) before part, tool and machine are there, for a fixture whose tool varies, and when the programs
/// refuse it; and (409) while a step runs, or when a later choice has replaced it.
fn estimate(server: &Server, choice: &PlanChoice) -> Result<EstimateReport, Refusal> {
    let begun = Instant::now();
    let Begun { number, steps, machine, tool } = begin(server)?;
    let mut binned = server.binned.lock().unwrap_or_else(PoisonError::into_inner);
    let description = server.pipelines.get(&choice.pipeline);
    let description = description.ok_or_else(|| Refusal::of_value("there is no such pipeline"))?;
    // Settings that are refused cost no map.
    choice.setting_words(description, &[])?;
    File::create(server.files.dir.join(LOG)).map_err(|e| Refusal::new(500, e.to_string()))?;
    let known = match *binned {
        Some(known) if known.steps == steps => known,
        _ => {
            let made = bin(server, number, (steps, tool.tif()))?;
            *binned = Some(made);
            made
        }
    };
    let file = server.files.dir.join(machine.path(&description.folder)?);
    let limits = Inputs::new().read_machine(&file).map_err(|e| unreadable(&e))?.limits_on_part();
    // The faster axis bounds the speed along the path, as in the plan.
    let fastest = limits.max_velocity_mm_per_s().into_iter().fold(0.0, f64::max);
    let BinnedFor { width_mm, area_mm2, .. } = known;
    let of = EstimateInputs { tool: &tool, width_mm, area_mm2, floor_s_per_mm: fastest.recip() };
    let made = choice.estimate(&machine, description, &of)?;
    run(server, number, &made.command)?;
    report(server, made, known, begun)
}

/// An estimate that begins.
struct Begun {
    /// Number of the estimate.
    number: u64,
    /// Numbers of the steps of part and tool.
    steps: [u64; 2],
    machine: MachineChoice,
    tool: ToolSource,
}

/// Begins a new estimate, which replaces the one that runs.
fn begin(server: &Server) -> Result<Begun, Refusal> {
    let mut live = server.idle()?;
    let session = &live.session;
    let part = session.part.as_ref().filter(|step| step.done().is_some());
    let tool = session.tool.as_ref().filter(|step| step.done().is_some());
    let (Some(part), Some(tool), Some(machine)) = (part, tool, session.machine.clone()) else {
        return Err(Refusal::of_value(
            "an estimate needs part, tool and machine; finish these steps",
        ));
    };
    if let (PartSource::Fixture(_), ToolSource::Fixture(name)) =
        (&part.choice.source, &tool.choice.source)
        && fs::exists(format!("{}fixtures/{name}.tool", server.folder())).unwrap_or(false)
    {
        return Err(Refusal::of_value(format!(
            "the tool of {name} varies over the part, and an estimate takes it as constant; plan to see the result"
        )));
    }
    let steps = [part.number, tool.number];
    let tool = tool.choice.source.clone();
    Ok(Begun { number: live.estimate.replace(), steps, machine, tool })
}

/// Makes the binned map of the part for the tool.
fn bin(server: &Server, number: u64, (steps, tif): ([u64; 2], &str)) -> Result<BinnedFor, Refusal> {
    let mut inputs = Inputs::new();
    let tool = server.files.inside(tif)?;
    let tif: Tif = inputs.read_tool("tif", &tool).map_err(|e| unreadable(&e))?;
    let map = server.files.inside("part/prepared")?;
    let map: Surface = inputs.read("surface", &map).map_err(|e| unreadable(&e))?;
    let pixel_mm = map.grid().x.step_mm().max(map.grid().y.step_mm());
    let (rows, columns) = map.grid().shape();
    // The shorter side keeps two squares.
    let most = rows.min(columns).div_ceil(2).max(1) as f64;
    let square_px = (tif.half_maximum_width_mm() / PIXELS_PER_WIDTH / pixel_mm).floor();
    let square_px = square_px.clamp(1.0, most) as usize;
    let command: Words = ["planish", "surface", "bin", "--surface", "part/prepared"]
        .map(String::from)
        .into_iter()
        .chain([format!("--square-px={square_px}"), "--out".into(), BINNED_MAP.into()])
        .chain(["--force".into()])
        .collect();
    run(server, number, &command)?;
    let made = server.files.inside(BINNED_MAP)?;
    let manifest = inputs.read_manifest("surface", &made, Surface::KIND);
    let manifest = manifest.map_err(|e| unreadable(&e))?;
    let outcome: BinningOutcome =
        manifest.read_outcome(&made, "estimate again").map_err(|e| unreadable(&e))?;
    // The path goes over the edges by half the tool.
    let sides_mm = [(&map.grid().x, &tif.grid().x), (&map.grid().y, &tif.grid().y)]
        .map(|(part, tool)| part.end_mm() - part.start_mm() + tool.end_mm() - tool.start_mm());
    Ok(BinnedFor {
        steps,
        square_px,
        within_rms_nm: outcome.within_rms_nm,
        width_mm: tif.half_maximum_width_mm(),
        area_mm2: sides_mm.iter().product(),
    })
}

/// Runs a command of the estimate `number` to its end, with its messages in the log.
fn run(server: &Server, number: u64, command: &Words) -> Result<(), Refusal> {
    let failed = |e: &dyn std::fmt::Display| Refusal::new(500, format!("cannot estimate: {e}"));
    let replaced = || Refusal::new(409, "a later choice has replaced this estimate");
    let log = server.files.dir.join(LOG);
    let mut log = File::options().append(true).open(log).map_err(|e| failed(&e))?;
    writeln!(log, "$ {}", words::join(command)).map_err(|e| failed(&e))?;
    let program = std::env::current_exe().map_err(|e| failed(&e))?;
    let mut process = Command::new(program);
    process
        .args(command.get(1..).unwrap_or_default())
        .current_dir(&server.files.dir)
        .stdin(Stdio::null())
        .stdout(log.try_clone().map_err(|e| failed(&e))?)
        .stderr(log.try_clone().map_err(|e| failed(&e))?);
    let running = {
        let mut live = server.live();
        if live.estimate.number != number {
            return Err(replaced());
        }
        let running = Running::start(&mut process).map_err(|e| failed(&e))?;
        live.estimate.child = Some(running.id());
        running
    };
    let status = running.wait().map_err(|e| failed(&e))?;
    let mut live = server.live();
    live.estimate.child = None;
    if live.estimate.number != number {
        return Err(replaced());
    }
    drop(live);
    match status.code() {
        Some(0 | 1) => Ok(()),
        _ => {
            let messages = server.files.text_end(LOG);
            let error = messages.lines().rfind(|line| line.starts_with("error: "));
            Err(Refusal::of_value(error.unwrap_or("the estimate ended early").to_string()))
        }
    }
}

/// Returns the numbers of an estimate whose commands have ended.
fn report(
    server: &Server,
    Estimate { command, out, coarser }: Estimate,
    binned: BinnedFor,
    begun: Instant,
) -> Result<EstimateReport, Refusal> {
    let mut inputs = Inputs::new();
    let path = server.files.inside(&format!("{out}/tool_path"))?;
    let path: ToolPath = inputs.read("tool-path", &path).map_err(|e| unreadable(&e))?;
    let front = server.files.inside(&format!("{out}/front.json"))?;
    let front: FrontFile = read_json(&server.files.read(&front)?)?;
    // (1)
    let whole = |p: Point| Point { rms_nm: p.rms_nm.hypot(binned.within_rms_nm), ..p };
    let messages = server.files.text_end(LOG);
    let warnings = messages.lines().filter(|line| line.starts_with("warning: "));
    Ok(EstimateReport {
        command,
        points: front.points.into_iter().map(whole).collect(),
        chosen: whole(front.chosen),
        length_mm: coarser * (0..path.len()).map(|i| path.segment_length_mm(i)).sum::<f64>(),
        coarser,
        square_px: binned.square_px,
        took_s: begun.elapsed().as_secs_f64(),
        warnings: warnings.map(String::from).collect(),
    })
}
