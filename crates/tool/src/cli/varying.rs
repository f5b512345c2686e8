//! `planish tool rate`, `incidence`, `spots`, `edge`, `turned`, `footprint` and `time`: tools that vary over the part
//! or in time. A place is a point (x, y) at which the tool stands.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use ndarray::{Array2, Zip};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, Tool, as_command, flags::OutputArgs, say,
    warn, with_flags,
};
use planish_tool::varying::{
    Carrier, Direction, Footprint, LocalTool, LowRank, LowRankReport, LowRankSettings, Overhang,
    Parameter, Places, PressureLaw, RateLaw, Samples, Spots, ToolFrame, Used, low_rank,
    low_rank_by_azimuth, low_rank_by_heading, tool_at, turned,
};
use planish_types::{
    Axis, Grid, Invalid, PixelFactor, Surface, Tif, TimeFactor, VaryingTif, doubts, file_text,
};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;

use super::Name;

/// Largest table of parameter and factor that is read, bytes; a larger file is refused. Larger: more memory for a wrong
/// file. Smaller: long tables are refused.
const LARGEST_TABLE_BYTES: u64 = 1 << 22;

/// Place at which a rate law acts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
enum Acts {
    /// The factor belongs to the pixel that is removed
    Pixel,
    /// The factor belongs to the place of the tool
    Tool,
}

/// Wanted error of kernels and weights without `--error`: root mean square over the places, relative to the tool.
/// Larger: plans that miss the real tool. Smaller: more kernels, each of which costs as much as a constant tool.
const DEFAULT_ERROR: f64 = 1e-3;

/// Largest number of kernels without `--max-rank`. Larger: plans that take hours. Smaller: tools that are less exact
/// than asked for.
const DEFAULT_MAX_RANK: usize = 64;

/// Difference between the footprints of two orders of the tilts, relative to the footprint, up to which the user is not
/// warned. Larger: a spot that lies turned is not noticed. Smaller: warnings for spots that are nearly round. Chosen:
/// the wanted error of kernels and weights.
const MOST_OF_OTHER_TILTS: f64 = DEFAULT_ERROR;

/// Exactness of the tool.
#[derive(Debug, Args)]
struct ExactArgs {
    /// Wanted error of the kernels and weights, relative to the tool (root mean square over the places) [default:
    /// 0.001]
    #[arg(long, value_name = "E")]
    error: Option<f64>,
    /// Largest number of kernels [default: 64]
    #[arg(long, value_name = "K")]
    max_rank: Option<usize>,
}

impl ExactArgs {
    fn settings(&self) -> LowRankSettings {
        LowRankSettings {
            error: self.error.unwrap_or(DEFAULT_ERROR),
            max_rank: self.max_rank.unwrap_or(DEFAULT_MAX_RANK),
        }
    }
}

/// The map, and how exact the tool is.
#[derive(Debug, Args)]
struct MakeArgs {
    /// Map of the part, whose valid pixels are the part [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    #[command(flatten)]
    exact: ExactArgs,
    /// Distance of the places of the weights, mm [default: by the error]
    #[arg(long, value_name = "MM")]
    spacing_mm: Option<f64>,
    /// Distance beyond the valid pixels up to which the tool is known, mm [default: the half size of the TIF]
    #[arg(long, value_name = "MM")]
    beyond_mm: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

impl MakeArgs {
    /// Refuses flags of kernels and weights if the factor acts on the pixels, because such a tool has neither.
    fn refuse_all(&self) -> Result<(), Failure> {
        let Self { exact: ExactArgs { error, max_rank }, spacing_mm, beyond_mm, .. } = self;
        let flags = [
            ("--error", error.is_some()),
            ("--max-rank", max_rank.is_some()),
            ("--spacing-mm", spacing_mm.is_some()),
            ("--beyond-mm", beyond_mm.is_some()),
        ];
        match flags.iter().find(|(_, is_there)| *is_there) {
            None => Ok(()),
            Some((flag, _)) => Err(Failure::new(format!(
                "{flag}: has no effect on a factor of the pixels, which is exact; leave it out, or give --acts-at tool"
            ))),
        }
    }

