//! Finds pits and dust: features that are too narrow for the tool and too deep for noise.
//!
//! A feature narrower than about half the tool's full width at half maximum W cannot be corrected. Left in
//! the map, it sets the smallest height, and the solver tries to correct it. With the least-squares plane
//! subtracted first (a tilt must not decide what is a pit):
//!
//! ```text
//! z   <- z - figure(z),         order 10, robust, in the whole map or in windows
//! d    = z - median filter(z),  window W/2 (odd, at least 9 px)
//! L    = z convolved with [1 -2 1; -2 4 -2; 1 -2 1]: 0 for every quadratic, 6 times the deviation of white noise
//! s    = 1.4826 max(median|d - median(d)|, median|L - median(L)| / 6)
//! seed: |d| > max(15 s, floor)        grow: |d| > max(6 s, 0.3 floor), 8-connected
//! keep: components with a seed whose bounding box is at most W/2 along x and along y, and whose heights stand out by
//!       as much (largest: seed, median: grow) from a quadratic fitted to the pixels around them, no grown ones
//! mask: the kept components, dilated by a square of half-width 3 px
//! ```
//!
//! On a slope that is steeper than the noise, the median of a window is the height along its middle. A pit
//! moves this median along the slope, as far as windows reach the pit, so that its component becomes too
//! long to be kept. Hence the figure is subtracted first. The remainder can still be steep: every pixel is
//! then the median of its own window, and d is zero, which says nothing of the noise. L still measures the
//! noise.
//!
//! A figure of several waves over the map is followed in windows of half the map, a quarter, and so on, as
//! long as that lowers s. The first such window must halve s, later ones must lower it by 5 %. The
//! remainder of a figure falls by orders of magnitude. The roughness of a polished map falls a little in
//! any smaller window, and pits would be found at lower thresholds. No window is smaller than five windows
//! of the median, 2.5 W: a smaller one follows pits of half the window of the median, and this one still
//! follows waves of W. Third differences hardly respond to waves. If they give at least half of s, windows
//! cannot halve it and are not tried.
//!
//! The seed threshold finds what is surely not noise, and the growth adds its flanks. The limit on the
//! extent spares edges, rims and steps, which are long. The crest of a wave that the figure does not follow
//! can be short: it is spared because a quadratic through its neighbours follows it.
//!
//! Source: thresholds with hysteresis, J. Canny, IEEE Trans. Pattern Anal. Mach. Intell. 8 (1986)
//! 679; MAD as the estimate of the noise, F. R. Hampel, J. Am. Stat. Assoc. 69 (1974) 383 (1.4826
//! makes it the standard deviation of normal noise); L, J. Immerkaer, Comput. Vis. Image Underst. 64 (1996) 300. The
//! multiples were chosen on a measured
//! mirror.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `surface` | (ny, nx) | nm |
//! | W | `feature_mm` | - | mm |
//! | d | `deviation` | (ny, nx) | nm |
//! | L | `noise_of_differences` | (ny - 2, nx - 2) | nm |
//! | s | `noise_nm` | - | nm |

use std::ops::Range;

use nalgebra::{Matrix6, Vector6};
use ndarray::{Array2, Axis as NdAxis, Slice};
use planish_numerics::statistics::{fit_plane, subtract_plane};
use planish_types::{Axis, Invalid, Surface};
use serde::Serialize;

use crate::{PrepareError, figure::figure, median::median_filter};

/// Least threshold of the growth, as a fraction of `floor_nm`. Larger: the flanks of pits stay unmasked. Smaller:
/// components grow into the noise, and become too long to be kept.
const GROW_FLOOR: f64 = 0.3;

/// Smallest window of the median filter, px along each axis. Larger: the median is less local on coarse maps. Smaller:
/// a pit becomes its own median. Derived: a window of 9 x 9 still has a majority of other pixels around a pit of 6 x 6.
const MIN_WINDOW_PX: usize = 9;

/// Ratio of the standard deviation to the median absolute deviation of normal noise: 1 / (the 0.75 quantile
/// of the standard normal distribution).
const SIGMA_PER_MAD: f64 = 1.4826;

