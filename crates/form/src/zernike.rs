//! Zernike terms on a circle, by the three usual numberings of optics.
//!
//! ```text
//! Z_n^m = N R_n^|m|(rho) cos(m phi)  (m >= 0)   or   sin(|m| phi)  (m < 0)
//! R_n^m = sum_s (-1)^s (n - s)! / (s! ((n+m)/2 - s)! ((n-m)/2 - s)!) rho^(n - 2 s)
//! ```
//!
//! | numbering | first index | N | source |
//! |---|---|---|---|
//! | Noll | 1 | RMS 1 on the circle | R. J. Noll, J. Opt. Soc. Am. 66 (1976) 207 |
//! | ANSI | 0 | RMS 1 on the circle | ANSI Z80.28: `j = (n (n + 2) + m) / 2` |
//! | Fringe | 1 | largest magnitude 1 | University of Arizona: `j = (1 + (n + abs(m)) / 2)^2 - 2 abs(m) + (m < 0)` |

use planish_types::Invalid;
use serde::{Deserialize, Serialize};

use crate::jet::Jet;

/// Largest radial order n. Larger: the sum of R loses digits. Smaller: fine terms are refused. Derived: at n = 20 the
/// largest addend is 4e6, so that nine digits are left.
const LARGEST_ORDER: u32 = 20;

/// Numbering of Zernike terms, which determines their normalisation as well.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Numbering {
    /// Noll's, from 1; every term has the RMS 1.
    Noll,
    /// Numbering of the University of Arizona, from 1; every term has the largest magnitude 1.
    Fringe,
    /// Numbering of ANSI Z80.28 (OSA), from 0; every term has the RMS 1.
    Ansi,
}

impl Numbering {
    /// Returns the radial order n and the azimuthal order m of the term with this index; m < 0 is the sine. Refuses an
    /// index that does not exist, or whose order is above 20.
    pub fn order(self, index: u32) -> Result<(u32, i32), Invalid> {
        for n in 0..=LARGEST_ORDER as i32 {
            for m in (-n..=n).step_by(2) {
                if self.index(n, m) == index {
                    return Ok((n as u32, m));
                }
            }
        }
        let first = if self == Self::Ansi { 0 } else { 1 };
        let problem = format!("has the term {index}");
        let remedy = format!("give terms from {first}, of an order n of at most {LARGEST_ORDER}");
        Err(Invalid::whole("zernike", problem, remedy))
    }

    fn index(self, n: i32, m: i32) -> u32 {
        let a = m.abs();
        let j = match self {
            Self::Ansi => (n * (n + 2) + m) / 2,
            Self::Fringe => (1 + (n + a) / 2).pow(2) - 2 * a + i32::from(m < 0),
            Self::Noll => {
                // The terms of n follow those of lower orders, by rising |m|; the even index of a pair is the cosine.
                let first = n * (n + 1) / 2 + 1;
                if m == 0 {
                    first
                } else {
                    let low = first + a - 1;
                    let even = low + low.rem_euclid(2);
                    let odd = low + 1 - low.rem_euclid(2);
                    if m > 0 { even } else { odd }
                }
            }
        };
        j as u32
    }

    /// Returns the factor N of the module, which normalises a term.
    fn norm(self, n: u32, m: i32) -> f64 {
        match (self, m) {
            (Self::Fringe, _) => 1.0,
            (_, 0) => f64::from(n + 1).sqrt(),
            _ => f64::from(2 * (n + 1)).sqrt(),
        }
    }

