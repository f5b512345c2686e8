//! Gauss-Legendre quadrature.

/// Returns the `N`-point Gauss-Legendre rule on [0, 1] as pairs (node, weight), nodes ascending. The weights sum to 1.
///
/// Exact for polynomials up to degree 2N - 1. The nodes are the roots of the Legendre
/// polynomial P_N, found by Newton's method from Chebyshev's estimate
/// cos(pi (i + 3/4) / (N + 1/2)); weights `w = 1 / ((1 - z^2) P_N'(z)^2)` on [0, 1].
pub fn gauss_legendre<const N: usize>() -> [(f64, f64); N] {
    std::array::from_fn(|i| {
        let mut z = (std::f64::consts::PI * (i as f64 + 0.75) / (N as f64 + 0.5)).cos();
        let mut derivative = 0.0;
        // Quadratic convergence from an estimate good to 1e-2: six steps reach rounding.
        for _ in 0..6 {
            let (p, d) = legendre(N, z);
            derivative = d;
            z -= p / d;
        }
        (0.5 * (1.0 - z), 1.0 / ((1.0 - z * z) * derivative * derivative))
    })
}

/// Returns the Legendre polynomial of order n and its derivative, `(P_n(z), P_n'(z))`, by Bonnet's recursion.
fn legendre(n: usize, z: f64) -> (f64, f64) {
    let mut previous = 0.0;
    let mut p = 1.0;
    for k in 0..n {
        let kf = k as f64;
        (previous, p) = (p, ((2.0 * kf + 1.0) * z * p - kf * previous) / (kf + 1.0));
    }
    (p, n as f64 * (z * p - previous) / (z * z - 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn integrate<const N: usize>(degree: i32) -> f64 {
        gauss_legendre::<N>().iter().map(|(x, w)| w * x.powi(degree)).sum()
    }

    #[test]
    fn exact_to_degree_2n_minus_1_and_not_beyond() {
        for degree in 0..=5 {
            // Below: rounding of sums of three and of eight terms up to 1.
            assert!((integrate::<3>(degree) - 1.0 / f64::from(degree + 1)).abs() < 1e-15);
        }
        // The first degree beyond: 6^4 / (7 * 720^2) = 3.6e-4.
        assert!((integrate::<3>(6) - 1.0 / 7.0).abs() > 1e-5);
        for degree in 0..=15 {
            assert!((integrate::<8>(degree) - 1.0 / f64::from(degree + 1)).abs() < 1e-14);
        }
    }
}
