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
    Attribute, ByteOrder, BytesStorage, Dataset, Datatype, Hdf5File, OpenOptions, Storage,
    StorageBuffer, error::Error, group::Group,
};
use ndarray::{Array2, ArrayD, Ix2};
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::{
        BYTES_PER_PIXEL, MOST_ARRAYS, MOST_PIXELS, MOST_READS, MOST_TEXT_BYTES, check_elements,
        check_size, most_of, too_many,
    },
    bytes::{Number, exact, refuse_rounded},
    reading::{Coordinates, FirstRow, Pick, Reading},
};

const NAME: &str = "HDF5 file";
const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";

/// Names that optics groups use for a map and for a TIF, with their coordinates.
const CUSTOMARY: [[&str; 3]; 2] = [["Z", "X", "Y"], ["Ztif", "Xtif", "Ytif"]];

/// Depth of groups within groups to which datasets are listed. Larger: more time on a hostile file.
/// Smaller: a dataset in a deeper group has to be named by its path.
const DEEPEST: usize = 6;

/// Most values of an attribute.
pub(crate) const MOST_VALUES: u64 = 64;

/// Largest number of symbols (entries of groups of the first layout) that are read from a file. Larger:
/// more time and memory for a hostile file. Smaller: refuses files with many datasets.
const MOST_SYMBOLS: u64 = 4096;
/// Longest block of names of a group, bytes; the names of a group may all point to the same long text.
/// Larger: more memory for a hostile file. Smaller: refuses groups with many long names.
const LONGEST_NAMES: u64 = 1 << 16;

pub(crate) fn is_hdf5(bytes: &[u8]) -> bool {
    // A user block of 512 bytes, or twice that again and again, may come first.
    [0, 512, 1024, 2048].iter().any(|at| bytes.get(*at..).is_some_and(|b| b.starts_with(SIGNATURE)))
}

pub(crate) fn broken(error: Error) -> Invalid {
    Invalid::whole(NAME, format!("cannot be read ({error})"), "write it again, or crop it")
}

/// Opens a file; nothing larger than a map is read from it, and no more often than [`MOST_READS`].
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

/// The bytes of a file, and how much may still be read of them: a file of a few kilobytes that points to
/// itself can be read without end.
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
        let spend = |left: &AtomicU64, n: u64, what: &str| {
            let spent =
                left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |l| l.checked_sub(n));
            match spent {
                Ok(_) => Ok(()),
                Err(_) => Err(Error::ResourceLimit(format!("points to and fro: too many {what}"))),
            }
        };
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

/// Reads the dataset that `pick` names; without a name a customary one, or the only map there is.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    let file = open(bytes)?;
    let transposed = bytes.starts_with(b"MATLAB 7.3");
    let (arrays, complex) = match &pick.dataset {
        // Of a file that is too large to be listed an array can still be named.
        Some(name) => (named(&file, name), None),
        None => matrices(&file)?,
    };
    let mut pick = choose(&arrays, pick, NAME).map_err(|e| match complex {
        Some(name) if arrays.is_empty() => holds_complex(&name),
        _ => e,
    })?;

    let name = pick.dataset.clone().unwrap_or_default();
    let name = name.as_str();
    let set = file.dataset(name).map_err(broken)?;
    let values = matrix(&set, transposed)?;
    let (rows, columns) = values.dim();
    check_size("dataset", rows, columns)?;
    // Coordinates of a netCDF file: vectors called x and y beside the map, of its size.
    if pick.x.is_none() {
        let group = name.rsplit_once('/').map_or(String::new(), |split| format!("{}/", split.0));
        let has = |path: &str, len: usize| {
            file.dataset(path).is_ok_and(|set| set.shape() == [len as u64] && set.name() != name)
        };
        let (x, y) = (format!("{group}x"), format!("{group}y"));
        if has(&x, columns) && has(&y, rows) {
            (pick.x, pick.y) = (Some(x), Some(y));
        }
    }
    let mut reading = Reading::new(Format::Hdf5, values, FirstRow::SmallestY);
    reading.single = is_single(&set);
    let (unit, unit_name) = unit(&set)?;
    reading.unit = unit;
    let convention = Convention::of(&set)?;
    (reading.factor, reading.offset) = (convention.scale, convention.offset);
    convention.mark(&mut reading);
    if let Some(name) = &pick.mask {
        let mask = matrix(&file.dataset(name).map_err(broken)?, transposed)?;
        reading.apply_mask(name, &mask)?;
    }
    if let (Some(x), Some(y)) = (&pick.x, &pick.y) {
        let (x_set, y_set) = (file.dataset(x).map_err(broken)?, file.dataset(y).map_err(broken)?);
        let ((x_unit, _), (y_unit, _)) = (self::unit(&x_set)?, self::unit(&y_set)?);
        if x_unit != y_unit {
            let problem = format!("has x in {x_unit:?} and y in {y_unit:?}");
            return Err(Invalid::whole(NAME, problem, "give both the same unit"));
        }
        let scaled = |set: &Dataset| -> Result<Array2<f64>, Invalid> {
            let Convention { scale, offset, .. } = Convention::of(set)?;
            Ok(matrix(set, transposed)?.mapv(|v| match (scale, offset) {
                (1.0, 0.0) => v,
                _ => offset + scale * v,
            }))
        };
        reading.coordinates = Some(Coordinates {
            x: along("x", &scaled(&x_set)?, columns, true)?,
            y: along("y", &scaled(&y_set)?, rows, false)?,
            unit: x_unit,
        });
    }
    reading.stated = json!({
        "dataset": name,
        "x": pick.x,
        "y": pick.y,
        "mask": pick.mask,
        "unit": unit_name,
        "scale_factor": convention.scale,
        "add_offset": convention.offset,
        "invalid_values": convention.invalid,
        "matlab_7_3": transposed,
    });
    Ok(reading)
}

