//! The metrology: low-order terms of a map that an interferometer does not measure, which are mean (piston), tilt,
//! power, and more where asked for.
//!
//! Every term has the RMS one over the rectangle of the map, so that its coefficient is in nm RMS. The Legendre
//! polynomials P_i(u) P_j(v) times sqrt((2 i + 1)(2 j + 1)), with u and v from -1 to 1 over the rectangle; the power is
//! the part of x^2 + y^2 that has no mean.

use ndarray::Array2;
use planish_simulate::sample::legendre_terms;
use planish_types::Grid;

/// A low-order term of a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Term {
    /// x^2 + y^2 about the middle of the map, without its mean.
    Power,
    /// Legendre polynomials P_i along x times P_j along y, for the orders (i, j).
    Legendre(usize, usize),
}

/// Names of the terms that every fit has.
pub const NAMES: [&str; 4] = ["piston", "tilt_x", "tilt_y", "power"];

impl Term {
    /// Returns the name of the term on the command line and in the manifest.
    pub fn name(self) -> String {
        match self {
            Self::Power => "power".into(),
            Self::Legendre(0, 0) => "piston".into(),
            Self::Legendre(1, 0) => "tilt_x".into(),
            Self::Legendre(0, 1) => "tilt_y".into(),
            Self::Legendre(i, j) => format!("legendre_{i}_{j}"),
        }
    }

    /// Returns the values of the term on the pixels, shape (ny, nx), dimensionless, with an RMS of one over the
    /// rectangle of the map.
    pub fn map(self, grid: &Grid) -> Array2<f64> {
        match self {
            Self::Legendre(i, j) => legendre_terms(grid, &[(i, j)]).swap_remove(0),
            Self::Power => {
                let [x, y] = [&grid.x, &grid.y].map(|a| {
                    let middle = 0.5 * (a.start_mm() + a.end_mm());
                    (0..a.len())
                        .map(|i| (a.coordinate_mm(i) - middle).powi(2))
                        .collect::<Vec<f64>>()
                });
                let mut map = Array2::from_shape_fn(grid.shape(), |(r, c)| x[c] + y[r]);
                map -= map.mean().unwrap_or(0.0);
                let rms = (map.iter().map(|v| v * v).sum::<f64>() / map.len() as f64).sqrt();
                map / rms
            }
        }
    }
}

/// Returns piston, tilt and power, and further Legendre terms up to the orders (along x, along y), if given; an order
/// of 0 counts as 1. If both orders are at least 2, power is left out, because it is a sum of such terms.
pub fn terms(order: Option<[usize; 2]>) -> Vec<Term> {
    let [m, n] = order.unwrap_or([0, 0]).map(|k| k.max(1));
    let mut terms = vec![Term::Legendre(0, 0), Term::Legendre(1, 0), Term::Legendre(0, 1)];
    if m < 2 || n < 2 {
        terms.push(Term::Power);
    }
    let all = (0..=m + n).flat_map(|d| (0..=d).map(move |j| (d - j, j)));
    // Without an order the astigmatism P_1 P_1 is known, too.
    let more = all.filter(|(i, j)| order.is_some() && i + j > 1 && *i <= m && *j <= n);
    terms.extend(more.map(|(i, j)| Term::Legendre(i, j)));
    terms
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Axis;

    #[test]
    fn terms_have_an_rms_of_one_and_are_each_there_once() {
        let grid =
            Grid { x: Axis::new(3.0, 0.1, 200).unwrap(), y: Axis::new(-1.0, 0.1, 100).unwrap() };
        for term in terms(Some([3, 1])) {
            let map = term.map(&grid);
            let rms = (map.iter().map(|v| v * v).sum::<f64>() / map.len() as f64).sqrt();
            // A sum over pixels for an integral to the edge: 2 i + 1 over the pixels along an axis.
            assert!((rms - 1.0).abs() < 0.06, "{} {rms}", term.name());
        }
        let names = |order| terms(order).into_iter().map(Term::name).collect::<Vec<_>>();
        assert_eq!(names(None), NAMES);
        assert_eq!(
            names(Some([2, 1])),
            ["piston", "tilt_x", "tilt_y", "power", "legendre_2_0", "legendre_1_1", "legendre_2_1"]
        );
        assert_eq!(names(Some([4, 3])).len(), 20);
        assert!(!names(Some([4, 3])).contains(&String::from("power")));
    }
}
