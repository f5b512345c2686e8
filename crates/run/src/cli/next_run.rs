//! `planish-run next-run`: from the maps before and after a run to the next one.
//!
//! | directory | content |
//! |---|---|
//! | `reconciliation` | what the run taught |
//! | `tif`, `transform`, `error_budget.json` | tool, place and errors of the next run |
//! | `plan` | next plan, in the coordinates of the part |
//! | `commanded`, `verdict` | its motion in those of the machine, and the verdict on it |
//! | `tolerance` | what the plan is expected to leave |
//! | `decision` | run again, or stop |

use std::path::Path;

use clap::Args;
use planish_handoff::{Failure, Status, say, warn, words};

use super::{
    campaign::specified,
    claim::Claim,
    execute::{Programs, Said},
    place::{Place, directory_name, name_of},
    run::end,
    several::{Given, Silent, command, is_directory, plain},
};

/// Remedy for a setting that is not given.
const NEEDED: &str = "give before=DIR after=DIR trajectory=DIR tif=DIR";

#[derive(Args)]
pub struct NextRun {
    /// Settings: before=DIR, after=DIR, trajectory=DIR and tif=DIR (the maps, the motion in the coordinates of the part,
    /// the tool), transform=DIR, error_budget=FILE, machine=FILE, pipeline, least_gain_percent, reconcile, and those of the
    /// pipeline
    #[arg(value_name = "NAME=VALUE", trailing_var_arg = true, allow_hyphen_values = true)]
    settings: Vec<String>,
}

/// Inputs of the last run.
struct Last {
    before: String,
    after: String,
    trajectory: String,
    tif: String,
    transform: Option<String>,
    error_budget: Option<String>,
}

impl Last {
    /// The inputs, which are there.
    fn take(given: &mut Given) -> Result<Self, Failure> {
        if let Some(word) = given.words.first() {
            return Err(Failure::new(format!("'{word}' is no setting; {NEEDED}")));
        }
        for name in ["surface", "fixture"] {
            if given.get(name).is_some() {
                return Err(Failure::new(format!(
                    "the map of the next plan is after=DIR; leave {name} out"
                )));
            }
        }
        if given.get("export").is_some() {
            return Err(Failure::new(
                "the program is that of the commanded motion; leave export out, and give planish-export OUT/commanded",
            ));
        }
        let mut needed = |name: &str| {
            let lacking = || Failure::new(format!("{name} is not given; {NEEDED}"));
            let path = given.take_path(name).ok_or_else(lacking)?;
            is_directory(name, &path).map(|()| path)
        };
        let [before, after, trajectory, tif] =
            [needed("before")?, needed("after")?, needed("trajectory")?, needed("tif")?];
        let transform = given.take_path("transform");
        if let Some(transform) = &transform {
            is_directory("transform", transform)?;
        }
        let error_budget = given.take_path("error_budget");
        if let Some(file) = error_budget.as_ref().filter(|file| !Path::new(file).is_file()) {
            return Err(Failure::new(format!(
                "error_budget {file} is no file; give the errors that are known beforehand"
            )));
        }
        Ok(Self { before, after, trajectory, tif, transform, error_budget })
    }
}