/// Smallest window of the figure, in multiples of the window of the median. Larger: leaves short waves of the figure.
/// Smaller: the figure follows pits.
const LEAST_FIGURE: usize = 5;

/// Largest ratio of the noise in windows to the noise in the whole map at which windows are used. Larger:
/// windows are used on maps whose roughness only falls a little, and the thresholds fall. Smaller: waves of
/// the figure stay.
const FALLS: f64 = 0.5;

/// Largest ratio of the noise in smaller windows to the noise in the current windows at which the smaller
/// ones are used. Larger: windows shrink for a fall that is roughness. Smaller: waves of the figure stay.
const FALLS_ON: f64 = 0.95;

/// Smallest number of pixels around a component (connected pixels above the threshold of the growth) for the quadratic
/// through them. With fewer, the component counts as an outlier. Larger: crests of waves near holes are masked.
/// Smaller: an uncertain quadratic decides. Derived: ten for each of the six terms.
const MIN_NEIGHBOURS: usize = 60;

/// Largest fraction of valid pixels that may be masked; more are refused, because then the parameters are
/// wrong and not the mirror. Larger: masks good pixels. Smaller: refuses maps with much dust.
const MAX_MASKED_FRACTION: f64 = 0.02;

/// Settings that define which features are outliers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OutlierSettings {
    /// Full width at half maximum of the tool's influence, mm; > 0. See
    /// [`Tif::half_maximum_width_mm`](planish_types::Tif::half_maximum_width_mm).
    pub feature_mm: f64,
    /// Multiple of the noise (1.4826 MAD) above which a deviation is a seed; > 0. The noise of a polished
    /// map is not normal: 6 to 10 still flag its borders, 15 does not.
    pub seed_sigmas: f64,
    /// Multiple of the noise above which a neighbour of a seed joins it; > 0, at most `seed_sigmas`.
    pub grow_sigmas: f64,
    /// Smallest deviation of a seed, nm; >= 0. About 5 times the noise of the measurement is usual.
    pub floor_nm: f64,
    /// Width of the margin that is masked around a component, px: the blurred rim of the pit.
    pub dilate_px: usize,
}

impl OutlierSettings {
    /// Returns the default settings for a tool of this full width at half maximum, mm.
    pub fn for_feature_mm(feature_mm: f64) -> Self {
        Self { feature_mm, seed_sigmas: 15.0, grow_sigmas: 6.0, floor_nm: 1.0, dilate_px: 3 }
    }

    fn check(&self) -> Result<(), Invalid> {
        let Self { feature_mm, seed_sigmas, grow_sigmas, floor_nm, .. } = *self;
        let at_most_seed = format!("give a positive multiple, at most the seed's {seed_sigmas}");
        let in_range = grow_sigmas > 0.0 && grow_sigmas <= seed_sigmas;
        for (name, value, is_right, remedy) in [
            ("feature_mm", feature_mm, feature_mm > 0.0, "give a positive width in mm"),
            (
                "seed_sigmas",
                seed_sigmas,
                seed_sigmas > 0.0,
                "give a positive multiple of the noise",
            ),
            ("grow_sigmas", grow_sigmas, in_range, &at_most_seed),
            ("floor_nm", floor_nm, floor_nm >= 0.0, "give a height of at least 0 nm"),
        ] {
            if !(value.is_finite() && is_right) {
                return Err(Invalid::whole(name, format!("is {value}"), remedy));
            }
        }
        Ok(())
    }
}

/// Result of the search for outliers.
#[derive(Clone, Debug, PartialEq)]
pub struct Outliers {
    /// True at the pixels to mask (ny, nx); only valid pixels.
    pub mask: Array2<bool>,
    /// Numbers of the search for the manifest.
    pub report: OutlierReport,
}

