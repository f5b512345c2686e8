//! A TIF from a measured spot: maps of a test piece before and after the tool rested on it.
//!
//! ```text
//! removal(p) = before(p) - after(p + d) - (a + b x + c y)
//! R(p - centre) = removal(p) / dwell time
//! ```
//!
//! d is the shift of the part between the two measurements; a, b, c its piston and tilt. All five
//! are found from the ring outside the spot, where nothing was removed:
//!
//! ```text
//! sum_outside (h, 1, x, y)' removal(p) = 0,   h = grad before;     d removal / d d = -grad after(p + d)
//! ```
//!
//! The `shift` module solves these equations.
//!
//! `after` between its pixels is Keys' cubic convolution ([`planish_numerics::keys`]). The centre is
//! the centroid of the removal in the square that becomes the TIF, negative noise included: of an asymmetric spot it is not
//! where the peak is. The samples stay where they are measured: only the offsets are counted from the centre.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | before, after | `before`, `after` | (ny, nx) | nm |
//! | d | `shift_mm` | (2) | mm |
//! | R | `tif` | (my, mx) | nm/s |

use ndarray::{Array2, s};
use planish_numerics::statistics;
use planish_types::{Axis, Grid, Invalid, Surface, Tif};
use serde::Serialize;

use crate::shift::{Shift, align, shifted};

/// Smallest depth of a spot, relative to the RMS of the removal outside it; a shallower spot is refused. Larger:
/// refuses faint spots. Smaller: noise may pass for a spot. Derived: the deepest of 1e4 pixels of Gaussian noise is 4
/// times its RMS.
const LEAST_CONTRAST: f64 = 5.0;

/// Number of times that the square is centred anew on the centroid of the removal in it. Larger: more time, hardly a
/// change. Smaller: the centroid may belong to a square that is off. Chosen: the spot has fallen to its noise at the
/// edge of a square, so a square that is off by less than a pixel has the same centroid.
const CENTRE_ROUNDS: usize = 3;

/// Motion of the part between the two measurements.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Alignment {
    /// The part did not move.
    None,
    /// The part was shifted.
    Shift,
}

/// Function that is fitted outside the spot and subtracted from the removal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Baseline {
    /// Nothing.
    None,
    /// A constant.
    Piston,
    /// A plane.
    Plane,
}

/// Settings for the conversion of a measured spot to a TIF.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SpotSettings {
    /// Time that the tool rested, s.
    pub dwell_s: f64,
    /// Half the side of the square that becomes the TIF, mm. Outside the square nothing was removed.
    pub half_size_mm: f64,
    /// Position of the spot [x, y], mm, in the coordinates of the map; `None` for the position of the deepest removal.
    pub spot_mm: Option<[f64; 2]>,
    /// Treatment of a part that may have moved between the two measurements.
    #[serde(rename = "alignment")]
    pub align: Alignment,
    /// Function that is fitted outside the spot and subtracted from the removal.
    pub baseline: Baseline,
    /// True if negative rates (noise) become zero; the others are then scaled so that the volume stays.
    pub clip_negative: bool,
}

/// The TIF of a spot, and numbers of its measurement.
#[derive(Clone, Debug, Serialize)]
pub struct Spot {
    /// The TIF.
    #[serde(skip)]
    pub tif: Tif,
    /// Shift of the part [x, y] in `after` against `before`, mm.
    pub shift_mm: [f64; 2],
    /// Standard error of the shift [x, y], mm; 0 without an alignment.
    pub shift_error_mm: [f64; 2],
    /// Number of steps of the alignment; 0 without one.
    pub steps: usize,
    /// Centre of the spot [x, y] in the coordinates of the map, mm.
    pub centre_mm: [f64; 2],
    /// RMS of the removal outside the spot, about its mean, nm: the noise of the measurement; 0 if there are no pixels
    /// outside.
    pub outside_rms_nm: f64,
    /// Number of pixels outside the spot.
    pub outside_pixels: usize,
    /// Largest depth of the removal in the spot, nm.
    pub depth_nm: f64,
    /// Volume that was negative and became zero, as a fraction of the positive volume; 0 without clipping.
    pub clipped_share: f64,
}

