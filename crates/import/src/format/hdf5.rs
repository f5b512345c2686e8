//! HDF5 by the path of a dataset, and MATLAB `.mat` 7.3, which is HDF5 with its dimensions reversed.
//!
//! A dataset is two-dimensional, of any real number type, stored in any of the layouts and filters
//! that the crate hdf5-reader knows (contiguous, chunked, deflate, shuffle, szip, ...). Its unit is
//! the attribute `unit` or `units`, where there is one. The attributes of netCDF and its CF conventions are
//! obeyed:
//!
//! ```text
//! value = add_offset + scale_factor raw
//! ```
//!
//! A raw value is invalid if it is `_FillValue` or one of `missing_value`, or outside `valid_range`, `valid_min` or
//! `valid_max`. Source: NetCDF Users Guide, "Attribute Conventions". Vectors `x` and `y` beside the map, of its size,
//! are its coordinates. Other coordinates are named: vectors, or matrices as `meshgrid` makes them.

use std::{
    collections::HashSet,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use hdf5_reader::{
    Attribute, ByteOrder, BytesStorage, Dataset, Datatype, Hdf5File, OpenOptions, RawAttribute,
    Storage, StorageBuffer, error::Error, group::Group,
};
use ndarray::{Array2, ArrayD, Ix2};
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    arrays::{Arrays, BESIDE, CUSTOMARY, TURNED, along, choose, is_turned, leaf, prefix},
    beside::{Beside, Variable},
    budget::{
        BYTES_PER_PIXEL, MOST_ARRAYS, MOST_PIXELS, MOST_READS, MOST_TEXT_BYTES, check_elements,
        check_size, most_of, too_many,
    },
    bytes::{Number, exact, refuse_rounded},
    reading::{Coordinates, FirstRow, Pick, Reading},
};

const NAME: &str = "HDF5 file";
const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";

/// Largest depth of nested groups in which datasets are listed. Larger: more time on a hostile file. Smaller: more
/// datasets have to be named by their path.
const DEEPEST: usize = 6;

/// Largest number of values of an attribute that is read; an attribute with more is refused. Larger: more time on
/// hostile files. Smaller: refuses attributes that are lists.
pub(crate) const MOST_VALUES: u64 = 64;

/// Largest number of symbols (entries of groups in the older layout of HDF5) that are read from a file; more are
/// refused. Larger: more time and memory for a hostile file. Smaller: refuses files with many datasets.
const MOST_SYMBOLS: u64 = 4096;
/// Longest block of names of a group, bytes; a longer one is refused, because all names of a group may point to the
/// same long text. Larger: more memory for a hostile file. Smaller: refuses groups with many long names.
const LONGEST_NAMES: u64 = 1 << 16;

/// Returns true if the signature of HDF5 stands at byte 0, 512, 1024 or 2048.
pub(crate) fn is_hdf5(bytes: &[u8]) -> bool {
    // A user block of 512 bytes, or twice that again and again, may come first.
    [0, 512, 1024, 2048]
        .iter()
        .any(|start| bytes.get(*start..).is_some_and(|b| b.starts_with(SIGNATURE)))
}

/// Returns the message about a file that the crate hdf5-reader cannot read.
pub(crate) fn broken(error: Error) -> Invalid {
    Invalid::whole(NAME, format!("cannot be read ({error})"), "write it again, or crop it")
}

/// Opens an HDF5 file. What is read from it is limited in size to a map and a few times the file, and in number to
/// [`MOST_READS`]. Refuses bytes without the signature of HDF5.
pub(crate) fn open(bytes: &[u8]) -> Result<Hdf5File, Invalid> {
    if !is_hdf5(bytes) {
        let problem = "does not start with the signature of HDF5";
        return Err(Invalid::whole(NAME, problem, "give an HDF5 file, or the right `format`"));
    }
    let options = OpenOptions::default()
        .with_max_read_bytes(8 * most_of(BYTES_PER_PIXEL))
        .with_max_chunk_bytes(8 * most_of(BYTES_PER_PIXEL))
        .with_max_object_header_bytes(MOST_TEXT_BYTES)
        .with_chunk_cache_bytes(0);
    let metered = Metered {
        bytes: BytesStorage::new(bytes.to_vec()),
        reads: MOST_READS.into(),
        // Everything once, and room for reading headers and blocks of names again.
        volume: (4 * bytes.len() as u64 + (1 << 24)).into(),
        symbols: MOST_SYMBOLS.into(),
    };
    Hdf5File::from_storage_with_options(Arc::new(metered), options).map_err(broken)
}