    /// Returns the distance beyond the valid pixels up to which the tool is known, mm. Without the flag it is the
    /// larger half size of `tif`.
    fn beyond_mm(&self, tif: &Tif) -> f64 {
        let [x, y] = tif.half_size_mm();
        self.beyond_mm.unwrap_or(x.max(y))
    }

    /// Returns the corners [low, high] of the rectangle of tool positions: the map, and the distance beyond it.
    fn rectangle(&self, surface: &Surface, tif: &Tif) -> [[f64; 2]; 2] {
        let grid = surface.grid();
        let beyond = self.beyond_mm(tif);
        let ends = [&grid.x, &grid.y].map(|a| [a.start_mm(), a.end_mm()]);
        [0, 1].map(|end| {
            let sign = if end == 0 { -1.0 } else { 1.0 };
            [0, 1].map(|k| ends[k][end] + sign * beyond)
        })
    }

    /// Checks the function `parameter` of the place at the corners of the rectangle of tool positions before anything
    /// is written. If it is undefined anywhere, it is undefined at a corner.
    fn check_corners<T>(
        &self,
        (surface, tif): (&Surface, &Tif),
        parameter: impl Fn([f64; 2]) -> Result<T, Invalid>,
    ) -> Result<(), Failure> {
        let [low, high] = self.rectangle(surface, tif);
        for p in [low, high, [low[0], high[1]], [high[0], low[1]]] {
            parameter(p).map_err(Failure::with_flags)?;
        }
        Ok(())
    }

