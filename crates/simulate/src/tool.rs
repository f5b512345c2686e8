//! The TIF that errors change: the measured one without its noise, and without a step where its samples end.
//!
//! A tool that moves by a fraction of a pixel moves the noise of its TIF, and the steps at its border, over the
//! pixels' centres, with every pass: a change without a derivative, which no mirror would show, because it is the
//! measurement that has noise and an end, not the tool. So what errors change is computed with a TIF that is
//! smooth, and what the plan leaves with that of the plan.

use std::borrow::Cow;

use nalgebra::{SMatrix, SVector};
use ndarray::Array2;
use planish_types::{Grid, Invalid, OnLattice, Tif, Variation};
use rayon::prelude::*;

/// Radius over which a TIF is smoothed, in widths of the TIF. A quadratic is off by 1e-3 from a Gaussian there. Larger:
/// the shape of the tool is smoothed away. Smaller: more noise remains.
const SMOOTHED: f64 = 0.5;

/// Largest radius over which a TIF is smoothed, in samples. Larger: more time, without need against noise. Smaller:
/// more noise of finely sampled TIFs remains.
const MOST_SAMPLES: f64 = 9.0;

/// Smallest number of samples for the fit of a quadratic: twice the number of its coefficients. With fewer, the sample
/// stays as it is. Larger: noise at the border stays. Smaller: the fit follows the noise.
const LEAST_SAMPLES: usize = 12;

/// Distance over which a TIF falls to zero at its border, in widths of the TIF. Larger: more of the tool is weakened.
/// Smaller: a steep border, whose displacement causes large errors.
const FADED: f64 = 1.0;
/// Largest distance over which a TIF falls to zero at its border, as a fraction of its extent. Larger: more of the tool
/// is weakened. Smaller: a steep border, whose displacement causes large errors.
const MOST_FADED: f64 = 0.2;

/// Largest error of a TIF that is resampled on the pixels of the map, as a fraction of its peak. It equals the error of
/// Keys' convolution for a Gaussian whose standard deviation is two samples, and errors are a small part of the
/// removal. Larger: less exact errors. Smaller: a finer lattice, and more time for every run.
const RESAMPLED: f64 = 2e-3;

/// Rate, as a fraction of the peak, up to which a sample is outside of the tool. Larger: the rim of the tool is cut.
/// Smaller: rounding counts as part of the tool.
const NOTHING: f64 = 1e-9;

/// Returns the TIF smoothed, and faded to zero at its border, with the same volumetric removal rate. `width_mm` is its
/// width. If the tool varies, the same linear operation acts on every kernel, and so on the tool at every place.
///
/// # Errors
///
/// Fails if the smoothed samples are not those of a TIF.
pub fn smooth(tif: &Tif, width_mm: f64) -> Result<Tif, Invalid> {
    let extent = tif.grid().size_mm();
    let over_mm = (FADED * width_mm).min(MOST_FADED * extent[0].min(extent[1]));
    let inside = inside(tif);
    let fade = fade(tif, &inside, over_mm);
    let smooth = |kernel: &Tif| smoothed(kernel, &inside, width_mm) * &fade;
    let volume = tif.rate_nm_per_s().sum() / smooth(tif).sum();
    tif.with_kernels(|kernel| Ok((*tif.grid(), smooth(kernel) * volume)))
}

/// The TIF that errors change.
#[derive(Clone, Debug)]
pub struct Moved<'a> {
    /// The smooth TIF, or the given one.
    pub tif: Cow<'a, Tif>,
    /// Largest error of its samples on the pixels of the map, as a fraction of its peak; 0 if it was not resampled.
    pub resampling_error: f64,
}

/// Returns the TIF that errors change over a map: smoothed, and sampled on the lattice of the map with an error of at
/// most `RESAMPLED`. If `as_sampled` is true it is `tif` itself.
pub fn moved<'a>(tif: &'a Tif, map: &Grid, as_sampled: bool) -> Result<Moved<'a>, Invalid> {
    if as_sampled {
        return Ok(Moved { tif: Cow::Borrowed(tif), resampling_error: 0.0 });
    }
    let smooth = smooth(tif, tif.width_mm())?;
    let OnLattice { tif, lattice } = smooth.on_lattice_of(map, RESAMPLED)?;
    Ok(Moved { tif: Cow::Owned(tif.into_owned()), resampling_error: lattice.error })
}

/// Returns true for the samples that are part of the tool: the rate of the mean tool, or of any kernel, is above
/// [`NOTHING`] of the peak.
pub(crate) fn inside(tif: &Tif) -> Array2<bool> {
    let least = NOTHING * tif.peak_nm_per_s();
    let mut inside = tif.rate_nm_per_s().mapv(|v| v.abs() > least);
    for component in tif.variation().map_or(&[][..], Variation::components) {
        let samples = component.kernel().rate_nm_per_s();
        inside.zip_mut_with(samples, |inside, v| *inside |= v.abs() > least);
    }
    inside
}

