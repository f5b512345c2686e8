//! The subcommands of `planish toolpath`, one file each. Most of them are a method to make a path; this file has what
//! these methods have in common.

mod draw;
mod inspect;
mod maze;
mod multi_pitch;
mod passes;
mod random_adaptive;
mod raster;
mod rest;
mod spiral;

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use planish_form::FormKind;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, Task, Writer, flags::OutputArgs, kind, say,
    warn, with_flags,
};
use planish_toolpath::{
    AlongReport, OnForm, PathReport, inset, travel_warnings, usual_overscan_mm,
};
use planish_types::{Machine, Surface, Tif, ToolPath, doubts, plausible};
use serde::Serialize;

#[derive(Debug, Subcommand)]
pub enum PathCommand {
    /// Parallel lines, back and forth, joined by turn-arounds beyond the aperture
    Raster(raster::RasterArgs),
    /// One random closed line through every cell of a lattice, which never crosses itself
    Maze(maze::MazeArgs),
    /// One random closed line that never crosses itself, denser where more is to be removed
    RandomAdaptive(random_adaptive::RandomAdaptiveArgs),
    /// Regions by the depth to be removed, each a raster of its own pitch
    MultiPitch(multi_pitch::MultiPitchArgs),
    /// One line from the inside out, for round parts
    Spiral(spiral::SpiralArgs),
    /// Repeat a path several times, there and back
    Passes(passes::PassesArgs),
    /// Rest of a path after an abort
    Rest(rest::RestArgs),
    /// Print the statistics of a path as JSON
    Inspect(inspect::InspectArgs),
    /// Draw a path as SVG
    Draw(draw::DrawArgs),
}

impl PathCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Raster(arguments) => arguments.run(),
            Self::Maze(arguments) => arguments.run(),
            Self::RandomAdaptive(arguments) => arguments.run(),
            Self::MultiPitch(arguments) => arguments.run(),
            Self::Spiral(arguments) => arguments.run(),
            Self::Passes(arguments) => arguments.run(),
            Self::Rest(arguments) => arguments.run(),
            Self::Inspect(arguments) => arguments.run(),
            Self::Draw(arguments) => arguments.run(),
        }
    }
}

/// Arguments that every path has in common.
#[derive(Debug, Args)]
struct RegionArgs {
    /// Map whose valid pixels (their centres) are the clear aperture [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Tool influence function, for the overscan and the pitch limit [tif or tool artifact]
    #[arg(long, value_name = "DIR", required_unless_present = "overscan_mm")]
    tif: Option<PathBuf>,
    /// Distance of neighbouring lines, mm
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    pitch_mm: f64,
    /// Distance that the path goes beyond the aperture, mm. Below 0 it stays that far inside of the edge. [default: half the
    /// side of the square about the centroid of the TIF with all but 0.05 % of its volume]
    #[arg(long, value_name = "O", allow_negative_numbers = true)]
    overscan_mm: Option<f64>,
    /// Machine and its limits, for a warning if the path leaves the travel of its axes [JSON]
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
    /// Refuse a path that leaves the travel, instead of a warning: no program can run it
    #[arg(long, requires = "machine")]
    within_travel: bool,
    #[command(flatten)]
    form: FormArgs,
    #[command(flatten)]
    output: OutputArgs,
}

impl RegionArgs {
    /// Reads the file of the machine; `None` without the flag, or if neither its travel nor its limits can lead to a
    /// warning. Adds probable mistakes in its values to `doubts`.
    fn machine(
        &self,
        surface: &Surface,
        tif: Option<&Tif>,
        inputs: &mut Inputs,
        doubts: &mut Vec<String>,
    ) -> Result<Option<Machine>, Failure> {
        let Some(file) = &self.machine else { return Ok(None) };
        let read = Inputs::new().read_machine(file)?;
        let mut doubt = None;
        // Rates in doubt say nothing of the limits.
        if doubts.is_empty() {
            doubt =
                doubts::of_rotary_axes(&read).or_else(|| doubts::of_pivot(&read)).or_else(|| {
                    doubts::of_limits(surface, tif?, &read.limits_on_part(), self.pitch_mm)
                });
        }
        let counts = doubt.is_some() || read.travel_mm().iter().any(Option::is_some);
        doubts.extend(doubt);
        doubts.extend(doubts::of_travel(surface, &read));
        if counts { Ok(Some(inputs.read_machine(file)?)) } else { Ok(None) }
    }
}

/// The form of the part, along which pitch and step count.
#[derive(Clone, Debug, Default, Args)]
struct FormArgs {
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]; pitch, step and overscan then
    /// count along the surface
    #[arg(long, value_name = "PATH")]
    form: Option<PathBuf>,
}

