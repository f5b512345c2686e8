//! The baseline feed, from the volumetric removal rate (VRR) and the desired removal alone.
//!
//! ```text
//! F(s) = VRR / (z(P(s)) p),   D(s) = z p / VRR >= 1/F_max                                   (1)
//! ```
//!
//! with the desired removal z at the position of the tool and the distance p of neighbouring passes. It is
//! right where z varies slowly against the TIF; elsewhere the TIF blurs it. (1) is a feed that no
//! machine follows; what is scheduled is the spline closest to it within the limits,
//!
//! ```text
//! min integral (sum_i d_i B_i - D)^2 ds                                                      (2)
//! ```
//!
//! Beyond the map z is that of the nearest valid pixel.
//!
//! Source: the B-spline deconvolution of feed profiles, Eq. 1, which it is compared with.

use ndarray::Array2;
use planish_numerics::{bspline::Knots, quadrature::gauss_legendre};
use planish_types::Tif;

use crate::{limited::Quadratic, passes::Pass};

/// Largest angle (its sine), rad, between two directions that count as parallel. Larger: passes in other directions
/// count as neighbours. Smaller: rounding of the directions hides neighbours.
const PARALLEL: f64 = 1e-3;

/// Returns the distance p of every pass to its nearest parallel neighbour, mm. For a pass without one it is the width
/// of the groove that the TIF makes: volume over depth.
pub fn pitches_mm(passes: &[Pass], tif: &Tif) -> Vec<f64> {
    passes.iter().map(|p| pitch_mm(p, passes).unwrap_or_else(|| groove_width_mm(p, tif))).collect()
}

/// Returns the distance of a pass to the nearest parallel pass that overlaps it along its direction, mm; `None` if
/// there is none.
fn pitch_mm(pass: &Pass, passes: &[Pass]) -> Option<f64> {
    let [tx, ty] = pass.direction;
    let beside = passes.iter().filter_map(|other| {
        let cross = tx * other.direction[1] - ty * other.direction[0];
        if cross.abs() > PARALLEL {
            return None;
        }
        let [(a, across), (b, _)] = [other.start_mm, other.position(other.length_mm())].map(|p| {
            let dx = p[0] - pass.start_mm[0];
            let dy = p[1] - pass.start_mm[1];
            (dx * tx + dy * ty, dy * tx - dx * ty)
        });
        let overlap = a.min(b) < pass.length_mm() && a.max(b) > 0.0;
        // Nearer than this it is the same line.
        if overlap && across.abs() > 1e-6 { Some(across.abs()) } else { None }
    });
    beside.reduce(f64::min)
}

/// Returns the width of the groove that the TIF makes along the pass: VRR over the largest line integral of the TIF,
/// mm.
fn groove_width_mm(pass: &Pass, tif: &Tif) -> f64 {
    let [tx, ty] = pass.direction;
    let [hx, hy] = tif.half_size_mm();
    let reach = hx.hypot(hy);
    let step = 0.5 * tif.grid().x.step_mm().min(tif.grid().y.step_mm());
    let n = (reach / step).ceil() as i64;
    let places: Vec<f64> = (-n..=n).map(|k| k as f64 * step).collect();
    let lines = places.iter().map(|w| {
        let rates = places.iter().map(|s| tif.rate_at(s * tx - w * ty, s * ty + w * tx));
        rates.sum::<f64>() * step
    });
    let depth = lines.fold(0.0, f64::max);
    tif.vrr_nm_mm2_per_s() / depth
}

/// Returns the dwell-time density (1) of the module for a desired removal of `z_nm`, s/mm; `least` is its lower bound.
pub fn density_s_per_mm(z_nm: f64, pitch_mm: f64, vrr_nm_mm2_per_s: f64, least: f64) -> f64 {
    (z_nm * pitch_mm / vrr_nm_mm2_per_s).max(least)
}

/// Returns the objective (2) of the module as a quadratic of the control values. It is half of the integral of the
/// squared distance of the spline to the dwell density `wanted(s)`.
pub fn closest(knots: &Knots, wanted: impl Fn(f64) -> f64) -> Quadratic {
    let n = knots.len();
    let mut p = Array2::zeros((n, n));
    let mut q = vec![0.0; n];
    for span in knots.breaks().windows(2) {
        let h = span[1] - span[0];
        for (u, w) in gauss_legendre::<5>() {
            let s = span[0] + u * h;
            let (first, b) = knots.basis(s);
            let d = wanted(s);
            for i in 0..4 {
                q[first + i] += w * h * b[i] * d;
                for j in 0..4 {
                    p[[first + i, first + j]] += w * h * b[i] * b[j];
                }
            }
        }
    }
    Quadratic { p, q }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{Axis, Grid};

    fn pass(y: f64, forward: bool) -> Pass {
        Pass {
            first_segment: 0,
            arc_start_mm: 0.0,
            start_mm: [if forward { 0.0 } else { 10.0 }, y],
            direction: [if forward { 1.0 } else { -1.0 }, 0.0],
            node_mm: vec![0.0, 10.0],
            tool_on_after: false,
            max_feed_mm_per_s: 1.0,
            max_acceleration_mm_per_s2: 1.0,
        }
    }

    fn tif() -> Tif {
        let axis = Axis::new(-3.0, 0.1, 61).unwrap();
        let grid = Grid { x: axis, y: axis };
        let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            (-(axis.coordinate_mm(c).powi(2) + axis.coordinate_mm(r).powi(2)) / (2.0 * 0.5 * 0.5))
                .exp()
        });
        Tif::new(grid, rate).unwrap()
    }

    #[test]
    fn the_pitch_is_the_distance_to_the_nearest_neighbour() {
        let passes = [pass(0.0, true), pass(0.7, false), pass(2.0, true)];
        let p = pitches_mm(&passes, &tif());
        for (p, expected) in p.iter().zip([0.7, 0.7, 1.3]) {
            // Rounding of coordinates of 1 mm.
            assert!((p - expected).abs() < 1e-12);
        }
        // A Gaussian groove: 2 pi s^2 / (s sqrt(2 pi)) = s sqrt(2 pi).
        let alone = pitches_mm(&passes[..1], &tif())[0];
        // Sums over samples of a Gaussian that has faded at the border. Regression bound: 3.8e-10 was seen.
        assert!(
            (alone / (0.5 * (2.0 * std::f64::consts::PI).sqrt()) - 1.0).abs() < 1e-6,
            "{alone}"
        );
    }

    #[test]
    fn the_closest_spline_to_a_cubic_is_the_cubic() {
        let knots = Knots::uniform(10.0, 7);
        let cubic = |s: f64| 1.0 + 0.1 * s - 0.02 * s * s + 0.003 * s * s * s;
        let quadratic = closest(&knots, cubic);
        let greville = knots.greville();
        // The gradient vanishes at its control values, found by interpolation at Greville's abscissae.
        let n = knots.len();
        let mut d = vec![0.0; n];
        for _ in 0..200 {
            for i in 0..n {
                d[i] += cubic(greville[i]) - knots.value(&d, greville[i]);
            }
        }
        for i in 0..n {
            let slope: f64 =
                (0..n).map(|j| quadratic.p[[i, j]] * d[j]).sum::<f64>() - quadratic.q[i];
            // Rounding of sums of ten terms of the order 1; the iteration has converged to that.
            assert!(slope.abs() < 1e-10, "{slope}");
        }
    }
}
