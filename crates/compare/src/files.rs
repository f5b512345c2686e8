//! Reading of runs: the directories of their artifacts, and the arrays in a directory. The role of an input is the name
//! under which the report records it, such as `0/surface` for the surface of the first run.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    io::Read,
    path::{Path, PathBuf},
};

use ndarray::Ix3;
use planish_compare::{
    chain::{self, Chain, MethodRecords, Record, Recorded, RunRecords, Standing},
    diff::Elements,
    dwell::{Solver, SolverRow},
    error_budget::ErrorBudget,
    made::{Made, Shown},
    on_axes::{OnAxes, check_names},
    places::Division,
    plan::PlanStatus,
    report::{Frames, Rounds, RunData, RunMethod, on_axes, tool},
    specification::Around,
    summary::{LeftOut, MethodFacts, MethodResult, Summary, WallTimes},
    tool_numbers::ToolNumbers,
};
use planish_form::Form;
use planish_handoff::{
    Arrays, Artifact, Failure, Inputs,
    artifact::{Manifest, ManifestHead},
    kind::{self, Dtype, Kind, MANIFEST},
    npy::{self, ArrayData},
};
use planish_types::{
    AxesMotion, Axis, DwellTime, Grid, Invalid, Removal, Surface, ToolPath, Trajectory,
    outcome::{
        StageEnd, WallTime,
        axes::MotionReport,
        bound::PathFreeBounds,
        plan::PlanOutcome,
        removal::ServoOutcome,
        specification::{SpecificationOutcome, SpecificationReport},
        tolerance::ToleranceArrays,
        verdict::{AxesVerdict, Verdict},
    },
    reach::Reach,
};
use rayon::prelude::*;

/// Returns the name of a run: the last component of the path of its directory. A path without one, such as `..`, is
/// made absolute first.
pub fn name_of(run: &Path) -> String {
    // A path such as `.` has no last component of its own.
    let whole = if run.file_name().is_none() { run.canonicalize().ok() } else { None };
    let whole = whole.as_deref().unwrap_or(run);
    whole.file_name().unwrap_or(run.as_os_str()).to_string_lossy().into_owned()
}

/// Reads the results of all methods of the run in the directory `run`. `number` distinguishes the runs in the roles
/// of inputs; with `after_servo` a method also needs its prediction after the servo.
///
/// Returns the methods, and those that are left out: refused, incomplete, or with parts that do not belong together.
/// Fails if no method remains.
fn read_methods(
    inputs: &mut Inputs,
    number: usize,
    run: &Path,
    after_servo: bool,
) -> Result<(Vec<MethodFiles>, Vec<LeftOut>), Failure> {
    let methods_dir = run.join("methods");
    if !methods_dir.exists() && run.join("tools").is_dir() && run.join("rack.json").is_file() {
        return Err(Failure::new(format!(
            "{}: is a run of several tools, whose page is {}; planish compare several makes it again",
            run.display(),
            run.join("report").join("report.html").display()
        )));
    }
    let schedulers = entries(&methods_dir)?.into_iter().filter(|name| {
        // A stage that runs writes into a sibling whose name begins with a dot.
        !name.starts_with('.') && methods_dir.join(name).is_dir()
    });
    let mut read = Vec::new();
    let mut refused = Vec::new();
    for scheduler in schedulers {
        let dir = methods_dir.join(&scheduler);
        if !dir.join("trajectory").exists() && dir.join(MESSAGE).is_file() {
            let reasons = vec![message_in(&dir)?];
            refused.push(LeftOut { name: scheduler, standing: Standing::Refused, reasons });
            continue;
        }
        let role = format!("{number}/{scheduler}");
        let reasons = match lacking(&dir, after_servo) {
            Some(problem) => vec![problem],
            None => {
                let (files, stale) = read_method(inputs, &role, &scheduler, dir, after_servo)?;
                if stale.is_empty() {
                    read.push(files);
                    continue;
                }
                stale
            }
        };
        refused.push(LeftOut { name: scheduler, standing: Standing::OutOfDate, reasons });
    }
    if read.is_empty() {
        let left: Vec<String> =
            refused.iter().map(|m| format!("{}: {}", m.name, m.reasons.join("; "))).collect();
        let left = if left.is_empty() { String::new() } else { format!(" ({})", left.join("; ")) };
        let message = "holds no method; schedule, simulate and verify at least one";
        return Err(Failure::new(format!("{}: {message}{left}", methods_dir.display())));
    }
    Ok((read, refused))
}

/// Returns a sentence on the artifacts that the method in `dir` lacks because a run was ended before it made them.
/// `None` if all are there. With `after_servo` the prediction after the servo is needed, too.
fn lacking(dir: &Path, after_servo: bool) -> Option<String> {
    let mut needed = vec!["trajectory", "removal", "verdict"];
    if after_servo {
        needed.push(AFTER_SERVO);
    }
    let mut places: Vec<PathBuf> = needed.iter().map(PathBuf::from).collect();
    if dir.join(ON_AXES).exists() {
        places.extend(
            ["axes", "trajectory", "removal", "verdict"].map(|part| Path::new(ON_AXES).join(part)),
        );
    }
    let lacking: Vec<String> = places
        .iter()
        .filter(|place| !dir.join(place).exists())
        .map(|place| place.display().to_string())
        .collect();
    if lacking.is_empty() {
        return None;
    }
    Some(format!("it has no {}; run the stages again that make it", lacking.join(" and no ")))
}

