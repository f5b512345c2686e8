//! Damped least squares without bounds, by LSQR.
//!
//! ```text
//! min || P W^1/2 (B t - z) ||^2 + delta^2 || t - t_ref ||^2                                (1)
//! ```
//!
//! where P subtracts the free piston, and t_ref are reference dwell times whose level is just high enough for the floor
//! ([`crate::problem`]). All dampings of the search share one bidiagonalisation ([`planish_numerics::linear::lsqr`]).
//! delta is given, or found:
//!
//! * *discrepancy*: the largest delta whose residual is not above the noise of the map;
//! * *L-curve*: the corner of ln |residual| against ln |t - t_ref|, where the circle through three
//!   neighbouring points is smallest.
//!
//! Source: C. C. Paige, M. A. Saunders, ACM Trans. Math. Softw. 8 (1982) 43; P. C. Hansen,
//! Rank-Deficient and Discrete Ill-Posed Problems (1998), sections 7.3 and 7.5.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `desired` | (ny, nx) | nm |
//! | t | `dwell_s` | (n) | s |
//! | delta | `damping_nm_per_s` | - | nm/s |

use planish_numerics::linear::lsqr::{Damped, largest_singular_value, lsqr};
use planish_types::{End, progress};
use serde::Serialize;

use crate::{
    DwellError,
    problem::{DwellModel, Problem, Solution, check},
};

/// Choice of the damping delta. Relative dampings are fractions of the largest singular value of the weighted removal
/// matrix `P W^1/2 B`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Damping {
    /// This damping as a fraction of the largest singular value, > 0.
    Relative(f64),
    /// Largest damping whose residual (RMS, mean removed) is at most this noise, nm.
    Discrepancy(f64),
    /// Damping at the corner of the L-curve.
    LCurve,
}

/// Settings of the damped least squares.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TikhonovLsqrSettings {
    /// Choice of the damping delta.
    pub damping: Damping,
    /// Relative size of the gradient, the product of the residual with the columns, at which LSQR ends; 0 at the
    /// minimum.
    pub tolerance: f64,
    /// Largest number of steps of LSQR.
    pub max_iterations: usize,
}

impl Default for TikhonovLsqrSettings {
    fn default() -> Self {
        // On a measured mirror dwell times are not negative from 1e-2 on, and the residual is within
        // a tenth of the unconstrained least one.
        Self { damping: Damping::Relative(1e-2), tolerance: 1e-6, max_iterations: 2000 }
    }
}

/// Report of the damped least squares.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TikhonovLsqrReport {
    /// Reason for the end: `converged` or `iteration-limit`.
    pub end: End,
    /// Number of steps of LSQR: the larger one of the two solutions, for the map and for the level of dwell.
    pub iterations: usize,
    /// Relative damping that was used, as a fraction of the largest singular value.
    pub relative_damping: f64,
    /// Damping delta that was used, nm/s, in the unit of the singular values of the weighted removal matrix.
    pub damping_nm_per_s: f64,
    /// True if the residual is not above the given noise; always true without `discrepancy`.
    pub noise_reached: bool,
    /// Relative dampings that were tried; only one without a search.
    pub searched: Vec<f64>,
    /// RMS (mean removed) of the residual for every damping tried, nm, before the level of dwell is added.
    pub searched_rms_nm: Vec<f64>,
    /// Norm |t - t_ref| of the dwell times above the level of dwell, for every damping tried, s.
    pub searched_norm_s: Vec<f64>,
    /// Level of dwell c, s: the reference dwell time of a segment of median length, the least that meets the floor ((3)
    /// of [`crate::problem`]).
    pub level_s: f64,
    /// Number of dwell times that are still below their floor at this level; they are set to it.
    pub clipped: usize,
}

impl TikhonovLsqrReport {
    /// Returns the reason of a negative verdict; none if the solver converged and reached the noise.
    pub fn negative(&self) -> Option<String> {
        if !self.noise_reached {
            let least = self.searched_rms_nm.iter().copied().fold(f64::INFINITY, f64::min);
            Some(format!("the least residual of the search is {least:.4} nm RMS, above the noise"))
        } else if self.end != End::Converged {
            Some(format!("not converged after {} steps of LSQR", self.iterations))
        } else {
            None
        }
    }
}

/// Relative dampings of the search for a corner: smallest, largest and number, eight per decade. A wider range or a
/// larger number: more time. A narrower range: the corner may lie outside of it.
const SEARCHED_DAMPINGS: (f64, f64, usize) = (1e-3, 1e-1, 17);