/// The names to read out of `arrays` (names with shapes): those asked for, else customary ones that are there, else the only map.
pub(crate) fn choose(
    arrays: &[(String, Vec<u64>)],
    pick: &Pick,
    file: &'static str,
) -> Result<Pick, Invalid> {
    if pick.x.is_some() != pick.y.is_some() {
        return Err(Invalid::whole(file, "one of `x` and `y` was given", "give both or none"));
    }
    let has = |name: &str| arrays.iter().any(|(n, _)| n == name);
    let is_map = |shape: &[u64]| shape.len() == 2 && shape.iter().all(|n| *n > 1);
    let maps: Vec<&str> =
        arrays.iter().filter(|(_, shape)| is_map(shape)).map(|(name, _)| name.as_str()).collect();
    let mut chosen = pick.clone();
    let is_mask = |name: &str| leaf(name).to_lowercase().contains("mask");
    let customary = CUSTOMARY[usize::from(pick.is_tif)];
    if chosen.dataset.is_none() {
        chosen.dataset = match (has(customary[0]), &maps[..]) {
            (true, _) => Some(customary[0].to_string()),
            (false, [only]) => Some(only.to_string()),
            (false, []) => {
                let remedy = "give a file with an array of two axes";
                return Err(Invalid::whole(file, "holds no matrix of real numbers", remedy));
            }
            (false, several)
                if pick.mask.is_some() && {
                    let mask = pick.mask.as_deref();
                    several.len() == 2 && several.iter().any(|name| Some(*name) == mask)
                } =>
            {
                several
                    .iter()
                    .find(|name| Some(**name) != pick.mask.as_deref())
                    .map(|n| n.to_string())
            }
            (false, several) => {
                let listed: Vec<&str> = several.iter().copied().take(20).collect();
                let problem = format!("holds several matrices: {}", listed.join(", "));
                return Err(Invalid::whole(file, problem, "choose one with `dataset`"));
            }
        };
    }
    if let (None, None, Some(map)) = (&pick.mask, &pick.dataset, &chosen.dataset) {
        let shape = |name: &str| arrays.iter().find(|a| a.0 == name).map(|a| &a.1);
        let beside = |name: &&&str| **name != map && is_mask(name) && shape(name) == shape(map);
        if let Some(mask) = maps.iter().find(beside) {
            let problem = format!("holds \"{mask}\", an array of the size of \"{map}\"");
            let remedy = format!(
                "give `mask` {mask} where it is not 0 at invalid pixels, or `dataset` {map} to leave it out"
            );
            return Err(Invalid::whole(file, problem, remedy));
        }
    }
    let [z, x, y] = customary;
    if chosen.x.is_none() && chosen.dataset.as_deref() == Some(z) && has(x) && has(y) {
        (chosen.x, chosen.y) = (Some(x.to_string()), Some(y.to_string()));
    }
    Ok(chosen)
}

