//! Evidence that the map after is that of the run: its sign, scale, orientation, position, and part. A reading is one
//! way to take the map after, for example turned or with the other sign.
//!
//! What no tool reaches stays on the part. It is in the map before, less the removal, and it is in the map after,
//! whatever the run did otherwise. So their common part says whether the map after is of this run, and how it lies:
//!
//! ```text
//! p = P (before - removal)      a = P after                          P takes off all that the fit can explain
//! X(h) = sum_x p(x) a(x + h)    sigma^2 = sum_h N(h) C_p(h) C_a(h)   h = 0 is expected to be the largest
//! ```
//!
//! The noise of two maps is independent, so X has no part of it, and sigma is its scatter if the maps have nothing in
//! common (Bartlett's formula; N(h), C(h): pairs of pixels that are h apart, and the covariance of a map). Another
//! reading of the map after, with X_k in place of X, is less probable than the given one by the factor
//!
//! ```text
//! exp(-X (X - X_k) / sigma^2)
//! ```
//!
//! That holds for the map with its sign turned (X_k = -X), for another part (half of X^2, X_k = 0), for the map turned
//! or mirrored, and for the map at another place (X(h)). Where a reading is not [`ODDS`] less probable, the maps do not
//! tell, and nothing of the fit is applied, unless the user states that both maps were measured in the same way.
//!
//! The scale s of the map after lies within bounds that no noise passes (Frisch's bounds of two maps with errors), and
//! where white noise can be told from the figure, the noise is taken off them:
//!
//! ```text
//! X / <p, p>  <=  s  <=  <a, a> / X             X / (<p, p> - N n_p^2),   (<a, a> - N n_a^2) / X
//! ```
//!
//! If they do not tell 1 from 1/2 and 2, equal noise of both maps does, because two maps of one instrument have about
//! the same. How much of the planned removal is between the maps is a regression of before - after on it: 1 is
//! expected, 0 is a map that was measured twice, and -1 is two maps that were exchanged.
//!
//! Maps of no known mistake are found by their size: the fit explains less than half of what the plan missed, the rest
//! is at least a quarter of the measured removal, and it is no noise from pixel to pixel.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | p, a | `expected`, `after` | (ny, nx) | nm |
//! | X, sigma | `common`, `scatter` | | nm^2 |
//! | n_p, n_a | `noise_nm` | | nm |
//!
//! Sources: M. S. Bartlett, J. Roy. Stat. Soc. B 8 (1946) 27; R. Frisch, Statistical confluence analysis (1934).

use ndarray::{Array2, s};
use planish_numerics::fft::{smooth_size, transform};
use planish_types::{
    outcome::reconciliation::{Evidence, Fitted},
    text::significant,
};

use crate::{
    correlation::padded,
    fit::{Data, LeastSquaresFit, Normal, dot},
};

/// Logarithm of the odds with which one reading of the map after is preferred to another. Larger: fewer maps are
/// accepted. Smaller: a wrong map is accepted by chance. Chosen: 3000 to 1; a map of another part then needs four
/// standard errors.
const ODDS: f64 = 8.0;

/// Range of the scale of the map after that is accepted as 1. Wider: mistakes of a factor near 1 pass. Narrower: errors
/// that the model does not know, and that resemble the residual, are taken for a mistake. Chosen between 1 and the
/// factors of the usual mistakes, 1/2 and 2.
const SCALES: [f64; 2] = [0.7, 1.4];

/// Number of standard errors by which the factor of the removal, or the scale of the map after, must be beyond its
/// accepted range. Larger: mistakes pass on noisy maps. Smaller: right maps are refused by chance. Chosen.
const ERRORS: f64 = 4.0;

/// Range of the ratio of the noise of the map after to that of the map before which one instrument can have. Wider:
/// half and twice the heights pass. Narrower: right maps are refused. Derived: the noise of 1000 pixels is known to 4
/// %, and 1/2 and 2 are far away.
const SAME_NOISE: [f64; 2] = [0.75, 1.33];

/// Accepted range of the factor of the planned removal in the difference of the maps. Wider: a map that was measured
/// twice passes. Narrower: runs whose rate is off are refused. Chosen: half way to a map that was measured twice, and
/// as much beyond 1.
const REMOVALS: [f64; 2] = [0.5, 1.5];