    /// Computes kernels and weights of the tool `local_tool` on `offsets`, and writes them with the pixel and time
    /// factors of `base`. `counts` says at which places the tool is used. Refuses a `base` that turns with its motion.
    fn make<S: Serialize>(
        &self,
        name: Name,
        settings: &S,
        inputs: &Inputs,
        (surface, base): (&Surface, &Tif),
        (offsets, local_tool, counts): (Grid, Box<LocalTool<'_>>, Box<Used<'_>>),
    ) -> Result<Status, Failure> {
        base.same_in_all_directions("a second cause").map_err(Failure::with_flags)?;
        let shared = json!({
            "settings": settings, "low_rank": self.exact.settings(), "spacing_mm": self.spacing_mm,
            "beyond_mm": self.beyond_mm,
        });
        let task = name.task(&shared);
        let output = match Output::directory(&self.output, Tool::KIND).begin(&task, inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let places = (self.rectangle(surface, base), self.spacing_mm);
        let LowRank { tool, report } =
            low_rank(&offsets, places, &*local_tool, &*counts, &self.exact.settings())
                .map_err(Failure::with_flags)?;
        let factors = base.variation();
        let tool = VaryingTif {
            pixels: factors.and_then(|v| v.pixel_factor()).cloned(),
            time: factors.and_then(|v| v.time_factor()).cloned(),
            ..tool
        };
        write(output, name, Tif::varying(tool)?, Some(&report), &self.output.out)
    }
}

/// Returns a function that is true at places no farther than `beyond_mm` from the valid pixels.
fn near<'a>(places: &'a Places<'a>, beyond_mm: f64) -> Box<Used<'a>> {
    Box::new(move |p| places.parameter(Parameter::EdgeDistance, p).is_ok_and(|mm| mm >= -beyond_mm))
}

/// Writes a tool, and prints its main numbers. `report` is absent for tools without kernels and weights.
fn write(
    mut output: Box<planish_handoff::Writer>,
    name: Name,
    tif: Tif,
    report: Option<&LowRankReport>,
    out: &Path,
) -> Result<Status, Failure> {
    let status = match report.and_then(LowRankReport::negative) {
        None => Status::Done,
        Some(reason) => Status::Negative(with_flags(&reason)),
    };
    let rank = tif.variation().map_or(1, |v| v.components().len());
    let outcome = json!({
        "rank": rank,
        "mean_peak_nm_per_s": tif.peak_nm_per_s(),
        "mean_vrr_nm_mm2_per_s": tif.vrr_nm_mm2_per_s(),
        "report": report,
    });
    output.write(&Tool(tif), outcome, &status)?;
    let exact = report.map_or(String::new(), |r| {
        let samples = match r.samples {
            Samples::Places { places: [nx, ny], spacing_mm: [x, y] } => {
                format!("on {nx} x {ny} places {:.3} mm apart", x.max(y))
            }
            Samples::Azimuths { azimuths, spacing_deg } => {
                format!("at {azimuths} azimuths {spacing_deg:.2} degrees apart")
            }
            Samples::Headings { headings, spacing_deg } => {
                format!("at {headings} headings {spacing_deg:.2} degrees apart")
            }
        };
        format!(
            ", {samples}; error {:.1e} of the tool, largest {:.1e} at {}",
            r.error, r.largest_error, r.largest_error_at
        )
    });
    let kernels = if rank == 1 { "1 kernel".to_string() } else { format!("{rank} kernels") };
    say(format!("{}: tool of {kernels}{exact} -> {}", as_command(name.program), out.display()));
    Ok(status)
}

/// The form of the part.
#[derive(Debug, Args)]
struct FormArgs {
    /// Radius of curvature of a sphere with its vertex in the middle of the valid pixels, mm
    #[arg(long, value_name = "MM", allow_negative_numbers = true, conflicts_with = "form")]
    sphere_radius_mm: Option<f64>,
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]
    #[arg(long, value_name = "PATH")]
    form: Option<PathBuf>,
}

impl FormArgs {
    /// Returns the geometry of the part from the map `surface` and from the form that the flags give, if any.
    fn places<'a>(&self, surface: &'a Surface, inputs: &mut Inputs) -> Result<Places<'a>, Failure> {
        let places = Places::new(surface);
        match (self.sphere_radius_mm, &self.form) {
            (Some(radius_mm), _) => places.on_sphere(radius_mm).map_err(Failure::with_flags),
            (None, Some(path)) => {
                let form = inputs.read_form("form", path)?.form;
                places.with_form(form).map_err(|e| Failure::new(format!("{}: {e}", path.display())))
            }
            (None, None) => Ok(places),
        }
    }
}

#[derive(Debug, Args)]
pub struct RateArgs {
    /// Parameter of the place on which the tool depends
    #[arg(long, value_enum)]
    by: Parameter,
    #[command(flatten)]
    factor: FactorArgs,
}

impl RateArgs {
    pub fn run(&self, name: Name) -> Result<Status, Failure> {
        self.factor.run(name, self.by)
    }
}

/// The rate and its factor, whose parameter is known.
#[derive(Debug, Args)]
pub struct FactorArgs {
    /// Tool influence function where the factor is 1 [tif or tool artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    #[command(flatten)]
    form: FormArgs,
    /// Exponent m of cos(incidence)^m; below 0 the rate rises with the angle
    #[arg(long, value_name = "M", allow_negative_numbers = true, conflicts_with = "table")]
    exponent: Option<f64>,
    /// Table of parameter and factor, two numbers in each line, ascending [text file]
    #[arg(long, value_name = "FILE", required_unless_present = "exponent")]
    table: Option<PathBuf>,
    /// Where the factor acts [default: pixel for the incidence, tool for all others]
    #[arg(long, value_enum)]
    acts_at: Option<Acts>,
    #[command(flatten)]
    make: MakeArgs,
}

