//! The low-order part of a map: Zernike terms on a circle, Legendre or Chebyshev terms on a
//! rectangle.
//!
//! ```text
//! z(x, y) = sum_k c_k phi_k(x, y) + residual
//! zernike     phi = N_n^m R_n^|m|(rho) cos(m theta), m < 0: sin(|m| theta),  n <= order
//!             N_n^m = sqrt((2 - [m = 0]) (n + 1)):  unit RMS on the full disc
//! legendre    phi = P_i(u) P_j(v),   i + j <= order
//! chebyshev   phi = T_i(u) T_j(v),   i + j <= order
//! ```
//!
//! All coefficients are fitted together by least squares on the valid pixels (`basis.rs`); none is an inner
//! product. So the fitted shape depends only on the order, not on whether the terms are orthogonal on this
//! aperture. The coefficients do depend on it: on an annulus, or if pixels are missing, a term is not
//! orthogonal to the others, and its coefficient changes when terms are added. The report states how far
//! from orthogonal they were.
//!
//! Source: R. J. Noll, J. Opt. Soc. Am. 66 (1976) 207 (normalisation); ANSI Z80.28 (order);
//! V. N. Mahajan, J. Opt. Soc. Am. 71 (1981) 75 (why an annulus is different).
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | c | `coefficient_nm` | nm |
//! | u, v | -1 .. 1 over `x_mm`, `y_mm`: the valid pixel centres | 1 |
//! | rho | distance from `centre_mm` over `radius_mm` | 1 |

use std::f64::consts::PI;

use ndarray::Array2;
use planish_types::{Axis, Grid, Invalid, Surface};
use serde::Serialize;

use crate::basis::{Basis, BasisFit, Polynomial, fit};

/// Highest order that a caller may ask for; it has 231 terms. Larger: normal equations that take noticeable
/// time. Smaller: less of the figure can be described.
const MAX_ORDER: u32 = 20;

/// Correlation of two terms on the valid pixels above which the report has a note. Larger: no note on coefficients that
/// depend on the order. Smaller: notes on usual apertures.
const NOTEWORTHY_CORRELATION: f64 = 0.1;

/// Settings of the fit of low-order terms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LowOrderSettings {
    /// Family of the polynomials to fit.
    pub family: Family,
    /// Highest order: n of Zernike, i + j of the others; at most 20.
    pub order: u32,
    /// Unit circle of Zernike terms. `None` takes the circle about the middle of the bounding box of the valid pixels
    /// that contains them all. With the other families a circle is refused.
    pub circle: Option<Circle>,
}

/// Family of polynomials.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Family {
    /// Zernike polynomials, for circular apertures.
    Zernike,
    /// Legendre polynomials, for rectangular apertures; orthogonal with equal weights.
    Legendre,
    /// Chebyshev polynomials, for rectangular apertures; more weight on the edges.
    Chebyshev,
}

impl Family {
    /// Returns the family whose domain about the valid pixels of `surface` is the smaller one: Zernike terms if that
    /// is their circle, Legendre terms if it is their rectangle.
    pub fn suited_to(surface: &Surface) -> Self {
        let bounds = bounding_box_mm(surface.height_nm(), surface.grid());
        let centre = bounds.map(|[low, high]| 0.5 * (low + high));
        let [width, height] = bounds.map(|[low, high]| high - low);
        let radius_mm = farthest_mm(surface, centre);
        if PI * radius_mm * radius_mm < width * height { Self::Zernike } else { Self::Legendre }
    }
}

/// A circle in part coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Circle {
    /// Centre [x, y], mm.
    pub centre_mm: [f64; 2],
    /// Radius, mm; > 0.
    pub radius_mm: f64,
}

/// Result of the fit: the low-order part of a map, with its numbers.
#[derive(Clone, Debug)]
pub struct LowOrder {
    /// The fitted terms on every pixel (ny, nx), nm; NaN where the map is invalid.
    pub shape_nm: Array2<f64>,
    /// Numbers of the fit for the manifest.
    pub report: LowOrderReport,
}