/// Name of the file with the message of a stage, in place of the artifact that it refused to make.
const MESSAGE: &str = "message.txt";

/// Returns the reason for which a stage refused to make something, from its message file in `dir`: its last line that
/// begins with `error: `, without that prefix; otherwise its last line that is not blank.
fn message_in(dir: &Path) -> Result<String, Failure> {
    let file = dir.join(MESSAGE);
    let text = read_text(&file)
        .map_err(|e| Failure::new(format!("{}: cannot read: {e}", file.display())))?;
    // What a command line does not take has a hint below its error.
    let mut lines = text.lines().rev().filter(|l| !l.trim().is_empty());
    let reason = lines.clone().find_map(|l| l.strip_prefix("error: ")).or(lines.next());
    Ok(reason.unwrap_or("no message").to_string())
}

/// A method whose artifacts belong together, with its verdict by the specification (`None` without one) and remarks
/// on it.
type Valid = (MethodFiles, Option<SpecificationReport>, Vec<String>);

/// Splits the methods into those whose artifacts belong together, and those that are left out with reasons. `read`,
/// `chains` and `judged` have one element per method: its files, the check of its artifacts, and its verdict by the
/// specification.
fn divided(
    read: Vec<MethodFiles>,
    chains: Vec<Chain>,
    judged: Vec<Option<SpecificationReport>>,
) -> (Vec<Valid>, Vec<LeftOut>) {
    let mut valid = Vec::new();
    let mut left_out = Vec::new();
    for ((files, chain), judged) in read.into_iter().zip(chains).zip(judged) {
        let Chain { standing, reasons, remarks } = chain;
        match standing {
            Standing::Valid => valid.push((files, judged, remarks)),
            _ => left_out.push(LeftOut { name: files.name, standing, reasons }),
        }
    }
    (valid, left_out)
}

/// Reads and summarises a run: its surface, and the results of each method. `number` distinguishes the runs in the
/// roles of inputs. `names` are the names and files of the command line.
///
/// # Errors
/// Fails if an artifact cannot be read, if the run holds no method, or if artifacts that belong together by their
/// records contradict each other.
pub(crate) fn read_run(
    inputs: &mut Inputs,
    number: usize,
    run: &Path,
    names: &Names,
) -> Result<RunData, Failure> {
    let mut provenance = Provenance::default();
    let role = number.to_string();
    let desired: Known<Surface> = read_artifact(inputs, &role, run, "surface", &mut provenance)?;
    let path: Option<Known<ToolPath>> =
        read_optional_artifact(inputs, &role, run, "tool_path", &mut provenance)?;
    let plan: Option<Known<DwellTime>> =
        read_optional_artifact(inputs, &role, run, "dwell", &mut provenance)?;
    let measured = names.measured.map(|dir| inputs.read("measured", dir)).transpose()?;
    let tif_role = format!("{role}/tif");
    let tif = names.tif.map(|dir| inputs.read_tool(&tif_role, dir)).transpose()?;
    let digest = inputs.digest(&tif_role).unwrap_or_default().to_string();
    let reach = tif.as_ref().and_then(|tif| Some((Reach::new(&desired.value, &[tif])?, digest)));
    let form_role = format!("{role}/form");
    let form = names.form.map(|path| inputs.read_form(&form_role, path)).transpose()?;
    let form = form.map(|read| read.form);
    let division = Division::new(&desired.value, tif.as_ref());
    let mut judge = Judge { inputs, role: &role, specification: None, remarks: vec![] };
    let around = Around {
        before: judge.read("before", run, Some(("surface", &desired.recorded.digest)))?,
        after: judge.read("after", run, None)?,
    };
    let Judge { specification, remarks: judge_remarks, .. } = judge;
    let records = RunRecords {
        surface: desired.recorded,
        tool_path: path.as_ref().map(|p| p.recorded.clone()),
        dwell: plan.as_ref().map(|p| p.recorded.clone()),
    };

    let (read, refused) = read_methods(inputs, number, run, names.after_servo)?;
    let mut judge = Judge { inputs, role: &role, specification, remarks: judge_remarks };
    let judged = judge.read_all(&read, run)?;
    let judge_remarks = judge.remarks;
    let method_records: Vec<MethodRecords> = read.iter().map(|m| m.records.clone()).collect();
    let method_names: Vec<String> = read.iter().map(|m| m.name.clone()).collect();
    let chains = chain::check(&records, &method_records);
    let run_plan = plan.as_ref().map(|p| &p.value);
    let planned = planned_dwell(&read, run_plan);
    let shared = Shared {
        desired: &desired.value,
        planned: &planned,
        plan_manifest: manifest_of(&provenance, "dwell"),
        plan_is_for_another: records
            .dwell
            .as_ref()
            .map_or(vec![], |dwell| chain::solved_for_another(&records, dwell)),
        reach: reach.as_ref(),
        division: &division,
        form: form.as_ref(),
    };
    let (valid, mut left_out) = divided(read, chains, judged);
    left_out.extend(refused);
    let (numbers, methods) = shared.methods(valid)?;
    let (process, process_remark) =
        read_process(inputs, &role, run, &method_records, &method_names)?;
    let (bound, bound_remark) = read_bound(inputs, &role, run, &records.surface)?;
    let name = name_of(run);
    let pipeline = names.pipeline.unwrap_or(&name);
    let mut remarks = chain::check_run(&records);
    remarks.extend(judge_remarks.into_iter().chain(process_remark).chain(bound_remark));
    let surface = &desired.value;
    let mut summary =
        Summary::new(pipeline, names.fixture, surface, &division, numbers, left_out, remarks).with(
            surface,
            reach.as_ref().map(|(reach, _)| reach),
            around,
        );
    summary.error_budget = process;
    summary.bound = bound;
    let path = path.map(|p| p.value);
    summary.tool = tif.as_ref().and_then(ToolNumbers::new);
    let tool = tif.as_ref().map_or(vec![], |tif| tool::pictures(tif, &desired.value, ""));
    Ok(RunData { name, summary, desired: desired.value, measured, path, tool, methods, provenance })
}

