//! Artifacts: directories of arrays with a manifest. They are checked when read, and written whole or not at all.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    io::{ErrorKind, Read, Write},
    path::Path,
    thread,
};

use ndarray::{ArrayD, Dimension};
use planish_types::{Invalid, outcome::StageEnd};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_json::{Map, Value};

use crate::{
    HandoffError,
    kind::{self, ArrayDef, Dtype, Kind, MANIFEST},
    npy::{self, ArrayData},
    place::is_absent,
    system::directory_stamp,
};

/// Largest manifest that is read, bytes (256 MiB). Larger: a damaged file takes more memory and time. Smaller:
/// manifests of long plans are refused, because some methods report about a hundred bytes for every segment that they
/// stretched.
const LARGEST_MANIFEST_BYTES: u64 = 1 << 28;

/// A type that can be stored as an artifact directory: one `.npy` file per array, and a manifest.
pub trait Artifact: Sized {
    /// Kind of the directory, which defines its arrays.
    const KIND: &'static Kind;
    /// Returns the arrays in the order in which the kind defines them. Optional arrays at the end may be left out.
    fn to_arrays(&self) -> Vec<ArrayData<'_>>;
    /// Makes the value from its arrays, whose dtypes, shapes and finiteness have been checked.
    fn from_arrays(arrays: Arrays) -> Result<Self, Invalid>;
}

/// Arrays that were read from one artifact directory, by name; `take_...` removes them one by one.
#[derive(Debug, Default)]
pub struct Arrays(BTreeMap<&'static str, ArrayData<'static>>);

impl Arrays {
    /// Removes and returns the float array `name`. Panics if the kind does not define it as floats, or if it was taken.
    pub fn take_f64(&mut self, name: &str) -> ArrayD<f64> {
        match self.0.remove(name) {
            Some(ArrayData::F64(a)) => a.into_owned(),
            other => panic!("the kind promises {name} as <f8, found {other:?}"),
        }
    }

    /// Removes and returns the integer array `name`. Panics if the kind does not define it as integers, or if it was
    /// taken.
    pub fn take_i64(&mut self, name: &str) -> ArrayD<i64> {
        match self.0.remove(name) {
            Some(ArrayData::I64(a)) => a.into_owned(),
            other => panic!("the kind promises {name} as <i8, found {other:?}"),
        }
    }

    /// Removes and returns the array of flags `name`. Panics if the kind does not define it as flags, or if it was
    /// taken.
    pub fn take_bool(&mut self, name: &str) -> Vec<bool> {
        match self.0.remove(name) {
            Some(ArrayData::U8(a)) => a.iter().map(|v| *v != 0).collect(),
            other => panic!("the kind promises {name} as |u1, found {other:?}"),
        }
    }
}

/// Content of `manifest.json`: origin and result of an artifact, and the hashes of its files.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Name of the kind of artifact, such as `surface`.
    pub kind: String,
    /// Version of the layout of the kind, which says which arrays there are.
    pub version: u32,
    /// Name of the program that wrote the artifact, such as `planish-dwell`.
    pub tool: String,
    /// Version of the program that wrote the artifact.
    pub tool_version: String,
    /// Subcommand of the program that wrote the artifact.
    pub method: String,
    /// Command line that wrote the artifact, quoted for a shell.
    pub command: String,
    /// BLAKE3 hash of tool, version, method, settings and inputs. An output with the same key is up to date.
    pub key: String,
    /// Frame that the coordinates refer to, in words.
    pub frame: String,
    /// Settings of the stage with their values, defaults included.
    pub settings: Value,
    /// Inputs that the stage read, with their hashes.
    pub inputs: Vec<InputRecord>,
    /// All artifacts and files that the artifact was made from, inputs of inputs included.
    #[serde(default)]
    pub lineage: BTreeSet<Ancestor>,
    /// Outcome: `status` and the numbers that the method reports.
    pub outcome: Value,
    /// Records of the arrays, by their names.
    pub arrays: BTreeMap<String, ArrayRecord>,
    /// BLAKE3 hashes of the files beside the arrays, by file name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub files: BTreeMap<String, String>,
}

