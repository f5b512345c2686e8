//! Gwyddion `.gwy`: channels as nested objects, little-endian.
//!
//! ```text
//! file       = "GWYP" object                       the object is a GwyContainer
//! object     = name NUL, u32 size, components      size in bytes of the components
//! component  = name NUL, type, value
//! type       = b bool, c char, i int32, q int64, d double, s string NUL, o object; a capital is an array, whose value
//!              is a u32 count and so many values
//! ```
//!
//! The component `/N/data` of the container is the map of channel N, a GwyDataField: `xres` and `yres` pixels, `xreal`
//! and `yreal` its size in `si_unit_xy`, `data` the heights in `si_unit_z`, row by row. The first row is the top. The
//! units are those of the SI without a prefix. A field `/N/mask` is not 0 at marked pixels; Gwyddion itself marks
//! pixels without data so, and they are read as invalid with a warning. Source: Gwyddion user guide, "Gwyddion file
//! format" (GWY), sections "The container", "Data fields" and "Byte order".

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use super::short;
use crate::{
    Format, Unit,
    budget::{MOST_ARRAYS, MOST_TEXT_BYTES, check_size, too_many},
    bytes::{Bytes, Number},
    reading::{FirstRow, Pick, Reading, Window},
};

const NAME: &str = "GWY file";
pub(crate) const MAGIC: &[u8] = b"GWYP";

/// Refuses names of coordinates or of a mask in `pick`, because the channel has its own.
fn refuse_arrays(pick: &Pick) -> Result<(), Invalid> {
    for (name, array) in [("x", &pick.x), ("y", &pick.y), ("mask", &pick.mask)] {
        if let Some(array) = array {
            let remedy = "a channel has its coordinates and its mask itself; leave it out";
            return Err(Invalid::whole(name, format!("\"{array}\" was asked for"), remedy));
        }
    }
    Ok(())
}

/// Reads the channel whose number `pick` names, or the only one.
///
/// # Errors
/// Refuses a damaged file, several channels without a number, names of coordinates or of a mask, and units that are no
/// lengths.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    if !bytes.starts_with(MAGIC) {
        return Err(broken("does not start with \"GWYP\"".into()));
    }
    refuse_arrays(pick)?;
    let b = Bytes { all: bytes, name: NAME, big_endian: false };
    let (container, end) = object(&b, MAGIC.len())?;
    if container.name != "GwyContainer" {
        return Err(broken(format!("holds a \"{}\", not a GwyContainer", short(&container.name))));
    }
    if end != bytes.len() {
        return Err(broken(format!("has {} bytes after its container", bytes.len() - end)));
    }
    let all = container.components()?;
    let number = channel(&all, pick.dataset.as_deref())?;
    let data = field(&all, &format!("/{number}/data"))?.expect("it is a channel");
    let (rows, columns) = data.values.dim();
    let mut reading = Reading::new(Format::Gwy, data.values, FirstRow::Top);
    if let Some(name) = &data.unit_z {
        reading.state_unit("si_unit_z", name);
    }
    if let (Some([x, y]), Some(name)) = (data.real, &data.unit_xy) {
        let mm = Unit::stated("si_unit_xy", name)?.mm()?;
        reading.pixel_mm = Some([x * mm / columns as f64, y * mm / rows as f64]);
        if let Some(offset) = data.offset {
            reading.window = Some(Window::at_mm(offset.map(|v| v * mm)));
        }
    }
    if let Some(mask) = field(&all, &format!("/{number}/mask"))? {
        let marked = mask.values.iter().filter(|m| **m != 0.0).count();
        reading.apply_mask(&format!("/{number}/mask"), &mask.values)?;
        reading.warnings.push(format!(
            "the mask of the channel marks {marked} pixel(s), which are read as invalid; remove the mask in Gwyddion to \
             keep them"
        ));
    }
    reading.stated = json!({ "channel": number, "title": title(&all, number) });
    Ok(reading)
}

/// Returns the value of the first component called `name`; `None` without it.
fn find<'a, 'b>(components: &'b [Component<'a>], name: &str) -> Option<&'b Value<'a>> {
    components.iter().find(|c| c.name == name).map(|c| &c.value)
}