/// Returns the dwell times that each method has planned, by its name; a method without a plan is absent. `run_plan` has
/// the dwell times that the methods of the run share.
fn planned_dwell(
    methods: &[MethodFiles],
    run_plan: Option<&DwellTime>,
) -> BTreeMap<String, DwellTime> {
    let mut planned = BTreeMap::new();
    for files in methods {
        if let Some(dwell) = files.dwell(methods, run_plan) {
            planned.insert(files.name.clone(), dwell.clone());
        }
    }
    planned
}

/// Names and files that the command line gives for the runs.
#[derive(Clone, Copy, Debug)]
pub struct Names<'a> {
    /// Name of the pipeline; `None` for the name of the run's directory.
    pub pipeline: Option<&'a str>,
    /// Name of the mirror; may be empty.
    pub fixture: &'a str,
    /// Directory of the map as it was measured, before anything was done to it [surface artifact]; `None` if it is not
    /// given.
    pub measured: Option<&'a Path>,
    /// Directory of the tool [tif artifact]; `None` if it is not given.
    pub tif: Option<&'a Path>,
    /// Form of the part: a form file, or the directory of its height along z; `None` if it is not given.
    pub form: Option<&'a Path>,
    /// True if the plans are compared by their predictions after the servo of the machine.
    pub after_servo: bool,
}

/// Reader of the verdicts of `planish surface spec` on the maps of a run. All verdicts must be by one specification,
/// and each about the map that is there now.
struct Judge<'a> {
    inputs: &'a mut Inputs,
    role: &'a str,
    /// BLAKE3 hash of the specification of the first verdict; `None` before it is read.
    specification: Option<String>,
    remarks: Vec<String>,
}

impl Judge<'_> {
    /// Reads the verdicts on the residuals of the methods, in their order; `None` for a method without a verdict.
    fn read_all(
        &mut self,
        methods: &[MethodFiles],
        run: &Path,
    ) -> Result<Vec<Option<SpecificationReport>>, Failure> {
        let mut verdicts = Vec::with_capacity(methods.len());
        for files in methods {
            let removal = ("removal", files.records.removal.digest.as_str());
            verdicts.push(self.read(&files.name, run, Some(removal))?);
        }
        Ok(verdicts)
    }

    /// Reads the verdict in `run`/specified/`name`/specification. `judged` is the role and the hash of the artifact
    /// that it must be about; `None` accepts any map.
    ///
    /// Returns `None` if there is no verdict. It also returns `None`, and adds a remark, if the verdict is about
    /// another map, or by another specification than the first one.
    fn read(
        &mut self,
        name: &str,
        run: &Path,
        judged: Option<(&str, &str)>,
    ) -> Result<Option<SpecificationReport>, Failure> {
        let dir = run.join("specified").join(name).join("specification");
        if !dir.exists() {
            return Ok(None);
        }
        let role = format!("{}/{name}/specification", self.role);
        let manifest = self.inputs.read_manifest(&role, &dir, &kind::SPECIFICATION)?;
        let outcome: SpecificationOutcome = manifest.read_outcome(&dir, "judge it again")?;
        let Some(mut report) = outcome.specification else {
            return Ok(None);
        };
        // The report tells values and limits; the part of the noise stands in the artifact.
        report.limits.iter_mut().for_each(|limit| limit.noise = None);
        let record = record_of(&manifest);
        if judged.is_some_and(|(role, digest)| record.input(role) != Some(digest)) {
            let remark =
                format!("{name}: its specification was judged on another map; judge it again");
            self.remarks.push(remark);
            return Ok(None);
        }
        let by = record.input("specification").unwrap_or_default().to_string();
        if *self.specification.get_or_insert_with(|| by.clone()) != by {
            let remark = format!("{name}: it was judged by another specification; judge it again");
            self.remarks.push(remark);
            return Ok(None);
        }
        Ok(Some(report))
    }
}

