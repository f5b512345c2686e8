//! `planish-run doctor`: what is here, and a plan of a fixture as a check.

use std::{env, fs, fs::File, path::Path, process::Command, thread};

use clap::Args;
use planish_handoff::{Failure, Status, keep_output, say};
use planish_types::budget;
use serde_json::Value;

use super::{
    execute::{Messages, run},
    place::Installation,
};

/// Settings of the check: a plan that takes a few seconds.
const CHECK: [&str; 6] =
    ["fixture=coupon", "pitch_mm=2", "refine=no", "plan_joint=no", "frames=0", "step_mm=2"];

#[derive(Args)]
pub struct Doctor {}

impl Doctor {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Installation::find()?;
        let row = |name: &str, found: String| say(format!("{name:10} {found}"));
        row("planish", format!("{} in {}", env!("CARGO_PKG_VERSION"), place.programs.display()));
        row("system", format!("{} {}, {} cores", env::consts::OS, env::consts::ARCH, cores()));
        row(
            "memory",
            format!("a stage may take {} GiB (--memory-gib)", budget::DEFAULT_MEMORY_GIB),
        );
        let pipelines = place.pipelines();
        row("pipelines", format!("{} in {}pipelines", pipelines.len(), place.repository()));
        let python = Command::new("python3").arg("--version").output();
        let python = python.map(|found| String::from_utf8_lossy(&found.stdout).trim().to_string());
        row("python3", python.unwrap_or_else(|_| "none; planish sweep needs it".into()));
        check(&place)
    }
}

/// Returns the number of cores that the stages use.
fn cores() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

/// Plans a fixture in a temporary directory, which is removed if the plan is good.
fn check(place: &Installation) -> Result<Status, Failure> {
    let folder = env::temp_dir().join(format!("planish-doctor-{}", std::process::id()));
    fs::create_dir_all(&folder)?;
    let log = folder.join("log.txt");
    let out = folder.join("run");
    let settings = CHECK.map(String::from).into_iter().chain([format!("out={}", out.display())]);
    let definition = place.definition("raster")?;
    let scope = place.scope(&definition, &settings.collect::<Vec<_>>())?;
    let code = run(place, scope, "run", Messages::Kept(File::create(&log)?))?.code;
    let summary = summary(&out).unwrap_or_default();
    let rms_nm = |row: &Value| row["rms_nm"].as_f64().unwrap_or(f64::NAN);
    let (before, after) = (rms_nm(&summary["initial"]), rms_nm(&summary["methods"]["pvt"]));
    if code != 0 || !(after < before) {
        let log = log.display();
        return Ok(Status::Negative(format!(
            "the plan of the fixture coupon failed (exit code {code}); report this with {log}"
        )));
    }
    say(format!("check      {before:.2} nm RMS become {after:.2} nm"));
    keep_output(&out, "check", summary);
    fs::remove_dir_all(&folder)?;
    Ok(Status::Done)
}

/// Reads the numbers of the report of a run; `None` if it has none.
fn summary(out: &Path) -> Option<Value> {
    let text = fs::read_to_string(out.join("report/summary.json")).ok()?;
    serde_json::from_str(&text).ok()
}
