//! Manifest of an artifact, as a report needs it.

use planish_types::outcome::{StageStatus, plan::PlanOutcome};
use serde::Serialize;
use serde_json::Value;

/// Manifest of an artifact: what made it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Made {
    /// Keys that the page shows.
    pub shown: Shown,
    /// Reason of a negative status.
    pub reason: Option<String>,
    /// True if the artifact was made from dwell times, or from something that was.
    pub is_from_dwell_times: bool,
    /// Outcome of a stage that makes dwell times or a motion; empty for other artifacts.
    pub outcome: PlanOutcome,
}

/// Keys of a manifest that the page shows.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Shown {
    /// Role of the artifact in the run.
    pub role: String,
    /// Program.
    pub tool: String,
    /// Version of the program.
    pub tool_version: String,
    /// Subcommand of the program.
    pub method: String,
    /// Command line.
    pub command: String,
    /// Resolved settings.
    pub settings: Value,
    /// Inputs with their hashes.
    pub inputs: Value,
    /// Status of the stage at its end.
    pub status: Option<StageStatus>,
}
