//! `planish compare`: every scheduler along three tool paths, on one mirror or on all of them.

use clap::Args;
use planish_handoff::{Failure, Status, warn};
use planish_pipeline::{
    definition::DIRECTORY_NAME,
    scope::{Scope, Words},
};

use super::{
    execute::{Messages, Programs, assumed_machine, run},
    place::Installation,
    run::end,
    several::{UserSettings, command},
};

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
        let skip = user.take("skip").unwrap_or_default();
        let given = user.take_path("out");
        let named = user.take_fixture()?;
        let is_all = named.as_deref() == Some("all");
        if is_all && (user.get("surface").is_some() || user.get("tif").is_some()) {
            return Err(Failure::new(
                "`all` compares the mirrors of fixtures/; leave surface and tif out, or all",
            ));
        }
        if !is_all && !skip.is_empty() {
            return Err(Failure::new(
                "skip leaves out mirrors of `all`; leave it out for one mirror",
            ));
        }
        let settings = user.settings;
        // The fixture of the first pipeline, if the user names no mirror.
        let definition = place.definition(PATHS[0])?;
        let named = named.map(|name| format!("fixture={name}"));
        let first = place.settings(&definition, &[named.as_slice(), &settings].concat())?;
        let text = |name: &str| first.text(name).map_err(Failure::new);
        let fixture = text("fixture")?;
        let out = match given {
            Some(out) => out,
            None => format!("out/compare/{}", text(DIRECTORY_NAME)?),
        };
        let mut mirrors = if is_all { place.fixtures() } else { vec![fixture] };
        mirrors.retain(|mirror| !skip.split_whitespace().any(|name| name == mirror));
        if mirrors.is_empty() {
            return Err(Failure::new("skip leaves out every mirror of fixtures/"));
        }
        let mut code = 0;
        let mut flags = vec!["report".to_string()];
        let mut about = Vec::new();
        let mut assumed_text = None;
        for fixture in &mirrors {
            for path in PATHS {
                let at = if is_all {
                    format!("{out}/{fixture}-{path}")
                } else {
                    format!("{out}/{path}")
                };
                let own = [
                    vec![format!("fixture={fixture}")],
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
                about = about_runs(&ended.scope, is_all).map_err(Failure::new)?;
                flags.push(at);
            }
        }
        flags.extend(about);
        flags.extend(["--out".into(), format!("{out}/report"), "--force".into()]);
        let ended =
            Programs::new(&place, Messages::Shown)?.run(&command("planish-compare", &flags))?;
        assumed_text.iter().for_each(warn);
        end(if ended == 0 { code } else { ended })
    }
}

/// Returns the flags of the report that are the same for all runs, from the scope of one of them. The runs of all
/// fixtures have no mirror and no tool in common.
fn about_runs(scope: &Scope<'_>, is_all: bool) -> Result<Vec<String>, String> {
    let mut flags = if is_all {
        ["--pipeline", "compare"].map(String::from).to_vec()
    } else {
        vec![format!("--mirror={}", scope.text("name")?), format!("--tif={}", scope.text("tool")?)]
    };
    for name in ["assumed", "stated"] {
        flags.extend(scope.words(name, &Words::new())?);
    }
    Ok(flags)
}