/// The coordinates of an axis from a vector, or from a matrix that varies along one axis only.
pub(crate) fn along(
    name: &'static str,
    values: &Array2<f64>,
    len: usize,
    columns: bool,
) -> Result<Vec<f64>, Invalid> {
    let (r, c) = values.dim();
    if r == 1 || c == 1 {
        return Ok(values.iter().copied().collect());
    }
    let line: Vec<f64> = if columns { values.row(0).to_vec() } else { values.column(0).to_vec() };
    let spread = line.iter().fold(0.0_f64, |m, v| m.max((v - line[0]).abs()));
    let same = values.indexed_iter().all(|((i, j), v)| {
        let expected = line[if columns { j } else { i }];
        // Rounding of a coordinate that was computed twice.
        (v - expected).abs() <= 1e-9 * spread || (v.is_nan() && expected.is_nan())
    });
    if line.len() != len || !same {
        let problem = format!("of shape ({r}, {c}) is not a grid of {len} coordinates");
        return Err(Invalid::whole(name, problem, "give a vector, or what meshgrid makes"));
    }
    Ok(line)
}

/// The array that was asked for, and the customary coordinates beside it, with their shapes.
fn named(file: &Hdf5File, name: &str) -> Vec<(String, Vec<u64>)> {
    let names = CUSTOMARY.iter().flatten().copied().chain([name]).collect::<HashSet<_>>();
    let shape = |name: &str| file.dataset(name).ok().map(|set| set.shape().to_vec());
    names.into_iter().filter_map(|name| Some((name.to_string(), shape(name)?))).collect()
}

/// Paths and shapes of all datasets of real numbers with at most two axes, and the path of one of
/// complex numbers.
type Listed = (Vec<(String, Vec<u64>)>, Option<String>);

fn matrices(file: &Hdf5File) -> Result<Listed, Invalid> {
    let mut found = (Vec::new(), None);
    let root = file.root_group().map_err(broken)?;
    list(&root, "", 0, &mut HashSet::new(), &mut 0, &mut found)?;
    Ok(found)
}

/// Adds what is in `group` and below it. A group may be linked to from several places, from within
/// itself too: it is listed at the first.
fn list(
    group: &Group,
    path: &str,
    depth: usize,
    visited: &mut HashSet<u64>,
    looked_at: &mut usize,
    found: &mut Listed,
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
        let shape = set.shape().to_vec();
        let at = format!("{path}{}", leaf(set.name()));
        if is_complex(set.dtype()) {
            found.1 = Some(at);
        } else if numeric && shape.len() <= 2 {
            found.0.push((at, shape));
        }
    }
    if depth < DEEPEST {
        for group in groups {
            let path = format!("{path}{}/", leaf(group.name()));
            list(&group, &path, depth + 1, visited, looked_at, found)?;
        }
    }
    Ok(())
}

/// A complex number as h5py and MATLAB write it: a pair of real ones.
fn is_complex(datatype: &Datatype) -> bool {
    let Datatype::Compound { fields, .. } = datatype else { return false };
    let names: Vec<String> = fields.iter().map(|f| f.name.to_ascii_lowercase()).collect();
    matches!(&names[..], [a, b] if [["r", "i"], ["real", "imag"], ["re", "im"]].contains(&[a, b]))
}

fn holds_complex(name: &str) -> Invalid {
    let problem = format!("\"{name}\" holds complex numbers");
    Invalid::whole("dataset", problem, "save their real part, or choose another with `dataset`")
}

pub(crate) fn leaf(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// A dataset as a matrix; a vector becomes one row.
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
            let (name, shape) = (set.name(), set.shape());
            let problem = format!("\"{name}\" has chunks of {chunks:?} in the shape {shape:?}");
            return Err(Invalid::whole("dataset", problem, "write it again, in smaller chunks"));
        }
    }
    let array = numbers(set)?;
    let array = match array.ndim() {
        1 => array.insert_axis(ndarray::Axis(0)),
        2 => array,
        n => {
            let problem = format!("\"{}\" has {n} axes", set.name());
            return Err(Invalid::whole("dataset", problem, "give one with two axes"));
        }
    };
    let matrix = array.into_dimensionality::<Ix2>().expect("two axes");
    Ok(if transposed { matrix.reversed_axes().as_standard_layout().into_owned() } else { matrix })
}

