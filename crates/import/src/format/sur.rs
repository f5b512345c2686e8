//! Digital Surf `.sur`, not compressed: a header of 512 bytes, a comment, a private zone, whole numbers.
//!
//! ```text
//! height = offset + raw dz      in the unit of dz
//! ```
//!
//! | offset | type | field |
//! |---|---|---|
//! | 0 | 12 bytes | `DIGITAL SURF` |
//! | 14, 18 | i16 | number of objects, type of the object (2: surface) |
//! | 86, 88 | i16 | 1 where there are special points; 1 where the heights are absolute |
//! | 98 | i16 | bits of a number, 16 or 32 |
//! | 100, 104 | i32 | least and largest raw value |
//! | 108, 112 | i32 | columns, rows |
//! | 120, 124, 128 | f32 | dx, dy, dz |
//! | 180, 196, 212 | 16 bytes | units of dx, dy, dz |
//! | 288, 290 | i16 | 1 for a replica, inversion |
//! | 334, 336 | i16 | bytes of the comment and of the private zone |
//! | 466, 470 | f32 | offsets of the first column and row, in the units of dx and dy |
//! | 474 | f32 | offset of the heights |
//!
//! All of these are little-endian. Special points are raw values beyond the least or the largest: they are invalid. The
//! offset counts where the heights are absolute. The first row is the top. Source: the description of the format by
//! Digital Surf, as the documentation of rosettasciio and surfalize gives it.

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::check_size,
    bytes::{Bytes, Number},
    reading::{FirstRow, Reading, Window},
};

const NAME: &str = "SUR file";
const HEADER: usize = 512;
pub(crate) const MAGIC: &[u8] = b"DIGITAL SURF";
pub(crate) const COMPRESSED: &[u8] = b"DSCOMPRESSED";

/// Returns the unit in the 16 bytes from byte `start`, as text without blanks at its ends.
fn unit_word(b: &Bytes<'_>, start: usize) -> Result<String, Invalid> {
    let raw = b.slice(start, 16)?;
    // Older writers use one byte per letter.
    let text = match std::str::from_utf8(raw) {
        Ok(text) => text.to_string(),
        Err(_) => raw.iter().map(|b| char::from(*b)).collect(),
    };
    Ok(text.trim_matches(['\0', ' ']).to_string())
}

/// Returns the length at byte `start`, mm. Its unit is the text at byte `unit_at`. Refuses a unit that is no length.
fn length_mm(b: &Bytes<'_>, start: usize, unit_at: usize) -> Result<f64, Invalid> {
    let length = f64::from(b.f32(start)?);
    Ok(length * Unit::stated("coordinate_unit", &unit_word(b, unit_at)?)?.mm()?)
}

/// Reads the map of a Digital Surf file.
///
/// # Errors
/// Refuses compressed and damaged files, files of anything but one surface, and inversions. Refuses numbers of other
/// than 16 or 32 bits, and units of the pixels that are no lengths.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let refuse = |problem: String, remedy: &str| Err(Invalid::whole(NAME, problem, remedy));
    let b = Bytes { all: bytes, name: NAME, big_endian: false };
    if bytes.starts_with(COMPRESSED) {
        return refuse("is compressed".into(), "save it as an uncompressed .sur, or as .sdf");
    }
    if !bytes.starts_with(MAGIC) {
        let remedy = "give a .sur file, or the right `format`";
        return refuse("does not start with DIGITAL SURF".into(), remedy);
    }
    b.slice(0, HEADER)?;
    let objects = b.i16(14)?;
    let kind = b.i16(18)?;
    if kind != 2 || objects > 1 {
        let problem = format!("holds {objects} object(s) of type {kind}, not one surface (type 2)");
        return refuse(problem, "save the one surface alone");
    }
    let inversion = b.i16(290)?;
    if inversion != 0 {
        let problem = format!(
            "states the inversion {inversion}, of which no reader knows whether it was done"
        );
        return refuse(problem, "save it without an inversion");
    }
    let number = match b.i16(98)? {
        16 => Number::I16,
        32 => Number::I32,
        other => return refuse(format!("has numbers of {other} bits"), "save it with 16 or 32"),
    };
    let [columns, rows] = [b.i32(108)?, b.i32(112)?].map(|size| size.max(0) as usize);
    let count = check_size("SUR surface", rows, columns)?;
    let start = HEADER + usize::from(b.u16(334)?) + usize::from(b.u16(336)?);
    let raw = b.slice(start, count * number.size())?;
    let values = number.decode(raw, count, false)?;
    let values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");
    let mut reading = Reading::new(Format::Sur, values, FirstRow::Top);
    if b.i16(86)? == 1 {
        let [least, most] = [f64::from(b.i32(100)?), f64::from(b.i32(104)?)];
        reading.values.mapv_inplace(|v| if v < least || v > most { f64::NAN } else { v });
    }
    reading.state_unit("unit", &unit_word(&b, 212)?);
    reading.factor = f64::from(b.f32(128)?);
    let offset = f64::from(b.f32(474)?);
    let is_absolute = b.i16(88)? == 1;
    if is_absolute {
        reading.offset = offset;
    }
    reading.pixel_mm = Some([length_mm(&b, 120, 180)?, length_mm(&b, 124, 196)?]);
    let first = [length_mm(&b, 466, 180)?, length_mm(&b, 470, 196)?];
    // 0 is what programs write that know no place.
    if first != [0.0; 2] && first.iter().all(|v| v.is_finite()) {
        reading.window = Some(Window::at_mm(first));
    }
    if b.i16(288)? == 1 {
        let say = "the file says that a replica was measured: `negate` gives the surface it was taken from";
        reading.warnings.push(say.into());
    }
    reading.stated = json!({
        "object_name": b.text(20, 30)?,
        "dz": reading.factor,
        "z_offset": if offset.is_finite() { Some(offset) } else { None },
        "absolute": is_absolute,
    });
    Ok(reading)
}
