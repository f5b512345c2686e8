//! HDF5 by the path of a dataset, and MATLAB `.mat` 7.3, which is HDF5 with its dimensions reversed.
//!
//! A dataset is two-dimensional, of any real number type, stored in any of the layouts and filters
//! that the crate hdf5-reader knows (contiguous, chunked, deflate, shuffle, szip, ...). Its unit is
//! the attribute `unit` or `units`, where there is one. Coordinates are datasets too: vectors, or
//! matrices as `meshgrid` makes them.

use hdf5_reader::{Dataset, Datatype, Hdf5File, OpenOptions, error::Error, group::Group};
use ndarray::{Array2, ArrayD, Ix2};
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, MOST_PIXELS, Unit, check_size,
    reading::{Coordinates, FirstRow, Pick, Reading},
};

const NAME: &str = "HDF5 file";
const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";

/// Names that optics groups use for a map and for a TIF, with their coordinates.
const CUSTOMARY: [[&str; 3]; 2] = [["Z", "X", "Y"], ["Ztif", "Xtif", "Ytif"]];

/// Groups within groups are listed to this depth.
const DEEPEST: usize = 6;

pub(crate) fn is_hdf5(bytes: &[u8]) -> bool {
    // A user block of 512 bytes, or twice that again and again, may come first.
    [0, 512, 1024, 2048].iter().any(|at| bytes.get(*at..).is_some_and(|b| b.starts_with(SIGNATURE)))
}

pub(crate) fn broken(error: Error) -> Invalid {
    Invalid::whole(NAME, format!("cannot be read ({error})"), "write it again, or crop it")
}

/// Opens a file; nothing larger than a map is read from it.
pub(crate) fn open(bytes: &[u8]) -> Result<Hdf5File, Invalid> {
    if !is_hdf5(bytes) {
        let problem = "does not start with the signature of HDF5";
        return Err(Invalid::whole(NAME, problem, "give an HDF5 file, or the right --format"));
    }
    let options = OpenOptions::default()
        .with_max_read_bytes(8 * MOST_PIXELS)
        .with_max_chunk_bytes(8 * MOST_PIXELS)
        .with_max_object_header_bytes(1 << 22)
        .with_chunk_cache_bytes(0);
    Hdf5File::from_vec_with_options(bytes.to_vec(), options).map_err(broken)
}

