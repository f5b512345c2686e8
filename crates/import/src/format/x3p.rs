//! ISO 25178-72 `.x3p`: a ZIP archive of `main.xml` and the heights in bytes.
//!
//! | element of `main.xml` | what is read |
//! |---|---|
//! | `Record1/FeatureType` | `SUR`: a map |
//! | `Record1/Axes/CX`, `CY` | `AxisType` I (equal steps), `Increment` and `Offset` in m |
//! | `Record1/Axes/CZ` | `DataType` I, L, F or D: i16, i32, f32 or f64; `Increment` and `Offset` in m |
//! | `Record1/Axes/Rotation` | refused: the axes of the map are those of the part |
//! | `Record3/MatrixDimension` | `SizeX`, `SizeY`, and `SizeZ` 1 |
//! | `Record3/DataLink/PointDataLink` | member with the heights, little-endian, x first |
//! | `Record3/DataLink/ValidPointsLink` | member with a bit per pixel, 0 = invalid |
//!
//! ```text
//! height (m) = Offset + Increment raw
//! ```
//!
//! NaN is an invalid pixel too. The first row is the smallest y. Source: ISO 25178-72, and the schema `ISO5436_2.xsd` of
//! OpenGPS.

use ndarray::Array2;
use planish_types::Invalid;
use roxmltree::{Document, Node};
use serde_json::json;

use super::zip::Archive;
use crate::{
    Format, Unit,
    budget::{MOST_TEXT_BYTES, check_size},
    bytes::Number,
    reading::{FirstRow, Reading, Window},
};

const NAME: &str = "x3p file";

/// Largest size of `main.xml`, bytes. A file with heights as text within `main.xml` is larger, and is refused.
const MOST_XML: usize = 4 * MOST_TEXT_BYTES;

/// Returns true for a ZIP archive that contains `main.xml`, and for one whose directory is damaged, so that it may be
/// one.
pub(crate) fn is_x3p(bytes: &[u8]) -> bool {
    Archive::open(bytes, NAME).map_or(true, |archive| archive.has("main.xml"))
}

/// Returns the first 200 characters of the text of the element at a path such as `Record1/FeatureType`; `None` if it is
/// absent or empty.
fn text(root: Node<'_, '_>, path: &str) -> Option<String> {
    let element = path.split('/').try_fold(root, child)?;
    let text: String = element.text()?.trim().chars().take(200).collect();
    if text.is_empty() { None } else { Some(text) }
}

/// Returns the number of the element at a path; `None` if it is absent or empty. Refuses text that is no finite number.
fn number(root: Node<'_, '_>, path: &str) -> Result<Option<f64>, Invalid> {
    let Some(text) = text(root, path) else { return Ok(None) };
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() => Ok(Some(v)),
        _ => {
            let problem = format!("has \"{text}\" in {path}");
            Err(Invalid::whole(NAME, problem, "write a number there"))
        }
    }
}

/// Returns the number of pixels that `MatrixDimension` states under `name`. Refuses its absence, and a number that is
/// negative or not whole.
fn size(root: Node<'_, '_>, name: &str) -> Result<usize, Invalid> {
    let path = format!("Record3/MatrixDimension/{name}");
    match number(root, &path)? {
        // A float to an integer saturates; the size is checked next.
        Some(v) if v >= 0.0 && v.fract() == 0.0 => Ok(v as usize),
        other => {
            let problem = format!("has {path} = {other:?}");
            Err(Invalid::whole(NAME, problem, "export it as a matrix"))
        }
    }
}

