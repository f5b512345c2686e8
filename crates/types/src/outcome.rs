//! Outcomes of stages as plain data: what a manifest holds. A stage writes its outcome as one of these types, and
//! every other stage reads it through the same type.
//!
//! The names of the fields are keys of manifests, so they are part of the format. A field that a foreign program may
//! leave out is an `Option` or has a default. An outcome with the type parameter `More` has further numbers that only
//! its stage knows; nobody else reads them.

pub mod abort;
pub mod axes;
pub mod bound;
pub mod plan;
pub mod reconciliation;
pub mod removal;
pub mod report;
pub mod settings;
pub mod specification;
pub mod sweep;
pub mod tolerance;
pub mod verdict;
pub mod virtual_machine;

use serde::{Deserialize, Deserializer, Serialize};

/// Status of a stage at its end. Every outcome begins with it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StageEnd {
    /// Status; absent where a foreign program does not state one, which counts as done.
    pub status: Option<StageStatus>,
    /// Reason of a negative status.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// Statuses of a stage at its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StageStatus {
    /// The result is not what the settings ask for: not converged, or a limit exceeded.
    Negative,
    /// The result is what the settings ask for.
    #[serde(other)]
    Done,
}

/// Content of the file of `--wall-time`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WallTime {
    /// Wall time of the stage, s.
    pub wall_s: f64,
    /// Peak memory of the process, in 2^20 bytes; `None` if the system does not report it.
    pub peak_memory_mb: Option<f64>,
}

/// No further numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct NoMore {}

/// Reads a number, NaN for `null`. JSON has `null` for a number that is not finite.
fn null_is_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

/// Reads a number, infinity for `null`.
fn null_is_infinity<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::INFINITY))
}
