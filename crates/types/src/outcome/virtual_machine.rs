//! Outcome of a run of the virtual machine of `planish simulate`.

use serde::{Deserialize, Serialize};

use super::{NoMore, removal::RemovalOutcome};

/// Settings of a run that others read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
pub struct RunSettings {
    /// Random seed of what is hidden.
    pub seed: u64,
    /// Number of the run of this machine, from 1.
    pub run: u64,
    /// True if rate, place, width and shape of the tool are known and corrected exactly; all other errors stay.
    pub known: bool,
}

/// Outcome of a run: the true residual, and what is hidden.
pub type TruthOutcome<More = NoMore> = RemovalOutcome<HiddenOutcome<More>>;

/// Further numbers of the outcome of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HiddenOutcome<More = NoMore> {
    /// Errors of the run.
    pub hidden: Hidden,
    /// Further numbers.
    #[serde(flatten)]
    pub more: More,
}

/// Value of one error in this run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Drawn {
    /// Kind of the error.
    pub kind: String,
    /// The number that it drew, in `unit`; `None` of noise, which draws many.
    pub value: Option<f64>,
    /// The unit that the error budget states.
    pub unit: String,
}

/// Values that nobody at the machine sees.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hidden {
    /// Sums of what acts on the same quantity.
    pub truth: Truth,
    /// Every error of the process.
    #[serde(default)]
    pub errors: Vec<Drawn>,
}

/// Errors that act throughout a run: fractions, mm and rad.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)] // what each is stands at the kinds of a process
pub struct Truth {
    pub rate_scale: f64,
    pub offset_x_mm: f64,
    pub offset_y_mm: f64,
    pub rotation_rad: f64,
    pub magnification: f64,
    #[serde(default)]
    pub shear: f64,
    pub tif_width: f64,
    pub tif_ellipticity: f64,
    pub tif_diagonal_ellipticity: f64,
    pub tif_rotation_rad: f64,
}