impl Manifest {
    /// Returns the BLAKE3 of the content that the manifest describes: of the names and hashes of its arrays, or of its
    /// outcome if readers of this kind use only that. A stage that reads the artifact records it as its input. `None`
    /// if this version does not know the kind.
    pub fn content(&self) -> Option<String> {
        let kind = kind::ALL.iter().find(|kind| kind.name == self.kind)?;
        if kind.is_read_by_outcome() {
            return Some(blake3::hash(self.outcome.to_string().as_bytes()).to_string());
        }
        let stored = kind.arrays.iter().filter_map(|def| Some((def, self.arrays.get(def.name)?)));
        let mut hasher = blake3::Hasher::new();
        for (def, record) in stored {
            hasher.update(def.name.as_bytes()).update(record.blake3.as_bytes());
        }
        Some(hasher.finalize().to_string())
    }

    /// Returns the status with which the stage ended, and the reason if it is negative. A manifest without a status
    /// counts as done.
    pub fn end(&self) -> StageEnd {
        StageEnd::deserialize(&self.outcome).unwrap_or_default()
    }

    /// Returns the outcome (status and numbers) as the type that the stage writes.
    ///
    /// # Errors
    /// Fails if a field is missing or has another type; the message then ends with `remedy`. `path` names the
    /// artifact.
    pub fn read_outcome<T: DeserializeOwned>(
        &self,
        path: &Path,
        remedy: &str,
    ) -> Result<T, HandoffError> {
        part(&self.outcome)
            .map_err(|e| HandoffError::new(path, format!("has no usable outcome ({e}); {remedy}")))
    }

    /// Returns the settings of the stage as a type of which other stages read some fields.
    ///
    /// # Errors
    /// Fails if a setting is missing or has another type. `path` names the artifact.
    pub fn read_settings<T: DeserializeOwned>(&self, path: &Path) -> Result<T, HandoffError> {
        part(&self.settings).map_err(|e| {
            HandoffError::new(path, format!("has no usable settings ({e}); make it again"))
        })
    }

    /// Returns the text of the file: JSON whose last key is the BLAKE3 of everything before it.
    pub(crate) fn to_text(&self) -> String {
        let text = serde_json::to_string_pretty(self).expect("a manifest serialises");
        let body = text.strip_suffix("\n}").expect("a manifest has keys");
        format!("{body}{SEAL}{}\"\n}}\n", blake3::hash(body.as_bytes()))
    }
}

/// Reads the settings or the outcome of a manifest as a type; `null` counts as an object without keys.
fn part<T: DeserializeOwned>(value: &Value) -> serde_json::Result<T> {
    if value.is_null() { T::deserialize(Value::Object(Map::new())) } else { T::deserialize(value) }
}

/// Text between the body of a manifest and its seal, the hash of the body. It is part of the file format.
const SEAL: &str = ",\n  \"seal\": \"";

/// Result of the comparison of a manifest's seal with its body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Seal {
    /// The seal is the hash of the body.
    Whole,
    /// The seal is another hash: the manifest was edited or damaged.
    Broken,
    /// The manifest has no seal: an older version or another program wrote it.
    Absent,
}

/// Compares the seal in the text of a manifest with the hash of its body.
fn seal_of(text: &str) -> Seal {
    let Some((body, rest)) = text.rsplit_once(SEAL) else { return Seal::Absent };
    let seal = rest.trim_end_matches(['\n', '}', '"']);
    if seal == blake3::hash(body.as_bytes()).to_string() { Seal::Whole } else { Seal::Broken }
}

/// An artifact or file that an artifact was made from, directly or through others.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Ancestor {
    /// Kind of the artifact, or the role (flag) of a file.
    pub kind: String,
    /// BLAKE3 hash of the content.
    pub blake3: String,
}

