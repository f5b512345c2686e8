//! Preparation of a measured tool influence function (TIF) for the solvers.
//!
//! The steps, in this order, each only if it is asked for:
//!
//! 1. border: the least-squares plane through the border samples is subtracted; negative noise stays, so the volume has
//!    no bias;
//! 2. centre: the offsets are counted from the centroid or from the peak. The samples stay where
//!    they are, so nothing is interpolated; the axes may then have any offset;
//! 3. rotation about the centre, counterclockwise: by multiples of 90 degrees exactly, else by
//!    Keys' interpolation onto a lattice with a node at the centre;
//! 4. another pitch, on a lattice with a node at the centre;
//! 5. taper: a cosine lets the TIF end at zero instead of in a step.
//!
//! ```text
//! centroid   c = sum R p / sum R
//! rotation   R'(p) = R(turned back p)
//! pitch      R'[k] = sum_i K((x_i - k P) / s) R[i] / sum_i K,   s = max(P, step)
//! taper      R'(p) = R(p) (1 + cos(pi t)) / 2,  t = (rho - 1 + F) / F in [0, 1]
//! ```
//!
//! with K Keys' kernel along x and along y, and rho = hypot(x / X, y / Y), X and Y the borders on the side
//! of the sample (x, y). To a finer pitch K interpolates. To a coarser pitch K is stretched, so that it
//! averages, without aliasing, what the new lattice cannot represent. Both are exact for quadratics: a
//! smooth TIF is not widened. Rotation and pitch keep the volumetric removal rate (VRR) exactly: the
//! samples are scaled by the loss of the interpolation, and the report states it. Where the interpolation
//! swings below zero beside a steep edge, it is clipped.
//!
//! The solvers and the simulator need none of this: they take a TIF of any pitch, with an odd or even
//! number of samples, centred or not, as it is: R(pixel - tool). A TIF whose centroid is off centre shifts
//! the removal. That is right if the tool is mounted like that, and a mistake if the offset is one of the
//! measurement.
//!
//! Source: R. Keys, IEEE Trans. Acoust. Speech Signal Process. 29 (1981) 1153, Eq. 15.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | R | `rate_nm_per_s` | (my, mx) | nm/s |
//! | P | `pixel_mm` | - | mm |
//! | F | `taper_fraction` | - | 1 |

use std::f64::consts::PI;

use nalgebra::{Matrix3, Vector3};
use ndarray::{Array1, Array2, ArrayView1};
use planish_numerics::keys;
use planish_types::{Axis, Grid, Invalid, Tif, doubts};
use serde::Serialize;

/// Largest number of samples along an axis of a resampled TIF; more are refused. Larger: more memory and time for a
/// pitch that was mistyped. Smaller: refuses fine pitches.
const MAX_SAMPLES: f64 = 5000.0;

/// Largest rate on the border, relative to the peak, without a note in the report; a larger step at the border would
/// show on the part. Larger: does not notice a step at the border. Smaller: notes for usual noise.
const NOTEWORTHY_BORDER: f64 = 0.01;

/// Settings of the preparation; the defaults change nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TifSettings {
    /// True if the least-squares plane through the border samples is subtracted; negative noise stays.
    pub subtract_border: bool,
    /// Point from which the offsets are counted.
    pub centre: Centre,
    /// Angle by which the TIF is turned counterclockwise about its centre, degrees.
    pub rotate_deg: f64,
    /// Pitch of the resampled TIF, mm; `None` keeps the samples.
    pub pixel_mm: Option<f64>,
    /// Outer fraction of the half size in which the TIF goes to zero, in (0, 1]; `None` leaves the border as it is.
    pub taper_fraction: Option<f64>,
}

/// Point from which the offsets are counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Centre {
    /// The origin of the given TIF.
    #[default]
    Given,
    /// The centroid of the samples.
    Centroid,
    /// The vertex of the paraboloid through the largest sample and its neighbours.
    Peak,
}

/// Report on the preparation of a TIF.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TifReport {
    /// Numbers of the TIF as given.
    pub before: TifStatistics,
    /// Numbers of the prepared TIF.
    pub after: TifStatistics,
    /// Mean of the plane through the border samples that was subtracted, nm/s.
    pub subtracted_nm_per_s: f64,
    /// Position of the new centre [x, y] in the offsets of the given TIF, mm; 0 if the centre stays.
    pub centre_mm: [f64; 2],
    /// Relative change of the samples that keeps the volumetric removal rate (VRR) in rotation and resampling; 0 for
    /// none.
    pub volume_correction: f64,
    /// Probable mistakes in the result.
    pub doubts: Vec<String>,
    /// Note on a rate on the border that would show on the part; absent if there is none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// Main numbers of a TIF.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TifStatistics {
    /// Number of samples (rows, columns).
    pub shape: (usize, usize),
    /// Distance between the samples [x, y], mm.
    pub pitch_mm: [f64; 2],
    /// Smallest and largest offset along x, mm.
    pub x_mm: [f64; 2],
    /// Smallest and largest offset along y, mm.
    pub y_mm: [f64; 2],
    /// True if a sample lies at the centre, the offset 0, as in the middle of an odd number of samples.
    pub sample_at_centre: bool,
    /// Largest rate, nm/s.
    pub peak_nm_per_s: f64,
    /// Offset of the largest sample from the centre [x, y], mm.
    pub peak_at_mm: [f64; 2],
    /// Offset of the centroid from the centre [x, y], mm.
    pub centroid_mm: [f64; 2],
    /// Volumetric removal rate, nm mm^2/s.
    pub vrr_nm_mm2_per_s: f64,
    /// Full width at half maximum along [x, y] through the largest sample, mm; absent along an axis on which the
    /// samples end before half of the peak.
    pub fwhm_mm: [Option<f64>; 2],
    /// Largest rate on the border as a fraction of the peak.
    pub border_to_peak: f64,
}