/// The bytes of a file, with the numbers of reads, bytes and symbols that may still be read. A file of a few kilobytes
/// that points to itself could be read without end.
struct Metered {
    bytes: BytesStorage,
    reads: AtomicU64,
    volume: AtomicU64,
    symbols: AtomicU64,
}

impl Storage for Metered {
    fn len(&self) -> u64 {
        self.bytes.len()
    }

    fn read_range(&self, offset: u64, len: usize) -> Result<StorageBuffer, Error> {
        spend(&self.reads, 1, "reads")?;
        spend(&self.volume, len as u64, "bytes")?;
        let piece = self.bytes.read_range(offset, len)?;
        if piece.starts_with(b"SNOD") {
            let count = piece.get(6..8).map_or(0, |b| u64::from(b[0]) + 256 * u64::from(b[1]));
            spend(&self.symbols, count, "names")?;
        }
        if piece.starts_with(b"HEAP") && piece.len() >= 16 {
            // In files with lengths of 4 bytes the upper half is another field, and not 0 either.
            let size = piece[8..16].iter().rev().fold(0u64, |n, b| (n << 8) | u64::from(*b));
            if size & 0xffff_ffff > LONGEST_NAMES {
                let problem = format!("{size} bytes of names in one group");
                return Err(Error::ResourceLimit(problem));
            }
        }
        Ok(piece)
    }
}

/// Subtracts `n` from the number `left` of reads, bytes or symbols that may still be read. Refuses if less is left.
/// `what` names them in the message.
fn spend(left: &AtomicU64, n: u64, what: &str) -> Result<(), Error> {
    match left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(n)) {
        Ok(_) => Ok(()),
        Err(_) => Err(Error::ResourceLimit(format!("points to and fro: too many {what}"))),
    }
}

/// Returns the coordinates of the columns and rows of a map of `(rows, columns)`, from two datasets. Refuses different
/// units, and arrays that are not the coordinates of one axis each.
fn coordinates(
    x_set: &Dataset,
    y_set: &Dataset,
    transposed: bool,
    (rows, columns): (usize, usize),
) -> Result<Coordinates, Invalid> {
    let [x_unit, y_unit] = [coordinate_unit(x_set)?, coordinate_unit(y_set)?];
    if x_unit != y_unit {
        let problem = format!("has x in {x_unit:?} and y in {y_unit:?}");
        return Err(Invalid::whole(NAME, problem, "give both the same unit"));
    }
    Ok(Coordinates {
        x: along("x", &scaled(x_set, transposed)?, columns, true)?,
        y: along("y", &scaled(y_set, transposed)?, rows, false)?,
        unit: x_unit,
    })
}

/// Returns a dataset as a matrix, with `scale_factor` and `add_offset` applied. `transposed` is true for files of
/// MATLAB, and swaps the axes.
fn scaled(set: &Dataset, transposed: bool) -> Result<Array2<f64>, Invalid> {
    let Convention { scale, offset, .. } = Convention::read(set)?;
    let stored = matrix(set, transposed)?;
    Ok(if (scale, offset) == (1.0, 0.0) { stored } else { stored.mapv(|v| offset + scale * v) })
}