/// Makes the TIF of a spot. `before` is absent where `after` already is the depth of the removal.
///
/// # Errors
/// Refuses settings out of their range, maps that are not measured alike or have nothing to align by, and a spot that
/// is not found, does not stand out, or has invalid pixels.
pub fn spot(
    before: Option<&Surface>,
    after: &Surface,
    settings: &SpotSettings,
) -> Result<Spot, Invalid> {
    for (name, v) in [("dwell_s", settings.dwell_s), ("half_size_mm", settings.half_size_mm)] {
        if !(v.is_finite() && v > 0.0) {
            return Err(Invalid::whole(name, format!("is {v}"), "give a positive number"));
        }
    }
    let grid = after.grid();
    if let Some(before) = before {
        refuse_other_pixels(before.grid(), grid)?;
        if settings.align == Alignment::None {
            refuse_another_window(before.grid(), grid)?;
        }
    }
    let removal = |shift_px: [f64; 2]| match before {
        None => after.height_nm().clone(),
        Some(before) => before.height_nm() - &shifted(after.height_nm(), shift_px).0,
    };

    let first = removal([0.0; 2]);
    let coarse = match settings.spot_mm {
        Some(centre) => centre,
        None => find(grid, &first, settings.half_size_mm)?,
    };
    let outside = outside(grid, coarse, settings.half_size_mm);
    let shift = match (settings.align, before) {
        (Alignment::None, _) => Shift::default(),
        (Alignment::Shift, Some(before)) => align(grid, before, after, &outside)?,
        (Alignment::Shift, None) => {
            let remedy = "give `before`, or `align` none";
            return Err(Invalid::whole("align", "there is only one map", remedy));
        }
    };
    let mut removal = removal(shift.px);
    let mut ring = masked(&removal, &outside);
    let (x, y) = (grid.x.coordinates(), grid.y.coordinates());
    match settings.baseline {
        Baseline::None => {}
        Baseline::Piston => {
            let mean = statistics::statistics(ring.view()).ok_or_else(no_ring)?.mean;
            removal -= mean;
            ring -= mean;
        }
        Baseline::Plane => {
            let plane = statistics::fit_plane(ring.view(), &x, &y).ok_or_else(no_ring)?;
            removal = statistics::subtract_plane(removal.view(), &x, &y, plane);
            ring = masked(&removal, &outside);
        }
    }
    let centre = centroid(grid, &removal, coarse, settings.half_size_mm)?;
    let [shift_mm, shift_error_mm] =
        [shift.px, shift.error_px].map(|px| [px[0] * grid.x.step_mm(), px[1] * grid.y.step_mm()]);
    let noise = statistics::statistics(ring.view());
    let noise_nm = noise.map(|n| n.rms);
    let (tif, depth_nm, clipped_share) = cut(grid, &removal, centre, noise_nm, settings)?;
    Ok(Spot {
        tif,
        shift_mm,
        shift_error_mm,
        steps: shift.steps,
        centre_mm: centre,
        outside_rms_nm: noise.map_or(0.0, |s| s.rms),
        outside_pixels: noise.map_or(0, |s| s.valid_count),
        depth_nm,
        clipped_share,
    })
}

fn no_ring() -> Invalid {
    let remedy = "give a smaller `half_size_mm`, or `baseline` none";
    Invalid::whole("half_size_mm", "leaves no pixels outside the spot", remedy)
}

/// Refuses two maps with different numbers of pixels or different pitches.
fn refuse_other_pixels(before: &Grid, after: &Grid) -> Result<(), Invalid> {
    // Both pitches may have passed through 32-bit floats.
    let is_alike = [(&before.x, &after.x), (&before.y, &after.y)].iter().all(|(a, b)| {
        a.len() == b.len() && (a.step_mm() - b.step_mm()).abs() <= 1e-6 * a.step_mm()
    });
    if is_alike {
        return Ok(());
    }
    let [before, after] =
        [before, after].map(|g| format!("{:?} pixels of {} mm", g.shape(), g.x.step_mm()));
    let problem = format!("has {before}, the map after {after}");
    Err(Invalid::whole("before", problem, "measure both maps alike, or crop them"))
}

fn outside(grid: &Grid, centre: [f64; 2], half_size_mm: f64) -> Array2<bool> {
    Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (grid.x.coordinate_mm(c) - centre[0], grid.y.coordinate_mm(r) - centre[1]);
        x.abs().max(y.abs()) > half_size_mm
    })
}

fn masked(map: &Array2<f64>, mask: &Array2<bool>) -> Array2<f64> {
    let mut out = map.clone();
    out.zip_mut_with(mask, |v, keep| {
        if !keep {
            *v = f64::NAN;
        }
    });
    out
}

