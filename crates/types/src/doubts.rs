//! Doubts: probable mistakes in inputs of which each one is possible. A doubt is a sentence with a
//! remedy, and never refuses an input. It comes before anything is planned, because a plan for a
//! tilt that nobody wants, or for a pixel that is no height, takes hours of machine time.
//!
//! [`crate::plausible`] refuses what is certainly a mistake. Each bound here is beyond the values
//! of the fixtures and of measured mirrors, and below the values that the mistake causes.

use ndarray::Array2;
use planish_numerics::statistics;

use crate::{Limits, Surface, Tif, text::significant};

/// Fraction of the mean square of a map that is a plane, above which the plane is doubted as a tilt
/// of the measurement. Larger: a tilt that triples the time causes no doubt. Smaller: more parts
/// whose desired removal is a wedge are doubted; above 0.9 they are rare.
const MOST_PLANE: f64 = 0.9;

/// Smallest PV of a map in nm without a doubt, nm. Larger: flat parts are doubted. Smaller: maps in
/// um pass, whose numbers are a thousand times too small. Chosen: an interferometer repeats to
/// about 0.1 nm RMS.
const LEAST_PV_NM: f64 = 0.5;

/// Largest number of pixels that are searched for repeated heights and quantiles. Larger: more
/// time. Smaller: less certain quantiles. Chosen: 0.2 % of the pixels, the threshold of
/// [`LEAST_REPEATED`] and [`EXTREMES`], are 200 samples.
const MOST_SAMPLES: usize = 100_000;

/// Smallest fraction of the pixels with exactly one height, above which that height is doubted as a
/// mark of missing data. Larger: small areas without data pass. Smaller: heights that repeat by
/// chance are doubted.
const LEAST_REPEATED: f64 = 2e-3;
/// Smallest ratio of the number of pixels with that height to the number with the next most
/// frequent height. Larger: fewer doubts. Smaller: maps of integer counts are doubted, in which
/// neighbouring heights are about as frequent.
const LEAST_REPEATED_RATIO: usize = 10;

/// Fraction of the pixels at each end, the lowest and the highest ones, that do not decide the
/// range of the others. Larger: larger defects count as spikes. Smaller: a group of spikes widens
/// the range, and hides itself.
const EXTREMES: f64 = 2e-3;
/// Distance of a pixel from the range of the others, relative to that range, above which it is
/// doubted as a spike. Larger: lower spikes pass. Smaller: real pits are doubted. Chosen: the pits
/// of the fixtures, which a tool cannot correct, lie within one range.
const MOST_RANGES: f64 = 3.0;

/// Smallest and largest time in which the resting tool removes the mean depth, s, without a doubt.
/// Below the first, the machine would never stand still. Above the second, a part takes days. A
/// narrower interval doubts good plans, a wider one misses mistaken units. Chosen: the fixtures and
/// the reference mirror are between 1.6 and 11 s; rates in nm/min are 60 times too fast, rates in
/// um/s 1000 times too slow.
const MEAN_DEPTH_S: [f64; 2] = [0.1, 300.0];

/// Ratio of the time for the path at the largest velocity to the time of the removal, above which
/// the limits are doubted. Larger: mistaken units pass. Smaller: slow machines are doubted. Chosen:
/// at most 0.7 for the fixtures and the reference mirror on every machine; limits in m/s are 1000
/// times too small.
const MOST_TRAVEL: f64 = 5.0;

/// Least way, m, in which an axis reaches its largest velocity and stops, above which the limits are
/// doubted. Larger: mistaken units pass. Smaller: fast, weak machines are doubted. Chosen: 0.002 to
/// 0.03 m for the fixtures; velocities in mm/min or accelerations in g make it 3600 or 9800 times as
/// long.
const LEAST_WAY_M: f64 = 5.0;

/// Velocity, mm/s, above which such a way is due to the velocity. Chosen: figuring machines stay
/// below it.
const LEAST_FAST_MM_PER_S: f64 = 600.0;

/// Acceleration of 1 g, mm/s^2.
const STANDARD_GRAVITY_MM_PER_S2: f64 = 9806.65;