/// Reads the dataset that `pick` names; without a name a customary one, or the only map of the file.
///
/// # Errors
/// Refuses a damaged file, a file of several maps without a name, and arrays that are no real numbers on two axes.
/// Refuses attributes that contradict these numbers, and coordinates that do not fit the map.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    let file = open(bytes)?;
    let transposed = bytes.starts_with(b"MATLAB 7.3");
    let (arrays, complex) = match &pick.dataset {
        // Of a file that is too large to be listed an array can still be named.
        Some(name) => (named(&file, name), None),
        None => matrices(&file)?,
    };
    let is_asked = pick.x.is_some();
    let mut pick = choose(&arrays, pick, NAME).map_err(|e| match complex {
        Some(name) if arrays.numbers.is_empty() => holds_complex(&name),
        _ => e,
    })?;

    let name = pick.dataset.clone().unwrap_or_default();
    let name = name.as_str();
    let set = file.dataset(name).map_err(broken)?;
    let mut transposed = transposed;
    if let (false, Some([of_rows, of_columns])) = (is_asked, scales(&file, &set)?) {
        // xarray and netCDF name the axes of an array; its rows need not be y.
        let [rows, columns] = [&of_rows, &of_columns].map(|name| leaf(name).to_lowercase());
        transposed = rows.starts_with('x') && columns.starts_with('y');
        let (x, y) = if transposed { (of_rows, of_columns) } else { (of_columns, of_rows) };
        pick.x = Some(x);
        pick.y = Some(y);
    }
    let mut values = matrix(&set, transposed)?;
    check_size("dataset", values.nrows(), values.ncols())?;
    let sets = match (&pick.x, &pick.y) {
        (Some(x), Some(y)) => {
            Some((file.dataset(x).map_err(broken)?, file.dataset(y).map_err(broken)?))
        }
        _ => None,
    };
    let mut is_ndgrid = false;
    if let Some((x, y)) = &sets {
        is_ndgrid = is_turned(&matrix(x, transposed)?, &matrix(y, transposed)?, values.dim());
    }
    if is_ndgrid {
        transposed = !transposed;
        values = values.reversed_axes().as_standard_layout().into_owned();
    }
    let (rows, columns) = values.dim();
    let mut reading = Reading::new(Format::Hdf5, values, FirstRow::SmallestY);
    reading.single = is_single(&set);
    let unit_name = unit_text(&set)?;
    if let Some(name) = &unit_name {
        reading.state_unit("unit", name);
    }
    reading.state_unit_of_name(leaf(name));
    let convention = Convention::read(&set)?;
    reading.factor = convention.scale;
    reading.offset = convention.offset;
    convention.mark(&mut reading);
    mark_fill(&set, &mut reading);
    if let Some(name) = &pick.mask {
        let mask = matrix(&file.dataset(name).map_err(broken)?, transposed)?;
        reading.apply_mask(name, &mask)?;
    }
    if is_ndgrid {
        reading.warnings.push(TURNED.into());
    }
    if let Some((x_set, y_set)) = sets {
        reading.coordinates = Some(coordinates(&x_set, &y_set, transposed, (rows, columns))?);
    }
    statements(&file, &set, name)?.apply(&mut reading)?;
    reading.stated = json!({
        "dataset": name,
        "x": pick.x,
        "y": pick.y,
        "mask": pick.mask,
        "unit": unit_name,
        "scale_factor": convention.scale,
        "add_offset": convention.offset,
        "invalid_values": convention.invalid,
        "transposed": transposed,
    });
    Ok(reading)
}

/// Returns names and shapes of the array called `name`, and of arrays with the customary names of maps and coordinates,
/// as far as they exist.
fn named(file: &Hdf5File, name: &str) -> Arrays {
    let own = prefix(name);
    let beside = BESIDE.iter().chain([&["Xtif", "Ytif"]]).flatten();
    let beside = beside.map(|coordinate| format!("{own}{coordinate}"));
    let customary = CUSTOMARY.iter().flatten().map(|name| name.to_string());
    let names: HashSet<String> = customary.chain(beside).chain([name.to_string()]).collect();
    let mut arrays = Arrays::default();
    for name in names {
        if let Ok(set) = file.dataset(&name) {
            arrays.numbers.push((name, without_leading_ones(set.shape())));
        }
    }
    arrays
}

/// Paths and shapes of all datasets of real numbers or truth values with at most two axes, without counting leading
/// axes of one pixel. The text is the path of a dataset of complex numbers, if there is one.
type Listed = (Arrays, Option<String>);

/// Lists the arrays in the groups of a file, down to [`DEEPEST`]. Refuses too many, and groups that cannot be read.
fn matrices(file: &Hdf5File) -> Result<Listed, Invalid> {
    let mut listed = Listed::default();
    let root = file.root_group().map_err(broken)?;
    list(&root, "", 0, &mut HashSet::new(), &mut 0, &mut listed)?;
    Ok(listed)
}

/// Appends the arrays in `group` and in the groups within it, at most [`DEEPEST`] deep, to `listed`. A group may be
/// linked from several places, even from within itself; it is listed once. Refuses too many groups and arrays.
fn list(
    group: &Group,
    path: &str,
    depth: usize,
    visited: &mut HashSet<u64>,
    looked_at: &mut usize,
    listed: &mut Listed,
) -> Result<(), Invalid> {
    if !visited.insert(group.address()) {
        return Ok(());
    }
    let (groups, sets) = group.members().map_err(broken)?;
    *looked_at += groups.len() + sets.len();
    if *looked_at > MOST_ARRAYS {
        let remedy = "choose an array with `dataset`";
        return Err(too_many(NAME, MOST_ARRAYS, "groups and arrays", remedy));
    }
    for set in sets {
        let numeric =
            matches!(set.dtype(), Datatype::FloatingPoint { .. } | Datatype::FixedPoint { .. });
        let shape = without_leading_ones(set.shape());
        let path = format!("{path}{}", leaf(set.name()));
        if is_complex(set.dtype()) {
            listed.1 = Some(path);
        } else if shape.len() <= 2 && is_truth(&set)? {
            listed.0.marks.push((path, shape));
        } else if numeric && shape.len() <= 2 {
            listed.0.numbers.push((path, shape));
        }
    }
    if depth < DEEPEST {
        for group in groups {
            let path = format!("{path}{}/", leaf(group.name()));
            list(&group, &path, depth + 1, visited, looked_at, listed)?;
        }
    }
    Ok(())
}