/// Applies the steps of the module that `settings` ask for to `tif`. Returns the prepared TIF and the report.
///
/// # Errors
/// Refuses settings out of their range, a pitch that leaves fewer than 2 samples or more than 5000 along an axis, and a
/// taper about a centre that is not within the samples.
pub fn prepare_tif(tif: &Tif, settings: &TifSettings) -> Result<(Tif, TifReport), Invalid> {
    settings.check()?;
    let mut now = tif.clone();
    let mut subtracted_nm_per_s = 0.0;
    if settings.subtract_border {
        let plane = now.border_plane_nm_per_s();
        subtracted_nm_per_s = plane.sum() / plane.len() as f64;
        now = Tif::new(*now.grid(), now.rate_nm_per_s() - &plane)?;
    }
    let centre_mm = match settings.centre {
        Centre::Given => [0.0; 2],
        Centre::Centroid => now.centroid_mm(),
        Centre::Peak => vertex_mm(&now),
    };
    now = Tif::new(shifted(now.grid(), centre_mm)?, now.rate_nm_per_s().clone())?;
    let volume = now.vrr_nm_mm2_per_s();
    now = rotated(&now, settings.rotate_deg)?;
    if let Some(pixel_mm) = settings.pixel_mm {
        now = resampled(&now, pixel_mm)?;
    }
    // Quarter turns only move samples: those stay bit for bit.
    let interpolated =
        quarters_and_rest(settings.rotate_deg).1 != 0.0 || settings.pixel_mm.is_some();
    let factor = if interpolated { volume / now.vrr_nm_mm2_per_s() } else { 1.0 };
    if interpolated {
        now = Tif::new(*now.grid(), now.rate_nm_per_s() * factor)?;
    }
    if let Some(fraction) = settings.taper_fraction {
        now = tapered(&now, fraction)?;
    }
    let after = tif_statistics(&now);
    let doubts: Vec<String> = doubts::of_tif(&now).into_iter().collect();
    let mut note = None;
    if doubts.is_empty() && after.border_to_peak > NOTEWORTHY_BORDER {
        note = Some(format!(
            "the TIF ends at {:.1} % of its peak: a raster prints that step onto the part; measure a \
   wider field, or use `subtract_border` or `taper_fraction`",
            100.0 * after.border_to_peak
        ));
    }
    let report = TifReport {
        before: tif_statistics(tif),
        after,
        subtracted_nm_per_s,
        centre_mm,
        volume_correction: factor - 1.0,
        doubts,
        note,
    };
    Ok((now, report))
}

impl TifSettings {
    fn check(&self) -> Result<(), Invalid> {
        if !self.rotate_deg.is_finite() {
            let problem = format!("is {}", self.rotate_deg);
            return Err(Invalid::whole("rotation", problem, "give degrees"));
        }
        if let Some(f) = self.taper_fraction.filter(|f| !(*f > 0.0 && *f <= 1.0)) {
            let remedy = "give the tapered fraction of the half size, above 0 and at most 1";
            return Err(Invalid::whole("taper fraction", format!("is {f}"), remedy));
        }
        if let Some(p) = self.pixel_mm.filter(|p| !(p.is_finite() && *p > 0.0)) {
            return Err(Invalid::whole(
                "pitch",
                format!("is {p} mm"),
                "give a positive pitch in mm",
            ));
        }
        Ok(())
    }
}

/// Computes the main numbers of `tif`.
pub fn tif_statistics(tif: &Tif) -> TifStatistics {
    let g = tif.grid();
    let (r, c) = peak_place(tif);
    let sample_at_centre = [&g.x, &g.y].iter().all(|axis| {
        let k = -axis.start_mm() / axis.step_mm();
        (k - k.round()).abs() <= keys::SNAP && axis.start_mm() <= 0.0 && axis.end_mm() >= 0.0
    });
    let row: Vec<f64> = tif.rate_nm_per_s().row(r).to_vec();
    let column: Vec<f64> = tif.rate_nm_per_s().column(c).to_vec();
    TifStatistics {
        shape: g.shape(),
        pitch_mm: [g.x.step_mm(), g.y.step_mm()],
        x_mm: [g.x.start_mm(), g.x.end_mm()],
        y_mm: [g.y.start_mm(), g.y.end_mm()],
        sample_at_centre,
        peak_nm_per_s: tif.peak_nm_per_s(),
        peak_at_mm: [g.x.coordinate_mm(c), g.y.coordinate_mm(r)],
        centroid_mm: tif.centroid_mm(),
        vrr_nm_mm2_per_s: tif.vrr_nm_mm2_per_s(),
        fwhm_mm: [
            width_at_half(&row, c).map(|w| w * g.x.step_mm()),
            width_at_half(&column, r).map(|w| w * g.y.step_mm()),
        ],
        border_to_peak: tif.border_to_peak(),
    }
}