/// Numbers of the outliers and of the thresholds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OutlierReport {
    /// Number of components (connected outliers) that are masked, before the dilation.
    pub components: usize,
    /// Number of pixels in the components, before the dilation.
    pub core_pixels: usize,
    /// Number of valid pixels that are masked, after the dilation.
    pub masked_pixels: usize,
    /// Number of masked pixels over that of valid pixels.
    pub masked_fraction: f64,
    /// Robust standard deviation of the noise of the map, nm (s of the module).
    pub noise_nm: f64,
    /// Deviation above which a pixel is a seed, nm.
    pub seed_nm: f64,
    /// Deviation above which a pixel joins a seed next to it, nm.
    pub grow_nm: f64,
    /// Window of the median filter (rows, columns), px.
    pub window_px: (usize, usize),
}

impl OutlierReport {
    /// Sets the number of masked pixels and its ratio to the `valid` valid ones; refuses a mask of more than 2 % of
    /// them.
    fn masked(&mut self, mask: &Array2<bool>, valid: usize) -> Result<(), PrepareError> {
        self.masked_pixels = mask.iter().filter(|m| **m).count();
        self.masked_fraction = self.masked_pixels as f64 / valid as f64;
        if self.masked_fraction > MAX_MASKED_FRACTION {
            return Err(PrepareError::TooManyMasked {
                masked: self.masked_pixels,
                valid,
                percent: 100.0 * self.masked_fraction,
                limit: 100.0 * MAX_MASKED_FRACTION,
            });
        }
        Ok(())
    }
}

/// Finds the outliers of `surface`. Refuses settings out of their range, and to mask more than 2 % of the valid pixels.
pub fn outliers(surface: &Surface, settings: &OutlierSettings) -> Result<Outliers, PrepareError> {
    settings.check()?;
    let grid = surface.grid();
    let extent_mm = 0.5 * settings.feature_mm;
    let window_px = (window(&grid.y, extent_mm), window(&grid.x, extent_mm));

    let half = (window_px.0 / 2, window_px.1 / 2);
    let level = without_plane(surface);
    let (deviation, noise_nm) = least_noisy_deviation(&level, window_px);
    let seed_nm = (settings.seed_sigmas * noise_nm).max(settings.floor_nm);
    let grow_nm = (settings.grow_sigmas * noise_nm).max(GROW_FLOOR * settings.floor_nm);

    let mut mask = Array2::from_elem(grid.shape(), false);
    let mut report = OutlierReport {
        components: 0,
        core_pixels: 0,
        masked_pixels: 0,
        masked_fraction: 0.0,
        noise_nm,
        seed_nm,
        grow_nm,
        window_px,
    };
    for component in components(&deviation, grow_nm) {
        let has_seed = component.iter().any(|pixel| deviation[*pixel].abs() > seed_nm);
        let [rows, columns] = bounding_box(&component);
        // A pixel that rounding puts beyond W/2 by 1e-9 of a step is within it.
        let is_narrow = [(rows, &grid.y), (columns, &grid.x)].iter().all(|(range, axis)| {
            range.len() as f64 * axis.step_mm() <= extent_mm + 1e-9 * axis.step_mm()
        });
        if has_seed
            && is_narrow
            && stands_out(&level, &deviation, &component, half, (seed_nm, grow_nm))
        {
            report.components += 1;
            report.core_pixels += component.len();
            component.iter().for_each(|pixel| dilate(&mut mask, *pixel, settings.dilate_px));
        }
    }
    mask.zip_mut_with(surface.height_nm(), |m, z| *m &= !z.is_nan());

    report.masked(&mask, surface.statistics().valid_count)?;
    Ok(Outliers { mask, report })
}

/// Returns the size of a window along an axis, px: the odd number nearest to `extent_mm`, at least 9 and at most the
/// length of the map (or 9 on a shorter one).
fn window(axis: &Axis, extent_mm: f64) -> usize {
    let largest = axis.len().max(MIN_WINDOW_PX);
    let half = (0.5 * (extent_mm / axis.step_mm() - 1.0)).round().clamp(0.0, largest as f64);
    let half = (half as usize).clamp(MIN_WINDOW_PX / 2, (largest - 1) / 2);
    2 * half + 1
}