/// Reads the dataset that `pick` names; without a name a customary one, or the only map there is.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    let file = open(bytes)?;
    let transposed = bytes.starts_with(b"MATLAB 7.3");
    let pick = choose(&matrices(&file)?, pick, NAME)?;

    let name = pick.data.as_deref().unwrap_or_default();
    let set = file.dataset(name).map_err(broken)?;
    let values = matrix(&set, transposed)?;
    let (rows, columns) = values.dim();
    check_size("dataset", rows, columns)?;
    let mut reading = Reading::new(Format::Hdf5, values, FirstRow::SmallestY);
    let (unit, unit_name) = unit(&set)?;
    reading.unit = unit;
    if let (Some(x), Some(y)) = (&pick.x, &pick.y) {
        let (x_set, y_set) = (file.dataset(x).map_err(broken)?, file.dataset(y).map_err(broken)?);
        let ((x_unit, _), (y_unit, _)) = (self::unit(&x_set)?, self::unit(&y_set)?);
        if x_unit != y_unit {
            let problem = format!("has x in {x_unit:?} and y in {y_unit:?}");
            return Err(Invalid::whole(NAME, problem, "give both the same unit"));
        }
        reading.coordinates = Some(Coordinates {
            x: along("x", &matrix(&x_set, transposed)?, columns, true)?,
            y: along("y", &matrix(&y_set, transposed)?, rows, false)?,
            unit: x_unit,
        });
    }
    reading.stated = json!({
        "dataset": name,
        "x": pick.x,
        "y": pick.y,
        "unit": unit_name,
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
        return Err(Invalid::whole(file, "one of --x and --y was given", "give both or none"));
    }
    let has = |name: &str| arrays.iter().any(|(n, _)| n == name);
    let is_map = |shape: &[u64]| shape.len() == 2 && shape.iter().all(|n| *n > 1);
    let maps: Vec<&str> =
        arrays.iter().filter(|(_, shape)| is_map(shape)).map(|(name, _)| name.as_str()).collect();
    let mut chosen = pick.clone();
    let customary = CUSTOMARY[usize::from(pick.is_tif)];
    if chosen.data.is_none() {
        chosen.data = match (has(customary[0]), &maps[..]) {
            (true, _) => Some(customary[0].to_string()),
            (false, [only]) => Some(only.to_string()),
            (false, []) => {
                let remedy = "give a file with an array of two axes";
                return Err(Invalid::whole(file, "holds no matrix of real numbers", remedy));
            }
            (false, several) => {
                let listed: Vec<&str> = several.iter().copied().take(20).collect();
                let problem = format!("holds several matrices: {}", listed.join(", "));
                return Err(Invalid::whole(file, problem, "choose one with --dataset"));
            }
        };
    }
    let [z, x, y] = customary;
    if chosen.x.is_none() && chosen.data.as_deref() == Some(z) && has(x) && has(y) {
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

/// Paths and shapes of all datasets of real numbers with at most two axes.
fn matrices(file: &Hdf5File) -> Result<Vec<(String, Vec<u64>)>, Invalid> {
    let mut found = Vec::new();
    let root = file.root_group().map_err(broken)?;
    list(&root, "", 0, &mut found)?;
    Ok(found)
}

fn list(
    group: &Group,
    path: &str,
    depth: usize,
    found: &mut Vec<(String, Vec<u64>)>,
) -> Result<(), Invalid> {
    let (groups, sets) = group.members().map_err(broken)?;
    for set in sets {
        let numeric =
            matches!(set.dtype(), Datatype::FloatingPoint { .. } | Datatype::FixedPoint { .. });
        let shape = set.shape().to_vec();
        if numeric && shape.len() <= 2 {
            found.push((format!("{path}{}", leaf(set.name())), shape));
        }
    }
    if depth < DEEPEST && found.len() < 1000 {
        for group in groups {
            list(&group, &format!("{path}{}/", leaf(group.name())), depth + 1, found)?;
        }
    }
    Ok(())
}

fn leaf(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// A dataset as a matrix; a vector becomes one row.
pub(crate) fn matrix(set: &Dataset, transposed: bool) -> Result<Array2<f64>, Invalid> {
    let size = set.shape().iter().try_fold(1u64, |n, s| n.checked_mul(*s));
    if size.is_none_or(|n| n > MOST_PIXELS as u64) {
        let problem = format!("\"{}\" claims the shape {:?}", set.name(), set.shape());
        let remedy = format!("at most {MOST_PIXELS} elements are read; crop it");
        return Err(Invalid::whole("dataset", problem, remedy));
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
    match set.dtype() {
        Datatype::FloatingPoint { size: 8, .. } => set.read_array::<f64>(),
        Datatype::FloatingPoint { size: 4, .. } => widened(set, |v: &f32| f64::from(*v)),
        Datatype::FixedPoint { size: 1, signed: true, .. } => widened(set, |v: &i8| f64::from(*v)),
        Datatype::FixedPoint { size: 1, .. } => widened(set, |v: &u8| f64::from(*v)),
        Datatype::FixedPoint { size: 2, signed: true, .. } => widened(set, |v: &i16| f64::from(*v)),
        Datatype::FixedPoint { size: 2, .. } => widened(set, |v: &u16| f64::from(*v)),
        Datatype::FixedPoint { size: 4, signed: true, .. } => widened(set, |v: &i32| f64::from(*v)),
        Datatype::FixedPoint { size: 4, .. } => widened(set, |v: &u32| f64::from(*v)),
        Datatype::FixedPoint { size: 8, signed: true, .. } => widened(set, |v: &i64| *v as f64),
        Datatype::FixedPoint { size: 8, .. } => widened(set, |v: &u64| *v as f64),
        _ => {
            let problem = format!("\"{}\" does not hold real numbers", set.name());
            return Err(Invalid::whole("dataset", problem, "choose another with --dataset"));
        }
    }
    .map_err(broken)
}

fn unit(set: &Dataset) -> Result<(Option<Unit>, Option<String>), Invalid> {
    let named = ["unit", "units", "Unit", "Units"].iter().find_map(|n| set.attribute(n).ok());
    let Some(attribute) = named else { return Ok((None, None)) };
    match attribute.read_strings().map_err(broken)?.into_iter().next() {
        Some(name) => Ok((Some(Unit::stated("unit", &name)?), Some(name))),
        None => Ok((None, None)),
    }
}
