//! `planish next-run`: plans the next run from the maps before and after the last one.
//!
//! | directory | content |
//! |---|---|
//! | `reconciliation` | estimates from the last run: tool, position of the part, errors |
//! | `tif`, `transform`, `error_budget.json` | the tool, part position and errors that the next run assumes |
//! | `plan` | next plan, in the coordinates of the part |
//! | `commanded`, `verdict` | its motion in those of the machine, and the verdict on it |
//! | `tolerance` | residual that the plan is expected to leave |
//! | `decision` | run again, or stop |

use std::path::Path;

use clap::Args;
use planish_handoff::{Failure, Status, say, warn, words};
use planish_types::assumed_machine;

use super::{
    after_tool,
    campaign::specified,
    claim::{Claim, Named},
    execute::{Messages, Programs, as_typed},
    place::{Installation, directory_name, name_of},
    run::end,
    several::{Silent, UserSettings, command, is_directory, with_plain},
};

/// End of the messages about a missing setting: the settings that must be given.
const NEEDED: &str = "give before=DIR after=DIR trajectory=DIR tif=DIR";

#[derive(Args)]
pub struct NextRun {
    /// Settings: before=DIR, after=DIR, trajectory=DIR and tif=DIR (the maps, the motion in the coordinates of the part,
    /// the tool), transform=DIR, error_budget=FILE, machine=FILE, pipeline, least_gain_percent, reconcile, and those of the
    /// pipeline. After a tool of planish run several: run=DIR, after=MAP (measured after that tool), done=NAME (the tool;
    /// the first one by default), surface_settings and out=DIR
    #[arg(value_name = "NAME=VALUE", trailing_var_arg = true, allow_hyphen_values = true)]
    settings: Vec<String>,
}

/// Inputs from the last run: artifacts of the maps before and after it, of its motion and of its tool influence
/// function.
struct Last {
    before: String,
    after: String,
    trajectory: String,
    tif: String,
    transform: Option<String>,
    error_budget: Option<String>,
}

impl Last {
    /// Takes the inputs of the last run out of the settings. Refuses missing ones, and settings that do not fit this
    /// command.
    fn take(user: &mut UserSettings) -> Result<Self, Failure> {
        if let Some(word) = user.words.first() {
            return Err(Failure::new(format!("'{word}' is no setting; {NEEDED}")));
        }
        for name in ["surface", "fixture"] {
            if user.get(name).is_some() {
                return Err(Failure::new(format!(
                    "the map of the next plan is after=DIR; leave {name} out"
                )));
            }
        }
        if user.get("export").is_some() {
            return Err(Failure::new(
                "the program is that of the commanded motion; leave export out, and give planish export OUT/commanded",
            ));
        }
        let mut needed = |name: &str| {
            let path = user.take_path(name);
            let path =
                path.ok_or_else(|| Failure::new(format!("{name} is not given; {NEEDED}")))?;
            is_directory(name, &path).map(|()| path)
        };
        let [before, after, trajectory, tif] =
            [needed("before")?, needed("after")?, needed("trajectory")?, needed("tif")?];
        let transform = user.take_path("transform");
        if let Some(transform) = &transform {
            is_directory("transform", transform)?;
        }
        let error_budget = user.take_path("error_budget");
        if let Some(file) = error_budget.as_ref().filter(|file| !Path::new(file).is_file()) {
            return Err(Failure::new(format!(
                "error_budget {file} is no file; give the errors that are known beforehand"
            )));
        }
        Ok(Self { before, after, trajectory, tif, transform, error_budget })
    }

    /// Returns the paths of the inputs, each with the name of its setting, for the claim on the directory.
    fn named(&self) -> Vec<Named> {
        let Self { before, after, trajectory, tif, transform, error_budget } = self;
        let all = [
            ("before", Some(before)),
            ("after", Some(after)),
            ("trajectory", Some(trajectory)),
            ("tif", Some(tif)),
            ("transform", transform.as_ref()),
            ("error_budget", error_budget.as_ref()),
        ];
        all.into_iter()
            .flat_map(|(setting, path)| {
                Named::words(setting, path.map_or(&[], std::slice::from_ref), true)
            })
            .collect()
    }
}