/// Smallest fraction of the mean square of a map that must remain when its noise is subtracted. Larger: fewer scales
/// are known. Smaller: the correction for noise is a guess. Chosen.
const LEAST_SIGNAL: f64 = 0.2;

/// Cosine of the angle between both maps above which the given reading is right. Larger: right maps with an even
/// residual are taken for turned ones. Smaller: mistakes pass. Derived: above it the maps have more than half of their
/// mean square in common as they are.
const AS_IT_IS: f64 = 0.71;

/// Displacement of the map after, in widths of the tool, from which it counts as another position. Larger: displaced
/// maps pass. Smaller: the flank of the correlation is taken for another position. Chosen: such a displacement changes
/// what a run teaches by a part of it.
const PLACE: f64 = 0.25;

/// Smallest number of pairs of valid pixels that overlap at a displacement, as a fraction of the valid pixels;
/// displacements with fewer are not tried. Larger: fewer displacements are tried. Smaller: a few pixels decide. Chosen.
const LEAST_PAIRS: f64 = 0.25;

/// Smallest number of pixels of exactly one height, and its smallest ratio to the next frequent height, with which that
/// height stands for missing data. Larger: small holes pass. Smaller: maps in coarse steps are refused. Chosen: a map
/// in steps has many heights about as often.
const LEAST_EQUAL: [usize; 2] = [4, 10];

/// Limits of the RMS of the rest of the fit (data minus fit), above all three of which the fit fails. They are ratios
/// to what the plan missed, to the measured removal, and to the noise from pixel to pixel. Larger: bad fits pass.
/// Smaller: good fits fail.
const OF_MISSED: f64 = 0.5;
const OF_REMOVAL: f64 = 0.25;
const OF_NOISE: f64 = 3.0;

/// Ratio of the fourth differences over two pixels to those over one above which they show the figure more than noise.
/// Larger: figures are taken for noise. Smaller: noise that is correlated over some pixels, with a ratio of 1.5, is no
/// noise. Chosen.
const FIGURE: f64 = 3.0;

/// Evidence on the map after, and the sentence against it, if there is one.
pub(crate) struct Judgement {
    /// Numbers of the evidence, for the report.
    pub evidence: Evidence,
    /// Sentence that says why no result of the fit is applied; `None` if the results are applied.
    pub against: Option<String>,
}

/// Remedy in messages if the maps do not decide between readings.
const REMEDY: &str = "Give maps with less noise or with a mark that no tool reaches, or `same_measurement` if both maps were \
                      measured and read in the same way";

/// Sums that measure what both maps have in common apart from what the fit explains; the symbols are those of the
/// module.
struct Common {
    /// Expected part p of the map after, shape (ny, nx), nm; 0 where invalid.
    expected: Array2<f64>,
    /// Same part a of the measured map after, shape (ny, nx), nm; 0 where invalid.
    after: Array2<f64>,
    /// Sum X of the products of both, nm^2.
    common: f64,
    /// Standard deviation sigma of X for maps that have nothing in common, nm^2.
    scatter: f64,
    /// Number of valid pixels.
    pixels: f64,
    /// Cosine of the angle between both maps, X / (|p| |a|).
    cosine: f64,
}

/// Another reading of the map after: its name in messages, and its sum X_k of products, nm^2.
struct Reading {
    name: String,
    common: f64,
}

/// Other readings of the map after: turned or mirrored, and displaced.
struct Readings {
    orientations: Vec<Reading>,
    places: Vec<Reading>,
}

/// Scale of the heights of the map after (1: as expected), as a lower and an upper bound.
struct Scale {
    bounds: [f64; 2],
    /// Standard error of each bound.
    error: f64,
}