/// Reads the result of `planish tolerance` in `run`/tolerance for the motion of one of the methods. If no method has
/// that motion now, it returns a remark instead; both are `None` if there is no such directory. `role` is the prefix of
/// its role as an input; `records` and `names` are those of the methods.
fn read_process(
    inputs: &mut Inputs,
    role: &str,
    run: &Path,
    records: &[MethodRecords],
    names: &[String],
) -> Result<(Option<ErrorBudget>, Option<String>), Failure> {
    let dir = run.join("tolerance");
    if !dir.exists() {
        return Ok((None, None));
    }
    let (arrays, manifest): (ToleranceArrays, _) =
        inputs.read_with_manifest(&format!("{role}/tolerance"), &dir)?;
    let method = manifest.as_ref().map(record_of).and_then(|record| {
        records.iter().position(|r| record.input("trajectory") == Some(&r.trajectory.digest))
    });
    let (Some(manifest), Some(method)) = (manifest, method) else {
        let remark = "tolerance: it is of a motion that no method of the run has now; run planish tolerance again";
        return Ok((None, Some(remark.into())));
    };
    let outcome = manifest.read_outcome(&dir, "run planish tolerance again")?;
    let settings = manifest.read_settings(&dir)?;
    Ok((Some(ErrorBudget::new(&names[method], settings, outcome, arrays)), None))
}

/// Reads the bound of the residual in `run`/any-path/bound. If it is of another map than `surface`, or of another tool
/// than that of the report, it returns a remark instead; both are `None` if there is no bound. `role` is the prefix of
/// its role as an input.
fn read_bound(
    inputs: &mut Inputs,
    role: &str,
    run: &Path,
    surface: &Recorded,
) -> Result<(Option<PathFreeBounds>, Option<String>), Failure> {
    let dir = run.join("any-path").join("bound");
    if !dir.join(MANIFEST).exists() {
        return Ok((None, None));
    }
    let manifest = inputs.read_manifest(&format!("{role}/bound"), &dir, &kind::BOUND)?;
    let record = record_of(&manifest);
    let tif = inputs.digest(&format!("{role}/tif"));
    let is_of_tool = tif.is_none() || record.input("tif") == tif;
    if record.input("surface") != Some(&surface.digest) || !is_of_tool {
        let remark = "bound: it is of another map or tool than that of the run; run planish dwell bound again";
        return Ok((None, Some(remark.into())));
    }
    Ok((Some(manifest.read_outcome(&dir, "run planish dwell bound again")?), None))
}

/// Manifests of the artifacts of a run or of a method, for the report page.
pub(crate) type Provenance = Vec<Made>;

/// Returns the manifest of the artifact of this role; `None` if there is none.
pub(crate) fn manifest_of<'a>(provenance: &'a Provenance, role: &str) -> Option<&'a Made> {
    provenance.iter().find(|made| made.shown.role == role)
}

/// Adds the manifest of the artifact `name` in the directory `dir` to `provenance`.
pub(crate) fn add_manifest(
    provenance: &mut Provenance,
    name: &str,
    dir: &Path,
    manifest: &Manifest,
) -> Result<(), Failure> {
    let StageEnd { status, reason } = manifest.end();
    let outcome = match name {
        "trajectory" | "dwell" | "iterations" => manifest.read_outcome(dir, "make it again")?,
        _ => PlanOutcome::default(),
    };
    provenance.push(Made {
        shown: Shown {
            role: name.into(),
            tool: manifest.tool.clone(),
            tool_version: manifest.tool_version.clone(),
            method: manifest.method.clone(),
            command: manifest.command.clone(),
            settings: manifest.settings.clone(),
            inputs: serde_json::to_value(&manifest.inputs)?,
            status,
        },
        reason,
        is_from_dwell_times: manifest.inputs.iter().any(|input| input.role == "dwell")
            || manifest.lineage.iter().any(|ancestor| ancestor.kind == "dwell"),
        outcome,
    });
    Ok(())
}

/// Returns the name of the machine that a verdict is about. It is the name that the verdict states, otherwise that of
/// the machine file; `None` without either.
pub(crate) fn machine_of(verdict: &Verdict, manifest: &Manifest) -> Option<String> {
    if verdict.machine.is_some() {
        return verdict.machine.clone();
    }
    let machine = manifest.inputs.iter().find(|input| input.role == "machine")?;
    Some(Path::new(&machine.path).file_stem()?.to_string_lossy().into_owned())
}

/// An artifact that was read: its value, its hash and record, and its manifest.
struct Known<T> {
    value: T,
    recorded: Recorded,
    manifest: Option<Manifest>,
}

/// Reads the artifact `name` in `dir` and adds its manifest to `provenance`. `role` is the prefix of its role as an
/// input.
fn read_artifact<T: Artifact>(
    inputs: &mut Inputs,
    role: &str,
    dir: &Path,
    name: &str,
    provenance: &mut Provenance,
) -> Result<Known<T>, Failure> {
    let role = format!("{role}/{name}");
    let path = dir.join(name);
    let (value, manifest) = inputs.read_with_manifest(&role, &path)?;
    let digest = inputs.digest(&role).unwrap_or_default().to_string();
    let record = manifest.as_ref().map(record_of);
    if let Some(manifest) = &manifest {
        add_manifest(provenance, name, &path, manifest)?;
    }
    Ok(Known { value, recorded: Recorded { digest, record }, manifest })
}

/// Returns the program, the key and the inputs that a manifest records.
fn record_of(manifest: &Manifest) -> Record {
    let inputs = manifest.inputs.iter().map(|i| (i.role.clone(), i.blake3.clone())).collect();
    Record { tool: manifest.tool.clone(), key: manifest.key.clone(), inputs }
}

/// Reads the artifact `name` in `dir` as `read_artifact` does; `None` if it does not exist.
fn read_optional_artifact<T: Artifact>(
    inputs: &mut Inputs,
    role: &str,
    dir: &Path,
    name: &str,
    provenance: &mut Provenance,
) -> Result<Option<Known<T>>, Failure> {
    if !dir.join(name).exists() {
        return Ok(None);
    }
    read_artifact(inputs, role, dir, name, provenance).map(Some)
}

