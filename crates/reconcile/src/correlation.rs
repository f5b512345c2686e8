//! The correlation of the rest of a fit (data minus fit), and the variance that it gives to a sum over the map.
//!
//! ```text
//! C(h) = 1/N(h) sum_x r(x) r(x + h)          over the N(h) pairs of valid pixels that are h apart
//! Var(sum_x j(x) n(x)) = sum_x,y j(x) C(x - y) w(x - y) j(y)
//! ```
//!
//! w is 1 up to half of a radius L and falls to 0 at L as a cosine: far lags have noise and no signal. With the
//! correlation length l(L), the radius of the disk whose area is the integral of C(h)/C(0) out to L, L is the first
//! with `L >= 5 l(L)` (Madras and Sokal's automatic window, in two dimensions). A Gaussian correlation exp(-h^2 / 2 s^2)
//! has l = sqrt(2) s, and what lies beyond the flat part, 3.5 s, is 0.2 % of it.
//!
//! Where the model misses something, the rest is white noise and a weak field of long waves. Its part of C(0) is small,
//! its part of the integral is not. So L is only taken if the sum of C/C(0) out to any further lag is larger by no more
//! than noise makes it, `5 S (2 sum 1/N(h))^1/2` over the lags beyond, S the sum up to L. Otherwise the search goes on
//! from that lag. The window goes no further than half of the longer side, or to where the fit itself would decide: see
//! `LARGEST_LOST`.
//!
//! A fit leaves nothing of the noise along its own fields, which is where its variance is asked for. With orthonormal
//! fields u_k of the fit the rest of white noise of variance one has the covariance
//!
//! ```text
//! E C(h) = [h = 0] - 1/N(h) sum_k sum_x u_k(x) u_k(x + h)
//! ```
//!
//! The transform of that times w is the part of the spectrum that the fit has left, frequency by frequency; the estimated
//! spectrum is divided by it. This is exact for white noise, and for any other whose spectrum hardly changes over the
//! transform of w, which is what w is chosen for.
//!
//! The effective number of independent pixels is N / (sum of C w / C(0)).
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | r | `rest` | (ny, nx) | nm |
//! | C w | `spectrum`, its transform | (2 ny, 2 nx) about | nm^2 |
//! | L | `window_mm` | | mm |
//! | l | `length_mm` | | mm |

use std::f64::consts::PI;

use ndarray::{Array2, s};
use planish_numerics::fft::{smooth_size, transform};
use planish_types::{Grid, outcome::reconciliation::Noise};

/// Radius of the window over the correlation length, dimensionless. Larger: lags that have noise and no signal.
/// Smaller: a part of the correlation is cut off, and standard errors are too small. Chosen: a Gaussian correlation
/// has 0.2 % of its integral beyond the flat part of this window.
const WINDOW_OVER_LENGTH: f64 = 5.0;

/// Number of standard errors from which more correlation beyond a window is significant; the constant below is the
/// smallest fraction of the sum that it must add as well. Larger: a weak correlation over long lags is missed. Smaller:
/// lags that have noise and no signal. Chosen: among thousands of lags noise reaches four of its standard errors now
/// and then.
const CLEAR: f64 = 5.0;
const LEAST_MORE: f64 = 0.25;

/// Largest fraction of the spectrum near zero frequency that the fit may have removed; it bounds the window. Larger:
/// the spectrum is corrected by a factor that is uncertain. Smaller: windows that cut long correlations off. Chosen.
const LARGEST_LOST: f64 = 0.5;

/// The covariance of the noise of the data, as a spectrum that can be applied to maps.
pub struct Covariance {
    /// Numbers of the noise for the report: standard deviation, correlation length and effective pixels.
    pub noise: Noise,
    shape: (usize, usize),
    /// Transform of C w of the module, never negative, divided by the fraction that the fit has left of it; of the
    /// padded size.
    spectrum: Array2<f64>,
}