/// An input of the stage that wrote an artifact.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InputRecord {
    /// Name of the flag that gave the input.
    pub role: String,
    /// Path of the input as the user gave it.
    pub path: String,
    /// Kind of artifact, or `file`.
    pub kind: String,
    /// BLAKE3 hash of the content.
    pub blake3: String,
}

/// Record of a stored array in the manifest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArrayRecord {
    /// Name of the file in the directory of the artifact.
    pub file: String,
    /// NumPy's name of the element type, such as `<f8`.
    pub dtype: String,
    /// Sizes along the axes, the slowest axis first.
    pub shape: Vec<usize>,
    /// Names of the axes, the slowest first.
    pub axes: Vec<String>,
    /// Unit of the elements, such as `nm`.
    pub unit: String,
    /// BLAKE3 hash of the file.
    pub blake3: String,
}

/// An artifact that has been read and checked, with its hash and manifest.
#[derive(Debug)]
pub struct Loaded<T> {
    /// Value of the artifact.
    pub value: T,
    /// BLAKE3 hash of the content of the artifact, with or without a manifest.
    pub digest: String,
    /// Manifest; `None` if the directory has none.
    pub manifest: Option<Manifest>,
    /// Warning for the user about the artifact; `None` if there is none.
    pub warning: Option<String>,
}

/// Reads the artifact in `dir`; checks kind, version, dtypes, shapes, finiteness and hashes.
///
/// # Errors
/// Fails if the directory, its manifest or an array cannot be read, is of another kind or a newer version, was changed
/// after it was written, or holds values that the kind does not allow.
pub fn read<T: Artifact>(dir: &Path) -> Result<Loaded<T>, HandoffError> {
    read_whole(dir, || {
        check_directory(dir, T::KIND)?;
        read_arrays(dir, manifest_text(dir)?.as_deref())
    })
}

/// Reads a directory by `read_once`. Reads again if that failed and another run replaced the directory in the meantime.
pub(crate) fn read_whole<T>(
    dir: &Path,
    read_once: impl Fn() -> Result<T, HandoffError>,
) -> Result<T, HandoffError> {
    loop {
        // If another run replaces the directory meanwhile, the reader gets a mixture of the old and
        // the new one. The hashes reveal that, and the directory is read again.
        let before = directory_stamp(dir);
        let result = read_once();
        if result.is_ok() || directory_stamp(dir) == before {
            return result;
        }
    }
}

/// Reads the arrays in `dir`, checks them against the kind and the manifest, and makes the value. `text` is the text of
/// the manifest; `None` if there is none.
pub(crate) fn read_arrays<T: Artifact>(
    dir: &Path,
    text: Option<&str>,
) -> Result<Loaded<T>, HandoffError> {
    let manifest = text.map(|text| checked_manifest(dir, T::KIND, text)).transpose()?;
    let manifest = manifest.map(|(manifest, _)| manifest);
    let mut arrays = Arrays::default();
    let mut sizes = BTreeMap::new();
    let mut defaulted = Vec::new();
    let mut absent = Vec::new();
    let mut converted = Vec::new();
    let mut hasher = blake3::Hasher::new();
    for def in T::KIND.arrays {
        let path = dir.join(format!("{}.npy", def.name));
        if is_absent(&path) {
            let listed = manifest.as_ref().is_some_and(|m| m.arrays.contains_key(def.name));
            if def.optional_since.is_some() && !listed {
                absent.push(def);
                continue;
            }
            if manifest.is_none() && def.default.is_some() {
                defaulted.push(def);
                continue;
            }
            return Err(HandoffError::new(
                &path,
                format!(
                    "is missing; a {} needs {} as {} (see docs/formats.md)",
                    T::KIND.name,
                    def.name,
                    def.dtype.numpy()
                ),
            ));
        }
        let npy::Loaded { array, blake3: hash, note } = read_array(&path, def)?;
        converted.extend(note.map(|note| format!("{}.npy {note}", def.name)));
        check_shape(&path, def, array.shape(), &mut sizes)?;
        if let Some(manifest) = &manifest {
            check_record(&path, def, manifest.arrays.get(def.name), &array, &hash)?;
        }
        hasher.update(def.name.as_bytes()).update(hash.as_bytes());
        arrays.0.insert(def.name, array);
    }
    for def in defaulted.iter().chain(&absent) {
        arrays.0.insert(def.name, default_array(def, &sizes));
    }
    let mut warning = None;
    if manifest.is_none() {
        let mut text =
            format!("{}: no {MANIFEST}, read as bare arrays of a {}", dir.display(), T::KIND.name);
        for def in &defaulted {
            text += &format!("; no {}.npy, taken as {}", def.name, def.default.unwrap_or(0));
        }
        for note in &converted {
            text += &format!("; {note}");
        }
        warning = Some(text);
    }
    let value = T::from_arrays(arrays).map_err(|e| {
        let file = T::KIND.arrays.iter().find(|a| a.name == e.array);
        let path = file.map_or(dir.to_path_buf(), |a| dir.join(format!("{}.npy", a.name)));
        HandoffError::new(&path, e.to_string())
    })?;
    Ok(Loaded { value, digest: hasher.finalize().to_string(), manifest, warning })
}

