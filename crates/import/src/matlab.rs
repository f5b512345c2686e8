//! MATLAB `.mat`, version 5 (also 6 and 7): named matrices, column by column, compressed or not.
//!
//! Only real numeric matrices are read; cells, structures and text are passed over. The customary
//! names `X Y Z` and `Xtif Ytif Ztif` are found by themselves. A matrix has neither unit nor pitch.

use flate2::{Decompress, FlushDecompress, Status};
use ndarray::{Array2, ShapeBuilder};
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, MOST_PIXELS,
    bytes::{Bytes, Number},
    check_size,
    hdf5::{along, choose},
    reading::{Coordinates, FirstRow, Pick, Reading},
};

const NAME: &str = "MAT file";
const HEADER: usize = 128;

/// Types of data elements.
const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;

/// Most bytes that the compressed variables of a file may grow to, all together.
const MOST_BYTES: usize = 16 * MOST_PIXELS;

/// A real numeric matrix, not yet decoded.
struct Variable<'a> {
    name: String,
    rows: usize,
    columns: usize,
    number: Number,
    data: std::borrow::Cow<'a, [u8]>,
}

/// Reads the matrix that `pick` names; without a name a customary one, or the only one there is.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    let mut b = Bytes { all: bytes, name: NAME, big_endian: false };
    if !bytes.starts_with(b"MATLAB 5.0") {
        let problem = "does not start with MATLAB 5.0";
        return Err(Invalid::whole(NAME, problem, "save with -v7, or give the right --format"));
    }
    b.big_endian = match b.slice(126, 2)? {
        b"IM" => false,
        b"MI" => true,
        other => return Err(broken(format!("has the byte order mark {other:02X?}"))),
    };
    let variables = variables(&b)?;
    let shapes: Vec<(String, Vec<u64>)> =
        variables.iter().map(|v| (v.name.clone(), vec![v.rows as u64, v.columns as u64])).collect();
    let pick = choose(&shapes, pick, NAME)?;
    let get = |name: &str| -> Result<Array2<f64>, Invalid> {
        let found = variables.iter().find(|v| v.name == name).ok_or_else(|| {
            let names: Vec<&str> = variables.iter().map(|v| v.name.as_str()).take(20).collect();
            let problem = format!("has no numeric matrix \"{name}\"");
            Invalid::whole(NAME, problem, format!("it holds: {}", names.join(", ")))
        })?;
        let values = found.number.decode(&found.data, found.rows * found.columns, b.big_endian);
        let matrix = Array2::from_shape_vec((found.rows, found.columns).f(), values)
            .map_err(|_| broken(format!("is truncated in \"{name}\"")))?;
        Ok(matrix.as_standard_layout().into_owned())
    };
    let name = pick.data.as_deref().unwrap_or_default();
    let values = get(name)?;
    let (rows, columns) = values.dim();
    check_size("matrix", rows, columns)?;
    let mut reading = Reading::new(Format::Mat5, values, FirstRow::SmallestY);
    if let (Some(x), Some(y)) = (&pick.x, &pick.y) {
        reading.coordinates = Some(Coordinates {
            x: along("x", &get(x)?, columns, true)?,
            y: along("y", &get(y)?, rows, false)?,
            unit: None,
        });
    }
    reading.stated = json!({ "dataset": name, "x": pick.x, "y": pick.y });
    Ok(reading)
}

fn broken(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "save it again with -v7")
}

fn variables<'a>(b: &Bytes<'a>) -> Result<Vec<Variable<'a>>, Invalid> {
    let mut found = Vec::new();
    let (mut at, mut grown) = (HEADER, 0);
    while at < b.all.len() {
        let element = element(b, at)?;
        at = element.next;
        match element.kind {
            MATRIX => found.extend(matrix(element.data, b.big_endian)?),
            COMPRESSED => {
                let inflated = inflate(element.data, MOST_BYTES - grown)?;
                let inner = Bytes { all: &inflated, ..*b };
                let e = self::element(&inner, 0)?;
                if e.kind != MATRIX {
                    continue;
                }
                if let Some(v) = matrix(e.data, b.big_endian)? {
                    grown += v.data.len();
                    found.push(Variable { data: v.data.into_owned().into(), ..v });
                }
            }
            _ => {}
        }
    }
    Ok(found)
}