impl FormArgs {
    /// Reads the form of a part with the valid pixels of `surface`; `None` without the flag.
    fn read(&self, surface: &Surface, inputs: &mut Inputs) -> Result<Option<OnForm>, Failure> {
        let Some(path) = &self.form else { return Ok(None) };
        let form = inputs.read_form("form", path)?.form;
        OnForm::new(form, surface)
            .map(Some)
            .map_err(|e| Failure::new(format!("{}: {e}", path.display())))
    }
    /// Returns a warning if the vertex of a curved form lies at an unlikely position relative to the map; `None` for a
    /// plane, or without the flag.
    fn doubt(&self, surface: &Surface) -> Result<Option<String>, Failure> {
        let Some(path) = &self.form else { return Ok(None) };
        let read = Inputs::new().read_form("form", path)?;
        let is_flat = read
            .file
            .is_none_or(|stated| matches!(stated.file.kind, FormKind::Plane | FormKind::Map));
        Ok(if is_flat { None } else { doubts::of_vertex(surface, read.form.vertex_mm()) })
    }
}

/// Results of a method as the manifest (the record of the run) states them.
#[derive(Serialize)]
struct PathOutcome<'a, R> {
    #[serde(flatten)]
    report: &'a PathReport<R>,
    /// Report on the path along the surface of a curved part; left out without a form of the part.
    #[serde(skip_serializing_if = "Option::is_none")]
    form: Option<&'a AlongReport>,
}

/// Inputs of a run that makes a path, and the region that the path shall cover.
struct Region {
    inputs: Inputs,
    output: OutputArgs,
    /// Map of the tool positions: the clear aperture, moved by minus the offset of the TIF's centroid. It is in the
    /// coordinates along the surface if there is a form.
    surface: Surface,
    /// Form of the part with the same map in projection; `None` without a form.
    on_form: Option<(OnForm, Surface)>,
    tif: Option<Tif>,
    off_centre_mm: [f64; 2],
    overscan_mm: f64,
    /// Distance of the path from the edge of the aperture, mm, if the overscan is negative and the path stays inside;
    /// else 0.
    inset_mm: f64,
    /// Machine, if its travel is limited or its limits are doubtful; otherwise `None`, so that the report does not
    /// depend on it.
    machine: Option<Machine>,
    /// True if a path that leaves the travel is refused.
    within_travel: bool,
    /// Probable mistakes in the inputs.
    doubts: Vec<String>,
}

/// Returns a warning for a path in projection if a form file, written by `planish surface prepare`, lies beside the map
/// in the folder `dir`.
fn warning_of_projection(dir: &Path, surface: &Surface) -> Result<Option<String>, Failure> {
    let beside = dir.join(kind::FORM_FILE);
    if !beside.exists() {
        return Ok(None);
    }
    let form = Inputs::new().read_form("form", &beside)?.form;
    let warning = OnForm::new(form, surface).ok().and_then(|on| on.warning_of_projection(surface));
    Ok(warning.map(|w| w.replace("give `form`", &format!("give `form` {}", beside.display()))))
}

/// Settings of a method as the manifest (the record of the run) states them, with the distance from the edge if it is
/// not 0. A path beyond the travel is refused or not, so it is made again with the flag.
#[derive(Serialize)]
struct StatedSettings<'a, S> {
    #[serde(skip_serializing_if = "Option::is_none")]
    inset_mm: Option<f64>,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    within_travel: bool,
    #[serde(flatten)]
    settings: &'a S,
}

