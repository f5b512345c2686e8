//! Maps after a run that are not those of the run.
//!
//! The given map is compared with other readings of it: with its sign turned, with twice or half of its heights, turned
//! or mirrored. If one of them leaves less than half of what the given map leaves, the
//! given map contradicts the run. A reading that multiplies the noise is compared at equal noise. Maps of no known
//! mistake are found by their size: the fit explains less than half of what the plan missed, the rest is at least a
//! quarter of the measured removal, and it is no noise from pixel to pixel.
//!
//! What no tool reaches stays on the part, so the map after contains it with the factor 1, whatever the run did otherwise.
//! This factor is the slope of the map after on what the fit predicts of it ([`slope_on_predicted`]). A map with a turned
//! sign has -1, one of half the heights 0.5, and one of another part or position 0.
//!
//! Where all of the residual is noise, no slope tells the unit. Two maps of one instrument have about the same noise, so
//! a ratio of their noises that is a power of ten is taken for a wrong unit.

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

/// Range of the slope of the map after on the predicted one that is taken for 1. Wider: mistakes of a factor near 1 pass.
/// Narrower: errors that the model does not know, and that resemble the residual, are taken for a mistake. Chosen between
/// 1 and the factors of the usual mistakes, 0, 1/2 and 2.
const SLOPES: [f64; 2] = [0.7, 1.4];

/// Standard errors by which the slope must be beyond this range. Larger: mistakes pass on noisy maps. Smaller: right maps
/// are refused by chance. Chosen.
const SLOPE_ERRORS: f64 = 4.0;

/// Largest distance of the logarithm of a ratio of noises from a whole number of decades. Larger: maps that are measured
/// with ten times less averaging are refused by chance. Smaller: a wrong unit passes on small maps. Derived: the noise of
/// 1000 pixels is known to 4 %, 0.02 of a decade.
const NEAR_POWER: f64 = 0.05;

/// Fourth differences over two pixels relative to those over one, from which a map has more figure than noise between its
/// pixels. Larger: figures are taken for noise. Smaller: noise that is correlated over some pixels, with 1.5, is no noise.
/// Chosen.
const FIGURE: f64 = 3.0;

/// Number of blocks along an axis whose errors count as independent. Larger: long waves of the errors are underestimated.
/// Smaller: a worse estimate of the standard error. Chosen.
const BLOCKS: usize = 8;

/// Least part of the mean square of the predicted map that is no noise. Larger: fewer maps are judged. Smaller: the
/// correction for noise is a guess. Chosen.
const LEAST_SIGNAL: f64 = 0.2;

/// Other reading of the map after that leaves the least, and what it leaves, nm RMS.
fn best_reading(
    before: &Array2<f64>,
    after: &Array2<f64>,
    data: &Data<'_>,
    start: &Start,
    terms: &[Term],
) -> (&'static str, f64) {
    // A reading as before - factor * after, which has the noise (1 + factor^2) / 2 of the given one.
    let mirrored = |y: i32, x: i32| after.slice(s![..;y, ..;x]).to_owned();
    let readings: [(&str, Array2<f64>, f64); 6] = [
        ("with its sign turned", -after, 1.0),
        ("with twice its heights", 2.0 * after, 2.5_f64.sqrt()),
        ("with half of its heights", 0.5 * after, 0.625_f64.sqrt()),
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
    best
}

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
    let best = best_reading(before, &after, data, start, terms);
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
    let piston = [Array2::ones(after.dim())];
    let maps: Vec<Array2<f64>> =
        piston.into_iter().chain(terms.iter().map(|t| t.map(data.grid))).collect();
    let slope = slope_on_predicted(before, &after, rest, &data.valid, &maps);
    if let Some([plain, corrected]) = slope {
        let [low, high] = SLOPES;
        let is_less = [plain, corrected].iter().all(|(s, e)| s + SLOPE_ERRORS * e < low);
        let is_more = [plain, corrected].iter().all(|(s, e)| s - SLOPE_ERRORS * e > high);
        if is_less || is_more {
            let (slope, error) = corrected;
            return Some(format!(
                "the map after is {} +- {} times the map that the fit predicts, where 1 is expected: check its sign, its \
                 unit, its orientation, and that it is of this run",
                significant(slope, 2),
                significant(error, 1)
            ));
        }
    }
    if let Some(ratio) = power_of_ten(before, &after, &data.valid) {
        return Some(format!(
            "the noise from pixel to pixel of the map after is {} times that of the map before, as if its heights were in \
             another unit: check its unit",
            significant(ratio, 3)
        ));
    }
    let is_large = left_nm > OF_MISSED * missed
        && left_nm > OF_REMOVAL * fitted.measured_removal_rms_nm
        && left_nm > OF_NOISE * pixel_noise_nm(rest, &data.valid);
    is_large.then(|| {
        format!("{said}: check that both maps, the motion and the tool are those of one run")
    })
}