impl FactorArgs {
    pub fn run(&self, name: Name, by: Parameter) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let tif = inputs.read_tool_with_doubt("tif", &self.tif)?;
        let surface: Surface = inputs.read("surface", &self.make.surface)?;
        let places = self.form.places(&surface, &mut inputs)?;
        let law = match (self.exponent, &self.table) {
            (Some(_), _) if by != Parameter::Incidence => {
                return Err(Failure::new(
                    "--exponent: is of the cosine of the incidence; give --by incidence, or a --table",
                ));
            }
            (Some(exponent), _) => RateLaw::Cosine { exponent },
            (None, Some(file)) => {
                let pairs = read_table(&mut inputs, "table", file)?;
                if by == Parameter::Incidence {
                    doubt_incidences(&pairs);
                }
                RateLaw::Table { pairs }
            }
            (None, None) => return Err(Failure::new("--table: is missing; give it or --exponent")),
        };
        law.check().map_err(Failure::with_flags)?;
        let at_pixel = by == Parameter::Incidence;
        let acts = self.acts_at.unwrap_or(if at_pixel { Acts::Pixel } else { Acts::Tool });
        let settings = json!({
            "by": by, "law": law, "acts_at": acts, "sphere_radius_mm": self.form.sphere_radius_mm,
        });
        let factor = |p: [f64; 2]| places.parameter(by, p).map(|v| law.factor(v));
        if acts == Acts::Tool {
            self.make.check_corners((&surface, &tif), factor)?;
            let local_tool: Box<LocalTool<'_>> =
                Box::new(|p| tool_at(&tif, p) * factor(p).expect("checked at the corners"));
            let tool = (*tif.grid(), local_tool, near(&places, self.make.beyond_mm(&tif)));
            return self.make.make(name, &settings, &inputs, (&surface, &tif), tool);
        }
        self.make.refuse_all()?;
        let task = name.task(&settings);
        let output = match Output::directory(&self.make.output, Tool::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let grid = *surface.grid();
        let (ny, nx) = grid.shape();
        let values: Result<Vec<f64>, Invalid> = (0..ny * nx)
            .into_par_iter()
            .map(|i| factor([grid.x.coordinate_mm(i % nx), grid.y.coordinate_mm(i / nx)]))
            .collect();
        let values = values.map_err(Failure::with_flags)?;
        let factor = Array2::from_shape_vec((ny, nx), values).expect("one factor per pixel");
        let tif = with_factor(&tif, PixelFactor { grid, factor })?;
        write(output, name, tif, None, &self.make.output.out)
    }
}

/// Returns the tool `tif` with a further factor for each pixel; an earlier factor of the pixels is multiplied with it.
fn with_factor(tif: &Tif, mut pixels: PixelFactor) -> Result<Tif, Failure> {
    let mut numbers = tif.numbers();
    if let Some(before) = tif.variation().and_then(|v| v.factor_on(&pixels.grid)) {
        Zip::from(&mut pixels.factor).and(&*before).for_each(|f, before| *f *= before);
    }
    numbers.pixels = Some(pixels);
    Tif::varying(numbers).map_err(Failure::with_flags)
}

#[derive(Debug, Args)]
pub struct SpotsArgs {
    /// Parameter of the place on which the tool depends
    #[arg(long, value_enum)]
    by: Parameter,
    #[command(flatten)]
    form: FormArgs,
    /// Spot that was measured at this value of the parameter [tif artifact]; give it once for each spot
    #[arg(long, value_name = "VALUE=DIR", required = true, allow_hyphen_values = true)]
    spot: Vec<String>,
    #[command(flatten)]
    make: MakeArgs,
}