impl Covariance {
    /// Estimates the covariance of the noise from the `rest` (ny, nx), nm, of a fit of `terms` unknowns. The fit's
    /// orthonormal `fields` correct for the part that the fit removed; without them there is no correction. All maps
    /// are 0 where `valid` is 0; it is 1 elsewhere.
    pub fn new(
        rest: &Array2<f64>,
        valid: &Array2<f64>,
        grid: &Grid,
        terms: usize,
        fields: &[Array2<f64>],
    ) -> Self {
        let (ny, nx) = rest.dim();
        let size = (smooth_size(2 * ny), smooth_size(2 * nx));
        let [sum, count] = [rest, valid].map(|map| {
            let power = transform::forward(padded(map, size).view());
            transform::inverse(power.mapv(|v| (v.norm_sqr()).into()))
        });
        let pixels = count[[0, 0]].round().max(1.0);
        let variance = sum[[0, 0]] / pixels;
        // C(h) where at least one pair is
        let mut covariance = sum;
        covariance.zip_mut_with(&count, |c, n| *c = if *n > 0.5 { *c / n } else { 0.0 });
        let lag_mm = |(r, c): (usize, usize)| {
            let [rows, columns] = [r.min(size.0 - r) as f64, c.min(size.1 - c) as f64];
            (rows * grid.y.step_mm()).hypot(columns * grid.x.step_mm())
        };
        let area = grid.pixel_mm2();
        let sides = [grid.x, grid.y].map(|a| a.len() as f64 * a.step_mm());
        // p sum(w) / N <= LARGEST_LOST, where sum(w) is the area of a disk of some 3/4 L
        let most = LARGEST_LOST * pixels * area / (terms.max(1) as f64 * PI * 0.5625);
        let largest = most.sqrt().min(0.5 * sides[0].max(sides[1]));
        let (window_mm, window_is_cut) =
            window(&covariance, variance, area, largest, &count, &lag_mm);
        // What the fit took: sum_k u_k * u_k over the pairs
        let mut taken = Array2::<f64>::zeros(size);
        for field in fields {
            taken += &transform::forward(padded(field, size).view()).mapv(|v| v.norm_sqr());
        }
        let mut taken = transform::inverse(taken.mapv(|v| v.into()));
        taken.zip_mut_with(&count, |t, n| *t = if *n > 0.5 { *t / n } else { 0.0 });
        for (index, c) in covariance.indexed_iter_mut() {
            let w = taper(lag_mm(index) / window_mm);
            *c *= w;
            taken[index] *= w;
        }
        let taken = transform::forward(taken.view()).mapv(|v| v.re.clamp(0.0, LARGEST_LOST));
        let mut spectrum = transform::forward(covariance.view()).mapv(|v| v.re.max(0.0));
        spectrum.zip_mut_with(&taken, |s, t| *s /= 1.0 - t);
        let lost = taken[[0, 0]];
        let whole = spectrum[[0, 0]];
        let ratio = if variance > 0.0 { (whole / variance).max(1e-12) } else { 1.0 };
        let noise = Noise {
            rest_rms_nm: variance.sqrt(),
            correlation_length_mm: (ratio * area / PI).sqrt(),
            window_mm,
            window_is_cut,
            pixels: pixels as usize,
            // The sum of an estimated correlation scatters about that of white noise, too.
            effective_pixels: (pixels / ratio).min(pixels),
            lost_to_the_fit: lost,
        };
        Self { noise, shape: (ny, nx), spectrum }
    }

    /// Returns the covariance of the noise (C w of the module, corrected for what the fit removed) applied to a field
    /// (ny, nx), which is 0 where the map is invalid.
    pub fn apply(&self, field: &Array2<f64>) -> Array2<f64> {
        let mut transformed = transform::forward(padded(field, self.spectrum.dim()).view());
        transformed.zip_mut_with(&self.spectrum, |v, s| *v *= *s);
        let (ny, nx) = self.shape;
        transform::inverse(transformed).slice(s![..ny, ..nx]).to_owned()
    }
}

/// Returns the weight w of the module at the lag `part`, a fraction of the radius L.
fn taper(part: f64) -> f64 {
    if part <= 0.5 {
        1.0
    } else if part < 1.0 {
        0.5 * (1.0 + (PI * (2.0 * part - 1.0)).cos())
    } else {
        0.0
    }
}

/// Returns a map of the larger shape `size`, with zeros beyond the last row and column of `map`.
pub(crate) fn padded(map: &Array2<f64>, size: (usize, usize)) -> Array2<f64> {
    let (ny, nx) = map.dim();
    let mut large = Array2::zeros(size);
    large.slice_mut(s![..ny, ..nx]).assign(map);
    large
}

