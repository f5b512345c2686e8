//! Tail of a tool: its removal beyond the samples of its TIF.
//!
//! A measured spot is cut where it still removes something. What it removes beyond moves with the tool, so a run with a
//! displaced tool has a removal that no displacement of the cut TIF has. The tail continues the samples as a Gaussian
//! falls:
//!
//! ```text
//! R(p) = R(b) exp(-(|p|^2 - |b|^2) / 2 s^2)       b the last sample on the way from the centre to p
//! ```
//!
//! s is from the least-squares line of ln R over |p|^2, with the weights R^2, through the outer samples of the TIF.

use ndarray::Array2;
use planish_types::{Axis, Grid, Invalid, Tif};

use crate::tool::{ends_by_itself, inside, smoothed};

/// Smallest mean rate of the outermost samples, as a fraction of the peak; a TIF with less gets no tail. Larger: more
/// of a removal that the tail explains is taken for an error of the machine. Smaller: more time for tails that no map
/// shows. Chosen.
const LEAST_AT_END: f64 = 2e-3;

/// Rate, as a fraction of the peak, at which the tail ends. Larger: a step at its end. Smaller: more samples. Chosen.
const END: f64 = 1e-5;

/// Largest ratio of the half size of the TIF with its tail to that without. Larger: more samples of a tail that falls
/// slowly. Smaller: such a tail ends with a step. Chosen.
const LARGEST_OVER_HALF: f64 = 2.0;

/// Largest volume of the tail as a fraction of that of the samples; with a larger one the TIF gets no tail. Larger: a
/// baseline that is left in the TIF becomes a tail. Smaller: a spot that is cut close keeps its cut. Chosen.
const MOST_VOLUME: f64 = 0.3;

/// Returns the TIF continued by a tail beyond its samples. Returns `None` if the tool varies, if the TIF falls to zero
/// or below `LEAST_AT_END` within its samples, if these do not show a fall, or if the tail is larger than
/// `MOST_VOLUME`.
///
/// # Errors
///
/// Fails if the samples with the tail are not those of a TIF.
pub fn continued(tif: &Tif) -> Result<Option<Tif>, Invalid> {
    if tif.variation().is_some() {
        return Ok(None);
    }
    let inside = inside(tif);
    let Grid { x, y } = *tif.grid();
    let (ny, nx) = inside.dim();
    let rate = smoothed(tif, &inside, tif.width_mm());
    let square = |r: usize, c: usize| x.coordinate_mm(c).powi(2) + y.coordinate_mm(r).powi(2);
    let mut last = 0.0;
    let mut count = 0.0;
    let mut nearest = f64::INFINITY;
    for ((r, c), v) in rate.indexed_iter() {
        if inside[[r, c]] && is_beside_end(&inside, r, c) {
            last += v;
            count += 1.0;
            nearest = f64::min(nearest, square(r, c));
        }
    }
    let peak = tif.peak_nm_per_s();
    let last = last / f64::max(count, 1.0);
    if last < LEAST_AT_END * peak || ends_by_itself(tif, &inside) {
        return Ok(None);
    }
    let from = (nearest.sqrt() - tif.width_mm()).max(0.0).powi(2);
    let outer = rate
        .indexed_iter()
        .filter(|((r, c), v)| inside[[*r, *c]] && **v > 0.0 && square(*r, *c) >= from);
    let Some(two_s2) = fall(outer.map(|((r, c), v)| (square(r, c), *v))) else { return Ok(None) };
    let end = (nearest + two_s2 * (last / (END * peak)).ln()).sqrt();
    let (more_x, x2) = extended(&x, end)?;
    let (more_y, y2) = extended(&y, end)?;
    let tail = |px: f64, py: f64| {
        // The last sample on the way from the centre, by half steps back from p.
        let steps = 2 * (nx.max(ny) + more_x.max(more_y));
        (0..steps).find_map(|k| {
            let part = 1.0 - k as f64 / steps as f64;
            let c = nearest_sample(&x, part * px)?;
            let r = nearest_sample(&y, part * py)?;
            let from = square(r, c);
            let v = rate[[r, c]] * ((from - px * px - py * py) / two_s2).exp();
            if inside[[r, c]] { Some(v.max(0.0)) } else { None }
        })
    };
    let with_tail = Array2::from_shape_fn((y2.len(), x2.len()), |(r, c)| {
        let own = (r.checked_sub(more_y), c.checked_sub(more_x));
        match own {
            (Some(r), Some(c)) if r < ny && c < nx && inside[[r, c]] => tif.rate_nm_per_s()[[r, c]],
            _ => tail(x2.coordinate_mm(c), y2.coordinate_mm(r)).unwrap_or(0.0),
        }
    });
    let volume = tif.rate_nm_per_s().sum();
    if with_tail.sum() - volume <= MOST_VOLUME * volume {
        Tif::new(Grid { x: x2, y: y2 }, with_tail).map(Some)
    } else {
        Ok(None)
    }
}