/// Returns the middle [x, y] of the square with the largest mean removal, mm; the side of the square is a quarter of
/// that of the TIF. Refuses a map in which no such square has more than half of its pixels valid.
fn find(grid: &Grid, removal: &Array2<f64>, half_size_mm: f64) -> Result<[f64; 2], Invalid> {
    let (ny, nx) = removal.dim();
    // Sums over all pixels above and to the left, of values and of valid pixels.
    let mut sums = Array2::from_elem((ny + 1, nx + 1), [0.0; 2]);
    for r in 0..ny {
        for c in 0..nx {
            let v = removal[[r, c]];
            let own = if v.is_nan() { [0.0; 2] } else { [v, 1.0] };
            sums[[r + 1, c + 1]] = [0, 1]
                .map(|k| own[k] + sums[[r, c + 1]][k] + sums[[r + 1, c]][k] - sums[[r, c]][k]);
        }
    }
    // A square larger than the map reaches as far as the map.
    let [rx, ry] = [&grid.x, &grid.y]
        .map(|axis| ((0.25 * half_size_mm / axis.step_mm()).round() as usize).min(axis.len()));
    let mut best = (f64::NEG_INFINITY, None);
    for r in 0..ny {
        for c in 0..nx {
            let r0 = r.saturating_sub(ry);
            let r1 = (r + ry + 1).min(ny);
            let c0 = c.saturating_sub(rx);
            let c1 = (c + rx + 1).min(nx);
            let [total, count] = [0, 1].map(|k| {
                sums[[r1, c1]][k] - sums[[r0, c1]][k] - sums[[r1, c0]][k] + sums[[r0, c0]][k]
            });
            // Half of the square at least is measured.
            if 2.0 * count > ((r1 - r0) * (c1 - c0)) as f64 && total / count > best.0 {
                best = (total / count, Some([grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)]));
            }
        }
    }
    best.1.ok_or_else(|| {
        Invalid::whole("spot", "was not found: no valid removal", "give `spot_mm` X,Y")
    })
}

/// Returns the centroid of the removal, mm, in a square of the half size around the centroid itself. The search starts
/// at the centroid of the removal above half of the peak, in the square around `near`. Refuses a square without
/// removal.
fn centroid(
    grid: &Grid,
    removal: &Array2<f64>,
    near: [f64; 2],
    half_size_mm: f64,
) -> Result<[f64; 2], Invalid> {
    let heights = removal.indexed_iter().filter(|((r, c), v)| {
        let distance_mm = (grid.x.coordinate_mm(*c) - near[0])
            .abs()
            .max((grid.y.coordinate_mm(*r) - near[1]).abs());
        !v.is_nan() && distance_mm <= half_size_mm
    });
    let peak = heights.map(|(_, v)| *v).fold(0.0, f64::max);
    let Some(first) = centroid_about(grid, removal, near, half_size_mm, 0.5 * peak) else {
        let problem = format!("has no removal around x {}, y {} mm", near[0], near[1]);
        let remedy = "check `before` and after (or `negate`), or give `spot_mm` X,Y";
        return Err(Invalid::whole("spot", problem, remedy));
    };
    let mut centre = first;
    for _ in 0..CENTRE_ROUNDS {
        // A centroid that is far away is not that of a spot; the contrast is then too small, and the spot
        // is refused.
        centre = centroid_about(grid, removal, centre, half_size_mm, f64::NEG_INFINITY)
            .filter(|c| (0..2).all(|k| (c[k] - first[k]).abs() <= 0.5 * half_size_mm))
            .unwrap_or(centre);
    }
    Ok(centre)
}

/// Returns the centroid, mm, of the removal of at least `least_nm` in the square of the half size around (x, y),
/// weighted by depth. Returns `None` if the sum of this removal is not positive.
fn centroid_about(
    grid: &Grid,
    removal: &Array2<f64>,
    [x, y]: [f64; 2],
    half_size_mm: f64,
    least_nm: f64,
) -> Option<[f64; 2]> {
    let mut sums = [0.0; 3];
    for ((r, c), v) in removal.indexed_iter().filter(|(_, v)| **v >= least_nm) {
        let offset = [grid.x.coordinate_mm(c) - x, grid.y.coordinate_mm(r) - y];
        if offset[0].abs().max(offset[1].abs()) <= half_size_mm {
            let add = [v * offset[0], v * offset[1], *v];
            sums.iter_mut().zip(add).for_each(|(s, a)| *s += a);
        }
    }
    if sums[2] > 0.0 { Some([x + sums[0] / sums[2], y + sums[1] / sums[2]]) } else { None }
}

