//! The subcommands, one file each, and the flags and functions that the commands for maps share.

// The text of a field is the help of its flag, where [default: ...] is no link.
#![allow(rustdoc::broken_intra_doc_links)]

mod program;
mod slopes;
mod surface;
mod trace;

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use ndarray::Array2;
use planish_handoff::{
    Failure, Inputs, Output, Status, Subcommands, Writer, as_command, flags::OutputArgs,
    kind::Kind, pair, say, warn, with_flags,
};
use planish_import::{
    FirstRow, Format, MOST_FILE_BYTES, Origin, Pick, Reading, ReadingSettings, Rotation, Scale,
    Statement, Unit, read, svg, unknown,
};
use planish_types::{Grid, Surface, Tif, text::significant};

#[derive(Debug, Subcommand)]
pub(crate) enum ImportMethod<Others: Subcommands> {
    /// A height map
    Surface(surface::SurfaceArgs),
    /// A height map from two maps of slopes, along x and along y
    Slopes(Box<slopes::SlopesArgs>),
    /// The program of a motion controller, as the motion that it makes
    Program(program::ProgramArgs),
    /// A log of a machine, as the motion that the machine made
    Trace(trace::TraceArgs),
    /// Those of another stage
    #[command(flatten)]
    Others(Others),
}

impl<Others: Subcommands> ImportMethod<Others> {
    pub(crate) fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Surface(arguments) => arguments.run(),
            Self::Slopes(arguments) => arguments.run(),
            Self::Program(arguments) => arguments.run(),
            Self::Trace(arguments) => arguments.run(),
            Self::Others(others) => others.run(),
        }
    }
}

/// The file to read, and settings that the file does not state.
#[derive(Debug, Args)]
pub struct FileArgs {
    /// File, or directory of .npy
    pub file: PathBuf,
    /// File format [default: by the content; for text of numbers by the ending .csv or .xyz]
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Array to read: variable of a .mat, path in HDF5 or datx, number or name of the HDU in FITS
    /// [default: Z (Ztif for rates), or the only one]
    #[arg(long, value_name = "NAME")]
    dataset: Option<String>,
    /// Name of the x coordinates in the file: those of the columns [default: X (Xtif) beside Z]
    #[arg(long, value_name = "NAME")]
    x: Option<String>,
    /// Name of the y coordinates in the file: those of the rows [default: Y (Ytif) beside Z]
    #[arg(long, value_name = "NAME")]
    y: Option<String>,
    /// Array of the same size that is not 0 at invalid pixels, named as for --dataset [default in FITS: the image
    /// called MASK]
    #[arg(long, value_name = "NAME")]
    mask: Option<String>,
    /// Unit of the values in the file, where it does not state it: m, mm, um, nm, angstrom, in, mil or waves. Rates take
    /// a unit over a time, such as nm/min or um/h [default of the time: s]
    #[arg(long, value_name = "UNIT")]
    unit: Option<Unit>,
    /// Wavelength of the light, nm, for heights in waves
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    wavelength_nm: Option<f64>,
    /// Distance of pixel centres, mm, along x and y, where the file does not state it: one number, or two for X,Y
    #[arg(long, value_name = "P", value_parser = pair, allow_hyphen_values = true)]
    pixel_mm: Option<[f64; 2]>,
    /// Pitch along x and y, mm, to which points x y z that lie on no grid are interpolated (linear in triangles)
    #[arg(long, value_name = "P", value_parser = pair, allow_hyphen_values = true)]
    grid_mm: Option<[f64; 2]>,
    /// Columns of x, y and the values in lines of text, by name or by number from 1 [default: by their names, else 1,2,3]
    #[arg(long, value_name = "X,Y,Z", value_parser = columns)]
    xyz_columns: Option<[String; 3]>,
    /// Unit of the coordinates in the file, where it does not state it: m, mm, um, in, or pixels with --pixel-mm
    #[arg(long, value_name = "UNIT")]
    coordinate_unit: Option<Unit>,
    /// Take --unit, --wavelength-nm, --pixel-mm, --coordinate-unit and --surface-per-value in the place of what the file
    /// states, with a warning. Use it where the file is wrong
    #[arg(long)]
    override_file: bool,
    /// Surface height per height in the file: 0.5 for the wavefront of one reflection
    #[arg(long, value_name = "F", default_value_t = 1.0, allow_negative_numbers = true)]
    surface_per_value: f64,
    /// The file counts material (or removal) as negative
    #[arg(long)]
    negate: bool,
    /// Stored value that marks an invalid pixel, besides NaN and what the format has; compared in the type in which the
    /// file stores its numbers
    #[arg(long, value_name = "V", allow_negative_numbers = true)]
    no_data: Option<f64>,
    /// Side of the map that the first row of the file is [default: as the format has it]
    #[arg(long, value_enum)]
    first_row: Option<FirstRow>,
    /// Mirror x
    #[arg(long)]
    flip_x: bool,
    /// Mirror y
    #[arg(long)]
    flip_y: bool,
    /// Turn counterclockwise, degrees, with y upwards, after mirroring
    #[arg(long, value_enum, default_value = "0")]
    rotate_deg: Rotation,
    /// Draw what was read, as SVG, to compare with the picture on the instrument
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
    /// Directory of the artifact, and what happens if it exists.
    #[command(flatten)]
    pub output: OutputArgs,
}

