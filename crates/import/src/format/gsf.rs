//! Gwyddion Simple Field `.gsf`: a header of text, then 32-bit floats.
//!
//! The first line is `Gwyddion Simple Field 1.0`; lines `key = value` follow. `XRes` and `YRes` are the pixels, `XReal` and
//! `YReal` the size of the map in `XYUnits`, `ZUnits` is the unit of the heights. One to four zero bytes fill the header
//! up to a multiple of 4 bytes; then come the heights, little-endian, row by row. The first row is the top; NaN is an
//! invalid pixel. Source: Gwyddion user guide, "Gwyddion Simple Field (GSF)".

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::{MOST_TEXT_BYTES, check_size},
    bytes::{Bytes, Number},
    reading::{FirstRow, Reading, Window},
};

const NAME: &str = "GSF file";
pub(crate) const MAGIC: &[u8] = b"Gwyddion Simple Field 1.0\n";

/// Reads a field.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let bad = |problem: String| Invalid::whole(NAME, problem, "export it again from Gwyddion");
    if !bytes.starts_with(MAGIC) {
        return Err(bad("does not start with \"Gwyddion Simple Field 1.0\"".into()));
    }
    let end = bytes.iter().take(MOST_TEXT_BYTES).position(|b| *b == 0);
    let end = end.ok_or_else(|| bad("has no end of its header".into()))?;
    let header = String::from_utf8_lossy(&bytes[MAGIC.len()..end]);
    let field = |key: &str| {
        let pairs = header.lines().filter_map(|line| line.split_once('='));
        let mut found = pairs.filter(|(k, _)| k.trim() == key).map(|(_, v)| v.trim().to_string());
        found.next().filter(|v| !v.is_empty())
    };
    let number = |key: &str| -> Result<Option<f64>, Invalid> {
        let parse = |text: String| {
            let value = text.parse::<f64>().ok().filter(|v| v.is_finite());
            value.ok_or_else(|| bad(format!("has \"{key} = {}\"", short(&text))))
        };
        field(key).map(parse).transpose()
    };
    let size = |key: &str| match number(key)? {
        Some(v) if v >= 0.0 && v.fract() == 0.0 => Ok(v as usize),
        other => Err(bad(format!("has {key} = {other:?}"))),
    };
    let (columns, rows) = (size("XRes")?, size("YRes")?);
    let count = check_size("GSF field", rows, columns)?;
    let start = end + 4 - end % 4;
    let b = Bytes { all: bytes, name: NAME, big_endian: false };
    b.slice(end, start - end)?;
    let raw = b.slice(start, 4 * count)?;
    if bytes.len() != start + raw.len() {
        let more = bytes.len() - start - raw.len();
        return Err(bad(format!("has {more} bytes after its {rows} x {columns} pixels")));
    }
    let values = Number::F32.decode(raw, count, false)?;
    let values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");
    let mut reading = Reading::new(Format::Gsf, values, FirstRow::Top);
    reading.single = true;
    let unit = field("ZUnits");
    if let Some(name) = &unit {
        reading.state_unit("ZUnits", name);
    }
    if let (Some(x), Some(y), Some(name)) = (number("XReal")?, number("YReal")?, field("XYUnits")) {
        let mm = Unit::stated("XYUnits", &name)?.mm()?;
        reading.pixel_mm = Some([x * mm / columns as f64, y * mm / rows as f64]);
        if let (Some(x), Some(y)) = (number("XOffset")?, number("YOffset")?) {
            // The upper left corner of the field in the scanner, whose y goes down.
            reading.window = Some(Window::at_mm([x * mm, y * mm]));
        }
    }
    reading.stated = json!({ "z_units": unit, "title": field("Title").map(|t| short(&t)) });
    Ok(reading)
}

fn short(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(80).collect()
}