/// Returns true if a sample of the TIF is at the border of its array, or beside a sample outside of the tool.
fn is_beside_end(inside: &Array2<bool>, r: usize, c: usize) -> bool {
    let (ny, nx) = inside.dim();
    let at_border = r == 0 || c == 0 || r + 1 == ny || c + 1 == nx;
    at_border
        || !(inside[[r - 1, c]] && inside[[r + 1, c]] && inside[[r, c - 1]] && inside[[r, c + 1]])
}

/// Extends an axis to both sides up to `end` mm from the centre, but to at most `LARGEST_OVER_HALF` of its half size.
/// Returns the number of samples that are added on each side, and the new axis.
fn extended(axis: &Axis, end: f64) -> Result<(usize, Axis), Invalid> {
    let half = axis.start_mm().abs().max(axis.end_mm().abs());
    let more =
        ((end.min(LARGEST_OVER_HALF * half) - half).max(0.0) / axis.step_mm()).ceil() as usize;
    let start = axis.start_mm() - more as f64 * axis.step_mm();
    Ok((more, Axis::new(start, axis.step_mm(), axis.len() + 2 * more)?))
}

/// Returns the index of the sample nearest to the coordinate `mm`; `None` if that lies more than half a step beyond the
/// samples.
fn nearest_sample(axis: &Axis, mm: f64) -> Option<usize> {
    let i = ((mm - axis.start_mm()) / axis.step_mm()).round();
    if i >= 0.0 && i < axis.len() as f64 { Some(i as usize) } else { None }
}

/// Returns 2 s^2 of the module from samples (|p|^2, R), mm^2; `None` if they do not fall.
fn fall(samples: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    // Weighted sums of 1, |p|^2, ln R, |p|^4, |p|^2 ln R
    let mut sums = [0.0; 5];
    for (square, rate) in samples {
        let weight = rate * rate;
        let log = rate.ln();
        let row = [1.0, square, log, square * square, square * log];
        sums.iter_mut().zip(row).for_each(|(sum, v)| *sum += weight * v);
    }
    let [n, s, l, ss, sl] = sums;
    let slope = (n * sl - s * l) / (n * ss - s * s);
    if slope < 0.0 { Some(-1.0 / slope).filter(|v| v.is_finite()) } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sampled(half: f64, rate: impl Fn(f64, f64) -> f64) -> Tif {
        let n = (half / 0.1).round() as usize;
        let axis = Axis::new(-half, 0.1, 2 * n + 1).unwrap();
        let of = |(r, c): (usize, usize)| rate(axis.coordinate_mm(c), axis.coordinate_mm(r));
        Tif::new(Grid { x: axis, y: axis }, Array2::from_shape_fn((2 * n + 1, 2 * n + 1), of))
            .unwrap()
    }

    #[test]
    fn a_gaussian_that_is_cut_gets_its_tail_back() {
        let gaussian = |x: f64, y: f64| 8.0 * (-(x * x + y * y) / (2.0 * 1.7 * 1.7)).exp();
        // Cut at 1.3 % of the peak, by a square and by a circle.
        let circle = |x: f64, y: f64| if x.hypot(y) <= 5.0 { gaussian(x, y) } else { 0.0 };
        for cut in [sampled(5.0, gaussian), sampled(5.2, circle)] {
            let tif = continued(&cut).unwrap().unwrap();
            let volume = 8.0 * 2.0 * std::f64::consts::PI * 1.7 * 1.7;
            // The volume beyond the end of the tail is 1e-5 of the whole; smoothing has 1e-3 of the rim.
            assert!((tif.vrr_nm_mm2_per_s() / volume - 1.0).abs() < 5e-4);
            for (x, y) in [(5.5, 0.0), (0.0, -6.0), (4.2, 4.6), (-5.0, 5.0)] {
                let expected = gaussian(x, y);
                // A step of 0.1 mm from the last sample to the rim at a slope of 5 / 1.7^2, and the smoothing.
                assert!((tif.rate_at(x, y) - expected).abs() < 0.02 * 0.1, "{x} {y}: {expected}");
            }
        }
    }

    #[test]
    fn a_tool_that_ends_by_itself_has_no_tail() {
        let paraboloid = |x: f64, y: f64| (9.0 - x * x - y * y).max(0.0);
        assert!(continued(&sampled(4.0, paraboloid)).unwrap().is_none());
        // A flat pad: its samples do not fall.
        assert!(continued(&sampled(2.0, |_, _| 3.0)).unwrap().is_none());
        // A Gaussian that has ended.
        let narrow = |x: f64, y: f64| (-(x * x + y * y) / 0.5).exp();
        assert!(continued(&sampled(3.0, narrow)).unwrap().is_none());
    }
}
