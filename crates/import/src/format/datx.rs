//! Zygo `.datx`: HDF5 with the map in `/Data/Surface`, found through the table `/MetaData`.
//!
//! ```text
//! height (m) = raw S O W      in fringes
//! ```
//!
//! with the attributes of the dataset: interferometric scale factor S (0.5: reflected once),
//! obliquity factor O, wavelength W in m. In NanoMeters or MicroMeters the height is stored as it
//! is. Values at or beyond the attribute `No Data`, of either sign, are invalid pixels. The pitch is
//! the second parameter of the `X Converter`, in m. The first row of the file is the top. The attribute `Coordinates` has the
//! first column and row of the map in the camera, whose rows are in `Camera Height:Value` of a group of `/Attributes`.

use hdf5_reader::{Dataset, Datatype, Hdf5File};
use planish_types::Invalid;
use serde_json::json;

use super::hdf5::{Attributes, broken, matrix, open};
use crate::{
    Format, Unit,
    budget::{MOST_ARRAYS, MOST_TEXT_BYTES, check_size, too_many},
    bytes::{Bytes, Number},
    reading::{FirstRow, Pick, Reading, Window},
};

const NAME: &str = "datx file";
const SURFACES: &str = "/Data/Surface";

/// Returns true if the file is HDF5 and has the group of surfaces of a datx file, `/Data/Surface`.
pub(crate) fn is_datx(bytes: &[u8]) -> bool {
    open(bytes).is_ok_and(|file| file.group(SURFACES).is_ok())
}

/// Returns the message about a damaged datx file.
fn bad(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "export it again from the instrument")
}

/// Reads the map; `pick.dataset` names one if the file holds several.
///
/// # Errors
/// Refuses a damaged file, several maps without a name, and names of coordinates. Refuses heights without a unit or in
/// another one than fringes, nm and um, and fringes without positive factors.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    if pick.x.is_some() || pick.y.is_some() {
        let remedy = "a datx file has its pitch; leave out `x` and `y`";
        return Err(Invalid::whole(NAME, "has no arrays of coordinates", remedy));
    }
    let file = open(bytes)?;
    let path = match &pick.dataset {
        Some(path) => path.clone(),
        None => surface_path(&file)?,
    };
    let set = file.dataset(&path).map_err(broken)?;
    let [rows, columns] = set.shape() else {
        return Err(bad(format!("has a map of shape {:?}", set.shape())));
    };
    check_size("datx map", *rows as usize, *columns as usize)?;

    let attributes = Attributes::list(&set)?;
    let unit_name =
        text(&attributes, "Unit")?.ok_or_else(|| bad("does not state its unit".into()))?;
    let scale = number(&attributes, "Interferometric Scale Factor")?;
    let obliquity = number(&attributes, "Obliquity Factor")?;
    let wavelength_m = number(&attributes, "Wavelength")?;
    let (unit, factor) = match unit_name.as_str() {
        "Fringes" => match (scale, obliquity, wavelength_m) {
            // z = raw S O W
            (Some(s), Some(o), Some(w)) if s > 0.0 && o > 0.0 && w > 0.0 => {
                (Unit::named("m"), s * o * w)
            }
            factors => {
                return Err(bad(format!(
                    "has fringes with scale factor, obliquity, wavelength {factors:?}"
                )));
            }
        },
        "NanoMeters" => (Unit::named("nm"), 1.0),
        "MicroMeters" => (Unit::named("um"), 1.0),
        other => {
            let other: String = other.chars().take(40).collect();
            let remedy = "only a surface in Fringes, NanoMeters or MicroMeters is read";
            return Err(Invalid::whole(NAME, format!("is in \"{other}\""), remedy));
        }
    };
    let no_data = number(&attributes, "No Data")?;
    let mut values = matrix(&set, false)?;
    if let Some(limit) = no_data.map(f64::abs).filter(|v| *v > 0.0) {
        values.mapv_inplace(|v| if v.abs() >= limit { f64::NAN } else { v });
    }

    let mut reading = Reading::new(Format::Datx, values, FirstRow::Top);
    reading.unit = Some(unit);
    reading.factor = factor;
    reading.single = matches!(set.dtype(), Datatype::FloatingPoint { size: 4, .. });
    reading.scale_applied = scale.filter(|_| unit == Unit::named("m"));
    reading.wavelength_nm = wavelength_m.map(|w| w * 1e9);
    reading.pixel_mm = pitch_mm(&set, &attributes, &mut reading.warnings)?;
    let window = window(&attributes)?;
    if let Some([column, row, ..]) = window {
        let camera_rows = camera_rows(&file)?.filter(|n| *n >= row + *rows as f64);
        let first = [column, row];
        reading.window = Some(Window { first, in_mm: false, frame_rows: camera_rows });
    }
    reading.stated = json!({
        "dataset": path,
        "origin_pixel": window.map(|w| [w[0], w[1]]),
        "unit": unit_name,
        "interferometric_scale_factor": scale,
        "obliquity_factor": obliquity,
        "wavelength_nm": reading.wavelength_nm,
        "no_data": no_data,
    });
    Ok(reading)
}

