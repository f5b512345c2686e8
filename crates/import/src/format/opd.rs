//! Wyko and Veeco `.opd`: a directory of blocks, then the blocks one after the other.
//!
//! After two bytes the directory has 24 bytes per block: name (16), type (u16), length (u32), and two more bytes; its first
//! entry is the directory itself. An array block (type 3) begins with columns, rows and bytes per number (u16 each); the
//! numbers go up each column, y ascending, from the first column to the last. All of these are little-endian.
//!
//! ```text
//! height (waves) = raw            32-bit floats; 1e38 and more is invalid
//! height (waves) = raw / Mult     16-bit integers; 32766 and more is invalid
//! ```
//!
//! `Wavelength` is in nm, `Pixel_size` (of x) in mm, `Aspect` is the pitch along y over that along x. Source: the
//! documentation of Gwyddion and of SurfaceTopography on the format.

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::{MOST_ARRAYS, check_size, too_many},
    bytes::{Bytes, Number},
    reading::{FirstRow, Pick, Reading},
};

const NAME: &str = "OPD file";
const ENTRY: usize = 24;
pub(crate) const MAGIC: &[u8] = b"\x01\x00Directory";

/// Names of the blocks that may hold heights.
const MAPS: [&str; 4] = ["RAW_DATA", "RAW DATA", "OPD", "SAMPLE_DATA"];

struct Block {
    name: String,
    kind: u16,
    start: usize,
    len: usize,
}

/// Reads the map from the only block of heights, or from the one that `pick.dataset` names.
///
/// # Errors
/// Refuses damaged files, several blocks of heights without a name, numbers of other types, and names of coordinates or
/// of a mask. Refuses integers without a positive `Mult`.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    let b = Bytes { all: bytes, name: NAME, big_endian: false };
    if !bytes.starts_with(MAGIC) {
        return Err(bad("does not start with a directory".into()));
    }
    if pick.x.is_some() || pick.y.is_some() || pick.mask.is_some() {
        let remedy = "it has its pitch and marks invalid pixels; leave out `x`, `y` and `mask`";
        return Err(Invalid::whole(NAME, "has no arrays of coordinates, no mask", remedy));
    }
    let blocks = blocks(&b)?;
    let block = chosen(&blocks, pick)?;
    let parameter = |name: &str| parameter(&b, &blocks, name);
    let columns = usize::from(b.u16(block.start)?);
    let rows = usize::from(b.u16(block.start + 2)?);
    let (number, invalid) = match b.u16(block.start + 4)? {
        2 => (Number::I16, 32766.0),
        4 => (Number::F32, 1e38),
        other => return Err(bad(format!("has numbers of {other} bytes in {}", block.name))),
    };
    let count = check_size("OPD map", rows, columns)?;
    if block.len < 6 + count * number.size() {
        let problem = format!("has {rows} x {columns} pixels in {} bytes", block.len);
        return Err(bad(problem));
    }
    let raw = b.slice(block.start + 6, count * number.size())?;
    let values = number.decode(raw, count, false)?;
    let values = Array2::from_shape_vec((columns, rows), values).expect("one value per pixel");
    let values = values.reversed_axes().as_standard_layout().into_owned();
    let mut reading = Reading::new(Format::Opd, values, FirstRow::SmallestY);
    // The marker itself passed through a 32-bit float.
    reading.values.mapv_inplace(|v| if v >= invalid * (1.0 - 1e-6) { f64::NAN } else { v });
    reading.single = number == Number::F32;
    reading.unit = Some(Unit::named("waves"));
    reading.wavelength_nm = parameter("Wavelength")?;
    let mult = parameter("Mult")?;
    if number == Number::I16 {
        match mult {
            Some(mult) if mult > 0.0 => reading.factor = 1.0 / mult,
            other => return Err(bad(format!("has integers and Mult = {other:?}"))),
        }
    }
    let pixel = parameter("Pixel_size")?;
    let aspect = parameter("Aspect")?.unwrap_or(1.0);
    reading.pixel_mm = pixel.filter(|v| *v > 0.0).map(|v| [v, v * aspect]);
    let wedge = parameter("Wedge")?;
    if let Some(wedge) = wedge.filter(|w| *w != 0.0 && *w != 1.0) {
        let say = format!(
            "the file states the wedge factor {wedge}; the heights are stored value x wavelength, as public readers \
             have it: compare them with the instrument"
        );
        reading.warnings.push(say);
    }
    reading.stated = json!({
        "block": block.name,
        "wavelength_nm": reading.wavelength_nm,
        "mult": mult,
        "aspect": aspect,
        "wedge": wedge,
    });
    Ok(reading)
}