/// Judges whether the map after belongs to the run, from what the fit leaves of it. `before` is the map before and
/// `planned` the removal of the plan, (ny, nx), nm. If `same_measurement` is true, missing evidence is no reason
/// against the map.
pub fn judge(
    before: &Array2<f64>,
    data: &Data<'_>,
    planned: &Array2<f64>,
    fit: &LeastSquaresFit,
    fitted: &Fitted,
    tool_width_mm: f64,
    same_measurement: bool,
) -> Judgement {
    let after = masked(&(before - &data.data), &data.valid);
    let before = masked(before, &data.valid);
    let terms: Vec<Array2<f64>> = fit.terms.iter().map(|t| t.map(data.grid)).collect();
    let fields = Normal::new(&fit.columns[..fit.parameters.len()], &terms, &data.valid, Vec::new())
        .orthonormal();
    let expected = without(&fields, &(&before - &fit.removal), &data.valid);
    let common = Common::new(expected, without(&fields, &after, &data.valid), &data.valid);
    let readings = Readings::new(&common, &fields, &after, data, tool_width_mm);
    let noise_nm = [&before, &after].map(|map| white_noise_nm(map, &data.valid));
    let removal = removal_factor(data, planned, &terms, fit);
    let scale = common.scale(noise_nm);
    let evidence = Evidence {
        removal_factor: removal.map(|(factor, _)| factor),
        removal_factor_standard_error: removal.map(|(_, error)| error),
        common_rms_nm: common.common.signum() * (common.common.abs() / common.pixels).sqrt(),
        common_standard_errors: common.standard_errors(),
        scale: scale.as_ref().map(|scale| scale.bounds),
        noise_ratio: match noise_nm {
            [Some(of_before), Some(of_after)] => Some(of_after / of_before),
            _ => None,
        },
    };
    let against = filled("before", &before, &data.valid)
        .or_else(|| filled("after", &after, &data.valid))
        .or_else(|| removal.and_then(against_removal))
        .or_else(|| readings.clear(&common))
        .or_else(|| scale.and_then(|scale| against_scale(&scale)))
        .or_else(|| too_large(fitted, &fit.rest, &data.valid))
        .or_else(|| {
            untold(&evidence).or_else(|| readings.untold(&common)).filter(|_| !same_measurement)
        });
    Judgement { evidence, against }
}

/// Returns the sentence that says which of part, sign and scale the maps do not show; `None` if they show all, and also
/// if the scale has no bounds.
fn untold(evidence: &Evidence) -> Option<String> {
    if evidence.common_standard_errors.powi(2) < 2.0 * ODDS {
        return Some(format!(
            "the maps do not tell that the map after is of this run: beside what the fit explains they have {} nm RMS in \
             common, {} standard errors, and 4 are needed. {REMEDY}",
            significant(evidence.common_rms_nm, 2),
            significant(evidence.common_standard_errors, 2)
        ));
    }
    let [low, high] = evidence.scale?;
    let is_known = SCALES[0] < low && high < SCALES[1];
    let same_noise = SAME_NOISE[0]..SAME_NOISE[1];
    if is_known || evidence.noise_ratio.is_some_and(|ratio| same_noise.contains(&ratio)) {
        return None;
    }
    let noise = match evidence.noise_ratio {
        Some(ratio) => {
            format!("its noise is {} times that of the map before", significant(ratio, 2))
        }
        None => "its noise is not told from its figure".into(),
    };
    Some(format!(
        "the maps do not tell the scale of the map after: it is between {} and {}, and {noise}. Check its unit. {REMEDY}",
        significant(low, 2),
        significant(high, 2)
    ))
}

/// Returns the sentence against a map in which one height stands for pixels without data; `None` if no height does.
fn filled(name: &str, map: &Array2<f64>, valid: &Array2<f64>) -> Option<String> {
    let pairs = map.iter().zip(valid).filter(|(_, valid)| **valid > 0.5);
    let mut heights: Vec<f64> = pairs.map(|(height, _)| *height).collect();
    heights.sort_unstable_by(f64::total_cmp);
    let mut count = 0;
    let mut height = 0.0;
    let mut next_count = 0;
    for equal in heights.chunk_by(|a, b| a == b) {
        if equal.len() > count {
            next_count = count;
            count = equal.len();
            height = equal[0];
        } else {
            next_count = next_count.max(equal.len());
        }
    }
    let [least, ratio] = LEAST_EQUAL;
    if count < least || count < ratio * next_count {
        return None;
    }
    Some(format!(
        "{count} pixels of the map {name} have exactly the height {height} nm, and no other height is so frequent: mark \
         pixels without data by NaN"
    ))
}

