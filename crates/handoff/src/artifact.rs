//! A directory of arrays with its manifest: read and checked, written whole or not at all.

use std::{
    collections::BTreeMap,
    fs,
    io::ErrorKind,
    path::{Path, PathBuf},
    thread,
};

use ndarray::{ArrayD, Dimension};
use planish_types::Invalid;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{
    HandoffError,
    kind::{ArrayDef, Dtype, Kind},
    npy::{self, ArrayData},
};

/// Name of the manifest in an artifact directory.
pub const MANIFEST: &str = "manifest.json";

/// A noun that can be stored as a directory of arrays.
pub trait Artifact: Sized {
    /// What the directory holds.
    const KIND: &'static Kind;
    /// The arrays, in the order of the kind.
    fn to_arrays(&self) -> Vec<ArrayData>;
    /// Back from the arrays, whose dtypes, shapes and finiteness have been checked.
    fn from_arrays(arrays: Arrays) -> Result<Self, Invalid>;
}

/// The arrays of one directory, by name.
#[derive(Debug, Default)]
pub struct Arrays(BTreeMap<&'static str, ArrayData>);

impl Arrays {
    /// Takes out a float array that the kind promises.
    pub fn take_f64(&mut self, name: &str) -> ArrayD<f64> {
        match self.0.remove(name) {
            Some(ArrayData::F64(a)) => a,
            other => panic!("the kind promises {name} as <f8, found {other:?}"),
        }
    }

    /// Takes out an integer array that the kind promises.
    pub fn take_i64(&mut self, name: &str) -> ArrayD<i64> {
        match self.0.remove(name) {
            Some(ArrayData::I64(a)) => a,
            other => panic!("the kind promises {name} as <i8, found {other:?}"),
        }
    }

    /// Takes out an array of flags that the kind promises.
    pub fn take_bool(&mut self, name: &str) -> Vec<bool> {
        match self.0.remove(name) {
            Some(ArrayData::U8(a)) => a.iter().map(|v| *v != 0).collect(),
            other => panic!("the kind promises {name} as |u1, found {other:?}"),
        }
    }
}

/// `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Name of the kind.
    pub kind: String,
    /// Version of the kind's layout.
    pub version: u32,
    /// Binary that wrote it.
    pub tool: String,
    /// Its version.
    pub tool_version: String,
    /// Its subcommand.
    pub method: String,
    /// Command line.
    pub command: String,
    /// BLAKE3 of tool, version, method, settings and inputs.
    pub key: String,
    /// What the coordinates refer to.
    pub frame: String,
    /// Resolved settings.
    pub settings: Value,
    /// Inputs with their hashes.
    pub inputs: Vec<InputRecord>,
    /// `status` and what the method reports.
    pub outcome: Value,
    /// Arrays by name.
    pub arrays: BTreeMap<String, ArrayRecord>,
    /// BLAKE3 of the files beside the arrays, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub files: BTreeMap<String, String>,
}

/// An input of the stage that wrote an artifact.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InputRecord {
    /// The flag it was given by.
    pub role: String,
    /// Path as given.
    pub path: String,
    /// Kind of artifact, or `file`.
    pub kind: String,
    /// BLAKE3 of its content.
    pub blake3: String,
}

/// A stored array.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArrayRecord {
    /// File name in the directory.
    pub file: String,
    /// NumPy's name of the element type.
    pub dtype: String,
    /// Sizes.
    pub shape: Vec<usize>,
    /// What runs along the axes.
    pub axes: Vec<String>,
    /// Unit of the elements.
    pub unit: String,
    /// BLAKE3 of the file.
    pub blake3: String,
}

/// An artifact that has been read and checked.
#[derive(Debug)]
pub struct Loaded<T> {
    /// The value.
    pub value: T,
    /// BLAKE3 of its content, whether or not it has a manifest.
    pub digest: String,
    /// `None` for a directory without a manifest.
    pub manifest: Option<Manifest>,
    /// What the user should know, for standard error.
    pub warning: Option<String>,
}

/// Reads the artifact in `dir`; checks kind, version, dtypes, shapes, finiteness and hashes.
pub fn read<T: Artifact>(dir: &Path) -> Result<Loaded<T>, HandoffError> {
    loop {
        // A directory that is replaced meanwhile is read as a mixture of the old and the new one,
        // which the hashes reveal: then it is read again.
        let before = identity(dir);
        let result = read_once(dir);
        if result.is_ok() || identity(dir) == before {
            return result;
        }
    }
}

