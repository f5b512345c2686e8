//! Polynomials of degree at most three on an interval: values, exact ranges, crossings.
//!
//! Coefficients are ascending: `p(u) = c[0] + c[1] u + c[2] u^2 + c[3] u^3`.

/// Returns the value `p(u)` of the polynomial with the ascending coefficients `c`, by nested multiplication.
#[inline]
pub fn evaluate(c: &[f64; 4], u: f64) -> f64 {
    ((c[3] * u + c[2]) * u + c[1]) * u + c[0]
}

/// Returns the ascending coefficients of the derivative p'(u) of the polynomial with the coefficients `c`.
#[inline]
pub fn derivative(c: &[f64; 4]) -> [f64; 4] {
    [c[1], 2.0 * c[2], 3.0 * c[3], 0.0]
}

/// Returns the coefficients of q(u) = p(u + d), the same polynomial counted from `d`: `q_k = p^(k)(d) / k!`. For d = 0
/// it equals p to the last bit.
pub fn shifted(p: &[f64; 4], d: f64) -> [f64; 4] {
    if d == 0.0 {
        return *p;
    }
    let v = derivative(p);
    let a = derivative(&v);
    let j = derivative(&a);
    [evaluate(p, d), evaluate(&v, d), evaluate(&a, d) / 2.0, evaluate(&j, d) / 6.0]
}

/// Returns the Bernstein coefficients of both halves of a cubic, each of them a point of N coordinates, by de Casteljau's
/// construction.
pub fn halves<const N: usize>([a, b, c, d]: &[[f64; N]; 4]) -> [[[f64; N]; 4]; 2] {
    let [ab, bc, cd] = [middle(a, b), middle(b, c), middle(c, d)];
    let [abc, bcd] = [middle(&ab, &bc), middle(&bc, &cd)];
    let centre = middle(&abc, &bcd);
    [[*a, ab, abc, centre], [centre, bcd, cd, *d]]
}

/// Returns the point half way between two points.
fn middle<const N: usize>(p: &[f64; N], q: &[f64; N]) -> [f64; N] {
    std::array::from_fn(|k| 0.5 * (p[k] + q[k]))
}

/// Returns the real roots of `a + b u + c u^2` in the open interval (0, `end`), ascending.
///
/// Uses the citardauq pair `q = -(b + sign(b) sqrt(b^2 - 4ac)) / 2`, `u = q / c`, `u = a / q`,
/// which does not cancel; a double root is returned once.
pub fn quadratic_roots(a: f64, b: f64, c: f64, end: f64) -> impl Iterator<Item = f64> {
    let mut roots = [None, None];
    if c == 0.0 {
        if b != 0.0 {
            roots[0] = within(-a / b, end);
        }
    } else {
        let discriminant = b * b - 4.0 * a * c;
        if discriminant >= 0.0 {
            let q = -0.5 * (b + discriminant.sqrt().copysign(b));
            let first = q / c;
            let second = if q == 0.0 { first } else { a / q };
            roots[0] = within(first.min(second), end);
            roots[1] = if first == second { None } else { within(first.max(second), end) };
        }
    }
    roots.into_iter().flatten()
}

/// Returns `u` if it is in the open interval (0, `end`), otherwise `None`.
fn within(u: f64, end: f64) -> Option<f64> {
    if u > 0.0 && u < end { Some(u) } else { None }
}

/// Returns the exact smallest and largest value of the polynomial with the coefficients `c` on [0, `end`], and the
/// arguments u where they occur.
///
/// The candidates are the two ends and the roots of p' inside.
pub fn range(c: &[f64; 4], end: f64) -> Range {
    let mut range = Range { min: c[0], max: c[0], min_at: 0.0, max_at: 0.0 };
    let d = derivative(c);
    for u in quadratic_roots(d[0], d[1], d[2], end).chain([end]) {
        let value = evaluate(c, u);
        if value < range.min {
            (range.min, range.min_at) = (value, u);
        }
        if value > range.max {
            (range.max, range.max_at) = (value, u);
        }
    }
    range
}

/// Smallest and largest value of a polynomial on an interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Smallest value of the polynomial on the interval.
    pub min: f64,
    /// Largest value of the polynomial on the interval.
    pub max: f64,
    /// Argument u of the smallest value; the smaller one if several are equal.
    pub min_at: f64,
    /// Argument u of the largest value; the smaller one if several are equal.
    pub max_at: f64,
}

