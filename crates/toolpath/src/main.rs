//! `planish-toolpath`: tool paths over a clear aperture.

use std::{path::PathBuf, process::ExitCode};

use clap::{Args, Parser, Subcommand, ValueEnum};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, Task, Writer,
    flags::{OutputArgs, OutputFileArgs, PathArgs},
    run, say, task, warn,
};
use planish_toolpath::{
    Construction, LineOrder, MazeSettings, MultiPitchSettings, PathStatistics, PitchLimit,
    RandomAdaptiveSettings, RasterSettings, Scan, SpiralSettings, Tree, Turn, maze, multi_pitch,
    pitch_limit, random_adaptive, raster, spiral, statistics, svg, time_lower_bound_s,
};
use planish_types::{Surface, Tif, ToolPath, plausible};
use serde::Serialize;
use serde_json::{Value, json};

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-toolpath raster --surface out/surface --tif tool --pitch-mm 1 --step-mm 1 --out out/tool_path\n\
    \x20 planish-toolpath maze --surface out/surface --tif tool --pitch-mm 1 --step-mm 1 --seed 2 --out out/tool_path\n\
    \x20 planish-toolpath draw --tool-path out/tool_path --surface out/surface --out path.svg";

/// Tool paths over the clear aperture: the valid pixels of a map
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    method: Method,
}

#[derive(Debug, Subcommand)]
enum Method {
    /// Parallel lines, back and forth, joined by turn-arounds beyond the aperture
    Raster(RasterArgs),
    /// One random closed line through every cell of a lattice, which never crosses itself
    Maze(MazeArgs),
    /// One random closed line that never crosses itself, denser where more is to be removed
    RandomAdaptive(RandomAdaptiveArgs),
    /// Regions by the depth to be removed, each a raster of its own pitch
    MultiPitch(MultiPitchArgs),
    /// One line from the inside out, for round parts
    Spiral(SpiralArgs),
    /// Print the statistics of a path as JSON
    Inspect(InspectArgs),
    /// Draw a path as SVG
    Draw(DrawArgs),
}

/// What every path needs.
#[derive(Debug, Args)]
struct RegionArgs {
    /// Map whose valid pixels (their centres) are the clear aperture [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Tool influence function, for the overscan and the pitch limit [tif artifact]
    #[arg(long, value_name = "DIR", required_unless_present = "overscan_mm")]
    tif: Option<PathBuf>,
    /// Distance between neighbouring lines, mm
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    pitch_mm: f64,
    /// How far the path goes beyond the aperture, mm [default: half the TIF's size]
    #[arg(long, value_name = "O", allow_negative_numbers = true)]
    overscan_mm: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
struct RasterArgs {
    #[command(flatten)]
    region: RegionArgs,
    /// Longest segment, mm
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: f64,
    /// Direction of the lines
    #[arg(long, value_enum, default_value_t = ScanArg::X)]
    scan: ScanArg,
    /// Direction of the lines from x towards y, degrees: 0 and 90 are the scans along x and y
    #[arg(long, value_name = "A", conflicts_with = "scan", allow_negative_numbers = true)]
    angle_deg: Option<f64>,
    /// How consecutive lines are joined [default: square; lift for lines in one direction or in
    /// random order]
    #[arg(long, value_enum)]
    turn: Option<Turn>,
    /// Run all lines in the same direction, and return with the tool off
    #[arg(long)]
    one_directional: bool,
    /// Which line follows which
    #[arg(long, value_enum, default_value_t = LineOrderArg::Sequential)]
    line_order: LineOrderArg,
    /// Seed of the random line order [default: 1]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Let the distance of the lines follow the mean of the map along them, from A to B; then
    /// --pitch-mm is the distance where that mean is the map's
    #[arg(
        long,
        value_names = ["A", "B"],
        num_args = 2,
        conflicts_with = "line_origin_mm",
        allow_negative_numbers = true
    )]
    pitch_range_mm: Option<Vec<f64>>,
    /// Coordinate of one line across the lines (y for lines along x), mm [default: lines centred
    /// on the region]
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    line_origin_mm: Option<f64>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ScanArg {
    X,
    Y,
}

#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
enum LineOrderArg {
    /// The next one
    Sequential,
    /// Every other line, then back over the lines between them
    BiStep,
    /// A random one; the tool is lifted between lines
    Random,
}

