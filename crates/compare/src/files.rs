//! Where the parts of a run stand, and the arrays of a directory.

use std::{
    collections::BTreeMap,
    fs,
    io::Read,
    path::{Path, PathBuf},
};

use ndarray::Ix3;
use planish_compare::{
    diff::Elements,
    dwell::{Row, Solver},
    report::{Frames, Rounds, Run, RunMethod},
    summary::{Method, Summary, VerdictOutcome, WallTimes},
};
use planish_handoff::{
    Arrays, Artifact, Failure, Stage,
    artifact::MANIFEST,
    kind::{self, Dtype, Kind},
    npy::{self, ArrayData},
};
use planish_types::{Axis, DwellTime, Grid, Invalid, Removal, Surface, ToolPath, Trajectory};
use serde::Deserialize;
use serde_json::Value;

/// The last part of the path of a run.
pub fn name_of(run: &Path) -> String {
    // A path such as `.` has no last part of its own.
    let whole = if run.file_name().is_none() { run.canonicalize().ok() } else { None };
    let whole = whole.as_deref().unwrap_or(run);
    whole.file_name().unwrap_or(run.as_os_str()).to_string_lossy().into_owned()
}

/// Reads the run number `number` (its surface, and what each method made of it), and sums it up.
pub fn read_run(
    stage: &mut Stage,
    number: usize,
    run: &Path,
    names: &Names,
) -> Result<Run, Failure> {
    let mut provenance = Provenance::default();
    let role = number.to_string();
    let desired: Surface = read_part(stage, &role, run, "surface", &mut provenance)?;
    let path: Option<ToolPath> =
        read_optional_part(stage, &role, run, "tool_path", &mut provenance)?;
    let plan: Option<DwellTime> = read_optional_part(stage, &role, run, "dwell", &mut provenance)?;
    let measured = match names.measured {
        Some(dir) => Some(stage.read("measured", dir)?),
        None => None,
    };

    let methods_dir = run.join("methods");
    let schedulers = entries(&methods_dir)?.into_iter().filter(|name| {
        // A stage that runs writes into a sibling whose name begins with a dot.
        !name.starts_with('.') && methods_dir.join(name).is_dir()
    });
    let (mut numbers, mut methods) = (Vec::new(), Vec::new());
    for scheduler in schedulers {
        let dir = methods_dir.join(&scheduler);
        let role = format!("{number}/{scheduler}");
        let (number, method) = read_method(stage, &role, &dir, &desired, plan.as_ref())?;
        numbers.push((scheduler.clone(), number));
        methods.push(RunMethod { name: scheduler, ..method });
    }
    if methods.is_empty() {
        let message = "holds no method; schedule, simulate and verify at least one";
        return Err(Failure::new(format!("{}: {message}", methods_dir.display())));
    }
    let name = name_of(run);
    let pipeline = names.pipeline.unwrap_or(&name);
    let summary = Summary::new(pipeline, names.fixture, &desired, numbers);
    Ok(Run { name, summary, desired, measured, path, methods, provenance })
}

/// What the user calls the runs.
#[derive(Clone, Copy, Debug)]
pub struct Names<'a> {
    /// Pipeline; the name of the run's directory without it.
    pub pipeline: Option<&'a str>,
    /// Mirror.
    pub fixture: &'a str,
    /// Map as it was measured [surface artifact].
    pub measured: Option<&'a Path>,
}

/// Manifests by role.
type Provenance = Vec<(String, Value)>;

/// Reads the artifact `name` in `dir` and keeps its manifest.
fn read_part<T: Artifact>(
    stage: &mut Stage,
    role: &str,
    dir: &Path,
    name: &str,
    provenance: &mut Provenance,
) -> Result<T, Failure> {
    let (value, manifest) = stage.read_with_manifest(&format!("{role}/{name}"), &dir.join(name))?;
    if let Some(manifest) = manifest {
        provenance.push((name.into(), serde_json::to_value(manifest)?));
    }
    Ok(value)
}

/// The same, where there is one.
fn read_optional_part<T: Artifact>(
    stage: &mut Stage,
    role: &str,
    dir: &Path,
    name: &str,
    provenance: &mut Provenance,
) -> Result<Option<T>, Failure> {
    let exists = dir.join(name).exists();
    exists.then(|| read_part(stage, role, dir, name, provenance)).transpose()
}