/// Returns a shape without leading axes of length 1; the last two axes remain in any case.
fn without_leading_ones(shape: &[u64]) -> Vec<u64> {
    let ones = shape.iter().take(shape.len().saturating_sub(2)).take_while(|n| **n == 1).count();
    shape[ones..].to_vec()
}

/// Returns true if the dataset holds truth values: an enumeration of one byte as h5py writes it, or bytes that MATLAB
/// calls logical.
fn is_truth(set: &Dataset) -> Result<bool, Invalid> {
    match set.dtype() {
        Datatype::Enum { base, .. } => Ok(matches!(**base, Datatype::FixedPoint { size: 1, .. })),
        Datatype::FixedPoint { size: 1, .. } => {
            let class = Attributes::list(set)?.get("MATLAB_class")?;
            let words = class.map(|class| class.read_strings().map_err(broken)).transpose()?;
            Ok(words.is_some_and(|words| words.iter().any(|word| word == "logical")))
        }
        _ => Ok(false),
    }
}

/// Returns true if the type is that of complex numbers, as h5py and MATLAB write them: pairs of real numbers.
fn is_complex(datatype: &Datatype) -> bool {
    let Datatype::Compound { fields, .. } = datatype else { return false };
    let names: Vec<String> = fields.iter().map(|f| f.name.to_ascii_lowercase()).collect();
    matches!(&names[..], [a, b] if [["r", "i"], ["real", "imag"], ["re", "im"]].contains(&[a, b]))
}

/// Returns the message about an array of complex numbers.
fn holds_complex(name: &str) -> Invalid {
    let problem = format!("\"{name}\" holds complex numbers");
    Invalid::whole("dataset", problem, "save their real part, or choose another with `dataset`")
}

/// Returns a dataset as a matrix, as stored; a vector becomes one row. `transposed` swaps the axes. Refuses more than
/// two axes of more than one pixel, too many elements, other types than real numbers, and chunks that are too large.
pub(crate) fn matrix(set: &Dataset, transposed: bool) -> Result<Array2<f64>, Invalid> {
    check_elements("dataset", set.shape())?;
    if let Some(chunks) = set.chunks() {
        // Whole chunks are inflated, also where little of them is in the array: one of 1 x 2^25 in a
        // column of 2^25 would be 2^50 numbers.
        let whole = set.shape().iter().zip(&chunks).try_fold(1u64, |n, (size, chunk)| {
            let chunk = u64::from(*chunk).max(1);
            n.checked_mul(size.div_ceil(chunk))?.checked_mul(chunk)
        });
        if whole.is_none_or(|n| n > 2 * MOST_PIXELS as u64) {
            let name = set.name();
            let shape = set.shape();
            let problem = format!("\"{name}\" has chunks of {chunks:?} in the shape {shape:?}");
            return Err(Invalid::whole("dataset", problem, "write it again, in smaller chunks"));
        }
    }
    let array = numbers(set)?;
    let array = match array.ndim() {
        1 => array.insert_axis(ndarray::Axis(0)),
        2 => array,
        n if n > 2 && array.shape()[..n - 2].iter().all(|n| *n == 1) => {
            let shape = [array.shape()[n - 2], array.shape()[n - 1]];
            array.into_shape_with_order(&shape[..]).expect("as many numbers")
        }
        n => {
            let problem = format!("\"{}\" has {n} axes", set.name());
            return Err(Invalid::whole("dataset", problem, "give one with two axes"));
        }
    };
    let matrix = array.into_dimensionality::<Ix2>().expect("two axes");
    Ok(if transposed { matrix.reversed_axes().as_standard_layout().into_owned() } else { matrix })
}

