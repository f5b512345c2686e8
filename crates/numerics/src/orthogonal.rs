//! Orthogonal polynomials by three-term recurrences, which keep their digits at high orders.
//!
//! ```text
//! Legendre    (k+1) P_(k+1)(u) = (2k+1) u P_k(u) - k P_(k-1)(u),           |u| <= 1
//! Chebyshev   T_(k+1)(u) = 2 u T_k(u) - T_(k-1)(u)
//! Zernike     R_n^m(rho) = rho (R_(n-1)^|m-1| + R_(n-1)^(m+1)) - R_(n-2)^m,  rho <= 1
//!             Z_n^m = R_n^m cos(m theta) for m >= 0,  R_n^|m| sin(|m| theta) for m < 0
//! ```
//!
//! All are 1 at u = 1, or at rho = 1 in the direction in which the cosine or sine is 1.
//!
//! Source: F. W. J. Olver et al., NIST Handbook of Mathematical Functions, section 18.9; for the
//! radial polynomials B. Honarvar Shakibaei, R. Paramesran, Opt. Lett. 38 (2013) 2487, Eq. 12.

/// Writes the Legendre polynomials `out[k] = P_k(u)` of the orders k = 0, 1, ... up to the length of `out`.
pub fn legendre(u: f64, out: &mut [f64]) {
    for k in 0..out.len() {
        out[k] = match k {
            0 => 1.0,
            1 => u,
            _ => {
                let n = k as f64;
                ((2.0 * n - 1.0) * u * out[k - 1] - (n - 1.0) * out[k - 2]) / n
            }
        };
    }
}

/// Writes the Chebyshev polynomials of the first kind `out[k] = T_k(u)`, k = 0, 1, ... up to the length of `out`.
pub fn chebyshev(u: f64, out: &mut [f64]) {
    for k in 0..out.len() {
        out[k] = match k {
            0 => 1.0,
            1 => u,
            _ => 2.0 * u * out[k - 1] - out[k - 2],
        };
    }
}

/// Returns the number of Zernike terms (n, m) with a radial order n <= `order`.
pub fn zernike_terms(order: u32) -> usize {
    (order as usize + 1) * (order as usize + 2) / 2
}

/// Returns the index, from 0, of the Zernike term of radial order n and azimuthal order m in the sequence of OSA and
/// ANSI Z80.28: n ascending, then m.
pub fn zernike_index(n: u32, m: i32) -> usize {
    let n = i64::from(n);
    ((n * (n + 2) + i64::from(m)) / 2) as usize
}

/// Writes all Zernike polynomials `Z_n^m(x, y)` with n <= `order`, at x = rho cos(theta), y = rho sin(theta). Their
/// indices in `out` are those of [`zernike_index`]. Panics unless `out` has [`zernike_terms`] elements.
pub fn zernike(order: u32, x: f64, y: f64, out: &mut [f64]) {
    let n_max = order as usize;
    assert_eq!(out.len(), zernike_terms(order), "one element per term");
    let rho = x.hypot(y);
    let (cosine, sine) = if rho > 0.0 { (x / rho, y / rho) } else { (1.0, 0.0) };
    // R of the orders n-1 and n-2, by m; one zero more than needed.
    let mut before = vec![0.0; n_max + 3];
    let mut last = vec![0.0; n_max + 3];
    let mut this = vec![0.0; n_max + 3];
    this[0] = 1.0;
    for n in 0..=n_max {
        if n > 0 {
            before.copy_from_slice(&last);
            last.copy_from_slice(&this);
            this.fill(0.0);
            for m in (n % 2..=n).step_by(2) {
                // R_n^m = rho (R_(n-1)^|m-1| + R_(n-1)^(m+1)) - R_(n-2)^m
                let below = if m == 0 { 1 } else { m - 1 };
                this[m] = rho * (last[below] + last[m + 1]) - before[m];
            }
        }
        // (cos, sin)(m theta) = (cos theta + i sin theta)^m
        let mut c = 1.0;
        let mut s = 0.0;
        for m in 0..=n {
            if (n - m) % 2 == 0 {
                let n = n as u32;
                let m = m as i32;
                out[zernike_index(n, -m)] = this[m as usize] * s;
                out[zernike_index(n, m)] = this[m as usize] * c;
            }
            (c, s) = (c * cosine - s * sine, s * cosine + c * sine);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quadrature::gauss_legendre;

    /// Returns the radial Zernike polynomial by its closed form, Born and Wolf section 9.2.1.
    fn radial(n: u32, m: u32, rho: f64) -> f64 {
        let factorial = |k: u32| (1..=k).map(f64::from).product::<f64>();
        (0..=(n - m) / 2)
            .map(|s| {
                let sign = if s % 2 == 0 { 1.0 } else { -1.0 };
                sign * factorial(n - s)
                    / (factorial(s) * factorial((n + m) / 2 - s) * factorial((n - m) / 2 - s))
                    * rho.powi((n - 2 * s) as i32)
            })
            .sum()
    }

    #[test]
    fn zernike_terms_are_the_closed_form() {
        for (x, y) in [(0.0, 0.0), (0.3, -0.4), (-0.8, 0.6), (0.0, 1.0), (-0.05, 0.7)] {
            let mut z = vec![0.0; zernike_terms(9)];
            zernike(9, x, y, &mut z);
            let (rho, theta) = (f64::hypot(x, y), f64::atan2(y, x));
            for n in 0..=9_u32 {
                for m in (-(n as i32)..=n as i32).step_by(2) {
                    let k = m.unsigned_abs();
                    let angle = f64::from(k) * theta;
                    let turn = if m < 0 { angle.sin() } else { angle.cos() };
                    let want = radial(n, k, rho) * turn;
                    // The closed form itself cancels terms of up to 1e3.
                    let got = z[zernike_index(n, m)];
                    assert!((got - want).abs() < 1e-12, "Z {n} {m} at {x} {y}: {got} {want}");
                }
            }
        }
    }

    #[test]
    fn radial_polynomials_of_a_high_order_stay_within_one() {
        let mut z = vec![0.0; zernike_terms(60)];
        for k in 0..=50 {
            zernike(60, f64::from(k) / 50.0, 0.0, &mut z);
            // Rounding that grows along 60 steps of a recurrence.
            assert!(z.iter().all(|v| v.abs() < 1.0 + 1e-10));
        }
        // R_n^m(1) = 1.
        assert!((z[zernike_index(60, 0)] - 1.0).abs() < 1e-10);
    }

    #[test]
    fn legendre_and_chebyshev_are_orthogonal() {
        // 12 nodes are exact up to the degree 23.
        let rule = gauss_legendre::<12>();
        let mut sum = [[0.0; 6]; 6];
        for (u, w) in rule {
            let mut p = [0.0; 6];
            legendre(2.0 * u - 1.0, &mut p);
            for (i, j) in (0..6).flat_map(|i| (0..6).map(move |j| (i, j))) {
                sum[i][j] += 2.0 * w * p[i] * p[j];
            }
        }
        for (i, j) in (0..6).flat_map(|i| (0..6).map(move |j| (i, j))) {
            let want = if i == j { 2.0 / (2.0 * i as f64 + 1.0) } else { 0.0 };
            // Rounding of twelve terms.
            assert!((sum[i][j] - want).abs() < 1e-13, "{i} {j} {}", sum[i][j]);
        }
        let mut t = [0.0; 8];
        chebyshev(0.7_f64.cos(), &mut t);
        for (k, t) in t.iter().enumerate() {
            // Rounding of eight steps of a recurrence.
            assert!((t - (0.7 * k as f64).cos()).abs() < 1e-14);
        }
    }
}