/// Reads what one method left in `dir`; its name is for the caller to fill in.
fn read_method(
    stage: &mut Stage,
    role: &str,
    dir: &Path,
    desired: &Surface,
    plan: Option<&DwellTime>,
) -> Result<(Method, RunMethod), Failure> {
    let mut provenance = Provenance::default();
    let trajectory = read_part(stage, role, dir, "trajectory", &mut provenance)?;
    let removal = read_part(stage, role, dir, "removal", &mut provenance)?;
    let manifest =
        stage.read_manifest(&format!("{role}/verdict"), &dir.join("verdict"), &kind::VERDICT)?;
    let verdict = manifest.outcome.clone();
    provenance.push(("verdict".into(), serde_json::to_value(manifest)?));
    let own_plan = read_optional_part(stage, role, dir, "dwell", &mut provenance)?;
    let frames: Option<FramesFile> =
        read_optional_part(stage, role, dir, "frames", &mut provenance)?;
    let rounds: Option<RoundsFile> =
        read_optional_part(stage, role, dir, "iterations", &mut provenance)?;
    let mut wall = |name: &str| -> Result<Option<f64>, Failure> {
        let path = dir.join(format!("{name}-wall.json"));
        if !path.exists() {
            return Ok(None);
        }
        let Wall { wall_s, .. } = stage.read_json(&format!("{role}/{name}-wall"), &path)?;
        Ok(Some(wall_s))
    };
    let wall = WallTimes { schedule_s: wall("schedule")?, simulate_s: wall("simulate")? };
    // A refined plan has dwell times of its own.
    let dwell = own_plan.or_else(|| plan.cloned());
    let of_dir = |e: Invalid| Failure::new(format!("{}: {e}", dir.display()));
    let outcome = VerdictOutcome::from_json(&verdict).map_err(of_dir)?;
    let numbers = Method::new(desired, &removal, &trajectory, dwell.as_ref(), &outcome, wall)
        .map_err(of_dir)?;
    let best = provenance.iter().find(|(role, _)| role == "iterations");
    let best = best.and_then(|(_, manifest)| manifest["outcome"]["best_round"].as_u64());
    let method = RunMethod {
        name: String::new(),
        trajectory,
        removal,
        verdict,
        dwell,
        frames: frames.map(|f| f.0),
        rounds: rounds.map(|r| Rounds { best, ..r.0 }),
        provenance,
    };
    Ok((numbers, method))
}

/// `kind::FRAMES` as an artifact.
struct FramesFile(Frames);

impl Artifact for FramesFile {
    const KIND: &'static Kind = &kind::FRAMES;

    fn to_arrays(&self) -> Vec<ArrayData> {
        unreachable!("a report does not write frames")
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let mut axis = |name| {
            let coordinates: Vec<f64> = arrays.take_f64(name).into_iter().collect();
            Axis::from_coordinates(name, &coordinates)
        };
        let grid = Grid { x: axis("x_mm")?, y: axis("y_mm")? };
        let time_s: Vec<f64> = arrays.take_f64("time_s").into_iter().collect();
        let removal_nm = arrays.take_f64("removal_nm").into_dimensionality::<Ix3>();
        let removal_nm = removal_nm.expect("the kind promises three axes");
        Ok(Self(Frames { time_s, removal_nm, grid }))
    }
}

/// `kind::ITERATIONS` as an artifact; the times of the segments are not looked at.
struct RoundsFile(Rounds);

impl Artifact for RoundsFile {
    const KIND: &'static Kind = &kind::ITERATIONS;

    fn to_arrays(&self) -> Vec<ArrayData> {
        unreachable!("a report does not write iterations")
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let mut list = |name| arrays.take_f64(name).into_iter().collect();
        let rounds =
            Rounds { rms_nm: list("rms_nm"), total_time_s: list("total_time_s"), best: None };
        Ok(Self(rounds))
    }
}

/// What a stage writes for `--wall-time`.
#[derive(Deserialize)]
struct Wall {
    wall_s: f64,
    #[serde(default)]
    peak_memory_mb: Option<f64>,
}

/// Reads a run of dwell solvers: its surface, and what each solver made of it.
pub fn read_solvers(
    stage: &mut Stage,
    run: &Path,
) -> Result<(Surface, Vec<(String, Row)>), Failure> {
    let surface: Surface = stage.read("surface", &run.join("surface"))?;
    let path: ToolPath = stage.read("tool-path", &run.join("tool_path"))?;
    let dir = run.join("solvers");
    let mut rows = Vec::new();
    for name in entries(&dir)?.into_iter().filter(|n| dir.join(n).is_dir()) {
        let row = read_solver(stage, &name, &dir.join(&name), &path)?;
        rows.push((name, row));
    }
    if rows.is_empty() {
        let message = "holds no solver; solve, schedule and simulate at least once";
        return Err(Failure::new(format!("{}: {message}", dir.display())));
    }
    Ok((surface, rows))
}

/// A solver without dwell times has left its message.
fn read_solver(stage: &mut Stage, name: &str, dir: &Path, path: &ToolPath) -> Result<Row, Failure> {
    if !dir.join("dwell").exists() {
        let file = dir.join("message.txt");
        let text = fs::read_to_string(&file).map_err(|e| {
            Failure::new(format!("{}: cannot read: {e}; and there is no dwell/", file.display()))
        })?;
        let last = text.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("no message");
        return Ok(Row::Refused { refused: last.trim_start_matches("error: ").to_string() });
    }
    let dwell: DwellTime = stage.read(&format!("{name}/dwell"), &dir.join("dwell"))?;
    let position: Removal =
        stage.read(&format!("{name}/position"), &dir.join("position/removal"))?;
    let executed: Removal =
        stage.read(&format!("{name}/executed"), &dir.join("executed/removal"))?;
    let motion: Trajectory =
        stage.read(&format!("{name}/trajectory"), &dir.join("executed/trajectory"))?;
    let mut solver = Solver::new(path, &dwell, &position, &executed, motion.total_time_s())
        .map_err(|e| Failure::new(format!("{}: {e}", dir.display())))?;
    let wall = dir.join("dwell-wall.json");
    if wall.exists() {
        let Wall { wall_s, peak_memory_mb } =
            stage.read_json(&format!("{name}/dwell-wall"), &wall)?;
        (solver.wall_s, solver.peak_memory_mb) = (Some(wall_s), peak_memory_mb);
    }
    Ok(Row::Solved(solver))
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
    Ok(match npy::read(path, dtype_of(path)?)?.array {
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