/// Returns the factor of the planned removal in before - after, and its standard error; `None` if the plan removes
/// nothing but terms of the metrology.
///
/// ```text
/// f = <d, M> / <M, M>,   error^2 = <M, C M> / <M, M>^2     M without the terms of the metrology, C of the noise
/// ```
fn removal_factor(
    data: &Data<'_>,
    planned: &Array2<f64>,
    terms: &[Array2<f64>],
    fit: &LeastSquaresFit,
) -> Option<(f64, f64)> {
    let fields = Normal::new(&[], terms, &data.valid, Vec::new()).orthonormal();
    let removal = without(&fields, planned, &data.valid);
    let squares = dot(&removal, &removal);
    let error = dot(&removal, &fit.noise.apply(&removal)).max(0.0).sqrt() / squares;
    if squares > 0.0 { Some((dot(&data.data, &removal) / squares, error)) } else { None }
}

/// Returns the sentence against maps whose difference has another factor of the planned removal than 1, or whose noise
/// hides the factor. Returns `None` if the factor can be 1 and is known to better than 1 with four standard errors.
fn against_removal((factor, error): (f64, f64)) -> Option<String> {
    let [low, high] = REMOVALS;
    let is_beyond = factor + ERRORS * error < low || factor - ERRORS * error > high;
    let is_hidden = ERRORS * error > 1.0;
    if !is_beyond && !is_hidden {
        return None;
    }
    let reason = if !is_beyond {
        "the noise hides whether a run lies between them"
    } else if (factor + 1.0).abs() < low {
        "the maps before and after are exchanged"
    } else if factor.abs() < low {
        "no run lies between them; check both maps"
    } else {
        "check the units of the maps and of the tool, and that all is of one run"
    };
    Some(format!(
        "the maps differ by {} +- {} times the planned removal, where 1 is expected: {reason}",
        significant(factor, 2),
        significant(error, 1)
    ))
}

/// Returns the sentence against a map after whose scale is not 1; `None` if it can be 1.
fn against_scale(scale: &Scale) -> Option<String> {
    let [low, high] = scale.bounds;
    let is_beyond =
        high + ERRORS * scale.error < SCALES[0] || low - ERRORS * scale.error > SCALES[1];
    if !is_beyond {
        return None;
    }
    Some(format!(
        "the map after has {} to {} times the heights that the plan leaves there, where 1 is expected: check its unit, and \
         that it is of this run",
        significant(low, 2),
        significant(high, 2)
    ))
}

/// Returns the sentence against a fit whose rest exceeds all three limits: half of what the plan missed, a quarter of
/// the measured removal, and three times the noise. Returns `None` for other fits.
fn too_large(fitted: &Fitted, rest: &Array2<f64>, valid: &Array2<f64>) -> Option<String> {
    let left_nm = fitted.rest_rms_nm;
    let missed_nm = fitted.measured_less_planned_rms_nm;
    let is_large = left_nm > OF_MISSED * missed_nm
        && left_nm > OF_REMOVAL * fitted.measured_removal_rms_nm
        && left_nm > OF_NOISE * noise_by_differences_nm(rest, valid, &SECOND, 1);
    if !is_large {
        return None;
    }
    Some(format!(
        "the fit explains nothing: {} of the {} nm RMS that the plan missed are left: check that both maps, the motion \
         and the tool are those of one run",
        significant(left_nm, 3),
        significant(missed_nm, 3)
    ))
}

impl Common {
    fn new(expected: Array2<f64>, after: Array2<f64>, valid: &Array2<f64>) -> Self {
        let [of_expected, of_after, pairs] =
            [(&expected, &expected), (&after, &after), (valid, valid)]
                .map(|(one, other)| products(one, other));
        let (ny, nx) = valid.dim();
        // sum N C_p C_a over lags of up to half of the map, where each C is a sum of products over N
        let mut variance = 0.0;
        for ((r, c), n) in pairs.indexed_iter() {
            let [r_lag, c_lag] = [lag(r, pairs.nrows()), lag(c, pairs.ncols())];
            let is_near = 2 * r_lag.unsigned_abs() <= ny && 2 * c_lag.unsigned_abs() <= nx;
            if *n > 0.5 && is_near {
                variance += of_expected[[r, c]] * of_after[[r, c]] / n;
            }
        }
        let squares = dot(&expected, &expected) * dot(&after, &after);
        let common = dot(&expected, &after);
        let least = squares / valid.sum().max(1.0);
        Self {
            cosine: if squares > 0.0 { common / squares.sqrt() } else { 0.0 },
            common,
            // The sum scatters itself, and white noise alone has the least.
            scatter: variance.max(least).sqrt(),
            pixels: valid.sum().max(1.0),
            expected,
            after,
        }
    }

