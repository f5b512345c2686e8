//! NumPy's `.npy`: any real number type, either byte order, C or Fortran order, two axes; and `.npz`, a ZIP archive of them.
//!
//! In a `.npz` the customary names `X Y Z` are found by themselves. Arrays of one number or one text beside the map may state
//! its pitch and its unit (`pixel_mm`, `unit`), and its name may have its unit (`height_nm`).

use ndarray::{Array2, ShapeBuilder};
use planish_types::Invalid;

use super::zip::Archive;
use crate::{
    Format,
    arrays::{Arrays, TURNED, choose, is_turned, named_coordinates, prefix, upright},
    beside::{Beside, Variable},
    budget::{BYTES_PER_PIXEL, MOST_ARRAYS, check_elements, check_size, most_of, too_many},
    bytes::{Bytes, Number},
    reading::{FirstRow, Pick, Reading},
};

const NAME: &str = "npy file";

/// Longest header that is read, bytes; a longer one is refused. Larger: more memory for a hostile file.
/// Smaller: refuses long headers. Chosen: an array of numbers needs about a hundred bytes; a longer header
/// belongs to a structured dtype.
const LONGEST_HEADER: usize = 4096;

/// Longest text in a `.npz` that is read, bytes; a longer one is passed over. Larger: more time on hostile files.
/// Smaller: long statements are not seen.
const LONGEST_TEXT: usize = 800;

/// An array of a file: its shape without leading axes of length 1 before the last two, its numbers in the order of the
/// file, and its type.
struct Stored {
    shape: Vec<usize>,
    values: Vec<f64>,
    is_fortran: bool,
    number: Number,
    descriptor: String,
    /// Text of an array that holds one text; `None` for numbers.
    text: Option<String>,
}

impl Stored {
    /// Returns true if the array holds numbers on at most two axes, so that it may be a map, coordinates or a mask.
    fn is_number(&self) -> bool {
        self.text.is_none() && self.shape.len() <= 2
    }

    /// Returns the array as a matrix (rows, columns); a vector becomes one row. Refuses more axes.
    fn matrix(&self) -> Result<Array2<f64>, Invalid> {
        let (rows, columns) = match self.shape[..] {
            [] => (1, 1),
            [n] => (1, n),
            [rows, columns] => (rows, columns),
            _ => {
                let problem = format!("has shape {:?}, not two axes", self.shape);
                return Err(Invalid::whole(NAME, problem, "save a 2-D array of real numbers"));
            }
        };
        let matrix =
            Array2::from_shape_vec((rows, columns).set_f(self.is_fortran), self.values.clone());
        Ok(matrix.expect("one value per element").as_standard_layout().into_owned())
    }
}

/// Reads a map from an array with two axes. Refuses damaged files, other numbers of axes, numbers that are not real,
/// and too many.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let stored = stored(bytes)?;
    let [rows, columns] = stored.shape[..] else {
        let problem = format!("has shape {:?}, not two axes", stored.shape);
        let remedy = "save a 2-D array of real numbers with numpy.save";
        return Err(Invalid::whole(NAME, problem, remedy));
    };
    check_size(NAME, rows, columns)?;
    let mut reading = Reading::new(Format::Npy, stored.matrix()?, FirstRow::SmallestY);
    reading.single = stored.number == Number::F32;
    reading.stated =
        serde_json::json!({ "dtype": stored.descriptor, "fortran_order": stored.is_fortran });
    Ok(reading)
}

/// Returns true if the bytes are a ZIP archive that contains a `.npy` file.
pub(crate) fn is_npz(bytes: &[u8]) -> bool {
    Archive::open(bytes, NPZ)
        .is_ok_and(|archive| archive.names().any(|(name, _)| name.ends_with(".npy")))
}

const NPZ: &str = "npz file";

