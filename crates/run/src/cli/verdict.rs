//! `planish-run verdict`: which stages of a run gave a negative verdict: their manifests say so.

use std::{
    fs,
    io::ErrorKind,
    path::{Path, PathBuf},
};

use clap::Args;
use planish_handoff::{Failure, Manifest, Status, kind::MANIFEST};

#[derive(Args)]
pub struct Verdict {
    /// Directory of the run; the artifacts directly in it count
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Directory in it whose artifacts count too: the plan that is to be executed. Can be given
    /// again; the verdicts on other methods, made for comparison, do not count
    #[arg(long, value_name = "NAME")]
    plan: Vec<PathBuf>,
}

impl Verdict {
    pub fn run(&self) -> Result<Status, Failure> {
        verdict(&self.run, &self.plan)
    }
}

/// The negative verdicts on the artifacts directly in `run` and in each of `plans`, with the programs
/// that gave them.
fn verdict(run: &Path, plans: &[PathBuf]) -> Result<Status, Failure> {
    let mut negative = Vec::new();
    for dir in std::iter::once(run.to_path_buf()).chain(plans.iter().map(|p| run.join(p))) {
        for (artifact, manifest) in manifests(&dir)? {
            if manifest.outcome["status"] == "negative" {
                let reason = manifest.outcome["reason"].as_str().unwrap_or("no reason given");
                negative.push(format!("{} ({}): {reason}", artifact.display(), manifest.tool));
            }
        }
    }
    Ok(match negative.is_empty() {
        true => Status::Done,
        false => Status::Negative(negative.join("; ")),
    })
}

/// The directories in `dir` that have a manifest, by name.
fn manifests(dir: &Path) -> Result<Vec<(PathBuf, Manifest)>, Failure> {
    let unreadable = |path: &Path, e: &dyn std::fmt::Display| {
        Failure::new(format!("{}: cannot read: {e}", path.display()))
    };
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).map_err(|e| unreadable(dir, &e))? {
        let artifact = entry.map_err(|e| unreadable(dir, &e))?.path();
        let file = artifact.join(MANIFEST);
        let text = match fs::read(&file) {
            Ok(text) => text,
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                continue;
            }
            Err(e) => return Err(unreadable(&file, &e)),
        };
        found.push((artifact, serde_json::from_slice(&text).map_err(|e| unreadable(&file, &e))?));
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(found)
}