/// Returns the path of the map, by the links Root -Measurement-> M -Surface-> S -Path-> in `/MetaData`. Without these
/// links it is the only dataset of surfaces. Refuses none or several.
fn surface_path(file: &Hdf5File) -> Result<String, Invalid> {
    if let Some(links) = links(file)? {
        let mut path = Some("Root");
        for link in ["Measurement", "Surface", "Path"] {
            path =
                links.iter().find(|l| Some(&l[0][..]) == path && l[1] == link).map(|l| &l[2][..]);
        }
        if let Some(path) = path {
            return Ok(path.to_string());
        }
    }
    let group = file.group(SURFACES).map_err(broken)?;
    let (_, names) = group.member_names().map_err(broken)?;
    match &names[..] {
        [only] => Ok(format!("{SURFACES}/{}", only.rsplit('/').next().unwrap_or(only))),
        [] => Err(Invalid::whole(NAME, "holds no surface", "export a surface")),
        several => {
            let problem = format!("holds several surfaces: {}", several.join(", "));
            Err(Invalid::whole(NAME, problem, "choose one with `dataset` /Data/Surface/NAME"))
        }
    }
}

/// Returns the rows [Source, Link, Destination] of the table `/MetaData`; `None` without a table that has them. Refuses
/// too many rows, or too much text.
fn links(file: &Hdf5File) -> Result<Option<Vec<[String; 3]>>, Invalid> {
    let Ok(set) = file.dataset("/MetaData") else { return Ok(None) };
    let Datatype::Compound { size, fields } = set.dtype() else { return Ok(None) };
    let offsets = ["Source", "Link", "Destination"]
        .map(|name| fields.iter().find(|f| f.name == name).map(|f| f.byte_offset as usize));
    let [Some(source), Some(link), Some(destination)] = offsets else { return Ok(None) };
    if set.num_elements().map_err(broken)? > MOST_ARRAYS as u64 {
        let remedy = "choose the map with `dataset`";
        return Err(too_many(NAME, MOST_ARRAYS, "rows of /MetaData", remedy));
    }
    let raw = set.read_raw_bytes().map_err(broken)?;
    let reference = set.vlen_reference_size();
    // Many rows may point to the same long text.
    let mut left = MOST_TEXT_BYTES;
    let mut links = Vec::new();
    for row in raw.chunks_exact((*size as usize).max(1)) {
        let mut texts = [String::new(), String::new(), String::new()];
        for (text, start) in texts.iter_mut().zip([source, link, destination]) {
            let end = start.checked_add(reference);
            let Some(bytes) = end.and_then(|end| row.get(start..end)) else { continue };
            let length = bytes.first_chunk().map_or(0, |b| u32::from_le_bytes(*b)) as usize;
            left = left.checked_sub(length).ok_or_else(|| {
                let what = "bytes of text in /MetaData";
                too_many(NAME, MOST_TEXT_BYTES, what, "choose the map with `dataset`")
            })?;
            let bytes = set.resolve_vlen_reference_bytes(bytes, 1).map_err(broken)?;
            *text = String::from_utf8_lossy(&bytes).trim_end_matches('\0').to_string();
        }
        links.push(texts);
    }
    Ok(Some(links))
}

/// Returns the text of the attribute `name`; `None` if it is absent or empty.
fn text(attributes: &Attributes, name: &str) -> Result<Option<String>, Invalid> {
    let Some(attribute) = attributes.get(name)? else { return Ok(None) };
    Ok(attribute.read_strings().map_err(broken)?.into_iter().next())
}

/// Returns the first number of the attribute `name`; `None` if it is absent. Refuses a number that is not finite.
fn number(attributes: &Attributes, name: &str) -> Result<Option<f64>, Invalid> {
    let Some(attribute) = attributes.get(name)? else { return Ok(None) };
    let values = attribute.read_1d::<f64>().map_err(broken)?;
    match values.first() {
        Some(v) if v.is_finite() => Ok(Some(*v)),
        other => Err(bad(format!("has \"{name}\" = {other:?}"))),
    }
}