    /// Returns the common sum X of the module in units of its standard deviation sigma; 0 if that is 0.
    fn standard_errors(&self) -> f64 {
        if self.scatter > 0.0 { self.common / self.scatter } else { 0.0 }
    }

    /// Returns the fraction of the mean square that the maps do not have in common; only this part scatters.
    fn apart(&self) -> f64 {
        (1.0 - self.cosine.powi(2)).max(f64::EPSILON)
    }

    /// Returns the bounds of the scale of the map after; `None` if X is not positive or below four of its standard
    /// deviations. `noise_nm` is the noise of the maps before and after, where it is known.
    fn scale(&self, noise_nm: [Option<f64>; 2]) -> Option<Scale> {
        if self.standard_errors().powi(2) < 2.0 * ODDS || self.common <= 0.0 {
            return None;
        }
        let [expected, after] = [(&self.expected, noise_nm[0]), (&self.after, noise_nm[1])];
        let ends = [self.common / self.signal(expected), self.signal(after) / self.common];
        let bounds = [ends[0].min(ends[1]), ends[0].max(ends[1])];
        let error = bounds[1] / self.standard_errors() * self.apart().sqrt();
        Some(Scale { bounds, error })
    }

    /// Returns the sum of squares of a map with its noise subtracted, if at least [`LEAST_SIGNAL`] of it remains;
    /// otherwise the whole sum.
    fn signal(&self, (map, noise_nm): (&Array2<f64>, Option<f64>)) -> f64 {
        let squares = dot(map, map);
        let left = squares - noise_nm.unwrap_or(0.0).powi(2) * self.pixels;
        if left >= LEAST_SIGNAL * squares { left } else { squares }
    }

    /// Returns the readings of the map after that are displaced by more than [`PLACE`] of the tool's width, each with
    /// its sum X(h).
    fn other_places(&self, data: &Data<'_>, tool_width_mm: f64) -> Vec<Reading> {
        let all = products(&self.expected, &self.after);
        let pairs = products(&data.valid, &data.valid);
        let mut places = Vec::new();
        for ((r, c), n) in pairs.indexed_iter() {
            let [r_lag, c_lag] = [lag(r, pairs.nrows()), lag(c, pairs.ncols())];
            let [x_mm, y_mm] =
                [c_lag as f64 * data.grid.x.step_mm(), r_lag as f64 * data.grid.y.step_mm()];
            if *n >= LEAST_PAIRS * self.pixels && x_mm.hypot(y_mm) > PLACE * tool_width_mm {
                let name = format!(
                    "displaced by {}, {} mm",
                    significant(0.0 - x_mm, 3),
                    significant(0.0 - y_mm, 3)
                );
                // Fewer pairs have a smaller X and a smaller scatter.
                places.push(Reading { name, common: all[[r, c]] * (self.pixels / n).sqrt() });
            }
        }
        places
    }
}

impl Readings {
    fn new(
        common: &Common,
        fields: &[Array2<f64>],
        after: &Array2<f64>,
        data: &Data<'_>,
        tool_width_mm: f64,
    ) -> Self {
        let mut orientations = Vec::new();
        for (name, map) in turned(after) {
            let map = without(fields, &map, &data.valid);
            // Turned, the map has a part that the fit explained as it was: its scatter is larger.
            let size = dot(&map, &map).max(f64::MIN_POSITIVE) / dot(&common.after, &common.after);
            let size = if size.is_finite() { size.max(1.0).sqrt() } else { 1.0 };
            let common = dot(&common.expected, &map) / size;
            orientations.push(Reading { name: name.into(), common });
        }
        Self { orientations, places: common.other_places(data, tool_width_mm) }
    }