/// Smooths a kernel: every sample inside of the tool gets the value of the quadratic through the inside samples around
/// it, nm/s. A sample with fewer than `LEAST_SAMPLES` around it, or outside of the tool, stays.
pub(crate) fn smoothed(kernel: &Tif, inside: &Array2<bool>, width_mm: f64) -> Array2<f64> {
    let rate = kernel.rate_nm_per_s();
    let (ny, nx) = rate.dim();
    let step = [kernel.grid().x.step_mm(), kernel.grid().y.step_mm()];
    let radius_mm = (SMOOTHED * width_mm).min(MOST_SAMPLES * step[0].min(step[1]));
    let [reach_x, reach_y] = step.map(|s| (radius_mm / s) as usize);
    rows_in_parallel((ny, nx), |r, c| {
        if !inside[[r, c]] {
            return rate[[r, c]];
        }
        let mut normal = SMatrix::<f64, 6, 6>::zeros();
        let mut right = SVector::<f64, 6>::zeros();
        let mut samples = 0;
        for i in r.saturating_sub(reach_y)..(r + reach_y + 1).min(ny) {
            for j in c.saturating_sub(reach_x)..(c + reach_x + 1).min(nx) {
                let x = (j as f64 - c as f64) * step[0] / radius_mm;
                let y = (i as f64 - r as f64) * step[1] / radius_mm;
                if x * x + y * y <= 1.0 && inside[[i, j]] {
                    let row = SVector::from([1.0, x, y, x * x, x * y, y * y]);
                    normal += row * row.transpose();
                    right += row * rate[[i, j]];
                    samples += 1;
                }
            }
        }
        let fit = normal.cholesky().filter(|_| samples >= LEAST_SAMPLES);
        fit.map_or(rate[[r, c]], |f| f.solve(&right)[0])
    })
}

/// Computes every element (row, column) of an array of this shape, the rows on all threads.
fn rows_in_parallel(
    (ny, nx): (usize, usize),
    element: impl Fn(usize, usize) -> f64 + Sync,
) -> Array2<f64> {
    let rows: Vec<Vec<f64>> =
        (0..ny).into_par_iter().map(|r| (0..nx).map(|c| element(r, c)).collect()).collect();
    Array2::from_shape_fn((ny, nx), |(r, c)| rows[r][c])
}

/// Returns the points just outside of the tool, in samples (column, row), and true if the rate of the tool falls to
/// zero there: the outermost samples, summed, are at most the fall to them from the samples before.
fn end_of(tif: &Tif, inside: &Array2<bool>) -> (Vec<[f64; 2]>, bool) {
    let rate = tif.rate_nm_per_s();
    let (ny, nx) = rate.dim();
    let inside = |r: isize, c: isize| {
        let known = r >= 0 && c >= 0 && (r as usize) < ny && (c as usize) < nx;
        known && inside[[r as usize, c as usize]]
    };
    // Places just outside: those beside a sample inside.
    let mut outside = Vec::new();
    // What the samples at the end have, and by how much they are below those before them.
    let mut last = 0.0;
    let mut fall = 0.0;
    for r in -1..=ny as isize {
        for c in -1..=nx as isize {
            let beside = [(0, 1), (0, -1), (1, 0), (-1, 0)].into_iter();
            let inwards = beside.filter(|(i, j)| !inside(r, c) && inside(r + i, c + j));
            let mut is_beside = false;
            for (i, j) in inwards {
                is_beside = true;
                let here = rate[[(r + i) as usize, (c + j) as usize]];
                if inside(r + 2 * i, c + 2 * j) {
                    last += here;
                    fall += rate[[(r + 2 * i) as usize, (c + 2 * j) as usize]] - here;
                }
            }
            if is_beside {
                outside.push([c as f64, r as f64]);
            }
        }
    }
    // It ends by itself: going on as it falls it would be zero within the next step.
    (outside, last <= fall)
}

/// Returns true if the TIF falls to zero within its samples.
pub(crate) fn ends_by_itself(tif: &Tif, inside: &Array2<bool>) -> bool {
    end_of(tif, inside).1
}

/// Returns the weight of every sample: 1 at `over_mm` or more from the points just outside of the tool, and smoothly to
/// 0 there. It is 1 everywhere if the TIF falls to zero within its samples, because that edge is one of the tool and
/// not of its measurement.
fn fade(tif: &Tif, inside: &Array2<bool>, over_mm: f64) -> Array2<f64> {
    let (ny, nx) = inside.dim();
    let step = [tif.grid().x.step_mm(), tif.grid().y.step_mm()];
    let (outside, ends_by_itself) = end_of(tif, inside);
    if ends_by_itself {
        return Array2::ones((ny, nx));
    }
    rows_in_parallel((ny, nx), |r, c| {
        let squares = outside
            .iter()
            .map(|o| ((o[0] - c as f64) * step[0]).powi(2) + ((o[1] - r as f64) * step[1]).powi(2));
        let nearest_mm = squares.fold(f64::INFINITY, f64::min).sqrt();
        let s = (nearest_mm / over_mm).min(1.0);
        s * s * (3.0 - 2.0 * s)
    })
}
