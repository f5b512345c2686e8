//! Surface data files of ISO 25178-71: `aISO-1.0` in text, `bISO-1.0` in little-endian bytes; the same with `BCR`, as
//! the older EUNA 15178 has it, and `ISO-2.0`, in which the numbers of points and profiles in bytes have 32 bits.
//!
//! `height (m) = raw Zscale`, pitch Xscale and Yscale in m. In text `BAD` marks an invalid pixel; in
//! bytes, and in text of integers, the least value of a signed integer or a float, the largest of an unsigned integer,
//! or NaN. The first row
//! of the file is the smallest y.

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::{MOST_HEADER_LINES, check_size, too_many},
    bytes::{Bytes, Number},
    reading::{FirstRow, Reading},
    text,
};

const NAME: &str = "SDF file";

/// Size of a binary header whose numbers of points and profiles have 16 bits, bytes.
const HEADER: usize = 81;

/// First bytes of files in text, and (`BYTES`) of files in binary form.
const TEXT: [&[u8]; 3] = [b"aISO-1.0", b"aISO-2.0", b"aBCR-1.0"];
const BYTES: [&[u8]; 3] = [b"bISO-1.0", WIDE, b"bBCR-1.0"];
/// First bytes of a binary file whose numbers of points and profiles have 32 bits.
const WIDE: &[u8] = b"bISO-2.0";

/// Returns true if the file begins as a surface data file does. In text, blanks may come first.
pub(crate) fn is_sdf(bytes: &[u8]) -> bool {
    is_text(bytes) || BYTES.iter().any(|magic| bytes.starts_with(magic))
}

/// Returns true if the file begins as a surface data file in text does.
fn is_text(bytes: &[u8]) -> bool {
    let text = bytes.trim_ascii_start();
    TEXT.iter().any(|magic| text.starts_with(magic))
}

/// Reads the map. Refuses damaged and compressed files, files of other first bytes, and another number of heights than
/// pixels.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    if is_text(bytes) {
        ascii(bytes)
    } else if is_sdf(bytes) {
        binary(bytes)
    } else {
        let problem = "does not start with aISO or bISO 1.0 or 2.0, aBCR-1.0 or bBCR-1.0";
        Err(Invalid::whole(NAME, problem, "give an SDF file, or the right `format`"))
    }
}

/// Returns the number type for the code `kind` of the header. Refuses an unknown code.
fn number(kind: u8) -> Result<Number, Invalid> {
    match kind {
        0 => Ok(Number::U8),
        1 => Ok(Number::U16),
        2 => Ok(Number::U32),
        3 => Ok(Number::F32),
        4 => Ok(Number::I8),
        5 => Ok(Number::I16),
        6 => Ok(Number::I32),
        7 => Ok(Number::F64),
        other => Err(Invalid::whole(NAME, format!("has data type {other}"), "export it again")),
    }
}

/// Returns the stored value that marks an invalid pixel, for numbers of this type: the largest of an unsigned integer,
/// the least of other types.
fn marker(number: Number) -> f64 {
    match number {
        Number::U8 => f64::from(u8::MAX),
        Number::U16 => f64::from(u16::MAX),
        Number::U32 => f64::from(u32::MAX),
        Number::I8 => f64::from(i8::MIN),
        Number::I16 => f64::from(i16::MIN),
        Number::I32 => f64::from(i32::MIN),
        Number::F32 => f64::from(f32::MIN),
        _ => f64::MIN,
    }
}

/// Returns the reading of stored values with the numbers of a header: [columns, rows], scales [x, y, z] in m, and
/// [compression, check type]. Refuses a compressed file, a check type outside of 0 to 255, and a z scale of 0.
fn finish(
    values: Vec<f64>,
    [columns, rows]: [usize; 2],
    scale_m: [f64; 3],
    checks: [f64; 2],
) -> Result<Reading, Invalid> {
    let [compression, check] = checks;
    if compression != 0.0 || !(0.0..=255.0).contains(&check) {
        let problem = format!("has compression {compression}, check type {check}");
        return Err(Invalid::whole(NAME, problem, "export it without compression"));
    }
    let values = Array2::from_shape_vec((rows, columns), values).map_err(|_| {
        Invalid::whole(NAME, "does not hold the pixels it claims", "export it again")
    })?;
    let mut reading = Reading::new(Format::Sdf, values, FirstRow::SmallestY);
    let [x, y, z] = scale_m;
    if !(z.is_finite() && z != 0.0) {
        return Err(Invalid::whole(NAME, format!("has Zscale {z}"), "export it again"));
    }
    reading.unit = Some(Unit::named("m"));
    reading.factor = z;
    reading.pixel_mm = Some([x * 1e3, y * 1e3]);
    reading.stated = json!({ "z_scale_m": z });
    Ok(reading)
}