fn numbers(set: &Dataset) -> Result<ArrayD<f64>, Invalid> {
    fn widened<T: hdf5_reader::H5Type>(
        set: &Dataset,
        value: impl Fn(&T) -> f64,
    ) -> Result<ArrayD<f64>, Error> {
        set.read_array::<T>().map(|a| a.map(value))
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

/// The attributes of an array, with how many values each has.
pub(crate) struct Attributes<'a> {
    set: &'a Dataset,
    counts: Vec<(String, u64)>,
}

impl<'a> Attributes<'a> {
    pub(crate) fn of(set: &'a Dataset) -> Result<Self, Invalid> {
        let raw = set.raw_attributes().map_err(broken)?;
        let count = |a: &hdf5_reader::RawAttribute| a.message().dataspace.num_elements();
        let counts = raw.iter().map(|a| Ok((a.name().to_string(), count(a)?)));
        let counts = counts.collect::<Result<_, Error>>().map_err(broken)?;
        Ok(Self { set, counts })
    }

    /// One of them, where there is one; only of a few values, because each may point to a long text.
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
}

/// True where a dataset holds 32-bit floats.
pub(crate) fn is_single(set: &Dataset) -> bool {
    matches!(set.dtype(), Datatype::FloatingPoint { size: 4, .. })
}

/// Attributes of netCDF that change the numbers of a dataset.
struct Convention {
    /// Factor from the stored to the meant number.
    scale: f64,
    /// Meant number of the stored 0.
    offset: f64,
    /// Stored values that mark an invalid pixel.
    invalid: Vec<f64>,
    /// Smallest and largest stored value of a valid pixel.
    least: Option<f64>,
    most: Option<f64>,
}

impl Convention {
    fn of(set: &Dataset) -> Result<Self, Invalid> {
        let attributes = Attributes::of(set)?;
        let numbers = |name: &str| -> Result<Vec<f64>, Invalid> {
            let Some(attribute) = attributes.get(name)? else { return Ok(Vec::new()) };
            attribute_numbers(&attribute).ok_or_else(|| {
                let problem = format!("has an attribute \"{name}\" that is no number");
                Invalid::whole(NAME, problem, "correct the attribute")
            })
        };
        let one = |name: &str| -> Result<Option<f64>, Invalid> {
            match numbers(name)?[..] {
                [] => Ok(None),
                [v] if !v.is_nan() => Ok(Some(v)),
                ref several => {
                    let problem = format!("has {name} = {several:?}");
                    Err(Invalid::whole(NAME, problem, "give the attribute one number"))
                }
            }
        };
        if attributes.get("_Unsigned")?.is_some() {
            let problem =
                "has the attribute \"_Unsigned\": its integers have another sign than their type";
            return Err(Invalid::whole(NAME, problem, "write it with an unsigned type"));
        }
        let mut invalid = numbers("_FillValue")?;
        invalid.extend(numbers("missing_value")?);
        invalid.retain(|v| !v.is_nan());
        let (least, most) = match numbers("valid_range")?[..] {
            [] => (one("valid_min")?, one("valid_max")?),
            [least, most] => (Some(least), Some(most)),
            ref other => {
                let problem = format!("has valid_range = {other:?}");
                return Err(Invalid::whole(NAME, problem, "give the attribute two numbers"));
            }
        };
        let (scale, offset) =
            (one("scale_factor")?.unwrap_or(1.0), one("add_offset")?.unwrap_or(0.0));
        Ok(Self { scale, offset, invalid, least, most })
    }

    fn mark(&self, reading: &mut Reading) {
        for marker in &self.invalid {
            reading.invalidate(*marker);
        }
        let (least, most) = (self.least, self.most);
        let beside = |v: f64| least.is_some_and(|l| v < l) || most.is_some_and(|m| v > m);
        reading.values.mapv_inplace(|v| if beside(v) { f64::NAN } else { v });
    }
}

/// The numbers of an attribute, of any type of real numbers; `None` for what is none.
pub(crate) fn attribute_numbers(attribute: &Attribute) -> Option<Vec<f64>> {
    let number = match attribute.datatype {
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
    let big_endian = match &attribute.datatype {
        Datatype::FloatingPoint { byte_order, .. } | Datatype::FixedPoint { byte_order, .. } => {
            matches!(byte_order, ByteOrder::BigEndian)
        }
        _ => false,
    };
    let count = attribute.raw_data.len() / number.size();
    number.decode(&attribute.raw_data, count, big_endian).ok()
}

fn unit(set: &Dataset) -> Result<(Option<Unit>, Option<String>), Invalid> {
    match unit_text(set)? {
        Some(name) => Ok((Some(Unit::stated("unit", &name)?), Some(name))),
        None => Ok((None, None)),
    }
}

/// Name of the unit of a dataset, from its attribute `unit` or `units`.
pub(crate) fn unit_text(set: &Dataset) -> Result<Option<String>, Invalid> {
    let attributes = Attributes::of(set)?;
    let mut named = None;
    for name in ["unit", "units", "Unit", "Units"] {
        named = attributes.get(name)?;
        if named.is_some() {
            break;
        }
    }
    let Some(attribute) = named else { return Ok(None) };
    Ok(attribute.read_strings().map_err(broken)?.into_iter().next())
}
