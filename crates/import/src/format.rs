//! Formats of maps, one file each: a function that recognises the format, and a reader.
//!
//! | module | format | source of its layout |
//! |---|---|---|
//! | [`metropro`] | MetroPro `.dat` | MetroPro reference guide as read by prysm and SurfaceTopography |
//! | [`datx`] | Zygo `.datx` | a file of Zygo Mx |
//! | [`points`] | Zygo `.xyz` and any text of lines `x y z` | prysm's writer |
//! | [`matlab`] | MATLAB `.mat`, version 5 | "MAT-File Format", The MathWorks |
//! | [`hdf5`] | HDF5 by the path of a dataset, MATLAB `.mat` 7.3 | crate hdf5-reader |
//! | [`fits`] | FITS images | FITS standard 4.0 |
//! | [`npy`] | `.npy` of any real number type, and `.npz` | NumPy enhancement proposal 1 |
//! | [`csv`] | a matrix of numbers as text | - |
//! | [`gsf`] | Gwyddion Simple Field | Gwyddion user guide |
//! | [`gwy`] | Gwyddion `.gwy` | Gwyddion user guide |
//! | [`sur`] | Digital Surf `.sur` | Digital Surf's description, see there |
//! | [`codev`] | CODE V `.int` | CODE V reference manual |
//! | [`grid_sag`] | Zemax OpticStudio grid sag | OpticStudio help |
//! | [`x3p`] | `.x3p` | ISO 25178-72 |
//! | [`opd`] | Wyko and Veeco `.opd` | documentation of public readers |
//! | [`srw`] | height map of SRW and Sirepo | SRW's srwlib.py |
//! | [`wft`] | DFTFringe and OpenFringe `.wft` | files of DFTFringe |
//! | [`presurface`] | SHADOW presurface | SHADOW's user guide |
//! | [`four_sight`] | 4D Technology 4Sight `.h5` | public readers |
//! | [`sdf`] | surface data file, text and binary | ISO 25178-71 |

pub mod codev;
pub mod csv;
pub mod datx;
pub mod fits;
pub mod four_sight;
pub mod grid_sag;
pub mod gsf;
pub mod gwy;
pub mod hdf5;
pub mod matlab;
pub mod metropro;
pub mod npy;
pub mod opd;
pub mod points;
pub mod presurface;
pub mod sdf;
pub mod srw;
pub mod sur;
pub mod wft;
pub mod x3p;
mod zip;

use planish_types::Invalid;

use crate::{
    reading::{Pick, Reading},
    text,
};

/// A format that is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// MetroPro `.dat`.
    Metropro,
    /// Zygo `.datx`.
    Datx,
    /// Zygo `.xyz`, and text of lines `x y z`.
    Xyz,
    /// MATLAB `.mat`, version 5.
    Mat5,
    /// HDF5; MATLAB `.mat` 7.3 among them.
    Hdf5,
    /// FITS image.
    Fits,
    /// A matrix of numbers as text.
    Csv,
    /// NumPy array.
    Npy,
    /// Archive of NumPy arrays.
    Npz,
    /// Surface data file.
    Sdf,
    /// Gwyddion Simple Field.
    Gsf,
    /// Gwyddion's own format.
    Gwy,
    /// Digital Surf `.sur`.
    Sur,
    /// CODE V interferogram file on a grid.
    CodevInt,
    /// Zemax OpticStudio grid sag.
    GridSag,
    /// ISO 25178-72.
    X3p,
    /// Wyko and Veeco `.opd`.
    Opd,
    /// SHADOW presurface.
    Presurface,
    /// Height map of SRW and Sirepo.
    Srw,
    /// Wavefront of DFTFringe and OpenFringe.
    Wft,
    /// 4D Technology 4Sight.
    #[value(name = "4sight")]
    #[serde(rename = "4sight")]
    FourSight,
    /// Directory of `.npy` files, with or without a manifest.
    #[value(skip)]
    Directory,
}