impl FileArgs {
    /// Returns the output of the command: the artifact, and the picture if the user asks for one.
    pub fn output(&self, kind: &'static Kind) -> Output {
        let output = Output::directory(&self.output, kind);
        match &self.picture {
            Some(path) => output.and_file("--picture", path),
            None => output,
        }
    }

    /// Returns the choice of arrays, columns and grid from the flags. `is_tif` is true for a tool influence function.
    pub fn pick(&self, is_tif: bool) -> Pick {
        Pick {
            dataset: self.dataset.clone(),
            x: self.x.clone(),
            y: self.y.clone(),
            mask: self.mask.clone(),
            grid_mm: self.grid_mm,
            coordinate_unit: self.coordinate_unit,
            columns: self.xyz_columns.clone(),
            is_tif,
        }
    }

    /// Returns the settings for reading a map from the flags. `origin` is the point of the map that gets the
    /// coordinates x = y = 0.
    pub fn settings(&self, origin: Origin) -> ReadingSettings {
        ReadingSettings {
            override_file: self.override_file,
            unit: self.unit,
            wavelength_nm: self.wavelength_nm,
            pixel_mm: self.pixel_mm,
            coordinate_unit: self.coordinate_unit,
            surface_per_value: self.surface_per_value,
            negate: self.negate,
            no_data: self.no_data,
            first_row: self.first_row,
            flip_x: self.flip_x,
            flip_y: self.flip_y,
            rotation: self.rotate_deg,
            origin,
            place_mm: None,
        }
    }

    /// Returns the format that the flag states, else that of the content or of the ending of the file name. `bytes` are
    /// `None` for a directory. Refuses a file whose format remains unknown.
    pub fn format(&self, bytes: Option<&[u8]>) -> Result<Format, Failure> {
        let path = &self.file;
        let Some(bytes) = bytes else { return Ok(Format::Directory) };
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        let format = self
            .format
            .or_else(|| Format::recognise(bytes))
            .or_else(|| Format::of_ending(ending.as_deref()?, bytes));
        format.ok_or_else(|| {
            let named = Format::value_variants().iter().filter_map(|f| f.to_possible_value());
            let formats: Vec<String> = named.map(|f| f.get_name().to_string()).collect();
            Failure::new(format!("{}: {}", path.display(), with_flags(&unknown(bytes, &formats))))
        })
    }

    /// Writes the picture if the user asks for one. It appears together with the map; an older picture is replaced only
    /// with --force. Fails if it cannot be written.
    pub fn put_picture(
        &self,
        output: &mut Writer,
        picture: impl Fn() -> String,
    ) -> Result<(), Failure> {
        let Some(path) = &self.picture else { return Ok(()) };
        Ok(output.write_file(path, picture().as_bytes())?)
    }
}

/// Reads three names or numbers of columns, separated by commas. Refuses another number of them, and empty ones.
fn columns(text: &str) -> Result<[String; 3], String> {
    let names: Vec<String> = text.split(',').map(|name| name.trim().to_string()).collect();
    let all =
        <[String; 3]>::try_from(names).ok().filter(|names| names.iter().all(|n| !n.is_empty()));
    all.ok_or_else(|| {
        "give the columns of x, y and the values, such as 2,3,4 or x,y,height".to_string()
    })
}