/// Refuses maps whose origins differ by more than half a pixel, if no alignment was asked for.
fn refuse_another_window(before: &Grid, after: &Grid) -> Result<(), Invalid> {
    let is_moved = [(&before.x, &after.x), (&before.y, &after.y)]
        .iter()
        .any(|(a, b)| (a.start_mm() - b.start_mm()).abs() > 0.5 * a.step_mm());
    if !is_moved {
        return Ok(());
    }
    let [before, after] =
        [before, after].map(|g| format!("({}, {}) mm", g.x.start_mm(), g.y.start_mm()));
    let problem = format!("begins at {before}, the map after at {after}");
    let remedy = "measure both with the same window, crop them, or give `align` shift";
    Err(Invalid::whole("before", problem, remedy))
}

/// Returns the square around the centre as a TIF, its largest depth in nm, and the fraction of its volume that was
/// clipped. `noise_nm` is the RMS outside. Refuses a square without pixels or with invalid ones, and a depth below five
/// times the noise.
fn cut(
    grid: &Grid,
    removal: &Array2<f64>,
    centre: [f64; 2],
    noise_nm: Option<f64>,
    settings: &SpotSettings,
) -> Result<(Tif, f64, f64), Invalid> {
    let (c0, c1, x) = window(&grid.x, centre[0], settings.half_size_mm)?;
    let (r0, r1, y) = window(&grid.y, centre[1], settings.half_size_mm)?;
    let mut depth = removal.slice(s![r0..=r1, c0..=c1]).to_owned();
    let invalid = depth.iter().filter(|v| v.is_nan()).count();
    if invalid > 0 {
        let problem = format!("has {invalid} invalid pixels in the square of the TIF");
        let remedy = "give a smaller `half_size_mm`, or fill them first";
        return Err(Invalid::whole("spot", problem, remedy));
    }
    let depth_nm = depth.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if let Some(noise_nm) = noise_nm.filter(|n| depth_nm < LEAST_CONTRAST * n) {
        let problem =
            format!("is {depth_nm} nm deep, with {noise_nm} nm RMS outside it: nothing stands out");
        let remedy = "check `before` and after (or `negate`), `align`, or give `spot_mm` X,Y";
        return Err(Invalid::whole("spot", problem, remedy));
    }
    let mut clipped_share = 0.0;
    if settings.clip_negative {
        let volume = depth.sum();
        depth.mapv_inplace(|v| v.max(0.0));
        let positive = depth.sum();
        clipped_share = 1.0 - volume / positive;
        // Zeros for the negative noise alone would raise the volume, and with it the rate.
        if volume > 0.0 {
            depth *= volume / positive;
        }
    }
    // R = removal / dwell time
    let tif = Tif::new(Grid { x, y }, depth / settings.dwell_s)?;
    Ok((tif, depth_nm, clipped_share))
}