    /// Returns the sentence that names the reading that is clearly right instead of the given one: the sign turned,
    /// another orientation or a displacement. Returns `None` if there is none, or if the maps agree well as they are
    /// ([`AS_IT_IS`]).
    fn clear(&self, as_it_is: &Common) -> Option<String> {
        let subject = "the part of the maps that the fit cannot explain";
        if as_it_is.standard_errors() < -(2.0 * ODDS).sqrt() {
            return Some(format!(
                "{subject} has opposite signs ({} standard errors): read the map after with its sign turned",
                significant(as_it_is.standard_errors(), 3)
            ));
        }
        if as_it_is.cosine > AS_IT_IS {
            return None;
        }
        let many = self.places.len();
        let orientations = self.orientations.iter().filter(|reading| reading.is_clear(as_it_is, 1));
        let places = self.places.iter().filter(|reading| reading.is_clear(as_it_is, many));
        let best = orientations.chain(places).max_by(|a, b| a.common.total_cmp(&b.common))?;
        Some(format!(
            "{subject} is alike by {} standard errors if the map after is read {}, and by {} as it is: check the map after",
            significant(best.common / as_it_is.scatter, 3),
            best.name,
            significant(as_it_is.standard_errors(), 3)
        ))
    }

    /// Returns the sentence that names a reading about as probable as the given one; `None` if there is none.
    fn untold(&self, as_it_is: &Common) -> Option<String> {
        let errors = as_it_is.standard_errors();
        let odds = |reading: &Reading| {
            errors * (errors - reading.common / as_it_is.scatter) / as_it_is.apart()
        };
        let orientation = self.orientations.iter().find(|reading| odds(reading) < ODDS);
        // Before the data every place is as probable as any other one.
        let places: f64 = self.places.iter().map(|reading| (-odds(reading)).exp()).sum();
        let is_elsewhere = places > (-ODDS).exp() * self.places.len() as f64;
        let best = self.places.iter().max_by(|a, b| a.common.total_cmp(&b.common));
        let name = &orientation.or(best.filter(|_| is_elsewhere))?.name;
        Some(format!("the maps do not tell whether the map after is as it is or {name}. {REMEDY}"))
    }
}

impl Reading {
    /// Returns true if this reading, the best of `many`, is more probable by [`ODDS`] than another part and than the
    /// given reading. The best of many readings may be good by chance, so the logarithm of their number counts against
    /// it.
    fn is_clear(&self, as_it_is: &Common, many: usize) -> bool {
        let errors = self.common / as_it_is.scatter;
        let odds = ODDS + (many as f64).ln();
        errors > (2.0 * odds).sqrt() && errors * (errors - as_it_is.standard_errors()) > odds
    }
}

/// Returns a map turned by 180 degrees and mirrored, each with its name for messages. A square array is also turned by
/// 90 degrees and transposed.
fn turned(map: &Array2<f64>) -> Vec<(&'static str, Array2<f64>)> {
    let mirrored = |y: i32, x: i32| map.slice(s![..;y, ..;x]).to_owned();
    let mut all = vec![
        ("turned by 180 degrees", mirrored(-1, -1)),
        ("mirrored along x", mirrored(1, -1)),
        ("mirrored along y", mirrored(-1, 1)),
    ];
    if map.nrows() == map.ncols() {
        all.extend([
            ("with x and y exchanged", mirrored(1, 1).reversed_axes()),
            ("turned by 90 degrees", mirrored(1, -1).reversed_axes()),
            ("turned by -90 degrees", mirrored(-1, 1).reversed_axes()),
            ("turned by 90 degrees and mirrored", mirrored(-1, -1).reversed_axes()),
        ]);
    }
    all
}

/// Returns, for every lag, the sum of the products of `one` with `other` displaced by it. The array is padded with
/// zeros; negative lags stand at its end ([`lag`]).
fn products(one: &Array2<f64>, other: &Array2<f64>) -> Array2<f64> {
    let (ny, nx) = one.dim();
    let size = (smooth_size(2 * ny), smooth_size(2 * nx));
    let mut product = transform::forward(padded(one, size).view()).mapv(|v| v.conj());
    product *= &transform::forward(padded(other, size).view());
    transform::inverse(product)
}