/// Returns the deviation d of the module and its noise s, nm. The figure is fitted to the whole map, or to smaller
/// windows where these lower the noise enough.
fn least_noisy_deviation(level: &Array2<f64>, window_px: (usize, usize)) -> (Array2<f64>, f64) {
    let mut window = level.dim();
    let (mut deviation, mut noise_nm) = deviation_and_noise(level, window, window_px);
    // Third differences respond to white noise only, unless waves are very short. No window has less noise
    // than they give.
    let noise_of_whole = noise_nm;
    if noise_of_differences(level, 3) >= FALLS * noise_of_whole {
        return (deviation, noise_nm);
    }
    loop {
        let smaller = (halved(window.0, window_px.0), halved(window.1, window_px.1));
        if smaller == window {
            return (deviation, noise_nm);
        }
        window = smaller;
        let (next, next_noise_nm) = deviation_and_noise(level, window, window_px);
        let enough = if noise_nm < noise_of_whole { FALLS_ON } else { FALLS };
        if next_noise_nm < enough * noise_nm {
            deviation = next;
            noise_nm = next_noise_nm;
        }
    }
}

/// Returns half the size of a window of the figure, px, but at least [`LEAST_FIGURE`] windows of the median.
fn halved(figure_px: usize, median_px: usize) -> usize {
    (figure_px / 2).max(LEAST_FIGURE * median_px).min(figure_px)
}

/// Returns the deviation d of the module and its noise s, nm, with the figure fitted in windows of `window` (rows,
/// columns) pixels. `window_px` is the window of the median.
fn deviation_and_noise(
    level: &Array2<f64>,
    window: (usize, usize),
    window_px: (usize, usize),
) -> (Array2<f64>, f64) {
    // z <- z - figure(z)
    let flat = level - &figure(level.view(), window);
    // d = z - median filter(z)
    let deviation = &flat - &median_filter(flat.view(), (window_px.0 / 2, window_px.1 / 2));
    // s = 1.4826 max(MAD(d), MAD(L) / 6)
    let noise_nm = SIGMA_PER_MAD * median_absolute_deviation(&deviation);
    let noise_nm = noise_nm.max(noise_of_differences(&flat, 2));
    (deviation, noise_nm)
}

/// Returns true if the heights of a component deviate from the quadratic through the pixels around it: the largest by
/// more than the threshold of a seed, the median by more than that of the growth. These pixels lie up to half a window
/// of the median beyond its bounding box. With too few of them it returns true.
fn stands_out(
    level: &Array2<f64>,
    deviation: &Array2<f64>,
    component: &[(usize, usize)],
    half: (usize, usize),
    (seed_nm, grow_nm): (f64, f64),
) -> bool {
    let (ny, nx) = level.dim();
    let [rows, columns] = bounding_box(component);
    let rows = rows.start.saturating_sub(half.0)..(rows.end + half.0).min(ny);
    let columns = columns.start.saturating_sub(half.1)..(columns.end + half.1).min(nx);
    let terms = |&(r, c): &(usize, usize)| {
        let (u, v) = (unit_coordinate(c, &columns), unit_coordinate(r, &rows));
        Vector6::new(1.0, u, v, u * u, u * v, v * v)
    };
    let mut normal = Matrix6::zeros();
    let mut right = Vector6::zeros();
    let mut count = 0;
    for pixel in rows.clone().flat_map(|r| columns.clone().map(move |c| (r, c))) {
        // false for NaN
        if deviation[pixel].abs() <= grow_nm {
            let a = terms(&pixel);
            normal += a * a.transpose();
            right += a * level[pixel];
            count += 1;
        }
    }
    let Some(fit) = normal.cholesky().filter(|_| count >= MIN_NEIGHBOURS).map(|n| n.solve(&right))
    else {
        return true; // Too few neighbours to say.
    };
    let mut stands: Vec<f64> =
        component.iter().map(|pixel| (level[*pixel] - fit.dot(&terms(pixel))).abs()).collect();
    stands.iter().any(|d| *d > seed_nm) && middle(&mut stands) > grow_nm
}

/// Returns the coordinate of the centre of pixel `i`, which runs from -1 to 1 over the range of pixels.
fn unit_coordinate(i: usize, range: &Range<usize>) -> f64 {
    let reach = 0.5 * range.len() as f64;
    (i as f64 - range.start as f64 + 0.5) / reach - 1.0
}