/// Returns the numbers of a dataset as stored. Refuses other types, and 64-bit integers that no 64-bit float equals.
fn numbers(set: &Dataset) -> Result<ArrayD<f64>, Invalid> {
    fn widened<T: hdf5_reader::H5Type>(
        set: &Dataset,
        value: impl Fn(&T) -> f64,
    ) -> Result<ArrayD<f64>, Error> {
        set.read_array::<T>().map(|a| a.map(value))
    }
    if let Some(number) = packed(set)? {
        let raw = set.read_raw_bytes().map_err(broken)?;
        let shape: Vec<usize> = set.shape().iter().map(|n| *n as usize).collect();
        let count = check_elements("dataset", set.shape())?;
        let values = number.decode(&raw, count, is_big_endian(set.dtype()))?;
        return ArrayD::from_shape_vec(shape, values).map_err(|_| {
            let problem = format!("\"{}\" does not hold the numbers that it claims", set.name());
            Invalid::whole("dataset", problem, "write it again")
        });
    }
    let values = match set.dtype() {
        Datatype::FloatingPoint { size: 8, .. } => set.read_array::<f64>(),
        Datatype::FloatingPoint { size: 4, .. } => widened(set, |v: &f32| f64::from(*v)),
        Datatype::FixedPoint { size: 1, signed: true, .. } => widened(set, |v: &i8| f64::from(*v)),
        Datatype::FixedPoint { size: 1, .. } => widened(set, |v: &u8| f64::from(*v)),
        Datatype::FixedPoint { size: 2, signed: true, .. } => widened(set, |v: &i16| f64::from(*v)),
        Datatype::FixedPoint { size: 2, .. } => widened(set, |v: &u16| f64::from(*v)),
        Datatype::FixedPoint { size: 4, signed: true, .. } => widened(set, |v: &i32| f64::from(*v)),
        Datatype::FixedPoint { size: 4, .. } => widened(set, |v: &u32| f64::from(*v)),
        Datatype::FixedPoint { size: 8, signed: true, .. } => widened(set, |v: &i64| exact(*v)),
        Datatype::FixedPoint { size: 8, .. } => widened(set, |v: &u64| exact(*v)),
        other if is_complex(other) => return Err(holds_complex(set.name())),
        _ => {
            let problem = format!("\"{}\" does not hold real numbers", set.name());
            return Err(Invalid::whole("dataset", problem, "choose another with `dataset`"));
        }
    }
    .map_err(broken)?;
    if matches!(set.dtype(), Datatype::FixedPoint { size: 8, .. }) {
        refuse_rounded(&values)?;
    }
    Ok(values)
}

/// Returns the number type of a dataset that this module decodes itself: 16-bit floats (IEEE binary16), and truth
/// values of one byte. Returns `None` for the others.
fn packed(set: &Dataset) -> Result<Option<Number>, Invalid> {
    match set.dtype() {
        // Byte 13 of the type: bits of the exponent. Other floats of 16 bits have 8.
        Datatype::FloatingPoint { size: 2, .. }
            if set.raw_datatype().map_err(broken)?.get(13) == Some(&5) =>
        {
            Ok(Some(Number::F16))
        }
        Datatype::Enum { base, .. } if matches!(**base, Datatype::FixedPoint { size: 1, .. }) => {
            Ok(Some(Number::U8))
        }
        _ => Ok(None),
    }
}

/// Returns true if the type stores numbers with the most significant byte first.
fn is_big_endian(datatype: &Datatype) -> bool {
    match datatype {
        Datatype::FloatingPoint { byte_order, .. } | Datatype::FixedPoint { byte_order, .. } => {
            matches!(byte_order, ByteOrder::BigEndian)
        }
        _ => false,
    }
}

/// Names of attributes, besides those of netCDF, that state a stored value for invalid pixels.
const NO_DATA: [&str; 6] =
    ["nodata", "no_data", "NoData", "NODATA", "nodata_value", "NODATA_value"];

/// The attributes of an array: their names, with the number of values of each.
pub(crate) struct Attributes<'a> {
    set: &'a Dataset,
    counts: Vec<(String, u64)>,
}

impl<'a> Attributes<'a> {
    /// Lists the attributes of an array, without reading their values.
    pub(crate) fn list(set: &'a Dataset) -> Result<Self, Invalid> {
        let mut counts = Vec::new();
        for a in set.raw_attributes().map_err(broken)? {
            let count = a.message().dataspace.num_elements().map_err(|e| broken(e.into()))?;
            counts.push((a.name().to_string(), count));
        }
        Ok(Self { set, counts })
    }