/// Returns the pitch along [x, y], mm, from the converters of the axes; `None` unless both state it in pixels.
fn pitch_mm(
    set: &Dataset,
    attributes: &Attributes,
    warnings: &mut Vec<String>,
) -> Result<Option<[f64; 2]>, Invalid> {
    let mut pitches = Vec::new();
    for name in ["X Converter", "Y Converter"] {
        let Some((base, parameters)) = converter(set, attributes, name)? else { continue };
        let metres = parameters.get(1).copied().unwrap_or(0.0);
        if base == "Pixels" && metres > 0.0 && metres.is_finite() {
            pitches.push(metres * 1e3);
        } else {
            warnings.push(format!("{name} has {base} {parameters:?}: not used"));
        }
    }
    Ok(<[f64; 2]>::try_from(pitches).ok())
}

/// Returns first column, first row, width and height of the map in the camera, in pixels, from the attribute
/// `Coordinates`. Returns `None` if it is absent or of another layout.
fn window(attributes: &Attributes) -> Result<Option<[f64; 4]>, Invalid> {
    let Some(attribute) = attributes.get("Coordinates")? else { return Ok(None) };
    let Datatype::Compound { fields, .. } = &attribute.datatype else { return Ok(None) };
    let mut window = [0.0; 4];
    for (value, name) in window.iter_mut().zip(["ColumnStart", "RowStart", "Width", "Height"]) {
        let Some(field) = fields.iter().find(|f| f.name == name) else { return Ok(None) };
        let Datatype::FixedPoint { size: 4, .. } = field.datatype else { return Ok(None) };
        let start = field.byte_offset as usize;
        let bytes = start.checked_add(4).and_then(|end| attribute.raw_data.get(start..end));
        let Some(bytes) = bytes.and_then(|b| b.first_chunk::<4>()) else { return Ok(None) };
        *value = f64::from(i32::from_le_bytes(*bytes));
    }
    Ok(Some(window))
}

/// Returns the number of rows of the camera; `None` if no group of `/Attributes` states it as a finite number.
fn camera_rows(file: &Hdf5File) -> Result<Option<f64>, Invalid> {
    let Ok(group) = file.group("/Attributes") else { return Ok(None) };
    let (groups, _) = group.members().map_err(broken)?;
    for group in groups.iter().take(MOST_ARRAYS) {
        for attribute in group.raw_attributes().map_err(broken)? {
            let count = attribute.message().dataspace.num_elements();
            if attribute.name() == "Data Context.Data Attributes.Camera Height:Value"
                && count.is_ok_and(|n| n == 1)
            {
                let attribute = group.attribute(attribute.name()).map_err(broken)?;
                let values = attribute.read_1d::<f64>().map_err(broken)?;
                return Ok(values.first().copied().filter(|n| n.is_finite()));
            }
        }
    }
    Ok(None)
}

/// Returns the base unit and the parameters of the converter called `name`, an attribute {Category, BaseUnit,
/// Parameters}. Returns `None` if it is absent or of another type.
fn converter(
    set: &Dataset,
    attributes: &Attributes,
    name: &str,
) -> Result<Option<(String, Vec<f64>)>, Invalid> {
    let Some(attribute) = attributes.get(name)? else { return Ok(None) };
    let Datatype::Compound { fields, .. } = &attribute.datatype else { return Ok(None) };
    let reference = set.vlen_reference_size();
    let field = |name: &str, size: usize| -> Result<Vec<u8>, Invalid> {
        let start = fields.iter().find(|f| f.name == name).map(|f| f.byte_offset as usize);
        let range = start.and_then(|start| Some(start..start.checked_add(reference)?));
        let Some(bytes) = range.and_then(|range| attribute.raw_data.get(range)) else {
            return Ok(Vec::new());
        };
        let length = bytes.first_chunk().map_or(0, |b| u32::from_le_bytes(*b)) as usize;
        if length > MOST_TEXT_BYTES / 8 {
            return Ok(Vec::new());
        }
        set.resolve_vlen_reference_bytes(bytes, size).map_err(broken)
    };
    let base = String::from_utf8_lossy(&field("BaseUnit", 1)?).trim_end_matches('\0').to_string();
    let parameters = field("Parameters", 8)?;
    let b = Bytes { all: &parameters, name: NAME, big_endian: false };
    let parameters = Number::F64.decode(b.all, b.all.len() / 8, false)?;
    Ok(Some((base, parameters)))
}