/// Range of the slope of the map after, a, on the map p that the fit predicts of it, with the standard error of both ends;
/// both maps without the terms of the metrology, which the fit takes from the map after. `None` where p is hardly more than
/// noise, unless the slope is below 0, which no noise does.
///
/// ```text
/// p = a + rest,   slope = <p, a> / (<p, p> - N sigma^2)
/// error^2 = sum over blocks of <p, a - slope p>^2 / (<p, p> - N sigma^2)^2
/// ```
///
/// N sigma^2 is the noise of the map before, which p contains and a does not. It lies between 0 and the noise from pixel to
/// pixel of the map before or of the rest, whichever is less.
fn slope_on_predicted(
    before: &Array2<f64>,
    after: &Array2<f64>,
    rest: &Array2<f64>,
    valid: &Array2<f64>,
    terms: &[Array2<f64>],
) -> Option<[(f64, f64); 2]> {
    let is_valid = valid.mapv(|v| if v > 0.5 { 1.0 } else { 0.0 });
    let after = without(terms, &after.mapv(|v| if v.is_nan() { 0.0 } else { v }), &is_valid);
    let predicted = without(terms, &(&after + rest), &is_valid);
    let (squares, count) = ((&predicted * &predicted).sum(), is_valid.sum());
    let noise_nm = pixel_noise_nm(before, valid).min(pixel_noise_nm(rest, valid));
    let signal = squares - noise_nm.powi(2) * count;
    if count < (BLOCKS * BLOCKS) as f64 {
        return None;
    }
    let plain = (&predicted * &after).sum() / squares;
    let (ny, nx) = after.dim();
    let mut blocks = vec![0.0; BLOCKS * BLOCKS];
    for ((r, c), p) in predicted.indexed_iter() {
        blocks[r * BLOCKS / ny * BLOCKS + c * BLOCKS / nx] += p * (after[[r, c]] - plain * p);
    }
    let error = blocks.iter().map(|b| b * b).sum::<f64>().sqrt();
    let at = |denominator: f64| (plain * squares / denominator, error / denominator);
    if signal >= LEAST_SIGNAL * squares {
        return Some([at(squares), at(signal)]);
    }
    let is_turned = at(squares).0 + SLOPE_ERRORS * at(squares).1 < 0.0;
    is_turned.then(|| [at(squares); 2])
}

/// The map without its least-squares part in the `columns`, over the valid pixels; 0 elsewhere.
fn without(columns: &[Array2<f64>], map: &Array2<f64>, valid: &Array2<f64>) -> Array2<f64> {
    let mut left = map * valid;
    let mut basis: Vec<Array2<f64>> = Vec::new();
    for column in columns {
        let mut column = column * valid;
        let given = (&column * &column).sum().sqrt();
        for other in &basis {
            let along = (&column * other).sum();
            column.scaled_add(-along, other);
        }
        let norm = (&column * &column).sum().sqrt();
        // Rounding of a column that the ones before it span, as on a single row.
        if norm <= 1e-9 * given {
            continue;
        }
        column /= norm;
        let along = (&left * &column).sum();
        left.scaled_add(-along, &column);
        basis.push(column);
    }
    left
}

/// Ratio of the noise of two maps of one instrument, after over before, if it is a power of ten. `None` if it is not, or
/// if the fourth differences of a map are more of its figure than of its noise: over twice the distance, those of a
/// figure are sixteen times as large, those of noise hardly larger.
fn power_of_ten(before: &Array2<f64>, after: &Array2<f64>, valid: &Array2<f64>) -> Option<f64> {
    let noise = |map: &Array2<f64>| {
        let fourth = [1.0, -4.0, 6.0, -4.0, 1.0];
        let [near, far] = [1, 2].map(|lag| noise_by_differences_nm(map, valid, &fourth, lag));
        (near > 0.0 && far < FIGURE * near).then_some(near)
    };
    let ratio = noise(after)? / noise(before)?;
    let decades = ratio.log10().round();
    let is_power = decades != 0.0 && (ratio.log10() - decades).abs() < NEAR_POWER;
    is_power.then_some(ratio)
}

