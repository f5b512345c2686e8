//! The problems: a part and a tool, a machine, and the errors of the process.

use planish_types::Invalid;
use serde::Deserialize;

/// A problem of the benchmark. Its files are named relative to the folder of the problem.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Problem {
    /// Name of the problem.
    pub name: String,
    /// Description of the problem.
    pub doc: String,
    /// Recipe of part and tool, with its seed; absent if they are measured.
    pub recipe: Option<String>,
    /// Measured part and tool; absent if they have a recipe.
    pub measured: Option<MeasuredPart>,
    /// Machine with its limits.
    pub machine: String,
    /// Errors of the process.
    pub error_budget: String,
}

/// A measured part and a tool, which `benchmark/measured.py` makes from files that are not part of the project.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredPart {
    /// Folder with the artifacts `surface` and `tif`.
    pub folder: String,
    /// BLAKE3 of the content of `surface`.
    pub surface_blake3: String,
    /// BLAKE3 of the content of `tif`.
    pub tif_blake3: String,
}

/// Source of a part and its tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Source<'a> {
    /// Recipe of part and tool.
    Recipe(&'a str),
    /// Maps that were measured.
    Measured(&'a MeasuredPart),
}

impl Problem {
    /// Returns the source of part and tool.
    ///
    /// # Errors
    /// Refuses a problem with both sources, and one with neither.
    pub fn source(&self) -> Result<Source<'_>, Invalid> {
        match (&self.recipe, &self.measured) {
            (Some(recipe), None) => Ok(Source::Recipe(recipe)),
            (None, Some(measured)) => Ok(Source::Measured(measured)),
            (Some(_), Some(_)) => Err(one_source("has both sources")),
            (None, None) => Err(one_source("has no source")),
        }
    }
}

/// Returns the refusal of a problem that has not one source.
fn one_source(problem: &str) -> Invalid {
    Invalid::whole("the part", problem, "give `recipe` or `measured`")
}