/// Relative dampings of the search for a noise level: smallest, largest and number, eight per decade. The noise may be
/// a large part of the map, so the range goes up to a damping with which nearly nothing is removed. A smaller upper
/// end: the search may not reach the noise.
const SEARCHED_FOR_NOISE: (f64, f64, usize) = (1e-3, 1e1, 33);

/// Number of parts into which the search divides the interval of two dampings between which the residual falls to the
/// noise. Neighbours then differ by 4 %. Larger: the residual meets the noise more closely, in more time.
const PARTS_AT_THE_NOISE: usize = 8;

impl Damping {
    fn check(self) -> Result<(), DwellError> {
        match self {
            Damping::Relative(d) => check("damping", d, |d| d > 0.0, "give a number > 0")?,
            Damping::Discrepancy(noise) => {
                let remedy = "give the noise of the map in nm, > 0";
                check("noise_rms_nm", noise, |n| n > 0.0, remedy)?;
            }
            Damping::LCurve => {}
        }
        Ok(())
    }
}

/// Finds the dwell times that minimise (1) of the module, with the given damping or that of the search.
///
/// # Errors
/// Refuses a damping or a noise that is not positive. Every solver refuses weights and floors out of range, a floor
/// that alone removes more than the PV of the map, a TIF that varies in time, and a tool that does not reach the map.
pub fn solve(
    problem: &Problem<'_>,
    settings: &TikhonovLsqrSettings,
) -> Result<Solution<TikhonovLsqrReport>, DwellError> {
    settings.damping.check()?;
    let model = DwellModel::new(problem)?;
    let largest =
        largest_singular_value(|t| model.weighted_adjoint(&model.weighted(t)), problem.path.len());
    if largest <= 0.0 {
        return Err(DwellError::OutOfReach { points: problem.path.len() });
    }
    let mut relative = match settings.damping {
        Damping::Relative(d) => vec![d],
        Damping::LCurve => falling_dampings(SEARCHED_DAMPINGS),
        Damping::Discrepancy(_) => falling_dampings(SEARCHED_FOR_NOISE),
    };
    let projected = model.project(problem.desired.height_nm());
    let mut solutions =
        progress::part(0, 3, || damped(&model, &projected, largest, &relative, settings));
    let mut rms = residual_rms(&model, &solutions);
    if let Damping::Discrepancy(noise) = settings.damping
        && let Some(k) = rms.iter().position(|r| *r <= noise).filter(|k| *k > 0)
    {
        // Between the last damping with too large a residual and the first without
        let inner = falling_dampings((relative[k], relative[k - 1], PARTS_AT_THE_NOISE + 1));
        let inner = inner[1..PARTS_AT_THE_NOISE].to_vec();
        let of_inner =
            progress::part(1, 3, || damped(&model, &projected, largest, &inner, settings));
        rms.splice(k..k, residual_rms(&model, &of_inner));
        solutions.splice(k..k, of_inner);
        relative.splice(k..k, inner);
    }
    let norm: Vec<f64> =
        solutions.iter().map(|f| f.value.iter().map(|t| t * t).sum::<f64>().sqrt()).collect();
    let (chosen, noise_reached) = match settings.damping {
        Damping::Relative(_) => (0, true),
        Damping::Discrepancy(noise) => match rms.iter().position(|r| *r <= noise) {
            Some(k) => (k, true),
            None => (relative.len() - 1, false),
        },
        Damping::LCurve => (corner(&rms, &norm), true),
    };
    // The answer to a level of dwell: b = s + argmin |A u + A s|^2 + delta^2 |u|^2.
    let level: Vec<f64> = model.weighted(&model.shape).iter().map(|v| -v).collect();
    let chosen_damping = &relative[chosen..=chosen];
    let answer = progress::part(2, 3, || damped(&model, &level, largest, chosen_damping, settings))
        .remove(0);
    let b: Vec<f64> = model.shape.iter().zip(&answer.value).map(|(s, u)| s + u).collect();
    let chosen_one = &solutions[chosen];
    let levelled = model.levelled(&chosen_one.value, &b);
    let converged = chosen_one.converged && answer.converged;
    let report = TikhonovLsqrReport {
        end: if converged { End::Converged } else { End::IterationLimit },
        iterations: chosen_one.iterations.max(answer.iterations),
        relative_damping: relative[chosen],
        damping_nm_per_s: relative[chosen] * largest,
        noise_reached,
        level_s: levelled.level_s,
        clipped: levelled.clipped,
        searched: relative,
        searched_rms_nm: rms,
        searched_norm_s: norm,
    };
    model.finish(levelled.dwell_s, report)
}

