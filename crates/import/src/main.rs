//! `planish-import`: files of instruments and other programs in.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::{Args, Parser, Subcommand};
use ndarray::Array2;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, Writer, flags::OutputArgs, kind::Kind, pair,
    run, say, task, warn,
};
use planish_import::{
    Alignment, Baseline, FirstRow, Format, MOST_FILE_BYTES, Origin, Pick, Reading, Rotation, Scale,
    Settings, SpotSettings, Statement, Unit,
    program::{self, Configuration, Controller},
    read, spot, surface, svg, tif,
};
use planish_types::{Grid, Surface, Tif, Trajectory, text::significant};
use serde::Serialize;
use serde_json::{Value, json};

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-import surface mirror.datx --picture mirror.svg --out out/surface\n\
    \x20 planish-import tif spot.mat --rate --unit m --coordinate-unit m --out out/tif";

/// Files of instruments and other programs in
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    method: Method,
}

#[derive(Debug, Subcommand)]
enum Method {
    /// A height map
    Surface(SurfaceArgs),
    /// A tool influence function: a map of rates, of depth after a known time, or a spot before
    /// and after
    Tif(TifArgs),
    /// The program of a motion controller, back into the motion that it makes
    Program(ProgramArgs),
}

/// What is read, and what the user knows of it.
#[derive(Debug, Args)]
struct FileArgs {
    /// File, or directory of .npy
    file: PathBuf,
    /// Format [default: by the content; for text of numbers by the ending .csv or .xyz]
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Array to read: variable of a .mat, path in HDF5 or datx, number of the HDU in FITS
    /// [default: Z (Ztif for rates), or the only one]
    #[arg(long, value_name = "NAME")]
    dataset: Option<String>,
    /// Array of the coordinates of the columns [default: X (Xtif) beside Z]
    #[arg(long, value_name = "NAME")]
    x: Option<String>,
    /// Array of the coordinates of the rows [default: Y (Ytif) beside Z]
    #[arg(long, value_name = "NAME")]
    y: Option<String>,
    /// Unit of the heights, where the file does not state it
    #[arg(long, value_enum)]
    unit: Option<Unit>,
    /// Wavelength of heights in waves, nm
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    wavelength_nm: Option<f64>,
    /// Distance of pixel centres along x and y, mm: one number, or two for X,Y
    #[arg(long, value_name = "P", value_parser = pair, allow_hyphen_values = true)]
    pitch_mm: Option<[f64; 2]>,
    /// Unit of the coordinates in the file, where it does not state it
    #[arg(long, value_enum)]
    coordinate_unit: Option<Unit>,
    /// Surface height per height in the file: 0.5 for the wavefront of one reflection
    #[arg(long, value_name = "F", default_value_t = 1.0, allow_negative_numbers = true)]
    surface_per_value: f64,
    /// The file counts material (or removal) as negative
    #[arg(long)]
    negate: bool,
    /// Value that marks an invalid pixel, besides NaN and what the format has
    #[arg(long, value_name = "V", allow_negative_numbers = true)]
    no_data: Option<f64>,
    /// Where the first row of the file is [default: as the format has it]
    #[arg(long, value_enum)]
    first_row: Option<FirstRow>,
    /// Mirror x
    #[arg(long)]
    flip_x: bool,
    /// Mirror y
    #[arg(long)]
    flip_y: bool,
    /// Turn counter-clockwise with y upwards, after mirroring
    #[arg(long, value_enum, default_value = "0")]
    rotate_deg: Rotation,
    /// Draw what was read, as SVG, to compare with the picture on the instrument
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
struct SurfaceArgs {
    #[command(flatten)]
    file: FileArgs,
    /// Where the coordinate 0 is
    #[arg(long, value_enum, default_value = "file")]
    origin: Origin,
}

#[derive(Debug, Args)]
struct TifArgs {
    #[command(flatten)]
    file: FileArgs,
    /// The values are rates already: height unit per second, on the offsets from the tool centre
    #[arg(long, required_unless_present = "dwell_s", conflicts_with_all = ["dwell_s", "before"])]
    rate: bool,
    /// Where the offset 0 of a map of rates is [default: the file's coordinates, else the middle]
    #[arg(long, value_enum, requires = "rate")]
    origin: Option<Origin>,
    /// Time that the tool rested, s; FILE is the depth of the removal, or the map after it
    #[arg(long, value_name = "T", requires = "half_size_mm", allow_negative_numbers = true)]
    dwell_s: Option<f64>,
    /// Map before, read with the same flags; FILE is the map after
    #[arg(long, value_name = "FILE")]
    before: Option<PathBuf>,
    /// Half the side of the square that becomes the TIF, mm
    #[arg(long, value_name = "H", requires = "dwell_s", allow_negative_numbers = true)]
    half_size_mm: Option<f64>,
    /// Where the spot is, mm [default: where the removal is deepest]
    #[arg(long, value_name = "X,Y", value_parser = pair, requires = "dwell_s", allow_hyphen_values = true)]
    spot_mm: Option<[f64; 2]>,
    /// Whether the part moved between the maps
    #[arg(long, value_enum, default_value = "none")]
    align: Alignment,
    /// What is subtracted from the removal, fitted outside the square
    #[arg(long, value_enum, default_value = "plane")]
    baseline: Baseline,
    /// Set negative rates (noise) to zero
    #[arg(long, requires = "dwell_s")]
    clip_negative: bool,
}

#[derive(Debug, Args)]
struct ProgramArgs {
    /// Program
    file: PathBuf,
    /// Whose program it is
    #[arg(long, value_enum)]
    controller: Controller,
    /// File that planish-export wrote beside the program; the flags below go before it
    #[arg(long, value_name = "FILE")]
    about: Option<PathBuf>,
    /// Where the axes stand before the program, mm
    #[arg(long, value_name = "X,Y", value_parser = pair, allow_hyphen_values = true)]
    start_mm: Option<[f64; 2]>,
    /// Size of a count, mm: one number, or two for X,Y
    #[arg(long, value_name = "C", value_parser = pair, allow_hyphen_values = true)]
    count_mm: Option<[f64; 2]>,
    /// Sample time, s
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    sample_s: Option<f64>,
    /// Unit of time of a PMAC's velocities, s
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    feedrate_time_unit_s: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

fn main() -> ExitCode {
    let method = planish_handoff::parse::<Cli>().method;
    run(move || match method {
        Method::Surface(args) => surface_stage(&args),
        Method::Tif(args) => tif_stage(&args),
        Method::Program(args) => program_stage(&args),
    })
}

fn surface_stage(args: &SurfaceArgs) -> Result<Status, Failure> {
    let file = &args.file;
    let mut inputs = Inputs::new();
    let (pick, settings) = (pick(file, false), settings(file, args.origin));
    let bytes = map_bytes(&mut inputs, "file", &file.file)?;
    let format = format_of(file, bytes.as_deref())?;
    let task = task!("surface", json!({ "format": format, "pick": pick, "reading": settings }));
    let reading = open(&mut inputs, "file", &file.file, format, bytes, &pick)?;
    let mut output = match file.output(Surface::KIND).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let (map, statement) = surface(reading, &settings).map_err(|e| about(&file.file, &e))?;
    let picture = || draw(map.grid(), map.height_nm(), Scale::HeightNm, &file.file, &statement);
    put_picture(&mut output, file, picture)?;
    let statistics = map.statistics();
    let outcome = json!({
        "reading": statement,
        "pv_nm": statistics.pv,
        "rms_nm": statistics.rms,
    });
    output.write(&map, outcome, &Status::Done)?;
    report(&statement, map.grid());
    say(format!(
        "planish-import: {:.4} nm RMS, {:.4} nm PV, height {:.4} .. {:.4} nm -> {}",
        statistics.rms,
        statistics.pv,
        map.height_nm().iter().copied().fold(f64::INFINITY, f64::min),
        map.height_nm().iter().copied().fold(f64::NEG_INFINITY, f64::max),
        file.output.out.display()
    ));
    Ok(Status::Done)
}

fn tif_stage(args: &TifArgs) -> Result<Status, Failure> {
    let file = &args.file;
    let mut inputs = Inputs::new();
    // Maps of a spot are surfaces.
    let pick = pick(file, args.rate);
    let bytes = map_bytes(&mut inputs, "file", &file.file)?;
    let format = format_of(file, bytes.as_deref())?;
    let origin = args.origin.unwrap_or(Origin::File);
    let mut settings = settings(file, origin);
    let spot_settings = match (args.dwell_s, args.half_size_mm) {
        (Some(dwell_s), Some(half_size_mm)) => Some(SpotSettings {
            dwell_s,
            half_size_mm,
            spot_mm: args.spot_mm,
            alignment: args.align,
            baseline: args.baseline,
            clip_negative: args.clip_negative,
        }),
        _ => None,
    };
    let resolved = json!({
        "format": format,
        "pick": pick,
        "reading": settings,
        "origin_given": args.origin.is_some(),
        "spot": spot_settings,
    });
    let task = task!("tif", resolved);
    let reading = open(&mut inputs, "file", &file.file, format, bytes, &pick)?;
    let before = match &args.before {
        Some(path) => {
            let bytes = map_bytes(&mut inputs, "before", path)?;
            Some(open(&mut inputs, "before", path, format, bytes, &pick)?)
        }
        None => None,
    };
    let mut output = match file.output(Tif::KIND).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let (made, statement, own) = match &spot_settings {
        Some(spot_settings) => {
            let (after, statement) =
                surface(reading, &settings).map_err(|e| about(&file.file, &e))?;
            let before = match (before, &args.before) {
                (Some(reading), Some(path)) => {
                    Some(surface(reading, &settings).map_err(|e| about(path, &e))?.0)
                }
                _ => None,
            };
            let made = spot(before.as_ref(), &after, spot_settings)?;
            let own = serde_json::to_value(&made)?;
            (made.tif, statement, own)
        }
        None => {
            if args.origin.is_none() && reading.coordinates.is_none() {
                settings.origin = Origin::Centre;
            }
            let (made, statement) = tif(reading, &settings).map_err(|e| about(&file.file, &e))?;
            (made, statement, Value::Null)
        }
    };
    let picture =
        || draw(made.grid(), made.rate_nm_per_s(), Scale::RateNmPerS, &file.file, &statement);
    put_picture(&mut output, file, picture)?;
    let outcome = json!({
        "reading": statement,
        "spot": own,
        "peak_nm_per_s": made.peak_nm_per_s(),
        "vrr_nm_mm2_per_s": made.vrr_nm_mm2_per_s(),
    });
    output.write(&made, outcome, &Status::Done)?;
    report(&statement, made.grid());
    if let Some(noise) = own["outside_rms_nm"].as_f64() {
        say(format!(
            "planish-import: spot at {} mm, shift {} mm, noise {noise:.4} nm RMS outside it",
            own["centre_mm"], own["shift_mm"]
        ));
    }
    say(format!(
        "planish-import: peak {:.4} nm/s, {:.4} nm mm^2/s -> {}",
        made.peak_nm_per_s(),
        made.vrr_nm_mm2_per_s(),
        file.output.out.display()
    ));
    Ok(Status::Done)
}

fn program_stage(args: &ProgramArgs) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let mut configuration = match &args.about {
        Some(path) => {
            let bytes = foreign(&mut inputs, "about", path)?;
            serde_json::from_slice::<Configuration>(&bytes).map_err(|e| about(path, &e))?
        }
        None => Configuration::default(),
    };
    configuration.start_mm = args.start_mm.or(configuration.start_mm);
    configuration.count_mm = args.count_mm.or(configuration.count_mm);
    configuration.sample_s = args.sample_s.or(configuration.sample_s);
    configuration.feedrate_time_unit_s =
        args.feedrate_time_unit_s.or(configuration.feedrate_time_unit_s);
    let controller = args.controller;
    let resolved = json!({ "controller": controller, "configuration": configuration });
    let task = task!("program", resolved);
    let bytes = foreign(&mut inputs, "file", &args.file)?;
    let mut output =
        match Output::directory(&args.output, Trajectory::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
    let motion =
        program::read(controller, &bytes, &configuration).map_err(|e| about(&args.file, &e))?;
    let outcome = json!({
        "segments": motion.len(),
        "total_time_s": motion.total_time_s(),
        "always_on": motion.tool_on().iter().all(|on| *on),
    });
    output.write(&motion, outcome, &Status::Done)?;
    say(format!(
        "planish-import: {} segments, {:.4} s -> {}",
        motion.len(),
        motion.total_time_s(),
        args.output.out.display()
    ));
    Ok(Status::Done)
}

impl FileArgs {
    /// The artifact, and the picture where one is asked for.
    fn output(&self, kind: &'static Kind) -> Output {
        let output = Output::directory(&self.output, kind);
        match &self.picture {
            Some(path) => output.and_file("--picture", path),
            None => output,
        }
    }
}

/// A message of the library, with the file that it is about.
fn about(path: &Path, error: &dyn std::error::Error) -> Failure {
    Failure::new(format!("{}: {error}", path.display()))
}

/// The bytes of a file of another program.
fn foreign(inputs: &mut Inputs, role: &str, path: &Path) -> Result<Vec<u8>, Failure> {
    let bytes = inputs.read_bytes(role, path, MOST_FILE_BYTES)?;
    match bytes.is_empty() {
        true => Err(Failure::new(format!("{}: is empty; export it again", path.display()))),
        false => Ok(bytes),
    }
}

/// The bytes of a map; `None` for a directory.
fn map_bytes(inputs: &mut Inputs, role: &str, path: &Path) -> Result<Option<Vec<u8>>, Failure> {
    if path.is_dir() { Ok(None) } else { foreign(inputs, role, path).map(Some) }
}

fn pick(args: &FileArgs, is_tif: bool) -> Pick {
    Pick { data: args.dataset.clone(), x: args.x.clone(), y: args.y.clone(), is_tif }
}

fn settings(args: &FileArgs, origin: Origin) -> Settings {
    Settings {
        unit: args.unit,
        wavelength_nm: args.wavelength_nm,
        pitch_mm: args.pitch_mm,
        coordinate_unit: args.coordinate_unit,
        surface_per_value: args.surface_per_value,
        negate: args.negate,
        no_data: args.no_data,
        first_row: args.first_row,
        flip_x: args.flip_x,
        flip_y: args.flip_y,
        rotation: args.rotate_deg,
        origin,
    }
}

/// The format that was given, or that the content or the ending of the file tells; `bytes` are `None` for
/// a directory.
fn format_of(args: &FileArgs, bytes: Option<&[u8]>) -> Result<Format, Failure> {
    let path = &args.file;
    let Some(bytes) = bytes else { return Ok(Format::Directory) };
    if let Some(format) = args.format {
        return Ok(format);
    }
    let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    let by_ending = match ending.as_deref() {
        Some("csv") => Some(Format::Csv),
        Some("xyz") => Some(Format::Xyz),
        _ => None,
    };
    Format::of(bytes).or(by_ending).ok_or_else(|| {
        Failure::new(format!("{}: is of no format that is known; give --format", path.display()))
    })
}

fn open(
    inputs: &mut Inputs,
    role: &str,
    path: &Path,
    format: Format,
    bytes: Option<Vec<u8>>,
    pick: &Pick,
) -> Result<Reading, Failure> {
    let Some(bytes) = bytes else {
        if pick.data.is_some() || pick.x.is_some() || pick.y.is_some() {
            let problem = "is a directory; leave out --dataset, --x and --y";
            return Err(Failure::new(format!("{}: {problem}", path.display())));
        }
        return Ok(match pick.is_tif {
            false => {
                let map: Surface = inputs.read(role, path)?;
                Reading::of_map(map.grid(), map.height_nm())
            }
            true => {
                let map: Tif = inputs.read(role, path)?;
                Reading::of_map(map.grid(), map.rate_nm_per_s())
            }
        });
    };
    read(format, &bytes, pick).map_err(|e| about(path, &e))
}

/// What was done, for the user to check, and the warnings.
fn report(statement: &Statement, grid: &Grid) {
    for warning in &statement.warnings {
        warn(warning);
    }
    #[derive(Serialize)]
    struct Names(Format, FirstRow);
    let name = |v: Value| v.as_str().unwrap_or_default().to_string();
    let names = serde_json::to_value(Names(statement.format, statement.first_row));
    let names = names.unwrap_or_default();
    let (ny, nx) = grid.shape();
    say(format!(
        "planish-import: {}, {nx} x {ny} pixels of {} x {} mm (pitch: {}), {} invalid",
        name(names[0].clone()),
        significant(grid.x.step_mm(), 10),
        significant(grid.y.step_mm(), 10),
        statement.pitch_from,
        statement.invalid
    ));
    say(format!(
        "planish-import: stored value 1 is {} nm of surface (unit: {}); the first row of the file is \
         the {}",
        statement.nm_per_value,
        statement.unit_from,
        if statement.first_row == FirstRow::Top { "top" } else { "smallest y" }
    ));
}

fn draw(
    grid: &Grid,
    map: &Array2<f64>,
    scale: Scale,
    file: &Path,
    statement: &Statement,
) -> String {
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    let title = format!(
        "{name}: {} x {} pixels, {} invalid (grey)",
        map.ncols(),
        map.nrows(),
        statement.invalid
    );
    svg(grid, map, scale, &title)
}

/// The picture that was asked for appears with the map; an older one is replaced with --force.
fn put_picture(
    output: &mut Writer,
    args: &FileArgs,
    picture: impl Fn() -> String,
) -> Result<(), Failure> {
    let Some(path) = &args.picture else { return Ok(()) };
    Ok(output.write_file(path, picture().as_bytes())?)
}
