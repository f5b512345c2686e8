//! Which plan of a run is to be executed.
//!
//! Only a motion within the limits of the machine is one; where some keep the specification of the mirror, only those
//! are. Of what is left, the plans whose RMS is at most 5 % above the least differ by less than the errors of a process
//! add, so their time counts: recommended is the least of
//!
//! ```text
//! RMS^2 T^(1/2)                                                                             (1)
//! ```
//!
//! One percent more time is worth taking where it lowers the mean square by at least half a percent, which is also what
//! `planish-feed` plans for by default.

/// By how much the RMS of a recommended plan may be above the least one, over it.
const NEGLIGIBLE_RMS: f64 = 0.05;

/// By how many percent one percent more time must lower the mean square.
const TIME_ELASTICITY: f64 = 0.5;

/// A motion within the limits of the machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// RMS of its residual, nm.
    pub rms_nm: f64,
    /// Its time, s.
    pub total_time_s: f64,
    /// Whether its residual keeps the specification; true where none was asked.
    pub keeps_specification: bool,
}

impl Candidate {
    /// (1)
    fn cost(&self) -> f64 {
        self.rms_nm * self.rms_nm * self.total_time_s.powf(TIME_ELASTICITY)
    }
}

/// The name of the plan that is to be executed, the first of equals.
pub fn recommended<'a>(candidates: &[(&'a str, Candidate)]) -> Option<&'a str> {
    let some_keep = candidates.iter().any(|(_, c)| c.keeps_specification);
    let eligible = || candidates.iter().filter(|(_, c)| c.keeps_specification || !some_keep);
    let least_nm = eligible().map(|(_, c)| c.rms_nm).reduce(f64::min)?;
    eligible()
        .filter(|(_, c)| c.rms_nm <= (1.0 + NEGLIGIBLE_RMS) * least_nm)
        .min_by(|(_, a), (_, b)| a.cost().total_cmp(&b.cost()))
        .map(|(name, _)| *name)
}