/// Smallest baseline of a TIF that is doubted, relative to the peak. The baseline is the rate that
/// 9 of 10 samples on the border exceed. Larger: real baselines pass. Smaller: good TIFs are
/// doubted. Chosen: a Gaussian that ends at 3 standard deviations has 2e-4.
const LEAST_BASELINE: f64 = 0.01;
/// Largest rate on the border up to which it can be a baseline, relative to the peak. Larger:
/// cropped spots are called a baseline. Smaller: high baselines are called a cropped spot.
const MOST_BASELINE: f64 = 0.3;
/// Largest spread of a level border: the difference of its 90 % and 10 % quantiles, relative to its
/// median. Larger: a cropped spot, whose border falls off towards its corners, is called a
/// baseline. Smaller: a baseline with noise is not recognised.
const MOST_SPREAD: f64 = 0.8;

/// Largest rate on the border, relative to the peak, above which the TIF is doubted as cropped.
/// Larger: cropped spots pass. Smaller: noise is doubted. Chosen: a Gaussian that ends at 2.4
/// standard deviations has this value, and noise of 1 % of the peak stays below it.
const MOST_BORDER: f64 = 0.06;

/// Doubt about the heights of a map in the clear aperture, before the map is levelled.
pub fn of_heights(measured: &Surface) -> Option<String> {
    let map = measured.height_nm();
    let mut some = sampled(map);
    some.sort_unstable_by(f64::total_cmp);
    no_height(map, &some).or_else(|| spikes(map, &some))
}

/// Doubt about the desired removal, from its PV and its RMS with and without the best plane, nm.
pub fn of_removal(pv_nm: f64, rms_nm: f64, detilted_nm: f64) -> Option<String> {
    if pv_nm > 0.0 && pv_nm < LEAST_PV_NM {
        return Some(format!(
            "the heights span {} nm in all, less than an interferometer resolves: heights in um? give nm, or \
             surface_settings=\"--unit um\" for the file of an instrument",
            significant(pv_nm, 2)
        ));
    }
    let plane = 1.0 - (detilted_nm / rms_nm).powi(2);
    (plane > MOST_PLANE).then(|| {
        format!(
            "{:.0} % of the RMS is a plane ({} nm RMS with it, {} nm without): a tilt of the measurement? \
             prepare=\"--level plane\" takes it off; as it is, the run removes it",
            100.0 * (1.0 - detilted_nm / rms_nm),
            significant(rms_nm, 3),
            significant(detilted_nm, 3)
        )
    })
}

/// Doubt about the samples of a TIF.
pub fn of_tif(tif: &Tif) -> Option<String> {
    let (ny, nx) = tif.grid().shape();
    let rate = tif.rate_nm_per_s();
    let border = rate
        .indexed_iter()
        .filter(|((r, c), _)| *r == 0 || *c == 0 || *r == ny - 1 || *c == nx - 1);
    let mut border: Vec<f64> = border.map(|(_, v)| v / tif.peak_nm_per_s()).collect();
    border.sort_unstable_by(f64::total_cmp);
    let [baseline, median, high] =
        [0.1, 0.5, 0.9].map(|part| border[(part * border.len() as f64) as usize]);
    let largest = border[border.len() - 1];
    let is_level = high - baseline < MOST_SPREAD * median;
    if baseline > LEAST_BASELINE && largest < MOST_BASELINE && is_level {
        // Part of the volume that is a block of this height.
        let part = baseline * tif.peak_nm_per_s() * rate.len() as f64 / rate.sum();
        return Some(format!(
            "the TIF has {:.1} % of its peak all along its border, which is {:.0} % of its volume: a baseline? \
             planish-surface tif --subtract-border takes it off",
            100.0 * baseline,
            100.0 * part
        ));
    }
    (largest > MOST_BORDER).then(|| {
        format!(
            "the TIF ends at {:.0} % of its peak, so that its volume is too small and a raster prints the step onto \
             the part: a spot that was cropped? measure a wider field",
            100.0 * largest
        )
    })
}

/// Doubt about the units of the map and the TIF, from the time in which the resting tool removes
/// the mean depth.
pub fn of_rates(desired: &Surface, tif: &Tif) -> Option<String> {
    let depth_nm = mean_depth_nm(desired);
    let at_one_place_s = depth_nm / tif.peak_nm_per_s();
    let [least, most] = MEAN_DEPTH_S;
    let said = |units: &str| {
        format!(
            "the tool removes the mean depth of {} nm in {} s at one place (its peak is {} nm/s): {units}",
            significant(depth_nm, 3),
            significant(at_one_place_s, 2),
            significant(tif.peak_nm_per_s(), 3)
        )
    };
    if at_one_place_s > most {
        return Some(said("rates in um/s? give nm/s"));
    }
    (at_one_place_s > 0.0 && at_one_place_s < least)
        .then(|| said("rates in nm/min, or heights in um? give nm/s and nm"))
}

