//! Verdicts of `planish-surface spec` on the maps of a run: before, predicted, and measured after.
//!
//! | column | judged |
//! |---|---|
//! | before | the desired removal |
//! | a method | its predicted residual |
//! | after | the map as it was measured after the run, where it is known |

use planish_types::Invalid;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// The verdict on one map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Judged {
    /// Name of the specification.
    pub name: String,
    /// True if every limit is kept.
    pub passed: bool,
    /// Limit by limit.
    pub limits: Vec<JudgedLimit>,
}

/// The verdict on one limit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JudgedLimit {
    /// The quantity in words.
    pub quantity: String,
    /// Unit of value and limit.
    pub unit: String,
    /// Value of the map; `null` for infinity.
    pub value: Option<f64>,
    /// Value that is allowed; for a line under a spectrum, the one at the frequency where the spectrum is worst.
    pub limit: f64,
    /// `at-most` or `at-least`.
    pub bound: String,
    /// True if the limit is kept.
    pub passed: bool,
    /// Place or frequency at which it is worst.
    pub worst: Option<String>,
}

impl Judged {
    /// The verdict in the outcome of a specification artifact; `None` if the map was measured without a
    /// specification.
    pub fn from_json(outcome: &Value) -> Result<Option<Self>, Invalid> {
        Option::<Self>::deserialize(&outcome["specification"]).map_err(|e| {
            let problem = format!("has no usable outcome ({e})");
            Invalid::whole("specification", problem, "judge it again")
        })
    }
}

/// Verdicts on the maps that belong to no method.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Around {
    /// The desired removal.
    pub before: Option<Judged>,
    /// The map as it was measured after the run.
    pub after: Option<Judged>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_verdict_is_read_as_the_stage_writes_it() {
        let limit = json!({ "quantity": "radius", "unit": "m", "value": null, "limit": 2.0,
            "bound": "at-least", "passed": true, "worst": null });
        let outcome =
            json!({ "specification": { "name": "a", "passed": true, "limits": [limit] } });
        let found = Judged::from_json(&outcome).unwrap().unwrap();
        assert_eq!((found.passed, found.limits[0].value), (true, None));
        assert_eq!(Judged::from_json(&json!({ "specification": null })).unwrap(), None);
        let message = Judged::from_json(&json!({ "specification": 7 })).unwrap_err().to_string();
        assert!(message.contains("judge it again"), "{message}");
    }
}