/// Refuses a path that does not exist or is not a directory; the message names the `kind` that is needed.
pub(crate) fn check_directory(dir: &Path, kind: &Kind) -> Result<(), HandoffError> {
    let problem = match fs::metadata(dir) {
        Ok(m) if m.is_dir() => return Ok(()),
        Ok(_) => "is not a directory".into(),
        Err(e) if e.kind() == ErrorKind::NotFound => "does not exist".into(),
        Err(e) => format!("cannot be read: {e}"),
    };
    let remedy = format!("give a {} directory (see docs/formats.md)", kind.name);
    Err(HandoffError::new(dir, format!("{problem}; {remedy}")))
}

/// Reads the manifest in `dir` and checks it against `kind`; `None` if there is no manifest.
///
/// # Errors
/// Fails if the manifest cannot be read, is of another kind or a newer version, or was changed after it was written.
pub fn read_manifest(dir: &Path, kind: &Kind) -> Result<Option<Manifest>, HandoffError> {
    Ok(read_sealed_manifest(dir, kind)?.map(|(manifest, _)| manifest))
}

/// Reads the manifest in `dir`, checks it against `kind`, and returns it with the state of its seal. It is `None` if
/// there is no manifest, and a broken seal is refused.
pub(crate) fn read_sealed_manifest(
    dir: &Path,
    kind: &Kind,
) -> Result<Option<(Manifest, Seal)>, HandoffError> {
    manifest_text(dir)?.map(|text| checked_manifest(dir, kind, &text)).transpose()
}

/// Reads the text of the manifest in `dir`; `None` if there is none.
pub(crate) fn manifest_text(dir: &Path) -> Result<Option<String>, HandoffError> {
    let path = dir.join(MANIFEST);
    if is_absent(&path) {
        return Ok(None);
    }
    read_text(&path, LARGEST_MANIFEST_BYTES).map(Some)
}