impl Format {
    /// Returns the format of a file from its bytes: the first ones, the content of an archive, or the words of a text.
    /// Returns `None` if they do not tell, as in a text of numbers.
    pub fn recognise(bytes: &[u8]) -> Option<Self> {
        let starts = |magic: &[u8]| bytes.starts_with(magic);
        if metropro::is_magic(bytes) {
            Some(Self::Metropro)
        } else if starts(b"\x93NUMPY") {
            Some(Self::Npy)
        } else if starts(b"SIMPLE  =") {
            Some(Self::Fits)
        } else if hdf5::is_hdf5(bytes) {
            if datx::is_datx(bytes) {
                Some(Self::Datx)
            } else if four_sight::is_four_sight(bytes) {
                Some(Self::FourSight)
            } else {
                Some(Self::Hdf5)
            }
        } else if starts(b"MATLAB 5.0") {
            Some(Self::Mat5)
        } else if starts(b"Zygo XYZ Data File") || starts(b"Zygo ASCII Data File") {
            Some(Self::Xyz)
        } else if sdf::is_sdf(bytes) {
            Some(Self::Sdf)
        } else if starts(gsf::MAGIC) {
            Some(Self::Gsf)
        } else if starts(gwy::MAGIC) {
            Some(Self::Gwy)
        } else if starts(sur::MAGIC) || starts(sur::COMPRESSED) {
            Some(Self::Sur)
        } else if starts(opd::MAGIC) {
            Some(Self::Opd)
        } else if starts(zip::MAGIC) && npy::is_npz(bytes) {
            Some(Self::Npz)
        } else if starts(zip::MAGIC) && x3p::is_x3p(bytes) {
            Some(Self::X3p)
        } else {
            let text = text::text("text", bytes).ok()?;
            if codev::is_codev(&text) {
                Some(Self::CodevInt)
            } else if grid_sag::is_grid_sag(&text) {
                Some(Self::GridSag)
            } else if wft::is_wft(&text) {
                Some(Self::Wft)
            } else if presurface::is_presurface(&text) {
                Some(Self::Presurface)
            } else {
                None
            }
        }
    }

    /// Returns the format of a text of numbers from the ending of the file name, in lower case: `csv`, `xyz`, and `dat`
    /// or `txt` if the first lines are those of SRW. Returns `None` otherwise.
    pub fn of_ending(ending: &str, bytes: &[u8]) -> Option<Self> {
        match ending {
            "csv" => Some(Self::Csv),
            "xyz" => Some(Self::Xyz),
            "dat" | "txt" if srw::is_srw(&text::text("text", bytes).ok()?) => Some(Self::Srw),
            _ => None,
        }
    }
}

/// Reads a map from the bytes of a file of `format`; `pick` names the arrays to read from a file that holds several.
///
/// # Errors
/// Refuses a file that is not of the format, entries of `pick` that the format does not have, and content that its
/// reader refuses.
pub fn read(format: Format, bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    if pick.grid_mm.is_some() && format != Format::Xyz {
        let problem = "was given, but only lines x y z are interpolated";
        return Err(Invalid::whole("grid_mm", problem, "leave it out, or give `format` xyz"));
    }
    if pick.columns.is_some() && format != Format::Xyz {
        let problem = "was given, but only lines x y z have columns";
        return Err(Invalid::whole("columns", problem, "leave it out, or give `format` xyz"));
    }
    let several = matches!(
        format,
        Format::Mat5
            | Format::Hdf5
            | Format::Datx
            | Format::Fits
            | Format::Gwy
            | Format::Opd
            | Format::FourSight
            | Format::Npz
    );
    if let (Some(name), Format::Datx) = (&pick.mask, format) {
        let remedy = "a datx file marks its invalid pixels itself; leave it out";
        return Err(Invalid::whole("mask", format!("\"{name}\" was asked for"), remedy));
    }
    if let Some(name) = [&pick.dataset, &pick.x, &pick.y, &pick.mask].into_iter().flatten().next()
        && !several
    {
        let remedy =
            "only datx, mat5, hdf5, npz, fits, gwy, opd and 4sight files have names; leave it out";
        return Err(Invalid::whole("dataset", format!("\"{name}\" was asked for"), remedy));
    }
    match format {
        Format::Metropro => metropro::read(bytes),
        Format::Datx => datx::read(bytes, pick),
        Format::Xyz => points::read(bytes, pick),
        Format::Mat5 => matlab::read(bytes, pick),
        Format::Hdf5 => hdf5::read(bytes, pick),
        Format::Fits => fits::read(bytes, pick),
        Format::Csv => csv::read(bytes),
        Format::Npy => npy::read(bytes),
        Format::Npz => npy::read_archive(bytes, pick),
        Format::Sdf => sdf::read(bytes),
        Format::Gsf => gsf::read(bytes),
        Format::Gwy => gwy::read(bytes, pick),
        Format::Sur => sur::read(bytes),
        Format::CodevInt => codev::read(bytes),
        Format::GridSag => grid_sag::read(bytes),
        Format::X3p => x3p::read(bytes),
        Format::Opd => opd::read(bytes, pick),
        Format::Presurface => presurface::read(bytes),
        Format::Srw => srw::read(bytes),
        Format::Wft => wft::read(bytes),
        Format::FourSight => four_sight::read(bytes, pick),
        Format::Directory => {
            let remedy = "give the directory that holds it";
            Err(Invalid::whole("format", "directory was given for a file", remedy))
        }
    }
}

/// Returns the first 80 characters of a text of a file, without control characters, for a message or the manifest.
fn short(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(80).collect()
}
