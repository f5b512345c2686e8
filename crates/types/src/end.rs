//! Reasons why an iterative method ended.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Reason why an iterative method ended. Manifests and messages contain its name in kebab case.
/// Each stage decides which ends are a success.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum End {
    /// The result is optimal within its tolerance.
    Optimal,
    /// The last step changed less than the tolerance.
    Converged,
    /// The quantity that the method watches no longer changes, or another step is not worth its
    /// cost.
    Settled,
    /// The last round did not improve the result.
    NoImprovement,
    /// The quantity that the method watches has reached the requested threshold.
    Threshold,
    /// The next step would have made the result worse, so the method kept the one before.
    Stopped,
    /// The objective no longer changes, but there is no proof that it is the smallest.
    Stagnated,
    /// The requested number of steps is done.
    StepsDone,
    /// The requested number of rounds is done.
    RoundsDone,
    /// All requested prices of time, the weights of the time in the objective, are done.
    AllPrices,
    /// The method computes its result directly, without iterations.
    Direct,
    /// The largest allowed number of iterations is reached.
    IterationLimit,
    /// The largest allowed number of rounds is reached.
    RoundLimit,
    /// The largest allowed number of steps is reached.
    StepLimit,
    /// The largest allowed number of sweeps is reached.
    SweepLimit,
    /// The largest allowed number of lifts is reached. A lift adds a constant height to the map.
    LiftLimit,
    /// The removal on the links, the moves between two passes, still changed after the largest allowed number of
    /// rounds.
    LinkLimit,
}

impl fmt::Display for End {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn its_name_is_what_manifests_hold() {
        assert_eq!(End::Optimal.to_string(), "optimal");
        assert_eq!(End::IterationLimit.to_string(), "iteration-limit");
        assert_eq!(End::NoImprovement.to_string(), "no-improvement");
    }
}
