//! `planish campaign`: simulated runs on the virtual machine, each planned from the map after the one before. A
//! chain is one such sequence; one learns from its runs, one does not, and one knows the machine.
//!
//! | directory | content |
//! |---|---|
//! | `measured` | map before the first run |
//! | `first` | first plan, which all chains run |
//! | `learning/K` | run K and the results of its evaluation: measured, truth, reconciliation, tif, transform, error_budget.json, the next plan, tolerance, decision; from the second run on the motion that is commanded |
//! | `without/K` | run K without learning: measured, truth, the next plan |
//! | `known/K` | the same on a machine whose tool and part position are those of the plan |
//! | `alike` | a second mirror like the first, and its first run in each chain, planned at the end |
//! | `report` | table as a page |

use std::{
    io::{IsTerminal, stderr},
    path::Path,
    time::Instant,
};

use clap::Args;
use planish_handoff::{Failure, Status, warn, words};
use planish_pipeline::{definition::Definition, scope::Scope};
use planish_types::assumed_machine;

use super::{
    claim::{Claim, Named},
    execute::{Messages, Programs, as_typed},
    place::{Installation, directory_name, name_of},
    run::end,
    several::{Silent, UserSettings, command, count, with_plain},
};

#[derive(Args)]
pub struct Campaign {
    /// Name of a fixture (coupon without one), and settings: runs, seed, error_budget, least_gain_percent, pipeline,
    /// reconcile, and those of the pipeline. The map of a measured mirror (surface=DIR tif=DIR, two artifacts) is taken for
    /// the mirror itself
    #[arg(value_name = "WORD", trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

/// State of a campaign while it runs: its inputs, settings, and the number of plans so far.
struct Course<'a> {
    silent: Silent<'a>,
    definition: &'a Definition,
    /// Settings that every plan of the campaign gets, as NAME=VALUE.
    settings: Vec<String>,
    out: String,
    /// Artifact of the true surface error map; `tif` is that of the true tool influence function.
    surface: String,
    tif: String,
    /// File with the errors of the virtual machine, an error budget.
    error_budget: String,
    seed: String,
    runs: u32,
    least_gain_percent: String,
    reconcile: Vec<String>,
    is_specified: bool,
    /// Name of the plan in each run that is executed, such as `pvt`; empty before the first plan.
    planned: String,
    begun: Instant,
    made: u32,
}

impl Campaign {
    pub fn run(&self) -> Result<Status, Failure> {
        let code = campaign(&self.words, Messages::Shown)?;
        end(code)
    }
}