/// Artifacts of one method of a run.
struct MethodFiles {
    name: String,
    dir: PathBuf,
    trajectory: Trajectory,
    removal: Removal,
    verdict: Verdict,
    /// Name of the machine that the verdict is about; `None` if it is not known.
    machine: Option<String>,
    own_plan: Option<DwellTime>,
    frames: Option<Frames>,
    rounds: Option<Rounds>,
    after_servo_rms_nm: Option<f64>,
    on_axes: Option<AxesFiles>,
    wall: WallTimes,
    records: MethodRecords,
    provenance: Provenance,
}

impl MethodFiles {
    /// Returns the planned dwell times of the method: its own, or otherwise those of the run (`of_run`); `None` if
    /// neither exists. A program that was read back has those of its plan among `methods`, or `None` if that is not
    /// there. A B-spline of the feed along the lines of a raster (`planish bspline-feed`) has none.
    fn dwell<'a>(
        &'a self,
        methods: &'a [Self],
        of_run: Option<&'a DwellTime>,
    ) -> Option<&'a DwellTime> {
        let manifest = manifest_of(&self.provenance, "trajectory");
        match manifest.map(|made| made.shown.tool.as_str()) {
            Some("planish-import") => {
                let (plan, _) = self.name.rsplit_once('+')?;
                let plan = methods.iter().find(|files| files.name == plan)?;
                plan.dwell(&[], of_run)
            }
            Some("planish-bspline-feed") => None,
            _ => self.own_plan.as_ref().or(of_run),
        }
    }
}

/// Reads the results of the method `name` in `dir`. Also returns the reasons for which they do not belong together.
/// `role` is the prefix of the roles of its artifacts; with `after_servo` it also reads the prediction after the servo.
fn read_method(
    inputs: &mut Inputs,
    role: &str,
    name: &str,
    dir: PathBuf,
    after_servo: bool,
) -> Result<(MethodFiles, Vec<String>), Failure> {
    let mut stale = Vec::new();
    let mut provenance = Provenance::default();
    let trajectory: Known<Trajectory> =
        read_artifact(inputs, role, &dir, "trajectory", &mut provenance)?;
    let removal: Known<Removal> = read_artifact(inputs, role, &dir, "removal", &mut provenance)?;
    let place = dir.join("verdict");
    let manifest = inputs.read_manifest(&format!("{role}/verdict"), &place, &kind::VERDICT)?;
    let verdict: Verdict = manifest.read_outcome(&place, "verify it again")?;
    let machine = machine_of(&verdict, &manifest);
    add_manifest(&mut provenance, "verdict", &place, &manifest)?;
    let own_plan: Option<Known<DwellTime>> =
        read_optional_artifact(inputs, role, &dir, "dwell", &mut provenance)?;
    let frames: Option<Known<FramesFile>> =
        read_optional_artifact(inputs, role, &dir, "frames", &mut provenance)?;
    let rounds: Option<Known<RoundsFile>> =
        read_optional_artifact(inputs, role, &dir, "iterations", &mut provenance)?;
    let mut after_servo_rms_nm = None;
    if after_servo {
        after_servo_rms_nm = read_after_servo(inputs, role, &dir, &removal.recorded, &mut stale)?;
    }
    let on_axes = read_on_axes(inputs, role, &dir, &trajectory.recorded, &mut stale)?;
    let mut wall = |name: &str| -> Result<Option<f64>, Failure> {
        let path = dir.join(format!("{name}-wall.json"));
        if !path.exists() {
            return Ok(None);
        }
        let WallTime { wall_s, .. } = inputs.read_json(&format!("{role}/{name}-wall"), &path)?;
        Ok(Some(wall_s))
    };
    let wall = WallTimes { schedule_s: wall("schedule")?, simulate_s: wall("simulate")? };
    let claim = manifest_of(&provenance, "trajectory").and_then(|made| made.outcome.claim);
    let best = manifest_of(&provenance, "iterations").and_then(|made| made.outcome.best_round);
    let records = MethodRecords {
        trajectory: trajectory.recorded,
        removal: removal.recorded,
        verdict: record_of(&manifest),
        limits_kept: (verdict.limits_respected, claim.map(|claim| claim.limits_respected)),
        dwell: own_plan.as_ref().map(|p| p.recorded.clone()),
        frames: frames.as_ref().map(|f| f.recorded.clone()),
        iterations: rounds.as_ref().map(|r| r.recorded.clone()),
    };
    let files = MethodFiles {
        name: name.into(),
        dir,
        trajectory: trajectory.value,
        removal: removal.value,
        verdict,
        machine,
        own_plan: own_plan.map(|p| p.value),
        frames: frames.map(|f| f.value.0),
        rounds: rounds.map(|r| Rounds { best, ..r.value.0 }),
        after_servo_rms_nm,
        on_axes,
        wall,
        records,
        provenance,
    };
    Ok((files, stale))
}