impl SpotsArgs {
    pub fn run(&self, name: Name) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let surface: Surface = inputs.read("surface", &self.make.surface)?;
        let places = self.form.places(&surface, &mut inputs)?;
        let mut spots = Vec::new();
        for spot in &self.spot {
            let parsed =
                spot.split_once('=').and_then(|(value, dir)| Some((value.parse().ok()?, dir)));
            let Some((value, dir)) = parsed else {
                let problem = format!("--spot: is {spot:?}; give VALUE=DIR, such as 12.5=spots/12");
                return Err(Failure::new(problem));
            };
            spots.push((value, inputs.read_tool_with_doubt("spot", Path::new(dir))?));
        }
        let values: Vec<f64> = spots.iter().map(|s| s.0).collect();
        let settings = json!({
            "by": self.by, "values": values, "sphere_radius_mm": self.form.sphere_radius_mm,
        });
        let widest = spots[0].1.clone();
        let spots = Spots::new(spots).map_err(Failure::with_flags)?;
        let parameter = |p: [f64; 2]| places.parameter(self.by, p);
        self.make.check_corners((&surface, &widest), parameter)?;
        let local_tool: Box<LocalTool<'_>> =
            Box::new(|p| spots.tool(parameter(p).expect("checked at the corners")));
        let tool = (spots.offsets(), local_tool, near(&places, self.make.beyond_mm(&widest)));
        self.make.make(name, &settings, &inputs, (&surface, &widest), tool)
    }
}

#[derive(Debug, Args)]
pub struct EdgeArgs {
    /// Tool influence function of the pad where all of it is on the part [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Radius of the pad, mm
    #[arg(long, value_name = "MM")]
    pad_radius_mm: f64,
    /// Pressure under a pad that hangs over the edge, with the same force
    #[arg(long, value_enum, default_value = "linear")]
    pressure: PressureLaw,
    #[command(flatten)]
    make: MakeArgs,
}

impl EdgeArgs {
    pub fn run(&self, name: Name) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let tif = inputs.read_tool_with_doubt("tif", &self.tif)?;
        doubts::of_pad(&tif, self.pad_radius_mm).iter().for_each(warn);
        let surface: Surface = inputs.read("surface", &self.make.surface)?;
        let settings = json!({ "pad_radius_mm": self.pad_radius_mm, "pressure": self.pressure });
        let places = Places::new(&surface);
        let pad = Overhang::new(&tif, &places, self.pressure, self.pad_radius_mm);
        let pad = pad.map_err(Failure::with_flags)?;
        let local_tool: Box<LocalTool<'_>> = Box::new(|p| pad.tool(p));
        let counts: Box<Used<'_>> = Box::new(|p| pad.is_used(p));
        let tool = (*tif.grid(), local_tool, counts);
        self.make.make(name, &settings, &inputs, (&surface, &tif), tool)
    }
}

/// The angle with which a spot turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
enum FollowsArg {
    /// The azimuth of the tool about the middle of the part, as on a spindle
    Azimuth,
    /// The direction of the motion, as a belt or a wheel that is steered along the path
    Heading,
}

#[derive(Debug, Args)]
pub struct TurnedArgs {
    /// Tool influence function at the angle 0: beside the middle towards positive x, or in a motion along positive x
    /// [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Map of the part; the azimuth is that about the middle of its valid pixels [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Angle with which the spot turns
    #[arg(long, value_enum, default_value_t = FollowsArg::Azimuth)]
    follows: FollowsArg,
    #[command(flatten)]
    exact: ExactArgs,
    #[command(flatten)]
    output: OutputArgs,
}

impl TurnedArgs {
    pub fn run(&self, name: Name) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let tif = inputs.read_tool_with_doubt("tif", &self.tif)?;
        let surface: Surface = inputs.read("surface", &self.surface)?;
        let places = Places::new(&surface);
        let middle_mm = match self.follows {
            FollowsArg::Azimuth => places.middle_mm(),
            FollowsArg::Heading => [0.0; 2],
        };
        let (offsets, local_tool) = turned(&tif, middle_mm).map_err(Failure::with_flags)?;
        let settings = json!({ "low_rank": self.exact.settings(), "follows": self.follows });
        let task = name.task(&settings);
        let output = match Output::directory(&self.output, Tool::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let exact = self.exact.settings();
        let made = match self.follows {
            FollowsArg::Azimuth => {
                let around = (middle_mm, places.radius_mm());
                low_rank_by_azimuth(&offsets, around, &*local_tool, &exact)
            }
            FollowsArg::Heading => corners(surface.grid()).and_then(|positions| {
                low_rank_by_heading(&offsets, positions, &*local_tool, &exact)
            }),
        };
        let LowRank { tool, report } = made.map_err(Failure::with_flags)?;
        write(output, name, Tif::varying(tool)?, Some(&report), &self.output.out)
    }
}

