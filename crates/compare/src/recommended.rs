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

use crate::summary::Method;

/// By how much the RMS of a recommended plan may be above the least one, over it.
const NEGLIGIBLE_RMS: f64 = 0.05;

/// By how many percent one percent more time must lower the mean square.
const TIME_ELASTICITY: f64 = 0.5;

/// The plan of `methods` that is to be executed, the first of equals.
pub fn recommended(methods: &[(String, Method)]) -> Option<&(String, Method)> {
    let candidates = || methods.iter().filter(|(_, m)| m.is_candidate());
    let keeps = |m: &Method| m.specification.as_ref().is_none_or(|judged| judged.passed);
    let some_keep = candidates().any(|(_, m)| keeps(m));
    let eligible = || candidates().filter(|(_, m)| keeps(m) || !some_keep);
    let least_nm = eligible().map(|(_, m)| m.rms_nm).reduce(f64::min)?;
    let cost = |m: &Method| m.rms_nm * m.rms_nm * m.total_time_s.powf(TIME_ELASTICITY);
    eligible()
        .filter(|(_, m)| m.rms_nm <= (1.0 + NEGLIGIBLE_RMS) * least_nm)
        .min_by(|(_, a), (_, b)| cost(a).total_cmp(&cost(b)))
}
