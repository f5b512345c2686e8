//! Input files and artifacts of a command, with the hash of each.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
    time::Instant,
};

use ndarray::{Array2, Ix2};
use planish_form::{Form, FormFile, FormKind};
use planish_types::{Invalid, Machine, MachineFile, Surface, Tif, doubts};

use crate::{
    HandoffError,
    artifact::{self, Ancestor, Artifact, InputRecord, Loaded, Manifest, Seal},
    from_run::before_reading,
    kind::{Dtype, Kind, MANIFEST},
    nouns,
    npy::{self, ArrayData},
    place::{is_within, parent_of},
    shell::warn,
};

/// Largest JSON file that is read, bytes: a machine, a recipe, or the file beside a program.
/// Larger: a damaged file takes more memory and time. Smaller: long files beside a program are
/// refused.
pub(crate) const LARGEST_JSON_BYTES: u64 = 1 << 24;

/// Inputs of a command. Every reader checks its input, and records the path and the BLAKE3 hash.
/// The manifest of the output lists these records, and they decide whether an output is up to date.
///
/// A role is the name of the flag that gives the input, without its dashes.
#[derive(Debug)]
pub struct Inputs {
    pub(crate) records: Vec<InputRecord>,
    /// Paths of the inputs, in the order of the records and as the user gave them. They keep a name that is not
    /// UTF-8, which the text of a record cannot.
    paths: Vec<PathBuf>,
    pub(crate) lineage: BTreeSet<Ancestor>,
    /// Time at which the command started. The wall time includes reading.
    pub(crate) started: Instant,
}

/// The form of a part (its shape along z), as the user gave it.
#[derive(Clone, Debug)]
pub struct GivenForm {
    /// Form, ready for calculations.
    pub form: Form,
    /// Content of the form file; `None` if the form is a map that was given as a directory.
    pub file: Option<StatedForm>,
}

/// Content of a form file, and the map that it names.
#[derive(Clone, Debug)]
pub struct StatedForm {
    /// The file.
    pub file: FormFile,
    /// Map to which a form of the kind `map` refers; `None` for other kinds.
    pub map: Option<Surface>,
}

impl Default for Inputs {
    fn default() -> Self {
        Self::new()
    }
}

impl Inputs {
    /// Creates an empty list of inputs; the readers add to it.
    pub fn new() -> Self {
        Self {
            records: Vec::new(),
            paths: Vec::new(),
            lineage: BTreeSet::new(),
            started: Instant::now(),
        }
    }

    /// Reads an input artifact given by the flag `--role`.
    ///
    /// # Errors
    /// Fails if the artifact cannot be read or is not valid.
    pub fn read<T: Artifact>(&mut self, role: &str, dir: &Path) -> Result<T, HandoffError> {
        Ok(self.read_with_manifest(role, dir)?.0)
    }

    /// Reads an input artifact as [`Self::read`] does, and returns its manifest as well; `None` if it has none.
    ///
    /// # Errors
    /// Fails if the artifact cannot be read or is not valid.
    pub fn read_with_manifest<T: Artifact>(
        &mut self,
        role: &str,
        dir: &Path,
    ) -> Result<(T, Option<Manifest>), HandoffError> {
        before_reading(dir);
        Ok(self.recorded(role, dir, T::KIND, artifact::read::<T>(dir)?))
    }

    /// Records an artifact that was read, prints its warning, and returns its value and its manifest.
    fn recorded<T>(
        &mut self,
        role: &str,
        dir: &Path,
        kind: &Kind,
        loaded: Loaded<T>,
    ) -> (T, Option<Manifest>) {
        if let Some(warning) = &loaded.warning {
            warn(warning);
        }
        self.lineage.extend(loaded.manifest.iter().flat_map(|m| m.lineage.clone()));
        self.record(role, dir, kind.name, loaded.digest);
        (loaded.value, loaded.manifest)
    }

