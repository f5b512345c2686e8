//! Mean of repeated measurements of one part, with the standard deviation of every pixel.
//!
//! Map k is z_k. Between two measurements the part is mounted again. It is then shifted, turned, and tilted against
//! the instrument. [`crate::maps`] finds the shift and the rotation on the first map, unless the caller says that the
//! part lay still. A polynomial of low order is the difference of the mountings, and of drifts of the instrument.
//! With T_k the transform from the first map to map k, and q_k the least-squares fit of z_k(T_k x) - z_0(x),
//!
//! ```text
//! y_k(x) = z_k(T_k x) - q_k(x)
//! mean   m(x) = sum_k y_k(x) / n(x)
//! spread s(x) = sqrt(sum_k (y_k(x) - m(x))^2 / (n(x) - 1))      of one measurement
//!        u(x) = s(x) / sqrt(n(x))                               of the mean
//! ```
//!
//! n(x) is the number of maps that are valid at x; a pixel with n < 2 is invalid in the result. Between its pixels, a map
//! is Keys' cubic convolution, which smooths its noise: by up to a factor of 0.64 in the middle of four pixels. A map that
//! lies on the pixels of the first one is not interpolated.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z_k | `maps` | (ny, nx) each | nm |
//! | q_k | coefficients of Legendre products | - | nm |
//! | m, u | heights and deviations of `mean` | (ny, nx) | nm |

use ndarray::Array2;
use planish_types::{Invalid, Surface, progress};
use serde::Serialize;

use crate::{
    fit::Estimate,
    low_order::LowOrder,
    maps::{MapSettings, register},
    resampled::Resampled,
};

/// Settings for the mean of repeated measurements.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct SeriesSettings {
    /// Settings of the registration of every map on the first one; `None` if the part did not move between the
    /// measurements.
    pub registration: Option<MapSettings>,
    /// Highest total order of the Legendre terms by which two measurements may differ: 0 is the piston, 1 the plane.
    pub free_order: usize,
}

/// Mean of repeated measurements, with its statistics.
#[derive(Clone, Debug)]
pub struct Series {
    /// Mean height on the pixels of the first map, nm, with the standard deviation of that mean at every pixel.
    pub mean: Surface,
    /// Statistics of the measurements: scatter, and shift of each map.
    pub report: SeriesReport,
}

/// Statistics of repeated measurements of one part.
#[derive(Clone, Debug, Serialize)]
pub struct SeriesReport {
    /// Number of maps that were averaged.
    pub maps: usize,
    /// Pooled standard deviation of one measurement, nm. It is the root of the mean of the variance s^2 over the
    /// pixels, weighted by the number n of maps minus 1.
    pub single_deviation_nm: f64,
    /// RMS over the pixels of the standard deviation of the mean, nm.
    pub mean_deviation_nm: f64,
    /// Number of pixels with a mean: at least two maps are valid there.
    pub pixels: usize,
    /// Shift, rotation and difference of every map after the first one, in the order given.
    pub members: Vec<Member>,
}

/// Shift and rotation of one map relative to the first map, and its difference from it.
#[derive(Clone, Debug, Serialize)]
pub struct Member {
    /// Shift along x relative to the first map, mm; `None` if the maps were not registered.
    pub shift_x_mm: Option<Estimate>,
    /// Shift along y relative to the first map, mm; `None` if the maps were not registered.
    pub shift_y_mm: Option<Estimate>,
    /// Rotation relative to the first map, degree, positive from x towards y; `None` if the maps were not registered.
    pub rotation_deg: Option<Estimate>,
    /// True if heights were interpolated, because the pixels do not coincide with those of the first map.
    pub interpolated: bool,
    /// RMS of the difference from the first map after subtraction of the fitted low-order terms, nm.
    pub difference_rms_nm: f64,
    /// Number of pixels that are valid in this map and in the first one.
    pub pixels: usize,
}

/// Largest number of maps. Larger: more memory, one map each. Smaller: long series are refused. Chosen: from so many
/// maps the standard deviation is known to 2 %.
pub const MOST_MAPS: usize = 1000;

/// Refusal of one map of several, with the reason.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("map {}: {reason}", index + 1)]
pub struct RefusedMap {
    /// Index of the refused map, counted from 0.
    pub index: usize,
    /// Problem of the map, with a remedy.
    pub reason: Invalid,
}