/// Numbers of the fitted low-order part, for the manifest: the coefficients, RMS, PV and quality of the fit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LowOrderReport {
    /// Definition, normalisation and order of the terms.
    pub convention: &'static str,
    /// Domain of the terms: u and v, or rho, are 1 at its border.
    pub domain: Domain,
    /// The fitted terms with their coefficients.
    pub terms: Vec<Term>,
    /// Population RMS of the fitted terms over the valid pixels, mean removed, nm.
    pub rms_nm: f64,
    /// Largest minus smallest of the fitted terms over the valid pixels, nm.
    pub pv_nm: f64,
    /// Condition number of the matrix of the terms on the valid pixels, each term scaled to the same RMS there.
    pub condition: f64,
    /// Largest magnitude of the correlation of two terms on the valid pixels; 0 if all are orthogonal.
    pub largest_correlation: f64,
    /// Area of the valid pixels over that of the domain; an annulus, a hole or an aperture of
    /// another shape makes it less than 1.
    pub coverage: f64,
    /// Note that the terms are not orthogonal on these pixels; absent if they nearly are.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// Domain on which the terms are defined: u and v, or rho, are 1 at its border.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Domain {
    /// Unit disc of Zernike terms.
    Circle(Circle),
    /// Rectangle of Legendre or Chebyshev terms; u and v are -1 and 1 at its edges.
    Rectangle {
        /// Smallest and largest x of a valid pixel, mm.
        x_mm: [f64; 2],
        /// Smallest and largest y of a valid pixel, mm.
        y_mm: [f64; 2],
    },
}

/// One fitted term.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Term {
    /// Order of the term: [n, m] of Zernike, [i, j] (along x, along y) of the others.
    pub order: [i32; 2],
    /// Coefficient of the term, nm.
    pub coefficient_nm: f64,
}

/// Fits the low-order terms to the valid pixels of `surface`. Refuses an order above 20, pixels that do not determine
/// the terms, a circle that does not hold all valid pixels, and a circle for other than Zernike terms.
pub fn low_order(surface: &Surface, settings: &LowOrderSettings) -> Result<LowOrder, Invalid> {
    let grid = surface.grid();
    if settings.order > MAX_ORDER {
        return Err(Invalid::whole(
            "low order",
            format!("the order is {}", settings.order),
            format!("give at most {MAX_ORDER}"),
        ));
    }
    if settings.circle.is_some() && settings.family != Family::Zernike {
        let problem = "has no use without zernike terms";
        return Err(Invalid::whole("zernike circle", problem, "leave it out"));
    }
    let map = surface.height_nm();
    let valid_area_mm2 = surface.statistics().valid_count as f64 * grid.pixel_mm2();
    let [x_mm, y_mm] = bounding_box_mm(map, grid);
    let by_degree = |order: u32| -> Vec<[u32; 2]> {
        (0..=order).flat_map(|n| (0..=n).map(move |j| [n - j, j])).collect()
    };
    let (basis, domain, area_mm2) = match settings.family {
        Family::Zernike => {
            let circle = unit_circle(surface, settings.circle)?;
            let basis = Basis::zernike(grid, circle.centre_mm, circle.radius_mm, settings.order);
            (basis, Domain::Circle(circle), PI * circle.radius_mm.powi(2))
        }
        Family::Legendre | Family::Chebyshev => {
            if x_mm[0] == x_mm[1] || y_mm[0] == y_mm[1] {
                return Err(Invalid::whole(
                    "low order",
                    "the valid pixels are in one row or one column",
                    "give a map of at least 2 x 2 valid pixels",
                ));
            }
            let polynomial = match settings.family {
                Family::Chebyshev => Polynomial::Chebyshev,
                _ => Polynomial::Legendre,
            };
            let basis = Basis::tensor(grid, [x_mm, y_mm], polynomial, by_degree(settings.order));
            let whole = |[low, high]: [f64; 2], axis: &Axis| high - low + axis.step_mm();
            let area_mm2 = whole(x_mm, &grid.x) * whole(y_mm, &grid.y);
            (basis, Domain::Rectangle { x_mm, y_mm }, area_mm2)
        }
    };
    let BasisFit { coefficients, map: mut shape_nm, condition, largest_correlation } =
        fit(&basis, map.view())?;
    shape_nm.zip_mut_with(map, |s, z| {
        if z.is_nan() {
            *s = f64::NAN;
        }
    });
    let fitted = Surface::new(*grid, shape_nm)?;
    let mut note = None;
    if largest_correlation > NOTEWORTHY_CORRELATION {
        note = Some(format!(
            "the terms are not orthogonal on these pixels (largest correlation \
             {largest_correlation:.2}): the coefficients belong to this order and change with it; \
             what is removed does not depend on that"
        ));
    }
    let terms = basis.terms().into_iter().zip(coefficients);
    let report = LowOrderReport {
        convention: convention(settings.family),
        domain,
        terms: terms.map(|(order, coefficient_nm)| Term { order, coefficient_nm }).collect(),
        rms_nm: fitted.statistics().rms,
        pv_nm: fitted.statistics().pv,
        condition,
        largest_correlation,
        coverage: valid_area_mm2 / area_mm2,
        note,
    };
    Ok(LowOrder { shape_nm: fitted.height_nm().clone(), report })
}