/// Reads the array that `pick` names from a `.npz` archive; without a name a customary one, or the only map.
///
/// # Errors
/// Refuses damaged archives, several maps without a name, names of absent arrays, and arrays that are no real numbers
/// on two axes.
pub fn read_archive(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    let archive = Archive::open(bytes, NPZ)?;
    let most_bytes = 8 * most_of(BYTES_PER_PIXEL) + LONGEST_HEADER;
    let mut all = Vec::new();
    let mut left = most_bytes;
    for (name, size) in archive.names() {
        let Some(own) = name.strip_suffix(".npy") else { continue };
        left = left.checked_sub(size).ok_or_else(|| {
            Invalid::whole(NPZ, "holds more numbers than a map may have", "save the map alone")
        })?;
        if all.len() == MOST_ARRAYS {
            return Err(too_many(NPZ, MOST_ARRAYS, "arrays", "save the map alone"));
        }
        // Arrays of other types are passed over.
        if let Ok(array) = stored(&archive.member(name, most_bytes)?) {
            all.push((own.to_string(), array));
        }
    }
    let mut arrays = Arrays::default();
    for (name, array) in all.iter().filter(|(_, array)| array.is_number()) {
        let shape = array.shape.iter().map(|n| *n as u64).collect();
        let is_truth = array.descriptor.ends_with("b1");
        let list = if is_truth { &mut arrays.marks } else { &mut arrays.numbers };
        list.push((name.clone(), shape));
    }
    let pick = choose(&arrays, pick, NPZ)?;
    let name = pick.dataset.as_deref().unwrap_or_default();
    let map = find(&all, name)?;
    let values = map.matrix()?;
    check_size(NPZ, values.nrows(), values.ncols())?;
    let coordinates = match (&pick.x, &pick.y) {
        (Some(x), Some(y)) => Some((find(&all, x)?.matrix()?, find(&all, y)?.matrix()?)),
        _ => None,
    };
    let turned = coordinates.as_ref().is_some_and(|(x, y)| is_turned(x, y, values.dim()));
    let values = upright(values, turned);
    let (rows, columns) = values.dim();
    let mut reading = Reading::new(Format::Npz, values, FirstRow::SmallestY);
    reading.single = map.number == Number::F32;
    if let Some(mask) = &pick.mask {
        reading.apply_mask(mask, &upright(find(&all, mask)?.matrix()?, turned))?;
    }
    if turned {
        reading.warnings.push(TURNED.into());
    }
    reading.state_unit_of_name(&name[prefix(name).len()..]);
    if let Some((x, y)) = coordinates {
        let [x, y] = [x, y].map(|matrix| upright(matrix, turned));
        reading.coordinates = Some(named_coordinates(&pick, &x, &y, (rows, columns))?);
    }
    statements(&all)?.apply(&mut reading)?;
    reading.stated =
        serde_json::json!({ "dataset": name, "x": pick.x, "y": pick.y, "mask": pick.mask });
    Ok(reading)
}

/// Returns the array of numbers called `name`, or refuses its absence.
fn find<'a>(all: &'a [(String, Stored)], name: &str) -> Result<&'a Stored, Invalid> {
    let mut named = all.iter().filter(|(own, array)| own == name && array.is_number());
    named.next().map(|(_, array)| array).ok_or_else(|| {
        let names: Vec<&str> = all.iter().map(|(own, _)| own.as_str()).take(20).collect();
        let problem = format!("has no array of numbers \"{name}\"");
        Invalid::whole(NPZ, problem, format!("it holds: {}", names.join(", ")))
    })
}

/// Returns the statements in arrays of up to three numbers, and in texts, by the names of the arrays.
fn statements(all: &[(String, Stored)]) -> Result<Beside, Invalid> {
    let mut variables = Vec::new();
    for (key, array) in all.iter().filter(|(_, a)| a.shape.iter().product::<usize>() <= 3) {
        let value = match &array.text {
            Some(text) => text.clone(),
            None => array.values.iter().map(f64::to_string).collect::<Vec<_>>().join(" x "),
        };
        variables.push(Variable { key: key.clone(), value, place: "array".into() });
    }
    let mut beside = Beside::default();
    beside.add_variables(&variables)?;
    Ok(beside)
}

