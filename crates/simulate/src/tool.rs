//! The TIF that errors move: a measured one without its noise, and without a step where its samples end.
//!
//! A tool that moves by a fraction of a pixel moves the noise of its TIF, and the steps at its border, over the
//! pixels' centres, with every pass: a change without a derivative, which no mirror would show, because it is the
//! measurement that has noise and an end, not the tool. So what errors change is computed with a TIF that is
//! smooth, and what the plan leaves with that of the plan.

use nalgebra::{SMatrix, SVector};
use ndarray::Array2;
use planish_types::{Invalid, Tif};
use rayon::prelude::*;

/// Radius over which a TIF is smoothed, in its widths; of a Gaussian a quadratic is off by 1e-3 there.
const SMOOTHED: f64 = 0.5;

/// The same in samples: more are not needed against noise.
const MOST_SAMPLES: f64 = 9.0;

/// Samples that decide a quadratic, twice over; where there are fewer, the sample stays.
const LEAST_SAMPLES: usize = 12;

/// Over how many of its widths a TIF is led to zero at its border, and the most of its extent.
const FADED: f64 = 1.0;
const MOST_FADED: f64 = 0.2;

/// A sample below this part of the peak is outside of the TIF.
const NOTHING: f64 = 1e-9;

/// The TIF smoothed, and led to zero at its border, at the same volumetric removal rate.
pub fn smooth(tif: &Tif, width_mm: f64) -> Result<Tif, Invalid> {
    let extent = tif.grid().size_mm();
    let over_mm = (FADED * width_mm).min(MOST_FADED * extent[0].min(extent[1]));
    let rate = smoothed(tif, width_mm) * fade(tif, over_mm);
    let volume = tif.rate_nm_per_s().sum() / rate.sum();
    Tif::new(*tif.grid(), rate * volume)
}

/// Every sample in the TIF is the value of the quadratic through those around it.
fn smoothed(tif: &Tif, width_mm: f64) -> Array2<f64> {
    let rate = tif.rate_nm_per_s();
    let (ny, nx) = rate.dim();
    let step = [tif.grid().x.step_mm(), tif.grid().y.step_mm()];
    let radius_mm = (SMOOTHED * width_mm).min(MOST_SAMPLES * step[0].min(step[1]));
    let least = NOTHING * tif.peak_nm_per_s();
    let [reach_x, reach_y] = step.map(|s| (radius_mm / s) as usize);
    let at = |r: usize, c: usize| {
        if rate[[r, c]].abs() <= least {
            return rate[[r, c]];
        }
        let (mut normal, mut right) = (SMatrix::<f64, 6, 6>::zeros(), SVector::<f64, 6>::zeros());
        let mut samples = 0;
        for i in r.saturating_sub(reach_y)..(r + reach_y + 1).min(ny) {
            for j in c.saturating_sub(reach_x)..(c + reach_x + 1).min(nx) {
                let x = (j as f64 - c as f64) * step[0] / radius_mm;
                let y = (i as f64 - r as f64) * step[1] / radius_mm;
                if x * x + y * y <= 1.0 && rate[[i, j]].abs() > least {
                    let row = SVector::from([1.0, x, y, x * x, x * y, y * y]);
                    normal += row * row.transpose();
                    right += row * rate[[i, j]];
                    samples += 1;
                }
            }
        }
        let fit = normal.cholesky().filter(|_| samples >= LEAST_SAMPLES);
        fit.map_or(rate[[r, c]], |f| f.solve(&right)[0])
    };
    let rows: Vec<Vec<f64>> =
        (0..ny).into_par_iter().map(|r| (0..nx).map(|c| at(r, c)).collect()).collect();
    Array2::from_shape_fn((ny, nx), |(r, c)| rows[r][c])
}

/// How much of every sample is left: 1 in the TIF, 0 just outside, and smooth between over `over_mm`.
fn fade(tif: &Tif, over_mm: f64) -> Array2<f64> {
    let rate = tif.rate_nm_per_s();
    let (ny, nx) = rate.dim();
    let step = [tif.grid().x.step_mm(), tif.grid().y.step_mm()];
    let least = NOTHING * tif.peak_nm_per_s();
    let inside = |r: isize, c: isize| {
        let known = r >= 0 && c >= 0 && (r as usize) < ny && (c as usize) < nx;
        known && rate[[r as usize, c as usize]].abs() > least
    };
    // Places just outside: those beside a sample inside.
    let mut outside = Vec::new();
    for r in -1..=ny as isize {
        for c in -1..=nx as isize {
            let mut beside = [(0, 1), (0, -1), (1, 0), (-1, 0)].into_iter();
            if !inside(r, c) && beside.any(|(i, j)| inside(r + i, c + j)) {
                outside.push([c as f64, r as f64]);
            }
        }
    }
    let at = |r: usize, c: usize| {
        let square = |o: &[f64; 2]| {
            ((o[0] - c as f64) * step[0]).powi(2) + ((o[1] - r as f64) * step[1]).powi(2)
        };
        let nearest_mm = outside.iter().map(square).fold(f64::INFINITY, f64::min).sqrt();
        let s = (nearest_mm / over_mm).min(1.0);
        s * s * (3.0 - 2.0 * s)
    };
    let rows: Vec<Vec<f64>> =
        (0..ny).into_par_iter().map(|r| (0..nx).map(|c| at(r, c)).collect()).collect();
    Array2::from_shape_fn((ny, nx), |(r, c)| rows[r][c])
}