/// Reads the RMS of the residual of the motion in `dir` after the servo of the machine, nm; `None` if the process has
/// no servo. If the prediction is of another motion, mirror or tool than `removal`, it adds a reason to `stale`. `role`
/// is the prefix of its role as an input.
fn read_after_servo(
    inputs: &mut Inputs,
    role: &str,
    dir: &Path,
    removal: &Recorded,
    stale: &mut Vec<String>,
) -> Result<Option<f64>, Failure> {
    let place = dir.join(AFTER_SERVO);
    let role_of_file = format!("{role}/{AFTER_SERVO}");
    // Whole, so that the report records its arrays.
    let (after, manifest): (Removal, _) = inputs.read_with_manifest(&role_of_file, &place)?;
    let Some(manifest) = manifest else {
        let problem = "has no manifest; run planish simulate --servo-of again";
        return Err(Failure::new(format!("{}: {problem}", place.display())));
    };
    let record = record_of(&manifest);
    for role in ["trajectory", "surface", "tif"] {
        let expected = removal.record.as_ref().and_then(|record| record.input(role));
        if expected.is_some() && expected != record.input(role) {
            stale.push(format!(
                "{AFTER_SERVO} is of another {role} than removal; run planish simulate --servo-of again"
            ));
        }
    }
    match manifest.read_outcome::<ServoOutcome>(&place, "run planish simulate again")?.servos {
        Some(0) => Ok(None),
        Some(_) => Ok(Some(after.residual().statistics().rms)),
        None => Err(Failure::new(format!(
            "{}: does not say what a servo leaves; run planish simulate --servo-of",
            place.display()
        ))),
    }
}

/// A motion of all axes of the machine that executes the plan of a method, with its verdict and predicted removal.
struct AxesFiles {
    outcome: MotionReport,
    motion: AxesMotion,
    verdict: AxesVerdict,
    removal: Removal,
}

/// Reads the motion of all axes in `dir`, with its verdict and predicted removal; `None` if there is none. It adds a
/// reason to `stale` if the motion is of another plan than `trajectory`, or the verdict or prediction of another
/// motion.
fn read_on_axes(
    inputs: &mut Inputs,
    role: &str,
    dir: &Path,
    trajectory: &Recorded,
    stale: &mut Vec<String>,
) -> Result<Option<AxesFiles>, Failure> {
    let place = dir.join(ON_AXES);
    if !place.exists() {
        return Ok(None);
    }
    let role = format!("{role}/{ON_AXES}");
    let again = |what: String| {
        Failure::new(format!(
            "{}: {what}; run planish axes motion and what follows again",
            place.display()
        ))
    };
    let mut provenance = Provenance::default();
    let motion: Known<AxesMotion> = read_artifact(inputs, &role, &place, "axes", &mut provenance)?;
    let executed: Known<Trajectory> =
        read_artifact(inputs, &role, &place, "trajectory", &mut provenance)?;
    let removal: Known<Removal> = read_artifact(inputs, &role, &place, "removal", &mut provenance)?;
    let manifest =
        inputs.read_manifest(&format!("{role}/verdict"), &place.join("verdict"), &kind::VERDICT)?;
    let verdict_record = record_of(&manifest);
    let parts = [
        ("axes", motion.recorded.record.as_ref(), "trajectory", &trajectory.digest),
        ("verdict", Some(&verdict_record), "axes", &motion.recorded.digest),
        ("trajectory", executed.recorded.record.as_ref(), "axes", &motion.recorded.digest),
        ("removal", removal.recorded.record.as_ref(), "trajectory", &executed.recorded.digest),
    ];
    for (name, record, from, digest) in parts {
        if record.and_then(|record| record.input(from)) != Some(digest) {
            stale.push(format!(
                "{ON_AXES}/{name} was made from another {from} than that which is there; run planish axes motion and \
                 what follows again"
            ));
        }
    }
    let verdict = manifest.read_outcome(&place.join("verdict"), "verify it again")?;
    let made = motion.manifest.as_ref().ok_or_else(|| again("axes has no manifest".into()))?;
    let outcome: MotionReport =
        made.read_outcome(&place.join("axes"), "run planish axes motion again")?;
    check_names(&outcome, motion.value.axes()).map_err(|e| again(e.to_string()))?;
    Ok(Some(AxesFiles { outcome, motion: motion.value, verdict, removal: removal.value }))
}

/// Name of the directory, in that of a method, with the motion of all axes of the machine.
const ON_AXES: &str = "on-axes";

/// Name of the directory, in that of a method, with the prediction after the servo of the machine.
const AFTER_SERVO: &str = "removal-after-servo";

/// Data that all methods of a run share, to compute their numbers.
struct Shared<'a> {
    desired: &'a Surface,
    /// Planned dwell times, by the name of the method; methods without them are missing.
    planned: &'a BTreeMap<String, DwellTime>,
    plan_manifest: Option<&'a Made>,
    plan_is_for_another: Vec<&'static str>,
    /// Waves that the tool can correct, and the BLAKE3 hash of the tool; `None` if the tool is not known.
    reach: Option<&'a (Reach, String)>,
    division: &'a Division,
    form: Option<&'a Form>,
}

/// Name of a method and its numbers.
type Numbered = (String, MethodResult);

