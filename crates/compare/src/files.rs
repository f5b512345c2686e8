//! Where the parts of a run stand, and the arrays of a directory.

use std::{
    collections::BTreeMap,
    fs,
    io::Read,
    path::{Path, PathBuf},
};

use planish_compare::{
    diff::Elements,
    summary::{Method, VerdictOutcome, WallTimes},
};
use planish_handoff::{
    Failure, Stage,
    artifact::MANIFEST,
    kind::{self, Dtype},
    npy::{self, ArrayData},
};
use planish_types::{DwellTime, Surface};
use serde::Deserialize;
use serde_json::Value;

/// The last part of the path of a run.
pub fn name_of(run: &Path) -> String {
    // A path such as `.` has no last part of its own.
    let whole = if run.file_name().is_none() { run.canonicalize().ok() } else { None };
    let whole = whole.as_deref().unwrap_or(run);
    whole.file_name().unwrap_or(run.as_os_str()).to_string_lossy().into_owned()
}

/// Reads the run number `number`: its surface, and what each method made of it.
pub fn read_run(
    stage: &mut Stage,
    number: usize,
    run: &Path,
) -> Result<(Surface, Vec<(String, Method)>), Failure> {
    let surface: Surface = stage.read(&format!("{number}/surface"), &run.join("surface"))?;
    let methods_dir = run.join("methods");
    let schedulers = entries(&methods_dir)?.into_iter().filter(|name| {
        // A stage that runs writes into a sibling whose name begins with a dot.
        !name.starts_with('.') && methods_dir.join(name).is_dir()
    });
    let mut methods = Vec::new();
    for scheduler in schedulers {
        let dir = methods_dir.join(&scheduler);
        // A refined plan has dwell times of its own.
        let dwell = [dir.join("dwell"), run.join("dwell")].into_iter().find(|d| d.exists());
        let role = format!("{number}/{scheduler}");
        let method = read_method(stage, &role, &dir, dwell.as_deref(), &surface)?;
        methods.push((scheduler, method));
    }
    if methods.is_empty() {
        let message = "holds no method; schedule, simulate and verify at least one";
        return Err(Failure::new(format!("{}: {message}", methods_dir.display())));
    }
    Ok((surface, methods))
}

fn read_method(
    stage: &mut Stage,
    role: &str,
    dir: &Path,
    dwell: Option<&Path>,
    surface: &Surface,
) -> Result<Method, Failure> {
    let dwell: Option<DwellTime> =
        dwell.map(|d| stage.read(&format!("{role}/dwell"), d)).transpose()?;
    let trajectory = stage.read(&format!("{role}/trajectory"), &dir.join("trajectory"))?;
    let removal = stage.read(&format!("{role}/removal"), &dir.join("removal"))?;
    let outcome =
        stage.read_outcome(&format!("{role}/verdict"), &dir.join("verdict"), &kind::VERDICT)?;
    let mut wall = |name: &str| -> Result<Option<f64>, Failure> {
        let path = dir.join(format!("{name}-wall.json"));
        if !path.exists() {
            return Ok(None);
        }
        let Wall { wall_s } = stage.read_json(&format!("{role}/{name}-wall"), &path)?;
        Ok(Some(wall_s))
    };
    let wall = WallTimes { schedule_s: wall("schedule")?, simulate_s: wall("simulate")? };
    VerdictOutcome::from_json(&outcome)
        .and_then(|verdict| {
            Method::new(surface, &removal, &trajectory, dwell.as_ref(), &verdict, wall)
        })
        .map_err(|e| Failure::new(format!("{}: {e}", dir.display())))
}

/// What a stage writes for `--wall-time`.
#[derive(Deserialize)]
struct Wall {
    wall_s: f64,
}

/// The arrays of two directories, by name; refuses unlike kinds and unlike sets of arrays.
pub fn read_pair(a: &Path, b: &Path) -> Result<BTreeMap<String, [Elements; 2]>, Failure> {
    if let (Some(x), Some(y)) = (kind_of(a)?, kind_of(b)?)
        && x != y
    {
        let message = format!("{} holds a {x}, {} a {y}", a.display(), b.display());
        return Err(Failure::new(format!("{message}; give two artifacts of the same kind")));
    }
    let (in_a, in_b) = (arrays_of(a)?, arrays_of(b)?);
    if in_a != in_b {
        return Err(Failure::new(format!(
            "{} holds the arrays {in_a:?}, {} {in_b:?}; give two directories with the same arrays",
            a.display(),
            b.display()
        )));
    }
    let pair = |name: String| -> Result<_, Failure> {
        let elements = [read_elements(&a.join(&name))?, read_elements(&b.join(&name))?];
        Ok((name, elements))
    };
    in_a.into_iter().map(pair).collect()
}

/// The kind that the manifest names; `None` without a manifest.
fn kind_of(dir: &Path) -> Result<Option<String>, Failure> {
    let path = dir.join(MANIFEST);
    if !path.exists() {
        return Ok(None);
    }
    let broken = |e: String| Failure::new(format!("{}: is not a manifest ({e})", path.display()));
    let text = fs::read_to_string(&path).map_err(|e| broken(e.to_string()))?;
    let manifest: Value = serde_json::from_str(&text).map_err(|e| broken(e.to_string()))?;
    Ok(manifest["kind"].as_str().map(String::from))
}

/// Names of the `.npy` files in `dir`, at least one.
fn arrays_of(dir: &Path) -> Result<Vec<String>, Failure> {
    let mut names = entries(dir)?;
    names.retain(|name| name.ends_with(".npy"));
    if names.is_empty() {
        let message = "holds no .npy file; diff compares arrays";
        return Err(Failure::new(format!("{}: {message}", dir.display())));
    }
    Ok(names)
}

/// Names in `dir`, sorted.
fn entries(dir: &Path) -> Result<Vec<String>, Failure> {
    let unreadable =
        |e: std::io::Error| Failure::new(format!("{}: cannot read: {e}", dir.display()));
    let name = |entry: Result<fs::DirEntry, std::io::Error>| {
        entry.map(|e| e.file_name().to_string_lossy().into_owned())
    };
    let names: Result<Vec<String>, _> = fs::read_dir(dir).map_err(unreadable)?.map(name).collect();
    let mut names = names.map_err(unreadable)?;
    names.sort();
    Ok(names)
}

fn read_elements(path: &PathBuf) -> Result<Elements, Failure> {
    Ok(match npy::read(path, dtype_of(path)?)?.0 {
        ArrayData::F64(a) => Elements::Float(a),
        ArrayData::I64(a) => Elements::Integer(a),
        ArrayData::U8(a) => Elements::Integer(a.mapv(i64::from)),
    })
}

/// The element type that the header names; floats where it is none that artifacts have, for
/// [`npy::read`] to say so.
fn dtype_of(path: &PathBuf) -> Result<Dtype, Failure> {
    let unreadable =
        |e: std::io::Error| Failure::new(format!("{}: cannot read: {e}", path.display()));
    let mut header = Vec::new();
    let file = fs::File::open(path).map_err(unreadable)?;
    file.take(128).read_to_end(&mut header).map_err(unreadable)?;
    let header = String::from_utf8_lossy(&header);
    let names = |dtype: &str| header.contains(&format!("'{dtype}'"));
    Ok(if names("<i8") {
        Dtype::I64
    } else if names("|u1") || names("|b1") {
        Dtype::U8
    } else {
        Dtype::F64
    })
}
