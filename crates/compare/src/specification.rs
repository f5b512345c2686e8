//! Verdicts of `planish-surface spec` on the maps of a run: before, predicted, and measured after.
//!
//! | column | judged |
//! |---|---|
//! | before | the desired removal |
//! | a method | its predicted residual |
//! | after | the map as it was measured after the run, where it is known |

use planish_types::outcome::specification::SpecificationReport;
use serde::Serialize;

/// Verdicts on the maps that belong to no method.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Around {
    /// The desired removal.
    pub before: Option<SpecificationReport>,
    /// The map as it was measured after the run.
    pub after: Option<SpecificationReport>,
}