/// Returns a grid of 2 x 2 points at the corners of a map.
fn corners(map: &Grid) -> Result<Grid, Invalid> {
    let [x, y] = [map.x, map.y].map(|axis| {
        let size_mm = (axis.end_mm() - axis.start_mm()).max(axis.step_mm());
        Axis::new(axis.start_mm(), size_mm, 2)
    });
    Ok(Grid { x: x?, y: y? })
}

/// Direction of a tool.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
enum DirectionArg {
    /// Along the normal of the part
    Normal,
    /// Along z everywhere, as a beam whose source does not tilt
    Fixed,
}

#[derive(Debug, Args)]
pub struct FootprintArgs {
    /// Tool influence function on a flat part [tif or tool artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    #[command(flatten)]
    form: FormArgs,
    /// Direction of the tool
    #[arg(long, value_enum)]
    direction: DirectionArg,
    /// Machine and its limits, with --direction normal: its tilts turn the tool [JSON] [default: one whose tilt b carries a]
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
    /// Exponent m of cos(incidence)^m; below 0 the rate rises with the angle
    #[arg(long, value_name = "M", allow_negative_numbers = true, conflicts_with = "table")]
    exponent: Option<f64>,
    /// Table of parameter and factor, two numbers in each line, ascending; the parameter is the incidence in degrees
    /// [text file]
    #[arg(long, value_name = "FILE")]
    table: Option<PathBuf>,
    /// fixed: distance of the point from which the rays come to the part, mm [default: parallel rays]
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    source_distance_mm: Option<f64>,
    #[command(flatten)]
    make: MakeArgs,
}

impl FootprintArgs {
    pub fn run(&self, name: Name) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let tif = inputs.read_tool_with_doubt("tif", &self.tif)?;
        let surface: Surface = inputs.read("surface", &self.make.surface)?;
        let places = self.form.places(&surface, &mut inputs)?;
        let has_law = self.exponent.is_some() || self.table.is_some();
        if self.direction == DirectionArg::Normal && (has_law || self.source_distance_mm.is_some())
        {
            return Err(Failure::new(
                "--direction: is normal, where the incidence is 0 everywhere; leave --exponent, --table and \
                 --source-distance-mm out, or give --direction fixed",
            ));
        }
        if self.direction == DirectionArg::Fixed && self.machine.is_some() {
            return Err(Failure::new(
                "--machine: turns a tool along the normal, and --direction is fixed; leave it out",
            ));
        }
        let frame = match &self.machine {
            None => ToolFrame::of_carrier(Carrier::B),
            Some(file) => {
                ToolFrame::of_machine(&inputs.read_machine(file)?).map_err(Failure::with_flags)?
            }
        };
        let rate_law = match (self.exponent, &self.table) {
            (Some(exponent), _) => RateLaw::Cosine { exponent },
            (None, Some(file)) => {
                let pairs = read_table(&mut inputs, "table", file)?;
                doubt_incidences(&pairs);
                RateLaw::Table { pairs }
            }
            (None, None) => RateLaw::Cosine { exponent: 0.0 },
        };
        rate_law.check().map_err(Failure::with_flags)?;
        if self.direction == DirectionArg::Fixed && !has_law {
            say(format!(
                "{}: note: without --exponent or --table the yield does not depend on the incidence",
                as_command(name.program)
            ));
        }
        let settings = json!({
            "direction": self.direction, "rate_law": rate_law, "source_distance_mm": self.source_distance_mm,
            "sphere_radius_mm": self.form.sphere_radius_mm,
            "carrier": Some(frame.carrier()).filter(|_| self.direction == DirectionArg::Normal),
        });
        let direction = match self.direction {
            DirectionArg::Normal => Direction::Normal(Box::new(frame)),
            DirectionArg::Fixed => {
                Direction::Fixed { rate_law, source_distance_mm: self.source_distance_mm }
            }
        };
        let on = Footprint::new(&tif, &places, direction).map_err(Failure::with_flags)?;
        if self.direction == DirectionArg::Normal && self.machine.is_none() {
            let other = Direction::Normal(Box::new(ToolFrame::of_carrier(Carrier::A)));
            let other = Footprint::new(&tif, &places, other).map_err(Failure::with_flags)?;
            let difference = on.largest_difference(&other);
            if difference > MOST_OF_OTHER_TILTS {
                warn(format!(
                    "the tool is that of a machine whose tilt b carries a; where a carries b, the spot lies turned, by \
                     up to {:.1} % of it (root mean square). Give --machine",
                    100.0 * difference
                ));
            }
        }
        let local_tool: Box<LocalTool<'_>> = Box::new(|p| on.tool(p));
        let tool = (on.offsets(), local_tool, near(&places, self.make.beyond_mm(&tif)));
        self.make.make(name, &settings, &inputs, (&surface, &tif), tool)
    }
}

