//! `planish doctor`: what is here, and a plan of a fixture as a check.

use std::{env, fs, fs::File, process::Command, thread};

use clap::Args;
use planish_handoff::{Failure, Status, say};
use planish_types::budget;

use super::{
    execute::{Messages, run},
    place::Installation,
    program::read_answer,
};

/// Settings of the check: a plan that takes a few seconds.
const CHECK: [&str; 6] =
    ["fixture=coupon", "pitch_mm=2", "refine=no", "plan_joint=no", "frames=0", "step_mm=2"];

#[derive(Args)]
pub struct Doctor {}

impl Doctor {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Installation::find()?;
        row("planish", &format!("{} in {}", env!("CARGO_PKG_VERSION"), place.programs.display()));
        row("system", &format!("{} {}, {} cores", env::consts::OS, env::consts::ARCH, cores()));
        let gib = budget::DEFAULT_MEMORY_GIB;
        row("memory", &format!("a stage may take {gib} GiB (--memory-gib)"));
        let pipelines = place.pipelines().len();
        row("pipelines", &format!("{pipelines} in {}pipelines", place.repository()));
        let python = Command::new("python3").arg("--version").output();
        let python = python.map(|found| String::from_utf8_lossy(&found.stdout).trim().to_string());
        row("python3", &python.unwrap_or_else(|_| "none; planish sweep needs it".into()));
        check(&place)
    }
}

/// Prints what was found of the part `name`.
fn row(name: &str, found: &str) {
    say(format!("{name:10} {found}"));
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
    let answer = read_answer(&out).ok().filter(|answer| code == 0 && answer.method.is_some());
    let Some(answer) = answer else {
        let log = log.display();
        return Ok(Status::Negative(format!(
            "the plan of the fixture coupon failed (exit code {code}); report this with {log}"
        )));
    };
    row("check", &answer.sentence);
    fs::remove_dir_all(&folder)?;
    Ok(Status::Done)
}