    /// Reads a tool: a TIF that is the same everywhere, or a tool that varies over the part. The manifest says which
    /// it is. Without a manifest, a directory with the array of weights holds a tool that varies.
    ///
    /// # Errors
    /// Fails if the artifact cannot be read or is not valid.
    pub fn read_tool(&mut self, role: &str, dir: &Path) -> Result<Tif, HandoffError> {
        Ok(self.read_tool_with_manifest(role, dir)?.0)
    }

    /// Reads a tool as [`Self::read_tool`] does. It warns of doubtful samples if the arrays have no manifest, because
    /// no program has checked them before.
    ///
    /// # Errors
    /// Fails if the artifact cannot be read or is not valid.
    pub fn read_tool_with_doubt(&mut self, role: &str, dir: &Path) -> Result<Tif, HandoffError> {
        let (tif, manifest) = self.read_tool_with_manifest(role, dir)?;
        if let (None, Some(doubt)) = (manifest, doubts::of_tif(&tif)) {
            warn(format!("{}: {doubt}", dir.display()));
        }
        Ok(tif)
    }

    /// Reads a tool as [`Self::read_tool`] does, and returns its manifest as well; `None` if it has none.
    fn read_tool_with_manifest(
        &mut self,
        role: &str,
        dir: &Path,
    ) -> Result<(Tif, Option<Manifest>), HandoffError> {
        before_reading(dir);
        let (kind, loaded) = nouns::read_tool(dir)?;
        Ok(self.recorded(role, dir, kind, loaded))
    }

    /// Returns the BLAKE3 hash of the content of the input `role`; `None` if no such input was read.
    pub fn digest(&self, role: &str) -> Option<&str> {
        self.records.iter().find(|input| input.role == role).map(|input| input.blake3.as_str())
    }

    /// Reads the manifest of an artifact, for a command that uses the numbers of its outcome.
    ///
    /// # Errors
    /// Fails if the manifest is missing, unreadable, of another kind or of a newer version. It also fails if the
    /// manifest has no seal (hash of its text), or was changed after it was sealed.
    pub fn read_manifest(
        &mut self,
        role: &str,
        dir: &Path,
        kind: &Kind,
    ) -> Result<Manifest, HandoffError> {
        before_reading(dir);
        let (manifest, seal) = artifact::read_sealed_manifest(dir, kind)?.ok_or_else(|| {
            HandoffError::new(dir, format!("has no {MANIFEST}; give a {} directory", kind.name))
        })?;
        // Only the seal guarantees that the outcome is the one that the stage wrote.
        if seal != Seal::Whole {
            let problem = "has no seal: an older Planish wrote it; make it again";
            return Err(HandoffError::new(&dir.join(MANIFEST), problem));
        }
        let digest = manifest.content().expect("the kind was checked");
        self.lineage.extend(manifest.lineage.iter().cloned());
        self.record(role, dir, kind.name, digest);
        Ok(manifest)
    }

    /// Reads and parses a JSON file given by the flag `--role`.
    ///
    /// # Errors
    /// Fails if the file cannot be read, is larger than 16 MiB, or is not of this type.
    pub fn read_json<T: serde::de::DeserializeOwned>(
        &mut self,
        role: &str,
        path: &Path,
    ) -> Result<T, HandoffError> {
        before_reading(path);
        let bytes = artifact::read_file(path, LARGEST_JSON_BYTES)?;
        self.record(role, path, "file", blake3::hash(&bytes).to_string());
        serde_json::from_slice(&bytes).map_err(|e| HandoffError::new(path, format!("{e}")))
    }

    /// Reads a file of another program, given by the flag `--role`, of at most `most` bytes.
    ///
    /// # Errors
    /// Fails if the file cannot be read, or is larger than that.
    pub fn read_bytes(
        &mut self,
        role: &str,
        path: &Path,
        most: u64,
    ) -> Result<Vec<u8>, HandoffError> {
        before_reading(path);
        let bytes = artifact::read_file(path, most)?;
        self.record(role, path, "file", blake3::hash(&bytes).to_string());
        Ok(bytes)
    }