#[derive(Debug, Args)]
pub struct TimeArgs {
    /// Tool influence function where the factor is 1 [tif or tool artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Table of parameter and factor, two numbers in each line, ascending; the parameter is the time since the start of
    /// the run in s [text file]
    #[arg(long, value_name = "FILE")]
    table: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
}

impl TimeArgs {
    pub fn run(&self, name: Name) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let tif = inputs.read_tool_with_doubt("tif", &self.tif)?;
        if tif.variation().is_some_and(|v| v.time_factor().is_some()) {
            return Err(Failure::new(
                "--tif: has a factor of the time already; give a tool without one",
            ));
        }
        let pairs = read_table(&mut inputs, "table", &self.table)?;
        let task = name.task(json!({ "pairs": pairs }));
        let output = match Output::directory(&self.output, Tool::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let time = TimeFactor {
            time_s: pairs.iter().map(|p| p[0]).collect(),
            factor: pairs.iter().map(|p| p[1]).collect(),
        };
        let numbers = VaryingTif { time: Some(time), ..tif.numbers() };
        let tif = Tif::varying(numbers).map_err(Failure::with_flags)?;
        write(output, name, tif, None, &self.output.out)
    }
}

/// Warns if the incidences of a table, its first column, may be in radians instead of degrees.
fn doubt_incidences(pairs: &[[f64; 2]]) {
    let largest_deg = pairs.iter().fold(0.0, |most: f64, pair| most.max(pair[0]));
    doubts::of_incidences(largest_deg, pairs.len()).iter().for_each(warn);
}

/// Reads rows of two numbers, separated by blanks, commas or semicolons; empty lines and those that begin with `#` are
/// left out. `role` names the file in the manifest.
fn read_table(inputs: &mut Inputs, role: &str, file: &Path) -> Result<Vec<[f64; 2]>, Failure> {
    let bytes = inputs.read_bytes(role, file, LARGEST_TABLE_BYTES)?;
    let about = |e: Invalid| Failure::new(format!("{}: {e}", file.display()));
    let text = file_text::text("table", &bytes).map_err(about)?;
    let with_points = file_text::with_points("table", &text).map_err(about)?;
    let mut rows = Vec::new();
    for (i, line) in with_points.as_deref().unwrap_or(&text).lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let numbers: Vec<Option<f64>> = file_text::fields(line)
            .map(|word| word.parse().ok().filter(|v: &f64| v.is_finite()))
            .collect();
        match numbers[..] {
            [Some(a), Some(b)] => rows.push([a, b]),
            _ => {
                let shown: String = line.chars().take(40).collect();
                return Err(Failure::new(format!(
                    "{}: line {} is {shown:?}; give two numbers, the parameter and the factor",
                    file.display(),
                    i + 1
                )));
            }
        }
    }
    Ok(rows)
}