/// Returns the indices of the first and the last pixel within `half` mm of `centre`, and the axis of their offsets from
/// it. Refuses a square without a pixel.
fn window(axis: &Axis, centre: f64, half: f64) -> Result<(usize, usize, Axis), Invalid> {
    let mut inside = (0..axis.len()).filter(|i| (axis.coordinate_mm(*i) - centre).abs() <= half);
    let Some(first) = inside.next() else {
        let remedy = "give a larger `half_size_mm`";
        return Err(Invalid::whole("half_size_mm", format!("{half} holds no pixel"), remedy));
    };
    let last = inside.next_back().unwrap_or(first);
    let offsets = Axis::new(axis.coordinate_mm(first) - centre, axis.step_mm(), last - first + 1)?;
    Ok((first, last, offsets))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const STEP: f64 = 0.1;
    const CENTRE: [f64; 2] = [6.03, 4.17];

    fn grid() -> Grid {
        Grid { x: Axis::new(0.0, STEP, 121).unwrap(), y: Axis::new(0.0, STEP, 101).unwrap() }
    }

    /// Returns the heights of a test piece, nm, moved by `d` mm; its waves have no shift that maps them to themselves.
    fn piece(d: [f64; 2]) -> Array2<f64> {
        let g = grid();
        Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c) - d[0], g.y.coordinate_mm(r) - d[1]);
            10.0 * (1.1 * x + 0.3 * y).sin() + 7.0 * (0.7 * y - 0.2 * x).cos()
        })
    }

    fn dig(at: [f64; 2]) -> Array2<f64> {
        let g = grid();
        Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c) - at[0], g.y.coordinate_mm(r) - at[1]);
            200.0 * (-(x * x + 1.5 * y * y) / 0.5).exp()
        })
    }

    fn settings() -> SpotSettings {
        SpotSettings {
            dwell_s: 25.0,
            half_size_mm: 2.5,
            spot_mm: None,
            align: Alignment::Shift,
            baseline: Baseline::Plane,
            clip_negative: false,
        }
    }

    #[test]
    fn a_planted_spot_comes_back_from_shifted_and_tilted_maps() {
        let g = grid();
        let d = [0.237, -0.154];
        let tilt = Array2::from_shape_fn(g.shape(), |(r, c)| {
            40.0 - 3.0 * g.x.coordinate_mm(c) + 2.0 * g.y.coordinate_mm(r)
        });
        let before = Surface::new(g, piece([0.0; 2])).unwrap();
        // The spot is on the part, so it moves with it.
        let after = piece(d) - dig([CENTRE[0] + d[0], CENTRE[1] + d[1]]) + tilt;
        let after = Surface::new(g, after).unwrap();
        let made = spot(Some(&before), &after, &settings()).unwrap();
        for k in 0..2 {
            // Keys' interpolation of waves of 5.7 mm at 0.1 mm: (2 pi 0.1 / 5.7)^3 / 6 of 10 nm,
            // 2e-3 nm against slopes of 10 nm/mm: 2e-4 mm; what that leaves of the waves in the
            // square is 1e-4 of the spot.
            assert!((made.shift_mm[k] - d[k]).abs() < 3e-4, "{:?}", made.shift_mm);
            assert!((made.centre_mm[k] - CENTRE[k]).abs() < 1e-3, "{:?}", made.centre_mm);
        }
        // As above, over the ring. Regression bound: 3e-4 nm was seen.
        assert!(made.outside_rms_nm < 0.01, "{}", made.outside_rms_nm);
        let (gx, gy) = (made.tif.grid().x, made.tif.grid().y);
        for ((r, c), v) in made.tif.rate_nm_per_s().indexed_iter() {
            let [x, y] = [
                gx.coordinate_mm(c) + made.centre_mm[0] - CENTRE[0],
                gy.coordinate_mm(r) + made.centre_mm[1] - CENTRE[1],
            ];
            let expected = 8.0 * (-(x * x + 1.5 * y * y) / 0.5).exp();
            // Interpolation of the dig itself: (0.1 / 0.5)^3 / 6 x 8 nm/s.
            assert!((v - expected).abs() < 1.1e-2, "{x} {y}: {v} for {expected}");
        }
        // The first moment of the samples is at the offset 0, of a spot with a tail too: beyond its square is 1e-9 of it.
        let tail = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.coordinate_mm(c) - CENTRE[0], g.y.coordinate_mm(r) - CENTRE[1]);
            let along = if x > 0.0 { 0.35 } else { 0.12 };
            200.0 * (-x * x / along - y * y / 0.4).exp()
        });
        let tailed = Surface::new(g, -tail).unwrap();
        let how = SpotSettings { align: Alignment::None, baseline: Baseline::None, ..settings() };
        let made = spot(Some(&Surface::new(g, Array2::zeros(g.shape())).unwrap()), &tailed, &how);
        let made = made.unwrap();
        let (gx, rate) = (made.tif.grid().x, made.tif.rate_nm_per_s());
        let moment: f64 = rate.indexed_iter().map(|((_, c), v)| v * gx.coordinate_mm(c)).sum();
        assert!((moment / rate.sum()).abs() < 1e-6, "{}", moment / rate.sum());
        // (sqrt a - sqrt b) / sqrt pi of two halves of Gaussians exp(-x^2 / a), exp(-x^2 / b), sampled at 0.1 mm
        let expected = (0.35f64.sqrt() - 0.12f64.sqrt()) / std::f64::consts::PI.sqrt();
        let found = made.centre_mm[0] - CENTRE[0];
        // Regression bound: 1.5e-5 mm was seen.
        assert!((found - expected).abs() < 5e-3, "{found} {expected}");
        // Without alignment the waves stay: d times slopes of 10 nm/mm, over the ring.
        let still = SpotSettings { align: Alignment::None, ..settings() };
        let made = spot(Some(&before), &after, &still).unwrap();
        // Regression bound: 1.6 nm was seen.
        assert!(made.outside_rms_nm > 1.0, "{}", made.outside_rms_nm);
    }

    /// Returns normal noise, each a sum of twelve uniform numbers, with the standard deviation `sigma`, averaged over
    /// `side` x `side` pixels.
    fn noise(
        random: &mut ChaCha8Rng,
        side: usize,
        sigma: f64,
        (ny, nx): (usize, usize),
    ) -> Array2<f64> {
        let white = Array2::from_shape_simple_fn((ny + side - 1, nx + side - 1), || {
            (0..12).map(|_| random.random_range(0.0..1.0)).sum::<f64>() - 6.0
        });
        let mean = |(r, c): (usize, usize)| white.slice(s![r..r + side, c..c + side]).sum();
        Array2::from_shape_fn((ny, nx), |at| mean(at) * sigma / side as f64)
    }

    /// Makes the maps before and after a spot of 100 nm on a base with slopes of 0.3 nm per pixel. The part moves by
    /// `pixels`, and each map has noise of `sigma` nm over `side` x `side` pixels.
    fn noisy_maps(
        random: &mut ChaCha8Rng,
        side: usize,
        sigma: f64,
        pixels: [f64; 2],
    ) -> [Surface; 2] {
        let step = 0.2;
        let grid =
            Grid { x: Axis::new(0.0, step, 81).unwrap(), y: Axis::new(0.0, step, 71).unwrap() };
        let height =
            |x: f64, y: f64| 2.4 * (0.8 * x + 0.2 * y).sin() + 2.1 * (0.9 * y - 0.3 * x).cos();
        [([0.0; 2], 0.0), (pixels, 100.0)].map(|(d, depth)| {
            let heights = Array2::from_shape_fn(grid.shape(), |(r, c)| {
                let (x, y) =
                    (grid.x.coordinate_mm(c) - d[0] * step, grid.y.coordinate_mm(r) - d[1] * step);
                let square = (x - 8.0).powi(2) + (y - 7.0).powi(2);
                height(x, y) - depth * (-square / 0.8).exp()
            });
            Surface::new(grid, heights + noise(random, side, sigma, grid.shape())).unwrap()
        })
    }

    #[test]
    fn noise_does_not_draw_the_shift_to_half_a_pixel() {
        // White noise of 0.4 nm, with which least squares end half a pixel off, and noise over 3 x 3 pixels.
        for (side, pixels) in [(1, [0.0, 0.0]), (1, [0.3, -0.3]), (3, [0.0, 0.0]), (3, [0.3, -0.3])]
        {
            let mut random = ChaCha8Rng::seed_from_u64(11);
            let (mut sums, mut over_errors) = ([0.0; 2], 0.0);
            for _ in 0..200 {
                let [before, after] = noisy_maps(&mut random, side, 0.4, pixels);
                let made = spot(Some(&before), &after, &settings()).unwrap();
                for k in 0..2 {
                    let error_px = made.shift_mm[k] / 0.2 - pixels[k];
                    let over = error_px * 0.2 / made.shift_error_mm[k];
                    // Of 800 normal numbers one in 2000 sets is beyond five.
                    assert!(over.abs() < 5.0, "{side}: {made:?}");
                    sums[k] += error_px / 200.0;
                    over_errors += over * over / 400.0;
                }
            }
            println!("{side}, {pixels:?}: {sums:?}, {}", over_errors.sqrt());
            // Regression bound: 0.004 pixels was seen.
            assert!(sums.iter().all(|mean| mean.abs() < 0.01), "{side}, {pixels:?}: {sums:?}");
            // An RMS of 400 normal numbers is known to 3.5 %. The window of the correlation cuts a part of it.
            assert!((0.85..1.2).contains(&over_errors.sqrt()), "{side}: {over_errors}");
        }
    }

    #[test]
    fn spots_with_noise_of_two_percent_are_not_refused() {
        for side in [1, 3] {
            let mut random = ChaCha8Rng::seed_from_u64(12);
            let (mut sum, mut squares) = (0.0, 0.0);
            for _ in 0..200 {
                let [before, after] = noisy_maps(&mut random, side, 2.0, [0.3, -0.3]);
                let made = spot(Some(&before), &after, &settings())
                    .unwrap_or_else(|e| panic!("{side}: {e}"));
                // 100 nm in 25 s, pi 0.8 mm^2
                let off = made.tif.vrr_nm_mm2_per_s() / (4.0 * std::f64::consts::PI * 0.8) - 1.0;
                sum += off / 200.0;
                squares += off * off / 200.0;
            }
            println!("{side}: {sum} {}", squares.sqrt());
            // The mean of 200 scatters by 7 % of one.
            assert!(sum.abs() < 0.25 * squares.sqrt(), "{side}: {sum} {squares}");
        }
    }

    #[test]
    fn a_clipped_spot_keeps_its_volume() {
        // Noise of 1 % of the peak: zeros alone would raise the volume by some percent.
        let mut random = ChaCha8Rng::seed_from_u64(9);
        let depth = dig(CENTRE).mapv(|v| v + random.random_range(-3.4..3.4));
        let depth = Surface::new(grid(), depth).unwrap();
        let made = |clip_negative| {
            let s = SpotSettings { align: Alignment::None, clip_negative, ..settings() };
            spot(None, &depth, &s).unwrap()
        };
        let (plain, clipped) = (made(false), made(true));
        // Regression bound: 5.4 % was seen.
        assert!(clipped.clipped_share > 0.01, "{}", clipped.clipped_share);
        let vrr = [plain, clipped].map(|s| s.tif.vrr_nm_mm2_per_s());
        // Sums of 2500 samples round.
        assert!((vrr[1] / vrr[0] - 1.0).abs() < 1e-12, "{vrr:?}");
    }

    #[test]
    fn a_depth_map_is_cut_centred_and_divided_by_the_time() {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let depth = dig(CENTRE).mapv(|v| v + random.random_range(-0.5..0.5) + 12.0);
        let depth = Surface::new(grid(), depth).unwrap();
        let settings = SpotSettings { align: Alignment::None, clip_negative: true, ..settings() };
        let made = spot(None, &depth, &settings).unwrap();
        // 200 nm in 25 s, noise of 0.5 nm at most, the peak within half a pixel of a sample.
        assert!((made.tif.peak_nm_per_s() - 8.0).abs() < 0.03 + 8.0 * 0.0125);
        // Regression bound: 0.8 % was seen.
        assert!(made.clipped_share > 0.0 && made.clipped_share < 0.02, "{}", made.clipped_share);
        assert!(made.tif.rate_nm_per_s().iter().all(|v| *v >= 0.0));
        assert!(made.tif.half_size_mm()[0] <= 2.5);
        // RMS of a uniform distribution of +-0.5: 1 / sqrt(12), within 3 % for 8000 pixels.
        assert!((made.outside_rms_nm - 12.0_f64.powf(-0.5)).abs() < 0.01);
    }

    #[test]
    fn what_cannot_be_a_spot_is_refused() {
        let g = grid();
        let map = |m: Array2<f64>| Surface::new(g, m).unwrap();
        let flat = map(piece([0.0; 2]));
        let dug = map(piece([0.0; 2]) - dig(CENTRE));
        let message = |b: Option<&Surface>, a: &Surface, s: SpotSettings| {
            spot(b, a, &s).unwrap_err().to_string()
        };
        let zero = SpotSettings { dwell_s: 0.0, ..settings() };
        assert!(message(Some(&flat), &dug, zero).contains("dwell_s: is 0"));
        assert!(message(None, &dug, settings()).contains("only one map"));
        let large = SpotSettings { half_size_mm: 50.0, ..settings() };
        assert!(message(Some(&flat), &dug, large).contains("align"));
        let mut holed = piece([0.0; 2]) - dig(CENTRE);
        holed[[42, 60]] = f64::NAN;
        assert!(message(Some(&flat), &map(holed), settings()).contains("invalid pixels"));
        let smaller = Grid { x: Axis::new(0.0, STEP, 120).unwrap(), y: g.y };
        let smaller = Surface::new(smaller, Array2::zeros((101, 120))).unwrap();
        assert!(message(Some(&smaller), &dug, settings()).contains("before: has"));
        // Swapped maps: material was added.
        let still = SpotSettings { align: Alignment::None, ..settings() };
        let swapped = message(Some(&dug), &flat, still);
        assert!(swapped.contains("nothing stands out"), "{swapped}");
    }
}