/// Returns the message about a file that holds no array of real numbers.
fn bad(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "save a 2-D array of real numbers with numpy.save")
}

/// Reads the bytes of a `.npy` file as an array that holds real numbers or one text. Refuses more than two axes of more
/// than one element, other types, and bytes after the array.
fn stored(bytes: &[u8]) -> Result<Stored, Invalid> {
    let b = Bytes { all: bytes, name: NAME, big_endian: false };
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
    let is_fortran = after(&header, "'fortran_order':").is_some_and(|t| t.starts_with("True"));
    let shape = shape(&header).ok_or_else(|| bad("has no readable shape".into()))?;
    // Axes of one pixel before the map say nothing.
    let leading = shape.len().saturating_sub(2);
    if shape[..leading].iter().any(|n| *n != 1) {
        return Err(bad(format!("has shape {shape:?}, not two axes")));
    }
    let shape = shape[leading..].to_vec();
    if let (Some(text), true) = (
        text_of(descriptor, b.slice(start + length, bytes.len().saturating_sub(start + length))?),
        shape.iter().all(|n| *n == 1),
    ) {
        let values = Vec::new();
        let descriptor = descriptor.to_string();
        return Ok(Stored {
            shape,
            values,
            is_fortran,
            number: Number::U8,
            descriptor,
            text: Some(text),
        });
    }
    let (number, big_endian) = dtype(descriptor).ok_or_else(|| match descriptor.get(1..2) {
        Some("c") => Invalid::whole(
            NAME,
            format!("holds complex numbers of type \"{descriptor}\""),
            "save a.real, or numpy.angle(a) for a phase",
        ),
        _ => bad(format!("holds elements of type \"{descriptor}\"")),
    })?;
    let sizes: Vec<u64> = shape.iter().map(|n| *n as u64).collect();
    let count = check_elements(NAME, &sizes)?;
    let data = b.slice(start + length, count * number.size())?;
    if bytes.len() != start + length + data.len() {
        return Err(bad(format!(
            "has {} bytes after the array",
            bytes.len() - start - length - data.len()
        )));
    }
    let values = number.decode(data, count, big_endian)?;
    let descriptor = descriptor.to_string();
    Ok(Stored { shape, values, is_fortran, number, descriptor, text: None })
}

/// Returns the text of an array of one text, whose type `descriptor` is such as `<U5` or `|S5`. Returns `None` if it is
/// longer than [`LONGEST_TEXT`] or of another type.
fn text_of(descriptor: &str, data: &[u8]) -> Option<String> {
    if data.len() > LONGEST_TEXT {
        return None;
    }
    let letters: String = match (descriptor.get(..1)?, descriptor.get(1..2)?) {
        (_, "S") => String::from_utf8_lossy(data).into_owned(),
        (order, "U") => {
            let words = data.chunks_exact(4).map(|b| {
                let bytes = [b[0], b[1], b[2], b[3]];
                if order == ">" { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) }
            });
            words.filter_map(char::from_u32).collect()
        }
        _ => return None,
    };
    Some(letters.trim_end_matches('\0').to_string())
}

/// Returns the text after a key of the header; `None` without the key.
fn after<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    header.find(key).map(|start| header[start + key.len()..].trim_start())
}

/// Returns the text in quotation marks after a key of the header; `None` without it.
fn quoted<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    after(header, key)?.strip_prefix('\'')?.split('\'').next()
}

/// Returns the shape that the header states; `None` if it states none, or one that is no list of whole numbers.
fn shape(header: &str) -> Option<Vec<usize>> {
    let inside = after(header, "'shape':")?.strip_prefix('(')?.split(')').next()?;
    let sizes = inside.split(',').map(str::trim).filter(|s| !s.is_empty());
    sizes.map(|s| s.parse().ok()).collect()
}

/// Returns the type of the numbers for a descriptor such as `<f8`, and true if the most significant byte comes first;
/// `None` for other types.
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
    if matches!(order, "<" | ">" | "|" | "=") { Some((number, order == ">")) } else { None }
}
