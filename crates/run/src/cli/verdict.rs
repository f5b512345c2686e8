//! `planish verdict`: lists the stages of a run that gave a negative verdict, from their manifests.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    io::ErrorKind,
    path::{Path, PathBuf},
};

use clap::Args;
use planish_handoff::{Failure, Manifest, Status, as_command, kind::MANIFEST, read_regular, words};
use planish_types::outcome::{StageEnd, StageStatus};

#[derive(Args)]
pub struct Verdict {
    /// Directory of the run; the verdicts on the artifacts directly in it count
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Directory in the run whose artifacts count too: that of the plan to be executed. Can be given
    /// again; the verdicts on other methods, made for comparison, do not count
    #[arg(long, value_name = "NAME")]
    plan: Vec<PathBuf>,
}

/// Names of the artifacts of a plan that carry a verdict, as far as they exist.
const JUDGED: [&str; 4] = ["trajectory", "removal", "verdict", "specification"];

/// Names of the artifacts that must stand beside a trajectory, so that the directory holds a complete plan.
const NEEDED: [&str; 2] = ["removal", "verdict"];

/// Roles of the input files that are the same for all stages of a run.
const SHARED: [&str; 3] = ["machine", "error-budget", "specification"];

impl Verdict {
    pub fn run(&self) -> Result<Status, Failure> {
        verdict(&self.run, &self.plan)
    }
}

/// Collects the negative verdicts on the artifacts directly in `run` and in each of `plans`, with the programs that
/// gave them. Refuses a motion without its removal or verdict, and artifacts that were not made from each other.
fn verdict(run: &Path, plans: &[PathBuf]) -> Result<Status, Failure> {
    let mut negative = Vec::new();
    let mut whole = Whole { run, seen: BTreeSet::new(), shared: BTreeMap::new() };
    for plan in std::iter::once(Path::new("")).chain(plans.iter().map(PathBuf::as_path)) {
        let manifests = manifests(run, plan)?;
        let is_there = |name: &str| manifests.iter().any(|(place, _)| *place == plan.join(name));
        if is_there("trajectory")
            && let Some(lacking) = NEEDED.iter().find(|name| !is_there(name))
        {
            return Err(whole.mixed(&format!("{} has no {lacking}", plan.display())));
        }
        for (at, manifest) in &manifests {
            let name = at.file_name().unwrap_or_default();
            if *at == Path::new("report") || JUDGED.iter().any(|judged| *judged == name) {
                whole.check(at, manifest)?;
            }
            if let StageEnd { status: Some(StageStatus::Negative), reason } = manifest.end() {
                let reason = reason.as_deref().unwrap_or("no reason given");
                let at = run.join(at);
                let command = as_command(&manifest.tool);
                negative.push(format!("{} ({command}): {reason}", at.display()));
            }
        }
    }
    if negative.is_empty() {
        return Ok(Status::Done);
    }
    Ok(Status::Negative(negative.join("; ")))
}

/// Check that the artifacts of a run were made from each other. If a run with other settings ended early, some of its
/// own artifacts stand beside older ones.
struct Whole<'a> {
    run: &'a Path,
    /// Artifacts that were checked already, by their paths in the run.
    seen: BTreeSet<PathBuf>,
    /// Hash of the input file for each role in [`SHARED`], and the first artifact that was made with it.
    shared: BTreeMap<String, (String, PathBuf)>,
}

impl Whole<'_> {
    /// Refuses the artifact at the path `at` in the run if its inputs are not the present artifacts of the run.
    /// `manifest` is its manifest; the artifacts that it was made from are checked in turn.
    fn check(&mut self, at: &Path, manifest: &Manifest) -> Result<(), Failure> {
        if !self.seen.insert(at.into()) {
            return Ok(());
        }
        let run_as_given = run_as_given(at, manifest);
        for input in &manifest.inputs {
            if input.kind == "file" {
                self.check_shared(at, &input.role, &input.blake3)?;
                continue;
            }
            let inside = run_as_given.as_ref().map(|run| Path::new(&input.path).strip_prefix(run));
            let Some(Ok(from)) = inside else { continue };
            let [made, source] = [at, from].map(Path::display);
            let Some(made_from) = manifest_in(&self.run.join(from))? else {
                let problem = format!("{made} was made from {source}, which is not there");
                return Err(self.mixed(&problem));
            };
            if made_from.content().is_some_and(|content| content != input.blake3) {
                return Err(self.mixed(&format!("{made} was made from another {source}")));
            }
            self.check(from, &made_from)?;
        }
        Ok(())
    }

    /// Refuses the artifact at the path `at` if its machine, error budget or specification is not that of the others.
    /// `hash` is that of the file. `role` is that of the file.
    fn check_shared(&mut self, at: &Path, role: &str, hash: &str) -> Result<(), Failure> {
        if !SHARED.contains(&role) {
            return Ok(());
        }
        let first = self.shared.entry(role.into()).or_insert_with(|| (hash.into(), at.into()));
        if first.0 == hash {
            return Ok(());
        }
        let problem = format!(
            "{} and {} were made with different {role} files",
            first.1.display(),
            at.display()
        );
        Err(self.mixed(&problem))
    }

    /// Returns the message that the artifacts of the run do not belong together, because of `problem`.
    fn mixed(&self, problem: &str) -> Failure {
        Failure::new(format!(
            "{}: {problem}: a run was ended before its last stage, or a part is left over from an older run; run the \
             pipeline again, and if that does not help, into another directory",
            self.run.display()
        ))
    }
}

/// Returns the path of the run at the time when the artifact `at` was made, from the command in its manifest. It can
/// differ from the present path, because a run may be moved. `None` if the command has no `--out` that ends with `at`
/// or a directory above it.
fn run_as_given(at: &Path, manifest: &Manifest) -> Option<PathBuf> {
    let words = words::split(&manifest.command).ok()?;
    let mut values = words.iter().skip_while(|word| *word != "--out").skip(1);
    let out: PathBuf = Path::new(values.next()?).components().collect();
    // A stage with several artifacts is given the directory above them.
    let inside = at.ancestors().find(|part| out.ends_with(part))?;
    let mut run = out.as_path();
    for _ in inside.components() {
        run = run.parent()?;
    }
    Some(run.into())
}

/// Returns the path in the run and the manifest of every directory directly in `plan` that has a manifest, in the order
/// of their names.
fn manifests(run: &Path, plan: &Path) -> Result<Vec<(PathBuf, Manifest)>, Failure> {
    let dir = run.join(plan);
    let mut manifests = Vec::new();
    for entry in fs::read_dir(&dir).map_err(|e| unreadable(&dir, &e))? {
        let entry = entry.map_err(|e| unreadable(&dir, &e))?;
        if let Some(manifest) = manifest_in(&entry.path())? {
            manifests.push((plan.join(entry.file_name()), manifest));
        }
    }
    manifests.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(manifests)
}

/// Reads the manifest of the artifact in a directory; `None` if there is none.
fn manifest_in(dir: &Path) -> Result<Option<Manifest>, Failure> {
    let file = dir.join(MANIFEST);
    match read_regular(&file) {
        Ok(text) => serde_json::from_slice(&text).map(Some).map_err(|e| unreadable(&file, &e)),
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(None),
        Err(e) => Err(unreadable(&file, &e)),
    }
}

/// Returns the failure that a file or folder cannot be read.
fn unreadable(path: &Path, problem: &dyn std::fmt::Display) -> Failure {
    Failure::new(format!("{}: cannot read: {problem}", path.display()))
}