fn without_plane(surface: &Surface) -> Array2<f64> {
    let (x, y) = (surface.grid().x.coordinates(), surface.grid().y.coordinates());
    let map = surface.height_nm().view();
    fit_plane(map, &x, &y).map_or_else(|| map.to_owned(), |p| subtract_plane(map, &x, &y, p))
}

/// Returns the noise, nm, from the n-th differences along both axes; n = 2 gives L of the module. The weights along an
/// axis are the signed binomial coefficients, whose squares have the sum binomial(2 n, n). The differences multiply
/// white noise by this number: 6 for n = 2, and 20 for n = 3.
fn noise_of_differences(map: &Array2<f64>, n: usize) -> f64 {
    let mut differences = map.clone();
    for axis in [NdAxis(0), NdAxis(1)] {
        for _ in 0..n {
            let len = differences.len_of(axis);
            if len < 2 {
                return 0.0;
            }
            let [lower, upper] =
                [0, 1].map(|k| differences.slice_axis(axis, Slice::from(k..len - 1 + k)));
            differences = &upper - &lower; // NaN beside an invalid pixel
        }
    }
    let gain = (1..=n).fold(1.0, |product, k| product * (n + k) as f64 / k as f64);
    SIGMA_PER_MAD * median_absolute_deviation(&differences) / gain
}

/// Returns the median absolute deviation from the median, nm; 0 without a valid pixel.
fn median_absolute_deviation(map: &Array2<f64>) -> f64 {
    let mut values: Vec<f64> = map.iter().copied().filter(|v| !v.is_nan()).collect();
    if values.is_empty() {
        return 0.0;
    }
    let centre = middle(&mut values);
    values.iter_mut().for_each(|v| *v = (*v - centre).abs());
    middle(&mut values)
}

/// Returns the median of `values`, the smaller middle value of an even number; `values` must not be empty.
fn middle(values: &mut [f64]) -> f64 {
    let k = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(k, f64::total_cmp).1
}

/// Returns the components of the pixels with |map| > threshold, each a list of (row, column). Pixels are connected by
/// edges or corners.
fn components(map: &Array2<f64>, threshold: f64) -> Vec<Vec<(usize, usize)>> {
    let (ny, nx) = map.dim();
    let mut open = map.mapv(|v| v.abs() > threshold); // false for NaN
    let mut components = Vec::new();
    for start in ndarray::indices((ny, nx)) {
        if !std::mem::take(&mut open[start]) {
            continue;
        }
        let mut component = vec![start];
        let mut next = 0;
        while next < component.len() {
            let (r, c) = component[next];
            next += 1;
            for i in r.saturating_sub(1)..=(r + 1).min(ny - 1) {
                for j in c.saturating_sub(1)..=(c + 1).min(nx - 1) {
                    if std::mem::take(&mut open[[i, j]]) {
                        component.push((i, j));
                    }
                }
            }
        }
        components.push(component);
    }
    components
}
/// Returns the rows and columns of the bounding box of `pixels`, which must not be empty.
fn bounding_box(pixels: &[(usize, usize)]) -> [Range<usize>; 2] {
    let [mut rows, mut columns] = [pixels[0].0, pixels[0].1].map(|k| k..k + 1);
    for (r, c) in pixels {
        rows = rows.start.min(*r)..rows.end.max(r + 1);
        columns = columns.start.min(*c)..columns.end.max(c + 1);
    }
    [rows, columns]
}

