//! Settings of stages that others read from a manifest.

use serde::{Deserialize, Serialize};

use super::NoMore;
use crate::ControllerKind;

/// Settings of a tool path that others read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
pub struct PathSettings {
    /// Distance by which the path goes beyond the aperture, mm; left out by a path of another program.
    pub overscan_mm: Option<f64>,
}

/// Settings of a program of a controller that was read back.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProgramSettings<More = NoMore> {
    /// Controller of the program.
    pub controller: ControllerKind,
    /// Further settings.
    #[serde(flatten)]
    pub more: More,
}