    /// Returns the term with this index, with its derivatives; x and y are from the centre of the circle, over its
    /// radius.
    pub(crate) fn term(self, index: u32, [x, y]: [Jet; 2]) -> Result<Jet, Invalid> {
        let (n, m) = self.order(index)?;
        let a = m.unsigned_abs();
        // (x + i y)^|m|
        let mut re = Jet::constant(1.0);
        let mut im = Jet::constant(0.0);
        for _ in 0..a {
            (re, im) = (re * x - im * y, re * y + im * x);
        }
        let square = x * x + y * y;
        let half = (n - a) / 2;
        let mut radial = Jet::constant(0.0);
        for s in 0..=half {
            let sign = if s % 2 == 0 { 1.0 } else { -1.0 };
            let below = factorial(s) * factorial((n + a) / 2 - s) * factorial(half - s);
            let coefficient = sign * factorial(n - s) / below;
            radial = radial + square.power(half - s).times(coefficient);
        }
        let azimuthal = if m < 0 { im } else { re };
        Ok((radial * azimuthal).times(self.norm(n, m)))
    }
}

fn factorial(n: u32) -> f64 {
    (1..=n).map(f64::from).product()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_terms_are_those_of_the_tables() {
        let orders = |numbering: Numbering, from: u32| -> Vec<(u32, i32)> {
            (from..from + 11).map(|j| numbering.order(j).unwrap()).collect()
        };
        let noll = [
            (0, 0),
            (1, 1),
            (1, -1),
            (2, 0),
            (2, -2),
            (2, 2),
            (3, -1),
            (3, 1),
            (3, -3),
            (3, 3),
            (4, 0),
        ];
        assert_eq!(orders(Numbering::Noll, 1), noll);
        let fringe = [
            (0, 0),
            (1, 1),
            (1, -1),
            (2, 0),
            (2, 2),
            (2, -2),
            (3, 1),
            (3, -1),
            (4, 0),
            (3, 3),
            (3, -3),
        ];
        assert_eq!(orders(Numbering::Fringe, 1), fringe);
        let ansi = [
            (0, 0),
            (1, -1),
            (1, 1),
            (2, -2),
            (2, 0),
            (2, 2),
            (3, -3),
            (3, -1),
            (3, 1),
            (3, 3),
            (4, -4),
        ];
        assert_eq!(orders(Numbering::Ansi, 0), ansi);
        let message = Numbering::Noll.order(0).unwrap_err().to_string();
        assert!(message.contains("has the term 0; give terms from 1"), "{message}");
    }

    #[test]
    fn terms_are_orthonormal_on_the_circle() {
        // Rings of equal area by midpoints, with 64 azimuths: exact in the azimuth up to m = 31; the midpoint rule over
        // 4000 rings leaves n^4 / 4000^2 / 24 = 3e-6 at n = 6.
        let (rings, azimuths) = (4000, 64);
        let points: Vec<[f64; 2]> = (0..rings * azimuths)
            .map(|k| {
                let rho = ((f64::from(k / azimuths) + 0.5) / f64::from(rings)).sqrt();
                let phi = std::f64::consts::TAU * f64::from(k % azimuths) / f64::from(azimuths);
                [rho * phi.cos(), rho * phi.sin()]
            })
            .collect();
        let value =
            |j: u32, p: [f64; 2]| Numbering::Noll.term(j, Jet::coordinates(p)).unwrap().value;
        for (i, j) in [(4, 4), (5, 5), (11, 11), (22, 22), (4, 11), (11, 22), (5, 13), (7, 8)] {
            let mean = points.iter().map(|p| value(i, *p) * value(j, *p)).sum::<f64>()
                / f64::from(rings * azimuths);
            let want = f64::from(u8::from(i == j));
            assert!((mean - want).abs() < 1e-5, "{i} {j}: {mean}");
        }
        // The largest magnitude of a fringe term is 1, on the circle.
        for j in 2..30 {
            let largest = (0..360).map(|k| {
                let phi = f64::from(k).to_radians();
                let at = Jet::coordinates([phi.cos(), phi.sin()]);
                Numbering::Fringe.term(j, at).unwrap().value.abs()
            });
            // A sine of 5 phi has its largest value up to half a degree beside an azimuth: (5 pi / 360)^2 / 2 = 1e-3
            // less.
            assert!((largest.fold(0.0, f64::max) - 1.0).abs() < 1e-2, "{j}");
        }
    }
}