impl Range {
    /// Returns the largest magnitude of the polynomial and the argument u where it occurs.
    pub fn peak(&self) -> (f64, f64) {
        if -self.min > self.max { (-self.min, self.min_at) } else { (self.max, self.max_at) }
    }
}

/// Returns the argument u in [`lo`, `hi`] at which the polynomial has the value `level`. It must be monotone there,
/// and `level` must lie between its values at both ends.
///
/// Uses Newton's method, with bisection where a step would leave the shrinking bracket. It ends when a step is
/// rounding.
pub fn monotone_crossing(c: &[f64; 4], level: f64, mut lo: f64, mut hi: f64) -> f64 {
    let rising = evaluate(c, hi) >= evaluate(c, lo);
    let d = derivative(c);
    let mut u = 0.5 * (lo + hi);
    // Bisection alone ends after 53 halvings of a bracket of one binade.
    for _ in 0..60 {
        let error = evaluate(c, u) - level;
        if error == 0.0 {
            return u;
        }
        if (error > 0.0) == rising {
            hi = u;
        } else {
            lo = u;
        }
        let newton = u - error / evaluate(&d, u);
        let next = if newton > lo && newton < hi { newton } else { 0.5 * (lo + hi) };
        // A step below a few units in the last place of the interval's end is rounding.
        if (next - u).abs() <= 4.0 * f64::EPSILON * hi.abs() {
            return next;
        }
        u = next;
    }
    u
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_shifted_polynomial_is_the_same_motion() {
        let p = [1.0, -2.0, 0.5, 0.25];
        let q = shifted(&p, 1.75);
        for u in [0.0, 0.5, 3.0] {
            // Rounding of terms of up to 30.
            assert!((evaluate(&q, u) - evaluate(&p, u + 1.75)).abs() < 1e-13);
        }
        assert_eq!(shifted(&[0.1, 0.3, -0.7, 1.1], 0.0), [0.1, 0.3, -0.7, 1.1]);
    }

    #[test]
    fn range_of_a_known_cubic() {
        // u^3 - 3u on [0, 3]: minimum -2 at 1, maximum 18 at 3.
        let r = range(&[0.0, -3.0, 0.0, 1.0], 3.0);
        assert_eq!((r.min, r.min_at, r.max, r.max_at), (-2.0, 1.0, 18.0, 3.0));
        assert_eq!(r.peak(), (18.0, 3.0));
    }

    #[test]
    fn quadratic_roots_do_not_cancel() {
        // Roots 1e-9 and 1e9.
        let roots: Vec<f64> = quadratic_roots(1.0, -(1e9 + 1e-9), 1.0, 1e10).collect();
        // Rounding, relative to each root.
        assert!((roots[0] / 1e-9 - 1.0).abs() < 1e-14 && (roots[1] / 1e9 - 1.0).abs() < 1e-14);
        assert_eq!(quadratic_roots(1.0, -2.0, 1.0, 5.0).collect::<Vec<_>>(), [1.0]);
        assert_eq!(quadratic_roots(1.0, 0.0, 1.0, 5.0).count(), 0);
    }

    proptest! {
        #[test]
        fn range_contains_every_sample_and_is_attained(
            c in prop::array::uniform4(-10.0..10.0_f64), end in 0.01..5.0_f64,
        ) {
            let r = range(&c, end);
            // Values up to 10 (1 + 5 + 25 + 125); a few roundings of that.
            let tolerance = 1e-12;
            for k in 0..=200 {
                let v = evaluate(&c, end * f64::from(k) / 200.0);
                prop_assert!(v >= r.min - tolerance && v <= r.max + tolerance);
            }
            prop_assert_eq!(evaluate(&c, r.min_at), r.min);
            prop_assert_eq!(evaluate(&c, r.max_at), r.max);
        }

        #[test]
        fn monotone_crossing_hits_the_level(
            a in -5.0..5.0_f64, b in 0.01..5.0_f64, d in 0.0..5.0_f64, f in 0.0..1.0_f64,
        ) {
            // b > 0 and d >= 0: increasing everywhere.
            let c = [a, b, 0.0, d];
            let level = evaluate(&c, 0.0) * (1.0 - f) + evaluate(&c, 2.0) * f;
            let u = monotone_crossing(&c, level, 0.0, 2.0);
            prop_assert!((evaluate(&c, u) - level).abs() < 1e-12);
        }
    }
}
