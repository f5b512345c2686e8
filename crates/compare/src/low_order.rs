//! Low-order terms of a map, each with the name that optics has for it: Zernike terms on a round aperture, Legendre
//! terms on any other.
//!
//! ```text
//! z(x, y) = sum_k c_k phi_k(x, y) + rest,    RMS of phi_k on the whole aperture = 1
//! ```
//!
//! so that the magnitude of c_k is the RMS of its term. A Legendre term is sqrt((2i + 1)(2j + 1)) P_i(u) P_j(v).

use planish_form::low_order::{Family, LowOrderSettings, low_order};
use planish_types::Surface;
use serde::Serialize;

/// Highest order of the terms: n of Zernike, i + j of Legendre. Larger: terms without a usual name. Smaller: the
/// spherical aberration is missing. Chosen: the 15 terms of the third-order aberrations.
const ORDER: u32 = 4;

/// Low-order terms of a map.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LowOrderTerms {
    /// Family of the terms: Zernike on a round aperture, Legendre on any other.
    pub family: Family,
    /// The terms without the piston, by ascending order.
    pub terms: Vec<LowOrderTerm>,
    /// RMS of the map without all of these terms, nm.
    pub rest_rms_nm: f64,
}

/// One low-order term of a map.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LowOrderTerm {
    /// Name of the term, such as `coma along x`.
    pub name: String,
    /// Order of the term: [n, m] of Zernike, [i, j] (along x, along y) of Legendre.
    pub order: [i32; 2],
    /// Coefficient of the term of unit RMS, nm: its magnitude is the RMS of the term.
    pub coefficient_nm: f64,
}

/// Returns the low-order terms of `surface`; `None` if its valid pixels do not determine them.
pub fn low_order_terms(surface: &Surface) -> Option<LowOrderTerms> {
    let family = Family::suited_to(surface);
    let fitted =
        low_order(surface, &LowOrderSettings { family, order: ORDER, circle: None }).ok()?;
    let rest = Surface::new(*surface.grid(), surface.height_nm() - &fitted.shape_nm).ok()?;
    let mut terms = Vec::new();
    for term in fitted.report.terms.iter().filter(|term| term.order != [0, 0]) {
        terms.push(LowOrderTerm {
            name: name_of(family, term.order),
            order: term.order,
            coefficient_nm: term.coefficient_nm * rms_of_term(family, term.order),
        });
    }
    Some(LowOrderTerms { family, terms, rest_rms_nm: rest.statistics().rms })
}

/// Returns the RMS on its whole domain of a term as `planish_form` normalises it.
fn rms_of_term(family: Family, [i, j]: [i32; 2]) -> f64 {
    match family {
        Family::Zernike => 1.0,
        // The mean of P_k^2 over -1 to 1 is 1 / (2 k + 1).
        _ => (f64::from(2 * i + 1) * f64::from(2 * j + 1)).sqrt().recip(),
    }
}