/// Returns a failure with the path of the file and the message of the library, in which flags replace the names of
/// settings.
pub fn about(path: &Path, error: &dyn std::error::Error) -> Failure {
    Failure::new(format!("{}: {}", path.display(), with_flags(&error.to_string())))
}

/// Reads the bytes of a file that another program wrote, and records it as the input `role`. Refuses an empty file.
fn foreign(inputs: &mut Inputs, role: &str, path: &Path) -> Result<Vec<u8>, Failure> {
    let bytes = inputs.read_bytes(role, path, MOST_FILE_BYTES)?;
    if bytes.is_empty() {
        return Err(Failure::new(format!("{}: is empty; export it again", path.display())));
    }
    Ok(bytes)
}

/// Returns the bytes of a map, or `None` for a directory. They are recorded as the input `role`. Refuses a file that is
/// empty, too large, or cannot be read.
pub fn map_bytes(inputs: &mut Inputs, role: &str, path: &Path) -> Result<Option<Vec<u8>>, Failure> {
    if path.is_dir() { Ok(None) } else { foreign(inputs, role, path).map(Some) }
}

/// Reads a map from the bytes of its file in `format`, or without `bytes` from the artifact in the directory `path`, as
/// the input `role`. Refuses a file that is not of the format, names in `pick` that the file does not have, and names
/// for a directory.
pub fn open(
    inputs: &mut Inputs,
    role: &str,
    path: &Path,
    format: Format,
    bytes: Option<Vec<u8>>,
    pick: &Pick,
) -> Result<Reading, Failure> {
    let Some(bytes) = bytes else {
        if [&pick.dataset, &pick.x, &pick.y, &pick.mask].iter().any(|name| name.is_some())
            || pick.grid_mm.is_some()
            || pick.columns.is_some()
        {
            let problem = "is a directory; leave out --dataset, --x, --y, --mask, --xyz-columns and --grid-mm";
            return Err(Failure::new(format!("{}: {problem}", path.display())));
        }
        if pick.is_tif {
            let map: Tif = inputs.read(role, path)?;
            return Ok(Reading::of_map(map.grid(), map.rate_nm_per_s()));
        }
        let map: Surface = inputs.read(role, path)?;
        return Ok(Reading::of_map(map.grid(), map.height_nm()));
    };
    read(format, &bytes, pick).map_err(|e| about(path, &e))
}

/// Returns the statement with flags in place of the names of settings in its warnings.
pub fn in_flags(statement: Statement) -> Statement {
    let warnings = statement.warnings.iter().map(|warning| with_flags(warning)).collect();
    Statement { warnings, ..statement }
}

/// Prints the warnings, and how the file was read (format, pixels, unit, orientation), for the user to check. `program`
/// begins each line but the warnings.
pub fn report(program: &str, statement: &Statement, grid: &Grid) {
    let program = as_command(program);
    for warning in &statement.warnings {
        warn(warning);
    }
    let format = serde_json::to_value(statement.format).unwrap_or_default();
    let (ny, nx) = grid.shape();
    say(format!(
        "{program}: {}, {nx} x {ny} pixels of {} x {} mm (pitch: {}), x {} .. {} and y {} .. {} mm, {} \
         invalid",
        format.as_str().unwrap_or_default(),
        significant(grid.x.step_mm(), 10),
        significant(grid.y.step_mm(), 10),
        statement.pitch_from,
        significant(grid.x.start_mm(), 10),
        significant(grid.x.end_mm(), 10),
        significant(grid.y.start_mm(), 10),
        significant(grid.y.end_mm(), 10),
        statement.invalid
    ));
    let value = match statement.nm_of_zero {
        0.0 => format!("stored value 1 is {} nm of surface", statement.nm_per_value),
        zero => format!(
            "stored value 0 is {zero} nm of surface, a step of 1 is {} nm",
            statement.nm_per_value
        ),
    };
    say(format!(
        "{program}: {value} (unit: {}); the first row of the file is the {}",
        statement.unit_from,
        if statement.first_row == FirstRow::Top { "top" } else { "smallest y" }
    ));
}

/// Returns a picture of the map as SVG, with the file name, the size and the number of invalid pixels as its title.
pub fn draw(
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
