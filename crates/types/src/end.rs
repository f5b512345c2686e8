//! How a method that goes step by step came to its end.

use std::fmt;

use serde::{Deserialize, Serialize};

/// How an iterative method ended. Manifests hold its name in kebab case, which is also how it is
/// displayed; whether a stage calls an end a success is for the stage to say.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum End {
    /// The result is optimal within its tolerance.
    Optimal,
    /// The last step changed less than the tolerance.
    Converged,
    /// What the method watches changes no more, or another step would not pay.
    Settled,
    /// No round improved the result any more.
    NoImprovement,
    /// The threshold that was asked for is reached.
    Threshold,
    /// The next step would have made it worse.
    Stopped,
    /// The objective changes no more, without a proof that it is the least.
    Stagnated,
    /// The number of steps that was asked for is done.
    StepsDone,
    /// The number of rounds that was asked for is done.
    RoundsDone,
    /// Every price that was asked for is done.
    AllPrices,
    /// The method does not iterate.
    Direct,
    /// As many iterations as are allowed.
    IterationLimit,
    /// As many rounds as are allowed.
    RoundLimit,
    /// As many steps as are allowed.
    StepLimit,
    /// As many sweeps as are allowed.
    SweepLimit,
    /// As many lifts of the map as are allowed.
    LiftLimit,
    /// What the links between the passes remove did not stand still in the rounds that are allowed.
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