/// Parses a manifest, checks it against `kind`, and returns it with the state of its seal. `text` is its text and `dir`
/// its directory, for messages. Refuses another kind, a newer version, text that is no manifest, and a broken seal.
fn checked_manifest(dir: &Path, kind: &Kind, text: &str) -> Result<(Manifest, Seal), HandoffError> {
    let path = dir.join(MANIFEST);
    let damaged = |what: String| {
        HandoffError::new(
            &path,
            format!("{what}; make the artifact again, or remove {MANIFEST} to use your own arrays"),
        )
    };
    let unreadable = |e: serde_json::Error| damaged(format!("is not a manifest ({e})"));
    // Kind and version are checked first, because everything else may differ in a newer manifest.
    let head: ManifestHead = serde_json::from_str(text).map_err(unreadable)?;
    if head.kind == kind::FORMER_DWELL_DENSITY {
        let problem = "holds a feed, as an older Planish called a dwell_density; make it again, by \
                       `planish schedule trig-spline --dwell-density-out` or `planish bspline-feed`";
        return Err(HandoffError::new(dir, problem));
    }
    if head.kind != kind.name {
        return Err(HandoffError::new(
            dir,
            format!("holds a {}, needs a {}; check the order of the flags", head.kind, kind.name),
        ));
    }
    if head.version > kind.version {
        return Err(HandoffError::new(
            &path,
            format!(
                "{} version {} is newer than this program knows ({}); update Planish",
                kind.name, head.version, kind.version
            ),
        ));
    }
    let seal = seal_of(text);
    if seal == Seal::Broken {
        return Err(damaged("was changed after it was written".into()));
    }
    Ok((serde_json::from_str(text).map_err(unreadable)?, seal))
}

/// Reads the text of a regular file of at most `most` bytes. It refuses larger files, text that is not UTF-8, and pipes
/// and devices, because they may never end.
pub(crate) fn read_text(path: &Path, most: u64) -> Result<String, HandoffError> {
    String::from_utf8(read_file(path, most)?).map_err(|e| {
        let byte = e.utf8_error().valid_up_to();
        HandoffError::new(path, format!("is not text (byte {byte} is not UTF-8); write it again"))
    })
}

/// Reads the bytes of a regular file.
///
/// # Errors
/// Fails if it cannot be read. Refuses a pipe or a device, because it may never end.
pub fn read_regular(path: &Path) -> std::io::Result<Vec<u8>> {
    if !fs::metadata(path)?.is_file() {
        return Err(std::io::Error::other("is not a file; give a regular file"));
    }
    fs::read(path)
}

/// Reads the bytes of a regular file of at most `most` bytes. It refuses larger files, pipes and devices.
pub(crate) fn read_file(path: &Path, most: u64) -> Result<Vec<u8>, HandoffError> {
    let io = |e| HandoffError::io(path, "read", &e);
    if !fs::metadata(path).map_err(io)?.is_file() {
        return Err(HandoffError::new(path, "is not a file; give a regular file"));
    }
    let mut bytes = Vec::new();
    fs::File::open(path).and_then(|f| f.take(most + 1).read_to_end(&mut bytes)).map_err(io)?;
    if bytes.len() as u64 > most {
        let problem = format!("has more than {most} bytes; give a smaller file");
        return Err(HandoffError::new(path, problem));
    }
    Ok(bytes)
}

/// Keys that every version of a manifest has.
#[derive(Deserialize)]
pub struct ManifestHead {
    /// Name of the kind.
    pub kind: String,
    version: u32,
}

/// Number of values of an array that are checked for NaN and infinity in one pass without an early exit. Larger: a
/// bad value is found later. Smaller: vector instructions help less. It does not change the result.
const VALUES_PER_LOOK: usize = 1 << 12;

/// Reads an array. Refuses infinity, NaN where the definition does not allow it, and flags other than 0 and 1.
fn read_array(path: &Path, def: &ArrayDef) -> Result<npy::Loaded, HandoffError> {
    let loaded = npy::read(path, def.dtype)?;
    if let ArrayData::F64(a) = &loaded.array {
        let bad = |v: f64| v.is_infinite() || (v.is_nan() && !def.nan_allowed);
        // The fold has no early exit, so that the compiler uses vectors.
        let whole = a.as_slice().is_some_and(|a| {
            let mut parts = a.chunks(VALUES_PER_LOOK);
            !parts.any(|part| part.iter().fold(false, |any, v| any | bad(*v)))
        });
        if !whole && let Some((index, v)) = a.indexed_iter().find(|(_, v)| bad(**v)) {
            let remedy =
                if def.nan_allowed { "mark an invalid pixel by NaN" } else { "give finite values" };
            let index = index.slice().to_vec();
            return Err(HandoffError::new(path, format!("element {index:?} is {v}; {remedy}")));
        }
    }
    if let ArrayData::U8(a) = &loaded.array
        && let Some((index, v)) = a.indexed_iter().find(|(_, v)| **v > 1)
    {
        let index = index.slice().to_vec();
        return Err(HandoffError::new(path, format!("element {index:?} is {v}; give 0 or 1")));
    }
    Ok(loaded)
}