/// Returns the (row, column) of the largest sample; the first one of equal samples.
fn peak_place(tif: &Tif) -> (usize, usize) {
    let first = ((0, 0), f64::NEG_INFINITY);
    let all = tif.rate_nm_per_s().indexed_iter();
    all.fold(first, |best, (place, v)| if *v > best.1 { (place, *v) } else { best }).0
}

/// Returns the full width at half maximum of the samples `line` about the sample `peak`, in samples, linear between
/// them; `None` if the samples end before half of the peak on either side.
fn width_at_half(line: &[f64], peak: usize) -> Option<f64> {
    let right = samples_to_half(line[peak], line[peak + 1..].iter())?;
    Some(right + samples_to_half(line[peak], line[..peak].iter().rev())?)
}

/// Returns the distance from the peak to its half along the samples `outwards` of the peak, in samples; `None` if they
/// end before.
fn samples_to_half<'a>(peak: f64, outwards: impl Iterator<Item = &'a f64>) -> Option<f64> {
    let half = 0.5 * peak;
    let mut before = peak;
    for (k, v) in outwards.enumerate() {
        if *v < half {
            return Some(k as f64 + (before - half) / (before - v));
        }
        before = *v;
    }
    None
}

/// Returns the vertex of the paraboloid through the largest sample and its neighbours, as an offset [x, y], mm.
///
/// ```text
/// R(u, v) = R0 + g u + h v + (a u^2 + b v^2) / 2 + c u v,   u, v in samples from the largest one
/// vertex    (u, v) = -[a c; c b]^-1 (g, h)
/// ```
///
/// Each coefficient is the central difference, exact for a quadratic. c belongs to a spot whose axes are turned.
/// Without c, each coordinate would be that of the largest rate on the line through the sample, not on the plane. If
/// the vertex is farther than one sample away, these coordinates are taken, and that of the sample at a border.
fn vertex_mm(tif: &Tif) -> [f64; 2] {
    let (r, c) = peak_place(tif);
    let g = tif.grid();
    let rate = tif.rate_nm_per_s();
    let along_x = slope_and_bend(rate.row(r), c);
    let along_y = slope_and_bend(rate.column(c), r);
    let on_lines = [along_x, along_y].map(|line| line.map_or(0.0, |(slope, bend)| -slope / bend));
    let in_mm = |[x, y]: [f64; 2]| {
        [g.x.coordinate_mm(c) + x * g.x.step_mm(), g.y.coordinate_mm(r) + y * g.y.step_mm()]
    };
    let (Some((slope_x, bend_x)), Some((slope_y, bend_y))) = (along_x, along_y) else {
        return in_mm(on_lines);
    };
    let rising = rate[[r + 1, c + 1]] + rate[[r - 1, c - 1]];
    let twist = 0.25 * (rising - rate[[r + 1, c - 1]] - rate[[r - 1, c + 1]]);
    let determinant = bend_x * bend_y - twist * twist;
    let vertex = [
        (twist * slope_y - bend_y * slope_x) / determinant,
        (twist * slope_x - bend_x * slope_y) / determinant,
    ];
    // Beyond the neighbours the paraboloid is a guess: that of a saddle, or of noise on a plateau.
    let within = determinant > 0.0 && vertex.iter().all(|offset| offset.abs() <= 1.0);
    in_mm(if within { vertex } else { on_lines })
}

/// Returns the first and second central difference of the samples `line` at the index `peak`, per sample. Returns
/// `None` if the sample is the first or last one, or if the line does not bend down there.
fn slope_and_bend(line: ArrayView1<f64>, peak: usize) -> Option<(f64, f64)> {
    let before = line.get(peak.checked_sub(1)?)?;
    let after = line.get(peak + 1)?;
    let bend = before - 2.0 * line[peak] + after;
    if bend < 0.0 { Some((0.5 * (after - before), bend)) } else { None }
}

/// Returns the grid with its coordinates counted from `centre_mm`.
fn shifted(grid: &Grid, centre_mm: [f64; 2]) -> Result<Grid, Invalid> {
    let [x, y] = [(&grid.x, centre_mm[0]), (&grid.y, centre_mm[1])]
        .map(|(axis, by)| Axis::new(axis.start_mm() - by, axis.step_mm(), axis.len()));
    Ok(Grid { x: x?, y: y? })
}