impl Shared<'_> {
    /// Computes the numbers of the methods whose artifacts belong together. Returns them with the data for the page,
    /// in the order of `valid`.
    fn methods(&self, valid: Vec<Valid>) -> Result<(Vec<Numbered>, Vec<RunMethod>), Failure> {
        let numbered = valid.into_par_iter().map(|(files, judged, remarks)| {
            let name = files.name.clone();
            let (number, method) = self.method(files, judged, remarks)?;
            Ok(((name, number), method))
        });
        // The first failure in the order of the methods, whichever thread met its own first.
        let numbered: Vec<Result<_, Failure>> = numbered.collect();
        numbered.into_iter().collect()
    }

    /// Computes the numbers of a method whose artifacts belong together. Returns them with the data for the page.
    fn method(
        &self,
        files: MethodFiles,
        specification: Option<SpecificationReport>,
        remarks: Vec<String>,
    ) -> Result<(MethodResult, RunMethod), Failure> {
        let trajectory = manifest_of(&files.provenance, "trajectory");
        // A refined plan has dwell times of its own.
        let (dwell_manifest, for_another) = match &files.own_plan {
            Some(_) => (manifest_of(&files.provenance, "dwell"), &[][..]),
            None => (self.plan_manifest, &self.plan_is_for_another[..]),
        };
        let plan = PlanStatus::of_method(&files.name, trajectory, dwell_manifest, for_another);
        let dwell = self.planned.get(&files.name).cloned();
        // A prediction with another tool is not told by this one.
        let tool = files.records.removal.record.as_ref();
        let tool = tool.and_then(|record| record.input("tif"));
        let reach = self.reach.filter(|(_, digest)| tool.is_none_or(|tool| tool == digest));
        let short_wave_rms_nm =
            reach.map(|(reach, _)| reach.short_wave_rms_nm(files.removal.residual()));
        let part = self.form.map(|form| (form, self.desired));
        let (on_axes, picture) = match &files.on_axes {
            Some(o) => (
                Some(OnAxes::new(&o.outcome, &o.motion, &o.verdict, &o.removal, self.form)),
                Some(on_axes::picture(&o.outcome, &o.motion, &o.verdict, part)),
            ),
            None => (None, None),
        };
        let numbers = MethodResult::new(
            self.desired,
            self.division,
            &files.removal,
            &files.trajectory,
            dwell.as_ref(),
            &files.verdict,
            MethodFacts {
                wall: files.wall,
                machine: files.machine,
                plan,
                short_wave_rms_nm,
                specification,
                after_servo_rms_nm: files.after_servo_rms_nm,
                on_axes,
                remarks,
            },
        )
        .map_err(|e| Failure::new(format!("{}: {e}", files.dir.display())))?;
        let method = RunMethod {
            name: files.name,
            trajectory: files.trajectory,
            shown_removal_nm: None,
            removal: files.removal,
            verdict: files.verdict,
            path: None,
            dwell,
            frames: files.frames,
            rounds: files.rounds,
            on_axes: picture,
            provenance: files.provenance,
        };
        Ok((numbers, method))
    }
}

/// Frames of a run (removal at chosen times) as an artifact of the kind `kind::FRAMES`.
struct FramesFile(Frames);

impl Artifact for FramesFile {
    const KIND: &'static Kind = &kind::FRAMES;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
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

/// Rounds of a refinement as an artifact of the kind `kind::ITERATIONS`; the times of the segments are not read.
struct RoundsFile(Rounds);

impl Artifact for RoundsFile {
    const KIND: &'static Kind = &kind::ITERATIONS;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        unreachable!("a report does not write iterations")
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let mut list = |name| arrays.take_f64(name).into_iter().collect();
        let rounds =
            Rounds { rms_nm: list("rms_nm"), total_time_s: list("total_time_s"), best: None };
        Ok(Self(rounds))
    }
}

/// Reads a run of several dwell solvers along one tool path: its surface, and one row per solver, by name. The row of
/// a solver in `skip` only says that it was left out.
///
/// # Errors
/// Fails if an artifact cannot be read, or if the run holds no solver.
pub(crate) fn read_solvers(
    inputs: &mut Inputs,
    run: &Path,
    tool_path: &Path,
    skip: &[String],
) -> Result<(Surface, Vec<(String, SolverRow)>), Failure> {
    let surface: Surface = inputs.read("surface", &run.join("surface"))?;
    let path: ToolPath = inputs.read("tool-path", tool_path)?;
    let dir = run.join("solvers");
    let solved = entries(&dir)?.into_iter().filter(|name| dir.join(name).is_dir());
    let names: BTreeSet<String> = solved.chain(skip.iter().cloned()).collect();
    let mut rows = Vec::new();
    for name in names {
        let row = if skip.contains(&name) {
            SolverRow::Refused { refused: "left out by skip=".into() }
        } else {
            read_solver(inputs, &name, &dir.join(&name), &path)?
        };
        rows.push((name, row));
    }
    if rows.is_empty() {
        let message = "holds no solver; solve, schedule and simulate at least once";
        return Err(Failure::new(format!("{}: {message}", dir.display())));
    }
    Ok((surface, rows))
}