/// Returns the number of the requested channel, or that of the only one. Refuses several channels without a request, a
/// channel that the file does not have, and a file without channels.
fn channel<'a>(all: &'a [Component<'_>], requested: Option<&str>) -> Result<&'a str, Invalid> {
    let mut channels = Vec::new();
    for component in all.iter().filter(|c| matches!(c.value, Value::Object(_))) {
        let name = component.name.strip_prefix('/').and_then(|name| name.strip_suffix("/data"));
        channels.extend(name.filter(|number| number.bytes().all(|c| c.is_ascii_digit())));
    }
    let mut listed = Vec::new();
    for number in channels.iter().take(20) {
        let title = title(all, number);
        listed.push(if title.is_empty() {
            number.to_string()
        } else {
            format!("{number} ({title})")
        });
    }
    let listed = listed.join(", ");
    match (requested, &channels[..]) {
        (_, []) => Err(broken("holds no channel".into())),
        (Some(wanted), _) => channels.into_iter().find(|c| *c == wanted).ok_or_else(|| {
            let problem = format!("\"{}\" is no channel of the file", short(wanted));
            Invalid::whole("dataset", problem, format!("it holds: {listed}"))
        }),
        (None, [only]) => Ok(only),
        (None, many) => {
            let problem = format!("holds {} channels: {listed}", many.len());
            Err(Invalid::whole(NAME, problem, "choose one by its number with `dataset`"))
        }
    }
}

/// Returns the title of channel `number`; empty if it has none.
fn title(all: &[Component<'_>], number: &str) -> String {
    match find(all, &format!("/{number}/data/title")) {
        Some(Value::Text(text)) => short(text),
        _ => String::new(),
    }
}

/// Reads the map that is the component `name` of the container; `None` if it is absent or no object.
fn field(all: &[Component<'_>], name: &str) -> Result<Option<GwyField>, Invalid> {
    match find(all, name) {
        Some(Value::Object(object)) => GwyField::new(object).map(Some),
        _ => Ok(None),
    }
}

/// A map in a Gwyddion file (GwyDataField): heights, size, position and units.
struct GwyField {
    values: Array2<f64>,
    /// Size of the map along [x, y], in `unit_xy`.
    real: Option<[f64; 2]>,
    /// Position [x, y] of the upper left corner in the scanner, in `unit_xy`; y points down.
    offset: Option<[f64; 2]>,
    unit_xy: Option<String>,
    unit_z: Option<String>,
}

impl GwyField {
    /// Reads a map from its object. Refuses another kind of object, one without sizes or heights, and a number of
    /// heights that is not that of the pixels.
    fn new(object: &Object) -> Result<Self, Invalid> {
        if object.name != "GwyDataField" {
            return Err(broken(format!("has a \"{}\" as a channel", short(&object.name))));
        }
        let components = object.components()?;
        let columns = size(&components, "xres")?;
        let rows = size(&components, "yres")?;
        let count = check_size("GWY channel", rows, columns)?;
        let Some(Value::Doubles(raw)) = find(&components, "data") else {
            return Err(broken("has no data in a channel".into()));
        };
        if raw.len() != 8 * count {
            let there = raw.len() / 8;
            return Err(broken(format!("has {there} heights for {rows} x {columns} pixels")));
        }
        let values = Number::F64.decode(raw, count, false)?;
        let values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");
        Ok(Self {
            values,
            real: pair(&components, ["xreal", "yreal"])?,
            offset: pair(&components, ["xoff", "yoff"])?,
            unit_xy: unit(&components, "si_unit_xy")?,
            unit_z: unit(&components, "si_unit_z")?,
        })
    }
}

/// Returns the number of pixels that the component `name` states. Refuses its absence, and a negative number.
fn size(components: &[Component<'_>], name: &str) -> Result<usize, Invalid> {
    match find(components, name) {
        Some(Value::Int(n)) => usize::try_from(*n).map_err(|_| broken(format!("has {name} = {n}"))),
        _ => Err(broken(format!("has no {name} in a channel"))),
    }
}

/// Returns the two numbers in the components `names`, those of x and y; `None` unless both exist. Refuses numbers that
/// are not finite.
fn pair(components: &[Component<'_>], names: [&str; 2]) -> Result<Option<[f64; 2]>, Invalid> {
    let mut numbers = [None; 2];
    for (number, name) in numbers.iter_mut().zip(names) {
        if let Some(Value::Double(v)) = find(components, name) {
            if !v.is_finite() {
                return Err(broken(format!("has {name} = {v}")));
            }
            *number = Some(*v);
        }
    }
    let [x, y] = numbers;
    Ok(x.zip(y).map(|(x, y)| [x, y]))
}

/// Returns the symbol of the unit in the component `name`; `None` if it is absent, empty or no object of a unit.
fn unit(components: &[Component<'_>], name: &str) -> Result<Option<String>, Invalid> {
    let Some(Value::Object(object)) = find(components, name) else { return Ok(None) };
    match find(&object.components()?, "unitstr") {
        Some(Value::Text(text)) if !text.is_empty() => Ok(Some(text.clone())),
        _ => Ok(None),
    }
}

/// A serialised object: its name, and the bytes of its components.
struct Object<'a> {
    name: String,
    bytes: Bytes<'a>,
}

struct Component<'a> {
    name: String,
    value: Value<'a>,
}

/// Value of a component, of the types that the reader uses; `Other` stands for all others.
enum Value<'a> {
    Int(i32),
    Double(f64),
    Text(String),
    Doubles(&'a [u8]),
    Object(Object<'a>),
    Other,
}

impl<'a> Object<'a> {
    /// Reads the components of an object from its bytes. Refuses too many, and damaged ones.
    fn components(&self) -> Result<Vec<Component<'a>>, Invalid> {
        let b = &self.bytes;
        let mut start = 0;
        let mut components = Vec::new();
        while start < b.all.len() {
            if components.len() >= MOST_ARRAYS {
                return Err(too_many(NAME, MOST_ARRAYS, "components", "save the channel alone"));
            }
            let (name, after) = string(b, start)?;
            let kind = b.slice(after, 1)?[0];
            let (value, next) = value(b, kind, after + 1)?;
            components.push(Component { name, value });
            start = next;
        }
        Ok(components)
    }
}

/// Reads the object that begins at byte `start`. Returns it with the offset of the byte after it.
fn object<'a>(b: &Bytes<'a>, start: usize) -> Result<(Object<'a>, usize), Invalid> {
    let (name, after) = string(b, start)?;
    let size = b.u32(after)? as usize;
    let all = b.slice(after + 4, size)?;
    Ok((Object { name, bytes: Bytes { all, ..*b } }, after + 4 + size))
}

/// Reads the text from byte `start` up to a NUL. Returns it with the offset after the NUL. Refuses one that is too long
/// or does not end.
fn string(b: &Bytes, start: usize) -> Result<(String, usize), Invalid> {
    let rest = b.slice(start, b.all.len().saturating_sub(start))?;
    let end = rest.iter().take(MOST_TEXT_BYTES).position(|c| *c == 0);
    let end = end.ok_or_else(|| broken(format!("is truncated in a text at byte {start}")))?;
    Ok((String::from_utf8_lossy(&rest[..end]).into_owned(), start + end + 1))
}

/// Returns the size of a number of the type `kind` (its letter in the file), bytes; `None` for other types.
fn bytes_each(kind: u8) -> Option<usize> {
    match kind {
        b'b' | b'c' => Some(1),
        b'i' => Some(4),
        b'q' | b'd' => Some(8),
        _ => None,
    }
}

/// Reads the value of the type `kind` (its letter in the file) at byte `start`. Returns it with the offset after it.
/// Refuses other types, and a value that ends after the file.
fn value<'a>(b: &Bytes<'a>, kind: u8, start: usize) -> Result<(Value<'a>, usize), Invalid> {
    let unknown = || broken(format!("has a component of type {kind:02X} at byte {start}"));
    if kind.is_ascii_lowercase() {
        return Ok(match kind {
            b'i' => (Value::Int(b.i32(start)?), start + 4),
            b'd' => (Value::Double(b.f64(start)?), start + 8),
            b's' => {
                let (text, next) = string(b, start)?;
                (Value::Text(text), next)
            }
            b'o' => {
                let (object, next) = object(b, start)?;
                (Value::Object(object), next)
            }
            kind => {
                let size = bytes_each(kind).ok_or_else(unknown)?;
                b.slice(start, size)?;
                (Value::Other, start + size)
            }
        });
    }
    let count = b.u32(start)? as usize;
    let mut next = start + 4;
    let single = kind.to_ascii_lowercase();
    if let Some(size) = bytes_each(single) {
        let len = count.checked_mul(size).ok_or_else(unknown)?;
        let raw = b.slice(next, len)?;
        let value = if kind == b'D' { Value::Doubles(raw) } else { Value::Other };
        return Ok((value, next + len));
    }
    if count > MOST_ARRAYS {
        return Err(too_many(NAME, MOST_ARRAYS, "elements in a list", "save the channel alone"));
    }
    for _ in 0..count {
        next = match kind {
            b'S' => string(b, next)?.1,
            b'O' => object(b, next)?.1,
            _ => return Err(unknown()),
        };
    }
    match kind {
        b'S' | b'O' => Ok((Value::Other, next)),
        _ => Err(unknown()),
    }
}

/// Returns the message about a damaged Gwyddion file.
fn broken(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "save it again in Gwyddion")
}
