//! The certificate: how far the objective (1) of [`crate::bounded_least_squares`] can be above its minimum.
//!
//! It is proven by the exact gradient alone, so whatever the surrogate does, the claim in the report holds.

/// By how much (1) can still fall, at most. H is at least `alpha D`, so
///
/// ```text
/// f(t) - min f <= sum_j max over lo <= s <= hi of q_j (t_j - s) - alpha D (t_j - s)^2 / 2
/// ```
///
/// It is the gap of Fenchel's dual at the residual of t, with the alpha D alone of the penalty's
/// curvature: the bounds are exact in it, and where they are finite a component adds at most
/// `q_j (t_j - lo_j)` or `q_j (t_j - hi_j)`, whatever alpha.
///
/// `None` without alpha.
pub fn gap(
    t: &[f64],
    q: &[f64],
    lo: &[f64],
    hi: &[f64],
    alpha_d: f64,
    reached: &[bool],
) -> Option<f64> {
    // p: from t to the best s,  max over s = q_j p - alpha D p^2 / 2
    let of = |j: usize| {
        let p = t[j] - (t[j] - q[j] / alpha_d).clamp(lo[j], hi[j]);
        p * (q[j] - 0.5 * alpha_d * p)
    };
    (alpha_d > 0.0).then(|| (0..t.len()).filter(|j| reached[*j]).map(of).sum())
}