/// Averages repeated maps of one part on the pixels of the first one, after registration and subtraction of low-order
/// differences.
///
/// # Errors
/// Refuses fewer than 2 maps or more than [`MOST_MAPS`], a map that does not register on the first one, and maps that
/// have no pixels in common.
pub fn mean(maps: &[Surface], settings: &SeriesSettings) -> Result<Series, RefusedMap> {
    let refused = |index: usize| move |reason: Invalid| RefusedMap { index, reason };
    if !(2..=MOST_MAPS).contains(&maps.len()) {
        let problem = format!("has {} map(s)", maps.len());
        let remedy = format!("give 2 to {MOST_MAPS} measurements of the same part");
        return Err(refused(0)(Invalid::whole("series", problem, remedy)));
    }
    let first = &maps[0];
    let grid = first.grid();
    let low_order = LowOrder::new(grid, settings.free_order).map_err(refused(0))?;
    let mut members = Vec::new();
    let mut levelled = vec![first.height_nm().clone()];
    for (k, map) in maps.iter().enumerate().skip(1) {
        let registration = match &settings.registration {
            None => None,
            Some(how) => Some(
                progress::part(k - 1, maps.len() - 1, || register(first, map, how))
                    .map_err(refused(k))?,
            ),
        };
        let source = Resampled::new(map, grid);
        let there = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let p = [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)];
            let height = match &registration {
                Some(registration) => source.at_point(registration.transform.point(p)),
                None => source.at_pixel((r, c), p),
            };
            height.unwrap_or(f64::NAN)
        });
        let difference = &there - first.height_nm();
        let fitted = low_order.fit(&difference).map_err(refused(k))?;
        let rest = &difference - &fitted;
        let known: Vec<f64> = rest.iter().copied().filter(|v| !v.is_nan()).collect();
        let squares: f64 = known.iter().map(|v| v * v).sum();
        let report = registration.as_ref().map(|registration| &registration.report);
        members.push(Member {
            shift_x_mm: report.map(|r| r.shift_x_mm),
            shift_y_mm: report.map(|r| r.shift_y_mm),
            rotation_deg: report.map(|r| r.rotation_deg),
            interpolated: registration.is_some() || !source.is_exact(),
            difference_rms_nm: (squares / known.len() as f64).sqrt(),
            pixels: known.len(),
        });
        levelled.push(there - fitted);
    }
    let moments = Array2::from_shape_fn(grid.shape(), |pixel| Moments::new(&levelled, pixel));
    let valid: Vec<&Moments> = moments.iter().filter(|m| m.count >= 2.0).collect();
    if valid.is_empty() {
        let problem = "has no pixel that two maps have in common";
        return Err(refused(0)(Invalid::whole("series", problem, "give maps of the same part")));
    }
    let degrees: f64 = valid.iter().map(|m| m.count - 1.0).sum();
    let squares: f64 = valid.iter().map(|m| m.squares).sum();
    let of_mean: f64 = valid.iter().map(|m| m.deviation().powi(2)).sum();
    let report = SeriesReport {
        maps: maps.len(),
        single_deviation_nm: (squares / degrees).sqrt(),
        mean_deviation_nm: (of_mean / valid.len() as f64).sqrt(),
        pixels: valid.len(),
        members,
    };
    let height_nm = moments.map(|m| if m.count >= 2.0 { m.mean } else { f64::NAN });
    let deviation_nm = moments.map(|m| if m.count >= 2.0 { m.deviation() } else { f64::NAN });
    let mean = Surface::new(*grid, height_nm)
        .and_then(|mean| mean.with_deviation(deviation_nm))
        .map_err(refused(0))?;
    Ok(Series { mean, report })
}

/// Number of valid heights of a pixel, their mean (nm), and the sum of their squared deviations from it (nm^2).
struct Moments {
    count: f64,
    mean: f64,
    squares: f64,
}

impl Moments {
    /// Returns the moments over the maps at a pixel (row, column); NaN marks invalid heights.
    fn new(maps: &[Array2<f64>], pixel: (usize, usize)) -> Self {
        let heights = maps.iter().map(|map| map[pixel]).filter(|z| !z.is_nan());
        let count = heights.clone().count() as f64;
        let mean = heights.clone().sum::<f64>() / count;
        let squares = heights.map(|z| (z - mean).powi(2)).sum();
        Self { count, mean, squares }
    }

    /// Returns the standard deviation u of the mean, nm (module); it needs at least two maps.
    fn deviation(&self) -> f64 {
        (self.squares / (self.count - 1.0) / self.count).sqrt()
    }
}
