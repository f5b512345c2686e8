//! The certificate: how far the objective (1) of [`crate::bounded_least_squares`] can be above its minimum.
//!
//! It is proven by the exact gradient alone, so whatever the surrogate does, the claim in the report holds.

/// By how much (1) can still fall, at most. With the diagonal C of the Tikhonov term, `c_j = alpha D A / a_j`, H is
/// at least C, so
///
/// ```text
/// f(t) - min f <= sum_j max over lo <= s <= hi of q_j (t_j - s) - c_j (t_j - s)^2 / 2
/// ```
///
/// It is the gap of Fenchel's dual at the residual of t, with the c_j alone of the penalty's
/// curvature: the bounds are exact in it, and where they are finite a component adds at most
/// `q_j (t_j - lo_j)` or `q_j (t_j - hi_j)`, whatever c_j.
///
/// `None` without alpha.
pub fn gap(
    t: &[f64],
    q: &[f64],
    lo: &[f64],
    hi: &[f64],
    c: &[f64],
    reached: &[bool],
) -> Option<f64> {
    // p: from t to the best s,  max over s = q_j p - c_j p^2 / 2
    let of = |j: usize| {
        let p = t[j] - (t[j] - q[j] / c[j]).clamp(lo[j], hi[j]);
        p * (q[j] - 0.5 * c[j] * p)
    };
    c.iter().all(|c| *c > 0.0).then(|| (0..t.len()).filter(|j| reached[*j]).map(of).sum())
}