/// Returns the blocks that the directory of the file lists, with their offsets and lengths, bytes. Refuses too many.
fn blocks(b: &Bytes<'_>) -> Result<Vec<Block>, Invalid> {
    let entries = b.u32(2 + 18)? as usize / ENTRY;
    if entries > MOST_ARRAYS {
        return Err(too_many(NAME, MOST_ARRAYS, "blocks", "export only the map"));
    }
    let mut blocks = Vec::new();
    let mut start = 2usize;
    for i in 0..entries {
        let entry = 2 + ENTRY * i;
        let len = b.u32(entry + 18)? as usize;
        blocks.push(Block { name: b.text(entry, 16)?, kind: b.u16(entry + 16)?, start, len });
        start = start.saturating_add(len);
    }
    Ok(blocks)
}

/// Returns the first block called `name` that is not empty; `None` without it.
fn find<'a>(blocks: &'a [Block], name: &str) -> Option<&'a Block> {
    blocks.iter().find(|block| block.name == name && block.len > 0)
}

/// Returns the number in the block called `name`; `None` without it. Refuses a block of another type, and a number that
/// is not finite.
fn parameter(b: &Bytes<'_>, blocks: &[Block], name: &str) -> Result<Option<f64>, Invalid> {
    let Some(block) = find(blocks, name) else { return Ok(None) };
    let value = match block.kind {
        6 => f64::from(b.i16(block.start)?),
        7 => f64::from(b.f32(block.start)?),
        8 => b.f64(block.start)?,
        12 => f64::from(b.i32(block.start)?),
        other => return Err(bad(format!("has {name} of type {other}"))),
    };
    if !value.is_finite() {
        return Err(bad(format!("has {name} = {value}")));
    }
    Ok(Some(value))
}

/// Returns the array block that `pick.dataset` names, or the only block of heights. Refuses an absent one, and several
/// without a name.
fn chosen<'a>(blocks: &'a [Block], pick: &Pick) -> Result<&'a Block, Invalid> {
    let maps: Vec<&Block> = blocks
        .iter()
        .filter(|m| MAPS.contains(&m.name.as_str()) && m.kind == 3 && m.len > 6)
        .collect();
    match (&pick.dataset, &maps[..]) {
        (Some(name), _) => {
            let listed: Vec<&str> = blocks.iter().take(40).map(|m| m.name.as_str()).collect();
            let listed = format!("it holds: {}", listed.join(", "));
            find(blocks, name)
                .filter(|block| block.kind == 3)
                .ok_or_else(|| Invalid::whole(NAME, format!("has no array \"{name}\""), listed))
        }
        (None, [only]) => Ok(only),
        (None, []) => Err(bad("holds no heights (RAW_DATA, OPD or SAMPLE_DATA)".into())),
        (None, several) => {
            let listed: Vec<&str> = several.iter().take(20).map(|m| m.name.as_str()).collect();
            let problem = format!("holds several maps: {}", listed.join(", "));
            Err(Invalid::whole(NAME, problem, "choose one with `dataset`"))
        }
    }
}

/// Returns the message about a damaged OPD file.
fn bad(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "export it again from the instrument")
}