/// Doubt about the limits of the machine for lines of this pitch, mm. The path is about area /
/// pitch long.
pub fn of_limits(desired: &Surface, tif: &Tif, limits: &Limits, pitch_mm: f64) -> Option<String> {
    of_units_of_limits(limits).or_else(|| of_slow_limits(desired, tif, limits, pitch_mm))
}

/// Doubt about the units of the limits, from the way in which an axis reaches its largest velocity
/// and stops, v^2 / a.
fn of_units_of_limits(limits: &Limits) -> Option<String> {
    let velocities = limits.max_velocity_mm_per_s().into_iter();
    let axes = velocities.zip(limits.max_acceleration_mm_per_s2());
    let way_m = |(v, a): &(f64, f64)| 1e-3 * v * v / a;
    let (v, a) = axes.max_by(|one, other| way_m(one).total_cmp(&way_m(other)))?;
    let way = significant(way_m(&(v, a)), 2);
    if way_m(&(v, a)) < LEAST_WAY_M {
        return None;
    }
    if v > LEAST_FAST_MM_PER_S {
        return Some(format!(
            "an axis needs {way} m to reach its largest velocity of {} mm/s and to stop: velocities in mm/min? {} \
             mm/min are {} mm/s",
            significant(v, 4),
            significant(v, 4),
            significant(v / 60.0, 4)
        ));
    }
    Some(format!(
        "an axis needs {way} m to reach {} mm/s and to stop at its largest acceleration of {} mm/s^2: accelerations \
         in g or m/s^2? {} g are {} mm/s^2, {} m/s^2 are {} mm/s^2",
        significant(v, 4),
        significant(a, 4),
        significant(a, 4),
        significant(STANDARD_GRAVITY_MM_PER_S2 * a, 4),
        significant(a, 4),
        significant(1e3 * a, 4)
    ))
}

/// Doubt about limits that make the machine slower than the removal.
fn of_slow_limits(desired: &Surface, tif: &Tif, limits: &Limits, pitch_mm: f64) -> Option<String> {
    let area_mm2 = desired.statistics().valid_count as f64 * desired.grid().pixel_mm2();
    let removal_s = mean_depth_nm(desired) * area_mm2 / tif.vrr_nm_mm2_per_s();
    let fastest = limits.max_velocity_mm_per_s().into_iter().fold(0.0, f64::max);
    let travel_s = area_mm2 / pitch_mm / fastest;
    (removal_s > 0.0 && travel_s > MOST_TRAVEL * removal_s).then(|| {
        format!(
            "the machine takes {} s for the path at its largest velocity of {} mm/s, and the removal {} s: limits in \
             m/s? give mm/s and mm/s^2",
            significant(travel_s, 3),
            significant(fastest, 3),
            significant(removal_s, 3)
        )
    })
}

/// Mean depth of the desired removal, nm: the mean height above the lowest height but for
/// [`EXTREMES`]. A downward spike is not the depth of the part.
fn mean_depth_nm(desired: &Surface) -> f64 {
    let s = desired.statistics();
    let low = statistics::lowest(desired.height_nm().view(), None, EXTREMES).unwrap_or(s.min);
    s.mean - low
}

/// Valid heights, at most [`MOST_SAMPLES`] of them, at equal distances in the array.
fn sampled(map: &Array2<f64>) -> Vec<f64> {
    let valid = statistics::valid_count(map.view());
    map.iter().filter(|z| !z.is_nan()).step_by(valid.div_ceil(MOST_SAMPLES)).copied().collect()
}

/// Doubt about a height that far more pixels have, exactly, than any other height; `some` are
/// sorted.
fn no_height(map: &Array2<f64>, some: &[f64]) -> Option<String> {
    let runs = some.chunk_by(|a, b| a == b);
    let (mut first, mut second) = ((0, 0.0), 0);
    for run in runs {
        if run.len() > first.0 {
            (second, first) = (first.0, (run.len(), run[0]));
        } else {
            second = second.max(run.len());
        }
    }
    let (repeated, height) = first;
    // Fewer than two heights are a flat map, and no doubt.
    let many = repeated as f64 > LEAST_REPEATED * some.len() as f64;
    if !many || second == 0 || repeated < LEAST_REPEATED_RATIO * second {
        return None;
    }
    let [count] = statistics::counts(map.view(), [height]);
    Some(format!(
        "{count} pixels have exactly the height {height} nm, and no other height is so frequent: pixels without data? \
         mark them by NaN, or give the clear aperture (prepare=\"--aperture-rectangle-mm X0 X1 Y0 Y1\")"
    ))
}