#[derive(Debug, Args)]
struct MazeArgs {
    #[command(flatten)]
    region: RegionArgs,
    /// Longest segment, mm [default: the pitch; with rounded corners their radius]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: Option<f64>,
    /// Seed of the random numbers
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Random tree that the path walks around
    #[arg(long, value_enum, default_value_t = TreeArg::DepthFirst)]
    tree: TreeArg,
    /// Chance that depth-first keeps its direction where that is possible, 0 to 1 [default: 0]
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    straightness: Option<f64>,
    /// Radius of the corners, mm: from 0 (sharp) to half the pitch
    #[arg(long, value_name = "R", default_value_t = 0.0, allow_negative_numbers = true)]
    corner_radius_mm: f64,
    /// Leave out the step that leads back to the start
    #[arg(long)]
    open: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum TreeArg {
    /// Long corridors
    DepthFirst,
    /// Every spanning tree equally likely: more turns
    Wilson,
}

#[derive(Debug, Args)]
struct RandomAdaptiveArgs {
    #[command(flatten)]
    region: RegionArgs,
    /// Wanted length of a step, mm [default: the nodes of the construction]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: Option<f64>,
    /// Seed of the random numbers
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Exponent of the density in the desired removal: 0 (uniform) to 1 (proportional)
    #[arg(long, value_name = "B", default_value_t = 1.0, allow_negative_numbers = true)]
    contrast: f64,
    /// What the path goes around
    #[arg(long, value_enum, default_value_t = Construction::MeshTree)]
    construction: Construction,
    /// Passes of corner cutting; each halves the turns and doubles the points
    #[arg(long, value_name = "K", default_value_t = 1)]
    rounding_passes: u32,
}

#[derive(Debug, Args)]
struct MultiPitchArgs {
    /// Desired removal; its valid pixels (their centres) are the clear aperture [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Tool influence function [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Feed that shall not be exceeded, mm/s
    #[arg(long, value_name = "V", allow_negative_numbers = true)]
    max_velocity_mm_per_s: f64,
    /// Classes of depth
    #[arg(long, value_name = "M", default_value_t = 4)]
    classes: usize,
    /// Smallest pitch: what the machine can position, mm
    #[arg(long, value_name = "A", default_value_t = 0.1, allow_negative_numbers = true)]
    min_pitch_mm: f64,
    /// Largest pitch, mm [default: a sixth of the TIF's size, or less where the lines of a Gaussian
    /// as large would leave a ripple of 0.1 %]
    #[arg(long, value_name = "B", allow_negative_numbers = true)]
    max_pitch_mm: Option<f64>,
    /// Least area of a region, mm^2 [default: 25 pitches squared, at least 50]
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    min_area_mm2: Option<f64>,
    /// Longest segment, mm
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: f64,
    /// How far the path goes beyond the aperture, mm [default: half the TIF's size]
    #[arg(long, value_name = "O", allow_negative_numbers = true)]
    overscan_mm: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
struct SpiralArgs {
    #[command(flatten)]
    region: RegionArgs,
    /// Longest segment, mm
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: f64,
}

#[derive(Debug, Args)]
struct InspectArgs {
    #[command(flatten)]
    path: PathArgs,
    /// Map whose valid pixels are the clear aperture [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Machine and its limits, for the least time [JSON]
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct DrawArgs {
    #[command(flatten)]
    path: PathArgs,
    /// Map whose valid pixels, the clear aperture, are drawn in grey [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: Option<PathBuf>,
    #[command(flatten)]
    output: OutputFileArgs,
}

/// What the manifest says about a path.
#[derive(Serialize)]
struct Outcome {
    #[serde(flatten)]
    statistics: PathStatistics,
    /// Left out without a TIF.
    #[serde(skip_serializing_if = "Option::is_none")]
    pitch_limit: Option<PitchLimit>,
    /// What only this method has to say.
    #[serde(flatten)]
    own: Value,
    warnings: Vec<String>,
}

fn main() -> ExitCode {
    let method = planish_handoff::parse::<Cli>().method;
    run(move || match method {
        Method::Raster(args) => raster_stage(&args),
        Method::Maze(args) => maze_stage(&args),
        Method::RandomAdaptive(args) => random_adaptive_stage(&args),
        Method::MultiPitch(args) => multi_pitch_stage(args),
        Method::Spiral(args) => spiral_stage(&args),
        Method::Inspect(args) => inspect(&args),
        Method::Draw(args) => draw(&args),
    })
}

fn raster_stage(args: &RasterArgs) -> Result<Status, Failure> {
    let mut on = Region::read(&args.region)?;
    let order = match (args.line_order, args.seed) {
        (LineOrderArg::Sequential, None) => LineOrder::Sequential,
        (LineOrderArg::BiStep, None) => LineOrder::BiStep,
        (LineOrderArg::Random, seed) => LineOrder::Random { seed: seed.unwrap_or(1) },
        (_, Some(_)) => return Err(Failure::new("seed: only --line-order random has one")),
    };
    let lifts = args.one_directional || args.line_order == LineOrderArg::Random;
    let settings = RasterSettings {
        pitch_mm: args.region.pitch_mm,
        step_mm: args.step_mm,
        overscan_mm: on.overscan_mm,
        scan: match (args.angle_deg, args.scan) {
            (Some(angle_deg), _) => Scan::Angle { angle_deg },
            (None, ScanArg::X) => Scan::X,
            (None, ScanArg::Y) => Scan::Y,
        },
        turn: args.turn.unwrap_or(if lifts { Turn::Lift } else { Turn::Square }),
        line_origin_mm: args.line_origin_mm,
        order,
        one_directional: args.one_directional,
        pitch_range_mm: args.pitch_range_mm.as_ref().map(|range| [range[0], range[1]]),
    };
    let mut output = match on.begin(&task!("raster", &settings))? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let path = raster(&on.surface, &settings)?;
    // What the warnings compare with is the largest distance of the lines.
    on.pitch_mm = settings.pitch_range_mm.map_or(settings.pitch_mm, |[_, most]| most);
    let mut warnings = Vec::new();
    let across = settings.scan.axes()[1];
    let w: Vec<f64> = path.point_mm().iter().map(|p| p[0] * across[0] + p[1] * across[1]).collect();
    // Less than any pitch that can be meant, more than rounding.
    if w.iter().all(|v| (v - w[0]).abs() < 1e-6 * settings.pitch_mm) {
        warnings.push(format!(
            "one line only: a pitch of {} mm leaves no room for a second one",
            settings.pitch_mm
        ));
    }
    on.write(&mut output, &path, json!({}), warnings)
}

fn maze_stage(args: &MazeArgs) -> Result<Status, Failure> {
    let on = Region::read(&args.region)?;
    let (pitch_mm, corner_radius_mm) = (args.region.pitch_mm, args.corner_radius_mm);
    let settings = MazeSettings {
        pitch_mm,
        step_mm: args.step_mm.unwrap_or(match corner_radius_mm {
            r if r > 0.0 => r,
            _ => pitch_mm,
        }),
        overscan_mm: on.overscan_mm,
        corner_radius_mm,
        tree: match (args.tree, args.straightness) {
            (TreeArg::DepthFirst, s) => Tree::DepthFirst { straightness: s.unwrap_or(0.0) },
            (TreeArg::Wilson, None) => Tree::Wilson,
            (TreeArg::Wilson, Some(_)) => {
                return Err(Failure::new("straightness: only --tree depth-first has one"));
            }
        },
        open: args.open,
        seed: args.seed,
    };
    let mut output = match on.begin(&task!("maze", &settings))? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let made = maze(&on.surface, &settings)?;
    let own = json!({ "cells": made.cells, "cells_left_out": made.cells_left_out });
    on.write(&mut output, &made.path, own, Vec::new())
}

fn random_adaptive_stage(args: &RandomAdaptiveArgs) -> Result<Status, Failure> {
    let mut on = Region::read(&args.region)?;
    let settings = RandomAdaptiveSettings {
        pitch_mm: args.region.pitch_mm,
        overscan_mm: on.overscan_mm,
        step_mm: args.step_mm,
        contrast: args.contrast,
        construction: args.construction,
        rounding_passes: args.rounding_passes,
        seed: args.seed,
    };
    let mut output = match on.begin(&task!("random-adaptive", &settings))? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let made = random_adaptive(&on.surface, &settings)?;
    // What the warnings compare with is the pitch where the path is least dense.
    on.pitch_mm = (1e3 * made.report.largest_spacing_mm).ceil() / 1e3;
    on.write(&mut output, &made.path, serde_json::to_value(made.report)?, Vec::new())
}

fn multi_pitch_stage(args: MultiPitchArgs) -> Result<Status, Failure> {
    let region = RegionArgs {
        surface: args.surface,
        tif: Some(args.tif),
        pitch_mm: args.min_pitch_mm,
        overscan_mm: args.overscan_mm,
        output: args.output,
    };
    let mut on = Region::read(&region)?;
    let Some(tif) = on.tif.take() else { return Err(Failure::new("tif: give --tif")) };
    let max_velocity_mm_per_s = args.max_velocity_mm_per_s;
    let settings = MultiPitchSettings {
        classes: args.classes,
        max_velocity_mm_per_s,
        min_pitch_mm: args.min_pitch_mm,
        max_pitch_mm: args.max_pitch_mm.unwrap_or_else(|| {
            let limit = pitch_limit(&tif);
            limit.tif_size_sixth_mm.min(limit.ripple_mm)
        }),
        min_area_mm2: args.min_area_mm2,
        step_mm: args.step_mm,
        overscan_mm: on.overscan_mm,
    };
    let mut output = match on.begin(&task!("multi-pitch", &settings))? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let made = multi_pitch(&on.surface, &tif, &settings)?;
    on.tif = Some(tif);
    let classes = &made.report.classes;
    on.pitch_mm = classes[0].pitch_mm;
    let mut warnings = Vec::new();
    for (k, class) in classes.iter().enumerate().skip(1) {
        let fastest = class.least_depth_velocity_mm_per_s;
        let fastest = fastest.filter(|v| *v > max_velocity_mm_per_s * 1.001);
        if let Some(v) = fastest {
            warnings.push(format!(
                "class {k} (pitch {:.4} mm) needs up to {v:.4} mm/s, more than \
                 {max_velocity_mm_per_s} mm/s; give a larger --max-pitch-mm, or expect more \
                 removal there than asked for",
                class.pitch_mm
            ));
        }
    }
    on.write(&mut output, &made.path, serde_json::to_value(&made.report)?, warnings)
}

fn spiral_stage(args: &SpiralArgs) -> Result<Status, Failure> {
    let on = Region::read(&args.region)?;
    let settings = SpiralSettings {
        pitch_mm: args.region.pitch_mm,
        step_mm: args.step_mm,
        overscan_mm: on.overscan_mm,
    };
    let mut output = match on.begin(&task!("spiral", &settings))? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    on.write(&mut output, &spiral(&on.surface, &settings)?, json!({}), Vec::new())
}

/// A run of a method: where the path shall go.
struct Region {
    inputs: Inputs,
    output: OutputArgs,
    surface: Surface,
    tif: Option<Tif>,
    pitch_mm: f64,
    overscan_mm: f64,
}

impl Region {
    fn read(args: &RegionArgs) -> Result<Self, Failure> {
        let mut inputs = Inputs::new();
        let surface = inputs.read("surface", &args.surface)?;
        let tif: Option<Tif> = args.tif.as_ref().map(|dir| inputs.read("tif", dir)).transpose()?;
        if let Some(tif) = &tif {
            plausible::check_tool(&surface, tif)?;
            plausible::check_pitch(tif, args.pitch_mm)?;
        }
        let half_size_mm = tif.as_ref().map(|t| t.half_size_mm()).map(|[x, y]| x.max(y));
        let overscan_mm = args.overscan_mm.or(half_size_mm).ok_or_else(|| {
            Failure::new("overscan: unknown; give --overscan-mm, or --tif for half its size")
        })?;
        let (output, pitch_mm) = (args.output.clone(), args.pitch_mm);
        Ok(Self { inputs, output, surface, tif, pitch_mm, overscan_mm })
    }