/// Returns the lag, positive or negative, of index `k` of a padded axis of length `n`.
fn lag(k: usize, n: usize) -> isize {
    if 2 * k < n { k as isize } else { k as isize - n as isize }
}

/// Returns the map with 0 at its invalid pixels.
fn masked(map: &Array2<f64>, valid: &Array2<f64>) -> Array2<f64> {
    let mut map = map.clone();
    map.zip_mut_with(valid, |v, valid| *v = if *valid > 0.5 { *v } else { 0.0 });
    map
}

/// Returns the map without its components along the orthonormal `fields`; 0 where it is invalid.
fn without(fields: &[Array2<f64>], map: &Array2<f64>, valid: &Array2<f64>) -> Array2<f64> {
    let mut left = masked(map, valid);
    for field in fields {
        let along = dot(field, &left);
        left.scaled_add(-along, field);
    }
    left
}

/// Returns the standard deviation of the white noise of a map, nm, from its fourth differences along x. Returns `None`
/// if these show its figure more than its noise. Over twice the distance those of a figure are sixteen times as large,
/// those of noise hardly larger.
fn white_noise_nm(map: &Array2<f64>, valid: &Array2<f64>) -> Option<f64> {
    let fourth = [1.0, -4.0, 6.0, -4.0, 1.0];
    let [near, far] = [1, 2].map(|lag| noise_by_differences_nm(map, valid, &fourth, lag));
    if near > 0.0 && far < FIGURE * near { Some(near) } else { None }
}

/// Weights of a second difference of three neighbouring pixels.
const SECOND: [f64; 3] = [1.0, -2.0, 1.0];