impl NextRun {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Place::find()?;
        let mut given = Given::new(&self.settings);
        let last = Last::take(&mut given)?;
        let definition =
            place.definition_of_plans(&given.take("pipeline").unwrap_or("raster".into()))?;
        let reconcile = given.take("reconcile").unwrap_or_default();
        let reconcile = words::split(&reconcile)
            .map_err(|e| Failure::new(format!("reconcile={reconcile}: {e}")))?;
        let least_gain_percent = given.take("least_gain_percent").unwrap_or("5".into());
        let out = given.take_path("out").unwrap_or_else(|| {
            let name =
                std::path::absolute(&last.after).map(|path| name_of(&path)).unwrap_or_default();
            format!("{}out/next-run/{}", place.home(), directory_name(&name))
        });
        let settings = [plain(&definition), given.settings.clone()].concat();
        let machine =
            place.settings(&definition, &settings)?.text("machine").map_err(Failure::new)?;
        let name =
            Path::new(&machine).file_name().unwrap_or_default().to_string_lossy().into_owned();
        let limits = format!("{out}/machine/{name}");
        let claim = Claim {
            out: out.clone().into(),
            pipeline: "next-run".into(),
            fixture: None,
            surface: Some(last.after.clone().into()),
            tif: Some(last.tif.clone().into()),
            machine: machine.into(),
        };
        let (_lock, assumed) = claim.take(&words::join(std::env::args()))?;
        assumed.into_iter().for_each(warn);
        let programs = Programs::new(&place, Said::Shown)?;
        let go_on = |program: &str, flags: &[&str]| match programs.run(&command(program, flags))? {
            0 | 1 => Ok::<(), Failure>(()),
            // Its message is printed.
            _ => std::process::exit(2),
        };
        let at = |part: &str| format!("{out}/{part}");
        let [tif, transform, learnt, commanded] =
            ["tif", "transform", "error_budget.json", "commanded"].map(at);
        let (tolerance, run) = (at("tolerance"), at("plan"));

        // Where the part lay, if nobody measured it: as the machine file says
        let lay = match &last.transform {
            Some(transform) => transform.clone(),
            None => {
                go_on(
                    "planish-register",
                    &["place", "--machine", &limits, "--out", &at("place"), "--force"],
                )?;
                at("place")
            }
        };
        let mut flags: Vec<&str> = reconcile.iter().map(String::as_str).collect();
        flags.extend([
            "--before",
            &last.before,
            "--after",
            &last.after,
            "--trajectory",
            &last.trajectory,
        ]);
        flags.extend(["--tif", &last.tif]);
        flags.extend(last.error_budget.iter().flat_map(|file| ["--error-budget", file]));
        let reconciliation = at("reconciliation");
        flags.extend(["--transform", &lay, "--out", &reconciliation, "--corrected-tif", &tif]);
        flags.extend([
            "--corrected-transform",
            &transform,
            "--learnt-error-budget",
            &learnt,
            "--force",
        ]);
        go_on("planish-reconcile", &flags)?;

        // The next plan, whose pages and tables are its own
        let own = [format!("surface={}", last.after), format!("tif={tif}"), format!("out={run}")];
        let plan = Silent::new(&place)?.pipeline(&definition, &[&settings[..], &own].concat())?;
        let planned = plan.scope.text("planned").map_err(Failure::new)?;
        let (motion, map) =
            (format!("{run}/methods/{planned}/trajectory"), format!("{run}/surface"));
        let over =
            ["--transform", &transform, "--trajectory", &motion, "--out", &commanded, "--force"];
        go_on("planish-register", &[&["apply"], &over[..]].concat())?;
        let verdict = at("verdict");
        go_on(
            "planish-verify",
            &["--trajectory", &commanded, "--machine", &limits, "--out", &verdict, "--force"],
        )?;
        let over =
            ["--trajectory", &motion, "--tif", &tif, "--surface", &map, "--error-budget", &learnt];
        go_on("planish-tolerance", &[&over[..], &["--out", &tolerance, "--force"]].concat())?;
        let is_specified = given.get("specification").is_some_and(|file| !file.is_empty());
        let judged = if is_specified { specified(&run, &planned) } else { vec![] };
        let (least, decision) =
            (format!("--least-gain-percent={least_gain_percent}"), at("decision"));
        let mut flags = vec![
            "decide",
            "--surface",
            &map,
            "--trajectory",
            &motion,
            "--tolerance",
            &tolerance,
            &least,
        ];
        flags.extend(judged.iter().map(String::as_str));
        flags.extend(["--out", &decision, "--force"]);
        say("");
        go_on("planish-campaign", &flags)?;
        say(format!("the plan: {run}/report/report.html\nits motion on the machine: {commanded}"));
        let method = format!("plan/methods/{planned}");
        let verdict = ["verdict", "--run", &out, "--plan", "plan", "--plan", &method];
        end(programs.run(&command("planish-run", &verdict))?)
    }
}