    /// Records the hash of a file, given by the flag `--role`, that the command itself reads piece by piece.
    ///
    /// # Errors
    /// Fails if it cannot be read.
    pub fn record_file(&mut self, role: &str, path: &Path) -> Result<(), HandoffError> {
        before_reading(path);
        let io = |e| HandoffError::io(path, "read", &e);
        if !fs::metadata(path).map_err(io)?.is_file() {
            return Err(HandoffError::new(path, "is not a file; give a regular file"));
        }
        let digest = npy::hash(path).map_err(io)?;
        self.record(role, path, "file", digest);
        Ok(())
    }

    /// Reads and checks the machine file given by the flag `--machine`.
    ///
    /// # Errors
    /// Fails if the file cannot be read or describes no machine.
    pub fn read_machine(&mut self, path: &Path) -> Result<Machine, HandoffError> {
        let file: MachineFile = self.read_json("machine", path)?;
        Machine::new(file).map_err(|e| HandoffError::new(path, e.to_string()))
    }

    /// Reads the form of a part given by the flag `--role`: a form file, or the directory of a map of its height
    /// along z.
    ///
    /// # Errors
    /// Fails if the file or the map cannot be read, or describes no form.
    pub fn read_form(&mut self, role: &str, path: &Path) -> Result<GivenForm, HandoffError> {
        before_reading(path);
        let failure = |e: Invalid| HandoffError::new(path, e.to_string());
        if path.is_dir() {
            let map: Surface = self.read(role, path)?;
            let form = Form::sampled(&map).map_err(failure)?;
            return Ok(GivenForm { form, file: None });
        }
        let file: FormFile = self.read_json(role, path)?;
        let map: Option<Surface> = match &file.surface {
            Some(dir) if file.kind == FormKind::Map => {
                Some(self.read(&format!("{role}-map"), &parent_of(path).join(dir))?)
            }
            _ => None,
        };
        let form = Form::new(&file, map.as_ref()).map_err(failure)?;
        Ok(GivenForm { form, file: Some(StatedForm { file, map }) })
    }

    /// Reads one float map (shape ny, nx) from a `.npy` file given by the flag `--role`; NaN marks an invalid pixel.
    ///
    /// # Errors
    /// Fails if the file cannot be read as floats, or has another number of axes.
    pub fn read_map(&mut self, role: &str, path: &Path) -> Result<Array2<f64>, HandoffError> {
        let ArrayData::F64(a) = self.read_array(role, path, Dtype::F64)? else {
            unreachable!("read as F64")
        };
        a.into_owned().into_dimensionality::<Ix2>().map_err(|_| {
            HandoffError::new(path, "is not a map; give an array with two axes (ny, nx)")
        })
    }

    /// Reads one mask (shape ny, nx) from a `.npy` file given by the flag `--role`; 0 becomes false, 1 to 255 true.
    ///
    /// # Errors
    /// Fails if the file cannot be read, or holds other values than whole numbers from 0 to 255, or another number of
    /// axes.
    pub fn read_mask(&mut self, role: &str, path: &Path) -> Result<Array2<bool>, HandoffError> {
        let ArrayData::U8(a) = self.read_array(role, path, Dtype::U8)? else {
            unreachable!("read as U8")
        };
        a.into_owned().into_dimensionality::<Ix2>().map(|a| a.mapv(|v| v != 0)).map_err(|_| {
            HandoffError::new(path, "is not a mask; give an array with two axes (ny, nx)")
        })
    }

