//! Choice of the plan of a run that is to be executed.
//!
//! Only a motion within the limits of the machine can be chosen. If some of these keep the specification of the
//! mirror, only those can. Among them, the plan with the least
//!
//! ```text
//! RMS^2 T^(1/2)                                                                             (1)
//! ```
//!
//! is recommended. One percent more time is taken if it lowers the mean square by at least half a percent, as in
//! `planish joint` by default.

/// Exponent of the time in (1) of the module, dimensionless: percentage by which one percent more time must lower the
/// mean square. Larger: shorter runs. Smaller: a smaller residual. Chosen: the default of `planish joint`.
const TIME_ELASTICITY: f64 = 0.5;

/// A plan that may be recommended: a motion within the limits of the machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// RMS of the residual by which the plan is compared with others, nm.
    pub rms_nm: f64,
    /// Duration of the motion by which the plan is compared with others, s.
    pub total_time_s: f64,
    /// True if the residual keeps the specification, or if there is none.
    pub keeps_specification: bool,
}

impl Candidate {
    /// Returns the cost of the plan, (1) of the module, nm^2 s^(1/2).
    fn cost(&self) -> f64 {
        self.rms_nm * self.rms_nm * self.total_time_s.powf(TIME_ELASTICITY)
    }
}

/// Returns the plan that is to be executed, the first of equals; `None` if there are no candidates. Each pair is a
/// plan and its numbers.
pub fn recommended<T: Copy>(candidates: &[(T, Candidate)]) -> Option<T> {
    let some_keep = candidates.iter().any(|(_, c)| c.keeps_specification);
    let eligible = candidates.iter().filter(|(_, c)| c.keeps_specification || !some_keep);
    eligible.min_by(|(_, a), (_, b)| a.cost().total_cmp(&b.cost())).map(|(plan, _)| *plan)
}
