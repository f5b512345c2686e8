//! `planish tolerance`: effect of the errors of a process (its error budget) on the plans of several pipelines.

use std::{
    env, fs,
    io::{Write, stdout},
    path::{Path, PathBuf},
};

use clap::Args;
use planish_handoff::{Failure, Status, kind::MANIFEST, read_regular, say, tells_text, warn};
use serde_json::Value;

use super::{
    after_tool,
    execute::{Messages, Programs, assumed_machine},
    place::{Installation, name_of},
    run::end,
    several::{Silent, UserSettings, command},
};

/// Word of the command line that selects the reference mirror, in the folder that PLANISH_REFERENCE names.
const REFERENCE: &str = "reference";

#[derive(Args)]
pub struct Tolerance {
    /// Pipelines (raster and maze without any), their settings, and error_budget=FILE; `reference` is the mirror in
    /// PLANISH_REFERENCE, with residuals without their planes and a process of single errors. For a run of planish run
    /// several: run=DIR, draws=40, seed=1 and out=DIR, for the set-up errors of its tools
    #[arg(value_name = "WORD", trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

impl Tolerance {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Installation::find()?;
        let mut user = UserSettings::new(&self.words)?;
        if user.get("run").is_some() {
            return after_tool::tolerance(&mut user);
        }
        let is_reference = user.words.iter().any(|word| word == REFERENCE);
        let mut pipelines: Vec<&str> =
            user.words.iter().map(String::as_str).filter(|word| *word != REFERENCE).collect();
        let known = place.pipelines();
        if let Some(word) = pipelines.iter().find(|word| !known.iter().any(|name| name == *word)) {
            return Err(Failure::new(format!(
                "'{word}' is no pipeline and no setting; give raster, maze, NAME=VALUE"
            )));
        }
        if pipelines.is_empty() {
            pipelines = vec!["raster", "maze"];
        }
        let pipelines: Vec<String> = pipelines.into_iter().map(String::from).collect();
        let errors = if is_reference { "single-errors" } else { "ion-beam" };
        let error_budget = user.take_path("error_budget").unwrap_or_else(|| {
            format!("{}fixtures/error-budgets/{errors}.json", place.repository())
        });
        let out = user
            .take_path("out")
            .unwrap_or_else(|| format!("out/tolerance/{}", mirror(&user, is_reference)));
        if is_reference {
            for (part, path) in reference(Path::new(&out))? {
                user.settings.push(format!("{part}={}", path.display()));
            }
        }
        let mut ranks = Vec::new();
        let mut assumed = None;
        for pipeline in &pipelines {
            let definition = place.definition(pipeline)?;
            let at = format!("{out}/{pipeline}");
            let settings = [user.settings.clone(), vec![format!("out={at}")]].concat();
            let scope = Silent::new(&place)?.pipeline(&definition, &settings)?.scope;
            assumed = assumed_machine(&scope)?;
            let text = |name: &str| scope.text(name).map_err(Failure::new);
            let trajectory = format!("{}/{}/trajectory", text("methods")?, text("exported")?);
            // Not inside the run, whose report would hold it from the second run on.
            let own = format!("{out}/{pipeline}-tolerance");
            let free = if is_reference { "plane" } else { "piston" };
            let tif = text("constant_tool")?;
            let map = text("map")?;
            let flags = [
                &["--trajectory", &trajectory, "--tif", &tif, "--surface", &map][..],
                &["--error-budget", &error_budget, "--free", free, "--out", &own, "--force"],
            ];
            // The program goes on in this line.
            if tells_text() {
                let _ = write!(stdout(), "\n{pipeline}: ").and_then(|()| stdout().flush());
            }
            let code = Programs::new(&place, Messages::Shown)?
                .run(&command("planish-tolerance", &flags.concat()))?;
            if code != 0 {
                return end(code);
            }
            ranks.push((below_95_percent_nm(Path::new(&own))?, pipeline));
        }
        ranks.sort_by(|a, b| a.0.total_cmp(&b.0));
        say("\n95 % of the runs are below");
        for (below_nm, pipeline) in ranks {
            say(format!("{below_nm:10.4} nm  {pipeline}"));
        }
        assumed.iter().for_each(warn);
        Ok(Status::Done)
    }
}

/// Returns the name of the mirror (reference, map or fixture) as a name for a directory. It is `default` if the user
/// named no mirror, and `mirror` if its name is empty, hidden or has a slash.
fn mirror(user: &UserSettings, is_reference: bool) -> String {
    let name = match (
        is_reference,
        user.get("surface").filter(|path| !path.is_empty()),
        user.get("fixture"),
    ) {
        (true, ..) => REFERENCE.into(),
        (false, Some(surface), _) => name_of(&env::current_dir().unwrap_or_default().join(surface)),
        (false, None, Some(fixture)) => fixture,
        (false, None, None) => "default".into(),
    };
    if name.is_empty() || name.contains('/') || name.starts_with('.') {
        "mirror".into()
    } else {
        name
    }
}

/// Copies the surface and the tool influence function of the reference mirror to `out`, as arrays. Returns the settings
/// that name them, and their paths.
fn reference(out: &Path) -> Result<[(&'static str, PathBuf); 2], Failure> {
    let folder =
        env::var_os("PLANISH_REFERENCE").filter(|folder| !folder.is_empty()).ok_or_else(|| {
            Failure::new(
                "PLANISH_REFERENCE does not name the folder of the reference mirror; set it",
            )
        })?;
    let from = PathBuf::from(folder).join("nsls2-mirror");
    let places = ["surface", "tif"].map(|part| (part, out.join("mirror").join(part)));
    for (part, to) in &places {
        fs::create_dir_all(to)?;
        let (map, prefix, own) = match *part {
            "surface" => ("height_nm", "", "height_nm"),
            _ => ("tif_nm_per_s", "tif_", "rate_nm_per_s"),
        };
        let axes = ["x_mm", "y_mm"].map(|axis| (format!("{prefix}{axis}"), axis));
        for (name, own) in axes.into_iter().chain([(map.to_string(), own)]) {
            let file = from.join(format!("{name}.npy"));
            fs::copy(&file, to.join(format!("{own}.npy")))
                .map_err(|e| Failure::new(format!("{}: cannot be copied: {e}", file.display())))?;
        }
    }
    Ok(places)
}

/// Reads the residual RMS that 95 % of the runs stay below, nm, from the manifest of `planish tolerance`.
fn below_95_percent_nm(tolerance: &Path) -> Result<f64, Failure> {
    fn find(value: &Value) -> Option<f64> {
        match value {
            Value::Object(entries) => entries
                .get("below_95_percent_nm")
                .and_then(Value::as_f64)
                .or_else(|| entries.values().find_map(find)),
            Value::Array(items) => items.iter().find_map(find),
            _ => None,
        }
    }
    let file = tolerance.join(MANIFEST);
    let failed = |e: &dyn std::fmt::Display| {
        Failure::new(format!("{}: cannot be read: {e}", file.display()))
    };
    let text = read_regular(&file).map_err(|e| failed(&e))?;
    let manifest: Value = serde_json::from_slice(&text).map_err(|e| failed(&e))?;
    find(&manifest).ok_or_else(|| failed(&"it has no below_95_percent_nm"))
}