/// Reads the map of an X3P archive.
///
/// # Errors
/// Refuses damaged archives, axes that are turned or not uniform, other features than maps, several layers, and another
/// number of heights than pixels. Refuses heights of another type, or as text.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let refuse = |problem: String, remedy: &str| Invalid::whole(NAME, problem, remedy);
    let again = "export it again";
    let archive = Archive::open(bytes, NAME)?;
    let xml = archive.member("main.xml", MOST_XML)?;
    let xml = std::str::from_utf8(&xml);
    let xml = xml.map_err(|_| refuse("has a main.xml that is not UTF-8".into(), again))?;
    let document = Document::parse(xml).map_err(|e| {
        let reason: String = e.to_string().chars().take(120).collect();
        refuse(format!("has a broken main.xml ({reason})"), again)
    })?;
    let root = document.root_element();
    refuse_other(root)?;
    let columns = size(root, "SizeX")?;
    let rows = size(root, "SizeY")?;
    let layers = size(root, "SizeZ")?;
    if layers != 1 {
        return Err(refuse(format!("has {layers} layers (SizeZ)"), "export one layer"));
    }
    let count = check_size("x3p map", rows, columns)?;
    let number_type = match text(root, "Record1/Axes/CZ/DataType").as_deref() {
        Some("I") => Number::I16,
        Some("L") => Number::I32,
        Some("F") => Number::F32,
        Some("D") => Number::F64,
        other => {
            return Err(refuse(format!("has heights of type {other:?}, not I, L, F or D"), again));
        }
    };
    let Some(link) = text(root, "Record3/DataLink/PointDataLink") else {
        let problem = "has no bytes of heights (PointDataLink)";
        return Err(refuse(problem.into(), "export it with binary data"));
    };
    let raw = archive.member(&link, count * number_type.size())?;
    if raw.len() != count * number_type.size() {
        let problem = format!("has {} bytes of heights for {columns} x {rows} pixels", raw.len());
        return Err(refuse(problem, again));
    }
    let values = number_type.decode(&raw, count, false)?;
    let values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");
    let mut reading = Reading::new(Format::X3p, values, FirstRow::SmallestY);
    reading.single = number_type == Number::F32;
    if let Some(link) = text(root, "Record3/DataLink/ValidPointsLink") {
        let bits = archive.member(&link, count.div_ceil(8))?;
        mark_invalid(&mut reading, &bits)?;
    }
    reading.unit = Some(Unit::named("m"));
    reading.factor = number(root, "Record1/Axes/CZ/Increment")?.unwrap_or(1.0);
    reading.offset = number(root, "Record1/Axes/CZ/Offset")?.unwrap_or(0.0);
    reading.pixel_mm = pair_mm(root, "Increment")?;
    reading.window = pair_mm(root, "Offset")?.map(Window::at_mm);
    reading.stated = json!({
        "revision": text(root, "Record1/Revision"),
        "manufacturer": text(root, "Record2/Instrument/Manufacturer"),
        "model": text(root, "Record2/Instrument/Model"),
        "z_increment_m": reading.factor,
        "z_offset_m": reading.offset,
    });
    Ok(reading)
}

/// Returns the numbers in the element `name` of the axes [x, y], converted from m to mm; `None` unless both exist.
/// Refuses text that is no number.
fn pair_mm(root: Node<'_, '_>, name: &str) -> Result<Option<[f64; 2]>, Invalid> {
    let x = number(root, &format!("Record1/Axes/CX/{name}"))?;
    let y = number(root, &format!("Record1/Axes/CY/{name}"))?;
    Ok(x.zip(y).map(|(x, y)| [x * 1e3, y * 1e3]))
}

/// Returns the first child element called `name`, in any namespace.
fn child<'a>(node: Node<'a, 'a>, name: &str) -> Option<Node<'a, 'a>> {
    node.children().find(|child| child.tag_name().name() == name)
}

/// Refuses a document that is no map on a uniform grid along the axes of the part: another feature, turned axes, or
/// steps that are not equal.
fn refuse_other(root: Node<'_, '_>) -> Result<(), Invalid> {
    let kind = text(root, "Record1/FeatureType").unwrap_or_default();
    if kind != "SUR" {
        let problem = format!("holds the feature \"{kind}\", not a map (SUR)");
        return Err(Invalid::whole(NAME, problem, "export the surface"));
    }
    if child(root, "Record1").and_then(|r| child(child(r, "Axes")?, "Rotation")).is_some() {
        let remedy = "export it with the axes of the map";
        return Err(Invalid::whole(NAME, "has turned axes (Rotation)", remedy));
    }
    for axis in ["CX", "CY"] {
        let kind = text(root, &format!("Record1/Axes/{axis}/AxisType"));
        if kind.as_deref() != Some("I") {
            let problem = format!("has an axis {axis} of type {kind:?}, not of equal steps (I)");
            return Err(Invalid::whole(NAME, problem, "export it on a uniform grid"));
        }
    }
    Ok(())
}

/// Makes the pixels invalid whose bit in `bits` is 0, the lowest bit of the first byte first. Refuses another number of
/// bytes than the pixels need.
fn mark_invalid(reading: &mut Reading, bits: &[u8]) -> Result<(), Invalid> {
    let count = reading.values.len();
    if bits.len() != count.div_ceil(8) {
        let problem = format!("has {} bytes of valid pixels for {count}", bits.len());
        return Err(Invalid::whole(NAME, problem, "export it again"));
    }
    for (k, v) in reading.values.iter_mut().enumerate() {
        if bits[k / 8] >> (k % 8) & 1 == 0 {
            *v = f64::NAN;
        }
    }
    Ok(())
}