/// Returns the dampings of a search (smallest, largest, number), in falling order and equal ratios.
fn falling_dampings((from, to, count): (f64, f64, usize)) -> Vec<f64> {
    (0..count).map(|k| to * (from / to).powf(k as f64 / (count - 1) as f64)).collect()
}

/// Returns the solutions t - t_ref for the right-hand side b, one for each of the dampings `relative`, which are
/// fractions of `largest`, the largest singular value.
fn damped(
    model: &DwellModel<'_>,
    b: &[f64],
    largest: f64,
    relative: &[f64],
    settings: &TikhonovLsqrSettings,
) -> Vec<Damped> {
    let dampings: Vec<f64> = relative.iter().map(|d| d * largest).collect();
    lsqr(
        |t| model.weighted(t),
        |y| model.weighted_adjoint(y),
        b,
        &dampings,
        settings.tolerance,
        settings.max_iterations,
        progress::of_excess(),
    )
}

/// Returns the RMS (mean removed) of the residual `z - B t` of each solution, without the level of dwell, nm.
fn residual_rms(model: &DwellModel<'_>, solutions: &[Damped]) -> Vec<f64> {
    let z = model.problem.desired.height_nm();
    solutions.iter().map(|f| model.rms(&(z - &model.operator.apply(&f.value)))).collect()
}

/// Returns the index of the corner of the L-curve (ln residual, ln norm): the point with the largest Menger curvature
/// `4 area / (product of the sides)` of it and its two neighbours, among those that turn towards the origin. Returns 0
/// if there are fewer than three points.
fn corner(residual: &[f64], norm: &[f64]) -> usize {
    let p: Vec<[f64; 2]> = residual.iter().zip(norm).map(|(r, n)| [r.ln(), n.ln()]).collect();
    (1..p.len().saturating_sub(1))
        .max_by(|a, b| {
            turn([p[a - 1], p[*a], p[a + 1]]).total_cmp(&turn([p[b - 1], p[*b], p[b + 1]]))
        })
        .unwrap_or(0)
}

/// Returns the Menger curvature of three points, positive for a turn to the right. Damping falls along the curve: the
/// residual first falls, then the norm rises, so that a turn to the right is the corner. Minus infinity if two points
/// are the same.
fn turn([a, b, c]: [[f64; 2]; 3]) -> f64 {
    let cross = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    let sides = distance(a, b) * distance(b, c) * distance(a, c);
    if sides > 0.0 { -2.0 * cross / sides } else { f64::NEG_INFINITY }
}

/// Returns the Euclidean distance of two points [x, y].
fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (b[0] - a[0]).hypot(b[1] - a[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_corner_of_an_l_is_found() {
        // Residual falls from e^4 to 1 at the norm 1, then the norm rises at the residual 1.
        let points: Vec<(f64, f64)> = (0..9)
            .map(|k| f64::from(k - 4))
            .map(|s| if s < 0.0 { (-s, 0.01 * s) } else { (-0.01 * s, s) })
            .collect();
        let (r, n): (Vec<f64>, Vec<f64>) = points.iter().map(|(r, n)| (r.exp(), n.exp())).unzip();
        assert_eq!(corner(&r, &n), 4);
        // The circle through three neighbours is smallest where a parabola is most curved, at its vertex.
        let points: Vec<(f64, f64)> =
            (0..9).map(f64::from).map(|s: f64| (-s, 0.02 * s * s)).collect();
        let (r, n): (Vec<f64>, Vec<f64>) = points.iter().map(|(r, n)| (r.exp(), n.exp())).unzip();
        assert_eq!(corner(&r, &n), 1);
    }

    #[test]
    fn a_turn_away_from_the_origin_is_no_corner() {
        // A sharp turn to the left at 2, a slight one to the right at 4.
        let points = [
            (0.0, 0.0),
            (-1.0, 0.0),
            (-2.0, 0.0),
            (-2.0, -1.0),
            (-2.0, -2.0),
            (-2.2, -3.0),
            (-2.4, -4.0),
        ];
        let (r, n): (Vec<f64>, Vec<f64>) =
            points.iter().map(|(r, n): &(f64, f64)| (r.exp(), n.exp())).unzip();
        assert_eq!(corner(&r, &n), 4);
    }
}