/// Runs a campaign. `words` are those of the command line; the last table goes to `messages`. Returns the exit code.
///
/// # Errors
/// Fails if a setting, an input or the directory is refused, or if a command cannot be run.
pub fn campaign(words: &[String], messages: Messages) -> Result<u8, Failure> {
    let place = Installation::find()?;
    let mut user = UserSettings::new(words)?;
    let fixture = user.take_fixture()?.unwrap_or("coupon".into());
    if user.get("export").is_some() {
        return Err(Failure::new("a campaign writes no programs; leave export out"));
    }
    let runs = count("runs", &user.take_or("runs", "3"), 99)?;
    let definition = place.definition_of_plans(&user.take_or("pipeline", "raster"))?;
    let [surface, tif] = take_mirror(&mut user)?;
    let reconcile = user.take_or("reconcile", "");
    let reconcile = words::split(&reconcile)
        .map_err(|e| Failure::new(format!("reconcile={reconcile}: {e}")))?;
    let error_budget = user
        .take_path("error_budget")
        .unwrap_or_else(|| format!("{}fixtures/error-budgets/hidden.json", place.repository()));
    let seed = user.take_or("seed", "1");
    let least_gain_percent = user.take_or("least_gain_percent", "5");
    let is_own = surface.is_some() || tif.is_some();
    let is_users = is_own
        || ["form", "varying"].iter().any(|name| user.get(name).is_some_and(|v| !v.is_empty()));
    let name = match &surface {
        Some(map) => name_of(&std::path::absolute(map)?),
        None => fixture.clone(),
    };
    let out =
        user.take_path("out").unwrap_or_else(|| format!("out/campaign/{}", directory_name(&name)));
    if !Path::new(&error_budget).is_file() {
        return Err(Failure::new(format!(
            "error_budget {error_budget} is no file; give the errors of the virtual machine (docs/tolerance.md)"
        )));
    }
    let settings = with_plain(&definition, &user);
    let scope = place.settings(&definition, &settings)?;
    let machine = scope.text("machine").map_err(Failure::new)?;
    let assumed_name = if is_users { user.assumed_machine(&machine)? } else { None };
    let assumed_machine = assumed_name.as_deref().map(assumed_machine);
    let recipe = format!("{}fixtures/{fixture}.json", place.repository());
    let claim = Claim {
        out: out.clone().into(),
        pipeline: "campaign".into(),
        fixture: if is_own { None } else { Some(recipe.clone().into()) },
        surface: surface.clone().map(Into::into),
        tif: tif.clone().map(Into::into),
        machine: machine.into(),
        named: named_words(&scope, &error_budget, &reconcile)?,
    };
    let (_lock, assumed) = claim.take(&as_typed())?;
    assumed.iter().chain(&assumed_machine).for_each(warn);
    let mut course = Course {
        silent: Silent::new(&place)?,
        definition: &definition,
        is_specified: user.get("specification").is_some_and(|file| !file.is_empty()),
        settings,
        surface: surface.unwrap_or_else(|| format!("{out}/fixture/surface")),
        tif: tif.unwrap_or_else(|| format!("{out}/fixture/tif")),
        out,
        error_budget,
        seed,
        runs,
        least_gain_percent,
        reconcile,
        planned: String::new(),
        begun: Instant::now(),
        made: 0,
    };
    if !is_own {
        let to = format!("{}/fixture", course.out);
        course.quiet("planish-fixture", &[&recipe, "--out", &to, "--force"])?;
    }
    course.run()?;
    let report = course.report(&name, assumed_name.as_deref());
    let code = Programs::new(&place, messages)?.run(&report)?;
    assumed_machine.iter().for_each(warn);
    Ok(code)
}

/// Takes the settings `surface` and `tif` of a measured mirror out; `None` for one that is not given. Refuses files,
/// because both must be artifacts.
fn take_mirror(user: &mut UserSettings) -> Result<[Option<String>; 2], Failure> {
    let mirror = [user.take_path("surface"), user.take_path("tif")];
    if let Some(map) = mirror.iter().flatten().find(|map| Path::new(map).is_file()) {
        return Err(Failure::new(format!(
            "{map} is a file; read it with planish import, and give the directory"
        )));
    }
    Ok(mirror)
}

/// Returns the words of the settings of the plans and of the campaign that may name an input file. The claim on the
/// directory checks them.
fn named_words(
    scope: &Scope,
    error_budget: &str,
    reconcile: &[String],
) -> Result<Vec<Named>, Failure> {
    let named = [
        Named::all(scope)?,
        Named::words("error_budget", &[error_budget.to_string()], true),
        Named::words("reconcile", reconcile, false),
    ];
    Ok(named.into_iter().flatten().collect())
}