/// Returns the name of a term.
fn name_of(family: Family, order: [i32; 2]) -> String {
    let name = match (family, order) {
        (Family::Zernike, [1, 1]) | (Family::Legendre, [1, 0]) => "tilt along x",
        (Family::Zernike, [1, -1]) | (Family::Legendre, [0, 1]) => "tilt along y",
        (Family::Zernike, [2, 0]) => "defocus",
        (Family::Zernike, [2, 2]) => "astigmatism 0\u{b0}",
        (Family::Zernike, [2, -2]) => "astigmatism 45\u{b0}",
        (Family::Zernike, [3, 1]) => "coma along x",
        (Family::Zernike, [3, -1]) => "coma along y",
        (Family::Zernike, [3, 3]) => "trefoil 0\u{b0}",
        (Family::Zernike, [3, -3]) => "trefoil 30\u{b0}",
        (Family::Zernike, [4, 0]) => "spherical",
        (Family::Zernike, [4, 2]) => "secondary astigmatism 0\u{b0}",
        (Family::Zernike, [4, -2]) => "secondary astigmatism 45\u{b0}",
        (Family::Zernike, [4, 4]) => "tetrafoil 0\u{b0}",
        (Family::Zernike, [4, -4]) => "tetrafoil 22.5\u{b0}",
        (Family::Legendre, [2, 0]) => "curvature along x",
        (Family::Legendre, [0, 2]) => "curvature along y",
        (Family::Legendre, [1, 1]) => "twist",
        (Family::Legendre, [3, 0]) => "third order along x",
        (Family::Legendre, [0, 3]) => "third order along y",
        (Family::Legendre, [4, 0]) => "fourth order along x",
        (Family::Legendre, [0, 4]) => "fourth order along y",
        (_, [i, j]) => return format!("P{i}(x) P{j}(y)"),
    };
    name.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use planish_numerics::orthogonal::{legendre, zernike, zernike_index, zernike_terms};
    use planish_types::{Axis, Grid};

    /// Returns a map of 121 x 121 pixels on -30 to 30 mm; with `is_round` it is a disc.
    fn map(is_round: bool, height_nm: impl Fn(f64, f64) -> f64) -> Surface {
        let axis = Axis::new(-30.0, 0.5, 121).unwrap();
        let grid = Grid { x: axis, y: axis };
        let map = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (u, v) = (axis.coordinate_mm(c) / 30.0, axis.coordinate_mm(r) / 30.0);
            if is_round && u.hypot(v) > 1.0 { f64::NAN } else { height_nm(u, v) }
        });
        Surface::new(grid, map).unwrap()
    }

    #[test]
    fn a_planted_term_appears_under_its_name_and_no_other_does() {
        for (name, n, m) in [("spherical", 4, 0), ("coma along y", 3, -1), ("defocus", 2, 0)] {
            let disc = map(true, |u, v| {
                let mut z = vec![0.0; zernike_terms(4)];
                zernike(4, u, v, &mut z);
                let twice = if m == 0 { 1.0 } else { 2.0 };
                7.0 + 10.0 * (twice * f64::from(n + 1)).sqrt() * z[zernike_index(n as u32, m)]
            });
            let found = low_order_terms(&disc).unwrap();
            assert_eq!((found.family, found.terms.len()), (Family::Zernike, 14));
            for term in &found.terms {
                let expected = if term.name == name { 10.0 } else { 0.0 };
                // Rounding of sums over 11000 pixels.
                assert!((term.coefficient_nm - expected).abs() < 1e-10, "{name}: {term:?}");
            }
            assert!(found.rest_rms_nm < 1e-10, "{found:?}");
        }
    }

    #[test]
    fn a_legendre_term_counts_with_its_rms() {
        let square = map(false, |u, v| {
            let [mut p, mut q] = [[0.0; 4]; 2];
            legendre(u, &mut p);
            legendre(v, &mut q);
            // RMS 10 nm: 1 / sqrt(5) of P_2, 1 / sqrt(3 * 3) of the twist.
            10.0 * 5.0_f64.sqrt() * p[2] - 30.0 * p[1] * q[1]
        });
        let found = low_order_terms(&square).unwrap();
        assert_eq!(found.family, Family::Legendre);
        for term in &found.terms {
            let expected = match term.name.as_str() {
                "curvature along x" => 10.0,
                "twist" => -10.0,
                _ => 0.0,
            };
            // Rounding of sums over 14000 pixels.
            assert!((term.coefficient_nm - expected).abs() < 1e-10, "{term:?}");
        }
    }

    #[test]
    fn too_few_pixels_have_no_terms() {
        let axis = Axis::new(0.0, 1.0, 3).unwrap();
        let nine = Surface::new(Grid { x: axis, y: axis }, Array2::zeros((3, 3))).unwrap();
        assert_eq!(low_order_terms(&nine), None);
    }
}