/// Returns the standard deviation, nm, of white noise whose differences along x have the RMS of those of `map`. A
/// difference is a sum with these weights over valid pixels that are `lag` apart; 0 if there is none.
fn noise_by_differences_nm(
    map: &Array2<f64>,
    valid: &Array2<f64>,
    weights: &[f64],
    lag: usize,
) -> f64 {
    let mut sum = 0.0;
    let mut count = 0.0_f64;
    let variance: f64 = weights.iter().map(|w| w * w).sum();
    for (row, valid) in map.outer_iter().zip(valid.outer_iter()) {
        for c in 0..row.len().saturating_sub(lag * (weights.len() - 1)) {
            if (0..weights.len()).all(|k| valid[c + k * lag] > 0.5) {
                let difference =
                    (0..weights.len()).map(|k| weights[k] * row[c + k * lag]).sum::<f64>();
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
    use planish_types::{Axis, Grid};
    use rand::RngExt;

    const SIZE: usize = 64;

    /// Returns white noise of about this RMS, nm, shape (SIZE, SIZE).
    fn noise(stream: u64, rms_nm: f64) -> Array2<f64> {
        let mut random = case_generator(77, stream, 0);
        // The sum of twelve uniform numbers has the variance 1.
        let mut normal = || (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
        Array2::from_shape_fn((SIZE, SIZE), |_| rms_nm * normal())
    }

    /// Returns noise that is correlated over some pixels, of 0.7 nm RMS, as a residual that a tool cannot reach.
    fn residual() -> Array2<f64> {
        let fine = noise(9, 1.0);
        let at = |r: usize, c: usize| fine[[r % SIZE, c % SIZE]];
        Array2::from_shape_fn((SIZE, SIZE), |(r, c)| {
            0.35 * (at(r, c) + at(r + 1, c) + at(r, c + 1) + at(r + 1, c + 1))
        })
    }

    fn of(after: &Array2<f64>, expected: &Array2<f64>) -> Common {
        Common::new(expected.clone(), after.clone(), &Array2::ones((SIZE, SIZE)))
    }

    fn other_reading(after: &Array2<f64>, expected: &Array2<f64>) -> Option<String> {
        let axis = Axis::new(0.0, 0.5, SIZE).unwrap();
        let grid = Grid { x: axis, y: axis };
        let data = Data {
            grid: &grid,
            data: Array2::zeros(grid.shape()),
            valid: Array2::ones(grid.shape()),
        };
        let common = of(after, expected);
        Readings::new(&common, &[], after, &data, 4.0).clear(&common)
    }

    /// Noise in both maps of another part is alike by one standard error.
    #[test]
    fn maps_without_a_common_part_scatter_by_the_scatter() {
        let (mut squares, maps) = (0.0, 200);
        for k in 0..maps {
            // Correlated noise: its variance is that of the four pixels that share a part.
            let smooth = |map: Array2<f64>| {
                Array2::from_shape_fn((SIZE, SIZE), |(r, c)| map[[r, c]] + map[[r, (c + 1) % SIZE]])
            };
            let [one, other] = [2 * k, 2 * k + 1].map(|stream| smooth(noise(stream, 0.5)));
            squares += of(&one, &other).standard_errors().powi(2) / maps as f64;
        }
        // The mean of 200 squares scatters by sqrt(2 / 200) = 10 %: three of it.
        assert!((squares - 1.0).abs() < 0.3, "{squares}");
    }

    /// The residual r stays on the part: p = r + noise before, a = f (r + noise after).
    #[test]
    fn the_scale_is_within_its_bounds() {
        let (r, noises) = (residual(), [noise(1, 0.3), noise(2, 0.4)]);
        for factor in [0.5, 1.0, 2.0] {
            let after = factor * (&r + &noises[1]);
            let common = of(&after, &(&r + &noises[0]));
            let plain = common.scale([None; 2]).unwrap();
            // 0.49 / (0.49 + 0.09) and (0.49 + 0.16) / 0.49, to three errors of the common part.
            for (bound, expected) in plain.bounds.into_iter().zip([0.845 * factor, 1.327 * factor])
            {
                assert!(
                    (bound - expected).abs() < 3.0 * plain.error,
                    "{factor}: {bound} {expected}"
                );
            }
            let corrected = common.scale([Some(0.3), Some(0.4 * factor)]).unwrap();
            for bound in corrected.bounds {
                assert!((bound - factor).abs() < 3.0 * corrected.error, "{factor}: {bound}");
            }
            assert_eq!(against_scale(&corrected).is_some(), factor != 1.0, "{factor}");
        }
    }

    #[test]
    fn other_readings_are_named() {
        let (r, n) = (residual(), noise(2, 0.5));
        let (expected, after) = (&r + &noise(1, 0.5), &r + &n);
        assert_eq!(other_reading(&after, &expected), None);
        let moved = Array2::from_shape_fn((SIZE, SIZE), |(y, x)| after[[y, (x + SIZE - 4) % SIZE]]);
        for (map, name) in [
            (-&after, "with its sign turned"),
            (after.slice(s![..;-1, ..;-1]).to_owned(), "turned by 180 degrees"),
            (after.slice(s![.., ..;-1]).to_owned(), "mirrored along x"),
            (after.slice(s![..;-1, ..]).to_owned(), "mirrored along y"),
            (after.t().to_owned(), "with x and y exchanged"),
            (moved, "displaced by -2, 0 mm"),
        ] {
            let said = other_reading(&map, &expected).unwrap_or_default();
            assert!(said.contains(name), "{name}: {said}");
        }
        // A map of another part is alike by chance.
        assert_eq!(other_reading(&noise(5, 0.8), &expected), None);
        assert!(of(&noise(5, 0.8), &expected).standard_errors().abs() < 4.0);
    }

    #[test]
    fn a_height_for_no_data_is_named_and_steps_are_not() {
        let ones = Array2::ones((SIZE, SIZE));
        let mut map = residual();
        assert_eq!(filled("after", &map, &ones), None);
        assert_eq!(filled("after", &map.mapv(|v| (5.0 * v).round() / 5.0), &ones), None);
        map.slice_mut(s![3..6, 7..11]).fill(0.0);
        assert!(
            filled("after", &map, &ones).unwrap().starts_with("12 pixels of the map after have")
        );
    }

    #[test]
    fn the_removal_between_the_maps_names_exchanged_maps_and_none() {
        for (factor, error, said) in [
            (-1.0, 0.01, "exchanged"),
            (0.0, 0.01, "no run lies between"),
            (2.0, 0.01, "units"),
            (0.5, 0.4, "hides"),
        ] {
            assert!(against_removal((factor, error)).unwrap().contains(said), "{factor}");
        }
        assert_eq!(against_removal((0.9, 0.1)), None);
    }
}
