//! The certificate: how far the objective (1) of [`crate::bounded_least_squares`] can be above its minimum.
//!
//! It is proven by the exact gradient alone, so the bound in the report holds whatever the surrogate does.

/// Returns an upper bound of the decrease of the objective (1) that is still possible at dwell times t with the
/// gradient q. H is at least the diagonal matrix C of the Tikhonov term, `c_j = alpha K A / a_j`, so
///
/// ```text
/// f(t) - min f <= sum_j max over lo <= s <= hi of q_j (t_j - s) - c_j (t_j - s)^2 / 2
/// ```
///
/// with the sum over the reached dwell points j. It is the gap of Fenchel's dual at the residual of t, with no
/// curvature of the penalty but the c_j. Where the bounds are finite, a dwell time adds at most `q_j (t_j - lo_j)` or
/// `q_j (t_j - hi_j)`, whatever c_j.
///
/// The dwell times t may be beyond their bounds: `f(t)` minus the result is a lower bound of the minimum there, too.
///
/// Returns `None` if alpha is 0, so that the `c_j` are not above 0.
pub fn gap(
    t: &[f64],
    q: &[f64],
    lo: &[f64],
    hi: &[f64],
    c: &[f64],
    reached: &[bool],
) -> Option<f64> {
    if !c.iter().all(|c| *c > 0.0) {
        return None;
    }
    let terms = (0..t.len()).filter(|j| reached[*j]).map(|j| {
        // p: from t to the best s,  max over s = q_j p - c_j p^2 / 2
        let p = t[j] - (t[j] - q[j] / c[j]).clamp(lo[j], hi[j]);
        p * (q[j] - 0.5 * c[j] * p)
    });
    Some(terms.sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_numerics::{
        linear::skyline::{Skyline, dot},
        qp::bounded::{LastFactor, Quadratic, active_set},
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn it_is_a_bound_anywhere_and_tight_at_the_minimum() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        for case in 0..200 {
            let n = 1 + case % 11;
            // f = t'Ht / 2 - g't,  H = B'B + C
            let mut random = |low: f64, high: f64| -> Vec<f64> {
                (0..n).map(|_| rng.random_range(low..high)).collect()
            };
            let c = random(0.05, 0.5);
            let b: Vec<Vec<f64>> = (0..n).map(|_| random(-1.0, 1.0)).collect();
            let g = random(-2.0, 2.0);
            let mut k = Skyline::zeros(vec![0; n]);
            k.fill(|i, row| {
                for (j, v) in row.iter_mut().enumerate() {
                    *v = dot(&b[i], &b[j]) + if i == j { c[i] } else { 0.0 };
                }
            });
            let h = Quadratic { k, u: Vec::new() };
            let (lo, hi) = (vec![-0.3; n], vec![0.6; n]);
            let f = |t: &[f64]| 0.5 * dot(t, &h.product(t)) - dot(&g, t);
            let of = |t: &[f64]| {
                let q: Vec<f64> = h.product(t).iter().zip(&g).map(|(h, g)| h - g).collect();
                gap(t, &q, &lo, &hi, &c, &vec![true; n]).unwrap()
            };
            // The rounding of a solution whose condition number is below 1e3, of order 1.
            let least = active_set(&h, &g, (&lo, &hi), &lo, 0.0, 200, &mut LastFactor::default())
                .unwrap()
                .value;
            assert!(of(&least).abs() < 1e-12, "case {case}: {}", of(&least));
            for wide in [0.5, 5.0] {
                let t = random(-wide, wide);
                let bound = f(&t) - of(&t);
                assert!(bound <= f(&least) + 1e-12, "case {case}: {bound} {}", f(&least));
            }
        }
    }
}