/// Compares `shape` with the definition. `sizes` holds the size of each symbol such as `n`, which is set where the
/// symbol first occurs, and the array that set it.
fn check_shape(
    path: &Path,
    def: &ArrayDef,
    shape: &[usize],
    sizes: &mut BTreeMap<&'static str, (usize, &'static str)>,
) -> Result<(), HandoffError> {
    let wanted = def.shape.join(", ");
    if shape.len() != def.shape.len() {
        return Err(HandoffError::new(
            path,
            format!(
                "has {} axes (shape {shape:?}), needs {}: ({wanted})",
                shape.len(),
                def.shape.len()
            ),
        ));
    }
    for (symbol, size) in def.shape.iter().zip(shape) {
        let expected = if let Ok(number) = symbol.parse::<usize>() {
            number
        } else {
            let (name, more) = split_symbol(symbol);
            let Some(base) = size.checked_sub(more) else {
                return Err(HandoffError::new(
                    path,
                    format!("has shape {shape:?}, needs ({wanted})"),
                ));
            };
            let (bound, by) = *sizes.entry(name).or_insert((base, def.name));
            if bound != base {
                return Err(HandoffError::new(
                    path,
                    format!(
                        "has shape {shape:?}, needs ({wanted}) with {name} = {bound} from {by}.npy; \
                         give arrays that belong together"
                    ),
                ));
            }
            bound + more
        };
        if expected != *size {
            return Err(HandoffError::new(path, format!("has shape {shape:?}, needs ({wanted})")));
        }
    }
    Ok(())
}

/// Splits a size into its symbol and its offset: `"n+1"` is ("n", 1); `"n"` is ("n", 0).
fn split_symbol(symbol: &'static str) -> (&'static str, usize) {
    symbol.strip_suffix("+1").map_or((symbol, 0), |name| (name, 1))
}

/// Compares an array that was read with its record in the manifest: unit, shape and hash. Refuses an array without a
/// record.
fn check_record(
    path: &Path,
    def: &ArrayDef,
    record: Option<&ArrayRecord>,
    array: &ArrayData,
    hash: &str,
) -> Result<(), HandoffError> {
    match record {
        Some(r) if r.unit != def.unit => Err(HandoffError::new(
            path,
            format!(
                "{MANIFEST} says that {} is in {:?}, it is read in {:?}; convert the array and make \
                 the artifact again",
                def.name, r.unit, def.unit
            ),
        )),
        Some(r) if r.blake3 == hash => Ok(()),
        Some(r) if r.shape != array.shape() => Err(HandoffError::new(
            path,
            format!(
                "has shape {:?} but {MANIFEST} says {:?}; make the artifact again, or remove \
                 {MANIFEST} to use your own arrays",
                array.shape(),
                r.shape
            ),
        )),
        Some(r) => Err(HandoffError::new(
            path,
            format!(
                "was changed after it was written (BLAKE3 {hash}, {MANIFEST} says {}); make the \
                 artifact again, or remove {MANIFEST} to use your own arrays",
                r.blake3
            ),
        )),
        None => Err(HandoffError::new(
            path,
            format!(
                "is not listed in {MANIFEST}; make the artifact again, or remove {MANIFEST} to \
                 use your own arrays"
            ),
        )),
    }
}