/// Reads a surface data file in text. Refuses a header without its numbers, and another number of heights than pixels.
fn ascii(bytes: &[u8]) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let text = text.as_ref();
    let mut lines = text.lines().enumerate();
    let mut fields = Vec::new();
    for (_, line) in lines.by_ref() {
        if line.trim() == "*" {
            break;
        }
        if let Some((key, value)) = line.split_once('=') {
            if fields.len() == MOST_HEADER_LINES {
                let remedy = "export it again";
                return Err(too_many(NAME, MOST_HEADER_LINES, "lines of its header", remedy));
            }
            fields.push((key.trim().to_ascii_lowercase(), value.trim()));
        }
    }
    let get = |key: &str| -> Result<f64, Invalid> {
        let value = fields.iter().find(|(k, _)| k == key).and_then(|(_, v)| v.parse().ok());
        value.ok_or_else(|| {
            Invalid::whole(NAME, format!("has no number for {key}"), "export it again")
        })
    };
    let size = |key: &str| -> Result<usize, Invalid> {
        let v = get(key)?;
        // A float to an integer saturates; the size is checked next.
        if v >= 0.0 && v.fract() == 0.0 {
            Ok(v as usize)
        } else {
            Err(Invalid::whole(NAME, format!("has {key} = {v}"), "export it again"))
        }
    };
    let columns = size("numpoints")?;
    let rows = size("numprofiles")?;
    let count = check_size("SDF map", rows, columns)?;
    let scales = [get("xscale")?, get("yscale")?, get("zscale")?];
    let mut values = Vec::new();
    for (i, line) in lines {
        if line.trim() == "*" {
            break;
        }
        for (k, field) in line.split_whitespace().enumerate() {
            if values.len() == count {
                let problem = format!("has more than {count} numbers in line {}", i + 1);
                return Err(Invalid::whole(NAME, problem, "export it again"));
            }
            values.push(text::number(NAME, field, i + 1, k + 1)?);
        }
    }
    if values.len() != count {
        let problem = format!("is truncated: {} of {count} pixels", values.len());
        return Err(Invalid::whole(NAME, problem, "export it again"));
    }
    if let Ok(kind @ 0.0..=7.0) = get("datatype") {
        let invalid = marker(number(kind as u8)?);
        values.iter_mut().filter(|v| **v == invalid).for_each(|v| *v = f64::NAN);
    }
    let checks = [get("compression")?, get("checktype").unwrap_or(0.0)];
    finish(values, [columns, rows], scales, checks)
}

/// Reads a surface data file in binary form. Refuses a truncated one, and unknown types of numbers.
fn binary(bytes: &[u8]) -> Result<Reading, Invalid> {
    let b = Bytes { all: bytes, name: NAME, big_endian: false };
    // 8 version, 10 manufacturer, 12 + 12 dates, sizes, scales, compression, types.
    let (columns, rows, more) = if bytes.starts_with(WIDE) {
        (b.u32(42)? as usize, b.u32(46)? as usize, 4)
    } else {
        (usize::from(b.u16(42)?), usize::from(b.u16(44)?), 0)
    };
    let scales = [b.f64(46 + more)?, b.f64(54 + more)?, b.f64(62 + more)?];
    let [compression, kind, check] =
        [78, 79, 80].map(|start| start + more).map(|start| b.slice(start, 1).map(|s| s[0]));
    let number = number(kind?)?;
    let count = check_size("SDF map", rows, columns)?;
    let raw = b.slice(HEADER + more, count * number.size())?;
    let mut values = number.decode(raw, count, false)?;
    let invalid = marker(number);
    values.iter_mut().filter(|v| **v == invalid).for_each(|v| *v = f64::NAN);
    let checks = [f64::from(compression?), f64::from(check?)];
    let mut reading = finish(values, [columns, rows], scales, checks)?;
    reading.single = number == Number::F32;
    Ok(reading)
}