    fn read_array(
        &mut self,
        role: &str,
        path: &Path,
        dtype: Dtype,
    ) -> Result<ArrayData<'static>, HandoffError> {
        before_reading(path);
        let loaded = npy::read(path, dtype)?;
        if let Some(note) = loaded.note {
            warn(format!("{}: {note}", path.display()));
        }
        self.record(role, path, "file", loaded.blake3);
        Ok(loaded.array)
    }

    fn record(&mut self, role: &str, path: &Path, kind: &str, blake3: String) {
        let kind_or_role = if kind == "file" { role } else { kind };
        self.lineage.insert(Ancestor { kind: kind_or_role.into(), blake3: blake3.clone() });
        self.paths.push(path.into());
        self.records.push(InputRecord {
            role: role.into(),
            path: path.display().to_string(),
            kind: kind.into(),
            blake3,
        });
    }

    /// Refuses inputs that do not belong together: the manifest `made` of the input `role` says that it was made from
    /// another artifact than the input `from`. It accepts arrays without a manifest, and a manifest whose origins name
    /// no artifact of the kind of `from`.
    pub fn refuse_unrelated(
        &self,
        role: &str,
        made: Option<&Manifest>,
        from: &str,
    ) -> Result<(), HandoffError> {
        let Some(problem) = self.unrelated(role, made, from) else { return Ok(()) };
        let dir = self.records.iter().find(|i| i.role == role).map_or("", |i| &i.path);
        Err(HandoffError::new(
            Path::new(dir),
            format!(
                "{problem}; give the one it was made from, make it again, or remove its {MANIFEST} \
                 to use its arrays all the same"
            ),
        ))
    }

    /// Prints a warning in the cases in which [`Self::refuse_unrelated`] refuses. It is for combinations that can
    /// make sense, such as a plan on another map.
    pub fn warn_unrelated(&self, role: &str, made: Option<&Manifest>, from: &str) {
        if let Some(problem) = self.unrelated(role, made, from) {
            warn(problem);
        }
    }

    fn unrelated(&self, role: &str, made: Option<&Manifest>, from: &str) -> Option<String> {
        let from = self.records.iter().find(|i| i.role == from)?;
        let mut known = made?.lineage.iter().filter(|a| a.kind == from.kind).peekable();
        known.peek()?;
        if known.any(|a| a.blake3 == from.blake3) {
            return None;
        }
        let InputRecord { kind, role: flag, path, .. } = from;
        Some(format!("--{role} was made from another {kind} than --{flag} {path}"))
    }

    /// Returns a sentence if the motion with the manifest `made` was made for another machine file than the one that
    /// was read. It is `None` if the machines are the same, if no machine was read, or if the motion has no manifest or
    /// names no machine.
    pub fn made_for_another_machine(&self, made: Option<&Manifest>) -> Option<String> {
        let is_machine = |i: &&InputRecord| i.role == "machine";
        let here = self.records.iter().find(is_machine)?;
        let made = made?;
        let ancestors = made.lineage.iter().filter(|a| a.kind == "machine").map(|a| &a.blake3);
        // If the stage that wrote the motion read a machine, that machine counts. A stage that only
        // transformed the motion read none; then the machines of its lineage count.
        let known: Vec<&String> = match made.inputs.iter().find(is_machine) {
            Some(direct) => vec![&direct.blake3],
            None => ancestors.collect(),
        };
        let first = known.first()?;
        if known.contains(&&here.blake3) {
            return None;
        }
        Some(format!(
            "was made for another machine file (BLAKE3 {}...) than --machine {} ({}...)",
            &first[..first.len().min(8)],
            here.path,
            &here.blake3[..8]
        ))
    }

    /// Refuses an output at `path` that is an input, contains one, or lies in one. `flag` gives the output.
    pub(crate) fn refuse_overlap(&self, flag: &str, path: &Path) -> Result<(), HandoffError> {
        for (input, place) in self.records.iter().zip(&self.paths) {
            let how = match (is_within(path, place), is_within(place, path)) {
                (true, true) => "is",
                (true, false) => "lies in",
                (false, true) => "contains",
                (false, false) => continue,
            };
            let problem = format!("{how} the input --{}; choose another {flag}", input.role);
            return Err(HandoffError::new(path, problem));
        }
        Ok(())
    }
}

/// Returns true if two paths lead to the same file or directory; false if one of them does not exist.
pub(crate) fn is_same(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}