/// Standard deviation of white noise that has the second differences of `map` along x, nm.
fn pixel_noise_nm(map: &Array2<f64>, valid: &Array2<f64>) -> f64 {
    noise_by_differences_nm(map, valid, &[1.0, -2.0, 1.0], 1)
}

/// Standard deviation of white noise that has the differences of `map` along x with these weights, on pixels that are
/// `lag` apart, nm.
fn noise_by_differences_nm(
    map: &Array2<f64>,
    valid: &Array2<f64>,
    weights: &[f64],
    lag: usize,
) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0_f64);
    let variance: f64 = weights.iter().map(|w| w * w).sum();
    for (row, valid) in map.outer_iter().zip(valid.outer_iter()) {
        for c in 0..row.len().saturating_sub(lag * (weights.len() - 1)) {
            let at = |k: usize| c + k * lag;
            if (0..weights.len()).all(|k| valid[at(k)] > 0.5) {
                let difference = (0..weights.len()).map(|k| weights[k] * row[at(k)]).sum::<f64>();
                sum += difference * difference / variance;
                count += 1.0;
            }
        }
    }
    (sum / count.max(1.0)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_testkit::case_generator;
    use rand::RngExt;

    const SIZE: usize = 64;

    /// White noise of about this RMS, nm.
    fn noise(stream: u64, rms_nm: f64) -> Array2<f64> {
        let mut random = case_generator(77, stream, 0);
        // The sum of twelve uniform numbers has the variance 1.
        let mut normal = || (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
        Array2::from_shape_fn((SIZE, SIZE), |_| rms_nm * normal())
    }

    /// Waves of 6 to 12 pixels, 0.5 nm RMS each along its axis: what a tool cannot reach.
    fn residual() -> Array2<f64> {
        Array2::from_shape_fn((SIZE, SIZE), |(r, c)| {
            0.7 * ((0.9 * c as f64).sin() + (0.6 * r as f64 + 0.2 * c as f64).cos())
        })
    }

    /// The residual r stays on the part. The map after is f (r + noise), so the rest is p - f (r + noise) with the predicted
    /// map p = r + noise of the map before.
    #[test]
    fn the_slope_is_the_factor_of_the_map_after() {
        let (r, ones) = (residual(), Array2::ones((SIZE, SIZE)));
        let (noise_before, noise_after) = (noise(1, 0.3), noise(2, 0.5));
        let smooth = Array2::from_shape_fn((SIZE, SIZE), |(y, x)| 1e-3 * (x * x + y * x) as f64);
        let (before, predicted) = (&smooth + &noise_before, &r + &noise_before);
        for factor in [1.0, -1.0, 0.5, 2.0, 10.0] {
            let after = factor * (&r + &noise_after);
            let rest = &predicted - &after;
            let [plain, corrected] =
                slope_on_predicted(&before, &after, &rest, &ones, std::slice::from_ref(&ones))
                    .unwrap();
            // The noise of the map before lowers the plain slope by the ratio of the mean squares, 0.49 / (0.49 + 0.09).
            let lowered = 0.49 / 0.58;
            for ((slope, error), expected) in [(plain, factor * lowered), (corrected, factor)] {
                // Four standard errors, and 3 % for the estimate of the noise from 4000 second differences.
                let allowed = 4.0 * error + 0.03 * factor.abs();
                assert!((slope - expected).abs() < allowed, "{factor}: {slope} +- {error}");
            }
        }
        // A map of another part has the slope 0.
        let other = noise(3, 0.7);
        let [_, (slope, error)] = slope_on_predicted(
            &before,
            &other,
            &(&predicted - &other),
            &ones,
            std::slice::from_ref(&ones),
        )
        .unwrap();
        // Four standard errors, as above.
        assert!(slope.abs() < 4.0 * error, "{slope} +- {error}");
        assert!(slope + SLOPE_ERRORS * error < SLOPES[0]);
        // Where the predicted map is noise, only a turned sign is said.
        let little = 0.2 * &r;
        let p = &little + &noise_before;
        let slope = |after: Array2<f64>| {
            slope_on_predicted(&before, &after, &(&p - &after), &ones, std::slice::from_ref(&ones))
        };
        assert_eq!(slope(&little + &noise_after), None);
        assert!(slope(-(&little + &noise_after)).is_some());
    }
}