/// Returns the array that replaces an absent optional one: filled with its default, or empty without a default.
/// `sizes` holds the sizes of the symbols of its shape.
fn default_array(
    def: &ArrayDef,
    sizes: &BTreeMap<&'static str, (usize, &'static str)>,
) -> ArrayData<'static> {
    let known = def.shape.iter().map(|s| sizes.get(s).filter(|_| def.default.is_some()));
    let shape: Vec<usize> = known.map(|size| size.map_or(0, |(n, _)| *n)).collect();
    let value = def.default.unwrap_or(0);
    match def.dtype {
        Dtype::F64 => ArrayData::F64(ArrayD::from_elem(shape, f64::from(value)).into()),
        Dtype::I64 => ArrayData::I64(ArrayD::from_elem(shape, i64::from(value)).into()),
        Dtype::U8 => ArrayData::U8(ArrayD::from_elem(shape, value).into()),
    }
}

/// Writes the arrays of an artifact as `.npy` files into the directory `dir`. Returns their records for the manifest,
/// by name.
pub(crate) fn write_arrays(
    dir: &Path,
    kind: &Kind,
    arrays: &[ArrayData],
) -> Result<BTreeMap<String, ArrayRecord>, HandoffError> {
    let lacking = kind.arrays.get(arrays.len()..).expect("no more arrays than the kind has");
    assert!(lacking.iter().all(|a| a.optional_since.is_some()), "{}: its arrays", kind.name);
    // Each array has its own thread, because hashing and copying take most of the time.
    let hashes = thread::scope(|scope| {
        let mut threads = Vec::with_capacity(arrays.len());
        for (def, array) in kind.arrays.iter().zip(arrays) {
            let path = dir.join(format!("{}.npy", def.name));
            threads.push(scope.spawn(move || npy::write(&path, array)));
        }
        let joined = threads.into_iter().map(|t| t.join().expect("writing does not panic"));
        joined.collect::<Result<Vec<_>, _>>()
    })?;
    let mut records = BTreeMap::new();
    for ((def, array), blake3) in kind.arrays.iter().zip(arrays).zip(hashes) {
        assert_eq!(array.dtype(), def.dtype, "{}/{}", kind.name, def.name);
        let record = ArrayRecord {
            file: format!("{}.npy", def.name),
            dtype: def.dtype.numpy().into(),
            shape: array.shape().to_vec(),
            axes: def.axes.iter().map(|a| a.to_string()).collect(),
            unit: def.unit.into(),
            blake3,
        };
        records.insert(def.name.to_string(), record);
    }
    Ok(records)
}

/// Writes `bytes` as the new file `path`. The file is synchronised with the disk when the function
/// returns.
pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), HandoffError> {
    fs::File::create_new(path)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_data()))
        .map_err(|e| HandoffError::io(path, "write", &e))
}

/// Returns true if the directory holds every file that its manifest lists. It refuses a directory with a file that
/// differs from the manifest or is not listed. Somebody changed it or put it there, and it would be lost.
pub(crate) fn is_complete(dir: &Path, manifest: &Manifest) -> Result<bool, HandoffError> {
    let mut known: BTreeMap<&str, &str> = BTreeMap::new();
    known.extend(manifest.arrays.values().map(|r| (r.file.as_str(), r.blake3.as_str())));
    known.extend(manifest.files.iter().map(|(file, hash)| (file.as_str(), hash.as_str())));
    let mut count = 0;
    for entry in fs::read_dir(dir).map_err(|e| HandoffError::io(dir, "read", &e))? {
        let name = entry.map_err(|e| HandoffError::io(dir, "read", &e))?.file_name();
        if *name == *MANIFEST {
            continue;
        }
        let hash = npy::hash(&dir.join(&name)).ok();
        if hash.is_none() || known.get(name.to_string_lossy().as_ref()).copied() != hash.as_deref()
        {
            return Err(HandoffError::new(
                &dir.join(&name),
                format!(
                    "is not what {MANIFEST} says that Planish wrote; move it elsewhere to keep it, \
                     or remove it to have it made again"
                ),
            ));
        }
        count += 1;
    }
    Ok(count == known.len())
}
