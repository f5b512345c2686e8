//! `planish compare figures`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use planish_compare::{
    report::{
        RunData,
        figure::{Layout, figures},
        views,
    },
    typeset,
};
use planish_handoff::{Failure, Inputs, Output, Status, flags::OutputArgs, kind, say, task};
use planish_types::text::visible;
use rayon::prelude::*;
use serde_json::json;

use super::super::files::{self, Names};

#[derive(Args)]
pub struct Figures {
    /// Run: a directory with surface/ and methods/<scheduler>/{trajectory,removal,verdict}/
    #[arg(required = true, value_name = "RUN_DIR")]
    runs: Vec<PathBuf>,
    /// File format of the figures: pdf (180 mm wide, fonts embedded), png (300 pixels an inch) or svg
    #[arg(long, value_enum)]
    format: Format,
    /// Resolution of a PNG [default: 300, 2126 pixels a line]
    #[arg(long, value_name = "PIXELS_PER_INCH")]
    dpi: Option<f64>,
    /// Method that is drawn [default: the plan that is recommended]
    #[arg(long, value_name = "NAME")]
    method: Option<String>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum Format {
    Pdf,
    Png,
    Svg,
}

impl Format {
    fn extension(self) -> &'static str {
        match self {
            Self::Pdf => "pdf",
            Self::Png => "png",
            Self::Svg => "svg",
        }
    }
}

impl Figures {
    pub fn run(&self) -> Result<Status, Failure> {
        let Figures { runs, format, dpi, method, output } = self;
        let dpi = match (format, dpi) {
            (_, None) => typeset::PNG_DPI,
            (Format::Png, Some(dpi)) if typeset::PNG_DPI_RANGE.contains(dpi) => *dpi,
            (Format::Png, Some(dpi)) => {
                let [low, high] = [typeset::PNG_DPI_RANGE.start(), typeset::PNG_DPI_RANGE.end()];
                let message = format!("--dpi: is {dpi}; give {low} to {high} pixels an inch");
                return Err(Failure::new(message));
            }
            (_, Some(_)) => {
                let message = "--dpi is of a PNG; leave it out, or give --format png";
                return Err(Failure::new(message));
            }
        };
        let mut inputs = Inputs::new();
        let names: Vec<String> = runs.iter().map(|dir| files::name_of(dir)).collect();
        let task = task!(
            "figures",
            json!({ "runs": names, "format": format.extension(), "dpi": dpi, "method": method })
        );
        let called = Names {
            pipeline: None,
            fixture: "",
            measured: None,
            tif: None,
            form: None,
            after_servo: false,
        };
        let read = runs.iter().enumerate();
        let read = read.map(|(i, dir)| {
            let run = files::read_run(&mut inputs, i, dir, &called)?;
            with_one_method(run, method.as_deref())
                .map_err(|problem| Failure::new(format!("{}: {problem}", dir.display())))
        });
        let read = read.collect::<Result<Vec<_>, Failure>>()?;
        let Some(mut writer) =
            Output::directory(output, &kind::FIGURES).begin(&task, &inputs)?.writer()
        else {
            return Ok(Status::Done);
        };
        let drawn = figures(&views(read), &Layout::PAPER);
        let printed = drawn.into_par_iter().map(|(name, svg)| {
            let bytes = match format {
                Format::Pdf => typeset::pdf(&svg)?,
                Format::Png => typeset::png(&svg, dpi)?,
                Format::Svg => svg.into_bytes(),
            };
            Ok((format!("{name}.{}", format.extension()), bytes))
        });
        let printed: Vec<(String, Vec<u8>)> = printed.collect::<Result<_, Failure>>()?;
        let count = printed.len();
        let beside: Vec<(&str, Vec<u8>)> =
            printed.iter().map(|(name, bytes)| (name.as_str(), bytes.clone())).collect();
        writer.write_arrays(&kind::FIGURES, &[], &beside, json!({}), &Status::Done)?;
        let listed: Vec<&str> = printed.iter().map(|(name, _)| name.as_str()).collect();
        say(format!(
            "{count} figures -> {}: {}",
            visible(&output.out.to_string_lossy()),
            listed.join(", ")
        ));
        Ok(Status::Done)
    }
}

/// Returns the run with only the method that is to be drawn: `wanted`, or the recommended one. Refuses a name that no
/// valid method has, and `None` if no plan is recommended; the error says which methods there are.
fn with_one_method(mut run: RunData, wanted: Option<&str>) -> Result<RunData, String> {
    let there: Vec<String> = run.methods.iter().map(|m| m.name.clone()).collect();
    let there = there.join(", ");
    let Some(name) = wanted.map(String::from).or_else(|| run.summary.best.clone()) else {
        return Err(format!(
            "no plan keeps the limits; name the method to draw (--method): {there}"
        ));
    };
    run.methods.retain(|m| m.name == name);
    if run.methods.is_empty() {
        return Err(format!("has no valid method {name:?}; there is: {there}"));
    }
    Ok(run)
}