/// Returns the TIF turned counterclockwise about its centre: R'(p) = R(p turned back).
fn rotated(tif: &Tif, degrees: f64) -> Result<Tif, Invalid> {
    let (quarters, rest_deg) = quarters_and_rest(degrees);
    let mut turned = tif.clone();
    for _ in 0..quarters {
        turned = quarter_turn(&turned)?;
    }
    if rest_deg == 0.0 {
        return Ok(turned);
    }
    let rest = rest_deg.to_radians();
    let g = turned.grid();
    let cos = rest.cos();
    let sin = rest.sin();
    // The box about the turned corners, on multiples of the pitch.
    let corners: Vec<[f64; 2]> = [g.x.start_mm(), g.x.end_mm()]
        .iter()
        .flat_map(|x| {
            [g.y.start_mm(), g.y.end_mm()].map(|y| [x * cos - y * sin, x * sin + y * cos])
        })
        .collect();
    let [x, y] = [g.x, g.y].map(|axis| axis.step_mm());
    let [x, y] = [(0, x), (1, y)].map(|(which, step)| {
        let ends = corners.iter().map(|p| p[which]);
        let (low, high) =
            ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        lattice(low, high, step)
    });
    let grid = Grid { x: x?, y: y? };
    let least = least_rate(tif);
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
        turned.rate_at(x * cos + y * sin, y * cos - x * sin).max(least)
    });
    Tif::new(grid, rate)
}

/// Returns the smallest sample or 0, whichever is smaller. Interpolation beside a steep edge gives values below it,
/// which are clipped, because no tool adds material.
fn least_rate(tif: &Tif) -> f64 {
    tif.rate_nm_per_s().iter().copied().fold(0.0, f64::min)
}

/// Splits an angle into 0 to 3 quarter turns and a rest from -45 to 45 degrees.
fn quarters_and_rest(degrees: f64) -> (usize, f64) {
    let quarters = (degrees / 90.0).round();
    (quarters.rem_euclid(4.0) as usize, degrees - 90.0 * quarters)
}

/// Turns a TIF by 90 degrees counterclockwise: R'(x, y) = R(y, -x), sample by sample.
fn quarter_turn(tif: &Tif) -> Result<Tif, Invalid> {
    let g = tif.grid();
    let grid = Grid { x: Axis::new(-g.y.end_mm(), g.y.step_mm(), g.y.len())?, y: g.x };
    let last = g.y.len() - 1;
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| tif.rate_nm_per_s()[[last - c, r]]);
    Tif::new(grid, rate)
}

/// Returns the axis of the multiples of `step` from `low` to `high`, mm. Refuses fewer than 2 and more than
/// [`MAX_SAMPLES`] of them.
fn lattice(low: f64, high: f64, step: f64) -> Result<Axis, Invalid> {
    let first = (low / step - keys::SNAP).ceil();
    let last = (high / step + keys::SNAP).floor();
    if last - first >= MAX_SAMPLES {
        return Err(Invalid::whole(
            "pitch",
            format!("of {step} mm makes {} samples along an axis", last - first + 1.0),
            format!("give a pitch in mm that makes at most {MAX_SAMPLES}"),
        ));
    }
    if last - first < 1.0 {
        return Err(Invalid::whole(
            "pitch",
            format!("of {step} mm leaves less than 2 samples between {low} and {high} mm"),
            "give a smaller pitch in mm",
        ));
    }
    Axis::new(first * step, step, (last - first) as usize + 1)
}

/// Resamples a TIF on multiples of `pitch_mm`, within the rectangle of its samples.
fn resampled(tif: &Tif, pitch_mm: f64) -> Result<Tif, Invalid> {
    let g = tif.grid();
    let [x, y] = [g.x, g.y].map(|axis| lattice(axis.start_mm(), axis.end_mm(), pitch_mm));
    let grid = Grid { x: x?, y: y? };
    // R' = W_y R W_x^T
    let [wx, wy] = [(g.x, grid.x), (g.y, grid.y)].map(|(old, new)| weights(&old, &new));
    let least = least_rate(tif);
    Tif::new(grid, wy.dot(tif.rate_nm_per_s()).dot(&wx.t()).mapv(|v| v.max(least)))
}

/// Returns the weights with which the samples `i` of the old axis make the samples `k` of the new one, shape (new,
/// old).
fn weights(old: &Axis, new: &Axis) -> Array2<f64> {
    let n = old.len();
    let mut out = Array2::zeros((new.len(), n));
    for (k, mut row) in out.outer_iter_mut().enumerate() {
        let place = (new.coordinate_mm(k) - old.start_mm()) / old.step_mm();
        if new.step_mm() <= old.step_mm() {
            let (cell, f) = keys::split(place);
            let cell = cell.clamp(0, n as isize - 2) as usize;
            let f = if f == 0.0 { place.round() - cell as f64 } else { f };
            for (w, node) in keys::weights(f).into_iter().zip(cell..) {
                // Node `node - 1`; the ghosts are what `keys::with_ghosts` makes them.
                let far = match node {
                    0 => [0, 1, 2],
                    _ if node == n + 1 => [n - 1, n - 2, n.max(3) - 3],
                    _ => {
                        row[node - 1] += w;
                        continue;
                    }
                };
                let parts = if n == 2 { &[2.0, -1.0][..] } else { &[3.0, -3.0, 1.0] };
                parts.iter().zip(far).for_each(|(v, i)| row[i] += w * v);
            }
        } else {
            row.assign(&averaging(n, place, new.step_mm() / old.step_mm()));
        }
    }
    out
}

