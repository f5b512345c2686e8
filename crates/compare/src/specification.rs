//! Verdicts of `planish surface spec` on the maps of a run: before the run, predicted, and measured after it.
//!
//! | column | judged |
//! |---|---|
//! | before | the desired removal |
//! | a method | its predicted residual |
//! | after | the map as it was measured after the run, where it is known |

use planish_types::outcome::specification::SpecificationReport;
use serde::Serialize;

/// Verdicts by the specification on the maps that belong to no method.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Around {
    /// Verdict on the desired removal; `null` if there is none.
    pub before: Option<SpecificationReport>,
    /// Verdict on the map that was measured after the run; `null` if there is none.
    pub after: Option<SpecificationReport>,
}
