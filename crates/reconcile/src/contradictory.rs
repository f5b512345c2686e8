//! Maps after a run that are not those of the run.
//!
//! The given map is compared with other readings of it: with its sign turned, with twice or half of its heights, turned
//! or mirrored. If one of them leaves less than half of what the given map leaves, the
//! given map contradicts the run. A reading that multiplies the noise is compared at equal noise. Maps of no known
//! mistake are found by their size: the fit explains less than half of what the plan missed, the rest is at least a
//! quarter of the measured removal, and it is no noise from pixel to pixel.

use ndarray::{Array2, s};
use planish_types::text::significant;

use crate::{
    fit::{Data, Start},
    metrology::Term,
    report::Fitted,
};

/// Rest of another reading over the rest of the given one from which it is the right one. Noise alone gives 1.
const PLAINLY: f64 = 0.5;

/// Rest over what the plan missed below which the fit explains the run, whatever other readings leave.
const EXPLAINED: f64 = 0.01;

/// Least rest over what the plan missed, over the measured removal, and over the noise from pixel to pixel.
const OF_MISSED: f64 = 0.5;
const OF_REMOVAL: f64 = 0.25;
const OF_NOISE: f64 = 3.0;

/// Returns the sentence that says so if the fit explains nothing. `start` is the model at the plan, `rest` what the fit
/// leaves.
pub fn explains_nothing(
    before: &Array2<f64>,
    data: &Data<'_>,
    start: &Start,
    terms: &[Term],
    rest: &Array2<f64>,
    fitted: &Fitted,
) -> Option<String> {
    let with_nan = |v: f64, valid: &f64| if *valid > 0.5 { v } else { f64::NAN };
    let mut after = before - &data.data;
    after.zip_mut_with(&data.valid, |v, valid| *v = with_nan(*v, valid));
    let left_nm = fitted.rest_rms_nm;
    // A reading as before - factor * after, which has the noise (1 + factor^2) / 2 of the given one.
    let mirrored = |y: i32, x: i32| after.slice(s![..;y, ..;x]).to_owned();
    let readings: [(&str, Array2<f64>, f64); 6] = [
        ("with its sign turned", -&after, 1.0),
        ("with twice its heights", 2.0 * &after, 2.5_f64.sqrt()),
        ("with half of its heights", 0.5 * &after, 0.625_f64.sqrt()),
        ("turned by 180 degrees", mirrored(-1, -1), 1.0),
        ("mirrored along x", mirrored(1, -1), 1.0),
        ("mirrored along y", mirrored(-1, 1), 1.0),
    ];
    let mut best = ("", f64::INFINITY);
    for (name, map, gain) in readings {
        let mut other = before - &map;
        let valid = other.mapv(|v| if v.is_nan() { 0.0 } else { 1.0 });
        if valid.sum() < 0.5 * data.valid.sum() {
            continue;
        }
        other.mapv_inplace(|v| if v.is_nan() { 0.0 } else { v });
        let other = Data { grid: data.grid, data: other, valid };
        let left = start.left_of(terms, &other) / gain;
        if left < best.1 {
            best = (name, left);
        }
    }
    let missed = fitted.measured_less_planned_rms_nm;
    let said = format!(
        "the fit explains nothing: {} of the {} nm RMS that the plan missed are left",
        significant(left_nm, 3),
        significant(missed, 3)
    );
    if left_nm > EXPLAINED * missed && best.1 < PLAINLY * left_nm {
        return Some(format!(
            "{said}, and only {} nm if the map after is read {}: check the map after",
            significant(best.1, 3),
            best.0
        ));
    }
    let is_large = left_nm > OF_MISSED * missed
        && left_nm > OF_REMOVAL * fitted.measured_removal_rms_nm
        && left_nm > OF_NOISE * pixel_noise_nm(rest, &data.valid);
    is_large.then(|| {
        format!("{said}: check that both maps, the motion and the tool are those of one run")
    })
}

/// Standard deviation of white noise that has the second differences of `map` along x, nm.
fn pixel_noise_nm(map: &Array2<f64>, valid: &Array2<f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0_f64);
    for (row, valid) in map.outer_iter().zip(valid.outer_iter()) {
        for c in 1..row.len().saturating_sub(1) {
            if valid[c - 1] + valid[c] + valid[c + 1] > 2.5 {
                // 1 + 4 + 1 times the variance of one
                sum += (row[c - 1] - 2.0 * row[c] + row[c + 1]).powi(2) / 6.0;
                count += 1.0;
            }
        }
    }
    (sum / count.max(1.0)).sqrt()
}