/// Sets the square of half-width `reach` pixels about a pixel of the mask to true.
fn dilate(mask: &mut Array2<bool>, (r, c): (usize, usize), reach: usize) {
    let (ny, nx) = mask.dim();
    for i in r.saturating_sub(reach)..=r.saturating_add(reach).min(ny - 1) {
        for j in c.saturating_sub(reach)..=c.saturating_add(reach).min(nx - 1) {
            mask[[i, j]] = true;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Grid;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    const SHAPE: (usize, usize) = (120, 200);

    fn grid() -> Grid {
        Grid { x: Axis::new(0.0, 0.1, SHAPE.1).unwrap(), y: Axis::new(0.0, 0.1, SHAPE.0).unwrap() }
    }

    /// Returns a smooth figure of 20 nm with noise of 0.05 nm RMS.
    fn smooth(seed: u64) -> Array2<f64> {
        let noise = Normal::new(0.0, 0.05).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Array2::from_shape_fn(SHAPE, |(r, c)| {
            let (x, y) = (0.1 * c as f64, 0.1 * r as f64);
            10.0 * (0.3 * x).sin() * (0.25 * y).cos() + noise.sample(&mut rng)
        })
    }

    fn find(map: &Array2<f64>) -> Outliers {
        let surface = Surface::new(grid(), map.clone()).unwrap();
        outliers(&surface, &OutlierSettings::for_feature_mm(4.0)).unwrap()
    }

    fn with_pit(mut map: Array2<f64>) -> Array2<f64> {
        map.slice_mut(ndarray::s![50..56, 80..86]).mapv_inplace(|v| v - 20.0);
        map
    }

    #[test]
    fn one_pit_is_exactly_that_component() {
        let found = find(&with_pit(smooth(1)));
        assert_eq!((found.report.components, found.report.core_pixels), (1, 36));
        // 6 + 2 * 3 pixels in each direction.
        let square =
            Array2::from_shape_fn(SHAPE, |(r, c)| (47..59).contains(&r) && (77..89).contains(&c));
        assert_eq!(found.mask, square);
    }

    /// Returns the figure of [`smooth`] times 1, 10 and 100, with noise: up to 0.3, 3 and 30 nm from pixel to pixel.
    fn steeper(seed: u64) -> impl Iterator<Item = (f64, Array2<f64>)> {
        [1.0, 10.0, 100.0].into_iter().map(move |k| {
            let figure = Array2::from_shape_fn(SHAPE, |(r, c)| {
                let (x, y) = (0.1 * c as f64, 0.1 * r as f64);
                (k - 1.0) * 10.0 * (0.3 * x).sin() * (0.25 * y).cos()
            });
            (k, smooth(seed) + figure)
        })
    }

    #[test]
    fn a_pit_on_a_slope_is_found_inside_and_at_the_border() {
        let places = [(50, 80), (0, 90), (70, 194), (0, 0), (114, 0), (0, 194), (114, 194)];
        for (k, map) in steeper(1) {
            let report = find(&map).report;
            assert_eq!(report.components, 0, "{k}: {report:?}");
            // What the figure leaves is taken for noise: at 100 times the figure a few pm.
            assert!((0.045..0.12).contains(&report.noise_nm), "{k}: {report:?}");
            for (r, c) in places {
                let mut map = map.clone();
                map.slice_mut(ndarray::s![r..r + 6, c..c + 6]).mapv_inplace(|v| v - 20.0);
                let found = find(&map);
                assert_eq!(found.report.components, 1, "{k} {r} {c}: {:?}", found.report);
                assert!(found.mask.slice(ndarray::s![r..r + 6, c..c + 6]).iter().all(|m| *m));
                // A border of one pixel at most.
                assert!(
                    (36..=100).contains(&found.report.core_pixels),
                    "{k} {r} {c} {:?}",
                    found.report
                );
            }
        }
    }

    #[test]
    fn waves_that_the_figure_does_not_follow_are_no_outliers() {
        // 2 and 3 times the frequency: without a look at the neighbours the crests at the border were 5 components.
        for (k, height) in [(2.0, 10.0), (2.0, 100.0), (3.0, 10.0), (3.0, 100.0)] {
            let wave = Array2::from_shape_fn(SHAPE, |(r, c)| {
                let (x, y) = (0.1 * c as f64, 0.1 * r as f64);
                height * (k * 0.3 * x + 0.4).sin() * (k * 0.25 * y).cos()
            });
            let report = find(&(smooth(1) + &wave)).report;
            assert_eq!(report.components, 0, "{k} {height}: {report:?}");
        }
    }

    #[test]
    fn pits_on_several_waves_are_found_and_their_crests_are_not() {
        // Waves of 100 nm and more, from twice the width of the tool on: 40 px of 0.1 mm. As one polynomial the figure of
        // 5 waves leaves noise of 20 nm and more.
        let grid = |ny: usize, nx: usize| Grid {
            x: Axis::new(0.0, 0.1, nx).unwrap(),
            y: Axis::new(0.0, 0.1, ny).unwrap(),
        };
        let (ny, nx) = (240, 400);
        for (waves, height, seed) in [(2.5, 300.0, 1), (5.0, 100.0, 2), (5.0, 300.0, 3)] {
            let noise = Normal::new(0.0, 0.05).unwrap();
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let k = 2.0 * std::f64::consts::PI * waves / nx as f64;
            let clean = Array2::from_shape_fn((ny, nx), |(r, c)| {
                let (x, y) = (c as f64, r as f64);
                height * (k * x + 0.4).sin() * (k * y).cos() + noise.sample(&mut rng)
            });
            let settings = OutlierSettings::for_feature_mm(4.0);
            let found = |map: &Array2<f64>| {
                outliers(&Surface::new(grid(ny, nx), map.clone()).unwrap(), &settings).unwrap()
            };
            let report = found(&clean).report;
            assert_eq!(report.components, 0, "{waves} {height}: {report:?}");
            // The noise but for what the figure leaves.
            assert!((0.045..0.06).contains(&report.noise_nm), "{waves} {height}: {report:?}");
            let mut pitted = clean;
            let places = [(60, 100), (180, 333), (0, 200), (100, 20)];
            for (r, c) in places {
                pitted.slice_mut(ndarray::s![r..r + 6, c..c + 6]).mapv_inplace(|v| v - 20.0);
            }
            let with_pits = found(&pitted);
            assert_eq!(with_pits.report.components, 4, "{waves} {height}: {:?}", with_pits.report);
            for (r, c) in places {
                assert!(with_pits.mask.slice(ndarray::s![r..r + 6, c..c + 6]).iter().all(|m| *m));
            }
        }
    }

    #[test]
    fn differences_know_the_noise_whatever_the_polynomial() {
        let noise = Normal::new(0.0, 0.2).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let map = Array2::from_shape_fn((200, 300), |(r, c)| {
            let (x, y) = (0.1 * c as f64, 0.1 * r as f64);
            3.0 * x * x - y * y * x + 7.0 * y + noise.sample(&mut rng)
        });
        for n in [2, 3] {
            // 60 000 pixels tell it to half a percent, and their differences depend on each other.
            let found = noise_of_differences(&map, n);
            assert!((found / 0.2 - 1.0).abs() < 0.03, "{n}: {found}");
        }
        assert_eq!(noise_of_differences(&Array2::zeros((2, 9)), 3), 0.0);
    }

    #[test]
    fn disks_and_annuli_on_a_slope_have_their_pits_only() {
        let (pits, radius) =
            ([(58, 120)], |r: usize, c: usize| (r as f64 - 59.5).hypot(c as f64 - 99.5));
        for (least, (k, map)) in
            [0.0, 20.0].into_iter().flat_map(|least| steeper(4).map(move |m| (least, m)))
        {
            let aperture = |map: &Array2<f64>| {
                Array2::from_shape_fn(SHAPE, |(r, c)| {
                    if (least..=58.0).contains(&radius(r, c)) { map[[r, c]] } else { f64::NAN }
                })
            };
            assert_eq!(find(&aperture(&map)).report.components, 0, "{least} {k}");
            let mut pitted = map;
            for (r, c) in pits {
                pitted.slice_mut(ndarray::s![r..r + 6, c..c + 6]).mapv_inplace(|v| v - 20.0);
            }
            let report = find(&aperture(&pitted)).report;
            assert_eq!((report.components, report.core_pixels), (1, 36), "{least} {k}");
        }
    }

    #[test]
    fn a_hill_counts_like_a_pit() {
        let map = with_pit(smooth(2)).mapv(|v| -v);
        assert_eq!(find(&map).report.core_pixels, 36);
    }

    #[test]
    fn noise_has_no_outlier() {
        for seed in 0..5 {
            let report = find(&smooth(seed)).report;
            assert_eq!(report.components, 0, "seed {seed}: {report:?}");
        }
    }

    #[test]
    fn the_noise_is_known_on_steep_slopes_too() {
        // A cylinder at 32 degrees, up to 17 nm from pixel to pixel, and 0.1 nm of noise: every pixel is the median of
        // its window.
        let noise = Normal::new(0.0, 0.1).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let map = Array2::from_shape_fn(SHAPE, |(r, c)| {
            let (x, y) = (0.1 * c as f64 - 10.0, 0.1 * r as f64 - 6.0);
            3.0 * (x + 0.618 * y).powi(2) + noise.sample(&mut rng)
        });
        let found = find(&map);
        // 24 000 pixels tell it to a percent; the differences of neighbours are not independent.
        assert!((found.report.noise_nm / 0.1 - 1.0).abs() < 0.05, "{}", found.report.noise_nm);
        assert_eq!(found.report.masked_pixels, 0);
    }

    #[test]
    fn a_step_at_the_border_is_not_an_outlier() {
        for width in [1, 3, 8] {
            let mut map = smooth(3);
            map.slice_mut(ndarray::s![.., ..width]).mapv_inplace(|v| v + 20.0);
            map.slice_mut(ndarray::s![SHAPE.0 - width.., ..]).mapv_inplace(|v| v - 20.0);
            assert_eq!(find(&map).report.components, 0, "width {width}");
        }
    }

    #[test]
    fn the_rim_of_a_circular_aperture_is_not_an_outlier_but_a_pit_near_it_is() {
        let inside = |r: usize, c: usize| (r as f64 - 59.5).hypot(c as f64 - 99.5) <= 58.0;
        let masked = |map: Array2<f64>| {
            Array2::from_shape_fn(SHAPE, |(r, c)| if inside(r, c) { map[[r, c]] } else { f64::NAN })
        };
        assert_eq!(find(&masked(smooth(4))).report.components, 0);
        let found = find(&masked(with_pit(smooth(4))));
        assert_eq!((found.report.components, found.report.core_pixels), (1, 36));
    }

    #[test]
    fn a_tilt_changes_nothing() {
        let flat = find(&with_pit(smooth(5)));
        let mut tilted = with_pit(smooth(5));
        tilted.indexed_iter_mut().for_each(|((r, c), v)| *v += 40.0 * c as f64 - 7.0 * r as f64);
        assert_eq!(find(&tilted).mask, flat.mask);
    }

    #[test]
    fn a_wide_pit_is_left_to_the_tool() {
        let mut map = smooth(6);
        // 25 px = 2.5 mm > 4 mm / 2.
        map.slice_mut(ndarray::s![50..75, 80..86]).mapv_inplace(|v| v - 20.0);
        assert_eq!(find(&map).report.components, 0);
    }

    #[test]
    fn too_many_outliers_are_refused() {
        let mut map = smooth(7);
        for (r, c) in (0..8).flat_map(|i| (0..12).map(move |j| (i, j))) {
            map[[8 + 14 * r, 10 + 15 * c]] -= 20.0;
        }
        let surface = Surface::new(grid(), map).unwrap();
        let error = outliers(&surface, &OutlierSettings::for_feature_mm(4.0)).unwrap_err();
        // 96 dots of 7 x 7 pixels.
        assert!(error.to_string().contains("4704 of 24000"), "{error}");
    }

    #[test]
    fn bad_settings_are_refused() {
        let surface = Surface::new(grid(), smooth(8)).unwrap();
        let good = OutlierSettings::for_feature_mm(4.0);
        let bad = [
            (OutlierSettings { feature_mm: 0.0, ..good.clone() }, "feature_mm: is 0"),
            (OutlierSettings { seed_sigmas: f64::NAN, ..good.clone() }, "seed_sigmas: is NaN"),
            (OutlierSettings { grow_sigmas: 16.0, ..good.clone() }, "grow_sigmas: is 16"),
            (OutlierSettings { floor_nm: -1.0, ..good }, "floor_nm: is -1"),
        ];
        for (settings, message) in bad {
            let error = outliers(&surface, &settings).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
    }
}