impl NextRun {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Installation::find()?;
        let mut user = UserSettings::new(&self.settings)?;
        if user.get("run").is_some() {
            return after_tool::run(&mut user);
        }
        let last = Last::take(&mut user)?;
        let definition =
            place.definition_of_plans(&user.take("pipeline").unwrap_or("raster".into()))?;
        let reconcile = user.take("reconcile").unwrap_or_default();
        let reconcile = words::split(&reconcile)
            .map_err(|e| Failure::new(format!("reconcile={reconcile}: {e}")))?;
        let least_gain_percent = user.take("least_gain_percent").unwrap_or("5".into());
        let out = user.take_path("out").unwrap_or_else(|| {
            let after = std::path::absolute(&last.after).unwrap_or_default();
            format!("out/next-run/{}", directory_name(&name_of(&after)))
        });
        let settings = with_plain(&definition, &user);
        let scope = place.settings(&definition, &settings)?;
        let machine = scope.text("machine").map_err(Failure::new)?;
        let assumed_machine = user.assumed_machine(&machine)?.map(|name| assumed_machine(&name));
        let name = Path::new(&machine).file_name().unwrap_or_default().to_string_lossy();
        let limits = format!("{out}/machine/{name}");
        let claim = Claim {
            out: out.clone().into(),
            pipeline: "next-run".into(),
            fixture: None,
            surface: Some(last.after.clone().into()),
            tif: Some(last.tif.clone().into()),
            machine: machine.clone().into(),
            named: [
                Named::all(&scope)?,
                last.named(),
                Named::words("reconcile", &reconcile, false),
            ]
            .into_iter()
            .flatten()
            .collect(),
        };
        let (_lock, assumed) = claim.take(&as_typed())?;
        assumed.iter().chain(&assumed_machine).for_each(warn);
        let next = Next {
            programs: Programs::new(&place, Messages::Shown)?,
            is_specified: user.get("specification").is_some_and(|file| !file.is_empty()),
            out,
            limits,
            least_gain_percent,
        };
        next.reconcile(&last, &reconcile)?;
        // The next plan, whose pages and tables are its own
        let own = [
            format!("surface={}", last.after),
            format!("tif={}", next.path("tif")),
            format!("out={}", next.path("plan")),
        ];
        let plan = Silent::new(&place)?.pipeline(&definition, &[&settings[..], &own].concat())?;
        let planned = plan.scope.text("planned").map_err(Failure::new)?;
        next.decide(&planned)?;
        let method = format!("plan/methods/{planned}");
        let verdict = ["verdict", "--run", &next.out, "--plan", "plan", "--plan", &method];
        let code = next.programs.run(&command("planish-run", &verdict))?;
        assumed_machine.iter().for_each(warn);
        end(code)
    }
}

/// Directory and settings of the next run, for the commands that plan it.
struct Next {
    programs: Programs,
    out: String,
    /// Path of the machine file that the commands read, a copy in the directory of the run.
    limits: String,
    least_gain_percent: String,
    is_specified: bool,
}

impl Next {
    /// Returns the path of `part` in the output directory.
    fn path(&self, part: &str) -> String {
        format!("{}/{part}", self.out)
    }

    /// Runs a command. Exit codes 0 and 1 (a negative verdict) count as success; any other ends this process with code
    /// 2.
    fn go_on(&self, program: &str, flags: &[&str]) -> Result<(), Failure> {
        match self.programs.run(&command(program, flags))? {
            0 | 1 => Ok(()),
            _ => planish_handoff::exit(2),
        }
    }

    /// Estimates from both maps the tool, the position of the part and the errors of the last run. `more` are further
    /// flags for the program.
    fn reconcile(&self, last: &Last, more: &[String]) -> Result<(), Failure> {
        let place = self.path("place");
        // Where the part lay, if nobody measured it: as the machine file says
        let lay = match &last.transform {
            Some(transform) => transform,
            None => {
                let flags = ["place", "--machine", &self.limits, "--out", &place, "--force"];
                self.go_on("planish-register", &flags)?;
                &place
            }
        };
        let [reconciliation, tif, transform, learnt] =
            ["reconciliation", "tif", "transform", "error_budget.json"].map(|part| self.path(part));
        let mut flags: Vec<&str> = more.iter().map(String::as_str).collect();
        flags.extend(["--before", &last.before, "--after", &last.after]);
        flags.extend(["--trajectory", &last.trajectory, "--tif", &last.tif]);
        flags.extend(last.error_budget.iter().flat_map(|file| ["--error-budget", file]));
        flags.extend(["--transform", lay, "--out", &reconciliation, "--corrected-tif", &tif]);
        flags.extend(["--corrected-transform", &transform, "--learnt-error-budget", &learnt]);
        flags.push("--force");
        self.go_on("planish-reconcile", &flags)
    }

    /// Transforms the plan `planned` to the machine, checks its limits, estimates its residual, and decides whether to
    /// run again.
    fn decide(&self, planned: &str) -> Result<(), Failure> {
        let [run, tif, transform, learnt, commanded] =
            ["plan", "tif", "transform", "error_budget.json", "commanded"].map(|p| self.path(p));
        let [verdict, tolerance, decision] =
            ["verdict", "tolerance", "decision"].map(|part| self.path(part));
        let motion = format!("{run}/methods/{planned}/trajectory");
        let map = format!("{run}/surface");
        let to = ["--trajectory", &motion, "--out", &commanded, "--force"];
        self.go_on("planish-register", &[&["apply", "--transform", &transform], &to[..]].concat())?;
        let of = ["--trajectory", &commanded, "--machine", &self.limits];
        self.go_on("planish-verify", &[&of[..], &["--out", &verdict, "--force"]].concat())?;
        let over = ["--trajectory", &motion, "--tif", &tif, "--surface", &map];
        let own = ["--error-budget", &learnt, "--out", &tolerance, "--force"];
        self.go_on("planish-tolerance", &[&over[..], &own[..]].concat())?;
        let judged = if self.is_specified { specified(&run, planned) } else { vec![] };
        let least = format!("--least-gain-percent={}", self.least_gain_percent);
        let mut flags = vec!["decide", "--surface", &map, "--trajectory", &motion];
        flags.extend(["--tolerance", &tolerance, &least]);
        flags.extend(judged.iter().map(String::as_str));
        flags.extend(["--out", &decision, "--force"]);
        say("");
        self.go_on("planish-campaign", &flags)?;
        say(format!("the plan: {run}/report/report.html\nits motion on the machine: {commanded}"));
        Ok(())
    }
}