/// Returns the weights of n samples for a value at the position `place`, in samples from the first: Keys' kernel,
/// stretched by the factor `stretch`.
///
/// On the samples the moments of the kernel are not exactly 1, 0, 0. A small parabola under a bell corrects this, so
/// that the weights are exact for quadratics.
fn averaging(n: usize, place: f64, stretch: f64) -> Array1<f64> {
    let t: Vec<f64> = (0..n).map(|i| (i as f64 - place) / stretch).collect();
    let bell: Vec<f64> = t.iter().map(|t| (1.0 - 0.25 * t.powi(2)).max(0.0).powi(2)).collect();
    let mut w: Vec<f64> = t.iter().map(|t| kernel(*t) / stretch).collect();
    // sum (w + bell (a + b t + c t^2)) t^k = [k = 0],  k = 0, 1, 2
    let lack = Vector3::from_fn(|k, _| f64::from(u8::from(k == 0)) - moment(&w, &t, k));
    let matrix = Matrix3::from_fn(|k, l| moment(&bell, &t, k + l));
    match matrix.cholesky().map(|m| m.solve(&lack)) {
        Some(c) => {
            for ((w, bell), t) in w.iter_mut().zip(bell).zip(t) {
                *w += bell * (c[0] + t * (c[1] + t * c[2]));
            }
            w.into()
        }
        // Fewer than three samples within reach.
        None => {
            let w = Array1::from(w);
            &w / w.sum()
        }
    }
}

/// Returns the sum of value * t^k over the samples.
fn moment(values: &[f64], t: &[f64], k: usize) -> f64 {
    values.iter().zip(t).map(|(v, t)| v * t.powi(k as i32)).sum()
}

/// Returns Keys' kernel with a = -1/2 at the distance `t` in samples.
fn kernel(t: f64) -> f64 {
    let t = t.abs();
    if t < 1.0 {
        (1.5 * t - 2.5) * t * t + 1.0
    } else if t < 2.0 {
        ((-0.5 * t + 2.5) * t - 4.0) * t + 2.0
    } else {
        0.0
    }
}

