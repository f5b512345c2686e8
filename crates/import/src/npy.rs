//! NumPy's `.npy`: any real number type, either byte order, C or Fortran order, two axes.

use ndarray::{Array2, ShapeBuilder};
use planish_types::Invalid;

use crate::{
    Format,
    budget::check_size,
    bytes::{Bytes, Number},
    reading::{FirstRow, Reading},
};

const NAME: &str = "npy file";

/// Longest header that is read, bytes; a longer one is refused. Larger: more memory for a hostile file.
/// Smaller: refuses long headers. Chosen: an array of numbers needs about a hundred bytes; a longer header
/// belongs to a structured dtype.
const LONGEST_HEADER: usize = 4096;

/// Reads an array with two axes.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let b = Bytes { all: bytes, name: NAME, big_endian: false };
    let bad = |problem: String| {
        Invalid::whole(NAME, problem, "save a 2-D array of real numbers with numpy.save")
    };
    if b.slice(0, 6)? != b"\x93NUMPY" {
        return Err(bad("does not start with the magic of NumPy".into()));
    }
    let (start, length) = match b.slice(6, 1)?[0] {
        1 => (10, usize::from(b.u16(8)?)),
        2 | 3 => (12, b.u32(8)? as usize),
        other => return Err(bad(format!("has version {other}"))),
    };
    if length > LONGEST_HEADER {
        return Err(bad(format!("has a header of {length} bytes")));
    }
    let header = String::from_utf8_lossy(b.slice(start, length)?).into_owned();
    let descriptor = quoted(&header, "'descr':").ok_or_else(|| bad("has no plain dtype".into()))?;
    let (number, big_endian) = dtype(descriptor).ok_or_else(|| match descriptor.get(1..2) {
        Some("c") => Invalid::whole(
            NAME,
            format!("holds complex numbers of type \"{descriptor}\""),
            "save a.real, or numpy.angle(a) for a phase",
        ),
        _ => bad(format!("holds elements of type \"{descriptor}\"")),
    })?;
    let fortran = after(&header, "'fortran_order':").is_some_and(|t| t.starts_with("True"));
    let shape = shape(&header).ok_or_else(|| bad("has no readable shape".into()))?;
    // Axes of one pixel before the map say nothing.
    let start_of_map = shape.len().saturating_sub(2);
    let (leading, map) = shape.split_at(start_of_map);
    let ([rows, columns], true) = (map, leading.iter().all(|n| *n == 1)) else {
        return Err(bad(format!("has shape {shape:?}, not two axes")));
    };
    let (rows, columns) = (*rows, *columns);

    let count = check_size(NAME, rows, columns)?;
    let data = b.slice(start + length, count * number.size())?;
    if bytes.len() != start + length + data.len() {
        return Err(bad(format!(
            "has {} bytes after the array",
            bytes.len() - start - length - data.len()
        )));
    }
    let values = number.decode(data, count, big_endian)?;
    let values = Array2::from_shape_vec((rows, columns).set_f(fortran), values)
        .expect("one value per element");
    let mut reading = Reading::new(Format::Npy, values, FirstRow::SmallestY);
    reading.single = number == Number::F32;
    reading.stated = serde_json::json!({ "dtype": descriptor, "fortran_order": fortran });
    Ok(reading)
}

fn after<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    header.find(key).map(|at| header[at + key.len()..].trim_start())
}

fn quoted<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    after(header, key)?.strip_prefix('\'')?.split('\'').next()
}

fn shape(header: &str) -> Option<Vec<usize>> {
    let inside = after(header, "'shape':")?.strip_prefix('(')?.split(')').next()?;
    let sizes = inside.split(',').map(str::trim).filter(|s| !s.is_empty());
    sizes.map(|s| s.parse().ok()).collect()
}

fn dtype(descriptor: &str) -> Option<(Number, bool)> {
    let (order, kind) = descriptor.split_at_checked(1)?;
    let number = match kind {
        "i1" => Number::I8,
        "u1" | "b1" => Number::U8,
        "i2" => Number::I16,
        "u2" => Number::U16,
        "i4" => Number::I32,
        "u4" => Number::U32,
        "i8" => Number::I64,
        "u8" => Number::U64,
        "f2" => Number::F16,
        "f4" => Number::F32,
        "f8" => Number::F64,
        _ => return None,
    };
    matches!(order, "<" | ">" | "|" | "=").then_some((number, order == ">"))
}
