//! `planish run`, `stage` and `show`: a pipeline, one stage of it, and its settings.

use std::{fs, path::Path};

use clap::Args;
use planish_handoff::{Failure, Status, keep_output, say};
use planish_pipeline::{
    description::{PipelineDescription, SettingDescription},
    kind::{Kind, unit},
};

use super::{
    execute::{Messages, run},
    place::Installation,
    several_tools,
};

#[derive(Args)]
pub struct RunPipeline {
    /// Name of the pipeline, such as raster
    pipeline: String,
    /// Settings of the pipeline
    #[arg(value_name = "NAME=VALUE", trailing_var_arg = true, allow_hyphen_values = true)]
    settings: Vec<String>,
}

#[derive(Args)]
pub struct Stage {
    /// Name of the pipeline, such as raster
    pipeline: String,
    /// Name of the stage, such as path or compare; the files in pipelines/ list them
    stage: String,
    /// Settings of the pipeline
    #[arg(value_name = "NAME=VALUE", trailing_var_arg = true, allow_hyphen_values = true)]
    settings: Vec<String>,
}

#[derive(Args)]
pub struct Show {
    /// Name of the pipeline, such as raster
    pipeline: String,
    /// Print the settings as JSON, with the names of the fixtures and of their machines
    #[arg(long)]
    json: bool,
}

impl RunPipeline {
    pub fn run(&self) -> Result<Status, Failure> {
        if self.pipeline == several_tools::NAME {
            return several_tools::run(&self.settings);
        }
        stage(&self.pipeline, "run", &self.settings)
    }
}

impl Stage {
    pub fn run(&self) -> Result<Status, Failure> {
        stage(&self.pipeline, &self.stage, &self.settings)
    }
}

fn stage(pipeline: &str, stage: &str, settings: &[String]) -> Result<Status, Failure> {
    let place = Installation::find()?;
    let definition = place.definition(pipeline)?;
    let scope = place.scope(&definition, settings)?;
    let ended = run(&place, scope, stage, Messages::Shown)?;
    let out = ended.scope.text("out").map_err(Failure::new)?;
    // Another stage than the report may be asked for, or the run ended before it.
    let summary = fs::read_to_string(Path::new(&out).join("report/summary.json")).ok();
    let summary = summary.and_then(|text| serde_json::from_str(&text).ok());
    keep_output(Path::new(&out), "run", summary.unwrap_or_default());
    end(ended.code)
}

/// Returns success for the exit code 0, and ends this process with any other. The program that failed has printed the
/// reason.
///
/// # Errors
/// Never fails; it fits the end of a command.
pub fn end(code: u8) -> Result<Status, Failure> {
    match code {
        0 => Ok(Status::Done),
        code => planish_handoff::exit(code),
    }
}

/// Width of the table of settings on the terminal, characters. Larger: lines break on a narrow terminal. Smaller: more
/// lines.
const WIDTH: usize = 110;
/// Column at which the description of a setting begins, characters. Larger: less room for it. Smaller: it collides with
/// the default.
const INDENT: usize = 64;

impl Show {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Installation::find()?;
        let definition = place.definition(&self.pipeline)?;
        let scope = place.settings::<&str>(&definition, &[])?;
        if self.json {
            let mut settings = Vec::new();
            for setting in &definition.settings {
                let default = scope.text(&setting.name).map_err(Failure::new)?;
                settings.push(SettingDescription::new(setting, default));
            }
            say(serde_json::to_string(&PipelineDescription {
                pipeline: definition.name.clone(),
                title: definition.title.clone(),
                folder: place.repository(),
                fixtures: place.fixtures(),
                machines: place.machines(),
                settings,
            })?);
            return Ok(Status::Done);
        }
        say(format!("{}: {}\n", definition.name, definition.title));
        say(format!("{:<22} {:<33} {:<7} what", "setting", "default", "unit"));
        say(format!("{:<22} {:<33} {:<7} ----", "-------", "-------", "----"));
        for setting in &definition.settings {
            let default = scope.text(&setting.name).map_err(Failure::new)?;
            let default = if default.is_empty() { "(empty)" } else { &default };
            let head = format!("{:<22} {default:<33} {:<7}", setting.name, unit(&setting.name));
            let values = match &setting.kind {
                Kind::OneOf { .. } | Kind::Whole { .. } => format!(" ({})", setting.kind.wanted()),
                _ => String::new(),
            };
            say(wrapped(head, &format!("{}{values}", setting.help)));
        }
        let name = &definition.name;
        say(format!(
            "\nGiven as NAME=VALUE: planish run {name} NAME=VALUE... The commands of each stage: pipelines/{name}.yaml and \
             shared.yaml."
        ));
        Ok(Status::Done)
    }
}

/// Returns a row of the table: the head, with the text wrapped to `WIDTH` in the column beside it.
fn wrapped(head: String, text: &str) -> String {
    let mut lines = vec![head];
    for word in text.split_whitespace() {
        let last = lines.last_mut().expect("the head is a line");
        if last.chars().count() + 1 + word.chars().count() > WIDTH {
            lines.push(format!("{:INDENT$} {word}", ""));
        } else {
            last.push(' ');
            last.push_str(word);
        }
    }
    lines.join("\n")
}