    /// Returns an attribute; `None` if it is absent. Refuses one of more than [`MOST_VALUES`] values, because each may
    /// point to a long text.
    pub(crate) fn get(&self, name: &str) -> Result<Option<Attribute>, Invalid> {
        match self.counts.iter().find(|(n, _)| n == name) {
            None => Ok(None),
            Some((_, count)) if *count > MOST_VALUES => {
                let problem = format!("has {count} values in the attribute \"{name}\"");
                Err(Invalid::whole(NAME, problem, "write it again, with one value"))
            }
            Some(_) => self.set.attribute(name).map(Some).map_err(broken),
        }
    }

    /// Returns the numbers of an attribute; the list is empty if it is absent. Refuses one that holds no numbers.
    fn numbers(&self, name: &str) -> Result<Vec<f64>, Invalid> {
        let Some(attribute) = self.get(name)? else { return Ok(Vec::new()) };
        attribute_numbers(&attribute).ok_or_else(|| {
            let problem = format!("has an attribute \"{name}\" that is no number");
            Invalid::whole(NAME, problem, "correct the attribute")
        })
    }

    /// Returns the number of an attribute; `None` if it is absent. Refuses several numbers, and NaN.
    fn number(&self, name: &str) -> Result<Option<f64>, Invalid> {
        match self.numbers(name)?[..] {
            [] => Ok(None),
            [v] if !v.is_nan() => Ok(Some(v)),
            ref several => {
                let problem = format!("has {name} = {several:?}");
                Err(Invalid::whole(NAME, problem, "give the attribute one number"))
            }
        }
    }
}

/// Returns true if the dataset holds 32-bit floats.
pub(crate) fn is_single(set: &Dataset) -> bool {
    matches!(set.dtype(), Datatype::FloatingPoint { size: 4, .. })
}

/// Attributes of netCDF (and others for invalid pixels) that change the meaning of the stored numbers.
struct Convention {
    /// Factor from the stored number to the value (`scale_factor`).
    scale: f64,
    /// Value of the stored number 0 (`add_offset`).
    offset: f64,
    /// Stored numbers that mark invalid pixels.
    invalid: Vec<f64>,
    /// Smallest (`least`) and largest (`most`) stored number of a valid pixel.
    least: Option<f64>,
    most: Option<f64>,
}

impl Convention {
    /// Reads the attributes of a dataset. Refuses `_Unsigned`, and attributes that are no numbers or have the wrong
    /// count of them.
    fn read(set: &Dataset) -> Result<Self, Invalid> {
        let attributes = Attributes::list(set)?;
        if attributes.get("_Unsigned")?.is_some() {
            let problem =
                "has the attribute \"_Unsigned\": its integers have another sign than their type";
            return Err(Invalid::whole(NAME, problem, "write it with an unsigned type"));
        }
        let mut invalid = attributes.numbers("_FillValue")?;
        invalid.extend(attributes.numbers("missing_value")?);
        for name in NO_DATA {
            invalid.extend(attributes.numbers(name)?);
        }
        invalid.retain(|v| !v.is_nan());
        let (least, most) = match attributes.numbers("valid_range")?[..] {
            [] => (attributes.number("valid_min")?, attributes.number("valid_max")?),
            [least, most] => (Some(least), Some(most)),
            ref other => {
                let problem = format!("has valid_range = {other:?}");
                return Err(Invalid::whole(NAME, problem, "give the attribute two numbers"));
            }
        };
        let scale = attributes.number("scale_factor")?.unwrap_or(1.0);
        let offset = attributes.number("add_offset")?.unwrap_or(0.0);
        Ok(Self { scale, offset, invalid, least, most })
    }

    /// Makes the pixels invalid whose stored number marks them or lies outside the valid range.
    fn mark(&self, reading: &mut Reading) {
        for marker in &self.invalid {
            reading.invalidate(*marker);
        }
        let least = self.least.unwrap_or(f64::NEG_INFINITY);
        let most = self.most.unwrap_or(f64::INFINITY);
        reading.values.mapv_inplace(|v| if v < least || v > most { f64::NAN } else { v });
    }
}

/// Returns the numbers of an attribute; `None` if [`numbers_of`] cannot read its type.
pub(crate) fn attribute_numbers(attribute: &Attribute) -> Option<Vec<f64>> {
    numbers_of(&attribute.datatype, &attribute.raw_data)
}