impl Region {
    fn read(args: &RegionArgs) -> Result<Self, Failure> {
        let mut inputs = Inputs::new();
        let surface: Surface = inputs.read("surface", &args.surface)?;
        let tif = args.tif.as_ref().map(|dir| inputs.read_tool("tif", dir)).transpose()?;
        if let Some(tif) = &tif {
            plausible::check_tool(&surface, tif)?;
            plausible::check_pitch(tif, args.pitch_mm)?;
        }
        let off_centre_mm = tif.as_ref().map_or([0.0; 2], |tif| tif.off_centre_mm(surface.grid()));
        let mut doubts = Vec::new();
        if let Some(tif) = &tif {
            doubts.extend(doubts::of_tif(tif));
            doubts.extend(
                doubts::of_pixels(&surface, tif)
                    .or_else(|| doubts::of_sizes(&surface, tif))
                    .or_else(|| doubts::of_rates(&surface, tif))
                    .or_else(|| doubts::of_time(&surface, tif)),
            );
        }
        let machine = args.machine(&surface, tif.as_ref(), &mut inputs, &mut doubts)?;
        // The form is of the part, not of the places of the tool.
        let on_form = args.form.read(&surface, &mut inputs)?;
        doubts.extend(args.form.doubt(&surface)?);
        if on_form.is_none() {
            doubts.extend(warning_of_projection(&args.surface, &surface)?);
        }
        let surface = match off_centre_mm {
            [0.0, 0.0] => surface,
            _ => surface.seen_by_tool(off_centre_mm)?,
        };
        let (surface, on_form) = match on_form {
            None => (surface, None),
            Some(on) => (on.developed(&surface)?, Some((on, surface))),
        };
        let usual_mm = tif.as_ref().map(|tif| usual_overscan_mm(tif, off_centre_mm));
        let overscan_mm = args.overscan_mm.or(usual_mm).ok_or_else(|| {
            Failure::new(
                "overscan: unknown; give --overscan-mm, or --tif for half the size of the tool",
            )
        })?;
        // A path that stays inside is that of a smaller aperture, without overscan.
        let inset_mm = (-overscan_mm).max(0.0);
        let (surface, overscan_mm) = if inset_mm > 0.0 {
            (inset(&surface, inset_mm).map_err(Failure::with_flags)?, 0.0)
        } else {
            (surface, overscan_mm)
        };
        Ok(Self {
            inputs,
            output: args.output.clone(),
            surface,
            on_form,
            tif,
            off_centre_mm,
            overscan_mm,
            inset_mm,
            machine,
            within_travel: args.within_travel,
            doubts,
        })
    }

    /// Returns the settings of a method together with the distance of the path from the edge of the aperture.
    fn stated<'a, S: Serialize>(&self, settings: &'a S) -> StatedSettings<'a, S> {
        let inset_mm = Some(self.inset_mm).filter(|mm| *mm > 0.0);
        StatedSettings { inset_mm, within_travel: self.within_travel, settings }
    }

    fn begin(&self, task: &Task) -> Result<Begin, Failure> {
        Ok(Output::directory(&self.output, ToolPath::KIND).begin(task, &self.inputs)?)
    }

    /// Writes the path and its report. `own` holds the results and `warnings` the warnings that only its method has.
    fn write<R: Serialize>(
        &self,
        output: &mut Writer,
        path: &ToolPath,
        largest_pitch_mm: f64,
        own: R,
        warnings: Vec<String>,
    ) -> Result<Status, Failure> {
        let tif = self.tif.as_ref();
        let mut along = None;
        let mut projected = None;
        if let Some((on, part)) = &self.on_form {
            along = Some(on.report(path, part, &self.surface)?);
            projected = Some((on.projected(path)?, part));
        }
        let (path, surface) = match &projected {
            Some((path, part)) => (path, *part),
            None => (path, &self.surface),
        };
        let mut report = PathReport::new(path, surface, tif, largest_pitch_mm, own, warnings);
        report.warnings.extend(along.iter().flat_map(AlongReport::warnings));
        report.warnings.extend(self.doubts.iter().cloned());
        if self.off_centre_mm != [0.0; 2] {
            let [x, y] = self.off_centre_mm;
            report.warnings.push(format!(
                "the TIF removes ({x:.3}, {y:.3}) mm from where the tool stands (its centroid), so the path \
                 lies that much the other way from the aperture; `planish tool prepare --centre centroid` \
                 centres it, where the tool is not mounted like that"
            ));
        }
        if let Some(machine) = &self.machine {
            let beyond = travel_warnings(path, surface, machine);
            if self.within_travel && !beyond.is_empty() {
                return Err(Failure::new(with_flags(&beyond.join("; "))));
            }
            report.warnings.extend(beyond);
        }
        for warning in &mut report.warnings {
            *warning = with_flags(warning);
            warn(&*warning);
        }
        let outcome = PathOutcome { report: &report, form: along.as_ref() };
        output.write(path, outcome, &Status::Done)?;
        let s = &report.statistics;
        say(format!(
            "planish toolpath: {} points, {:.1} mm in {} pass(es), {} lift(s), step <= {:.4} mm",
            s.points, s.length_mm, s.passes, s.lifts, s.longest_step_mm
        ));
        if let Some(AlongReport { along_surface: s, stretches: [low, high], .. }) = &along {
            say(format!(
                "planish toolpath: along the surface {:.1} mm, step <= {:.4} mm; lengths there are {low:.4} to {high:.4} of \
                 the given ones",
                s.length_mm, s.longest_step_mm
            ));
        }
        Ok(Status::Done)
    }
}