/// Returns the sentence that defines the terms of a family, their normalisation and their order.
fn convention(family: Family) -> &'static str {
    match family {
        Family::Zernike => {
            "Zernike terms of unit RMS on the full disc (Noll's normalisation), order [n, m] of OSA \
             and ANSI Z80.28: cosine for m >= 0, sine for m < 0, theta from +x towards +y; joint \
             least-squares fit"
        }
        Family::Legendre => {
            "P_i(u) P_j(v), order [i, j], P(1) = 1; u and v run from -1 to 1 over the valid pixel \
             centres along x and y; joint least-squares fit"
        }
        Family::Chebyshev => {
            "T_i(u) T_j(v), order [i, j], T(1) = 1; u and v run from -1 to 1 over the valid pixel \
             centres along x and y; joint least-squares fit"
        }
    }
}

/// Returns the smallest and largest x, and y, of the valid pixels, mm.
pub fn bounding_box_mm(map: &Array2<f64>, grid: &Grid) -> [[f64; 2]; 2] {
    let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for ((r, c), z) in map.indexed_iter() {
        if !z.is_nan() {
            for (range, v) in
                bounds.iter_mut().zip([grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)])
            {
                *range = [range[0].min(v), range[1].max(v)];
            }
        }
    }
    bounds
}

/// Returns the given circle, which must contain every valid pixel. Without one, it returns the circle about the middle
/// of their bounding box that contains all of them.
fn unit_circle(surface: &Surface, circle: Option<Circle>) -> Result<Circle, Invalid> {
    let Some(circle) = circle else {
        let centre_mm = bounding_box_mm(surface.height_nm(), surface.grid())
            .map(|[low, high]| 0.5 * (low + high));
        return Circle { centre_mm, radius_mm: farthest_mm(surface, centre_mm) }.checked();
    };
    let circle = circle.checked()?;
    let farthest = farthest_mm(surface, circle.centre_mm);
    // A pixel centre that rounding puts outside is on the circle.
    if farthest > circle.radius_mm * (1.0 + 1e-9) {
        return Err(Invalid::whole(
            "zernike circle",
            format!("has the radius {} mm, a valid pixel is at {farthest} mm", circle.radius_mm),
            "give a circle that holds every valid pixel, or crop the map to it",
        ));
    }
    Ok(circle)
}

/// Returns the distance from `centre` [x, y] to the farthest valid pixel, mm.
fn farthest_mm(surface: &Surface, centre: [f64; 2]) -> f64 {
    let grid = surface.grid();
    let valid = surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan());
    valid
        .map(|((r, c), _)| {
            (grid.x.coordinate_mm(c) - centre[0]).hypot(grid.y.coordinate_mm(r) - centre[1])
        })
        .fold(0.0, f64::max)
}