/// Returns the tapered TIF R (1 + cos(pi t)) / 2, with t of the module, on quarters of ellipses about the centre that
/// touch the borders. If the centre is not the middle of the samples, a single ellipse would end at the nearest border.
/// It would cut off samples at the same distance on the other side. Refuses a centre that is not within the samples.
fn tapered(tif: &Tif, fraction: f64) -> Result<Tif, Invalid> {
    let g = tif.grid();
    if ![&g.x, &g.y].iter().all(|axis| axis.start_mm() < 0.0 && axis.end_mm() > 0.0) {
        return Err(Invalid::whole(
            "taper",
            "the tool centre is not within the samples",
            "give a centre (`centre` centroid)",
        ));
    }
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        // The offset over that of the border on its side.
        let [x, y] = [(&g.x, c), (&g.y, r)].map(|(axis, k)| {
            let offset = axis.coordinate_mm(k);
            offset / if offset < 0.0 { axis.start_mm() } else { axis.end_mm() }
        });
        let rho = x.hypot(y);
        let t = ((rho - 1.0 + fraction) / fraction).clamp(0.0, 1.0);
        tif.rate_nm_per_s()[[r, c]] * 0.5 * (1.0 + (PI * t).cos())
    });
    Tif::new(*g, rate)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns an elliptical Gaussian TIF of 8 nm/s about `centre`, with `n` samples along x and y.
    fn gaussian(n: [usize; 2], pitch: f64, centre: [f64; 2], sigma: [f64; 2]) -> Tif {
        let axis = |n: usize| Axis::new(-0.5 * (n - 1) as f64 * pitch, pitch, n).unwrap();
        let grid = Grid { x: axis(n[0]), y: axis(n[1]) };
        Tif::new(grid, bell(&grid, centre, sigma)).unwrap()
    }

    fn bell(grid: &Grid, centre: [f64; 2], sigma: [f64; 2]) -> Array2<f64> {
        Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (grid.x.coordinate_mm(c) - centre[0], grid.y.coordinate_mm(r) - centre[1]);
            8.0 * (-0.5 * ((x / sigma[0]).powi(2) + (y / sigma[1]).powi(2))).exp()
        })
    }

    fn settings() -> TifSettings {
        TifSettings::default()
    }

    fn worst(tif: &Tif, want: impl Fn(f64, f64) -> f64) -> f64 {
        let g = tif.grid();
        let error = |((r, c), v): ((usize, usize), &f64)| {
            (v - want(g.x.coordinate_mm(c), g.y.coordinate_mm(r))).abs()
        };
        tif.rate_nm_per_s().indexed_iter().map(error).fold(0.0, f64::max)
    }

    #[test]
    fn nothing_asked_is_nothing_done_and_the_statistics_are_the_closed_forms() {
        for n in [[121, 101], [120, 100]] {
            let tif = gaussian(n, 0.1, [0.3, -0.2], [0.8, 0.6]);
            let (same, report) = prepare_tif(&tif, &settings()).unwrap();
            assert_eq!(same.rate_nm_per_s(), tif.rate_nm_per_s());
            assert_eq!((same.grid(), report.volume_correction), (tif.grid(), 0.0));
            let s = report.after;
            // 2 pi A sigma_x sigma_y; the sum over samples of a Gaussian is spectrally exact.
            let vrr = 2.0 * PI * 8.0 * 0.48;
            // Below: rounding, and the tail beyond the samples, which end at 7 sigma: 1e-12 of the volume.
            assert!((s.vrr_nm_mm2_per_s / vrr - 1.0).abs() < 1e-9, "{s:?}");
            assert!((s.centroid_mm[0] - 0.3).abs() < 1e-9 && (s.centroid_mm[1] + 0.2).abs() < 1e-9);
            let fwhm = 8.0_f64.sqrt() * std::f64::consts::LN_2.sqrt();
            // Linear between samples of a tenth of sigma.
            assert!((s.fwhm_mm[0].unwrap() / (0.8 * fwhm) - 1.0).abs() < 5e-3, "{s:?}");
            assert!((s.fwhm_mm[1].unwrap() / (0.6 * fwhm) - 1.0).abs() < 1e-2, "{s:?}");
            assert_eq!(s.sample_at_centre, n[0] % 2 == 1);
        }
    }

    #[test]
    fn the_centre_moves_the_axes_and_not_the_samples() {
        for n in [[121, 101], [120, 100]] {
            let tif = gaussian(n, 0.1, [0.33, -0.21], [0.8, 0.6]);
            for (centre, tolerance) in [(Centre::Centroid, 1e-9), (Centre::Peak, 2e-3)] {
                let (moved, report) =
                    prepare_tif(&tif, &TifSettings { centre, ..settings() }).unwrap();
                assert_eq!(moved.rate_nm_per_s(), tif.rate_nm_per_s());
                let [x, y] = report.centre_mm;
                // A parabola through three samples of a Gaussian errs by (step / sigma)^2 of the step.
                assert!((x - 0.33).abs() < tolerance && (y + 0.21).abs() < tolerance, "{x} {y}");
                // The same rate at the same place: r(p) was at p + centre.
                let (a, b) = (moved.rate_at(0.5, 0.4), tif.rate_at(0.5 + x, 0.4 + y));
                // Rounding of coordinates times slopes of 8 nm/s per mm.
                assert!((a - b).abs() < 1e-10, "{a} {b}");
            }
        }
    }

    #[test]
    fn the_peak_of_a_turned_spot_is_not_that_of_the_lines_through_its_largest_sample() {
        // Half a sample off along x and y, where the lines alone err most: by 0.4 of a sample.
        let grid =
            Grid { x: Axis::new(-3.0, 0.2, 61).unwrap(), y: Axis::new(-7.0, 0.3, 56).unwrap() };
        let (sine, cosine) = 0.4_f64.sin_cos();
        let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (grid.x.coordinate_mm(c) - 2.5, grid.y.coordinate_mm(r) + 1.15);
            let (u, v) = (cosine * x + sine * y, cosine * y - sine * x);
            7.0 * (-0.5 * ((u / 1.2).powi(2) + (v / 0.7).powi(2))).exp()
        });
        let tif = Tif::new(grid, rate).unwrap();
        let peak = TifSettings { centre: Centre::Peak, ..settings() };
        let [x, y] = prepare_tif(&tif, &peak).unwrap().1.centre_mm;
        // A paraboloid through samples of a Gaussian errs by (step / sigma)^2 of the offset, 0.1 mm along x.
        assert!((x - 2.5).abs() < 0.02 && (y + 1.15).abs() < 0.02, "{x} {y}");
    }

    #[test]
    fn a_taper_about_a_centre_beside_the_middle_leaves_the_samples_on_the_long_side() {
        // From -3 to 9 mm about the tool, the spot at 2.5 mm: within 3 mm of the tool lies half of it.
        let grid =
            Grid { x: Axis::new(-3.0, 0.2, 61).unwrap(), y: Axis::new(-4.0, 0.2, 41).unwrap() };
        let tif = Tif::new(grid, bell(&grid, [2.5, 0.5], [0.8, 0.6])).unwrap();
        let taper = TifSettings { taper_fraction: Some(0.15), ..settings() };
        let (tapered, report) = prepare_tif(&tif, &taper).unwrap();
        // The taper begins at 0.85 of the way to the border, 6.4 sigma from the spot: 1e-9 of its volume.
        let (before, after) = (report.before.vrr_nm_mm2_per_s, report.after.vrr_nm_mm2_per_s);
        // The taper cuts 1e-9 of the volume, as above.
        assert!((after / before - 1.0).abs() < 1e-6, "{before} {after}");
        assert_eq!(tapered.rate_nm_per_s()[[20, 60]], 0.0);
        assert_eq!(tapered.rate_nm_per_s()[[40, 15]], 0.0);
    }

    #[test]
    fn quarter_turns_move_samples_and_four_are_none() {
        let tif = gaussian([12, 9], 0.5, [0.8, 0.4], [0.8, 1.6]);
        let turn = |tif: &Tif, rotate_deg: f64| {
            prepare_tif(tif, &TifSettings { rotate_deg, ..settings() }).unwrap().0
        };
        let once = turn(&tif, 90.0);
        assert_eq!(once.grid().shape(), (12, 9));
        for ((r, c), v) in tif.rate_nm_per_s().indexed_iter() {
            // (x, y) goes to (-y, x): column from the row counted from the end, row from the column.
            assert_eq!(once.rate_nm_per_s()[[c, 8 - r]].to_bits(), v.to_bits());
            let (x, y) = (tif.grid().x.coordinate_mm(c), tif.grid().y.coordinate_mm(r));
            let g = once.grid();
            // Rounding of coordinates.
            assert!(
                (g.x.coordinate_mm(8 - r) + y).abs() < 1e-12
                    && (g.y.coordinate_mm(c) - x).abs() < 1e-12
            );
        }
        // The spot at (0.8, 0.4) is now at (-0.4, 0.8).
        let [x, y] = tif_statistics(&once).centroid_mm;
        // The spot is at (-0.4, 0.8), and the samples end beside it.
        assert!(x < -0.1 && y > 0.5, "{x} {y}");
        for (degrees, turns) in [(180.0, 2), (-90.0, 3), (450.0, 1), (360.0, 0), (-720.0, 0)] {
            let many = (0..turns).fold(tif.clone(), |t, _| turn(&t, 90.0));
            assert_eq!(turn(&tif, degrees).rate_nm_per_s(), many.rate_nm_per_s());
        }
        assert_eq!(turn(&once, -90.0).rate_nm_per_s(), tif.rate_nm_per_s());
    }

    #[test]
    fn any_angle_turns_the_ellipse_and_keeps_the_volume() {
        let angle = 30.0_f64.to_radians();
        let (cos, sin) = (angle.cos(), angle.sin());
        let turned = |x: f64, y: f64| {
            let (u, v) = (x * cos + y * sin - 0.3, y * cos - x * sin);
            8.0 * (-0.5 * ((u / 0.9).powi(2) + (v / 0.5).powi(2))).exp()
        };
        let error = |pitch: f64| {
            let n = (10.0 / pitch) as usize + 1;
            let tif = gaussian([n, n - 1], pitch, [0.3, 0.0], [0.9, 0.5]);
            let (t, report) =
                prepare_tif(&tif, &TifSettings { rotate_deg: 30.0, ..settings() }).unwrap();
            let after = report.after.vrr_nm_mm2_per_s;
            // The volume is kept by a factor: rounding.
            assert!((after / report.before.vrr_nm_mm2_per_s - 1.0).abs() < 1e-12);
            assert!(report.volume_correction.abs() < 1e-2 && report.after.sample_at_centre);
            worst(&t, turned)
        };
        let (coarse, fine) = (error(0.1), error(0.05));
        // Keys' interpolation is of the third order.
        let order = (coarse / fine).log2();
        // The order is 3; at steps of 0.05 and 0.1 mm the next order takes a part of it.
        assert!(order > 2.7 && coarse < 0.02, "{coarse} {fine}: order {order}");
    }

    #[test]
    fn a_resampled_gaussian_converges_and_its_volume_stays() {
        // To a pitch 0.7 of the own one (interpolated) and to 1.7 (averaged).
        for (ratio, least_order) in [(0.7, 2.8), (1.7, 2.8)] {
            let error = |pitch: f64| {
                let n = (10.0 / pitch).round() as usize;
                let tif = gaussian([n, n + 1], pitch, [0.1, -0.3], [0.8, 0.7]);
                let s = TifSettings { pixel_mm: Some(ratio * pitch), ..settings() };
                let (t, report) = prepare_tif(&tif, &s).unwrap();
                let before = report.before.vrr_nm_mm2_per_s;
                // The volume is kept by a factor: rounding.
                assert!((report.after.vrr_nm_mm2_per_s / before - 1.0).abs() < 1e-12);
                assert!(report.after.sample_at_centre);
                assert!(report.volume_correction.abs() < 1e-3, "{report:?}");
                worst(&t, |x, y| {
                    8.0 * (-0.5 * (((x - 0.1) / 0.8).powi(2) + ((y + 0.3) / 0.7).powi(2))).exp()
                })
            };
            let (coarse, fine) = (error(0.1), error(0.05));
            let order = (coarse / fine).log2();
            assert!(order > least_order, "{ratio}: {coarse} {fine}: order {order}");
        }
    }

    #[test]
    fn resampling_onto_its_own_lattice_changes_nothing() {
        let tif = gaussian([21, 31], 0.25, [0.1, 0.0], [0.8, 0.7]);
        let s = TifSettings { pixel_mm: Some(0.25), ..settings() };
        let (same, _) = prepare_tif(&tif, &s).unwrap();
        assert_eq!(same.grid().shape(), tif.grid().shape());
        let difference = same.rate_nm_per_s() - tif.rate_nm_per_s();
        // At a sample the interpolation gives the sample: rounding.
        assert!(difference.iter().all(|d| d.abs() < 1e-14));
    }

    #[test]
    fn a_coarse_lattice_averages_what_it_cannot_hold() {
        // Stripes of two samples: no lattice of five samples can hold them, and picking every
        // fifth would make stripes of ten.
        let axis = Axis::new(-5.0, 0.1, 101).unwrap();
        let grid = Grid { x: axis, y: axis };
        let rate = Array2::from_shape_fn(grid.shape(), |(_, c)| if c % 2 == 0 { 2.0 } else { 0.0 });
        let s = TifSettings { pixel_mm: Some(0.5), ..settings() };
        let (coarse, _) = prepare_tif(&Tif::new(grid, rate).unwrap(), &s).unwrap();
        let middle = coarse.rate_nm_per_s().slice(ndarray::s![.., 3..18]).to_owned();
        let (low, high) =
            middle.iter().fold((9.0_f64, 0.0_f64), |(l, h), v| (l.min(*v), h.max(*v)));
        assert!(high - low < 0.05 * high, "{low} {high}");
    }

    #[test]
    fn beside_a_steep_edge_no_rate_is_negative() {
        let axis = Axis::new(-3.0, 0.2, 31).unwrap();
        let grid = Grid { x: axis, y: axis };
        let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            if axis.coordinate_mm(c).hypot(axis.coordinate_mm(r)) < 1.5 { 4.0 } else { 0.0 }
        });
        let top_hat = Tif::new(grid, rate).unwrap();
        for (rotate_deg, pixel_mm) in [(20.0, None), (0.0, Some(0.13)), (0.0, Some(0.31))] {
            let s = TifSettings { rotate_deg, pixel_mm, ..settings() };
            let (t, report) = prepare_tif(&top_hat, &s).unwrap();
            assert!(t.rate_nm_per_s().iter().all(|v| *v >= 0.0), "{s:?}");
            let vrr = [report.before, report.after].map(|s| s.vrr_nm_mm2_per_s);
            // The volume is kept by a factor: rounding.
            assert!((vrr[1] / vrr[0] - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn border_and_taper_end_the_tif_at_zero() {
        let axis = Axis::new(-2.0, 0.1, 41).unwrap();
        let grid = Grid { x: axis, y: axis };
        let pedestal = Tif::new(grid, bell(&grid, [0.0; 2], [0.5; 2]) + 0.4).unwrap();
        let plain = prepare_tif(&pedestal, &settings()).unwrap().1;
        assert!(plain.doubts[0].contains("4.8 % of its peak") && plain.note.is_none(), "{plain:?}");
        let s = TifSettings { subtract_border: true, ..settings() };
        let (clean, report) = prepare_tif(&pedestal, &s).unwrap();
        // The Gaussian itself is 8 exp(-8) = 0.003 on the middle of the border.
        assert!((report.subtracted_nm_per_s - 0.4).abs() < 2e-3, "{report:?}");
        // exp(-8) is 3.4e-4 of the peak.
        assert!(clean.border_to_peak() < 1e-3 && report.note.is_none() && report.doubts.is_empty());
        // A plane of any tilt comes off, but for the rounding of the Gaussian's own border.
        let tilted = bell(&grid, [0.0; 2], [0.3; 2])
            + Array2::from_shape_fn(grid.shape(), |(r, c)| {
                0.1 + 0.03 * axis.coordinate_mm(c) - 0.02 * axis.coordinate_mm(r)
            });
        let (flat, _) = prepare_tif(&Tif::new(grid, tilted).unwrap(), &s).unwrap();
        // exp(-(2 / 0.3)^2 / 2) is 2e-10 of the peak.
        assert!(worst(&flat, |x, y| 8.0 * (-0.5 * (x * x + y * y) / 0.09).exp()) < 1e-8);
        let s = TifSettings { taper_fraction: Some(0.15), ..settings() };
        let (tapered, report) = prepare_tif(&pedestal, &s).unwrap();
        // Rounding of the weight at its end.
        assert!(tapered.border_to_peak() < 1e-12 && report.note.is_none());
        // Within 85 % of the half size nothing changed.
        assert_eq!(tapered.rate_nm_per_s()[[20, 36]], pedestal.rate_nm_per_s()[[20, 36]]);
        assert!(tapered.rate_nm_per_s()[[20, 38]] < pedestal.rate_nm_per_s()[[20, 38]]);
    }

    #[test]
    fn bad_settings_are_refused() {
        let tif = gaussian([21, 21], 0.25, [0.0; 2], [0.8; 2]);
        let message = |s: TifSettings| prepare_tif(&tif, &s).unwrap_err().to_string();
        let pitch = |p| TifSettings { pixel_mm: Some(p), ..settings() };
        assert!(message(pitch(0.0)).contains("is 0 mm"));
        assert!(message(pitch(9.0)).contains("less than 2 samples"));
        assert!(message(pitch(1e-6)).contains("at most 5000"));
        assert!(message(TifSettings { rotate_deg: f64::NAN, ..settings() }).contains("is NaN"));
        let taper = TifSettings { taper_fraction: Some(1.5), ..settings() };
        assert!(message(taper).contains("is 1.5"));
        let off = Tif::new(shifted(tif.grid(), [9.0, 0.0]).unwrap(), tif.rate_nm_per_s().clone());
        let taper = TifSettings { taper_fraction: Some(0.1), ..settings() };
        let error = prepare_tif(&off.unwrap(), &taper).unwrap_err().to_string();
        assert!(error.contains("not within the samples"), "{error}");
    }
}