/// Returns the numbers in `bytes` that have the type `datatype`. Returns `None` if it is no integer and no float of 32
/// or 64 bits, or if an integer has no equal float.
fn numbers_of(datatype: &Datatype, bytes: &[u8]) -> Option<Vec<f64>> {
    let number = match *datatype {
        Datatype::FloatingPoint { size: 4, .. } => Number::F32,
        Datatype::FloatingPoint { size: 8, .. } => Number::F64,
        Datatype::FixedPoint { size, signed, .. } => match (size, signed) {
            (1, true) => Number::I8,
            (1, false) => Number::U8,
            (2, true) => Number::I16,
            (2, false) => Number::U16,
            (4, true) => Number::I32,
            (4, false) => Number::U32,
            (8, true) => Number::I64,
            (8, false) => Number::U64,
            _ => return None,
        },
        _ => return None,
    };
    let count = bytes.len() / number.size();
    number.decode(bytes, count, is_big_endian(datatype)).ok()
}

/// Makes the pixels invalid that have the fill value of the dataset, because nobody wrote them. The fill value 0 marks
/// nothing, because it is the default.
fn mark_fill(set: &Dataset, reading: &mut Reading) {
    let stored = set.fill_value().and_then(|fill| fill.value.as_deref());
    let fill = stored.and_then(|bytes| numbers_of(set.dtype(), bytes)?.first().copied());
    let Some(fill) = fill.filter(|fill| *fill != 0.0 && !fill.is_nan()) else { return };
    let count = reading.invalidate(fill);
    if count > 0 {
        let say = format!(
            "{count} pixel(s) have the fill value {fill} of the dataset, and are read as invalid"
        );
        reading.warnings.push(say);
    }
}

/// Names of attributes that the reader handles itself, and those that HDF5, netCDF and MATLAB use internally.
const READ: [&str; 20] = [
    "unit",
    "units",
    "Unit",
    "Units",
    "scale_factor",
    "add_offset",
    "missing_value",
    "valid_range",
    "valid_min",
    "valid_max",
    "DIMENSION_SCALE",
    "DIMENSION_LIST",
    "REFERENCE_LIST",
    "CLASS",
    "NAME",
    "nodata",
    "no_data",
    "NoData",
    "nodata_value",
    "no_data_value",
];

/// Largest number of attributes, and of arrays of one number or text, in one group that are read as statements. Larger:
/// more time on a hostile file. Smaller: statements in files with many attributes are not seen.
const MOST_STATEMENTS: usize = 200;

/// Returns up to three numbers, or the first text, of an attribute: `0.5`, `0.5 x 0.25`, `mm`. Returns `None` for more
/// numbers, and for no text.
fn value_of(attribute: &Attribute) -> Option<String> {
    match attribute_numbers(attribute) {
        Some(numbers) if numbers.len() <= 3 && !numbers.is_empty() => {
            Some(numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" x "))
        }
        Some(_) => None,
        None => attribute.read_strings().ok()?.into_iter().next(),
    }
}

/// Names of attributes that state a unit.
const UNITS: [&str; 4] = ["unit", "units", "Unit", "Units"];

/// Returns true if an attribute may be a statement: it has at most three values, its name does not begin with `_`, and
/// the reader does not handle it itself.
fn may_state(a: &RawAttribute) -> bool {
    let count = a.message().dataspace.num_elements();
    !READ.contains(&a.name()) && !a.name().starts_with('_') && count.is_ok_and(|n| n <= 3)
}