impl Circle {
    fn checked(self) -> Result<Self, Invalid> {
        let finite = self.centre_mm.iter().all(|v| v.is_finite()) && self.radius_mm.is_finite();
        if finite && self.radius_mm > 0.0 {
            return Ok(self);
        }
        let problem =
            format!("has the centre {:?} mm and the radius {} mm", self.centre_mm, self.radius_mm);
        Err(Invalid::whole("zernike circle", problem, "give a positive radius in mm"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_numerics::orthogonal;

    fn grid(nx: usize, ny: usize) -> Grid {
        let axis = |n: usize, step: f64| Axis::new(-0.5 * (n - 1) as f64 * step, step, n).unwrap();
        Grid { x: axis(nx, 0.1), y: axis(ny, 0.1) }
    }

    /// Returns a map of `f(x, y)`, valid between the radii `inner` and `outer` about the origin, mm.
    fn between(g: Grid, inner: f64, outer: f64, f: impl Fn(f64, f64) -> f64) -> Surface {
        let map = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
            let rho = x.hypot(y);
            if rho >= inner && rho <= outer { f(x, y) } else { f64::NAN }
        });
        Surface::new(g, map).unwrap()
    }

    fn settings(family: Family, order: u32) -> LowOrderSettings {
        LowOrderSettings { family, order, circle: None }
    }

    fn zernike(circle_mm: f64, order: u32) -> LowOrderSettings {
        let circle = Circle { centre_mm: [0.0, 0.0], radius_mm: circle_mm };
        LowOrderSettings { family: Family::Zernike, order, circle: Some(circle) }
    }

    fn coefficient(report: &LowOrderReport, order: [i32; 2]) -> f64 {
        report.terms.iter().find(|t| t.order == order).unwrap().coefficient_nm
    }

    /// Returns 3 nm RMS of primary coma along x plus -2 nm RMS of oblique astigmatism, on a disc of the radius 4 mm.
    fn coma(x: f64, y: f64) -> f64 {
        let mut z = vec![0.0; orthogonal::zernike_terms(4)];
        orthogonal::zernike(4, x / 4.0, y / 4.0, &mut z);
        3.0 * 8.0_f64.sqrt() * z[orthogonal::zernike_index(3, 1)]
            - 2.0 * 6.0_f64.sqrt() * z[orthogonal::zernike_index(2, -2)]
    }

    #[test]
    fn zernike_terms_are_orthonormal_on_a_discrete_disc_to_first_order_in_the_pixel() {
        // The correlation of two terms on the disc's pixels vanishes with the pixel: the rim of a
        // disc of N pixels across is known to 1 / N.
        let correlation = |n: usize| {
            let g = Grid {
                x: Axis::new(-1.0 + 1.0 / n as f64, 2.0 / n as f64, n).unwrap(),
                y: Axis::new(-1.0 + 1.0 / n as f64, 2.0 / n as f64, n).unwrap(),
            };
            low_order(&between(g, 0.0, 1.0, |x, _| x), &zernike(1.0, 6)).unwrap().report
        };
        let reports = [64, 128, 256, 512].map(correlation);
        for (k, report) in reports.iter().enumerate() {
            let n = 64.0 * f64::powi(2.0, k as i32);
            assert!(report.largest_correlation < 4.0 / n, "{n}: {report:?}");
            assert!(report.note.is_none() && (report.coverage - 1.0).abs() < 4.0 / n);
            // Z_1^1 = 2 rho cos theta has unit RMS: x = 1/2 of it.
            assert!((coefficient(report, [1, 1]) - 0.5).abs() < 1e-13);
        }
    }

    #[test]
    fn planted_terms_come_back_on_a_disc_an_annulus_and_a_half_moon() {
        let g = grid(81, 81);
        let disc = between(g, 0.0, 4.0, coma);
        let annulus = between(g, 1.6, 4.0, coma);
        let moon = between(g, 0.0, 4.0, |x, y| if x > 1.0 { coma(x, y) } else { f64::NAN });
        let mut correlations = Vec::new();
        for surface in [disc, annulus, moon] {
            let found = low_order(&surface, &zernike(4.0, 5)).unwrap();
            for term in &found.report.terms {
                let want = match term.order {
                    [3, 1] => 3.0,
                    [2, -2] => -2.0,
                    _ => 0.0,
                };
                // The half moon has a condition number of about 1e3.
                assert!((term.coefficient_nm - want).abs() < 1e-10, "{term:?}");
            }
            let rest = &found.shape_nm - surface.height_nm();
            // Rounding of heights of some ten nm: the errors of the coefficients cancel on the pixels.
            assert!(rest.iter().all(|v| v.is_nan() || v.abs() < 1e-11));
            correlations.push(found.report.largest_correlation);
        }
        assert!(correlations[0] < 0.05 && correlations[1] > 0.3, "{correlations:?}");
    }

    #[test]
    fn on_an_annulus_a_coefficient_changes_with_the_order_and_the_report_says_so() {
        // A bowl rho^4: on an annulus its piston and defocus depend on whether n = 4 is fitted.
        let bowl = |x: f64, y: f64| 100.0 * ((x * x + y * y) / 16.0).powi(2);
        let surface = between(grid(81, 81), 2.0, 4.0, bowl);
        let low = low_order(&surface, &zernike(4.0, 2)).unwrap().report;
        let high = low_order(&surface, &zernike(4.0, 4)).unwrap().report;
        let change = coefficient(&high, [2, 0]) - coefficient(&low, [2, 0]);
        assert!(change.abs() > 5.0, "{change}");
        for report in [low, high] {
            assert!(report.note.as_ref().is_some_and(|n| n.contains("not orthogonal")));
            // The area without the hole, 1 - (2 / 4)^2; the rim of a map of 81 pixels is known to 1 / 81.
            assert!((report.coverage - 0.75).abs() < 0.02, "{}", report.coverage);
        }
    }

    #[test]
    fn legendre_and_chebyshev_remove_the_same_and_leave_nothing_of_a_polynomial() {
        let g = grid(60, 41);
        let f = |x: f64, y: f64| 5.0 - 3.0 * x + x * x * y - 0.2 * y.powi(4) + 0.1 * x.powi(3) * y;
        let mut map = Array2::from_shape_fn(g.shape(), |(r, c)| {
            f(g.x.coordinate_mm(c), g.y.coordinate_mm(r))
        });
        map.slice_mut(ndarray::s![5..15, 20..31]).fill(f64::NAN);
        let surface = Surface::new(g, map).unwrap();
        for family in [Family::Legendre, Family::Chebyshev] {
            let found = low_order(&surface, &settings(family, 4)).unwrap();
            let rest = &found.shape_nm - surface.height_nm();
            // Heights of 100 nm carry rounding of 1e-14 each; the fit may add one digit.
            assert!(rest.iter().all(|v| v.is_nan() || v.abs() < 1e-12));
            // One order less leaves x^3 y and y^4.
            let less = low_order(&surface, &settings(family, 3)).unwrap();
            let rest = Surface::new(g, &less.shape_nm - surface.height_nm()).unwrap();
            assert!(rest.statistics().rms > 0.1);
        }
        let [a, b] = [Family::Legendre, Family::Chebyshev]
            .map(|f| low_order(&surface, &settings(f, 3)).unwrap().shape_nm);
        // Both span the same polynomials: rounding, as above.
        assert!((&a - &b).iter().all(|v| v.is_nan() || v.abs() < 1e-12));
    }

    #[test]
    fn coefficients_are_in_the_stated_convention() {
        let g = grid(60, 41);
        let (half_x, half_y) = (2.95, 2.0);
        let (u, v) =
            (|c: usize| g.x.coordinate_mm(c) / half_x, |r: usize| g.y.coordinate_mm(r) / half_y);
        let map = Array2::from_shape_fn(g.shape(), |(r, c)| {
            // 7 P_2(u) P_1(v) and -4 T_0(u) T_3(v)
            3.5 * (3.0 * u(c) * u(c) - 1.0) * v(r) - 4.0 * (4.0 * v(r).powi(3) - 3.0 * v(r))
        });
        let surface = Surface::new(g, map).unwrap();
        let found = low_order(&surface, &settings(Family::Legendre, 3)).unwrap().report;
        // Rounding of sums over 2e3 pixels, of coefficients below 10.
        assert!((coefficient(&found, [2, 1]) - 7.0).abs() < 1e-12);
        // T_3 = (8 P_3 - 3 P_1) / 5
        assert!((coefficient(&found, [0, 3]) + 6.4).abs() < 1e-12);
        let found = low_order(&surface, &settings(Family::Chebyshev, 3)).unwrap().report;
        // P_2 = (3 T_2 + 1) / 4
        assert!((coefficient(&found, [2, 1]) - 5.25).abs() < 1e-12);
        // As above.
        assert!((coefficient(&found, [0, 3]) + 4.0).abs() < 1e-12);
    }

    #[test]
    fn what_cannot_be_fitted_says_why() {
        let surface = between(grid(41, 41), 0.0, 1.0, |x, _| x);
        let message = |s: LowOrderSettings| low_order(&surface, &s).unwrap_err().to_string();
        assert!(message(settings(Family::Legendre, 21)).contains("the order is 21"));
        assert!(message(settings(Family::Legendre, 18)).contains("valid pixel(s) for 190 terms"));
        assert!(message(zernike(0.5, 2)).contains("a valid pixel is at 1"));
        assert!(message(zernike(f64::NAN, 2)).contains("radius NaN"));
        let without_terms = LowOrderSettings { family: Family::Legendre, ..zernike(1.0, 2) };
        assert!(message(without_terms).contains("zernike circle: has no use"));
        let mut map = Array2::from_elem((41, 41), f64::NAN);
        map.column_mut(7).fill(1.0);
        let line = Surface::new(grid(41, 41), map.clone()).unwrap();
        let error = low_order(&line, &settings(Family::Legendre, 1)).unwrap_err();
        assert!(error.to_string().contains("one row or one column"), "{error}");
        map.column_mut(9).fill(1.0);
        let two = Surface::new(grid(41, 41), map).unwrap();
        let error = low_order(&two, &settings(Family::Legendre, 2)).unwrap_err();
        assert!(error.to_string().contains("cannot be told apart"), "{error}");
    }
}