    fn begin(&self, task: &Task) -> Result<Begin, Failure> {
        Ok(Output::directory(&self.output, ToolPath::KIND).begin(task, &self.inputs)?)
    }

    fn write(
        &self,
        output: &mut Writer,
        path: &ToolPath,
        own: Value,
        mut warnings: Vec<String>,
    ) -> Result<Status, Failure> {
        let (s, pitch_mm) = (statistics(path, &self.surface), self.pitch_mm);
        let limit = self.tif.as_ref().map(pitch_limit);
        if let Some(l) = limit.filter(|l| pitch_mm > l.tif_size_sixth_mm) {
            warnings.push(format!(
                "the pitch of {pitch_mm} mm is larger than a sixth of the TIF's size ({:.4} mm): \
                 the lines will show",
                l.tif_size_sixth_mm
            ));
        }
        if let Some(far) = s.coverage_mm.filter(|far| *far > pitch_mm) {
            warnings.push(format!(
                "a pixel is {far:.4} mm from the path, more than the pitch of {pitch_mm} mm: give \
                 a smaller pitch or a larger overscan"
            ));
        }
        for warning in &warnings {
            warn(warning);
        }
        let outcome = Outcome { statistics: s, pitch_limit: limit, own, warnings };
        output.write(path, serde_json::to_value(outcome)?, &Status::Done)?;
        say(format!(
            "planish-toolpath: {} points, {:.1} mm in {} pass(es), {} lift(s), step <= {:.4} mm",
            s.points, s.length_mm, s.passes, s.lifts, s.longest_step_mm
        ));
        Ok(Status::Done)
    }
}

fn inspect(args: &InspectArgs) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let path = args.path.read(&mut inputs)?;
    let surface: Surface = inputs.read("surface", &args.surface)?;
    let mut found = serde_json::to_value(statistics(&path, &surface))?;
    if let Some(file) = &args.machine {
        found["least_time_s"] = time_lower_bound_s(&path, &inputs.read_machine(file)?).into();
    }
    say(serde_json::to_string_pretty(&found)?);
    Ok(Status::Done)
}

fn draw(args: &DrawArgs) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let path = args.path.read(&mut inputs)?;
    let surface: Option<Surface> =
        args.surface.as_ref().map(|dir| inputs.read("surface", dir)).transpose()?;
    let output = args.output.begin(&inputs)?;
    output.write(svg(&path, surface.as_ref()).as_bytes())?;
    let out = args.output.out.display();
    say(format!("planish-toolpath: {} segments drawn to {out}", path.len()));
    Ok(Status::Done)
}