/// Reads the result of the solver `name` in `dir`. For a solver without dwell times it reads the message that it has
/// left. `path` is the tool path of the run.
fn read_solver(
    inputs: &mut Inputs,
    name: &str,
    dir: &Path,
    path: &ToolPath,
) -> Result<SolverRow, Failure> {
    if !dir.join("dwell").exists() {
        return Ok(SolverRow::Refused { refused: message_in(dir)? });
    }
    let (dwell, manifest): (DwellTime, _) =
        inputs.read_with_manifest(&format!("{name}/dwell"), &dir.join("dwell"))?;
    let mut provenance = Provenance::default();
    if let Some(manifest) = &manifest {
        add_manifest(&mut provenance, "dwell", &dir.join("dwell"), manifest)?;
    }
    let plan = PlanStatus::of_solver(provenance.first());
    let position: Removal =
        inputs.read(&format!("{name}/position"), &dir.join("position/removal"))?;
    let executed: Removal =
        inputs.read(&format!("{name}/executed"), &dir.join("executed/removal"))?;
    let motion: Trajectory =
        inputs.read(&format!("{name}/trajectory"), &dir.join("executed/trajectory"))?;
    let time_s = motion.total_time_s();
    let mut solver = Solver::new(path, &dwell, &position, &executed, time_s, plan)
        .map_err(|e| Failure::new(format!("{}: {e}", dir.display())))?;
    let wall = dir.join("dwell-wall.json");
    if wall.exists() {
        let WallTime { wall_s, peak_memory_mb } =
            inputs.read_json(&format!("{name}/dwell-wall"), &wall)?;
        solver.wall_s = Some(wall_s);
        solver.peak_memory_mb = peak_memory_mb;
    }
    Ok(SolverRow::Solved(solver))
}

/// Reads the arrays of two directories that have the same arrays, as pairs by name.
///
/// # Errors
/// Refuses unlike kinds, unlike sets of arrays, and files that cannot be read.
pub(crate) fn read_pair(a: &Path, b: &Path) -> Result<BTreeMap<String, [Elements; 2]>, Failure> {
    if let (Some(x), Some(y)) = (kind_of(a)?, kind_of(b)?)
        && x != y
    {
        let message = format!("{} holds a {x}, {} a {y}", a.display(), b.display());
        return Err(Failure::new(format!("{message}; give two artifacts of the same kind")));
    }
    let in_a = arrays_of(a)?;
    let in_b = arrays_of(b)?;
    if in_a != in_b {
        return Err(Failure::new(format!(
            "{} holds the arrays {in_a:?}, {} {in_b:?}; give two directories with the same arrays",
            a.display(),
            b.display()
        )));
    }
    let mut pairs = BTreeMap::new();
    for name in in_a {
        let elements = [read_elements(&a.join(&name))?, read_elements(&b.join(&name))?];
        pairs.insert(name, elements);
    }
    Ok(pairs)
}

/// Returns the kind of artifact that the manifest in `dir` names; `None` without a manifest.
fn kind_of(dir: &Path) -> Result<Option<String>, Failure> {
    let path = dir.join(MANIFEST);
    if !path.exists() {
        return Ok(None);
    }
    let broken = |e: String| Failure::new(format!("{}: is not a manifest ({e})", path.display()));
    let text = read_text(&path).map_err(|e| broken(e.to_string()))?;
    let head: ManifestHead = serde_json::from_str(&text).map_err(|e| broken(e.to_string()))?;
    Ok(Some(head.kind))
}

/// Reads the text of a regular file. Refuses a pipe, because reading it could wait for ever.
fn read_text(path: &Path) -> std::io::Result<String> {
    if !fs::metadata(path)?.is_file() {
        return Err(std::io::Error::other("is not a file"));
    }
    fs::read_to_string(path)
}

/// Returns the names of the `.npy` files in `dir`, sorted. Refuses a directory without any.
fn arrays_of(dir: &Path) -> Result<Vec<String>, Failure> {
    let mut names = entries(dir)?;
    names.retain(|name| name.ends_with(".npy"));
    if names.is_empty() {
        let message = "holds no .npy file; diff compares arrays";
        return Err(Failure::new(format!("{}: {message}", dir.display())));
    }
    Ok(names)
}

/// Returns the names of the entries of `dir`, sorted. Fails if it cannot be read, or if a name is not UTF-8.
fn entries(dir: &Path) -> Result<Vec<String>, Failure> {
    let unreadable =
        |e: std::io::Error| Failure::new(format!("{}: cannot read: {e}", dir.display()));
    let mut names = Vec::new();
    for entry in fs::read_dir(dir).map_err(unreadable)? {
        let name = entry.map_err(unreadable)?.file_name().into_string().map_err(|name| {
            let path = dir.join(name);
            Failure::new(format!("{}: the name is not UTF-8; give another one", path.display()))
        })?;
        names.push(name);
    }
    names.sort();
    Ok(names)
}

/// Reads a `.npy` array of any element type that artifacts have: floats, integers, or flags, which become 0 and 1.
fn read_elements(path: &PathBuf) -> Result<Elements, Failure> {
    Ok(match npy::read(path, dtype_of(path)?)?.array {
        ArrayData::F64(a) => Elements::Float(a.into_owned()),
        ArrayData::I64(a) => Elements::Integer(a.into_owned()),
        ArrayData::U8(a) => Elements::Integer(a.mapv(i64::from)),
    })
}

/// Returns the element type that the header of a `.npy` file names. It is float for a type that artifacts do not
/// have, so that [`npy::read`] refuses the file with its message.
fn dtype_of(path: &PathBuf) -> Result<Dtype, Failure> {
    let unreadable =
        |e: std::io::Error| Failure::new(format!("{}: cannot read: {e}", path.display()));
    // A pipe would never end; `npy::read` says so.
    if !fs::metadata(path).map_err(unreadable)?.is_file() {
        return Ok(Dtype::F64);
    }
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
