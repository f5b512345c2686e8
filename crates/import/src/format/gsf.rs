//! Gwyddion Simple Field `.gsf`: a header of text, then 32-bit floats.
//!
//! The first line is `Gwyddion Simple Field 1.0`; lines `key = value` follow. `XRes` and `YRes` are the pixels, `XReal` and
//! `YReal` the size of the map in `XYUnits`, `ZUnits` is the unit of the heights. One to four zero bytes fill the header
//! up to a multiple of 4 bytes; then come the heights, little-endian, row by row. The first row is the top; NaN is an
//! invalid pixel. Source: Gwyddion user guide, "Gwyddion Simple Field (GSF)".

use std::borrow::Cow;

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use super::short;
use crate::{
    Format, Unit,
    budget::{MOST_TEXT_BYTES, check_size},
    bytes::{Bytes, Number},
    reading::{FirstRow, Reading, Window},
};

const NAME: &str = "GSF file";
pub(crate) const MAGIC: &[u8] = b"Gwyddion Simple Field 1.0\n";

/// The header of a GSF file, lines `key = value`.
struct Header<'a>(Cow<'a, str>);

impl Header<'_> {
    /// Returns the value of the first line with this key; `None` if the key is absent or its value is empty.
    fn field(&self, key: &str) -> Option<String> {
        let mut pairs = self.0.lines().filter_map(|line| line.split_once('='));
        let (_, value) = pairs.find(|(k, _)| k.trim() == key)?;
        Some(value.trim().to_string()).filter(|v| !v.is_empty())
    }

    /// Returns the number of a key; `None` if the key is absent or empty. Refuses a value that is no finite number.
    fn number(&self, key: &str) -> Result<Option<f64>, Invalid> {
        let Some(text) = self.field(key) else { return Ok(None) };
        match text.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(Some(value)),
            _ => Err(bad(format!("has \"{key} = {}\"", short(&text)))),
        }
    }

    /// Returns the number of pixels that a key states. Refuses an absent key, and a number that is negative or not
    /// whole.
    fn size(&self, key: &str) -> Result<usize, Invalid> {
        match self.number(key)? {
            Some(v) if v >= 0.0 && v.fract() == 0.0 => Ok(v as usize),
            other => Err(bad(format!("has {key} = {other:?}"))),
        }
    }
}

/// Returns the message about a damaged GSF file.
fn bad(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "export it again from Gwyddion")
}

/// Reads the map. Refuses a damaged file, bytes after the heights, and a unit of the pixels that is no length.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    if !bytes.starts_with(MAGIC) {
        return Err(bad("does not start with \"Gwyddion Simple Field 1.0\"".into()));
    }
    let end = bytes.iter().take(MOST_TEXT_BYTES).position(|b| *b == 0);
    let end = end.ok_or_else(|| bad("has no end of its header".into()))?;
    let header = Header(String::from_utf8_lossy(&bytes[MAGIC.len()..end]));
    let columns = header.size("XRes")?;
    let rows = header.size("YRes")?;
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
    let unit = header.field("ZUnits");
    if let Some(name) = &unit {
        reading.state_unit("ZUnits", name);
    }
    if let (Some(x), Some(y), Some(name)) =
        (header.number("XReal")?, header.number("YReal")?, header.field("XYUnits"))
    {
        let mm = Unit::stated("XYUnits", &name)?.mm()?;
        reading.pixel_mm = Some([x * mm / columns as f64, y * mm / rows as f64]);
        if let (Some(x), Some(y)) = (header.number("XOffset")?, header.number("YOffset")?) {
            // The upper left corner of the field in the scanner, whose y goes down.
            reading.window = Some(Window::at_mm([x * mm, y * mm]));
        }
    }
    reading.stated = json!({ "z_units": unit, "title": header.field("Title").map(|t| short(&t)) });
    Ok(reading)
}
