//! `planish compare`: every scheduler along three tool paths, on one mirror or on all of them.

use std::path::Path;

use clap::Args;
use planish_handoff::{Failure, Status, warn};
use planish_pipeline::scope::Words;

use super::{
    execute::{Messages, Programs, assumed_machine, run},
    place::{Installation, directory_name},
    run::end,
    several::{UserSettings, command, no_flag},
};

/// Returns the fixture that the first pipeline of `PATHS` uses by default.
fn default_fixture(place: &Installation) -> Result<String, Failure> {
    let definition = place.definition(PATHS[0])?;
    place.settings::<&str>(&definition, &[])?.text("fixture").map_err(Failure::new)
}

/// Names of the pipelines whose tool paths are compared.
const PATHS: [&str; 3] = ["raster", "maze", "random-adaptive"];

#[derive(Args)]
pub struct Compare {
    /// Name of a fixture (that of the pipeline raster without one), or `all` for every one; and settings of the pipelines,
    /// of which skip="NAME NAME" leaves mirrors of `all` out
    #[arg(value_name = "WORD", trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

impl Compare {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Installation::find()?;
        let mut user = UserSettings::new(&self.words)?;
        if user.get("export").is_some() {
            return Err(Failure::new("a comparison writes no programs; leave export out"));
        }
        let fixture = match user.take_fixture()? {
            None => default_fixture(&place)?,
            Some(fixture) => fixture,
        };
        let fixture = fixture.as_str();
        let skip = user.take("skip").unwrap_or_default();
        let out = user
            .take_path("out")
            .unwrap_or_else(|| format!("out/compare/{}", directory_name(fixture)));
        let tif = user.get("tif").map(|path| no_flag(&path)).unwrap_or_default();
        let settings = user.settings;
        let is_all = fixture == "all";
        if !is_all && !skip.is_empty() {
            return Err(Failure::new(
                "skip leaves out mirrors of `all`; leave it out for one mirror",
            ));
        }
        let mut mirrors = if is_all { place.fixtures() } else { vec![fixture.to_string()] };
        mirrors.retain(|mirror| !skip.split_whitespace().any(|name| name == mirror));
        if mirrors.is_empty() {
            return Err(Failure::new("skip leaves out every mirror of fixtures/"));
        }
        let mut runs = Vec::new();
        let mut code = 0;
        let mut assumed = Vec::new();
        let mut assumed_text = None;
        for mirror in &mirrors {
            for path in PATHS {
                let at =
                    if is_all { format!("{out}/{mirror}-{path}") } else { format!("{out}/{path}") };
                let own = [
                    vec![format!("fixture={mirror}")],
                    settings.clone(),
                    vec![format!("out={at}")],
                ];
                let definition = place.definition(path)?;
                let scope = place.scope(&definition, &own.concat())?;
                let ended = run(&place, scope, "compare", Messages::Shown)?;
                match ended.code {
                    one @ 0..=1 => code |= one,
                    other => return end(other),
                }
                assumed_text = assumed_machine(&ended.scope)?;
                assumed = ended.scope.words("assumed", &Words::new()).map_err(Failure::new)?;
                runs.push(at);
            }
        }
        let mut flags = [vec!["report".to_string()], runs].concat();
        if is_all {
            flags.extend(["--pipeline".into(), "compare".into()]);
        } else {
            // The tool is the same along every path: that of the fixture, or the user's as it is or as it was imported.
            let tif = if tif.is_empty() {
                format!("{out}/raster/fixture/tif")
            } else if Path::new(&tif).is_file() {
                format!("{out}/raster/import/tif")
            } else {
                tif
            };
            flags.extend([format!("--mirror={fixture}"), "--tif".into(), tif]);
        }
        flags.extend(assumed);
        flags.extend(["--out".into(), format!("{out}/report"), "--force".into()]);
        let ended =
            Programs::new(&place, Messages::Shown)?.run(&command("planish-compare", &flags))?;
        assumed_text.iter().for_each(warn);
        end(if ended == 0 { code } else { ended })
    }
}