/// Doubt about pixels far outside the range of all others; `some` are sorted.
fn spikes(map: &Array2<f64>, some: &[f64]) -> Option<String> {
    // At least the two outermost samples on each side.
    let out = ((EXTREMES * some.len() as f64) as usize).max(2);
    let (low, high) = (*some.get(out)?, *some.get(some.len().checked_sub(out + 1)?)?);
    let beyond = MOST_RANGES * (high - low);
    let is_beyond = |z: &&f64| **z < low - beyond || **z > high + beyond;
    let count = map.iter().filter(is_beyond).count();
    if beyond <= 0.0 || count == 0 {
        return None;
    }
    let (lowest, highest) = statistics::range(map.view());
    let farthest = if low - lowest > highest - high { lowest } else { highest };
    let (are, them) = if count == 1 { ("pixel lies", "it") } else { ("pixels lie", "them") };
    Some(format!(
        "{count} {are} up to {} nm beyond all others, which are from {} to {} nm: spikes, or pixels without data ({})? \
         prepare=\"--mask-outliers --feature-mm W\" leaves {them} out, where W is the width of the tool",
        significant((low - lowest).max(highest - high), 3),
        significant(low, 3),
        significant(high, 3),
        significant(farthest, 5)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axis, Grid, MachineFile, MachineFileAxis};

    fn axis(start: f64, end: f64, n: usize) -> Axis {
        Axis::new(start, (end - start) / (n - 1) as f64, n).unwrap()
    }

    /// A map of 40 x 24 mm with a PV of about 40 nm, whose heights are replaced by those of
    /// `change`.
    fn map(change: impl Fn(f64, (usize, usize)) -> f64) -> Surface {
        let grid = Grid { x: axis(0.0, 40.0, 81), y: axis(0.0, 24.0, 49) };
        let z = Array2::from_shape_fn((49, 81), |(r, c)| {
            let (x, y) = (c as f64 - 40.0, r as f64 - 20.0);
            change(0.01 * x * x + 0.03 * y * y + 0.3 * (0.7 * x).sin(), (r, c))
        });
        Surface::new(grid, z).unwrap()
    }

    /// A Gaussian TIF of sigma 1.5 mm and 10 nm/s out to `half` mm, whose rates are replaced by
    /// those of `change`.
    fn tool(half: f64, change: impl Fn(f64) -> f64) -> Tif {
        let a = axis(-half, half, 49);
        let rate = Array2::from_shape_fn((49, 49), |(r, c)| {
            change(10.0 * (-0.5 * (a.at(r).powi(2) + a.at(c).powi(2)) / 2.25).exp())
        });
        Tif::new(Grid { x: a, y: a }, rate).unwrap()
    }

    fn limits(velocity: f64) -> Limits {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: velocity,
            max_acceleration_mm_per_s2: 2000.0,
            ..MachineFileAxis::default()
        };
        let axes = ["x", "y"].map(axis).to_vec();
        MachineFile { name: "m".into(), axes, ..MachineFile::default() }.checked().unwrap()
    }

    fn of_map(surface: &Surface) -> Option<String> {
        let s = surface.statistics();
        of_heights(surface).or_else(|| of_removal(s.pv, s.rms, surface.detilted_rms_nm()))
    }

    #[track_caller]
    fn said(doubt: Option<String>, parts: &[&str]) {
        let doubt = doubt.expect("a doubt");
        assert!(!doubt.contains('\n'), "{doubt}");
        for part in parts {
            assert!(doubt.contains(part), "no {part:?} in: {doubt}");
        }
    }

    #[test]
    fn an_ordinary_map_with_its_tool_and_machine_is_in_no_doubt() {
        let (surface, tif) = (map(|z, _| z), tool(5.0, |rate| rate));
        assert_eq!(of_map(&surface), None);
        // Counts of 0.1 nm, a pit of the depth of the map, and a corner without data.
        assert_eq!(of_map(&map(|z, _| (10.0 * z).round() / 10.0)), None);
        assert_eq!(of_map(&map(|z, at| if at == (7, 9) { -30.0 } else { z })), None);
        assert_eq!(of_map(&map(|z, (r, c)| if r < 9 && c < 9 { f64::NAN } else { z })), None);
        // Some wedge, and a map that is flat.
        assert_eq!(of_map(&map(|z, (_, c)| z + 0.1 * c as f64)), None);
        assert_eq!(of_map(&map(|_, _| 5.0)), None);
        assert_eq!(of_tif(&tif), None);
        // A Gaussian that ends at 2.9 standard deviations, as that of the reference mirror does.
        assert_eq!(of_tif(&tool(4.4, |rate| rate)), None);
        assert_eq!(of_rates(&surface, &tif), None);
        for velocity in [1000.0, 250.0, 10.0] {
            assert_eq!(of_limits(&surface, &tif, &limits(velocity), 1.0), None);
        }
    }

    #[test]
    fn heights_that_are_none_are_named() {
        let hole = |v: f64| move |z, (r, c): (usize, usize)| if r < 9 && c < 20 { v } else { z };
        said(of_map(&map(hole(9999.0))), &["180 pixels have exactly the height 9999 nm"]);
        said(of_map(&map(hole(0.0))), &["the height 0 nm", "mark them by NaN", "prepare="]);
        let few = |z, at| if at == (3, 3) || at == (3, 4) { 9999.0 } else { z };
        said(of_map(&map(few)), &["2 pixels lie", "9999", "--mask-outliers --feature-mm W"]);
        let spikes = |z, at| match at {
            (10, 10) => 3000.0,
            (20, 30) => -3000.0,
            _ => z,
        };
        said(of_map(&map(spikes)), &["2 pixels lie", "spikes"]);
    }

    #[test]
    fn a_tilt_and_heights_in_um_are_named() {
        let tilted = of_map(&map(|z, (_, c)| z + 20.0 * c as f64));
        said(tilted, &["98 % of the RMS is a plane", "prepare=\"--level plane\""]);
        said(of_map(&map(|z, _| 1e-3 * z)), &["span 0.0", "heights in um"]);
    }

    #[test]
    fn a_tool_with_a_baseline_or_cropped_or_in_other_units_is_named() {
        let surface = map(|z, _| z);
        // 0.5 nm/s on 10 x 10 mm beside 2 pi sigma^2 10 nm/s: 50 / (50 + 141), and the lattice ends half a pitch later.
        let baseline = of_tif(&tool(5.0, |rate| rate + 0.5));
        said(baseline, &["4.8 % of its peak", "is 27 % of its volume", "--subtract-border"]);
        // exp(-1.317^2 / 2) = 0.42
        let cropped = of_tif(&tool(1.317 * 1.5, |rate| rate));
        said(cropped, &["ends at 42 % of its peak", "measure a wider field"]);
        said(of_rates(&surface, &tool(5.0, |rate| 60.0 * rate)), &["600 nm/s", "nm/min"]);
        said(of_rates(&surface, &tool(5.0, |rate| 1e-3 * rate)), &["0.01 nm/s", "um/s"]);
    }

    #[test]
    fn limits_in_mm_per_minute_and_in_g_are_named() {
        let of = |velocity: f64, acceleration: f64| {
            let mut file: MachineFile = (&limits(velocity)).into();
            file.axes.iter_mut().for_each(|axis| axis.max_acceleration_mm_per_s2 = acceleration);
            of_limits(&map(|z, _| z), &tool(5.0, |rate| rate), &file.checked().unwrap(), 1.0)
        };
        // 250 mm/s are 15000 mm/min: 15000^2 / 2000 mm are 112 m.
        said(of(15000.0, 2000.0), &["needs 110 m", "mm/min", "15000 mm/min are 250 mm/s"]);
        said(of(250.0, 0.2), &["0.2 g are 1961 mm/s^2", "0.2 m/s^2 are 200 mm/s^2"]);
        // A slow machine: 20 mm/s and 200 mm/s^2.
        said(of(1200.0, 200.0), &["1200 mm/min are 20 mm/s"]);
        said(of(20.0, 0.02), &["0.02 g are 196.1 mm/s^2"]);
        assert_eq!(of(500.0, 100.0), None);
    }

    #[test]
    fn limits_in_metres_per_second_are_named() {
        let doubt = of_limits(&map(|z, _| z), &tool(5.0, |rate| rate), &limits(0.25), 1.0);
        said(doubt, &["largest velocity of 0.25 mm/s", "limits in m/s"]);
    }
}