/// Returns the statements about a dataset, called `name`: attributes of the dataset, of its group and of the file, and
/// arrays of one number or text in its group.
fn statements(file: &Hdf5File, set: &Dataset, name: &str) -> Result<Beside, Invalid> {
    let mut variables = Vec::new();
    let attributes = set.raw_attributes().map_err(broken)?;
    for raw in attributes.iter().filter(|a| may_state(a)).take(MOST_STATEMENTS) {
        if let Some(value) = set.attribute(raw.name()).ok().as_ref().and_then(value_of) {
            variables.push(Variable { key: raw.name().into(), value, place: "attribute".into() });
        }
    }
    let mut beside = Beside::default();
    let path = prefix(name).trim_end_matches('/');
    let groups = if path.is_empty() { vec!["/"] } else { vec!["/", path] };
    for path in groups {
        let group = if path == "/" { file.root_group() } else { file.group(path) };
        let group = group.map_err(broken)?;
        let raw = group.raw_attributes().map_err(broken)?;
        for raw in raw.iter().take(MOST_STATEMENTS) {
            let is_unit = UNITS.contains(&raw.name());
            let count = raw.message().dataspace.num_elements();
            if !(is_unit || may_state(raw)) || count.is_ok_and(|n| n > 3) {
                continue;
            }
            let Some(value) = group.attribute(raw.name()).ok().as_ref().and_then(value_of) else {
                continue;
            };
            if is_unit {
                // Of the values, or of the coordinates.
                beside.lone_unit = beside.lone_unit.or(Unit::spelled(&value));
            } else {
                let place = format!("attribute of {path}");
                variables.push(Variable { key: raw.name().into(), value, place });
            }
        }
    }
    let group = if path.is_empty() { file.root_group() } else { file.group(path) };
    let (_, sets) = group.map_err(broken)?.members().map_err(broken)?;
    for set in
        sets.iter().filter(|set| set.num_elements().is_ok_and(|n| n == 1)).take(MOST_STATEMENTS)
    {
        let value = match set.dtype() {
            Datatype::FloatingPoint { .. } | Datatype::FixedPoint { .. } => {
                numbers(set)?.first().map(f64::to_string)
            }
            _ => set.read_strings().ok().and_then(|words| words.into_iter().next()),
        };
        if let Some(value) = value {
            let key = leaf(set.name()).into();
            variables.push(Variable { key, value, place: "array".into() });
        }
    }
    beside.add_variables(&variables)?;
    Ok(beside)
}

/// Returns the paths of the coordinates of the rows and of the columns that the dataset refers to (dimension scales).
/// Returns `None` unless both exist, and for a file that is too large to be listed.
fn scales(file: &Hdf5File, set: &Dataset) -> Result<Option<[String; 2]>, Invalid> {
    let Some(list) = Attributes::list(set)?.get("DIMENSION_LIST")? else { return Ok(None) };
    let size = set.vlen_reference_size();
    let references: Vec<&[u8]> = list.raw_data.chunks_exact(size).collect();
    let [.., rows, columns] = references[..] else { return Ok(None) };
    if references.len() != set.shape().len() {
        return Ok(None);
    }
    // Of a file that is too large to be listed the coordinates can be named.
    let Ok((arrays, _)) = matrices(file) else { return Ok(None) };
    let mut vectors = Vec::new();
    for (path, _) in arrays.numbers.into_iter().filter(|a| a.1.len() == 1) {
        let Ok(vector) = file.dataset(&path) else { return Ok(None) };
        vectors.push((path, vector));
    }
    let rows = scale_of_axis(set, rows, &vectors)?;
    let columns = scale_of_axis(set, columns, &vectors)?;
    Ok(rows.zip(columns).map(|(rows, columns)| [rows, columns]))
}

/// Returns the path of the coordinates that `reference` points to, one of `vectors`. Returns `None` if it points to
/// none of them, or to a dimension of netCDF without coordinates.
fn scale_of_axis(
    set: &Dataset,
    reference: &[u8],
    vectors: &[(String, Dataset)],
) -> Result<Option<String>, Invalid> {
    let Ok(bytes) = set.resolve_vlen_reference_bytes(reference, 8) else { return Ok(None) };
    let Some(address) = bytes.first_chunk::<8>().map(|b| u64::from_le_bytes(*b)) else {
        return Ok(None);
    };
    let Some((path, vector)) = vectors.iter().find(|(_, vector)| vector.address() == address)
    else {
        return Ok(None);
    };
    let name = Attributes::list(vector)?.get("NAME")?;
    let words = name.map(|name| name.read_strings().map_err(broken)).transpose()?;
    let mut words = words.iter().flatten();
    if words.any(|word| word.starts_with("This is a netCDF dimension but not")) {
        return Ok(None);
    }
    Ok(Some(path.clone()))
}

/// Returns the unit of coordinates, from their attribute or from the end of their name; `None` without either. Refuses
/// an attribute that is no unit of a map.
fn coordinate_unit(set: &Dataset) -> Result<Option<Unit>, Invalid> {
    match unit_text(set)? {
        Some(name) => Unit::stated("coordinate_unit", &name).map(Some),
        None => Ok(Unit::of_name(leaf(set.name())).ok().and_then(|(_, unit)| unit)),
    }
}

/// Returns the unit of a dataset as text, from its attribute `unit` or `units`; `None` if it is absent or empty.
pub(crate) fn unit_text(set: &Dataset) -> Result<Option<String>, Invalid> {
    let attributes = Attributes::list(set)?;
    for name in UNITS {
        if let Some(attribute) = attributes.get(name)? {
            return Ok(attribute.read_strings().map_err(broken)?.into_iter().next());
        }
    }
    Ok(None)
}
