//! Manifest of an artifact: the fields that a report needs.

use planish_types::outcome::{StageStatus, plan::PlanOutcome};
use serde::Serialize;
use serde_json::Value;

/// Manifest of an artifact, which says what program made it and from which inputs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Made {
    /// Fields that the report page shows.
    pub shown: Shown,
    /// Reason of a negative status; `None` for a stage that is done.
    pub reason: Option<String>,
    /// True if the artifact was made from dwell times, directly or through other artifacts.
    pub is_from_dwell_times: bool,
    /// Outcome of a stage that makes dwell times or a motion; empty for other artifacts.
    pub outcome: PlanOutcome,
}

/// Fields of a manifest that the report page shows.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Shown {
    /// Role of the artifact in the run, which is the name of its directory, such as `trajectory`.
    pub role: String,
    /// Name of the program that made the artifact.
    pub tool: String,
    /// Version of the program that made the artifact.
    pub tool_version: String,
    /// Subcommand of the program that made the artifact.
    pub method: String,
    /// Command line that made the artifact.
    pub command: String,
    /// Settings of the stage with their values, defaults included.
    pub settings: Value,
    /// Inputs that the stage read, as JSON: role (flag), path, kind and BLAKE3 hash of each.
    pub inputs: Value,
    /// Status of the stage at its end; `None` if the manifest does not say.
    pub status: Option<StageStatus>,
}