/// Differs when a directory has been replaced by another.
fn identity(dir: &Path) -> Option<impl PartialEq + use<>> {
    let metadata = fs::metadata(dir).ok()?;
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        Some((metadata.ino(), metadata.ctime(), metadata.ctime_nsec()))
    }
    #[cfg(not(unix))]
    metadata.created().ok()
}

fn read_once<T: Artifact>(dir: &Path) -> Result<Loaded<T>, HandoffError> {
    check_directory(dir, T::KIND)?;
    let manifest = read_manifest(dir, T::KIND)?;
    let mut arrays = Arrays::default();
    let mut sizes = BTreeMap::new();
    let mut defaulted = Vec::new();
    let mut hasher = blake3::Hasher::new();
    for def in T::KIND.arrays {
        let path = dir.join(format!("{}.npy", def.name));
        if is_absent(&path) {
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
        let (array, hash) = read_array(&path, def)?;
        check_shape(&path, def, array.shape(), &mut sizes)?;
        if let Some(manifest) = &manifest {
            check_record(&path, manifest.arrays.get(def.name), &array, &hash)?;
        }
        hasher.update(def.name.as_bytes()).update(hash.as_bytes());
        arrays.0.insert(def.name, array);
    }
    for def in &defaulted {
        arrays.0.insert(def.name, default_array(def, &sizes));
    }
    let warning = manifest.is_none().then(|| {
        let mut text =
            format!("{}: no {MANIFEST}, read as bare arrays of a {}", dir.display(), T::KIND.name);
        for def in &defaulted {
            text += &format!("; no {}.npy, taken as {}", def.name, def.default.unwrap_or(0));
        }
        text
    });
    let value = T::from_arrays(arrays).map_err(|e| {
        let file = T::KIND.arrays.iter().find(|a| a.name == e.array);
        let path = file.map_or(dir.to_path_buf(), |a| dir.join(format!("{}.npy", a.name)));
        HandoffError::new(&path, e.to_string())
    })?;
    Ok(Loaded { value, digest: hasher.finalize().to_string(), manifest, warning })
}

/// Refuses what is not a directory.
fn check_directory(dir: &Path, kind: &Kind) -> Result<(), HandoffError> {
    let problem = match fs::metadata(dir) {
        Ok(m) if m.is_dir() => return Ok(()),
        Ok(_) => "is not a directory".into(),
        Err(e) if e.kind() == ErrorKind::NotFound => "does not exist".into(),
        Err(e) => format!("cannot be read: {e}"),
    };
    let remedy = format!("give a {} directory (see docs/formats.md)", kind.name);
    Err(HandoffError::new(dir, format!("{problem}; {remedy}")))
}

/// Whether there is nothing of this name; a broken link or an unreadable file is something.
fn is_absent(path: &Path) -> bool {
    fs::symlink_metadata(path).is_err_and(|e| e.kind() == ErrorKind::NotFound)
}

/// The manifest in `dir`, checked against `kind`; `None` when there is none.
pub fn read_manifest(dir: &Path, kind: &Kind) -> Result<Option<Manifest>, HandoffError> {
    let path = dir.join(MANIFEST);
    if is_absent(&path) {
        return Ok(None);
    }
    let text = fs::read_to_string(&path).map_err(|e| HandoffError::io(&path, "read", &e))?;
    let damaged = |e: serde_json::Error| {
        HandoffError::new(
            &path,
            format!(
                "is not a manifest ({e}); make the artifact again, or remove {MANIFEST} to use \
                 your own arrays"
            ),
        )
    };
    // Kind and version first: a newer manifest may look different in everything else.
    let head: ManifestHead = serde_json::from_str(&text).map_err(damaged)?;
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
    serde_json::from_str(&text).map(Some).map_err(damaged)
}

/// What every version of a manifest has.
#[derive(Deserialize)]
struct ManifestHead {
    kind: String,
    version: u32,
}

fn read_array(path: &Path, def: &ArrayDef) -> Result<(ArrayData, String), HandoffError> {
    let (array, hash) = npy::read(path, def.dtype)?;
    if let ArrayData::F64(a) = &array {
        let bad = |v: f64| v.is_infinite() || (v.is_nan() && !def.nan_allowed);
        if let Some(at) = a.iter().position(|v| bad(*v)) {
            let (index, v) = a.indexed_iter().nth(at).expect("it is one of them");
            let remedy =
                if def.nan_allowed { "mark an invalid pixel by NaN" } else { "give finite values" };
            let index = index.slice().to_vec();
            return Err(HandoffError::new(path, format!("element {index:?} is {v}; {remedy}")));
        }
    }
    if let ArrayData::U8(a) = &array
        && let Some((index, v)) = a.indexed_iter().find(|(_, v)| **v > 1)
    {
        let index = index.slice().to_vec();
        return Err(HandoffError::new(path, format!("element {index:?} is {v}; give 0 or 1")));
    }
    Ok((array, hash))
}

/// Compares `shape` with the definition; binds its symbols on first sight.
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
    for (symbol, found) in def.shape.iter().zip(shape) {
        let expected = if let Ok(number) = symbol.parse::<usize>() {
            number
        } else {
            let (name, more) = split_symbol(symbol);
            let Some(base) = found.checked_sub(more) else {
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
        if expected != *found {
            return Err(HandoffError::new(path, format!("has shape {shape:?}, needs ({wanted})")));
        }
    }
    Ok(())
}

/// `"n+1"` is ("n", 1); `"n"` is ("n", 0).
fn split_symbol(symbol: &'static str) -> (&'static str, usize) {
    symbol.strip_suffix("+1").map_or((symbol, 0), |name| (name, 1))
}

fn check_record(
    path: &Path,
    record: Option<&ArrayRecord>,
    array: &ArrayData,
    hash: &str,
) -> Result<(), HandoffError> {
    match record {
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

fn default_array(
    def: &ArrayDef,
    sizes: &BTreeMap<&'static str, (usize, &'static str)>,
) -> ArrayData {
    let shape: Vec<usize> = def.shape.iter().map(|s| sizes.get(s).map_or(0, |(n, _)| *n)).collect();
    let value = def.default.unwrap_or(0);
    match def.dtype {
        Dtype::F64 => ArrayData::F64(ArrayD::from_elem(shape, f64::from(value))),
        Dtype::I64 => ArrayData::I64(ArrayD::from_elem(shape, i64::from(value))),
        Dtype::U8 => ArrayData::U8(ArrayD::from_elem(shape, value)),
    }
}

/// Writes the arrays of an artifact into the directory `dir`; their records for the manifest.
pub(crate) fn write_arrays(
    dir: &Path,
    kind: &Kind,
    arrays: &[ArrayData],
) -> Result<BTreeMap<String, ArrayRecord>, HandoffError> {
    assert_eq!(arrays.len(), kind.arrays.len(), "{}: arrays of the kind", kind.name);
    let each = || kind.arrays.iter().zip(arrays);
    let file = |def: &ArrayDef| format!("{}.npy", def.name);
    // Each by a thread of its own: what takes time is hashing and copying.
    let hashes = thread::scope(|scope| {
        let write = |(def, array)| {
            let path = dir.join(file(def));
            scope.spawn(move || npy::write(&path, array))
        };
        let threads: Vec<_> = each().map(write).collect();
        let joined = threads.into_iter().map(|t| t.join().expect("writing does not panic"));
        joined.collect::<Result<Vec<_>, _>>()
    })?;
    let record = |((def, array), blake3): ((&ArrayDef, &ArrayData), String)| {
        assert_eq!(array.dtype(), def.dtype, "{}/{}", kind.name, def.name);
        let record = ArrayRecord {
            file: file(def),
            dtype: def.dtype.numpy().into(),
            shape: array.shape().to_vec(),
            axes: def.axes.iter().map(|a| a.to_string()).collect(),
            unit: def.unit.into(),
            blake3,
        };
        (def.name.to_string(), record)
    };
    Ok(each().zip(hashes).map(record).collect())
}

/// Writes `bytes` as the file `path`.
pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), HandoffError> {
    fs::write(path, bytes).map_err(|e| HandoffError::io(path, "write", &e))
}

/// Whether the directory holds every array of `kind` and what its manifest says, byte for byte.
pub(crate) fn is_intact(dir: &Path, kind: &Kind, manifest: &Manifest) -> bool {
    let complete = kind.arrays.iter().all(|a| manifest.arrays.contains_key(a.name));
    let arrays = manifest.arrays.values().map(|r| (&r.file, &r.blake3));
    complete
        && arrays
            .chain(&manifest.files)
            .all(|(file, hash)| npy::hash(&dir.join(file)).is_ok_and(|found| found == *hash))
}

/// Refuses a directory with anything in it that no artifact of `kind` has: it would be lost.
pub(crate) fn refuse_foreign_files(dir: &Path, kind: &Kind) -> Result<(), HandoffError> {
    let entries = fs::read_dir(dir).map_err(|e| HandoffError::io(dir, "read", &e))?;
    for entry in entries {
        let entry = entry.map_err(|e| HandoffError::io(dir, "read", &e))?;
        let name = entry.file_name();
        let is_directory = entry.file_type().map_or(true, |t| t.is_dir());
        if is_directory || !kind.file_names().any(|known| *known == *name) {
            return Err(HandoffError::new(
                dir,
                format!(
                    "holds {}, which no {} has; choose another --out",
                    name.display(),
                    kind.name
                ),
            ));
        }
    }
    Ok(())
}

/// Makes the directory `dir` of what `fill` writes: first into a sibling, which then takes its place,
/// so that a killed run leaves either the old directory or the new one.
pub(crate) fn replace_directory(
    dir: &Path,
    kind: &Kind,
    fill: impl FnOnce(&Path) -> Result<(), HandoffError>,
) -> Result<(), HandoffError> {
    let dir = if dir.exists() {
        dir.canonicalize().map_err(|e| HandoffError::io(dir, "resolve", &e))?
    } else {
        dir.to_path_buf()
    };
    let parent = match dir.parent() {
        Some(p) if !p.as_os_str().is_empty() => p.to_path_buf(),
        _ => PathBuf::from("."),
    };
    fs::create_dir_all(&parent).map_err(|e| HandoffError::io(&parent, "create", &e))?;
    let sibling = create_sibling(&parent)?;
    let write = || {
        fill(&sibling)?;
        if dir.exists() {
            refuse_foreign_files(&dir, kind)?;
        }
        put_in_place(&sibling, &dir).map_err(|e| HandoffError::io(&dir, "write", &e))
    };
    let written = write();
    // What was written in vain, or after an exchange the old directory: only files of the kind,
    // so that one that appeared in it a moment ago is not lost.
    for name in kind.file_names() {
        let _ = fs::remove_file(sibling.join(name));
    }
    let _ = fs::remove_dir(&sibling);
    written
}

/// A new directory in `parent`. A run that was killed may have left one of its own behind, and
/// a container gives every run the same process id.
fn create_sibling(parent: &Path) -> Result<PathBuf, HandoffError> {
    let mut count = 0;
    loop {
        let sibling = parent.join(format!(".planish-{}-{count}.tmp", std::process::id()));
        match fs::create_dir(&sibling) {
            Ok(()) => return Ok(sibling),
            Err(e) if e.kind() == ErrorKind::AlreadyExists => count += 1,
            Err(e) => return Err(HandoffError::io(parent, "create a directory there", &e)),
        }
    }
}

/// `from` becomes `to`. Where `to` exists the two are exchanged in one step.
#[cfg(target_os = "linux")]
fn put_in_place(from: &Path, to: &Path) -> std::io::Result<()> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    if !to.exists() {
        return fs::rename(from, to);
    }
    match renameat_with(CWD, from, CWD, to, RenameFlags::EXCHANGE) {
        // A file system without the exchange.
        Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) => {
            put_in_place_by_two_renames(from, to)
        }
        result => Ok(result?),
    }
}

#[cfg(not(target_os = "linux"))]
fn put_in_place(from: &Path, to: &Path) -> std::io::Result<()> {
    if to.exists() { put_in_place_by_two_renames(from, to) } else { fs::rename(from, to) }
}

/// Between the first two renames the old directory stands under its temporary name.
fn put_in_place_by_two_renames(from: &Path, to: &Path) -> std::io::Result<()> {
    let old = from.with_extension("old");
    fs::rename(to, &old)?;
    match fs::rename(from, to) {
        Ok(()) => fs::rename(&old, from),
        Err(e) => fs::rename(&old, to).and(Err(e)),
    }
}