/// A data element: its type, its bytes, and where the next one is.
struct Element<'a> {
    kind: u32,
    data: &'a [u8],
    next: usize,
}

fn element<'a>(b: &Bytes<'a>, at: usize) -> Result<Element<'a>, Invalid> {
    let tag = b.u32(at)?;
    if tag >> 16 != 0 {
        // The small format: size and type in one word, up to 4 bytes after it.
        let (kind, size) = (tag & 0xffff, (tag >> 16) as usize);
        if size > 4 {
            return Err(broken(format!("has a small element of {size} bytes at byte {at}")));
        }
        return Ok(Element { kind, data: b.slice(at + 4, size)?, next: at + 8 });
    }
    let size = b.u32(at + 4)? as usize;
    let data = b.slice(at + 8, size)?;
    // Elements start at multiples of 8 bytes, but compressed ones follow each other.
    let padded = if tag == COMPRESSED { size } else { size.div_ceil(8) * 8 };
    Ok(Element { kind: tag, data, next: at + 8 + padded })
}

/// A real numeric matrix; `None` for anything else.
fn matrix(data: &[u8], big_endian: bool) -> Result<Option<Variable<'_>>, Invalid> {
    let b = Bytes { all: data, name: NAME, big_endian };
    let flags = element(&b, 0)?;
    let dimensions = element(&b, flags.next)?;
    let name = element(&b, dimensions.next)?;
    let word = Bytes { all: flags.data, ..b }.u32(0)?;
    let (class, is_complex) = (word & 0xff, word & 0x800 != 0);
    let name_text = String::from_utf8_lossy(name.data).into_owned();
    // Classes 6 .. 15: double, single, int8 .. uint64.
    if !(6..=15).contains(&class) || is_complex || dimensions.data.len() != 8 {
        return Ok(None);
    }
    let sizes = Bytes { all: dimensions.data, ..b };
    let (rows, columns) = (sizes.i32(0)?, sizes.i32(4)?);
    let (Ok(rows), Ok(columns)) = (usize::try_from(rows), usize::try_from(columns)) else {
        return Err(broken(format!("has \"{name_text}\" of {rows} x {columns}")));
    };
    if rows * columns == 0 {
        return Ok(None);
    }
    let values = element(&b, name.next)?;
    let number = match values.kind {
        1 => Number::I8,
        2 => Number::U8,
        3 => Number::I16,
        4 => Number::U16,
        5 => Number::I32,
        6 => Number::U32,
        7 => Number::F32,
        9 => Number::F64,
        12 => Number::I64,
        13 => Number::U64,
        other => return Err(broken(format!("has \"{name_text}\" stored as type {other}"))),
    };
    if rows.checked_mul(columns).and_then(|n| n.checked_mul(number.size()))
        != Some(values.data.len())
    {
        return Err(broken(format!(
            "has \"{name_text}\" of {rows} x {columns} in {} bytes",
            values.data.len()
        )));
    }
    Ok(Some(Variable { name: name_text, rows, columns, number, data: values.data.into() }))
}

/// Inflates, but not beyond `most` bytes.
fn inflate(compressed: &[u8], most: usize) -> Result<Vec<u8>, Invalid> {
    let mut stream = Decompress::new(true);
    let mut out = Vec::new();
    loop {
        // Grows with what comes out, not with what a header claims.
        let more = (2 * out.len()).clamp(1 << 16, 1 << 26);
        out.reserve(more);
        let before = (stream.total_in(), stream.total_out());
        let rest = &compressed[(stream.total_in() as usize).min(compressed.len())..];
        let status = stream
            .decompress_vec(rest, &mut out, FlushDecompress::None)
            .map_err(|e| broken(format!("has a broken compressed element ({e})")))?;
        if out.len() > most {
            let problem = format!("grows beyond {most} bytes when it is inflated");
            return Err(Invalid::whole(NAME, problem, "save only the map"));
        }
        match status {
            Status::StreamEnd => return Ok(out),
            _ if (stream.total_in(), stream.total_out()) == before => {
                return Err(broken("is truncated in a compressed element".into()));
            }
            _ => {}
        }
    }
}