impl Course<'_> {
    /// Runs all three chains (learning, without learning, machine known), then a second mirror like the first one.
    fn run(&mut self) -> Result<(), Failure> {
        let measured = format!("{}/measured", self.out);
        self.measure(&measured, None)?;
        let first = format!("{}/first", self.out);
        let tif = self.tif.clone();
        self.plan(&first, &measured, &tif)?;
        for (chain, flags) in [("without", &[][..]), ("known", &["--known"])] {
            self.without_learning(chain, flags)?;
        }
        let learnt_tif = self.learning()?;
        self.alike(&learnt_tif)
    }

    /// Runs a chain whose plans use the original tool influence function and no result of earlier runs. `flags` go to
    /// the virtual machine.
    fn without_learning(&mut self, chain: &str, flags: &[&str]) -> Result<(), Failure> {
        let mut map = format!("{}/measured", self.out);
        let mut run = format!("{}/first", self.out);
        let tif = self.tif.clone();
        for k in 1..=self.runs {
            let at = format!("{}/{chain}/{k}", self.out);
            self.machine_runs(&at, k, &map, &self.motion(&run), flags)?;
            map = format!("{at}/measured");
            run = format!("{at}/plan");
            if k < self.runs {
                self.plan(&run, &map, &tif)?;
            }
        }
        Ok(())
    }

    /// Runs the chain that learns: every run corrects tool, position and errors for the next. Returns the artifact of
    /// the tool influence function after the last run.
    fn learning(&mut self) -> Result<String, Failure> {
        let mut map = format!("{}/measured", self.out);
        let mut run = format!("{}/first", self.out);
        let mut tool = self.tif.clone();
        let mut knowledge = self.error_budget.clone();
        let mut place: Option<String> = None;
        for k in 1..=self.runs {
            let at = format!("{}/learning/{k}", self.out);
            let motion = self.motion(&run);
            let mut commanded = motion.clone();
            // The plan goes to where the part lies by what was learnt so far.
            if let Some(place) = &place {
                commanded = format!("{at}/commanded");
                self.command_motion(place, &motion, &commanded)?;
            }
            self.machine_runs(&at, k, &map, &commanded, &[])?;
            let [measured, reconciliation, tif, transform, learnt] =
                ["measured", "reconciliation", "tif", "transform", "error_budget.json"]
                    .map(|part| format!("{at}/{part}"));
            let mut flags = [
                &["--before", &map, "--after", &measured][..],
                &["--trajectory", &motion, "--tif", &tool],
                &["--error-budget", &knowledge],
            ]
            .concat();
            if let Some(place) = &place {
                flags.extend(["--transform", place]);
            }
            flags.extend([
                "--out",
                &reconciliation,
                "--corrected-tif",
                &tif,
                "--corrected-transform",
                &transform,
            ]);
            // The virtual machine measures all maps in the same way.
            flags.extend(["--learnt-error-budget", &learnt, "--same-measurement", "--force"]);
            let words: Vec<&str> = self.reconcile.iter().map(String::as_str).chain(flags).collect();
            self.silent.command(&command("planish-reconcile", &words))?;
            map = measured;
            run = format!("{at}/plan");
            tool = tif;
            knowledge = learnt;
            place = Some(transform);
            self.plan(&run, &map, &tool)?;
            self.decide(&at, &run, &tool, &knowledge)?;
        }
        Ok(tool)
    }

    /// Computes the residual that the next plan is expected to leave, and decides whether the run is worth its time.
    /// Both results go to the directory `at`. `knowledge` is the file with the errors of the process. `run` is the
    /// directory of the next plan, and `tool` the TIF with which it was made.
    fn decide(&mut self, at: &str, run: &str, tool: &str, knowledge: &str) -> Result<(), Failure> {
        let motion = self.motion(run);
        let map = format!("{run}/surface");
        let [tolerance, decision] = ["tolerance", "decision"].map(|part| format!("{at}/{part}"));
        let over = [
            "--trajectory",
            &motion,
            "--tif",
            tool,
            "--surface",
            &map,
            "--error-budget",
            knowledge,
        ];
        self.quiet("planish-tolerance", &[&over[..], &["--out", &tolerance, "--force"]].concat())?;
        let judged = if self.is_specified { specified(run, &self.planned) } else { vec![] };
        let least = format!("--least-gain-percent={}", self.least_gain_percent);
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
        self.quiet("planish-campaign", &flags)
    }

    /// Plans and runs a second mirror like the first one, as a further run of each chain. `tool` is the tool influence
    /// function that was learnt.
    fn alike(&mut self, tool: &str) -> Result<(), Failure> {
        let runs = self.runs;
        let k = runs + 1;
        let at = format!("{}/alike", self.out);
        let measured = format!("{at}/measured");
        let first = format!("{at}/first");
        let last = format!("{at}/plan-after-{runs}");
        let tif = self.tif.clone();
        self.measure(&measured, Some(k))?;
        self.plan(&first, &measured, &tif)?;
        let motion = self.motion(&first);
        self.machine_runs(&format!("{at}/without"), k, &measured, &motion, &[])?;
        self.machine_runs(&format!("{at}/known"), k, &measured, &motion, &["--known"])?;
        self.plan(&last, &measured, tool)?;
        let commanded = format!("{at}/commanded");
        self.command_motion(
            &format!("{}/learning/{runs}/transform", self.out),
            &self.motion(&last),
            &commanded,
        )?;
        self.machine_runs(&format!("{at}/learning"), k, &measured, &commanded, &[])
    }

    /// Returns the path of the trajectory of the executed plan in the directory `run`.
    fn motion(&self, run: &str) -> String {
        format!("{run}/methods/{}/trajectory", self.planned)
    }

    /// Simulates the measurement of the true map into the directory `to`. `run_number` selects the random errors of the
    /// measurement: those before this run, from 1; `None` takes those before run 1.
    fn measure(&mut self, to: &str, run_number: Option<u32>) -> Result<(), Failure> {
        let seed = format!("--seed={}", self.seed);
        let number = run_number.map(|k| format!("--run-number={k}"));
        let mut flags = vec![
            "measure",
            "--surface",
            &self.surface,
            "--error-budget",
            &self.error_budget,
            &seed,
        ];
        flags.extend(number.as_deref());
        flags.extend(["--out", to, "--force"]);
        self.silent.command(&command("planish-campaign", &flags)).map(|_| ())
    }

    /// Transforms the trajectory `motion` to where the part lies on the machine, and writes it to the directory `to`.
    fn command_motion(&mut self, transform: &str, motion: &str, to: &str) -> Result<(), Failure> {
        let flags =
            ["apply", "--transform", transform, "--trajectory", motion, "--out", to, "--force"];
        self.quiet("planish-register", &flags)
    }

    /// Runs `motion` on the virtual machine with the true tool, as run number `k` from the map `map`. `more` are
    /// further flags. The directory `at` gets the map that is measured afterwards (`measured`) and the true result
    /// (`truth`).
    fn machine_runs(
        &mut self,
        at: &str,
        k: u32,
        map: &str,
        motion: &str,
        more: &[&str],
    ) -> Result<(), Failure> {
        let seed = format!("--seed={}", self.seed);
        let number = format!("--run-number={k}");
        let [measured, truth] = ["measured", "truth"].map(|part| format!("{at}/{part}"));
        let flags = [
            &["--trajectory", motion, "--tif", &self.tif, "--surface", map][..],
            &["--error-budget", &self.error_budget, &seed, &number],
            more,
            &["--measured-out", &measured, "--out", &truth, "--force"],
        ];
        self.silent.command(&command("planish-simulate", &flags.concat())).map(|_| ())
    }

    /// Plans a run for a map and a tool influence function, in the directory `at`. Plans take nearly all the time of a
    /// campaign, so a terminal is told their number and the remaining time.
    fn plan(&mut self, at: &str, map: &str, tool: &str) -> Result<(), Failure> {
        let own = [format!("surface={map}"), format!("tif={tool}"), format!("out={at}")];
        let settings = [&self.settings[..], &own].concat();
        let ended = self.silent.pipeline(self.definition, &settings)?;
        self.planned = ended.scope.text("planned").map_err(Failure::new)?;
        self.made += 1;
        let plans = 3 * self.runs + 1;
        let took_s = self.begun.elapsed().as_secs_f64();
        if stderr().is_terminal() {
            let left_s = took_s * f64::from(plans.saturating_sub(self.made)) / f64::from(self.made);
            eprintln!(
                "plan {} of {plans} after {took_s:.0} s, about {left_s:.0} s left",
                self.made
            );
        }
        Ok(())
    }

    /// Runs a command without printing its messages, unless it fails.
    fn quiet(&mut self, program: &str, flags: &[&str]) -> Result<(), Failure> {
        self.silent.command(&command(program, flags)).map(|_| ())
    }

    /// Returns the command that writes the report page of the campaign. `name` is that of the mirror.
    fn report(
        &self,
        name: &str,
        assumed_machine: Option<&str>,
    ) -> planish_pipeline::walk::StageCommand {
        let runs = format!("--runs={}", self.runs);
        let mirror = format!("--mirror={name}");
        let out = format!("{}/report", self.out);
        let assumed = assumed_machine.map(|name| format!("--assumed-machine={name}"));
        let mut flags = vec!["report", &self.out, "--surface", &self.surface, &runs, &mirror];
        flags.extend(assumed.as_deref());
        flags.extend(["--out", &out, "--force"]);
        command("planish-campaign", &flags)
    }
}

/// Returns the flags that name two verdicts on a specification: on the map before the next run, and on the residual
/// that its plan predicts. `run` is the directory of the plan, and `planned` the name of its method.
pub fn specified(run: &str, planned: &str) -> Vec<String> {
    let [now, next] =
        ["before", planned].map(|part| format!("{run}/specified/{part}/specification"));
    vec!["--specified-now".into(), now, "--specified-next".into(), next]
}