/// Returns the radius L of the window, mm: the first with `L >= 5 l(L)` beyond which the correlation adds nothing
/// significant. Returns `largest_mm` and true if there is none up to it. `lag_mm` is the distance of a lag, and `pairs`
/// its number of pairs.
fn window(
    covariance: &Array2<f64>,
    variance: f64,
    pixel_mm2: f64,
    largest_mm: f64,
    pairs: &Array2<f64>,
    lag_mm: &impl Fn((usize, usize)) -> f64,
) -> (f64, bool) {
    // Two pixels, so that there is a taper
    let least_mm = 2.0 * pixel_mm2.sqrt();
    let largest_mm = largest_mm.max(least_mm);
    let mut lags: Vec<(f64, f64, f64)> = covariance
        .indexed_iter()
        .map(|(index, c)| (lag_mm(index), *c, pairs[index]))
        .filter(|(lag, _, pairs)| *lag <= largest_mm && *pairs > 0.5)
        .collect();
    lags.sort_by(|a, b| a.0.total_cmp(&b.0));
    if variance <= 0.0 {
        return (least_mm, false);
    }
    // Sums of C / C(0) and of 1 / N(h) up to every lag
    let mut sums = Vec::new();
    let mut scatters = Vec::new();
    let mut sum = 0.0;
    let mut scatter = 0.0;
    for (_, c, pairs) in &lags {
        sum += c / variance;
        scatter += 1.0 / pairs;
        sums.push(sum);
        scatters.push(scatter);
    }
    let ends = |k: usize| {
        let length = (sums[k].max(0.0) * pixel_mm2 / PI).sqrt();
        lags[k].0 >= least_mm && lags[k].0 >= WINDOW_OVER_LENGTH * length
    };
    let mut from = 0;
    while let Some(end) = (from..lags.len()).find(|k| ends(*k)) {
        let known: f64 = f64::max(sums[end], 1.0);
        let clear = (end..lags.len()).find(|k| {
            let by_noise = known * (2.0 * (scatters[*k] - scatters[end])).sqrt();
            sums[*k] - sums[end] > (CLEAR * by_noise).max(LEAST_MORE * known)
        });
        match clear {
            None => return (lags[end].0, false),
            Some(k) => from = k,
        }
    }
    (largest_mm, true)
}

#[cfg(test)]
mod tests {
    use planish_types::Axis;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn grid() -> Grid {
        Grid { x: Axis::new(0.0, 0.5, 120).unwrap(), y: Axis::new(0.0, 0.25, 90).unwrap() }
    }

    /// Returns means of uniform numbers over `side` x `side` pixels, scaled to the variance one.
    fn noise(seed: u64, side: usize) -> Array2<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (ny, nx) = grid().shape();
        let fine = Array2::from_shape_simple_fn((ny + side, nx + side), || {
            rng.random_range(-1.0..1.0) * 3.0_f64.sqrt()
        });
        let mean = |(r, c)| fine.slice(s![r..r + side, c..c + side]).sum() / side as f64;
        Array2::from_shape_fn((ny, nx), mean)
    }

    #[test]
    fn of_white_noise_every_pixel_counts_and_of_means_over_blocks_as_few_as_the_blocks() {
        let valid = Array2::ones(grid().shape());
        for side in [1, 4] {
            let each: Vec<f64> = (0..40)
                .map(|seed| {
                    let found = Covariance::new(&noise(seed, side), &valid, &grid(), 0, &[]).noise;
                    assert!(!found.window_is_cut);
                    found.effective_pixels
                })
                .collect();
            // A sum of side x side white numbers correlates over twice the triangle: its integral is side^2 pixels.
            let mean = 40.0 / each.iter().map(|n| 1.0 / n).sum::<f64>();
            let expected = 120.0 * 90.0 / (side * side) as f64;
            // The window cuts a part of the triangles' corners, and 40 maps scatter by 3 %.
            assert!((mean / expected - 1.0).abs() < 0.12, "{side}: {mean} {expected}");
        }
    }

    /// An error of the model is a weak field of long waves under white noise. It has a twelfth of the variance, and nearly
    /// all of that of a mean.
    #[test]
    fn a_weak_field_of_long_waves_under_white_noise_counts() {
        let valid = Array2::ones(grid().shape());
        let ratio = |seed| {
            let rest = noise(seed, 1) + 0.3 * noise(2000 + seed, 12);
            let noise = Covariance::new(&rest, &valid, &grid(), 0, &[]).noise;
            noise.pixels as f64 / noise.effective_pixels
        };
        let mean = (0..40).map(ratio).sum::<f64>() / 40.0;
        // (1 + 0.09 144) / 1.09 = 12.8 by the whole field. The window falls to 0 within it and keeps half, 7.3 measured. A
        // window by the white noise alone keeps 1.
        assert!((5.0..13.0).contains(&mean), "{mean}");
    }

    /// The variance of the product with a field, against that over many maps.
    #[test]
    fn the_variance_of_a_sum_is_that_of_many_maps() {
        let grid = grid();
        let field = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            (0.1 * c as f64).sin() + 0.02 * r as f64 - 0.9
        });
        let valid = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            if (r as f64 - 45.0).hypot(c as f64 - 20.0) < 12.0 { 0.0 } else { 1.0 }
        });
        let masked = &field * &valid;
        let (mut found, mut squares) = (0.0, 0.0);
        let maps = 300;
        for seed in 0..maps {
            let rest = noise(1000 + seed, 3) * &valid;
            let covariance = Covariance::new(&rest, &valid, &grid, 0, &[]);
            found += (covariance.apply(&masked) * &masked).sum() / maps as f64;
            squares += (&rest * &masked).sum().powi(2) / maps as f64;
        }
        // The mean of 300 squares of normal numbers scatters by sqrt(2 / 300) = 8 %: three of it.
        assert!((found / squares - 1.0).abs() < 0.25, "{found} {squares}");
    }
}
