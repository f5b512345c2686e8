//! Predicted against measured removal, band by band of spatial frequency.
//!
//! Bands are octaves of the period over the width of the TIF, from what a tool removes easily to what it does not
//! reach. The densities are those of the largest rectangle of valid pixels, plane removed, Hann window
//! (`planish_numerics::spectrum`), as in the report of a plan; their sums over adjoining bands add up. The transfer of
//! a band is the coefficient by which the predicted removal fits the measured one there,
//! `sum Re(d conj(F)) / sum |F|^2`: 1 where the prediction is right, 0 where what is measured has nothing of it.

use ndarray::{Array2, s};
use planish_numerics::spectrum::{Density, MIN_SAMPLES, hann, largest_rectangle, without_plane};
use planish_types::{Grid, outcome::reconciliation::Band};

/// Longest periods of the bands of spatial frequency from the second one on, in widths of the TIF; the first band has
/// no longest period, the last no shortest. More or closer: narrower bands with more noise. Fewer: less detail. Chosen:
/// octaves, from what a tool removes easily to what it does not reach.
const PERIODS_OVER_WIDTH: [f64; 4] = [16.0, 8.0, 4.0, 2.0];

/// Maps of removal that are compared, shape (ny, nx), nm.
pub struct Maps<'a> {
    /// Measured removal: the difference of the maps without the terms of the metrology (d - Q c).
    pub measured: &'a Array2<f64>,
    /// Removal that the plan predicts without errors (M(0)).
    pub planned: &'a Array2<f64>,
    /// Removal with the fitted parameters (F(p)).
    pub predicted: &'a Array2<f64>,
}

/// Returns the RMS of the maps in each band of spatial frequency. `valid` is 1 at valid pixels, else 0, and `width_mm`
/// is the width of the TIF. Empty if a side of the largest rectangle of valid pixels has fewer pixels than a spectrum
/// needs.
pub fn bands(maps: &Maps<'_>, valid: &Array2<f64>, grid: &Grid, width_mm: f64) -> Vec<Band> {
    let (origin, (ny, nx)) = largest_rectangle(&valid.mapv(|v| v > 0.5));
    if ny < MIN_SAMPLES || nx < MIN_SAMPLES {
        return Vec::new();
    }
    let rows = origin.0..origin.0 + ny;
    let columns = origin.1..origin.1 + nx;
    let x = grid.x.coordinates();
    let y = grid.y.coordinates();
    let windows = [hann(nx), hann(ny)];
    let density = |map: &Array2<f64>| {
        let z = map.slice(s![rows.clone(), columns.clone()]);
        let z = without_plane(z, &x[columns.clone()], &y[rows.clone()]);
        Density::new(
            z.view(),
            [grid.x.step_mm(), grid.y.step_mm()],
            windows.each_ref().map(|w| &w[..]),
        )
    };
    let measured = density(maps.measured);
    let planned = density(maps.planned);
    let predicted = density(maps.predicted);
    let less_planned = density(&(maps.measured - maps.planned));
    let rest = density(&(maps.measured - maps.predicted));
    let mut periods: Vec<Option<f64>> = vec![None];
    periods.extend(PERIODS_OVER_WIDTH.map(|n| Some(n * width_mm)));
    periods.push(Some(0.0));
    let mut bands = Vec::new();
    for ends in periods.windows(2) {
        let range = [frequency(ends[0]), frequency(ends[1])];
        let [m, p, f, less_p, r] = [&measured, &planned, &predicted, &less_planned, &rest]
            .map(|density| density.mean_square(range).max(0.0));
        bands.push(Band {
            period_mm: [ends[1], ends[0]],
            measured_rms_nm: m.sqrt(),
            planned_rms_nm: p.sqrt(),
            predicted_rms_nm: f.sqrt(),
            measured_less_planned_rms_nm: less_p.sqrt(),
            rest_rms_nm: r.sqrt(),
            // 2 Re(d conj(F)) = |d|^2 + |F|^2 - |d - F|^2
            transfer: if f > 0.0 { Some(0.5 * (m + f - r) / f) } else { None },
        });
    }
    bands
}

/// Returns the spatial frequency of a period, 1/mm; 0 for `None`, the longest period, and infinity for a period of 0.
fn frequency(period_mm: Option<f64>) -> f64 {
    match period_mm {
        None => 0.0,
        Some(period) if period > 0.0 => 1.0 / period,
        Some(_) => f64::INFINITY,
    }
}
